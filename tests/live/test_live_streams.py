"""The live view's streams: datagrams for PlotJuggler, a Foxglove server, receivers that hang."""

from __future__ import annotations

import json
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from sewfast.errors import SettingError
from sewfast.live import Feed, open_view
from sewfast.live.stream import RATE, Tail


def feed(n: int | None = None) -> Feed:
    return Feed({"u": "V", "counts": ""}, 0.001, n, "record sine", counts_per_rev=1572)


def batch(first: int, count: int = 10) -> dict[str, np.ndarray]:
    k = np.arange(first, first + count)
    return {"u": k / 1000, "counts": 10 * k}


def strict(message: bytes | str) -> dict[str, object]:
    def refuse(name: str) -> float:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(message, parse_constant=refuse)


# samples in order, at a bounded rate


class Clock:
    def __init__(self) -> None:
        self.now = 1e9

    def __call__(self) -> float:
        return self.now


def test_tail_gives_each_sample_once_with_its_time() -> None:
    f, clock = feed(), Clock()
    tail = Tail(f, clock)
    found = []
    for first in range(0, 1000, 10):
        f.put(first, batch(first))
        clock.now += 0.01
        found += list(tail.rows())
    assert [round(1000 * row["t"]) for _, row in found] == list(range(1000))
    stamps = np.array([stamp for stamp, _ in found])
    np.testing.assert_allclose(np.diff(stamps), 0.001, atol=1e-6)
    assert abs(stamps[0] - 1e9) < 0.1
    assert found[500][1] == pytest.approx({"t": 0.5, "u": 0.5, "counts": 5000, "speed": 381.6794})


def test_tail_leaves_out_what_is_missing() -> None:
    f, clock = feed(), Clock()
    tail = Tail(f, clock)
    f.put(0, {"u": np.array([0.0, np.nan, 2.0])})
    f.put(5, {"u": np.array([5.0])})
    clock.now += 0.01
    rows = [row for _, row in tail.rows()]
    assert rows == [{"t": 0.0, "u": 0.0}, {"t": 0.002, "u": 2.0}, {"t": 0.005, "u": 5.0}]


def test_tail_of_a_fast_record_is_thinned() -> None:
    """200 times real time: bounded work, and samples at an even distance within a look."""
    f, clock = feed(), Clock()
    tail = Tail(f, clock)
    sent = 0
    for first in range(0, 200_000, 4000):
        f.put(first, batch(first, 4000))
        clock.now += 0.02
        rows = [row for _, row in tail.rows()]
        ticks = np.rint([1000 * row["t"] for row in rows]).astype(int)
        if first >= 40_000:
            assert set(np.diff(ticks)) == {80}
            assert (ticks % 80 == 0).all()
        sent += len(rows)
    # the second that could be made up for, and the one that passed
    assert 0 < sent <= 2 * RATE


def test_tail_that_comes_late_takes_what_is_left() -> None:
    f, clock = feed(), Clock()
    tail = Tail(f, clock)
    for first in range(0, 100_000, 10):
        f.put(first, batch(first))
    clock.now += 100.0
    rows = [row for _, row in tail.rows()]
    assert 0 < len(rows) <= RATE
    assert rows[-1]["t"] > 99.9
    assert all("u" in row for row in rows)


def test_status_lines_are_sent_once() -> None:
    f = feed()
    tail = Tail(f)
    f.say("one")
    assert list(tail.notes()) == ["one"]
    f.say("two")
    f.say("three")
    assert list(tail.notes()) == ["two", "three"]
    assert list(tail.notes()) == []


# PlotJuggler


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        made.bind(("127.0.0.1", 0))
        made.settimeout(60)
        yield made


