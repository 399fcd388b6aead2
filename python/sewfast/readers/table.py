"""`Table`: the named columns of one file, and why others cannot be used."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError, printable

MAX_COLUMNS = 10_000


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """Columns of one file by name; `table["speed"]` is a float64 array of shape (N,).

    Parameters
    ----------
    path : Path
        The file.
    columns : mapping of name to array
        Columns may differ in length where the format allows it (`.mat`, `.npz`).
    units : mapping of name to text
        From headers such as `u [V]` or `speed (RPM)`; absent where unknown.
    unusable : mapping of name to text
        Columns that are there but hold no series of numbers, each with the reason.
    lines : sequence of int or None
        Line of each row in a text file, 1-based.
    Ts : float or None
        Sample time [s] where the file states it.
    Ts_source : str
        Where it states it, for messages.
    notes : sequence of str
        What was left out when the file was read.
    counts_per_rev : float or None
        Encoder counts of one turn, of the column `counts`, where the file states it.
    """

    path: Path
    columns: Mapping[str, FloatArray]
    units: Mapping[str, str] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)
    lines: Sequence[int] | None = None
    Ts: float | None = None
    counts_per_rev: float | None = None
    Ts_source: str = "the header"
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.columns)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return len(self.columns)

    def __repr__(self) -> str:
        return f"Table({self.path.name!r}: {', '.join(self.names)})"

    def resolve(self, name: str) -> str:
        """The column's own name for `name`, which may also be the whole header (`u [V]`).

        Raises
        ------
        DataError
            Where the file has no such column, or it cannot be used.
        """
        name = printable(name)
        for candidate in (name, split_unit(name)[0]):
            if candidate in self.columns:
                return candidate
            if candidate in self.unusable:
                raise DataError(f"{self.path}: {self.unusable[candidate]}")
        raise DataError(f"{self.path}: no column {name!r}; {self._hint(name)}")

    def _hint(self, name: str) -> str:
        shown = ", ".join(self.names[:30]) + (", ..." if len(self) > 30 else "")
        lower = {n.lower(): n for n in self.names}
        close = difflib.get_close_matches(name.lower(), lower, n=1, cutoff=0.6)
        guess = f" did you mean {lower[close[0]]!r}?" if close else ""
        return f"available: {shown or 'none'}.{guess}"

    def __getitem__(self, name: str) -> FloatArray:
        return self.columns[self.resolve(name)]

    def unit(self, name: str) -> str:
        """The unit of a column, empty where unknown."""
        return self.units.get(self.resolve(name), "")

    def row(self, k: int) -> str:
        """Where sample `k` stands in the file, for messages."""
        return f"sample {k} (0-based)" if self.lines is None else f"line {self.lines[k]}"


def split_unit(header: str) -> tuple[str, str]:
    """`u [V]` or `u (V)` -> `("u", "V")`; no unit gives an empty one."""
    match = re.fullmatch(r"\s*(\S.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*", header)
    if match is None:
        return header.strip(), ""
    return match[1], (match[2] or match[3] or "").strip()


def split_units(headers: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names and units of a header row; a name that would then occur twice keeps its unit."""
    headers = [printable(h.strip()) for h in headers]
    pairs = [split_unit(h) for h in headers]
    bare = [name for name, _ in pairs]
    names = [n if bare.count(n) == 1 else h.strip() for n, h in zip(bare, headers, strict=True)]
    return names, [unit for _, unit in pairs]


def from_headers(
    path: Path,
    headers: Sequence[str],
    columns: Sequence[FloatArray],
    bad: Mapping[int, str],
    lines: Sequence[int] | None = None,
) -> Table:
    """A table from a header row; `bad` holds the reason for each column that cannot be used."""
    names, units = split_units(headers)
    unusable = {
        n: f"the header {n!r} occurs more than once; rename one"
        for n in names
        if names.count(n) > 1
    }
    unusable |= {names[i]: reason for i, reason in bad.items()}
    used = {n: c for n, c in zip(names, columns, strict=True) if n and n not in unusable}
    if not used and unusable:
        raise DataError(f"{path}: {next(iter(unusable.values()))}")
    known = {n: u for n, u in zip(names, units, strict=True) if u and n in used}
    return Table(path, {n: freeze(c) for n, c in used.items()}, known, unusable, lines)


def freeze(values: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> FloatArray:
    """A read-only contiguous float64 copy."""
    array = np.array(values, dtype=np.float64, order="C")
    array.flags.writeable = False
    return array
