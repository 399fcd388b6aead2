"""`Filing`: the thread that owns a recording's file; what callers give it, it writes in order.

A thread of its own, because Ctrl-C is raised in the main thread, at any point of it: a chunk or a
column half done would be damage. It also writes what has waited for long enough while nobody calls,
and keeps a slow disk away from the link.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from ..errors import DataError, SewfastError
from . import samples
from .container import Assembler, Message, opening
from .header import Header, bearable
from .sink import Sink, batched, exists, marked, require_writable
from .topics import Topic

MESSAGE_SAMPLES = 100
"""Samples at which a message is written."""
OLDEST = 0.2
"""Seconds that a sample waits for a full message; the operating system has it within .25 s."""
MOST_WAITING = 10_000
"""Samples that wait for the disk before a caller has to."""


class Block(NamedTuple):
    """Consecutive samples from number `first` on, as JSON values."""

    first: int
    columns: Mapping[str, list[Any]]


class Event(NamedTuple):
    """The content of an event message and its log time [ns]."""

    content: Mapping[str, Any]
    at: int


class End(NamedTuple):
    """The recording ends, how, and which sample would have come next."""

    outcome: str
    due: int


Item: TypeAlias = Block | Event | End


class Filing:
    """Owner of the file. Only `put`, `finish`, `failure` and `refusal` are for other threads."""

    def __init__(self, path: Path, header: Header, *, overwrite: bool, lazy: bool) -> None:
        self.failure: Exception | None = None
        self._path, self._overwrite = path, overwrite
        self._header = header
        self._opened: Sink | None = None
        self._assembler = Assembler(header.columns)
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
        """Hand over; returns at once unless the disk has fallen far behind."""
        while self._given - self._received > MOST_WAITING and self.failure is None:
            time.sleep(0.001)
        self._items.put(item)
        if isinstance(item, Block):
            self._given += len(next(iter(item.columns.values())))

    def finish(self) -> None:
        """Wait until the end that was put is in the file."""
        self._thread.join()

    @property
    def is_made(self) -> bool:
        """Whether there is a file; certain once it is finished."""
        return self._opened is not None

    def refusal(self, error: Exception) -> SewfastError:
        """What to say to callers when the file could not be written."""
        if isinstance(error, SewfastError):
            return error
        reason = getattr(error, "strerror", None) or repr(error)
        return DataError(
            f"{self._path}: expected room for the recording, received {reason!r}; the "
            f"file is whole up to sample {self._first} (end excluded, {self._sink.size} bytes); "
            "free some space and record again"
        )

    @property
    def _sink(self) -> Sink:
        assert self._opened is not None, "the file is made before anything is written"
        return self._opened

    def _open(self) -> None:
        # what has come since it was asked for may be the only account of a run
        if marked(self._path) not in (None, self._before):
            raise exists(self._path)
        self._opened = Sink(self._path, overwrite=self._overwrite)
        self._write_header()

    def _write_header(self) -> None:
        """Twice: a recording cannot be read without it, and one copy may be damaged."""
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
            raise DataError(
                f"{self._path}: cannot be written ({e.strerror}); free some space or write "
                "elsewhere"
            ) from e

    def _run(self) -> None:
        try:
            while not isinstance(item := self._next_item(), End):
                if not self.is_made:
                    self._open()
                self._take(item)
            if self.is_made:
                self._finish(item)
        except Exception as e:
            # whatever it is, callers must learn of it
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
            self._append(Message(Topic.EVENTS, item.at, item.at, samples.dumps(item.content)))
            return
        # repeated where Ctrl-C hit the caller between handing over and taking note of it
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
        if len(self._gaps) < samples.MOST_GAPS_LISTED:
            self._gaps.append((self._first, first - self._first))
        self._gap_count += 1
        self._first = first

    def _write_pending(self) -> None:
        if self._waiting:
            self._write_samples(self._waiting)

    def _write_samples(self, count: int) -> None:
        """The `count` samples that wait longest, as one message."""
        columns = {name: values[:count] for name, values in self._pending.items()}
        data = samples.encode(self._first, self._header.Ts, columns)
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
            # what was planned and never came is a gap as well
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
        self._append(Message(Topic.COMPLETENESS, at, at, samples.dumps(content)))
        for piece in batched(self._assembler.ending(self._sink.size, self._sink.crc)):
            self._sink.append(piece)
        self._sink.sync()
