"""Statistical tests of a record: does the output integrate, was it made in a closed loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray, runs
from .pieces import LARGEST

if TYPE_CHECKING:
    from .dataset import Dataset


# --- Whether the output integrates an input -------------------------------------------------------


SCALES = ((60, 1), (200, 2), (1000, 4))
"""Numbers of blocks for the longest experiment, and past changes in the regression on them."""
LEAST_DIFFERENCES = 300
"""Least samples of the longest experiment for a test."""
NEGLIGIBLE = 0.5
"""Length of the record in time constants below which a pole cannot be told from 1."""
RESTORED = (3.0, 3.0, 6.0)
"""Standard errors by which a pole must lie inside the unit circle, at each of the scales.

More on the finest blocks, where sensor noise on the level looks like a restoring force.
"""
RESTORED_SHORT = 2.5
"""The same at every scale where the record is too short for the finest blocks."""
DRIVEN = 4.5
"""Standard errors by which the input must drive the change of the output."""
BALANCE, MOST_BALANCE = 0.2, 0.5
"""Largest ratio of restoring to driving part of the change: in the median of the scales, and at the
scale where the input drives most clearly."""
EXPLAINED = 0.35
"""Least part of the output, without its trend, that the integral of the input must explain."""
MOST_EXPERIMENTS = 50
TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Integration:
    """How an output that inputs drive returns to its level, over the whole record.
    `gain` is the output's change per second and unit of `input`, which drives it most clearly, at
    low frequencies. `time_constant` [s] is that of the slowest pole, a sum if several are slow, inf
    for an integral; `lengths` is the longest experiment in it, 0 or below for an integral. The pole
    lies inside by `restoring` standard errors, and the input drives the change by `driving`.
    """

    is_integral: bool
    input: int
    lengths: float
    time_constant: float
    gain: float
    restoring: float
    driving: float


def integration(data: Dataset) -> Integration | None:
    """Test for a pole at 1 that an input drives; None where the record is too short or still.
    An augmented Dickey-Fuller regression (D. Dickey, W. Fuller, J. American Statistical Association
    74 (1979) 427-431) with inputs, their squares, a line and the sign of the motion (dry friction)
    is solved over block means of three lengths. For an integral, no pole lies inside (`RESTORED`)
    and an input drives the change (`DRIVEN`, `BALANCE`) and explains the output (`EXPLAINED`).
    """
    experiments = sorted(data.experiments, key=len, reverse=True)[:MOST_EXPERIMENTS]
    longest = len(experiments[0])
    if longest < LEAST_DIFFERENCES:
        return None
    columns = [np.column_stack([e.u, e.y]) for e in experiments]
    found = []
    for blocks, past in SCALES:
        size = longest // blocks
        if size >= 1:
            means = [m for c in columns if len(m := _block_means(c, size)) > past + 2]
            scale = _scale(means, past, longest / size, data.Ts * size)
            found += [] if scale is None else [scale]
    if not found:
        return None
    return _together(found, data.Ts * longest)


@dataclass(frozen=True)
class _Scale:
    """The regression at one length of blocks, in deviations and records."""

    lengths: float
    error: float
    input: int
    driving: float
    balance: float
    explained: float
    gain: float

    @property
    def restoring(self) -> float:
        return (self.lengths - NEGLIGIBLE) / self.error if self.error > 0.0 else 0.0


def _together(found: list[_Scale], seconds: float) -> Integration:
    restored = max(found, key=lambda s: s.restoring)
    driven = max(found, key=lambda s: s.driving)
    whole = len(found) == len(SCALES)
    bounds = RESTORED if whole else (RESTORED_SHORT,) * len(found)
    is_integral = (
        all(s.restoring < bound for s, bound in zip(found, bounds, strict=True))
        and driven.driving > DRIVEN
        and float(np.median([s.balance for s in found])) < BALANCE
        and driven.balance < MOST_BALANCE
        and driven.explained > EXPLAINED
    )
    lengths = driven.lengths if is_integral else restored.lengths
    return Integration(
        is_integral=is_integral,
        input=driven.input,
        lengths=lengths,
        time_constant=math.inf if is_integral or lengths <= 0.0 else seconds / lengths,
        gain=driven.gain,
        restoring=restored.restoring,
        driving=driven.driving,
    )


def _block_means(columns: FloatArray, size: int) -> FloatArray:
    """Means of `size` samples each; NaN where fewer than half are known."""
    count = len(columns) // size
    cut = columns[: count * size].reshape(count, size, columns.shape[1])
    known = np.abs(cut) < LARGEST
    number = known.sum(axis=1)
    total = np.where(known, cut, 0.0).sum(axis=1)
    means: FloatArray = np.where(2 * number >= size, total / np.maximum(number, 1), np.nan)
    return means


def _scale(means: list[FloatArray], past: int, record: float, seconds: float) -> _Scale | None:
    """The regression over blocks, `record` of them in the longest experiment, `seconds` each."""
    everything = np.concatenate(means) if means else np.zeros((0, 2))
    everything = everything[np.isfinite(everything).all(axis=1)]
    if len(everything) < 40:
        return None
    middle, size = everything.mean(axis=0), everything.std(axis=0)
    moving = size > 1e-12 * np.abs(everything).max(axis=0)
    if not moving[-1] or not moving[:-1].any():
        return None
    inputs = np.flatnonzero(moving[:-1])
    with np.errstate(over="ignore"):
        scaled = [(m - middle)[:, moving] / size[moving] for m in means]
    # inputs at missing outputs are not scaled: their squares could overflow
    scaled = [np.where(np.abs(m) < LARGEST, m, np.nan) for m in scaled]
    changes = np.concatenate([np.diff(m[:, -1]) for m in scaled])
    spread = _deviation(changes)
    rows = np.concatenate([_rows(m, past, record, spread) for m in scaled])
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 2 * rows.shape[1]:
        return None
    theta, covariance = _least_squares(rows[:, 1:], rows[:, 0])
    left = 1.0 - float(theta[1 : 1 + past].sum())
    lags = past + 2
    driving, total = [], []
    for j in range(len(inputs)):
        window = slice(1 + past + j * lags, 1 + past + (j + 1) * lags)
        total.append(float(theta[window].sum()))
        variance = float(covariance[window, window].sum())
        driving.append(abs(total[-1]) / math.sqrt(max(variance, TINY)))
    j = int(np.argmax(driving))
    if left == 0.0 or total[j] == 0.0:
        return None
    gain = total[j] / left
    inputs_of = [np.where(np.isfinite(m[:, j]), m[:, j], 0.0) for m in scaled]
    integral = np.concatenate([_without_line(np.cumsum(u)) for u in inputs_of])
    output = np.concatenate([_without_line(m[:, -1]) for m in scaled])
    return _Scale(
        lengths=-float(theta[0]) / left * record,
        error=math.sqrt(max(float(covariance[0, 0]), 0.0)) / abs(left) * record,
        input=int(inputs[j]),
        driving=driving[j],
        balance=-float(theta[0]) / abs(total[j]),
        explained=abs(gain) * _deviation(integral) / max(_deviation(output), TINY),
        gain=float(gain * size[-1] / size[inputs[j]] / seconds),
    )


def _rows(scaled: FloatArray, past: int, record: float, spread: float) -> FloatArray:
    """[change, level, past changes, inputs, 1, time, sign of motion, squares] of each block."""
    y, u = scaled[:, -1], scaled[:, :-1]
    change = np.diff(y)
    k = np.arange(past, len(change))
    columns = [change[k], y[k], *(change[k - i] for i in range(1, past + 1))]
    for column in u.T:
        columns += [column[k + 1 - i] for i in range(past + 2)]
    moving = change / np.sqrt(change**2 + 0.01 * spread**2 + TINY)
    columns += [np.ones(len(k)), k / record - 0.5, moving[k - 1]]
    for column in u.T:
        size = np.abs(column[np.isfinite(column)])
        # the square of a two-level input is a constant
        if len(size) and np.ptp(size) > 0.05:
            columns += [column[k] ** 2, column[k - 1] ** 2]
        else:
            columns += [np.zeros(len(k)), np.zeros(len(k))]
    return np.stack(columns, axis=1)


def _least_squares(X: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters and their covariance; parameters that the columns do not determine are 0."""
    length = np.linalg.norm(X, axis=0)
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    left, values, right = np.linalg.svd(X * scale, full_matrices=False)
    keep = values > 1e-9 * values[0]
    back = right[keep].T / values[keep]
    theta = back @ (left[:, keep].T @ y)
    error = y - (X * scale) @ theta
    variance = float(error @ error) / max(len(y) - int(keep.sum()), 1)
    covariance = variance * (back @ back.T) * np.outer(scale, scale)
    return theta * scale, covariance


