"""`ReportCard`: how far a model can be trusted, one line per question with its verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .lines import Judged, Line, Verdict
from .summary import summary

if TYPE_CHECKING:
    from ..dataset import FloatArray
    from .correlations import ResidualTest
    from .criteria import Criteria
    from .operating import OperatingRange
    from .parameters import Parameters
    from .residuals import Run
    from .scores import HorizonScores
    from .simulation_bands import Bands

FORMAT = "sewfast.report_card"
VERSION = 1

__all__ = ["Line", "ReportCard", "Verdict"]


@dataclass(frozen=True, eq=False, repr=False)
class ReportCard(Judged):
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
        """Whether the model is good enough to tune on, what speaks against it, what to do first."""
        return summary(self.lines)

    @property
    def title(self) -> str:
        """Model, data, and whether it was trained on them."""
        kind = "its training data" if self.on_training else "data not trained on"
        return f"{self.model} on {self.data} ({kind})"


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
