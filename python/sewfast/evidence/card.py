"""`ReportCard`: how far a model can be trusted, one line per question with its verdict."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

if TYPE_CHECKING:
    from ..dataset import FloatArray
    from .operating import OperatingRange
    from .parameters import Criteria, Parameters
    from .portmanteau import ResidualTest
    from .residuals import HorizonScores, Run
    from .simulation_bands import Bands

__all__ = ["Line", "ReportCard", "Verdict"]


# --- Line and VerdictTable ------------------------------------------------------------------------


Verdict: TypeAlias = Literal["ok", "warn", "fail", "info"]
_ORDER: dict[Verdict, int] = {"info": 0, "ok": 1, "warn": 2, "fail": 3}


@dataclass(frozen=True)
class Line:
    """One line of a report card: a figure with its limit and verdict.

    Attributes
    ----------
    name : str
        The tested quantity.
    value : float
        Its value; NaN if there is none.
    shown : str
        The value as text, with its unit.
    limit : str
        The limit as text; empty for information only.
    verdict : "ok", "warn", "fail" or "info"
    meaning : str
        The meaning and what to do.
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


class VerdictTable:
    """A table of lines; its verdict is their worst one."""

    lines: tuple[Line, ...]
    heading = "Report card"
    style = "report-card"
    """Class of the table in `to_html`."""

    @property
    def title(self) -> str:
        """The title: what was judged."""
        raise NotImplementedError

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the lines."""
        return max((line.verdict for line in self.lines), key=_ORDER.__getitem__, default="info")

    @property
    def summary(self) -> str:
        """Conclusion from the lines and what to do, in a sentence; empty if there is none."""
        return ""

    def line(self, name: str) -> Line:
        """The line of that name.

        Raises
        ------
        KeyError
            If there is no such line.
        """
        for line in self.lines:
            if line.name == name:
                return line
        raise KeyError(f"no line {name!r}; there are {', '.join(x.name for x in self.lines)}")

    def to_html(self) -> str:
        """A table for a page, without script and style; the verdicts are classes of the cells."""
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
        closing = f"<br>{escape(self.summary)}" if self.summary else ""
        return (
            f'<table class="{self.style}"><caption>{escape(self.title)}: '
            f'<b class="verdict {self.verdict}">{self.verdict}</b>{closing}</caption>\n'
            f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody></table>"
        )

    _repr_html_ = to_html

    def __repr__(self) -> str:
        counts = {v: sum(x.verdict == v for x in self.lines) for v in _ORDER}
        text = ", ".join(f"{n} {v}" for v, n in reversed(counts.items()) if n)
        return f"{type(self).__name__}({self.verdict}: {text})"

    def __str__(self) -> str:
        width = 100
        wide = [
            max((len(getattr(x, k)) for x in self.lines), default=0)
            for k in ("name", "shown", "limit")
        ]
        found = [f"{self.heading}: {self.title}", f"verdict: {self.verdict}", ""]
        before = ""
        for x in self.lines:
            cells = zip((x.name, x.shown, x.limit), wide, strict=True)
            found.append(f"{x.verdict:4}  " + "  ".join(c.ljust(w) for c, w in cells).rstrip())
            if x.meaning != before:
                found += textwrap.wrap(
                    x.meaning, width, initial_indent=" " * 6, subsequent_indent=" " * 6
                )
            before = x.meaning
        if self.summary:
            found += ["", *textwrap.wrap(f"in short: {self.summary}", width)]
        return "\n".join(found)


# --- The conclusion of a report card: good enough or not, why, what to do first -------------------


_STEPS = (
    # most important first: mending a later line does not help a model that fails an earlier one
    ("record", "mend the record: its line says how"),
    ("free run", "check the columns, the delay and the orders, or record with a larger excitation"),
    ("largest pole", "record at the operating points that are unstable, and train on them as well"),
    (
        "outside training region",
        "record operation like this, and train on it as well before relying on the model here",
    ),
    ("error over training", "train on data like these as well, or take a smaller model"),
    (
        "parameters on these data",
        "train on this recording as well, and allow a network: a linear model is a compromise "
        "where the plant is nonlinear; if that does not help, the plant has changed in between",
    ),
    (
        "residual with past residual times input",
        "compare recordings from different times: the gain drifts, or noise acts inside the loop",
    ),
    (
        "residual with",
        "let identify search for the structure: it tries other orders, delays and networks",
    ),
    ("squared residual", "allow a network, or check whether the noise grows with the amplitude"),
    ("mean residual", "check whether the zero of a sensor or an amplifier has moved"),
    ("samples per parameter", "record longer, or take a smaller model"),
    ("inside", "read the bands with care: noise or operation differ from the training data"),
)
"""Beginning of a line's name, and what to do if it warns or fails."""


