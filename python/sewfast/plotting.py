"""Pictures of results: the look of every figure, `plot`.

The picture of a result is a `Drawing`: panels, each a function that draws into axes. `plot` draws
them into a new figure, into given axes, or into a file; the report uses the same panels.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .errors import SettingError, not_installed, unwritable
from .storage import replace_file
from .tables import Table
from .units import SPEEDS, spelled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Panel: TypeAlias = Callable[[Axes], None]
else:
    Panel: TypeAlias = object


# --- The look of every figure, thinning of long series --------------------------------------------


Float = NDArray[np.float64]

SHADE = "#e6e6e6"
"""Colour of an uncertainty range."""
WIDTH = 9.2
"""Width of a figure by itself [inch]."""
PAGE_WIDTH = 6.4
"""Width of a figure that stands beside another one on a page [inch]: its letters stay legible."""

BUCKETS = 700
"""A long series is drawn by the smallest and largest value in each of this many buckets."""

# Okabe and Ito's colours; the line style distinguishes them without colour
LOOKS: dict[str, dict[str, Any]] = {
    "truth": {"color": "#a9a9a9", "lw": 2.8, "ls": "-"},
    "command": {"color": "#333333", "lw": 1.0, "ls": "-"},
    "reference": {"color": "black", "lw": 1.0, "ls": (0, (1, 1.6))},
    "paper": {"color": "#D55E00", "lw": 1.2, "ls": (0, (4, 1.5))},
    "neural_oe": {"color": "#0072B2", "lw": 1.2, "ls": "-"},
    "oe": {"color": "#007a59", "lw": 1.2, "ls": (0, (6, 1.5, 1, 1.5))},
    "arx": {"color": "#B07800", "lw": 1.2, "ls": (0, (8, 2))},
    "arx_raw": {"color": "#9b3f77", "lw": 1.3, "ls": (0, (1.5, 1.2))},
    "model": {"color": "#D55E00", "lw": 1.3, "ls": (0, (4, 1.8))},
    "machine": {"color": "#0072B2", "lw": 1.6, "ls": "-"},
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
    """Raise with a remedy if matplotlib or Jinja2 is not installed."""
    _require("the report", "matplotlib", "jinja2")


def require_matplotlib() -> None:
    """Raise with a remedy if matplotlib is not installed."""
    _require("figures", "matplotlib")


def _require(what: str, *modules: str) -> None:
    for name in modules:
        try:
            import_module(name)
        except ImportError as e:
            raise not_installed(name, what, "sewfast[report]") from e


@contextlib.contextmanager
def style() -> Iterator[None]:
    """The look of figures drawn and saved inside the `with` block."""
    import matplotlib

    # only the latest matplotlib has a type for the keys
    settings: Any = _STYLE | {"svg.hashsalt": "sewfast"}
    with matplotlib.rc_context(settings):
        yield


def panels(
    heights: list[float],
    *,
    widths: list[float] | None = None,
    share_x: bool = True,
    width: float = PAGE_WIDTH,
) -> tuple[Figure, NDArray[Any]]:
    """A figure of a page, `width` inch wide, rows `heights` high; axes (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, sum(heights)), layout="constrained")
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
    The result has at most 3 `buckets` + 2 points, always with the first and last; a short series
    (N,) is unchanged. A gap (NaN) of half a bucket or more is a gap in the line; a shorter one
    would not be visible.
    """
    n = len(y)
    if n <= 2 * buckets:
        return x, y
    edges = np.linspace(0, n, buckets + 1).astype(int)
    first, size = edges[:-1, None], np.diff(edges)[:, None]
    place = np.arange(size.max())
    part = y[np.minimum(first + place, n - 1)]
    inside = place < size
    seen = inside & ~np.isnan(part)
    gap = 2 * seen.sum(1) <= size[:, 0]
    index = np.unique(
        np.concatenate(
            (
                [0, n - 1],
                (first[:, 0] + (inside & ~seen).argmax(1))[gap],
                (first[:, 0] + np.where(seen, part, np.inf).argmin(1))[seen.any(1)],
                (first[:, 0] + np.where(seen, part, -np.inf).argmax(1))[seen.any(1)],
            )
        )
    )
    return x[index], y[index]


def draw(
    ax: Axes, x: Float, y: Float, look: str, label: str | None = None, *,
    width: float | None = None, held: bool = False,
) -> None:  # fmt: skip
    """A thinned line in the look of its role, optionally of another width; `held` as steps."""
    changed: dict[str, Any] = {"lw": width} if width else {}
    if held:
        changed["drawstyle"] = "steps-post"
    ax.plot(*thin(x, y), label=label, **LOOKS[look] | changed)


def legend(ax: Axes, columns: int = 6) -> None:
    """A legend above the axes, so that it covers nothing."""
    ax.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=columns, borderaxespad=0.1,
        handlelength=2.6, columnspacing=1.2,
    )  # fmt: skip


# --- Drawing: the picture of a result, for a notebook, given axes or a file -----------------------


FILES = (".png", ".svg", ".pdf")
"""Formats of a figure in a file."""
DPI = 150


@dataclass(frozen=True)
class Drawing:
    """The picture of a result: `rows` of panels, functions that draw into axes (None leaves a place
    empty), with `heights` [inch] and relative `widths`. `main` is the panel, counted row by row,
    for a single pair of axes; `legend` counts the columns of a legend above the figure, 0 if the
    panels have their own.
    """

    rows: tuple[tuple[Panel | None, ...], ...]
    heights: tuple[float, ...]
    widths: tuple[float, ...] = (1.0,)
    share_x: bool = True
    main: int = 0
    legend: int = 0

    @property
    def panels(self) -> list[Panel]:
        return [panel for row in self.rows for panel in row if panel is not None]

    def figure(self, width: float = WIDTH) -> Figure:
        """A new figure that no window or notebook shows, for pages and files; `width` in inch."""
        from matplotlib.figure import Figure

        require_matplotlib()
        with style():
            figure = Figure(figsize=(width, sum(self.heights)), layout="constrained")
            self._fill(figure)
        return figure

    def beside(self) -> Figure:
        """A figure beside another one on a page: narrow, so that its letters stay legible."""
        return self.figure(PAGE_WIDTH if len(self.widths) == 1 else WIDTH)

    def plot(self, ax: Any = None, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw into axes, a file, or a new figure of pyplot, which a notebook shows.

        Parameters
        ----------
        ax : Axes or sequence of Axes, optional
            One takes the main panel; several take as many panels, in reading order.
        file : path, optional
            PNG, SVG or PDF by its ending; an existing file is replaced in one step.

        Returns
        -------
        Axes or array of Axes
            `ax` if given, else the panels, shape (panels,).

        Raises
        ------
        SettingError
            If matplotlib is not installed, `ax` is not axes, or the file cannot be written.
        """
        if isinstance(ax, (str, os.PathLike)):
            raise SettingError(
                f"expected matplotlib axes, got {os.fspath(ax)!r}; for a file: plot(file=...)"
            )
        if ax is not None and file is not None:
            raise SettingError(
                "expected axes or a file, got both; the figure of the axes has savefig"
            )
        if not (file is None or isinstance(file, (str, os.PathLike))):
            raise SettingError(
                name="file", expected="the name of a figure", received=repr(file),
                remedy="for example 'loop.png'",
            )  # fmt: skip
        require_matplotlib()
        if ax is not None:
            return self._into(ax)
        if file is not None:
            return self._save(Path(file))
        from matplotlib import pyplot

        with style():
            figure = pyplot.figure(figsize=(WIDTH, sum(self.heights)), layout="constrained")
            return self._fill(figure)

    def _fill(self, figure: Figure) -> NDArray[Any]:
        axes = figure.subplots(
            len(self.rows),
            len(self.widths),
            squeeze=False,
            sharex="col" if self.share_x else "none",
            gridspec_kw={"height_ratios": self.heights, "width_ratios": self.widths},
        )
        drawn = []
        for row, places in zip(self.rows, axes, strict=True):
            for panel, place in itertools.zip_longest(row, places):
                if panel is None:
                    place.set_axis_off()
                    continue
                panel(place)
                drawn.append(place)
        for above, below in zip(axes[:-1].flat, axes[1:].flat, strict=True):
            if above.get_xlabel() == below.get_xlabel():
                above.set_xlabel("")
        if self.legend:
            figure.legend(
                *drawn[0].get_legend_handles_labels(), loc="outside upper right",
                ncols=self.legend,
            )  # fmt: skip
        return np.array(drawn, dtype=object)

    def _into(self, given: Any) -> Any:
        axes = np.ravel(np.array(given, dtype=object))
        panels = self.panels
        if not 0 < len(axes) <= len(panels) or not all(hasattr(a, "set_xlabel") for a in axes):
            raise SettingError(
                f"expected one of matplotlib's axes or up to {len(panels)}, one per panel, got "
                f"{given!r}"
            )
        if len(axes) == 1:
            panels = [panels[self.main]]
        for panel, ax in zip(panels, axes, strict=False):
            panel(ax)
            # a legend above the axes, as in a new figure, could cover something of the caller's
            if ax.get_legend() is not None or (self.legend and ax is axes[0]):
                ax.legend()
        return given

    def _save(self, path: Path) -> NDArray[Any]:
        require_file(path)
        figure, buffer = self.figure(), io.BytesIO()
        dated = {"CreationDate": None} if path.suffix.lower() == ".pdf" else {}
        dated = {"Date": None} if path.suffix.lower() == ".svg" else dated
        with style():
            figure.savefig(buffer, format=path.suffix[1:].lower(), dpi=DPI, metadata=dated)
        try:
            replace_file(path, buffer.getvalue())
        except OSError as e:
            raise unwritable(SettingError, path, e) from e
        return np.array([ax for ax in figure.axes if ax.axison], dtype=object)


