"""Families of simulated systems: `make(family, seed)` draws a system and its records.

Each seed gives another system: time constants, gains, friction, orders, signal to noise and length
are drawn within the ranges that the family states. Outputs of test records are free of noise. Their
excitation is of the training's kind unless the family says otherwise, inputs are within the range
of the training's, and outputs leave it by little.

Rules of the search may be made on the families of RULES. Those of HELD are only run for the record:
nothing is decided on them. Each half has a motor with friction, an integrator (a position), a chain
of blocks, a linear truth, small records and large ones.

    RULES  first_order_encoder, prbs_drift, dead_time, motor_friction, drive_limit, angle,
           position_periodic, hammerstein, wiener_hammerstein, tanks, duffing, backlash, two_inputs
    HELD   second_order_encoder, two_mass, three_inputs, motor_loop, slow_drive, position, wiener,
           hammerstein_wiener, bouc_wen, bilinear, gain_scheduled
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from sewfast import Dataset

from . import simulators as sim
from .simulators import Excitation, FloatArray

Rng: TypeAlias = np.random.Generator
Split: TypeAlias = Literal["rules", "held"]


@dataclass(frozen=True, eq=False)
class Record:
    """One recording; `before` are the inputs that led up to it from rest, which no model sees."""

    u: FloatArray
    y: FloatArray
    before: FloatArray


@dataclass(frozen=True, eq=False)
class Truth:
    """The structure that made the data, with the parameters it had.

    Parameters
    ----------
    run : callable(theta, u) -> y
        Free run from rest, (N,) or (N, n_inputs) to (N,).
    theta : array, shape (p,)
    kinked : bool
        The error has kinks in the parameters (backlash), so a refit should not rely on derivatives.
    """

    run: Callable[[FloatArray, FloatArray], FloatArray]
    theta: FloatArray
    kinked: bool = False

    def simulate(self, record: Record, theta: FloatArray | None = None) -> FloatArray:
        """Noise-free output over a record."""
        u = np.concatenate([record.before, record.u])
        return self.run(self.theta if theta is None else theta, u)[len(record.before) :]


@dataclass(frozen=True, eq=False)
class Case:
    """One system of a family.

    Attributes
    ----------
    train, test : tuple of Record
        Test outputs are free of noise.
    Ts : float
        Sample time [s].
    n : int
        The first outputs of a test record, which set the initial state; they are not scored.
    is_linear : bool
        The truth is linear (perhaps with an offset).
    noise : float
        Root mean square of training output minus the truth's free run from the same input.
    gain_probe : array or None
        Two constant inputs, one after the other, each held until a motor has settled: the steady
        gain is the difference of the last outputs over that of the inputs. None: not a motor.
    """

    family: str
    seed: int
    train: tuple[Record, ...]
    test: tuple[Record, ...]
    Ts: float
    n: int
    is_linear: bool
    truth: Truth
    noise: float
    gain_probe: FloatArray | None = None

    @property
    def training(self) -> Dataset:
        """What `identify` gets."""
        return Dataset.concat(self.dataset(r.u, r.y) for r in self.train)

    def dataset(self, u: FloatArray, y: FloatArray | None) -> Dataset:
        """A record of this case as a data set."""
        return Dataset.from_arrays(u, y, self.Ts, name=f"{self.family}/{self.seed}")

    @property
    def samples(self) -> int:
        """To learn from."""
        return sum(len(r.y) for r in self.train)


@dataclass(frozen=True)
class Family:
    """How to draw a case; what its function draws is in the docstring."""

    name: str
    split: Split
    draw: Callable[[Rng], System]
    is_linear: bool = False
    quick: bool = False


@dataclass(frozen=True, eq=False)
class System:
    """What a family draws; `gain_levels` are two inputs and the samples to hold each."""

    truth: Truth
    train: Sequence[Record]
    test: Sequence[Record]
    Ts: float = 0.001
    gain_levels: tuple[float, float, int] | None = None
    inputs: int = 1


FAMILIES: dict[str, Family] = {}


def family(
    split: Split, *, linear: bool = False, quick: bool = False
) -> Callable[[Callable[[Rng], System]], Callable[[Rng], System]]:
    """Enter a function that draws a system; `quick`: small and cheap, for tests and QUICK=1."""

    def entered(draw: Callable[[Rng], System]) -> Callable[[Rng], System]:
        name = draw.__name__
        FAMILIES[name] = Family(name, split, draw, linear, quick)
        return draw

    return entered


def make(name: str, seed: int) -> Case:
    """The case of a family with this seed; the same one on every machine."""
    entry = FAMILIES[name]
    drawn = entry.draw(np.random.default_rng([seed, zlib.crc32(name.encode())]))
    residuals = [r.y - drawn.truth.simulate(r) for r in drawn.train]
    samples = sum(len(r.y) for r in drawn.train)
    return Case(
        name,
        seed,
        tuple(drawn.train),
        tuple(drawn.test),
        drawn.Ts,
        20 if samples < 2000 else 50,
        entry.is_linear,
        drawn.truth,
        rms(np.concatenate(residuals)),
        _probe(drawn),
    )


def rms(x: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


# --- drawing --------------------------------------------------------------------------------------


def _probe(drawn: System) -> FloatArray | None:
    if drawn.gain_levels is None:
        return None
    low, high, hold = drawn.gain_levels
    u = np.repeat([low, high], hold)
    # further inputs (a brake) rest
    return u if drawn.inputs == 1 else np.column_stack([u, np.zeros((len(u), drawn.inputs - 1))])


def _log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _size(rng: Rng, low: int, high: int) -> int:
    """A number of samples, in hundreds."""
    return int(round(_log(rng, low, high), -2))


def _period(rng: Rng) -> float:
    """A sample time [s]: a label, for all else is counted in samples."""
    return float(rng.choice([0.001, 0.002, 0.005, 0.01, 0.02]))


def _record(truth: Truth, u: FloatArray, lead: int = 0) -> Record:
    """The noise-free record of an input, of which the first `lead` samples are cut off."""
    before = u[:lead]
    return Record(u[lead:], truth.run(truth.theta, u)[lead:], before)


def _with_noise(rng: Rng, record: Record, decibels: float) -> Record:
    """White noise, this far below the output's standard deviation."""
    sd = record.y.std() * 10 ** (-decibels / 20)
    return Record(record.u, record.y + sd * rng.normal(size=len(record.y)), record.before)


