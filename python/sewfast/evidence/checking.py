"""`check`: a model on data -> its report card."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from ..dataset import Dataset, require_dataset
from ..dataset.experiment import in_effect
from ..dataset.pieces import thinned
from ..dynamic_model import INIT, DynamicModel
from ..errors import FitError, SewfastError
from ..validation import Scores, by_input, doubling, noise_of, without_input
from . import verdicts
from .card import Line, ReportCard
from .operating import operating_range
from .parameters import Criteria, Parameters, StoredInformation, estimate
from .portmanteau import LAGS, parameter_test, residual_tests
from .region import RegionRuns, region_runs, training_region
from .residuals import Horizon, Residuals, horizon_scores, representative
from .simulation_bands import (
    LEVEL,
    Bands,
    bands_of,
    require_level,
    stored_uncertainty,
    uncertainty,
    uncertainty_of,
)

_M = TypeVar("_M", bound=DynamicModel)


@np.errstate(over="ignore", invalid="ignore")
def check(
    model: DynamicModel,
    data: Dataset,
    *,
    training: Dataset | None = None,
    init: int = INIT,
    level: float = LEVEL,
) -> ReportCard:
    """Assess how far a model can be trusted on these data.

    Parameters
    ----------
    model : Model
    data : Dataset
        Preferably not the training data. Outputs after the first `init` samples can be NaN; those
        of weight 0 count as NaN, other weights are ignored.
    training : Dataset or None
        The training data of the model: adds information criteria and the comparison of errors,
        and replaces the evidence stored by `identify` (bands, region).
    init : int
        Samples of each experiment that determine the initial state and are not judged.
    level : float
        Level of the bands, .5 to .999.

    Returns
    -------
    ReportCard

    Raises
    ------
    DataError
        If the data do not match the model or leave nothing to judge.
    FitError
        If the model is unstable, or diverges on these inputs.
    SettingError
        For a level out of range.
    """
    require_dataset(data, "data")
    require_level(level)
    weighed = in_effect(data)
    if training is not None:
        require_dataset(training, "training")
        training = weighed if training is data else in_effect(training)
    data = weighed
    if doubling(model) is not None:
        raise FitError(
            name="model", expected="one whose free run can be judged",
            received="an unstable one, which only a loop holds",
            remedy="validate it, whose free runs begin anew before they leave all bounds, and look "
            "at the margins of its controller (sewfast analyse)",
        )  # fmt: skip
    free = Residuals.of(model, data, init, "free run")
    has_gaps = not all(np.isfinite(e.y).all() for e in data.experiments)
    horizon: Horizon = "one step" if model.kind == "arx" and not has_gaps else "free run"
    # most samples that the tests of the residual use, in blocks: of more all are significant
    tested, part = free, thinned(data, 200_000)
    if part is not data or horizon != "free run":
        tested = Residuals.of(model, part, init, horizon)
    scores = horizon_scores(model, data, free)
    unit = free.unit
    on_training = training is data or (training is None and is_training_data(model, data))
    errors = [np.where(r.counts, r.error, np.nan) for r in free.runs]
    noise = noise_of([r.y[r.counts] for r in free.runs], errors)
    rmse = scores.pooled["free run"].rmse
    share = by_input(rmse, without_input(model, data, init))
    lines = verdicts.accuracy(scores, unit, noise, share) + verdicts.record(data)
    if training is not None and training is not data:
        lines.append(
            verdicts.generalisation(
                scores.pooled["free run"], _training_scores(model, training, init)
            )
        )
    lines.append(verdicts.bias(free))
    tests = residual_tests(tested, fading_samples(model, data, init))
    lines += [verdicts.correlation(t) for t in tests]
    if not on_training and not model.members:
        held = parameter_test(tested, int(model.training.get("samples") or 0))
        lines += [verdicts.correlation(held)] if held is not None else []
    found = _parameters(model, data, training, on_training, init)
    lines += found[2]
    place = region_runs(model, data, training, init)
    far = place.distances if place is not None else []
    covered = _bands(model, data, free, training, level, place)
    if covered is not None:
        lines.append(verdicts.coverage(covered))
    outside = farthest = math.nan
    if far:
        judged = np.concatenate([d[init:] for d in far])
        outside, farthest = float(np.mean(judged > 1.0)), float(judged.max())
    lines.append(verdicts.region(outside, farthest))
    lines += verdicts.rest(model, data)
    operating = operating_range(model) if model.training.get("input_range") else None
    if operating is not None:
        lines += verdicts.operation(operating)
    named = ", ".join(f"{e.name} [{e.range_text}]" for e in data.experiments)
    return ReportCard(
        tuple(lines), model.title, named, on_training, scores, tests, covered, operating,
        found[0], found[1], outside, tuple(far), free.runs, data.Ts, data.output_name, unit,
    )  # fmt: skip


def is_training_data(model: DynamicModel, data: Dataset) -> bool:
    """Whether names, ranges and lengths are those of the model's training data."""
    known = model.training.get("data")
    mine = [{"name": e.name, "range": e.range_text, "samples": len(e)} for e in data.experiments]
    return known == mine


