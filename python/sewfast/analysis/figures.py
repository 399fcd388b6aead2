"""Figures of an analysis: steps, Bode of L, S, T, gain sensitivity, what-if."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import lettered
from ..dataset import FloatArray
from ..evidence.figures import shade
from ..plotting import Float, panels, require_matplotlib, style, thin
from .points import LoopBode
from .responses import Responses
from .sensitivity import Score

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .analysis import Analysis

BLUE, ORANGE, GREY, BLACK = "#0072B2", "#D55E00", "#9a9a9a", "#000000"
"""Okabe and Ito's, told apart by everyone; the line style tells them apart in grey print."""
_STYLES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1, 2)))
LARGE_MS = 2.0


def figures(a: Analysis) -> dict[str, Figure]:
    """All figures of an analysis by name.

    Raises
    ------
    SettingError
        Where matplotlib is not installed.
    """
    require_matplotlib()
    with style():
        found = {"bode": bode_figure(a)}
        if a.responses:
            found = {"responses": response_figure(a), **found}
        if a.sensitivity:
            found["sensitivity"] = sensitivity_figure(a)
        if a.what_if:
            found["what_if"] = what_if_figure(a)
    return found


def response_figure(a: Analysis) -> Figure:
    """Reference step beside disturbance step: output with the band of all plants, command."""
    figure, axes = panels([2.6, 1.9], widths=[1, 1])
    for column, r in enumerate(a.responses):
        output, command = axes[0, column], axes[1, column]
        t = 1e3 * r.t
        if len(r.plants) > 1:
            _band(output, t, *r.band)
            _band(command, t, r.u.min(axis=0), r.u.max(axis=0))
        output.plot(*thin(t, r.r), color=BLACK, lw=0.9, ls=(0, (4, 2)), label="reference")
        name = "median of the plants" if len(r.plants) > 1 else r.plants[0]
        output.plot(*thin(t, np.median(r.y, axis=0)), color=BLUE, lw=1.4, label=name)
        command.plot(*thin(t, np.median(r.u, axis=0)), color=BLUE, lw=1.1)
        output.set_title(_step_title(r))
        output.set_ylabel(lettered(f"output [{r.y_unit}]"))
        command.set_ylabel(lettered(f"command [{r.u_unit}]"))
        command.set_xlabel("time since the step [ms]")
        output.margins(x=0.01)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)
    return figure


def _step_title(r: Responses) -> str:
    if r.kind == "reference":
        return lettered(f"reference step of {r.size:.4g} {r.y_unit}")
    return lettered(f"disturbance worth {r.disturbance:.3g} {r.u_unit} at the plant's input")


def _band(ax: Axes, t: FloatArray, low: FloatArray, high: FloatArray) -> None:
    step = max(1, len(t) // 1200)
    at = np.arange(0, len(t), step)
    lows, highs = np.minimum.reduceat(low, at), np.maximum.reduceat(high, at)
    ax.fill_between(t[at], lows, highs, color="#E69F00", alpha=0.45, lw=0, label="all plants")


# --- frequency ------------------------------------------------------------------------------------


def bode_figure(a: Analysis) -> Figure:
    """Gain and phase of L on the left, |S| and |T| on the right, per operating point."""
    figure, axes = panels([2.5, 2.5], widths=[1, 1])
    gain, phase, s, t = axes[0, 0], axes[1, 0], axes[0, 1], axes[1, 1]
    unit = lettered(a.controller.gains.y_unit)
    for n, loop in enumerate(a.loops):
        look = {
            "color": shade(n, len(a.loops)),
            "ls": _STYLES[n % len(_STYLES)],
            # what lies on top of another curve leaves it to be seen
            "lw": 3.2 - 2.0 * n / max(1, len(a.loops) - 1),
        }
        label = f"about {loop.level:.4g} {unit}"
        _curve(gain, loop, np.abs(loop.L), look, label)
        _curve(phase, loop, np.degrees(np.unwrap(np.angle(loop.L), axis=1)), look)
        _curve(s, loop, np.abs(loop.S), look)
        _curve(t, loop, np.abs(loop.T), look)
    for ax in (gain, s, t):
        ax.set_yscale("log")
        ax.axhline(1.0, color="#555555", lw=0.7)
    _mark(s)
    phase.axhline(-180.0, color="#555555", lw=0.7)
    _sensible(a.loops, phase, gain, s, t)
    for ax, title in (
        (gain, "loop transfer L: gain"), (phase, "loop transfer L: phase"),
        (s, "sensitivity |S|: what is left of a disturbance"),
        (t, "complementary sensitivity |T|"),
    ):  # fmt: skip
        ax.set_title(title)
        ax.set_xscale("log")
        ax.margins(x=0.0)
        ax.set_ylabel("phase [°]" if ax is phase else "gain [1]")
    for ax in (phase, t):
        ax.set_xlabel("frequency [Hz]")
    handles, labels = gain.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=4)
    return figure