def test_plotjuggler_receives_every_sample(receiver: socket.socket) -> None:
    f = feed()
    with open_view(f"plotjuggler:127.0.0.1:{receiver.getsockname()[1]}", f):
        for first in range(0, 300, 10):
            if first != 100:
                f.put(first, batch(first))
            time.sleep(0.005)
    expected = [k for k in range(300) if not 100 <= k < 110]
    messages = [receiver.recv(65536) for _ in expected]
    assert max(map(len, messages)) < 500
    found = [strict(m) for m in messages]
    assert [round(1000 * m["sewfast"]["t"]) for m in found] == expected
    assert all(set(m) == {"timestamp", "sewfast"} for m in found)
    assert abs(found[0]["timestamp"] - time.time()) < 60
    steps = np.diff([m["timestamp"] for m in found])
    np.testing.assert_allclose(steps, 0.001 * np.diff(expected), atol=2e-6)
    assert found[-1]["sewfast"]["speed"] == pytest.approx(381.6794)
    assert "speed" not in found[expected.index(115)]["sewfast"]


def test_absent_receiver_costs_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    f = feed()
    with open_view(f"plotjuggler:127.0.0.1:{port}", f):
        for first in range(0, 300, 10):
            f.put(first, batch(first))
            time.sleep(0.002)
    assert f.received == 300
    assert capfd.readouterr() == ("", "")


def test_host_without_an_address_is_refused() -> None:
    with (
        pytest.raises(SettingError, match="expected a host with an address, received 'no host'"),
        open_view("plotjuggler:no host:9870", feed()),
    ):
        pass


# Foxglove


def subscribe(port: int) -> socket.socket:
    """A raw client that has asked for the topic /drive, and reads no further."""
    client = socket.socket()
    # before connecting, so that the window is small from the start
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.settimeout(60)
    client.connect(("127.0.0.1", port))
    client.sendall(
        b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    )
    found = b""
    while (channel := re.search(rb'"id":(\d+),"topic":"/drive"', found)) is None:
        found += client.recv(4096)
    wanted = {"id": 7, "channelId": int(channel[1])}
    ask = json.dumps({"op": "subscribe", "subscriptions": [wanted]}).encode()
    # a client's frame: text, final, masked with zeros
    client.sendall(bytes([0x81, 0x80 | len(ask)]) + bytes(4) + ask)
    return client


def test_foxglove_client_receives_samples_and_status() -> None:
    pytest.importorskip("foxglove", reason="needs the foxglove extra")
    connect = pytest.importorskip("websockets.sync.client").connect
    f, done = feed(), threading.Event()
    samples, texts, topics = [], [], {}

    def put() -> None:
        for first in range(0, 100_000, 10):
            f.put(first, batch(first))
            if done.wait(0.005):
                return

    with (
        open_view("foxglove:0", f) as view,
        connect(
            f"ws://127.0.0.1:{view.port}", subprotocols=["foxglove.sdk.v1"], close_timeout=1
        ) as client,
    ):
        while len(topics) < 2:
            message = json.loads(client.recv(timeout=60))
            topics |= {c["topic"]: c for c in message.get("channels", ())}
        client.send(
            json.dumps(
                {
                    "op": "subscribe",
                    "subscriptions": [
                        {"id": 1, "channelId": topics["/drive"]["id"]},
                        {"id": 2, "channelId": topics["/log"]["id"]},
                    ],
                }
            )
        )
        writer = threading.Thread(target=put)
        writer.start()
        while len(samples) < 200 or not texts:
            message = client.recv(timeout=60)
            _, subscription, stamp = struct.unpack_from("<BIQ", message)
            (samples if subscription == 1 else texts).append((stamp, strict(message[13:])))
            if len(samples) == 1:
                f.say("tripped: speed limit")
        done.set()
        writer.join()
    ticks = [round(1000 * row["t"]) for _, row in samples]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    assert samples[150][1]["speed"] == pytest.approx(381.6794)
    np.testing.assert_allclose(np.diff([s for s, _ in samples]), 1_000_000, atol=2000)
    assert {text["message"] for _, text in texts} == {"tripped: speed limit"}
    assert texts[0][1]["message"] == "tripped: speed limit"
    schema = json.loads(topics["/drive"]["schema"])
    assert schema["properties"]["u"] == {"type": "number", "description": "V"}
    assert (topics["/log"]["schemaName"], topics["/log"]["encoding"]) == ("foxglove.Log", "json")


