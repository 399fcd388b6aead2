"""Linear blocks and static curves in a chain."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .. import simulators as sim
from ..simulators import Excitation, FloatArray
from .drawing import (
    log_uniform,
    records,
    sample_time,
    samples,
)
from .system import Rng, System, Truth, family


def second_order(rng: Rng) -> tuple[FloatArray, FloatArray, float]:
    """A second-order block of gain 1 with its time constant: real or complex poles."""
    if rng.random() < 0.5:
        tau = log_uniform(rng, 4, 25)
        return *sim.lags(1.0, tau, tau * rng.uniform(0.2, 0.8)), tau
    period = log_uniform(rng, 15, 80)
    return *sim.oscillator(1.0, period, rng.uniform(0.25, 0.8)), period / 4


def input_curve(rng: Rng) -> tuple[Callable[..., FloatArray], FloatArray]:
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


def output_curve(rng: Rng) -> tuple[Callable[..., FloatArray], FloatArray]:
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
    curve, p = input_curve(rng)
    b, a, tau = second_order(rng)
    delay = int(rng.integers(0, 4))
    scale = log_uniform(rng, 1, 24)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(1 + delay), theta[:2]])
        return sim.filtered(num, theta[2:4], curve(u / scale, theta[4:]))

    truth = Truth(run, np.concatenate([b[1:], a, p]))
    signal = Excitation(
        str(rng.choice(["multisine", "steps", "levels"])), -scale, scale, tau
    )  # fmt: skip
    N = samples(rng, 1000, 6000)
    train, test = records(rng, truth, signal, N, 3000, rng.uniform(25, 45), lead=int(4 * tau))
    return System(truth, train, test, sample_time(rng))


@family("held", quick=True)
def wiener(rng: Rng) -> System:
    """Second order and a delay of 0 to 2, then a saturation on one side, on both, or an
    exponential; 25 to 45 dB; 600 to 3,000 samples; multisine, steps or levels."""
    curve, p = output_curve(rng)
    b, a, tau = second_order(rng)
    delay = int(rng.integers(0, 3))
    scale, gain = log_uniform(rng, 1, 24), log_uniform(rng, 0.1, 100)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(1 + delay), theta[:2]])
        return theta[4] * curve(sim.filtered(num, theta[2:4], u / scale), theta[5:])

    signal = Excitation(
        str(rng.choice(["multisine", "steps", "levels"])), -scale, scale, tau
    )  # fmt: skip
    N = samples(rng, 600, 3000)
    # the linear block's gain brings what enters the curve to +-1.3
    x = sim.filtered(b, a, signal(rng, 5000) / scale)
    truth = Truth(run, np.concatenate([1.3 * b[1:] / np.abs(x).max(), a, [gain], p]))
    train, test = records(rng, truth, signal, N, 2000, rng.uniform(25, 45), lead=int(4 * tau))
    return System(truth, train, test, sample_time(rng))


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
    signal = Excitation("multisine", -1.8, 1.8, log_uniform(rng, 2, 5))
    N = samples(rng, 20000, 100000)
    train, test = records(rng, truth, signal, N, 20000, rng.uniform(45, 60), lead=200)
    return System(truth, train, test, 1 / 51200)


@family("held")
def hammerstein_wiener(rng: Rng) -> System:
    """A static curve, order 2 to 4, a static curve that rises; 30 to 50 dB; 10,000 to 60,000
    samples; multisine or steps."""
    first, p = input_curve(rng)
    last, q = output_curve(rng)
    b, a, tau = second_order(rng)
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
    N = samples(rng, 10000, 60000)
    train, test = records(rng, truth, signal, N, 10000, rng.uniform(30, 50), lead=int(5 * tau))
    return System(truth, train, test, sample_time(rng))
