"""What is tuned on what, as `tune`, `costs` and `pareto` hand it to the core."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from .constraints import Constraints
from .control.controller import Controller
from .control.defaults import beyond_record, default_references
from .control.loop import (
    Plants,
    References,
    check_fits,
    each_plant,
    each_reference,
    reference_samples,
)
from .cost import Cost
from .errors import SettingError
from .gains import real, vector, whole
from .load_step import LoadStep
from .starting import first_controller
from .threads import available
from .variables import Wanted, usual_variables, wanted

Progress: TypeAlias = Callable[[int, int, float], object]
Aggregate: TypeAlias = Literal["mean", "worst"]

GAINS = (0.8, 1.25)
"""Plant gains beside the identified one that a controller has to bear, so that it transfers."""


@dataclass(frozen=True)
class TuningTask:
    """Everything but the search itself."""

    plants: list[Any]
    references: list[Any]
    loads: list[LoadStep]
    disturbances: list[Any]
    start: Controller
    variations: list[tuple[float, int]]
    cost: Cost
    aggregate: str
    constraints: Constraints
    assumed: str

    @classmethod
    def of(
        cls,
        models: Plants,
        references: References,
        *,
        start: Controller | None,
        first: Mapping[str, Any],
        cost: Cost | None,
        aggregate: str,
        constraints: Constraints | None,
        variations: Sequence[tuple[float, int]] | None,
        loads: Sequence[LoadStep] = (),
        disturbances: Sequence[ArrayLike] | None = None,
    ) -> TuningTask:
        """Checked; without a start, `first` are the settings of the first controller."""
        given = list(models) if isinstance(models, Sequence) else [models]
        if not given:
            raise SettingError("expected at least one plant to tune on, got none")
        plants = each_plant(given)
        if not (start is None or isinstance(start, Controller)):
            raise SettingError(
                f"expected a Controller to start from, got {type(start).__name__}; read a file "
                "with load_controller"
            )
        derived = start is None
        if start is None:
            start = first_controller(given[0], **first)
        for plant in given:
            check_fits(start, plant)
        if references is None:
            references = default_references(given[0], start)
        return cls(
            plants=plants,
            references=[
                reference_samples(r, start, plant=given[0]) for r in each_reference(references, ())
            ],
            loads=_load_steps(loads),
            disturbances=[vector("disturbance", d) for d in disturbances or ()],
            start=start,
            variations=_checked(default_variations(start) if variations is None else variations),
            cost=_instance(cost, Cost, "Cost(chatter=5.0)"),
            aggregate=aggregate,
            constraints=_instance(constraints, Constraints, "Constraints(overshoot=2.0)"),
            assumed=_assumed(start, given, derived=derived),
        )

    def core(self, names: Sequence[Wanted] | None = None, *, ms: bool = False) -> _core._Task:
        """As the core takes it, with variables by name; `ms`: Ms is asked for anyway."""
        loops = self._loops() if ms or self.constraints.Ms is not None else []
        return {
            "plants": [plant.core for plant in self.plants],
            "references": self.references,
            "disturbances": self.disturbances,
            "load_steps": [step.samples(self.start.Ts) for step in self.loads],
            "start": self.start.core(),
            "counts_per_unit": self.start.counts_per_unit,
            "variations": self.variations,
            "variables": wanted(
                usual_variables(self.start) if names is None else names, self.start
            ),
            "cost": self.cost.named(),
            "aggregate": self.aggregate,
            "limits": self.constraints.limits,
            "linear_plants": loops,
        }

    def _loops(self) -> list[Any]:
        """The linear plants that Ms is taken on, as fractions."""
        from .control.margins import sampled

        given = self.constraints.plant
        if given is None:
            plants = [p for p in self.plants if hasattr(p, "to_tf")]
        else:
            plants = list(given) if isinstance(given, (list, tuple)) else [given]
        if not plants:
            raise SettingError(
                "expected a linear plant to take Ms on, got none among the plants; give "
                "Constraints(plant=...), for example a linear model of the same drive, or add one "
                "to the plants"
            )
        return [sampled(plant, self.start.Ts, self.constraints.speed) for plant in plants]


def _assumed(start: Controller, given: list[Any], *, derived: bool) -> str:
    """What of the limits has to be said in a controller's notes."""
    if derived:
        _, _, said = start.notes.partition("; ")
    else:
        said = beyond_record(given, start.u_min, start.u_max)
    return f"; {said}" if said else ""


def threads_or_all(threads: int | None) -> int:
    """The number of threads; by default all that are available."""
    return whole("threads", available() if threads is None else threads)


def default_variations(controller: Controller) -> tuple[tuple[float, int], ...]:
    """(gain, extra delay in samples) of the plants that a controller is tuned on; see `tune`."""
    delay = max(1, controller.filter_samples // 4)
    return ((1.0, 0), *((gain, delay) for gain in GAINS))


def _instance(given: Any, kind: type[Any], example: str) -> Any:
    if not (given is None or isinstance(given, kind)):
        raise SettingError(
            f"expected a {kind.__name__}, got {type(given).__name__}; for example {example}"
        )
    return kind() if given is None else given


def budget(seconds: Any) -> float:
    """A time in which a search has to end [s].

    Raises
    ------
    SettingError
        For what is no number above 0.
    """
    time = real("time_budget", seconds)
    if not 0.0 < time < math.inf:
        raise SettingError(f"expected a time_budget above 0 s, got {time:g}; None for none")
    return time


class TimeUp(KeyboardInterrupt):
    """Asks the core to stop and hand over its best."""


@dataclass
class Deadline:
    """Progress that ends a search after a time."""

    seconds: float | None
    inner: Progress | None

    def __post_init__(self) -> None:
        self._began = time.monotonic()
        self.passed = False

    def __call__(self, done: int, total: int, best: float) -> None:
        if self.inner is not None:
            self.inner(done, total, best)
        # before the first gains are known there is nothing to hand over
        if self.seconds is not None and math.isfinite(best) and done > 0:
            self.passed = time.monotonic() - self._began > self.seconds
            if self.passed:
                raise TimeUp


def _load_steps(given: Sequence[LoadStep]) -> list[LoadStep]:
    steps = [given] if isinstance(given, LoadStep) else list(given)
    return [_instance(step, LoadStep, "LoadStep(1500.0, -2.0)") for step in steps]


def _checked(variations: Sequence[tuple[float, int]]) -> list[tuple[float, int]]:
    pairs = isinstance(variations, Sequence) and all(np.shape(v) == (2,) for v in variations)
    if not (pairs and variations):
        raise SettingError(
            f"expected variations as pairs of a gain and a delay in samples, got {variations!r}"
        )
    return [(real("a variation's gain", g), whole("a variation's delay", d)) for g, d in variations]
