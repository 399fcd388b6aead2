"""Runs of a drive, recorded: into memory, a recording file and a live view."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..arrays import FloatArray
from ..causes import sudden
from ..control.controller import SampledController
from ..control.machine import RecordedRun, Watch, cancelled_by, cause_in, recording_of
from ..control.position import Playing, PositionController
from ..errors import Interrupted, LinkError, SettingError, SewfastError
from ..live import Feed, ViewKind, open_view
from ..recordfile import Header, RecordWriter, read_recording
from ..recordfile.writer import require_ending, require_replaceable
from ..recording import Recording
from ..speed import Method, speed_or_nan
from .plan import Outcome, Plan

if TYPE_CHECKING:
    from .drive import Drive

T = TypeVar("T")

_OF_A_RUN = ("started", "gap")
"""Events that show that the device has accepted a start."""


class Recorder:
    """The sink of `Drive.stream` for a run of `n` samples; `columns` maps streamed names to units.
    `writer` is a lazy file, created when the run has begun; with it, the samples are not kept in
    memory. `feed` is that of a live view. `watch` is called with the samples; an exception from it
    ends the run.
    """

    def __init__(
        self,
        columns: Mapping[str, str],
        n: int,
        *,
        writer: RecordWriter | None = None,
        feed: Feed | None = None,
        watch: Watch | None = None,
    ) -> None:
        size = 0 if writer else n
        self._kept = {name: np.full(size, np.nan) for name in columns}
        self._file = writer
        self._feed = feed
        self._watch = watch
        self._end = 0
        self._begun = False
        self._early: list[tuple[str, int | None, dict[str, Any]]] = []

    def samples(self, first: int, columns: Mapping[str, FloatArray]) -> None:
        """Take a batch of samples; called by the thread that owns the link."""
        self._begin()
        if self._file is not None:
            self._file.samples(first, columns)
        else:
            stop = first + len(next(iter(columns.values())))
            for name, kept in self._kept.items():
                kept[first:stop] = columns[name]
            self._end = max(self._end, stop)
        if self._feed is not None:
            self._feed.put(first, columns)
        if self._watch is not None:
            self._watch(first, columns["u"], columns["counts"])

    def event(self, kind: str, index: int | None = None, **detail: Any) -> None:
        """Take an event; see `samples`."""
        if kind in _OF_A_RUN:
            self._begin()
        if self._begun:
            self._write_event(kind, index, detail)
        else:
            self._early.append((kind, index, detail))
        if self._feed is not None:
            self._feed.say(describe(kind, index, detail))

    def _begin(self) -> None:
        """The run has begun: write the events before it, which belong to its recording."""
        if not self._begun:
            self._begun = True
            for event in self._early:
                self._write_event(*event)

    def _write_event(self, kind: str, index: int | None, detail: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.event(kind, index, **{k: _finite_or_none(v) for k, v in detail.items()})

    def columns(self) -> dict[str, FloatArray]:
        """The samples received, 0 to the last one, NaN in gaps; only without a file."""
        return {name: values[: self._end] for name, values in self._kept.items()}

    def close(self, outcome: str, taken: int | None) -> None:
        """Flush and close the file. `outcome` says how the run ended, `taken` how many samples the
        device took; None if unknown. Raises `DataError` if the file could not be completed.
        """
        if self._file is not None:
            self._file.close(outcome, taken=taken)


def _finite_or_none(value: Any) -> Any:
    """The value, or None for a number that JSON lacks: a device can send infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe(kind: str, index: int | None, detail: Mapping[str, Any]) -> str:
    """An event as a line of text."""
    at = "" if index is None else f" at sample {index}"
    text = ", ".join(f"{name} {value}" for name, value in detail.items())
    return f"{kind}{at}" + (f": {text}" if text else "")


