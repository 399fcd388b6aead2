"""Plants that are linear, perhaps but for an encoder or a drift."""

from __future__ import annotations

import math

import numpy as np

from .. import simulators as sim
from ..simulators import Excitation, FloatArray
from .drawing import (
    gain_levels,
    input_range,
    log_uniform,
    noise_free,
    records,
    sample_time,
    samples,
    transfer_function,
    unseen,
    with_encoder,
    with_noise,
)
from .system import Record, Rng, System, Truth, family, rms


@family("rules", linear=True, quick=True)
def first_order_encoder(rng: Rng) -> System:
    """First order, tau 8 to 120; speed from encoder counts, 20 to 40 dB; 600 to 3,000 samples;
    steps, levels or a multisine."""
    tau, (low, high) = log_uniform(rng, 8, 120), input_range(rng)
    truth = transfer_function(*sim.lags(log_uniform(rng, 5, 500), tau))
    signal = Excitation(str(rng.choice(["steps", "levels", "multisine"])), low, high, tau)
    N, lead = samples(rng, 600, 3000), int(3 * tau)
    train = noise_free(truth, signal(rng, N + lead), lead)
    test = unseen(truth, train, lambda: signal(rng, N + lead, inside=0.95), lead)
    noisy = with_encoder(rng, train, rng.uniform(20, 40))
    return System(truth, [noisy], [test], sample_time(rng), gain_levels(low, high, tau))


@family("held", linear=True, quick=True)
def second_order_encoder(rng: Rng) -> System:
    """Second order, two lags of 15 to 100 and 3 to 10 or an oscillation of period 25 to 200 and
    damping .3 to .9; encoder, 20 to 40 dB; 800 to 6,000 samples; steps, levels, multisine, chirp.
    """
    (low, high), gain = input_range(rng), log_uniform(rng, 5, 500)
    if rng.random() < 0.5:
        tau = log_uniform(rng, 15, 100)
        truth = transfer_function(*sim.lags(gain, tau, log_uniform(rng, 3, 10)))
    else:
        period = log_uniform(rng, 25, 200)
        tau = period / 3
        truth = transfer_function(*sim.oscillator(gain, period, rng.uniform(0.3, 0.9)))
    kind = str(rng.choice(["steps", "levels", "multisine", "chirp"]))
    signal = Excitation(kind, low, high, tau)
    N = samples(rng, 800, 6000)
    train = noise_free(truth, signal(rng, N))
    noisy = with_encoder(rng, train, rng.uniform(20, 40))
    test = unseen(truth, train, lambda: signal(rng, N, inside=0.95))
    return System(truth, [noisy], [test], sample_time(rng), gain_levels(low, high, 2 * tau))


@family("rules", linear=True, quick=True)
def prbs_drift(rng: Rng) -> System:
    """Lags of 3 to 12 and .7 to 2.5 about a working point under a two-level PRBS; white noise 25 to
    40 dB and a slow drift of 2 to 8 % of the output; 800 to 2,500 samples. Test: steps between the
    two levels, so a network that bends between them loses."""
    tau = log_uniform(rng, 3, 12)
    low = rng.uniform(0.5, 2)
    high = low + rng.uniform(0.5, 2)
    gain = log_uniform(rng, 10, 300)
    truth = transfer_function(
        *sim.lags(gain, tau, log_uniform(rng, 0.7, 2.5)), offset=-gain * low / 2
    )
    N, lead = samples(rng, 800, 2500), int(12 * tau)
    train = noise_free(truth, Excitation("prbs", low, high, tau)(rng, N + lead), lead)
    signal = Excitation("steps", low, high, tau)
    test = unseen(truth, train, lambda: signal(rng, 1000 + lead, 0.95), lead)
    pole = 1 - log_uniform(rng, 5e-4, 5e-3)
    drift = sim.filtered(np.ones(1), np.array([-pole]), rng.normal(size=N + 2000))[2000:]
    drift *= rng.uniform(0.02, 0.08) * train.y.std() / rms(drift)
    noisy = with_noise(rng, train, rng.uniform(25, 40))
    drifting = Record(noisy.u, noisy.y + drift, noisy.before)
    return System(truth, [drifting], [test], 0.02, gain_levels(low, high, tau))


