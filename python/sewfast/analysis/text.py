"""An analysis as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .points import LoopBode
from .responses import Responses
from .sensitivity import Score

if TYPE_CHECKING:
    from .analysis import Analysis


def text(a: Analysis) -> str:
    """Margins, steps, cost, sensitivities, what-if, guards."""
    y, u = a.controller.gains.y_unit, a.controller.gains.u_unit
    lines = [f"Analysis on {_plants(a.plants)}", "", "margins (worst plant)"]
    lines += rows([["about", "Ms", "Mt", "gain", "phase", "delay", "noise gain"]]
                  + [_margin_row(loop, u, y) for loop in a.loops])  # fmt: skip
    lines += ["", *(_response_line(r) for r in a.responses)]
    lines += ["", f"cost on {', '.join(a.references)}"]
    head = ["", "cost", f"error [{y} rms]", "overshoot", f"chatter [{u} rms]", "Ms"]
    table = [head, ["as it is", *_cells(a.score)]]
    table += [
        [f"{s.name} {100 * (f - 1):+.0f} %", *_cells(score)]
        for s in a.sensitivity
        for f, score in zip(s.factors, s.scores, strict=True)
    ]
    table += [[w.name, *_cells(w.score)] for w in a.what_if]
    lines += [*rows(table), ""]
    lines.append(str(a.judgement) if a.judgement is not None else "a loop runs away")
    return "\n".join(lines)


def _plants(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} plants, {names[0]} to {names[-1]}"


def _margin_row(loop: LoopBode, u: str, y: str) -> list[str]:
    m = loop.worst
    about = f"{loop.level:.4g} {y}"
    if not m.stable:
        return [about, "unstable", "", "", "", "", ""]
    return [
        about, f"{m.Ms:.3f}", f"{m.Mt:.3f}", f"{m.gain_margin:.3g}",
        f"{m.phase_margin_deg:.1f} deg", f"{1e3 * m.delay_margin_s:.3g} ms",
        f"{m.noise_gain:.3g} {u}/{y}",
    ]  # fmt: skip


def _response_line(r: Responses) -> str:
    found = r.metrics()
    if r.kind == "reference":
        return (
            f"reference step of {r.size:.4g} {r.y_unit} at {r.level:.4g} {r.y_unit}: "
            f"rise {span([m['rise_ms'] for m in found])} ms, overshoot "
            f"{span([m['overshoot_percent'] for m in found])} %, settled within "
            f"{span([m['settling_ms'] for m in found])} ms"
        )
    return (
        f"disturbance worth {r.disturbance:.3g} {r.u_unit} at the plant's input: "
        f"{span([m['peak'] for m in found])} {r.y_unit} off, back within "
        f"{span([m['recovery_ms'] for m in found])} ms"
    )


def span(values: Sequence[float | None]) -> str:
    """The smallest and the largest of the plants'."""
    known = [v for v in values if v is not None]
    if not known:
        return "-"
    low, high = f"{min(known):.3g}", f"{max(known):.3g}"
    shown = low if low == high else f"{low} to {high}"
    return shown if len(known) == len(values) else f"{shown} (not all)"


def _cells(s: Score) -> list[str]:
    numbers = [s.cost, s.tracking, s.overshoot_percent, s.chatter, s.Ms]
    shown = [
        "-" if math.isnan(v) else "runs away" if math.isinf(v) else f"{v:.4g}" for v in numbers
    ]
    return [*shown[:2], f"{shown[2]} %" if math.isfinite(numbers[2]) else shown[2], *shown[3:]]


def rows(cells: Sequence[Sequence[str]]) -> list[str]:
    """Columns as wide as they need to be; the first to the left, numbers to the right."""
    widths = [max(len(r[i]) for r in cells) for i in range(len(cells[0]))]
    return [
        "  " + r[0].ljust(widths[0]) + "".join(
            f"  {c.rjust(w)}" for c, w in zip(r[1:], widths[1:], strict=True)
        )
        for r in cells
    ]  # fmt: skip
