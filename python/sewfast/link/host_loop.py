"""`run_on_host`: a controller on this computer against a drive, for slow plants."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core, signals
from ..arrays import FloatArray
from ..control.controller import Controller
from ..control.loop import reference_samples, require_controller
from ..errors import Interrupted, LinkError, SettingError
from ..units import counts_per_unit, spelled
from . import wire
from .drive import Drive
from .host_run import HostLoopRun, Jitter
from .plan import Layout, Plan
from .run import ARMS_WITHIN, MOVING
from .wire import refusal

ORDINARY = "ordinary"

_ENDS = {
    "completed": "the whole reference was run",
    "interrupted": "interrupted",
    "ended": "the device ended the run early; see `sewfast doctor` for its state",
    "silent": "no sample came within the watchdog time, so the motor was stopped; check the cable",
    "reset": "the device was reset; its motor is without command: check its power supply",
    "port_lost": "the port vanished, the device's watchdog stops the motor; check the cable",
}


def run_on_host(
    drive: Drive,
    controller: Controller,
    reference: str | ArrayLike,
    *,
    seed: int = 0,
    name: str | None = None,
    watchdog: float | None = None,
    columns: Sequence[str] | None = None,
    batch: int | None = None,
    real_time: bool = False,
    progress: Callable[[int, int, float], object] | None = None,
) -> HostLoopRun:
    """Run a controller on this computer against a drive, for slow plants.

    The drive applies the commands and guards the motor; a thread without Python computes each
    command from the newest counts. Its jitter and the link's delay are part of the loop, and of the
    result. For a fast plant, let the drive run the controller itself.

    Parameters
    ----------
    drive : Drive
        Idle, with limits set, in real time.
    controller : Controller
        Its sample time is the loop's: a whole multiple of the drive's, 2 or more; `at_period`
        converts one with another sample time.
    reference : str or array, shape (N,)
        Name of a reference (`sewfast.signals`) or its samples at the controller's sample time [y].
    seed : int
        Chooses a named random reference.
    name : str, optional
        Name of the reference in messages.
    watchdog : float, optional
        Time after which the drive stops without a command, and this computer without a sample
        [s]; by default the drive's own, but at least four periods.
    columns : sequence of str, optional
        Channels to keep besides `counts` and `u`.
    batch : int, optional
        Samples in a frame; fewer are fresher and load the link more.
    real_time : bool
        Try real-time scheduling and locked memory; `jitter.real_time` reports the result.
    progress : callable, optional
        Called with the ticks done, the total and a number to ignore.

    Returns
    -------
    HostLoopRun
        However it ended: trips and lost links are outcomes.

    Raises
    ------
    SettingError, DataError
        Before anything moves, for settings that cannot run.
    LinkError
        If the drive refuses to arm or to start, or does not answer.
    Interrupted
        On Ctrl-C, after STOP; `best` is the run so far.
    """
    call = "run_on_host(drive, controller, reference)"
    require_controller(controller, drive, call)
    if not isinstance(drive, Drive):
        raise SettingError(
            name="drive", expected="a Drive to run on", received=type(drive).__name__,
            remedy=f"connect to one, then {call}",
        )  # fmt: skip
    ratio = _ratio(drive, controller)
    r = _reference(reference, controller, seed)
    plan = Plan("direct", r, columns=columns, batch=batch or _batch(ratio))
    streamed = drive.prepare_direct(plan, controller)
    # periods that the device runs on without a command, unless its watchdog time is longer
    wait = max(drive.watchdog, 4 * controller.Ts) if watchdog is None else watchdog
    until = time.monotonic() + ARMS_WITHIN
    while True:
        with drive.lent() as session, _scheduling(real_time) as scheduling:
            found = _core.host_loop(
                session.descriptor, controller.core(), controller.early(r), tag=drive.identity.tag,
                session=session.session, key=drive.identity.key, command=session.command,
                heartbeat=session.heartbeat, device_period=drive.identity.period_us,
                ratio=ratio, watchdog=round(1e6 * wait),
                batch=streamed.batch, mask=streamed.mask,
                channels=[(c.encoding, c.steps_per_unit) for c in streamed.channels],
                counts_per_unit=_scale(drive, controller), lock_memory=real_time, progress=progress,
            )  # fmt: skip
            session.command, session.heartbeat = found["sequences"]
        # the device alone decides whether its motor rests, as in `arm_at_rest`
        if found["outcome"].get("result") != MOVING or time.monotonic() > until:
            break
        drive.wait_for_rest()
    _raise_where_it_never_ran(found["outcome"])
    label = name or (reference if isinstance(reference, str) else "reference")
    run = _run(found, drive, controller, r, streamed, scheduling, label)
    if run.outcome == "interrupted":
        raise Interrupted(run)
    return run


def at_period(controller: Controller, Ts: float) -> Controller:
    """The same controller at a longer sample time, its feedback averaged over the same time.

    The gains stay the same in standard form; a feedforward, whose taps are for one sample time, is
    left out. A loop that is stable at its own sample time may be
    unstable at a longer one: try it on a model first.

    Parameters
    ----------
    Ts : float
        Sample time [s].
    """
    samples = max(1, round(controller.filter_samples * controller.Ts / Ts))
    note = f"made for {controller.Ts:g} s, run at {Ts:g} s"
    note += ", without its feedforward" if controller.feedforward else ""
    notes = f"{controller.notes}; {note}" if controller.notes else note
    gains = controller.gains.to("standard")
    schedule = tuple((speed, g.to("standard")) for speed, g in controller.schedule)
    return replace(
        controller, gains=gains, schedule=schedule, Ts=Ts, filter_samples=samples, notes=notes,
        feedforward=None,
    )  # fmt: skip


def _batch(ratio: int) -> int:
    """Samples in a frame; fewer than five would load a serial line too much."""
    # samples in a frame: the first that divides a period, so all ticks see equally old samples
    batches = (10, 9, 8, 7, 6, 5)
    return next((b for b in batches if ratio % b == 0), min(ratio, batches[0]))


def _ratio(drive: Drive, controller: Controller) -> int:
    """Samples of the drive in a period of the loop."""
    if os.name == "nt":
        raise SettingError(
            expected="Linux or macOS for a loop on the host", received="Windows",
            remedy="run the controller on the device",
        )  # fmt: skip
    if drive.identity.on_credit:
        raise SettingError(
            name="drive", expected="a device in real time for a loop on the host",
            received="one whose time stops between grants", remedy="start it without --fast",
        )  # fmt: skip
    ratio = controller.Ts / drive.identity.Ts
    whole = round(ratio)
    if whole < 2 or abs(ratio - whole) > 1e-6 * whole:
        raise SettingError(
            name="controller",
            expected=f"one at a whole number, 2 or more, of the device's {drive.identity.Ts:g} s",
            received=f"{controller.Ts:g} s",
            remedy="convert it with at_period, or run it on the device",
        )
    return whole


def _reference(reference: str | ArrayLike, controller: Controller, seed: int) -> FloatArray:
    """The reference at the loop's sample time; a named one is sampled from its own."""
    step = round(controller.Ts / signals.TS)
    named = isinstance(reference, str)
    if not named or step <= 1 or not math.isclose(step * signals.TS, controller.Ts, rel_tol=1e-6):
        return reference_samples(reference, controller, seed)
    if spelled(controller.gains.y_unit) != "rpm":
        raise SettingError(
            name="controller", expected=f"one in RPM for the reference {reference!r}",
            received=repr(controller.gains.y_unit), remedy="give the reference as samples",
        )  # fmt: skip
    assert isinstance(reference, str)
    return np.ascontiguousarray(signals.reference(reference, seed)[::step])


