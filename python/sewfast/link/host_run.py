"""`HostLoopRun`: the run of a controller on this computer, and its `Jitter`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray
from ..control.controller import Controller
from ..control.loop import SMOOTHING, run_html
from ..errors import DataError
from ..plotting import Drawing, Plotted, Trace, loop_panels, stacked
from ..recordfile import Header, RecordWriter
from ..recordfile.filing import replacing
from ..recordfile.writer import require_replaceable
from ..storage import write_table
from .wire import Identity

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EDGES = np.array([m * 10.0**d for d in range(7) for m in (1.0, 2.0, 5.0)] + [1e7])
"""Edges of the bins [us], 1 us to 10 s; values beyond count in the first or last bin."""
BAR = 30


@dataclass(frozen=True, eq=False)
class Jitter(Plotted):
    """How late a loop woke up, how old its measurements were, and what it missed.

    These are measurements of one run on one computer under its load at the time; only a real-time
    operating system puts a bound on them.

    Attributes
    ----------
    late : array, shape (N,)
        Time from a deadline until the loop was awake [us].
    age : array, shape (M,)
        Age of the newest sample at a tick [us], less the link's shortest delay.
    period : float
        Period of the loop [us].
    missed : int
        Ticks skipped because the loop woke up a period late or more.
    blind : int
        Ticks without a new sample since the one before; the command stayed unchanged.
    unsent : int
        Commands that the port did not take.
    round_trip : float or None
        Shortest time from a command to its answer [us]; it includes the link's delay.
    device_late : int or None
        Largest delay of a control period on the device [us], as it reports.
    real_time : str
        Result of asking for real-time scheduling.
    """

    late: FloatArray
    age: FloatArray
    period: float
    missed: int
    blind: int
    unsent: int
    round_trip: float | None
    device_late: int | None
    real_time: str

    def percentiles(self) -> dict[str, dict[str, float]]:
        """Median, 99 and 99.9 % and worst of lateness and age [us]; NaN if there are none."""
        return {"late_us": _percentiles(self.late), "age_us": _percentiles(self.age)}

    def histogram(self) -> dict[str, NDArray[Any]]:
        """Ticks in each bin.

        Returns
        -------
        dict
            `edges_us`, shape (B + 1,), spaced 1, 2, 5 a decade; `late` and `age`, shape (B,).
        """
        return {"edges_us": EDGES.copy(), "late": _counted(self.late), "age": _counted(self.age)}

    def to_dict(self) -> dict[str, Any]:
        """Everything except the single ticks, as JSON values; null if unknown."""
        return {
            "period_us": self.period,
            "ticks": len(self.late),
            **{
                name: {key: _finite(value) for key, value in values.items()}
                for name, values in self.percentiles().items()
            },
            "missed": self.missed,
            "blind": self.blind,
            "unsent": self.unsent,
            "round_trip_us": self.round_trip,
            "device_late_us": self.device_late,
            "real_time": self.real_time,
            "histogram": {k: v.tolist() for k, v in self.histogram().items()},
        }

    def __str__(self) -> str:
        all_ticks = len(self.late) + self.missed
        lines = [f"{all_ticks} ticks of {_time(self.period)}; times are this run's, no bounds"]
        lines += _table(self.percentiles())
        lines.append(
            f"  missed deadlines {self.missed}, ticks without a new sample {self.blind}, "
            f"commands not sent {self.unsent}"
        )
        if self.round_trip is not None:
            lines.append(
                f"  shortest round trip {_time(self.round_trip)}; the link's delay within it adds "
                "to the age"
            )
        lines.append(f"  scheduling: {self.real_time}")
        return "\n".join(lines + _bars(self.histogram()))

    def drawing(self) -> Drawing:
        """Both histograms."""
        return stacked((self.panel,), (3.4,))

    def panel(self, ax: Axes) -> None:
        """Draw both histograms into axes."""
        for name, values, colour in (
            ("wake-up lateness", self.late, "#0072B2"),
            ("age of the newest sample", self.age, "#D55E00"),
        ):
            ax.stairs(_counted(values), EDGES, label=name, fill=True, alpha=0.5, color=colour)
        ax.axvline(self.period, color="0.3", linestyle="--", label="period")
        used = np.flatnonzero(_counted(self.late) + _counted(self.age))
        ends = (EDGES[used[0]], EDGES[used[-1] + 1]) if len(used) else (1.0, 1.0)
        span = (0.5 * min(ends[0], self.period), 2.0 * max(ends[1], self.period))
        ax.set(xscale="log", yscale="log", xlim=span, ylim=(0.5, None))
        ax.set(xlabel="time [us]", ylabel="ticks")
        ax.set_title(f"{len(self.late)} ticks of {_time(self.period)}, {self.missed} missed")
        ax.legend()


def _percentiles(values: FloatArray) -> dict[str, float]:
    known = values[np.isfinite(values)]
    if not len(known):
        return dict.fromkeys(("median", "p99", "p999", "worst"), math.nan)
    found = np.percentile(known, (50.0, 99.0, 99.9), method="higher")
    return dict(zip(("median", "p99", "p999"), map(float, found), strict=True)) | {
        "worst": float(known.max())
    }


def _counted(values: FloatArray) -> NDArray[np.int64]:
    known = np.clip(values[np.isfinite(values)], EDGES[0], EDGES[-1])
    return np.histogram(known, EDGES)[0].astype(np.int64)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _time(us: float) -> str:
    """A time in the unit that suits it."""
    if math.isnan(us):
        return "-"
    for scale, unit in ((1e6, "s"), (1e3, "ms")):
        if us >= scale:
            return f"{us / scale:.3g} {unit}"
    return f"{us:.0f} us"


def _table(found: dict[str, dict[str, float]]) -> list[str]:
    names = {"late_us": "wake-up lateness", "age_us": "age of newest sample"}
    rows = [f"  {'':20}{'median':>10}{'99 %':>10}{'99.9 %':>10}{'worst':>10}"]
    for key, values in found.items():
        rows.append(f"  {names[key]:20}" + "".join(f"{_time(v):>10}" for v in values.values()))
    return rows


def _bars(counts: dict[str, NDArray[Any]]) -> list[str]:
    """A line for each bin from the first to the last that is not empty."""
    both = counts["late"] + counts["age"]
    used = np.flatnonzero(both)
    if not len(used):
        return []
    largest = max(counts["late"].max(), counts["age"].max(), 1)
    lines = [f"  {'from':>8}  {'late':<{BAR + 9}}age"]
    for k in range(used[0], used[-1] + 1):
        cells = (_bar(int(counts[name][k]), largest) for name in ("late", "age"))
        lines.append(f"  {_time(counts['edges_us'][k]):>8}  " + "".join(cells).rstrip())
    return lines


def _bar(count: int, largest: int) -> str:
    """A bar on a logarithmic scale, as the rare values matter most."""
    length = round(BAR * math.log1p(count) / math.log1p(largest))
    return f"{'#' * length + (f' {count}' if count else ''):<{BAR + 9}}"


# --- HostLoopRun ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HostLoopRun(Plotted):
    """The run of a controller on the host; entry k is tick k, `t[k]` after the first.

    Attributes
    ----------
    t, r : array, shape (N,)
        Time [s] and reference [y] of each tick reached. The first tick follows shortly after the
        first samples, so that each tick has fresh ones; until then the drive is on with command 0.
    u : array, shape (N,)
        Command after the controller's limits [u]; NaN if the tick was missed.
    y, feedback : array, shape (N,)
        Speed over the last period, from the counts, and the same after the feedback filter [y];
        y is NaN without a new sample.
    late, age : array, shape (N,)
        Lateness of the tick and age of its newest sample [s]; NaN if there is none.
    samples : mapping
        Every sample received from the device, (n,): `t` [s] from the start of the run, then its
        channels.
    sample_units : mapping
        Their units.
    gaps : tuple of (first, count)
        Missing samples of the device.
    taken : int or None
        Samples that the device took; None if it could not be asked.
    outcome : str
        completed, tripped, ended, silent, reset, port_lost or interrupted.
    message : str
        The outcome explained, and what to do.
    stop_confirmed : bool
        Whether the device confirmed STOP; if not, its watchdog stops the motor.
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
        """Whether the whole reference ran and every sample that the device took arrived."""
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
        """Tracking and effort: `ClosedLoopRun.metrics` of the measured output.

        Returns
        -------
        dict
            None for an undefined figure: nothing ran, or the reference is not a step.
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

    def drawing(self) -> Drawing:
        """Panels of output and reference, error, command, and lateness of the ticks."""
        trace = Trace.of(self.columns(), "measured", self.plant)
        limits = (self.controller.u_min, self.controller.u_max)
        panels = loop_panels([trace], self.units["y"], self.units["u"], limits)
        return stacked((*panels, self.jitter.panel), (2.2, 1.3, 1.3, 2.4), share_x=False)

    def _repr_html_(self) -> str:
        caption = f"{self.reference} on {self.plant} from this computer, {self.outcome}"
        return run_html(self, caption)

    def save_samples(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write every sample of the device as CSV, `.npz`, `.mat`, Parquet or MCAP.

        Missing samples are NaN; in MCAP they are gaps. The file appears complete or not at all.

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
        metrics, unit = self.metrics(), self.units
        lines = [f"{self.reference} on {self.plant}, loop on the host: {self.outcome}"]
        if self.outcome != "completed":
            lines.append(f"  {self.message}")
        if not self.stop_confirmed and self.outcome != "reset":
            lines.append(
                "  STOP was not answered: the device's watchdog stops the motor; make sure that "
                "it is at rest"
            )
        if metrics["rmse"] is not None:
            lines.append(
                f"  error     {metrics['rmse']:.4g} {unit['y']} rms, {metrics['max_abs']:.4g} at "
                "most (measured)"
            )
        of = "an unknown number" if self.taken is None else self.taken
        gaps = ", ".join(f"{n} from sample {k}" for k, n in self.gaps[:5]) or "none"
        more = f" and {len(self.gaps) - 5} more" if len(self.gaps) > 5 else ""
        lines.append(f"  samples   {len(self.samples['t'])} of {of}; gaps: {gaps}{more}")
        return "\n".join([*lines, str(self.jitter)])
