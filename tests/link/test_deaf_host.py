"""A host that hears nothing of its device falls silent, so that the watchdog ends the run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_link_drive import Kept

import link_device as script
from link_device import ScriptedDevice
from link_simulated import Clock, SimulatedPort, driven, linked, simulated
from refusals import refuses
from sewfast.errors import LinkError
from sewfast.link import Drive, Plan
from sewfast.link.connection import RETRY
from sewfast.link.run import ARMED_SILENCE

WATCHDOG = 0.05
TURN = 0.003
"""What host and device may take to see a frame, in simulated time [s]."""
LONG = np.ones(5000)


class Silenced:
    """Nothing leaves the device from a frame on; what it was about when STOP came."""

    def __init__(self, device: ScriptedDevice) -> None:
        self.device, self.since = device, 0.0
        self.when_stopped: list[tuple[int, int]] = []
        device.mangle, device.intercept = self.mangle, self.intercept

    def begins(self, kind: int) -> bool:
        return kind == 0xC0 and self.device._taken >= 300

    def mangle(self, kind: int, wire: bytes) -> list[bytes]:
        if self.since or self.begins(kind):
            self.since = self.since or self.device._monotonic()
            return []
        return [wire]

    def intercept(self, frame: Any) -> bool:
        if frame[0] == script.STOP:
            self.when_stopped.append((self.device.state, self.device.reason))
        return False

    def last_heartbeat(self) -> float:
        beats = [at for at, kind in self.device.arrived if kind in (script.KEEP, script.DRIVE)]
        assert len(beats) > 5
        return beats[-1]


class SilencedAtStart(Silenced):
    """It starts, but the reply that says so is lost as all that follows."""

    def begins(self, kind: int) -> bool:
        return kind == 0x80 | script.START


@pytest.mark.parametrize("mode", ["commands", "direct"])
@pytest.mark.parametrize(("batch", "longest"), [(10, WATCHDOG), (40, 0.120)])
def test_a_deaf_host_lets_the_watchdog_end_the_run(mode, batch, longest):
    with simulated() as (device, port):
        silence = Silenced(device)
        drive = driven(port)
        with pytest.raises(LinkError, match="answer to STATUS"):
            drive.stream(Plan(mode, LONG, columns=(), batch=batch), Kept())
        assert silence.when_stopped[0] == (script.TRIPPED, 1)
        # the frame before the first that was lost came a batch earlier
        assert silence.last_heartbeat() - silence.since <= longest + TURN - 0.001 * batch


def test_a_host_that_is_deaf_from_the_start_on_falls_silent_too():
    with simulated() as (device, port):
        silence = SilencedAtStart(device)
        drive = driven(port)
        with pytest.raises(LinkError, match="answer to START"):
            drive.stream(Plan("commands", LONG), Kept())
        assert silence.when_stopped[0] == (script.TRIPPED, 1)
        assert silence.last_heartbeat() - silence.since <= ARMED_SILENCE + TURN


def test_a_start_that_is_lost_twice_is_still_executed():
    with simulated() as (device, port):
        lost = iter([True, True])
        drive = driven(port)
        device.intercept = lambda frame: frame[0] == script.START and next(lost, False)
        assert drive.stream(Plan("commands", np.ones(200)), Kept()).is_complete


# --- the way out ----------------------------------------------------------------------------------


def test_an_abort_leaves_the_connection_s_patience_as_it_was():
    with simulated() as (_, port):
        link = linked(port, watchdog=5.0)
        drive = Drive(link)
        drive.set_limits(volt=10.0)

        def fail(first: int) -> None:
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            drive.stream(Plan("commands", LONG), Kept(fail))
        assert link.resume == 0.5
        assert drive.outcome is not None
        assert drive.outcome.state == "idle"


class Vanishing(SimulatedPort):
    """A port that is lost in the middle of a run, and how long each attempt to open it may take."""

    def __init__(self, device: ScriptedDevice, clock: Clock, back: int) -> None:
        super().__init__(device, clock)
        self.back, self.waits = back, list[float]()

    def read(self, timeout: float) -> bytes:
        if self._device._taken >= 300 and not self.waits:
            raise LinkError("gone")
        return super().read(timeout)

    def reopen(self, timeout: float = 5.0) -> None:
        self.waits.append(timeout)
        if len(self.waits) < self.back:
            # as long as a host that does not answer takes
            self._clock.now += timeout
            raise LinkError("not there")


def test_a_port_is_tried_again_no_longer_than_promised():
    with simulated() as (device, quiet):
        port = Vanishing(device, quiet._clock, back=99)
        drive = Drive(linked(port))
        drive.set_limits(volt=10.0)
        with pytest.raises(LinkError, match=r"the port back within 0\.5 s"):
            drive.stream(Plan("commands", LONG), Kept())
        assert port.waits[0] == pytest.approx(0.5)
        assert all(RETRY <= wait <= 0.5 for wait in port.waits)


def test_a_port_that_comes_back_after_the_abort_is_given_the_stop():
    with simulated() as (device, quiet):
        port = Vanishing(device, quiet._clock, back=3)
        link = linked(port, watchdog=5.0)
        drive = Drive(link)
        drive.set_limits(volt=10.0)
        with refuses(LinkError, expected="the port back"):
            drive.stream(Plan("commands", LONG), Kept())
        assert drive.outcome is not None
        assert drive.outcome.state == "idle"
        assert device.state == script.IDLE
        assert link.resume == 0.5
