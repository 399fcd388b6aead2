"""The sample time of a table: from its time column, from the caller, or agreed between both."""

from __future__ import annotations

import math

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError, SettingError
from .table import Table

TOLERANCE = 0.01
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}


def sample_time(table: Table, given: float | None, column: str | None = None) -> float:
    """Sample time [s] from column `t` or `time`, checked against `given`, which wins.

    Parameters
    ----------
    table : Table
    given : float or None
        Sample time [s] by the caller.
    column : str or None
        Name of the time column; found by its name (`t` or `time`) where None.

    Raises
    ------
    DataError
        Where the time is not even to 1 % of the period, or disagrees with `given` by more.
    SettingError
        Where there is neither a time column nor a sample time.
    """
    if given is not None and not (math.isfinite(given) and given > 0):
        raise SettingError(f"Ts: expected a positive sample time in seconds, received {given}")
    if table.Ts is not None and column is None:
        return table.Ts if given is None else _agreed(table, "the header", table.Ts, given)
    name = table.resolve(column) if column is not None else _find(table)
    if name is None:
        if given is None:
            raise SettingError(
                f"{table.path}: no column t or time; state the sample time in seconds (Ts, --ts)"
            )
        return float(given)
    found = _even_period(table, name)
    return found if given is None else _agreed(table, f"column {name!r}", found, given)


def _agreed(table: Table, source: str, found: float, given: float) -> float:
    if abs(found - given) > TOLERANCE * given:
        raise DataError(
            f"{table.path}: {source} says Ts = {found:.6g} s, but {given:.6g} s was given; "
            "they must agree within 1 %"
        )
    return float(given)


def _find(table: Table) -> str | None:
    return next((n for n in table.names if n.lower() in ("t", "time")), None)


def _even_period(table: Table, name: str) -> float:
    unit = table.unit(name)
    if unit.lower() not in _SECONDS:
        raise DataError(f"{table.path}: time in {unit!r} is not understood; expected s, ms or us")
    t = table[name]
    if len(t) < 2:
        raise DataError(
            f"{table.path}: column {name!r}: expected at least 2 samples, received {len(t)}"
        )
    _require_finite(table, name, t)
    return _SECONDS[unit.lower()] * _period(table, name, t)


def _require_finite(table: Table, name: str, t: FloatArray) -> None:
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise DataError(
            f"{table.path}: column {name!r}: expected a time in every row, received {t[bad[0]]} at "
            f"{table.row(int(bad[0]))}"
        )


def _period(table: Table, name: str, t: FloatArray) -> float:
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        k = int(back[0]) + 1
        raise DataError(
            f"{table.path}: column {name!r}: expected increasing time, received {t[k]:.9g} after "
            f"{t[k - 1]:.9g} at {table.row(k)}; sort the rows or split the recording"
        )
    period = float(np.median(steps))
    off = np.abs(steps - period)
    if off.max() > TOLERANCE * period:
        k = int(np.argmax(off > TOLERANCE * period)) + 1
        raise DataError(
            f"{table.path}: column {name!r}: expected even steps of {period:.6g} within 1 %, "
            f"received {steps[k - 1]:.6g} at {table.row(k)}; resample, or leave the "
            "column out and state Ts"
        )
    # the mean is exact where every printed time is rounded
    return float((t[-1] - t[0]) / len(steps))
