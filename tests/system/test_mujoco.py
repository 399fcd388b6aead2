"""Motors of MuJoCo: another simulator's physics, through sewfast from record to run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sewfast
from sewfast import Cost, commission, signals
from sewfast.commissioning.demands import demands
from sewfast.commissioning.excitations import first_motion, step_response
from sewfast.commissioning.small_signal import SmallSignal, small_signal

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'sewfast[test]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benches"))
motors = pytest.importorskip("mujoco_motors")


def shaken(motor: motors.Motor) -> SmallSignal:
    on = motors.bench_of(motor)
    wanted = demands(
        on, u_max=None, speed=motor.speed, references=None, members=1, evaluations=1, seed=0,
        threads=1,
    )  # fmt: skip
    motion = first_motion(on, wanted)
    found = small_signal(on, wanted, motion, step_response(on, wanted, motion))
    assert found is not None
    return found


def test_motor_turns_as_its_data_sheet_says() -> None:
    motor = replace(motors.drawn(0), coulomb=0.0, viscous=0.0)
    on = motors.bench_of(motor)
    recording = on.excite(np.full(1000, 0.5 * motor.volt), "half")
    assert recording.speed_true is not None
    free = motor.volt / motor.constant * 30.0 / np.pi
    assert recording.speed_true[-1] == pytest.approx(0.5 * free, rel=1e-3)
    # the inertia of the rotor counts with the gear's square: the lag is that of the motor's shaft
    reached = 1e-3 * np.argmax(recording.speed_true > 0.632 * recording.speed_true[-1])
    assert reached == pytest.approx(motor.lag + motor.electrical, rel=0.1)
    assert recording.y[-100:].mean() == pytest.approx(0.5 * free, rel=0.01)


def test_every_run_ends_at_0_volts() -> None:
    motor = motors.drawn(0)
    on = motors.bench_of(motor)
    on.excite(np.full(50, motor.volt), "hard")
    assert on.machine.data.ctrl[0] == 0.0
    with pytest.raises(TypeError):
        on.excite([motor.volt, None], "broken")  # type: ignore[arg-type, list-item]
    assert on.machine.data.ctrl[0] == 0.0


@pytest.mark.nightly("responses of MuJoCo's motors")
@pytest.mark.parametrize("number", [4, 17])
def test_load_over_the_turn_behind_a_gear_is_no_resonance(number: int) -> None:
    motor = motors.drawn(number)
    assert motor.unbalance > 0.0
    found = shaken(motor)
    assert found.resonance is None
    assert found.fopdt is not None
    # friction makes the lag of small signals no other, the load would
    assert pytest.approx(motor.lag, rel=0.2) == found.fopdt.T


def test_record_identify_tune_run() -> None:
    motor = motors.drawn(7)
    on = motors.bench_of(motor)
    size = 0.5 * motor.volt
    recording = on.excite(size * (1.0 + signals.excitation("chirp_lo_hi") / 20.0), "chirp")
    model = sewfast.identify(recording.dataset(), model="oe")
    r = signals.reference("trapezoid")
    r = r * motor.speed / r.max()
    weights = Cost(tracking=1.0, chatter=5.0, overshoot=3.0, saturation=0.0)
    tuned = sewfast.tune(
        model, r, u_min=-motor.volt, u_max=motor.volt, counts_per_rev=motor.counts,
        filter_samples=4, cost=weights, evaluations=400,
    )  # fmt: skip
    measured = weights.of(on.follow(tuned.controller, r, "trapezoid").run)
    assert measured < 0.02 * motor.speed
    assert measured < 2.0 * tuned.cost


@pytest.mark.nightly("a commissioning of a motor of MuJoCo")
def test_motor_is_commissioned() -> None:
    motor = motors.drawn(17)
    found = commission(motors.bench_of(motor), speed=motor.speed, members=1, evaluations=150)
    assert found.is_verified
    assert found.measured_cost is not None
    assert found.measured_cost < 0.01 * motor.speed
