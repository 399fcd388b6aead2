"""`Journal`: a commissioning under way, its stages and what came so far."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, TypeAlias

from ..control.controller import Controller
from ..recording import Recording
from ..rules import Fopdt
from .bench import ABORTED
from .checkpoint import STAGES
from .result import Commissioning

Progress: TypeAlias = Callable[[int, int, str], object]
"""Called with stages done, stages in all, and what comes now."""


class Journal:
    """Collects results; a `Commissioning` can be had at any time.

    Parameters
    ----------
    machine : str
    progress : callable or None
    cancel : threading.Event or None
    between : callable or None
        See `commission`.
    """

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
        self.pause(stage)
        # a person's time is not the stage's
        self._began[-1] = (stage, time.perf_counter())

    def pause(self, following: str) -> None:
        """Say what comes next, with what there is; whoever listens may take time over it."""
        if self._between is not None:
            self._between(following, self.result("under way"))
        self.heed()

    def heed(self) -> None:
        """End where that was asked for.

        Raises
        ------
        KeyboardInterrupt
        """
        if self._cancel is not None and self._cancel.is_set():
            raise KeyboardInterrupt

    def within(self, done: int, total: int) -> None:
        """Tell how far the stage is."""
        self.heed()
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
        if self.stage != STAGES[-1] or name.startswith("hold_") or name.endswith(ABORTED):
            self._values["recordings"] = {**self._values["recordings"], name: recording}

    def result(self, verdict: str, reason: str = "") -> Commissioning:
        """What there is."""
        ends = [t for _, t in self._began[1:]] + [time.perf_counter()]
        seconds = {s: end - t for (s, t), end in zip(self._began, ends, strict=True)}
        return Commissioning(
            **self._values, verdict=verdict, stage=self.stage, reason=reason, seconds=seconds
        )
