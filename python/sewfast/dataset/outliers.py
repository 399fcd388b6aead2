"""The noise of a column, and outliers: outputs that are marked, to be masked in a separate step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray, is_whole, runs
from ..errors import DataError, SettingError
from .pieces import require_sane

if TYPE_CHECKING:
    from .dataset import Dataset

# --- The sensor of a column: white noise, quantum, limits -----------------------------------------


MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def white_noise(column: FloatArray) -> float:
    """Standard deviation of the white noise of a column; NaN if unknown.
    Third differences suppress smooth motion, and their variance is 20 times that of white noise.
    The median makes single jumps harmless.
    """
    changes = np.diff(column, 3)
    changes = changes[np.isfinite(changes)]
    if len(changes) < 4:
        return math.nan
    return MAD * float(np.median(np.abs(changes))) / math.sqrt(20.0)


def quantum(column: FloatArray) -> float | None:
    """The step of a grid of all values, which occur twice or more on average; None without one."""
    return _core.quantum(np.ascontiguousarray(column))


def share_at_limits(column: FloatArray) -> tuple[float, float]:
    """Parts of the known samples that stay at the smallest and at the largest value."""
    known = column[np.isfinite(column)]
    if len(known) == 0 or known.min() == known.max():
        return 0.0, 0.0
    margin = 1e-9 * np.ptp(known)
    sides = (known <= known.min() + margin, known >= known.max() - margin)
    # samples in a row at an extreme that count as at a limit
    low, high = (sum(n for _, n in runs(side) if n >= 3) / len(known) for side in sides)
    return low, high


# --- The spectrum of a signal ---------------------------------------------------------------------


LOW, HIGH, TOP = 0.05, 0.95, 0.999
"""Parts of the power below the band's lower end, its upper end, and the top frequency."""


def power_spectrum(columns: Iterable[FloatArray], Ts: float) -> tuple[FloatArray, FloatArray]:
    """Power density of one signal over pieces without gaps, by Welch's method.
    Segments of one length overlap by half; their mean is removed and a Hann window applied. Returns
    frequency [Hz] and power [unit^2/Hz], both (M,), without frequency 0; they are empty where no
    piece has 32 samples.
    """
    pieces = [c[a : a + n] for c in columns for a, n in runs(np.isfinite(c)) if n >= 32]
    if not pieces:
        return np.zeros(0), np.zeros(0)
    # samples of a segment at most (Welch 1967)
    length = min(4096, 2 ** int(np.log2(max(map(len, pieces)))))
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
    """Frequencies [Hz] that bound the middle 90 % of the power; None if there is no power."""
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


# --- Outliers: marks of single wrong outputs ------------------------------------------------------


class Simulates(Protocol):
    """The part of a model that outliers need: its free run on a data set."""

    @property
    def input_names(self) -> tuple[str, ...]: ...

    def simulate(self, data: Dataset) -> list[FloatArray]: ...


BoolArray = NDArray[np.bool_]

_SHOWN = 8


@dataclass(frozen=True, eq=False, repr=False)
class Outliers(Sequence[BoolArray]):
    """Marks for `Dataset.mask`: a sequence of masks, one per experiment.

    Attributes
    ----------
    masks : tuple of array of bool, shape (N,)
        True where the output stands out.
    distances : tuple of array, shape (N,)
        How far each output is from its neighbours' median, in robust standard deviations; NaN where
        it was not measured.
    """

    masks: tuple[BoolArray, ...]
    distances: tuple[FloatArray, ...]
    names: tuple[str, ...]
    starts: tuple[int, ...]

    @property
    def marked(self) -> int:
        """Marked samples in all experiments together."""
        return int(sum(m.sum() for m in self.masks))

    def __len__(self) -> int:
        return len(self.masks)

    def __iter__(self) -> Iterator[BoolArray]:
        return iter(self.masks)

    @overload
    def __getitem__(self, i: int) -> BoolArray: ...
    @overload
    def __getitem__(self, i: slice) -> tuple[BoolArray, ...]: ...
    def __getitem__(self, i: int | slice) -> BoolArray | tuple[BoolArray, ...]:
        return self.masks[i]

    def __repr__(self) -> str:
        return f"Outliers({self.marked} of {sum(map(len, self.masks))} samples)"

    def __str__(self) -> str:
        lines = [f"{self.marked} of {sum(map(len, self.masks))} outputs stand out"]
        for name, start, mask, far in zip(
            self.names, self.starts, self.masks, self.distances, strict=True
        ):
            at = np.flatnonzero(mask)
            if len(at):
                shown = ", ".join(f"{start + k} ({far[k]:.0f} sd)" for k in at[:_SHOWN])
                more = f", and {len(at) - _SHOWN} more" if len(at) > _SHOWN else ""
                lines.append(f"  {name}: samples {shown}{more}")
        return "\n".join(lines)


