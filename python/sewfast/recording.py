"""`Recording`: what an excitation did on a machine, column by column; `record` makes one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .dataset import Dataset
from .errors import DataError
from .machine import VirtualMachine
from .recordfile import Header, save_columns
from .speed import Method, speed_from_counts
from .writers import write_table

FloatArray = NDArray[np.float64]

UNITS: Mapping[str, str] = {"t": "s", "u": "V", "y": "RPM", "speed_true": "RPM"}
"""Of the columns; counts are pure numbers."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Command, encoder counts and speed of one run from rest.

    Attributes
    ----------
    u : array, shape (N,)
        Command [V], held from sample k to k + 1.
    counts : array, shape (N,)
        Encoder counts, read before `u[k]` acts.
    y : array, shape (N,)
        Speed [RPM] estimated from the counts.
    speed_true : array, shape (N,)
        The virtual machine's true speed [RPM], for scores only.
    Ts, counts_per_rev : float
        Sample time [s], counts of one turn.
    name : str
        Of the excitation.
    """

    u: FloatArray
    counts: FloatArray
    y: FloatArray
    speed_true: FloatArray
    Ts: float
    counts_per_rev: float
    name: str

    def __len__(self) -> int:
        return len(self.u)

    def columns(self) -> dict[str, FloatArray]:
        """t, u, counts, y and speed_true by name, as in a recording file."""
        return {
            "t": np.arange(len(self), dtype=np.float64) * self.Ts,
            "u": self.u,
            "counts": self.counts,
            "y": self.y,
            "speed_true": self.speed_true,
        }

    def speed(self, method: Method) -> FloatArray:
        """The speed [RPM] estimated from the counts by another method, shape (N,)."""
        return speed_from_counts(self.counts, self.Ts, self.counts_per_rev, method=method)

    def dataset(self, y: ArrayLike | None = None) -> Dataset:
        """Command and speed for `identify`; the true speed rides along as channel `speed_true`.

        Parameters
        ----------
        y : array, shape (N,), optional
            Another estimate of the speed [RPM].
        """
        return Dataset.from_arrays(
            self.u,
            self.y if y is None else y,
            self.Ts,
            input_units="V",
            output_unit="RPM",
            name=self.name,
            channels={"speed_true": self.speed_true},
        )

    def header(self, **settings: Any) -> Header:
        """What its file says of it; `settings` are what is needed to record it again."""
        return Header(
            self.name,
            self.Ts,
            {name: UNITS.get(name, "1") for name in self.columns() if name != "t"},
            len(self),
            self.counts_per_rev,
            {"kind": "virtual"},
            settings,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the columns as CSV, `.npz`, `.mat`, Parquet or MCAP, whole or not at all.

        Raises
        ------
        DataError, SettingError
            As for `sewfast.writers.write_table`.
        """
        if Path(path).suffix.lower() == ".mcap":
            columns = self.columns()
            del columns["t"]
            save_columns(path, self.header(), columns)
            return
        write_table(path, self.columns(), units=UNITS)

    def __repr__(self) -> str:
        return f"Recording({self.name!r}, {len(self)} samples, Ts={self.Ts:g} s)"


def record(
    machine: VirtualMachine, u: ArrayLike, *, name: str = "array", method: Method = "kalman"
) -> Recording:
    """Excite a machine from rest and record it.

    Parameters
    ----------
    machine : VirtualMachine
        Reset first, and left where the run ends.
    u : array, shape (N,)
        Command [V] at the machine's sample time; see `sewfast.signals.excitation`.
    name : str
        Of the excitation, for messages and files.
    method : "kalman", "savgol" or "difference"
        How the speed is estimated from the counts.

    Returns
    -------
    Recording
        The command as given: beyond its limit the machine clips it.

    Raises
    ------
    DataError
        Where `u` is not one-dimensional and finite, or too short for a speed.
    """
    command = np.array(u, dtype=np.float64)
    if command.ndim != 1:
        raise DataError(
            f"expected an excitation of shape (N,), received {command.shape}; pass one column"
        )
    machine.reset()
    run = machine.run(command)
    y = speed_from_counts(run.counts, machine.Ts, machine.counts_per_rev, method=method)
    return Recording(
        command, run.counts, y, run.speed_rpm, machine.Ts, machine.counts_per_rev, name
    )
