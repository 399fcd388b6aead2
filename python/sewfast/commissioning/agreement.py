"""Agreement: the members that do under a controller what most of them do."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..control.controller import Controller
from ..control.loop import run
from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble, Model
from .refusal import Refusal

DISAGREE = 0.05
"""Largest distance of a member from the median of all, rms over the reference's span."""


class Disagreement(Refusal):
    """Networks that do not agree on what a controller does."""


def agreeing(
    controller: Controller, ensemble: Ensemble, references: Mapping[str, FloatArray]
) -> Ensemble:
    """The ensemble without members that part from the others, in a false rest for instance.

    Raises
    ------
    Disagreement
        Where less than half of the members agree.
    """
    members = list(ensemble.members)
    apart = np.zeros(len(members))
    for r in references.values():
        runs = np.array([_output(controller, m, r) for m in members])
        known = np.isfinite(runs).all(axis=1)
        median = np.median(runs[known], axis=0) if known.any() else np.zeros(len(r))
        distances = np.sqrt(np.mean((runs - median) ** 2, axis=1)) / np.ptp(r)
        apart = np.maximum(apart, np.where(known, distances, np.inf))
    kept = [m for m, share in zip(members, apart, strict=True) if share <= DISAGREE]
    if 2 * len(kept) < len(members):
        raise Disagreement(
            f"expected at least half of {len(members)} networks within {100 * DISAGREE:g} % of the "
            f"span from their median in closed loop, {len(kept)} are; record longer, or raise "
            "members"
        )
    return ensemble if len(kept) == len(members) else Ensemble.of(kept)


def _output(controller: Controller, member: Model, r: FloatArray) -> FloatArray:
    """Not finite where the member runs away."""
    try:
        return run(controller, member, r).y
    except FitError:
        return np.full(len(r), np.inf)
