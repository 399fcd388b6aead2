"""An LM iteration of the neural state-space model beside numba's: same data, start, steps, thread.

3 states, 15 tanh, 155 parameters with the initial state, 65,000 samples. Both begin at the iterate
that sewfast's first iteration reaches and make the same steps: the costs that each passes are
compared before the times are, which are of the processor: others may use the computer, too.
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np
import pytest

from sewfast import _core

numba_ss = pytest.importorskip("rivals.numba_ss")

SAMPLES, NX, HIDDEN = 65_000, 3, 15
DECAY = 1e-6
FIRST, STEPS = 1, 10
_TIMES: dict[str, float] = {}


@cache
def record() -> tuple[np.ndarray, np.ndarray]:
    """A resonance with a stiffening spring, as a Silverbox has it, and noise."""
    rng = np.random.default_rng(0)
    u = np.convolve(rng.normal(size=SAMPLES), np.ones(8) / np.sqrt(8), mode="same")
    x, v, y = 0.0, 0.0, np.empty(SAMPLES)
    for k in range(SAMPLES):
        y[k] = x
        v += 0.5 * (0.3 * u[k] - 0.25 * v - 0.4 * x - 0.15 * x**3)
        x += 0.5 * v
    return u[:, None].copy(), y + 1e-3 * y.std() * rng.normal(size=SAMPLES)


def train(iterations: int) -> _core.NeuralSSFit:
    u, y = record()
    linear = _core.fit_oe([(u, y)], na=NX, nb=NX, nk=1, max_iterations=20).model
    began = time.process_time()
    fit = _core.fit_neural_ss(
        [(u, y)],
        [],
        nx=NX,
        nk=1,
        hidden=HIDDEN,
        linear=linear,
        output="linear",
        output_parameters=np.zeros(0),
        integrator=False,
        weight_decay=DECAY,
        hidden_scale=1.0,
        max_iterations=iterations,
        starts=1,
        first_start=0,
        seed=0,
        threads=1,
    )
    _TIMES[f"sewfast {iterations}"] = time.process_time() - began
    return fit


def scaled(model: _core.NeuralSS) -> tuple[np.ndarray, np.ndarray]:
    u, y = record()
    s: Any = model.settings
    v = (np.concatenate([u[:1, 0], u[:-1, 0]]) - s["u_mean"]) / s["u_scale"]
    return v, (y - s["y_mean"]) / s["y_scale"]


def test_lm_iteration() -> None:
    least: dict[str, float] = {}
    first = train(FIRST)
    start = np.concatenate([first.model.theta, first.initial_states[0]])
    rival = numba_ss.Trainer(NX, HIDDEN, *scaled(first.model), DECAY)
    rival.train(start, 1, 2e-3)
    for _ in range(3):
        train(FIRST)
        fit = train(FIRST + STEPS)
        spent = (_TIMES[f"sewfast {FIRST + STEPS}"] - _TIMES[f"sewfast {FIRST}"]) / STEPS
        least["sewfast"] = min(spent, least.get("sewfast", np.inf))
        rival.trials = 0
        began = time.process_time()
        trace = rival.train(start, STEPS, 2e-3)
        spent = (time.process_time() - began) / STEPS
        least["numba"] = min(spent, least.get("numba", np.inf))
    np.testing.assert_allclose(fit.trace[FIRST:], trace, rtol=1e-5)
    print(f"\n{rival.trials - 1} trials for {STEPS} steps; J {trace[0]:.4g} -> {trace[-1]:.4g}")
    for who, seconds in least.items():
        print(f"{who}: {1e3 * seconds:.1f} ms an LM iteration")
    print(f"numba takes {least['numba'] / least['sewfast']:.2f} times as long as sewfast")


def test_free_run() -> None:
    fit = train(FIRST)
    u, _ = record()
    state = fit.initial_states[0]
    theta = np.concatenate([fit.model.theta, state])
    v, y = scaled(fit.model)
    out = np.empty_like(y)
    least: dict[str, float] = {}
    for _ in range(20):
        for who, work in (
            ("sewfast", lambda: fit.model.simulate(u, state)),
            ("numba", lambda: numba_ss.simulate(theta, NX, HIDDEN, v, state, out)),
        ):
            began = time.process_time()
            work()
            least[who] = min(time.process_time() - began, least.get(who, np.inf))
    for who, seconds in least.items():
        print(f"{who}: {1e9 * seconds / SAMPLES:.1f} ns a sample of free run")
