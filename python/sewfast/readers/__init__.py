"""Files in: CSV, `.mat`, `.npz`, Parquet, JSON and MCAP, read into a `Table` or a `Dataset`.

Read in this order: `recording` (`read`, `read_table`, formats that other packages add), `roles`
(which column is the input, which the output), `timebase` (the sample time of a column, moments),
`delimited`, `jsonlog`, `containers`, `logs` (formats of other tools), `blackbox`, `frames` (tables
in memory).
"""

from .containers import Table
from .recording import parse_source, read, read_columns, read_table
from .roles import Roles, left_out, roles

__all__ = [
    "Roles",
    "Table",
    "left_out",
    "parse_source",
    "read",
    "read_columns",
    "read_table",
    "roles",
]
