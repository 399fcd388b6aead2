"""Small signals about a working speed: linear dynamics, delay and resonance of the machine.

A step response shows little of the first milliseconds and nothing of a resonance, because friction,
load and current limit dominate it. A small random command about a held speed shows the linear
dynamics that matter for the gains (delay, electrical pole and shaft) within a few seconds.

A load over the turn oscillates, too, behind a gear even slower than the encoder's shaft. Two speeds
distinguish it from a resonance: the frequency of a load moves with the speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from .. import _core
from ..control.machine import Machine
from ..dataset import Dataset, FloatArray
from ..errors import DataError, FitError
from ..identification.folds import Errors, Split, compared, errors_of, free_runs, later_part
from ..identification.task import arrays, wrap
from ..models import LinearOE, Model
from ..recording import Recording
from ..rules import Fopdt, fit_fopdt
from .demands import OVER, Demands
from .excitations import Motion

SHAKEN_AT = 0.5
"""Working speed as a share of the top speed."""
NEAR = 0.1
"""Search range about a frequency, as a share of it. The two speeds lie further apart, so that fixed
frequencies and those that move with the speed stay separate."""
SAME = math.log(1.25)
"""Largest distance of a resonance's frequencies in two records, in logarithms: those of shafts were
within 1 % of each other, with play within 25 %."""
TWICE = 2.0
"""Least number of periods in a record: fewer cannot be distinguished from drift."""
BESIDE = (0.4, 0.8), (1.25, 1.8)
"""Surroundings of a line, as shares of its frequency."""
SIZE = 0.1
"""Largest amplitude as a share of the largest command: small enough for linear dynamics."""
SAMPLES, LONGEST = 4_000, 12.0
"""Samples of the random command, and its longest duration [s]."""
ITERATIONS = 60
ORDERS = (1, 2, 3, 4, 5)
LEAST_GAIN = math.log(1.005)
"""A smaller difference in (log) error does not count, however significant."""
SWINGS = 0.3
"""Damping ratio below which a pair of poles is a resonance."""
LOWEST, HIGHEST = 2.0, 0.4
"""Range of resonances: least frequency [Hz], largest as a share of the sample rate."""


@dataclass(frozen=True)
class Resonance:
    """Lightly damped poles: the undamped `frequency` [Hz] and the `damping` ratio."""

    frequency: float
    damping: float

    def __str__(self) -> str:
        return f"a resonance near {self.frequency:.3g} Hz (damping ratio {self.damping:.2g})"


@dataclass(frozen=True, eq=False)
class SmallSignal:
    """The machine about a working speed. `model`, from command [V] to speed [RPM], has the simplest
    order that explains the record; `resonance` is the one with the highest peak; `fopdt` is the
    model's step response as first order with dead time, None if that does not fit.
    """

    model: Model
    resonance: Resonance | None
    fopdt: Fopdt | None


def small_signal(
    machine: Machine, demands: Demands, motion: Motion, fopdt: Fopdt
) -> SmallSignal | None:
    """Excite the machine about half its top speed; None if the record shows no dynamics.
    If a pair of poles is lightly damped, or a line stands out from the residual of a first order,
    the machine is also excited at a higher speed. A frequency that has moved in proportion with the
    speed is a load over the turn and not a resonance: it is removed. A resonance shows at both.
    """
    u, settled = shaking(demands, motion, fopdt, machine.Ts, SHAKEN_AT)
    slow = Shaken.of(machine.excite(u, "small_signals"), settled)
    found = explained(slow, fopdt)
    if found is None or not _suspects(found.model, slow):
        return found
    # second working speed, used if something oscillates, as a share of the top speed
    u, settled = shaking(demands, motion, fopdt, machine.Ts, 0.8)
    fast = Shaken.of(machine.excite(u, "small_signals_faster"), settled)
    # most rounds of removing loads over the turn
    for _ in range(4):
        loads = [turns_of(f, slow, fast) for f in _suspects(found.model, slow)]
        taken = [ratio for ratio in loads if ratio is not None]
        if not taken:
            break
        slow, fast = slow.without(taken), fast.without(taken)
        again = explained(slow, fopdt)
        if again is None:
            break
        found = again
    if found.resonance is None or _is_seen(found.resonance, fast, fopdt):
        return found
    return explained(slow, fopdt, swings=False) or replace(found, resonance=None)


def _is_seen(resonance: Resonance, shaken: Shaken, fopdt: Fopdt) -> bool:
    """Whether another record shows it: noise and a delay can pass for one, at any frequency."""
    other = explained(shaken, fopdt)
    if other is None or other.resonance is None:
        return False
    return abs(math.log(other.resonance.frequency / resonance.frequency)) < SAME


@dataclass(frozen=True, eq=False)
class Shaken:
    """The random part of a record: (N,) arrays of the command `u` [V], the `speed` by differences
    of counts [RPM] and the angle `turns` of the encoder's shaft [turns]; `Ts` is in seconds.
    """

    u: FloatArray
    speed: FloatArray
    turns: FloatArray
    Ts: float
    name: str

    @classmethod
    def of(cls, recording: Recording, settled: int) -> Shaken:
        """The part of a recording from sample `settled`, at which the random command begins."""
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
        return Dataset.from_arrays(
            self.u, self.speed, self.Ts, input_units="V", output_unit="RPM", name=self.name
        )

    def without(self, ratios: Sequence[float]) -> Shaken:
        """With the waves of these frequencies per turn removed from both command and speed.
        A linear machine answers a sine with a sine of the same frequency, so the rest of the speed
        is still the response to the rest of the command.
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
    """The command [V] about a share of the top speed, and the sample at which it becomes random."""
    # a slow machine was still speeding up in its first motion, so that this asks too much of it
    most = (OVER * level * demands.speed - fopdt.offset) / fopdt.K
    held = min(motion.command(level * demands.speed), most, (1.0 - SIZE) * demands.u_max)
    settle = max(1, round(min(4.0 * fopdt.T, LONGEST) / Ts))
    samples = int(min(SAMPLES, max(500, LONGEST / Ts)))
    # even if it were held, it would not take the machine beyond its top
    size = min(SIZE * demands.u_max, (demands.top - level * demands.speed) / fopdt.K)
    # samples that each random value is held: power up to a quarter of the sample rate
    random = _core.prbs(
        duration=samples * Ts, Ts=Ts, low=held - size, high=held + size, hold=2 * Ts,
        seed=demands.seed,
    )  # fmt: skip
    return np.concatenate([np.full(settle, held), random]), settle


