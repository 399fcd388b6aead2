"""Sensitivity of the cost to changed gains, and to changed plants."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from ..control.controller import Controller
from ..control.loop import Plant, run
from ..control.margins import margins
from ..errors import FitError, SettingError
from ..gains import Gains
from ..machine import VirtualMachine
from ..threads import available
from ..tuning.objective import Cost, terms
from .changes import ON_MACHINES, ON_MODELS, Change
from .points import PlantPoint, plant_points

# --- Score: cost and margin of a controller on plants and references ------------------------------


J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True)
class Score:
    """A controller on a set of plants.

    Attributes
    ----------
    cost : float
        Mean over plants and references [y]; infinite if a loop diverges.
    tracking : float
        The worst rms of r - y [y].
    overshoot_percent : float
        The worst overshoot.
    chatter : float
        The worst rms of the command's change from sample to sample [u].
    Ms : float
        The worst Ms; infinite if a linear loop is unstable, NaN if there is none.
    """

    cost: float
    tracking: float
    overshoot_percent: float
    chatter: float
    Ms: float

    def to_json(self) -> dict[str, float | None]:
        """As JSON values; numbers that are not finite become None."""
        return {k: v if math.isfinite(v) else None for k, v in vars(self).items()}


@dataclass(frozen=True, eq=False)
class Task:
    """What scores a controller; `points` are the plants at the operating point, for Ms."""

    plants: tuple[Plant, ...]
    names: tuple[str, ...]
    points: tuple[PlantPoint, ...]
    references: tuple[Any, ...]
    cost: Cost
    seed: int

    def on(self, plants: Sequence[Plant], names: Sequence[str]) -> Task:
        """The task on other plants, linearised at the same output."""
        points: tuple[PlantPoint, ...] = ()
        with contextlib.suppress(SettingError):
            points = plant_points(plants, names, [self.points[0].y])[0]
        return replace(self, plants=tuple(plants), names=tuple(names), points=points)

    def score(self, controller: Controller) -> Score:
        """Run every reference on every plant."""
        peaks = [margins(controller, p, speed=p.y).Ms for p in self.points]
        Ms = max(peaks, default=math.nan)
        costs, seen = [], []
        try:
            for plant in self.plants:
                runs = [run(controller, plant, r, seed=self.seed) for r in self.references]
                costs.append(self.cost.of(runs))
                seen += [terms(r) for r in runs]
        except FitError:
            return Score(math.inf, math.inf, math.inf, math.inf, Ms)
        worst = {n: max(s[n] for s in seen) for n in ("tracking", "overshoot", "chatter")}
        return Score(
            float(np.mean(costs)), worst["tracking"], worst["overshoot"], worst["chatter"], Ms
        )


def each(function: Callable[[J], R], jobs: Sequence[J], threads: int | None) -> list[R]:
    """Results in the order of the jobs, computed on threads (compiled runs release the GIL)."""
    with ThreadPoolExecutor(threads or available()) as pool:
        return list(pool.map(function, jobs))


# --- GainSensitivity: scores for changed settings -------------------------------------------------


FACTORS = (0.75, 0.9, 1.1, 1.25)
NAMES = ("Kp", "Ti", "Td", "alpha", "beta", "N", "filter_time", "observer_time")


@dataclass(frozen=True)
class GainSensitivity:
    """Scores for changes of one setting.

    Attributes
    ----------
    name : str
        `Kp`, `Ti`, `Td` (of the schedule as well), `alpha`, `beta`, `N`, ...
    value : float
        Value of the unchanged setting.
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
    """Vary every setting that is neither 0 nor infinite by each of `FACTORS`, on `threads`."""
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
    """The controller with one setting multiplied by a factor, gains in standard form."""
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


# --- WhatIf: the controller on changed plants -----------------------------------------------------


@dataclass(frozen=True)
class WhatIf:
    """The score after one change of the plants.

    Attributes
    ----------
    name : str
        Name of the change.
    score : Score
        Score of the same controller.
    """

    name: str
    score: Score

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {"change": self.name, **self.score.to_json()}


def what_if(
    controller: Controller,
    task: Task,
    changes: Sequence[Change] | None = None,
    *,
    threads: int | None = None,
) -> tuple[WhatIf, ...]:
    """Score the controller on changed plants. The changes are by default `ON_MODELS` and, for
    virtual machines, `ON_MACHINES`; one that applies to no plant is left out. The result is the
    same at any number of threads (by default all processors).
    """
    if changes is None:
        machines = [isinstance(p, VirtualMachine) for p in task.plants]
        changes = (
            *(ON_MODELS if not all(machines) else ()),
            *(ON_MACHINES if any(machines) else ()),
        )
    tasks = [(c.name, found) for c in changes if (found := _with_changes(task, c)) is not None]
    scores = each(lambda job: job[1].score(controller), tasks, threads)
    return tuple(WhatIf(name, s) for (name, _), s in zip(tasks, scores, strict=True))


def _with_changes(task: Task, change: Change) -> Task | None:
    """The task on the plants to which the change applies; None if there are none."""
    plants, names = [], []
    for plant, name in zip(task.plants, task.names, strict=True):
        try:
            plants.append(change.apply(plant))
        except SettingError:
            continue
        names.append(name)
    return task.on(plants, names) if plants else None
