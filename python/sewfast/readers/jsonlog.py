"""Logs in JSON: one object a line (JSON lines), a list of objects, or an object of columns."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import DataError
from .containers import MAX_COLUMNS, Table, from_headers, split_units
from .delimited import CORRUPT, short, skipped_lines
from .timebase import is_moment, seconds_of_texts

_BEGINS = re.compile(rb"\s*(\{|\[\s*\{)")


def is_json(raw: bytes) -> bool:
    """Whether a file begins as a JSON object, or as a list of them."""
    return _BEGINS.match(raw.removeprefix(b"\xef\xbb\xbf")[:4096]) is not None


def read_json(path: Path, raw: bytes) -> Table:
    """Read the numbers of a JSON log; true and false are 1 and 0, null and missing values NaN.
    Fields of an object within an object are `NAME.FIELD`. Dates and times of day become seconds
    from the first one. Up to 1 % of corrupt lines of JSON lines are skipped, with a note; more
    raise `DataError`.
    """
    found: Any = None
    text = raw.decode("utf-8-sig", errors="replace").rstrip("\0\x1a")
    notes: tuple[str, ...] = ()
    try:
        found = json.loads(text)
        rows, lines = _rows(found), None
    except (ValueError, RecursionError):
        rows, lines, notes = _of_lines(path, text)
    kind = found.get("format") if isinstance(found, dict) else None
    if isinstance(kind, str) and kind.startswith("sewfast."):
        raise DataError(
            name=str(path), expected="a recording", received=f"a file of kind {kind!r}",
            remedy="name the recording; such a file goes where a model, a controller or a result "
            "is asked for",
        )  # fmt: skip
    table = _by_row(path, rows, lines) if any(rows) else _by_column(path, found)
    return Table(
        path, table.columns, table.units, table.unusable, lines, notes=notes, moments=table.moments
    )


def _rows(found: Any) -> list[dict[str, Any]]:
    """The objects of a list, of one line, or of the only list of objects in an object."""
    if isinstance(found, dict):
        lists = [v for v in found.values() if _is_records(v)]
        if len(lists) == 1:
            return list(map(_flat, lists[0]))
        columns = any(isinstance(v, (list, dict)) for v in found.values())
        return [] if columns else [_flat(found)]
    return list(map(_flat, found)) if _is_records(found) else []


def _is_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)


def _of_lines(path: Path, text: str) -> tuple[list[dict[str, Any]], list[int], tuple[str, ...]]:
    rows, lines, corrupt = [], [], []
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        if not line.strip():
            continue
        try:
            found = json.loads(line)
        except (ValueError, RecursionError):
            found = None
        if isinstance(found, dict):
            rows.append(_flat(found))
            lines.append(number)
        else:
            corrupt.append((number, line.strip()))
    # a log that is cut off ends within a line
    below = [c for c in corrupt[-1:] if lines and c[0] > lines[-1]]
    corrupt = corrupt[: len(corrupt) - len(below)]
    if len(corrupt) > CORRUPT * (len(rows) + len(corrupt)):
        number, line = corrupt[0]
        raise DataError(
            name=f"{path}: line {number}", expected="a JSON object of numbers on each line",
            received=f"{short(line)}, and {len(corrupt)} of {len(corrupt) + len(rows)} lines are "
            "like that", remedy=f"repair or delete them; up to {CORRUPT:.0%} would be skipped",
        )  # fmt: skip
    cut = tuple(f"warning: {path.name}: the last line is cut off and left out" for _ in below)
    return rows, lines, (*skipped_lines(path, corrupt, len(rows)), *cut)


def _flat(row: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    made: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, dict) and not before:
            made |= _flat(value, f"{name}.")
        else:
            made[before + name] = value
    return made


def _by_row(path: Path, rows: list[dict[str, Any]], lines: list[int] | None) -> Table:
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) > MAX_COLUMNS:
        raise DataError(f"{path}: expected at most {MAX_COLUMNS} columns, received {len(names)}")
    return _table(path, {name: [row.get(name) for row in rows] for name in names}, lines)


def _by_column(path: Path, found: Any) -> Table:
    columns = {n: v for n, v in _flat(found).items() if isinstance(v, list)} if isinstance(
        found, dict
    ) else {}  # fmt: skip
    if isinstance(found, dict) and str(found.get("format", "")).startswith("sewfast."):
        columns = {}
    lengths = {len(v) for v in columns.values()}
    if len(lengths) != 1 or lengths == {0}:
        raise DataError(
            name=str(path), expected="a log: an object of numbers on each line, a list of such "
            "objects, or an object of columns of one length", received="other JSON",
            remedy="name a recording, or export the table as CSV",
        )  # fmt: skip
    return _table(path, columns, None)


def _table(path: Path, cells: Mapping[str, list[Any]], lines: list[int] | None) -> Table:
    columns: list[FloatArray] = []
    bad, moments, headers = {}, [], list(cells)
    for i, (name, values) in enumerate(cells.items()):
        if any(isinstance(v, str) and is_moment(v) for v in values[:1]):
            found = seconds_of_texts([v if isinstance(v, str) else "" for v in values])
            if found is not None:
                columns.append(found)
                moments.append(i)
                headers[i] = f"{name} [s]"
                continue
        numbers = [_number(v) for v in values]
        wrong = next((k for k, v in enumerate(numbers) if v is None), None)
        columns.append(np.array([np.nan if v is None else v for v in numbers]))
        if wrong is not None:
            place = f"line {lines[wrong]}" if lines is not None else f"entry {wrong}"
            bad[i] = f"{place}, {name!r}: expected a number, received {short(str(values[wrong]))}"
    table = from_headers(path, headers, columns, bad, lines)
    names = split_units(headers)[0]
    made = tuple(names[i] for i in moments)
    return Table(path, table.columns, table.units, table.unusable, lines, moments=made)


def _number(value: Any) -> float | None:
    if value is None:
        return float("nan")
    if isinstance(value, (int, float)):
        try:
            return float(value)
        except OverflowError:
            return None
    if isinstance(value, str):
        try:
            return None if "_" in value else float(value)
        except ValueError:
            return None
    return None
