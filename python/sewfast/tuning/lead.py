"""The feedforward of a tuned PID: made of its models, chosen by cost, kept if no model loses."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from .. import _core
from ..control.controller import Controller
from ..control.defaults import recorded_outputs
from ..control.feedforward import AHEAD, TAPS, Feedforward, reduced
from ..control.loop import titles
from ..control.margins import command_grid, point_within
from ..errors import FitError, SettingError
from ..models import Model
from ..models.rest import Rest
from ..threads import available
from .robustness import ROUNDING
from .task import Deadline

if TYPE_CHECKING:
    from ..evidence import OperatingPoint
    from .task import TuningTask

Lead: TypeAlias = Literal["preview", "causal", "none"]
"""With the reference known ahead, in time only, or without feedforward."""
LEADS = ("preview", "causal", "none")
WEIGHTS = ("alpha", "beta")
"""Settings whose work a feedforward does."""

SMOOTHINGS = (1e-3, 1e-2, 1e-1)
"""Multiples of the squared taps among which costs choose, from a sharp inverse to a calm one."""
FURTHER, FEW = (0, 2, 4, 6, 8, 12), (4, 8)
"""Samples of preview beyond the plant's delay among which costs choose; few until a deadline."""
LEADING, PART = 0.15, 0.6
"""Part of a time budget that the search leaves to the feedforward, and part of what is left
then that this may take."""
PARTS = (0.25, 0.5, 1.0)
"""The other levels, as shares of the way from rest to the ends of the range."""


Point: TypeAlias = "tuple[float, OperatingPoint, bool]"
"""A level, the steady state there, and whether its dynamics count: close to rest they are those of
dry friction."""


@dataclass(frozen=True)
class Effort:
    """How much may be tried: until a deadline few, on so many threads."""

    deadline: Deadline | None = None
    threads: int = field(default_factory=available)

    @property
    def is_whole(self) -> bool:
        """Whether there is time for all."""
        return self.deadline is None or self.deadline.budget.seconds is None

    def check(self) -> None:
        if self.deadline is not None:
            self.deadline(1, 1, 0.0)


@dataclass(frozen=True)
class Choices:
    """Feedforwards among which the costs choose; `reason` says why there are none."""

    feedforwards: tuple[Feedforward, ...] = ()
    reason: str = ""


