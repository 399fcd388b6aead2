"""Loads over a turn of the shaft; slow drives, of which every k-th sample is enough."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun
from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble, Model
from ..recording import Recording
from ..rules import Fopdt
from ..speed import speed_from_counts
from ..tuning.objective import Cost
from .small_signal import SmallSignal

# --- What a turn does: the load over the angle, which no model of command and speed holds ---------
#
# Cams, cranks, an eccentric load and cogging push at the same angles turn after turn. What the
# first closed loops leave unexplained is taken apart over the angle that the encoder shows, as a
# command that would have had the same effect, and is put back where loops are simulated.


HARMONICS = 6
"""Of a turn that are told apart."""
WORTH_IT = 0.97
"""The load must bring what is unexplained on a recording that it was not taken from below this."""
SLOW = 0.5
"""Span of the moving mean that is taken away before [s]."""


@dataclass(frozen=True, eq=False)
class TurnLoad:
    """A command [V] over the angle: `sum_k a_k cos(k theta) + b_k sin(k theta)`.

    Attributes
    ----------
    cosine, sine : array, shape (HARMONICS,)
        [V]
    """

    cosine: FloatArray
    sine: FloatArray

    def at(self, turns: FloatArray) -> FloatArray:
        """The command [V] at these angles [turns]."""
        command: FloatArray = basis(turns) @ np.concatenate([self.cosine, self.sine])
        return command

    def along(self, r: FloatArray, Ts: float) -> FloatArray:
        """The command [V] of a machine that follows a reference [RPM], from angle 0."""
        return self.at(np.concatenate([[0.0], np.cumsum(r[:-1])]) * Ts / 60.0)

    @property
    def rms(self) -> float:
        """Over a turn [V]."""
        return float(np.sqrt(0.5 * (self.cosine @ self.cosine + self.sine @ self.sine)))


def basis(turns: FloatArray) -> FloatArray:
    """Cosines, then sines, of the harmonics of these angles; shape (N, 2 HARMONICS)."""
    angles = 2.0 * np.pi * turns[:, None] * np.arange(1, HARMONICS + 1)
    return np.hstack([np.cos(angles), np.sin(angles)])


def turn_load(
    ensemble: Ensemble,
    plant: Model,
    learned: Sequence[Recording],
    judge: Recording,
    k: int = 1,
) -> TurnLoad | None:
    """The load over the turn, where a recording that it was not taken from shows it too.

    Parameters
    ----------
    ensemble : Ensemble
        Its median's free run is what is explained.
    plant : Model
        From command to speed about a working speed: what a push does.
    learned, judge : Recordings
        To take it from, and to ask whether it is there.
    k : int
        Samples of the recordings in one of the models.
    """
    rows, rests = [], []
    for recording in learned:
        row, rest = _explained(ensemble, plant, recording, k)
        rows.append(row)
        rests.append(rest)
    solution, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(rests), rcond=1e-6)
    found = TurnLoad(solution[:HARMONICS], solution[HARMONICS:])
    row, rest = _explained(ensemble, plant, judge, k)
    left = rest - row @ solution
    return found if np.mean(left**2) < WORTH_IT**2 * np.mean(rest**2) else None


def _explained(
    ensemble: Ensemble, plant: Model, whole: Recording, k: int
) -> tuple[FloatArray, FloatArray]:
    """What each harmonic would do to the speed, and what the models leave unexplained [RPM].

    Both without what is slower than a few turns: friction that changes with warmth is no load over
    the turn.
    """
    thinning = Thinning(k)
    recording = thinning.recording(whole)
    turns = (whole.counts - whole.counts[0]) / whole.counts_per_rev
    core, zero = plant.core, np.zeros(plant.core.na)
    still = core.simulate(np.zeros((len(recording), 1)), zero)
    pushes = [np.ascontiguousarray(thinning.mean(c)[:, None]) for c in basis(turns).T]
    columns = [core.simulate(push, zero) - still for push in pushes]
    try:
        runs = np.array([m.simulate(recording.dataset(), init=0)[0] for m in ensemble.members])
    except FitError:
        return np.zeros((1, 2 * HARMONICS)), np.zeros(1)
    rest = recording.y - np.median(runs, axis=0)
    slow = max(3, round(SLOW / recording.Ts))
    rows = np.column_stack([_fast(c, slow) for c in columns])
    return rows, _fast(rest, slow)


def _fast(x: FloatArray, span: int) -> FloatArray:
    kernel = np.ones(span) / span
    weight = np.convolve(np.ones(len(x)), kernel, "same")
    return x - np.convolve(x, kernel, "same") / weight


# --- Slow drives: training and tuning on every k-th sample, so that effort follows the dynamics ---
#
# A drive whose time constant is ten times longer takes ten times more samples for the same content,
# and its poles come so close to 1 that networks are hard to train. So all that is simulated runs on
# every k-th sample, k in proportion to the time constant. The machine is always run at its own
# sample time: gains in standard form are in seconds, and so is the feedback's filter.


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
