"""`Judgement`: what speaks against a set of closed loops, one line per guard."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from ..control.loop import ClosedLoopRun
from ..evidence.card import Judged, Line
from .disagreement import Disagreement
from .limits import Limits
from .oscillation import Oscillation

FORMAT = "sewfast.judgement"
VERSION = 1


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """One run and what was seen in it.

    Attributes
    ----------
    run : ClosedLoopRun
    outside, farthest : float
        Share of the samples outside the training region, and the largest distance over the
        region's radius; NaN where no region is known.
    saturated : float
        Share of the samples with the command at a limit.
    oscillation : Oscillation or None
        None where no stretch of constant reference is long enough.
    """

    run: ClosedLoopRun
    outside: float
    farthest: float
    saturated: float
    oscillation: Oscillation | None

    @property
    def name(self) -> str:
        """Reference and plant."""
        return f"{self.run.reference} on {self.run.plant}"

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        o = self.oscillation
        return {
            "reference": self.run.reference,
            "plant": self.run.plant,
            "outside": self.outside if math.isfinite(self.outside) else None,
            "farthest": self.farthest if math.isfinite(self.farthest) else None,
            "saturated": self.saturated,
            "oscillation": o and dict(vars(o)),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Judgement(Judged):
    """Lines with verdicts, and the runs behind them.

    Attributes
    ----------
    lines : tuple of Line
        `training region`, `saturation`, `limit cycle`, `disagreement`.
    runs : tuple of JudgedRun
    disagreements : tuple of Disagreement
        One per reference that several plants ran.
    limits : Limits
    """

    lines: tuple[Line, ...]
    runs: tuple[JudgedRun, ...]
    disagreements: tuple[Disagreement, ...]
    limits: Limits

    heading = "Closed loop"
    style = "judgement"

    @property
    def title(self) -> str:
        """How many runs of which references."""
        names = ", ".join(dict.fromkeys(r.run.reference for r in self.runs))
        return f"{len(self.runs)} run{'s' if len(self.runs) > 1 else ''} of {names}"

    @property
    def warnings(self) -> tuple[Line, ...]:
        """The lines whose verdict is `warn` or `fail`."""
        return tuple(x for x in self.lines if x.verdict in ("warn", "fail"))

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "verdict": self.verdict,
            "lines": [line.to_json() for line in self.lines],
            "runs": [run.to_json() for run in self.runs],
            "disagreements": [{**vars(d), "share": d.share} for d in self.disagreements],
            "limits": dict(vars(self.limits)),
        }
