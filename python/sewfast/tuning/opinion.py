"""A second opinion on tuned gains by a model of another kind.

A search finds gains that are good on its models, including their mistakes: a network can fit a
record to 94 % and still favour gains that are bad on its drive. A model of another kind makes other
mistakes. A brief search finds its own gains. If either set of gains costs much more on the other's
model than that model's own gains, at least one model is wrong in closed loop, and simulations
cannot tell which. Then the gains whose worse relative cost is smallest are used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..control.controller import SampledController
from ..errors import FitError
from .task import TuningTask
from .verdict import Objection

SHARE = 0.2
"""Evaluations of each search of a second opinion, as a share of those on the models."""
MUCH = 3.0
"""Ratio to the cost of a model's own gains above which models contradict each other."""
OWN, OTHER, BOTH = range(3)
_TITLES = (
    "those tuned on the models",
    "those tuned on the rival",
    "others, tuned on the models and the rival",
)

Search = Callable[[TuningTask], SampledController]
"""Searches a task; raises FitError if nothing meets its constraints."""


@dataclass(frozen=True, eq=False)
class SecondOpinion:
    """Candidates with their costs on either kind of plant.

    Attributes
    ----------
    candidates : tuple of Controller
        Tuned on the models, on the rival and, if these contradict each other, on both.
    costs : array, shape (2, candidates)
        In the output's unit, on the models and on the rival; inf if a loop diverges.
    allowed : array of bool, shape (candidates,)
        Whether each meets the constraints on the models, so that it can be used.
    """

    candidates: tuple[SampledController, ...]
    costs: NDArray[np.float64]
    allowed: NDArray[np.bool_]

    @property
    def relative(self) -> NDArray[np.float64]:
        """The costs relative to the least on the same plants; shape (2, candidates)."""
        return _relative(self.costs)

    @property
    def is_contradiction(self) -> bool:
        """Whether either gains cost much more on the other's plants than the gains tuned there."""
        return max(self._crossed) > MUCH

    @property
    def _crossed(self) -> tuple[float, float]:
        """Relative costs of the models' gains on the rival, and of the rival's on the models."""
        relative = _relative(self.costs[:, :BOTH])
        return float(relative[1, OWN]), float(relative[0, OTHER])

    @property
    def pick(self) -> int:
        """The candidate to use: that of the models or, if contradicted, the least bad on both."""
        if not self.is_contradiction:
            return OWN
        worst = self.relative.max(axis=0)
        return int(np.argmin(np.where(self.allowed, worst, np.inf)))

    @property
    def warning(self) -> str | None:
        """The contradiction and its remedy; None if the models agree."""
        return None if self.objection is None else str(self.objection)

    @property
    def objection(self) -> Objection | None:
        """The contradiction as a reason of the verdict: the gains are poor."""
        if not self.is_contradiction:
            return None
        on_rival, on_models = self._crossed
        worst = float(self.relative[:, self.pick].max())
        return Objection(
            "poor",
            f"the gains tuned on the models cost {_times(on_rival)} the rival's own gains on the "
            f"rival, and those {_times(on_models)} the models' own gains on the models: one of the "
            f"two is wrong in closed loop; taken are {_TITLES[self.pick]}, at most "
            f"{_times(worst)} the least on either",
            "record a closed loop at the speeds and commands of the references and identify again",
        )


def second_opinion(
    own: SampledController, task: TuningTask, rival: TuningTask, search: Search
) -> SecondOpinion | None:
    """Compare tuned gains with those of a rival, which a brief `search` finds.
    `task` is that of the tuned gains, and `rival` the same task on the rival's plants. None if
    nothing on the rival meets the constraints.
    """
    # start from the cheaper of the two, so that gains that are good on both show as such
    starts = [own, task.start]
    begun = replace(rival, start=starts[int(np.argmin([_judged(rival, c)[0] for c in starts]))])
    try:
        other = search(begun)
    except FitError:
        return None
    found = _opinion((own, other), task, rival)
    if not found.is_contradiction:
        return found
    least_wrong = found.candidates[int(np.argmin(found.relative.max(axis=0)))]
    both = replace(
        task, plants=[*task.plants, *rival.plants], start=least_wrong,
        loops=task.loops + rival.loops,
    )  # fmt: skip
    try:
        third = search(both)
    except FitError:
        return found
    return _opinion((own, other, third), task, rival)


def _opinion(
    candidates: tuple[SampledController, ...], task: TuningTask, rival: TuningTask
) -> SecondOpinion:
    on_models = [_judged(task, c) for c in candidates]
    on_rival = [_judged(rival, c)[0] for c in candidates]
    # the search itself has found the first within the constraints
    allowed = [i == OWN or violation == 0.0 for i, (_, violation) in enumerate(on_models)]
    return SecondOpinion(
        candidates, np.array([[cost for cost, _ in on_models], on_rival]), np.array(allowed)
    )


def _judged(task: TuningTask, controller: SampledController) -> tuple[float, float]:
    """Cost, and the sum of violations of the constraints."""
    cost, violation, *_ = _core.tuning_costs(task.core(), [controller.core()], threads=1)[0]
    return cost, violation


def _relative(costs: NDArray[np.float64]) -> NDArray[np.float64]:
    least = costs.min(axis=1, keepdims=True)
    # on plants on which nothing is stable, all are equally bad
    ratios = np.full(costs.shape, np.inf)
    known = np.isfinite(costs) & (least > 0.0)
    np.divide(costs, least, out=ratios, where=known)
    return ratios


def _times(ratio: float) -> str:
    return f"{ratio:.3g} times" if np.isfinite(ratio) else "endlessly more than"
