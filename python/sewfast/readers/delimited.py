"""Delimited text (CSV and relatives) -> `Table`."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError
from ..units import is_unit, split_unit
from .containers import MAX_COLUMNS, Table, from_headers, split_units
from .timebase import is_moment, seconds_of_texts

MAX_LINE = 1_000_000
_MISSING = frozenset(
    re.split(" ", "nan na n/a <na> #n/a #na #nv null none nat - -- 1.#qnan -1.#ind 1.#ind")
) | {""}
"""How programs write a missing value, in lower case."""
_DELIMITERS = ";\t|,"
_WORD = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?")
"""A cell between spaces: `u`, `1.5` or `u [V]`."""
_MARKED = re.compile(r"[+-]?\d[\d.,]*(?:e[+-]?\d+)?", re.IGNORECASE)
_APART = re.compile(r"[+-]?\d{1,3}(?:['’\u00a0\u2009\u202f ]\d{3})+(?=[.,]\d|$)")
"""Digits in groups of three, separated by marks with no other meaning."""
CORRUPT = 0.01
"""Part of the lines that can be corrupt, as serial ports lose characters: they are skipped."""


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
    thousands: str = ""


def read_delimited(path: Path, raw: bytes) -> Table:
    """Read delimited text with a header row.
    Lines above the header, a few shorter ones at the end and up to 1 % of corrupt lines are
    skipped, with a note in `Table.notes`; a row of units below the header gives the units.
    Delimiter (comma, semicolon, tab, bar, space), decimal commas and thousands separators are
    recognised; `#` begins a comment. Empty cells are NaN, moments are seconds from the first one.
    """
    layout = _whole(_layout(path, _decode(path, raw)))
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
    head = text[:4096].rstrip("\0\x1a") if text.strip("\0\x1a") else text[:4096]
    strange = sum((c < " " and c not in "\t\r\n") or "\x7f" <= c <= "\x9f" for c in head)
    if "\0" in head or strange > 0.02 * len(head):
        raise DataError(
            f"{path}: expected text (CSV), .mat, .npz or Parquet; received binary data of an "
            "unknown kind"
        )
    # DOS ends a text with ^Z; loggers that reserve space in advance leave zeros
    return text.rstrip("\0\x1a").replace("\r\n", "\n").replace("\r", "\n")


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Offset after each line, and the line."""
    start = 0
    while start < len(text):
        stop = text.find("\n", start)
        stop = len(text) if stop < 0 else stop
        yield stop + 1, text[start:stop]
        start = stop + 1


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return _WORD.findall(line)
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in row]


def _pick_delimiter(line: str) -> str:
    """The most frequent delimiter; the first of several equally frequent ones."""
    return max(_DELIMITERS, key=line.count)


def _is_numeric(cells: list[str]) -> bool:
    """Whether all cells are numbers or, as in a time column, moments."""
    return all(_is_number(c) or is_moment(c) for c in cells)


def _is_number(cell: str) -> bool:
    return _number(cell.replace(",", "."), ".") is not None


