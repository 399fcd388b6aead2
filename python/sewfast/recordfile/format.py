"""The format of recordings: topics, messages of samples, MCAP records and chunks."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import DataError, not_installed

# --- The four kinds of message in a recording: channel numbers, topics, JSON schemas --------------


class Topic(IntEnum):
    """Channel number of each topic, fixed so that every chunk can be read on its own."""

    HEADER = 1
    SAMPLES = 2
    EVENTS = 3
    COMPLETENESS = 4

    @property
    def path(self) -> str:
        return f"/sewfast/{self.name.lower()}"

    @property
    def schema_name(self) -> str:
        return f"sewfast.{self.name.title()}"


def schema(topic: Topic, columns: Mapping[str, str], *, single: bool = False) -> bytes:
    """JSON schema of messages with these columns; `single` for one message a sample."""
    content = _object(**_PROPERTIES[topic]) if topic in _PROPERTIES else _samples(columns, single)
    return json.dumps({"title": topic.schema_name, **content}).encode()


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _samples(columns: Mapping[str, str], single: bool) -> dict[str, Any]:
    # null is a value that was not measured
    given = {name: (["number", "null"], f"[{unit}]") for name, unit in columns.items()}
    own = {
        "index": ("integer", "number of the sample, 0 at the start"),
        "t": ("number", "time since the start [s]"),
    }
    properties: dict[str, Any] = {}
    for name, (kind, description) in {**own, **given}.items():
        value = {"type": kind} if single else {"type": "array", "items": {"type": kind}}
        properties[name] = {**value, "description": description}
    return {"type": "object", "properties": properties, "required": list(properties)}


_WHOLE = {"type": "integer"}
_TEXT = {"type": "string"}
_PROPERTIES: dict[Topic, dict[str, Any]] = {
    Topic.HEADER: {
        "format": _TEXT,
        "version": _WHOLE,
        "name": _TEXT,
        "Ts": {"type": "number", "description": "sample time [s]"},
        "columns": {"type": "object", "description": "unit of each column"},
        "n": {"type": ["integer", "null"], "description": "planned number of samples"},
        "counts_per_rev": {"type": ["number", "null"]},
        "device": {"type": "object"},
        "settings": {"type": "object"},
        "started": _TEXT,
    },
    Topic.EVENTS: {
        "kind": _TEXT,
        "index": {"type": ["integer", "null"], "description": "sample at which it happened"},
        "elapsed": {"type": "number", "description": "host's time since the file was opened [s]"},
        "detail": {"type": "object"},
    },
    Topic.COMPLETENESS: {
        "outcome": _TEXT,
        "received": {"type": "integer", "description": "samples written"},
        "expected": {"type": ["integer", "null"], "description": "samples planned"},
        "end": {"type": "integer", "description": "number of the sample after the last one"},
        "gap_count": _WHOLE,
        "gaps": {
            "type": "array",
            "items": {"type": "array", "items": _WHOLE},
            "description": "[first, count] of each gap; the first ones of many",
        },
    },
}


# --- Columns of numbers <-> messages of samples (JSON) --------------------------------------------


MOST_GAPS_LISTED = 10_000
"""Most gaps listed in the completeness message; the samples show all of them anyway."""
EXACT = 2**53
"""Whole numbers up to here are exact in float64."""


def numbers(name: str, values: object) -> list[Any]:
    """A column as JSON values that parse to the same float64; NaN is null. Whole numbers are
    written as such, float32 as the shortest text of the same float32.
    """
    array = np.asarray(values)
    if array.ndim != 1 or array.dtype.kind not in "biuf":
        raise DataError(
            name=name, expected="real numbers of shape (N,)",
            received=f"{array.dtype} of shape {array.shape}", remedy="pass one column of numbers",
        )  # fmt: skip
    if array.dtype.kind != "f":
        return _whole(name, array)
    return _real(name, array)


def _whole(name: str, array: NDArray[Any]) -> list[int]:
    if len(array) and max(-int(array.min()), int(array.max())) > EXACT:
        raise DataError(
            name=name, expected="whole numbers of at most 2^53",
            received=f"{array.min()} to {array.max()}", remedy="subtract the first one",
        )  # fmt: skip
    whole: list[int] = array.astype(np.int64).tolist()
    return whole


def _real(name: str, array: NDArray[Any]) -> list[Any]:
    if array.dtype.itemsize < 8:
        array = array.astype(str)
    array = array.astype(np.float64)
    if np.isinf(array).any():
        k = int(np.argmax(np.isinf(array)))
        raise DataError(
            name=name, expected="finite numbers, or NaN where nothing was measured",
            received=f"{array[k]} at row {k}",
        )  # fmt: skip
    negative_zero = (array == 0) & np.signbit(array)
    if np.all((np.rint(array) == array) & (np.abs(array) <= EXACT) & ~negative_zero):
        return array.astype(np.int64).tolist()  # type: ignore[no-any-return]
    missing = np.isnan(array).any()
    return [None if v != v else v for v in array.tolist()] if missing else array.tolist()


def encode(first: int, Ts: float, columns: Mapping[str, list[Any]]) -> bytes:
    """The message of consecutive samples from number `first` on."""
    count = len(next(iter(columns.values())))
    index = range(first, first + count)
    own: dict[str, Any] = {"index": list(index), "t": [round(k * Ts, 9) for k in index]}
    return dumps({**own, **columns})


def dumps(content: Mapping[str, Any]) -> bytes:
    """A message's JSON: ASCII, no spaces, finite numbers."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def parse(data: bytes) -> dict[str, Any]:
    """A message's JSON object; `ValueError` for anything else, or numbers that are not finite."""
    try:
        content = json.loads(data, parse_constant=_refuse)
    except RecursionError as e:
        raise ValueError("it is nested too deeply") from e
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    return content


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


