"""`Run`: one run on a device, from its upload to the last sample, or to its safe end."""

from __future__ import annotations

import math
import threading
import time
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._core import LinkUpload
from ..causes import turning
from ..control.position import Playing
from ..errors import LinkError, SettingError
from . import wire
from .connection import SILENCE, Connection, DeviceReset
from .plan import Columns, Layout, Outcome, Plan, Sink
from .wire import Channel, Event, Kind, Limits, Reply, Status


def commands(values: NDArray[np.float64], u: Channel, limits: Limits) -> LinkUpload:
    """Commands rounded to the device's steps. Raises `SettingError` beyond the volt limit."""
    limit = min(limits.volt, 32_767 / u.steps_per_unit)
    _require_within("commands", values, limit, u.unit)
    return LinkUpload.commands(values, u.steps_per_unit, limit)


def references(values: NDArray[np.float64], limits: Limits) -> LinkUpload:
    """References as the device stores them. Raises `SettingError` beyond the speed limit."""
    limit = min(limits.speed_rpm, wire.LARGEST)
    _require_within("references", values, limit, "RPM")
    return LinkUpload.references(values, limit)


def goals(values: NDArray[np.float64]) -> LinkUpload:
    """Goals as the device stores them. Raises `SettingError` beyond what single precision holds."""
    _require_within("goals", values, wire.FARTHEST, "counts")
    return LinkUpload.goals(values)


def _require_within(name: str, values: NDArray[np.float64], limit: float, unit: str) -> None:
    beyond = np.flatnonzero(np.abs(values) > limit * (1.0 + 1e-6))
    if len(beyond):
        k = int(beyond[0])
        raise SettingError(
            name=name, expected=f"within +-{limit:g} {unit}",
            received=f"{values[k]:g} at sample {k} and {len(beyond)} beyond in all",
            remedy="scale the signal or raise the limit (set_limits)",
        )  # fmt: skip


def _take_reply(profile: LinkUpload, reply: Reply) -> None:
    """Take the reply to an UPLOAD; raise LinkError if the device refuses the values."""
    if not profile.answered(reply.result, reply.detail, reply.body):
        wire.uploaded(reply.checked())


# --- Run ------------------------------------------------------------------------------------------


AGAIN, AT_MOST = 0.002, 0.064
"""Time after which credit is granted again if nothing arrived [s], and its upper bound: it doubles
each time, as a device that is slow to read would otherwise drown in grants, with its answers stuck
behind them."""
ARMED_SILENCE = 0.25
"""Longest silence of an armed device, which sends a frame every .2 s [s]."""
STEP_US = 20_000
ARMS_WITHIN = 10.0
"""Longest wait for a motor that still moves according to the device [s]."""
MOVING = 11
"""Result of ARM if the motor moves."""
_ENDS = ("finished", "stopped", "tripped")


def wait_for_rest(link: Connection, timeout: float) -> None:
    """Wait until the encoder has not moved for a while; see `Drive.wait_for_rest`."""
    status = link.status()
    since = began = status.time_us
    # the host's clock too: the time of a device that takes no credit stands still
    patience = timeout + (5.0 if link.identity.on_credit else 0.0)
    start, marks = time.monotonic(), list[Status]()
    # device time without a count after which a motor counts as at rest; ARM requires 100 ms
    while status.time_us - since < 120_000:
        passed, past = (status.time_us - began) * 1e-6, time.monotonic() - start
        if passed > timeout or past > patience:
            error = LinkError(
                name=link.port.url, expected=f"the motor at rest within {timeout:g} s",
                received=f"{status.speed_rpm:.0f} RPM", remedy="brake it or wait longer",
            )  # fmt: skip
            # a motor that keeps more than this share of its mean speed from the third to the last
            # quarter of the wait is driven: one that coasts loses speed
            if len(marks) == 2 and _pace(marks[1], status) > 0.99 * _pace(*marks):
                error.remedy = ""  # both are said
                error.explain(turning(status.speed_rpm, "before a run"))
            raise error
        if len(marks) < 2 and max(passed / timeout, past / patience) > (0.5, 0.75)[len(marks)]:
            marks.append(status)
        link.let_pass(STEP_US)
        before, status = status, link.status()
        if status.counts != before.counts:
            since = status.time_us


