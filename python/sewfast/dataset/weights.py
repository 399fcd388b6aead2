"""Weights of samples: how much the squared error of each counts."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray, as_float, frozen
from ..errors import DataError

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment


def as_weights(values: ArrayLike, n: int) -> FloatArray:
    """Weights (N,), finite and 0 or more."""
    weights = as_float(values, "weights")
    if weights.shape != (n,):
        raise DataError(
            f"weights: expected shape ({n},), one for each sample, received {weights.shape}; cut "
            "them to the same range as the output"
        )
    wrong = ~(np.isfinite(weights) & (weights >= 0.0))
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(
            f"weights: expected finite numbers of 0 or more, received {weights[k]} at sample {k} "
            "(0-based); 0 leaves a sample out, 1 counts it in full"
        )
    return weights


def require_some_weight(e: Experiment) -> None:
    """Raise `DataError` where every measured sample of an experiment has weight 0."""
    if e.weights is None:
        return
    measured = ~np.isnan(e.y)
    if not e.weights[measured if measured.any() else slice(None)].any():
        raise DataError(
            f"{e.name} [{e.range_text}], weights: every measured sample has weight 0; expected one "
            "that counts: give it a weight above 0, or leave this experiment out"
        )


def weights_of(e: Experiment) -> FloatArray:
    """The weights of an experiment, ones where it has none, shape (N,)."""
    return np.ones(len(e)) if e.weights is None else e.weights


def mean_square(squares: FloatArray, weights: FloatArray) -> float:
    """Weighted mean of squared errors, both (N,); those that are NaN do not count."""
    counting = weights[~np.isnan(squares)]
    return float(np.nanmean(weights * squares) / np.mean(counting))


def without_weightless(e: Experiment) -> Experiment:
    """The experiment with samples of weight 0 as ones that were not measured."""
    if e.weights is None or e.weights.all():
        return e
    return replace(e, y=frozen(np.where(e.weights == 0.0, np.nan, e.y)))


def in_effect(data: Dataset) -> Dataset:
    """The data as fits and scores take them.

    Samples of weight 0 are as if they had not been measured. The other weights say something only
    beside each other: they are left out where they are all alike, and their largest is made 1.
    """
    if all(e.weights is None for e in data.experiments):
        return data
    for e in data.experiments:
        require_some_weight(e)
    measured = [weights_of(e)[~np.isnan(e.y)] for e in data.experiments]
    high = max((float(w.max()) for w in measured if len(w)), default=1.0)
    experiments, notes = [], []
    for given in data.experiments:
        weights = np.minimum(weights_of(given) / high, 1.0)
        e = without_weightless(replace(given, weights=frozen(weights)))
        require_some_weight(e)
        experiments.append(e)
        taken = e.unmeasured - given.unmeasured
        if taken:
            note = f"{taken} outputs of weight 0 count as not measured"
            notes.append(f"{e.name} [{e.range_text}]: {note}")
    counting = np.concatenate([weights_of(e)[~np.isnan(e.y)] for e in experiments])
    if (counting == 1.0).all():
        experiments = [replace(e, weights=None) for e in experiments]
    else:
        notes.append(f"samples weigh {counting.min():.3g} to 1")
    return replace(data, experiments=tuple(experiments), notes=(*data.notes, *notes))
