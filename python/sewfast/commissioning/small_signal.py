"""Small signals about a working speed: how fast the machine answers, and whether a shaft swings.

A step response says little of the first milliseconds and nothing of a resonance: friction, load and
the current limit are in it. A small random command about a held speed shows the linear dynamics
that a controller's gains meet, delay, electrical pole and shaft, within a few seconds.

A load over the turn swings, too, and behind a gear slower than the shaft that the encoder sees. It
is told from a resonance by its frequency at two speeds: that of a load moves with the speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import _core
from ..control.machine import Machine
from ..dataset import Dataset, FloatArray
from ..errors import DataError, FitError
from ..identification.folds import Errors, Split, compared, errors_of, folds, free_runs
from ..identification.task import arrays, wrap
from ..models import LinearOE, Model
from ..recording import Recording
from ..rules import Fopdt, fit_fopdt
from .demands import Demands
from .excitations import Motion

SHAKEN_AT = 0.5
"""Of the top speed, at which the machine is shaken."""
FASTER = 0.8
"""Of the top speed, at which it is shaken again where something swings."""
NEAR = 0.1
"""How far from its place a frequency is looked for, in shares of it: the levels lie further apart,
so that one that stays and one that moves with the speed are told apart."""
CLEAR = 4.0
"""Times the power at the place where a resonance would be, and of the surroundings, of a load."""
TWICE = 2.0
"""Swings in a record, at the least: fewer cannot be told from a drift."""
SHARE, MOST = 0.1, 60.0
"""Of what is unexplained, that a line must be to be asked about; its largest frequency [Hz]."""
BESIDE = (0.4, 0.8), (1.25, 1.8)
"""Surroundings of a line, in shares of its frequency."""
LOADS = 4
"""Of the turn, at the most, that are taken out one after the other."""
SIZE = 0.1
"""Of the largest command: small against what friction and the current limit bend."""
SAMPLES, LONGEST = 4_000, 12.0
"""Samples that are shaken; not longer than that [s]."""
HOLD = 2
"""Samples that each random value is held: power up to a quarter of the sample rate."""
ITERATIONS = 60
ORDERS = (1, 2, 3, 4, 5)
LEAST_GAIN = math.log(1.005)
"""A difference in error that counts as none, however well it is known."""
SWINGS = 0.3
"""Damping ratio below which a pair of poles is a resonance."""
LOWEST, HIGHEST = 2.0, 0.4
"""Frequencies looked at: from so many Hz to that share of the sample rate."""
LEAST_FIT = 90.0
"""Percent at which the model's own step response is one of first order with dead time."""


@dataclass(frozen=True)
class Resonance:
    """A pair of lightly damped poles.

    Attributes
    ----------
    frequency : float
        Undamped [Hz].
    damping : float
        Ratio.
    """

    frequency: float
    damping: float

    def __str__(self) -> str:
        return f"a resonance near {self.frequency:.3g} Hz (damping ratio {self.damping:.2g})"


@dataclass(frozen=True, eq=False)
class SmallSignal:
    """The machine about a working speed.

    Attributes
    ----------
    model : Model
        Command [V] to speed [RPM], of the simplest order that explains the record.
    resonance : Resonance or None
        The least damped one.
    fopdt : Fopdt or None
        The model's step response as first order with dead time; None where it is none.
    """

    model: Model
    resonance: Resonance | None
    fopdt: Fopdt | None


def small_signal(
    bench: Machine, demands: Demands, motion: Motion, fopdt: Fopdt
) -> SmallSignal | None:
    """Shake the machine about half its top speed; None where that shows nothing.

    Where a pair of poles swings, or a line stands out from what a first order leaves unexplained,
    it is shaken at a higher speed as well. What has moved in proportion with the speed is a load
    over the turn: it is taken out, and no resonance.
    """
    u, settled = shaking(demands, motion, fopdt, bench.Ts, SHAKEN_AT)
    slow = Shaken.of(bench.excite(u, "small_signals"), settled)
    found = explained(slow, fopdt)
    if found is None or not _suspects(found.model, slow):
        return found
    u, settled = shaking(demands, motion, fopdt, bench.Ts, FASTER)
    fast = Shaken.of(bench.excite(u, "small_signals_faster"), settled)
    for _ in range(LOADS):
        loads = [turns_of(f, slow, fast) for f in _suspects(found.model, slow)]
        taken = [ratio for ratio in loads if ratio is not None]
        if not taken:
            break
        slow, fast = slow.without(taken), fast.without(taken)
        again = explained(slow, fopdt)
        if again is None:
            break
        found = again
    return found


