"""`Plan`: what a run is to do; `play`: it is done, into memory, a file and a live view."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..control.controller import SampledController
from ..control.machine import RecordedRun, Watch, cancelled_by
from ..errors import Interrupted, LinkError, SettingError, SewfastError
from ..gains import vector
from ..live import Feed, Kind, open_view
from ..recordfile import Header, RecordWriter, read_recording
from ..recordfile.writer import require_ending, require_replaceable
from ..recording import Recording
from ..speed import Method, speed_or_nan
from . import wire
from .connection import ClockBounds
from .wire import Channel, Identity

if TYPE_CHECKING:
    from .drive import Drive

T = TypeVar("T")
Mode: TypeAlias = Literal["commands", "controller", "direct"]
Columns: TypeAlias = Mapping[str, NDArray[np.float64]]

DEFAULTS: dict[str, tuple[str, ...]] = {
    "commands": ("speed_true",),
    "controller": ("speed_true", "feedback", "r"),
    "direct": ("speed_true",),
}
"""Streamed beside `counts` and `u` where the device has them; a low baud rate drops the last."""
BATCH = 10
SPARE = 0.1
_CAPABILITIES = {"commands": wire.PROFILE, "controller": wire.PID, "direct": wire.DIRECT}


@dataclass(frozen=True)
class Plan:
    """What a run is to do.

    Parameters
    ----------
    mode : "commands", "controller" or "direct"
        Play `values` as commands; run `controller` along them on the device; or send each as a
        command when its time has come, which is only for slow plants.
    values : array, shape (N,)
        Commands in the unit of channel `u`, or references in the unit of the controller's output.
    controller : Controller, StateFeedback or None
        Of mode "controller".
    columns : sequence of str or None
        Channels to stream beside `counts` and `u`; None for those of the mode that the baud rate
        carries.
    batch : int or None
        Samples in a frame; None for the smallest number from 10 on that the baud rate carries.

    Raises
    ------
    DataError
        For values that are not numbers or not one-dimensional.
    SettingError
        For a mode, values or a controller that do not go together.
    """

    mode: Mode
    values: NDArray[np.float64]
    controller: SampledController | None = None
    columns: Sequence[str] | None = None
    batch: int | None = None

    def __post_init__(self) -> None:
        if self.mode not in wire.MODES:
            raise SettingError(f"expected a mode out of {', '.join(wire.MODES)}, got {self.mode!r}")
        values = vector("values", self.values).copy()
        if not 0 < len(values) < 2**32 or not np.all(np.isfinite(values)):
            raise SettingError(
                f"expected at least one value, all finite, got {len(values)} of which "
                f"{int(np.count_nonzero(~np.isfinite(values)))} are not; mend the signal"
            )
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        if (self.controller is None) == (self.mode == "controller"):
            raise SettingError(
                f"expected a controller in mode 'controller' and none elsewhere, got "
                f"{'none' if self.controller is None else 'one'} in mode {self.mode!r}"
            )


class Sink(Protocol):
    """Takes what a run delivers; called on the thread of the run, so it must be quick."""

    def samples(self, first: int, columns: Columns) -> None:
        """Samples `first`, `first + 1`, ..., no gap between them: arrays (n,) by channel."""

    def event(self, kind: str, index: int, **detail: object) -> None:
        """Something happened at sample `index`.

        Kinds: those of the device (armed, started, finished, stopped, tripped), and gap, port_lost,
        resumed, reset, stop_unconfirmed.
        """


@dataclass(frozen=True)
class Outcome:
    """What became of a run.

    Parameters
    ----------
    state : str
        Of the device at the end.
    reason : str
        "finished", "stopped", "cancelled", "interrupted", "failed", or why the device tripped.
    received : int
        Samples that arrived.
    taken : int or None
        Samples that the device has taken; None where it could not be asked.
    gaps : tuple of (first, count)
        Samples that are missing.
    anomalies : tuple of (kind, sequence, count)
        Frames that were not in order: of which kind, from which sequence number, how many.
    clock : ClockBounds or None
        None on credit, where there is no wall clock.
    columns : tuple of str
        Channels streamed.
    batch : int
        Samples in a frame.
    counters : mapping
        How many frames and samples, in and out of order.
    """

    state: str
    reason: str
    received: int
    taken: int | None
    gaps: tuple[tuple[int, int], ...]
    anomalies: tuple[tuple[str, int, int], ...]
    clock: ClockBounds | None
    columns: tuple[str, ...] = ()
    batch: int = 0
    counters: Mapping[str, int] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether every sample that the device took has arrived."""
        return self.taken == self.received and not self.gaps

    def __str__(self) -> str:
        of = "an unknown number" if self.taken is None else f"{self.taken}"
        gaps = ", ".join(f"{n} from sample {k}" for k, n in self.gaps[:5]) or "none"
        more = f" and {len(self.gaps) - 5} more" if len(self.gaps) > 5 else ""
        return f"{self.reason} ({self.state}); {self.received} of {of} samples; gaps: {gaps}{more}"


