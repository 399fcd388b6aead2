"""The example firmware in C, on a board that is this computer, as a host sees it."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from cli import refused, sewfast
from sewfast.control.record import record
from sewfast.errors import LinkError
from sewfast.link import Plan, connect, examine
from sewfast.recordfile import read_recording

DESK = Path(__file__).resolve().parents[2] / "target" / "bare" / "desk"
LIMITS = "volt=8,speed=3500,acceleration=40000,current=inf"
WATCHDOG = 2.0
"""A busy computer may leave host or board without the processor for long [s]."""


STALLED = 0.4
"""A watchdog time of which most passes while the board stands still [s]."""


@pytest.fixture
def port() -> Iterator[str]:
    if not DESK.exists():
        pytest.skip("needs the firmware on its desk board: make c-test")
    with subprocess.Popen([DESK], stdout=subprocess.PIPE, text=True) as desk:
        assert desk.stdout is not None
        yield desk.stdout.readline().removeprefix("port ").strip()
        desk.terminate()


def test_the_doctor_finds_nothing_wrong(port: str) -> None:
    found = examine(port)
    assert found["device"].values["device"] == "example drive"
    assert found["loss"].verdict == "ok"
    assert found["clock"].values["uncertainty_s"] > 0.0
    assert found["counters"].values["late_us"] < 500
    # a busy computer may be slow, which is the computer's
    worse = [f.name for f in found.findings if f.verdict != "ok"]
    assert set(worse) <= {"round trip"}, found


def test_a_step_is_recorded(port: str, tmp_path: Path) -> None:
    options = ("--signal", "step", "--scale", 0.4, "--watchdog", 1000 * WATCHDOG)
    said = refused(tmp_path, "record", "--on", port, *options, "-o", "step.mcap")
    assert "--limits" in said
    sewfast(tmp_path, "record", "--on", port, *options, "--limits", LIMITS, "-o", "step.mcap")
    made = read_recording(tmp_path / "step.mcap")
    assert made.complete
    assert made.header.device["firmware"] == "1.0"
    turned = np.diff(made.columns["counts"][[500, 2000, 2999]]) / 1572.0
    # 490 RPM/V through a lag of 150 ms: 980 RPM in the end
    speed = 490.0 * 2.0 / 60.0
    assert turned == pytest.approx([speed * (1.5 - 0.15), speed * 0.999], abs=0.01)


def test_limits_are_the_firmware_s(port: str) -> None:
    command = np.concatenate([np.zeros(100), np.full(2000, 5.0)])
    with connect(port, watchdog=WATCHDOG) as drive:
        assert drive.limits().ceilings[0] == 20.0
        drive.set_limits(volt=8.0, speed_rpm=500.0)
        with pytest.raises(LinkError, match="speed") as stopped:
            record(drive, command)
        assert 100 < len(stopped.value.recording) < 400
        assert drive.status().state == "tripped"
        drive.clear()
        assert drive.status().state == "idle"


def test_a_host_that_dies_is_watched(port: str) -> None:
    host = (
        "import sys, numpy\n"
        "from sewfast.link import Plan, connect\n"
        "class Sink:\n"
        "    def samples(self, first, columns): print('it turns', flush=True)\n"
        "    def event(self, kind, index, **detail): pass\n"
        "drive = connect(sys.argv[1], watchdog=1.0)\n"
        "drive.set_limits(volt=8.0)\n"
        "drive.stream(Plan('commands', numpy.full(20_000, 2.0)), Sink())\n"
    )
    with subprocess.Popen([sys.executable, "-c", host, port], stdout=subprocess.PIPE) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == b"it turns\n"
        running.kill()
    # a host that came within the watchdog time would be what trips it
    time.sleep(2.0)
    with connect(port) as drive:
        status = drive.status()
    assert (status.state, status.reason) == ("tripped", "watchdog")
    assert 0 < status.taken < 20_000


def test_two_boots_have_two_boot_ids() -> None:
    if not DESK.exists():
        pytest.skip("needs the firmware on its desk board: make c-test")
    boots = set()
    for _ in range(3):
        with subprocess.Popen([DESK], stdout=subprocess.PIPE, text=True) as desk:
            assert desk.stdout is not None
            with connect(desk.stdout.readline().removeprefix("port ").strip()) as drive:
                boots.add(drive.identity.boot)
            desk.terminate()
    assert len(boots) == 3


class Counting:
    """Takes samples and counts them."""

    def __init__(self) -> None:
        self.taken = 0

    def samples(self, first: int, columns: Mapping[str, np.ndarray]) -> None:
        self.taken = first + len(columns["counts"])

    def event(self, kind: str, index: int, **detail: object) -> None:
        pass


def test_a_board_that_makes_up_for_lost_time_hears_what_came_meanwhile() -> None:
    """Stalls of 3/4 of the watchdog time: with no heartbeat heard in them the device trips."""
    if not DESK.exists():
        pytest.skip("needs the firmware on its desk board: make c-test")
    with subprocess.Popen([DESK], stdout=subprocess.PIPE, text=True) as desk:
        assert desk.stdout is not None
        port = desk.stdout.readline().removeprefix("port ").strip()
        stopped = threading.Event()

        def stall() -> None:
            while not stopped.wait(0.15):
                desk.send_signal(signal.SIGSTOP)
                time.sleep(0.75 * STALLED)
                desk.send_signal(signal.SIGCONT)

        with connect(port, watchdog=STALLED) as drive:
            drive.set_limits(volt=8.0)
            sink = Counting()
            thread = threading.Thread(target=stall)
            thread.start()
            try:
                drive.stream(Plan("commands", np.full(6_000, 1.0)), sink)
            finally:
                stopped.set()
                thread.join()
        desk.terminate()
    assert sink.taken == 6_000
