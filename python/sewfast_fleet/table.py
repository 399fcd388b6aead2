"""The table of a fleet: a row for each recording, its files, and drift since an earlier run."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sewfast import storage
from sewfast.errors import SettingError, printable
from sewfast.plotting import Drawing, Plotted, lettered, stacked
from sewfast.tables import Table, percent, significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORMAT = "sewfast.fleet"
SIGMAS = 4.0
LEAST_CHANGE = 0.02
"""Least relative change of a gain or a residence time to count as drift, however certain."""
SHOWN = 50
"""Most rows of a table in a notebook."""
NOISE_RATIO = 1.5
"""Ratio of the residuals of two recordings, in either direction, that counts as drift."""


@dataclass(frozen=True)
class Row:
    """The result of one recording.

    Attributes
    ----------
    file : str
        Path relative to the folder, or as in the manifest.
    status : str
        `ok`, or `failed` with a message instead of a model.
    message : str
        Why it failed, or what is wrong with the recording (`sewfast.diagnose`).
    samples : int
    Ts : float
        [s]
    kind : str
        Kind of the model.
    fit_percent, rmse : float
        Free run on the last 30 % of the recording, which were not used for training.
    noise : float
        Standard deviation of the residual there.
    gain, gain_error : float
        Steady gain from the first input and its standard error; NaN for networks.
    residence_time, residence_time_error : float
        Average residence time [s] and its standard error: for a first-order lag the sum of time
        constant and dead time, in general the area between step response and final value over the
        gain (Astrom and Hagglund 2006, chapter 2); NaN for networks and integrators.
    verdict : str
        Verdict of `identify`, in words.
    parameters : str
        Start of the hash of all parameters: equal for equal bits.
    Kp, Ti, Td : float
        Gains of the controller tuned for it, in standard form; NaN without a controller.
    """

    file: str
    status: str = "ok"
    message: str = ""
    samples: int = 0
    Ts: float = math.nan
    kind: str = ""
    fit_percent: float = math.nan
    rmse: float = math.nan
    noise: float = math.nan
    gain: float = math.nan
    gain_error: float = math.nan
    residence_time: float = math.nan
    residence_time_error: float = math.nan
    verdict: str = ""
    parameters: str = ""
    Kp: float = math.nan
    Ti: float = math.nan
    Td: float = math.nan


COLUMNS = tuple(Row.__dataclass_fields__)
LABELS = {"gain": "gain", "residence_time": "residence time [s]", "noise": "noise"}
"""Drawn quantities, in the model's units."""


@dataclass(frozen=True)
class Drift:
    """A change of a machine since an earlier run.

    Attributes
    ----------
    file : str
    quantity : str
        `gain`, `residence_time` or `noise`.
    before, now : float
    sigmas : float
        The change over its standard error; infinite for `noise`, which is judged by its ratio.
    """

    file: str
    quantity: str
    before: float
    now: float
    sigmas: float

    def __str__(self) -> str:
        certain = "" if math.isinf(self.sigmas) else f" ({self.sigmas:.1f} standard errors)"
        return f"{self.file}: {self.quantity} {self.before:.4g} -> {self.now:.4g}{certain}"


