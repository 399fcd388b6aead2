"""Figures of a report card: residual correlations, bands, operating range, training region."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import lettered
from ..dataset import FloatArray, labelled
from ..errors import SettingError
from .card import ReportCard

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 9.2
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito's, told apart by everyone."""
_STYLES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1, 2)))
_MARKERS = "osD^vP"
_MOST_PANELS = 6
_BUCKETS = 1200
_FARTHEST = 20.0


def figures(card: ReportCard) -> dict[str, Figure]:
    """All figures of a card by name; only those that it has evidence for.

    Returns
    -------
    dict
        `residuals`, `bands`, `bode`, `poles`, `region`: matplotlib figures.

    Raises
    ------
    SettingError
        Where matplotlib is not installed.
    """
    from ..plotting import require_matplotlib, style

    require_matplotlib()

    found: dict[str, Figure] = {}
    with style():
        if card.tests:
            found["residuals"] = residual_figure(card)
        if card.bands is not None:
            found["bands"] = band_figure(card)
        if card.operating is not None:
            found["bode"] = bode_figure(card)
            found["poles"] = pole_figure(card)
        if card.distances:
            found["region"] = region_figure(card)
    return found


def save(card: ReportCard, folder: str | os.PathLike[str]) -> list[Path]:
    """Write every figure as a PNG into a folder, which is made where it does not exist.

    Raises
    ------
    SettingError
        Where matplotlib is not installed or the folder cannot be written to.
    """
    from ..plotting import style

    written = []
    drawn = figures(card)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        for name, figure in drawn.items():
            path = Path(folder) / f"{name}.png"
            with style():
                figure.savefig(path, dpi=150)
            written.append(path)
    except OSError as e:
        raise SettingError(
            f"{folder}: expected a folder to write figures to, received {e.strerror!r}; "
            "choose another"
        ) from e
    return written


def residual_figure(card: ReportCard) -> Figure:
    """Every residual test: correlations over lags, their 99 % limits, the verdict."""
    rows = (len(card.tests) + 1) // 2
    figure, axes = _panels(rows, 2, 2.1 * rows)
    for ax, t in zip(axes.ravel(), card.tests, strict=False):
        lags = t.lags * card.Ts * 1e3
        for i, name in enumerate(t.series):
            shift = (i - 0.5 * (len(t.series) - 1)) * 0.15 * card.Ts * 1e3
            colour = _COLOURS[i % len(_COLOURS)]
            ax.vlines(lags + shift, 0.0, t.correlations[i], color=colour, lw=1.0)
            label = name if len(t.series) > 1 else None
            marker = _MARKERS[i % len(_MARKERS)]
            ax.plot(lags + shift, t.correlations[i], marker, ms=3.0, color=colour, label=label)
        limit = t.limits.max(axis=0)
        ax.fill_between(lags, -limit, limit, color="#999999", alpha=0.25, lw=0)
        ax.axhline(0.0, color="#555555", lw=0.7)
        judged = "" if t.judges else ", informs"
        word = "passed" if t.passed else "detected"
        ax.set_title(f"{t.title}\n{word}, p = {t.p_value:.2g}{judged}", fontsize=8.5)
        ax.set_ylabel("correlation")
        reach = 1.15 * max(float(np.abs(t.correlations).max()), float(limit.max()), 1e-12)
        ax.set_ylim(-reach, reach)
        if len(t.series) > 1:
            ax.legend(fontsize=7.5, ncols=len(t.series), loc="upper right")
    for ax in axes.ravel()[len(card.tests) :]:
        ax.set_axis_off()
    for ax in axes[-1]:
        ax.set_xlabel("lag [ms]; grey: 99 % of single correlations")
    return figure


