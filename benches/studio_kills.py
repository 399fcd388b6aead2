"""How long the output of a drive stays on after the browser, the studio or the link is gone.

A record runs on a virtual device, whose own account says when the output went off; the moment of
the fault is taken by the same clock just before it. Needs the extra `studio`, selenium, chromium
and chromedriver.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sewfast.link import VirtualDevice
from sewfast_studio import Project, Studio
from studio import browser, spread
from studio_stops import WATCHDOG_MS, arm, press, until

FAULTS = ("browser killed", "page hung", "tab closed", "tab frozen", "studio killed", "link pulled")
WATCHDOGS = ("studio killed", "link pulled")
"""Faults after which the pipe to the process at the port, or the device's watchdog, is to act."""

HANG = "setTimeout(() => { for (const end = Date.now() + 5000; Date.now() < end;); }, 0)"


class Address:
    """What `arm` takes of a studio."""

    def __init__(self, address: str) -> None:
        self.address = address


def family(pid: int) -> list[int]:
    """A process and all that it has started."""
    found = [pid]
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = file.read_text(encoding="utf-8").split()
        except OSError:
            continue
        for child in children:
            found += family(int(child))
    return found


def signal_all(pids: list[int], number: int) -> None:
    for pid in pids:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            continue


def serve(folder: str) -> None:
    with Studio(Project(folder)) as studio:
        print(studio.address, flush=True)
        sys.stdin.read()


def trial(fault: str) -> tuple[float, float]:
    """Milliseconds from the fault to the end of the output, and how late the device was itself."""
    with tempfile.TemporaryDirectory() as folder, VirtualDevice() as device:
        zero = time.monotonic()
        command = [sys.executable, __file__, "--serve", folder]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as server:
            assert server.stdout is not None
            page = browser()
            chromium = family(page.service.process.pid)[1:]
            try:
                arm(page, Address(server.stdout.readline().strip()), device)
                press(page, "arm")
                press(page, "record")
                until(lambda: events(device)[-1:] == ["on"])
                time.sleep(0.3)
                began = 1e3 * (time.monotonic() - zero)
                chromium = family(page.service.process.pid)[1:]
                DO[fault](page, server.pid, chromium, device)
                until(lambda: events(device)[-1:] == ["off"])
                off = [e for e in device.trace() if e["event"] == "off"][-1]
                return 1e3 * float(off["seconds"]) - began, 1e-3 * float(off["late_us"])
            finally:
                signal_all(chromium, signal.SIGKILL)
                page.service.stop()
                server.kill()


def events(device: VirtualDevice) -> list[str]:
    return [e["event"] for e in device.trace() if e["event"] in ("on", "off")]


DO: dict[str, Callable[[Any, int, list[int], VirtualDevice], object]] = {
    "browser killed": lambda page, server, pids, device: signal_all(pids, signal.SIGKILL),
    "page hung": lambda page, server, pids, device: page.execute_script(HANG),
    "tab closed": lambda page, server, pids, device: page.close(),
    "tab frozen": lambda page, server, pids, device: signal_all(pids, signal.SIGSTOP),
    "studio killed": lambda page, server, pids, device: os.kill(server, signal.SIGKILL),
    "link pulled": lambda page, server, pids, device: device.cause("unplug", 10.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--fault", choices=FAULTS, action="append")
    parser.add_argument("--serve", metavar="FOLDER")
    args = parser.parse_args()
    if args.serve:
        serve(args.serve)
        return
    found = {}
    for fault in args.fault or FAULTS:
        rows = [trial(fault) for _ in range(args.trials)]
        found[fault] = {
            **spread([took for took, _ in rows]),
            "device_late_ms": max(r[1] for r in rows),
        }
        print(json.dumps({fault: found[fault]}), file=sys.stderr, flush=True)
    print(json.dumps({"watchdog_ms": WATCHDOG_MS, **found}, indent=1))


if __name__ == "__main__":
    main()
