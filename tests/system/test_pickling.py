"""Public values that are no live connection can be pickled, copied and sent to processes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

import sewfast
from loops import QUIET, drive
from sewfast import Dataset, Gains, VirtualMachine, rules
from sewfast.control import Fopdt

PLANT = Fopdt(490.0, 0.25, 0.0075)


def moved_machine() -> VirtualMachine:
    machine = VirtualMachine(seed=3)
    machine.set_load(0.01)
    machine.run(np.repeat([5.0, -3.0, 8.0], 400))
    return machine


def later(machine: VirtualMachine) -> tuple[list[float], list[float]]:
    """What the machine does next, to the last bit."""
    run = machine.run(np.repeat([2.0, -9.0, 4.0], 300))
    return run.counts.tolist(), run.speed_rpm.tolist()


def _answer(queue: Any, machine: VirtualMachine) -> None:
    queue.put((later(machine), machine.name, machine.parameters))


@cache
def data() -> Dataset:
    u = np.random.default_rng(1).normal(size=800)
    y = np.zeros(800)
    for k in range(2, 800):
        y[k] = 1.5 * y[k - 1] - 0.6 * y[k - 2] + 0.1 * u[k - 1]
    return Dataset.from_arrays(u, y, Ts=0.001)


@cache
def model(kind: Any) -> Any:
    few: dict[str, Any] = {"hidden": 2, "starts": 1, "iterations": 5}
    return sewfast.identify(data(), model=kind, **(few if kind.startswith("neural") else {}))


VALUES: dict[str, Callable[[], Any]] = {
    "machine": moved_machine,
    "its run": lambda: moved_machine().run(np.ones(50)),
    "dataset": data,
    "arx": lambda: model("arx"),
    "iv": lambda: model("iv"),
    "oe": lambda: model("oe"),
    "neural oe": lambda: model("neural-oe"),
    "neural ss": lambda: model("neural-ss"),
    "orders": lambda: sewfast.orders(data()),
    "delay": lambda: sewfast.delay(data()),
    "validation": lambda: sewfast.validate(model("arx"), data()),
    "gains": lambda: Gains.standard(0.1, 0.2, 0.0),
    "controller": lambda: QUIET,
    "rule": lambda: rules.simc(PLANT),
    "margins": lambda: sewfast.margins(QUIET, PLANT),
    "drive": drive,
    "loop run": lambda: sewfast.run(QUIET, moved_machine(), np.full(300, 800.0)),
    "least squares": lambda: sewfast.least_squares(lambda p: p - 1.0, np.zeros(2)),
    "tuning": lambda: sewfast.tune(drive(), np.full(300, 800.0), evaluations=20),
}


@pytest.mark.parametrize("name", VALUES)
def test_values_survive_pickle_and_deepcopy(name: str) -> None:
    value = VALUES[name]()
    for twin in (pickle.loads(pickle.dumps(value)), copy.deepcopy(value)):
        assert type(twin) is type(value)
        if type(value).__repr__ is not object.__repr__:
            assert repr(twin) == repr(value)


def test_a_copied_machine_goes_on_where_the_first_is() -> None:
    machine = moved_machine()
    twins = [pickle.loads(pickle.dumps(machine)), copy.deepcopy(machine)]
    expected = later(machine)
    for twin in twins:
        assert (twin.name, twin.parameters) == (machine.name, machine.parameters)
        assert later(twin) == expected


METHODS = sorted({"fork", "spawn"} & {*multiprocessing.get_all_start_methods()})


@pytest.mark.parametrize("method", METHODS)
def test_a_machine_runs_in_another_process(method: Any) -> None:
    context: Any = multiprocessing.get_context(method)
    machine, queue = moved_machine(), context.Queue()
    with warnings.catch_warnings():
        # newer Pythons warn of a fork beside threads
        warnings.simplefilter("ignore", DeprecationWarning)
        worker = context.Process(target=_answer, args=(queue, machine))
        worker.start()
    run, name, parameters = queue.get()
    worker.join()
    assert (run, name, parameters) == (later(machine), machine.name, machine.parameters)
