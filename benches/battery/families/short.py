"""Short records, of 200 to 800 samples, about a level that is not zero.

Input and output lie up to 20 standard deviations away from zero. Half of the records of linear
plants have two levels of the input only. Tests are as long as the training, at least 600 samples.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .. import simulators as sim
from ..simulators import Excitation, FloatArray
from .blocks import input_curve, output_curve, second_order
from .drawing import log_uniform, records, sample_time, samples, transfer_function
from .motors import motor_of
from .system import Record, Rng, System, Truth, family

LEAST, MOST = 200, 800
TESTED = 600


def _about_a_level(
    rng: Rng,
    run: Callable[[FloatArray, FloatArray], FloatArray],
    theta: FloatArray,
    signal: Excitation,
) -> tuple[Truth, Excitation]:
    """A plant and its excitation about levels of input and output; the output's is a parameter."""
    probe = run(theta, signal(rng, 2000))
    u0 = rng.uniform(-20.0, 20.0) * (signal.high - signal.low)
    y0 = rng.uniform(-20.0, 20.0) * probe.std()

    def about(theta: FloatArray, u: FloatArray) -> FloatArray:
        return theta[-1] + run(theta[:-1], u - u0)

    moved = Excitation(signal.kind, signal.low + u0, signal.high + u0, signal.tau)
    return Truth(about, np.append(theta, y0)), moved


def _recorded(
    rng: Rng,
    run: Callable[[FloatArray, FloatArray], FloatArray],
    theta: FloatArray,
    signal: Excitation,
    decibels: tuple[float, float],
) -> System:
    truth, moved = _about_a_level(rng, run, theta, signal)
    N, lead = samples(rng, LEAST, MOST), int(5 * signal.tau)
    train, test = records(rng, truth, moved, N, max(N, TESTED), rng.uniform(*decibels), lead=lead)
    return System(truth, train, test, sample_time(rng))


@family("rules", linear=True, quick=True)
def short_lags(rng: Rng) -> System:
    """One to three lags, dead time of 0 to 4 samples; 15 to 40 dB; PRBS, steps or multisine."""
    tau = log_uniform(rng, 4, 25)
    taus = [tau, *(tau * rng.uniform(0.15, 0.7) for _ in range(int(rng.integers(0, 3))))]
    truth = transfer_function(
        *sim.lags(log_uniform(rng, 0.1, 100), *taus, delay=int(rng.integers(0, 5)))
    )
    kind = str(rng.choice(["prbs", "prbs", "steps", "multisine"]))
    return _recorded(rng, truth.run, truth.theta, Excitation(kind, -1.0, 1.0, tau), (15, 40))


@family("rules", quick=True)
def short_hammerstein(rng: Rng) -> System:
    """A static curve, second order, a delay of 0 to 3; 20 to 40 dB; multisine, steps or levels."""
    curve, p = input_curve(rng)
    b, a, tau = second_order(rng)
    delay = int(rng.integers(0, 4))

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(1 + delay), theta[:2]])
        return sim.filtered(num, theta[2:4], curve(u, theta[4:]))

    kind = str(rng.choice(["multisine", "steps", "levels"]))
    theta = np.concatenate([b[1:], a, p])
    return _recorded(rng, run, theta, Excitation(kind, -1.0, 1.0, tau), (20, 40))


@family("rules", quick=True)
def short_tank(rng: Rng) -> System:
    """Two tanks without overflow, emptied through holes; 20 to 40 dB; slow steps or multisine."""
    theta = rng.uniform([0.18, 0.18, 0.14, 0.05], [0.26, 0.26, 0.22, 0.15])

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = sim.tanks(u, *map(float, theta), 0.1)
        return y

    tau = rng.uniform(10, 25)
    truth = Truth(run, theta[:3])
    signal = Excitation(str(rng.choice(["steps", "multisine"])), 0.5, rng.uniform(2.0, 4.0), tau)
    N, lead = samples(rng, LEAST, MOST), 100
    train, test = records(rng, truth, signal, N, TESTED, rng.uniform(20, 40), lead=lead)
    return System(truth, train, test, 4.0)


