"""`Panel`: curves of one unit over time, as lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from .axis import Axis
from .canvas import Codes, Spans, braille, cover, marks, spans, text
from .palette import Palette

FloatArray = NDArray[np.float64]

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
