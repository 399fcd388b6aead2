"""`Profile`: a run's values as the device stores them, uploaded ahead of it piece by piece."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError
from . import wire
from .wire import Channel, Limits

COMMANDS: Literal[0] = 0
REFERENCES: Literal[1] = 1
_DTYPES: dict[int, str] = {COMMANDS: "<i2", REFERENCES: "<f4"}


class Profile:
    """Values in the device's steps, and how far they have been uploaded.

    Parameters
    ----------
    table : 0 or 1
        Commands in steps of channel `u`, or references as f32.
    values : array, shape (N,)
    """

    def __init__(self, table: Literal[0, 1], values: NDArray[Any]) -> None:
        self.table = table
        self.values = np.ascontiguousarray(values, dtype=_DTYPES[table])
        self.per_frame = (wire.MAX_BODY - 5) // self.values.itemsize
        self.end = 0

    @property
    def is_whole(self) -> bool:
        """Whether the device has all of it."""
        return self.end >= len(self.values)

    def piece(self, room: int) -> bytes | None:
        """Body of the next UPLOAD where a full frame, or the rest, has room; None where not."""
        count = min(self.per_frame, len(self.values) - self.end)
        if count <= 0 or room < count:
            return None
        part = self.values[self.end : self.end + count]
        return wire.upload(self.table, self.end, part.tobytes())

    def answered(self, reply: wire.Reply) -> None:
        """Take the reply to an UPLOAD: its end, or where the device wants to go on.

        Raises
        ------
        LinkError
            Where the device refuses the values.
        """
        if reply.result == 9:
            self.end = min(reply.detail, len(self.values))
        elif reply.result not in (4, 7):
            # no room yet, or the run has ended: neither is an error of the values
            self.end = wire.uploaded(reply.checked())[0]


def commands(values: NDArray[np.float64], u: Channel, limits: Limits) -> Profile:
    """Commands rounded to the device's steps.

    Raises
    ------
    SettingError
        Where one is beyond the volt limit.
    """
    limit = min(limits.volt, 32_767 / u.steps_per_unit)
    _require_within("commands", values, limit, u.unit)
    top = np.floor(np.float32(limit) * u.steps_per_unit)
    return Profile(COMMANDS, np.clip(np.rint(values * u.steps_per_unit), -top, top))


def references(values: NDArray[np.float64], limits: Limits) -> Profile:
    """References as the device stores them.

    Raises
    ------
    SettingError
        Where one is beyond the speed limit.
    """
    limit = min(limits.speed_rpm, wire.LARGEST)
    _require_within("references", values, limit, "RPM")
    return Profile(REFERENCES, np.clip(values, -limit, limit))


def _require_within(name: str, values: NDArray[np.float64], limit: float, unit: str) -> None:
    beyond = np.flatnonzero(np.abs(values) > limit * (1.0 + 1e-6))
    if len(beyond):
        k = int(beyond[0])
        raise SettingError(
            f"expected {name} within +-{limit:g} {unit}, got {values[k]:g} at sample {k} and "
            f"{len(beyond)} beyond in all; scale the signal or raise the limit (set_limits)"
        )
