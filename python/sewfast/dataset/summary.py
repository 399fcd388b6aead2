"""What to know of data before anything is identified from them."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..arrays import FloatArray, labelled, runs
from .advice import advice
from .diagnosis import Diagnosis, diagnose
from .noise import band, power_spectrum, quantum, share_at_limits, top, white_noise
from .outliers import distances, usual_threshold
from .pieces import LARGEST

if TYPE_CHECKING:
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
        Change of a straight line through an experiment, from its first to its last sample; that of
        the experiment where it is largest [unit].
    quantum : float or None
        Step of the grid that all values lie on [unit].
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
    """What `Dataset.summary` finds; `str` is a page of text, `to_json` its numbers.

    Attributes
    ----------
    columns : tuple of ColumnSummary
        Inputs, then the output.
    outliers_at : tuple of (str, int)
        Experiment and sample (0-based, of its file) of outputs that stand out of their neighbours
        (`Dataset.mark_outliers`).
    diagnosis : Diagnosis
        What the data are (`sewfast.diagnose`).
    advice : tuple of str
        What to do about the numbers, in the order of their weight.
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

    def __repr__(self) -> str:
        hints = len(self.advice) + len(self.diagnosis.findings)
        return f"Summary({self.n} samples, {len(self.columns)} columns, {hints} hints)"

    def __str__(self) -> str:
        count = len(self.experiments)
        several = f" in {count} experiments" if count > 1 else ""
        rate = f"Ts = {self.Ts:g} s ({1 / self.Ts:.4g} Hz)"
        lines = [f"{self.n} samples{several}, {self.n * self.Ts:.4g} s at {rate}"]
        lines += [f"  {name} [{text}]" for name, text, _ in self.experiments[:10]]
        lines += ["", *table(self.columns)]
        hints = [*self.diagnosis.findings, *self.advice] or ["nothing stands in the way"]
        lines += ["", *(f"- {hint}" for hint in hints)]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def summary(data: Dataset) -> Summary:
    """Range, gaps, quantisation, limits, trend, noise and band of every column, and what to do.

    Looks at anything: values that no model could use are counted and not refused.

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
    widths = [max(len(cells[i]) for _, cells in rows) for i in range(len(columns))]
    return [
        "  ".join(
            [label.ljust(19), *(c.rjust(w) for c, w in zip(cells, widths, strict=True))]
        ).rstrip()
        for label, cells in rows
    ]


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
