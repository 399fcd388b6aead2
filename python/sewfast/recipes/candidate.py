"""`Candidate`: one structure after its trial, as a line of the table that is chosen from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .. import _core
from ..models.ensemble import EnsembleCore
from .holdout import Split, held_out_error
from .structure import Start, Structure
from .task import Story, finite

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
        """Part of the starts that counts: where it is small, the data do not fix the network."""
        return len(members(self.starts)) / len(self.starts) if self.starts else 0.0

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
    error = held_out_error(EnsembleCore(tuple(kept), "median"), split) if kept else float("inf")
    return Candidate(structure, tuple(starts), error)
