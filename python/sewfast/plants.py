"""Plants and references as they are given, one by one: members of ensembles, titles, samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .control import Controller
from .errors import FitError, SettingError
from .loop import ClosedLoopRun, Plant, run
from .machine import VirtualMachine
from .models import Ensemble, Model

Plants: TypeAlias = Plant | Sequence[Plant]
References: TypeAlias = str | ArrayLike | Sequence[str | ArrayLike] | None


def each_plant(on: Plants | None) -> list[Plant]:
    """Every plant by itself: of an ensemble its members.

    Raises
    ------
    SettingError
        For what is neither model nor virtual machine.
    """
    if on is None:
        return []
    given = list(on) if isinstance(on, Sequence) else [on]
    for plant in given:
        if not isinstance(plant, (Model, VirtualMachine)):
            raise SettingError(
                f"on: expected models or virtual machines, got {type(plant).__name__}; load a "
                "model with load_model"
            )
    return [m for plant in given for m in _singles(plant)]


def _singles(plant: Plant) -> list[Plant]:
    """Members know what their ensemble stores of the training data, region and ranges."""
    if not isinstance(plant, Ensemble):
        return [plant]
    return [_informed(m, plant) for m in plant.members]


def _informed(member: Model, ensemble: Ensemble) -> Model:
    shared = ("input_range", "output_range", "region")
    known = {k: ensemble.training[k] for k in shared if k in ensemble.training}
    return replace(member, training={**known, **member.training})


def titles(plants: Sequence[Plant]) -> list[str]:
    """What to call each."""
    names = [p.name if isinstance(p, VirtualMachine) else p.kind for p in plants]
    if len(plants) == 1:
        return names
    return [f"{name}, {i + 1} of {len(names)}" for i, name in enumerate(names)]


def each_reference(references: Any, default: Sequence[str]) -> list[Any]:
    """The references one by one: a name or a vector is one, a sequence of those is several.

    Raises
    ------
    SettingError
        For what is none of these.
    """
    if references is None:
        return list(default)
    if isinstance(references, str):
        return [references]
    try:
        iter(references)
    except TypeError:
        raise SettingError(
            f"expected references as names or samples, got {references!r}; for example 'trapezoid'"
        ) from None
    several = not isinstance(references, np.ndarray) and any(
        isinstance(r, str) or np.ndim(r) for r in references
    )
    return list(references) if several or np.ndim(references) == 2 else [references]


def trial(
    controller: Controller, plant: Plant, reference: Any, title: str, seed: int = 0
) -> ClosedLoopRun:
    """A run under the plant's title.

    Raises
    ------
    FitError
        Where the loop runs away; the plant is named.
    """
    try:
        return replace(run(controller, plant, reference, seed=seed), plant=title)
    except FitError as e:
        named = reference if isinstance(reference, str) else "reference"
        raise FitError(
            f"expected a loop that stays bounded, received one that runs away on {title}, "
            f"{named}: {e}"
        ) from e