@dataclass(frozen=True)
class Layout:
    """The channels that a run streams and how many samples go into a frame."""

    channels: tuple[Channel, ...]
    batch: int

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.channels)

    @property
    def mask(self) -> int:
        return sum(1 << c.number for c in self.channels)


def require_capable(plan: Plan, identity: Identity) -> None:
    """Refuse what the device does not offer.

    Raises
    ------
    SettingError
    """
    if not identity.capabilities & _CAPABILITIES[plan.mode]:
        raise SettingError(
            f"expected a device that offers mode {plan.mode!r}, {identity.name!r} does not; "
            "choose another mode or update its firmware"
        )
    controller = plan.controller
    if controller and not math.isclose(controller.Ts, identity.Ts, rel_tol=1e-6):
        raise SettingError(
            f"expected a controller for the device's period of {identity.Ts:g} s, got one for "
            f"{controller.Ts:g} s; tune it at that sample time"
        )


def layout(plan: Plan, channels: Sequence[Channel], identity: Identity, baud: float) -> Layout:
    """Channels and batch that the link carries with a tenth to spare.

    Parameters
    ----------
    baud : float
        Bits per second; inf where nothing limits them.

    Raises
    ------
    SettingError
        Where the columns asked for are unknown or too much; the message names those to leave out.
    """
    names = {c.name: c for c in channels}
    wanted = DEFAULTS[plan.mode] if plan.columns is None else tuple(plan.columns)
    if plan.columns is None:
        wanted = tuple(w for w in wanted if w in names)
    unknown = [w for w in wanted if w not in names]
    if unknown:
        raise SettingError(
            f"expected columns out of {', '.join(names)}, got {', '.join(unknown)}; "
            "the device streams no others"
        )
    extra = [names[w] for w in wanted if names[w].number > 1]
    for count in range(len(extra), -1, -1):
        chosen = tuple(sorted({*channels[:2], *extra[:count]}, key=lambda c: c.number))
        batch = _batch(plan, chosen, identity, baud)
        if batch is not None and (count == len(extra) or plan.columns is None):
            return Layout(chosen, batch)
        if batch is not None:
            raise _too_much(plan, extra[count:], identity, baud)
    raise _too_much(plan, extra, identity, baud)


def _batch(plan: Plan, chosen: Sequence[Channel], identity: Identity, baud: float) -> int | None:
    """The smallest batch that fits, or the one asked for if it does."""
    encodings = [c.encoding for c in chosen]
    tries = range(BATCH, 101) if plan.batch is None else (plan.batch,)
    fits = (b for b in tries if _fits(encodings, b, identity, baud))
    found = next(fits, None)
    if found is None and plan.batch is None:
        found = next((b for b in range(BATCH, 0, -1) if _fits(encodings, b, identity, baud)), None)
    return found


def _fits(encodings: Sequence[int], batch: int, identity: Identity, baud: float) -> bool:
    body = wire.body_size(encodings, batch)
    if not 1 <= batch <= 255 or body > wire.MAX_BODY:
        return False
    seconds = batch * identity.Ts
    return wire.wire_size(body) * 10.0 / seconds <= (1.0 - SPARE) * baud


def _too_much(plan: Plan, out: Sequence[Channel], identity: Identity, baud: float) -> SettingError:
    if plan.batch is not None and _batch(plan, out, identity, math.inf) is None:
        return SettingError(
            f"expected a batch that fits a frame of {wire.MAX_BODY} bytes, got {plan.batch}; "
            "leave it to sewfast (batch=None)"
        )
    leave = f"leave out {', '.join(c.name for c in out)}" if out else "use a longer period"
    batch = "any batch" if plan.batch is None else f"batches of {plan.batch}"
    return SettingError(
        f"expected columns that {baud:g} baud carries each {identity.Ts:g} s with a tenth to spare "
        f"in {batch}, got more; {leave}, or raise the baud rate of both sides"
    )


# --- Recorder: a run's samples to memory, a file and a live view, none of which hold it up --------


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
        raise SettingError(f"expected settings as a mapping, got {settings!r}")
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
        raise Stopped(played, LinkError(_not_finished(played.outcome, n, drive)))
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


def _not_finished(outcome: Outcome, n: int, drive: Drive) -> str:
    came = f"{outcome.received} of {n} samples came"
    if outcome.state == "tripped":
        return (
            f"expected the run to finish, the device tripped: {_why(outcome.reason, drive)}; its "
            f"output is safe and {came}; find out why, then clear it (sewfast clear PORT)"
            + (_more_time(drive.watchdog) if outcome.reason == "watchdog" else "")
        )
    return f"expected the run to finish, the device ended it ({outcome.reason}); {came}"
