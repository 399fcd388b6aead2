"""The white noise of a measurement, which closed loops on a model measure as well."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from typing import TypeVar, cast

from ..dataset import Dataset
from ..dataset.outliers import quantum
from ..errors import FitError
from ..models import Model
from ..validation import noise_of
from .task import with_provenance

M = TypeVar("M", bound=Model)


def with_noise(model: M, data: Dataset) -> M:
    """The model with the noise of its output in `training`, and so its alternatives.
    It stays unchanged without noise, and if its output was computed from counts: a loop then has
    the encoder itself.
    """
    if model.counts is not None:
        return model
    others = tuple(_noisy(m, data) for m in model.alternatives)
    return replace(_noisy(model, data), alternatives=others)


def _noisy(model: M, data: Dataset) -> M:
    """Third differences show white noise, and fast motion beside it that a free run explains.
    What is rounded to a grid has at least the noise of rounding (Widrow, Kollar and Liu 1996).
    """
    outputs = [e.y for e in data.experiments]
    found = [noise_of(outputs)]
    with contextlib.suppress(FitError):  # a free run that diverges explains nothing
        found.append(noise_of([y - f for y, f in zip(outputs, model.simulate(data), strict=True)]))
    white = min((n for n in found if math.isfinite(n)), default=0.0)
    rounded = min((quantum(y) or 0.0 for y in outputs), default=0.0) / math.sqrt(12.0)
    noise = max(white, rounded)
    return cast("M", with_provenance(model, {"noise": noise})) if noise > 0.0 else model
