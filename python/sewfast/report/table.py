"""`Table`: rows of text under headers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """Rows whose first cell is a header.

    Attributes
    ----------
    caption : str
        What it shows.
    header : tuple of str
    rows : tuple of tuple of str
    best : frozenset of (row, column)
        Cells to set in bold.
    words : bool
        Whether its cells hold words rather than numbers, which begin at the left.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    words: bool = False
