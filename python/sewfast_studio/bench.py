"""The process that owns the port: it runs a page's requests, and stops when the page is silent.

The server sends lines of JSON and receives frames (`session.packed`). It is a separate process,
so that no work of the server can hold up the heartbeats of a drive. The motor stops if

- a page asks for it: at once, whatever else is running;
- the page that armed the drive has not answered for `LEASE`;
- the pipe from the server ends: the server was closed or killed;
- this process dies or hangs: then the drive's own watchdog stops it.
"""

from __future__ import annotations

import json
import math
import os
import queue
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from sewfast.errors import Interrupted, LinkError, SettingError
from sewfast.link.drive import Drive
from sewfast.live import Feed

from .words import error_text

if TYPE_CHECKING:
    from sewfast.dataset import FloatArray
    from sewfast.link.plan import Outcome, Plan, Sink

LEASE = 0.5
"""Time without an answer of the page after which an armed drive is stopped [s]."""

FRAME = 1.0 / 60.0
"""Time between two batches of live samples [s]."""

LOOK = 0.2
"""Time between two status requests to a drive at rest [s]."""

LAST_WORDS = 10.0
"""Time for a stopped run to close its file after the server has ended [s]."""

STOPPED = "Stopped; what was recorded until then is kept"

Send = Callable[..., None]


class SeenDrive(Drive):
    """A drive that runs only while armed, and shows its running samples to the page."""

    #: Time of the last confirmed stop, before the motor is at rest.
    off_at = -math.inf
    bench: Bench

    def stream(self, plan: Plan, sink: Sink, *, cancel: threading.Event | None = None) -> Outcome:
        """Run a plan if the drive is armed."""
        bench = self.bench
        bench.require_armed()
        columns = {c.name: c.unit for c in self.layout(plan).channels}
        per_rev = self.identity.counts_per_rev or None
        feed = Feed(columns, self.identity.Ts, len(plan.values), bench.job, counts_per_rev=per_rev)
        bench.begin(feed)
        try:
            return super().stream(plan, _Both(sink, feed), cancel=bench.cancel)
        finally:
            feed.close()
            bench.show()

    def _settle(self) -> None:
        self.off_at = time.monotonic()
        if not self.bench.is_left:  # nobody is there to hear that the motor is at rest
            super()._settle()


class _Both:
    """Passes samples to the page's feed and to a sink."""

    def __init__(self, sink: Sink, feed: Feed) -> None:
        self._sink, self._feed = sink, feed

    def samples(self, first: int, columns: Mapping[str, FloatArray]) -> None:
        self._feed.put(first, columns)
        self._sink.samples(first, columns)

    def event(self, kind: str, index: int, **detail: object) -> None:
        self._sink.event(kind, index, **detail)


