"""Tables of known moves: planned on models, kept in files, played wherever the controller runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lags import LEAD, PI, RAMP, drive, error, rms
from refusals import refuses
from sewfast import (
    DataError,
    Feedforward,
    FitError,
    Gains,
    ModelFileError,
    MoveTable,
    SettingError,
    VirtualMachine,
    load_table,
    plan,
    run,
    tune,
)
from sewfast.commissioning import SteppedBench
from sewfast.link import VirtualDevice, connect


@pytest.mark.parametrize("lead", [None, LEAD])
def test_a_model_follows_its_table_and_expects_what_it_does(lead: Feedforward | None) -> None:
    controller = replace(PI, feedforward=lead)
    table = plan(controller, drive(), RAMP, name="ramp")
    before, after = table.expected
    assert after < 0.1 * before
    played = run(controller, drive(), table=table)
    plain = run(controller, drive(), RAMP)
    assert error(plain) == pytest.approx(before, rel=0.1)
    # the encoder's counts are rounded in a run, not in a plan
    assert error(played) < 0.25 * error(plain)
    np.testing.assert_array_equal(played.r, RAMP)
    assert played.reference == "ramp"
    assert rms(played.y - table.y) < 0.1 * before
    assert rms(played.u - table.u) < 1.0
    assert "expected  error" in str(table)


def test_an_ensemble_shares_a_table_that_is_worse_on_none() -> None:
    models = [drive(), drive(gain=560.0), drive(gain=430.0), drive(time=0.3)]
    table = plan(PI, models, RAMP)
    assert len(table.errors) == 4
    assert all(after < 0.5 * before for before, after in table.errors)


def test_state_feedback_has_tables_too() -> None:
    found = tune(drive(), [RAMP], controller="state_feedback", evaluations=60, threads=1)
    table = plan(found.controller, drive(), RAMP)
    before, after = table.expected
    assert after < 0.3 * before


def test_the_command_keeps_its_limits_and_says_if_it_is_at_one() -> None:
    tight = replace(PI, u_min=-2.0, u_max=8.0)
    steep = np.clip((np.arange(600) - 100) * 60.0, 0.0, 1500.0)
    table = plan(tight, drive(), steep)
    assert table.limited > 0.01
    assert table.u.min() >= -2.0
    assert table.u.max() <= 8.0
    assert "asks for more than the drive has" in str(table)


def test_the_result_does_not_depend_on_threads_and_shows_progress() -> None:
    models, seen = [drive(), drive(gain=560.0)], []
    one = plan(PI, models, RAMP, threads=1, progress=lambda *now: seen.append(now))
    np.testing.assert_array_equal(one.setpoint, plan(PI, models, RAMP, threads=3).setpoint)


def test_a_file_keeps_it_whole(tmp_path: Path) -> None:
    table = plan(replace(PI, feedforward=LEAD), drive(), RAMP, name="ramp")
    table.save(tmp_path / "t.json")
    again = load_table(tmp_path / "t.json")
    assert again.to_dict() == table.to_dict()
    again.require(table.controller)
    assert json.loads((tmp_path / "t.json").read_text())["version"] == 1


@given(st.data())
def test_a_damaged_file_is_refused_by_name(tmp_path_factory: Any, data: st.DataObject) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = MoveTable(RAMP[:3], RAMP[:3], RAMP[:3], RAMP[:3], RAMP[:3], PI).to_dict()
    document = {"format": "sewfast.table", "version": 1, **whole}
    name = data.draw(st.sampled_from(sorted(document)))
    wrong = data.draw(st.sampled_from([None, "x", [1.0], {}, [[1.0]], ["a"], -3, True]))
    document[name] = wrong
    (folder / "d.json").write_text(json.dumps(document))
    if (name, wrong) in (("name", "x"), ("correction", [1.0]), ("limited", -3)):
        load_table(folder / "d.json")
        return
    with pytest.raises(ModelFileError, match=r"d\.json"):
        load_table(folder / "d.json")


def test_it_is_played_on_machine_bench_and_device_alike() -> None:
    table = plan(replace(PI, feedforward=LEAD), drive(), RAMP, name="ramp")
    c = table.controller
    here = run(c, VirtualMachine(), table=table)
    with VirtualDevice(fast=True) as device, connect(device.port) as drive_:
        drive_.set_limits(volt=20.0, speed_rpm=4000.0)
        there = run(c, drive_, table=table)
    np.testing.assert_array_equal(there.r, RAMP)
    assert rms(there.y - here.y) < 5.0

    class Stepped:
        def __init__(self) -> None:
            self.machine = VirtualMachine()

        @property
        def counts(self) -> float:
            return float(self.machine.counts)

        @property
        def speed_rpm(self) -> float:
            return self.machine.speed_rpm

        def reset(self) -> None:
            self.machine.reset()

        def step(self, u: float) -> None:
            self.machine.step(u)

    bench = SteppedBench(Stepped(), Ts=0.001, counts_per_rev=1572.0, volt=20.0)
    stepped = run(c, bench, table=table)
    assert rms(stepped.y - here.y) < 5.0
    assert error(here) < error(run(replace(c, feedforward=None), VirtualMachine(), RAMP))


def test_what_does_not_belong_together_is_refused() -> None:
    table = plan(PI, drive(), RAMP)
    with refuses(SettingError, name="table", received="gains"):
        run(replace(PI, gains=Gains.standard(0.02, 0.1)), drive(), table=table)
    with pytest.raises(SettingError, match="sample time"):
        table.require(replace(PI, Ts=0.002))
    with pytest.raises(SettingError, match="no other reference"):
        run(PI, drive(), RAMP, table=table)
    with pytest.raises(DataError, match="MoveTable"):
        run(PI, drive(), table=RAMP)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="r_rate"):
        plan(replace(PI, r_rate=100.0), drive(), RAMP)
    with pytest.raises(SettingError, match="at least one"):
        plan(PI, [], RAMP)
    with pytest.raises(DataError):
        plan(PI, drive(), [])
    with pytest.raises(DataError):
        plan(PI, drive(), [0.0, np.nan])
    wild = replace(PI, gains=Gains.standard(50.0, 0.1), u_min=-np.inf, u_max=np.inf)
    with pytest.raises(FitError, match="loop"):
        plan(wild, drive(), RAMP)
