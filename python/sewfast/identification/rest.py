"""What loops on a model take from its record: the level at rest, and the noise of its output."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np

from ..dataset import Dataset, Experiment, FloatArray
from ..dataset.experiment import without_weightless
from ..dataset.outliers import quantum
from ..dataset.standing import SIGMAS, Standing, standing
from ..equilibrium import Linearised, linearise
from ..errors import FitError, SettingError
from ..evidence.region import stored_region
from ..evidence.residuals import representative
from ..models import Model
from ..models.rest import Rest
from ..validation import doubling, noise_of
from .task import free_run_rmse, with_provenance

M = TypeVar("M", bound=Model)


def for_loops(model: M, data: Dataset) -> M:
    """The model, and so its alternatives, with its rest and the noise of its output in `training`:
    none of them if it is zero.
    """
    found = _standing(data)

    def each(m: Model) -> Model:
        return _noisy(_rested(m, data, found), data)

    return cast("M", replace(each(model), alternatives=tuple(map(each, model.alternatives))))


def _rested(model: M, data: Dataset, found: _Found | None) -> M:
    is_rest = found is not None and not _answers_earlier(model, found, data)
    rest = found.rest if found is not None and is_rest else _equilibrium(model, data)
    if rest is None or rest.is_zero:
        return model
    try:
        model.about(rest)
    except SettingError:
        return model  # its own zero is its rest
    return cast("M", with_provenance(model, {"rest": rest.to_json()}))


@dataclass(frozen=True)
class _Found:
    """The first samples of an experiment, which stand still."""

    level: Standing
    experiment: Experiment

    @property
    def rest(self) -> Rest:
        """Their level, as that of a model."""
        return Rest(self.level.u, self.level.y, "standing samples", self.level.near_zero)


def _standing(data: Dataset) -> _Found | None:
    """The level of the experiment that stands with the least command, and of those the longest."""
    levels = [_Found(s, e) for e in data.experiments if (s := standing(e)) is not None]
    return min(levels, key=lambda f: (math.hypot(*f.level.u), -f.level.samples), default=None)


def _answers_earlier(model: Model, found: _Found, data: Dataset) -> bool:
    """Whether a model that stands elsewhere, which its own error does not explain, leaves it open
    that the first command came with the first sample: another one of the record has its equilibrium
    there, and so few samples would hardly answer the change.
    """
    level, e = found.level, without_weightless(found.experiment)
    if len(level.u) > 1 or doubling(model) is not None:
        return False
    small = linearise(representative(model).core, np.array(level.u), level=level.y)
    gain = (small.C @ np.linalg.pinv(np.eye(len(small.A)) - small.A) @ small.B + small.D).item()
    if not small.settled or gain == 0.0:
        return False
    change = (small.y - level.y) / gain
    ((low, high),) = data.input_range
    earlier = low <= level.u[0] - change <= high
    if not earlier or abs(small.y - level.y) <= SIGMAS * free_run_rmse(model, data):
        return False
    left = e.y[: level.samples] - level.y
    worse = (left - change * _step(small, level.samples)) ** 2 - left**2
    return bool(np.nansum(worse) <= (SIGMAS * level.scatter) ** 2)


def _step(small: Linearised, n: int) -> FloatArray:
    """The response of a small signal to a step of its first input, shape (n,)."""
    x, y = np.zeros(len(small.A)), np.zeros(n)
    for k in range(small.delay, n):
        y[k] = (small.C @ x)[0] + small.D[0, 0]
        x = small.A @ x + small.B[:, 0]
    return y


def _equilibrium(model: Model, data: Dataset) -> Rest | None:
    """The model's equilibrium without a command, or with the least recorded one.
    If the model is known at neither, as the record is too fast to have stayed there, it is that
    with their mean. The record has been at rest or not, so the level is kept within the recorded
    outputs. It is zero if the model's own error does not tell it from zero.
    """
    held = _held(data)
    if doubling(model) is not None:
        return held
    low, high = np.array(data.input_range, dtype=np.float64).T
    zero = np.zeros(len(low))
    known = ((u, _level(model, u, data)) for u in (zero, np.clip(zero, low, high)))
    u, off = next((pair for pair in known if pair[1] is not None), (zero, None))
    if off is None and held is not None:
        u = np.array(held.u)
        off = _level(model, u)
        if off is not None and not data.output_range[0] <= off <= data.output_range[1]:
            off = held.y  # what integrates stands at any level
    if off is None:
        return None
    y = float(np.clip(off, *data.output_range))
    if not u.any() and abs(y) <= free_run_rmse(model, data):
        return None
    return Rest(tuple(float(v) for v in u), y, "equilibrium")


def _held(data: Dataset) -> Rest | None:
    """The mean command and output of a record that a loop held, which are an equilibrium but for
    what the motion at both ends is worth; none if both are within a standard deviation of zero.
    """
    u = np.concatenate([e.u for e in data.experiments])
    y = np.concatenate([e.y for e in data.experiments])
    level, mean = float(np.nanmean(y)), u.mean(axis=0)
    if abs(level) <= float(np.nanstd(y)) and (np.abs(mean) <= u.std(axis=0)).all():
        return None
    return Rest(tuple(float(v) for v in mean), level, "equilibrium")


def _level(model: Model, u: FloatArray, data: Dataset | None = None) -> float | None:
    """The steady output at constant inputs, if there is one; with `data`, where these show the
    model: in its region, or in the ranges of the record where a budget left no time for a region,
    or where it has no outputs, as they integrate.
    """
    found = linearise(representative(model).core, u)
    if not (found.settled and math.isfinite(found.y)):
        return None
    if data is None:
        return found.y
    region = stored_region(model)
    if region is not None and not region.integrates:
        return found.y if region.holds(u, found.y) else None
    ranges, values = (*data.input_range, data.output_range), (*u, found.y)
    inside = all(low <= v <= high for (low, high), v in zip(ranges, values, strict=True))
    return found.y if inside else None


def _noisy(model: M, data: Dataset) -> M:
    """Third differences show white noise, and fast motion beside it that a free run explains, or
    for an unstable plant a prediction of one step. What is rounded to a grid has at least the noise
    of rounding (Widrow, Kollar and Liu 1996). An output that was computed from counts has none: a
    loop then has the encoder itself.
    """
    if model.counts is not None:
        return model
    outputs = [e.y for e in data.experiments]
    found = [noise_of(outputs)]
    with contextlib.suppress(FitError):  # a free run that diverges explains nothing
        found.append(noise_of([y - f for y, f in zip(outputs, model.simulate(data), strict=True)]))
    if model.training.get("cost_horizon") == "one step":
        # what a model does not predict one step ahead is at least the noise
        found.append(math.sqrt(2.0 * model.training["cost"]))
    white = min((n for n in found if math.isfinite(n)), default=0.0)
    rounded = min((quantum(y) or 0.0 for y in outputs), default=0.0) / math.sqrt(12.0)
    noise = max(white, rounded)
    return cast("M", with_provenance(model, {"noise": noise})) if noise > 0.0 else model