@dataclass(frozen=True, eq=False)
class Shaken:
    """The random part of a record.

    Attributes
    ----------
    u, speed : array, shape (N,)
        [V, RPM], the latter as counted.
    turns : array, shape (N,)
        Of the shaft that the encoder sees.
    Ts : float
        [s]
    name : str
    """

    u: FloatArray
    speed: FloatArray
    turns: FloatArray
    Ts: float
    name: str

    @classmethod
    def of(cls, recording: Recording, settled: int) -> Shaken:
        """From the sample on from which the command is random."""
        counts, per = recording.counts, 60.0 / (recording.counts_per_rev * recording.Ts)
        speed = np.diff(counts, prepend=counts[0]) * per
        turns = (counts[settled:] - counts[settled]) / recording.counts_per_rev
        return cls(recording.u[settled:], speed[settled:], turns, recording.Ts, recording.name)

    @property
    def seconds(self) -> float:
        return len(self.u) * self.Ts

    @property
    def rate(self) -> float:
        """Mean speed [turns/s]."""
        return float(self.turns[-1] - self.turns[0]) / self.seconds

    def dataset(self) -> Dataset:
        """For fits."""
        return Dataset.from_arrays(
            self.u, self.speed, self.Ts, input_units="V", output_unit="RPM", name=self.name
        )

    def without(self, ratios: Sequence[float]) -> Shaken:
        """Without what swings so many times a turn, command and speed alike.

        A linear machine answers a sine with one of the same frequency: what is left of its speed
        is what is left of its command makes of it.
        """
        waves = [w for ratio in ratios for w in _waves(ratio * self.turns)]
        columns = np.column_stack([np.ones(len(self.u)), *waves])
        both = np.column_stack([self.u, self.speed])
        shares = np.linalg.lstsq(columns, both, rcond=None)[0]
        left = both - columns[:, 1:] @ shares[1:]
        return replace(self, u=left[:, 0].copy(), speed=left[:, 1].copy())


def shaking(
    demands: Demands, motion: Motion, fopdt: Fopdt, Ts: float, level: float
) -> tuple[FloatArray, int]:  # fmt: skip
    """The command [V] about a level of the top speed, and the sample from which it is random."""
    held = min(motion.command(level * demands.speed), (1.0 - SIZE) * demands.u_max)
    settle = max(1, round(min(4.0 * fopdt.T, LONGEST) / Ts))
    samples = int(min(SAMPLES, max(500, LONGEST / Ts)))
    size = SIZE * demands.u_max
    random = _core.prbs(
        duration=samples * Ts, Ts=Ts, low=held - size, high=held + size, hold=HOLD * Ts,
        seed=demands.seed,
    )  # fmt: skip
    return np.concatenate([np.full(settle, held), random]), settle


def explained(shaken: Shaken, fopdt: Fopdt) -> SmallSignal | None:
    """The simplest linear model of what was shaken."""
    data = shaken.dataset()
    part = folds(data)[0]
    tried = {order: fitted(part, order) for order in ORDERS}
    found = {order: fit for order, fit in tried.items() if fit is not None}
    if not found or not min(errors.rmse for _, errors in found.values()) < part.spread:
        return None
    order = simplest(found)
    core = found[order][0]
    model = wrap(LinearOE, core, data)
    resonance = _resonance(core, shaken.Ts)
    return SmallSignal(model, resonance, _first_order(core, shaken.Ts, fopdt))


def fitted(part: Split, order: int) -> tuple[_core.LinearModel, Errors] | None:
    """The better of output error and instrumental variables: a resonance makes local minima."""
    tried = []
    for fit in (_core.fit_oe, _core.fit_iv):
        try:
            model = fit(
                arrays(part.fitted), na=order, nb=order + 1, nk=1, max_iterations=ITERATIONS
            ).model
        except (DataError, FitError):
            continue
        tried.append((model, errors_of(free_runs(model, part), part)))
    return min(tried, key=lambda t: t[1].rmse, default=None)


def simplest(found: dict[int, tuple[_core.LinearModel, Errors]]) -> int:
    """The least order whose error is not credibly above the lowest."""
    best = min(found, key=lambda o: found[o][1].rmse)
    for order in sorted(found):
        ratio, deviation = compared(found[order][1], found[best][1])
        if ratio <= max(deviation, LEAST_GAIN):
            return order
    return best


def _resonance(core: _core.LinearModel, Ts: float) -> Resonance | None:
    """Of the lightly damped pairs of poles within the frequencies looked at, the highest peak."""
    poles = core.poles()[:, 0] + 1j * core.poles()[:, 1]
    found: list[tuple[float, Resonance]] = []
    for p in poles[poles.imag > 0.0]:
        s = np.log(p) / Ts
        resonance = Resonance(float(abs(s)) / (2.0 * math.pi), float(-s.real / abs(s)))
        is_seen = LOWEST <= resonance.frequency <= HIGHEST / Ts and resonance.damping < SWINGS
        # the pair's share of the response at its own frequency: its residue over its distance
        others = np.prod(p - poles[np.abs(poles - p) > 0.0])
        peak = abs(np.polyval(core.b[0], p) / others) / max(1.0 - abs(p), 1e-9)
        if is_seen:
            found.append((float(peak), resonance))
    return max(found, key=lambda f: f[0], default=(0.0, None))[1]


