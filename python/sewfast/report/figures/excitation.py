"""Excitations and the machine's responses: the paper's Fig. 2 to 5, scaled in Fig. 7 and 12."""

from __future__ import annotations

import numpy as np

from ...plotting import Float, Picture, Table, draw, legend, panels, percent, rpm, significant, svg
from ..artefacts import Artefacts, Columns

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
    """Fig. 7, the training data, and Fig. 12, the random test data, as the network sees them."""
    return {
        "7": _scaled(artefacts.recordings["chirp_lo_hi"], "7", "Training data, scaled"),
        "12": _scaled(artefacts.recordings["random"], "12", "Random test data, scaled"),
    }


def _recorded(artefacts: Artefacts, number: str, record: str, title: str) -> Picture:
    columns = artefacts.recordings[record]
    figure, axes = panels([2.1, 1.25])
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
    facts = [
        ("samples", f"{len(columns['t']):,} at 1 ms"),
        ("command", f"{_range(columns['u'])} V"),
        ("true speed", f"{_range(columns['speed_true'])} RPM"),
    ]
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
        facts.append(("rms error of the speed", rpm(float(np.sqrt(np.mean(error**2))))))
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
    figure, axes = panels([1.5, 1.5])
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
