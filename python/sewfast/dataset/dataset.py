"""`Dataset`: inputs and one output at a fixed sample time, in one or several experiments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray, labelled, range_of, texts
from ..errors import DataError, SettingError
from ..storage import LARGEST_NUMBER
from ..tables import Table, significant
from . import outliers, pieces, rates, summary, trends
from .experiment import Experiment, require_some_weight


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Recordings of one plant: the same columns, units and sample time in every experiment.

    Immutable. An output can be NaN, which means that it was not measured: models run through it and
    it has no weight. An input that is NaN is refused if a model needs it; the message names the
    sample.

    Parameters
    ----------
    experiments : tuple of Experiment
    Ts : float
        Sample time [s].
    input_names, output_name
        Column names.
    input_units, output_unit
        Units as text, empty where unknown.
    counts : tuple (column, counts_per_rev) or None
        Set if the output is a speed [RPM] computed from an encoder's counts.
    notes : tuple of str
        Notes on samples and columns omitted when the data set was made.
    looks_ahead : bool
        Whether the output was computed from later samples as well, by a smoother or a filter
        without delay, so that it begins to move before the input does.

    Raises
    ------
    DataError
        If experiments, names and units disagree in number, or Ts is not a positive number.
    """

    experiments: tuple[Experiment, ...]
    Ts: float
    input_names: tuple[str, ...] = ("u",)
    output_name: str = "y"
    input_units: tuple[str, ...] = ("",)
    output_unit: str = ""
    counts: tuple[str, float] | None = None
    notes: tuple[str, ...] = ()
    looks_ahead: bool = False

    def __post_init__(self) -> None:
        if not self.experiments:
            raise DataError("expected at least one experiment, received none")
        try:
            given = math.nan if isinstance(self.Ts, bool) else float(self.Ts)
        except (TypeError, ValueError):
            given = math.nan
        if not 0.0 < given <= LARGEST_NUMBER:
            raise DataError(f"Ts: expected a positive sample time in seconds, received {self.Ts!r}")
        object.__setattr__(self, "Ts", given)
        widths = sorted({e.u.shape[1] for e in self.experiments})
        if len(widths) > 1:
            raise DataError(
                f"expected the same inputs in every experiment, received {widths} inputs"
            )
        if not len(self.input_names) == len(self.input_units) == widths[0]:
            raise DataError(
                f"expected {widths[0]} input names and units, one per column of u, received names "
                f"{list(self.input_names)} and units {list(self.input_units)}"
            )
        if len(set(self.input_names)) < len(self.input_names):
            raise DataError(f"expected different input names, received {list(self.input_names)}")

    @classmethod
    def from_arrays(
        cls,
        u: ArrayLike,
        y: ArrayLike | None,
        Ts: float,
        *,
        input_names: str | Sequence[str] | None = None,
        output_name: str = "y",
        input_units: str | Sequence[str] | None = None,
        output_unit: str = "",
        name: str = "array",
        channels: Mapping[str, ArrayLike] | None = None,
        weights: ArrayLike | None = None,
    ) -> Dataset:
        """One experiment from arrays, which are copied.

        Parameters
        ----------
        u : array_like, shape (N,) or (N, n_inputs)
        y : array_like, shape (N,), or None
            None if nothing was measured: enough to simulate from rest.
        Ts : float
            Sample time [s].
        weights : array_like, shape (N,), or None
            How much the squared error of each sample counts: finite, 0 or more, not all 0. Give
            less weight to samples that you trust less and 0 to those that must not count; only
            ratios matter. None: all equal.

        Raises
        ------
        DataError
            As for `Experiment` and `Dataset`.
        """
        y = np.full(np.shape(u)[:1], np.nan) if y is None else y
        experiment = Experiment(u, y, channels or {}, name, weights=weights)  # type: ignore[arg-type]
        if weights is not None:
            require_some_weight(experiment)
        width = experiment.u.shape[1]
        default = ("u",) if width == 1 else tuple(f"u{i + 1}" for i in range(width))
        return cls(
            (experiment,),
            Ts,
            texts(input_names, default),
            output_name,
            texts(input_units, ("",) * width),
            output_unit,
        )

    @staticmethod
    def concat(datasets: Iterable[Dataset]) -> Dataset:
        """All experiments of several data sets as one data set; names are taken from the first.

        Raises
        ------
        DataError
            If there is none, or sample times (1 %), numbers of inputs or units differ.
        """
        parts = tuple(datasets)
        if not parts:
            raise DataError("concat: expected at least one data set, received none")
        first = parts[0]
        for other in parts[1:]:
            pieces.require_alike(first, other)
        return replace(
            first,
            experiments=tuple(e for part in parts for e in part.experiments),
            notes=tuple(note for part in parts for note in part.notes),
            looks_ahead=any(part.looks_ahead for part in parts),
        )

    @property
    def n_inputs(self) -> int:
        return len(self.input_names)

    @property
    def source(self) -> str:
        """Names of the experiments, for messages."""
        return ", ".join(dict.fromkeys(e.name for e in self.experiments))

    @property
    def input_range(self) -> tuple[tuple[float, float], ...]:
        """Smallest and largest value of each input over all experiments."""
        u = np.concatenate([e.u for e in self.experiments])
        return tuple(map(range_of, u.T))

    @property
    def output_range(self) -> tuple[float, float]:
        """Smallest and largest measured output over all experiments; NaN if there is none."""
        return range_of(np.concatenate([e.y for e in self.experiments]))

    def __len__(self) -> int:
        """Samples in all experiments together."""
        return sum(len(e) for e in self.experiments)

    # without this, Python would iterate over `self[0]`, `self[1]`, ...
    __iter__ = None

    def __getitem__(self, key: slice) -> Dataset:
        """`data[a:b]`: that range of every experiment, cut where it leaves the experiment."""
        if not isinstance(key, slice) or key.step not in (None, 1):
            raise SettingError(
                f"expected a range such as data[0:400], received data[{key!r}]; single experiments "
                "are in data.experiments"
            )
        pieces = (e.cut(*key.indices(len(e))[:2]) for e in self.experiments)
        return replace(self, experiments=tuple(pieces))

    slice = pieces.take
    split = pieces.split
    split_at_gaps = pieces.split_at_gaps

    mask = pieces.mask
    fill_inputs = pieces.fill_inputs
    shift_inputs = pieces.shift_inputs
    detrend = trends.detrend
    restore = trends.restore
    resample = rates.resample
    differentiate = rates.differentiate
    mark_outliers = outliers.mark_outliers
    plot = summary.plot
    summary = summary.summary

    require_inputs = pieces.require_inputs
    require_measured = pieces.require_measured
    require_complete = pieces.require_complete
    require_excited = pieces.require_excited

    def to_pandas(self, *, units: bool = False) -> Any:
        """The samples as a pandas DataFrame.

        Columns: `t` [s], inputs, output, channels, `weights` if there are any, and with several
        experiments their number, `experiment`, first. NaN means not measured.

        Parameters
        ----------
        units : bool
            Whether headers hold units, `u [V]`; `frame.attrs["units"]` has them in any case.

        Raises
        ------
        SettingError
            If pandas is not installed.
        """
        columns, known = _columns(self)
        frame = _package("pandas", "to_pandas").DataFrame(_headed(columns, known, units))
        frame.attrs["units"] = known
        return frame

    def to_polars(self, *, units: bool = False) -> Any:
        """The samples as a polars DataFrame, with the columns of `to_pandas`.

        Null means not measured.

        Parameters
        ----------
        units : bool
            Whether headers hold units, `u [V]`; a polars table has no other place for them.

        Raises
        ------
        SettingError
            If polars is not installed.
        """
        columns, known = _columns(self)
        return _package("polars", "to_polars").DataFrame(
            _headed(columns, known, units), nan_to_null=True
        )

    def to_arrow(self, *, units: bool = False) -> Any:
        """The samples as a pyarrow Table, with the columns of `to_pandas`; null means not measured.

        Parameters
        ----------
        units : bool
            Whether headers hold units, `u [V]`; the fields' metadata `unit` has them in any case.

        Raises
        ------
        SettingError
            If pyarrow is not installed.
        """
        columns, known = _columns(self)
        pa = _package("pyarrow", "to_arrow")
        fields, arrays = [], []
        for name, values in columns.items():
            header = labelled(name, known.get(name, "")) if units else name
            arrays.append(pa.array(values, from_pandas=True))
            metadata = {"unit": known[name]} if known.get(name) else None
            fields.append(pa.field(header, arrays[-1].type, metadata=metadata))
        return pa.table(arrays, schema=pa.schema(fields))

    def to_xarray(self) -> Any:
        """The samples as an xarray Dataset over the coordinate `t` [s].

        `attrs["units"]` of each variable is its unit. Several experiments follow one another along
        `sample`, with the coordinates `t` and `experiment`. NaN means not measured.

        Raises
        ------
        SettingError
            If xarray is not installed.
        """
        columns, known = _columns(self)
        several = "experiment" in columns and len(self.experiments) > 1
        along = "sample" if several else "t"
        coordinates = ("experiment", "t") if several else ("t",)
        made = {
            name: (along, values, {"units": known[name]} if known.get(name) else {})
            for name, values in columns.items()
        }
        return _package("xarray", "to_xarray").Dataset(
            {n: c for n, c in made.items() if n not in coordinates},
            coords={n: made[n] for n in coordinates},
            attrs={"sample_time_s": self.Ts},
        )

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Arrow's stream of the samples, for `polars.DataFrame(data)`, DuckDB and others."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def _repr_html_(self) -> str:
        names = [*map(labelled, self.input_names, self.input_units)]
        columns = [
            ("input", name, span) for name, span in zip(names, self.input_range, strict=True)
        ]
        columns.append(("output", labelled(self.output_name, self.output_unit), self.output_range))
        rows = tuple((n, r, *map(significant, span)) for r, n, span in columns)
        count = len(self.experiments)
        several = f" in {count} experiments" if count > 1 else ""
        caption = f"{len(self)} samples{several} at Ts = {self.Ts:g} s"
        return Table(caption, ("column", "", "from", "to"), rows).to_html(self.notes)

    def __repr__(self) -> str:
        inputs = ", ".join(map(labelled, self.input_names, self.input_units))
        return (
            f"Dataset({len(self.experiments)} experiment(s), {len(self)} samples, "
            f"Ts={self.Ts:g} s, {inputs} -> {labelled(self.output_name, self.output_unit)})"
        )

    def __str__(self) -> str:
        lines = [f"Data set: {len(self)} samples at Ts = {self.Ts:g} s"]
        for name, unit, (low, high) in zip(
            self.input_names, self.input_units, self.input_range, strict=True
        ):
            lines.append(f"  input   {labelled(name, unit)}: {low:g} to {high:g}")
        low, high = self.output_range
        lines.append(
            f"  output  {labelled(self.output_name, self.output_unit)}: {low:g} to {high:g}"
        )
        for e in self.experiments:
            weighted = "" if e.weights is None else ", weighted"
            lines.append(f"  {e.name} [{e.range_text}]{weighted}")
        lines += [f"  note    {note}" for note in self.notes]
        return "\n".join(lines)


