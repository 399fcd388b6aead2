"""`Score`: what a controller costs on plants over references, and how near to instability it is."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from ..control import Controller
from ..cost import Cost, terms
from ..errors import FitError, SettingError
from ..loop import Plant, run
from ..robustness import margins
from ..threads import available
from .points import PlantPoint, plant_points

J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True)
class Score:
    """A controller on a set of plants.

    Attributes
    ----------
    cost : float
        Mean over plants and references [y]; infinite where a loop runs away.
    tracking : float
        The worst rms of r - y [y].
    overshoot_percent : float
        The worst.
    chatter : float
        The worst rms of the command's change from sample to sample [u].
    Ms : float
        The worst; infinite where a linear loop is unstable, NaN where there is none.
    """

    cost: float
    tracking: float
    overshoot_percent: float
    chatter: float
    Ms: float

    def to_json(self) -> dict[str, float | None]:
        """As JSON values; what is not finite becomes None."""
        return {k: v if math.isfinite(v) else None for k, v in vars(self).items()}


@dataclass(frozen=True, eq=False)
class Task:
    """What a controller is scored on.

    Attributes
    ----------
    plants : tuple of Model or VirtualMachine
    names : tuple of str
    points : tuple of PlantPoint
        The plants about the operating point at which Ms is taken.
    references : tuple of str or array
    cost : Cost
    seed : int
    """

    plants: tuple[Plant, ...]
    names: tuple[str, ...]
    points: tuple[PlantPoint, ...]
    references: tuple[Any, ...]
    cost: Cost
    seed: int

    def on(self, plants: Sequence[Plant], names: Sequence[str]) -> Task:
        """The same on other plants, linearised at the same output."""
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
    """In the order of the jobs, on threads: the compiled runs release the interpreter."""
    with ThreadPoolExecutor(threads or available()) as pool:
        return list(pool.map(function, jobs))
