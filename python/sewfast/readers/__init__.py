"""Files in: CSV, `.mat`, `.npz`, Parquet, JSON and MCAP, read into a `Table` or a `Dataset`.

Read in this order: `recording` (`read`, `read_table`, formats that other packages add), `roles`
(which column is the input, which the output), `timebase` (the sample time of a column, moments),
`delimited`, `jsonlog`, `containers`, `logs` (formats of other tools), `blackbox`, `sage`, `frames`
(tables in memory), `joints` (command and position of each joint of a robot).
"""

from .containers import Table
from .joints import of_joint, read_joints
from .recording import parse_source, read, read_columns, read_table
from .roles import Roles, joint_columns, left_out, roles

__all__ = [
    "Roles",
    "Table",
    "joint_columns",
    "left_out",
    "of_joint",
    "parse_source",
    "read",
    "read_columns",
    "read_joints",
    "read_table",
    "roles",
]