def mark_outliers(
    data: Dataset,
    *,
    threshold: float | None = None,
    window: int = 7,
    model: Simulates | None = None,
) -> Outliers:
    """Mark outputs that differ strongly from their neighbours; the data stay unchanged.

    An output is marked where its distance to the median of `window` samples around it is over
    `threshold` robust standard deviations (Hampel 1974), of the window without its slope or of the
    record's white noise, whichever is larger. Runs of up to half a window are found.

    Parameters
    ----------
    threshold : float or None
        In standard deviations, above 0. None: 6, and more on long records (`usual_threshold`), so
        that chance marks nothing there either.
    window : int
        Odd, from 3 on.
    model : Model or None
        Examine the residual of this model's free run instead of the output, so that fast motion of
        the plant is not mistaken for an outlier.

    Returns
    -------
    Outliers
        `data.mask(data.mark_outliers())` removes the marked outputs.

    Raises
    ------
    SettingError
        For an invalid threshold or window.
    DataError, FitError
        If the model cannot run on the data.
    """
    if threshold is None:
        threshold = usual_threshold(data)
    number = isinstance(threshold, (int, float, np.number)) and not isinstance(threshold, bool)
    if not number or not threshold > 0.0:
        raise SettingError(f"threshold: expected a number above 0, received {threshold!r}")
    if not is_whole(window) or window < 3 or window % 2 == 0 or window > 1001:
        raise SettingError(f"window: expected an odd number from 3 to 1001, received {window!r}")
    require_sane(data)
    series = _series(data, model)
    far = tuple(distances(y, int(window)) for y in series)
    masks = tuple(d > threshold for d in far)
    names, starts = zip(*((e.name, e.start) for e in data.experiments), strict=True)
    return Outliers(masks, far, names, starts)


def usual_threshold(data: Dataset) -> float:
    """Robust standard deviations that mark an output: 6 up to 20,000 samples, then slowly more.
    For white noise alone, 6 would suffice for a hundred million samples; in 2,000,000 samples of a
    moving plant, chance reaches 7.3.
    """
    # robust standard deviations from which on an output of a short record stands out
    return 6.0 + 0.75 * max(0.0, math.log10(len(data) / 20_000))


def _series(data: Dataset, model: Simulates | None) -> list[FloatArray]:
    if model is None:
        return [e.y for e in data.experiments]
    if data.n_inputs != len(model.input_names):
        raise DataError(
            name="model", expected=f"the inputs of the data, {data.n_inputs}",
            received=f"{len(model.input_names)}", remedy="give a model of these data",
        )  # fmt: skip
    runs = model.simulate(data)
    return [e.y - run for e, run in zip(data.experiments, runs, strict=True)]


def distances(y: FloatArray, window: int = 7) -> FloatArray:
    """Distance of each value from its window, in robust standard deviations.
    It is the smaller of two distances to the window's median: over the record's deviation, and,
    after removing the window's slope, over the larger of the window's and the record's deviation.
    """
    known = y[np.isfinite(y)]
    if len(known) == 0:
        return np.full_like(y, np.nan)
    # part of the range below which a deviation is rounding
    least = max(1e-12 * float(np.ptp(known)), np.finfo(np.float64).tiny)
    level = max(float(np.nan_to_num(white_noise(y))), 0.5 * (quantum(y) or 0.0), least)
    padded = np.pad(y, window // 2, constant_values=np.nan)
    rows = np.lib.stride_tricks.sliding_window_view(padded, window)
    distance = np.empty_like(y)
    # numbers at once, for the memory
    count = max(1, 2_000_000 // window)
    for first in range(0, len(y), count):
        part = slice(first, first + count)
        levelled = _levelled(rows[part], level)
        median = _medians(levelled)
        local = MAD * _medians(np.abs(levelled - median[:, None]))
        without_slope = np.abs(y[part] - median) / np.fmax(local, level)
        plain = np.abs(y[part] - _medians(rows[part])) / level
        distance[part] = np.minimum(plain, without_slope)
    return distance


def _levelled(rows: FloatArray, level: float) -> FloatArray:
    """Windows minus their slope, if it clearly exceeds the noise."""
    slope = _medians(np.diff(rows, axis=1))
    slope = np.where(np.abs(slope) > 2.0 * level, slope, 0.0)
    width = rows.shape[1]
    levelled: FloatArray = rows - slope[:, None] * (np.arange(width) - width // 2)
    return levelled


def _medians(rows: FloatArray) -> FloatArray:
    """Median of each row without NaN; NaN if all of it is."""
    ordered = np.sort(rows, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    index, row = np.maximum(count, 1), np.arange(len(rows))
    middle = 0.5 * (ordered[row, (index - 1) // 2] + ordered[row, index // 2])
    return np.where(count > 0, middle, np.nan)