class Plotted(ABC):
    """A result that can draw itself; `drawing` defines the figure."""

    @abstractmethod
    def drawing(self) -> Drawing:
        """The figure as panels."""

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw it into axes, a file, or a new figure; arguments and result as `Drawing.plot`."""
        return self.drawing().plot(ax, file)


def require_file(path: Path) -> None:
    """Raise `SettingError` for a file name without an ending of a figure's format."""
    if path.suffix.lower() not in FILES:
        raise SettingError(f"expected a figure ending in .png, .svg or .pdf, got {path.name!r}")


def stacked(panels: Sequence[Panel], heights: Sequence[float], **settings: Any) -> Drawing:
    """Panels below each other with a common x axis."""
    return Drawing(tuple((panel,) for panel in panels), tuple(heights), **settings)


def lettered(text: str) -> str:
    r"""A text for a figure, with dollars escaped: matplotlib would read `$...$` as a formula."""
    return text.replace("$", r"\$")


# --- Series: closed loops, measured and computed outputs ------------------------------------------


CYCLE = ("measured", "model", "oe", "arx_raw", "arx", "truth")
"""Looks of series of the same kind, in this order; each has its own line style."""
STYLES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1, 2)))
"""Line styles that are distinct in grey print."""
FINE = 1.2
"""Line width where lines do not cover each other."""