def choices(task: TuningTask, lead: Lead, effort: Effort | None = None, every: int = 1) -> Choices:
    """The feedforwards that the models of a task allow, for a device `every` so many of whose
    samples are one of the task; raises `TimeUp` at a deadline.
    """
    effort = effort or Effort()
    models = [p for p in task.plants if isinstance(p, Model)]
    if not (isinstance(task.start, Controller) and models):
        return Choices(reason="only a PID that is tuned on models has feedforward")
    rest, ends = task.rest, _ends(models, task)
    moving = PARTS[0] * max(ends[1] - rest.y, rest.y - ends[0])
    points = [list(_points(model, rest.y, ends, moving, effort)) for model in models]
    local = [(level, point) for found in points for level, point, moves in found if moves]
    if not all(points) or not local:
        return Choices(reason="a model does not stand still within the references")
    if any(max(abs(p.poles), default=0.0) > 1.0 + ROUNDING for _, p in local):
        return Choices(reason="a model is unstable, and has no inverse that one may trust")
    known = _with_rest(_mirrored(_mean(points), rest, moving), rest)
    levels = reduced(known, always=rest.y)
    delay = min(p.delay for _, p in local)
    further, smoothings = (FURTHER, SMOOTHINGS) if effort.is_whole else (FEW, SMOOTHINGS[1:2])
    ahead = AHEAD // every
    previews = {min(delay + more, ahead) for more in further} if lead == "preview" else {0}
    pairs = [(preview, smoothing) for preview in sorted(previews) for smoothing in smoothings]
    plants = [_local(p, _slope(levels, level, rest.y)) for level, p in local]
    try:
        taps = _core.inverse_taps(plants, pairs, count=TAPS // every)
    except SettingError:
        return Choices(reason="a model answers a command within 256 samples with nothing finite")
    late = 0.5 if task.start.counts_per_unit > 0.0 else 0.0
    made = zip(pairs, taps, strict=True)
    return Choices(
        tuple(Feedforward(preview, late, tuple(levels), tuple(t)) for (preview, _), t in made)
    )


def _part(one: Feedforward, share: float, rest: Rest) -> Feedforward:
    """A share of it, about rest."""
    if share == 1.0:
        return one
    u = rest.u[0]
    levels = tuple((y, u + share * (held - u)) for y, held in one.levels)
    return replace(one, levels=levels, taps=tuple(share * tap for tap in one.taps))


def _ends(models: Sequence[Model], task: TuningTask) -> tuple[float, float]:
    """The range of references and records, the same for all models: their levels must agree."""
    ends = [float(f(r)) for r in task.references for f in (np.min, np.max)]
    ends += [task.rest.y, *(y for model in models for y in recorded_outputs(model) or ())]
    return min(ends), max(ends)


def _points(
    model: Model, rest: float, ends: tuple[float, float], moving: float, effort: Effort
) -> Iterator[Point]:
    """Steady states within the range; dynamics count from the distance `moving` on."""
    low, high = ends
    # distance from rest of the first levels to either side, as a share of the range: dry friction
    # has its full size there, as a jump cannot be drawn
    beside, grid = 2e-3 * (high - low), command_grid(model)
    for end in (low, high):
        way = end - rest
        if abs(way) <= beside:
            continue
        for off in (math.copysign(beside, way), *(part * way for part in PARTS)):
            effort.check()
            # a level that the model does not reach, or at which it jumps, is left out
            with contextlib.suppress(SettingError, FitError):
                point = point_within(model, grid, rest + off)
                yield rest + off, point, abs(off) >= 0.999 * moving


def _mean(points: Sequence[Sequence[Point]]) -> list[tuple[float, float]]:
    """Levels with the mean of the commands that hold them on all models; none if they integrate."""
    known: dict[float, list[float]] = {}
    for found in points:
        for level, point, _ in found:
            if point.drift == 0.0 and np.isfinite(point.dc_gain[0]):
                known.setdefault(level, []).append(float(point.u[0]))
    everywhere = {y: u for y, u in known.items() if len(u) == len(points)}
    return [(y, float(np.mean(u))) for y, u in sorted(everywhere.items())]


def _mirrored(
    levels: list[tuple[float, float]], rest: Rest, moving: float
) -> list[tuple[float, float]]:
    """The levels, with the other side's mirrored about rest where a side knows nothing but the
    neighbourhood of rest: the line through dry friction must not be drawn on.
    """
    for side in (-1.0, 1.0):
        own = [level for level in levels if side * (level[0] - rest.y) > 0.0]
        others = [level for level in levels if side * (level[0] - rest.y) < 0.0]
        if others and all(abs(y - rest.y) < 0.999 * moving for y, _ in own):
            made = [(2.0 * rest.y - y, 2.0 * rest.u[0] - u) for y, u in others]
            return sorted([*others, *made])
    return levels


def _with_rest(levels: list[tuple[float, float]], rest: Rest) -> list[tuple[float, float]]:
    """The levels with that at rest, where a motor must not be pushed against its friction."""
    kept = [level for level in levels if level[0] != rest.y]
    return sorted([*kept, (rest.y, rest.u[0])]) if kept else []


def _slope(levels: Sequence[tuple[float, float]], y: float, rest: float) -> float:
    """The slope of the line through the levels at an output, towards rest; 0 without a line."""
    if len(levels) < 2:
        return 0.0
    outputs, commands = np.array(levels).T
    before = np.searchsorted(outputs, y, "left" if y > rest else "right") - 1
    i = int(np.clip(before, 0, len(levels) - 2))
    return float((commands[i + 1] - commands[i]) / (outputs[i + 1] - outputs[i]))


def _local(point: OperatingPoint, slope: float) -> tuple[Any, ...]:
    A, B, C = (np.ascontiguousarray(m) for m in (point.A, point.B[:, 0], point.C[0]))
    return A, B, C, float(point.D[0, 0]), point.delay, slope


@dataclass(frozen=True)
class Led:
    """What a feedforward is worth: the PID `alone`, and costs [y] with and without it over all
    plants in all variations, where overshoot (percents of small edges) has no weight unless one was
    given. `reason` says why it was not taken.
    """

    alone: Controller
    cost: float = math.nan
    alone_cost: float = math.nan
    reason: str = ""

    def to_json(self) -> dict[str, Any]:
        costs = {"cost": self.cost, "cost_without": self.alone_cost}
        known = {name: c if math.isfinite(c) else None for name, c in costs.items()}
        return {"taken": not self.reason, **known, "reason": self.reason}

    def __str__(self) -> str:
        if self.reason:
            return f"none: {self.reason}"
        unit = self.alone.y_unit or "y"
        return f"following costs {self.cost:.3g} {unit} with it and {self.alone_cost:.3g} without"


_VIOLATED = "a constraint is violated with one"
_LOADED = (
    "a limit of recovery or load is exceeded with one by more than without; allow more, or leave "
    "the limit out"
)


def with_lead(
    task: TuningTask,
    alone: Controller,
    lead: Lead,
    searched: Collection[str] = WEIGHTS,
    others: Sequence[TuningTask] = (),
    effort: Effort | None = None,
    every: int = 1,
) -> tuple[Controller, Led]:
    """A PID with feedforward, if that costs less over all plants of this task and of the others,
    and no more on any of them in any variation; otherwise the PID alone. It has room on a device
    `every` so many of whose samples are one of the task. The feedforward does the
    work of alpha and beta, which become 0 if they are `searched`. The gains stay: what they owe to
    loads, noise and other plants, margins included, they keep. Raises `TimeUp` at a deadline.
    """
    # shares of the best feedforward, of which the first that no plant loses by is taken: a drive
    # whose gain is a quarter too large needs less of it
    shares = (1.0, 0.95, 0.9, 0.8)
    effort = effort or Effort()
    among = choices(task, lead, effort, every)
    weights: dict[str, Any] = {name: 0.0 for name in WEIGHTS if name in searched}
    tried = [replace(alone, feedforward=one, **weights) for one in among.feedforwards]
    if not tried:
        return alone, Led(alone, reason=among.reason)
    loaded = replace(task, constraints=replace(task.constraints, Ms=math.inf))
    limits_loads = (task.constraints.recovery, task.constraints.load) != (None, None)
    task, others = _following(task), [_following(other) for other in others]
    *judged, (alone_cost, _) = _judged(task, [*tried, alone], effort)
    best = min(range(len(tried)), key=lambda k: judged[k][::-1])
    led = Led(alone, judged[best][0], alone_cost)
    objection = ""
    for share in shares if effort.is_whole else shares[:1]:
        part = _part(among.feedforwards[best], share, task.rest)
        controller = replace(tried[best], feedforward=part)
        said = (_objection(one, controller, alone, effort) for one in (task, *others))
        objection = next(filter(None, said), "")
        # with it counts fall differently when the load comes, and so do the samples of recovery
        if limits_loads and not objection:
            (_, violation), (_, own) = _judged(loaded, [controller, alone], effort)
            objection = _LOADED if violation > own else ""
        if not objection:
            return controller, replace(led, cost=_judged(task, [controller], effort)[0][0])
    kept = [name for name in WEIGHTS if name not in weights and getattr(alone, name) != 0.0]
    if kept:
        objection += f"; {' and '.join(kept)} do the same work: search them, or start with 0"
    return alone, replace(led, reason=objection)


def _following(task: TuningTask) -> TuningTask:
    """The task without load steps and Ms, or a weight of overshoot that was not given."""
    weight = 0.0 if task.cost.overshoot is None else task.cost.overshoot
    limits = replace(task.constraints, Ms=math.inf, recovery=None, load=None)
    cost = replace(task.cost, overshoot=weight, recovery=0.0, load=0.0)
    return replace(task, cost=cost, constraints=limits, loads=[])


def _objection(task: TuningTask, controller: Controller, alone: Controller, effort: Effort) -> str:
    """Why a controller is not better over all plants and no worse on any; empty if it is."""
    (cost, violation), (other, own) = _judged(task, [controller, alone], effort)
    unit = alone.y_unit or "y"
    if not cost < other:
        return f"following costs {cost:.3g} {unit} with one and {other:.3g} without"
    if violation > own:
        return _VIOLATED
    every = zip(task.plants, titles(task.plants), strict=True)
    for (plant, title), (gain, delay) in itertools.product(every, task.variations):
        one = replace(task, plants=[plant], variations=[(gain, delay)])
        (cost, _), (other, _) = _judged(one, [controller, alone], effort)
        if not cost <= other:
            changed = f" with {gain:g} times the gain and {delay} samples more delay"
            return (
                f"on {title}{changed if (gain, delay) != (1.0, 0) else ''} following costs "
                f"{cost:.3g} {unit} with one and {other:.3g} without"
            )
    return ""


def _judged(
    task: TuningTask, controllers: Sequence[Controller], effort: Effort
) -> list[tuple[float, float]]:
    """Cost and violation of the constraints of each controller; raises `TimeUp` at a deadline."""
    cores = [task.about(controller).core() for controller in controllers]
    judged = _core.tuning_costs(
        task.core(), cores, threads=effort.threads, progress=effort.deadline
    )
    effort.check()
    return [(cost, violation) for cost, violation, *_ in judged]
