"""The host and the virtual device: the machine's own answers, every fault accounted for."""

from __future__ import annotations

import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from test_link_drive import Kept, once

from effort import FULL
from sewfast import Controller, Gains, VirtualMachine, signals
from sewfast.control import loop
from sewfast.errors import LinkError, SettingError
from sewfast.link import Plan, VirtualDevice, connect

ENDPOINTS = ["pty", "tcp"]
ONE_COUNT = 1.0
"""A command in steps differs from its decimal number in the last bit."""


def excitation(n: int) -> np.ndarray:
    """Commands in whole steps of the device, so that rounding changes nothing."""
    t = 0.001 * np.arange(n)
    return np.round(3.0 + 2.5 * np.sin(2 * np.pi * 0.5 * t) + 0.4 * np.sin(40 * t), 3)


def run(device, plan, sink, **settings):
    with connect(device.port, **settings) as drive:
        if not drive.limits().are_set:
            drive.set_limits(volt=20.0)
        return drive.stream(plan, sink)


@pytest.mark.parametrize("endpoint", ENDPOINTS)
def test_a_run_gives_what_the_machine_itself_gives(endpoint):
    u = excitation(20_000)
    sink = Kept()
    with VirtualDevice("virtual:3", fast=True, endpoint=endpoint) as device:
        outcome = run(device, Plan("commands", u), sink)
    assert outcome.reason == "finished"
    assert outcome.is_complete
    assert outcome.clock is None
    assert outcome.columns == ("counts", "u", "speed_true")
    np.testing.assert_array_equal(sink.indexes(), np.arange(len(u)))
    expected = VirtualMachine(3).run(u)
    np.testing.assert_array_equal(sink.column("u"), u)
    np.testing.assert_allclose(sink.column("counts"), expected.counts, rtol=0.0, atol=ONE_COUNT)
    np.testing.assert_allclose(sink.column("speed_true"), expected.speed_rpm, rtol=1e-6, atol=1e-3)


def test_runs_follow_each_other_each_from_rest():
    u = excitation(1500)
    first, second = Kept(), Kept()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0)
        drive.stream(Plan("commands", u), first)
        drive.stream(Plan("commands", u), second)
    np.testing.assert_array_equal(first.column("speed_true"), second.column("speed_true"))


def test_a_controller_on_the_device_does_what_it_does_here():
    controller = Controller(
        Gains.parallel(0.004, 0.03, 0.0), u_min=-20.0, u_max=20.0, filter_samples=8
    )
    r = signals.reference("trapezoid")
    sink = Kept()
    columns = ("r", "feedback", "speed_true")
    with VirtualDevice(fast=True) as device:
        outcome = run(device, Plan("controller", r, controller, columns), sink)
    assert outcome.is_complete
    np.testing.assert_allclose(sink.column("r"), r, rtol=1e-6, atol=1e-3)
    here = loop.run(controller, VirtualMachine(), r)
    # single precision there, double here: an encoder step may fall into the next sample
    np.testing.assert_allclose(sink.column("speed_true"), here.y, rtol=0.0, atol=1.0)
    one_count = 60_000.0 / 1572.0 / controller.filter_samples
    np.testing.assert_allclose(
        sink.column("feedback"), here.feedback, rtol=0.0, atol=1.5 * one_count
    )


def test_a_whole_design_on_the_device_does_what_it_does_here():
    points = [(0.0, Gains.standard(0.006, 0.2)), (1500.0, Gains.standard(0.004, 0.13))]
    controller = Controller(
        Gains.parallel(0.004, 0.03, 0.0), u_min=-20.0, u_max=20.0, filter_samples=4,
        observer_time=0.003, r_rate=4000.0, schedule=points,
    )  # fmt: skip
    r = signals.reference("trapezoid")
    sink = Kept()
    with VirtualDevice(fast=True) as device:
        outcome = run(device, Plan("controller", r, controller, ("feedback", "speed_true")), sink)
    assert outcome.is_complete
    here = loop.run(controller, VirtualMachine(), r)
    plain = loop.run(replace(controller, observer_time=0.0), VirtualMachine(), r)
    assert np.max(np.abs(plain.y - here.y)) > 2.0
    # single precision there, double here: an encoder step may fall into the next sample
    np.testing.assert_allclose(sink.column("speed_true"), here.y, rtol=0.0, atol=2.0)
    one_count = 60_000.0 / 1572.0 / controller.filter_samples
    np.testing.assert_allclose(
        sink.column("feedback"), here.feedback, rtol=0.0, atol=1.5 * one_count
    )


def test_real_time_is_kept_and_the_clock_is_known():
    sink = Kept()
    with VirtualDevice() as device:
        began = time.monotonic()
        plan = Plan("commands", excitation(1000))
        outcome = run(device, plan, sink, baud=921_600, watchdog=10.0)
        assert time.monotonic() - began >= 1.0
    assert outcome.reason == "finished"
    assert outcome.received + sum(n for _, n in outcome.gaps) == outcome.taken == 1000
    assert outcome.clock is not None
    assert outcome.clock.consistent


