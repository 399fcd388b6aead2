"""`LoopBode`: L, S and T of every plant over frequency, about one operating point, with margins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..control import Controller
from ..dataset import FloatArray
from ..robustness import Margins, loop_response, margins
from .points import PlantPoint, to_json

FREQUENCIES = 240
_BELOW = 0.02
"""The lowest frequency over that of the slowest closed-loop pole."""


@dataclass(frozen=True, eq=False)
class LoopBode:
    """The loop around every plant about one operating point.

    Attributes
    ----------
    points : tuple of PlantPoint
        One per plant.
    hertz : array, shape (F,)
    L : array of complex, shape (plants, F)
        Broken at the plant's input.
    margins : tuple of Margins
        One per plant.
    """

    points: tuple[PlantPoint, ...]
    hertz: FloatArray
    L: NDArray[np.complex128]
    margins: tuple[Margins, ...]

    @property
    def S(self) -> NDArray[np.complex128]:
        """Sensitivity 1/(1 + L), shape (plants, F)."""
        return np.asarray(1.0 / (1.0 + self.L), dtype=np.complex128)

    @property
    def T(self) -> NDArray[np.complex128]:
        """Complementary sensitivity L/(1 + L), shape (plants, F)."""
        return np.asarray(self.L / (1.0 + self.L), dtype=np.complex128)

    @property
    def level(self) -> float:
        """The steady output [y], that of the first plant."""
        return self.points[0].y

    @property
    def Ms(self) -> float:
        """The largest of all plants; infinite where one is unstable."""
        return max(m.Ms for m in self.margins)

    @property
    def worst(self) -> Margins:
        """The margins of the plant with the largest Ms."""
        return max(self.margins, key=lambda m: m.Ms)

    def to_json(self) -> dict[str, Any]:
        """Operating point and margins as JSON values; the curves are in the figures."""
        rows = zip(self.points, self.margins, strict=True)
        return {
            "level": self.level,
            "plants": [{**to_json(p), "margins": margins_json(m)} for p, m in rows],
        }


def margins_json(found: Margins) -> dict[str, Any]:
    """As JSON values; what is not finite becomes None."""
    names = (
        "Ms", "Mt", "gain_margin", "phase_margin_deg", "delay_margin_s", "noise_gain"
    )  # fmt: skip
    values = {n: getattr(found, n) for n in names}
    return {
        "stable": found.stable,
        **{n: v if math.isfinite(v) else None for n, v in values.items()},
    }


def loop_bodes(
    controller: Controller, points: Sequence[Sequence[PlantPoint]], slowest: float
) -> tuple[LoopBode, ...]:
    """The loop about every operating point.

    Parameters
    ----------
    controller : Controller
    points : sequence (operating points) of sequence (plants) of PlantPoint
    slowest : float
        Time constant of the slowest closed-loop pole [s], from which the frequencies begin.
    """
    low = min(_BELOW / (2.0 * math.pi * slowest), 0.01 / controller.Ts)
    hertz = np.geomspace(low, 0.5 / controller.Ts, FREQUENCIES)
    return tuple(_of(controller, tuple(row), hertz) for row in points)


def _of(controller: Controller, row: tuple[PlantPoint, ...], hertz: FloatArray) -> LoopBode:
    omega = 2.0 * math.pi * hertz
    L = np.array([loop_response(controller, p, omega, speed=p.y) for p in row])
    return LoopBode(row, hertz, L, tuple(margins(controller, p, speed=p.y) for p in row))