# --- run_plan: a plan on a drive, recorded --------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RunResult:
    """The samples of a run and its outcome. Row k of the `columns`, (N,) each, is sample k of the
    run, NaN if the link lost it; N is the number that the device took, the planned one after a
    complete run. `file` is the recording; None without a file, and if the run never began.
    """

    columns: dict[str, FloatArray]
    outcome: Outcome
    file: Path | None


class Stopped(Exception):
    """A run that was stopped by `cause`; `run` holds the samples until then."""

    def __init__(self, run: RunResult, cause: BaseException) -> None:
        super().__init__(str(cause))
        self.run = run
        self.cause = cause

    def as_error(self, convert: Callable[[RunResult], Any]) -> BaseException:
        """`Interrupted` after Ctrl-C, else the cause; both carry the converted run."""
        result = convert(self.run)
        if isinstance(self.cause, KeyboardInterrupt):
            return Interrupted(result)
        file = self.run.file
        kept = f"; what came is in {file}" if file is not None else ""
        error = LinkError(f"{self.cause}{kept}") if kept else self.cause
        if isinstance(error, LinkError):
            error.recording = result
        return error


def run_plan(
    drive: Drive,
    plan: Plan,
    *,
    name: str,
    file: str | os.PathLike[str] | None = None,
    live: str | ViewKind = "none",
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    watch: Watch | None = None,
    cancel: threading.Event | None = None,
) -> RunResult:
    """Run a plan and keep its samples, in memory or in an MCAP `file` written as they arrive. It is
    created when the device accepts the start, so a refused run leaves an existing file unchanged;
    `overwrite` matters only for a drive's recording. `live` is as in `sewfast.live.open_view`; an
    exception from `watch`, or setting `cancel` in another thread, ends the run. Raises `Stopped` if
    a trip, port, device, disk or Ctrl-C ended it; the motor has been stopped and the file closed.
    """
    if file is not None:
        require_replaceable(require_ending(file), overwrite=overwrite)
    if settings is not None and not isinstance(settings, Mapping):
        raise SettingError(name="settings", expected="a mapping", received=repr(settings))
    columns = drive.columns(plan)
    n = len(plan.values)
    feed = Feed(columns, drive.identity.Ts, n, name, counts_per_rev=_counts_per_rev(drive))
    with open_view(live, feed):
        writer = _writer(file, drive, plan, name, columns, settings or {})
        recorder = Recorder(columns, n, writer=writer, feed=feed, watch=watch)
        run = _stream(drive, plan, recorder, writer, cancel)
    if run.outcome.reason == "cancelled" and cancel is not None and cancel.is_set():
        raise Stopped(run, KeyboardInterrupt())
    if run.outcome.reason != "finished":
        raise Stopped(run, _not_finished(run.outcome, n, drive))
    return run