def fading_samples(model: DynamicModel, data: Dataset, init: int = INIT) -> int:
    """Samples after which the effect of the initial state has decayed to a twentieth."""
    single = representative(model)
    e = max(data.experiments, key=len)
    state = single.initial_state(e, init)
    size = np.abs(state).max(initial=0.0)
    try:
        one = single.core.simulate(e.u, state)
        other = single.core.simulate(e.u, state + 1e-3 * max(size, 1.0))
    except (FitError, ValueError):
        return LAGS
    gap = np.abs(other - one)
    kept = np.flatnonzero(gap > 0.05 * gap.max(initial=0.0))
    return int(kept[-1]) + 1 if len(kept) else LAGS


def with_training_evidence(model: _M, data: Dataset) -> _M:
    """The model with the result of `training_evidence` added to its `training`."""
    return replace(model, training={**model.training, **training_evidence(model, data)})


def training_evidence(model: DynamicModel, data: Dataset) -> dict[str, Any]:
    """Evidence for a model to store, from its training data: `region`, `uncertainty`,
    `information`, as JSON values for `model.training`. Parts that these data cannot provide are
    missing.
    """
    found: dict[str, Any] = {}
    try:
        found["region"] = training_region(model, data)
        residuals = Residuals.of(model, data, horizon="free run")
        known = None if model.members else estimate(model, residuals)
        found["uncertainty"] = uncertainty_of(model, data, residuals, known).to_json()
        if model.kind == "arx":
            residuals = Residuals.of(model, data)
            known = estimate(model, residuals)
        if known is not None:
            found["information"] = StoredInformation.of(known, residuals.n).to_json()
    except (SewfastError, np.linalg.LinAlgError):
        return found
    return found


def _training_scores(model: DynamicModel, training: Dataset, init: int) -> Scores:
    return horizon_scores(
        model, training, Residuals.of(model, training, init, "free run"), ()
    ).pooled["free run"]


def _parameters(
    model: DynamicModel, data: Dataset, training: Dataset | None, on_training: bool, init: int
) -> tuple[Parameters | None, Criteria | None, list[Line]]:
    """Parameters and criteria from the training data if given, else the stored ones."""
    source = training if training is not None else data if on_training else None
    if model.members:
        return None, None, []
    if source is None:
        known = StoredInformation.stored(model)
        return None, None, verdicts.parameters(known) if known is not None else []
    residuals = Residuals.of(model, source, init)
    found = estimate(model, residuals)
    if found is None:
        return None, None, []
    squares = verdicts.residuals_power(residuals) * residuals.n
    criteria = Criteria.of(squares, residuals.n, found.effective)
    lines = verdicts.parameters(StoredInformation.of(found, residuals.n))
    lines += [verdicts.looseness(found), verdicts.information(criteria, residuals.unit)]
    return found, criteria, lines


def _bands(
    model: DynamicModel,
    data: Dataset,
    free: Residuals,
    training: Dataset | None,
    level: float,
    place: RegionRuns | None,
) -> Bands | None:
    known = stored_uncertainty(model) if training is None else uncertainty(model, training)
    if known is None:
        return None
    return bands_of(model, data, free, known, level, place)
