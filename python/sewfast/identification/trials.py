"""The basis of a search: trained candidates, their held-out errors, and the effort spent.

Effort is counted in multiplications, not in seconds, so that a seed gives the same model on every
machine; a time budget is converted into multiplications by the speed of the first trials.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from .. import _core
from ..errors import FitError
from ..models.base import EnsembleCore
from .folds import RUNAWAY, Errors, Split, errors_of, free_runs, thinned
from .grey_box import MotorCandidate
from .linear import SAMPLES, LinearTable, fitted
from .outputs import ABS, LINEAR, Output, rectified_start
from .task import Look, Pool, Provenance, Task, arrays, finite
from .training import Network, Request, Start, Structure, counting, guarded, train

LARGE = 45_000
"""Samples above which a data set is large."""
TRIAL_SAMPLES, TRIAL_SAMPLES_LARGE = 20_000, 12_000
"""Fitted samples of a trial. Fewer than 20,000 raise the final error by a factor of up to 3."""
SEARCH_OPERATIONS, SEARCH_OPERATIONS_LARGE = 1.8e11, 5e11
"""Multiplications after which the search ends; a core does some 1.4e10 per second."""
SAMPLES_PER_PARAMETER = 4
BY_FAR = 0.2
"""Below this part of the linear error on the newest part, a network needs no further evidence."""
NEARLY = 1.02
"""In trials on much data an error larger by up to this factor counts as equal: a smaller network
trains further in the same time, and extrapolates better."""
WORTH_A_FEEDTHROUGH, STILL_WORTH_A_FEEDTHROUGH = 0.5, 0.9
"""Error ratios required of nk = 0, compared with equal size, and with the best with a delay (whose
additional states can compensate). nk = 0 is no plant for a loop, and a smoothed speed anticipates
the input a little."""
TRAINING = "training of networks"
"""What is lost if a time budget ends before a network is trained, or while one is."""
REFIT_LOST, DIAGNOSIS = "the fit to all samples", "the diagnosis of the record"
"""What is lost if a budget ends before these."""
SHARE_OF_LINEAR = 0.12
"""Part of a time budget for linear models but the smallest."""
SHARE_OF_SEARCH, SHARE_OF_SEARCH_VERIFIED = 0.58, 0.45
"""Parts of it after which no further network is tried."""
SHARE_OF_VERIFYING, SHARE_OF_FINAL, SHARE_OF_REFIT = 0.64, 0.89, 0.94
"""Parts of it by which the stages after the search must be finished."""
SHARE_OF_LINEAR_STARTS = 0.1
"""Part of it for fitting the linear models at which the next networks start; networks whose model
is not ready start at a smaller one."""


@dataclass(frozen=True)
class Candidate:
    """A structure, its trained starts, and the held-out errors of their median."""

    structure: Structure
    starts: tuple[Start, ...]
    errors: Errors
    iterations: int
    converged: bool = False

    @property
    def error(self) -> float:
        """Root mean square error on held-out data."""
        return self.errors.rmse

    @property
    def members(self) -> list[Start]:
        """The starts that count: sound if any is, not far worse than the best; best first."""
        return counting(self.starts)

    @property
    def models(self) -> list[Network]:
        """Networks of the starts that count."""
        return [s.model for s in self.members]

    @property
    def is_sound(self) -> bool:
        """Whether any start passed the guard."""
        return any(s.is_sound for s in self.starts)

    def to_json(self) -> Provenance:
        """The candidate's row of the table."""
        row = self.structure.to_json() | {"starts": len(self.starts)}
        row |= {"sound": sum(s.is_sound for s in self.starts)}
        return row | {"free_run_rmse": finite(self.error)}


def best_of_each_size(ranked: Iterable[Candidate]) -> list[Candidate]:
    """The first one of each kind and number of states."""
    found: dict[tuple[object, ...], Candidate] = {}
    for c in ranked:
        found.setdefault(c.structure.size, c)
    return list(found.values())


def median_of(models: Sequence[Network]) -> Any:
    """One model unchanged, several as their median."""
    return models[0] if len(models) == 1 else EnsembleCore(tuple(models), "median")


