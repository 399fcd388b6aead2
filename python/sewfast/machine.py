"""The virtual sewing machine, for experiments without a real one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._core import Machine
from .errors import SettingError
from .gains import real, vector

__all__ = ["MachineRun", "VirtualMachine"]

_NAME = re.compile(r"virtual(?::(\d+))?(?:\?(.*))?")


@dataclass(frozen=True, eq=False)
class MachineRun:
    """The response of a machine, at the instants at which each command starts to act. `counts` (N,)
    are encoder counts since the reset, whole numbers unless quantisation is off. `speed_rpm` (N,)
    is the true speed [RPM], which a real experiment cannot measure; it is for tests and scores.
    """

    counts: NDArray[np.float64]
    speed_rpm: NDArray[np.float64]


class VirtualMachine:
    """A computed sewing machine: inverter, motor, crank and encoder, sampled every millisecond.

    Equations, parameters and their spread are in docs/CONVENTIONS.md.

    Parameters
    ----------
    seed
        None is the nominal machine; a whole number gives another machine of the same type.
    u_limit
        Largest command in either direction [V].
    angle_dependence
        Whether load, inertia and torque vary over the turn of the crank.
    quantisation
        Whether the encoder gives whole counts. Without it counts are the exact position.
    load_inertia
        Inertia of a second mass behind an elastic shaft [kg m^2]; 0 is a rigid machine. The
        encoder stays on the first. The masses oscillate against each other at
        ``sqrt(stiffness (1 / inertia + 1 / load_inertia))`` [rad/s]; the first stands still at
        ``sqrt(stiffness / load_inertia)``.
    stiffness, damping, backlash
        Of the shaft [N m/rad, N m s/rad, rad]; they matter only with a second mass. None keeps the
        values of `parameters`.
    parameters
        Values by name that replace those of the machine chosen so far.

    Raises
    ------
    SettingError
        For an invalid seed, parameter name or value.
    """

    Ts = 0.001
    """Sample time [s]."""

    def __init__(
        self,
        seed: int | None = None,
        *,
        u_limit: float = 20.0,
        angle_dependence: bool = True,
        quantisation: bool = True,
        load_inertia: float | None = None,
        stiffness: float | None = None,
        damping: float | None = None,
        backlash: float | None = None,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        values = {} if seed is None else Machine.variant_parameters(_checked_seed(seed))
        values["u_limit"] = u_limit
        values["angle_dependence"] = float(angle_dependence)
        values["quantisation"] = float(quantisation)
        values.update(parameters or {})
        shaft = {
            "load_inertia": load_inertia,
            "shaft_stiffness": stiffness,
            "shaft_damping": damping,
            "shaft_backlash": backlash,
        }
        given = {name: value for name, value in shaft.items() if value is not None}
        values.update(given)
        self._core = Machine({name: real(name, value) for name, value in values.items()})
        self._name = _name(seed, {**(parameters or {}), **given})

    @classmethod
    def from_name(cls, name: str) -> VirtualMachine:
        """The machine by its name: ``virtual``, or ``virtual:SEED`` for another of the same type.

        Parameters may follow: ``virtual?load_inertia=0.002&shaft_stiffness=150``.

        Raises
        ------
        SettingError
            For any other name.
        """
        match = _NAME.fullmatch(name) if isinstance(name, str) else None
        if match is None:
            raise SettingError(
                name="name", expected="'virtual' or 'virtual:SEED' with a whole number",
                received=repr(name), remedy="for example 'virtual:1'",
            )  # fmt: skip
        seed = None if match[1] is None else int(match[1])
        return cls(seed, parameters=_parameters(match[2] or "", name))

    @property
    def core(self) -> Machine:
        """The compiled machine; `sewfast.control.loop` uses it as a plant."""
        return self._core

    @property
    def name(self) -> str:
        """``virtual`` or ``virtual:SEED``."""
        return self._name

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter by name; :meth:`units` gives their units."""
        return self._core.parameters

    @staticmethod
    def units() -> dict[str, str]:
        """The unit of every parameter by name; ``1`` for a pure number, ``switch`` for 0 or 1."""
        return Machine.parameter_units()

    @property
    def counts_per_rev(self) -> float:
        """Encoder counts per turn of the crank."""
        return self._core.parameters["counts_per_rev"]

    @property
    def counts(self) -> float:
        """The encoder's present count."""
        return self._core.counts

    @property
    def speed_rpm(self) -> float:
        """The present true speed [RPM]."""
        return self._core.speed_rpm

    @property
    def current(self) -> float:
        """The present motor current [A]."""
        return self._core.current

    def reset(self) -> None:
        """Return to rest at the initial crank angle, with the counter at zero."""
        self._core.reset()

    def set_load(self, torque: float) -> None:
        """Load the shaft with a constant torque [N m] from now on; a reset does not remove it.

        It brakes if it has the sign of the speed; 0 removes it.

        Raises
        ------
        SettingError
            If the torque is not finite.
        """
        self._core.set_load(torque)

    def step(self, u: float) -> tuple[float, float]:
        """Hold the command ``u`` [V] for one sample; counts and true speed [RPM] at its end.

        Raises
        ------
        DataError
            If ``u`` is not finite.
        """
        return self._core.step(u)

    def run(self, u: ArrayLike) -> MachineRun:
        """Hold each command in turn for one sample, starting from the present state.

        Parameters
        ----------
        u
            Commands [V], (N,), clipped to ``u_limit`` as by the drive.

        Raises
        ------
        DataError
            If ``u`` is not a one-dimensional array of finite numbers.
        """
        counts, speed = self._core.run(vector("u", u))
        return MachineRun(counts, speed)

    def linearise(self, speed_rpm: float = 1500.0) -> dict[str, float]:
        """Linearise at a steady speed: command [V], current [A], gain [RPM/V], T1, T2 [s].

        Raises
        ------
        SettingError
            At standstill and beyond the drive's limits.
        """
        return self._core.linearise(speed_rpm)

    def __repr__(self) -> str:
        return f"VirtualMachine.from_name({self._name!r})"


def _name(seed: int | None, parameters: Mapping[str, float]) -> str:
    """The name from which `VirtualMachine.from_name` builds the same machine."""
    name = "virtual" if seed is None else f"virtual:{int(seed)}"
    query = "&".join(f"{key}={float(value)!r}" for key, value in parameters.items())
    return f"{name}?{query}" if query else name


def _parameters(query: str, name: str) -> dict[str, float]:
    found = {}
    for part in query.split("&") if query else ():
        key, _, value = part.partition("=")
        try:
            found[key] = float(value)
        except ValueError:
            raise SettingError(
                name=name, expected="NAME=NUMBER between '?' and '&'", received=repr(part),
                remedy="for example 'virtual?load_inertia=0.002'",
            ) from None  # fmt: skip
    return found


def _checked_seed(seed: int) -> int:
    largest_seed = 2**64 - 1
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)):
        raise SettingError(name="seed", expected="a whole number or None", received=repr(seed))
    if not 0 <= seed <= largest_seed:
        raise SettingError(name="seed", expected=f"0 to {largest_seed}", received=str(seed))
    return int(seed)
