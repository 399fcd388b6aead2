"""Whether the output integrates an input, as a position does what drives the motor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .arrays import FloatArray
from .checks import LARGEST

if TYPE_CHECKING:
    from .dataset import Dataset

SCALES = ((60, 1), (200, 2), (1000, 4))
"""Blocks that the longest experiment is cut into, and past changes in the regression on them."""
LEAST = 300
"""Samples of the longest experiment below which nothing is said."""
NEGLIGIBLE = 0.5
"""Lengths of the record in time constants up to which a pole is at 1 for all that it can show."""
RESTORED = (3.0, 3.0, 6.0)
"""Standard errors by which a pole must lie inside, at each of the scales, to count as inside.

More on the finest blocks, where sensor noise on the level looks like a force that brings it back.
"""
RESTORED_SHORT = 2.5
"""The same at every scale where the record is too short for the finest blocks."""
DRIVEN = 4.5
"""Standard errors by which the input must drive the change of the output."""
BALANCE, MOST_BALANCE = 0.2, 0.5
"""Restoring over driving part of the change: less in the median of the scales, and where the input
drives most clearly."""
EXPLAINED = 0.35
"""Part of the output without its line that the integral of the input must reach."""
MOST_EXPERIMENTS = 50
TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Integration:
    """How an output that is driven by the inputs comes back, seen over the whole record.

    Attributes
    ----------
    is_integral : bool
        The output integrates an input: nothing that the record shows brings it back.
    input : int
        The input that drives it most clearly.
    lengths : float
        Length of the longest experiment in time constants of the slowest pole; 0 or below for an
        integral.
    time_constant : float
        Of the slowest pole [s]; where several are slow, their sum. inf for an integral.
    gain : float
        Change of the output per second and unit of that input at low frequencies.
    restoring, driving : float
        Standard errors by which the pole lies inside, and by which the input drives the change.
    """

    is_integral: bool
    input: int
    lengths: float
    time_constant: float
    gain: float
    restoring: float
    driving: float


def integration(data: Dataset) -> Integration | None:
    r"""Test for a pole at 1 that an input drives; None where the record is too short or still.

    The record is cut into blocks, and over their means this regression is solved (the augmented
    Dickey-Fuller regression with inputs):

    .. math:: \Delta y_k = c + d k - \epsilon y_{k-1} + \sum_i a_i \Delta y_{k-i}
              + \sum_i b_i u_{k-i} + f\,\mathrm{sign}(\Delta y_{k-1}) + \sum_i q_i u_{k-i}^2

    The slowest time constant is `(1 - sum a) / epsilon` blocks, and `sum b / (1 - sum a)` the
    gain into it. A constant holds offsets of both, a line holds drift, the sign holds dry friction
    and the squares an uneven input. Means over blocks of three lengths make sensor noise and what
    is fast small. The output is an integral where

    - at no length the pole lies significantly inside (`RESTORED`), where a time constant of more
      than two records counts as infinite (`NEGLIGIBLE`): a slow drive that was recorded for one
      time constant or more does come back;
    - the input drives the change at some length (`DRIVEN`): drift of a sensor has a pole at 1 as
      well, but no input reaches it;
    - the restoring part is small beside the driving part (`BALANCE`): at rest both are equal;
    - the integral of the input is a large part of the output (`EXPLAINED`).

    Source: D. Dickey, W. Fuller, J. American Statistical Association 74 (1979) 427-431. The bounds
    are those at which some 50 simulated families could be kept apart.
    """
    experiments = sorted(data.experiments, key=len, reverse=True)[:MOST_EXPERIMENTS]
    longest = len(experiments[0])
    if longest < LEAST:
        return None
    columns = [np.column_stack([e.u, e.y]) for e in experiments]
    found = []
    for blocks, past in SCALES:
        size = longest // blocks
        if size >= 1:
            means = [m for c in columns if len(m := _block_means(c, size)) > past + 2]
            scale = _scale(means, past, longest / size, data.Ts * size)
            found += [] if scale is None else [scale]
    if not found:
        return None
    return _together(found, data.Ts * longest)


@dataclass(frozen=True)
class _Scale:
    """The regression at one length of blocks, in deviations and records."""

    lengths: float
    error: float
    input: int
    driving: float
    balance: float
    explained: float
    gain: float

    @property
    def restoring(self) -> float:
        return (self.lengths - NEGLIGIBLE) / self.error if self.error > 0.0 else 0.0


def _together(found: list[_Scale], seconds: float) -> Integration:
    restored = max(found, key=lambda s: s.restoring)
    driven = max(found, key=lambda s: s.driving)
    whole = len(found) == len(SCALES)
    bounds = RESTORED if whole else (RESTORED_SHORT,) * len(found)
    is_integral = (
        all(s.restoring < bound for s, bound in zip(found, bounds, strict=True))
        and driven.driving > DRIVEN
        and float(np.median([s.balance for s in found])) < BALANCE
        and driven.balance < MOST_BALANCE
        and driven.explained > EXPLAINED
    )
    lengths = driven.lengths if is_integral else restored.lengths
    return Integration(
        is_integral=is_integral,
        input=driven.input,
        lengths=lengths,
        time_constant=math.inf if is_integral or lengths <= 0.0 else seconds / lengths,
        gain=driven.gain,
        restoring=restored.restoring,
        driving=driven.driving,
    )


def _block_means(columns: FloatArray, size: int) -> FloatArray:
    """Means of `size` samples each; NaN where fewer than half are known."""
    count = len(columns) // size
    cut = columns[: count * size].reshape(count, size, columns.shape[1])
    known = np.abs(cut) < LARGEST
    number = known.sum(axis=1)
    total = np.where(known, cut, 0.0).sum(axis=1)
    means: FloatArray = np.where(2 * number >= size, total / np.maximum(number, 1), np.nan)
    return means


def _scale(means: list[FloatArray], past: int, record: float, seconds: float) -> _Scale | None:
    """The regression over blocks, `record` of them in the longest experiment, `seconds` each."""
    everything = np.concatenate(means) if means else np.zeros((0, 2))
    everything = everything[np.isfinite(everything).all(axis=1)]
    if len(everything) < 40:
        return None
    middle, size = everything.mean(axis=0), everything.std(axis=0)
    moving = size > 1e-12 * np.abs(everything).max(axis=0)
    if not moving[-1] or not moving[:-1].any():
        return None
    inputs = np.flatnonzero(moving[:-1])
    scaled = [(m - middle)[:, moving] / size[moving] for m in means]
    changes = np.concatenate([np.diff(m[:, -1]) for m in scaled])
    spread = _deviation(changes)
    rows = np.concatenate([_rows(m, past, record, spread) for m in scaled])
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 2 * rows.shape[1]:
        return None
    theta, covariance = _least_squares(rows[:, 1:], rows[:, 0])
    left = 1.0 - float(theta[1 : 1 + past].sum())
    lags = past + 2
    driving, total = [], []
    for j in range(len(inputs)):
        window = slice(1 + past + j * lags, 1 + past + (j + 1) * lags)
        total.append(float(theta[window].sum()))
        variance = float(covariance[window, window].sum())
        driving.append(abs(total[-1]) / math.sqrt(max(variance, TINY)))
    j = int(np.argmax(driving))
    if left == 0.0 or total[j] == 0.0:
        return None
    gain = total[j] / left
    integral = np.concatenate([_without_line(_running_sum(m[:, j])) for m in scaled])
    output = np.concatenate([_without_line(m[:, -1]) for m in scaled])
    return _Scale(
        lengths=-float(theta[0]) / left * record,
        error=math.sqrt(max(float(covariance[0, 0]), 0.0)) / abs(left) * record,
        input=int(inputs[j]),
        driving=driving[j],
        balance=-float(theta[0]) / abs(total[j]),
        explained=abs(gain) * _deviation(integral) / max(_deviation(output), TINY),
        gain=float(gain * size[-1] / size[inputs[j]] / seconds),
    )


def _rows(scaled: FloatArray, past: int, record: float, spread: float) -> FloatArray:
    """[change, level, past changes, inputs, 1, time, sign of motion, squares] of each block."""
    y, u = scaled[:, -1], scaled[:, :-1]
    change = np.diff(y)
    k = np.arange(past, len(change))
    columns = [change[k], y[k], *(change[k - i] for i in range(1, past + 1))]
    for column in u.T:
        columns += [column[k + 1 - i] for i in range(past + 2)]
    moving = change / np.sqrt(change**2 + 0.01 * spread**2 + TINY)
    columns += [np.ones(len(k)), k / record - 0.5, moving[k - 1]]
    for column in u.T:
        size = np.abs(column)
        # the square of a two-level input is a constant
        if np.nanmax(size) - np.nanmin(size) > 0.05:
            columns += [column[k] ** 2, column[k - 1] ** 2]
        else:
            columns += [np.zeros(len(k)), np.zeros(len(k))]
    return np.stack(columns, axis=1)


def _least_squares(X: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters and their covariance; what the columns do not fix is 0."""
    length = np.linalg.norm(X, axis=0)
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    left, values, right = np.linalg.svd(X * scale, full_matrices=False)
    keep = values > 1e-9 * values[0]
    back = right[keep].T / values[keep]
    theta = back @ (left[:, keep].T @ y)
    error = y - (X * scale) @ theta
    variance = float(error @ error) / max(len(y) - int(keep.sum()), 1)
    covariance = variance * (back @ back.T) * np.outer(scale, scale)
    return theta * scale, covariance


def _deviation(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.std()) if len(known) else 0.0


def _running_sum(column: FloatArray) -> FloatArray:
    return np.cumsum(np.where(np.isfinite(column), column, 0.0))


def _without_line(column: FloatArray) -> FloatArray:
    known = np.isfinite(column)
    k = np.arange(len(column)) - (len(column) - 1) / 2.0
    if known.sum() < 3:
        return column - column
    line: FloatArray = np.polyval(np.polyfit(k[known], column[known], 1), k)
    return column - line
