"""Which candidate becomes the model: against linear ones, trained to the end, guarded, refitted.

A candidate that fails a question makes room for the next one; the linear model is returned only
where no network is credibly better. What was second stays with the model, in `alternatives`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..dataset.experiment import mean_square, weights_of
from ..errors import FitError, Interrupted
from ..models import Ensemble, LinearOE, Model, NeuralOE, NeuralSS
from .effort import Look, Pool, Stopped
from .folds import LEAST_HELD_OUT, SHARE, Split, compared, errors_of, folds, free_runs
from .linear import linear_model
from .orders import LEAST_GAIN, LinearCandidate, LinearTable
from .search import STILL_NEAR, Search, decayed
from .task import Provenance, Task, arrays, documented, finite, with_provenance, wrap
from .training import Network, Request, Start, Structure, train
from .trials import (
    BY_FAR,
    STILL_WORTH_A_FEEDTHROUGH,
    Candidate,
    best_of_each_size,
    counting,
    median_of,
)
from .verdict import verdict

WORTH_IT = 0.9
"""A network must bring the error below this part of the best linear model's."""
WORTH_LOOKING = 0.97
"""Where the median of the starts does not even reach this, nothing is asked."""
LEAST_PASSING = 0.5
"""Part of the network sizes that must beat linear models on the earlier part, too."""
VERIFIED = 4
"""Structures that are learned again on the earlier fold."""
FINALISTS = 3
RELEASED = 0.01
"""Weight decay makes the search surer, and biases what it finds: one finalist is trained with this
part of it as well, and what is held out decides."""
WITHIN, WITHIN_LARGE = 2.0, 1.3
"""How much larger than the best one's a finalist's error may be."""
WORTH_AN_INTEGRATOR = 0.7
ENOUGH_TO_CHOOSE_BY = 1_500
"""Held-out samples from which on a single start, or structure, may be taken instead of a median."""
MOST_STARTS_LARGE = 2
"""Starts of a finalist that are trained to the end on much data."""
ALONE = 0.98
"""A single start must bring the error of the median below this part: a median errs less often."""
ABOUT_EQUAL = 0.02
"""Up to this larger an error on little data counts as none: fewer parameters are the safer bet."""
MOST_MEMBERS = 15
"""Of an ensemble: a controller is tuned on every one, and a median of more is hardly better."""
MOST_ALTERNATIVES = 2
LIKELY = 1.5
"""Linear models whose error on the newest part is within this factor are asked on earlier ones."""
TOGETHER = 1.25
"""On little data the median goes over all finalists whose error is within this factor."""
FINAL_OPERATIONS, FINAL_OPERATIONS_LARGE = 1.5e11, 1.25e12
LEGS = 3
LEG_ITERATIONS = 80
BEHIND = 1.15
"""A finalist that is behind by more after a leg is not trained on."""
BEHIND_LARGE = 1.01
"""The same on much data, where held-out errors are sure and iterations dear."""
FINISHED = 0.995
"""A leg that does not bring the error below this part ends the training."""
SHARE_OF_VERIFYING, SHARE_OF_FINAL, SHARE_OF_REFIT = 0.64, 0.84, 0.9
"""Parts of a time budget at which each stage has to be done."""


def auto(task: Task) -> Model:
    """The network where it is credibly better, else linear output error."""
    return _identified(task, wants_network=False)


def neural_ss(task: Task) -> Model:
    """The state-space network, whether it is better or not."""
    return _identified(task, wants_network=True)


def _identified(task: Task, wants_network: bool) -> Model:
    began = time.perf_counter()
    parts = folds(task.data, task.validation)
    if not parts:
        return _without_held_out(task, began, wants_network)
    pool = Pool(task.threads, task.clock, task.progress)
    search = Search(task, parts, pool, wants_network)
    choice = Choice(search, began)
    try:
        search.run()
        return choice.model()
    except (Stopped, KeyboardInterrupt) as stopped:
        # Ctrl-C also comes between two pieces of compiled work
        raise Interrupted(choice.best_so_far(stopped)) from None


