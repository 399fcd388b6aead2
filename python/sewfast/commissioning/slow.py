"""Slow drives: training and tuning on every k-th sample, so that effort follows the dynamics.

A drive whose time constant is ten times longer takes ten times more samples for the same content,
and its poles come so close to 1 that networks are hard to train. So all that is simulated runs on
every k-th sample, k in proportion to the time constant. The machine is always run at its own sample
time: gains in standard form are in seconds, and so is the feedback's filter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun
from ..dataset import FloatArray
from ..recording import Recording
from ..rules import Fopdt
from ..speed import speed_from_counts
from ..tuning.objective import Cost
from .small_signal import SmallSignal

if TYPE_CHECKING:
    from .turn import TurnLoad

PER_CONSTANT = 200
"""Samples of a time constant that are kept: as many as the nominal machine has at 1 ms."""
MOST = 10
"""Samples of which one is kept, at most."""
LONGEST_FILTER = 64
"""Of the feedback's moving average [samples]."""
SHARPEST = 50.0
"""Derivative filter N of a coarse controller whose own sample time filters more than it asks for;
the largest that is searched."""


@dataclass(frozen=True)
class Thinning:
    """Every k-th sample.

    Attributes
    ----------
    k : int
        1 leaves everything as it is.
    """

    k: int = 1

    @classmethod
    def of(cls, fopdt: Fopdt, Ts: float, small: SmallSignal | None) -> Thinning:
        """What a drive's time constant allows; a resonance is not to be folded into it."""
        if small is not None and small.resonance is not None:
            return cls()
        return cls(max(1, min(MOST, int(fopdt.T / (PER_CONSTANT * Ts) + 1e-9))))

    @classmethod
    def between(cls, coarse: float, fine: float) -> Thinning:
        """That between two sample times [s]."""
        return cls(max(1, round(coarse / fine)))

    def recording(self, r: Recording) -> Recording:
        """The mean command over k samples, and the speed from the counts that are left.

        A command that is picked instead of averaged would be another one than the machine saw: a
        closed loop's changes at every sample.
        """
        if self.k == 1:
            return r
        counts, Ts = np.ascontiguousarray(r.counts[:: self.k]), self.k * r.Ts
        y = speed_from_counts(counts, Ts, r.counts_per_rev, method="kalman")
        true = None if r.speed_true is None else np.ascontiguousarray(r.speed_true[:: self.k])
        return Recording(self.mean(r.u), counts, y, true, Ts, r.counts_per_rev, r.name)

    def references(self, fine: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """References at the coarse sample time."""
        return {name: np.ascontiguousarray(r[:: self.k]) for name, r in fine.items()}

    def pushes(
        self, load: TurnLoad | None, references: Mapping[str, FloatArray], Ts: float
    ) -> list[FloatArray] | None:
        """The load's command along references at the machine's sample time, thinned.

        Its harmonics lie beyond half of the coarse rate at high speeds: they are averaged, and not
        folded into slow ones.
        """
        if load is None:
            return None
        return [self.mean(load.along(r, Ts)) for r in references.values()]

    def mean(self, u: FloatArray) -> FloatArray:
        """Over each k samples; over those that are left at the end."""
        if self.k == 1:
            return u
        begins = np.arange(0, len(u), self.k)
        sizes = np.diff(np.append(begins, len(u)))
        means: FloatArray = np.add.reduceat(u, begins) / sizes
        return means

    def coarse(self, c: Controller) -> Controller:
        """The controller as it is simulated.

        The encoder's difference over k samples is the mean of k speeds.
        """
        if self.k == 1:
            return c
        return replace(
            c,
            Ts=self.k * c.Ts,
            filter_samples=max(1, round(c.filter_samples / self.k)),
            N=_derivative_filter(c, (1 - self.k) * c.Ts),
        )

    def fine(self, c: Controller) -> Controller:
        """The controller as the machine runs it.

        A coarse sample filters the derivative by itself: a change is divided by Td / N and the
        sample time. At the machine's sample time the same `N` would answer every count of the
        encoder with k times the command.
        """
        if self.k == 1:
            return c
        Ts = c.Ts / self.k
        return replace(
            c,
            Ts=Ts,
            filter_samples=min(LONGEST_FILTER, self.k * c.filter_samples),
            N=_derivative_filter(c, c.Ts - Ts),
        )

    def plant(self, fopdt: Fopdt, Ts: float) -> Fopdt:
        """First order with dead time as a loop at coarse samples sees it, `Ts` [s] the machine's.

        Its command is held, and its speed taken, over k samples instead of one: half of the rest
        each.
        """
        return fopdt if self.k == 1 else replace(fopdt, L=fopdt.L + (self.k - 1) * Ts)

    def variations(self) -> Sequence[tuple[float, int]] | None:
        """Gain and delay of the plants that are tuned on; None for the usual ones.

        The coarse sample time itself is more delay than the usual ones add.
        """
        return None if self.k == 1 else ((1.0, 0), (0.8, 0), (1.25, 0))

    def cost(self, cost: Cost) -> Cost:
        """The same cost of what is simulated.

        A command that follows the encoder's counts changes more from one coarse sample to the next
        than from one sample to the next: with the square root of k, as whatever is random does.
        Measured were .55 to .72 of the coarse change at k = 2, .19 to .34 at k = 10.
        """
        if self.k == 1 or cost.chatter is None:
            return cost
        return replace(cost, chatter=cost.chatter / math.sqrt(self.k))

    def run(self, found: ClosedLoopRun) -> ClosedLoopRun:
        """What the machine did, as it compares with what was simulated."""
        if self.k == 1:
            return found
        kept = {n: np.ascontiguousarray(x[:: self.k]) for n, x in found.columns().items()}
        controller = self.coarse(found.controller)
        return ClosedLoopRun(
            **kept, controller=controller, plant=found.plant, reference=found.reference
        )


def _derivative_filter(c: Controller, longer: float) -> float:
    """`N` of a derivative filter whose time constant is so much longer [s]."""
    Td = c.gains.to("standard").Td
    if Td <= 0.0:
        return c.N
    return Td / max(Td / c.N + longer, Td / SHARPEST)
