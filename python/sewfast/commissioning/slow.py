"""Loads over a turn of the shaft; slow drives, of which every k-th sample is enough."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..control.controller import Controller, pid_of
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
# command that would have had the same effect, and is put back where loops are simulated. Behind a
# gear the load turns with the output shaft: how often in a turn of the encoder's is told from the
# line that it leaves in what is unexplained, drawn over the angle.


HARMONICS = 6
"""Of a turn that are told apart."""
WORTH_IT = 0.97
"""The load must bring what is unexplained on a recording that it was not taken from below this."""
SLOW = 0.5
"""Span of the moving mean that is taken away before [s], for a load on the encoder's shaft."""
SLOW_TURNS = 2.0
"""The same in turns of a load behind a gear."""
LEAST_TURNS = 8.0
"""Of a load in the recordings that it is taken from: fewer cannot be told from friction."""
GEARED = 0.95
"""Largest turns of a load in one of the encoder's shaft that count as behind a gear."""
BIWEIGHT, REWEIGHTED = 4.685, 5
"""Deviations at which a sample counts for nothing, the usual number; rounds of it."""
CELLS = 32
"""Of a turn of the encoder's shaft, by which a line is looked for: a load turns less often."""
REFINED = 15
"""Ratios that are tried between two of those that the record can tell apart."""


@dataclass(frozen=True, eq=False)
class TurnLoad:
    """A command [V] over the angle: `sum_k a_k cos(k theta) + b_k sin(k theta)`.

    Attributes
    ----------
    cosine, sine : array, shape (HARMONICS,)
        [V]
    ratio : float
        Turns of the load in one of the encoder's shaft: below 1 behind a gear.
    """

    cosine: FloatArray
    sine: FloatArray
    ratio: float = 1.0

    def at(self, turns: FloatArray) -> FloatArray:
        """The command [V] at these angles of the encoder's shaft [turns]."""
        command: FloatArray = basis(self.ratio * turns) @ np.concatenate([self.cosine, self.sine])
        return command

    def along(self, r: FloatArray, Ts: float) -> FloatArray:
        """The command [V] of a machine that follows a reference [RPM], from angle 0."""
        return self.at(np.concatenate([[0.0], np.cumsum(r[:-1])]) * Ts / 60.0)

    @property
    def rms(self) -> float:
        """Over a turn [V]."""
        return float(np.sqrt(0.5 * (self.cosine @ self.cosine + self.sine @ self.sine)))


def basis(turns: FloatArray, harmonics: int = HARMONICS) -> FloatArray:
    """Cosines, then sines, of the harmonics of these angles; shape (N, 2 harmonics)."""
    angles = 2.0 * np.pi * turns[:, None] * np.arange(1, harmonics + 1)
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
    try:
        known = [_Unexplained.of(ensemble, r, k) for r in learned]
        other = _Unexplained.of(ensemble, judge, k)
    except FitError:
        return None
    best, gained = None, 0.0
    for ratio in (1.0, *_behind_a_gear(plant, known)):
        span = max(u.span(ratio) for u in known)
        pairs = [u.parts(plant, ratio, span) for u in known]
        rows, rest = np.vstack([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])
        solution = _robust(rows, rest)
        row, rest = other.parts(plant, ratio, span)
        before, after = float(np.mean(rest**2)), float(np.mean((rest - row @ solution) ** 2))
        if after < WORTH_IT**2 * before and before - after > gained:
            best = TurnLoad(solution[:HARMONICS], solution[HARMONICS:], ratio)
            gained = before - after
    return best


@dataclass(frozen=True, eq=False)
class _Unexplained:
    """What models leave of a recording's speed, with the angle at every sample of the machine."""

    rest: FloatArray
    turns: FloatArray
    Ts: float
    thinning: Thinning

    @classmethod
    def of(cls, ensemble: Ensemble, whole: Recording, k: int) -> _Unexplained:
        """Of the median's free run.

        Raises
        ------
        FitError
            Where a member runs away.
        """
        thinning = Thinning(k)
        recording = thinning.recording(whole)
        runs = [m.simulate(recording.dataset(), init=0)[0] for m in ensemble.members]
        turns = (whole.counts - whole.counts[0]) / whole.counts_per_rev
        return cls(recording.y - np.median(runs, axis=0), turns, recording.Ts, thinning)

    def span(self, ratio: float) -> float:
        """Of the moving mean that is taken away [s]: friction that changes with warmth is no load
        over the turn, but what a slow output shaft does is.
        """
        rate = float(self.turns[-1]) / (len(self.rest) * self.Ts)
        return max(SLOW, SLOW_TURNS / max(ratio * rate, 1e-9)) if ratio < 1.0 else SLOW

    def parts(
        self, plant: Model, ratio: float, span: float, harmonics: int = HARMONICS
    ) -> tuple[FloatArray, FloatArray]:
        """What each harmonic would do to the speed, and what is unexplained [RPM]; both without
        what is slow.
        """
        core, zero = plant.core, np.zeros(plant.core.na)
        still = core.simulate(np.zeros((len(self.rest), 1)), zero)
        waves = basis(ratio * self.turns, harmonics).T
        pushes = [np.ascontiguousarray(self.thinning.mean(c)[:, None]) for c in waves]
        slow = max(3, round(span / self.Ts))
        columns = [_fast(core.simulate(push, zero) - still, slow) for push in pushes]
        return np.column_stack(columns), _fast(self.rest, slow)


