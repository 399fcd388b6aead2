"""One contender: loads, warms up, then works and tells how long that took whenever it reads "go".

python benches/contender.py MODULE WORK '{"argument": value}'
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

LEAST = 0.02
"""Seconds that a turn lasts at least: short work is repeated, and the mean of its time is told."""
MOST = 2000


def repetitions(work: Callable[[], Any]) -> int:
    """How often to repeat the work in a turn; warms it up."""
    began = time.perf_counter()
    work()
    if time.perf_counter() - began > 1.0:
        return 1
    began = time.perf_counter()
    work()
    return min(max(1, round(LEAST / (time.perf_counter() - began))), MOST)


def main() -> None:
    # what the work prints must not be taken for an answer
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def tell(**answer: Any) -> None:
        answers.write(json.dumps(answer) + "\n")
        answers.flush()

    sys.path.insert(0, str(Path(__file__).parent))
    module, name, arguments = sys.argv[1:]
    work = getattr(importlib.import_module(module), name)(**json.loads(arguments))
    count = repetitions(work)
    tell(repetitions=count)
    for line in sys.stdin:
        if line.strip() != "go":
            break
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(count):
            reached = work()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        tell(wall=wall / count, cpu=cpu / count, reached=reached or {})


if __name__ == "__main__":
    main()
