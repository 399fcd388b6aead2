"""The whole chunks of an MCAP file, and what between them is damaged.

Nothing is believed that no checksum covers: a chunk is searched for, not reached by the lengths of
the records before it. Its own head states its size three times, and its CRC-32 covers the rest.
The search has a budget: a file that is made of heads alone would cost a checksum of megabytes each.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from ..errors import DataError
from .container import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    FOOTER_BODY,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    Message,
)
from .topics import Topic

LARGEST_CHUNK = 4 << 20
"""Bytes; a recording's own chunks are far smaller."""
BUDGET = 4
"""Checksums that fail may cover so many times the file; each damaged chunk is covered by one."""


class Chunk(NamedTuple):
    """A chunk whose CRC holds: its place in the file and its messages."""

    start: int
    stop: int
    messages: tuple[Message, ...]


def chunks(raw: bytes) -> Iterator[Chunk]:
    """Every chunk that is whole, in the file's order.

    Raises
    ------
    DataError
        For a file of so many heads without their chunks that no damage explains them.
    """
    at, left = 0, BUDGET * len(raw) + LARGEST_CHUNK
    while (at := raw.find(CHUNK.to_bytes(1, "little"), at)) >= 0:
        size = _claimed(raw, at)
        chunk = None if size is None else _chunk_at(raw, at, size)
        if chunk is not None:
            yield chunk
        elif size is not None:
            left -= size
            if left < 0:
                raise DataError(
                    "expected heads of chunks with their chunks, received "
                    f"{at} bytes with heads alone; the file is no recording that was damaged"
                )
        at = at + 1 if chunk is None else chunk.stop


def _claimed(raw: bytes, at: int) -> int | None:
    """The size that a head states; None where there is no head."""
    if at + CHUNK_HEAD.size > len(raw):
        return None
    _, length, _, _, size, _, compression, stored = CHUNK_HEAD.unpack_from(raw, at)
    stop = at + CHUNK_HEAD.size + size
    if compression != 0 or stored != size or length != CHUNK_HEAD.size - RECORD.size + size:
        return None
    if size > LARGEST_CHUNK or stop > len(raw):
        return None
    return int(size)


def _chunk_at(raw: bytes, at: int, size: int) -> Chunk | None:
    stop = at + CHUNK_HEAD.size + size
    if (
        zlib.crc32(memoryview(raw)[at + CHUNK_HEAD.size : stop])
        != CHUNK_HEAD.unpack_from(raw, at)[5]
    ):
        return None
    body = raw[at + CHUNK_HEAD.size : stop]
    messages = _messages(body)
    return None if messages is None else Chunk(at, stop, messages)


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
    """Opcode, begin and end of each record's content; opcode -1 where they do not fit."""
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
    """Whether the bytes before the first chunk are what a file begins with."""
    opcodes = [r[0] for r in records(raw, len(MAGIC), stop)]
    return raw.startswith(MAGIC) and opcodes == [HEADER]


def is_index(raw: bytes, start: int, stop: int) -> bool:
    """Whether the bytes between two chunks are nothing but a message index."""
    for opcode, begin, end in records(raw, start, stop):
        size = end - begin
        if opcode != MESSAGE_INDEX or size < 6 or size != 6 + _u32(raw, begin + 2):
            return False
    return True


def ending_fault(raw: bytes, start: int, *, damaged: bool) -> str | None:
    """What is wrong behind the last chunk; None where the checksums of the whole file hold.

    In a file known to be `damaged` the checksum over all of it says nothing new.
    """
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
