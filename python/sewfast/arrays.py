"""Columns of numbers in the package's form, their names and units, runs of True in a mask."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Protocol, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError, SettingError
from .units import spelled

# --- Names and units of columns -------------------------------------------------------------------


class HasUnits(Protocol):
    """A data set or a model."""

    @property
    def input_units(self) -> tuple[str, ...]: ...
    @property
    def output_unit(self) -> str: ...


class HasSource(HasUnits, Protocol):
    """A data set, with the name of its source."""

    @property
    def source(self) -> str: ...


def require_same_units(one: HasUnits, other: HasSource) -> None:
    """Raise `DataError` if a unit is known on both sides and differs."""
    mine = (*one.input_units, one.output_unit)
    for unit, received in zip(mine, (*other.input_units, other.output_unit), strict=True):
        if unit and received and spelled(unit) != spelled(received):
            raise DataError(
                name=other.source, expected=f"the unit {unit!r}", received=f"{received!r}",
                remedy="convert the data",
            )  # fmt: skip


def labelled(name: str, unit: str) -> str:
    """`name [unit]`, or the name alone for an unknown unit."""
    return f"{name} [{unit}]" if unit else name


def in_unit(number: str, unit: str) -> str:
    """`number unit`, or the number alone for an unknown unit."""
    return f"{number} {unit}" if unit else number


# --- Arguments -> read-only columns of float64 ----------------------------------------------------


FloatArray: TypeAlias = NDArray[np.float64]


def on_grid(values: ArrayLike, span: float, bits: int = 24) -> FloatArray:
    """Deviations from a level, rounded to so many bits of a span.
    Beside a level, numbers lose their last digits, and a search may end elsewhere by one of them:
    on a grid the same deviations are the same bits at every level.
    """
    found = np.asarray(values, dtype=np.float64)
    if not 0.0 < span < math.inf:
        return found
    step = math.ldexp(1.0, math.frexp(span)[1] - bits)
    return found if step == 0.0 else np.round(found / step) * step


def limits_about(low: float, high: float, level: float) -> tuple[float, float]:
    """A lower and an upper limit as deviations from a level, on a grid of the room between them."""
    found = on_grid([low - level, high - level], high - low, bits=34)
    return float(found[0]), float(found[1])


def deviations(values: FloatArray, level: float) -> FloatArray:
    """Values as deviations from a level, on a grid of their span; at a level of 0 as they are."""
    if level == 0.0 or not len(values):
        return values
    return on_grid(values - level, float(np.ptp(values)))


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is a whole number of Python or NumPy; True and False are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def require_whole(name: str, value: object, low: int, high: int) -> None:
    """Raise `SettingError` for anything but an `int` from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise SettingError(
            name=name, expected=f"a whole number from {low} to {high}", received=repr(value)
        )


def as_float(values: ArrayLike, what: str) -> FloatArray:
    """Read-only C-contiguous float64; a copy unless the array already is exactly that."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise DataError(
            name=what, expected="real numbers", received=f"dtype {array.dtype}",
            remedy="convert it to float64",
        )  # fmt: skip
    if array.dtype != np.float64 or array.flags.writeable or not array.flags.c_contiguous:
        array = np.array(array, dtype=np.float64, order="C")
        array.flags.writeable = False
    return array


def frozen(array: FloatArray) -> FloatArray:
    """A new array made read-only without a copy."""
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def as_column(values: ArrayLike, what: str, n: int | None = None) -> FloatArray:
    array = as_float(values, what)
    if array.ndim != 1:
        raise DataError(
            name=what, expected="shape (N,)", received=f"{array.shape}",
            remedy="nothing is transposed or flattened by guess, pass one column",
        )  # fmt: skip
    if n is not None and len(array) != n:
        raise DataError(
            name=what, expected=f"{n} samples, as many as the output", received=f"{len(array)}",
            remedy="cut both to the same range",
        )  # fmt: skip
    return array


def as_inputs(values: ArrayLike, n: int) -> FloatArray:
    """Inputs as (N, nu); a single input can be (N,)."""
    array = as_float(values, "u")
    if array.ndim == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or array.shape[0] != n or array.shape[1] == 0:
        raise DataError(
            name="u", expected=f"shape ({n},) or ({n}, n_inputs), time first, as long as y",
            received=f"{np.shape(values)}", remedy="nothing is transposed by guess",
        )  # fmt: skip
    return array


def known_until(*columns: FloatArray) -> int:
    """How many entries come before the first that is not finite in one of the columns."""
    known = np.logical_and.reduce([np.isfinite(column) for column in columns])
    return len(known) if known.all() else int(np.argmin(known))


def range_of(column: FloatArray) -> tuple[float, float]:
    known = column[~np.isnan(column)]
    return (float(known.min()), float(known.max())) if len(known) else (math.nan, math.nan)


def texts(value: str | Sequence[str] | None, default: tuple[str, ...]) -> tuple[str, ...]:
    if value is None:
        return default
    return (value,) if isinstance(value, str) else tuple(value)


# --- Runs of one value in a column: gaps, and the pieces between them -----------------------------


def runs(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    """First index and length of each run of True in a mask of shape (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return tuple((int(a), int(b - a)) for a, b in edges.reshape(-1, 2))


def bridged(column: FloatArray, known: NDArray[np.bool_] | None = None) -> FloatArray:
    """The column with straight lines over what is not known, by default what is not finite; level
    beyond its ends.
    """
    at = np.flatnonzero(np.isfinite(column) if known is None else known)
    return np.interp(np.arange(len(column)), at, column[at])


# --- Products of tall matrices --------------------------------------------------------------------


def gram(a: FloatArray, b: FloatArray | None = None) -> FloatArray:
    """a'b, or a'a, of tall matrices (N, p) and (N, q): a sum over blocks of rows.
    A block is so small that BLAS takes one thread for it. The bits are then the same with any
    number of processors; and a busy computer does not keep it waiting for threads, which took eight
    times as long.
    """
    b = a if b is None else b
    total = np.zeros((a.shape[1], b.shape[1]))
    for rows in _blocks(len(a), total.size):
        total += a[rows].T @ b[rows]
    return total


def product(a: FloatArray, x: FloatArray) -> FloatArray:
    """a x of a tall matrix (N, p) and a small one (p, q), in blocks of rows as `gram`."""
    found = np.empty((len(a), x.shape[1]))
    for rows in _blocks(len(a), x.size):
        np.matmul(a[rows], x, out=found[rows])
    return found


def _blocks(n: int, per_row: int) -> Iterator[slice]:
    """Blocks of n rows, each with so many multiplications per row."""
    # multiplications in one product: half of what OpenBLAS leaves to one thread
    rows = max(1, 2**17 // max(1, per_row))
    for at in range(0, n, rows):
        yield slice(at, at + rows)
