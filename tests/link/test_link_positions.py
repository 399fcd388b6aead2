"""Positions on a device: goals, stops at an angle and its limits of the position, over a pty."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lags import PI
from link_device import ScriptedDevice
from link_kept import Kept
from sewfast import (
    Feedforward,
    LinkError,
    PositionController,
    Recording,
    SettingError,
    VirtualMachine,
    follow_positions,
    stop_at,
)
from sewfast.cli import main
from sewfast.commissioning.positions import Stop, telling
from sewfast.control.position import Playing
from sewfast.link import Plan, VirtualDevice, connect, wire
from sewfast.link.wire import Kind
from sewfast.recordfile import read_recording

LEVELS = ((-3000.0, -6.6), (-1.0, -0.5), (0.0, 0.0), (1.0, 0.5), (3000.0, 6.6))
SPEED = replace(PI, feedforward=Feedforward(8, 0.5, LEVELS, (0.05,) * 8))
RATES = ((0.0, 15e3, 15e3), (2000.0, 15e3, 18e3))
LAW = PositionController(
    SPEED, gain=20.0, fastest=4000.0, rates=RATES, share=0.9, smoothing=4, landing=10.0, creep=15.0
)
GENTLE = replace(LAW, share=0.3)
GOALS = np.repeat([0.0, 0.75, -0.5], [50, 700, 800])  # turns


def require_same_bits(playing: Playing, r: np.ndarray, u: np.ndarray, counts: np.ndarray) -> None:
    """The law in single precision over the counts gives the commands, and the simulated machine
    under these commands the counts: the closed loop is that of the simulation, bit by bit.
    """
    wanted, *_ = playing.core().single(playing.early(r), counts)
    scaled = np.asarray(wanted, dtype=np.float32) * np.float32(1000.0)
    # as the device rounds: halves away from 0
    steps = np.trunc(scaled + np.copysign(np.float32(0.5), scaled))
    np.testing.assert_array_equal(np.round(1000.0 * u), steps)
    # as the device applies them: steps in single precision
    applied = (steps.astype(np.float32) / np.float32(1000.0)).astype(np.float64)
    machine = VirtualMachine()
    machine.reset()
    np.testing.assert_array_equal(machine.run(applied).counts, counts - counts[0])


@pytest.mark.parametrize(
    ("speed", "way"), [(2000.0, "onward"), (-900.0, "shortest"), (0.0, "onward")]
)
def test_a_stop_on_a_device_is_the_simulations_bit_by_bit(speed: float, way: Any) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        there = stop_at(LAW, drive, "90deg", speed=speed, way=way, after=1.5)
    here = stop_at(LAW, VirtualMachine(), "90deg", speed=speed, way=way, after=1.5)
    stop = (there.start, 393.0, 1572.0, way == "onward")
    r = np.where(np.isnan(there.r), speed, there.r)
    require_same_bits(Playing.of(LAW, stop=stop), r, there.u, there.counts)
    # double precision decides as single precision does
    np.testing.assert_array_equal(there.goal, here.goal)
    assert np.abs(there.counts - here.counts).max() <= 3.0
    np.testing.assert_allclose(there.place, here.place, atol=1.0)
    assert abs(there.metrics()["counts_off"] or 0.0) <= 2.0
    assert there.goal[-1] % 1572.0 == 393.0


@pytest.mark.parametrize("fast", [True, False])
def test_a_stop_that_is_asked_for_in_mid_run_is_the_laws_bit_by_bit(
    fast: bool, tmp_path: Path
) -> None:
    asked = []

    def pedal(first: int, u: Any, counts: Any) -> None:
        if first > 300 and not asked:
            asked.append(first)
            with pytest.raises(SettingError, match="angle: expected a place within"):
                drive.stop_at("5e6counts")
            drive.stop_at("180deg")
            with pytest.raises(SettingError, match="asked for already"):
                drive.stop_at("180deg")

    reference, file = np.minimum(8.0 * np.arange(1200), 1500.0), tmp_path / "stop.mcap"
    with VirtualDevice(fast=fast) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        there = stop_at(LAW, drive, "90deg", reference=reference, watch=pedal, file=file)
        with pytest.raises(SettingError, match="received no run"):
            drive.stop_at("90deg")
    assert asked[0] < there.start < 1200
    assert there.name == f"stop at 90deg, asked for at sample {there.start}"
    playing = Playing.of(LAW, stop=(there.start, 786.0, 1572.0, True))
    # what came after the stop had been asked for has no effect
    require_same_bits(playing, np.append(reference, np.zeros(1000)), there.u, there.counts)
    assert there.goal[-1] % 1572.0 == 786.0
    (event,) = (e for e in read_recording(file).events if e["kind"] == "stop_at")
    assert event["index"] == there.start


def test_a_stop_in_mid_run_needs_a_run_before_its_own_stop() -> None:
    refused: list[str] = []

    def ask(first: int, u: Any, counts: Any) -> None:
        with pytest.raises(SettingError) as found:
            drive.stop_at("90deg")
        refused.append(str(found.value))

    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        for angle, way in (("90", "onward"), ("90deg", "back")):
            with pytest.raises(SettingError):
                drive.stop_at(angle, way=way)  # type: ignore[arg-type]
        found = stop_at(LAW, drive, "90deg", reference=np.zeros(20), after=0.3, watch=ask)
        assert found.start == 20
        follow_positions(LAW, drive, np.zeros(100), unit="counts", watch=ask)
    assert "begins its own stop" in refused[0]
    assert "a run without one" in refused[-1]


def test_goals_on_a_device_are_followed_bit_by_bit() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        there = follow_positions(LAW, drive, GOALS, unit="turns")
        # once more: each run begins at 0, though the counter goes on
        again = follow_positions(GENTLE, drive, GOALS, unit="turns", release=True)
    here = follow_positions(LAW, VirtualMachine(), GOALS, unit="turns")
    require_same_bits(Playing.of(LAW), there.r, there.u, there.counts)
    require_same_bits(Playing.of(GENTLE, releases=True), again.r, again.u, again.counts)
    np.testing.assert_array_equal(there.goal, here.goal)
    assert np.abs(there.counts - here.counts).max() <= 3.0


def test_a_volt_limit_of_the_device_is_the_loops() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=9.0, speed_rpm=4000.0)
        there = stop_at(GENTLE, drive, "90deg", speed=1500.0, after=2.0)
    assert np.abs(there.u).max() <= 9.0
    speed = replace(SPEED, u_min=-9.0, u_max=9.0)
    stop = (there.start, 393.0, 1572.0, True)
    playing = Playing.of(replace(GENTLE, speed=speed), stop=stop)
    r = np.where(np.isnan(there.r), 1500.0, there.r)
    require_same_bits(playing, r, there.u, there.counts)
    assert abs(there.metrics()["counts_off"] or 0.0) <= 2.0


def test_moves_beyond_the_limits_are_refused_by_name_before_anything_moves() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=3000.0)
        with pytest.raises(SettingError, match="speeds of at most 3000 RPM"):
            stop_at(LAW, drive, "90deg")
        drive.set_limits(speed_rpm=4000.0, acceleration=16_000.0)
        with pytest.raises(SettingError, match="rates of at most 16000 RPM/s"):
            follow_positions(LAW, drive, GOALS, unit="turns")
        drive.set_limits(acceleration=20_000.0)
        with pytest.raises(SettingError, match="goals"):
            follow_positions(LAW, drive, [0.0, 5e6], unit="counts")
        # what a host did not check, the device refuses
        drive.set_controller(LAW)
        drive.set_limits(speed_rpm=3000.0)
        for numbers, rows in (((20.0, 3100.0, 0.0, 1.0), RATES), ((20.0, 9.0, 0.0, 1.0), ())):
            with pytest.raises(LinkError, match="its gain, speeds, landing, smoothing or rates"):
                drive._link.ask(Kind.POSITION, wire.position(numbers, 4, False, rows))
        assert drive.outcome is None


def test_the_counter_keeps_to_its_travel() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        assert drive.travel() == (-(2**31), 2**31 - 1)
        drive.set_travel(-400, 1800)
        assert drive.travel() == (-400, 1800)
        # 0 and 0 on the wire would only ask, and leave the limits as they are
        for low, high in ((0, 0), (5, 5), (10, -10), (-(2**31) - 1, 5), (0, 2**31)):
            with pytest.raises(SettingError, match="a least count below the greatest"):
                drive.set_travel(low, high)
        for low in (0.5, np.nan, np.inf, True, "0"):
            with pytest.raises(SettingError, match="low"):
                drive.set_travel(low, 5)  # type: ignore[arg-type]
        assert drive.travel() == (-400, 1800)
        with pytest.raises(LinkError, match="the greatest count"):
            drive._link.ask(Kind.TRAVEL, wire.set_travel(5, 5))
        # goals within, goals beyond, and a stop that the turn leads beyond
        follow_positions(GENTLE, drive, np.repeat([0.0, 1500.0, 0.0], 900), unit="counts")
        drive.outcome = None
        with pytest.raises(SettingError, match=r"goals: .* limits of the position \(-400 to 1800"):
            follow_positions(LAW, drive, np.repeat([0.0, -900.0], 600), unit="counts")
        assert drive.outcome is None  # nothing was armed
        # what a host did not check, the device refuses
        drive.set_controller(LAW)
        drive._link.ask(Kind.UPLOAD, struct.pack("<BI2f", 2, 0, 0.0, -900.0))
        drive.arm()
        with pytest.raises(LinkError, match=r"its profile, or what .* is beyond a limit"):
            drive._link.ask(Kind.START, wire.start(3, 100_000, 0, 2, 3, 5))
        drive.stop()
        with pytest.raises(LinkError, match="travel") as found:
            stop_at(LAW, drive, "90deg", speed=1500.0)
        assert found.value.recording is not None
        assert drive.status().reason == "travel"
        drive.clear()
        # the shaft coasts on without a command: there is no run from where it is
        drive.wait_for_rest()
        assert drive.status().counts > 1800
        for run in (
            lambda: drive.excite(np.full(20, -1.0)),
            lambda: follow_positions(LAW, drive, np.zeros(20), unit="counts"),
        ):
            with pytest.raises(SettingError, match="travel: expected a counter within -400 to"):
                run()
        drive.set_travel(-400, 2**31 - 1)
        drive.excite(np.full(20, -1.0))


def test_what_does_not_go_together_is_refused_before_a_motor_is_armed() -> None:
    with pytest.raises(SettingError, match="a PositionController in the mode 'positions'"):
        Plan("positions", GOALS, SPEED)
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        with pytest.raises(SettingError, match="angle: expected a place within"):
            stop_at(LAW, drive, "5e6counts", speed=500.0)
        assert drive.outcome is None


def test_a_stop_that_passed_or_a_goal_that_is_torn_ends_in_a_safe_output() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        drive.set_controller(SPEED)
        drive.wait_for_rest()
        drive.arm()
        with pytest.raises(LinkError, match="a run without a position loop, is outside"):
            drive._link.ask(Kind.ANGLE, wire.angle(0, 1.0, True))
        drive.set_controller(LAW)
        with pytest.raises(LinkError, match="angle"):
            drive._link.ask(Kind.ANGLE, wire.angle(0, float("nan"), True))
        with pytest.raises(LinkError, match="wrong length"):
            drive._link.ask(Kind.ANGLE, struct.pack("<If", 0, 1.0))
        with pytest.raises(LinkError, match="value 1"):
            drive._link.ask(Kind.UPLOAD, struct.pack("<BI2f", 2, 0, 1.0, float("inf")))
        with pytest.raises(LinkError, match="length"):
            drive._link.ask(Kind.START, wire.start(3, 100_000, 0, 5, 3, 5))
        drive.stop()
        drive.wait_for_rest()
        # goals that end before the run does
        drive._link.ask(Kind.UPLOAD, struct.pack("<BI5f", 2, 0, *range(5)))
        drive.arm()
        drive._link.ask(Kind.START, wire.start(3, 100_000, 0, 50, 3, 5))
        for _ in range(20):
            drive._link.let_pass(20_000)
            if drive.status().state != "running":
                break
        assert drive.status().reason == "underrun"
        drive.clear()


def test_a_device_of_version_3_refuses_positions_by_name_and_runs_as_ever(tmp_path: Path) -> None:
    with ScriptedDevice(tmp_path) as device, connect(device.url) as drive:
        assert drive.identity.version == 3
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        for asked in (
            lambda: stop_at(LAW, drive, "90deg"),
            lambda: follow_positions(LAW, drive, GOALS, unit="turns"),
            lambda: drive.set_controller(LAW),
            drive.travel,
            lambda: drive.set_travel(-5, 5),
        ):
            with pytest.raises(SettingError) as found:
                asked()
            assert "a position loop" in str(found.value)
            assert "protocol version 3" in str(found.value)
            assert "SEWFAST_CAN_POSITIONS" in str(found.value)
        assert drive.outcome is None
        sink = Kept()
        drive.stream(Plan("commands", np.full(40, 1.0)), sink)
        np.testing.assert_array_equal(sink.column("u"), 1.0)


def test_a_stop_of_which_samples_were_lost_is_not_judged() -> None:
    lossy = VirtualDevice(fast=True, faults="drop=.03", seed=3)
    with lossy as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        found = stop_at(GENTLE, drive, "90deg", speed=1500.0, after=1.5)
        assert drive.outcome is not None
        assert drive.outcome.gaps
    m = found.metrics()
    assert np.isnan([m["off"], m["passed"], m["counts_off"]]).all()
    assert m["time"] is None
    # it was said to have gone on to a later turn, and to have stopped at once
    (warning,) = found.warnings
    assert warning.startswith(f"lost samples from {drive.outcome.gaps[0][0]} on")
    assert "unknown: samples were lost" in str(found)
    # nor is its recording cut down to nothing where a commissioning looks for the cause
    stop = Stop("90deg from 1500 RPM", (), found)
    record = Recording(found.u, found.counts, found.y, None, found.Ts, 1572.0, "stop")
    (told,) = telling([record], [stop], GENTLE)
    assert len(told) == len(record)


def test_the_command_line_stops_a_drive_at_an_angle(tmp_path: Path, capsys: Any) -> None:
    law, out = tmp_path / "position.json", tmp_path / "stop.csv"
    LAW.save(law)
    with VirtualDevice(fast=True) as device:
        given = ["run", str(law), "--on", device.port, "--stop-at", "90deg", "--speed", "1500"]
        limits = ["--limits", "volt=20,speed=4000,acceleration=1e9,current=100"]
        assert main([*given, *limits, "-o", str(out), "--live", "none"]) == 0
        said = capsys.readouterr().out
        assert "stop at 90deg from 1500 RPM" in said
        assert "passed by" in said
        moves = tmp_path / "moves.csv"
        rows = "\n".join(f"{0.001 * k:.3f},{90.0 * (k > 20)}" for k in range(500))
        moves.write_text("t [s],r [deg]\n" + rows)
        asked = ["run", str(law), "--on", device.port, "--positions", str(moves), *limits]
        assert main([*asked, "-o", str(tmp_path / "moves.mcap"), "--json", "--live", "none"]) == 0
        assert '"off"' in capsys.readouterr().out
    kept = read_recording(out.with_suffix(".mcap"))
    assert kept.header.settings["controller"]["kind"] == "position"
    stop = kept.header.settings["stop"]
    assert (stop["angle"], stop["turn"], stop["way"]) == (393.0, 1572.0, "onward")
    assert kept.header.settings["release"] is False
    assert out.read_text().startswith("t [s]")
    assert {"counts", "u"} <= set(kept.columns)
