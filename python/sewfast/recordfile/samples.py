"""Columns of numbers <-> messages of samples (JSON)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray
from ..errors import DataError

MOST_GAPS_LISTED = 10_000
"""Gaps that the completeness message spells out; they follow from the samples anyway."""
EXACT = 2**53
"""Whole numbers up to here are exact in float64."""


def numbers(name: str, values: object) -> list[Any]:
    """A column as JSON values that read back to the same float64; NaN is null.

    Whole numbers are written as such, float32 by the shortest text that gives the same float32.

    Raises
    ------
    DataError
        For anything but one column of real numbers, for infinity and whole numbers above 2^53.
    """
    array = np.asarray(values)
    if array.ndim != 1 or array.dtype.kind not in "biuf":
        raise DataError(
            f"{name}: expected real numbers of shape (N,), received {array.dtype} of shape "
            f"{array.shape}; pass one column of numbers"
        )
    if array.dtype.kind != "f":
        return _whole(name, array)
    return _real(name, array)


def _whole(name: str, array: NDArray[Any]) -> list[int]:
    if len(array) and max(-int(array.min()), int(array.max())) > EXACT:
        raise DataError(
            f"{name}: expected whole numbers of at most 2^53, received {array.min()} to "
            f"{array.max()}; subtract the first one"
        )
    whole: list[int] = array.astype(np.int64).tolist()
    return whole


def _real(name: str, array: NDArray[Any]) -> list[Any]:
    if array.dtype.itemsize < 8:
        array = array.astype(str)
    array = array.astype(np.float64)
    if np.isinf(array).any():
        k = int(np.argmax(np.isinf(array)))
        raise DataError(
            f"{name}: expected finite numbers, or NaN where nothing was measured, received "
            f"{array[k]} at row {k}"
        )
    negative_zero = (array == 0) & np.signbit(array)
    if np.all((np.rint(array) == array) & (np.abs(array) <= EXACT) & ~negative_zero):
        return array.astype(np.int64).tolist()  # type: ignore[no-any-return]
    missing = np.isnan(array).any()
    return [None if v != v else v for v in array.tolist()] if missing else array.tolist()


def encode(first: int, Ts: float, columns: Mapping[str, list[Any]]) -> bytes:
    """The message of consecutive samples from number `first` on."""
    count = len(next(iter(columns.values())))
    index = range(first, first + count)
    own: dict[str, Any] = {"index": list(index), "t": [round(k * Ts, 9) for k in index]}
    return dumps({**own, **columns})


def dumps(content: Mapping[str, Any]) -> bytes:
    """A message's JSON: ASCII, no spaces, finite numbers."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


def parse(data: bytes) -> dict[str, Any]:
    """A message's JSON object.

    Raises
    ------
    ValueError
        Where it is none, or holds numbers that are not finite.
    """
    try:
        content = json.loads(data, parse_constant=_refuse)
    except RecursionError as e:
        raise ValueError("it is nested too deeply") from e
    if not isinstance(content, dict):
        raise ValueError("it is no JSON object")
    return content


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


class Block(NamedTuple):
    """Samples of one message: their numbers, and the columns in the header's order."""

    numbers: NDArray[np.int64]
    columns: tuple[FloatArray, ...]


def decode(content: Mapping[str, Any], names: Iterable[str]) -> Block:
    """The samples of a parsed message.

    Raises
    ------
    ValueError
        Where columns are missing or differ in length, numbers are not finite, or the samples'
        numbers do not increase.
    """
    index = _column(content, "index", (int,))
    if len(index) == 0 or index.min() < 0 or index.max() > EXACT or np.any(np.diff(index) <= 0):
        raise ValueError("the samples' numbers do not increase from 0 on")
    columns = tuple(_column(content, name, (int, float, type(None))) for name in names)
    if any(len(c) != len(index) for c in columns):
        raise ValueError("columns differ in length")
    return Block(index.astype(np.int64), columns)


def _column(content: Mapping[str, Any], name: str, kinds: tuple[type, ...]) -> FloatArray:
    values = content.get(name, ())
    if type(values) in kinds:
        # one message a sample
        values = [values]
    # the exact type: True is no number here, and NumPy would take text for one
    if not isinstance(values, list) or not set(map(type, values)) <= set(kinds):
        raise ValueError(f"column {name!r} is missing or holds no numbers")
    try:
        array = np.array(values, dtype=np.float64)
    except OverflowError as e:
        raise ValueError(f"column {name!r} holds a number beyond float64") from e
    if np.isinf(array).any():
        raise ValueError(f"column {name!r} holds a number beyond float64")
    return array