def _with_encoder(rng: Rng, record: Record, decibels: float) -> Record:
    """A speed by differences of whole counts, as coarse as to give this signal to noise.

    The output is the mean speed between two samples, so counting adds noise and no delay: the
    difference of two errors that are evenly spread over a count.
    """
    count = record.y.std() * 10 ** (-decibels / 20) * math.sqrt(6)
    place = np.floor(np.cumsum(record.y) / count + rng.random())
    y = count * np.diff(place, prepend=np.floor(rng.random()))
    y[0] = record.y[0]
    return Record(record.u, y, record.before)


def _within(train: Record, draw: Callable[[], Record]) -> Record:
    """A test record whose output leaves the training's range by a tenth of it at most: the first
    of 20 that does, else the nearest. What goes beyond the data is another question.
    """
    low, high = train.y.min(), train.y.max()
    best, least = None, math.inf
    for _ in range(20):
        record = draw()
        beyond = max(record.y.max() - high, low - record.y.min()) / (high - low)
        if beyond < least:
            best, least = record, beyond
        if least <= 0.1:
            break
    assert best is not None
    return best


def _unseen(
    truth: Truth, train: Record, draw: Callable[[], FloatArray], lead: int = 0
) -> Record:  # fmt: skip
    """The test record of inputs drawn and kept within the range of the training's."""
    low, high = train.u.min(axis=0), train.u.max(axis=0)
    return _within(train, lambda: _record(truth, np.clip(draw(), low, high), lead))


def _pair(
    rng: Rng, truth: Truth, signal: Excitation, N: int, tested: int, decibels: float, lead: int = 0
) -> tuple[list[Record], list[Record]]:
    """A noisy training record and a test record of the same kind, a little inside its range."""
    train = _with_noise(rng, _record(truth, signal(rng, N + lead), lead), decibels)
    return [train], [_unseen(truth, train, lambda: signal(rng, tested + lead, inside=0.95), lead)]


def _linear(b: FloatArray, a: FloatArray, offset: float | None = None) -> Truth:
    """A transfer function; leading zeros of b are a delay and no parameters."""
    delay = int(np.flatnonzero(b)[0])
    nb, na = len(b) - delay, len(a)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(delay), theta[:nb]])
        y = sim.filtered(num, theta[nb : nb + na], u)
        return y if offset is None else y + theta[-1]

    tail = [] if offset is None else [offset]
    return Truth(run, np.concatenate([b[delay:], a, tail]))


def _signed(rng: Rng) -> tuple[float, float]:
    """A range of input: both signs, or one."""
    top = _log(rng, 0.5, 24)
    return (-top, top) if rng.random() < 0.6 else (0.1 * top, top)


def _gain_levels(low: float, high: float, tau: float) -> tuple[float, float, int]:
    """From a quarter to three quarters of the largest input."""
    start = max(low, 0.0)
    return start + 0.25 * (high - start), start + 0.75 * (high - start), int(20 * tau)


# --- linear truths --------------------------------------------------------------------------------


@family("rules", linear=True, quick=True)
def first_order_encoder(rng: Rng) -> System:
    """First order, tau 8 to 120; speed from encoder counts, 20 to 40 dB; 600 to 3,000 samples;
    steps, levels or a multisine."""
    tau, (low, high) = _log(rng, 8, 120), _signed(rng)
    truth = _linear(*sim.lags(_log(rng, 5, 500), tau))
    signal = Excitation(str(rng.choice(["steps", "levels", "multisine"])), low, high, tau)
    N, lead = _size(rng, 600, 3000), int(3 * tau)
    train = _record(truth, signal(rng, N + lead), lead)
    test = _unseen(truth, train, lambda: signal(rng, N + lead, inside=0.95), lead)
    noisy = _with_encoder(rng, train, rng.uniform(20, 40))
    return System(truth, [noisy], [test], _period(rng), _gain_levels(low, high, tau))


@family("held", linear=True, quick=True)
def second_order_encoder(rng: Rng) -> System:
    """Second order, two lags of 15 to 100 and 3 to 10 or an oscillation of period 25 to 200 and
    damping .3 to .9; encoder, 20 to 40 dB; 800 to 6,000 samples; steps, levels, multisine, chirp.
    """
    (low, high), gain = _signed(rng), _log(rng, 5, 500)
    if rng.random() < 0.5:
        tau = _log(rng, 15, 100)
        truth = _linear(*sim.lags(gain, tau, _log(rng, 3, 10)))
    else:
        period = _log(rng, 25, 200)
        tau = period / 3
        truth = _linear(*sim.oscillator(gain, period, rng.uniform(0.3, 0.9)))
    kind = str(rng.choice(["steps", "levels", "multisine", "chirp"]))
    signal = Excitation(kind, low, high, tau)
    N = _size(rng, 800, 6000)
    train = _record(truth, signal(rng, N))
    noisy = _with_encoder(rng, train, rng.uniform(20, 40))
    test = _unseen(truth, train, lambda: signal(rng, N, inside=0.95))
    return System(truth, [noisy], [test], _period(rng), _gain_levels(low, high, 2 * tau))


