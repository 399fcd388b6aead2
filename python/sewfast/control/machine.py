"""`Machine`, the protocol of machines for recording, running and commissioning.

Read on in `guarding` (the guard of a machine without a device), `benches` (machines of this
process) and `record`. A drive behind a port is itself a `Machine` (`sewfast.link.Drive`).
"""

from __future__ import annotations

import contextlib
import inspect
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Protocol, TypeAlias, TypeGuard

import numpy as np

from ..arrays import FloatArray
from ..causes import Cause, cause_of
from ..errors import DataError, SettingError
from ..recording import Recording, require_finite
from .controller import SampledController
from .loop import ClosedLoopRun


@dataclass(frozen=True, eq=False)
class RecordedRun(ClosedLoopRun):
    """A closed loop on a machine; for a virtual machine, `y` is the true speed.

    Attributes
    ----------
    recording : Recording
        The run as measured by the encoder, for identification.
    place, goal : array, shape (N,), or None
        Of a position loop on a device: the profile's position, and where it goes [counts].
    """

    recording: Recording
    place: FloatArray | None = field(default=None, kw_only=True)
    goal: FloatArray | None = field(default=None, kw_only=True)

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
        require_fit(controller, r, recording.Ts)
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


def require_fit(controller: SampledController, r: FloatArray, Ts: float) -> None:
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


def cancelled_by(cancel: threading.Event | None) -> dict[str, Any]:
    """The option `cancel`, left out if None, as a user's streaming machine may lack it."""
    return {} if cancel is None else {"cancel": cancel}


MEMBERS = ("name", "Ts", "counts_per_rev", "volt", "speed", "excite", "follow")
