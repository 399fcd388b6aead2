"""Curves as characters: spans of dots per column, drawn in braille or as one mark per cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .axis import Axis

FloatArray = NDArray[np.float64]
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
