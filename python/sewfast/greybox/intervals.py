"""Filters that make errors white, and what an estimate's covariance is when no model is exact.

Intervals are those of a misspecified model, from the long-run covariance of the scores (White 1982,
Econometrica 50; Newey and West 1987, Econometrica 55), since what is left over is friction and load
that no term has, not white noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import FitError

CONFIDENCE = 1.96
SINGULAR = 1e-11
"""Of the largest eigenvalue, from which a direction is seen."""
BOUNDLESS = 1e6
"""Standard deviations for a direction that is not, at unit noise."""
FLOOR = 0.05
"""Of the power of what is left over, white: a filter does not magnify what is hardly there."""


def filtered(rows: FloatArray, used: NDArray[np.bool_], taps: FloatArray) -> FloatArray:
    """Rows (..., N) through a filter; samples that are not used are nothing."""
    kept: FloatArray = np.where(used, rows, 0.0)
    found: FloatArray = taps[0] * kept
    for lag in range(1, len(taps)):
        found[..., lag:] += taps[lag] * kept[..., :-lag]
    return found


def whitener(parts: Sequence[FloatArray], order: int) -> FloatArray:
    """Of an autoregression (Yule-Walker equations), over its innovations' standard deviation."""
    n = sum(map(len, parts))
    r = np.array([sum(float(x[k:] @ x[: len(x) - k]) for x in parts) for k in range(order + 1)]) / n
    if r[0] <= 0.0:
        return np.ones(1)
    r[0] *= 1.0 + FLOOR
    lags = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    a = np.linalg.solve(r[lags], r[1:])
    return np.concatenate([[1.0], -a]) / math.sqrt(max(r[0] - float(a @ r[1:]), 1e-12 * r[0]))


def covariance_of(
    jacobian: FloatArray,
    residuals: FloatArray,
    lengths: Sequence[int],
    windows: Sequence[int],
    *,
    channels: int = 1,
    known: FloatArray | None = None,
) -> FloatArray:
    """Of an estimate, (n, n); sums of scores over a window stand for their long-run covariance.

    Parameters
    ----------
    jacobian, residuals : array, shape (m, n) and (m,)
        Piece by piece, the channels of a piece one after the other.
    lengths, windows : sequence of int
        Samples of each piece, and over how many scores hang together there.
    channels : int
        Rows that belong to one instant.
    known : array, shape (k, k), optional
        Inverse covariance of what is known of the first k parameters beforehand.
    """
    n = jacobian.shape[1]
    before = np.zeros((n, n))
    if known is not None:
        before[: len(known), : len(known)] = known
    inner, unknown = inverse(jacobian.T @ jacobian + before)
    middle, at, total = before, 0, 0.0
    for length, window in zip(lengths, windows, strict=True):
        rows = slice(at, at + channels * length)
        g = (jacobian[rows] * residuals[rows, None]).reshape(channels, length, n).sum(axis=0)
        at += channels * length
        sums = np.cumsum(np.concatenate([np.zeros((window, n)), g]), axis=0)
        sums = np.concatenate([sums, np.repeat(sums[-1:], window - 1, axis=0)])
        within = sums[window:] - sums[:-window]
        middle = middle + within.T @ within / window
        total += 1.5 * length / window
    spread = (1.0 + 1.2 / max(total, 1.0)) ** 2  # Student's quantile over the normal one
    found: FloatArray = inner @ middle @ inner * spread + unknown
    return found


def inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of a positive matrix where it has one, and a covariance beyond all bounds where it has none.

    A step to a single speed, say, does not part friction from back-EMF: what is left in such a
    direction is rounding, whose inverse would be a lie and whose omission a certainty.
    """
    if not np.isfinite(matrix).all():
        raise FitError(
            name="data", expected="a free run that changes with the parameters by finite amounts",
            received="infinite ones", remedy="record changes of speed in both directions, faster "
            "sampled than the motor settles",
        )  # fmt: skip
    d = np.sqrt(np.diag(matrix))
    d[d == 0.0] = 1.0
    size, along = np.linalg.eigh(matrix / np.outer(d, d))
    along /= d[:, None]
    known = size > SINGULAR * size[-1]
    unknown = along[:, ~known] * BOUNDLESS
    return along[:, known] / size[known] @ along[:, known].T, unknown @ unknown.T
