"""Which candidate becomes the model: compared with linear ones, trained fully, guarded, refitted.

A candidate that fails a test makes room for the next one; the linear model is returned only if no
network is credibly better. The second best are kept with the model, in `alternatives`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .. import _core
from ..dataset import Diagnosis
from ..errors import FitError, Interrupted
from ..models import LinearOE, Model
from ..models.grey_box import GreyBox
from .closing import MOST_MEMBERS, WORTH_IT, as_one, closed, cost_of, linear_alternative
from .finals import (
    ALONE,
    ENOUGH_TO_CHOOSE_BY,
    WORTH_LOOKING,
    Finals,
)
from .folds import (
    LEAST_HELD_OUT,
    SHARE,
    compared,
    errors_of,
    folds,
    free_runs,
)
from .linear import HELD_OUT, LEAST_GAIN, LinearCandidate, LinearTable, linear_provenance, short
from .mixture import MOST_SAMPLES, tabled
from .search import CLIMB_ITERATIONS, Search
from .task import Pool, Provenance, Stopped, Task, arrays, finite, with_provenance
from .training import Network, Request, Structure, counting
from .trials import (
    DIAGNOSIS,
    REFIT_LOST,
    SHARE_OF_FINAL,
    SHARE_OF_REFIT,
    SHARE_OF_VERIFYING,
    STILL_WORTH_A_FEEDTHROUGH,
    Candidate,
    median_of,
)

WORTH_AN_INTEGRATOR = 0.7
MOST_ALTERNATIVES = 2
LIKELY = 1.5
"""Linear models with an error on the newest part within this factor are tested on earlier ones."""
_FINALISTS = "training of the finalists to the end"
"""What a time budget can cut short, in words."""
TOGETHER = 1.25
"""In little time, the median includes all finalists within this factor."""


def searched(task: Task, *, wants_network: bool = False) -> Model:
    """The network if it is credibly better, else linear output error.
    If one is wanted, it is the state-space network, even if that is not better.
    """
    if len(task.data) <= MOST_SAMPLES:
        found = tabled(task, wants_network=wants_network)
        if found is not None:
            return found
    parts = folds(task.data, task.validation)
    if not parts:
        reason = (
            f"the record is too short to hold out {100 * SHARE:.0f} % of every experiment, at "
            f"least {LEAST_HELD_OUT} samples, to compare on; or nothing moves before, or only once"
        )
        if wants_network:
            raise FitError(f"{task.data.source}: {reason}; record longer, or give validation data")
        return short(task, reason)
    pool = Pool(task.threads, task.clock, task.progress)
    choice = Choice(Search(task, parts, pool, wants_network))
    try:
        choice.search.run()
        return choice.model()
    except (Stopped, KeyboardInterrupt) as stopped:
        # Ctrl-C can also arrive between two compiled calls
        raise Interrupted(choice.best_so_far(stopped)) from None


@dataclass
class Choice(Finals):
    """The end of a search: from its candidates to one model."""

    is_linear: bool = False
    is_interrupted: bool = False

    def model(self) -> Model:
        """The chosen model, with the second best as alternatives."""
        if self.search.is_exact:
            self.reasons.append("the linear model's error is at rounding: no network was asked")
            asked = []
        else:
            asked = self.worth_asking()
        while asked:
            finalists = self.finalists(asked)
            finished = self.finish(finalists)
            chosen = self._sound_and_settled(finished)
            if chosen:
                others = [c for c in finished if c.is_sound and c not in chosen]
                return self._network(chosen, others)
            asked = [c for c in asked if c.structure not in {f.structure for f in finalists}]
            # if the best candidates do not beat a motor, the next ones do not either
            if not self._beats_motor(finished[0]) or self.clock.over(SHARE_OF_FINAL, _FINALISTS):
                break
        if self.wants_network:
            return self._network(self._any_network(), [])
        self.is_linear = True
        return self._motor() if self._is_motor() else self._linear()

    # --- the choice -----------------------------------------------------------------------------

    def _sound_and_settled(self, finished: Sequence[Candidate]) -> list[Candidate]:
        """The chosen candidate and those that join its median; empty if none qualifies."""
        able = [c for c in finished if c.is_sound and math.isfinite(c.error)]
        linear = self.linear
        if linear is not None and not self.wants_network:
            able = [c for c in able if c.error < WORTH_LOOKING * linear.rmse]
        able = [c for c in able if self._beats_motor(c)]
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
            if ratio <= min(deviation, LEAST_GAIN):
                best = c
                break
        return [best, *self._joining(best, able)]

    def _beats_motor(self, c: Candidate) -> bool:
        """Whether it is better by a tenth than a motor's equations, if these are a candidate."""
        motor = self.search.motor
        return motor is None or c.error < WORTH_IT * motor.rmse

    def _joining(self, best: Candidate, able: Sequence[Candidate]) -> list[Candidate]:
        """Others that reduce the median's error; in little time all that are about as good.
        On few held-out samples, a structure that leads narrowly can do far worse elsewhere, and
        other structures fail at other places: any gain is accepted.
        """
        group = [best]
        worth = 1.0 if self.split.scored < ENOUGH_TO_CHOOSE_BY else ALONE
        is_unsure = self.is_hurried and not self.search.is_large
        if best.structure.integrator and self.search.repeats:
            # the held-out data repeat the training data and cannot rank them: take all small ones
            return [c for c in able if c is not best and c.structure.integrator]
        for c in able:
            if c is best or c.structure.integrator != best.structure.integrator:
                continue
            before = self._error_of(group)
            after = self._error_of([*group, c])
            if after < worth * before or (is_unsure and c.error < TOGETHER * best.error):
                group.append(c)
        return group[1:]

    def _error_of(self, group: Sequence[Candidate]) -> float:
        models = [m for c in group for m in c.models]
        return errors_of(free_runs(median_of(models), self.split), self.split).rmse

    def _any_network(self) -> list[Candidate]:
        """The best network even if it is not sound, or one that is trained in the time left."""
        found = self._state_space_networks()
        asked = [s for s in self.search.candidates if s.kind == "neural_ss"]
        if asked and not found and not self.clock.over(SHARE_OF_FINAL, _FINALISTS):
            # slow linear fits have used up the search's share of a time budget
            self.search.share = SHARE_OF_FINAL
            self.search.tried([(asked[0], CLIMB_ITERATIONS, 1)])
            found = self._state_space_networks()
            if found and found[0].is_sound:
                self.reasons.append("there was time for one network only")
                return found
        if not found:
            remedy = "give more time" if self.clock.truncated else "record longer"
            raise FitError(
                f"{self.task.data.source}: expected a network with a finite free run on data not "
                f"trained on, found none; {remedy}, give nx and hidden, or ask for model oe"
            )
        self.reasons.append("no network passed the guard; the best of them is used")
        return [min(found, key=lambda c: c.error)]

    def _state_space_networks(self) -> list[Candidate]:
        return [
            c for c in self.search.candidates.values()
            if c.structure.kind == "neural_ss" and math.isfinite(c.error)
        ]  # fmt: skip

    # --- the model ------------------------------------------------------------------------------

    def _refitted(self, c: Candidate, most: int) -> list[Network]:
        """A few iterations on all data, including the held-out part, if the model stays sound.
        There are none if a budget has cut the training short: models that have not reached their
        minimum do worse after some steps towards another one.
        """
        search, models = self.search, c.models[:most]
        if self.split.is_given or self.is_interrupted:
            return models
        if self.is_hurried or self.clock.over(SHARE_OF_REFIT, REFIT_LOST):
            self.clock.lose(REFIT_LOST)
            return models
        linear = search.start(c.structure.nx, c.structure.nk, c.structure.output)
        request = Request(
            c.structure, self.task.data, None, 6 if search.samples > 60_000 else 15,
            linear if c.structure.kind == "neural_oe" else None, initial=models,
        )  # fmt: skip
        until = self.clock.until(SHARE_OF_REFIT)
        (found,) = search.guarded(search.train([request], until, 1.0, REFIT_LOST))
        kept = [s.model for s in counting(found) if s.is_sound]
        return kept if len(kept) >= min(len(models), 3) else models

    def _network(self, chosen: Sequence[Candidate], others: Sequence[Candidate]) -> Model:
        task, first = self.task, chosen[0]
        most = math.ceil(MOST_MEMBERS / len(chosen))
        models = [m for c in chosen for m in self._refitted(c, most)][:MOST_MEMBERS]
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
        model = task.documented(model, provenance)
        runners_up = [self._alternative(c) for c in others[:MOST_ALTERNATIVES]]
        return self._closed(model, error, [*runners_up, *self._linear_alternative()])

    def _of(self, models: Sequence[Network], s: Structure) -> Model:
        """One model unchanged, several as an ensemble, in the data's names and units."""
        known: Provenance = {"weight_decay": s.decay, "samples_fitted": len(self.task.data)}
        return as_one([(m, known) for m in models], self.task)

    def _alternative(self, c: Candidate) -> Model:
        model = self._of(c.models[:MOST_MEMBERS], c.structure)
        choice: Provenance = {
            "chosen": c.structure.kind,
            "reason": "an alternative to the choice",
        }
        choice |= {"free_run_rmse": {c.structure.kind: finite(c.error)}}
        extra: Provenance = {"initial_state": "estimated", "choice": choice}
        return self.task.documented(model, extra)

    def _network_alternative(self) -> list[Model]:
        """The best network that passed the guard, if none was chosen."""
        sound = [c for c in self.search.eligible if c.is_sound]
        return [self._alternative(c) for c in sorted(sound, key=lambda c: c.error)[:1]]

    def _linear_alternative(self) -> list[Model]:
        """The linear model with which the network was compared."""
        if not self.search.linear.eligible:
            return []
        chosen = self.search.linear.choice
        return [linear_alternative(chosen, chosen.rmse, self.task)]

    def _is_motor(self) -> bool:
        """Whether a motor's equations beat linear models, on the newest part and the one before."""
        motor, linear, search = self.search.motor, self.linear, self.search
        if motor is None or linear is None:
            return motor is not None
        if motor.rmse >= WORTH_IT * linear.rmse:
            return False
        if len(search.folds) > 1 and not self.is_interrupted:
            until = self.clock.until(SHARE_OF_FINAL)
            again = search.motors.again(motor, search.part_of_motor(1), search.pool, until)
            if again is not None:
                earlier = LinearTable(self.task.nk, [search.folds[1]], search.pool)
                orders = sorted({search.linear.choice.order, linear.order})
                earlier.add([(o, linear.nk) for o in orders], until)
                if earlier.candidates and again >= WORTH_IT * earlier.best.rmse:
                    return False
        self.reasons.append(
            "the equations of a motor: their free-run error on data not trained on is "
            f"{100 * motor.rmse / max(linear.rmse, 1e-300):.1f} % of the best linear model's"
        )
        return True

    def _motor(self) -> Model:
        """The motor's equations on all data."""
        task, found = self.task, self.search.motor
        assert found is not None
        until = self.clock.until(SHARE_OF_REFIT)
        motors = self.search.motors
        jobs = [] if self.split.is_given or self.is_interrupted else [found]
        part = self.split.shortened(len(task.data), HELD_OUT)
        fits = self.search.pool.map(
            lambda c, look: motors.refitted(c, task.data, part, look),
            jobs, until=until, share=1.0, what=REFIT_LOST,
        )  # fmt: skip
        core = next((c for c in fits if c is not None), found.core)
        provenance: Provenance = {
            "initial_state": "estimated",
            "cost_horizon": "free run",
            "cost_unit": "output unit squared",
            "termination": "time budget" if self.clock.truncated else "chosen by free run",
            "choice": self._choice("grey_box", found.rmse),
        }
        model = task.model(GreyBox, core, provenance)
        model = with_provenance(model, {"cost": cost_of(model, task.data)})
        return self._closed(
            model, found.rmse, [*self._network_alternative(), *self._linear_alternative()]
        )

    def _linear(self) -> Model:
        """Output error on all data, of the simplest order that is about as good as the best."""
        task, table = self.task, self.search.linear
        if not table.eligible:
            return self._least_squares()
        chosen = self._linear_choice()
        core = chosen.models[0]
        provenance: Provenance = {"choice": self._choice("oe", chosen.rmse)}
        until = self.clock.until(SHARE_OF_REFIT)
        options = task.fit_options(na=chosen.order, nb=chosen.order + 1, nk=chosen.nk)
        (fit,) = self.search.pool.map(
            lambda data, look: _core.fit_oe(data, **{**options, "progress": look}),
            [arrays(task.data)], until=until, share=1.0, what=REFIT_LOST,
        )  # fmt: skip
        if fit is None:
            # no time to fit all samples: keep the model of the excerpt
            extra = {"initial_state": "estimated", "termination": "time budget", **provenance}
            model = task.model(LinearOE, core, extra)
        else:
            model = task.model(LinearOE, fit.model, linear_provenance(fit) | provenance)
        return self._closed(model, chosen.rmse, self._network_alternative())

    def _linear_choice(self) -> LinearCandidate:
        """The simplest linear model within a standard error of the best on all later parts."""
        table = self.search.linear
        if self.clock.over(SHARE_OF_VERIFYING, "linear models on earlier parts"):
            return table.choice
        likely = [c for c in table.eligible if c.order <= 3 or c.rmse <= LIKELY * table.best.rmse]
        everywhere = LinearTable(self.task.nk, self.search.folds, self.search.pool)
        wanted = [(c.order, c.nk) for c in likely]
        everywhere.add(wanted, self.clock.until(SHARE_OF_FINAL))
        first = table.choice
        # a candidate that the budget left untested on earlier parts must not lose for that
        is_asked = (first.order, first.nk) in everywhere.candidates
        return everywhere.choice if is_asked else first

    def _least_squares(self) -> Model:
        """The fallback if no output-error fit has finished: least squares, judged in free run."""
        task = self.task
        core = _core.fit_arx(arrays(task.data), **task.orders, offset=True)
        if not core.is_stable:
            raise FitError(
                f"{task.data.source}: expected a linear model or a network with a finite free run, "
                "found none; check units and signs, record longer, or give more time"
            )
        self.reasons.append("no output-error fit finished; least squares instead")
        error = errors_of(free_runs(core, self.split), self.split).rmse
        extra: Provenance = {"initial_state": "estimated", "termination": "time budget"}
        extra["choice"] = {"chosen": "oe", "reason": "; ".join(self.reasons), "candidates": []}
        return self._closed(task.model(LinearOE, core, extra), error, [])

    def _closed(self, model: Model, error: float, alternatives: Sequence[Model]) -> Model:
        """The model with its alternatives, notes and verdict."""
        linear = self.linear
        found = closed(
            model, self.task, self.split, error, linear=None if linear is None else linear.rmse,
            wants_network=self.wants_network, diagnosed=self._diagnosed,
        )  # fmt: skip
        return replace(found, alternatives=tuple(alternatives))

    def _diagnosed(self) -> Diagnosis | None:
        is_known = self.search.is_diagnosed or not self.clock.over(SHARE_OF_REFIT, DIAGNOSIS)
        return self.search.diagnosis if is_known else None

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
        """The result on Ctrl-C: the best candidate, else the linear model."""
        best, linear, motor = self.search.best, self.linear, self.search.motor
        bound = math.inf if linear is None else linear.rmse
        is_motor = motor is not None and motor.rmse < WORTH_IT * bound
        if motor is not None and is_motor:
            bound = motor.rmse
        is_better = best is not None and (self.wants_network or best.error < WORTH_IT * bound)
        if best is not None and is_better and not self.is_linear:
            self.reasons = ["interrupted: the best candidate so far"]
            self.is_interrupted = True
            model = self._network([best], [])
            return with_provenance(model, {"termination": "interrupted"})
        if is_motor:
            self.reasons, self.is_interrupted = ["interrupted: the equations of a motor"], True
            return with_provenance(self._motor(), {"termination": "interrupted"})
        if self.wants_network or linear is None or linear.models[0] is None:
            # a kind requested by name is not replaced by another
            raise KeyboardInterrupt from stopped
        provenance = {"termination": "interrupted", "initial_state": "estimated"}
        return self.task.model(LinearOE, linear.models[0], provenance)
