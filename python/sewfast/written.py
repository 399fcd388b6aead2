"""The files that this process has written, for a command that is interrupted to name them."""

from __future__ import annotations

import os
from pathlib import Path

_STAGED: dict[Path, tuple[Path, int]] = {}


def staged(temporary: Path, target: Path, descriptor: int) -> None:
    """Note a file that is about to get its final name, by the open one with its content.
    A signal can come at any time, also between the renaming and a note of it; the inode shows
    later whether it was renamed.
    """
    _STAGED[target.resolve()] = temporary.resolve(), os.fstat(descriptor).st_ino


def forget() -> None:
    """Begin anew: another command starts in the same process."""
    _STAGED.clear()


def written() -> list[Path]:
    """The files with their final names that have the content of this process."""
    return [target for target, (_, inode) in _STAGED.items() if _inode(target) == inode]


def discard() -> None:
    """Delete temporary files, at the end of a process that has no time to clean up."""
    for target, (temporary, inode) in _STAGED.items():
        if temporary != target and _inode(temporary) == inode:
            temporary.unlink(missing_ok=True)


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except OSError:
        return None