def quantity(unit: str) -> str:
    """`speed [RPM]`, `output [mm]`, or `output` if the unit is unknown."""
    name = "speed" if spelled(unit) in (*SPEEDS, "hz") else "output"
    return lettered(f"{name} [{unit}]" if unit else name)


@dataclass(frozen=True)
class Trace:
    """A closed loop to draw: time [s], reference, command and output, shape (N,) each."""

    t: Float
    r: Float
    u: Float
    y: Float
    look: str
    label: str

    @classmethod
    def of(cls, columns: Mapping[str, Float], look: str, label: str) -> Trace:
        """From the columns t, r, u, y."""
        return cls(columns["t"], columns["r"], columns["u"], columns["y"], look, label)


def loop_panels(
    traces: Sequence[Trace], y_unit: str, u_unit: str, limits: tuple[float, float] | None = None
) -> tuple[Panel, Panel, Panel]:
    """Output and reference, error and command of closed loops; the first loop lies on top.
    `limits` are those of the command, marked if a loop reaches one.
    """
    first = traces[0]

    def output(ax: Axes) -> None:
        for s in reversed(traces):
            draw(ax, s.t, s.y, s.look, s.label)
        draw(ax, first.t, first.r, "reference", "reference")
        legend(ax)
        _over_time(ax, quantity(y_unit))

    def error(ax: Axes) -> None:
        for s in reversed(traces):
            draw(ax, s.t, s.r - s.y, s.look, width=FINE)
        _over_time(ax, lettered(f"error [{y_unit}]" if y_unit else "error"))

    def command(ax: Axes) -> None:
        for s in reversed(traces):
            draw(ax, s.t, s.u, s.look, width=FINE, held=len(s.t) <= BUCKETS)
        for limit in limits or ():
            if any(np.nanmax(np.abs(s.u), initial=0.0) >= abs(limit) > 0.0 for s in traces):
                ax.axhline(limit, color="#777777", lw=0.8, ls=(0, (2, 2)))
        _over_time(ax, lettered(f"command [{u_unit}]" if u_unit else "command"))

    return output, error, command


def apart_panel(predicted: Trace, measured: Trace, y_unit: str) -> Panel:
    """What the measured output has beyond the predicted one: where both coincide, this is seen."""

    def apart(ax: Axes) -> None:
        n = min(len(predicted.t), len(measured.t))
        draw(ax, measured.t[:n], measured.y[:n] - predicted.y[:n], "measured", width=FINE)
        ax.axhline(0.0, color="#555555", lw=0.7)
        _over_time(ax, lettered(f"difference\n[{y_unit}]" if y_unit else "difference"))

    return apart


