"""`record` and `run` on machines that no device guards: too fast, blind, or not to be stopped."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sewfast import Controller, Gains, Recording, record, run
from sewfast.commissioning import SteppedBench
from sewfast.control.machine import MEMBERS, RecordedRun
from sewfast.errors import DataError, LinkError, SettingError

PID = Controller(
    Gains.standard(0.01, 0.1, u_unit="V", y_unit="RPM"), u_min=-10.0, u_max=10.0,
    filter_samples=8, counts_per_rev=4096,
)  # fmt: skip
LEVEL = np.repeat([500.0, 1200.0], [250, 1750])
STEADY = np.full(600, 2.0)


class Motor:
    """400 RPM/V with a time constant of .1 s; after .5 s its encoder counts `counted` of a turn,
    and its command is `command` times that which was given, or `stuck`.
    """

    def __init__(self, counted: float = 1.0, command: float = 1.0, stuck: float = 0.0) -> None:
        self.counted, self.command, self.stuck, self.is_off = counted, command, stuck, False
        self.top = 0.0
        self.reset()

    def reset(self) -> None:
        self.t = self.speed_rpm = self.turns = 0.0

    @property
    def counts(self) -> float:
        return math.floor(4096 * self.turns)

    def step(self, u: float) -> None:
        late = self.t >= 0.5
        u = self.stuck or self.command * u if late else u
        self.speed_rpm += 0.01 * (400.0 * u * (not self.is_off) - self.speed_rpm)
        self.turns += (self.counted if late else 1.0) * 1e-3 * self.speed_rpm / 60.0
        self.t, self.top = self.t + 1e-3, max(self.top, abs(self.speed_rpm))


def stepped(motor: Motor) -> SteppedBench:
    return SteppedBench(motor, Ts=1e-3, counts_per_rev=4096, volt=10.0, speed=2000.0, name="rig")


class Own:
    """A user's own, which plays a whole signal."""

    name, Ts, counts_per_rev, volt, speed = "rig", 1e-3, 4096.0, 10.0, 2000.0

    def __init__(self, motor: Motor) -> None:
        self.motor = motor

    def play(self, law: Any, n: int, name: str, watch: Any = None) -> Recording:
        u, counts = np.zeros(n), np.zeros(n)
        for k in range(n):
            if watch is not None and k and k % 20 == 0:
                watch(k - 20, u[k - 20 : k], counts[k - 20 : k])
            counts[k] = self.motor.counts
            u[k] = law(k, counts[k])
            self.motor.step(u[k])
        return Recording.of_counts(u, counts, Ts=1e-3, counts_per_rev=4096, name=name)

    def excite(self, u: Any, name: str) -> Recording:
        return self.play(lambda k, counts: u[k], len(u), name)

    def follow(self, controller: Any, r: Any, name: str, **options: Any) -> RecordedRun:
        core, before = controller.core(), [0.0]

        def law(k: int, counts: float) -> float:
            speed, before[0] = (counts - before[0]) * 60.0 / 4.096, counts
            return float(core.step(r[k], speed))

        log = self.play(law, len(r), name, **options)
        return RecordedRun.of_recording(log, controller, r, plant=self.name)


class Watched(Own):
    """The same, which can be ended."""

    def excite(self, u: Any, name: str, *, watch: Any = None) -> Recording:
        return self.play(lambda k, counts: u[k], len(u), name, watch)

    def follow(self, controller: Any, r: Any, name: str, *, watch: Any = None) -> RecordedRun:
        return super().follow(controller, r, name, watch=watch)


@pytest.mark.parametrize("kind", [stepped, Watched, Own])
def test_a_sound_machine_runs_to_the_end(kind: Any) -> None:
    brakes = np.repeat([1800.0, 200.0, -1800.0, 0.0], 500)
    assert len(run(PID, kind(Motor()), brakes).r) == 2000
    assert len(record(kind(Motor()), brakes / 400.0)) == 2000


@pytest.mark.parametrize(("kind", "most"), [(stepped, 1.1), (Watched, 1.25), (Own, math.inf)])
def test_a_machine_that_is_too_fast_is_ended_or_refused_afterwards(kind: Any, most: float) -> None:
    motor = Motor(command=-1.0)
    with pytest.raises(LinkError, match="rig, level: expected at most 2000 RPM") as stop:
        run(PID, kind(motor), LEVEL, name="level")
    assert stop.value.cause.name == "command sign"
    assert motor.top <= most * 2000.0
    assert ("let it take a `watch`" in str(stop.value)) == (kind is Own)
    motor = Motor(command=3.0)
    with pytest.raises(LinkError, match="rig, levels: expected at most 2000 RPM") as stop:
        record(kind(motor), np.full(1500, 4.0), name="levels")
    assert stop.value.cause.name == "gain"
    assert motor.top <= most * 2000.0