@family("rules", linear=True, quick=True)
def prbs_drift(rng: Rng) -> System:
    """Lags of 3 to 12 and .7 to 2.5 about a working point under a two-level PRBS; white noise 25 to
    40 dB and a slow drift of 2 to 8 % of the output; 800 to 2,500 samples. Test: steps between the
    two levels, so a network that bends between them loses."""
    tau = _log(rng, 3, 12)
    low = rng.uniform(0.5, 2)
    high = low + rng.uniform(0.5, 2)
    gain = _log(rng, 10, 300)
    truth = _linear(*sim.lags(gain, tau, _log(rng, 0.7, 2.5)), offset=-gain * low / 2)
    N, lead = _size(rng, 800, 2500), int(12 * tau)
    train = _record(truth, Excitation("prbs", low, high, tau)(rng, N + lead), lead)
    signal = Excitation("steps", low, high, tau)
    test = _unseen(truth, train, lambda: signal(rng, 1000 + lead, 0.95), lead)
    pole = 1 - _log(rng, 5e-4, 5e-3)
    drift = sim.filtered(np.ones(1), np.array([-pole]), rng.normal(size=N + 2000))[2000:]
    drift *= rng.uniform(0.02, 0.08) * train.y.std() / rms(drift)
    noisy = _with_noise(rng, train, rng.uniform(25, 40))
    drifting = Record(noisy.u, noisy.y + drift, noisy.before)
    return System(truth, [drifting], [test], 0.02, _gain_levels(low, high, tau))


@family("rules", linear=True, quick=True)
def dead_time(rng: Rng) -> System:
    """Order 1 to 3 behind a dead time of 0 to 5 samples; 20 to 50 dB; 600 to 4,000 samples; steps,
    levels, multisine or PRBS (test: of the same kind)."""
    delay, order = int(rng.integers(0, 6)), int(rng.integers(1, 4))
    tau, (low, high) = _log(rng, 8, 60), _signed(rng)
    taus = [tau, *(tau * rng.uniform(0.1, 0.5) for _ in range(order - 1))]
    truth = _linear(*sim.lags(_log(rng, 0.1, 100), *taus, delay=delay))
    signal = Excitation(
        str(rng.choice(["steps", "levels", "multisine", "prbs"])), low, high, tau
    )  # fmt: skip
    N = _size(rng, 600, 4000)
    train, test = _pair(rng, truth, signal, N, N, rng.uniform(20, 50), lead=int(3 * tau))
    return System(truth, train, test, _period(rng))


@family("held", linear=True)
def two_mass(rng: Rng) -> System:
    """Two masses on a shaft, speed at the motor: resonance at .02 to .1 of the sampling rate,
    damping of a few per cent; 20 to 45 dB; 4,000 to 40,000 samples; steps, levels or a chirp."""
    ratio, w = _log(rng, 0.3, 3), 2 * math.pi * rng.uniform(0.02, 0.1)
    J1, J2 = 1.0, ratio
    k = w * w * J1 * J2 / (J1 + J2)
    d = 2 * rng.uniform(0.01, 0.05) * k / w
    tau = _log(rng, 60, 250)
    b = (J1 + J2) / (2 * tau)
    gain = _log(rng, 1, 100)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        J1, J2, k, d, b, K = theta
        A = np.array(
            [[-(b + d) / J1, -k / J1, d / J1], [1, 0, -1], [d / J2, k / J2, -(d + b) / J2]]
        )
        B, C = np.array([[K / J1], [0], [0]]), np.array([[1.0, 0, 0]])
        return sim.filtered(*sim.discretised(A, B, C), u)

    truth = Truth(run, np.array([J1, J2, k, d, b, gain * 2 * b]))
    low, high = _signed(rng)
    signal = Excitation(
        str(rng.choice(["steps", "levels", "chirp"])), low, high, rng.uniform(5, 25)
    )  # fmt: skip
    N = _size(rng, 4000, 40000)
    train, test = _pair(rng, truth, signal, N, min(N, 10000), rng.uniform(20, 45))
    return System(truth, train, test, _period(rng), _gain_levels(low, high, tau))


@family("held", linear=True)
def three_inputs(rng: Rng) -> System:
    """Three inputs on a plant of order 2 or 3 with common poles and own zeros and delays (0 to 2);
    20 to 40 dB; 2,000 to 10,000 samples; steps on each."""
    tau = _log(rng, 10, 60)
    taus = [tau, *(tau * rng.uniform(0.1, 0.6) for _ in range(int(rng.integers(1, 3))))]
    _, a = sim.lags(1.0, *taus)
    n, leading = len(a), 1 + rng.integers(0, 3, 3)
    signals = [Excitation("steps", *_signed(rng), tau) for _ in range(3)]
    # inputs of different size have effects of a similar size
    b = rng.uniform(-1, 1, (3, n))
    b *= rng.uniform(0.5, 2, (3, 1)) * (1 + a.sum()) / (np.abs(b.sum(1, keepdims=True)) + 0.2)
    b /= np.array([[s.high] for s in signals])

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        rows, den = theta[: 3 * n].reshape(3, n), theta[3 * n :]
        nums = [np.concatenate([np.zeros(k), row]) for k, row in zip(leading, rows, strict=True)]
        return np.sum([sim.filtered(num, den, u[:, i]) for i, num in enumerate(nums)], axis=0)

    truth = Truth(run, np.concatenate([b.ravel(), a]))

    def inputs(N: int, inside: float) -> FloatArray:
        return np.column_stack([s(rng, N, inside) for s in signals])

    train = _record(truth, inputs(_size(rng, 2000, 10000), 1.0))
    test = _unseen(truth, train, lambda: inputs(4000, 0.95))
    return System(truth, [_with_noise(rng, train, rng.uniform(20, 40))], [test], _period(rng))


