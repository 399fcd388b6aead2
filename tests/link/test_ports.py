"""One table for every `Port`; datagrams of UDP that are lost, late, or a stranger's."""

from __future__ import annotations

import copy
import math
import os
import pickle
import random
import select
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from refusals import refuses
from sewfast import ClosedLoopRun, Controller, Gains, Recording, record, run
from sewfast.errors import LinkError, SettingError
from sewfast.link import Drive, VirtualDevice, connect, examine, open_port
from sewfast.link.ports import (
    DATAGRAM,
    TRANSPORTS,
    SerialPort,
    SocketPort,
    UdpPort,
    _datagrams,
    is_port,
    transport_of,
)  # fmt: skip

pytestmark = pytest.mark.alone

CONTROLLER = Controller(Gains.standard(0.004, 0.1), u_min=-10.0, u_max=10.0)


@dataclass
class Far:
    """The device's end of a port."""

    url: str
    send: Callable[[bytes], Any]
    receive: Callable[[], bytes]


@contextmanager
def serial() -> Iterator[Far]:
    pytest.importorskip("serial")
    pty, tty = pytest.importorskip("pty"), pytest.importorskip("tty")
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        yield Far(os.ttyname(slave), lambda d: os.write(master, d), lambda: os.read(master, 65_536))
    finally:
        os.close(master)
        os.close(slave)


@contextmanager
def tcp() -> Iterator[Far]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        peers: list[socket.socket] = []

        def peer() -> socket.socket:
            # the port that was opened last is the one that counts
            while select.select([listener], [], [], 0.0 if peers else 10.0)[0]:
                peers.append(listener.accept()[0])
            peers[-1].settimeout(10.0)
            return peers[-1]

        url = f"socket://127.0.0.1:{listener.getsockname()[1]}"
        yield Far(url, lambda d: peer().sendall(d), lambda: peer().recv(65_536))
        for one in peers:
            one.close()


@contextmanager
def udp() -> Iterator[Far]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind(("127.0.0.1", 0))
        end.settimeout(10.0)
        known: list[Any] = []

        def receive() -> bytes:
            data, address = end.recvfrom(65_536)
            known.append(address)
            return data

        yield Far(
            f"udp://127.0.0.1:{end.getsockname()[1]}", lambda d: end.sendto(d, known[-1]), receive
        )


TABLE = {"": (serial, SerialPort), "socket": (tcp, SocketPort), "udp": (udp, UdpPort)}


@pytest.fixture(params=TABLE, ids=lambda scheme: scheme or "serial")
def far(request: pytest.FixtureRequest) -> Iterator[Far]:
    with TABLE[request.param][0]() as end:
        yield end


# --- what every port keeps to ---------------------------------------------------------------------


def test_the_table_has_every_transport() -> None:
    assert {scheme: kind for scheme, (_, kind) in TABLE.items()} == TRANSPORTS


def test_bytes_come_through_both_ways(far: Far) -> None:
    port = open_port(far.url)
    port.write(b"to the device\0\xff\0")
    assert far.receive() == b"to the device\0\xff\0"
    far.send(bytes(range(256)))
    assert port.read(10.0) == bytes(range(256))
    assert port.read(0.0) == b""
    port.close()
    port.close()


def test_an_address_leads_to_its_transport(far: Far) -> None:
    port = open_port(far.url)
    assert transport_of(far.url) is type(port)
    assert is_port(far.url)
    assert port.form
    assert port.describe()
    assert port.fileno() >= 0
    assert port.max_rate == (port.baud if port.is_local else math.inf)
    port.close()


def test_a_closed_port_says_so_and_opens_again(far: Far) -> None:
    port = open_port(far.url)
    port.close()
    for use in (lambda: port.read(0.0), lambda: port.write(b"x")):
        with refuses(LinkError, expected="an open port", received="closed", remedy="connect again"):
            use()
    with pytest.raises(LinkError, match="closed"):
        port.fileno()
    port.reopen()
    port.write(b"again\0")
    assert far.receive() == b"again\0"
    port.close()


def test_it_has_one_owner(far: Far) -> None:
    port = open_port(far.url)
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        with refuses(SettingError, name="port", expected="one owner"):
            copied(port)
    port.close()


@pytest.mark.parametrize(
    "url", ["", "virtual", "virtual:1", "http://localhost:80", "://x", "udp:/localhost:1", "sock"]
)
def test_what_is_no_port(url: str) -> None:
    assert not is_port(url)


@pytest.mark.parametrize("scheme", [s for s in TRANSPORTS if s])
@pytest.mark.parametrize(
    "rest", ["", "localhost", "localhost:0", ":5", "a:70000", "[::1:5", "a:5/b"]
)
def test_an_address_that_is_none(scheme: str, rest: str) -> None:
    with refuses(SettingError, name="port", expected=f"^{scheme}://HOST:PORT"):
        open_port(f"{scheme}://{rest}")


def test_another_scheme_is_answered_by_those_that_there_are() -> None:
    with refuses(
        SettingError, expected="socket://HOST:PORT or udp://HOST:PORT$", received="'ftp://a:5'"
    ):
        open_port("ftp://a:5")


# --- UDP ------------------------------------------------------------------------------------------


def test_datagrams_end_where_frames_end() -> None:
    dice = random.Random(1)
    for _ in range(200):
        frames = [
            bytes(dice.randrange(1, 256) for _ in range(dice.randrange(1, 252))) + b"\0"
            for _ in range(dice.randrange(1, 40))
        ]
        parts = list(_datagrams(b"".join(frames)))
        assert b"".join(parts) == b"".join(frames)
        assert all(len(p) <= DATAGRAM and p.endswith(b"\0") for p in parts)
    assert [len(p) for p in _datagrams(b"x" * 3000)] == [1200, 1200, 600]
    assert list(_datagrams(b"")) == []


