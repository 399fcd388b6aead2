"""`LoadStep`: a disturbance that comes on while a level is held, to tune for."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from .dataset import FloatArray
from .errors import SettingError
from .gains import real

BAND = 0.01
"""Of the level: deviation that counts as recovered."""


@dataclass(frozen=True)
class LoadStep:
    """A level is approached and held; then a command that the controller does not see comes on.

    It acts as a load on the shaft does: a torque of a motor takes as many volts as it makes current
    times resistance (docs/tuning.md). The run's recovery [ms] is the last time after it that the
    true output, in the mean of the last `mean` seconds, is farther than `band` from the level; its
    load the rms of that deviation from then on [y].

    Parameters
    ----------
    level : float
        What is held [y].
    disturbance : float
        Added to the command behind its limits [u]; one that brakes has the other sign.
    band : float, optional
        [y]; a hundredth of the level by default.
    ramp, settle, look : float
        Time of the way to the level, from there to the load, and of the load [s].
    mean : float
        Time of the moving mean of the deviation [s]; that of a turn where a load varies over it, 0
        for none.

    Raises
    ------
    SettingError
        For values that are not finite, no disturbance, times below 0 or no time under load.
    """

    level: float
    disturbance: float
    band: float | None = None
    ramp: float = 0.3
    settle: float = 0.5
    look: float = 0.5
    mean: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "band" and value is None:
                value = BAND * abs(real("level", self.level))
            number = real(field.name, value)
            least = -math.inf if field.name in ("level", "disturbance") else 0.0
            if not (math.isfinite(number) and number >= least):
                raise SettingError(
                    f"expected a finite {field.name} of a load step"
                    + ("" if math.isinf(least) else " of 0 or more")
                    + f", got {value!r}"
                )
            object.__setattr__(self, field.name, number)
        for name in ("disturbance", "band", "look"):
            if getattr(self, name) == 0.0:
                raise SettingError(f"expected a {name} of a load step other than 0, got 0")

    def samples(self, Ts: float) -> tuple[FloatArray, FloatArray, float, int]:
        """Reference [y], disturbance [u], band [y] and samples of the mean."""
        on = round((self.ramp + self.settle) / Ts)
        k = np.arange(on + max(1, round(self.look / Ts)))
        share = np.minimum(1.0, k * Ts / self.ramp) if self.ramp > 0.0 else np.ones(len(k))
        assert self.band is not None
        return (
            self.level * share,
            np.where(k < on, 0.0, self.disturbance),
            self.band,
            max(1, round(self.mean / Ts)),
        )
