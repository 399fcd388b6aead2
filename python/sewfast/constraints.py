"""`Constraints`: what a controller must keep to, whatever it costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

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
    plant: Any = None
    speed: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("Ms", 1.0), ("overshoot", 0.0), ("u", 0.0)):
            value = getattr(self, name)
            if value is None:
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
    def limits(self) -> tuple[float | None, float | None, float | None]:
        """Ms, overshoot [%], \\|u\\| [u]."""
        return self.Ms, self.overshoot, self.u

    def __str__(self) -> str:
        names = {"Ms": "", "overshoot": " %", "u": ""}
        given = {n: getattr(self, n) for n in names if getattr(self, n) is not None}
        return ", ".join(f"{n} <= {v:g}{names[n]}" for n, v in given.items()) or "none"
