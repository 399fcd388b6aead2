"""`Filing`: the thread that owns a recording's file, and the file it appends to."""

from __future__ import annotations

import os
import queue
import threading
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from ..errors import DataError, SettingError, SewfastError, unwritable
from ..storage import names
from ..storage import require_writable as require_replaceable
from ..written import staged
from . import format
from .format import Assembler, Message, Topic, opening
from .header import Header, bearable

# --- Sink: a file that grows by whole pieces ------------------------------------------------------


_LOCKED = 0x7FFF_0000
"""The byte to lock on Windows, beyond any recording: others cannot read locked bytes there."""


class Mark(NamedTuple):
    """Identity of a file and its content, to notice that either was replaced since."""

    device: int
    inode: int
    size: int
    modified_ns: int


def marked(path: Path) -> Mark | None:
    """The mark of the file at a path; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return Mark(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


def require_writable(path: Path, *, overwrite: bool) -> None:
    """Raise the errors that `Sink` would raise, without changing anything."""
    if not path.is_file():
        require_replaceable(path, DataError)
        return
    if not overwrite:
        raise exists(path)
    try:
        file = os.open(path, os.O_WRONLY)
    except OSError as e:
        raise unwritable(DataError, path, e) from e
    try:
        _own(path, file)
    finally:
        _give_back(file)


def _own(path: Path, file: int) -> None:
    """Lock an open file: two recorders would overwrite each other's chunks."""
    try:
        _lock(file)
    except BlockingIOError:
        raise SettingError(
            name=str(path), expected="a file that nobody else writes",
            received="one with a recording in progress, which is kept",
            remedy="choose another name",
        ) from None  # fmt: skip
    except (ImportError, OSError):
        # the file system or this Python has no locks
        pass


def _lock(file: int, *, free: bool = False) -> None:
    """Take or release a lock (never run on Windows); `BlockingIOError` if another holds it."""
    try:
        import fcntl
    except ImportError:
        msvcrt: Any = import_module("msvcrt")
        position = os.lseek(file, 0, os.SEEK_CUR)
        os.lseek(file, _LOCKED, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_UNLCK if free else msvcrt.LK_NBLCK, 1)
        except PermissionError as e:
            raise BlockingIOError(e.errno, e.strerror) from e
        finally:
            os.lseek(file, position, os.SEEK_SET)
    else:
        fcntl.flock(file, fcntl.LOCK_UN if free else fcntl.LOCK_EX | fcntl.LOCK_NB)


def _give_back(file: int) -> None:
    with suppress(ImportError, OSError):
        # explicitly, because a process forked in the meantime would keep it
        _lock(file, free=True)
    with suppress(OSError):
        os.close(file)


def exists(path: Path) -> SettingError:
    """The error for a file that must not be overwritten."""
    return SettingError(
        name=str(path), expected="a new name", received="a file, which is kept",
        remedy="choose another name, or overwrite=True (--overwrite)",
    )  # fmt: skip


def _folder(path: Path) -> DataError:
    return DataError(name=str(path), expected="a file to write", received="a folder")


