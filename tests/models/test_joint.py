"""Joints: parameters from positions, with and without a controller inside; choice, files, loops."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast import Dataset, motorfit, physics
from sewfast.errors import DataError, FitError, ModelFileError, SettingError
from sewfast.greybox import Joint, load_joint
from sewfast.models.grey_box import GreyBox

TS, SUBSTEPS, STEP = 0.01, 20, 2.0 * math.pi / 4096


def _levels(n: int, seed: int, size: float, hold: int) -> Any:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-size, size, n // hold + 1), hold)[:n]


def _servo(n: int, seed: int, *, reach: float = 9.0, u: Any = None) -> Dataset:
    """Angle in 12-bit steps of a joint with k_p / J = 400 1/s^2 behind its controller: friction .02
    rad, gravity .06 rad, late by 15 ms; all in units of the position error."""
    u = _levels(n, seed, 0.9, 60) if u is None else u
    y, q, w, h = np.zeros(n), 0.0, 0.0, TS / SUBSTEPS
    for k in range(n * SUBSTEPS):
        if k % SUBSTEPS == 0:
            y[k // SUBSTEPS] = np.floor(q / STEP + 0.5) * STEP
        due = u[max(k - 30, 0) // SUBSTEPS] if k >= 30 else u[0]
        drive = np.clip(due - q - 0.02 * w, -reach, reach) - 0.05 * w
        free = w + 400.0 * h * (drive - 0.06 * np.sin(q + 0.4))
        w = np.sign(free) * max(abs(free) - 400.0 * h * 0.02, 0.0)
        q += h * w
    return Dataset.from_arrays(u, y, TS, input_units=("rad",), output_unit="rad")


def _axis(n: int, seed: int, noise: float = 2e-5, unit: str = "m") -> Dataset:
    """Position of a carriage of 2 N s^2/m with 3 N s/m, .8 N of friction and -.1 N, under a force
    that a controller computes from it."""
    rng, r = np.random.default_rng(seed), _levels(n, seed, 0.2, 120)
    u, y, q, w, h = np.zeros(n), np.zeros(n), 0.0, 0.0, TS / SUBSTEPS
    for k in range(n):
        y[k] = q
        u[k] = np.clip(40.0 * (r[k] - q) - 10.0 * w, -6.0, 6.0)
        for _ in range(SUBSTEPS):
            free = w + h / 2.0 * (u[k] - 3.0 * w + 0.1)
            w = np.sign(free) * max(abs(free) - h / 2.0 * 0.8, 0.0)
            q += h * w
    return Dataset.from_arrays(u, y + noise * rng.normal(size=n), TS, output_unit=unit)


@cache
def _joint(kind: str) -> Joint:
    return physics(_servo(1500, 1) if kind == "servo" else _axis(1500, 1), structure="joint")


def test_command_and_encoder_tell_what_a_servo_does_with_its_gain_as_the_unit() -> None:
    joint = _joint("servo")
    assert joint.inside
    assert "gravity" in joint.terms
    truth = {
        "inertia": 1 / 400, "viscous": 0.07, "friction": 0.02, "gravity": 0.06, "delay": 0.015,
        "stiffness": 400.0,
    }  # fmt: skip
    for name, value in truth.items():
        assert joint.value(name) == pytest.approx(value, rel=0.05, abs=2e-4), name
    assert {"k_p", "inertia_kg_m2"} <= set(joint.undetermined)
    assert "reach" in joint.undetermined  # it never reached its limit
    with pytest.raises(DataError, match="known inertia"):
        joint.value("k_p")
    assert "not determined: k_p" in str(joint)
    assert "controller inside" in str(joint)


def test_a_force_and_a_position_tell_inertia_and_friction() -> None:
    joint = _joint("axis")
    assert not joint.inside
    for name, value in {"inertia": 2.0, "viscous": 3.0, "friction": 0.8, "offset": -0.1}.items():
        found = joint.parameters[name]
        assert found.value == pytest.approx(value, rel=0.05), name
    assert "gravity" not in joint.parameters  # a carriage has no angle


def test_a_limit_that_is_reached_is_found() -> None:
    joint = physics(_servo(1500, 2, reach=0.3), structure="joint")
    assert joint.value("reach") == pytest.approx(0.3, rel=0.05)
    gains = joint.inner_gains(5.0)
    assert gains.reach == pytest.approx(0.3 / gains.kp_factor, rel=0.05)
    assert "at its limit from an error" in str(gains)


def test_damping_is_a_time_whatever_the_unit_of_the_angles() -> None:
    e = _servo(1500, 2, reach=0.3).experiments[0]
    turned = np.degrees(e.u[:, 0]), np.degrees(e.y)
    data = Dataset.from_arrays(*turned, TS, input_units=("deg",), output_unit="deg")
    assert physics(data, structure="joint").value("damping") == pytest.approx(0.02, rel=0.2)


def test_slow_moves_give_a_joint_that_quick_ones_do_not_throw_off() -> None:
    n = 500
    slow = 0.9 * np.sin(2.0 * math.pi * 0.15 * TS * np.arange(n))
    joint = physics(_servo(n, 4, u=slow))
    assert joint.inside
    quick = _servo(500, 5)
    e = quick.experiments[0]
    core = joint.to_model().core
    run = core.simulate(e.u, core.estimate_initial_state(e.u[:20], e.y[:20]))
    assert np.sqrt(np.mean((run - e.y) ** 2)) < 0.3 * np.std(e.y)


def test_counts_do_not_say_what_a_simulator_needs() -> None:
    model = replace(_joint("servo").model, output_unit="counts")
    with pytest.raises(SettingError, match="turns or slides"):
        replace(_joint("servo"), model=model).export("mujoco")


def test_gains_of_the_controller_inside_for_a_bandwidth() -> None:
    gains = _joint("servo").inner_gains(5.0, damping_ratio=0.8)
    # k_p / J = 400 1/s^2 and .07 s of damping with the gain that was recorded
    w = 2.0 * math.pi * 5.0
    assert gains.kp_factor == pytest.approx(w * w / 400.0, rel=0.05)
    assert gains.kd_change == pytest.approx(2.0 * 0.8 * w / 400.0 - 0.07, abs=0.005)
    assert gains.stick == pytest.approx(0.02 / gains.kp_factor, rel=0.05)
    assert gains.sag == pytest.approx(0.06 / gains.kp_factor, rel=0.1)
    s = 2j * math.pi * np.geomspace(0.1, 100.0, 20_000)
    loop = (w * w + 1.6 * w * s) / s**2
    at = np.argmin(np.abs(np.abs(loop) - 1.0))
    assert gains.phase_margin == pytest.approx(180.0 + np.degrees(np.angle(loop[at])), abs=0.1)
    turned = math.radians(gains.phase_margin) / s[at].imag
    assert gains.delay_margin == pytest.approx(turned, rel=0.01)
    assert "kp times 2.4" in str(gains)
    with pytest.raises(SettingError, match="command that drives the joint"):
        _joint("axis").inner_gains(5.0)
    with pytest.raises(SettingError, match="from 1e-06"):
        _joint("servo").inner_gains(0.0)


@pytest.mark.parametrize("kind", ["servo", "axis"])
def test_a_joint_goes_freely_where_it_was_not_recorded(kind: str) -> None:
    model = _joint(kind).to_model()
    fresh = _servo(1000, 31) if kind == "servo" else _axis(1000, 31, noise=0.0)
    (e,), spread = fresh.experiments, np.std(fresh.experiments[0].y)
    assert model.validate(fresh).simulation.rmse < 0.02 * spread
    assert model.validate(fresh).one_step.rmse < 0.01 * spread
    assert model.core.states(e.u, model.core.rest_state()).shape == (len(e), 4)
    assert model.state_names[-1] == "position"


def test_its_files_come_back(tmp_path: Path) -> None:
    joint = _joint("servo")
    joint.save(tmp_path / "j.json")
    again = load_joint(tmp_path / "j.json")
    assert str(again) == str(joint)
    joint.to_model().save(tmp_path / "m.json")
    model: Any = sewfast.load_model(tmp_path / "m.json")
    u = _levels(300, 5, 0.5, 50)
    np.testing.assert_array_equal(model.simulate(u), joint.model.simulate(u))
    assert model.joint == joint.model.joint
    document = json.loads((tmp_path / "m.json").read_text())
    document["parameters"]["joint"].pop("k_q")
    (tmp_path / "m.json").write_text(json.dumps(document))
    with pytest.raises(ModelFileError, match="k_q"):
        sewfast.load_model(tmp_path / "m.json")


def test_a_loop_is_closed_and_tuned_around_it() -> None:
    model = _joint("axis").to_model()
    gains = sewfast.Gains("standard", 80.0, 20.0, 0.3, u_unit="", y_unit="m")
    controller = sewfast.Controller(gains, TS, u_min=-6.0, u_max=6.0)
    run = sewfast.run(controller, model, np.repeat([0.0, 0.1, -0.1], 300))
    assert abs(run.y[599] - 0.1) < 0.02
    assert abs(run.y[-1] + 0.1) < 0.02
    with pytest.raises(SettingError, match="microcontrollers"):
        model.core.embedded()


def test_it_is_a_candidate_where_the_output_is_a_position() -> None:
    model: Any = sewfast.identify(_servo(1200, 3), model="grey_box", select=False)
    assert isinstance(model, GreyBox)
    assert model.joint["k_q"] == 1.0
    assert "joint with a controller of its own" in str(model)


@pytest.mark.nightly("a default search")
def test_the_equations_of_a_joint_win_where_they_hold() -> None:
    """Also without a unit, where the linear models or the record show the integrator."""
    data = _axis(2500, 6, unit="")
    model = sewfast.identify(data)
    fresh = _axis(1000, 41, noise=0.0, unit="")
    assert model.validate(fresh).simulation.rmse < 0.02 * np.std(fresh.experiments[0].y)
    for member in model.members or (model,):
        assert member.core.settings["integrator"]


@cache
def _recorded() -> tuple[Any, Any, float]:
    """Command [V], angle [rad] and sample time of a machine."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-3.0, 3.0, 20), 60)
    r = sewfast.record(sewfast.VirtualMachine(3), u, name="steps")
    return u, r.counts * 2.0 * np.pi / r.counts_per_rev, r.Ts