def _pace(before: Status, after: Status) -> float:
    """Counts from one status to another, over the device's time between them [1/us]."""
    return abs(after.counts - before.counts) / max(1, after.time_us - before.time_us)


def await_measurement(link: Connection) -> None:
    """Wait for the end of boot, after some good samples; a device on credit is granted time."""
    # longest wait for a booting device to finish its first measurements [s]
    deadline = time.monotonic() + 1.0
    while link.status().state == "boot" and time.monotonic() < deadline:
        link.let_pass(STEP_US)


def halted(link: Connection) -> LinkError:
    """The error if another thread ended the run before it began."""
    return LinkError(
        name=link.port.url, expected="a run to start", received="a stop from another thread"
    )


def arm_at_rest(link: Connection) -> None:
    """Repeat ARM until the device finds its motor at rest.
    The device decides, as it sees every count. The host sees only a STATUS every 20 ms: a motor
    that creeps, or swings about an edge of the encoder, can move just before ARM. Raises
    `LinkError` if it still moves after 10 s, and if the device refuses for another reason.
    """
    body = wire.arm(link.watchdog_us, link.identity.key)
    until = time.monotonic() + ARMS_WITHIN
    while (reply := link.request(Kind.ARM, body)).result == MOVING and time.monotonic() < until:
        link.let_pass(STEP_US)
        if link.halted:
            raise halted(link)
    reply.checked()