def _layout(path: Path, text: str) -> _Layout:
    """Find the header: the first line with content, or the comment above bare numbers.
    Where numbers begin farther down, below a line of names that fits them, the lines above are not
    part of the table but a preamble, such as that of an oscilloscope's export.
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
        found = _numbers(body[:MAX_LINE].lstrip("\n").partition("\n")[0])
        if found is not None and len(_cells(line, found[0])) == found[1] > 1:
            # names can contain other delimiters: `Time, s;Voltage, V`
            delimiter, header = found[0], _cells(line, found[0])
        # two cells can be one number with a decimal comma
        if len(header) == 1 and found is not None and (found[0] != "," or found[1] > 2):
            spaced = _cells(line, " ")
            if found[0] != " " or len(spaced) != found[1]:
                raise DataError(
                    name=f"{path}: line {skipped + 1}",
                    expected=f"a header with names for the {found[1]} columns below it",
                    received=short(line), remedy="add one, such as t,u,y",
                )  # fmt: skip
            delimiter, header = " ", spaced
        if _is_numeric(header):
            named = _cells(comment, _pick_delimiter(comment)) if comment else []
            if len(named) != len(header) or _is_numeric(named):
                raise DataError(
                    f"{path}: expected a header with column names (such as t,u,y) in the first "
                    f"line, received numbers: {short(line)}; add one"
                )
            header, body, above = named, text[offset - len(line) - 1 :], skipped
        return _checked(_Layout(path, header, body, above, delimiter, _decimal(delimiter, body)))
    raise DataError(f"{path}: the file is empty; expected a header and rows of numbers")


def _below_preamble(path: Path, text: str) -> _Layout | None:
    """The layout of a table with lines above its header. None where the table begins in the first
    line with content, or where its beginning is not clear: the first line is then the header.
    """
    lines: list[tuple[int, str]] = []
    for offset, line in _lines(text):
        # lines within which the numbers of a table must begin for lines above its header to be
        # skipped
        if len(line) > MAX_LINE or len(lines) >= 200:
            return None
        lines.append((offset, line))
        at = len(lines) - 1
        found = _numbers(line)
        if found is None:
            continue
        # a line of numbers in a preamble has no line of the same width below it
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
        if names is None and not heads and _describes(lines[k][1], delimiter, width):
            # a line that describes the columns, such as sample times, between names and numbers
            continue
        if len(heads) == 1 and all(map(_looks_like_unit, heads[0])):
            names = names or _numbered(lines[k][1], delimiter, width)
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
        # names and a row of text: an ordinary table; its columns of text are reported later
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
        shown = short(lines[skipped[0]][1].strip())
        many = _count(len(skipped), "above the header")
        notes.append(f"{path.name}: {many} skipped: {shown}")
    start = lines[at][0] - len(lines[at][1]) - 1
    body = text[max(start, 0) :]
    return _Layout(
        path, header, body, at, delimiter, _decimal(delimiter, body),
        tuple(notes),
    )  # fmt: skip


def _numbers(line: str) -> tuple[str, int] | None:
    """Delimiter and number of cells of a line of numbers; None for any other line."""
    if not line.strip() or len(line) > MAX_LINE:
        return None
    for delimiter in (*_DELIMITERS, " "):
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
    # LabVIEW names a column of comments, but most lines have no cell for it
    while len(cells) > width and cells[-1].lower() in ("", "comment"):
        cells.pop()
    named = len(cells) == width and all(c and not _is_number(c) for c in cells)
    return cells if named else None


def _describes(line: str, delimiter: str, width: int) -> bool:
    """Whether a line describes each column: a text, then numbers."""
    cells = _cells(line, delimiter)
    return len(cells) == width and bool(cells[0]) and not _is_numeric(cells[:1])


def _numbered(line: str, delimiter: str, width: int) -> list[str] | None:
    """The cells of a line of names above units, where some names are numbers (scope channels)."""
    cells = _cells(line, delimiter)
    named = len(cells) == width and all(cells) and not _is_numeric(cells)
    return cells if named else None


def _looks_like_unit(cell: str) -> bool:
    """Whether a cell below a name is its unit: text in brackets, or a known unit."""
    text = cell.strip()
    if len(text) > 2 and text[0] + text[-1] in ("()", "[]"):
        return True
    return is_unit(text)


def _decimal(delimiter: str, body: str) -> str:
    """The decimal mark of a file of plain numbers; `_written` decides from the cells."""
    return "," if delimiter != "," and "," in body and "." not in body else "."


def _written(layout: _Layout, rows: list[list[str]]) -> _Layout:
    """The layout with the decimal mark and thousands separator found in the cells.
    A cell with both marks shows which is which. Without such a cell, a comma is a decimal mark if
    no cell has a point. `"1,234"` alone, quoted between commas, is ambiguous and not read.
    """
    if "," not in layout.body or (layout.delimiter == "," and '"' not in layout.body):
        return replace(layout, decimal=".")
    marked = {c for row in rows for c in map(str.strip, row) if _MARKED.fullmatch(c)}
    both = {c for c in marked if "," in c and "." in c}
    if both:
        decimal = max(",.", key=min(both).rfind)
        thousands = ",.".replace(decimal, "")
        return replace(layout, decimal=decimal, thousands=thousands)
    commas = {c for c in marked if "," in c}
    points = {c for c in marked if c.count(".") == 1}
    groups = all(re.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+", c) for c in commas)
    if commas and not points and not (layout.delimiter == "," and groups):
        return replace(layout, decimal=",")
    return replace(layout, decimal=".")


def _checked(layout: _Layout) -> _Layout:
    if layout.header and not layout.header[-1]:
        # some loggers end each row with a delimiter
        layout.header.pop()
    if len(layout.header) > MAX_COLUMNS:
        raise DataError(
            f"{layout.path}: expected at most {MAX_COLUMNS} columns, received {len(layout.header)}"
        )
    if not layout.body.strip():
        raise DataError(f"{layout.path}: a header but no rows; expected rows of numbers below it")
    return layout


def _whole(layout: _Layout) -> _Layout:
    """The layout without a last line that was cut off: it has no line end, and fewer cells or, in
    its last cell, fewer decimals than all the lines above it.
    """
    # lines with which the last one is compared
    compared = 1000
    body, _, last = layout.body.rpartition("\n")
    above = body.rsplit("\n", compared)[-compared:]
    # as of corrupt lines, at most a hundredth
    if len(above) < 1.0 / CORRUPT or not last.strip():
        return layout

    def ending(line: str) -> tuple[int, int]:
        cells = line.split(None if layout.delimiter == " " else layout.delimiter)
        end = cells[-1].strip() if cells else ""
        if end.lstrip("+-").isalpha():  # nan and inf have no decimals
            return len(cells), len(line)
        whole, mark, decimals = end.partition(layout.decimal)
        return len(cells), len(decimals) if whole or mark else -1

    try:
        cells = _cells(last, layout.delimiter)
    except csv.Error:  # refused later, with its line number
        return layout
    width = len(layout.header)
    if _is_numeric(cells) and (
        ending(last) < min((e for e in map(ending, above) if e[0] == width), default=(0, 0))
    ):
        note = f"warning: {layout.path.name}: the last line is cut off and left out: {short(last)}"
        return replace(layout, body=body, notes=(*layout.notes, note))
    return layout


def _fast_pass(layout: _Layout) -> list[FloatArray] | None:
    """All cells, by NumPy's parser; None if a cell is not a number or the rows differ in length."""
    body = layout.body.rstrip("\n")
    if layout.decimal == ",":
        body = body.replace(",", ".")
    try:
        values = np.loadtxt(
            # a generator, so that Ctrl-C is heard within a long file
            (line for line in io.StringIO(body)),
            delimiter=None if layout.delimiter == " " else layout.delimiter,
            comments=None, quotechar='"', ndmin=2,
        )  # fmt: skip
    except (ValueError, OverflowError):
        return None
    if values.shape != (body.count("\n") + 1, len(layout.header)):
        return None
    return list(values.T)


