"""`Machine`, the protocol of machines for recording, running and commissioning; `record`.

Read in this order: the protocol, `record`, then the machines of this process: the virtual one and
any that is advanced sample by sample. A drive behind a port is itself a `Machine`
(`sewfast.link.Drive`).
"""

from __future__ import annotations

import contextlib
import copy
import inspect
import math
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeGuard, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray
from ..causes import Cause, cause_of, loss
from ..errors import DataError, LinkError, SettingError, SewfastError
from ..gains import real
from ..machine import VirtualMachine
from ..recordfile.writer import require_replaceable
from ..recording import Recording, require_finite
from ..speed import Method, speed_or_nan
from .controller import SampledController
from .loop import ClosedLoopRun, run

if TYPE_CHECKING:
    from ..live import ViewKind


@dataclass(frozen=True, eq=False)
class RecordedRun(ClosedLoopRun):
    """A closed loop on a machine; for a virtual machine, `y` is the true speed.

    Attributes
    ----------
    recording : Recording
        The run as measured by the encoder, for identification.
    """

    recording: Recording

    @classmethod
    def of(cls, run: ClosedLoopRun, recording: Recording) -> RecordedRun:
        """A run with its recording."""
        known = {f.name: getattr(run, f.name) for f in fields(ClosedLoopRun)}
        return cls(**known, recording=recording)

    @classmethod
    def of_recording(
        cls, recording: Recording, controller: SampledController, r: FloatArray, *, plant: str
    ) -> RecordedRun:
        """The run from commands and counts logged by a test rig.

        The feedback, which a log does not contain, is computed by the controller from the counts.

        Parameters
        ----------
        recording : Recording
            From `Recording.of_counts`; its name becomes the reference's.
        controller : Controller
            The controller that computed the commands.
        r : array, shape (N,)
            Reference [RPM].
        plant : str
            Name of the machine.

        Raises
        ------
        SettingError
            For a controller with another sample time.
        DataError
            For a reference with another length, or one that is not finite.
        """
        _require_fit(controller, r, recording.Ts)
        if len(r) != len(recording):
            raise DataError(
                name="reference", expected=f"a sample for each of the recording's {len(recording)}",
                received=f"{len(r)}", remedy="log the whole run",
            )  # fmt: skip
        core, feedback = controller.core(), np.zeros(len(r))
        per_count = 60.0 / (recording.counts_per_rev * recording.Ts)
        speeds = np.diff(recording.counts, prepend=0.0) * per_count
        early = controller.early(r).tolist()
        for k, (wanted, speed) in enumerate(zip(early, speeds.tolist(), strict=True)):
            core.step(wanted, speed)
            feedback[k] = core.filtered
        t = np.arange(len(r), dtype=np.float64) * recording.Ts
        y = recording.y if recording.speed_true is None else recording.speed_true
        return cls(
            t, np.array(r), recording.u, y, feedback, controller, plant, recording.name,
            recording=recording,
        )  # fmt: skip

    @property
    def run(self) -> ClosedLoopRun:
        """The run itself, for code that expects a pair of run and recording."""
        return self


def recording_of(error: Any) -> Any:
    """What an error says was recorded: a loop on a device ends with its run."""
    return getattr(error.recording, "recording", error.recording)


def cause_in(recording: Recording, *, volt: float, speed: float = math.inf) -> Cause | None:
    """The cause that a run which was ended shows, if it has samples enough."""
    with contextlib.suppress(DataError):
        return cause_of(recording, volt=volt, speed=speed)
    return None


def Followed(run: ClosedLoopRun, recording: Recording) -> RecordedRun:
    """Earlier name of `RecordedRun.of`."""
    return RecordedRun.of(run, recording)


def _require_fit(controller: SampledController, r: FloatArray, Ts: float) -> None:
    """Refuse a controller with another sample time, and a reference that is not finite."""
    if not math.isclose(controller.Ts, Ts, rel_tol=0.01):
        raise SettingError(
            name="controller", expected=f"the machine's sample time of {Ts} s",
            received=f"{controller.Ts} s", remedy="tune a controller for this machine",
        )  # fmt: skip
    require_finite("reference", r)


Watch: TypeAlias = Callable[[int, FloatArray, FloatArray], object]
"""Watches a run: called with the number of a sample, and the commands [V] and counts from it on. An
exception from it ends the run and stops the motor."""
WATCHED = 20
"""Samples per call of a watch by a machine of this process."""


