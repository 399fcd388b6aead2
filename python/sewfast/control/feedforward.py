"""`Feedforward`: the command that a model needs for a reference, part of a PID `Controller`.

It takes the reference `preview` samples early, and adds the command that holds this level and the
one for its last changes. The measurement is compared with the reference at that time, late by the
same filter. The arithmetic is that of `sewfast_control::feedforward`, on every plant and device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray
from ..errors import SettingError
from ..gains import real, vector, whole
from ..storage import Fields

if TYPE_CHECKING:
    from ..models.rest import Rest

AHEAD, LEVELS, TAPS = 30, 8, 16
"""The longest preview in samples, the most levels and the most taps: what a device has room for."""


@dataclass(frozen=True)
class Feedforward:
    """The command that a model needs for a reference that is known ahead.

    Parameters
    ----------
    preview : int
        Samples by which the reference arrives early, 0 to 30. It covers the delay and lag of the
        plant. A reference that is not known ahead is followed this much later.
    late : float
        Share of a sample by which a measurement is late before the controller's filter: .5 for a
        speed from counts, 0 for a direct one.
    levels : sequence of (float, float)
        Up to 8 outputs [y], growing, each with the command that holds it [u]. Linear between them,
        and on the same line beyond the ends.
    taps : sequence of float
        Up to 16 commands per change of the reference [u/y], the newest change's first.

    Raises
    ------
    SettingError
        For a value outside its range, or neither levels nor taps.

    Notes
    -----
    ``u(k) = held(r(k+p)) + sum_j taps[j] (r(k+p-j) - r(k+p-j-1))`` with the preview `p`: the static
    inverse of a model, and the truncated non-causal inverse of its dynamics (Zou and Devasia, ASME
    J. Dyn. Syst. Meas. Control 121, 1999).
    """

    preview: int = 0
    late: float = 0.0
    levels: tuple[tuple[float, float], ...] = ()
    taps: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        try:
            levels = tuple((real("level", y), real("level", u)) for y, u in self.levels)
            taps = tuple(real("tap", tap) for tap in self.taps)
        except (TypeError, ValueError) as error:
            raise SettingError(
                name="feedforward", expected="levels as (output, command) pairs, and taps",
                received=f"{self.levels!r} and {self.taps!r}",
            ) from error  # fmt: skip
        object.__setattr__(self, "preview", whole("preview", self.preview))
        object.__setattr__(self, "late", real("late", self.late))
        object.__setattr__(self, "levels", levels)
        object.__setattr__(self, "taps", taps)

    def core(self) -> tuple[int, float, list[tuple[float, float]], list[float]]:
        """As the compiled controller takes it, which checks the numbers."""
        return self.preview, self.late, list(self.levels), list(self.taps)

    def about(self, rest: Rest) -> Feedforward:
        """The same for deviations from a level of command and output."""
        levels = tuple((y - rest.y, u - rest.u[0]) for y, u in self.levels)
        return replace(self, levels=levels)

    def early(self, reference: ArrayLike) -> FloatArray:
        """The reference `preview` samples early; the last value stays."""
        r = vector("reference", reference)
        ahead = np.minimum(np.arange(len(r)) + self.preview, len(r) - 1)
        early: FloatArray = r[ahead]
        return early

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "preview": self.preview, "late": self.late,
            "levels": [{"y": y, "u": u} for y, u in self.levels], "taps": list(self.taps),
        }  # fmt: skip

    @classmethod
    def read(cls, fields: Fields) -> Feedforward:
        """The feedforward in a controller's file."""
        fields.require_only(("preview", "late", "levels", "taps"))
        levels = fields.objects("levels")
        for level in levels:
            level.require_only(("y", "u"))
        return cls(
            preview=fields.integer("preview"), late=fields.number("late"),
            levels=tuple((level.number("y"), level.number("u")) for level in levels),
            taps=tuple(fields.vector("taps").tolist()),
        )  # fmt: skip

    def __str__(self) -> str:
        counts = f"{len(self.levels)} levels, {len(self.taps)} taps"
        return f"{counts}, preview of {self.preview} samples"


def reduced(
    levels: Sequence[tuple[float, float]], most: int = LEVELS, always: float | None = None
) -> list[tuple[float, float]]:
    """The fewest of these levels, at most `most`, that draw the line through all of them. The
    output `always` stays if it is among them. One level after another is added where the line is
    farthest off, until it is within a thousandth of the commands' range.
    """
    if len(levels) < 3:
        return list(levels)
    y, u = np.array(levels).T
    kept = sorted({0, len(levels) - 1, *np.flatnonzero(y == always).tolist()})
    while len(kept) < most:
        off = np.abs(np.interp(y, y[kept], u[kept]) - u)
        worst = int(off.argmax())
        if off[worst] <= 1e-3 * np.ptp(u):
            break
        kept = sorted([*kept, worst])
    return [levels[k] for k in kept]
