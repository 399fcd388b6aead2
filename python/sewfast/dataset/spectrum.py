"""Where the power of a signal lies."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..runs import runs
from .arrays import FloatArray

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
