"""The figures of the report, each with its number in the paper and a table of its values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..plotting import (
    LOOKS,
    Float,
    Picture,
    Trace,
    apart_panel,
    draw,
    legend,
    loop_drawing,
    loop_panels,
    panels,
    stacked,
    svg,
    thin,
)
from ..tables import Table, milliseconds, percent, rpm, significant, volt
from . import artefacts as labels
from .artefacts import Artefacts, Columns, record_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- Excitations and responses: Fig. 2 to 5, scaled in Fig. 7 and 12 ------------------------------


THIRD = 4.2
"""Width of a figure with two others beside it [inch]."""

_RECORDED = (
    ("2", "step", "Step command and response"),
    ("3", "chirp_lo_hi", "Chirp Lo-Hi: amplitude and frequency grow"),
    ("4", "chirp_hi_lo", "Chirp Hi-Lo: amplitude shrinks while frequency grows"),
    ("5", "random", "Random command and response"),
)

_USE = {
    "step": "Its response gives gain, time constant and dead time for the first controller gains.",
    "chirp_lo_hi": "The only record that the paper's network, ARX and linear output error learn "
    "from.",
    "chirp_hi_lo": "Never trained on: this record tests every model.",
    "random": "Never trained on: this record tests every model.",
}


def recorded_pictures(artefacts: Artefacts) -> list[Picture]:
    """Fig. 2 to 5: command and speed over time."""
    return [_recorded(artefacts, *row) for row in _RECORDED]


def scaled_pictures(artefacts: Artefacts) -> dict[str, Picture]:
    """Fig. 7, the training data, and Fig. 12, the random test data, scaled for the network."""
    return {
        "7": _scaled(artefacts.recordings["chirp_lo_hi"], "7", "Training data, scaled"),
        "12": _scaled(artefacts.recordings["random"], "12", "Random test data, scaled"),
    }


def _recorded(artefacts: Artefacts, number: str, record: str, title: str) -> Picture:
    columns = artefacts.recordings[record]
    figure, axes = panels([1.4, 1.0], width=THIRD)
    speed, command = axes[:, 0]
    draw(speed, columns["t"], columns["y"], "measured", "speed from encoder counts")
    if record == "step":
        draw(speed, columns["t"], _first_order(artefacts, columns), "model", "first order + delay")
        speed.set_xlim(*_window_of_step(columns))
    legend(speed)
    speed.set_ylabel("speed [RPM]")
    draw(command, columns["t"], columns["u"], "command")
    command.set_ylabel("command [V]")
    command.set_xlabel("time [s]")
    alt = f"Speed in RPM above the command in volt over time, {title.lower()}"
    key = f"fig-{number}"
    return Picture(
        key, f"Fig. {number}", title, alt, _USE[record], svg(figure, key, alt),
        _numbers(artefacts, record),
    )  # fmt: skip


def _numbers(artefacts: Artefacts, record: str) -> Table:
    columns = artefacts.recordings[record]
    facts = [("samples", f"{len(columns['t']):,} at 1 ms")]
    if record == "step":
        k, t, delay = (artefacts.number(f"fopdt.{n}") for n in "KTL")
        facts += [
            ("gain K", f"{significant(k)} RPM/V"),
            ("time constant T", f"{significant(1e3 * t if t else t)} ms"),
            ("dead time L", f"{significant(1e3 * delay if delay else delay)} ms"),
            ("fit of Eq. 10", percent(artefacts.number("fopdt.fit_percent"), 1)),
        ]
    else:
        error = columns["y"] - columns["speed_true"]
        facts += [
            ("command", f"{_range(columns['u'])} V"),
            ("true speed", f"{_range(columns['speed_true'])} RPM"),
            ("rms error of the speed", rpm(float(np.sqrt(np.mean(error**2))))),
        ]
    return Table("", tuple(name for name, _ in facts), (tuple(text for _, text in facts),))


def _range(values: Float) -> str:
    low, high = float(values.min()), float(values.max())
    return f"{low:,.4g} to {high:,.4g}".replace("-", "−")


def _first_order(artefacts: Artefacts, columns: Columns) -> Float:
    """The fitted step response of the paper's Eq. 11."""
    k, time_constant, delay, offset, low, high = (
        float(artefacts.number(f"fopdt.{n}") or 0.0)
        for n in ("K", "T", "L", "offset", "u_low", "u_high")
    )
    t, u = columns["t"], columns["u"]
    since = t - t[int(np.argmax(u > 0.5 * (low + high)))] - delay
    rising = 1.0 - np.exp(-np.maximum(since, 0.0) / max(time_constant, 1e-9))
    return np.asarray(offset + k * (low + (high - low) * rising), dtype=np.float64)


