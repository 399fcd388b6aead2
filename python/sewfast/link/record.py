"""A plan on a drive, into memory, a recording file and a live view."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..arrays import FloatArray
from ..control.controller import SampledController
from ..control.machine import RecordedRun, Watch, cancelled_by
from ..errors import Interrupted, LinkError, SettingError, SewfastError
from ..live import Feed, Kind, open_view
from ..recordfile import Header, RecordWriter, read_recording
from ..recordfile.writer import require_ending, require_replaceable
from ..recording import Recording
from ..speed import Method, speed_or_nan
from .plan import Outcome, Plan

if TYPE_CHECKING:
    from .drive import Drive

T = TypeVar("T")

_OF_A_RUN = ("started", "gap")
"""Events that say that the device has accepted a start."""


class Recorder:
    """The sink of `Drive.stream`.

    Parameters
    ----------
    columns : mapping of name to unit
        The streamed columns.
    n : int
        Samples of the run.
    writer : RecordWriter, optional
        The file, a lazy one: it gets nothing before the run has begun. The samples are then not
        kept in memory.
    feed : Feed, optional
        Of a live view.
    watch : Watch, optional
        What it raises ends the run.
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
        """A batch that came; called by the thread that owns the link.

        Raises
        ------
        DataError
            Where the file takes no more.
        """
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
        """Something that happened on the way; see `samples`."""
        if kind in _OF_A_RUN:
            self._begin()
        if self._begun:
            self._write_down(kind, index, detail)
        else:
            self._early.append((kind, index, detail))
        if self._feed is not None:
            self._feed.say(describe(kind, index, detail))

    def _begin(self) -> None:
        """The run is there: what happened on the way to it belongs to its recording."""
        if not self._begun:
            self._begun = True
            for event in self._early:
                self._write_down(*event)

    def _write_down(self, kind: str, index: int | None, detail: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.event(kind, index, **{k: _finite_or_none(v) for k, v in detail.items()})

    def columns(self) -> dict[str, FloatArray]:
        """What came, sample 0 to the last one, NaN in gaps; where there is no file."""
        return {name: values[: self._end] for name, values in self._kept.items()}

    def close(self, outcome: str, taken: int | None) -> None:
        """Write what waits and close the file.

        Parameters
        ----------
        outcome : str
            How it ended.
        taken : int or None
            Samples that the device took, where that is known.

        Raises
        ------
        DataError
            Where the file could not be written to its end.
        """
        if self._file is not None:
            self._file.close(outcome, taken=taken)


def _finite_or_none(value: Any) -> Any:
    """What JSON can say: a device may send infinity as the value of an event."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe(kind: str, index: int | None, detail: Mapping[str, Any]) -> str:
    """An event as a line of text."""
    at = "" if index is None else f" at sample {index}"
    said = ", ".join(f"{name} {value}" for name, value in detail.items())
    return f"{kind}{at}" + (f": {said}" if said else "")


# --- play: a plan on a drive, into memory or a recording file, in front of a live view ------------


@dataclass(frozen=True, eq=False)
class Played:
    """What came of a plan.

    Attributes
    ----------
    columns : dict of name to array, shape (N,)
        Row k is sample k of the run; NaN where the link lost it. N is what the device took, the
        planned number after a whole run.
    outcome : Outcome
        How it ended.
    file : Path or None
        The recording that was written, where the run had begun.
    """

    columns: dict[str, FloatArray]
    outcome: Outcome
    file: Path | None


class Stopped(Exception):
    """A run that did not end by itself: `cause` stopped it, `played` is what had come."""

    def __init__(self, played: Played, cause: BaseException) -> None:
        super().__init__(str(cause))
        self.played = played
        self.cause = cause

    def as_error(self, made: Callable[[Played], Any]) -> BaseException:
        """`Interrupted` after Ctrl-C, else the cause; both carry what `made` makes of the run."""
        result = made(self.played)
        if isinstance(self.cause, KeyboardInterrupt):
            return Interrupted(result)
        file = self.played.file
        kept = f"; what came is in {file}" if file is not None else ""
        error = LinkError(f"{self.cause}{kept}") if kept else self.cause
        if isinstance(error, LinkError):
            error.recording = result
        return error


def play(
    drive: Drive,
    plan: Plan,
    *,
    name: str,
    file: str | os.PathLike[str] | None = None,
    live: str | Kind = "none",
    overwrite: bool = False,
    settings: Mapping[str, Any] | None = None,
    watch: Watch | None = None,
    cancel: threading.Event | None = None,
) -> Played:
    """Run a plan and keep its samples.

    Parameters
    ----------
    drive : Drive
    plan : Plan
    name : str
        Of the excitation or reference.
    file : path, optional
        An MCAP recording, written as the samples come; without it they are in memory only. It is
        made when the device has accepted the start: a run that is refused leaves no file, and one
        that is there as it was.
    live : str or Kind
        See `sewfast.live.open_view`.
    overwrite : bool
        Whether a recording of a drive may be replaced; one of a virtual machine may.
    settings : mapping, optional
        What else the file says of the run.
    watch : Watch, optional
        Sees the samples as they come, and ends the run by what it raises.
    cancel : threading.Event, optional
        Set in another thread, it ends the run as Ctrl-C does.

    Raises
    ------
    Stopped
        Where a trip, port, device, disk or Ctrl-C ended it; the motor has been stopped and the file
        closed.
    SettingError, DataError
        Before anything moves.
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
        played = _streamed(drive, plan, recorder, writer, cancel)
    if played.outcome.reason == "cancelled" and cancel is not None and cancel.is_set():
        raise Stopped(played, KeyboardInterrupt())
    if played.outcome.reason != "finished":
        raise Stopped(played, _not_finished(played.outcome, n, drive))
    return played


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

    def made(played: Played) -> Recording:
        return _recording(played.columns, drive, name, method)

    return _made(drive, Plan("commands", u), made, name=name, settings=settings, **options)


def follow(
    drive: Drive, controller: SampledController, r: FloatArray, name: str, **options: Any
) -> RecordedRun:
    """A controller on a drive along a reference; see `Drive.follow`."""

    def made(played: Played) -> RecordedRun:
        return _run(played.columns, drive, controller, r, name)

    return _made(drive, Plan("controller", r, controller), made, name=name, **options)


def _made(drive: Drive, plan: Plan, made: Callable[[Played], T], **options: Any) -> T:
    """What `made` makes of the run; an error carries what it makes of what had come."""
    try:
        return made(play(drive, plan, **options))
    except Stopped as stopped:
        raise stopped.as_error(made) from stopped.cause


def _recording(
    columns: Mapping[str, FloatArray], drive: Drive, name: str, method: Method
) -> Recording:
    """Counts from the first sample on; the speed as far as gaps let it be known."""
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
    """The run as the drive streamed it; what it left out is computed, or is NaN."""
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
    controller = {} if plan.controller is None else {"controller": plan.controller.to_dict()}
    header = Header(
        name=name,
        Ts=identity.Ts,
        columns={column: unit or "1" for column, unit in columns.items()},
        n=len(plan.values),
        counts_per_rev=_counts_per_rev(drive),
        device=device_of(drive),
        settings={"mode": plan.mode, **conditions_of(drive), **controller, **settings},
    )
    place = Path(file)
    # that it may be replaced where it exists has been asked
    return RecordWriter(place, header, overwrite=place.exists(), lazy=True)


def device_of(drive: Drive) -> dict[str, Any]:
    """What a recording says of the drive that it was made on."""
    return {"kind": "drive", **asdict(drive.identity)}


def conditions_of(drive: Drive) -> dict[str, Any]:
    """Limits and watchdog in force, as a recording states them."""
    return {"limits": _finite(drive.limits().values), "watchdog_s": drive.watchdog}


def _finite(limits: tuple[float, ...]) -> dict[str, float | None]:
    names = ("volt", "speed_rpm", "acceleration", "current")
    pairs = zip(names, limits, strict=True)
    return {name: value if np.isfinite(value) else None for name, value in pairs}


def _streamed(
    drive: Drive,
    plan: Plan,
    recorder: Recorder,
    writer: RecordWriter | None,
    cancel: threading.Event | None,
) -> Played:
    """Stream, close the file whatever happens, and give what came."""
    # of this run, not of one before it
    drive.outcome = None
    try:
        outcome = drive.stream(plan, recorder, **cancelled_by(cancel))
    except BaseException as error:
        ended = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        _closed(recorder, ended, drive.outcome, error)
        if not isinstance(error, (KeyboardInterrupt, SewfastError)) or drive.outcome is None:
            raise
        raise Stopped(_played(recorder, writer, drive.outcome), error) from error
    recorder.close(_word(outcome), outcome.taken)
    return _played(recorder, writer, outcome)


def _closed(recorder: Recorder, ended: str, outcome: Outcome | None, error: BaseException) -> None:
    """Close the file; the error that is on its way says more than one of closing."""
    try:
        recorder.close(ended, None if outcome is None else outcome.taken)
    except SewfastError as second:
        if second is not error:
            error.__context__ = second


_LONGEST = 10.0
"""Watchdog time of the protocol [s]."""


def _more_time(watchdog: float) -> str:
    """What a busy computer needs: more than there was, where there is more."""
    longer = min(max(0.25, 2.0 * watchdog), _LONGEST)
    if longer <= watchdog:
        return ""
    return (
        f". A busy computer needs more time: --watchdog {longer * 1e3:g} (watchdog={longer:g}), "
        "if the machine tolerates it"
    )


_LIMITED = {"speed": (1, "RPM"), "acceleration": (2, "RPM/s"), "current": (3, "A")}
"""Trips with a limit of their own: its place among the limits, its unit."""


def _why(reason: str, drive: Drive) -> str:
    """The reason of a trip, with what was in force."""
    if reason == "watchdog":
        return f"{reason}, it had heard nothing for {drive.watchdog * 1e3:g} ms"
    if reason not in _LIMITED:
        return reason
    place, unit = _LIMITED[reason]
    try:
        return f"{reason}, the limit is {drive.limits().values[place]:g} {unit}"
    except LinkError:
        return reason


def _word(outcome: Outcome) -> str:
    """How the recording says that it ended."""
    if outcome.reason == "finished":
        return "complete"
    return f"tripped: {outcome.reason}" if outcome.state == "tripped" else outcome.reason


def _played(recorder: Recorder, writer: RecordWriter | None, outcome: Outcome) -> Played:
    file = writer.path if writer is not None and writer.is_made else None
    columns = recorder.columns() if file is None else dict(read_recording(file).columns)
    n = outcome.taken if outcome.taken is not None else len(next(iter(columns.values())))
    return Played({name: _padded(values, n) for name, values in columns.items()}, outcome, file)


def _padded(values: FloatArray, n: int) -> FloatArray:
    """NaN for samples at the end that the device took and the link lost."""
    if len(values) >= n:
        return values
    padded = np.full(n, np.nan)
    padded[: len(values)] = values
    return padded


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
