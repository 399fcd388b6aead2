"""What one column says by itself: noise, quantum, limits, spectrum."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from ..arrays import FloatArray, runs

# --- What one column says of its sensor: white noise, quantum, limits -----------------------------


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


# --- Where the power of a signal lies -------------------------------------------------------------


LONGEST = 4096
"""Samples of a segment at most (Welch 1967)."""
SHORTEST = 32
LOW, HIGH, TOP = 0.05, 0.95, 0.999
"""Parts of the power below the band, below its upper end, and below the top of what is there."""


def power_spectrum(columns: Iterable[FloatArray], Ts: float) -> tuple[FloatArray, FloatArray]:
    """Power density of one signal over pieces without gaps, by Welch's method.

    Segments of one length overlap by half, lose their mean and stand under a Hann window.

    Returns
    -------
    frequency, power : array, shape (M,)
        [Hz] and [unit^2/Hz], without frequency 0; empty where no piece has 32 samples.
    """
    pieces = [c[a : a + n] for c in columns for a, n in runs(np.isfinite(c)) if n >= SHORTEST]
    if not pieces:
        return np.zeros(0), np.zeros(0)
    length = min(LONGEST, 2 ** int(np.log2(max(map(len, pieces)))))
    window = np.hanning(length + 1)[:-1]
    total, count = np.zeros(length // 2 + 1), 0
    for piece in pieces:
        for start in range(0, len(piece) - length + 1, length // 2):
            segment = piece[start : start + length]
            total += np.abs(np.fft.rfft(window * (segment - segment.mean()))) ** 2
            count += 1
    power = 2.0 * Ts * total / (count * (window @ window))
    frequency: FloatArray = np.arange(1, len(power)) / (length * Ts)
    return frequency, power[1:]


def band(frequency: FloatArray, power: FloatArray) -> tuple[float, float] | None:
    """Frequencies [Hz] about the middle 90 % of the power; None where there is no power."""
    if len(power) == 0 or not power.sum() > 0.0:
        return None
    below = np.cumsum(power) / power.sum()
    low, high = np.searchsorted(below, [LOW, HIGH])
    return float(frequency[low]), float(frequency[min(high, len(frequency) - 1)])


def top(frequency: FloatArray, power: FloatArray) -> float | None:
    """Frequency [Hz] below which 99.9 % of the power lies."""
    if len(power) == 0 or not power.sum() > 0.0:
        return None
    found = int(np.searchsorted(np.cumsum(power) / power.sum(), TOP))
    return float(frequency[min(found, len(frequency) - 1)])
