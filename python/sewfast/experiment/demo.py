"""The paper's experiment on a virtual machine, stage by stage: `run_demo`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from .. import __version__
from ..commissioning.taken import prepare
from ..control import Controller, Fopdt, paper_controller
from ..machine import VirtualMachine
from ..report import report
from ..report.canvas import require
from ..signals import excitation
from ..tuning import TuningResult
from . import folder, identified, loops, recordings
from .rig import Rig, rig

Progress: TypeAlias = Callable[[int, int, str], object]
"""Called with stages done, stages in all, and what comes now."""

STAGES = (
    "recording the machine",
    "paper's network",
    "linear models",
    "closed-loop recording",
    "default network",
    "scores",
    "report card",
    "commissioning",
    "paper's gains",
    "writing",
)


class _Clock:
    """Tells the progress and how long each stage took."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._began: list[float] = []

    def enter(self, stage: str) -> None:
        if self._progress is not None:
            self._progress(len(self._began), len(STAGES), stage)
        self._began.append(time.perf_counter())

    def finish(self) -> None:
        if self._progress is not None:
            self._progress(len(STAGES), len(STAGES), "done")

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began[0]

    def stages(self) -> dict[str, float]:
        ends = [*self._began[1:], time.perf_counter()]
        pairs = zip(STAGES, self._began, ends, strict=False)
        return {stage: end - began for stage, began, end in pairs}


def run_demo(
    out: str | os.PathLike[str],
    seed: int = 0,
    *,
    machine: str = "virtual",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Carry out the paper's experiment: excite, record, identify, validate, commission, report.

    The machine is behind a port and is talked to as to hardware (docs/PROTOCOL.md).

    Parameters
    ----------
    out : path
        Result folder (docs/ARCHITECTURE.md); artefacts of an earlier experiment are replaced once
        this one is through.
    seed : int
        Of the random signals, of the networks' starts and of the search for gains.
    machine : str
        `virtual`, or `virtual:SEED` for another machine of the type.
    overwrite : bool
        Whether files of these names may be replaced that no experiment has left.
    progress : callable(done, total, stage), optional
        Called as each stage begins, and at the end.

    Returns
    -------
    dict
        The values of `results.json`.

    Raises
    ------
    SettingError
        For an unknown machine, a seed that is none, a folder with files of somebody else's, or
        where the report's packages are missing.
    DataError
        Where the folder cannot be made.
    Interrupted
        On Ctrl-C; an earlier experiment in the folder is left as it was.
    """
    require()
    plant = VirtualMachine.from_name(machine)
    excitation("random", seed)  # refuses a seed that is none before the folder is made
    target = Path(out)
    folder.require_own(target, overwrite=overwrite)
    prepare(target)
    try:
        with rig(plant) as bench:
            return _carry_out(target, bench, seed, _Clock(progress))
    except BaseException:
        folder.abandon(target)
        raise


def _carry_out(target: Path, rig: Rig, seed: int, clock: _Clock) -> dict[str, Any]:
    """The stages, one after the other; the folder is written at the end."""
    clock.enter("recording the machine")
    recorded = recordings.open_loop(rig, seed)
    lo_hi = recorded["chirp_lo_hi"]
    speed = recordings.speed_numbers(lo_hi)

    clock.enter("paper's network")
    models = {"paper": identified.paper(recorded, seed)}
    ideal = identified.ideal_cost(rig.machine, seed)

    clock.enter("linear models")
    models["arx_raw"] = identified.arx_raw(recorded)
    models["arx"] = identified.linear(recorded, "arx", identified.PAPER_RECORDS)
    models["oe"] = identified.linear(recorded, "oe", identified.PAPER_RECORDS)

    clock.enter("closed-loop recording")
    fopdt = recordings.first_order(recorded["step"])
    coarse = recordings.coarse_controller(fopdt, Ts=rig.Ts, counts_per_rev=rig.counts_per_rev)
    recorded["closed_loop"] = recordings.closed_loop(rig, coarse)

    clock.enter("default network")
    models["oe_all"] = identified.linear(recorded, "oe", identified.ALL_RECORDS)
    models["neural_oe"] = identified.neural(recorded, seed)

    clock.enter("scores")
    scored = identified.scores(models, recorded)

    clock.enter("report card")
    check, drawings = identified.report_card(models["neural_oe"], recorded["random"])

    clock.enter("commissioning")
    found = loops.commissioned(rig, seed)
    runs = loops.commissioned_runs(found)

    clock.enter("paper's gains")
    paper_runs = loops.paper_runs(rig)

    clock.enter("writing")
    tuned, tuning = found.controller, found.tuning
    assert tuned is not None
    assert tuning is not None
    controllers = {"paper": paper_controller(), "coarse": coarse, "tuned": tuned}
    identification = identified.identification_numbers(
        models, scored, speed["difference"]["cost_floor"]
    )
    identification["paper"]["cost_ideal"] = ideal
    results = {
        "sewfast": __version__,
        "machine": rig.drive.identity.name,
        "link": rig.numbers(),
        "seed": seed,
        "counts_per_rev": rig.counts_per_rev,
        "speed": speed,
        "identification": identification,
        "check": check,
        **_controller_numbers(fopdt, controllers, tuning),
        "commissioning": found.numbers(),
        "control": loops.control_numbers(runs),
        "paper_gains": loops.paper_numbers(paper_runs) | {"readings": loops.readings()},
        "seconds": clock.seconds,
        "stages": clock.stages(),
    }
    folder.write(
        target,
        results,
        recordings=recorded,
        models=models,
        controllers=controllers,
        predictions=identified.predictions(scored),
        runs=runs | paper_runs,
        drawings=drawings,
        commissioning=found,
    )
    report(target)
    clock.finish()
    return results


def _controller_numbers(
    fopdt: Fopdt, controllers: dict[str, Controller], tuning: TuningResult
) -> dict[str, Any]:
    """How the gains came about, for `results.json`."""
    names = ("K", "T", "L", "offset", "u_low", "u_high", "fit_percent")
    ratio = fopdt.L / fopdt.T
    return {
        "fopdt": {name: getattr(fopdt, name) for name in names},
        "table_1": {
            "ratio": ratio,
            "ratio_used": min(max(ratio, 0.1), 1.0),
            "in_range": 0.1 <= ratio <= 1.0,
        },
        "gains": {name: _gains(c) for name, c in controllers.items()},
        "limits": {"u_min": tuning.controller.u_min, "u_max": tuning.controller.u_max},
        "tuning": {
            "evaluations": tuning.evaluations,
            "cost": tuning.cost,
            "start_cost": tuning.start_cost,
            "termination": tuning.termination,
        },
    }


def _gains(controller: Controller) -> dict[str, float | None]:
    """Gains in standard form, null for no integral action."""
    values = controller.to_dict()
    gains = controller.gains.to("standard").to_dict()
    kept = {name: gains[name] for name in ("Kp", "Ti", "Td")}
    kept["Ti"] = None if kept["Ti"] == float("inf") else kept["Ti"]
    return kept | {name: values[name] for name in ("alpha", "beta", "N", "filter_samples")}
