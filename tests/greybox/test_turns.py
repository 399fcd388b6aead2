"""What varies over the turn, the supply, the encoder: found where it is, and nowhere else."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast import Motor, VirtualMachine, load_motor, physics
from sewfast.cli import main
from sewfast.errors import ModelFileError, SettingError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benches"))
from physics import recorded, steps, truths, turning

SEED = 1
"""Of a motor with two orders of cogging, a ripple, a sagging supply, an encoder out of true."""


@pytest.fixture(scope="module")
def case() -> tuple[sewfast.Recording, dict[str, float], np.ndarray]:
    return turning([SEED], 0, 20.0)[0]


@pytest.fixture(scope="module")
def motor(case: Any) -> Motor:
    return physics(case[0])


def loads(names: Any) -> set[str]:
    return {n for n in names if n.startswith("load_")} - {"load_1", "load_2"}


def test_cogging_and_ripple_are_found_with_their_orders(case: Any, motor: Motor) -> None:
    truth = case[1]
    assert loads(motor.parameters) == loads(truth)
    for name in loads(truth):
        assert motor.value(name) == pytest.approx(truth[name], rel=0.1)
    assert motor.value("torque_ripple") == pytest.approx(truth["torque_ripple"], rel=0.2)
    assert motor.value("k_a") == pytest.approx(truth["k_a"], rel=0.02)


def test_supply_and_encoder_are_told_from_the_motor(case: Any, motor: Motor) -> None:
    for name, bound in (("sag", 0.1), ("eccentricity", 0.05), ("stribeck_difference", 0.2)):
        assert motor.value(name) == pytest.approx(case[1][name], rel=bound), name
    without = physics(case[0], structure=["lag", "delay", "coulomb", "offset", "stribeck"])
    assert abs(without.value("k_v") / case[1]["k_v"] - 1) > 0.02  # the sag bends it
    assert motor.value("k_v") == pytest.approx(case[1]["k_v"], rel=0.01)


def test_an_even_motor_has_none_of_it() -> None:
    recording, truth, _ = turning([3], 0, 20.0)[0]
    motor = physics(recording)
    assert not loads(motor.parameters)
    assert not {"torque_ripple", "sag", "eccentricity"} & set(motor.parameters)
    assert "stands out" in motor.undetermined["cogging"]
    assert motor.value("k_v") == pytest.approx(truth["k_v"], rel=0.01)


def test_what_is_fed_forward_takes_the_ripple_out_of_a_slow_loop(motor: Motor) -> None:
    """At 60 rpm the motor's own loads over the turn, held against by `turn_load`."""
    rms = []
    for share in (0.0, 1.0):
        w, angle, held, shown = 2 * math.pi, 0.0, motor.of["k_s"], []
        k_a, k_v = motor.of["k_a"], motor.of["k_e"] + motor.of["k_b"]
        for k in range(3000):
            load = float(motor.turn_load(np.array([angle]))[0])
            held += 0.05 * k_a * (2 * math.pi - w)
            u = held + 20 * k_a * (2 * math.pi - w) + share * load + k_v * w
            w += 0.001 / k_a * (u - k_v * w - motor.of["k_s"] - load)
            angle += 0.001 * w
            if k > 1000:
                shown.append(w)
        rms.append(float(np.std(shown)))
    assert 20 * math.log10(rms[0] / rms[1]) > 10.0  # dB


def test_files_keep_the_orders_and_older_ones_are_read(motor: Motor, tmp_path: Path) -> None:
    path, u = tmp_path / "motor.json", np.repeat([3.0, -3.0], 300)
    motor.save(path)
    again = load_motor(path)
    assert again.orders == motor.orders
    assert np.array_equal(again.simulate(u), motor.simulate(u))
    document = json.loads(path.read_text())
    older = {**document, "version": 2}
    del older["orders"]
    for name in list(older["theta"])[18:]:
        del older["theta"][name]
    path.write_text(json.dumps(older))
    assert load_motor(path).orders == (0, 0, 0, 0)
    assert load_motor(path).of["sag"] == 0.0
    for wrong in ([1, 2], [3, 4, 5, -1], [3, 4, 5, 1.5], "none"):
        path.write_text(json.dumps({**document, "orders": wrong}))
        with pytest.raises(ModelFileError, match="orders"):
            load_motor(path)


def test_a_twin_has_the_torque_ripple_of_its_motor() -> None:
    machine = VirtualMachine(101)
    recording, _ = recorded(machine, steps(20.0, 0.001, 101))
    motor = physics(recording)
    assert motor.orders[3] == 4
    twin = motor.machine()
    assert twin.parameters["torque_ripple"] == pytest.approx(
        machine.parameters["torque_ripple"], rel=0.25
    )


@pytest.mark.nightly("a motor of its own")
def test_profiles_have_ends_of_their_own_to_either_side() -> None:
    machine = VirtualMachine(7)
    recording, _ = recorded(machine, steps(5.0, 0.001, 7))
    usual = physics(recording)
    profile = physics(recording, intervals="profile")
    truth = truths(machine.parameters)
    uneven = []
    for name, p in profile.parameters.items():
        assert p.value == usual.value(name)
        assert p.low <= p.value <= p.high
        other = usual.parameters[name]
        if p.low > 0.0:
            uneven.append(abs((p.high - p.value) / (p.value - p.low) - 1))
        # the same question, asked of the cost instead of its curvature
        assert 0.4 < (p.high - p.low) / (other.high - other.low) < 2.5, name
    assert max(uneven) > 0.05
    for name in ("k_v", "k_a"):
        assert profile.parameters[name].low <= truth[name] <= profile.parameters[name].high


def test_structure_and_intervals_are_checked(case: Any) -> None:
    with pytest.raises(SettingError, match="profile"):
        physics(case[0], intervals="bootstrap")  # type: ignore[call-overload]
    with pytest.raises(SettingError, match="cogging"):
        physics(case[0], structure=["dcmotor", "cogs"])


@pytest.mark.parametrize(
    "structure",
    ["cogging", ["cogging", "torque_ripple"], ["lag", "stribeck_difference"], ["sag", "coulomb"]],
)  # fmt: skip
def test_any_terms_alone_are_a_fit(case: Any, structure: Any) -> None:
    recording = sewfast.Recording(
        case[0].u[:6000], case[0].counts[:6000], case[0].y[:6000], None, 0.001, 4000.0, "part"
    )
    motor = physics(recording, structure=structure)
    assert math.isfinite(motor.rmse)
    assert "k_v" in {*motor.parameters, *motor.undetermined}


def test_the_command_takes_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine = VirtualMachine(7)
    recording, _ = recorded(machine, steps(5.0, 0.001, 7))
    recording.save(tmp_path / "steps.csv")
    main([
        "physics", str(tmp_path / "steps.csv"), "--input", "u", "--counts", "counts",
        "--counts-per-rev", "1572", "--structure", "lag,coulomb,sag", "--intervals", "profile",
    ])  # fmt: skip
    assert "k_v" in capsys.readouterr().out
