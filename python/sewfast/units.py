"""Units of angular speed and the encoder's resolution in each."""

from __future__ import annotations

import math

from .errors import SettingError

#: Revolutions per second that one of each unit stands for.
REVOLUTIONS_PER_SECOND: dict[str, float] = {
    "rpm": 1.0 / 60.0,
    "rev/s": 1.0,
    "rad/s": 1.0 / math.tau,
    "deg/s": 1.0 / 360.0,
}


def counts_per_unit(counts_per_rev: float, unit: str = "rpm") -> float:
    """Encoder counts that pass in one second at a speed of one ``unit``.

    A change of ``n`` counts in ``Ts`` seconds is a speed of ``n / (Ts * counts_per_unit)``.
    With 1,572 counts/rev and 1 ms one count is 38.168 RPM.

    Parameters
    ----------
    counts_per_rev
        Counts per revolution [counts/rev], above zero.
    unit
        One of ``rpm``, ``rev/s``, ``rad/s``, ``deg/s``; capitals do not matter.

    Returns
    -------
    float
        Counts per (unit x second).

    Raises
    ------
    SettingError
        For a resolution that is not finite and above zero, or an unknown unit.

    Examples
    --------
    >>> round(1 / (0.001 * counts_per_unit(1572, "rpm")), 3)
    38.168
    """
    if not (math.isfinite(counts_per_rev) and counts_per_rev > 0):
        raise SettingError(
            f"expected counts_per_rev finite and above 0, got {counts_per_rev}; "
            "give the encoder's counts per revolution after its 4-fold evaluation"
        )
    factor = REVOLUTIONS_PER_SECOND.get(unit.lower())
    if factor is None:
        raise SettingError(
            f"expected a speed unit out of {', '.join(REVOLUTIONS_PER_SECOND)}, got {unit!r}; "
            "convert the speed to one of them"
        )
    return counts_per_rev * factor
