"""Files in: every format read, and every damaged file refused with its name and place."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import sewfast
from refusals import refuses
from sewfast.errors import DataError, SettingError, SewfastError
from sewfast.readers import parse_source, read, read_table

T = np.arange(5) * 0.01
U = np.array([0.1, -2.5, 1e-17, 4.0, 0.3])
Y = np.array([100.0, 1 / 3, 3.0, -4e300, 5.0])
DATA = Path(os.environ.get("SEWFAST_DATA", Path(__file__).parents[3] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no measured data (set SEWFAST_DATA)")


def csv(tmp_path: Path, text: str | bytes, name: str = "run.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


# --- delimited text ---------------------------------------------------------------------------


def test_csv_round_trips_every_bit(tmp_path: Path) -> None:
    rows = "".join(f"{t!r},{u!r},{y!r}\n" for t, u, y in zip(*map(list, (T, U, Y)), strict=True))
    table = read_table(csv(tmp_path, "t,u,y\n" + rows.replace("np.float64(", "").replace(")", "")))
    np.testing.assert_array_equal(table["u"], U)
    np.testing.assert_array_equal(table["y"], Y)


@pytest.mark.parametrize(
    "text",
    [
        "u,y\n1.5,2\n3,4\n",
        "u;y\n1.5;2\n3;4\n",
        "u;y\n1,5;2\n3;4\n",
        "u\ty\n1,5\t2\n3\t4\n",
        "\ufeffu,y\r\n1.5,2\r\n3,4\r\n",
        "u,y\r1.5,2\r3,4",
        '"u","y"\n"1.5","2"\n3,4\n',
        "# made by a logger\n\nu, y\n1.5, 2\n3, 4\n\n\n",
        "# u,y\n1.5,2\n3,4\n",
        "u,y,\n1.5,2,\n3,4,\n",
        "u,y\n1.5,2,\n3,4\n",
        "u [V],y (RPM)\n1.5,2\n3,4\n",
        "u,y\n\n1.5,2\n\n3,4\n",
    ],
)
def test_dialects(tmp_path: Path, text: str) -> None:
    table = read_table(csv(tmp_path, text))
    np.testing.assert_array_equal(table["u"], [1.5, 3.0])
    np.testing.assert_array_equal(table["y"], [2.0, 4.0])
    assert table.names == ("u", "y")


def test_utf16_as_spreadsheets_write_it(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "u\ty\r\n1,5\t2\r\n".encode("utf-16")))
    assert table["u"][0] == 1.5


def test_latin1_headers(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "u,winkel [°]\n1,2\n3,4\n".encode("latin-1")))
    assert table.unit("winkel") == "°"


def test_units_come_from_the_header(tmp_path: Path) -> None:
    path = csv(tmp_path, "t [s],u [V],speed (RPM),note\n0,1,2,3\n0.1,2,3,4\n")
    data = read(path, inputs="u", output="speed")
    assert (data.input_units, data.output_unit, data.Ts) == (("V",), "RPM", 0.1)
    assert read(path, inputs="u [V]", output="speed (RPM)").output_name == "speed"


def test_names_that_differ_by_unit_alone_stay_apart(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "w [RPM],w [rad/s]\n60,6.28\n120,12.6\n"))
    assert table.names == ("w [RPM]", "w [rad/s]")
    assert table.unit("w [RPM]") == "RPM"


def test_empty_cells_are_nan(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "u,y\n1,2\n2,\n3,NaN\n"))
    np.testing.assert_array_equal(table["y"], [2.0, np.nan, np.nan])
    np.testing.assert_array_equal(table["u"], [1.0, 2.0, 3.0])


def test_a_bad_cell_is_named_by_line_column_and_text(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "u,y\n1,2\n2,3\n\n4,two\n"))
    with pytest.raises(DataError, match=r"run\.csv: line 5, column 'y'.*received 'two'"):
        table["y"]
    np.testing.assert_array_equal(table["u"], [1.0, 2.0, 4.0])


@pytest.mark.parametrize(
    "text",
    [
        "u y\n1.5 2000.25\n3 4000\n",
        "  u [V]   y [RPM]\n 1.5   2000.25\n 3.0   4000.00\n",
        "u y\n1,5 2000,25\n3 4000\n",
        "u|y\n1.5|2000.25\n3|4000\n",
        'u,y\n1.5,"2,000.25"\n3,"4,000"\n',
        "u;y\n1,5;2.000,25\n3;4.000\n",
        "u;y\n1.5;2'000.25\n3;4'000\n",
        "u;y\n1,5;2\u00a0000,25\n3;4\u202f000\n",
        "u;y\n1,5;2 000,25\n3;4 000\n",
        '"u","y"\n"1,5","2000,25"\n"3,0","4000,0"\n',
        "u;y;note\n1,5;2000,25;vers. 1.0\n3;4000;\n",
        "u,y\n1.5,2000.25\n# pause\n3,4000\n# end\n",
        "sep=;\nu;y\n1,5;2000,25\n3;4000\n",
        "u,y\n1.5,2000.25\n3,4000\n\x1a",
        "u,y\n1.5,2000.25\n3,4000\n" + 600 * "\0",
        "u,y\n1.5,2000.25\n3,4000\nEnd of data\n",
        "u,y,z\n1.5,2000.25,1\n3,4000,1\n4,1.2",
        "LabVIEW Measurement\t\nWriter_Version\t2\n***End_of_Header***\t\n\nChannels\t2\t\n"
        "X0\t0\t0\t\n***End_of_Header***\t\t\t\nu\ty\tComment\n1.5\t2000.25\n3\t4000\n",
        "File;C:\\x.svd\n\nName;u;y\nSampleTime[ms];10;10\n\n0;1,5;2000,25\n10;3;4000\n",
    ],
)
def test_dialects_of_strangers(tmp_path: Path, text: str) -> None:
    table = read_table(csv(tmp_path, text))
    np.testing.assert_array_equal(table["u"], [1.5, 3.0])
    np.testing.assert_array_equal(table["y"], [2000.25, 4000.0])
    assert len(table.notes) == sum(w in text for w in ("sep=", "End of data", "z\n", "Lab", "svd"))


@pytest.mark.parametrize("text", ["u;y\n1;2\n1.5;2,5\n", 'u,y\n1,2\n1,"2,500"\n'])
def test_marks_that_may_mean_either_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError, match=r"line 3, column 'y'.*'2,5(00)?'.*decimal points"):
        read_table(csv(tmp_path, text))["y"]


def test_digits_in_wrong_groups_are_no_number(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "t;u;y\n0;1.234,5;1\n1;12.34,5;1\n"))
    with pytest.raises(DataError, match=r"line 3, column 'u'.*'12\.34,5'"):
        table["u"]


def test_a_short_line_within_a_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"line 3: expected 2 cells.*received 1"):
        read_table(csv(tmp_path, "u,y\n1,2\nlost\n3,4\n"))


def test_numbers_below_a_line_of_text_want_a_header(tmp_path: Path) -> None:
    with refuses(DataError, name=r"run.csv: line 1", expected="names for the 3 columns"):
        read_table(csv(tmp_path, "setup done\n0,1,2\n1,2,3\n"))
    np.testing.assert_array_equal(
        read_table(csv(tmp_path, "motor speed\n1,5\n2,5\n"))["motor speed"], [1.5, 2.5]
    )


@pytest.mark.parametrize("word", ["", "NaN", "NA", "#N/A", "-", "--", "null", "1.#QNAN"])
def test_what_programs_write_where_nothing_was_measured(tmp_path: Path, word: str) -> None:
    table = read_table(csv(tmp_path, f"u,y\n1,2\n2,{word}\n"))
    np.testing.assert_array_equal(table["y"], [2.0, np.nan])


MOMENTS = {
    "iso": ("2026-03-14T23:59:59.990", "2026-03-15T00:00:00", "2026-03-15T00:00:00.010"),
    "zone": ("2026-03-29T00:59:59.99Z", "2026-03-29T03:00:00+02:00", "2026-03-29T03:00:00.01+0200"),
    "spaces": ("2026-03-14 23:59:59.99", "2026-03-15 0:00:00", "2026-03-15 0:00:00.01"),
    "points": ("14.03.2026 23:59:59,990", "15.03.2026 00:00:00,000", "15.03.2026 00:00:00,010"),
    "American": ("3/14/2026 11:59:59.990 PM", "3/15/2026 12:00:00 AM", "3/15/2026 12:00:00.010 AM"),
    "British": ("31/03/2026 23:59:59.99", "01/04/2026 00:00:00", "01/04/2026 00:00:00.01"),
    "clock": ("23:59:59.990", "00:00:00.000", "00:00:00.010"),
}  # fmt: skip


@pytest.mark.parametrize("name", MOMENTS)
def test_moments_become_seconds(tmp_path: Path, name: str) -> None:
    rows = "".join(f"{moment};1;2\n" for moment in MOMENTS[name])
    data = read(csv(tmp_path, "Timestamp [ms];u;y\n" + rows), inputs="u", output="y")
    assert data.Ts == pytest.approx(0.01, rel=1e-12)
    assert data.notes == ()


def test_moments_that_are_none_stay_text(tmp_path: Path) -> None:
    table = read_table(csv(tmp_path, "t,u\n2026-02-30T10:00:00,1\n2026-02-31T10:00:00,2\n"))
    with pytest.raises(DataError, match="line 2, column 't': expected a number"):
        table["t"]


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_time_since_1970_in_small_units_is_no_time_in_seconds(
    tmp_path: Path, unit: str, scale: float
) -> None:
    rows = "".join(f"{round((1773482400 + 0.01 * k) * scale)},1,{k}\n" for k in range(50))
    data = read(csv(tmp_path, "timestamp,u,y\n" + rows), inputs="u", output="y")
    assert data.Ts == pytest.approx(0.01, rel=1e-6)
    assert data.notes == (f"run.csv: column 'timestamp' is taken as {unit} since 1970",)


def test_decimal_commas_between_commas_are_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"line 2: expected 2 cells.*received 4.*semicolons"):
        read_table(csv(tmp_path, "u,y\n1,5,2,0\n"))


@pytest.mark.parametrize("cell", ["1_000", "0x1", "1e", "--1", "1 2", "one", "inf inf"])
def test_what_is_not_a_number(tmp_path: Path, cell: str) -> None:
    with pytest.raises(DataError, match="line 2, column 'u'"):
        read_table(csv(tmp_path, f"u,y\n{cell},2\n"))["u"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"\n\n  \n", "empty"),
        (b"# only a comment\n", "empty"),
        (b"t,u,y\n", "header but no rows"),
        (b"t,u,y\n\n\n", "header but no rows"),
        (b"0,1,2\n1,2,3\n", "header"),
        (b"u,y\n1\n", "line 2: expected 2 cells"),
        (b"u,y\n1,2\n1,2,3\n", "line 3: expected 2 cells"),
        (bytes(range(256)) * 20, "binary data"),
        (b"\x00\x00\x00\x00", "binary data"),
        (b"u,u\n1,2\n", "more than once"),
        (b"a" * 2_000_000, "characters"),
        (b"u,y\n" + b'"' + b"x" * 200_000 + b'",2\n', "field larger"),
        (b"PK\x03\x04 not a zip", "cannot be read"),
        (b"PAR1 not a parquet PAR1", "cannot be read"),
        (b"MATLAB 5.0 MAT-file, cut", "cannot be read"),
        (b"\x89HDF\r\n\x1a\n cut", "cannot be read"),
        (b"PK\x03\x04......xl/workbook.xml", "Excel"),
    ],
)
def test_files_that_are_no_table_are_named(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(DataError) as caught:
        read_table(csv(tmp_path, content))
    assert "run.csv" in str(caught.value)
    assert words in str(caught.value)


def test_missing_file_folder_and_wrong_extension(tmp_path: Path) -> None:
    with refuses(DataError, name=r"nowhere\.csv", received="No such file"):
        read_table(tmp_path / "nowhere.csv")
    with pytest.raises(DataError, match="folder"):
        read_table(tmp_path)
    with pytest.raises(DataError, match=r"\.npz"):
        read_table(csv(tmp_path, "u,y\n1,2\n", "run.npz"))
    with pytest.raises(DataError, match="MATLAB"):
        read_table(csv(tmp_path, "u,y\n1,2\n", "run.mat"))


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=400), st.sampled_from(["x.csv", "x.mat", "x.npz", "x.parquet", "x"]))
def test_any_bytes_are_read_or_refused(tmp_path: Path, raw: bytes, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(raw)
    try:
        table = read_table(path)
    except SewfastError as e:
        assert name in str(e)  # noqa: PT017
    else:
        assert all(c.dtype == np.float64 for c in table.columns.values())


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(alphabet="0123456789.,;\t-+eE \"'\nnaif#[]()tuy", max_size=120))
def test_any_text_is_read_or_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(text.encode())
    try:
        table = read_table(path)
    except DataError as e:
        assert "x.csv" in str(e)  # noqa: PT017
    else:
        assert len({len(c) for c in table.columns.values()}) == 1


# --- columns ----------------------------------------------------------------------------------


def test_a_wrong_column_lists_the_others_and_guesses(tmp_path: Path) -> None:
    path = csv(tmp_path, "t,voltage,Speed\n0,1,2\n1,2,3\n")
    with refuses(
        DataError, expected="a column 'speed'",
        remedy=r"available: t, voltage, Speed. did you mean 'Speed'\?",
    ):  # fmt: skip
        read(path, inputs="voltage", output="speed")


def test_an_output_may_be_absent(tmp_path: Path) -> None:
    data = read(csv(tmp_path, "t,u\n0,1\n1,2\n"), inputs="u", name="run 3")
    assert data.source == "run 3"
    assert np.isnan(data.experiments[0].y).all()
    data.require_inputs()


def test_several_inputs_and_channels(tmp_path: Path) -> None:
    path = csv(tmp_path, "t,a,b,y,truth\n0,1,2,3,4\n1,5,6,7,8\n")
    data = read(path, inputs=["b", "a"], output="y", channels=["truth"])
    np.testing.assert_array_equal(data.experiments[0].u, [[2.0, 1.0], [6.0, 5.0]])
    np.testing.assert_array_equal(data.experiments[0].channels["truth"], [4.0, 8.0])
    with pytest.raises(SettingError, match="at least one"):
        read(path, inputs=[], output="y")


# --- time -------------------------------------------------------------------------------------


def times(tmp_path: Path, values: object, header: str = "t") -> Path:
    rows = "".join(f"{v},{k},{2 * k}\n" for k, v in enumerate(values))  # type: ignore[var-annotated,arg-type]
    return csv(tmp_path, f"{header},u,y\n" + rows)


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("t", 1), ("time", 1), ("Time [s]", 1), ("t [ms]", 1e-3), ("T (us)", 1e-6),
        ("t [min]", 60), ("Zeit (min)", 60), ("time_min", 60), ("Time (h)", 3600),
        ("t_hours", 3600),
    ],
)  # fmt: skip
def test_the_sample_time_comes_from_the_time_column(
    tmp_path: Path, header: str, factor: float
) -> None:
    data = read(times(tmp_path, [0, 2, 4, 6], header), inputs="u", output="y")
    assert data.Ts == pytest.approx(2 * factor)


def test_min_of_another_column_is_its_least_value(tmp_path: Path) -> None:
    path = csv(tmp_path, "t,u [V],speed [min]\n0,1,2\n1,2,4\n2,1,3\n")
    assert read(path, inputs="u", output="speed").output_unit == ""


def test_a_time_column_by_another_name(tmp_path: Path) -> None:
    path = times(tmp_path, [0, 2, 4], "clock")
    assert read(path, inputs="u", output="y", time="clock").Ts == 2.0
    with refuses(SettingError, expected="a column t or time", remedy="--ts"):
        read(path, inputs="u", output="y")
    assert read(path, inputs="u", output="y", Ts=0.5).Ts == 0.5


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([0, 1, 1, 1, 1, 2], "line 4 (so are 3 of 5 steps: too coarse a clock)"),
        ([0, 1, 2, 1.5], "increasing time, received 1.5 after 2 at line 5"),
        ([0, 1, 2, 1e9], "a step of 1e+09 s at line 5"),
        ([0, 1, 2, "", 4], "line 5"),
        ([0], "at least 2 samples"),
    ],
)
def test_time_that_is_no_time_is_refused_by_line(
    tmp_path: Path, values: object, words: str
) -> None:
    with pytest.raises(DataError) as caught:
        read(times(tmp_path, values), inputs="u", output="y", Ts=1.0)
    assert words in str(caught.value)
    assert "'t'" in str(caught.value)


def test_time_even_to_one_percent_is_accepted(tmp_path: Path) -> None:
    assert read(times(tmp_path, [0, 1.0, 2.009, 3.0]), inputs="u", output="y").Ts == 1.0


def test_a_given_sample_time_wins_where_it_agrees(tmp_path: Path) -> None:
    path = times(tmp_path, [0, 0.01, 0.02])
    assert read(path, inputs="u", output="y", Ts=0.010001).Ts == 0.010001
    with refuses(DataError, expected=r"0\.01 s", received=r"0\.02 s"):
        read(path, inputs="u", output="y", Ts=0.02)
    for Ts in (0.0, -1.0, float("nan")):
        with pytest.raises(SettingError, match="positive"):
            read(path, inputs="u", output="y", Ts=Ts)


def test_a_clock_of_text_is_no_obstacle_where_the_sample_time_is_given(tmp_path: Path) -> None:
    path = times(tmp_path, ["12:00:01", "12:00:02", "12:00:03"], "time")
    assert read(path, inputs="u", output="y", Ts=1.0).Ts == 1.0


# --- .mat, .npz, Parquet ----------------------------------------------------------------------


def test_npz_vectors_matrices_and_what_is_unusable(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, u=U, row=Y[None], m=np.column_stack([U, Y]), wide=np.ones((2, 9)), Ts=0.01)
    table = read_table(path)
    np.testing.assert_array_equal(table["row"], Y)
    np.testing.assert_array_equal(table["m.1"], Y)
    for name, words in [("m", "m.0 to m.1"), ("wide", "transposed"), ("Ts", "single number")]:
        with pytest.raises(DataError, match=words):
            table[name]


def test_npz_never_unpickles(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, u=U, evil=np.array([{"a": 1}], dtype=object))
    table = read_table(path)
    assert table.names == ("u",)
    with pytest.raises(DataError, match="not numeric"):
        table["evil"]


def test_columns_of_different_length_are_refused_together(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, u=U, y=Y[:3])
    with pytest.raises(DataError, match="'y' has 3 samples, 'u' has 5"):
        read(path, inputs="u", output="y", Ts=1.0)


def test_mat_5_structs_and_struct_arrays(tmp_path: Path) -> None:
    io = pytest.importorskip("scipy.io")
    path = tmp_path / "run.MAT"
    s = np.zeros((1, 2), dtype=[("d", object), ("n", object)])
    s["d"][0, 0], s["d"][0, 1], s["n"][0, 0], s["n"][0, 1] = U, Y[None], "volt", "rpm"
    io.savemat(path, {"t": T[:, None], "s": {"u": U, "y": Y}, "a": s, "z": U * 1j}, appendmat=False)
    data = read(path, inputs="s.u", output="a.1.d")
    np.testing.assert_array_equal(data.experiments[0].u[:, 0], U)
    np.testing.assert_array_equal(data.experiments[0].y, Y)
    assert data.Ts == pytest.approx(0.01)
    with pytest.raises(DataError, match="complex"):
        read_table(path)["z"]


def test_mat_73_has_its_dimensions_put_right(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "run.mat"
    with h5py.File(path, "w", userblock_size=512) as f:
        for name, value in [("u", U[None]), ("m", np.stack([U, Y])), ("s/y", Y[None])]:
            f[name] = value
            f[name].attrs["MATLAB_class"] = np.bytes_("double")
        f["text"] = np.frombuffer(b"volt", np.uint8).astype(np.uint16)[:, None]
        f["text"].attrs["MATLAB_class"] = np.bytes_("char")
        refs = [f.create_dataset(f"#refs#/{k}", data=v[None]) for k, v in enumerate([U, Y])]
        for r in refs:
            r.attrs["MATLAB_class"] = np.bytes_("double")
        f["a/d"] = np.array([[r.ref] for r in refs], dtype=h5py.ref_dtype)
    raw = bytearray(path.read_bytes())
    raw[:19] = b"MATLAB 7.3 MAT-file"
    path.write_bytes(raw)
    table = read_table(path)
    assert set(table.names) == {"u", "m.0", "m.1", "s.y", "a.0.d", "a.1.d"}
    for name, expected in [("u", U), ("m.1", Y), ("s.y", Y), ("a.0.d", U), ("a.1.d", Y)]:
        np.testing.assert_array_equal(table[name], expected)


def test_parquet(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "run.parquet"
    columns = {"t": T, "u [V]": U.astype(np.float32), "n": [1, 2, None, 4, 5], "s": list("abcde")}
    pq.write_table(pa.table(columns), path)
    data = read(path, inputs="u", output="n")
    np.testing.assert_array_equal(data.experiments[0].u[:, 0], U.astype(np.float32))
    assert np.isnan(data.experiments[0].y[2])
    assert data.input_units == ("V",)
    with pytest.raises(DataError, match="'s' holds text"):
        read_table(path)["s"]


# --- FILE:IN:OUT ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("run.csv", ("run.csv", None, None)),
        ("run.csv:u:y", ("run.csv", ("u",), "y")),
        ("run.csv:u1+u2:y", ("run.csv", ("u1", "u2"), "y")),
        (r"C:\data\run.csv", (r"C:\data\run.csv", None, None)),
        (r"C:\data\run.csv:u:y", (r"C:\data\run.csv", ("u",), "y")),
    ],
)
def test_sources(text: str, expected: object) -> None:
    assert parse_source(text) == expected


def test_a_file_with_colons_is_a_file(tmp_path: Path) -> None:
    path = csv(tmp_path, "u,y\n1,2\n", "run:12:30.csv")
    assert parse_source(str(path)) == (str(path), None, None)


@pytest.mark.parametrize("text", ["run.csv::y", "run.csv:u:", ":u:y", "run.csv:u+:y"])
def test_half_a_source_is_refused(text: str) -> None:
    with pytest.raises(SettingError, match="FILE:INPUT:OUTPUT"):
        parse_source(text)


# --- encoder counts ---------------------------------------------------------------------------


def test_counts_and_turns_belong_together(tmp_path: Path) -> None:
    path = csv(tmp_path, "t,u,n\n0,1,0\n1,2,3\n")
    with refuses(SettingError, name="counts, counts_per_rev"):
        read(path, inputs="u", counts="n")
    with refuses(SettingError, name="counts, counts_per_rev"):
        read(path, inputs="u", output="n", counts_per_rev=100)


def test_counts_become_a_speed_in_rpm(tmp_path: Path) -> None:
    t = np.arange(400) * 1e-3
    counts = np.floor(100.0 * 20.0 * t)
    rows = "".join(f"{a:.3f},{1.0},{n}\n" for a, n in zip(t, counts, strict=True))
    path = csv(tmp_path, "t,u,n\n" + rows)
    data = read(path, inputs="u", counts="n", counts_per_rev=100)
    np.testing.assert_allclose(data.experiments[0].y[100:300], 20.0 * 60, rtol=0.01)
    assert (data.output_name, data.output_unit, data.counts) == ("speed", "RPM", ("n", 100.0))
    assert read(path, inputs="u", output="w", counts="n", counts_per_rev=100).output_name == "w"
    holed = csv(tmp_path, "t,u,n\n0,1,0\n1,2,\n2,3,1\n", "holes.csv")
    with pytest.raises(DataError, match=r"'n'.*encoder counts in a row.*sample 1"):
        read(holed, inputs="u", counts="n", counts_per_rev=100)


# --- measured data ----------------------------------------------------------------------------


@needs_data
def test_the_flattened_copy_equals_its_original() -> None:
    flat = read(DATA / "bldc_cigan/bldc.csv", inputs="u", output="y")
    deep = read(
        DATA / "bldc_cigan/dataset.mat",
        inputs="cigan.Y.2.Data",
        output="cigan.Y.1.Data",
        time="cigan.X.Data",
    )
    assert len(flat) == len(deep) == 8334
    assert flat.Ts == pytest.approx(deep.Ts) == pytest.approx(0.00072)
    np.testing.assert_allclose(flat.experiments[0].y, deep.experiments[0].y, rtol=1e-7)


@needs_data
def test_mat_4_and_long_rows() -> None:
    drives = read(DATA / "coupled_drives/DATAUNIF.MAT", inputs="u11", output="z11", Ts=0.02)
    assert len(drives) == 500
    box = read(DATA / "silverbox/SNLS80mV.mat", inputs="V1", output="V2", Ts=1 / 610.35)
    assert len(box) == 131072


def test_one_column_is_not_input_and_output(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text("t,u,y\n" + "".join(f"{k},{k % 3},{k}\n" for k in range(9)))
    with pytest.raises(SettingError, match="'u' twice"):
        read(path, inputs="u", output="u")
    with pytest.raises(SettingError, match="'y' twice"):
        read(path, inputs=["y", "y"])


# --- serial logs: corrupt lines, `.log`, JSON -----------------------------------------------------


def serial(count: int = 1000) -> list[str]:
    return [f"{0.01 * k:.2f},{(k // 10) % 7},{k % 5}" for k in range(count)]


@pytest.mark.parametrize("ending", ["csv", "log", "txt"])
def test_corrupt_lines_are_skipped_counted_and_named(tmp_path: Path, ending: str) -> None:
    rows = serial()
    rows[100], rows[300], rows[500] = "1.0,3", "3.00,x3,1", "5.00,3,1,8"
    path = tmp_path / f"x.{ending}"
    path.write_text("t,u,y\n" + "\n".join(rows) + "\n")
    data = sewfast.read(path)
    assert len(data) == 1000
    assert list(np.flatnonzero(np.isnan(data.experiments[0].y))) == [100, 300, 500]
    assert data.experiments[0].u[100, 0] == data.experiments[0].u[99, 0]
    assert "3 of 1000 lines skipped" in data.notes[0]
    assert "lines 102 ('1.0,3'), 302 ('3.00,x3,1'), 502" in data.notes[0]


def test_more_than_a_hundredth_is_refused_with_line_and_remedy(tmp_path: Path) -> None:
    rows = serial()
    for k in range(100, 130):
        rows[k] = rows[k].rpartition(",")[0]
    path = tmp_path / "x.csv"
    path.write_text("t,u,y\n" + "\n".join(rows) + "\n")
    with pytest.raises(DataError, match=r"line 102: .*30 of 1000 lines .*repair or delete"):
        sewfast.read(path)
    rows = [row.replace(",", ",#", 1) if 100 <= k < 130 else row for k, row in enumerate(serial())]
    path.write_text("t,u,y\n" + "\n".join(rows) + "\n")
    with pytest.raises(DataError, match=r"line 102, column 'u'.*30 cells"):
        sewfast.read(path, inputs="u", output="y")


def as_json(kind: str) -> str:
    rows = [
        {"time": 0.01 * k, "motor": {"volt": k // 10 % 7, "rpm": 5.5 * (k % 5)}, "on": k > 3}
        for k in range(400)
    ]
    if kind == "lines":
        return "\n".join(map(json.dumps, rows))
    if kind == "list":
        return json.dumps(rows, indent=1)
    if kind == "inside":
        return json.dumps({"device": "x", "samples": rows})
    columns = {name: [row[name] for row in rows] for name in ("time", "on")}
    motor = {name: [row["motor"][name] for row in rows] for name in ("volt", "rpm")}
    return json.dumps({**columns, "motor": motor})


@pytest.mark.parametrize("ending", ["json", "jsonl", "log"])
@pytest.mark.parametrize("kind", ["lines", "list", "inside", "columns"])
def test_logs_in_json_are_read(tmp_path: Path, ending: str, kind: str) -> None:
    path = tmp_path / f"x.{ending}"
    path.write_text(as_json(kind))
    table = read_table(path)
    assert set(table.names) == {"time", "motor.volt", "motor.rpm", "on"}
    data = sewfast.read(path, inputs="motor.volt", output="motor.rpm")
    assert (len(data), data.Ts) == (400, pytest.approx(0.01))
    assert data.experiments[0].y[3] == 16.5


def test_corrupt_lines_of_json_are_skipped_or_refused(tmp_path: Path) -> None:
    rows = as_json("lines").splitlines()
    rows[7], rows[-1] = rows[7][:-4], rows[-1][:9]
    path = tmp_path / "x.log"
    path.write_text("\n".join(rows))
    table = read_table(path)
    assert len(table["time"]) == 398
    assert "1 of 399 lines skipped" in table.notes[0]
    assert "line 8" in table.notes[0]
    assert "cut off" in table.notes[1]
    rows[50:60] = ["?"] * 10
    path.write_text("\n".join(rows))
    with refuses(
        DataError, expected="JSON object", received="11 of 399", remedy="repair or delete"
    ):
        read_table(path)


@pytest.mark.parametrize(
    "text", ["{}", "[{}]", '{"a": 1, "b": [1], "c": [1, 2]}', "{", '{"a": "x"}']
)
def test_json_that_is_no_log_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(DataError):
        read_table(path)


def test_the_studio_offers_logs_and_no_models(tmp_path: Path) -> None:
    from sewfast_studio.project import Project

    for name in ("a.log", "b.jsonl", "c.json"):
        (tmp_path / name).write_text(as_json("lines"))
    u = np.repeat([1.0, 2.0, 0.0, 3.0], 100)
    data = sewfast.Dataset.from_arrays(u[1:], 0.5 * u[:-1] + 0.01 * np.sin(np.arange(399)), 0.01)
    sewfast.identify(data, model="arx").save(tmp_path / "model.json")
    with refuses(DataError, received="sewfast.model"):
        read_table(tmp_path / "model.json")
    assert Project(tmp_path).recordings() == ["a.log", "b.jsonl", "c.json"]
