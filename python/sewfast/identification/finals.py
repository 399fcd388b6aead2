"""Finalists: candidates that are credibly better than linear models, trained fully."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .closing import WORTH_IT
from .folds import Split, compared, errors_of, free_runs
from .linear import LinearCandidate, LinearTable
from .search import STILL_NEAR, Search, decayed
from .training import Request, Start
from .trials import (
    BY_FAR,
    SHARE_OF_FINAL,
    SHARE_OF_VERIFYING,
    TRAINING,
    Candidate,
    best_of_each_size,
    median_of,
)

WORTH_LOOKING = 0.97
"""If the median of the starts does not even reach this ratio, no further tests are made."""
VERIFIED = 4
"""Number of structures trained again on the earlier fold."""
FINALISTS = 3
RELEASED = 0.01
"""Weight decay makes the search more reliable but biases its result: one finalist is also trained
with this part of it, and the held-out data decide."""
WITHIN, WITHIN_LARGE = 2.0, 1.3
"""Largest ratio of a finalist's error to the best one's."""
ENOUGH_TO_CHOOSE_BY = 1_500
"""Held-out samples needed to choose a single start, or structure, instead of a median."""
MOST_STARTS_LARGE = 2
"""Starts of a finalist that are trained fully on much data."""
ALONE = 0.98
"""A single start must reduce the median's error to below this part: medians err less often."""
FINAL_OPERATIONS, FINAL_OPERATIONS_LARGE = 1.5e11, 1.25e12
LEGS = 3
LEG_ITERATIONS = 80
BEHIND = 1.15
"""A finalist that is behind by more than this factor after a leg is not trained further."""
BEHIND_LARGE = 1.01
"""The same on much data, where held-out errors are reliable and iterations expensive."""
FINISHED = 0.995
"""A leg that does not reduce the error to below this part ends the training."""


