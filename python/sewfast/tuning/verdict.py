"""The verdict on tuned gains: a grade and its reasons, which every command, page and file shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..arrays import in_unit
from ..control.controller import Controller, SampledController
from ..control.defaults import (
    drive_step,
    growth_rate,
    moves_on,
    rate_step,
    recorded_limits,
    recorded_outputs,
)
from ..control.loop import ClosedLoopRun, missed_levels, outside_region, run
from ..dataset import FloatArray
from ..errors import FitError, SettingError
from ..evidence.verdicts import OUTSIDE
from ..models import Model
from .objective import LARGEST_MS
from .robustness import HAIR

if TYPE_CHECKING:
    from .task import Budget, TuningTask

GRADES = ("unfit", "poor", "fair", "good")
"""Grades of a controller, the worst first."""
MODEL_GRADES = ("useless", "poor", "fair", "good")
"""Grades of a model's verdict, the worst first."""
LIVELY = 2.0
"""Ms above which gains are poor: a gain margin of 2 and a phase margin of 29 degrees."""
MOST = 0.5
"""Share of a run above which gains that saturate, or leave the record, are unfit: most of it."""
ROOM = 0.05
"""Share of the command's range that a calm reference leaves to either limit."""
MISSED = 0.05
"""Part of a reference's span by which a held level is missed, as `commission` has it."""
WIDER = 0.1
"""Share of a recorded range by which it is wider at either end, as the guards of models have it."""


@dataclass(frozen=True)
class Objection:
    """A reason against tuned gains.

    Attributes
    ----------
    grade : str
        The best grade that it allows.
    text, remedy : str
        The reason, and what to do.
    """

    grade: str
    text: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.text}; {self.remedy}"


@dataclass(frozen=True)
class Verdict:
    """The verdict on tuned gains.

    Attributes
    ----------
    objections : tuple of Objection
        The worst first; empty for good gains.
    model : str
        The worst grade of the models, ``good`` to ``useless``; empty if they have none.
    """

    objections: tuple[Objection, ...] = ()
    model: str = ""

    @property
    def grade(self) -> str:
        """``good``, ``fair``, ``poor`` or ``unfit``: never better than that of the models."""
        of_model = [GRADES[MODEL_GRADES.index(self.model)]] if self.model else []
        given = [o.grade for o in self.objections] + of_model
        return min(given, key=GRADES.index, default="good")

    @property
    def reasons(self) -> tuple[str, ...]:
        """The objections in words, with what to do."""
        return tuple(str(o) for o in self.objections)

    @property
    def warning(self) -> str | None:
        """All reasons in one text; None if there are none."""
        return "; ".join(self.reasons) or None

    @property
    def unfit(self) -> tuple[Objection, ...]:
        """The objections for which the gains must not be used."""
        return tuple(o for o in self.objections if o.grade == "unfit")

    def require_fit(self) -> None:
        """Refuse gains that must not be used.

        Raises
        ------
        FitError
            If the loop is unstable, at a limit or outside the record for most of a run.
        """
        if self.unfit:
            raise FitError(
                name="controller", expected="one that the drive can be run with",
                received="; ".join(o.text for o in self.unfit),
                remedy=f"{self.unfit[0].remedy}, or write it all the same with --force",
            )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {"grade": self.grade, "reasons": list(self.reasons)}

    def __str__(self) -> str:
        graded = f"the model is graded {self.model}" if self.model not in ("", "good") else ""
        said = "; ".join(filter(None, (*self.reasons, graded)))
        return f"{self.grade}: {said}" if said else self.grade


def model_grade(plants: Sequence[Any]) -> str:
    """The worst grade of the models' verdicts; empty if none has one."""
    known = [p.training.get("verdict") or {} for p in plants if isinstance(p, Model)]
    grades = [v["grade"] for v in known if v.get("grade") in MODEL_GRADES]
    return min(grades, key=MODEL_GRADES.index, default="")


