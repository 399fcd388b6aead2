"""The lagged network: the paper's preset, and the network that starts from linear output error."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from .. import _core
from ..dataset import Experiment
from ..dynamic_model import INIT
from ..errors import FitError, Interrupted
from ..models import LinearOE, Model, NeuralOE
from .folds import folds
from .linear import linear_fit
from .orders import is_misled, raised
from .task import (
    Provenance,
    Task,
    arrays,
    documented,
    finite,
    fit_provenance,
    free_run_rmse,
    sources,
    wrap,
)

BLOCKS = 8
HELD_OUT = (2, 5)
"""Blocks held out for selection: inside the record, away from both ends of a chirp."""
LEAST_BLOCK = 2 * INIT
DECAYS = (1e-2, 1e-4)
"""Weight decays of the default network, the strongest first."""
ABOUT_AS_WELL = 1.25
"""Largest ratio to the best held-out error for which a stronger weight decay is chosen."""
SAME = 1e-6
"""Relative difference of two errors below which the network is still its linear start."""
NOTHING_LEFT = 1e-6
"""J in scaled units below which a linear model explains everything."""
_USUAL_STARTS = 4
LINEAR_SHARE = 0.4
"""Share of a time budget for the linear fits, so that some is left for the network."""
WORTH_IT = 0.98
"""The network must reduce the free-run error to below this part of the linear model's."""


def paper(task: Task) -> Model:
    """The paper's network, from random starts and in its fixed scaling."""
    began = time.perf_counter()
    fit = _core.fit_neural_oe(
        arrays(task.data),
        [] if task.validation is None else arrays(task.validation),
        **task.orders,
        hidden=task.hidden_or_usual,
        linear=None,
        u_mean=np.zeros(1),
        u_scale=np.full(1, 10.0),
        y_mean=0.0,
        y_scale=1000.0,
        saturate=0.2,
        initial_state="measured",
        weight_decay=0.0,
        max_iterations=task.iterations_or_usual,
        starts=_starts(task),
        seed=task.seed,
        threads=task.threads,
        initial_theta=None,
        progress=task.progress,
    )
    provenance = {"preset": "paper", "initial_state": "measured"}
    model = _network_model(task, fit, began, provenance)
    if fit.termination == "interrupted":
        raise Interrupted(model)
    return model


def neural_oe(task: Task) -> Model:
    """The network, trained in free run from the linear output-error model.

    The result is always a trained network. If the held-out blocks stop the training before its
    first step, because no step is better there than the linear model, the network is trained on
    all data instead, with a note.
    """
    began = time.perf_counter()
    linear, start = begun(task, began)
    if not task.select:
        return unselected(task, start, began)
    trial = task if task.validation is not None else _with_blocks_held_out(task)
    network, decays = _selected_network(trial, start, began)
    choice = _comparison(trial, linear, network)
    provenance = {"samples_fitted": len(trial.data), **decays}
    if len(network.trace) > 1 and not _is_still_linear(choice):
        return _network_model(task, network, began, provenance | _choice_provenance(choice))
    # a strong decay would pull the network back to its linear part
    everything = replace(task, validation=None)
    network = _network_fit(everything, start, DECAYS[-1], began)
    _require_trained(task, network)
    choice["reason"] += "; no step of the training did better on held-out blocks"
    provenance = {**decays, "samples_fitted": len(task.data), "weight_decay": DECAYS[-1]}
    return _network_model(task, network, began, provenance | _choice_provenance(choice))


def begun(task: Task, began: float) -> tuple[_core.LinearModel, _core.LinearModel]:
    """The linear model of the data, and the one from which networks start."""
    brief = replace(task, progress=task.clock.limited(task.progress, LINEAR_SHARE))
    try:
        linear = _linear(brief, began)
        return linear, _start(brief, linear)
    except Interrupted as stopped:
        # a network requested by name is not replaced by a linear model
        raise KeyboardInterrupt from stopped


def unselected(task: Task, start: _core.LinearModel, began: float) -> Model:
    """The network trained on all data to the last iteration."""
    fit = _network_fit(task, start, DECAYS[-1], began)
    return _network_model(task, fit, began, {"weight_decay": DECAYS[-1], "selected": False})


