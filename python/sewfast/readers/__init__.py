"""Files in: CSV, `.mat`, `.npz`, Parquet and MCAP, read into a `Table` or a `Dataset`."""

from .containers import Table
from .files import read_table
from .recording import parse_source, read

__all__ = ["Table", "parse_source", "read", "read_table"]
