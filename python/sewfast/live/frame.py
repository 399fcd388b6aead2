"""`Frame`: one picture of a feed as lines of text that fit a terminal."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .axis import Axis
from .feed import SPEED, Feed
from .palette import Palette
from .panel import GUTTER, Panel, time_axis

FloatArray = NDArray[np.float64]

_NARROW, _LOW = 40, 12
"""Below this many columns or lines there is room for the status alone."""

_TALL = 40
"""Lines that a frame takes at most."""

_AROUND = 7
"""Lines of a frame that are no plot: title, two legends, two of the axis, two of status."""


@dataclass(frozen=True)
class Frame:
    """What is drawn at once.

    Attributes
    ----------
    lines : tuple of str
        With colour sequences.
    widths : tuple of int
        Cells that each line takes.
    """

    lines: tuple[str, ...]
    widths: tuple[int, ...]

    @classmethod
    def of(cls, feed: Feed, columns: int, rows: int, palette: Palette) -> Frame:
        """Draw a feed into at most `columns - 1` by `rows - 1` cells."""
        width = columns - 1
        if columns < _NARROW or rows < _LOW or feed.end == 0:
            return cls._plain([status(feed, width, palette)])
        height = min(rows - 1, _TALL) - _AROUND
        body = _plots(feed, width - GUTTER, height, palette)
        title, below = clean(feed.title, width, palette), status(feed, width, palette)
        lines = [title, *body, below, clean(_newest(feed), width, palette)]
        return cls(tuple(lines), tuple(_cells(line) for line in lines))

    @classmethod
    def _plain(cls, lines: list[str]) -> Frame:
        return cls(tuple(lines), tuple(map(len, lines)))


def panels(columns: Mapping[str, str]) -> list[Panel]:
    """The command above; below it the speed and its reference, else what comes first.

    Times and counts are drawn in no panel: the speed stands for the counts.
    """
    drawn = {name: unit for name, unit in columns.items() if name not in ("t", "counts")}
    if not drawn:
        drawn = dict(columns)
    command = drawn["u"] if "u" in drawn else next(iter(drawn.values()))
    units = [command, drawn.get(SPEED, drawn.get("r", ""))]
    units += [unit for unit in drawn.values() if unit != command]
    below = next((unit for unit in units[1:] if unit != command and unit in drawn.values()), None)
    return [_panel(drawn, unit) for unit in (command, below) if unit is not None]


def _panel(drawn: Mapping[str, str], unit: str) -> Panel:
    """The curves of one unit, a reference behind the others.

    Beside the derived speed there is only its reference: what a device says of the same speed
    would hide both.
    """
    names = [name for name, of in drawn.items() if of == unit]
    if SPEED in names:
        names = [name for name in (SPEED, "r") if name in names]
    names.sort(key=lambda name: (name == "r", name != "u"))
    return Panel(names[:4], unit)


def _plots(feed: Feed, width: int, height: int, palette: Palette) -> list[str]:
    start, stop = shown(feed)
    found = feed.read(start, min(stop, feed.end))
    edges = np.linspace(0, stop - start, 2 * width + 1).astype(np.int64)
    chosen = panels(feed.columns)
    upper = height if len(chosen) == 1 else 2 * height // 5
    heights = [upper, height - upper]
    lines = [
        line
        for panel, h in zip(chosen, heights, strict=False)
        for line in panel.lines(found, edges, h, palette)
    ]
    axis = Axis.exactly(start * feed.Ts, stop * feed.Ts, max(2, width // 12))
    return lines + time_axis(axis, width, palette)


def shown(feed: Feed) -> tuple[int, int]:
    """The samples between the ends of the time axis, which moves on once it is full."""
    start = max(feed.end - feed.window, 0)
    return start, start + feed.window


def status(feed: Feed, width: int, palette: Palette) -> str:
    """How far the record is, what is missing, and the newest values that there is room for."""
    if feed.end == 0:
        return clean(f"{feed.title}: waiting for the first sample", width, palette)
    now = f"{feed.end * feed.Ts:.2f}"
    planned = f" of {feed.n * feed.Ts:.2f}" if feed.n is not None else ""
    line = f"{now}{planned} s   {_received(feed)}"
    for part in _values(feed):
        if len(line) + 3 + len(part) <= width:
            line += f"   {part}"
    return clean(line, width, palette)


def _received(feed: Feed) -> str:
    if not feed.missing:
        return "all samples received"
    gaps = f"{feed.gaps} gap{'s' * (feed.gaps != 1)}"
    # rounded down: what is not all must not read as 100 %
    share = np.floor(1e4 * feed.received / feed.end) / 100
    return f"{share:.2f} % received ({feed.missing} missing, {gaps})"


def _values(feed: Feed) -> list[str]:
    """The newest known value of the columns that a status has room for."""
    newest = feed.read(max(feed.end - 50, 0), feed.end)
    found = []
    for name in (SPEED, "u"):
        known = newest[name][~np.isnan(newest[name])] if name in newest else np.empty(0)
        if len(known):
            digits = 0 if name == SPEED else 2
            found.append(f"{name} {known[-1]:.{digits}f} {feed.columns[name]}".rstrip())
    return found


def _newest(feed: Feed) -> str:
    said = feed.said()
    return said[-1][1] if said else ""


def clean(line: str, width: int, palette: Palette) -> str:
    """A line of others' text without what could move the cursor, cut to `width` cells."""
    kept = "".join(c if _fits(c, palette) else "?" for c in line)
    return kept if len(kept) <= width else kept[: max(width - 1, 0)] + palette.box[5]


def _fits(c: str, palette: Palette) -> bool:
    if c.isascii():
        return c.isprintable()
    narrow = unicodedata.east_asian_width(c) not in "WF" and not unicodedata.combining(c)
    return palette.unicode and c.isprintable() and narrow


def _cells(line: str) -> int:
    """Cells of a line, colour sequences aside; everything drawn is one cell wide."""
    return sum(len(piece.partition("m")[2]) if k else len(piece)
               for k, piece in enumerate(line.split("\x1b[")))  # fmt: skip