def _of_machine(unit: str = "rad", scale: float = 1.0, **more: Any) -> Dataset:
    u, q, Ts = _recorded()
    return Dataset.from_arrays(
        u, more.pop("q", q) * scale, Ts, input_units=("V",), output_unit=unit, **more
    )


def test_intervals_are_those_at_the_fitted_states_of_the_pieces() -> None:
    data = _of_machine()
    fit = motorfit.joint._Fit(data, lambda: None)
    found = fit.descended(fit.started(True))
    cost = motorfit.joint.squares(found.core, fit.pieces, found.states)
    assert cost == pytest.approx(found.cost, rel=1e-9)
    # at states from the first outputs alone, the errors were 9 times as large
    inertia = physics(data, structure="joint").parameters["inertia"]
    assert inertia.high - inertia.low < 0.1 * inertia.value


@pytest.mark.parametrize("unit", ["rad", "deg", "mrad", "rev"])
def test_the_unit_of_an_angle_changes_the_unit_of_the_result_alone(unit: str) -> None:
    plain = physics(_of_machine(), structure="joint")
    scale = {"rad": 1.0, "deg": 180.0 / math.pi, "mrad": 1e3, "rev": 0.5 / math.pi}[unit]
    joint = physics(_of_machine(unit, scale), structure="joint")
    assert joint.terms == plain.terms
    assert joint.rmse == pytest.approx(scale * plain.rmse, rel=1e-6)
    assert joint.parameters.keys() == plain.parameters.keys()
    for name, one in plain.parameters.items():
        per = {"inertia": scale, "viscous": scale, "cogging_period": 1.0 / scale}.get(name, 1.0)
        found = joint.parameters[name]
        for a, b in ((found.value, one.value), (found.low, one.low), (found.high, one.high)):
            assert per * a == pytest.approx(b, rel=1e-4, abs=1e-6), name


