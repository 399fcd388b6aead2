"""Writing tables: named columns as CSV, `.npz`, `.mat` or Parquet; a file is complete or absent."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import labelled
from .errors import DataError, SettingError, not_installed, unwritable
from .storage import replace_file

_Columns = dict[str, NDArray[Any]]


def write_table(
    path: str | os.PathLike[str],
    columns: Mapping[str, ArrayLike],
    *,
    units: Mapping[str, str] | None = None,
) -> None:
    """Write columns of one length to a file, in the format given by its extension.

    Every float reads back to the same bits. A column `t` comes first.

    Parameters
    ----------
    path : path
        `.csv`, `.npz`, `.mat` or `.parquet`; an existing file is replaced in one step.
    columns : mapping of name to array of shape (N,)
    units : mapping of name to text, optional
        Put into the headers of CSV and Parquet as `name [unit]`.

    Raises
    ------
    DataError
        If columns differ in length or shape, or the file cannot be written.
    SettingError
        If the extension is unknown or its package is not installed.
    """
    path = Path(path)
    encode = _ENCODERS.get(path.suffix.lower())
    if encode is None:
        raise SettingError(
            f"{path}: expected a file ending in {', '.join(_ENCODERS)}; received {path.suffix!r}"
        )
    write_bytes(path, encode(_checked(path, columns), units or {}))


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write `content` to a file: under a temporary name beside it, renamed once it is complete.

    Raises
    ------
    DataError
        If the folder does not exist or cannot be written to.
    """
    try:
        replace_file(path, content)
    except OSError as e:
        raise unwritable(DataError, path, e) from e


def _checked(path: Path, columns: Mapping[str, ArrayLike]) -> _Columns:
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    shapes = {name: a.shape for name, a in arrays.items()}
    if not arrays or any(a.ndim != 1 for a in arrays.values()) or len(set(shapes.values())) > 1:
        raise DataError(f"{path}: expected columns of one shape (N,), received {shapes}")
    if wrong := [n for n, a in arrays.items() if a.dtype.kind not in "biuf"]:
        raise DataError(f"{path}: expected real numbers in column {wrong[0]!r}")
    return {n: arrays[n] for n in sorted(arrays, key=lambda n: n != "t")}


def _csv(columns: _Columns, units: Mapping[str, str]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([labelled(n, units.get(n, "")) for n in columns])
    # Python's repr of a float is the shortest text that reads back to the same bits
    writer.writerows(zip(*(map(repr, c.tolist()) for c in columns.values()), strict=True))
    return text.getvalue().encode()


def _npz(columns: _Columns, units: Mapping[str, str]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **columns)  # type: ignore[arg-type]
    return buffer.getvalue()


def _mat(columns: _Columns, units: Mapping[str, str]) -> bytes:
    try:
        from scipy.io import savemat
    except ImportError as e:
        raise not_installed("scipy", "writing .mat", "sewfast[mat]") from e
    for name in columns:
        if re.fullmatch(r"[A-Za-z]\w{0,30}", name, re.ASCII) is None:
            raise DataError(
                name=f"column {name!r}",
                expected="a name of letters, digits and _, at most 31 long, that starts with a "
                "letter, as MATLAB has them",
                received="another", remedy="rename it or write CSV",
            )  # fmt: skip
    buffer = io.BytesIO()
    savemat(buffer, columns, oned_as="column")
    return buffer.getvalue()


def _parquet(columns: _Columns, units: Mapping[str, str]) -> bytes:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as e:
        raise not_installed("pyarrow", "writing Parquet", "sewfast[parquet]") from e
    buffer = io.BytesIO()
    pq.write_table(pa.table({labelled(n, units.get(n, "")): c for n, c in columns.items()}), buffer)
    return buffer.getvalue()


_ENCODERS: dict[str, Callable[[_Columns, Mapping[str, str]], bytes]] = {
    ".csv": _csv,
    ".npz": _npz,
    ".mat": _mat,
    ".parquet": _parquet,
}
