"""Faults of a record: dead sensors, computed, exchanged and late columns; and what is none."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from effort import FULL
from refusals import refuses
from sewfast import diagnose
from sewfast.dataset import Dataset, Experiment
from sewfast.dataset.faults import faults
from sewfast.errors import DataError, SettingError

SEEDS = range(40 if FULL else 4)
FAULTS = ("dead_sensor", "spike", "wraps", "no_dynamics", "exchanged", "late_input", "at_once")
Columns = tuple[np.ndarray, np.ndarray]


def steps(random: np.random.Generator, n: int, low: float = -8.0, high: float = 8.0) -> np.ndarray:
    """Levels between `low` and `high`, held 20 to 200 samples each."""
    u = [np.full(random.integers(20, 200), random.uniform(low, high)) for _ in range(n // 20)]
    return np.concatenate(u)[:n]


def drive(u: np.ndarray, *, friction: float = 0.0, pole: float = 0.97) -> np.ndarray:
    """Speed of a drive that dry friction holds at commands up to `friction`."""
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        moved = pole * y[k - 1] + 100.0 * (1.0 - pole) * u[k - 1]
        y[k] = moved - np.sign(moved) * min(abs(moved), 100.0 * (1.0 - pole) * friction)
    return y


def found(u: np.ndarray, y: np.ndarray) -> list[str]:
    diagnosis = diagnose(Dataset.from_arrays(u, y, 0.01))
    return [f.kind for f in diagnosis.findings if f.kind in FAULTS]


def rounded(y: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """With noise and the steps of an encoder, of three sizes each."""
    noise, step = random.choice([0.0, 0.3, 3.0]), random.choice([0.0, 1.0, 20.0])
    y = y + noise * random.normal(size=len(y))
    return np.round(y / step) * step if step else y


# --- what is no fault -----------------------------------------------------------------------------


def rests_first(random: np.random.Generator) -> Columns:
    u = steps(random, 4000)
    u[: random.integers(200, 2500)] = 0.0
    return u, drive(u)


def rests_last(random: np.random.Generator) -> Columns:
    u = steps(random, 4000)
    u[random.integers(1500, 3500) :] = 0.0
    y = drive(u)
    return u, np.where(np.abs(y) < 0.5, 0.0, y)


def stalls(random: np.random.Generator) -> Columns:
    t = np.arange(4000)
    u = 8.0 * t / 4000 * np.sin(2.0 * np.pi * t / random.integers(60, 300))
    return u, drive(u, friction=2.0)


def saturates(random: np.random.Generator) -> Columns:
    u = steps(random, 4000)
    return u, np.clip(drive(u), -300.0, 300.0)


def dead_zone(random: np.random.Generator) -> Columns:
    u = steps(random, 4000, 0.0, 10.0)
    return u, drive(np.maximum(u - random.uniform(2.0, 7.0), 0.0))


def coarse_thermometer(random: np.random.Generator) -> Columns:
    u, y, now, on = np.zeros(4000), np.zeros(4000), 20.0, 1.0
    for k in range(4000):
        on = float(now < (40.0 if k < 2000 else 42.0)) if k % 20 == 0 else on
        u[k], y[k] = 100.0 * on, now
        now += (20.0 + 0.5 * u[k] - now) * 0.002
    return u, np.round(y / 0.5) * 0.5


def end_stop(random: np.random.Generator) -> Columns:
    u, y = steps(random, 4000, -3.0, 3.0), np.zeros(4000)
    for k in range(1, 4000):
        y[k] = np.clip(y[k - 1] + 0.1 * u[k - 1], -40.0, 40.0)
    return u, y


def plain(random: np.random.Generator) -> Columns:
    u = steps(random, 4000)
    return u, rounded(drive(u), random)


def noisy_input(random: np.random.Generator) -> Columns:
    u = steps(random, 4000) + random.normal(size=4000)
    return u, rounded(drive(u), random)


def in_a_loop(random: np.random.Generator) -> Columns:
    u, y, r = np.zeros(4000), np.zeros(4000), steps(random, 4000, -200.0, 200.0)
    noise = random.normal(size=4000)
    for k in range(1, 4000):
        y[k] = 0.97 * y[k - 1] + 3.0 * u[k - 1]
        u[k] = 0.05 * (r[k] - y[k] - noise[k])
    return u, y + noise


def dead_time(random: np.random.Generator) -> Columns:
    u = steps(random, 4000)
    return u, drive(np.concatenate([np.zeros(60), u[:-60]])) + random.normal(size=4000)


def in_a_loop_with_dead_time(random: np.random.Generator) -> Columns:
    u, y, r = np.zeros(4000), np.zeros(4000), steps(random, 4000, -200.0, 200.0)
    noise = random.normal(size=4000)
    for k in range(60, 4000):
        y[k] = 0.97 * y[k - 1] + 3.0 * u[k - 60]
        u[k] = 0.01 * (r[k] - y[k] - noise[k])
    return u, y + noise


def cuts_low_flow(random: np.random.Generator) -> Columns:
    """A meter that shows nothing below some flow, as many do."""
    u = steps(random, 4000, 0.0, 10.0)
    flow = drive(u, pole=0.9) + 3.0 * random.normal(size=4000)
    return u, np.where(flow < random.uniform(50.0, 400.0), 0.0, flow)


def dead_time_from_rest(random: np.random.Generator) -> Columns:
    u = steps(random, 4000)
    delay = int(random.integers(60, 250))
    return u, 20.0 + drive(np.concatenate([np.zeros(delay), u[:-delay]]))


SOUND = [
    rests_first, rests_last, stalls, saturates, dead_zone, coarse_thermometer, end_stop, plain,
    noisy_input, in_a_loop, dead_time,
    in_a_loop_with_dead_time, cuts_low_flow, dead_time_from_rest,
]  # fmt: skip


@pytest.mark.parametrize("record", SOUND)
def test_nothing_is_accused_falsely(record: object) -> None:
    for seed in SEEDS:
        assert found(*record(np.random.default_rng(seed))) == [], seed


@pytest.mark.parametrize("seed", [24, 45, 99])
def test_one_bump_into_an_end_stop_is_no_late_command(seed: int) -> None:
    assert found(*end_stop(np.random.default_rng(seed))) == []


# --- a sensor that died ---------------------------------------------------------------------------


@pytest.mark.parametrize("frozen", [False, True])
def test_a_dead_sensor_is_named_by_its_samples(frozen: bool) -> None:
    missed = 0
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        u = steps(random, 4000)
        y = rounded(drive(u, friction=random.choice([0.0, 0.5])), random)
        length = int(random.integers(1500, 2400))
        first = int(random.integers(400, 4000 - length))
        y[first : first + length] = y[first] if frozen else 0.0
        finding = diagnose(Dataset.from_arrays(u, y, 0.01)).find("dead_sensor")
        if finding is None:
            # by chance the input has few levels there, or the rest is in pieces
            missed += 1
            continue
        # a coarse output stands still before and after, as long as a step of the input
        assert first - 200 < finding.evidence["first"] <= first + 1, seed
        assert first + length - 1 <= finding.evidence["last"] < first + length + 200, seed
        assert "--mask" in finding.remedy
    assert missed <= len(SEEDS) // 20


@pytest.mark.parametrize("frozen", [False, True])
def test_a_dead_sensor_of_a_plant_that_no_linear_model_describes_is_named(frozen: bool) -> None:
    """Its sensor has noise elsewhere: the model of the rest need not say anything."""
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        u = np.repeat(random.uniform(-8.0, 8.0, 150), 4)
        y = np.abs(drive(u, friction=1.0, pole=0.9)) + random.normal(size=600)
        y[250:450] = y[250] if frozen else 0.0
        finding = diagnose(Dataset.from_arrays(u, y, 0.01)).find("dead_sensor")
        assert finding is not None, seed
        assert (finding.evidence["first"], finding.evidence["last"]) == (250.0, 450.0)


def test_identify_leaves_a_dead_stretch_out(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    u = steps(random, 4000)
    y = drive(u) + 0.5 * random.normal(size=4000)
    y[2000:] = y[2000]
    data = Dataset.from_arrays(u, y, 0.01)
    model = api.identify(data, model="arx", na=1, nb=1)
    assert any("left out" in note for note in model.training["notes"])
    assert model.core.theta[1] == pytest.approx(3.0, rel=0.05)
    api.write_table(tmp_path / "x.csv", {"t": 0.01 * np.arange(4000), "u": u, "y": y})
    said = sewfast(tmp_path, "identify", "x.csv", "--model", "arx", "-o", "m.json").out
    assert said.count("in samples 2000:4000, 50% of the record") == 1
    assert "of data not trained on (rmse 0.5" in said
    options = ("--speed-unit", "rpm", "--structure", "delay,coulomb", "--json")
    motor = sewfast(tmp_path, "physics", "x.csv", *options)
    assert "in samples 2000:4000" in motor.err
    assert "left out" in motor.err
    k_v = motor.json()["parameters"]["k_v"]["value"]
    assert k_v == pytest.approx(30.0 / (100.0 * np.pi), rel=0.01)


# --- values that no plant has ---------------------------------------------------------------------


@pytest.mark.parametrize(("value", "count"), [(1e12, 1), (-32768.0, 1), (65535.0, 3)])
def test_identify_leaves_a_spike_out(value: float, count: int) -> None:
    random = np.random.default_rng(1)
    u = steps(random, 3000)
    y = drive(u) + random.normal(size=len(u))
    y[1234 : 1234 + count] = value
    assert found(u, y) == ["spike"]
    model = api.identify(Dataset.from_arrays(u, y, 0.01), model="oe")
    assert model.training["verdict"]["fit_percent"] > 98.0
    assert any(f"in samples 1234:{1234 + count}" in note for note in model.training["notes"])


def test_what_is_no_spike() -> None:
    random = np.random.default_rng(2)
    u = np.zeros(400)
    u[200] = 1e3
    blow = drive(u, pole=0.1)
    assert found(u, blow) == []
    early = np.full(400, 5.0)
    early[:2] = 0.0
    step = drive(early, pole=0.05) + 0.1 * random.normal(size=400)
    assert found(early, step) == []
    assert found(early[::-1], step[::-1]) == []


def test_an_integer_that_wraps_is_refused_by_name() -> None:
    random = np.random.default_rng(3)
    u = 3.0 + steps(random, 4000, -1.0, 1.0)
    counts = np.floor(np.cumsum(drive(u)))
    wrapped = (counts + 32768) % 65536 - 32768
    assert found(u, wrapped) == ["wraps"]
    with refuses(DataError, received="jumps back by 65536", remedy="np.unwrap"):
        api.identify(Dataset.from_arrays(u, wrapped, 0.01))
    assert "wraps" not in found(u, np.unwrap(wrapped, period=65536))


def test_a_number_times_an_input_of_two_levels_is_no_plant() -> None:
    random = np.random.default_rng(4)
    u = np.repeat(random.choice([-5.0, 5.0], 150), 20)
    assert found(u, 100.0 * u) == ["no_dynamics"]
    step = np.repeat([0.0, 1.0], 200)
    assert found(step, 3.0 * step) == ["no_dynamics"]
    # what settles in a sample
    assert found(step, np.concatenate([[0.0], 3.0 * step[:-1]])) == []


# --- columns --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gain", "delay"), [(1.0, 0), (100.0, 0), (-0.25, 3)])
def test_a_computed_column_is_refused(gain: float, delay: int) -> None:
    u = drive(steps(np.random.default_rng(0), 3000))
    y = gain * np.roll(u, delay) + 2.0
    data = Dataset.from_arrays(u[10:], y[10:], 0.01)
    assert found(u[10:], y[10:]) == ["no_dynamics"]
    for refused_by in (api.identify, partial(api.physics, speed_unit="rpm")):
        with refuses(DataError, expected="answers the input", received="read twice"):
            refused_by(data)


@pytest.mark.parametrize("noise", [0.0, 2.0, 20.0])
def test_exchanged_columns_are_refused(tmp_path: Path, noise: float) -> None:
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        u = steps(random, 4000)
        y = drive(u) + noise * random.normal(size=4000)
        assert found(u, y) == []
        assert found(y, u) == ["exchanged"], seed
    api.write_table(tmp_path / "x.csv", {"t": 0.01 * np.arange(4000), "u": y, "y": u})
    for command in ("identify", "physics"):
        assert "are exchanged; take y as input" in refused(tmp_path, command, "x.csv")


@pytest.mark.parametrize("late", [2, 3, 5])
def test_a_late_command_is_found_and_shifted(tmp_path: Path, late: int) -> None:
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        u = steps(random, 3000)
        y = drive(u, pole=0.9) + random.choice([0.3, 3.0]) * random.normal(size=3000)
        data = Dataset.from_arrays(u[:-late], y[late:], 0.01)
        logged = Dataset.from_arrays(np.roll(u, late)[late:], y[late:], 0.01)
        finding = diagnose(logged).find("late_input")
        assert finding is not None, seed
        assert finding.evidence["shift"] == late
        shifted = logged.shift_inputs(late)
        np.testing.assert_array_equal(shifted.experiments[0].u[:, 0], u[late:-late])
        assert diagnose(shifted).find("late_input") is None
        assert len(data) == len(shifted) + late
    e = logged.experiments[0]
    api.write_table(tmp_path / "x.csv", {"t": 0.01 * np.arange(len(e)), "u": e.u[:, 0], "y": e.y})
    assert f"--shift-input {late}" in sewfast(tmp_path, "look", "x.csv").out
    fit = ("identify", "x.csv", "--model", "arx", "-o", "m.json")
    said = sewfast(tmp_path, *fit).out
    assert f"verdict: not good enough to tune a controller on: y moves {late - 1}" in said
    assert f"logged {late} samples late" in said
    assert "samples late" not in sewfast(tmp_path, *fit, "--shift-input", str(late)).out


@pytest.mark.parametrize("ending", ["csv", "npz", "mcap"])
def test_a_recording_of_the_package_is_not_said_to_be_late(tmp_path: Path, ending: str) -> None:
    """Its speed is smoothed from both sides, and begins to move before the command does."""
    u = api.signals.excitation("saturating", 0)[:8000]
    recording = api.record(api.VirtualMachine(seed=1), u)
    recording.save(tmp_path / f"r.{ending}")
    data = api.read(tmp_path / f"r.{ending}", inputs="u", output="y")
    assert data.looks_ahead
    assert diagnose(data).find("late_input") is None
    y = recording.y.copy()
    y[3000:3100] = np.nan
    api.write_table(tmp_path / "gap.csv", recording.columns() | {"y": y})
    assert api.read(tmp_path / "gap.csv", inputs="u", output="y").looks_ahead
    # without the counts nothing tells it
    api.write_table(tmp_path / "x.csv", {"t": 0.001 * np.arange(8000), "u": u, "y": recording.y})
    smoothed = diagnose(api.read(tmp_path / "x.csv", inputs="u", output="y")).find("late_input")
    assert smoothed is not None
    assert "or y was smoothed with later samples" in smoothed.text
    assert "take y as it was measured" in smoothed.remedy


def test_an_answer_in_the_same_sample_says_why_it_closes_no_loop() -> None:
    random = np.random.default_rng(0)
    u = np.repeat(random.choice([-1.0, 1.0], 400), 5)
    y = np.diff(u, prepend=0.0) + 0.5 * u + 0.01 * random.normal(size=2000)
    finding = diagnose(Dataset.from_arrays(u, y, 0.01)).find("at_once")
    assert finding is not None
    assert "nk = 0" in finding.text
    assert "--nk 0" in finding.remedy


values = st.floats(width=64) | st.sampled_from(
    [0.0, 1.0, np.nan, np.inf, 1e308, -1e308, 1e150, 1e59, -1e59, 1e-60, 5e-324]
)
levels = st.lists(values, min_size=1, max_size=40)


@settings(deadline=None, max_examples=100)
@given(u=levels, y=levels, n=st.integers(1, 400), times=st.integers(1, 80))
@example(u=[0.0, 1.0], y=[1e308, -1e308], n=2, times=1)
@example(u=[0.0], y=[0.0], n=160, times=1)
@example(u=[0.0, 1e59, 1.0], y=[1.0, 5e-324, 1e-60], n=400, times=3)
def test_no_test_fails_on_any_numbers(u: list[float], y: list[float], n: int, times: int) -> None:
    once = Experiment(np.resize(np.repeat(u, times), (n, 1)), np.resize(y, n))
    still = Experiment(np.resize(u, (n, 1)), np.resize(np.repeat(y, times), n))
    data = Dataset((once, still), 0.01, ("u",), "y", ("",))
    for fault in faults(data):
        json.dumps(fault.evidence, allow_nan=False)


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, 1e308, 1e-320])
def test_a_column_that_identify_refuses_is_not_judged(spoilt: float) -> None:
    u = steps(np.random.default_rng(0), 3000)
    assert found(np.full(3000, spoilt), u) == found(u, np.full(3000, spoilt)) == []
    assert found(np.where(u > 0.0, 0.0, spoilt), np.full(3000, 1.0)) == []


def test_shifts_that_are_none() -> None:
    data = Dataset.from_arrays(np.arange(9.0), np.arange(9.0), 0.01)
    later = data.shift_inputs(-2).experiments[0]
    np.testing.assert_array_equal(later.u[:, 0], np.arange(7.0))
    np.testing.assert_array_equal(later.y, np.arange(2.0, 9.0))
    assert later.start == 2
    assert data.shift_inputs(0) is data
    for wrong in (9, 1.5, True, None):
        with refuses(SettingError, expected="whole number", received=repr(wrong)):
            data.shift_inputs(wrong)


@pytest.mark.parametrize("seed", range(3))
def test_several_spikes_of_one_size_are_one_fault(seed: int, tmp_path: Path) -> None:
    """Digits that a serial line lost: none has more power than the others together."""
    random = np.random.default_rng(seed)
    u = steps(random, 1500)
    y = drive(u) + random.normal(size=len(u))
    at = np.sort(random.choice(np.arange(10, len(u) - 10), 9, replace=False))
    y[at] = 1e6 * random.choice([-1.0, 1.0], 9)
    (fault,) = faults(Dataset.from_arrays(u, y, 0.01))
    assert {d.start for d in fault.dead} == set(at)
    assert "at 8 other places" in fault.text
    api.write_table(tmp_path / "x.csv", {"t": 0.01 * np.arange(len(u)), "u": u, "y": y})
    found = sewfast(tmp_path, "identify", "x.csv", "--model", "oe", "-o", "x.json", "--json").json()
    assert fault.text in found["training"]["notes"][0]
    assert found["scores"]["train"]["simulation"]["fit_percent"] > 90.0


@pytest.mark.parametrize("blows", [1, 2, 5, 15, 30])
@pytest.mark.parametrize("pole", [0.0, 0.4])
def test_answers_to_blows_are_no_spikes(blows: int, pole: float) -> None:
    """Pulses of one size, of a plant that has settled again after a few samples."""
    random = np.random.default_rng(blows)
    u = np.zeros(2000)
    u[60 * np.arange(1, blows + 1)] = 5.0
    y = drive(u, pole=pole) + 0.05 * random.normal(size=len(u))
    assert found(u, y) == []
    y[1990] = 1e6
    assert found(u, y) == ["spike"]


@pytest.mark.parametrize("moves", [1, 2, 5])
def test_a_copy_of_a_few_steps_is_named_and_a_plant_is_not(moves: int) -> None:
    """Nothing that is driven settles within the sample of the command."""
    u = np.repeat(np.arange(moves + 1) % 2, 80).astype(float)
    assert found(u, 100.0 * u) == ["no_dynamics"]
    assert found(u, 100.0 * np.append(0.0, u[:-1])) == []