def verdict_of(
    task: TuningTask,
    controller: SampledController,
    time: Budget,
    *,
    limit: float | None = None,
    others: Sequence[Objection] = (),
    searched: bool = True,
) -> Verdict:
    """The verdict on gains for a task, whose references are run on its models as they are.
    Without `time` for the runs, they are among what it lost. `limit` is the user's own limit of Ms;
    `others` are the objections known otherwise; `searched` is False for gains set by hand.
    """
    found = [*others, *_of_loops(task, controller, _calmer(limit, searched))]
    found += _of_runs(task, controller, time)
    found += _of_step(task, controller, time)
    found.sort(key=lambda o: GRADES.index(o.grade))
    return Verdict(tuple(found), model_grade(task.plants))


# --- Ms -------------------------------------------------------------------------------------------


def _of_loops(task: TuningTask, controller: SampledController, remedy: str) -> Iterator[Objection]:
    """An Ms above the default limit, or of which nothing is known."""
    loops = task.loops
    if isinstance(controller, Controller) and not loops.looked_at and _models(task):
        why = "" if loops.reason is None else f" ({loops.reason})"
        yield Objection(
            "fair", "Ms is not known: no model has a stable linear loop about the levels of the "
            f"references{why}", "give references that the model reaches, or identify it again",
        )  # fmt: skip
    if loops.opposed:
        others, (_, at) = len(loops.opposed), loops.opposed[0]
        place = "" if at is None else f", the first about {in_unit(f'{at:.4g}', controller.y_unit)}"
        yield Objection(
            "fair", f"{others} of {others + len(loops.looked_at)} linear loops{place}, are left "
            "out of Ms: there a command moves the model the other way than most of the models",
            "record more at that level, and identify again",
        )  # fmt: skip
    Ms, level = loops.worst(controller)
    if Ms <= HAIR * LARGEST_MS:
        return
    place = ""
    if level is not None and loops.depends:
        place = f" about {in_unit(f'{level:.4g}', controller.y_unit)}"
    if math.isinf(Ms):
        yield Objection(
            "unfit",
            f"on one of the models the linear loop{place} is unstable: Ms is infinite",
            "lower the gains, search more variables, or look at the margins (sewfast analyse)",
        )
        return
    yield Objection(
        "fair" if Ms <= HAIR * LIVELY else "poor",
        f"Ms is {Ms:.3g}{place}: at one frequency the loop amplifies disturbances {Ms:.3g} times, "
        "which is close to instability",
        remedy,
    )


def _calmer(limit: float | None, searched: bool) -> str:
    """What to do about an Ms above the default limit."""
    if not searched:
        return "lower Kp or Td, or search from here"
    if limit is not None:
        return f"without a limit of its own the search keeps to {LARGEST_MS:g}"
    return (
        f"no gains with at most {LARGEST_MS:g} were found: search more variables, give more "
        "evaluations, or take delay out of the loop"
    )


def _models(task: TuningTask) -> list[Model]:
    return [p for p in task.plants if isinstance(p, Model)]


# --- Runs -----------------------------------------------------------------------------------------


