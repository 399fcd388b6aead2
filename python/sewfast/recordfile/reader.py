"""`read_recording`: an MCAP recording, whole or damaged -> `RecordedFile`."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..arrays import FloatArray, labelled, runs
from ..errors import DataError, located, printable
from ..storage import file_bytes
from .format import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    EXACT,
    FOOTER,
    FOOTER_BODY,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    MOST_RATIO,
    PACKED_HEAD,
    RECORD,
    SCHEMA,
    ZSTD,
    Block,
    Message,
    Topic,
    decode,
    parse,
    zstandard,
)
from .header import LARGEST_HEADER, MOST_MISSING, Header, bearable, plain

# --- The whole chunks of an MCAP file, and the damage between them --------------------------------
# Only data covered by a checksum are trusted: chunks are searched for, not reached by the lengths
# of the records before them. A chunk's head states its size three times (twice if compressed), and
# its CRC-32 covers the rest. The search has a budget, because each head without a chunk costs a
# checksum over megabytes.


LARGEST_FILE = 4 << 30
"""Bytes: more than a day of four columns at 1 kHz."""
LARGEST_CHUNK = 4 << 20
"""Bytes; a recording's own chunks are far smaller."""


class Chunk(NamedTuple):
    """A chunk with a valid CRC: its place in the file and its messages."""

    start: int
    stop: int
    messages: tuple[Message, ...]


def chunks(raw: bytes) -> Iterator[Chunk]:
    """Every chunk that is whole, in the file's order. Raises `DataError` for a file with more heads
    without chunks than damage can explain, and for one that unpacks to more than `MOST_RATIO` times
    its size; `SettingError` if a chunk is compressed and zstandard is not installed.
    """
    # budget of failed checksums, in multiples of the file; each damaged chunk costs one
    at, left, unpacked = 0, 4 * len(raw) + LARGEST_CHUNK, 0
    while (at := raw.find(CHUNK.to_bytes(1, "little"), at)) >= 0:
        claim = _claimed(raw, at)
        chunk = None if claim is None else _chunk_at(raw, at, claim)
        if chunk is not None and claim is not None:
            unpacked += claim.size if claim.is_packed else 0
            if unpacked > min(MOST_RATIO * len(raw), LARGEST_FILE):
                raise DataError(
                    name="chunks", received=f"{unpacked} bytes in {chunk.stop} of the file",
                    expected=f"at most {MOST_RATIO} times the file, and {LARGEST_FILE >> 30} GiB",
                    remedy="the file is not a recording; record long runs in parts",
                )  # fmt: skip
            yield chunk
        elif claim is not None:
            left -= claim.size
            if left < 0:
                raise DataError(
                    name="chunks", expected="heads of chunks with their chunks",
                    received=f"{at} bytes with heads alone",
                    remedy="the file is not a damaged recording",
                )  # fmt: skip
        at = at + 1 if chunk is None else chunk.stop


class _Claim(NamedTuple):
    """The statements of a head: begin and end of the content, its unpacked size, its CRC."""

    begin: int
    stop: int
    size: int
    crc: int
    is_packed: bool


def _claimed(raw: bytes, at: int) -> _Claim | None:
    """The statements of the head at a position; None if there is no head."""
    for head, name in ((CHUNK_HEAD, ()), (PACKED_HEAD, (ZSTD,))):
        begin = at + head.size
        if begin > len(raw):
            return None
        _, length, _, _, size, crc, letters, *named, stored = head.unpack_from(raw, at)
        if letters != len(b"".join(name)) or tuple(named) != name:
            continue
        if length != head.size - RECORD.size + stored or (not name and stored != size):
            return None
        if max(size, stored) > LARGEST_CHUNK or begin + stored > len(raw):
            return None
        return _Claim(begin, begin + stored, size, crc, bool(name))
    return None


