"""Boards of other makers, emulated from their firmware's text protocols, and ways to reach them.

`EmulatedODrive` answers as the ASCII protocol of firmware 0.5 does, `EmulatedSimpleFOC` as the
Commander of SimpleFOC 2.3 with `@1`. A motor with inertia, friction and an encoder is behind both.
`Line` is a port to one in simulated time, `on_a_pty` a terminal to one in real time.
"""

from __future__ import annotations

import math
import os
import select
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from sewfast.link import Port

STEP = 0.001


class Motor:
    """`T w' + w = gain (u - friction)` with w in RPM; the encoder shows whole counts."""

    def __init__(self, gain: float, T: float, friction: float, counts_per_rev: float) -> None:
        self.gain, self.T, self.friction, self.cpr = gain, T, friction, counts_per_rev
        self.u = self.rpm = self.turns = self.time = self.now = 0.0
        self.most = 0.0

    def advance(self, now: float) -> None:
        self.now = now
        while self.time + STEP <= now:
            drive = self.u - math.copysign(self.friction, self.rpm)
            if abs(self.rpm) < 0.5:
                drive = math.copysign(max(abs(self.u) - self.friction, 0.0), self.u)
                self.rpm = 0.0 if drive == 0.0 else self.rpm
            self.rpm += STEP / self.T * (self.gain * drive - self.rpm)
            self.turns += STEP * self.rpm / 60.0
            self.most = max(self.most, abs(self.u))
            self.time += STEP

    @property
    def seen(self) -> float:
        turns = self.turns + (self.now - self.time) * self.rpm / 60.0
        return math.floor(turns * self.cpr) / self.cpr