def excite(
    drive: Drive,
    u: FloatArray,
    name: str,
    *,
    method: Method = "kalman",
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Recording:
    """Commands on a drive; see `Drive.excite`."""

    def convert(run: RunResult) -> Recording:
        return _recording(run.columns, drive, name, method)

    return _converted(drive, Plan("commands", u), convert, name=name, settings=settings, **options)


def follow(
    drive: Drive, controller: SampledController, r: FloatArray, name: str, **options: Any
) -> RecordedRun:
    """A controller on a drive along a reference; see `Drive.follow`."""

    playing = Playing.of(controller) if isinstance(controller, PositionController) else None
    # asked for before the run: afterwards the drive may have gone
    volt = math.inf if playing is None else drive.limits().volt

    def convert(run: RunResult) -> RecordedRun:
        played = None if playing is None else _played(playing, run.outcome)
        found = _run(run.columns, drive, played or controller, r, name)
        if played is None:
            return found
        place, goal = played.on_device(r, found.recording.counts, volt)
        return replace(found, place=place, goal=goal)

    goals = playing is not None and playing.stop is None
    plan = Plan("positions" if goals else "controller", controller.early(r), controller)
    return _converted(drive, plan, convert, name=name, **options)


def _played(playing: Playing, outcome: Outcome) -> Playing:
    """The controller with the stop that was asked for in mid-run, if one was."""
    if outcome.stop is None or playing.stop is None:
        return playing
    (at, angle, onward), (_, _, turn, _) = outcome.stop, playing.stop
    return replace(playing, stop=(at, angle, turn, onward))


def _converted(drive: Drive, plan: Plan, convert: Callable[[RunResult], T], **options: Any) -> T:
    """Run a plan and convert its result; an error carries the converted partial run."""
    try:
        return convert(run_plan(drive, plan, **options))
    except Stopped as stopped:
        error = stopped.as_error(convert)
        outcome = stopped.run.outcome
        tripped = outcome.state == "tripped" and outcome.reason in _OF_MACHINE
        if isinstance(error, LinkError) and tripped:
            with contextlib.suppress(LinkError):  # the drive has gone meanwhile
                found, counts = recording_of(error), stopped.run.columns["counts"]
                moved = drive.status().counts - counts[np.isfinite(counts)][-1:].sum()
                cause = cause_in(found, volt=drive.volt) or sudden(found, moved)
                # a limit that its owner has set low ends a healthy motor before it settles
                if cause is not None and cause.name != "integrates":
                    error.remedy = ""  # the message keeps how to clear the trip
                    error.explain(cause)
        raise error from stopped.cause


def _recording(
    columns: Mapping[str, FloatArray], drive: Drive, name: str, method: Method
) -> Recording:
    """Counts from the first sample on; the speed where gaps leave enough samples for it."""
    Ts, per_rev = drive.identity.Ts, drive.identity.counts_per_rev
    counts = columns["counts"]
    known = counts[np.isfinite(counts)]
    counts = counts - known[0] if len(known) else counts
    y = speed_or_nan(counts, Ts, per_rev, method)
    return Recording(columns["u"], counts, y, columns.get("speed_true"), Ts, per_rev, name)


def _run(
    columns: Mapping[str, FloatArray],
    drive: Drive,
    controller: SampledController,
    r: FloatArray,
    name: str,
) -> RecordedRun:
    """The run as the drive streamed it; a column that is missing is computed, or NaN."""
    recording = _recording(columns, drive, name, "kalman")
    n, true = len(recording), recording.speed_true
    return RecordedRun(
        t=np.arange(n, dtype=np.float64) * recording.Ts,
        r=r[:n],
        u=recording.u,
        y=recording.y if true is None else true,
        feedback=columns.get("feedback", np.full(n, np.nan)),
        controller=controller,
        plant=drive.identity.name,
        reference=name,
        recording=recording,
    )


def _counts_per_rev(drive: Drive) -> float | None:
    return drive.identity.counts_per_rev or None


def _writer(
    file: str | os.PathLike[str] | None,
    drive: Drive,
    plan: Plan,
    name: str,
    columns: Mapping[str, str],
    settings: Mapping[str, Any],
) -> RecordWriter | None:
    if file is None:
        return None
    identity = drive.identity
    asked = {} if plan.controller is None else _asked_of(plan.controller)
    header = Header(
        name=name,
        Ts=identity.Ts,
        columns={column: unit or "1" for column, unit in columns.items()},
        n=len(plan.values),
        counts_per_rev=_counts_per_rev(drive),
        device=device_of(drive),
        settings={"mode": plan.mode, **conditions_of(drive), **asked, **settings},
    )
    place = Path(file)
    # whether an existing file may be replaced was checked before
    return RecordWriter(place, header, overwrite=place.exists(), lazy=True)


def _asked_of(controller: SampledController) -> dict[str, Any]:
    """The controller, and what a position loop does in this run."""
    asked: dict[str, Any] = {"controller": controller.to_dict()}
    if not isinstance(controller, Playing):
        return asked
    asked["release"] = controller.releases
    if controller.stop is not None:
        at, angle, turn, onward = controller.stop
        way = "onward" if onward else "shortest"
        asked["stop"] = {"sample": at, "angle": angle, "turn": turn, "way": way}
    return asked


def device_of(drive: Drive) -> dict[str, Any]:
    """The description of a drive in a recording."""
    return {"kind": "drive", **asdict(drive.identity)}


def conditions_of(drive: Drive) -> dict[str, Any]:
    """Limits and watchdog in force, for a recording."""
    names = ("volt", "speed_rpm", "acceleration", "current")
    limits = zip(names, drive.limits().values, strict=True)
    return {
        "limits": {name: _finite_or_none(value) for name, value in limits},
        "watchdog_s": drive.watchdog,
    }


def _stream(
    drive: Drive,
    plan: Plan,
    recorder: Recorder,
    writer: RecordWriter | None,
    cancel: threading.Event | None,
) -> RunResult:
    """Stream, close the file in any case, and return the samples received."""
    # must not be that of an earlier run
    drive.outcome = None
    try:
        outcome = drive.stream(plan, recorder, **cancelled_by(cancel))
    except BaseException as error:
        ended = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        try:
            recorder.close(ended, None if drive.outcome is None else drive.outcome.taken)
        except SewfastError as second:
            # the error of the run tells more than the one of closing
            if second is not error:
                error.__context__ = second
        if not isinstance(error, (KeyboardInterrupt, SewfastError)) or drive.outcome is None:
            raise
        raise Stopped(_result(recorder, writer, drive.outcome), error) from error
    ended = "complete" if outcome.reason == "finished" else outcome.reason
    recorder.close(f"tripped: {ended}" if outcome.state == "tripped" else ended, outcome.taken)
    return _result(recorder, writer, outcome)


def _more_time(watchdog: float) -> str:
    """The remedy for a busy computer: a longer watchdog time, up to the longest."""
    # the protocol's longest watchdog time is 10 s
    longer = min(max(0.25, 2.0 * watchdog), 10.0)
    if longer <= watchdog:
        return ""
    return (
        f". A busy computer needs more time: --watchdog {longer * 1e3:g} (watchdog={longer:g}), "
        "if the machine tolerates it"
    )


_LIMITED = {"speed": (1, "RPM"), "acceleration": (2, "RPM/s"), "current": (3, "A")}
"""Trips by a limit: its place among the limits, its unit."""
_OF_MACHINE = (*_LIMITED, "no motion", "swinging")
"""Trips whose cause is the machine."""


def _why(reason: str, drive: Drive) -> str:
    """The reason of a trip, with the limit or the time that was in force."""
    if reason == "watchdog":
        return f"{reason}, it had received nothing for {drive.watchdog * 1e3:g} ms"
    if reason not in _LIMITED:
        return reason
    place, unit = _LIMITED[reason]
    try:
        return f"{reason}, the limit is {drive.limits().values[place]:g} {unit}"
    except LinkError:
        return reason


def _result(recorder: Recorder, writer: RecordWriter | None, outcome: Outcome) -> RunResult:
    """The samples, with NaN for those at the end that the device took and the link lost."""
    file = writer.path if writer is not None and writer.is_made else None
    columns = recorder.columns() if file is None else dict(read_recording(file).columns)
    received = len(next(iter(columns.values())))
    lost = np.full(max(0, (outcome.taken or 0) - received), np.nan)
    padded = {name: np.concatenate([values, lost]) for name, values in columns.items()}
    return RunResult(padded, outcome, file)


def _not_finished(outcome: Outcome, n: int, drive: Drive) -> LinkError:
    why, remedy = f"one that the device ended ({outcome.reason})", ""
    if outcome.state == "tripped":
        why = f"one that tripped: {_why(outcome.reason, drive)}"
        remedy = "the output is safe: find out why, then clear it (sewfast clear PORT)"
        remedy += _more_time(drive.watchdog) if outcome.reason == "watchdog" else ""
    return LinkError(
        expected="a run that finishes", received=f"{why}, after {outcome.received} of {n} samples",
        remedy=remedy,
    )  # fmt: skip
