"""Wrappers around a `Machine` for commissioning: complete runs, saved recordings, a guard."""

from __future__ import annotations

import hashlib
import json
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from .. import _core
from ..causes import ABORTED
from ..control.benches import MachineBench, Stepped, SteppedBench, machine_of
from ..control.controller import SampledController
from ..control.guarding import SEEN, MachineWrapper, RunGuard, require_record, require_run
from ..control.loop import ClosedLoopRun
from ..control.machine import (
    Followed,
    Machine,
    RecordedRun,
    Watch,
    cancelled_by,
    is_streaming,
    recording_of,
    watching,
)
from ..dataset import FloatArray
from ..errors import LinkError
from ..link import Drive
from ..link.record import conditions_of, device_of
from ..recording import Recording
from ..speed import speed_or_nan
from .demands import Refusal

__all__ = ["Bench", "Followed", "MachineBench", "Stepped", "SteppedBench"]

Bench = Machine
"""Earlier name of `sewfast.Machine`."""


class Aborted(Refusal):
    """A run ended early: its `recording`, and the `frequency` of a swinging command [Hz]."""

    def __init__(
        self, reason: str, recording: Recording, *, frequency: float | None = None
    ) -> None:
        super().__init__(reason)
        self.recording, self.frequency = recording, frequency

    @classmethod
    def after(
        cls,
        reason: str,
        name: str,
        u: FloatArray,
        counts: FloatArray,
        like: SampledController,
        counts_per_rev: float,
        *,
        frequency: float | None = None,
    ) -> Aborted:
        """The error for a run of this name, from its commands [V] and counts until then."""
        counts, u = counts - counts[:1], u.copy()
        y = speed_or_nan(counts, like.Ts, counts_per_rev, "kalman")
        return cls(
            f"{name!r}, ended after {len(u) * like.Ts:.3g} s: {reason}",
            Recording(u, counts, y, None, like.Ts, counts_per_rev, f"{name}{ABORTED}"),
            frequency=frequency,
        )


class Guard(RunGuard):
    """The guard of a loop, which ends it as a `Refusal`. Under feedback, a lost encoder means a
    motor at full speed until the end of the reference.
    """

    def __init__(
        self,
        controller: SampledController,
        name: str,
        counts_per_rev: float,
        speed: float = math.inf,
        lossy: bool = False,
    ) -> None:
        low, high = controller.u_min, controller.u_max
        super().__init__(
            name, controller.Ts, counts_per_rev, volt=max(-low, high), speed=speed,
            between=(low, high), lossy=lossy,
        )  # fmt: skip
        self._controller = controller

    def ended(self, reason: str, value: float, u: FloatArray, counts: FloatArray) -> Aborted:
        """The refusal."""
        stop = Aborted.after(
            seen(reason, value, self.speed), self.name, u, counts, self._controller,
            self.counts_per_rev, frequency=value if reason == "Swinging" else None,
        )  # fmt: skip
        if reason == "Lost":
            stop.cause = self.lost(stop.recording, len(u))
        return stop


def seen(reason: str, value: float, limit: float) -> str:
    """What a guard saw, as a sentence."""
    expected, received, remedy = SEEN[reason]
    return f"expected {expected.format(limit=limit)}, got {received.format(value=value)}; {remedy}"


@dataclass
class DriveBench(MachineWrapper):
    """A drive behind a port with its limits set, which returns complete runs only. If the link has
    lost samples of a run that ended well, the run is repeated once: every run starts from rest, and
    lost samples do not endanger the machine. Setting `cancel` ends a run as Ctrl-C does.
    """

    cancel: threading.Event | None = field(default=None, kw_only=True)

    @property
    def drive(self) -> Drive:
        return cast(Drive, self.inner)

    def excite(self, u: FloatArray, name: str) -> Recording:
        recording = self.drive.excite(u, name, **cancelled_by(self.cancel))
        if not self._is_whole:
            recording = self.drive.excite(u, name, **cancelled_by(self.cancel))
        self._require_whole(name)
        return recording

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        options = {**cancelled_by(self.cancel), "watch": watch}
        run = self.drive.follow(controller, r, name, **options)
        if not self._is_whole:
            run = self.drive.follow(controller, r, name, **options)
        self._require_whole(name)
        return run

    @property
    def _is_whole(self) -> bool:
        outcome = self.drive.outcome
        return outcome is not None and outcome.is_complete

    def _require_whole(self, name: str) -> None:
        if not self._is_whole:
            raise LinkError(
                name=name, expected="every sample of the run",
                received=f"twice not all, at last: {self.drive.outcome}",
                remedy="mend the link (sewfast doctor PORT), then commission again",
            )  # fmt: skip


