"""Joints: friction of other shapes, records that tell little, exports, replays in MuJoCo."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import sewfast
from sewfast import Dataset, motorfit, physics
from sewfast.cli import main
from sewfast.errors import SettingError
from sewfast.greybox import Joint

TS, SUBSTEPS, STEP = 0.005, 20, 2.0 * math.pi / 4096


def _rubbing(n: int, seed: int, *, creep: float = 0.0, share: float = 0.0) -> Dataset:
    """Angle of a joint with k_p / J = 400 1/s^2 behind its controller, friction .015 rad and .012
    more at rest, which falls with exp(-(w/.2)^2), gravity of .05 rad; `share` of the drive is
    friction besides, and friction holds with the time constant `creep`."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.9, 0.9, n // 100 + 1), 100)[:n]
    # slow moves and quick ones: only slow ones show what falls with speed
    u[: n // 2] = np.convolve(u, np.ones(100) / 100, "same")[: n // 2]
    y, q, w, h = np.zeros(n), u[0], 0.0, TS / SUBSTEPS
    for k in range(n * SUBSTEPS):
        if k % SUBSTEPS == 0:
            y[k // SUBSTEPS] = np.floor(q / STEP + 0.5) * STEP
        drive = u[max(k - 30, 0) // SUBSTEPS] - q - 0.06 * w
        free = w + 400.0 * h * (drive - 0.05 * np.sin(q))
        dry = 400.0 * h * (0.015 + 0.012 * math.exp(-((w / 0.2) ** 2)) + share * abs(drive))
        if abs(free) * h <= dry * (creep + h):
            w = free * creep / (creep + h)
        else:
            w = free - math.copysign(dry, free)
        q += h * w
    return Dataset.from_arrays(u, y, TS, input_units=("rad",), output_unit="rad")


@cache
def _joint() -> Joint:
    return physics(_rubbing(3000, 1, creep=2e-3), structure="joint")


@pytest.mark.slow("a fit with all terms")
def test_friction_that_falls_with_speed_and_creeps_is_found() -> None:
    joint = _joint()
    assert {"stribeck", "creep", "gravity"} <= set(joint.terms)
    for name, value in {"inertia": 1 / 400, "friction": 0.015, "gravity": 0.05}.items():
        assert joint.value(name) == pytest.approx(value, rel=0.05), name
    assert joint.value("stribeck") == pytest.approx(0.012, rel=0.2)
    assert joint.value("creep") == pytest.approx(2e-3, rel=0.3)
    fresh = _rubbing(2000, 11, creep=2e-3)
    assert joint.model.validate(fresh).simulation.rmse < 2.0 * STEP


@pytest.mark.slow("a fit with all terms")
def test_friction_per_drive_is_told_from_friction_per_load() -> None:
    joint = physics(_rubbing(3000, 2, share=0.15), structure="joint")
    assert {"loaded", "directional"} & set(joint.terms)
    of = joint.model.joint
    assert of["k_l"] + of["k_m"] == pytest.approx(0.15, abs=0.05)


def _geared(
    n: int, seed: int, *, rate: float = 1e9, gap: float = 0.0, wave: float = 0.0
) -> Dataset:
    """Angle of the load of a motor with k_p / J = 400 1/s^2 in all, of which the load has .3,
    behind a stiff contact with this gap; .01 rad of friction on either side, the setpoint's rate
    limited, cogging of this size nine times per turn."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.9, 0.9, n // 100 + 1), 100)[:n]
    u[: n // 2] = np.convolve(u, np.ones(60) / 60, "same")[: n // 2]
    share, h = 0.3, TS / SUBSTEPS
    own, load = h * 400.0 / (1.0 - share), h * 400.0 / share
    stiff = share / 400.0 * (2.0 * math.pi * 150.0) ** 2
    damping = 1.4 * math.sqrt(stiff * share / 400.0)
    y, r, q, w, p, v = np.zeros(n), u[0], u[0], 0.0, u[0], 0.0
    for k in range(n * SUBSTEPS):
        if k % SUBSTEPS == 0:
            y[k // SUBSTEPS] = np.floor(p / STEP + 0.5) * STEP
        r += min(max(u[max(k - 30, 0) // SUBSTEPS] - r, -rate * h), rate * h)
        off = q - p
        over = off - math.copysign(0.5 * gap, off) if abs(off) > 0.5 * gap else 0.0
        force = stiff * over + damping * (w - v) if over else 0.0
        force = force if force * over > 0.0 else 0.0
        free = w + own * (r - p - 0.06 * w - wave * math.cos(9.0 * q + 0.7) - force)
        w = math.copysign(max(abs(free) - own * 0.01, 0.0), free)
        free = v + load * force
        v = math.copysign(max(abs(free) - load * 0.01, 0.0), free)
        q, p = q + h * w, p + h * v
    return Dataset.from_arrays(u, y, TS, input_units=("rad",), output_unit="rad")


@pytest.mark.slow("fits with all terms")
@pytest.mark.parametrize(
    ("term", "drawn", "truth"),
    [
        ("rate", {"rate": 2.0}, {"rate": 2.0}),
        ("backlash", {"gap": 0.03}, {"backlash": 0.03}),
        ("cogging", {"wave": 0.01}, {"cogging": 0.01, "cogging_period": 2.0 * math.pi / 9.0}),
    ],
)
def test_rate_backlash_and_cogging_are_found_where_they_are(
    term: str, drawn: dict[str, float], truth: dict[str, float]
) -> None:
    joint = physics(_geared(3000, 1, **drawn), structure="joint")
    assert {"rate", "backlash", "cogging"} & set(joint.terms) == {term}
    for name, value in truth.items():
        assert joint.value(name) == pytest.approx(value, rel=0.05), name
    assert joint.value("stiffness") == pytest.approx(400.0, rel=0.05)
    assert term in " ".join(joint.to_model().describe())


def _driven(
    n: int, seed: int, size: float, hold: int, *, pull: float = 0.0, wave: float = 0.0
) -> Dataset:
    """Angle of a joint of .1 kg m^2 under levels of torque: .1 N m of friction, .1 N m s/rad, its
    weight, which hangs, and cogging 14 times per turn."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-size, size, n // hold + 1), hold)[:n]
    y, q, w, h = np.zeros(n), 0.0, 0.0, TS / 50
    for k in range(n * 50):
        if k % 50 == 0:
            y[k // 50] = np.floor(q / STEP + 0.5) * STEP
        load = pull * math.sin(q) + wave * math.cos(14.0 * q + 0.7)
        free = w + h / 0.1 * (u[k // 50] - load - 0.1 * w)
        w = math.copysign(max(abs(free) - h / 0.1 * 0.1, 0.0), free)
        q += h * w
    return Dataset.from_arrays(u, y, TS, input_units=("N m",), output_unit="rad")


@pytest.mark.slow("fits with all terms")
@pytest.mark.parametrize(
    ("term", "size", "hold", "drawn"),
    [
        ("gravity", 1.5, 200, {"pull": 3.0}),
        ("cogging", 0.5, 40, {"wave": 0.2}),
        ("", 0.4, 60, {}),
    ],
)  # fmt: skip
def test_forces_by_angle_without_which_a_joint_goes_elsewhere_are_found(
    term: str, size: float, hold: int, drawn: dict[str, float]
) -> None:
    joint = physics(_driven(3000, 2, size, hold, **drawn), structure="joint")
    assert {"gravity", "cogging"} & set(joint.terms) == {term} - {""}
    truth = {"inertia": 0.1, "friction": 0.1, "viscous": 0.1}
    truth |= dict(zip([term], drawn.values(), strict=False))
    for name, value in truth.items():
        assert joint.value(name) == pytest.approx(value, rel=0.02), name
    assert joint.fit_percent > 99.5


def test_a_step_after_a_standstill_has_no_inertia_of_nothing() -> None:
    u, q, w, h = np.r_[np.zeros(100), np.full(200, 3.0)], 0.0, 0.0, 1e-4
    y = np.zeros(300)
    for k in range(300):
        y[k] = q
        for _ in range(50):
            w += h * (u[k] - 0.4 * w) / 0.004
            q += h * w
    y = np.floor(y / STEP + 0.5) * STEP
    data = Dataset.from_arrays(u, y, TS, input_units=("V",), output_unit="rad")
    joint = physics(data, structure="joint")
    assert joint.fit_percent > 95.0
    assert joint.model.motor["k_a"] > 1e-5
    if "inertia" in joint.parameters:
        found = joint.parameters["inertia"]
        assert found.low <= 0.004 <= found.high


@pytest.mark.parametrize("per", [1.0, 4096 / (2.0 * math.pi), 1e-3])
def test_the_state_does_not_depend_on_the_unit_of_the_position(per: float) -> None:
    core = _joint().model.core
    e = _rubbing(60, 5).experiments[0]
    plain = core.estimate_initial_state(e.u, e.y)
    scaled = motorfit.joint.changed(core, unit=core.settings["unit"] / per)
    state = scaled.estimate_initial_state(e.u, per * e.y)
    np.testing.assert_allclose(state / [1.0, 1.0, 1.0, per], plain, rtol=1e-6, atol=1e-9)


def test_its_model_has_the_ranges_of_its_record() -> None:
    u = np.repeat(np.random.default_rng(4).uniform(-3.0, 3.0, 20), 60)
    r = sewfast.record(sewfast.VirtualMachine(3), u, name="steps")
    q = r.counts * 2.0 * np.pi / r.counts_per_rev
    data = Dataset.from_arrays(u, q, r.Ts, input_units=("V",), output_unit="rad")
    model = physics(data, structure="joint").to_model()
    assert model.training["input_range"] == [list(data.input_range[0])]
    assert model.training["output_range"] == list(data.output_range)


_FIRST = ("k_l", "k_q", "damping", "dead_band", "reach")


def test_a_file_from_before_the_terms_loads(tmp_path: Path) -> None:
    joint = physics(_rubbing(600, 3), structure="joint")
    joint.to_model().save(tmp_path / "m.json")
    document = json.loads((tmp_path / "m.json").read_text())
    later = [n for n in sewfast._core.GREYBOX_JOINT if n not in _FIRST]
    for name in later:
        value = document["parameters"]["joint"].pop(name)
        assert value == 0.0 or name in document["parameters"]["free"]
    document["parameters"]["free"] = [n for n in document["parameters"]["free"] if n not in later]
    document["parameters"]["theta"] = document["parameters"]["theta"][
        : len(document["parameters"]["free"])
    ]
    (tmp_path / "m.json").write_text(json.dumps(document))
    model: Any = sewfast.load_model(tmp_path / "m.json")
    assert model.joint["creep"] == 0.0


# --- exports --------------------------------------------------------------------------------------


def test_forces_of_an_export_are_those_of_a_known_inertia() -> None:
    joint = _joint()
    plain, known = (json.loads(joint.export("json", inertia=i)) for i in (None, 0.02))
    assert known["armature"] == pytest.approx(0.02)
    assert known["kp"] == pytest.approx(8.0, rel=0.05)
    assert plain["kp"] == pytest.approx(1.0)
    for name in ("friction_base", "friction_viscous", "gravity_sin"):
        assert known[name] == pytest.approx(known["kp"] * plain[name]), name
    assert (known["force_unit"], plain["force_unit"]) == ("N m", "units of k_p")
    dynamics = ElementTree.fromstring(joint.export("urdf", inertia=0.02)).attrib
    assert float(dynamics["friction"]) == pytest.approx(known["friction_base"], rel=1e-4)


@pytest.mark.parametrize("inertia", [0.0, -1.0, math.nan, math.inf])
def test_an_inertia_that_is_none_is_refused(inertia: float) -> None:
    with pytest.raises(SettingError, match="inertia"):
        _joint().export("urdf", inertia=inertia)


def test_another_target_is_refused() -> None:
    with pytest.raises(SettingError, match="mujoco, urdf, json"):
        _joint().export("odrive")  # type: ignore[arg-type]


def test_mujoco_goes_where_the_joint_goes() -> None:
    pytest.importorskip("mujoco")
    fresh = _rubbing(2000, 12, creep=2e-3)
    found = {i: _joint().check(fresh, inertia=i) for i in (None, 0.02)}
    for replay in found.values():
        assert 0.0 < replay.of_model < 0.02 * replay.span
        assert 0.0 < replay.of_record < 0.02 * replay.span
        assert "falls with speed" in str(replay)
    assert found[None].of_model == pytest.approx(found[0.02].of_model, rel=0.05)


def test_mujoco_goes_where_a_driven_joint_goes() -> None:
    pytest.importorskip("mujoco")
    u = np.repeat(np.random.default_rng(1).uniform(-3.0, 3.0, 20), 60)
    r = sewfast.record(sewfast.VirtualMachine(3), u, name="steps")
    q = r.counts * 2.0 * np.pi / r.counts_per_rev
    data = Dataset.from_arrays(u, q, r.Ts, input_units=("V",), output_unit="rad")
    replay = physics(data, structure="joint").check(data)
    assert replay.of_model < 0.05 * replay.span


def test_the_command_line_exports_and_checks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    e = _rubbing(1500, 4).experiments[0]
    rows = ["t,u [rad],q [rad]"]
    rows += [f"{k * TS:.3f},{u},{y}" for k, (u, y) in enumerate(zip(e.u[:, 0], e.y, strict=True))]
    (tmp_path / "moves.csv").write_text("\n".join(rows))
    place = tmp_path / "joint.xml"
    given = ["physics", str(tmp_path / "moves.csv"), "--structure", "joint"]
    assert main([*given, "--export", "mujoco", str(place), "--check", "mujoco"]) == 0
    shown = capsys.readouterr().out
    assert "of the span" in shown
    assert "<actuator>" in place.read_text()
    assert main(["physics", str(tmp_path / "moves.csv"), "--inertia", "0.02"]) == 2
