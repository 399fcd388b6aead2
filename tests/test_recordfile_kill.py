"""`kill -9` of a recorder at random moments: every file opens, little is lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from recordings_made import SOAK
from sewfast.recordfile import read_recording
from sewfast.recordfile.writer import MESSAGE_SAMPLES

_RECORDER = """
    import sys, time
    import numpy as np
    from sewfast.recordfile import Header, RecordWriter
    size, pause = int(sys.argv[2]), float(sys.argv[3])
    writer = RecordWriter(sys.argv[1], Header("x", 0.001, {"u": "V", "counts": "1"}))
    for k in range(0, 10**9, size):
        i = np.arange(k, k + size)
        writer.samples(k, {"u": i / 7, "counts": 3 * i})
        print(k + size, time.monotonic(), flush=True)
        time.sleep(pause)
"""
RATES = {"fast": (10, 0.0005), "1 kHz": (10, 0.01), "slow": (1, 0.03)}
"""Samples a call and the pause between calls [s]."""


@pytest.mark.parametrize("rate", RATES)
def test_a_killed_recorder_leaves_what_it_wrote(tmp_path: Path, rate: str) -> None:
    random = np.random.default_rng(len(rate))
    for trial in range(67 if SOAK else 5):
        path = tmp_path / f"{trial}.mcap"
        reported, killed = killed_recorder(path, rate, float(random.uniform(0.02, 0.7)))
        found = read_recording(path)
        k = np.arange(len(found))
        np.testing.assert_array_equal(found.columns["u"], k / 7)
        np.testing.assert_array_equal(found.columns["counts"], 3.0 * k)
        assert (found.gaps, found.outcome) == ((), "torn")
        older = max((n for n, at in reported if at < killed - 0.25), default=0)
        assert len(found) >= older - MESSAGE_SAMPLES
        assert len(found) >= reported[-1][0] - MESSAGE_SAMPLES
        if rate == "slow":
            # a message takes a quarter of a second here: two of them, and the machine's own delays
            assert len(found) >= max((n for n, at in reported if at < killed - 0.6), default=0)


def killed_recorder(path: Path, rate: str, seconds: float) -> tuple[list[tuple[int, float]], float]:
    """What the recorder reported as written, with times, and when it was killed."""
    size, pause = RATES[rate]
    command = [sys.executable, "-c", textwrap.dedent(_RECORDER), str(path), str(size), str(pause)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as recorder:
        assert recorder.stdout is not None
        first = recorder.stdout.readline()
        time.sleep(seconds)
        killed = time.monotonic()
        os.kill(recorder.pid, signal.SIGKILL)
        lines = [first, *recorder.stdout.read().splitlines(keepends=True)]
    whole = [line.split() for line in lines if line.endswith(b"\n")]
    return [(int(n), float(at)) for n, at in whole], killed
