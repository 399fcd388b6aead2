"""`Variable`: what of a controller is searched, between which bounds, and what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np

from .control.controller import Controller
from .errors import SettingError
from .gains import Gains, real

Wanted: TypeAlias = str | tuple[str, float, float]

GAINS = ("Kp", "Ti", "Td")
SETTINGS = (
    "alpha", "beta", "N", "Tt", "filter_samples", "filter_time", "observer_time", "r_rate",
)  # fmt: skip
_EDGE = 1e-3


@dataclass(frozen=True)
class Variable:
    """A number of the controller that was searched.

    Attributes
    ----------
    name : str
        ``Kp``, ``Ti``, ``Td``, a setting of `Controller`, or ``Kp[0]``.. of a schedule's point.
    low, high : float
        Its bounds.
    value : float
        What was found.
    """

    name: str
    low: float
    high: float
    value: float

    @property
    def at_bound(self) -> bool:
        """Whether it lies on a bound: what is best may lie beyond."""
        room = _EDGE * (self.high - self.low)
        near_low = self.value <= self.low + min(room, _EDGE * abs(self.low) or room)
        return near_low or self.value >= self.high - room

    def __str__(self) -> str:
        where = ", at a bound" if self.at_bound else ""
        return f"{self.name} {self.value:.6g} ({self.low:.4g} to {self.high:.4g}{where})"


def wanted(
    variables: Sequence[Wanted] | None, start: Controller
) -> list[tuple[str, tuple[float, float] | None]]:
    """Names and bounds as the core takes them; ``schedule`` stands for the gains of all points.

    Raises
    ------
    SettingError
        For what is neither a name nor a name with two bounds, or for no variable at all.
    """
    if variables is None:
        return []
    if isinstance(variables, str) or not variables:
        raise SettingError(
            f"expected a list of variables, got {variables!r}; for example variables=['Kp', "
            "('Ti', 0.02, 0.5)]"
        )
    return [one for given in variables for one in _one(given, start)]


def usual_variables(start: Controller) -> list[Wanted] | None:
    """What is searched unless it is named, where the core's usual bounds do not hold it; else None.

    These leave Ti at 4 sample times or more. A drive whose time constant is a few sample times
    begins below that.
    """
    Ti = start.gains.to("standard").Ti
    if start.schedule or not 0.0 < Ti < 8.0 * start.Ts:
        return None
    names: list[Wanted] = ["Kp", ("Ti", 0.1 * Ti, 1e3 * Ti), "Td", "alpha", "beta"]
    return [*names, "N"] if np.isfinite(start.N) else names


def _one(given: Any, start: Controller) -> list[tuple[str, tuple[float, float] | None]]:
    if given == "schedule":
        points = len(start.schedule)
        if not points:
            raise SettingError(
                "expected a start with a gain schedule for the variable 'schedule', got one with "
                "constant gains; search 'Kp', 'Ti', 'Td'"
            )
        return [(f"{gain}[{k}]", None) for k in range(points) for gain in GAINS]
    if isinstance(given, str):
        return [(given, None)]
    if not (isinstance(given, tuple) and len(given) == 3 and isinstance(given[0], str)):
        raise SettingError(
            f"expected a variable as a name or (name, low, high), got {given!r}; for example "
            "('Ti', 0.02, 0.5)"
        )
    name, *bounds = given
    low, high = (real(f"the bounds of {name}", bound) for bound in bounds)
    if name == "filter_samples" and low < high and np.ceil(low) > np.floor(high):
        raise SettingError(
            f"expected bounds of filter_samples with a whole number between them, got {low:g} and "
            f"{high:g}"
        )
    return [(name, (low, high))]


def applied(values: Mapping[str, float], start: Controller, notes: str) -> Controller:
    """The start with these values by name; its gains in standard form."""
    gains = _standard(start.gains, values, GAINS)
    known = {field.name for field in fields(start)}
    changes: dict[str, Any] = {n: values[n] for n in SETTINGS if n in values and n in known}
    if "filter_samples" in changes:
        changes["filter_samples"] = int(changes["filter_samples"])
    schedule = getattr(start, "schedule", ())
    if schedule:
        changes["schedule"] = tuple(
            (speed, _standard(point, values, [f"{gain}[{k}]" for gain in GAINS]))
            for k, (speed, point) in enumerate(schedule)
        )
    return replace(start, gains=gains, notes=notes, **changes)


def _standard(own: Gains, values: Mapping[str, float], names: Sequence[str]) -> Gains:
    """The gains in standard form, with the values that have one of the names."""
    standard = own.to("standard")
    kept = (standard.Kp, standard.Ti, standard.Td)
    Kp, Ti, Td = (values.get(name, own) for name, own in zip(names, kept, strict=True))
    return Gains.standard(Kp, Ti, Td, u_unit=own.u_unit, y_unit=own.y_unit)