def _chunk_at(raw: bytes, at: int, claim: _Claim) -> Chunk | None:
    stored = memoryview(raw)[claim.begin : claim.stop]
    body = _unpacked(stored, claim.size) if claim.is_packed else stored
    if body is None or zlib.crc32(body) != claim.crc:
        return None
    messages = _messages(bytes(body))
    return None if messages is None else Chunk(at, claim.stop, messages)


def _unpacked(stored: memoryview, size: int) -> bytes | None:
    """The content of a compressed chunk; None if it is damaged or not of the stated size."""
    zstd = zstandard("reading a compressed recording")
    try:
        # a frame can state another size than the head, and would allocate it
        found = zstd.ZstdDecompressor().stream_reader(stored).read(size + 1)
    except zstd.ZstdError:
        return None
    return found if len(found) == size else None


def _messages(body: bytes) -> tuple[Message, ...] | None:
    found = []
    for opcode, start, stop in records(body, 0, len(body)):
        if opcode == MESSAGE and stop - start >= MESSAGE_HEAD.size:
            channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(body, start)
            if channel in set(Topic):
                data = body[start + MESSAGE_HEAD.size : stop]
                found.append(Message(Topic(channel), log_time, publish_time, data, sequence))
        elif opcode not in (SCHEMA, CHANNEL):
            return None
    return tuple(found)


