"""`judge`: closed loops held against limits; a refusal where members of an ensemble disagree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from ..control.controller import Controller
from ..control.defaults import default_references
from ..control.loop import (
    ClosedLoopRun,
    Plant,
    Plants,
    References,
    check_fits,
    each_plant,
    each_reference,
    titles,
    trial,
)
from ..dataset import Dataset
from ..errors import FitError, SettingError, SewfastError
from ..evidence.region import placed
from ..models import Model
from . import judgement
from .judgement import JudgedRun, Judgement, Limits, disagreements, oscillation


class HasController(Protocol):
    """What came with a controller, as from `tune` or `commission`."""

    @property
    def controller(self) -> Controller | None: ...


Judgeable: TypeAlias = ClosedLoopRun | Sequence[ClosedLoopRun] | Controller | HasController

REFERENCES = ("trapezoid", "random")


def judge(
    what: Judgeable,
    on: Plants | None = None,
    references: References = None,
    *,
    limits: Limits | None = None,
    seed: int = 0,
    refuse: bool = True,
) -> Judgement:
    """Hold simulated or measured closed loops against limits.

    - `training region`: the share of samples unlike any that the model was trained on. A measured
      run is placed by its command: where would it lead the model?
    - `saturation`: the share of samples with the command at a limit.
    - `limit cycle`: a lasting oscillation of the loop's own making at constant reference
      (`sewfast.trust.oscillation`).
    - `disagreement`: how far plants part that ran the same reference under the same controller.

    Parameters
    ----------
    what : ClosedLoopRun, sequence of them, Controller, TuningResult or Commissioning
        Runs as they are; a controller, or what `tune` or `commission` found, is run on every plant
        of `on`.
    on : Model, VirtualMachine or sequence of them, optional
        The plants of a controller, every member of an ensemble one of them; of a commissioning its
        own models, unless others are given. With runs: the models in whose training region they
        are to lie.
    references : str, array of shape (N,), or sequence of them, optional
        Of a controller; `REFERENCES` by default, which is the same shapes over the first plant's
        recorded range where the catalogue does not suit it.
    limits : Limits, optional
        The bounds.
    seed : int
        Chooses named random references.
    refuse : bool
        Whether to raise where members disagree; else the line `disagreement` fails.

    Returns
    -------
    Judgement

    Raises
    ------
    FitError
        Where members of an ensemble disagree by more than the bound, or one runs away.
    SettingError
        For arguments that are none of these, a controller without plants, or models whose sample
        time or units are not the runs'.
    """
    if not (limits is None or isinstance(limits, Limits)):
        raise SettingError(
            f"expected Limits, got {type(limits).__name__}; for example Limits(saturated=0.02)"
        )
    limits = limits or Limits()
    models = each_plant(getattr(what, "models", None) if on is None else on)
    runs = _runs(what, models, references, seed)
    regions = [m for m in models if isinstance(m, Model)]
    found = tuple(_judged(r, model) for r, model in _with_model(runs, regions))
    apart = disagreements([r for r, _ in runs])
    unit = found[0].run.units["y"]
    lines = (
        judgement.region(found, limits),
        judgement.saturation(found, limits),
        judgement.limit_cycle(found, limits),
        judgement.disagreement(apart, limits, unit),
    )
    if refuse and lines[-1].verdict == "fail":
        raise FitError(_refusal(lines[-1].shown, lines[-1].limit, lines[-1].meaning))
    return Judgement(lines, found, apart, limits)


def _refusal(shown: str, limit: str, meaning: str) -> str:
    return f"expected plants that agree in closed loop ({limit}), received {shown}: {meaning}"


_Run: TypeAlias = tuple[ClosedLoopRun, "Plant | None"]


def _runs(
    what: Judgeable, plants: list[Plant], references: References, seed: int
) -> list[_Run]:  # fmt: skip
    if isinstance(what, ClosedLoopRun):
        return [(what, None)]
    controller = getattr(what, "controller", what)
    if isinstance(controller, Controller):
        if not plants:
            raise SettingError(
                "expected plants to run the controller on, got none; give judge(controller, models)"
            )
        if references is None:
            references = default_references(plants[0], controller, REFERENCES)
        return [
            (trial(controller, plant, r, title, seed), plant)
            for r in each_reference(references, ())
            for plant, title in zip(plants, titles(plants), strict=True)
        ]
    if isinstance(what, Sequence) and what and all(isinstance(r, ClosedLoopRun) for r in what):
        return [(r, None) for r in what]
    raise SettingError(
        "expected closed-loop runs, a Controller or a TuningResult to judge, got "
        f"{type(what).__name__}; run(controller, plant, reference) gives a run"
    )


def _with_model(runs: list[_Run], models: list[Model]) -> list[_Run]:
    """Each run with the model whose region it is to lie in, if there is one."""
    given = models[0] if models else None
    return [(r, plant if isinstance(plant, Model) else given) for r, plant in runs]


def _judged(found: ClosedLoopRun, model: Any) -> JudgedRun:
    outside, farthest = _outside(found, model)
    saturated = found.metrics()["saturated"] or 0.0
    return JudgedRun(found, outside, farthest, saturated, oscillation(found))


def _outside(found: ClosedLoopRun, model: Model | None) -> tuple[float, float]:
    """Share of samples outside, farthest distance; NaN where no region is known."""
    if model is None or not len(found.u):
        return math.nan, math.nan
    check_fits(found.controller, model)
    known = np.isfinite(found.u)
    u = np.interp(np.arange(len(known)), np.flatnonzero(known), found.u[known])
    data = Dataset.from_arrays(
        u, None, model.Ts, input_names=model.input_names, input_units=model.input_units,
        output_name=model.output_name, output_unit=model.output_unit, name=found.reference,
    )  # fmt: skip
    try:
        place = placed(model, data, init=0)
    except SewfastError:
        return 1.0, math.inf
    if place is None:
        return math.nan, math.nan
    distances = place.distances[0]
    return float(np.mean(distances > 1.0)), float(distances.max())