def _deviation(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.std()) if len(known) else 0.0


def _without_line(column: FloatArray) -> FloatArray:
    known = np.isfinite(column)
    k = np.arange(len(column)) - (len(column) - 1) / 2.0
    if known.sum() < 3:
        return column - column
    line: FloatArray = np.polyval(np.polyfit(k[known], column[known], 1), k)
    return column - line


# --- Whether a record was made in closed loop: noise of the output returns in an input ------------


PAST = 20
"""Past outputs and inputs in the regressions for the innovations; fewer with many inputs."""
LEADS = 10
"""Largest lead: samples after an innovation of the output within which an input is tested."""
AT_ONCE = 0.2
"""Largest part of the plant's response that a controller can mimic within a sample."""
SPANS = (1, 3, 10)
"""Samples over which that input is summed: a filter in the loop spreads the feedback."""
SIGNIFICANT = 4.2
"""Least significance of a correlation [standard errors]; chance reaches it in .1 % of records."""
OVER_MISFIT = 2.0
"""Least ratio to the largest correlation with the past, which only a misfit can cause."""
HELD = 0.5
"""Largest part of the samples in which a fed back input keeps its value to the last bit."""
MOST_SAMPLES = 20_000
LEAST = 300
_CLIP = 5.0
_EXACT = 1e-9
"""Innovation over standard deviation below which only rounding is left of a signal."""
_SMOOTH = 12


