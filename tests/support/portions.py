"""Work of hours, a portion each night: a state file says where the next run goes on."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def portion(work: Sequence[T], state: Path | None, minutes: float) -> Iterator[T]:
    """What to do now: each piece once, from where the last run stopped, until the time is over.

    Parameters
    ----------
    work : sequence
        Pieces whose `str` names them.
    state : Path, optional
        File that holds the name of the piece that comes next; written before each piece, so that
        one that was interrupted is done again. Without it the work begins with its first piece.
    minutes : float
        No piece begins later than this; the first always does.
    """
    names = [str(piece) for piece in work]
    last = state.read_text() if state is not None and state.exists() else ""
    first = names.index(last) if last in names else 0
    end = time.monotonic() + 60.0 * minutes
    for k in [*range(first, len(work)), *range(first)]:
        if state is not None:
            state.parent.mkdir(parents=True, exist_ok=True)
            state.write_text(names[k])
        if k != first and time.monotonic() > end:
            return
        yield work[k]
    if state is not None and names:
        state.write_text(names[first])
