"""Changed plants: other gain, slower, more delay; a machine with other parameters or load."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import _core
from ..control.loop import Plant
from ..errors import SettingError
from ..gains import real, whole
from ..machine import VirtualMachine
from ..models import Model, NeuralSS
from ..models.base import SingleModel
from ..models.files import from_dict
from ..models.grey_box import GreyBox
from ..models.linear import LinearDifference


@dataclass(frozen=True)
class Change:
    """A change of a plant, for a what-if.

    Attributes
    ----------
    name : str
        Name for the reader.
    apply : callable
        Function from a plant to the changed one; raises a `SettingError` if that is impossible.
    """

    name: str
    apply: Callable[[Plant], Plant]


def gain(factor: float) -> Change:
    """Multiply the output of a model by a factor."""
    factor = _positive("factor", factor)
    return Change(f"gain x {factor:g}", lambda plant: with_gain(_model(plant), factor))


def time_constants(factor: float) -> Change:
    """Multiply every time constant of a model by a factor, as other inertia would."""
    factor = _positive("factor", factor)
    return Change(
        f"time constants x {factor:g}", lambda plant: with_time_constants(_model(plant), factor)
    )


def delay(samples: int) -> Change:
    """Delay the input of a model by some samples."""
    samples = whole("samples", samples)
    plural = "s" if samples != 1 else ""
    return Change(
        f"delay + {samples} sample{plural}", lambda plant: with_delay(_model(plant), samples)
    )


def parameters(name: str, **factors: float) -> Change:
    """Multiply parameters of a virtual machine, each by its factor."""
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
    """Multiply Coulomb, Stribeck and viscous friction of a virtual machine by a factor."""
    names = ("coulomb_torque", "stribeck_torque", "viscous_friction")
    return parameters(f"friction x {factor:g}", **dict.fromkeys(names, factor))


def inertia(factor: float) -> Change:
    """Multiply the inertia of a virtual machine by a factor."""
    return parameters(f"inertia x {factor:g}", inertia=factor)


def crank_load(factor: float) -> Change:
    """Multiply the load that varies over the turn of a virtual machine by a factor."""
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
    if not isinstance(model, SingleModel):
        raise SettingError("gain: expected a single model, received an ensemble; take its members")
    scaled = _changed(model, **model.with_output_scaled(factor))
    assert isinstance(scaled, SingleModel)
    # the level at rest stays
    moved = (factor - 1.0) * model.rest.y
    parameters = scaled.with_zero_at(np.zeros(len(model.input_names)), moved) if moved else {}
    return _changed(scaled, **(parameters or {}))


def with_delay(model: Model, samples: int) -> Model:
    if not isinstance(model, SingleModel):
        raise SettingError("delay: expected a single model, received an ensemble; take its members")
    return _changed(model, **model.with_input_delayed(samples))


def with_time_constants(model: Model, factor: float) -> Model:
    """The model with the same steady states, reached more slowly by a factor. Linear: every pole p
    becomes p^(1/factor); the steady gain is kept, an integrator's rate is divided by the factor.
    State space: every step is 1/factor as large. Grey box: inertia and lag are multiplied. A lagged
    network has no time constants to change: `SettingError`.
    """
    if isinstance(model, LinearDifference):
        return _slower_linear(model, factor)
    if isinstance(model, NeuralSS):
        return _changed(model, theta=model.core.slowed(factor).theta.tolist())
    if isinstance(model, GreyBox):
        slow = [factor if n in ("k_a", "tau") else 1.0 for n in model.parameter_names]
        return _changed(model, theta=(model.theta * slow).tolist())
    raise SettingError(
        f"expected a linear or a state-space model to change time constants of, got a "
        f"{model.kind}; identify with model='neural_ss', or look at the gain instead"
    )


def _slower_linear(model: LinearDifference, factor: float) -> Model:
    core: _core.LinearModel = model.core
    poles = np.roots(np.concatenate([[1.0], core.a])).astype(np.complex128)
    # very fast poles have no meaningful time constant
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
