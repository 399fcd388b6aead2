"""A scripted device to test the host with: pure Python after docs/PROTOCOL.md, pty or socket.

It shares no code with the package. Its motor is ideal: the counts are the sum of the commands.
"""

from __future__ import annotations

import os
import pty
import select
import socket
import struct
import sys
import threading
import time
import tty
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "golden"))

import link_frames as golden

HELLO, DESCRIBE, STATUS, LIMITS, ARM, STOP, CLEAR, UPLOAD, GAINS, START, ECHO = range(1, 12)
KEEP, DRIVE, CREDIT = 0x20, 0x21, 0x22
BOOT, IDLE, ARMED, RUNNING, TRIPPED = range(5)
KEY = 0xC0FFEE11
PERIOD = 1000
CEILINGS = (20.0, 5000.0, 1e6, 10.0)


def text(value: str) -> bytes:
    return bytes([len(value.encode())]) + value.encode()


CHANNELS = [
    bytes([0, 0]) + struct.pack("<I", 1) + text("counts") + text(""),
    bytes([1, 1]) + struct.pack("<I", 1000) + text("u") + text("V"),
    bytes([2, 2]) + struct.pack("<I", 1) + text("r") + text("RPM"),
    bytes([3, 2]) + struct.pack("<I", 1) + text("feedback") + text("RPM"),
    bytes([4, 2]) + struct.pack("<I", 1) + text("speed_true") + text("RPM"),
]
ENCODINGS = [0, 1, 2, 2, 2]


class Wire:
    """The device's end of a port; `plug` gives the host something to open."""

    def __init__(self, kind: str, folder: Path) -> None:
        self.kind, self._folder = kind, folder
        self._peer: socket.socket | None = None
        self._master = -1
        if kind == "tcp":
            self._listener = socket.create_server(("127.0.0.1", 0))
            self._listener.setblocking(False)
            self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        else:
            self.url = str(folder / "port")
            self.plug()

    def plug(self) -> None:
        if self.kind == "pty":
            self._master, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(self._master, False)
            link = Path(self.url)
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(slave))
            # held open, so that the host may close its end without a hang-up of ours
            self._slave = slave

    def unplug(self) -> None:
        if self.kind == "tcp":
            if self._peer is not None:
                self._peer.close()
                self._peer = None
        elif self._master >= 0:
            Path(self.url).unlink(missing_ok=True)
            os.close(self._slave)
            os.close(self._master)
            self._master = -1

    def close(self) -> None:
        self.unplug()
        if self.kind == "tcp":
            self._listener.close()

    def read(self, wait: float) -> bytes:
        try:
            if self.kind == "tcp":
                return self._receive(wait)
            if self._master >= 0 and select.select((self._master,), (), (), wait)[0]:
                return os.read(self._master, 65536)
        except OSError:
            return b""
        if self._master < 0:
            time.sleep(wait)
        return b""

    def _receive(self, wait: float) -> bytes:
        watched = self._peer or self._listener
        if not select.select((watched,), (), (), wait)[0]:
            return b""
        if self._peer is None:
            self._peer = self._listener.accept()[0]
            return b""
        data = self._peer.recv(65536)
        if not data:
            self._peer.close()
            self._peer = None
        return data

    def write(self, data: bytes) -> None:
        try:
            if self.kind == "tcp" and self._peer is not None:
                self._peer.sendall(data)
            elif self._master >= 0:
                os.write(self._master, data)
        except OSError:
            pass


