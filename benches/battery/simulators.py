"""Excitations, and simulators that numba compiles where it is installed (extra `bench`).

Time is counted in samples throughout: a time constant of 30 is 30 samples, a frequency of .1 is a
tenth of the sampling rate. The sample time of a case is only a label. Simulators begin at rest.
Differential equations are integrated by Euler's method with `sub` steps a sample; what a record
holds is that integration, so a parametric fit by the same simulator has no discretisation error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]

try:
    from numba import njit
except ImportError:
    IS_COMPILED = False

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        """The function itself: numba is not installed, and everything takes longer."""
        return function

else:
    IS_COMPILED = True
    # compiled once for all processes and sessions; kept in __pycache__
    compiled = njit(cache=True)


# --- excitations ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Excitation:
    """A kind of input signal with its range, made anew for every record.

    Parameters
    ----------
    kind : {"steps", "levels", "prbs", "multisine", "chirp"}
        `steps`: random levels held for half to five time constants; `levels`: random levels of
        equal length; `prbs`: two levels; `multisine`: random phases, flat up to four times the
        corner frequency; `chirp`: a sine from a twentieth of the corner frequency to five times it.
    low, high : float
        Range, which every record of some length reaches.
    tau : float
        Dominant time constant of the plant [samples].
    """

    kind: str
    low: float
    high: float
    tau: float

    def __call__(self, rng: np.random.Generator, N: int, inside: float = 1.0) -> FloatArray:
        """N samples; `inside` below 1 narrows the range about its middle."""
        middle, half = (self.low + self.high) / 2, inside * (self.high - self.low) / 2
        corner = 1 / (2 * math.pi * self.tau)
        if self.kind == "steps":
            unit = steps(rng, N, -1, 1, max(2, self.tau / 2), max(5, 5 * self.tau))
        elif self.kind == "levels":
            hold = max(2, round(self.tau))
            unit = steps(rng, N, -1, 1, hold, hold)
        elif self.kind == "prbs":
            hold = max(2, round(0.7 * self.tau))
            unit = np.repeat(rng.choice([-1.0, 1.0], N // hold + 1), hold)[:N]
        elif self.kind == "multisine":
            unit = multisine(rng, N, min(0.3, 4 * corner))
        elif self.kind == "chirp":
            unit = chirp(N, corner / 20, min(0.3, 5 * corner))
        else:
            raise ValueError(f"kind: no excitation is called {self.kind!r}")
        return middle + half * unit


def steps(
    rng: np.random.Generator, N: int, low: float, high: float, shortest: float, longest: float
) -> FloatArray:
    """Random levels held for a random time; the lowest and the highest are among them."""
    holds: list[int] = []
    while sum(holds) < N:
        holds.append(int(rng.integers(round(shortest), round(longest) + 1)))
    levels = rng.uniform(low, high, len(holds))
    if len(holds) > 2:
        levels[rng.choice(len(holds) - 1, 2, replace=False)] = low, high
    return np.repeat(levels, holds)[:N]


def multisine(rng: np.random.Generator, N: int, highest: float) -> FloatArray:
    """Random phases and a flat spectrum up to a frequency [1/sample]; from -1 to 1."""
    frequency = np.fft.rfftfreq(N)
    inside = (frequency > 0) & (frequency < highest)
    phase = rng.uniform(0, 2 * np.pi, len(frequency))
    x = np.fft.irfft(np.where(inside, np.exp(1j * phase), 0), N)
    return 2 * (x - x.min()) / (x.max() - x.min()) - 1


def chirp(N: int, first: float, last: float) -> FloatArray:
    """A sine of amplitude 1 whose frequency [1/sample] rises linearly."""
    t = np.arange(N)
    return np.sin(2 * np.pi * (first * t + (last - first) * t * t / (2 * N)))


# --- linear systems -------------------------------------------------------------------------------


def filtered(b: FloatArray, a: FloatArray, u: FloatArray) -> FloatArray:
    """y = B/A u with a = [a_1, .., a_n] (the leading 1 is left out), from rest."""
    from scipy.signal import lfilter

    y: FloatArray = lfilter(b, np.concatenate([[1.0], a]), u)
    return y


def discretised(
    A: FloatArray, B: FloatArray, C: FloatArray, delay: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator [a_1, ..] of a strictly proper system held by a zero-order hold."""
    from scipy.signal import cont2discrete, ss2tf

    Ad, Bd, Cd, Dd, _ = cont2discrete((A, B, C, np.zeros((1, 1))), 1.0)
    b, a = ss2tf(Ad, Bd, Cd, Dd)
    return np.concatenate([np.zeros(delay + 1), b[0, 1:]]), a[1:]


