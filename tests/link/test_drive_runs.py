"""`record` and `run` on a drive behind a port: as on the virtual machine, and what goes wrong."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cli import PROGRAM, environment, refused, sewfast
from moments import is_on, once_on, until
from sewfast import signals
from sewfast.control import Controller, Gains
from sewfast.control.loop import run
from sewfast.control.record import record
from sewfast.errors import Interrupted, LinkError, SettingError
from sewfast.link import Drive, VirtualDevice, connect
from sewfast.machine import VirtualMachine
from sewfast.readers import read
from sewfast.recordfile import read_recording

STEP = 0.001
"""Of the device's command [V]."""


@pytest.fixture
def device() -> Iterator[VirtualDevice]:
    with VirtualDevice(fast=True) as served:
        yield served


@pytest.fixture
def drive(device: VirtualDevice) -> Iterator[Drive]:
    with connect(device.port) as connected:
        connected.set_limits()
        yield connected


def controller() -> Controller:
    return Controller(
        Gains.standard(0.02, 0.2, 0.004), alpha=0.3, N=10.0, u_min=-20.0, u_max=20.0,
        filter_samples=8, counts_per_rev=1572.0,
    )  # fmt: skip


def command() -> np.ndarray:
    return np.round(signals.excitation("step"), 3)


def test_a_recording_is_that_of_the_virtual_machine(drive: Drive) -> None:
    u = np.round(signals.excitation("chirp_lo_hi")[:6000], 3)
    found = record(drive, u, name="chirp")
    expected = record(VirtualMachine(), u)
    np.testing.assert_allclose(found.u, u, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.counts, expected.counts)
    assert found.speed_true is not None
    assert expected.speed_true is not None
    np.testing.assert_allclose(found.speed_true, expected.speed_true, rtol=0, atol=1e-3)
    np.testing.assert_array_equal(found.y, expected.y)
    assert (found.Ts, found.counts_per_rev, found.name) == (0.001, 1572.0, "chirp")


def test_a_second_recording_repeats_the_first(drive: Drive) -> None:
    first, second = record(drive, command()), record(drive, command())
    np.testing.assert_array_equal(first.counts, second.counts)


def test_a_loop_is_that_of_the_virtual_machine(drive: Drive) -> None:
    found = run(controller(), drive, "trapezoid")
    expected = run(controller(), VirtualMachine(), "trapezoid")
    # the device computes in single precision and applies whole steps of the command
    assert np.sqrt(np.mean((found.y - expected.y) ** 2)) < 2.0
    assert np.abs(found.y - expected.y).max() < 10.0
    np.testing.assert_array_equal(found.r, expected.r)
    ours, theirs = found.metrics(), expected.metrics()
    assert ours["rise_time_ms"] == pytest.approx(theirs["rise_time_ms"], abs=1.0)
    assert (found.plant, found.reference) == ("virtual", "trapezoid")


def test_a_file_holds_the_run(drive: Drive, tmp_path: Path) -> None:
    path = tmp_path / "step.mcap"
    found = record(drive, command(), name="step", file=path, settings={"seed": 3})
    kept = read_recording(path)
    assert kept.complete
    np.testing.assert_array_equal(kept.columns["u"], found.u)
    np.testing.assert_array_equal(kept.columns["counts"], found.counts)
    assert kept.header.device["name"] == "virtual"
    assert kept.header.settings["seed"] == 3
    assert kept.header.settings["limits"]["volt"] == pytest.approx(20.0)
    assert [e["kind"] for e in kept.events][-1] == "finished"
    data = read(path, inputs="u", counts="counts")
    np.testing.assert_array_equal(data.experiments[0].y, found.y)


def test_a_run_says_its_controller_in_its_file(drive: Drive, tmp_path: Path) -> None:
    run(controller(), drive, "trapezoid", file=tmp_path / "run.mcap")
    settings = read_recording(tmp_path / "run.mcap").header.settings
    assert settings["controller"]["gains"] == controller().to_dict()["gains"]


def test_lost_samples_are_nan_and_listed(tmp_path: Path) -> None:
    with (
        VirtualDevice(fast=True, faults="drop=0.02,flip=0.01", seed=5) as device,
        connect(device.port) as drive,
    ):
        drive.set_limits()
        found = record(drive, command(), file=tmp_path / "step.mcap")
        outcome = drive.outcome
    assert outcome is not None
    missing = np.isnan(found.u)
    assert 0 < missing.sum() < 1500
    assert missing.sum() == sum(count for _, count in outcome.gaps)
    there = ~missing
    expected = record(VirtualMachine(), command())
    # the first count may be lost: counts are told from the first that came
    np.testing.assert_array_equal(np.diff(found.counts[there]), np.diff(expected.counts[there]))
    kept = read_recording(tmp_path / "step.mcap")
    assert kept.gaps == outcome.gaps
    assert not kept.complete
    assert np.isfinite(found.y[there]).mean() > 0.9