@dataclass(frozen=True)
class Feedback:
    """How one input follows the output's innovations, `lead` samples later.
    `correlation` is that of the innovations at this lead, and `significance` the same in standard
    errors. `misfit` is the largest correlation with the input's past beyond the regression, in
    standard errors.
    """

    input: int
    lead: int
    correlation: float
    significance: float
    misfit: float


def feedback(data: Dataset) -> Feedback | None:
    """The input with the clearest response to noise of the output; None if no input responds.
    Innovations of output and input correlate at positive leads only if the input was computed from
    the output (Granger 1969; Box, Jenkins, Reinsel 2008, section 12.1; standard errors: Newey, West
    1987). At lead 0 the signs of controller and plant differ. Only a misfit also correlates with
    the input's past. The output of a smoother is not tested (`Dataset.looks_ahead`).
    """
    pieces = [] if data.looks_ahead else _pieces(data)
    found: list[Feedback] = []
    for j in range(data.n_inputs):
        every = _sampling([p[:, j] for p in pieces])
        if every is None:
            continue
        step, kept = every
        thinned = [p[first::step] for p, first in zip(pieces, kept, strict=True)]
        thinned = [p for p in thinned if len(p) > 4 * (PAST + LEADS)]
        if sum(map(len, thinned)) >= LEAST:
            found += _of_input(thinned, j, step)
    return max(found, key=lambda f: f.significance, default=None)


def _pieces(data: Dataset) -> list[FloatArray]:
    """The longest runs without missing values, columns minus their means."""
    pieces: list[FloatArray] = []
    for e in sorted(data.experiments, key=len, reverse=True):
        columns = np.column_stack([e.u, e.y])
        known = np.logical_and.reduce(np.abs(columns) < LARGEST, axis=1)
        pieces += [columns[a : a + n] for a, n in runs(known) if n > 4 * (PAST + LEADS)]
    chosen, left = [], MOST_SAMPLES
    for piece in sorted(pieces, key=len, reverse=True):
        if left > 4 * (PAST + LEADS):
            chosen.append(piece[:left])
            left -= len(chosen[-1])
    if not chosen:
        return []
    everything = np.concatenate(chosen)
    middle, size = everything.mean(axis=0), everything.std(axis=0)
    scale = 1.0 / np.where(size > 0.0, size, 1.0)
    return [(piece - middle) * scale for piece in chosen]


def _sampling(column: list[FloatArray]) -> tuple[int, list[int]] | None:
    """Interval between changes of a held input and its offsets; None if it is not fed back."""
    if not column:
        return None
    low, high = min(float(p.min()) for p in column), max(float(p.max()) for p in column)
    # samples at a limit do not count as held
    free = [(piece[:-1] > low) & (piece[:-1] < high) for piece in column]
    changes = [np.diff(piece) != 0.0 for piece in column]
    count = sum(int((c & f).sum()) for c, f in zip(changes, free, strict=True))
    total = sum(int(f.sum()) for f in free)
    if total < LEAST:
        return None
    if count > (1.0 - HELD) * total:
        return 1, [0] * len(column)
    at = [np.flatnonzero(c) + 1 for c in changes]
    between = np.concatenate([np.diff(a) for a in at])
    if len(between) == 0:
        return None
    step = int(np.bincount(between).argmax())
    regular = float((between % step == 0).mean())
    if step < 2 or regular < 0.9 or count * step < (1.0 - HELD) * total:
        return None
    return step, [int(a[0]) % step if len(a) else 0 for a in at]


