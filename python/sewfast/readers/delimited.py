"""Delimited text (CSV and relatives) -> `Table`."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError
from .containers import MAX_COLUMNS, Table, from_headers

MAX_LINE = 1_000_000
_PREAMBLE = 200
"""Lines within which the numbers of a table must begin for lines above its header to be skipped."""
_UNITS = frozenset(
    re.split(
        " ",
        "s sec second seconds ms us µs ns v volt volts mv a amp ampere amperes ma rpm rev rev/s "
        "rad rad/s deg deg/s nm n m mm m/s mm/s w hz khz % °c degc counts counts/s 1/min",
    )
)
"""Units that oscilloscopes and loggers write into a row of their own, in lower case."""
_MISSING = frozenset({"", "nan", "na", "n/a", "null", "none"})


@dataclass(frozen=True)
class _Layout:
    """Cells of the header, the text below it, lines above that, and how numbers are written."""

    path: Path
    header: list[str]
    body: str
    skipped: int
    delimiter: str
    decimal: str
    notes: tuple[str, ...] = ()


def read_delimited(path: Path, raw: bytes) -> Table:
    """Read delimited text with a header row.

    Lines above the header, as oscilloscopes write them, are skipped, which `Table.notes` says, and
    a row of units below it gives the units. The delimiter is comma, semicolon or tab; with the last
    two, numbers may have decimal commas.
    Empty cells are NaN. Columns with text are kept as unusable, each with the line and the cell,
    so that they only matter to those who select them.

    Raises
    ------
    DataError
        Where the file is not a table of that kind.
    """
    layout = _layout(path, _decode(path, raw))
    fast = _fast_pass(layout)
    if fast is not None:
        first = layout.skipped + 1
        lines = range(first, first + len(fast[0]))
        return replace(from_headers(path, layout.header, fast, {}, lines), notes=layout.notes)
    return _slow_pass(layout)


def _decode(path: Path, raw: bytes) -> str:
    """Text of UTF-8 or UTF-16 (by its mark), else Latin-1, with line ends as `\\n`."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = raw.decode("utf-16", errors="replace")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = raw.decode("latin-1")
    head = text[:4096]
    strange = sum((c < " " and c not in "\t\r\n") or "\x7f" <= c <= "\x9f" for c in head)
    if "\0" in head or strange > 0.02 * len(head):
        raise DataError(
            f"{path}: expected text (CSV), .mat, .npz or Parquet; received binary data of an "
            "unknown kind"
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Offset after each line, and the line."""
    start = 0
    while start < len(text):
        stop = text.find("\n", start)
        stop = len(text) if stop < 0 else stop
        yield stop + 1, text[start:stop]
        start = stop + 1


def _cells(line: str, delimiter: str) -> list[str]:
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in row]


def _pick_delimiter(line: str) -> str:
    """The most frequent of semicolon, tab and comma; the earlier where tied."""
    return max(";\t,", key=line.count)


def _is_numeric(cells: list[str]) -> bool:
    return all(_number(c.replace(",", "."), ".") is not None for c in cells)


def _layout(path: Path, text: str) -> _Layout:
    """Find the header: the first line with content, or the comment above bare numbers.

    Where numbers begin farther down, below a line of names that fits them, what is above is no
    table: the header of an oscilloscope's export.
    """
    below = _below_preamble(path, text)
    if below is not None:
        return _checked(below)
    comment = ""
    for skipped, (offset, line) in enumerate(_lines(text)):
        if len(line) > MAX_LINE:
            raise DataError(
                name=f"{path}: line {skipped + 1}",
                expected=f"a table with lines of up to {MAX_LINE} characters",
                received=f"{len(line)}", remedy="export the table as CSV",
            )  # fmt: skip
        if not line.strip():
            continue
        if line.lstrip().startswith("#"):
            comment = line.lstrip()[1:]
            continue
        delimiter = _pick_delimiter(line)
        header, body, above = _cells(line, delimiter), text[offset:], skipped + 1
        if _is_numeric(header):
            named = _cells(comment, _pick_delimiter(comment)) if comment else []
            if len(named) != len(header) or _is_numeric(named):
                raise DataError(
                    f"{path}: expected a header with column names (such as t,u,y) in the first "
                    f"line, received numbers: {_short(line)}; add one"
                )
            header, body, above = named, text[offset - len(line) - 1 :], skipped
        return _checked(_Layout(path, header, body, above, delimiter, _decimal(delimiter, body)))
    raise DataError(f"{path}: the file is empty; expected a header and rows of numbers")


def _below_preamble(path: Path, text: str) -> _Layout | None:
    """The layout of a table that does not begin in the file's first line with content.

    None where it does, or where it is not clear where it begins: then the first line is the header.
    """
    lines: list[tuple[int, str]] = []
    for offset, line in _lines(text):
        if len(line) > MAX_LINE or len(lines) >= _PREAMBLE:
            return None
        lines.append((offset, line))
        at = len(lines) - 1
        found = _numbers(line)
        if found is None:
            continue
        # a line of numbers within a preamble has no other of its width below it
        following = text[offset : offset + MAX_LINE].lstrip("\n").partition("\n")[0]
        again = _numbers(following)
        if following.strip() and (again is None or again[1] != found[1]):
            continue
        return _above_numbers(path, text, lines, at, *found)
    return None


def _above_numbers(
    path: Path, text: str, lines: list[tuple[int, str]], at: int, delimiter: str, width: int
) -> _Layout | None:
    """Names, and units if there are any, in the lines above the first numbers in line `at`."""
    above = [k for k in range(at) if lines[k][1].strip() and lines[k][1].lstrip()[0] != "#"]
    heads: list[list[str]] = []
    for k in reversed(above):
        names = _texts(lines[k][1], delimiter, width)
        if names is None or len(heads) == 2:
            break
        heads.insert(0, names)
    if not heads or len(above) == 1:
        return None
    units: tuple[str, ...] = ()
    if len(heads) == 2 and all(_looks_like_unit(cell) for cell in heads[1]):
        units = tuple(cell.strip("()[] ") for cell in heads[1])
        heads.pop()
        header = heads[0]
    elif len(heads) == len(above):
        # names and a row of text: an ordinary table, whose columns with text are named later
        return None
    else:
        header = heads[-1]
        heads = heads[-1:]
    used = len(heads) + bool(units)
    skipped = above[: len(above) - used]
    if units:
        pairs = zip(header, units, strict=True)
        header = [f"{n} [{u}]" if u and "[" not in n else n for n, u in pairs]
    notes = []
    if skipped:
        shown = _short(lines[skipped[0]][1].strip())
        notes.append(f"{path.name}: {len(skipped)} lines above the header are skipped: {shown} ...")
    start = lines[at][0] - len(lines[at][1]) - 1
    body = text[max(start, 0) :]
    return _Layout(
        path, header, body, at, delimiter, _decimal(delimiter, body),
        tuple(notes),
    )  # fmt: skip


def _numbers(line: str) -> tuple[str, int] | None:
    """Delimiter and number of cells of a line that holds numbers and nothing else."""
    if not line.strip() or len(line) > MAX_LINE:
        return None
    for delimiter in ";\t,":
        try:
            cells = _cells(line, delimiter)
        except csv.Error:
            return None
        while len(cells) > 1 and not cells[-1]:
            cells.pop()
        if len(cells) > 1 and _is_numeric(cells) and any(cells):
            return delimiter, len(cells)
    return None


def _texts(line: str, delimiter: str, width: int) -> list[str] | None:
    """The cells of a line of names: as many as there are columns, none of them a number."""
    cells = _cells(line, delimiter)
    while len(cells) > width and not cells[-1]:
        cells.pop()
    named = len(cells) == width and all(
        c and _number(c.replace(",", "."), ".") is None for c in cells
    )
    return cells if named else None


def _looks_like_unit(cell: str) -> bool:
    """Whether a cell below a name is its unit: in brackets, or one that measurements have."""
    text = cell.strip()
    if len(text) > 2 and text[0] + text[-1] in ("()", "[]"):
        return True
    return text.lower() in _UNITS


def _decimal(delimiter: str, body: str) -> str:
    return "," if delimiter != "," and "," in body and "." not in body else "."


def _checked(layout: _Layout) -> _Layout:
    if layout.header and not layout.header[-1]:
        # rows of some loggers end with a delimiter
        layout.header.pop()
    if len(layout.header) > MAX_COLUMNS:
        raise DataError(
            f"{layout.path}: expected at most {MAX_COLUMNS} columns, received {len(layout.header)}"
        )
    if not layout.body.strip():
        raise DataError(f"{layout.path}: a header but no rows; expected rows of numbers below it")
    return layout


def _fast_pass(layout: _Layout) -> list[FloatArray] | None:
    """All cells by NumPy's parser; None where one is not a number or a row has another length."""
    body = layout.body.rstrip("\n")
    if layout.decimal == ",":
        body = body.replace(",", ".")
    try:
        values = np.loadtxt(
            io.StringIO(body), delimiter=layout.delimiter, comments=None, quotechar='"', ndmin=2
        )
    except (ValueError, OverflowError):
        return None
    if values.shape != (body.count("\n") + 1, len(layout.header)):
        return None
    return list(values.T)


def _slow_pass(layout: _Layout) -> Table:
    rows: list[list[float]] = []
    lines: list[int] = []
    bad: dict[int, str] = {}
    for number, cells in _rows(layout):
        rows.append([_value(layout, bad, number, i, c) for i, c in enumerate(cells)])
        lines.append(number)
    if not rows:
        raise DataError(f"{layout.path}: a header but no rows; expected rows of numbers below it")
    table = from_headers(layout.path, layout.header, list(np.array(rows).T), bad, lines)
    return replace(table, notes=layout.notes)


def _rows(layout: _Layout) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of each row that is not blank, checked against the header."""
    width = len(layout.header)
    reader = csv.reader((line for _, line in _lines(layout.body)), delimiter=layout.delimiter)
    try:
        for cells in reader:
            number = layout.skipped + reader.line_num
            while len(cells) > width and not cells[-1].strip():
                cells.pop()
            if not any(c.strip() for c in cells) and len(cells) < max(width, 2):
                continue
            if len(cells) != width:
                raise DataError(
                    f"{layout.path}: line {number}: expected {width} cells, as in the header, "
                    f"received {len(cells)}: {_short(layout.delimiter.join(cells))}"
                    + _comma_hint(layout, len(cells))
                )
            yield number, cells
    except csv.Error as e:
        raise DataError(f"{layout.path}: line {layout.skipped + reader.line_num}: {e}") from e


def _comma_hint(layout: _Layout, received: int) -> str:
    if layout.delimiter == "," and received > len(layout.header):
        return "; numbers with decimal commas need semicolons between the columns"
    return ""


def _value(layout: _Layout, bad: dict[int, str], line: int, column: int, cell: str) -> float:
    value = _number(cell, layout.decimal)
    if value is None:
        bad.setdefault(column, _complaint(layout, line, column, cell))
        return float("nan")
    return value


def _number(cell: str, decimal: str) -> float | None:
    text = cell.strip()
    if text.lower() in _MISSING:
        return float("nan")
    if decimal == ",":
        text = "?" if "." in text else text.replace(",", ".")
    try:
        # Python's own digit separators are not a number format of data files
        return None if "_" in text else float(text)
    except ValueError:
        return None


def _complaint(layout: _Layout, line: int, column: int, cell: str) -> str:
    hint = ""
    if "," in cell and layout.decimal == ".":
        hint = "; the file also holds decimal points: write all numbers one way"
    return (
        f"line {line}, column {layout.header[column]!r}: expected a number, received "
        f"{_short(cell)}{hint}"
    )


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