def _window_of_step(columns: Columns) -> tuple[float, float]:
    """From shortly before the step to its settling."""
    at = columns["t"][int(np.argmax(np.abs(np.diff(columns["u"]))))]
    return max(float(at) - 0.2, float(columns["t"][0])), min(
        float(at) + 2.0, float(columns["t"][-1])
    )


def _scaled(columns: Columns, number: str, title: str) -> Picture:
    figure, axes = panels([1.2, 1.2], width=THIRD)
    k = np.arange(len(columns["t"]), dtype=np.float64)
    for ax, values, label in (
        (axes[0, 0], columns["u"] / 10.0, "voltage / 10 V"),
        (axes[1, 0], columns["y"] / 1000.0, "speed / 1000 RPM"),
    ):
        draw(ax, k, values, "measured")
        ax.margins(x=0.01)
        ax.set_ylabel(label)
    axes[1, 0].set_xlabel("sample number k (1 ms each)")
    alt = f"Scaled voltage above scaled speed over the sample number: {title.lower()}"
    caption = (
        "Voltage divided by 10 and speed by 1,000: the units in which the paper's network "
        "computes and in which its cost J is stated."
    )
    key = f"fig-{number}"
    return Picture(key, f"Fig. {number}", title, alt, caption, svg(figure, key, alt))


# --- Predictions and the machine's speed: the paper's Fig. 8 to 11 and 13 to 15 ----------------


_BESIDE = ("paper", "neural_oe", "oe")


@dataclass(frozen=True)
class _Case:
    """A record, the paper's numbers of its two figures and its purpose."""

    record: str
    free_run: str
    errors: str
    purpose: str


_CASES = (
    _Case("chirp_lo_hi", "8", "9", "the training data"),
    _Case("chirp_hi_lo", "10", "11", "the Hi-Lo chirp, never trained on"),
    _Case("random", "13", "14", "the random record, never trained on"),
    # the paper has no such record: the current limit cuts the acceleration off
    _Case("saturating", "A", "B", "a record in which the drive saturates, never trained on"),
)


def prediction_pictures(artefacts: Artefacts) -> dict[str, list[Picture]]:
    """For each scored record: the networks in free run and their errors, over time and binned."""
    return {case.record: [_free_run(artefacts, case), _errors(artefacts, case)] for case in _CASES}


def arx_picture(artefacts: Artefacts) -> Picture:
    """Fig. 15: the linear models on the Hi-Lo chirp."""
    case = _Case("chirp_hi_lo", "15", "", "the Hi-Lo chirp")
    return _compared(
        artefacts, case, ("arx_raw", "arx", "oe"), "The linear rivals on the Hi-Lo chirp",
        "All are linear with the paper's orders and learn from the Lo-Hi chirp. ARX minimises the "
        "one-step error, on differences of counts as in the paper or on the smoother's speed; "
        "output error minimises the free run.",
    )  # fmt: skip


def _free_run(artefacts: Artefacts, case: _Case) -> Picture:
    return _compared(
        artefacts, case, ("paper", "neural_oe"), f"Free run on {case.purpose}",
        "Grey: the machine. Below, the two seconds around the paper network's largest error.",
    )  # fmt: skip


