"""A tuning task: plants, references and limits; the variables; the first controller."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import deviations, limits_about, on_grid
from ..control.controller import GAIN_NAMES, NOTCH_NAMES, Controller, SampledController
from ..control.defaults import (
    beyond_record,
    command_limits,
    default_references,
    default_step,
    drive_step,
    filter_length,
    growth_rate,
    rate_step,
    require_one_input,
)
from ..control.files import KINDS
from ..control.loop import (
    Plant,
    Plants,
    References,
    check_fits,
    common_rest,
    cores_about,
    each_plant,
    each_reference,
    noise_in_loop,
    plant_units,
    reference_samples,
)
from ..control.margins import loop_response, margins
from ..dataset import FloatArray
from ..errors import FitError, SettingError
from ..gains import Gains, real, vector, whole
from ..models import Model
from ..models.rest import Rest
from ..progress import TimeUp, latest
from ..rules import Fopdt, Rule, table_1
from ..threads import available
from ..units import duration, revolutions_per_second, spelled
from .objective import Constraints, Cost, LoadStep
from .robustness import LinearLoops, linear_loops

Progress: TypeAlias = Callable[[int, int, float], object]
Aggregate: TypeAlias = Literal["mean", "worst"]

GAINS = (0.8, 1.25)
"""Factors on the identified gain that a controller must also suit, so that it transfers."""


@dataclass(frozen=True)
class TuningTask:
    """Everything that a search works on; `step` is for its verdict, with references by default."""

    plants: list[Any]
    references: list[Any]
    loads: list[LoadStep]
    disturbances: list[Any]
    start: SampledController
    variations: list[tuple[float, int]]
    cost: Cost
    aggregate: str
    constraints: Constraints
    assumed: str
    step: FloatArray | None = None
    loops: LinearLoops = field(default_factory=LinearLoops)

    @classmethod
    def of(
        cls,
        models: Plants,
        references: References,
        *,
        start: SampledController | None,
        first: Mapping[str, Any],
        cost: Cost | None,
        aggregate: str,
        constraints: Constraints | None,
        variations: Sequence[tuple[float, int]] | None,
        loads: Sequence[LoadStep] = (),
        disturbances: Sequence[ArrayLike] | None = None,
    ) -> TuningTask:
        """The checked task; without a start, `first` holds settings of the first controller."""
        given = list(models) if isinstance(models, Sequence) else [models]
        if not given:
            raise SettingError("expected at least one plant to tune on, got none")
        plants = each_plant(given)
        if not (start is None or isinstance(start, SampledController)):
            raise SettingError(
                f"expected a Controller to start from, got {type(start).__name__}; read a file "
                "with load_controller"
            )
        derived = start is None
        if start is None:
            start = first_of(given[0], **first)
        for plant in given:
            check_fits(start, plant)
        step = None
        if references is None:
            step = default_step(given[0], start)
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
            step=step,
        )

    @property
    def rest(self) -> Rest:
        """The level at which the loops begin."""
        return common_rest(self.plants)

    def with_loops(self, time: Budget) -> TuningTask:
        """The task with the linear loops on which Ms is limited and looked at."""
        return replace(self, loops=linear_loops(self, time))

    def about(self, controller: SampledController) -> SampledController:
        """A controller for deviations from rest, its limits on a grid as all deviations are."""
        low, high = limits_about(controller.u_min, controller.u_max, self.rest.u[0])
        changes: dict[str, Any] = {"u_min": low, "u_max": high}
        # the base class alone is no dataclass
        return replace(controller.about(self.rest), **changes)  # type: ignore[type-var]

    def _noise(self, plant: Plant, span: float) -> float:
        """The noise in single precision, without what a level alone has rounded."""
        return float(np.float32(on_grid(noise_in_loop(self.start, plant), span, bits=40)))

    def core(self, names: Sequence[Wanted] | None = None, *, ms: bool = False) -> _core._Task:
        """The task for the core, with variables by name; `ms` if Ms is an objective."""
        asked = ms or self.constraints.limits_Ms
        if asked and not isinstance(self.start, Controller):
            raise SettingError(
                name="Ms", expected="a PID to take it of", received=type(self.start).__name__,
                remedy="leave it out: plants with other gains and delays (variations) are among "
                "those that the controller has to serve",
            )  # fmt: skip
        rest = self.rest
        references = [deviations(r, rest.y) for r in self.references]
        span = max((float(np.ptp(r)) for r in references if len(r)), default=0.0)
        return {
            "plants": cores_about(rest, self.plants),
            "references": references,
            "disturbances": self.disturbances,
            "noise": [self._noise(p, span) for p in self.plants],
            "load_steps": [step.samples(self.start.Ts, rest.y) for step in self.loads],
            "start": self.about(self.start).core(),
            "counts_per_unit": self.start.counts_per_unit,
            "variations": self.variations,
            "variables": wanted(
                usual_variables(self.start) if names is None else names, self.start
            ),
            "cost": self.cost.named(),
            "aggregate": self.aggregate,
            "limits": self.constraints.limits,
            "linear_plants": self.loops.core(self.start.Ts) if asked else [],
            "measured": [r.lines(self.start) for r in self.loops.measured] if asked else [],
        }


def _assumed(start: SampledController, given: list[Any], *, derived: bool) -> str:
    """A note on the limits for the controller's notes."""
    if derived:
        _, _, note = start.notes.partition("; ")
    else:
        note = beyond_record(given, start.u_min, start.u_max)
    return f"; {note}" if note else ""