class ScriptedDevice(threading.Thread):
    """Serves the protocol in real time; what a test wants otherwise it sets beforehand.

    `intercept(frame) -> bool` sees every command; True swallows it. `mangle(kind, wire) -> list of
    bytes` sees every frame that goes out and says what is sent instead.
    """

    def __init__(
        self, folder: Path | None, kind: str = "pty", clock: Any = time, **settings: object
    ) -> None:
        super().__init__(daemon=True)
        if folder is not None:
            self.wire = Wire(kind, folder)
        self._monotonic: Callable[[], float] = clock.monotonic
        self.boot = 0x0001BEEF
        self.channels = 5
        self.capacity = 512
        self.capabilities = 0b100111
        self.schema: int | None = None
        self.hello_result = b"\0"
        self.intercept: Callable[[tuple[int, int, int, int, bytes]], bool] = lambda frame: False
        self.mangle: Callable[[int, bytes], list[bytes]] = lambda kind, wire: [wire]
        self.executed: list[tuple[int, bytes]] = []
        self.arrived: list[tuple[float, int]] = []
        self.heartbeats = self.foreign = 0
        self.creeping = 0
        """So many ARMs find the motor moving, whatever STATUS says."""
        self.limits = (0.0,) * 4
        self.state, self.reason, self.run_number = IDLE, 0, 0
        self.problem: BaseException | None = None
        for name, value in settings.items():
            assert hasattr(self, name), name
            setattr(self, name, value)
        self._began = self._monotonic()
        self._sequence = 0
        self._session = 0
        self._last: tuple[int, bytes] | None = None
        self._profile: list[float] = []
        self._table = 0
        self._at = self._taken = self._length = self._mask = self._batch = self._mode = 0
        self._counts = 0
        self._fed = 0.0
        self._watchdog = 1.0
        self._rows: list[tuple[float, ...]] = []
        self._first_us = 0
        self._done = threading.Event()
        self._todo: list[Callable[[], None]] = []
        self._lock = threading.Lock()

    @property
    def url(self) -> str:
        return self.wire.url

    def __enter__(self) -> ScriptedDevice:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self.join()
        self.wire.close()
        if self.problem is not None:
            raise self.problem

    def do(self, action: Callable[[], None]) -> None:
        """Have the device do something, on its own thread where it has one."""
        with self._lock:
            self._todo.append(action)

    def run(self) -> None:
        try:
            pending = b""
            while not self._done.is_set():
                self.act()
                pending = self.hear(pending + self.wire.read(0.001))
                self.advance()
        except BaseException as error:
            self.problem = error

    def act(self) -> None:
        """Do what it was told to."""
        with self._lock:
            todo, self._todo = self._todo, []
        for action in todo:
            action()

    def hear(self, data: bytes) -> bytes:
        """Take the whole frames of `data`; what is left of it."""
        *blocks, rest = data.split(b"\0")
        for frame in golden.frames(b"".join(b + b"\0" for b in blocks)):
            self._take(frame)
        return rest

    # --- time -------------------------------------------------------------------------------------

    @property
    def now_us(self) -> int:
        return int((self._monotonic() - self._began) * 1e6)

    def reset(self) -> None:
        """As after a loss of supply."""
        self.boot += 1
        self._began, self._sequence, self._session, self._last = self._monotonic(), 0, 0, None
        self.limits, self.state, self.reason = (0.0,) * 4, IDLE, 0
        self.event(1)

    def trip(self, reason: int, value: float = 0.0) -> None:
        self._flush()
        self.state, self.reason = TRIPPED, reason
        self.event(6, value)

    def advance(self) -> None:
        if self.state in (ARMED, RUNNING) and self._monotonic() - self._fed > self._watchdog:
            if self.state == RUNNING:
                self.trip(1)
            else:
                self.state = IDLE
        while self.state == RUNNING and self._at + self._taken * PERIOD <= self.now_us:
            self._sample()

    def _sample(self) -> None:
        k = self._taken
        if k == self._length:
            self._flush()
            self.state = IDLE
            return self.event(4)
        if self._mode < 2 and k >= len(self._profile):
            return self.trip(5)
        value = self._profile[k] if self._mode < 2 else self._drive
        u = value if self._table == 0 or self._mode == 2 else 0.0
        r = 0.0 if self._table == 0 else value
        if not self._rows:
            self._first_us = self._at + k * PERIOD
        row = (self._counts, round(u * 1000), r, 0.5, 10.0 * u)
        self._rows.append(tuple(v for i, v in enumerate(row) if self._mask >> i & 1))
        self._counts += round(u)
        self._taken += 1
        if len(self._rows) == self._batch:
            self._flush()
        return None

    def _flush(self) -> None:
        if self._rows:
            used = [e for i, e in enumerate(ENCODINGS) if self._mask >> i & 1]
            body = golden.samples_body(0, used, self._rows)
            self._rows = []
            self.send(0xC0, body, self._first_us)

    def send(self, kind: int, body: bytes, at: int | None = None) -> None:
        tag = self.boot & 0xFFFF
        time_us = self.now_us if at is None else at
        frame = golden.wire(kind, tag, self._sequence, time_us, body)
        self._sequence += 1
        for part in self.mangle(kind, frame):
            self.wire.write(part)

    def event(self, code: int, value: float = 0.0) -> None:
        head = bytes([code, self.state, self.reason])
        self.send(0xC1, head + struct.pack("<IIf", self.run_number, self._taken, value))

    # --- commands ---------------------------------------------------------------------------------

    def _take(self, frame: tuple[int, int, int, int, bytes]) -> None:
        kind, tag, sequence, told, body = frame
        self.arrived.append((self._monotonic(), kind))
        if self.intercept(frame):
            return
        own = told >> 32 == self._session
        if kind == HELLO:
            self._hello(body)
        elif not self._session or not (own or kind == STOP):
            self.foreign += 1
        elif kind >= KEEP:
            self._heartbeat(kind, tag, body)
        elif tag != self.boot & 0xFFFF:
            self._reply(kind, sequence, b"\5" + struct.pack("<I", tag))
        elif not own:
            self._reply(kind, sequence, self._execute(kind, body))
        elif self._last is None or sequence > self._last[0]:
            self.executed.append((kind, body))
            answer = self._execute(kind, body)
            self._last = (sequence, answer)
            self._reply(kind, sequence, answer)
        elif sequence == self._last[0]:
            self._reply(kind, sequence, self._last[1])

    def _reply(self, kind: int, sequence: int, answer: bytes) -> None:
        self.send(0x80 + kind, struct.pack("<I", sequence) + answer)

    def _heartbeat(self, kind: int, tag: int, body: bytes) -> None:
        if tag == self.boot & 0xFFFF:
            self._fed = self._monotonic()
            self.heartbeats += 1
            if kind == DRIVE:
                self._drive = struct.unpack("<If", body)[1]

    def _hello(self, body: bytes) -> None:
        session: int = struct.unpack("<BBI", body)[2]
        if session != self._session:
            self._session, self._last, self.limits = session, None, (0.0,) * 4
            if self.state == RUNNING:
                self.trip(7)
        schema = zlib.crc32(struct.pack("<BI", 3, PERIOD) + b"".join(CHANNELS[: self.channels]))
        head = struct.pack(
            "<BIIBBIIIf", 3, self.boot, self.schema or schema, self.state, self.channels, PERIOD,
            self.capabilities, self.capacity, 1572.0,
        )  # fmt: skip
        answer = b"\0" + head + text("script") + text("1.0") + struct.pack("<II", session, KEY)
        if self.hello_result != b"\0":
            answer = self.hello_result
        self._reply(HELLO, 0, answer)

    def _execute(self, kind: int, body: bytes) -> bytes:
        refuse = b"\4" + struct.pack("<I", self.state)
        if kind == DESCRIBE:
            return b"\0" + CHANNELS[body[0]]
        if kind == STATUS:
            return b"\0" + self._status()
        if kind == LIMITS:
            values = struct.unpack("<4f", body)
            self.limits = values if any(values) else self.limits
            return b"\0" + struct.pack("<8f", *self.limits, *CEILINGS)
        if kind == ARM:
            return self._arm(body) if self.state == IDLE else refuse
        if kind == STOP:
            return self._stop()
        if kind == CLEAR:
            self.state = IDLE
            return b"\0"
        if kind == UPLOAD:
            return self._upload(body)
        if kind == START:
            return self._start(body) if self.state == ARMED else refuse
        if kind == ECHO:
            return b"\0" + body
        return b"\0" if kind == GAINS else b"\1" + struct.pack("<I", kind)

    def _status(self) -> bytes:
        return struct.pack(
            "<BBBHIQIIIfiIIIIII", self.state, self.reason, self._mode, self._mask, self.run_number,
            self._at, self._taken, self._length, len(self._profile), 0.0, self._counts, 0, 0, 0, 0,
            self._session, self.foreign,
        )  # fmt: skip

    def _arm(self, body: bytes) -> bytes:
        if not any(self.limits):
            return b"\x0c" + bytes(4)
        watchdog, key = struct.unpack("<II", body)
        if key != KEY:
            return b"\x0d" + bytes(4)
        if self.creeping:
            self.creeping -= 1
            return b"\x0b" + bytes(4)
        self._watchdog = watchdog * 1e-6
        self._fed = self._monotonic()
        self.state = ARMED
        return b"\0"

    def _stop(self) -> bytes:
        if self.state in (ARMED, RUNNING):
            self._flush()
            self.state = IDLE
            self.event(5)
        return b"\0" + bytes([self.state])

    def _upload(self, body: bytes) -> bytes:
        table, offset = struct.unpack_from("<BI", body)
        code, scale = ("h", 1e-3) if table == 0 else ("f", 1.0)
        size = struct.calcsize(code)
        values = [scale * v for v in struct.unpack(f"<{(len(body) - 5) // size}{code}", body[5:])]
        if offset == 0 and self.state != RUNNING:
            self._profile, self._table = [], table
            self._taken = 0 if self.state != RUNNING else self._taken
        if offset > len(self._profile):
            return b"\x09" + struct.pack("<I", len(self._profile))
        played = self._taken if self.state == RUNNING else 0
        room = self.capacity + played - len(self._profile)
        fresh = values[len(self._profile) - offset :]
        if len(fresh) > room:
            return b"\x07" + struct.pack("<I", room)
        self._profile += fresh
        return b"\0" + struct.pack("<II", len(self._profile), room - len(fresh))

    def _start(self, body: bytes) -> bytes:
        self._mode, watchdog, _, self._length, self._mask, self._batch = struct.unpack(
            "<BIQIHB", body
        )
        self._watchdog = watchdog * 1e-6
        self._fed = self._monotonic()
        self._drive = 0.0
        self.run_number += 1
        self._taken, self._rows = 0, []
        self._at = self.now_us + PERIOD
        self.state = RUNNING
        self.event(3)
        return b"\0" + struct.pack("<IQ", self.run_number, self._at)
