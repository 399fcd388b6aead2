"""Further training of a model, on the same data or on others, in its own structure and scaling."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

from .. import _core
from ..dataset import require_same_units
from ..errors import FitError, Interrupted, SettingError
from ..models import ARX, IV, Ensemble, LinearOE, Model, NeuralOE, NeuralSS
from ..models.base import StructuredModel
from ..models.grey_box import GreyBox
from .grey_box import trained_from
from .linear import arx, iv, linear_model
from .task import Task, arrays, documented, fit_provenance, with_provenance, wrap

STARTING_SCALE = 1.0


def trained(task: Task, model: Model) -> Model:
    """The model after further iterations of its kind of fit on the task's data.

    Raises
    ------
    SettingError
        For a model of a kind that cannot be trained further, or an ensemble with one; if the data
        differ from the model's in inputs or sample time.
    DataError
        If the data have other units.
    FitError
        If the model's free run on the data diverges.
    Interrupted
        On Ctrl-C and at the end of a time budget. `best` is at least as good as the model: the
        model itself if no step was made, an ensemble with the members trained so far.
    """
    for m in model.members or (model,):
        _require_trainable(m)
    _require_match(task, model)
    if isinstance(model, Ensemble):
        return _members(task, model)
    try:
        return _single(task, model)
    except KeyboardInterrupt as e:
        best = _best(model, e)
        raise Interrupted(_as_given(model) if best is model else best) from None


def _members(task: Task, model: Ensemble) -> Model:
    """Train every member in turn, within one time budget."""
    began = time.perf_counter()
    members, known = list(model.members), {"initial_state": "estimated", "seed": task.seed}
    known |= {"trained_further": True}
    for i, member in enumerate(model.members):
        try:
            members[i] = _single(task, member)
        except KeyboardInterrupt as e:
            members[i] = _best(member, e)
            if members[0] is model.members[0]:
                raise Interrupted(_as_given(model)) from None
            known["termination"] = "interrupted"
            known["notes"] = [
                f"{i} of {len(members)} members were trained to the end: those after them are as "
                "they were given"
            ]
            break
    found = documented(Ensemble.of(members, model.combine), task, began, known)
    if "termination" in known:
        raise Interrupted(found)
    return found


def _best(model: Model, stopped: KeyboardInterrupt) -> Model:
    """The best model when the training of a single model is stopped."""
    best: Model | None = getattr(stopped, "best", None)
    # without a step, and for an estimate that is solved afresh, that is the given model
    is_further = best is not None and best.training.get("iterations") and best.kind != "iv"
    return best if best is not None and is_further else model


def _as_given(model: Model) -> Model:
    notes = [*model.training.get("notes", []), "no step further was made: the model is as given"]
    return with_provenance(model, {"notes": notes})


def _single(task: Task, model: Model) -> Model:
    began = time.perf_counter()
    if isinstance(model, (ARX, IV)):
        # both are solved afresh, without a start
        o = model.orders
        own = replace(task, na=o["na"], nb=o["nb"], nk=o["nk"])
        return arx(own) if isinstance(model, ARX) else iv(own)
    if isinstance(model, LinearOE):
        return _linear(task, model, began)
    if isinstance(model, GreyBox):
        return _grey(task, model, began)
    try:
        if isinstance(model, NeuralSS):
            return _state_space(task, model, began)
        return _lagged(task, model, began)
    except FitError as e:
        # messages of the core that ask for other starts and sizes do not apply here
        raise FitError(
            name=f"{task.data.source}", expected="data on which the model's free run is finite",
            received="none", remedy="check scale and signs of the data, or identify again",
        ) from e  # fmt: skip


def _require_trainable(model: Model) -> None:
    """Refuse models at which no fit can begin."""
    if isinstance(model, StructuredModel):
        raise SettingError(
            name="model", expected="a model that can be trained further",
            received=f"the {model.title} model, which is always fitted from scratch",
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
    require_same_units(model, data)


def _linear(task: Task, model: LinearOE, began: float) -> Model:
    orders = {k: model.orders[k] for k in ("na", "nb", "nk")}
    fit = _core.fit_oe(arrays(task.data), **task.fit_options(**orders), initial=model.core)
    found = linear_model(task, fit, began)
    if fit.termination == "interrupted":
        raise Interrupted(found)
    return found


def _grey(task: Task, model: GreyBox, began: float) -> Model:
    iterations = task.iterations_or_usual

    def look(*_: object) -> None:
        if task.progress is not None:
            task.progress(0, iterations, math.inf)

    core = trained_from(model.core, model.core.theta, task.data, iterations, look)
    found = wrap(GreyBox, core, task.data)
    return documented(found, task, began, {"initial_state": "estimated", "trained_further": True})


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
        # only states that there is a linear part, and estimates initial states
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
    """The weight decay with which the model was trained."""
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
