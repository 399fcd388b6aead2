"""Who can start a motor: not a web page, and not one that guesses."""

from __future__ import annotations

import random
import socket
import struct
import time

import pytest

import raw_host as raw
from raw_host import RawHost, golden
from sewfast.errors import LinkError
from sewfast.link import VirtualDevice

TRIES = 1000
LIMITS = struct.pack("<4f", 20.0, 6000.0, 1e6, 50.0)


def blind(tag: int, key: int, session: int) -> bytes:
    """All that starts a motor, by someone who does not hear what the device says."""

    def frame(kind: int, number: int, body: bytes) -> bytes:
        own = golden.host_time(session, 1000) if kind != raw.HELLO else 0
        return golden.wire(kind, tag if kind != raw.HELLO else 0, number, own, body)

    frames = [
        frame(raw.HELLO, 0, struct.pack("<BBI", 3, 3, session)),
        frame(raw.LIMITS, 1, LIMITS),
        frame(raw.ARM, 2, struct.pack("<II", 10_000_000, key)),
        frame(raw.START, 3, struct.pack("<BIQIHB", 2, 10_000_000, 0, 0, 3, 10)),
        frame(raw.DRIVE, 1, struct.pack("<If", 10_000_000, 5.0)),
    ]
    return b"\0" + b"".join(frames)


def posted(body: bytes) -> bytes:
    head = (
        "POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://attacker.example\r\n"
        f"Content-Type: text/plain\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body


def say(port: str, data: bytes) -> bool:
    """Say it to a port; whether the connection was closed because of it."""
    host, _, number = port.removeprefix("socket://").rpartition(":")
    with socket.create_connection((host, int(number)), timeout=10.0) as connection:
        try:
            connection.sendall(data)
            while connection.recv(4096):
                pass
        except TimeoutError:
            return False
        except OSError:
            return True
    return True


def starts(device: VirtualDevice) -> int:
    return sum(entry["event"] == "on" for entry in device.trace())


def test_what_the_attacks_say_starts_the_motor_of_whoever_knows_tag_and_key() -> None:
    # without this, that the attacks start nothing would say nothing about the locks
    with VirtualDevice(endpoint="tcp") as device, RawHost(device.port, session=99) as host:
        hello, *_ = blind(0, 0, 99).split(b"\0")[1:]
        host.write(b"\0" + hello + b"\0")
        reply = host.wait_for(raw.HELLO + 0x80)
        # a motor that is known to stand still can be armed
        time.sleep(0.3)
        (key,) = struct.unpack("<I", reply[-1][-4:])
        _, _, *rest = blind(reply[1], key, 99).split(b"\0")
        host.write(b"\0".join(rest))
        deadline = time.monotonic() + 5.0
        while starts(device) != 1 and time.monotonic() < deadline:
            host.read(0.01)
        assert starts(device) == 1


def test_a_web_page_starts_nothing_even_if_it_knows_the_tag() -> None:
    dice = random.Random(1)
    with VirtualDevice(endpoint="tcp") as device:
        host = RawHost(device.port)
        host.hello()
        tag = host.tag
        host.close()
        for k in range(TRIES):
            frames = blind(tag, dice.getrandbits(32), 1 + k)
            # the head as one piece, or longer than any frame
            data = posted(frames) if k % 2 else b"x" * 400 + posted(frames)
            assert say(device.port, data)
        assert starts(device) == 0
        # a host is still served
        host = RawHost(device.port)
        host.hello()
        host.arm()
        host.command(raw.START, struct.pack("<BIQIHB", 2, raw.WATCHDOG, 0, 0, 3, 10))
        host.running()
        host.command(raw.STOP)
        host.close()
        deadline = time.monotonic() + 5.0
        while starts(device) != 1 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert starts(device) == 1


def test_who_speaks_the_protocol_and_does_not_listen_starts_nothing() -> None:
    dice = random.Random(2)
    with VirtualDevice(endpoint="tcp") as device:
        host = RawHost(device.port)
        host.hello()
        tag = host.tag
        host.close()
        # a motor that is known to stand still could be armed
        time.sleep(0.2)
        for k in range(20):
            frames = b"".join(blind(tag, dice.getrandbits(32), 1 + 50 * k + i) for i in range(50))
            host_address = device.port.removeprefix("socket://").rpartition(":")
            where = (host_address[0], int(host_address[2]))
            with socket.create_connection(where, timeout=10.0) as connection:
                connection.sendall(frames)
                time.sleep(0.05)
        assert starts(device) == 0


def test_a_flood_of_wrong_tags_is_closed_and_starts_nothing() -> None:
    dice = random.Random(3)
    with VirtualDevice(endpoint="tcp") as device:
        host = RawHost(device.port)
        host.hello()
        tag = host.tag
        host.close()
        for k in range(100):
            wrong = [t for t in (dice.getrandbits(16) for _ in range(10)) if t != tag]
            frames = b"".join(blind(t, dice.getrandbits(32), 1 + k) for t in wrong)
            assert say(device.port, frames)
        assert starts(device) == 0
        # the device counts a connection after it has closed it
        deadline = time.monotonic() + 5.0
        while device.statistics["refused"] < 100 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert device.statistics["refused"] == 100


def test_a_port_that_others_reach_needs_a_word_and_is_warned_of() -> None:
    with pytest.raises(LinkError, match="whoever reaches the port can start the motor"):
        VirtualDevice(endpoint="tcp", address="0.0.0.0:0")
    with (
        pytest.warns(UserWarning, match="anyone who can reach this port can start the motor"),
        VirtualDevice(endpoint="tcp", address="0.0.0.0:0", anyone=True),
    ):
        pass


def test_arm_wants_the_key_of_the_last_hello() -> None:
    with VirtualDevice(endpoint="tcp") as device:
        host = RawHost(device.port)
        host.hello()
        host.settle()
        first = host.key
        host.command(raw.LIMITS, LIMITS)
        time.sleep(0.2)
        host.command(raw.ARM, struct.pack("<II", raw.WATCHDOG, first ^ 1), expect=13)
        host.hello_again()
        assert host.key == first
        host.session = 78
        host.hello()
        assert host.key != first
        host.command(raw.LIMITS, LIMITS)
        host.command(raw.ARM, struct.pack("<II", raw.WATCHDOG, first), expect=13)
        host.command(raw.ARM, host.arming())
        host.close()
