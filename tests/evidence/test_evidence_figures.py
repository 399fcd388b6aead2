"""Figures of the report card, the command, and what the report shows of them."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import result_folder
import sewfast
from cli import called as command
from plants import bent_data, linear_data
from sewfast import Dataset
from sewfast.errors import DataError, SettingError
from sewfast.evidence import ReportCard
from sewfast.evidence.figures import figures, save
from sewfast.report import report

pytest.importorskip("matplotlib", reason="needs the report extra")
NAMES = ["residuals", "bands", "bode", "poles", "region"]


@cache
def card() -> ReportCard:
    data = Dataset.concat([linear_data(400, seed=s, noise=0.5, inputs=2) for s in (1, 2)])
    return sewfast.identify(data, model="oe").check(data)


def test_there_is_a_figure_per_question_with_units() -> None:
    found = figures(card())
    assert list(found) == NAMES
    for figure in found.values():
        for ax in figure.axes:
            assert not ax.axison or ax.get_ylabel()
    assert found["bode"].axes[0].get_ylabel() == "gain [RPM/V]"
    assert "time [s]" in {ax.get_xlabel() for ax in found["bands"].axes}


def test_gaps_and_long_records_are_drawn() -> None:
    e = bent_data(9000, noise=0.05).experiments[0]
    y = e.y.copy()
    y[5000:5200] = np.nan
    data = Dataset.from_arrays(e.u, y, 0.01, input_units="V", output_unit="RPM")
    model = sewfast.identify(bent_data(800, noise=0.05), model="oe")
    lines = figures(model.check(data))["bands"].axes[0].get_lines()
    measured = next(x for x in lines if x.get_label() == "measured")
    drawn = np.asarray(measured.get_ydata())
    assert len(drawn) < 5000
    assert np.isnan(drawn).any()
    assert np.nanmax(drawn) == np.nanmax(y)


def test_figures_are_written_whole(tmp_path: Path) -> None:
    written = save(card(), tmp_path / "new" / "folder")
    assert [p.stem for p in written] == NAMES
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in written)
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingError, match="folder"):
        save(card(), tmp_path / "file")


@pytest.mark.nightly("another card")
def test_the_command_prints_the_card(tmp_path: Path) -> None:
    data = linear_data(900, noise=0.5)
    e = data.experiments[0]
    columns = {"t": 0.01 * np.arange(len(e)), "u": e.u[:, 0], "speed": e.y}
    sewfast.write_table(tmp_path / "run.csv", columns, units={"u": "V", "speed": "RPM"})
    sewfast.identify(data, model="oe").save(tmp_path / "m.json")
    said = command(tmp_path, "check", "m.json", "run.csv")
    assert "verdict: " in said.out
    arguments = ["--json", "--range", "100:900", "--training", "run.csv"]
    arguments += ["--training-range", "0:600", "--plot", "figures"]
    found = command(tmp_path, "check", "m.json", "run.csv", *arguments).json()
    assert found["format"] == "sewfast.report_card"
    assert found["criteria"]["aic"] is not None
    assert len(found["figures"]) == len(NAMES)


def _with_card(folder: Path, drawing: str) -> Path:
    made = result_folder.make(folder)
    path = made / "results.json"
    shown = {**card().to_json(), "figures": ["bode"]}
    path.write_text(json.dumps({**json.loads(path.read_text()), "check": shown}))
    (made / "check").mkdir()
    (made / "check" / "bode.svg").write_text(drawing)
    return made


@pytest.mark.nightly("another report")
def test_the_report_shows_the_card(tmp_path: Path) -> None:
    drawing = '<svg viewBox="0 0 100 50" role="img" aria-label="Bode"><path d="M0 0"/></svg>'
    page = report(_with_card(tmp_path / "a", drawing)).read_text()
    assert "Can the default network be trusted?" in page
    assert all(line.name in page for line in card().lines)
    assert drawing in page


@pytest.mark.parametrize(
    "drawing",
    ["", "<p>", "<svg><script>1</script></svg>", '<svg onload="x"/>', '<svg><a href="http:x"/>'],
)
def test_the_report_takes_drawings_only(tmp_path: Path, drawing: str) -> None:
    with pytest.raises(DataError, match=r"bode\.svg"):
        report(_with_card(tmp_path / "a", drawing))
