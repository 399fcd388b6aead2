"""What numba does of the benchmarks: each function prepares the work that is timed."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numba
import numpy as np

import problem

from . import numba_loop, numba_oe, numba_ss

Work = Callable[[], dict[str, Any]]


def training(iterations: int, mu: float) -> Work:
    """Levenberg-Marquardt from the common start."""
    trainer, theta = numba_oe.Trainer(*problem.drive()), problem.start()

    def work() -> dict[str, Any]:
        _, cost, trials = trainer.train(theta, iterations, mu)
        return {"cost": cost, "trials": trials}

    return work


def free_run(samples: int) -> Work:
    """Of the trained network."""
    (u, _), theta = problem.drive(samples), problem.trained()
    out = np.empty(samples)

    def work() -> dict[str, Any]:
        numba_oe.simulate(theta, u, out)
        return {"last": float(out[-1]), "sum": float(out.sum())}

    return work


def jacobian_pass() -> Work:
    """J'J and J'e at the trained network, its own free run in it."""
    trainer, theta = numba_oe.Trainer(*problem.drive()), problem.trained()
    return lambda: {"cost": trainer.normal_equations(theta)[0]}


_TRAINER: list[numba_oe.Trainer] = []


def _prepare() -> None:
    _TRAINER.append(numba_oe.Trainer(*problem.drive()))
    _TRAINER[0].train(problem.start(), 1)


def _trained(work: tuple[int, int, float]) -> float:
    seed, iterations, mu = work
    return float(_TRAINER[0].train(problem.start(seed), iterations, mu)[1])


def several_starts(starts: int, iterations: int, mu: float) -> Work:
    """Two processes, which are there and warm already."""
    pool = ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), _prepare)
    jobs = [(seed, iterations, mu) for seed in range(starts)]
    list(pool.map(_trained, [(0, 1, mu)] * 2))

    def work() -> dict[str, Any]:
        return {"costs": sorted(pool.map(_trained, jobs))}

    return work


def _terms(candidates: int) -> np.ndarray:
    return np.array(list(problem.terms(candidates).values()))


def _tracking(total: np.ndarray) -> dict[str, Any]:
    costs = problem.Y_SCALE * np.sqrt(total / problem.LOOP_SAMPLES)
    return {"mean": float(costs.mean()), "least": float(costs.min())}


def candidates(number: int) -> Work:
    """Closed loops over many candidates."""
    theta, r, terms = problem.trained(), problem.reference(), _terms(number)
    total = np.empty(number)

    def work() -> dict[str, Any]:
        numba_loop.candidates(theta, terms, r, total)
        return _tracking(total)

    return work


def encoded_candidates(number: int) -> Work:
    """The same with encoder and feedback filter."""
    theta, r, terms = problem.trained(), problem.reference(), _terms(number)
    total, per_second = np.empty(number), problem.COUNTS_PER_REV / 60.0
    step = 0.5 * problem.TS * per_second * problem.Y_SCALE
    per_count = 1.0 / (problem.FILTER * problem.TS * per_second * problem.Y_SCALE)

    def work() -> dict[str, Any]:
        numba_loop.encoded_candidates(theta, terms, r, step, per_count, problem.FILTER, total)
        return _tracking(total)

    return work


def one_loop() -> Work:
    """One closed loop."""
    theta, r, terms = problem.trained(), problem.reference(), _terms(1)[:, 0]
    y, u = np.empty_like(r), np.empty_like(r)

    def work() -> dict[str, Any]:
        numba_loop.one(theta, terms, r, y, u)
        return {"last": float(y[-1]), "mean": float(np.mean((r - y) ** 2))}

    return work


@numba.njit(fastmath=True, cache=True)
def _gram(u, y):
    left, right, x = np.zeros((4, 4)), np.zeros(4), np.empty(4)
    for k in range(2, len(u)):
        x[0], x[1], x[2], x[3] = -y[k - 1], -y[k - 2], u[k - 1], u[k - 2]
        for i in range(4):
            right[i] += x[i] * y[k]
            for j in range(4):
                left[i, j] += x[i] * x[j]
    return left, right


def arx(samples: int) -> Work:
    """Normal equations in one pass over the data."""
    u, y = problem.noisy_drive(samples)
    return lambda: {"theta": np.linalg.solve(*_gram(u, y)).tolist()}


def neural_ss(steps: int) -> Work:
    """LM steps of the state-space model from where sewfast's first iteration ends."""
    import state_space

    start, v, y = state_space.first()
    trainer = numba_ss.Trainer(state_space.NX, state_space.HIDDEN, v, y, state_space.DECAY)
    return lambda: {"cost": trainer.train(start, steps, state_space.MU)[-1]}