# --- Columns for tables of other packages ---------------------------------------------------------


def _columns(data: Dataset) -> tuple[dict[str, Any], dict[str, str]]:
    """Columns of all experiments one after the other, and the units that are known."""
    parts = data.experiments
    made: dict[str, Any] = {}
    if len(parts) > 1:
        made["experiment"] = np.repeat(np.arange(len(parts)), [len(e) for e in parts])
    made["t"] = np.concatenate([(e.start + np.arange(len(e))) * data.Ts for e in parts])
    for i, name in enumerate(data.input_names):
        made[_free(name, made)] = np.concatenate([e.u[:, i] for e in parts])
    inputs = list(made)[-data.n_inputs :]
    output = _free(data.output_name, made)
    made[output] = np.concatenate([e.y for e in parts])
    for name in dict.fromkeys(name for e in parts for name in e.channels):
        rest: list[FloatArray] = [e.channels.get(name, np.full(len(e), np.nan)) for e in parts]
        made[_free(name, made)] = np.concatenate(rest)
    if any(e.weights is not None for e in parts):
        weights = [np.ones(len(e)) if e.weights is None else e.weights for e in parts]
        made[_free("weights", made)] = np.concatenate(weights)
    units = dict(zip((*inputs, output), (*data.input_units, data.output_unit), strict=True))
    return made, {"t": "s"} | {n: u for n, u in units.items() if u}


def _free(name: str, taken: dict[str, Any]) -> str:
    """The name, changed if another column has it already."""
    while name in taken:
        name += "_"
    return name


def _headed(columns: dict[str, Any], units: dict[str, str], wanted: bool) -> dict[str, Any]:
    return {labelled(n, units.get(n, "")): c for n, c in columns.items()} if wanted else columns


def _package(name: str, method: str) -> Any:
    try:
        return import_module(name)
    except ImportError as e:
        raise SettingError(
            f"{method}: expected {name}, which is not installed: pip install {name}"
        ) from e
