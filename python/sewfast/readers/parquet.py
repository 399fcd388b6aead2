"""Parquet -> `Table`."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..errors import DataError, SettingError
from .table import Table, from_headers


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
        import pyarrow as pa
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
    columns, bad = [], {}
    for i, field in enumerate(found.schema):
        try:
            columns.append(found.column(i).cast(pa.float64(), safe=False).to_numpy())
        except pa.ArrowException:
            columns.append(np.empty(0))
            bad[i] = f"column {field.name!r} holds {field.type}; expected numbers"
    return from_headers(path, found.schema.names, columns, bad)
