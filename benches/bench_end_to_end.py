"""What a user waits for: import, identification, tuning, closed loop."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from typing import Any

import pytest

import sewfast


@cache
def recording() -> sewfast.Dataset:
    """20 s of the training chirp on the virtual machine."""
    machine = sewfast.VirtualMachine()
    u = sewfast.signals.excitation("chirp_lo_hi")
    y = sewfast.speed_from_counts(machine.run(u).counts, machine.Ts, machine.counts_per_rev)
    return sewfast.Dataset.from_arrays(u, y, machine.Ts, input_units="V", output_unit="RPM")


@cache
def model() -> sewfast.Model:
    return sewfast.identify(recording(), model="oe")


@pytest.mark.parametrize("statement", ["pass", "import numpy", "import sewfast"])
def test_start_up(benchmark: Any, statement: str) -> None:
    """A whole interpreter; the first two are what there is to compare with."""
    benchmark(lambda: subprocess.run([sys.executable, "-c", statement], check=True))


def test_help(benchmark: Any) -> None:
    command = [sys.executable, "-m", "sewfast", "--help"]
    benchmark(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))


@pytest.mark.parametrize("kind", ["arx", "oe", "neural_oe"])
def test_identify(benchmark: Any, kind: str) -> None:
    data = recording()
    benchmark.pedantic(lambda: sewfast.identify(data, model=kind, starts=1), rounds=3)


def test_simulate(benchmark: Any) -> None:
    data, found = recording(), model()
    benchmark(lambda: found.simulate(data))


def test_tune(benchmark: Any) -> None:
    found = model()
    benchmark.pedantic(lambda: sewfast.tune(found, "trapezoid", evaluations=200), rounds=3)


@pytest.mark.parametrize("plant", ["model", "machine"])
def test_closed_loop(benchmark: Any, plant: str) -> None:
    on = model() if plant == "model" else sewfast.VirtualMachine()
    controller = sewfast.paper_controller()
    benchmark(lambda: sewfast.run(controller, on, "chirp_hi_lo"))
