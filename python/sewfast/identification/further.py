"""A model trained further, on the same data or on others, in its own structure and scaling."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from .. import _core
from ..errors import Interrupted, SettingError
from ..models import ARX, IV, Ensemble, LinearOE, Model, NeuralOE, NeuralSS
from ..models.base import StructuredModel
from .linear import arx, iv, linear_model
from .task import Task, arrays, documented, fit_provenance, wrap

STARTING_SCALE = 1.0


def trained(task: Task, model: Model) -> Model:
    """The model after further iterations of its own kind of fit on the task's data.

    Raises
    ------
    SettingError
        For a model of a kind that is not trained further, or an ensemble that holds one; where the
        data have other inputs or another sample time than the model's.
    FitError
        Where the model's free run on the data leaves the finite numbers.
    """
    for m in model.members or (model,):
        _require_trainable(m)
    _require_match(task, model)
    began = time.perf_counter()
    if isinstance(model, Ensemble):
        # the task's budget holds for all members together
        together = Ensemble.of([trained(task, m) for m in model.members], model.combine)
        known = {"initial_state": "estimated", "seed": task.seed, "trained_further": True}
        return documented(together, task, began, known)
    if isinstance(model, (ARX, IV)):
        # both are solved anew: what they begin with does not matter
        o = model.orders
        own = replace(task, na=o["na"], nb=o["nb"], nk=o["nk"])
        return arx(own) if isinstance(model, ARX) else iv(own)
    if isinstance(model, LinearOE):
        return _linear(task, model, began)
    if isinstance(model, NeuralSS):
        return _state_space(task, model, began)
    return _lagged(task, model, began)


def _require_trainable(model: Model) -> None:
    """A fit that can begin at this model."""
    if isinstance(model, StructuredModel):
        raise SettingError(
            name="model", expected="a model that can be trained further",
            received=f"the {model.title} model, whose fit begins anew",
            remedy=f"identify it anew (model={model.kind!r}) on all the data",
        )  # fmt: skip
    if isinstance(model, NeuralOE) and not model.core.settings["bypass"]:
        raise SettingError(
            "model: the paper's network has no linear part and is not trained further; identify "
            "it anew (preset='paper')"
        )


def _require_match(task: Task, model: Model) -> None:
    data = task.data
    if data.n_inputs != len(model.input_names) or abs(data.Ts - model.Ts) > 0.01 * model.Ts:
        raise SettingError(
            f"model: expected data like the model's, {len(model.input_names)} input(s) at "
            f"{model.Ts:g} s, received {data.n_inputs} at {data.Ts:g} s; identify anew"
        )


def _linear(task: Task, model: LinearOE, began: float) -> Model:
    orders = {k: model.orders[k] for k in ("na", "nb", "nk")}
    fit = _core.fit_oe(arrays(task.data), **task.fit_options(**orders), initial=model.core)
    found = linear_model(task, fit, began)
    if fit.termination == "interrupted":
        raise Interrupted(found)
    return found


def _state_space(task: Task, model: NeuralSS, began: float) -> Model:
    s: dict[str, Any] = model.core.settings
    decay = _decay(model)
    fit = _core.fit_neural_ss(
        arrays(task.data),
        [] if task.validation is None else arrays(task.validation),
        nx=s["nx"],
        nk=s["nk"],
        hidden=s["hidden"],
        linear=None,
        output=s["output"],
        output_parameters=s["output_parameters"],
        integrator=s["integrator"],
        weight_decay=decay,
        hidden_scale=STARTING_SCALE,
        max_iterations=task.iterations_or_usual,
        starts=1,
        first_start=0,
        seed=task.seed,
        threads=1,
        initial=[model.core],
        progress=task.progress,
    )
    return _network(task, wrap(NeuralSS, fit.model, task.data), fit, decay, began)


def _lagged(task: Task, model: Model, began: float) -> Model:
    s = model.core.settings
    decay = _decay(model)
    theta = model.core.theta
    fit = _core.fit_neural_oe(
        arrays(task.data),
        [] if task.validation is None else arrays(task.validation),
        na=s["na"],
        nb=s["nb"],
        nk=s["nk"],
        hidden=s["hidden"],
        # only says that there is a linear part, and estimates initial states
        linear=_core.fit_arx(arrays(task.data), na=s["na"], nb=s["nb"], nk=s["nk"], offset=True),
        u_mean=s["u_mean"],
        u_scale=s["u_scale"],
        y_mean=s["y_mean"],
        y_scale=s["y_scale"],
        saturate=1.0,
        initial_state="estimated",
        weight_decay=decay,
        max_iterations=task.iterations_or_usual,
        starts=1,
        seed=task.seed,
        threads=1,
        initial_theta=theta[None, :],
        progress=task.progress,
    )
    return _network(task, wrap(NeuralOE, fit.model, task.data), fit, decay, began)


def _decay(model: Model) -> float:
    """The weight decay that the model was trained with."""
    known = model.training.get("weight_decay", 0.0)
    return float(known) if isinstance(known, (int, float)) else 0.0


def _network(
    task: Task, model: Model, fit: _core.NeuralSSFit | _core.NeuralFit, decay: float, began: float
) -> Model:
    known = fit_provenance(fit) | {"initial_state": "estimated", "seed": task.seed}
    known |= {"cost_unit": "scaled output squared", "weight_decay": decay, "trained_further": True}
    found = documented(model, task, began, known | {"samples_fitted": len(task.data)})
    if fit.termination == "interrupted":
        raise Interrupted(found)
    return found
