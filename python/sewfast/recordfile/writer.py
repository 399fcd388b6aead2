"""`RecordWriter`: samples and events into an MCAP file; files that are not overwritten; exports."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import is_whole
from ..errors import DataError, SettingError
from ..storage import write_table
from . import format
from .filing import Block, End, Event, Filing, Sink, batched, replacing
from .format import Assembler, Message, Topic, opening
from .header import MOST_MISSING, Header, bearable, plain
from .reader import RecordedFile, read_header, read_recording

# --- Protected files: recordings of a drive, which cannot be made again ---------------------------


ENDING = ".mcap"
_COMPUTED = 1 << 5
"""The capability of a device that simulates a machine (docs/PROTOCOL.md)."""


def require_ending(path: str | os.PathLike[str]) -> Path:
    """The path of a recording, whose ending other programs rely on."""
    if not isinstance(path, (str, os.PathLike)) or "\0" in str(path):
        raise SettingError(
            name="file", expected="a file's name", received=repr(path),
            remedy=f"as in file='run{ENDING}'",
        )  # fmt: skip
    found = Path(path)
    if found.suffix.lower() != ENDING:
        raise SettingError(
            name=str(found), expected=f"a recording's name, which ends in {ENDING}",
            received=found.suffix or "none",
            remedy="rename it; `sewfast.recordfile.export` converts it to other formats",
        )  # fmt: skip
    return found


def require_replaceable(path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Protect recordings: an `.mcap` is replaced only if it can be computed again.
    That holds for recordings of a virtual machine and for exports of a recording. A file that
    cannot be read is protected, since it can be a recording of a drive. Raises `SettingError` if
    the file is protected; `overwrite` allows its replacement in any case.
    """
    found = Path(path)
    if overwrite or found.suffix.lower() != ENDING or not _is_there(found):
        return
    try:
        header = read_header(found)
    except DataError:
        raise _kept(found, "a file that can be one") from None
    if not _is_computed(header):
        device = header.device.get("name", "a drive")
        raise _kept(found, f"one of {str(device)[:60]!r} of {header.started[:19]}")


def require_free(paths: Iterable[str | os.PathLike[str] | None], *, overwrite: bool) -> None:
    """Refuse to overwrite any file: for output that is the only record of a run on a drive."""
    for path in paths:
        if path is not None and not overwrite and _is_there(Path(path)):
            raise SettingError(
                name=str(path), expected="a free name for what a drive did",
                received="a file, which is kept",
                remedy="choose another name, or overwrite it (--overwrite, overwrite=True)",
            )  # fmt: skip


def _is_there(path: Path) -> bool:
    """Whether there is a file to lose; a folder is refused later, when it is written to."""
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
        name=str(path), expected="no recording that cannot be had again",
        received=f"{what}, which is kept",
        remedy="choose another name, or overwrite it (--overwrite, overwrite=True)",
    )  # fmt: skip


# --- RecordWriter: samples and events into an MCAP file while the drive runs ----------------------


