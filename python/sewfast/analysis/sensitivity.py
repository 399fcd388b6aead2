"""`GainSensitivity`: what a gain that is a little off costs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from ..control import Controller
from ..gains import Gains
from .scoring import Score, Task, each

FACTORS = (0.75, 0.9, 1.1, 1.25)
NAMES = ("Kp", "Ti", "Td", "alpha", "beta", "N", "filter_time", "observer_time")


@dataclass(frozen=True)
class GainSensitivity:
    """One setting, moved.

    Attributes
    ----------
    name : str
        `Kp`, `Ti`, `Td` (of the schedule as well), `alpha`, `beta`, `N`, ...
    value : float
        As it is.
    factors : tuple of float
    scores : tuple of Score
        One per factor.
    """

    name: str
    value: float
    factors: tuple[float, ...]
    scores: tuple[Score, ...]

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        rows = zip(self.factors, self.scores, strict=True)
        return {
            "name": self.name,
            "value": self.value,
            "moved": [{"factor": f, **s.to_json()} for f, s in rows],
        }


def gain_sensitivity(
    controller: Controller, task: Task, *, threads: int | None = None
) -> tuple[GainSensitivity, ...]:
    """Every setting that is neither 0 nor infinite, by each of `FACTORS`.

    Parameters
    ----------
    controller : Controller
    task : Task
        Plants, references and cost.
    threads : int, optional
        All processors by default; the result is the same at any number.
    """
    values = {n: v for n in NAMES if (v := _value(controller, n)) and math.isfinite(v)}
    jobs = [(n, f) for n in values for f in FACTORS]
    scores = each(lambda job: task.score(scaled(controller, *job)), jobs, threads)
    return tuple(
        GainSensitivity(n, v, FACTORS, tuple(scores[i * len(FACTORS) : (i + 1) * len(FACTORS)]))
        for i, (n, v) in enumerate(values.items())
    )


def _value(controller: Controller, name: str) -> float:
    if name in ("Kp", "Ti", "Td"):
        return float(getattr(controller.gains.to("standard"), name))
    return float(getattr(controller, name))


def scaled(controller: Controller, name: str, factor: float) -> Controller:
    """The controller with one setting times a factor, gains in standard form."""
    if name not in ("Kp", "Ti", "Td"):
        return replace(controller, **{name: factor * getattr(controller, name)})
    changes: dict[str, Any] = {"gains": _scaled(controller.gains, name, factor)}
    schedule = controller.schedule
    if schedule:
        changes["schedule"] = tuple((s, _scaled(g, name, factor)) for s, g in schedule)
    return replace(controller, **changes)


def _scaled(gains: Gains, name: str, factor: float) -> Gains:
    g = gains.to("standard")
    values = {"Kp": g.Kp, "Ti": g.Ti, "Td": g.Td}
    values[name] *= factor
    return Gains.standard(**values, u_unit=g.u_unit, y_unit=g.y_unit)
