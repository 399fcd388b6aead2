"""The state-space problem: 3 states, 15 tanh, 155 parameters with its initial state, N = 65,000."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from sewfast import _core

SAMPLES, NX, HIDDEN = 65_000, 3, 15
DECAY = 1e-6
FIRST, STEPS = 1, 10
"""Iterations before the rival joins, at the iterate that they reach, and those compared."""
MU = 2e-3
"""Damping after the first accepted step."""


@cache
def record(samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """A resonance with a stiffening spring, as a Silverbox has it, and noise."""
    rng = np.random.default_rng(0)
    u = np.convolve(rng.normal(size=samples), np.ones(8) / np.sqrt(8), mode="same")
    x, v, y = 0.0, 0.0, np.empty(samples)
    for k in range(samples):
        y[k] = x
        v += 0.5 * (0.3 * u[k] - 0.25 * v - 0.4 * x - 0.15 * x**3)
        x += 0.5 * v
    return u[:, None].copy(), y + 1e-3 * y.std() * rng.normal(size=samples)


def training(
    iterations: int, samples: int = SAMPLES, hidden: int = HIDDEN
) -> Callable[[], _core.NeuralSSFit]:
    """A training from a linear model, ready to begin."""
    data = [record(samples)]
    linear = _core.fit_oe(data, na=NX, nb=NX, nk=1, max_iterations=20).model
    return lambda: _core.fit_neural_ss(
        data,
        [],
        nx=NX,
        nk=1,
        hidden=hidden,
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


def first() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the rival begins, and its delayed input and its output in scaled units."""
    fit = training(FIRST)()
    u, y = record()
    s: dict[str, Any] = dict(fit.model.settings)
    v = (np.concatenate([u[:1, 0], u[:-1, 0]]) - s["u_mean"]) / s["u_scale"]
    start = np.concatenate([fit.model.theta, fit.initial_states[0]])
    return start, v, (y - s["y_mean"]) / s["y_scale"]
