"""Numbers as a reader likes them: few digits, a unit, a dash where there is none."""

from __future__ import annotations

import math

NONE = "–"
_SPACE = "\N{NO-BREAK SPACE}"


def significant(value: float | None, digits: int = 3) -> str:
    """`digits` significant digits, plain where that is short, else a power of ten."""
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0.0:
        return "0"
    # of the rounded value: 9.996 has two digits before the point
    size = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -3 <= size <= 5:
        mantissa = value / 10.0**size
        text = f"{mantissa:.{digits - 1}f} × 10{_raised(size)}"
        return text.replace("-", "−").replace(" ", _SPACE)
    return f"{value:,.{max(digits - 1 - size, 0)}f}".replace("-", "−")


def rpm(value: float | None) -> str:
    """A speed or its error [RPM]."""
    return NONE if value is None else f"{significant(value)}{_SPACE}RPM"


def volt(value: float | None) -> str:
    """A command or its change [V]."""
    return NONE if value is None else f"{significant(value)}{_SPACE}V"


def percent(value: float | None, digits: int = 2) -> str:
    """A share [%]."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{value:.{digits}f}{_SPACE}%".replace("-", "−")


def milliseconds(value: float | None) -> str:
    """A duration [ms]."""
    return NONE if value is None else f"{value:.0f}{_SPACE}ms"


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
