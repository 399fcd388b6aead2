"""How each kind of model comes out of a checked `Task`; `identify` is the way in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from . import _core
from .dataset import Dataset, Experiment, FloatArray
from .errors import FitError, Interrupted
from .models import ARX, IV, LinearOE, Model, NeuralOE
from .models.base import INIT
from .validation import validate

Progress: TypeAlias = Callable[[int, int, float], object]
Story: TypeAlias = dict[str, Any]
_Class: TypeAlias = type[ARX] | type[IV] | type[LinearOE] | type[NeuralOE]

BLOCKS = 8
HELD_OUT = (2, 5)
"""Blocks to select on: inside the record, where a chirp is neither at its start nor at its end."""
LEAST_BLOCK = 2 * INIT
DECAYS = (1e-2, 1e-4)
"""Weight decays that the default network is trained with, the strongest first."""
ABOUT_AS_WELL = 1.25
"""Largest ratio to the best held-out error at which a stronger weight decay is taken."""
WORTH_IT = 0.98
"""The network must bring the free-run error below this part of the linear model's."""


@dataclass(frozen=True)
class Task:
    """One identification: data, where to select on, and settings."""

    data: Dataset
    validation: Dataset | None
    na: int
    nb: int
    nk: int
    hidden: int
    starts: int
    seed: int
    iterations: int
    threads: int
    progress: Progress | None

    @property
    def orders(self) -> dict[str, int]:
        return {"na": self.na, "nb": self.nb, "nk": self.nk}


# --- recipes ----------------------------------------------------------------------------------


def arx(task: Task) -> Model:
    """Least squares of the one-step error."""
    began = time.perf_counter()
    core = _core.fit_arx(_arrays(task.data), **task.orders, offset=True)
    story = {"cost_horizon": "one step", "initial_state": "measured", "termination": "solved"}
    model = _model(ARX, core, task, began, story)
    one_step = np.concatenate(
        [
            (y - yhat)[INIT:]
            for (_, y), yhat in zip(_arrays(task.data), model.predict(task.data), strict=True)
        ]
    )
    return _told(
        model, {"cost": float(np.nanmean(one_step**2) / 2), "cost_unit": "output unit squared"}
    )


def iv(task: Task) -> Model:
    """Refined instrumental variables."""
    began = time.perf_counter()
    fit = _core.fit_iv(
        _arrays(task.data),
        na=task.na,
        nb=task.nb,
        nk=task.nk,
        max_iterations=task.iterations,
        progress=task.progress,
    )
    settled = fit.termination == "small_step"
    note = f"instrumental variables did not settle ({fit.termination}); consider model oe"
    model = _linear_model(task, fit, began, {} if settled else {"notes": [note]}, IV)
    if fit.termination == "interrupted":
        raise Interrupted(model)
    return model


def oe(task: Task) -> Model:
    """Linear output error."""
    began = time.perf_counter()
    return _linear_model(task, _linear_fit(task, began), began)


def paper(task: Task) -> Model:
    """The paper's network, from random starts and in its fixed scaling."""
    began = time.perf_counter()
    fit = _core.fit_neural_oe(
        _arrays(task.data),
        [] if task.validation is None else _arrays(task.validation),
        **task.orders,
        hidden=task.hidden,
        linear=None,
        u_mean=np.zeros(1),
        u_scale=np.full(1, 10.0),
        y_mean=0.0,
        y_scale=1000.0,
        saturate=0.2,
        initial_state="measured",
        weight_decay=0.0,
        max_iterations=task.iterations,
        starts=task.starts,
        seed=task.seed,
        threads=task.threads,
        progress=task.progress,
    )
    story = {"preset": "paper", "initial_state": "measured"}
    return _unless_interrupted(fit, _network_model(task, fit, began, story))


def neural_oe(task: Task) -> Model:
    """The network, trained in free run from the linear output-error model."""
    return _from_linear_start(task, always_network=True)


