"""`Dataset`: inputs and one output at a fixed sample time, in one or several experiments."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError, SettingError
from .runs import runs

FloatArray: TypeAlias = NDArray[np.float64]

SHORTEST_PIECE = 100
"""Samples between two gaps that `Dataset.split_at_gaps` keeps at least."""


def _as_float(values: ArrayLike, what: str) -> FloatArray:
    """Read-only C-contiguous float64; a copy unless the array already is exactly that."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise DataError(
            f"{what}: expected real numbers, received dtype {array.dtype}; convert it to float64"
        )
    if array.dtype != np.float64 or array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=np.float64, order="C")
        array.flags.writeable = False
    return array


def require_dataset(data: object, what: str) -> None:
    """A `Dataset`, or a `DataError` that says how to make one."""
    if not isinstance(data, Dataset):
        raise DataError(
            f"{what}: expected a Dataset, received {type(data).__name__}; make one with "
            "sewfast.read or Dataset.from_arrays"
        )


def _as_column(values: ArrayLike, what: str, n: int | None = None) -> FloatArray:
    array = _as_float(values, what)
    if array.ndim != 1:
        raise DataError(
            f"{what}: expected shape (N,), received {array.shape}; nothing is transposed or "
            "flattened by guess, pass one column"
        )
    if n is not None and len(array) != n:
        raise DataError(
            f"{what}: expected {n} samples, as many as the output, received {len(array)}; "
            "cut both to the same range"
        )
    return array


def _as_inputs(values: ArrayLike, n: int) -> FloatArray:
    """(N, nu), where a single input may come as (N,)."""
    array = _as_float(values, "u")
    if array.ndim == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[0] != n or array.shape[1] == 0:
        raise DataError(
            f"u: expected shape ({n},) or ({n}, n_inputs), time first, as long as y; received "
            f"{np.shape(values)}; nothing is transposed by guess"
        )
    return array


