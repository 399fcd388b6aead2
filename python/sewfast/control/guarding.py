"""The guard of a machine that has no device: a user's own, a simulator, a test rig."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from .. import _core
from ..arrays import FloatArray, known_until
from ..causes import Cause, loss
from ..errors import DataError, LinkError, SettingError, SewfastError
from ..gains import real, vector
from ..recording import Recording, require_finite
from ..speed import speed_or_nan
from .controller import SampledController
from .machine import Machine, RecordedRun, Watch, cause_in, recording_of, require_fit, watching

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


TAIL = 0.25
"""How much of the way to rest is recorded after a run was ended [s]: in seconds of a machine that
nothing stops, what happened before would count little."""


class RunGuard:
    """A device's own guard (docs/PROTOCOL.md, 9 and 12) for one run of a machine that has no
    device: a `Watch` that ends it if it is faster than `speed` [RPM], if its motor or encoder has
    failed under a command of up to `volt` [V], or if its command swings `between` two limits.
    Counts that are no numbers end it, too, unless the machine is `lossy`: over a link that loses
    samples.
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
        lossy: bool = False,
    ) -> None:
        self.name, self.Ts, self.counts_per_rev, self.speed = name, Ts, counts_per_rev, speed
        self.lossy, self.samples, self.has_ended = lossy, 0, False
        self._guard = _core.Guard(
            Ts=Ts, counts_per_rev=counts_per_rev, volt=volt, speed=speed, between=between
        )
        self._u: list[FloatArray] = []
        self._counts: list[FloatArray] = []

    def __call__(self, first: int, u: FloatArray, counts: FloatArray) -> None:
        """Check samples `first`, `first + 1`, ...; raises what `ended` makes."""
        # from a user's own machine: integers, single precision, lists, columns of a table
        u, counts = vector("u", u).copy(), vector("counts", counts).copy()
        before, self.samples = self.samples, self.samples + len(u)
        # a link tells where samples are missing
        if len(u) != len(counts) or (first != before and not self.lossy):
            raise SettingError(
                name=f"{self.name}, watch", expected=f"the samples from {before} on, each once",
                received=f"{len(u)} commands and {len(counts)} counts from {first} on",
                remedy="call watch(first, u[first:k], counts[first:k]), then first = k",
            )  # fmt: skip
        self._u.append(u)
        self._counts.append(counts)
        known = len(u) if self.lossy else known_until(u, counts)
        found = self._guard.watch(u[:known], counts[:known])
        end = before + known
        if found is not None:
            after, (reason, value) = found
            end = before + after + 1
        elif known < len(u):
            reason, value = "NoNumber", float(u[known])
        else:
            return
        self.has_ended = True
        all_u, all_counts = (np.concatenate(x)[:end] for x in (self._u, self._counts))
        raise self.ended(reason, value, all_u, all_counts)

    def ended(self, reason: str, value: float, u: FloatArray, counts: FloatArray) -> SewfastError:
        """The error of a run that was ended, from its commands [V] and counts until then."""
        counts = counts - counts[:1]
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
        require_finite("command", u)
        u = np.clip(u, -self.volt, self.volt)
        # in an open loop a machine may stand under any command
        with self._guarded(name, math.inf) as guard:
            watched = watching(self.inner.excite, guard)
            found = self.inner.excite(u, name, **watched)
            self._look_at(guard, require_made(self, name, found, Recording), bool(watched))
            require_record(self, name, len(u), found, lossy=True)
            return found

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        require_fit(controller, r, self.Ts)
        require_reference(self, controller, r)
        controller = controller.limited(self.volt)
        with self._guarded(name, self.volt) as guard:

            def both(first: int, u: FloatArray, counts: FloatArray) -> None:
                guard(first, u, counts)
                if watch is not None:
                    watch(first, u, counts)

            watched = watching(self.inner.follow, both)
            found = self.inner.follow(controller, r, name, **watched)
            made = require_made(self, name, found, RecordedRun)
            self._look_at(guard, made.recording, bool(watched))
            require_run(self, name, len(r), found, lossy=True)
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

    def _look_at(self, guard: RunGuard, recording: Recording, is_watched: bool) -> None:
        """Refuse a run whose recording shows that it was too fast."""
        if math.isfinite(self.speed):
            whole = _core.Guard(
                Ts=self.Ts, counts_per_rev=self.counts_per_rev, volt=math.inf, speed=self.speed
            )
            seen = whole.watch(recording.u, recording.counts)
            if seen is not None:
                k, (reason, value) = seen
                error = guard.error(reason, value, recording, k + 1, _late(guard, is_watched))
                # what a run does long after a fault hides it
                end = k + 1 + round(TAIL / self.Ts)
                u, counts, y = recording.u[:end], recording.counts[:end], recording.y[:end]
                if error.cause is None:
                    short = replace(recording, u=u, counts=counts, y=y, speed_true=None)
                    self._explain(error, short)
                raise error


