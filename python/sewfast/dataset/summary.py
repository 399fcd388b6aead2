"""`summary`: the properties of data to look at before identifying anything from them."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..arrays import FloatArray, labelled, runs
from ..plotting import Drawing, legend, lettered, thin
from ..tables import Table
from ..units import duration
from .diagnosis import Diagnosis, diagnose
from .outliers import (
    band,
    distances,
    power_spectrum,
    quantum,
    share_at_limits,
    top,
    usual_threshold,
    white_noise,
)
from .pieces import LARGEST, SMALLEST_FITTED

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .dataset import Dataset


@dataclass(frozen=True)
class ColumnSummary:
    """One column over all experiments; numbers that are not known are NaN or None.

    Attributes
    ----------
    n, missing, gaps, longest_gap : int
        Samples; those that are NaN, in how many runs, and the longest of these.
    unusable : int
        Values that no sensor gives: infinite, or 1e150 and more.
    low, high, mean, std : float
        Of the known values [unit].
    trend : float
        Change of a straight line through an experiment, from its first to its last sample, in the
        experiment where it is largest [unit].
    quantum : float or None
        Step of the grid on which all values lie [unit].
    at_low, at_high : float
        Parts of the known samples that stay at the smallest and at the largest value for three
        samples or more, 0 to 1.
    noise : float
        Standard deviation of the white part, from third differences [unit].
    band : tuple of float or None
        Frequencies between which the middle 90 % of the power lies [Hz].
    top : float or None
        Frequency below which 99.9 % of it lies [Hz].
    """

    name: str
    unit: str
    role: Literal["input", "output", "column"]
    n: int
    missing: int
    gaps: int
    longest_gap: int
    unusable: int
    low: float
    high: float
    mean: float
    std: float
    trend: float
    quantum: float | None
    at_low: float
    at_high: float
    noise: float
    band: tuple[float, float] | None
    top: float | None

    @property
    def moves(self) -> bool:
        return self.high > self.low


@dataclass(frozen=True, eq=False, repr=False)
class Summary:
    """The result of `Dataset.summary`; `str` is a page of text, `to_json` its numbers.

    Attributes
    ----------
    columns : tuple of ColumnSummary
        Inputs, then the output.
    outliers_at : tuple of (str, int)
        Experiment and sample (0-based, of its file) of outputs that stand out from their neighbours
        (`Dataset.mark_outliers`).
    diagnosis : Diagnosis
        Properties of the data (`sewfast.diagnose`).
    advice : tuple of str
        What to do about the numbers, most important first.
    """

    Ts: float
    experiments: tuple[tuple[str, str, int], ...]
    columns: tuple[ColumnSummary, ...]
    outliers_at: tuple[tuple[str, int], ...]
    diagnosis: Diagnosis
    notes: tuple[str, ...] = ()
    data: Dataset | None = field(default=None, repr=False)

    @property
    def n(self) -> int:
        """Samples in all experiments together."""
        return sum(n for _, _, n in self.experiments)

    @property
    def outliers(self) -> int:
        """How many outputs stand out."""
        return len(self.outliers_at)

    @property
    def advice(self) -> tuple[str, ...]:
        return tuple(advice(self))

    def to_json(self) -> dict[str, Any]:
        """As JSON values: None where a number is not known."""
        return {
            "Ts": self.Ts,
            "samples": self.n,
            "seconds": self.n * self.Ts,
            "experiments": [
                {"name": name, "range": text, "samples": n} for name, text, n in self.experiments
            ],
            "columns": [_plain(asdict(c)) for c in self.columns],
            "outliers": self.outliers,
            "outliers_at": [{"experiment": e, "sample": k} for e, k in self.outliers_at],
            **self.diagnosis.to_json(),
            "advice": list(self.advice),
            "notes": list(self.notes),
        }

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw the data: `Dataset.plot`."""
        assert self.data is not None
        return self.data.plot(ax, file=file)

    def _repr_html_(self) -> str:
        """A table for a notebook, with the advice below it."""
        (_, header), *rows = _rows(self.columns)
        cells = tuple((label, *cells) for label, cells in rows)
        hints = [*map(str, self.diagnosis.findings), *self.advice]
        notes = [f"note: {note}" for note in self.notes]
        return Table(self._caption(), ("", *header), cells).to_html([*hints, *notes])

    def __repr__(self) -> str:
        hints = len(self.advice) + len(self.diagnosis.findings)
        return f"Summary({self.n} samples, {len(self.columns)} columns, {hints} hints)"

    def _caption(self) -> str:
        count = len(self.experiments)
        several = f" in {count} experiments" if count > 1 else ""
        rate = f"Ts = {self.Ts:g} s ({1 / self.Ts:.4g} Hz)"
        return f"{self.n} samples{several}, {duration(self.n * self.Ts)} at {rate}"

    def __str__(self) -> str:
        lines = [self._caption()]
        lines += [f"  {name} [{text}]" for name, text, _ in self.experiments[:10]]
        lines += ["", *table(self.columns)]
        hints = [*self.diagnosis.findings, *self.advice]
        if not hints and not any(note.startswith("warning: ") for note in self.notes):
            hints = ["nothing stands in the way"]
        lines += ["", *(f"- {hint}" for hint in hints)]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def summary(data: Dataset) -> Summary:
    """Range, gaps, quantisation, limits, trend, noise and band of every column, and what to do.

    Accepts any data: values that no model could use are counted, not refused.

    Returns
    -------
    Summary
    """
    columns = [
        column_summary(name, unit, "input", [e.u[:, i] for e in data.experiments], data.Ts)
        for i, (name, unit) in enumerate(zip(data.input_names, data.input_units, strict=True))
    ]
    outputs = [e.y for e in data.experiments]
    columns.append(column_summary(data.output_name, data.output_unit, "output", outputs, data.Ts))
    sane = data.mask(lambda e: ~(np.abs(e.y) < LARGEST))
    inputs_too = all((np.abs(e.u) < LARGEST).any() for e in data.experiments)
    outliers = _marked(sane) if inputs_too else ()
    experiments = tuple((e.name, e.range_text, len(e)) for e in data.experiments)
    found = diagnose(data)
    return Summary(data.Ts, experiments, tuple(columns), outliers, found, data.notes, data)


