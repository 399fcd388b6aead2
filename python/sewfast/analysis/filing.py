"""An analysis in a folder: `analysis.json`, and every figure as PNG and SVG."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from .. import storage
from ..errors import SettingError

if TYPE_CHECKING:
    from .analysis import Analysis

NUMBERS = "analysis.json"
FOLDER = "analysis"
"""Of the figures, within the folder of the numbers."""
ALT = {
    "responses": "Output and command over time after a step of the reference and after a step of a "
    "disturbance; the band holds all plants",
    "bode": "Gain and phase of L and gains of S and T over frequency, with bands over the plants",
    "sensitivity": "Cost and largest Ms over the change of each setting in percent",
    "what_if": "Cost, worst error and Ms on plants that are not as identified",
}


def save(a: Analysis, folder: str | os.PathLike[str], *, png: bool = True) -> list[Path]:
    """Write everything, or without the PNGs, which the report has no use for; what was written.

    Raises
    ------
    SettingError
        Where matplotlib is not installed or the folder cannot be written to.
    """
    drawn = a.figures()
    from ..plotting import style, svg

    place = Path(folder) / FOLDER
    written = []
    try:
        place.mkdir(parents=True, exist_ok=True)
        for name, figure in drawn.items():
            with style():
                text = svg(figure, f"analysis-{name}", ALT[name])
                if png:
                    figure.savefig(place / f"{name}.png", dpi=150)
                    written.append(place / f"{name}.png")
            (place / f"{name}.svg").write_text(text, encoding="utf-8")
            written.append(place / f"{name}.svg")
        target = Path(folder) / NUMBERS
        values = {k: v for k, v in a.to_json().items() if k not in ("format", "version")}
        storage.write(target, "sewfast.analysis", 1, {**values, "figures": list(drawn)})
    except OSError as e:
        raise SettingError(
            f"{folder}: expected a folder to write to, received {e.strerror!r}; choose another"
        ) from e
    return [target, *written]