def _slow_pass(layout: _Layout) -> Table:
    lines, rows, below, corrupt = _rows(layout)
    if not rows:
        raise DataError(f"{layout.path}: a header but no rows; expected rows of numbers below it")
    layout = _written(layout, rows)
    header, columns, bad = list(layout.header), [], {}
    moments = []
    spoiled = _spoiled_rows(layout, rows, len(corrupt))
    corrupt += [(lines[k], layout.delimiter.join(rows[k])) for k in spoiled]
    if spoiled:
        gone = set(spoiled)
        lines = [line for k, line in enumerate(lines) if k not in gone]
        rows = [row for k, row in enumerate(rows) if k not in gone]
    for i, cells in enumerate(zip(*rows, strict=True)):
        column = _column(layout, cells)
        if column is None and is_moment(cells[0]):
            column = seconds_of_texts(cells)
            if column is not None:
                header[i] = f"{split_unit(header[i])[0]} [s]"
                moments.append(i)
        if column is None:
            k, column = _spoiled(layout, cells)
            wrong = _wrong(layout, cells)
            bad[i] = _complaint(layout, lines[k], i, cells[k], wrong, len(corrupt), len(rows))
        columns.append(column)
    table = from_headers(layout.path, header, columns, bad, lines)
    names = split_units(header)[0]
    notes = (*layout.notes, *below, *skipped_lines(layout.path, corrupt, len(rows)))
    return replace(table, notes=notes, moments=tuple(names[i] for i in moments))


