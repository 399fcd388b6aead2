"""Kinds with several structures: held-out data choose one, which all data are then fitted in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from ..errors import FitError, Interrupted
from ..models import Model
from ..models.base import Fitted, StructuredModel
from .folds import Errors, Split, compared, errors_of, folds, free_runs
from .task import Provenance, Task, arrays, documented, finite, fit_provenance, wrap

_BETTER = math.log(0.98)
"""A structure with more parameters must bring the held-out error below this part of the best."""
SHARE_OF_CHOICE = 0.45
"""Of a time budget; what is chosen is fitted to all data in the rest."""


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
    """The structure with the least held-out error, a plainer one where it does about as well.

    So is a pole less, unless the order was given: a spare one drifts to where a trend is followed,
    and takes the steady gain with it. Where its share of a time budget is used up, the best so far.
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