def _suspects(model: Model, shaken: Shaken) -> list[float]:
    """Frequencies that a load over the turn may have [Hz]: of poles that swing, and of the line."""
    line = _line(shaken)
    return [*_swinging(model, shaken), *([] if line is None else [line])]


def _line(shaken: Shaken) -> float | None:
    """The frequency at which most of what is unexplained is, where that is a line [Hz]."""
    rest = _unexplained(shaken)
    if rest is None:
        return None
    # over the angle: a load is a line there, also while the command shakes the speed
    per_turn = np.arange(TWICE, MOST * shaken.seconds, 0.25) / (shaken.seconds * shaken.rate)
    powers = np.array([_power(ratio * shaken.turns, rest) for ratio in per_turn])
    best = int(np.argmax(powers))
    is_line = 2.0 * powers[best] > SHARE * float(np.mean(rest**2))
    return float(per_turn[best] * shaken.rate) if is_line else None


def _swinging(model: Model, shaken: Shaken) -> list[float]:
    """Frequencies of the pairs of poles that swing, growing ones too [Hz]."""
    poles = model.core.poles()[:, 0] + 1j * model.core.poles()[:, 1]
    s = np.log(poles[poles.imag > 0.0]) / shaken.Ts
    frequencies = np.abs(s) / (2.0 * math.pi)
    is_seen = (frequencies * shaken.seconds > TWICE) & (frequencies < HIGHEST / shaken.Ts)
    found: list[float] = frequencies[is_seen & (-s.real < SWINGS * np.abs(s))].tolist()
    return found


def turns_of(frequency: float, slow: Shaken, fast: Shaken) -> float | None:
    """How many times a turn a load swings that was seen with a frequency [Hz] at the slow speed.

    None where the frequency has stayed at the fast one, or is not seen there at a place that
    moves with the speed: by the slow record alone nothing is taken for a load.
    """
    before, rest = _unexplained(slow), _unexplained(fast)
    if before is None or rest is None:
        return None
    near = frequency * np.linspace(1.0 - NEAR, 1.0 + NEAR, 41)
    ratios = near / slow.rate
    both = [_power(x * slow.turns, before) + _power(x * fast.turns, rest) for x in ratios]
    ratio = float(ratios[int(np.argmax(both))])
    t = np.arange(len(rest)) * fast.Ts
    stayed = max(_power(f * t, rest) for f in near)
    shares = np.concatenate([np.linspace(*BESIDE[0], 21), np.linspace(*BESIDE[1], 21)])
    beside = np.median([_power(ratio * share * fast.turns, rest) for share in shares])
    is_load = _power(ratio * fast.turns, rest) > CLEAR * max(stayed, float(beside))
    return ratio if is_load else None


def _unexplained(shaken: Shaken) -> FloatArray | None:
    """What a first order leaves of the speed: loads that the command has no part in, and shafts."""
    data = shaken.dataset()
    try:
        core = _core.fit_oe(arrays(data), na=1, nb=2, nk=1, max_iterations=ITERATIONS).model
    except (DataError, FitError):
        return None
    run = core.simulate(shaken.u[:, None], shaken.speed[: core.na])
    rest = shaken.speed - run
    k = np.arange(len(rest))
    rest = rest - np.polyval(np.polyfit(k, rest, 1), k)
    return rest if np.all(np.isfinite(rest)) else None


def _waves(turns: FloatArray) -> list[FloatArray]:
    return [np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)]


def _power(turns: FloatArray, rest: FloatArray) -> float:
    """Of what swings once a turn in a signal; twice that is its mean square."""
    return float(sum(np.mean(wave * rest) ** 2 for wave in _waves(turns)))


def _first_order(core: _core.LinearModel, Ts: float, recorded: Fopdt) -> Fopdt | None:
    """First order with dead time of the model's step response, over five recorded constants."""
    u = _core.step(duration=6.0 * recorded.T, Ts=Ts, at=0.5 * recorded.T, low=0.0, high=1.0)
    try:
        y = core.simulate(u[:, None], np.zeros(core.na)) - core.simulate(
            np.zeros((len(u), 1)), np.zeros(core.na)
        )
        found = fit_fopdt(u, y, Ts=Ts)
    except (DataError, FitError):
        return None
    return found if found.K > 0.0 and found.fit_percent >= LEAST_FIT else None
