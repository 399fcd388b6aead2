"""A host over bare file descriptors, after docs/PROTOCOL.md; it shares no code with ours."""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "golden"))

import link_frames as golden

HELLO, DESCRIBE, STATUS, LIMITS, ARM, STOP, CLEAR, UPLOAD, GAINS, START, ECHO = range(1, 12)
KEEP, DRIVE, CREDIT = 0x20, 0x21, 0x22
SAMPLES, EVENT, BEAT = 0xC0, 0xC1, 0xC2
BOOT, IDLE, ARMED, RUNNING, TRIPPED = range(5)
FINISHED, TRIP_EVENT = 4, 6
WATCHDOG = 50_000
PATIENCE = 60.0
"""Long enough for any machine; reached only where something is wrong [s]."""


class Silent(Exception):
    """The device did not answer, or the port is gone."""


class RawHost:
    """Opens a port, speaks frames; keeps every frame that came in `frames`."""

    def __init__(self, port: str, session: int = 77) -> None:
        self._fd, self._socket = _opened(port)
        self._rest = b""
        self._count = {False: 0, True: 0}
        self.frames: list[golden.Frame] = []
        self.tag = self.key = 0
        self.session = session
        self.repeat = 0.5

    def reopen(self, port: str) -> None:
        """Go on with the session on a port that was away."""
        self.close()
        self._fd, self._socket = _opened(port)
        self._rest = b""
        self.hello_again()

    def hello_again(self) -> bytes:
        """HELLO of the session, which keeps its sequences where it is in force."""
        reply = self.command(HELLO, struct.pack("<BBI", 3, 3, self.session))
        session, self.key = struct.unpack("<II", reply[-8:])
        assert session == self.session
        return reply

    def hello(self) -> bytes:
        reply = self.hello_again()
        self.boot = struct.unpack_from("<I", reply, 1)[0]
        self.tag = self.boot & 0xFFFF
        self._count = {False: 0, True: 0}
        return reply

    def frame(self, kind: int, body: bytes) -> tuple[int, bytes]:
        beat = kind >= KEEP
        if kind != HELLO:
            self._count[beat] += 1
        sequence = 0 if kind == HELLO else self._count[beat]
        tag, session = (0, 0) if kind == HELLO else (self.tag, self.session)
        told = golden.host_time(session, time.monotonic_ns() // 1000)
        return sequence, golden.wire(kind, tag, sequence, told, body)

    def send(self, kind: int, body: bytes = b"") -> int:
        sequence, frame = self.frame(kind, body)
        self.write(frame)
        return sequence

    def write(self, data: bytes) -> None:
        while data:
            if not select.select([], [self._fd], [], PATIENCE)[1]:
                raise Silent("no room for bytes to the device")
            data = data[os.write(self._fd, data) :]

    def read(self, wait: float) -> list[golden.Frame]:
        """The frames that come within `wait` seconds, as soon as there is any byte."""
        if not select.select([self._fd], [], [], wait)[0]:
            return []
        try:
            data = os.read(self._fd, 65536)
        except OSError as e:
            raise Silent(str(e)) from e
        if not data:
            raise Silent("closed")
        blocks, end, self._rest = (self._rest + data).rpartition(b"\0")
        new = list(golden.frames(blocks + end))
        self.frames += new
        return new

    def command(self, kind: int, body: bytes = b"", *, expect: int = 0) -> bytes:
        """Send a command and wait for its reply, repeating it; what stands behind the result."""
        result, rest = self.ask(kind, body)
        assert result == expect, (hex(kind), result, rest.hex())
        return rest

    def ask(self, kind: int, body: bytes = b"") -> tuple[int, bytes]:
        """As `command`, with the result."""
        sequence, frame = self.frame(kind, body)
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            self.write(frame)
            for reply in self._until(self.repeat, lambda f: f[0] == 0x80 | kind):
                number, result = struct.unpack_from("<IB", reply[4])
                if number == sequence:
                    return result, reply[4][5:]
        raise Silent(f"no reply to {kind:#x}")

    def wait_for(self, kind: int, code: int | None = None) -> golden.Frame:
        """The next frame of a kind; of an event, of a code."""
        for found in self._until(
            PATIENCE, lambda f: f[0] == kind and (code is None or f[4][0] == code)
        ):
            return found
        raise Silent(f"no frame {kind:#x}")

    def _until(self, seconds: float, wanted) -> list[golden.Frame]:
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            found = [frame for frame in self.read(left) if wanted(frame)]
            if found:
                return found
        return []

    def running(self) -> None:
        """Wait until the run has begun."""
        self.settle(RUNNING)

    def state(self) -> int:
        return self.command(STATUS)[0]

    def settle(self, state: int = IDLE) -> None:
        """Wait until the device is in a state."""
        while self.state() != state:
            pass

    def arming(self, watchdog: int = WATCHDOG) -> bytes:
        """The body of ARM."""
        return struct.pack("<II", watchdog, self.key)

    def arm(self, *, watchdog: int = WATCHDOG) -> None:
        self.command(LIMITS, struct.pack("<4f", 20.0, 6000.0, 1e6, 50.0))
        # a motor is known to stand still after 100 ms of it
        while (answer := self.ask(ARM, self.arming(watchdog)))[0] == 11:
            time.sleep(0.01)
        assert answer[0] == 0, answer

    def upload(self, commands: list[int], offset: int = 0) -> tuple[int, int]:
        body = struct.pack(f"<BI{len(commands)}h", 0, offset, *commands)
        end, room = struct.unpack("<II", self.command(UPLOAD, body))
        return end, room

    def start(
        self,
        length: int,
        *,
        mode: int = 0,
        mask: int = 3,
        batch: int = 10,
        watchdog: int = WATCHDOG,
    ) -> int:
        body = struct.pack("<BIQIHB", mode, watchdog, 0, length, mask, batch)
        return struct.unpack("<IQ", self.command(START, body))[1]

    def keep(self, *, watchdog: int = WATCHDOG) -> None:
        self.send(KEEP, struct.pack("<I", watchdog))

    def drive(self, u: float, *, watchdog: int = WATCHDOG) -> None:
        self.send(DRIVE, struct.pack("<If", watchdog, u))

    def turn(self, watchdog: int) -> None:
        """From anywhere to a motor that turns at 2 V."""
        self.hello()
        if self.state() == TRIPPED:
            self.command(CLEAR)
        self.settle()
        self.arm(watchdog=10_000_000)
        self.start(0, mode=2, watchdog=10_000_000)
        self.running()
        self.drive(2.0, watchdog=watchdog)
        # its reply says that the shorter time is in force
        self.state()

    def credit(self, until: int, *, watchdog: int = WATCHDOG) -> None:
        self.send(CREDIT, struct.pack("<IQ", watchdog, until))

    def fileno(self) -> int:
        return self._fd

    def close(self) -> None:
        if self._fd < 0:
            return
        if self._socket is not None:
            self._socket.close()
        else:
            os.close(self._fd)
        self._fd = -1

    def __enter__(self) -> RawHost:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def drive_forever(port: str) -> None:
    """Turn the motor until killed, telling the device every 5 ms; says when it turns."""
    with RawHost(port, session=os.getpid()) as host:
        host.turn(WATCHDOG)
        print("running", flush=True)
        while True:
            host.drive(2.0)
            host.read(0.005)


def _opened(port: str) -> tuple[int, socket.socket | None]:
    if port.startswith("socket://"):
        host, _, number = port.removeprefix("socket://").rpartition(":")
        connection = socket.create_connection((host, int(number)), timeout=PATIENCE)
        return connection.fileno(), connection
    return os.open(port, os.O_RDWR | os.O_NOCTTY), None


def counts_and_u(frames: list[golden.Frame]) -> list[tuple[int, int, int]]:
    """(time, counts, u in steps) of every sample in frames of channels 0 and 1."""
    rows = []
    for kind, _, _, at, body in frames:
        if kind != SAMPLES:
            continue
        n = (len(body) - 3) // 4
        counts = list(struct.unpack_from("<i", body, 1))
        for difference in struct.unpack_from(f"<{n - 1}h", body, 5):
            counts.append(counts[-1] + difference)
        u = struct.unpack_from(f"<{n}h", body, 3 + 2 * n)
        rows += [(at + 1000 * k, c, v) for k, (c, v) in enumerate(zip(counts, u, strict=True))]
    return rows


if __name__ == "__main__":
    drive_forever(sys.argv[1])
