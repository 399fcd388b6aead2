"""A search for a controller: what it is asked for, what it found, and how both are copied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..control.controller import Controller
    from ..models import Model
    from ..tuning import Constraints, Cost


@dataclass(frozen=True)
class Search:
    """How to search for a controller, and what is a good one.

    Parameters
    ----------
    evaluations, seed : int
        As for `sewfast.tune`.
    seconds : float or None
        Its `time_budget`; when a search ends by time, its copy is the controller that it found.
    weights : mapping
        Fields of `sewfast.Cost` by name.
    constraints : mapping
        ``Ms``, ``overshoot`` [%] and ``u`` of `sewfast.Constraints`.
    """

    evaluations: int
    seed: int
    seconds: float | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    constraints: Mapping[str, float] = field(default_factory=dict)

    def cost(self) -> Cost:
        """The weights; those that are not given are the defaults.

        Raises
        ------
        SettingError
        """
        from ..tuning import Cost

        return Cost(**self.weights)

    def limits(self, model: Model, level: float) -> Constraints:
        """The constraints; Ms of networks is that about the level [y].

        Raises
        ------
        SettingError
        """
        from ..tuning import Constraints

        if "Ms" not in self.constraints or _is_linear(model):
            return Constraints(**self.constraints)
        return Constraints(**self.constraints, plant=model.members or model, speed=level)

    def python(self, model: Model, level: float) -> str:
        """Arguments of `sewfast.tune`."""
        words = [f"evaluations={self.evaluations}, seed={self.seed}"]
        if self.weights:
            words.append(f"cost=sewfast.Cost({_named(self.weights)})")
        if self.constraints:
            limits = _named(self.constraints)
            if "Ms" in self.constraints and not _is_linear(model):
                plant = "model.members" if model.members else "model"
                limits += f", plant={plant}, speed={level!r}"
            words.append(f"constraints=sewfast.Constraints({limits})")
        return ", ".join(words)

    def command(self, model: Model, level: float) -> str:
        """Options of `sewfast tune`."""
        words = [f"--evaluations={self.evaluations}", f"--seed={self.seed}"]
        words += [f"--cost {name}={value!r}" for name, value in self.weights.items()]
        words += [f"--constraint {name}={value!r}" for name, value in self.constraints.items()]
        if "Ms" in self.constraints and not _is_linear(model):
            words.append(f"--speed={level!r}")
        return " ".join(words)


@dataclass(frozen=True)
class Found:
    """What a search found, with what finds it again; `search` is None where nothing does."""

    values: dict[str, float]
    controller: Controller
    start: Controller
    search: Search | None
    cost: float | None = None
    start_cost: float | None = None
    ended: str = "interrupted"


def _named(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in values.items())


def _is_linear(model: Model) -> bool:
    """Whether `sewfast.tune` finds a plant to take Ms on by itself."""
    return all(hasattr(member, "to_tf") for member in model.members or (model,))
