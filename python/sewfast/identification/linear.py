"""Models of a given kind: ARX, instrumental variables, output error; kinds with structures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..dataset.experiment import mean_square, weights_of
from ..dynamic_model import INIT
from ..errors import DataError, FitError, Interrupted
from ..models import ARX, IV, LinearOE, Model
from ..models.base import Fitted, StructuredModel
from .folds import RUNAWAY, Errors, Split, compared, errors_of, folds, free_runs, with_run_up
from .task import (
    Provenance,
    Task,
    arrays,
    documented,
    finite,
    fit_provenance,
    with_provenance,
    wrap,
)


def arx(task: Task) -> Model:
    """Least squares of the one-step error."""
    began = time.perf_counter()
    core = _core.fit_arx(arrays(task.data), **task.orders, offset=True)
    provenance = {"cost_horizon": "one step", "initial_state": "measured", "termination": "solved"}
    model = documented(wrap(ARX, core, task.data), task, began, provenance)
    pairs = list(zip(task.data.experiments, model.predict(task.data), strict=True))
    squares = np.concatenate([(e.y - yhat)[INIT:] ** 2 for e, yhat in pairs])
    weights = np.concatenate([weights_of(e)[INIT:] for e, _ in pairs])
    cost = mean_square(squares, weights) / 2
    return with_provenance(model, {"cost": cost, "cost_unit": "output unit squared"})


def iv(task: Task) -> Model:
    """Refined instrumental variables."""
    began = time.perf_counter()
    fit = _core.fit_iv(arrays(task.data), **task.fit_options())
    settled = fit.termination == "small_step"
    note = f"instrumental variables did not settle ({fit.termination}); consider model oe"
    model = linear_model(task, fit, began, {} if settled else {"notes": [note]}, IV)
    if fit.termination == "interrupted":
        raise Interrupted(model)
    return model


def oe(task: Task) -> Model:
    """Linear output error."""
    began = time.perf_counter()
    return linear_model(task, linear_fit(task, began), began)


def linear_fit(task: Task, began: float) -> _core.LinearFit:
    """Output error in the task's orders on all its data."""
    fit = _core.fit_oe(arrays(task.data), **task.fit_options())
    if fit.termination == "interrupted":
        raise Interrupted(linear_model(task, fit, began))
    return fit


def linear_model(
    task: Task,
    fit: _core.LinearFit,
    began: float,
    extra: Provenance | None = None,
    cls: type[IV] | type[LinearOE] = LinearOE,
) -> Model:
    """The model of a fit, with its provenance."""
    provenance: Provenance = {"initial_state": "estimated", "cost_unit": "output unit squared"}
    provenance |= {"standard_errors": _standard_errors(fit)}
    known = fit_provenance(fit) | provenance | (extra or {})
    return documented(wrap(cls, fit.model, task.data), task, began, known)


def _standard_errors(fit: _core.LinearFit) -> Provenance:
    """Standard errors for white measurement noise; None for undetermined coefficients."""
    errors = [e if math.isfinite(e) else None for e in fit.standard_errors.tolist()]
    (na, (inputs, nb)) = (fit.model.na, fit.model.b.shape)
    b = [errors[na + j * nb :][:nb] for j in range(inputs)]
    return {"a": errors[:na], "b": b, "offset": errors[-1]}


# --- Records too short to choose by: one pole less if they cannot show it -------------------------


UNSEEN = 3.0
"""Time constants of more than this many times the longest experiment are trends, not dynamics."""
EARLIER = 0.7
"""Part of every experiment to fit to when two orders are compared on the rest."""
AS_GOOD = 1.05
"""Ratio of the smaller order's error to the larger one's up to which the smaller one is enough."""


