"""Machines of this process: the virtual one, and any that is advanced sample by sample."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

import numpy as np

from .. import _core
from ..arrays import FloatArray
from ..causes import loss
from ..errors import LinkError, SettingError, SewfastError
from ..gains import real
from ..machine import VirtualMachine
from ..recording import Recording, require_finite
from ..speed import Method, speed_or_nan
from .controller import SampledController
from .guarding import (
    SEEN,
    TAIL,
    GuardedMachine,
    MachineWrapper,
    require_numbers,
    require_reference,
)
from .loop import run
from .machine import (
    MEMBERS,
    WATCHED,
    Machine,
    RecordedRun,
    Watch,
    cause_in,
    is_streaming,
    require_fit,
)


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
COAST = 5.0
"""Longest wait for rest after a run was ended [s]."""


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
    except (TypeError, ValueError, OverflowError):
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
        require_numbers(self)
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
        require_fit(controller, r, self.Ts)
        require_reference(self, controller, r)
        controller = controller.limited(self.volt)
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
            turned = abs(coast[-1][0] - coast[-1 - half][0]) if len(coast) >= obeys else 0.0
            # at any time: a load that hangs is slowed first, and then falls
            if off is not None and turned >= pace > 0.0:
                self._switched_off(off)
                off = None
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

    def _switched_off(self, off: Callable[[], object]) -> None:
        """Take the power from the machine; why it failed must not hide what ended the run."""
        try:
            off()
        except Exception as failed:
            warnings.warn(f"{self.name}: off() failed: {failed!r}", RuntimeWarning, stacklevel=2)

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


def guarded(machine: Machine) -> Machine:
    """A machine whose runs are watched: those of a device or of a bench of this package are."""
    if is_streaming(machine) or isinstance(machine, MachineWrapper):
        return machine
    kind = type(machine)
    # a subclass of one's own may play in its own way
    for known in (SteppedBench, MachineBench):
        if kind.excite is known.excite and kind.follow is known.follow:
            return machine
    require_numbers(machine)
    return GuardedMachine(machine)
