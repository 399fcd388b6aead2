"""`Gate`: who may connect to a WebSocket server of this computer, by the head of the request.

A browser lets any page connect to a WebSocket on its own computer and read what it sends; the
page's address stands in `Origin`, which a page cannot change. A page whose name was made to lead to
this computer (DNS rebinding) gives itself away by `Host`. The server behind, Foxglove's own, looks
at neither, so that what passes is handed on to it.
"""

from __future__ import annotations

import random
import re
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import urlsplit

LONGEST = 16_384
"""Bytes of a request's head."""
PATIENCE = 5.0
"""Time for it [s]."""
CONNECTIONS = 16
"""So many at once; further ones are closed."""
_REFUSAL = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_END = b"\r\n\r\n"


def hidden_address() -> str:
    """Where the server behind listens: where it can, at one of 16 million that nobody is told."""
    if sys.platform != "linux":
        return "127.0.0.1"
    drawn = random.SystemRandom()
    return f"127.{drawn.randint(1, 254)}.{drawn.randint(0, 255)}.{drawn.randint(1, 254)}"


def admits(head: bytes) -> bool:
    """Whether a request comes from a program, Foxglove or a page of this computer."""
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
    """Of the desktop program, Foxglove's own pages, or a page that this computer serves."""
    if origin == "file://" or _is_local(origin):
        return True
    return re.fullmatch(r"https://([a-z0-9-]+\.)*foxglove\.dev", origin) is not None


def _is_local(address: str) -> bool:
    try:
        return urlsplit(address).hostname in ("localhost", "127.0.0.1", "::1")
    except ValueError:
        return False


class Gate:
    """Listens, reads the heads of requests and hands on what may pass.

    Parameters
    ----------
    host, port
        Where it listens; port 0 takes any free one.
    behind : pair of text and int
        The server that gets what passes.

    Raises
    ------
    OSError
        Where the port is taken.
    """

    def __init__(self, host: str, port: int, behind: tuple[str, int]) -> None:
        self._behind = behind
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family)
        self.port = int(self._listener.getsockname()[1])
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._room = threading.BoundedSemaphore(CONNECTIONS)
        self._closed = False
        self._start(self._accept)

    def close(self) -> None:
        """End all connections, and take no further ones."""
        self._closed = True
        # a thread that waits in accept is not woken by closing alone
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
        client.settimeout(PATIENCE)
        head = b""
        while _END not in head and len(head) < LONGEST:
            piece = client.recv(4096)
            if not piece:
                return
            head += piece
        if _END not in head or not admits(head.partition(_END)[0]):
            client.sendall(_REFUSAL)
            return
        with socket.create_connection(self._behind, timeout=PATIENCE) as server:
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
    """Hand on until one of the two ends; then end both."""
    with suppress(OSError):
        while piece := source.recv(65_536):
            target.sendall(piece)
    for connection in (source, target):
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
