"""Every example runs as its user runs it.

The paper's experiment is cut short: `make docs` runs the whole of it, as `sewfast demo`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cli import environment

EXAMPLES = sorted(Path(__file__).resolve().parents[2].glob("examples/*.py"))
SUPPORT = Path(__file__).resolve().parents[1] / "support"
CUT_SHORT = """
import runpy, sys
sys.path.insert(0, sys.argv[2])
from commissioned import short_experiment
with short_experiment():
    runpy.run_path(sys.argv[1], run_name="__main__")
"""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path: Path, tmp_path: Path) -> None:
    is_long = path.stem == "paper_experiment"
    command = ["-c", CUT_SHORT, str(path), str(SUPPORT)] if is_long else [str(path)]
    done = subprocess.run(
        [sys.executable, *command], cwd=tmp_path, env=environment(), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout
    assert not list(tmp_path.iterdir())


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 3