class Machine(Protocol):
    """A motor with an encoder that can be excited and run, each time from rest.

    Any object with these members works with `record`, `run`, `commission` and `bode`: a drive
    behind a port, an FMU, a model of MuJoCo, your own test rig. A `VirtualMachine` has them all.
    Every run, even an interrupted one, ends with no command on the motor. If its `excite` or its
    `follow` also accepts a `watch` (`Watch`), a run that goes wrong is ended early, otherwise it is
    refused afterwards. `Recording.of_counts` and `RecordedRun.of_recording` make the results from
    the log of a test rig.
    """

    @property
    def name(self) -> str:
        """Its name, for messages and files."""

    @property
    def Ts(self) -> float:
        """Sample time [s]."""

    @property
    def counts_per_rev(self) -> float:
        """Encoder counts per turn."""

    @property
    def volt(self) -> float:
        """Largest command that it accepts in either direction [V]."""

    @property
    def speed(self) -> float:
        """Speed above which it stops on its own [RPM]; inf if there is none."""

    def excite(self, u: FloatArray, name: str) -> Recording:
        """Apply commands [V], shape (N,), one per sample."""

    def follow(self, controller: SampledController, r: FloatArray, name: str) -> RecordedRun:
        """Run a controller along a reference [RPM], shape (N,)."""


class Streaming(Machine, Protocol):
    """A machine whose samples arrive during a run, such as a drive, and which writes files itself.
    Its `excite` and `follow` take `file`, `live`, `overwrite` and `cancel` as `record` and `run`
    do, `excite` also `method` and `settings`.
    """

    def excite(self, u: FloatArray, name: str, **options: Any) -> Recording: ...
    def follow(
        self, controller: SampledController, r: FloatArray, name: str, **options: Any
    ) -> RecordedRun: ...
    def stream(self, *arguments: Any, **options: Any) -> Any: ...


def is_streaming(machine: object) -> TypeGuard[Streaming]:
    """Whether a machine's samples arrive during a run."""
    return hasattr(machine, "stream")


def watching(play: Callable[..., Any], watch: Watch) -> dict[str, Any]:
    """The option `watch` for an `excite` or a `follow`, left out if it takes none."""
    return {"watch": watch} if "watch" in inspect.signature(play).parameters else {}


MEMBERS = ("name", "Ts", "counts_per_rev", "volt", "speed", "excite", "follow")


WRAP = "wrap it: sewfast.commissioning.SteppedBench(yours, Ts=..., counts_per_rev=..., volt=...)"
"""What to do with a machine that can only be stepped."""


def machine_of(
    on: object,
    *,
    name: str = "on",
    expected: str = "a VirtualMachine, a Drive or a Machine",
    remedy: str = "sewfast.VirtualMachine(), connect to a drive, or give yours the members of "
    "sewfast.Machine",
) -> Machine:
    """The argument as a `Machine`; a virtual machine is wrapped."""
    if isinstance(on, VirtualMachine):
        return MachineBench(on)
    # look properties up in the class: reading a drive's limits would send it a command
    missing = [m for m in MEMBERS if not hasattr(type(on), m) and not hasattr(on, m)]
    if missing:
        lacking = "" if len(missing) == len(MEMBERS) else f" without {', '.join(missing)}"
        if all(hasattr(on, m) for m in ("reset", "step")):
            remedy = WRAP
        elif lacking:
            remedy = "give it the members of sewfast.Machine; one without a limit of speed states "
            remedy += "math.inf"
        raise SettingError(
            name=name, expected=expected, received=f"{type(on).__name__}{lacking}", remedy=remedy
        )
    return cast(Machine, on)


# --- The guard of a machine without a device ------------------------------------------------------


