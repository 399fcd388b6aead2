"""Pages without a browser: a socket that gave its token, and one that answers as a page does."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sewfast_studio import Studio

websockets = pytest.importorskip("websockets.sync.client")

EVIL = '<script>document.title="run"</script>'
"""Name of a column, which a page must show and not run."""

FOLDS = """
document.querySelectorAll("main details:not(.menu, #loop-fold)").forEach(d => { d.open = true; });
"""


NUMBER = """
const rows = [...document.querySelectorAll('#numbers tr')];
const row = rows.find(r => r.cells[0].textContent === arguments[0]);
return row && row.cells[1].textContent;
"""


class Page:
    """A socket that gave its token."""

    def __init__(self, studio: Studio, token: str | None = None, **headers: Any) -> None:
        origin = headers.pop("origin", f"http://127.0.0.1:{studio.port}")
        place = f"ws://127.0.0.1:{studio.port}/socket"
        self._left = contextlib.ExitStack()
        self._meanwhile: list[dict[str, Any]] = []
        self.socket = self._left.enter_context(websockets.connect(place, origin=origin, **headers))
        self.socket.send(studio.token if token is None else token)

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *error: object) -> None:
        self._left.close()

    def hear(self, wanted: Callable[[dict[str, Any]], bool], timeout: float = 30) -> dict[str, Any]:
        until = time.monotonic() + timeout
        while True:
            heard = unpacked(self.socket.recv(timeout=until - time.monotonic()))
            if wanted(heard):
                return dict(heard)

    def event(self, name: str) -> dict[str, Any]:
        """The next event of this name, which may have come before the answer to the last `ask`."""
        for i, heard in enumerate(self._meanwhile):
            if heard.get("event") == name:
                return self._meanwhile.pop(i)
        return self.hear(lambda m: m.get("event") == name)

    def ask(self, do: str, **asked: Any) -> dict[str, Any]:
        self._meanwhile.clear()

        def is_answer(heard: dict[str, Any]) -> bool:
            if heard.get("id") != 7:
                self._meanwhile.append(heard)
            return heard.get("id") == 7

        self.socket.send(json.dumps({"id": 7, "do": do, **asked}))
        return self.hear(is_answer)


class Watching:
    """A page that answers beats unless it is `frozen`; it keeps what it hears."""

    def __init__(self, studio: Any) -> None:
        self._page = Page(studio)
        self._heard: list[dict[str, Any]] = []
        self._more = threading.Condition()
        self._number = 100
        self.frozen = False
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self) -> Watching:
        return self

    def __exit__(self, *error: object) -> None:
        self._page.__exit__()

    def close(self) -> None:
        self._page.__exit__()

    def _listen(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            for message in self._page.socket:
                heard = unpacked(message)
                if heard.get("event") == "beat":
                    if not self.frozen:
                        self.send("alive", n=heard["n"])
                    continue
                with self._more:
                    self._heard.append(heard)
                    self._more.notify_all()

    def send(self, do: str, **asked: Any) -> None:
        self._page.socket.send(json.dumps({"do": do, **asked}))

    def ask(self, do: str, timeout: float = 60.0, **asked: Any) -> dict[str, Any]:
        self._number += 1
        number = self._number
        self._page.socket.send(json.dumps({"id": number, "do": do, **asked}))
        return self.hear(lambda m: m.get("id") == number, timeout)

    def event(self, name: str, timeout: float = 60.0, **fields: Any) -> dict[str, Any]:
        """The oldest event of that name that was not taken yet."""
        return self.hear(
            lambda m: m.get("event") == name and all(m.get(k) == v for k, v in fields.items()),
            timeout,
        )

    def hear(self, wanted: Callable[[dict[str, Any]], bool], timeout: float) -> dict[str, Any]:
        until = time.monotonic() + timeout
        with self._more:
            while True:
                for k, heard in enumerate(self._heard):
                    if wanted(heard):
                        return self._heard.pop(k)
                assert self._more.wait(until - time.monotonic()), "it was not heard"

    def armed(self, port: str, watchdog: float = 2.0, **limits: float) -> Watching:
        """Connected, limited and armed, by patience where the machine is busy."""
        # a watchdog that a busy machine keeps to: what stops the motor here is something else
        found = self.ask("drive_connect", port=port, watchdog=watchdog)
        assert "found" in found, found
        usual = {"volt": None, "speed_rpm": None, "acceleration": None, "current": None}
        assert "found" in self.ask("drive_limits", **{**usual, **limits})
        self.arm()
        return self

    def arm(self) -> None:
        until = time.monotonic() + 60.0
        while "error" in (answer := self.ask("drive_arm")):
            assert "in a row" in answer["error"], answer
            assert time.monotonic() < until
            time.sleep(0.3)


def unpacked(message: str | bytes) -> dict[str, Any]:
    if isinstance(message, str):
        return dict(json.loads(message))
    end = 4 + int.from_bytes(message[:4], "little")
    head, rest = json.loads(message[4:end]), np.frombuffer(message[end:], "<f4")
    lengths = [n for _, n in head["curves"]]
    parts = np.split(rest, np.cumsum(lengths)[:-1])
    assert [len(part) for part in parts] == lengths or not lengths
    names = [name for name, _ in head["curves"]]
    return {**head, "curves": dict(zip(names, parts, strict=True)) if names else {}}
