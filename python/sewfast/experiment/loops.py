"""Closed loops of the experiment: the commissioned controller, and the paper's gains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .. import _core
from ..commissioning import Commissioning, commission
from ..commissioning.numbers import run_numbers
from ..control import Controller, Gains, paper_controller
from ..errors import FitError
from ..loop import ClosedLoopRun, run
from ..models import LinearOE
from ..report.artefacts import PLANTS, REFERENCES
from .rig import Rig

Runs = dict[tuple[str, str], ClosedLoopRun]

PRACTICE = ("trapezoid", "trapezoids", "random")
"""References to tune on, half as long as those to verify on."""
PAPER_LIMIT = 10.0
"""Of the command under the paper's gains [V]."""


def commissioned(rig: Rig, seed: int) -> Commissioning:
    """The drive, commissioned for the experiment's references."""
    return commission(rig, references=REFERENCES, practice=PRACTICE, seed=seed)


def commissioned_runs(found: Commissioning) -> Runs:
    """Every reference as the ensemble predicted it, and on the machine."""
    runs: Runs = {}
    for c in found.comparisons:
        runs[c.reference, "model"] = c.predicted
        if c.measured is not None:
            runs[c.reference, "machine"] = c.measured
    return runs


def paper_runs(rig: Rig) -> Runs:
    """The paper's gains on the plant of its Eq. 8, ideal feedback, and on the machine."""
    gains = paper_controller()
    return {
        ("paper_gains", "eq8"): run(replace(gains, counts_per_rev=None), eq8(), "trapezoid"),
        ("paper_gains", "machine"): rig.run(gains, "trapezoid", volt=PAPER_LIMIT),
    }


def readings() -> dict[str, dict[str, float | None]]:
    """The paper's gains on the plant of its Eq. 8, by the error's unit and the gains' form."""
    paper = replace(paper_controller(), counts_per_rev=None)
    numbers = (paper.gains.Kp, paper.gains.Ki, paper.gains.Kd)
    units = {"rpm": 1.0, "cps": 60.0 / (1572.0 * paper.Ts), "krpm": 1000.0}
    found = {}
    for unit, size in units.items():
        Kp, Ki, Kd = (gain / size for gain in numbers)
        forms = {
            "per_sample": Gains.per_sample(Kp, Ki, Kd, Ts=paper.Ts),
            "continuous": Gains.parallel(Kp, Ki, Kd),
        }
        for form, gains in forms.items():
            found[f"{form}_{unit}"] = _tried(replace(paper, gains=gains))
    return found


def _tried(controller: Controller) -> dict[str, float | None]:
    names = ("rmse_rpm", "rise_time_ms", "overshoot_percent")
    try:
        numbers = run_numbers(run(controller, eq8(), "trapezoid"))
    except FitError:
        return dict.fromkeys(names)
    return {name: numbers[name] for name in names}


def eq8() -> LinearOE:
    """The plant of the paper's Eq. 8, as printed."""
    core = _core.LinearModel(np.array([-1.87, 0.8705]), np.array([[0.1228, 0.1224]]), 1, 0.0)
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM")


def control_numbers(runs: Mapping[tuple[str, str], ClosedLoopRun]) -> dict[str, dict[str, Any]]:
    """`control` of `results.json`."""
    return {r: _pair({p: runs[r, p] for p in PLANTS}) for r in REFERENCES}


def paper_numbers(runs: Mapping[tuple[str, str], ClosedLoopRun]) -> dict[str, dict[str, Any]]:
    """`paper_gains` of `results.json`."""
    return {plant: run_numbers(r) for (_, plant), r in runs.items()}


def _pair(runs: Mapping[str, ClosedLoopRun]) -> dict[str, Any]:
    apart = runs["model"].y - runs["machine"].y
    return {
        **{plant: run_numbers(r) for plant, r in runs.items()},
        "model_vs_machine_rmse_rpm": float(np.sqrt(np.mean(apart**2))),
        "reference_rise_time_ms": runs["machine"].metrics()["reference_rise_time_ms"],
    }