TOO_FAST = (
    "look for a load that drives it, a turned sign of command or encoder, a gain larger than "
    "recorded, wrong counts_per_rev, a counter that wraps"
)
"""What to do about a machine that is faster than stated: never a higher limit."""
NO_MOTION = "look for a lost encoder, an amplifier that has tripped, a shaft that is blocked"
"""What to do about a machine that stands under a large command."""
SEEN = {
    "Speed": ("at most {limit:g} RPM", "{value:.4g} RPM", TOO_FAST),
    "NoMotion": ("the encoder to move", "not a count for .25 s at {value:.3g} V", NO_MOTION),
    "Lost": (
        "the encoder to count on while the command stays",
        "counts that stopped, fell or turned from one sample to the next, at {value:.3g} V",
        "look for a lost encoder or one of its channels, a slipping coupling, a shaft that hit "
        "something",
    ),
    "NoNumber": (
        "a number as its counts",
        "none, at {value:.3g} V",
        "look for a lost encoder or line, a transfer that fails",
    ),
    "Swinging": (
        "a command that does not swing",
        "one that went 8 times in a row from limit to limit, at {value:.3g} Hz",
        "look for play, for a shaft that gives, for a delay",
    ),
}
"""What was expected, what was seen instead, and what to do, by the guard's reasons."""


class RunGuard:
    """A device's own guard (docs/PROTOCOL.md, 9 and 12) for one run of a machine that has no
    device: a `Watch` that ends it if it is faster than `speed` [RPM], if its motor or encoder has
    failed under a command of up to `volt` [V], or if its command swings `between` two limits.
    """

    def __init__(
        self,
        name: str,
        Ts: float,
        counts_per_rev: float,
        *,
        volt: float = math.inf,
        speed: float = math.inf,
        between: tuple[float, float] | None = None,
    ) -> None:
        self.name, self.Ts, self.counts_per_rev, self.speed = name, Ts, counts_per_rev, speed
        self._guard = _core.Guard(
            Ts=Ts, counts_per_rev=counts_per_rev, volt=volt, speed=speed, between=between
        )
        self._u: list[FloatArray] = []
        self._counts: list[FloatArray] = []

    def __call__(self, first: int, u: FloatArray, counts: FloatArray) -> None:
        """Check samples `first`, `first + 1`, ...; raises what `ended` makes."""
        self._u.append(u.copy())
        self._counts.append(counts.copy())
        found = self._guard.watch(u, counts)
        if found is None:
            return
        after, (reason, value) = found
        end = sum(map(len, self._u[:-1])) + after + 1
        all_u, all_counts = (np.concatenate(x)[:end] for x in (self._u, self._counts))
        raise self.ended(reason, value, all_u, all_counts)

    def ended(self, reason: str, value: float, u: FloatArray, counts: FloatArray) -> SewfastError:
        """The error of a run that was ended, from its commands [V] and counts until then."""
        counts = counts - counts[0]
        y = speed_or_nan(counts, self.Ts, self.counts_per_rev, "kalman")
        recording = Recording(u, counts, y, None, self.Ts, self.counts_per_rev, self.name)
        return self.error(reason, value, recording, len(u), "the run was ended")

    def error(
        self, reason: str, value: float, recording: Recording, samples: int, then: str
    ) -> LinkError:
        """The error that says what was seen after so many samples of a recording."""
        expected, received, remedy = SEEN[reason]
        error = LinkError(
            name=self.name, expected=expected.format(limit=self.speed),
            received=f"{received.format(value=value)} after {samples * self.Ts:.3g} s; "
            f"{then}", remedy=remedy,
        )  # fmt: skip
        error.recording = recording
        if reason == "Lost":
            error.explain(self.lost(recording, samples))
        return error

    def lost(self, recording: Recording, samples: int) -> Cause:
        """What became of an encoder that was seen to be lost after so many samples."""
        concluded = cause_in(recording, volt=math.inf, speed=self.speed)
        return loss(recording, samples - 1, concluded)


@dataclass
class MachineWrapper:
    """A wrapper that forwards all members of a machine."""

    inner: Machine

    @property
    def name(self) -> str:
        return self.inner.name

    @property
    def Ts(self) -> float:
        return self.inner.Ts

    @property
    def counts_per_rev(self) -> float:
        return self.inner.counts_per_rev

    @property
    def volt(self) -> float:
        return self.inner.volt

    @property
    def speed(self) -> float:
        return self.inner.speed

    def excite(self, u: FloatArray, name: str) -> Recording:
        return self.inner.excite(u, name)

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        watched = {} if watch is None else watching(self.inner.follow, watch)
        return self.inner.follow(controller, r, name, **watched)


Made = TypeVar("Made", Recording, RecordedRun)


