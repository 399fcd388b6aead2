"""Levenberg-Marquardt on normal equations within bounds, ended by what noise would gain anyway.

Dry friction makes the cost of a motor's free run a broken line: no test by the last digits of cost
or step holds at its minimum, and a solver that waits for one goes in circles. The end here is
statistical. With errors of variance 1, `g' inv(H) g` is the squared distance to the minimum in
standard errors (the relative offset of Bates and Watts 1981, Technometrics 23): what is less than a
fraction of one is no part of the answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from ..arrays import FloatArray

Normal: TypeAlias = tuple[float, FloatArray, FloatArray]
"""Cost `e'e`, gradient `J'e` (n,) and `J'J` (n, n)."""

DAMPING = 1e-3
RAISE, LOWER = 6.0, 8.0
"""What a rejected trial multiplies the damping by, and an accepted one divides it by."""
SAME = 0.8
"""Share of what a rejected trial promised, above which another damping makes no other trial."""
MOST_DAMPING = 1e7
LEAST_DAMPING = 1e-9
SINGULAR = 1e-12
"""Of the largest eigenvalue of the scaled matrix, below which a direction is not walked."""


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where it ended.

    Attributes
    ----------
    x : array, shape (n,)
        Parameters.
    cost : float
        Sum of squares there.
    left : float
        Squared distance to the minimum in standard errors, as the linear model has it.
    """

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
    """The least squares near a start.

    Parameters
    ----------
    normal, cost : callable
        Of parameters, shape (n,); a cost that is not finite rejects a trial.
    start : array, shape (n,)
        Within the bounds.
    bounds : pair of array, shape (n,)
        Least and largest values.
    count : int
        Residuals: their mean square is the variance in which distances are measured.
    enough : float
        Squared distance in standard errors at which it ends.
    iterations : int
        Jacobians at most.
    """
    low, high = bounds
    x, mu = start, DAMPING
    now, gradient, matrix = normal(x)
    left = math.inf
    for _ in range(iterations):
        variance = max(now / count, 1e-300)
        held = ((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0))
        free = ~held & (np.diag(matrix) > 0.0)
        if not free.any():
            return Minimum(x, now, 0.0)
        scale = np.sqrt(np.diag(matrix)[free])
        size, along = np.linalg.eigh(matrix[np.ix_(free, free)] / np.outer(scale, scale))
        slope = along.T @ (gradient[free] / scale)
        known = size > SINGULAR * size[-1]
        left = float(np.sum(slope[known] ** 2 / size[known])) / variance
        if left < enough:
            break
        refused = math.inf
        while mu <= MOST_DAMPING:
            promised = float(np.sum((slope**2 * (size + 2.0 * mu) / (size + mu) ** 2)[known]))
            if promised < enough * variance:
                return Minimum(x, now, left)  # a kink: steps this short are worth no trial
            if promised > SAME * refused:
                mu *= RAISE
                continue  # about the step that was just refused
            step = np.zeros(len(x))
            step[free] = -(along @ np.where(known, slope / (size + mu), 0.0)) / scale
            trial = np.clip(x + step, low, high)
            after = cost(trial)
            if after < now:
                break
            mu *= RAISE
            refused = promised
        else:
            break  # a kink: what the linear model still promises is not there
        gained = (now - after) / variance
        x, mu = trial, max(mu / LOWER, LEAST_DAMPING)
        now, gradient, matrix = normal(x)
        if gained < enough:
            left = min(left, gained)
            break
    return Minimum(x, now, left)
