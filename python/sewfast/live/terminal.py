"""`TerminalView`: a plot on standard error, drawn over itself; the last one stays."""

from __future__ import annotations

import os
import time
from typing import TextIO

from .feed import Feed
from .frame import Frame, status
from .tty import Tty, can_move, palette

PERIOD_S = 0.1
"""Between two frames [s]."""

_LINE_PERIOD_S = 1.0
"""Between two lines where the cursor cannot be moved [s]."""

_PATIENCE_S = 0.2
"""For a terminal that takes nothing, once the record has ended [s]."""


class TerminalView:
    """Two panels over time with a status below.

    No mode of the terminal is changed: the cursor is moved up over the last frame, and each line
    is written anew. Whatever ends the program, nothing has to be restored.

    Parameters
    ----------
    stream : text stream
        A terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._tty = Tty(stream)
        term = os.environ.get("TERM")
        self._moves = can_move(term)
        self._palette = palette(term, self._tty.encoding, os.environ.get("NO_COLOR"))
        self._drawn: Frame | None = None

    def run(self, feed: Feed) -> None:
        """Draw until the feed is closed, then once more."""
        try:
            if self._moves:
                self._animate(feed)
            else:
                self._tell(feed)
        finally:
            self._tty.close()

    def _animate(self, feed: Feed) -> None:
        before = None
        while not feed.closed.wait(PERIOD_S):
            state = (feed.end, feed.said()[-1:], self._tty.size())
            if state != before:
                self._draw(feed)
                before = state
        self._draw(feed)

    def _draw(self, feed: Feed) -> None:
        columns, rows = self._tty.size()
        frame = Frame.of(feed, columns, rows, self._palette)
        back = rows_to_climb(self._drawn, columns, rows)
        climb = f"\r\x1b[{back}A" if back else "\r"
        body = "".join(f"{line}\x1b[K\r\n" for line in frame.lines)
        self._drawn = frame
        self._write(f"{climb}{body}\x1b[J", feed)

    def _tell(self, feed: Feed) -> None:
        """A line that is written over itself, and the plot at the end."""
        while not feed.closed.wait(_LINE_PERIOD_S):
            self._over_line(feed)
        self._over_line(feed)
        columns, rows = self._tty.size()
        frame = Frame.of(feed, columns, rows, self._palette)
        self._write("\r" + "\r\n".join(frame.lines) + "\r\n", feed)

    def _over_line(self, feed: Feed) -> None:
        width = self._tty.size()[0] - 1
        self._write("\r" + status(feed, width, self._palette).ljust(width), feed)

    def _write(self, text: str, feed: Feed) -> None:
        ended: list[float] = []

        def wait(_: float) -> bool:
            if feed.closed.is_set() and not ended:
                ended.append(time.monotonic())
            return not ended or time.monotonic() - ended[0] < _PATIENCE_S

        self._tty.write(text, wait)


def rows_to_climb(drawn: Frame | None, columns: int, rows: int) -> int:
    """Lines between the cursor and the top of the last frame.

    A terminal that has become narrower has broken the lines that no longer fit.
    """
    if drawn is None:
        return 0
    broken = sum(max(1, -(-width // columns)) for width in drawn.widths)
    return min(broken, rows - 1)
