"""Threads and processes: the limit, fork and spawn, the interpreter's lock, Ctrl-C, no copies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast import _core
from sewfast.arrays import gram, product
from sewfast.errors import SettingError
from sewfast.threads import available

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
# CPython 3.12 and later warn of forks beside threads, which is what is tested
forks = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


def _drive(samples: int = 600) -> list[tuple[Any, Any]]:
    rng = np.random.default_rng(4)
    u, y = rng.uniform(-1, 1, (samples, 1)), np.zeros(samples)
    for k in range(1, samples):
        y[k] = 0.8 * y[k - 1] + 0.3 * np.tanh(u[k - 1, 0])
    return [(u, y)]


def _fit(data: list[tuple[Any, Any]], **changes: Any) -> _core.NeuralFit:
    settings: dict[str, Any] = {
        "na": 1,
        "nb": 1,
        "nk": 1,
        "hidden": 3,
        "linear": None,
        "u_mean": None,
        "u_scale": None,
        "y_mean": None,
        "y_scale": None,
        "saturate": None,
        "initial_state": "zero",
        "weight_decay": 0.0,
        "max_iterations": 8,
        "starts": 4,
        "seed": 0,
        "threads": 2,
    }
    return _core.fit_neural_oe(data, [], **(settings | changes))


def _trained(_: int = 0) -> bytes:
    """What a process finds, to the last bit."""
    return bytes(_fit(_drive()).model.theta)


@forks
@pytest.mark.parametrize("method", multiprocessing.get_all_start_methods())
def test_any_process_finds_the_same_bits(method: str) -> None:
    here = _trained()
    with multiprocessing.get_context(method).Pool(2) as pool:
        assert pool.map(_trained, range(3)) == [here] * 3


@needs_fork
@forks
def test_a_fork_amid_a_training_works_on() -> None:
    begun, done = threading.Event(), threading.Event()
    found: list[Any] = []

    def progress(*_: Any) -> None:
        begun.set()
        if done.is_set():
            raise StopIteration

    def train() -> None:
        try:
            _fit(_drive(20_000), max_iterations=1_000_000, starts=1000, progress=progress)
        except StopIteration as stopped:
            found.append(stopped)

    expected = _trained()
    worker = threading.Thread(target=train)
    worker.start()
    try:
        assert begun.wait(120)
        read, write = os.pipe()
        child = os.fork()
        if child == 0:  # only the calling thread lives on here
            signal.alarm(300)
            try:
                os.write(write, _trained())
            finally:
                os._exit(0)
        os.close(write)
        with os.fdopen(read, "rb") as pipe:
            assert pipe.read() == expected
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    finally:
        done.set()
        worker.join()
    assert len(found) == 1


def _network(hidden: int, lags: int = 2) -> _core.NeuralOE:
    theta = np.random.default_rng(0).uniform(-0.1, 0.1, (2 * lags + 2) * hidden + 1)
    return _core.NeuralOE(
        na=lags,
        nb=lags,
        nk=1,
        n_inputs=1,
        hidden=hidden,
        bypass=False,
        theta=theta,
        u_mean=np.zeros(1),
        u_scale=np.ones(1),
        y_mean=0.0,
        y_scale=1.0,
        output_low=-1.0,
        output_high=1.0,
    )


def _closed_loop(samples: int, hidden: int, lags: int = 2) -> dict[str, Any]:
    gains = sewfast.Gains.standard(1.0, 0.1, 0.0)
    controller = sewfast.Controller(gains, u_min=-10.0, u_max=10.0, filter_samples=8).core()
    return _core.closed_loop(
        _network(hidden, lags), controller, np.ones(samples), counts_per_unit=1e3
    )


_DATA = _drive(20_000)
_U, _Y = _DATA[0]
CALLS: dict[str, Callable[[], Any]] = {
    "arx": lambda: _core.fit_arx(_DATA, na=2, nb=2, nk=1, offset=True),
    "oe": lambda: _core.fit_oe(_DATA, na=1, nb=1, nk=1),
    "neural_oe": lambda: _fit(_DATA, starts=1, threads=1),
    "free run": lambda: _network(64).simulate(_U, np.zeros(2)),
    "prediction": lambda: _network(64).predict(_U, _Y, np.zeros(2), 1),
    "sensitivities": lambda: _network(8).jacobian(_U, np.zeros(2)),
    "closed loop": lambda: _closed_loop(20_000, 8),
    "machine": lambda: _core.Machine().run(np.ones(20_000)),
    "speed": lambda: _core.speed_kalman(np.arange(20_000.0), Ts=1e-3, counts_per_unit=1.0),
}


@pytest.mark.parametrize("call", CALLS)
def test_others_run_while_a_call_computes(call: str) -> None:
    """Nobody but the call itself gives the interpreter away: no switch is due before it is over."""
    counted, over = [0], threading.Event()

    def count() -> None:
        while not over.wait(1e-4):
            counted[0] += 1

    interval = sys.getswitchinterval()
    counter = threading.Thread(target=count)
    counter.start()
    sys.setswitchinterval(1000.0)
    try:
        for _ in range(1000):
            before = counted[0]
            CALLS[call]()
            after = counted[0]
            if after > before:
                break
    finally:
        over.set()
        sys.setswitchinterval(interval)
        counter.join()
    assert after > before


def test_ctrl_c_ends_a_closed_loop() -> None:
    """Long before the loop would be over, which takes minutes."""
    heard, in_time = threading.Event(), []

    def handler(*_: Any) -> None:
        heard.set()
        raise KeyboardInterrupt

    def interrupt() -> None:
        signal.raise_signal(signal.SIGINT)
        in_time.append(heard.wait(20.0))

    usual = signal.signal(signal.SIGINT, handler)
    timer = threading.Timer(0.2, interrupt)
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            _closed_loop(2_000_000, 1000, lags=50)
    finally:
        timer.join()
        signal.signal(signal.SIGINT, usual)
    assert in_time == [True]


def test_well_formed_arrays_are_not_copied() -> None:
    """Of a million samples nothing but the run is made."""
    model = _core.LinearModel(np.array([-0.9]), np.array([[0.1]]), 1, 0.0)
    u, rest = np.ones((1_000_000, 1)), np.zeros(1)
    tracemalloc.start()
    try:
        model.simulate(u, rest)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # the run itself belongs to Rust, where tracemalloc does not look
    assert peak < u.nbytes / 100
    with pytest.raises(Exception, match="C-contiguous"):
        model.simulate(np.ones((1000, 2))[:, :1], rest)


@pytest.mark.parametrize(("given", "most"), [("1", 1), ("", 10**9), (" 2 ", 2)])
def test_limit(given: str, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SEWFAST_THREADS", raising=False)
    here = available()
    assert here >= 1
    monkeypatch.setenv("SEWFAST_THREADS", given)
    assert available() == min(here, most)


@pytest.mark.parametrize("given", ["0", "-1", "many", "1.5"])
def test_a_limit_that_is_none_is_refused(given: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEWFAST_THREADS", given)
    with pytest.raises(SettingError, match="SEWFAST_THREADS"):
        available()


def test_loads_in_an_interpreter_of_its_own() -> None:
    """The module says that it needs no lock; an interpreter that has one loads it all the same."""
    code = "import sewfast._core as c; print(c.cpu, c.NeuralOE.__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [_core.cpu, "NeuralOE"]


@pytest.mark.parametrize(
    ("n", "p", "q"), [(0, 3, 2), (1, 1, 1), (7, 0, 2), (5000, 19, 23), (3, 600, 400)]
)
def test_products_in_blocks_are_those_of_whole_matrices(n: int, p: int, q: int) -> None:
    rng = np.random.default_rng(n)
    a, b, x = rng.normal(size=(n, p)), rng.normal(size=(n, q)), rng.normal(size=(p, q))
    for found, expected in ((gram(a, b), a.T @ b), (gram(a), a.T @ a), (product(a, x), a @ x)):
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-10)


_BITS = """
import sys, numpy as np
from sewfast.arrays import gram, product
a = np.random.default_rng(1).normal(size=(20_000, 30))
sys.stdout.buffer.write(gram(a).tobytes() + product(a, gram(a)).tobytes())
"""


def test_products_in_blocks_have_the_same_bits_on_any_number_of_blas_threads() -> None:
    run = [
        subprocess.run(
            [sys.executable, "-c", _BITS], env={**os.environ, "OPENBLAS_NUM_THREADS": threads},
            check=True, capture_output=True,
        ).stdout
        for threads in ("1", "2")
    ]  # fmt: skip
    assert len(run[0]) == 8 * (30 * 30 + 20_000 * 30)
    assert run[0] == run[1]


class _Deadline(KeyboardInterrupt):
    pass


@pytest.mark.alone
@pytest.mark.parametrize("kind", [_Deadline, KeyboardInterrupt])
def test_a_fit_that_is_done_outlives_a_deadline_and_not_ctrl_c(kind: type[BaseException]) -> None:
    def late(done: int, *_: object) -> None:
        time.sleep(2.0)  # the fit, of a fifth of a second, ends meanwhile
        raise kind

    ((u, y),) = _drive(20_000)
    data = [(np.tile(u, (10, 1)), np.tile(y, 10))]
    fit = partial(_core.fit_oe, data, na=1, nb=1, nk=1, max_iterations=3)
    if kind is KeyboardInterrupt:
        with pytest.raises(KeyboardInterrupt):
            fit(progress=late)
    else:
        assert fit(progress=late).termination != "interrupted"
