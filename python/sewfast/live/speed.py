"""Speed from the change of counts over a window: what a view can know while a record runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..units import counts_per_unit

FloatArray = NDArray[np.float64]


def speed_over_window(counts: FloatArray, lag: int, Ts: float, counts_per_rev: float) -> FloatArray:
    """Mean speed [RPM] over the `lag` samples before each one.

    Parameters
    ----------
    counts : array, shape (N,)
        Accumulated counts; NaN where a sample is missing.
    lag : int
        Samples in the window, at least 1; one count over it is `60 / (lag Ts counts_per_rev)` RPM.
    Ts : float
        Sample time [s].
    counts_per_rev : float
        Counts per revolution.

    Returns
    -------
    array, shape (N - lag,)
        From the sample `lag` on; NaN where a sample of the window is missing, because a device
        that was reset in the gap counts from elsewhere.
    """
    missing = np.concatenate(([0], np.cumsum(np.isnan(counts))))
    whole = missing[lag + 1 :] == missing[: len(counts) - lag]
    change = counts[lag:] - counts[: len(counts) - lag]
    scale = 1.0 / (lag * Ts * counts_per_unit(counts_per_rev))
    return np.where(whole, change * scale, np.nan)
