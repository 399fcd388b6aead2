"""`Connection`: a session with the device behind a port: its turns, commands and recovery."""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..errors import LinkError, SettingError
from . import wire
from .ports import Port, Unique
from .wire import Event, Identity, Kind, Reply

RETRY = 0.05
"""Time between two attempts to open a port that vanished [s]."""
SILENCE = 0.02
"""Longest wait for bytes in one turn [s]; Ctrl-C and cancelling are checked at least as often."""


@dataclass
class Loan:
    """A port and its session, lent out: descriptor, session, last sequence numbers used."""

    descriptor: int
    session: int
    command: int
    heartbeat: int


class Connection(Unique):
    """A session with the device behind an open port, which it closes; one thread uses it.
    Everything happens in `turn`; the next turn raises a failure of the port, so sending never
    raises. Times are in [s]: the device runs on for `watchdog` without a frame from this host, the
    first answer may take `patience` (many boards restart when their port opens), and a port lost
    during a run is tried again for `resume`. Raises `LinkError` without an answer in this protocol.
    """

    def __init__(
        self, port: Port, *, watchdog: float | None, patience: float, resume: float
    ) -> None:
        self.port = port
        self._owner = threading.RLock()
        self.resume = resume
        self.session = secrets.randbelow(2**32 - 1) + 1
        self._client = _core.LinkClient(self.session)
        self.clock = Clock()
        self.events: deque[Event] = deque(maxlen=256)
        #: Called at the end of each turn; a run collects samples and sends heartbeats there.
        self.each_turn: Callable[[], None] | None = None
        #: Whether to reopen a port that vanished.
        self.resumable = False
        #: Whether another thread has asked to end the current run.
        self.halted = False
        #: Duration of each loss of the port [s].
        self.outages: list[float] = []
        self._reply: Reply | None = None
        self._greeting: Reply | None = None
        self._failed: LinkError | None = None
        self._bytes = 0
        self._is_closed = self._is_lent = False
        self.identity = self._greet(patience)
        usual = 0.25 if self.identity.on_credit else 0.1
        self.watchdog = usual if watchdog is None else watchdog
        self.watchdog_us = round(self.watchdog * 1e6)
        self._client.set_watchdog(self.watchdog_us)

    @property
    def receiver(self) -> _core.LinkClient:
        """The session's samples, counters and anomalies."""
        return self._client

    @property
    def newest(self) -> int:
        """Latest device time in any of its frames [us]."""
        return self._client.newest

    @property
    def heard(self) -> float:
        """Host time of the last frame received [s]."""
        heard = self._client.heard
        return -math.inf if heard is None else 1e-6 * heard

    # --- turns ----------------------------------------------------------------------------------

    def turn(self, wait: float = SILENCE) -> bool:
        """Read once, waiting at most `wait` seconds, hand on what arrived, send what is due.
        Return whether anything arrived. Raises `LinkError` if the port is lost for good, the device
        was reset, or a command is not answered.
        """
        came = False
        try:
            if self._failed is not None:
                raise self._failed
            came = self._hear(wait)
        except LinkError as error:
            self._recover(error)
        given_up = self._client.expire(_now_us())
        if given_up is not None:
            raise self._unanswered(*given_up)
        self._transmit()
        if self.each_turn is not None:
            self.each_turn()
        return came

    def _hear(self, wait: float) -> bool:
        due = self._client.due
        if due is not None:
            wait = min(wait, max(0.0, 1e-6 * due - time.monotonic()))
        data = self.port.read(wait)
        if not data:
            return False
        self._bytes += len(data)
        received = time.monotonic()
        replies, events, same_boot = self._client.receive(_now_us(), data)
        self.events.extend(wire.event(*event) for event in events)
        for kind, result, detail, body, device_us, sent_us in replies:
            self._take(Reply(kind, result, detail, body, device_us), 1e-6 * sent_us, received)
        if not same_boot:
            self._failed = DeviceReset(
                f"{self.port.url}: expected the device to go on, it has been reset; its motor is "
                "without command: check its power supply, connect again, set the limits and start "
                "anew"
            )
            raise self._failed
        return True

    def _take(self, reply: Reply, sent: float, received: float) -> None:
        if reply.kind == Kind.HELLO:
            self._greeting = reply
            return
        self._reply = reply
        if not self.identity.on_credit:
            self.clock.add(sent, reply.time_us, received)

    # --- commands -------------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether a command is pending, or its reply has not been fetched."""
        return self._reply is not None or self._client.is_busy

    def begin(self, kind: Kind, body: bytes = b"") -> None:
        """Send a command and return at once; turns repeat it until its reply arrives."""
        assert not self.is_busy, "one command at a time"
        self._client.begin(kind, body)
        self._transmit()

    def answer(self) -> Reply | None:
        """The reply to the pending command, once; None while there is none."""
        reply, self._reply = self._reply, None
        return reply

    def _forget(self) -> None:
        self._reply = None
        self._client.forget()

    @contextmanager
    def owned(self) -> Iterator[None]:
        """Use the connection from this thread alone; refuse a second one: frames would mix."""
        if not self._owner.acquire(blocking=False):
            raise SettingError(
                name="drive", expected="one thread that uses it",
                received="a second one at the same time",
                remedy="to end a run from another thread, set the event that `stream` takes as "
                "cancel",
            )  # fmt: skip
        try:
            yield
        finally:
            self._owner.release()

    def request(self, kind: Kind, body: bytes = b"") -> Reply:
        """Send a command and take turns until it is answered.
        Raises `LinkError` if no answer arrives or the port fails (a refusal is a reply), and
        `SettingError` if another thread uses the connection.
        """
        with self.owned():
            return self._request(kind, body)

    def _request(self, kind: Kind, body: bytes) -> Reply:
        while self.is_busy:
            self.turn()
            self.answer()
        self.begin(kind, body)
        try:
            while (reply := self.answer()) is None:
                self.turn()
        except BaseException:
            self._forget()
            raise
        return reply

    def ask(self, kind: Kind, body: bytes = b"") -> bytes:
        """The body of a command's reply; `LinkError` as `request`, and if the device refuses."""
        return self.request(kind, body).checked()

    def status(self) -> wire.Status:
        return wire.status(self.request(Kind.STATUS))

    def stop(self) -> None:
        """Send STOP at once; return when the device has confirmed it. Called from another thread,
        it ends that thread's run, which sends STOP itself, and waits for it. Raises `LinkError` if
        STOP was not confirmed: then the device's watchdog stops the motor. Raises `SettingError` if
        a loop on the host uses the connection; Ctrl-C ends that one.
        """
        self._halt()
        with self.owned():
            self._forget()
            # a zero ends the frame that an interrupted write left unfinished
            self._send(b"\0")
            self.ask(Kind.STOP)

    def _halt(self) -> None:
        """Make the thread that uses the connection end its run; do nothing if it is this one."""
        if self._owner.acquire(blocking=False):
            self._owner.release()
            return
        if self._is_lent:
            return
        self.halted = True
        try:
            # longest wait for another thread's run to end; after its STOP it waits for rest [s]
            if self._owner.acquire(timeout=30.0):
                self._owner.release()
        finally:
            self.halted = False

    def _unanswered(self, kind: int, attempts: int, waited_us: int, others: int) -> LinkError:
        heard, remedy = "nothing at all", "check cable and device"
        if others > 0:
            heard = f"{others} other frames"
            remedy = "the device receives nothing or is too busy: see `sewfast doctor`"
        return LinkError(
            name=self.port.url, expected=f"an answer to {Kind(kind).name}",
            received=f"{heard} within {1e-6 * waited_us:.2g} s of {attempts} attempts",
            remedy=f"{remedy}, then connect again",
        )  # fmt: skip

    # --- heartbeats -----------------------------------------------------------------------------

    def keep(self) -> None:
        """Send a heartbeat."""
        self._send(self._client.keep(_now_us()))

    def drive(self, u: float) -> None:
        """Send the command of a direct run [V]; it is a heartbeat too."""
        self._send(self._client.drive(_now_us(), u))

    def grant(self, until: int) -> None:
        """Let the time of a device on credit advance to `until` [us]; it is a heartbeat too."""
        self._send(self._client.grant(_now_us(), min(until, wire.LATEST)))

    def let_pass(self, us: int) -> None:
        """Let the device's time advance by `us`: grant it on credit, take turns in real time."""
        if self.identity.on_credit:
            self.grant(self.newest + us)
            return
        until = time.monotonic() + us * 1e-6
        while (rest := until - time.monotonic()) > 0.0:
            self.turn(rest)

    def _transmit(self) -> None:
        """Send the pending command if it is new or due to be repeated."""
        frame = self._client.transmit(_now_us())
        if frame:
            self._send(frame)

    def _send(self, frame: bytes) -> None:
        if self._failed is None:
            try:
                self.port.write(frame)
            except LinkError as error:
                self._failed = error

    @contextmanager
    def lent(self) -> Iterator[Loan]:
        """Lend the port and the session's sequence numbers; the borrower leaves its last ones."""
        loan = Loan(self.port.fileno(), self.session, *self._client.sequences)
        self._forget()
        try:
            with self.owned():
                self._is_lent = True
                yield loan
        except BaseException:
            # the borrower may have used more numbers than it left: skip ahead of them all, as the
            # device would take a STOP with a used number for an old one
            loan.command += 2**16
            loan.heartbeat += 2**24
            raise
        finally:
            self._is_lent = False
            self._client.go_on(loan.command & 0xFFFFFFFF, loan.heartbeat & 0xFFFFFFFF)

    # --- greeting and recovery ------------------------------------------------------------------

    def _greet(self, patience: float) -> Identity:
        """Repeat HELLO until it is answered; with the same session it changes nothing there."""
        self._greeting = None
        self._client.greet(round(1e6 * patience))
        try:
            while self._greeting is None:
                if self._client.expire(_now_us()) is not None:
                    raise self._nobody(patience)
                frame = self._client.transmit(_now_us())
                if frame:
                    self.port.write(frame)
                self._hear(SILENCE)
        finally:
            self._client.end_greeting()
        return wire.identity(self._greeting.checked())

    def _nobody(self, patience: float) -> LinkError:
        heard = "nothing"
        remedy = "check cable, supply and that the firmware speaks this protocol (docs/PROTOCOL.md)"
        if self._client.counters["echoed"]:
            heard = "only what was sent"
            remedy = "check whether transmit and receive are connected to each other"
        elif self._bytes:
            heard = f"{self._bytes} bytes that are not frames for this host"
            remedy = f"check the baud rate ({self.port.baud}) and what runs on the device"
        return LinkError(
            name=self.port.url, expected=f"a device that answers HELLO within {patience:g} s",
            received=heard, remedy=remedy,
        )  # fmt: skip

    def _recover(self, error: LinkError) -> None:
        """Reopen the port and confirm the session; the device may have run on meanwhile."""
        if not self.resumable or self._is_closed or isinstance(error, DeviceReset):
            raise error
        self._failed = None
        lost = time.monotonic()
        identity = self._return(lost, error)
        if identity.boot != self.identity.boot:
            self._failed = DeviceReset(
                name=self.port.url, expected="the device as it was",
                received=f"one that has been reset meanwhile ({error})",
                remedy="connect again, set the limits and start anew",
            )  # fmt: skip
            raise self._failed
        self.outages.append(time.monotonic() - lost)

    def _return(self, lost: float, error: LinkError) -> Identity:
        while not self._is_closed:
            try:
                self.port.reopen(max(RETRY, lost + self.resume - time.monotonic()))
                if self._is_closed:
                    self.port.close()
                # longest wait for the answer to one HELLO on a reopened port [s]
                return self._greet(0.1)
            except LinkError as failed:
                if time.monotonic() - lost + RETRY > self.resume:
                    raise LinkError(
                        name=self.port.url, expected=f"the port back within {self.resume:g} s",
                        received=error.received or str(error),
                        remedy=f"the device stops its motor {self.watchdog:g} s after the last "
                        "heartbeat",
                    ) from failed  # fmt: skip
            time.sleep(RETRY)
        raise error

    def close(self) -> None:
        """Close the port; a run in another thread does not reopen it."""
        self._is_closed = True
        self.port.close()