@dataclass
class Trials:
    """Data of a search, the effort it has spent, and the candidates it found.
    `trials` are the folds, shortened for trials, the newest first. `candidates` are those on the
    newest fold, each after its latest training; `operations` counts multiplications.
    """

    task: Task
    folds: tuple[Split, ...]
    pool: Pool
    wants_network: bool = False
    candidates: dict[Structure, Candidate] = field(default_factory=dict)
    operations: float = 0.0

    def __post_init__(self) -> None:
        self.samples = len(self.task.data)
        self.inputs = self.task.data.n_inputs
        size = TRIAL_SAMPLES_LARGE if self.is_large else TRIAL_SAMPLES
        self.trials = tuple(f.shortened(size, size) for f in self.folds[:2])
        self.linear = LinearTable(self.task.nk, self.folds[:1], self.pool)
        self.most = SEARCH_OPERATIONS_LARGE if self.is_large else SEARCH_OPERATIONS
        self.budget, self.rate = self.most, 0.0
        # part of a time budget by which the present stage must be finished; 0 for the search's own
        self.share = 0.0
        # whether the screening found that the output depends on the input of the same sample
        self.feeds_through = False
        # the equations of a motor, if the data are those of one
        self.motor: MotorCandidate | None = None
        self._starts: dict[tuple[int, int, str, int], _core.LinearModel | None] = {}
        self._guarded = arrays(self.task.data)

    @property
    def is_large(self) -> bool:
        """Whether the data are many: little variance, and larger networks can pay."""
        return self.samples > LARGE

    @property
    def decay(self) -> float:
        """Initial weight decay."""
        return 1e-7 if self.is_large else 1e-5

    @property
    def until(self) -> float | None:
        """Deadline of the present stage, on `time.perf_counter`."""
        return self.pool.clock.until(self.share or self._share_of_search)

    @property
    def _share_of_search(self) -> float:
        """Share of a time budget; networks that are not far better need time for verification."""
        best, linear = self.best, self.linear
        if self.wants_network or best is None or not linear.eligible:
            return SHARE_OF_SEARCH
        # the climb can be expected to halve the error
        is_by_far = best.error <= 2.0 * BY_FAR * linear.best.rmse
        return SHARE_OF_SEARCH if is_by_far else SHARE_OF_SEARCH_VERIFIED

    @property
    def _until_started(self) -> float | None:
        """Deadline of the linear models at which networks start."""
        most = self.share or self._share_of_search
        return self.pool.clock.within(SHARE_OF_LINEAR_STARTS, most)

    def able(self, operations: float) -> float:
        """Part of these operations for which the present stage has time, at most 1."""
        if self.until is None:
            return 1.0
        left = max(0.0, self.until - time.perf_counter())
        return min(1.0, left * self.rate / max(operations, 1.0))

    @property
    def is_over(self) -> bool:
        """Whether the search has used up its operations or its share of the time budget."""
        if self._is_late:
            self.pool.clock.lose("larger networks")
        return self._is_late or self.operations >= self.budget

    @property
    def _is_late(self) -> bool:
        return self.until is not None and time.perf_counter() >= self.until

    def _calibrate(self, seconds: float, operations: float) -> None:
        """Convert the rest of a time budget into multiplications, by the best speed so far."""
        until = self.until
        # short trainings of small networks are slower per multiplication than long ones
        self.rate = max(self.rate, operations / max(seconds, 1e-3))
        if until is not None:
            left = max(0.0, until - time.perf_counter())
            self.budget = min(self.most, self.operations + self.rate * left)

    def _limited(self, starts: int) -> int:
        return starts if self.task.starts is None else min(starts, self.task.starts)

    # --- what has been found ----------------------------------------------------------------------

    @property
    def best(self) -> Candidate | None:
        """The candidate with the lowest held-out error, a sound one if possible."""
        return self._lowest(self.eligible)

    def best_of(self, kind: str) -> Candidate | None:
        """The same among candidates of one kind."""
        return self._lowest(c for c in self.eligible if c.structure.kind == kind)

    def _ranked(self, kind: str) -> list[Candidate]:
        """The best sound candidate of each size of one kind, the best first."""
        sound = [c for c in self.eligible if c.structure.kind == kind and c.is_sound]
        return best_of_each_size(sorted(sound, key=lambda c: c.error))

    @property
    def eligible(self) -> list[Candidate]:
        """Candidates that can be chosen; direct feedthrough only if it is worth it."""
        found = [c for c in self.candidates.values() if math.isfinite(c.error) and c.starts]
        delayed = min((c.error for c in found if c.structure.nk > 0), default=math.inf)
        worth = STILL_WORTH_A_FEEDTHROUGH if self.feeds_through else WORTH_A_FEEDTHROUGH
        most = delayed if self.task.nk == 0 else worth * delayed
        return [c for c in found if c.structure.nk > 0 or c.error < most]

    @staticmethod
    def _lowest(candidates: Iterable[Candidate]) -> Candidate | None:
        finite_ = [c for c in candidates if math.isfinite(c.error)]
        sound = [c for c in finite_ if c.is_sound] or finite_
        return min(sound, key=lambda c: c.error, default=None)

    def simplest(self, candidates: Sequence[Candidate]) -> Candidate:
        """The best one; on much data the one with fewest parameters that does about as well."""
        most = (NEARLY if self.is_large else 1.0) * min(c.error for c in candidates)
        near = [c for c in candidates if c.error <= most]
        return min(near, key=lambda c: (c.structure.parameters(self.inputs), c.error))

    def rows(self) -> Iterator[Provenance]:
        """Rows of the table: linear models, then networks in the order of their trials."""
        yield from self.linear.rows()
        yield from () if self.motor is None else (self.motor.to_json(),)
        yield from (c.to_json() for c in self.candidates.values())

    # --- training -------------------------------------------------------------------------------

    def is_affordable(self, s: Structure, fold: int = 0) -> bool:
        """Whether the fold has enough samples for the parameters."""
        parameters, fitted = s.parameters(self.inputs), self.trials[fold].fitted
        known = sum(len(e) - e.unmeasured for e in fitted.experiments)
        # the core only trains with a surplus over parameters and initial states
        if known <= parameters + s.nx * len(fitted.experiments):
            return False
        is_given = None not in (self.task.nx, self.task.hidden)
        return is_given or parameters * SAMPLES_PER_PARAMETER <= len(fitted)

    def tried(
        self,
        wanted: Sequence[tuple[Structure, int, int]],
        fold: int = 0,
        share: float | None = None,
    ) -> list[Candidate]:
        """Candidates of (structure, iterations, starts), trained afresh side by side."""
        self._prepare([s for s, _, _ in wanted], fold)
        requests = [self.request(s, i, starts=n, fold=fold) for s, i, n in wanted]
        found = self.trained(requests, share)
        pairs = zip(wanted, found, strict=True)
        return [self.judged(s, starts, i, fold) for (s, i, _), starts in pairs]

    def continued(
        self, candidates: Sequence[Candidate], iterations: int, fresh: Sequence[int]
    ) -> list[Candidate]:
        """Candidates trained further, each with some fresh starts; never worse than before."""
        requests = []
        for c, more in zip(candidates, fresh, strict=True):
            requests.append(self.request(c.structure, iterations, initial=c.models))
            total = c.iterations + iterations
            more = min(more, self._limited(more + len(c.starts)) - len(c.starts))
            requests.append(
                self.request(c.structure, total, starts=max(more, 0), first=len(c.starts))
            )
        trained = iter(self.trained(requests))
        found = []
        for c in candidates:
            starts = [*next(trained), *next(trained)]
            new = self.judged(c.structure, starts, c.iterations + iterations)
            if new.error > c.error:
                new = replace(c, iterations=c.iterations + iterations, converged=True)
            else:
                new = replace(new, converged=new.error > 0.995 * c.error)
            self.candidates[c.structure] = new
            found.append(new)
        return found

    def request(
        self,
        s: Structure,
        iterations: int,
        *,
        starts: int = 0,
        first: int = 0,
        initial: Sequence[Network] = (),
        fold: int = 0,
    ) -> Request:
        """Request for starts of a structure on a trial's data, or for training models further."""
        data = self.trials[fold]
        needs_linear = not initial or s.kind == "neural_oe"
        linear = self.start(s.nx, s.nk, s.output, fold) if needs_linear else None
        most = self.task.iterations
        iterations = iterations if most is None else min(iterations, most)
        return Request(s, data.fitted, data.held, iterations, linear, starts, first, tuple(initial))

    def trained(
        self,
        requests: Sequence[Request],
        share: float | None = None,
    ) -> list[list[Start]]:
        """Starts of every request, checked by the guard."""
        wanted = sum(r.operations for r in requests)
        self.operations += wanted
        began = time.perf_counter()
        if share is None:
            share = max(self.pool.share, min(0.6, 0.25 + 0.35 * self.operations / self.budget))
        found = self.train(requests, self.until, share)
        # without training there is no speed to measure
        if wanted and not self._is_late:
            self._calibrate(time.perf_counter() - began, wanted)
        return self.guarded(found)

    def train(
        self,
        requests: Sequence[Request],
        until: float | None,
        share: float,
        what: str = TRAINING,
    ) -> list[list[Start]]:
        """Starts of every request, not yet checked, outside the count of operations."""
        seed, workers = self.task.seed, self.task.workers
        return train(
            requests, self.pool, seed, workers=workers, until=until, share=share, what=what
        )

    def guarded(self, found: Sequence[Sequence[Start]]) -> list[list[Start]]:
        """The starts with the guard's findings on whole records."""
        return guarded(found, self._guarded, self.bounding_models, self.pool)

    @property
    def bounding_models(self) -> list[_core.LinearModel]:
        """Linear models whose memory of the initial state bounds that of networks."""
        if not self.linear.eligible:
            return []
        most = max(2, self.linear.choice.order)
        usable = [c for c in self.linear.eligible if c.order <= most]
        model = max(usable, key=lambda c: c.order).models[0]
        return [] if model is None else [model]

    def judged(
        self, s: Structure, starts: Sequence[Start], iterations: int, fold: int = 0
    ) -> Candidate:
        """The candidate with the held-out errors of its members' median."""
        models = [start.model for start in counting(starts)]
        held = self.trials[fold]
        errors = errors_of(free_runs(median_of(models), held), held) if models else RUNAWAY
        found = Candidate(s, tuple(starts), errors, iterations)
        if fold == 0:
            self.candidates[s] = found
            self.pool.best = min(self.pool.best, found.error)
        return found

    def start(
        self, nx: int, nk: int, output: Output = LINEAR, fold: int = 0
    ) -> _core.LinearModel | None:
        """The linear model at which networks of this order and delay start."""
        if fold == 0 and output != ABS:
            self.linear.add([(nx, nk)], self.until)
            return self.linear.start(nx, nk)
        key = (nx, nk, output.name, fold)
        if key not in self._starts:
            self._prepare([Structure(nx, nk, 1, 0.0, output)], fold)
        return self._starts[key]

    def _prepare(self, structures: Sequence[Structure], fold: int) -> None:
        """Fit the models that `start` needs, in parallel."""
        plain = {(s.nx, s.nk) for s in structures if s.output != ABS}
        if fold == 0:
            self.linear.add(sorted(plain), self._until_started)
        keys = {
            (s.nx, s.nk, s.output.name, fold): s for s in structures if s.output == ABS or fold > 0
        }
        missing = [(k, s) for k, s in keys.items() if k not in self._starts]

        def fit(job: tuple[Any, Structure], look: Look) -> _core.LinearModel | None:
            s, data = job[1], self.trials[fold].fitted
            try:
                if s.output == ABS:
                    return rectified_start(data, s.nx, s.nk, look)
                return fitted(thinned(data, SAMPLES), s.nx, s.nk, look)
            except FitError:
                return None

        for (key, _), model in zip(
            missing,
            self.pool.map(fit, missing, until=self.until, what="linear starts of networks"),
            strict=True,
        ):
            self._starts[key] = model
