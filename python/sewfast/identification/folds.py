"""The data that models are fitted to and chosen by, comparisons of errors, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from ..dataset import Dataset, Experiment, FloatArray
from ..dataset.experiment import mean_square, weights_of
from ..dataset.pieces import thinned
from ..dynamic_model import INIT, Core
from ..errors import DataError, FitError
from ..models import Model
from ..validation import (
    GOOD,
    by_input,
    doubling,
    free_run_error,
    grade_of,
    judged,
    largest_pole,
    noise_of,
    scored_runs,
    without_input,
)
from .task import Provenance, sources, with_provenance

SHARE = 0.2
"""Part of every experiment that is held out, at its end.

Short blocks inside a record lie where the drive was before and after, and favour a network that
memorises the record; a later part is the honest test if there are many data.
"""
LEAST_HELD_OUT = 2 * INIT
"""Samples of a held-out part, and of what is left to fit."""
AS_GOOD = 0.05
"""An error that is larger by more than this share is worse, however uncertain the comparison."""
TRIAL = 20_000
"""Samples by which something is decided that few samples tell badly: to which networks are trained
before the last stage, and by which a process noise is chosen."""
WORTH_IT = 0.98
"""A larger structure has to bring the error below this part of the smaller one's to count as a
gain, however significant it is."""


@dataclass(frozen=True)
class Split:
    """Data to fit to and data to choose by. Parts of `held` begin in the fitted data, which give
    their state. If `is_given`, it is the user's own validation data, which are never trained on.
    `sources` are the scored ranges, as JSON values.
    """

    fitted: Dataset
    held: Dataset
    is_given: bool = False
    sources: tuple[Provenance, ...] = ()

    @property
    def scored(self) -> int:
        """Number of samples by which models are chosen."""
        return sum(measured(e.y[e.initial_samples(INIT) :]) for e in self.held.experiments)

    @property
    def spread(self) -> float:
        """Error of a constant, the mean of the fitted data: the largest meaningful error.
        Its outermost percent is left out, since one outlier would make every error look small.
        """
        fitted = np.concatenate([e.y for e in self.fitted.experiments])
        low, high = np.nanquantile(fitted, [0.005, 0.995])
        mean = float(np.nanmean(np.clip(fitted, low, high)))
        scored = [(e, e.initial_samples(INIT)) for e in self.held.experiments]
        squares = np.concatenate([(e.y[first:] - mean) ** 2 for e, first in scored])
        weights = np.concatenate([weights_of(e)[first:] for e, first in scored])
        return math.sqrt(mean_square(squares, weights))

    def shortened(self, samples: int) -> Split:
        """About so many samples to fit, a proportional part of every experiment, and ten times as
        many to judge by: a free run takes a tenth of the time of a fit, or less.
        """
        fitted, held = thinned(self.fitted, samples), _shortened(self.held, 10 * samples)
        return replace(self, fitted=fitted, held=held)


def _split(data: Dataset) -> Split | None:
    """Hold out the end of every experiment that is long enough; None if none is.
    A short experiment is used for training as a whole; if all are short, the last ones are held out
    whole.
    """
    fitted: list[Experiment] = []
    held: list[Experiment] = []
    parts: list[Experiment] = []
    for e in data.experiments:
        at = len(e) - round(SHARE * len(e))
        # a long gap can leave too little on one side for a split
        if min(measured(e.y[:at]), measured(e.y[at:])) < LEAST_HELD_OUT:
            fitted.append(e)
            continue
        fitted.append(e.cut(0, at))
        held.append(with_run_up(e, at, len(e)))
        parts.append(e.cut(at, len(e)))
    if not held:
        fitted, held = _whole(data)
        parts = held
    if not held:
        return None
    pieces = (replace(data, experiments=tuple(p)) for p in (fitted, held, parts))
    fitted_data, held_data, scored = pieces
    return Split(fitted_data, held_data, sources=tuple(sources(scored)))


def _whole(data: Dataset) -> tuple[list[Experiment], list[Experiment]]:
    """Many short experiments split into those before the last fifth, and that fifth."""
    able = [e for e in data.experiments if measured(e.y) >= LEAST_HELD_OUT]
    at = len(able) - round(SHARE * len(able))
    return able[:at], able[at:] if at > 0 else []


def later_part(data: Dataset, validation: Dataset | None = None) -> Split | None:
    """The last fifth, after all data before it; validation data, if given.
    None if experiments are too short, or if the inputs move only once: what follows a single step
    is its response, in the fitted part as in the held one.
    """
    if validation is not None:
        return given(data, validation)
    found = None if moves_once(data) else _split(data)
    return found if found is not None and found.scored and is_moving(found.fitted) else None


def given(data: Dataset, validation: Dataset) -> Split:
    """Validation data as the part to judge by."""
    return Split(data, validation, is_given=True, sources=tuple(sources(validation)))


def moves_once(data: Dataset) -> bool:
    """Whether the inputs move less than twice."""
    moves = ((np.diff(e.u, axis=0) != 0.0).any(axis=1).sum() for e in data.experiments)
    return sum(map(int, moves)) < 2


def is_moving(data: Dataset) -> bool:
    """Whether there is motion to learn from: a step near the end can be entirely held out."""
    try:
        data.require_excited()
    except DataError:
        return False
    return True


def measured(y: FloatArray) -> int:
    """Number of outputs that are known."""
    return int(np.isfinite(y).sum())


@dataclass(frozen=True, eq=False, repr=False)
class HeldOut(Experiment):
    """A held-out part; its first `run_up` samples are fitted ones, which only give its state."""

    run_up: int = 0

    def initial_samples(self, init: int) -> int:
        """Number of first samples that give the state, at least `init` measured ones."""
        return max(self.run_up, super().initial_samples(init))

    def cut(self, start: int, stop: int) -> HeldOut:
        """Samples `start` to `stop`, with what is left of the run-up."""
        e = super().cut(start, stop)
        left = max(0, self.run_up - start)
        return HeldOut(e.u, e.y, {}, e.name, e.start, weights=e.weights, run_up=left)


def with_run_up(e: Experiment, at: int, stop: int) -> HeldOut:
    # fitted samples at the beginning of a held-out part, so that its state is known for scoring
    begin = max(0, at - (10 * INIT))
    part = e.cut(begin, stop)
    return HeldOut(part.u, part.y, {}, e.name, part.start, weights=part.weights, run_up=at - begin)


def _shortened(data: Dataset, samples: int) -> Dataset:
    if len(data) <= samples:
        return data
    share = samples / len(data)
    kept = [max(LEAST_HELD_OUT, round(share * len(e))) for e in data.experiments]
    pieces = (e.cut(0, min(n, len(e))) for n, e in zip(kept, data.experiments, strict=True))
    return replace(data, experiments=tuple(pieces))


# --- Errors on held-out data, and their comparison ------------------------------------------------

ERROR_BLOCKS = 12
"""Number of blocks of squared errors in a comparison, over all held-out parts together."""


@dataclass(frozen=True, eq=False)
class Errors:
    """Squared free-run errors on held-out data, summed block by block.
    `squares` (B,) holds the sum of squared errors of each block, each times its weight; `counts`
    (B,) the sum of the weights of the known outputs in it: their number if all weights are equal.
    """

    squares: FloatArray
    counts: FloatArray

    @property
    def rmse(self) -> float:
        """Root mean square error over all blocks."""
        samples = self.counts.sum()
        return float(np.sqrt(self.squares.sum() / samples)) if samples else float("inf")


RUNAWAY = Errors(np.array([np.inf]), np.array([1.0]))
"""Errors of a model whose free run diverges."""


def errors_of(runs: Sequence[FloatArray] | None, held: Split) -> Errors:
    """The errors of free runs over the held-out parts, one run for each experiment."""
    if runs is None:
        return RUNAWAY
    experiments = held.held.experiments
    parts = max(2, round(ERROR_BLOCKS / len(experiments)))
    squares, counts = [], []
    for run, e in zip(runs, experiments, strict=True):
        error = e.y - run
        error[: e.initial_samples(INIT)] = np.nan
        known, weights = np.flatnonzero(np.isfinite(error)), weights_of(e)
        for block in np.array_split(known, parts):
            squares.append(float((weights[block] * error[block]) @ error[block]))
            counts.append(float(weights[block].sum()))
    return Errors(np.array(squares), np.array(counts))


def free_runs(core: Core, held: Split) -> list[FloatArray] | None:
    """Free runs over the held-out parts, each from its estimated state; None if one diverges."""
    runs = []
    for e in held.held.experiments:
        try:
            first = e.initial_samples(INIT)
            state = core.estimate_initial_state(e.u[:first], e.y[:first])
            runs.append(core.simulate(e.u, state))
        except FitError:
            return None
    return runs


def compared(one: Errors, other: Errors) -> tuple[float, float]:
    """Logarithm of the ratio of two rms errors, and its standard error.
    Neighbouring errors are correlated, so whole blocks are resampled, the same ones for both models
    (Kuensch 1989; Efron and Tibshirani 1993, section 8.6).
    """
    one_runs, other_runs = np.isfinite(one.squares).all(), np.isfinite(other.squares).all()
    if not (one_runs and other_runs):
        return 0.0 if one_runs == other_runs else -np.inf if one_runs else np.inf, 0.0
    picks = np.random.default_rng(0).integers(0, len(one.squares), (400, len(one.squares)))
    tiny = 1e-300
    drawn = 0.5 * np.log(
        (one.squares[picks].sum(axis=1) + tiny) / (other.squares[picks].sum(axis=1) + tiny)
    )
    ratio = 0.5 * np.log((one.squares.sum() + tiny) / (other.squares.sum() + tiny))
    return float(ratio), float(drawn.std())


# --- The verdict: whether a model is good enough --------------------------------------------------


TEXTS = {
    "": "the output hardly moves where it was not trained on",
    "good": "good enough to tune a controller on",
    "fair": "good enough for a first, cautious controller",
    "poor": "not good enough to tune a controller on",
    "useless": "useless",
}
UNSEEN_DATA = "data not trained on"


@dataclass(frozen=True, eq=False)
class Trial:
    """Free runs over a part of the data by which a model is judged.
    `error` is their root mean square error, `residuals` what they leave of the outputs of each
    experiment, NaN where it is not scored. `apart` is the standard error of the model's own free
    run, from models of the data without each block. All in the output's unit.
    """

    part: Split
    error: float
    residuals: Sequence[FloatArray]
    apart: float = 0.0


def tried(model: Model, part: Split) -> Trial:
    """The model's own free run over a part."""
    try:
        runs = scored_runs(model, part.held, INIT)
    except (DataError, FitError):
        return Trial(part, math.inf, ())
    residuals = [e.y - run for run, e in zip(runs, part.held.experiments, strict=True)]
    for residual, e in zip(residuals, part.held.experiments, strict=True):
        residual[: e.initial_samples(INIT)] = np.nan
    return Trial(part, free_run_error(model, part.held, INIT), residuals)


