"""Blocks of the whole record, each held out once, and convex weights of what is found on them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from .. import _core
from ..dataset import Dataset, Experiment, FloatArray
from ..dataset.experiment import weights_of
from ..dynamic_model import INIT, Core
from ..errors import DataError, FitError
from ..models import Model
from ..models.base import EnsembleCore
from .folds import (
    AS_GOOD,
    ERROR_BLOCKS,
    LEAST_HELD_OUT,
    Errors,
    Split,
    Trial,
    apart,
    compared,
    free_runs,
    given,
    is_moving,
    measured,
    moves_once,
    with_run_up,
)
from .linear import LEAST_GAIN
from .task import Provenance, Task, finite, sources

COUNT = 4
"""Blocks. Eight take twice the time and gain nothing: geometric mean of test errors .384 of output
error's, against .349 with four (families `short_*` of the battery's rules, systems 0 to 4)."""
ENOUGH = 5_000
"""Samples to judge by: with more data, fewer blocks are held out, each made of stretches that are
spread over the record. Short stretches resemble what is beside them: of records with few events
long blocks tell more (`bldc_cigan`: error on its last part 12.3 with two stretches of 625 samples a
block, 9.9 with blocks of 1,250, 9.2 of the best linear model)."""
BY_LUCK = 10.0
"""Fewer structures suffice if their error is larger by at most a standard error, or by this number
over that of samples, up to `AS_GOOD`: the best of dozens of structures leads by luck."""
FAR = 2.0
"""A structure with an error of more than this many times the least has no part in any weights: the
errors of bad models can cancel on some blocks, but a median of members does not cancel them."""


def blocked(
    data: Dataset, validation: Dataset | None = None, blocks: int = COUNT
) -> tuple[Split, ...]:
    """The experiments one after another in so many blocks, each held out once, in order.
    What is left of an experiment around its blocks is fitted. On many data only the last folds are
    given, those that are enough to judge by. There are none if the data are too short, or if
    the inputs move only once: what follows a single step is its response, in the fitted part as in
    the held one. Validation data, if given, are the only fold.
    """
    if validation is not None:
        return (given(data, validation),)
    if moves_once(data):
        return ()
    count = min(blocks, math.ceil(blocks * ENOUGH / len(data)))
    edges = np.linspace(0, len(data), blocks * math.ceil(blocks / count) + 1).round().astype(int)
    stretches = list(itertools.pairwise(edges.tolist()))
    # the first of all is the last to be held out: nothing before it gives its state
    found = (_without(data, stretches[i::blocks]) for i in range(blocks - count, blocks))
    parts = tuple(f for f in found if f is not None and f.scored and is_moving(f.fitted))
    return parts if len(parts) > 1 or count == 1 else ()


def _without(data: Dataset, stretches: Sequence[tuple[int, int]]) -> Split | None:
    """These ranges of the samples of all experiments held out; None if they are too short."""
    fitted: list[Experiment] = []
    held: list[Experiment] = []
    parts: list[Experiment] = []
    first = 0
    for e in data.experiments:
        within = [(max(low - first, 0), min(high - first, len(e))) for low, high in stretches]
        able = [
            (a, b)
            for a, b in within
            if b - a >= LEAST_HELD_OUT and measured(e.y[a:b]) >= LEAST_HELD_OUT
        ]
        first += len(e)
        held += [with_run_up(e, a, b) for a, b in able]
        parts += [e.cut(a, b) for a, b in able]
        edges = [0, *itertools.chain(*able), len(e)]
        around = zip(edges[::2], edges[1::2], strict=True)
        fitted += [
            e.cut(a, b) for a, b in around if not able or measured(e.y[a:b]) >= LEAST_HELD_OUT
        ]
    if not (held and fitted):
        return None
    pieces = (replace(data, experiments=tuple(p)) for p in (fitted, held, parts))
    of, judged, scored = pieces
    return Split(of, judged, sources=tuple(sources(scored)))


@dataclass(frozen=True)
class Blocks:
    """The scored samples of all folds of some data, one after another."""

    data: Dataset
    folds: tuple[Split, ...]

    @cached_property
    def together(self) -> Split:
        """All blocks held out, all data fitted: what a combination of models is judged by."""
        first = self.folds[0]
        if first.is_given:
            return first
        held = [e for f in self.folds for e in f.held.experiments]
        listed = tuple(s for f in self.folds for s in f.sources)
        return Split(self.data, replace(self.data, experiments=tuple(held)), sources=listed)

    @cached_property
    def _outputs(self) -> FloatArray:
        """All held-out outputs; NaN where they are not scored."""
        found = []
        for e in self.together.held.experiments:
            y = e.y.copy()
            y[: e.initial_samples(INIT)] = np.nan
            found.append(y)
        return np.concatenate(found)

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the scored samples."""
        held = self.together.held.experiments
        return np.concatenate([weights_of(e) for e in held])[np.isfinite(self._outputs)]

    @cached_property
    def sizes(self) -> list[int]:
        """Scored samples of each fold."""
        return [
            sum(int(np.isfinite(e.y[e.initial_samples(INIT) :]).sum()) for e in f.held.experiments)
            for f in self.folds
        ]

    def residual(self, cores: Sequence[Core]) -> FloatArray | None:
        """Scored outputs minus the free runs of one model per fold; None if a run diverges."""
        runs: list[FloatArray] = []
        for core, part in zip(cores, self.folds, strict=True):
            found = free_runs(core, part)
            if found is None:
                return None
            runs += found
        known = np.isfinite(self._outputs)
        return np.asarray((self._outputs - np.concatenate(runs))[known])

    def trial(self, residual: FloatArray, apart: float) -> Trial:
        """What is left on all blocks, and how far models without one are apart."""
        whole = np.full(len(self._outputs), np.nan)
        whole[np.isfinite(self._outputs)] = residual
        ends = np.cumsum([len(e) for e in self.together.held.experiments])[:-1]
        pieces = np.split(whole, ends)
        return Trial(self.together, self.errors(residual).rmse, pieces, apart)

    def errors(self, residual: FloatArray) -> Errors:
        """Its squares, block by block."""
        squares, edges = self.weights * residual**2, np.arange(len(residual))
        blocks = np.array_split(edges, ERROR_BLOCKS)
        return Errors(
            np.array([float(squares[b].sum()) for b in blocks]),
            np.array([float(self.weights[b].sum()) for b in blocks]),
        )


