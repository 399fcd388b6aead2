"""The search for a structure: short trials of many, longer ones of the better half, then growth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from .. import _core
from ..dataset import Diagnosis, diagnose
from . import grey_box
from .folds import Split, compared
from .linear import HELD_OUT, MISLED
from .outputs import ABS, LINEAR, Output, is_rectified, named, suggested
from .task import arrays
from .training import Request, Structure
from .trials import (
    SHARE_OF_FINAL,
    SHARE_OF_LINEAR,
    TRAINING,
    WORTH_A_FEEDTHROUGH,
    Candidate,
    Trials,
    best_of_each_size,
)

MOST_NX, MOST_HIDDEN, MOST_HIDDEN_SMALL = 8, 32, 16
LEAST_DECAY, MOST_DECAY = 1e-10, 1e-1
DECAY_MATTERS = 6_000
"""Samples from which on only the finalists, not the climb, try another weight decay."""
HOPELESS = 0.98
"""The search ends if the best of the second halving exceeds this part of the linear error."""
WORTH_A_STEP = 0.97
"""A step of the climb must reduce the error to below this part."""
LEAST_STEP = 0.01
"""Relative gain of a step that suffices if the gain is significant."""
FAR_BEHIND = 2.0
"""A kind of network whose best is worse than the other's by this factor climbs no further."""
STILL_NEAR = 3.0
"""Largest ratio of a size's error to the best one's after the screening."""
SECOND_ROUTE = 0.25
"""Part of its operations below which a search can still climb a second route."""
ROUNDS = 6
MOST_STARTS, SHARE_OF_STARTS = 8, 0.1
"""Fresh starts of a structure at a time, and the part of the operations for all of them."""
SCREEN_ITERATIONS, HALVING_ITERATIONS, CLIMB_ITERATIONS = 20, (25, 40), 40
SAYS_LITTLE = 0.5
"""Error of the best linear model, in deviations of the output, above which poles are ignored."""
INTEGRATING_ITERATIONS, INTEGRATING_STARTS = 60, 8


