"""`analyse`: responses, margins and sensitivities of a controller on models or a machine."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import storage
from ..arrays import in_unit
from ..control.controller import Controller
from ..control.defaults import default_references
from ..control.loop import (
    Plants,
    References,
    check_fits,
    each_plant,
    each_reference,
    require_controller,
    titles,
)
from ..control.systems import LinearLoop
from ..errors import FitError, SettingError
from ..evidence.card import Line
from ..tables import Table
from ..trust import Judgement, Limits, judge
from ..tuning.objective import LARGEST_MS, Cost
from ..tuning.robustness import HAIR
from ..tuning.verdict import LIVELY
from ..units import duration, time_unit
from .changes import Change
from .points import LoopBode, PlantPoint, loop_bodes, plant_points, recorded_way
from .responses import (
    Responses,
    Steps,
    default_steps,
    each_change,
    finite_each,
    required,
    responses,
)
from .sensitivity import GainSensitivity, Score, Task, WhatIf, gain_sensitivity, what_if

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMAT = "sewfast.analysis"
VERSION = 1
REFERENCES = ("trapezoid", "random")


@dataclass(frozen=True, eq=False, repr=False)
class Analysis:
    """A controller's behaviour on plants, and its sensitivity to small changes.

    Attributes
    ----------
    controller : Controller
    plants, references : tuple of str
        The names of the plants and references.
    loops : tuple of LoopBode
        L, S, T and margins, per operating point.
    main : int
        Index of the loop used for the steps and the sensitivities.
    responses : tuple of Responses
        Reference step and disturbance step; empty if the loop is unstable.
    score : Score
        Cost on the references, worst error and overshoot, Ms.
    sensitivity : tuple of GainSensitivity
    what_if : tuple of WhatIf
    judgement : Judgement
        Objections to the loops (`sewfast.trust`); a refusal is a line that fails.
    """

    controller: Controller
    plants: tuple[str, ...]
    references: tuple[str, ...]
    loops: tuple[LoopBode, ...]
    main: int
    responses: tuple[Responses, ...]
    score: Score
    sensitivity: tuple[GainSensitivity, ...]
    what_if: tuple[WhatIf, ...]
    judgement: Judgement | None

    @property
    def Ms(self) -> float:
        """The largest peak of |S| over plants and operating points."""
        return max(loop.Ms for loop in self.loops)

    def linear(self, point: int | None = None, plant: int = 0) -> LinearLoop:
        """The linear loop at an operating point (by default the main one): L, S, T as state space.

        `linear().to_control("S")` and `.to_scipy("S")` give the toolboxes' objects.

        Raises
        ------
        SettingError
            For an unknown point or plant.
        """
        point = self.main if point is None else point
        if not 0 <= point < len(self.loops):
            raise SettingError(
                f"expected one of {len(self.loops)} operating points, counted from 0, got {point}"
            )
        row = self.loops[point].points
        if not 0 <= plant < len(row):
            raise SettingError(f"expected one of {len(row)} plants, counted from 0, got {plant}")
        return LinearLoop.of(self.controller, row[plant].system, speed=row[plant].y)

    def figures(self) -> dict[str, Figure]:
        """`responses`, `bode`, `sensitivity`, `what_if`: matplotlib figures.

        Raises
        ------
        SettingError
            If matplotlib is not installed.
        """
        from .figures import figures

        return figures(self)

    def plot(
        self,
        ax: Any = None,
        *,
        figure: str | None = None,
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Draw steps and Bode together, or one figure of `figures` by its name.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`. The panels in reading order are output and command after both
            steps; |L|, |S|, phase of L and |T|; cost and Ms.
        figure : str, optional
            `responses`, `bode`, `sensitivity` or `what_if`.

        Raises
        ------
        SettingError
            For another figure, or as `Drawing.plot`.
        """
        from .figures import drawing

        return drawing(self, figure).plot(ax, file)

    def save(self, folder: str | os.PathLike[str], *, png: bool = True) -> list[Path]:
        """Write `analysis.json` and every figure as SVG, and as PNG, into a folder.

        `sewfast report` shows them if the folder is that of a demo or a commissioning.

        Parameters
        ----------
        folder : path
            Created if it does not exist.
        png : bool
            Whether to write PNGs as well.

        Raises
        ------
        SettingError
            If matplotlib is not installed or the folder cannot be written to.
        """

        return save(self, folder, png=png)

    def to_json(self) -> dict[str, Any]:
        """Every number as JSON values; non-finite numbers are None."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "controller": self.controller.to_dict(),
            "plants": list(self.plants),
            "references": list(self.references),
            "units": {"u": self.controller.gains.u_unit, "y": self.controller.gains.y_unit},
            "Ms": self.Ms if math.isfinite(self.Ms) else None,
            "main": self.main,
            "loops": [loop.to_json() for loop in self.loops],
            "responses": [r.to_json() for r in self.responses],
            "score": self.score.to_json(),
            "sensitivity": [s.to_json() for s in self.sensitivity],
            "what_if": [w.to_json() for w in self.what_if],
            "judgement": self.judgement and self.judgement.to_json(),
        }

    def _repr_html_(self) -> str:
        """A table for a notebook: margins, then the steps and objections to the loop."""
        y, u = self.controller.gains.y_unit, self.controller.gains.u_unit
        table = Table(
            f"Analysis on {_plants(self.plants)}: margins of the worst plant",
            ("about", "Ms", "Mt", "gain margin", "phase margin", "delay margin", "noise gain"),
            tuple(tuple(_margin_row(loop, u, y)) for loop in self.loops),
        )
        steps = [_response_line(r) for r in self.responses]
        return table.to_html(steps) + ("" if self.judgement is None else self.judgement.to_html())

    def __repr__(self) -> str:
        return f"Analysis(Ms {self.Ms:.3g}, {len(self.plants)} plants)"

    def __str__(self) -> str:

        return text(self)


def analyse(
    controller: Controller,
    on: Plants,
    *,
    speeds: Sequence[float] | None = None,
    level: float | None = None,
    step: float | None = None,
    disturbance: float | None = None,
    seconds: float | None = None,
    references: References = None,
    cost: Cost | None = None,
    changes: Sequence[Change] | None = None,
    limits: Limits | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> Analysis:
    """Responses, loop transfers, margins, sensitivities and guards of a controller on plants.

    Parameters
    ----------
    controller : Controller
    on : Model, VirtualMachine or sequence of them
        With one input each; every member of an ensemble is a plant.
    speeds : sequence of float, optional
        Steady outputs about which the plants are linearised [y]; by default three within the range
        covered by the first model's training data, of a drive that was recorded in both directions
        one in the other direction. A linear model has one, in the middle of this range or, if it
        covers both directions, half way from rest to its farther end.
    level, step : float, optional
        Output before the steps and size of the reference step [y]; by default the middle of
        `speeds`, and a twentieth of the way from rest to the farther end of the recorded output.
    disturbance : float, optional
        Disturbance step at the plant's input [u]; by default one that would move the output by
        `step` without control. On a virtual machine it is the load torque with the same effect.
    seconds : float, optional
        Duration of the steps; by default five times the slowest closed-loop pole's time
        constant.
    references : str, array of shape (N,), or sequence of them, optional
        References for the cost and the guards; by default `REFERENCES`, over the first plant's own
        range if the catalogue does not suit it, as in `tune`.
    cost : Cost, optional
        As for `sewfast.tune`.
    changes : sequence of Change, optional
        For the what-if; see `sewfast.analysis.sensitivity`.
    limits : Limits, optional
        For the guards.
    seed : int
        Chooses named random references.
    threads : int, optional
        All processors by default; the result is the same at any number.

    Returns
    -------
    Analysis

    Raises
    ------
    SettingError
        For plants with another sample time or units than the controller, or that cannot rest at any
        of `speeds`; for steps of size 0, or times that are not above 0.
    DataError
        For a reference that cannot be used.
    """
    # most members on which gains and plants are varied; an ensemble is sorted, best first
    most = 8
    require_controller(controller, on, "analyse(controller, plants)")
    cost = required("cost", cost, Cost)
    limits = required("limits", limits, Limits)
    changes = each_change(changes)
    speeds = None if speeds is None else finite_each("speeds", speeds)
    plants = each_plant(on)
    if not plants:
        raise SettingError("expected at least one plant to analyse on, got none")
    for plant in plants:
        check_fits(controller, plant)
    names = titles(plants)
    points = plant_points(plants, names, speeds)
    main = _main(points, level)
    slowest = slowest_time(controller, points[main])
    steps = default_steps(
        controller, points[main], slowest,
        level=level, step=step, disturbance=disturbance, seconds=seconds, span=recorded_way(plants),
    )  # fmt: skip
    wanted = each_reference(references, _default_references(controller, plants[0], steps))
    task = Task(
        tuple(plants[:most]), tuple(names[:most]), points[main][:most], tuple(wanted),
        cost, seed,
    )  # fmt: skip
    loops = loop_bodes(controller, points, slowest)
    return Analysis(
        controller=controller,
        plants=tuple(names),
        references=tuple(r if isinstance(r, str) else "reference" for r in wanted),
        loops=loops,
        main=main,
        responses=_responses(controller, plants, names, steps),
        score=task.score(controller),
        sensitivity=gain_sensitivity(controller, task, threads=threads),
        what_if=what_if(controller, task, changes, threads=threads),
        judgement=_judgement(controller, plants, wanted, limits, seed, loops),
    )


def _main(points: Sequence[Sequence[PlantPoint]], level: float | None) -> int:
    """Index of the operating point nearest to the level of the steps; by default the middle one."""
    if level is None:
        return len(points) // 2
    return int(np.argmin([abs(row[0].y - level) for row in points]))


def slowest_time(controller: Controller, row: Sequence[PlantPoint]) -> float:
    """The slowest closed-loop time constant of all plants [s]; 100 samples for unstable loops."""
    sizes = [
        abs(LinearLoop.of(controller, p.system, speed=p.y).poles()[0]) for p in row
    ]  # fmt: skip
    largest = max(sizes, default=0.0)
    if not 1e-6 < largest < 1.0 - 1e-9:
        return 100.0 * controller.Ts
    return float(-controller.Ts / math.log(largest))


def _default_references(controller: Controller, plant: Any, steps: Steps) -> Sequence[Any]:
    """Those of `tune`, so that both judge the same loop; the steps for a plant without any."""
    try:
        return default_references(plant, controller, REFERENCES)
    except (FitError, SettingError):
        n = steps.samples
        return [np.concatenate([np.full(n, steps.level), np.full(n, steps.level + steps.step)])]


def _responses(
    controller: Controller, plants: Sequence[Any], names: Sequence[str], steps: Steps
) -> tuple[Responses, ...]:
    try:
        return responses(controller, plants, names, steps)
    except FitError:
        return ()


def _judgement(
    controller: Controller, plants: Sequence[Any], references: Any, limits: Limits | None,
    seed: int, loops: Sequence[LoopBode],
) -> Judgement | None:  # fmt: skip
    """Objections to margins and loops; None if a loop diverges, which the score shows."""
    try:
        found = judge(controller, plants, references, limits=limits, seed=seed, refuse=False)
    except FitError:
        return None
    return replace(found, lines=(_margins_line(loops, controller.y_unit), *found.lines))


def _margins_line(loops: Sequence[LoopBode], unit: str) -> Line:
    """Is the loop far enough from instability, by the limits of `tune`?"""
    worst = max(loops, key=lambda loop: loop.Ms)
    name, limit = "margins", f"Ms <= {LARGEST_MS:g}"
    place = f"about {in_unit(f'{worst.level:.4g}', unit)}"
    if not worst.worst.stable:
        text = "the linear loop is unstable: lower the gains, or identify again"
        return Line(name, math.inf, f"unstable {place}", limit, "fail", text)
    shown = f"Ms {worst.Ms:.3g}, {worst.worst.phase_margin_deg:.3g} deg {place}"
    if worst.Ms <= HAIR * LARGEST_MS:
        text = "the loop keeps its distance from instability"
        return Line(name, worst.Ms, shown, limit, "ok", text)
    if worst.Ms <= HAIR * LIVELY:
        text = "the loop is lively: an older belt or a longer delay makes it ring"
        return Line(name, worst.Ms, shown, limit, "info", text)
    text = (
        "the loop is close to instability and rings at one frequency; lower the gains, tune again, "
        "or take delay out of the loop"
    )
    return Line(name, worst.Ms, shown, limit, "warn", text)


# --- An analysis as text --------------------------------------------------------------------------


def text(a: Analysis) -> str:
    """Margins, steps, cost, sensitivities, what-if, guards."""
    # y and u stand for unknown units, as in the units of gains
    y, u = a.controller.gains.y_unit or "y", a.controller.gains.u_unit or "u"
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
    lines.append(str(a.judgement) if a.judgement is not None else "a loop diverges")
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
        f"{m.phase_margin_deg:.1f} deg", duration(m.delay_margin_s, 3),
        f"{m.noise_gain:.3g} {u}/{y}",
    ]  # fmt: skip


def _response_line(r: Responses) -> str:
    found = r.metrics()
    if r.kind == "reference":
        return (
            f"reference step of {in_unit(f'{r.size:.4g}', r.y_unit)} at "
            f"{in_unit(f'{r.level:.4g}', r.y_unit)}: rise {times([m['rise_ms'] for m in found])}, "
            f"overshoot {span([m['overshoot_percent'] for m in found])} %, settled within "
            f"{times([m['settling_ms'] for m in found])}"
        )
    return (
        f"disturbance worth {in_unit(f'{r.disturbance:.3g}', r.u_unit)} at the plant's input: "
        f"{span([m['peak'] for m in found])} {r.y_unit} off, back within "
        f"{times([m['recovery_ms'] for m in found])}"
    )


def times(values: Sequence[float | None]) -> str:
    """The range of times [ms] as text, in the unit that suits the longest."""
    factor, unit = time_unit(max((1e-3 * v for v in values if v is not None), default=0.0))
    return f"{span([None if v is None else factor * 1e-3 * v for v in values])} {unit}"


def span(values: Sequence[float | None]) -> str:
    """The range of the plants' values as text."""
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
    """Rows of text in aligned columns: the first to the left, numbers to the right."""
    widths = [max(len(r[i]) for r in cells) for i in range(len(cells[0]))]
    return [
        "  " + r[0].ljust(widths[0]) + "".join(
            f"  {c.rjust(w)}" for c, w in zip(r[1:], widths[1:], strict=True)
        )
        for r in cells
    ]  # fmt: skip


