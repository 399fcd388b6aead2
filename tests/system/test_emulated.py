"""The example firmware in C on an emulated Cortex-M4 and M7, as a host sees it."""

from __future__ import annotations

import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import sewfast
from sewfast.cli import main
from sewfast.errors import LinkError, SettingError
from sewfast.link import connect, examine
from sewfast_deploy.emulated import BOARDS, EmulatedBoard, build_firmware

ROOT = Path(__file__).resolve().parents[2]
FIRMWARE = ROOT / "target" / "bare" / "mps2-an386.elf"
LIMITS = {"volt": 10.0, "speed_rpm": 8000.0, "acceleration": 90_000.0, "current": float("inf")}

TRIALS = int(os.environ.get("SEWFAST_TRIALS", "3"))
"""How often the host is killed; `make killed` asks for 100."""

needs_board = pytest.mark.skipif(
    shutil.which("qemu-system-arm") is None or not FIRMWARE.exists(),
    reason="needs qemu-system-arm and the firmware for the emulated board: make firmware",
)


def controller() -> sewfast.Controller:
    """Everything that a controller may have: the deepest stack."""
    gains = sewfast.Gains.standard(Kp=0.02, Ti=0.1, Td=0.002)
    return sewfast.Controller(
        gains, Ts=0.001, alpha=0.4, N=10, u_min=-10, u_max=10, slew=4000, filter_samples=8,
        observer_time=0.003, r_rate=20_000,
    )  # fmt: skip


@pytest.mark.nightly("measures the link for half a minute")
@needs_board
@pytest.mark.parametrize("clock", ["credit", "real"])
@pytest.mark.parametrize("name", BOARDS)
def test_the_doctor_finds_nothing_wrong(name: str, clock: str) -> None:
    with EmulatedBoard(FIRMWARE.with_name(f"{name}.elf"), clock=clock) as board:  # type: ignore[arg-type]
        assert board.board == name
        found = examine(board.port)
    assert found["device"].values["device"] == "emulated drive"
    assert found["clock"].verdict == "ok"
    # a busy computer may be slow, which is the computer's
    worse = [f.name for f in found.findings if f.verdict != "ok"]
    assert set(worse) <= {"round trip", "throughput"}, found


@needs_board
def test_a_computer_that_pauses_the_emulator_does_not_bend_its_clock() -> None:
    """What the board makes up for after a pause must not be seen as a clock that runs back."""
    with EmulatedBoard(FIRMWARE, clock="real") as board:
        over = threading.Event()

        def pause() -> None:
            while not over.wait(0.05):
                board.process.send_signal(signal.SIGSTOP)
                time.sleep(0.015)
                board.process.send_signal(signal.SIGCONT)

        busy = threading.Thread(target=pause)
        busy.start()
        try:
            found = examine(board.port)
        finally:
            over.set()
            busy.join()
    assert found["clock"].verdict == "ok", found


@needs_board
def test_recordings_on_credit_are_equal_and_the_processor_is_measured() -> None:
    """On either processor: the Cortex-M7 has the bits of the Cortex-M4."""
    made = []
    for name in BOARDS:
        firmware = FIRMWARE.with_name(f"{name}.elf")
        with EmulatedBoard(firmware, boot_id=7) as board, connect(board.port) as drive:
            drive.set_limits(**LIMITS)
            chirp = sewfast.record(drive, sewfast.signals.excitation("chirp_lo_hi")[:3000])
            run = sewfast.run(controller(), drive, np.full(1000, 1000.0))
            figures = board.figures()
            made.append((chirp.counts, run.y, run.u))
        # ceilings, as an embedded developer plans by them
        # state feedback and its command took 4.5 KB more than the PID alone, feedforward and its
        # own 5.1; the longest period begins a run, and copies its controller
        assert figures.code <= 50 * 1024
        assert figures.stack <= 4400
        assert figures.memory <= 17 * 1024
        assert figures.steps >= 4000
        assert figures.instructions is not None
        least, mean, most = figures.instructions
        assert 100 < least < mean < most < 15_000
    for first, second in zip(*made, strict=True):
        np.testing.assert_array_equal(first, second)
    assert abs(made[0][1][-1] - 1000.0) < 20.0


@needs_board
@pytest.mark.slow("what keeps a machine safe is seen at once")
def test_a_killed_host_leaves_the_output_off_in_time() -> None:
    """In real time: within the watchdog and one period of the last bytes heard."""
    watchdog = 0.4
    host = (
        "import numpy, sewfast, sys\n"
        "from sewfast.link import connect\n"
        f"with connect(sys.argv[1], watchdog={watchdog}) as drive:\n"
        "    drive.set_limits(volt=10, speed_rpm=8000, acceleration=90000, current=float('inf'))\n"
        "    sewfast.record(drive, numpy.full(60_000, 5.0))\n"
    )
    late = []
    with EmulatedBoard(FIRMWARE, clock="real") as board:
        for trial in range(TRIALS):
            running = subprocess.Popen([sys.executable, "-c", host, board.port])
            until = time.monotonic() + 30.0
            while board.safe_after() is not None and time.monotonic() < until:
                assert running.poll() is None
                time.sleep(0.002)
            time.sleep(0.02 + 0.3 * np.random.default_rng(trial).random())
            running.send_signal(signal.SIGKILL)
            running.wait()
            while (after := board.safe_after()) is None and time.monotonic() < until:
                time.sleep(0.002)
            assert after is not None
            late.append(after)
            with connect(board.port) as drive:
                assert drive.status().reason == "watchdog"
                drive.clear()
    assert max(late) <= watchdog + 0.001, late
    # the last bytes need not be a whole heartbeat; a switch-off long before would be another cause
    assert min(late) > 0.5 * watchdog, late


