"""Further training of a model, on the same data or on others, in its own structure and scaling."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

from .. import _core
from ..dataset import Dataset, require_same_units
from ..errors import FitError, Interrupted, SettingError
from ..models import ARX, IV, Ensemble, LinearOE, Model, NeuralOE, NeuralSS
from ..models.base import StructuredModel
from ..models.grey_box import GreyBox
from .grey_box import trained_from
from .linear import arx, iv, linear_provenance
from .task import Pairs, Task, arrays, completed, fit_provenance, with_provenance


def trained(model: Model, task: Task) -> Model:
    """The model after further iterations of its kind of fit on the task's data.
    Raises `SettingError` for a kind that cannot be trained further, an ensemble with one, and other
    inputs or sample time than the model's; `DataError` for other units; `FitError` if its free run
    diverges; `Interrupted` on Ctrl-C and at the end of a time budget, whose `best` is at least as
    good as the model: the model itself without a step, an ensemble with the members trained so far.
    """
    members = list(model.members or (model,))
    for m in members:
        _require_trainable(m)
    _require_match(task.data, model)
    if not isinstance(model, Ensemble):
        try:
            return _single(task, model)
        except KeyboardInterrupt as e:
            best = _best(model, e)
            raise Interrupted(_as_given(model) if best is model else best) from None
    known = {"initial_state": "estimated", "seed": task.seed, "trained_further": True}
    # every member in turn, within one time budget
    for i, member in enumerate(model.members):
        try:
            members[i] = _single(replace(task, began=time.perf_counter()), member)
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
    found = task.documented(Ensemble.of(members, model.combine), known)
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


def _require_match(data: Dataset, model: Model) -> None:
    if data.n_inputs != len(model.input_names) or abs(data.Ts - model.Ts) > 0.01 * model.Ts:
        raise SettingError(
            f"model: expected data like the model's, {len(model.input_names)} input(s) at "
            f"{model.Ts:g} s, received {data.n_inputs} at {data.Ts:g} s; identify anew"
        )
    require_same_units(model, data)


def _single(task: Task, model: Model) -> Model:
    if isinstance(model, (ARX, IV)):
        # both are solved afresh, without a start
        o = model.orders
        own = replace(task, na=o["na"], nb=o["nb"], nk=o["nk"])
        return arx(own) if isinstance(model, ARX) else iv(own)
    data = arrays(task.data)
    if isinstance(model, LinearOE):
        orders = {k: model.orders[k] for k in ("na", "nb", "nk")}
        linear = _core.fit_oe(data, **task.fit_options(**orders), initial=model.core)
        return completed(task.model(LinearOE, linear.model, linear_provenance(linear)))
    if isinstance(model, GreyBox):
        iterations, progress = task.iterations_or_usual, task.progress

        def look(*_: object) -> None:
            if progress is not None:
                progress(0, iterations, math.inf)

        core = trained_from(model.core, model.core.theta, task.data, iterations, look)
        known: dict[str, Any] = {"initial_state": "estimated", "trained_further": True}
        return task.model(GreyBox, core, known)
    decay = model.training.get("weight_decay", 0.0)
    decay = float(decay) if isinstance(decay, (int, float)) else 0.0
    held = [] if task.validation is None else arrays(task.validation)
    options = {
        "weight_decay": decay, "max_iterations": task.iterations_or_usual, "starts": 1,
        "seed": task.seed, "threads": 1, "progress": task.progress,
    }  # fmt: skip
    try:
        fit = (_state_space if isinstance(model, NeuralSS) else _lagged)(model, data, held, options)
    except FitError as e:
        # messages of the core that ask for other starts and sizes do not apply here
        raise FitError(
            name=f"{task.data.source}", expected="data on which the model's free run is finite",
            received="none", remedy="check scale and signs of the data, or identify again",
        ) from e  # fmt: skip
    known = fit_provenance(fit) | {"initial_state": "estimated", "seed": task.seed}
    known |= {"cost_unit": "scaled output squared", "weight_decay": decay, "trained_further": True}
    known |= {"samples_fitted": len(task.data)}
    return completed(task.model(type(model), fit.model, known))


def _state_space(
    model: Model, data: Pairs, held: Pairs, options: dict[str, Any]
) -> _core.NeuralSSFit:
    s = model.core.settings
    return _core.fit_neural_ss(
        data,
        held,
        nx=s["nx"],
        nk=s["nk"],
        hidden=s["hidden"],
        linear=None,
        output=s["output"],
        output_parameters=s["output_parameters"],
        integrator=s["integrator"],
        hidden_scale=1.0,
        first_start=0,
        initial=[model.core],
        **options,
    )


def _lagged(model: Model, data: Pairs, held: Pairs, options: dict[str, Any]) -> _core.NeuralFit:
    s = model.core.settings
    orders = {k: s[k] for k in ("na", "nb", "nk")}
    return _core.fit_neural_oe(
        data,
        held,
        **orders,
        hidden=s["hidden"],
        # only states that there is a linear part, and estimates initial states
        linear=_core.fit_arx(data, **orders, offset=True),
        u_mean=s["u_mean"],
        u_scale=s["u_scale"],
        y_mean=s["y_mean"],
        y_scale=s["y_scale"],
        saturate=1.0,
        initial_state="estimated",
        initial_theta=model.core.theta[None, :],
        **options,
    )
