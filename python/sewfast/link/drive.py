"""`Drive`: a motor drive behind a port; `connect` opens it."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, suppress
from types import TracebackType
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..control.controller import Controller, SampledController
from ..control.machine import RecordedRun, Watch
from ..control.position import Playing, PositionController
from ..control.stops import WAYS, Way, position_of
from ..errors import LinkError, SettingError
from ..gains import real
from ..live import ViewKind
from ..recording import Recording
from ..speed import Method
from ..units import counts_of
from . import run as profiles
from . import wire
from .connection import ClockBounds, Connection, DeviceReset, Loan
from .plan import (
    Layout,
    Outcome,
    Plan,
    Sink,
    channels,
    count,
    fitting,
    gains,
    layout,
    limit,
    moves,
    other_kind,
    require_capable,
    require_near,
    require_positions,
)
from .ports import Unique, open_port
from .record import excite, follow
from .run import Run, await_measurement, wait_for_rest
from .wire import Channel, Identity, Kind, Limits, Status

PATIENCE = 3.0


_Drive = TypeVar("_Drive", bound="Drive")


class Drive(Unique):
    """A motor drive behind a port, made by `connect`; leaving its context stops the motor.

    It is a `sewfast.Machine`.

    One thread uses it; `stop` and `close` can be called from another one and end its run. Only
    `stream`, and what calls it, starts a motor.

    Parameters
    ----------
    link : Connection
        Greeted; the drive closes it.
    """

    def __init__(self, link: Connection) -> None:
        self._link = link
        self._channels = channels(link)
        #: Outcome of the last run, even of one that ended in an exception.
        self.outcome: Outcome | None = None
        self._run: Run | None = None
        await_measurement(link)

    @classmethod
    def open(
        cls: type[_Drive],
        url: str,
        *,
        baud: int = 115_200,
        watchdog: float | None = None,
        resume: float = 1.0,
    ) -> _Drive:
        """As `connect`, for a subclass."""
        if watchdog is not None and not 0.001 <= real("watchdog", watchdog) <= 10.0:
            raise SettingError(
                name="watchdog", expected=".001 to 10 s", received=f"{watchdog}",
                remedy=".1 suits most",
            )  # fmt: skip
        if not 0.0 <= real("resume", resume) < math.inf:
            raise SettingError(
                name="resume", expected="0 s or more", received=f"{resume}", remedy="1 suits most"
            )
        port = open_port(url, baud)
        try:
            return cls(Connection(port, watchdog=watchdog, patience=PATIENCE, resume=resume))
        except BaseException:
            port.close()
            raise

    def __enter__(self: _Drive) -> _Drive:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.stop()
        except DeviceReset:
            # a reset motor has no command, and the run has raised this error already
            pass
        except LinkError:
            if error is None:
                raise
        finally:
            self.close()

    def close(self) -> None:
        """Close the port and send the device nothing; its watchdog ends what it runs."""
        self._link.close()

    # --- what it is -------------------------------------------------------------------------------

    @property
    def identity(self) -> Identity:
        """The device's name, firmware and capabilities."""
        return self._link.identity

    @property
    def name(self) -> str:
        """The device's name for itself."""
        return self.identity.name

    @property
    def Ts(self) -> float:
        """Sample time [s]."""
        return self.identity.Ts

    @property
    def counts_per_rev(self) -> float:
        """Encoder counts per turn."""
        return self.identity.counts_per_rev

    @property
    def volt(self) -> float:
        """Largest command in either direction [V]: the limit in force, read from the device."""
        return self.limits().values[0]

    @property
    def speed(self) -> float:
        """Speed above which it trips [RPM]: the limit in force, read from the device."""
        return self.limits().values[1]

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels that it can stream."""
        return self._channels

    @property
    def clock(self) -> ClockBounds | None:
        """Bounds on the clocks' difference; None on credit, where there is no wall clock."""
        return None if self.identity.on_credit else self._link.clock.bounds()

    def __str__(self) -> str:
        i = self.identity
        names = ", ".join(f"{c.name} [{c.unit}]" if c.unit else c.name for c in self.channels)
        return (
            f"{i.name} (firmware {i.firmware}) on {self._link.port.url}: {i.Ts * 1e3:g} ms, "
            f"{i.counts_per_rev:g} counts/rev; {names}"
        )

    def status(self) -> Status:
        """Ask the device for its status.

        Raises
        ------
        LinkError
            If the port or the device fails, as from every method.
        """
        return self._link.status()

    def echo(self, data: bytes = b"") -> float:
        """Time until up to 200 bytes come back [s]."""
        sent = time.monotonic()
        if self._link.ask(Kind.ECHO, data) != data:
            raise LinkError(
                name=self._link.port.url, expected="the bytes sent to ECHO", received="others",
                remedy="fix the firmware",
            )  # fmt: skip
        return time.monotonic() - sent

    # --- limits, controller, states ---------------------------------------------------------------

    def limits(self) -> Limits:
        """The limits in force and the device's ceilings."""
        return wire.limits(self._link.ask(Kind.LIMITS, wire.set_limits((0.0,) * 4)))

    def set_limits(
        self,
        *,
        volt: float | None = None,
        speed_rpm: float | None = None,
        acceleration: float | None = None,
        current: float | None = None,
    ) -> Limits:
        """Set limits that the device enforces at every sample until a reset or a new session.

        Parameters
        ----------
        volt, speed_rpm, acceleration, current : float or None
            Largest magnitudes [V, RPM, RPM/s, A]; None keeps the present limit, or takes the
            device's ceiling if none is set.

        Raises
        ------
        SettingError
            For a limit that is not above 0 or is above the device's ceiling.
        """
        present = self.limits()
        given = {
            "volt": volt, "speed_rpm": speed_rpm, "acceleration": acceleration, "current": current
        }  # fmt: skip
        values = [
            limit(name, value, now, ceiling)
            for (name, value), now, ceiling in zip(
                given.items(), present.values, present.ceilings, strict=True
            )
        ]
        return wire.limits(self._link.ask(Kind.LIMITS, wire.set_limits(values)))

    def require_positions(self) -> None:
        """Raise `SettingError` for a device that has no positions; the message says how to update
        it.
        """
        require_positions(self.identity)

    def travel(self) -> tuple[int, int]:
        """Least and greatest count that the device allows during a run."""
        self.require_positions()
        low, high, *_ = wire.travel(self._link.ask(Kind.TRAVEL, wire.set_travel(0, 0)))
        return low, high

    def set_travel(self, low: int, high: int) -> None:
        """Set the least and the greatest count that the device allows during a run, until a reset
        or a new session. They are those of its counter (`status().counts`), which goes on from run
        to run: beyond them it trips, and refuses goals.

        Raises
        ------
        SettingError
            For a device without positions, and for limits that are no counts, that leave no room,
            or that are beyond the device's own.
        """
        self.require_positions()
        given = (count("low", low), count("high", high))
        *_, least, greatest = wire.travel(self._link.ask(Kind.TRAVEL, wire.set_travel(0, 0)))
        # 0 and 0 would only ask the device
        if not least <= given[0] < given[1] <= greatest:
            raise SettingError(
                name="travel", expected=f"a least count below the greatest, within {least} to "
                f"{greatest}, the device's own", received=f"{given[0]} to {given[1]}",
            )  # fmt: skip
        self._link.ask(Kind.TRAVEL, wire.set_travel(*given))

    def set_controller(self, controller: SampledController) -> None:
        """Load a controller into the device; its encoder is the device's own.

        Raises
        ------
        SettingError
            Where sample time or units are not the device's, or the moves of a position loop are
            beyond its limits.
        """
        if isinstance(controller, PositionController):
            self.require_positions()
            playing = Playing.of(controller)
            body = moves(playing, self.identity, self.limits())
            self.set_controller(playing.speed)
            self._link.ask(Kind.POSITION, body)
            return
        if not isinstance(controller, Controller):
            self._link.ask(Kind.CONTROLLER, other_kind(controller, self.channels, self.identity))
            return
        body = gains(controller, self.channels, self.identity)
        self._link.ask(Kind.GAINS, body)
        # GAINS removes both
        if controller.biquads:
            self._link.ask(Kind.BIQUADS, wire.biquads(controller.sections()))
        if controller.feedforward is not None:
            self._link.ask(Kind.FEEDFORWARD, wire.feedforward(*controller.feedforward.core()))

    def arm(self) -> None:
        """Make it ready to start; if the host falls silent, its watchdog returns it to idle."""
        self._link.ask(Kind.ARM, wire.arm(self._link.watchdog_us, self._link.identity.key))

    def stop(self) -> None:
        """Set command 0 and disable the drive immediately; return when the device has confirmed it.

        A run in another thread is cancelled; then this returns when the motor is at rest.
        """
        self._link.stop()

    def clear(self) -> None:
        """Clear a trip, once its cause is known; the device is idle afterwards."""
        self._link.ask(Kind.CLEAR)

    def wait_for_rest(self, timeout: float = 10.0) -> None:
        """Wait until the encoder has not moved for a while.

        Parameters
        ----------
        timeout : float
            Longest wait [s], of the device's time where it runs on credit.

        Raises
        ------
        LinkError
            If the motor still moves after that.
        """
        wait_for_rest(self._link, timeout)

    def upload(
        self, values: object, *, what: Literal["commands", "references"] = "commands"
    ) -> int:
        """Load the start of a profile into the idle device.

        Parameters
        ----------
        values : array, shape (N,)
            Commands [V] or references [RPM].

        Returns
        -------
        int
            Number of values that fitted; `stream` sends the rest during the run.
        """
        if what not in ("commands", "references"):
            raise SettingError(
                name="what", expected="'commands' or 'references'", received=repr(what)
            )
        plan = Plan("commands", values)  # type: ignore[arg-type]
        run = Run(
            self._link, plan, Layout(self.channels[:2], 1), self._profile(what, plan), _NullSink()
        )
        run.upload()
        assert run.profile is not None
        return run.profile.end

    def layout(self, plan: Plan) -> Layout:
        """The channels that a run of `plan` would stream, and the number of samples in a frame.

        Raises
        ------
        SettingError
            If the baud rate is too low for the columns asked for; it names those to leave out.
        """
        baud = math.inf if self.identity.on_credit else self._link.port.max_rate
        return layout(plan, self.channels, self.identity, baud)

    def columns(self, plan: Plan) -> dict[str, str]:
        """Names and units of the columns that a run of `plan` will stream; moves nothing.

        Raises
        ------
        SettingError, LinkError
            If `stream` would refuse the plan.
        """
        require_capable(plan, self.identity)
        self._profile_of(plan)
        self._require_idle()
        return {c.name: c.unit for c in self.layout(plan).channels}

    # --- runs -------------------------------------------------------------------------------------

    def stream(self, plan: Plan, sink: Sink, *, cancel: threading.Event | None = None) -> Outcome:
        """Run a plan and hand every sample to `sink` as it arrives.

        Waits for rest, uploads, arms, starts and takes samples until the end. On any error,
        including Ctrl-C, it first sends STOP and waits for the motor to come to rest, then raises
        the error. `outcome` describes the run even then.

        Parameters
        ----------
        plan : Plan
        sink : Sink
        cancel : threading.Event or None
            Set it in another thread to stop the run; that is no error.

        Returns
        -------
        Outcome
            A trip is an outcome: `state` is "tripped" and `reason` is its cause.

        Raises
        ------
        SettingError
            Before anything moves: no limits set, values beyond them, too many columns for the baud
            rate, a mode or controller that the device does not offer.
        LinkError
            If port or device fails.
        """
        with self._link.owned():
            return self._stream(plan, sink, cancel)

    def excite(
        self,
        u: NDArray[np.float64],
        name: str = "array",
        *,
        method: Method = "kalman",
        file: str | os.PathLike[str] | None = None,
        live: str | ViewKind = "none",
        settings: Mapping[str, Any] | None = None,
        overwrite: bool = False,
        cancel: threading.Event | None = None,
    ) -> Recording:
        """Apply commands from rest and record; `sewfast.record` calls this for a drive.

        Parameters
        ----------
        u : array, shape (N,)
            Commands at the device's sample time [V].
        name : str
            Of the excitation, in messages and files.
        method, file, live, settings, overwrite, cancel
            As for `sewfast.record`.

        Raises
        ------
        SettingError, LinkError, Interrupted
            As for `sewfast.record`.
        """
        return excite(
            self, u, name, method=method, file=file, live=live, settings=settings,
            overwrite=overwrite, cancel=cancel,
        )  # fmt: skip

    def follow(
        self,
        controller: SampledController,
        r: NDArray[np.float64],
        name: str = "reference",
        *,
        file: str | os.PathLike[str] | None = None,
        live: str | ViewKind = "none",
        overwrite: bool = False,
        watch: Watch | None = None,
        cancel: threading.Event | None = None,
    ) -> RecordedRun:
        """Run a controller on the device along a reference; `sewfast.run` calls this for a drive.

        Parameters
        ----------
        controller : Controller, StateFeedback or PositionController
        r : array, shape (N,)
            Reference at the device's sample time [y]; for positions goals [counts], from where the
            run begins (`stop_at` and `follow_positions` are the way to it).
        name : str
            Of the reference, in messages and reports.
        file, live, overwrite, cancel
            As for `sewfast.run`.
        watch : Watch, optional
            Called with the samples as they arrive; an exception from it stops the motor.

        Returns
        -------
        RecordedRun
            `y` is the speed estimated from the counts, or the true speed of a virtual drive.

        Raises
        ------
        SettingError, LinkError, Interrupted
            As for `sewfast.run`.
        """
        return follow(
            self, controller, r, name, file=file, live=live, overwrite=overwrite, watch=watch,
            cancel=cancel,
        )  # fmt: skip

    def stop_at(self, angle: str, *, way: Way = "onward", zero: float = 0.0) -> None:
        """Begin the stop of a run now: for another thread while `sewfast.stop_at` follows its
        reference, or for the `watch` of that run.

        It returns at once. The stop begins with the next sample that the device takes after it has
        heard of it; the run goes on to its planned end, holds the shaft and tells this sample as
        its `start`.

        Parameters
        ----------
        angle, way, zero
            As for `sewfast.stop_at`; they replace those that the run began with.

        Raises
        ------
        SettingError
            Without a run of `sewfast.stop_at`, once its stop was asked for or within two watchdog
            times of its own; for an angle without a unit or beyond what a device can hold.
        """
        value, unit = position_of(angle)
        if way not in WAYS:
            raise SettingError(name="way", expected=" or ".join(WAYS), received=repr(way))
        counts = real("zero", zero) + counts_of(value, unit, self.counts_per_rev)
        require_near(counts)
        if (run := self._run) is None:
            raise SettingError(
                name="stop_at", expected="a run of a stop at an angle", received="no run",
                remedy="begin one in another thread: sewfast.stop_at(controller, drive, ...)",
            )  # fmt: skip
        run.stop_at(counts, way == "onward")

    def _stream(self, plan: Plan, sink: Sink, cancel: threading.Event | None) -> Outcome:
        self._run = run = self._prepare(plan, sink)
        try:
            return self._ran(run, cancel)
        finally:
            self._run = None

    def _ran(self, run: Run, cancel: threading.Event | None) -> Outcome:
        try:
            run.upload()
            wanted = cancel is None or not cancel.is_set()
            if wanted:
                run.begin()
            self.outcome = run.finish() if wanted and run.pump(cancel) else run.abort(None)
        except BaseException as error:
            self.outcome = run.abort(error)
            if not isinstance(error, KeyboardInterrupt):
                # after Ctrl-C a person waits, the output is off, and the next run waits for rest
                self._settle()
            raise
        if self.outcome.reason == "cancelled":
            self._settle()
        return self.outcome

    def _prepare(self, plan: Plan, sink: Sink) -> Run:
        require_capable(plan, self.identity)
        profile = self._profile_of(plan)
        streamed = self.layout(plan)
        self._require_idle()
        if plan.controller is not None:
            self.set_controller(plan.controller)
        self.wait_for_rest()
        self._require_travel(plan)
        self.outcome = None
        return Run(self._link, plan, streamed, profile, sink)

    def prepare_direct(self, plan: Plan, controller: Controller) -> Layout:
        """Check and prepare a run whose commands `controller` computes on the host; wait for rest.

        Raises
        ------
        SettingError
            If the device takes no direct commands, or the controller has other units.
        LinkError
            If the device is not idle or its motor does not come to rest.
        """
        require_capable(plan, self.identity)
        fitting(controller, self.channels)
        streamed = self.layout(plan)
        self._require_idle()
        self.wait_for_rest()
        self._require_travel(plan)
        return streamed

    def lent(self) -> AbstractContextManager[Loan]:
        """Lend the port and the session's numbers to a loop outside the interpreter."""
        return self._link.lent()

    @property
    def watchdog(self) -> float:
        """Time that the device runs on without a frame from this host [s]."""
        return self._link.watchdog

    def _profile_of(self, plan: Plan) -> _core.LinkUpload | None:
        tables = {"controller": "references", "positions": "goals"}
        profile = self._profile(tables.get(plan.mode, "commands"), plan)
        return None if plan.mode == "direct" else profile

    def _profile(self, what: str, plan: Plan) -> _core.LinkUpload:
        limits = self.limits()
        if not limits.are_set:
            raise SettingError(
                name="limits",
                expected="those of motor and machine, set in this session",
                received="none",
                remedy="set them first: drive.set_limits(volt=..., speed_rpm=..., ...)",
            )
        if what == "references":
            return profiles.references(plan.values, limits)
        if what == "goals":
            return profiles.goals(plan.values)
        return profiles.commands(plan.values, self.channels[1], limits)

    def _require_idle(self) -> None:
        status = self.status()
        if status.state == "tripped":
            raise LinkError(
                name=self._link.port.url, expected="an idle device",
                received=f"one that has tripped: {status.reason}",
                remedy="find out why, then clear it (drive.clear())",
            )  # fmt: skip
        if status.state in ("armed", "running"):
            self.stop()

    def _require_travel(self, plan: Plan) -> None:
        """Refuse a run that would trip where it begins, and goals beyond the limits."""
        if not self.identity.capabilities & wire.POSITIONS:
            return
        low, high = self.travel()
        if (low, high) == wire.ANYWHERE:
            return
        at = self.status().counts
        if not low <= at <= high:
            raise SettingError(
                name="travel", expected=f"a counter within {low} to {high}, its limits",
                received=f"one at {at}", remedy="turn the shaft back without a command, or widen "
                "them (set_travel)",
            )  # fmt: skip
        least, most = at + float(plan.values.min()), at + float(plan.values.max())
        if plan.mode == "positions" and not (low <= least and most <= high):
            raise SettingError(
                name="goals", expected=f"within {low - at} to {high - at} counts from here, the "
                f"limits of the position ({low} to {high}; the counter is at {at})",
                received=f"{least - at:g} to {most - at:g}",
                remedy="change the goals, or widen the limits (set_travel)",
            )  # fmt: skip

    def _settle(self) -> None:
        """Wait for rest after a stop, if the device still answers."""
        if self.outcome is not None and self.outcome.state != "unknown":
            with suppress(LinkError):
                self.wait_for_rest()


class _NullSink:
    """Drops what a run delivers."""

    def samples(self, first: int, columns: object) -> None: ...

    def event(self, kind: str, index: int, **detail: object) -> None: ...


def connect(
    url: str, *, baud: int = 115_200, watchdog: float | None = None, resume: float = 1.0
) -> Drive:
    """Open a port and connect to the drive behind it; sets nothing and moves nothing.

    Parameters
    ----------
    url : str
        An address for `open_port`.
    baud : int
        Bits per second of a serial port.
    watchdog : float or None
        Time after which the device stops a motor whose host has fallen silent, .001 to 10 s. None
        is .1 s, or .25 s for a device on credit, whose computed time runs ahead by most of it.
    resume : float
        How long a run waits for a port that vanished [s]; the motor keeps turning only as long as
        `watchdog` allows.

    Returns
    -------
    Drive
        Use it in a ``with`` block: leaving it stops the motor.

    Raises
    ------
    LinkError
        If the port does not open or nothing answers; the message says what to do.
    SettingError
        For a setting outside its range.
    """
    return Drive.open(url, baud=baud, watchdog=watchdog, resume=resume)
