"""A PID with feedforward on a device: its bits, its removal, its refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from link_kept import Kept
from sewfast import (
    Biquad,
    Controller,
    Feedforward,
    Gains,
    LinkError,
    SettingError,
    VirtualMachine,
    run,
)
from sewfast.link import Plan, VirtualDevice, connect, wire
from sewfast.link.plan import gains
from sewfast.link.wire import FEEDFORWARD, Kind

TS = 1e-3
LEVELS = ((-1500.0, -4.6), (-60.0, -0.9), (60.0, 0.9), (1500.0, 4.7))
AHEAD = Feedforward(8, 0.5, LEVELS, (0.004, 0.012, -0.003))
R = 700.0 * np.clip(np.arange(500) / 150.0, 0.0, 1.0)


def controller(**settings: Any) -> Controller:
    base: dict[str, Any] = {
        "alpha": 0.3, "beta": 0.5, "N": 8.0, "u_min": -20.0, "u_max": 20.0, "filter_samples": 4,
        "counts_per_rev": 1572.0, "feedforward": AHEAD,
    }  # fmt: skip
    return Controller(Gains.standard(0.004, 0.1, 0.003), Ts=TS, **(base | settings))


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"r_rate": 3000.0, "observer_time": 0.004, "biquads": (Biquad.notch(60.0),)},
        {"feedforward": Feedforward(0, 1.0, (), (0.01,))},
        {"feedforward": Feedforward(30, 0.0, LEVELS[:1])},
    ],
)
def test_a_device_runs_it_as_the_core_does_in_single_precision(settings: dict[str, Any]) -> None:
    c = controller(**settings)
    sink, plain = Kept(), Kept()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        drive.stream(Plan("controller", c.early(R), c), sink)
        drive.stream(Plan("controller", R, replace(c, feedforward=None)), plain)
    core = c.core().single()
    counts = sink.column("counts")
    moved = np.diff(counts, prepend=counts[0]).astype(np.float32)
    # as the device divides: counts by period times counts per unit
    speed = moved / (np.float32(TS) * np.float32(1572.0 / 60.0))
    u = [core.step(float(a), float(b)) for a, b in zip(c.early(R), speed, strict=True)]
    whole = np.round(np.array(u, dtype=np.float32) * np.float32(1000.0))
    np.testing.assert_array_equal(np.round(1000.0 * sink.column("u")), whole)
    # gains without it leave none of that before
    assert np.abs(plain.column("u") - sink.column("u")).max() > 0.01


def test_a_recording_on_a_device_is_the_simulation_of_its_machine() -> None:
    """`run` on the drive and on the machine in this process: in time on both."""
    c = controller()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        there = run(c, drive, R)
    here = run(c, VirtualMachine(), R)
    np.testing.assert_array_equal(there.r, here.r)
    assert np.sqrt(np.mean((there.y - here.y) ** 2)) < 5.0


def test_a_device_without_it_refuses_it_by_name_before_anything_is_sent() -> None:
    c = controller()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        assert drive.identity.capabilities & FEEDFORWARD
        older = replace(drive.identity, capabilities=drive.identity.capabilities & ~FEEDFORWARD)
        with pytest.raises(SettingError) as found:
            gains(c, drive.channels, older)
        assert gains(replace(c, feedforward=None), drive.channels, older)
    assert found.value.name == "controller"
    assert found.value.expected == "one without feedforward for this device"
    assert "tune --no-feedforward" in str(found.value.remedy)
    assert "SEWFAST_CAN_FEEDFORWARD" in str(found.value.remedy)


def test_a_device_names_what_it_refuses() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        body = wire.feedforward(*AHEAD.core())
        with pytest.raises(LinkError, match="its preview, levels or taps"):
            drive._link.ask(Kind.FEEDFORWARD, body)  # no gains
        drive.set_controller(controller())
        late = wire.feedforward(31, 0.5, [], [0.1])
        with pytest.raises(LinkError, match="its preview, levels or taps"):
            drive._link.ask(Kind.FEEDFORWARD, late)
        drive._link.ask(Kind.FEEDFORWARD, wire.feedforward(0, 0.0, [], []))
