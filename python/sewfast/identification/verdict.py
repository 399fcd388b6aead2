"""The verdict of `identify`: whether a model is good enough to tune on, why, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..dataset import Dataset, diagnose
from ..dynamic_model import INIT
from ..models import Model
from ..validation import GOOD, by_input, free_run_error, judged, noise_of, without_input
from .folds import Split
from .linear import UNSEEN, time_constant
from .task import Provenance

if TYPE_CHECKING:
    from .choice import Choice


def verdict(choice: Choice, model: Model, error: float) -> Provenance:
    """Whether the model is good enough to tune a controller on, in words and as values.

    Parameters
    ----------
    choice : Choice
        The search and its held-out data.
    model : Model
        The chosen model.
    error : float
        Free-run error on held-out data [output unit].

    Returns
    -------
    dict
        `grade` ("good", "fair", "poor" or "useless"), `fit_percent` on data not trained on,
        `text`, and `next`: a list of things to do, the most important one first.
    """
    found = _judged(model, choice.task.data, choice.split, error)
    if found["grade"] == "good" and choice.search.repeats:
        found["grade"] = "fair"
        found["text"] = found["text"].replace(_TEXTS["good"], "good on repetitions of this record")
        found["next"] += _what_to_record(choice.task.data)
    if choice.clock.truncated and found["grade"] != "good":
        found["next"].insert(0, "give a longer time budget, or none")
    found["next"] += [f"{f.text}: {f.remedy}" for f in choice.search.diagnosis.findings]
    return found


def verdict_by_name(model: Model, data: Dataset, validation: Dataset | None) -> Provenance:
    """`verdict` on a kind requested by name, for which no data were held out.

    It is judged on the validation data, else on its training data; the text states which.
    """
    part = Split(data, validation or data, is_given=validation is not None)
    found = _judged(
        model, data, part, where=_UNSEEN_DATA if part.is_given else "its own training data"
    )
    if model.kind in ("arx", "iv", "oe") and found["grade"] in ("good", "fair"):
        slowest, longest = time_constant(model.core), max(len(e) for e in data.experiments)
        # a real integrator is not a superfluous pole
        if slowest > UNSEEN * longest and diagnose(data).find("integrator") is None:
            found["grade"] = "poor"
            measured = found["text"].partition(": ")[2]
            found["text"] = (
                f"{_TEXTS['poor']}: its slowest pole takes {slowest * data.Ts:.3g} s, longer than "
                f"the record can show, so that its steady gain is a guess; {measured}"
            )
            found["next"].insert(0, "lower na, or leave model out and let the search choose")
    return found


_TEXTS = {
    "": "the output hardly moves where it was not trained on",
    "good": "good enough to tune a controller on",
    "fair": "good enough for a first, cautious controller",
    "poor": "not good enough to tune a controller on",
    "useless": "useless",
}


_UNSEEN_DATA = "data not trained on"


def _judged(
    model: Model,
    data: Dataset,
    part: Split,
    error: float | None = None,
    where: str = _UNSEEN_DATA,
) -> Provenance:
    """The model's grade by its error on held-out data, with the reason and what to do next."""
    # `error` can come from other samples; the share explained by the input needs the same ones
    own = free_run_error(model, part.held, part.held, INIT)
    error = own if error is None else error
    spread = part.spread
    fit = 100.0 * (1.0 - error / spread) if spread > 0.0 else float("nan")
    noise = noise_of([e.y for e in data.experiments])
    share = by_input(own, without_input(model, part.held, INIT))
    grade, resting = judged(fit, error, noise, share)
    unit = f" {data.output_unit}" if data.output_unit else ""
    rmse = f"rmse {error:.3g}{unit}"
    text, todo = _TEXTS[grade], []
    if not np.isfinite(error):
        text = "useless: its free run leaves the finite numbers"
    elif grade:
        text += f": free run explains {fit:.1f} % of {where} ({rmse}){resting}"
        if grade == "useless" and not resting:
            text += "; a constant would do about as well"
    else:
        text += f" ({rmse})"
    if grade == "good":
        if fit < GOOD:
            text += f"; what is left is measurement noise ({noise:.3g}{unit})"
        todo.append(
            "validate it on another recording; to tune, identify with nk = 1 (--nk 1): no loop can "
            "be closed around a model without delay"
            if any(m.orders["nk"] == 0 for m in model.members or (model,))
            else "validate it on another recording, then tune"
        )
    else:
        todo += _what_to_record(data)
    return {
        "grade": grade or "useless",
        "fit_percent": fit if np.isfinite(fit) else None,
        "text": text,
        "next": todo,
    }


def _what_to_record(data: Dataset) -> list[str]:
    """Advice on another recording."""
    wanted = [
        "record longer, with more levels of the input and the speeds that the controller will use"
    ]
    if len(data.experiments) == 1:
        wanted.append("give several recordings: they are fitted together")
    wanted.append("see the report card (check) for what the residual still contains")
    return wanted