@pytest.mark.parametrize("kind", [stepped, Watched])
@pytest.mark.parametrize(
    ("counted", "named"), [(0.0, "encoder lost"), (0.5, "counts scaled"), (-1.0, "encoder sign")]
)
def test_an_encoder_that_is_lost_ends_a_run_before_it_is_too_fast(
    kind: Any, counted: float, named: str
) -> None:
    motor = Motor(counted=counted)
    with pytest.raises(LinkError, match="expected the encoder to count on") as stop:
        run(PID, kind(motor), LEVEL, name="level")
    assert stop.value.cause.name == named
    assert motor.top < 2000.0
    with pytest.raises(LinkError, match="expected the encoder to count on"):
        record(kind(Motor(counted=counted)), np.full(1500, 4.0))


def test_a_stage_that_does_not_obey_is_switched_off() -> None:
    class Switched(Motor):
        def off(self) -> None:
            self.is_off = True

    tops = []
    for motor, can_be in ((Motor(stuck=10.0), False), (Switched(stuck=10.0), True)):
        with pytest.raises(LinkError, match="expected at most 2000 RPM") as stop:
            run(PID, stepped(motor), LEVEL)
        tops.append(motor.top)
        assert ("it stands now" in str(stop.value)) == can_be
    assert tops[0] > 1.9 * 2000.0
    assert tops[1] < 1.25 * 2000.0
    # one that obeys is not: rest brakes it
    obedient = Switched(command=-1.0)
    with pytest.raises(LinkError):
        run(PID, stepped(obedient), LEVEL)
    assert not obedient.is_off


def test_a_load_that_falls_after_the_command_of_rest_is_switched_off() -> None:
    class Hoist(Motor):
        """Rest slows it; then gravity turns it the other way. The brake is its `off`."""

        def step(self, u: float) -> None:
            pull = 0.0 if self.is_off else 8.0 * (self.t > 0.3)
            super().step(u - pull)

        def off(self) -> None:
            self.is_off = True

    motor = Hoist(command=1.0)
    with pytest.raises(LinkError, match=r"at most 2000 RPM.*it stands now"):
        record(stepped(motor), np.full(1500, 9.0))
    assert motor.is_off
    assert motor.top < 1.25 * 2000.0


def test_an_off_that_fails_does_not_hide_what_ended_the_run() -> None:
    class Welded(Motor):
        def off(self) -> None:
            raise OSError("the contactor does not answer")

    with (
        pytest.warns(RuntimeWarning, match="rig: off.. failed: OSError"),
        pytest.raises(LinkError, match=r"at most 2000 RPM.*it still turns 5 s after that"),
    ):
        run(PID, stepped(Welded(stuck=10.0)), LEVEL)


@pytest.mark.parametrize("kind", [stepped, Watched, Own])
def test_a_reference_beyond_the_stated_speed_accuses_no_machine(kind: Any) -> None:
    motor = Motor()
    with pytest.raises(SettingError, match=r"rig, reference: expected within its \+-2000 RPM"):
        run(PID, kind(motor), np.repeat([500.0, 2500.0], 500))
    assert motor.t == 0.0


@pytest.mark.parametrize("missing", [math.nan, None, 10**400])
@pytest.mark.parametrize("play", [lambda on: run(PID, on, LEVEL), lambda on: record(on, STEADY)])
def test_counts_that_are_no_numbers_end_a_run(play: Any, missing: Any) -> None:
    class Blind(Motor):
        @property
        def counts(self) -> Any:
            return super().counts if self.t < 0.3 else missing

    motor = Blind()
    with pytest.raises(LinkError, match="expected a number as its counts") as stop:
        play(stepped(motor))
    assert motor.t < 0.31
    assert np.isfinite(stop.value.recording.counts).all()


@pytest.mark.parametrize(
    "kind",
    [
        lambda a: np.array(a, dtype=np.int32),
        lambda a: np.array(a, dtype=np.float32),
        list,
        lambda a: np.column_stack([a, a])[:, 0],
    ],
    ids=["integers", "single", "list", "column"],
)
def test_a_watch_takes_samples_of_any_kind(kind: Any) -> None:
    class Shown(Watched):
        def play(self, law: Any, n: int, name: str, watch: Any = None) -> Recording:
            def shown(first: int, u: Any, counts: Any) -> None:
                watch(first, list(u), kind(counts))

            return super().play(law, n, name, shown)

    assert len(record(Shown(Motor()), STEADY)) == 600
    assert len(run(PID, Shown(Motor()), LEVEL).r) == 2000
    with pytest.raises(LinkError, match="at most 2000 RPM"):
        record(Shown(Motor(command=3.0)), np.full(1500, 4.0))


def test_counts_that_are_no_numbers_end_a_watched_run() -> None:
    class Blind(Motor):
        since = 0.3

        @property
        def counts(self) -> float:
            return super().counts if self.t < self.since else math.nan

    for play in (lambda on: run(PID, on, LEVEL), lambda on: record(on, STEADY)):
        motor = Blind()
        with pytest.raises(LinkError, match="expected a number as its counts") as stop:
            play(Watched(motor))
        assert motor.t < 0.33
        assert len(stop.value.recording) == pytest.approx(300, abs=1)
        assert np.isfinite(stop.value.recording.counts).all()
        motor.since = 0.0
        with pytest.raises(LinkError, match="expected a number as its counts"):
            play(Watched(motor))


