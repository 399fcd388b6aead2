"""`HostLoopRun`: what a controller on the host did."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..control import Controller
from ..errors import DataError
from ..loop import SMOOTHING
from ..recordfile import Header, RecordWriter
from ..recordfile.keeping import require_replaceable
from ..recordfile.sink import replacing
from ..writers import write_table
from .jitter import Jitter
from .wire import Identity

FloatArray: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HostLoopRun:
    """What a controller on the host did; entry k belongs to tick k, `t[k]` after the first.

    Attributes
    ----------
    t, r : array, shape (N,)
        Time [s] and reference [y] of each tick that was reached. The first tick comes shortly after
        the first samples, so that each finds fresh ones; the drive is on with command 0 until then.
    u : array, shape (N,)
        Command after the controller's limits [u]; NaN where the tick was missed.
    y, feedback : array, shape (N,)
        Speed over the last period, from the counts, and the same after the feedback filter [y];
        y is NaN where no new sample had come.
    late, age : array, shape (N,)
        Lateness of the tick and age of its newest sample [s]; NaN where there is none.
    samples : mapping
        Every sample of the device that came, (n,): `t` [s] from the start of the run, then its
        channels.
    sample_units : mapping
        Their units.
    gaps : tuple of (first, count)
        Samples of the device that are missing.
    taken : int or None
        Samples that the device took; None where it could not be asked.
    outcome : str
        completed, tripped, ended, silent, reset, port_lost or interrupted.
    message : str
        What that means and what to do.
    stop_confirmed : bool
        Whether the device has answered STOP; where not, its watchdog stops the motor.
    jitter : Jitter
    controller : Controller
    device : Identity
    reference : str
        Its name.
    """

    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray
    feedback: FloatArray
    late: FloatArray
    age: FloatArray
    samples: Mapping[str, FloatArray]
    sample_units: Mapping[str, str]
    gaps: tuple[tuple[int, int], ...]
    taken: int | None
    outcome: str
    message: str
    stop_confirmed: bool
    jitter: Jitter
    controller: Controller
    device: Identity
    reference: str

    @property
    def Ts(self) -> float:
        """Sample time of the loop [s]."""
        return self.controller.Ts

    @property
    def plant(self) -> str:
        """The device's name."""
        return self.device.name

    @property
    def is_complete(self) -> bool:
        """Whether the whole reference was run and every sample that the device took has come."""
        return (
            self.outcome == "completed" and not self.gaps and self.taken == len(self.samples["t"])
        )

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column by name."""
        u, y = self.controller.gains.u_unit, self.controller.gains.y_unit
        return {"t": "s", "r": y, "u": u, "y": y, "feedback": y, "late": "s", "age": "s"}

    def columns(self) -> dict[str, FloatArray]:
        """t, r, u, y, feedback, late, age by name, for a file or a plot."""
        return {name: getattr(self, name) for name in self.units}

    def metrics(self) -> dict[str, float | None]:
        """How well it tracked and what that took: `ClosedLoopRun.metrics` of the measured output.

        Returns
        -------
        dict
            None for what is not defined: nothing was run, or the reference is no step.
        """
        measured, run = np.isfinite(self.y), np.isfinite(self.u)
        error = (self.r - self.y)[measured]
        found: dict[str, float | None] = dict.fromkeys(("rmse", "max_abs"))
        if len(error):
            found = {"rmse": float(np.sqrt(np.mean(error**2))), "max_abs": float(abs(error).max())}
        found |= self._step_metrics(measured)
        effort = ("u_rms", "du_rms", "saturated")
        if not run.any():
            return found | dict.fromkeys(effort)
        limits = {"u_min": self.controller.u_min, "u_max": self.controller.u_max}
        return found | _core.effort(self.u[run], **limits)

    def _step_metrics(self, measured: NDArray[np.bool_]) -> dict[str, float | None]:
        names = ("rise_time_ms", "reference_rise_time_ms", "overshoot_percent")
        if not measured.any():
            return dict.fromkeys(names)
        y = np.interp(self.t, self.t[measured], self.y[measured])
        try:
            found = _core.step_metrics(y, self.r, Ts=self.Ts, smoothing=SMOOTHING)
        except DataError:
            return dict.fromkeys(names)
        return {name: None if math.isnan(value) else value for name, value in found.items()}

    def save_samples(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write every sample of the device as CSV, `.npz`, `.mat`, Parquet or MCAP.

        Missing samples are NaN; in MCAP they are gaps. The file appears whole or not at all.

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
            self._save_mcap(Path(path))
            return
        numbers = self._numbers()
        n = max(self.taken or 0, int(numbers[-1]) + 1 if len(numbers) else 0)
        columns = {name: np.full(n, np.nan) for name in self.samples}
        for name, column in columns.items():
            column[numbers] = self.samples[name]
        columns["t"] = np.arange(n, dtype=np.float64) * self.device.Ts
        write_table(path, columns, units=self.sample_units)

    def _save_mcap(self, path: Path) -> None:
        names = [name for name in self.samples if name != "t"]
        header = Header(
            name=self.reference, Ts=self.device.Ts,
            columns={name: self.sample_units[name] or "1" for name in names}, n=self.taken,
            counts_per_rev=self.device.counts_per_rev or None,
            device={"kind": "drive", **asdict(self.device)},
            settings={"mode": "host loop", "controller": self.controller.to_dict()},
        )  # fmt: skip
        numbers = self._numbers()
        ends = np.flatnonzero(np.diff(numbers) != 1) + 1
        with replacing(path) as temporary, RecordWriter(temporary, header) as writer:
            for part in np.split(np.arange(len(numbers)), ends):
                if len(part):
                    columns = {name: self.samples[name][part] for name in names}
                    writer.samples(int(numbers[part[0]]), columns)
            ended = "complete" if self.outcome == "completed" else self.outcome
            writer.close(ended, taken=self.taken)

    def _numbers(self) -> NDArray[np.intp]:
        """The samples' numbers in the run."""
        return np.rint(self.samples["t"] / self.device.Ts).astype(np.intp)

    def __str__(self) -> str:
        told, unit = self.metrics(), self.units
        lines = [f"{self.reference} on {self.plant}, loop on the host: {self.outcome}"]
        if self.outcome != "completed":
            lines.append(f"  {self.message}")
        if not self.stop_confirmed and self.outcome != "reset":
            lines.append(
                "  STOP was not answered: the device's watchdog stops the motor; see that it stands"
            )
        if told["rmse"] is not None:
            lines.append(
                f"  error     {told['rmse']:.4g} {unit['y']} rms, {told['max_abs']:.4g} at most "
                "(measured)"
            )
        of = "an unknown number" if self.taken is None else self.taken
        gaps = ", ".join(f"{n} from sample {k}" for k, n in self.gaps[:5]) or "none"
        more = f" and {len(self.gaps) - 5} more" if len(self.gaps) > 5 else ""
        lines.append(f"  samples   {len(self.samples['t'])} of {of}; gaps: {gaps}{more}")
        return "\n".join([*lines, str(self.jitter)])
