"""Formats of other packages: an entry point `sewfast.readers` of any installed one reads a file.

The name of the entry point is the file's ending without its dot, its object a function of the path.
What it returns is a table in memory, as `table_of` takes it, or a `Table`. Nothing is registered:
the metadata of what is installed is the list, looked at when a file has an ending of no own format.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DataError, SettingError, SewfastError, printable
from .containers import Table
from .frames import table_of

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "sewfast.readers"
OWN = frozenset({"csv", "tsv", "txt", "mat", "npz", "npy", "parquet", "mcap", "xls", "xlsx"})
"""Endings that are not looked up: these are read here, and asking takes milliseconds a file."""


def read_installed(path: Path) -> Table | None:
    """Read a file by the package that knows its ending; None where none does.

    Raises
    ------
    DataError
        Where the package's function fails, or returns no table of numbers.
    SettingError
        Where several packages know the ending, or the function cannot be imported.
    """
    ending = path.suffix.lower().removeprefix(".")
    if not ending or ending in OWN:
        return None
    # not above: it brings parsers of mail and archives, which reading CSV does not need
    from importlib.metadata import entry_points

    found = tuple(entry_points(group=GROUP, name=ending))
    if not found:
        return None
    if len(found) > 1:
        raise SettingError(
            name=str(path), expected=f"one installed package that reads .{ending}",
            received=" and ".join(sorted(map(_package, found))),
            remedy="uninstall one, or read the table with one of them and pass it on: read(table)",
        )  # fmt: skip
    (point,) = found
    try:
        return _table(path, _function(path, point)(path))
    except SewfastError:
        raise
    except Exception as e:
        # somebody else's function may fail in any way
        raise DataError(
            name=str(path), expected=f"a file that {_package(point)} can read",
            received=f"{type(e).__name__}: {printable(str(e))[:200]}",
            remedy=f"see the documentation of {_package(point)}",
        ) from e  # fmt: skip


def _function(path: Path, point: EntryPoint) -> Callable[[Path], Any]:
    try:
        function = point.load()
    except Exception as e:
        # importing runs somebody else's code
        raise _unusable(path, point, f"{type(e).__name__}: {printable(str(e))[:200]}") from e
    if not callable(function):
        raise _unusable(path, point, f"{point.value}, a {type(function).__name__}")
    read: Callable[[Path], Any] = function
    return read


def _unusable(path: Path, point: EntryPoint, received: str) -> SettingError:
    return SettingError(
        name=str(path), expected=f"a function of {_package(point)} that reads .{point.name}",
        received=received, remedy=f"update {_package(point)}, or uninstall it",
    )  # fmt: skip


def _table(path: Path, found: Any) -> Table:
    if isinstance(found, Table):
        return replace(found, path=path)
    try:
        return replace(table_of(found), path=path)
    except SettingError as e:
        raise DataError(
            name=str(path), expected="a table from the package that reads it",
            received=type(found).__name__, remedy="its function returns a mapping of name to array",
        ) from e  # fmt: skip


def _package(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
