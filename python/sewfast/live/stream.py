"""Views over the network: JSON for Foxglove and PlotJuggler, and the check of who may connect."""

from __future__ import annotations

import json
import logging
import math
import random
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

from ..errors import SettingError
from .feed import Feed

# --- Gate: checks the head of a request before it reaches the WebSocket server --------------------
# A browser lets any web page connect to a WebSocket on its own computer and read from it. The
# header `Origin` holds the page's address, which the page cannot change. A page whose host name was
# made to resolve to this computer (DNS rebinding) shows in `Host`. Foxglove's own server checks
# neither header, so the gate checks them and forwards the requests that pass.


_REFUSAL = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_END = b"\r\n\r\n"


def hidden_address() -> str:
    """The address of Foxglove's server: on Linux a random one of 16 million, kept secret."""
    if sys.platform != "linux":
        return "127.0.0.1"
    drawn = random.SystemRandom()
    return f"127.{drawn.randint(1, 254)}.{drawn.randint(0, 255)}.{drawn.randint(1, 254)}"


def admits(head: bytes) -> bool:
    """Whether a request comes from a program, from Foxglove or from a page of this computer."""
    fields: dict[str, list[str]] = {}
    for line in head.decode("latin-1").split("\r\n")[1:]:
        name, colon, value = line.partition(":")
        if colon:
            fields.setdefault(name.strip().lower(), []).append(value.strip())
    hosts, origins = fields.get("host", []), fields.get("origin", [])
    if len(hosts) != 1 or len(origins) > 1:
        return False
    return _is_local(f"//{hosts[0]}") and all(map(_may_read, origins))


def _may_read(origin: str) -> bool:
    """Whether it is the desktop program, a page of Foxglove's, or one served by this computer."""
    if origin == "file://" or _is_local(origin):
        return True
    return re.fullmatch(r"https://([a-z0-9-]+\.)*foxglove\.dev", origin) is not None


def _is_local(address: str) -> bool:
    try:
        return urlsplit(address).hostname in ("localhost", "127.0.0.1", "::1")
    except ValueError:
        return False


class Gate:
    """Forwards requests whose heads pass to the server `behind`; port 0 takes any free one."""

    def __init__(self, host: str, port: int, behind: tuple[str, int]) -> None:
        self._behind = behind
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family)
        self.port = int(self._listener.getsockname()[1])
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        # most connections at once; further ones are closed
        self._room = threading.BoundedSemaphore(16)
        self._closed = False
        self._start(self._accept)

    def close(self) -> None:
        """End all connections, and take no further ones."""
        self._closed = True
        # closing alone does not wake a thread that waits in accept
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            for connection in self._open:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    @staticmethod
    def _start(task: Callable[..., None], *arguments: object) -> None:
        threading.Thread(target=task, args=arguments, name="sewfast-gate", daemon=True).start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                client = self._listener.accept()[0]
            except OSError:
                if self._closed:
                    return
                continue
            if self._room.acquire(blocking=False):
                self._start(self._serve, client)
            else:
                client.close()

    def _serve(self, client: socket.socket) -> None:
        try:
            with suppress(OSError), client:
                self._admit(client)
        finally:
            self._room.release()

    def _admit(self, client: socket.socket) -> None:
        # longest wait for the head [s]
        patience = 5.0
        client.settimeout(patience)
        head = b""
        # bytes of a request's head
        while _END not in head and len(head) < 16_384:
            piece = client.recv(4096)
            if not piece:
                return
            head += piece
        if _END not in head or not admits(head.partition(_END)[0]):
            client.sendall(_REFUSAL)
            return
        with socket.create_connection(self._behind, timeout=patience) as server:
            for connection in (client, server):
                connection.settimeout(None)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                if self._closed:
                    return
                self._open |= {client, server}
            try:
                server.sendall(head)
                back = threading.Thread(target=_pump, args=(server, client), daemon=True)
                back.start()
                _pump(client, server)
                back.join()
            finally:
                with self._lock:
                    self._open -= {client, server}


def _pump(source: socket.socket, target: socket.socket) -> None:
    """Forward bytes until one of the two connections ends; then end both."""
    with suppress(OSError):
        while piece := source.recv(65_536):
            target.sendall(piece)
    for connection in (source, target):
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)


# --- Tail: the samples of a feed as JSON objects, at a limited rate -------------------------------


PERIOD_S = 0.02
"""Time between two reads of the feed [s]."""

RATE = 2500
"""Most samples that a stream sends in a second; of a faster record it sends every second one, or
fewer. Samples not sent in one second can be made up for in the next."""