def summary(lines: Sequence[Line]) -> str:
    """Conclusion from the lines of a report card."""
    failed = [x for x in lines if x.verdict == "fail"]
    warned = [x for x in lines if x.verdict == "warn"]
    free = next((x for x in lines if x.name == "free run"), None)
    if free is not None and free.verdict == "fail":
        return f"useless here ({free.shown}); first {_step(failed)}"
    shown = "" if free is None else f" ({free.shown})"
    if free is not None and free.verdict == "info":
        return "the output is constant here, which does not test the model; record one that moves"
    follows = f"the free run follows the data{shown}"
    if free is not None and free.verdict == "warn":
        follows = f"not good enough to tune on: the free run follows the data loosely{shown}"
        warned.remove(free)
    if failed:
        return f"{follows}, and {_counted(failed, 'fail')}; first {_step(failed)}"
    if free is not None and free.verdict == "warn":
        return f"{follows}; first {_step([free, *warned])}"
    if warned:
        return (
            f"good enough to tune on with care{shown}: {_counted(warned, 'warn')}; to do better, "
            f"{_step(warned)}"
        )
    return f"good enough to tune a controller on{shown}: nothing here contradicts the model"


def _counted(lines: Sequence[Line], verb: str) -> str:
    # most lines listed by name; of the others only the number is given
    named = 3
    names = ", ".join(x.name for x in lines[:named])
    more = len(lines) - named
    count = f"one line {verb}s" if len(lines) == 1 else f"{len(lines)} lines {verb}"
    return f"{count} ({names}{f' and {more} more' if more > 0 else ''})"


def _step(lines: Sequence[Line]) -> str:
    for start, step in _STEPS:
        if any(x.name.startswith(start) for x in lines):
            return step
    return "read the lines above"


# --- ReportCard: how far a model can be trusted, in lines with verdicts ---------------------------


FORMAT = "sewfast.report_card"
VERSION = 1


@dataclass(frozen=True, eq=False, repr=False)
class ReportCard(VerdictTable):
    """Lines with verdicts, and the evidence behind them.

    Attributes
    ----------
    lines : tuple of Line
    model, data : str
        The names of the model and the data.
    on_training : bool
        Whether the data are the model's training data.
    scores : HorizonScores
        Errors at every horizon, per experiment and pooled.
    tests : tuple of ResidualTest
    bands : Bands or None
    operating : OperatingRange or None
    parameters : Parameters or None
    criteria : Criteria or None
        Only if the training data are known.
    outside : float
        Share of the samples outside the training region; NaN if it is not known.
    distances : tuple of array, shape (N,)
        Distances from the training region over its bounds, per experiment: above 1 is outside.
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

    def to_json(self) -> dict[str, Any]:
        """The whole card as JSON values."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "model": self.model,
            "data": self.data,
            "on_training": self.on_training,
            "verdict": self.verdict,
            "summary": self.summary,
            "lines": [line.to_json() for line in self.lines],
            "scores": self.scores.to_json(),
            "tests": [_test_json(t) for t in self.tests],
            "bands": self.bands and self.bands.to_json(),
            "criteria": self.criteria and self.criteria.to_json(),
            "parameters": self.parameters and _parameters_json(self.parameters),
            "operating": self.operating and self.operating.to_json(),
            "outside": self.outside if math.isfinite(self.outside) else None,
        }

    @property
    def summary(self) -> str:
        """Whether the model is good enough for tuning, the objections, and what to do first."""
        return summary(self.lines)

    @property
    def title(self) -> str:
        """Model, data, and whether it was trained on them."""
        kind = "its training data" if self.on_training else "data not trained on"
        return f"{self.model} on {self.data} ({kind})"

    def plot(
        self,
        ax: Any = None,
        *,
        figure: str | None = None,
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Draw one figure, by default measured output and free run in its band.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`; one gets the figure's first panel.
        figure : str, optional
            `bands`, `residuals`, `bode`, `poles` or `region`, if the card has data for it.

        Raises
        ------
        SettingError
            For another figure, or as `Drawing.plot`.
        """
        from .figures import drawing

        return drawing(self, figure).plot(ax, file)


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
