"""`Clock` and `Pool`: how long an identification may take, and on how many threads it runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeAlias, TypeVar

Progress: TypeAlias = Callable[[int, int, float], object]
Look: TypeAlias = Callable[[int, int, float], None]
"""Progress callback of a compiled fit; it raises KeyboardInterrupt where the fit has to end."""

T = TypeVar("T")
R = TypeVar("R")

PERIOD = 0.02
"""How often the calling thread looks for Ctrl-C and shows progress [s]."""
STEPS = 1000
"""What progress counts to."""


class Clock:
    """Counts from its making; without a budget it never runs out.

    Attributes
    ----------
    budget : float or None
        Seconds.
    truncated : bool
        Whether the budget has cut anything short: the result then depends on the machine.
    """

    def __init__(self, budget: float | None) -> None:
        self.budget = budget
        self.truncated = False
        self._began = time.perf_counter()

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self._began

    def until(self, share: float) -> float | None:
        """When this share of the budget is used up, on `time.perf_counter`; None without one."""
        return None if self.budget is None else self._began + share * self.budget

    def over(self, share: float = 1.0) -> bool:
        """Whether this share of the budget is used up; remembers that it was."""
        is_over = self.budget is not None and self.spent >= share * self.budget
        self.truncated = self.truncated or is_over
        return is_over

    def limited(self, progress: Progress | None, share: float) -> Progress | None:
        """`progress` that ends a fit, as Ctrl-C would, when this share of the budget is used up."""
        until = self.until(share)
        if until is None:
            return progress

        def look(done: int, total: int, best: float) -> None:
            if progress is not None:
                progress(done, total, best)
            if time.perf_counter() >= until:
                self.truncated = True
                raise KeyboardInterrupt

        return look


class Stopped(Exception):
    """Ctrl-C while work was going on; what it reached is in the search."""


class Pool:
    """Runs compiled work on several threads while the calling one listens.

    Parameters
    ----------
    threads : int
    clock : Clock
    progress : callable(done, total, best) or None
        Called from the calling thread, at most every `PERIOD`.
    """

    def __init__(self, threads: int, clock: Clock, progress: Progress | None) -> None:
        self.threads = threads
        self.clock = clock
        self.progress = progress
        self.share = 0.0
        self.best = float("inf")

    def map(
        self,
        work: Callable[[T, Look], R | None],
        items: Sequence[T],
        *,
        until: float | None = None,
        share: float | None = None,
    ) -> list[R | None]:
        """`work(item, look)` of every item, in their order.

        Parameters
        ----------
        work : callable
            Passes `look` on to the compiled function, which then ends at a deadline or at Ctrl-C
            with its best so far.
        items : sequence
        until : float or None
            Deadline on `time.perf_counter`; items that have not begun by then give None.
        share : float or None
            Part of the whole identification that is done when the items are, for the progress.

        Raises
        ------
        Stopped
            On Ctrl-C.
        """
        stopping = threading.Event()
        began, ended = self.share, self.share if share is None else share

        def look(*_: object) -> None:
            if stopping.is_set() or (until is not None and time.perf_counter() >= until):
                raise KeyboardInterrupt

        def one(item: T) -> R | None:
            try:
                look()
                return work(item, look)
            except KeyboardInterrupt:
                return None

        with ThreadPoolExecutor(min(self.threads, max(len(items), 1))) as threads:
            futures = [threads.submit(one, item) for item in items]
            try:
                self._listen(futures, began, ended)
            except KeyboardInterrupt:
                stopping.set()
                raise Stopped from None
            except BaseException:
                stopping.set()
                raise
        if until is not None and time.perf_counter() >= until:
            self.clock.truncated = True
        self.share = ended
        return [f.result() for f in futures]

    def _listen(self, futures: Sequence[Future[Any]], began: float, ended: float) -> None:
        pending = set(futures)
        while pending:
            # wait() is itself interrupted by a signal
            _, pending = wait(pending, timeout=PERIOD)
            part = 1.0 - len(pending) / len(futures)
            self.show(began + part * (ended - began))

    def show(self, share: float) -> None:
        """Call the progress function, if there is one, with the larger of work and time done."""
        if self.progress is None:
            return
        clock = self.clock
        if clock.budget is not None:
            share = max(share, clock.spent / clock.budget)
        self.progress(min(STEPS, round(STEPS * share)), STEPS, self.best)
