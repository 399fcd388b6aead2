"""Tables in memory in and out: pandas, polars, Arrow, xarray, dicts of columns."""

from __future__ import annotations

import datetime
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np
import pytest

import sewfast
from refusals import refuses
from sewfast import DataError, Dataset, SettingError

TS = 0.01
N = 300
T = TS * np.arange(N)
U = np.sin(3.0 * T)
Y = np.where((T > 1.0) & (T < 1.1), np.nan, np.cos(T))


def data() -> Dataset:
    return Dataset.from_arrays(
        U, Y, TS, input_units="V", output_unit="RPM", output_name="speed", channels={"true": 2 * Y}
    )


def require_same(found: Dataset, *, units: bool = True) -> None:
    e = found.experiments[0]
    assert found.Ts == pytest.approx(TS)
    assert np.array_equal(e.u[:, 0], U)
    assert np.array_equal(e.y, Y, equal_nan=True)
    assert np.array_equal(e.channels["true"], 2 * Y, equal_nan=True)
    if units:
        assert (found.input_units, found.output_unit) == (("V",), "RPM")


def read(frame: Any) -> Dataset:
    return sewfast.read(frame, inputs="u", output="speed", channels=["true"])


# --- there and back -------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["pandas", "polars", "pyarrow", "xarray"])
def test_a_data_set_comes_back_from_a_table(package: str) -> None:
    pytest.importorskip(package)
    make: dict[str, Callable[[Dataset], Any]] = {
        "pandas": Dataset.to_pandas, "polars": Dataset.to_polars, "pyarrow": Dataset.to_arrow,
        "xarray": Dataset.to_xarray,
    }  # fmt: skip
    require_same(read(make[package](data())), units=package != "polars")
    if package != "xarray":
        frame = make[package](data(), units=True)  # type: ignore[call-arg]
        assert "speed [RPM]" in (frame.column_names if package == "pyarrow" else frame.columns)
        require_same(read(frame))


def test_what_was_not_measured_is_null() -> None:
    pytest.importorskip("pyarrow")
    missing = int(np.isnan(Y).sum())
    assert data().to_arrow()["speed"].null_count == missing
    polars = pytest.importorskip("polars")
    assert data().to_polars()["speed"].null_count() == missing
    assert polars.DataFrame(data())["speed"].null_count() == missing
    pandas = pytest.importorskip("pandas")
    assert data().to_pandas()["speed"].isna().sum() == missing
    assert isinstance(data().to_pandas(), pandas.DataFrame)


def test_several_experiments_are_numbered() -> None:
    pytest.importorskip("pandas")
    weighted = replace(data().experiments[0], weights=np.ones(N))
    both = Dataset.concat([data()[:100], replace(data(), experiments=(weighted,))])
    frame = both.to_pandas()
    assert list(frame.columns) == ["experiment", "t", "u", "speed", "true", "weights"]
    assert frame.groupby("experiment").size().tolist() == [100, N]
    require_same(read(frame[frame.experiment == 1]))
    pytest.importorskip("xarray")
    assert both.to_xarray().sizes == {"sample": 100 + N}


def test_names_that_meet_are_told_apart() -> None:
    pytest.importorskip("pandas")
    frame = Dataset.from_arrays(U, Y, TS, input_names="t", output_name="t").to_pandas()
    assert list(frame.columns) == ["t", "t_", "t__"]


# --- in -------------------------------------------------------------------------------------------


def test_a_dict_of_columns_is_a_table() -> None:
    columns = {"t": T, "u [V]": U, "speed (RPM)": Y, "true": (2 * Y).tolist(), "who": ["me"] * N}
    require_same(read(columns))
    with pytest.raises(DataError, match=r"dict: column 'who' holds text; expected numbers"):
        sewfast.read(columns, inputs="who")
    with pytest.raises(DataError, match="did you mean 'speed'"):
        sewfast.read(columns, inputs="u", output="sped")
    with pytest.raises(DataError, match="expected rows"):
        sewfast.read({}, inputs="u")
    for wrong in ([[1.0], [1.0, 2.0]], data(), 3.0):
        with pytest.raises(DataError, match="shape"):
            sewfast.read({"u": wrong}, inputs="u")


def test_another_object_is_refused() -> None:
    for wrong in (3, None, np.zeros(5), [1.0, 2.0]):
        with pytest.raises(SettingError, match=r"pandas.*from_arrays"):
            sewfast.read(wrong, inputs="u")


