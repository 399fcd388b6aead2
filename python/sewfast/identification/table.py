"""The search on little data: a table of structures, judged on blocks of the whole record.

On few samples it is luck which structure leads on one held-out part, and which one a vote refuses.
Here every structure is trained without each block in turn and judged on that block, so that every
sample is predicted by models that have not seen it. The structures are then combined by convex
weights of least squares on these free runs (stacking: Wolpert 1992; Breiman 1996; of time series,
Hansen and Racine 2012), reduced to the fewest that do as well within a standard error. One is
returned alone; of several, the model is the median of members in proportion to the weights, each
trained without a block first and on everything then: on few data a start can go astray on a new
input, and a median ignores it where a weighted mean is lost with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from .. import _core
from ..dataset import Diagnosis, FloatArray, diagnose
from ..errors import FitError, Interrupted
from ..models import Model
from ..models.base import EnsembleCore
from . import grey_box
from .blocks import Blocks, Mixture, Row, blocked, combined
from .closing import MOST_MEMBERS, as_one, closed, cost_of, linear_alternative
from .grey_box import or_none
from .linear import MISLED, ROUNDING, LinearTable, joined, linear_provenance, raised, time_constant
from .outputs import ABS, LINEAR, Output, is_rectified, named, rectified_start, suggested
from .task import Pool, Provenance, Stopped, Task, arrays, finite, with_provenance
from .training import Request, Start, Structure, counting, guarded, train
from .trials import (
    DIAGNOSIS,
    REFIT_LOST,
    SAMPLES_PER_PARAMETER,
    SHARE_OF_FINAL,
    SHARE_OF_LINEAR,
    SHARE_OF_REFIT,
    TRAINING,
    WORTH_A_FEEDTHROUGH,
)

MOST_SAMPLES = 3_750
"""Samples up to which every structure can be trained without each block."""
ORDERS, MOST_NX = (1, 2, 3, 4), 8
"""States of the networks that are tried in any case, beside those of the best linear models."""
HIDDEN, MOST_HIDDEN = 4, 16
DECAYS = (1e-4, 1e-2)
"""Weight decays in the beginning. With the smaller one only, the geometric mean of test errors is
.569 of output error's, with both .417 (families `short_*` of the battery's rules)."""
STARTS = 4
FIRST, HALVINGS, FURTHER = 30, (60, 120), 90
"""Iterations of all networks, further ones of the better halves, and of each step of the climb."""
CLIMBED = 5e9
"""Multiplications of one structure in a step of the climb, which limit the models of each fold that
take part: training to the end pays on few samples, where it costs little."""
ROUNDS = 4
REFIT = 15
"""Iterations on all data of a network that was trained without a block."""
SHARE_OF_NETWORKS = 0.85
"""Part of a time budget by which networks must be finished."""
LAGGED_DECAY = 1e-3
"""Weight decay of the lagged network, where it has another meaning."""
Models: TypeAlias = Sequence[Sequence[Any]]
"""Of each fold."""


def tabled(task: Task, *, wants_network: bool = False) -> Model | None:
    """The structures that describe the data best, as one model; None if there are too few blocks.
    If a network is wanted, it is of state-space networks, even if these are not better.
    """
    folds = blocked(task.data, task.validation)
    if not folds:
        return None
    pool = Pool(task.threads, task.clock, task.progress)
    table = Table(task, Blocks(task.data, folds), pool, wants_network)
    try:
        table.search()
        return table.model()
    except (Stopped, KeyboardInterrupt) as stopped:
        # Ctrl-C can also arrive between two compiled calls
        raise Interrupted(table.best_so_far(stopped)) from None


@dataclass
class Table:
    """The structures of one identification, and the model that is made of them.
    `rows` are those with a finite free run on every block, by what they were made of.
    """

    task: Task
    blocks: Blocks
    pool: Pool
    wants_network: bool = False
    rows: dict[Any, Row] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.clock, self.folds = self.pool.clock, self.blocks.folds
        self.linear = LinearTable(self.task.nk, self.folds, self.pool)
        self.motors = grey_box.Motors(self.task.seed, self.task.iterations_or_usual)
        # a network that failed the guard, for one asked for by name
        self._unsound: tuple[Structure, tuple[tuple[Start, ...], ...]] | None = None
        self._pairs = arrays(self.task.data)
        # part of a time budget by which networks must be finished
        self._share = SHARE_OF_NETWORKS

    # --- the schedule -----------------------------------------------------------------------------

    def search(self) -> None:
        """Linear models and a motor, then networks: the better half of them further, twice, then
        larger ones from the best.
        The equations of a motor come after the smallest linear model: where they hold, no other
        second of the search gains as much, and a time budget must not end before it.
        """
        self.linear.begin()
        if not self.is_exact:
            self._try_motor()
        self.linear.search(self.clock.within(SHARE_OF_LINEAR, SHARE_OF_FINAL))
        self._enter_linear()
        if self.is_exact:
            return
        alive = self._screened()
        for iterations in HALVINGS:
            best = sorted(alive, key=lambda r: r.rmse)[: max(2, (len(alive) + 1) // 2)]
            alive = [self._further(row, iterations) for row in best]
        self._climb()

    @property
    def is_exact(self) -> bool:
        """Whether the linear model's error is only rounding, so that a network cannot help."""
        return not self.wants_network and self.linear.is_exact(self.task.data)

    @property
    def _rounding(self) -> float:
        return ROUNDING * max(abs(v) for v in self.task.data.output_range)

    def _try_motor(self) -> None:
        """Fit the equations of a motor, unless another kind was requested."""
        task = self.task
        if self.wants_network or {task.nk, task.nx, task.hidden, task.output} != {None}:
            return
        until, found = self.clock.until(SHARE_OF_FINAL), []
        for part in self.folds:
            one = self.motors.candidate(part, self.pool, until)
            if one is None:
                return
            found.append(one)
        largest = max(found, key=lambda c: c.hidden)
        self._enter("grey_box", len(largest.core.theta), largest, [(c.core,) for c in found])

    def _enter_linear(self) -> None:
        if self.wants_network:
            return
        for c in self.linear.candidates.values():
            if all(m is not None for m in c.models):
                self._enter("oe", c.parameters, c, [(m,) for m in c.models])

    def _enter(self, kind: str, parameters: int, found: Any, models: Models) -> Row | None:
        """A row of these models of each fold, unless one runs away on its block."""
        cores = [m[0] if len(m) == 1 else EnsembleCore(tuple(m), "median") for m in models]
        residual = self.blocks.residual(cores)
        if residual is None:
            return None
        row = Row(
            kind, parameters, found, tuple(map(tuple, models)), residual,
            self.blocks.errors(residual),
        )  # fmt: skip
        self.rows[found] = row
        self.pool.best = min(self.pool.best, row.rmse)
        return row

    # --- networks ---------------------------------------------------------------------------------

    def _screened(self) -> list[Row]:
        """All likely networks, trained briefly."""
        found: list[Row] = []
        at_once: list[Row] = []
        for s in self._likely(self._outputs()):
            row = self._trained(s, FIRST)
            (at_once if s.nk == 0 and self.task.nk is None else found).extend([row] if row else [])
        # no loop can be closed around a model that needs the input of the same sample
        least = min((r.rmse for r in found), default=math.inf)
        for row in at_once:
            if row.rmse < WORTH_A_FEEDTHROUGH * least:
                found.append(row)
            else:
                del self.rows[row.found]
        return found

    def _outputs(self) -> list[Output]:
        data = self.task.data
        if self.task.output is not None:
            return [named(self.task.output, data)]
        return [o for o in suggested(data) if o != ABS or self._is_rectified()]

    def _is_rectified(self) -> bool:
        plain = [c.models[0] for c in self.linear.eligible if c.order <= 2]
        return is_rectified(self._behind_rectifier, self._pairs, plain)

    @cached_property
    def _behind_rectifier(self) -> _core.LinearModel | None:
        """The linear model behind a rectifier, of all data: each fold trains from it.
        A delay that was found without the rectifier says nothing.
        """
        order = min(2, self.task.nx or 2)
        until = self.clock.until(self._share)
        (found,) = self.pool.map(
            lambda data, look: or_none(lambda: rectified_start(data, order, self.linear.nk, look)),
            [self.task.data], until=until, what="linear starts of networks",
        )  # fmt: skip
        return found

    @property
    def _nk(self) -> int:
        return self.linear.choice.nk if self.linear.eligible else self.linear.nk

    def _likely(self, outputs: Sequence[Output]) -> list[Structure]:
        """Sizes near those of the best linear models, the likeliest first."""
        task, linear = self.task, self.linear
        orders, nk = list(ORDERS), self._nk
        if linear.eligible:
            order, best = linear.choice.order, linear.best.order
            orders = sorted(
                {*ORDERS, order, order + 1, best, best + 1}, key=lambda o: abs(o - order)
            )
        orders = [o for o in orders if o <= MOST_NX] if task.nx is None else [task.nx]
        hidden = task.hidden or HIDDEN
        found = [
            Structure(nx, k, hidden, decay, output)
            for output in outputs
            for nx in orders
            for decay in DECAYS
            for k in dict.fromkeys((linear.nk, nk))
            if output != ABS or (k == linear.nk and (nx > 1 or task.nx == 1))
        ]
        if task.nk is None and task.data.counts is None:
            # further states can replace the missing sample of a slow input, at great cost
            least = min((linear.error(o, linear.nk) for o in orders), default=math.inf)
            able = [o for o in orders if linear.error(o, linear.nk) <= MISLED * least]
            like = (min(able), linear.nk, LINEAR)
            found += [replace(s, nk=0) for s in found if (s.nx, s.nk, s.output) == like]
        if not self.wants_network and task.nx is None and task.output in (None, "linear"):
            lagged = Structure(2, nk, hidden, LAGGED_DECAY, kind="neural_oe")
            found[2:2] = [lagged] if nk >= 1 else []
        if task.nx is None and task.output in (None, "linear") and self._integrates():
            found += [
                Structure(nx, linear.nk, h, DECAYS[0], integrator=True)
                for nx in (2, 3)
                for h in ((2, HIDDEN) if task.hidden is None else (task.hidden,))
            ]
        return [s for s in found if self._is_affordable(s)]

    def _integrates(self) -> bool:
        linear = self.linear
        is_seen = self.diagnosis.find("integrator") is not None
        return is_seen or (bool(linear.eligible) and linear.integrates(self.task.data))

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Properties of the record that decide what can be identified from it."""
        return diagnose(self.task.data)

    def _is_affordable(self, s: Structure) -> bool:
        """Whether every fold has enough samples for the parameters; if asked for by name, enough
        for the core."""
        parameters = s.parameters(self.task.data.n_inputs)
        is_given = None not in (self.task.nx, self.task.hidden)
        each = 1 if is_given else SAMPLES_PER_PARAMETER
        for part in self.folds:
            known = sum(len(e) - e.unmeasured for e in part.fitted.experiments)
            if known <= each * parameters + s.nx * len(part.fitted.experiments):
                return False
        return True

    def _start(self, s: Structure, fold: int) -> _core.LinearModel | None:
        """The linear model at which networks of this order and delay start."""
        if s.output == ABS:
            behind = self._behind_rectifier
            return None if behind is None else raised(behind, s.nx)
        self.linear.add([(s.nx, s.nk)], self.clock.until(self._share))
        others = (i for i in range(len(self.folds)) if i != fold)
        found = [self.linear.start(s.nx, s.nk, i) for i in (fold, *others)]
        # without a block, a fit can end at a trend: that of another fold is nearer to the plant
        longest = max(len(e) for e in self.task.data.experiments)
        able = (m for m in found if m is not None and time_constant(m) <= longest)
        return next(able, found[0])

    def _trained(
        self, s: Structure, iterations: int, models: Models | None = None, starts: int = STARTS
    ) -> Row | None:
        """The row of a structure after further iterations from models of each fold, else of its
        starts; None if no start is sound, a fold has none, or no time is left.
        """
        if self.clock.over(self._share, TRAINING):
            return None
        task, until = self.task, self.clock.until(self._share)
        most = iterations if task.iterations is None else min(iterations, task.iterations)
        starts = starts if task.starts is None else task.starts
        requests = []
        for i, part in enumerate(self.folds):
            given = () if models is None else models[i]
            linear = self._start(s, i) if not given or s.kind == "neural_oe" else None
            count = 0 if given else starts
            requests.append(Request(s, part.fitted, None, most, linear, count, 0, given))
        share = max(self.pool.share, min(0.8, self.pool.share + 0.02))
        found = self._started(requests, until, share)
        # a linear fit that ends at a trend is no start: random ones are
        again = [i for i, f in enumerate(found) if not f and s.kind == "neural_ss"]
        afresh = [replace(requests[i], linear=None) for i in again if models is None]
        for i, starts_ in zip(again, self._started(afresh, until, share), strict=False):
            found[i] = starts_
        judged = [counting(f) for f in guarded(found, self._pairs, self._bounds, self.pool)]
        if not all(judged):
            return None
        if not any(f[0].is_sound for f in judged):
            if self._unsound is None:
                self._unsound = s, tuple(tuple(f) for f in judged)
            return None
        parameters = s.parameters(task.data.n_inputs)
        return self._enter(s.kind, parameters, s, [[x.model for x in f] for f in judged])

    def _started(
        self, requests: Sequence[Request], until: float | None, share: float
    ) -> list[list[Start]]:
        task = self.task
        return train(
            requests, self.pool, task.seed, workers=task.workers, until=until, share=share,
            what=TRAINING,
        )  # fmt: skip

    @property
    def _bounds(self) -> list[_core.LinearModel]:
        """The linear model whose memory of the initial state bounds that of networks."""
        model = self.linear.choice.models[0] if self.linear.eligible else None
        return [] if model is None else [model]

    def _further(self, row: Row, iterations: int) -> Row:
        """The row trained further; unchanged if that is not better on the blocks."""
        new = self._trained(row.found, iterations, row.models)
        if new is not None and new.rmse < row.rmse:
            return new
        self.rows[row.found] = row
        return row

    def _climb(self) -> None:
        """Larger networks and other weight decays from the best one, while these are better."""
        networks = [r for r in self.rows.values() if r.kind == "neural_ss"]
        best = min(networks, key=lambda r: r.rmse, default=None)
        for _ in range(ROUNDS):
            if best is None:
                return
            found = [row for s in self._moves(best.found) if (row := self._moved(best, s))]
            nearest = min(found, key=lambda r: r.rmse, default=None)
            best = nearest if nearest and nearest.rmse < best.rmse else None

    def _moves(self, s: Structure) -> list[Structure]:
        task = self.task
        found = [replace(s, decay=float(f"{s.decay * f:.0e}")) for f in (0.1, 10.0)]
        if task.hidden is None and 2 * s.hidden <= MOST_HIDDEN:
            found.append(replace(s, hidden=2 * s.hidden))
        if task.nx is None and s.nx < MOST_NX:
            found.append(replace(s, nx=s.nx + 1))
        return [m for m in found if m not in self.rows and self._is_affordable(m)]

    def _moved(self, best: Row, s: Structure) -> Row | None:
        """The row of a structure that starts at the models of a smaller one or another decay."""
        size = best.found.nx, best.found.hidden
        each = FURTHER * s.operations(self.task.data.n_inputs, len(self.task.data))
        able = max(1, int(CLIMBED / (len(self.folds) * each)))
        models = [f[:able] for f in best.models]
        if size == (s.nx, s.hidden):
            return self._trained(s, FURTHER, models)
        grown = [tuple(m.grown(s.nx, s.hidden, self.task.seed) for m in f) for f in models]
        return self._trained(s, FURTHER, grown)

    # --- the model --------------------------------------------------------------------------------

    def model(self, is_interrupted: bool = False) -> Model:
        """The rows combined, those with weight trained on everything."""
        rows = [r for r in self.rows.values() if r.kind == "neural_ss" or not self.wants_network]
        reasons = ["interrupted: the best so far"] if is_interrupted else []
        if rows:
            # at rounding, errors say no more
            exact = [r for r in rows if self.is_exact and r.rmse <= self._rounding]
            simplest = sorted(exact, key=lambda r: r.parameters)[:1]
            mixture = combined(simplest or rows, self.blocks)
            reasons += [*self._missing(rows, is_interrupted), self._reason(mixture, len(rows))]
        else:
            late = self._late_row()
            row = late or self._unsound_row()
            mixture = Mixture((row,), np.ones(1), row.residual, row.errors)
            reasons.append(
                "there was time for one network only"
                if late is not None
                else "no network passed the guard; the best of them is used"
            )
        shares = self._shares(mixture)
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
        error = mixture.errors.rmse
        linear = self._linear_error()
        model = closed(
            self.task.documented(model, {**model.training, **provenance}), self.task,
            self.blocks.together, error, linear=linear, wants_network=self.wants_network,
            diagnosed=self._diagnosed,
        )  # fmt: skip
        model = self._with_blocks(model, mixture)
        return replace(model, alternatives=tuple(self._alternatives(model)))

    def _with_blocks(self, model: Model, mixture: Mixture) -> Model:
        """The verdict with the fit of each block, which shows how far the figure can be trusted."""
        spread, sizes = self.blocks.together.spread, self.blocks.sizes
        if len(sizes) < 2 or not spread > 0.0:
            return model
        if not np.isfinite(mixture.residual).all():
            return model
        ends = np.cumsum(sizes)[:-1]
        squares = np.split(self.blocks.weights * mixture.residual**2, ends)
        counts = np.split(self.blocks.weights, ends)
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
        self._enter_linear()
        able = [r for r in self.rows.values() if r.kind == "neural_ss" or not self.wants_network]
        if not able:
            # a kind requested by name is not replaced by another
            raise KeyboardInterrupt from stopped
        return with_provenance(self.model(is_interrupted=True), {"termination": "interrupted"})

    def _missing(self, rows: Sequence[Row], is_interrupted: bool) -> list[str]:
        """Why there is no network among the rows."""
        if self.is_exact:
            return ["the linear model's error is at rounding: no network was asked"]
        if is_interrupted or any(isinstance(r.found, Structure) for r in rows):
            return []
        if TRAINING in self.clock.lost:
            return ["the time budget left no time for a network"]
        return ["no network could be trained: too few samples, or none passed the guard"]

    def _shares(self, mixture: Mixture) -> FloatArray:
        """Members of each row in proportion to its weight, as many as the scarcest row allows."""
        if len(mixture.rows) == 1:
            (row,) = mixture.rows
            # a linear model or a motor needs no others beside it
            alone = row.kind in ("oe", "grey_box")
            return np.array([1 if alone else min(MOST_MEMBERS, self.task.starts or MOST_MEMBERS)])
        pairs = zip(mixture.rows, mixture.weights, strict=True)
        whole = 0 if self.folds[0].is_given else 1
        able = min(
            (sum(map(len, r.models)) + whole * (r.kind in ("oe", "grey_box"))) / w for r, w in pairs
        )
        most = min(MOST_MEMBERS, max(1, int(able)))
        return np.diff(np.round(most * np.cumsum(mixture.weights)), prepend=0.0)

    def _members(self, row: Row, most: int, is_interrupted: bool) -> list[tuple[Any, Provenance]]:
        """At most so many models of the row, each with its provenance.
        Networks are trained a little further on everything, each from one that was trained without
        a block, if they stay sound. A linear model or a motor is fitted to everything; if there are
        to be several, those without a block follow.
        """
        fitted = [len(f.fitted) for f in self.folds]
        known: Provenance = {}
        if isinstance(row.found, Structure):
            known["weight_decay"] = row.found.decay
        plain = known | {"samples_fitted": len(self.task.data)}
        of_folds = [
            (m[i], known | {"samples_fitted": n})
            for i in range(max(map(len, row.models)))
            for m, n in zip(row.models, fitted, strict=True)
            if i < len(m)
        ]
        given = of_folds[:most]
        if not most or is_interrupted or self.folds[0].is_given:
            return given
        if self.clock.over(SHARE_OF_REFIT, REFIT_LOST):
            return given
        until = self.clock.until(SHARE_OF_REFIT)
        if row.kind == "oe":
            options = self.task.fit_options(
                na=row.found.order, nb=row.found.order + 1, nk=row.found.nk
            )
            (fit,) = self.pool.map(
                lambda data, look: _core.fit_oe(data, **{**options, "progress": look}),
                [self._pairs], until=until, share=1.0, what=REFIT_LOST,
            )  # fmt: skip
            first = [] if fit is None else [(fit.model, plain | linear_provenance(fit))]
            return [*first, *given][:most]
        if row.kind == "grey_box":
            hidden = row.found.hidden
            (core,) = self.pool.map(
                lambda data, look: or_none(lambda: self.motors.fitted(data, hidden, look)),
                [self.task.data], until=until, share=1.0, what=REFIT_LOST,
            )  # fmt: skip
            # on everything it must not fit worse than the best that was fitted to less
            able = ([] if core is None else [(core, plain)]) + of_folds
            able.sort(key=lambda pair: grey_box.cost_of(pair[0], self.task.data))
            return able[:most]
        linear = self._start(row.found, 0) if row.kind == "neural_oe" else None
        request = Request(
            row.found, self.task.data, None, min(REFIT, self.task.iterations or REFIT), linear,
            initial=[m for m, _ in given],
        )  # fmt: skip
        found = train(
            [request], self.pool, self.task.seed, workers=self.task.workers, until=until, share=1.0,
            what=REFIT_LOST,
        )  # fmt: skip
        (starts,) = guarded(found, self._pairs, self._bounds, self.pool)
        return [(s.model, plain) for s in counting(starts) if s.is_sound] or given

    def _late_row(self) -> Row | None:
        """A network that was asked for by name, in the time that is left after slow linear fits."""
        self._share = SHARE_OF_REFIT
        if not self.wants_network or self._unsound is not None:
            return None
        likely = self._likely(self._outputs())
        return self._trained(likely[0], FIRST, starts=1) if likely else None

    def _unsound_row(self) -> Row:
        """The best network that failed the guard, if a network was asked for by name."""
        if self._unsound is not None:
            structure, starts = self._unsound
            models = tuple(tuple(s.model for s in f) for f in starts)
            cores = [EnsembleCore(m, "median") for m in models]
            residual = self.blocks.residual(cores)
            if residual is None:
                residual = np.full(len(self.blocks.weights), np.inf)
            parameters = structure.parameters(self.task.data.n_inputs)
            errors = self.blocks.errors(residual)
            return Row("neural_ss", parameters, structure, models, residual, errors)
        remedy = "give more time" if self.clock.truncated else "record longer"
        raise FitError(
            f"{self.task.data.source}: expected a model with a finite free run on data not trained "
            f"on, found none; {remedy}, give other sizes (nx, hidden), or ask for model oe"
        )

    def _linear_error(self) -> float | None:
        errors = [joined(c.errors).rmse for c in self.linear.eligible]
        return min(errors, default=None)

    def _alternatives(self, model: Model) -> list[Model]:
        """The best network alone, if the model has none, and the linear model."""
        found, kinds = [], {m.kind for m in model.members or (model,)}
        networks = [r for r in self.rows.values() if isinstance(r.found, Structure)]
        if networks and not kinds & {"neural_ss", "neural_oe"}:
            best = min(networks, key=lambda r: r.rmse)
            choice: Provenance = {
                "chosen": best.kind, "reason": "an alternative to the choice",
                "free_run_rmse": {best.kind: finite(best.rmse)},
            }  # fmt: skip
            members = self._members(best, MOST_MEMBERS, True)
            extra: Provenance = {"initial_state": "estimated", "choice": choice}
            found.append(self.task.documented(as_one(members, self.task), extra))
        if self.linear.eligible and kinds != {"oe"}:
            chosen = self.linear.choice
            found.append(linear_alternative(chosen, joined(chosen.errors).rmse, self.task))
        return found

    def _reason(self, mixture: Mixture, count: int) -> str:
        parts = len(self.folds)
        where = "the validation data" if parts == 1 else f"{parts} blocks, each held out once"
        if len(mixture.rows) == 1:
            what = (
                "the simplest structure that does as well as all together within a standard error"
            )
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
        linear, error = self._linear_error(), finite(mixture.errors.rmse)
        rmse = {} if linear is None else {"oe": finite(linear)}
        return {
            "chosen": kind,
            "reason": "; ".join(reasons),
            "free_run_rmse": rmse | {kind: error},
            "candidates": [r.to_json(weights.get(id(r), 0.0)) for r in self._listed()],
            "held_out": list(self.blocks.together.sources),
            "chosen_structure": mixture.rows[int(np.argmax(mixture.weights))].found.to_json(),
            "final_free_run_rmse": error,
        }

    def _listed(self) -> list[Row]:
        """Linear models in their order, a motor, and networks in the order of their trials."""
        order = ("oe", "grey_box")
        rows = self.rows.values()
        linear = sorted(
            (r for r in rows if r.kind == "oe"), key=lambda r: (r.found.order, r.found.nk)
        )
        return [
            *linear,
            *(r for r in rows if r.kind == order[1]),
            *(r for r in rows if r.kind not in order),
        ]

    def _diagnosed(self) -> Diagnosis | None:
        is_known = "diagnosis" in self.__dict__ or not self.clock.over(SHARE_OF_REFIT, DIAGNOSIS)
        return self.diagnosis if is_known else None
