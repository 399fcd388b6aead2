"""The server's client of the process that owns a drive's port (`bench`)."""

from __future__ import annotations

import itertools
import json
import math
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sewfast.errors import LinkError, SettingError
from sewfast.live import Feed

from .driving import LIMITS, Place, copies

if TYPE_CHECKING:
    from sewfast.dataset import FloatArray
    from sewfast.link import VirtualDevice

PATIENCE = 15.0
"""Longest wait for an answer of the process, which waits up to 10 s for a motor to rest [s]."""

CLOSING = 3.0
"""Time for the process to end by itself [s]."""

_PROGRAM = "import sys; sys.path[:] = {path!r}; from sewfast_studio.bench import main; main()"


class Line:
    """A drive in the process that owns its port; its recordings are in `folder`.
    `tell(event)` takes the events of the process; it is called in its own thread.
    """

    def __init__(self, folder: Path, tell: Callable[[dict[str, Any]], None]) -> None:
        self.folder, self._tell = folder, tell
        self.state: dict[str, Any] = {"event": "drive", "connected": False, "armed": False}
        self._program: subprocess.Popen[bytes] | None = None
        self._ear: threading.Thread | None = None
        self._device: VirtualDevice | None = None
        self._place = Place("")
        self._work: tuple[str, dict[str, Any]] | None = None
        self._writing, self._lock = threading.Lock(), threading.RLock()
        self._numbers = itertools.count()
        self._waiting: dict[int, Future[dict[str, Any]]] = {}
        self._feed: Feed | None = None
        self._run = 0

    @property
    def is_connected(self) -> bool:
        return bool(self.state["connected"])

    @property
    def may_move(self) -> bool:
        """Whether the motor turns or can be started."""
        return bool(self.state["armed"]) or self._work is not None

    # --- The process ------------------------------------------------------------------------------

    def _started(self) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._program is None or self._program.poll() is not None:
                self._program = subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM.format(path=sys.path)],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    # keep Ctrl-C for the server, whose end stops the motor
                    start_new_session=True,
                )  # fmt: skip
                self._ear = threading.Thread(target=self._hear, args=(self._program,), daemon=True)
                self._ear.start()
            return self._program

    def _write(self, message: dict[str, Any]) -> None:
        program = self._program
        if program is None or program.stdin is None:
            return
        with self._writing, suppress(OSError, ValueError):
            program.stdin.write(json.dumps(message).encode() + b"\n")
            program.stdin.flush()

    def _ask(self, name: str, **asked: Any) -> Any:
        self._started()
        number = next(self._numbers)
        future = self._waiting[number] = Future()
        self._write({"do": name, "id": number, **asked})
        try:
            answer = future.result(PATIENCE)
        except NoAnswer:
            raise LinkError(
                f"expected an answer about the drive within {PATIENCE:g} s, received none; press "
                "STOP, see to cable and supply, then connect again"
            ) from None
        finally:
            self._waiting.pop(number, None)
        if "error" in answer:
            raise SettingError(answer["error"])
        return answer["found"]

    def _hear(self, program: subprocess.Popen[bytes]) -> None:
        assert program.stdout is not None
        with program.stdout as pipe:
            while len(head := pipe.read(4)) == 4:
                self._take(pipe.read(struct.unpack("<I", head)[0]))
        program.wait()
        with suppress(OSError):
            assert program.stdin is not None
            program.stdin.close()
        self._lost()

    def _take(self, body: bytes) -> None:
        if not body:
            return
        length = struct.unpack_from("<I", body)[0]
        message = json.loads(body[4 : 4 + length])
        if "answer" in message:
            waiting = self._waiting.get(message["answer"])
            if waiting is not None:
                waiting.set_result(message)
            return
        event = message["event"]
        if event == "samples":
            self._put(message, np.frombuffer(body, "<f4", offset=4 + length))
            return
        del message["curves"]
        if event == "begin":
            columns = {k: v for k, v in message["columns"].items() if k != "counts"}
            speed = {"speed": "RPM"} if message["counts_per_rev"] else {}
            feed = Feed({**columns, **speed}, message["Ts"], message["n"], message["title"])
            self._feed, self._run = feed, message["run"]
            return
        if event == "drive":
            self.state = message
            # limits are in single precision on the wire; null is infinity, which JSON lacks
            given = {
                name: math.inf if value is None else float(f"{value:.7g}")
                for name, value in zip(LIMITS, message.get("limits", ()), strict=False)
            }
            self._place = replace(self._place, limits=given)
        if event == "stopped":
            self.state = {**self.state, "armed": False}
        if event == "driven":
            if "found" in message and self._work is not None:
                message |= copies(self._work[0], self._place, self._work[1])
            self._work = None
        self._tell(message)

    def _put(self, head: dict[str, Any], values: FloatArray) -> None:
        feed = self._feed
        if feed is None:
            return
        names, lengths = zip(*head["curves"], strict=True)
        parts = np.split(values, np.cumsum(lengths)[:-1])
        feed.put(head["first"], dict(zip(names, parts, strict=True)))

    def _lost(self) -> None:
        """The process has ended; the drive's watchdog stops a running motor."""
        self.state = {"event": "drive", "connected": False, "armed": False}
        self._work = None
        error = {"error": "the process at the port has ended; connect again"}
        for waiting in list(self._waiting.values()):
            with suppress(Exception):  # answered meanwhile
                waiting.set_result(error)
        self._tell({**self.state, **error})

    def release(self) -> None:
        """End the pipe to the process, which then stops the motor and ends."""
        program = self._program
        if program is not None:
            with self._writing, suppress(OSError):
                assert program.stdin is not None
                program.stdin.close()

    def close(self) -> None:
        """Wait for the end of the process."""
        self.release()
        program = self._program
        if program is not None:
            try:
                program.wait(CLOSING)
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()
            if self._ear is not None:
                self._ear.join(CLOSING)
        if self._device is not None:
            self._device.stop()

    # --- Requests of the page ---------------------------------------------------------------------

    def stop(self, why: str) -> None:
        """Set command 0 and disable the drive, ahead of everything else."""
        self._write({"do": "stop", "why": why})

    def alive(self, age: float) -> None:
        """Pass on that the page that armed the drive has answered."""
        self._write({"do": "alive", "age": age})

    def go(self) -> None:
        """Let a waiting commissioning go on."""
        self._write({"do": "go"})

    def connect(self, port: str, baud: int = 115_200, watchdog: float | None = None) -> None:
        """Open a port; ``virtual[:SEED]`` is a virtual drive served by this process."""
        from sewfast.link import VirtualDevice

        with self._lock:
            if self.is_connected:
                raise SettingError("expected no drive, one is connected; disconnect it first")
            place = Place(port, baud, watchdog)
            if self._device is not None:
                self._device.stop()
                self._device = None
            if place.is_virtual:
                self._device = VirtualDevice(port)
            self._place = place
            url = port if self._device is None else self._device.port
            self._ask("connect", port=url, baud=baud, watchdog=watchdog)

    def disconnect(self) -> None:
        """Stop the motor and close the port."""
        if self._program is not None:
            self._ask("disconnect")

    def limits(self, **limits: float | None) -> None:
        """Set the drive's limits; None is its own ceiling."""
        self._ask("limits", **limits)

    def arm(self) -> None:
        """Allow runs for as long as the page answers."""
        self._ask("arm")

    def disarm(self) -> None:
        """Allow no more runs."""
        self._ask("disarm")

    def clear(self) -> None:
        """Clear a trip."""
        self._ask("clear")

    def work(self, kind: str, **asked: Any) -> None:
        """Start a record, run or commissioning; its end is the event ``driven``.
        Raises `SettingError` if the drive is not armed, or busy.
        """
        with self._lock:
            if not self.is_connected:
                raise SettingError("expected a drive, none is connected; connect one first")
            if not self.state["armed"]:
                raise SettingError("expected an armed drive, it is not; press Arm first")
            if self._work is not None:
                raise SettingError(
                    name="drive", expected="one at rest", received="one at work",
                    remedy="stop it or wait for its end",
                )  # fmt: skip
            self._work = (kind, asked)
        place = {"kind": kind, "folder": str(self.folder)}
        self._write({"do": "work", "id": next(self._numbers), **place, **asked})

    def live(self, seconds: float, columns: int) -> tuple[dict[str, Any], dict[str, FloatArray]]:
        """The newest samples to draw: lowest and highest of each of `columns` pieces. Return a head
        and the curves, ``NAME_low`` and ``NAME_high`` for each column, with the times ``t`` [s].
        """
        feed = self._feed
        if feed is None:
            return {"run": 0}, {}
        end = feed.end
        n = min(math.ceil(seconds / feed.Ts), feed.window)
        # pieces begin at multiples of their length, so that a moving curve does not flicker
        step = max(1, math.ceil(n / columns))
        start = max(0, end - n) // step * step
        head = {
            "run": self._run, "title": feed.title, "n": feed.n, "end": end, "gaps": feed.gaps,
            "missing": feed.missing, "columns": feed.columns, "received": feed.received,
        }  # fmt: skip
        if end <= start:
            return head, {}
        values = feed.read(start, end)
        starts = np.arange(0, end - start, step)
        curves: dict[str, FloatArray] = {"t": np.asarray((start + starts) * feed.Ts)}
        for name, column in values.items():
            curves[f"{name}_low"] = np.fmin.reduceat(column, starts)
            curves[f"{name}_high"] = np.fmax.reduceat(column, starts)
        return head, curves
