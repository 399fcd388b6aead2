"""Files out: what is written reads back to the same bits, and appears whole or not at all."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from refusals import refuses
from sewfast.errors import DataError, SettingError
from sewfast.readers import read, read_table
from sewfast.storage import write_bytes, write_table

FORMATS = [".csv", ".npz", ".mat", ".parquet"]


@pytest.mark.parametrize("suffix", FORMATS)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(width=64), min_size=2, max_size=20))
def test_every_format_round_trips_every_bit(
    tmp_path: Path, suffix: str, values: list[float]
) -> None:
    path = tmp_path / f"run{suffix}"
    write_table(path, {"y": values, "u": np.arange(len(values))})
    np.testing.assert_array_equal(read_table(path)["y"], values)


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_recording_comes_back_as_a_data_set(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    write_table(path, {"y": [1.0, 2.0], "t": [0.0, 0.5], "u": [3, 4]}, units={"u": "V"})
    data = read(path, inputs="u", output="y")
    assert data.Ts == 0.5
    assert data.input_units == (("V",) if suffix in (".csv", ".parquet") else ("",))
    assert read_table(path).names[0] == "t"


def test_headers_that_need_quotes(tmp_path: Path) -> None:
    write_table(tmp_path / "a.csv", {'a,"b"': [1.0], "c": [2.0]})
    assert read_table(tmp_path / "a.csv").names == ('a,"b"', "c")


def test_the_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    write_table(path, {"u": [1.0]})
    with pytest.raises(DataError, match="real numbers in column 'y'"):
        write_table(path, {"u": [2.0], "y": ["text"]})
    assert read_table(path)["u"][0] == 1.0
    write_table(path, {"u": [3.0]})
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"\.csv, \.npz, \.mat, \.parquet; received '\.doc'"):
        write_table(tmp_path / "a.doc", {"u": [1.0]})
    with pytest.raises(DataError, match=r"\(2,\).*\(1,\)"):
        write_table(tmp_path / "a.csv", {"u": [1.0, 2.0], "y": [1.0]})
    with pytest.raises(DataError, match=r"one shape"):
        write_table(tmp_path / "a.csv", {})
    with pytest.raises(DataError, match="starts with a letter"):
        write_table(tmp_path / "a.mat", {"1u": [1.0]})
    with pytest.raises(DataError, match="folder that exists"):
        write_table(tmp_path / "nowhere" / "a.csv", {"u": [1.0]})
    with refuses(DataError, expected="can be written"):
        write_bytes(tmp_path, b"")
    assert list(tmp_path.iterdir()) == []
