"""Linear output error of several orders and delays: which one the data ask for.

The errors on what is held out decide, by the rule that chooses networks too: the simplest model
that is within one standard error of the best. A larger order that gains a hair often does so by a
slow pole that no motor has, and with a steady gain that is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .. import _core
from ..errors import DataError, FitError
from .delays import delay, reach
from .effort import Look, Pool
from .folds import RUNAWAY, Errors, Split, compared, errors_of, free_runs
from .task import Provenance, Task, arrays, finite

ORDERS = (1, 2, 3, 4, 5, 6, 7, 8)
DELAYS = (2, 3, 4, 5, 6)
"""Looked at beside the delay of one sample, unless one is given."""
LATE_ORDERS = (1, 2, 3)
"""Looked at with a dead time that is estimated to lie beyond these delays."""
SAMPLES_OF_DELAY = 2_000
"""Of that estimate."""
SAMPLES = 6_000
HELD_OUT = 10 * SAMPLES
"""Of a fit that only decides: blocks from all over the record."""
ITERATIONS = 60
WORTH_AN_ORDER = 0.98
"""A larger order that does not bring the error below this part has not gained."""
PATIENCE = 2
"""Orders without gain after which larger ones are left out."""
MISLED = 1.2
"""A model whose error exceeds a smaller one's by more is no start for a network."""
SPARE_POLES = (0.6, 0.8, 0.4, 0.9, 0.7, 0.5, 0.3)
LEAST_GAIN = math.log(1.005)
"""A difference in error below half a per cent counts as none, however well it is known."""


@dataclass(frozen=True)
class LinearCandidate:
    """Output error of one order and delay: a model per fold, and its errors there."""

    order: int
    nk: int
    models: tuple[_core.LinearModel | None, ...]
    errors: tuple[Errors, ...]

    @property
    def rmse(self) -> float:
        """On the newest fold."""
        return self.errors[0].rmse

    @property
    def parameters(self) -> int:
        """Coefficients; a sample of delay costs nothing, and gains nothing."""
        return 2 * self.order + 2

    def to_json(self) -> Provenance:
        """For the table of candidates."""
        row: Provenance = {"kind": "oe", "na": self.order, "nb": self.order + 1, "nk": self.nk}
        return row | {"free_run_rmse": finite(self.rmse)}


@dataclass
class LinearTable:
    """Linear models that were fitted for a decision.

    Parameters
    ----------
    task : Task
    folds : sequence of Split
        The newest first; models are fitted to thinned excerpts of what each learns from.
    pool : Pool
    """

    task: Task
    folds: Sequence[Split]
    pool: Pool
    candidates: dict[tuple[int, int], LinearCandidate] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._excerpts = [f.shortened(SAMPLES, HELD_OUT) for f in self.folds]

    @property
    def nk(self) -> int:
        """The delay that was given, else 1."""
        return 1 if self.task.nk is None else self.task.nk

    def search(self, until: float | None) -> None:
        """Orders upwards until two have not gained, then delays of the best small order.

        A long dead time is looked at before large orders, which feign one and take most of the
        time; the smallest orders come first, as networks begin there. The very first is fitted
        however short the time, so that there is a linear model.
        """
        self.add([(ORDERS[0], self.nk)], None)
        self.add([(ORDERS[1], self.nk)], until)
        if self.task.nk is None:
            self.add(self._late(), until)
        best, idle = math.inf, 0
        orders = iter(ORDERS)
        while idle < PATIENCE:
            # as many at once as there are threads, so that none of them waits
            some = [o for _, o in zip(range(max(2, self.pool.threads)), orders, strict=False)]
            if not some:
                break
            self.add(((o, self.nk) for o in some), until)
            for order in some:
                error = self.error(order, self.nk)
                idle = 0 if error < WORTH_AN_ORDER * best else idle + 1
                best = min(best, error)
            if until is not None and self.pool.clock.over() and self.candidates:
                break
        if self.task.nk is None and self.candidates:
            # what looked like an order may have been a delay, so one order less is asked as well
            small = min(self.choice.order, 3)
            self.add(((o, nk) for nk in DELAYS for o in (small - 1, small) if o > 0), until)

    def _late(self) -> list[tuple[int, int]]:
        """Small orders with the estimated dead time, where it is longer than `DELAYS`.

        Large orders feign a dead time at the cost of poles that the drive has not. The estimate can
        be late by a sample.
        """
        data = self.folds[0].shortened(SAMPLES_OF_DELAY, SAMPLES_OF_DELAY).fitted
        try:
            found = delay(data, longest=reach(data)).nk
        except (DataError, FitError):
            return []
        nks = (found - 1, found) if found > max(DELAYS) else ()
        return [(o, nk) for o in LATE_ORDERS for nk in nks]

    def add(self, wanted: Iterable[tuple[int, int]], until: float | None) -> None:
        """Fit these orders and delays on every fold."""
        todo = [w for w in dict.fromkeys(wanted) if w not in self.candidates]
        jobs = [(o, nk, fold) for o, nk in todo for fold in range(len(self.folds))]
        found = iter(self.pool.map(self._fitted, jobs, until=until))
        for order, nk in todo:
            models = tuple(next(found) for _ in self.folds)
            if models[0] is None:
                continue
            errors = tuple(
                RUNAWAY if m is None else errors_of(free_runs(m, f), f)
                for m, f in zip(models, self._excerpts, strict=True)
            )
            self.candidates[order, nk] = LinearCandidate(order, nk, models, errors)

    def _fitted(self, job: tuple[int, int, int], look: Look) -> _core.LinearModel | None:
        order, nk, fold = job
        return fitted(self._excerpts[fold], order, nk, look)

    def error(self, order: int, nk: int) -> float:
        """On the newest fold; infinite where that model was not found."""
        found = self.candidates.get((order, nk))
        return math.inf if found is None else found.rmse

    @property
    def eligible(self) -> list[LinearCandidate]:
        """Those that may be chosen.

        Direct feedthrough is only a network's start, unless it is asked for. A delay makes a model
        smaller, and is believed only where it does as well as the best model without.
        """
        usual = [c for c in self.candidates.values() if c.nk == self.nk]
        least = min((self._pooled(c).rmse for c in usual), default=math.inf) * math.exp(LEAST_GAIN)
        delayed = [c for c in self.candidates.values() if c.nk > self.nk]
        return usual + [c for c in delayed if self._pooled(c).rmse <= least]

    @property
    def best(self) -> LinearCandidate:
        """The lowest error on the newest fold."""
        return min(self.eligible, key=lambda c: c.rmse)

    @property
    def choice(self) -> LinearCandidate:
        """The simplest one within a standard error of the best, over all folds together."""
        return simplest(self.eligible, self._pooled)

    def _pooled(self, c: LinearCandidate) -> Errors:
        """Errors on all folds, each relative to the least one there: every fold counts alike."""
        if len(self.folds) == 1:
            return c.errors[0]
        squares, counts = [], []
        for i, errors in enumerate(c.errors):
            least = min(other.errors[i].rmse for other in self.candidates.values())
            if not math.isfinite(least):  # a budget that ended before this fold's first fit
                continue
            squares.append(errors.squares / max(least, 1e-300) ** 2)
            counts.append(errors.counts)
        if not counts:
            return c.errors[0]
        return Errors(np.concatenate(squares), np.concatenate(counts))

    def start(self, order: int, nk: int) -> _core.LinearModel | None:
        """A model of that order for a network to begin at.

        Where the fit of that order is misled (it has found a slow pole that is none), the smaller
        one with further fast poles.
        """
        fitted_ = self.candidates.get((order, nk))
        smaller = [c for (o, k), c in self.candidates.items() if o < order and k == nk]
        if not smaller:
            return None if fitted_ is None else fitted_.models[0]
        best = min(smaller, key=lambda c: c.rmse)
        own, model = None if fitted_ is None else fitted_.models[0], best.models[0]
        if own is None or model is None:
            return own if model is None else raised(model, order)
        return raised(model, order) if is_misled(own, model, self._excerpts[0]) else own

    def rows(self) -> Iterator[Provenance]:
        """For the table of candidates."""
        yield from (c.to_json() for _, c in sorted(self.candidates.items()))