class Bench:
    """The state of the process: the drive, whether it is armed, the last answer of the page.
    `send(message, curves=None)` sends a message to the server. It can block, so while the motor
    turns only the thread that shows samples calls it.
    """

    def __init__(self, send: Send) -> None:
        self.send = send
        self.work: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self.drive: SeenDrive | None = None
        self.cancel = threading.Event()
        self.job = ""
        self.is_left = False
        self._armed = False
        self._alive = -math.inf
        self._go = threading.Event()
        self._feed: Feed | None = None
        self._shown = self._runs = 0
        self._showing = threading.Lock()

    # --- Arming and stopping ----------------------------------------------------------------------

    def require_armed(self) -> None:
        """Raise `SettingError` unless the drive is armed."""
        if not self._armed:
            raise SettingError("expected an armed drive, it is not; press Arm first")

    def alive(self, age: float) -> None:
        """Note that the page has answered a message sent `age` seconds ago."""
        self._alive = max(self._alive, time.monotonic() - age)

    def watch(self) -> None:
        """Stop an armed drive whose page has fallen silent; runs in its own thread."""
        while True:
            time.sleep(0.02)
            if self._armed and time.monotonic() - self._alive > LEASE:
                self.stop(f"the page did not answer for {LEASE * 1e3:.0f} ms")

    def stop(self, why: str) -> None:
        """Set command 0 and disable the drive first, then report it."""
        began = time.monotonic()
        was = self._armed or bool(self.job)
        self._armed = False
        self.cancel.set()
        self._go.set()
        drive, error = self.drive, ""
        while drive is not None:
            try:
                drive.stop()
            except SettingError:  # the other thread is using the connection
                time.sleep(0.002)
                continue
            except LinkError as e:
                error = f"{e}; the drive's watchdog stops it"
            break
        now = time.monotonic()
        off = drive.off_at if drive is not None and drive.off_at >= began else now
        self.send({
            "event": "stopped", "why": why, "moving": was, "error": error,
            "off_ms": 1e3 * (off - began), "rest_ms": 1e3 * (now - began),
        })  # fmt: skip

    # --- Messages of the server -------------------------------------------------------------------

    def listen(self, lines: BinaryIO) -> None:
        """Take the server's messages until its pipe ends; runs in its own thread."""
        for line in lines:
            asked = json.loads(line)
            name = asked["do"]
            if name == "alive":
                self.alive(asked["age"])
            elif name == "stop":
                self.stop(asked["why"])
            elif name == "go":
                self._go.set()
            else:
                self.work.put(asked)
        self.is_left = True
        self.stop("the server is gone")
        self.work.put(None)
        time.sleep(LAST_WORDS)
        os._exit(1)

    def serve(self) -> None:
        """Carry out the requests one after the other until the server's pipe ends."""
        try:
            while True:
                try:
                    asked = self.work.get(timeout=LOOK)
                except queue.Empty:
                    self._look()
                    continue
                if asked is None:
                    break
                self._answer(asked)
        finally:
            if self.drive is not None:
                self.drive.close()

    def _answer(self, asked: dict[str, Any]) -> None:
        number, name = asked.pop("id"), asked.pop("do")
        try:
            found = {"found": getattr(self, f"_do_{name}")(**asked)}
        except Exception as e:
            found = {"error": error_text(e)}
        self._look()
        self.send({"answer": number, **found})

    def _do_connect(self, port: str, baud: int, watchdog: float | None) -> None:
        if self.drive is not None:
            raise SettingError("expected no drive, one is connected; disconnect it first")
        drive = SeenDrive.open(port, baud=baud, watchdog=watchdog)
        drive.bench = self
        self.drive = drive

    def _do_disconnect(self) -> None:
        self._armed = False
        if self.drive is not None:
            drive, self.drive = self.drive, None
            try:
                drive.stop()
            finally:
                drive.close()

    def _do_limits(self, **limits: float | None) -> None:
        self._connected().set_limits(**limits)

    def _do_clear(self) -> None:
        self._connected().clear()

    def _do_arm(self) -> None:
        drive = self._connected()
        if not drive.limits().are_set:
            raise SettingError("expected limits on the drive, none are set; set them first")
        status = drive.status()
        if status.state == "tripped":
            raise SettingError(
                f"expected an idle drive, it has tripped: {status.reason}; find out why, then Clear"
            )
        self._alive = time.monotonic()
        self._armed = True

    def _do_disarm(self) -> None:
        self._armed = False

    def _connected(self) -> SeenDrive:
        if self.drive is None:
            raise SettingError("expected a drive, none is connected; connect one first")
        return self.drive

    def _look(self) -> None:
        """Ask the drive for its status and send it."""
        drive, state = self.drive, {"connected": False, "armed": False, "job": self.job}
        if drive is not None:
            try:
                status, limits = drive.status(), drive.limits()
                state = {
                    "connected": True, "armed": self._armed, "job": self.job,
                    "name": drive.identity.name, "port": drive._link.port.url,
                    "state": status.state, "reason": status.reason, "speed": status.speed_rpm,
                    "watchdog": drive.watchdog, "limits": list(limits.values),
                    "ceilings": list(limits.ceilings), "Ts": drive.identity.Ts,
                    "received": status.received, "dropped": status.dropped,
                }  # fmt: skip
            except SettingError:
                # another thread is stopping the drive, and reports the result
                return
            except LinkError as e:
                self._armed, self.drive = False, None
                drive.close()
                state["error"] = str(e)
        self.send({"event": "drive", **state})

    # --- Runs -------------------------------------------------------------------------------------

    def _do_work(self, kind: str, folder: str, **asked: Any) -> None:
        """Carry out a record, run or commissioning; its end is an event."""
        from . import driving

        self.cancel = threading.Event()
        try:
            # check after creating the event: a stop from here on shows in one or the other
            self.require_armed()
            drive, self.job = self._connected(), kind
            self._look()
            found: dict[str, Any] = {
                "found": getattr(driving, kind)(drive, Path(folder), self, **asked)
            }
        except (KeyboardInterrupt, Interrupted):
            found = {"error": STOPPED}
        except Exception as e:
            # the stopping thread may hold the port, so that the last request of a run is refused
            met = isinstance(e, SettingError) and self.cancel.is_set()
            found = {"error": STOPPED if met else error_text(e)}
            # a person must look at a trip or a lost port before anything moves again
            self._armed = self._armed and not isinstance(e, LinkError)
        self.job = ""
        self.show()
        self._look()
        self.send({"event": "driven", "kind": kind, **found})

    def progress(self, done: int, total: int, stage: str) -> None:
        """Report a stage of a commissioning."""
        self.send({
            "event": "progress", "of": "driven", "done": done, "total": total, "best": stage
        })  # fmt: skip

    def wait_for_go(self) -> None:
        """Wait until a person lets it go on, or the drive is stopped."""
        self._go.clear()
        while not (self._go.wait(0.1) or self.cancel.is_set()):
            pass

    # --- Live samples -----------------------------------------------------------------------------

    def begin(self, feed: Feed) -> None:
        """Announce the samples of another run."""
        with self._showing:
            self._feed, self._shown = feed, 0
            self._runs += 1
        self.send({"event": "begin", "run": self._runs, **feed.description})

    def show(self) -> None:
        """Send the samples since the last call."""
        with self._showing:
            feed = self._feed
            if feed is None:
                return
            start, stop = max(self._shown, feed.oldest), feed.end
            if stop > start:
                self.send({"event": "samples", "first": start}, feed.read(start, stop))
                self._shown = stop

    def show_always(self) -> None:
        """`show` 60 times a second; runs in its own thread."""
        with suppress(OSError):
            while True:
                time.sleep(FRAME)
                self.show()


def main() -> None:
    """Serve the process at the other end of standard input and output."""
    from .session import packed

    # keep other output out of the stream of frames
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sending = threading.Lock()

    def send(message: dict[str, Any], curves: Mapping[str, FloatArray] | None = None) -> None:
        body = packed(message, curves or {})
        with sending, suppress(BrokenPipeError):  # the server has ended, as `listen` notices too
            out.write(struct.pack("<I", len(body)) + body)
            out.flush()

    bench = Bench(send)
    for run in (lambda: bench.listen(sys.stdin.buffer), bench.watch, bench.show_always):
        threading.Thread(target=run, daemon=True).start()
    bench.serve()


if __name__ == "__main__":
    main()