def _scale(drive: Drive, controller: Controller) -> float:
    return counts_per_unit(drive.identity.counts_per_rev, controller.gains.y_unit)


@contextmanager
def _scheduling(wanted: bool) -> Iterator[list[str]]:
    """Real-time scheduling, if wanted, of this thread and those it starts; yields the result."""
    priority = 50
    if not wanted:
        yield [ORDINARY]
        return
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except AttributeError:
        yield [f"{ORDINARY} (real time is not offered on this system)"]
        return
    except OSError as refused:
        yield [f"{ORDINARY} (real time refused: {refused.strerror}; see limits.conf, rtprio)"]
        return
    try:
        yield [f"SCHED_FIFO {priority}"]
    finally:
        os.sched_setscheduler(0, *before)


def _raise_where_it_never_ran(outcome: Mapping[str, Any]) -> None:
    if outcome["name"] == "refused":
        raise refusal(outcome["command"], outcome["result"], outcome["detail"])
    if outcome["name"] == "unanswered":
        raise LinkError(
            expected=f"an answer to {wire.Kind(outcome['command']).name}", received="none",
            remedy="check cable and device, then connect again",
        )  # fmt: skip


def _run(
    found: Mapping[str, Any], drive: Drive, controller: Controller, r: FloatArray,
    streamed: Layout, scheduling: Sequence[str], label: str,
) -> HostLoopRun:  # fmt: skip
    ticks = found["ticks"]
    number = ticks["number"].astype(np.intp)
    reached = int(number[-1]) + 1 if len(number) else 0
    if found["outcome"]["name"] == "completed":
        # the last ticks may have been missed
        reached = len(r)
    at_ticks = {
        k: _spread(ticks[k], number, reached) for k in ("u", "y", "feedback", "late", "age")
    }
    times = (found["times"] - found["start"]) / 1e6
    samples = dict(zip(streamed.names, found["columns"], strict=True))
    return HostLoopRun(
        t=np.arange(reached, dtype=np.float64) * controller.Ts, r=r[:reached],
        u=at_ticks["u"], y=at_ticks["y"], feedback=at_ticks["feedback"],
        late=1e-6 * at_ticks["late"], age=1e-6 * at_ticks["age"],
        samples={"t": times, **samples},
        sample_units={"t": "s", **{c.name: c.unit for c in streamed.channels}},
        gaps=_gaps(times, found["taken"], drive.identity.Ts), taken=found["taken"],
        outcome=found["outcome"]["name"], message=_message(found["outcome"]),
        stop_confirmed=found["stopped"], jitter=_jitter(found, controller, scheduling),
        controller=controller, device=drive.identity, reference=label,
    )  # fmt: skip


