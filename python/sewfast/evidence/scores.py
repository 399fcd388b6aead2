"""`HorizonScores`: errors one step, k steps ahead and in free run, per experiment and pooled."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..dataset import Dataset, FloatArray
from ..dynamic_model import DynamicModel
from ..validation import Scores
from .residuals import Residuals

STEPS = (1, 5, 20)


@dataclass(frozen=True)
class HorizonScores:
    """Scores by horizon.

    Attributes
    ----------
    pooled : mapping of horizon to Scores
        Horizons are `free run` and `1 step`, `5 steps`, ..
    experiments : mapping of horizon to tuple of Scores
        None where an experiment has no sample to score.
    names : tuple of str
        Of the experiments, with their ranges.
    """

    pooled: dict[str, Scores]
    experiments: dict[str, tuple[Scores | None, ...]]
    names: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {
            horizon: {
                **scores.to_json(),
                "experiments": [
                    {"name": n, **(s.to_json() if s else {"rmse": None})}
                    for n, s in zip(self.names, self.experiments[horizon], strict=True)
                ],
            }
            for horizon, scores in self.pooled.items()
        }


def horizon_scores(
    model: DynamicModel, data: Dataset, residuals: Residuals, steps: tuple[int, ...] = STEPS
) -> HorizonScores:
    """Errors at every horizon; those of some steps ahead only where the outputs are complete.

    Parameters
    ----------
    model, data
    residuals : Residuals
        Their free run.
    steps : tuple of int
    """
    series: dict[str, list[FloatArray]] = {"free run": [r.yhat for r in residuals.runs]}
    if all(np.isfinite(e.y).all() for e in data.experiments):
        for k in steps:
            name = "1 step" if k == 1 else f"{k} steps"
            series[name] = model.predict(data, k, init=residuals.init)
    pooled, single = {}, {}
    for name, runs in series.items():
        pairs = [
            (r.y[r.counts], yhat[r.counts]) for r, yhat in zip(residuals.runs, runs, strict=True)
        ]
        single[name] = tuple(Scores.of(y, yhat) if len(y) else None for y, yhat in pairs)
        pooled[name] = Scores.of(*(np.concatenate(c) for c in zip(*pairs, strict=True)))
    names = tuple(f"{r.name} [{r.range_text}]" for r in residuals.runs)
    return HorizonScores(pooled, single, names)


def fit_text(scores: Scores, unit: str) -> str:
    """`rmse 1.23 RPM, fit 98.7 %`."""
    fit = f", fit {scores.fit_percent:.2f} %" if math.isfinite(scores.fit_percent) else ""
    return f"{scores.rmse:.4g} {unit}".rstrip() + fit
