"""Reference for the link's frames: plain Python with ``zlib.crc32``, after docs/PROTOCOL.md.

Run as a program it writes ``link_frames.json`` and the same frames as ``link_frames.txt``, a line
each; the tests use its functions on more frames.
"""

from __future__ import annotations

import itertools
import json
import random
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAX_BODY = 231

Frame = tuple[int, int, int, int, bytes]


def stuffed(data: bytes) -> bytes:
    """COBS of up to 254 bytes: the runs between zeros, each after its length plus one."""
    assert len(data) <= 254
    return b"".join(bytes([len(run) + 1]) + run for run in data.split(b"\0"))


def frame(kind: int, tag: int, sequence: int, time: int, body: bytes) -> bytes:
    """Header, body and CRC-32 before stuffing."""
    content = struct.pack("<BHIQ", kind, tag, sequence, time) + body
    return content + struct.pack("<I", zlib.crc32(content))


def host_time(session: int, us: int) -> int:
    """The time field of a host's frame: u32 of its clock, which wraps, then u32 session."""
    return int.from_bytes(struct.pack("<II", us & 0xFFFFFFFF, session), "little")


def wire(kind: int, tag: int, sequence: int, time: int, body: bytes) -> bytes:
    """The frame as it is sent, with its closing zero."""
    return stuffed(frame(kind, tag, sequence, time, body)) + b"\0"


def unstuffed(block: bytes) -> bytes | None:
    """What a stuffed block means; None where its codes do not lead to its end."""
    data, at = b"", 0
    while at < len(block):
        code = block[at]
        if code == 0 or at + code > len(block):
            return None
        data += block[at + 1 : at + code]
        at += code
        if at < len(block):
            data += b"\0"
    return data


def frames(stream: bytes) -> Iterator[Frame]:
    """The whole frames of a stream of bytes; what is damaged is left out."""
    for block in stream.split(b"\0")[:-1]:
        data = unstuffed(block)
        if data is None or not 19 <= len(data) <= 19 + MAX_BODY:
            continue
        if zlib.crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0]:
            yield (*struct.unpack("<BHIQ", data[:15]), data[15:-4])


def samples_body(flags: int, encodings: list[int], rows: list[tuple[float, ...]]) -> bytes:
    """Body of SAMPLES: channel by channel; values are counts (0), steps (1) or numbers (2)."""
    body = bytes([flags])
    for encoding, column in zip(encodings, zip(*rows, strict=True), strict=True):
        if encoding == 0:
            body += struct.pack("<i", column[0])
            body += b"".join(struct.pack("<h", b - a) for a, b in itertools.pairwise(column))
        else:
            body += struct.pack(f"<{len(column)}{'hf'[encoding - 1]}", *column)
    return body


def samples() -> list[dict[str, Any]]:
    """Bodies of SAMPLES with what they mean."""
    cases = [
        ("one sample", 0, [(0, 1), (1, 1000)], [(0, 0)]),
        (
            "counts and u, ten samples",
            0,
            [(0, 1), (1, 1000)],
            [(5 * k, 100 * k) for k in range(10)],
        ),
        ("backwards below zero", 1, [(0, 1), (1, 1000)], [(-30000 * k, -32768) for k in range(4)]),
        (
            "four channels",
            3,
            [(0, 1), (1, 1000), (1, 50), (2, 1)],
            [(2147483600 + 9 * k, -k, 32767, 0.25 * k) for k in range(6)],
        ),
    ]
    return [
        {
            "what": what,
            "flags": flags,
            "channels": channels,
            "rows": rows,
            "body": samples_body(flags, [encoding for encoding, _ in channels], rows).hex(),
        }
        for what, flags, channels, rows in cases
    ]


