"""One file of any known format -> `Table`; one recording file -> `Dataset`."""

from __future__ import annotations

import io
import json
import logging
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import plugins
from ..dataset import Dataset, Experiment, FloatArray
from ..dataset.experiment import as_weights, require_some_weight
from ..errors import (
    DataError,
    SettingError,
    SewfastError,
    located,
    not_installed,
    printable,
)
from ..recordfile.format import MAGIC
from ..recordfile.reader import decode_recording
from ..speed import speed_between_gaps
from ..storage import file_bytes
from .containers import Table, freeze, labels_of, read_mat, read_npz
from .delimited import read_delimited
from .frames import collected, of_arrow, table_of
from .jsonlog import is_json, read_json
from .logs import is_log, read_log
from .roles import recognised
from .sage import read_folder
from .timebase import TOLERANCE, Grid, time_base

LOG = logging.getLogger("sewfast")

# --- Parquet -> Table -----------------------------------------------------------------------------


def read_parquet(path: Path, raw: bytes) -> Table:
    """Read the numeric columns of a Parquet file; nulls are NaN."""
    try:
        import pyarrow.parquet as pq
    except ImportError as e:
        raise not_installed("pyarrow", "reading Parquet", "sewfast[parquet]") from e
    try:
        found = pq.read_table(io.BytesIO(raw))
    except Exception as e:
        # a damaged file can make the parser raise anything
        raise DataError(f"{path}: expected a Parquet file, but it cannot be read: {e}") from e
    if found.num_rows == 0:
        raise DataError(f"{path}: expected rows of numbers, received none")
    return collected(path, of_arrow(found, _lerobot_labels(path)))