def lags(gain: float, *taus: float, delay: int = 0) -> tuple[FloatArray, FloatArray]:
    """First-order lags in series, as `discretised`."""
    n = len(taus)
    A = np.diag([-1 / t for t in taus]) + np.diag([1 / t for t in taus[1:]], -1)
    B, C = np.zeros((n, 1)), np.zeros((1, n))
    B[0, 0], C[0, -1] = gain / taus[0], 1.0
    return discretised(A, B, C, delay)


def oscillator(
    gain: float, period: float, damping: float, delay: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Second order with complex poles, as `discretised`; `period` is 1 / natural frequency."""
    w = 2 * math.pi / period
    A = np.array([[0.0, 1.0], [-w * w, -2 * damping * w]])
    return discretised(A, np.array([[0.0], [gain * w * w]]), np.array([[1.0, 0.0]]), delay)


# --- motors and drives ----------------------------------------------------------------------------


@compiled
def _friction(w: float, coulomb: float, static: float, stribeck: float) -> float:
    """Stribeck's curve; the sign is smoothed over a tenth of the Stribeck speed."""
    level = coulomb + (static - coulomb) * math.exp(-((w / stribeck) ** 2))
    return level * math.tanh(w / (0.1 * stribeck))


@compiled
def motor(
    u: FloatArray, load: FloatArray, sub: int, J: float, B: float, K: float,
    coulomb: float, static: float, stribeck: float, dead: float, limit: float,
) -> FloatArray:  # fmt: skip
    """Speed of a DC motor (resistance 1): J w' = i - B w - friction(w) - load, i = limit(v - K w).

    v is the input behind a dead zone of +-`dead`; `limit` bounds the current. Unlimited and without
    friction its gain is 1 / (K + B) and its time constant J / (K + B).
    """
    N = len(u)
    y = np.empty(N)
    w = 0.0
    for k in range(N):
        y[k] = w
        v, T = float(u[k]), float(load[k])
        v = math.copysign(max(abs(v) - dead, 0.0), v)
        for _ in range(sub):
            i = min(max(v - K * w, -limit), limit)
            w += (i - B * w - _friction(w, coulomb, static, stribeck) - T) / (J * sub)
    return y


@compiled
def motor_loop(
    r: FloatArray, noise: FloatArray, top: float, Kp: float, Ti: float, sub: int, J: float,
    B: float, K: float, coulomb: float, static: float, stribeck: float, dead: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The same motor under a speed PI controller that sees the noise; its input and its speed."""
    N = len(r)
    u, y = np.empty(N), np.empty(N)
    w, integral = 0.0, 0.0
    for k in range(N):
        y[k] = w
        e = float(r[k]) - w - float(noise[k])
        wanted = Kp * e + integral
        v = min(max(wanted, -top), top)
        # the integrator stands still while the output is limited
        if v == wanted:
            integral += Kp * e / Ti
        u[k] = v
        v = math.copysign(max(abs(v) - dead, 0.0), v)
        for _ in range(sub):
            i = v - K * w
            w += (i - B * w - _friction(w, coulomb, static, stribeck)) / (J * sub)
    return u, y


@compiled
def _slide_step(
    q: float, v: float, force: float, M: float, viscous: float, ahead: float, back: float,
    offset: float,
) -> tuple[float, float]:  # fmt: skip
    """One sample of a carriage, four Euler steps; `ahead` and `back` are Coulomb frictions."""
    for _ in range(4):
        # the sign of v is smoothed: within 2e-6 a sample friction falls to zero
        sign = math.tanh(v / 2e-6)
        coulomb = ahead if v > 0 else back
        v += 0.25 / M * (force - viscous * v - coulomb * sign - offset)
        q += 0.25 * v
    return q, v


@compiled
def slide(
    u: FloatArray, M: float, viscous: float, ahead: float, back: float, offset: float
) -> FloatArray:
    """Position of a carriage on a rail under a force: an integrator with friction."""
    N = len(u)
    y = np.empty(N)
    q, v = 0.0, 0.0
    for k in range(N):
        y[k] = q
        q, v = _slide_step(q, v, float(u[k]), M, viscous, ahead, back, offset)
    return y


@compiled
def slide_loop(
    r: FloatArray, pulses: FloatArray, drift: FloatArray, low: float, high: float, kp: float,
    kv: float, M: float, viscous: float, ahead: float, back: float, offset: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The same under a cascade of position P and speed P; the force applied and the position.

    `pulses` are added to the force and recorded with it; `drift` acts on the carriage unrecorded.
    """
    N = len(r)
    u, y = np.empty(N), np.empty(N)
    q, v = 0.0, 0.0
    for k in range(N):
        y[k] = q
        force = kv * (kp * (float(r[k]) - q) - v) + float(pulses[k])
        force = min(max(force, low), high)
        u[k] = force
        q, v = _slide_step(q, v, force, M, viscous, ahead, back, offset + float(drift[k]))
    return u, y


@compiled
def backlash(x: FloatArray, gap: float) -> FloatArray:
    """What a loose coupling hands on: nothing until the gap of +-`gap` is closed."""
    N = len(x)
    y = np.empty(N)
    z = 0.0
    for k in range(N):
        z = min(max(z, float(x[k]) - gap), float(x[k]) + gap)
        y[k] = z
    return y


# --- other plants ---------------------------------------------------------------------------------


@compiled
def tanks(u: FloatArray, upper: float, lower: float, pump: float, spill: float) -> FloatArray:
    """Level of the lower of two tanks of height 10; a part of what overflows above falls in."""
    N = len(u)
    y = np.empty(N)
    x1, x2 = 3.0, 3.0
    for k in range(N):
        y[k] = x2
        inflow = pump * float(u[k])
        for _ in range(8):
            q1, q2 = upper * math.sqrt(max(x1, 0.0)), lower * math.sqrt(max(x2, 0.0))
            x1 += (inflow - q1) / 8
            over = max(x1 - 10.0, 0.0)
            x1 = min(max(x1, 0.0), 10.0)
            x2 = min(max(x2 + (q1 - q2) / 8 + spill * over, 0.0), 10.0)
    return y


@compiled
def bouc_wen(
    u: FloatArray, M: float, c: float, k: float, alpha: float, beta: float, gamma: float,
    delta: float,
) -> FloatArray:  # fmt: skip
    """Displacement of a mass on a hysteretic spring (Bouc and Wen), 20 steps a sample."""
    N = len(u)
    y = np.empty(N)
    x, v, z, h = 0.0, 0.0, 0.0, 0.05
    for i in range(N):
        y[i] = x
        force = float(u[i])
        for _ in range(20):
            rate = alpha * v - beta * (gamma * abs(v) * z + delta * v * abs(z))
            v += h / M * (force - c * v - k * x - z)
            x += h * v
            z += h * rate
    return y


@compiled
def duffing(u: FloatArray, w: float, damping: float, cubic: float) -> FloatArray:
    """Displacement of a mass on a hardening spring: x'' = w^2 (u - x - cubic x^3) - 2 D w x'."""
    N = len(u)
    y = np.empty(N)
    x, v, h = 0.0, 0.0, 0.125
    for i in range(N):
        y[i] = x
        force = float(u[i])
        for _ in range(8):
            v += h * (w * w * (force - x - cubic * x * x * x) - 2 * damping * w * v)
            x += h * v
    return y


@compiled
def bilinear(u: FloatArray, tau: float, actuator: float, alpha: float, gain: float) -> FloatArray:
    """tau y' = gain a - (1 + alpha a) y behind an actuator lag a of u: flow that also carries
    away."""
    N = len(u)
    y = np.empty(N)
    a, x = 0.0, 0.0
    for k in range(N):
        y[k] = x
        target = float(u[k])
        for _ in range(4):
            x += 0.25 / tau * (gain * a - (1 + alpha * a) * x)
            a += 0.25 / actuator * (target - a)
    return y


@compiled
def scheduled(
    u: FloatArray, actuator: float, tau: float, slower: float, gain: float, weaker: float
) -> FloatArray:
    """A lag whose time constant and gain change with its output (of size 1), behind an actuator."""
    N = len(u)
    y = np.empty(N)
    a, x = 0.0, 0.0
    for k in range(N):
        y[k] = x
        target = float(u[k])
        for _ in range(4):
            x += 0.25 * (gain * a - x * (1 + weaker * abs(x))) / (tau * (1 + slower * abs(x)))
            a += 0.25 / actuator * (target - a)
    return y
