"""The example firmware in C on an emulated Cortex-M4, as a host sees it."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from sewfast.link import examine

FIRMWARE = Path(__file__).resolve().parents[1] / "target" / "bare" / "mps2.elf"
BOOT = 0x12345678


@pytest.fixture
def board() -> Iterator[Callable[[], str]]:
    """Boots a board, and says where."""
    if shutil.which("qemu-system-arm") is None:
        pytest.skip("needs qemu-system-arm")
    if not FIRMWARE.exists():
        pytest.skip("needs the firmware for the emulated board: make firmware")
    with ExitStack() as boards:

        def boot() -> str:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = free.getsockname()[1]
            serial = f"tcp:127.0.0.1:{port},server=on,wait=off,nodelay=on"
            command = ["qemu-system-arm", "-M", "mps2-an386", "-display", "none"]
            command += ["-monitor", "none", "-serial", serial, "-kernel", str(FIRMWARE)]
            command += ["-device", f"loader,addr=0x203ffff0,data={BOOT},data-len=4"]
            running = boards.enter_context(subprocess.Popen(command))
            boards.callback(running.kill)
            listening = time.monotonic() + 10.0
            # a connection to try would be taken for a host
            table = Path("/proc/net/tcp")
            while f"0100007F:{port:04X} 00000000:0000 0A" not in table.read_text():
                assert running.poll() is None
                assert time.monotonic() < listening
                time.sleep(0.02)
            return f"socket://127.0.0.1:{port}"

        yield boot


def test_the_doctor_finds_nothing_wrong(board: Callable[[], str]) -> None:
    found = examine(board())
    assert found["device"].values["device"] == "emulated drive"
    assert found["clock"].verdict == "ok"
    # a busy computer may be slow, which is the computer's
    worse = [f.name for f in found.findings if f.verdict != "ok"]
    assert set(worse) <= {"round trip"}, found