def _spoiled_rows(layout: _Layout, rows: list[list[str]], corrupt: int) -> list[int]:
    """Rows with a cell that is no number in a column of numbers, if they are few."""
    few = CORRUPT * (len(rows) + corrupt) - corrupt
    found: set[int] = set()
    for cells in zip(*rows, strict=True):
        if _column(layout, cells) is not None:
            continue
        # a column of moments, or of text, in which a few cells were lost
        dated = sum(map(is_moment, cells)) > len(cells) / 2
        wrong = [
            k for k, c in enumerate(cells)
            if not (is_moment(c) if dated else _is_read(layout, c))
        ]  # fmt: skip
        if len(wrong) <= few:
            found.update(wrong)
    return sorted(found) if len(found) <= few else []


def _is_read(layout: _Layout, cell: str) -> bool:
    return _number(cell, layout.decimal, layout.thousands) is not None


def _wrong(layout: _Layout, cells: Sequence[str]) -> int:
    return sum(not _is_read(layout, c) for c in cells)


def skipped_lines(path: Path, corrupt: list[tuple[int, str]], left: int) -> tuple[str, ...]:
    """A note on corrupt lines, each with its number and text, beside `left` good ones."""
    if not corrupt:
        return ()
    corrupt = sorted(corrupt)
    shown = ", ".join(f"{number} ({short(text)})" for number, text in corrupt[:3])
    more = f" and {len(corrupt) - 3} more" if len(corrupt) > 3 else ""
    one = len(corrupt) == 1
    return (
        f"warning: {path.name}: {len(corrupt)} of {left + len(corrupt)} lines skipped, as "
        f"{'it has' if one else 'they have'} cells that are missing or no numbers: "
        f"line{'' if one else 's'} {shown}{more}",
    )


def _rows(
    layout: _Layout,
) -> tuple[list[int], list[list[str]], tuple[str, ...], list[tuple[int, str]]]:
    """Line numbers and cells of the rows, a note on lines below them, and corrupt lines.
    Blank lines and comments do not count as rows. Lines of another width are corrupt; more of them
    than `CORRUPT` are refused.
    """
    width = len(layout.header)
    lines: list[int] = []
    rows: list[list[str]] = []
    other: list[tuple[int, list[str]]] = []
    for number, cells in _split(layout):
        while len(cells) > width and not cells[-1].strip():
            cells.pop()
        blank = not any(c.strip() for c in cells) and len(cells) < max(width, 2)
        if blank or cells[0].lstrip().startswith("#"):
            continue
        if len(cells) != width:
            other.append((number, cells))
            continue
        lines.append(number)
        rows.append(cells)
    below = [o for o in other if lines and o[0] > lines[-1]]
    # a footer is a few shorter lines
    # most lines below a table that are left out if they have fewer cells
    if len(below) > 20 or any(len(cells) > width for _, cells in below):
        below = []
    corrupt = other[: len(other) - len(below)]
    if corrupt and len(corrupt) > CORRUPT * (len(rows) + len(corrupt)):
        raise _of_other_width(layout, *corrupt[0], len(corrupt), len(rows) + len(corrupt))
    notes: tuple[str, ...] = ()
    if below:
        shown = short(layout.delimiter.join(below[0][1]))
        many = _count(len(below), "below the table")
        notes = (f"{layout.path.name}: {many} left out: {shown}",)
    return lines, rows, notes, [(n, layout.delimiter.join(cells)) for n, cells in corrupt]


