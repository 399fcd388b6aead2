"""`Session`: a page that gave its token, with a thread for each direction of its messages."""

from __future__ import annotations

import contextlib
import json
import math
import queue
import struct
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

    from ..dataset import FloatArray

PROMPT, ROW = 0.15, 10
"""A page can arm a drive after `ROW` answers in a row, each within `PROMPT` [s]."""

MOST_UNANSWERED = 20
"""Most heartbeats without an answer; then no further ones are sent."""

MOST_WAITING = 200
"""Most queued messages of a page; a page that sends more is closed."""


class Session:
    """A page that has given its token.

    Sending to the page and answering its requests have a thread each, so that a page that no longer
    reads holds up nobody, and a long request of a page does not delay its STOP.
    """

    def __init__(
        self, connection: ServerConnection, answer: Callable[[Session, str | bytes], object]
    ) -> None:
        self.connection = connection
        self._outgoing: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self._incoming: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self._answer = answer
        self._beats: dict[int, float] = {}
        self._beat = 0
        #: Number of heartbeats in a row with a prompt answer.
        self.prompt = 0
        self._threads = [
            threading.Thread(target=run, daemon=True) for run in (self._send, self._work)
        ]
        for thread in self._threads:
            thread.start()

    def send(self, message: str | bytes) -> None:
        self._outgoing.put(message)

    def take(self, message: str | bytes) -> None:
        """Queue a message for its answer."""
        if self._incoming.qsize() >= MOST_WAITING:
            self.connection.close(1008, "too many messages wait for an answer")
            return
        self._incoming.put(message)

    def end(self) -> None:
        self._outgoing.put(None)
        self._incoming.put(None)

    def wait(self, seconds: float) -> None:
        """Wait for the threads, so that Python does not exit during a computation."""
        self.end()
        for thread in self._threads:
            thread.join(seconds)

    def _send(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while (message := self._outgoing.get()) is not None:
                self.connection.send(message)

    def _work(self) -> None:
        while (message := self._incoming.get()) is not None:
            self._answer(self, message)

    def beat(self) -> None:
        """Send a heartbeat for the page to answer."""
        now = time.monotonic()
        if len(self._beats) >= MOST_UNANSWERED:
            self.prompt = 0
            oldest = min(self._beats)
            if now - self._beats[oldest] > 10.0:  # the page may have lost them
                self._beats.clear()
            return
        self._beat += 1
        self._beats[self._beat] = now
        self.send(to_text({"event": "beat", "n": self._beat, "prompt": self.prompt}))

    def answered(self, n: int) -> float | None:
        """Time of the answer to a heartbeat [s]; None for an unknown number."""
        sent = self._beats.pop(n, None)
        if sent is None:
            return None
        took = time.monotonic() - sent
        self.prompt = self.prompt + 1 if took <= PROMPT else 0
        return took


def packed(head: dict[str, Any], curves: Mapping[str, FloatArray]) -> bytes:
    """A message with curves: length of the head, head as JSON, then every curve in float32.

    The head's `curves` are names and lengths in order; it is padded so that a browser can map an
    array onto the rest.
    """
    names = [[name, len(values)] for name, values in curves.items()]
    text = to_text({**head, "curves": names}).encode()
    text += b" " * (-len(text) % 4)
    rows = [np.asarray(values, dtype="<f4").tobytes() for values in curves.values()]
    return b"".join([struct.pack("<I", len(text)), text, *rows])


def to_text(value: Any) -> str:
    """The value as JSON, with null for NaN and infinity."""
    return json.dumps(finite(value), allow_nan=False)


def finite(value: Any) -> Any:
    """The value for JSON, with None for NaN and infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return value