@dataclass
class Choice:
    """The end of a search: from its candidates to one model."""

    search: Search
    began: float
    reasons: list[str] = field(default_factory=list)
    is_linear: bool = False

    def __post_init__(self) -> None:
        self.task = self.search.task
        self.wants_network = self.search.wants_network
        self.clock = self.search.pool.clock
        self.split = self.search.folds[0]

    def model(self) -> Model:
        """The chosen model, with the second best as alternatives."""
        asked = self._worth_asking()
        while asked:
            finalists = self._finalists(asked)
            finished = self._finish(finalists)
            chosen = self._sound_and_settled(finished)
            if chosen:
                others = [c for c in finished if c.is_sound and c not in chosen]
                return self._network(chosen, others)
            asked = [c for c in asked if c.structure not in {f.structure for f in finalists}]
            if self.clock.over(SHARE_OF_FINAL):
                break
        if self.wants_network:
            return self._network(self._any_network(), [])
        self.is_linear = True
        return self._linear()

    # --- against the linear model ---------------------------------------------------------------

    @property
    def linear(self) -> LinearCandidate | None:
        """The linear model with the lowest held-out error: what a network has to beat."""
        return self.search.linear.best if self.search.linear.eligible else None

    def _worth_asking(self) -> list[Candidate]:
        """Candidates credibly better than linear, the best first."""
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
        if ratio >= WORTH_LOOKING:
            return []
        return ranked if ratio <= BY_FAR else self._verified(ranked, linear)

    def _why_no_network(self, found: Sequence[Candidate]) -> str:
        if found:
            return "no network forgets its initial state and withstands larger inputs"
        if self.clock.truncated:
            return "the time budget left no time for a network"
        return "no network could be trained: too few samples, or no start had a finite free run"

    def _verified(self, ranked: Sequence[Candidate], linear: LinearCandidate) -> list[Candidate]:
        """Those that beat linear models on two later parts, most starts alone as well.

        Forward chaining: the best structure of each size is learned again from what is before an
        earlier fifth, so that a win by luck, of the start or of the part, is none.
        """
        search = self.search
        asked = best_of_each_size(ranked)[:VERIFIED]
        newest = search.trials[0]
        winning = [c for c in asked if self._usual(c, newest) < WORTH_IT * linear.rmse]
        passed, parts = [(c.error, c) for c in winning], 1
        if winning and len(search.trials) > 1:
            search.share = SHARE_OF_VERIFYING
            earlier = LinearTable(self.task, [search.folds[1]], search.pool)
            nk = linear.nk
            # another part may ask for another order, and the network has to beat that one, too
            orders = {1, 2, 3, search.linear.choice.order, linear.order}
            earlier.add([(o, nk) for o in sorted(orders)], search.until)
            bound = earlier.best.rmse if earlier.candidates else math.inf
            able = [c for c in winning if search.is_affordable(c.structure, 1)]
            again = self._learned_again(able)
            # what the time budget has left unasked has not failed; where it is all, one part counts
            if again or not able:
                learned = [c for c, _ in again]
                unasked = [c for c in able if c not in learned]
                asked = [c for c in asked if c not in unasked]
                passed, parts = [(c.error, c) for c in winning if c not in able], 2
            for c, other in again:
                if self._usual(other, search.trials[1]) < WORTH_IT * bound:
                    passed.append((math.sqrt(c.error * other.error), c))
        passed.sort(key=lambda p: p[0])
        self.reasons.append(
            f"{len(passed)} of {len(asked)} network sizes beat it, most starts alone as well, on "
            f"{parts} later part(s)"
        )
        if len(passed) < LEAST_PASSING * len(asked):
            # one of four sizes passes by luck now and then; what the data show, most sizes can see
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
        """Those that could be learned afresh from what is before the earlier fifth, and how.

        With a time budget in as many starts as there is time for; if not even two of each, then the
        best structures alone.
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
        """The error of the median of the starts, or of the median start where that is larger.

        One start of six that is stuck says nothing of the others.
        """
        each = [errors_of(free_runs(m, held), held).rmse for m in c.models]
        return max(c.error, float(np.median(each)))

    # --- training to the end --------------------------------------------------------------------

    def _finalists(self, ranked: Sequence[Candidate]) -> list[Candidate]:
        """Up to three of different structure, about as good as the best; of different size first.

        A search that has led to the wrong size has led there with all its neighbours.
        """
        within = WITHIN_LARGE if len(self.task.data) >= 20_000 else WITHIN
        first = ranked[0]
        found: list[Candidate] = []
        seen: set[tuple[object, ...]] = set()
        for c in (*best_of_each_size(ranked), *ranked):
            s = c.structure
            key = (s.kind, s.nx, s.hidden, s.nk, s.integrator, s.output.name)
            close = c.error <= within * first.error or (
                # held-out data that repeat what was learned do not tell small networks apart
                s.integrator and first.structure.integrator and self.search.repeats
            )
            if close and key not in seen and len(found) < FINALISTS:
                seen.add(key)
                found.append(c)
        if all(c.structure.integrator for c in found):
            plain = next((c for c in ranked if not c.structure.integrator), None)
            if plain is not None and plain.error <= STILL_NEAR * first.error:
                found[FINALISTS - 1 :] = [plain]
        if self.search.is_released and not first.structure.integrator:
            released = replace(first, structure=decayed(first.structure, RELEASED))
            found[FINALISTS - 1 :] = [released]
        return found

    def _finish(self, finalists: Sequence[Candidate]) -> list[Candidate]:
        """More starts, then all fitted data, until nothing is gained any more."""
        search = self.search
        search.share = SHARE_OF_FINAL
        until = search.until
        budget = FINAL_OPERATIONS_LARGE if search.is_large else FINAL_OPERATIONS
        budget *= search.able(budget)
        alive = self._with_more_starts(finalists, budget / 3.0)
        alive = [self._rejudged(c) for c in alive]
        spent = 0.0
        for leg in range(LEGS):
            if self.clock.over(SHARE_OF_FINAL):
                break
            requests = self._leg(alive, (budget - spent) / (LEGS - leg))
            spent += sum(r.operations for r in requests)
            found = search.guarded(
                train(
                    requests,
                    search.pool,
                    self.task.seed,
                    workers=self.task.workers,
                    until=until,
                    share=0.6 + 0.35 * (leg + 1) / LEGS,
                )
            )
            following = [self._better(c, starts) for c, starts in zip(alive, found, strict=True)]
            gained = any(
                n.error < FINISHED * c.error for c, n in zip(alive, following, strict=True)
            )
            alive = following
            if not search.is_small and not (search.repeats and alive[0].structure.integrator):
                best = min(c.error for c in alive)
                behind = BEHIND_LARGE if search.is_large else BEHIND
                alive = [c for c in alive if c.error <= behind * best]
            if not gained:
                break
        return sorted(alive, key=lambda c: c.error)

    def _with_more_starts(self, finalists: Sequence[Candidate], budget: float) -> list[Candidate]:
        search, requests = self.search, []
        for c in finalists:
            many = 16 if search.is_small else 12 if c.structure.integrator else 6
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
        """One leg for the starts that count: as many iterations as the budget allows."""
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

    def _rejudged(self, c: Candidate) -> Candidate:
        """The same starts, judged on all that is held out."""
        models = c.models
        return replace(c, errors=errors_of(free_runs(median_of(models), self.split), self.split))

    def _better(self, before: Candidate, starts: Sequence[Start]) -> Candidate:
        """The candidate after a leg, unless that has made it worse."""
        if not starts:
            return before
        after = self._rejudged(replace(before, starts=tuple(starts)))
        if after.error <= 1.02 * before.error and (after.is_sound or not before.is_sound):
            return self._alone(after)
        return before

    def _alone(self, c: Candidate) -> Candidate:
        """The best start alone, where long held-out data say that it is better so."""
        if len(c.models) < 2 or self.split.scored < ENOUGH_TO_CHOOSE_BY:
            return c
        if self.search.is_large:
            return self._rejudged(replace(c, starts=(c.members[0],)))
        if c.structure.integrator and self.search.repeats:
            return c
        one = self._rejudged(replace(c, starts=(c.members[0],)))
        return one if one.error < ALONE * c.error else c

    # --- the choice -----------------------------------------------------------------------------

    def _sound_and_settled(self, finished: Sequence[Candidate]) -> list[Candidate]:
        """The chosen candidate and those that join its median; empty where none may be taken."""
        able = [c for c in finished if c.is_sound and math.isfinite(c.error)]
        linear = self.linear
        if linear is not None and not self.wants_network:
            able = [c for c in able if c.error < WORTH_LOOKING * linear.rmse]
        plain = [c for c in able if not c.structure.integrator]
        integrates = bool(able) and able[0].structure.integrator
        if integrates and plain and able[0].error > WORTH_AN_INTEGRATOR * plain[0].error:
            able = plain
        delayed = [c for c in able if c.structure.nk > 0]
        if delayed and able[0].error > STILL_WORTH_A_FEEDTHROUGH * delayed[0].error:
            able = delayed
        if not able:
            return []
        best = able[0]
        for c in sorted(able, key=lambda c: c.structure.parameters(self.search.inputs)):
            ratio, deviation = compared(c.errors, best.errors)
            if ratio <= min(deviation, ABOUT_EQUAL if self.search.is_small else LEAST_GAIN):
                best = c
                break
        return [best, *self._joining(best, able)]

    def _joining(self, best: Candidate, able: Sequence[Candidate]) -> list[Candidate]:
        """Others whose runs bring the median's error down, on little data all about as good.

        Where little is held out, a structure that leads there by a hair may do far worse elsewhere,
        and others do their worst at other places: any gain will do.
        """
        group = [best]
        worth = 1.0 if self.split.scored < ENOUGH_TO_CHOOSE_BY else ALONE
        if best.structure.integrator and self.search.repeats:
            # what is held out repeats what was learned and cannot tell them: all that are small
            return [c for c in able if c is not best and c.structure.integrator]
        for c in able:
            if c is best or c.structure.integrator != best.structure.integrator:
                continue
            before = self._error_of(group)
            after = self._error_of([*group, c])
            if after < worth * before or (self.search.is_small and c.error < TOGETHER * best.error):
                group.append(c)
        return group[1:]

    def _error_of(self, group: Sequence[Candidate]) -> float:
        models = [m for c in group for m in c.models]
        return errors_of(free_runs(median_of(models), self.split), self.split).rmse

    def _any_network(self) -> list[Candidate]:
        found = [
            c for c in self.search.candidates.values()
            if c.structure.kind == "neural_ss" and math.isfinite(c.error)
        ]  # fmt: skip
        if not found:
            remedy = "give more time" if self.clock.truncated else "record longer"
            raise FitError(
                f"{self.task.data.source}: expected a network with a finite free run on data not "
                f"trained on, found none; {remedy}, give nx and hidden, or ask for model oe"
            )
        self.reasons.append("no network passed the guard: the best of them all the same")
        return [min(found, key=lambda c: c.error)]

    # --- the model ------------------------------------------------------------------------------

    def _refitted(self, c: Candidate, most: int) -> list[Network]:
        """A few iterations on everything, the held-out part included, where that stays sound."""
        search, models = self.search, c.models[:most]
        if self.split.is_given or self.clock.over(SHARE_OF_REFIT):
            return models
        linear = search.start(c.structure.nx, c.structure.nk, c.structure.output)
        request = Request(
            c.structure, self.task.data, None, 6 if search.samples > 60_000 else 15,
            linear if c.structure.kind == "neural_oe" else None, initial=models,
        )  # fmt: skip
        (found,) = search.guarded(
            train(
                [request], search.pool, self.task.seed, workers=self.task.workers,
                until=self.clock.until(SHARE_OF_REFIT), share=1.0,
            )
        )  # fmt: skip
        kept = [s.model for s in counting(found) if s.is_sound]
        return kept if len(kept) >= min(len(models), 3) else models

    def _network(self, chosen: Sequence[Candidate], others: Sequence[Candidate]) -> Model:
        task, first = self.task, chosen[0]
        most = math.ceil(MOST_MEMBERS / len(chosen))
        models = [m for c in chosen for m in self._refitted(c, most)]
        error = self._error_of(chosen)
        s = first.structure
        provenance: Provenance = {
            "initial_state": "estimated",
            "cost_horizon": "free run",
            "cost_unit": "output unit squared",
            "termination": "time budget" if self.clock.truncated else "chosen by free run",
            "seed": task.seed,
            "samples_fitted": len(task.data),
            "weight_decay": s.decay,
            "choice": self._choice(s.kind, error),
        }
        provenance["choice"]["chosen_structure"] = s.to_json()
        provenance["choice"]["final_free_run_rmse"] = finite(error)
        model = self._of(models, s)
        provenance["cost"] = cost_of(model, task.data)
        model = documented(model, task, self.began, provenance)
        runners_up = [self._alternative(c) for c in others[:MOST_ALTERNATIVES]]
        return self._closed(model, error, [*runners_up, *self._linear_alternative()])

    def _of(self, models: Sequence[Network], s: Structure) -> Model:
        """One model as it is, several as an ensemble, in the data's names and units."""
        known: Provenance = {"weight_decay": s.decay, "samples_fitted": len(self.task.data)}
        members = [
            with_provenance(
                wrap(NeuralOE if isinstance(m, _core.NeuralOE) else NeuralSS, m, self.task.data),
                known,
            )
            for m in models
        ]
        return members[0] if len(members) == 1 else Ensemble.of(members)

    def _alternative(self, c: Candidate) -> Model:
        model = self._of(c.models[:MOST_MEMBERS], c.structure)
        choice: Provenance = {
            "chosen": c.structure.kind,
            "reason": "an alternative to what was chosen",
        }
        choice |= {"free_run_rmse": {c.structure.kind: finite(c.error)}}
        extra: Provenance = {"initial_state": "estimated", "choice": choice}
        return documented(model, self.task, self.began, extra)

    def _linear_alternative(self) -> list[Model]:
        """The linear model that the network was compared with."""
        if not self.search.linear.eligible:
            return []
        chosen = self.search.linear.choice
        core = chosen.models[0]
        choice: Provenance = {"chosen": "oe", "reason": "the linear alternative"}
        choice |= {"free_run_rmse": {"oe": finite(chosen.rmse)}}
        extra: Provenance = {"initial_state": "estimated", "choice": choice}
        return [documented(wrap(LinearOE, core, self.task.data), self.task, self.began, extra)]

    def _linear(self) -> Model:
        """Output error on all data, of the simplest order that is about as good as the best."""
        task, table = self.task, self.search.linear
        if not table.eligible:
            return self._least_squares()
        chosen = self._linear_choice()
        core = chosen.models[0]
        provenance: Provenance = {"choice": self._choice("oe", chosen.rmse)}
        until = self.clock.until(SHARE_OF_REFIT)
        (fit,) = self.search.pool.map(self._linear_fit, [chosen], until=until, share=1.0)
        if fit is None:
            # no time for all samples: the excerpt's model
            extra = {"initial_state": "estimated", "termination": "time budget", **provenance}
            model = documented(wrap(LinearOE, core, task.data), task, self.began, extra)
        else:
            model = linear_model(task, fit, self.began, provenance)
        ranked = sorted((c for c in self.search.eligible if c.is_sound), key=lambda c: c.error)
        others = [self._alternative(c) for c in ranked[:1]]
        return self._closed(model, chosen.rmse, others)

    def _linear_choice(self) -> LinearCandidate:
        """The simplest linear model within a standard error of the best on all later parts."""
        table = self.search.linear
        if self.clock.over(SHARE_OF_VERIFYING):
            return table.choice
        likely = [c for c in table.eligible if c.order <= 3 or c.rmse <= LIKELY * table.best.rmse]
        everywhere = LinearTable(self.task, self.search.folds, self.search.pool)
        wanted = [(c.order, c.nk) for c in likely]
        everywhere.add(wanted, self.clock.until(SHARE_OF_FINAL))
        return everywhere.choice if everywhere.eligible else table.choice

    def _least_squares(self) -> Model:
        """What there is when no output-error fit has come to an end: least squares, in free run."""
        task = self.task
        core = _core.fit_arx(arrays(task.data), **task.orders, offset=True)
        if not core.is_stable:
            raise FitError(
                f"{task.data.source}: expected a linear model or a network with a finite free run, "
                "found none; check units and signs, record longer, or give more time"
            )
        self.reasons.append("no output-error fit came to an end; least squares instead")
        model = wrap(LinearOE, core, task.data)
        error = errors_of(free_runs(core, self.split), self.split).rmse
        extra: Provenance = {"initial_state": "estimated", "termination": "time budget"}
        extra["choice"] = {"chosen": "oe", "reason": "; ".join(self.reasons), "candidates": []}
        return self._closed(documented(model, task, self.began, extra), error, [])

    def _linear_fit(self, chosen: LinearCandidate, look: Look) -> _core.LinearFit | None:
        task = self.task
        options = task.fit_options(na=chosen.order, nb=chosen.order + 1, nk=chosen.nk)
        return _core.fit_oe(arrays(task.data), **{**options, "progress": look})

    def _closed(self, model: Model, error: float, alternatives: Sequence[Model]) -> Model:
        """The model with its alternatives, notes and verdict."""
        notes = list(model.training.get("notes", []))
        if self.clock.truncated:
            notes.append(
                f"the time budget of {self.clock.budget:g} s ended the search early: the result "
                "depends on the speed of the machine"
            )
        linear = self.linear
        if self.wants_network and linear is not None and error >= WORTH_IT * linear.rmse:
            notes.append(
                f"free-run error on data not trained on: {100 * error / linear.rmse:.1f} % of the "
                "best linear model's; consider model oe"
            )
        if self.task.nk is None and any(m.orders["nk"] == 0 for m in model.members or (model,)):
            notes.append(
                "the output depends on the input of the same sample (nk = 0), so that no loop can "
                "be closed around the model; for a controller identify with nk = 1"
            )
        extra: Provenance = {"notes": notes} if notes else {}
        extra["verdict"] = verdict(self, error)
        return replace(with_provenance(model, extra), alternatives=tuple(alternatives))

    def _choice(self, kind: str, error: float) -> Provenance:
        linear = self.linear
        rmse = {} if linear is None else {"oe": finite(linear.rmse)}
        return {
            "chosen": kind,
            "reason": "; ".join(self.reasons),
            "free_run_rmse": rmse | {kind: finite(error)},
            "candidates": list(self.search.rows()),
            "held_out": list(self.split.sources),
        }

    def best_so_far(self, stopped: BaseException) -> Model:
        """What there is when Ctrl-C comes: the best candidate, else the linear model."""
        best, linear = self.search.best, self.linear
        bound = math.inf if linear is None else linear.rmse
        if best is not None and best.error < WORTH_IT * bound and not self.is_linear:
            self.reasons = ["interrupted: the best candidate so far"]
            self._refitted = lambda c, most: c.models[:most]  # type: ignore[method-assign]
            model = self._network([best], [])
            return with_provenance(model, {"termination": "interrupted"})
        if linear is None or linear.models[0] is None:
            raise KeyboardInterrupt from stopped
        model = wrap(LinearOE, linear.models[0], self.task.data)
        provenance = {"termination": "interrupted", "initial_state": "estimated"}
        return documented(model, self.task, self.began, provenance)


def _without_held_out(task: Task, began: float, wants_network: bool) -> Model:
    """A record too short to choose by, or still until its end: second order, and no network."""
    reason = (
        f"the record is too short to hold out {100 * SHARE:.0f} % of every experiment, at least "
        f"{LEAST_HELD_OUT} samples, to compare on; or nothing moves before"
    )
    if wants_network:
        raise FitError(f"{task.data.source}: {reason}; record longer, or give validation data")
    fit = _core.fit_oe(arrays(task.data), **task.fit_options())
    return linear_model(task, fit, began, {"choice": {"chosen": "oe", "reason": reason}})


def cost_of(model: Model, data: Dataset) -> float:
    """J of the free run, in the output's unit squared."""
    runs = zip(model.simulate(data), data.experiments, strict=True)
    pairs = [((e.y - run) ** 2, weights_of(e)) for run, e in runs]
    squares, weights = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return mean_square(squares, weights) / 2.0
