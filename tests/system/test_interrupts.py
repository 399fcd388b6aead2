"""Ctrl-C at random times in commands that run longer than a second, as in `make interrupts`.

Two times in a few commands; 20 times in each with SEWFAST_SOAK=1 (`make soak`).
"""

from __future__ import annotations

import random
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

from effort import FULL

if sys.platform == "win32":
    pytest.skip("needs process groups", allow_module_level=True)

BENCH = Path(__file__).parents[2] / "benches" / "interrupts.py"
SOME = ("identify oe", "gains", "fleet")
TIMES, SPAN = (20, 10.0) if FULL else (2, 2.0)

pytestmark = pytest.mark.alone


@pytest.fixture(scope="module")
def bench() -> dict[str, Any]:
    return runpy.run_path(str(BENCH))


def _rows(bench: dict[str, Any]) -> list[Any]:
    return [row for row in bench["ROWS"] if FULL or row.name in SOME]


@pytest.fixture(scope="module")
def place(bench: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interrupts")
    bench["prepare"](folder, _rows(bench))
    return folder


def test_ctrl_c_at_any_time_ends_a_command_and_leaves_whole_files(
    bench: dict[str, Any], place: Path
) -> None:
    if any("fleet" in row.words for row in _rows(bench)):
        pytest.importorskip("distributed", reason="needs dask (extra fleet)")
    drawn = random.Random(0)
    faults = {}
    for row in _rows(bench):
        for i in range(TIMES):
            at = drawn.uniform(0.0, SPAN)
            found = bench["trial"](row, place, at, twice=i % 4 == 1, old=None, usual=0)
            if found.faults:
                faults[row.name, at] = (*found.faults, found.text)
    assert faults == {}
