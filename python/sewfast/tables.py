"""Numbers and tables for readers: few digits, a unit, a dash for a missing value."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

NONE = "–"
_SPACE = "\N{NO-BREAK SPACE}"


def significant(value: float | None, digits: int = 3) -> str:
    """`digits` significant digits, plain if that is short, else with a power of ten."""
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0.0:
        return "0"
    # magnitude of the rounded value: 9.996 gives two digits before the point
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    size = int(power)
    if not -3 <= size <= 5:
        text = f"{mantissa} × 10{_raised(size)}"
        return text.replace("-", "−").replace(" ", _SPACE)
    return f"{value:,.{max(digits - 1 - size, 0)}f}".replace("-", "−")


def rpm(value: float | None) -> str:
    """A speed or its error [RPM]."""
    return NONE if value is None else f"{significant(value)}{_SPACE}RPM"


def volt(value: float | None) -> str:
    """A command or its change [V]."""
    return NONE if value is None else f"{significant(value)}{_SPACE}V"


def percent(value: float | None, digits: int = 2) -> str:
    """A share [%]."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{value:.{digits}f}{_SPACE}%".replace("-", "−")


def milliseconds(value: float | None) -> str:
    """A duration [ms]."""
    return NONE if value is None else f"{value:.0f}{_SPACE}ms"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    cells = (map(str.ljust, row, widths) for row in rows)
    return ["  ".join(row).rstrip() for row in cells]


class Shown:
    """A result that a notebook shows as the table of its text; `repr` is the first line of that."""

    def _repr_html_(self) -> str:
        return html_of(str(self))

    def __repr__(self) -> str:
        return f"<{str(self).splitlines()[0]}>"


def html_of(text: str) -> str:
    """Lines of text, `name: value` or `name   value`, as a table; the first line is its caption."""
    caption, *lines = text.splitlines()
    rows: list[tuple[str, ...]] = []
    for line in lines:
        parts = re.split(r": | {2,}", line.strip(), maxsplit=1)
        rows.append((parts[0], parts[1]) if len(parts) == 2 else ("", parts[0]))
    return Table(caption, (), tuple(rows), words=True).to_html()


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


# --- Table: rows of text under headers ------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """Rows whose first cell is a header. `best` has the cells (row, column) to set in bold; `words`
    says whether the cells hold words, aligned to the left, rather than numbers.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    words: bool = False

    def to_text(self) -> str:
        """As lines with aligned columns."""
        return "\n".join(
            [self.caption, *("  " + row for row in aligned([self.header, *self.rows]))]
        )

    def to_html(self, notes: Sequence[str] = ()) -> str:
        """As HTML for a notebook, escaped, without style or script; `notes` are lines below."""
        heads = "".join(f'<th scope="col">{escape(h)}</th>' for h in self.header)
        head = f"<thead><tr>{heads}</tr></thead>\n" if self.header else ""
        rows = "\n".join(
            f'<tr><th scope="row">{escape(row[0])}</th>'
            + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:])
            + "</tr>"
            for row in self.rows
        )
        below = "".join(f"\n<div>{escape(note)}</div>" for note in notes)
        return (
            f"<table><caption>{escape(self.caption)}</caption>\n{head}"
            f"<tbody>\n{rows}\n</tbody></table>{below}"
        )
