"""Figures of closed loops: runs, and what speaks against them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...plotting import (
    Picture,
    Table,
    Trace,
    draw,
    loop_drawing,
    loop_panels,
    milliseconds,
    percent,
    rpm,
    stacked,
    svg,
    volt,
)
from .. import labels
from ..artefacts import Artefacts, Columns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- The report card's figures: drawn when the card was made, read as they are --------------------


CAPTIONS = {
    "residuals": (
        "What is left in the residual",
        "Correlations of the free-run residual with its past, with past inputs, their squares and "
        "cubes, powers of the computed output, squares and products; grey bands hold 99 % of the "
        "single correlations of a perfect model",
        "One verdict per panel judges all its lags together. In 20,000 samples small dependences "
        "are certain: the table says what each is worth.",
    ),
    "bands": (
        "Where samples are to be expected",
        "Measured speed in the 95 % band about the free run, and the error in the same band",
        "The band holds the residual's spread and the parameters' uncertainty, both from the "
        "training data alone.",
    ),
    "bode": (
        "Small signals over the operating range",
        "Gain and phase of the network linearised about constant commands from low to high",
        "Where the curves part the plant changes with the operating point.",
    ),
    "poles": (
        "Poles, steady output, gain and time constant over the command",
        "Poles in the unit circle; steady speed, steady gain and slowest time constant over the "
        "constant command",
        "All poles lie inside the circle where the model is stable.",
    ),
    "region": (
        "Is the model used where it has been trained?",
        "Distance of every sample from the training region; values above 1 lie outside",
        "Outside the green area no training sample was like it.",
    ),
}
"""Title, what a reader sees, what to look at."""


def trust_pictures(artefacts: Artefacts) -> list[Picture]:
    """The figures of the report card that the folder holds."""
    letters = iter("CDEFG")
    return [
        Picture(f"trust-{name}", f"Check {next(letters)}", *CAPTIONS[name], svg=svg)
        for name, svg in artefacts.drawn.items()
    ]


# --- Closed loops: the paper's Fig. 19 to 22, and what the paper's own gains do -------------------


_LOOPS = (("19", "trapezoid"), ("20", "chirp_hi_lo"), ("21", "chirp_lo_hi"), ("22", "random"))

_PURPOSE = {
    "trapezoid": "The hardest reference: 0 to 3,000 RPM in 150 ms, sharper than anything in the "
    "chirps.",
    "chirp_hi_lo": "A swing of shrinking amplitude and growing frequency, up to 2,000 RPM.",
    "chirp_lo_hi": "A swing of growing amplitude and growing frequency, up to 600 RPM.",
    "random": "Levels between 200 and 2,000 RPM at random.",
}

_MAGNIFIED = 0.4
"""Width of the magnified rise [s]."""


def loop_pictures(artefacts: Artefacts) -> list[Picture]:
    """Fig. 19 to 22: the tuned controller on the model and on the machine."""
    return [_tuned(artefacts, number, reference) for number, reference in _LOOPS]


def paper_gain_pictures(artefacts: Artefacts) -> list[Picture]:
    """Fig. C and D: the paper's gains on the plant of its Eq. 8 and on the virtual machine."""
    return [
        _paper_gains(
            artefacts, "C", "eq8", "on the plant of Eq. 8",
            "Speed fed back without an encoder, command limited to ±10 V, integral stopped while "
            "limited. The command switches from limit to limit: the loop leans on the limit.",
        ),
        _paper_gains(
            artefacts, "D", "machine", "on the virtual machine",
            "Encoder counts differenced as in the paper, command limited to ±10 V. One count in a "
            "sample is 38 RPM, which Kd = 0.5 V/RPM turns into 19 V.",
        ),
    ]  # fmt: skip


