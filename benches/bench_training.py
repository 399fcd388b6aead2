"""Training, free run and least squares beside their rivals: same data, one thread, one process.

Each group's table gives the times; the closing line of a pair prints their ratio. Both trainers
make 100 iterations with the same damping policy, each from the best of its own random starts
(finding it is not timed). Printed with the ratio: the J that each reaches, since a fast trainer
that ends elsewhere would prove nothing.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast import _core

numba_oe = pytest.importorskip("rivals.numba_oe")

ITERATIONS = 100
_MEDIANS: dict[tuple[str, str], float] = {}


@cache
def scaled() -> tuple[np.ndarray, np.ndarray]:
    """Lo-Hi in the paper's scaling: u/10, y/1000, raw differences of counts, N = 20,000."""
    machine = sewfast.VirtualMachine()
    u = sewfast.signals.excitation("chirp_lo_hi")
    y = sewfast.speed_from_counts(
        machine.run(u).counts, machine.Ts, machine.counts_per_rev, method="difference"
    )
    return u / 10.0, y / 1000.0


def _note(benchmark: Any, group: str, who: str) -> None:
    _MEDIANS[group, who] = benchmark.stats.stats.median
    if (group, "rival") in _MEDIANS and (group, "sewfast") in _MEDIANS:
        ratio = _MEDIANS[group, "rival"] / _MEDIANS[group, "sewfast"]
        print(f"\n{group}: the rival takes {ratio:.2f} times as long as sewfast")


@pytest.mark.benchmark(group="100 LM iterations, 49 parameters, N = 20,000")
def test_training(benchmark: Any) -> None:
    u, y = scaled()
    data = [(u[:, None].copy(), y)]

    def train(seed: int) -> _core.NeuralFit:
        return _core.fit_neural_oe(
            data,
            [],
            na=2,
            nb=2,
            nk=1,
            hidden=8,
            linear=None,
            u_mean=np.zeros(1),
            u_scale=np.ones(1),
            y_mean=0.0,
            y_scale=1.0,
            saturate=None,
            initial_state="zero",
            weight_decay=0.0,
            max_iterations=ITERATIONS,
            starts=1,
            seed=seed,
            threads=1,
        )

    fits = {seed: train(seed) for seed in range(8)}
    whole = [seed for seed, fit in fits.items() if fit.iterations == ITERATIONS]
    best = min(whole, key=lambda seed: fits[seed].cost)
    benchmark.pedantic(lambda: train(best), rounds=3)
    print(f"\nsewfast: J {fits[best].cost:.3g}")
    _note(benchmark, "training", "sewfast")


@pytest.mark.benchmark(group="100 LM iterations, 49 parameters, N = 20,000")
def test_training_numba(benchmark: Any) -> None:
    trainer = numba_oe.Trainer(*scaled())
    starts = [np.random.default_rng(s).uniform(-0.1, 0.1, 49) for s in range(3)]
    best = min(starts, key=lambda theta: trainer.train(theta, ITERATIONS)[1])
    _, cost, trials = benchmark.pedantic(lambda: trainer.train(best, ITERATIONS), rounds=3)
    print(f"\nnumba: J {cost:.3g} in {trials} trials")
    _note(benchmark, "training", "rival")


@pytest.mark.benchmark(group="free run, N = 20,000")
def test_free_run(benchmark: Any) -> None:
    u, _ = scaled()
    theta = np.random.default_rng(0).uniform(-0.1, 0.1, 49)
    model = _core.NeuralOE(
        na=2,
        nb=2,
        nk=1,
        n_inputs=1,
        hidden=8,
        bypass=False,
        theta=theta,
        u_mean=np.zeros(1),
        u_scale=np.ones(1),
        y_mean=0.0,
        y_scale=1.0,
        output_low=None,
        output_high=None,
    )
    columns, rest = u[:, None].copy(), np.zeros(2)
    run = benchmark(lambda: model.simulate(columns, rest))
    assert np.allclose(run, numba_oe.simulate(theta, u, np.empty(len(u))), atol=1e-12)
    _note(benchmark, "free run", "sewfast")


@pytest.mark.benchmark(group="free run, N = 20,000")
def test_free_run_numba(benchmark: Any) -> None:
    u, _ = scaled()
    theta, out = np.random.default_rng(0).uniform(-0.1, 0.1, 49), np.empty(len(u))
    benchmark(lambda: numba_oe.simulate(theta, u, out))
    _note(benchmark, "free run", "rival")


def _gram(u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """ARX(2, 2, 1) by dot products of slices: no regressor matrix is built."""
    columns = (-y[1:-1], -y[:-2], u[1:-1], u[:-2])
    left = np.array([[a @ b for b in columns] for a in columns])
    return np.linalg.solve(left, np.array([a @ y[2:] for a in columns]))


@pytest.mark.benchmark(group="ARX(2, 2, 1), N = 1,000,000")
def test_arx(benchmark: Any) -> None:
    u, y = (np.tile(v, 50) for v in scaled())
    data = [(u[:, None].copy(), y)]
    model = benchmark(lambda: _core.fit_arx(data, na=2, nb=2, nk=1, offset=False))
    found = np.concatenate([model.a, model.b[0]])
    assert np.allclose(found, _gram(u, y), rtol=1e-6)
    _note(benchmark, "ARX", "sewfast")


@pytest.mark.benchmark(group="ARX(2, 2, 1), N = 1,000,000")
def test_arx_numpy(benchmark: Any) -> None:
    u, y = (np.tile(v, 50) for v in scaled())
    benchmark(lambda: _gram(u, y))
    _note(benchmark, "ARX", "rival")
