"""The problems that every contender is timed on: one drive, its network, controllers, references.

A chirp drives a second-order motor with dead zone, saturation and friction whose speed is read by
an encoder; in the paper's scaling, u/10 and y/1000. The network has 2 past outputs, 2 past inputs,
8 tanh and 49 parameters theta = [W1 (8 x 4) row by row, b1 (8), w2 (8), b2].
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

SAMPLES, HIDDEN, PARAMETERS = 20_000, 8, 49
TS = 1e-3
U_SCALE, Y_SCALE = 10.0, 1000.0
U_MAX = 10.0
TT = 0.2
FILTER = 8
COUNTS_PER_REV = 1572.0
LOOP_SAMPLES = 4000
_NUM, _DEN = (0.1228, 0.1224), (-1.87, 0.8705)
_RPM_PER_COUNT = 60.0 / (TS * COUNTS_PER_REV)


def _static(v: np.ndarray) -> np.ndarray:
    """A smooth dead zone of .25 V, saturation near 8 V."""
    s, zone = 0.05, 0.25
    soft = [s * np.logaddexp(0.0, (side * v - zone) / s) for side in (1.0, -1.0)]
    return 8.0 * np.tanh((soft[0] - soft[1]) / 8.0)


def _speed(v: np.ndarray) -> np.ndarray:
    """True speed [RPM]; Coulomb and quadratic friction count against the input [V]."""
    w, y = _static(v), np.zeros(len(v) + 2)
    m = np.zeros(len(v) + 2)
    for k in range(len(v)):
        at = -_DEN[0] * y[k + 1] - _DEN[1] * y[k] + _NUM[0] * m[k + 1] + _NUM[1] * m[k]
        friction = 0.15 * np.tanh(at / 60.0) + 0.25 * (at / 3000.0) * abs(at / 3000.0)
        y[k + 2], m[k + 2] = at, w[k] - friction
    return y[2:]


def _chirp(samples: int) -> np.ndarray:
    t, duration = np.arange(samples) * TS, samples * TS
    return np.sin(2 * np.pi * (0.1 * t + 1.45 * t * t / duration) - np.pi / 2)


@cache
def _drive() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, y and the true y of 20,000 samples, scaled."""
    rng = np.random.default_rng(7)
    amplitude = np.minimum(1.0, 0.5 + 0.9 * np.linspace(0.0, 1.0, SAMPLES))
    u = 3.0 * amplitude * (1.0 + _chirp(SAMPLES))
    true = _speed(u)
    counts = np.floor(np.cumsum(true) / _RPM_PER_COUNT + rng.uniform())
    y = np.diff(counts, prepend=0.0) * _RPM_PER_COUNT
    return u / U_SCALE, y / Y_SCALE, true / Y_SCALE


def drive(samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """u and y, scaled; the 20,000 samples again and again where more are asked for."""
    u, y, _ = _drive()
    times = -(-samples // SAMPLES)
    return tuple(np.ascontiguousarray(np.tile(v, times)[:samples]) for v in (u, y))


def noisy_drive(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """u and the true y under white noise, scaled: steps of counts are none."""
    u, _, true = _drive()
    times = -(-samples // SAMPLES)
    u, true = (np.tile(v, times)[:samples] for v in (u, true))
    return u.copy(), true + np.random.default_rng(1).normal(0.0, 0.0155, samples)


def start(seed: int = 0, half_width: float = 0.1, hidden: int = HIDDEN) -> np.ndarray:
    """Parameters to begin training from."""
    return np.random.default_rng(seed).uniform(-half_width, half_width, 6 * hidden + 1)


@cache
def trained() -> np.ndarray:
    """Parameters of a network trained on the drive."""
    return np.loadtxt(Path(__file__).with_name("theta.csv"))


def gains(candidates: int) -> np.ndarray:
    """Kp [scaled], Ki [1/s], Kd [s], alpha, beta, N of every candidate, (candidates, 6)."""
    # with more derivative action some loops are chaotic, and their cost a matter of rounding
    low = np.array([0.1, 0.5, 1e-4, 0.0, 0.0, 2.0])
    high = np.array([1.0, 6.0, 3e-3, 0.7, 1.0, 10.0])
    return low + (high - low) * np.random.default_rng(3).random((candidates, 6))


def reference(samples: int = LOOP_SAMPLES) -> np.ndarray:
    """Four levels, scaled."""
    levels = np.array([0.8, 1.3, 0.4, 1.0])
    return levels[np.minimum(np.arange(samples) // 1000, 3)]


def terms(candidates: int) -> dict[str, Any]:
    """The candidates' gains as the loop's arithmetic wants them, in scaled units.

    kp, ki (per sample), kd (on the difference), pole (of the derivative's filter), alpha, beta,
    tracking (share of the excess taken from the integral per sample).
    """
    kp, ki, kd, alpha, beta, n = gains(candidates).T
    lag = kd / kp / n
    return {
        "kp": kp,
        "ki": ki * TS,
        "kd": kd / (lag + TS),
        "pole": lag / (lag + TS),
        "alpha": alpha,
        "beta": beta,
        "tracking": np.full(candidates, TS / TT),
    }
