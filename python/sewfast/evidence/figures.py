"""Figures of a report card: residual correlations, bands, operating range, training region."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..dataset import FloatArray, labelled
from ..errors import SettingError
from ..plotting import DPI, STYLES, Drawing, Panel, lettered, stacked, style, thin
from ..storage import making, replace_files
from .card import ReportCard
from .portmanteau import ResidualTest

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Colours of Okabe and Ito, distinct for readers with a colour deficiency, too."""
_MARKERS = "osD^vP"
_MOST_PANELS = 6
_BUCKETS = 1200


def figures(card: ReportCard, *, page: bool = False) -> dict[str, Figure]:
    """All figures of a card for which it has the evidence, by name."""
    drawn = {name: drawing(card, name) for name in names(card)}
    return {name: d.beside() if page else d.figure() for name, d in drawn.items()}


def names(card: ReportCard) -> list[str]:
    """The names of the figures for which a card has evidence."""
    evidence = {
        "residuals": bool(card.tests), "bands": card.bands is not None,
        "bode": card.operating is not None, "poles": card.operating is not None,
        "region": bool(card.distances),
    }  # fmt: skip
    return [name for name, is_there in evidence.items() if is_there]


def drawing(card: ReportCard, name: str | None = None) -> Drawing:
    """One figure of a card; by default `bands`, else the first for which it has evidence."""
    there = names(card)
    if name is None and there:
        name = "bands" if "bands" in there else there[0]
    if name not in there:
        raise SettingError(
            f"expected a figure of this card, {', '.join(there) or 'which has none'}, got {name!r}"
        )
    return _DRAWINGS[name](card)


def save(card: ReportCard, folder: str | os.PathLike[str]) -> list[Path]:
    """Write every figure as a PNG into a folder, which is created if needed."""
    contents: dict[Path, bytes] = {}
    for name, figure in figures(card).items():
        content = io.BytesIO()
        with style():
            figure.savefig(content, dpi=DPI)
        contents[Path(folder) / f"{name}.png"] = content.getvalue()
    try:
        with making(Path(folder)):
            replace_files(contents)
    except OSError as e:
        raise SettingError(
            f"{folder}: expected a folder to write figures to, received {e.strerror!r}; "
            "choose another"
        ) from e
    return [*contents]


def residual_drawing(card: ReportCard) -> Drawing:
    """Every residual test: correlations over lags, their 99 % limits, the verdict."""
    panels: list[Panel | None] = [partial(_residual_test, t=t, Ts=card.Ts) for t in card.tests]
    if len(panels) % 2:
        panels.append(None)
    rows = tuple(zip(panels[::2], panels[1::2], strict=True))
    return Drawing(rows, (2.1,) * len(rows), (1.0, 1.0))


def _residual_test(ax: Axes, t: ResidualTest, Ts: float) -> None:
    lags = t.lags * Ts * 1e3
    for i, name in enumerate(t.series):
        shift = (i - 0.5 * (len(t.series) - 1)) * 0.15 * Ts * 1e3
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
    ax.set_xlabel("lag [ms]; grey: 99 % of single correlations")
    reach = 1.15 * max(float(np.abs(t.correlations).max()), float(limit.max()), 1e-12)
    ax.set_ylim(-reach, reach)
    if len(t.series) > 1:
        ax.legend(fontsize=7.5, ncols=len(t.series), loc="upper right")


def band_drawing(card: ReportCard) -> Drawing:
    """Measured output, free run and bands of the first experiments."""
    count = len(card.runs[:_MOST_PANELS])
    panels = [partial(part, card=card, i=i) for i in range(count) for part in (_band, _band_error)]
    return stacked(panels, (2.2, 1.6) * count, share_x=False)


def _band(ax: Axes, card: ReportCard, i: int) -> None:
    assert card.bands is not None
    b, run = card.bands, card.runs[i]
    t: FloatArray = card.Ts * np.arange(len(run.y), dtype=np.float64)
    _envelope(ax, t, b.lower[i], b.upper[i])
    _line(ax, t, b.simulated[i], color="#D55E00", lw=1.1, ls=(0, (4, 1.6)), label="free run")
    _line(ax, t, run.y, color="#0072B2", lw=0.9, label="measured")
    ax.set_ylabel(lettered(labelled(card.output_name, card.unit)))
    ax.set_xlabel("time [s]")
    ax.set_title(
        f"{lettered(run.name)} [{run.range_text}]: {100.0 * b.inside[i]:.1f} % of samples\ninside "
        f"the {100 * b.level:g} % band"
    )
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8)
    ax.margins(x=0.01)