class Search(Trials):
    """One search: its steps, and the structures tried in each."""

    @property
    def is_released(self) -> bool:
        """Whether a finalist is also tried with less weight decay, since the climb did not."""
        return self.samples >= DECAY_MATTERS

    def run(self) -> None:
        """Linear models, then networks of every likely size, then larger ones from the best.
        The equations of a motor come after the smallest linear model: where they hold, no other
        second of the search gains as much, and a time budget must not end before it.
        """
        self.linear.begin()
        if not self.is_exact:
            self._try_motor()
        self.linear.search(self.pool.clock.within(SHARE_OF_LINEAR, SHARE_OF_FINAL))
        if self.is_exact:
            return
        if self._is_late and not self.wants_network:
            self.pool.clock.lose(TRAINING)
            return
        alive = self.screen()
        for iterations in HALVING_ITERATIONS:
            alive = self.halve(alive, iterations)
        if not self.is_hopeless:
            self.climb()

    def _try_motor(self) -> None:
        """Fit the equations of a motor to the newest part, unless another kind was requested."""
        task = self.task
        if self.wants_network or {task.nk, task.nx, task.hidden, task.output} != {None}:
            return
        until = self.pool.clock.until(SHARE_OF_FINAL)
        self.motor = self.motors.candidate(self.part_of_motor(0), self.pool, until)

    @property
    def motors(self) -> grey_box.Motors:
        """The fits of motors."""
        return grey_box.Motors(self.task.seed, self.task.iterations_or_usual)

    def part_of_motor(self, fold: int) -> Split:
        """The same data as for linear models, so that both can be compared block by block."""
        return self.folds[fold].shortened(grey_box.SEARCHED, HELD_OUT)

    @property
    def is_exact(self) -> bool:
        """Whether the linear model's error is only rounding, so that a network cannot help.
        A network requested by name is trained in any case.
        """
        return not self.wants_network and self.linear.is_exact(self.task.data)

    @property
    def is_hopeless(self) -> bool:
        """Whether no network is visibly better so far than linear models or a motor's equations.
        Larger ones would not help.
        """
        if self.wants_network or not self.linear.eligible or self.best is None:
            return False
        motor = math.inf if self.motor is None else self.motor.rmse
        return self.best.error >= min(HOPELESS * self.linear.best.rmse, motor)

    def screen(self) -> list[Candidate]:
        """Train every likely structure briefly; the best first."""
        likely = self._likely()
        starts = self._screened_starts(likely)
        at_once = self._at_once(likely)
        wanted = [(s, SCREEN_ITERATIONS, starts) for s in (*likely, *at_once)]
        if self.task.hidden is None or self.task.nx is None:
            wanted += [(s, INTEGRATING_ITERATIONS, INTEGRATING_STARTS) for s in self._integrating()]
        wanted += [(s, SCREEN_ITERATIONS, 2) for s in self._lagged()]
        found = self.tried([(s, i, self._limited(n)) for s, i, n in wanted], share=0.25)
        self.feeds_through = bool(at_once) and all(self._is_halved(s) for s in at_once)
        if not self.feeds_through:
            found = [c for c in found if c.structure not in at_once]
        return sorted(found, key=lambda c: c.error)

    def _at_once(self, likely: Sequence[Structure]) -> list[Structure]:
        """Networks without delay, of the smallest order whose linear model is not far behind.
        Additional states can replace the missing sample of a slowly changing input, at great cost:
        among large networks it is too late to try this.
        """
        if self.task.nk is not None or self.task.data.counts is not None or self.nk != 1:
            return []
        linear = self.linear
        most = MISLED * linear.best.rmse if linear.eligible else math.inf
        able = [s.nx for s in likely if linear.error(s.nx, linear.nk) <= most]
        order = min(able, default=min((s.nx for s in likely), default=1))
        return [replace(s, nk=0) for s in likely if s.nx == order and s.output == LINEAR]

    def _is_halved(self, s: Structure) -> bool:
        """Whether the median of the starts and the best one are far better without a delay."""
        one, other = self.candidates[s], self.candidates[replace(s, nk=1)]
        if not (one.is_sound and other.starts):
            return False
        costs = [min(start.cost for start in c.starts) for c in (one, other)]
        worth = WORTH_A_FEEDTHROUGH
        return one.error < worth * other.error and costs[0] < worth**2 * costs[1]

    def _screened_starts(self, likely: Sequence[Structure]) -> int:
        """Number of starts of each structure."""
        samples = len(self.trials[0].fitted)
        round_ = SCREEN_ITERATIONS * sum(s.operations(self.inputs, samples) for s in likely)
        return self._cheap_starts(round_, 3)

    def _cheap_starts(self, operations: float, least: int) -> int:
        """Number of starts that are cheap at this cost for one: the best start judges a size."""
        able = int(SHARE_OF_STARTS * self.budget / max(operations, 1.0))
        return min(MOST_STARTS, max(least, able))

    def halve(self, alive: Sequence[Candidate], iterations: int) -> list[Candidate]:
        """Train the better half further, together with fresh starts.
        The first time it includes the best of every number of states, unless that is far behind:
        after few iterations it is hard to rank sizes.
        """
        half = list(alive[: max(2, len(alive) // 2)])
        near = [c for c in alive if c.error <= STILL_NEAR * alive[0].error]
        firsts = best_of_each_size(near) if iterations == HALVING_ITERATIONS[0] else []
        kept = half + [c for c in firsts if c not in half]
        samples = len(self.trials[0].fitted)
        costs = [
            (c.iterations + iterations) * c.structure.operations(self.inputs, samples) for c in kept
        ]
        fresh = [self._cheap_starts(len(kept) * cost, 1) for cost in costs]
        return sorted(self.continued(kept, iterations, fresh), key=lambda c: c.error)

    def climb(self) -> None:
        """Try larger networks, other decays and delays from the best so far, while steps gain.
        State-space and lagged networks climb side by side, as long as neither is far behind. If the
        search was cheap so far, the best state-space network of another order does too: which of
        the two leads at this point is often luck.
        """
        asked: set[tuple[str, Structure]] = set()
        climbing = [c for c in (self.best_of("neural_ss"), self.best_of("neural_oe")) if c]
        if self.operations < SECOND_ROUTE * self.budget:
            climbing += [c for c in self._ranked("neural_ss")[1:2] if c not in climbing]
        for round_ in range(ROUNDS):
            if not climbing or self.is_over:
                return
            least = min(c.error for c in climbing)
            climbing = [c for c in climbing if c.error <= FAR_BEHIND * least]
            moves = [
                (c, kind, s)
                for c in climbing
                for kind, s in self._moves(c, round_ == 0)
                if (kind, s) not in asked
            ]
            asked.update((kind, s) for _, kind, s in moves)
            found = self._moved(moves)
            climbing = [up for c in climbing if (up := self._step(c, moves, found)) is not None]

    def _step(
        self,
        best: Candidate,
        moves: Sequence[tuple[Candidate, str, Structure]],
        found: Sequence[Candidate],
    ) -> Candidate | None:
        """The best of the moves from `best`, trained a little further; None if none gains."""
        own = [new for (c, _, _), new in zip(moves, found, strict=True) if c is best]
        better = [new for new in own if self._is_step(new, best)]
        if not better:
            return None
        new = self.simplest(better)
        return new if new.converged else self.continued([new], 30, [0])[0]

    # --- structures to try ------------------------------------------------------------------------

    def _likely(self) -> list[Structure]:
        """Sizes near the linear order, with every output function that the data suggest."""
        nk, task = self.linear.nk, self.task
        hidden = (4, 8) if task.hidden is None else (task.hidden,)
        orders = self._orders() if task.nx is None else [task.nx]
        all_ = [
            Structure(nx, nk, h, self.decay, output)
            for output in self._outputs()
            for nx in orders
            for h in hidden
        ]
        if self.nk > nk:
            # a delay can mimic an order and vice versa: try both
            order = self.linear.choice.order
            all_ += [replace(s, nk=self.nk) for s in all_ if s.nx == order]
        affordable = [s for s in all_ if self.is_affordable(s)]
        if not affordable and None in (task.nx, task.hidden):
            least = Structure(task.nx or 1, nk, task.hidden or 2, self.decay)
            affordable = [least] if self.is_affordable(least) else []
        return affordable

    def _orders(self) -> list[int]:
        """The first four orders, the best linear one, and their neighbours."""
        if not self.linear.eligible:
            return [2, 3]
        order, best = self.linear.choice.order, self.linear.best.order
        likely = (order, best, 2, order + 1, best + 1, 3)
        return [nx for nx in dict.fromkeys(likely) if nx <= MOST_NX][:4]

    @property
    def nk(self) -> int:
        """The delay of the chosen linear model."""
        return self.linear.choice.nk if self.linear.eligible else self.linear.nk

    def _outputs(self) -> list[Output]:
        data = self.trials[0].fitted
        if self.task.output is not None:
            return [named(self.task.output, data)]
        return [o for o in suggested(data) if o != ABS or self._is_rectified()]

    def _is_rectified(self) -> bool:
        """Whether a linear model with a rectified output is better than any without."""
        plain = [c.models[0] for c in self.linear.eligible if c.order <= 2]
        return is_rectified(self.start(2, self.nk, ABS), arrays(self.trials[0].fitted), plain)

    def _integrating(self) -> list[Structure]:
        """Small networks followed by an integrator, if a linear pole is nearly 1."""
        if self.task.nx is not None or self.task.output not in (None, "linear"):
            return []
        if not self.linear.eligible:
            return []
        orders: tuple[int, ...] = (2, 3)
        likely: tuple[int, ...] = (1, 2) if self.repeats else (1, 2, 4, 8)
        if not self.linear.integrates(self.task.data, self.diagnosis):
            # linear models miss the integrator of a drive that friction holds most of the time
            if self.linear.best.rmse < SAYS_LITTLE * self._deviation:
                return []
            orders, likely = (2,), (4,)
        sizes = likely if self.task.hidden is None else (self.task.hidden,)
        structures = (
            Structure(nx, self.linear.nk, h, self.decay, integrator=True)
            for nx in orders
            for h in sizes
        )
        return [s for s in structures if self.is_affordable(s)]

    @property
    def _deviation(self) -> float:
        """Standard deviation of the held-out output."""
        held = [e.y for e in self.trials[0].held.experiments]
        return float(np.nanstd(np.concatenate(held)))

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Properties of the record that decide what can be identified from it."""
        return diagnose(self.task.data)

    @property
    def is_diagnosed(self) -> bool:
        """Whether `diagnosis` is known already."""
        return "diagnosis" in self.__dict__

    @property
    def repeats(self) -> bool:
        """Whether the record repeats one trajectory, so that held-out data were seen before."""
        return self.diagnosis.find("repeats") is not None

    def _lagged(self) -> list[Structure]:
        """The lagged network of second order; its weight decay has a different meaning."""
        task = self.task
        if task.nx is not None or task.output not in (None, "linear"):
            return []
        s = Structure(2, self.nk, task.hidden or 8, 1e-4, kind="neural_oe")
        return [s] if s.nk >= 1 and self.is_affordable(s) else []

    def _moves(self, best: Candidate, is_first: bool) -> list[tuple[str, Structure]]:
        s, task = best.structure, self.task
        if s.kind == "neural_oe":
            return [("fresh", replace(s, hidden=2 * s.hidden)), ("fresh", replace(s, nx=s.nx + 1))]
        moves: list[tuple[str, Structure]] = []
        if s.integrator and self.repeats:
            return []
        most = MOST_HIDDEN_SMALL if len(self.trials[0].fitted) < 5_000 else MOST_HIDDEN
        wider = task.hidden is None and 2 * s.hidden <= most
        taller = task.nx is None and s.nx < MOST_NX
        if wider:
            moves.append(("grow", replace(s, hidden=2 * s.hidden)))
        if taller:
            moves.append(("grow", replace(s, nx=s.nx + 1)))
            if wider:
                moves.append(("grow", replace(s, nx=s.nx + 1, hidden=2 * s.hidden)))
        if self.samples < DECAY_MATTERS:
            moves += [("decay", decayed(s, f)) for f in (100.0, 0.01)]
        if is_first and task.nk is None and not s.integrator:
            later, at_once = replace(s, nk=s.nk + 1), replace(s, nk=0)
            moves += [("fresh", later)]
            moves += [("fresh", at_once)] if task.data.counts is None and s.nk == 1 else []
        return [
            (name, s)
            for name, s in moves
            if LEAST_DECAY <= s.decay <= MOST_DECAY and self.is_affordable(s)
        ]

    def _moved(self, moves: Sequence[tuple[Candidate, str, Structure]]) -> list[Candidate]:
        """All moves of one round, trained side by side."""
        requests: list[Request] = []
        iterations: list[int] = []
        for best, kind, s in moves:
            if kind == "grow":
                models = [
                    m.grown(s.nx, s.hidden, self.task.seed)
                    for m in best.models[:3]
                    if isinstance(m, _core.NeuralSS)
                ]
                requests.append(self.request(s, CLIMB_ITERATIONS, initial=models))
                iterations.append(best.iterations + CLIMB_ITERATIONS)
            elif kind == "decay":
                requests.append(self.request(s, 30, initial=best.models[:4]))
                iterations.append(best.iterations + 30)
            else:
                count = 30 if self.is_large else 60
                starts = self._limited(2)
                requests.append(self.request(s, count, starts=starts))
                iterations.append(count)
        found = self.trained(requests)
        return [
            self.judged(s, starts, count)
            for (_, _, s), starts, count in zip(moves, found, iterations, strict=True)
        ]

    def _is_step(self, found: Candidate, best: Candidate) -> bool:
        worth = WORTH_A_STEP
        if found.structure.nk == 0 and best.structure.nk > 0:
            worth *= WORTH_A_FEEDTHROUGH
        if best.is_sound and not found.is_sound:
            return False
        ratio, deviation = compared(found.errors, best.errors)
        if found.error < worth * best.error:
            return True
        # near the noise even a useful step gains little; on much data ever wider networks would
        # keep gaining in this way
        is_cheap = not self.is_large or found.structure.hidden <= best.structure.hidden
        is_small_step = worth == WORTH_A_STEP and is_cheap
        return is_small_step and ratio < -max(2.0 * deviation, LEAST_STEP)


def decayed(s: Structure, factor: float) -> Structure:
    """The structure with its weight decay multiplied by a factor."""
    return replace(s, decay=float(f"{s.decay * factor:.0e}"))