def _compared(
    artefacts: Artefacts, case: _Case, models: tuple[str, ...], title: str, caption: str
) -> Picture:
    columns = artefacts.recordings[record_of(case.record)]
    t, truth = columns["t"], columns["speed_true"]
    predicted = {m: artefacts.predictions[case.record][f"{m}_simulation"] for m in models}
    figure, axes = panels([1.3, 1.3], share_x=False)
    window = _worst(t, truth - predicted[models[0]])
    for ax, inside in ((axes[0, 0], np.ones(len(t), dtype=bool)), (axes[1, 0], window)):
        draw(ax, t[inside], truth[inside], "truth", "machine")
        for m in models:
            draw(ax, t[inside], predicted[m][inside], m, labels.MODEL[m])
        ax.set_ylabel("speed [RPM]")
        ax.margins(x=0.01)
    axes[0, 0].axvspan(t[window][0], t[window][-1], color="#f3ead2", zorder=0)
    axes[1, 0].set_title("magnified: the shaded window", pad=3)
    axes[1, 0].set_xlabel("time [s]")
    legend(axes[0, 0], 3)
    alt = f"{title}: speed of the machine and of {_names(models)} over time, whole and magnified"
    key = f"fig-{case.free_run.lower()}"
    return Picture(
        key, f"Fig. {case.free_run}", title, alt, caption, svg(figure, key, alt),
    )  # fmt: skip


def _errors(artefacts: Artefacts, case: _Case) -> Picture:
    columns = artefacts.recordings[record_of(case.record)]
    t, truth = columns["t"], columns["speed_true"]
    predicted = artefacts.predictions[case.record]
    errors = {m: truth - predicted[f"{m}_simulation"] for m in _BESIDE}
    figure, axes = panels([0.88] * len(errors), widths=[4.2, 1.0])
    for row, (m, error) in zip(axes, errors.items(), strict=True):
        limit = 1.05 * max(float(np.abs(error).max()), 1e-9)
        _series(row[0], t, error, m, limit)
        _histogram(row[1], error, m, limit)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("samples [%]")
    title = f"Errors over {case.purpose}"
    alt = f"{title}: free-run error series and histograms of {_names(_BESIDE)}"
    caption = "True speed minus free run, each with its own scale; right: share of samples."
    key = f"fig-{case.errors.lower()}"
    return Picture(key, f"Fig. {case.errors}", title, alt, caption, svg(figure, key, alt))


def _series(ax: Any, t: Float, error: Float, model: str, limit: float) -> None:
    ax.plot(*thin(t, error), color=LOOKS[model]["color"], lw=0.8)
    ax.axhline(0.0, color="#555555", lw=0.7)
    ax.set_ylim(-limit, limit)
    ax.set_ylabel("error [RPM]")
    rms = float(np.sqrt(np.mean(error**2)))
    ax.set_title(f"{labels.MODEL[model]}: {rpm(rms)} rms", pad=3)
    ax.margins(x=0.01)


def _histogram(ax: Any, error: Float, model: str, limit: float) -> None:
    share = np.full(len(error), 100.0 / len(error))
    ax.hist(
        error, bins=np.linspace(-limit, limit, 41), weights=share, orientation="horizontal",
        color=LOOKS[model]["color"],
    )  # fmt: skip
    ax.set_ylim(-limit, limit)
    ax.set_yticklabels([])


def _worst(t: Float, error: Float) -> Any:
    """The window around the largest error."""
    # width of the magnified window [s]
    width = min(2.0, float(t[-1] - t[0]) / 3)
    start = float(t[int(np.argmax(np.abs(error)))]) - 0.5 * width
    start = min(max(start, float(t[0])), float(t[-1]) - width)
    return (t >= start) & (t <= start + width)


def _names(models: tuple[str, ...]) -> str:
    return " and ".join(labels.MODEL[m] for m in models)


# --- The report card's figures, read from their files ---------------------------------------------


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
"""Title, description and caption."""


def trust_pictures(artefacts: Artefacts) -> list[Picture]:
    """The figures of the report card in the folder."""
    letters = iter("CDEFG")
    return [
        Picture(f"trust-{name}", f"Check {next(letters)}", *CAPTIONS[name], svg=svg)
        for name, svg in artefacts.drawn.items()
    ]


# --- Closed loops: the paper's Fig. 19 to 22, and the loops of the paper's own gains --------------


_LOOPS = (("19", "trapezoid"), ("20", "chirp_hi_lo"), ("21", "chirp_lo_hi"), ("22", "random"))