def test_the_unit_of_a_length_changes_the_unit_of_the_result_alone() -> None:
    e, plain = _axis(1500, 1).experiments[0], _joint("axis")
    data = Dataset.from_arrays(e.u, 1e3 * e.y, TS, output_unit="mm")
    joint = physics(data, structure="joint")
    assert joint.terms == plain.terms
    assert 1e3 * joint.value("inertia") == pytest.approx(plain.value("inertia"), rel=1e-6)


def test_an_interval_holds_its_value_and_is_none_without_information() -> None:
    u, q, Ts = _recorded()
    # two holds: friction and offset show as a sum alone, which had an interval of no width
    few = Dataset.from_arrays(u[:120], q[:120], Ts, input_units=("V",), output_unit="rad")
    joint = physics(few, structure="joint")
    assert {"friction", "offset"} <= set(joint.undetermined)
    for p in (*joint.parameters.values(), *_joint("servo").parameters.values()):
        assert p.low <= p.value <= p.high
        assert p.low < p.high
    with pytest.raises(DataError, match="constant"):
        physics(Dataset.from_arrays(0.0 * u + 2.0, q, Ts, output_unit="rad"), structure="joint")


def test_a_bump_of_friction_may_be_a_dip(monkeypatch: pytest.MonkeyPatch) -> None:
    data, of = _of_machine(), motorfit.joint.fitted

    def dipped(*given: Any, **named: Any) -> Any:
        fit = of(*given, **named)
        core, n = fit.core, len(fit.core.theta)
        places = [motorfit.joint.PLACES[name] for name in ("k_t", "w_s")]
        core = motorfit.joint.changed(
            core, free=[*core.settings["free"], *places], theta=np.array([*core.theta, -0.2, 1.0])
        )
        return replace(
            fit, core=core, terms=("stribeck",), covariance=1e-6 * np.eye(n + 2),
            determined=np.ones(n + 2, bool),
        )  # fmt: skip

    monkeypatch.setattr("sewfast.greybox.joint.fitted", dipped)
    bump = physics(data, structure="joint").parameters["stribeck"]
    assert bump.low < bump.value < bump.high < 0.0


