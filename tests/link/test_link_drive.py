"""Runs on a drive: every sample accounted for, and the motor stopped whatever happens."""

from __future__ import annotations

import math
import os
import signal
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

import link_device as script
from effort import FULL
from link_device import ScriptedDevice
from link_kept import LONG, Kept, U, once
from link_simulated import SimulatedPort, driven, linked, simulated
from sewfast import Controller, Gains
from sewfast.errors import LinkError, SettingError
from sewfast.link import Drive, Plan, connect
from sewfast.link.drive import gains


@pytest.fixture
def simulation() -> Iterator[tuple[ScriptedDevice, SimulatedPort]]:
    with simulated() as found:
        yield found


@pytest.fixture
def device(simulation) -> ScriptedDevice:
    """In simulated time."""
    return simulation[0]


@pytest.fixture
def drive(simulation) -> Iterator[Drive]:
    with Drive(linked(simulation[1])) as connected:
        connected.set_limits(volt=10.0, speed_rpm=4000.0)
        yield connected


@pytest.fixture
def served(tmp_path) -> Iterator[ScriptedDevice]:
    """On a pty, in real time."""
    with ScriptedDevice(tmp_path) as device:
        yield device


def stops(device: ScriptedDevice) -> list[float]:
    return [at for at, kind in device.arrived if kind == script.STOP]


def starts(device: ScriptedDevice) -> list[bytes]:
    return [body for kind, body in device.executed if kind == script.START]


# --- what is done -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_every_sample_of_a_run_arrives(tmp_path, kind):
    with ScriptedDevice(tmp_path, kind) as device, connect(device.url, watchdog=5.0) as drive:
        drive.set_limits(volt=10.0)
        sink = Kept()
        outcome = drive.stream(Plan("commands", U), sink)
    assert (outcome.state, outcome.reason) == ("idle", "finished")
    assert outcome.is_complete
    assert outcome.received == outcome.taken == len(U)
    assert outcome == drive.outcome
    np.testing.assert_array_equal(sink.indexes(), np.arange(len(U)))
    np.testing.assert_allclose(sink.column("u"), U, atol=0.0005 + 1e-9)
    np.testing.assert_allclose(sink.column("speed_true"), 10.0 * sink.column("u"), rtol=1e-6)
    assert sink.kinds == ["started", "finished"]


def test_a_profile_longer_than_the_memory_is_fed_while_it_runs():
    with simulated(capacity=130) as (_, port):
        sink = Kept()
        outcome = driven(port).stream(Plan("commands", U), sink)
    assert outcome.is_complete
    np.testing.assert_allclose(sink.column("u"), U, atol=0.0005 + 1e-9)


def test_a_controller_runs_on_the_device(device, drive):
    gains = Gains.parallel(0.01, 0.1, 0.0)
    controller = Controller(gains, alpha=0.1, u_min=-8.0, u_max=8.0, filter_samples=4)
    sink = Kept()
    r = np.linspace(0.0, 1000.0, 200)
    outcome = drive.stream(Plan("controller", r, controller, columns=("r",)), sink)
    assert outcome.columns == ("counts", "u", "r")
    assert outcome.is_complete
    np.testing.assert_allclose(sink.column("r"), r, rtol=1e-6)
    (body,) = [body for kind, body in device.executed if kind == script.GAINS]
    *values, filter_samples = struct.unpack("<12fB", body)
    expected = (0.01, 0.1, 0.0, 0.1, 0.0, math.inf, 0.0, -8.0, 8.0, math.inf, 0.0, 1572 / 60)
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    assert filter_samples == 4


def test_a_device_that_does_not_know_a_part_is_not_sent_it(device, drive):
    gains = Gains.standard(0.01, 0.1)
    parts = {"observer_time": 0.004, "r_rate": 1000.0, "schedule": [(0.0, gains)]}
    for name, value in parts.items():
        controller = Controller(gains, u_min=-8.0, u_max=8.0, **{name: value})
        with pytest.raises(SettingError) as refused:
            drive.set_controller(controller)
        assert refused.value.name == "controller"
        assert refused.value.expected == f"one without {name} for this device"
    assert not [kind for kind, _ in device.executed if kind == script.GAINS]


def test_a_device_that_knows_them_is_sent_the_whole_design(drive):
    knowing = replace(drive.identity, capabilities=drive.identity.capabilities | 1 << 6)
    points = [(0.0, Gains.standard(0.01, 0.1)), (900.0, Gains.parallel(0.02, 0.1))]
    controller = Controller(
        Gains.standard(0.01, 0.1), observer_time=0.004, r_rate=1000.0, schedule=points
    )
    body = gains(controller, drive.channels, knowing)
    assert len(body) == 49 + 9 + 2 * 16
    told = struct.unpack("<12fB2fB8f", body)
    assert told[13:16] == (np.float32(0.004), 1000.0, 2)
    rows = (0.0, 0.01, 0.1, 0.0, 900.0, 0.02, 0.2, 0.0)
    np.testing.assert_allclose(told[16:], rows, rtol=1e-6)