# --- motors ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Motor:
    """Parameters of `simulators.motor` that were drawn, and the input range they are meant for."""

    theta: FloatArray
    sub: int
    top: float
    tau: float
    speed: float

    def truth(self, load: bool = False) -> Truth:
        """With a current limit only where theta has one; with a load as second input."""

        def run(theta: FloatArray, u: FloatArray) -> FloatArray:
            full = theta if len(theta) == 8 else np.append(theta, np.inf)
            v, T = (u[:, 0], u[:, 1]) if load else (u, np.zeros(len(u)))
            y: FloatArray = sim.motor(
                np.ascontiguousarray(v), np.ascontiguousarray(T), self.sub, *map(float, full)
            )
            return y

        return Truth(run, self.theta)


def _motor(
    rng: Rng, tau: float, coulomb: tuple[float, float], dead: tuple[float, float],
    limit: tuple[float, float] | None = None,
) -> _Motor:  # fmt: skip
    """A motor of a few volts; Coulomb friction, dead zone and current limit as shares of them."""
    top, gain = _log(rng, 2, 24), _log(rng, 2, 100)
    K = rng.uniform(0.8, 0.98) / gain
    B = 1 / gain - K
    level = top * _log(rng, *coulomb)
    speed = gain * top
    theta = [
        tau / gain,
        B,
        K,
        level,
        level * rng.uniform(1.2, 2.5),
        speed * _log(rng, 0.03, 0.1),
        top * _log(rng, *dead),
    ]
    if limit is not None:
        theta.append(top * _log(rng, *limit))
    # the friction's slope at rest must be slow against a step of the integration
    slope = theta[4] / (0.1 * theta[5]) / theta[0]
    sub = max(4, math.ceil(slope / 0.4))
    return _Motor(np.array(theta), sub, top, tau, speed)


@family("rules")
def motor_friction(rng: Rng) -> System:
    """Motor with Stribeck friction (Coulomb 2 to 10 % of the voltage) and a dead zone of 1 to 8 %,
    tau 20 to 120; 30 to 45 dB; 2,000 to 10,000 samples; steps or a multisine."""
    m = _motor(rng, _log(rng, 20, 120), (0.02, 0.1), (0.01, 0.08))
    signal = Excitation(str(rng.choice(["steps", "multisine"])), -m.top, m.top, m.tau)
    N = _size(rng, 2000, 10000)
    train, test = _pair(rng, m.truth(), signal, N, min(N, 4000), rng.uniform(30, 45))
    return System(m.truth(), train, test, 0.002, _gain_levels(0, m.top, m.tau))


@family("rules")
def drive_limit(rng: Rng) -> System:
    """Motor whose current is limited at 15 to 50 % of the stall current, tau 20 to 80, little
    friction; 30 to 50 dB; twice 5,000 to 20,000 samples: a slow chirp in one direction, pulses in
    both. Test: random steps up to 80 % of the pulses."""
    m = _motor(rng, _log(rng, 20, 80), (0.005, 0.03), (0.002, 0.01), (0.15, 0.5))
    truth, N = m.truth(), _size(rng, 5000, 20000)
    slow = 0.4 * m.top * (1 + sim.chirp(N, 0.02 / m.tau, 0.6 / m.tau))
    pulses = sim.steps(rng, N, -m.top, m.top, m.tau, 6 * m.tau)
    decibels = rng.uniform(30, 50)
    train = [_with_noise(rng, _record(truth, u), decibels) for u in (slow, pulses)]
    test = sim.steps(rng, min(N, 8000), -0.8 * m.top, 0.8 * m.top, 2 * m.tau, 10 * m.tau)
    levels = _gain_levels(0, 0.8 * m.top, 2 * m.tau)
    return System(truth, train, [_record(truth, test)], 0.001, levels)


