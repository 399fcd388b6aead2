"""`Journal`: what has come of a commissioning so far, stage by stage."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeAlias

from ..control.controller import Controller
from ..recording import Recording
from ..rules import Fopdt
from .result import Commissioning

Progress: TypeAlias = Callable[[int, int, str], object]
"""Called with stages done, stages in all, and what comes now."""

STAGES = (
    "first motion",
    "step response",
    "small signals",
    "limits",
    "closed loop",
    "training",
    "tuning",
    "verification",
)


class Journal:
    """Collects results; a `Commissioning` can be had at any time.

    Parameters
    ----------
    machine : str
    progress : callable or None
    """

    def __init__(self, machine: str, progress: Progress | None) -> None:
        self._progress = progress
        self._began: list[tuple[str, float]] = []
        self._values: dict[str, Any] = {"machine": machine, "recordings": {}}

    @property
    def fopdt(self) -> Fopdt:
        """Of the step response."""
        found: Fopdt = self._values["fopdt"]
        return found

    @property
    def first(self) -> Controller:
        """The first gains."""
        found: Controller = self._values["first"]
        return found

    def recording(self, name: str) -> Recording:
        """One that was noted."""
        found: Recording = self._values["recordings"][name]
        return found

    @property
    def stage(self) -> str:
        """The one that is on."""
        return self._began[-1][0] if self._began else STAGES[0]

    def enter(self, stage: str) -> None:
        """Begin a stage."""
        # begun before it is told: whoever is told may stop
        self._began.append((stage, time.perf_counter()))
        self._tell(STAGES.index(stage), stage)

    def within(self, done: int, total: int) -> None:
        """Tell how far the stage is."""
        self._tell(STAGES.index(self.stage), f"{self.stage} {done}/{total}")

    def finish(self) -> None:
        """All stages are through."""
        self._tell(len(STAGES), "done")

    def _tell(self, done: int, text: str) -> None:
        if self._progress is not None:
            self._progress(done, len(STAGES), text)

    def keep(self, **values: Any) -> None:
        """Results."""
        self._values |= values

    def say(self, note: str) -> None:
        """What went otherwise than usual."""
        self._values["notes"] = (*self._values.get("notes", ()), note)

    def note(self, name: str, recording: Recording) -> None:
        """A recording, but for those along the references, which are runs."""
        if self.stage != STAGES[-1] or name.startswith("hold_"):
            self._values["recordings"] = {**self._values["recordings"], name: recording}

    def result(self, verdict: str, reason: str = "") -> Commissioning:
        """What there is."""
        ends = [t for _, t in self._began[1:]] + [time.perf_counter()]
        seconds = {s: end - t for (s, t), end in zip(self._began, ends, strict=True)}
        return Commissioning(
            **self._values, verdict=verdict, stage=self.stage, reason=reason, seconds=seconds
        )
