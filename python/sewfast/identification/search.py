"""The search for a structure: a few steps from a usual one, each kept where free run gains."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..errors import FitError
from .candidate import Candidate, judged, pooled
from .folds import Split, held_out_error
from .memory import Memory, Rectified, Simulator
from .outputs import ABS, LINEAR, Output, named, rectified_start, rms_error, suggested
from .plan import SEARCH_OPERATIONS, Plan
from .task import Pairs, Story, Task, arrays, finite
from .training import Stopped, Structure, Training, train

LINEAR_ORDERS = (1, 2, 3, 4, 5, 6)
WORTH_AN_ORDER = 0.97
"""A larger linear order must bring the error below this part of the smaller one's."""
WORTH_A_DECAY = 0.99
WORTH_A_FEEDTHROUGH = 0.5
"""nk = 0 is no plant for a loop, and a smoothed speed leans ahead a little: it must be worth it."""
USUAL_HIDDEN = 8
WORTH_A_RECTIFIER = 0.9
LEAST_NX, MOST_NX = 2, 8
LEAST_DECAY, MOST_DECAY = 1e-10, 1e-1
SAMPLES_PER_PARAMETER = 4
SHARE_FOR_SEARCH = 0.6
"""Part of a time budget after which no further candidate is tried."""


@dataclass
class Search:
    """One search: what it works on, and the table it fills."""

    task: Task
    plan: Plan
    split: Split
    folds: tuple[Split, ...]
    linear: dict[tuple[int, int, str, int], _core.LinearModel | None] = field(default_factory=dict)
    linear_errors: dict[int, tuple[float, ...]] = field(default_factory=dict)
    order: int = 0
    table: dict[Structure, Candidate] = field(default_factory=dict)
    memories: dict[tuple[int, str, int], Memory | None] = field(default_factory=dict)
    operations: float = 0.0

    @classmethod
    def of(cls, task: Task, plan: Plan, folds: Sequence[Split]) -> Search:
        """A search that has not begun."""
        trials = (f.shortened(plan.trial_samples, plan.held_samples) for f in folds)
        return cls(task, plan, folds[0], tuple(trials))

    @property
    def trial(self) -> Split:
        """The newest fold, as short as trials are."""
        return self.folds[0]

    @property
    def nk(self) -> int:
        """The delay to begin with."""
        return 1 if self.task.nk is None else self.task.nk

    # --- linear models --------------------------------------------------------------------------

    def start_model(
        self, nx: int, nk: int, output: Output = LINEAR, fold: int = 0
    ) -> _core.LinearModel | None:
        """The linear model of that order, fitted once to what the fold learns from."""
        key = (nx, nk, output.name, fold)
        if key not in self.linear:
            data = self.folds[fold].fitted
            if output == ABS:
                self.linear[key] = rectified_start(data, nx, nk)
            else:
                self.linear[key] = _output_error(self.task, arrays(data), nx, nk)
        return self.linear[key]

    def linear_order(self) -> int:
        """The smallest order about as good on all folds as the best; fills `linear_errors`."""
        for order in LINEAR_ORDERS:
            errors = tuple(self._linear_error(order, i) for i in range(len(self.folds)))
            if self.start_model(order, self.nk) is not None:
                self.linear_errors[order] = errors
        self.order = self._smallest_order(pooled)
        return self.order

    def _smallest_order(self, error: Callable[[tuple[float, ...]], float]) -> int:
        chosen = min(self.linear_errors, default=0)
        for order, errors in self.linear_errors.items():
            if error(errors) < WORTH_AN_ORDER * error(self.linear_errors[chosen]):
                chosen = order
        return chosen

    def best_order(self) -> int:
        """The one best on all folds together: for a model that is linear in the end."""
        errors = self.linear_errors
        return min(errors, key=lambda o: pooled(errors[o]), default=self.order)

    def linear_error(self, order: int) -> float:
        """On the newest fold; infinite where that order was not fitted."""
        return self.linear_errors[order][0] if order in self.linear_errors else math.inf

    def _linear_error(self, order: int, fold: int) -> float:
        """No model counts for worse than a constant."""
        model, held = self.start_model(order, self.nk, fold=fold), self.folds[fold]
        return held.spread if model is None else min(held_out_error(model, held), held.spread)

    # --- networks -------------------------------------------------------------------------------

    def ladder(self) -> Candidate | None:
        """The best candidate after all steps; None where no network could be trained.

        It begins with as many states as the order of the linear model that the newest fold, where
        networks are judged, asks for.
        """
        order = self._smallest_order(lambda errors: errors[0])
        nx = self.task.nx or min(max(order, LEAST_NX), LINEAR_ORDERS[-1])
        hidden = (USUAL_HIDDEN, 4, 2) if self.task.hidden is None else (self.task.hidden,)
        sizes = (Structure(nx, self.nk, h, self.plan.decay) for h in hidden)
        base = next(filter(self.is_affordable, sizes), None)
        if base is None:
            return None
        best = self._best_of(replace(base, output=o) for o in self._outputs(nx))
        for step in (
            self._delays,
            self._decays,
            self._sizes,
            self._orders,
            self._sizes,
            self._decays,
        ):
            best = step(best)
        return best if best is not None and math.isfinite(best.error) else None

    def _outputs(self, nx: int) -> list[Output]:
        data = self.trial.fitted
        if self.task.output is not None:
            return [named(self.task.output, data)]
        return [o for o in suggested(data) if o != ABS or self._is_rectified(nx)]

    def _is_rectified(self, nx: int) -> bool:
        """Whether a linear model behind a rectifier does better than one without."""
        plain, behind = self.start_model(nx, self.nk), self.start_model(nx, self.nk, ABS)
        if plain is None or behind is None:
            return behind is not None
        pairs = arrays(self.trial.fitted)
        return rms_error(behind, pairs, np.abs) < WORTH_A_RECTIFIER * rms_error(plain, pairs)

    def _decays(self, best: Candidate | None) -> Candidate | None:
        if best is None:
            return None
        step = self.plan.decay_step
        weaker = self._climbed(best, lambda s: _decayed(s, 1.0 / step), WORTH_A_DECAY)
        if weaker is not best:
            return weaker
        return self._climbed(best, lambda s: _decayed(s, step), WORTH_A_DECAY)

    def _orders(self, best: Candidate | None) -> Candidate | None:
        if best is None or self.task.nx is not None:
            return best
        larger = self._climbed(best, _with_a_state_more)
        if larger is not best or best.structure.nx <= 1:
            return larger
        return self._climbed(best, lambda s: replace(s, nx=s.nx - 1) if s.nx > 1 else None)

    def _sizes(self, best: Candidate | None) -> Candidate | None:
        if best is None or self.task.hidden is not None:
            return best
        most = self.plan.most_hidden
        larger = self._climbed(
            best, lambda s: replace(s, hidden=2 * s.hidden) if 2 * s.hidden <= most else None
        )
        if larger is not best:
            return larger
        return self._best_of([replace(best.structure, hidden=best.structure.hidden // 2)], best)

    def _delays(self, best: Candidate | None) -> Candidate | None:
        if best is None or self.task.nk is not None:
            return best
        later = self._best_of([replace(best.structure, nk=2)], best) or best
        if self.task.data.counts is not None:
            return later
        return self._best_of([replace(best.structure, nk=0)], later, WORTH_A_FEEDTHROUGH)

    def _climbed(
        self,
        best: Candidate,
        step: Callable[[Structure], Structure | None],
        worth: float | None = None,
    ) -> Candidate:
        """Steps of one kind as long as each is worth it."""
        while (following := step(best.structure)) is not None:
            tried = self._best_of([following], best, worth)
            if tried is best or tried is None:
                break
            best = tried
        return best

    def _best_of(
        self,
        structures: Iterable[Structure],
        best: Candidate | None = None,
        worth: float | None = None,
    ) -> Candidate | None:
        for structure in structures:
            tried = self._tried(structure)
            if tried is None:
                continue
            if best is None or tried.is_better(best, worth or self.plan.worth_a_step):
                best = tried
        return best

    def _tried(self, structure: Structure) -> Candidate | None:
        """The candidate, from the table where it was tried before; None where it cannot be."""
        if structure in self.table:
            return self.table[structure]
        if self._is_over() or not self.is_affordable(structure):
            return None
        self.table[structure] = self.trial_on(structure)
        return self.table[structure]

    def trial_on(self, structure: Structure, fold: int = 0) -> Candidate:
        """The structure trained on what a fold learns from and judged on what it holds out."""
        plan = self.plan
        training = self.training(structure, plan.trial_starts, plan.trial_iterations, fold)
        starts = train(self.task, structure, training)
        self.operations += training.operations(structure)
        return judged(structure, starts, self.folds[fold])

    def _is_over(self) -> bool:
        """Time or work is used up; the first candidate is always tried."""
        out_of_time = self.task.clock.over(SHARE_FOR_SEARCH)
        return bool(self.table) and (out_of_time or self.operations > SEARCH_OPERATIONS)

    def training(
        self, structure: Structure, starts: int, iterations: int, fold: int = 0
    ) -> Training:
        """A training of the structure on what the fold learns from."""
        return Training(
            self.folds[fold].fitted,
            self.folds[fold].held,
            self.start_model(structure.nx, structure.nk, structure.output, fold),
            starts if self.task.starts is None else self.task.starts,
            _limited(iterations, self.task),
            memory=self.memory(self.folds[fold].fitted, structure.output, fold),
        )

    def memory(self, data: Dataset, output: Output, fold: int = 0) -> Memory | None:
        """The bound on a network's memory that linear models set; computed once."""
        key = (id(data), output.name, fold)
        if key not in self.memories:
            self.memories[key] = self._memory(data, output, fold)
        return self.memories[key]

    def _memory(self, data: Dataset, output: Output, fold: int) -> Memory | None:
        """Of the chosen order; behind a rectifier as well where the network is."""
        outputs = [LINEAR, ABS] if output == ABS else [LINEAR]
        known: list[Simulator] = []
        for o in outputs:
            linear = self.start_model(max(self.order, 1), self.nk, o, fold)
            if linear is not None:
                known.append(Rectified(linear) if o == ABS else linear)
        return Memory.of(known, data) if known else None

    def is_affordable(self, structure: Structure, fold: int = 0) -> bool:
        """Whether the fold has samples enough for its parameters."""
        wanted = structure.parameters(self.task.data.n_inputs) * SAMPLES_PER_PARAMETER
        is_fixed = None not in (self.task.nx, self.task.hidden)
        return is_fixed or wanted <= len(self.folds[fold].fitted)

    def rows(self) -> Iterator[Story]:
        """The table: linear models, then networks in the order of their trials."""
        for order, errors in self.linear_errors.items():
            row: Story = {"kind": "oe", "na": order, "nb": order + 1, "nk": self.nk}
            yield row | {"free_run_rmse": finite(pooled(errors))}
        yield from (c.to_json() for c in self.table.values())


def _with_a_state_more(structure: Structure) -> Structure | None:
    return replace(structure, nx=structure.nx + 1) if structure.nx < MOST_NX else None


def _decayed(structure: Structure, factor: float) -> Structure | None:
    """With another weight decay, as long as that can matter."""
    decay = float(f"{structure.decay * factor:.0e}")
    return replace(structure, decay=decay) if LEAST_DECAY <= decay <= MOST_DECAY else None


def _limited(iterations: int, task: Task) -> int:
    return iterations if task.iterations is None else min(iterations, task.iterations)


def _output_error(task: Task, pairs: Pairs, order: int, nk: int) -> _core.LinearModel | None:
    try:
        fit = _core.fit_oe(pairs, **task.fit_options(na=order, nb=order + 1, nk=nk))
    except FitError:
        return None
    if fit.termination == "interrupted":
        raise Stopped([])
    return fit.model