class Emulated:
    """Bytes in, bytes out; `told` has every line that came."""

    def __init__(self, motor: Motor) -> None:
        self.motor, self.out, self.told = motor, b"", list[str]()
        self._rest = b""
        self.silent = False
        self.now = 0.0

    def at(self, now: float) -> None:
        self.now = max(now, self.now)
        self.motor.advance(self.now)

    def feed(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self.told.append(line.decode())
            answer = self.line(line.decode())
            if answer and not self.silent:
                self.out += answer.encode()

    def line(self, text: str) -> str:
        raise NotImplementedError


class EmulatedODrive(Emulated):
    """Axis 0 of an ODrive. Torque [N m] in torque mode; its watchdog and overspeed are its own."""

    def __init__(self, motor: Motor, *, calibrated: bool = True, vel_limit: float = 200.0) -> None:
        super().__init__(motor)
        self.calibrated, self.vel_limit, self.fed = calibrated, vel_limit, 0.0
        self.properties = {
            "fw_version_major": 0.0, "fw_version_minor": 5.0, "axis0.error": 0.0,
            "axis0.current_state": 1.0, "axis0.requested_state": 0.0,
            "axis0.encoder.config.cpr": motor.cpr, "axis0.motor.config.motor_type": 0.0,
            "axis0.controller.config.control_mode": 3.0, "axis0.controller.config.input_mode": 3.0,
            "axis0.config.watchdog_timeout": 0.0, "axis0.config.enable_watchdog": 0.0,
        }  # fmt: skip

    def at(self, now: float) -> None:
        properties = self.properties
        expires = self.fed + properties["axis0.config.watchdog_timeout"]
        if properties["axis0.config.enable_watchdog"] and now > expires:
            super().at(expires)
            self._fail(0x800)
        super().at(now)
        if abs(self.motor.rpm) > 60.0 * self.vel_limit:
            self._fail(0x200)

    def _fail(self, error: int) -> None:
        self.properties["axis0.error"] = float(error)
        self.properties["axis0.current_state"] = 1.0
        self.motor.u = 0.0

    @property
    def drives(self) -> bool:
        return self.properties["axis0.current_state"] == 8.0

    def line(self, text: str) -> str:
        kind, _, rest = text.partition(" ")
        if kind == "r":
            found = self.properties.get(rest)
            return "invalid property\r\n" if found is None else f"{found:g}\r\n"
        if kind == "w":
            return self._written(*rest.split())
        if kind == "f":
            return f"{self.motor.seen:.6f} {self.motor.rpm / 60.0:.6f}\r\n"
        if kind == "c":
            self.fed = self.now
            self.motor.u = float(rest.split()[1]) if self.drives else 0.0
            return ""
        if kind == "u":
            self.fed = self.now
            return ""
        return "unknown command\r\n"

    def _written(self, name: str, value: str) -> str:
        if name not in self.properties:
            return "invalid property\r\n"
        self.properties[name] = float(value)
        if name == "axis0.requested_state":
            wanted = float(value)
            if wanted == 8.0 and not self.calibrated:
                self._fail(0x1)
            elif wanted in (1.0, 8.0):
                self.properties["axis0.current_state"] = wanted
                self.motor.u = 0.0
        return ""


class EmulatedSimpleFOC(Emulated):
    """A sketch with a motor `M`, enabled as after initFOC, and a watchdog `W` of its own."""

    def __init__(self, motor: Motor, *, watchdog: bool = True, resistance: float = 0.0) -> None:
        super().__init__(motor)
        self.enabled, self.limit, self.resistance = True, 6.0, resistance
        self.has_watchdog, self.watchdog_ms, self.heard = watchdog, 0.0, 0.0
        self.target, self.mode, self.torque = 0.0, 1.0, 0.0
        self.telemetry = True

    def at(self, now: float) -> None:
        expires = self.heard + 1e-3 * self.watchdog_ms
        if self.enabled and self.watchdog_ms > 0.0 and now > expires:
            super().at(expires)
            self.enabled, self.motor.u = False, 0.0
        super().at(now)
        if self.telemetry:
            self.out += b"0.0000\t0.0000\t0.0000\r\n"

    def line(self, text: str) -> str:
        answer = self._answer(text)
        drives = self.enabled and self.mode == 0.0
        self.motor.u = max(-self.limit, min(self.limit, self.target)) if drives else 0.0
        return "" if answer is None else f"{answer}\r\n"

    def _answer(self, text: str) -> str | None:
        if text == "?":
            watchdog = "\r\nW:watchdog [ms]" if self.has_watchdog else ""
            return "M:motor" + watchdog
        if text.startswith("@"):
            return "on!"
        if text.startswith("#"):
            return text[1:]
        if text.startswith("W") and self.has_watchdog:
            self.watchdog_ms = float(text[1:]) if text[1:] else self.watchdog_ms
            return f"{self.watchdog_ms:.6f}"
        if not text.startswith("M"):
            return None
        self.heard = self.now
        return self._of_motor(text[1:])

    def _of_motor(self, text: str) -> str:
        if text[:2] == "MD":
            self.telemetry = float(text[2:]) > 0.0
            return f"{float(text[2:]):.0f}"
        if text == "MG6":
            return f"{2.0 * math.pi * self.motor.seen:.6f}"
        if text[:2] == "LU":
            self.limit = float(text[2:]) if text[2:] else self.limit
            return f"{self.limit:.6f}"
        if text == "R":
            return f"{self.resistance:.6f}"
        if text[:1] == "C":
            self.mode = float(text[1:])
            return ("torque", "vel", "angle")[int(self.mode)]
        if text[:1] == "T":
            self.torque = float(text[1:])
            return ("volt", "dc curr", "foc curr")[int(self.torque)]
        if text[:1] == "E":
            self.enabled = bool(float(text[1:])) if text[1:] else self.enabled
            return f"{self.enabled:d}"
        try:
            self.target = float(text)
        except ValueError:
            return "err"
        return f"{self.target:.6f}"


class Line(Port):
    """A port to an emulated board, and the clock of both: nothing waits in real time.

    `pauses` are seconds that the host loses at the times that are their keys.
    """

    form = "in memory"

    def __init__(self, board: Emulated, baud: int = 1_000_000) -> None:
        self.board, self.time, self.closed = board, 0.0, False
        self.pauses: dict[float, float] = {}
        super().__init__("memory", baud)

    def _open(self) -> None: ...

    def monotonic(self) -> float:
        return self.time

    def sleep(self, seconds: float, /) -> None:
        self._pass(seconds)
        for at in [at for at in self.pauses if at <= self.time]:
            self._pass(self.pauses.pop(at))

    def _pass(self, seconds: float) -> None:
        self.time += seconds
        self.board.at(self.time)

    def write(self, data: bytes) -> None:
        self._pass(10.0 * len(data) / self.baud)
        self.board.feed(data)

    def read(self, timeout: float) -> bytes:
        data, self.board.out = self.board.out, b""
        self._pass(10.0 * len(data) / self.baud if data else timeout)
        return data

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self.closed = True


@contextmanager
def on_a_pty(board: Emulated) -> Iterator[str]:
    """A terminal behind which a board runs in real time, in a thread; gives its path."""
    master, slave = os.openpty()
    tty.setraw(slave)
    ended, begun = threading.Event(), time.monotonic()

    def serve() -> None:
        while not ended.is_set():
            ready = select.select([master], [], [], 0.001)[0]
            board.at(time.monotonic() - begun)
            if ready:
                with suppress(OSError):
                    board.feed(os.read(master, 4096))
            data, board.out = board.out, b""
            if data:
                with suppress(OSError):
                    os.write(master, data)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        ended.set()
        thread.join()
        os.close(master)
        os.close(slave)


def odrive(**options: Any) -> EmulatedODrive:
    """8192 counts; 0.2 N m turn it at 1,200 RPM in the end, after a time constant of 0.4 s."""
    return EmulatedODrive(Motor(6000.0, 0.4, 0.005, 8192.0), **options)


def simplefoc(**options: Any) -> EmulatedSimpleFOC:
    """16384 counts, 100 RPM/V, 60 ms."""
    return EmulatedSimpleFOC(Motor(100.0, 0.06, 0.2, 16384.0), **options)