def _now_us() -> int:
    """The session's clock [us]."""
    return time.monotonic_ns() // 1000


class DeviceReset(LinkError):
    """The device has lost its run and its limits; this session cannot go on."""


# --- Bounds on the device's clock from the exchanges with it --------------------------------------


MAX_DRIFT = 0.1
"""Drift that every working oscillator stays within, a microcontroller's RC oscillator included."""

RESOLUTION = 1.2e-6
"""A device counts whole microseconds of its own clock, rounded down [s, with the drift]."""

_Points = NDArray[np.float64]


@dataclass(frozen=True)
class ClockBounds:
    """Bounds on the difference between the host's and the device's clock.

    Host time is `at + offset + (1 + drift) * (device time - at)`, with `at` the device's time of
    the last exchange.

    Parameters
    ----------
    at_us : int
        Device's time at the last exchange [us].
    offset_s : (float, float)
        Host time (a monotonic clock) less device time then [s].
    drift_ppm : (float, float)
        How much faster the host's clock runs [1e-6].
    exchanges : int
        Exchanges that the bounds are from.
    consistent : bool
        False if no offset and drift explain them all: a clock was set or jumped.
    """

    at_us: int
    offset_s: tuple[float, float]
    drift_ppm: tuple[float, float]
    exchanges: int
    consistent: bool

    def __str__(self) -> str:
        if not self.consistent:
            return f"the clocks contradict each other over {self.exchanges} exchanges"
        low, high = self.drift_ppm
        width = (self.offset_s[1] - self.offset_s[0]) * 1e6
        return f"clock known within {width:.0f} us, drift {low:.0f} to {high:.0f} ppm"