class Block(NamedTuple):
    """Samples of one message: their numbers, and the columns in the header's order."""

    numbers: NDArray[np.int64]
    columns: tuple[FloatArray, ...]


def decode(content: Mapping[str, Any], names: Iterable[str]) -> Block:
    """The samples of a parsed message. Raises `ValueError` if columns are missing or differ in
    length, numbers are not finite, or the samples' numbers do not increase.
    """
    index = _column(content, "index", (int,))
    if len(index) == 0 or index.min() < 0 or index.max() > EXACT or np.any(np.diff(index) <= 0):
        raise ValueError("the samples' numbers do not increase from 0 on")
    columns = tuple(_column(content, name, (int, float, type(None))) for name in names)
    if any(len(c) != len(index) for c in columns):
        raise ValueError("columns differ in length")
    return Block(index.astype(np.int64), columns)


def _column(content: Mapping[str, Any], name: str, kinds: tuple[type, ...]) -> FloatArray:
    values = content.get(name, ())
    if type(values) in kinds:
        # one message a sample
        values = [values]
    # the exact type: NumPy would accept True and text as numbers
    if not isinstance(values, list) or not set(map(type, values)) <= set(kinds):
        raise ValueError(f"column {name!r} is missing or holds no numbers")
    try:
        array = np.array(values, dtype=np.float64)
    except OverflowError as e:
        raise ValueError(f"column {name!r} holds a number beyond float64") from e
    if np.isinf(array).any():
        raise ValueError(f"column {name!r} holds a number beyond float64")
    return array


# --- MCAP records as bytes: https://mcap.dev/spec; chunks of one topic, plain or zstd, CRCs on ----


MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0E, 0x0F
LIBRARY = "sewfast"

RECORD = struct.Struct("<BQ")
"""Opcode and length of what follows."""
CHUNK_HEAD = struct.Struct("<BQQQQIIQ")
"""Opcode, length, first and last log time, size, CRC-32, length of the compression's name, size."""
PACKED_HEAD = struct.Struct("<BQQQQII4sQ")
"""The same of a compressed chunk, with the compression's name and its compressed size."""
ZSTD = b"zstd"
MOST_RATIO = 200
"""Largest ratio of all unpacked chunks to the file; 200 constant columns reach 96. A reader unpacks
no more, so that a small file cannot exhaust memory; a writer leaves chunks plain that would exceed
it."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time."""
FOOTER_BODY = struct.Struct("<QQI")
"""Start of the summary, start of its offsets, CRC-32 of both."""
_PLACE = struct.Struct("<QQ")
_ENTRY = struct.Struct("<QQQQQHI?")


class Message(NamedTuple):
    """One message: its channel, its times [ns since 1970] and its JSON."""

    topic: Topic
    log_time: int
    publish_time: int
    data: bytes
    sequence: int = 0
    """Counted by the writer, per channel."""


def _record(opcode: int, body: bytes) -> bytes:
    return RECORD.pack(opcode, len(body)) + body


def _text(text: str) -> bytes:
    raw = text.encode()
    return struct.pack("<I", len(raw)) + raw


def opening() -> bytes:
    return MAGIC + _record(HEADER, _text("") + _text(LIBRARY))


def catalogue(columns: Mapping[str, str], *, single: bool) -> bytes:
    """Schema and channel records of all topics."""
    return b"".join(_record(SCHEMA, _schema(topic, columns, single)) for topic in Topic) + b"".join(
        _record(CHANNEL, _channel(topic)) for topic in Topic
    )


def _schema(topic: Topic, columns: Mapping[str, str], single: bool) -> bytes:
    data = schema(topic, columns, single=single)
    head = struct.pack("<H", topic) + _text(topic.schema_name) + _text("jsonschema")
    return head + struct.pack("<I", len(data)) + data


def _channel(topic: Topic) -> bytes:
    head = struct.pack("<HH", topic, topic) + _text(topic.path) + _text("json")
    return head + struct.pack("<I", 0)


