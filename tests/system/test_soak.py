"""One kilohertz, four channels, over a pty under faults: every gap is listed and none is not.

Half a minute in the ordinary tests, an hour with SEWFAST_SOAK=1 (`make soak`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from effort import FULL
from sewfast import signals
from sewfast.link import Plan, VirtualDevice, connect
from sewfast.recordfile import Header, RecordWriter, read_recording

SECONDS = 3600 if FULL else 30
FAULTS = "drop=2e-3,flip=1e-3,duplicate=2e-3,reorder=2e-3,delay=1e-3:0.02,stall=2e-4:0.2"
WATCHDOG = 10.0
"""The longest there is [s]: for how long a busy machine keeps a host waiting is not asked here."""
COLUMNS = {"counts": "1", "u": "V", "current": "A", "speed_true": "RPM"}
MOST_GROWTH = 5e6
"""Bytes."""


def memory() -> int:
    """Bytes of this process, the device's thread included, that lie in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


@dataclass
class Checked:
    """A sink that compares every sample with what the device was told to apply."""

    planned: NDArray[np.float64]
    writer: RecordWriter
    next: int = 0
    missing: list[tuple[int, int]] = field(default_factory=list)
    memory: list[int] = field(default_factory=list)

    def samples(self, first: int, columns: Mapping[str, NDArray[np.float64]]) -> None:
        count = len(columns["u"])
        if first > self.next:
            self.missing.append((self.next, first - self.next))
        wrong = np.abs(columns["u"] - self.planned[first : first + count]) > 1e-9
        assert not wrong.any(), f"sample {first + int(np.argmax(wrong))} is another one's"
        self.writer.samples(first, columns)
        self.next = first + count
        if self.next // 10_000 > len(self.memory):
            self.memory.append(memory())

    def event(self, kind: str, index: int, **detail: object) -> None:
        self.writer.event(kind, index)


@pytest.mark.nightly("half a minute of faults")
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
def test_a_long_run_under_faults_lists_every_gap(tmp_path: Path) -> None:
    period = np.round(signals.excitation("random", 1), 3)
    n = 1000 * SECONDS
    planned = np.resize(period, n)
    header = Header("soak", 0.001, COLUMNS, n=n, counts_per_rev=1572.0)
    with (
        VirtualDevice(fast=False, faults=FAULTS, seed=7, endpoint="pty") as device,
        connect(device.port, baud=921_600, watchdog=WATCHDOG) as drive,
        RecordWriter(tmp_path / "soak.mcap", header) as writer,
    ):
        drive.set_limits()
        sink = Checked(planned, writer)
        plan = Plan("commands", planned, columns=("current", "speed_true"))
        outcome = drive.stream(plan, sink)
        faults = device.faults
    assert (outcome.reason, outcome.taken) == ("finished", n)
    assert faults["drop"] > SECONDS / 10
    assert sum(faults[kind] > 0 for kind in ("flip", "duplicate", "reorder")) == 3
    if sink.next < n:
        sink.missing.append((sink.next, n - sink.next))
    assert outcome.gaps == tuple(sink.missing)
    assert outcome.received == n - sum(count for _, count in outcome.gaps)
    kept = read_recording(tmp_path / "soak.mcap")
    assert kept.gaps == outcome.gaps
    assert not kept.damage
    there = np.isfinite(kept.columns["u"])
    assert there.sum() == outcome.received
    np.testing.assert_array_equal(kept.columns["u"][there], planned[: len(there)][there])
    # the first seconds fill buffers and caches
    growth = max(sink.memory[1:]) - sink.memory[1]
    print(
        f"\n{SECONDS} s: {n} samples, {outcome.received} received, {len(outcome.gaps)} gaps "
        f"listed, faults {faults}, memory grew by {growth / 1e6:.2f} MB"
    )
    assert growth < MOST_GROWTH
