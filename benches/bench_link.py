"""The link through a pty on credit: samples a second, round trip of ECHO, beside plain pyserial."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rivals import pyserial_link
from sewfast.link import Plan, VirtualDevice, connect

SAMPLES = 100_000
COMMANDS = np.round(3.0 + 2.0 * np.sin(2e-3 * np.arange(SAMPLES)), 3)


class Counting:
    """A sink that only counts."""

    def __init__(self) -> None:
        self.received = 0

    def samples(self, first: int, columns: Any) -> None:
        self.received += len(columns["u"])

    def event(self, kind: str, index: int, **detail: object) -> None:
        pass


def _say(benchmark: Any, received: int) -> None:
    assert received == SAMPLES
    rate = SAMPLES / benchmark.stats.stats.min
    benchmark.extra_info["times_real_time"] = round(rate / 1000.0)
    print(f"\n{rate:,.0f} samples a second, {rate / 1000:.0f} times real time")


@pytest.mark.benchmark(group="run")
def test_run_sewfast(benchmark: Any) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0)
        plan = Plan("commands", COMMANDS, columns=())

        def run() -> int:
            sink = Counting()
            drive.stream(plan, sink)
            return sink.received

        received = benchmark.pedantic(run, setup=drive.wait_for_rest, rounds=5)
    _say(benchmark, received)


@pytest.mark.benchmark(group="run")
def test_run_pyserial(benchmark: Any) -> None:
    received = []

    def run(host: pyserial_link.Host) -> None:
        received.append(len(host.run(COMMANDS)[0]))

    def setup() -> tuple[tuple[pyserial_link.Host], dict[str, Any]]:
        device = VirtualDevice(fast=True)
        devices.append(device)
        host = pyserial_link.Host(device.port)
        host.set_limits()
        return (host,), {}

    devices: list[VirtualDevice] = []
    # a rest of its own for each run, as the rival cannot wait for one
    benchmark.pedantic(run, setup=setup, rounds=5)
    for device in devices:
        device.stop()
    _say(benchmark, received[-1])


@pytest.mark.benchmark(group="echo")
def test_echo_sewfast(benchmark: Any) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        benchmark(drive.echo, bytes(40))


@pytest.mark.benchmark(group="echo")
def test_echo_pyserial(benchmark: Any) -> None:
    with VirtualDevice(fast=True) as device:
        host = pyserial_link.Host(device.port)
        benchmark(host.echo, bytes(40))
        host.close()
