"""`Tty`: a terminal that is written to without waiting for it longer than told."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from typing import TextIO

from .palette import Palette

_SLICE_S = 0.05
"""How often a wait looks whether it should go on [s]."""


class Tty:
    """The terminal behind a text stream.

    It is opened anew where the system lets it: only then can writing be non-blocking without
    making the terminal so for everybody who shares it. Elsewhere a write waits as long as the
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
        self.encoding = stream.encoding

    def size(self) -> tuple[int, int]:
        """Columns and lines; 80 x 24 where the terminal does not say."""
        try:
            columns, rows = os.get_terminal_size(self._stream)
        except OSError:
            return 80, 24
        return columns or 80, rows or 24

    def write(self, text: str, wait: Callable[[float], bool]) -> bool:
        """Write all of a text; False where it was given up.

        Parameters
        ----------
        text : str
        wait : callable
            Called with the seconds for which nothing could be written; False gives up.
        """
        rest = memoryview(text.encode(self.encoding or "ascii", "replace"))
        stuck = time.monotonic()
        while rest:
            if written := self._write_some(rest):
                rest, stuck = rest[written:], time.monotonic()
            elif not wait(time.monotonic() - stuck):
                return False
        return True

    def _write_some(self, rest: memoryview) -> int:
        """Bytes written, 0 where the terminal took none for a moment."""
        # Windows waits for sockets only
        if os.name != "nt" and not select.select([], [self._fd], [], _SLICE_S)[1]:
            return 0
        try:
            return os.write(self._fd, rest)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        os.close(self._fd)


def can_move(term: str | None) -> bool:
    """Whether the cursor can be moved; Windows' console is not asked to."""
    return os.name != "nt" and term not in (None, "", "dumb", "unknown")


def palette(term: str | None, encoding: str | None, no_color: str | None) -> Palette:
    """Characters and colours for a terminal.

    Parameters
    ----------
    term : str or None
        Its type, from `TERM`; the Linux console has no braille in its fonts.
    encoding : str or None
        Of the stream.
    no_color : str or None
        From `NO_COLOR`: any text in it forbids colour (https://no-color.org).
    """
    utf = (encoding or "").lower().replace("_", "-") in ("utf-8", "utf8")
    moving = can_move(term)
    return Palette(unicode=utf and moving and term != "linux", colour=moving and not no_color)
