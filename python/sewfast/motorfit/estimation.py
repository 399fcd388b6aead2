"""Estimation: whitening filters, the covariance of a misspecified model, and the descent.

Covariance and descent are the core's (rust/core/src/sandwich.rs, bounded.rs). Intervals come from
the long-run covariance of the scores (White 1982, Econometrica 50; Newey and West 1987,
Econometrica 55), since the residuals are unmodelled friction and load, not white noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray
from ..progress import TimeUp

CONFIDENCE = 1.96
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
    *,
    channels: int = 1,
    known: FloatArray | None = None,
) -> FloatArray:
    """Covariance of an estimate, (n, n), from sums of scores over a window.
    `jacobian` (m, n) and `residuals` (m,) are sorted by piece, then channel. `lengths` are the
    pieces' samples, and `known` (k, k) is the inverse prior covariance of the first k parameters.
    """
    return _core.sandwich_covariance(
        np.ascontiguousarray(jacobian), np.ascontiguousarray(residuals), lengths,
        channels=channels, known=known,
    )  # fmt: skip


def inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of a positive matrix in its determined directions, a covariance for the others."""
    half, unknown = _core.inverse_root(matrix)
    return half @ half.T, unknown


Normal: TypeAlias = tuple[float, FloatArray, FloatArray]
"""Cost `e'e`, gradient `J'e` (n,) and `J'J` (n, n)."""


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
    iterations: int,
    enough: float = 1.0,
) -> Minimum:
    """Find the least-squares solution near a start (n,), within the bounds, both (n,).
    A `cost` that is not finite rejects a trial. The mean square of the `count` residuals is the
    variance for the standard errors. The descent ends at the squared distance `enough` in standard
    errors, or after `iterations` Jacobians. Raises `TimeUp` if one of the functions raises it at
    the start. Raised later, it ends the descent where it is.
    """
    x, least, left, stopped = _core.minimised(
        normal, cost, start, *bounds, count=count, enough=enough, iterations=iterations
    )
    if stopped is not None and not isinstance(stopped, TimeUp):
        raise stopped
    return Minimum(x, least, left)
