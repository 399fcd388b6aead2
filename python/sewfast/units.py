"""Units in their usual spellings: one table of spellings, and units in a column's name.

A unit is kept as written; this module is only used to compare and convert units.
"""

from __future__ import annotations

import math
import re

from .errors import SettingError

# --- Units of angular speed and the encoder's resolution in each ----------------------------------


REVOLUTIONS_PER_SECOND: dict[str, float] = {
    "rpm": 1.0 / 60.0,
    "rev/s": 1.0,
    "rad/s": 1.0 / math.tau,
    "deg/s": 1.0 / 360.0,
}
"""Factor from each unit to revolutions per second."""
_WRITTEN = {
    "rpm": "r/min rev/min 1/min min-1 min^-1 min⁻¹ u/min upm tr/min",
    "rev/s": "rps 1/s turn/s turns/s",
    "rad/s": "rad/sec",
    "deg/s": "°/s deg/sec",
    "v": "volt volts",
    "a": "amp amps ampere amperes",
    "s": "sec second seconds",
    "%": "percent pct",
    "deg": "° degree degrees",
    "rad": "radian radians",
    "°c": "degc celsius",
    "counts": "count",
}
"""Other spellings of a unit, in lower case; `u` is German for turns, `tr` French."""
_SPELLINGS = {other: unit for unit, others in _WRITTEN.items() for other in others.split()}
ANGULAR_SPEEDS = frozenset(REVOLUTIONS_PER_SECOND) | frozenset(
    other for other, unit in _SPELLINGS.items() if unit in REVOLUTIONS_PER_SECOND
)
SPEEDS = ANGULAR_SPEEDS | frozenset(["m/s", "cm/s", "mm/s", "m/min", "km/h"])


def spelled(unit: str) -> str:
    """A unit in lower case and in the package's spelling: "U/min" becomes "rpm"."""
    key = unit.strip().lower()
    return _SPELLINGS.get(key, key)


def revolutions_per_second(unit: str) -> float | None:
    """Factor from `unit` to revolutions per second; None if it is no angular speed."""
    return REVOLUTIONS_PER_SECOND.get(spelled(unit))


ANGLES: dict[str, float] = {
    "rad": 1.0, "deg": math.pi / 180.0, "rev": math.tau, "turn": math.tau,
    "turns": math.tau, "mrad": 1e-3,
}  # fmt: skip
"""Factor from each unit of an angle to rad."""
LENGTHS = frozenset(["m", "cm", "mm", "um", "µm"])


def radians(unit: str) -> float | None:
    """Factor from a unit of an angle to rad; None for any other unit."""
    return ANGLES.get(spelled(unit))


def is_position(unit: str) -> bool:
    """Whether it is a unit of an angle or a length, or counts of an encoder."""
    return radians(unit) is not None or spelled(unit) in LENGTHS or spelled(unit) == "counts"


def position_unit(text: str) -> str:
    """The unit of a position on a shaft in the package's spelling.

    Raises
    ------
    SettingError
        For a unit that is no angle and not counts.
    """
    unit = spelled(text)
    if unit == "counts" or unit in ANGLES:
        return unit
    raise SettingError(
        name="unit", expected="deg, rad, turns or counts", received=repr(text),
        remedy="write a number with a point and one of these, as in '90.5deg'; convert lengths by "
        "the lead or radius",
    )  # fmt: skip


def counts_of(value: float, unit: str, counts_per_rev: float) -> float:
    """A position on a shaft in counts, from a unit of `position_unit`."""
    return value if unit == "counts" else value * ANGLES[unit] / math.tau * counts_per_rev


def counts_per_unit(counts_per_rev: float, unit: str = "rpm") -> float:
    """Encoder counts per second at a speed of one ``unit`` (``rpm``, ``rev/s``, ``rad/s`` or
    ``deg/s``, in any usual spelling) [counts/(unit s)]. A change of ``n`` counts in ``Ts`` seconds
    is a speed of ``n / (Ts * counts_per_unit)``. With 1,572 counts/rev and 1 ms one count is 38.168
    RPM.
    """
    if not (math.isfinite(counts_per_rev) and counts_per_rev > 0):
        raise SettingError(
            f"expected counts_per_rev finite and above 0, got {counts_per_rev}; "
            "give the encoder's counts per revolution after its 4-fold evaluation"
        )
    factor = revolutions_per_second(unit)
    if factor is None:
        raise SettingError(
            f"expected a speed unit out of {', '.join(REVOLUTIONS_PER_SECOND)}, got {unit!r}; "
            "convert the speed to one of them"
        )
    return counts_per_rev * factor


# --- Times as text --------------------------------------------------------------------------------


def time_unit(seconds: float) -> tuple[float, str]:
    """The unit that suits a time, as a factor from seconds and its name: ms below a second, s below
    ten minutes, min below three hours, h above.
    """
    if not 1.0 <= abs(seconds) < math.inf:
        return 1e3, "ms"
    if abs(seconds) < 600.0:
        return 1.0, "s"
    return (1.0 / 60.0, "min") if abs(seconds) < 10800.0 else (1.0 / 3600.0, "h")


