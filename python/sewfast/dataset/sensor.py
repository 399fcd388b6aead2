"""Stretches in which a sensor says nothing: it died, or a few samples stand out.

- A dead sensor: the output keeps one value to the last bit, though elsewhere it never does for more
  than a few samples, or a linear model of the rest, whose output is limited to the recorded range,
  moves; the input has the levels there at which the output moves elsewhere, so that friction or a
  dead zone is no explanation; and a limit of the output was not reached by motion, so that a
  saturation or an end stop is none either.
- A value that stands out: a few samples, far from those before and after, have more power than all
  of the output but other such values.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, runs
from .pieces import LARGEST_FITTED, SMALLEST_FITTED

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment

PAST = 10
"""Past outputs and inputs in the regressions, and largest lead in samples."""
ORDER = 4
"""Past outputs and inputs of the model of the rest."""
LEAST_PART = 0.01
"""Least part of its experiment for a dead stretch."""
WINDOWS = 8
"""Least number of windows of the rest with which a stretch is compared."""
APART = 10.0
"""Ratio of squared errors, in the stretch to the worst window of the rest. Of 2,400 sound records
of `tests/dataset/test_faults.py` the worst has 4.5 (a saturation), of 766 dead sensors the least
20."""


def measured_columns(e: Experiment) -> FloatArray:
    """Inputs and output, NaN where they are not known or no measured quantity is as large."""
    columns = np.column_stack([e.u, e.y])
    return np.where(np.abs(columns) < LARGEST_FITTED, columns, np.nan)


def known_rows(columns: FloatArray) -> NDArray[np.bool_]:
    """Samples at which every column is known."""
    known: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(columns), axis=1)
    return known


def scale_of(parts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray] | None:
    """Mean and deviation of each column over all parts; None if one of them does not move."""
    whole = np.concatenate(parts) if parts else np.zeros((1, 1))
    if (np.ptp(whole, axis=0) < SMALLEST_FITTED).any():
        return None
    return whole.mean(axis=0), whole.std(axis=0)


# --- A sensor that died ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Dead:
    """A stretch in which the output's sensor says nothing: samples `start` to `stop`, excluded.
    Samples are those of the file, 0-based; `experiment` is the index in the data set.
    """

    experiment: int
    start: int
    stop: int
    value: float


def dead_stretches(data: Dataset) -> tuple[Dead, ...]:
    """Stretches in which the output stands still while the rest says that it cannot."""
    return tuple(
        Dead(i, e.start + first, e.start + first + count, float(e.y[first]))
        for i, e in enumerate(data.experiments)
        for first, count in _dead_in(e)
    )


def _dead_in(e: Experiment) -> list[tuple[int, int]]:
    columns, least = measured_columns(e), max(4 * ORDER, LEAST_PART * len(e))
    known = known_rows(columns)
    same = known[1:] & known[:-1] & (e.y[1:] == e.y[:-1])
    still = [(a, count + 1) for a, count in runs(same) if count + 1 >= least]
    still = sorted(still, key=lambda s: -s[1])[:20]
    for first, count in still:
        known[first : first + count] = False
    model = _Rest.of(columns, known) if still else None
    return [] if model is None else sorted(s for s in still if model.contradicts(*s))


@dataclass(frozen=True)
class _Rest:
    """A linear model of the part of an experiment in which the output moves."""

    u: FloatArray
    y: FloatArray
    theta: FloatArray
    pieces: tuple[tuple[int, int], ...]
    longest: int

    @classmethod
    def of(cls, columns: FloatArray, rest: NDArray[np.bool_]) -> _Rest | None:
        pieces = tuple(p for p in runs(rest) if p[1] > 4 * ORDER)
        scale = scale_of([columns[a : a + n] for a, n in pieces])
        if scale is None:
            return None
        u, y = np.split((columns - scale[0]) / scale[1], [-1], axis=1)
        y = y[:, 0]
        X = np.concatenate([_regressors(u[a : a + n], y[a : a + n]) for a, n in pieces])
        if len(X) < 10 * ORDER * (2 + u.shape[1]):
            return None
        target = np.concatenate([y[a + ORDER : a + n] for a, n in pieces])
        theta = np.asarray(np.linalg.lstsq(X, target, rcond=1e-10)[0])
        same = (np.diff(y[a : a + n]) == 0.0 for a, n in pieces)
        longest = 1 + max(count for equal in same for _, count in (*runs(equal), (0, 0)))
        return cls(u, y, theta, pieces, longest)

    def contradicts(self, first: int, count: int) -> bool:
        """Whether the output moves in this stretch, by everything known from the rest."""
        if not (self._covers(first, count) and self._jumps(first, count)):
            return False
        # the last digits of a noisy sensor stand still only before the machine was switched on
        if first > 0 and self.longest <= ORDER and count > APART * self.longest:
            return True
        length = min(count, sum(n for _, n in self.pieces) // WINDOWS)
        if length <= 2 * ORDER:
            return False
        others = np.array([
            k for a, n in self.pieces for k in range(a, a + n - length + 1, max(1, length // 2))
        ])  # fmt: skip
        if len(others) < WINDOWS // 2:
            return False
        own = np.arange(first, first + count - length + 1, length)
        errors = self._errors(others, length)
        return bool(np.median(self._errors(own, length)) > APART * errors.max())

    def _covers(self, first: int, count: int) -> bool:
        """Whether an input reaches the levels here that it has while the output moves.
        Friction, a dead zone or a closed valve keep an output still at some levels, but not at the
        middle half of those at which it moves, for more than `PAST` samples at either side.
        """
        own = self.u[first : first + count]
        rest = np.concatenate([self.u[a : a + n] for a, n in self.pieces])
        low, high = np.quantile(rest, [0.25, 0.75], axis=0)
        ends = np.sort(own, axis=0)[[min(PAST, count - 1), max(-PAST - 1, -count)]]
        inside = (ends[0] <= low) & (ends[1] >= high)
        return bool((inside & (np.ptp(own, axis=0) > 0.0)).any())

    def _jumps(self, first: int, count: int) -> bool:
        """Whether the output can be at no limit: it is inside the range, or reached it at a jump.
        A saturated output and an end stop are reached by motion.
        """
        y, value = self.y, self.y[first]
        if np.nanmin(y) < value < np.nanmax(y):
            return True
        ends = [abs(y[k] - y[k - 1]) for k in (first, first + count) if 0 < k < len(y)]
        usual = max(float(np.abs(np.diff(y[a : a + n])).max()) for a, n in self.pieces)
        return max(ends, default=0.0) > usual

    def _errors(self, starts: np.ndarray, length: int) -> FloatArray:
        """Mean square errors of free runs from the measured start of each window."""
        low, high = np.nanmin(self.y), np.nanmax(self.y)
        past = [self.y[starts + i] for i in range(ORDER)][::-1]
        total = np.zeros(len(starts))
        for k in range(ORDER, length):
            columns = [*past, *(self.u[starts + k - i, j] for j in range(self.u.shape[1])
                                for i in range(1, ORDER + 1)), np.ones(len(starts))]  # fmt: skip
            y = np.clip(np.stack(columns, axis=1) @ self.theta, low, high)
            total += (self.y[starts + k] - y) ** 2
            past = [y, *past[:-1]]
        return total / (length - ORDER)


def _regressors(u: FloatArray, y: FloatArray) -> FloatArray:
    k = np.arange(ORDER, len(y))
    past = [y[k - i] for i in range(1, ORDER + 1)]
    inputs = [u[k - i, j] for j in range(u.shape[1]) for i in range(1, ORDER + 1)]
    return np.stack([*past, *inputs, np.ones(len(k))], axis=1)


# --- Values that no plant has ---------------------------------------------------------------------

SPIKE = 3
"""Most samples in a row that are a spike and no motion."""
SPIKES = 20
"""Most spikes of an experiment that are looked for."""
_Stretch: TypeAlias = tuple[int, int, float, float]
"""Start and length of a stretch, its power and that of all others."""


def spikes(data: Dataset) -> tuple[Dead, ...]:
    """Short stretches of the output that have most of its power, while no input stands out."""
    return tuple(
        Dead(i, e.start + first, e.start + first + count, float(e.y[first]))
        for i, e in enumerate(data.experiments)
        for first, count in _spikes_in(measured_columns(e))
    )


def _spikes_in(columns: FloatArray) -> Iterator[tuple[int, int]]:
    """The most stretches, farthest first, of which the last has more power than all that is left.
    Several spikes of one size have no more power than the rest together with the others.
    """
    *inputs, y = columns.T
    # an input moves at nothing else than its blows, an output has noise
    blows = [first for u in inputs for first, *_ in _most(_standing_out(u), least=-1.0)]
    found = itertools.takewhile(
        # the answer to a blow on the input is no spike
        lambda s: not any(blow in range(s[0] - PAST, s[0] + s[1]) for blow in blows),
        _standing_out(y),
    )
    yield from (spike[:2] for spike in _most(found, least=0.0))


def _most(found: Iterable[_Stretch], *, least: float) -> list[_Stretch]:
    """These stretches, up to the last one with more power than all that is left, which is more than
    `least`; a single one may be all that moves.
    """
    stretches, count = [], 0
    for stretch in found:
        stretches.append(stretch)
        *_, inside, rest = stretch
        if inside > rest and (rest > least or len(stretches) == 1):
            count = len(stretches)
    return stretches[:count]


def _standing_out(column: FloatArray) -> Iterator[_Stretch]:
    """The farthest stretch, the farthest of the rest, and so on."""
    rest = column.copy()
    for _ in range(SPIKES):
        if np.isfinite(rest).sum() < 4 * PAST or (stretch := _farthest(rest)) is None:
            return
        yield stretch
        rest[stretch[0] : stretch[0] + stretch[1]] = np.nan


def _farthest(column: FloatArray) -> _Stretch | None:
    """Start and length of `SPIKE` samples or fewer about the farthest value, with their power and
    that of all others; None if the column does not come back within them.
    """
    if not np.isfinite(column).any():
        return None
    apart = np.abs(column - np.nanmedian(column))
    k = int(np.nanargmax(apart))
    if apart[k] == 0.0:
        return None
    far = apart > 0.5 * apart[k]
    first = k - int(np.argmin(far[k::-1])) + 1 if not far[: k + 1].all() else 0
    last = k + int(np.argmin(far[k:])) if not far[k:].all() else len(far)
    # away and back: a step that settles in a sample begins or ends elsewhere
    if last - first > SPIKE or first == 0 or last == len(column):
        return None
    if not abs(column[first - 1] - column[last]) < 0.5 * apart[k]:
        return None
    power = (apart / apart[k]) ** 2
    inside = float(np.nansum(power[first:last]))
    power[first:last] = 0.0
    return first, last - first, inside, float(np.nansum(power))


def measuring(data: Dataset) -> Dataset:
    """The data without spikes, and then without dead stretches, as `identify` takes them."""
    data = alive(data, spikes(data))
    return alive(data, dead_stretches(data))


def alive(data: Dataset, dead: Sequence[Dead]) -> Dataset:
    """The data without these dead stretches."""
    if not dead:
        return data
    masks = [np.zeros(len(e), dtype=np.bool_) for e in data.experiments]
    for d in dead:
        start = data.experiments[d.experiment].start
        masks[d.experiment][d.start - start : d.stop - start] = True
    return data.mask(masks, why="that no plant has left out")
