"""How many times faster than real time the virtual device runs through a pty."""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import raw_host as raw
from raw_host import RawHost
from sewfast._core import LinkReceiver
from sewfast.link import VirtualDevice

SAMPLES = 20_000
PERIOD = 1000
GRANT = 200_000
"""Credit ahead of what has come [us]."""
CHANNELS = {
    "counts and u": (0x03, 10, [(0, 1), (1, 1000)]),
    "and speed_true": (0x23, 10, [(0, 1), (1, 1000), (2, 1)]),
}


def armed(host: RawHost) -> None:
    host.credit(host.frames[-1][3] + 300_000, watchdog=10_000_000)
    host.settle()
    host.command(raw.LIMITS, struct.pack("<4f", 20.0, 6000.0, 1e6, 50.0))
    while host.ask(raw.ARM, host.arming(10_000_000))[0]:
        host.credit(host.frames[-1][3] + 300_000, watchdog=10_000_000)


def run(host: RawHost, mask: int, batch: int, channels: list[tuple[int, int]]) -> None:
    """A run of SAMPLES at 0 V, every sample taken."""
    armed(host)
    start = host.start(SAMPLES, mode=2, mask=mask, batch=batch, watchdog=10_000_000)
    receiver = LinkReceiver()
    receiver.expect(channels, PERIOD)
    got, granted, end = 0, start, start + PERIOD * SAMPLES
    while got < SAMPLES:
        if granted < end and granted - start - PERIOD * got < GRANT // 2:
            granted = min(granted + GRANT, end)
            host.credit(granted, watchdog=10_000_000)
        receiver.feed(os.read(host.fileno(), 65536))
        times, _ = receiver.take()
        got += len(times)


@pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")
@pytest.mark.parametrize("name", CHANNELS)
def test_virtual_device(benchmark: Any, name: str) -> None:
    with VirtualDevice(fast=True) as device, RawHost(device.port) as host:
        host.hello()
        benchmark.pedantic(run, (host, *CHANNELS[name]), rounds=5)
    if benchmark.stats is not None:
        ratio = SAMPLES * PERIOD * 1e-6 / benchmark.stats.stats.median
        benchmark.extra_info["times_real_time"] = round(ratio)
        print(f"\n{name}: {ratio:.0f} x real time")
