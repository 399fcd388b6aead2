"""`PlotJugglerView`: samples as JSON datagrams for PlotJuggler's "UDP Server"."""

from __future__ import annotations

import socket
from typing import Any

from ..errors import SettingError
from .feed import Feed
from .stream import PERIOD_S, Tail, encode

TIMESTAMP = "timestamp"
"""The field that PlotJuggler is told to use as time [s since 1970]."""


class PlotJugglerView:
    """One datagram a sample: PlotJuggler takes one time from a message, and reads 2,048 bytes.

    A message that is no JSON makes it stop listening, and one without the time makes it use its
    own clock from then on. Hence a missing value is left out, and the time is always there.

    Parameters
    ----------
    host, port
        Where PlotJuggler listens.

    Raises
    ------
    SettingError
        For a host that has no address.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            # IPv4 first: PlotJuggler listens to nothing else
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
        """Send until the feed is closed, then what is left."""
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
                # nobody listens, or the buffer is full: a view may lose what it shows
                continue
