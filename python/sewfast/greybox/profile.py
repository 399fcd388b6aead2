"""Profile-likelihood intervals: how far a quantity can be moved while all others follow.

An interval is the set of values that a fit with the quantity held there explains not much worse:
the deviance, cost over that of the least squares in units of the noise, stays below the quantile of
chi-squared with one degree of freedom. The parameters are no maximum of a likelihood whose errors
are white, so that the quantile is multiplied by the quantity's variance from the long-run
covariance over that of white noise (Chandler and Bate 2007, Biometrika 94). Where the cost is a
parabola this is the symmetric interval; it is one-sided where friction or a delay ends at nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from .intervals import CONFIDENCE, inverse
from .marquardt import Normal

REFITS = 8
"""Steps of the other parameters after the quantity."""
TRIES = 6
"""Values of a quantity on each side."""
NEAR = 0.03
"""Of the half-width: an end is found."""
FARTHEST = 30.0
"""Times the symmetric half-width, at which an end is given up: there is none."""


@dataclass
class Profile:
    """The cost around its least value.

    Attributes
    ----------
    normal, cost : callable
        Of parameters, shape (n,).
    x : array, shape (n,)
        The least squares.
    bounds : pair of array, shape (n,)
        Beyond which nothing is simulated.
    covariance : array, shape (n, n)
        Long-run covariance of `x`.
    count : int
        Residuals.
    """

    normal: Callable[[FloatArray], Normal]
    cost: Callable[[FloatArray], float]
    x: FloatArray
    bounds: tuple[FloatArray, FloatArray]
    covariance: FloatArray
    count: int

    def __post_init__(self) -> None:
        self.least, _, matrix = self.normal(self.x)
        self.inverse, _ = inverse(matrix)
        self.variance = max(self.least / self.count, 1e-300)

    def interval(
        self, quantity: Callable[[FloatArray], float], slope: FloatArray
    ) -> tuple[float, float]:
        """Both ends, infinite where there is none; `slope` (n,) is the gradient at `x`."""
        value = quantity(self.x)
        robust = float(slope @ self.covariance @ slope)
        white = float(slope @ self.inverse @ slope) * self.variance
        if not (math.isfinite(robust) and robust > 0.0 and white > 0.0):
            return value - math.inf, value + math.inf
        allowed = CONFIDENCE**2 * robust / white
        half = CONFIDENCE * math.sqrt(robust)
        low, high = (self._end(quantity, slope, s, half, allowed) for s in (-1.0, 1.0))
        return value - low, value + high

    def _end(
        self,
        quantity: Callable[[FloatArray], float],
        slope: FloatArray,
        side: float,
        half: float,
        allowed: float,
    ) -> float:
        """How far it goes on one side; the root of the deviance is close to a line through 0."""
        inside, beyond = (0.0, 0.0), (math.inf, math.inf)
        at = half
        for _ in range(TRIES):
            reached = math.sqrt(max(self._deviance(quantity, slope, side * at) / allowed, 0.0))
            if abs(reached - 1.0) < NEAR:
                return at
            if reached < 1.0:
                inside = max(inside, (at, reached))
            else:
                beyond = min(beyond, (at, reached))
            if beyond[0] < math.inf:
                share = (1.0 - inside[1]) / max(beyond[1] - inside[1], 1e-9)
                at = inside[0] + min(max(share, 0.1), 0.9) * (beyond[0] - inside[0])
                if not math.isfinite(at):
                    at = 0.5 * (inside[0] + beyond[0])
            else:
                at *= min(max(1.02 / max(reached, 1e-9), 1.1), 4.0)
                if at > FARTHEST * half:
                    return math.inf
        return at

    def _deviance(
        self, quantity: Callable[[FloatArray], float], slope: FloatArray, change: float
    ) -> float:
        """Least cost with the quantity held there, over the noise and above the least of all."""
        goal = quantity(self.x) + change
        along = self.inverse @ slope
        along = along / float(slope @ along)
        x = self._held(quantity, self.x + change * along, along, goal)
        cost = math.inf if x is None else self.cost(x)
        for _ in range(REFITS if x is not None and math.isfinite(cost) else 0):
            assert x is not None
            _, gradient, matrix = self.normal(x)
            inner, _ = inverse(matrix)
            across = inner @ slope
            step = -inner @ gradient + across * float(across @ gradient) / float(slope @ across)
            before = cost
            for share in (1.0, 0.4, 0.1, 0.03):  # on a broken line a whole step may miss
                trial = self._held(quantity, x + share * step, along, goal)
                if trial is not None and (after := self.cost(trial)) < cost:
                    x, cost = trial, after
                    break
            if (before - cost) / self.variance < 0.02:
                break
        return (cost - self.least) / self.variance

    def _held(
        self, quantity: Callable[[FloatArray], float], x: FloatArray, along: FloatArray, goal: float
    ) -> FloatArray | None:
        """Moved within the bounds until the quantity has its value; None where it cannot."""
        x = np.clip(x, *self.bounds)
        for _ in range(20):
            off = goal - quantity(x)
            if abs(off) <= 1e-9 * max(abs(goal), 1e-300):
                return x
            x = np.clip(x + off * along, *self.bounds)
        return x if abs(goal - quantity(x)) <= 1e-3 * abs(goal - quantity(self.x)) else None