def _spread(values: FloatArray, number: NDArray[np.intp], reached: int) -> FloatArray:
    """Values at the ticks that ran, NaN at those that were missed."""
    spread = np.full(reached, np.nan)
    spread[number] = values
    return spread


def _gaps(times: FloatArray, taken: int | None, Ts: float) -> tuple[tuple[int, int], ...]:
    """(first, count) of each stretch of missing samples, those at both ends included."""
    numbers = np.rint(times / Ts).astype(np.int64)
    end = taken if taken is not None else (int(numbers[-1]) + 1 if len(numbers) else 0)
    edges = np.concatenate([[-1], numbers, [max(end, int(numbers[-1]) + 1 if len(numbers) else 0)]])
    missing = np.diff(edges) - 1
    return tuple((int(edges[k]) + 1, int(missing[k])) for k in np.flatnonzero(missing > 0))


def _message(outcome: Mapping[str, Any]) -> str:
    if outcome["name"] != "tripped":
        detail = f" ({outcome['text']})" if "text" in outcome else ""
        return _ENDS[outcome["name"]] + detail
    reason = wire.name_of(wire.REASONS, outcome["reason"])
    value = outcome["value"]
    at = "" if math.isnan(value) or value == 0.0 else f" at {value:.5g}"
    return f"the device tripped: {reason}{at}; find out why, then clear the trip"


def _jitter(found: Mapping[str, Any], controller: Controller, scheduling: Sequence[str]) -> Jitter:
    memory = found["memory"]
    scheduled = list(scheduling)
    if memory is not None:
        scheduled.append("memory locked" if not memory else f"memory not locked ({memory})")
    ticks = found["ticks"]
    return Jitter(
        late=ticks["late"], age=ticks["age"], period=1e6 * controller.Ts,
        missed=found["missed"], blind=int(np.count_nonzero(ticks["fresh"] == 0.0)),
        unsent=found["unsent"], round_trip=found["round_trip"], device_late=found["device_late"],
        real_time=", ".join(scheduled),
    )  # fmt: skip