class Clock:
    """Collects exchanges (sent, device's time, received). The device's time lies between the two
    host times, so the line `host(device)` passes above `sent` and below `received` there. Only the
    convex hulls of the two sets matter, so memory stays small in a session of any length.
    """

    def __init__(self) -> None:
        self._low: list[tuple[float, float]] = []
        self._high: list[tuple[float, float]] = []
        self._exchanges = 0

    def add(self, sent: float, device_us: int, received: float) -> None:
        """An exchange: host times [s] and the device's time in its reply [us]."""
        device = device_us * 1e-6
        if self._low and device < self._low[-1][0]:
            return
        _extend(self._low, (device, sent - RESOLUTION), 1.0)
        _extend(self._high, (device, received), -1.0)
        self._exchanges += 1

    def bounds(self) -> ClockBounds | None:
        """The tightest bounds that all exchanges allow; None before the first."""
        if not self._low:
            return None
        last = self._low[-1][0]
        at = round(last * 1e6)
        low = np.array(self._low) - (last, 0.0)
        high = np.array(self._high) - (last, 0.0)
        slopes = _slopes(low, high)
        if slopes[0] > slopes[1]:
            unknown = (-np.inf, np.inf)
            return ClockBounds(at, unknown, unknown, self._exchanges, False)
        offset = _offsets(low, high, slopes)
        drift = ((slopes[0] - 1.0) * 1e6, (slopes[1] - 1.0) * 1e6)
        offset = (offset[0] - last, offset[1] - last)
        return ClockBounds(at, offset, drift, self._exchanges, True)


