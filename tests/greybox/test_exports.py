"""Settings of boards: amplitudes along q against a DC motor's constants, and what is not known."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_physics import steps

import sewfast
from sewfast import Motor, physics
from sewfast.cli import main
from sewfast.errors import DataError, SettingError
from sewfast.frequency.shaft import Parameter
from sewfast.greybox.motor import NAMES

POLE_PAIRS = 7
R, L, FLUX = 0.4, 2e-4, 0.006
"""Of a phase [ohm], [H]; amplitude of its back-EMF per speed [V s/rad]."""
INERTIA, DRY, VISCOUS = 8e-5, 0.01, 2e-5


def three_phases(seconds: float = 8.0) -> tuple[np.ndarray, ...]:
    """Voltage and current along q, and speed, of a motor computed in its three phases.

    The torque is the power of the three back-EMFs over the speed, without a factor from a book.
    """
    Ts, fine = 0.001, 10
    u = steps(seconds, Ts, 3, 6.0)
    amplitude, w, angle = 0.0, 0.0, 0.0
    speed, current = np.empty(len(u)), np.empty(len(u))
    phases = np.array([0.0, -2.0, 2.0]) * math.pi / 3
    h = Ts / fine
    for k, q in enumerate(u):
        speed[k], current[k] = w, amplitude
        for _ in range(fine):
            back = FLUX * np.cos(POLE_PAIRS * angle + phases)
            # the current loop holds d at nothing: every phase's current is in step with its EMF
            goal = (q - FLUX * w) / R
            amplitude = goal + math.exp(-h * R / L) * (amplitude - goal)
            i = amplitude * np.cos(POLE_PAIRS * angle + phases)
            free = w + h * (float(back @ i) - VISCOUS * w) / INERTIA
            w = math.copysign(max(abs(free) - h * DRY / INERTIA, 0.0), free)
            angle += h * w
    return u, speed, current


@pytest.fixture(scope="module")
def along_q() -> Motor:
    u, w, i = three_phases()
    data = sewfast.Dataset.from_arrays(u, w, 0.001, output_unit="rad/s")
    terms = ["lag", "coulomb"]
    return physics(data, current=i, volts=1.0, structure=terms)


def between_lines() -> Motor:
    """The same motor as DC motor: two phases in series."""
    u, w, i = three_phases()
    # of equal power at equal torque: V I = 3/2 v i, with the back-EMF's amplitude between lines
    line, amps = math.sqrt(3.0) * u, math.sqrt(3.0) / 2.0 * i
    data = sewfast.Dataset.from_arrays(line, w, 0.001, output_unit="rad/s")
    return physics(data, current=amps, volts=1.0, structure=["lag", "coulomb"])


def numbers(text: str) -> dict[str, float]:
    """Settings by the last part of their name."""
    found = re.findall(r"^(?:conf set )?[\w.]*?(\w+)(?: = | )(-?[\d.e+-]+)", text, re.MULTILINE)
    return {name: float(value) for name, value in found}


def test_a_board_gets_the_phase_of_the_motor(along_q: Motor) -> None:
    KV = 30 / math.pi / (math.sqrt(3) * FLUX)
    odrive = numbers(along_q.export("odrive", winding="q"))
    assert odrive["torque_constant"] == pytest.approx(1.5 * FLUX, rel=0.01)
    assert odrive["torque_constant"] == pytest.approx(8.27 / KV, rel=0.01)
    assert odrive["phase_resistance"] == pytest.approx(R, rel=0.02)
    assert odrive["phase_inductance"] == pytest.approx(L, rel=0.1)
    assert odrive["inertia"] == pytest.approx(2 * math.pi * INERTIA, rel=0.02)
    moteus = numbers(along_q.export("moteus", winding="q"))
    assert moteus["Kv"] == pytest.approx(KV, rel=0.01)
    assert moteus["resistance_ohm"] == odrive["phase_resistance"]
    assert moteus["inertia_feedforward"] == odrive["inertia"]
    simplefoc = numbers(along_q.export("simplefoc", winding="q"))
    assert simplefoc["KV_rating"] == pytest.approx(KV, rel=0.01)
    assert simplefoc["phase_inductance"] == odrive["phase_inductance"]


def test_two_terminals_are_two_phases_in_series(along_q: Motor) -> None:
    line = between_lines()
    assert line.value("inertia") == pytest.approx(INERTIA, rel=0.02)
    assert line.value("resistance_ohm") == pytest.approx(2 * R, rel=0.02)
    one, other = (
        numbers(m.export("odrive", winding=w)) for m, w in ((line, "line"), (along_q, "q"))
    )
    assert one == pytest.approx(other, rel=0.01)


def test_torques_along_q_are_half_as_large_again(along_q: Motor) -> None:
    assert along_q.value("inertia") == pytest.approx(INERTIA / 1.5, rel=0.02)
    joint = along_q.export("mujoco", winding="q")
    armature = float(joint.split('armature="')[1].split('"')[0])
    assert armature == pytest.approx(INERTIA, rel=0.02)
    damping, friction = re.findall(r'="([^"]+)"', along_q.export("urdf", winding="q"))
    assert float(damping) == pytest.approx(VISCOUS, rel=0.1)
    assert float(friction) == pytest.approx(DRY, rel=0.05)


@pytest.mark.parametrize("target", ["odrive", "moteus", "simplefoc"])
def test_what_a_record_cannot_tell_is_named_and_not_invented(along_q: Motor, target: Any) -> None:
    text = along_q.export(target, winding="q")
    assert "not known from a record" in text
    assert "pole" in text.splitlines()[-1]
    assert "3/2" in text.splitlines()[0]
    with pytest.raises(SettingError) as caught:
        along_q.export(target)
    assert caught.value.name == "winding"
    with pytest.raises(SettingError):
        along_q.export(target, winding="star")  # type: ignore[arg-type]


def test_a_motor_without_a_current_has_no_settings() -> None:
    u, w, _ = three_phases(4.0)
    motor = physics(
        sewfast.Dataset.from_arrays(u, w, 0.001, output_unit="rad/s"), structure=["coulomb"]
    )
    with pytest.raises(DataError, match="pass current"):
        motor.export("odrive", winding="q")


def test_a_motor_without_a_lag_has_no_inductance(along_q: Motor) -> None:
    parameters = {n: p for n, p in along_q.parameters.items() if n != "inductance"}
    text = replace(along_q, parameters=parameters).export("simplefoc", winding="q")
    assert "phase_inductance" not in text
    assert "the inductance" in text


def test_on_the_command_line_a_board_asks_for_the_winding(
    tmp_path: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    u, w, i = three_phases(4.0)
    table = np.stack([u, w, i], axis=1)
    header = "volts,speed,amps"
    np.savetxt("log.csv", table, delimiter=",", header=header, comments="")
    words = ["physics", "log.csv", "--input", "volts", "--output", "speed", "--Ts", "0.001"]
    words += ["--speed-unit", "rad/s", "--current", "amps", "--volts", "1"]
    words += ["--structure", "lag,coulomb", "--export", "moteus", "moteus.cfg"]
    assert main(words) != 0
    assert "--winding" in capsys.readouterr().err
    assert main([*words, "--winding", "q"]) == 0
    assert "conf set motor.Kv" in (tmp_path / "moteus.cfg").read_text()
    assert main([*words, "--winding", "q", "--gear", "10"]) != 0
    assert "gear" in capsys.readouterr().err
    words[words.index("moteus") :] = ["wpilib", "gains.json", "--json"]
    assert main([*words, "--gear", "10"]) == 0
    k_v = json.loads(capsys.readouterr().out)["parameters"]["k_v"]["value"]
    gains = json.loads(Path("gains.json").read_text())["feedforward"]
    assert gains["kV"] == pytest.approx(10 * k_v)


# --- Behind a gear, under gravity -----------------------------------------------------------------


def test_a_joint_behind_a_gear_has_its_square_of_the_inertia(along_q: Motor) -> None:
    alone, geared = (
        dict(re.findall(r'(\w+)="([^"]+)"', along_q.export("mujoco", winding="q", gear=g)))
        for g in (1.0, 50.0)
    )
    assert float(geared["armature"]) == pytest.approx(2500 * float(alone["armature"]), rel=1e-4)
    assert float(geared["damping"]) == pytest.approx(2500 * float(alone["damping"]), rel=1e-4)
    assert float(geared["frictionloss"]) == pytest.approx(
        50 * float(alone["frictionloss"]), rel=1e-4
    )
    assert float(geared["gear"]) == 50.0
    assert "gear" not in alone
    assert geared["gainprm"] == alone["gainprm"]  # MuJoCo has the actuator before its gear
    urdf = dict(re.findall(r'(\w+)="([^"]+)"', along_q.export("urdf", winding="q", gear=50.0)))
    assert float(urdf["friction"]) == pytest.approx(float(geared["frictionloss"]), rel=1e-4)


def test_mujoco_moves_a_geared_joint_as_the_motor(along_q: Motor) -> None:
    mujoco = pytest.importorskip("mujoco")
    speeds = []
    for gear in (1.0, 20.0):
        joint, actuator = along_q.export("mujoco", winding="q", gear=gear).splitlines()
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="0.0002" integrator="RK4" gravity="0 0 0"/><worldbody>
            <body>{joint.replace("<joint", '<joint name="j"')}
            <inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/></body></worldbody>
            <actuator>{actuator.replace("<general", '<general joint="j"')}</actuator></mujoco>"""
        )
        data = mujoco.MjData(model)
        data.ctrl[0] = 4.0
        mujoco.mj_step(model, data, 300)
        speeds.append(gear * data.qvel[0])
    assert speeds[0] > 1.0
    assert speeds[1] == pytest.approx(speeds[0], rel=0.01)


