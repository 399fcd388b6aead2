"""The end of the search: from the table of structures to one model.

Structures with weight are trained on everything; of several the model is the midmean of members in
proportion to their weights: a start can go astray on a new input, and what is left without at
least a quarter of the members at each end ignores it where a weighted mean is lost with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from .. import _core
from ..dataset import Dataset, Diagnosis, FloatArray
from ..dataset.experiment import mean_square, weights_of
from ..dataset.pieces import thinned
from ..errors import FitError, Interrupted
from ..models import Ensemble, LinearOE, Model, NeuralOE, NeuralSS
from ..models.base import EnsembleCore
from ..models.grey_box import GreyBox
from . import grey_box
from .blocks import Blocks, Mixture, Row, blocked, combined
from .folds import LEAST_HELD_OUT, TEXTS, WORTH_IT, Trial, apart, verdict, what_to_record
from .grey_box import or_none
from .linear import LinearCandidate, linear_provenance, short
from .table import BRIEF, TRAINING, Table
from .task import SHARES, Pool, Provenance, Stopped, Task, finite, with_provenance, wrap
from .training import Request, Structure, counting, guarded, train

REFIT_LOST, DIAGNOSIS = "the fit to all samples", "the diagnosis of the record"
"""What is lost if a budget ends before these."""
MOST_MEMBERS = 15
"""Members of an ensemble: a controller is tuned on each, and a midmean of more is hardly better."""
_CLASSES: dict[type, type[Model]] = {
    _core.LinearModel: LinearOE, _core.GreyBox: GreyBox, _core.NeuralOE: NeuralOE,
    _core.NeuralSS: NeuralSS,
}  # fmt: skip


def searched(task: Task, *, wants_network: bool = False) -> Model:
    """The structures that describe the data best, as one model; networks if they are wanted."""
    folds = blocked(task.data, task.validation)
    if not folds:
        reason = (
            f"the record is too short for blocks of {LEAST_HELD_OUT} samples, each held out once, "
            "to compare on; or nothing moves outside them, or only once"
        )
        if wants_network:
            raise FitError(f"{task.data.source}: {reason}; record longer, or give validation data")
        return short(task, reason)
    pool = Pool(task.threads, task.clock, task.progress)
    table = Table(task, Blocks(task.data, folds), pool, wants_network)
    ending = Ending(table)
    try:
        table.search()
        return ending.model()
    except (Stopped, KeyboardInterrupt) as stopped:
        # Ctrl-C can also arrive between two compiled calls
        raise Interrupted(ending.best_so_far(stopped)) from None


@dataclass
class Ending:
    """One model of a table: its rows combined, each with weight trained on everything."""

    table: Table

    def __post_init__(self) -> None:
        table = self.table
        self.task, self.pool, self.clock = table.task, table.pool, table.clock
        self.wants_network = table.wants_network

    def model(self, is_interrupted: bool = False) -> Model:
        """The rows combined, those with weight trained on everything."""
        rows = self.table.usable
        reasons = ["interrupted: the best so far"] if is_interrupted else []
        if rows:
            # at rounding, errors say no more
            exact = [r for r in rows if self.table.is_exact and r.rmse <= self.table.rounding]
            simplest = sorted(exact, key=lambda r: r.parameters)[:1]
            shares, mixture = self._realised(combined(simplest or rows, self.table.blocks))
            reasons += [*self._missing(rows, is_interrupted), self._reason(mixture, len(rows))]
        else:
            late = self.table.late_row()
            row = late or self._unsound_row()
            mixture = Mixture((row,), np.ones(1), row.residual, row.errors)
            shares, mixture = self._realised(mixture)
            reasons.append(
                "there was time for one network only"
                if late is not None
                else "no network passed the guard; the best of them is used"
            )
        cores: list[tuple[Any, Provenance]] = []
        # the first member is the plant of a loop: the best of the row with most weight
        for i in np.argsort(-mixture.weights, kind="stable").tolist():
            cores += self._members(mixture.rows[i], int(shares[i]), is_interrupted)
        model = as_one(cores, self.task)
        provenance: Provenance = {
            "initial_state": "estimated",
            "cost_horizon": "free run",
            "cost_unit": "output unit squared",
            "termination": "time budget" if self.clock.truncated else "chosen by free run",
            "seed": self.task.seed,
            "samples_fitted": len(self.task.data),
            "cost": cost_of(model, self.task.data),
            "choice": self._choice(mixture, reasons),
        }
        linear = self._linear_error()
        left = mixture.unseen(self.table.blocks)
        trial = self.table.blocks.trial(left, self._apart(model, mixture))
        model = closed(
            self.task.documented(model, {**model.training, **provenance}), self.task, trial,
            linear=linear, wants_network=self.wants_network, diagnosed=self._diagnosed,
        )  # fmt: skip
        model = self._with_blocks(model, left)
        return replace(model, alternatives=tuple(self._alternatives(model)))

    def _apart(self, model: Model, mixture: Mixture) -> float:
        """How far mixtures without one of the blocks are apart."""
        folds = [] if self.table.folds[0].is_given else range(len(self.table.folds))
        return apart(model, self.task.data, [partial(mixture.runs, i) for i in folds])

    def _with_blocks(self, model: Model, left: FloatArray) -> Model:
        """The verdict with the fit of each block, from what is left on them, which shows how far
        the figure can be trusted.
        """
        spread, sizes = self.table.blocks.together.spread, self.table.blocks.sizes
        if len(sizes) < 2 or not spread > 0.0:
            return model
        if not np.isfinite(left).all():
            return model
        ends = np.cumsum(sizes)[:-1]
        squares = np.split(self.table.blocks.weights * left**2, ends)
        counts = np.split(self.table.blocks.weights, ends)
        fits = [
            100.0 * (1.0 - math.sqrt(float(p.sum() / w.sum())) / spread)
            for p, w in zip(squares, counts, strict=True)
        ]
        own = dict(model.training["verdict"])
        own["blocks"] = fits
        own["text"] += f"; block by block {min(fits):.1f} to {max(fits):.1f} %"
        return with_provenance(model, {"verdict": own})

    def best_so_far(self, stopped: BaseException) -> Model:
        """The result on Ctrl-C: of the rows so far, as they are."""
        self.table.enter_linear()
        able = self.table.usable
        if not able:
            # a kind requested by name is not replaced by another
            raise KeyboardInterrupt from stopped
        return with_provenance(self.model(is_interrupted=True), {"termination": "interrupted"})

    def _missing(self, rows: Sequence[Row], is_interrupted: bool) -> list[str]:
        """Why there is no network among the rows."""
        if self.table.is_exact:
            return ["the linear model's error is at rounding: no network was asked"]
        if self.table.joints_decide:
            return [
                "the record repeats one trajectory, so that no part of it can judge a network: the "
                "equations decide"
            ]
        if is_interrupted or any(isinstance(r.found, Structure) for r in rows):
            return []
        if TRAINING in self.clock.lost:
            return ["the time budget left no time for a network"]
        return ["no network could be trained: too few samples, or none passed the guard"]

    def _realised(self, mixture: Mixture) -> tuple[FloatArray, Mixture]:
        """Members of each row, as many as the scarcest row allows, and the mixture they are."""
        if len(mixture.rows) == 1:
            (row,) = mixture.rows
            # a linear model or a motor needs no others beside it
            alone = row.kind in ("oe", "grey_box")
            most = 1 if alone else min(MOST_MEMBERS, self.task.starts or MOST_MEMBERS)
            return np.array([most]), mixture
        pairs = zip(mixture.rows, mixture.weights, strict=True)
        whole = 0 if self.table.folds[0].is_given else 1
        able = min(
            (sum(map(len, r.models)) + whole * (r.kind in ("oe", "grey_box"))) / w for r, w in pairs
        )
        most = min(MOST_MEMBERS, max(1, int(able)))
        shares, found = mixture.of_members(most, self.table.blocks)
        return (shares, found) if len(shares) > 1 else self._realised(found)

    def _members(self, row: Row, most: int, is_interrupted: bool) -> list[tuple[Any, Provenance]]:
        """At most so many models of the row, each with its provenance.
        Networks are trained a little further on everything, each from one that was trained without
        a block, if they stay sound. A linear model or a motor is fitted to everything; if there are
        to be several, those without a block follow.
        """
        fitted = [len(f.fitted) for f in self.table.folds]
        known: Provenance = {}
        if isinstance(row.found, Structure):
            known["weight_decay"] = row.found.decay
        plain = known | {"samples_fitted": len(self.task.data)}
        # not every fold of a row need have a sound network
        asked = row.sound if any(row.sound) else (True,) * len(fitted)
        of_folds = [
            (m[i], known | {"samples_fitted": n})
            for i in range(max(map(len, row.models)))
            for m, n, is_asked in zip(row.models, fitted, asked, strict=True)
            if is_asked and i < len(m)
        ]
        given = of_folds[:most]
        if not most or is_interrupted or self.table.folds[0].is_given:
            return given
        if self.clock.over(SHARES.refit, REFIT_LOST):
            return given
        until = self.clock.until(SHARES.refit)
        if row.kind == "oe":
            options = self.task.fit_options(
                na=row.found.order, nb=row.found.order + 1, nk=row.found.nk
            )
            (fit,) = self.pool.map(
                lambda data, look: _core.fit_oe(data, **{**options, "progress": look}),
                [self.table.pairs], until=until, share=1.0, what=REFIT_LOST,
            )  # fmt: skip
            first = [] if fit is None else [(fit.model, plain | linear_provenance(fit))]
            return [*first, *given][:most]
        if row.kind == "grey_box":
            hidden = row.found.hidden
            (core,) = self.pool.map(
                lambda data, look: or_none(lambda: self.table.motors.fitted(data, hidden, look)),
                [thinned(self.task.data, grey_box.MOST_FITTED)],
                until=until, share=1.0, what=REFIT_LOST,
            )  # fmt: skip
            # on everything it must not fit worse than the best that was fitted to less
            able = ([] if core is None else [(core, plain)]) + of_folds
            able.sort(key=lambda pair: grey_box.cost_of(pair[0], self.task.data))
            return able[:most]
        linear = self.table.start_of(row.found, 0) if row.kind == "neural_oe" else None
        request = Request(
            row.found, self.task.data, None, min(BRIEF, self.task.iterations or BRIEF), linear,
            initial=[m for m, _ in given],
        )  # fmt: skip
        found = train(
            [request], self.pool, self.task.seed, workers=self.task.workers, until=until, share=1.0,
            what=REFIT_LOST,
        )  # fmt: skip
        (starts,) = guarded(found, self.table.pairs, self.table.bounds, self.pool)
        return [(s.model, plain) for s in counting(starts) if s.is_sound] or given

    def _unsound_row(self) -> Row:
        """The best network that failed the guard, if a network was asked for by name."""
        if self.table.unsound is not None:
            structure, starts = self.table.unsound
            models = tuple(tuple(s.model for s in f) for f in starts)
            cores = [EnsembleCore(m, "median") for m in models]
            residual = self.table.blocks.residual(cores)
            if residual is None:
                residual = np.full(len(self.table.blocks.weights), np.inf)
            parameters = structure.parameters(self.task.data.n_inputs)
            errors = self.table.blocks.errors(residual)
            sound = (False,) * len(models)
            return Row("neural_ss", parameters, structure, models, sound, residual, errors)
        remedy = "give more time" if self.clock.truncated else "record longer"
        raise FitError(
            f"{self.task.data.source}: expected a model with a finite free run on data not trained "
            f"on, found none; {remedy}, give other sizes (nx, hidden), or ask for model oe"
        )

    def _linear_error(self) -> float | None:
        table = self.table.linear
        return table.best.rmse if table.eligible else None

    def _alternatives(self, model: Model) -> list[Model]:
        """The best network alone, if the model has none, and the linear model."""
        found, kinds = [], {m.kind for m in model.members or (model,)}
        networks = [r for r in self.table.rows.values() if isinstance(r.found, Structure)]
        if networks and not kinds & {"neural_ss", "neural_oe"}:
            best = min(networks, key=lambda r: r.rmse)
            choice: Provenance = {
                "chosen": best.kind, "reason": "an alternative to the choice",
                "free_run_rmse": {best.kind: finite(best.rmse)},
            }  # fmt: skip
            members = self._members(best, MOST_MEMBERS, True)
            extra: Provenance = {"initial_state": "estimated", "choice": choice}
            found.append(self.task.documented(as_one(members, self.task), extra))
        if self.table.linear.eligible and kinds != {"oe"}:
            chosen = self.table.linear.choice
            found.append(linear_alternative(chosen, self.task))
        return found

    def _reason(self, mixture: Mixture, count: int) -> str:
        parts = len(self.table.folds)
        where = "a held-out block" if parts == 1 else f"{parts} blocks, each held out once"
        if self.table.folds[0].is_given:
            where = "the validation data"
        if len(mixture.rows) == 1:
            what = "as good as all together within a standard error, and the simplest such"
            if mixture.rows[0].kind == "grey_box":
                what = "the equations of a motor: " + what
        else:
            weights = sorted(np.round(mixture.weights, 3), reverse=True)
            listed = ", ".join(f"{100 * w:.0f} %" for w in weights)
            what = f"{len(mixture.rows)} structures with weights of {listed}"
        reason = f"{what}; {count} were judged on {where}"
        linear = self._linear_error()
        if linear and any(r.kind != "oe" for r in mixture.rows):
            share = 100 * mixture.errors.rmse / linear
            reason += f", with {share:.1f} % of the best linear model's free-run error"
        return reason

    def _choice(self, mixture: Mixture, reasons: Sequence[str]) -> Provenance:
        weights = {id(r): float(w) for r, w in zip(mixture.rows, mixture.weights, strict=True)}
        kinds = {r.kind for r in mixture.rows}
        kind = kinds.pop() if len(kinds) == 1 else "ensemble"
        heaviest = mixture.rows[int(np.argmax(mixture.weights))].found.to_json()
        linear, error = self._linear_error(), finite(mixture.errors.rmse)
        rmse = {} if linear is None else {"oe": finite(linear)}
        return {
            "chosen": kind,
            "reason": "; ".join(reasons),
            "free_run_rmse": rmse | {kind: error},
            "candidates": [r.to_json(weights.get(id(r), 0.0)) for r in self._listed()],
            "held_out": list(self.table.blocks.together.sources),
            "chosen_structure": {k: v for k, v in heaviest.items() if k != "free_run_rmse"},
            "final_free_run_rmse": error,
        }

    def _listed(self) -> list[Row]:
        """Linear models in their order, a motor, and networks in the order of their trials."""
        order = ("oe", "grey_box")
        rows = self.table.rows.values()
        linear = sorted(
            (r for r in rows if r.kind == "oe"), key=lambda r: (r.found.order, r.found.nk)
        )
        return [
            *linear,
            *(r for r in rows if r.kind == order[1]),
            *(r for r in rows if r.kind not in order),
        ]

    def _diagnosed(self) -> Diagnosis | None:
        is_known = "diagnosis" in self.table.__dict__ or not self.clock.over(
            SHARES.refit, DIAGNOSIS
        )
        return self.table.diagnosis if is_known else None


# --- Members as one model, its notes and verdict --------------------------------------------------


def as_one(cores: Sequence[tuple[Any, Provenance]], task: Task) -> Model:
    """One model unchanged, several as their midmean, each with its provenance.
    A median follows the larger group alone: of two structures with weights of 46 and 54 % it was
    the second, with 58 and 42 % the first, though their weighted mean had been judged
    (`short_wiener`, system 0: test errors .049 and .020).
    """
    members = [
        with_provenance(wrap(_CLASSES[type(core)], core, task.data), known) for core, known in cores
    ]
    return members[0] if len(members) == 1 else Ensemble.of(members, "midmean")


def linear_alternative(chosen: LinearCandidate, task: Task) -> Model:
    """The linear model with which others were compared."""
    choice: Provenance = {"chosen": "oe", "reason": "the linear alternative"}
    choice |= {"free_run_rmse": {"oe": finite(chosen.rmse)}}
    extra: Provenance = {"initial_state": "estimated", "choice": choice}
    return task.model(LinearOE, chosen.models[0], extra)


def closed(
    model: Model,
    task: Task,
    trial: Trial,
    *,
    linear: float | None,
    wants_network: bool,
    diagnosed: Callable[[], Diagnosis | None],
) -> Model:
    """The model with its notes and verdict, by a trial on data that it was not trained on.
    `linear` is the error of the best linear model there; `diagnosed` gives the properties of the
    record, None if a time budget leaves no time for them.
    """
    notes, error = list(model.training.get("notes", [])), trial.error
    if wants_network and linear is not None and error >= WORTH_IT * linear:
        notes.append(
            f"free-run error on data not trained on: {100 * error / linear:.1f} % of the best "
            "linear model's; consider model oe"
        )
    if task.nk is None and any(m.orders["nk"] == 0 for m in model.members or (model,)):
        notes.append(
            "the output depends on the input of the same sample (nk = 0), so that no loop can be "
            "closed around the model; for a controller identify with nk = 1"
        )
    extra: Provenance = {"notes": notes} if notes else {}
    found = verdict(model, task.data, trial)
    diagnosis = diagnosed()
    if found["grade"] == "good" and diagnosis is not None and diagnosis.find("repeats") is not None:
        found["grade"] = "fair"
        repeated = "good on repetitions of this record"
        found["text"] = found["text"].replace(TEXTS["good"], repeated)
        found["next"] += what_to_record(task.data)
    if task.clock.truncated and found["grade"] != "good":
        found["next"].insert(0, "give a longer time budget, or none")
    if diagnosis is not None:
        found["next"] += [f"{f.text}: {f.remedy}" for f in diagnosis.findings]
    extra["verdict"] = found
    return with_provenance(model, extra)


def cost_of(model: Model, data: Dataset) -> float:
    """J of the free run, in the output's unit squared."""
    runs = zip(model.simulate(data), data.experiments, strict=True)
    pairs = [((e.y - run) ** 2, weights_of(e)) for run, e in runs]
    squares, weights = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return mean_square(squares, weights) / 2.0
