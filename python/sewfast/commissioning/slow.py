"""Loads over a turn of the shaft; slow drives, for which every k-th sample is enough."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..control.controller import Controller, pid_of
from ..control.feedforward import Feedforward
from ..control.loop import ClosedLoopRun
from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble, Model
from ..recording import Recording
from ..rules import Fopdt
from ..speed import speed_from_counts
from ..tuning.objective import Cost
from .small_signal import SmallSignal

# --- The load over the angle, which a model from command to speed cannot contain ------------------
#
# Cams, cranks, an eccentric load and cogging push at the same angles turn after turn. The models'
# residual of the first closed loops is fitted over the encoder's angle, as a command that would
# have the same effect, and added in simulated loops. Behind a gear the load turns with the output
# shaft: the ratio is found from the line of the load in the residual's spectrum over the angle.


HARMONICS = 6
"""Harmonics of a turn that are fitted."""


@dataclass(frozen=True, eq=False)
class TurnLoad:
    """A command [V] over the angle: `sum_k a_k cos(k theta) + b_k sin(k theta)`. `cosine` and
    `sine` (HARMONICS,) are its coefficients [V]; `ratio` is the turns of the load per turn of the
    encoder's shaft, below 1 behind a gear.
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
        """Rms over a turn [V]."""
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
    """The load over the turn, if it also shows in a recording not used for the fit.
    It explains the residual of the median of the ensemble's free runs. `plant` is the response from
    command to speed about a working speed, `learned` are the recordings for the fit and `judge` the
    one to judge it by; `k` is the number of their samples per sample of the models.
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
        # largest ratio of the residuals with and without the load, on a recording not used for the
        # fit
        if after < 0.97**2 * before and before - after > gained:
            best = TurnLoad(solution[:HARMONICS], solution[HARMONICS:], ratio)
            gained = before - after
    return best


@dataclass(frozen=True, eq=False)
class _Unexplained:
    """The models' residual of a recording's speed, and the angle at every sample of the machine."""

    rest: FloatArray
    turns: FloatArray
    Ts: float
    thinning: Thinning

    @classmethod
    def of(cls, ensemble: Ensemble, whole: Recording, k: int) -> _Unexplained:
        """The residual of the median of the members' free runs; `FitError` if a member diverges."""
        thinning = Thinning(k)
        recording = thinning.recording(whole)
        runs = [m.simulate(recording.dataset(), init=0)[0] for m in ensemble.members]
        turns = (whole.counts - whole.counts[0]) / whole.counts_per_rev
        return cls(recording.y - np.median(runs, axis=0), turns, recording.Ts, thinning)

    def span(self, ratio: float) -> float:
        """Span of the mean to remove [s]: it takes warming friction, and leaves a slow load."""
        # span of the moving mean removed before the fit [s], for a load on the encoder's shaft
        slow = 0.5
        rate = float(self.turns[-1]) / (len(self.rest) * self.Ts)
        # behind a gear, two turns of the load
        return max(slow, 2.0 / max(ratio * rate, 1e-9)) if ratio < 1.0 else slow

    def parts(
        self, plant: Model, ratio: float, span: float, harmonics: int = HARMONICS
    ) -> tuple[FloatArray, FloatArray]:
        """Response of the speed to each harmonic, and the residual [RPM]; without slow parts."""
        core, zero = plant.core, np.zeros(plant.core.na)
        still = core.simulate(np.zeros((len(self.rest), 1)), zero)
        waves = basis(ratio * self.turns, harmonics).T
        pushes = [np.ascontiguousarray(self.thinning.mean(c)[:, None]) for c in waves]
        slow = max(3, round(span / self.Ts))
        columns = [_fast(core.simulate(push, zero) - still, slow) for push in pushes]
        return np.column_stack(columns), _fast(self.rest, slow)


def _robust(rows: FloatArray, rest: FloatArray) -> FloatArray:
    """Least squares with Tukey's biweight (Huber and Ronchetti, Robust Statistics, 2009, ch. 4).
    The error of a model at a current limit is many times the effect of the load, and not a wave
    over the angle. With equal weights, the linear model of drive `weak` gave 9.3 V of load instead
    of .12; with the biweight it gives .18. On nine drives, the residual on the random levels falls
    to .82 (median; .69 to 1.15) of that with equal weights.
    """
    # cut-off of the biweight in standard deviations, the usual value; rounds of reweighting
    biweight, reweighted = 4.685, 5
    weight: FloatArray = np.ones(len(rest))
    for _ in range(1 + reweighted):
        found, *_ = np.linalg.lstsq(weight[:, None] * rows, weight * rest, rcond=1e-6)
        error = rest - rows @ found
        reach = biweight * float(np.median(np.abs(error))) / 0.6745
        weight = np.maximum(1.0 - (error / max(reach, 1e-12)) ** 2, 0.0)
    return np.asarray(found, np.float64)