def test_gravity_has_gains_of_its_own(along_q: Motor) -> None:
    theta = along_q.theta.copy()
    theta[[NAMES.index(n) for n in ("offset", "load_1c", "load_1s")]] = 0.4, 0.3, -0.4
    interval = {"offset": Parameter(0.4, 0.3, 0.5, "V"), "load_1": Parameter(0.5, 0.4, 0.6, "V")}
    arm = replace(along_q, theta=theta, parameters={**along_q.parameters, **interval})
    gains = json.loads(arm.export("wpilib"))["feedforward"]
    assert gains["kG"] == 0.4
    assert gains["kG_cos"] == 0.5
    assert gains["horizontal"] == pytest.approx(math.atan2(-0.4, 0.3))
    # where the arm is horizontal the load is all that it can be, and the map has it there
    assert arm.turn_load([gains["horizontal"]])[0] == pytest.approx(0.5)
    geared = json.loads(arm.export("wpilib", gear=10.0))["feedforward"]
    assert geared["kV"] == pytest.approx(10 * gains["kV"])
    assert geared["kA"] == pytest.approx(10 * gains["kA"])
    assert geared["kS"] == gains["kS"]
    assert "kG_cos" not in geared  # once per turn of the motor is not once per turn of the arm
    plain = json.loads(along_q.export("wpilib"))["feedforward"]
    assert "kG" not in plain


@pytest.mark.parametrize("gear", [0.0, -2.0, math.nan, math.inf, "ten"])
def test_a_gear_is_a_number_above_0(along_q: Motor, gear: Any) -> None:
    with pytest.raises(SettingError) as caught:
        along_q.export("urdf", winding="q", gear=gear)
    assert caught.value.name == "gear"


def test_a_board_has_no_gear(along_q: Motor) -> None:
    with pytest.raises(SettingError) as caught:
        along_q.export("odrive", winding="q", gear=10.0)
    assert caught.value.name == "gear"
