"""The front of controllers: every pair of objectives in a panel, the knee marked."""

from __future__ import annotations

import io
import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ... import plotting
from ...errors import SettingError
from ...storage import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ...front import ParetoFront

NAMES = {
    "cost": "cost",
    "tracking": "tracking error, rms",
    "chatter": "change of the command, rms",
    "effort": "command, rms",
    "overshoot": "overshoot",
    "rise": "rise time beyond the reference's",
    "lag": "lag",
    "saturation": "share of samples at a limit",
    "recovery": "recovery from a load",
    "load": "deviation under a load",
    "Ms": "largest sensitivity Ms",
}
HEIGHT = 3.6
"""Of a panel [inch]."""


def draw(front: ParetoFront, path: Path) -> Path:
    """Write the figure in the format of the path's ending.

    Raises
    ------
    SettingError
        For an ending that is no format of figures, or a file that cannot be written.
    """
    plotting.require_matplotlib()
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise SettingError(f"expected a figure ending in .png, .svg or .pdf, got {path.name!r}")
    pairs = list(itertools.combinations(range(len(front.objectives)), 2))
    columns = min(2, len(pairs))
    rows = -(-len(pairs) // columns)
    with plotting.style():
        figure, axes = plotting.panels([HEIGHT] * rows, widths=[1] * columns, share_x=False)
        for axis, (i, j) in zip(axes.flat, pairs, strict=False):
            _panel(axis, front, i, j)
        for axis in axes.flat[len(pairs) :]:
            axis.set_visible(False)
        axes.flat[0].legend()
        drawn = io.BytesIO()
        figure.savefig(drawn, format=path.suffix[1:].lower(), dpi=150)
    try:
        replace_file(path, drawn.getvalue())
    except OSError as error:
        raise SettingError(
            f"{path}: cannot be written ({error.strerror}); choose a folder that exists and is "
            "writable"
        ) from error
    return path


def _panel(axis: Axes, front: ParetoFront, i: int, j: int) -> None:
    x, y = front.values[:, i], front.values[:, j]
    order = np.argsort(x)
    if len(front.objectives) == 2:
        axis.step(x[order], y[order], where="post", color="#bbbbbb", lw=1.0, zorder=1)
    axis.scatter(x, y, s=18, color="#0072B2", label="controllers of the front", zorder=2)
    k = front.pick
    axis.scatter(
        x[k], y[k], s=90, marker="D", facecolor="none", edgecolor="#D55E00", lw=1.8,
        label="the knee", zorder=3,
    )  # fmt: skip
    from ...front import wide

    axis.set_xscale("log" if wide(x) else "linear")
    axis.set_yscale("log" if wide(y) else "linear")
    axis.set_xlabel(_label(front, i))
    axis.set_ylabel(_label(front, j))


def _label(front: ParetoFront, i: int) -> str:
    name = front.objectives[i]
    unit = front.units[name]
    return NAMES[name] + (f" [{unit}]" if unit else "")
