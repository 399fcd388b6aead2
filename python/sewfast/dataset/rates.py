"""Another sample time, and the derivative from a position to its speed."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray, bridged, frozen, runs
from ..errors import DataError, SettingError, located
from .experiment import without_weightless
from .outliers import quantum, white_noise
from .pieces import require_sane
from .trends import Trend

if TYPE_CHECKING:
    from ..speed import Method
    from .dataset import Dataset
    from .experiment import Experiment


# --- Another sample time: outputs filtered, held inputs averaged ----------------------------------


REACH = 10
"""Half width of the filter, in samples of the slower rate."""


def resample(
    data: Dataset,
    Ts: float,
    *,
    inputs: Literal["held", "sampled"] = "held",
    antialias: bool = True,
) -> Dataset:
    """The data at another sample time, slower or faster, by any ratio.

    New sample j is at `t = j Ts` from the first sample of its experiment. The output there is the
    result of a zero-phase low-pass filter (a sinc under a Kaiser window) at the Nyquist frequency
    of the slower of both rates: frequencies that a slower rate cannot show are removed instead of
    aliased.

    Parameters
    ----------
    Ts : float
        New sample time [s].
    inputs : {"held", "sampled"}
        `held`: the input was commanded and held from sample to sample; the new value is its mean
        over the new period, so that as much acts on the plant as before. `sampled`: the input was
        measured like the output, and is filtered like it.
    antialias : bool
        False takes the output as it is at the new times, without a filter (between two samples, by
        a straight line): for data without anything above the new Nyquist frequency, noise included.

    Returns
    -------
    Dataset
        A new output is NaN where at most half of the old ones around it were measured; a new input
        wherever a part of its period is unknown. An old output of weight 0 counts as not measured;
        a new weight is the mean of the old ones around it.

    Raises
    ------
    SettingError
        For a sample time that is no positive number or makes over 100 million samples, or another
        `inputs`.
    DataError
        If an experiment is shorter than one new period.
    """
    most_samples = 100_000_000
    if isinstance(Ts, bool) or not isinstance(Ts, (int, float, np.number)):
        raise SettingError(f"resample: expected a sample time in seconds, received {Ts!r}")
    if not (math.isfinite(Ts) and Ts > 0.0):
        raise SettingError(f"resample: expected a positive sample time in seconds, received {Ts}")
    if inputs not in ("held", "sampled"):
        raise SettingError(f"inputs: expected 'held' or 'sampled', received {inputs!r}")
    require_sane(data)
    ratio = _rounded(float(Ts) / data.Ts)
    if ratio == 1.0:
        return data
    if len(data) / ratio > most_samples:
        raise SettingError(
            f"resample: Ts = {Ts:g} s makes {len(data) / ratio:.3g} samples, expected at most "
            f"{most_samples:,}; give a longer sample time"
        )
    experiments = tuple(_resampled(e, ratio, inputs, antialias) for e in data.experiments)
    note = f"resampled from Ts = {data.Ts:g} s to {Ts:g} s, inputs {inputs}"
    note += "" if antialias else ", without a filter"
    if antialias and inputs == "held" and all(_is_held(e.u, ratio) for e in data.experiments):
        note += "; every input is constant over whole new periods: antialias=False is exact"
    return replace(
        data,
        experiments=experiments,
        Ts=float(Ts),
        notes=(*data.notes, note),
        looks_ahead=data.looks_ahead or antialias,
    )


def _rounded(ratio: float) -> float:
    """The ratio, made whole if only rounding separates it from a whole number."""
    for whole in (round(ratio), 1.0 / max(round(1.0 / ratio), 1)):
        if whole > 0 and abs(ratio / whole - 1.0) < 1e-9:
            return float(whole)
    return ratio


def _is_held(u: FloatArray, ratio: float) -> bool:
    """Whether the inputs change at the beginning of a new period only, over more than one."""
    if ratio < 2.0 or not ratio.is_integer() or len(u) < 2 * ratio:
        return False
    changed = np.flatnonzero((np.diff(u, axis=0) != 0.0).any(axis=1)) + 1
    return len(changed) > 0 and not (changed % int(ratio)).any()


def _resampled(e: Experiment, ratio: float, inputs: str, antialias: bool) -> Experiment:
    count = math.floor(len(e) / ratio + 1e-9)
    if count < 1:
        raise DataError(
            f"{e.name} [{e.range_text}]: expected at least one new period, received {len(e)} "
            f"samples of a {ratio:g}th of it; leave this experiment out"
        )

    def output(column: FloatArray) -> FloatArray:
        return frozen(_at_times(column, ratio, count, antialias))

    def held(column: FloatArray) -> FloatArray:
        return _period_means(column, ratio, count)

    e = without_weightless(e)
    u = np.column_stack([held(c) if inputs == "held" else output(c) for c in e.u.T])
    start = round(e.start / ratio)
    return replace(
        e,
        u=frozen(u),
        y=output(e.y),
        channels={name: output(c) for name, c in e.channels.items()},
        start=start,
        removed=_rescaled(e, ratio, start, inputs),
        weights=None if e.weights is None else frozen(_around(e.weights, ratio, count)),
    )


def _rescaled(e: Experiment, ratio: float, start: int, inputs: str) -> Trend | None:
    """The removed line, per new sample."""
    if e.removed is None:
        return None
    at = np.full(len(e.removed.level), float(e.start))
    if inputs == "held":
        at[:-1] += 0.5 * (ratio - 1.0)
    level = e.removed.level + e.removed.slope * (at - ratio * start)
    return Trend(frozen(level), frozen(e.removed.slope * ratio))


def _period_means(column: FloatArray, ratio: float, count: int) -> FloatArray:
    """Mean over each new period of a column that is held from sample to sample."""
    if ratio.is_integer():
        whole = int(ratio)
        means: FloatArray = column[: count * whole].reshape(count, whole).mean(axis=1)
        return means
    known = np.isfinite(column)
    middle = column[known].mean() if known.any() else 0.0
    edges = np.minimum(np.arange(count + 1) * ratio, len(column))
    found = middle + _integrals(np.where(known, column - middle, 0.0), edges) / ratio
    unknown = _integrals((~known).astype(np.float64), edges) > 1e-9
    return np.where(unknown, np.nan, found)


def _integrals(column: FloatArray, edges: FloatArray) -> FloatArray:
    total = np.concatenate([[0.0], np.cumsum(column)])
    return np.diff(np.interp(edges, np.arange(len(total)), total))


def _at_times(column: FloatArray, ratio: float, count: int, antialias: bool) -> FloatArray:
    """A sampled column at the new times, NaN where too little of it was measured there."""
    known = np.isfinite(column)
    if not known.any():
        return np.full(count, np.nan)
    times = np.minimum(np.arange(count) * ratio, len(column) - 1.0)
    filled = bridged(column)
    if antialias:
        values = _low_passed(filled, times, max(1.0, ratio))
    else:
        values = np.interp(times, np.arange(len(column)), filled)
    return np.where(_around(known, ratio, count) > 0.5, values, np.nan)


def _around(values: FloatArray | NDArray[np.bool_], ratio: float, count: int) -> FloatArray:
    """Mean of the old samples' values around each new one."""
    last = len(values) - 1
    times = np.minimum(np.arange(count) * ratio, float(last))
    low = np.minimum(np.floor(times), np.ceil(times - 0.5 * ratio))
    high = np.maximum(np.ceil(times), np.floor(times + 0.5 * ratio))
    low, high = (np.clip(edge, 0, last).astype(np.int64) for edge in (low, high))
    total = np.concatenate([[0], np.cumsum(values)])
    mean: FloatArray = (total[high + 1] - total[low]) / (high + 1.0 - low)
    return np.maximum(mean, 0.0)


