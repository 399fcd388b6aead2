"""`Recording`: what an excitation did on a machine, column by column; `record` makes one."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray
from .dataset import Dataset
from .errors import DataError, SettingError
from .machine import VirtualMachine
from .recordfile import Header, save_columns
from .recordfile.writer import require_replaceable
from .speed import Method, speed_from_counts, speed_or_nan
from .writers import write_table

if TYPE_CHECKING:
    from .link.drive import Drive
    from .live import Kind


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
    speed_true : array, shape (N,), or None
        The virtual machine's true speed [RPM], for scores only; None where there is no such thing.
    Ts, counts_per_rev : float
        Sample time [s], counts of one turn.
    name : str
        Of the excitation.

    Notes
    -----
    Samples that the link to a drive lost are NaN in every column.
    """

    u: FloatArray
    counts: FloatArray
    y: FloatArray
    speed_true: FloatArray | None
    Ts: float
    counts_per_rev: float
    name: str

    def __len__(self) -> int:
        return len(self.u)

    def columns(self) -> dict[str, FloatArray]:
        """t, u, counts, y and, where known, speed_true by name, as in a recording file."""
        t = np.arange(len(self), dtype=np.float64) * self.Ts
        known = {} if self.speed_true is None else {"speed_true": self.speed_true}
        return {"t": t, "u": self.u, "counts": self.counts, "y": self.y, **known}

    def speed(self, method: Method) -> FloatArray:
        """The speed [RPM] estimated from the counts by another method, shape (N,)."""
        return speed_from_counts(self.counts, self.Ts, self.counts_per_rev, method=method)

    def dataset(self, y: ArrayLike | None = None) -> Dataset:
        """Command and speed for `identify`; a true speed rides along as channel `speed_true`.

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
        """What its file says of it.

        Parameters
        ----------
        device : mapping, optional
            What it was recorded on; the virtual machine by default.
        **settings
            What is needed to record it again.
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
        """Write the columns as CSV, `.npz`, `.mat`, Parquet or MCAP, whole or not at all.

        Parameters
        ----------
        path : path
            A file that exists is replaced in one step, save a recording of a drive.
        overwrite : bool
            Whether that may be replaced as well.

        Raises
        ------
        DataError, SettingError
            As for `sewfast.writers.write_table`.
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
        """A table for a notebook."""
        return self.dataset()._repr_html_()

    def __repr__(self) -> str:
        return f"Recording({self.name!r}, {len(self)} samples, Ts={self.Ts:g} s)"


class Excited(Protocol):
    """A machine that plays commands by itself, such as a `sewfast.commissioning.SteppedBench`."""

    def excite(self, u: FloatArray, name: str) -> Recording: ...


def record(
    machine: VirtualMachine | Drive | Excited,
    u: ArrayLike,
    *,
    name: str = "array",
    method: Method = "kalman",
    file: str | os.PathLike[str] | None = None,
    live: str | Kind = "none",
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    cancel: threading.Event | None = None,
) -> Recording:
    """Excite a machine from rest and record it.

    Parameters
    ----------
    machine : VirtualMachine, Drive or a machine of your own
        A virtual machine is reset first, and left where the run ends. A drive (`sewfast.link`)
        waits for rest, is armed and started; its limits must have been set. One of your own, a
        simulator or an FMU, stands in a `sewfast.commissioning.SteppedBench`.
    u : array, shape (N,)
        Command [V] at the machine's sample time; see `sewfast.signals.excitation`.
    name : str
        Of the excitation, for messages and files.
    method : "kalman", "savgol" or "difference"
        How the speed is estimated from the counts.
    file : path, optional
        Of a drive an MCAP recording, written while it runs, so that nothing is lost; of a virtual
        machine any format.
    live : str
        Of a drive: see `sewfast.live.open_view`.
    settings : mapping, optional
        What else the file says of the recording.
    overwrite : bool
        Whether `file` may replace a recording of a drive, which cannot be had again; one of a
        virtual machine is replaced anyway.
    cancel : threading.Event, optional
        Of a drive: set in another thread, it ends the run as Ctrl-C does.

    Returns
    -------
    Recording
        Of a virtual machine the command as given: beyond its limit the machine clips it. Of a
        drive the command as applied.

    Raises
    ------
    DataError
        Where `u` is not one-dimensional and finite, or too short for a speed.
    SettingError
        Where `file` has an unknown ending or is a recording that is kept, before anything moves.
    LinkError
        Where the port or the drive failed or tripped; the motor is stopped, `recording` holds what
        came.
    Interrupted
        On Ctrl-C or `cancel`, of a drive; the motor is stopped, `best` is the recording up to
        there.
    """
    if not isinstance(machine, VirtualMachine) and not (
        hasattr(machine, "stream") or hasattr(machine, "excite")
    ):
        raise SettingError(
            f"expected a VirtualMachine or a Drive to record, got {type(machine).__name__}; the "
            "machine comes first: record(machine, u)"
        )
    try:
        if np.iscomplexobj(u):
            raise TypeError("complex numbers")
        command = np.array(u, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as e:
        raise DataError(
            f"expected an excitation as numbers, got {str(u)[:60]!r}; a named one is "
            "sewfast.signals.excitation('step')"
        ) from e
    if command.ndim != 1:
        raise DataError(
            f"expected an excitation of shape (N,), received {command.shape}; pass one column"
        )
    if hasattr(machine, "stream"):
        return _record_on(
            cast("Drive", machine), command, name, method, file, live, settings, overwrite, cancel
        )
    if file is not None:
        require_replaceable(file, overwrite=overwrite)
    if not isinstance(machine, VirtualMachine):
        found = cast(Excited, machine).excite(command, name)
        if file is not None:
            found.save(file, overwrite=overwrite)
        return found
    machine.reset()
    run = machine.run(command)
    y = speed_from_counts(run.counts, machine.Ts, machine.counts_per_rev, method=method)
    made = Recording(
        command, run.counts, y, run.speed_rpm, machine.Ts, machine.counts_per_rev, name
    )
    if file is not None:
        made.save(file, overwrite=overwrite)
    return made


def _record_on(
    drive: Drive,
    command: FloatArray,
    name: str,
    method: Method,
    file: str | os.PathLike[str] | None,
    live: str | Kind,
    settings: Mapping[str, Any] | None,
    overwrite: bool,
    cancel: threading.Event | None,
) -> Recording:
    from .link.plan import Plan, Played, Stopped, play

    def recording(played: Played) -> Recording:
        return recording_of_drive(played.columns, drive, name, method)

    try:
        plan = Plan("commands", command)
        return recording(
            play(
                drive, plan, name=name, file=file, live=live, settings=settings,
                overwrite=overwrite, cancel=cancel,
            )
        )  # fmt: skip
    except Stopped as stopped:
        raise stopped.as_error(recording) from stopped.cause


def recording_of_drive(
    columns: Mapping[str, FloatArray], drive: Drive, name: str, method: Method
) -> Recording:
    """Counts from the first sample on; the speed as far as gaps let it be known."""
    per_rev = drive.identity.counts_per_rev
    counts = columns["counts"]
    known = counts[np.isfinite(counts)]
    counts = counts - known[0] if len(known) else counts
    y = speed_or_nan(counts, drive.identity.Ts, per_rev, method)
    true = columns.get("speed_true")
    return Recording(columns["u"], counts, y, true, drive.identity.Ts, per_rev, name)