def duration(seconds: float, digits: int = 4) -> str:
    """A time [s] in the unit that suits it, such as '49.4 ms' for 0.0494."""
    factor, unit = time_unit(seconds)
    return f"{factor * seconds:.{digits}g} {unit}"


# --- Units in the names of columns ----------------------------------------------------------------


_UNITS = SPEEDS | frozenset(
    re.split(
        " ",
        "s sec second seconds ms us µs ns min v volt volts mv a amp ampere amperes ma rev "
        "rad deg ° nm n m cm mm w hz khz % °c degc counts counts/s kgf bar kpa",
    )
)
"""Units that are written behind or below a name, in lower case."""
_STATISTIC = re.compile(r"(?:^|\s+)(?:rms|avg|mean|max|min|peak|pk|pp)$", re.IGNORECASE)
"""What a number between brackets is of several samples; `[V rms]` is in V."""
_TIMES = re.compile(r"t|.*(?:time|zeit|elapsed|stamp|temps|tiempo|tempo).*", re.IGNORECASE)
"""Names of times, whose `[min]` are minutes and no least value."""
_BEFORE_UNIT = re.compile(r"\s+in\s+|\s*/\s*|\s*,\s+")


def split_unit(header: str) -> tuple[str, str]:
    """`u [V]`, `u (V)`, `u, V`, `u in V` or `u / V` -> `("u", "V")`; no unit gives an empty one."""
    match = re.fullmatch(r"\s*(\S.*?)[\s/]*(?:\[([^\]]*)\]|\(([^)]*)\))\s*", header)
    if match is not None:
        unit = (match[2] or match[3] or "").strip()
        minutes = unit.lower() == "min" and _TIMES.fullmatch(match[1]) is not None
        return match[1], unit if minutes else _STATISTIC.sub("", unit).strip()
    text = header.strip()
    if is_unit(text):
        return text, ""
    ends, known = unit_in_name(text)
    for between in _BEFORE_UNIT.finditer(text):
        name, unit = text[: between.start()], text[between.end() :]
        # `speed m/s` and `speed_rad/s` end with a unit of speed; they are no `speed m` in seconds
        if name and is_unit(unit) and not (known and len(name) > len(ends)):
            return name, unit
    return text, ""


def is_unit(text: str) -> bool:
    return text.strip().lower() in _UNITS


_SUFFIX = {
    "V": "V", "mV": "mV", "A": "A", "mA": "mA", "rpm": "RPM", "RPM": "RPM", "radps": "rad/s",
    "rad_s": "rad/s", "degps": "deg/s", "deg_s": "deg/s", "deg": "deg", "rad": "rad", "Nm": "Nm",
    "mm": "mm", "Hz": "Hz", "rad_per_s": "rad/s", "deg_per_s": "deg/s", "m_s": "m/s",
    "mm_s": "mm/s", "m_per_s": "m/s", "mm_per_s": "mm/s", "mps": "m/s", "percent": "%", "pct": "%",
    "%": "%", "volt": "V", "volts": "V", "degC": "degC", "degc": "degC", "celsius": "degC",
    "kelvin": "K", "bar": "bar", "mbar": "mbar", "kPa": "kPa", "hPa": "hPa", "psi": "psi",
    "mNm": "mNm", "kW": "kW", "cm": "cm", "m3h": "m³/h", "m3_h": "m³/h", "l_min": "l/min",
}  # fmt: skip
_SUFFIXED = re.compile(rf"(.+)[_ ]({'|'.join(sorted(_SUFFIX, key=len, reverse=True))})")
_SPEED_SUFFIX = re.compile(rf"(.+?)[_ ]({'|'.join(map(re.escape, sorted(SPEEDS, key=len)))})")
_LETTERS = {"A": "A", "C": "degC", "K": "K", "m": "m", "N": "N", "W": "W"}
_LETTERED = re.compile(
    r"((?i:(?:motor_?)?(?:i|curr(?:ent)?|strom|amps?)|i_?motor))[_ ](A)"
    r"|((?:.*[_ ])?(?i:t|temp|temperature|temperatur))(?:[_ ]?\d+)?[_ ]([CK])"
    r"|((?:.*[_ ])?(?i:position|weg|stroke|travel|height|altitude|level))[_ ](m)"
    r"|((?:.*[_ ])?(?i:force|kraft|thrust|schub))[_ ](N)"
    r"|((?:.*[_ ])?(?i:power|leistung|heat|heater|heating|heizung))[_ ](W)"
)
"""Units of one letter, each behind a word for what it measures."""


def unit_in_name(name: str) -> tuple[str, str]:
    """`speed_rpm` -> `("speed", "RPM")`; a name without a unit at its end gives an empty one.
    Only unambiguous endings count. A lone letter can also be a phase or a channel, so it is a unit
    only behind a word for what it measures (`temp_C`, not `phase_C`).
    """
    if (match := _LETTERED.fullmatch(name)) is not None:
        found, letter = filter(None, match.groups())
        return found, _LETTERS[letter]
    if (match := _SUFFIXED.fullmatch(name)) is not None and match[2] != "A":
        return match[1], _SUFFIX[match[2]]
    if (match := _SPEED_SUFFIX.fullmatch(name.lower())) is not None:
        return name[: match.end(1)], name[match.start(2) :]
    return name, ""
