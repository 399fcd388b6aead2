"""Files in: CSV, `.mat`, `.npz`, Parquet and MCAP, read into a `Table` or a `Dataset`."""

from .containers import Table
from .recording import parse_source, read, read_table

__all__ = ["Table", "parse_source", "read", "read_table"]