def _behind_a_gear(plant: Model, known: Sequence[_Unexplained]) -> list[float]:
    """Turns of a load per turn of the encoder's shaft, if a line shows one: a list of one at most.
    The line is searched in the spectrum over the angle of the longest recording, and its place is
    refined by the residual that the load would leave: over hundreds of turns, a ratio that is off
    by a thousandth gets out of phase.
    """
    # least turns of a load in the recordings: fewer cannot be distinguished from friction
    least_turns = 8.0
    # largest ratio (turns of the load per turn of the encoder) of a load behind a gear
    geared = 0.95
    longest = max(known, key=lambda u: len(u.rest))
    total = float(longest.turns[-1])
    if total * geared <= least_turns:
        return []
    step = 0.5 / total
    turns = longest.turns[:: longest.thinning.k][: len(longest.rest)]
    rest = _fast(longest.rest, max(3, round(longest.span(least_turns / total) / longest.Ts)))
    lowest, end = math.ceil(2.0 * least_turns), math.ceil(2.0 * geared * total)
    first = step * (lowest + int(np.argmax(_lines(turns, rest, total)[lowest:end])))
    # ratios tried within the resolution of the record
    near = first + np.linspace(-step, step, 15)
    return [float(near[int(np.argmin([_left(plant, longest, ratio) for ratio in near]))])]


def _lines(turns: FloatArray, rest: FloatArray, total: float) -> FloatArray:
    """Power of waves with 0, 1, 2, .. periods in twice the total of turns.
    This is one Fourier transform of sums over cells of angle; sums over all samples for each of
    thousands of ratios took four seconds of a slow drive's commissioning.
    """
    # cells per turn of the encoder's shaft in the search for a line; a load turns less often
    cells = math.ceil(32 * total)
    at = np.rint(turns * (cells / total)).astype(int) % (2 * cells)
    powers: FloatArray = np.abs(np.fft.rfft(np.bincount(at, rest, 2 * cells))) ** 2
    return powers


def _left(plant: Model, known: _Unexplained, ratio: float) -> float:
    """Share of the residual that remains with a load of this ratio, of one harmonic."""
    rows, rest = known.parts(plant, ratio, known.span(ratio), 1)
    solution, *_ = np.linalg.lstsq(rows, rest, rcond=1e-6)
    return float(np.mean((rest - rows @ solution) ** 2) / max(float(np.mean(rest**2)), 1e-30))