def _low_passed(column: FloatArray, times: FloatArray, scale: float) -> FloatArray:
    """The column behind a zero-phase low-pass of `1/scale` of its Nyquist frequency, at `times`."""
    reach = math.ceil(REACH * scale)
    padded = _extended(column, reach + 1)
    offsets = np.arange(-reach, reach + 2)
    found = np.empty(len(times))
    # numbers at once, for the memory
    rows = max(1, 2_000_000 // len(offsets))
    for first in range(0, len(times), rows):
        t = times[first : first + rows]
        whole = np.floor(t).astype(np.int64)
        # few distinct fractions if the ratio is rational
        phases, which = np.unique(np.round(t - whole, 12), return_inverse=True)
        weights = _weights((phases[:, None] - offsets) / scale)
        values = padded[whole[:, None] + offsets + reach + 1]
        found[first : first + rows] = np.einsum("ij,ij->i", weights[which], values)
    return found


def _weights(x: FloatArray) -> FloatArray:
    """Sinc under a Kaiser window; each row has the sum 1, so that a constant stays one."""
    inside = np.clip(1.0 - (x / REACH) ** 2, 0.0, None)
    # the window's beta: 60 dB (Kaiser 1974); passband to .8, stopband from 1.2 of the Nyquist rate
    weights = np.where(np.abs(x) < REACH, np.sinc(x) * np.i0(5.653 * np.sqrt(inside)), 0.0)
    scaled: FloatArray = weights / weights.sum(axis=1, keepdims=True)
    return scaled


def _extended(column: FloatArray, reach: int) -> FloatArray:
    """The column continued at both ends by its reflection in the end points, as far as it goes."""
    turn = min(reach, len(column) - 1)
    before = 2.0 * column[0] - column[turn:0:-1]
    after = 2.0 * column[-1] - column[::-1][1 : turn + 1]
    return np.pad(np.concatenate([before, column, after]), reach - turn, mode="edge")


# --- The output's derivative: from a position to its speed ----------------------------------------


SHORTEST = {"kalman": 5, "savgol": 41, "difference": 2}
"""Samples in a row that each method needs."""
_HOW = {
    "kalman": "by a Kalman smoother, without delay",
    "savgol": "by the slope of a cubic over 41 samples, without delay",
    "difference": "by differences to the sample before, half a sample late",
}


def differentiate(data: Dataset, *, method: Method = "kalman") -> Dataset:
    """The data with the output's derivative per second in its place: of a position, its speed.

    A model of a position has to integrate, and small errors of its speed add up; a model of the
    speed has a steady state, which is enough for a controller of the position. The unit follows:
    deg becomes deg/s, m/s becomes m/s^2, an unknown unit stays unknown. Inputs and channels stay.

    Parameters
    ----------
    method : {"kalman", "savgol", "difference"}
        As for `sewfast.speed_from_counts`. `kalman`: a smoother for motion with white jerk, whose
        noise and jerk are estimated by maximum likelihood: smoothing adapts to the sensor noise and
        rounding of each record, and whole counts are exact to their rounding. `savgol`: slope of a
        cubic through 41 samples. Neither delays; both look ahead, so the result begins to move some
        samples before the input does. `difference`: to the previous sample, half a sample late,
        with all of the noise; the only method that a controller can use as well.

    Returns
    -------
    Dataset
        NaN where the output was not measured, or has weight 0. Up to 5 missing samples are bridged
        by a straight line for the smoother; longer gaps split the record, and pieces shorter than
        the method needs (5, 41 or 2 samples) become NaN.

    Raises
    ------
    SettingError
        For another method.
    DataError
        If no piece is long enough, or the output jumps as a counter that wraps.

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
    """The unit of a derivative per second, m/s^3 for m/s^2; unknown stays unknown."""
    head, slash, power = unit.rpartition("/s")
    if slash and not power:
        return f"{head}/s^2"
    if slash and power.startswith("^") and power[1:].isdigit():
        return f"{head}/s^{int(power[1:]) + 1}"
    return f"{unit}/s" if unit else ""


def _differentiated(e: Experiment, data: Dataset, method: Method) -> Experiment:
    e = without_weightless(e)
    known = np.isfinite(e.y)
    joined = known.copy()
    for first, count in runs(~known):
        inside = first > 0 and first + count < len(e)
        # most missing samples that the smoother bridges
        joined[first : first + count] = inside and count <= 5 and method != "difference"
    pieces = [(a, n) for a, n in runs(joined) if n >= SHORTEST[method]]
    if not pieces:
        raise DataError(
            f"{e.name} [{e.range_text}], output {data.output_name!r}: expected "
            f"{SHORTEST[method]} samples in a row to differentiate, received {e.counted}; leave "
            "this experiment out"
        )
    filled, rate = bridged(e.y), np.full(len(e), np.nan)
    for first, count in pieces:
        piece = filled[first : first + count]
        try:
            rate[first : first + count] = _rate(piece - piece[0], data.Ts, method)
        except DataError as error:
            raise located(
                DataError, f"{e.name} [{e.range_text}], output {data.output_name!r}", error
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
    """The sensor's step and the position in such steps: the smoother expects counts.
    For values on a grid the step is the grid's, and the positions are whole numbers, which the
    smoother takes as exact to their rounding. Otherwise it is the white noise of the position: the
    smoother searches noise and jerk over many decades around 1.
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
    """The derivative of the removed line: its slope as a level, without drift."""
    if e.removed is None:
        return None
    level, slope = e.removed.level.copy(), e.removed.slope.copy()
    level[-1], slope[-1] = slope[-1] / Ts, 0.0
    return Trend(frozen(level), frozen(slope))
