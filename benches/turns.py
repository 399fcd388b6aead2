"""Contenders that take turns: each a warm process of its own that works when told to."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_XLA = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


class Failed(Exception):
    """A contender that could not work, with its last words."""


@dataclass(frozen=True)
class Contender:
    """Who works: `module.work(**arguments)`, under an environment of its own.

    `parts` is into how many pieces its work falls beside those of the row.
    """

    name: str
    module: str
    work: str
    arguments: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)
    threads: int = 1
    turns: int | None = None
    parts: int = 1

    def environ(self) -> dict[str, str]:
        own = dict(ONE_THREAD, XLA_FLAGS=_XLA) if self.threads == 1 else {}
        return {**os.environ, **own, "JAX_PLATFORMS": "cpu", **self.environment}


@dataclass(frozen=True)
class Turn:
    """Seconds of the clock and of the processor for one call, and what it reached."""

    wall: float
    cpu: float
    reached: dict[str, Any]


class Worker:
    """A contender's process; its first turn has been taken, uncounted, when it is ready."""

    def __init__(self, contender: Contender) -> None:
        self.contender = contender
        command = [sys.executable, str(Path(__file__).with_name("contender.py"))]
        what = [contender.module, contender.work, json.dumps(contender.arguments)]
        self._process = subprocess.Popen(
            command + what,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=contender.environ(),
        )

    def ready(self) -> dict[str, Any]:
        """Waits until it is warm; what it tells about itself."""
        return self._answer()

    def turn(self) -> Turn:
        self._write("go")
        return Turn(**self._answer())

    def close(self) -> None:
        if self._process.poll() is None:
            self._write("end")
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None and not stream.closed:
                stream.close()

    def _write(self, word: str) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(word + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        line = self._process.stdout.readline()
        if not line:
            said = self._process.stderr.read().strip().splitlines()
            raise Failed(f"{self.contender.name}: {said[-1] if said else 'ended without a word'}")
        answer: dict[str, Any] = json.loads(line)
        return answer


def take_turns(contenders: list[Contender], turns: int) -> dict[str, list[Turn]]:
    """A B A B ..., each as often as it says or else `turns` times; who fails has none."""
    workers: dict[str, Worker] = {}
    taken: dict[str, list[Turn]] = {}
    try:
        for contender in contenders:
            worker = workers[contender.name] = Worker(contender)
            try:
                worker.ready()
                taken[contender.name] = []
            except Failed as failure:
                print(f"  without {failure}", file=sys.stderr)
        for number in range(turns):
            for name, found in taken.items():
                most = workers[name].contender.turns
                if most is None or number < most:
                    found.append(workers[name].turn())
    finally:
        for worker in workers.values():
            worker.close()
    return taken