def _mark(ax: Axes) -> None:
    """Where a peak of |S| is large."""
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


def _sensible(loops: Sequence[LoopBode], phase: Axes, gain: Axes, s: Axes, t: Axes) -> None:
    """What lies where the loop no longer acts is not what one looks for."""
    low, high = phase.get_ylim()
    low, high = max(low, -540.0), min(max(high, 0.0), 90.0)
    phase.set_ylim(low, high)
    phase.set_yticks(np.arange(math.ceil(low / 90) * 90, high + 1.0, 90))
    for ax, values in (
        (gain, [np.abs(x.L) for x in loops]),
        (s, [np.abs(x.S) for x in loops]),
        (t, [np.abs(x.T) for x in loops]),
    ):
        least = min(float(v.min()) for v in values)
        most = max(float(v.max()) for v in values)
        ax.set_ylim(max(0.7 * least, 1e-3), max(1.5 * most, 2.2 * LARGE_MS))


# --- sensitivity ----------------------------------------------------------------------------------


def sensitivity_figure(a: Analysis) -> Figure:
    """Cost over that of the gains as they are, and Ms, over the factor on each setting."""
    figure, axes = panels([3.3], widths=[1, 1], share_x=False)
    cost, peak = axes[0]
    for n, s in enumerate(a.sensitivity):
        factors = np.array([*s.factors, 1.0])
        order = np.argsort(factors)
        percent = 100.0 * (factors[order] - 1.0)
        scores = [*s.scores, a.score]
        look = {
            "color": shade(n, len(a.sensitivity)),
            "ls": _STYLES[n % len(_STYLES)],
            "marker": "osD^vP<>"[n % 8],
            "ms": 4.5,
            "lw": 1.3,
        }
        cost.plot(
            percent, _finite([scores[i].cost / a.score.cost for i in order]), label=s.name, **look
        )
        peak.plot(percent, _finite([scores[i].Ms for i in order]), **look)
    cost.axhline(1.0, color="#555555", lw=0.7)
    _mark(peak)
    peak.set_ylim(top=max(peak.get_ylim()[1], 1.06 * LARGE_MS))
    cost.set_ylabel("cost over that of the controller [1]")
    peak.set_ylabel("largest Ms [1]")
    for ax in (cost, peak):
        ax.set_xlabel("change of the setting [%]")
        ax.set_xticks([100.0 * (f - 1.0) for f in (*a.sensitivity[0].factors, 1.0)])
    figure.legend(*cost.get_legend_handles_labels(), loc="outside upper right", ncols=8)
    return figure


def _finite(values: Sequence[float]) -> list[float]:
    return [v if math.isfinite(v) else math.nan for v in values]


def what_if_figure(a: Analysis) -> Figure:
    """Cost, worst error and Ms on changed plants, one row per change."""
    names = ["as it is", *(w.name for w in a.what_if)]
    scores = [a.score, *(w.score for w in a.what_if)]
    figure, axes = panels([0.32 * len(names) + 1.0], widths=[1, 1, 1], share_x=False)
    unit = lettered(a.controller.gains.y_unit)
    rows: tuple[tuple[str, Any], ...] = (
        (f"cost [{unit}]", lambda s: s.cost),
        (f"worst error [{unit} rms]", lambda s: s.tracking),
        ("Ms [1]", lambda s: s.Ms),
    )
    at = np.arange(len(names), dtype=np.float64)
    for ax, (label, value) in zip(axes[0], rows, strict=True):
        _dots(ax, at, scores, value, start=1.0 if ax is axes[0, 2] else 0.0)
        ax.set_xlabel(label)
        ax.set_yticks(at, names if ax is axes[0, 0] else [""] * len(names))
        ax.invert_yaxis()
        ax.grid(axis="y", visible=False)
    if axes[0, 2].get_xlim()[1] > LARGE_MS:
        axes[0, 2].axvline(LARGE_MS, color=ORANGE, lw=1.0, ls=(0, (4, 2)))
    return figure


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
