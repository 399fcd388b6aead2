"""`ReportCard`: how far a model can be trusted, one line per question with its verdict."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

if TYPE_CHECKING:
    from ..dataset import FloatArray
    from .correlations import ResidualTest
    from .criteria import Criteria
    from .operating import OperatingRange
    from .parameters import Parameters
    from .residuals import Run
    from .scores import HorizonScores
    from .simulation_bands import Bands

Verdict: TypeAlias = Literal["ok", "warn", "fail", "info"]
FORMAT = "sewfast.report_card"
VERSION = 1
_ORDER: dict[Verdict, int] = {"info": 0, "ok": 1, "warn": 2, "fail": 3}
_WIDTH = 100


@dataclass(frozen=True)
class Line:
    """One question.

    Attributes
    ----------
    name : str
        What was looked at.
    value : float
        The number; NaN where there is none.
    shown : str
        The number as text, with its unit.
    limit : str
        What it is held against; empty for information alone.
    verdict : "ok", "warn", "fail" or "info"
    meaning : str
        What it says about the model and what to do.
    """

    name: str
    value: float
    shown: str
    limit: str
    verdict: Verdict
    meaning: str

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        value = self.value if math.isfinite(self.value) else None
        return {
            "name": self.name,
            "value": value,
            "shown": self.shown,
            "limit": self.limit,
            "verdict": self.verdict,
            "meaning": self.meaning,
        }


@dataclass(frozen=True, eq=False, repr=False)
class ReportCard:
    """Lines with verdicts, and the evidence behind them.

    Attributes
    ----------
    lines : tuple of Line
    model, data : str
        What was checked on what.
    on_training : bool
        Whether the data are those that the model was identified from.
    scores : HorizonScores
        Errors at every horizon, per experiment and pooled.
    tests : tuple of ResidualTest
    bands : Bands or None
    operating : OperatingRange or None
    parameters : Parameters or None
    criteria : Criteria or None
        Where the training data are known.
    outside : float
        Share of the samples outside the training region; NaN where it is not known.
    distances : tuple of array, shape (N,)
        Distance to the nearest known point over the region's radius, per experiment.
    runs : tuple of Run
        Free runs: outputs, measured and computed.
    """

    lines: tuple[Line, ...]
    model: str
    data: str
    on_training: bool
    scores: HorizonScores
    tests: tuple[ResidualTest, ...]
    bands: Bands | None
    operating: OperatingRange | None
    parameters: Parameters | None
    criteria: Criteria | None
    outside: float
    distances: tuple[FloatArray, ...]
    runs: tuple[Run, ...]
    Ts: float
    output_name: str
    unit: str

    @property
    def verdict(self) -> Verdict:
        """The worst of the lines."""
        return max((line.verdict for line in self.lines), key=_ORDER.__getitem__, default="info")

    def line(self, name: str) -> Line:
        """The line of that name.

        Raises
        ------
        KeyError
            Where there is none.
        """
        for line in self.lines:
            if line.name == name:
                return line
        raise KeyError(f"no line {name!r}; there are {', '.join(x.name for x in self.lines)}")

    def to_json(self) -> dict[str, Any]:
        """The whole card as JSON values."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "model": self.model,
            "data": self.data,
            "on_training": self.on_training,
            "verdict": self.verdict,
            "lines": [line.to_json() for line in self.lines],
            "scores": self.scores.to_json(),
            "tests": [_test_json(t) for t in self.tests],
            "bands": self.bands and self.bands.to_json(),
            "criteria": self.criteria and self.criteria.to_json(),
            "parameters": self.parameters and _parameters_json(self.parameters),
            "operating": self.operating and self.operating.to_json(),
            "outside": self.outside if math.isfinite(self.outside) else None,
        }

    def to_html(self) -> str:
        """A table for a page: no script, no style of its own, verdicts as classes of the cells."""
        rows = "\n".join(
            f'<tr><th scope="row">{escape(x.name)}</th><td>{escape(x.shown)}</td>'
            f"<td>{escape(x.limit)}</td>"
            f'<td class="verdict {x.verdict}">{x.verdict}</td><td>{escape(x.meaning)}</td></tr>'
            for x in self.lines
        )
        heads = "".join(
            f'<th scope="col">{h}</th>'
            for h in ("question", "value", "limit", "verdict", "meaning")
        )
        return (
            f'<table class="report-card"><caption>{escape(self.title)}: '
            f'<b class="verdict {self.verdict}">{self.verdict}</b></caption>\n'
            f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody></table>"
        )

    @property
    def title(self) -> str:
        kind = "its training data" if self.on_training else "data not trained on"
        return f"{self.model} on {self.data} ({kind})"

    def __repr__(self) -> str:
        counts = {v: sum(x.verdict == v for x in self.lines) for v in _ORDER}
        text = ", ".join(f"{n} {v}" for v, n in reversed(counts.items()) if n)
        return f"ReportCard({self.verdict}: {text})"

    def __str__(self) -> str:
        wide = [max(len(getattr(x, k)) for x in self.lines) for k in ("name", "shown", "limit")]
        found = [f"Report card: {self.title}", f"verdict: {self.verdict}", ""]
        for x in self.lines:
            cells = zip((x.name, x.shown, x.limit), wide, strict=True)
            found.append(f"{x.verdict:4}  " + "  ".join(c.ljust(w) for c, w in cells).rstrip())
            found += textwrap.wrap(
                x.meaning, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6
            )
        return "\n".join(found)


def _test_json(t: ResidualTest) -> dict[str, Any]:
    known = math.isfinite(t.p_value)
    return {
        "name": t.name,
        "title": t.title,
        "judges": t.judges,
        "p_value": t.p_value if known else None,
        "statistic": t.statistic if known else None,
        "threshold": t.threshold if known else None,
        "freedom": t.freedom,
        "explained": t.explained,
        "lags": t.lags.tolist(),
        "series": list(t.series),
        "correlations": t.correlations.tolist(),
        "limits": t.limits.tolist(),
    }


def _parameters_json(p: Parameters) -> dict[str, Any]:
    return {
        "number": len(p.values),
        "effective": p.effective,
        "condition": p.condition if math.isfinite(p.condition) else None,
        "undetermined": p.undetermined,
        "names": list(p.names),
        "values": p.values.tolist(),
        "standard_errors": p.standard_errors.tolist(),
    }
