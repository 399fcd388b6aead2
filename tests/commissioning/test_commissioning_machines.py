"""Commissioning on machines that sewfast was not made with: `benches/drives.py`, a few in short."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from sewfast import Controller, Ensemble, Gains, LinearOE
from sewfast.commissioning import SteppedBench
from sewfast.commissioning.demands import Demands, Refusal, demands
from sewfast.commissioning.excitations import (
    GENTLE,
    acceleration,
    acceleration_from_rest,
    acceleration_shown,
    first_motion,
    pulses,
    standard,
    step_response,
)
from sewfast.commissioning.gains import cautious, first_gains, held, lowered, scaled, swing_of
from sewfast.commissioning.slow import HARMONICS, TurnLoad, basis, turn_load
from sewfast.commissioning.small_signal import SmallSignal, small_signal
from sewfast.control.margins import margins
from sewfast.dataset import FloatArray
from sewfast.recording import Recording
from sewfast.tuning.objective import LARGEST_MS

sys.path.insert(0, str(Path(__file__).parents[2] / "benches"))
drives = pytest.importorskip("drives")
pytest.importorskip("numba", reason="the simulator takes minutes without numba")
pytestmark = pytest.mark.nightly("compiles another simulator, and commissions its machines")


def bench(name: str, **changes: float) -> SteppedBench:
    """One machine of the family."""
    drive = next(d for d in drives.FAMILY if d.name == name)
    return drives.bench_of(drives.Simulator(replace(drive, **changes)))


def asked(on: SteppedBench, seed: int = 0) -> Demands:
    return demands(
        on, u_max=None, speed=None, references=None, members=2, evaluations=10, seed=seed, threads=1
    )


def shaken(on: SteppedBench, seed: int = 0) -> SmallSignal:
    wanted = asked(on, seed)
    motion = first_motion(on, wanted)
    found = small_signal(on, wanted, motion, step_response(on, wanted, motion))
    assert found is not None
    return found


@pytest.mark.parametrize(("hertz", "damping"), [(25.0, 0.02), (60.0, 0.02), (150.0, 0.05)])
def test_a_shaft_that_swings_is_named(hertz: float, damping: float) -> None:
    found = shaken(bench("shaft60", shaft=hertz, damping=damping)).resonance
    assert found is not None
    assert found.frequency == pytest.approx(hertz, rel=0.03)
    assert found.damping == pytest.approx(damping, abs=0.02)


@pytest.mark.parametrize("name", ["nominal", "light", "sticky", "late2", "enc256", "sag", "fast02"])
def test_a_stiff_machine_has_no_resonance(name: str) -> None:
    assert shaken(bench(name)).resonance is None


def test_dead_time_is_seen_that_a_step_response_does_not_show() -> None:
    found = {late: shaken(bench("nominal", late=late)).fopdt for late in (0, 2)}
    assert found[0] is not None
    assert found[2] is not None
    assert pytest.approx(2e-3, abs=3e-4) == found[2].L - found[0].L


def test_first_gains_are_quiet_where_eq_12_alone_would_wake_the_shaft() -> None:
    on = bench("shaft60")
    wanted = asked(on)
    motion = first_motion(on, wanted)
    step = step_response(on, wanted, motion)
    found = small_signal(on, wanted, motion, step)
    assert found is not None
    r, settled = held(wanted, 6000.0, on.Ts)
    wild = first_gains(step, on, wanted)
    assert margins(wild, found.model).Ms > LARGEST_MS
    swing = swing_of(on.follow(wild, r, "wild"), settled)
    assert swing is not None
    assert swing.frequency == pytest.approx(60.0, rel=0.2)
    quiet = first_gains(step, on, wanted, found)
    assert margins(quiet, found.model).Ms <= LARGEST_MS
    assert [b.kind for b in quiet.biquads] == ["notch"]
    # it allows more than gains that are lowered alone
    plain = lowered(wild, found.model, LARGEST_MS)
    assert quiet.gains.to("parallel").Ki > 1.2 * plain.gains.to("parallel").Ki
    assert swing_of(on.follow(quiet, r, "quiet"), settled) is None


def test_gains_come_in_steps_and_stop_at_the_first_swing() -> None:
    simulator = drives.Simulator(next(d for d in drives.FAMILY if d.name == "shaft40"))
    on = drives.bench_of(simulator)
    wild = Controller(
        gains=Gains.standard(0.04, 0.03), u_min=-20.0, u_max=20.0, filter_samples=8,
        counts_per_rev=1572.0,
    )  # fmt: skip
    kept, swing = cautious(on, wild, asked(on), 6000.0, "hold", None)
    assert swing is not None
    assert kept.gains.to("standard").Kp <= 0.5 * swing.share * 0.04 + 1e-12
    assert simulator.railed * on.Ts < 0.5
    with pytest.raises(Refusal, match=r"swings at .* Hz .*shaft"):
        cautious(on, scaled(wild, 20.0), asked(on), 6000.0, "hold", None)


def test_gains_that_nothing_makes_stable_are_refused() -> None:
    on = bench("nominal")
    backwards = Controller(gains=Gains.standard(-0.5, 1e-3), u_min=-20.0, u_max=20.0)
    with pytest.raises(Refusal, match="small signals"):
        lowered(backwards, shaken(on).model, 2.0)


def test_acceleration_is_what_the_current_limit_leaves() -> None:
    on = bench("nominal")
    recording = on.excite(np.repeat([0.0, 20.0, -10.0], [100, 250, 200]), "hard")
    # 5 A x .28 N m/A on .002 kg m^2, less friction and load
    assert 5500.0 < acceleration_shown(recording, asked(on)) < 7000.0


def test_acceleration_is_that_of_speeding_up_where_friction_hinders() -> None:
    # 2.5 A x .28 N m/A less .2 N m of friction: 2,380 RPM/s up, 4,290 down
    on = bench("weak")
    recording = on.excite(np.repeat([0.0, 20.0, -20.0], [100, 500, 200]), "hard")
    assert 2100.0 < acceleration_shown(recording, asked(on)) < 2800.0


@pytest.mark.parametrize(("name", "true"), [("light", 17_700.0), ("fast02", 31_000.0)])
def test_a_drive_whose_pulses_are_over_at_once_shows_its_acceleration_from_rest(
    name: str, true: float
) -> None:
    on = bench(name)
    wanted = asked(on)
    step = step_response(on, wanted, first_motion(on, wanted))
    planned = acceleration(step, wanted)
    assert planned > 4.0 * true
    recording = on.excite(pulses(step, planned, wanted, on.Ts, 0), "pulses")
    assert acceleration_shown(recording, wanted) == np.inf
    assert acceleration_from_rest(on, step, planned, wanted) == pytest.approx(true, rel=0.1)


def test_no_longer_pulse_is_tried_where_one_shows_nothing() -> None:
    on = bench("light")
    wanted = asked(on)
    step = step_response(on, wanted, first_motion(on, wanted))
    tried = []

    class Frozen:
        Ts = on.Ts

        def excite(self, u: FloatArray, name: str) -> Recording:
            tried.append(name)
            found = on.excite(u, name)
            return replace(found, y=0.0 * found.y, counts=0.0 * found.counts)

    with pytest.raises(Refusal, match="a tenth of what"):
        acceleration_from_rest(cast(Any, Frozen()), step, acceleration(step, wanted), wanted)
    assert len(tried) == 1


@pytest.mark.parametrize("fastest", [2_500.0, 6_000.0, 1e5])
def test_the_standard_references_ask_for_no_more_than_the_machine_has(fastest: float) -> None:
    on = bench("nominal")
    for short in (False, True):
        for name, r in standard(fastest, asked(on), on.Ts, short=short).items():
            # the sweeps reach their steepest at the end alone, for a part of a period
            share = 0.95 if name.startswith("chirp") else GENTLE
            assert np.abs(np.diff(r)).max() / on.Ts <= 1.001 * share * fastest


def test_a_load_over_the_turn_is_a_command_over_the_angle() -> None:
    load = TurnLoad(np.eye(HARMONICS)[0], 2.0 * np.eye(HARMONICS)[1])
    turns = np.array([0.0, 0.125, 1.25])
    expected = np.cos(2 * np.pi * turns) + 2.0 * np.sin(4 * np.pi * turns)
    np.testing.assert_allclose(load.at(turns), expected, atol=1e-12)
    assert basis(turns).shape == (3, 2 * HARMONICS)
    # 60 RPM is a turn a second
    np.testing.assert_allclose(
        load.along(np.full(2001, 60.0), 1e-3)[[0, 250, 1000]], [1.0, 0.0, 1.0], atol=1e-9
    )


def test_a_load_behind_a_gear_is_found_over_the_angle_of_the_output_shaft() -> None:
    # 200 RPM/V with a time constant of .1 s
    plant = LinearOE.from_tf([0.0, 2.0], [1.0, -0.99], 1e-3, input_units=["V"], output_unit="RPM")
    core = plant.core
    rng = np.random.default_rng(3)

    def recorded(samples: int, ratio: float, name: str) -> Recording:
        u = np.repeat(rng.uniform(2.0, 8.0, samples // 500), 500)
        turns = speed = 0.0
        push, counts = np.zeros(samples), np.zeros(samples)
        for k in range(samples):
            counts[k] = np.floor(1572.0 * turns)
            push[k] = 0.4 * np.sin(2.0 * np.pi * ratio * turns)
            speed += 0.01 * (200.0 * (u[k] + push[k]) - speed)
            turns += speed / 60.0 * 1e-3
        y = core.simulate((u + push)[:, None], np.zeros(core.na))
        return Recording(u, counts, y, None, 1e-3, 1572.0, name)

    ensemble = Ensemble.of([plant])
    for ratio in (1.0 / 3.0, 1.0 / 19.2, 1.0):
        learned, judge = (recorded(n, ratio, name) for n, name in ((20_000, "a"), (15_000, "b")))
        found = turn_load(ensemble, plant, [learned], judge)
        assert found is not None
        assert found.ratio == pytest.approx(ratio, rel=5e-3)
        assert found.rms == pytest.approx(0.4 / np.sqrt(2.0), rel=0.15)
    # a current limit keeps the speed back by far more, and is no load
    limited = learned.y.copy()
    for begin in range(1000, len(limited), 2000):
        limited[begin : begin + 60] -= 2000.0 * np.hanning(60)
    again = turn_load(ensemble, plant, [replace(learned, y=limited)], judge)
    assert again is not None
    assert again.rms == pytest.approx(0.4 / np.sqrt(2.0), rel=0.15)
    noise = replace(learned, y=core.simulate(learned.u[:, None], np.zeros(core.na)))
    noise = replace(noise, y=noise.y + rng.normal(0.0, 5.0, len(noise)))
    assert turn_load(ensemble, plant, [noise], replace(judge, y=noise.y[:15_000])) is None


def test_a_machine_of_ones_own_is_a_few_lines() -> None:
    class Lag:
        counts = 0.0
        angle = speed = 0.0

        def reset(self) -> None:
            self.angle = self.speed = self.counts = 0.0

        def step(self, u: float) -> None:
            self.speed += 0.01 * (100.0 * u - self.speed)
            self.angle += self.speed / 60.0 * 1e-3
            self.counts = float(np.floor(self.angle * 1000.0))

    on = SteppedBench(Lag(), Ts=1e-3, counts_per_rev=1000.0, volt=10.0)
    recording = on.excite(np.full(1000, 20.0), "beyond")
    assert recording.u.max() == 10.0
    assert recording.y[-1] == pytest.approx(1000.0, rel=0.05)
    assert recording.speed_true is None
    controller = Controller(gains=Gains.standard(0.05, 0.05), u_min=-10.0, u_max=10.0)
    found = on.follow(controller, np.full(1000, 500.0), "hold")
    assert np.median(found.y[-100:]) == pytest.approx(500.0, rel=0.05)
    np.testing.assert_array_equal(found.u, found.recording.u)
