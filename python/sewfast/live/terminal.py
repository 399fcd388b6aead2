"""Curves in a terminal: axis, characters, colours, and panels of curves over time."""

from __future__ import annotations

import math
import os
import select
import time
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from .feed import SPEED, Feed

# --- Axis: a range that ends on round numbers, with its ticks and their labels --------------------


@dataclass(frozen=True)
class Axis:
    """A range of values and the round numbers in it, which its ends need not be.

    Attributes
    ----------
    low, high : float
        Ends; `low < high`.
    step : float
        Between ticks: 1, 2 or 5 times a power of ten.
    """

    low: float
    high: float
    step: float

    @classmethod
    def around(cls, low: float, high: float, ticks: int) -> Axis:
        """A range that holds `low` to `high` in about `ticks` steps and ends on fifths of one."""
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high = 0.0, 1.0
        if high - low < 1e-9 * max(abs(low), abs(high), 1e-3):
            pad = 0.5 * max(abs(low), 1.0)
            low, high = low - pad, high + pad
        step = round_step((high - low) / max(ticks, 1))
        found = cls._on_fifths(low, high, step)
        while len(found.ticks()) < 2:
            # one number alone says nothing of the scale
            step = round_step(step / 2.5)
            found = cls._on_fifths(low, high, step)
        return found

    @classmethod
    def _on_fifths(cls, low: float, high: float, step: float) -> Axis:
        fifth = step / 5
        return cls(math.floor(low / fifth) * fifth, math.ceil(high / fifth) * fifth, step)

    @classmethod
    def exactly(cls, low: float, high: float, ticks: int) -> Axis:
        """The given ends, with round ticks between them."""
        return cls(low, high, round_step((high - low) / max(ticks, 1)))

    def ticks(self) -> list[float]:
        """The multiples of the step within the ends, upwards."""
        first = math.ceil(self.low / self.step - 1e-9)
        last = math.floor(self.high / self.step + 1e-9)
        return [k * self.step for k in range(first, last + 1)]

    def label(self, value: float) -> str:
        """With as many decimals as the step needs."""
        if not 1e-4 <= self.step < 1e6:
            return f"{value:.3g}"
        decimals = max(0, -math.floor(math.log10(self.step) + 1e-9))
        return f"{value + 0.0:.{decimals}f}"

    def place(self, value: float, places: int) -> int:
        """The nearest of `places` points, of which the first is at `low` and the last at `high`."""
        return round((value - self.low) / (self.high - self.low) * (places - 1))


def round_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    factor = next((f for f in (1.0, 2.0, 5.0) if f * power >= least * (1 - 1e-9)), 10.0)
    return factor * power


# --- Curves as characters: spans of dots per column, drawn in braille or as one mark per cell -----


Codes = NDArray[np.uint32]

_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], dtype=np.uint32)
"""Bit of each dot of a braille cell, 4 rows of 2 (Unicode, block U+2800)."""

_BRAILLE = 0x2800
_BLANK = ord(" ")


@dataclass(frozen=True)
class Spans:
    """What a curve covers in each column: its least and largest value there, NaN where nothing."""

    low: FloatArray
    high: FloatArray


def spans(values: FloatArray, edges: NDArray[np.int64]) -> Spans:
    """The range of a curve in each column, joined to the column before it.

    Parameters
    ----------
    values : array, shape (N,)
        NaN where there is no sample.
    edges : array of int, shape (columns + 1,)
        Column `j` shows the samples `edges[j]` to `edges[j + 1] - 1`, and `edges[j]` itself where
        that is none: a sample is held until the next.
    """
    last = len(values) - 1
    first = np.minimum(edges[:-1], last)
    # the last sample of the column before joins the two, so that a jump is a line
    begin = np.maximum(first - 1, 0)
    stop = np.minimum(np.maximum(edges[1:], first + 1), last + 1)
    pairs = np.stack([begin, stop], axis=1).ravel()
    padded = np.append(values, np.nan)
    low = np.fmin.reduceat(padded, pairs)[::2]
    high = np.fmax.reduceat(padded, pairs)[::2]
    # a column whose own samples are all missing stays empty, whatever came before
    own = np.fmin.reduceat(padded, np.stack([first, stop], axis=1).ravel())[::2]
    beyond = edges[:-1] > last
    gone = np.isnan(own) | beyond
    return Spans(np.where(gone, np.nan, low), np.where(gone, np.nan, high))


def cover(found: Spans, axis: Axis, rows: int) -> NDArray[np.bool_]:
    """Which of `rows` dots, the top one first, a curve covers in each column."""
    scale = (rows - 1) / (axis.high - axis.low)
    top = np.rint((axis.high - found.high) * scale)
    bottom = np.rint((axis.high - found.low) * scale)
    dots = np.arange(rows)[:, None]
    return np.asarray((dots >= top) & (dots <= bottom))


def braille(dots: NDArray[np.bool_]) -> Codes:
    """Characters of a grid of dots, shape (4 h, 2 w) to (h, w); blank where no dot is set."""
    h, w = dots.shape[0] // 4, dots.shape[1] // 2
    cells = dots.reshape(h, 4, w, 2).astype(np.uint32)
    bits = np.einsum("hiwj,ij->hw", cells, _DOTS)
    return np.where(bits > 0, bits + _BRAILLE, _BLANK).astype(np.uint32)


def marks(cells: NDArray[np.bool_], mark: str) -> Codes:
    """One mark in every covered cell, shape (h, w)."""
    return np.where(cells, ord(mark), _BLANK).astype(np.uint32)


def text(codes: Codes) -> str:
    """A row of characters as a string."""
    return codes.astype("<u4").tobytes().decode("utf-32-le")


