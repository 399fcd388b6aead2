"""What changes cost: gains that are off, and plants that are not as identified."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from .. import _core
from ..control import Controller
from ..cost import Cost, terms
from ..errors import FitError, SettingError
from ..gains import Gains, real, whole
from ..loop import Plant, run
from ..machine import VirtualMachine
from ..models import Model, NeuralSS
from ..models.files import from_dict
from ..models.linear import LinearDifference
from ..robustness import margins
from ..threads import available
from .points import PlantPoint, plant_points

# --- Plants that are not as identified: other gain, slower, later; a machine with another load ----


@dataclass(frozen=True)
class Change:
    """What if a plant were different?

    Attributes
    ----------
    name : str
        As a reader sees it.
    apply : callable
        From a plant to the changed one; a `SettingError` where a plant cannot be changed so.
    """

    name: str
    apply: Callable[[Plant], Plant]


def gain(factor: float) -> Change:
    """The output of a model times a factor."""
    factor = _positive("factor", factor)
    return Change(f"gain x {factor:g}", lambda plant: with_gain(_model(plant), factor))


def time_constants(factor: float) -> Change:
    """Every time constant of a model times a factor, as more or less inertia would do."""
    factor = _positive("factor", factor)
    return Change(
        f"time constants x {factor:g}", lambda plant: with_time_constants(_model(plant), factor)
    )


def delay(samples: int) -> Change:
    """The input of a model acts some samples later."""
    samples = whole("samples", samples)
    plural = "s" if samples != 1 else ""
    return Change(
        f"delay + {samples} sample{plural}", lambda plant: with_delay(_model(plant), samples)
    )


def parameters(name: str, **factors: float) -> Change:
    """Parameters of a virtual machine, each times its factor."""
    known = VirtualMachine().parameters
    for one, factor in factors.items():
        if one not in known:
            raise SettingError(f"expected a parameter out of {', '.join(known)}, got {one!r}")
        _positive(one, factor, zero=True)

    def apply(plant: Plant) -> Plant:
        machine = _machine(plant)
        changed = {k: f * machine.parameters[k] for k, f in factors.items()}
        return VirtualMachine(parameters={**machine.parameters, **changed})

    return Change(name, apply)


def load(torque: float) -> Change:
    """A constant load torque on the shaft of a virtual machine [N m]."""
    torque = real("torque", torque)
    if not math.isfinite(torque):
        raise SettingError(f"expected a finite torque [N m], got {torque}")

    def apply(plant: Plant) -> Plant:
        machine = VirtualMachine(parameters=_machine(plant).parameters)
        machine.set_load(torque)
        return machine

    return Change(f"load {torque:g} N m", apply)


def friction(factor: float) -> Change:
    """Coulomb, Stribeck and viscous friction of a virtual machine times a factor."""
    names = ("coulomb_torque", "stribeck_torque", "viscous_friction")
    return parameters(f"friction x {factor:g}", **dict.fromkeys(names, factor))


def inertia(factor: float) -> Change:
    """The inertia of a virtual machine times a factor."""
    return parameters(f"inertia x {factor:g}", inertia=factor)


def crank_load(factor: float) -> Change:
    """The load that varies over the turn of a virtual machine times a factor."""
    return parameters(f"crank load x {factor:g}", load_first=factor, load_second=factor)


def _positive(name: str, value: Any, *, zero: bool = False) -> float:
    factor = real(name, value)
    if not (0.0 <= factor < math.inf and (zero or factor)):
        raise SettingError(
            f"expected a finite factor {'of 0 or more' if zero else 'above 0'} for {name}, got "
            f"{factor:g}"
        )
    return factor


ON_MODELS = (
    gain(0.75), gain(1.25), time_constants(0.75), time_constants(1.25), delay(1), delay(2),
)  # fmt: skip
ON_MACHINES = (
    inertia(0.75), inertia(1.25), friction(0.5), friction(2.0), crank_load(2.0),
    parameters("motor constant x 0.9", motor_constant=0.9),
    parameters("motor constant x 1.1", motor_constant=1.1), load(0.1),
)  # fmt: skip


def _model(plant: Plant) -> Model:
    if isinstance(plant, Model):
        return plant
    raise SettingError("expected a model, got a machine; change its parameters, inertia or load")


def _machine(plant: Plant) -> VirtualMachine:
    if isinstance(plant, VirtualMachine):
        return plant
    raise SettingError("expected a virtual machine, got a model; change its gain or delay")


# --- models ---------------------------------------------------------------------------------------


def _changed(model: Model, **parameters: Any) -> Model:
    values = model.to_dict()
    return from_dict({**values, "parameters": {**values["parameters"], **parameters}})


def with_gain(model: Model, factor: float) -> Model:
    """The same model whose output is a factor as large."""
    p = model.parameters()
    if isinstance(model, LinearDifference):
        b = (factor * np.asarray(p["b"])).tolist()
        return _changed(model, b=b, offset=factor * p["offset"])
    scaled = {k: (factor * np.asarray(p[k])).tolist() for k in ("y_mean", "y_scale")}
    return _changed(model, **scaled)


def with_delay(model: Model, samples: int) -> Model:
    """The same model whose input acts some samples later."""
    return _changed(model, nk=model.parameters()["nk"] + samples)


def with_time_constants(model: Model, factor: float) -> Model:
    """The same steady states, reached a factor more slowly.

    Linear: every pole p becomes p^(1/factor), the steady gain, or an integrator's rate over the
    factor, stays. State space: every step goes 1/factor of its way. A lagged network has no time
    constants of its own to change.

    Raises
    ------
    SettingError
        For a lagged network.
    """
    if isinstance(model, LinearDifference):
        return _slower_linear(model, factor)
    if isinstance(model, NeuralSS):
        return _changed(model, theta=model.core.slowed(factor).theta.tolist())
    raise SettingError(
        f"expected a linear or a state-space model to change time constants of, got a "
        f"{model.kind}; identify with model='neural_ss', or look at the gain instead"
    )


def _slower_linear(model: LinearDifference, factor: float) -> Model:
    core: _core.LinearModel = model.core
    poles = np.roots(np.concatenate([[1.0], core.a])).astype(np.complex128)
    # what is not on its way to rest within some samples has no time constant to speak of
    slow = (poles.real > 0.0) & (np.abs(poles) > 1e-6)
    moved = np.where(slow, np.where(slow, poles, 1.0) ** (1.0 / factor), poles)
    integrates = np.abs(1.0 - poles) < 1e-9
    ratios = np.where(
        integrates, 1.0 / factor, (1.0 - moved) / np.where(integrates, 1.0, 1.0 - poles)
    )
    share = float(np.prod(ratios).real)
    a = np.real(np.poly(moved))[1:]
    values = {"a": a.tolist(), "b": (share * core.b).tolist(), "offset": share * core.offset}
    return _changed(model, **values)


# --- Score: what a controller costs on plants over references, and how near to instability it is --


J = TypeVar("J")
R = TypeVar("R")


@dataclass(frozen=True)
class Score:
    """A controller on a set of plants.

    Attributes
    ----------
    cost : float
        Mean over plants and references [y]; infinite where a loop runs away.
    tracking : float
        The worst rms of r - y [y].
    overshoot_percent : float
        The worst.
    chatter : float
        The worst rms of the command's change from sample to sample [u].
    Ms : float
        The worst; infinite where a linear loop is unstable, NaN where there is none.
    """

    cost: float
    tracking: float
    overshoot_percent: float
    chatter: float
    Ms: float

    def to_json(self) -> dict[str, float | None]:
        """As JSON values; what is not finite becomes None."""
        return {k: v if math.isfinite(v) else None for k, v in vars(self).items()}


@dataclass(frozen=True, eq=False)
class Task:
    """What a controller is scored on.

    Attributes
    ----------
    plants : tuple of Model or VirtualMachine
    names : tuple of str
    points : tuple of PlantPoint
        The plants about the operating point at which Ms is taken.
    references : tuple of str or array
    cost : Cost
    seed : int
    """

    plants: tuple[Plant, ...]
    names: tuple[str, ...]
    points: tuple[PlantPoint, ...]
    references: tuple[Any, ...]
    cost: Cost
    seed: int

    def on(self, plants: Sequence[Plant], names: Sequence[str]) -> Task:
        """The same on other plants, linearised at the same output."""
        points: tuple[PlantPoint, ...] = ()
        with contextlib.suppress(SettingError):
            points = plant_points(plants, names, [self.points[0].y])[0]
        return replace(self, plants=tuple(plants), names=tuple(names), points=points)

    def score(self, controller: Controller) -> Score:
        """Run every reference on every plant."""
        peaks = [margins(controller, p, speed=p.y).Ms for p in self.points]
        Ms = max(peaks, default=math.nan)
        costs, seen = [], []
        try:
            for plant in self.plants:
                runs = [run(controller, plant, r, seed=self.seed) for r in self.references]
                costs.append(self.cost.of(runs))
                seen += [terms(r) for r in runs]
        except FitError:
            return Score(math.inf, math.inf, math.inf, math.inf, Ms)
        worst = {n: max(s[n] for s in seen) for n in ("tracking", "overshoot", "chatter")}
        return Score(
            float(np.mean(costs)), worst["tracking"], worst["overshoot"], worst["chatter"], Ms
        )


def each(function: Callable[[J], R], jobs: Sequence[J], threads: int | None) -> list[R]:
    """In the order of the jobs, on threads: the compiled runs release the interpreter."""
    with ThreadPoolExecutor(threads or available()) as pool:
        return list(pool.map(function, jobs))


# --- GainSensitivity: what a gain that is a little off costs --------------------------------------


FACTORS = (0.75, 0.9, 1.1, 1.25)
NAMES = ("Kp", "Ti", "Td", "alpha", "beta", "N", "filter_time", "observer_time")


@dataclass(frozen=True)
class GainSensitivity:
    """One setting, moved.

    Attributes
    ----------
    name : str
        `Kp`, `Ti`, `Td` (of the schedule as well), `alpha`, `beta`, `N`, ...
    value : float
        As it is.
    factors : tuple of float
    scores : tuple of Score
        One per factor.
    """

    name: str
    value: float
    factors: tuple[float, ...]
    scores: tuple[Score, ...]

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        rows = zip(self.factors, self.scores, strict=True)
        return {
            "name": self.name,
            "value": self.value,
            "moved": [{"factor": f, **s.to_json()} for f, s in rows],
        }


def gain_sensitivity(
    controller: Controller, task: Task, *, threads: int | None = None
) -> tuple[GainSensitivity, ...]:
    """Every setting that is neither 0 nor infinite, by each of `FACTORS`.

    Parameters
    ----------
    controller : Controller
    task : Task
        Plants, references and cost.
    threads : int, optional
        All processors by default; the result is the same at any number.
    """
    values = {n: v for n in NAMES if (v := _value(controller, n)) and math.isfinite(v)}
    jobs = [(n, f) for n in values for f in FACTORS]
    scores = each(lambda job: task.score(scaled(controller, *job)), jobs, threads)
    return tuple(
        GainSensitivity(n, v, FACTORS, tuple(scores[i * len(FACTORS) : (i + 1) * len(FACTORS)]))
        for i, (n, v) in enumerate(values.items())
    )


def _value(controller: Controller, name: str) -> float:
    if name in ("Kp", "Ti", "Td"):
        return float(getattr(controller.gains.to("standard"), name))
    return float(getattr(controller, name))


def scaled(controller: Controller, name: str, factor: float) -> Controller:
    """The controller with one setting times a factor, gains in standard form."""
    if name not in ("Kp", "Ti", "Td"):
        return replace(controller, **{name: factor * getattr(controller, name)})
    changes: dict[str, Any] = {"gains": _scaled(controller.gains, name, factor)}
    schedule = controller.schedule
    if schedule:
        changes["schedule"] = tuple((s, _scaled(g, name, factor)) for s, g in schedule)
    return replace(controller, **changes)


def _scaled(gains: Gains, name: str, factor: float) -> Gains:
    g = gains.to("standard")
    values = {"Kp": g.Kp, "Ti": g.Ti, "Td": g.Td}
    values[name] *= factor
    return Gains.standard(**values, u_unit=g.u_unit, y_unit=g.y_unit)


# --- WhatIf: the controller on plants that are not as identified ----------------------------------


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
    tasks = [(c.name, found) for c in changes if (found := _with_changes(task, c)) is not None]
    scores = each(lambda job: job[1].score(controller), tasks, threads)
    return tuple(WhatIf(name, s) for (name, _), s in zip(tasks, scores, strict=True))


def _with_changes(task: Task, change: Change) -> Task | None:
    """The task on those plants that can be changed so; None where none can."""
    plants, names = [], []
    for plant, name in zip(task.plants, task.names, strict=True):
        try:
            plants.append(change.apply(plant))
        except SettingError:
            continue
        names.append(name)
    return task.on(plants, names) if plants else None