@dataclass(frozen=True)
class Fleet(Plotted):
    """All rows, by file.

    Attributes
    ----------
    rows : tuple of Row
    drifts : tuple of Drift
        Compared with an earlier run, if one was given.
    """

    rows: tuple[Row, ...]
    drifts: tuple[Drift, ...] = ()

    @property
    def failed(self) -> tuple[Row, ...]:
        """The rows without a model."""
        return tuple(row for row in self.rows if row.status != "ok")

    def columns(self) -> dict[str, list[Any]]:
        """The rows by column, for `pandas.DataFrame` and others."""
        return {name: [getattr(row, name) for row in self.rows] for name in COLUMNS}

    def drawing(self) -> Drawing:
        """Gain, residence time and noise of every machine, with bands of 4 standard errors.

        Machines that have drifted are labelled, their earlier values grey.

        Raises
        ------
        SettingError
            If no recording was identified.
        """
        done = [row for row in self.rows if row.status == "ok"]
        if not done:
            raise SettingError("expected a recording that was identified; all failed")
        shown = [q for q in LABELS if any(math.isfinite(getattr(row, q)) for row in done)]
        panels = [partial(self._panel, done, q, q == shown[-1]) for q in shown]
        return stacked(panels, [1.8] * len(panels))

    def _panel(self, done: Sequence[Row], quantity: str, last: bool, ax: Axes) -> None:
        from matplotlib.ticker import MaxNLocator

        value = np.array([getattr(row, quantity) for row in done])
        error = [SIGMAS * getattr(row, f"{quantity}_error", 0.0) for row in done]
        x = np.arange(1, len(done) + 1)
        ax.errorbar(x, value, np.nan_to_num(error), fmt="o", markersize=3.5, capsize=2.0)
        place = {row.file: k for k, row in enumerate(done)}
        for drift in self.drifts:
            if drift.quantity == quantity:
                k = place[drift.file]
                ax.plot(x[k], drift.before, marker="o", markersize=3.5, color="0.6")
                ax.annotate(
                    lettered(drift.file), (x[k], value[k]), (6, 0), textcoords="offset points",
                    va="center",
                )  # fmt: skip
        ax.set_ylabel(LABELS[quantity])
        if last:
            ax.set_xlabel("machine")
            ax.xaxis.set_major_locator(MaxNLocator(integer=True))

    def _repr_html_(self) -> str:
        """A table for a notebook, with the failed recordings below."""
        done = [row for row in self.rows if row.status == "ok"]
        rows = tuple(
            (
                row.file, percent(row.fit_percent), significant(row.rmse, 4),
                significant(row.gain, 5), significant(row.residence_time, 4),
                significant(row.noise, 3),
            )
            for row in done[:SHOWN]
        )  # fmt: skip
        header = ("recording", "fit, held back", "rms error", "gain", "residence time [s]", "noise")
        caption, *notes = str(self).split("\n")
        rest = [f"and {len(done) - SHOWN} more rows"] if len(done) > SHOWN else []
        return Table(caption, header, rows).to_html([*rest, *notes])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as `.csv`, `.json` or `.parquet`; the file is either complete or absent.

        Raises
        ------
        SettingError
            For another ending, or `.parquet` without pyarrow.
        ModelFileError
            If the file cannot be written.
        """
        place = Path(path)
        require_ending(place)
        storage.replace(place, _content(self.rows, place.suffix.lower()))

    def __str__(self) -> str:
        done = [row for row in self.rows if row.status == "ok"]
        lines = [f"{len(self.rows)} recordings: {len(done)} identified, {len(self.failed)} failed"]
        if done:
            fits = sorted(row.fit_percent for row in done)
            middle, worst = fits[len(fits) // 2], min(done, key=lambda row: row.fit_percent)
            lines.append(
                f"fit on the held-back 30 %: median {middle:.1f} %, worst "
                f"{worst.fit_percent:.1f} % ({worst.file})"
            )
        for word, rows in ("failed", self.failed), ("faulty", [r for r in done if r.message]):
            lines += [f"{word}  {row.file}: {row.message}" for row in rows[:10]]
            if len(rows) > 10:
                lines.append(f"  and {len(rows) - 10} more; they are in the table")
        lines += [f"drift   {drift}" for drift in self.drifts]
        return "\n".join(lines)


# --- Tables ---------------------------------------------------------------------------------------


def require_ending(place: Path) -> None:
    if place.suffix.lower() not in (".csv", ".json", ".parquet"):
        raise SettingError(
            f"{place}: expected a name that ends in .csv, .json or .parquet, got {place.name}"
        )


def _content(rows: Sequence[Row], ending: str) -> str | bytes:
    if ending == ".parquet":
        arrow, parquet = _arrow()
        place = io.BytesIO()
        parquet.write_table(arrow.table(Fleet(tuple(rows)).columns()), place)
        return place.getvalue()
    if ending == ".json":
        known = [{k: _or_none(v) for k, v in asdict(row).items()} for row in rows]
        return json.dumps({"format": FORMAT, "version": 1, "rows": known}, indent=1) + "\n"
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_cell(getattr(row, name)) for name in COLUMNS] for row in rows)
    return text.getvalue()


def _or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value).replace("\n", " ")


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise SettingError(
            "expected pyarrow for Parquet, got none; pip install 'sewfast[parquet]', or write .csv"
        ) from error
    return pyarrow, pyarrow.parquet


def load_fleet(path: str | os.PathLike[str]) -> Fleet:
    """Read a table written by `Fleet.save`.

    Raises
    ------
    SettingError
        If there is none, or it lacks columns.
    """
    place = Path(path)
    require_ending(place)
    try:
        if place.suffix.lower() == ".parquet":
            content = io.BytesIO(storage.file_bytes(place, SettingError))
            rows = _arrow()[1].read_table(content).to_pylist()
        elif place.suffix.lower() == ".json":
            rows = json.loads(storage.file_bytes(place, SettingError))["rows"]
        else:
            text = storage.file_bytes(place, SettingError).decode("utf-8-sig")
            rows = list(csv.DictReader(io.StringIO(text, newline="")))
            if not text.strip():
                raise ValueError("an empty file")
        return Fleet(tuple(_read(row) for row in rows))
    except SettingError:
        raise
    except Exception as error:
        raise SettingError(
            f"{place}: expected a table that `sewfast fleet` wrote, got {type(error).__name__}: "
            f"{error}"
        ) from error


def _read(row: Mapping[str, Any]) -> Row:
    values: dict[str, Any] = {}
    for name, of in Row.__dataclass_fields__.items():
        value = row[name]
        if of.type == "float":
            value = math.nan if value in (None, "") else float(value)
            if storage.LARGEST_NUMBER < abs(value) < math.inf:
                raise ValueError(f"{name}: a number larger than {storage.LARGEST_NUMBER:g}")
            if name.endswith("_error") and value < 0.0:
                raise ValueError(f"{name}: a standard error below 0")
        elif of.type == "int":
            value = int(value)
        else:
            value = printable(str(value or ""))
        values[name] = value
    return Row(**values)


# --- Drift ----------------------------------------------------------------------------------------


def earlier_rows(before: Any) -> dict[str, Row]:
    if before is None:
        return {}
    found = before if isinstance(before, Fleet) else load_fleet(before)
    return {row.file: row for row in found.rows if row.status == "ok"}


def drifts(earlier: Mapping[str, Row], rows: Sequence[Row]) -> Iterator[Drift]:
    for row in rows:
        old = earlier.get(row.file)
        if old is None or row.status != "ok":
            continue
        for quantity in ("gain", "residence_time"):
            was, now = getattr(old, quantity), getattr(row, quantity)
            error = math.hypot(getattr(old, f"{quantity}_error"), getattr(row, f"{quantity}_error"))
            change = abs(now - was)
            if change > SIGMAS * error and change > LEAST_CHANGE * abs(was):
                yield Drift(row.file, quantity, was, now, change / error if error else math.inf)
        ratio = row.noise / old.noise if old.noise > 0.0 else 1.0
        if ratio > NOISE_RATIO or ratio < 1.0 / NOISE_RATIO:
            yield Drift(row.file, "noise", old.noise, row.noise, math.inf)