class Run:
    """One run: `upload`, `begin`, `pump`, `finish` in this order, or `abort` at any time."""

    def __init__(
        self, link: Connection, plan: Plan, layout: Layout, profile: LinkUpload | None, sink: Sink
    ) -> None:
        self.link, self.plan, self.layout, self.profile = link, plan, layout, profile
        self.sink = sink
        self.length = len(plan.values)
        self.period = link.identity.period_us
        self.run = -1
        #: The device's time of sample 0 [us]; None until it is known.
        self.start_us: int | None = None
        #: Index of the next sample.
        self.next = 0
        self.received = 0
        self.gaps: list[tuple[int, int]] = []
        self.ended = False
        #: The stop that was asked for in mid-run: its first sample, angle [counts], whether onward.
        self.stop: tuple[int, float, bool] | None = None
        self._wish: tuple[float, bool] | None = None
        self._sink_works = True
        self._last: Status | None = None
        # share of the watchdog time that a device on credit can run ahead
        self._lead = round(0.8 * link.watchdog_us)
        self._granted = self._brought = 0
        self._again = AGAIN
        self._driven = 0.0
        self._beaten = self._heard = self._asked = 0.0
        self._outages = len(link.outages)
        link.receiver.anomalies()
        self._counters = dict(link.receiver.counters)
        pause = 3.0 * layout.batch * self.period * 1e-6
        self._deaf_after = max(link.watchdog, pause)
        self._silence = 0.02 if self._on_credit else max(0.1, pause)

    @property
    def _on_credit(self) -> bool:
        return self.link.identity.on_credit

    # --- to the start -----------------------------------------------------------------------------

    def upload(self) -> None:
        """Send as much of the profile as the idle device has room for."""
        profile = self.profile
        while profile is not None and (piece := profile.piece(self._room())) is not None:
            before = profile.end
            _take_reply(profile, self.link.request(Kind.UPLOAD, piece))
            if profile.end == before:
                raise LinkError(
                    name=self.link.port.url,
                    expected=f"room for {self.link.identity.capacity} values",
                    received=f"a device that takes no more than {before}",
                    remedy="fix the firmware",
                )

    def begin(self) -> None:
        """Arm and start; the motor moves from here on."""
        link, layout = self.link, self.layout
        if link.halted:
            raise halted(link)
        link.receiver.expect([(c.encoding, c.steps_per_unit) for c in layout.channels], self.period)
        link.receiver.take()
        link.events.clear()
        link.resumable = True
        link.each_turn = self._each_turn
        arm_at_rest(link)
        playing = self.plan.controller
        if isinstance(playing, Playing) and playing.stop is not None:
            at, angle, _, onward = playing.stop
            link.ask(Kind.ANGLE, wire.angle(at, angle, onward))
        mode = wire.MODES[self.plan.mode]
        body = wire.start(mode, link.watchdog_us, 0, self.length, layout.mask, layout.batch)
        self.run, start_us = wire.started(link.ask(Kind.START, body))
        if abs(start_us - link.newest) >= 2**32:
            raise LinkError(
                name=link.port.url,
                expected=f"a start at the device's present time of {link.newest} us",
                received=f"{start_us} us", remedy="fix the firmware",
            )  # fmt: skip
        self._heard = self._asked = time.monotonic()
        self.start_us = start_us

    # --- the run ----------------------------------------------------------------------------------

    def pump(self, cancel: threading.Event | None) -> bool:
        """Take turns until the run has ended; False if it was cancelled."""
        while not self.ended:
            if self.link.halted or (cancel is not None and cancel.is_set()):
                return False
            self.link.turn(self._wait())
            reply = self.link.answer()
            if reply is not None:
                self._answered(reply)
            self._events()
            if len(self.link.outages) != self._outages:
                self._resumed()
            if not self.link.is_busy and not self.ended:
                self._ask(time.monotonic())
        return True

    def stop_at(self, counts: float, onward: bool) -> None:
        """Ask for the stop of a position loop now; for any thread. See `Drive.stop_at`."""
        playing = self.plan.controller
        own = playing.stop if isinstance(playing, Playing) else None
        going = self.start_us is not None and not self.ended
        # what is on its way is no longer than the watchdog's time, or the run trips
        near = self.next + math.ceil(2e6 * self.link.watchdog / self.period)
        for holds, received in (
            (own is not None, "a run without one"),
            (going, "one that has not begun or has ended"),
            (self._wish is None, "a stop that has been asked for already"),
            (own is not None and near < own[0], "one that begins its own stop"),
        ):
            if not holds:
                raise SettingError(
                    name="stop_at", expected="a run of a stop at an angle before this stop",
                    received=received, remedy="ask once, while stop_at(controller, drive, ...) "
                    "follows its reference",
                )  # fmt: skip
        self._wish = (counts, onward)

    def _wait(self) -> float:
        if self._on_credit:
            return AGAIN
        now = time.monotonic()
        if self._is_deaf(now):
            return SILENCE
        rest = self._beaten + self.link.watchdog / 4.0 - now
        return min(max(rest, 0.0), SILENCE)

    def _each_turn(self) -> None:
        if self.start_us is not None:
            self.collect(self.start_us)
        now = time.monotonic()
        if self._on_credit:
            self._grant(now)
        elif self._is_deaf(now):
            return
        elif now - self._beaten >= self.link.watchdog / 4.0 or self._changed():
            self._beaten = now
            self._beat()

    def _is_deaf(self, now: float) -> bool:
        """Whether the device is silent for so long that heartbeats end: its watchdog stops the
        motor.
        """
        after = self._deaf_after
        if self.start_us is None:
            after = max(after, ARMED_SILENCE)
        return now - self.link.heard > after

    def _beat(self) -> None:
        if self.plan.mode == "direct":
            self._driven = self._command()
            self.link.drive(self._driven)
        else:
            self.link.keep()

    def _changed(self) -> bool:
        return self.plan.mode == "direct" and self._command() != self._driven

    def _command(self) -> float:
        """The command that is due at the device's latest known time."""
        if self.start_us is None:
            return 0.0
        k = (self.link.newest - self.start_us) // self.period + 1
        return float(self.plan.values[min(max(k, 0), self.length - 1)])

    def _grant(self, now: float) -> None:
        if self.start_us is None:
            return
        until = self.link.newest + self._lead
        if self.profile is not None and not self.profile.is_whole:
            # the device must not run past the end of the uploaded values
            until = min(until, self.start_us + (self.profile.end - 1) * self.period)
        further = until - self._granted
        if self.link.newest > self._brought:
            self._brought, self._again = self.link.newest, AGAIN
        if 4 * further >= self._lead or now - self._beaten >= self._again:
            if further <= 0:
                self._again = min(2.0 * self._again, AT_MOST)
            self._beaten = now
            self._granted = until
            if self.plan.mode == "direct":
                self.link.drive(self._command())
            self.link.grant(until)

    def _ask(self, now: float) -> None:
        """Send the next command if one is due: a piece of the profile, or STATUS."""
        silent = now - max(self._heard, self._asked) >= self._silence
        # time between two STATUS in real time [s]; each one tightens the bounds on the clocks
        if silent or (not self._on_credit and now - self._asked >= 0.5):
            self._asked = now
            self.link.begin(Kind.STATUS)
            return
        if self._wish is not None and self.stop is None and self.next > 0:
            self.link.begin(Kind.ANGLE, wire.angle(0, *self._wish))
            return
        piece = None if self.profile is None else self.profile.piece(self._room())
        if piece is not None:
            self.link.begin(Kind.UPLOAD, piece)

    def _room(self) -> int:
        """Values that fit: one fits once the value `capacity` before it has been applied."""
        assert self.profile is not None
        return self.link.identity.capacity + self.next - self.profile.end

    def _answered(self, reply: Reply) -> None:
        if reply.kind == Kind.UPLOAD and self.profile is not None:
            _take_reply(self.profile, reply)
        if reply.result and reply.kind in (Kind.UPLOAD, Kind.ANGLE):
            # the run has ended, or the device disagrees: ask for STATUS next
            self._heard = self._asked = -math.inf
        elif reply.kind == Kind.ANGLE and self._wish is not None:
            counts, onward = self._wish
            self.stop = (wire.begins(reply.body), counts, onward)
            way = "onward" if onward else "shortest"
            self._notify("stop_at", self.stop[0], angle=counts, way=way)
        elif reply.kind == Kind.STATUS:
            self._last = wire.status(reply)
            going = self._last.run == self.run and self._last.state in ("armed", "running")
            self.ended = self.ended or not going

    def _events(self) -> None:
        while self.link.events:
            self._event(self.link.events.popleft())

    def _event(self, event: Event) -> None:
        mine = event.run == self.run
        if mine and event.name in _ENDS:
            self.ended = True
        detail = {"reason": event.reason, "state": event.state, "device_us": event.time_us}
        if math.isfinite(event.value):
            detail["value"] = event.value
        self._notify(event.name, event.samples if mine else 0, **detail)

    def _resumed(self) -> None:
        away = self.link.outages[self._outages :]
        self._outages = len(self.link.outages)
        self._notify("port_lost", self.next)
        self._notify("resumed", self.next, seconds=sum(away))
        status = self.link.status()
        mine = status.run == self.run
        if mine and status.state in ("armed", "running"):
            return
        if not mine or status.state == "tripped":
            what = f"had tripped: {status.reason}" if mine else "runs something else"
            raise LinkError(
                name=self.link.port.url,
                expected=f"the run to go on after {sum(away):.2f} s without the port",
                received=f"a device that {what}, after {status.taken} samples",
                remedy="check cable and plug, or give the watchdog more time than "
                f"{self.link.watchdog:g} s",
            )
        self.ended = True

    # --- samples ----------------------------------------------------------------------------------

    def collect(self, start_us: int) -> None:
        """Hand the received samples to the sink, one call for each stretch without a gap."""
        times, columns = self.link.receiver.take()
        n = len(times)
        if not n:
            return
        first, last = int(times[0]), int(times[-1])
        self._heard = time.monotonic()
        named = dict(zip(self.layout.names, columns, strict=True))
        if last - first == (n - 1) * self.period:
            self._deliver((first - start_us) // self.period, named)
            return
        index = (times - start_us) // self.period
        cuts = [0, *(np.flatnonzero(np.diff(index) != 1) + 1).tolist(), n]
        for a, b in pairwise(cuts):
            self._deliver(int(index[a]), {name: c[a:b] for name, c in named.items()})

    def _deliver(self, first: int, columns: dict[str, NDArray[np.float64]]) -> None:
        count = len(columns["counts"])
        if first < self.next:
            # from the run before, or repeated
            columns = {name: c[self.next - first :] for name, c in columns.items()}
            count, first = count - (self.next - first), self.next
            if count <= 0:
                return
        if first + count > self.length:
            # beyond the end of this run
            return
        if first > self.next:
            self._gap(first - self.next)
        self._hand_over(first, count, columns)

    def _hand_over(self, first: int, count: int, columns: Columns) -> None:
        self.next = first + count
        if not self._sink_works:
            # the samples arrived, but nothing keeps them
            self.gaps.append((first, count))
            return
        try:
            self.sink.samples(first, columns)
        except BaseException as error:
            # the sink may or may not have kept them: list them as missing
            self.gaps.append((first, count))
            self._sink_works = not isinstance(error, Exception)
            raise
        self.received += count

    def _gap(self, count: int) -> None:
        # step over it before notifying: after Ctrl-C in the sink it must not be listed again
        first, self.next = self.next, self.next + count
        self.gaps.append((first, count))
        self._notify("gap", first, count=count)

    def _notify(self, kind: str, index: int, **detail: object) -> None:
        if self._sink_works:
            try:
                self.sink.event(kind, index, **detail)
            except Exception:
                self._sink_works = False
                raise

    # --- the end ----------------------------------------------------------------------------------

    def finish(self, reason: str | None = None) -> Outcome:
        """Ask how many samples were taken, list those that did not arrive."""
        status = self.link.status()
        if self.start_us is not None:
            self.collect(self.start_us)
        self._events()
        self._leave()
        taken = status.taken if status.run == self.run else 0
        if taken > self.next:
            self._gap(taken - self.next)
        ended = "finished" if taken == self.length else "stopped"
        if status.state == "tripped":
            ended = status.reason
        return self._outcome(status.state, reason or ended, taken)

    def abort(self, error: BaseException | None) -> Outcome:
        """Stop the motor first, then collect what arrived; `error` is why, None if cancelled."""
        link, resume = self.link, self.link.resume
        link.each_turn = None
        # wait for a vanished port as long as the motor can still turn, to send it STOP
        link.resume = max(resume, link.watchdog)
        reason = "cancelled" if error is None else "failed"
        if isinstance(error, KeyboardInterrupt):
            reason = "interrupted"
        try:
            link.stop()
            return self._save(reason)
        except LinkError as failed:
            return self._unconfirmed(reason, failed)
        finally:
            link.resume = resume
            self._leave()

    def _save(self, reason: str) -> Outcome:
        try:
            return self.finish(reason)
        except LinkError:
            raise
        except Exception:
            # the motor has stopped, and the sink's first error is raised already
            self._sink_works = False
            return self.finish(reason)

    def _unconfirmed(self, reason: str, failed: LinkError) -> Outcome:
        try:
            if self.start_us is not None:
                self.collect(self.start_us)
            kind = "reset" if isinstance(failed, DeviceReset) else "stop_unconfirmed"
            self._notify(kind, self.next, message=str(failed))
        except Exception:
            self._sink_works = False
        return self._outcome("unknown", reason, None)

    def _leave(self) -> None:
        self.link.each_turn = None
        self.link.resumable = False

    def _outcome(self, state: str, reason: str, taken: int | None) -> Outcome:
        link = self.link
        now: dict[str, Any] = dict(link.receiver.counters)
        counters = {k: int(v) - int(self._counters.get(k, 0)) for k, v in now.items()}
        return Outcome(
            state=state, reason=reason, received=self.received, taken=taken, gaps=tuple(self.gaps),
            anomalies=tuple(link.receiver.anomalies()),
            clock=None if self._on_credit else link.clock.bounds(),
            columns=self.layout.names, batch=self.layout.batch, counters=counters, stop=self.stop,
        )  # fmt: skip
