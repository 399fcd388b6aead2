"""The picture of a data set: columns over time with what is missing or stands out, and spectra."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray, labelled, lettered, runs
from ..errors import SettingError
from .noise import band, power_spectrum
from .outliers import distances, usual_threshold
from .pieces import LARGEST

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .dataset import Dataset

INPUT, OUTPUT, MISSING, OUTLIER = "#333333", "#0072B2", "#D55E00", "#CC0000"
MOST_PANELS = 8
_BUCKETS = 1200


def save(data: Dataset, path: str | os.PathLike[str]) -> None:
    """Draw `figure` into a file whose ending says the format.

    Raises
    ------
    SettingError
        Where matplotlib is not installed or the file cannot be written.
    """
    from ..plotting import require_matplotlib, style

    require_matplotlib()
    with style():
        drawn = figure(data)
        try:
            drawn.savefig(Path(path), dpi=150)
        except (OSError, ValueError) as e:
            raise SettingError(
                f"{path}: expected a file ending in .png, .svg or .pdf in a folder that exists, "
                f"received {e}"
            ) from e


def figure(data: Dataset) -> Figure:
    """One row per column, time on the left, spectrum on the right; experiments side by side."""
    from matplotlib.figure import Figure

    names = [*map(labelled, data.input_names, data.input_units)]
    names = [*names[: MOST_PANELS - 1], labelled(data.output_name, data.output_unit)]
    drawn = Figure(figsize=(9.2, 0.7 + 1.9 * len(names)), layout="constrained")
    names = [*map(lettered, names)]
    axes = drawn.subplots(
        len(names), 2, squeeze=False, sharex="col", gridspec_kw={"width_ratios": [2.6, 1.0]}
    )
    for i, (name, (left, right)) in enumerate(zip(names, axes, strict=True)):
        is_output = i == len(names) - 1
        columns = [e.y if is_output else e.u[:, i] for e in data.experiments]
        columns = [np.where(np.abs(c) < LARGEST, c, np.nan) for c in columns]
        _over_time(left, columns, data.Ts, name, usual_threshold(data) if is_output else None)
        _over_frequency(right, columns, data.Ts, OUTPUT if is_output else INPUT)
    several = ", experiments one after the other" if len(data.experiments) > 1 else ""
    axes[-1, 0].set_xlabel(f"time [s]{several}")
    axes[-1, 1].set_xlabel("frequency [Hz]")
    axes[0, 1].set_title("power density; 90 % is shaded")
    return drawn


def _over_time(
    ax: Axes, columns: list[FloatArray], Ts: float, name: str, threshold: float | None
) -> None:
    """One column; with a threshold it is the output, whose outliers are circled."""
    is_output, offset = threshold is not None, 0
    labels: dict[str, Any] = {}
    look: dict[str, Any] = {"lw": 0.9, "color": OUTPUT if is_output else INPUT}
    look |= {"drawstyle": "default" if is_output else "steps-post"}
    for column in columns:
        for start, length in runs(np.isfinite(column)):
            t, y = _thinned(column, start, length)
            ax.plot((offset + t) * Ts, y, **look)
        for start, length in runs(np.isnan(column)):
            left = (offset + start - 0.5) * Ts
            labels["missing"] = ax.axvspan(
                left, left + length * Ts, color=MISSING, alpha=0.25, lw=0
            )
        if threshold is not None:
            at = np.flatnonzero(distances(column) > threshold)
            if len(at):
                (labels["stands out"],) = ax.plot(
                    (offset + at) * Ts, column[at], "o", ms=5, mfc="none", mec=OUTLIER
                )
        offset += len(column)
        if column is not columns[-1]:
            ax.axvline(offset * Ts, color="#888888", lw=0.8, ls=(0, (2, 2)))
    ax.set_ylabel(name)
    ax.set_xlim(0.0, offset * Ts)
    if labels:
        ax.legend(
            list(labels.values()), list(labels), loc="lower right", bbox_to_anchor=(1.0, 1.0),
            ncols=2, borderaxespad=0.1,
        )  # fmt: skip


def _thinned(column: FloatArray, start: int, length: int) -> tuple[FloatArray, FloatArray]:
    from ..plotting import thin

    index = np.arange(start, start + length, dtype=np.float64)
    return thin(index, column[start : start + length], _BUCKETS)


def _over_frequency(ax: Axes, columns: list[FloatArray], Ts: float, colour: str) -> None:
    frequency, power = power_spectrum(columns, Ts)
    found = band(frequency, power)
    if found is None:
        ax.text(0.5, 0.5, "too short", ha="center", va="center", transform=ax.transAxes)
        return
    shown = power > 0.0
    ax.loglog(frequency[shown], power[shown], lw=0.9, color=colour)
    ax.axvspan(*found, color=colour, alpha=0.12, lw=0)
