"""Fine tuning by simulated closed loops: `tune`."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .control import Controller, Fopdt, Gains, fit_fopdt, table_1
from .cost import Cost
from .errors import DataError, FitError, Interrupted, SettingError
from .gains import real, whole
from .loop import Plant, check_fits, plant_units, reference_samples
from .models import Ensemble, Model
from .units import REVOLUTIONS_PER_SECOND

Progress: TypeAlias = Callable[[int, int, float], object]

REFERENCES = ("trapezoid", "trapezoids", "random")
"""References to tune on unless others are given."""
GAINS = (0.8, 1.25)
"""Plant gains beside the identified one that a controller has to bear, so that it transfers."""
DERIVATIVE_FILTER = 10.0
"""N to begin with."""
_STEP_SHARES = (0.25, 0.5, 0.1)
"""Shares of u_max that the first step response is looked for at."""
_STEP_SAMPLES = (4_000, 16_000)


@dataclass(frozen=True, eq=False)
class TuningResult:
    """The tuned controller and the story of its search.

    Attributes
    ----------
    controller : Controller
        Ready to run.
    start : Controller
        What the search began with.
    cost, start_cost : float
        Cost of both in the output's unit, mean over plants and references; inf where one diverges.
    evaluations : int
        Controllers tried.
    trace : array
        The best cost so far, the start's first, then after each generation.
    termination : str
        ``evaluations``, ``converged`` or ``interrupted``.
    weights : Cost
        What counted how much, every weight a number.
    aggregate : str
        ``mean`` or ``worst``, over the plants.
    """

    controller: Controller
    start: Controller
    cost: float
    start_cost: float
    evaluations: int
    trace: NDArray[np.float64]
    termination: str
    weights: Cost
    aggregate: str

    def __str__(self) -> str:
        unit = self.controller.gains.y_unit
        return (
            f"cost {self.cost:.4g} {unit} (start {self.start_cost:.4g}) after {self.evaluations} "
            f"evaluations, {self.termination}\n{self.controller}"
        )


def tune(
    models: Plant | Sequence[Plant],
    references: str | ArrayLike | Sequence[str | ArrayLike] | None = None,
    *,
    u_min: float = -20.0,
    u_max: float = 20.0,
    counts_per_rev: float | None = 1572.0,
    filter_samples: int = 8,
    start: Controller | None = None,
    cost: Cost | None = None,
    aggregate: Literal["mean", "worst"] = "mean",
    variations: Sequence[tuple[float, int]] | None = None,
    evaluations: int = 600,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> TuningResult:
    """Search Kp, Ti, Td, alpha, beta (and N where finite) for the least cost of simulated loops.

    Every candidate runs on every plant in every variation over every reference, with encoder,
    feedback filter and limits in the loop. A run's cost is a weighted sum of terms (`Cost`). The
    search is differential evolution; a seed gives the same bits at any number of threads.

    Parameters
    ----------
    models : model, machine or sequence of them
        Plants that one controller has to serve, with one input, one sample time, the same units;
        every member of an ensemble is one.
    references : str, array of shape (N,), or sequence of them, optional
        Names (`sewfast.signals`) or samples [y]; `REFERENCES` by default.
    u_min, u_max : float
        Limits of the command [u].
    counts_per_rev : float or None
        Encoder in the loop of the models; None for ideal feedback.
    filter_samples : int
        Moving average in the feedback.
    start : Controller, optional
        What to begin with; its limits, filters, encoder and sample time are kept, and the four
        settings above are not used. By default Table 1 on the first model's own step response.
    cost : Cost, optional
        What counts how much.
    aggregate : "mean" or "worst"
        Over the plants in their variations; over the references it is the mean.
    variations : sequence of (gain, delay), optional
        Output gain and extra input delay in samples, applied to every plant. By default the plant
        as it is, and with the gains `GAINS` and a delay of a quarter of the moving average, at
        least one sample: dynamics that identification missed must not upset the loop.
    evaluations : int
        Candidates tried.
    seed : int
        Seed of the search.
    threads : int, optional
        All processors by default.
    progress : callable, optional
        Called with (done, total, lowest cost).

    Raises
    ------
    SettingError, DataError
        For plants, references or settings that cannot be used.
    FitError
        Where every candidate diverges.
    Interrupted
        After Ctrl-C; its `best` is the best controller so far.
    """
    plants = list(models) if isinstance(models, Sequence) else [models]
    if not plants:
        raise SettingError("expected at least one plant to tune on, got none")
    if start is None:
        start = first_controller(
            plants[0],
            u_min=u_min,
            u_max=u_max,
            counts_per_rev=counts_per_rev,
            filter_samples=filter_samples,
        )
    for plant in plants:
        check_fits(start, plant)
    found = _core.tune(
        [core for plant in plants for core in _cores(plant)],
        [reference_samples(r, start) for r in _each(references)],
        start=start.core(),
        counts_per_unit=start.counts_per_unit,
        variations=_checked(default_variations(start) if variations is None else variations),
        cost=_cost(cost).named(),
        aggregate=aggregate,
        evaluations=whole("evaluations", evaluations),
        seed=whole("seed", seed),
        threads=whole("threads", os.cpu_count() or 1 if threads is None else threads),
        progress=progress,
    )
    result = _result(found, start, aggregate, _assumed(plants[0]))
    if result.termination == "interrupted":
        raise Interrupted(result.controller)
    return result


def _cores(plant: Plant) -> list[Any]:
    """A plant each: of an ensemble, every member."""
    return [m.core for m in plant.members] if isinstance(plant, Ensemble) else [plant.core]


def default_variations(controller: Controller) -> tuple[tuple[float, int], ...]:
    """(gain, extra delay in samples) of the plants that a controller is tuned on; see `tune`."""
    delay = max(1, controller.filter_samples // 4)
    return ((1.0, 0), *((gain, delay) for gain in GAINS))


def _cost(cost: Cost | None) -> Cost:
    if not (cost is None or isinstance(cost, Cost)):
        raise SettingError(
            f"expected a Cost, got {type(cost).__name__}; for example Cost(chatter=5.0)"
        )
    return cost or Cost()


def first_controller(
    plant: Plant,
    *,
    u_min: float = -20.0,
    u_max: float = 20.0,
    counts_per_rev: float | None = 1572.0,
    filter_samples: int = 8,
) -> Controller:
    """A conservative controller from a model's own step response by Table 1 (nearest row).

    The moving average's delay counts as dead time.

    Raises
    ------
    SettingError
        For a machine: record its step response and use `fit_fopdt` and `table_1`.
    FitError
        Where no step of the model settles.
    """
    if not isinstance(plant, Model):
        raise SettingError(
            "expected a model to find a start from, got a machine; give start=, or tune on a model"
        )
    if not np.isfinite(u_max) or u_max == 0:
        raise SettingError(
            f"expected a finite u_max other than 0 to size the step by, got {u_max}; give the "
            "amplifier's limit"
        )
    u_unit, y_unit = _stated_units(plant)
    fopdt = _step_fit(plant, u_max)
    delayed = replace(fopdt, L=fopdt.L + (filter_samples - 1) / 2 * plant.Ts)
    rule = table_1(delayed, outside="nearest")
    gains = Gains.standard(
        rule.gains.Kp, rule.gains.Ti, rule.gains.Td, u_unit=u_unit, y_unit=y_unit
    )
    turns = y_unit.lower() in REVOLUTIONS_PER_SECOND
    return Controller(
        gains=gains,
        Ts=plant.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=u_min,
        u_max=u_max,
        filter_samples=filter_samples,
        counts_per_rev=counts_per_rev if turns else None,
        notes="Table 1 on the model's step response" + _assumed(plant),
    )


def _stated_units(plant: Plant) -> tuple[str, str]:
    """Units of command and output; what a model leaves open counts as volt and RPM."""
    u_unit, y_unit = plant_units(plant)
    return u_unit or "V", y_unit or "RPM"


def _assumed(plant: Plant) -> str:
    """What was taken for granted about the units, for a controller's notes."""
    names = ("command in V", "output in RPM")
    open_ = [n for n, unit in zip(names, plant_units(plant), strict=True) if not unit]
    return f"; the model states no unit, taken: {', '.join(open_)}" if open_ else ""


