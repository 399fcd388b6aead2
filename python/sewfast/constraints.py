"""`Constraints`: what a controller must keep to, whatever it costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

from . import _core
from .control.controller import Controller
from .errors import SettingError
from .gains import real


@dataclass(frozen=True)
class Constraints:
    """Limits that come before the cost (docs/CONVENTIONS.md, Tuning).

    Of two controllers the one within all limits is better; of two beyond them, that with the
    smaller sum of relative violations.

    Parameters
    ----------
    Ms : float, optional
        Largest sensitivity of the linear loop (`sewfast.margins`), 1.4 to 2 for a robust one; with
        a gain schedule at each of its points.
    overshoot : float, optional
        Largest overshoot on steps and trapezoids [%], on every plant.
    u : float, optional
        Largest \\|u\\| in every run [u].
    recovery : float or Controller, optional
        Longest recovery from any load step, on every plant in every variation [ms]. Of a
        controller what it takes on each plant itself, at least one sample: no plant may recover
        later than under it, as it is, or in every variation where none leaves it as it is.
    load : float or Controller, optional
        Largest rms deviation under any load step [y], likewise.
    plant : linear plant or list of them, optional
        Where Ms is taken: whatever `sewfast.margins` takes. By default the linear models among the
        plants that are tuned on.
    speed : float, optional
        Where a nonlinear `plant` is linearised [y].

    Raises
    ------
    SettingError
        For a limit that is not finite and above 0, or Ms not above 1.
    """

    Ms: float | None = None
    overshoot: float | None = None
    u: float | None = None
    recovery: float | Controller | None = None
    load: float | Controller | None = None
    plant: Any = None
    speed: float | None = None

    def __post_init__(self) -> None:
        for name in LIMITS:
            value, least = getattr(self, name), 1.0 if name == "Ms" else 0.0
            if value is None or (name in BY_RIVAL and isinstance(value, Controller)):
                continue
            limit = real(name, value)
            if not (limit > least and math.isfinite(limit)):
                raise SettingError(
                    f"expected a finite limit above {least:g} for {name}, got {value!r}"
                )
            object.__setattr__(self, name, limit)
        if self.speed is not None:
            object.__setattr__(self, "speed", real("speed", self.speed))

    @property
    def limits(self) -> _core._Limits:
        """By name, as the core takes them."""
        values = {name: getattr(self, name) for name in LIMITS}
        cores = {n: v.core() if isinstance(v, Controller) else v for n, v in values.items()}
        return cast("_core._Limits", cores)

    def __str__(self) -> str:
        given = {n: getattr(self, n) for n in LIMITS if getattr(self, n) is not None}
        return ", ".join(_told(n, v) for n, v in given.items()) or "none"


LIMITS = {"Ms": "", "overshoot": " %", "u": "", "recovery": " ms", "load": ""}
"""Every limit with its unit."""
BY_RIVAL = ("recovery", "load")


def _told(name: str, limit: float | Controller) -> str:
    if isinstance(limit, Controller):
        return f"{name} no larger than under {limit.notes or 'another controller'}"
    return f"{name} <= {limit:g}{LIMITS[name]}"