@dataclass
class Finals:
    """The candidates that can be chosen from a search, with the reasons for the model's file.
    `is_hurried` says whether a time budget cuts the full training short.
    """

    search: Search
    reasons: list[str] = field(default_factory=list)
    is_hurried: bool = False

    def __post_init__(self) -> None:
        self.task = self.search.task
        self.wants_network = self.search.wants_network
        self.clock = self.search.pool.clock
        self.split = self.search.folds[0]

    @property
    def linear(self) -> LinearCandidate | None:
        """The linear model with the lowest held-out error, which a network has to beat."""
        return self.search.linear.best if self.search.linear.eligible else None

    # --- against the linear model ---------------------------------------------------------------

    def worth_asking(self) -> list[Candidate]:
        """Candidates that are credibly better than linear models, best first."""
        found = self.search.eligible
        ranked = sorted([c for c in found if c.is_sound], key=lambda c: c.error)
        linear = self.linear
        if self.wants_network or linear is None:
            if self.wants_network:
                self.reasons.append("a state-space network was asked for")
            only = [c for c in ranked or found if c.structure.kind == "neural_ss"]
            return only if self.wants_network else ranked
        if not ranked:
            self.reasons.append(self._why_no_network(found))
            return []
        ratio = ranked[0].error / max(linear.rmse, 1e-300)
        self.reasons.append(
            f"free-run error of the best network on data not trained on: {100 * ratio:.1f} % of "
            "the best linear model's"
        )
        if ratio >= WORTH_LOOKING or self._is_behind_motor(ranked[0]):
            return []
        return ranked if ratio <= BY_FAR else self._verified(ranked, linear)

    def _is_behind_motor(self, best: Candidate) -> bool:
        motor = self.search.motor
        if motor is None or best.error < motor.rmse:
            return False
        self.reasons.append(
            f"{best.error / max(motor.rmse, 1e-300):.2g} times that of the motor's equations"
        )
        return True

    def _why_no_network(self, found: Sequence[Candidate]) -> str:
        if found:
            return "no network forgets its initial state and withstands larger inputs"
        if TRAINING in self.clock.lost:
            return "the time budget left no time for a network"
        return "no network could be trained: too few samples, or no start had a finite free run"

    def _verified(self, ranked: Sequence[Candidate], linear: LinearCandidate) -> list[Candidate]:
        """Those that beat linear models on two later parts, most starts also on their own.
        Forward chaining: the best structure of each size is trained again on the data before an
        earlier fifth, so that a start or part with luck does not decide.
        """
        search = self.search
        asked = best_of_each_size(ranked)[:VERIFIED]
        newest = search.trials[0]
        ratios = {c.structure.size: self._usual(c, newest) / linear.rmse for c in asked}
        winning = [c for c in asked if ratios[c.structure.size] < WORTH_IT]
        passed, parts = [(c.error, c) for c in winning], 1
        if winning and len(search.trials) > 1:
            search.share = SHARE_OF_VERIFYING
            earlier = LinearTable(self.task.nk, [search.folds[1]], search.pool)
            nk = linear.nk
            # another part can need another order, which the network has to beat as well
            orders = {1, 2, 3, search.linear.choice.order, linear.order}
            earlier.add([(o, nk) for o in sorted(orders)], search.until)
            bound = earlier.best.rmse if earlier.candidates else math.inf
            able = [c for c in winning if search.is_affordable(c.structure, 1)]
            again = self._learned_again(able)
            # untested for lack of time is not failed; if that holds for all, one part counts
            if again or not able:
                learned = [c for c, _ in again]
                for c in able:
                    if c not in learned:
                        del ratios[c.structure.size]
                passed, parts = [(c.error, c) for c in winning if c not in able], 2
            for c, other in again:
                ratio = self._usual(other, search.trials[1]) / bound
                ratios[c.structure.size] = max(ratio, ratios[c.structure.size])
                if ratio < WORTH_IT:
                    passed.append((math.sqrt(c.error * other.error), c))
        passed.sort(key=lambda p: p[0])
        # one or two of four sizes can win by luck; most sizes win only if the data show it
        middle = float(np.median(list(ratios.values())))
        self.reasons.append(
            f"{len(passed)} of {len(ratios)} network sizes beat it, most starts alone as well, on "
            f"{parts} later part(s); their median has {100 * middle:.0f} % of its error"
        )
        if middle >= WORTH_IT:
            return []
        sizes = {c.structure.size: c for _, c in passed}
        kept = []
        for c in ranked:
            size = sizes.get(c.structure.size)
            if size is not None and c.structure.hidden <= size.structure.hidden:
                kept.append(c)
        order = [id(c) for _, c in passed]
        return sorted(kept, key=lambda c: order.index(id(c)) if id(c) in order else len(order))

    def _learned_again(self, able: Sequence[Candidate]) -> list[tuple[Candidate, Candidate]]:
        """Those that could be trained afresh on the data before the earlier fifth, with the result.
        A time budget limits the number of starts; if there is no time for two of each, only the
        best structures are trained.
        """
        search = self.search
        starts, least = 3 if search.is_large else 6, 2
        samples = len(search.trials[1].fitted)
        wanted = [80 * c.structure.operations(search.inputs, samples) for c in able]
        share = search.able(starts * sum(wanted))
        starts = max(least, int(share * starts))
        ends = [n for n in range(1, len(able) + 1) if search.able(starts * sum(wanted[:n])) == 1.0]
        some = able[: max(ends, default=1)]
        found = search.tried([(c.structure, 80, starts) for c in some], 1)
        return [(c, other) for c, other in zip(some, found, strict=True) if other.starts]

    def _usual(self, c: Candidate, held: Split) -> float:
        """The error of the median of the starts, or of the median start if that is larger.
        One start of six that is stuck does not count against the others.
        """
        each = [errors_of(free_runs(m, held), held).rmse for m in c.models]
        return max(c.error, float(np.median(each)))

    # --- training to the end --------------------------------------------------------------------

    def finalists(self, ranked: Sequence[Candidate]) -> list[Candidate]:
        """Up to three different structures about as good as the best, different sizes first.
        A search that ends at a wrong size ends there with all its neighbours.
        """
        within = WITHIN_LARGE if len(self.task.data) >= 20_000 else WITHIN
        first = ranked[0]
        found: list[Candidate] = []
        seen: set[tuple[object, ...]] = set()
        firsts = [self._simplest_of_size(c, ranked) for c in best_of_each_size(ranked)]
        for c in (*firsts, *ranked):
            s = c.structure
            key = (s.kind, s.nx, s.hidden, s.nk, s.integrator, s.output.name)
            close = c.error <= within * first.error or (
                # held-out data that repeat the training data cannot rank small networks
                s.integrator and first.structure.integrator and self.search.repeats
            )
            if close and key not in seen and len(found) < FINALISTS:
                seen.add(key)
                found.append(c)
        if all(c.structure.integrator for c in found):
            plain = next((c for c in ranked if not c.structure.integrator), None)
            if plain is not None and plain.error <= STILL_NEAR * first.error:
                found[FINALISTS - 1 :] = [plain]
        self.search.share = SHARE_OF_FINAL
        self.is_hurried = self.search.able(self._operations) < 1.0
        # no second weight decay if there is hardly time to train the starts once
        if self.search.is_released and not (self.is_hurried or first.structure.integrator):
            leading = found[0]
            released = replace(leading, structure=decayed(leading.structure, RELEASED))
            found[FINALISTS - 1 :] = [released]
        return found

    @property
    def _operations(self) -> float:
        """Multiplications of the full training."""
        return FINAL_OPERATIONS_LARGE if self.search.is_large else FINAL_OPERATIONS

    def _simplest_of_size(self, c: Candidate, ranked: Sequence[Candidate]) -> Candidate:
        """The network with the same states and the fewest hidden units that does about as well."""
        same = [o for o in ranked if replace(o.structure, hidden=c.structure.hidden) == c.structure]
        return self.search.simplest([c, *same])

    def finish(self, finalists: Sequence[Candidate]) -> list[Candidate]:
        """More starts, then all fitted data, until the error no longer improves."""
        search, until = self.search, self.search.until
        budget = self._operations * search.able(self._operations)
        alive = self._with_more_starts(finalists, budget / 3.0)
        alive = [replace(self.rejudged(c), converged=False) for c in alive]
        spent = 0.0
        legs = 1 if self.is_hurried else LEGS
        for leg in range(legs):
            going = [c for c in alive if not c.converged]
            if not going or self.clock.over(SHARE_OF_FINAL, "training of the finalists to the end"):
                break
            requests = self._leg(going, (budget - spent) / (legs - leg))
            spent += sum(r.operations for r in requests)
            share = 0.6 + 0.35 * (leg + 1) / legs
            found = search.guarded(search.train(requests, until, share))
            following = [
                self._better(c, starts, r.count)
                for c, starts, r in zip(going, found, requests, strict=True)
            ]
            alive = [c for c in alive if c.converged] + following
            if not (search.repeats and alive[0].structure.integrator):
                best = min(c.error for c in alive)
                behind = BEHIND_LARGE if search.is_large else BEHIND
                alive = [c for c in alive if c.error <= behind * best]
        return sorted(alive, key=lambda c: c.error)

    def _with_more_starts(self, finalists: Sequence[Candidate], budget: float) -> list[Candidate]:
        search, requests = self.search, []
        for c in finalists:
            many = 12 if c.structure.integrator else 6
            many = 4 if len(self.task.data) >= 25_000 and not c.structure.integrator else many
            wanted = many if self.task.starts is None else self.task.starts
            request = search.request(c.structure, 60, starts=1, first=20)
            can = int(budget / len(finalists) / request.operations)
            requests.append(replace(request, starts=max(0, min(wanted - len(c.starts), can))))
        added = search.trained(requests, 0.6)
        return [
            search.judged(c.structure, [*c.starts, *starts], c.iterations)
            for c, starts in zip(finalists, added, strict=True)
        ]

    def _leg(self, alive: Sequence[Candidate], budget: float) -> list[Request]:
        """One leg of the starts that count, with as many iterations as the budget allows."""
        task, requests = self.task, []
        for c in alive:
            each = c.structure.operations(self.search.inputs, len(self.split.fitted))
            share = budget / len(alive)
            most = LEG_ITERATIONS if task.iterations is None else task.iterations
            able = max(1, int(share / (each * 30)))
            kept = c.models[: min(able, MOST_STARTS_LARGE) if self.search.is_large else able]
            iterations = int(min(most, max(5, share / (each * len(kept)))))
            linear = self.search.start(c.structure.nx, c.structure.nk, c.structure.output)
            requests.append(
                Request(
                    c.structure,
                    self.split.fitted,
                    self.split.held,
                    iterations,
                    linear if c.structure.kind == "neural_oe" else None,
                    initial=kept,
                )
            )
        return requests

    def rejudged(self, c: Candidate) -> Candidate:
        """The same starts, judged on all held-out data."""
        models = c.models
        return replace(c, errors=errors_of(free_runs(median_of(models), self.split), self.split))

    def _better(self, before: Candidate, starts: Sequence[Start], count: int) -> Candidate:
        """The candidate after a leg of its first `count` starts, unless it became worse.
        Starts for which there was no time stay in the median, unless the median is credibly better
        without them.
        """
        settled = replace(before, converged=True)
        if not starts:
            return settled
        after = self.rejudged(replace(before, starts=tuple(starts)))
        rest = before.members[count:]
        if rest:
            together = self.rejudged(replace(before, starts=(*starts, *rest)))
            after = after if self._is_better_alone(after, together) else together
        if after.error <= 1.02 * before.error and (after.is_sound or not before.is_sound):
            return replace(self._alone(after), converged=after.error >= FINISHED * before.error)
        return settled

    def _alone(self, c: Candidate) -> Candidate:
        """The best start alone, if enough held-out data show that it is better."""
        if len(c.models) < 2 or self.split.scored < ENOUGH_TO_CHOOSE_BY:
            return c
        # unfinished starts are good at different places: their median is safer
        if self.is_hurried and not self.search.is_large:
            return c
        if c.structure.integrator and self.search.repeats and not self.search.is_large:
            return c
        one = self.rejudged(replace(c, starts=(c.members[0],)))
        return one if self.search.is_large or self._is_better_alone(one, c) else c

    def _is_better_alone(self, some: Candidate, all_: Candidate) -> bool:
        """Whether some of the starts do credibly better: on other data a median errs less often."""
        if self.search.is_large:
            return some.error < all_.error
        ratio, deviation = compared(some.errors, all_.errors)
        return ratio < min(math.log(ALONE), -deviation)
