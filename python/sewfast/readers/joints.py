"""Command and position of each joint of a robot, from one record.

Readers give a column to each element of an array of joints, `field.JOINT` (`containers.label`);
`roles.joint_columns` knows which are those of a joint.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from ..dataset import Dataset
from ..errors import SettingError
from ..units import is_position, radians, spelled
from .containers import Table, freeze
from .recording import read_columns, read_table
from .roles import joint_columns

_EPISODE = "episode_index"


def columns_of(table: Table, joint: str) -> tuple[str, str]:
    """Columns of command and position of one joint; raises `SettingError` for an unknown one."""
    found = joint_columns(table)
    if joint not in found:
        raise SettingError(
            name="joint", expected=f"one of {', '.join(found)}" if found else
            "columns of a joint's command and position, such as elbow.command, elbow.position",
            received=repr(joint) if found else f"{table.path} with {', '.join(table.names[:20])}",
            remedy="choose one of them" if found else "name both columns: --input, --output",
        )  # fmt: skip
    return found[joint]


def read_joints(
    path: Any, *, joints: Sequence[str] = (), unit: str = "", Ts: float | None = None
) -> dict[str, Dataset]:
    """Position command and position of each joint of a robot's record.

    Parameters
    ----------
    path : path or table, or a sequence of them
        A SAGE folder (`control.csv`, `state_motor.csv`), LeRobot's Parquet episodes, MCAP or ROS
        bags with `JointState` and a commanded position, or any table whose columns are named
        `JOINT.command` and `JOINT.position`, in either order. Of several records each is an
        experiment, and so is each episode.
    joints : sequence of str
        Names of the wanted joints; all by default.
    unit : str
        Unit of command and position, if the file has none: rad, deg, rev, m, mm, counts.
    Ts : float, optional
        Sample time [s], as for `read`.

    Returns
    -------
    dict of Dataset by name
        Input: position command, output: position. `physics` takes all of them.

    Raises
    ------
    DataError
        If a file cannot be read, or has no joints.
    SettingError
        For a joint or unit that there is none of.

    Notes
    -----
    SAGE states rad. Messages of ROS are in rad or m by the kind of joint (REP 103), which they do
    not state; LeRobot's are in degrees or in percent of a range.
    """
    if unit != "" and not (isinstance(unit, str) and is_position(unit)):
        raise SettingError(
            name="unit", expected="an angle or a length: rad, deg, rev, m, mm, counts",
            received=repr(unit), remedy="name the unit of command and position",
        )  # fmt: skip
    if isinstance(joints, str):
        joints = (joints,)
    several = isinstance(path, Sequence) and not isinstance(path, str)
    if several and not len(path):
        raise SettingError(name="path", expected="one record or more", received="none")
    tables = [p if isinstance(p, Table) else read_table(p) for p in (path if several else [path])]
    names = list(joints or joint_columns(tables[0])) or [""]
    return {
        name: Dataset.concat([_dataset(part, name, unit, Ts) for t in tables for part in _parts(t)])
        for name in names
    }


def _dataset(table: Table, joint: str, unit: str, Ts: float | None) -> Dataset:
    table, command, position = of_joint(table, joint, unit)
    return read_columns(table, inputs=command, output=position, Ts=Ts)


def of_joint(table: Table, joint: str, unit: str = "") -> tuple[Table, str, str]:
    """The table with `unit` where it states none, and the joint's columns of command and position.
    Raises `SettingError` for an unknown joint, and for units that do not go together.
    """
    command, position = columns_of(table, joint)
    given, known = (table.unit(name) or unit for name in (command, position))
    other = [stated for stated in (given, known) if unit and spelled(stated) != spelled(unit)]
    kinds = {radians(u) is None for u in (given, known) if is_position(u)}
    if other or len(kinds) > 1:
        raise SettingError(
            name="unit", expected="one that command and position of a joint share",
            received=f"{unit} beside {other[0]} in the file" if other else f"{given} and {known}",
            remedy="leave it out" if other else "name the columns of one joint",
        )  # fmt: skip
    units = {name: u for name, u in ((command, given), (position, known)) if u}
    return replace(table, units={**table.units, **units}), command, position


def _parts(table: Table) -> Iterator[Table]:
    """The episodes of a table; time begins anew in each."""
    if _EPISODE not in table:
        yield table
        return
    of = table[_EPISODE]
    for number in dict.fromkeys(of.tolist()):
        columns = {n: freeze(c[of == number]) for n, c in table.columns.items() if n != _EPISODE}
        path = table.path.with_name(f"{table.path.name} episode {number:g}")
        yield replace(table, path=path, columns=columns, lines=None)