class Sink:
    """An open file; a piece that cannot be written completely is removed again."""

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self.path = path
        self.size = 0
        self.crc = 0
        flags = os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0)
        # without O_NONBLOCK, it would wait for somebody to read a pipe
        flags |= getattr(os, "O_NONBLOCK", 0)
        try:
            # without O_EXCL two writers could open the same new file
            self._file = os.open(path, flags | (0 if overwrite else os.O_EXCL), 0o666)
        except FileExistsError as e:
            raise (_folder(path) if path.is_dir() else exists(path)) from e
        except OSError as e:
            raise unwritable(DataError, path, e) from e
        try:
            _own(path, self._file)
            # truncate only after the lock is held, so that a refusal loses nothing
            os.ftruncate(self._file, 0)
            staged(path, path, self._file)
        except OSError as e:
            self.close()
            raise unwritable(DataError, path, e) from e
        except BaseException:
            self.close()
            raise

    def append(self, piece: bytes) -> None:
        """Pass a piece to the system, where it survives `kill -9`; `OSError`, and nothing, if it is
        full.
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
        """Flush the file to the disk itself, against a loss of power."""
        with suppress(OSError):
            os.fsync(self._file)

    def close(self) -> None:
        _give_back(self._file)


def batched(pieces: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes in larger pieces, for fewer calls."""
    batch = bytearray()
    for piece in pieces:
        batch += piece
        if len(batch) >= (1 << 16):
            yield bytes(batch)
            batch.clear()
    yield bytes(batch)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside a file, renamed to the file if the block succeeds."""
    temporary = path
    try:
        temporary, target = names(path)
        try:
            yield temporary
            temporary.replace(target)
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
    except OSError as e:
        raise unwritable(DataError, path, e) from e
    except DataError as e:
        if e.name != str(temporary):
            raise
        # nothing is left of the temporary file that the message is about
        remedy = "free some space or write elsewhere" if "is whole" in str(e.remedy) else e.remedy
        raise DataError(
            name=str(path), expected=e.expected, received=e.received, remedy=remedy
        ) from e


# --- Filing: the thread that owns a recording's file ----------------------------------------------
# A separate thread, because Ctrl-C is raised in the main thread at any point and could leave half a
# chunk. The thread also writes samples that have waited long enough even if no call comes, and
# keeps a slow disk from blocking the link.


MESSAGE_SAMPLES = 100
"""Samples at which a message is written."""
OLDEST = 0.2
"""Longest wait of a sample for a full message [s]; the operating system gets it within .25 s."""


class Block(NamedTuple):
    """Consecutive samples from number `first` on, as JSON values."""

    first: int
    columns: Mapping[str, list[Any]]


class Event(NamedTuple):
    """The content of an event message and its log time [ns]."""

    content: Mapping[str, Any]
    at: int


class End(NamedTuple):
    """End of the recording: the outcome, and the number of the sample that would follow."""

    outcome: str
    due: int


Item: TypeAlias = Block | Event | End


class Filing:
    """Owner of the file. Other threads call only `put`, `finish`, `failure` and `refusal`."""

    def __init__(
        self, path: Path, header: Header, *, overwrite: bool, lazy: bool, compress: bool
    ) -> None:
        self.failure: Exception | None = None
        self._path, self._overwrite = path, overwrite
        self._header = header
        self._opened: Sink | None = None
        self._assembler = Assembler(header.columns, compress=compress)
        self._pending: dict[str, list[Any]] = {name: [] for name in header.columns}
        self._first = 0
        self._since = 0.0
        self._given = 0
        self._received = 0
        self._gaps: list[tuple[int, int]] = []
        self._gap_count = 0
        self._items: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._before = marked(path)
        if lazy:
            require_writable(path, overwrite=overwrite)
        else:
            self._open()
        self._thread = threading.Thread(target=self._run, name="sewfast-recording", daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Queue an item; returns at once unless the disk is far behind."""
        # most samples that wait for the disk before `put` blocks
        while self._given - self._received > 10_000 and self.failure is None:
            time.sleep(0.001)
        self._items.put(item)
        if isinstance(item, Block):
            self._given += len(next(iter(item.columns.values())))

    def finish(self) -> None:
        """Wait until the queued end is in the file."""
        self._thread.join()

    @property
    def is_made(self) -> bool:
        """Whether the file was created; final after `finish`."""
        return self._opened is not None

    def refusal(self, error: Exception) -> SewfastError:
        """The error for callers when the file could not be written."""
        if isinstance(error, SewfastError):
            return error
        reason = getattr(error, "strerror", None) or repr(error)
        return DataError(
            name=str(self._path), expected="room for the recording", received=reason,
            remedy=f"the file is whole up to sample {self._first} (end excluded, "
            f"{self._sink.size} bytes); free some space and record again",
        )  # fmt: skip

    @property
    def _sink(self) -> Sink:
        assert self._opened is not None, "the file is made before anything is written"
        return self._opened

    def _open(self) -> None:
        # a file created since the check can be the only record of a run
        if marked(self._path) not in (None, self._before):
            raise exists(self._path)
        self._opened = Sink(self._path, overwrite=self._overwrite)
        self._write_header()

    def _write_header(self) -> None:
        """Write the header twice: no recording is readable without it, and one can get damaged."""
        at = self._header.start_ns()
        message = Message(Topic.HEADER, at, at, self._header.encode())
        try:
            self._sink.append(opening())
            self._append(message, leading=True)
            self._append(message)
        except OSError as e:
            self._sink.close()
            self._path.unlink(missing_ok=True)
            self._opened = None
            raise unwritable(DataError, self._path, e) from e

    def _run(self) -> None:
        try:
            while not isinstance(item := self._next_item(), End):
                if not self.is_made:
                    self._open()
                self._take(item)
            if self.is_made:
                self._finish(item)
        except Exception as e:
            # callers must learn of any error
            self.failure = e
        finally:
            if self.is_made:
                self._sink.close()

    def _next_item(self) -> Item:
        while self._waiting:
            try:
                return self._items.get(timeout=max(self._since + OLDEST - time.monotonic(), 0.0))
            except queue.Empty:
                self._write_pending()
        return self._items.get()

    def _take(self, item: Block | Event) -> None:
        if isinstance(item, Event):
            self._append(Message(Topic.EVENTS, item.at, item.at, format.dumps(item.content)))
            return
        # a repeat, if Ctrl-C hit the caller between queueing and counting
        if item.first < self._end:
            return
        if item.first > self._end:
            self._skip_to(item.first)
        self._add(item)
        while self._waiting >= MESSAGE_SAMPLES:
            self._write_samples(MESSAGE_SAMPLES)
        if self._waiting and time.monotonic() - self._since >= OLDEST:
            self._write_pending()

    @property
    def _waiting(self) -> int:
        return len(next(iter(self._pending.values())))

    @property
    def _end(self) -> int:
        return self._first + self._waiting

    def _add(self, block: Block) -> None:
        if not self._waiting:
            self._since = time.monotonic()
        for name, values in block.columns.items():
            self._pending[name] += values
        self._received += self._end - block.first

    def _skip_to(self, first: int) -> None:
        self._write_pending()
        if len(self._gaps) < format.MOST_GAPS_LISTED:
            self._gaps.append((self._first, first - self._first))
        self._gap_count += 1
        self._first = first

    def _write_pending(self) -> None:
        if self._waiting:
            self._write_samples(self._waiting)

    def _write_samples(self, count: int) -> None:
        """Write the `count` oldest waiting samples as one message."""
        columns = {name: values[:count] for name, values in self._pending.items()}
        data = format.encode(self._first, self._header.Ts, columns)
        begin = self._header.time_ns(self._first)
        end = self._header.time_ns(self._first + count - 1)
        self._append(Message(Topic.SAMPLES, end, begin, data))
        for values in self._pending.values():
            del values[:count]
        self._first += count
        self._since = time.monotonic()

    def _append(self, message: Message, *, leading: bool = False) -> None:
        self._sink.append(self._assembler.chunk([message], self._sink.size, leading=leading))

    def _finish(self, end: End) -> None:
        self._write_pending()
        planned, outcome = self._header.n, end.outcome
        due = end.due if planned is None or outcome != "complete" else planned
        if due > self._first and bearable(due - self._received, len(self._header.columns)):
            # planned samples that never came are a gap as well
            self._skip_to(due)
        content = {
            "outcome": outcome,
            "received": self._received,
            "expected": planned,
            "end": self._first,
            "gap_count": self._gap_count,
            "gaps": self._gaps,
        }
        at = self._header.time_ns(self._first)
        self._append(Message(Topic.COMPLETENESS, at, at, format.dumps(content)))
        for piece in batched(self._assembler.ending(self._sink.size, self._sink.crc)):
            self._sink.append(piece)
        self._sink.sync()
