"""Records that deceive, and good ones that look as odd: for tests and `make nonsense`.

Rules were made on seeds below `HELD`; from there on plants, inputs and lengths are others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sewfast.dataset import Dataset

HELD = 100
"""First seed of the records on which nothing was chosen."""
Columns = tuple[np.ndarray, np.ndarray]
Random = np.random.Generator


# --- Inputs and plants ----------------------------------------------------------------------------


def held(random: Random, n: int, levels: int, hold: int) -> np.ndarray:
    """Random levels, each held for `hold` samples to three times as long."""
    choice = np.linspace(-5.0, 5.0, levels)
    lengths = random.integers(hold, 3 * hold, n // hold + 1)
    return np.repeat(random.choice(choice, len(lengths)), lengths)[:n]


def sweep(random: Random, n: int) -> np.ndarray:
    t = np.arange(n) / n
    return 5.0 * np.sin(2.0 * np.pi * n * (t / 400.0 + random.uniform(0.01, 0.02) * t**2))


INPUTS: dict[str, Callable[[Random, int], np.ndarray]] = {
    "prbs": lambda random, n: held(random, n, 2, 15),
    "steps": lambda random, n: held(random, n, 41, 40),
    "sweep": sweep,
    "levels": lambda random, n: held(random, n, 6, 25),
}


def lag(u: np.ndarray, pole: float = 0.95, gain: float = 100.0, delay: int = 1) -> np.ndarray:
    y = np.zeros(len(u))
    for k in range(delay, len(u)):
        y[k] = pole * y[k - 1] + gain * (1.0 - pole) * u[k - delay]
    return y


def swings(u: np.ndarray, turn: float = 60.0, damping: float = 0.97) -> np.ndarray:
    """A second order, with a turn of so many samples."""
    a, b, y = 2.0 * damping * np.cos(2.0 * np.pi / turn), -(damping**2), np.zeros(len(u))
    for k in range(2, len(u)):
        y[k] = a * y[k - 1] + b * y[k - 2] + 100.0 * (1.0 - a - b) * u[k - 1]
    return y


def sticks(u: np.ndarray, friction: float = 1.0, pole: float = 0.96) -> np.ndarray:
    """A drive that dry friction holds at commands up to `friction`."""
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        moved = pole * y[k - 1] + 100.0 * (1.0 - pole) * u[k - 1]
        y[k] = moved - np.sign(moved) * min(abs(moved), 100.0 * (1.0 - pole) * friction)
    return y


RULES: list[Callable[[np.ndarray], np.ndarray]] = [lag, swings]
OTHERS: list[Callable[[np.ndarray], np.ndarray]] = [
    lambda u: lag(u, 0.88, -40.0, 5),
    lambda u: swings(u, 35.0, 0.93),
    lambda u: sticks(u, 0.4),
    lambda u: 0.5 * lag(lag(u, 0.9, 1.0), 0.97),
]


def noisy(y: np.ndarray, share: float, random: Random) -> np.ndarray:
    return y + share * y.std() * random.normal(size=len(y))


def plain(
    seed: int, inputs: tuple[str, ...] = tuple(INPUTS)
) -> tuple[np.ndarray, np.ndarray, Random]:
    """A good record, and the source of what spoils it."""
    random = np.random.default_rng(seed)
    plants, lengths = (RULES, (3000, 5000)) if seed < HELD else (OTHERS, (2500, 4000, 9000))
    plant = plants[random.integers(len(plants))]
    u = INPUTS[random.choice(inputs)](random, int(random.choice(lengths)))
    return u, noisy(plant(u), random.choice([0.0, 0.01, 0.05, 0.3]), random), random


# --- Records that deceive -------------------------------------------------------------------------


@dataclass(frozen=True)
class Nonsense:
    """How a record is spoilt, and the faults of which one names it; none if none can."""

    of: Callable[[np.ndarray, np.ndarray, Random], Columns]
    named: tuple[str, ...] = ()
    moves: tuple[str, ...] = tuple(INPUTS)


def part(y: np.ndarray, random: Random) -> int:
    """Where a record changes."""
    return int(random.uniform(0.3, 0.7) * len(y))


def from_there(
    y: np.ndarray, random: Random, change: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    k = part(y, random)
    return np.concatenate([y[:k], change(y[k:])])


def lost(y: np.ndarray, random: Random) -> np.ndarray:
    """Without some rows from one on."""
    k, rows = part(y, random), int(random.integers(40, 400))
    return np.concatenate([y[:k], y[k + rows :]])


def torn(u: np.ndarray, y: np.ndarray) -> Columns:
    n = min(len(u), len(y))
    return u[:n], y[:n]


def wrapped(y: np.ndarray, bits: int) -> np.ndarray:
    half = 2.0 ** (bits - 1)
    return (np.floor(y) + half) % (2.0 * half) - half


def frozen(y: np.ndarray, random: Random, value: float | None) -> np.ndarray:
    k, length, y = part(y, random), len(y) // 3, y.copy()
    y[k : k + length] = y[k] if value is None else value
    return y


def struck(y: np.ndarray, random: Random, value: float, count: int = 1) -> np.ndarray:
    k, y = part(y, random), y.copy()
    y[k : k + count] = value
    return y


def other_input(u: np.ndarray, y: np.ndarray, random: Random) -> Columns:
    return random.permutation(INPUTS["levels"](random, len(u))), y


def mean_of(u: np.ndarray, n: int) -> np.ndarray:
    return np.convolve(u, np.full(n, 1.0 / n))[: len(u)]


HOLDS = ("prbs", "steps", "levels")
_COMPUTED = ("no_dynamics",)
_CHANGED = ("changes",)
NONSENSE: dict[str, Nonsense] = {
    "noise": Nonsense(lambda u, y, r: (u, 100.0 * r.normal(size=len(u)))),
    "random walk": Nonsense(lambda u, y, r: (u, np.cumsum(r.normal(size=len(u))))),
    "constant output": Nonsense(lambda u, y, r: (u, np.full(len(u), 5.0))),
    "constant input": Nonsense(lambda u, y, r: (np.full(len(u), 3.0), y)),
    "time as output": Nonsense(lambda u, y, r: (u, 0.001 * np.arange(len(u)))),
    "unrelated sine": Nonsense(lambda u, y, r: (u, 50.0 * np.sin(np.arange(len(u)) / 50.0))),
    "mains hum": Nonsense(
        lambda u, y, r: (u, 50.0 * np.sin(0.314 * np.arange(len(u))) + r.normal(size=len(u)))
    ),
    "another machine's input": Nonsense(other_input),
    "shuffled": Nonsense(lambda u, y, r: (u, r.permutation(y))),
    "reversed": Nonsense(lambda u, y, r: (u, y[::-1].copy())),
    "three levels": Nonsense(lambda u, y, r: (u, np.round(y / (2.0 * y.std())) * 2.0 * y.std())),
    "tiny": Nonsense(lambda u, y, r: (1e-300 * u, 1e-300 * y)),
    # columns
    "input read twice": Nonsense(lambda u, y, r: (u, u.copy()), _COMPUTED),
    "y = 100 u": Nonsense(lambda u, y, r: (u, 100.0 * u), _COMPUTED),
    "echo of the command": Nonsense(
        lambda u, y, r: (u[3:], np.round(-0.25 * u, 3)[:-3]), _COMPUTED, HOLDS
    ),
    "difference of u": Nonsense(lambda u, y, r: (u, np.diff(u, prepend=u[0])), _COMPUTED, HOLDS),
    "sum of u": Nonsense(lambda u, y, r: (u, np.cumsum(u)), _COMPUTED, HOLDS),
    "trapezoids of u": Nonsense(
        lambda u, y, r: (u, 0.005 * np.cumsum(u + np.append(0.0, u[:-1]))), _COMPUTED, HOLDS
    ),
    "mean of u": Nonsense(lambda u, y, r: (u, mean_of(u, 5)), _COMPUTED, HOLDS),
    "mean of u, printed": Nonsense(
        lambda u, y, r: (u, np.round(mean_of(u, 8), 5)), _COMPUTED, HOLDS
    ),
    "square of u": Nonsense(lambda u, y, r: (u, u**2 + 3.0 * u), _COMPUTED),
    "exchanged": Nonsense(lambda u, y, r: (y, u), ("exchanged",)),
    "output leads": Nonsense(lambda u, y, r: (u[:-6], y[6:]), ("late_input", "at_once"), HOLDS),
    # values
    "frozen third": Nonsense(lambda u, y, r: (u, frozen(y, r, None)), ("dead_sensor",)),
    "dead third": Nonsense(lambda u, y, r: (u, frozen(y, r, 0.0)), ("dead_sensor",)),
    "cable off, with noise": Nonsense(
        lambda u, y, r: (u, from_there(y, r, lambda z: 0.02 * y.std() * r.normal(size=len(z)))),
        _CHANGED,
    ),
    "one 1e12": Nonsense(lambda u, y, r: (u, struck(y, r, 1e12)), ("spike",)),
    "one -32768": Nonsense(
        lambda u, y, r: (u, struck(y, r, -32768.0 * max(1.0, y.std() / 100.0))), ("spike",)
    ),
    "three 65535": Nonsense(
        lambda u, y, r: (u, struck(y, r, 65535.0 * max(1.0, y.std() / 100.0), 3)), ("spike",)
    ),
    "position of 16 bits": Nonsense(
        lambda u, y, r: (u, wrapped(np.cumsum(10.0 * y + 20.0 * y.std()), 16)), ("wraps",)
    ),
    "speed of 8 bits": Nonsense(lambda u, y, r: (u, wrapped(300.0 * y / y.std(), 8)), ()),
    "speed of 16 bits": Nonsense(lambda u, y, r: (u, wrapped(20000.0 * y / y.std(), 16)), ()),
    # changes midway
    "sign of the output turns": Nonsense(
        lambda u, y, r: (u, from_there(y, r, lambda z: -z)), _CHANGED
    ),
    "sign of the input turns": Nonsense(
        lambda u, y, r: (from_there(u, r, lambda z: -z), y), _CHANGED
    ),
    "output times 10": Nonsense(
        lambda u, y, r: (u, from_there(y, r, lambda z: 10.0 * z)), _CHANGED
    ),
    "output in rad/s": Nonsense(
        lambda u, y, r: (u, from_there(y, r, lambda z: z * np.pi / 30.0)), _CHANGED
    ),
    "input in other units": Nonsense(
        lambda u, y, r: (from_there(u, r, lambda z: 3.0 * z), y), _CHANGED
    ),
    "output lost rows": Nonsense(lambda u, y, r: torn(u, lost(y, r)), _CHANGED),
    "input lost rows": Nonsense(lambda u, y, r: torn(lost(u, r), y), _CHANGED),
    "output stuffed with rows": Nonsense(
        lambda u, y, r: (u, from_there(y, r, lambda z: np.roll(z, 150))), _CHANGED
    ),
    "two files glued": Nonsense(
        lambda u, y, r: (
            np.concatenate([u, u[::-1]]),
            np.concatenate([y, -2.0 * plain_again(u[::-1], r)]),
        ),
        (),
    ),
}


def plain_again(u: np.ndarray, random: Random) -> np.ndarray:
    """Another plant's answer."""
    return noisy(lag(u, 0.9, 60.0), 0.02, random)