def _marked(data: Dataset) -> tuple[tuple[str, int], ...]:
    limit = usual_threshold(data)
    return tuple(
        (e.name, e.start + int(k))
        for e in data.experiments
        for k in np.flatnonzero(distances(e.y) > limit)
    )


def column_summary(
    name: str,
    unit: str,
    role: Literal["input", "output", "column"],
    parts: Sequence[FloatArray],
    Ts: float | None,
) -> ColumnSummary:
    """Summary of one column, given experiment by experiment; without Ts it has no band."""
    usable = [np.where(np.abs(part) < LARGEST, part, np.nan) for part in parts]
    gaps = [n for part in parts for _, n in runs(np.isnan(part))]
    unusable = int(sum((np.abs(part) >= LARGEST).sum() for part in parts))
    known = np.concatenate([part[np.isfinite(part)] for part in usable])
    some = len(known) > 0
    noises = [white_noise(part) for part in usable]
    spectrum = power_spectrum(usable, Ts) if Ts is not None else (np.zeros(0), np.zeros(0))
    longest = int(np.argmax([len(part) for part in usable]))
    at_low, at_high = share_at_limits(np.concatenate(usable))
    return ColumnSummary(
        name,
        unit,
        role,
        sum(map(len, parts)),
        sum(gaps),
        len(gaps),
        max(gaps, default=0),
        unusable,
        float(known.min()) if some else math.nan,
        float(known.max()) if some else math.nan,
        float(known.mean()) if some else math.nan,
        float(known.std()) if some else math.nan,
        max((_trend(part) for part in usable), key=_size),
        quantum(known),
        at_low,
        at_high,
        noises[longest],
        band(*spectrum),
        top(*spectrum),
    )


def _trend(column: FloatArray) -> float:
    """Change of the least-squares line over the whole column."""
    index = np.flatnonzero(np.isfinite(column)).astype(np.float64)
    if len(index) < 2:
        return math.nan
    values, k = column[np.isfinite(column)], index - index.mean()
    return float(k @ (values - values.mean()) / (k @ k)) * (len(column) - 1)