_PURPOSE = {
    "trapezoid": "The hardest reference: 0 to 3,000 RPM in 150 ms, sharper than anything in the "
    "chirps.",
    "chirp_hi_lo": "A swing of shrinking amplitude and growing frequency, up to 2,000 RPM.",
    "chirp_lo_hi": "A swing of growing amplitude and growing frequency, up to 600 RPM.",
    "random": "Levels between 200 and 2,000 RPM at random.",
}


def opening_picture(artefacts: Artefacts) -> Picture:
    """The main result: the trapezoid as predicted and as measured, and what is between them."""
    names = {"model": "predicted on the model", "machine": "measured on the machine"}
    traces = [
        Trace.of(artefacts.runs["trapezoid", plant], plant, label) for plant, label in names.items()
    ]
    caption = "Fig. 19 shows the tracking error and the command of the same run."
    return hero(traces, "A trapezoid of 3,000 RPM", caption)


def hero(traces: list[Trace], title: str, caption: str) -> Picture:
    """The first picture of a report: a loop as predicted and as measured, with the difference."""
    output, _, _ = loop_panels(traces, "RPM", "V")
    rows, heights = [output], [2.2]
    if len(traces) > 1:
        rows.append(apart_panel(traces[0], traces[1], "RPM"))
        heights.append(1.1)
    # width of the first picture [inch], which has a page's width for itself
    figure = stacked(rows, heights).figure(12.0)
    alt = f"{title}: reference, predicted and measured speed, below measured minus predicted"
    return Picture("opening", "", title, alt, caption, svg(figure, "opening", alt))


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
    caption = _PURPOSE[reference]
    figure = _loop_figure(runs, names, magnified=reference == "trapezoid")
    return Picture(
        key, f"Fig. {number}", title, alt, caption, svg(figure, key, alt),
    )  # fmt: skip


def _paper_gains(
    artefacts: Artefacts, number: str, plant: str, where: str, caption: str
) -> Picture:
    title = f"The paper's gains {where}"
    key = f"fig-{number.lower()}"
    alt = f"{title}: reference and speed, tracking error and command over time"
    runs = {"measured": artefacts.runs["paper_gains", plant]}
    figure = _loop_figure(runs, {"measured": where}, magnified=True)
    numbers = _metric_table(artefacts, {where: f"paper_gains.{plant}"}, with_step=True)
    return Picture(key, f"Fig. {number}", title, alt, caption, svg(figure, key, alt), numbers)


def _loop_figure(runs: dict[str, Columns], names: dict[str, str], *, magnified: bool) -> Figure:
    traces = [Trace.of(run, look, names[look]) for look, run in runs.items()]
    if not magnified:
        return loop_drawing(traces, "RPM", "V", heights=(1.9, 1.0, 1.0)).beside()
    output, error, command = loop_panels(traces, "RPM", "V")
    window = _rise(traces[0])

    def whole(ax: Axes) -> None:
        output(ax)
        ax.axvspan(window[0], window[1], color="#f3ead2", zorder=0)

    drawing = stacked(
        (whole, lambda ax: _magnify(ax, traces, window), error, command), (1.4, 1.3, 0.9, 0.9),
        share_x=False,
    )  # fmt: skip
    return drawing.beside()


def _rise(trace: Trace) -> tuple[float, float]:
    """A window about the first edge of the reference [s]."""
    start = float(trace.t[int(np.argmax(trace.r > trace.r[0]))]) - 0.1
    # width of the magnified rise [s]
    return start, start + 0.4


def _magnify(ax: Axes, traces: list[Trace], window: tuple[float, float]) -> None:
    """Draw the rise, which is only a small part of the record."""
    for s in reversed(traces):
        inside = (s.t >= window[0]) & (s.t <= window[1])
        draw(ax, s.t[inside], s.y[inside], s.look)
    draw(ax, s.t[inside], s.r[inside], "reference")
    ax.set_title("magnified: the rise", pad=3)
    ax.set_ylabel("speed [RPM]")
    ax.set_xlabel("time [s]")
    ax.margins(x=0.01)


def _metric_table(
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