def records(raw: bytes, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of each record's content; opcode -1 if a record does not fit."""
    at = start
    while at < stop:
        if at + RECORD.size > stop:
            yield -1, at, stop
            return
        opcode, length = RECORD.unpack_from(raw, at)
        begin = at + RECORD.size
        if length > stop - begin:
            yield -1, at, stop
            return
        at = begin + length
        yield opcode, begin, at


def is_start(raw: bytes, stop: int) -> bool:
    """Whether the bytes before the first chunk are a valid beginning of a file."""
    opcodes = [r[0] for r in records(raw, len(MAGIC), stop)]
    return raw.startswith(MAGIC) and opcodes == [HEADER]


def is_index(raw: bytes, start: int, stop: int) -> bool:
    """Whether the bytes between two chunks are only a message index."""
    for opcode, begin, end in records(raw, start, stop):
        size = end - begin
        if opcode != MESSAGE_INDEX or size < 6 or size != 6 + _u32(raw, begin + 2):
            return False
    return True


def ending_fault(raw: bytes, start: int, *, damaged: bool) -> str | None:
    """The fault behind the last chunk, or None; a `damaged` file's total checksum is not tested."""
    at = start
    for _, begin, end in records(raw, start, len(raw)):
        if not is_index(raw, begin - RECORD.size, end):
            break
        at = end
    if at == len(raw):
        return "the end is missing"
    begin = at + RECORD.size
    if raw[at] != DATA_END or begin + 4 > len(raw) or RECORD.unpack_from(raw, at)[1] != 4:
        return f"bytes {at}:{len(raw)} are damaged or torn"
    if not damaged and _u32(raw, begin) != zlib.crc32(memoryview(raw)[:at]):
        return "an index between the chunks or the file's checksum is damaged; no sample is lost"
    return None if _holds_summary_crc(raw) else "the index at the end is damaged"


def _holds_summary_crc(raw: bytes) -> bool:
    footer = len(raw) - len(MAGIC) - FOOTER_BODY.size - RECORD.size
    if footer < 0 or not raw.endswith(MAGIC):
        return False
    opcode, length = RECORD.unpack_from(raw, footer)
    start, _, crc = FOOTER_BODY.unpack_from(raw, footer + RECORD.size)
    covered = memoryview(raw)[start : footer + RECORD.size + FOOTER_BODY.size - 4]
    return (opcode, length) == (FOOTER, FOOTER_BODY.size) and zlib.crc32(covered) == crc


def _u32(raw: bytes, at: int) -> int:
    value: int = struct.unpack_from("<I", raw, at)[0]
    return value


# --- read_recording: an MCAP recording, whole or damaged -> RecordedFile --------------------------


@dataclass(frozen=True, eq=False, repr=False)
class RecordedFile:
    """The content of a recording file.

    Attributes
    ----------
    path : Path
    header : Header
    columns : mapping of name to array of shape (N,)
        float64, row k is sample k; NaN in gaps and where nothing was measured.
    gaps : tuple of (first, count)
        Missing samples.
    events : tuple of mapping
        `kind`, `index` (int or None), `elapsed` [s], `detail`, in the order written.
    outcome : str
        How the recording ended, according to its completeness message; "torn" without one.
    damage : tuple of str
        Damaged parts, which were left out.
    """

    path: Path
    header: Header
    columns: Mapping[str, FloatArray]
    gaps: tuple[tuple[int, int], ...]
    events: tuple[Mapping[str, Any], ...]
    outcome: str
    damage: tuple[str, ...]

    def __len__(self) -> int:
        """Number of samples from the first to the last, including gaps."""
        return len(next(iter(self.columns.values())))

    @property
    def received(self) -> int:
        """Number of samples in the file."""
        return len(self) - sum(count for _, count in self.gaps)

    @property
    def complete(self) -> bool:
        """Whether it ended as planned, without gaps and damage."""
        planned = self.header.n in (None, self.received)
        return self.outcome == "complete" and not self.gaps and not self.damage and planned

    @property
    def units(self) -> dict[str, str]:
        """Unit of each column, including `t`; pure numbers have no unit."""
        known = {name: unit for name, unit in self.header.columns.items() if unit not in ("", "1")}
        return {"t": "s", **known}

    def table_columns(self) -> dict[str, FloatArray]:
        """`t` [s] and the columns, as for an export."""
        t = np.round(np.arange(len(self)) * self.header.Ts, 9)
        return {"t": t, **self.columns}

    def __reduce__(self) -> tuple[Any, ...]:
        columns = {name: np.array(values) for name, values in self.columns.items()}
        events = [dict(event) for event in self.events]
        return _made, (
            self.path, self.header, columns, self.gaps, events, self.outcome, self.damage,
        )  # fmt: skip

    def __repr__(self) -> str:
        return f"RecordedFile({self.path.name!r}, {self.summary})"

    @property
    def summary(self) -> str:
        """Samples, outcome, gaps and damage in one line."""
        planned = "" if self.header.n is None else f" of {self.header.n}"
        gaps = f"{len(self.gaps)} gap(s)" if self.gaps else "no gap"
        damage = f"{len(self.damage)} damage(s)" if self.damage else "no damage"
        return f"{self.received}{planned} samples, {self.outcome}, {gaps}, {damage}"

    def __str__(self) -> str:
        columns = ", ".join(labelled(n, self.units.get(n, "")) for n in self.columns)
        lines = [
            f"{self.path}: {self.summary}",
            f"  {self.header.name}, Ts = {self.header.Ts:g} s, started {self.header.started}",
            f"  columns   {columns}",
        ]
        lines += _described("device", self.header.device) + _described(
            "settings", self.header.settings
        )
        lines += [f"  gap       samples {a}:{a + n}" for a, n in self.gaps[:_SHOWN]]
        lines += _more(len(self.gaps), "gaps")
        if self.header.n is not None and len(self) < self.header.n:
            lines.append(f"  not there samples {len(self)}:{self.header.n}, planned")
        lines += [f"  event     {_event(e)}" for e in self.events[:_SHOWN]]
        lines += _more(len(self.events), "events")
        lines += [f"  damage    {text}" for text in self.damage[:_SHOWN]]
        return "\n".join(map(printable, lines + _more(len(self.damage), "places of damage")))


_SHOWN = 20


def _described(label: str, content: Mapping[str, Any]) -> list[str]:
    return [f"  {label:<8}  {key}: {value}" for key, value in content.items()]


def _more(count: int, what: str) -> list[str]:
    return [f"  ... {count - _SHOWN} more {what}"] if count > _SHOWN else []


def _made(
    path: Path,
    header: Header,
    columns: Mapping[str, FloatArray],
    gaps: tuple[tuple[int, int], ...],
    events: Sequence[Mapping[str, Any]],
    outcome: str,
    damage: tuple[str, ...],
) -> RecordedFile:
    """The content as an immutable `RecordedFile`."""
    for column in columns.values():
        column.flags.writeable = False
    frozen = tuple(MappingProxyType(dict(event)) for event in events)
    return RecordedFile(path, header, MappingProxyType(columns), gaps, frozen, outcome, damage)


def _event(event: Mapping[str, Any]) -> str:
    at = "" if event["index"] is None else f" at sample {event['index']}"
    detail = dict(event["detail"])
    if detail.get("reason") == "none":
        # devices send this field with every event; it only has a meaning together with a reason
        detail = {key: value for key, value in detail.items() if key not in ("reason", "value")}
    text = ", ".join(f"{key} {value}" for key, value in detail.items())
    return f"{event['kind']}{at}" + (f": {text}" if text else "")


def read_recording(path: str | os.PathLike[str]) -> RecordedFile:
    """Read a recording; damaged parts are left out and listed.

    Parameters
    ----------
    path : path
        An MCAP file written by `RecordWriter`, even if the writer was killed.

    Returns
    -------
    RecordedFile

    Raises
    ------
    DataError
        If the file cannot be read, is not an MCAP file, or both copies of its header message
        are damaged.
    """
    path = _named(path)
    return decode_recording(path, _bytes(path))


def read_header(path: str | os.PathLike[str]) -> Header:
    """Read the header of a recording, without its samples."""
    path = _named(path)
    # both copies of the header message are in the first bytes, not compressed
    raw, found = _bytes(path, 3 * LARGEST_HEADER), _Contents()
    for chunk in _chunks(path, raw):
        for message in chunk.messages:
            found.take(message)
        if found.header is not None:
            return found.header
    raise _headless(path, raw, found.damage)


def _named(path: object) -> Path:
    if isinstance(path, (str, os.PathLike)):
        return Path(path)
    raise DataError(
        name="path", expected="a recording's name", received=repr(path), remedy="as in 'run.mcap'"
    )


def _bytes(path: Path, most: int = -1) -> bytes:
    return file_bytes(path, most=most, largest=LARGEST_FILE)


def decode_recording(path: Path, raw: bytes) -> RecordedFile:
    """As `read_recording`, from the file's bytes."""
    found = _Contents()
    stop: int | None = None
    for chunk in _chunks(path, raw):
        whole = is_start(raw, chunk.start) if stop is None else is_index(raw, stop, chunk.start)
        if not whole:
            found.damage.append(f"bytes {stop or 0}:{chunk.start} are damaged and left out")
        for message in chunk.messages:
            found.take(message)
        stop = chunk.stop
    if found.header is None:
        raise _headless(path, raw, found.damage)
    if stop is not None and (fault := ending_fault(raw, stop, damaged=bool(found.damage))):
        found.damage.append(fault)
    return found.assemble(path, found.header)


def _chunks(path: Path, raw: bytes) -> Iterator[Chunk]:
    try:
        yield from chunks(raw)
    except DataError as e:
        raise located(DataError, path, e) from e


def _headless(path: Path, raw: bytes, damage: list[str]) -> DataError:
    if not raw.startswith(MAGIC):
        return DataError(
            name=str(path), expected="a recording (MCAP)",
            received="a file of another kind or one damaged from its first bytes on",
            remedy="sewfast look reads columns in other formats",
        )  # fmt: skip
    reason = next((text for text in damage if Topic.HEADER.path in text), "none is whole")
    return DataError(
        name=str(path), expected=f"an MCAP file with the message {Topic.HEADER.path} of sewfast",
        received=reason,
        remedy="a file of another program, one compressed other than by zstd, or one damaged "
        "from its start on cannot be read as a recording",
    )  # fmt: skip


class _Contents:
    """Collects the messages of one file."""

    def __init__(self) -> None:
        self.header: Header | None = None
        self.damage: list[str] = []
        self.blocks: list[Block] = []
        self.events: list[Mapping[str, Any]] = []
        self.completeness: Mapping[str, Any] | None = None
        self._next = 0
        self._received = 0
        self._last_event = -1

    def take(self, message: Message) -> None:
        """Add a message; an invalid one is left out and noted as damage."""
        if message.topic is Topic.HEADER and self.header is not None:
            return
        try:
            self._take(message.topic, parse(message.data), message.sequence)
        except ValueError as e:
            self.damage.append(f"a message on {message.topic.path} is left out: {e}")

    def _take(self, topic: Topic, content: Mapping[str, Any], sequence: int) -> None:
        if topic is Topic.HEADER:
            self.header = Header.from_json(content)
        elif self.header is None:
            raise ValueError("it comes before the header")
        elif topic is Topic.SAMPLES:
            self._take_samples(decode(content, self.header.columns), len(self.header.columns))
        elif topic is Topic.EVENTS:
            self._take_event(_checked_event(content), sequence)
        else:
            self.completeness = _checked_completeness(content)

    def _take_samples(self, block: Block, width: int) -> None:
        first, end = int(block.numbers[0]), int(block.numbers[-1]) + 1
        if first < self._next:
            raise ValueError(f"sample {first} follows sample {self._next - 1}")
        received = self._received + len(block.numbers)
        if not bearable(end - received, width):
            raise ValueError(f"samples up to {end} leave gaps of more than {MOST_MISSING} values")
        self.blocks.append(block)
        self._next, self._received = end, received

    def _take_event(self, event: Mapping[str, Any], sequence: int) -> None:
        if sequence <= self._last_event:
            raise ValueError(f"event {sequence} follows event {self._last_event}")
        self.events.append(event)
        self._last_event = sequence

    def assemble(self, path: Path, header: Header) -> RecordedFile:
        end = self._end(len(header.columns))
        there = np.zeros(end, dtype=bool)
        columns = {name: np.full(end, np.nan) for name in header.columns}
        for block in self.blocks:
            there[block.numbers] = True
            for column, values in zip(columns.values(), block.columns, strict=True):
                column[block.numbers] = values
        outcome = "torn" if self.completeness is None else self.completeness["outcome"]
        gaps, damage = runs(~there), tuple(self.damage)
        return _made(path, header, columns, gaps, self.events, outcome, damage)

    def _end(self, width: int) -> int:
        """Number of samples there should be, from the completeness message if there is one."""
        if self.completeness is None:
            return self._next
        lost = self.completeness["received"] - self._received
        if lost:
            self.damage.append(f"{lost} of {self.completeness['received']} samples are left out")
        end: int = self.completeness["end"]
        if end < self._next or not bearable(end - self._received, width):
            self.damage.append(f"its account ends at sample {end}, its samples at {self._next}")
            return self._next
        return end


def _checked_event(content: Mapping[str, Any]) -> Mapping[str, Any]:
    index, elapsed = content.get("index"), content.get("elapsed")
    detail = content.get("detail")
    known = isinstance(content.get("kind"), str) and isinstance(detail, dict)
    if not known or not (index is None or _is_number(index)) or type(elapsed) not in (int, float):
        raise ValueError("it is not an event")
    plain("event", dict(content))
    kept = {"kind": content["kind"], "index": index, "elapsed": elapsed, "detail": detail}
    return MappingProxyType(kept)


def _checked_completeness(content: Mapping[str, Any]) -> Mapping[str, Any]:
    numbers = _is_number(content.get("received")) and _is_number(content.get("end"))
    if not isinstance(content.get("outcome"), str) or not numbers:
        raise ValueError("it is not a completeness message")
    return content


def _is_number(value: object) -> bool:
    return type(value) is int and 0 <= value <= EXACT
