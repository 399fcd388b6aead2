"""The command line as its user has it: a process, its exit code and what it printed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PROGRAM = (sys.executable, "-m", "sewfast")


def environment() -> Mapping[str, str]:
    """Plain text wherever Python would colour it, and warnings as errors."""
    return {**os.environ, "NO_COLOR": "1", "PYTHONWARNINGS": "error", "COLUMNS": "100"}


@dataclass(frozen=True)
class Done:
    code: int
    out: str
    err: str

    def json(self) -> Any:
        return json.loads(self.out)


def sewfast(folder: Path, *arguments: object, done: int = 0) -> Done:
    """Run one command in a folder; its exit code must be `done`."""
    found = subprocess.run(
        [*PROGRAM, *map(str, arguments)],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert found.returncode == done, found.stdout + found.stderr
    return Done(found.returncode, found.stdout, found.stderr)


def refused(folder: Path, *arguments: object) -> str:
    """Run a command that must be refused: exit code 2, one message, nothing left behind."""
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    found = sewfast(folder, *arguments, done=2)
    assert found.out == ""
    assert "Traceback" not in found.err
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    return found.err
