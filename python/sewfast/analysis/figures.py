"""Figures of an analysis: steps, Bode of L, S, T, gain sensitivity, what-if."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import in_unit, labelled
from ..dataset import FloatArray
from ..errors import SettingError
from ..evidence.figures import shade
from ..plotting import STYLES, Drawing, Float, Panel, lettered, thin
from .points import LoopBode
from .responses import Responses
from .sensitivity import Score

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .analysis import Analysis

BLUE, ORANGE, GREY, BLACK = "#0072B2", "#D55E00", "#9a9a9a", "#000000"
"""Colours of Okabe and Ito, distinct for everyone; line styles distinguish them in grey print."""
LARGE_MS = 2.0


def figures(a: Analysis, *, page: bool = False) -> dict[str, Figure]:
    """All figures of an analysis by name. Raises `SettingError` if matplotlib is not installed."""
    drawn = {name: drawing(a, name) for name in names(a)}
    return {name: d.beside() if page else d.figure() for name, d in drawn.items()}


def names(a: Analysis) -> list[str]:
    """The names of the figures for which an analysis has numbers."""
    there = {
        "responses": bool(a.responses), "bode": True, "sensitivity": bool(a.sensitivity),
        "what_if": bool(a.what_if),
    }  # fmt: skip
    return [name for name, is_there in there.items() if is_there]


def drawing(a: Analysis, name: str | None = None) -> Drawing:
    """One figure of an analysis, by default steps and Bode together."""
    if name is None:
        return overview(a)
    there = names(a)
    if name not in there:
        raise SettingError(f"expected a figure of this analysis, {', '.join(there)}, got {name!r}")
    return _DRAWINGS[name](a)


def overview(a: Analysis) -> Drawing:
    """Steps above, loop transfer and sensitivities below: performance and margins of a loop."""
    rows = [row for part in (response_drawing(a), bode_drawing(a)) for row in part.rows]
    heights = [h for part in (response_drawing(a), bode_drawing(a)) for h in part.heights]
    if not a.responses:
        rows, heights = rows[2:], heights[2:]
    rows = [
        tuple(_with_legend(panel) if i % 2 == 0 and k == 0 else panel for k, panel in enumerate(r))
        for i, r in enumerate(rows)
    ]
    return Drawing(tuple(rows), tuple(heights), (1.0, 1.0), share_x=False)


def _with_legend(panel: Panel | None) -> Panel:
    def drawn(ax: Axes) -> None:
        assert panel is not None
        panel(ax)
        ax.legend(loc="best", fontsize=8)

    return drawn


def response_drawing(a: Analysis) -> Drawing:
    """Reference step beside disturbance step: output with the band of all plants, command."""
    rows = (
        tuple(partial(_output, r=r) for r in a.responses),
        tuple(partial(_command, r=r) for r in a.responses),
    )
    return Drawing(rows, (2.7, 1.9), (1.0,) * len(a.responses), legend=3)


def _output(ax: Axes, r: Responses) -> None:
    t = 1e3 * r.t
    if len(r.plants) > 1:
        _band(ax, t, *r.band)
    ax.plot(*thin(t, r.r), color=BLACK, lw=0.9, ls=(0, (4, 2)), label="reference")
    name = "median of the plants" if len(r.plants) > 1 else r.plants[0]
    ax.plot(*thin(t, np.median(r.y, axis=0)), color=BLUE, lw=1.4, label=name)
    ax.set_title(_step_title(r))
    ax.set_ylabel(lettered(labelled("output", r.y_unit)))
    ax.set_xlabel("time since the step [ms]")
    ax.margins(x=0.01)


def _command(ax: Axes, r: Responses) -> None:
    t = 1e3 * r.t
    if len(r.plants) > 1:
        _band(ax, t, r.u.min(axis=0), r.u.max(axis=0))
    ax.plot(*thin(t, np.median(r.u, axis=0)), color=BLUE, lw=1.1)
    ax.set_ylabel(lettered(labelled("command", r.u_unit)))
    ax.set_xlabel("time since the step [ms]")
    ax.margins(x=0.01)


def _step_title(r: Responses) -> str:
    if r.kind == "reference":
        return lettered(f"reference step of {in_unit(f'{r.size:.4g}', r.y_unit)}")
    size = in_unit(f"{r.disturbance:.3g}", r.u_unit)
    return lettered(f"disturbance worth {size} at the plant's input")


def _band(ax: Axes, t: FloatArray, low: FloatArray, high: FloatArray) -> None:
    step = max(1, len(t) // 1200)
    at = np.arange(0, len(t), step)
    lows, highs = np.minimum.reduceat(low, at), np.maximum.reduceat(high, at)
    ax.fill_between(t[at], lows, highs, color="#E69F00", alpha=0.45, lw=0, label="all plants")


# --- frequency ------------------------------------------------------------------------------------


def bode_drawing(a: Analysis) -> Drawing:
    """Gain and phase of L on the left, |S| and |T| on the right, per operating point."""
    gain, phase, s, t = (partial(_bode, a=a, curve=curve) for curve in ("L", "phase", "S", "T"))
    return Drawing(((gain, s), (phase, t)), (2.6, 2.6), (1.0, 1.0), legend=4)


_BODE: dict[str, tuple[str, Callable[[LoopBode], Float]]] = {
    "L": ("loop transfer L: gain", lambda x: np.abs(x.L)),
    "phase": ("loop transfer L: phase", lambda x: np.degrees(np.unwrap(np.angle(x.L), axis=1))),
    "S": ("sensitivity |S|: what is left of a disturbance", lambda x: np.abs(x.S)),
    "T": ("complementary sensitivity |T|", lambda x: np.abs(x.T)),
}
"""Title and values, shape (plants, frequencies), of each panel."""


def _bode(ax: Axes, a: Analysis, curve: str) -> None:
    title, values = _BODE[curve]
    unit = lettered(a.controller.gains.y_unit)
    for n, loop in enumerate(a.loops):
        look = {
            "color": shade(n, len(a.loops)),
            "ls": STYLES[n % len(STYLES)],
            # thinner lines on top, so that a curve below stays visible
            "lw": 1.4 + 1.8 * (1.0 - (n + 1) / len(a.loops)),
        }
        _curve(ax, loop, values(loop), look, f"about {loop.level:.4g} {unit}")
    ax.set_title(title)
    ax.set_xscale("log")
    ax.set_xlabel("frequency [Hz]")
    ax.margins(x=0.0)
    if curve == "phase":
        ax.axhline(-180.0, color="#555555", lw=0.7)
        ax.set_ylabel("phase [°]")
        _sensible_phase(ax)
        return
    ax.set_yscale("log")
    ax.axhline(1.0, color="#555555", lw=0.7)
    ax.set_ylabel("gain [1]")
    if curve == "S":
        _mark(ax)
    least = min(float(values(x).min()) for x in a.loops)
    most = max(float(values(x).max()) for x in a.loops)
    ax.set_ylim(max(0.7 * least, 1e-3), max(1.5 * most, 2.2 * LARGE_MS))


def _sensible_phase(ax: Axes) -> None:
    """Limit the phase axis to the range in which the loop acts."""
    low, high = ax.get_ylim()
    low, high = max(low, -540.0), min(max(high, 0.0), 90.0)
    ax.set_ylim(low, high)
    ax.set_yticks(np.arange(math.ceil(low / 90) * 90, high + 1.0, 90))


def _mark(ax: Axes) -> None:
    """Mark the level above which a peak of |S| is large."""
    ax.axhline(LARGE_MS, color=ORANGE, lw=1.0, ls=(0, (4, 2)))
    ax.annotate(
        f"Ms = {LARGE_MS:g}", (0.0, LARGE_MS), (4, 3), xycoords=("axes fraction", "data"),
        textcoords="offset points", color=ORANGE, va="bottom", fontsize=8.5,
    )  # fmt: skip


def _curve(ax: Axes, loop: LoopBode, values: Float, look: Any, label: str | None = None) -> None:
    if len(values) > 1:
        ax.fill_between(
            loop.hertz, values.min(axis=0), values.max(axis=0), color=look["color"], alpha=0.2, lw=0
        )
    ax.plot(loop.hertz, np.median(values, axis=0), label=label, **look)


# --- sensitivity ----------------------------------------------------------------------------------


def sensitivity_drawing(a: Analysis) -> Drawing:
    """Cost relative to the unchanged controller, and Ms, over the factor on each setting."""
    cost = partial(_sensitivity, a=a, value=lambda s: s.cost / a.score.cost)
    peak = partial(_sensitivity, a=a, value=lambda s: s.Ms, is_peak=True)
    return Drawing(((cost, peak),), (3.3,), (1.0, 1.0), share_x=False, legend=8)


def _sensitivity(
    ax: Axes, a: Analysis, value: Callable[[Score], float], is_peak: bool = False
) -> None:
    for n, s in enumerate(a.sensitivity):
        factors = np.array([*s.factors, 1.0])
        order = np.argsort(factors)
        scores = [*s.scores, a.score]
        ax.plot(
            100.0 * (factors[order] - 1.0), _finite([value(scores[i]) for i in order]),
            label=s.name, color=shade(n, len(a.sensitivity)), ls=STYLES[n % len(STYLES)],
            marker="osD^vP<>"[n % 8], ms=4.5, lw=1.3,
        )  # fmt: skip
    if is_peak:
        _mark(ax)
        ax.set_ylim(top=max(ax.get_ylim()[1], 1.06 * LARGE_MS))
        ax.set_ylabel("largest Ms [1]")
    else:
        ax.axhline(1.0, color="#555555", lw=0.7)
        ax.set_ylabel("cost over that of the controller [1]")
    ax.set_xlabel("change of the setting [%]")
    ax.set_xticks([100.0 * (f - 1.0) for f in (*a.sensitivity[0].factors, 1.0)])


def _finite(values: Sequence[float]) -> list[float]:
    return [v if math.isfinite(v) else math.nan for v in values]


def what_if_drawing(a: Analysis) -> Drawing:
    """Cost, worst error and Ms on changed plants, one row per change."""
    unit = lettered(a.controller.gains.y_unit)
    values: tuple[tuple[str, Callable[[Score], float]], ...] = (
        (labelled("cost", unit), lambda s: s.cost),
        (labelled("worst error", f"{unit} rms".lstrip()), lambda s: s.tracking),
        ("Ms [1]", lambda s: s.Ms),
    )
    panels = tuple(
        partial(_what_if, a=a, label=label, value=value, is_first=i == 0, is_peak=i == 2)
        for i, (label, value) in enumerate(values)
    )
    return Drawing((panels,), (0.32 * (1 + len(a.what_if)) + 1.0,), (1.0,) * 3, share_x=False)


def _what_if(
    ax: Axes, a: Analysis, label: str, value: Callable[[Score], float], is_first: bool,
    is_peak: bool,
) -> None:  # fmt: skip
    names = ["as it is", *(w.name for w in a.what_if)]
    scores = [a.score, *(w.score for w in a.what_if)]
    at = np.arange(len(names), dtype=np.float64)
    _dots(ax, at, scores, value, start=1.0 if is_peak else 0.0)
    ax.set_xlabel(label)
    ax.set_yticks(at, names if is_first else [""] * len(names))
    ax.invert_yaxis()
    ax.grid(axis="y", visible=False)
    if is_peak and ax.get_xlim()[1] > LARGE_MS:
        ax.axvline(LARGE_MS, color=ORANGE, lw=1.0, ls=(0, (4, 2)))


_DRAWINGS: dict[str, Callable[[Analysis], Drawing]] = {
    "responses": response_drawing,
    "bode": bode_drawing,
    "sensitivity": sensitivity_drawing,
    "what_if": what_if_drawing,
}


def _dots(ax: Axes, at: FloatArray, scores: Sequence[Score], value: Any, *, start: float) -> None:
    found = np.array([value(s) for s in scores], dtype=np.float64)
    known = np.isfinite(found)
    ax.hlines(at[known], found[0], found[known], color=GREY, lw=1.2)
    ax.plot(found[known], at[known], "o", color=BLUE, ms=5)
    if known[0]:
        ax.axvline(found[0], color="#555555", lw=0.8)
    for place in at[np.isinf(found)]:
        ax.annotate("runs away", (0.5, place), xycoords=("axes fraction", "data"), va="center",
                    ha="center", fontsize=8.5, color=ORANGE)  # fmt: skip
    high = float(found[known].max(initial=start + 1e-9))
    ax.set_xlim(start, start + 1.1 * (high - start))