@family("held")
def motor_loop(rng: Rng) -> System:
    """Motor with friction of 1 to 6 % recorded under a speed PI controller that sees the noise, tau
    20 to 100; 25 to 40 dB; 3,000 to 10,000 samples; reference in steps. Test: other references,
    no noise in the loop."""
    m = _motor(rng, _log(rng, 20, 100), (0.01, 0.06), (0.005, 0.03))
    truth, gain = m.truth(), m.speed / m.top
    Kp, Ti = rng.uniform(0.8, 2.5) / gain, m.tau * rng.uniform(0.6, 1.5)

    def loop(r: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta = map(float, m.theta)
        u, y = sim.motor_loop(r, noise, m.top, Kp, Ti, m.sub, *theta)
        return u, y

    def reference(N: int, inside: float) -> FloatArray:
        top = 0.8 * inside * m.speed
        return sim.steps(rng, N, -top, top, 2 * m.tau, 8 * m.tau)

    N, none = _size(rng, 3000, 10000), np.zeros(0)
    sd = 0.4 * m.speed * 10 ** (-rng.uniform(25, 40) / 20)
    noise = sd * rng.normal(size=N)
    u, y = loop(reference(N, 1.0), noise)
    v, z = loop(reference(4000, 0.95), np.zeros(4000))
    levels = _gain_levels(0, 0.8 * m.top, m.tau)
    return System(truth, [Record(u, y + noise, none)], [Record(v, z, none)], 0.001, levels)


@family("held", quick=True)
def slow_drive(rng: Rng) -> System:
    """A slow drive (tau 30 to 120) with friction of 2 to 8 %, recorded in 8 to 12 long steps with
    rests between; 30 to 45 dB; 800 to 7,000 samples. Test: random steps."""
    m = _motor(rng, _log(rng, 30, 120), (0.02, 0.08), (0.005, 0.03))
    truth, count = m.truth(), int(rng.integers(8, 13))
    shares = rng.permutation(np.linspace(0.25, 1, count)) * rng.choice([-1, 1], count)
    shares[:2] = 1, -1
    shares[2::3] = 0
    u = np.repeat(m.top * rng.permutation(shares), int(rng.uniform(3.5, 5) * m.tau))
    train = _with_noise(rng, _record(truth, u), rng.uniform(30, 45))
    test = sim.steps(rng, 2500, -0.95 * m.top, 0.95 * m.top, m.tau, 4 * m.tau)
    levels = _gain_levels(0, m.top, m.tau)
    return System(truth, [train], [_record(truth, test)], 0.01, levels)


@family("rules")
def two_inputs(rng: Rng) -> System:
    """Motor with friction of 1 to 5 % and a brake torque as second input, tau 20 to 80; 30 to 45
    dB; 3,000 to 12,000 samples; steps on both."""
    m = _motor(rng, _log(rng, 20, 80), (0.01, 0.05), (0.005, 0.03))
    truth = m.truth(load=True)

    def inputs(N: int, inside: float) -> FloatArray:
        voltage = sim.steps(rng, N, -inside * m.top, inside * m.top, m.tau, 5 * m.tau)
        brake = sim.steps(rng, N, -0.3 * inside * m.top, 0.3 * inside * m.top, m.tau, 8 * m.tau)
        return np.column_stack([voltage, brake])

    train = _record(truth, inputs(_size(rng, 3000, 12000), 1.0))
    test = _unseen(truth, train, lambda: inputs(4000, 0.95))
    noisy = _with_noise(rng, train, rng.uniform(30, 45))
    return System(truth, [noisy], [test], 0.001, _gain_levels(0, m.top, m.tau), inputs=2)


# --- positions ------------------------------------------------------------------------------------


def _moves(rng: Rng, N: int, stroke: float, shortest: int, longest: int) -> FloatArray:
    """Smooth point-to-point moves, half of the time moving, to random places and both ends."""
    holds = rng.integers(shortest, longest + 1, N // shortest + 1)
    targets = rng.uniform(-stroke, stroke, len(holds))
    targets[rng.choice(N // longest, 2, replace=False)] = -stroke, stroke
    starts = np.concatenate([[0.0], targets])
    pieces = [_move(a, b, h) for a, b, h in zip(starts, targets, holds, strict=False)]
    return np.concatenate(pieces)[:N]


def _move(start: float, end: float, hold: int) -> FloatArray:
    x = np.clip(np.arange(hold) / (0.5 * hold), 0, 1)
    return start + (end - start) * (3 * x**2 - 2 * x**3)


@dataclass(frozen=True)
class _Slide:
    """A carriage under its controller."""

    theta: FloatArray
    kp: float
    kv: float
    stroke: float

    @property
    def truth(self) -> Truth:
        """Force to position, open loop."""

        def run(theta: FloatArray, u: FloatArray) -> FloatArray:
            y: FloatArray = sim.slide(u, *map(float, theta))
            return y

        return Truth(run, self.theta)

    def run(
        self, r: FloatArray, pulses: FloatArray, drift: FloatArray, limits: tuple[float, float]
    ) -> tuple[FloatArray, FloatArray]:
        """Force, within its limits, and position in closed loop."""
        u, y = sim.slide_loop(r, pulses, drift, *limits, self.kp, self.kv, *map(float, self.theta))
        return u, y


def _slide(rng: Rng) -> _Slide:
    """Mass .5 to 4 kg, viscous 1 to 4 N s/m, Coulomb .1 to .4 N, a third of the seeds with up to
    1.6 times as much in one direction, offset up to .05 N; in units of samples of 1 ms."""
    M, coulomb = _log(rng, 0.5, 4), rng.uniform(0.1, 0.4)
    uneven = rng.uniform(1.2, 1.6) if rng.random() < 1 / 3 else 1.0
    theta = [M * 1e6, _log(rng, 1, 4) * 1e3, coulomb, coulomb * uneven, rng.uniform(0.01, 0.05)]
    return _Slide(
        np.array(theta), rng.uniform(0.02, 0.04), M * rng.uniform(3e4, 6e4), rng.uniform(0.08, 0.2)
    )


def _offset_drift(rng: Rng, N: int, size: float) -> FloatArray:
    """A force that wanders slowly: a random walk smoothed over a second, of this size."""
    walk = np.cumsum(rng.normal(size=N))
    smooth = np.convolve(walk - walk.mean(), np.ones(1000) / 1000, "same")
    return size * smooth / (np.abs(smooth).max() + 1e-300)


@family("held")
def position(rng: Rng) -> System:
    """Position of a carriage with friction (`_slide`), recorded in closed loop during random moves;
    50 to 60 dB; 8,000 to 20,000 samples. Test: other random moves within the training's force."""
    s = _slide(rng)

    def run(N: int, stroke: float, limits: tuple[float, float]) -> Record:
        u, y = s.run(_moves(rng, N, stroke, 800, 2000), np.zeros(N), np.zeros(N), limits)
        return Record(u, y, np.zeros(0))

    train = run(_size(rng, 8000, 20000), s.stroke, (-20.0, 20.0))
    limits = train.u.min(), train.u.max()
    test = _within(train, lambda: run(10000, 0.9 * s.stroke, limits))
    noisy = _with_noise(rng, train, rng.uniform(50, 60))
    return System(s.truth, [noisy], [test])


@family("rules")
def position_periodic(rng: Rng) -> System:
    """The same recorded while one trajectory of six moves repeats; 50 to 60 dB; 12,000 to 24,000
    samples; half of the seeds with an unrecorded force that drifts by 1 to 3 % of the friction.
    Test: the same trajectory with pulses of force added, within the range of training's force."""
    s = _slide(rng)
    none = np.zeros(0)
    targets = s.stroke * np.array([0.8, -0.8, 0.5, -1.0, 1.0, 0.0]) * rng.choice([-1, 1])
    hold = int(rng.integers(900, 1500))
    starts = np.roll(targets, 1)
    one = np.concatenate([_move(a, b, hold) for a, b in zip(starts, targets, strict=True)])
    N = _size(rng, 12000, 24000)
    r = np.tile(one, N // len(one) + 1)[:N]
    drift = _offset_drift(rng, N, s.theta[2] * rng.uniform(0.01, 0.03) * (rng.random() < 0.5))
    u, y = s.run(r, np.zeros(N), drift, (-20.0, 20.0))
    noisy = _with_noise(rng, Record(u, y, none), rng.uniform(50, 60))
    pulses, force = np.zeros(N), np.abs(u).max()
    for _ in range(N // 600):
        at, width = int(rng.integers(0, N - 200)), int(rng.integers(30, 150))
        pulses[at : at + width] += rng.choice([-1, 1]) * rng.uniform(0.2, 0.7) * force
    v, z = s.run(r, pulses, np.zeros(N), (u.min(), u.max()))
    return System(s.truth, [noisy], [Record(v, z, none)])


@family("rules")
def angle(rng: Rng) -> System:
    """Angle of a servo that steps from place to place against dry friction of 5 to 25 % of its
    largest torque, recorded in closed loop; 40 to 55 dB; 6,000 to 16,000 samples. Test: other steps
    within the training's torque."""
    inertia, top = _log(rng, 1e-3, 1e-2) * 1e6, rng.uniform(0.5, 2.0)
    coulomb = top * _log(rng, 0.05, 0.25)
    theta = np.array([inertia, _log(rng, 0.5, 3.0) * inertia * 1e-3, coulomb, coulomb, 0.0])
    kp = rng.uniform(0.008, 0.02)
    s = _Slide(theta, kp, inertia * kp * rng.uniform(3, 5), 1.0)
    reach = 0.25 * top / inertia / kp**2

    def run(N: int, limits: tuple[float, float]) -> Record:
        levels = np.repeat(rng.uniform(-reach, reach, N // 400 + 1), rng.integers(400, 900))[:N]
        u, y = s.run(levels, np.zeros(N), np.zeros(N), limits)
        return Record(u, y, np.zeros(0))

    train = run(_size(rng, 6000, 16000), (-top, top))
    limits = float(train.u.min()), float(train.u.max())
    test = _within(train, lambda: run(8000, limits))
    return System(s.truth, [_with_noise(rng, train, rng.uniform(40, 55))], [test])


# --- chains of blocks -----------------------------------------------------------------------------


def _poles(rng: Rng) -> tuple[FloatArray, FloatArray, float]:
    """A second-order block of gain 1 with its time constant: real or complex poles."""
    if rng.random() < 0.5:
        tau = _log(rng, 4, 25)
        return *sim.lags(1.0, tau, tau * rng.uniform(0.2, 0.8)), tau
    period = _log(rng, 15, 80)
    return *sim.oscillator(1.0, period, rng.uniform(0.25, 0.8)), period / 4


def _input_curve(rng: Rng) -> tuple[Callable[..., FloatArray], FloatArray]:
    """A static function of an input within +-1 and its parameters."""
    which = int(rng.integers(0, 4))
    if which == 0:
        return lambda u, p: np.tanh(p[0] * u) + p[1] * u**2, rng.uniform([0.8, 0.1], [2.5, 0.5])
    if which == 1:
        return lambda u, p: u + p[0] * u**2 + p[1] * u**3, rng.uniform([0.2, -0.3], [0.6, 0.8])
    if which == 2:
        # a dead zone with rounded corners
        corner = 0.03

        def dead(u: FloatArray, p: FloatArray) -> FloatArray:
            side = [np.logaddexp(0, (s * u - p[i]) / corner) for i, s in enumerate((1, -1))]
            return corner * (side[0] - side[1])

        return dead, rng.uniform(0.1, 0.4, 2)
    return lambda u, p: np.where(u > 0, u, p[0] * u) / (1 + p[1] * np.abs(u)), rng.uniform(
        [0.2, 0.2], [0.6, 1.0]
    )


def _output_curve(rng: Rng) -> tuple[Callable[..., FloatArray], FloatArray]:
    """A static function that rises, for a signal of size 1."""
    which = int(rng.integers(0, 3))
    if which == 0:
        return lambda x, p: np.where(x > 0, np.tanh(p[0] * x) / p[0], p[1] * x), rng.uniform(
            [0.7, 0.4], [1.5, 1.0]
        )
    if which == 1:
        return lambda x, p: x / np.cbrt(1 + np.abs(p[0] * x) ** 3), rng.uniform([0.8], [1.6])
    return lambda x, p: np.expm1(p[0] * x) / p[0], rng.uniform([0.3], [0.9])


@family("rules", quick=True)
def hammerstein(rng: Rng) -> System:
    """A static curve (tanh, cubic, dead zone, bent at 0), then second order and a delay of 0 to 3;
    25 to 45 dB; 1,000 to 6,000 samples; multisine, steps or levels."""
    curve, p = _input_curve(rng)
    b, a, tau = _poles(rng)
    delay = int(rng.integers(0, 4))
    scale = _log(rng, 1, 24)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(1 + delay), theta[:2]])
        return sim.filtered(num, theta[2:4], curve(u / scale, theta[4:]))

    truth = Truth(run, np.concatenate([b[1:], a, p]))
    signal = Excitation(
        str(rng.choice(["multisine", "steps", "levels"])), -scale, scale, tau
    )  # fmt: skip
    N = _size(rng, 1000, 6000)
    train, test = _pair(rng, truth, signal, N, 3000, rng.uniform(25, 45), lead=int(4 * tau))
    return System(truth, train, test, _period(rng))


@family("held", quick=True)
def wiener(rng: Rng) -> System:
    """Second order and a delay of 0 to 2, then a saturation on one side, on both, or an
    exponential; 25 to 45 dB; 600 to 3,000 samples; multisine, steps or levels."""
    curve, p = _output_curve(rng)
    b, a, tau = _poles(rng)
    delay = int(rng.integers(0, 3))
    scale, gain = _log(rng, 1, 24), _log(rng, 0.1, 100)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(1 + delay), theta[:2]])
        return theta[4] * curve(sim.filtered(num, theta[2:4], u / scale), theta[5:])

    signal = Excitation(
        str(rng.choice(["multisine", "steps", "levels"])), -scale, scale, tau
    )  # fmt: skip
    N = _size(rng, 600, 3000)
    # the linear block's gain brings what enters the curve to +-1.3
    x = sim.filtered(b, a, signal(rng, 5000) / scale)
    truth = Truth(run, np.concatenate([1.3 * b[1:] / np.abs(x).max(), a, [gain], p]))
    train, test = _pair(rng, truth, signal, N, 2000, rng.uniform(25, 45), lead=int(4 * tau))
    return System(truth, train, test, _period(rng))


def _block(rng: Rng, order: int) -> tuple[FloatArray, FloatArray]:
    """A Chebyshev or Butterworth low-pass of gain 1 (its numerator has no delay)."""
    from scipy.signal import butter, cheby1, cheby2

    cut, which = rng.uniform(0.12, 0.35), int(rng.integers(0, 3))
    if which == 0:
        b, a = butter(order, cut)
    elif which == 1:
        b, a = cheby1(order, rng.uniform(0.2, 1), cut)
    else:
        b, a = cheby2(order, rng.uniform(30, 45), min(0.6, 1.6 * cut))
    return b * (a.sum() / b.sum()), a[1:]


@family("rules")
def wiener_hammerstein(rng: Rng) -> System:
    """Low-pass of order 2 or 3, a diode or a saturation, low-pass of order 2 or 3; half of the
    seeds without a delay of one sample; 45 to 60 dB; 20,000 to 100,000 samples; multisine."""
    (b1, a1), (b2, a2) = (_block(rng, int(rng.integers(2, 4))) for _ in range(2))
    delay = int(rng.integers(0, 2))
    n1, n2 = len(a1), len(a2)
    if rng.random() < 0.5:
        p = rng.uniform([0.1, 0.2], [0.4, 0.5])

        def curve(x: FloatArray, p: FloatArray) -> FloatArray:
            return np.where(x > p[0], p[0] + p[1] * (x - p[0]), x)
    else:
        p = rng.uniform([1.0, -0.2], [2.5, 0.2])

        def curve(x: FloatArray, p: FloatArray) -> FloatArray:
            return np.tanh(p[0] * x + p[1])

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        b1, a1, b2, a2, p = np.split(theta, np.cumsum([n1 + 1, n1, n2 + 1, n2]))
        x = curve(sim.filtered(b1, a1, u), p)
        return sim.filtered(np.concatenate([np.zeros(delay), b2]), a2, x)

    truth = Truth(run, np.concatenate([b1, a1, b2, a2, p]))
    # peaks of a multisine are rare: the bulk of it has to reach the curve
    signal = Excitation("multisine", -1.8, 1.8, _log(rng, 2, 5))
    N = _size(rng, 20000, 100000)
    train, test = _pair(rng, truth, signal, N, 20000, rng.uniform(45, 60), lead=200)
    return System(truth, train, test, 1 / 51200)


@family("held")
def hammerstein_wiener(rng: Rng) -> System:
    """A static curve, order 2 to 4, a static curve that rises; 30 to 50 dB; 10,000 to 60,000
    samples; multisine or steps."""
    first, p = _input_curve(rng)
    last, q = _output_curve(rng)
    b, a, tau = _poles(rng)
    extra = int(rng.integers(0, 3))
    c, d = sim.lags(1.0, *(tau * rng.uniform(0.15, 0.7) for _ in range(extra))) if extra else (
        np.array([0.0, 1.0]),
        np.zeros(0),
    )  # fmt: skip
    sizes = np.cumsum([2, 2, max(extra, 1), extra, len(p)])

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        b, a, c, d, p, q = np.split(theta, sizes)
        x = sim.filtered(np.concatenate([[0.0], b]), a, first(u, p))
        return last(sim.filtered(c, d, x), q)

    signal = Excitation(str(rng.choice(["multisine", "steps"])), -1.0, 1.0, tau)
    x = sim.filtered(c[1:], d, sim.filtered(b, a, first(signal(rng, 5000), p)))
    truth = Truth(run, np.concatenate([1.3 * b[1:] / np.abs(x).max(), a, c[1:], d, p, q]))
    N = _size(rng, 10000, 60000)
    train, test = _pair(rng, truth, signal, N, 10000, rng.uniform(30, 50), lead=int(5 * tau))
    return System(truth, train, test, _period(rng))


# --- other plants ---------------------------------------------------------------------------------


@family("rules", quick=True)
def tanks(rng: Rng) -> System:
    """Two cascaded tanks of which the upper one overflows now and then; 25 to 40 dB; 1,000 samples;
    a slow multisine."""
    while True:
        theta = rng.uniform([0.18, 0.18, 0.14, 0.05], [0.26, 0.26, 0.22, 0.15])
        low, high = 0.3, rng.uniform(5, 9)

        def run(theta: FloatArray, u: FloatArray) -> FloatArray:
            y: FloatArray = sim.tanks(u, *map(float, theta))
            return y

        truth = Truth(run, theta)
        # slower than what the tanks need to empty
        signal = Excitation("multisine", low, high, rng.uniform(25, 50))
        train, test = _pair(rng, truth, signal, 1000, 1000, rng.uniform(25, 40), lead=100)
        seen, new = truth.simulate(train[0]), test[0].y
        overflows = all(0.01 < np.mean(y > 9.99) < 0.15 for y in (seen, new))
        if overflows and new.min() > seen.min() - 0.3:
            return System(truth, train, test, 4.0)


@family("rules")
def backlash(rng: Rng) -> System:
    """Second order, a backlash of 10 to 40 % of what enters it, half of the seeds with a lag
    after it; 25 to 45 dB; 2,000 to 6,000 samples; steps or a multisine."""
    b, a, tau = _poles(rng)
    lag = rng.uniform(2, 8) if rng.random() < 0.5 else None
    low, high = _signed(rng)
    signal = Excitation(str(rng.choice(["steps", "multisine"])), low, high, tau)
    x = sim.filtered(b, a, signal(rng, 5000))[500:]
    gap = rng.uniform(0.1, 0.4) * x.std()
    after = [] if lag is None else [math.exp(-1 / lag)]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        z: FloatArray = sim.backlash(
            sim.filtered(np.concatenate([[0.0], theta[:2]]), theta[2:4], u), float(theta[4])
        )
        if lag is None:
            return z
        return sim.filtered(np.array([0.0, 1 - theta[5]]), -theta[5:], z)

    truth = Truth(run, np.concatenate([b[1:], a, [gap], after]), kinked=True)
    N = _size(rng, 2000, 6000)
    train, test = _pair(rng, truth, signal, N, 4000, rng.uniform(25, 45), lead=int(5 * tau))
    return System(truth, train, test, _period(rng))


@family("held")
def bouc_wen(rng: Rng) -> System:
    """A mass on a hysteretic spring, resonance at .02 to .06 of the sampling rate; 40 to 55 dB;
    5,000 to 40,000 samples; multisine."""
    w, damping = 2 * math.pi * rng.uniform(0.02, 0.06), rng.uniform(0.01, 0.04)
    share = rng.uniform(0.35, 0.6)
    # mass 1; `share` of the stiffness is hysteretic, and yields at a deflection of about .6 to 1.5
    stiff = w * w
    alpha = share * stiff
    gamma = rng.uniform(0.6, 1.0)
    beta = alpha / (gamma + 0.8) / (alpha * rng.uniform(0.6, 1.5))
    theta = [1.0, 2 * damping * w, stiff - alpha, alpha, beta, gamma, 0.8 * gamma]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        # beta and gamma are only known as products
        M, c, k, alpha, *rest = map(float, theta)
        y: FloatArray = sim.bouc_wen(u, M, c, k, alpha, 1.0, *rest)
        return y

    theta = [*theta[:4], beta * gamma, 0.8 * beta * gamma]
    truth = Truth(run, np.array(theta))
    top = stiff * rng.uniform(1.0, 2.5)
    signal = Excitation("multisine", -top, top, 1.2 / w)
    N = _size(rng, 5000, 40000)
    train, test = _pair(rng, truth, signal, N, min(N, 10000), rng.uniform(40, 55))
    return System(truth, train, test, 1 / 750)


@family("rules")
def duffing(rng: Rng) -> System:
    """A mass on a hardening spring (the cubic part 3 to 25 % at the rms deflection), resonance at
    .06 to .15 of the sampling rate, damping .03 to .1; 40 to 60 dB; 10,000 to 60,000 samples;
    multisine."""
    w, damping = 2 * math.pi * rng.uniform(0.06, 0.15), rng.uniform(0.03, 0.1)
    top = _log(rng, 0.05, 5)
    signal = Excitation("multisine", -top, top, 0.7 / w)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = sim.duffing(u, *map(float, theta))
        return y

    linear = run(np.array([w, damping, 0.0]), signal(rng, 5000))
    cubic = rng.uniform(0.03, 0.25) / np.mean(linear**2)
    truth = Truth(run, np.array([w, damping, cubic]))
    N = _size(rng, 10000, 60000)
    train, test = _pair(rng, truth, signal, N, 10000, rng.uniform(40, 60))
    return System(truth, train, test, 1 / 610)


@family("held", quick=True)
def bilinear(rng: Rng) -> System:
    """A flow that also carries away: tau 20 to 100 shrinks by a factor of 1.5 to 4 with the input,
    behind an actuator of 2 to 10; 25 to 45 dB; 1,000 to 8,000 samples; steps, levels, multisine."""
    tau, top = _log(rng, 20, 100), _log(rng, 1, 24)
    theta = [tau, _log(rng, 2, 10), rng.uniform(0.5, 3) / top, _log(rng, 0.1, 50)]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = sim.bilinear(u, *map(float, theta))
        return y

    truth = Truth(run, np.array(theta))
    kind = str(rng.choice(["steps", "levels", "multisine"]))
    signal = Excitation(kind, 0.05 * top, top, tau / 2)
    N = _size(rng, 1000, 8000)
    train, test = _pair(rng, truth, signal, N, 3000, rng.uniform(25, 45), lead=int(3 * tau))
    return System(truth, train, test, _period(rng))


@family("held")
def gain_scheduled(rng: Rng) -> System:
    """A motor that grows slower (by 20 to 150 %) and weaker (by 20 to 100 %) towards full speed,
    tau 15 to 80, behind an actuator of 2 to 8; 25 to 45 dB; 1,500 to 10,000 samples; steps, levels
    or a chirp."""
    tau, top, size = _log(rng, 15, 80), _log(rng, 2, 24), _log(rng, 1, 300)
    weaker = rng.uniform(0.2, 1.0)
    theta = [_log(rng, 2, 8), tau, rng.uniform(0.2, 1.5), (1 + weaker) / top, weaker, size]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = theta[5] * sim.scheduled(u, *map(float, theta[:5]))
        return y

    # the size of the output and that of its curves cannot be told apart from the gain: fixed
    truth = Truth(lambda t, u: run(np.append(t, size), u), np.array(theta[:5]))
    low = -top if rng.random() < 0.5 else 0.05 * top
    signal = Excitation(str(rng.choice(["steps", "levels", "chirp"])), low, top, tau)
    N = _size(rng, 1500, 10000)
    train, test = _pair(rng, truth, signal, N, 4000, rng.uniform(25, 45))
    return System(truth, train, test, 0.005, _gain_levels(low, top, 3 * tau))


RULES = tuple(name for name, f in FAMILIES.items() if f.split == "rules")
HELD = tuple(name for name, f in FAMILIES.items() if f.split == "held")
