"""The scripted device and its host in simulated time on one thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from link_device import ScriptedDevice
from sewfast.errors import LinkError
from sewfast.link import connection, drive, run
from sewfast.link.connection import Connection
from sewfast.link.drive import Drive
from sewfast.link.ports import Port


class Clock(SimpleNamespace):
    """Stands for the module `time` where the host asks for it."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(self.now * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Ideal:
    """The device's end of a port without any wire."""

    def __init__(self) -> None:
        self.out = b""

    def write(self, data: bytes) -> None:
        self.out += data


class SimulatedPort(Port):
    """Bytes to and from the device; waiting lets the time pass, half a millisecond at once."""

    def __init__(self, device: ScriptedDevice, clock: Clock) -> None:
        self._device, self._clock, self._rest = device, clock, b""
        super().__init__("simulated", 115_200)

    def _open(self) -> None:
        pass

    def read(self, timeout: float) -> bytes:
        until = self._clock.now + timeout
        while True:
            self._device.act()
            self._device.advance()
            data, self._device.wire.out = self._device.wire.out, b""
            if data or self._clock.now >= until:
                return data
            self._clock.now += 0.0005

    def write(self, data: bytes) -> None:
        # time also passes for those who never wait
        self._clock.now += 1e-5
        self._rest = self._device.hear(self._rest + data)

    def fileno(self) -> int:
        raise LinkError("it has no descriptor")

    def close(self) -> None:
        pass


@contextmanager
def simulated(**settings: object) -> Iterator[tuple[ScriptedDevice, SimulatedPort]]:
    """A device and its port, with the host's clock simulated as long as the block lasts."""
    clock = Clock()
    with pytest.MonkeyPatch.context() as patch:
        for module in (connection, drive, run):
            patch.setattr(module, "time", clock)
        device = ScriptedDevice(None, clock=clock, **settings)
        device.wire = Ideal()  # type: ignore[assignment]
        yield device, SimulatedPort(device, clock)


def linked(port: Port, watchdog: float = 0.05) -> Connection:
    """A session with what is behind the port."""
    return Connection(port, watchdog=watchdog, patience=1.0, resume=0.5)


def driven(port: Port) -> Drive:
    """A drive with limits set."""
    found = Drive(linked(port))
    found.set_limits(volt=10.0)
    return found
