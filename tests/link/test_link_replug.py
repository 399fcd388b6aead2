"""Runs on a drive whose port comes and goes."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import link_device as script
from link_device import ScriptedDevice
from link_kept import LONG, Kept, U, once
from refusals import refuses
from sewfast.errors import LinkError
from sewfast.link import Plan, connect


@pytest.fixture
def served(tmp_path) -> Iterator[ScriptedDevice]:
    """On a pty, in real time."""
    with ScriptedDevice(tmp_path) as device:
        yield device


def replug(device: ScriptedDevice, away: float) -> None:
    """Pull the cable now and plug it in again after a while; the device goes on meanwhile."""
    device.wire.unplug()
    if away < 10.0:
        threading.Timer(away, lambda: device.do(device.wire.plug)).start()


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_a_run_goes_on_after_the_port_was_away(tmp_path, kind):
    # room for all of it, and seconds: a run outlasts what a busy machine makes of a short absence
    u = np.tile(U, 8)
    with (
        ScriptedDevice(tmp_path, kind, capacity=len(u)) as device,
        connect(device.url, watchdog=10.0, resume=10.0) as drive,
    ):
        drive.set_limits(volt=10.0)
        sink = Kept(once(lambda: device.do(lambda: replug(device, 0.15))))
        outcome = drive.stream(Plan("commands", u), sink)
    assert outcome.reason == "finished"
    assert outcome.taken == len(u)
    assert outcome.received == len(sink.indexes())
    assert outcome.received + sum(n for _, n in outcome.gaps) == len(u)
    assert [k for k in sink.kinds if k in ("port_lost", "resumed")] == ["port_lost", "resumed"]


def test_a_run_that_tripped_meanwhile_says_so(served):
    served.capacity = len(LONG)
    with connect(served.url, watchdog=1.0, resume=10.0) as drive:
        drive.set_limits(volt=10.0)
        sink = Kept(once(lambda: served.do(lambda: replug(served, 1.5))))
        with pytest.raises(LinkError, match=r"a device that had tripped: watchdog"):
            drive.stream(Plan("commands", LONG), sink)
        assert drive.outcome is not None
        assert drive.outcome.state == "tripped"
        assert drive.outcome.taken is not None
        assert drive.outcome.taken < len(LONG)


def test_a_device_that_was_reset_meanwhile_says_so(served):
    def lose() -> None:
        replug(served, 0.1)
        served.reset()

    with connect(served.url, watchdog=10.0, resume=10.0) as drive:
        drive.set_limits(volt=10.0)
        sink = Kept(once(lambda: served.do(lose)))
        with refuses(LinkError, received="been reset"):
            drive.stream(Plan("commands", LONG), sink)


def test_a_stop_still_reaches_a_device_whose_port_comes_back_late(served):
    served.capacity = len(LONG)
    drive = connect(served.url, watchdog=5.0, resume=0.1)
    drive.set_limits(volt=10.0)
    sink = Kept(once(lambda: served.do(lambda: replug(served, 1.2))))
    with pytest.raises(LinkError, match=r"the port back within 0\.1 s, .*; the device stops its"):
        drive.stream(Plan("commands", LONG), sink)
    assert served.state == script.IDLE
    assert drive.outcome is not None
    assert drive.outcome.state == "idle"
    assert drive.outcome.received + sum(n for _, n in drive.outcome.gaps) == drive.outcome.taken
    drive.close()


def test_a_port_that_stays_away(served):
    sink = Kept(once(lambda: served.do(lambda: replug(served, math.inf))))
    drive = connect(served.url, watchdog=1.0, resume=0.2)
    drive.set_limits(volt=10.0)
    with pytest.raises(LinkError, match=r"back within 0\.2 s, received one that vanished"):
        drive.stream(Plan("commands", LONG), sink)
    drive.close()
    assert sink.kinds[-1] == "stop_unconfirmed"
    assert Path(served.url).exists() is False
