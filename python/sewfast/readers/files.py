"""One file of any known format -> `Table`, told apart by its first bytes, then by its extension."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import DataError
from .containers import read_mat, read_npz
from .delimited import read_delimited
from .mcap import MAGIC, read_mcap
from .parquet import read_parquet
from .table import Table


def read_table(path: str | os.PathLike[str]) -> Table:
    """Read all columns of a CSV, `.mat`, `.npz`, Parquet or MCAP file.

    Parameters
    ----------
    path : path
        The format is told by the file's first bytes, where they tell, else by its extension.

    Returns
    -------
    Table
        Columns by name, float64.

    Raises
    ------
    DataError
        Where the file is missing, empty, damaged or of an unknown kind; the message names it.
    SettingError
        Where the format needs a package that is not installed.
    """
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
