"""Motors with friction, a dead zone, a current limit or a load, in open and closed loop."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import simulators as sim
from ..simulators import Excitation, FloatArray
from .drawing import (
    gain_levels,
    log_uniform,
    noise_free,
    records,
    samples,
    unseen,
    with_noise,
)
from .system import Record, Rng, System, Truth, family


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


def motor_of(
    rng: Rng, tau: float, coulomb: tuple[float, float], dead: tuple[float, float],
    limit: tuple[float, float] | None = None,
) -> _Motor:  # fmt: skip
    """A motor of a few volts; Coulomb friction, dead zone and current limit as shares of them."""
    top, gain = log_uniform(rng, 2, 24), log_uniform(rng, 2, 100)
    K = rng.uniform(0.8, 0.98) / gain
    B = 1 / gain - K
    level = top * log_uniform(rng, *coulomb)
    speed = gain * top
    theta = [
        tau / gain,
        B,
        K,
        level,
        level * rng.uniform(1.2, 2.5),
        speed * log_uniform(rng, 0.03, 0.1),
        top * log_uniform(rng, *dead),
    ]
    if limit is not None:
        theta.append(top * log_uniform(rng, *limit))
    # the friction's slope at rest must be slow against a step of the integration
    slope = theta[4] / (0.1 * theta[5]) / theta[0]
    sub = max(4, math.ceil(slope / 0.4))
    return _Motor(np.array(theta), sub, top, tau, speed)


@family("rules")
def motor_friction(rng: Rng) -> System:
    """Motor with Stribeck friction (Coulomb 2 to 10 % of the voltage) and a dead zone of 1 to 8 %,
    tau 20 to 120; 30 to 45 dB; 2,000 to 10,000 samples; steps or a multisine."""
    m = motor_of(rng, log_uniform(rng, 20, 120), (0.02, 0.1), (0.01, 0.08))
    signal = Excitation(str(rng.choice(["steps", "multisine"])), -m.top, m.top, m.tau)
    N = samples(rng, 2000, 10000)
    train, test = records(rng, m.truth(), signal, N, min(N, 4000), rng.uniform(30, 45))
    return System(m.truth(), train, test, 0.002, gain_levels(0, m.top, m.tau))


@family("rules")
def drive_limit(rng: Rng) -> System:
    """Motor whose current is limited at 15 to 50 % of the stall current, tau 20 to 80, little
    friction; 30 to 50 dB; twice 5,000 to 20,000 samples: a slow chirp in one direction, pulses in
    both. Test: random steps up to 80 % of the pulses."""
    m = motor_of(rng, log_uniform(rng, 20, 80), (0.005, 0.03), (0.002, 0.01), (0.15, 0.5))
    truth, N = m.truth(), samples(rng, 5000, 20000)
    slow = 0.4 * m.top * (1 + sim.chirp(N, 0.02 / m.tau, 0.6 / m.tau))
    pulses = sim.steps(rng, N, -m.top, m.top, m.tau, 6 * m.tau)
    decibels = rng.uniform(30, 50)
    train = [with_noise(rng, noise_free(truth, u), decibels) for u in (slow, pulses)]
    test = sim.steps(rng, min(N, 8000), -0.8 * m.top, 0.8 * m.top, 2 * m.tau, 10 * m.tau)
    levels = gain_levels(0, 0.8 * m.top, 2 * m.tau)
    return System(truth, train, [noise_free(truth, test)], 0.001, levels)


@family("held")
def motor_loop(rng: Rng) -> System:
    """Motor with friction of 1 to 6 % recorded under a speed PI controller that sees the noise, tau
    20 to 100; 25 to 40 dB; 3,000 to 10,000 samples; reference in steps. Test: other references,
    no noise in the loop."""
    m = motor_of(rng, log_uniform(rng, 20, 100), (0.01, 0.06), (0.005, 0.03))
    truth, gain = m.truth(), m.speed / m.top
    Kp, Ti = rng.uniform(0.8, 2.5) / gain, m.tau * rng.uniform(0.6, 1.5)

    def loop(r: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        theta = map(float, m.theta)
        u, y = sim.motor_loop(r, noise, m.top, Kp, Ti, m.sub, *theta)
        return u, y

    def reference(N: int, inside: float) -> FloatArray:
        top = 0.8 * inside * m.speed
        return sim.steps(rng, N, -top, top, 2 * m.tau, 8 * m.tau)

    N, none = samples(rng, 3000, 10000), np.zeros(0)
    sd = 0.4 * m.speed * 10 ** (-rng.uniform(25, 40) / 20)
    noise = sd * rng.normal(size=N)
    u, y = loop(reference(N, 1.0), noise)
    v, z = loop(reference(4000, 0.95), np.zeros(4000))
    levels = gain_levels(0, 0.8 * m.top, m.tau)
    return System(truth, [Record(u, y + noise, none)], [Record(v, z, none)], 0.001, levels)


@family("held", quick=True)
def slow_drive(rng: Rng) -> System:
    """A slow drive (tau 30 to 120) with friction of 2 to 8 %, recorded in 8 to 12 long steps with
    rests between; 30 to 45 dB; 800 to 7,000 samples. Test: random steps."""
    m = motor_of(rng, log_uniform(rng, 30, 120), (0.02, 0.08), (0.005, 0.03))
    truth, count = m.truth(), int(rng.integers(8, 13))
    shares = rng.permutation(np.linspace(0.25, 1, count)) * rng.choice([-1, 1], count)
    shares[:2] = 1, -1
    shares[2::3] = 0
    u = np.repeat(m.top * rng.permutation(shares), int(rng.uniform(3.5, 5) * m.tau))
    train = with_noise(rng, noise_free(truth, u), rng.uniform(30, 45))
    test = sim.steps(rng, 2500, -0.95 * m.top, 0.95 * m.top, m.tau, 4 * m.tau)
    levels = gain_levels(0, m.top, m.tau)
    return System(truth, [train], [noise_free(truth, test)], 0.01, levels)


@family("rules")
def two_inputs(rng: Rng) -> System:
    """Motor with friction of 1 to 5 % and a brake torque as second input, tau 20 to 80; 30 to 45
    dB; 3,000 to 12,000 samples; steps on both."""
    m = motor_of(rng, log_uniform(rng, 20, 80), (0.01, 0.05), (0.005, 0.03))
    truth = m.truth(load=True)

    def inputs(N: int, inside: float) -> FloatArray:
        voltage = sim.steps(rng, N, -inside * m.top, inside * m.top, m.tau, 5 * m.tau)
        brake = sim.steps(rng, N, -0.3 * inside * m.top, 0.3 * inside * m.top, m.tau, 8 * m.tau)
        return np.column_stack([voltage, brake])

    train = noise_free(truth, inputs(samples(rng, 3000, 12000), 1.0))
    test = unseen(truth, train, lambda: inputs(4000, 0.95))
    noisy = with_noise(rng, train, rng.uniform(30, 45))
    return System(truth, [noisy], [test], 0.001, gain_levels(0, m.top, m.tau), inputs=2)
