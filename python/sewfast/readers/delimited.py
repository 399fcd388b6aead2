"""Delimited text (CSV and relatives) -> `Table`."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError
from .table import MAX_COLUMNS, Table, from_headers

MAX_LINE = 1_000_000
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


def read_delimited(path: Path, raw: bytes) -> Table:
    """Read delimited text with a header row.

    The delimiter is comma, semicolon or tab; with the last two, numbers may have decimal commas.
    Empty cells are NaN. Columns with text are kept as unusable, each with the line and the cell,
    so that they only matter to who asks for them.

    Raises
    ------
    DataError
        Where the file is not a table of that kind.
    """
    layout = _layout(path, _decode(path, raw))
    fast = _fast_pass(layout)
    if fast is not None:
        first = layout.skipped + 1
        return from_headers(path, layout.header, fast, {}, range(first, first + len(fast[0])))
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
    """Find the header: the first line with content, or the comment above bare numbers."""
    comment = ""
    for skipped, (offset, line) in enumerate(_lines(text)):
        if len(line) > MAX_LINE:
            raise DataError(f"{path}: line {skipped + 1} has {len(line)} characters; not a table")
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
    return from_headers(layout.path, layout.header, list(np.array(rows).T), bad, lines)


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
