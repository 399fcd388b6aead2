"""`Jitter`: how well a loop on the host kept its time."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EDGES = np.array([m * 10.0**d for d in range(7) for m in (1.0, 2.0, 5.0)] + [1e7])
"""Ends of the bins [us], 1 us to 10 s; what lies beyond counts in the first or last one."""
PERCENT = (50.0, 99.0, 99.9)
BAR = 30


@dataclass(frozen=True, eq=False)
class Jitter:
    """How late a loop awoke, how old its measurements were, and what it missed.

    These are measurements of one run on one computer under its load then: no operating system that
    is not made for it bounds them.

    Attributes
    ----------
    late : array, shape (N,)
        From a deadline to the loop's being awake [us].
    age : array, shape (M,)
        Of the newest sample at a tick [us], less the link's shortest delay.
    period : float
        Of the loop [us].
    missed : int
        Ticks that were skipped, as the loop awoke a period late or more.
    blind : int
        Ticks to which no new sample had come since the one before; the command stayed as it was.
    unsent : int
        Commands that the port did not take.
    round_trip : float or None
        Shortest time from a command to its answer [us]; the link's delay is within it.
    device_late : int or None
        Latest control period of the device [us late], as it says.
    real_time : str
        What became of the wish for real-time scheduling.
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
        """50, 99 and 99.9 % and the worst of lateness and age [us]; NaN where there are none."""
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
        """Everything but the single ticks, as JSON values; null for what is not known."""
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

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw both histograms.

        Parameters
        ----------
        ax : Axes, optional
        file : path, optional
            Where to write the figure: PNG, SVG or PDF by its ending.

        Returns
        -------
        Axes or array of Axes
            `ax`, or the one panel of a new figure.

        Raises
        ------
        SettingError
            Where matplotlib is not installed or the file cannot be written.
        """
        from ..plotting import stacked

        return stacked((self.panel,), (3.4,)).plot(ax, file)

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
    found = np.percentile(known, PERCENT, method="higher")
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
    """A line for each bin between the first and the last that hold something."""
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
    """On a scale of logarithms, as what is rare is what matters."""
    length = round(BAR * math.log1p(count) / math.log1p(largest))
    return f"{'#' * length + (f' {count}' if count else ''):<{BAR + 9}}"