def band_figure(card: ReportCard) -> Figure:
    """Measured output, free run and bands of the first experiments."""
    assert card.bands is not None
    b, runs = card.bands, card.runs[:_MOST_PANELS]
    figure, axes = _panels(2 * len(runs), 1, 3.6 * len(runs), share_x=False)
    for i, run in enumerate(runs):
        top, bottom = axes[2 * i, 0], axes[2 * i + 1, 0]
        t: FloatArray = card.Ts * np.arange(len(run.y), dtype=np.float64)
        low, high = b.lower[i], b.upper[i]
        _envelope(top, t, low, high)
        _line(top, t, b.simulated[i], color="#D55E00", lw=1.1, ls=(0, (4, 1.6)), label="free run")
        _line(top, t, run.y, color="#0072B2", lw=0.9, label="measured")
        top.set_ylabel(lettered(labelled(card.output_name, card.unit)))
        share = 100.0 * b.inside[i]
        top.set_title(
            f"{lettered(run.name)} [{run.range_text}]: {share:.1f} % of samples inside the "
            f"{100 * b.level:g} % band"
        )
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8)
        _envelope(bottom, t, low - run.yhat, high - run.yhat)
        _line(bottom, t, run.y - run.yhat, color="#0072B2", lw=0.8)
        bottom.set_ylabel(lettered(labelled("error", card.unit)))
        bottom.set_xlabel("time [s]")
        bottom.sharex(top)
    return figure


