"""A session with a device: commands repeated until answered, heartbeats, the clocks."""

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

MAX_DRIFT = 0.1
"""What any working oscillator keeps, a microcontroller's RC included."""

RESOLUTION = 1.2e-6
"""A device's time is in whole microseconds, of its own, and rounded down."""

_Points = NDArray[np.float64]


@dataclass(frozen=True)
class ClockBounds:
    """What is certain about the device's clock.

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
        Exchanges that the bounds rest on.
    consistent : bool
        False where no offset and drift explain them all: a clock was set or jumped.
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
    """Collects exchanges: (sent, device's time, received), the device's between the others.

    Each says that the line `host(device)` passes above `sent` and below `received` there. Only the
    convex hulls of the two sets matter, so that memory stays small however long it listens.
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
    """Append to a monotone chain: the upper hull of the sent, the lower one of the received."""
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
    """Least and greatest value at 0 of such a line: at an end of the slopes or along an edge."""
    at = [np.clip(s, *slopes) for s in (*slopes, *_edges(low), *_edges(high))]
    least = min(float(np.max(low[:, 1] - s * low[:, 0])) for s in at)
    greatest = max(float(np.min(high[:, 1] - s * high[:, 0])) for s in at)
    return least, greatest


def _edges(points: _Points) -> _Points:
    steps = np.diff(points, axis=0)
    return np.asarray(steps[:, 1] / steps[:, 0])


# --- `Connection`: a session with a device, its commands, its heartbeats, its way back ------------


REPEAT = 0.1
"""Time after which a command that was not answered is sent again [s]."""
STOP_REPEAT = 0.01
"""The same for STOP, within any usual watchdog time."""
PATIENCE = 1.0
"""Time after which a command is given up, where the watchdog's is not longer [s]."""
ATTEMPTS = 10
"""Times that a command is sent at least before it is given up."""
WATCHDOG = 0.1
WATCHDOG_ON_CREDIT = 0.25
RETRY = 0.05
"""Time between two attempts to open a port that vanished [s]."""
HALTED_WITHIN = 30.0
"""Longest wait for another thread's run to end; it waits for rest after its STOP [s]."""
SILENCE = 0.02
"""Longest wait for bytes in one turn [s]; Ctrl-C and cancelling are seen at least as often."""


@dataclass
class _Command:
    """A command under way, with its attempts."""

    kind: int
    sequence: int
    frame: bytes
    first_sent: float
    last_sent: float
    since: float
    """From when on its patience counts: anew after the port was away."""
    heard: int
    """Intact frames that had come by then."""
    attempts: int = 1
    reply: Reply | None = None


@dataclass
class Loan:
    """A port and its session in other hands: the descriptor, the session, the last numbers used."""

    descriptor: int
    session: int
    command: int
    heartbeat: int


class Connection(Unique):
    """A session with the device behind a port; one thread uses it.

    Everything happens in `turn`: one read, what came is handed on, what is due is sent. A port that
    fails shows in the next turn, so that sending never raises.

    Parameters
    ----------
    port : Port
        Open; the connection closes it.
    watchdog : float or None
        Time that the device goes on without a word from here [s]; None for the usual.
    patience : float
        How long to wait for the first answer [s]; many boards restart when their port opens.
    resume : float
        How long to try to get a vanished port back during a run [s].

    Raises
    ------
    LinkError
        Where nothing answers, or what answers speaks otherwise.
    """

    def __init__(
        self, port: Port, *, watchdog: float | None, patience: float, resume: float
    ) -> None:
        self.port = port
        self._owner = threading.RLock()
        self.receiver = _core.LinkReceiver()
        self.resume = resume
        self.session = secrets.randbelow(2**32 - 1) + 1
        self.clock = Clock()
        self.events: deque[Event] = deque(maxlen=256)
        #: Greatest time of the device that any of its frames told [us].
        self.newest = 0
        #: When any of its frames came last.
        self.heard = -math.inf
        #: Called at the end of each turn; a run takes its samples there and sends heartbeats.
        self.each_turn: Callable[[], None] | None = None
        #: Whether a vanished port is to be opened again.
        self.resumable = False
        #: Another thread has asked for the end of the run under way.
        self.halted = False
        #: Seconds that the port was away, each time.
        self.outages: list[float] = []
        self._sequence = 0
        self._beats = 0
        self._command: _Command | None = None
        self._failed: LinkError | None = None
        self._greeting: Reply | None = None
        self._tag: int | None = None
        self._bytes = 0
        self._is_closed = self._is_lent = False
        self.identity = self._greet(patience)
        self._tag = self.identity.tag
        usual = WATCHDOG_ON_CREDIT if self.identity.on_credit else WATCHDOG
        self.watchdog = usual if watchdog is None else watchdog
        self.watchdog_us = round(self.watchdog * 1e6)
        if self._greeting is not None:
            # what waited in the port may have been of another boot
            self.newest = self._greeting.time_us

    # --- turns ----------------------------------------------------------------------------------

    def turn(self, wait: float = SILENCE) -> bool:
        """Read once, waiting at most `wait` seconds, hand on what came, send what is due.

        Returns
        -------
        bool
            Whether anything came.

        Raises
        ------
        LinkError
            Where the port is lost for good, the device has been reset, or a command stays without
            an answer.
        """
        came = False
        try:
            if self._failed is not None:
                raise self._failed
            came = self._hear(wait)
        except LinkError as error:
            self._recover(error)
        if self._command is not None:
            self._repeat(self._command)
        if self.each_turn is not None:
            self.each_turn()
        return came

    def _hear(self, wait: float) -> bool:
        data = self.port.read(wait)
        if not data:
            return False
        self._bytes += len(data)
        received = time.monotonic()
        foreign = None
        for kind, tag, _, device_us, body in self.receiver.feed(data):
            if self._tag is not None and tag != self._tag:
                foreign = tag
            else:
                self._take(kind, device_us, body, received)
        if foreign is not None:
            self._failed = DeviceReset(
                f"{self.port.url}: expected the device to go on, it has been reset; its motor is "
                "without command: check its power supply, connect again, set the limits and start "
                "anew"
            )
            raise self._failed
        return True

    def _take(self, kind: int, device_us: int, body: bytes, received: float) -> None:
        self.heard = received
        self.newest = max(self.newest, device_us)
        if kind == wire.EVENT:
            event = wire.event(device_us, body)
            if event is not None:
                self.events.append(event)
        elif wire.REPLY < kind < wire.SAMPLES:
            answer = wire.reply(kind, device_us, body)
            if answer is not None:
                self._answered(*answer, received)

    def _answered(self, sequence: int, reply: Reply, received: float) -> None:
        if reply.kind == Kind.HELLO:
            if wire.greets(reply, self.session):
                self._greeting = reply
            return
        command = self._command
        if command is None or sequence != command.sequence or reply.kind != command.kind:
            return
        command.reply = reply
        if not self.identity.on_credit:
            self.clock.add(command.first_sent, reply.time_us, received)

    # --- commands -------------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether a command is under way."""
        return self._command is not None

    def begin(self, kind: Kind, body: bytes = b"") -> None:
        """Send a command and return; turns repeat it until `answer` has its reply."""
        assert self._command is None, "one command at a time"
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        frame = self._frame(kind, self._sequence, body)
        now = time.monotonic()
        self._command = _Command(kind, self._sequence, frame, now, now, now, self._frames)
        self._send(frame)

    def answer(self) -> Reply | None:
        """The reply to the command under way, once; None as long as there is none."""
        if self._command is None or self._command.reply is None:
            return None
        reply, self._command = self._command.reply, None
        return reply

    @contextmanager
    def owned(self) -> Iterator[None]:
        """The connection for this thread alone; a second one is refused, not made to wait.

        Raises
        ------
        SettingError
            Where another thread uses it: their frames and replies would mix.
        """
        if not self._owner.acquire(blocking=False):
            raise SettingError(
                "expected one thread to use a drive, a second one used it at the same time; to "
                "end a run from another thread, set the event that `stream` takes as cancel"
            )
        try:
            yield
        finally:
            self._owner.release()

    def request(self, kind: Kind, body: bytes = b"") -> Reply:
        """Send a command and take turns until it is answered.

        Raises
        ------
        LinkError
            Where no answer comes or the port fails; a refusal is a reply.
        SettingError
            Where another thread uses the connection.
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
                self.turn(STOP_REPEAT if kind == Kind.STOP else SILENCE)
        except BaseException:
            self._command = None
            raise
        return reply

    def ask(self, kind: Kind, body: bytes = b"") -> bytes:
        """The body of a command's reply.

        Raises
        ------
        LinkError
            As `request`, and where the device refuses.
        """
        return self.request(kind, body).checked()

    def status(self) -> wire.Status:
        """Ask the device how it is."""
        return wire.status(self.request(Kind.STATUS))

    def stop(self) -> None:
        """STOP, at once, whatever is under way; returns when the device has confirmed it.

        From another thread it ends the run there, which says STOP by itself, and waits for that.

        Raises
        ------
        LinkError
            Where it was not confirmed: then the device's watchdog stops the motor.
        SettingError
            Where a loop on the host uses the connection, which is ended by Ctrl-C.
        """
        self._halt()
        with self.owned():
            self._command = None
            # what an interrupted write has left is closed by a zero
            self._send(b"\0")
            self.ask(Kind.STOP)

    def _halt(self) -> None:
        """Have the thread that uses the connection end its run; nothing where that is this one."""
        if self._owner.acquire(blocking=False):
            self._owner.release()
            return
        if self._is_lent:
            return
        self.halted = True
        try:
            if self._owner.acquire(timeout=HALTED_WITHIN):
                self._owner.release()
        finally:
            self.halted = False

    def _repeat(self, command: _Command) -> None:
        now = time.monotonic()
        pause = STOP_REPEAT if command.kind == Kind.STOP else REPEAT
        if command.reply is not None or now - command.last_sent < pause:
            return
        # a host that was not given the processor for a while has waited, but not asked
        if now - command.since >= self._patience and command.attempts >= ATTEMPTS:
            self._command = None
            raise self._unanswered(command, now)
        command.attempts += 1
        command.last_sent = now
        self._send(command.frame)

    @property
    def _patience(self) -> float:
        """No less than the watchdog time: STOP is repeated for as long as the motor may turn."""
        return max(PATIENCE, self.watchdog)

    @property
    def _frames(self) -> int:
        return self.receiver.counters["frames"]

    def _unanswered(self, command: _Command, now: float) -> LinkError:
        others = self._frames - command.heard
        heard = "nor anything else; check cable and device"
        if others > 0:
            heard = (
                f"but {others} other frames: it receives nothing, or is too busy to answer; "
                "see `sewfast doctor`"
            )
        return LinkError(
            f"{self.port.url}: expected an answer to {Kind(command.kind).name}, none came within "
            f"{now - command.since:.2g} s to {command.attempts} attempts, {heard}, then connect "
            "again"
        )

    # --- heartbeats -----------------------------------------------------------------------------

    def keep(self) -> None:
        """Tell the device that the host is there."""
        self._beat(Kind.KEEP, wire.keep(self.watchdog_us))

    def drive(self, u: float) -> None:
        """The command of a direct run [V]; a heartbeat too."""
        self._beat(Kind.DRIVE, wire.drive(self.watchdog_us, u))

    def grant(self, until: int) -> None:
        """Let the time of a device on credit advance to `until` [us]; a heartbeat too."""
        self._beat(Kind.CREDIT, wire.credit(self.watchdog_us, until))

    def let_pass(self, us: int) -> None:
        """Grant time to a device on credit; take turns for as long with another."""
        if self.identity.on_credit:
            self.grant(self.newest + us)
            return
        until = time.monotonic() + us * 1e-6
        while (rest := until - time.monotonic()) > 0.0:
            self.turn(rest)

    def _beat(self, kind: Kind, body: bytes) -> None:
        self._beats = (self._beats + 1) & 0xFFFFFFFF
        self._send(self._frame(kind, self._beats, body))

    def _frame(self, kind: Kind, sequence: int, body: bytes) -> bytes:
        told = wire.host_time(self.session, time.monotonic_ns() // 1000)
        return _core.link_frame(kind, self._tag or 0, sequence, told, body)

    def _send(self, frame: bytes) -> None:
        if self._failed is None:
            try:
                self.port.write(frame)
            except LinkError as error:
                self._failed = error

    @contextmanager
    def lent(self) -> Iterator[Loan]:
        """The port and the session's numbers for someone else, who leaves those he reached."""
        loan = Loan(self.port.fileno(), self.session, self._sequence, self._beats)
        self._command = None
        try:
            with self.owned():
                self._is_lent = True
                yield loan
        except BaseException:
            # numbers may have been used that were not left here: a STOP with one of those is old
            loan.command += 2**16
            loan.heartbeat += 2**24
            raise
        finally:
            self._is_lent = False
            self._sequence = loan.command & 0xFFFFFFFF
            self._beats = loan.heartbeat & 0xFFFFFFFF
            # what the device has sent meanwhile is not missing
            self.receiver = _core.LinkReceiver()

    # --- greeting and return --------------------------------------------------------------------

    def _greet(self, patience: float) -> Identity:
        """HELLO until it is answered; the same session again changes nothing on the device."""
        frame = b"\0" + _core.link_frame(Kind.HELLO, 0, 0, 0, wire.hello(self.session))
        deadline = time.monotonic() + patience
        self._greeting, expected = None, self._tag
        # a device that was reset meanwhile is to be heard too
        self._tag = None
        try:
            while self._greeting is None:
                if time.monotonic() >= deadline:
                    raise self._nobody(patience)
                self.port.write(frame)
                again = time.monotonic() + REPEAT
                while self._greeting is None and time.monotonic() < again:
                    self._hear(SILENCE)
        finally:
            self._tag = expected
        return wire.identity(self._greeting.checked())

    def _nobody(self, patience: float) -> LinkError:
        heard = "nothing came"
        remedy = "check cable, supply and that the firmware speaks this protocol (docs/PROTOCOL.md)"
        if self.receiver.counters["echoed"]:
            heard = "only what was sent came back"
            remedy = "check whether transmit and receive are connected to each other"
        elif self._bytes:
            heard = f"{self._bytes} bytes arrived that are not frames for this host"
            remedy = f"check the baud rate ({self.port.baud}) and what runs on the device"
        return LinkError(
            f"{self.port.url}: expected a device to answer HELLO within {patience:g} s, {heard}; "
            f"{remedy}"
        )

    def _recover(self, error: LinkError) -> None:
        """Open the port again and confirm the session; the device may have gone on meanwhile."""
        if not self.resumable or self._is_closed or isinstance(error, DeviceReset):
            raise error
        self._failed = None
        lost = time.monotonic()
        identity = self._return(lost, error)
        if identity.boot != self.identity.boot:
            self._failed = DeviceReset(
                f"{error}; it came back, but the device has been reset meanwhile: connect again, "
                "set the limits and start anew"
            )
            raise self._failed
        now = time.monotonic()
        self.outages.append(now - lost)
        if self._command is not None:
            self._command.since = now

    def _return(self, lost: float, error: LinkError) -> Identity:
        while not self._is_closed:
            try:
                self.port.reopen(max(RETRY, lost + self.resume - time.monotonic()))
                if self._is_closed:
                    self.port.close()
                return self._greet(REPEAT)
            except LinkError as failed:
                if time.monotonic() - lost + RETRY > self.resume:
                    raise LinkError(
                        f"{error}; it did not come back within {self.resume:g} s: the device stops "
                        f"its motor {self.watchdog:g} s after the last heartbeat"
                    ) from failed
            time.sleep(RETRY)
        raise error

    def close(self) -> None:
        """Give the port back; a run under way in another thread does not open it again."""
        self._is_closed = True
        self.port.close()


class DeviceReset(LinkError):
    """The device has lost its run and its limits; no way leads back into this session."""
