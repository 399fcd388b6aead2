"""MCAP records as bytes: https://mcap.dev/spec; one message a chunk, uncompressed, CRCs on."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
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
_ENTRY = struct.Struct("<QQQH")


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


def catalogue(columns: Mapping[str, str]) -> bytes:
    """Schema and channel records of all topics."""
    return b"".join(_record(SCHEMA, _schema(topic, columns)) for topic in Topic) + b"".join(
        _record(CHANNEL, _channel(topic)) for topic in Topic
    )


def _schema(topic: Topic, columns: Mapping[str, str]) -> bytes:
    data = schema(topic, columns)
    head = struct.pack("<H", topic) + _text(topic.schema_name) + _text("jsonschema")
    return head + struct.pack("<I", len(data)) + data


def _channel(topic: Topic) -> bytes:
    head = struct.pack("<HH", topic, topic) + _text(topic.path) + _text("json")
    return head + struct.pack("<I", 0)


class Assembler:
    """Chunks and the summary of one file, as bytes to append.

    It keeps 26 bytes a chunk for the summary, so that its memory stays small over hours.
    """

    def __init__(self, columns: Mapping[str, str]) -> None:
        self._catalogue = catalogue(columns)
        self._index = bytearray()
        self._counts = dict.fromkeys(Topic, 0)

    def chunk(self, message: Message, at: int, *, leading: bool = False) -> bytes:
        """A chunk with one message, and its index; `at` is where in the file it will stand."""
        body = MESSAGE_HEAD.pack(
            message.topic, self._counts[message.topic], message.log_time, message.publish_time
        )
        before = self._catalogue if leading else b""
        records = before + _record(MESSAGE, body + message.data)
        size = len(records)
        head = CHUNK_HEAD.pack(
            CHUNK, CHUNK_HEAD.size - RECORD.size + size, message.log_time, message.log_time,
            size, zlib.crc32(records), 0, size,
        )  # fmt: skip
        self._counts[message.topic] += 1
        self._index += _ENTRY.pack(message.log_time, at, size, message.topic)
        position = struct.pack("<HIQQ", message.topic, 16, message.log_time, len(before))
        return head + records + _record(MESSAGE_INDEX, position)

    def ending(self, at: int, data_crc: int) -> bytes:
        """All that follows the last chunk; `at` is where it will stand."""
        end = _record(DATA_END, struct.pack("<I", data_crc))
        start = at + len(end)
        catalogue_of = {SCHEMA: b"", CHANNEL: b""}
        for opcode, record in _records(self._catalogue):
            catalogue_of[opcode] += record
        groups = {**catalogue_of, STATISTICS: self._statistics(), CHUNK_INDEX: self._chunks()}
        summary, offsets = b"", b""
        for opcode, group in groups.items():
            place = struct.pack("<BQQ", opcode, start + len(summary), len(group))
            offsets += _record(SUMMARY_OFFSET, place)
            summary += group
        offset_start = start + len(summary)
        footer = RECORD.pack(FOOTER, FOOTER_BODY.size) + struct.pack("<QQ", start, offset_start)
        crc = zlib.crc32(summary + offsets + footer)
        return end + summary + offsets + footer + struct.pack("<I", crc) + MAGIC

    def _statistics(self) -> bytes:
        times = [log_time for log_time, *_ in _ENTRY.iter_unpack(self._index)]
        counts = b"".join(struct.pack("<HQ", t, n) for t, n in self._counts.items() if n)
        body = struct.pack(
            "<QHIIIIQQI", len(times), len(Topic), len(Topic), 0, 0, len(times),
            min(times), max(times), len(counts),
        )  # fmt: skip
        return _record(STATISTICS, body + counts)

    def _chunks(self) -> bytes:
        return b"".join(
            _record(CHUNK_INDEX, _chunk_index(*entry)) for entry in _ENTRY.iter_unpack(self._index)
        )


def _chunk_index(log_time: int, at: int, size: int, topic: int) -> bytes:
    length = CHUNK_HEAD.size + size
    index_length = RECORD.size + struct.calcsize("<HIQQ")
    return (
        struct.pack("<QQQQ", log_time, log_time, at, length)
        + struct.pack("<IHQ", 10, topic, at + length)
        + struct.pack("<QIQQ", index_length, 0, size, size)
    )


def _records(raw: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at < len(raw):
        opcode, length = RECORD.unpack_from(raw, at)
        found.append((opcode, raw[at : at + RECORD.size + length]))
        at += RECORD.size + length
    return found