def nonsense(kind: str, seed: int) -> Columns:
    """The columns of a record that deceives; each kind has plants of its own."""
    own = 1000 * list(NONSENSE).index(kind) + seed if seed >= HELD else seed
    return NONSENSE[kind].of(*plain(own, NONSENSE[kind].moves))


# --- Good records ---------------------------------------------------------------------------------


def backlash(x: np.ndarray, play: float) -> np.ndarray:
    y = np.zeros(len(x))
    for k in range(1, len(x)):
        y[k] = min(max(y[k - 1], x[k] - play), x[k] + play)
    return y


def _closed(random: Random, n: int) -> Columns:
    u, y, r = np.zeros(n), np.zeros(n), 60.0 * held(random, n, 9, 60)
    noise = 3.0 * random.normal(size=n)
    for k in range(1, n):
        y[k] = 0.95 * y[k - 1] + 5.0 * u[k - 1]
        u[k] = 0.03 * (r[k] - y[k] - noise[k])
    return u, y + noise


def _thermostat(random: Random, n: int) -> Columns:
    u, y, now, on = np.zeros(n), np.zeros(n), 20.0, 1.0
    for k in range(n):
        level = 40.0 if k < n // 2 else 42.0
        on = float(now < level) if k % 20 == 0 else on
        u[k], y[k] = 100.0 * on, now
        now += (20.0 + 0.5 * u[k] - now) * 0.002
    return u, y + 0.05 * random.normal(size=n)


