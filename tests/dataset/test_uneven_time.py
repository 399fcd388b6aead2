"""Time stamps that are not even, in whatever form: a grid, gaps that stay gaps, a note."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import sewfast
from cli import called as command
from refusals import refuses
from sewfast import read, read_table
from sewfast.dataset import Dataset, FloatArray
from sewfast.errors import DataError, SettingError, SewfastError
from sewfast.readers.containers import Table
from sewfast.readers.timebase import time_base

TAU = 0.05


def lag(t: FloatArray, u: FloatArray) -> FloatArray:
    """A lag of 50 ms and gain 20 behind an input that is held from row to row, from rest."""
    y = np.zeros(len(t))
    for k in range(1, len(t)):
        p = np.exp(-(t[k] - t[k - 1]) / TAU)
        y[k] = p * y[k - 1] + (1.0 - p) * 20.0 * u[k - 1]
    return y


def stamps(n: int, jitter: float, Ts: float = 0.005, seed: int = 0) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.cumsum(Ts * (1.0 + jitter * rng.uniform(-1.0, 1.0, n)))


def levels(n: int, hold: int = 12, seed: int = 1) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).uniform(-3.0, 3.0, n // hold + 1), hold)[:n]


def made(folder: Path, t: FloatArray, header: str = "t", name: str = "log.csv") -> Path:
    u = levels(len(t))
    rows = np.column_stack([t, u, lag(t, u)])
    text = f"{header},u [V],y [rad/s]\n" + "\n".join(",".join(map(repr, r)) for r in rows.tolist())
    (folder / name).write_text(text)
    return folder / name


def load(path: Path | Table, **options: object) -> Dataset:
    return read(path, inputs="u", output="y", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("jitter", [0.05, 0.4, 0.9])
def test_a_host_stamped_log_is_identified_as_the_drive_that_it_is(
    tmp_path: Path, jitter: float
) -> None:
    data = load(made(tmp_path, stamps(4000, jitter)))
    (note,) = data.notes
    assert "time stamps are uneven (steps of" in note
    assert "inputs as held and averaged" in note
    assert data.Ts == pytest.approx(0.005, rel=0.05)
    assert data.looks_ahead
    model = sewfast.identify(data, model="oe")
    assert model.training["preparation"][0] == note
    assert sewfast.validate(model, data).simulation.fit_percent > 97.0
    step = sewfast.fit_fopdt(*_step(model), Ts=model.Ts)
    assert pytest.approx(20.0, rel=0.02) == step.K
    assert pytest.approx(TAU, abs=0.006) == step.T + step.L


def _step(model: sewfast.Model) -> tuple[FloatArray, FloatArray]:
    u = np.r_[np.zeros(50), np.ones(450)]
    return u, model.simulate(u)


def test_a_stated_sample_time_is_the_grids_and_slower_ones_are_filtered(tmp_path: Path) -> None:
    t = stamps(3000, 0.3)
    path = made(tmp_path, t)
    fine = load(path, Ts=0.002)
    assert fine.Ts == 0.002
    assert len(fine) == pytest.approx((t[-1] - t[0]) / 0.002, abs=2)
    slow = load(path, Ts=0.02)
    assert slow.Ts == 0.02
    assert any("resampled from Ts" in note for note in slow.notes)
    # a ripple above the new Nyquist frequency does not come back as a slow one
    rows = np.column_stack([t, levels(len(t)), np.sin(2.0 * np.pi * 48.0 * t)])
    np.savetxt(path, rows, delimiter=",", header="t,u,y", comments="")
    assert np.nanstd(load(path, Ts=0.02).experiments[0].y[20:-20]) < 0.1


def test_rows_that_are_missing_in_even_time_are_gaps_and_nothing_else_moves(
    tmp_path: Path,
) -> None:
    t = 0.01 * np.arange(1000)
    kept = np.r_[0:300, 301:500, 560:1000]
    u = levels(1000)
    y = lag(t, u)
    columns = {"t": t[kept], "u": u[kept], "y": y[kept]}
    sewfast.write_table(tmp_path / "gap.csv", columns)
    data = load(tmp_path / "gap.csv")
    e = data.experiments[0]
    assert len(e) == 1000
    assert np.array_equal(np.flatnonzero(np.isnan(e.y)), np.r_[300, 500:560])
    assert np.array_equal(e.y[kept], read_table(tmp_path / "gap.csv")["y"])
    assert np.array_equal(e.u[kept, 0], read_table(tmp_path / "gap.csv")["u"])
    assert "1 gap of 0.61 s is not known" in data.notes[0]
    assert not data.looks_ahead
    assert [len(x) for x in data.split_at_gaps().experiments] == [300, 199, 440]
    with pytest.raises(DataError, match="split-at-gaps"):
        sewfast.identify(data, model="oe")
    assert sewfast.identify(data.fill_inputs("hold"), model="oe").Ts == pytest.approx(0.01)


def test_nothing_is_made_up_inside_a_gap_of_an_uneven_log(tmp_path: Path) -> None:
    t = stamps(1000, 0.3)
    t[600:] += 0.4
    data = load(made(tmp_path, t))
    e = data.experiments[0]
    at = t[0] + data.Ts * np.arange(len(e))
    inside = (at > t[599] + 2 * data.Ts) & (at < t[600] - 2 * data.Ts)
    assert inside.sum() > 70
    assert np.isnan(e.y[inside]).all()
    assert np.isnan(e.u[inside]).all()
    assert np.isfinite(e.y[~inside]).mean() > 0.99
    assert "1 gap of" in data.notes[0]


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("time_ms", 1e-3), ("t_ms", 1e-3), ("t [ms]", 1e-3), ("time_us", 1e-6), ("Time (us)", 1e-6),
        ("timestamp", 1.0), ("timestamp_ns", 1e-9), ("seconds", 1.0), ("Time_s", 1.0),
        ("millis", 1e-3), ("Micros", 1e-6), ("ms", 1e-3), ("t / ms", 1e-3), ("Zeit in ms", 1e-3),
        ("Time since start [ms]", 1e-3), ("t/us", 1e-6), ("time_milliseconds", 1e-3),
    ],
)  # fmt: skip
def test_the_time_columns_name_says_its_unit(tmp_path: Path, header: str, factor: float) -> None:
    data = load(made(tmp_path, 0.4 * np.arange(50), header))
    assert data.Ts == pytest.approx(0.4 * factor)
    assert data.notes == ()


UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@pytest.mark.parametrize("jitter", [0.0, 0.2])
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("Ts", [2e-5, 1e-4, 1e-3, 4e-3, 0.02, 0.2])
def test_a_time_without_a_unit_is_not_taken_as_seconds_in_silence(
    tmp_path: Path, Ts: float, unit: str, jitter: float
) -> None:
    """Sample times of drives in every unit; half a unit is the least that can be noticed."""
    t = stamps(60, jitter, Ts)
    path = made(tmp_path, t / UNITS[unit])
    step = Ts / UNITS[unit]
    if unit == "s" or step < 0.4:
        assert not any("warning" in note for note in load(path).notes)
        return
    if step >= 950.0:
        with refuses(SettingError, expected="a time with its unit", remedy=f"counts {unit}"):
            load(path)
    else:
        assert any(f"if it counts {unit}" in note for note in load(path).notes)
    # the sample time that it names settles the unit
    data = load(path, Ts=Ts)
    assert data.Ts == pytest.approx(Ts)
    assert len(data) == pytest.approx(60, abs=8)
    assert not any("warning" in note for note in data.notes)


@pytest.mark.parametrize("Ts", [1.0, 10.0, 300.0])
def test_a_slow_process_is_read_and_pointed_out(tmp_path: Path, Ts: float) -> None:
    path = made(tmp_path, Ts * np.arange(60))
    data = load(path)
    assert data.Ts == pytest.approx(Ts)
    (note,) = data.notes
    assert note.startswith("warning: ")
    assert load(path, Ts=Ts).notes == ()
    assert load(made(tmp_path, Ts * np.arange(60), "t_s")).notes == ()


@pytest.mark.parametrize(
    ("variables", "Ts"),
    [
        ({"Ts": 0.004}, 0.004), ({"fs": 250.0}, 0.004), ({"Fs": 250, "dt": 0.004}, 0.004),
        ({"Ts": 0.004, "fs": 1000.0}, None), ({"Ts": 0.0}, None), ({"Ts": -1.0}, None),
        ({"fs": float("nan")}, None), ({"gain": 0.004}, None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("kind", ["mat", "npz"])
def test_a_files_sample_time_is_used_where_it_has_no_time_column(
    tmp_path: Path, variables: dict[str, float], Ts: float | None, kind: str
) -> None:
    u = levels(100)
    path = tmp_path / f"run.{kind}"
    if kind == "mat":
        pytest.importorskip("scipy.io").savemat(path, {"u": u, "y": u, **variables})
    else:
        np.savez(path, u=u, y=u, **variables)  # type: ignore[arg-type]
    if Ts is None:
        with pytest.raises(SettingError, match="state the sample time"):
            read(path, inputs="u", output="y")
    else:
        data = read(path, inputs="u", output="y")
        assert data.Ts == pytest.approx(Ts)
        assert "from variable" in data.notes[0]
        with refuses(DataError, expected="Ts within", received="1 s"):
            read(path, inputs="u", output="y", Ts=1.0)


SCOPES = {
    "settings": (
        "Model,DS1\nRecord Length,5\nSample Interval,0.002\nNotes,hall, twice\n"
        "\nt,u,y\n0,1,2\n0.002,1,3\n0.004,1,4\n0.006,1,5\n",
        0.002, ("u", "y"), 4,
    ),
    "names above units": (
        "Time,Channel A,Channel B\n(ms),(V),(mV)\n\n0,1,2\n2,1,3\n4,1,4\n",
        0.002, ("Channel A", "Channel B"), 0,
    ),
    "quantities below channels": (
        "x-axis,1,2\nsecond,Volt,Volt\n-0.002,1,2\n0,1,3\n0.002,1,4\n",
        0.002, ("1", "2"), 0,
    ),
    "semicolons and decimal commas": (
        "Export von Kanal 1\nDatum;1.2.2026\nt;u;y\n0,000;1,5;2,0\n0,002;1,5;3,0\n",
        0.002, ("u", "y"), 2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SCOPES)
def test_lines_above_a_scopes_header_are_skipped_and_counted(tmp_path: Path, name: str) -> None:
    text, Ts, (u, y), skipped = SCOPES[name]
    path = tmp_path / "scope.csv"
    path.write_text(text)
    data = read(path, inputs=u, output=y)
    assert data.Ts == pytest.approx(Ts)
    assert np.isfinite(data.experiments[0].y).all()
    assert len(data.notes) == (skipped > 0)
    if skipped:
        assert f"{skipped} lines above the header are skipped" in data.notes[0]
    if "units" in name:
        assert (data.input_units, data.output_unit) == (("V",), "mV")


def test_a_table_with_text_in_it_is_read_as_before(tmp_path: Path) -> None:
    path = tmp_path / "plain.csv"
    path.write_text("t,u,mode\n0,1,idle\n1,2,run\n2,3,4\n3,4,5\n")
    table = read_table(path)
    assert table.names == ("t", "u")
    assert "line 2, column 'mode'" in table.unusable["mode"]
    assert table.notes == ()


@settings(max_examples=150, deadline=None)
@given(
    t=st.lists(
        st.one_of(
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(-10.0, 10.0),
            st.integers(-5, 5).map(float),
        ),
        min_size=0,
        max_size=30,
    ),
    ordered=st.booleans(),
    Ts=st.none() | st.floats(1e-12, 1e12),
)
@example(t=[0.0, 0.0, 8.9e307], ordered=False, Ts=0.5)
@example(t=[0.0, 1.0, 1.1984620899082105e308], ordered=False, Ts=None)
def test_any_time_column_is_a_grid_or_an_error(
    t: list[float], ordered: bool, Ts: float | None
) -> None:
    times = np.array(sorted(t) if ordered else t)
    table = Table(Path("any.csv"), {"t": times, "u": np.ones(len(t))})
    try:
        base = time_base(table, Ts)
    except SewfastError:
        return
    assert 0.0 < base.Ts < np.inf
    if base.grid is None:
        return
    column = np.linspace(-1.0, 1.0, len(t))
    y, u = base.grid.output(column), base.grid.held(column)
    assert len(y) == len(u) == len(base.grid.times) <= max(100 * len(t), 10_000) + 1
    for made_up in (y, u):
        known = made_up[np.isfinite(made_up)]
        assert np.all(np.abs(known) <= 1.0 + 1e-6)
    assert np.isfinite(y[0])
    assert base.notes


def test_the_command_says_what_was_done(tmp_path: Path) -> None:
    made(tmp_path, stamps(1500, 0.3))
    options = ("log.csv", "--input", "u", "--output", "y")
    told = command(tmp_path, "look", *options)
    assert "time stamps are uneven" in told.err
    told = command(tmp_path, "identify", *options, "--Ts", "0.01", "--model", "oe", "-o", "m.json")
    assert "resampled to Ts = 0.005" in told.err
    assert "resampled from Ts" in told.err
    command(tmp_path, "simulate", "m.json", "log.csv", "--Ts", "0.01", "-o", "out.csv")
    assert np.allclose(np.diff(read_table(tmp_path / "out.csv")["t"]), 0.01)