def _lerobot_labels(path: Path) -> dict[str, tuple[str, ...]]:
    """Labels of LeRobot's list columns, from `meta/info.json` in a folder above an episode."""
    for folder in list(path.absolute().parents)[:4]:
        try:
            features = json.loads((folder / "meta" / "info.json").read_text("utf-8"))["features"]
            named = {str(column): of.get("names") for column, of in features.items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue
        for column, names in named.items():
            # version 2.0 has {"motors": [...]}
            named[column] = next(iter(names.values()), ()) if isinstance(names, dict) else names
        return {column: labels_of({"names": names}) for column, names in named.items()}
    return {}


# --- MCAP recordings of the package -> Table ------------------------------------------------------


def read_mcap(path: Path, raw: bytes) -> Table:
    """Time and columns of a recording, NaN in its gaps and where it is damaged."""
    found = decode_recording(path, raw)
    columns = {name: freeze(c) for name, c in found.table_columns().items()}
    header = found.header
    return Table(path, columns, found.units, Ts=header.Ts, counts_per_rev=header.counts_per_rev)


RECORDED = {"t", "u", "counts", "y"}
"""Columns of a recording of the package."""


def smoothed_by(table: Table, output: str) -> float | None:
    """The `y` of a recording of the package over the counts of a sample, if it was smoothed from
    the counts beside it on both sides, as `Recording` does; None for another output.

    The way of such a speed follows the counts to their rounding and without lag. A difference lags
    by half a sample, and what looks back alone by more.
    """
    if output != "y" or not set(table.names) >= RECORDED:
        return None
    if len(table["counts"]) != len(table[output]):
        return None
    counts, y = table["counts"], table[output]
    gaps = np.r_[-1, np.flatnonzero(~np.isfinite(counts + y)), len(y)]
    k = int(np.argmax(np.diff(gaps)))
    counts, y = (x[gaps[k] + 1 : gaps[k + 1]] for x in (counts, y))
    if len(y) == 0:
        return None

    def followed(way: FloatArray) -> tuple[float, float]:
        """Root mean square in counts after the best scale, and that scale."""
        c, w = counts - counts.mean(), way - way.mean()
        scale = (c @ w) / (w @ w)
        return float(np.sqrt(np.mean((c - scale * w) ** 2))), float(scale)

    with np.errstate(all="ignore"):  # what is no number is no answer
        back = np.cumsum(y)
        (off, scale), (lagged, _) = followed(back - 0.5 * y), followed(back)
        return 1.0 / scale if off < 0.5 and off < lagged else None


# --- Formats of other packages -> Table -----------------------------------------------------------

# An entry point `sewfast.readers` of any installed package reads a file. Its name is the file's
# ending without the dot, its object a function of the path that returns a table in memory (as for
# `table_of`) or a `Table`. It is searched for a file whose ending is not in `OWN`.

GROUP = "sewfast.readers"
OWN = frozenset({"csv", "tsv", "txt", "mat", "npz", "npy", "parquet", "mcap", "xls", "xlsx"})
"""Endings that sewfast reads itself; looking an entry point up takes milliseconds a file."""


def read_installed(path: Path) -> Table | None:
    """Read a file by the installed package that handles its ending; None if there is none."""
    ending = path.suffix.lower().removeprefix(".")
    if not ending or ending in OWN:
        return None
    found = plugins.points(GROUP, ending)
    if not found:
        return None
    task = f"that reads .{ending}"
    remedy = "uninstall one, or read the table with one of them and pass it on: read(table)"
    point = plugins.only(found, str(path), task, remedy)
    read = plugins.function(point, str(path), task)
    try:
        return _installed_table(path, read(path))
    except SewfastError:
        raise
    except Exception as e:
        # a function of another package can raise anything
        package = plugins.package(point)
        raise DataError(
            name=str(path), expected=f"a file that {package} can read",
            received=plugins.told(e), remedy=f"see the documentation of {package}",
        ) from e  # fmt: skip


def _installed_table(path: Path, found: Any) -> Table:
    if isinstance(found, Table):
        return replace(found, path=path)
    try:
        return replace(table_of(found), path=path)
    except SettingError as e:
        raise DataError(
            name=str(path), expected="a table from the package that reads it",
            received=type(found).__name__, remedy="its function returns a mapping of name to array",
        ) from e  # fmt: skip


# --- One file of any known format -> Table; recognised by its first bytes, then by its extension


def read_table(path: Any) -> Table:
    """Read all columns of a CSV, `.mat`, `.npz`, Parquet, MCAP or JSON file, of a log of another
    tool, or of a table in memory.

    Parameters
    ----------
    path : path or table
        The file's first bytes decide the format if possible, otherwise its extension. A table comes
        from pandas, polars, pyarrow (or anything with `__arrow_c_stream__`), xarray (a Dataset) or
        is a mapping of name to array; null, NA and NaT are NaN, moments become seconds from the
        first one. Logs are MDF, TDMS, PX4 ULog, WPILib's data log and ROS bags (`.bag`, `.mcap`);
        the signal with most samples gives the rows, others are held. JSON is an object of numbers
        on each line (JSON lines), a list of such objects, or an object of columns. If an installed
        package handles the file's ending (entry point `sewfast.readers`), that package reads it.
        A folder is a motion as SAGE records it. Arrays with labels, in messages of ROS, episodes of
        LeRobot, archives with `joint_names`, become columns `field.LABEL`.

    Returns
    -------
    Table
        Columns by name, float64.

    Raises
    ------
    DataError
        If the file is missing, empty, damaged or of an unknown kind; the message names it.
    SettingError
        If the format needs a package that is not installed, or for what is neither path nor
        table.
    """
    if not isinstance(path, (str, os.PathLike)):
        return table_of(path)
    path = Path(path)
    table = read_folder(path) if path.is_dir() else _table(path, _bytes(path))
    rows = max(map(len, table.columns.values()), default=0)
    LOG.info("%s: read, %d rows of %s", path, rows, printable(", ".join(table.names)))
    return table


def _table(path: Path, raw: bytes) -> Table:
    if is_log(raw):
        return read_log(path, raw)
    if raw.startswith(MAGIC) or path.suffix.lower() == ".mcap":
        return read_mcap(path, raw)
    # before the containers: their first bytes do not identify the content
    if (found := read_installed(path)) is not None:
        return found
    if raw.startswith(b"PAR1"):
        return read_parquet(path, raw)
    if raw.startswith(b"PK\x03\x04"):
        return _zipped(path, raw)
    if raw.startswith((b"MATLAB ", b"\x89HDF")) or path.suffix.lower() == ".mat":
        return read_mat(path, raw)
    if path.suffix.lower() in (".npz", ".parquet", ".npy"):
        raise DataError(
            f"{path}: expected a {path.suffix} file, but its content is of another kind or "
            "damaged; supported are CSV, .mat, .npz, Parquet, recordings (.mcap) and logs of "
            "other tools"
        )
    if is_json(raw):
        return read_json(path, raw)
    return read_delimited(path, raw)


def _zipped(path: Path, raw: bytes) -> Table:
    if b"xl/" in raw[:4096] or path.suffix.lower().startswith(".xls"):
        raise DataError(
            name=str(path), expected="a table", received="an Excel workbook",
            remedy="save the sheet as CSV",
        )  # fmt: skip
    return read_npz(path, raw)


def _bytes(path: Path) -> bytes:
    raw = file_bytes(path)
    if not raw:
        raise DataError(
            name=str(path), expected="a header and rows of numbers", received="an empty file"
        )
    return raw


# --- One recording file -> `Dataset` --------------------------------------------------------------


def read(
    path: Any,
    *,
    inputs: str | Sequence[str] | None = None,
    output: str | None = None,
    Ts: float | None = None,
    counts: str | None = None,
    counts_per_rev: float | None = None,
    time: str | None = None,
    channels: Sequence[str] = (),
    name: str | None = None,
    weights: str | None = None,
) -> Dataset:
    """Read inputs and an output from one recording, a file or a table in memory.

    Parameters
    ----------
    path : path or table
        CSV, `.mat`, `.npz`, Parquet or MCAP; a table of pandas, polars, pyarrow or xarray, a
        mapping of name to array, or a `Table`; see `read_table`.
    inputs : str or sequence of str, or None
        Column names of the inputs. None: recognised by names and units, as on the command line.
    output : str or None
        Column name of the output. None, without `counts`: recognised likewise. Where inputs are
        named and no column shows that it is the output, the output stays NaN: enough to simulate
        from rest.
    Ts : float or None
        Sample time [s]. Where the file has a time column with even steps, the two must agree
        within 1 % and this one is used. Where its steps are uneven, the rows are resampled to it
        (by default to the median step): outputs by straight lines, inputs as held; steps of more
        than 3.5 periods are gaps, NaN in all columns. The notes of the data set describe this.
    counts, counts_per_rev : str and float, or None
        Column of encoder counts. The output is then the speed [RPM] computed from it by a Kalman
        smoother, each piece between gaps (NaN) separately, and `output` only names it (`speed` by
        default). A recording (MCAP) states the counts of one turn itself.
    time : str or None
        Name of the time column if it is none of t, time, timestamp, seconds, alone or with a
        unit (`t [ms]`, `time_us`). Without any, a file's variable Ts or fs is used.
    channels : sequence of str
        Further columns to carry along.
    name : str or None
        Name of the experiment, for messages; None: the file's name.
    weights : str or None
        Column of weights: how much the squared error of each sample counts (`Experiment.weights`).
        Rows of weight 0 do not affect a resampled `output`; they do affect a speed computed from
        counts.

    Returns
    -------
    Dataset
        One experiment.

    Raises
    ------
    DataError
        If the file or a column cannot be used, or the input is neither named nor recognised.
    SettingError
        If the sample time is missing or settings contradict each other.
    """
    table = path if isinstance(path, Table) else read_table(path)
    named = _names(table, inputs, output, counts)
    if not named and inputs is not None:
        raise SettingError("inputs: expected at least one column name, received none")
    if not named or (output is None and counts is None):
        found = recognised(table, inputs=named, output=output, counts=counts, time=time)
        named = named or (found.input,)
        if output is None and counts is None:
            output, counts = found.output, found.counts
    return read_columns(
        table, inputs=named, output=output, Ts=Ts, counts=counts, counts_per_rev=counts_per_rev,
        time=time, channels=channels, name=name, weights=weights,
    )  # fmt: skip


def read_columns(
    path: Any,
    *,
    inputs: str | Sequence[str],
    output: str | None = None,
    Ts: float | None = None,
    counts: str | None = None,
    counts_per_rev: float | None = None,
    time: str | None = None,
    channels: Sequence[str] = (),
    name: str | None = None,
    weights: str | None = None,
) -> Dataset:
    """As `read`, with no column recognised: without output and counts the output is NaN."""
    table = path if isinstance(path, Table) else read_table(path)
    names = _names(table, inputs, output, counts)
    if not names:
        raise SettingError("inputs: expected at least one column name, received none")
    if counts is not None and counts_per_rev is None:
        counts_per_rev = table.counts_per_rev
    if (counts is None) != (counts_per_rev is None):
        raise SettingError(
            name="counts, counts_per_rev",
            expected="both, the column of encoder counts and the counts of one turn",
            received=f"{counts!r} and {counts_per_rev!r}", remedy="give both or neither",
        )  # fmt: skip
    names = tuple(table.resolve(n) for n in names)
    _require_distinct(names, None if output is None or counts else table.resolve(output))
    base = time_base(table, Ts, time)
    slower = base.grid is not None and base.Ts > (1.0 + TOLERANCE) * base.grid.period
    if slower and base.grid is not None:
        # first at the recording's own rate, so that `resample` can filter before slowing down
        wanted, base = base.Ts, time_base(table, base.grid.period, time)
    weigh = None if weights is None else _weights(table, weights, names[0])
    if base.grid is not None:
        measured = (counts,) if counts else (output,) if output else ()
        if set(table.names) >= RECORDED:
            measured = tuple(dict.fromkeys((*measured, "counts")))  # which tells what its y is
        if weigh is not None:
            if output and not counts:
                table = _without_weightless(table, output, weigh)
            # samples in a gap were not measured and need no weight
            weigh = np.nan_to_num(base.grid.output(weigh))
        table = _on_grid(table, base.grid, names, (*measured, *channels))
    u = _side_by_side(table, names)
    y, label, unit, source = _output(table, output, counts, counts_per_rev, base.Ts, len(u))
    _require_length(table, label, y, names[0], len(u))
    extra = {c: table[c] for c in channels}
    experiment = Experiment(u, y, extra, name or table.path.name, weights=weigh)
    require_some_weight(experiment)
    data = Dataset(
        (experiment,), base.Ts, names, label, tuple(table.unit(n) for n in names), unit, source,
        (*table.notes, *base.notes),
        looks_ahead=source is not None
        or (output is not None and smoothed_by(table, label) is not None)
        or (base.grid is not None and not base.grid.exact),
    )  # fmt: skip
    return data.resample(wanted) if slower else data


def _names(table: Table, inputs: Any, output: str | None, counts: str | None) -> tuple[str, ...]:
    """The names of the inputs, none if none is given; refuses what is no name."""
    single = isinstance(inputs, str) or not isinstance(inputs, Iterable)
    names: tuple[Any, ...] = () if inputs is None else (inputs,) if single else tuple(inputs)
    for role, one in [*(("inputs", n) for n in names), ("output", output), ("counts", counts)]:
        if not isinstance(one, str | None) or (role == "inputs" and one is None):
            raise SettingError(
                f"{role}: expected the name of a column, received {one!r}; names are text, as in "
                f"'{table.names[0] if len(table) else 'u'}'"
            )
    return names


def _on_grid(table: Table, grid: Grid, inputs: Sequence[str], measured: Sequence[str]) -> Table:
    """The table with its inputs and measured columns at even times."""
    made = {}
    for name in (*inputs, *measured):
        column = table[name]
        _require_length(table, name, column, "time", grid.count)
        made[table.resolve(name)] = grid.held(column) if name in inputs else grid.output(column)
    return replace(table, columns={**table.columns, **made}, lines=None)


def _weights(table: Table, name: str, other: str) -> FloatArray:
    column = table[name]
    _require_length(table, name, column, other, len(table[other]))
    try:
        return as_weights(column, len(column))
    except DataError as e:
        raise located(DataError, f"{table.path}: column {name!r}", e) from e


def _without_weightless(table: Table, output: str, weights: FloatArray) -> Table:
    column = np.where(weights == 0.0, np.nan, table[output])
    return replace(table, columns={**table.columns, table.resolve(output): column}, lines=None)


def _require_distinct(inputs: tuple[str, ...], output: str | None) -> None:
    twice = next((n for i, n in enumerate(inputs) if n in inputs[:i] or n == output), None)
    if twice is not None:
        raise SettingError(
            f"expected different columns as inputs and output, received {twice!r} twice; "
            "name the column that was measured as output"
        )


def _output(
    table: Table,
    output: str | None,
    counts: str | None,
    counts_per_rev: float | None,
    Ts: float,
    n: int,
) -> tuple[FloatArray, str, str, tuple[str, float] | None]:
    """Output, its name, its unit and, if it is computed from counts, their source."""
    if counts is not None and counts_per_rev is not None:
        y = _speed(table, counts, counts_per_rev, Ts)
        return y, output or "speed", "RPM", (table.resolve(counts), float(counts_per_rev))
    if output is None:
        return np.full(n, np.nan), "y", "", None
    return table[output], table.resolve(output), table.unit(output), None


def _side_by_side(table: Table, names: Sequence[str]) -> FloatArray:
    first = table[names[0]]
    for name in names[1:]:
        _require_length(table, name, table[name], names[0], len(first))
    return np.column_stack([table[n] for n in names])


def _require_length(table: Table, name: str, column: FloatArray, other: str, n: int) -> None:
    if len(column) != n:
        raise DataError(
            f"{table.path}: {name!r} has {len(column)} samples, {other!r} has {n}; "
            "expected columns of one recording"
        )


def _speed(table: Table, column: str, counts_per_rev: float, Ts: float) -> FloatArray:
    counts = table[column]
    bad = np.flatnonzero(np.isinf(counts))
    if len(bad):
        raise DataError(
            f"{table.path}: column {column!r}: expected encoder counts, received "
            f"{counts[bad[0]]} at {table.row(int(bad[0]))}"
        )
    try:
        return speed_between_gaps(counts, Ts, counts_per_rev)
    except DataError as e:
        raise located(DataError, f"{table.path}: column {column!r}", e) from e


def parse_source(text: str) -> tuple[str, tuple[str, ...] | None, str | None]:
    """Split `FILE:IN:OUT` into file, input names (joined by `+` where several) and output name.
    A text that exists as a file, or has no two colons after a drive letter, is a file alone.
    """
    parts = text.rsplit(":", 2)
    is_drive = len(parts) == 3 and len(parts[0]) == 1 and parts[0].isalpha()
    if len(parts) < 3 or is_drive or Path(text).exists():
        return text, None, None
    path, inputs, output = parts
    names = tuple(n.strip() for n in inputs.split("+"))
    if not path or not output.strip() or not all(names):
        raise SettingError(
            f"expected FILE:INPUT:OUTPUT, such as run.csv:u:speed; received {text!r}"
        )
    return path, names, output.strip()
