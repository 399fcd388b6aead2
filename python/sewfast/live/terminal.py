"""A status line on a terminal, overwritten in place: progress, missing samples, newest values."""

from __future__ import annotations

import os
import select
import time
import unicodedata
from collections.abc import Callable
from typing import TextIO

import numpy as np

from .feed import SPEED, Feed

# --- Tty: writing to a terminal without blocking on it --------------------------------------------


_SLICE_S = 0.05
"""Longest wait before it is checked whether to wait on [s]."""


class Tty:
    """The terminal behind a text stream.

    It is opened a second time if the system allows: only then can writes be non-blocking without
    making the terminal non-blocking for all who share it. Otherwise a write waits as long as the
    terminal is blocked.

    Parameters
    ----------
    stream : text stream
        Standard error, which must be a terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream.fileno()
        try:
            flags = os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK
            self._fd = os.open(os.ttyname(self._stream), flags)
        except (OSError, AttributeError):
            self._fd = os.dup(self._stream)
        self.encoding = stream.encoding or "ascii"

    @property
    def columns(self) -> int:
        """Width of the terminal; 80 if it is unknown."""
        try:
            return os.get_terminal_size(self._stream).columns or 80
        except OSError:
            return 80

    def write(self, text: str, wait: Callable[[], bool]) -> None:
        """Write a text; while the terminal takes none of it, `wait` decides whether to go on."""
        rest = memoryview(text.encode(self.encoding, "replace"))
        while rest:
            if written := self._write_some(rest):
                rest = rest[written:]
            elif not wait():
                return

    def _write_some(self, rest: memoryview) -> int:
        """Bytes written; 0 if the terminal took none for a moment."""
        # on Windows, select works for sockets only
        if os.name != "nt" and not select.select([], [self._fd], [], _SLICE_S)[1]:
            return 0
        try:
            return os.write(self._fd, rest)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        os.close(self._fd)


# --- The status line ------------------------------------------------------------------------------


def status(feed: Feed, width: int) -> str:
    """Progress, missing samples, and as many of the newest values as there is room for."""
    if feed.end == 0:
        return fitted(f"{feed.title}: waiting for the first sample", width)
    now = f"{feed.end * feed.Ts:.2f}"
    planned = f" of {feed.n * feed.Ts:.2f}" if feed.n is not None else ""
    line = f"{now}{planned} s   {_received(feed)}"
    for part in _values(feed):
        if len(line) + 3 + len(part) <= width:
            line += f"   {part}"
    return fitted(line, width)


def _received(feed: Feed) -> str:
    if not feed.missing:
        return "all samples received"
    gaps = f"{feed.gaps} gap{'s' * (feed.gaps != 1)}"
    # round down: an incomplete record must not read as 100 %
    share = np.floor(1e4 * feed.received / feed.end) / 100
    return f"{share:.2f} % received ({feed.missing} missing, {gaps})"


def _values(feed: Feed) -> list[str]:
    """The newest known values of speed and command."""
    newest = feed.read(max(feed.end - 50, 0), feed.end)
    found = []
    for name in (SPEED, "u"):
        known = newest[name][~np.isnan(newest[name])] if name in newest else np.empty(0)
        if len(known):
            digits = 0 if name == SPEED else 2
            found.append(f"{name} {known[-1]:.{digits}f} {feed.columns[name]}".rstrip())
    return found


def fitted(line: str, width: int) -> str:
    """A line without characters that could move the cursor, cut to `width` cells."""
    kept = "".join(c if _is_one_cell(c) else "?" for c in line)
    return kept if len(kept) <= width else kept[: max(width - 1, 0)] + "~"


def _is_one_cell(c: str) -> bool:
    wide = unicodedata.east_asian_width(c) in "WF" or unicodedata.combining(c)
    return c.isprintable() and not wide


# --- TerminalView: the status line while the feed is open -----------------------------------------


PERIOD_S = 0.1
"""Time between two lines [s]."""

_PATIENCE_S = 0.2
"""Longest wait for a blocked terminal once the record has ended [s]."""


class TerminalView:
    """A status line, with the feed's notes written above it.

    It moves the cursor only by carriage returns, which every terminal knows, and changes no mode:
    however the program ends, nothing has to be restored.

    Parameters
    ----------
    stream : text stream
        A terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._tty = Tty(stream)
        self._noted = 0
        self._line = ""

    def run(self, feed: Feed) -> None:
        """Write until the feed is closed, then once more."""
        try:
            while not feed.closed.wait(PERIOD_S):
                self._write(feed)
            self._write(feed, end="\r\n")
        finally:
            self._tty.close()

    def _write(self, feed: Feed, end: str = "") -> None:
        # a terminal breaks a line that fills its last column
        width = self._tty.columns - 1
        notes = [(number, fitted(text, width)) for number, text in feed.notes(self._noted)]
        line = status(feed, width)
        if not (notes or end or line != self._line):
            return
        before = min(len(self._line), width)
        above = "".join(f"\r{text:{before}}\r\n" for _, text in notes)
        blank = 0 if notes else before
        self._line, self._noted = line, notes[-1][0] if notes else self._noted
        self._tty.write(f"{above}\r{line:{blank}}{end}", self._patience(feed))

    def _patience(self, feed: Feed) -> Callable[[], bool]:
        ended: list[float] = []

        def wait() -> bool:
            if feed.closed.is_set() and not ended:
                ended.append(time.monotonic())
            return not ended or time.monotonic() - ended[0] < _PATIENCE_S

        return wait
