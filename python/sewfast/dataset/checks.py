"""What a data set must fulfil before it is used."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import DataError
from .arrays import FloatArray, range_of
from .units import require_same_units

if TYPE_CHECKING:
    from .dataset import Dataset


INPUT_REMEDY = (
    "a simulation needs every input: choose a range without it, take the pieces between, "
    "Dataset.split_at_gaps (--split-at-gaps), or say what the input was: "
    'Dataset.fill_inputs("hold") assumes that it stayed as it was last known (--hold-inputs)'
)
OUTPUT_REMEDY = (
    "repair it, choose a range without it, or take the pieces between: "
    "Dataset.split_at_gaps (--split-at-gaps)"
)


def require_dataset(data: object, what: str) -> None:
    """A `Dataset`, or a `DataError` that says how to make one."""
    from .dataset import Dataset

    if not isinstance(data, Dataset):
        raise DataError(
            f"{what}: expected a Dataset, received {type(data).__name__}; make one with "
            "sewfast.read or Dataset.from_arrays"
        )


def require_alike(data: Dataset, other: Dataset) -> None:
    """Raise `DataError` where two data sets cannot be one: inputs, units, sample time (1 %)."""
    if data.n_inputs != other.n_inputs:
        raise DataError(
            f"expected {data.n_inputs} inputs, as in {data.source}, received {other.n_inputs} "
            f"in {other.source}"
        )
    require_same_units(data, other)
    if abs(data.Ts - other.Ts) > 0.01 * data.Ts:
        raise DataError(
            f"expected one sample time: {data.Ts} s in {data.source}, received {other.Ts} s in "
            f"{other.source}; resample one of them"
        )


def require_inputs(data: Dataset) -> None:
    """Raise `DataError` that names the first input value that is not finite."""
    for e in data.experiments:
        for name, column in zip(data.input_names, e.u.T, strict=True):
            require_finite(column, f"{e.name}, input {name!r}", e.start, INPUT_REMEDY)


def require_measured(data: Dataset, least: int = 1) -> None:
    """Raise `DataError` unless every input is known and enough outputs were measured.

    An output that is NaN was not measured and is no error; an infinite one is.

    Parameters
    ----------
    least : int
        Measured outputs that every experiment must have.
    """
    require_inputs(data)
    for e in data.experiments:
        what = f"{e.name} [{e.range_text}], output {data.output_name!r}"
        if np.isinf(e.y).any():
            k = int(np.argmax(np.isinf(e.y)))
            raise DataError(
                f"{what}: expected finite values, or NaN where it was not measured, received "
                f"{e.y[k]} at sample {e.start + k} (0-based); set it to NaN: Dataset.mask"
            )
        measured = len(e) - e.unmeasured
        if measured == 0 < least:
            raise DataError(f"{what}: every value is NaN; expected a measured column")
        if measured < least:
            raise DataError(
                f"{what}: expected at least {least} samples, received {e.counted}; "
                "leave this experiment out, or record again"
            )


def require_complete(data: Dataset) -> None:
    """Raise `DataError` that names the first input or output value that is not finite."""
    require_inputs(data)
    for e in data.experiments:
        require_finite(e.y, f"{e.name}, output {data.output_name!r}", e.start, OUTPUT_REMEDY)


LARGEST = 1e150
"""Magnitude from which on squares leave the numbers: no measured quantity."""
LARGEST_FITTED, SMALLEST_FITTED = 1e60, 1e-60
"""Magnitude and range between which covariances and their inverses stay within the numbers."""


def require_sane(data: Dataset, largest: float = LARGEST) -> None:
    """Raise `DataError` where a value is infinite or beyond any measured quantity; NaN is none."""
    for e in data.experiments:
        columns = zip((*data.input_names, data.output_name), (*e.u.T, e.y), strict=True)
        for name, column in columns:
            bad = np.abs(column) >= largest
            if bad.any():
                k = int(np.argmax(bad))
                raise DataError(
                    f"{e.name}, {name!r}: expected finite values below {largest:g}, or NaN where "
                    f"nothing is known, received {column[k]:g} at sample {e.start + k} (0-based); "
                    "set it to NaN (of an output: Dataset.mask), or change the unit"
                )


def require_excited(data: Dataset) -> None:
    """Raise `DataError` where an input or the output never moves: nothing to identify from."""
    for i, name in enumerate(data.input_names):
        if all(np.min(e.u[:, i]) == np.max(e.u[:, i]) for e in data.experiments):
            raise DataError(
                f"{data.source}: input {name!r} is constant at "
                f"{data.experiments[0].u[0, i]:g}; expected an input that moves; "
                "record with an excitation (`sewfast signals`)"
            )
    ranges = [range_of(e.y) for e in data.experiments]
    if not any(low < high for low, high in ranges):
        raise DataError(
            f"{data.source}: output {data.output_name!r} is constant at {ranges[0][0]:g}; expected "
            "an output that follows the input; check the column and the sensor"
        )


def require_fittable(data: Dataset) -> None:
    """Raise `DataError` where values are so large, or move so little, that no fit can square them.

    To be asked after `require_measured`: infinite values are named there.
    """
    require_sane(data, LARGEST_FITTED)
    columns = [*np.concatenate([e.u for e in data.experiments]).T]
    columns.append(np.concatenate([e.y for e in data.experiments]))
    for name, column in zip((*data.input_names, data.output_name), columns, strict=True):
        low, high = range_of(column)
        if high - low < SMALLEST_FITTED:
            raise DataError(
                f"{data.source}, {name!r}: expected values that differ by {SMALLEST_FITTED:g} or "
                f"more, received {low:g} to {high:g}; change the unit, or check the column"
            )


def require_finite(column: FloatArray, what: str, start: int, remedy: str) -> None:
    """Raise `DataError` that names the first value that is not finite."""
    bad = ~np.isfinite(column)
    if not bad.any():
        return
    if bad.all():
        raise DataError(f"{what}: every value is NaN or infinite; expected a measured column")
    k = int(np.argmax(bad))
    raise DataError(
        f"{what}: expected finite values, received {column[k]} at sample {start + k} (0-based; "
        f"{int(bad.sum())} such in {len(column)} samples); {remedy}"
    )