class GuardedMachine(MachineWrapper):
    """A user's own machine: its runs are watched if they can be, and looked at afterwards."""

    def excite(self, u: FloatArray, name: str) -> Recording:
        # in an open loop a machine may stand under any command
        with self._guarded(name, math.inf) as guard:
            found = self.inner.excite(u, name, **watching(self.inner.excite, guard))
            require_made(self, name, found, Recording)
            self._look_at(guard, found)
            return found

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        with self._guarded(name, self.volt) as guard:

            def both(first: int, u: FloatArray, counts: FloatArray) -> None:
                guard(first, u, counts)
                if watch is not None:
                    watch(first, u, counts)

            found = super().follow(controller, r, name, watch=both)
            require_made(self, name, found, RecordedRun)
            self._look_at(guard, found.recording)
            return found

    @contextlib.contextmanager
    def _guarded(self, name: str, volt: float) -> Iterator[RunGuard]:
        """A guard for a run; what it raises is told its cause."""
        title = f"{self.name}, {name}"
        try:
            yield RunGuard(title, self.Ts, self.counts_per_rev, volt=volt, speed=self.speed)
        except LinkError as error:
            recording = recording_of(error)
            if isinstance(recording, Recording) and error.cause is None:
                self._explain(error, recording)
            raise

    def _explain(self, error: LinkError, recording: Recording) -> None:
        if cause := cause_in(recording, volt=self.volt, speed=self.speed):
            error.explain(cause)

    def _look_at(self, guard: RunGuard, recording: Recording) -> None:
        """Refuse a run whose recording shows that it was too fast."""
        if math.isfinite(self.speed):
            whole = _core.Guard(
                Ts=self.Ts, counts_per_rev=self.counts_per_rev, volt=math.inf, speed=self.speed
            )
            seen = whole.watch(recording.u, recording.counts)
            if seen is not None:
                k, (reason, value) = seen
                then = "it was seen after the run, which nobody could end: let it take a `watch`"
                error = guard.error(reason, value, recording, k + 1, then)
                # what a run does long after a fault hides it
                end = k + 1 + round(TAIL / self.Ts)
                u, counts, y = recording.u[:end], recording.counts[:end], recording.y[:end]
                if error.cause is None:
                    short = replace(recording, u=u, counts=counts, y=y, speed_true=None)
                    self._explain(error, short)
                raise error


def guarded(machine: Machine) -> Machine:
    """A machine whose runs are watched: those of a device or of a bench of this package are."""
    if is_streaming(machine) or isinstance(machine, (SteppedBench, MachineBench, MachineWrapper)):
        return machine
    _require_numbers(machine)
    return GuardedMachine(machine)


def _require_numbers(machine: Machine | SteppedBench) -> None:
    """Refuse a machine whose sample time, counts or limits are no numbers above 0."""
    for name in ("Ts", "counts_per_rev", "volt", "speed"):
        value = real(name, getattr(machine, name))
        if not value > 0.0 or (math.isinf(value) and name != "speed"):
            raise SettingError(
                name=name, expected="a finite number above 0", received=f"{value!r}",
                remedy="math.inf if it states none" if name == "speed" else "see the data sheet",
            )  # fmt: skip


def require_made(machine: Machine, name: str, found: object, kind: type[Made]) -> Made:
    """What a user's own machine returned, if it is a recording, or a run."""
    if isinstance(found, kind):
        return found
    maker = "of_counts" if kind is Recording else "of_recording"
    raise SettingError(
        name=f"{machine.name}, {name}", expected=f"a {kind.__name__}",
        received=type(found).__name__, remedy=f"make it by {kind.__name__}.{maker}",
    )  # fmt: skip


# --- Recording ------------------------------------------------------------------------------------


