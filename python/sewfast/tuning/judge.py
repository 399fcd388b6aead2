"""Controllers judged as a search judges them, without a search: `costs`, `verdict_on`, `Judge`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..control.controller import Controller, SampledController
from ..control.loop import Plants, References, check_fits
from ..errors import SettingError
from .lead import Led, with_lead
from .objective import Cost, LoadStep
from .task import Aggregate, Budget, Progress, TuningTask, threads_or_all
from .verdict import Verdict, verdict_of


@dataclass(frozen=True)
class Judgement:
    """What a search finds of a controller, over plants, references and variations.

    Attributes
    ----------
    cost : float
        In the output's unit; inf if a loop diverges, as are the others but Ms.
    Ms : float
        The largest sensitivity of the linear loops that a search limits; 0 if there is none.
    overshoot, u : float
        The largest of all runs [%], and the largest command [u].
    """

    cost: float
    Ms: float
    overshoot: float
    u: float


class Judge:
    """Judges one controller after the other as `tune` does; its linear loops are taken once.

    Parameters
    ----------
    start : Controller
        Its limits and encoder decide the default weights and variations.
    models : Model or sequence of them
    """

    def __init__(self, start: SampledController, models: Plants) -> None:
        self._task = _task_of(start, models).with_loops(Budget(None))

    def of(
        self, controllers: Sequence[SampledController], cost: Cost | None = None
    ) -> list[Judgement]:
        """The judgement of each, with the weights of a cost."""
        task = self._task if cost is None else replace(self._task, cost=cost)
        return [
            Judgement(cost, task.loops.worst(controller)[0], overshoot, u)
            for controller, (cost, _, overshoot, u) in zip(
                controllers, _judged(task, controllers), strict=True
            )
        ]

    def verdict(self, controller: SampledController) -> Verdict:
        """As `verdict_on`."""
        return verdict_of(self._task, controller, Budget(None), searched=False)


def costs(
    controllers: SampledController | Sequence[SampledController],
    models: Plants,
    references: References = None,
    *,
    cost: Cost | None = None,
    aggregate: Aggregate = "mean",
    variations: Sequence[tuple[float, int]] | None = None,
    loads: Sequence[LoadStep] = (),
    threads: int | None = None,
    progress: Progress | None = None,
) -> NDArray[np.float64]:
    """Costs of controllers on plants, as in `tune`; shape (controllers,).

    Parameters are those of `tune`. The limits and the encoder of the first controller decide the
    default weights and the default variations. A controller that diverges costs inf.

    Raises
    ------
    SettingError, DataError
        For controllers, plants or references that cannot be used.
    """
    given = [controllers] if isinstance(controllers, SampledController) else controllers
    several = isinstance(given, Sequence) and all(isinstance(c, SampledController) for c in given)
    if not (several and given):
        raise SettingError(f"expected controllers to compare, got {controllers!r}")
    if len({c.counts_per_unit for c in given}) > 1:
        raise SettingError(
            "expected controllers with one encoder, got several; compare them one by one"
        )
    task = _task_of(
        given[0], models, references, cost=cost, aggregate=aggregate, variations=variations,
        loads=loads,
    )  # fmt: skip
    for controller in given:
        for plant in task.plants:
            check_fits(controller, plant)
    return np.array([cost for cost, *_ in _judged(task, given, threads, progress)])


def verdict_on(controller: SampledController, models: Plants) -> Verdict:
    """The verdict that `tune` gives on its gains, on those of a controller.

    Parameters
    ----------
    controller : Controller or StateFeedback
    models : Model, VirtualMachine or sequence of them

    Raises
    ------
    SettingError
        If sample times or units disagree.
    """
    return Judge(controller, models).verdict(controller)


def led(controller: Controller, models: Plants) -> tuple[Controller, Led]:
    """The controller with the feedforward that `tune` adds to it, and what that is worth. It is the
    controller alone if none helps on every model.
    """
    return with_lead(_task_of(controller, models), controller, "preview")


def _judged(
    task: TuningTask, controllers: Sequence[SampledController], threads: int | None = None,
    progress: Progress | None = None,
) -> list[tuple[float, float, float, float]]:  # fmt: skip
    """Cost, violation, overshoot and command of each controller on a task."""
    cores = [task.about(c).core() for c in controllers]
    return _core.tuning_costs(
        task.core(), cores, threads=threads_or_all(threads), progress=progress
    )


def _task_of(
    controller: SampledController, models: Plants, references: References = None, *,
    cost: Cost | None = None, aggregate: Aggregate = "mean",
    variations: Sequence[tuple[float, int]] | None = None, loads: Sequence[LoadStep] = (),
) -> TuningTask:  # fmt: skip
    """The task to judge a controller on, as `tune` has it without further settings."""
    return TuningTask.of(
        models, references, start=controller, first={}, cost=cost, aggregate=aggregate,
        constraints=None, variations=variations, loads=loads,
    )  # fmt: skip


def recoveries(
    controller: SampledController,
    models: Plants,
    loads: Sequence[LoadStep],
    *,
    variations: Sequence[tuple[float, int]] | None = None,
) -> NDArray[np.float64]:
    """The worst recovery [ms] and rms deviation [y] under the load steps; shape (plants, 2).

    A row per plant in each variation: the first plant in all of them, then the next. Parameters are
    those of `tune`.

    Raises
    ------
    SettingError, DataError
        For a controller, plants or load steps that cannot be used.
    FitError
        If a loop diverges.
    """
    task = _task_of(controller, models, [np.zeros(1)], variations=variations, loads=loads)
    return np.array(_core.tuning_loads(task.core()))
