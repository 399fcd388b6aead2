"""State feedback: settings, files, loops, tuning, the virtual drive, what refuses it by name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import call_refused as refused
from cli import called as program
from sewfast import Constraints, StateFeedback, load_controller, signals
from sewfast.analysis import analyse
from sewfast.control.files import load_pid
from sewfast.control.loop import require_controller
from sewfast.control.state_feedback import VARIABLES
from sewfast.errors import ModelFileError, SettingError
from sewfast.link import VirtualDevice, connect
from sewfast.link.wire import KINDS
from sewfast.models import LinearOE
from sewfast.tuning import costs

LIMITS = {"u_min": -20.0, "u_max": 20.0}
ENCODER = 1572.0


@pytest.fixture(scope="module")
def model() -> Any:
    u = np.concatenate([signals.excitation("chirp_lo_hi"), 3.0 * signals.excitation("multisine")])
    return sewfast.identify(sewfast.record(sewfast.VirtualMachine(), u).dataset(), model="oe")


@pytest.fixture(scope="module")
def controller(model: Any) -> StateFeedback:
    return StateFeedback.from_model(model, counts_per_rev=ENCODER, weight=0.9, **LIMITS)


def test_files_come_back_and_pids_keep_their_version(
    controller: StateFeedback, tmp_path: Path
) -> None:
    path = tmp_path / "states.json"
    whole = replace(controller, lead=0.003, slew=5e3, r_rate=1e5, notes="by hand")
    whole.save(path)
    assert load_controller(path) == whole
    assert json.loads(path.read_text())["version"] == 4
    sewfast.paper_controller().save(tmp_path / "pid.json")
    assert json.loads((tmp_path / "pid.json").read_text())["version"] == 5
    assert load_controller(tmp_path / "pid.json") == load_pid(tmp_path / "pid.json")
    with pytest.raises(ModelFileError) as error:
        load_pid(path)
    assert (error.value.name, error.value.expected) == (str(path), "a PID")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"kind": "fuzzy"}, "kind"),
        ({"rho": -1.0}, "rho"),
        ({"num": [0.0, 0.0]}, "num"),
        ({"den": [0.1] * 5}, "den"),
        ({"extra": 1}, "extra"),
        ({"notes": None}, "notes"),
    ],
)
def test_damaged_files_are_refused_by_field(
    controller: StateFeedback, tmp_path: Path, change: dict[str, Any], named: str
) -> None:
    path = tmp_path / "states.json"
    controller.save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ModelFileError, match=named):
        load_controller(path)


def test_gains_solve_the_riccati_equation(controller: StateFeedback) -> None:
    """The regulator's gains against the equation that they come from, and the loop's poles."""
    numbers = controller.core().numbers
    A, b = np.zeros((5, 5)), np.zeros(5)
    A[:4, 0], b[:4] = -np.array(numbers["den"]), numbers["num"]
    A[[0, 1, 2], [1, 2, 3]] = 1.0
    A[4, 0], A[4, 4] = -1.0, 1.0
    K = np.array([*numbers["K"], -numbers["Ki"]])
    closed = A - np.outer(b, K)
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0
    Q = np.diag([1.0, 0.0, 0.0, 0.0, (controller.integral * controller.Ts) ** 2])
    # the cost of the closed loop, then the gain that is best against it: the same again
    cost = Q + controller.rho * np.outer(K, K)
    X, power = np.zeros((5, 5)), closed.copy()
    X = cost.copy()
    for _ in range(40):
        X, power = X + power.T @ X @ power, power @ power
    best = (b @ X @ A) / (controller.rho + b @ X @ b)
    np.testing.assert_allclose(K, best, rtol=1e-6, atol=1e-9)
    observer = A[:4, :4] - np.outer(A[:4, :4] @ np.array(numbers["L"]), [1.0, 0.0, 0.0, 0.0])
    assert np.abs(np.linalg.eigvals(observer)).max() < 1.0


def test_a_run_is_the_step_by_step_and_reaches_the_reference(
    model: Any, controller: StateFeedback
) -> None:
    ideal = replace(controller, counts_per_rev=None)
    r = np.full(3000, 1000.0)
    found = sewfast.run(ideal, model, r, noise=0.0)
    assert abs(found.y[-1] - 1000.0) < 1.0
    core, single = ideal.core(), ideal.core().single()
    u = [core.step(float(x), float(y)) for x, y in zip(found.r, found.y, strict=True)]
    np.testing.assert_array_equal(u, found.u)
    rough = [single.step(float(x), float(y)) for x, y in zip(found.r, found.y, strict=True)]
    np.testing.assert_allclose(rough, u, atol=0.02)
    # under a load that it does not see
    pushed = sewfast.run(ideal, model, r, disturbance=np.full(3000, -1.0))
    assert abs(pushed.y[-1] - 1000.0) < 1.0


def test_the_command_is_finite_and_within_limits_whatever_comes(
    controller: StateFeedback,
) -> None:
    rng = np.random.default_rng(0)
    odd = np.array([0.0, 1.0, -1e3, 1e308, -1e308, np.inf, -np.inf, np.nan])
    limited = replace(controller, slew=2e3)
    for core in (limited.core(), limited.core().single()):
        last = 0.0
        for r, y, added in rng.choice(odd, (5000, 3)):
            u = core.step(float(r), float(y), float(added))
            assert math.isfinite(u)
            assert abs(u) <= 20.0
            assert abs(u - last) <= 2.0 * (1 + 1e-6)
            last = u


def test_tuning_lowers_the_cost_and_repeats_to_the_bit(model: Any) -> None:
    options: dict[str, Any] = {**LIMITS, "counts_per_rev": ENCODER, "evaluations": 300, "seed": 3}
    one, two = (
        sewfast.tune(model, "trapezoid", controller="state_feedback", threads=threads, **options)
        for threads in (1, 2)
    )
    assert isinstance(one.controller, StateFeedback)
    assert one.controller == two.controller
    assert one.cost < 0.7 * one.start_cost
    assert tuple(v.name for v in one.variables) == VARIABLES
    again = costs(one.controller, model, "trapezoid")
    assert again[0] == pytest.approx(one.cost, rel=1e-9)
    with pytest.raises(SettingError) as error:
        _ = one.pid
    assert error.value.expected == "a PID (Controller)"


def test_a_nonlinear_model_is_linearised_in_the_middle_of_its_record(model: Any) -> None:
    data = sewfast.record(sewfast.VirtualMachine(), signals.excitation("multisine")).dataset()
    network = sewfast.identify(data, model="neural_oe", hidden=4, starts=1, seed=0)
    found = sewfast.tune(
        network, "trapezoid", controller="state_feedback", evaluations=20, **LIMITS
    )
    assert isinstance(found.start, StateFeedback)
    assert found.cost <= found.start_cost


def test_the_virtual_drive_runs_it_as_single_precision_does(controller: StateFeedback) -> None:
    r = np.full(400, 800.0)
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        assert drive.identity.capabilities & KINDS
        drive.set_limits()
        found = sewfast.run(controller, drive, r)
        counts = np.diff(found.recording.counts, prepend=0.0)
        feedback = counts * 60.0 / (ENCODER * 0.001)
        core = controller.core().single()
        u = [core.step(float(x), float(y)) for x, y in zip(r, feedback, strict=True)]
        # the device applies whole steps of a millivolt
        np.testing.assert_allclose(found.u, np.clip(u, -20.0, 20.0), atol=0.0011)
        assert found.y[-50:].mean() == pytest.approx(800.0, rel=0.02)
        pid = sewfast.run(sewfast.paper_controller(), drive, r)
        assert isinstance(pid.controller, sewfast.Controller)


def test_a_device_without_it_refuses_by_name(
    controller: StateFeedback, monkeypatch: pytest.MonkeyPatch
) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits()
        known = replace(drive.identity, capabilities=drive.identity.capabilities & ~KINDS)
        monkeypatch.setattr(type(drive), "identity", known)
        with pytest.raises(SettingError) as error:
            drive.set_controller(controller)
    assert error.value.name == "controller"
    assert "PID" in str(error.value.expected)


@pytest.mark.parametrize(
    "use",
    [
        lambda c, m: sewfast.margins(c, m),
        lambda c, m: analyse(c, m),
        lambda c, m: sewfast.pareto(m, "trapezoid", objectives=("tracking", "chatter"), start=c),
        lambda c, m: require_controller(c, m, "anything(controller)"),
        lambda c, m: sewfast.tune(m, "trapezoid", start=c, constraints=Constraints(Ms=1.6)),
        lambda c, m: sewfast.deploy(c, "nowhere"),
    ],
)
def test_what_knows_pids_only_refuses_it_by_name(
    controller: StateFeedback, model: Any, use: Callable[[Any, Any], object]
) -> None:
    with pytest.raises(SettingError) as error:
        use(controller, model)
    assert error.value.received == "StateFeedback"
    assert error.value.remedy


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"rho": 0.0}, "rho"),
        ({"noise": math.inf}, "noise"),
        ({"integral": -1.0}, "integral"),
        ({"u_min": 1.0, "u_max": 1.0}, "u_max"),
        ({"slew": 0.0}, "slew"),
        ({"num": (1.0, -1.0)}, "num"),
        ({"num": (1.0,) * 5}, "num"),
        ({"u_unit": None}, "u_unit"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(
    controller: StateFeedback, settings: dict[str, Any], name: str
) -> None:
    with pytest.raises(SettingError, match=name):
        replace(controller, **settings)


def test_a_plant_of_more_states_and_one_without_delay_are_refused() -> None:
    long = LinearOE.from_tf([0.0] * 5 + [1.0], [1.0, -0.9], 0.001)
    with pytest.raises(SettingError) as error:
        StateFeedback.from_model(long)
    assert error.value.name == "num"
    direct = LinearOE.from_tf([1.0], [1.0, -0.9], 0.001)
    with pytest.raises(SettingError, match="nk"):
        StateFeedback.from_model(direct)


def test_filter_and_kind_are_refused_where_they_do_not_fit(model: Any) -> None:
    with pytest.raises(SettingError) as error:
        sewfast.tune(model, controller="state_feedback", filter_samples=4)
    assert error.value.name == "filter_samples"
    with pytest.raises(SettingError) as error:
        sewfast.tune(model, controller="fuzzy")
    assert error.value.name == "controller"


def test_the_command_line_tunes_and_runs_it(model: Any, tmp_path: Path) -> None:
    model.save(tmp_path / "drive.json")
    done = program(
        tmp_path, "tune", "drive.json", "--controller", "state-feedback", "--u-min", "-20",
        "--u-max", "20", "--reference", "trapezoid", "--evaluations", "60", "-o", "states.json",
        "--json",
    )  # fmt: skip
    assert done.json()["controller"]["kind"] == "state_feedback"
    done = program(tmp_path, "run", "states.json", "--on", "virtual", "--json", "-o", "run.csv")
    assert done.json()["rmse"] < 200.0
    assert "PID" in refused(tmp_path, "analyse", "states.json", "drive.json")
    assert "--controller" in refused(
        tmp_path, "tune", "drive.json", "--start", "states.json", "--controller", "state-feedback",
        "-o", "other.json",
    )  # fmt: skip
