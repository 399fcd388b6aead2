"""Speed from encoder counts: difference, Savitzky-Golay, Kalman/RTS smoother."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from . import _core
from .arrays import FloatArray, is_whole, runs
from .errors import DataError, SettingError
from .units import counts_per_unit

Method: TypeAlias = Literal["difference", "savgol", "kalman"]

#: Whole numbers above this are not exact in double precision.


def speed_from_counts(
    counts: ArrayLike,
    Ts: float,
    counts_per_rev: float,
    *,
    method: Method = "kalman",
    unit: str = "rpm",
    window: int = 41,
    order: int = 3,
    process_noise: float | None = None,
    ripple_orders: Sequence[int] = (1, 2, 3, 4),
    unwrap_bits: int | None = None,
) -> FloatArray:
    """Estimate the speed from the counts of an incremental encoder.

    Parameters
    ----------
    counts
        Accumulated counts, shape (N,), integers or floats: at least 2, ``window`` for ``savgol``,
        5 for ``kalman``.
    Ts
        Sample time [s].
    counts_per_rev
        Counts per revolution, after 4-fold evaluation.
    method
        ``difference``: backward difference, which shows every count (38.2 RPM at 1,572 counts/rev
        and 1 ms). ``savgol``: slope of a local polynomial [1]_. ``kalman``: smoother for a motion
        with white jerk [2]_, [3]_. The last two look ahead: for recordings, not for control.
    unit
        ``rpm``, ``rev/s``, ``rad/s`` or ``deg/s``.
    window, order
        For ``savgol``: odd number of samples, order of the polynomial.
    process_noise
        For ``kalman``: intensity of the jerk [unit^2/s^3]; None: estimated by maximum likelihood.
        Whole counts have a rounding variance of 1/12 count^2; for others it is estimated too.
    ripple_orders
        For ``kalman``: multiples of the shaft's turn, at most 6, at which the load can repeat, as
        with cranks and torque ripple [4]_; used if it makes the counts more likely. () disables it.
    unwrap_bits
        Width of a counter that wraps, for example 16.

    Returns
    -------
    ndarray
        Speed in ``unit``, float64, shape (N,).

    Raises
    ------
    DataError
        For counts that are not one column of finite real numbers, too few of them, or jumps near
        2^16 or 2^32, which show a wrapped counter.
    SettingError
        For settings outside their range.

    References
    ----------
    .. [1] A. Savitzky, M. J. E. Golay, Anal. Chem. 36 (1964) 1627-1639.
    .. [2] H. E. Rauch, F. Tung, C. T. Striebel, AIAA J. 3 (1965) 1445-1450.
    .. [3] P. R. Belanger, P. Dobrovolny, A. Helmy, X. Zhang, Int. J. Robotics Research 17 (1998)
       1225-1233.
    .. [4] H. Vold, J. Leuridan, SAE Technical Paper 931288 (1993).

    Examples
    --------
    >>> import numpy as np
    >>> counts = np.arange(100) * 2
    >>> speed_from_counts(counts, 0.001, 1572, method="difference")[:2].round(2)
    array([76.34, 76.34])
    """
    values = _column(counts)
    scale = {"Ts": float(Ts), "counts_per_unit": counts_per_unit(counts_per_rev, unit)}
    if unwrap_bits is not None:
        values = _core.unwrap_counts(values, bits=_whole("unwrap_bits", unwrap_bits))
    if method == "difference":
        return _core.speed_difference(values, **scale)
    if method == "savgol":
        window, order = _whole("window", window), _whole("order", order)
        return _core.speed_savgol(values, **scale, window=window, order=order)
    if method == "kalman":
        return _core.speed_kalman(
            values,
            **scale,
            process_noise=process_noise,
            ripple_orders=[_whole("ripple_orders", order) for order in ripple_orders],
            counts_per_rev=float(counts_per_rev),
        )
    raise SettingError(
        f"expected method {', '.join(get_args(Method))}, got {method!r}; choose one of them"
    )


def speed_between_gaps(
    counts: FloatArray, Ts: float, counts_per_rev: float, *, method: Method = "kalman"
) -> FloatArray:
    """As `speed_from_counts`, separately for each piece between gaps (NaN); shape (N,). The speed
    is NaN in gaps and in pieces too short for the method.
    """
    if not np.isnan(counts).any():
        return speed_from_counts(counts, Ts, counts_per_rev, method=method)
    # least consecutive counts for the Kalman smoother
    shortest = {"kalman": 5, "savgol": 41, "difference": 2}[method]
    pieces = [(a, n) for a, n in runs(~np.isnan(counts)) if n >= shortest]
    if not pieces:
        raise DataError(
            f"expected at least {shortest} encoder counts in a row, received gaps everywhere, the "
            f"first one at sample {int(np.argmax(np.isnan(counts)))} (0-based); record again"
        )
    speed = np.full(len(counts), np.nan)
    for first, count in pieces:
        piece = counts[first : first + count]
        speed[first : first + count] = speed_from_counts(piece, Ts, counts_per_rev, method=method)
    return speed


def speed_or_nan(
    counts: FloatArray, Ts: float, counts_per_rev: float, method: Method
) -> FloatArray:
    """As `speed_between_gaps`, all NaN if there are too few counts for a speed."""
    try:
        return speed_between_gaps(counts, Ts, counts_per_rev, method=method)
    except DataError:
        return np.full(len(counts), np.nan)


def floor_of_J(estimate: ArrayLike, truth: ArrayLike, y_scale: float = 1000.0) -> float:
    """The least J possible with a speed estimate: ``mean((estimate - truth)^2) / 2``, scaled (paper
    Eq. 4). A model with the exact true speed would still score this J against the estimate, so no
    honest J of a free run is lower. For raw differences of 1,572 counts/rev at 1 ms it is about
    1.2e-4. Both speeds (N,) have the same unit; the speed `y_scale` is 1 in the model's scaled
    units (the paper's is 1,000 RPM).
    """
    a, b = _column(estimate, "estimate"), _column(truth, "truth")
    if len(a) != len(b) or len(a) == 0:
        raise DataError(
            f"expected estimate and truth of one length above 0, got {len(a)} and {len(b)}; "
            "cut both to the same range"
        )
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise DataError("expected finite speeds, got NaN or infinity; cut or repair that part")
    if not (math.isfinite(y_scale) and y_scale > 0):
        raise SettingError(
            f"expected y_scale finite and above 0, got {y_scale}; the paper's is 1000"
        )
    return float(np.mean(((a - b) / y_scale) ** 2) / 2)


def _column(values: ArrayLike, name: str = "counts") -> FloatArray:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise DataError(f"expected {name} as one column, got a ragged list; {error}") from error
    if array.ndim != 1 or array.dtype.kind not in "iuf":
        raise DataError(
            f"expected {name} as real numbers of shape (N,), got {array.dtype} of shape "
            f"{array.shape}; pass one column of numbers"
        )
    if (
        array.dtype.kind in "iu"
        and array.size
        and max(-int(array.min()), int(array.max())) > (2**53)
    ):
        raise DataError(
            f"expected {name} of at most 2^53, got {array.min()} to {array.max()}; "
            "subtract the first count"
        )
    return np.ascontiguousarray(array, dtype=np.float64)


def _whole(name: str, value: int) -> int:
    if not is_whole(value):
        raise SettingError(f"expected {name} as a whole number, got {value!r}; give an int")
    if not 0 <= value < 2**32:
        raise SettingError(f"expected {name} of 0 to 2^32 - 1, got {value}; see the docstring")
    return int(value)