def record(
    machine: VirtualMachine | Machine,
    u: ArrayLike,
    *,
    name: str = "array",
    method: Method = "kalman",
    file: str | os.PathLike[str] | None = None,
    live: str | ViewKind = "none",
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    cancel: threading.Event | None = None,
) -> Recording:
    """Excite a machine from rest and record it.

    Parameters
    ----------
    machine : VirtualMachine, Drive or a machine of your own
        A virtual machine is reset first and stays in the state at the end of the run. A drive
        (`sewfast.link`) waits for rest, is armed and started; its limits must have been set. Your
        own is a `Machine`; wrap a simulator in a `sewfast.commissioning.SteppedBench`.
    u : array, shape (N,)
        Command [V] at the machine's sample time; see `sewfast.signals.excitation`.
    name : str
        Name of the excitation, for messages and files.
    method : "kalman", "savgol" or "difference"
        Method of estimating the speed of a virtual machine or a drive from the counts.
    file : path, optional
        For a drive, an MCAP recording, written while it runs so that nothing is lost; for another
        machine any format, written at the end.
    live : str
        For a drive: see `sewfast.live.open_view`.
    settings : mapping, optional
        Further entries for the header of the file.
    overwrite : bool
        Whether `file` may replace a recording of a drive, which cannot be repeated exactly; one of
        a virtual machine is always replaced.
    cancel : threading.Event, optional
        For a drive: set it in another thread to end the run as Ctrl-C does.

    Returns
    -------
    Recording
        For a virtual machine, `u` is the command as given, which the machine clips at its limit;
        for a drive, the command as applied.

    Raises
    ------
    DataError
        If `u` is not one-dimensional and finite, or too short for a speed.
    SettingError
        Before anything moves, if `file` has an unknown ending or must not be replaced.
    LinkError
        If the port or the drive failed or tripped; the motor is stopped, `recording` holds the
        samples so far.
    Interrupted
        On Ctrl-C or `cancel` with a drive; the motor is stopped, `best` is the recording so far.
    """
    if not is_streaming(machine):
        machine_of(machine, name="machine", remedy="the machine comes first: record(machine, u)")
    command = _command(u)
    if is_streaming(machine):
        return machine.excite(
            command, name, method=method, file=file, live=live, settings=settings,
            overwrite=overwrite, **cancelled_by(cancel),
        )  # fmt: skip
    if file is not None:
        require_replaceable(file, overwrite=overwrite)
    if isinstance(machine, VirtualMachine):
        found = MachineBench(machine, method=method).excite(command, name)
    else:
        found = guarded(machine).excite(command, name)
    if file is not None:
        found.save(file, overwrite=overwrite)
    return found


def cancelled_by(cancel: threading.Event | None) -> dict[str, Any]:
    """The option `cancel`, left out if None, as a user's streaming machine may lack it."""
    return {} if cancel is None else {"cancel": cancel}


