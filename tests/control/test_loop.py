"""Closed loops: the paper's gains on the paper's plant, models against the machine, refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest

from loops import QUIET, drive
from sewfast import _core, signals
from sewfast.control import Controller, Gains, paper_controller
from sewfast.control.loop import run
from sewfast.errors import DataError, FitError, SettingError
from sewfast.machine import VirtualMachine
from sewfast.models import LinearOE


def linear(a: list[float], b: list[float], Ts: float = 0.001, unit: str = "RPM") -> LinearOE:
    core = _core.LinearModel(np.array(a), np.array([b]), 1, 0.0)
    return LinearOE(core, Ts, ("u",), "y", ("V",), unit)


EQ_8 = linear([-1.87, 0.8705], [0.1228, 0.1224])


def test_the_papers_gains_track_on_the_papers_plant_read_per_sample() -> None:
    ideal = replace(paper_controller(), counts_per_rev=None)
    told = run(ideal, EQ_8, "trapezoid").metrics()
    assert told["rise_time_ms"] == pytest.approx(186, abs=2)
    assert told["overshoot_percent"] < 2.1
    assert told["rmse"] < 210


def test_the_papers_gains_lean_on_their_limits() -> None:
    wide = replace(paper_controller(), counts_per_rev=None, u_min=-1e3, u_max=1e3)
    assert run(wide, EQ_8, "trapezoid").metrics()["rmse"] > 1000


@pytest.mark.parametrize(
    "gains",
    [
        Gains.standard(0.02, 0.02, 0.5),
        Gains.parallel(0.02, 0.02, 0.5),
        Gains.per_sample(0.02 / 38.168, 0.02 / 38.168, 0.5 / 38.168, Ts=0.001),
        Gains.per_sample(2e-5, 2e-5, 5e-4, Ts=0.001),
    ],
    ids=["standard", "parallel", "counts per sample", "kRPM"],
)
def test_no_other_reading_of_the_papers_gains_tracks(gains: Gains) -> None:
    other = replace(paper_controller(), gains=gains, counts_per_rev=None)
    told = run(other, EQ_8, "trapezoid").metrics()
    assert told["rmse"] > 350
    assert told["rise_time_ms"] is None or told["overshoot_percent"] > 8


def test_the_papers_gains_reach_the_level_on_the_virtual_machine_as_a_limit_cycle() -> None:
    told = run(paper_controller(), VirtualMachine(u_limit=10.0), "trapezoid").metrics()
    assert 180 < told["rise_time_ms"] < 215
    assert told["du_rms"] > 5


def test_a_run_has_its_columns_units_and_conventions() -> None:
    told = run(QUIET, drive(), "trapezoid")
    columns = told.columns()
    assert list(columns) == ["t", "r", "u", "y", "feedback"] == list(told.units)
    assert {len(c) for c in columns.values()} == {len(signals.reference("trapezoid"))}
    assert told.units["u"] == "V"
    assert told.units["feedback"] == "RPM"
    assert np.all(np.abs(told.u) <= 20)
    assert (told.plant, told.reference, told.Ts) == ("oe", "trapezoid", 0.001)
    count = 60 / (1572 * 0.001) / 8
    assert np.allclose(told.feedback / count, np.round(told.feedback / count), atol=1e-6)
    error = told.r - told.y
    assert told.metrics()["rmse"] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert "trapezoid on oe" in str(told)


def test_a_run_repeats_and_leaves_its_plant_and_reference_alone() -> None:
    machine, r = VirtualMachine(), np.full(200, 500.0)
    machine.step(3.0)
    before = (machine.counts, machine.speed_rpm)
    first, second = run(QUIET, machine, r), run(QUIET, machine, r)
    assert np.array_equal(first.y, second.y)
    assert (machine.counts, machine.speed_rpm) == before
    assert first.r is not r


def test_the_loop_is_the_machine_stepped_by_hand() -> None:
    machine, core = VirtualMachine(), QUIET.core()
    r = signals.reference("trapezoid")[:600]
    told = run(QUIET, VirtualMachine(), r)
    counts, speed = machine.counts, machine.speed_rpm
    before = counts
    for k, reference in enumerate(r):
        assert told.y[k] == speed
        u = core.step(reference, (counts - before) / (0.001 * 1572 / 60))
        assert told.u[k] == pytest.approx(u, abs=1e-9)
        before = counts
        counts, speed = machine.step(u)


def test_metrics_without_a_step_are_none() -> None:
    told = run(QUIET, drive(), np.sin(np.arange(500) / 30.0) * 100).metrics()
    assert told["rise_time_ms"] is None
    assert told["overshoot_percent"] is None
    slow = replace(QUIET, gains=Gains.standard(1e-4, 10.0))
    late = run(slow, drive(), "trapezoid").metrics()
    assert late["rise_time_ms"] is None
    assert late["overshoot_percent"] == 0.0


def test_a_loop_that_diverges_is_an_error_that_says_when() -> None:
    unstable = linear([-3.0], [1.0])
    with pytest.raises(FitError, match=r"diverged at 0\.\d+ s"):
        run(QUIET, unstable, "trapezoid")


def test_plants_and_references_that_do_not_fit_are_refused() -> None:
    two = LinearOE(
        _core.LinearModel(np.array([-0.9]), np.ones((2, 1)), 1, 0.0),
        0.001,
        ("u", "v"),
        "y",
        ("V", "V"),
        "RPM",
    )
    refused = [
        (QUIET, two, "trapezoid", "one input"),
        (QUIET, linear([-0.9], [1.0], Ts=0.01), "trapezoid", "sample time"),
        (QUIET, linear([-0.9], [1.0], unit="rad/s"), "trapezoid", "unit"),
        (QUIET, drive(), "unheard", "unheard"),
        (replace(QUIET, Ts=0.01), VirtualMachine(), "trapezoid", "one sample time|0.001 s"),
        (QUIET, "model.json", "trapezoid", "load_model"),
    ]
    for controller, plant, reference, says in refused:
        with pytest.raises(SettingError, match=says):
            run(controller, plant, reference)
    for bad in ([], [1.0, math.nan], np.ones((3, 2)), ["a", "b"]):
        with pytest.raises(DataError, match="reference"):
            run(QUIET, drive(), bad)


def test_named_references_need_rpm_at_a_millisecond() -> None:
    gains = Gains.standard(0.2, 0.05, y_unit="rad/s")
    with pytest.raises(SettingError, match="as samples"):
        run(Controller(gains), linear([-0.9], [1.0], unit="rad/s"), "trapezoid")


def test_feedforward_and_disturbance_are_what_the_core_makes_of_them() -> None:
    r = np.full(300, 500.0)
    feedforward, disturbance = r / 490.0, np.where(np.arange(300) < 150, 0.0, -1.0)
    told = run(QUIET, drive(), r, feedforward=feedforward, disturbance=disturbance)
    core = QUIET.core()
    core.step(r[0], told.feedback[0], feedforward[0])
    plain = run(QUIET, drive(), r)
    assert told.u[0] == pytest.approx(plain.u[0] + feedforward[0])
    assert np.array_equal(told.y[:150], run(QUIET, drive(), r, feedforward=feedforward).y[:150])
    assert np.min(told.y[150:]) < np.min(run(QUIET, drive(), r, feedforward=feedforward).y[150:])
    ahead = run(QUIET, VirtualMachine(), r, feedforward=feedforward)
    assert ahead.u[0] == pytest.approx(plain.u[0] + feedforward[0])


def test_signals_that_a_plant_cannot_take_are_refused() -> None:
    r = np.full(10, 500.0)
    with pytest.raises(SettingError, match="set_load"):
        run(QUIET, VirtualMachine(), r, disturbance=r)
    for bad in (r[:5], np.full(10, math.nan), np.ones((10, 2)), "none"):
        with pytest.raises(DataError, match="feedforward"):
            run(QUIET, drive(), r, feedforward=bad)


def test_a_model_begins_at_standstill_wherever_it_would_settle() -> None:
    core = _core.LinearModel(np.array([-0.9]), np.array([[10.0]]), 1, -5.0)
    model = LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM")
    ideal = replace(QUIET, alpha=0.0, counts_per_rev=None)
    told = run(ideal, model, np.zeros(50))
    # it would settle at -50
    assert tuple(told.y[:2]) == (0.0, -5.0)
