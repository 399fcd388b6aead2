"""The section of a page on an analysis that lies in its folder (`Analysis.save`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import storage
from ..analysis.analysis import ALT, FOLDER, FORMAT, NUMBERS, VERSION
from ..errors import ModelFileError
from ..plotting import Picture, Table, percent, significant
from .artefacts import drawing

_CAPTIONS = {
    "responses": (
        "Steps of the reference and of a disturbance",
        "What the loop does about one speed, with encoder, filter and limits; the band holds every "
        "plant. The reference step shows F₁ and F₂ together, the disturbance step F₁ alone.",
    ),
    "bode": (
        "L, S and T",
        "With bands over the plants. |S| is the share of a disturbance that is left: its peak is "
        "to stay below 2, better below 1.7. |T| is what comes through of the measurement, with its "
        "noise.",
    ),
    "sensitivity": (
        "What a gain that is a little off costs",
        "Flat curves are gains that need no care; a steep one, or an Ms beyond 2, is where not to "
        "round.",
    ),
    "what_if": (
        "What if the plant is not as identified?",
        "The same controller on changed plants; the thin line marks the plants as they are.",
    ),
}


def section(folder: Path) -> dict[str, Any] | None:
    """What the template `analysis.html` shows; None where the folder holds no analysis.

    Raises
    ------
    DataError, ModelFileError
        Where a file is missing or damaged.
    """
    path = folder / NUMBERS
    if not path.is_file():
        return None
    found = storage.read(path, FORMAT, {VERSION})
    try:
        return {
            "margins": _margins(found),
            "what_if": _scores(found),
            "judgement": found["judgement"],
            "plants": found["plants"],
            "pictures": [_picture(folder, str(n)) for n in found["figures"] if n in _CAPTIONS],
        }
    except (KeyError, TypeError, AttributeError) as e:
        raise ModelFileError(
            f"{path}: expected the numbers of an analysis, one is missing or of another kind "
            f"({e}); analyse again"
        ) from e


def _picture(folder: Path, name: str) -> Picture:
    title, caption = _CAPTIONS[name]
    svg = drawing(folder / FOLDER / f"{name}.svg")
    return Picture(f"analysis-{name}", "", title, ALT[name], caption, svg)


def _margins(found: Mapping[str, Any]) -> Table:
    unit = found["units"]["y"]
    rows = []
    for loop in found["loops"]:
        worst = max((p["margins"] for p in loop["plants"]), key=_peak)
        rows.append((f"{significant(loop['level'])} {unit}", *_margin_cells(worst)))
    header = ("about", "Ms", "Mt", "gain margin", "phase margin", "delay margin", "noise gain")
    count = len(found["plants"])
    whose = "" if count == 1 else f" The worst of {count} plants."
    return Table(f"Margins of the linear loop.{whose}", header, tuple(rows))


def _peak(margins: Mapping[str, Any]) -> float:
    return float("inf") if margins["Ms"] is None else float(margins["Ms"])


def _margin_cells(m: Mapping[str, Any]) -> tuple[str, ...]:
    if not m["stable"]:
        return ("unstable", *("–",) * 5)
    delay = m["delay_margin_s"]
    phase = m["phase_margin_deg"]
    return (
        significant(m["Ms"]),
        significant(m["Mt"]),
        significant(m["gain_margin"]),
        "–" if phase is None else f"{phase:.0f}°",
        "–" if delay is None else f"{significant(1e3 * delay)} ms",
        significant(m["noise_gain"]),
    )


def _scores(found: Mapping[str, Any]) -> Table:
    unit, volt = found["units"]["y"], found["units"]["u"]
    rows = [("as it is", *_score_cells(found["score"]))]
    rows += [(w["change"], *_score_cells(w)) for w in found["what_if"]]
    header = (
        "plant", f"cost [{unit}]", f"worst error [{unit} rms]", "overshoot",
        f"chatter [{volt} rms]", "Ms",
    )  # fmt: skip
    return Table(f"Cost on {', '.join(found['references'])}.", header, tuple(rows))


def _score_cells(s: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        significant(s["cost"]),
        significant(s["tracking"]),
        percent(s["overshoot_percent"]),
        significant(s["chatter"]),
        significant(s["Ms"]),
    )
