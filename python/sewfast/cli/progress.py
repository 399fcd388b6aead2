"""`Progress`: how far long work is: one line on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType

_WIDTH = 24
_FIRST_LINE, _LATER = 10.0, 1.5
"""Where stderr is no terminal: seconds until the first line, and the factor to each next one."""


class Progress:
    """Draws `done/total`, the best cost and the seconds so far on a terminal.

    Where stderr is no terminal (a file, a pipe, a build's log) it prints a line of its own after
    10 s and then at growing intervals, so that nobody takes long work for a hang. Use it in a
    `with`, which wipes the line at the end.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._began = time.monotonic()
        self._on = sys.stderr.isatty()
        self._next = _FIRST_LINE

    def __call__(self, done: int, total: int, best: float) -> None:
        if not self._on:
            self._now_and_then(f"{100 * done / max(total, 1):.0f} %, best {best:.4g}")
            return
        filled = _WIDTH * done // max(total, 1)
        bar = "=" * filled + " " * (_WIDTH - filled)
        seconds = time.monotonic() - self._began
        self._draw(f"{self._title} [{bar}] {done}/{total}  best {best:.4g}  {seconds:.0f} s")

    def count(self, done: int, total: int) -> None:
        """Show work that has steps but no cost."""
        if self._on:
            filled = _WIDTH * done // max(total, 1)
            bar = "=" * filled + " " * (_WIDTH - filled)
            seconds = time.monotonic() - self._began
            self._draw(f"{self._title} [{bar}] {done}/{total}  {seconds:.0f} s")

    def say(self, text: str) -> None:
        """Show a stage that has no steps to count."""
        if self._on:
            self._draw(f"{self._title}: {text}  {time.monotonic() - self._began:.0f} s")

    def _now_and_then(self, text: str) -> None:
        seconds = time.monotonic() - self._began
        if seconds >= self._next:
            self._next = _LATER * seconds
            print(f"{self._title}: {text}, {seconds:.0f} s", file=sys.stderr, flush=True)

    def _draw(self, line: str) -> None:
        # back to the first column, the line, then clear what an older one left
        print(f"\r{line}\x1b[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._on:
            self._draw("")
