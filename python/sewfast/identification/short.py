"""Records too short to choose by: second order, unless its slowest pole is one they cannot show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..errors import DataError, FitError, Interrupted
from ..models import Model
from .folds import RUNAWAY, Errors, Split, errors_of, free_runs, with_run_up
from .linear import linear_fit, linear_model
from .task import Task, arrays

UNSEEN = 3.0
"""Time constants of so many times the longest experiment are a trend to it, and no dynamics."""
EARLIER = 0.7
"""Part of every experiment by which the rest is predicted, where two orders are compared."""
AS_GOOD = 1.05
"""Ratio of the smaller order's error that tells no need of the larger one."""


def short(task: Task, began: float, reason: str) -> Model:
    """Output error on all data in the task's orders, or of one pole less.

    A free initial state and a pole near 1 follow whatever drifts over a short record; the steady
    gain of such a model is of any size and sign. The smaller order is taken where all its poles are
    ones that the record shows, and it does about as well, on the whole or on the later part by what
    came before. A drive that does integrate has such a pole in both, or needs the larger order.
    """
    fit = linear_fit(task, began)
    try:
        other = _without_unseen(task, fit)
    except KeyboardInterrupt:
        raise Interrupted(linear_model(task, fit, began)) from None
    if other is not None:
        fit = other
        reason += "; a pole that so short a record cannot show is left out"
    return linear_model(task, fit, began, {"choice": {"chosen": "oe", "reason": reason}})


def _without_unseen(task: Task, fit: _core.LinearFit) -> _core.LinearFit | None:
    """The fit of one pole less, where it is to be taken."""
    longest = max(len(e) for e in task.data.experiments)
    if task.na < 2 or time_constant(fit.model) <= UNSEEN * longest:
        return None
    smaller = replace(task, na=task.na - 1)
    other = _tried(smaller, task.data)
    if other is None or time_constant(other.model) > longest:
        return None
    about_as_good = other.cost <= AS_GOOD**2 * fit.cost
    if about_as_good or _later(smaller).rmse <= AS_GOOD * _later(task).rmse:
        return other
    return None


def time_constant(model: _core.LinearModel) -> float:
    """Of the slowest pole [samples]; infinite at the unit circle and beyond."""
    radius = float(np.hypot(*model.poles().T).max())
    if radius >= 1.0:
        return float("inf")
    return -1.0 / float(np.log(radius)) if radius > 0.0 else 0.0


def _tried(task: Task, data: Dataset) -> _core.LinearFit | None:
    try:
        fit = _core.fit_oe(arrays(data), **task.fit_options())
    except (DataError, FitError):
        return None
    if fit.termination == "interrupted":
        raise KeyboardInterrupt
    return fit


def _later(task: Task) -> Errors:
    """Errors on the later part of a model of the earlier one; infinite where there is none."""
    experiments = task.data.experiments
    cuts = [round(EARLIER * len(e)) for e in experiments]
    pairs = list(zip(experiments, cuts, strict=True))
    fitted = replace(task.data, experiments=tuple(e.cut(0, at) for e, at in pairs))
    held = tuple(with_run_up(e, at, len(e)) for e, at in pairs)
    part = Split(fitted, replace(task.data, experiments=held))
    fit = _tried(task, fitted)
    return RUNAWAY if fit is None else errors_of(free_runs(fit.model, part), part)