def _size(value: float) -> float:
    return abs(value) if math.isfinite(value) else -1.0


def table(columns: Sequence[ColumnSummary]) -> list[str]:
    """The columns side by side, one quantity per line."""
    rows = _rows(columns)
    widths = [max(len(cells[i]) for _, cells in rows) for i in range(len(columns))]
    return [
        "  ".join(
            [label.ljust(19), *(c.rjust(w) for c, w in zip(cells, widths, strict=True))]
        ).rstrip()
        for label, cells in rows
    ]


def _rows(columns: Sequence[ColumnSummary]) -> list[tuple[str, list[str]]]:
    """A label and a cell for each column; the first row is the header."""
    rows: list[tuple[str, list[str]]] = [
        ("", [f"{c.role} {labelled(c.name, c.unit)}" for c in columns]),
        ("range", [f"{_number(c.low)} to {_number(c.high)}" for c in columns]),
        ("mean", [_number(c.mean) for c in columns]),
        ("standard deviation", [_number(c.std) for c in columns]),
        ("trend over a record", [_number(c.trend) for c in columns]),
        ("missing", [_missing(c) for c in columns]),
        (
            "quantisation",
            ["none seen" if c.quantum is None else _number(c.quantum) for c in columns],
        ),
        ("at lowest, highest", [f"{c.at_low:.1%}, {c.at_high:.1%}" for c in columns]),
        ("white noise", [_noise(c) for c in columns]),
        ("90 % of the power", [_band(c) for c in columns]),
    ]
    if all(c.band is None for c in columns):
        rows.pop()
    return rows


