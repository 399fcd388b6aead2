"""Results on standard output: JSON, tables, columns as CSV; progress on standard error."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..recordfile import Header


def print_json(value: Any) -> None:
    """Strict JSON: what is not finite becomes null."""
    print(json.dumps(_finite(value), indent=1, allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return value


def print_result(result: Any, args: Any, *, plot: Path | None = None) -> None:
    """A result with `to_json` and `str`, and where its figure has been written."""
    if args.json:
        print_json(result.to_json() | ({"plot": str(plot)} if plot is not None else {}))
        return
    print(result)
    if plot is not None:
        print(f"written to {plot}")


def print_rows(rows: Sequence[Sequence[str]]) -> None:
    """Columns of text, as wide as they need to be; the last one runs free."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (cell.ljust(w) for cell, w in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())


def write_columns(
    out: Path | None,
    columns: Mapping[str, ArrayLike],
    units: Mapping[str, str],
    summary: Mapping[str, Any],
    lines: Sequence[str],
    *,
    as_json: bool,
    header: Header | None = None,
    written: Path | None = None,
) -> None:
    """Columns to `out` and what they say to standard output; without `out` the columns themselves.

    Parameters
    ----------
    out : Path or None
    columns, units
        As for `write_table`.
    summary : mapping
        The result as JSON values.
    lines : sequence of str
        The result as text.
    header : Header or None
        What an `.mcap` file says of itself.
    written : Path or None
        A file that holds the columns already: the recording of a drive.
    """
    if out is not None:
        if out != written:
            _write(out, columns, units, header)
        summary, lines = {**summary, "file": str(out)}, [*lines, f"written to {out}"]
    if as_json:
        print_json(summary if out is not None else {**summary, "columns": _lists(columns)})
    elif out is not None:
        print("\n".join(lines))
    else:
        _print_csv(columns, units)
        print("\n".join(lines), file=sys.stderr)


def _write(
    out: Path, columns: Mapping[str, ArrayLike], units: Mapping[str, str], header: Header | None
) -> None:
    if header is not None and out.suffix.lower() == ".mcap":
        from ..recordfile import save_columns

        save_columns(out, header, {name: columns[name] for name in header.columns})
        return
    from ..writers import write_table

    write_table(out, columns, units=units)


def _lists(columns: Mapping[str, ArrayLike]) -> dict[str, list[float]]:
    import numpy as np

    return {name: np.asarray(c).tolist() for name, c in columns.items()}


def _print_csv(columns: Mapping[str, ArrayLike], units: Mapping[str, str]) -> None:
    from ..dataset import labelled

    print(",".join(labelled(name, units.get(name, "")) for name in columns))
    for row in zip(*_lists(columns).values(), strict=True):
        print(",".join(map(repr, row)))


# --- Progress: a line on a terminal that is drawn anew, elsewhere one now and then ----------------


_WIDTH = 24
_FIRST_LINE, _LATER = 10.0, 1.5
"""Where stderr is no terminal: seconds until the first line, and the factor to each next one."""


class Progress:
    """Draws `done/total`, the best cost and the seconds so far on a terminal.

    Where stderr is no terminal (a file, a pipe, a build's log) it prints a line of its own after
    10 s and then at growing intervals, so that nobody takes long work for a hang. Use it in a
    `with`, which wipes the line at the end.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._began = time.monotonic()
        self._on = sys.stderr.isatty()
        self._next = _FIRST_LINE

    def __call__(self, done: int, total: int, best: float) -> None:
        if not self._on:
            self._now_and_then(f"{100 * done / max(total, 1):.0f} %, best {best:.4g}")
            return
        filled = _WIDTH * done // max(total, 1)
        bar = "=" * filled + " " * (_WIDTH - filled)
        seconds = time.monotonic() - self._began
        self._draw(f"{self._title} [{bar}] {done}/{total}  best {best:.4g}  {seconds:.0f} s")

    def count(self, done: int, total: int) -> None:
        """Show work that has steps but no cost."""
        if self._on:
            filled = _WIDTH * done // max(total, 1)
            bar = "=" * filled + " " * (_WIDTH - filled)
            seconds = time.monotonic() - self._began
            self._draw(f"{self._title} [{bar}] {done}/{total}  {seconds:.0f} s")

    def say(self, text: str) -> None:
        """Show a stage that has no steps to count."""
        if self._on:
            self._draw(f"{self._title}: {text}  {time.monotonic() - self._began:.0f} s")

    def _now_and_then(self, text: str) -> None:
        seconds = time.monotonic() - self._began
        if seconds >= self._next:
            self._next = _LATER * seconds
            print(f"{self._title}: {text}, {seconds:.0f} s", file=sys.stderr, flush=True)

    def _draw(self, line: str) -> None:
        # back to the first column, the line, then clear what an older one left
        print(f"\r{line}\x1b[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._on:
            self._draw("")
