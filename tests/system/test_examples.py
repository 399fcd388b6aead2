"""Every example runs as its user runs it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cli import environment

EXAMPLES = sorted(Path(__file__).resolve().parents[2].glob("examples/*.py"))


SEARCHES = pytest.mark.nightly("searches for a structure with all defaults")


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=[SEARCHES] if p.stem == "own_recording" else []) for p in EXAMPLES],
    ids=lambda p: p.stem,
)
def test_example(path: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path, env=environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout
    assert not list(tmp_path.iterdir())


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 3
