"""A machine that is not as thought: too fast for its stated speed, or short of what was asked."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from sewfast import Controller, Gains, commission, record, run
from sewfast.commissioning import Refusal, SteppedBench
from sewfast.commissioning.verification import Comparison, unreached
from sewfast.control.loop import ClosedLoopRun
from sewfast.dataset import FloatArray
from sewfast.errors import LinkError
from sewfast.recording import Recording

STATED = 2000.0
TS = 1e-3


@dataclass
class Motor:
    """`gain` RPM/V, a time constant of `lag` [s]; without friction it integrates the command."""

    gain: float = 250.0
    has_friction: bool = True
    flips_at: float = math.inf
    sticks_at: float = math.inf
    lag: float = 0.1
    t: float = 0.0
    speed_rpm: float = 0.0
    angle: float = 0.0
    speeds: list[float] = field(default_factory=list)
    commands: list[float] = field(default_factory=list)

    @property
    def counts(self) -> float:
        return math.floor(4096 * self.angle)

    def reset(self) -> None:
        self.speed_rpm = self.angle = self.t = 0.0

    def step(self, u: float) -> None:
        self.commands.append(u)
        u = -u if self.t >= self.flips_at else u
        u = 10.0 if self.t >= self.sticks_at else u
        for _ in range(10):
            drag = self.speed_rpm if self.has_friction else 0.0
            self.speed_rpm += 1e-4 / self.lag * (self.gain * u - drag)
            self.angle += 1e-4 * self.speed_rpm / 60.0
        self.t += TS
        self.speeds.append(abs(self.speed_rpm))

    def judge(self, most: float) -> None:
        """The command is 0 within 20 ms of the stated speed, which is not passed by far."""
        passed = int(np.argmax(np.array(self.speeds) > STATED))
        assert max(self.speeds) > STATED
        assert max(self.speeds) <= most * STATED
        assert not any(self.commands[passed + round(0.02 / TS) :])


def bench(motor: Motor) -> SteppedBench:
    return SteppedBench(motor, Ts=TS, counts_per_rev=4096, volt=10.0, speed=STATED, name="rig")


@pytest.mark.parametrize(
    ("motor", "most"),
    [
        (Motor(has_friction=False), 1.25),
        (Motor(gain=400.0), 1.25),
        (Motor(gain=15_000.0), 2.0),
    ],
    ids=["integrates", "too strong", "60 times the gain"],
)
def test_a_motor_that_passes_its_speed_is_commanded_to_rest(motor: Motor, most: float) -> None:
    with pytest.raises(LinkError, match=r"rig, step: expected at most 2000 RPM") as stop:
        record(bench(motor), np.full(3000, 8.0), name="step")
    motor.judge(most)
    assert isinstance(stop.value.recording, Recording)
    assert "raise" not in str(stop.value)
    rests = "it stands now" if motor.has_friction else "it still turns 5 s after that"
    assert rests in str(stop.value)


@pytest.mark.parametrize(
    ("fault", "named"), [("flips_at", "command sign"), ("sticks_at", "stage stuck")]
)
def test_a_loop_that_runs_away_is_ended(fault: str, named: str) -> None:
    motor = Motor(gain=400.0, **{fault: 0.5})
    pid = Controller(
        Gains.standard(0.01, 0.1, u_unit="V", y_unit="RPM"), u_min=-10.0, u_max=10.0,
        filter_samples=8, counts_per_rev=4096,
    )  # fmt: skip
    with pytest.raises(LinkError, match="expected at most 2000 RPM") as stop:
        run(pid, bench(motor), np.full(3000, 1000.0), name="level")
    # a stage that is stuck has its own will: its command of rest comes as fast
    motor.judge(1.25 if fault == "flips_at" else math.inf)
    assert stop.value.cause.name == named
    assert stop.value.cause.at == pytest.approx(0.5, abs=0.05)
    # on the way to rest, which a turned sign allows and a stuck stage does not
    u, counts = stop.value.recording.u, stop.value.recording.counts
    assert len(u) == len(counts)
    assert u[-260:-240].any()
    assert not u[-240:].any()
    speeds = np.diff(counts[-200:])
    assert (abs(speeds[-1]) < 0.5 * abs(speeds[0])) == (fault == "flips_at")


def test_a_loop_that_loses_its_encoder_is_ended_though_nobody_watches_it() -> None:
    class Blind(Motor):
        last = 0.0

        @property
        def counts(self) -> float:
            if self.t < 0.5:
                self.last = math.floor(4096 * self.angle)
            return self.last

    pid = Controller(
        Gains.standard(0.01, 0.1, u_unit="V", y_unit="RPM"), u_min=-10.0, u_max=10.0,
        filter_samples=8, counts_per_rev=4096,
    )  # fmt: skip
    motor = Blind(gain=400.0)
    with pytest.raises(LinkError, match="expected the encoder to count on") as stop:
        run(pid, bench(motor), np.full(3000, 1000.0), name="level")
    assert stop.value.cause.name in ("encoder lost", "stage off")
    assert motor.commands.index(0.0, 10) < 515
    # without a stated speed a quarter of a second after the command reached half of its limit
    motor = Blind(gain=400.0)
    rig = SteppedBench(motor, Ts=TS, counts_per_rev=4096, volt=10.0, name="rig")
    with pytest.raises(LinkError, match="expected the encoder to move"):
        run(pid, rig, np.full(3000, 1000.0), name="level")
    assert motor.commands.index(0.0, 10) < 1000
    assert motor.commands[-1] == 0.0


def test_a_gain_that_one_sample_proves_too_large_is_refused_after_the_step() -> None:
    motor = Motor(gain=15_000.0, lag=0.02)
    with pytest.raises(Refusal, match="takes many samples to its 2000 RPM at 10 V") as stop:
        commission(bench(motor), speed=1500, members=2, evaluations=60)
    assert stop.value.cause.name == "gain too large"
    assert "raise" not in str(stop.value)
    assert max(motor.speeds) < STATED


def test_a_dead_encoder_does_not_take_a_machine_to_full_speed() -> None:
    class Dead(Motor):
        counts = 0.0

    motor = Dead(gain=400.0)
    with pytest.raises(Refusal, match="its encoder counted less") as stop:
        commission(bench(motor), speed=1500, members=2, evaluations=60)
    assert stop.value.cause.name == "no motion"
    assert max(motor.speeds) < 1.4 * STATED


def test_commissioning_ends_on_a_machine_that_integrates() -> None:
    motor = Motor(gain=2000.0 * 0.1, has_friction=False)
    with pytest.raises(LinkError, match="expected at most 2000 RPM"):
        commission(bench(motor), speed=1500, members=2, evaluations=60)
    motor.judge(1.25)


def test_a_machine_that_states_no_speed_ends_at_twice_what_was_planned() -> None:
    motor = Motor(gain=400.0, sticks_at=0.5)
    rig = SteppedBench(motor, Ts=TS, counts_per_rev=4096, volt=10.0, name="rig")
    with pytest.raises(LinkError, match="expected at most 3750 RPM"):
        commission(rig, speed=1500, members=2, evaluations=60)
    assert max(motor.speeds[: motor.commands.index(0.0, 600)]) < 1.1 * 3750.0
    assert math.isinf(rig.speed)


def test_a_machine_that_integrates_is_named_before_it_is_too_fast() -> None:
    motor = Motor(gain=2000.0 * 0.1, has_friction=False)
    rig = SteppedBench(motor, Ts=TS, counts_per_rev=4096, volt=10.0, name="rig")
    with pytest.raises(Refusal, match=r"it did not.*integrates: ") as stop:
        commission(rig, speed=1500, members=2, evaluations=60)
    assert max(motor.speeds) < 3750.0
    assert stop.value.cause.name == "integrates"


def test_a_machine_within_its_speed_is_left_alone() -> None:
    motor = Motor()
    found = record(bench(motor), np.full(1000, 7.0), name="step")
    assert len(found) == 1000
    assert max(motor.speeds) > 0.8 * STATED


def run_at(y: FloatArray, u: float = 3.0) -> ClosedLoopRun:
    pid = Controller(Gains.standard(0.01, 0.1), Ts=TS, u_min=-10.0, u_max=10.0)
    r = np.concatenate([np.linspace(0.0, 1500.0, 400), np.full(1600, 1500.0)])
    t = TS * np.arange(len(r))
    return ClosedLoopRun(t, r, np.full(len(r), u), y, y, pid, "rig", "trapezoid")


def test_what_was_predicted_and_missed_is_no_verification() -> None:
    good = run_at(np.interp(np.arange(2000), [0, 405], [0.0, 1500.0]))
    short = run_at(np.interp(np.arange(2000), [0, 350], [0.0, 1200.0]))
    railed = run_at(good.y, u=10.0)
    assert unreached([Comparison("trapezoid", good, good, ())]) == ""
    # as predicted, and yet 300 RPM off
    text = unreached([Comparison("trapezoid", short, short, ())])
    assert text == "1200 of 1500 RPM on 'trapezoid'"
    assert "at a limit for 100 %" in unreached([Comparison("trapezoid", good, railed, ())])
    assert unreached([Comparison("trapezoid", railed, railed, ())]) == ""
    assert unreached([Comparison("trapezoid", short, None, ())]) == ""


def test_a_smooth_reference_beyond_reach_and_a_short_end_are_no_verification() -> None:
    t = TS * np.arange(4000)
    pid = Controller(Gains.standard(0.01, 0.1), Ts=TS, u_min=-10.0, u_max=10.0)

    def compared(r: FloatArray, y: FloatArray, u: FloatArray) -> str:
        found = ClosedLoopRun(t, r, u, y, y, pid, "rig", "sweep")
        return unreached([Comparison("sweep", found, found, ())])

    wave = 750.0 * (1.0 - np.cos(2.0 * math.pi * t))
    capped = np.minimum(wave, 1200.0)
    limit = np.where(wave > 1200.0, 10.0, 3.0)
    assert compared(wave, wave, limit) == ""
    assert "300 RPM off while the command was at its limit" in compared(wave, capped, limit)
    # as far off, but not for want of command
    assert compared(wave, capped, np.full(4000, 3.0)) == ""
    ends = np.where(t < 3.9, 1000.0, 0.0)
    turning = np.where(t < 3.9, 1000.0, 200.0)
    assert compared(ends, turning, np.full(4000, 1.0)) == "200 of 0 RPM on 'sweep'"


@pytest.mark.parametrize(
    ("per_turn", "scale"),
    [(6.0, 1.0), (1.0, 0.0), (2.0 * math.pi, 0.0)],
    ids=["hall", "turns", "rad"],
)
def test_coarse_steps_and_counts_that_are_none_trip_nothing(per_turn: float, scale: float) -> None:
    class Sensor(Motor):
        @property
        def counts(self) -> float:
            counted = per_turn * self.angle
            return math.floor(counted) if scale else counted

    motor = Sensor()
    rig = SteppedBench(motor, Ts=TS, counts_per_rev=per_turn, volt=10.0, speed=STATED)
    found = record(rig, np.full(1500, 6.0), name="step")
    assert len(found) == 1500
    assert max(motor.speeds) > 0.7 * STATED


@pytest.mark.nightly("a whole commissioning")
def test_a_machine_that_states_just_what_training_needs_is_not_tripped() -> None:
    motor = Motor(gain=300.0)
    rig = SteppedBench(motor, Ts=TS, counts_per_rev=4096, volt=10.0, speed=1250.0)
    commission(rig, speed=1000, members=1, evaluations=60)
    assert max(motor.speeds) < 1250.0
