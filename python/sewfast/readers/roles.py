"""Which column of a table is the input and which the output, by their names and units."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..dataset import is_reference
from .containers import Table, unit_in_name
from .timebase import time_column

_COMMAND = re.compile(
    r"u|in|input|command|cmd|pwm|duty|volt(s|age)?|spannung|motor_?voltage|v_?motor"
)
_CURRENT = re.compile(r"i|curr(ent)?|strom|amps?|i_?motor|motor_?current")
_MEASURED = re.compile(
    r"y|out|output|speed|rpm|velocity|vel|omega|drehzahl|position|pos|angle|theta|winkel|temperature"
)
_COMMAND_UNITS = frozenset({"v", "mv", "volt", "volts"})
_CURRENT_UNITS = frozenset({"a", "ma", "amp", "ampere"})
_SPEEDS = ("rpm", "1/min", "rev/s", "rad/s", "deg/s", "°/s", "m/s", "mm/s")
_MEASURED_UNITS = frozenset((*_SPEEDS, "rad", "deg", "°", "rev", "m", "mm", "°c", "degc"))


@dataclass(frozen=True)
class Roles:
    """Input and output of a table, as its names and units show them."""

    input: str
    output: str


def roles(table: Table) -> Roles | None:
    """Input and output of a table; None where its names and units leave a doubt.

    Time, references and columns that never change are neither. The plain names `u` and `y` come
    first, then a voltage or a command (a current only where there is no voltage) as input and a
    speed, a position or a temperature as output. Where one of the two is known and one column is
    left, that is the other.
    """
    time = time_column(table)
    length = max((len(table[name]) for name in table.names), default=0)
    left = [
        name for name in table.names
        if name != time and len(table[name]) == length and _moves(table, name)
        and not is_reference(name) and _stem(name) != "speed_true"
    ]  # fmt: skip
    given = (
        _only(left, lambda n: n == "u")
        or _only(left, lambda n: _is(table, n, _COMMAND, _COMMAND_UNITS))
        or _only(left, lambda n: _is(table, n, _CURRENT, _CURRENT_UNITS))
    )
    found = _only(left, lambda n: n == "y") or _only(
        left, lambda n: _is(table, n, _MEASURED, _MEASURED_UNITS)
    )
    if len(left) == 2 and (given is None) != (found is None):
        (other,) = (name for name in left if name not in (given, found))
        given, found = given or other, found or other
    if given is None or found is None or given == found:
        return None
    return Roles(given, found)


def _moves(table: Table, name: str) -> bool:
    known = table[name][np.isfinite(table[name])]
    return len(known) > 0 and bool(known.min() < known.max())


def _stem(name: str) -> str:
    """A name in lower case, without the unit that it ends with."""
    return unit_in_name(name)[0].lower()


def _is(table: Table, name: str, words: re.Pattern[str], units: frozenset[str]) -> bool:
    unit = table.unit(name).lower()
    return unit in units if unit else words.fullmatch(_stem(name)) is not None


def _only(names: list[str], holds: Callable[[str], bool]) -> str | None:
    fitting = [name for name in names if holds(name)]
    return fitting[0] if len(fitting) == 1 else None