def _loaded(random: Random, n: int) -> Columns:
    u = held(random, n, 41, 40)
    load = np.where(np.arange(n) < n // 2, 0.0, 1.5)
    return u, noisy(lag(u - load), 0.02, random)


def _grows(random: Random, n: int) -> Columns:
    """Small motion first, large motion later, over friction."""
    u = held(random, n, 21, 30) * np.where(np.arange(n) < n // 2, 0.4, 2.0)
    return u, noisy(sticks(u, 0.8), 0.01, random)


def _warms(random: Random, n: int) -> Columns:
    u = held(random, n, 21, 30)
    return u, noisy(lag(u) * np.linspace(1.0, 0.8, n), 0.02, random)


def _clipped(random: Random, n: int) -> Columns:
    u = held(random, n, 21, 30)
    return u, noisy(np.clip(lag(u), -250.0, 250.0), 0.01, random)


def _stops(random: Random, n: int) -> Columns:
    u = held(random, n, 21, 30)
    u[int(0.6 * n) :] = 0.0
    return u, noisy(lag(u), 0.01, random)


def _resonates(random: Random, n: int) -> Columns:
    """A sweep through a light resonance, on one or two masses."""
    turn, t = random.uniform(12.0, 60.0), np.arange(n) / n
    low, high = random.uniform(0.02, 0.3) / turn, min(random.uniform(1.5, 5.0) / turn, 0.3)
    growth = np.log(high / low)
    turns = (
        low * (np.exp(growth * t) - 1.0) / growth
        if random.random() < 0.5
        else low * t + (high - low) * t**2 / 2.0
    )
    u = 5.0 * np.sin(2.0 * np.pi * (n * turns + random.random()))
    y = swings(u, turn, random.choice([0.97, 0.985, 0.995]))
    y = lag(y, random.uniform(0.9, 0.99), 1.0) if random.random() < 0.5 else y
    return u, noisy(y, random.choice([0.0, 0.01, 0.05]), random)


def _on(
    kind: str, of: Callable[[np.ndarray], np.ndarray], noise: float
) -> Callable[[Random, int], Columns]:
    def columns(random: Random, n: int) -> Columns:
        u = INPUTS[kind](random, n)
        return u, noisy(of(u), noise, random)

    return columns


GOOD: dict[str, Callable[[Random, int], Columns]] = {
    "lag, prbs": _on("prbs", lag, 0.02),
    "lag, steps": _on("steps", lag, 0.02),
    "lag, sweep": _on("sweep", lag, 0.02),
    "lag, levels, no noise": _on("levels", lag, 0.0),
    "noise of 30 %": _on("steps", lag, 0.3),
    "noise of 30 %, prbs": _on("prbs", swings, 0.3),
    "swings": _on("steps", swings, 0.02),
    "swings, sweep": _on("sweep", swings, 0.02),
    "level at rest": _on("levels", lambda u: 293.15 + 0.2 * lag(u), 0.01),
    "position": _on("steps", lambda u: 0.01 * np.cumsum(lag(u, 0.9)), 0.001),
    "position, prbs": _on("prbs", lambda u: 0.01 * np.cumsum(lag(u, 0.9)), 0.001),
    "backlash": _on("sweep", lambda u: backlash(lag(u), 60.0), 0.01),
    "slow oven": _on("steps", lambda u: 22.0 + lag(u + 5.0, 0.999, 20.0, 8), 0.01),
    "friction": _on("sweep", lambda u: sticks(u, 1.5), 0.02),
    "dead zone": _on("steps", lambda u: lag(np.sign(u) * np.maximum(np.abs(u) - 2.0, 0.0)), 0.02),
    "dead time": _on("steps", lambda u: lag(u, 0.95, 100.0, 60), 0.05),
    "square of the input": _on("steps", lambda u: lag(u * np.abs(u)), 0.02),
    "fast": _on("prbs", lambda u: lag(u, 0.2), 0.02),
    "fast, no noise": _on("levels", lambda u: lag(u, 0.2), 0.0),
    "coarse encoder": _on("levels", lambda u: np.round(lag(u) / 20.0) * 20.0, 0.0),
    "clipped": _clipped,
    "closed loop": _closed,
    "thermostat": _thermostat,
    "load in the second half": _loaded,
    "small, then large": _grows,
    "warms": _warms,
    "rests last": _stops,
    "sweep through a resonance": _resonates,
}


def good(kind: str, seed: int) -> Columns:
    """The columns of a good record."""
    random = np.random.default_rng(seed)
    return GOOD[kind](random, 3000 if seed < HELD else int(random.choice([2500, 6000])))


def data(columns: Columns) -> Dataset:
    """As a data set of 1 ms."""
    return Dataset.from_arrays(*columns, 0.001, input_units="V", output_unit="RPM")
