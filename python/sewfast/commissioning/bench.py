"""`Bench`: what is commissioned, as commissioning sees it."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun, run
from ..dataset import FloatArray
from ..errors import LinkError, SettingError
from ..link.plan import Plan, Stopped, conditions_of, device_of, play, run_of_drive
from ..machine import VirtualMachine
from ..recording import Recording, record, recording_of_drive
from ..speed import speed_from_counts

if TYPE_CHECKING:
    from ..link import Drive


@dataclass(frozen=True, eq=False)
class Followed:
    """A closed loop on a machine.

    Attributes
    ----------
    run : ClosedLoopRun
        With the true speed where the machine is a virtual one.
    recording : Recording
        The same with what its encoder saw: what may be learned from.
    """

    run: ClosedLoopRun
    recording: Recording


class Bench(Protocol):
    """A machine that can be excited and run, each time from rest.

    Anything with these members can be commissioned.
    """

    @property
    def name(self) -> str:
        """Of the machine."""

    @property
    def Ts(self) -> float:
        """Sample time [s]."""

    @property
    def counts_per_rev(self) -> float:
        """Encoder counts of one turn."""

    @property
    def volt(self) -> float:
        """Largest command that it takes [V]."""

    @property
    def speed(self) -> float:
        """Speed beyond which it stops by itself [RPM]; inf where there is none."""

    def excite(self, u: FloatArray, name: str) -> Recording:
        """Play commands [V]."""

    def follow(self, controller: Controller, r: FloatArray, name: str) -> Followed:
        """Run a controller along a reference [RPM]."""


@dataclass(frozen=True)
class MachineBench:
    """A virtual machine of this process."""

    machine: VirtualMachine
    speed: float = float("inf")

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
        return record(self.machine, u, name=name)

    def follow(self, controller: Controller, r: FloatArray, name: str) -> Followed:
        # undisturbed, the machine does the same again and shows its counts
        found = run(controller, self.machine, r, name=name)
        return Followed(found, record(self.machine, found.u, name=name))


class Stepped(Protocol):
    """A machine that is advanced one sample at a time: a simulator, or a test rig without a clock.

    `speed_rpm`, where there is one, is its true speed [RPM]: runs are then scored by it, and by the
    speed estimated from counts otherwise.
    """

    @property
    def counts(self) -> float:
        """What its encoder shows now."""

    def reset(self) -> None:
        """Bring it to rest."""

    def step(self, u: float) -> None:
        """Hold a command [V] for one sample."""


@dataclass(frozen=True, eq=False)
class SteppedBench:
    """Any machine that can be advanced sample by sample, with sewfast's own controller around it.

    Every run ends with a sample at 0 V, also one that is broken off.

    Parameters
    ----------
    machine : Stepped
        With `reset()`, `step(u)` and `counts`.
    Ts : float
        Sample time [s].
    counts_per_rev : float
        Encoder counts of one turn.
    volt : float
        Largest command that it takes to either side [V]; larger ones are clipped.
    name : str
    speed : float
        Speed beyond which it stops by itself [RPM].
    """

    machine: Stepped
    Ts: float
    counts_per_rev: float
    volt: float
    name: str = "machine"
    speed: float = float("inf")

    def excite(self, u: FloatArray, name: str) -> Recording:
        return self._recording(u, *self._played(lambda k, counts: float(u[k]), len(u)), name)

    def follow(self, controller: Controller, r: FloatArray, name: str) -> Followed:
        core = controller.core()
        per_count = 60.0 / (self.counts_per_rev * self.Ts)
        u, feedback, before = np.zeros(len(r)), np.zeros(len(r)), [0.0]

        def decide(k: int, counts: float) -> float:
            u[k] = core.step(float(r[k]), (counts - before[0]) * per_count)
            feedback[k], before[0] = core.filtered, counts
            return float(u[k])

        recording = self._recording(u, *self._played(decide, len(r)), name)
        truth = recording.speed_true
        t = np.arange(len(r), dtype=np.float64) * self.Ts
        y = recording.y if truth is None else truth
        found = ClosedLoopRun(t, np.array(r), u, y, feedback, controller, self.name, name)
        return Followed(found, recording)

    def _played(
        self, decide: Callable[[int, float], float], samples: int
    ) -> tuple[FloatArray, FloatArray | None]:
        """Counts, from 0, and true speeds, each read before the sample's command acts."""
        machine = self.machine
        machine.reset()
        first, counts, speed = machine.counts, np.zeros(samples), np.zeros(samples)
        try:
            for k in range(samples):
                counts[k], speed[k] = machine.counts - first, getattr(machine, "speed_rpm", np.nan)
                machine.step(min(max(decide(k, float(counts[k])), -self.volt), self.volt))
        finally:
            # a rig holds its last command: no run leaves it turning, however it ends
            machine.step(0.0)
        return counts, speed if hasattr(machine, "speed_rpm") else None

    def _recording(
        self, u: FloatArray, counts: FloatArray, speed: FloatArray | None, name: str
    ) -> Recording:
        y = speed_from_counts(counts, self.Ts, self.counts_per_rev, method="kalman")
        u = np.clip(u, -self.volt, self.volt)
        return Recording(u, counts, y, speed, self.Ts, self.counts_per_rev, name)