def test_a_strangers_datagrams_are_not_heard() -> None:
    with udp() as far, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        port = open_port(far.url)
        port.write(b"x\0")
        far.receive()
        stranger.sendto(b"start the motor\0", ("127.0.0.1", port._socket.getsockname()[1]))
        assert port.read(0.2) == b""
        far.send(b"")
        assert port.read(0.2) == b""  # an empty datagram is no end
        far.send(b"own\0")
        assert port.read(10.0) == b"own\0"
        port.close()


def test_where_nobody_listens_that_is_said() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    with refuses(LinkError, expected="listens there", received="nobody", remedy="start it"):
        connect(f"udp://127.0.0.1:{number}")
    found = examine(f"udp://127.0.0.1:{number}")
    assert (found.verdict, [f.name for f in found.findings]) == ("fail", ["port", "device"])
    assert "received nobody" in found.findings[1].measured


def test_a_host_that_there_is_not() -> None:
    with refuses(LinkError, expected="listens there", received="no such way"):
        open_port("udp://no.such.host.invalid:5000")


class Bridge:
    """Datagrams on one side, a device's TCP port on the other; it loses and swaps datagrams."""

    def __init__(
        self, port: str, *, lost: float = 0.0, swapped: float = 0.0, seed: int = 0
    ) -> None:
        host, _, number = port.removeprefix("socket://").rpartition(":")
        self._device = socket.create_connection((host, int(number)))
        self._end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._end.bind(("127.0.0.1", 0))
        self.url = f"udp://127.0.0.1:{self._end.getsockname()[1]}"
        self._dice, self._lost, self._swapped = random.Random(seed), lost, swapped
        self.counts = {"lost": 0, "swapped": 0, "passed": 0}
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)

    def __enter__(self) -> Bridge:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._device.close()
        self._end.close()

    def _pass_on(self) -> None:
        host: Any = None
        buffered, held = b"", []
        while not self._stopping.is_set():
            ready = select.select([self._device, self._end], [], [], 0.002)[0]
            if self._end in ready:
                with suppress(ConnectionError):  # of the host, which has gone
                    data, host = self._end.recvfrom(65_536)
                    if not self._is_lost():
                        self._device.sendall(data)
            if self._device in ready:
                buffered += self._device.recv(65_536)
                whole, _, buffered = buffered.rpartition(b"\0")
                for frame in whole.split(b"\0") if whole else ():
                    if host is None or self._is_lost():
                        continue
                    if not held and self._dice.random() < self._swapped:
                        self.counts["swapped"] += 1
                        held = [frame]
                        continue
                    for one in (frame, *held):
                        self._end.sendto(one + b"\0", host)
                    held = []
            elif held:  # nothing comes to be swapped with
                self._end.sendto(held.pop() + b"\0", host)

    def _is_lost(self) -> bool:
        drawn = self._dice.random() < self._lost
        self.counts["lost" if drawn else "passed"] += 1
        return drawn


STEP = np.concatenate([np.zeros(100), np.full(900, 4.0)])


@contextmanager
def bridged(**faults: Any) -> Iterator[tuple[Bridge, Drive]]:
    """A drive behind datagrams."""
    with (
        VirtualDevice(fast=True, endpoint="tcp") as device,
        Bridge(device.port, **faults) as bridge,
        connect(bridge.url) as drive,
    ):
        drive.set_limits()
        yield bridge, drive


@pytest.fixture(scope="module")
def undisturbed() -> tuple[Recording, ClosedLoopRun]:
    """The same behind a connection."""
    with VirtualDevice(fast=True, endpoint="tcp") as device, connect(device.port) as drive:
        drive.set_limits()
        return record(drive, STEP), run(CONTROLLER, drive, np.full(600, 800.0))


def test_a_drive_behind_datagrams_does_what_one_behind_a_connection_does(
    undisturbed: tuple[Recording, ClosedLoopRun],
) -> None:
    with bridged() as (bridge, drive):
        found = record(drive, STEP), run(CONTROLLER, drive, np.full(600, 800.0))
        assert drive.outcome is not None
        assert drive.outcome.is_complete
    assert bridge.counts["passed"] > 100
    np.testing.assert_array_equal(found[0].counts, undisturbed[0].counts)
    np.testing.assert_array_equal(found[1].u, undisturbed[1].u)


@pytest.mark.parametrize("fault", ["lost", "swapped"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_lost_and_late_datagrams_are_gaps_and_nothing_else(
    undisturbed: tuple[Recording, ClosedLoopRun], fault: str, seed: int
) -> None:
    with bridged(**{fault: 0.1}, seed=seed) as (bridge, drive):
        found, outcome = record(drive, STEP), drive.outcome
    expected = undisturbed[0]
    assert bridge.counts[fault] > 5
    assert outcome is not None
    assert {kind for kind, *_ in outcome.anomalies} & {"late", "missing"}
    missing = np.isnan(found.counts)
    assert 0 < missing.sum() < 500
    listed = np.zeros(len(STEP), dtype=bool)
    for first, count in outcome.gaps:
        listed[first : first + count] = True
    np.testing.assert_array_equal(listed, missing)
    np.testing.assert_array_equal(found.u[~missing], expected.u[~missing])
    # a gap at the beginning moves the origin of the counts, nothing else
    known = np.flatnonzero(~np.isnan(np.diff(found.counts)))
    np.testing.assert_array_equal(np.diff(found.counts)[known], np.diff(expected.counts)[known])


def test_a_device_that_falls_silent_is_missed() -> None:
    with bridged() as (bridge, drive):
        bridge._lost = 1.0
        with refuses(LinkError, expected="an answer to STATUS"):
            drive.status()
        bridge._lost = 0.0
