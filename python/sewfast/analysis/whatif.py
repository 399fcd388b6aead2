"""`WhatIf`: the controller on plants that are not as identified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..control import Controller
from ..errors import SettingError
from ..machine import VirtualMachine
from .changes import ON_MACHINES, ON_MODELS, Change
from .scoring import Score, Task, each


@dataclass(frozen=True)
class WhatIf:
    """One change of the plants.

    Attributes
    ----------
    name : str
        What is different.
    score : Score
        Of the same controller.
    """

    name: str
    score: Score

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {"change": self.name, **self.score.to_json()}


def what_if(
    controller: Controller,
    task: Task,
    changes: Sequence[Change] | None = None,
    *,
    threads: int | None = None,
) -> tuple[WhatIf, ...]:
    """Score the controller on changed plants.

    Parameters
    ----------
    controller : Controller
    task : Task
        Plants, references and cost.
    changes : sequence of Change, optional
        By default `ON_MODELS` and, for virtual machines, `ON_MACHINES`. One that no plant can be
        changed by is left out.
    threads : int, optional
        All processors by default; the result is the same at any number.
    """
    if changes is None:
        machines = [isinstance(p, VirtualMachine) for p in task.plants]
        changes = (
            *(ON_MODELS if not all(machines) else ()),
            *(ON_MACHINES if any(machines) else ()),
        )
    tasks = [(c.name, found) for c in changes if (found := _changed(task, c)) is not None]
    scores = each(lambda job: job[1].score(controller), tasks, threads)
    return tuple(WhatIf(name, s) for (name, _), s in zip(tasks, scores, strict=True))


def _changed(task: Task, change: Change) -> Task | None:
    """The task on those plants that can be changed so; None where none can."""
    plants, names = [], []
    for plant, name in zip(task.plants, task.names, strict=True):
        try:
            plants.append(change.apply(plant))
        except SettingError:
            continue
        names.append(name)
    return task.on(plants, names) if plants else None
