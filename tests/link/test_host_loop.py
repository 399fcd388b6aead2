"""The loop on the host: its thread over a pseudo-terminal, its results."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from link_device import ARM, DRIVE, START, STOP, ScriptedDevice
from sewfast import Controller, Gains, VirtualMachine, _core, read_table, write_table
from sewfast.cli import main
from sewfast.errors import Interrupted, LinkError, SettingError
from sewfast.link import (
    Drive,
    HostLoopRun,
    Jitter,
    VirtualDevice,
    at_period,
    connect,
    run_on_host,
)
from sewfast.link.host_loop import _batch
from sewfast.recordfile import read_recording

pytest.importorskip("serial", reason="opens pseudo-terminals as serial ports")

# the scripted device's motor moves u counts a sample: 38.2 u RPM
CONTROLLER = Controller(Gains.standard(0.005, 0.1), Ts=0.01, u_min=-10.0, u_max=10.0)


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """Descriptors of a pseudo-terminal: the device's end, the host's."""
    device, host = os.openpty()
    tty.setraw(host)
    yield device, host
    for descriptor in (device, host):
        with contextlib.suppress(OSError):
            os.close(descriptor)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[ScriptedDevice]:
    with ScriptedDevice(tmp_path) as served:
        yield served


@pytest.fixture
def drive(device: ScriptedDevice) -> Iterator[Drive]:
    # longer than a busy machine keeps the loop's thread waiting
    connected = connect(device.url, watchdog=5.0)
    connected.set_limits()
    yield connected
    connected.close()


def _at_tick(device: ScriptedDevice, number: int, action: Callable[[], object]) -> None:
    """Have the device do something when the command of a tick comes."""
    ticks = iter(range(1, 1_000_000))

    def listen(frame: tuple[int, int, int, int, bytes]) -> bool:
        if frame[0] == DRIVE and next(ticks) == number:
            action()
        return False

    device.intercept = listen


def _host_loop(port: int, **changed: Any) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "tag": 1, "session": 5, "key": 0, "command": 0, "heartbeat": 0, "device_period": 1000,
        "ratio": 10, "watchdog": 50_000, "batch": 10, "mask": 1, "channels": [(0, 1)],
        "counts_per_unit": 26.2,
    }  # fmt: skip
    return _core.host_loop(port, CONTROLLER.core(), np.full(10, 100.0), **settings | changed)


def test_a_device_that_is_not_there_is_an_outcome(terminal: tuple[int, int]) -> None:
    found = _host_loop(terminal[1])
    assert found["outcome"] == {"name": "unanswered", "command": ARM}
    assert not found["stopped"]
    assert len(found["times"]) == 0
    assert found["sequences"] == (2, 0)
    frames = os.read(terminal[0], 4096).split(b"\0")
    assert len(frames) == 111, "ten times ARM, a hundred times STOP"


def test_a_port_that_vanishes_is_an_outcome(terminal: tuple[int, int]) -> None:
    os.close(terminal[0])
    found = _host_loop(terminal[1])
    assert found["outcome"]["name"] == "port_lost"
    assert "os error" in found["outcome"]["text"]


def test_refuses_what_cannot_run(terminal: tuple[int, int]) -> None:
    with pytest.raises(SettingError, match="watchdog time longer than"):
        _host_loop(terminal[1], watchdog=5000)
    with pytest.raises(SettingError, match="an open port"):
        _host_loop(-1)


def test_runs_the_reference_and_gives_the_session_back(
    drive: Drive, device: ScriptedDevice
) -> None:
    r = np.full(60, 190.8)
    run = run_on_host(drive, CONTROLLER, r, columns=["speed_true"], batch=11)
    assert run.outcome == "completed"
    assert run.is_complete
    assert run.taken == len(run.samples["t"]) >= 600
    assert run.stop_confirmed
    assert np.array_equal(run.samples["t"], np.arange(run.taken) / 1000)
    assert set(run.samples) == {"t", "counts", "u", "speed_true"}
    assert run.sample_units["u"] == "V"
    # what was said was applied, rounded to the channel's steps
    said = run.u[np.isfinite(run.u)]
    assert set(np.round(run.samples["u"], 3)) <= {0.0, *np.round(said, 3)}
    assert len(run.jitter.late) + run.jitter.missed == 60
    assert [kind for kind, _ in device.executed if kind in (ARM, START, STOP)] == [ARM, START, STOP]
    assert sum(kind == DRIVE for _, kind in device.arrived) == len(said)
    assert drive.status().state == "idle"
    assert run_on_host(drive, CONTROLLER, r).outcome == "completed", "the session goes on"


def test_a_motor_that_creeps_is_waited_for(drive: Drive, device: ScriptedDevice) -> None:
    device.creeping = 2
    assert run_on_host(drive, CONTROLLER, np.full(20, 100.0)).outcome == "completed"
    assert sum(kind == ARM for kind, _ in device.executed) == 3


def test_an_error_of_progress_leaves_a_session_that_can_stop(
    drive: Drive, device: ScriptedDevice
) -> None:
    def fail(done: int, total: int, best: float) -> None:
        if done > 5:
            raise RuntimeError("of progress")

    with pytest.raises(RuntimeError, match="of progress"):
        run_on_host(drive, CONTROLLER, np.full(400, 100.0), progress=fail)
    # the loop's numbers are lost with it: a smaller one would be ignored as old
    drive.stop()
    assert [kind for kind, _ in device.executed][-1] == STOP
    assert run_on_host(drive, CONTROLLER, np.full(20, 100.0)).outcome == "completed"


def test_a_trip_is_an_outcome_with_its_reason(drive: Drive, device: ScriptedDevice) -> None:
    _at_tick(device, 5, lambda: device.trip(2, 3100.0))
    run = run_on_host(drive, CONTROLLER, np.full(400, 100.0))
    assert run.outcome == "tripped"
    assert "speed at 3100" in run.message
    assert 0 < len(run.t) < 400
    assert run.taken == len(run.samples["t"])


def test_a_device_that_falls_silent_is_stopped(drive: Drive, device: ScriptedDevice) -> None:
    def mute() -> None:
        device.mangle = lambda kind, wire: [] if kind == 0xC0 else [wire]

    _at_tick(device, 5, mute)
    run = run_on_host(drive, CONTROLLER, np.full(400, 100.0), watchdog=2.0)
    assert run.outcome == "silent"
    assert run.stop_confirmed
    assert device.state == 1
    [(first, count)] = run.gaps
    assert first == len(run.samples["t"])
    assert first + count == run.taken


def test_lost_samples_are_gaps_and_the_loop_goes_on(drive: Drive, device: ScriptedDevice) -> None:
    batches = iter(range(10_000))
    device.mangle = lambda kind, wire: [] if kind == 0xC0 and next(batches) in (3, 4, 9) else [wire]
    run = run_on_host(drive, CONTROLLER, np.full(40, 100.0))
    assert run.outcome == "completed"
    assert run.gaps == ((30, 20), (90, 10))
    assert not run.is_complete
    assert "20 from sample 30, 10 from sample 90" in str(run)
    assert run.jitter.blind >= 2


def test_a_port_that_vanishes_in_the_run_keeps_the_samples(
    drive: Drive, device: ScriptedDevice
) -> None:
    _at_tick(device, 10, device.wire.unplug)
    run = run_on_host(drive, CONTROLLER, np.full(400, 100.0))
    assert run.outcome == "port_lost"
    assert len(run.samples["t"]) > 10
    assert run.taken is None
    assert "watchdog stops the motor" in run.message


def test_a_reset_ends_the_run(drive: Drive, device: ScriptedDevice) -> None:
    _at_tick(device, 5, device.reset)
    assert run_on_host(drive, CONTROLLER, np.full(400, 100.0)).outcome == "reset"


def test_ctrl_c_stops_before_the_next_tick_and_keeps_the_run(
    drive: Drive, device: ScriptedDevice
) -> None:
    pressed: list[float] = []

    def press() -> None:
        pressed.append(time.monotonic())
        signal.raise_signal(signal.SIGINT)

    # 8.9 s before the next deadline, for which the loop must not wait
    slow = replace(CONTROLLER, Ts=9.0)
    _at_tick(device, 1, threading.Timer(0.1, press).start)
    with pytest.raises(Interrupted) as caught:
        run_on_host(drive, slow, np.full(40, 100.0), watchdog=10.0)
    stopped = min(at for at, kind in device.arrived if kind == STOP)
    assert stopped - pressed[0] < 8.0
    run = caught.value.best
    assert isinstance(run, HostLoopRun)
    assert run.outcome == "interrupted"
    assert len(run.samples["t"]) == run.taken
    assert "interrupted" in run._repr_html_()


def test_a_refusal_says_what_to_do(device: ScriptedDevice) -> None:
    with contextlib.closing(connect(device.url)) as drive, pytest.raises(LinkError, match="limits"):
        run_on_host(drive, CONTROLLER, np.full(10, 100.0))


def test_refuses_before_anything_moves(drive: Drive, device: ScriptedDevice) -> None:
    amperes = replace(CONTROLLER, gains=Gains.standard(0.005, 0.1, u_unit="A"))
    for controller, received in (
        (replace(CONTROLLER, Ts=0.001), "0.001 s"),
        (replace(CONTROLLER, Ts=0.0105), "0.0105 s"),
        (amperes, "A"),
    ):
        with pytest.raises(SettingError) as refused:
            run_on_host(drive, controller, np.full(10, 100.0))
        assert (refused.value.name, refused.value.received) == ("controller", received)
    assert ARM not in [kind for kind, _ in device.executed]


def test_a_device_on_credit_is_refused(tmp_path: Path) -> None:
    with (
        ScriptedDevice(tmp_path, capabilities=0b101111) as device,
        contextlib.closing(connect(device.url)) as drive,
        pytest.raises(SettingError, match="without --fast"),
    ):
        run_on_host(drive, CONTROLLER, np.full(10, 100.0))


def test_named_references_are_taken_at_the_loops_period(drive: Drive) -> None:
    run = run_on_host(drive, replace(CONTROLLER, Ts=0.05), "trapezoid")
    assert run.reference == "trapezoid"
    assert len(run.r) == 30
    assert run.r[0] == 0.0
    assert run.r.max() == pytest.approx(3000.0)


def test_a_wish_for_real_time_is_answered_either_way(drive: Drive) -> None:
    run = run_on_host(drive, CONTROLLER, np.full(10, 0.0), real_time=True)
    told = run.jitter.real_time
    assert "SCHED_FIFO" in told or "refused" in told or "not offered" in told
    assert "memory" in told
    if hasattr(os, "sched_getscheduler"):
        assert os.sched_getscheduler(0) == os.SCHED_OTHER, "given back"


@pytest.mark.parametrize(
    ("ratio", "batch"), [(2, 2), (5, 5), (7, 7), (11, 10), (20, 10), (25, 5), (36, 9), (100, 10)]
)
def test_frames_divide_the_period_where_they_can(ratio: int, batch: int) -> None:
    assert _batch(ratio) == batch


def test_a_controller_at_another_period_averages_over_the_same_time() -> None:
    fast = Controller(Gains.per_sample(0.02, 0.0002, 0.5, Ts=0.001), filter_samples=40)
    slow = at_period(fast, 0.01)
    assert (slow.Ts, slow.filter_samples) == (0.01, 4)
    assert slow.gains.to("standard") == fast.gains.to("standard")
    assert "made for 0.001 s" in slow.notes
    assert at_period(fast, 0.1).filter_samples == 1


def _jitter(**changed: Any) -> Jitter:
    values: dict[str, Any] = {
        "late": np.array([0.0, 40.0, 60.0, 70.0, 2500.0]),
        "age": np.array([np.nan, 3000.0, 4000.0, 5000.0, 2e7]), "period": 1e4, "missed": 2,
        "blind": 1, "unsent": 0, "round_trip": 310.0, "device_late": 12, "real_time": "ordinary",
    }  # fmt: skip
    return Jitter(**values | changed)


def test_the_histogram_holds_every_tick_once() -> None:
    histogram = _jitter().histogram()
    edges, late, age = histogram["edges_us"], histogram["late"], histogram["age"]
    assert len(edges) == len(late) + 1
    assert late.sum() == 5
    assert age.sum() == 4
    assert late[0] == 1, "below the first bin"
    assert age[-1] == 1, "beyond the last one"
    assert late[np.searchsorted(edges, 2500.0) - 1] == 1


def test_percentiles_are_times_that_were_measured() -> None:
    late = np.arange(1.0, 1001.0)
    found = _jitter(late=late).percentiles()["late_us"]
    assert found == {"median": 501.0, "p99": 991.0, "p999": 1000.0, "worst": 1000.0}


def test_jitter_prints_and_serialises_even_without_ticks() -> None:
    text = str(_jitter())
    assert "missed deadlines 2, ticks without a new sample 1" in text
    assert "2.5 ms" in text
    assert "no bounds" in text
    empty = _jitter(late=np.empty(0), age=np.empty(0), round_trip=None)
    assert "0 us" not in str(empty).splitlines()[2]
    told = json.loads(json.dumps(empty.to_dict(), allow_nan=False))
    assert told["late_us"]["worst"] is None


def test_jitter_draws_both_histograms(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    path = tmp_path / "jitter.png"
    _jitter().plot(file=path)
    assert path.read_bytes().startswith(b"\x89PNG")


# --- on the virtual machine -----------------------------------------------------------------------

SLOW = Controller(Gains.standard(0.002, 0.25), Ts=0.02, u_min=0.0, u_max=10.0)
RAMP = np.interp(np.arange(0.0, 2.0, 0.02), [0.2, 1.2], [0.0, 1500.0])


def _simulated() -> np.ndarray:
    """The same loop without a link: measured and applied at once."""
    machine, core, y = VirtualMachine(), SLOW.core(), []
    before = machine.counts
    for r in RAMP:
        y.append((machine.counts - before) / (0.02 * machine.counts_per_rev / 60.0))
        before = machine.counts
        machine.run(np.full(20, core.step(r, y[-1])))
    return np.array(y)


@pytest.mark.parametrize("endpoint", ["pty", "tcp"])
def test_tracks_as_the_loop_without_a_link(endpoint: Any) -> None:
    with VirtualDevice(endpoint=endpoint) as device, connect(device.port, watchdog=10.0) as drive:
        drive.set_limits()
        run = run_on_host(drive, SLOW, RAMP)
    assert run.outcome == "completed"
    assert run.metrics()["rmse"] is not None
    # the samples are the machine's answer to the commands, whenever those came
    u, counts = run.samples["u"], run.samples["counts"]
    if run.is_complete:
        alone = VirtualMachine().run(u).counts
        np.testing.assert_allclose(counts - counts[0], alone, rtol=0.0, atol=1.0)
    # the commands are the controller's own, whatever the feedback was when its tick came
    core, ran = SLOW.core(), np.isfinite(run.y)
    said = np.array([core.step(r, y) for r, y in zip(run.r[ran], run.y[ran], strict=True)])
    if run.jitter.missed == 0:
        np.testing.assert_allclose(run.u[ran], said, rtol=1e-9, atol=1e-9)
    # late by less than a tenth of a period, the loop is that without a link and 10 samples behind
    if run.jitter.missed == 0 and run.jitter.late.max() < 2000.0:
        assert np.sqrt(np.mean((run.y - _simulated())[ran] ** 2)) < 60.0


def test_faults_are_gaps_and_nothing_is_lost_unnoticed(tmp_path: Path) -> None:
    with (
        VirtualDevice(faults="drop=.02,flip=.01", seed=4) as device,
        connect(device.port, watchdog=10.0) as drive,
    ):
        drive.set_limits()
        run = run_on_host(drive, SLOW, RAMP)
    assert run.outcome == "completed"
    assert run.gaps
    assert run.taken is not None
    assert run.taken >= 2000
    assert len(run.samples["t"]) + sum(n for _, n in run.gaps) == run.taken
    run.save_samples(tmp_path / "run.csv")
    table = read_table(tmp_path / "run.csv")
    assert len(table["u"]) == run.taken
    assert np.count_nonzero(np.isnan(table["u"])) == sum(n for _, n in run.gaps)
    run.save_samples(tmp_path / "run.mcap")
    recording = read_recording(tmp_path / "run.mcap")
    assert np.array_equal(np.isnan(recording.columns["u"]), np.isnan(table["u"]))


def test_the_watchdog_ends_a_host_that_stands_still(tmp_path: Path) -> None:
    with VirtualDevice() as device, connect(device.port) as drive:
        drive.set_limits()
        threading.Timer(0.5, device.cause, ("stall", 0.3)).start()
        run = run_on_host(drive, SLOW, RAMP, watchdog=0.1)
        assert run.outcome in ("silent", "tripped")
        assert drive.status().state != "running"


@pytest.fixture
def controller_file(tmp_path: Path) -> str:
    SLOW.save(tmp_path / "controller.json")
    write_table(tmp_path / "ramp.csv", {"t": 0.02 * np.arange(60), "r": RAMP[:60]})
    return str(tmp_path / "controller.json")


def test_the_command_runs_and_writes(
    controller_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", controller_file, "--reference", str(tmp_path / "ramp.csv"), "--host-loop"]
    command += ["-o", str(tmp_path / "run.csv"), "--samples", str(tmp_path / "samples.mcap")]
    command += ["--plot", str(tmp_path / "jitter.png"), "--json", "--watchdog", "10000"]
    with VirtualDevice() as device:
        assert main([*command, "--on", device.port]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["outcome"] == "completed"
    assert told["samples"] + sum(n for _, n in told["gaps"]) == told["taken"] >= 1200
    assert sum(told["jitter"]["histogram"]["late"]) == told["jitter"]["ticks"]
    names = [header.split(" ")[0] for header in read_table(tmp_path / "run.csv").columns]
    assert names == ["t", "r", "u", "y", "feedback", "late", "age"]
    assert len(read_recording(tmp_path / "samples.mcap").columns["counts"]) == told["taken"]
    assert (tmp_path / "jitter.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_refuses_and_says_why(
    controller_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", controller_file, "--reference", "trapezoid", "--host-loop", "20"]
    assert main([*command, "--on", "virtual"]) == 2
    assert "--on PORT" in capsys.readouterr().err
    with VirtualDevice(fast=True) as device:
        assert main([*command, "--on", device.port]) == 2
    assert "without --fast" in capsys.readouterr().err
    assert main([*command[:-1], "-5", "--on", "socket://localhost:1"]) == 2
    assert "up to 10000 ms" in capsys.readouterr().err


def test_a_trip_exits_with_2_and_keeps_the_columns(
    controller_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", controller_file, "--reference", str(tmp_path / "ramp.csv"), "--host-loop"]
    command += ["--limits", "volt=20,speed=300,acceleration=inf,current=inf"]
    command += ["-o", str(tmp_path / "run.csv"), "--watchdog", "10000"]
    with VirtualDevice() as device:
        assert main([*command, "--on", device.port]) == 2
    assert "tripped: speed" in capsys.readouterr().err
    assert 0 < len(read_table(tmp_path / "run.csv")["t"]) < 60