@dataclass(frozen=True, eq=False, repr=False)
class Experiment:
    """One uninterrupted recording.

    Parameters
    ----------
    u : array, shape (N, n_inputs) or (N,)
        Inputs; `u[k]` is held from sample k to k + 1.
    y : array, shape (N,)
        Output, measured before `u[k]` acts. NaN marks samples that were not measured.
    channels : mapping of name to array of shape (N,)
        Further columns for plots and scores (the true speed of a virtual machine, say).
    name : str
        Where it comes from, for messages.
    start : int
        Index of its first sample in the recording that it was cut from.

    Raises
    ------
    DataError
        Where shapes disagree, nothing is left, or the values are not real numbers.
    """

    u: FloatArray
    y: FloatArray
    channels: Mapping[str, FloatArray] = field(default_factory=dict)
    name: str = "array"
    start: int = 0

    def __post_init__(self) -> None:
        y = _as_column(self.y, "y")
        if len(y) == 0:
            raise DataError(f"{self.name}: expected at least 1 sample, received none")
        channels = {key: _as_column(v, key, len(y)) for key, v in self.channels.items()}
        object.__setattr__(self, "y", y)
        object.__setattr__(self, "u", _as_inputs(self.u, len(y)))
        object.__setattr__(self, "channels", MappingProxyType(channels))

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        return f"Experiment({self.name!r}, {self.range_text}, {self.u.shape[1]} input(s))"

    def __reduce__(self) -> tuple[Any, ...]:
        # a mappingproxy cannot be pickled
        return Experiment, (self.u, self.y, dict(self.channels), self.name, self.start)

    @property
    def range_text(self) -> str:
        """Its place in the recording, as `A:B`."""
        return f"{self.start}:{self.start + len(self)}"

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Where inputs and output are finite, shape (N,)."""
        known: NDArray[np.bool_] = np.isfinite(self.u).all(axis=1) & np.isfinite(self.y)
        return known

    def cut(self, start: int, stop: int) -> Experiment:
        """Samples `start` to `stop`, end excluded, as views.

        Raises
        ------
        DataError
            Where the range leaves the experiment or is empty.
        """
        if not 0 <= start < stop <= len(self):
            raise DataError(
                f"{self.name}: expected a range inside 0:{len(self)} with at least one sample, "
                f"received {start}:{stop}"
            )
        channels = {key: v[start:stop] for key, v in self.channels.items()}
        return Experiment(
            self.u[start:stop], self.y[start:stop], channels, self.name, self.start + start
        )


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Recordings of one plant: the same columns, units and sample time in every experiment.

    Immutable. Values may hold NaN; `identify` and `validate` name the sample that they cannot use.

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
        Set where the output is a speed [RPM] computed from an encoder's counts.
    notes : tuple of str
        What was left out when the data set was made.

    Raises
    ------
    DataError
        Where experiments, names and units disagree in number, or Ts is not a positive number.
    """

    experiments: tuple[Experiment, ...]
    Ts: float
    input_names: tuple[str, ...] = ("u",)
    output_name: str = "y"
    input_units: tuple[str, ...] = ("",)
    output_unit: str = ""
    counts: tuple[str, float] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.experiments:
            raise DataError("expected at least one experiment, received none")
        if isinstance(self.Ts, bool) or not (math.isfinite(self.Ts) and self.Ts > 0):
            raise DataError(f"Ts: expected a positive sample time in seconds, received {self.Ts}")
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
    ) -> Dataset:
        """One experiment from arrays, which are copied.

        Parameters
        ----------
        u : array_like, shape (N,) or (N, n_inputs)
        y : array_like, shape (N,), or None
            None where nothing was measured: enough to simulate from rest.
        Ts : float
            Sample time [s].

        Raises
        ------
        DataError
            As for `Experiment` and `Dataset`.
        """
        y = np.full(np.shape(u)[:1], np.nan) if y is None else y
        experiment = Experiment(u, y, channels or {}, name)  # type: ignore[arg-type]
        width = experiment.u.shape[1]
        default = ("u",) if width == 1 else tuple(f"u{i + 1}" for i in range(width))
        return cls(
            (experiment,),
            float(Ts),
            _texts(input_names, default),
            output_name,
            _texts(input_units, ("",) * width),
            output_unit,
        )

    @staticmethod
    def concat(datasets: Iterable[Dataset]) -> Dataset:
        """All experiments of several data sets as one data set; names are taken from the first.

        Raises
        ------
        DataError
            Where there is none, or sample times (1 %), numbers of inputs or units differ.
        """
        parts = tuple(datasets)
        if not parts:
            raise DataError("concat: expected at least one data set, received none")
        first = parts[0]
        for other in parts[1:]:
            first._require_alike(other)
        return replace(
            first,
            experiments=tuple(e for part in parts for e in part.experiments),
            notes=tuple(note for part in parts for note in part.notes),
        )

    def _require_alike(self, other: Dataset) -> None:
        if self.n_inputs != other.n_inputs:
            raise DataError(
                f"expected {self.n_inputs} inputs, as in {self.source}, received {other.n_inputs} "
                f"in {other.source}"
            )
        require_same_units(self, other)
        if abs(self.Ts - other.Ts) > 0.01 * self.Ts:
            raise DataError(
                f"expected one sample time: {self.Ts} s in {self.source}, received {other.Ts} s in "
                f"{other.source}; resample one of them"
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
        return tuple(map(_range_of, u.T))

    @property
    def output_range(self) -> tuple[float, float]:
        """Smallest and largest measured output over all experiments; NaN where there is none."""
        return _range_of(np.concatenate([e.y for e in self.experiments]))

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

    def slice(self, text: str) -> Dataset:
        """`"A:B"` of every experiment, 0-based, end excluded; A or B may be left out.

        Raises
        ------
        SettingError
            Where the text is not a range.
        DataError
            Where the range leaves an experiment or is empty.
        """
        match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", text)
        if match is None:
            raise SettingError(
                f"expected a range A:B, 0-based, end excluded, such as 0:400; received {text!r}"
            )
        start = int(match[1] or 0)
        pieces = (e.cut(start, int(match[2]) if match[2] else len(e)) for e in self.experiments)
        return replace(self, experiments=tuple(pieces))

    def split(self, fraction: float) -> tuple[Dataset, Dataset]:
        """The first `fraction` of every experiment, and the rest of it.

        Raises
        ------
        SettingError
            Where the fraction is not between 0 and 1.
        DataError
            Where an experiment is too short to leave samples on both sides.
        """
        if not 0.0 < fraction < 1.0:
            raise SettingError(f"expected a fraction between 0 and 1, received {fraction}")
        at = [round(fraction * len(e)) for e in self.experiments]
        first = tuple(e.cut(0, k) for e, k in zip(self.experiments, at, strict=True))
        rest = tuple(e.cut(k, len(e)) for e, k in zip(self.experiments, at, strict=True))
        return replace(self, experiments=first), replace(self, experiments=rest)

    def split_at_gaps(self, shortest: int = SHORTEST_PIECE) -> Dataset:
        """The pieces without NaN between the gaps, each as an experiment of its own.

        Parameters
        ----------
        shortest : int
            Samples that a piece must have; shorter ones are left out, which `notes` says. The
            initial state alone takes 20.

        Raises
        ------
        SettingError
            Where `shortest` is no whole number above 0.
        DataError
            Where no piece is left.
        """
        if isinstance(shortest, bool) or not isinstance(shortest, int) or shortest < 1:
            raise SettingError(f"shortest: expected a number of samples above 0, got {shortest!r}")
        pieces = [(e, a, n) for e in self.experiments for a, n in runs(e.measured)]
        kept = tuple(e.cut(a, a + n) for e, a, n in pieces if n >= shortest)
        if not kept:
            longest = max((n for _, _, n in pieces), default=0)
            raise DataError(
                f"{self.source}: expected a piece of at least {shortest} samples without a gap, "
                f"received {longest} at most; record again, or lower `shortest`"
            )
        dropped = tuple(
            f"{e.name}: samples {e.start + a}:{e.start + a + n} between gaps are left out, fewer "
            f"than {shortest}"
            for e, a, n in pieces
            if n < shortest
        )
        return replace(self, experiments=kept, notes=(*self.notes, *dropped))

    def require_inputs(self) -> None:
        """Raise `DataError` that names the first input value that is not finite."""
        for e in self.experiments:
            for name, column in zip(self.input_names, e.u.T, strict=True):
                _require_finite(column, f"{e.name}, input {name!r}", e.start)

    def require_complete(self) -> None:
        """Raise `DataError` that names the first input or output value that is not finite."""
        self.require_inputs()
        for e in self.experiments:
            _require_finite(e.y, f"{e.name}, output {self.output_name!r}", e.start)

    def require_excited(self) -> None:
        """Raise `DataError` where an input or the output never moves: nothing to identify from."""
        for i, name in enumerate(self.input_names):
            if all(np.min(e.u[:, i]) == np.max(e.u[:, i]) for e in self.experiments):
                raise DataError(
                    f"{self.source}: input {name!r} is constant at "
                    f"{self.experiments[0].u[0, i]:g}; expected an input that moves; "
                    "record with an excitation (`sewfast signals`)"
                )
        if all(np.min(e.y) == np.max(e.y) for e in self.experiments):
            raise DataError(
                f"{self.source}: output {self.output_name!r} is constant at "
                f"{self.experiments[0].y[0]:g}; expected an output that follows the input; check "
                "the column and the sensor"
            )

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
        lines += [f"  {e.name} [{e.range_text}]" for e in self.experiments]
        lines += [f"  note    {note}" for note in self.notes]
        return "\n".join(lines)


def require_same_units(one: HasUnits, other: Dataset) -> None:
    """Raise `DataError` where a unit is known on both sides and differs."""
    mine = (*one.input_units, one.output_unit)
    for unit, received in zip(mine, (*other.input_units, other.output_unit), strict=True):
        if unit and received and unit != received:
            raise DataError(
                f"{other.source}: expected the unit {unit!r}, received {received!r}; convert "
                "the data"
            )


class HasUnits(Protocol):
    """A data set or a model."""

    @property
    def input_units(self) -> tuple[str, ...]: ...
    @property
    def output_unit(self) -> str: ...


def labelled(name: str, unit: str) -> str:
    """`name [unit]`, or the name alone where the unit is unknown."""
    return f"{name} [{unit}]" if unit else name


def _range_of(column: FloatArray) -> tuple[float, float]:
    known = column[~np.isnan(column)]
    return (float(known.min()), float(known.max())) if len(known) else (math.nan, math.nan)


def _texts(value: str | Sequence[str] | None, default: tuple[str, ...]) -> tuple[str, ...]:
    if value is None:
        return default
    return (value,) if isinstance(value, str) else tuple(value)


def _require_finite(column: FloatArray, what: str, start: int) -> None:
    bad = ~np.isfinite(column)
    if not bad.any():
        return
    if bad.all():
        raise DataError(f"{what}: every value is NaN or infinite; expected a measured column")
    k = int(np.argmax(bad))
    raise DataError(
        f"{what}: expected finite values, received {column[k]} at sample {start + k} (0-based; "
        f"{int(bad.sum())} such in {len(column)} samples); repair it, choose a range without it, "
        "or take the pieces between: Dataset.split_at_gaps (--split-at-gaps)"
    )
