"""The command line: its exit code and what it printed.

`sewfast` and `refused` start a process, as a user does. `called` and `call_refused` call the same
`main` in the test's own process: a third of the time, and enough where a test is about what a
command prints and writes, and not about signals, terminals, pipes or ports.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from sewfast.cli import main

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


def called(folder: Path, *arguments: object, done: int = 0) -> Done:
    """As `sewfast`, without a process."""
    found = call(folder, *map(str, arguments))
    assert found.code == done, found.out + found.err
    return found


def call(folder: Path, *arguments: str) -> Done:
    """Call `main` in a folder; whatever it ends with is its exit code."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", newline="") for _ in range(2))
    with (
        _within(folder),
        mock.patch.dict(os.environ, environment()),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            code = main(arguments)
        except SystemExit as e:  # argparse's
            code = e.code if isinstance(e.code, int) else int(e.code is not None)
    said = []
    for stream in (out, err):
        stream.seek(0)
        said.append(stream.read())
    return Done(code, *said)


@contextlib.contextmanager
def _within(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def refused(folder: Path, *arguments: object) -> str:
    """Run a command that must be refused: exit code 2, one message, nothing left behind."""
    return _refused(sewfast, folder, *arguments)


def call_refused(folder: Path, *arguments: object) -> str:
    """As `refused`, without a process."""
    return _refused(called, folder, *arguments)


def _refused(run: Callable[..., Done], folder: Path, *arguments: object) -> str:
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    found = run(folder, *arguments, done=2)
    assert found.out == ""
    assert "Traceback" not in found.err
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    return found.err
