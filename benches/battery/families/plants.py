"""Tanks, springs, backlash, and gains that depend on the state."""

from __future__ import annotations

import math

import numpy as np

from .. import simulators as sim
from ..simulators import Excitation, FloatArray
from .blocks import second_order
from .drawing import (
    gain_levels,
    input_range,
    log_uniform,
    records,
    sample_time,
    samples,
)
from .system import Rng, System, Truth, family


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
        train, test = records(rng, truth, signal, 1000, 1000, rng.uniform(25, 40), lead=100)
        seen, new = truth.simulate(train[0]), test[0].y
        overflows = all(0.01 < np.mean(y > 9.99) < 0.15 for y in (seen, new))
        if overflows and new.min() > seen.min() - 0.3:
            return System(truth, train, test, 4.0)


@family("rules")
def backlash(rng: Rng) -> System:
    """Second order, a backlash of 10 to 40 % of what enters it, half of the seeds with a lag
    after it; 25 to 45 dB; 2,000 to 6,000 samples; steps or a multisine."""
    b, a, tau = second_order(rng)
    lag = rng.uniform(2, 8) if rng.random() < 0.5 else None
    low, high = input_range(rng)
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
    N = samples(rng, 2000, 6000)
    train, test = records(rng, truth, signal, N, 4000, rng.uniform(25, 45), lead=int(5 * tau))
    return System(truth, train, test, sample_time(rng))


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
    N = samples(rng, 5000, 40000)
    train, test = records(rng, truth, signal, N, min(N, 10000), rng.uniform(40, 55))
    return System(truth, train, test, 1 / 750)


@family("rules")
def duffing(rng: Rng) -> System:
    """A mass on a hardening spring (the cubic part 3 to 25 % at the rms deflection), resonance at
    .06 to .15 of the sampling rate, damping .03 to .1; 40 to 60 dB; 10,000 to 60,000 samples;
    multisine."""
    w, damping = 2 * math.pi * rng.uniform(0.06, 0.15), rng.uniform(0.03, 0.1)
    top = log_uniform(rng, 0.05, 5)
    signal = Excitation("multisine", -top, top, 0.7 / w)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = sim.duffing(u, *map(float, theta))
        return y

    linear = run(np.array([w, damping, 0.0]), signal(rng, 5000))
    cubic = rng.uniform(0.03, 0.25) / np.mean(linear**2)
    truth = Truth(run, np.array([w, damping, cubic]))
    N = samples(rng, 10000, 60000)
    train, test = records(rng, truth, signal, N, 10000, rng.uniform(40, 60))
    return System(truth, train, test, 1 / 610)


@family("held", quick=True)
def bilinear(rng: Rng) -> System:
    """A flow that also carries away: tau 20 to 100 shrinks by a factor of 1.5 to 4 with the input,
    behind an actuator of 2 to 10; 25 to 45 dB; 1,000 to 8,000 samples; steps, levels, multisine."""
    tau, top = log_uniform(rng, 20, 100), log_uniform(rng, 1, 24)
    theta = [tau, log_uniform(rng, 2, 10), rng.uniform(0.5, 3) / top, log_uniform(rng, 0.1, 50)]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = sim.bilinear(u, *map(float, theta))
        return y

    truth = Truth(run, np.array(theta))
    kind = str(rng.choice(["steps", "levels", "multisine"]))
    signal = Excitation(kind, 0.05 * top, top, tau / 2)
    N = samples(rng, 1000, 8000)
    train, test = records(rng, truth, signal, N, 3000, rng.uniform(25, 45), lead=int(3 * tau))
    return System(truth, train, test, sample_time(rng))


@family("held")
def gain_scheduled(rng: Rng) -> System:
    """A motor that grows slower (by 20 to 150 %) and weaker (by 20 to 100 %) towards full speed,
    tau 15 to 80, behind an actuator of 2 to 8; 25 to 45 dB; 1,500 to 10,000 samples; steps, levels
    or a chirp."""
    tau, top, size = log_uniform(rng, 15, 80), log_uniform(rng, 2, 24), log_uniform(rng, 1, 300)
    weaker = rng.uniform(0.2, 1.0)
    theta = [log_uniform(rng, 2, 8), tau, rng.uniform(0.2, 1.5), (1 + weaker) / top, weaker, size]

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        y: FloatArray = theta[5] * sim.scheduled(u, *map(float, theta[:5]))
        return y

    # the size of the output and that of its curves cannot be told apart from the gain: fixed
    truth = Truth(lambda t, u: run(np.append(t, size), u), np.array(theta[:5]))
    low = -top if rng.random() < 0.5 else 0.05 * top
    signal = Excitation(str(rng.choice(["steps", "levels", "chirp"])), low, top, tau)
    N = samples(rng, 1500, 10000)
    train, test = records(rng, truth, signal, N, 4000, rng.uniform(25, 45))
    return System(truth, train, test, 0.005, gain_levels(low, top, 3 * tau))
