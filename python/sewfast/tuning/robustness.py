"""Ms in a search: the linear loops that it is taken on, and its limit if none was given."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..control.controller import Controller, SampledController
from ..control.margins import levels_over, margins, operating_point, sampled
from ..errors import FitError, SettingError
from ..evidence.operating import INTEGRATES
from ..models import Model
from .objective import LARGEST_MS

if TYPE_CHECKING:
    from .task import Budget, TuningTask

HAIR = 1.001
"""Share above which an Ms exceeds a limit: rounding in the search for its frequency."""


ROUNDING = 1e-6
"""Distance from 1 of the pole of an integrator."""


@dataclass(frozen=True, eq=False)
class LinearLoops:
    """The linear plants of a search: `looked_at`, with the output about which each is taken [y];
    `searched`, on which the core takes Ms of every candidate; `measured` responses, whose bands
    count. `depends` says whether Ms depends on the output, `reason` why a plant was left out;
    `opposed` are those left out because most others answer a command the other way.
    """

    looked_at: tuple[tuple[Any, float | None], ...] = ()
    searched: tuple[Any, ...] = ()
    measured: tuple[Any, ...] = ()
    depends: bool = False
    reason: Exception | None = None
    opposed: tuple[tuple[Any, float | None], ...] = ()

    def __add__(self, other: LinearLoops) -> LinearLoops:
        return LinearLoops(
            self.looked_at + other.looked_at,
            self.searched + other.searched,
            self.measured or other.measured,
            self.depends or other.depends,
            self.reason or other.reason,
        )

    def worst(self, controller: SampledController) -> tuple[float, float | None]:
        """The largest Ms of a PID, and the output about which it is; 0 without a plant."""
        if not (self.looked_at and isinstance(controller, Controller)):
            return 0.0, None
        found = [
            (margins(controller, plant, speed=level).Ms_robust, level)
            for plant, level in self.looked_at
        ]
        return max(found, key=lambda pair: pair[0])

    def agreed(self) -> LinearLoops:
        """Without the plants whose steady gain has the other sign than that of most about the same
        output: no controller with an integral holds both. Of many networks that follow one record,
        some may be lost at a level where it hardly is.
        """
        signs = [_sign(plant) for plant, _ in self.looked_at]
        total: dict[float | None, int] = {}
        for (_, level), sign in zip(self.looked_at, signs, strict=True):
            total[level] = total.get(level, 0) + sign
        opposed = tuple(
            one for one, sign in zip(self.looked_at, signs, strict=True) if sign * total[one[1]] < 0
        )
        left = {id(plant) for plant, _ in opposed}
        return replace(
            self, opposed=opposed,
            looked_at=tuple(one for one in self.looked_at if id(one[0]) not in left),
            searched=tuple(plant for plant in self.searched if id(plant) not in left),
        )  # fmt: skip

    def core(self, Ts: float) -> list[Any]:
        """The fractions in z^-1 for the core, or a `SettingError` if there is none."""
        if not self.searched:
            raise SettingError(
                name="Ms", expected="a model, or another linear plant, to take it on",
                received="none" if self.reason is None else f"none ({self.reason})",
                remedy="give Constraints(plant=...), for example a linear model of the same drive, "
                "or add one to the plants",
            ) from self.reason  # fmt: skip
        return [sampled(plant, Ts) for plant in self.searched]


def linear_loops(task: TuningTask, time: Budget) -> LinearLoops:
    """The linear plants of a task, from the plants of its constraints or else its models. A
    nonlinear model is linearised at three outputs over the references; with a gain schedule also
    at its points; with a speed in the constraints only there. Levels at which a model
    has no stable steady state are left out: the plant stands there, one network of many does not.
    """
    controller, given = task.start, task.constraints.plant
    if not isinstance(controller, Controller):
        return LinearLoops()
    if given is None:
        plants = [p for p in task.plants if isinstance(p, Model) and len(p.input_names) == 1]
    else:
        listed = list(given) if isinstance(given, (list, tuple)) else [given]
        plants = [m for plant in listed for m in (getattr(plant, "members", ()) or (plant,))]
    measured = tuple(plant for plant in plants if hasattr(plant, "lines"))
    if measured and len(measured) == len(plants):
        raise SettingError(
            name="plant", expected="a linear plant beside the measured response, which does not "
            "tell whether a loop is stable", received="none",
            remedy="give plant=[response, fit_shaft(response).to_model()]",
        )  # fmt: skip
    found = LinearLoops(measured=measured)
    # part of a time budget for linearising: a grey box takes .14 s for each level
    ends = time.share(0.1)
    for plant in plants:
        if not hasattr(plant, "lines"):
            found += _of(plant, task, controller, time, ends)
    return found.agreed()


def _sign(plant: Any) -> int:
    """The sign of a plant's steady gain; 0 where it has none, as near a pole at 1, or if it is
    unknown.
    """
    if not (hasattr(plant, "dc_gain") and hasattr(plant, "poles")):
        return 0
    if max(map(abs, plant.poles), default=0.0) >= 1.0 - INTEGRATES:
        return 0
    return int(np.sign(plant.dc_gain[0]))


def _of(
    plant: Any, task: TuningTask, controller: Controller, time: Budget, ends: float
) -> LinearLoops:
    """The loops of one plant."""
    scheduled, speed = [at for at, _ in controller.schedule], task.constraints.speed
    if not isinstance(plant, Model) or hasattr(plant, "to_tf"):
        about: Sequence[float | None] = scheduled or [None]
        return LinearLoops(
            tuple((plant, level) for level in about), (plant,), depends=bool(scheduled)
        )
    levels = [*_levels(task), *scheduled] if speed is None else [speed]
    points: list[tuple[Any, float | None]] = []
    reason: Exception | None = None
    may_lack = task.constraints.Ms is None
    for level in levels:
        if time.spent > ends and (points or may_lack):
            time.lose("all looks at the largest sensitivity Ms")
            break
        try:
            point = operating_point(plant, level)
            if max(abs(point.poles), default=0.0) > 1.0 + ROUNDING:
                continue
            margins(controller, point, speed=level)  # refuses a standstill, where nothing answers
            points.append((point, level))
        except (SettingError, FitError) as error:
            reason = error
    # the core takes every plant at every point of a schedule, also where the plant never is
    if scheduled and speed is None:
        reason = SettingError("of a gain schedule, give the speed as well: Constraints(speed=...)")
        searched: tuple[Any, ...] = ()
    else:
        searched = tuple(point for point, _ in points)
    return LinearLoops(tuple(points), searched, depends=True, reason=reason)


def _levels(task: TuningTask) -> list[float]:
    """As `analyse` has them, over the references: a loop that is calm in their middle may be close
    to instability at an end, where the gain of a pump or a valve is another.
    """
    low = min(float(r.min()) for r in task.references)
    high = max(float(r.max()) for r in task.references)
    return list(dict.fromkeys(levels_over(low, high, task.rest.y)))


def within_default(task: TuningTask) -> Iterator[TuningTask]:
    """The task with the default limit of Ms; then, if nothing is within, with wider ones.
    They are the start's own Ms, which the start keeps to, and none. A task with a limit of its own,
    or without a linear plant in its search, is yielded as it is.
    """
    loops = task.loops
    if task.constraints.Ms is not None or not loops.searched:
        yield task
        return
    yield with_limit(task, LARGEST_MS)
    own = HAIR * loops.worst(task.start)[0]
    if LARGEST_MS < own < math.inf:
        yield with_limit(task, own)
    yield with_limit(task, math.inf)


def with_limit(task: TuningTask, Ms: float) -> TuningTask:
    return replace(task, constraints=replace(task.constraints, Ms=Ms))
