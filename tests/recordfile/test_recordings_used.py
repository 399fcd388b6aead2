"""Recording files in use: read as data, with gaps, by every command that takes a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from kinds import model_of
from recordings_made import header
from refusals import refuses
from sewfast.cli import main
from sewfast.control import paper_controller
from sewfast.control.record import record
from sewfast.dataset import Dataset
from sewfast.errors import DataError, SettingError
from sewfast.machine import VirtualMachine
from sewfast.recordfile import RecordWriter, read_recording
from sewfast.speed import speed_from_counts

GAP = (1500, 40)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`whole.mcap`, and `holed.mcap`, which lacks 40 samples and then all but 30 between two."""
    folder = tmp_path_factory.mktemp("recordings")
    run = record(VirtualMachine(), api.signals.excitation("chirp_lo_hi")[:4000], name="chirp")
    run.save(folder / "whole.mcap")
    columns = {"u": "V", "counts": "1"}
    with RecordWriter(folder / "holed.mcap", header(4000, columns=columns)) as writer:
        for a, b in ((0, 1500), (1540, 2000), (2010, 2040), (2050, 4000)):
            writer.samples(a, {"u": run.u[a:b], "counts": run.counts[a:b]})
    return folder


def test_a_recording_is_a_table_with_units(folder: Path) -> None:
    table = api.read_table(folder / "whole.mcap")
    assert table.names == ("t", "u", "counts", "y", "speed_true")
    assert [table.unit(n) for n in table.names] == ["s", "V", "", "RPM", "RPM"]
    assert (table.Ts, table.counts_per_rev) == (0.001, 1572.0)
    assert read_recording(folder / "whole.mcap").complete


def test_a_recording_is_told_by_its_content(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.dat"
    path.write_bytes((folder / "whole.mcap").read_bytes())
    assert len(api.read(path, inputs="u", output="y")) == 4000
    (tmp_path / "text.mcap").write_text("t,u\n0,1\n")
    with pytest.raises(DataError, match="another kind"):
        api.read_table(tmp_path / "text.mcap")


def test_its_header_states_sample_time_and_encoder(folder: Path) -> None:
    data = api.read(folder / "whole.mcap", inputs="u", counts="counts")
    table = api.read_table(folder / "whole.mcap")
    assert (data.Ts, data.counts, data.input_units) == (0.001, ("counts", 1572.0), ("V",))
    np.testing.assert_array_equal(data.experiments[0].y, table["y"])
    assert api.read(folder / "whole.mcap", inputs="u", output="y", Ts=0.001005).Ts == 0.001005
    with refuses(DataError, expected="as the header says"):
        api.read(folder / "whole.mcap", inputs="u", output="y", Ts=0.002)


def test_speed_leaves_gaps_open_and_each_piece_to_itself(folder: Path) -> None:
    data = api.read(folder / "holed.mcap", inputs="u", counts="counts")
    (experiment,) = data.experiments
    missing = np.ones(4000, dtype=bool)
    counts = api.read_table(folder / "holed.mcap")["counts"]
    for a, b in ((0, 1500), (1540, 2000), (2010, 2040), (2050, 4000)):
        missing[a:b] = False
        np.testing.assert_array_equal(
            experiment.y[a:b], speed_from_counts(counts[a:b], 0.001, 1572.0)
        )
    np.testing.assert_array_equal(np.isnan(experiment.y), missing)
    np.testing.assert_array_equal(np.isnan(experiment.u[:, 0]), missing)


def test_pieces_of_a_few_counts_have_no_speed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path, header(columns={"u": "V", "counts": "1"})) as writer:
        for a, n in ((0, 4), (5, 5), (20, 60)):
            writer.samples(a, {"u": np.ones(n), "counts": np.arange(a, a + n)})
    y = api.read(path, inputs="u", counts="counts").experiments[0].y
    assert np.flatnonzero(np.isfinite(y)).tolist() == [*range(5, 10), *range(20, 80)]


def test_a_data_set_is_split_at_its_gaps(folder: Path) -> None:
    data = api.read(folder / "holed.mcap", inputs="u", counts="counts")
    with pytest.raises(DataError, match=r"sample 1500.*split_at_gaps"):
        api.identify(data, model="oe")
    pieces = data.split_at_gaps()
    assert [e.range_text for e in pieces.experiments] == ["0:1500", "1540:2000", "2050:4000"]
    assert pieces.notes == (
        "holed.mcap: samples 2010:2040 between gaps are left out, fewer than 100",
    )
    assert "2010:2040" in str(pieces)
    pieces.require_complete()
    assert api.identify(pieces, model="oe").simulate(pieces)
    assert len(data.split_at_gaps(30).experiments) == 4
    assert Dataset.concat([pieces, pieces]).notes == 2 * pieces.notes


def test_splitting_says_what_it_cannot_do(folder: Path) -> None:
    data = api.read(folder / "holed.mcap", inputs="u", counts="counts")
    with pytest.raises(DataError, match="5000 samples without a gap, received 1950"):
        data.split_at_gaps(5000)
    for wrong in (0, -1, 1.5, True):
        with pytest.raises(SettingError, match="shortest"):
            data.split_at_gaps(wrong)  # type: ignore[arg-type]


def test_without_gaps_splitting_changes_nothing(folder: Path) -> None:
    data = api.read(folder / "whole.mcap", inputs="u", output="y")
    (piece,) = data.split_at_gaps().experiments
    np.testing.assert_array_equal(piece.y, data.experiments[0].y)
    assert data.split_at_gaps().notes == ()