@pytest.mark.parametrize("gap", ["long", "fifths", "many", "start"])
def test_gaps_in_the_positions_are_left_out(gap: str) -> None:
    q = _recorded()[1].copy()
    at = np.arange(len(q))
    missing = {
        "long": (at >= 300) & (at < 420), "fifths": at % 5 == 0, "many": at % 40 < 4,
        "start": at < 100,
    }[gap]  # fmt: skip
    q[missing] = np.nan
    plain, joint = (physics(d, structure="joint") for d in (_of_machine(), _of_machine(q=q)))
    assert joint.samples == np.sum(~missing)
    assert joint.fit_percent > 99.0
    assert joint.value("inertia") == pytest.approx(plain.value("inertia"), rel=0.1)


def test_a_record_of_gaps_alone_is_refused_as_one() -> None:
    q = np.where(np.arange(len(_recorded()[1])) % 100, math.nan, _recorded()[1])
    with pytest.raises(DataError, match="fewer gaps"):
        physics(_of_machine(q=q), structure="joint")


def test_only_ratios_of_weights_count() -> None:
    q, ones = _recorded()[1], np.ones(len(_recorded()[1]))
    plain = physics(_of_machine(), structure="joint")
    for weight in (4.0, 0.01):
        joint = physics(_of_machine(weights=weight * ones), structure="joint")
        assert joint.rmse == pytest.approx(plain.rmse, rel=1e-9)
        assert joint.fit_percent == pytest.approx(plain.fit_percent, rel=1e-9)
    some = np.where(np.arange(len(q)) % 2, 0.25, 1.0)
    data = _of_machine(weights=some)
    fit = motorfit.joint._Fit(data, lambda: None)
    found = fit.descended(fit.started(True))
    variance = found.core.settings["residual_variance"]
    assert variance == pytest.approx(found.cost / some.sum(), rel=1e-9)
    # a sample of weight 0 counts as not measured
    joint = physics(
        _of_machine(weights=np.where(np.arange(len(q)) % 5, 1.0, 0.0)), structure="joint"
    )
    assert joint.samples == np.sum(np.arange(len(q)) % 5 > 0)