def simplest(
    candidates: Sequence[LinearCandidate], errors: Callable[[LinearCandidate], Errors]
) -> LinearCandidate:
    """The candidate with the fewest parameters whose error is not credibly above the lowest."""
    best = min(candidates, key=lambda c: errors(c).rmse)
    for c in sorted(candidates, key=lambda c: (c.parameters, c.nk)):
        ratio, deviation = compared(errors(c), errors(best))
        if ratio <= max(deviation, LEAST_GAIN):
            return c
    return best


def fitted(split: Split, order: int, nk: int, look: Look | None) -> _core.LinearModel | None:
    """Output error of that order on what the split learns from; None where there is no model."""
    try:
        return _core.fit_oe(
            arrays(split.fitted),
            na=order,
            nb=order + 1,
            nk=nk,
            max_iterations=ITERATIONS,
            progress=look,
        ).model
    except (FitError, DataError):
        return None


def is_misled(model: _core.LinearModel, smaller: _core.LinearModel, part: Split) -> bool:
    """Whether a model runs clearly worse than a smaller one, on what is held out or was learned.

    A drive that saturates lures a fit to a slow pole that it has not: its free initial state
    follows each record's trend. Started from a few samples such a model fails even on the record
    that it was fitted to.
    """
    for of in (part, replace(part, held=part.fitted)):
        own, other = (errors_of(free_runs(m, of), of).rmse for m in (model, smaller))
        if own > MISLED * other:
            return True
    return False


def raised(model: _core.LinearModel, order: int) -> _core.LinearModel:
    """The same behaviour in a larger order: further poles, each nearly cancelled by a zero."""
    a, b = np.concatenate([[1.0], model.a]), np.array(model.b)
    for pole in SPARE_POLES[: order - model.na]:
        zero = pole - 0.02
        a = np.convolve(a, [1.0, -pole])
        # the same steady gain
        factor = np.array([1.0, -zero]) * (1.0 - pole) / (1.0 - zero)
        b = np.array([np.convolve(row, factor) for row in b])
    offset = model.offset * a.sum() / (1.0 + model.a.sum())
    return _core.LinearModel(np.ascontiguousarray(a[1:]), b, model.nk, float(offset))


def slowest_pole(model: _core.LinearModel) -> float:
    """The largest real pole; 0 where the slowest one oscillates."""
    poles = model.poles()
    slowest = poles[int(np.argmax(np.hypot(poles[:, 0], poles[:, 1])))]
    return float(slowest[0]) if abs(slowest[1]) < 1e-9 else 0.0