def test_pandas_kinds_of_columns() -> None:
    pd = pytest.importorskip("pandas")
    missing = [1.0, None, 3.0] * (N // 3)
    frame = pd.DataFrame(
        {
            "u": pd.array([1, None, 3] * (N // 3), dtype="Int64"),
            "y": pd.array(missing, dtype="Float64"),
            "on": pd.array([True, False, None] * (N // 3), dtype="boolean"),
            "off": np.arange(N) % 2 == 0,
            "mixed": np.array(missing, dtype=object),
            "word": ["a"] * N,
            "kind": pd.Categorical(["a"] * N),
        },
        index=pd.date_range("2026-01-01", periods=N, freq="10ms", tz="Europe/Berlin"),
    )
    table = sewfast.read_table(frame)
    assert table.names == ("t", "u", "y", "on", "off", "mixed")
    assert set(table.unusable) == {"word", "kind"}
    assert table.unit("t") == "s"
    for name in ("u", "y", "mixed"):
        assert np.array_equal(table[name][:3], [1.0, np.nan, 3.0], equal_nan=True)
    assert np.array_equal(table["on"][:3], [1.0, 0.0, np.nan], equal_nan=True)
    found = sewfast.read(frame[["u", "y"]].fillna(0.0), inputs="u", output="y")
    assert found.Ts == pytest.approx(0.01)
    # rows that were dropped are gaps of the time, as in a file
    gaps = sewfast.read(frame.iloc[np.r_[0:100, 110:N]], inputs="off", output="y")
    assert len(gaps) == N
    assert "missing" in gaps.notes[0]


def test_pandas_index_is_time_where_it_says_so() -> None:
    pd = pytest.importorskip("pandas")
    columns = {"u": U, "y": Y}
    assert sewfast.read_table(pd.DataFrame(columns)).names == ("u", "y")
    assert sewfast.read_table(pd.DataFrame(columns, index=T)).names == ("t", "u", "y")
    named = pd.DataFrame(columns, index=pd.Index(np.arange(N) * 10, name="time_ms"))
    assert sewfast.read(named, inputs="u", output="y").Ts == pytest.approx(0.01)
    since = pd.DataFrame(columns, index=pd.to_timedelta(T, unit="s"))
    assert sewfast.read(since, inputs="u", output="y").Ts == pytest.approx(0.01)


def test_pandas_series_are_arrays() -> None:
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"u": U, "y": Y})
    found = Dataset.from_arrays(frame[["u"]], frame["y"], TS)
    assert np.array_equal(found.experiments[0].y, Y, equal_nan=True)


def test_columns_of_any_package_are_arrays() -> None:
    pl = pytest.importorskip("polars")
    pa = pytest.importorskip("pyarrow")
    for column in (
        pl.Series([1, None, 3]),
        pa.array([1, None, 3]),
        pa.chunked_array([[1, None, 3]]),
    ):
        e = Dataset.from_arrays(np.ones(3), column, TS).experiments[0]
        assert np.array_equal(e.y, [1.0, np.nan, 3.0], equal_nan=True)


def test_polars_and_arrow_kinds_of_columns() -> None:
    pl = pytest.importorskip("polars")
    when = np.datetime64("2026-01-01", "us") + (1e6 * T).astype("timedelta64[us]")
    frame = pl.DataFrame(
        {"time": when, "u": [1, None, 3] * (N // 3), "on": [True, None] * (N // 2), "w": ["a"] * N}
    )
    tables = [sewfast.read_table(frame), sewfast.read_table(frame.lazy())]
    if "pyarrow" in sys.modules or pytest.importorskip("pyarrow"):
        tables.append(sewfast.read_table(frame.to_arrow()))
    for table in tables:
        assert table.names == ("time", "u", "on")
        assert np.array_equal(table["u"][:3], [1.0, np.nan, 3.0], equal_nan=True)
        assert np.array_equal(table["on"][:2], [1.0, np.nan], equal_nan=True)
        assert sewfast.read(table, inputs="on").Ts == pytest.approx(TS)


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_a_single_column_is_refused(package: str) -> None:
    series = pytest.importorskip(package).Series("speed", U)
    with pytest.raises(SettingError, match="one DataFrame"):
        read(series)


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_decimals_are_numbers(package: str) -> None:
    values = [Decimal(repr(round(v, 6))) for v in U.tolist()]
    frame = pytest.importorskip(package).DataFrame({"t": T, "u": U, "speed": values})
    found = sewfast.read(frame, inputs="u", output="speed").experiments[0].y
    np.testing.assert_allclose(found, U, atol=1e-6)


def test_what_is_masked_was_not_measured() -> None:
    speed = np.ma.masked_array(U, mask=np.arange(N) == 3)
    y = sewfast.read({"t": T, "u": U, "speed": speed}, inputs="u", output="speed").experiments[0].y
    assert np.flatnonzero(np.isnan(y)).tolist() == [3]


def test_anything_with_an_arrow_stream_is_read() -> None:
    pytest.importorskip("pyarrow")

    class Stream:
        def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
            return data().to_arrow().__arrow_c_stream__(requested_schema)

    require_same(read(Stream()))
    require_same(read(data()))


def test_xarray_takes_what_lies_along_one_dimension() -> None:
    xr = pytest.importorskip("xarray")
    frame = data().to_xarray()
    frame["map"] = (("t", "x"), np.zeros((N, 2)))
    table = sewfast.read_table(frame)
    assert "map" in table.unusable
    assert table.unit("speed") == "RPM"
    one = xr.DataArray(U, dims="t", coords={"t": T}, name="u")
    assert sewfast.read_table(one).names == ("t", "u")


@pytest.mark.parametrize("package", ["pandas", "polars", "pyarrow", "xarray"])
def test_a_package_that_is_missing_is_named(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    method = {"pyarrow": "to_arrow"}.get(package, f"to_{package}")
    with pytest.raises(SettingError, match=f"{package}.*pip install {package}"):
        getattr(data(), method)()


def test_a_stream_without_pyarrow_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stream:
        def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
            raise AssertionError

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with refuses(SettingError, name="pyarrow", expected="Stream", remedy=r"sewfast\[parquet\]"):
        sewfast.read(Stream(), inputs="u")


def test_integers_that_numpy_does_not_have() -> None:
    pl = pytest.importorskip("polars")
    u = pl.Series("u", [1, 2, 3]).cast(pl.Int128)
    table = sewfast.read_table(pl.DataFrame([pl.Series("t", [0.0, 0.1, 0.2]), u]))
    assert table["u"].tolist() == [1.0, 2.0, 3.0]


def test_a_query_that_cannot_be_computed_is_refused() -> None:
    pl = pytest.importorskip("polars")
    lazy = pl.DataFrame({"t": [0.0, 0.1]}).lazy().select("nope")
    with pytest.raises(DataError, match=r"LazyFrame: expected a query .* unable to find column"):
        sewfast.read_table(lazy)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"inputs": 1}, "inputs: expected the name of a column, received 1"),
        ({"inputs": [None]}, "inputs: expected the name of a column, received None"),
        ({"output": 2}, "output: expected the name of a column, received 2"),
        ({"Ts": "0.1"}, "Ts: expected a positive sample time in seconds, received '0.1'"),
    ],
)
def test_names_and_times_of_another_type_are_refused(options: dict[str, Any], words: str) -> None:
    columns = {"t": np.arange(4) * 0.1, "u": np.arange(4.0), "y": np.arange(4.0)}
    with pytest.raises(SettingError, match=re.escape(words)):
        sewfast.read(columns, **{"inputs": "u", "output": "y", **options})


def test_a_time_column_without_numbers_is_named() -> None:
    columns = {"t": np.array(["a", "b", "c"]), "u": np.arange(3.0), "y": np.arange(3.0)}
    with pytest.raises(DataError, match="column 't' holds"):
        sewfast.read(columns, inputs="u", output="y")


@pytest.mark.parametrize("package", ["pandas", "polars", "pyarrow", "dict"])
@pytest.mark.parametrize("kind", ["text", "moment", "time of day", "duration"])
def test_moments_as_objects_or_text_are_times(package: str, kind: str) -> None:
    begin = datetime.datetime(2026, 3, 14, 10)
    moments = [begin + datetime.timedelta(milliseconds=10 * k) for k in range(N)]
    made: dict[str, list[Any]] = {
        "text": [m.isoformat() for m in moments],
        "moment": moments,
        "time of day": [m.time() for m in moments],
        "duration": [m - begin for m in moments],
    }
    columns = {"time": made[kind], "u": U, "speed": U, "true": U}
    if package == "dict":
        frame: Any = columns
    elif package == "pyarrow":
        frame = pytest.importorskip(package).table(columns)
    else:
        frame = pytest.importorskip(package).DataFrame(columns)
    assert read(frame).Ts == pytest.approx(TS, rel=1e-9)


def test_levels_of_an_index_that_have_names_are_columns() -> None:
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"run": 1, "t": T, "u": U, "speed": U}).set_index(["run", "t"])
    assert sewfast.read_table(frame).names == ("run", "t", "u", "speed")
    assert sewfast.read(frame, inputs="u", output="speed").Ts == pytest.approx(TS)
    periods = pd.period_range("2026-01-01", periods=N, freq="s")
    assert sewfast.read(pd.DataFrame({"u": U}, index=periods), inputs="u").Ts == 1.0
    assert sewfast.read(pd.DataFrame({"t": periods, "u": U}), inputs="u").Ts == 1.0


def test_a_structured_array_is_a_table() -> None:
    fields = np.rec.fromarrays([T, U, U, U], names="t,u,speed,true")
    assert read(fields).Ts == pytest.approx(TS)


def test_columns_that_show_what_they_are_need_no_names() -> None:
    pandas = pytest.importorskip("pandas")
    k = np.arange(200)
    table = pandas.DataFrame(
        {"time_ms": 2.0 * k, "speed [rpm]": k % 7, "voltage [V]": k % 5, "status": 0.0 * k}
    )
    data = sewfast.read(table)
    assert (data.input_names, data.output_name) == (("voltage",), "speed")
    assert (data.Ts, data.input_units, data.output_unit) == (0.002, ("V",), "rpm")
    np.testing.assert_array_equal(data.experiments[0].y, k % 7)
    with refuses(DataError, expected="which is the input", received="a, b", remedy="name both"):
        sewfast.read(pandas.DataFrame({"a": k % 3, "b": k % 5}), Ts=0.1)
    # naming one role leaves the other recognised
    assert sewfast.read(table, output="speed").input_names == ("voltage",)
    assert sewfast.read(table, inputs="voltage").output_name == "speed"
