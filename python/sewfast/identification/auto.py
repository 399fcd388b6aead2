"""The default: linear models, a ladder of small networks, the choice and its reasons."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..errors import FitError, Interrupted
from ..models import Ensemble, LinearOE, Model, NeuralSS
from .candidate import Candidate
from .finish import ENOUGH_TO_CHOOSE_BY, LEAST_AGREEING, Finished, finish, ratios
from .folds import LEAST_HELD_OUT, SHARE, folds
from .linear import linear_model
from .outputs import LINEAR
from .plan import plan_of
from .search import Search
from .task import Story, Task, arrays, bare, finite, told, with_story
from .training import Stopped

_NO_NETWORK = "too few samples for a network, or none stayed finite on data not trained on"
AGREEMENT = 1 / 3
"""Part of the starts that has to come out about as good as the best and to pass the guard."""
WORTH_IT = 0.9
"""The network must bring the free-run error below this part of the linear model's."""


def auto(task: Task) -> Model:
    """The network where it is worth it, else the linear output-error model."""
    return _found(task, always_network=False)


def neural_ss(task: Task) -> Model:
    """The state-space network, whether it is worth it or not."""
    return _found(task, always_network=True)


def _found(task: Task, always_network: bool) -> Model:
    began = time.perf_counter()
    parts = folds(task.data, task.validation)
    if not parts:
        return _without_held_out(task, began, always_network)
    search = Search.of(task, plan_of(task, len(parts[0].fitted)), parts)
    order = 0
    try:
        order = search.linear_order()
        return _chosen(search, order, began, always_network)
    except Stopped as stopped:
        raise Interrupted(_best_so_far(search, order, began, stopped)) from None


def _chosen(search: Search, order: int, began: float, always_network: bool) -> Model:
    best = search.ladder()
    if best is None:
        return _linear(search, began, {}, _NO_NETWORK)
    found = ratios(search, best, order, WORTH_IT) if order else [0.0]
    worth = max(found) < WORTH_IT
    rmse = {"oe": search.linear_error(order), "neural_ss": best.error}
    reason = _reason(found)
    if not worth and not always_network:
        return _linear(search, began, rmse, reason)
    finished = finish(search, best)
    if not always_network and not _is_fixed(search, finished.candidate):
        agreeing, all_ = finished.candidate.agreeing, len(finished.candidate.starts)
        disagree = f"only {agreeing} of the network's {all_} starts agree"
        return _linear(search, began, rmse, f"{disagree}: the data do not fix it")
    model = _network(search, finished, began, rmse, reason)
    return model if worth else told(model, {"notes": [f"{reason}; consider model oe"]})


def _is_fixed(search: Search, candidate: Candidate) -> bool:
    """Whether starts enough agree; more than two where held-out data do not tell the best one."""
    is_told = search.split.scored >= ENOUGH_TO_CHOOSE_BY
    least = 1 if is_told or search.task.starts is not None else LEAST_AGREEING
    return candidate.agreement >= AGREEMENT and candidate.agreeing >= least


def _reason(found: Sequence[float]) -> str:
    shares = ", ".join(f"{100 * r:.1f} %" for r in found)
    parts = "" if len(found) == 1 else f", on {len(found)} later parts in turn, the last first"
    return (
        f"free-run error of the network on data not trained on: {shares} of the linear model's"
        f"{parts}; the network is chosen below {100 * WORTH_IT:.0f} %"
    )


# --- models -----------------------------------------------------------------------------------


