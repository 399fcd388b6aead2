"""`Axis`: a range that ends on round numbers, with its ticks and their labels."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Axis:
    """A range of values and the round numbers in it, which its ends need not be.

    Attributes
    ----------
    low, high : float
        Ends; `low < high`.
    step : float
        Between ticks: 1, 2 or 5 times a power of ten.
    """

    low: float
    high: float
    step: float

    @classmethod
    def around(cls, low: float, high: float, ticks: int) -> Axis:
        """A range that holds `low` to `high` in about `ticks` steps and ends on fifths of one."""
        if not (math.isfinite(low) and math.isfinite(high)):
            low, high = 0.0, 1.0
        if high - low < 1e-9 * max(abs(low), abs(high), 1e-3):
            pad = 0.5 * max(abs(low), 1.0)
            low, high = low - pad, high + pad
        step = round_step((high - low) / max(ticks, 1))
        found = cls._on_fifths(low, high, step)
        while len(found.ticks()) < 2:
            # one number alone says nothing of the scale
            step = round_step(step / 2.5)
            found = cls._on_fifths(low, high, step)
        return found

    @classmethod
    def _on_fifths(cls, low: float, high: float, step: float) -> Axis:
        fifth = step / 5
        return cls(math.floor(low / fifth) * fifth, math.ceil(high / fifth) * fifth, step)

    @classmethod
    def exactly(cls, low: float, high: float, ticks: int) -> Axis:
        """The given ends, with round ticks between them."""
        return cls(low, high, round_step((high - low) / max(ticks, 1)))

    def ticks(self) -> list[float]:
        """The multiples of the step within the ends, upwards."""
        first = math.ceil(self.low / self.step - 1e-9)
        last = math.floor(self.high / self.step + 1e-9)
        return [k * self.step for k in range(first, last + 1)]

    def label(self, value: float) -> str:
        """With as many decimals as the step needs."""
        if not 1e-4 <= self.step < 1e6:
            return f"{value:.3g}"
        decimals = max(0, -math.floor(math.log10(self.step) + 1e-9))
        return f"{value + 0.0:.{decimals}f}"

    def place(self, value: float, places: int) -> int:
        """The nearest of `places` points, of which the first is at `low` and the last at `high`."""
        return round((value - self.low) / (self.high - self.low) * (places - 1))


def round_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below `least`."""
    power = 10.0 ** math.floor(math.log10(least))
    factor = next((f for f in (1.0, 2.0, 5.0) if f * power >= least * (1 - 1e-9)), 10.0)
    return factor * power
