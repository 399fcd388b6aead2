"""Curves in a terminal: axis, characters, colours, and panels of curves over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray

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
