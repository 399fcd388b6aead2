"""Where a record changes its sign, scale or time: torn files, turned leads, files that were glued.

What one part of a record says of the output predicts the other once it is multiplied or shifted;
`rust/core/src/changes.rs` has the search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .. import _core

if TYPE_CHECKING:
    from .dataset import Dataset


NOTED = 0.1
"""Share of the output's scale that is worth a word; the search has the same."""


@dataclass(frozen=True)
class Change:
    """From sample `start` of an experiment on, the output is `gain` times what the rest of the
    record says, or what it says for `shift` samples later. `left` is the share of the error that
    this leaves.
    """

    experiment: int
    start: int
    gain: float
    shift: int
    left: float


def changed(data: Dataset) -> Change | None:
    """From where a record has another sign, scale or time than before; None if nowhere."""
    found = _core.changed([(e.u, e.y) for e in data.experiments])
    if found is None:
        return None
    experiment, start, gain, shift, left = found
    return Change(experiment, data.experiments[experiment].start + start, gain, shift, left)
