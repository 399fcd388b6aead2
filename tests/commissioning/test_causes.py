"""`cause_of`: what is wrong with a machine gets its name."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from sewfast import Controller, DataError, Gains, Recording, cause_of, commission, record, run
from sewfast.causes import cause_among, sudden
from sewfast.commissioning import Refusal, SteppedBench
from sewfast.commissioning.demands import demands
from sewfast.commissioning.excitations import first_motion, lost_motion, step_response
from sewfast.errors import LinkError

TS, PER_TURN = 1e-3, 4096.0


@dataclass
class Motor:
    """250 RPM/V, .3 V of friction; from `at` on each field that is not None acts."""

    at: float = math.inf
    command: float = 1.0
    stuck: float | None = None
    load: float = 0.0
    encoder: float = 1.0
    jump: float = 0.0
    late: int = 0
    inertia: float = 1.0
    friction: float = 0.3
    lag: float = 0.1

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.t = self.speed_rpm = self.counted = 0.0
        self.sent = [0.0] * 200

    @property
    def counts(self) -> float:
        return math.floor(PER_TURN * self.counted)

    def step(self, u: float) -> None:
        wrong = self.t >= self.at
        if wrong and self.jump and self.t - TS < self.at:
            self.counted += self.jump / PER_TURN
        self.sent.append(u)
        drive = self.sent[-2 - self.late * wrong] * (self.command if wrong else 1.0)
        drive = self.stuck if wrong and self.stuck is not None else drive
        drive += self.load * wrong
        friction = self.friction if wrong else 0.3
        for _ in range(5):
            held = math.copysign(friction, self.speed_rpm)
            held = held if self.speed_rpm else min(max(drive, -friction), friction)
            before = self.speed_rpm
            rise = (250.0 * (drive - held) - before) / (self.lag * (self.inertia if wrong else 1.0))
            self.speed_rpm += 0.2 * TS * rise
            if before * self.speed_rpm < 0.0:
                self.speed_rpm = 0.0
            self.counted += 0.2 * TS * self.speed_rpm / 60.0 * (self.encoder if wrong else 1.0)
        self.t += TS


def rig(motor: Motor) -> SteppedBench:
    return SteppedBench(motor, Ts=TS, counts_per_rev=PER_TURN, volt=10.0, speed=3000.0, name="rig")


def looped(motor: Motor) -> Recording:
    """A run along levels, as far as it goes."""
    pid = Controller(
        Gains.standard(0.004, 0.1, u_unit="V", y_unit="RPM"), u_min=-10.0, u_max=10.0,
        filter_samples=4, counts_per_rev=PER_TURN,
    )  # fmt: skip
    levels = np.repeat([700.0, 1200.0, 400.0, 1000.0], 500)
    try:
        return run(pid, rig(motor), levels, name="levels").recording
    except LinkError as stop:
        found: Recording = stop.recording
        return found


CASES = [
    (Motor(1.13, command=-1.0), "command sign", -1.0),
    (Motor(1.13, encoder=-1.0), "encoder sign", -1.0),
    (Motor(1.13, encoder=0.0), "encoder lost", 0.0),
    (Motor(1.13, encoder=0.5), "counts scaled", 0.5),
    (Motor(1.13, stuck=6.0), "stage stuck", 6.0),
    (Motor(1.13, command=0.0), "stage off", 0.0),
    (Motor(1.13, command=0.4), "gain", 0.4),
    (Motor(1.13, load=1.5), "load", 1.5),
    (Motor(1.13, friction=2.0), "friction", 1.7),
    (Motor(1.13, late=30), "delay", 0.03),
    (Motor(1.13, inertia=4.0), "inertia", 4.0),
    (Motor(1.13, jump=3000.0), "counts jumped", 3000.0),
]


@pytest.mark.parametrize(("motor", "name", "value"), CASES, ids=[c[1] for c in CASES])
def test_what_changed_in_a_run_is_named_with_its_number_and_time(
    motor: Motor, name: str, value: float
) -> None:
    before = [record(rig(Motor()), np.repeat([0.0, 3.0, 6.0, 2.0], 500), name="steps")]
    found = cause_of(looped(motor), before, volt=10.0, speed=3000.0)
    assert found is not None
    assert found.name == name
    assert found.value == pytest.approx(value, rel=0.3, abs=0.05)
    # a delay shows at the next edge
    assert found.at == pytest.approx(1.13, abs=0.4 if name == "delay" else 0.06)
    assert found.run == "levels"
    assert "raise" not in str(found)
    assert found.to_json()["name"] == name


@pytest.mark.parametrize(
    ("motor", "name"), [c[:2] for c in CASES[:8]], ids=[c[1] for c in CASES[:8]]
)
def test_a_run_alone_is_enough_if_it_was_well_at_first(motor: Motor, name: str) -> None:
    found = cause_of(looped(motor))
    assert found is not None
    assert found.name == name


def test_an_encoder_that_freezes_before_anything_moved_fast_is_no_delay() -> None:
    sound, broken = Motor(lag=0.4), Motor(0.06, encoder=0.0, lag=0.4)
    before = [record(rig(sound), np.repeat([0.0, 3.0, 0.0], [100, 900, 900]), name="step")]
    u = np.concatenate([np.zeros(50), np.tile(np.repeat([9.0, -4.0, 6.0, 2.0], 60), 8)])
    found = cause_among([*before, record(rig(broken), u, name="pulses")], volt=10.0, speed=3000.0)
    assert found is not None
    assert found.name in ("encoder lost", "stage off"), str(found)


def test_a_machine_that_was_never_as_thought_is_named_from_one_run() -> None:
    step = np.concatenate([np.zeros(100), np.full(400, 5.0), np.linspace(5.0, 7.0, 400)])

    def named(motor: Motor) -> str | None:
        try:
            found = cause_of(record(rig(motor), step, name="step"), volt=10.0, speed=3000.0)
        except LinkError as stop:
            found = stop.cause
        return None if found is None else found.name

    assert named(Motor()) is None
    assert named(Motor(0.0, command=-1.0)) == "sign"
    assert named(Motor(0.0, encoder=0.0)) == "no motion"
    assert named(Motor(0.0, command=40.0)) == "gain too large"
    assert named(Motor(0.0, stuck=3.0)) == "turns at rest"


@pytest.mark.parametrize(
    ("wraps", "per_turn", "said"),
    [
        (2000, 2000.0, "an angle that begins anew at every turn"),
        (4096, 4096.0, "an angle that begins anew at every turn"),
        (16384, 2000.0, "a counter of 14 bits that wraps"),
        (3000, 2000.0, "more than the machine can turn"),
    ],
)
def test_counts_that_wrap_are_said_to(wraps: int, per_turn: float, said: str) -> None:
    class Absolute(Motor):
        @property
        def counts(self) -> float:
            return math.floor(per_turn * self.counted) % wraps

    bench = SteppedBench(Absolute(), Ts=TS, counts_per_rev=per_turn, volt=10.0, speed=3000.0)
    with pytest.raises(LinkError) as stop:
        record(bench, np.full(3000, 1.0))
    assert stop.value.cause.name == "counts jumped"
    assert said in stop.value.cause.text


@pytest.mark.parametrize(("brakes", "named"), [(False, "turns at rest"), (True, "sign")])
def test_a_load_that_hangs_is_not_a_turned_sign(brakes: bool, named: str) -> None:
    """Behind a brake that opens with the command nothing tells them apart: both are said."""

    class Hoist(Motor):
        def step(self, u: float) -> None:
            self.at = math.inf if brakes and not u else 0.0
            super().step(u)

    with pytest.raises(Refusal) as refused:
        commission(rig(Hoist(load=-1.5)), speed=1100.0)
    assert refused.value.stage == "first motion"
    assert refused.value.cause.name == named
    assert "load" in refused.value.cause.text


def test_no_longer_step_follows_one_that_nothing_was_seen_of() -> None:
    class Slips(Motor):
        """The coupling is lost after the first motion."""

        runs = 0

        def reset(self) -> None:
            super().reset()
            self.runs += 1

        @property
        def counts(self) -> float:
            return super().counts if self.runs <= 6 else 0.0

    motor = Slips()
    with pytest.raises(Refusal, match="counted nothing in 2 s") as refused:
        commission(rig(motor), speed=1100.0)
    assert refused.value.cause.name == "encoder lost"
    assert motor.t < 2.1


@pytest.mark.parametrize("lag", [0.1, 0.4, 1.5])
@pytest.mark.parametrize("friction", [1.0, 0.0])
def test_a_strong_machine_that_a_guard_ended_early_is_not_said_to_integrate(
    lag: float, friction: float
) -> None:
    """Ended at a fifth of its own speed, it has not settled, but its speed falls behind a line."""
    speed, counts = 0.0, [0.0]
    while speed < 2100.0:
        speed += TS / lag * (2500.0 * 4.0 - friction * speed)
        counts.append(counts[-1] + PER_TURN * TS * speed / 60.0)
    u = np.full(len(counts), 4.0)
    ended = Recording.of_counts(u, np.floor(counts), Ts=TS, counts_per_rev=PER_TURN)
    found = cause_of(ended, volt=12.0, speed=2000.0)
    assert found is not None
    assert found.name == ("gain too large" if friction else "integrates")


def test_a_machine_that_did_what_it_always_did_has_no_cause() -> None:
    before = [record(rig(Motor()), np.repeat([0.0, 3.0, 6.0, 2.0], 500), name="steps")]
    assert cause_of(looped(Motor()), before, volt=10.0) is None


@pytest.mark.parametrize(
    ("motor", "u_max", "name", "said"),
    [
        (Motor(0.0, friction=4.0), 10.0, "dead zone", "the first 3.2 V"),
        (Motor(0.0, command=40.0, inertia=400.0), 10.0, "integrates", "RPM/s per V"),
        (Motor(0.0), 5.0, "out of reach", "or raise u_max"),
        (Motor(0.0, command=0.3), 10.0, "out of reach", "at the 10 V that it bears"),
    ],
    ids=["friction", "integrates", "held back", "weak"],
)
def test_a_step_that_is_refused_has_a_cause(
    motor: Motor, u_max: float, name: str, said: str
) -> None:
    """Only where the machine bears more than it may have is the limit the cause."""
    with pytest.raises(Refusal) as refused:
        commission(rig(motor), speed=1100.0, u_max=u_max)
    assert refused.value.stage == "step response"
    cause = refused.value.cause
    assert cause is not None
    assert (cause.name, cause.run) == (name, "step")
    assert said in cause.text
    assert ("raise" in str(refused.value)) == (u_max < 10.0)


@pytest.mark.parametrize(("friction", "lost"), [(0.3, False), (3.0, True)])
def test_a_dead_zone_is_said_of_a_machine_that_goes_on(friction: float, lost: bool) -> None:
    motor = Motor(0.0, friction=friction)
    asked = demands(
        rig(motor), u_max=None, speed=700.0, references=None, members=1, evaluations=1, seed=0,
        threads=1,
    )  # fmt: skip
    motion = first_motion(rig(motor), asked)
    step = step_response(rig(motor), asked, motion)
    cause = lost_motion(step, asked, motion)
    assert (None if cause is None else cause.name) == ("dead zone" if lost else None)


def test_one_motor_that_explains_all_runs_needs_no_change() -> None:
    """At one level friction is a part of the gain; a second level shows it, and is no fault."""
    stiff = Motor(0.0, friction=3.0)
    low, high = (record(rig(stiff), np.repeat([0.0, u], 500), name="step") for u in (5.0, 9.0))
    assert cause_of(high, [low], volt=10.0) is None


@pytest.mark.parametrize(
    ("after", "name", "value"),
    [(0.0, "encoder lost", 0.0), (-1.0, "encoder sign", -1.0), (0.5, "counts scaled", 0.5),
     (20.0, "counts jumped", 38.0 * 19.0), (0.9, None, 0.0), (1.5, "counts scaled", 1.5)],
)  # fmt: skip
@pytest.mark.parametrize("more", [1, 2])
def test_a_pace_that_no_torque_changes_has_a_cause(
    after: float, name: str | None, value: float, more: int
) -> None:
    """A device has tripped within a sample or two."""
    rng = np.random.default_rng(0)
    paces = np.concatenate([np.linspace(0.0, 38.0, 80), np.full(60, 38.0)])
    counts = np.floor(np.cumsum([*paces, *[38.0 * after] * more]) + rng.uniform(0.0, 1.0))
    u = np.full(len(counts), 5.0)
    seen = sudden(Recording(u, counts, u, None, 1e-3, 1572.0, "loop"))
    assert (seen and seen.name) == name
    if seen is not None:
        assert seen.value == pytest.approx(value, abs=1.5 if name == "counts jumped" else 0.05)
        assert seen.at == pytest.approx(0.139, abs=1e-9)


@pytest.mark.parametrize(
    ("moved", "name"), [(400.0, None), (0.0, "encoder lost"), (-400.0, "encoder sign")]
)
def test_counts_after_a_trip_tell_what_a_run_did_not_show(moved: float, name: str | None) -> None:
    counts = np.floor(7.4 * np.arange(200.0))
    run = Recording(np.full(200, 5.0), counts, counts, None, 1e-3, 1572.0, "loop")
    assert sudden(run) is None
    seen = sudden(run, moved)
    assert (seen and seen.name) == name


def test_a_motor_that_begins_to_turn_has_not_changed_suddenly() -> None:
    counts = np.concatenate([np.zeros(60), [3.0, 12.0, 27.0]])
    u = np.full(len(counts), 20.0)
    assert sudden(Recording(u, counts, u, None, 1e-3, 1572.0, "loop")) is None


def test_too_short_a_run_is_refused() -> None:
    lost, counts = np.full(4, np.nan), np.arange(4.0)
    with pytest.raises(DataError, match="three samples"):
        cause_of(Recording(lost, counts, counts, None, TS, PER_TURN, "lost"))


def test_a_run_of_two_samples_among_others_is_passed_over() -> None:
    whole = record(rig(Motor()), np.repeat([0.0, 5.0], 500), name="step")
    short = Recording(np.ones(2), np.arange(2.0), np.arange(2.0), None, TS, PER_TURN, "short")
    assert cause_among([whole, short, whole]) is None


@pytest.mark.parametrize("lasts", [False, True])
def test_what_an_earlier_run_shows_is_a_fault_only_if_it_lasts(lasts: bool) -> None:
    def ran(motor: Motor, name: str) -> Recording:
        return record(rig(motor), np.repeat([0.0, 3.0, 6.0, 2.0], 250), name=name)

    braked = Motor(0.0, friction=1.5)
    later = [ran(braked if lasts else Motor(), f"later {i}") for i in range(2)]
    series = [ran(Motor(), "first"), ran(Motor(), "second"), ran(braked, "third"), *later]
    found = cause_among(series)
    assert (found is not None and found.name == "friction") == lasts
