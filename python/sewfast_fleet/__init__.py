"""Many machines: one recording, one row, on the cores of this computer or on a Dask cluster.

`fleet` identifies and checks every recording of a folder. A recording that cannot be used affects
only its own row; finished rows are kept in a journal, from which the same call continues. Read
`recordings` (one recording, its row), then `table` (all rows, files, drift) and `running` (workers,
journal); `command` adds `sewfast fleet`.
"""

from typing import TYPE_CHECKING

from sewfast.plugins import on_first_use as _on_first_use

if TYPE_CHECKING:
    from .running import fleet
    from .table import Drift, Fleet, Row, load_fleet

__all__ = ["Drift", "Fleet", "Row", "fleet", "load_fleet"]

if not TYPE_CHECKING:  # a misspelt name is an error for type checkers
    __getattr__, __dir__ = _on_first_use(
        __name__, {"running": "fleet", "table": "Drift Fleet Row load_fleet"}
    )
