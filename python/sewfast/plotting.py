"""Numbers, tables and drawings of a page, as HTML and SVG."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import SettingError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# --- Numbers as a reader likes them: few digits, a unit, a dash where there is none ---------------


NONE = "–"
_SPACE = "\N{NO-BREAK SPACE}"


def significant(value: float | None, digits: int = 3) -> str:
    """`digits` significant digits, plain where that is short, else a power of ten."""
    if value is None or not math.isfinite(value):
        return NONE
    if value == 0.0:
        return "0"
    # of the rounded value: 9.996 has two digits before the point
    size = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -3 <= size <= 5:
        mantissa = value / 10.0**size
        text = f"{mantissa:.{digits - 1}f} × 10{_raised(size)}"
        return text.replace("-", "−").replace(" ", _SPACE)
    return f"{value:,.{max(digits - 1 - size, 0)}f}".replace("-", "−")


def rpm(value: float | None) -> str:
    """A speed or its error [RPM]."""
    return NONE if value is None else f"{significant(value)}{_SPACE}RPM"


def volt(value: float | None) -> str:
    """A command or its change [V]."""
    return NONE if value is None else f"{significant(value)}{_SPACE}V"


def percent(value: float | None, digits: int = 2) -> str:
    """A share [%]."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{value:.{digits}f}{_SPACE}%".replace("-", "−")


def milliseconds(value: float | None) -> str:
    """A duration [ms]."""
    return NONE if value is None else f"{value:.0f}{_SPACE}ms"


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


# --- Table: rows of text under headers ------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """Rows whose first cell is a header.

    Attributes
    ----------
    caption : str
        What it shows.
    header : tuple of str
    rows : tuple of tuple of str
    best : frozenset of (row, column)
        Cells to set in bold.
    words : bool
        Whether its cells hold words rather than numbers, which begin at the left.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    words: bool = False


# --- The canvas: the look of every figure, thinning of long series, figures as inline SVG ---------


Float = NDArray[np.float64]

WIDTH = 9.2
"""Of every figure [inch]."""

BUCKETS = 700
"""A series is drawn by the smallest and largest value in each of at most this many buckets."""

# Okabe and Ito's colours; the line style tells them apart without colour
LOOKS: dict[str, dict[str, Any]] = {
    "truth": {"color": "#a9a9a9", "lw": 2.8, "ls": "-"},
    "command": {"color": "#333333", "lw": 1.0, "ls": "-"},
    "reference": {"color": "black", "lw": 0.9, "ls": "-"},
    "paper": {"color": "#D55E00", "lw": 1.2, "ls": (0, (4, 1.5))},
    "neural_oe": {"color": "#0072B2", "lw": 1.2, "ls": "-"},
    "oe": {"color": "#007a59", "lw": 1.2, "ls": (0, (6, 1.5, 1, 1.5))},
    "arx": {"color": "#B07800", "lw": 1.2, "ls": (0, (8, 2))},
    "arx_raw": {"color": "#9b3f77", "lw": 1.3, "ls": (0, (1.5, 1.2))},
    "model": {"color": "#D55E00", "lw": 1.3, "ls": (0, (4, 1.8))},
    "machine": {"color": "#56B4E9", "lw": 2.6, "ls": "-"},
    "measured": {"color": "#0072B2", "lw": 1.2, "ls": "-"},
}

_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "lines.solid_joinstyle": "round",
    "svg.fonttype": "path",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}


def require() -> None:
    """Refuse with a remedy where matplotlib or Jinja2 is not installed."""
    _require("the report needs", "matplotlib", "jinja2")


def require_matplotlib() -> None:
    """Refuse with a remedy where matplotlib is not installed."""
    _require("figures need", "matplotlib")


def _require(what: str, *modules: str) -> None:
    for name in modules:
        try:
            import_module(name)
        except ImportError as e:
            raise SettingError(
                f'{what} {name}, which is not installed: pip install "sewfast[report]"'
            ) from e


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The look of the figures drawn and written inside."""
    import matplotlib

    # keys are a type of their own in the latest matplotlib only
    settings: Any = _STYLE | {"svg.hashsalt": "sewfast"}
    with matplotlib.rc_context(settings):
        yield


def panels(
    heights: list[float], *, widths: list[float] | None = None, share_x: bool = True
) -> tuple[Figure, NDArray[Any]]:
    """A figure of panels, each row `heights` inch high; axes as an array (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(
        len(heights),
        len(widths or [1]),
        squeeze=False,
        sharex="col" if share_x else "none",
        gridspec_kw={"height_ratios": heights, "width_ratios": widths or [1]},
    )
    return figure, axes


def thin(x: Float, y: Float, buckets: int = BUCKETS) -> tuple[Float, Float]:
    """The smallest and largest value of each bucket, in their order: no peak is lost.

    Parameters
    ----------
    x, y : array, shape (N,)

    Returns
    -------
    x, y : array, shape (M,), M at most 2 `buckets` + 2
        The series itself where it is short; its first and last sample always.
    """
    n = len(y)
    if n <= 2 * buckets:
        return x, y
    edges = np.linspace(0, n, buckets + 1).astype(int)
    kept = {0, n - 1}
    for start, stop in itertools.pairwise(edges):
        kept.add(start + int(np.argmin(y[start:stop])))
        kept.add(start + int(np.argmax(y[start:stop])))
    index = np.array(sorted(kept))
    return x[index], y[index]


def draw(
    ax: Axes, x: Float, y: Float, look: str, label: str | None = None, *, width: float | None = None
) -> None:
    """A thinned line in the look of its role, or thinner than that."""
    ax.plot(*thin(x, y), label=label, **LOOKS[look] | ({"lw": width} if width else {}))


def legend(ax: Axes, columns: int = 6) -> None:
    """A legend above the axes, where it covers nothing."""
    ax.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, borderaxespad=0.1,
        handlelength=2.8, columnspacing=1.4,
    )  # fmt: skip


@dataclass(frozen=True)
class Picture:
    """One figure of the report.

    Attributes
    ----------
    key : str
        Its anchor on the page.
    number : str
        `Fig. 8` for the paper's Fig. 8; `Fig. A` and so on for those that the paper has not.
    title, alt, caption : str
        What it shows; what a reader sees in it; what to look at.
    svg : str
        Inline SVG.
    numbers : Table or None
        The numbers that belong to it.
    """

    key: str
    number: str
    title: str
    alt: str
    caption: str
    svg: str
    numbers: Table | None = None


def svg(figure: Figure, key: str, alt: str) -> str:
    """The figure as inline SVG whose identifiers are its own on a page of many."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'( (?:d|x|y|width|height)="[^"]*"|translate\([^)]*\))', _rounded, text)
    text = _renamed(text, key)
    box = re.search(r'viewBox="[^"]*"', text)
    opening = f'<svg {box[0] if box else ""} role="img" aria-label="{_attribute(alt)}"'
    namespaces = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    return re.sub(r"<svg[^>]*>", lambda _: f"{opening} {namespaces}>", text, count=1)


def _rounded(match: re.Match[str]) -> str:
    """Coordinates to a hundredth of a point: finer than any printer, half the size."""
    short = re.sub(r"-?\d+\.\d+", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), match[0])
    return short.replace(" \n", " ").replace("\n", " ")


def _renamed(text: str, key: str) -> str:
    """Identifiers numbered in their order: matplotlib's hash the last bits of the layout."""
    numbers: dict[str, str] = {}
    return re.sub(
        r'(\bid="|href="#|url\(#)([^")]+)',
        lambda m: f"{m[1]}{key}-{numbers.setdefault(m[2], str(len(numbers)))}",
        text,
    )


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