def test_a_loop_with_lost_samples_is_scored_on_the_others(tmp_path: Path) -> None:
    with (
        VirtualDevice(fast=True, faults="drop=0.02", seed=4) as device,
        connect(device.port) as drive,
    ):
        drive.set_limits()
        found = run(controller(), drive, "trapezoid")
    assert np.isnan(found.y).any()
    told = found.metrics()
    assert told["rise_time_ms"] is None
    assert told["rmse"] is not None
    assert 0.0 < told["rmse"] < 1000.0
    assert "rms" in str(found)


def test_a_trip_is_an_error_that_keeps_what_came(drive: Drive, tmp_path: Path) -> None:
    drive.set_limits(speed_rpm=1500.0)
    path = tmp_path / "step.mcap"
    with pytest.raises(LinkError, match=r"tripped: speed.*step\.mcap") as caught:
        record(drive, np.full(3000, 5.0), file=path)
    assert 100 < len(caught.value.recording) < 3000
    kept = read_recording(path)
    assert kept.outcome == "tripped: speed"
    assert len(kept) == len(caught.value.recording)
    with pytest.raises(LinkError, match="clear"):
        record(drive, np.full(100, 1.0))
    drive.clear()
    drive.set_limits(speed_rpm=6000.0)
    assert len(record(drive, np.full(100, 1.0))) == 100


def test_a_refused_run_leaves_no_file(drive: Drive, tmp_path: Path) -> None:
    drive.set_limits(volt=2.0)
    with pytest.raises(SettingError, match="2 V"):
        record(drive, np.full(100, 5.0), file=tmp_path / "step.mcap")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_told_before_anything_moves(
    drive: Drive, tmp_path: Path
) -> None:
    from sewfast.errors import DataError

    with pytest.raises(DataError, match="nowhere"):
        record(drive, command(), file=tmp_path / "nowhere" / "step.mcap")
    assert drive.status().state == "idle"


def test_a_vanished_port_ends_the_run_and_keeps_what_came(tmp_path: Path) -> None:
    path = tmp_path / "step.mcap"
    with VirtualDevice(fast=False) as device:
        # the watchdog is longer than a busy machine keeps this process waiting
        drive = connect(device.port, watchdog=2.0, resume=0.1)
        drive.set_limits()
        once_on(device, device.stop, after=0.3)
        with pytest.raises(LinkError, match=r"step\.mcap") as caught:
            record(drive, np.full(5000, 3.0), file=path)
        drive.close()
    kept = read_recording(path)
    assert kept.outcome == "failed"
    assert 0 < len(kept) == len(caught.value.recording) < 5000


@pytest.mark.parametrize("what", ["record", "run"])
def test_cancelled_it_stops_the_motor_and_gives_what_came(tmp_path: Path, what: str) -> None:
    path, cancel = tmp_path / "step.mcap", threading.Event()
    with VirtualDevice(fast=False) as device, connect(device.port, watchdog=5.0) as drive:
        drive.set_limits()
        once_on(device, cancel.set, after=0.2)
        calls = {
            "record": lambda: record(drive, np.full(20_000, 3.0), file=path, cancel=cancel),
            "run": lambda: run(
                controller(), drive, np.full(20_000, 500.0), file=path, cancel=cancel
            ),
        }
        with pytest.raises(Interrupted) as caught:
            calls[what]()
        assert drive.status().state == "idle"
    best = caught.value.best
    assert 0 < len(best.u) < 20_000
    kept = read_recording(path)
    assert (kept.outcome, len(kept)) == ("cancelled", len(best.u))


def test_cancelled_before_the_start_nothing_moves(device: VirtualDevice, drive: Drive) -> None:
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(Interrupted) as caught:
        record(drive, command(), cancel=cancel)
    assert len(caught.value.best) == 0
    assert "on" not in {entry["event"] for entry in device.trace()}


def test_ctrl_c_stops_the_motor_and_keeps_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "step.mcap"
    with VirtualDevice(fast=False) as device, connect(device.port, watchdog=5.0) as drive:
        drive.set_limits()
        once_on(device, lambda: os.kill(os.getpid(), signal.SIGINT), after=0.3)
        with pytest.raises(Interrupted) as caught:
            record(drive, np.full(20_000, 3.0), file=path)
        assert drive.status().state == "idle"
        safe = [entry for entry in device.trace() if entry["event"] == "off"]
        assert safe
    assert 0 < len(caught.value.best) < 20_000
    kept = read_recording(path)
    assert kept.outcome == "interrupted"
    assert len(kept) == len(caught.value.best)


def test_a_short_outage_is_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "step.mcap"
    with (
        VirtualDevice(fast=False) as device,
        connect(device.port, watchdog=10.0, resume=10.0) as drive,
    ):
        drive.set_limits()
        once_on(device, lambda: device.cause("unplug", 0.2), after=0.3)
        found = record(drive, np.full(2000, 3.0), file=path)
    assert len(found) == 2000
    assert 0 < np.isnan(found.u).sum() < 2000
    kinds = [e["kind"] for e in read_recording(path).events]
    assert "port_lost" in kinds
    assert "resumed" in kinds
    assert kinds[-1] == "finished"