def _late(guard: RunGuard, is_watched: bool) -> str:
    """Why a run that was too fast was not ended in time."""
    if guard.has_ended:
        return "the run went on after its `watch` had ended it: let that exception pass"
    if is_watched:
        return f"it was seen after the run, whose `watch` was shown {guard.samples} samples"
    return "it was seen after the run, which nobody could end: let it take a `watch`"


def require_numbers(machine: object) -> None:
    """Refuse a machine whose sample time, counts or limits are no numbers above 0."""
    for name in ("Ts", "counts_per_rev", "volt", "speed"):
        value = real(name, getattr(machine, name))
        if not value > 0.0 or (math.isinf(value) and name != "speed"):
            raise SettingError(
                name=name, expected="a finite number above 0", received=f"{value!r}",
                remedy="math.inf if it states none" if name == "speed" else "see the data sheet",
            )  # fmt: skip


def require_reference(machine: Machine, controller: SampledController, r: FloatArray) -> None:
    """Refuse a reference beyond the speed that a machine must not pass, as a device does."""
    fastest = float(np.max(np.abs(r), initial=0.0)) if controller.LOOP == "speed" else 0.0
    if fastest > machine.speed * (1.0 + 1e-6):
        raise SettingError(
            name=f"{machine.name}, reference", expected=f"within its +-{machine.speed:g} RPM",
            received=f"{fastest:g} RPM", remedy="scale it",
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


def require_record(
    machine: Machine, name: str, samples: int, found: object, *, lossy: bool = False
) -> None:
    """Refuse an unusable recording of a user's own machine; a link may have lost samples."""
    made = require_made(machine, name, found, Recording)
    columns = {"u": made.u, "counts": made.counts, "y": made.y}
    _require_columns(f"{machine.name}, {name}", columns, samples, "command", lossy=lossy)
    for member in ("Ts", "counts_per_rev"):
        own, its = getattr(machine, member), getattr(made, member)
        if not math.isclose(own, its, rel_tol=1e-6):
            raise DataError(
                name=f"{machine.name}, {name}", expected=f"the machine's {member} of {own:g}",
                received=f"{its:g}", remedy="state the same in both",
            )  # fmt: skip


def require_run(
    machine: Machine, name: str, samples: int, found: object, *, lossy: bool = False
) -> None:
    """The same for a closed loop."""
    made = require_made(machine, name, found, RecordedRun)
    require_record(machine, name, samples, made.recording, lossy=lossy)
    columns = {"r": made.r, "u": made.u, "y": made.y}
    _require_columns(
        f"{machine.name}, {name}", columns, samples, "sample of the reference", lossy=lossy
    )


def _require_columns(
    where: str, columns: Mapping[str, FloatArray], samples: int, each: str, *, lossy: bool
) -> None:
    """Refuse a column with a missing sample or, unless `lossy`, one that is not finite."""
    for column, values in columns.items():
        if np.shape(values) != (samples,):
            raise DataError(
                name=where, expected=f"{column} of shape ({samples},), one for each {each}",
                received=f"shape {np.shape(values)}", remedy="log every sample of the run",
            )  # fmt: skip
        if not lossy:
            require_finite(f"{where}: {column}", values)