def _of_runs(task: TuningTask, controller: SampledController, time: Budget) -> list[Objection]:
    """What the references show on the models as they are, each share in the mean of the models.
    References for which no time is left are not judged, which is an objection of its own.
    """
    at_limit, outside, unknown, missed, found = 0.0, 0.0, 0.0, "", []
    for r in task.references if _models(task) else ():
        try:
            pairs = _in_time(time, partial(_run_with, controller, r), _models(task))
        except FitError:
            return [
                Objection(
                    "unfit", "the loop on one of the models diverges",
                    "begin with smaller gains, or check the model on new data",
                )
            ]  # fmt: skip
        # the samples that need no limit are more than MOST of all: with less than this at a limit,
        # no more than MOST of them are, whatever the reference needs, which takes long to find
        is_railed = pairs and np.mean([np.mean(_railed(one)) for one, _ in pairs]) > MOST * MOST
        shares = _in_time(time, lambda pair: _at_limit(*pair), (is_railed and pairs) or [])
        levels = _in_time(time, lambda pair: _missed(*pair), pairs or [])
        regions = _in_time(time, lambda pair: outside_region(*pair)[0], pairs or [])
        if pairs is None or shares is None or levels is None or regions is None:
            text = "the time budget left no time to run the references on the models"
            found.append(Objection("fair", text, "give more time, or run them (sewfast run)"))
            break
        at_limit = max(at_limit, float(np.mean(shares)) if shares else 0.0)
        outside = max(outside, float(np.mean([_outside(*pair) for pair in pairs])))
        if known := [share for share in regions if math.isfinite(share)]:
            unknown = max(unknown, float(np.mean(known)))
        if sum(map(bool, levels)) > MOST * len(levels):
            missed = next(filter(None, levels))
    if missed:
        found.append(
            Objection(
                "poor",
                f"on the model the loop ends at {missed} that the reference holds, although the "
                "command is not at a limit",
                "search more variables, or check the model at that level",
            )
        )
    if at_limit > MOST:
        found.append(
            Objection(
                "unfit",
                f"the command is at a limit for {100 * at_limit:.0f} % of the samples at which "
                "the reference needs none, so that the loop swings between the limits or is stuck",
                "lower the gains, check the model on new data, or raise the limits",
            )
        )
    if outside > MOST:
        found.append(
            Objection(
                "unfit",
                f"the loop is outside the recorded inputs and outputs for {100 * outside:.0f} % of "
                "a run, where the model is a guess",
                "record such operation, or lower the references and the limits",
            )
        )
    elif unknown > OUTSIDE:
        found.append(
            Objection(
                "fair" if unknown <= MOST else "poor",
                f"the loop runs where the model was not trained for {100 * unknown:.0f} % of a "
                "run, and its predictions there are a guess",
                "record such operation, best in a closed loop, and identify again, or demand less",
            )
        )
    return found


def _of_step(task: TuningTask, controller: SampledController, time: Budget) -> Iterator[Objection]:
    """What the gains make of a step, which is what is asked of an oven or a tank, where they were
    searched on ramps.
    """
    step, Ts = task.step, controller.Ts
    if step is None:
        return
    try:
        pairs = _in_time(time, partial(_run_with, controller, step), _models(task))
    except FitError:
        pairs = []
    over = [one.metrics()["overshoot_percent"] or 0.0 for one, _ in pairs or ()]
    if not over or np.mean(over) <= 100.0 * MISSED:
        return
    fastest = max(float(np.abs(np.diff(r)).max()) for r in task.references) / Ts
    rate = in_unit(f"{fastest:.3g}", f"{controller.y_unit or 'y'}/s")
    yield Objection(
        "fair", f"a step of the reference to {in_unit(f'{step[-1]:.4g}', controller.y_unit)} is "
        f"overshot by {np.mean(over):.0f} %, as the gains were searched on ramps",
        f"ramp the reference by at most {rate}, as r_rate of the controller does, or search on the "
        "reference that will be played (--reference)",
    )  # fmt: skip


Of = TypeVar("Of")
Found = TypeVar("Found")


def _in_time(time: Budget, look: Callable[[Of], Found], at: Sequence[Of]) -> list[Found] | None:
    """A look at each of them; None if there is no time for all."""
    found = []
    for one in at:
        if time.over("the runs for the verdict"):
            return None
        found.append(look(one))
    return found


def _run_with(
    controller: SampledController, r: FloatArray, model: Model
) -> tuple[ClosedLoopRun, Model]:
    return run(controller, model, r), model


def _at_limit(found: ClosedLoopRun, model: Model) -> float:
    """Share of samples at a limit among those at which the reference needs no limit. 0 if these are
    less than half of the reference, or if it is not known what it needs.
    """
    c = found.controller
    try:
        needed = command_for(model, found.r, c.u_min, c.u_max)
    except (FitError, SettingError):
        return 0.0
    room = ROOM * (c.u_max - c.u_min)
    calm = (needed > c.u_min + room) & (needed < c.u_max - room)
    if not np.mean(calm) > MOST:
        return 0.0
    return float(np.mean(_railed(found)[calm]))