def explained(shaken: Shaken, fopdt: Fopdt, *, swings: bool = True) -> SmallSignal | None:
    """The simplest linear model of a record; of those without a resonance unless it `swings`."""
    data = shaken.dataset()
    part, smooth = later_part(data), _smooth(shaken)
    if part is None:
        return None
    tried = {order: fitted(part, order, smooth) for order in ORDERS}
    found = {
        order: fit
        for order, fit in tried.items()
        if fit is not None and (swings or _resonance(fit[0], shaken.Ts) is None)
    }
    if not found or not min(errors.rmse for _, errors in found.values()) < part.spread:
        return None
    order = simplest(found)
    core = found[order][0]
    model = wrap(LinearOE, core, data)
    resonance = _resonance(core, shaken.Ts)
    return SmallSignal(model, resonance, _first_order(core, shaken.Ts, fopdt))


def fitted(
    part: Split, order: int, smooth: Dataset | None = None
) -> tuple[_core.LinearModel, Errors] | None:
    """The best of output error and instrumental variables, as a resonance causes local minima.
    Output error also begins at what instrumental variables find in the `smooth` record: their own
    beginning, a model of low order by least squares, is blind to a resonance below the noise.
    """

    def by(fit: Callable[..., Any], record: Dataset, **options: Any) -> _core.LinearModel:
        found = fit(
            arrays(record), na=order, nb=order + 1, nk=1, max_iterations=ITERATIONS, **options
        )
        if found.termination == "interrupted":  # the core has heard Ctrl-C and kept its best
            raise KeyboardInterrupt
        model: _core.LinearModel = found.model
        return model

    fits = [partial(by, _core.fit_oe), partial(by, _core.fit_iv)]
    if smooth is not None:
        with suppress(DataError, FitError):
            fits.append(partial(by, _core.fit_oe, initial=by(_core.fit_iv, smooth)))
    tried = []
    for fit in fits:
        try:
            model = fit(part.fitted)
        except (DataError, FitError):
            continue
        tried.append((model, errors_of(free_runs(model, part), part)))
    return min(tried, key=lambda t: t[1].rmse, default=None)