def feedforward(preview: int, late: float, levels: int, taps: int) -> bytes:
    """Body of FEEDFORWARD: levels of 3 V at 1000 RPM, taps that fall by halves."""
    body = struct.pack("<BfB", preview, late, levels)
    for k in range(levels):
        y = 1000.0 * (k - levels // 2)
        body += struct.pack("<ff", y, 0.003 * y)
    return body + struct.pack(f"<B{taps}f", taps, *(0.5**j for j in range(taps)))


def position(smoothing: int, releases: int, rows: int) -> bytes:
    """Body of POSITION: gain 30, up to 3000 RPM, the last 12 counts at 60 RPM, rates by speed."""
    body = struct.pack("<4f3B", 30.0, 3000.0, 12.0, 60.0, smoothing, releases, rows)
    rates = (
        struct.pack("<3f", 500.0 * k, 9000.0 - 250.0 * k, 1e4 + 250.0 * k) for k in range(rows)
    )
    return body + b"".join(rates)


def catalogue() -> list[tuple[str, Frame]]:
    """Frames that reach every edge of the layout."""
    dice = random.Random(7)
    boot, hello = 0xBEEF, struct.pack("<BBI", 3, 3, 0x12345678)

    def at(us: int) -> int:
        return host_time(0x12345678, us)

    described = [
        ("empty body", (0x06, boot, 1, 0, b"")),
        ("all zero", (0, 0, 0, 0, bytes(4))),
        ("all ones", (0xFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF, b"\xff" * 4)),
        ("HELLO", (0x01, 0, 0, 1_000_000, hello)),
        ("DESCRIBE", (0x02, boot, 2, at(1_010_000), b"\x01")),
        ("ARM for 50 ms", (0x05, boot, 3, at(1_020_000), struct.pack("<II", 50_000, 0x9E3779B9))),
        ("KEEP for 50 ms", (0x20, boot, 4, at(1_030_000), struct.pack("<I", 50_000))),
        ("DRIVE at 1.5", (0x21, boot, 5, at(1_040_000), struct.pack("<If", 50_000, 1.5))),
        ("CREDIT", (0x22, boot, 6, at(1_050_000), struct.pack("<IQ", 50_000, 2**40))),
        ("ECHO of 200 bytes", (0x0B, boot, 7, at(2**32 + 1_060_000), bytes(range(200)))),
        ("FEEDFORWARD of two levels", (0x0E, boot, 8, at(1_070_000), feedforward(8, 0.5, 2, 3))),
        ("FEEDFORWARD in full", (0x0E, boot, 9, at(1_080_000), feedforward(30, 1.0, 8, 16))),
        ("FEEDFORWARD of none", (0x0E, boot, 10, at(1_090_000), feedforward(0, 0.0, 0, 0))),
        ("HELLO of two versions", (0x01, 0, 0, 1_100_000, struct.pack("<BBI", 3, 4, 0x12345678))),
        (
            "UPLOAD of goals",
            (0x08, boot, 11, at(1_110_000), struct.pack("<BI2f", 2, 7, 393.0, -0.5)),
        ),
        ("POSITION of a row", (0x0F, boot, 12, at(1_120_000), position(1, 0, 1))),
        ("POSITION in full", (0x0F, boot, 13, at(1_130_000), position(31, 1, 8))),
        (
            "ANGLE of the next sample",
            (0x10, boot, 14, at(1_140_000), struct.pack("<IfB", 0, 393.0, 0)),
        ),
        (
            "ANGLE the shorter way",
            (0x10, boot, 15, at(1_150_000), struct.pack("<IfB", 777, -0.5, 1)),
        ),
        ("TRAVEL", (0x11, boot, 16, at(1_160_000), struct.pack("<ii", -(2**31), 2**31 - 1))),
        (
            "START of goals",
            (0x0A, boot, 17, at(1_170_000), struct.pack("<BIQIHB", 3, 50_000, 0, 9, 3, 10)),
        ),
        (
            "the longest without a zero",
            (0x0B, 0x0101, 0x01010101, 2**64 // 255, b"\x01" * MAX_BODY),
        ),
        ("the longest with zeros only", (0x0B, 0, 0, 0, bytes(MAX_BODY))),
        ("the longest, zero at its end", (0x0B, 0x0101, 2**31 - 1, 1, b"\x07" * 230 + b"\0")),
        ("first sequence after wrap", (0xC2, 0xFFFF, 0, 2**32, b"")),
    ]
    for case in samples():
        body = bytes.fromhex(case["body"])
        described.append((f"SAMPLES, {case['what']}", (0xC0, boot, 1000, 5_000_000, body)))
    for length in (1, 2, 14, 43, 128, 230):
        content = bytes(dice.choice((0, dice.randrange(256))) for _ in range(length))
        fields = (dice.randrange(256), dice.randrange(2**16), dice.randrange(2**32))
        described.append((f"random, {length} bytes", (*fields, dice.randrange(2**64), content)))
    return described


def document() -> dict[str, Any]:
    """What stands in ``link_frames.json``; times as text, for readers whose numbers are doubles."""
    rows = [
        {
            "what": what,
            "kind": kind,
            "tag": tag,
            "sequence": sequence,
            "time": str(time),
            "body": body.hex(),
            "frame": frame(kind, tag, sequence, time, body).hex(),
            "wire": wire(kind, tag, sequence, time, body).hex(),
        }
        for what, (kind, tag, sequence, time, body) in catalogue()
    ]
    return {"frames": rows, "samples": samples()}


def lines() -> str:
    """What stands in ``link_frames.txt``: no body is a dash."""
    rows = ["# kind tag sequence time body frame wire; written by link_frames.py"]
    names = ("kind", "tag", "sequence", "time", "body", "frame", "wire")
    rows += [" ".join(str(row[name]) or "-" for name in names) for row in document()["frames"]]
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    folder = Path(__file__).parent
    (folder / "link_frames.json").write_text(json.dumps(document(), indent=1) + "\n")
    (folder / "link_frames.txt").write_text(lines())
