"""`Memory`: how long a model remembers, by its training inputs in another order.

A network may have several equilibria at an input where the drive has one. Its free run over the
record need not show that, nor a later part of it. The same blocks of input in another order do: the
network then sits on another branch, block after block, where a model with a drive's memory is back
where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..dataset import Dataset, Experiment, FloatArray
from ..errors import FitError
from ..models.base import INIT, Core

BLOCKS = 16
STEPS = (3, 7)
"""Blocks are also gone through by these steps, prime to their number."""
MORE = 1.5
"""Largest ratio to the linear model's memory."""
ROOM = 0.03
"""What may come on top, in widths of the output's range."""


class Simulator(Protocol):
    """What runs freely from a state estimated of first samples."""

    def estimate_initial_state(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """State before the first sample."""

    def simulate(self, u: FloatArray, state: FloatArray) -> FloatArray:
        """Outputs, (N,)."""


@dataclass(frozen=True)
class Memory:
    """What a network may remember of the order of these data's blocks."""

    data: Dataset
    limit: float

    @classmethod
    def of(cls, linear: Sequence[Simulator], data: Dataset) -> Memory:
        """A bound from the longest memory of linear models."""
        return cls(data, MORE * max(remembered(model, data) for model in linear) + ROOM)

    def allows(self, core: Simulator) -> bool:
        """Whether the model's output depends on what was before little more than a linear one's."""
        return remembered(core, self.data) <= self.limit


class Rectified:
    """A linear model behind a sensor that does not see the sign."""

    def __init__(self, linear: Core) -> None:
        self.linear = linear

    def estimate_initial_state(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """As if the sign were positive: the later halves of the blocks do not know."""
        return self.linear.estimate_initial_state(u, y)

    def simulate(self, u: FloatArray, state: FloatArray) -> FloatArray:
        """The size of the linear model's free run."""
        return np.abs(self.linear.simulate(u, state))


def remembered(core: Simulator, data: Dataset) -> float:
    """Mean distance between runs over the record and over its blocks in other orders.

    The second half of every block counts, in widths of the output's range; infinite for a runaway,
    0 for experiments too short to be cut.
    """
    found = [d for e in data.experiments for d in _distances(core, e)]
    low, high = data.output_range
    return float(np.mean(found)) / (high - low) if found and high > low else 0.0


def _distances(core: Simulator, e: Experiment) -> Iterator[float]:
    length = len(e) // BLOCKS
    if length < 2:
        return
    try:
        first = e.initial_samples(INIT)
        state = core.estimate_initial_state(e.u[:first], e.y[:first])
        usual = _later_halves(core.simulate(e.u, state), length)
        for order in _orders(_cut(e.u, length)):
            u = np.ascontiguousarray(np.concatenate([_cut(e.u, length)[i] for i in order]))
            other = _later_halves(core.simulate(u, state), length)
            yield float(np.mean(np.abs(other - usual[list(order)])))
    except FitError:
        yield float("inf")


def _cut(values: FloatArray, length: int) -> FloatArray:
    """Blocks (BLOCKS, length, ..) of a record."""
    whole = values[: BLOCKS * length]
    return whole.reshape(BLOCKS, length, *values.shape[1:])


def _later_halves(run: FloatArray, length: int) -> FloatArray:
    return _cut(run, length)[:, length // 2 :]


def _orders(blocks: FloatArray) -> Iterator[Sequence[int]]:
    """By the mean of each input, rising and falling, and shuffled."""
    for level in blocks.mean(axis=1).T:
        rising = np.argsort(level, kind="stable").tolist()
        yield rising
        yield rising[::-1]
    for step in STEPS:
        yield [(i + 1) * step % BLOCKS for i in range(BLOCKS)]