def test_direct_commands_are_sent_as_their_time_comes(device, drive):
    sink = Kept()
    values = np.repeat([1.0, 2.0, 3.0], 300)
    outcome = drive.stream(Plan("direct", values), sink)
    assert outcome.is_complete
    u = sink.column("u")
    assert set(u[200:300]) == {1.0}
    assert set(u[-100:]) == {3.0}
    assert np.all(np.diff(u) >= 0.0)


def test_the_clock_of_the_device_is_known_within_its_round_trips(drive):
    clock = drive.stream(Plan("commands", U), Kept()).clock
    assert clock is not None
    assert clock.consistent
    assert clock.drift_ppm[0] <= 0.0 <= clock.drift_ppm[1]
    # the device counts from its own boot on the same clock
    assert clock.offset_s[0] < clock.offset_s[1] < clock.offset_s[0] + 0.1


def test_heartbeats_go_on_while_a_run_lasts_and_no_longer(device, drive):
    drive.stream(Plan("commands", U), Kept())
    drive.status()
    beats = device.heartbeats
    assert beats >= 2
    drive.wait_for_rest()
    assert device.heartbeats == beats


def test_whether_the_motor_rests_is_for_the_device_to_say(device, drive):
    """It sees counts that no STATUS brings: a motor that creeps is waited for, not refused."""
    device.creeping = 3
    assert drive.stream(Plan("commands", U), Kept()).is_complete
    assert sum(kind == script.ARM for kind, _ in device.executed) == 4
    device.creeping = 10**9
    with pytest.raises(LinkError, match="a refusal: the motor is moving"):
        drive.stream(Plan("commands", U), Kept())
    assert len(starts(device)) == 1


# --- what is refused ----------------------------------------------------------------------------


def test_nothing_starts_without_limits(served):
    with connect(served.url, watchdog=2.0) as drive:
        assert not drive.limits().are_set
        for mode in ("commands", "direct"):
            with pytest.raises(SettingError, match=r"drive\.set_limits") as refused:
                drive.stream(Plan(mode, U), Kept())
            assert (refused.value.name, refused.value.received) == ("limits", "none")
    assert served.limits == (0.0,) * 4
    assert not starts(served)


def test_limits_left_out_keep_what_is_set_or_take_the_ceiling(drive):
    assert drive.limits().values == (10.0, 4000.0, 1e6, 10.0)
    drive.set_limits(current=2.0)
    assert drive.limits().values == (10.0, 4000.0, 1e6, 2.0)
    for value in (0.0, -1.0, 21.0, math.nan):
        with pytest.raises(SettingError, match="volt"):
            drive.set_limits(volt=value)


@pytest.mark.parametrize(
    ("plan", "name", "expected", "received"),
    [
        (Plan("commands", np.full(10, 10.01)), "commands", "within +-10 V", "10.01 at sample 0"),
        (Plan("direct", np.full(10, -10.01)), "commands", "within +-10 V", "-10.01 at sample 0"),
        (Plan("commands", U, columns=("torque",)), "columns", "some of counts, u", "torque"),
        (
            Plan("controller", U, Controller(Gains.standard(1.0, 0.1), Ts=0.002)),
            "controller", "period of 0.001 s", "one for 0.002 s",
        ),
        (
            Plan("controller", U, Controller(Gains.standard(1.0, 0.1, y_unit="rad/s"))),
            "controller", "output is in RPM", "rad/s",
        ),
        (
            Plan("controller", np.array([4001.0]), Controller(Gains.standard(1.0, 0.1))),
            "references", "within +-4000 RPM", "4001 at sample 0",
        ),
        (
            Plan("commands", U, columns=("r", "feedback", "speed_true")),
            "columns", "115200 baud", "more",
        ),
        (Plan("commands", U, batch=1), "columns", "in batches of 1", "more"),
    ],
)  # fmt: skip
def test_what_cannot_be_run_is_refused_before_anything_moves(
    device, drive, plan, name, expected, received
):
    with pytest.raises(SettingError) as refused:
        drive.stream(plan, Kept())
    error = refused.value
    assert error.name == name
    assert expected in error.expected
    assert error.received.startswith(received)
    assert error.remedy
    if plan.columns == ("r", "feedback", "speed_true"):
        assert error.remedy.startswith("leave out feedback, speed_true, or raise")
    assert not starts(device)
    assert not stops(device)


