"""`Recording`: command, counts and speed of one run, as columns."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray
from .dataset import Dataset
from .errors import DataError
from .gains import vector
from .recordfile import Header, save_columns
from .recordfile.writer import require_replaceable
from .speed import Method, speed_from_counts
from .storage import write_table

UNITS: Mapping[str, str] = {"t": "s", "u": "V", "y": "RPM", "speed_true": "RPM"}
"""Units of the columns; counts have none."""


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
    speed_true : array, shape (N,), or None
        The virtual machine's true speed [RPM], for scores only; None for a real machine.
    Ts, counts_per_rev : float
        Sample time [s], counts of one turn.
    name : str
        Name of the excitation.

    Notes
    -----
    Samples lost on the link to a drive are NaN in every column.
    """

    u: FloatArray
    counts: FloatArray
    y: FloatArray
    speed_true: FloatArray | None
    Ts: float
    counts_per_rev: float
    name: str

    @classmethod
    def of_counts(
        cls,
        u: ArrayLike,
        counts: ArrayLike,
        *,
        Ts: float,
        counts_per_rev: float,
        name: str = "recording",
        speed_true: FloatArray | None = None,
        method: Method = "kalman",
    ) -> Recording:
        """A recording from logged commands and counts, one of each per sample.

        Parameters
        ----------
        u : array, shape (N,)
            Command [V], held from sample k to k + 1.
        counts : array, shape (N,)
            Accumulated encoder counts, read before `u[k]` acts; the first is subtracted.
        Ts, counts_per_rev : float
            Sample time [s], counts of one turn.
        name : str
            Name of the excitation.
        speed_true : array, shape (N,), optional
            As in the class.
        method : "kalman", "savgol" or "difference"
            Method of the speed estimate (`speed_from_counts`).

        Raises
        ------
        DataError
            For commands and counts of different lengths, values that are not finite, or too few.
        """
        command, seen = vector("u", u).copy(), vector("counts", counts).copy()
        if command.shape != seen.shape:
            raise DataError(
                name="counts", expected=f"one for each command, shape {command.shape}",
                received=f"shape {seen.shape}", remedy="log both at every sample",
            )  # fmt: skip
        require_finite("command", command)
        require_finite("counts", seen)
        seen -= seen[:1]
        y = speed_from_counts(seen, Ts, counts_per_rev, method=method)
        return cls(command, seen, y, speed_true, Ts, counts_per_rev, name)

    def __len__(self) -> int:
        return len(self.u)

    def columns(self) -> dict[str, FloatArray]:
        """t, u, counts, y and, if known, speed_true by name, as in a recording file."""
        t = np.arange(len(self), dtype=np.float64) * self.Ts
        known = {} if self.speed_true is None else {"speed_true": self.speed_true}
        return {"t": t, "u": self.u, "counts": self.counts, "y": self.y, **known}

    def speed(self, method: Method) -> FloatArray:
        """The speed [RPM] estimated from the counts by another method, shape (N,)."""
        return speed_from_counts(self.counts, self.Ts, self.counts_per_rev, method=method)

    def dataset(self, y: ArrayLike | None = None) -> Dataset:
        """Command and speed for `identify`; a true speed is added as the channel `speed_true`.

        Parameters
        ----------
        y : array, shape (N,), optional
            Another estimate of the speed [RPM].
        """
        data = Dataset.from_arrays(
            self.u,
            self.y if y is None else y,
            self.Ts,
            input_units="V",
            output_unit="RPM",
            name=self.name,
            channels={} if self.speed_true is None else {"speed_true": self.speed_true},
        )
        return replace(data, looks_ahead=y is None)

    def header(self, *, device: Mapping[str, Any] | None = None, **settings: Any) -> Header:
        """The header of its file.

        Parameters
        ----------
        device : mapping, optional
            The device recorded; the virtual machine by default.
        **settings
            Settings needed to repeat the recording.
        """
        return Header(
            self.name,
            self.Ts,
            {name: UNITS.get(name, "1") for name in self.columns() if name != "t"},
            len(self),
            self.counts_per_rev,
            {"kind": "virtual"} if device is None else device,
            settings,
        )

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the columns as CSV, `.npz`, `.mat`, Parquet or MCAP, completely or not at all.

        Parameters
        ----------
        path : path
            An existing file is replaced in one step, except a recording of a drive.
        overwrite : bool
            Whether to replace a recording of a drive as well.

        Raises
        ------
        DataError, SettingError
            As for `sewfast.storage.write_table`.
        """
        require_replaceable(path, overwrite=overwrite)
        if Path(path).suffix.lower() == ".mcap":
            columns = self.columns()
            del columns["t"]
            save_columns(path, self.header(), columns)
            return
        write_table(path, self.columns(), units=UNITS)

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw command and speed over time, and their spectra: `Dataset.plot`."""
        return self.dataset().plot(ax, file=file)

    def _repr_html_(self) -> str:
        return self.dataset()._repr_html_()

    def __repr__(self) -> str:
        return f"Recording({self.name!r}, {len(self)} samples, Ts={self.Ts:g} s)"


def require_finite(name: str, values: FloatArray) -> None:
    """Refuse NaN and infinity with a `DataError`."""
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise DataError(
            name=name, expected="finite numbers",
            received=f"{len(bad)} of {len(values)} that are not, the first at {bad[0]}",
            remedy="mend the signal",
        )  # fmt: skip