class Tail:
    """The samples of a feed since the last read, with time stamps from the wall clock `now` [s]."""

    def __init__(self, feed: Feed, now: Callable[[], float] = time.time) -> None:
        self._feed, self._now = feed, now
        self._next = 0
        self._looked = now()
        self._allowed = float(RATE)
        self._began: float | None = None
        self._noted = 0

    def rows(self) -> Iterator[tuple[float, dict[str, float]]]:
        """Wall time [s] and columns of each sample to send; a missing value is left out."""
        feed, stop = self._feed, self._feed.end
        self._refill()
        start = max(self._next, feed.oldest)
        if stop <= start:
            return
        if self._began is None:
            self._began = self._looked - stop * feed.Ts
        stride = math.ceil((stop - start) / max(self._allowed, 1.0))
        self._allowed -= (stop - start) / stride
        # multiples of the stride: the same samples, whenever the feed is read
        first = -(-start // stride) * stride
        columns = {name: c[first - start :: stride] for name, c in feed.read(start, stop).items()}
        self._next = stop
        for k, values in enumerate(zip(*(c.tolist() for c in columns.values()), strict=True)):
            known = {n: v for n, v in zip(columns, values, strict=True) if math.isfinite(v)}
            if known:
                t = (first + k * stride) * feed.Ts
                yield self._began + t, {"t": round(t, 9), **known}

    @property
    def now(self) -> float:
        """Wall time of the last read [s]."""
        return self._looked

    def _refill(self) -> None:
        """Add to the number of samples allowed, by the time passed (a token bucket)."""
        now = self._now()
        passed, self._looked = max(now - self._looked, 0.0), now
        self._allowed = min(self._allowed + RATE * passed, RATE)

    def notes(self) -> Iterator[str]:
        """The lines of status since the last call."""
        for number, text in self._feed.notes(self._noted):
            self._noted = number
            yield text


def encode(value: object) -> bytes:
    """Strict JSON: NaN and infinity are refused."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


# --- FoxgloveView: samples as JSON messages from a WebSocket server that Foxglove connects to -----


_LOG = {
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
    },
}
"""The part used of Foxglove's own schema foxglove.Log, which its log panel shows."""


class FoxgloveView:
    """Topics `/drive` (one message a sample) and `/log` (the lines of status)."""

    def __init__(self, host: str, port: int, name: str) -> None:
        try:
            import foxglove
        except ImportError as e:
            raise SettingError(
                "the Foxglove view expected the package foxglove-sdk, received none; "
                'pip install "sewfast[foxglove]"'
            ) from e
        # a client that disconnects is not worth a line; Python's logging can still show it
        logging.getLogger("foxglove").addHandler(logging.NullHandler())
        self._sdk: Any = foxglove
        self._context = foxglove.Context()
        # the server keeps 1,024 messages for a client that does not read, then drops the oldest
        behind = hidden_address()
        self._server = foxglove.start_server(name=name, host=behind, port=0, context=self._context)
        try:
            # without the gate, the server would serve any web page
            self._gate = Gate(host, port, (behind, int(self._server.port)))
        except OSError as e:
            self._server.stop()
            raise SettingError(
                f"foxglove: expected port {port} of {host} to be free, received {str(e)!r}; "
                "choose another one: foxglove:PORT"
            ) from e

    @property
    def port(self) -> int:
        return self._gate.port

    def run(self, feed: Feed) -> None:
        """Send samples until the feed is closed, then the rest."""
        drive = self._channel("/drive", "sewfast.Drive", _schema(feed))
        log = self._channel("/log", "foxglove.Log", _LOG)
        tail = Tail(feed)
        try:
            while not feed.closed.wait(PERIOD_S):
                _send(tail, drive, log)
            _send(tail, drive, log)
        finally:
            self._gate.close()
            # this waits as long as a client that does not read stays connected: never call it from
            # the thread that owns the link
            self._server.stop()

    def _channel(self, topic: str, name: str, schema: dict[str, Any]) -> Any:
        described = self._sdk.Schema(
            name=name, encoding="jsonschema", data=json.dumps(schema).encode()
        )
        return self._sdk.Channel(
            topic, schema=described, message_encoding="json", context=self._context
        )


def _schema(feed: Feed) -> dict[str, Any]:
    units = {"t": "s", **feed.columns}
    numbers = {name: {"type": "number", "description": unit} for name, unit in units.items()}
    return {"type": "object", "properties": numbers}


def _send(tail: Tail, drive: Any, log: Any) -> None:
    stamp = 0.0
    for stamp, row in tail.rows():
        drive.log(encode(row), log_time=round(stamp * 1e9))
    for text in tail.notes():
        at = round((stamp or tail.now) * 1e9)
        time = {"sec": at // 10**9, "nsec": at % 10**9}
        message = {"timestamp": time, "level": 2, "message": text, "name": "sewfast"}
        log.log(encode(message), log_time=at)


# --- PlotJugglerView: samples as JSON datagrams for PlotJuggler's "UDP Server" --------------------


TIMESTAMP = "timestamp"
"""The field to choose as time in PlotJuggler [s since 1970]."""


class PlotJugglerView:
    """One datagram a sample: PlotJuggler takes one time per message, and reads 2,048 bytes. A
    message that is not JSON makes it stop listening, and one without the time makes it use its own
    clock from then on. So a missing value is left out, and the time is always included. `host` and
    `port` are where PlotJuggler listens. Raises `SettingError` for a host that has no address.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            # IPv4 first: PlotJuggler listens on nothing else
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as e:
            raise SettingError(
                f"plotjuggler: expected a host with an address, received {host!r} ({e}); "
                "127.0.0.1 is this machine"
            ) from e
        found.sort(key=lambda entry: entry[0] != socket.AF_INET)
        family, kind, protocol, _, address = found[0]
        self._address: Any = address
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def run(self, feed: Feed) -> None:
        """Send samples until the feed is closed, then the rest."""
        tail = Tail(feed)
        with self._socket:
            while not feed.closed.wait(PERIOD_S):
                self._send(tail)
            self._send(tail)

    def _send(self, tail: Tail) -> None:
        for stamp, row in tail.rows():
            message = encode({TIMESTAMP: round(stamp, 6), "sewfast": row})
            try:
                self._socket.sendto(message, self._address)
            except OSError:
                # nobody listens, or the buffer is full: a view may lose samples
                continue
