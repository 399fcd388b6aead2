"""`FoxgloveView`: samples as JSON messages from a WebSocket server that Foxglove connects to."""

from __future__ import annotations

import json
import logging
from typing import Any

from ..errors import SettingError
from .feed import Feed
from .gate import Gate, hidden_address
from .stream import PERIOD_S, Tail, encode

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
"""Of Foxglove's own schema foxglove.Log, which its log panel shows."""

_INFO = 2


class FoxgloveView:
    """Topics `/drive` (one message a sample) and `/log` (the lines of status).

    Parameters
    ----------
    host, port
        Where the server is bound; port 0 takes any free one.
    name : str
        What clients see.

    Raises
    ------
    SettingError
        Without the package foxglove-sdk, or for a port that is taken.
    """

    def __init__(self, host: str, port: int, name: str) -> None:
        try:
            import foxglove
        except ImportError as e:
            raise SettingError(
                "the Foxglove view expected the package foxglove-sdk, received none; "
                'pip install "sewfast[foxglove]"'
            ) from e
        # a client that goes away is no news; who wants it asks Python's logging for it
        logging.getLogger("foxglove").addHandler(logging.NullHandler())
        self._sdk: Any = foxglove
        self._context = foxglove.Context()
        # for a client that does not read, the server keeps 1,024 messages and drops the oldest
        behind = hidden_address()
        self._server = foxglove.start_server(name=name, host=behind, port=0, context=self._context)
        try:
            # it would serve any web page
            self._gate = Gate(host, port, (behind, int(self._server.port)))
        except OSError as e:
            self._server.stop()
            raise SettingError(
                f"foxglove: expected port {port} of {host} to be free, received {str(e)!r}; "
                "choose another one: foxglove:PORT"
            ) from e

    @property
    def port(self) -> int:
        """Where clients connect."""
        return self._gate.port

    def run(self, feed: Feed) -> None:
        """Send until the feed is closed, then what is left."""
        drive = self._channel("/drive", "sewfast.Drive", _schema(feed))
        log = self._channel("/log", "foxglove.Log", _LOG)
        tail = Tail(feed)
        try:
            while not feed.closed.wait(PERIOD_S):
                _send(tail, drive, log)
            _send(tail, drive, log)
        finally:
            self._gate.close()
            # waits for a client that does not read, for as long as that stays connected: it must
            # not be called from the thread that owns the link
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
    for text in tail.said():
        at = round((stamp or tail.now) * 1e9)
        time = {"sec": at // 10**9, "nsec": at % 10**9}
        message = {"timestamp": time, "level": _INFO, "message": text, "name": "sewfast"}
        log.log(encode(message), log_time=at)
