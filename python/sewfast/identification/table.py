"""The search for a structure: a table of structures, judged on blocks of the whole record.

It is luck which structure leads on one held-out part, and which one a vote refuses. Here every
structure is trained without each block in turn and judged on that block, so that every sample is
predicted by models that have not seen it. The structures are then combined by convex weights of
least squares on these free runs (stacking: Wolpert 1992; Breiman 1996; of time series, Hansen and
Racine 2012), reduced to the fewest that do as well within a standard error (`blocks.py`,
`mixture.py`).

Effort is counted in multiplications, not in seconds, so that a seed gives the same model on every
machine: a stage has as many starts and iterations as its work allows. On many samples all but the
last stage train on an excerpt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

from .. import _core
from ..dataset import Diagnosis, diagnose
from ..dataset.pieces import thinned
from ..models.base import EnsembleCore
from ..units import revolutions_per_second
from . import grey_box, lagged
from .blocks import Blocks, Mixture, Row, near
from .folds import TRIAL
from .grey_box import or_none
from .linear import (
    INTEGRATING_POLE,
    MISLED,
    ORDERS,
    ROUNDING,
    LinearTable,
    raised,
    slowest_pole,
    time_constant,
)
from .outputs import ABS, LINEAR, Output, named, rectified_start, suggested
from .task import HIDDEN, SHARES, Pool, Task, arrays
from .training import Request, Start, Structure, counting, guarded, train

LIKELY, TRIED = 2, 4
"""Numbers of states that are tried with an output function, or another delay; and in any case,
beside those of the best linear models."""
DECAYS = (0.1, 10.0)
"""Weight decays in the beginning, times the number of samples: a prior of the weights, which counts
the less the more data there are. With the smaller one only, the geometric mean of test errors is
.569 of output error's, with both .417 (families `short_*` of the battery's rules)."""
FIRST_STARTS, STARTS = 8, 4
"""Of each fold: at first, and of those the best."""
BRIEF, FIRST_OF_INTEGRATORS, HALVINGS, FURTHER = 15, 60, (30, 60), 90
"""Iterations of all networks (and at least of any stage, and at the end on all samples), further
ones of the better halves, and of each step of the climb."""
WORK, CLIMBED = 1e11, 5e9
"""Multiplications of a stage, and of one structure in a step of the climb; a core does some 1.4e10
per second. Training to the end pays on few samples, where it costs little."""
ROUNDS, LEAST_FURTHER, WORTH_A_STEP = 4, 40, 0.99
"""Steps of the climb, their iterations whatever the work, and the part below which each has to
bring the error."""
WORTH_A_FEEDTHROUGH = 0.5
"""Error ratio required of nk = 0. It is no plant for a loop, and a smoothed speed anticipates the
input a little."""
LEADING = 3
LEGS, LEG, FINISHED = 2, 80, 0.995
"""Stages on all samples of those that lead, and their iterations; one that does not bring the error
below the last part is the last one."""
TRAINING = "training of networks"
"""What is lost if a time budget ends before a network is trained, or while one is."""
Models: TypeAlias = Sequence[Sequence[Any]]
"""Of each fold."""


@dataclass
class Table:
    """The structures of one identification; `rows` are those that are finite on every block."""

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
        # part of a time budget by which the present stage must be finished
        self._share = SHARES.search
        # the data to which each fold's networks are trained
        self._fitted = [thinned(f.fitted, TRIAL) for f in self.folds]

    # --- the schedule -----------------------------------------------------------------------------

    def search(self) -> None:
        """Linear models and a motor, then networks: the better half of them further, twice, larger
        ones from the best, and those that lead to the end.
        The equations of a motor come after the smallest linear model: where they hold, no other
        second of the search gains as much, and a time budget must not end before it. Those of a
        joint take longer than all linear models, and many a length (a level) is no joint's.
        """
        self.linear.begin()
        is_open = not self.is_exact
        is_motor = revolutions_per_second(self.task.data.output_unit) is not None
        if is_open and is_motor:
            self._try_motor()
        self.linear.search(self.clock.within(SHARES.linear, SHARES.search))
        if is_open and not is_motor:
            self._try_motor()
        self.enter_linear()
        if self.is_exact or self.joints_decide:
            return
        alive = self._screened()
        for iterations in HALVINGS:
            half = sorted(alive, key=lambda r: r.rmse)[: max(2, (len(alive) + 1) // 2)]
            # what is far behind the best is not trained further
            going = [r for r in half if r.rmse <= 3.0 * half[0].rmse]
            alive = self._further(going, iterations)
        if not self.is_hopeless:
            self._climb()
            self._finish()

    @property
    def is_exact(self) -> bool:
        """Whether the linear model's error is only rounding, so that a network cannot help."""
        return not self.wants_network and self.linear.is_exact(self.task.data)

    @property
    def is_hopeless(self) -> bool:
        """Whether no network is better so far than linear models or a motor's equations."""
        networks = [r.rmse for r in self.rows.values() if isinstance(r.found, Structure)]
        others = [r.rmse for r in self.rows.values() if not isinstance(r.found, Structure)]
        return min(networks, default=math.inf) >= min(others, default=math.inf)

    @property
    def usable(self) -> list[Row]:
        """Rows of which the model may consist.
        Where the plant integrates, a model without an integrator follows the positions of the
        record only. Where one trajectory repeats, a network with one has learned its forces by
        heart, which no held-out part shows: the equations of a joint count alone.
        """
        found = [r for r in self.rows.values() if r.kind == "neural_ss" or not self.wants_network]
        if self.joints_decide:
            return [r for r in found if r.kind == "grey_box"]
        able = [r for r in found if is_integrator(r)]
        return able if able and self._integrates else found

    @property
    def joints_decide(self) -> bool:
        """Whether the equations of a joint count alone: repetitions tell nothing of what is new to
        a network, while physics holds there too."""
        joints = (r for r in self.rows.values() if r.kind == "grey_box" and is_integrator(r))
        repeats = any(joints) and self._integrates and self.diagnosis.find("repeats") is not None
        return repeats and not self.wants_network

    @property
    def _integrates(self) -> bool:
        return self.linear.integrates(self.task.data, self.diagnosis)

    @property
    def rounding(self) -> float:
        """Error that is only rounding."""
        return ROUNDING * max(abs(v) for v in self.task.data.output_range)

    def _try_motor(self) -> None:
        """Fit the equations of a motor, unless another kind was requested."""
        task = self.task
        if self.wants_network or {task.nk, task.nx, task.hidden, task.output} != {None}:
            return
        until, found = self.clock.until(SHARES.search), []
        if not task.data.output_unit:
            self.motors = replace(self.motors, integrates=self._integrates)
        for part in self.folds:
            part = part.shortened(grey_box.MOST_FITTED)
            one = self.motors.candidate(part, self.pool, until)
            if one is None:
                return
            found.append(one)
        largest = max(found, key=lambda c: c.hidden)
        self._enter("grey_box", len(largest.core.theta), largest, [(c.core,) for c in found])

    def enter_linear(self) -> None:
        """Rows of the linear models so far that can be chosen and that every fold has."""
        if self.wants_network:
            return
        for c in self.linear.eligible:
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
        likely = self._likely(self._outputs())
        tried: list[Row | None] = []
        # an integrator begins without the motion of a linear model, far from its optimum
        for is_far, iterations in ((False, BRIEF), (True, FIRST_OF_INTEGRATORS)):
            asked = [(s, None) for s in likely if s.integrator == is_far]
            tried += self._stage(asked, iterations, FIRST_STARTS)
        found = [r for r in tried if r is not None and (r.found.nk > 0 or self.task.nk == 0)]
        # no loop can be closed around a model that needs the input of the same sample; further
        # states can replace it, so that only those of equal size tell
        delayed = {replace(r.found, nk=0): r.rmse for r in found if r.found.nk == self.linear.nk}
        for row in tried:
            if row is not None and row not in found:
                if row.rmse < WORTH_A_FEEDTHROUGH * delayed.get(row.found, math.inf):
                    found.append(row)
                else:
                    del self.rows[row.found]
        return found

    def _outputs(self) -> list[Output]:
        output, data = self.task.output, self.task.data
        return suggested(data) if output is None else [named(output, data)]

    @cached_property
    def _behind_rectifier(self) -> _core.LinearModel | None:
        """The linear model behind a rectifier of all data, in which each fold trains."""
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
        orders, nk = list(ORDERS[:TRIED]), self._nk
        if linear.eligible:
            order, best = linear.choice.order, linear.best.order
            orders = sorted({*orders, order, best}, key=lambda o: abs(o - order))
        orders = orders if task.nx is None else [task.nx]
        hidden = task.hidden or HIDDEN
        decays = [float(f"{d / len(task.data):.0e}") for d in DECAYS]
        widths = (HIDDEN, HIDDEN, 2 * HIDDEN) if task.hidden is None else (hidden,) * 2
        found = [
            Structure(nx, k, h, decay, output)
            for output in outputs
            for nx in self._orders_of(output, orders)
            for h, decay in zip(widths, (*decays, decays[0]), strict=False)
            for k in dict.fromkeys((linear.nk, nk))
            if k == linear.nk or (nx in orders[:LIKELY] and output != ABS)
        ]
        if task.nk is None and task.data.counts is None:
            # further states can replace the missing sample of a slow input, at great cost
            least = min((linear.error(o, linear.nk) for o in orders), default=math.inf)
            able = [o for o in orders if linear.error(o, linear.nk) <= MISLED * least]
            like = (min(able), linear.nk, LINEAR)
            found += [replace(s, nk=0) for s in found if (s.nx, s.nk, s.output) == like]
        is_free = task.nx is None and task.output in (None, "linear")
        if is_free and not self.wants_network:
            # between those of the default one: of a lagged network it means something else
            decay = math.sqrt(math.prod(lagged.DECAYS))
            network = Structure(2, nk, hidden, decay, kind="neural_oe")
            found[2:2] = [network] if nk >= 1 else []
        if is_free:
            sizes = [(nx, task.hidden or h) for nx, h in self._integrators()]
            found += [
                Structure(nx, linear.nk, h, decays[0], integrator=True)
                for nx, h in dict.fromkeys(sizes)
            ]
        return [s for s in found if self._is_affordable(s)]

    def _integrators(self) -> list[tuple[int, int]]:
        """States and hidden units of networks with an integrator. One is tried in any case: linear
        models and the test for a pole at 1 miss that of a drive that friction holds most of the
        time (`angle`, system 13: error .026 with it, .85 without).
        """
        if self._integrates:
            return [(2, 2), (2, HIDDEN), (3, 2), (3, HIDDEN)]
        return [(2, HIDDEN)]

    def _orders_of(self, output: Output, orders: Sequence[int]) -> Sequence[int]:
        """Numbers of states to try with an output function; a hidden sign takes two to be told."""
        if output == LINEAR or self.task.nx is not None:
            return orders
        return [nx for nx in orders if output != ABS or nx > 1][:LIKELY]

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Properties of the record that decide what can be identified from it."""
        return diagnose(self.task.data)

    def _is_affordable(self, s: Structure) -> bool:
        """Whether every fold has enough samples for the parameters; for the core, if asked for."""
        parameters = s.parameters(self.task.data.n_inputs)
        is_given = None not in (self.task.nx, self.task.hidden)
        # samples of each parameter
        each = 1 if is_given else 4
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

    def _stage(
        self,
        wanted: Sequence[tuple[Structure, Models | None]],
        iterations: int,
        starts: int = STARTS,
        work: float = WORK,
        least: int = BRIEF,
    ) -> list[Row | None]:
        """Rows of structures after further iterations from models of each fold, else of fresh
        starts, as many of both as this work allows.
        """
        samples = sum(map(len, self._fitted))
        each = sum(s.operations(self.task.data.n_inputs, samples) for s, _ in wanted)
        most = int(work / max(each, 1.0))
        starts = max(1, min(starts, most // iterations))
        iterations = min(iterations, max(least, most))
        if self.task.iterations is not None:
            iterations = min(iterations, self.task.iterations)
        # as many at a time as keep all threads at work
        together = max(1, self.pool.threads // len(self.folds))
        # the same for all: fits of further linear starts must not change them with the threads
        bounds, found = self.bounds, list[Row | None]()
        for i in range(0, len(wanted), together):
            found += self._trained(wanted[i : i + together], iterations, starts, bounds)
        return found

    def _trained(
        self,
        wanted: Sequence[tuple[Structure, Models | None]],
        iterations: int,
        starts: int,
        bounds: list[_core.LinearModel],
    ) -> list[Row | None]:
        """One row each; None if no start is sound, a fold has none, or no time is left."""
        if self.clock.over(self._share, TRAINING):
            return [None] * len(wanted)
        task, until = self.task, self.clock.until(self._share)
        fresh = starts if task.starts is None else task.starts
        requests: list[Request] = []
        for s, models in wanted:
            for i, fitted in enumerate(self._fitted):
                given = () if models is None else models[i][:starts]
                linear = self.start_of(s, i) if not given or s.kind == "neural_oe" else None
                count = 0 if given else fresh
                requests.append(Request(s, fitted, None, iterations, linear, count, 0, given))
        share = max(self.pool.share, min(0.8, self.pool.share + 0.02))
        found = self._started(requests, until, share)
        # a linear fit that ends at a trend is no start: random ones are
        again = [
            i
            for i, (f, r) in enumerate(zip(found, requests, strict=True))
            if not (f or r.initial) and r.structure.kind == "neural_ss"
        ]
        afresh = [replace(requests[i], linear=None) for i in again]
        for i, starts_ in zip(again, self._started(afresh, until, share), strict=True):
            found[i] = starts_
        judged = [counting(f) for f in guarded(found, self.pairs, bounds, self.pool)]
        folds = len(self.folds)
        return [
            self._judged(s, judged[i * folds : (i + 1) * folds]) for i, (s, _) in enumerate(wanted)
        ]

    def _judged(self, s: Structure, judged: Sequence[list[Start]]) -> Row | None:
        """The row of a structure with these starts of each fold."""
        if not all(judged):
            return None
        if not any(f[0].is_sound for f in judged):
            if self.unsound is None:
                self.unsound = s, tuple(tuple(f) for f in judged)
            return None
        parameters = s.parameters(self.task.data.n_inputs)
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

    def _further(self, rows: Sequence[Row], iterations: int, work: float = WORK) -> list[Row]:
        """The rows trained further, each unchanged if that is not better on the blocks."""
        found = self._stage([(r.found, r.models) for r in rows], iterations, work=work)
        better = [
            new if new is not None and new.rmse < row.rmse else row
            for row, new in zip(rows, found, strict=True)
        ]
        self.rows |= {r.found: r for r in better}
        return better

    def late_row(self) -> Row | None:
        """A network that was asked for by name, in the time that is left after slow linear fits."""
        self._share = SHARES.refit
        if not self.wants_network or self.unsound is not None:
            return None
        likely = self._likely(self._outputs())[:1]
        return next(iter(self._stage([(s, None) for s in likely], BRIEF, starts=1)), None)

    def _climb(self) -> None:
        """Larger networks and other weight decays from the best one, while these are better."""
        networks = [r for r in self.usable if r.kind == "neural_ss"]
        best = min(networks, key=lambda r: r.rmse, default=None)
        for round_ in range(ROUNDS):
            if best is None:
                return
            moves = [(s, self._moved(best, s)) for s in self._moves(best.found, round_ == 0)]
            tried = self._stage(moves, FURTHER, work=CLIMBED * len(moves), least=LEAST_FURTHER)
            found = [r for r in tried if r is not None and r.rmse < WORTH_A_STEP * best.rmse]
            best = min(found, key=lambda r: r.rmse, default=None)

    def _moves(self, s: Structure, is_first: bool) -> list[Structure]:
        task = self.task
        factors = (0.1, 10.0) if is_first else ()
        found = [replace(s, decay=float(f"{s.decay * f:.0e}")) for f in factors]
        # at most 32 hidden units
        if task.hidden is None and 2 * s.hidden <= 32:
            found.append(replace(s, hidden=2 * s.hidden))
        if task.nx is None and s.nx < ORDERS[-1]:
            found.append(replace(s, nx=s.nx + 1))
        return [m for m in found if m not in self.rows and self._is_affordable(m)]

    def _moved(self, best: Row, s: Structure) -> Models:
        """Models of each fold from which a larger structure, or another decay, starts."""
        if (best.found.nx, best.found.hidden) == (s.nx, s.hidden):
            return best.models
        return [tuple(m.grown(s.nx, s.hidden, self.task.seed) for m in f) for f in best.models]

    def _finish(self) -> None:
        """Networks that lead, trained to the end on all samples."""
        self._share = SHARES.networks
        self._fitted = [f.fitted for f in self.folds]
        mixture = Mixture.of(near(self.usable), self.blocks)
        pairs = sorted(zip(mixture.weights, mixture.rows, strict=True), key=lambda p: -p[0])
        going = [r for w, r in pairs if w > 0.0 and isinstance(r.found, Structure)][:LEADING]
        # as much for a sample as in the stages before
        work = WORK * max(1.0, len(self.task.data) / TRIAL)
        for _ in range(LEGS):
            after = self._further(going, LEG, work)
            going = [
                new for new, old in zip(after, going, strict=True) if new.rmse < FINISHED * old.rmse
            ]
            if not going:
                return


def is_integrator(row: Row) -> bool:
    """Whether its models have an integrator: a network, a joint, or a pole at 1."""
    if isinstance(row.found, Structure):
        return row.found.integrator
    cores = [m[0] for m in row.models]
    if row.kind == "grey_box":
        return all(core.settings["integrator"] for core in cores)
    return all(slowest_pole(core) > INTEGRATING_POLE for core in cores)
