"""Progress of long work: a bar in a terminal or a notebook, an occasional line elsewhere.

With Python's logger `sewfast` at level INFO, these lines go to the log instead.
"""

from __future__ import annotations

import html
import logging
import math
import sys
import threading
import time
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

LOG = logging.getLogger(__package__)
_FIRST_LINE, _LATER = 10.0, 1.5
"""Without a terminal: time of the first line [s], and the factor from each line to the next."""
_FIRST_BAR, _BETWEEN = 0.5, 0.2
"""In a notebook: time until the bar appears, and shortest time between two updates [s]."""
_shown = threading.local()
"""Whether a bar is shown already: work that starts other work shows only its own bar."""


class TimeUp(KeyboardInterrupt):
    """Raised by a progress callback at the end of a time budget.
    Compiled work stops and returns its best result, as after Ctrl-C. A result that is complete by
    then is kept, whereas Ctrl-C still interrupts the caller.
    """


def latest(seconds: float) -> float:
    """When a call with this time budget has to be back, whatever else the computer does [s]."""
    return 1.1 * seconds + 0.5


class Progress:
    """Shows `done/total`, the best cost or the stage, and the elapsed seconds, until its `with`
    block ends. On a terminal it redraws one line; in a notebook a bar appears after half a second.
    Elsewhere (a file, a pipe, a build's log) it prints a line after 10 s and then at growing
    intervals. `title` names the work, such as `identify`, and `value` the number shown with the
    counts.
    """

    def __init__(self, title: str, value: str = "best", *, quiet: bool = False) -> None:
        self._title = title
        self._value = value
        self._began = time.monotonic()
        self._bar = _Bar() if in_notebook() and not quiet else None
        self._on = self._bar is None and not quiet and sys.stderr.isatty()
        self._next = math.inf if quiet else _FIRST_LINE

    def __call__(self, done: int, total: int, best: float | str) -> None:
        """Show the steps done, with a number (a cost) or a text (a stage)."""
        if isinstance(best, str):
            text = best
        else:
            text = f"{self._value} {best:.4g}" if math.isfinite(best) else ""
        self._show(done / max(total, 1), f"{done}/{total}", text)

    def count(self, done: int, total: int) -> None:
        """Show the steps done, without a cost."""
        self._show(done / max(total, 1), f"{done}/{total}", "")

    def say(self, text: str) -> None:
        """Show a stage without steps."""
        self._show(None, "", text)

    def _show(self, share: float | None, count: str, text: str) -> None:
        width = 24
        seconds = time.monotonic() - self._began
        if self._bar is not None:
            self._bar.draw(self._title, share, "  ".join(filter(None, (count, text))), seconds)
        elif self._on:
            if share is None:
                self._draw(f"{self._title}: {text}  {seconds:.0f} s")
            else:
                filled = min(int(width * share), width)
                bar = "=" * filled + " " * (width - filled)
                parts = (f"{self._title} [{bar}] {count}", text, f"{seconds:.0f} s")
                self._draw("  ".join(filter(None, parts)))
        elif seconds >= self._next:
            self._next = _LATER * seconds
            percent = "" if share is None else f"{100 * share:.0f} %"
            shown = ", ".join(filter(None, (percent, text)))
            self._line(f"{self._title}: {shown}, {seconds:.0f} s")

    def _line(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    def _draw(self, line: str) -> None:
        # back to the first column, the line, then clear the rest of a longer, older line
        print(f"\r{line}\x1b[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            self._bar.remove()
        elif self._on:
            self._draw("")


def in_notebook() -> bool:
    """Whether this code runs in a notebook: IPython with a kernel."""
    shell: Any = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def shown_in_notebooks(
    title: str, value: str = "best"
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a function with a `progress` argument to show progress when a caller omits it.
    A notebook shows a bar; at level INFO the logger `sewfast` gets an occasional line, and the
    duration at the end. This happens only in the main thread, where cells run, and only for the
    outermost work. `progress=None` shows nothing.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def called(*args: P.args, **options: P.kwargs) -> R:
            in_main = threading.current_thread() is threading.main_thread()
            logged = LOG.isEnabledFor(logging.INFO)
            if not in_main or getattr(_shown, "one", False) or not (logged or in_notebook()):
                return function(*args, **options)
            _shown.one = True
            began = time.monotonic()
            try:
                with Progress(title, value) if in_notebook() else _Logged(title, value) as progress:
                    options.setdefault("progress", progress)
                    found = function(*args, **options)
                LOG.info("%s: done in %.1f s", title, time.monotonic() - began)
                return found
            finally:
                _shown.one = False

        return called

    return decorate


class _Logged(Progress):
    """Progress as lines of the log."""

    def __init__(self, title: str, value: str) -> None:
        super().__init__(title, value)
        self._bar, self._on = None, False

    def _line(self, text: str) -> None:
        LOG.info("%s", text)


class _Bar:
    """A bar below a notebook's cell, redrawn in place."""

    def __init__(self) -> None:
        self._handle: Any = None
        self._next = _FIRST_BAR

    def draw(self, title: str, share: float | None, text: str, seconds: float) -> None:
        if seconds < self._next:
            return
        self._next = seconds + _BETWEEN
        value = "" if share is None else f' value="{share:.3f}"'
        line = f"{text}  {seconds:.0f} s"
        page = (
            f"<div>{html.escape(title)} <progress{value} "
            f'style="width: 20em; vertical-align: middle"></progress> {html.escape(line)}</div>'
        )
        self._put({"text/html": page, "text/plain": f"{title}: {line}"})

    def remove(self) -> None:
        if self._handle is not None:
            self._put({"text/html": "", "text/plain": ""})

    def _put(self, content: dict[str, str]) -> None:
        if self._handle is None:
            # IPython is installed, as a notebook runs
            self._handle = import_module("IPython.display").DisplayHandle()
            self._handle.display(content, raw=True)
        else:
            self._handle.update(content, raw=True)
