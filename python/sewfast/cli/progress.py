"""`Progress`: one line on a terminal that says how far long work is."""

from __future__ import annotations

import sys
import time
from types import TracebackType

_WIDTH = 24


class Progress:
    """Draws `done/total`, the best cost and the seconds so far; silent where stderr is no terminal.

    Use it in a `with`, which wipes the line at the end.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._began = time.monotonic()
        self._on = sys.stderr.isatty()

    def __call__(self, done: int, total: int, best: float) -> None:
        if not self._on:
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
