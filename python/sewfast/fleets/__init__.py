"""Many machines: one recording, one row, on the cores of this computer or on a Dask cluster.

`fleet` identifies and checks every recording of a folder. A recording that cannot be used affects
only its own row; finished rows are kept in a journal, from which the same call continues. Read
`recordings` (one recording, its row), then `table` (all rows, files, drift) and `running` (workers,
journal).
"""

from .running import fleet
from .table import Drift, Fleet, Row, load_fleet

__all__ = ["Drift", "Fleet", "Row", "fleet", "load_fleet"]
