"""Which column of a table is the input and which the output, by names and units.

The command line, Python, the studio and the fleet all ask here, so that they give one answer.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import FloatArray
from ..dataset import is_reference
from ..errors import DataError
from ..units import SPEEDS, unit_in_name
from .containers import Table
from .timebase import numbers_rows, time_column


@dataclass(frozen=True)
class _Sort:
    """Columns of one sort, recognised by the words in their names or by their units."""

    words: frozenset[str]
    units: frozenset[str]


def _sort(words: str, units: Iterable[str]) -> _Sort:
    return _Sort(frozenset(words.split()), frozenset(units))


_INPUTS = (
    _sort(
        "u in input command cmd pwm duty volt volts voltage spannung tension control throttle "
        "stellgröße stellgroesse commande voltaje tensione heater heating valve heizung ventil",
        ("v", "mv", "volt", "volts"),
    ),
    _sort("i curr current strom amp amps courant", ("a", "ma", "amp", "ampere", "amps")),
    _sort(
        "torque moment drehmoment force kraft power leistung heating feed feeder frequency "
        "frequenz",
        ("nm", "mnm", "w", "kw", "hz"),
    ),
)
_OUTPUTS = (
    _sort(
        "y out output speed rpm velocity vel omega drehzahl geschwindigkeit vitesse tacho tach "
        "position pos angle theta winkel weg altitude height höhe hoehe istwert velocidad velocità",
        (*SPEEDS, "rad", "deg", "°", "rev", "m", "cm", "mm"),
    ),
    _sort(
        "temperature temp temperatur level füllstand fuellstand pressure druck flow durchfluss "
        "thrust schub",
        (
            "°c",
            "degc",
            "k",
            "°f",
            "degf",
            "bar",
            "mbar",
            "pa",
            "hpa",
            "kpa",
            "psi",
            "kgf",
            "m³/h",
            "m3/h",
            "l/min",
        ),
    ),
)
"""The first sort with a column counts; columns of later sorts were logged beside it."""
_SUPPLY = re.compile(r"(battery|batt|bat|vbat|supply|bus|akku|batterie|versorgung)(?![a-z])")
"""Names of a drive's supply, which is not a command."""
_QUALIFIERS = frozenset(
    re.split(
        " ",
        "motor shaft actual act ist meas measured measurement gemessen signal value wert cycle "
        "percent pct raw filt filtered m n w c k",
    )
)
"""Words without meaning for the role of a column."""
_WORD = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+(?![^\W\d_A-Z])")


@dataclass(frozen=True)
class Roles:
    """Input and output of a table, recognised by names and units.
    `input` is the first one where several were named. `output` is None where it is a speed from
    `counts`, the column of encoder counts.
    """

    input: str
    output: str | None
    counts: str | None = None


def roles(
    table: Table,
    *,
    inputs: Sequence[str] = (),
    output: str | None = None,
    counts: str | None = None,
    time: str | None = None,
) -> Roles | None:
    """Input and output of a table; None if its names and units leave any doubt.
    Named columns keep their role; time, references, row numbers, supplies and constant columns have
    none. `u` and `y` come first, then a voltage or command (else a current, else a torque or power)
    as input, a speed or position (else temperature, level, pressure, flow) as output; name and unit
    together beat one alone. The last column takes the last role. Of two columns that names alone
    do not tell apart, the one that is held and steps is the input. Stated counts per turn make
    `counts` the output. Else the position command and the position of a single joint.
    """
    time = time_column(table) if time is None else table.resolve(time)
    named = [table.resolve(name) for name in (*inputs, output, counts) if name is not None]
    if output is None and counts is None and table.counts_per_rev and "counts" in table:
        counts = "counts"
    length = max((len(table[name]) for name in table.names), default=0)
    left = [
        name for name in table.names
        if name not in (time, counts, *named) and len(table[name]) == length
        and _moves(table, name) and not is_reference(name) and _stem(name) != "speed_true"
        and not _SUPPLY.match(_stem(name)) and not numbers_rows(table, name)
    ]  # fmt: skip
    given = table.resolve(inputs[0]) if inputs else _only(left, "u") or _first(table, left, _INPUTS)
    if counts is not None:
        given = given or (left[0] if len(left) == 1 else None)
        return None if given is None else Roles(given, output, table.resolve(counts))
    known = None if output is None else table.resolve(output)
    found = known or _only(left, "y") or _first(table, left, _OUTPUTS)
    rest = [name for name in left if name not in (given, found)]
    if len(left) == 2 and not named and (given is None or found is None or given == found):
        commands = [name for name in left if is_stepped(table[name])]
        if len(commands) == 1:
            left.remove(commands[0])
            return Roles(commands[0], left[0])
    if len(rest) == 1 and (given is None) != (found is None):
        given, found = given or rest[0], found or rest[0]
    if given is not None and found is not None and given != found:
        return Roles(given, found)
    joints = joint_columns(table)
    return Roles(*joints.popitem()[1]) if len(joints) == 1 and not named else None


def recognised(
    table: Table,
    *,
    inputs: Sequence[str] = (),
    output: str | None = None,
    counts: str | None = None,
    time: str | None = None,
) -> Roles:
    """Input and output of a table, as `roles`; `DataError` where they are in doubt."""
    found = roles(table, inputs=inputs, output=output, counts=counts, time=time)
    if found is None and inputs:
        return Roles(inputs[0], None)
    if found is None:
        raise DataError(
            name=str(table.path), expected="columns that show which is the input and which the "
            "output", received=", ".join(table.names), remedy=f"name both{left_out(table)}",
        )  # fmt: skip
    return found