def loop_drawing(
    traces: Sequence[Trace], y_unit: str, u_unit: str, limits: tuple[float, float] | None = None,
    *, heights: tuple[float, float, float] = (2.2, 1.3, 1.3),
) -> Drawing:  # fmt: skip
    """Output, error and command below each other."""
    return stacked(loop_panels(traces, y_unit, u_unit, limits), heights)


def fit_panels(
    Ts: float | None, measured: Sequence[Float], computed: Mapping[str, Sequence[Float]],
    errors: Mapping[str, Sequence[Float]], *, label: str, unit: str, title: str = "",
) -> tuple[Panel, Panel]:  # fmt: skip
    """Computed outputs over the measured one, and errors; experiments one after the other.
    `measured` has an array (N,) per experiment; `computed` and `errors` have the same under each
    label, which has one look in both. Without `Ts` [s] samples are counted. `label` is that of the
    output, with its unit.
    """
    looks = {name: CYCLE[i % len(CYCLE)] for i, name in enumerate({**computed, **errors})}
    when = "sample" if Ts is None else "time [s]"
    if len(measured) > 1:
        when += ", experiments one after the other"
    t, ends = _one_after_the_other(measured, Ts or 1.0)

    def output(ax: Axes) -> None:
        draw(ax, t, _joined(measured), "truth", "measured")
        for name, series in computed.items():
            draw(ax, t, _joined(series), looks[name], name)
        if title:
            ax.set_title(lettered(title))
        legend(ax)
        finish(ax, label)

    def error(ax: Axes) -> None:
        for name, series in errors.items():
            draw(ax, t, _joined(series), looks[name], name, width=0.9)
        ax.axhline(0.0, color="#555555", lw=0.7)
        if errors.keys() != computed.keys():
            legend(ax)
        finish(ax, f"error [{unit}]" if unit else "error")

    def finish(ax: Axes, name: str) -> None:
        _over_time(ax, lettered(name), when)
        for end in ends:
            ax.axvline(end, color="#888888", lw=0.8, ls=(0, (2, 2)))

    return output, error


def _over_time(ax: Axes, name: str, when: str = "time [s]") -> None:
    ax.set_ylabel(name)
    ax.set_xlabel(when)
    ax.margins(x=0.01)


def _one_after_the_other(parts: Sequence[Float], step: float) -> tuple[Float, list[float]]:
    """Times of `_joined`, and the times at which one experiment ends and the next begins."""
    counts = np.cumsum([len(part) for part in parts])
    times = [
        step * np.append(np.arange(end - len(part), end), end - 0.5)
        for part, end in zip(parts, counts, strict=True)
    ]
    return np.concatenate(times)[:-1], [float(step * (end - 0.5)) for end in counts[:-1]]


def _joined(parts: Sequence[Float]) -> Float:
    """All experiments, with a NaN between two so that no line joins them."""
    return np.concatenate([np.append(part, np.nan) for part in parts])[:-1]


# --- Picture: a figure of a page, as inline SVG ---------------------------------------------------


@dataclass(frozen=True)
class Picture:
    """One figure of the report, as inline SVG with its `numbers` as a table.
    `key` is its anchor on the page; `number` is `Fig. 8` for the paper's Fig. 8, and `Fig. A` and
    so on for figures that are not in the paper. `alt` describes it for readers who cannot see it;
    `caption` says what to look for.
    """

    key: str
    number: str
    title: str
    alt: str
    caption: str
    svg: str
    numbers: Table | None = None


def svg(figure: Figure, key: str, alt: str) -> str:
    """The figure as inline SVG with identifiers that are unique on a page of many."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    # savefig would draw the figure twice, the first time for its size, which is known here
    canvas: Any = FigureCanvasSVG(figure)  # not typed by matplotlib
    canvas.print_svg(buffer, metadata={"Date": None, "Creator": None})
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
    """Coordinates rounded to a hundredth of a point: finer than any printer, half the size."""
    short = re.sub(r"-?\d+\.\d+", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), match[0])
    return short.replace(" \n", " ").replace("\n", " ")


def _renamed(text: str, key: str) -> str:
    """Identifiers numbered in order: matplotlib's vary with the last bits of the layout."""
    numbers: dict[str, str] = {}
    return re.sub(
        r'(\bid="|href="#|url\(#)([^")]+)',
        lambda m: f"{m[1]}{key}-{numbers.setdefault(m[2], str(len(numbers)))}",
        text,
    )


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