@dataclass(eq=False)
class DriveBench:
    """A drive behind a port, whose limits have been set; `cancel` ends its run as Ctrl-C does."""

    drive: Drive
    cancel: threading.Event | None = field(default=None, kw_only=True)

    @property
    def name(self) -> str:
        return self.drive.identity.name

    @property
    def Ts(self) -> float:
        return self.drive.identity.Ts

    @property
    def counts_per_rev(self) -> float:
        return self.drive.identity.counts_per_rev

    @property
    def volt(self) -> float:
        return self.drive.limits().values[0]

    @property
    def speed(self) -> float:
        return self.drive.limits().values[1]

    def excite(self, u: FloatArray, name: str) -> Recording:
        columns = self._whole(Plan("commands", u), name)
        return recording_of_drive(columns, self.drive, name, "kalman")

    def follow(self, controller: Controller, r: FloatArray, name: str) -> Followed:
        columns = self._whole(Plan("controller", r, controller), name)
        return Followed(
            run_of_drive(columns, self.drive, controller, r, name),
            recording_of_drive(columns, self.drive, name, "kalman"),
        )

    def _whole(self, plan: Plan, name: str) -> dict[str, FloatArray]:
        """The columns of a run of which nothing is missing.

        What the link has lost of a run that ended well is no danger to the machine: the run is
        made once more, from rest as every run.
        """
        for _ in range(2):
            try:
                played = play(self.drive, plan, name=name, cancel=self.cancel)
            except Stopped as stopped:
                raise stopped.cause from None
            if played.outcome.is_complete:
                return played.columns
        raise LinkError(
            f"{name}: expected every sample of the run, received twice not all, at last: "
            f"{played.outcome}; mend the link (sewfast doctor PORT), then commission again"
        )


@dataclass(frozen=True)
class NotedBench:
    """A bench that hands every recording to `note` as it comes, with the run where a loop ran.

    What an earlier attempt has recorded under the same name of the very same command, or of the
    same controller and reference, is not recorded again: `kept` finds it by its key.
    """

    inner: Bench
    note: Callable[[str, str, Recording, ClosedLoopRun | None], object]
    kept: Callable[[str, str], Recording | None]
    kept_run: Callable[[str, str, Controller], Followed | None]

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
        key = key_of(u)
        recording = self.kept(name, key) or self.inner.excite(u, name)
        self.note(name, key, recording, None)
        return recording

    def follow(self, controller: Controller, r: FloatArray, name: str) -> Followed:
        key = key_of(r, controller)
        found = self.kept_run(name, key, controller) or self.inner.follow(controller, r, name)
        self.note(name, key, found.recording, found.run)
        return found


def key_of(signal: FloatArray, controller: Controller | None = None) -> str:
    """What tells a command, or a reference with its controller, from any other."""
    design = "" if controller is None else json.dumps(controller.to_dict(), sort_keys=True)
    return hashlib.sha256(np.ascontiguousarray(signal).tobytes() + design.encode()).hexdigest()


def told_of(bench: Bench) -> tuple[dict[str, Any], dict[str, Any]]:
    """Device and conditions, as recordings state them."""
    if isinstance(bench, DriveBench):
        return device_of(bench.drive), conditions_of(bench.drive)
    kind = "virtual" if isinstance(bench, MachineBench) else "bench"
    return {"kind": kind, "name": bench.name}, {}


@contextmanager
def bench_of(
    on: object, u_max: float | None, cancel: threading.Event | None = None
) -> Iterator[Bench]:
    """The bench of a machine; a drive's volt limit is at most `u_max` as long as it lasts.

    Raises
    ------
    SettingError
        For anything else.
    """
    if isinstance(on, VirtualMachine):
        yield MachineBench(on)
    elif hasattr(on, "stream"):
        drive = cast("Drive", on)
        before = drive.limits().volt
        if u_max is not None and u_max < before:
            drive.set_limits(volt=u_max)
        try:
            yield DriveBench(drive, cancel=cancel)
        finally:
            if drive.limits().volt != before:
                drive.set_limits(volt=before)
    elif hasattr(on, "excite") and hasattr(on, "follow"):
        yield cast(Bench, on)
    else:
        raise SettingError(
            "expected a VirtualMachine, a Drive or a Bench to commission, got "
            f"{type(on).__name__}; sewfast.VirtualMachine(), or connect to a drive"
        )
