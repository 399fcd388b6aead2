"""One table for every `Port`."""

from __future__ import annotations

import copy
import math
import os
import pickle
import select
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from sewfast.errors import LinkError, SettingError
from sewfast.link import open_port
from sewfast.link.ports import (
    TRANSPORTS,
    SerialPort,
    SocketPort,
    is_port,
    transport_of,
)  # fmt: skip

pytestmark = pytest.mark.alone


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


TABLE = {"": (serial, SerialPort), "socket": (tcp, SocketPort)}


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
        with pytest.raises(LinkError, match=r"expected an open port, it is closed; connect again"):
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
        with pytest.raises(SettingError, match="one owner of a port"):
            copied(port)
    port.close()


@pytest.mark.parametrize(
    "url",
    ["", "virtual", "virtual:1", "http://localhost:80", "://x", "socket:/a:1", "sock"],
)
def test_what_is_no_port(url: str) -> None:
    assert not is_port(url)


@pytest.mark.parametrize("scheme", [s for s in TRANSPORTS if s])
@pytest.mark.parametrize(
    "rest", ["", "localhost", "localhost:0", ":5", "a:70000", "[::1:5", "a:5/b"]
)
def test_an_address_that_is_none(scheme: str, rest: str) -> None:
    with pytest.raises(SettingError, match=rf"expected {scheme}://HOST:PORT .*got"):
        open_port(f"{scheme}://{rest}")


def test_another_scheme_is_answered_by_those_that_there_are() -> None:
    with pytest.raises(SettingError, match="or socket://HOST:PORT, got 'ftp://a:5'"):
        open_port("ftp://a:5")
