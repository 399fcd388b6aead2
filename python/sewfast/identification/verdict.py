"""The closing words of `identify`: good enough to tune on or not, why, and what to do next."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..dataset import Dataset
from ..dynamic_model import INIT
from ..models import Model
from ..validation import GOOD, by_input, free_run_error, judged, noise_of, without_input
from .task import Provenance

if TYPE_CHECKING:
    from .choice import Choice


def verdict(choice: Choice, model: Model, error: float) -> Provenance:
    """Whether a controller may be tuned on the model, in words and as values.

    Parameters
    ----------
    choice : Choice
        The search and what was held out.
    model : Model
        What was chosen.
    error : float
        Free-run error on what is held out [output unit].

    Returns
    -------
    dict
        `grade` ("good", "fair", "poor" or "useless"), `fit_percent` on data not trained on,
        `text`, and `next`: a list of things to do, the most important one first.
    """
    data, spread = choice.task.data, choice.split.spread
    fit = 100.0 * (1.0 - error / spread) if spread > 0.0 else float("nan")
    noise = noise_of([e.y for e in data.experiments])
    # of one model on the same samples: what was held out is not what the error is always of
    held = choice.split.held
    own = free_run_error(model, held, held, INIT)
    grade, resting = judged(fit, error, noise, by_input(own, without_input(model, held, INIT)))
    unit = f" {data.output_unit}" if data.output_unit else ""
    measured = (
        f"free run explains {fit:.1f} % of data not trained on (rmse {error:.3g}{unit}){resting}"
    )
    text = {
        "": f"the output hardly moves where it was not trained on (rmse {error:.3g}{unit})",
        "good": f"good enough to tune a controller on: {measured}",
        "fair": f"good enough for a first, cautious controller: {measured}",
        "poor": f"not good enough to tune a controller on: {measured}",
        "useless": f"useless: {measured}{'' if resting else '; a constant would do about as well'}",
    }[grade]
    grade = grade or "useless"
    todo = []
    if grade == "good":
        if fit < GOOD:
            text += f"; what is left is measurement noise ({noise:.3g}{unit})"
        todo.append(
            "validate it on another recording; to tune, identify with nk = 1 (--nk 1): no loop can "
            "be closed around a model without delay"
            if any(m.orders["nk"] == 0 for m in model.members or (model,))
            else "validate it on another recording, then tune"
        )
    if grade == "good" and choice.search.repeats:
        grade = "fair"
        text = text.replace("good enough to tune a controller on", "good where it repeats itself")
    if choice.clock.truncated and grade != "good":
        todo.append("give a longer time budget, or none")
    if grade in ("fair", "poor", "useless"):
        todo += _what_to_record(choice.task.data)
    todo += [f"{f.text}: {f.remedy}" for f in choice.search.diagnosis.findings]
    return {
        "grade": grade,
        "fit_percent": fit if np.isfinite(fit) else None,
        "text": text,
        "next": todo,
    }


def _what_to_record(data: Dataset) -> list[str]:
    """What another recording should have that this one lacks."""
    wanted = [
        "record longer, with more levels of the input and the speeds that the controller will use"
    ]
    if len(data.experiments) == 1:
        wanted.append("give several recordings: they are fitted together")
    wanted.append("see the report card (check) for what the residual still contains")
    return wanted