def _split(layout: _Layout) -> Iterator[tuple[int, list[str]]]:
    """Line number and cells of each line."""
    if layout.delimiter == " ":
        for k, (_, line) in enumerate(_lines(layout.body)):
            yield layout.skipped + k + 1, line.split() or [""]
        return
    reader = csv.reader((line for _, line in _lines(layout.body)), delimiter=layout.delimiter)
    try:
        for cells in reader:
            yield layout.skipped + reader.line_num, cells or [""]
    except csv.Error as e:
        raise DataError(f"{layout.path}: line {layout.skipped + reader.line_num}: {e}") from e


def _of_other_width(
    layout: _Layout, number: int, cells: list[str], count: int, total: int
) -> DataError:
    hint = "repair or delete the line"
    if count > 1:
        hint = (
            f"{count} of {total} lines are like that, and up to {CORRUPT:.0%} would be skipped: "
            "repair or delete them, or record again at a lower baud rate"
        )
    if layout.delimiter == "," and len(cells) > len(layout.header):
        hint += "; numbers with decimal commas need semicolons between the columns"
    return DataError(
        f"{layout.path}: line {number}: expected {len(layout.header)} cells, as in the header, "
        f"received {len(cells)}: {short(layout.delimiter.join(cells))}; {hint}"
    )


def _count(lines: int, where: str) -> str:
    return f"1 line {where} is" if lines == 1 else f"{lines} lines {where} are"


def _column(layout: _Layout, cells: Sequence[str]) -> FloatArray | None:
    """The numbers of a column; None if a cell is not a number."""
    try:
        # most columns; Python's own digit separators are not a number format of data files
        if layout.decimal == "." and not layout.thousands and not any("_" in c for c in cells):
            return np.array([float(c) for c in cells])
    except ValueError:
        pass
    found = []
    for cell in cells:
        value = _number(cell, layout.decimal, layout.thousands)
        if value is None:
            return None
        found.append(value)
    return np.array(found)


def _spoiled(layout: _Layout, cells: Sequence[str]) -> tuple[int, FloatArray]:
    """Index of the first cell that is not a number, and NaN for the column."""
    wrong = (_number(c, layout.decimal, layout.thousands) is None for c in cells)
    return next(k for k, one in enumerate(wrong) if one), np.full(len(cells), np.nan)


def _number(cell: str, decimal: str, thousands: str = "") -> float | None:
    text = cell.strip()
    if text.lower() in _MISSING:
        return float("nan")
    if _APART.match(text):
        text = re.sub(r"['’\u00a0\u2009\u202f ]", "", text)
    if thousands and thousands in text:
        groups = rf"[+-]?\d{{1,3}}(?:\{thousands}\d{{3}})+(?!\d|\{thousands})"
        text = text.replace(thousands, "") if re.match(groups, text) else "?"
    if decimal == ",":
        text = "?" if "." in text else text.replace(",", ".")
    try:
        # Python's own digit separators are not a number format of data files
        return None if "_" in text else float(text)
    except ValueError:
        return None


def _complaint(
    layout: _Layout, line: int, column: int, cell: str, count: int, corrupt: int, rows: int
) -> str:
    hint = "; repair or delete the line"
    if count > 1:
        others = f" and {corrupt} lines have too few or too many" if corrupt else ""
        hint = (
            f"; {count} cells of this column are no numbers{others}, and of {rows + corrupt} lines "
            f"up to {CORRUPT:.0%} with such cells would be skipped: repair or delete them, or "
            "choose another column"
        )
    if "," in cell and layout.decimal == ".":
        hint = "; the file also holds decimal points: write all numbers one way"
    return (
        f"line {line}, column {layout.header[column]!r}: expected a number, received "
        f"{short(cell)}{hint}"
    )


def short(text: str) -> str:
    """A text in quotes, at most 60 characters of it."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