def short(task: Task, began: float, reason: str) -> Model:
    """Output error on all data in the task's orders, or with one pole less.

    A free initial state and a pole near 1 can follow any drift over a short record, and the steady
    gain of such a model is arbitrary. The smaller order is used if the record can show all its
    poles and it does about as well, on the whole record or on its later part when fitted to the
    earlier one. A drive that really integrates has such a pole in both, or needs the larger order.
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
    """The fit with one pole less, if it should be used."""
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
    """Time constant of the slowest pole [samples]; infinite on and outside the unit circle."""
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
    """Errors on the later part of a model of the earlier one; infinite if there is no model."""
    experiments = task.data.experiments
    cuts = [round(EARLIER * len(e)) for e in experiments]
    pairs = list(zip(experiments, cuts, strict=True))
    fitted = replace(task.data, experiments=tuple(e.cut(0, at) for e, at in pairs))
    held = tuple(with_run_up(e, at, len(e)) for e, at in pairs)
    part = Split(fitted, replace(task.data, experiments=held))
    fit = _tried(task, fitted)
    return RUNAWAY if fit is None else errors_of(free_runs(fit.model, part), part)


# --- Kinds with several structures: chosen on held-out data, then fitted to all data --------------


_BETTER = math.log(0.98)
"""A structure with more parameters must reduce the held-out error to this part of the best."""
SHARE_OF_CHOICE = 0.45
"""Share of a time budget for the choice; the rest is for the fit to all data."""


def identified_as(cls: type[StructuredModel]) -> Callable[[Task], Model]:
    """`identify` for one kind."""

    def identified(task: Task) -> Model:
        began = time.perf_counter()
        structures = cls.structures(task.hidden)
        tried: list[Provenance] = []

        def described(structure: Mapping[str, int], fit: Fitted) -> Model:
            note = {"initial_state": "estimated", "cost_unit": "output unit squared"}
            known = fit_provenance(fit) | note | {"structure": dict(structure), "tried": tried}
            if task.clock.truncated and len(structures) > 1:
                known["notes"] = [
                    f"the time budget of {task.clock.budget:g} s ended the choice of a structure "
                    f"early: {len(tried)} tried"
                ]
            return documented(wrap(cls, fit.model, task.data), task, began, known)

        try:
            chosen = _chosen(cls, task, structures, tried)
        except _Stopped as stopped:
            raise Interrupted(described(stopped.structure, stopped.fit)) from None
        fit = _fit(cls, task, task.data, chosen)
        model = described(chosen, fit)
        if fit.termination == "interrupted":
            raise Interrupted(model)
        return model

    return identified


class _Stopped(Exception):
    """Ctrl-C during the choice, with the best fit so far."""

    def __init__(self, structure: Mapping[str, int], fit: Fitted) -> None:
        super().__init__()
        self.structure, self.fit = structure, fit


def _fit(cls: type[StructuredModel], task: Task, data: Any, structure: Mapping[str, int]) -> Fitted:
    options = {**task.orders, **structure, "max_iterations": task.iterations_or_usual}
    return cls.fitted(arrays(data), **options, progress=task.progress)


def _chosen(
    cls: type[StructuredModel],
    task: Task,
    structures: tuple[Mapping[str, int], ...],
    tried: list[Provenance],
) -> Mapping[str, int]:
    """The structure with the least held-out error, or a simpler one that does about as well.

    Unless the order was given, one pole less is tried too: a superfluous pole follows trends and
    spoils the steady gain. If the share of a time budget is used up, the best so far.
    """
    parts = folds(task.data, task.validation)[:1]
    if len(structures) == 1 or not parts:
        return structures[-1]
    held: Split = parts[0]
    brief = replace(task, progress=task.clock.limited(task.progress, SHARE_OF_CHOICE))
    best = structures[0]
    kept: Fitted | None = None
    least: Errors | None = None

    def tested(structure: Mapping[str, int]) -> tuple[Fitted, Errors] | None:
        try:
            fit = _fit(cls, brief, held.fitted, structure)
        except FitError:
            return None
        if fit.termination == "interrupted":
            if kept is None and fit.iterations and not task.clock.over(SHARE_OF_CHOICE):
                raise _Stopped(structure, fit)
            raise KeyboardInterrupt
        errors = errors_of(free_runs(fit.model, held), held)
        tried.append({**structure, "held_out_rmse": finite(errors.rmse)})
        return fit, errors

    try:
        for structure in structures:
            found = tested(structure)
            if found and (least is None or compared(found[1], least)[0] < _BETTER):
                best, (kept, least) = structure, found
        if least is not None and task.na > 1 and not task.is_order_given:
            smaller = {**best, "na": task.na - 1}
            found = tested(smaller)
            if found:
                ratio, deviation = compared(found[1], least)
                best = smaller if ratio <= max(deviation, -_BETTER) else best
    except KeyboardInterrupt:
        if task.clock.over(SHARE_OF_CHOICE):
            return best
        if kept is None:
            raise
        raise _Stopped(best, kept) from None
    return best
