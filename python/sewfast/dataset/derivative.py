"""The output's derivative: from a position to its speed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .. import _core
from ..errors import DataError, SettingError
from ..runs import runs
from .arrays import FloatArray, frozen
from .checks import require_sane
from .gaps import interpolated
from .noise import quantum, white_noise
from .trends import Trend
from .weights import without_weightless

if TYPE_CHECKING:
    from ..speed import Method
    from .dataset import Dataset
    from .experiment import Experiment

SHORTEST = {"kalman": 5, "savgol": 41, "difference": 2}
"""Samples in a row that each method needs."""
BRIDGED = 5
"""Samples without a value that a smoother is led across."""
_HOW = {
    "kalman": "by a Kalman smoother, without delay",
    "savgol": "by the slope of a cubic over 41 samples, without delay",
    "difference": "by differences to the sample before, half a sample late",
}


def differentiate(data: Dataset, *, method: Method = "kalman") -> Dataset:
    """The data with the output's derivative per second in its place: of a position, its speed.

    A model of a position has to integrate, and small errors of its speed add up; a model of the
    speed has a steady state, and a controller of the position needs no more. The unit follows: deg
    becomes deg/s, m/s becomes m/s^2, an unknown unit stays unknown. Inputs and channels stay.

    Parameters
    ----------
    method : {"kalman", "savgol", "difference"}
        As for `sewfast.speed_from_counts`. `kalman`: a smoother for motion with white jerk, whose
        noise and jerk are found by maximum likelihood: sensor noise and rounding are smoothed as
        much as each record asks for, whole counts are taken as exact to their rounding. `savgol`:
        slope of a cubic through 41 samples. Neither delays; both look ahead, so the result begins
        to move some samples before the input does. `difference`: to the sample before, half a
        sample late, with all of the noise; the only one that a controller has too.

    Returns
    -------
    Dataset
        NaN where the output was not measured, or has weight 0. Up to 5 missing samples are bridged
        by a straight line for the smoother; longer gaps part the record, and pieces shorter than
        the method needs (5, 41 or 2 samples) become NaN.

    Raises
    ------
    SettingError
        For another method.
    DataError
        Where no piece is long enough, or the output jumps as a counter that wraps.

    Examples
    --------
    >>> import numpy as np
    >>> from sewfast.dataset import Dataset
    >>> data = Dataset.from_arrays(np.ones(100), 3.0 * np.arange(100), 0.01, output_unit="deg")
    >>> speed = data.differentiate()
    >>> speed.output_unit, bool(np.allclose(speed.experiments[0].y, 300.0))
    ('deg/s', True)
    """
    if method not in SHORTEST:
        raise SettingError(
            f"differentiate: expected the method {', '.join(SHORTEST)}, received {method!r}"
        )
    require_sane(data)
    experiments = tuple(_differentiated(e, data, method) for e in data.experiments)
    unit = rate_unit(data.output_unit)
    units = f" from {data.output_unit} to {unit}" if unit else ""
    note = f"output {data.output_name} differentiated{units} {_HOW[method]}"
    lost = sum(e.unmeasured for e in experiments) - sum(e.unmeasured for e in data.experiments)
    note += f"; {lost} outputs in short pieces lost" if lost else ""
    return replace(
        data,
        experiments=experiments,
        output_unit=unit,
        counts=None,
        notes=(*data.notes, note),
        looks_ahead=data.looks_ahead or method != "difference",
    )


def rate_unit(unit: str) -> str:
    """The unit of a derivative per second; unknown stays unknown.

    Examples
    --------
    >>> [rate_unit(unit) for unit in ("deg", "mm/s", "m/s^2", "")]
    ['deg/s', 'mm/s^2', 'm/s^3', '']
    """
    head, slash, power = unit.rpartition("/s")
    if slash and not power:
        return f"{head}/s^2"
    if slash and power.startswith("^") and power[1:].isdigit():
        return f"{head}/s^{int(power[1:]) + 1}"
    return f"{unit}/s" if unit else ""


def _differentiated(e: Experiment, data: Dataset, method: Method) -> Experiment:
    e = without_weightless(e)
    known = np.isfinite(e.y)
    bridged = known.copy()
    for first, count in runs(~known):
        inside = first > 0 and first + count < len(e)
        bridged[first : first + count] = inside and count <= BRIDGED and method != "difference"
    pieces = [(a, n) for a, n in runs(bridged) if n >= SHORTEST[method]]
    if not pieces:
        raise DataError(
            f"{e.name} [{e.range_text}], output {data.output_name!r}: expected "
            f"{SHORTEST[method]} samples in a row to differentiate, received {e.counted}; leave "
            "this experiment out"
        )
    filled, rate = interpolated(e.y), np.full(len(e), np.nan)
    for first, count in pieces:
        piece = filled[first : first + count]
        try:
            rate[first : first + count] = _rate(piece - piece[0], data.Ts, method)
        except DataError as error:
            raise DataError(
                f"{e.name} [{e.range_text}], output {data.output_name!r}: {error}"
            ) from error
    rate[~known] = np.nan
    return replace(e, y=frozen(rate), removed=_removed(e, data.Ts))


def _rate(y: FloatArray, Ts: float, method: Method) -> FloatArray:
    y = np.ascontiguousarray(y)
    if method == "difference":
        return _core.speed_difference(y, Ts=Ts, counts_per_unit=1.0)
    if method == "savgol":
        return _core.speed_savgol(y, Ts=Ts, counts_per_unit=1.0, window=41, order=3)
    size, y = _in_steps(y)
    rate = _core.speed_kalman(
        y, Ts=Ts, counts_per_unit=1.0, process_noise=None, ripple_orders=[], counts_per_rev=1.0
    )
    return size * rate


def _in_steps(y: FloatArray) -> tuple[float, FloatArray]:
    """A step of the sensor and the position in such steps, as the smoother expects counts.

    On a grid the step is the grid's, and the position a whole number, which the smoother takes as
    exact to its rounding. Otherwise it is the white part of the position: the smoother looks for
    noise and jerk over many decades around 1.
    """
    if bool((y == np.round(y)).all()):
        return 1.0, y
    step = quantum(y)
    if step is not None:
        return step, np.round(y / step)
    step = float(np.nan_to_num(white_noise(y)))
    step = max(step, 1e-9 * float(np.ptp(y)), float(np.finfo(np.float64).tiny))
    return step, y / step


def _removed(e: Experiment, Ts: float) -> Trend | None:
    """The line that was taken off the output has its slope as a derivative, and no drift."""
    if e.removed is None:
        return None
    level, slope = e.removed.level.copy(), e.removed.slope.copy()
    level[-1], slope[-1] = slope[-1] / Ts, 0.0
    return Trend(frozen(level), frozen(slope))
