"""`Task`: one identification with its settings; what every model says of its origin."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from ..dataset import Dataset, FloatArray
from ..errors import FitError
from ..models import Model
from ..models.base import Fitted
from ..threads import Workers
from ..validation import validate
from .effort import Clock, Progress

Provenance: TypeAlias = dict[str, Any]
Pairs: TypeAlias = list[tuple[FloatArray, ...]]


@dataclass(frozen=True)
class Task:
    """One identification: data, where to select on, and settings (None: the usual)."""

    data: Dataset
    validation: Dataset | None
    na: int
    nb: int
    nk: int | None
    nx: int | None
    hidden: int | None
    output: str | None
    starts: int | None
    seed: int
    iterations: int | None
    threads: int
    progress: Progress | None
    workers: Workers | None = None
    select: bool = True
    is_order_given: bool = False
    clock: Clock = field(default_factory=lambda: Clock(None))

    @property
    def orders(self) -> dict[str, int]:
        """Of a lagged model."""
        return {"na": self.na, "nb": self.nb, "nk": 1 if self.nk is None else self.nk}

    def fit_options(self, **orders: int) -> dict[str, Any]:
        """Settings of a linear fit, in the task's orders unless others are given."""
        options: dict[str, Any] = {**self.orders, **orders}
        return options | {"max_iterations": self.iterations_or_usual, "progress": self.progress}

    @property
    def iterations_or_usual(self) -> int:
        """Of one fit whose number is left open."""
        return 100 if self.iterations is None else self.iterations

    @property
    def hidden_or_usual(self) -> int:
        """Hidden units of a lagged network."""
        return 8 if self.hidden is None else self.hidden


def arrays(data: Dataset) -> Pairs:
    """Inputs and output of each experiment, and its weights where it has some."""
    return [(e.u, e.y) if e.weights is None else (e.u, e.y, e.weights) for e in data.experiments]


def sources(data: Dataset) -> list[Provenance]:
    """Where the samples are from, as JSON values."""
    return [{"name": e.name, "range": e.range_text, "samples": len(e)} for e in data.experiments]


def wrap(cls: type[Model], core: Any, data: Dataset) -> Model:
    """A model in the data's names and units, without its provenance."""
    d = data
    return cls(core, d.Ts, d.input_names, d.output_name, d.input_units, d.output_unit, d.counts)


def with_provenance(model: Model, extra: Provenance) -> Model:
    """The model with more of its provenance."""
    return replace(model, training={**model.training, **extra})


def documented(model: Model, task: Task, began: float, extra: Provenance) -> Model:
    """The model with what every kind of model says of its origin, and `extra`."""
    data = task.data
    common = {
        "data": sources(data),
        "samples": len(data),
        "unmeasured": sum(e.unmeasured for e in data.experiments),
        "preparation": list(data.notes),
        "input_range": [list(r) for r in data.input_range],
        "output_range": list(data.output_range),
        "settings": {"max_iterations": task.iterations_or_usual},
        "seconds": time.perf_counter() - began,
    }
    return with_provenance(model, common | extra)


def fit_provenance(fit: Fitted) -> Provenance:
    """How a fit went."""
    return {
        "cost": fit.cost,
        "cost_horizon": "free run",
        "iterations": fit.iterations,
        "termination": fit.termination,
        "trace": fit.trace.tolist(),
    }


def free_run_rmse(model: Model, data: Dataset) -> float:
    """Pooled error of the free run; infinite where the model runs away."""
    try:
        return validate(model, data).simulation.rmse
    except FitError:
        return math.inf


def finite(value: float) -> float | None:
    """For JSON, which knows no infinity."""
    return value if math.isfinite(value) else None