@pytest.mark.nightly("measures the link, records and runs in real time")
@needs_board
def test_the_command_goes_from_doctor_to_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a folder, with a comma"
    words = ["pil", "--firmware", str(FIRMWARE), "--out", str(out), "--no-commission"]
    assert main(words) == 0
    printed = capsys.readouterr()
    assert "nothing is wrong with it" in printed.out
    assert "instructions a period" in printed.out
    assert {p.name for p in out.iterdir()} >= {"chirp.mcap", "first.json", "first.mcap"}
    assert main(words) == 2
    assert "--overwrite" in capsys.readouterr().err


@needs_board
def test_the_command_refuses_a_place_that_cannot_be_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    for wrong in (tmp_path / "file" / "below", tmp_path / ("x" * 300)):
        assert main(["pil", "--firmware", str(FIRMWARE), "--out", str(wrong)]) == 2
        assert "expected a folder that can be made" in capsys.readouterr().err


def test_what_is_no_firmware_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="source checkout"):
        build_firmware(tmp_path)
    with pytest.raises(SettingError, match="expected a file that can be read"):
        EmulatedBoard(tmp_path / "none.elf")
    other = tmp_path / "other.elf"
    for content in (b"", b"\x7fELF", b"\x7fELF\x02\x01" + bytes(100), bytes(1000)):
        other.write_bytes(content)
        with pytest.raises(SettingError, match="expected a firmware for ARM"):
            EmulatedBoard(other)
    # a whole header whose one segment lies in another board's memory
    head = (
        b"\x7fELF\x01\x01"
        + bytes(10)
        + struct.pack("<2HI3II6H", 2, 40, 1, 0, 52, 0, 0, 52, 32, 1, 0, 0, 0)
    )
    other.write_bytes(head + struct.pack("<8I", 1, 0, 0x08000000, 0x08000000, 0, 64, 5, 4))
    with pytest.raises(SettingError, match="or mps2-an500, received one for another board"):
        EmulatedBoard(other)
    with pytest.raises(SettingError, match="board: expected mps2-an386 or mps2-an500"):
        build_firmware(ROOT, board="mps2-an505")
    assert (
        main(
            ["pil", "--firmware", str(other), "--board", "mps2-an500", "--out", str(tmp_path / "o")]
        )
        == 2
    )
    with pytest.raises(SettingError, match="'credit' or 'real'"):
        EmulatedBoard(other, clock="none")  # type: ignore[arg-type]


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SettingError, match=r"arm-none-eabi-gcc.*apt-get install"):
        build_firmware(ROOT)


@needs_board
def test_an_emulator_that_ends_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "qemu-system-arm"
    broken.write_text("#!/bin/sh\necho out of order >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(LinkError, match="out of order"):
        EmulatedBoard(FIRMWARE)


@needs_board
def test_a_broken_motor_is_named_in_a_loop_and_at_rest() -> None:
    r = np.repeat([700.0, 1200.0, 900.0], 700)
    with EmulatedBoard(FIRMWARE, boot_id=3) as board, connect(board.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=2400.0)
        sewfast.run(controller(), drive, r)
        assert 1100.0 < board.fastest < 1800.0
        board.break_motor(0.9, command=-1.0)
        with pytest.raises(LinkError) as ended:
            sewfast.run(controller(), drive, r)
        cause = ended.value.cause
        assert cause is not None, ended.value
        assert cause.name == "command sign"
        assert abs(cause.at - 0.9) < 0.05
        assert "clear it" in str(ended.value)
        drive.clear()
        drive.wait_for_rest(20.0)
        # another fault begins anew, by its own time
        board.break_motor(0.8, command=0.5)
        slow = np.diff(sewfast.record(drive, np.full(1400, 3.0)).counts)
        assert slow[750:790].mean() > 1.8 * slow[-40:].mean()
        drive.wait_for_rest(20.0)
        for wrong in ({"lag": 0.0}, {"load": np.nan}, {"jump": 1e12}, {"after": -1.0}):
            with pytest.raises(SettingError, match=f"{next(iter(wrong))}: expected"):
                board.break_motor(**wrong)
        board.mend_motor()
        drive.wait_for_rest(20.0)
        board.break_motor(load=1.0)
        with pytest.raises(LinkError) as driven:
            sewfast.record(drive, np.ones(100))
        cause = driven.value.cause
        assert cause is not None, driven.value
        assert cause.name == "turns at rest"
        assert cause.value == pytest.approx(490.0 * (1.0 - 0.25), rel=0.05)
