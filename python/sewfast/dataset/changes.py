"""Where a record changes its sign, scale or time: torn files, turned leads, files that were glued.

What one part of a record says of the output predicts the other once it is multiplied or shifted.
Input and past are means over ever longer times, so that neither noise nor the order of a plant
matters. A change is believed if it leaves no more than half of what a curved model of the whole
record leaves: a plant that is not linear has not changed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from .pieces import LARGEST_FITTED, SMALLEST_FITTED

if TYPE_CHECKING:
    from .dataset import Dataset

MOST = 20_000
"""Rows that are used; a longer record is taken in means, so that it has no more."""
WIDER = 1.5
"""Each mean reaches back by this factor."""
PARTS = 16
"""Places of an experiment at which the search for a change begins."""
EXPLAINED = 0.5
"""Share of the error that may be left, as in `sewfast.cause_of`."""
NOTED = 0.1
"""Shares of the output's changes, and of its scale, that are worth a word."""
FARTHEST = 4
"""Part of an experiment that may be lost."""
TIES = 1.05
"""Errors up to this multiple of the least are equal: a change without a shift is taken."""
SCALES = np.concatenate([[0.0], *(sign * 2.0 ** np.arange(-7.0, 7.5, 0.5) for sign in (-1.0, 1.0))])
RIDGE = 1e-4
"""Share of a column's mean square that is added to it: what a part does not show is 0."""
Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class Change:
    """From sample `start` of an experiment on, the output is `gain` times what the rest of the
    record says, or what it says for `shift` samples later. `left` is the share of the error that
    this leaves.
    """

    experiment: int
    start: int
    gain: float
    shift: int
    left: float