FreeRuns: TypeAlias = Callable[[Split], Sequence[FloatArray] | None]
"""Free runs over the held-out part, one for each experiment; None if one diverges."""


def apart(model: Model, data: Dataset, without: Sequence[FreeRuns]) -> float:
    """Standard error of a model's free run [output unit]; infinite if one diverges.
    `without` are models of the same data without one block each: the grouped jackknife (Efron and
    Tibshirani 1993, section 11.5). They run over the inputs of the data, and on with the same
    backwards: where a record was, its outputs hold even a pole together that is the noise's.
    """
    further = []
    for e in data.experiments:
        u, unknown = np.concatenate([e.u, e.u[::-1]]), np.full(len(e), np.nan)
        longer = replace(e, u=u, y=np.concatenate([e.y, unknown]), channels={}, weights=None)
        further.append(longer)
    on = Split(data, replace(data, experiments=tuple(further)))
    try:
        own = np.concatenate(model.simulate(on.held))
    except FitError:
        return math.inf
    squares, n = 0.0, len(without)
    for run in without:
        if (runs := run(on)) is None:
            return math.inf
        squares += float(np.mean((np.concatenate(runs) - own) ** 2))
    return math.sqrt((n - 1) / n * squares) if n else 0.0


def verdict(model: Model, data: Dataset, trial: Trial, where: str = UNSEEN_DATA) -> Provenance:
    """Whether the model is good enough to tune a controller on, in words and as values.
    `data` are its training data, and those of the trial are described by `where`. The result has
    `grade` ("good", "fair", "poor" or "useless"), `fit_percent`, `text`, and `next`: a list of
    things to do, the most important one first. A model whose own standard error is larger than a
    good model's error is "fair" at best.
    """
    part, error, spread = trial.part, trial.error, trial.part.spread
    own = free_run_error(model, part.held, INIT)
    fit = 100.0 * (1.0 - error / spread) if spread > 0.0 else float("nan")
    noise = noise_of([e.y for e in data.experiments], trial.residuals)
    share = by_input(own, without_input(model, part.held, INIT))
    grade, remark = judged(fit, error, noise, share)
    if grade == "good" and (loose := 100.0 * trial.apart / spread) > 100.0 - GOOD:
        grade = "fair"
        by = f"differ from it by {loose:.0f} %" if math.isfinite(loose) else "run away"
        remark += f", but models without one of its parts {by}"
    unit = f" {data.output_unit}" if data.output_unit else ""
    rmse = f"rmse {error:.3g}{unit}"
    text, todo = TEXTS[grade], []
    if not np.isfinite(error):
        text = "useless: its free run leaves the finite numbers"
    elif grade:
        text += f": free run explains {fit:.1f} % of {where} ({rmse}){remark}"
        if grade == "useless" and not remark:
            text += "; a constant would do about as well"
    else:
        text += f" ({rmse})"
    if grade == "good":
        if fit < GOOD:
            text += f"; what is left is measurement noise ({noise:.3g}{unit})"
        todo.append(
            "validate it on another recording; to tune, identify with nk = 1 (--nk 1): no loop can "
            "be closed around a model without delay"
            if any(m.orders["nk"] == 0 for m in model.members or (model,))
            else "validate it on another recording, then tune"
        )
    else:
        todo += what_to_record(data)
    return {
        "grade": grade or "useless",
        "fit_percent": fit if np.isfinite(fit) else None,
        "text": text,
        "next": todo,
    }