def _network(search: Search, finished: Finished, began: float, rmse: Story, reason: str) -> Model:
    task, structure = search.task, finished.candidate.structure
    choice = _choice(search, "neural_ss", rmse, reason)
    choice["chosen_structure"] = structure.to_json()
    choice["final_free_run_rmse"] = finite(finished.candidate.error)
    if structure.nk == 0 and task.nk is None:
        choice["reason"] += (
            "; nk = 0: the output depends on the input of the same sample; for a plant of a "
            "control loop give nk=1"
        )
    fitted = task.data if finished.was_refitted else search.split.fitted
    story = {
        "initial_state": "estimated",
        "cost_horizon": "free run",
        "cost_unit": "output unit squared",
        "termination": "time budget" if task.clock.bit else "chosen by free run",
        "seed": task.seed,
        "samples_fitted": len(fitted),
        "weight_decay": structure.decay,
        "choice": choice,
    }
    model = _of_cores(finished.cores, task.data, story)
    model = with_story(model, task, began, {"cost": _cost(model, task.data), **story})
    return _with_budget(model, task)


def _of_cores(cores: Sequence[_core.NeuralSS], data: Dataset, story: Story) -> Model:
    kept = {k: story[k] for k in ("weight_decay", "samples_fitted")}
    models = [told(bare(NeuralSS, core, data), kept) for core in cores]
    return models[0] if len(models) == 1 else Ensemble.of(models)


def _linear(search: Search, began: float, rmse: Story, reason: str) -> Model:
    """Output error on all data, in the order best on all folds."""
    task, order = search.task, search.best_order()
    orders = {"na": order, "nb": order + 1, "nk": search.nk}
    fit = _core.fit_oe(arrays(task.data), **task.fit_options(**orders))
    choice = _choice(search, "oe", rmse, reason)
    return _with_budget(linear_model(task, fit, began, {"choice": choice}), task)


def _without_held_out(task: Task, began: float, always_network: bool) -> Model:
    """A record too short to choose by: second order, and no network."""
    reason = (
        f"the record is too short to hold out {100 * SHARE:.0f} % of every experiment, at least "
        f"{LEAST_HELD_OUT} samples, to compare on"
    )
    if always_network:
        raise FitError(f"{task.data.source}: {reason}; record longer, or give validation data")
    fit = _core.fit_oe(arrays(task.data), **task.fit_options())
    return linear_model(task, fit, began, {"choice": {"chosen": "oe", "reason": reason}})


def _best_so_far(search: Search, order: int, began: float, stopped: Stopped) -> Model:
    """What there is when Ctrl-C comes: the best candidate, else the linear model."""
    tried = [c for c in search.table.values() if math.isfinite(c.error)]
    best = min(tried, key=lambda c: c.error, default=None)
    linear_error = search.linear_error(order)
    if best is None or best.error >= WORTH_IT * linear_error:
        core = search.linear.get((order, search.nk, LINEAR.name, 0))
        if core is None:
            raise KeyboardInterrupt from stopped
        linear = bare(LinearOE, core, search.task.data)
        story = {"termination": "interrupted", "initial_state": "estimated"}
        return with_story(linear, search.task, began, story)
    finished = Finished(tuple(best.members), best, False)
    rmse = {"oe": linear_error, "neural_ss": best.error}
    model = _network(search, finished, began, rmse, "interrupted: the best candidate so far")
    return told(model, {"termination": "interrupted"})


# --- the story -----------------------------------------------------------------------------------


def _choice(search: Search, chosen: str, rmse: Story, reason: str) -> Story:
    return {
        "chosen": chosen,
        "reason": reason,
        "free_run_rmse": {k: finite(v) for k, v in rmse.items() if v is not None},
        "candidates": list(search.rows()),
        "held_out": list(search.split.sources),
    }


def _with_budget(model: Model, task: Task) -> Model:
    if not task.clock.bit:
        return model
    note = (
        f"the time budget of {task.clock.budget:g} s ended the search early: the result depends on "
        "the speed of the machine"
    )
    return told(model, {"notes": [*model.training.get("notes", []), note]})


def _cost(model: Model, data: Dataset) -> float:
    """J of the free run, in the output's unit squared."""
    runs = zip(model.simulate(data), data.experiments, strict=True)
    errors = np.concatenate([e.y - run for run, e in runs])
    return float(np.nanmean(errors**2) / 2.0)