def _step_fit(model: Model, u_max: float) -> Fopdt:
    """The model's step response, at the first size and length at which it settles."""
    if len(model.input_names) != 1:
        raise SettingError(
            f"expected a model with one input to tune on, got {len(model.input_names)}; identify "
            "it from the command alone"
        )
    reason: Exception | None = None
    for share in _STEP_SHARES:
        for samples in _STEP_SAMPLES:
            u = np.zeros(samples)
            u[samples // 20 :] = share * u_max
            try:
                y = model.core.simulate(u[:, None], model.core.rest_state())
                return fit_fopdt(u, y, Ts=model.Ts)
            except (DataError, FitError) as error:
                reason = error
    raise FitError(
        f"expected a model whose step response settles, got none up to u = {0.5 * u_max:g} "
        f"({reason}); give a controller to start from"
    ) from reason


def _checked(variations: Sequence[tuple[float, int]]) -> list[tuple[float, int]]:
    if not variations or not all(np.shape(v) == (2,) for v in variations):
        raise SettingError(
            f"expected variations as pairs of a gain and a delay in samples, got {variations!r}"
        )
    return [(real("a variation's gain", g), whole("a variation's delay", d)) for g, d in variations]


def _each(references: Any) -> list[str | ArrayLike]:
    """The references one by one: a name or a vector is one, a sequence of those is several."""
    if references is None:
        return list(REFERENCES)
    if isinstance(references, str):
        return [references]
    several = not isinstance(references, np.ndarray) and any(
        isinstance(r, str) or np.ndim(r) for r in references
    )
    return list(references) if several or np.ndim(references) == 2 else [references]


def _result(
    found: Mapping[str, Any], start: Controller, aggregate: str, assumed: str
) -> TuningResult:
    units = {"u_unit": start.gains.u_unit, "y_unit": start.gains.y_unit}
    tuned = replace(
        start,
        gains=Gains.standard(found["Kp"], found["Ti"], found["Td"], **units),
        alpha=found["alpha"],
        beta=found["beta"],
        N=found["N"],
        notes="tuned by simulated closed loops" + assumed,
    )
    return TuningResult(
        controller=tuned,
        start=start,
        cost=found["cost"],
        start_cost=found["start_cost"],
        evaluations=int(found["evaluations"]),
        trace=np.asarray(found["trace"]),
        termination=str(found["termination"]),
        weights=Cost(**found["weights"]),
        aggregate=aggregate,
    )