def judged_without(model: Model, without: Model, data: Dataset, part: Split) -> Model:
    """The model of some data with the verdict that one `without` a part of them gets on that part.
    Validation data judge the model itself, later.
    """
    if part.is_given or doubling(model) is not None:
        return model
    return with_provenance(model, {"verdict": verdict(model, data, tried(without, part))})


def unstable_verdict(model: Model, part: Split, where: str) -> Provenance:
    """`verdict` on an unstable model, by free runs of as many samples as it doubles in. It is at
    most "fair": nobody has seen its plant run freely.
    """
    ahead, pole = doubling(model), largest_pole(model)
    try:
        runs = scored_runs(model, part.held, INIT)
    except (DataError, FitError):
        runs = [np.full(len(e), np.inf) for e in part.held.experiments]
    outputs = np.concatenate([e.y for e in part.held.experiments])
    error, spread = errors_of(runs, part).rmse, float(np.nanstd(outputs))
    fit = 100.0 * (1.0 - error / spread) if spread > 0.0 else math.nan
    grade = grade_of(fit, error, noise_of([e.y for e in part.held.experiments])) or "useless"
    grade = "fair" if grade == "good" else grade
    unit = f" {part.fitted.output_unit}" if part.fitted.output_unit else ""
    return {
        "grade": grade,
        "fit_percent": fit if math.isfinite(fit) else None,
        "text": f"{TEXTS[grade]}: unstable, as its plant has to be, with a pole at {pole:.5g}; "
        f"free runs as long as it doubles, {ahead} samples, explain {fit:.1f} % of {where} "
        f"(rmse {error:.3g}{unit})",
        "next": [
            "tune, best from the controller that holds the plant (--start)" if grade == "fair"
            else "record longer, with a dither on the command that moves the output clearly"
        ],
    }  # fmt: skip


def what_to_record(data: Dataset) -> list[str]:
    """Advice on another recording."""
    wanted = [
        "record longer, with more levels of the input and the speeds that the controller will use"
    ]
    if len(data.experiments) == 1:
        wanted.append("give several recordings: they are fitted together")
    wanted.append("see the report card (check) for what the residual still contains")
    return wanted