@family("rules", linear=True, quick=True)
def dead_time(rng: Rng) -> System:
    """Order 1 to 3 behind a dead time of 0 to 5 samples; 20 to 50 dB; 600 to 4,000 samples; steps,
    levels, multisine or PRBS (test: of the same kind)."""
    delay, order = int(rng.integers(0, 6)), int(rng.integers(1, 4))
    tau, (low, high) = log_uniform(rng, 8, 60), input_range(rng)
    taus = [tau, *(tau * rng.uniform(0.1, 0.5) for _ in range(order - 1))]
    truth = transfer_function(*sim.lags(log_uniform(rng, 0.1, 100), *taus, delay=delay))
    signal = Excitation(
        str(rng.choice(["steps", "levels", "multisine", "prbs"])), low, high, tau
    )  # fmt: skip
    N = samples(rng, 600, 4000)
    train, test = records(rng, truth, signal, N, N, rng.uniform(20, 50), lead=int(3 * tau))
    return System(truth, train, test, sample_time(rng))


@family("held", linear=True)
def two_mass(rng: Rng) -> System:
    """Two masses on a shaft, speed at the motor: resonance at .02 to .1 of the sampling rate,
    damping of a few per cent; 20 to 45 dB; 4,000 to 40,000 samples; steps, levels or a chirp."""
    ratio, w = log_uniform(rng, 0.3, 3), 2 * math.pi * rng.uniform(0.02, 0.1)
    J1, J2 = 1.0, ratio
    k = w * w * J1 * J2 / (J1 + J2)
    d = 2 * rng.uniform(0.01, 0.05) * k / w
    tau = log_uniform(rng, 60, 250)
    b = (J1 + J2) / (2 * tau)
    gain = log_uniform(rng, 1, 100)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        J1, J2, k, d, b, K = theta
        A = np.array(
            [[-(b + d) / J1, -k / J1, d / J1], [1, 0, -1], [d / J2, k / J2, -(d + b) / J2]]
        )
        B, C = np.array([[K / J1], [0], [0]]), np.array([[1.0, 0, 0]])
        return sim.filtered(*sim.discretised(A, B, C), u)

    truth = Truth(run, np.array([J1, J2, k, d, b, gain * 2 * b]))
    low, high = input_range(rng)
    signal = Excitation(
        str(rng.choice(["steps", "levels", "chirp"])), low, high, rng.uniform(5, 25)
    )  # fmt: skip
    N = samples(rng, 4000, 40000)
    train, test = records(rng, truth, signal, N, min(N, 10000), rng.uniform(20, 45))
    return System(truth, train, test, sample_time(rng), gain_levels(low, high, tau))


@family("held", linear=True)
def three_inputs(rng: Rng) -> System:
    """Three inputs on a plant of order 2 or 3 with common poles and own zeros and delays (0 to 2);
    20 to 40 dB; 2,000 to 10,000 samples; steps on each."""
    tau = log_uniform(rng, 10, 60)
    taus = [tau, *(tau * rng.uniform(0.1, 0.6) for _ in range(int(rng.integers(1, 3))))]
    _, a = sim.lags(1.0, *taus)
    n, leading = len(a), 1 + rng.integers(0, 3, 3)
    signals = [Excitation("steps", *input_range(rng), tau) for _ in range(3)]
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

    train = noise_free(truth, inputs(samples(rng, 2000, 10000), 1.0))
    test = unseen(truth, train, lambda: inputs(4000, 0.95))
    return System(truth, [with_noise(rng, train, rng.uniform(20, 40))], [test], sample_time(rng))