def _number(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else "unknown"


def _missing(c: ColumnSummary) -> str:
    bad = f", {c.unusable} unusable" if c.unusable else ""
    if c.missing == 0:
        return f"none{bad}"
    return f"{c.missing} in {c.gaps} gaps, longest {c.longest_gap}{bad}"


def _noise(c: ColumnSummary) -> str:
    if not (math.isfinite(c.noise) and c.std > 0.0):
        return _number(c.noise)
    return f"{_number(c.noise)} ({c.noise / c.std:.2%} of sd)"


def _band(c: ColumnSummary) -> str:
    return "unknown" if c.band is None else f"{c.band[0]:.3g} to {c.band[1]:.3g} Hz"


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return list(value) if isinstance(value, tuple) else value


# --- Advice on the figures of a summary -----------------------------------------------------------


SHOWN = 8
"""Outliers whose places are named."""


def advice(found: Summary) -> Iterator[str]:
    """One sentence per finding: the fact, its effect and the remedy."""
    output = found.columns[-1]
    for c in found.columns:
        yield from _values(c)
    # an output that jumps with its input has outliers nowhere
    if found.outliers and found.diagnosis.find("at_once") is None:
        yield _outliers(found, output.name)
    yield from _limits(output)
    yield from _noise_advice(output)
    # nearly all power of a position is slow, however fast its speed changes
    if found.diagnosis.find("integrator") is None and found.diagnosis.find("wraps") is None:
        yield from _rate(output, found.Ts)
    # samples below which an identification has little evidence
    if found.n < 500:
        yield (
            f"{found.n} samples are few: a network needs about ten for each of its parameters; "
            "record longer, or identify a linear model (model='oe')"
        )


def _values(c: ColumnSummary) -> Iterator[str]:
    if c.unusable:
        yield (
            f"{c.unusable} {'value' if c.unusable == 1 else 'values'} of {c.name} "
            f"{'is' if c.unusable == 1 else 'are'} infinite or 1e150 and more, as no sensor gives "
            f"{'it' if c.unusable == 1 else 'them'}: repair the file"
            + (
                ", or mask them: data.mask(lambda e: abs(e.y) > LIMIT)"
                if c.role == "output"
                else ""
            )
        )
    if c.n == c.missing:
        yield f"nothing is known of {c.name}: choose another column"
    elif c.missing and c.role == "input":
        yield (
            f"{c.name} is not known at {c.missing} samples, and a simulation needs every input: "
            'hold it where it stayed as it was, data.fill_inputs("hold") (--hold-inputs), or take '
            'the pieces between, data.split_at_gaps(of="inputs") (--split-at-gaps)'
        )
    elif c.missing:
        yield (
            f"{c.name} was not measured at {c.missing} samples ({c.missing / c.n:.1%}): they have "
            "no weight, models run through them; nothing needs to be done"
        )
    elif not c.moves and not math.isnan(c.low):
        moves = "excites the plant" if c.role == "input" else "follows the input"
        yield f"{c.name} is constant at {c.low:g}: there is nothing to learn until it {moves}"
    elif c.high - c.low < SMALLEST_FITTED:
        yield f"{c.name} moves by {c.high - c.low:g}, too little to be squared: change the unit"


def _outliers(found: Summary, name: str) -> str:
    several = len(found.experiments) > 1
    shown = ", ".join(f"{k} of {e}" if several else str(k) for e, k in found.outliers_at[:SHOWN])
    more = "" if found.outliers <= SHOWN else f" and {found.outliers - SHOWN} more"
    one = found.outliers == 1
    return (
        f"{found.outliers} {'value' if one else 'values'} of {name} "
        f"{'stands' if one else 'stand'} out from {'its' if one else 'their'} neighbours, at sample"
        f"{'' if one else 's'} {shown}{more}: look at {'it' if one else 'them'}, then take "
        f"{'it' if one else 'them'} out, data.mask(data.mark_outliers()) (--mask outliers)"
    )


def _limits(output: ColumnSummary) -> Iterator[str]:
    for part, value in ((output.at_low, output.low), (output.at_high, output.high)):
        # least part of the samples at one limit for the output to count as limited
        if part > 0.02:
            yield (
                f"{output.name} stays at {value:g} for {part:.1%} of the samples: a limit of the "
                "sensor or of the plant. A network can learn it, a linear model cannot; of a "
                "sensor's limit mask these samples"
            )


def _noise_advice(output: ColumnSummary) -> Iterator[str]:
    # the square of a tiny output can be 0
    known = output.moves and output.std > 0.0 and math.isfinite(output.noise)
    # least ratio of white noise to standard deviation for the output to count as noisy
    if known and output.noise > 0.2 * output.std:
        yield (
            f"white noise is {output.noise / output.std:.0%} of what {output.name} does: excite "
            "more strongly or record longer; prefer output error to arx, which noise biases"
        )


def _rate(output: ColumnSummary, Ts: float) -> Iterator[str]:
    if output.band is None or output.top is None or not output.moves:
        return
    # samples per period of the highest frequency above which the sample time is very short
    if 1.0 / (output.top * Ts) > 50.0:
        # ten samples of such a period are enough
        wanted = nice(1.0 / (10.0 * output.top))
        yield (
            f"99.9 % of the power of {output.name} lies below {output.top:.3g} Hz, "
            f"{1.0 / (output.top * Ts):.0f} samples in a period: where no controller is to run at "
            f"this rate, fits are faster at a longer sample time, data.resample({wanted:g}) "
            f"(--resample {wanted:g})"
        )
    # upper end of the band, as a part of the sampling rate, that is close to the limit
    elif output.band[1] * Ts > 0.25:
        yield (
            f"{output.name} moves up to {output.band[1]:.3g} Hz, close to half the sampling rate: "
            "either most of it is noise, or the sample time is too long to see what the plant does"
        )


def nice(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power)


# --- The picture: columns over time with gaps and outliers, and spectra ---------------------------


INPUT, OUTPUT, MISSING, OUTLIER = "#333333", "#0072B2", "#D55E00", "#CC0000"


def plot(data: Dataset, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
    """Draw every column over time and its spectrum.

    Missing samples are shaded, outliers are circled; experiments follow one another.

    Parameters
    ----------
    ax, file
        As for `Drawing.plot`. One shows the output over time; several are filled in reading order.
    """
    return drawing(data).plot(ax, file)


def drawing(data: Dataset) -> Drawing:
    """One row per column, time on the left, spectrum on the right; experiments side by side."""
    names = [*map(labelled, data.input_names, data.input_units)]
    names = [*names[:7], labelled(data.output_name, data.output_unit)]
    rows = []
    units = [*data.input_units[: len(names) - 1], data.output_unit]
    for i, (name, unit) in enumerate(zip(map(lettered, names), map(lettered, units), strict=True)):
        is_output = i == len(names) - 1
        columns = [e.y if is_output else e.u[:, i] for e in data.experiments]
        columns = [np.where(np.abs(c) < LARGEST, c, np.nan) for c in columns]
        threshold = usual_threshold(data) if is_output else None
        colour = OUTPUT if is_output else INPUT
        rows.append((
            partial(_over_time, columns=columns, Ts=data.Ts, name=name, threshold=threshold),
            partial(
                _over_frequency, columns=columns, Ts=data.Ts, colour=colour, unit=unit,
                titled=i == 0,
            ),
        ))  # fmt: skip
    return Drawing(tuple(rows), (2.2, *[1.9] * (len(rows) - 1)), (2.6, 1.0), main=2 * len(rows) - 2)


def _over_time(
    ax: Axes, columns: list[FloatArray], Ts: float, name: str, threshold: float | None
) -> None:
    """One column; with a threshold it is the output, whose outliers are circled."""
    is_output, offset = threshold is not None, 0
    has_gaps = has_outliers = False
    look: dict[str, Any] = {"lw": 0.9, "color": OUTPUT if is_output else INPUT}
    look |= {"drawstyle": "default" if is_output else "steps-post"}
    for column in columns:
        index = np.arange(offset, offset + len(column), dtype=np.float64)
        ax.plot(*thin(index * Ts, column, 1200), **look)
        # most gaps that are shaded, the longest first; more would only slow the figure down
        gaps = sorted(runs(np.isnan(column)), key=lambda gap: -gap[1])[:1000]
        if gaps:
            places = [((offset + start - 0.5) * Ts, length * Ts) for start, length in gaps]
            missing: dict[str, Any] = {"color": MISSING, "alpha": 0.25, "lw": 0, "snap": False}
            missing |= {"label": "" if has_gaps else "missing"}
            # one collection over the whole height: a link can lose thousands of samples; marks at
            # the bottom show gaps thinner than a pixel
            height = ax.get_xaxis_transform()
            ax.broken_barh(places, (0.0, 1.0), transform=height, **missing)
            middles = [left + 0.5 * width for left, width in places]
            ax.plot(middles, np.zeros(len(places)), "|", color=MISSING, ms=7, transform=height)
            has_gaps = True
        if threshold is not None:
            at = np.flatnonzero(distances(column) > threshold)
            if len(at):
                label = "" if has_outliers else "stands out"
                circle: dict[str, Any] = {"ms": 5, "mfc": "none", "mec": OUTLIER, "label": label}
                ax.plot((offset + at) * Ts, column[at], "o", **circle)
                has_outliers = True
        offset += len(column)
        if column is not columns[-1]:
            ax.axvline(offset * Ts, color="#888888", lw=0.8, ls=(0, (2, 2)))
    ax.set_ylabel(name)
    several = ", experiments one after the other" if len(columns) > 1 else ""
    ax.set_xlabel(f"time [s]{several}")
    ax.set_xlim(0.0, offset * Ts)
    if has_gaps or has_outliers:
        legend(ax)


def _over_frequency(
    ax: Axes, columns: list[FloatArray], Ts: float, colour: str, unit: str, titled: bool
) -> None:
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel(f"density [{unit}²/Hz]" if unit else "density [1/Hz]")
    if titled:
        ax.set_title("90 % is shaded")
    frequency, power = power_spectrum(columns, Ts)
    found = band(frequency, power)
    if found is None:
        ax.text(0.5, 0.5, "too short", ha="center", va="center", transform=ax.transAxes)
        return
    shown = power > 0.0
    ax.loglog(frequency[shown], power[shown], lw=0.9, color=colour)
    ax.axvspan(*found, color=colour, alpha=0.12, lw=0)
