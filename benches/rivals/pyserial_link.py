"""The host's side of the link over pyserial, as an expert writes it: chunks, struct, zlib, numpy.

It does what the timed run of sewfast does and no more: greets, sets limits, uploads ahead, arms,
starts, grants credit and decodes every sample. No command is repeated, no port comes back, nothing
stops the motor on an error.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import serial
from numpy.typing import NDArray

_HEAD = struct.Struct("<BHIQ")
HELLO, STATUS, LIMITS, ARM, UPLOAD, START, ECHO = 0x01, 0x03, 0x04, 0x05, 0x08, 0x0A, 0x0B
CREDIT = 0x22
SAMPLES, FINISHED, SESSION = 0xC0, 4, 12345
WATCHDOG_US, LEAD_US, PER_FRAME = 250_000, 200_000, 113
SETTLED_US = 150_000


def _stuffed(data: bytes) -> bytes:
    return b"".join(bytes((len(run) + 1,)) + run for run in data.split(b"\0")) + b"\0"


def _unstuffed(block: bytes) -> bytes:
    out, at = [], 0
    while at < len(block):
        out.append(block[at + 1 : at + block[at]])
        at += block[at]
    return b"\0".join(out)


class Host:
    """A session on an open port."""

    def __init__(self, path: str) -> None:
        self.port = serial.Serial(path, 115_200, timeout=0.001, exclusive=True)
        self.tag = self.sequence = self.beats = self.newest = 0
        self.rest = b""
        self.batches: list[tuple[int, bytes]] = []
        self.replies: dict[int, bytes] = {}
        self.finished = False
        self._send(HELLO, 0, struct.pack("<BBI", 3, 3, SESSION))
        while 0 not in self.replies:
            self.hear()
        _, boot = struct.unpack_from("<BI", self.replies[0])
        self.key = self.replies[0][-4:]
        self.capacity = struct.unpack_from("<I", self.replies[0], 19)[0]
        self.tag = boot & 0xFFFF

    def _send(self, kind: int, sequence: int, body: bytes) -> None:
        frame = _HEAD.pack(kind, self.tag, sequence, SESSION << 32) + body
        self.port.write(_stuffed(frame + struct.pack("<I", zlib.crc32(frame))))

    def begin(self, kind: int, body: bytes) -> int:
        self.sequence += 1
        self._send(kind, self.sequence, body)
        return self.sequence

    def ask(self, kind: int, body: bytes) -> bytes:
        sequence = self.begin(kind, body)
        while sequence not in self.replies:
            self.hear()
        return self.replies.pop(sequence)

    def grant(self, until: int) -> None:
        self.beats += 1
        self._send(CREDIT, self.beats, struct.pack("<IQ", WATCHDOG_US, until))

    def hear(self) -> None:
        data = self.port.read(1)
        self.port.timeout = 0
        data += self.port.read(65536)
        self.port.timeout = 0.001
        *blocks, self.rest = (self.rest + data).split(b"\0")
        for block in blocks:
            frame = _unstuffed(block)
            if len(frame) < 19 or zlib.crc32(frame[:-4]) != int.from_bytes(frame[-4:], "little"):
                continue
            kind, _, _, time_us = _HEAD.unpack_from(frame)
            self.newest = max(self.newest, time_us)
            if kind == SAMPLES:
                self.batches.append((time_us, frame[15:-4]))
            elif kind == 0xC1:
                self.finished = self.finished or frame[15] == FINISHED
            elif kind < SAMPLES:
                (sequence,) = struct.unpack_from("<I", frame, 15)
                if frame[19]:
                    raise OSError(f"refused: {frame[19]}")
                self.replies[sequence] = frame[20:-4]

    def run(self, u: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Times [us], counts and commands of a run."""
        steps = np.rint(u * 1000).astype("<i2").tobytes()
        n, end, taken = len(u), 0, 0
        self.batches, self.finished = [], False
        while end < min(n, self.capacity - PER_FRAME):
            end = self._uploaded(self.ask(UPLOAD, self._piece(steps, end)))
        self.ask(ARM, struct.pack("<I", WATCHDOG_US) + self.key)
        body = struct.pack("<BIQIHB", 0, WATCHDOG_US, 0, n, 0b11, 10)
        _, start = struct.unpack("<IQ", self.ask(START, body))
        upload = None
        while not self.finished:
            if upload is None and end < n and end + PER_FRAME <= self.capacity + taken:
                upload = self.begin(UPLOAD, self._piece(steps, end))
            until = self.newest + LEAD_US
            self.grant(until if end == n else min(until, start + (end - 1) * 1000))
            self.hear()
            if upload in self.replies:
                end, upload = self._uploaded(self.replies.pop(upload)), None
            if self.batches:
                at, body = self.batches[-1]
                taken = (at - start) // 1000 + (len(body) - 3) // 4
                self.newest = max(self.newest, start + 1000 * (taken - 1))
        return self._columns()

    def _columns(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        times, counts, commands = [], [], []
        for at, body in self.batches:
            k = (len(body) - 3) // 4
            first = int.from_bytes(body[1:5], "little", signed=True)
            steps = np.frombuffer(body, "<i2", 2 * k - 1, 5)
            times.append(at + 1000 * np.arange(k))
            counts.append(first + np.concatenate([[0], np.cumsum(steps[: k - 1])]))
            commands.append(steps[k - 1 :] * 1e-3)
        return np.concatenate(times), np.concatenate(counts), np.concatenate(commands)

    @staticmethod
    def _piece(steps: bytes, end: int) -> bytes:
        return struct.pack("<BI", 0, end) + steps[2 * end : 2 * (end + PER_FRAME)]

    @staticmethod
    def _uploaded(reply: bytes) -> int:
        return int(struct.unpack_from("<I", reply)[0])

    def echo(self, data: bytes) -> bytes:
        return self.ask(ECHO, data)

    def set_limits(self) -> None:
        """Once the device has booted and seen its motor stand, for which it needs time."""
        while self.newest < SETTLED_US:
            self.grant(SETTLED_US)
            self.ask(STATUS, b"")
        self.ask(LIMITS, struct.pack("<4f", 20.0, *[float("inf")] * 3))

    def close(self) -> None:
        self.port.close()
