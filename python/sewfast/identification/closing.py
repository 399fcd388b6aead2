"""What every search ends with: members as one model, its notes, verdict and alternatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .. import _core
from ..dataset import Dataset, Diagnosis
from ..dataset.experiment import mean_square, weights_of
from ..models import Ensemble, LinearOE, Model, NeuralOE, NeuralSS
from ..models.grey_box import GreyBox
from .folds import TEXTS, Split, verdict, what_to_record
from .linear import LinearCandidate
from .task import Provenance, Task, finite, with_provenance, wrap

MOST_MEMBERS = 15
"""Members of an ensemble: a controller is tuned on each, and a median of more is hardly better."""
WORTH_IT = 0.9
"""A network must bring the error below this part of the best linear model's, and of a motor's."""
_CLASSES: dict[type, type[Model]] = {
    _core.LinearModel: LinearOE, _core.GreyBox: GreyBox, _core.NeuralOE: NeuralOE,
    _core.NeuralSS: NeuralSS,
}  # fmt: skip


def as_one(cores: Sequence[tuple[Any, Provenance]], task: Task) -> Model:
    """One model unchanged, several as the median, each with its provenance."""
    members = [
        with_provenance(wrap(_CLASSES[type(core)], core, task.data), known) for core, known in cores
    ]
    return members[0] if len(members) == 1 else Ensemble.of(members)


def linear_alternative(chosen: LinearCandidate, rmse: float, task: Task) -> Model:
    """The linear model with which others were compared."""
    choice: Provenance = {"chosen": "oe", "reason": "the linear alternative"}
    choice |= {"free_run_rmse": {"oe": finite(rmse)}}
    extra: Provenance = {"initial_state": "estimated", "choice": choice}
    return task.model(LinearOE, chosen.models[0], extra)


def closed(
    model: Model,
    task: Task,
    part: Split,
    error: float,
    *,
    linear: float | None,
    wants_network: bool,
    diagnosed: Callable[[], Diagnosis | None],
) -> Model:
    """The model with its notes and verdict, by its error on the part that it was not trained on.
    `linear` is the error of the best linear model there; `diagnosed` gives the properties of the
    record, None if a time budget leaves no time for them.
    """
    notes = list(model.training.get("notes", []))
    if wants_network and linear is not None and error >= WORTH_IT * linear:
        notes.append(
            f"free-run error on data not trained on: {100 * error / linear:.1f} % of the best "
            "linear model's; consider model oe"
        )
    if task.nk is None and any(m.orders["nk"] == 0 for m in model.members or (model,)):
        notes.append(
            "the output depends on the input of the same sample (nk = 0), so that no loop can be "
            "closed around the model; for a controller identify with nk = 1"
        )
    extra: Provenance = {"notes": notes} if notes else {}
    found = verdict(model, task.data, part, error)
    diagnosis = diagnosed()
    if found["grade"] == "good" and diagnosis is not None and diagnosis.find("repeats") is not None:
        found["grade"] = "fair"
        repeated = "good on repetitions of this record"
        found["text"] = found["text"].replace(TEXTS["good"], repeated)
        found["next"] += what_to_record(task.data)
    if task.clock.truncated and found["grade"] != "good":
        found["next"].insert(0, "give a longer time budget, or none")
    if diagnosis is not None:
        found["next"] += [f"{f.text}: {f.remedy}" for f in diagnosis.findings]
    extra["verdict"] = found
    return with_provenance(model, extra)


def cost_of(model: Model, data: Dataset) -> float:
    """J of the free run, in the output's unit squared."""
    runs = zip(model.simulate(data), data.experiments, strict=True)
    pairs = [((e.y - run) ** 2, weights_of(e)) for run, e in runs]
    squares, weights = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return mean_square(squares, weights) / 2.0