def _fast(x: FloatArray, span: int) -> FloatArray:
    """The signal less its moving mean over a span, which is shorter at the ends."""
    total, k = np.concatenate([[0.0], np.cumsum(x)]), np.arange(len(x))
    begin, end = np.maximum(k - span // 2, 0), np.minimum(k - span // 2 + span, len(x))
    mean: FloatArray = (total[end] - total[begin]) / (end - begin)
    return x - mean


# --- Slow drives: training and tuning on every k-th sample, so that effort follows the dynamics ---
#
# A drive with a ten times longer time constant needs ten times more samples for the same content,
# and its poles come so close to 1 that networks are hard to train. So all simulations run on every
# k-th sample, with k in proportion to the time constant. The machine always runs at its own sample
# time: gains in standard form are in seconds, and so is the feedback's filter.


PER_CONSTANT = 200
"""Samples kept per time constant: as many as the nominal machine has at 1 ms."""
MOST = 10
"""Largest k."""
SHARPEST = 50.0
"""Largest derivative filter N of the search; a coarse controller gets it if its sample time alone
filters more than its N."""


@dataclass(frozen=True)
class Thinning:
    """Every k-th sample; a `k` of 1 leaves everything as it is."""

    k: int = 1

    @classmethod
    def of(cls, fopdt: Fopdt, Ts: float, small: SmallSignal | None) -> Thinning:
        """The k for a drive's time constant; 1 with a resonance, which would alias."""
        if small is not None and small.resonance is not None:
            return cls()
        return cls(max(1, min(MOST, int(fopdt.T / (PER_CONSTANT * Ts) + 1e-9))))

    @classmethod
    def between(cls, coarse: float, fine: float) -> Thinning:
        """The k between two sample times [s]."""
        return cls(max(1, round(coarse / fine)))

    def recording(self, r: Recording) -> Recording:
        """The mean command over k samples (it may change at each), and the speed from every k-th
        count.
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
        """The load's command along references, averaged and not picked: harmonics would alias."""
        if load is None:
            return None
        return [self.mean(load.along(r, Ts)) for r in references.values()]

    def mean(self, u: FloatArray) -> FloatArray:
        """Means over each k samples, and over the remaining ones at the end."""
        if self.k == 1:
            return u
        begins = np.arange(0, len(u), self.k)
        sizes = np.diff(np.append(begins, len(u)))
        means: FloatArray = np.add.reduceat(u, begins) / sizes
        return means

    def coarse(self, c: Controller) -> Controller:
        """The controller at coarse samples; their counts are already means of k speeds."""
        if self.k == 1:
            return c
        return replace(
            c,
            Ts=self.k * c.Ts,
            filter_samples=max(1, round(c.filter_samples / self.k)),
            N=_derivative_filter(c, (1 - self.k) * c.Ts),
            feedforward=c.feedforward and self._coarse_lead(c.feedforward),
        )

    def _coarse_lead(self, lead: Feedforward) -> Feedforward:
        """What `_fine_lead` was made from."""
        preview = round((lead.preview + self._held) / self.k)
        return replace(lead, preview=preview, taps=lead.taps[:: self.k])

    def _fine_lead(self, lead: Feedforward) -> Feedforward:
        """The same command for the same change of the reference over k samples. A command that is
        held over k samples comes later by half of them, which the preview need not cover here.
        """
        preview = max(0, round(lead.preview * self.k - self._held))
        taps = [tap for tap in lead.taps for _ in range(self.k)]
        return replace(lead, preview=preview, taps=tuple(taps))

    @property
    def _held(self) -> float:
        """By how many samples a command that is held over k of them is later."""
        return (self.k - 1) / 2.0

    def fine(self, c: Controller) -> Controller:
        """The controller for the machine at its own sample time.
        A coarse sample time itself filters the derivative: a change is divided by the sum of Td / N
        and the sample time. At the machine's sample time, the same `N` would give k times the
        command for every count of the encoder.
        """
        if self.k == 1:
            return c
        Ts = c.Ts / self.k
        return replace(
            c,
            Ts=Ts,
            # longest moving average of the feedback [samples]
            filter_samples=min(64, self.k * c.filter_samples),
            N=_derivative_filter(c, c.Ts - Ts),
            feedforward=c.feedforward and self._fine_lead(c.feedforward),
        )

    def plant(self, fopdt: Fopdt, Ts: float) -> Fopdt:
        """First order with dead time in a loop at coarse samples; `Ts` [s] is the machine's.
        Holding the command and averaging the speed over k samples instead of one each add half of
        (k - 1) Ts to the dead time.
        """
        return fopdt if self.k == 1 else replace(fopdt, L=fopdt.L + (self.k - 1) * Ts)

    def variations(self) -> Sequence[tuple[float, int]] | None:
        """Gain and delay of the plants for tuning; None if the samples are not coarse."""
        return None if self.k == 1 else ((1.0, 0), (0.8, 0), (1.25, 0))

    def cost(self, cost: Cost) -> Cost:
        """The same cost for simulations.
        A command that follows the encoder's counts changes more from one coarse sample to the next
        than between the machine's samples: by the square root of k, as a random signal does. The
        measured ratio of fine to coarse change was .55 to .72 at k = 2, .19 to .34 at k = 10.
        """
        if self.k == 1 or cost.chatter is None:
            return cost
        return replace(cost, chatter=cost.chatter / math.sqrt(self.k))

    def run(self, found: ClosedLoopRun) -> ClosedLoopRun:
        """A run of the machine at the samples of the simulation, for comparison."""
        if self.k == 1:
            return found
        kept = {n: np.ascontiguousarray(x[:: self.k]) for n, x in found.columns().items()}
        controller = self.coarse(pid_of(found.controller, "commission"))
        return ClosedLoopRun(
            **kept, controller=controller, plant=found.plant, reference=found.reference
        )


def _derivative_filter(c: Controller, longer: float) -> float:
    """`N` of a derivative filter with a time constant longer by `longer` [s]."""
    Td = c.gains.to("standard").Td
    if Td <= 0.0:
        return c.N
    return Td / max(Td / c.N + longer, Td / SHARPEST)
