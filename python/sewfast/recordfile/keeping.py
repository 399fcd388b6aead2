"""What is not written over: a recording of a drive, which cannot be had again."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from ..errors import DataError, SettingError
from .header import Header
from .reader import read_header

ENDING = ".mcap"
_COMPUTED = 1 << 5
"""The capability of a device that is no machine but computes one (docs/PROTOCOL.md)."""


def require_ending(path: str | os.PathLike[str]) -> Path:
    """A recording's name, which other programs tell by its ending.

    Raises
    ------
    SettingError
        For another ending.
    """
    if not isinstance(path, (str, os.PathLike)) or "\0" in str(path):
        raise SettingError(f"expected a file's name, got {path!r}; as in file='run{ENDING}'")
    found = Path(path)
    if found.suffix.lower() != ENDING:
        raise SettingError(
            f"{found}: expected a recording's name, which ends in {ENDING}, got "
            f"{found.suffix or 'none'!r}; rename it, and `sewfast.recordfile.export` makes other "
            "formats of it"
        )
    return found


def require_replaceable(path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Refuse to lose a recording: an `.mcap` is replaced only where a computer can make it again.

    A recording of a virtual machine can be made again, and so can what is no recording but made
    from one. One that cannot be read may be of a drive.

    Parameters
    ----------
    path : path
        File that is about to be written.
    overwrite : bool
        Whether it may be replaced whatever it is.

    Raises
    ------
    SettingError
        Where it is to be kept.
    """
    found = Path(path)
    if overwrite or found.suffix.lower() != ENDING or not _is_there(found):
        return
    try:
        header = read_header(found)
    except DataError:
        raise _kept(found, "a file that may be one") from None
    if not _is_computed(header):
        device = header.device.get("name", "a drive")
        raise _kept(found, f"one of {str(device)[:60]!r} of {header.started[:19]}")


def require_free(paths: Iterable[str | os.PathLike[str] | None], *, overwrite: bool) -> None:
    """Refuse to write over anything at all: for what is the only account of a run on a drive.

    Raises
    ------
    SettingError
        Where one of the files exists.
    """
    for path in paths:
        if path is not None and not overwrite and _is_there(Path(path)):
            raise SettingError(
                f"{path}: expected a free name for what a drive did, there is a file; it is kept: "
                "choose another name, or overwrite it (--overwrite, overwrite=True)"
            )


def _is_there(path: Path) -> bool:
    """Whether there is anything to be lost; a folder is refused by whoever writes."""
    try:
        return path.is_file() and path.stat().st_size > 0
    except (OSError, ValueError):
        return False


def _is_computed(header: Header) -> bool:
    capabilities = header.device.get("capabilities", 0)
    computed = isinstance(capabilities, int) and bool(capabilities & _COMPUTED)
    return computed or header.device.get("kind") == "virtual"


def _kept(path: Path, what: str) -> SettingError:
    return SettingError(
        f"{path}: expected no recording that cannot be had again, there is {what}; it is kept: "
        "choose another name, or overwrite it (--overwrite, overwrite=True)"
    )
