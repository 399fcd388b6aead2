"""Loops, first gains and references begin at the level at which a plant stands still."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sewfast import Dataset, Gains, LinearOE, check, identify, load_model
from sewfast.analysis.changes import with_gain
from sewfast.control.controller import Controller
from sewfast.control.defaults import drive_references, drive_step, recorded_limits
from sewfast.control.loop import run
from sewfast.errors import ModelFileError, SettingError
from sewfast.tuning import costs, tune
from sewfast.tuning.task import first_controller

SHIFTS = [(0.0, 0.0), (0.0, 24.5), (0.0, 293.15), (4.0, -40.0)]
POLES = np.poly([0.9, 0.97])


def heater(u0: float = 0.0, y0: float = 0.0) -> Any:
    """A gain of .6 and two lags, with a rest at (u0, y0)."""
    num = np.array([0.0, 0.6 * POLES.sum()])
    names = {"input_units": ["%"], "output_unit": "degC"}
    plant = LinearOE.from_tf(num, POLES, 5.0, operating_point=([u0], y0), **names)
    known = {
        "input_range": [[u0, u0 + 100.0]],
        "output_range": [y0, y0 + 50.0],
        "rest": {"u": [u0], "y": y0, "source": "standing samples"},
    }
    return replace(plant, training=known)


def pid(u0: float = 0.0) -> Controller:
    gains = Gains.standard(5.0, 120.0, 10.0, u_unit="%", y_unit="degC")
    return Controller(gains, Ts=5.0, u_min=u0, u_max=u0 + 100.0, N=10.0, alpha=0.3)


@pytest.mark.parametrize(("u0", "y0"), SHIFTS)
def test_a_shift_changes_no_run_and_no_reference(u0: float, y0: float) -> None:
    plain, moved = heater(), heater(u0, y0)
    assert recorded_limits([moved]) == (u0, u0 + 100.0)
    for name, r in drive_references(plain, 0.0, 100.0).items():
        shifted = drive_references(moved, u0, u0 + 100.0)[name]
        np.testing.assert_allclose(shifted - y0, r, atol=1e-4)
        assert shifted.min() >= y0 - 1e-4
        assert shifted.max() <= y0 + 50.0
    expected, found = run(pid(), plain), run(pid(u0), moved)
    assert found.u[0] == pytest.approx(u0)
    assert found.y[0] == pytest.approx(y0)
    np.testing.assert_allclose(found.u - u0, expected.u, atol=1e-4)
    np.testing.assert_allclose(found.y - y0, expected.y, atol=1e-4)
    np.testing.assert_allclose(found.feedback - y0, expected.feedback, atol=1e-4)


@pytest.mark.parametrize(("offset", "begins"), [(-0.23, 22.0), (0.23, 22.23)])
def test_references_begin_at_the_level_of_rest_if_the_model_reaches_it(
    offset: float, begins: float
) -> None:
    """A slow plant's model is off by a little at rest, where the plant itself cannot be lower."""
    plain = heater(0.0, 22.0 + offset)
    seen = {**plain.training["rest"], "y": 22.0}
    for r in drive_references(
        replace(plain, training={**plain.training, "rest": seen}), 0.0, 100.0
    ).values():
        assert r.min() == pytest.approx(begins, abs=0.01)


@pytest.mark.parametrize(("u0", "y0"), SHIFTS)
def test_a_shift_changes_no_first_gain_and_no_cost(u0: float, y0: float) -> None:
    plain, moved = heater(), heater(u0, y0)
    step, other = drive_step(plain, 0.0, 100.0), drive_step(moved, u0, u0 + 100.0)
    assert other.rest == pytest.approx(y0)
    assert other.fopdt.K == pytest.approx(step.fopdt.K)  # noqa: SIM300
    first, second = first_controller(plain), first_controller(moved)
    assert second.gains.Kp == pytest.approx(first.gains.Kp, rel=1e-6)
    assert second.gains.Kp > 0.0
    np.testing.assert_allclose(costs(pid(u0), moved), costs(pid(), plain), rtol=1e-6)
    tuned, again = (tune(m, evaluations=40, threads=1).controller for m in (plain, moved))
    assert again.gains.Kp == pytest.approx(tuned.gains.Kp, rel=1e-3)
    assert (again.u_min, again.u_max) == (u0, u0 + 100.0)


def test_runs_from_rest_begin_there_and_keep_their_level() -> None:
    moved = heater(4.0, 293.15)
    np.testing.assert_allclose(moved.simulate(np.full(9, 4.0)), 293.15)
    np.testing.assert_allclose(moved.rest_state(), 293.15)
    # more gain changes the response and not the level at rest
    run_of = with_gain(moved, 1.25).simulate(np.full(2000, 14.0), initial_state=[293.15, 293.15])
    assert run_of[-1] == pytest.approx(293.15 + 1.25 * 6.0)


def test_a_rest_of_zero_leaves_every_bit() -> None:
    plain, without = heater(), replace(heater(), training={})
    assert plain.about_rest is plain.core
    assert without.rest.is_zero
    ranges = {k: v for k, v in plain.training.items() if k != "rest"}
    expected, found = run(pid(), replace(plain, training=ranges)), run(pid(), plain)
    np.testing.assert_array_equal(found.y, expected.y)


def test_a_schedule_over_the_output_needs_a_rest_of_zero() -> None:
    steps = ((10.0, pid().gains), (20.0, pid().gains))
    with pytest.raises(SettingError) as caught:
        run(replace(pid(), schedule=steps), heater(0.0, 24.5))
    assert caught.value.name == "schedule"


def test_files_keep_the_rest_and_refuse_a_damaged_one(tmp_path: Path) -> None:
    path = tmp_path / "heater.json"
    heater(4.0, 293.15).save(path)
    assert (load_model(path).rest.u, load_model(path).rest.y) == ((4.0,), 293.15)
    values = json.loads(path.read_text())
    for damaged in ({"u": [1.0, 2.0], "y": 0.0}, {"u": [1.0]}, 3):
        values["training"]["rest"] = damaged
        path.write_text(json.dumps(values))
        with pytest.raises(ModelFileError):
            load_model(path)
    # files of earlier versions have none
    del values["training"]["rest"]
    path.write_text(json.dumps(values))
    assert load_model(path).rest.is_zero


def test_the_report_card_names_a_model_that_begins_at_another_level() -> None:
    rng, u = np.random.default_rng(0), np.repeat([0.0, 40.0, 10.0, 60.0], 150)
    y = heater(0.0, 24.5).simulate(u) + 0.05 * rng.normal(size=len(u))
    names = {"input_names": ["duty"], "output_name": "T", "output_unit": "degC"}
    record = Dataset.from_arrays(u, y, 5.0, **names)
    model = identify(record, model="oe", nk=1)
    assert model.rest.y == pytest.approx(24.5, abs=0.05)
    assert not [line for line in check(model, record).lines if line.name == "rest"]
    older = replace(model, training={k: v for k, v in model.training.items() if k != "rest"})
    (line,) = [line for line in check(older, record).lines if line.name == "rest"]
    assert (line.verdict, line.value) == ("warn", pytest.approx(24.5, abs=0.05))
    assert "identify it again" in line.meaning
