"""Estimation: whitening filters, the covariance of a misspecified model, and the descent.

Intervals come from the long-run covariance of the scores (White 1982, Econometrica 50; Newey and
West 1987, Econometrica 55), since the residuals are unmodelled friction and load, not white noise.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, gram
from ..errors import FitError
from ..progress import TimeUp

CONFIDENCE = 1.96
SINGULAR = 1e-11
"""Least eigenvalue of a determined direction, relative to the largest."""
BOUNDLESS = 1e6
"""Standard deviation of an undetermined direction, at unit noise."""
PARTS = 4
"""Number of steps in which the window of summed scores advances by its length."""
LEFT = 0.01
"""Least part of a direction's information outside a window, for its scores to be usable."""
FLOOR = 0.05
"""White part added to the residual's power, so that a filter does not amplify tiny parts of it."""


def filtered(rows: FloatArray, used: NDArray[np.bool_], taps: FloatArray) -> FloatArray:
    """Rows (..., N) through a filter; unused samples count as 0."""
    kept: FloatArray = np.where(used, rows, 0.0)
    found: FloatArray = taps[0] * kept
    for lag in range(1, len(taps)):
        found[..., lag:] += taps[lag] * kept[..., :-lag]
    return found


def whitener(parts: Sequence[FloatArray], order: int) -> FloatArray:
    """Whitening filter of an autoregression (Yule-Walker), with innovations of variance 1."""
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
    """Covariance of an estimate, (n, n), from sums of scores over a window.
    A fit follows a window by its share h of the information: each sum is divided by sqrt(1 - h)
    (Bell and McCaffrey 2002, Survey Methodology 28). `jacobian` (m, n) and `residuals` (m,) are
    sorted by piece, then channel. `lengths` are the pieces' samples, `windows` those over which
    scores correlate, and `known` (k, k) is the inverse prior covariance of the first k parameters.
    """
    n = jacobian.shape[1]
    before = np.zeros((n, n))
    if known is not None:
        before[: len(known), : len(known)] = known
    half, unknown = _root(gram(jacobian) + before)
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
    """Moving sums over `within` parts, including windows that extend beyond the ends."""
    none = np.zeros((within, *parts.shape[1:]))
    sums = np.cumsum(np.concatenate([none, parts]), axis=0)
    sums = np.concatenate([sums, np.repeat(sums[-1:], within - 1, axis=0)])
    found: FloatArray = sums[within:] - sums[:-within]
    return found


def inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of a positive matrix in its determined directions, a covariance for the others."""
    half, unknown = _root(matrix)
    return half @ half.T, unknown


def _root(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root of the inverse, (n, determined directions), and a huge covariance for the others.
    A step to a single speed, say, does not separate friction from back-EMF: such a direction holds
    only rounding. Inverting it would give a false value, omitting it a false certainty.
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


# --- Levenberg-Marquardt with a statistical end ---------------------------------------------------


# Levenberg-Marquardt on normal equations within bounds, with a statistical end.
#
# Dry friction makes the cost of a motor's free run piecewise smooth, with kinks: tests of the last
# digits of cost or step do not hold at its minimum, and a solver that waits for one goes in
# circles. The end here is statistical. With errors of variance 1, `g' inv(H) g` is the squared
# distance to the minimum in standard errors (the relative offset of Bates and Watts 1981,
# Technometrics 23); a fraction of one standard error is irrelevant.

Normal: TypeAlias = tuple[float, FloatArray, FloatArray]
"""Cost `e'e`, gradient `J'e` (n,) and `J'J` (n, n)."""

DAMPING = 1e-3
RAISE, LOWER = 6.0, 8.0
"""Factors by which a rejected trial raises the damping, and an accepted one lowers it."""
SAME = 0.8
"""Ratio of predicted gains above which another damping would repeat a rejected trial."""
MOST_DAMPING = 1e7
LEAST_DAMPING = 1e-9
FLAT = 1e-12
"""Least eigenvalue of a direction to step in, relative to the largest of the scaled matrix."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """Parameters `x` (n,), their `cost`, and the squared distance `left` in standard errors."""

    x: FloatArray
    cost: float
    left: float


def minimised(
    normal: Callable[[FloatArray], Normal],
    cost: Callable[[FloatArray], float],
    start: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    count: int,
    *,
    enough: float,
    iterations: int,
) -> Minimum:
    """Find the least-squares solution near a start (n,), within the bounds, both (n,).
    A `cost` that is not finite rejects a trial. The mean square of the `count` residuals is the
    variance for the standard errors. The descent ends at the squared distance `enough` in standard
    errors, or after `iterations` Jacobians. Raises `TimeUp` if one of the functions raises it at
    the start. Raised later, it ends the descent where it is.
    """
    low, high = bounds
    x, mu = start, DAMPING
    now, gradient, matrix = normal(x)
    left, reached = math.inf, Minimum(x, now, math.inf)
    with contextlib.suppress(TimeUp):
        for _ in range(iterations):
            reached = Minimum(x, now, left)
            variance = max(now / count, 1e-300)
            held = ((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0))
            free = ~held & (np.diag(matrix) > 0.0)
            if not free.any():
                return Minimum(x, now, 0.0)
            scale = np.sqrt(np.diag(matrix)[free])
            size, along = np.linalg.eigh(matrix[np.ix_(free, free)] / np.outer(scale, scale))
            slope = along.T @ (gradient[free] / scale)
            known = size > FLAT * size[-1]
            left = float(np.sum(slope[known] ** 2 / size[known])) / variance
            if left < enough:
                break
            refused = math.inf
            while mu <= MOST_DAMPING:
                promised = float(np.sum((slope**2 * (size + 2.0 * mu) / (size + mu) ** 2)[known]))
                if promised < enough * variance:
                    return Minimum(x, now, left)  # a kink: steps this short are not worth a trial
                if promised > SAME * refused:
                    mu *= RAISE
                    continue  # nearly the step that was just rejected
                step = np.zeros(len(x))
                step[free] = -(along @ np.where(known, slope / (size + mu), 0.0)) / scale
                trial = np.clip(x + step, low, high)
                after = cost(trial)
                if after < now:
                    break
                mu *= RAISE
                refused = promised
            else:
                break  # a kink: the gain predicted by the linear model does not exist
            gained = (now - after) / variance
            x, mu = trial, max(mu / LOWER, LEAST_DAMPING)
            now, gradient, matrix = normal(x)
            if gained < enough:
                left = min(left, gained)
                break
        return Minimum(x, now, left)
    return reached
