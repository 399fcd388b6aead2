"""The virtual machine over its public API."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sewfast.errors import DataError, SettingError
from sewfast.machine import VirtualMachine

CONVENTIONS = Path(__file__).parents[1] / "docs" / "CONVENTIONS.md"
ROW = re.compile(r"^\| `(\w+)` \| (\S+) \| (\S.*?) \| (.*?) \|", re.MULTILINE)


def documented() -> dict[str, tuple[float, str, str]]:
    text = CONVENTIONS.read_text(encoding="utf-8")
    section = text.split("## The virtual sewing machine")[1].split("\n## ")[0]
    return {
        name: (float(value), unit, spread.strip())
        for name, value, unit, spread in ROW.findall(section)
    }


def random_command(n: int = 3000, hold: int = 50, amplitude: float = 12.0) -> np.ndarray:
    levels = np.random.default_rng(4).uniform(-amplitude, amplitude, n // hold)
    return np.repeat(levels, hold)


def test_parameters_are_those_of_the_specification() -> None:
    machine, table = VirtualMachine(), documented()
    assert {name: row[0] for name, row in table.items()} == machine.parameters
    assert {name: row[1] for name, row in table.items()} == VirtualMachine.units()


def test_variants_fill_the_spread_of_the_specification() -> None:
    variants = [VirtualMachine(seed).parameters for seed in range(200)]
    for name, (nominal, _, spread) in documented().items():
        moved = np.array([variant[name] for variant in variants]) - nominal
        width = 0.0
        if spread:
            number = float(spread.removesuffix(" %"))
            width = number / 100 * abs(nominal) if spread.endswith("%") else number
        assert np.abs(moved).max() <= width + 1e-12, name
        assert np.ptp(moved) >= 1.8 * width, name


def test_gain_and_time_constants_of_the_middle_range() -> None:
    small = VirtualMachine().linearise(1500.0)
    assert small["gain"] == pytest.approx(490, rel=0.03)
    assert small["T1"] == pytest.approx(0.252, rel=0.05)
    assert small["T2"] == pytest.approx(0.0074, rel=0.1)


def test_trapezoid_of_the_paper_is_within_reach_of_20_volts_but_not_of_10() -> None:
    def time_to_3000(u_limit: float) -> int:
        speed = VirtualMachine(u_limit=u_limit).run(np.full(1000, 20.0)).speed_rpm
        return int(np.argmax(speed > 3000))

    assert 100 < time_to_3000(20.0) < 140
    assert time_to_3000(10.0) > 200


def test_run_and_step_are_the_same_machine() -> None:
    u = random_command(500)
    whole, stepped = VirtualMachine(3), VirtualMachine(3)
    run = whole.run(u)
    assert (run.counts[0], run.speed_rpm[0]) == (0.0, 0.0)
    ends = np.array([stepped.step(value) for value in u])
    np.testing.assert_array_equal(run.counts[1:], ends[:-1, 0])
    np.testing.assert_array_equal(run.speed_rpm[1:], ends[:-1, 1])
    assert (whole.counts, whole.speed_rpm) == tuple(ends[-1])


def test_goes_on_where_it_was_and_repeats_itself_after_a_reset() -> None:
    u, machine = random_command(), VirtualMachine(7)
    whole = machine.run(u)
    machine.reset()
    parts = [machine.run(part) for part in (u[:1234], u[1234:])]
    np.testing.assert_array_equal(np.concatenate([p.counts for p in parts]), whole.counts)
    np.testing.assert_array_equal(np.concatenate([p.speed_rpm for p in parts]), whole.speed_rpm)


def test_same_seed_same_machine_other_seed_another() -> None:
    u = random_command()
    first, again, other = (VirtualMachine(seed).run(u).speed_rpm for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 10


def test_angle_dependence_ripples_the_speed_and_can_be_switched_off() -> None:
    def ripple(angle_dependence: bool) -> float:
        machine = VirtualMachine(angle_dependence=angle_dependence)
        return float(np.ptp(machine.run(np.full(6000, 1.0)).speed_rpm[4500:]))

    assert 10 < ripple(True) < 60
    assert ripple(False) < 0.01


def test_quantisation_can_be_switched_off() -> None:
    u = random_command()
    whole, exact = VirtualMachine().run(u), VirtualMachine(quantisation=False).run(u)
    np.testing.assert_array_equal(whole.counts, np.floor(exact.counts + 0.5))
    turns = np.cumsum(exact.speed_rpm[:-1] + np.diff(exact.speed_rpm) / 2) * VirtualMachine.Ts / 60
    np.testing.assert_allclose(exact.counts[1:], turns * 1572, atol=0.2)
    assert VirtualMachine(parameters={"counts_per_rev": 2000}).counts_per_rev == 2000


def test_stands_still_without_a_command_and_below_its_dead_zone() -> None:
    for u in (0.0, 0.2, -0.2):
        run = VirtualMachine().run(np.full(2000, u))
        assert not run.counts.any()
        assert not run.speed_rpm.any()


def test_clips_the_command_and_limits_the_current() -> None:
    u = np.repeat([50.0, -50.0], 300)
    np.testing.assert_array_equal(
        VirtualMachine(u_limit=10).run(u).counts, VirtualMachine(u_limit=10).run(u / 5).counts
    )
    machine = VirtualMachine()
    currents = [machine.current for value in u if machine.step(value)]
    limit = machine.parameters["current_limit"]
    assert np.abs(currents).max() == limit


def test_names() -> None:
    assert VirtualMachine.from_name("virtual").parameters == VirtualMachine().parameters
    assert VirtualMachine.from_name("virtual:12").parameters == VirtualMachine(12).parameters
    assert VirtualMachine(12).name == "virtual:12"
    assert VirtualMachine.from_name(VirtualMachine(12).name).name == "virtual:12"


@pytest.mark.parametrize("name", ["", "virtual:", "virtual:x", "virtual:-1", "virtual:1.5", "real"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(SettingError, match="virtual:SEED"):
        VirtualMachine.from_name(name)


@pytest.mark.parametrize("seed", [-1, 2**64, 1.5, True, "1"])
def test_unusable_seeds_are_refused(seed: object) -> None:
    with pytest.raises(SettingError, match="seed"):
        VirtualMachine(seed)  # type: ignore[arg-type]


@given(
    name=st.sampled_from(sorted(VirtualMachine.units())),
    bad=st.sampled_from([math.nan, math.inf, -1e30, "x"]),
)
@settings(max_examples=60, deadline=None)
def test_unusable_parameters_are_refused_by_name(name: str, bad: float) -> None:
    with pytest.raises(SettingError, match=name):
        VirtualMachine(parameters={name: bad})


def test_unknown_parameters_are_refused_with_the_known_ones() -> None:
    with pytest.raises(SettingError, match=r"'mass'.*inertia"):
        VirtualMachine(parameters={"mass": 1.0})


@pytest.mark.parametrize("u", [np.ones((3, 1)), 1.0, "volt", [1.0, math.nan], [math.inf]])
def test_unusable_commands_are_refused(u: object) -> None:
    with pytest.raises(DataError, match="expected"):
        VirtualMachine().run(u)  # type: ignore[arg-type]


def test_a_refused_command_leaves_the_machine_as_it_was() -> None:
    machine = VirtualMachine()
    machine.run(np.full(500, 5.0))
    before = (machine.counts, machine.speed_rpm, machine.current)
    with pytest.raises(DataError):
        machine.run(np.append(np.full(500, 5.0), np.nan))
    with pytest.raises(DataError):
        machine.step(math.nan)
    assert (machine.counts, machine.speed_rpm, machine.current) == before


def test_other_dtypes_and_strides_are_taken_and_an_empty_run_is_empty() -> None:
    u = np.arange(200, dtype=np.int64)[::-2] % 7
    np.testing.assert_array_equal(
        VirtualMachine().run(u).counts, VirtualMachine().run(u.astype(float)).counts
    )
    assert VirtualMachine().run([]).counts.shape == (0,)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=200))
@settings(max_examples=50, deadline=None)
def test_any_finite_command_gives_a_finite_run(u: list[float]) -> None:
    run = VirtualMachine(1).run(np.repeat(u, 5))
    assert np.isfinite(run.speed_rpm).all()
    assert (np.abs(run.speed_rpm) < 11_000).all()
    np.testing.assert_array_equal(run.counts, np.round(run.counts))


def test_a_load_slows_the_machine_and_comes_off_again() -> None:
    machine = VirtualMachine()
    free = machine.run(np.full(2000, 4.0)).speed_rpm[-1]
    machine.set_load(0.1)
    assert machine.run(np.full(2000, 4.0)).speed_rpm[-1] < free - 100.0
    machine.set_load(0.0)
    assert machine.run(np.full(2000, 4.0)).speed_rpm[-1] == pytest.approx(free, abs=25.0)
    with pytest.raises(SettingError, match="finite load"):
        machine.set_load(math.inf)


def test_a_second_mass_swings_behind_the_shaft() -> None:
    machine = VirtualMachine(load_inertia=1e-3, stiffness=150.0, damping=0.0)
    stiff = VirtualMachine(parameters={"inertia": 3e-3})
    step = np.full(1500, 4.0)
    swinging, rigid = machine.run(step).speed_rpm, stiff.run(step).speed_rpm
    assert abs(swinging[-1] / rigid[-1] - 1.0) < 0.05
    late = swinging[200:400] - rigid[200:400]
    spectrum = np.abs(np.fft.rfft(late * np.hanning(200), 4096))
    hertz = np.fft.rfftfreq(4096, 1e-3)
    assert hertz[10:][spectrum[10:].argmax()] == pytest.approx(75.5, abs=3.0)
    assert machine.linearise(1500.0)["T1"] == pytest.approx(stiff.linearise(1500.0)["T1"])


def test_a_machine_is_made_again_from_its_name() -> None:
    for machine in (
        VirtualMachine(),
        VirtualMachine(3),
        VirtualMachine(2, load_inertia=1e-3, backlash=0.01),
        VirtualMachine(parameters={"inertia": 4e-3}),
    ):
        again = VirtualMachine.from_name(machine.name)
        assert again.parameters == machine.parameters
        assert again.name == machine.name
    for wrong in (
        "virtual?",
        "virtual?inertia",
        "virtual?inertia=x",
        "virtual?mass=1",
        "virtual:?",
    ):
        if wrong == "virtual?":
            assert VirtualMachine.from_name(wrong).name == "virtual"
            continue
        with pytest.raises(SettingError):
            VirtualMachine.from_name(wrong)
