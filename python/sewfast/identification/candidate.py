"""`Candidate`: one structure after its trial, as a line of the table that is chosen from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .. import _core
from ..models.ensemble import EnsembleCore
from .folds import Split, held_out_error
from .task import Story, finite
from .training import Start, Structure

WORST = 3.0
"""Members whose J exceeds this multiple of the best one's are dropped."""


@dataclass(frozen=True)
class Candidate:
    """A structure, its trained starts, and the held-out free-run error of their median."""

    structure: Structure
    starts: tuple[Start, ...]
    error: float

    @property
    def agreement(self) -> float:
        """Part of the starts that passes the guard and is not far worse than the best.

        Where it is small, the data do not fix the network.
        """
        return self.agreeing / len(self.starts) if self.starts else 0.0

    @property
    def agreeing(self) -> int:
        """Number of those starts."""
        return sum(s.is_sound for s in members(self.starts))

    def is_better(self, other: Candidate, worth: float) -> bool:
        """Whether the error is below that part of the other's; a start that is sound goes first."""
        if (self.agreement > 0.0) != (other.agreement > 0.0):
            return self.agreement > 0.0
        return self.error < worth * other.error

    @property
    def members(self) -> list[_core.NeuralSS]:
        """The starts that count, best first."""
        return [s.model for s in members(self.starts)]

    def to_json(self) -> Story:
        """For the table."""
        return {
            "kind": "neural_ss",
            **self.structure.to_json(),
            "starts": len(self.starts),
            "free_run_rmse": finite(self.error),
        }


def members(starts: Sequence[Start]) -> list[Start]:
    """Starts that passed the guard, unless none did, and that are not far worse than the best."""
    able = [s for s in starts if s.is_sound] or list(starts)
    able = sorted(able, key=lambda s: s.cost)
    return [s for s in able if s.cost <= WORST * able[0].cost]


def judged(structure: Structure, starts: Sequence[Start], split: Split) -> Candidate:
    """The candidate with the error of its members' median."""
    kept = [s.model for s in members(starts)]
    error = held_out_error(EnsembleCore(tuple(kept), "median"), split) if kept else math.inf
    return Candidate(structure, tuple(starts), error)


def pooled(errors: Sequence[float]) -> float:
    """Geometric mean: a fold counts by its ratio to another model's error, not by its size."""
    if not errors or not all(map(math.isfinite, errors)):
        return math.inf
    return math.exp(sum(math.log(max(e, 1e-300)) for e in errors) / len(errors))