def _tuned(artefacts: Artefacts, number: str, reference: str) -> Picture:
    runs = {p: artefacts.runs[reference, p] for p in ("model", "machine")}
    names = {"model": "predicted", "machine": "on the machine"}
    title = f"Closed loop, {labels.REFERENCE[reference]} reference"
    key = f"fig-{number}"
    alt = f"{title}: reference, speed on model and machine, tracking error and command over time"
    caption = (
        f"{_PURPOSE[reference]} The same controller code runs on the identified networks "
        "(prediction) and on the virtual machine."
    )
    figure = _loop_figure(runs, names, magnified=reference == "trapezoid")
    return Picture(
        key, f"Fig. {number}", title, alt, caption, svg(figure, key, alt),
        _tuned_numbers(artefacts, reference),
    )  # fmt: skip


def _paper_gains(
    artefacts: Artefacts, number: str, plant: str, where: str, caption: str
) -> Picture:
    title = f"The paper's gains {where}"
    key = f"fig-{number.lower()}"
    alt = f"{title}: reference and speed, tracking error and command over time"
    runs = {"measured": artefacts.runs["paper_gains", plant]}
    figure = _loop_figure(runs, {"measured": where}, magnified=True)
    numbers = _numbers(artefacts, {where: f"paper_gains.{plant}"}, with_step=True)
    return Picture(key, f"Fig. {number}", title, alt, caption, svg(figure, key, alt), numbers)


def _loop_figure(runs: dict[str, Columns], names: dict[str, str], *, magnified: bool) -> Figure:
    traces = [Trace.of(run, look, names[look]) for look, run in runs.items()]
    if not magnified:
        return loop_drawing(traces, "RPM", "V").figure()
    output, error, command = loop_panels(traces, "RPM", "V")
    window = _rise(traces[0])

    def whole(ax: Axes) -> None:
        output(ax)
        ax.axvspan(window[0], window[1], color="#f3ead2", zorder=0)

    drawing = stacked(
        (whole, lambda ax: _magnify(ax, traces, window), error, command), (2.0, 1.9, 1.2, 1.2),
        share_x=False,
    )  # fmt: skip
    return drawing.figure()


def _rise(trace: Trace) -> tuple[float, float]:
    """A window about the first edge of the reference [s]."""
    start = float(trace.t[int(np.argmax(trace.r > trace.r[0]))]) - 0.1
    return start, start + _MAGNIFIED


def _magnify(ax: Axes, traces: list[Trace], window: tuple[float, float]) -> None:
    """The rise, which lasts a few per cent of the record."""
    for s in reversed(traces):
        inside = (s.t >= window[0]) & (s.t <= window[1])
        draw(ax, s.t[inside], s.y[inside], s.look)
    draw(ax, s.t[inside], s.r[inside], "reference")
    ax.set_title("magnified: the rise", pad=3)
    ax.set_ylabel("speed [RPM]")
    ax.set_xlabel("time [s]")
    ax.margins(x=0.01)


def _tuned_numbers(artefacts: Artefacts, reference: str) -> Table:
    path = f"control.{reference}"
    plants = {"identified model": f"{path}.model", "machine": f"{path}.machine"}
    apart = rpm(artefacts.number(f"{path}.model_vs_machine_rmse_rpm"))
    caption = f"Model against machine: {apart} rms."
    if reference == "trapezoid":
        rise = milliseconds(artefacts.number(f"{path}.reference_rise_time_ms"))
        caption += f" The reference itself rises within {rise}."
    return _numbers(artefacts, plants, with_step=reference == "trapezoid", caption=caption)


def _numbers(
    artefacts: Artefacts, plants: dict[str, str], *, with_step: bool, caption: str = ""
) -> Table:
    columns = {"tracking error (rms)": ("rmse_rpm", rpm)}
    if with_step:
        columns["10–90 % rise"] = ("rise_time_ms", milliseconds)
        columns["overshoot"] = ("overshoot_percent", percent)
    columns["command (rms)"] = ("effort_v", volt)
    columns["its change per sample (rms)"] = ("chatter_v", volt)
    rows = tuple(
        (name, *(text(artefacts.number(f"{path}.{key}")) for key, text in columns.values()))
        for name, path in plants.items()
    )
    return Table(caption, ("plant", *columns), rows)
