"""The search on little data: a table of structures, judged on blocks of the whole record.

On few samples it is luck which structure leads on one held-out part, and which one a vote refuses.
Here every structure is trained without each block in turn and judged on that block, so that every
sample is predicted by models that have not seen it. The structures are then combined by convex
weights of least squares on these free runs (stacking: Wolpert 1992; Breiman 1996; of time series,
Hansen and Racine 2012), reduced to the fewest that do as well within a standard error
(`blocks.py`, `mixture.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

from .. import _core
from ..dataset import Diagnosis, diagnose
from ..models.base import EnsembleCore
from . import grey_box
from .blocks import Blocks, Row
from .grey_box import or_none
from .linear import MISLED, ROUNDING, LinearTable, raised, time_constant
from .outputs import ABS, LINEAR, Output, named, rectified_start, suggested
from .task import Pool, Task, arrays
from .training import Request, Start, Structure, counting, guarded, train
from .trials import (
    SAMPLES_PER_PARAMETER,
    SHARE_OF_FINAL,
    SHARE_OF_LINEAR,
    SHARE_OF_REFIT,
    TRAINING,
    WORTH_A_FEEDTHROUGH,
)

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
SHARE_OF_NETWORKS = 0.85
"""Part of a time budget by which networks must be finished."""
LAGGED_DECAY = 1e-3
"""Weight decay of the lagged network, where it has another meaning."""
Models: TypeAlias = Sequence[Sequence[Any]]
"""Of each fold."""


@dataclass
class Table:
    """The structures of one identification.
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
        self.unsound: tuple[Structure, tuple[tuple[Start, ...], ...]] | None = None
        self.pairs = arrays(self.task.data)
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
        self.enter_linear()
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
    def usable(self) -> list[Row]:
        """Rows of which the model may consist."""
        return [r for r in self.rows.values() if r.kind == "neural_ss" or not self.wants_network]

    @property
    def rounding(self) -> float:
        """Error that is only rounding."""
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

    def enter_linear(self) -> None:
        """Rows of all linear models so far that every fold has."""
        if self.wants_network:
            return
        for c in self.linear.candidates.values():
            if all(m is not None for m in c.models):
                self._enter("oe", c.parameters, c, [(m,) for m in c.models])

    def _enter(
        self, kind: str, parameters: int, found: Any, models: Models, sound: Sequence[bool] = ()
    ) -> Row | None:
        """A row of these models of each fold, unless one runs away on its block."""
        cores = [m[0] if len(m) == 1 else EnsembleCore(tuple(m), "median") for m in models]
        residual = self.blocks.residual(cores)
        if residual is None:
            return None
        row = Row(
            kind, parameters, found, tuple(map(tuple, models)),
            tuple(sound) or (True,) * len(self.folds), residual, self.blocks.errors(residual),
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
        output, data = self.task.output, self.task.data
        return suggested(data) if output is None else [named(output, data)]

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
        is_free = task.nx is None and task.output in (None, "linear")
        if is_free and not self.wants_network:
            lagged = Structure(2, nk, hidden, LAGGED_DECAY, kind="neural_oe")
            found[2:2] = [lagged] if nk >= 1 else []
        if is_free and linear.integrates(task.data, self.diagnosis):
            found += [
                Structure(nx, linear.nk, h, DECAYS[0], integrator=True)
                for nx in (2, 3)
                for h in ((2, HIDDEN) if task.hidden is None else (task.hidden,))
            ]
        return [s for s in found if self._is_affordable(s)]

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

    def start_of(self, s: Structure, fold: int) -> _core.LinearModel | None:
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
            linear = self.start_of(s, i) if not given or s.kind == "neural_oe" else None
            count = 0 if given else starts
            requests.append(Request(s, part.fitted, None, most, linear, count, 0, given))
        share = max(self.pool.share, min(0.8, self.pool.share + 0.02))
        found = self._started(requests, until, share)
        # a linear fit that ends at a trend is no start: random ones are
        again = [i for i, f in enumerate(found) if not f and s.kind == "neural_ss"]
        afresh = [replace(requests[i], linear=None) for i in again if models is None]
        for i, starts_ in zip(again, self._started(afresh, until, share), strict=False):
            found[i] = starts_
        judged = [counting(f) for f in guarded(found, self.pairs, self.bounds, self.pool)]
        if not all(judged):
            return None
        if not any(f[0].is_sound for f in judged):
            if self.unsound is None:
                self.unsound = s, tuple(tuple(f) for f in judged)
            return None
        parameters = s.parameters(task.data.n_inputs)
        trained = [[x.model for x in f] for f in judged]
        return self._enter(s.kind, parameters, s, trained, [f[0].is_sound for f in judged])

    def _started(
        self, requests: Sequence[Request], until: float | None, share: float
    ) -> list[list[Start]]:
        task = self.task
        return train(
            requests, self.pool, task.seed, workers=task.workers, until=until, share=share,
            what=TRAINING,
        )  # fmt: skip

    @property
    def bounds(self) -> list[_core.LinearModel]:
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

    def late_row(self) -> Row | None:
        """A network that was asked for by name, in the time that is left after slow linear fits."""
        self._share = SHARE_OF_REFIT
        if not self.wants_network or self.unsound is not None:
            return None
        likely = self._likely(self._outputs())
        return self._trained(likely[0], FIRST, starts=1) if likely else None

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
