"""`RecordWriter`: samples and events into an MCAP file while the drive runs."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import DataError
from . import samples
from .container import Assembler, Message, opening
from .header import MOST_MISSING, Header, plain
from .sink import Sink, replacing
from .topics import Topic

MESSAGE_SAMPLES = 100
"""Samples at which a message is written."""
OLDEST = 0.2
"""Seconds that a sample waits for a full message; the operating system has it within .25 s."""


class RecordWriter:
    """One recording, written under its final name: what was written stays readable.

    A message holds 100 samples, fewer where the oldest would wait for longer than .2 s, and has a
    chunk of its own, which goes to the operating system at once. A killed recorder loses the
    samples that were waiting, nothing else.

    Parameters
    ----------
    path : path
        File to write; `.mcap` is the usual ending.
    header : Header
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    SettingError
        Where the file exists and `overwrite` is False.
    DataError
        Where it cannot be written.

    Notes
    -----
    Leaving the ``with`` block closes the file: "complete", "interrupted" after Ctrl-C, "failed"
    after another exception. The methods may be called from any thread.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> path = tempfile.mkdtemp() + "/run.mcap"
    >>> with RecordWriter(path, Header("step", 0.001, {"u": "V", "counts": "1"}, n=10)) as writer:
    ...     writer.samples(0, {"u": np.ones(4), "counts": np.arange(4)})
    ...     writer.samples(6, {"u": np.ones(4), "counts": np.arange(6, 10)})
    >>> from sewfast.recordfile import read_recording
    >>> read_recording(path).gaps
    ((4, 2),)
    """

    def __init__(
        self, path: str | os.PathLike[str], header: Header, *, overwrite: bool = False
    ) -> None:
        self.path = Path(path)
        self.header = header
        self._sink = Sink(self.path, overwrite=overwrite)
        self._assembler = Assembler(header.columns)
        self._opened = time.monotonic()
        self._next = 0
        self._written = 0
        self._received = 0
        self._gaps: list[tuple[int, int]] = []
        self._gap_count = 0
        self._pending: dict[str, list[Any]] = {name: [] for name in header.columns}
        self._first = 0
        self._since = 0.0
        self._failure: OSError | None = None
        self._closed = False
        self._change = threading.Condition()
        self._write_header()
        self._ager = threading.Thread(target=self._age, name="sewfast-recording", daemon=True)
        self._ager.start()

    def _write_header(self) -> None:
        """Twice: a recording cannot be read without it, and one copy may be damaged."""
        at = self.header.start_ns()
        message = Message(Topic.HEADER, at, at, self.header.encode())
        try:
            self._sink.append(opening())
            self._append(message, leading=True)
            self._append(message)
        except OSError as e:
            self._sink.close()
            self.path.unlink(missing_ok=True)
            raise DataError(
                f"{self.path}: cannot be written ({e.strerror}); free some space or write elsewhere"
            ) from e

    def __enter__(self) -> RecordWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
            return
        stopped = issubclass(kind, (KeyboardInterrupt, SystemExit, GeneratorExit))
        # the error that is on its way says more
        with suppress(DataError):
            self.close("interrupted" if stopped else "failed")

    @property
    def received(self) -> int:
        """Samples given so far."""
        return self._received

    def samples(self, first: int, columns: Mapping[str, ArrayLike]) -> None:
        """Append consecutive samples.

        Parameters
        ----------
        first : int
            Number of the first one; it may jump ahead, which leaves a gap.
        columns : mapping of name to array of shape (k,)
            All columns of the header, one length, any k. NaN: not measured.

        Raises
        ------
        DataError
            Where columns do not match the header, samples are repeated or the file cannot be
            written any further.
        """
        first = _index("first", first)
        values = self._matching(columns)
        count = len(next(iter(values.values())))
        with self._change:
            self._require_open()
            self._require_new(first, count)
            if count == 0:
                return
            if first > self._next:
                self._skip_to(first)
            self._wait_with(first, values)
            self._next = first + count
            self._received += count
            self._write_full()

    def _matching(self, columns: Mapping[str, ArrayLike]) -> dict[str, list[Any]]:
        if set(columns) != set(self.header.columns):
            raise DataError(
                f"{self.path}: expected the columns {', '.join(self.header.columns)}, received "
                f"{', '.join(map(str, columns)) or 'none'}; give every column of the header"
            )
        values = {name: samples.numbers(name, columns[name]) for name in self.header.columns}
        if len({len(v) for v in values.values()}) > 1:
            raise DataError(
                f"{self.path}: expected columns of one length, received "
                f"{ {name: len(v) for name, v in values.items()} }"
            )
        return values

    def _require_new(self, first: int, count: int) -> None:
        if first < self._next:
            raise DataError(
                f"{self.path}: expected samples from {self._next} on, received {first} to "
                f"{first + count - 1}; a sample is written once"
            )
        if not self._within_reach(first):
            raise DataError(
                f"{self.path}: expected gaps of at most {MOST_MISSING} values altogether, received "
                f"sample {first} after {self._received} samples; start a new recording"
            )

    def _within_reach(self, end: int) -> bool:
        missing = end - self._received
        return missing * len(self.header.columns) <= MOST_MISSING and end <= samples.EXACT

    def _skip_to(self, first: int) -> None:
        self._write_pending()
        if len(self._gaps) < samples.MOST_GAPS_LISTED:
            self._gaps.append((self._next, first - self._next))
        self._gap_count += 1

    def _wait_with(self, first: int, values: Mapping[str, list[Any]]) -> None:
        if not self._waiting:
            self._first = first
            self._since = time.monotonic()
            self._change.notify()
        for name, column in values.items():
            self._pending[name] += column

    @property
    def _waiting(self) -> int:
        return len(next(iter(self._pending.values())))

    def event(self, kind: str, index: int | None = None, **detail: Any) -> None:
        """Write down that something happened, at once.

        Parameters
        ----------
        kind : str
            "armed", "tripped", "gap", "reset", ...
        index : int or None
            Sample at which it happened, where that is known.
        **detail
            Finite numbers, text, lists and dicts.

        Raises
        ------
        SettingError
            For a detail that JSON does not know.
        DataError
            Where the file cannot be written any further.
        """
        index = None if index is None else _index("index", index)
        content = plain(f"event {kind!r}", {"kind": str(kind), "index": index, "detail": detail})
        with self._change:
            self._require_open()
            elapsed = time.monotonic() - self._opened
            content["elapsed"] = round(elapsed, 6)
            at = self.header.start_ns() + round(elapsed * 1e9)
            self._write(Topic.EVENTS, content, at if index is None else self.header.time_ns(index))

    def close(self, outcome: str = "complete") -> None:
        """Write what waits, the completeness record and the index; a closed file stays closed.

        Parameters
        ----------
        outcome : str
            "complete", "interrupted", "failed", "tripped" or another word that says how it ended.

        Raises
        ------
        DataError
            Where that could not be written; the samples before it are whole.
        """
        with self._change:
            if self._closed:
                return
            self._closed = True
            self._change.notify()
        self._ager.join()
        try:
            if self._failure is None:
                self._finish(outcome)
            else:
                raise self._refusal(self._failure)
        finally:
            self._sink.close()

    def _finish(self, outcome: str) -> None:
        end = self._next
        planned = self.header.n
        due = end if planned is None or outcome != "complete" else planned
        if due > end and self._within_reach(due):
            # what was planned and never came is a gap as well
            self._skip_to(due)
            end = due
        content = {
            "outcome": str(outcome),
            "received": self._received,
            "expected": planned,
            "end": end,
            "gap_count": self._gap_count,
            "gaps": self._gaps,
        }
        self._write_pending()
        self._write(Topic.COMPLETENESS, content, self.header.time_ns(end))
        try:
            self._sink.append(self._assembler.ending(self._sink.size, self._sink.crc))
        except OSError as e:
            raise self._fail(e) from e
        self._sink.sync()

    def _write_full(self) -> None:
        while self._waiting >= MESSAGE_SAMPLES:
            self._write_samples(MESSAGE_SAMPLES)

    def _write_pending(self) -> None:
        if self._waiting:
            self._write_samples(self._waiting)

    def _write_samples(self, count: int) -> None:
        """The `count` samples that wait longest, as one message."""
        columns = {name: values[:count] for name, values in self._pending.items()}
        data = samples.encode(self._first, self.header.Ts, columns)
        begin, end = self._first, self._first + count - 1
        self._put(
            Message(Topic.SAMPLES, self.header.time_ns(end), self.header.time_ns(begin), data)
        )
        for values in self._pending.values():
            del values[:count]
        self._first += count
        self._written = self._first
        self._since = time.monotonic()

    def _write(self, topic: Topic, content: Mapping[str, Any], at: int) -> None:
        self._put(Message(topic, at, at, samples.dumps(content)))

    def _put(self, message: Message) -> None:
        try:
            self._append(message)
        except OSError as e:
            raise self._fail(e) from e

    def _append(self, message: Message, *, leading: bool = False) -> None:
        self._sink.append(self._assembler.chunk([message], self._sink.size, leading=leading))

    def _fail(self, error: OSError) -> DataError:
        self._failure = error
        for values in self._pending.values():
            values.clear()
        return self._refusal(error)

    def _refusal(self, error: OSError) -> DataError:
        return DataError(
            f"{self.path}: expected room for the recording, received {error.strerror!r}; the file "
            f"is whole up to sample {self._written} (end excluded, {self._sink.size} bytes); free "
            "some space and record again"
        )

    def _require_open(self) -> None:
        if self._failure is not None:
            raise self._refusal(self._failure)
        if self._closed:
            raise DataError(f"{self.path}: the recording is closed; start a new one")

    def _age(self) -> None:
        """Write what has waited for long enough; a thread of its own, as samples may stay out."""
        with self._change:
            while not self._closed and self._failure is None:
                if not self._waiting:
                    self._change.wait()
                    continue
                left = self._since + OLDEST - time.monotonic()
                if left > 0:
                    self._change.wait(left)
                    continue
                try:
                    self._write_pending()
                except DataError:
                    # kept in `_failure`: the next call says it
                    return


def _index(what: str, value: object) -> int:
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not 0 <= value <= samples.EXACT:  # type: ignore[operator]
        raise DataError(f"{what}: expected the number of a sample, 0 or more, received {value!r}")
    return int(value)  # type: ignore[call-overload, no-any-return]


def save_columns(
    path: str | os.PathLike[str], header: Header, columns: Mapping[str, ArrayLike]
) -> None:
    """Write a recording that is already there; the file appears whole or not at all.

    Parameters
    ----------
    path : path
        An existing file is replaced in one step.
    header : Header
    columns : mapping of name to array of shape (N,)
        All columns of the header, without `t`.

    Raises
    ------
    DataError
        Where columns do not match the header or the file cannot be written.
    """
    with replacing(Path(path)) as temporary, RecordWriter(temporary, header) as writer:
        writer.samples(0, columns)