class Assembler:
    """Chunks and summary of one file, as bytes to append; 47 bytes a chunk stay in memory."""

    def __init__(
        self, columns: Mapping[str, str], *, single: bool = False, compress: bool = False
    ) -> None:
        self._pack = zstandard("compressing a recording").ZstdCompressor() if compress else None
        self._unpacked = 0
        self._catalogue = catalogue(columns, single=single)
        self._index = bytearray()
        self._counts = dict.fromkeys(Topic, 0)
        self._first, self._last = 2**64 - 1, 0

    def chunk(self, messages: Sequence[Message], at: int, *, leading: bool = False) -> bytes:
        """A chunk of messages on one topic, and its index; `at` is its position in the file.
        The first chunk is `leading`: it contains the schemas and channels.
        """
        topic = messages[0].topic
        records = bytearray(self._catalogue if leading else b"")
        places = bytearray()
        for message in messages:
            places += _PLACE.pack(message.log_time, len(records))
            records += _record(MESSAGE, self._message(message))
        times = [message.log_time for message in messages]
        self._first, self._last = min(self._first, *times), max(self._last, *times)
        size, crc = len(records), zlib.crc32(records)
        span = min(times), max(times)
        packed = self._packed(topic, bytes(records), at)
        stored = bytes(records) if packed is None else packed
        if packed is None:
            head = CHUNK_HEAD.pack(
                CHUNK, CHUNK_HEAD.size - RECORD.size + size, *span, size, crc, 0, size
            )
        else:
            head = PACKED_HEAD.pack(
                CHUNK, PACKED_HEAD.size - RECORD.size + len(stored), *span, size, crc,
                len(ZSTD), ZSTD, len(stored),
            )  # fmt: skip
        index = _record(MESSAGE_INDEX, struct.pack("<HI", topic, len(places)) + places)
        whole = head + stored
        self._index += _ENTRY.pack(
            *span, at, size, len(whole), topic, len(index), packed is not None
        )
        return whole + index

    def _packed(self, topic: Topic, records: bytes, at: int) -> bytes | None:
        """A chunk's content, compressed; None if it stays plain."""
        # the header stays readable for programs without zstd
        if self._pack is None or topic is Topic.HEADER:
            return None
        if self._unpacked + len(records) > MOST_RATIO * at:
            return None
        self._unpacked += len(records)
        packed: bytes = self._pack.compress(records)
        return packed

    def _message(self, message: Message) -> bytes:
        sequence = self._counts[message.topic]
        self._counts[message.topic] += 1
        times = (message.log_time, message.publish_time)
        return MESSAGE_HEAD.pack(message.topic, sequence, *times) + message.data

    def ending(self, at: int, data_crc: int) -> Iterator[bytes]:
        """Everything after the last chunk, in pieces; `at` is its position in the file."""
        end = _record(DATA_END, struct.pack("<I", data_crc))
        yield end
        start = place = at + len(end)
        offsets, crc = b"", 0
        for opcode, group in self._groups():
            begin = place
            for piece in group:
                yield piece
                place += len(piece)
                crc = zlib.crc32(piece, crc)
            offsets += _record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, begin, place - begin))
        footer = RECORD.pack(FOOTER, FOOTER_BODY.size) + struct.pack("<QQ", start, place)
        yield offsets
        yield footer + struct.pack("<I", zlib.crc32(offsets + footer, crc)) + MAGIC

    def _groups(self) -> Iterator[tuple[int, Iterable[bytes]]]:
        for kind in (SCHEMA, CHANNEL):
            yield kind, [record for opcode, record in _records(self._catalogue) if opcode == kind]
        yield STATISTICS, [self._statistics()]
        entries = _ENTRY.iter_unpack(self._index)
        yield CHUNK_INDEX, (_record(CHUNK_INDEX, _chunk_index(*entry)) for entry in entries)

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", t, n) for t, n in self._counts.items() if n)
        body = struct.pack(
            "<QHIIIIQQI", sum(self._counts.values()), len(Topic), len(Topic), 0, 0,
            len(self._index) // _ENTRY.size, self._first, self._last, len(counts),
        )  # fmt: skip
        return _record(STATISTICS, body + counts)


def _chunk_index(
    first: int, last: int, at: int, size: int, length: int, topic: int, index: int, packed: bool
) -> bytes:
    name = ZSTD if packed else b""
    stored = length - (PACKED_HEAD if packed else CHUNK_HEAD).size
    return (
        struct.pack("<QQQQ", first, last, at, length)
        + struct.pack("<IHQ", 10, topic, at + length)
        + struct.pack("<QI", index, len(name))
        + name
        + struct.pack("<QQ", stored, size)
    )


def zstandard(purpose: str) -> Any:
    """The package that compresses chunks; raises `SettingError` if it is not installed."""
    try:
        import zstandard as found
    except ImportError as e:
        raise not_installed("zstandard", purpose, "sewfast[zstd]") from e
    return found


def _records(raw: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at < len(raw):
        opcode, length = RECORD.unpack_from(raw, at)
        found.append((opcode, raw[at : at + RECORD.size + length]))
        at += RECORD.size + length
    return found