def _smooth(shaken: Shaken) -> Dataset | None:
    """The record with a high-order model's free run, almost noiseless, as speed (Wahlberg 1989,
    IEEE Trans. Automatic Control 34).
    """
    # order of the model that smooths the record
    many = 20
    try:
        core = _core.fit_arx(arrays(shaken.dataset()), na=many, nb=many, nk=1, offset=True)
    except (DataError, FitError):
        return None
    speed = core.simulate(shaken.u[:, None], shaken.speed[:many])
    # an unstable one of the many poles
    return replace(shaken, speed=speed).dataset() if np.isfinite(speed).all() else None


def simplest(found: dict[int, tuple[_core.LinearModel, Errors]]) -> int:
    """The least order whose error is not credibly above the lowest."""
    best = min(found, key=lambda o: found[o][1].rmse)
    for order in sorted(found):
        ratio, deviation = compared(found[order][1], found[best][1])
        if ratio <= max(deviation, LEAST_GAIN):
            return order
    return best


def _resonance(core: _core.LinearModel, Ts: float) -> Resonance | None:
    """The lightly damped pair of poles with the highest peak within the range of frequencies."""
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
    """Possible frequencies of a load over the turn [Hz]: of lightly damped poles, and of a line."""
    line = _line(shaken)
    return [*_swinging(model, shaken), *([] if line is None else [line])]


def _line(shaken: Shaken) -> float | None:
    """The frequency with the most power in the residual, if it is a spectral line [Hz]."""
    # least share of a spectral line in the residual for a second look; its largest frequency [Hz]
    share, most = 0.1, 60.0
    rest = _unexplained(shaken)
    if rest is None:
        return None
    # over the angle, a load is a line even while the command varies the speed
    per_turn = np.arange(TWICE, most * shaken.seconds, 0.25) / (shaken.seconds * shaken.rate)
    powers = np.array([_power(ratio * shaken.turns, rest) for ratio in per_turn])
    best = int(np.argmax(powers))
    is_line = 2.0 * powers[best] > share * float(np.mean(rest**2))
    return float(per_turn[best] * shaken.rate) if is_line else None


def _swinging(model: Model, shaken: Shaken) -> list[float]:
    """Frequencies of the lightly damped or unstable pairs of poles [Hz]."""
    poles = model.core.poles()[:, 0] + 1j * model.core.poles()[:, 1]
    s = np.log(poles[poles.imag > 0.0]) / shaken.Ts
    frequencies = np.abs(s) / (2.0 * math.pi)
    is_seen = (frequencies * shaken.seconds > TWICE) & (frequencies < HIGHEST / shaken.Ts)
    found: list[float] = frequencies[is_seen & (-s.real < SWINGS * np.abs(s))].tolist()
    return found


def turns_of(frequency: float, slow: Shaken, fast: Shaken) -> float | None:
    """Periods per turn of a load that was seen at a frequency [Hz] at the slow speed.
    None if the frequency is the same at the fast speed, or if nothing there has moved with the
    speed: the slow record alone does not prove a load.
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
    # least power of a load over the power at the place of a resonance, and over its surroundings
    is_load = _power(ratio * fast.turns, rest) > 4.0 * max(stayed, float(beside))
    return ratio if is_load else None


def _unexplained(shaken: Shaken) -> FloatArray | None:
    """The residual of a first-order fit to the speed: loads, and dynamics of the shaft."""
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
    """Power of the wave of one period per turn in a signal; twice that is its mean square."""
    return float(sum(np.mean(wave * rest) ** 2 for wave in _waves(turns)))


def _first_order(core: _core.LinearModel, Ts: float, recorded: Fopdt) -> Fopdt | None:
    """Fit of first order with dead time to the model's step response over five time constants."""
    u = _core.step(duration=6.0 * recorded.T, Ts=Ts, at=0.5 * recorded.T, low=0.0, high=1.0)
    try:
        y = core.simulate(u[:, None], np.zeros(core.na)) - core.simulate(
            np.zeros((len(u), 1)), np.zeros(core.na)
        )
        found = fit_fopdt(u, y, Ts=Ts)
    except (DataError, FitError):
        return None
    # least fit of first order with dead time to the model's own step response [%]
    return found if found.K > 0.0 and found.fit_percent >= 90.0 else None
