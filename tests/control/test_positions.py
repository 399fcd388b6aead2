"""Position loops: stops at an angle and moves, on models, machines and on the command line."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lags import PI, RAMP, drive
from refusals import refuses
from sewfast import (
    DataError,
    Feedforward,
    LinkError,
    ModelFileError,
    PositionController,
    SettingError,
    StateFeedback,
    VirtualMachine,
    follow_positions,
    load_controller,
    run,
    stop_at,
    tune,
)
from sewfast.cli import main
from sewfast.commissioning import SteppedBench
from sewfast.control.stops import position_of

LEVELS = ((-3000.0, -6.6), (-1.0, -0.5), (0.0, 0.0), (1.0, 0.5), (3000.0, 6.6))
SPEED = replace(PI, feedforward=Feedforward(8, 0.5, LEVELS, (0.05,) * 8))
RATES = ((0.0, 15e3, 15e3), (2000.0, 15e3, 18e3))
LAW = PositionController(
    SPEED, gain=20.0, fastest=4000.0, rates=RATES, share=0.9, smoothing=4, landing=10.0, creep=15.0
)


class Counted:
    """A virtual machine that shows its counts and nothing else."""

    def __init__(self, **options: Any) -> None:
        self.machine = VirtualMachine(**options)
        self.lost: int | None = None
        self.steps = 0

    @property
    def counts(self) -> float:
        return math.nan if self.steps == self.lost else float(self.machine.counts)

    def reset(self) -> None:
        self.machine.reset()
        self.steps = 0

    def step(self, u: float) -> None:
        self.steps += 1
        self.last = u
        self.machine.step(u)


def bench(machine: Counted | None = None, **options: Any) -> SteppedBench:
    return SteppedBench(machine or Counted(), 0.001, 1572.0, 20.0, **options)


@pytest.mark.parametrize("way", ["onward", "shortest"])
@pytest.mark.parametrize("speed", [-1500.0, 0.0, 700.0, 3000.0])
def test_a_machine_stops_at_an_angle(speed: float, way: Any) -> None:
    found = stop_at(LAW, VirtualMachine(), "90deg", speed=speed, way=way, after=2.0)
    m = found.metrics()
    assert abs(m["counts_off"] or 0.0) <= 2.0
    assert (found.goal[-1] - 393.0) % 1572.0 == 0.0
    assert m["rest_counts"] is not None
    assert m["rest_counts"] <= 1.0
    assert m["off"] == pytest.approx(0.0, abs=0.5)
    moved = np.diff(found.place[found.start :])
    if way == "onward":
        forwards = speed >= 0.0
        assert np.all(moved >= -1e-6 if forwards else moved <= 1e-6), "it turned back"
    else:
        assert m["turns"] is not None
        assert m["turns"] < 6.0
    assert "0.000 turns" not in str(found)
    assert "stop at 90deg from" in str(found)


def test_the_same_bits_on_a_model_a_machine_and_sample_by_sample() -> None:
    own = stop_at(LAW, VirtualMachine(), ".4turns", speed=2000.0)
    stepped = stop_at(LAW, bench(), ".4turns", speed=2000.0)
    for name in ("u", "counts", "place", "goal"):
        np.testing.assert_array_equal(getattr(own, name), getattr(stepped, name))
    goals = np.repeat([0.0, 90.0, -20.0], [50, 400, 400])
    own, stepped = (
        follow_positions(LAW, on, goals, unit="deg") for on in (VirtualMachine(), bench())
    )
    for name in ("u", "counts", "place", "goal"):
        np.testing.assert_array_equal(getattr(own, name), getattr(stepped, name))


def test_goals_in_every_unit_are_gone_to() -> None:
    goals = np.repeat([0.0, 0.5], [100, 900])
    runs = [
        follow_positions(LAW, VirtualMachine(), goals * factor, unit=unit)
        for unit, factor in (("turns", 1.0), ("deg", 360.0), ("rad", 2 * np.pi), ("counts", 1572.0))
    ]
    for one in runs:
        np.testing.assert_allclose(one.goal, runs[0].goal, atol=1e-9)
        assert abs(one.counts[-1] - 786.0) <= 1.0
    assert runs[1].metrics()["off"] == pytest.approx(
        360.0 * (runs[0].metrics()["off"] or 0.0), abs=0.05
    )


def test_an_s_curve_is_followed_as_it_is() -> None:
    # 3 turns within the rates
    t = np.clip((np.arange(1200) - 100) * 1e-3 / 0.8, 0.0, 1.0)
    turns = 3.0 * t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
    found = follow_positions(LAW, VirtualMachine(), turns, unit="turns")
    ahead, speed = found.place - 1572.0 * turns, np.gradient(1572.0 * turns)
    # rounded by the mean of the profile only, and in time [samples]
    assert np.max(np.abs(ahead)) < 3.0
    assert abs(ahead @ speed / (speed @ speed)) < 0.1
    assert (found.metrics()["rms"] or 1.0) < 0.05


def changed(**factors: float) -> VirtualMachine:
    own = VirtualMachine().parameters
    return VirtualMachine(
        parameters={**own, **{name: own[name] * f for name, f in factors.items()}}
    )


@pytest.mark.parametrize("speed", [-3500.0, 3500.0])
def test_a_shaft_that_brakes_less_goes_on_to_a_later_turn(speed: float) -> None:
    # what the virtual machine can do, for which its command comes near its limit
    own = replace(SPEED, feedforward=Feedforward(8, 0.5, LEVELS, (0.068,) * 8))
    rates = ((0.0, 24e3, 24e3), (2000.0, 22e3, 25e3))
    law = replace(LAW, speed=own, rates=rates, share=0.95, landing=40.0)
    able = stop_at(law, VirtualMachine(), "90deg", speed=speed, after=2.0)
    assert np.ptp(able.goal[able.start :]) == 0.0
    found = stop_at(law, changed(inertia=1.25), "90deg", speed=speed, after=4.0)
    goals, way = found.goal[found.start :], math.copysign(1.0, speed)
    later = way * (goals[-1] - goals[0])
    assert later >= 1572.0
    assert later % 1572.0 == 0.0
    assert "went on to a later turn" in found.warnings[0]
    beyond = way * found.position[found.start :]
    assert np.max(np.maximum.accumulate(beyond) - beyond) < 1572.0 / 8.0
    assert abs(found.counts[-1] - goals[-1]) <= 2.0


def test_a_shaft_that_cannot_be_stopped_as_planned_goes_on_once() -> None:
    for heavy in (2.0, 6.0):
        found = stop_at(LAW, changed(inertia=heavy), "90deg", speed=3500.0, after=8.0)
        goals = found.goal[found.start :]
        assert np.count_nonzero(np.diff(goals)) == 1
        # a loop with six times its inertia swings
        assert abs(found.counts[-1] - goals[-1]) <= (2.0 if heavy == 2.0 else 3.0 * 1572.0)


def test_a_stop_takes_little_more_than_the_way_to_brake() -> None:
    speed = 3000.0
    # 13,500 RPM/s below 2,000 RPM, 16,200 above
    least = (2000.0**2 / 13.5e3 + (speed**2 - 2000.0**2) / 16.2e3) / 120.0
    beyond = []
    for angle in range(0, 360, 30):
        m = stop_at(LAW, VirtualMachine(), f"{angle}deg", speed=speed, after=2.0).metrics()
        assert m["turns"] is not None
        beyond.append(m["turns"] - least)
    # 2 samples, a tenth of a turn, more if it began when the preview is over
    assert min(beyond) < 0.6
    assert max(beyond) < 1.5


def test_it_holds_against_a_load_or_lets_go() -> None:
    held = stop_at(LAW, drive(), "0deg", speed=0.0, after=2.0, disturbance=np.full(2501, 1.0))
    assert abs(held.metrics()["counts_off"] or 0.0) <= 1.0
    assert held.u[-1] == pytest.approx(-1.0, abs=0.2)
    released = stop_at(LAW, VirtualMachine(), "90deg", speed=1000.0, after=2.0, release=True)
    assert released.u[-1] == 0.0
    assert abs(released.metrics()["counts_off"] or 0.0) <= 2.0
    goals = np.repeat([1.0, 0.5], 1500)
    taken_up = follow_positions(LAW, VirtualMachine(), goals, unit="turns", release=True)
    assert taken_up.u[1400] == taken_up.u[-1] == 0.0
    assert abs(taken_up.metrics()["counts_off"] or 0.0) <= 2.0


def test_a_file_holds_everything(tmp_path: Path) -> None:
    LAW.save(tmp_path / "position.json")
    assert load_controller(tmp_path / "position.json") == LAW
    PI.save(tmp_path / "speed.json")
    assert load_controller(tmp_path / "speed.json") == PI
    text = (tmp_path / "position.json").read_text().replace('"share"', '"portion"')
    (tmp_path / "wrong.json").write_text(text)
    with pytest.raises(ModelFileError):
        load_controller(tmp_path / "wrong.json")


def test_what_cannot_be_is_refused_by_name() -> None:
    machine = VirtualMachine()
    states = StateFeedback.from_model(drive(), counts_per_rev=1572.0)
    with refuses(SettingError, name="controller"):
        stop_at(PI, machine, "90deg")  # type: ignore[arg-type]
    with refuses(SettingError, name="controller"):
        run(LAW, machine, RAMP)
    with refuses(SettingError, name="file"):
        stop_at(LAW, machine, "90deg", file="stop.mcap")
    with refuses(SettingError, name="controller"):
        tune(drive(), controller="position")
    with refuses(SettingError, name="counts_per_rev"):
        tune(drive(), loop="position", counts_per_rev=None)
    with refuses(SettingError, name="loop"):
        tune(drive(), loop="angle")  # type: ignore[arg-type]
    with refuses(SettingError, name="controller"):
        PositionController(states, gain=20.0, fastest=4000.0, rates=RATES)  # type: ignore[arg-type]
    with refuses(SettingError, name="speed"):
        replace(LAW, speed=replace(SPEED, counts_per_rev=None))
    for angle in ("90", "ninety deg", "deg"):
        with refuses(SettingError, name="position"):
            stop_at(LAW, machine, angle)
    with refuses(SettingError, name="unit"):
        stop_at(LAW, machine, "90mm")
    with refuses(SettingError, name="speed"):
        stop_at(LAW, machine, "90deg", speed=4500.0)
    with refuses(SettingError, name="way"):
        stop_at(LAW, machine, "90deg", way="back")  # type: ignore[arg-type]
    with refuses(SettingError, name="on"):
        stop_at(LAW, SteppedBench(Counted(), 0.001, 4096.0, 20.0), "90deg")
    with refuses(SettingError, name="disturbance"):
        stop_at(LAW, machine, "90deg", disturbance=np.ones(9))
    with refuses(SettingError, name="share"):
        replace(LAW, share=1.2)
    for bad in ({"gain": 0.0}, {"gain": math.nan}, {"smoothing": 40}, {"fastest": -1.0},
                {"landing": -1.0},
        {"creep": 0.0},
        {"rates": ()}, {"rates": ((1.0, 2.0, 3.0),)}):  # fmt: skip
        with pytest.raises(SettingError):
            replace(LAW, **bad)  # type: ignore[arg-type]
    for goals in ([], [math.nan], [0.0, math.inf]):
        for on in (machine, bench(Counted())):
            with refuses(DataError, name="goals"):
                follow_positions(LAW, on, goals, unit="deg")


def test_what_would_move_a_shaft_unasked_is_refused() -> None:
    machine = VirtualMachine()
    for angle in ("1e300deg", "1e400turns"):
        with refuses(SettingError, name="angle"):
            stop_at(LAW, machine, angle)
    with refuses(SettingError, name="goals"):
        follow_positions(LAW, machine, [1e30], unit="turns")
    with refuses(SettingError, name="after"):
        stop_at(LAW, machine, "90deg", after=1e12)
    with refuses(SettingError, name="reference"):
        stop_at(LAW, machine, "90deg", reference=[*np.full(300, 2000.0), 0.0])
    with refuses(SettingError, name="speed"):
        stop_at(LAW, machine, "90deg", reference=[*np.full(300, 9000.0), 2000.0])
    for load in (np.zeros(3), np.full(1500, np.nan)):
        with refuses(DataError, name="disturbance"):
            follow_positions(LAW, drive(), np.zeros(1500), unit="deg", disturbance=load)


def test_a_file_with_another_loop_inside_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "position.json"
    LAW.save(path)
    whole = json.loads(path.read_text())
    for change in ({"kind": "position"}, {"version": 99}):
        path.write_text(json.dumps(whole | {"speed": whole["speed"] | change}))
        with pytest.raises(ModelFileError):
            load_controller(path)


def test_lost_counts_and_too_much_speed_end_a_run_with_no_command() -> None:
    machine = Counted()
    machine.lost = 800
    with pytest.raises(LinkError, match="expected a number as its counts"):
        stop_at(LAW, bench(machine), "90deg", speed=1000.0)
    assert machine.last == 0.0
    machine = Counted()
    with pytest.raises(LinkError):
        stop_at(LAW, bench(machine, speed=900.0), "90deg", speed=1500.0)
    assert machine.last == 0.0


def test_positions_are_read_with_their_units() -> None:
    assert position_of(" -90 ° ") == (-90.0, "deg")
    assert position_of("1.5e1counts") == (15.0, "counts")
    assert position_of(".25rev") == (0.25, "rev")


def test_the_pages_are_drawn(tmp_path: Path) -> None:
    found = stop_at(LAW, VirtualMachine(), "90deg", speed=1000.0, after=0.3)
    assert len(found.plot(file=tmp_path / "stop.svg")) == 4
    assert set(found.columns()) == set(found.units)


@pytest.fixture(scope="module")
def tuned() -> Any:
    return tune(drive(), [RAMP], counts_per_rev=1572.0, loop="position", evaluations=200)


def test_a_search_finds_gain_and_share_within_its_limits(tuned: Any) -> None:
    law, position = tuned.controller, tuned.position
    assert isinstance(law, PositionController)
    assert tuned.pid == law.speed
    assert law.smoothing % 2 == 0
    assert position.Ms_position <= 1.81
    assert position.passed <= 1.0
    assert position.off <= 1.5
    assert "position" in str(tuned)
    assert position.to_json()["gain"] == law.gain
    m = stop_at(law, drive(), "90deg", speed=2500.0).metrics()
    assert abs(m["counts_off"] or 0.0) <= 1.0
    assert (m["passed"] or 0.0) <= 360.0 / 1572.0


def test_a_stop_of_a_slow_drive_is_followed_until_it_rests() -> None:
    slow = drive(2.5)
    slowly = np.repeat(RAMP, 4)
    found = tune(slow, [slowly], counts_per_rev=1572.0, loop="position", evaluations=100)
    assert found.position is not None
    # it was judged while it braked, thousands of counts before its goal
    assert found.position.off <= 1.5


def test_the_command_line_tunes_stops_and_moves(
    tuned: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, law = tmp_path / "drive.json", tmp_path / "position.json"
    drive().save(model)
    tuned.controller.save(law)
    out, picture = tmp_path / "stop.csv", tmp_path / "stop.png"
    given = [
        "run",
        str(law),
        "--on",
        "virtual",
        "--stop-at",
        "90deg",
        "--speed",
        "2000",
        "--share",
        ".6",
    ]
    assert main([*given, "-o", str(out), "--plot", str(picture)]) == 0
    assert out.exists()
    assert picture.exists()
    assert "turns; passed" in capsys.readouterr().out
    moves = tmp_path / "moves.csv"
    rows = "\n".join(f"{0.001 * k:.3f},{90.0 * (k > 20)}" for k in range(500))
    moves.write_text("t [s],r [deg]\n" + rows)
    assert main(["run", str(law), str(model), "--positions", str(moves), "--json"]) == 0
    assert '"off"' in capsys.readouterr().out
    for refused, words in (
        (["--on", "virtual", "--stop-at", "90"], "with a unit"),
        (["--on", "virtual", "--stop-at", "90deg", "--speed", "9000"], "the rates of the drive"),
        (["--on", "/dev/ttyS77", "--stop-at", "90deg"], "expected -o FILE"),
        (["--on", "virtual", "--stop-at", "90deg", "--table", "a.json"], "two"),
        (["--on", "virtual", "--reference", "trapezoid"], "stop_at"),
        (["--on", "virtual", "--speed", "900"], "--speed: expected --stop-at or --positions"),
        (["--on", "virtual", "--way", "shortest", "--zero", "5"], "--way, --zero: expected"),
        (["--on", "virtual", "--stop-at", "90,5deg"], "a number with a point"),
    ):
        assert main(["run", str(law), *refused]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["run", str(law), "--on", "virtual", "--stop-at", "-45deg"])
    assert "is written --stop-at=-VALUE" in capsys.readouterr().err