@pytest.mark.parametrize(
    "units", [("°", "deg"), ("deg", "°"), ("turn", "rev"), ("deg", "rad"), ("rad", "mrad")]
)
def test_a_command_and_an_output_may_have_other_units_or_spellings(units: tuple[str, str]) -> None:
    plain, (given, of) = _joint("servo"), units
    e = _servo(1500, 1).experiments[0]
    per = {"rad": 1.0, "mrad": 1e3, "rev": 0.5 / math.pi, "turn": 0.5 / math.pi}
    a, b = (per.get(unit, 180.0 / math.pi) for unit in units)
    data = Dataset.from_arrays(a * e.u[:, 0], b * e.y, TS, input_units=(given,), output_unit=of)
    joint = physics(data, structure="joint")
    assert joint.inside
    assert joint.terms == plain.terms
    for name, scale in {"stiffness": 1.0, "friction": a, "inertia": a / b}.items():
        assert joint.value(name) == pytest.approx(scale * plain.value(name), rel=1e-4), name
    assert joint.inner_gains(5.0).kp_factor == pytest.approx(
        plain.inner_gains(5.0).kp_factor, rel=1e-4
    )


def test_a_length_does_not_command_an_angle() -> None:
    e = _servo(300, 1).experiments[0]
    for given, of, inside in (("mm", "deg", False), ("mm", "m", True), ("V", "V", False)):
        data = Dataset.from_arrays(e.u, e.y, TS, input_units=(given,), output_unit=of)
        assert motorfit.joint.is_commanded(data) is inside


def test_a_position_that_does_not_follow_its_command_is_refused_by_its_cause() -> None:
    e = _servo(600, 3).experiments[0]

    def refused(u: Any, y: Any) -> str:
        data = Dataset.from_arrays(u, y, TS, input_units=("rad",), output_unit="rad")
        with pytest.raises(DataError) as caught:
            physics(data, structure="joint")
        return str(caught.value)

    assert "degrees" in refused(e.u[:, 0], np.degrees(e.y))
    assert "degrees" in refused(np.degrees(e.u[:, 0]), e.y)
    assert "gear" in refused(e.u[:, 0], 50.0 * e.y)
    assert "at a stop at 0.2 rad" in refused(e.u[:, 0], np.minimum(e.y, 0.2))
    assert "at a stop at -0.1 rad" in refused(e.u[:, 0], np.maximum(e.y, -0.1))
    assert "one that goes the other way; turn the sign" in refused(-e.u[:, 0], e.y)


def test_a_force_of_the_other_sign_is_refused() -> None:
    e = _axis(600, 2).experiments[0]
    data = Dataset.from_arrays(e.u[:, 0], -e.y, TS, input_units=("N",), output_unit="m")
    with pytest.raises((DataError, FitError), match="sign"):
        physics(data, structure="joint")


def test_what_is_no_joint_is_refused() -> None:
    e = _axis(300, 3).experiments[0]
    with pytest.raises(SettingError, match="output_unit"):
        physics(Dataset.from_arrays(e.u, e.y, TS, output_unit="rpm"), structure="joint")
    with pytest.raises(SettingError, match="current"):
        physics(_axis(300, 3), structure="joint", current="i")  # type: ignore[call-overload]
    two = Dataset.from_arrays(np.c_[e.u, e.u**2], e.y, TS, output_unit="m")
    with pytest.raises(DataError, match="inputs"):
        physics(two, structure="joint")
