"""One file of any known format -> `Table`."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

from ..errors import DataError, SettingError
from ..recordfile.format import MAGIC
from ..recordfile.reader import decode_recording
from .containers import Table, freeze, read_mat, read_npz
from .delimited import read_delimited
from .frames import collected, of_arrow, table_of

__all__ = ["MAGIC", "read_mcap"]


# --- Parquet -> Table -----------------------------------------------------------------------------


def read_parquet(path: Path, raw: bytes) -> Table:
    """Read the numeric columns of a Parquet file; nulls are NaN.

    Raises
    ------
    DataError
        Where the file is damaged or has no rows.
    SettingError
        Where pyarrow is not installed.
    """
    try:
        import pyarrow.parquet as pq
    except ImportError as e:
        raise SettingError(
            'reading Parquet needs pyarrow, which is not installed: pip install "sewfast[parquet]"'
        ) from e
    try:
        found = pq.read_table(io.BytesIO(raw))
    except Exception as e:
        # damaged files make the parser fail in any way
        raise DataError(f"{path}: expected a Parquet file, but it cannot be read: {e}") from e
    if found.num_rows == 0:
        raise DataError(f"{path}: expected rows of numbers, received none")
    return collected(path, of_arrow(found))


# --- MCAP recordings of the package -> Table ------------------------------------------------------


def read_mcap(path: Path, raw: bytes) -> Table:
    """Time and columns of a recording, NaN in its gaps and where it is damaged.

    Raises
    ------
    DataError
        Where the file is no recording of the package, or holds no sample.
    """
    found = decode_recording(path, raw)
    columns = {name: freeze(c) for name, c in found.table_columns().items()}
    header = found.header
    return Table(path, columns, found.units, Ts=header.Ts, counts_per_rev=header.counts_per_rev)


# --- One file of any known format -> Table, told apart by its first bytes, then by its extension --


def read_table(path: Any) -> Table:
    """Read all columns of a CSV, `.mat`, `.npz`, Parquet or MCAP file, or of a table in memory.

    Parameters
    ----------
    path : path or table
        The format is told by the file's first bytes, where they tell, else by its extension. A
        table is one of pandas, polars, pyarrow (or anything with `__arrow_c_stream__`), an xarray
        Dataset or a mapping of name to array; null, NA and NaT are NaN, moments become seconds from
        the first one.

    Returns
    -------
    Table
        Columns by name, float64.

    Raises
    ------
    DataError
        Where the file is missing, empty, damaged or of an unknown kind; the message names it.
    SettingError
        Where the format needs a package that is not installed, or for what is neither path nor
        table.
    """
    if not isinstance(path, (str, os.PathLike)):
        return table_of(path)
    path = Path(path)
    raw = _bytes(path)
    if raw.startswith(MAGIC) or path.suffix.lower() == ".mcap":
        return read_mcap(path, raw)
    if raw.startswith(b"PAR1"):
        return read_parquet(path, raw)
    if raw.startswith(b"PK\x03\x04"):
        return _zipped(path, raw)
    if raw.startswith((b"MATLAB ", b"\x89HDF")) or path.suffix.lower() == ".mat":
        return read_mat(path, raw)
    if path.suffix.lower() in (".npz", ".parquet", ".npy"):
        raise DataError(
            f"{path}: expected a {path.suffix} file, but its content is of another kind or "
            "damaged; supported are CSV, .mat, .npz, Parquet and recordings (.mcap)"
        )
    return read_delimited(path, raw)


def _zipped(path: Path, raw: bytes) -> Table:
    if b"xl/" in raw[:4096] or path.suffix.lower().startswith(".xls"):
        raise DataError(f"{path}: an Excel workbook; save the sheet as CSV")
    return read_npz(path, raw)


def _bytes(path: Path) -> bytes:
    if path.is_dir():
        raise DataError(f"{path}: expected a file, received a folder")
    try:
        raw = path.read_bytes()
    except FileNotFoundError as e:
        raise DataError(f"{path}: no such file; check the name and the folder") from e
    except (OSError, ValueError) as e:
        raise DataError(f"{path}: cannot be read: {e}") from e
    if not raw:
        raise DataError(f"{path}: the file is empty; expected a header and rows of numbers")
    return raw