def _of_input(pieces: list[FloatArray], j: int, step: int) -> list[Feedback]:
    width = pieces[0].shape[1]
    past = max(3, min(PAST, 2 * (PAST + 1) // width))
    values = np.concatenate([p[past:] for p in pieces])
    lagged = np.concatenate([_lagged(p, past) for p in pieces])
    friction = np.concatenate([_motion(p[:, -1], past) for p in pieces])
    u, y = values[:, j], values[:, -1]
    e, response = _innovation(np.column_stack([lagged, friction]), u, y)
    w, _ = _innovation(lagged[:, j::width], u, u)
    if e is None or w is None:
        return []
    ends = np.cumsum([len(p) - past for p in pieces])[:-1]
    parts = list(zip(np.split(e, ends), np.split(w, ends), strict=True))
    misfit = max(
        abs(_correlation(parts, lag, span)[1])
        for span in SPANS
        for lag in range(-past - LEADS, -past - span + 1)
    )
    leads = [
        (lag, *_correlation(parts, lag, span))
        for span in SPANS
        for lag in range(1, LEADS + 2 - span)
    ]
    at_once, impulse = (0, *_correlation(parts, 0, 1)), _impulse(response, past, width, j)
    small = abs(impulse[0]) < AT_ONCE * float(np.abs(impulse).max())
    if small and at_once[1] * float(impulse.sum()) < 0.0:
        leads.append(at_once)
    lead, size, significance = max(leads, key=lambda found: abs(found[2]))
    if not abs(significance) > max(SIGNIFICANT, OVER_MISFIT * misfit):
        return []
    return [Feedback(j, lead * step, size, abs(significance), misfit)]


def _lagged(piece: FloatArray, past: int) -> FloatArray:
    """All columns one sample ago, two samples ago and so on, shape (N - past, past * width)."""
    k = np.arange(past, len(piece))
    return np.concatenate([piece[k - i] for i in range(1, past + 1)], axis=1)


def _motion(y: FloatArray, past: int) -> FloatArray:
    """Smoothed sign of the last two changes of the output."""
    change = np.diff(y)
    sign = change / np.sqrt(change**2 + 0.01 * change.var() + np.finfo(np.float64).tiny)
    k = np.arange(past, len(y))
    return np.column_stack([sign[k - 2], sign[k - 3]])


def _innovation(X: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray | None, Any]:
    """Clipped residual of y, and the coefficients with u as an additional column.
    The residual is None if it is only rounding.
    """
    X = np.column_stack([X, np.ones(len(X))])
    length = np.linalg.norm(X, axis=0)
    X /= np.where(length > 0.0, length, 1.0)
    R = np.asarray(np.linalg.qr(np.column_stack([X, u, y]), mode="r"), dtype=np.float64)
    n = X.shape[1]
    theta = np.linalg.lstsq(R[:, :n], R[:, -1], rcond=1e-13)[0]
    with_u = np.linalg.lstsq(R[:, : n + 1], R[:, -1], rcond=1e-13)[0]
    with_u[:n] /= np.where(length > 0.0, length, 1.0)
    left: FloatArray = y - X @ theta
    if not float(left.std()) > _EXACT * max(float(y.std()), np.finfo(np.float64).tiny):
        return None, with_u
    robust = 1.4826 * float(np.median(np.abs(left)))
    if robust > 0.0:
        left = np.clip(left, -_CLIP * robust, _CLIP * robust)
    return left - left.mean(), with_u


def _impulse(theta: FloatArray, past: int, width: int, j: int) -> FloatArray:
    """Response of the output to one sample of input j, from the same sample on, (past + 1,)."""
    lags: FloatArray = theta[: past * width].reshape(past, width)
    to_u, to_y = np.concatenate([theta[-1:], lags[:, j]]), lags[:, -1]
    response = np.zeros(past + 1)
    for k in range(past + 1):
        response[k] = to_u[k] + to_y[:k] @ response[:k][::-1]
    return response


def _correlation(
    parts: list[tuple[FloatArray, FloatArray]], lag: int, span: int
) -> tuple[float, float]:
    """Correlation of e(k) with w(k + lag) + .. + w(k + lag + span - 1), also in standard errors."""
    total, variance, e2, w2, n = 0.0, 0.0, 0.0, 0.0, 0
    for e, w in parts:
        sums = np.concatenate([[0.0], np.cumsum(w)])
        later = sums[span:] - sums[:-span]
        first, last = max(0, -lag), min(len(e), len(later) - lag)
        if last - first <= _SMOOTH:
            continue
        one, other = e[first:last], later[first + lag : last + lag]
        z = one * other
        total += float(z.sum())
        n += len(z)
        own = float(z @ z)
        between = sum(
            2.0 * (1.0 - i / (_SMOOTH + 1.0)) * float(z[i:] @ z[:-i]) for i in range(1, _SMOOTH + 1)
        )
        # at least the value without memory: a negative sum is chance
        variance += max(own + between, own)
        e2, w2 = e2 + float(one @ one), w2 + float(other @ other)
    if not (variance > 0.0 and e2 > 0.0 and w2 > 0.0):
        return 0.0, 0.0
    return total / math.sqrt(e2 * w2), total / math.sqrt(variance)
