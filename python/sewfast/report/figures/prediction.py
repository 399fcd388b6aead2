"""Predictions beside the machine's speed: the paper's Fig. 8 to 11 and 13 to 15."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...plotting import LOOKS, Float, Picture, Table, draw, legend, panels, percent, rpm, svg, thin
from .. import labels
from ..artefacts import Artefacts, record_of

_ZOOM = 2.0
"""Width of the magnified window [s]."""

_BESIDE = ("paper", "neural_oe", "oe")


@dataclass(frozen=True)
class _Case:
    """A record, the paper's numbers of its two figures and what it is for."""

    record: str
    free_run: str
    errors: str
    purpose: str


_CASES = (
    _Case("chirp_lo_hi", "8", "9", "the training data"),
    _Case("chirp_hi_lo", "10", "11", "the Hi-Lo chirp, never trained on"),
    _Case("random", "13", "14", "the random record, never trained on"),
    _Case("saturating", "A", "B", "the second saturating record, never trained on"),
)


def prediction_pictures(artefacts: Artefacts) -> dict[str, list[Picture]]:
    """Per scored record: the networks in free run, then their errors as series and histogram."""
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
        "Light grey: the machine's true speed. Dark: the networks, which see the command alone. "
        "Below, magnified, the two seconds around the largest error of the paper's network.",
    )  # fmt: skip


def _compared(
    artefacts: Artefacts, case: _Case, models: tuple[str, ...], title: str, caption: str
) -> Picture:
    columns = artefacts.recordings[record_of(case.record)]
    t, truth = columns["t"], columns["speed_true"]
    predicted = {m: artefacts.predictions[case.record][f"{m}_simulation"] for m in models}
    figure, axes = panels([2.2, 2.2], share_x=False)
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
    legend(axes[0, 0])
    alt = f"{title}: speed of the machine and of {_names(models)} over time, whole and magnified"
    key = f"fig-{case.free_run.lower()}"
    return Picture(
        key, f"Fig. {case.free_run}", title, alt, caption, svg(figure, key, alt),
        _numbers(artefacts, case.record, models, {"free run": "simulation"}),
    )  # fmt: skip


def _errors(artefacts: Artefacts, case: _Case) -> Picture:
    columns = artefacts.recordings[record_of(case.record)]
    t, truth = columns["t"], columns["speed_true"]
    predicted = artefacts.predictions[case.record]
    errors = {m: truth - predicted[f"{m}_simulation"] for m in _BESIDE}
    figure, axes = panels([1.25] * len(errors), widths=[4.2, 1.0])
    for row, (m, error) in zip(axes, errors.items(), strict=True):
        limit = 1.05 * max(float(np.abs(error).max()), 1e-9)
        _series(row[0], t, error, m, limit)
        _histogram(row[1], error, m, limit)
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("samples [%]")
    title = f"Errors over {case.purpose}"
    alt = f"{title}: free-run error series and histograms of {_names(_BESIDE)}"
    caption = (
        "True speed minus free run, each model with its own scale; on the right the share of "
        "samples per error."
    )
    horizons = {"free run": "simulation", "one step": "one_step"}
    numbers = _numbers(artefacts, case.record, _BESIDE, horizons)
    key = f"fig-{case.errors.lower()}"
    return Picture(key, f"Fig. {case.errors}", title, alt, caption, svg(figure, key, alt), numbers)


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
    """The window with the largest error inside."""
    width = min(_ZOOM, float(t[-1] - t[0]) / 3)
    start = float(t[int(np.argmax(np.abs(error)))]) - 0.5 * width
    start = min(max(start, float(t[0])), float(t[-1]) - width)
    return (t >= start) & (t <= start + width)


def _numbers(
    artefacts: Artefacts, record: str, models: tuple[str, ...], horizons: dict[str, str]
) -> Table:
    rows = []
    for m in models:
        cells = [labels.MODEL[m]]
        for kind in horizons.values():
            path = f"identification.{m}.{record}.{kind}"
            cells.append(rpm(artefacts.number(f"{path}.rmse_rpm")))
            cells.append(percent(artefacts.number(f"{path}.fit_percent")))
        rows.append(tuple(cells))
    header = [f"{h}, {what}" for h in horizons for what in ("rms error", "fit")]
    return Table("", ("model", *header), tuple(rows))


def _names(models: tuple[str, ...]) -> str:
    return " and ".join(labels.MODEL[m] for m in models)