def _missed(found: ClosedLoopRun, model: Model) -> str:
    """The first held level that the loop does not meet where the command could still do something;
    empty if there is none.
    """
    r, rest = found.r, model.rest.y
    span = max(float(r.max()), rest) - min(float(r.min()), rest)
    for mean, level, hold in missed_levels(found, MISSED * span):
        if np.any(_railed(found)[hold]):
            continue
        # the last quarter of a hold that is long enough to be met; how long takes long to find
        if 4 * (hold.stop - hold.start) >= _settling(model, found.controller):
            return f"{mean:.4g} instead of {in_unit(f'{level:.4g}', found.controller.y_unit)}"
    return ""


def _settling(model: Model, c: SampledController) -> float:
    """Samples in which a loop around the model can be expected to meet a level: the model's dead
    time and time constant; infinite if these are not known.
    """
    if (growth := growth_rate(model)) > 0.0:
        return 1.0 / (growth * model.Ts)
    try:
        step = rate_step(model, c.u_min, c.u_max) or drive_step(model, c.u_min, c.u_max)
    except (FitError, SettingError):
        return math.inf
    return (step.fopdt.L + step.slowest) / model.Ts


def _railed(found: ClosedLoopRun) -> NDArray[np.bool_]:
    """Samples at a limit of the command."""
    c = found.controller
    hair = 1e-9 * (c.u_max - c.u_min)
    railed: NDArray[np.bool_] = (found.u >= c.u_max - hair) | (found.u <= c.u_min + hair)
    return railed


def command_for(model: Model, r: FloatArray, u_min: float, u_max: float) -> FloatArray:
    """The command [u] with which a first-order model of the step response follows `r` [y], as fast
    as the limits allow, from rest and without the dead time; for a model that integrates, the same
    of the reference's rate. Raises `FitError` or `SettingError` if no step of the model settles.
    """
    moving = rate_step(model, u_min, u_max)
    step = drive_step(model, u_min, u_max) if moving is None else moving
    fopdt, Ts = step.fopdt, model.Ts
    followed = r if moving is None else np.diff(r, append=r[-1:]) / Ts
    stays = math.exp(-Ts / fopdt.T) if fopdt.T > 0.0 else 0.0
    needed = np.empty(len(followed))
    y = model.rest.y if moving is None else 0.0
    for k, wanted in enumerate(followed.tolist()):
        level = (wanted - stays * y) / (1.0 - stays)
        needed[k] = u = min(max((level - fopdt.offset) / fopdt.K, u_min), u_max)
        y = stays * y + (1.0 - stays) * (fopdt.K * u + fopdt.offset)
    return needed


def _outside(found: ClosedLoopRun, model: Model) -> float:
    """Share of samples whose command or output the record and the rest do not come near."""
    outside = np.zeros(len(found.r), dtype=bool)
    for known, values in (
        (recorded_limits([model]), found.u),
        (recorded_outputs(model), found.y),
    ):
        if known is not None:
            room = WIDER * (known[1] - known[0])
            outside |= (values < known[0] - room) | (values > known[1] + room)
    return float(np.mean(outside))


def out_of_reach(task: TuningTask) -> Iterator[Objection]:
    """References that no gains follow: tuning on them minimises the loss at the limit."""
    (plant, *_), start = task.plants, task.start
    gain = min(gain for gain, _ in task.variations)
    if not isinstance(plant, Model) or gain >= 1.0 or moves_on(plant, start.u_min, start.u_max):
        return
    try:
        fopdt = drive_step(plant, start.u_min, start.u_max).fopdt
    except (FitError, SettingError):
        return  # its reach is unknown
    rest = plant.rest.y
    reach = (fopdt.K * u + fopdt.offset for u in (start.u_min, start.u_max))
    low, high = sorted(rest + gain * (y - rest) for y in reach)
    top, bottom = max(r.max() for r in task.references), min(r.min() for r in task.references)
    if bottom >= min(low, rest) and top <= max(high, rest):
        return
    unit = f" {start.y_unit}" if start.y_unit else ""
    yield Objection(
        "fair",
        f"the references ask for {bottom:.4g} to {top:.4g}{unit}, with {gain:g} of its gain the "
        f"drive reaches {low:.4g} to {high:.4g} at the limits of its command: there no gains help, "
        "and those found look for the least loss",
        "lower the references, raise the limits, or give variations without that gain",
    )
