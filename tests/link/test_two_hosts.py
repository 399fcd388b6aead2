"""What a replaced host has said, and a line has kept, does nothing in the next session."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import pytest

import raw_host as raw
from raw_host import RawHost
from sewfast.link import VirtualDevice, wire
from sewfast.link.doctor import _counters

OLD, NEW = 11, 12
AHEAD = 1_000_000
"""What the replaced host has counted up to, far beyond the new one."""
STOPPED = 5


@pytest.fixture(params=["pty", "tcp"])
def device(request: pytest.FixtureRequest) -> Iterator[VirtualDevice]:
    if request.param == "pty" and os.name != "posix":
        pytest.skip("needs pseudo-terminals")
    with VirtualDevice(endpoint=request.param) as served:
        yield served


class TwoHosts(RawHost):
    """The new host on a line that also brings frames of the old one."""

    def __init__(self, port: str) -> None:
        super().__init__(port, session=OLD)
        self.hello()
        self.settle()
        self._old_beats = AHEAD
        self.session = NEW

    def stale(self, kind: int, body: bytes = b"", number: int | None = None) -> None:
        self._old_beats += 1
        number = self._old_beats if number is None else number
        told = raw.golden.host_time(OLD, time.monotonic_ns() // 1000)
        self.write(raw.golden.wire(kind, self.tag, number, told, body))

    def foreign(self) -> int:
        return int.from_bytes(self.command(raw.STATUS)[-4:], "little")


def test_stale_frames_neither_feed_the_watchdog_nor_drive(device: VirtualDevice) -> None:
    with TwoHosts(device.port) as host:
        host.turn(200_000)
        before, sent = host.foreign(), 0
        deadline = time.monotonic() + raw.PATIENCE
        while not (trips := [f for f in host.frames if f[0] == raw.EVENT and f[4][0] == 6]):
            assert time.monotonic() < deadline, "stale frames have fed the watchdog"
            host.stale(raw.DRIVE, struct.pack("<If", 200_000, 9.0))
            host.stale(raw.KEEP, struct.pack("<I", 200_000))
            sent += 2
            host.read(0.005)
        assert trips[0][4][2] == 1
        assert sent > 0
        assert {u for _, _, u in raw.counts_and_u(host.frames)} <= {0, 2000}
        assert host.foreign() == before + sent


def test_the_new_host_is_heard_after_higher_numbers(device: VirtualDevice) -> None:
    with TwoHosts(device.port) as host:
        host.turn(10_000_000)
        deadline = time.monotonic() + raw.PATIENCE
        while not any(u == 3000 for _, _, u in raw.counts_and_u(host.frames)):
            assert time.monotonic() < deadline, "the new host is not heard"
            host.stale(raw.DRIVE, struct.pack("<If", 10_000_000, 9.0))
            host.stale(raw.STATUS)
            host.drive(3.0, watchdog=10_000_000)
            host.read(0.005)
        assert host.state() == raw.RUNNING
        assert all(u <= 3000 for _, _, u in raw.counts_and_u(host.frames))
        host.command(raw.STOP)


@pytest.mark.parametrize("number", [1, AHEAD])
def test_a_stop_of_either_host_is_executed(device: VirtualDevice, number: int) -> None:
    with TwoHosts(device.port) as host:
        host.turn(10_000_000)
        host.stale(raw.STOP, number=number)
        host.wait_for(raw.EVENT, STOPPED)
        assert host.state() == raw.IDLE
        # the same session goes on with its numbers
        host.arm()
        host.start(0, mode=2)
        host.command(raw.STOP)
        assert host.state() == raw.IDLE


def test_limits_of_one_host_are_not_those_of_the_next(device: VirtualDevice) -> None:
    with TwoHosts(device.port) as host:
        host.session = OLD
        host.command(raw.LIMITS, struct.pack("<4f", 5.0, 6000.0, 1e6, 50.0))
        host.session = NEW
        host.hello()
        host.settle()
        assert struct.unpack("<4f", host.command(raw.LIMITS, bytes(16))[:16]) == (0.0,) * 4
        result, _ = host.ask(raw.ARM, host.arming(50_000))
        assert result == 12


def test_the_doctor_names_another_host_that_talks_meanwhile() -> None:
    drive = SimpleNamespace(identity=SimpleNamespace(period_us=1000))
    empty = wire.Status("idle", "none", 0, 0, 0, 0, 0, 0, 0, 0.0, 0, 0, 0, 0, 0, NEW, 0)
    earlier, now = (replace(empty, foreign=n) for n in (5, 6))
    assert _counters(earlier, earlier, drive).verdict == "ok"  # type: ignore[arg-type]
    found = _counters(now, earlier, drive)  # type: ignore[arg-type]
    assert (found.verdict, "another host" in found.remedy) == ("warn", True)