def resident() -> int:
    """Memory of this process [bytes]."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_foxglove_client_that_never_reads_holds_nothing_up() -> None:
    pytest.importorskip("foxglove", reason="needs the foxglove extra")
    f = Feed(
        {f"column_{k:02}_of_a_rather_wide_record": "V" for k in range(60)}, 0.001, None, "hang"
    )  # fmt: skip
    wide = {name: np.random.default_rng(0).normal(size=10) for name in f.columns}

    def fill(first: int, batches: int) -> None:
        for k in range(batches):
            f.put(first + 10 * k, wide)
            time.sleep(0.002)

    with open_view("foxglove:0", f, own_process=False) as view, subscribe(view.port) as client:
        fill(0, 300)
        while b'"column_00_of' not in client.recv(4096):
            continue
        # from here on it does not read
        before = resident()
        # 20 MB of messages, of which the server keeps 1,024
        fill(3000, 700)
        grown = resident() - before
        assert f.received == 10_000
        began = time.monotonic()
    assert time.monotonic() - began < 30
    assert grown < 10e6


HANGING = """
import sys, time, numpy as np
from sewfast.live import Feed, open_view
feed = Feed({f"column_{k:02}_of_a_rather_wide_record": "V" for k in range(60)}, 0.001, None, "x")
with open_view("foxglove:0", feed) as view:
    print(view.port, flush=True)
    sys.stdin.readline()
    for first in range(0, 8000, 10):
        feed.put(first, {name: np.random.normal(size=10) for name in feed.columns})
        time.sleep(0.002)
"""


def test_program_ends_beside_a_foxglove_client_that_never_reads() -> None:
    pytest.importorskip("foxglove", reason="needs the foxglove extra")
    with subprocess.Popen(
        [sys.executable, "-c", HANGING], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        with subscribe(int(program.stdout.readline())):
            program.stdin.write("\n")
            program.stdin.flush()
            assert program.wait(120) == 0


@pytest.mark.parametrize(
    ("host", "origin", "passes"),
    [
        ("localhost:8765", None, True),
        ("127.0.0.1:8765", "https://app.foxglove.dev", True),
        ("[::1]:8765", "http://localhost:8080", True),
        ("127.0.0.1", "file://", True),
        ("127.0.0.1:8765", "https://attacker.example", False),
        ("127.0.0.1:8765", "https://foxglove.dev.attacker.example", False),
        ("127.0.0.1:8765", "https://localhost.attacker.example", False),
        ("127.0.0.1:8765", "http://app.foxglove.dev", False),
        ("127.0.0.1:8765", "null", False),
        ("attacker.example:8765", None, False),
        ("attacker.example:8765", "http://attacker.example:8765", False),
    ],
)
def test_foxglove_serves_no_web_page(host: str, origin: str | None, passes: bool) -> None:
    pytest.importorskip("foxglove", reason="needs the foxglove extra")
    lines = [
        "GET / HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Protocol: foxglove.sdk.v1", *([f"Origin: {origin}"] if origin else []),
    ]  # fmt: skip
    with (
        open_view("foxglove:0", feed(), own_process=False) as view,
        socket.create_connection(("127.0.0.1", view.port), timeout=10.0) as client,
    ):
        client.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        assert client.recv(4096).split(b"\r\n")[0].split()[1] == (b"101" if passes else b"403")


def test_foxglove_port_that_is_taken_is_refused() -> None:
    pytest.importorskip("foxglove", reason="needs the foxglove extra")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with (
            pytest.raises(SettingError, match=f"expected port {port} of 127.0.0.1 to be free"),
            open_view(f"foxglove:{port}", feed()),
        ):
            pass


def test_foxglove_without_its_package_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with (
        pytest.raises(SettingError, match=r'pip install "sewfast\[foxglove\]"'),
        open_view("foxglove", feed(), own_process=False),
    ):
        pass


def test_nothing_is_left_behind() -> None:
    before = set(os.listdir("/proc/self/fd")) if sys.platform.startswith("linux") else set()
    for own_process in (True, False):
        f = feed()
        with open_view("plotjuggler", f, own_process=own_process):
            f.put(0, batch(0))
            alive = any(t.name == "live view" for t in threading.enumerate())
            assert alive is not own_process
        assert not any(t.name == "live view" for t in threading.enumerate())
    if before:
        assert len(os.listdir("/proc/self/fd")) <= len(before)
