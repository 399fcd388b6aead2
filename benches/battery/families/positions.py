"""Positions with dry friction, recorded in closed loop: an integrator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import simulators as sim
from ..simulators import FloatArray
from .drawing import (
    log_uniform,
    samples,
    with_noise,
    within_range,
)
from .system import Record, Rng, System, Truth, family


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
    M, coulomb = log_uniform(rng, 0.5, 4), rng.uniform(0.1, 0.4)
    uneven = rng.uniform(1.2, 1.6) if rng.random() < 1 / 3 else 1.0
    theta = [
        M * 1e6,
        log_uniform(rng, 1, 4) * 1e3,
        coulomb,
        coulomb * uneven,
        rng.uniform(0.01, 0.05),
    ]
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

    train = run(samples(rng, 8000, 20000), s.stroke, (-20.0, 20.0))
    limits = train.u.min(), train.u.max()
    test = within_range(train, lambda: run(10000, 0.9 * s.stroke, limits))
    noisy = with_noise(rng, train, rng.uniform(50, 60))
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
    N = samples(rng, 12000, 24000)
    r = np.tile(one, N // len(one) + 1)[:N]
    drift = _offset_drift(rng, N, s.theta[2] * rng.uniform(0.01, 0.03) * (rng.random() < 0.5))
    u, y = s.run(r, np.zeros(N), drift, (-20.0, 20.0))
    noisy = with_noise(rng, Record(u, y, none), rng.uniform(50, 60))
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
    inertia, top = log_uniform(rng, 1e-3, 1e-2) * 1e6, rng.uniform(0.5, 2.0)
    coulomb = top * log_uniform(rng, 0.05, 0.25)
    theta = np.array([inertia, log_uniform(rng, 0.5, 3.0) * inertia * 1e-3, coulomb, coulomb, 0.0])
    kp = rng.uniform(0.008, 0.02)
    s = _Slide(theta, kp, inertia * kp * rng.uniform(3, 5), 1.0)
    reach = 0.25 * top / inertia / kp**2

    def run(N: int, limits: tuple[float, float]) -> Record:
        levels = np.repeat(rng.uniform(-reach, reach, N // 400 + 1), rng.integers(400, 900))[:N]
        u, y = s.run(levels, np.zeros(N), np.zeros(N), limits)
        return Record(u, y, np.zeros(0))

    train = run(samples(rng, 6000, 16000), (-top, top))
    limits = float(train.u.min()), float(train.u.max())
    test = within_range(train, lambda: run(8000, limits))
    return System(s.truth, [with_noise(rng, train, rng.uniform(40, 55))], [test])
