"""The journal of a commission: its stages and its results so far."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeAlias

from ..causes import ABORTED, Cause
from ..control.controller import Controller
from ..recording import Recording
from ..rules import Fopdt
from .checkpoint import STAGES
from .result import Commissioning

Progress: TypeAlias = Callable[[int, int, str], object]
"""Called with the stages done, their total, and the present stage."""


class Journal:
    """Collects the results; `result` makes a `Commissioning` of them at any time."""

    def __init__(
        self,
        machine: str,
        progress: Progress | None,
        cancel: threading.Event | None = None,
        between: Callable[[str, Commissioning], object] | None = None,
    ) -> None:
        self._progress = progress
        self._cancel, self._between = cancel, between
        self._began: list[tuple[str, float]] = []
        self._values: dict[str, Any] = {"machine": machine, "recordings": {}}

    @property
    def fopdt(self) -> Fopdt:
        """The fit to the step response."""
        found: Fopdt = self._values["fopdt"]
        return found

    @property
    def first(self) -> Controller:
        found: Controller = self._values["first"]
        return found

    def recording(self, name: str) -> Recording:
        found: Recording = self._values["recordings"][name]
        return found

    @property
    def stage(self) -> str:
        return self._began[-1][0] if self._began else STAGES[0]

    def enter(self, stage: str) -> None:
        # register it first: the callbacks can raise to stop
        self._began.append((stage, time.perf_counter()))
        self._report(STAGES.index(stage), stage)
        self.pause(stage)
        # the time that a person took does not count for the stage
        self._began[-1] = (stage, time.perf_counter())

    def pause(self, following: str) -> None:
        """Call `between` with the next step and the results so far; it can wait for a person."""
        if self._between is not None:
            self._between(following, self.result("under way"))
        self.heed()

    def heed(self) -> None:
        """Raise `KeyboardInterrupt` if `cancel` is set."""
        if self._cancel is not None and self._cancel.is_set():
            raise KeyboardInterrupt

    def within(self, done: int, total: int) -> None:
        """Report progress within the stage."""
        self.heed()
        self._report(STAGES.index(self.stage), f"{self.stage} {done}/{total}")

    def finish(self) -> None:
        """Report that all stages are done."""
        self._report(len(STAGES), "done")

    def _report(self, done: int, text: str) -> None:
        if self._progress is not None:
            self._progress(done, len(STAGES), text)

    def keep(self, **values: Any) -> None:
        self._values |= values

    def say(self, note: str) -> None:
        """Add a note on something unusual."""
        self._values["notes"] = (*self._values.get("notes", ()), note)

    def note(self, name: str, recording: Recording) -> None:
        """Store a recording, except those along the references, which are stored as runs."""
        if self.stage != STAGES[-1] or name.startswith("hold_") or name.endswith(ABORTED):
            self._values["recordings"] = {**self._values["recordings"], name: recording}

    @property
    def cause(self) -> Cause | None:
        """What was seen to be wrong with the machine."""
        found: Cause | None = self._values.get("cause")
        return found

    def result(self, verdict: str, reason: str = "") -> Commissioning:
        ends = [t for _, t in self._began[1:]] + [time.perf_counter()]
        seconds = {s: end - t for (s, t), end in zip(self._began, ends, strict=True)}
        return Commissioning(
            **self._values, verdict=verdict, stage=self.stage, reason=reason, seconds=seconds
        )
