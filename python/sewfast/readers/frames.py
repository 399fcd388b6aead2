"""Tables in memory: pandas, polars, Arrow, xarray or a mapping of columns -> `Table`.

None of these packages is imported before one of its objects is passed. Missing values (null, NA,
NaT) become NaN; moments and durations become seconds from the first one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import DataError, SettingError, not_installed
from .containers import ELEMENTS, Table, from_headers
from .timebase import seconds_of_objects

_NUMBER = (int, float, np.number, Decimal)

Found = tuple[str, FloatArray | None, str, str]
"""Header, numbers or None, unit if the header lacks it, reason why there are no numbers."""


def table_of(frame: Any) -> Table:
    """The numeric columns of a table in memory: pandas, polars, xarray, NumPy, mapping or Arrow.
    pyarrow reads anything with `__arrow_c_stream__`. A pandas index becomes a column if it is named
    or holds moments, `t` without a name; of several levels only the named ones do. Units are from
    headers such as `u [V]`, `attrs["units"]` (pandas, xarray) or a field's metadata `unit` (Arrow).
    """
    kinds = {c.__module__.partition(".")[0] for c in type(frame).__mro__}
    if "polars" in kinds and hasattr(frame, "collect"):
        frame = _collected_lazily(frame)
    if "pandas" in kinds and hasattr(frame, "columns"):
        found = _of_pandas(frame)
    elif "polars" in kinds and hasattr(frame, "columns"):
        found = _of_polars(frame)
    elif "xarray" in kinds:
        found = _of_xarray(frame)
    elif isinstance(frame, np.ndarray) and frame.dtype.names:
        found = ((n, *_numbers(frame[n])) for n in frame.dtype.names)
    elif isinstance(frame, Mapping):
        found = ((str(n), *_numbers(_array(v))) for n, v in frame.items())
    elif hasattr(frame, "__arrow_c_stream__"):
        found = of_arrow(_arrow(frame))
    else:
        raise SettingError(
            "expected a file's path or a table (pandas, polars, pyarrow, xarray, a dict of "
            f"columns), got {type(frame).__name__}; for arrays: Dataset.from_arrays"
        )
    return collected(Path(type(frame).__name__), found)


def _collected_lazily(frame: Any) -> Any:
    """The table of a polars LazyFrame, which is computed only now and can raise anything."""
    try:
        return frame.collect()
    except Exception as e:
        reason = str(e).partition("\n")[0]
        raise DataError(
            f"LazyFrame: expected a query that can be computed, received {type(e).__name__}: "
            f"{reason}; correct the query"
        ) from e


def collected(path: Path, found: Iterator[Found]) -> Table:
    """A table made of the columns found; raises `DataError` if there are no rows."""
    headers, columns, bad, units = [], [], {}, {}
    for i, (header, values, unit, why) in enumerate(found):
        headers.append(header)
        columns.append(np.empty(0) if values is None else values)
        if values is None:
            bad[i] = f"column {header!r} {why}; expected numbers"
        if unit:
            units[header] = unit
    if not any(len(c) for c in columns) and not bad:
        raise DataError(f"{path}: expected rows of numbers, received none")
    table = from_headers(path, headers, columns, bad)
    known = {**table.units, **{n: u for n, u in units.items() if n in table.columns}}
    return Table(path, table.columns, known, table.unusable)


def of_arrow(table: Any, labels: Mapping[str, Sequence[str]] | None = None) -> Iterator[Found]:
    """Columns of a pyarrow table; columns of text only if they hold numbers or moments. A column of
    lists of one length becomes `NAME.LABEL` of its `labels`, or `NAME.0` and so on.
    """
    import pyarrow as pa

    lists = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    for i, entry in enumerate(table.schema):
        column, metadata = table.column(i), entry.metadata or {}
        if any(is_list(entry.type) for is_list in lists):
            yield from _of_lists(entry.name, column.to_pylist(), (labels or {}).get(entry.name, ()))
            continue
        unit = metadata.get(b"unit", b"").decode("utf-8", "replace")
        try:
            if pa.types.is_temporal(entry.type):
                yield entry.name, *_numbers(column.to_numpy())
            else:
                numbers = column.cast(pa.float64(), safe=False).to_numpy()
                yield entry.name, numbers, unit, ""
        except pa.ArrowException:
            if pa.types.is_string(entry.type) or pa.types.is_large_string(entry.type):
                yield entry.name, *_numbers(np.array(column.to_pylist(), dtype=object))
            else:
                yield entry.name, None, "", f"holds {entry.type}"


def _of_lists(name: str, rows: list[Any], labels: Sequence[str]) -> Iterator[Found]:
    try:
        array = np.array(rows, dtype=np.float64)
    except (ValueError, TypeError):
        array = np.empty(0)
    if array.ndim != 2 or array.shape[1] > ELEMENTS:
        yield name, None, "", f"holds lists that are not of one length up to {ELEMENTS}"
        return
    known = len(labels) == array.shape[1]
    for k, column in enumerate(array.T):
        yield f"{name}.{labels[k] if known else k}", column, "", ""


def _arrow(frame: Any) -> Any:
    try:
        import pyarrow as pa
    except ImportError as e:
        raise not_installed("pyarrow", f"reading {type(frame).__name__}", "sewfast[parquet]") from e
    try:
        return pa.table(frame)
    except pa.ArrowException as e:
        # a single column, such as a Series, is a stream as well
        raise SettingError(
            f"expected a table with a column for each signal, got {type(frame).__name__}: put the "
            "columns into one DataFrame, or use Dataset.from_arrays"
        ) from e


def _of_pandas(frame: Any) -> Iterator[Found]:
    units = frame.attrs.get("units", {})
    for index in map(frame.index.get_level_values, range(frame.index.nlevels)):
        if hasattr(index, "to_timestamp"):  # periods: each begins at a moment
            index = index.to_timestamp()
        numbered = index.name is None and (index.dtype.kind in "iu" or frame.index.nlevels > 1)
        name = str(index.name or "t")
        if not numbered and index.dtype.kind in "iufmM" and name not in map(str, frame.columns):
            yield _with_unit(name, _of_series(index), units)
    for i, name in enumerate(frame.columns):
        # by position: a name can occur twice
        yield _with_unit(str(name), _of_series(frame.iloc[:, i]), units)


def _of_series(column: Any) -> tuple[FloatArray | None, str, str]:
    """Numbers, unit and reason of a column or an index of pandas."""
    if str(column.dtype).startswith("period"):
        column = column.dt.to_timestamp()
    if column.dtype.kind in "mM":
        # a moment with a time zone becomes one in UTC
        return _numbers(column.to_numpy(dtype=f"{column.dtype.kind}8[ns]"))
    if column.dtype.kind in "iufb":
        return column.to_numpy(dtype=np.float64, na_value=np.nan), "", ""
    if column.dtype.kind == "c":
        return None, "", f"holds {column.dtype}"
    values: Any = np.where(column.isna(), None, column.to_numpy(dtype=object))
    return _numbers(values)


def _of_polars(frame: Any) -> Iterator[Found]:
    for name in frame.columns:
        column = frame[name]
        if column.dtype.is_decimal() or "128" in str(column.dtype):
            # NumPy has no such integers
            yield name, *_numbers(column.cast(float).to_numpy())
        elif column.dtype.is_temporal() or column.dtype.is_numeric():
            yield name, *_numbers(column.to_numpy())
        elif str(column.dtype) == "String":
            yield name, *_numbers(np.array(column.to_list(), dtype=object))
        elif str(column.dtype) == "Boolean":
            yield name, *_numbers(column.cast(int).to_numpy())
        else:
            yield name, None, "", f"holds {column.dtype}"


def _of_xarray(frame: Any) -> Iterator[Found]:
    if not hasattr(frame, "data_vars"):
        frame = frame.to_dataset(name=str(frame.name or "values"))
    for name, column in {**frame.coords, **frame.data_vars}.items():
        if column.ndim == 1:
            values, unit, why = _numbers(column.to_numpy())
            yield str(name), values, str(column.attrs.get("units", unit)), why
        else:
            yield str(name), None, "", f"has dimensions {column.dims}"


def _with_unit(name: str, found: tuple[Any, str, str], units: Any) -> Found:
    values, unit, why = found
    return name, values, str(units.get(name, unit)) if isinstance(units, Mapping) else unit, why


def _array(values: Any) -> NDArray[Any]:
    try:
        if isinstance(values, np.ma.MaskedArray):
            # masked values were not measured
            mask = np.ma.getmaskarray(values)
            return np.where(mask, np.nan, np.asarray(values.data, dtype=np.float64))
        return np.asarray(values)
    except (ValueError, TypeError):
        # lists of different lengths, or no list at all
        return np.empty((0, 0))


def _numbers(values: NDArray[Any]) -> tuple[FloatArray | None, str, str]:
    """Numbers, their unit if they are seconds, or the reason why there are none."""
    kind = values.dtype.kind
    if values.ndim != 1:
        return None, "", f"has shape {values.shape}"
    if kind in "iufb":
        return values.astype(np.float64), "", ""
    if kind in "mM":
        known = values[~np.isnat(values)]
        since = values - known[0] if kind == "M" and len(known) else values
        return since / np.timedelta64(1, "s"), "s", ""
    if kind == "O" and all(v is None or isinstance(v, _NUMBER) for v in values):
        return np.array([np.nan if v is None else v for v in values], dtype=np.float64), "", ""
    if kind in "OUT" and (seconds := seconds_of_objects(values.tolist())) is not None:
        return seconds, "s", ""
    return None, "", f"holds {_held(values)}"


def _held(values: NDArray[Any]) -> str:
    """The kind of values in an array without numbers."""
    if values.dtype.kind != "O":
        return "text" if values.dtype.kind in "UT" else str(values.dtype)
    one = next((v for v in values if v is not None and not isinstance(v, _NUMBER)), None)
    return "text" if isinstance(one, str) else type(one).__name__
