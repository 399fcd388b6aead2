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
PARTS = 4
"""Steps in which the window over which scores are summed moves on by its length."""
LEFT = 0.01
"""Of a direction's information, at least outside a window: with less, its scores say nothing."""
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

    A fit bends towards each window by the share `h` of the information that the window has, which
    leaves of its sum a variance of h (1 - h) in place of h: each is divided by sqrt(1 - h) (Bell
    and McCaffrey 2002, Survey Methodology 28). With 18 parameters on 5 s this counts.

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
    half, unknown = _root(jacobian.T @ jacobian + before)
    middle, at, total = half.T @ before @ half, 0, 0.0
    for length, window in zip(lengths, windows, strict=True):
        rows = slice(at, at + channels * length)
        J = (jacobian[rows] @ half).reshape(channels, length, -1)
        at += channels * length
        part = max(window // PARTS, 1)
        starts, within = range(0, length, part), window // part
        g = np.einsum("cl,clj->lj", residuals[rows].reshape(channels, length), J)
        scores = np.add.reduceat(g, starts, axis=0)
        grams = np.stack([np.einsum("cli,clj->ij", *2 * [J[:, k : k + part]]) for k in starts])
        share, along = np.linalg.eigh(_windowed(grams, within))
        inside = np.einsum("wij,wi->wj", along, _windowed(scores, within))
        inside /= np.sqrt(np.clip(1.0 - share, LEFT, 1.0))
        sums = np.einsum("wij,wj->wi", along, inside)
        middle = middle + sums.T @ sums / within
        total += 1.5 * length / window
    spread = (1.0 + 1.2 / max(total, 1.0)) ** 2  # Student's quantile over the normal one
    found: FloatArray = half @ middle @ half.T * spread + unknown
    return found


def _windowed(parts: FloatArray, within: int) -> FloatArray:
    """Sums of so many parts in a row, those that stand over either end too."""
    none = np.zeros((within, *parts.shape[1:]))
    sums = np.cumsum(np.concatenate([none, parts]), axis=0)
    sums = np.concatenate([sums, np.repeat(sums[-1:], within - 1, axis=0)])
    found: FloatArray = sums[within:] - sums[:-within]
    return found


def inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of a positive matrix in the directions that are seen, and a covariance for the others."""
    half, unknown = _root(matrix)
    return half @ half.T, unknown


def _root(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root of the inverse, (n, directions seen), and a covariance beyond all bounds for the others.

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
    return along[:, known] / np.sqrt(size[known]), unknown @ unknown.T