def test_a_limit_trips_the_run_and_keeps_what_was_measured():
    sink = Kept()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=1000.0)
        outcome = drive.stream(Plan("commands", np.full(2000, 5.0)), sink)
        assert (outcome.state, outcome.reason) == ("tripped", "speed")
        with pytest.raises(LinkError, match="tripped: speed"):
            drive.stream(Plan("commands", np.full(10, 1.0)), sink)
        drive.clear()
        drive.stream(Plan("commands", np.full(10, 1.0)), Kept())
    assert outcome.received == outcome.taken
    assert 0 < outcome.received < 2000
    # a trip comes within 24 samples of the excess
    assert 1000.0 < sink.column("speed_true")[-1] < 1700.0


def test_a_batch_is_refused_that_no_frame_holds():
    with VirtualDevice(fast=True) as device, pytest.raises(SettingError, match="231 bytes"):
        run(device, Plan("commands", np.ones(10), batch=100), Kept())


FAULTS = {
    "drop": "drop=.01",
    "flip": "flip=.01",
    "duplicate": "duplicate=.02",
    "reorder": "reorder=.01",
    "delay": "delay=.01:0.002",
    "all": "drop=.003,flip=.003,duplicate=.003,reorder=.003,delay=.003:0.002",
}


@pytest.mark.parametrize("faults", FAULTS)
@pytest.mark.parametrize("endpoint", ENDPOINTS)
def test_each_sample_that_a_fault_took_is_listed(endpoint, faults):
    u = excitation(200_000 if FULL else 10_000)
    sink = Kept()
    with VirtualDevice(fast=True, endpoint=endpoint, faults=FAULTS[faults], seed=5) as device:
        outcome = run(device, Plan("commands", u), sink)
        caused = device.faults
    assert sum(caused.values()) > 0
    assert outcome.reason == "finished"
    assert outcome.taken == len(u)
    indexes = sink.indexes()
    missing = np.setdiff1d(np.arange(len(u)), indexes)
    listed = [first + np.arange(n) for first, n in outcome.gaps]
    np.testing.assert_array_equal(missing, np.concatenate([*listed, []]))
    assert len(np.unique(indexes)) == len(indexes) == outcome.received
    expected = VirtualMachine().run(u)
    found = sink.column("counts")
    np.testing.assert_allclose(found, expected.counts[indexes], rtol=0.0, atol=ONE_COUNT)


def test_a_reset_in_the_middle_is_an_error_with_the_rest_kept():
    sink = Kept()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0)
        sink = Kept(once(lambda: device.cause("reset"), at=1000))
        with pytest.raises(LinkError, match="has been reset"):
            drive.stream(Plan("commands", excitation(200_000)), sink)
        assert drive.outcome is not None
        assert drive.outcome.received == len(sink.indexes()) >= 1000


def test_a_run_survives_a_replug_within_its_watchdog():
    with (
        VirtualDevice() as device,
        connect(device.port, watchdog=10.0, resume=10.0, baud=921_600) as drive,
    ):
        drive.set_limits(volt=20.0)
        sink = Kept(once(lambda: device.cause("unplug", 0.2), at=200))
        outcome = drive.stream(Plan("commands", excitation(1500)), sink)
    assert outcome.reason == "finished"
    assert outcome.taken == 1500
    assert outcome.received + sum(n for _, n in outcome.gaps) == 1500
    assert "resumed" in sink.kinds


def test_a_replug_beyond_the_watchdog_says_what_happened():
    # longer than a busy machine keeps this process waiting before the plug is pulled
    with VirtualDevice() as device, connect(device.port, watchdog=1.0, resume=10.0) as drive:
        drive.set_limits(volt=20.0)
        sink = Kept(once(lambda: device.cause("unplug", 1.5), at=200))
        with pytest.raises(LinkError, match="had tripped: watchdog"):
            drive.stream(Plan("commands", excitation(5000)), sink)
        assert drive.outcome is not None
        assert drive.outcome.state == "tripped"


@pytest.mark.parametrize("fast", [False, True], ids=["real time", "on credit"])
def test_ctrl_c_turns_the_output_off(fast):
    pressed: list[float] = []

    def press() -> None:
        pressed.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    with VirtualDevice(fast=fast) as device, connect(device.port, watchdog=5.0) as drive:
        drive.set_limits(volt=20.0)
        timer = threading.Timer(0.1, press)
        sink = Kept(once(timer.start, at=200))
        with pytest.raises(KeyboardInterrupt):
            drive.stream(Plan("commands", np.full(5_000_000, 4.0)), sink)
        timer.join()
        assert drive.outcome is not None
        assert drive.outcome.reason == "interrupted"
        assert drive.status().state == "idle"
        off = [e for e in device.trace() if e["event"] == "off"]
        assert len(off) == 1


def test_cancelling_from_another_thread():
    cancel = threading.Event()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0)
        sink = Kept(once(cancel.set, at=5000))
        plan = Plan("commands", np.full(1_000_000, 4.0))
        outcome = drive.stream(plan, sink, cancel=cancel)
        assert outcome.reason == "cancelled"
        assert outcome.is_complete
        assert drive.status().state == "idle"


def test_a_second_host_cannot_have_the_port():
    with VirtualDevice(fast=True) as device, connect(device.port), pytest.raises(LinkError):
        connect(device.port)
