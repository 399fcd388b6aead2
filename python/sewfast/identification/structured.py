"""Kinds with several structures: held-out data choose one, which all data are then fitted in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from ..errors import FitError, Interrupted
from ..models import Model
from ..models.base import Fitted, StructuredModel
from .folds import Errors, Split, compared, errors_of, folds, free_runs
from .task import Provenance, Task, arrays, documented, finite, fit_provenance, wrap

_BETTER = math.log(0.98)
"""A structure with more parameters must bring the held-out error below this part of the best."""


def identified_as(cls: type[StructuredModel]) -> Callable[[Task], Model]:
    """`identify` for one kind."""

    def identified(task: Task) -> Model:
        began = time.perf_counter()
        structures = cls.structures(task.hidden)
        chosen, tried = _chosen(cls, task, structures)
        fit = _fit(cls, task, task.data, chosen)
        note = {"initial_state": "estimated", "cost_unit": "output unit squared"}
        known = fit_provenance(fit) | note | {"structure": dict(chosen), "tried": tried}
        model = documented(wrap(cls, fit.model, task.data), task, began, known)
        if fit.termination == "interrupted":
            raise Interrupted(model)
        return model

    return identified


def _fit(cls: type[StructuredModel], task: Task, data: Any, structure: Mapping[str, int]) -> Fitted:
    options = {**task.orders, **structure, "max_iterations": task.iterations_or_usual}
    return cls.fitted(arrays(data), **options, progress=task.progress)


def _chosen(
    cls: type[StructuredModel], task: Task, structures: tuple[Mapping[str, int], ...]
) -> tuple[Mapping[str, int], list[Provenance]]:
    """The structure with the least held-out error, a plainer one where it does about as well.

    So is a pole less, unless the order was given: a spare one drifts to where a trend is followed,
    and takes the steady gain with it.
    """
    parts = folds(task.data, task.validation)[:1]
    if len(structures) == 1 or not parts:
        return structures[-1], []
    held: Split = parts[0]
    best, least, tried = structures[0], None, []

    def errors_with(structure: Mapping[str, int]) -> Errors | None:
        try:
            fit = _fit(cls, task, held.fitted, structure)
        except FitError:
            return None
        if fit.termination == "interrupted":
            raise KeyboardInterrupt
        errors = errors_of(free_runs(fit.model, held), held)
        tried.append({**structure, "held_out_rmse": finite(errors.rmse)})
        return errors

    for structure in structures:
        errors = errors_with(structure)
        if errors is not None and (least is None or compared(errors, least)[0] < _BETTER):
            best, least = structure, errors
    if least is not None and task.na > 1 and not task.is_order_given:
        smaller = {**best, "na": task.na - 1}
        errors = errors_with(smaller)
        if errors is not None:
            ratio, deviation = compared(errors, least)
            best = smaller if ratio <= max(deviation, -_BETTER) else best
    return best, tried