def _extend(hull: list[tuple[float, float]], point: tuple[float, float], side: float) -> None:
    """Append to a monotone chain: the upper hull of `sent`, the lower hull of `received`."""
    while len(hull) >= 2 and side * _turn(hull[-2], hull[-1], point) >= 0.0:
        hull.pop()
    if hull and hull[-1][0] == point[0]:
        if side * (hull[-1][1] - point[1]) >= 0.0:
            return
        hull.pop()
    hull.append(point)


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _slopes(low: _Points, high: _Points) -> tuple[float, float]:
    """Least and greatest slope of a line above all of `low` and below all of `high`."""
    dx = high[None, :, 0] - low[:, None, 0]
    dy = high[None, :, 1] - low[:, None, 1]
    if np.any((dx == 0.0) & (dy < 0.0)):
        return 1.0, 0.0
    later, earlier = dx > 0.0, dx < 0.0
    greatest = min(1.0 + MAX_DRIFT, *(dy[later] / dx[later]).tolist(), 1.0 + MAX_DRIFT)
    least = max(1.0 - MAX_DRIFT, *(dy[earlier] / dx[earlier]).tolist(), 1.0 - MAX_DRIFT)
    return least, greatest


def _offsets(low: _Points, high: _Points, slopes: tuple[float, float]) -> tuple[float, float]:
    """Least and greatest value at 0 of such a line: at an extreme slope, or an edge of a hull."""
    at = [np.clip(s, *slopes) for s in (*slopes, *_edges(low), *_edges(high))]
    least = min(float(np.max(low[:, 1] - s * low[:, 0])) for s in at)
    greatest = max(float(np.min(high[:, 1] - s * high[:, 0])) for s in at)
    return least, greatest


def _edges(points: _Points) -> _Points:
    steps = np.diff(points, axis=0)
    return np.asarray(steps[:, 1] / steps[:, 0])
