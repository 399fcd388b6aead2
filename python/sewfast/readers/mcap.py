"""MCAP recordings of the package -> `Table`."""

from __future__ import annotations

from pathlib import Path

from ..recordfile.container import MAGIC
from ..recordfile.reader import decode_recording
from .table import Table, freeze

__all__ = ["MAGIC", "read_mcap"]


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