def _require_trained(task: Task, network: _core.NeuralFit) -> None:
    """Refuse a network without any training step: it is still its linear start."""
    # J is in scaled units: a linear model without error needs no step
    if len(network.trace) < 2 and network.cost > NOTHING_LEFT:
        raise FitError(
            f"{task.data.source}: expected a network that does better than its linear start, found "
            "none; ask for model oe, or give more iterations or starts"
        )


def _is_still_linear(choice: Provenance) -> bool:
    """Whether the network still has the linear model's error on held-out blocks."""
    rmse = choice.get("free_run_rmse", {})
    network, linear = rmse.get("neural_oe"), rmse.get("oe")
    if network is None or linear is None:
        return False
    return bool(abs(network - linear) <= SAME * linear)


# --- fits -------------------------------------------------------------------------------------


def _linear(task: Task, began: float) -> _core.LinearModel:
    """Output error, within its share of the time budget; ARX if there is no time at all."""
    try:
        return linear_fit(task, began).model
    except KeyboardInterrupt as e:
        if not task.clock.over(LINEAR_SHARE):
            raise
        if isinstance(e, Interrupted):
            best: _core.LinearModel = e.best.core
            return best
        return _core.fit_arx(arrays(task.data), **task.orders, offset=True)


def _start(task: Task, linear: _core.LinearModel) -> _core.LinearModel:
    """The start of the training: the linear model, or a smaller one if that one is misled.

    Networks that start at a slow pole which the drive does not have (`orders.is_misled`) rarely
    leave it.
    """
    orders = task.orders
    na, nb = orders["na"] - 1, orders["nb"] - 1
    parts = folds(task.data, task.validation)
    if na < 1 or nb < 1 or not parts or task.clock.over(LINEAR_SHARE):
        return linear
    learned = arrays(parts[0].fitted)
    models = []
    for a, b in ((na, nb), (orders["na"], orders["nb"])):
        options = task.fit_options(na=a, nb=b, nk=orders["nk"])
        try:
            fit = _core.fit_oe(learned, **options)
            if fit.termination == "interrupted":
                raise KeyboardInterrupt
        except FitError:
            return linear
        except KeyboardInterrupt:
            # Ctrl-C, or the end of the linear fits' share of a time budget
            if not task.clock.over(LINEAR_SHARE):
                raise
            return linear
        models.append(fit.model)
    smaller, own = models
    return raised(smaller, orders["na"]) if is_misled(own, smaller, parts[0]) else linear


def _selected_network(
    task: Task, linear: _core.LinearModel, began: float
) -> tuple[_core.NeuralFit, Provenance]:
    """The network with the strongest weight decay that does about as well as the best.

    Held-out blocks lie where the drive has been before; elsewhere a smoother network is safer (the
    one-standard-error rule: Hastie, Tibshirani, Friedman 2009, section 7.10). A network that
    diverges or does not forget its initial state is chosen only if all do.
    """
    decays = DECAYS if task.validation is not None else DECAYS[:1]
    fits = [_network_fit(task, linear, decay, began) for decay in decays]
    errors = [math.sqrt(2.0 * (f.validation_cost or 0.0)) for f in fits]
    able = [i for i, f in enumerate(fits) if f.sound] or list(range(len(fits)))
    bound = ABOUT_AS_WELL * min(errors[i] for i in able)
    chosen = next(i for i in able if errors[i] <= bound)
    tried = [
        {"weight_decay": d, "held_out_error": e or None, "sound": f.sound}
        for d, e, f in zip(decays, errors, fits, strict=True)
    ]
    return fits[chosen], {"weight_decay": decays[chosen], "weight_decays": tried}


