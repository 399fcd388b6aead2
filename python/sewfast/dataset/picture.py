"""The picture of a data set: columns over time with what is missing or stands out, and spectra."""

from __future__ import annotations

import os
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray, labelled, runs
from ..plotting import Drawing, legend, lettered, thin
from .outliers import band, distances, power_spectrum, usual_threshold
from .pieces import LARGEST

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .dataset import Dataset

INPUT, OUTPUT, MISSING, OUTLIER = "#333333", "#0072B2", "#D55E00", "#CC0000"
MOST_PANELS = 8
_BUCKETS = 1200
_MOST_GAPS = 1000
"""That are shaded, the longest first; of more a figure would only be slow."""


def plot(data: Dataset, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
    """Draw every column over time and its spectrum.

    What is missing is shaded, outputs that stand out of their neighbours are circled; experiments
    follow one another.

    Parameters
    ----------
    ax : Axes or sequence of Axes, optional
        One shows the output over time; several are filled in reading order.
    file : path, optional
        Where to write the figure: PNG, SVG or PDF by its ending.

    Returns
    -------
    Axes or array of Axes
        `ax`, or the panels of a new figure: time and spectrum of each input, then of the output.

    Raises
    ------
    SettingError
        Where matplotlib is not installed or the file cannot be written.
    """
    return drawing(data).plot(ax, file)


def drawing(data: Dataset) -> Drawing:
    """One row per column, time on the left, spectrum on the right; experiments side by side."""
    names = [*map(labelled, data.input_names, data.input_units)]
    names = [*names[: MOST_PANELS - 1], labelled(data.output_name, data.output_unit)]
    rows = []
    units = [*data.input_units[: len(names) - 1], data.output_unit]
    for i, (name, unit) in enumerate(zip(map(lettered, names), map(lettered, units), strict=True)):
        is_output = i == len(names) - 1
        columns = [e.y if is_output else e.u[:, i] for e in data.experiments]
        columns = [np.where(np.abs(c) < LARGEST, c, np.nan) for c in columns]
        threshold = usual_threshold(data) if is_output else None
        colour = OUTPUT if is_output else INPUT
        rows.append((
            partial(_over_time, columns=columns, Ts=data.Ts, name=name, threshold=threshold),
            partial(
                _over_frequency, columns=columns, Ts=data.Ts, colour=colour, unit=unit,
                titled=i == 0,
            ),
        ))  # fmt: skip
    return Drawing(tuple(rows), (2.2, *[1.9] * (len(rows) - 1)), (2.6, 1.0), main=2 * len(rows) - 2)


def _over_time(
    ax: Axes, columns: list[FloatArray], Ts: float, name: str, threshold: float | None
) -> None:
    """One column; with a threshold it is the output, whose outliers are circled."""
    is_output, offset = threshold is not None, 0
    has_gaps = has_outliers = False
    look: dict[str, Any] = {"lw": 0.9, "color": OUTPUT if is_output else INPUT}
    look |= {"drawstyle": "default" if is_output else "steps-post"}
    for column in columns:
        index = np.arange(offset, offset + len(column), dtype=np.float64)
        ax.plot(*thin(index * Ts, column, _BUCKETS), **look)
        gaps = sorted(runs(np.isnan(column)), key=lambda gap: -gap[1])[:_MOST_GAPS]
        if gaps:
            places = [((offset + start - 0.5) * Ts, length * Ts) for start, length in gaps]
            missing: dict[str, Any] = {"color": MISSING, "alpha": 0.25, "lw": 0, "snap": False}
            missing |= {"label": "" if has_gaps else "missing"}
            # over the whole height, as one collection: a link can lose thousands of samples; a gap
            # that is thinner than a pixel has a mark at the bottom
            height = ax.get_xaxis_transform()
            ax.broken_barh(places, (0.0, 1.0), transform=height, **missing)
            middles = [left + 0.5 * width for left, width in places]
            ax.plot(middles, np.zeros(len(places)), "|", color=MISSING, ms=7, transform=height)
            has_gaps = True
        if threshold is not None:
            at = np.flatnonzero(distances(column) > threshold)
            if len(at):
                label = "" if has_outliers else "stands out"
                circle: dict[str, Any] = {"ms": 5, "mfc": "none", "mec": OUTLIER, "label": label}
                ax.plot((offset + at) * Ts, column[at], "o", **circle)
                has_outliers = True
        offset += len(column)
        if column is not columns[-1]:
            ax.axvline(offset * Ts, color="#888888", lw=0.8, ls=(0, (2, 2)))
    ax.set_ylabel(name)
    several = ", experiments one after the other" if len(columns) > 1 else ""
    ax.set_xlabel(f"time [s]{several}")
    ax.set_xlim(0.0, offset * Ts)
    if has_gaps or has_outliers:
        legend(ax)


def _over_frequency(
    ax: Axes, columns: list[FloatArray], Ts: float, colour: str, unit: str, titled: bool
) -> None:
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel(f"density [{unit}²/Hz]" if unit else "density [1/Hz]")
    if titled:
        ax.set_title("90 % is shaded")
    frequency, power = power_spectrum(columns, Ts)
    found = band(frequency, power)
    if found is None:
        ax.text(0.5, 0.5, "too short", ha="center", va="center", transform=ax.transAxes)
        return
    shown = power > 0.0
    ax.loglog(frequency[shown], power[shown], lw=0.9, color=colour)
    ax.axvspan(*found, color=colour, alpha=0.12, lw=0)