def auto(task: Task) -> Model:
    """The network from its linear start, or the linear model where the network is not worth it."""
    return _from_linear_start(task, always_network=False)


def _from_linear_start(task: Task, always_network: bool) -> Model:
    began = time.perf_counter()
    linear = _linear_fit(task, began)
    trial = task if task.validation is not None else _with_blocks_held_out(task)
    if trial.validation is None and not always_network:
        return _linear_model(task, linear, began, {"choice": _NOTHING_HELD_OUT})
    network, decays = _selected_network(trial, linear, began)
    choice = _comparison(trial, linear, network)
    if not always_network and choice["chosen"] == "oe":
        return _linear_model(task, linear, began, {"choice": choice})
    story = {"samples_fitted": len(trial.data), **decays, **_choice_story(choice, always_network)}
    return _network_model(task, network, began, story)


# --- fits -------------------------------------------------------------------------------------


def _linear_fit(task: Task, began: float) -> _core.LinearFit:
    fit = _core.fit_oe(
        _arrays(task.data),
        na=task.na,
        nb=task.nb,
        nk=task.nk,
        max_iterations=task.iterations,
        progress=task.progress,
    )
    if fit.termination == "interrupted":
        raise Interrupted(_linear_model(task, fit, began))
    return fit


def _selected_network(
    task: Task, linear: _core.LinearFit, began: float
) -> tuple[_core.NeuralFit, Story]:
    """The network with the strongest weight decay that does about as well as the best.

    Held-out blocks lie where the drive has been before; a smoother network is the safer one where
    it has not (the one-standard-error rule: Hastie, Tibshirani, Friedman 2009, section 7.10). One
    that runs away or sticks is taken only where all do.
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
    task: Task, linear: _core.LinearFit, decay: float, began: float
) -> _core.NeuralFit:
    fit = _core.fit_neural_oe(
        _arrays(task.data),
        [] if task.validation is None else _arrays(task.validation),
        **task.orders,
        hidden=task.hidden,
        linear=linear.model,
        u_mean=None,
        u_scale=None,
        y_mean=None,
        y_scale=None,
        saturate=1.0,
        initial_state="estimated",
        weight_decay=decay,
        max_iterations=task.iterations,
        starts=task.starts,
        seed=task.seed,
        threads=task.threads,
        progress=task.progress,
    )
    if fit.termination == "interrupted":
        raise Interrupted(_network_model(task, fit, began))
    return fit


def _unless_interrupted(fit: _core.NeuralFit, model: Model) -> Model:
    if fit.termination == "interrupted":
        raise Interrupted(model)
    return model


# --- selection --------------------------------------------------------------------------------


def _with_blocks_held_out(task: Task) -> Task:
    """Two of eight blocks of every experiment become validation data, if they are long enough."""
    kept: list[Experiment] = []
    held: list[Experiment] = []
    for e in task.data.experiments:
        edges = [round(i * len(e) / BLOCKS) for i in range(BLOCKS + 1)]
        if edges[1] < LEAST_BLOCK + max(task.na, task.nk + task.nb):
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
    """The pieces that a long gap in the output has left something of."""
    return [e for e in pieces if len(e) - e.unmeasured > LEAST_BLOCK]


_NOTHING_HELD_OUT: Story = {
    "chosen": "oe",
    "reason": f"the record is too short to hold out blocks of {LEAST_BLOCK} samples to compare on",
}


def _comparison(task: Task, linear: _core.LinearFit, network: _core.NeuralFit) -> Story:
    """Free-run errors of both on data not trained on, the choice and its reason."""
    if task.validation is None:
        return _NOTHING_HELD_OUT
    rmse = {
        "oe": _free_run_rmse(_bare(LinearOE, linear.model, task), task.validation),
        "neural_oe": _free_run_rmse(_bare(NeuralOE, network.model, task), task.validation),
    }
    is_better = network.sound and rmse["neural_oe"] < WORTH_IT * rmse["oe"]
    ratio = rmse["neural_oe"] / rmse["oe"] if rmse["oe"] > 0.0 else 1.0
    reason = (
        f"free-run error of the network on data not trained on: {100 * ratio:.1f} % of the linear "
        f"model's; the network is chosen below {100 * WORTH_IT:.0f} %"
    )
    if not network.sound:
        reason += "; it runs away on larger inputs or does not forget its initial state"
    return {
        "chosen": "neural_oe" if is_better else "oe",
        "reason": reason,
        "free_run_rmse": {k: v if math.isfinite(v) else None for k, v in rmse.items()},
        "held_out": _sources(task.validation),
    }


def _choice_story(choice: Story, always_network: bool) -> Story:
    if always_network and choice["chosen"] != "neural_oe":
        return {"choice": choice, "notes": [f"{choice['reason']}; consider model oe"]}
    return {"choice": choice}


def _free_run_rmse(model: Model, data: Dataset) -> float:
    try:
        return validate(model, data).simulation.rmse
    except FitError:
        return math.inf


# --- models with their story --------------------------------------------------------------------


def _linear_model(
    task: Task,
    fit: _core.LinearFit,
    began: float,
    extra: Story | None = None,
    cls: type[IV] | type[LinearOE] = LinearOE,
) -> Model:
    story: Story = {"initial_state": "estimated", "cost_unit": "output unit squared"}
    story |= {"standard_errors": _standard_errors(fit)}
    return _model(cls, fit.model, task, began, _fit_story(fit) | story | (extra or {}))


def _standard_errors(fit: _core.LinearFit) -> Story:
    """Of the coefficients, for white measurement noise; None where the data do not fix them."""
    errors = [e if math.isfinite(e) else None for e in fit.standard_errors.tolist()]
    (na, (inputs, nb)) = (fit.model.na, fit.model.b.shape)
    b = [errors[na + j * nb :][:nb] for j in range(inputs)]
    return {"a": errors[:na], "b": b, "offset": errors[-1]}


def _network_model(
    task: Task, fit: _core.NeuralFit, began: float, extra: Story | None = None
) -> Model:
    story: Story = {"initial_state": "estimated", "cost_unit": "scaled output squared"}
    story |= {"seed": task.seed, "starts": task.starts, "start": fit.start}
    story |= {"start_costs": [c if math.isfinite(c) else None for c in fit.start_costs.tolist()]}
    story |= {"validation_cost": fit.validation_cost}
    return _model(NeuralOE, fit.model, task, began, _fit_story(fit) | story | (extra or {}))


def _fit_story(fit: _core.LinearFit | _core.NeuralFit) -> Story:
    return {
        "cost": fit.cost,
        "cost_horizon": "free run",
        "iterations": fit.iterations,
        "termination": fit.termination,
        "trace": fit.trace.tolist(),
    }


def _model(
    cls: _Class,
    core: Any,
    task: Task,
    began: float,
    story: Story,
) -> Model:
    data = task.data
    common = {
        "data": _sources(data),
        "samples": len(data),
        "unmeasured": sum(e.unmeasured for e in data.experiments),
        "preparation": list(data.notes),
        "input_range": [list(r) for r in data.input_range],
        "output_range": list(data.output_range),
        "settings": {"max_iterations": task.iterations},
        "seconds": time.perf_counter() - began,
    }
    return _told(_bare(cls, core, task), common | story)


def _bare(cls: _Class, core: Any, task: Task) -> Model:
    d = task.data
    return cls(core, d.Ts, d.input_names, d.output_name, d.input_units, d.output_unit, d.counts)


def _told(model: Model, story: Story) -> Model:
    return replace(model, training={**model.training, **story})


def _sources(data: Dataset) -> list[Story]:
    return [{"name": e.name, "range": e.range_text, "samples": len(e)} for e in data.experiments]


def _arrays(data: Dataset) -> list[tuple[FloatArray, FloatArray]]:
    return [(e.u, e.y) for e in data.experiments]