def _band_error(ax: Axes, card: ReportCard, i: int) -> None:
    assert card.bands is not None
    b, run = card.bands, card.runs[i]
    t: FloatArray = card.Ts * np.arange(len(run.y), dtype=np.float64)
    _envelope(ax, t, b.lower[i] - run.yhat, b.upper[i] - run.yhat)
    _line(ax, t, run.y - run.yhat, color="#0072B2", lw=0.8)
    ax.set_ylabel(lettered(labelled("error", card.unit)))
    ax.set_xlabel("time [s]")
    ax.margins(x=0.01)


def bode_drawing(card: ReportCard) -> Drawing:
    """Gain and phase at every operating point, with the range of an ensemble's members."""
    assert card.operating is not None
    inputs = range(len(card.operating.input_names))
    rows = (
        tuple(partial(_bode, card=card, i=i, phase=False) for i in inputs),
        tuple(partial(_bode, card=card, i=i, phase=True) for i in inputs),
    )
    return Drawing(rows, (2.2, 2.2), (1.0,) * len(inputs))


def _bode(ax: Axes, card: ReportCard, i: int, phase: bool) -> None:
    """Gain or phase from input i, at constant inputs from low to high."""
    assert card.operating is not None
    o = card.operating
    hertz = o.frequencies
    here = [k for k, j in enumerate(o.varied) if j == i]
    here = [k for k in here if o.points[k].known] or here
    shown = here[:: max(1, (len(here) - 1) // 4)]
    value = _phase if phase else np.abs
    for n, k in enumerate(shown):
        look = {
            "color": shade(n, len(shown)),
            "lw": 4.2 - 3.2 * n / max(1, len(shown) - 1),
            "ls": STYLES[n % len(STYLES)],
        }
        g = o.points[k].response(hertz)[:, i]
        if not np.abs(g).any():
            continue
        level = lettered(labelled(f"{o.points[k].u[i]:.3g}", o.input_units[i]))
        label = f"{lettered(o.input_names[i])} = {level}".replace("[", "").replace("]", "")
        ax.plot(hertz, value(g), label=None if phase else label, **look)
        if o.members:
            all_of_them = np.array([value(m[k].response(hertz)[:, i]) for m in o.members])
            low, high = all_of_them.min(axis=0), all_of_them.max(axis=0)
            ax.fill_between(hertz, low, high, color=look["color"], alpha=0.2, lw=0)
    ax.set_xscale("log")
    ax.set_xlabel("frequency [Hz]")
    if phase:
        ax.set_ylabel("phase [°]")
        return
    ax.set_yscale("log")
    gain = lettered(f"{o.output_unit or '1'}/{o.input_units[i] or '1'}")
    ax.set_ylabel(f"gain [{gain}]")
    ax.set_title(lettered(f"from {o.input_names[i]} to {o.output_name}"))
    ax.legend(fontsize=8, loc="lower left")


def _phase(g: Any) -> Any:
    return np.degrees(np.unwrap(np.angle(g)))


def pole_drawing(card: ReportCard) -> Drawing:
    """Poles in the z plane, and steady output, gain and time constant over the first input."""
    assert card.operating is not None
    o = card.operating
    over: tuple[tuple[str, Callable[[Any], float], str], ...] = (
        ("steady output; filled: in the training data", lambda p: p.y,
         labelled(o.output_name, o.output_unit)),
        ("steady gain", lambda p: float(p.dc_gain[0]),
         f"gain [{o.output_unit or '1'}/{o.input_units[0] or '1'}]"),
        ("slowest time constant", lambda p: float(p.time_constants.max(initial=0.0)),
         "time constant [s]"),
    )  # fmt: skip
    steady, gain, slow = (
        partial(_over_input, card=card, title=title, value=value, name=lettered(name))
        for title, value, name in over
    )
    plane = partial(_poles, card=card)
    return Drawing(((plane, steady), (gain, slow)), (3.1, 3.1), (1.0, 1.0), share_x=False)


def _along_first_input(card: ReportCard) -> list[int]:
    """Operating points at which only the first input differs."""
    assert card.operating is not None
    return [k for k, j in enumerate(card.operating.varied) if j == 0]


def _poles(ax: Axes, card: ReportCard) -> None:
    assert card.operating is not None
    o, here = card.operating, _along_first_input(card)
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    ax.plot(np.cos(angle), np.sin(angle), color="#777777", lw=0.9)
    for member in (o.members or ())[1:]:
        poles = np.concatenate([member[k].poles for k in here])
        ax.plot(poles.real, poles.imag, ".", color="#bbbbbb", ms=3)
    for n, p in enumerate(o.points[k] for k in here):
        if p.known:
            ax.plot(p.poles.real, p.poles.imag, "x", color=shade(n, len(here)), ms=6, mew=1.6)
    ax.set_aspect("equal", "datalim")
    ax.set_xlabel("real part of z")
    ax.set_ylabel("imaginary part of z")
    ax.set_title("poles; dark: low input, light: high input")


def _over_input(
    ax: Axes, card: ReportCard, title: str, value: Callable[[Any], float], name: str
) -> None:
    assert card.operating is not None
    o, here = card.operating, _along_first_input(card)
    points = [o.points[k] for k in here]
    u = np.array([p.u[0] for p in points])
    if o.members:
        of_members = np.array([[value(m[k]) for k in here] for m in o.members])
        low, high = of_members.min(axis=0), of_members.max(axis=0)
        ax.fill_between(u, low, high, color="#999999", alpha=0.35, lw=0)
    ax.plot(u, [value(p) for p in points], "o-", ms=4.5, color="#0072B2", lw=1.2, mfc="white")
    near = [k for k, p in enumerate(points) if p.known]
    ax.plot(u[near], [value(points[k]) for k in near], "o", ms=4.5, color="#0072B2")
    ax.set_title(title)
    ax.set_xlabel(lettered(labelled(o.input_names[0], o.input_units[0])))
    ax.set_ylabel(name)


def region_drawing(card: ReportCard) -> Drawing:
    """Distance from the training region over time."""
    count = len(card.runs[:_MOST_PANELS])
    panels = [partial(_region, card=card, i=i) for i in range(count)]
    return stacked(panels, (2.3,) * count, share_x=False)


def _region(ax: Axes, card: ReportCard, i: int) -> None:
    run, d = card.runs[i], card.distances[i]
    t: FloatArray = card.Ts * np.arange(len(run.y), dtype=np.float64)
    ax.axhspan(0.0, 1.0, color="#009E73", alpha=0.12, lw=0, label="training region")
    ax.axhline(1.0, color="#333333", lw=0.9, ls=(0, (4, 2)))
    _line(ax, t, d, color="#0072B2", lw=0.9)
    outside = 100.0 * float(np.mean(d[run.first :] > 1.0))
    ax.set_title(f"{lettered(run.name)} [{run.range_text}]: {outside:.2f} % of samples outside")
    ax.set_ylabel("distance / radius")
    ax.set_xlabel("time [s]")
    ax.margins(x=0.01)
    ax.set_ylim(0.0, min(max(1.2, 1.05 * float(d.max())), 20.0))


_DRAWINGS: dict[str, Callable[[ReportCard], Drawing]] = {
    "residuals": residual_drawing,
    "bands": band_drawing,
    "bode": bode_drawing,
    "poles": pole_drawing,
    "region": region_drawing,
}


# --- drawing --------------------------------------------------------------------------------------


def shade(n: int, count: int) -> str:
    """From dark to light in one hue: lightness shows the order, in grey print as well."""
    import matplotlib

    share = n / max(count - 1, 1)
    r, g, b, _ = matplotlib.colormaps["viridis"](0.05 + 0.8 * share)
    return f"#{round(255 * r):02x}{round(255 * g):02x}{round(255 * b):02x}"


def _line(ax: Axes, x: FloatArray, y: FloatArray, **look: Any) -> None:
    ax.plot(*thin(x, y, _BUCKETS), **look)


def _envelope(ax: Axes, t: FloatArray, low: FloatArray, high: FloatArray) -> None:
    step = max(1, len(t) // _BUCKETS)
    starts = np.arange(0, len(t), step)
    lows, highs = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
    ax.fill_between(t[starts], lows, highs, color="#E69F00", alpha=0.4, lw=0, label="band")