def unseen(model: Model, task: Task, fitted: Callable[[Task], Model]) -> Trial | None:
    """Free runs over all blocks, each of the model fitted to the rest.
    Short records have fewer blocks. None if there are none, if one of these fits fails or runs
    away, or without time for them.
    """
    fewer = max(2, min(COUNT, len(task.data) // LEAST_HELD_OUT))
    folds, cores = blocked(task.data, blocks=fewer), []
    for fold in folds:
        if not task.clock.can_close:
            return None
        try:
            cores.append(fitted(replace(task, data=fold.fitted, progress=None)).core)
        except (DataError, FitError):
            return None
    blocks = Blocks(task.data, folds)
    residual = blocks.residual(cores) if cores else None
    if residual is None:
        return None
    return blocks.trial(residual, apart(model, task.data, [partial(free_runs, c) for c in cores]))


@dataclass(frozen=True, eq=False)
class Row:
    """A structure, its models of each fold, and what these leave unexplained on the blocks.
    `found` is what the row was made of; `models` are those of each fold, the best first; `sound`
    says of each fold whether they passed the guard.
    """

    kind: str
    parameters: int
    found: Any
    models: tuple[tuple[Any, ...], ...]
    sound: tuple[bool, ...]
    residual: FloatArray
    errors: Errors

    @property
    def rmse(self) -> float:
        """Root mean square error on all blocks."""
        return self.errors.rmse

    def core(self, fold: int) -> Core:
        """Its models without one block as one: their median."""
        models = self.models[fold]
        return models[0] if len(models) == 1 else EnsembleCore(models, "median")

    def to_json(self, weight: float) -> Provenance:
        """The row of the table of candidates, with its weight in the model if it has one."""
        row = {**self.found.to_json(), "free_run_rmse": finite(self.rmse)}
        return row | ({"weight": round(weight, 3)} if weight else {})


@dataclass(frozen=True, eq=False)
class Mixture:
    """Rows with their weights, and what they leave unexplained together."""

    rows: tuple[Row, ...]
    weights: FloatArray
    residual: FloatArray
    errors: Errors

    def runs(self, fold: int, part: Split) -> list[FloatArray] | None:
        """Free runs over a part by the models without one block; None if one diverges."""
        found = [free_runs(r.core(fold), part) for r in self.rows]
        if any(runs is None for runs in found):
            return None
        experiments = zip(*(runs for runs in found if runs is not None), strict=True)
        return [np.average(runs, axis=0, weights=self.weights) for runs in experiments]

    @classmethod
    def of(cls, rows: Sequence[Row], blocks: Blocks) -> Mixture:
        """Convex weights of least squares on the blocks."""
        residuals = np.column_stack([r.residual for r in rows])
        weights = _core.convex_weights(residuals, blocks.weights)
        residual = residuals @ weights
        return cls(tuple(rows), weights, residual, blocks.errors(residual))

    def of_members(self, most: int, blocks: Blocks) -> tuple[FloatArray, Mixture]:
        """About `most` members in proportion to the weights, and the mixture that they are.
        If they are too few for every row, those that get none have one or are left out, whichever
        leaves less on the blocks.
        """
        shares = np.diff(np.round(most * np.cumsum(self.weights)), prepend=0.0)
        ways = [shares] if shares.min() >= 1.0 else [np.maximum(shares, 1.0), shares]
        found: list[tuple[FloatArray, Mixture]] = []
        for way in ways:
            has = way > 0.0
            rows = tuple(r for r, own in zip(self.rows, has, strict=True) if own)
            weights = way[has] / way.sum()
            residual = np.column_stack([r.residual for r in rows]) @ weights
            found.append((way[has], Mixture(rows, weights, residual, blocks.errors(residual))))
        return min(found, key=lambda f: f[1].errors.rmse)

    def unseen(self, blocks: Blocks) -> FloatArray:
        """What they leave on each block with weights from the others: errors of rows cancel where
        their weights were found, and not on another recording.
        """
        if len(self.rows) == 1 or len(blocks.sizes) == 1:
            return self.residual
        residuals, left = np.column_stack([r.residual for r in self.rows]), self.residual.copy()
        fold = np.repeat(np.arange(len(blocks.sizes)), blocks.sizes)
        for own in (fold == i for i in range(len(blocks.sizes))):
            others = _core.convex_weights(residuals[~own], blocks.weights[~own])
            left[own] = residuals[own] @ others
        return left


def combined(rows: Sequence[Row], blocks: Blocks) -> Mixture:
    """The fewest rows that do as well as all of them, within a standard error or two per cent.
    One row if there is one, the simplest such; else those that are left when one after another is
    dropped without which the error grows least.
    """
    rows, luck = near(rows), BY_LUCK / len(blocks.weights)
    everything = Mixture.of(rows, blocks)
    for row in sorted(rows, key=lambda r: (r.parameters, r.rmse)):
        if _is_as_good(row.errors, everything.errors, luck):
            linear = [r for r in rows if r.kind == "oe"]
            return Mixture.of([simplest(linear) if row in linear else row], blocks)
    pairs = zip(rows, everything.weights, strict=True)
    best = Mixture.of([r for r, w in pairs if w > 0.0], blocks)
    while len(best.rows) > 1:
        fewer = [
            Mixture.of([r for r in best.rows if r is not dropped], blocks) for dropped in best.rows
        ]
        enough = [m for m in fewer if _is_as_good(m.errors, everything.errors, luck)]
        if not enough:
            break
        best = min(enough, key=lambda m: m.errors.rmse)
    return best


def near(rows: Sequence[Row]) -> list[Row]:
    """Those whose error is not far above the least."""
    least = min(r.rmse for r in rows)
    return [r for r in rows if r.rmse <= FAR * least]


def simplest(rows: Sequence[Row]) -> Row:
    """The simplest linear model that does as well as the best of them, which is hardly luck."""
    best = min(rows, key=lambda r: r.rmse)
    ranked = sorted(rows, key=lambda r: (r.parameters, r.rmse))
    return next(r for r in ranked if _is_as_good(r.errors, best.errors, LEAST_GAIN))


def _is_as_good(one: Errors, other: Errors, least: float) -> bool:
    """Whether the first errors are larger by at most a standard error, or by `least`."""
    ratio, deviation = compared(one, other)
    return ratio <= min(max(deviation, least), AS_GOOD)
