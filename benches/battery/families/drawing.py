"""Draws of sizes and inputs, and records made of them: with noise, by an encoder, unseen."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .. import simulators as sim
from ..simulators import Excitation, FloatArray
from .system import Record, Rng, Truth


def log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def samples(rng: Rng, low: int, high: int) -> int:
    """A number of samples, in hundreds."""
    return int(round(log_uniform(rng, low, high), -2))


def sample_time(rng: Rng) -> float:
    """A sample time [s]: a label, for all else is counted in samples."""
    return float(rng.choice([0.001, 0.002, 0.005, 0.01, 0.02]))


def noise_free(truth: Truth, u: FloatArray, lead: int = 0) -> Record:
    """The noise-free record of an input, of which the first `lead` samples are cut off."""
    before = u[:lead]
    return Record(u[lead:], truth.run(truth.theta, u)[lead:], before)


def with_noise(rng: Rng, record: Record, decibels: float) -> Record:
    """White noise, this far below the output's standard deviation."""
    sd = record.y.std() * 10 ** (-decibels / 20)
    return Record(record.u, record.y + sd * rng.normal(size=len(record.y)), record.before)


def with_encoder(rng: Rng, record: Record, decibels: float) -> Record:
    """A speed by differences of whole counts, as coarse as to give this signal to noise.

    The output is the mean speed between two samples, so counting adds noise and no delay: the
    difference of two errors that are evenly spread over a count.
    """
    count = record.y.std() * 10 ** (-decibels / 20) * math.sqrt(6)
    place = np.floor(np.cumsum(record.y) / count + rng.random())
    y = count * np.diff(place, prepend=np.floor(rng.random()))
    y[0] = record.y[0]
    return Record(record.u, y, record.before)


def within_range(train: Record, draw: Callable[[], Record]) -> Record:
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


def unseen(
    truth: Truth, train: Record, draw: Callable[[], FloatArray], lead: int = 0
) -> Record:  # fmt: skip
    """The test record of inputs drawn and kept within the range of the training's."""
    low, high = train.u.min(axis=0), train.u.max(axis=0)
    return within_range(train, lambda: noise_free(truth, np.clip(draw(), low, high), lead))


def records(
    rng: Rng, truth: Truth, signal: Excitation, N: int, tested: int, decibels: float, lead: int = 0
) -> tuple[list[Record], list[Record]]:
    """A noisy training record and a test record of the same kind, a little inside its range."""
    train = with_noise(rng, noise_free(truth, signal(rng, N + lead), lead), decibels)
    return [train], [unseen(truth, train, lambda: signal(rng, tested + lead, inside=0.95), lead)]


def transfer_function(b: FloatArray, a: FloatArray, offset: float | None = None) -> Truth:
    """A transfer function; leading zeros of b are a delay and no parameters."""
    delay = int(np.flatnonzero(b)[0])
    nb, na = len(b) - delay, len(a)

    def run(theta: FloatArray, u: FloatArray) -> FloatArray:
        num = np.concatenate([np.zeros(delay), theta[:nb]])
        y = sim.filtered(num, theta[nb : nb + na], u)
        return y if offset is None else y + theta[-1]

    tail = [] if offset is None else [offset]
    return Truth(run, np.concatenate([b[delay:], a, tail]))


def input_range(rng: Rng) -> tuple[float, float]:
    """A range of input: both signs, or one."""
    top = log_uniform(rng, 0.5, 24)
    return (-top, top) if rng.random() < 0.6 else (0.1 * top, top)


def gain_levels(low: float, high: float, tau: float) -> tuple[float, float, int]:
    """From a quarter to three quarters of the largest input."""
    start = max(low, 0.0)
    return start + 0.25 * (high - start), start + 0.75 * (high - start), int(20 * tau)