def threads_or_all(threads: int | None) -> int:
    """The number of threads; by default all that are available."""
    return whole("threads", available() if threads is None else threads)


def default_variations(controller: SampledController) -> tuple[tuple[float, int], ...]:
    """(gain, extra delay in samples) of the default variations of a plant; see `tune`."""
    delay = max(1, getattr(controller, "filter_samples", 1) // 4)
    return ((1.0, 0), *((gain, delay) for gain in GAINS))


def _instance(given: Any, kind: type[Any], example: str) -> Any:
    if not (given is None or isinstance(given, kind)):
        raise SettingError(
            f"expected a {kind.__name__}, got {type(given).__name__}; for example {example}"
        )
    return kind() if given is None else given


def cut_short(lost: Sequence[str], grade: str) -> str | None:
    """What a time budget cut short, in words; None if nothing."""
    if not lost:
        return None
    graded = f"; the model is graded {grade}" if grade else ""
    return f"the time budget left no time for {', '.join(lost)}{graded}"


def budget(seconds: Any) -> float:
    """The time budget of a search [s], checked to be above 0."""
    time = real("time_budget", seconds)
    if not 0.0 < time < math.inf:
        raise SettingError(f"expected a time_budget above 0 s, got {time:g}; None for none")
    return time


LOOK = 0.1
"""Part of a time budget for the looks at a tuned controller, as of `identify` for evidence."""


class Budget:
    """The time of a search, from now on, with everything that belongs to it.
    Without `seconds` it never ends; `lost` names the work that it cut short, in words.
    """

    def __init__(self, seconds: float | None) -> None:
        self.seconds = seconds
        self.lost: list[str] = []
        self._began = time.monotonic()

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self._began

    def share(self, part: float) -> float:
        """When this part of what is left will be over, as seconds since the beginning."""
        if self.seconds is None:
            return math.inf
        spent = self.spent
        return spent + part * max(0.0, self.seconds - spent)

    def over(self, what: str) -> bool:
        """Whether the time is up; if so, `what` is lost."""
        is_over = self.seconds is not None and self.spent > self.seconds
        if is_over:
            self.lose(what)
        return is_over

    def lose(self, what: str) -> None:
        """Note that the time was too short for this work."""
        if what not in self.lost:
            self.lost.append(what)

    def refusal(self, tried: int) -> FitError:
        """The error if no loop is bounded with any controller tried until the time is up."""
        return FitError(
            name="time_budget",
            expected="time for a controller with which no loop diverges",
            received=f"{self.seconds:g} s, enough for {tried} controllers, of which none is one",
            remedy="give more time, begin with smaller gains, or check the model on new data first",
        )  # fmt: skip


@dataclass
class Deadline:
    """A progress callback that ends a search at a time, whatever its costs are.
    The start is tried in any case, unless the whole call would be late (`latest`).
    """

    budget: Budget
    ends: float
    inner: Progress | None
    passed: bool = False
    tried: int = 0

    def __call__(self, done: int, total: int, best: float) -> None:
        if self.inner is not None:
            self.inner(done, total, best)
        self.tried = done
        seconds = self.budget.seconds
        if seconds is None:
            return
        self.passed = self.budget.spent > (self.ends if done > 0 else latest(seconds))
        if self.passed:
            raise TimeUp


def shifted(progress: Progress | None, before: int, total: int | None = None) -> Progress | None:
    """The progress of work that follows `before` others, of `total` together."""
    if progress is None:
        return None
    return lambda done, own, best: progress(before + done, total or before + own, best)


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


# --- Variables of a search ------------------------------------------------------------------------


Wanted: TypeAlias = str | tuple[str, float, float]


@dataclass(frozen=True)
class Variable:
    """A setting of the controller that was searched, with its bounds and the value found.
    Its name is ``Kp``, ``Ti``, ``Td``, a setting of `Controller`, ``Kp[0]``.. of a schedule's
    point, or ``notch_frequency[0]``, ``notch_depth[0]``, ``notch_width[0]``.. of a biquad.
    """

    name: str
    low: float
    high: float
    value: float

    @property
    def at_bound(self) -> bool:
        """Whether it is at a bound: the best value may be beyond."""
        edge = 1e-3
        room = edge * (self.high - self.low)
        near_low = self.value <= self.low + min(room, edge * abs(self.low) or room)
        return near_low or self.value >= self.high - room

    def __str__(self) -> str:
        where = ", at a bound" if self.at_bound else ""
        return f"{self.name} {self.value:.6g} ({self.low:.4g} to {self.high:.4g}{where})"


def wanted(
    variables: Sequence[Wanted] | None, start: SampledController
) -> list[tuple[str, tuple[float, float] | None]]:
    """Names and bounds for the core; ``schedule`` stands for the gains of all points, ``notches``
    for all numbers of the start's notches. Raises `SettingError` without any variable.
    """
    if variables is None:
        return []
    if isinstance(variables, str) or not variables:
        raise SettingError(
            f"expected a list of variables, got {variables!r}; for example variables=['Kp', "
            "('Ti', 0.02, 0.5)]"
        )
    return [one for given in variables for one in _one(given, start)]


def usual_variables(start: SampledController) -> list[Wanted] | None:
    """Default variables for a start outside the core's default bounds; None for any other.
    The core's bounds keep Ti at 4 sample times or more. The start for a drive with a time constant
    of a few sample times is below that.
    """
    if not isinstance(start, Controller):
        return None
    Ti = start.gains.to("standard").Ti
    if start.schedule or not 0.0 < Ti < 8.0 * start.Ts:
        return None
    names: list[Wanted] = ["Kp", ("Ti", 0.1 * Ti, 1e3 * Ti), "Td", "alpha", "beta"]
    names += ["N"] if np.isfinite(start.N) else []
    return [*names, "notches"] if any(b.kind == "notch" for b in start.biquads) else names


def _one(given: Any, start: SampledController) -> list[tuple[str, tuple[float, float] | None]]:
    if given == "schedule":
        points = len(getattr(start, "schedule", ()))
        if not points:
            raise SettingError(
                "expected a start with a gain schedule for the variable 'schedule', got one with "
                "constant gains; search 'Kp', 'Ti', 'Td'"
            )
        return [(f"{gain}[{k}]", None) for k in range(points) for gain in GAIN_NAMES]
    if given == "notches":
        found = [
            k for k, biquad in enumerate(getattr(start, "biquads", ())) if biquad.kind == "notch"
        ]
        if not found:
            raise SettingError(
                "expected a start with a notch for the variable 'notches', got none; give "
                "start=dataclasses.replace(start, biquads=[Biquad.notch(60.0)])"
            )
        return [(f"{name}[{k}]", None) for k in found for name in NOTCH_NAMES]
    if isinstance(given, str):
        return [(given, None)]
    if not (isinstance(given, tuple) and len(given) == 3 and isinstance(given[0], str)):
        raise SettingError(
            f"expected a variable as a name or (name, low, high), got {given!r}; for example "
            "('Ti', 0.02, 0.5)"
        )
    name, *bounds = given
    low, high = (real(f"the bounds of {name}", bound) for bound in bounds)
    if name == "filter_samples" and low < high and np.ceil(low) > np.floor(high):
        raise SettingError(
            f"expected bounds of filter_samples with a whole number between them, got {low:g} and "
            f"{high:g}"
        )
    return [(name, (low, high))]


# --- The controller to start from -----------------------------------------------------------------


Encoder: TypeAlias = float | Literal["model"] | None


def first_controller(
    plant: Plant,
    *,
    u_min: float | None = None,
    u_max: float | None = None,
    counts_per_rev: Encoder = "model",
    filter_samples: int | None = None,
    output_unit: str | None = None,
) -> Controller:
    """A conservative controller from a model's own step response by Table 1 (nearest row), with the
    parameters of `tune`. If the output integrates the command, such as a position, SIMC on the
    rate's step response is used instead; for an unstable linear model, the gains of the least Ms.
    The moving average's delay counts as dead time. Raises `SettingError` for a machine, for limits
    that are neither given nor recorded, and for an encoder on an output of unknown unit; `FitError`
    if no step of the model settles, or no gains hold it.
    """
    plant = _require_model(plant)
    low, high, note = command_limits([plant], u_min, u_max)
    u_unit, y_unit = _units(plant, output_unit)
    if (growth := growth_rate(plant)) > 0.0:
        blank = Controller(
            gains=Gains.standard(1.0, math.inf, u_unit=u_unit, y_unit=y_unit), Ts=plant.Ts,
            N=10.0, u_min=low, u_max=high,
            filter_samples=max(1, whole("filter_samples", filter_samples or 1)),
            counts_per_rev=_encoder(plant, counts_per_rev, y_unit),
            notes="; ".join(n for n in ("least Ms of an unstable plant", note) if n),
        )  # fmt: skip
        return _holding(plant, blank, growth)
    moving = rate_step(plant, low, high)
    step = drive_step(plant, low, high) if moving is None else moving
    if filter_samples is None:
        filter_samples = filter_length(plant.Ts, step.slowest)
    average = (max(1, whole("filter_samples", filter_samples)) - 1) / 2 * plant.Ts
    late = replace(step.fopdt, L=step.fopdt.L + average)
    rule = table_1(late, outside="nearest") if moving is None else _of_position(late, plant.Ts)
    said = "Table 1" if moving is None else rule.name
    gains = Gains.standard(
        rule.gains.Kp, rule.gains.Ti, rule.gains.Td, u_unit=u_unit, y_unit=y_unit
    )
    return Controller(
        gains=gains,
        Ts=plant.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=10.0,
        u_min=low,
        u_max=high,
        filter_samples=filter_samples,
        counts_per_rev=_encoder(plant, counts_per_rev, y_unit),
        notes="; ".join(n for n in (f"{said} on the model's step response", note) if n),
    )


CROSSOVERS = (1.5, 2.0, 3.0, 4.5, 7.0, 10.0, 15.0, 25.0)
"""Crossovers that are tried for an unstable plant, in rates at which it grows; a limit of Ms asks
for about twice that rate, and a delay for no more than it leaves (Astrom and Murray, *Feedback
Systems*, section 14.2)."""
LEADS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Td that are tried, in reciprocals of the crossover."""


def _holding(plant: Model, blank: Controller, growth: float) -> Controller:
    """The gains of the least Ms for a plant that grows at this rate [1/s] without its controller.
    Raises `FitError` if none of those tried holds it.
    """
    own = blank.gains
    found: list[tuple[float, Controller]] = []
    for share in CROSSOVERS:
        w = share * growth
        for lead in LEADS if w * plant.Ts < 3.0 else ():
            gains = Gains.standard(1.0, 10.0 / w, lead / w, u_unit=own.u_unit, y_unit=own.y_unit)
            unit = float(abs(loop_response(replace(blank, gains=gains), plant, [w])[0]))
            for Kp in (1.0 / unit, -1.0 / unit) if unit > 0.0 else ():
                one = replace(blank, gains=replace(gains, Kp=Kp))
                found.append((margins(one, plant).Ms, one))
    Ms, best = min(found, key=lambda pair: pair[0], default=(math.inf, blank))
    if not math.isfinite(Ms):
        raise FitError(
            name="model", expected="a plant that a PID can hold",
            received=f"one that doubles every {duration(math.log(2.0) / growth)}, which none of "
            f"{len(found)} PIDs holds",
            remedy="give the controller that holds it to start from",
        )  # fmt: skip
    return best


def _of_position(rate: Fopdt, Ts: float) -> Rule:
    """SIMC for `K e^(-sL) / (s (1 + sT))` (Skogestad 2003, Table 1), in standard form.
    The derivative cancels T. The loop must not be faster than the cancelled lag and the dead time,
    which includes the hold of a sample.
    """
    tau = 2.0 * max(rate.L + Ts, 0.5 * rate.T) + rate.L
    Kc, Ti, Td = 1.0 / (rate.K * tau), 4.0 * tau, rate.T
    gains = Gains.standard(Kc * (1.0 + Td / Ti), Ti + Td, Ti * Td / (Ti + Td))
    # leave half of a step to the integral alone, as two integrators overshoot
    return Rule(gains, 0.5, 1.0, "SIMC for an integrator")


def first_of(
    plant: Plant,
    controller: str = Controller.KIND,
    *,
    u_min: float | None = None,
    u_max: float | None = None,
    counts_per_rev: Encoder = "model",
    filter_samples: int | None = None,
    output_unit: str | None = None,
) -> SampledController:
    """The first controller of a kind, with the parameters of `tune`."""
    if controller == Controller.KIND:
        return first_controller(
            plant, u_min=u_min, u_max=u_max, counts_per_rev=counts_per_rev,
            filter_samples=filter_samples, output_unit=output_unit,
        )  # fmt: skip
    if controller not in KINDS:
        raise SettingError(
            name="controller", expected=" or ".join(KINDS), received=f"{controller!r}",
            remedy="pid suits most drives",
        )  # fmt: skip
    plant = _require_model(plant)
    low, high, note = command_limits([plant], u_min, u_max)
    u_unit, y_unit = _units(plant, output_unit)
    recorded = plant.training.get("output_range")
    return KINDS[controller].first(
        plant,
        u_min=low,
        u_max=high,
        counts_per_rev=_encoder(plant, counts_per_rev, y_unit),
        u_unit=u_unit,
        y_unit=y_unit,
        filter_samples=filter_samples,
        middle=None if recorded is None else float(np.mean(recorded)),
        notes="; ".join(n for n in ("begun with the model's own gain", note) if n),
    )


def _require_model(plant: Plant) -> Model:
    if not isinstance(plant, Model):
        raise SettingError(
            "expected a model to find a start from, got a machine; give start=, or tune on a model"
        )
    require_one_input(plant)
    return plant


def _units(plant: Model, stated: str | None) -> tuple[str, str]:
    """Units of command and output; empty if unknown."""
    u_unit, y_unit = plant_units(plant)
    if stated is not None and not isinstance(stated, str):
        raise SettingError(f"expected a unit as text for output_unit, got {stated!r}")
    if stated and y_unit and spelled(stated) != spelled(y_unit):
        raise SettingError(
            f"expected the output in the model's unit {y_unit!r}, got output_unit = {stated!r}; "
            "leave it out, or identify the model from converted data"
        )
    return u_unit, y_unit or stated or ""


def _encoder(plant: Model, stated: Encoder, unit: str) -> float | None:
    """Counts of one turn: as given, else those of the model's output."""
    counts = stated
    if isinstance(stated, str):
        if stated != "model":
            raise SettingError(
                f"expected counts_per_rev as a number, None for ideal feedback, or 'model', got "
                f"{stated!r}"
            )
        counts = plant.counts[1] if plant.counts else None
        if revolutions_per_second(unit) is None:
            return None
    if counts is not None and not unit:
        raise SettingError(
            f"expected the unit of the output {plant.output_name!r} for an encoder, as the model "
            "states none; give it, output_unit='RPM' (--unit RPM), or name the column "
            f"'{plant.output_name} [RPM]' in the recording"
        )
    return counts  # type: ignore[return-value]