def _command(u: ArrayLike) -> FloatArray:
    try:
        if np.iscomplexobj(u):
            raise TypeError("complex numbers")
        command = np.array(u, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as e:
        raise DataError(
            name="u", expected="numbers", received=repr(str(u)[:60]),
            remedy="a named one is sewfast.signals.excitation('step')",
        ) from e  # fmt: skip
    if command.ndim != 1:
        raise DataError(
            name="u", expected="shape (N,)", received=str(command.shape), remedy="pass one column"
        )
    return command


# --- Machines of this process ---------------------------------------------------------------------


@dataclass(frozen=True)
class MachineBench:
    """A virtual machine as a `Machine` that stops above `speed` [RPM]; `method` is that of the
    speed.
    """

    machine: VirtualMachine
    speed: float = float("inf")
    method: Method = "kalman"

    @property
    def name(self) -> str:
        return self.machine.name

    @property
    def Ts(self) -> float:
        return self.machine.Ts

    @property
    def counts_per_rev(self) -> float:
        return self.machine.counts_per_rev

    @property
    def volt(self) -> float:
        return self.machine.parameters["u_limit"]

    def excite(self, u: FloatArray, name: str) -> Recording:
        u = np.array(u, dtype=np.float64)
        self.machine.reset()
        done = self.machine.run(u)
        return Recording.of_counts(
            u, done.counts, Ts=self.Ts, counts_per_rev=self.counts_per_rev, name=name,
            speed_true=done.speed_rpm, method=self.method,
        )  # fmt: skip

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        if controller.LOOP != "speed":
            stepped = SteppedBench(
                self.machine, self.Ts, self.counts_per_rev, self.volt, self.name, self.speed
            )
            return stepped.follow(controller, r, name, watch=watch)
        # the machine is deterministic: run it again with the same commands for its counts
        found = run(controller, self.machine, r, name=name)
        recording = self.excite(found.u, name)
        for k in range(0, len(r) if watch is not None else 0, WATCHED):
            assert watch is not None
            watch(k, recording.u[k : k + WATCHED], recording.counts[k : k + WATCHED])
        return RecordedRun.of(found, recording)


OBEYS = 0.02
"""A machine that is not slower so long after rest was commanded does not obey [s]."""
COAST, TAIL = 5.0, 0.25
"""Longest wait for rest after a run was ended, and how much of it is recorded [s]: in seconds of a
machine that nothing stops, what happened before would count little."""


class Stepped(Protocol):
    """A machine that is advanced one sample at a time: a simulator, or a test rig without a clock.

    If it has `speed_rpm`, its true speed [RPM], runs are scored by it, otherwise by the speed
    estimated from counts. If it has `off()`, which takes the power from it whatever the command (a
    contactor, a safe torque off), that is called when a run was ended and rest does not slow it.
    """

    @property
    def counts(self) -> float:
        """Present encoder counts."""

    def reset(self) -> None:
        """Bring it to rest."""

    def step(self, u: float) -> object:
        """Hold a command [V] for one sample."""


def _number(value: Any) -> float:
    """The value as a float, NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


@dataclass(frozen=True, eq=False)
class SteppedBench:
    """A machine that is advanced sample by sample, with the controller computed here.

    Every run, even an aborted one, ends with a sample at 0 V. The guard of a device watches every
    sample (docs/PROTOCOL.md, section 9): a mean speed over 8 samples above `speed` ends the run.

    Parameters
    ----------
    machine : Stepped
        With `reset()`, `step(u)` and `counts`.
    Ts : float
        Sample time [s].
    counts_per_rev : float
        Encoder counts per turn.
    volt : float
        Largest command in either direction [V]; larger ones are clipped.
    name : str
    speed : float
        Speed above which a run is ended with 0 V and a `LinkError` [RPM].

    Raises
    ------
    SettingError
        For a number that is not above 0.
    """

    machine: Stepped
    Ts: float
    counts_per_rev: float
    volt: float
    name: str = "machine"
    speed: float = float("inf")

    def __post_init__(self) -> None:
        _require_numbers(self)
        if isinstance(self.machine, type):
            raise SettingError(
                name="machine", expected="an object with reset(), step(u) and counts",
                received=f"the class {self.machine.__name__}",
                remedy=f"make one: {self.machine.__name__}()",
            )  # fmt: skip
        lacking = [name for name in ("reset", "step") if not hasattr(self.machine, name)]
        if lacking:
            raise SettingError(
                name="machine", expected="an object with reset(), step(u) and counts",
                received=f"{type(self.machine).__name__} without {', '.join(lacking)}",
            )  # fmt: skip

    def within(self, speed: float) -> SteppedBench:
        """The same machine with another limit of speed [RPM]."""
        limited = copy.copy(self)
        object.__setattr__(limited, "speed", speed)
        return limited

    def excite(self, u: FloatArray, name: str) -> Recording:
        require_finite("command", u)
        # in an open loop a machine may stand under any command
        return self._played(lambda k, counts: float(u[k]), len(u), name, math.inf)

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        _require_fit(controller, r, self.Ts)
        core, early = controller.core(), controller.early(r)
        per_count = 60.0 / (self.counts_per_rev * self.Ts)
        u, feedback, before = np.zeros(len(r)), np.zeros(len(r)), [0.0]
        seen = np.zeros(len(r))

        def decide(k: int, counts: float) -> float:
            if watch is not None and k and k % WATCHED == 0:
                watch(k - WATCHED, u[k - WATCHED : k], seen[k - WATCHED : k])
            u[k] = core.step(float(early[k]), (counts - before[0]) * per_count)
            feedback[k], before[0], seen[k] = core.filtered, counts, counts
            return float(u[k])

        # a loop that loses its encoder pushes ever harder; whoever watches looks for that, too
        volt = self.volt if watch is None else math.inf
        recording = self._played(decide, len(r), name, volt)
        truth = recording.speed_true
        t = np.arange(len(r), dtype=np.float64) * self.Ts
        y = recording.y if truth is None else truth
        return RecordedRun(
            t, np.array(r), u, y, feedback, controller, self.name, name, recording=recording
        )

    def _played(
        self, decide: Callable[[int, float], float], samples: int, name: str, volt: float
    ) -> Recording:
        """Counts, from 0, and true speeds, each read before the sample's command acts. A machine
        that stands under half of `volt` [V] ends the run.
        """
        machine = self.machine
        machine.reset()
        first = real(f"counts of {self.name}", getattr(machine, "counts", None))
        if hasattr(machine, "speed_rpm"):
            real(f"speed_rpm of {self.name}", machine.speed_rpm)
        guard = _core.Guard(
            Ts=self.Ts, counts_per_rev=self.counts_per_rev, volt=volt, speed=self.speed
        )
        u, counts, speed = np.zeros(samples), np.zeros(samples), np.zeros(samples)

        def rested(k: int) -> Recording:
            return self._rested(guard, first, name, u[: k + 1], counts[: k + 1], speed[: k + 1])

        try:
            for k in range(samples):
                counts[k] = _number(machine.counts) - first
                speed[k] = _number(getattr(machine, "speed_rpm", np.nan))
                if not math.isfinite(counts[k]):
                    blind = "NoNumber", u[max(0, k - 1)]
                    raise self._ended(name, k, blind, blind[1], guard, rested(max(0, k - 1)))
                if (seen := guard.take(counts[k])) is not None:
                    raise self._ended(name, k, seen, u[max(0, k - 1)], guard, rested(k))
                try:
                    command = decide(k, float(counts[k]))
                except SewfastError as stop:  # of who watches
                    self._explain(stop, rested(k))
                    raise
                u[k] = min(max(command, -self.volt), self.volt)
                if (seen := guard.sent(u[k])) is not None:
                    raise self._ended(name, k, seen, u[k], guard, rested(k))
                machine.step(u[k])
        finally:
            # a test rig holds its last command: no run may leave it turning, however it ends
            machine.step(0.0)
        return Recording.of_counts(
            u, counts, Ts=self.Ts, counts_per_rev=self.counts_per_rev, name=name,
            speed_true=speed if hasattr(machine, "speed_rpm") else None,
        )  # fmt: skip

    def _rested(
        self, guard: _core.Guard, first: float, name: str, u: FloatArray, counts: FloatArray,
        speed: FloatArray,
    ) -> Recording:  # fmt: skip
        """The run so far and how the machine comes to rest: rest is commanded from the last sample
        on until it stands. A stage that is stuck, or a load that drives it, obeys no such command.
        """
        coast: list[tuple[float, float]] = []
        off, obeys = getattr(self.machine, "off", None), max(2, round(OBEYS / self.Ts))
        half = obeys // 2
        pace = abs(counts[-1] - counts[-1 - half]) if len(counts) > half else math.inf
        while len(coast) * self.Ts < COAST and not guard.at_rest:
            turned = abs(coast[-1][0] - coast[-1 - half][0]) if len(coast) == obeys else 0.0
            if off is not None and turned >= pace > 0.0:
                off()
            self.machine.step(0.0)
            now = _number(self.machine.counts) - first
            if not math.isfinite(now):
                break
            guard.take(now)
            coast.append((now, _number(getattr(self.machine, "speed_rpm", np.nan))))
        shown = np.reshape(coast[: round(TAIL / self.Ts)], (-1, 2))
        u = np.append(u[:-1], np.zeros(1 + len(shown)))
        counts, speed = np.append(counts, shown[:, 0]), np.append(speed, shown[:, 1])
        # it can be too short for a speed
        y = speed_or_nan(counts, self.Ts, self.counts_per_rev, "kalman")
        true = speed if hasattr(self.machine, "speed_rpm") else None
        return Recording(u, counts, y, true, self.Ts, self.counts_per_rev, name)

    def _explain(self, error: Any, recording: Recording) -> None:
        """Tell an error what was recorded, and its cause if that shows one."""
        part = getattr(error, "recording", None)
        error.recording = recording if part is None else replace(recording, name=part.name)
        if isinstance(error, LinkError):
            cause = cause_in(recording, volt=self.volt, speed=self.speed)
            if cause is not None:
                error.explain(cause)

    def _ended(
        self,
        name: str,
        k: int,
        seen: tuple[str, float],
        u: float,
        guard: _core.Guard,
        run: Recording,
    ) -> LinkError:
        """The error for what the guard saw at sample `k`; `run` goes on towards rest."""
        expected, received, remedy = SEEN[seen[0]]
        said = f"{received.format(value=seen[1])} after {k * self.Ts:.3g} s"
        under = f", under {u:.3g} V" if seen[0] == "Speed" else ""
        after = "it stands now" if guard.at_rest else f"it still turns {COAST:g} s after that"
        if seen[0] == "NoNumber":
            after = "whether it stands is not known"
        error = LinkError(
            name=f"{self.name}, {name}", expected=expected.format(limit=self.speed),
            received=f"{said}{under}; rest was commanded, and {after}", remedy=remedy,
        )  # fmt: skip
        self._explain(error, run)
        if seen[0] == "Lost":
            error.explain(loss(run, k, error.cause))
        return error