# --- Palette: which characters and colours a terminal is given ------------------------------------


_RESET = "\x1b[0m"


@dataclass(frozen=True)
class Palette:
    """What may be drawn with.

    Attributes
    ----------
    unicode : bool
        Braille dots and box lines; else ASCII only.
    colour : bool
        Escape sequences for colour.
    """

    unicode: bool
    colour: bool

    @property
    def marks(self) -> str:
        """Of the first curve of a panel, the second and so on; told apart without colour."""
        return "\u28ff.+x" if self.unicode else "*.+x"

    @property
    def legend(self) -> str:
        """How the first curve looks in a legend."""
        return "\u2809\u2809" if self.unicode else "**"

    @property
    def box(self) -> tuple[str, ...]:
        """Vertical line, tick on it, corner, horizontal line, tick on that, ellipsis."""
        return tuple("\u2502\u2524\u2514\u2500\u252c\u2026" if self.unicode else "|++-+~")

    def paint(self, text: str, colour: int | None) -> str:
        """The text in one of the terminal's own colours (SGR number)."""
        if not self.colour or colour is None or not text.strip():
            return text
        return f"\x1b[{colour}m{text}{_RESET}"


# --- Panel: curves of one unit over time, as lines of text ----------------------------------------


GUTTER = 9
"""Cells left of the plot: a label of 7, a blank, the axis."""

_COLOURS = (36, 33, 35, 32)
_DIM = 2


@dataclass(frozen=True)
class Panel:
    """What is drawn together.

    Attributes
    ----------
    names : sequence of str
        Columns, the one drawn on top first; four at most.
    unit : str
        Of all of them.
    """

    names: Sequence[str]
    unit: str

    def lines(
        self,
        columns: Mapping[str, FloatArray],
        edges: NDArray[np.int64],
        height: int,
        palette: Palette,
    ) -> list[str]:
        """A line with the legend, then `height` lines of plot.

        Parameters
        ----------
        columns : mapping of str to array, shape (N,)
        edges : array of int, shape (2 w + 1,)
            First sample of each column of dots, two to a cell.
        height : int
            Lines of the plot.
        palette : Palette
        """
        found = [spans(columns[name], edges) for name in self.names]
        axis = Axis.around(*_extent(found), ticks=max(2, min(height // 2, 6)))
        layers = [_layer(s, axis, height, palette, k) for k, s in enumerate(found)]
        last = 4 * height - 1
        labels = {(last - axis.place(v, last + 1)) // 4: axis.label(v) for v in axis.ticks()}
        rows = [
            _gutter(labels.get(row, ""), palette) + _row([layer[row] for layer in layers], palette)
            for row in range(height)
        ]
        return [self._legend(palette), *rows]

    def _legend(self, palette: Palette) -> str:
        unit = f"[{self.unit}]" if self.unit else ""
        curves = [
            palette.paint(palette.legend if k == 0 else palette.marks[k] * 2, _COLOURS[k])
            + f" {name}"
            for k, name in enumerate(self.names)
        ]
        return " " * GUTTER + "   ".join([*curves, unit])


def _extent(found: Sequence[Spans]) -> tuple[float, float]:
    low = np.concatenate([s.low for s in found])
    high = np.concatenate([s.high for s in found])
    if np.isnan(low).all():
        return np.nan, np.nan
    return float(np.nanmin(low)), float(np.nanmax(high))


def _layer(found: Spans, axis: Axis, height: int, palette: Palette, k: int) -> Codes:
    """The characters of one curve; the first one is fine where braille can be had."""
    if k == 0 and palette.unicode:
        return braille(cover(found, axis, 4 * height))
    pairs = Spans(
        np.fmin(found.low[::2], found.low[1::2]), np.fmax(found.high[::2], found.high[1::2])
    )
    return marks(cover(pairs, axis, height), palette.marks[k])


def _row(layers: Sequence[Codes], palette: Palette) -> str:
    """One line of all curves, the first on top, painted run by run."""
    codes, owner = layers[0].copy(), np.where(layers[0] == ord(" "), -1, 0)
    for k, layer in enumerate(layers[1:], start=1):
        free = (owner < 0) & (layer != ord(" "))
        codes[free], owner[free] = layer[free], k
    line = text(codes)
    if not palette.colour:
        return line.rstrip()
    pieces, at = [], 0
    for k, run in groupby(owner.tolist()):
        width = len(list(run))
        pieces.append(palette.paint(line[at : at + width], _COLOURS[k] if k >= 0 else None))
        at += width
    return "".join(pieces).rstrip()


def _gutter(label: str, palette: Palette) -> str:
    line, tick = palette.box[:2]
    return f"{label[:7]:>7} " + palette.paint(tick if label else line, _DIM)


def time_axis(axis: Axis, width: int, palette: Palette) -> list[str]:
    """The line below the plots and its numbers [s]."""
    corner, line, tick = palette.box[2:5]
    rule, numbers = [line] * width, [" "] * (GUTTER + width)
    for value in axis.ticks():
        at = axis.place(value, width)
        label = axis.label(value)
        begin = GUTTER + at - len(label) // 2
        if begin + len(label) > len(numbers) - 2:
            continue
        rule[at] = tick
        numbers[begin : begin + len(label)] = label
    numbers[-1] = "s"
    return [
        " " * (GUTTER - 1) + palette.paint(corner + "".join(rule), _DIM),
        "".join(numbers),
    ]


# --- Tty: a terminal that is written to without waiting for it longer than told -------------------


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


# --- Frame: one picture of a feed as lines of text that fit a terminal ----------------------------


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


# --- TerminalView: a plot on standard error, drawn over itself; the last one stays ----------------


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
