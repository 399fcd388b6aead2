"""The studio through an hour of live signals: pictures a second, gaps, growth of server and page.

A virtual drive plays an excitation over and over at 1 kHz while a browser looks on. The server is
a process of its own, so that its memory is its own. Needs the extra `studio`, selenium, chromium
and chromedriver.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import studio_stops
from sewfast.link import VirtualDevice
from sewfast.readers import read_table
from sewfast_studio import Project, Studio, line
from studio import browser
from studio_stops import arm, press, until

WARM = 60.0
"""Seconds after which memory is first looked at: caches are full, the live window is."""
LEASE_S, WATCHDOG_MS = 10.0, "10000"
"""A pause of a busy computer is a slow picture here, and not the end of the run."""
EVERY = 30.0
"""Seconds between two looks."""
FILE = "hour.mcap"

LONG = """
import numpy as np
from sewfast import signals
from sewfast_studio import bench
bench.LEASE = {lease}
once = signals.excitation
signals.excitation = lambda *a: np.resize(once(*a), {samples})
"""
COUNT = """
window.frames = 0; window.slow = 0; let before = performance.now();
document.addEventListener("frame", () => {
  const now = performance.now(); window.frames++;
  window.slow = Math.max(window.slow, now - before); before = now;
});
"""


def serve(folder: str, seconds: float) -> None:
    """The studio, whose drive plays an excitation again and again for so long."""
    before = "from sewfast_studio.bench import main"
    line._PROGRAM = line._PROGRAM.replace(
        before, f"exec({LONG.format(samples=round(1000 * seconds), lease=LEASE_S)!r}); {before}"
    )
    with Studio(Project(folder)) as studio:
        print(studio.address, flush=True)
        sys.stdin.read()


def resident(process: int) -> float:
    """Memory of a process [MB]."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    return next(int(x.split()[1]) / 1024.0 for x in lines if x.startswith("VmRSS"))


def renderer(page: Any) -> int:
    """The process of the page: of chromium's renderers the largest."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            words = (place / "cmdline").read_bytes()
            if b"--type=renderer" in words and page.encode() in words:
                found.append((resident(int(place.name)), int(place.name)))
        except (OSError, StopIteration):
            continue
    return max(found)[1]


class Address:
    """What `arm` takes of a studio."""

    def __init__(self, address: str) -> None:
        self.address = address


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--serve", metavar="FOLDER")
    args = parser.parse_args()
    if args.serve:
        serve(args.serve, args.seconds)
        return
    studio_stops.WATCHDOG_MS = WATCHDOG_MS
    with tempfile.TemporaryDirectory() as folder, VirtualDevice() as device:
        command = [sys.executable, __file__, "--serve", folder, f"--seconds={args.seconds}"]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as server:
            assert server.stdout is not None
            page = browser()
            try:
                arm(page, Address(server.stdout.readline().strip()), device)
                found = watched(page, server.pid, args.seconds)
            finally:
                page.quit()
                assert server.stdin is not None
                server.stdin.close()
        table = read_table(Path(folder) / FILE)
        rows = np.array([table[name] for name in table.names])
        found["recorded"] = rows.shape[1]
        found["missing_in_file"] = int(np.isnan(rows).any(axis=0).sum())
        found["channels"] = list(table.names)
    print(json.dumps(found, indent=1))


def watched(page: Any, server: int, seconds: float) -> dict[str, Any]:
    until(lambda: not page.find_element("id", "arm").get_attribute("disabled"))
    name = page.find_element("id", "record-file")
    name.clear()
    name.send_keys(FILE)
    page.execute_script(COUNT)
    press(page, "arm")
    press(page, "record")
    until(lambda: page.execute_script("return window.frames") > 0)
    folder = page.capabilities["chrome"]["userDataDir"]
    rows: list[tuple[float, float, float, float, int]] = []
    began, frames, rates = time.monotonic(), 0, []
    state = ""
    while "(ended)" not in state and time.monotonic() - began < seconds + 60.0:
        time.sleep(EVERY if rows else min(WARM, 0.5 * seconds))
        page.execute_cdp_cmd("HeapProfiler.collectGarbage", {})
        count, heap = page.execute_script(
            "return [window.frames, performance.memory.usedJSHeapSize]"
        )
        at = time.monotonic() - began
        if rows:
            rates.append((count - frames) / (at - rows[-1][0]))
        frames = count
        rows.append((at, resident(server), resident(renderer(folder)), heap / 2**20, count))
        state = page.find_element("id", "live-state").text
        print(f"{at:.0f} s: {rows[-1][1:]} {state}", file=sys.stderr, flush=True)
    ended = page.find_element("id", "stopped").text or page.find_element("id", "drive-error").text
    if ended:
        raise SystemExit(f"after {rows[-1][0]:.0f} s: {ended}")
    until(lambda: "samples are in" in page.find_element("id", "driven").text, 120.0)
    first, last = rows[0], rows[-2]
    return {
        "seconds": round(rows[-1][0]),
        "frames_per_s": {
            "median": round(float(np.median(rates[:-1])), 1),
            "least_in_30_s": round(min(rates[:-1]), 1),
        },
        "longest_pause_ms": round(page.execute_script("return window.slow")),
        "server_mb": [round(x, 1) for x in (first[1], last[1], last[1] - first[1])],
        "renderer_mb": [round(x, 1) for x in (first[2], last[2], last[2] - first[2])],
        "page_heap_mb": [round(x, 1) for x in (first[3], last[3], last[3] - first[3])],
        "live": state,
        "load": [round(x, 1) for x in os.getloadavg()],
    }


if __name__ == "__main__":
    main()
