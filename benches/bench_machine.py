"""How many times faster than real time the virtual machine runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sewfast.machine import VirtualMachine

SAMPLES = 50_000


def _chirp() -> np.ndarray:
    t = np.arange(SAMPLES) * VirtualMachine.Ts
    return 3.5 + 2.5 * np.sin(2 * np.pi * (0.1 + 0.03 * t) * t)


def _random(hold: int) -> np.ndarray:
    levels = np.random.default_rng(1).uniform(-20, 20, SAMPLES // hold)
    return np.repeat(levels, hold)


EXCITATIONS = {
    "chirp": _chirp(),
    "random, 100 ms": _random(100),
    "random, 1 ms": _random(1),
}


@pytest.mark.parametrize("name", EXCITATIONS)
def test_machine(benchmark: Any, name: str) -> None:
    machine = VirtualMachine()

    def run() -> None:
        machine.reset()
        machine.run(EXCITATIONS[name])

    benchmark(run)
    if benchmark.stats is not None:
        ratio = SAMPLES * VirtualMachine.Ts / benchmark.stats.stats.median
        benchmark.extra_info["times_real_time"] = round(ratio)
        print(f"\n{name}: {ratio:.0f} x real time")
