"""A file that grows by whole pieces: what is in it is complete, whatever stops the writer."""

from __future__ import annotations

import os
import secrets
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from ..errors import DataError, SettingError

_BATCH = 1 << 16


class Mark(NamedTuple):
    """What tells a file from one that has taken its place, or its content, since."""

    device: int
    inode: int
    size: int
    modified_ns: int


def marked(path: Path) -> Mark | None:
    """The mark of what is there; None for nothing."""
    try:
        found = path.stat()
    except OSError:
        return None
    return Mark(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


def require_writable(path: Path, *, overwrite: bool) -> None:
    """Refuse what `Sink` would refuse, and leave everything as it is.

    Raises
    ------
    SettingError, DataError
        As `Sink`.
    """
    if path.exists() and not path.is_dir():
        if not overwrite:
            raise exists(path)
        _try(path, path, os.O_WRONLY)
        return
    if path.is_dir():
        raise _folder(path)
    probe = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    _try(path, probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
    probe.unlink(missing_ok=True)


def _try(path: Path, opened: Path, flags: int) -> None:
    try:
        file = os.open(opened, flags, 0o666)
    except OSError as e:
        raise _unwritable(path, e) from e
    try:
        _own(path, file)
    finally:
        _give_back(file)


def _own(path: Path, file: int) -> None:
    """Keep other recorders out of an open file: each would overwrite what the other has written.

    Raises
    ------
    SettingError
        Where another one has it.
    """
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise SettingError(
            f"{path}: expected a file that nobody else writes, a recording is being made in it; it "
            "is kept: choose another name"
        ) from None
    except OSError:
        # a file system without locks
        pass


def _give_back(file: int) -> None:
    with suppress(ImportError, OSError):
        import fcntl

        # a process that was forked meanwhile must not keep it
        fcntl.flock(file, fcntl.LOCK_UN)
    with suppress(OSError):
        os.close(file)


def exists(path: Path) -> SettingError:
    """The refusal to write over a file."""
    return SettingError(
        f"{path}: the file exists and is kept; choose another name, or overwrite=True (--overwrite)"
    )


def _folder(path: Path) -> DataError:
    return DataError(f"{path}: expected a file to write, received a folder")


def _unwritable(path: Path, error: OSError) -> DataError:
    return DataError(
        f"{path}: cannot be written ({error.strerror}); choose a folder that exists and is writable"
    )


class Sink:
    """An open file; a piece that cannot be written as a whole is taken back.

    Parameters
    ----------
    path : Path
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    SettingError
        Where the file exists and may not be replaced, or another recording is being made in it.
    DataError
        Where it cannot be made: a folder, no such folder, no permission.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self.path = path
        self.size = 0
        self.crc = 0
        flags = os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0)
        try:
            # without O_EXCL two writers could meet in one file
            self._file = os.open(path, flags | (0 if overwrite else os.O_EXCL), 0o666)
        except FileExistsError as e:
            raise (_folder(path) if path.is_dir() else exists(path)) from e
        except OSError as e:
            raise _unwritable(path, e) from e
        try:
            _own(path, self._file)
            # nothing is lost before it is certain that the file is this one's
            os.ftruncate(self._file, 0)
        except OSError as e:
            self.close()
            raise _unwritable(path, e) from e
        except BaseException:
            self.close()
            raise

    def append(self, piece: bytes) -> None:
        """Hand a piece to the operating system: from then on `kill -9` cannot take it away.

        Raises
        ------
        OSError
            Where it does not fit; the file then ends where the piece would have begun.
        """
        rest = memoryview(piece)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._file, self.size)
            raise
        self.size += len(piece)
        self.crc = zlib.crc32(piece, self.crc)

    def sync(self) -> None:
        """Ask for what was appended to be on the disk itself, against a loss of power."""
        with suppress(OSError):
            os.fsync(self._file)

    def close(self) -> None:
        _give_back(self._file)


def batched(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes in larger pieces, which cost fewer calls."""
    batch = bytearray()
    for piece in pieces:
        batch += piece
        if len(batch) >= _BATCH:
            yield bytes(batch)
            batch.clear()
    yield bytes(batch)


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A temporary name beside a file, which takes the file's place where the block succeeds.

    Raises
    ------
    DataError
        Where the file cannot be written.
    """
    if target.is_dir():
        raise _folder(target)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        temporary.replace(target)
    except OSError as e:
        raise DataError(
            f"{target}: cannot be written ({e.strerror}); choose a folder that exists and has room"
        ) from e
    finally:
        temporary.unlink(missing_ok=True)