def _robust(rows: FloatArray, rest: FloatArray) -> FloatArray:
    """Least squares with Tukey's biweight (Huber and Ronchetti, Robust Statistics, 2009, ch. 4).

    What a model misses at a current limit is many times what the load does, and no wave over the
    angle. With all samples alike, drive `weak` had 9.3 V of load by its linear model, where it has
    .12; so it has .18. Of nine drives, what is unexplained on the random levels falls to .82
    (median; .69 to 1.15) of that before.
    """
    weight: FloatArray = np.ones(len(rest))
    for _ in range(1 + REWEIGHTED):
        found, *_ = np.linalg.lstsq(weight[:, None] * rows, weight * rest, rcond=1e-6)
        error = rest - rows @ found
        reach = BIWEIGHT * float(np.median(np.abs(error))) / 0.6745
        weight = np.maximum(1.0 - (error / max(reach, 1e-12)) ** 2, 0.0)
    return np.asarray(found, np.float64)


def _behind_a_gear(plant: Model, known: Sequence[_Unexplained]) -> list[float]:
    """Turns of a load in one of the encoder's shaft, where a line says so: one at most.

    The line is looked for on the longest recording over the angle, and its place is refined by how
    much of what is unexplained the load would explain: over hundreds of turns a ratio that is off
    by a thousandth has come out of step.
    """
    longest = max(known, key=lambda u: len(u.rest))
    total = float(longest.turns[-1])
    if total * GEARED <= LEAST_TURNS:
        return []
    step = 0.5 / total
    turns = longest.turns[:: longest.thinning.k][: len(longest.rest)]
    rest = _fast(longest.rest, max(3, round(longest.span(LEAST_TURNS / total) / longest.Ts)))
    lowest, end = math.ceil(2.0 * LEAST_TURNS), math.ceil(2.0 * GEARED * total)
    first = step * (lowest + int(np.argmax(_lines(turns, rest, total)[lowest:end])))
    near = first + np.linspace(-step, step, REFINED)
    return [float(near[int(np.argmin([_left(plant, longest, ratio) for ratio in near]))])]


def _lines(turns: FloatArray, rest: FloatArray, total: float) -> FloatArray:
    """Power of what swings 0, 1, 2, .. times in twice the total of turns.

    One transform of what falls into each cell of angle, where a sum over all samples for each of
    thousands of ratios took four seconds of a slow drive's commissioning.
    """
    cells = math.ceil(CELLS * total)
    at = np.rint(turns * (cells / total)).astype(int) % (2 * cells)
    powers: FloatArray = np.abs(np.fft.rfft(np.bincount(at, rest, 2 * cells))) ** 2
    return powers


def _left(plant: Model, known: _Unexplained, ratio: float) -> float:
    """What a load with this ratio, of one harmonic, leaves unexplained."""
    rows, rest = known.parts(plant, ratio, known.span(ratio), 1)
    solution, *_ = np.linalg.lstsq(rows, rest, rcond=1e-6)
    return float(np.mean((rest - rows @ solution) ** 2) / max(float(np.mean(rest**2)), 1e-30))


def _fast(x: FloatArray, span: int) -> FloatArray:
    """Without the moving mean over a span, which is shorter at the ends."""
    total, k = np.concatenate([[0.0], np.cumsum(x)]), np.arange(len(x))
    begin, end = np.maximum(k - span // 2, 0), np.minimum(k - span // 2 + span, len(x))
    mean: FloatArray = (total[end] - total[begin]) / (end - begin)
    return x - mean


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
        controller = self.coarse(pid_of(found.controller, "commission"))
        return ClosedLoopRun(
            **kept, controller=controller, plant=found.plant, reference=found.reference
        )


def _derivative_filter(c: Controller, longer: float) -> float:
    """`N` of a derivative filter whose time constant is so much longer [s]."""
    Td = c.gains.to("standard").Td
    if Td <= 0.0:
        return c.N
    return Td / max(Td / c.N + longer, Td / SHARPEST)
