"""Files in: CSV, `.mat`, `.npz`, Parquet and MCAP, read into a `Table` or a `Dataset`.

Read in this order: `recording` (`read`, `read_table`, formats that other packages add; which column
is the input, which the output), `timebase` (the sample time of a column, moments), `delimited`,
`containers`, `logs` (formats of other tools), `blackbox`, `frames` (tables in memory).
"""

from .containers import Table
from .recording import Roles, left_out, parse_source, read, read_table, roles

__all__ = ["Roles", "Table", "left_out", "parse_source", "read", "read_table", "roles"]