# --- the command line ---------------------------------------------------------------------------


def test_commands_record_and_run_on_a_port(device: VirtualDevice, tmp_path: Path) -> None:
    port = device.port
    told = sewfast(tmp_path, "record", "--on", port, "--signal", "step", "-o", "a.mcap", "--json")
    assert told.json()["n"] == 3000
    assert told.json()["missing"] == 0
    assert told.json()["machine"] == "virtual"
    sewfast(tmp_path, "record", "--on", port, "--signal", "step", "-o", "b.csv")
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "b.mcap", "b.csv"}
    controller().save(tmp_path / "c.json")
    told = sewfast(
        tmp_path, "run", "c.json", "--on", port, "--reference", "trapezoid", "-o", "r.csv", "--json"
    )  # fmt: skip
    assert told.json()["plant"] == "virtual"
    assert told.json()["rise_time_ms"] > 50.0
    assert {"r.csv", "r.mcap"} <= {p.name for p in tmp_path.iterdir()}


def test_limits_given_are_enforced(device: VirtualDevice, tmp_path: Path) -> None:
    limits = "volt=10,speed=500,acceleration=inf,current=inf"
    arguments = ("--on", device.port, "--signal", "step", "-o", "a.mcap", "--limits", limits)
    told = sewfast(tmp_path, "record", *arguments, done=2)
    assert "tripped: speed" in told.err
    assert "a.mcap" in told.err
    assert read_recording(tmp_path / "a.mcap").outcome == "tripped: speed"
    assert "tripped (speed)" in sewfast(tmp_path, "stop", device.port).out
    assert sewfast(tmp_path, "clear", device.port, "--json").json()["state"] == "idle"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("--limits", "volt=10"), "each of"),
        (("--limits", "volt=a,speed=1,acceleration=1,current=1"), "numbers"),
        (("--limits", "volt=1000,speed=1,acceleration=1,current=1"), "ceiling"),
        (("--limits", "volt=-1,speed=1,acceleration=1,current=1"), "raise it"),
        (("--watchdog", "0"), "expected 1 to 10000 ms, got 0"),
        (("--live", "radio"), "radio"),
    ],
)
def test_unusable_options_are_refused(
    device: VirtualDevice, tmp_path: Path, arguments: tuple[str, ...], word: str
) -> None:
    assert word in refused(
        tmp_path, "record", "--on", device.port, "--signal", "step", "-o", "a.mcap", *arguments
    )


def test_a_drive_needs_a_file_and_a_port_must_be_there(
    device: VirtualDevice, tmp_path: Path
) -> None:
    assert "-o FILE" in refused(tmp_path, "record", "--on", device.port, "--signal", "step")
    error = refused(tmp_path, "record", "--on", "/dev/ttyNONE", "--signal", "step", "-o", "a.mcap")
    assert "sewfast ports" in error
    error = refused(
        tmp_path, "record", "--on", "socket://127.0.0.1:9", "--signal", "step", "-o", "a.mcap"
    )
    assert "sewfast device" in error


def test_limits_of_an_earlier_command_do_not_stay(device: VirtualDevice, tmp_path: Path) -> None:
    arguments = ("record", "--on", device.port, "--signal", "step", "-o")
    limits = "volt=8,speed=300,acceleration=inf,current=inf"
    sewfast(tmp_path, *arguments, "a.mcap", "--limits", limits, done=2)
    sewfast(tmp_path, "clear", device.port)
    assert sewfast(tmp_path, *arguments, "b.mcap", "--json").json()["n"] == 3000


def test_a_second_thread_is_refused(tmp_path: Path) -> None:
    refusals: list[BaseException] = []
    with VirtualDevice(fast=False) as device, connect(device.port, watchdog=5.0) as drive:
        drive.set_limits()

        def disturb() -> None:
            try:
                drive.status()
            except SettingError as e:
                refusals.append(e)

        thread = once_on(device, disturb, after=0.0)
        found = record(drive, np.full(1500, 2.0))
        thread.join()
    assert len(found) == 1500
    assert refusals
    assert "one thread" in str(refusals[0])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_on_the_command_line(tmp_path: Path, number: signal.Signals) -> None:
    with VirtualDevice(fast=False) as device:
        process = subprocess.Popen(
            [*PROGRAM, "record", "--on", device.port, "--signal", "chirp_lo_hi", "-o", "a.mcap",
             "--watchdog", "5000"],
            cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        until(lambda: is_on(device))
        time.sleep(0.3)
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
        assert [e["event"] for e in device.trace() if e["event"] in ("on", "off")][-1] == "off"
    assert process.returncode == 130
    assert "interrupted" in err
    assert "Traceback" not in err
    assert read_recording(tmp_path / "a.mcap").outcome == "interrupted"
