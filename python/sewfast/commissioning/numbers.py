"""The numbers of a commissioning as JSON values, for `commissioning.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun
from .verification import Comparison

if TYPE_CHECKING:
    from .result import Commissioning

_FOPDT = ("K", "T", "L", "offset", "u_low", "u_high", "fit_percent")


def numbers(c: Commissioning) -> dict[str, Any]:
    """The content of `commissioning.json`; null for results that are missing."""
    return {
        "machine": c.machine,
        "verdict": c.verdict,
        "stage": c.stage,
        "reason": c.reason,
        "seconds": dict(c.seconds),
        "recordings": {name: len(r) * r.Ts for name, r in c.recordings.items()},
        "motion": None if c.motion is None else dict(vars(c.motion)),
        "fopdt": None if c.fopdt is None else {n: getattr(c.fopdt, n) for n in _FOPDT},
        "small_signals": _small_signals(c),
        "acceleration_rpm_per_s": c.acceleration,
        "turn_load_v_rms": None if c.turn_load is None else c.turn_load.rms,
        "models": {"members": 0 if c.models is None else len(c.models.members)}
        | {"levels_rmse_rpm": list(c.rmse), "kind": _kind(c)},
        "rival": None
        if c.rival is None
        else {"order": c.rival.model.orders["na"], "levels_rmse_rpm": c.rival.rmse},
        "second_opinion": _opinion(c),
        "simulated_at_s": c.sample_time,
        "notes": list(c.notes),
        "controllers": {
            name: _gains(controller)
            for name, controller in (("first", c.first), ("tuned", c.controller))
            if controller is not None
        },
        "tuning": None
        if c.tuning is None
        else {
            "evaluations": c.tuning.evaluations,
            "cost": c.tuning.cost,
            "start_cost": c.tuning.start_cost,
            "termination": c.tuning.termination,
            "constraints": str(c.tuning.constraints),
        },
        "cost": None if c.cost is None else dict(vars(c.cost)),
        "met": None if c.met is None else dict(c.met),
        "margins": _finite(c.margins),
        "evidence": {
            name: {"verdict": judged.verdict, "lines": [x.to_json() for x in judged.lines]}
            for name, judged in (("report card", c.card), ("closed loops", c.judgement))
            if judged is not None
        },
        "predicted_cost": c.predicted_cost,
        "measured_cost": c.measured_cost,
        "references": {x.reference: _comparison(x) for x in c.comparisons},
    }


def _finite(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The values with null for an infinite margin, which JSON lacks."""
    if found is None:
        return None

    def one(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: one(x) for name, x in value.items()}
        if isinstance(value, list):
            return [one(x) for x in value]
        return value if math.isfinite(value) else None

    return {name: one(value) for name, value in found.items()}


def _small_signals(c: Commissioning) -> dict[str, Any] | None:
    """Order, first-order description and resonance of the machine about a working speed."""
    found = c.small_signal
    if found is None:
        return None
    fopdt, resonance = found.fopdt, found.resonance
    return {
        "order": found.model.orders["na"],
        "fopdt": None if fopdt is None else {n: getattr(fopdt, n) for n in ("K", "T", "L")},
        "resonance": None if resonance is None else dict(vars(resonance)),
    }


def _kind(c: Commissioning) -> str | None:
    return None if c.models is None else c.models.members[0].kind


def _opinion(c: Commissioning) -> dict[str, Any] | None:
    """Costs of the gains tuned on models, rival and both, on either; null if a loop diverges."""
    opinion = None if c.tuning is None else c.tuning.opinion
    if opinion is None:
        return None
    on_models, on_rival = ([x if np.isfinite(x) else None for x in row] for row in opinion.costs)
    return {"on_models": on_models, "on_rival": on_rival, "taken": opinion.pick}


def _gains(controller: Controller) -> dict[str, Any]:
    """The controller as in its file, with gains in standard form."""
    return {**controller.to_dict(), "gains": controller.gains.to("standard").to_dict()}


def _comparison(c: Comparison) -> dict[str, Any]:
    return {
        "predicted": run_numbers(c.predicted),
        "measured": None if c.measured is None else run_numbers(c.measured),
        "apart_rmse_rpm": c.apart,
        "disagreement_rmse_rpm": c.disagreement,
    }


def run_numbers(found: ClosedLoopRun) -> dict[str, float | None]:
    """The metrics of a run by their names in result files."""
    metrics = found.metrics()
    return {
        "rmse_rpm": metrics["rmse"],
        "max_abs_rpm": metrics["max_abs"],
        "rise_time_ms": metrics["rise_time_ms"],
        "overshoot_percent": metrics["overshoot_percent"],
        "effort_v": metrics["u_rms"],
        "chatter_v": metrics["du_rms"],
        "saturated": metrics["saturated"],
    }