# --- An analysis in a folder: `analysis.json`, and every figure as PNG and SVG --------------------


NUMBERS = "analysis.json"
FOLDER = "analysis"
"""Folder of the figures, within that of the numbers."""
ALT = {
    "responses": "Output and command over time after a step of the reference and after a step of a "
    "disturbance; the band holds all plants",
    "bode": "Gain and phase of L and gains of S and T over frequency, with bands over the plants",
    "sensitivity": "Cost and largest Ms over the change of each setting in percent",
    "what_if": "Cost, worst error and Ms on plants that are not as identified",
}


def save(a: Analysis, folder: str | os.PathLike[str], *, png: bool = True) -> list[Path]:
    """Write everything, the PNGs optionally (the report does not use them); return the files."""
    from ..plotting import style, svg
    from .figures import figures

    drawn = figures(a, page=True)

    place = Path(folder) / FOLDER
    contents: dict[Path, bytes] = {}
    try:
        with storage.making(place):
            for name, figure in drawn.items():
                with style():
                    text = svg(figure, f"analysis-{name}", ALT[name])
                    if png:
                        content = io.BytesIO()
                        # `svg` leaves its canvas, whose own format is SVG
                        figure.savefig(content, format="png", dpi=150)
                        contents[place / f"{name}.png"] = content.getvalue()
                contents[place / f"{name}.svg"] = text.encode()
            storage.replace_files(contents)
        target = Path(folder) / NUMBERS
        values = {k: v for k, v in a.to_json().items() if k not in ("format", "version")}
        storage.write(target, "sewfast.analysis", 1, {**values, "figures": list(drawn)})
    except OSError as e:
        raise SettingError(
            f"{folder}: expected a folder to write to, received {e.strerror!r}; choose another"
        ) from e
    return [target, *contents]