def test_a_mode_that_the_device_does_not_offer():
    with (
        simulated(capabilities=1) as (_, port),
        driven(port) as drive,
        pytest.raises(SettingError) as refused,
    ):
        drive.stream(Plan("direct", U), Kept())
    assert (refused.value.name, refused.value.received) == (
        "mode", "'direct', which 'script' does not",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"mode": "dance", "values": U}, "mode"),
        ({"mode": "commands", "values": []}, "values"),
        ({"mode": "commands", "values": [1.0, math.nan]}, "values"),
        ({"mode": "controller", "values": U}, "controller"),
        (
            {"mode": "commands", "values": U, "controller": Controller(Gains.standard(1.0, 0.1))},
            "controller",
        ),
    ],
)
def test_what_is_no_plan(given, name):
    with pytest.raises(SettingError) as refused:
        Plan(**given)
    assert refused.value.name == name


def test_a_tripped_device_is_not_cleared_by_itself(device, drive):
    device.do(lambda: device.trip(2, 4100.0))
    while drive.status().state != "tripped":
        pass
    with pytest.raises(LinkError) as refused:
        drive.stream(Plan("commands", U), Kept())
    assert refused.value.received == "one that has tripped: speed"
    assert not starts(device)
    drive.clear()
    assert drive.status().state == "idle"


# --- what goes wrong ----------------------------------------------------------------------------


def every(n: int, change: Callable[[bytes], list[bytes]]) -> Callable[[int, bytes], list[bytes]]:
    """Every n-th frame of samples as `change` has it."""
    count = 0

    def mangle(kind: int, wire: bytes) -> list[bytes]:
        nonlocal count
        count += kind == 0xC0
        return change(wire) if kind == 0xC0 and count % n == 0 else [wire]

    return mangle


@pytest.mark.parametrize(
    "change",
    [
        lambda wire: [],
        lambda wire: [wire[:9] + bytes([wire[9] ^ 4]) + wire[10:]],
        lambda wire: [wire[:-7]],
    ],
    ids=["lost", "damaged", "torn"],
)
def test_each_gap_is_listed(device, drive, change):
    device.mangle = every(7, change)
    sink = Kept()
    outcome = drive.stream(Plan("commands", U), sink)
    missing = np.setdiff1d(np.arange(len(U)), sink.indexes())
    listed = np.concatenate([first + np.arange(n) for first, n in outcome.gaps])
    assert len(missing)
    np.testing.assert_array_equal(missing, listed)
    assert outcome.taken == len(U)
    assert outcome.received == len(sink.indexes())
    assert not outcome.is_complete
    assert [(k, d["count"]) for kind, k, d in sink.events if kind == "gap"] == list(outcome.gaps)
    np.testing.assert_allclose(sink.column("u"), U[sink.indexes()], atol=0.0005 + 1e-9)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_a_gap_that_a_failing_sink_is_told_of_is_listed_once(device, drive, error):
    class Failing(Kept):
        def event(self, kind, index, **detail):
            super().event(kind, index, **detail)
            if kind == "gap" and self.kinds.count("gap") == 1:
                raise error

    device.mangle = every(7, lambda wire: [])
    with pytest.raises(error):
        drive.stream(Plan("commands", LONG), sink := Failing())
    outcome = drive.outcome
    listed = np.concatenate([first + np.arange(n) for first, n in outcome.gaps])
    missing = np.setdiff1d(np.arange(outcome.taken), sink.indexes())
    np.testing.assert_array_equal(listed, missing)
    assert outcome.received == len(sink.indexes())


def test_what_is_lost_at_the_end_is_a_gap_too(device, drive):
    def lost(kind):
        # less than makes the host take itself for deaf
        return kind == 0xC1 or (kind == 0xC0 and device._taken > 60)

    device.mangle = lambda kind, wire: [] if lost(kind) else [wire]
    outcome = drive.stream(Plan("commands", U[:100], batch=10), Kept())
    assert outcome.gaps == ((60, 40),)
    assert outcome.reason == "finished"


def test_repeated_frames_are_used_once(device, drive):
    device.mangle = lambda kind, wire: [wire, wire]
    sink = Kept()
    outcome = drive.stream(Plan("commands", U), sink)
    assert outcome.is_complete
    np.testing.assert_array_equal(sink.indexes(), np.arange(len(U)))
    assert outcome.counters["repeated"] > 0
    assert {kind for kind, _, _ in outcome.anomalies} == {"repeated"}


