"""Output of the commands: JSON, tables, columns as CSV, notes."""

from __future__ import annotations

import json
import logging
import math
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..tables import aligned

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..recordfile import Header


DONE, FAULT, REFUSED, INTERRUPTED = 0, 1, 2, 130
"""Exit codes (docs/cli.md)."""


LOG = logging.getLogger(__package__)
"""Logger for the notes of the commands; its parent is the package's logger."""


def note(text: str) -> None:
    """Print a note to standard error, except with `--quiet`."""
    LOG.info("%s", text)


def suggested(*words: object) -> str:
    """A command to type: names that hold spaces in quotes, no `Path` that looks like an option."""
    safe = (f"./{w}" if isinstance(w, Path) and str(w).startswith("-") else str(w) for w in words)
    return shlex.join(["sewfast", *safe])


class _ToStderr(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        print(record.getMessage(), file=sys.stderr, flush=True)


@contextmanager
def logging_to_stderr(*, quiet: bool = False, verbose: int = 0) -> Iterator[None]:
    """Notes, and with `verbose` the package's log, on standard error while a command runs."""
    package = LOG.parent
    assert package is not None
    if any(isinstance(handler, _ToStderr) for handler in package.handlers):
        # a stage of another command, which has set this up already
        yield
        return
    before = [(logger, logger.level) for logger in (LOG, package)]
    handler = _ToStderr()
    LOG.setLevel(logging.WARNING if quiet else logging.INFO)
    package.setLevel((logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)])
    package.addHandler(handler)
    try:
        yield
    finally:
        package.removeHandler(handler)
        for logger, level in before:
            logger.setLevel(level)


def print_json(value: Any) -> None:
    """Print strict JSON, with null for NaN and infinity."""
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
    """Print a result by its `to_json` or `str`, and the file of its figure."""
    if args.json:
        print_json(result.to_json() | ({"plot": str(plot)} if plot is not None else {}))
        return
    print(result)
    if plot is not None:
        print(f"written to {plot}")


def print_rows(rows: Sequence[Sequence[str]]) -> None:
    print("\n".join(aligned(rows)))


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
    """Write columns to `out` and print the result; without `out` print the columns as CSV.
    `columns` and `units` are as for `write_table`; `summary` is the result as JSON values, and
    `lines` are the result as text. `header` is for an `.mcap` file. `written` is a file that
    contains the columns already: the recording of a drive.
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
    from ..storage import write_table

    write_table(out, columns, units=units)


def _lists(columns: Mapping[str, ArrayLike]) -> dict[str, list[float]]:
    import numpy as np

    return {name: np.asarray(c).tolist() for name, c in columns.items()}


def _print_csv(columns: Mapping[str, ArrayLike], units: Mapping[str, str]) -> None:
    from ..dataset import labelled

    print(",".join(labelled(name, units.get(name, "")) for name in columns))
    for row in zip(*_lists(columns).values(), strict=True):
        print(",".join(map(repr, row)))