def commands_beside(table: Table, used: Sequence[str], time: str | None = None) -> list[str]:
    """Columns that are not `used` and step as a command does, by themselves: a second input."""
    time = time_column(table) if time is None else table.resolve(time)
    given = table.resolve(used[0])
    found = [
        name for name in table.names
        if name not in (time, *map(table.resolve, used)) and len(table[name]) == len(table[given])
        and _moves(table, name) and not is_reference(name) and is_stepped(table[name])
    ]  # fmt: skip
    return [name for name in found if not _is_scaled(table[name], table[given])]


def _is_scaled(one: FloatArray, other: FloatArray) -> bool:
    """Whether a column is another one in another unit."""
    known = np.isfinite(one) & np.isfinite(other)
    a, b = one[known] - one[known].mean(), other[known] - other[known].mean()
    return bool(abs(a @ b) > 0.999 * np.sqrt((a @ a) * (b @ b)))


def _moves(table: Table, name: str) -> bool:
    known = table[name][np.isfinite(table[name])]
    return len(known) > 0 and bool(known.min() < known.max())


def is_stepped(values: FloatArray) -> bool:
    """Whether a column is held and steps, as a command does: it mostly keeps its value, and moves
    by more than a coarse sensor would.
    """
    known = values[np.isfinite(values)]
    moves = np.abs(np.diff(known))
    moves = moves[moves > 0.0]
    return 0 < 2 * len(moves) < len(known) and bool(np.median(moves) > 0.05 * np.ptp(known))


def _stem(name: str) -> str:
    """A name in lower case, without the unit that it ends with."""
    return unit_in_name(name)[0].lower()


def left_out(table: Table) -> str:
    """The end of a message: columns of the right kind that were ruled out, and why."""
    why = list(table.unusable.values())[:3]
    still = [name for name in table.names if not _moves(table, name)]
    if still:
        why.append(f"no two different numbers in {', '.join(still[:10])}")
    return "".join(f"; {reason}" for reason in why)


def _only(names: list[str], plain: str) -> str | None:
    return plain if plain in names else None


def _first(table: Table, names: list[str], sorts: Sequence[_Sort]) -> str | None:
    """The best column of the first sort that has any; None if several match equally well."""
    for sort in sorts:
        scores = {name: _score(table, name, sort) for name in names}
        best = max(scores.values(), default=0)
        if best:
            fitting = [name for name in names if scores[name] == best]
            return fitting[0] if len(fitting) == 1 else None
    return None


def _score(table: Table, name: str, sort: _Sort) -> int:
    """2 for a column whose name and unit both match the sort, 1 for one match, else 0."""
    words = {word.lower() for word in _WORD.findall(unit_in_name(name)[0])} - _QUALIFIERS
    return (bool(words) and words <= sort.words) + (table.unit(name).lower() in sort.units)


# --- Joints of a robot ---------------------------------------------------------------------------


_COMMAND = frozenset(
    re.split(" ", "action cmd command commanded control desired goal reference setpoint target")
)
_POSITION = frozenset(
    re.split(" ", "actual angle feedback observation pos position positions present q state")
)
_OTHER = frozenset(
    re.split(
        " ",
        "acceleration accelerations current effort err error load speed temperature torque torques "
        "vel velocities velocity voltage",
    )
)
"""Words in names of columns; one of the last sort says that it is no position."""
_ALONE = "joint"
"""Name of a joint in a table that names none."""


def joint_columns(table: Table) -> dict[str, tuple[str, str]]:
    """Columns of the position command and of the position of each joint, by the joint's name.

    A column belongs to the joint that its last part names (`control.positions.Elbow`), or the words
    that say neither command nor position (`left_elbow_cmd`). Only joints with one command and one
    position count; one without a name (`goal`, `present`) if the table has no further columns.
    """
    for parted in (_by_last, _by_words):
        found: dict[str, dict[str, list[str]]] = {}
        for name in table.names:
            joint, rest = parted(name)
            if joint and not joint.isdigit() and (kind := _kind(rest)):
                found.setdefault(joint, {}).setdefault(kind, []).append(name)
        whole = {
            joint: (of["command"][0], of["position"][0]) for joint, of in found.items()
            if len(of.get("command", ())) == 1 == len(of.get("position", ()))
        }  # fmt: skip
        # at most a time beside command and position
        if len(table.names) > 3:
            whole.pop(_ALONE, None)
        if whole:
            return whole
    return {}


def _by_last(name: str) -> tuple[str, Sequence[str]]:
    *rest, joint = re.split(r"[./]", name)
    return (joint, rest) if rest else ("", ())


def _by_words(name: str) -> tuple[str, Sequence[str]]:
    words = [w for w in re.split(r"[./_ ]+", unit_in_name(name)[0]) if w]
    own = [w for w in words if w.lower() not in _COMMAND | _POSITION]
    return "_".join(own) or _ALONE, words


def _kind(parts: Sequence[str]) -> str | None:
    words = {w.lower() for part in parts for w in re.findall("[A-Za-z]+", part)}
    if words & _OTHER:
        return None
    if words & _COMMAND:
        return "command"
    return "position" if words & _POSITION else None