def test_a_trip_is_an_outcome(device, drive):
    def trip(first: int) -> None:
        if first >= 100:
            device.do(lambda: device.state == script.RUNNING and device.trip(3, 123.0))

    sink = Kept(trip)
    outcome = drive.stream(Plan("commands", LONG), sink)
    assert (outcome.state, outcome.reason) == ("tripped", "acceleration")
    assert outcome.received == outcome.taken < len(LONG)
    (event,) = [e for e in sink.events if e[0] == "tripped"]
    assert event[1] == outcome.taken
    assert event[2]["value"] == 123.0


def test_a_reset_ends_the_run_with_what_has_come(device, drive):
    sink = Kept(once(lambda: device.do(device.reset)))
    with pytest.raises(LinkError, match=r"it has been reset; .*set the limits"):
        drive.stream(Plan("commands", LONG), sink)
    assert drive.outcome is not None
    assert drive.outcome.reason == "failed"
    assert drive.outcome.received == len(sink.indexes()) >= 100
    assert sink.kinds[-1] == "reset"
    with pytest.raises(LinkError, match="connect again"):
        drive.status()


def test_a_dead_device_is_given_up_with_a_clear_error(device, drive):

    def die(first: int) -> None:
        device.intercept = lambda frame: True
        device.mangle = lambda kind, wire: []

    with pytest.raises(
        LinkError, match=r"an answer to STATUS, received nothing at all within \S+ s"
    ):
        drive.stream(Plan("commands", LONG), sink := Kept(die))
    assert drive.outcome is not None
    assert drive.outcome.state == "unknown"
    assert sink.kinds[-1] == "stop_unconfirmed"
    device.intercept = lambda frame: False
    device.mangle = lambda kind, wire: [wire]


# --- stopping -----------------------------------------------------------------------------------


def test_an_error_of_the_sink_stops_the_motor_first(device, drive):
    def full(first: int) -> None:
        if first >= 50:
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        drive.stream(Plan("commands", LONG), sink := Kept(full))
    assert device.state == script.IDLE
    assert len(stops(device)) == 1
    outcome = drive.outcome
    assert outcome is not None
    assert outcome.reason == "failed"
    assert outcome.taken is not None
    assert outcome.taken < len(LONG)
    listed = sum(count for _, count in outcome.gaps)
    assert outcome.received + listed == outcome.taken
    assert len(sink.indexes()) <= outcome.received


@pytest.mark.parametrize("where", ["in a wait", "in the sink"])
def test_ctrl_c_stops_the_motor_within_a_tenth_of_a_second(served, where):
    # a busy machine may forget this process for a while
    with connect(served.url, watchdog=5.0) as drive:
        drive.set_limits(volt=10.0)
        pressed: list[float] = []

        def press() -> None:
            pressed.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGINT)

        timer = threading.Timer(0.05, press)
        sink = Kept(once(press if where == "in the sink" else timer.start))
        with pytest.raises(KeyboardInterrupt):
            drive.stream(Plan("commands", LONG), sink)
        after = [kind for at, kind in served.arrived if at > pressed[0] and kind < script.KEEP]
        assert script.STOP in after[:2]
        if FULL:
            assert stops(served)[0] - pressed[0] < 0.1
        assert served.state == script.IDLE
        outcome = drive.outcome
        assert outcome is not None
        assert outcome.reason == "interrupted"
        assert outcome.received + sum(n for _, n in outcome.gaps) == outcome.taken
        assert sink.kinds[-1] == "stopped"


def test_cancelling_stops_the_motor_and_is_no_error(device, drive):
    cancel = threading.Event()
    sink = Kept(lambda first: cancel.set() if first >= 100 else None)
    outcome = drive.stream(Plan("commands", LONG), sink, cancel=cancel)
    assert outcome.reason == "cancelled"
    assert outcome.is_complete
    assert outcome.taken is not None
    assert 100 < outcome.taken < len(LONG)
    np.testing.assert_array_equal(sink.indexes(), np.arange(outcome.taken))
    assert len(stops(device)) == 1


def test_a_lost_stop_is_repeated(device, drive):
    swallowed = iter([True, True])
    device.intercept = lambda frame: frame[0] == script.STOP and next(swallowed, False)
    cancel = threading.Event()
    sink = Kept(lambda first: cancel.set())
    assert drive.stream(Plan("commands", LONG), sink, cancel=cancel).reason == "cancelled"
    assert len(stops(device)) == 3
    assert device.state == script.IDLE


def test_leaving_the_block_stops_the_motor(served):
    with connect(served.url, watchdog=5.0) as drive:
        drive.set_limits(volt=5.0)
        drive.arm()
        assert drive.status().state == "armed"
    assert served.state == script.IDLE