def test_a_model_comes_from_a_recording_without_naming_columns(
    folder: Path, tmp_path: Path
) -> None:
    model = tmp_path / "m.json"
    sewfast(folder, "identify", "whole.mcap", "--model", "oe", "-o", model)
    found = sewfast(folder, "validate", model, "whole.mcap", "--json").json()
    assert found["simulation"]["fit_percent"] > 90.0
    sewfast(folder, "simulate", model, "whole.mcap", "-o", tmp_path / "p.csv")


def test_a_model_of_speed_is_validated_on_counts(folder: Path, tmp_path: Path) -> None:
    model = tmp_path / "m.json"
    columns = ("--input", "u", "--output", "y")
    sewfast(folder, "identify", "whole.mcap", *columns, "--model", "oe", "-o", model)
    for asked in ((), ("--split-at-gaps",)):
        told = sewfast(folder, "validate", model, "holed.mcap", *asked, "--json")
        assert len(told.json()["experiments"]) == 3
        assert "2010:2040 between gaps are left out" in told.err


def test_pieces_between_missing_rows_are_experiments(folder: Path, tmp_path: Path) -> None:
    out = ("--model", "oe", "-o", tmp_path / "m.json")
    told = sewfast(folder, "identify", "holed.mcap", *out)
    assert "rows are missing; the pieces between are separate experiments" in told.err
    assert "2010:2040 between gaps are left out" in told.err


def test_a_virtual_recording_may_be_an_mcap_file(tmp_path: Path) -> None:
    arguments = ("record", "--on", "virtual:2", "--signal", "step")
    sewfast(tmp_path, *arguments, "-o", "step.mcap")
    sewfast(tmp_path, *arguments, "-o", "step.csv")
    found = read_recording(tmp_path / "step.mcap")
    assert (found.header.name, found.header.settings["seed"]) == ("step", 0)
    table = api.read_table(tmp_path / "step.csv")
    for name, column in found.columns.items():
        np.testing.assert_array_equal(column, table[name])


def test_show_says_what_is_there(folder: Path) -> None:
    text = sewfast(folder, "show", "holed.mcap").out
    for word in ("3940 of 4000 samples", "complete", "samples 1500:1540", "boot_id: 7", "u [V]"):
        assert word in text
    told = sewfast(folder, "show", "holed.mcap", "--json").json()
    assert told["gaps"] == [[1500, 40], [2000, 10], [2040, 10]]
    assert (told["received"], told["complete"], told["damage"]) == (3940, False, [])
    assert sewfast(folder, "show", "whole.mcap", "--json").json()["complete"]


def test_show_prints_models_and_controllers_too(folder: Path, tmp_path: Path) -> None:
    model = model_of("oe")
    model.save(tmp_path / "drive.json")
    assert sewfast(tmp_path, "show", "drive.json").out == f"{model}\n"
    assert sewfast(tmp_path, "show", "drive.json", "--json").json()["kind"] == "oe"
    paper_controller().save(tmp_path / "controller.json")
    assert "2-DOF PID" in sewfast(tmp_path, "show", "controller.json").out
    (tmp_path / "results.json").write_text('{"format": "sewfast.results"}')
    assert "sewfast look" in refused(tmp_path, "show", "results.json")


def test_export_writes_what_other_programs_read(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.csv"
    told = sewfast(folder, "export", "holed.mcap", "-o", out)
    assert "3 gap(s)" in told.out
    table = api.read_table(out)
    assert np.isnan(table["u"]).sum() == 60
    # an export still becomes a speed, gap by gap
    data = api.read(out, inputs="u", counts="counts", counts_per_rev=1572)
    np.testing.assert_array_equal(
        data.experiments[0].y,
        api.read(folder / "holed.mcap", inputs="u", counts="counts").experiments[0].y,
    )
    message = refused(folder, "export", "holed.mcap", "-o", tmp_path / "run.xlsx")
    assert ".parquet" in message
    assert "No such file" in refused(folder, "show", "none.mcap")


def test_export_leaves_the_recording_itself_alone(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "torn.mcap"
    path.write_bytes((folder / "whole.mcap").read_bytes()[:-200])
    (tmp_path / "link.mcap").symlink_to(path)
    for same in ("torn.mcap", "./torn.mcap", "link.mcap"):
        assert "expected a separate file" in refused(tmp_path, "export", "torn.mcap", "-o", same)


def test_tune_takes_the_volt_limit_of_a_recording(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = header(5, columns={"u": "V"}, settings={"limits": {"volt": 7.5, "current": None}})
    with RecordWriter(tmp_path / "drive.mcap", made) as writer:
        writer.samples(0, {"u": np.ones(5)})
    given = {}

    def tune(model: object, references: object, **settings: object) -> None:
        given.update(settings)
        raise SettingError("far enough")

    monkeypatch.setattr("sewfast.tuning.search.tune", tune)
    model = tmp_path / "model.json"
    data = api.read(folder / "whole.mcap", inputs="u", output="y")
    api.identify(data, model="arx").save(model)
    out = str(tmp_path / "c.json")
    command = ["tune", str(model), "-o", out, "--limits-of"]
    assert main([*command, str(tmp_path / "drive.mcap"), "--u-min", "0"]) == 2
    assert (given["u_min"], given["u_max"]) == (0.0, 7.5)
    assert main(["tune", str(model), "-o", out]) == 2
    # left to what the model's own record has seen
    assert (given["u_min"], given["u_max"]) == (None, None)
    given.clear()
    assert main([*command, str(folder / "whole.mcap")]) == 2
    assert not given
