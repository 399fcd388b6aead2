"""SAGE's folder of a motion of a robot: commands and states of all joints -> `Table`.

Format: `docs/LEROBOT_REAL.md` of the repository isaac-sim2real/sage. Time stamps are in
microseconds, positions in rad; a cell has one number for each joint.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..arrays import FloatArray
from ..errors import DataError
from ..storage import file_bytes
from .containers import Table, label
from .logs import Signal, joined

_FILES = {"control.csv": ("positions",), "state_motor.csv": ("positions", "velocities", "torques")}
_UNITS = {"positions": "rad", "velocities": "rad/s", "torques": ""}
_NAMES = "joint_list.txt"


def read_folder(path: Path) -> Table:
    """The columns `control.positions.JOINT`, `state_motor.positions.JOINT` and so on."""
    if missing := [name for name in _FILES if not (path / name).is_file()]:
        raise DataError(
            name=str(path), expected="a file, or a folder of SAGE with control.csv and "
            "state_motor.csv", received=f"a folder without {missing[0]}", remedy="name a file",
        )  # fmt: skip
    names = []
    if (path / _NAMES).is_file():
        names = [label(n) for n in file_bytes(path / _NAMES).decode("utf-8", "replace").split()]
    signals = []
    for file, fields in _FILES.items():
        stamps, arrays = _rows(path / file, fields)
        for field, array in zip(fields, arrays, strict=True):
            names = names or [f"joint{k}" for k in range(array.shape[1])]
            if array.shape[1] != len(names):
                raise DataError(
                    name=str(path / file), expected=f"{len(names)} numbers in a cell of {field}",
                    received=f"{array.shape[1]}", remedy=f"one for each joint of {_NAMES}",
                )  # fmt: skip
            for joint, column in zip(names, array.T, strict=True):
                name = f"{Path(file).stem}.{field}.{joint}"
                signals.append(Signal(name, 1e-6 * stamps, column, _UNITS[field]))
    return joined(path, signals, "a folder of SAGE")


def _rows(path: Path, fields: Sequence[str]) -> tuple[FloatArray, list[FloatArray]]:
    """Time stamps (N,) and the fields, each (N, joints)."""
    text = file_bytes(path).decode("utf-8", "replace")
    stamps: list[float] = []
    cells: list[list[list[float]]] = [[] for _ in fields]
    rows = csv.DictReader(io.StringIO(text))
    try:
        for row in rows:
            stamps.append(float(row["timestamp"]))
            for of, field in zip(cells, fields, strict=True):
                of.append(json.loads(row[field]))
        return np.array(stamps), [np.array(of, dtype=np.float64, ndmin=2) for of in cells]
    except (KeyError, TypeError, ValueError, csv.Error, RecursionError) as e:
        raise DataError(
            name=f"{path}, line {rows.line_num}",
            expected=f"a time stamp and a list of numbers as {', '.join(fields)}",
            received=f"another content ({type(e).__name__})",
            remedy="a torn last line can be deleted",
        ) from e