class RecordWriter:
    """One recording, written under its final name: whatever is written stays readable.

    A message holds 100 samples, or fewer if the oldest would wait longer than .2 s. Each message is
    a chunk, which goes to the operating system at once. A killed recorder loses only the samples
    that were waiting.

    Parameters
    ----------
    path : path
        File to write; `.mcap` is the usual ending.
    header : Header
    overwrite : bool
        Whether to replace an existing file.
    lazy : bool
        Create the file with the first sample or event. Without any, no file is created and an
        existing one is left alone. Whether it can be created is checked here in any case.
    compress : bool
        Compress each chunk by zstd (`sewfast[zstd]`). The guarantees of a plain file remain: a
        chunk is written as a whole, and a damaged one costs only its own samples.

    Raises
    ------
    SettingError
        If the file exists and `overwrite` is False, or zstandard is not installed.
    DataError
        If it cannot be written.

    Notes
    -----
    Leaving the ``with`` block closes the file: "complete", "interrupted" after Ctrl-C, "failed"
    after another exception. A separate thread owns the file, so that neither a slow disk nor Ctrl-C
    interrupts a write; a full disk is reported by the next call. Events can come from any thread,
    samples from one at a time.

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
        self,
        path: str | os.PathLike[str],
        header: Header,
        *,
        overwrite: bool = False,
        lazy: bool = False,
        compress: bool = False,
    ) -> None:
        self.path = Path(path)
        self.header = header
        self._filing = Filing(self.path, header, overwrite=overwrite, lazy=lazy, compress=compress)
        self._opened = time.monotonic()
        self._next = 0
        self._received = 0
        self._closed = False
        self._is_reported = False

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
        # the exception being raised is more informative
        with suppress(DataError):
            self.close("interrupted" if stopped else "failed")

    @property
    def received(self) -> int:
        """Samples given so far."""
        return self._received

    @property
    def is_made(self) -> bool:
        """Whether a file was created; final once the recording is closed."""
        return self._filing.is_made

    def samples(self, first: int, columns: Mapping[str, ArrayLike]) -> None:
        """Append consecutive samples.

        Parameters
        ----------
        first : int
            Number of the first one; a jump ahead leaves a gap.
        columns : mapping of name to array of shape (k,)
            All columns of the header, one length, any k. NaN: not measured.

        Raises
        ------
        DataError
            If columns do not match the header, samples are repeated or the file cannot be
            written any further.
        """
        first = _index("first", first)
        values = self._matching(columns)
        count = len(next(iter(values.values())))
        self._require_open()
        self._require_new(first, count)
        if count:
            self._filing.put(Block(first, values))
            self._next = first + count
            self._received += count

    def _matching(self, columns: Mapping[str, ArrayLike]) -> dict[str, list[Any]]:
        if set(columns) != set(self.header.columns):
            raise DataError(
                name=str(self.path), expected=f"the columns {', '.join(self.header.columns)}",
                received=", ".join(map(str, columns)) or "none",
                remedy="give every column of the header",
            )  # fmt: skip
        values = {name: format.numbers(name, columns[name]) for name in self.header.columns}
        if len({len(v) for v in values.values()}) > 1:
            raise DataError(
                name=str(self.path), expected="columns of one length",
                received=str({name: len(v) for name, v in values.items()}),
            )  # fmt: skip
        return values

    def _require_new(self, first: int, count: int) -> None:
        if first < self._next:
            raise DataError(
                name=str(self.path), expected=f"samples from {self._next} on",
                received=f"{first} to {first + count - 1}", remedy="a sample is written once",
            )  # fmt: skip
        missing = first - self._received
        if not bearable(missing, len(self.header.columns)) or first + count > format.EXACT:
            raise DataError(
                name=str(self.path), expected=f"gaps of at most {MOST_MISSING} values altogether",
                received=f"sample {first} after {self._received} samples",
                remedy="start a new recording",
            )  # fmt: skip

    def event(self, kind: str, index: int | None = None, **detail: Any) -> None:
        """Record an event, at once.

        Parameters
        ----------
        kind : str
            "armed", "tripped", "gap", "reset", ...
        index : int or None
            Sample at which it happened, if known.
        **detail
            Finite numbers, text, lists and dicts.

        Raises
        ------
        SettingError
            For a detail without a JSON form.
        DataError
            If the file cannot be written any further.
        """
        index = None if index is None else _index("index", index)
        content = plain(f"event {kind!r}", {"kind": str(kind), "index": index, "detail": detail})
        self._require_open()
        elapsed = time.monotonic() - self._opened
        content["elapsed"] = round(elapsed, 6)
        since = self.header.start_ns() + round(elapsed * 1e9)
        self._filing.put(Event(content, since if index is None else self.header.time_ns(index)))

    def close(self, outcome: str = "complete", *, taken: int | None = None) -> None:
        """Write waiting samples, the completeness record and the index; can be called repeatedly.

        Parameters
        ----------
        outcome : str
            "complete", "interrupted", "failed", "tripped" or another word for how it ended.
        taken : int or None
            Samples that the device took, if it reported them: missing last ones are a gap. A
            complete recording has the planned number.

        Raises
        ------
        DataError
            If that could not be written; the samples before it are whole.
        """
        if not self._closed:
            self._filing.put(End(str(outcome), taken or 0))
            self._closed = True
        try:
            self._filing.finish()
        except KeyboardInterrupt:
            # a single Ctrl-C must not cost the end of the file; a second one can
            self._filing.finish()
            raise
        if self._filing.failure is not None and not self._is_reported:
            self._is_reported = True
            raise self._filing.refusal(self._filing.failure)

    def _require_open(self) -> None:
        if self._filing.failure is not None:
            raise self._filing.refusal(self._filing.failure)
        if self._closed:
            raise DataError(
                name=str(self.path), expected="a recording that is open", received="a closed one",
                remedy="start a new one",
            )  # fmt: skip


def _index(what: str, value: object) -> int:
    if not is_whole(value) or not 0 <= value <= format.EXACT:
        raise DataError(
            name=what, expected="the number of a sample, 0 or more", received=repr(value)
        )
    return int(value)


def save_columns(
    path: str | os.PathLike[str], header: Header, columns: Mapping[str, ArrayLike]
) -> None:
    """Write a finished recording; the file is either complete or absent.

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
        If columns do not match the header or the file cannot be written.
    """
    with replacing(Path(path)) as temporary, RecordWriter(temporary, header) as writer:
        writer.samples(0, columns)


# --- A recording with one message per sample, as plotting programs need it ------------------------


def save_curves(
    path: str | os.PathLike[str], recording: RecordedFile, *, compress: bool = False
) -> None:
    """Write a recording again with one message per sample; the file is complete or absent.
    `read_recording` reads it like any other. Samples in gaps have no message, damaged parts are
    left out, and a torn recording stays marked as torn.
    """
    with replacing(Path(path)) as temporary:
        assembler = Assembler(recording.header.columns, single=True, compress=compress)
        sink = Sink(temporary, overwrite=False)
        try:
            sink.append(opening())
            for count, group in enumerate(_groups(recording)):
                sink.append(assembler.chunk(group, sink.size, leading=count == 0))
            for piece in batched(assembler.ending(sink.size, sink.crc)):
                sink.append(piece)
        finally:
            sink.close()


def _groups(recording: RecordedFile) -> Iterator[list[Message]]:
    # limits of a chunk, whichever comes first: a reader accepts chunks of at most 4 MiB
    chunk_samples, chunk_bytes = 500, 1 << 20
    header = recording.header
    start = header.start_ns()
    first = Message(Topic.HEADER, start, start, header.encode())
    yield from ([first], [first])
    for event in recording.events:
        at = start + round(event["elapsed"] * 1e9)
        at = at if event["index"] is None else header.time_ns(event["index"])
        yield [Message(Topic.EVENTS, at, at, format.dumps(dict(event)))]
    group: list[Message] = []
    size = 0
    for message in _samples(recording):
        group.append(message)
        size += len(message.data)
        if len(group) == chunk_samples or size >= chunk_bytes:
            yield group
            group, size = [], 0
    if group:
        yield group
    at = header.time_ns(len(recording))
    yield [Message(Topic.COMPLETENESS, at, at, format.dumps(_account(recording)))]


def _samples(recording: RecordedFile) -> Iterator[Message]:
    header = recording.header
    gaps = iter((*recording.gaps, (len(recording), 0)))
    begin = 0
    for first, count in gaps:
        columns = [
            format.numbers(n, np.array(c[begin:first])) for n, c in recording.columns.items()
        ]
        for k, *row in zip(range(begin, first), *columns, strict=True):
            at = header.time_ns(k)
            own = {"index": k, "t": round(k * header.Ts, 9)}
            data = format.dumps({**own, **dict(zip(recording.columns, row, strict=True))})
            yield Message(Topic.SAMPLES, at, at, data)
        begin = first + count


def _account(recording: RecordedFile) -> dict[str, Any]:
    return {
        "outcome": recording.outcome,
        "received": recording.received,
        "expected": recording.header.n,
        "end": len(recording),
        "gap_count": len(recording.gaps),
        "gaps": [list(gap) for gap in recording.gaps[: format.MOST_GAPS_LISTED]],
    }


# --- A recording -> CSV, Parquet, .mat, .npz, or MCAP with one message per sample -----------------


def _is_earlier(out: Path, recording: RecordedFile) -> bool:
    """Whether a file is an earlier export of this recording, without additional samples."""
    if out.suffix.lower() != ".mcap" or not out.is_file():
        return False
    try:
        found = read_recording(out)
    except DataError:
        return False
    return found.header == recording.header and found.received <= recording.received


def export(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    compress: bool = False,
) -> RecordedFile:
    """Write a recording's columns with `t` in the format given by the extension of `out`.

    Gaps are rows of NaN. Events, settings and the device's identity go into `.mcap` only.

    Parameters
    ----------
    path : path
        The recording.
    out : path
        `.csv`, `.parquet`, `.mat`, `.npz`, or `.mcap`: one message per sample, for plotting
        programs; also repairs a file without its end. An existing file is replaced in one step,
        except a recording of a drive.
    overwrite : bool
        Whether to replace such a recording as well.
    compress : bool
        Compress the chunks of an `.mcap` by zstd (`sewfast[zstd]`), which PlotJuggler, Foxglove and
        sewfast read.

    Returns
    -------
    RecordedFile
        The recording.

    Raises
    ------
    DataError
        If the recording cannot be read or the other file cannot be written.
    SettingError
        If the extension is unknown or its package is not installed, `out` is the recording
        itself or another one that cannot be made again, or another format is to be compressed.
    """
    if compress and Path(out).suffix.lower() != ENDING:
        raise SettingError(
            name="compress", expected=f"a file that ends in {ENDING}", received=str(out),
            remedy="leave it out: .parquet is compressed anyway",
        )  # fmt: skip
    recording = read_recording(path)
    if Path(out).exists() and Path(out).samefile(path):
        raise SettingError(
            name=str(out), expected="another file than the recording, which cannot be made again",
            received="the same", remedy="choose another name",
        )  # fmt: skip
    require_replaceable(out, overwrite=overwrite or _is_earlier(Path(out), recording))
    if Path(out).suffix.lower() == ".mcap":
        save_curves(out, recording, compress=compress)
    else:
        write_table(out, recording.table_columns(), units=recording.units)
    return recording