@family("rules", quick=True)
def short_motor(rng: Rng) -> System:
    """Motor with friction of 2 to 8 % and a dead zone, tau 5 to 25; 20 to 40 dB; steps."""
    m = motor_of(rng, log_uniform(rng, 5, 25), (0.02, 0.08), (0.005, 0.04))
    signal = Excitation("steps", -m.top if rng.random() < 0.6 else 0.1 * m.top, m.top, m.tau)
    N = samples(rng, LEAST, MOST)
    train, test = records(rng, m.truth(), signal, N, TESTED, rng.uniform(20, 40))
    return System(m.truth(), train, test, 0.01)


@family("held", linear=True, quick=True)
def short_oscillator(rng: Rng) -> System:
    """An oscillation, damping .1 to .9, perhaps behind a lag; 15 to 40 dB; PRBS, steps, levels."""
    period = log_uniform(rng, 12, 60)
    b, a = sim.oscillator(log_uniform(rng, 0.1, 100), period, rng.uniform(0.1, 0.9))
    if rng.random() < 0.5:
        c, d = sim.lags(1.0, period * rng.uniform(0.1, 0.5))
        b, a = np.convolve(b, c), np.convolve(np.r_[1.0, a], np.r_[1.0, d])[1:]
    truth = transfer_function(b, a)
    kind = str(rng.choice(["prbs", "prbs", "steps", "levels"]))
    signal = Excitation(kind, -1.0, 1.0, period / 4)
    return _recorded(rng, truth.run, truth.theta, signal, (15, 40))


@family("held", quick=True)
def short_wiener(rng: Rng) -> System:
    """Second order, a delay of 0 to 2, a static curve; 20 to 40 dB; multisine, steps or levels."""
    curve, p = output_curve(rng)
    b, a, tau = second_order(rng)
    delay = int(rng.integers(0, 3))
    signal = Excitation(str(rng.choice(["multisine", "steps", "levels"])), -1.0, 1.0, tau)
    x = sim.filtered(b, a, signal(rng, 5000))

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(1 + delay), theta[:2]])
        return curve(sim.filtered(num, theta[2:4], u), theta[4:])

    theta = np.concatenate([1.3 * b[1:] / np.abs(x).max(), a, p])
    return _recorded(rng, run, theta, signal, (20, 40))


@family("held", quick=True)
def short_scheduled(rng: Rng) -> System:
    """A motor slower and weaker towards full speed, tau 6 to 25; 20 to 40 dB; steps, levels."""
    tau, weaker = log_uniform(rng, 6, 25), rng.uniform(0.2, 1.0)
    theta = [rng.uniform(1, 3), tau, rng.uniform(0.2, 1.5), 1 + weaker, weaker]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = sim.scheduled(u, *map(float, theta))
        return y

    low = -1.0 if rng.random() < 0.5 else 0.05
    kind = str(rng.choice(["steps", "levels"]))
    return _recorded(rng, run, np.array(theta), Excitation(kind, low, 1.0, tau), (20, 40))


@family("held", quick=True)
def short_loop(rng: Rng) -> System:
    """Motor with friction under a PI controller that sees the noise, tau 5 to 25; 25 to 40 dB;
    reference in steps. Test: other references, no noise in the loop."""
    m = motor_of(rng, log_uniform(rng, 5, 25), (0.01, 0.06), (0.005, 0.03))
    gain = m.speed / m.top
    Kp, Ti = rng.uniform(0.8, 2.5) / gain, m.tau * rng.uniform(0.6, 1.5)

    def loop(r: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        u, y = sim.motor_loop(r, noise, m.top, Kp, Ti, m.sub, *map(float, m.theta))
        return u, y

    def reference(N: int, inside: float) -> FloatArray:
        top = 0.8 * inside * m.speed
        return sim.steps(rng, N, -top, top, 2 * m.tau, 8 * m.tau)

    N, none = samples(rng, LEAST, MOST), np.zeros(0)
    noise = 0.4 * m.speed * 10 ** (-rng.uniform(25, 40) / 20) * rng.normal(size=N)
    u, y = loop(reference(N, 1.0), noise)
    v, z = loop(reference(TESTED, 0.95), np.zeros(TESTED))
    return System(m.truth(), [Record(u, y + noise, none)], [Record(v, z, none)], 0.01)