def changed(data: Dataset) -> Change | None:
    """From where a record has another sign, scale or time than before; None if nowhere."""
    every = max(1, -(-sum(map(len, data.experiments)) // MOST))
    known = [
        (i, e)
        for i, e in enumerate(data.experiments)
        if len(e) >= every and (np.abs(e.u) < LARGEST_FITTED).all()
    ]
    us, ys = [_means(e.u, every) for _, e in known], [_means(e.y, every) for _, e in known]
    span = max(map(len, us), default=0) // (2 * PARTS)
    if not (span and _moves(us) and _moves(ys)):
        return None
    if (found := _Rows.of(us, ys, span).change()) is None:
        return None
    i, e = known[found.experiment]
    row = found.start - sum(map(len, us[: found.experiment]))
    # of the rows that have a share of both parts, one explains none
    row = row - span // 2 if row > 2 * span else 0
    return Change(i, e.start + row * every, found.gain, found.shift * every, found.left)


def _means(x: FloatArray, every: int) -> FloatArray:
    """Means of so many rows; those of values that are not known are not known."""
    x = np.where(np.abs(x) < LARGEST_FITTED, x, np.nan)
    whole = x[: len(x) // every * every].reshape(-1, every, *x.shape[1:])
    return np.asarray(whole.mean(axis=1))


def _moves(columns: Sequence[FloatArray]) -> bool:
    whole = np.concatenate([c.reshape(len(c), -1) for c in columns])
    whole = whole[np.isfinite(whole).all(axis=1)]
    return len(whole) > 1 and bool((np.ptp(whole, axis=0) >= SMALLEST_FITTED).all())


def _past(u: FloatArray, longest: int) -> FloatArray:
    """Means of the columns over lags 0 to 3, then ever longer ones, and those of a start from 0."""
    lags = [0, 1, 2, 3, 4]
    while lags[-1] < longest:
        lags.append(math.ceil(WIDER * lags[-1]))
    # an input that was 0 before, for a plant that did not stand still under the first one
    u = np.column_stack([u - u[0], np.ones(len(u))])
    total = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(u, axis=0)])
    k = np.arange(1, len(u) + 1)
    at = [total[np.maximum(k - lag, 0)] for lag in lags]
    widths = np.diff(lags)
    means = [(a - b) / n for (a, b), n in zip(itertools.pairwise(at), widths, strict=True)]
    return np.concatenate(means, axis=1)


def _change(x: FloatArray, span: int) -> FloatArray:
    before = np.full_like(x, np.nan)
    before[span:] = x[: max(0, len(x) - span)]
    return x - before


def _columns(us: Sequence[FloatArray], powers: int, span: int) -> FloatArray:
    """Changes of the pasts of all powers of the inputs, of deviation 1."""
    longest = max(map(len, us)) // 8
    every = [np.concatenate([u**p for p in range(1, powers + 1)], axis=1) for u in us]
    X = np.nan_to_num(np.concatenate([_change(_past(u, longest), span) for u in every]))
    columns: FloatArray = X / (X.std(axis=0) + 1e-12)
    return columns


@dataclass(frozen=True)
class _Found:
    """A change with its sum of squares, and what it says of the output before and after it."""

    experiment: int
    start: int
    gain: float
    shift: int
    error: float
    before: FloatArray
    after: FloatArray
    left: float = math.inf


@dataclass(frozen=True)
class _Rows:
    """Changes of what the inputs were, and of the output, over `span` rows of each experiment:
    neither a level nor a slow drift is a relation of the two.
    """

    us: tuple[FloatArray, ...]
    X: FloatArray
    y: FloatArray
    edges: tuple[int, ...]
    span: int

    @classmethod
    def of(cls, us: Sequence[FloatArray], ys: Sequence[FloatArray], span: int) -> _Rows:
        u = np.concatenate(us)
        scaled = tuple((v - u.mean(axis=0)) / u.std(axis=0) for v in us)
        y = np.concatenate([_change(v, span) for v in ys]) / np.nanstd(np.concatenate(ys))
        edges = tuple(map(int, np.cumsum([0, *map(len, us)])))
        return cls(scaled, _columns(scaled, 1, span), y, edges, span)

    def change(self) -> _Found | None:
        """The change that explains most, if it is one."""
        if np.isfinite(self.y).sum() < 10 * self.X.shape[1]:
            return None
        found = [f for place in self.places() if (f := self.at(*place, worth=True))]
        if not found:
            return None
        best = min(found, key=lambda f: f.error)
        for _ in range(3):
            best = self.at(best.experiment, self.sharper(best)) or best
        parts = self.sides(best.experiment, best.start)
        curved = _Pair.of(_columns(self.us, 3, self.span), self.y, *parts).one
        left = math.sqrt(best.error / max(curved, 1e-300))
        own = self.y[parts[1]]
        follows = np.nanvar(own - best.after[parts[1]]) <= EXPLAINED**2 * np.var(own)
        is_other = best.shift != 0 or abs(best.gain - 1.0) > NOTED
        # an output that answers nothing any more has nothing to follow
        if left > EXPLAINED or not is_other or not (follows or abs(best.gain) < NOTED):
            return None
        return replace(best, left=left)

    def places(self) -> Iterator[tuple[int, int]]:
        """Where a change may be: in each experiment, and between several."""
        for i, (a, b) in enumerate(itertools.pairwise(self.edges)):
            for k in range(1 if len(self.edges) == 2 else 0, PARTS):
                yield i, a + k * (b - a) // PARTS

    def sides(self, experiment: int, start: int) -> tuple[Rows, Rows]:
        """The rows before `start` and of other experiments, and those after; none that may have a
        share of both parts.
        """
        known, k = np.isfinite(self.y), np.arange(len(self.y))
        own = (k >= self.edges[experiment]) & (k < self.edges[experiment + 1])
        return known & ~(own & (k >= start - self.span)), known & own & (k >= start + self.span)

    def at(self, experiment: int, start: int, *, worth: bool = False) -> _Found | None:
        """The change from `start` on that explains most; with `worth`, only where one can."""
        before, after = self.sides(experiment, start)
        a, b = self.edges[experiment], self.edges[experiment + 1]
        if min(before.sum(), after.sum()) < 2 * self.span:
            return None
        pair = _Pair.of(self.X, self.y, before, after)
        one, apart = pair.one, (pair.alone, pair.swapped.alone)
        if worth and one < NOTED**2 * max(sum(pair.of_y), NOTED**2 * len(self.y)):
            return None
        most = EXPLAINED**2 * one if worth else math.inf
        found = []
        if sum(apart) <= most:
            gain, error, fits = pair.scaled(self.X)
            found.append(_Found(experiment, start, gain, 0, error, fits[0], fits[1]))
        # rows that were lost are in the future of one part: each is fitted, and the other found
        # along that fit
        for is_late in (False, True):
            if apart[is_late] > most or (is_late and len(self.edges) > 2):
                continue
            rest, others = (pair.swapped, before) if is_late else (pair, after)
            # a short part fits anything
            if others.sum() > (1.0 - 1.0 / FARTHEST) * len(self.y):
                continue
            # where rows of the input were lost, its past ends
            own = slice(a, start) if is_late else slice(start, b)
            error, shift, fit, moved = self.moved(rest, others, own, (b - a) // FARTHEST)
            if is_late:
                shift, fit, moved = -shift, moved, fit
            found.append(_Found(experiment, start, 1.0, shift, error, fit, moved))
        return min(found, key=lambda f: f.error * (TIES**2 if f.shift else 1.0), default=None)

    def moved(
        self, rest: _Pair, others: Rows, own: slice, farthest: int
    ) -> tuple[float, int, FloatArray, FloatArray]:
        """The shift with which the fit of the rest follows the others best."""
        m, fit = others[own].astype(np.float64), rest.fit(self.X)
        n, y, f = len(m), np.where(m > 0.0, self.y[own], 0.0), fit[own]
        # sums over the rows that both have, for each shift
        size, far = 1 << (2 * n - 1).bit_length(), min(int(m.sum()) // 2, farthest)
        shifts = np.r_[np.arange(far + 1), np.arange(-far, 0)]
        of_y = [np.conj(np.fft.rfft(v, size)) for v in (m, y, y**2)]
        of_fit = [np.fft.rfft(v, size) for v in (np.ones(n), f, f**2)]
        count, sy, syy, sf, sff, syf = (
            np.fft.irfft(of_y[i] * of_fit[j], size)[shifts]
            for i, j in ((0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (1, 1))
        )
        count = np.maximum(count, 1.0)
        left = syy - 2.0 * syf + sff - (sy - sf) ** 2 / count
        errors = np.where(count < 0.5 * m.sum(), np.inf, np.maximum(left, 0.0) * m.sum() / count)
        best = int(np.argmin(errors))
        shift = int(shifts[best])
        k = np.arange(len(fit))
        moved = fit[np.clip(k + shift, 0, len(fit) - 1)] + (sy[best] - sf[best]) / count[best]
        is_own, is_from = ((i >= own.start) & (i < own.stop) for i in (k, k + shift))
        moved[is_own & ~is_from] = np.nan
        return rest.alone + float(errors[best]), shift, fit, moved

    def sharper(self, found: _Found) -> int:
        """From where on what explains the later rows is better than what explains the others."""
        a, b = self.edges[found.experiment], self.edges[found.experiment + 1]
        # the answers to inputs that were lost are explained by neither
        if found.start == a or found.shift < 0:
            return found.start
        before, after = ((self.y[a:b] - f[a:b]) ** 2 for f in (found.before, found.after))
        total = np.cumsum(np.nan_to_num(after - before))[self.span : -self.span]
        return a + 1 + self.span + int(np.argmax(total)) if len(total) else found.start


@dataclass(frozen=True)
class _Pair:
    """Two parts of the rows, as products of their columns about their means."""

    G: tuple[FloatArray, ...]
    r: tuple[FloatArray, ...]
    of_y: tuple[float, ...]
    means: tuple[tuple[FloatArray, float], ...]
    ridge: FloatArray

    @classmethod
    def of(cls, X: FloatArray, y: FloatArray, *parts: Rows) -> _Pair:
        means = tuple((X[rows].mean(axis=0), float(y[rows].mean())) for rows in parts)
        own = [(X[rows] - x, y[rows] - v) for rows, (x, v) in zip(parts, means, strict=True)]
        ridge = RIDGE * sum(len(v) for _, v in own) * np.eye(X.shape[1])
        return cls(
            tuple(x.T @ x for x, _ in own), tuple(x.T @ v for x, v in own),
            tuple(float(v @ v) for _, v in own), means, ridge,
        )  # fmt: skip

    @property
    def swapped(self) -> _Pair:
        return _Pair(self.G[::-1], self.r[::-1], self.of_y[::-1], self.means[::-1], self.ridge)

    def fitted(self, gains: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sums of squares if the second part has another gain, and the fits to both."""
        G = self.G[0] + gains[:, None, None] ** 2 * self.G[1] + self.ridge
        r = self.r[0] + gains[:, None] * self.r[1]
        theta = np.asarray(np.linalg.solve(G, r[:, :, None])[:, :, 0], dtype=np.float64)
        left = np.maximum(sum(self.of_y) - (r * theta).sum(axis=1), 0.0)
        return np.asarray(left, dtype=np.float64), theta

    @property
    def one(self) -> float:
        """What one fit leaves of both parts."""
        return float(self.fitted(np.ones(1))[0][0])

    @property
    def alone(self) -> float:
        """What is left of the first part."""
        return max(0.0, float(self.fitted(np.zeros(1))[0][0]) - self.of_y[1])

    def fit(self, X: FloatArray) -> FloatArray:
        """The fit to the first part, at all rows."""
        x, level = self.means[0]
        return np.asarray((X - x) @ self.fitted(np.zeros(1))[1][0] + level)

    def scaled(self, X: FloatArray) -> tuple[float, float, list[FloatArray]]:
        """The gain of the second part that explains most, what it leaves, and both fits."""
        gains: FloatArray = SCALES
        for _ in range(2):
            errors, theta = self.fitted(gains)
            best = int(np.argmin(errors))
            gain, error, of = float(gains[best]), float(errors[best]), theta[best]
            gains = np.asarray(gain * 2.0 ** np.linspace(-0.5, 0.5, 41))
        fits = [g * ((X - x) @ of) + v for g, (x, v) in zip((1.0, gain), self.means, strict=True)]
        return gain, error, fits
