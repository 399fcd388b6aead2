"""A recorder that is stopped at random moments: `kill -9` costs little, Ctrl-C nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from effort import FULL
from sewfast.recordfile import RecordedFile, read_recording
from sewfast.recordfile.filing import MESSAGE_SAMPLES

_RECORDER = """
    import sys, time
    import numpy as np
    from sewfast.recordfile import Header, RecordWriter
    size, pause = int(sys.argv[2]), float(sys.argv[3])
    header = Header("x", 0.001, {"u": "V", "counts": "1"})
    with RecordWriter(sys.argv[1], header, compress=sys.argv[4] == "True") as writer:
        for k in range(0, 10**9, size):
            i = np.arange(k, k + size)
            writer.samples(k, {"u": i / 7, "counts": 3 * i})
            print(k + size, time.monotonic(), flush=True)
            time.sleep(pause)
"""
RATES = {"fast": (10, 0.0005), "1 kHz": (10, 0.01), "slow": (1, 0.03), "busy": (10, 0.0)}
"""Samples a call and the pause between calls [s]."""


@pytest.mark.parametrize("rate", ["fast", "1 kHz", "slow"])
def test_a_killed_recorder_leaves_what_it_wrote(tmp_path: Path, rate: str) -> None:
    random = np.random.default_rng(len(rate))
    for trial in range(67 if FULL else 5):
        path = tmp_path / f"{trial}.mcap"
        moment = float(random.uniform(0.02, 1.4 if rate == "slow" else 0.7))
        reported, killed = stopped_recorder(path, rate, moment, signal.SIGKILL)
        found = read_recording(path)
        assert_values(found)
        assert (found.gaps, found.outcome) == ((), "torn")
        older = max((n for n, at in reported if at < killed - 0.25), default=0)
        assert len(found) >= older - MESSAGE_SAMPLES
        # what comes in a quarter of a second and a message of the slow recorder; counted, as a
        # machine that is busy elsewhere slows all of it down
        assert rate != "slow" or len(found) >= reported[-1][0] - 20


def test_ctrl_c_costs_no_sample(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    for trial in range(100 if FULL else 5):
        path = tmp_path / f"{trial}.mcap"
        moment = float(random.uniform(0.02, 0.2))
        reported, _ = stopped_recorder(path, "busy", moment, signal.SIGINT)
        found = read_recording(path)
        assert_values(found)
        assert (found.gaps, found.damage, found.outcome) == ((), (), "interrupted")
        size = RATES["busy"][0]
        assert reported[-1][0] <= len(found) <= reported[-1][0] + size


def assert_values(found: RecordedFile) -> None:
    k = np.arange(len(found))
    np.testing.assert_array_equal(found.columns["u"], k / 7)
    np.testing.assert_array_equal(found.columns["counts"], 3.0 * k)


def stopped_recorder(
    path: Path, rate: str, seconds: float, how: signal.Signals
) -> tuple[list[tuple[int, float]], float]:
    """What the recorder reported as written, with times, and when it was stopped."""
    size, pause = RATES[rate]
    command = [sys.executable, "-c", textwrap.dedent(_RECORDER), str(path), str(size), str(pause)]
    # every other recording is compressed, where it can be
    command.append(str(int(path.stem) % 2 == 1 and find_spec("zstandard") is not None))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, **pipes) as recorder:  # type: ignore[call-overload]
        first = recorder.stdout.readline()
        time.sleep(seconds)
        stopped = time.monotonic()
        os.kill(recorder.pid, how)
        lines = [first, *recorder.stdout.read().splitlines(keepends=True)]
    whole = [line.split() for line in lines if line.endswith(b"\n")]
    return [(int(n), float(at)) for n, at in whole], stopped
