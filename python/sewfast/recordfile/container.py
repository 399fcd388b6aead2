"""MCAP records as bytes: https://mcap.dev/spec; chunks of one topic, uncompressed, CRCs on."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from .topics import Topic, schema

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, SUMMARY_OFFSET, DATA_END = 0x0B, 0x0E, 0x0F
LIBRARY = "sewfast"

RECORD = struct.Struct("<BQ")
"""Opcode and length of what follows."""
CHUNK_HEAD = struct.Struct("<BQQQQIIQ")
"""Opcode, length, first and last log time, size, CRC-32, length of the compression's name, size."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time."""
FOOTER_BODY = struct.Struct("<QQI")
"""Start of the summary, start of its offsets, CRC-32 of both."""
_PLACE = struct.Struct("<QQ")
_ENTRY = struct.Struct("<QQQQHI")


class Message(NamedTuple):
    """One message: its channel, its times [ns since 1970] and its JSON."""

    topic: Topic
    log_time: int
    publish_time: int
    data: bytes
    sequence: int = 0
    """Counted by the writer, on each channel for itself."""


def _record(opcode: int, body: bytes) -> bytes:
    return RECORD.pack(opcode, len(body)) + body


def _text(text: str) -> bytes:
    raw = text.encode()
    return struct.pack("<I", len(raw)) + raw


def opening() -> bytes:
    """The first bytes of a file."""
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
    """Chunks and the summary of one file, as bytes to append.

    It keeps 38 bytes a chunk for the summary, so that its memory stays small over hours.
    """

    def __init__(self, columns: Mapping[str, str], *, single: bool = False) -> None:
        self._catalogue = catalogue(columns, single=single)
        self._index = bytearray()
        self._counts = dict.fromkeys(Topic, 0)
        self._first, self._last = 2**64 - 1, 0

    def chunk(self, messages: Sequence[Message], at: int, *, leading: bool = False) -> bytes:
        """A chunk of messages on one topic, and its index; `at` is where in the file it will stand.

        The first chunk is `leading`: schemas and channels stand in it.
        """
        topic = messages[0].topic
        records = bytearray(self._catalogue if leading else b"")
        places = bytearray()
        for message in messages:
            places += _PLACE.pack(message.log_time, len(records))
            records += _record(MESSAGE, self._message(message))
        times = [message.log_time for message in messages]
        self._first, self._last = min(self._first, *times), max(self._last, *times)
        size = len(records)
        head = CHUNK_HEAD.pack(
            CHUNK, CHUNK_HEAD.size - RECORD.size + size, min(times), max(times),
            size, zlib.crc32(records), 0, size,
        )  # fmt: skip
        index = _record(MESSAGE_INDEX, struct.pack("<HI", topic, len(places)) + places)
        self._index += _ENTRY.pack(min(times), max(times), at, size, topic, len(index))
        return head + bytes(records) + index

    def _message(self, message: Message) -> bytes:
        sequence = self._counts[message.topic]
        self._counts[message.topic] += 1
        times = (message.log_time, message.publish_time)
        return MESSAGE_HEAD.pack(message.topic, sequence, *times) + message.data

    def ending(self, at: int, data_crc: int) -> Iterator[bytes]:
        """All that follows the last chunk, in pieces; `at` is where it will stand."""
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


def _chunk_index(first: int, last: int, at: int, size: int, topic: int, index: int) -> bytes:
    length = CHUNK_HEAD.size + size
    return (
        struct.pack("<QQQQ", first, last, at, length)
        + struct.pack("<IHQ", 10, topic, at + length)
        + struct.pack("<QIQQ", index, 0, size, size)
    )


def _records(raw: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at < len(raw):
        opcode, length = RECORD.unpack_from(raw, at)
        found.append((opcode, raw[at : at + RECORD.size + length]))
        at += RECORD.size + length
    return found