def bode_figure(card: ReportCard) -> Figure:
    """Gain and phase at every operating point, with the range of an ensemble's members."""
    assert card.operating is not None
    o = card.operating
    width = len(o.input_names)
    figure, axes = _panels(2, width, 5.2)
    hertz = o.frequencies
    for i in range(width):
        here = [k for k, j in enumerate(o.varied) if j == i]
        here = [k for k in here if o.points[k].known] or here
        shown = here[:: max(1, (len(here) - 1) // 4)]
        for n, k in enumerate(shown):
            look = {
                "color": shade(n, len(shown)),
                "lw": 4.2 - 3.2 * n / max(1, len(shown) - 1),
                "ls": _STYLES[n % len(_STYLES)],
            }
            g = o.points[k].response(hertz)[:, i]
            if not np.abs(g).any():
                continue
            value = lettered(labelled(f"{o.points[k].u[i]:.3g}", o.input_units[i]))
            label = f"{lettered(o.input_names[i])} = {value}".replace("[", "").replace("]", "")
            axes[0, i].loglog(hertz, np.abs(g), label=label, **look)
            axes[1, i].semilogx(hertz, np.degrees(np.unwrap(np.angle(g))), **look)
            _member_bands(axes[:, i], o.members, k, i, hertz, look["color"])
        gain = lettered(f"{o.output_unit or '1'}/{o.input_units[i] or '1'}")
        axes[0, i].set_ylabel(f"gain [{gain}]")
        axes[0, i].set_title(lettered(f"from {o.input_names[i]} to {o.output_name}"))
        axes[0, i].legend(fontsize=8, loc="lower left")
        axes[1, i].set_ylabel("phase [°]")
        axes[1, i].set_xlabel("frequency [Hz]")
    return figure


def _member_bands(axes: Any, members: Any, k: int, i: int, hertz: FloatArray, colour: str) -> None:
    """Between the smallest and the largest of an ensemble's members."""
    if not members:
        return
    g = np.array([m[k].response(hertz)[:, i] for m in members])
    size, phase = np.abs(g), np.degrees(np.unwrap(np.angle(g), axis=1))
    for ax, values in zip(axes, (np.maximum(size, 1e-300), phase), strict=True):
        ax.fill_between(
            hertz, values.min(axis=0), values.max(axis=0), color=colour, alpha=0.2, lw=0
        )


def pole_figure(card: ReportCard) -> Figure:
    """Poles in the z plane, and steady output, gain and time constant over the first input."""
    assert card.operating is not None
    o = card.operating
    here = [k for k, j in enumerate(o.varied) if j == 0]
    points = [o.points[k] for k in here]
    u = np.array([p.u[0] for p in points])
    figure, axes = _panels(2, 2, 6.2, share_x=False)
    plane, steady, gain, slow = axes.ravel()
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    plane.plot(np.cos(angle), np.sin(angle), color="#777777", lw=0.9)
    _member_poles(plane, o.members, here)
    for n, p in enumerate(points):
        if not p.known:
            continue
        plane.plot(p.poles.real, p.poles.imag, "x", color=shade(n, len(points)), ms=6, mew=1.6)
    plane.set_aspect("equal", "datalim")
    plane.set_xlabel("real part of z")
    plane.set_ylabel("imaginary part of z")
    plane.set_title("poles; dark: low input, light: high input")
    steady_note = "steady output; filled: in the training data"
    label = lettered(labelled(o.input_names[0], o.input_units[0]))
    rows = (
        (steady, steady_note, lambda p: p.y, lettered(labelled(o.output_name, o.output_unit))),
        (gain, "steady gain", lambda p: float(p.dc_gain[0]),
         lettered(f"gain [{o.output_unit or '1'}/{o.input_units[0] or '1'}]")),
        (slow, "slowest time constant", lambda p: float(p.time_constants.max(initial=0.0)),
         "time constant [s]"),
    )  # fmt: skip
    for ax, title, value, unit in rows:
        if o.members:
            all_values = np.array([[value(m[k]) for k in here] for m in o.members])
            low, high = all_values.min(axis=0), all_values.max(axis=0)
            ax.fill_between(u, low, high, color="#999999", alpha=0.35, lw=0)
        ax.plot(u, [value(p) for p in points], "o-", ms=4.5, color="#0072B2", lw=1.2, mfc="white")
        near = [k for k, p in enumerate(points) if p.known]
        ax.plot(u[near], [value(points[k]) for k in near], "o", ms=4.5, color="#0072B2")
        ax.set_title(title)
        ax.set_xlabel(label)
        ax.set_ylabel(unit)
    return figure


def _member_poles(ax: Axes, members: Any, here: list[int]) -> None:
    for member in members[1:]:
        poles = np.concatenate([member[k].poles for k in here])
        ax.plot(poles.real, poles.imag, ".", color="#bbbbbb", ms=3)


def region_figure(card: ReportCard) -> Figure:
    """Distance from the training region over time."""
    runs = card.runs[:_MOST_PANELS]
    figure, axes = _panels(len(runs), 1, 2.2 * len(runs) + 0.4, share_x=False)
    for i, run in enumerate(runs):
        ax = axes[i, 0]
        t: FloatArray = card.Ts * np.arange(len(run.y), dtype=np.float64)
        d = card.distances[i]
        ax.axhspan(0.0, 1.0, color="#009E73", alpha=0.12, lw=0, label="training region")
        ax.axhline(1.0, color="#333333", lw=0.9, ls=(0, (4, 2)))
        _line(ax, t, d, color="#0072B2", lw=0.9)
        outside = 100.0 * float(np.mean(d[run.first :] > 1.0))
        ax.set_title(f"{lettered(run.name)} [{run.range_text}]: {outside:.2f} % of samples outside")
        ax.set_ylabel("distance / radius")
        ax.set_xlabel("time [s]")
        ax.set_ylim(0.0, min(max(1.2, 1.05 * float(d.max())), _FARTHEST))
    return figure


# --- drawing --------------------------------------------------------------------------------------


def _panels(rows: int, columns: int, height: float, share_x: bool = True) -> tuple[Figure, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex="col" if share_x else "none")
    return figure, axes


def shade(n: int, count: int) -> str:
    """From dark to light in one hue: order is told by lightness, in grey print as well."""
    import matplotlib

    share = n / max(count - 1, 1)
    r, g, b, _ = matplotlib.colormaps["viridis"](0.05 + 0.8 * share)
    return f"#{round(255 * r):02x}{round(255 * g):02x}{round(255 * b):02x}"


def _line(ax: Axes, x: FloatArray, y: FloatArray, **look: Any) -> None:
    """A line thinned so that no peak is lost; gaps stay gaps."""
    if len(y) > 2 * _BUCKETS:
        edges = np.linspace(0, len(y), _BUCKETS + 1).astype(int)
        kept: list[int] = []
        for a, b in itertools.pairwise(edges):
            part = y[a:b]
            if np.isfinite(part).all():
                kept += sorted({a + int(np.argmin(part)), a + int(np.argmax(part))})
            else:
                kept += range(a, b)
        x, y = x[kept], y[kept]
    ax.plot(x, y, **look)


def _envelope(ax: Axes, t: FloatArray, low: FloatArray, high: FloatArray) -> None:
    step = max(1, len(t) // _BUCKETS)
    starts = np.arange(0, len(t), step)
    lows, highs = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
    ax.fill_between(t[starts], lows, highs, color="#E69F00", alpha=0.4, lw=0, label="band")
