"""Offsets and drift: removed from data, kept, and added again to a model's outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray, frozen
from ..errors import DataError, SettingError
from .pieces import require_sane

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment


@dataclass(frozen=True, eq=False)
class Trend:
    """The lines removed from an experiment: one per column, inputs first, output last.
    `level` and `slope` (n_inputs + 1,) are the value at sample 0 of the recording and the change
    per sample [column's unit].
    """

    level: FloatArray
    slope: FloatArray

    def lines(self, e: Experiment) -> FloatArray:
        """The removed values of each sample, shape (N, n_inputs + 1)."""
        index = np.arange(e.start, e.start + len(e), dtype=np.float64)
        lines: FloatArray = self.level + self.slope * index[:, None]
        return lines

    def is_offset(self, level: FloatArray) -> bool:
        """Whether the trend is this constant, without slope."""
        return not self.slope.any() and np.array_equal(self.level, level)

    def plus(self, other: Trend | None) -> Trend:
        return self if other is None else Trend(self.level + other.level, self.slope + other.slope)


def detrend(
    data: Dataset, order: Literal[0, 1, "steady"] = 1, *, like: Dataset | None = None
) -> Dataset:
    """The data without offset or drift; what is removed is kept for `restore`.

    Models of this package have their own offset, so a constant need not be removed for them. Remove
    it for a model of deviations from an operating point, and a line if a sensor drifts.

    Parameters
    ----------
    order : {0, 1, "steady"}
        0: the mean of each column over all experiments, one operating point. 1: a straight line
        through each column of each experiment, by least squares. "steady": in each experiment the
        level at rest, before an input first moves.
    like : Dataset or None
        A result of `detrend` with one and the same offset for all its experiments: remove that
        offset, as for validation data. `order` is then ignored.

    Returns
    -------
    Dataset
        Channels stay as they are: they are not known to be in the output's unit.

    Raises
    ------
    SettingError
        For another order, or a `like` whose offset is not one and the same constant.
    DataError
        If a column has no value, or an experiment does not begin at rest.
    """
    require_sane(data)
    if like is not None:
        trends = [_offset_of(like, data)] * len(data.experiments)
        how = f"offsets of {like.source}"
    elif order == "steady":
        trends, how = [_rest(e, data) for e in data.experiments], "level at rest"
    elif order in (0, 1) and not isinstance(order, bool):
        trends = [_mean(data)] * len(data.experiments) if order == 0 else _lines(data)
        how = "mean of all experiments" if order == 0 else "straight line"
    else:
        raise SettingError(f"detrend: expected order 0, 1 or 'steady', received {order!r}")
    pairs = list(zip(data.experiments, trends, strict=True))
    notes = [f"{e.name} [{e.range_text}]: {how} taken off, {_shown(e, t, data)}" for e, t in pairs]
    experiments = tuple(_without(e, t) for e, t in pairs)
    return replace(data, experiments=experiments, notes=(*data.notes, *notes))


def restore(data: Dataset, outputs: Sequence[ArrayLike]) -> list[FloatArray]:
    """Outputs of a model of detrended data, with the removed offset or line added again.

    Parameters
    ----------
    outputs : sequence of array, shape (N,)
        One per experiment, as `Model.simulate` and `Model.predict` return them for these data.

    Raises
    ------
    DataError
        If their number or a length is not that of the experiments.
    """
    if len(outputs) != len(data.experiments):
        raise DataError(
            f"restore: expected {len(data.experiments)} outputs, one per experiment, received "
            f"{len(outputs)}"
        )
    restored = []
    for e, output in zip(data.experiments, outputs, strict=True):
        y = np.asarray(output, dtype=np.float64)
        if y.shape != (len(e),):
            raise DataError(
                f"{e.name}: expected an output of shape ({len(e)},), received {y.shape}"
            )
        restored.append(y.copy() if e.removed is None else y + e.removed.lines(e)[:, -1])
    return restored


def _columns(e: Experiment) -> FloatArray:
    return np.column_stack([e.u, e.y])


def _without(e: Experiment, trend: Trend) -> Experiment:
    left = _columns(e) - trend.lines(e)
    return replace(e, u=frozen(left[:, :-1]), y=frozen(left[:, -1]), removed=trend.plus(e.removed))


def _names(data: Dataset) -> tuple[str, ...]:
    return (*data.input_names, data.output_name)


def _mean(data: Dataset) -> Trend:
    level = []
    for name, column in zip(
        _names(data), np.concatenate([_columns(e) for e in data.experiments]).T, strict=True
    ):
        known = column[np.isfinite(column)]
        if len(known) == 0:
            raise DataError(
                name=f"{data.source}: {name!r}", expected="a value for a mean",
                received="none", remedy="leave this column out",
            )  # fmt: skip
        level.append(known.mean())
    return Trend(frozen(np.array(level)), frozen(np.zeros(len(level))))


def _lines(data: Dataset) -> list[Trend]:
    trends = []
    for e in data.experiments:
        index = np.arange(e.start, e.start + len(e), dtype=np.float64)
        lines = [
            _line(index, column, f"{e.name}: {name!r}")
            for name, column in zip(_names(data), _columns(e).T, strict=True)
        ]
        level, slope = np.array(lines).T
        trends.append(Trend(frozen(level), frozen(slope)))
    return trends


def _line(index: FloatArray, column: FloatArray, what: str) -> tuple[float, float]:
    """Level at index 0 and slope, by least squares about the mean index."""
    known = np.isfinite(column)
    if known.sum() < 2:
        raise DataError(
            f"{what}: expected at least 2 values to draw a line through, received {known.sum()}; "
            "use order 0, or leave this experiment out"
        )
    k, values = index[known] - index[known].mean(), column[known]
    slope = float(k @ (values - values.mean()) / (k @ k))
    return float(values.mean() - slope * index[known].mean()), slope


def _rest(e: Experiment, data: Dataset) -> Trend:
    # least samples at rest at the beginning for `steady`
    least_rest = 20
    n = _samples_at_rest(e)
    half = slice(n // 2, n)
    y = e.y[half][np.isfinite(e.y[half])]
    if n < least_rest or len(y) < least_rest // 4:
        raise DataError(
            f"{e.name} [{e.range_text}]: expected at least {least_rest} samples at rest before an "
            f"input moves, received {n} with {len(y)} measured in their second half; record with a "
            "rest before the excitation, or use order 0"
        )
    spread = np.ptp(e.y[np.isfinite(e.y)])
    drift = abs(y[: len(y) // 2].mean() - y[len(y) // 2 :].mean())
    # part of its range by which the output can drift over the second half of the rest
    if drift > 0.05 * spread > 0.0:
        raise DataError(
            f"{e.name} [{e.range_text}]: expected an output that has settled before the input "
            f"moves, but it still moves by {drift:g} of a range of {spread:g}; wait longer before "
            "the excitation, or use order 0"
        )
    level = [*np.nanmean(e.u[half], axis=0), y.mean()]
    return Trend(frozen(np.array(level)), frozen(np.zeros(data.n_inputs + 1)))


def _samples_at_rest(e: Experiment) -> int:
    """Samples before any input first leaves its first values."""
    moved = np.zeros(len(e), dtype=np.bool_)
    for column in e.u.T:
        known = column[np.isfinite(column)]
        if len(known) == 0:
            return 0
        off = np.abs(column - np.median(known[:10]))
        # part of its range by which an input at rest can differ from its first value
        moved |= ~(off <= 0.02 * np.ptp(known))
    return int(np.argmax(moved)) if moved.any() else len(e)


def _offset_of(like: Dataset, data: Dataset) -> Trend:
    if like.n_inputs != data.n_inputs:
        raise SettingError(
            f"detrend: expected `like` with {data.n_inputs} inputs, received {like.n_inputs}"
        )
    trends = [e.removed for e in like.experiments]
    first = trends[0]
    if first is None or not all(t is not None and t.is_offset(first.level) for t in trends):
        raise SettingError(
            "detrend: expected a `like` from which one constant offset was taken off in all "
            "experiments (order 0); a line, or a level per experiment, does not apply to other data"
        )
    return first


def _shown(e: Experiment, trend: Trend, data: Dataset) -> str:
    def one(name: str, level: float, slope: float) -> str:
        first = level + slope * e.start
        if slope == 0.0:
            return f"{name} {first:.6g}"
        return f"{name} {first:.6g} to {first + slope * (len(e) - 1):.6g}"

    return ", ".join(map(one, _names(data), trend.level.tolist(), trend.slope.tolist()))
