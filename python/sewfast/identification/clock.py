"""`Clock`: how much of a time budget is left."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int, float], object]


class Clock:
    """Counts from its making; without a budget it never runs out.

    Attributes
    ----------
    budget : float or None
        Seconds.
    bit : bool
        Whether the budget has cut anything short: what comes out then depends on the machine.
    """

    def __init__(self, budget: float | None) -> None:
        self.budget = budget
        self.bit = False
        self._began = time.perf_counter()

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self._began

    @property
    def left(self) -> float | None:
        """Seconds until the budget is used up; None without a budget."""
        return None if self.budget is None else max(0.0, self.budget - self.spent)

    def over(self, share: float = 1.0) -> bool:
        """Whether this share of the budget is used up; remembers that it was."""
        is_over = self.budget is not None and self.spent >= share * self.budget
        self.bit = self.bit or is_over
        return is_over


def stopping(progress: Progress | None, seconds: float | None) -> Progress | None:
    """`progress` that also ends the work after so many seconds, as Ctrl-C would.

    The core returns its best so far on a `KeyboardInterrupt` of its progress function, with the
    termination `interrupted`.
    """
    if seconds is None:
        return progress
    end = time.perf_counter() + seconds

    def look(done: int, total: int, best: float) -> None:
        if progress is not None:
            progress(done, total, best)
        if time.perf_counter() >= end:
            raise KeyboardInterrupt

    return look
