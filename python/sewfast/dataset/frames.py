"""A data set as a table of pandas, polars, Arrow or xarray."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arrays import FloatArray, labelled
from ..errors import SettingError

if TYPE_CHECKING:
    from .dataset import Dataset


def to_pandas(data: Dataset, *, units: bool = False) -> Any:
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
    columns, known = _columns(data)
    frame = _package("pandas", "to_pandas").DataFrame(_headed(columns, known, units))
    frame.attrs["units"] = known
    return frame


def to_polars(data: Dataset, *, units: bool = False) -> Any:
    """The samples as a polars DataFrame, with the columns of `to_pandas`; null means not measured.

    Parameters
    ----------
    units : bool
        Whether headers hold units, `u [V]`; a polars table has no other place for them.

    Raises
    ------
    SettingError
        If polars is not installed.
    """
    columns, known = _columns(data)
    return _package("polars", "to_polars").DataFrame(
        _headed(columns, known, units), nan_to_null=True
    )


def to_arrow(data: Dataset, *, units: bool = False) -> Any:
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
    columns, known = _columns(data)
    pa = _package("pyarrow", "to_arrow")
    fields, arrays = [], []
    for name, values in columns.items():
        header = labelled(name, known.get(name, "")) if units else name
        arrays.append(pa.array(values, from_pandas=True))
        metadata = {"unit": known[name]} if known.get(name) else None
        fields.append(pa.field(header, arrays[-1].type, metadata=metadata))
    return pa.table(arrays, schema=pa.schema(fields))


def to_xarray(data: Dataset) -> Any:
    """The samples as an xarray Dataset over the coordinate `t` [s]; `attrs["units"]` per variable.

    Several experiments follow one another along `sample`, with the coordinates `t` and
    `experiment`. NaN means not measured.

    Raises
    ------
    SettingError
        If xarray is not installed.
    """
    columns, known = _columns(data)
    several = "experiment" in columns and len(data.experiments) > 1
    along = "sample" if several else "t"
    coordinates = ("experiment", "t") if several else ("t",)
    made = {
        name: (along, values, {"units": known[name]} if known.get(name) else {})
        for name, values in columns.items()
    }
    return _package("xarray", "to_xarray").Dataset(
        {n: c for n, c in made.items() if n not in coordinates},
        coords={n: made[n] for n in coordinates},
        attrs={"sample_time_s": data.Ts},
    )


def arrow_stream(data: Dataset, requested_schema: Any = None) -> Any:
    """Arrow's stream of the samples, for `polars.DataFrame(data)`, DuckDB and others."""
    return to_arrow(data).__arrow_c_stream__(requested_schema)


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
