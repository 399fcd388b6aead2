"""`sewfast profile`, `plan`, `learn` and `run --table`: files in, files out, refusals by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cli import call_refused as refused
from cli import called as sewfast
from lags import LEAD, PI, RAMP, drive
from sewfast import load_table, write_table
from sewfast.readers import read_columns


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    from dataclasses import replace

    replace(PI, feedforward=LEAD).save(tmp_path / "c.json")
    drive().save(tmp_path / "m.json")
    t = np.arange(len(RAMP)) * 1e-3
    write_table(tmp_path / "ramp.csv", {"t": t, "r": RAMP}, units={"t": "s", "r": "RPM"})
    step = np.where((t > 0.1) & (t < 0.6), 2000.0, 0.0)
    write_table(tmp_path / "step.csv", {"t": t, "r": step}, units={"t": "s", "r": "RPM"})
    return tmp_path


def test_from_a_step_to_a_learned_move(folder: Path) -> None:
    out = sewfast(folder, "profile", "m.json", "--reference", "step.csv", "-o", "r.csv", "--json")
    assert "rate" in out.json()["bounds"]
    r = read_columns(folder / "r.csv", inputs="r").experiments[0].u[:, 0]
    assert r.max() == pytest.approx(2000.0)
    plan = ("plan", "c.json", "m.json", "--reference", "r.csv", "-o", "t.json")
    found = sewfast(folder, *plan, "--json").json()
    assert found["expected"] < 0.3 * found["without"]
    assert "expected  error" in sewfast(folder, *plan).out
    run = ("run", "c.json", "--table", "t.json", "--json", "-o", "y.csv")
    played = sewfast(folder, *run, "--on", "m.json").json()
    assert played["reference"] == "r"
    assert played["rmse"] < 0.5 * found["without"]
    learn = ("learn", "c.json", "m.json", "--on", "virtual", "-o", "l.json")
    ramp = ("--reference", "ramp.csv", "--repetitions", "3")
    told = sewfast(folder, *learn, *ramp, "--json").json()
    assert [one["number"] for one in told["repetitions"]] == [1, 2, 3]
    assert told["repetitions"][-1]["error"] < told["repetitions"][0]["error"]
    again = sewfast(folder, *learn, "--resume", "--repetitions", "1").out
    assert "repetition  4" in again
    assert len(load_table(folder / "l.json").repetitions) == 4
    assert "--resume" in refused(folder, *learn, "--table", "t.json")


def test_within_reach_plans_a_step(folder: Path) -> None:
    plan = ("plan", "c.json", "m.json", "--reference", "step.csv", "-o", "t.json", "--json")
    asked = sewfast(folder, *plan).json()["limited"]
    assert sewfast(folder, *plan, "--within-reach").json()["limited"] < 0.5 * asked


def test_what_does_not_belong_together_is_refused(folder: Path) -> None:
    sewfast(folder, "plan", "c.json", "m.json", "--reference", "ramp.csv", "-o", "t.json")
    run = ("run", "c.json", "m.json", "--table", "t.json")
    assert "--table" in refused(folder, *run, "--reference", "ramp.csv")
    PI.save(folder / "other.json")
    assert "another feedforward" in refused(folder, "run", "other.json", *run[2:])
    learn = ("learn", "c.json", "m.json", "--on", "virtual", "-o", "l.json")
    assert "one of them" in refused(folder, *learn, "--table", "t.json", "--resume")
    assert "sewfast.table" in refused(folder, *learn, "--table", "c.json")
    assert "repetitions" in refused(folder, *learn, "--table", "t.json", "--repetitions", "0")
    assert "--within-reach" in refused(folder, *learn, "--table", "t.json", "--within-reach")
    port = ("learn", "c.json", "m.json", "--on", "/dev/none", "-o", "l.json")
    assert "a slip must not move a motor" in refused(folder, *port)
    assert "share" in refused(
        folder, "profile", "m.json", "--reference", "ramp.csv", "--share", "2", "-o", "r.csv"
    )


def test_a_learned_table_is_not_replaced_unasked(folder: Path) -> None:
    from dataclasses import replace

    from sewfast.control.files import load_table
    from sewfast.control.move import Repetition

    plan = ("plan", "c.json", "m.json", "--reference", "ramp.csv", "-o", "t.json")
    sewfast(folder, *plan)
    known = (Repetition(1, 2.0, 5.0, None, "first"),)
    replace(load_table(folder / "t.json"), repetitions=known).save(folder / "t.json")
    assert "no table that was learned" in refused(folder, *plan)
    sewfast(folder, *plan, "--overwrite")
    assert not load_table(folder / "t.json").repetitions


def test_a_useless_model_is_refused_unless_by_force(folder: Path) -> None:
    from dataclasses import replace

    known = {**drive().training, "verdict": {"grade": "useless", "text": "it explains nothing"}}
    replace(drive(), training=known).save(folder / "bad.json")
    for command in ("plan", "profile"):
        files = ("c.json",) * (command == "plan") + ("bad.json",)
        asked = (
            command,
            *files,
            "--reference",
            "ramp.csv",
            "-o",
            "t.json" if len(files) > 1 else "r.csv",
        )
        assert "it explains nothing" in refused(folder, *asked)
        assert "warning" in sewfast(folder, *asked, "--force").err