@dataclass
class RecordedBench(MachineWrapper):
    """A machine that hands every recording to `note`, together with the run of a closed loop.
    A recording that an earlier attempt made under the same name with exactly the same command, or
    the same controller and reference, is not made again: `kept` finds it by its key.
    """

    note: Callable[[str, str, Recording, ClosedLoopRun | None], object]
    kept: Callable[[str, str], Recording | None]
    kept_run: Callable[[str, str, SampledController], RecordedRun | None]
    runs: list[Recording] = field(default_factory=list)
    """All runs so far, in order, the last one as far as it went."""
    most: float = math.inf
    """Speed that no machine needs to pass [RPM]; it counts if the machine states none."""

    def __post_init__(self) -> None:
        if isinstance(self.inner, SteppedBench) and math.isinf(self.inner.speed):
            self.inner = self.inner.within(self.most)

    def excite(self, u: FloatArray, name: str) -> Recording:
        key = key_of(u)
        recording = self.kept(name, key)
        if recording is None:
            with self._keeping_what_failed():
                guard = RunGuard(
                    name, self.Ts, self.counts_per_rev, speed=self._stated, lossy=self._is_lossy
                )
                recording = self.inner.excite(u, name, **watching(self.inner.excite, guard))
                require_record(self.inner, name, len(u), recording)
                self._require_speed(name, key, recording)
        self.runs.append(recording)
        self.note(name, key, recording, None)
        return recording

    @contextmanager
    def _keeping_what_failed(self) -> Iterator[None]:
        try:
            yield
        except (Aborted, LinkError) as stop:
            found = recording_of(stop)
            if isinstance(found, Recording):
                self.runs.append(found)
            raise

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        key = key_of(r, controller)
        found = self.kept_run(name, key, controller)
        if found is None:
            guard = Guard(controller, name, self.counts_per_rev, self._stated, self._is_lossy)

            def both(first: int, u: FloatArray, counts: FloatArray) -> None:
                guard(first, u, counts)
                if watch is not None:
                    watch(first, u, counts)

            with self._keeping_what_failed():
                try:
                    found = super().follow(controller, r, name, watch=both)
                except (Aborted, LinkError) as stop:
                    # under another name, so that a resumed commissioning repeats the run
                    ended = recording_of(stop)
                    if isinstance(ended, Recording):
                        self.note(f"{name}{ABORTED}", key, ended, None)
                    raise
                require_run(self.inner, name, len(r), found)
                # nobody has watched a machine without a watch, nor the last samples of another
                self._require_speed(name, key, found.recording)
        self.runs.append(found.recording)
        self.note(name, key, found.recording, found)
        return found

    @property
    def _is_lossy(self) -> bool:
        return isinstance(self.inner, DriveBench)

    @property
    def _stated(self) -> float:
        """The speed that the machine must not pass [RPM]; a drive's device watches its own."""
        if self._is_lossy:
            return math.inf
        return self.most if math.isinf(self.inner.speed) else self.inner.speed

    def _require_speed(self, name: str, key: str, recording: Recording) -> None:
        """Refuse a run that was faster than stated."""
        guard = _core.Guard(
            Ts=self.Ts, counts_per_rev=self.counts_per_rev, volt=math.inf, speed=self._stated
        )
        found = guard.watch(recording.u, recording.counts)
        if found is None:
            return
        k, (reason, value) = found
        aborted = replace(recording, name=f"{name}{ABORTED}")
        self.note(aborted.name, key, aborted, None)
        raise Aborted(
            f"{name!r}, {k * self.Ts:.3g} s after its start: " + seen(reason, value, self._stated),
            aborted,
        )


def key_of(signal: FloatArray, controller: SampledController | None = None) -> str:
    """A hash that identifies a command, or a reference with its controller."""
    design = "" if controller is None else json.dumps(controller.to_dict(), sort_keys=True)
    return hashlib.sha256(np.ascontiguousarray(signal).tobytes() + design.encode()).hexdigest()


def description_of(bench: Machine) -> tuple[dict[str, Any], dict[str, Any]]:
    """Description of the device, and conditions, for recordings."""
    if isinstance(bench, DriveBench):
        return device_of(bench.drive), conditions_of(bench.drive)
    kind = "virtual" if isinstance(bench, MachineBench) else "bench"
    return {"kind": kind, "name": bench.name}, {}


@contextmanager
def bench_of(
    on: object, u_max: float | None, cancel: threading.Event | None = None
) -> Iterator[Machine]:
    """The machine to commission; for a drive, with a limit of at most `u_max` [V] meanwhile."""
    machine = machine_of(on)
    if not is_streaming(machine):
        yield machine
        return
    drive = cast(Drive, machine)
    before = drive.limits().volt
    if u_max is not None and u_max < before:
        drive.set_limits(volt=u_max)
    try:
        yield DriveBench(drive, cancel=cancel)
    finally:
        if drive.limits().volt != before:
            drive.set_limits(volt=before)
