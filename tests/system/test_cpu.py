"""`SEWFAST_CPU`: every level computes the same model, and a wrong name is refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from sewfast import _core

LEVELS = ("baseline", "avx2", "avx512")
PROGRAM = """
import json, sys
import numpy as np
import sewfast
from sewfast import _core
u = np.sin(np.linspace(0.0, 60.0, 600) ** 1.3)
y = np.zeros(600)
for k in range(1, 600):
    y[k] = 0.9 * y[k - 1] + 0.2 * np.tanh(1.5 * u[k - 1])
data = sewfast.Dataset.from_arrays(u, y, 0.001)
told = {"cpu": _core.cpu}
for kind, options in (("neural_oe", {"hidden": 5}), ("neural_ss", {"nx": 2, "nk": 1, "hidden": 5})):
    model = sewfast.identify(data, model=kind, starts=2, iterations=12, **options)
    told[kind] = model.simulate(data, init=0)[0].tolist()
    told[kind + " again"] = sewfast.identify(
        data, model=kind, starts=2, iterations=12, threads=1, **options
    ).simulate(data, init=0)[0].tolist()
json.dump(told, sys.stdout)
"""


def answer(level: str, program: str = PROGRAM) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"SEWFAST_CPU": level}
    return subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )


@pytest.mark.nightly("trains on every level; by day the core's tests compare lanes")
def test_every_level_trains_the_same_networks() -> None:
    found = {}
    for level in LEVELS[: LEVELS.index(_core.cpu) + 1]:
        done = answer(level)
        assert done.returncode == 0, done.stderr
        found[level] = json.loads(done.stdout)
        assert found[level]["cpu"] == level
    for kind in ("neural_oe", "neural_ss"):
        first = found["baseline"][kind]
        for level, told in found.items():
            assert told[kind] == told[kind + " again"], "bits differ between thread counts"
            # rounding grows over the iterations of the training, and no further
            worst = max(abs(a - b) for a, b in zip(first, told[kind], strict=True))
            assert worst < 1e-6, (kind, level, worst)


@pytest.mark.parametrize("level", ["sse9", "AVX2", ""])
def test_an_unknown_level_is_refused(level: str) -> None:
    done = answer(level, "import sewfast; sewfast.VirtualMachine()")
    assert done.returncode != 0
    assert "expected baseline, avx2 or avx512 for SEWFAST_CPU" in done.stderr


def test_the_command_line_refuses_it_in_one_line() -> None:
    done = answer("sse9", "import sys; from sewfast.cli import main; sys.exit(main(['--version']))")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