def _network_fit(
    task: Task, linear: _core.LinearModel, decay: float, began: float
) -> _core.NeuralFit:
    fit = _core.fit_neural_oe(
        arrays(task.data),
        [] if task.validation is None else arrays(task.validation),
        **task.orders,
        hidden=task.hidden_or_usual,
        linear=linear,
        u_mean=None,
        u_scale=None,
        y_mean=None,
        y_scale=None,
        saturate=1.0,
        initial_state="estimated",
        weight_decay=decay,
        max_iterations=task.iterations_or_usual,
        starts=_starts(task),
        seed=task.seed,
        threads=task.threads,
        initial_theta=None,
        progress=task.progress,
    )
    if fit.termination == "interrupted":
        known = {"weight_decay": decay, "samples_fitted": len(task.data)}
        raise Interrupted(_network_model(task, fit, began, known))
    return fit


# --- selection --------------------------------------------------------------------------------


def _with_blocks_held_out(task: Task) -> Task:
    """Two of eight blocks of every experiment become validation data, if they are long enough."""
    kept: list[Experiment] = []
    held: list[Experiment] = []
    lag = max(task.na, task.orders["nk"] + task.nb)
    for e in task.data.experiments:
        edges = [round(i * len(e) / BLOCKS) for i in range(BLOCKS + 1)]
        if edges[1] < LEAST_BLOCK + lag:
            return task
        held += [e.cut(edges[i], edges[i + 1]) for i in HELD_OUT]
        starts, stops = (0, *(i + 1 for i in HELD_OUT)), (*HELD_OUT, BLOCKS)
        kept += [e.cut(edges[i], edges[j]) for i, j in zip(starts, stops, strict=True)]
    kept, held = _with_enough_measured(kept), _with_enough_measured(held)
    if not kept or not held:
        return task
    return replace(
        task,
        data=replace(task.data, experiments=tuple(kept)),
        validation=replace(task.data, experiments=tuple(held)),
    )


def _with_enough_measured(pieces: list[Experiment]) -> list[Experiment]:
    """The pieces in which enough outputs were measured."""
    return [e for e in pieces if len(e) - e.unmeasured > LEAST_BLOCK]


def _comparison(task: Task, linear: _core.LinearModel, network: _core.NeuralFit) -> Provenance:
    """Free-run errors of both on data not trained on, the choice and its reason."""
    asked = "a lagged network was asked for"
    if task.validation is None:
        short = f"the record is too short to hold out blocks of {LEAST_BLOCK} samples to compare on"
        return {"chosen": "neural_oe", "reason": f"{asked}; {short}", "is_better": False}
    rmse = {
        "oe": free_run_rmse(wrap(LinearOE, linear, task.data), task.validation),
        "neural_oe": free_run_rmse(wrap(NeuralOE, network.model, task.data), task.validation),
    }
    is_better = network.sound and rmse["neural_oe"] < WORTH_IT * rmse["oe"]
    ratio = rmse["neural_oe"] / rmse["oe"] if rmse["oe"] > 0.0 else 1.0
    reason = (
        f"{asked}; its free-run error on data not trained on is {100 * ratio:.1f} % of the linear "
        "model's"
    )
    if not network.sound:
        reason += "; it runs away on larger inputs or does not forget its initial state"
    return {
        "chosen": "neural_oe",
        "reason": reason,
        "is_better": is_better,
        "free_run_rmse": {k: finite(v) for k, v in rmse.items()},
        "held_out": sources(task.validation),
    }


def _choice_provenance(choice: Provenance) -> Provenance:
    if choice.pop("is_better"):
        return {"choice": choice}
    bound = f"not credibly better than the linear model (below {100 * WORTH_IT:.0f} % of its error)"
    return {"choice": choice, "notes": [f"{bound}: consider model oe"]}


def _network_model(
    task: Task, fit: _core.NeuralFit, began: float, extra: Provenance | None = None
) -> Model:
    provenance: Provenance = {"initial_state": "estimated", "cost_unit": "scaled output squared"}
    provenance |= {"seed": task.seed, "starts": _starts(task), "start": fit.start}
    provenance |= {"start_costs": [finite(c) for c in fit.start_costs.tolist()]}
    provenance |= {"validation_cost": fit.validation_cost}
    known = fit_provenance(fit) | provenance | (extra or {})
    return documented(wrap(NeuralOE, fit.model, task.data), task, began, known)


def _starts(task: Task) -> int:
    return _USUAL_STARTS if task.starts is None else task.starts
