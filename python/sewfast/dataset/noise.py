"""What one column says of its sensor: white noise, quantum, limits."""

from __future__ import annotations

import math

import numpy as np

from ..runs import runs
from .arrays import FloatArray

MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
STUCK = 3
"""Samples in a row at an extreme that count as at a limit."""
_GRID = 1e-3
_SAME = 1e-9


def white_noise(column: FloatArray) -> float:
    """Standard deviation of what changes from sample to sample without memory; NaN where unknown.

    From third differences, in which what is smooth over a few samples is small: their variance is
    20 times that of white noise. The median makes single jumps harmless.
    """
    changes = np.diff(column, 3)
    changes = changes[np.isfinite(changes)]
    if len(changes) < 4:
        return math.nan
    return MAD * float(np.median(np.abs(changes))) / math.sqrt(20.0)


def quantum(column: FloatArray) -> float | None:
    """The step of a grid on which all values lie; None where there is none.

    Only where at least three values occur twice or more on average: a few values of any kind lie on
    some grid.
    """
    values = np.unique(column[np.isfinite(column)])
    if len(values) < 3 or len(values) > 0.5 * np.isfinite(column).sum():
        return None
    steps = np.diff(values)
    step = float(steps[steps > _SAME * np.ptp(values)].min(initial=np.inf))
    if not math.isfinite(step):
        return None
    places = (values - values[0]) / step
    step *= float(places[-1] / round(places[-1]))
    places = (values - values[0]) / step
    on_grid = np.abs(places - np.round(places)).max() < max(_GRID, _SAME * places[-1])
    return step if on_grid else None


def share_at_limits(column: FloatArray) -> tuple[float, float]:
    """Parts of the known samples that stay at the smallest and at the largest value."""
    known = column[np.isfinite(column)]
    if len(known) == 0 or known.min() == known.max():
        return 0.0, 0.0
    margin = _SAME * np.ptp(known)
    sides = (known <= known.min() + margin, known >= known.max() - margin)
    low, high = (sum(n for _, n in runs(side) if n >= STUCK) / len(known) for side in sides)
    return low, high
