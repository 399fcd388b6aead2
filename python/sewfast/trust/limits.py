"""`Limits`: the bounds that loops are judged by."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from ..errors import SettingError
from ..evidence.questions import OUTSIDE
from ..gains import real


@dataclass(frozen=True)
class Limits:
    """Bounds; what exceeds one is warned of, or refused (`disagreement`).

    Parameters
    ----------
    outside : float
        Share of the samples outside the model's training region.
    saturated : float
        Share of the samples with the command at a limit.
    swing : float
        Limit cycle: rms of the command's oscillation at constant reference over half its range.
    ripple : float
        Limit cycle: rms of the output's oscillation at constant reference over the largest
        reference.
    disagreement : float
        Rms distance of a member's output from the median of all members, over the reference's span.

    Raises
    ------
    SettingError
        For a bound that is not a number of 0 or more.
    """

    outside: float = OUTSIDE
    saturated: float = 0.1
    swing: float = 0.15
    ripple: float = 0.02
    disagreement: float = 0.05

    def __post_init__(self) -> None:
        for each in fields(self):
            value = real(each.name, getattr(self, each.name))
            if not 0.0 <= value <= math.inf:
                raise SettingError(f"expected a bound of 0 or more for {each.name}, got {value:g}")
            object.__setattr__(self, each.name, value)