@pytest.mark.parametrize("taken", [slice(0, None), slice(1, 20), slice(0, 0)])
def test_a_watch_that_is_called_wrongly_accuses_nobody(taken: slice) -> None:
    class Wrong(Watched):
        def play(self, law: Any, n: int, name: str, watch: Any = None) -> Recording:
            log: list[float] = []

            def wrong(first: int, u: Any, counts: Any) -> None:
                log.extend(counts)
                watch(0 if taken.stop is None else first, u, np.array(log)[taken])

            return super().play(law, n, name, wrong)

    with pytest.raises(SettingError, match="rig, array, watch: expected the samples from"):
        record(Wrong(Motor()), STEADY)


def test_a_run_that_was_too_fast_all_the_same_says_why_nobody_ended_it() -> None:
    class Deaf(Watched):
        def play(self, law: Any, n: int, name: str, watch: Any = None) -> Recording:
            def deaf(*samples: Any) -> None:
                with contextlib.suppress(LinkError):
                    watch(*samples)

            return super().play(law, n, name, deaf)

    class Mute(Watched):
        def play(self, law: Any, n: int, name: str, watch: Any = None) -> Recording:
            return super().play(law, n, name)

    for kind, why in (
        (Own, "let it take a `watch`"),
        (Deaf, "let that exception pass"),
        (Mute, "whose `watch` was shown 0 samples"),
    ):
        with pytest.raises(LinkError, match=f"at most 2000 RPM.*{why}"):
            record(kind(Motor(command=3.0)), np.full(1500, 4.0))


def test_a_bench_that_plays_in_its_own_way_is_guarded_as_any_other() -> None:
    class Quick(SteppedBench):
        def excite(self, u: Any, name: str) -> Recording:
            return Own(self.machine).excite(u, name)  # type: ignore[arg-type]

    bench = Quick(Motor(command=3.0), Ts=1e-3, counts_per_rev=4096, volt=10.0, speed=2000.0)
    with pytest.raises(LinkError, match=r"at most 2000 RPM.*let it take a `watch`"):
        record(bench, np.full(1500, 4.0))
    assert len(run(PID, bench, LEVEL[:300]).r) == 300


@pytest.mark.parametrize("kind", [stepped, Watched, Own])
def test_no_command_goes_beyond_what_a_machine_bears(kind: Any) -> None:
    class Weak(Motor):
        most = 0.0

        def step(self, u: float) -> None:
            self.most = max(self.most, abs(u))
            super().step(u / 10.0)

    motor = Weak()
    assert record(kind(motor), np.full(300, 15.0)).u.max() == 10.0
    for controller in (replace(PID, u_max=50.0), replace(PID, u_min=-math.inf, u_max=math.inf)):
        found = run(controller, kind(motor), np.full(1500, 1500.0))
        assert found.u.max() == 10.0
        np.testing.assert_array_equal(found.u, found.recording.u)
        # the limit is the loop's own: it is said to be at it
        assert found.metrics()["saturated"] > 0.5
    assert motor.most == 10.0
    motor.t = 0.0
    with pytest.raises(DataError, match="finite"):
        record(kind(motor), np.array([0.0, math.nan, 1.0]))
    with pytest.raises(DataError, match="finite"):
        run(PID, kind(motor), np.array([0.0, math.nan, 1.0]))
    assert motor.t == 0.0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"Ts": 2e-3}, "the machine's Ts"),
        ({"counts_per_rev": 1024.0}, "the machine's counts_per_rev"),
        ({"u": STEADY[:300], "counts": STEADY[:300], "y": STEADY[:300]}, "one for each command"),
    ],
)
def test_a_record_that_is_not_what_was_asked_for_is_refused(changes: Any, said: str) -> None:
    class Other(Own):
        def excite(self, u: Any, name: str) -> Recording:
            return replace(super().excite(u, name), **changes)

    with pytest.raises(DataError, match=said):
        record(Other(Motor()), STEADY)


def test_a_machine_that_is_unfinished_is_refused_by_what_it_lacks() -> None:
    own = Own(Motor())
    for name, changes, said in (
        ("speed", {"speed": None}, "speed: expected a number, received None"),
        ("excite", {"excite": lambda *given: None}, "expected a Recording, received NoneType"),
    ):
        changed = type("Changed", (Own,), changes)(Motor())
        with pytest.raises(SettingError, match=said):
            record(changed, LEVEL / 400.0)
        members = {m: getattr(own, m) for m in MEMBERS if m != name}
        for play in (lambda on: record(on, LEVEL), lambda on: run(PID, on, LEVEL)):
            with pytest.raises(SettingError, match=f"without {name}; give it"):
                play(type("Lacking", (), members)())
    with pytest.raises(SettingError, match="SteppedBench"):
        record(Motor(), LEVEL)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match=r"make one: Motor\(\)"):
        stepped(Motor)  # type: ignore[arg-type]
    motor = Motor()
    motor.reset = lambda: setattr(motor, "speed_rpm", None)  # type: ignore[method-assign]
    with pytest.raises(SettingError, match="speed_rpm of rig: expected a number"):
        run(PID, stepped(motor), LEVEL)
