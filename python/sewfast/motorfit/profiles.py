"""Profile-likelihood intervals: how far a quantity can go while all others follow it.

An interval by curvature is symmetric, and believes that the cost is a parabola. Here the quantity
is held away from its estimate, everything else is fitted again, and the ends are where the cost has
risen by as much as chance would let it (Venzon and Moolgavkar 1988, Applied Statistics 37). What is
left over is not white noise, so that the rise is measured by the ratio of the variance that the
scores show to the one that white noise would give (Chandler and Bate 2007, Biometrika 94).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from ..arrays import FloatArray
from .intervals import CONFIDENCE, inverse
from .marquardt import Normal, minimised
from .task import FINE, PARAMETERS, State, bounds_of
from .terms import Estimated

HELD = 100.0
"""Of the curvature of the cost along the quantity: what holds it, so that it gives way by 1 %."""
TRIES = 4
NEAR = 0.02
"""Of the way to an end, from which it is reached."""
LONGEST = 3.0
"""Times the step before, that the next guess may be."""
ITERATIONS = 12

Values = Mapping[str, float]


def profiled(
    found: Estimated, of: Callable[[Values], float], slope: FloatArray, half: float
) -> tuple[float, float]:
    """Ends of the 95 % interval of a quantity.

    Parameters
    ----------
    found : Estimated
        The least squares.
    of : callable
        The quantity, of all parameters by name and the resistance `R`.
    slope : array, shape (n,)
        Its derivatives by what is free.
    half : float
        Half-width of the interval by curvature, above 0: where the search begins.
    """
    task, state = found.task, found.state
    x = state.vector()
    start, _, matrix = task.normal(state)
    value = of(values_of(state))
    spread, _ = inverse(matrix)
    along = spread @ slope
    size = max(float(slope @ along), 1e-300)
    # cost that the end of an interval is above the minimum by
    rise = (half / CONFIDENCE) ** 2 / size * CONFIDENCE**2
    low, high = bounds_of(task, state)
    held = HELD / size
    ends = []
    for sign in (-1.0, 1.0):
        step, end = sign * half, value + sign * half
        for _ in range(TRIES):
            goal = value + step

            def normal(at: FloatArray, goal: float = goal) -> Normal:
                cost, gradient, gram = task.normal(state.at(at))
                off, by = _off(state.at(at), of, goal)
                return (
                    cost + held * off**2, gradient + held * off * by,
                    gram + held * np.outer(by, by),
                )  # fmt: skip

            def cost(at: FloatArray, goal: float = goal) -> float:
                off = of(values_of(state.at(at))) - goal
                return task.cost(state.at(at)) + held * off**2

            first = np.clip(x + step * along / size, low, high)
            if not math.isfinite(cost(first)):
                break
            reached = minimised(
                normal, cost, first, (low, high), task.count, enough=FINE, iterations=ITERATIONS
            ).x
            way = of(values_of(state.at(reached))) - value
            share = math.sqrt(max(task.cost(state.at(reached)) - start, 0.0) / rise)
            if way * sign <= 0.0:
                break
            end = value + way / max(share, 1.0 / LONGEST)
            if abs(share - 1.0) < NEAR:
                break
            step = end - value
        ends.append(end)
    return ends[0], ends[1]


def values_of(state: State) -> dict[str, float]:
    """All parameters by name, and the resistance."""
    known = dict(zip(PARAMETERS, state.theta.tolist(), strict=True))
    return known | {"R": math.nan if state.resistance is None else state.resistance}


def slope_of(
    known: Values, of: Callable[[Values], float], names: list[str], spreads: FloatArray
) -> FloatArray:
    """Derivatives of a quantity by what is free, (n,)."""
    slope = np.zeros(len(names))
    for j, name in enumerate(names):
        value = known[name]
        h = 1e-4 * abs(value) or max(min(1e-3 * float(spreads[j]), 1e-6), 1e-12)
        more, less = (of({**known, name: value + s * h}) for s in (1.0, -1.0))
        slope[j] = (more - less) / (2.0 * h)
    return slope


def _off(state: State, of: Callable[[Values], float], goal: float) -> tuple[float, FloatArray]:
    known, names = values_of(state), state.names()
    return of(known) - goal, slope_of(known, of, names, np.zeros(len(names)))
