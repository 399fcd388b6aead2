"""Linear models: ARX, instrumental variables, output error."""

from __future__ import annotations

import math
import time

import numpy as np

from .. import _core
from ..dataset.experiment import mean_square, weights_of
from ..dynamic_model import INIT
from ..errors import Interrupted
from ..models import ARX, IV, LinearOE, Model
from .task import Provenance, Task, arrays, documented, fit_provenance, with_provenance, wrap


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
    """A fit as a model with its provenance."""
    provenance: Provenance = {"initial_state": "estimated", "cost_unit": "output unit squared"}
    provenance |= {"standard_errors": _standard_errors(fit)}
    known = fit_provenance(fit) | provenance | (extra or {})
    return documented(wrap(cls, fit.model, task.data), task, began, known)


def _standard_errors(fit: _core.LinearFit) -> Provenance:
    """Of the coefficients, for white measurement noise; None where the data do not fix them."""
    errors = [e if math.isfinite(e) else None for e in fit.standard_errors.tolist()]
    (na, (inputs, nb)) = (fit.model.na, fit.model.b.shape)
    b = [errors[na + j * nb :][:nb] for j in range(inputs)]
    return {"a": errors[:na], "b": b, "offset": errors[-1]}
