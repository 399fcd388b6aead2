"""What a family draws: a system, its truth and its records; the table of families."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from sewfast import Dataset

from ..simulators import FloatArray

Rng: TypeAlias = np.random.Generator
Split: TypeAlias = Literal["rules", "held"]
Levels: TypeAlias = tuple[float, float, int]
"""Two inputs, and the samples for which each is held."""


@dataclass(frozen=True, eq=False)
class Record:
    """One recording; `before` are the inputs that led up to it from rest, which no model sees."""

    u: FloatArray
    y: FloatArray
    before: FloatArray


@dataclass(frozen=True, eq=False)
class Truth:
    """The structure that made the data, with the parameters it had.

    Parameters
    ----------
    run : callable(theta, u) -> y
        Free run from rest, (N,) or (N, n_inputs) to (N,).
    theta : array, shape (p,)
    kinked : bool
        The error has kinks in the parameters (backlash), so a refit should not rely on derivatives.
    """

    run: Callable[[FloatArray, FloatArray], FloatArray]
    theta: FloatArray
    kinked: bool = False

    def simulate(self, record: Record, theta: FloatArray | None = None) -> FloatArray:
        """Noise-free output over a record."""
        u = np.concatenate([record.before, record.u])
        return self.run(self.theta if theta is None else theta, u)[len(record.before) :]


@dataclass(frozen=True, eq=False)
class Case:
    """One system of a family.

    Attributes
    ----------
    train, test : tuple of Record
        Test outputs are free of noise.
    Ts : float
        Sample time [s].
    n : int
        The first outputs of a test record, which set the initial state; they are not scored.
    is_linear : bool
        The truth is linear (perhaps with an offset).
    noise : float
        Root mean square of training output minus the truth's free run from the same input.
    gain_probe : array or None
        Two constant inputs, one after the other, each held until a motor has settled: the steady
        gain is the difference of the last outputs over that of the inputs. None: not a motor.
    range_probe : array or None
        The same between the ends of the recorded input: the gain that the record itself shows.
    """

    family: str
    seed: int
    train: tuple[Record, ...]
    test: tuple[Record, ...]
    Ts: float
    n: int
    is_linear: bool
    truth: Truth
    noise: float
    gain_probe: FloatArray | None = None
    range_probe: FloatArray | None = None

    @property
    def training(self) -> Dataset:
        """What `identify` gets."""
        return Dataset.concat(self.dataset(r.u, r.y) for r in self.train)

    def dataset(self, u: FloatArray, y: FloatArray | None) -> Dataset:
        """A record of this case as a data set."""
        return Dataset.from_arrays(u, y, self.Ts, name=f"{self.family}/{self.seed}")

    @property
    def samples(self) -> int:
        """To learn from."""
        return sum(len(r.y) for r in self.train)


@dataclass(frozen=True)
class Family:
    """How to draw a case; what its function draws is in the docstring."""

    name: str
    split: Split
    draw: Callable[[Rng], System]
    is_linear: bool = False
    quick: bool = False


@dataclass(frozen=True, eq=False)
class System:
    """What a family draws; `gain_levels` are two inputs and the samples to hold each."""

    truth: Truth
    train: Sequence[Record]
    test: Sequence[Record]
    Ts: float = 0.001
    gain_levels: Levels | None = None
    inputs: int = 1


FAMILIES: dict[str, Family] = {}


def family(
    split: Split, *, linear: bool = False, quick: bool = False
) -> Callable[[Callable[[Rng], System]], Callable[[Rng], System]]:
    """Enter a function that draws a system; `quick`: small and cheap, for tests and QUICK=1."""

    def entered(draw: Callable[[Rng], System]) -> Callable[[Rng], System]:
        name = draw.__name__
        FAMILIES[name] = Family(name, split, draw, linear, quick)
        return draw

    return entered


def rms(x: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))
