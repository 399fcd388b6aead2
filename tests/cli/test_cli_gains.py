"""`sewfast gains`: from a step or from K, T, L to a controller with its margins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cli import call_refused as refused
from cli import called as sewfast
from sewfast import load_controller, margins, write_table
from sewfast.control import Fopdt

PLANT = ("--K", 490, "--T", 0.25, "--L", 0.0075)


@pytest.mark.parametrize("rule", ["eq-12", "simc", "simc-pid", "amigo"])
def test_every_rule_from_numbers(tmp_path: Path, rule: str) -> None:
    options = ("--rule", rule, "--form", "per-sample", "-o", "c.json", "--json")
    found = sewfast(tmp_path, "gains", *PLANT, *options).json()
    controller = load_controller(tmp_path / "c.json")
    assert controller.gains.form == "per_sample"
    assert set(found["gains"]) == {"standard", "parallel", "per_sample"}
    again = margins(controller, Fopdt(490.0, 0.25, 0.0075))
    assert found["margins"]["Ms"] == pytest.approx(again.Ms, rel=1e-9)
    assert found["margins"]["stable"]
    assert again.Ms < 2.2


def test_a_step_recording_becomes_gains(tmp_path: Path) -> None:
    t = np.arange(1500) * 0.001
    u = np.where(t < 0.2, 0.0, 2.0)
    y = Fopdt(490.0, 0.15, 0.012, u_high=2.0).response(t - 0.2)
    y += 3.0 * np.random.default_rng(1).standard_normal(len(t))
    write_table(tmp_path / "step.csv", {"t": t, "u": u, "y": y}, units={"u": "V", "y": "RPM"})
    columns = ("--input", "u", "--output", "y")
    found = sewfast(tmp_path, "gains", "step.csv", *columns, "--Ms", 1.7)
    for part in ("L/T", "eq-12, Ms <= 1.7", "per-sample", "phase margin", "noise gain"):
        assert part in found.out
    plant = sewfast(tmp_path, "gains", "step.csv", *columns, "--json").json()["plant"]
    assert plant["K"] == pytest.approx(490.0, rel=0.01)
    assert plant["T"] == pytest.approx(0.15, rel=0.03)


def test_what_does_not_belong_together_is_refused(tmp_path: Path) -> None:
    assert "either a recording" in refused(tmp_path, "gains")
    assert "--K, --T and --L" in refused(tmp_path, "gains", "--K", 1)
    assert "--Ms: expected the rule" in refused(
        tmp_path, "gains", *PLANT, "--rule", "amigo", "--Ms", 2
    )
    assert "nearest" in refused(
        tmp_path, "gains", "--K", 1, "--T", 1, "--L", 0.01, "--rule", "table-1"
    )


def test_a_unit_is_known_or_empty_and_never_invented(tmp_path: Path) -> None:
    t = np.arange(1500) * 0.001
    y = Fopdt(0.6, 0.15, 0.012, u_high=2.0).response(t - 0.2)
    write_table(tmp_path / "step.csv", {"t": t, "u": np.where(t < 0.2, 0.0, 2.0), "y": y})
    for given in (("step.csv",), ("--K", 0.6, "--T", 0.15, "--L", 0.012)):
        found = sewfast(tmp_path, "gains", *given, "-o", "c.json").out
        assert "V/RPM" not in found
        assert " y/u" in found
        assert " u/y" in found
        gains = load_controller(tmp_path / "c.json").gains
        assert (gains.u_unit, gains.y_unit) == ("", "")
    write_table(tmp_path / "oven.csv", {"t": t, "heater_pct": np.where(t < 0.2, 0.0, 2.0),
                                        "temp_C": y})  # fmt: skip
    assert "%/degC" in sewfast(tmp_path, "gains", "oven.csv").out
