"""Exact sensitivities of lagged models against complex steps, which are exact to rounding.

df/dx = Im f(x + ih)/h with h = 1e-30 (Squire and Trapp 1998). A derivative is compared relative to
the largest one of its parameter over the run: single entries may cancel to nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_core_models import reference

from effort import FULL
from sewfast import _core

COUNT = 10_000 if FULL else 200
SAMPLES = 25
WORST = 1e-10
STEP = 1e-30


def relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    largest = np.abs(expected).max(axis=0)
    return float(np.max(np.abs(found - expected) / np.where(largest > 0.0, largest, 1.0)))


def is_stable(rows: np.ndarray, na: int) -> bool:
    """What the past outputs did to the run has died down at its end."""
    of_state = np.abs(rows[:, -na:]).sum(axis=1)
    return bool(of_state[-na:].max() < 0.5 and of_state.max() < 1e3)


def random_network(rng: np.random.Generator) -> dict[str, Any]:
    """Any orders, one to three inputs, with and without bypass and limits."""
    na, nb, nk, n_inputs, hidden = (int(v) for v in rng.integers([1, 1, 0, 1, 1], [7, 6, 6, 4, 21]))
    bypass, clipped = bool(rng.integers(2)), bool(rng.integers(4) == 0)
    n_phi = na + nb * n_inputs
    linear = rng.normal(size=n_phi) * 0.3 if bypass else np.zeros(0)
    if bypass:
        linear[:na] *= rng.uniform(0.1, 0.9) / np.abs(linear[:na]).sum()
    second = rng.normal(size=hidden) / hidden
    settings = {
        "na": na,
        "nb": nb,
        "nk": nk,
        "n_inputs": n_inputs,
        "hidden": hidden,
        "bypass": bypass,
        "u_mean": rng.normal(size=n_inputs),
        "u_scale": rng.uniform(0.5, 5.0, n_inputs),
        "y_mean": float(rng.normal()),
        "y_scale": float(np.exp(rng.uniform(-3.0, 8.0))),
        "output_low": -0.4 if clipped else None,
        "output_high": 0.5 if clipped else None,
    }
    parts = [rng.normal(size=hidden * n_phi), rng.normal(size=hidden), second]
    return {
        "settings": settings,
        "theta": np.concatenate([*parts, rng.normal(size=1) * 0.1, linear]),
        "y_past": settings["y_mean"] + settings["y_scale"] * rng.normal(size=na) * 0.3,
        "u": settings["u_mean"] + settings["u_scale"] * rng.normal(size=(SAMPLES, n_inputs)),
    }


def test_networks_agree_with_complex_steps() -> None:
    rng = np.random.default_rng(20041)
    worst, compared, drawn = 0.0, 0, 0
    while compared < COUNT:
        case = random_network(rng)
        drawn += 1
        s, theta, past, u = (case[k] for k in ("settings", "theta", "y_past", "u"))
        run, rows = _core.NeuralOE(**s, theta=theta).jacobian(u, past)
        if not is_stable(rows, s["na"]):
            continue
        expected_run, expected = reference.jacobian(theta, past, u, s)
        spread = np.abs(expected_run - s["y_mean"]).max() + s["y_scale"]
        assert np.abs(run - expected_run).max() < 1e-12 * spread
        worst = max(worst, relative_error(rows, expected))
        compared += 1
    assert worst <= WORST, worst
    assert drawn < 2 * COUNT


def linear_run(theta: np.ndarray, past: np.ndarray, u: np.ndarray, shape: Any) -> np.ndarray:
    """Free run (N, batch) of [a, b, offset] (n_theta, batch) and past outputs (na, batch)."""
    na, nb, nk = shape
    a, b, offset = theta[:na], theta[na:-1], theta[-1]
    outputs, before = [], list(past)
    for k in range(len(u)):
        lagged = [u[max(k - nk - i, 0), j] for j in range(u.shape[1]) for i in range(nb)]
        y = offset - (a * np.array(before)).sum(axis=0) + np.array(lagged) @ b
        outputs.append(y)
        before = [y, *before[:-1]]
    return np.array(outputs)


def test_linear_models_agree_with_complex_steps() -> None:
    rng = np.random.default_rng(20042)
    worst = 0.0
    for _ in range(COUNT):
        na, nb, nk, n_inputs = (int(v) for v in rng.integers([1, 1, 0, 1], [6, 6, 6, 4]))
        roots = rng.uniform(0.1, 0.95, (na + 1) // 2) * np.exp(
            1j * rng.uniform(0, np.pi, (na + 1) // 2)
        )
        pairs = np.concatenate(
            [roots[: na // 2], roots[: na // 2].conj(), np.abs(roots[na // 2 :])]
        )
        a, b = np.real(np.poly(pairs[:na]))[1:], rng.normal(size=(n_inputs, nb))
        theta, past = np.concatenate([a, b.ravel(), rng.normal(size=1)]), rng.normal(size=na)
        u = rng.normal(size=(SAMPLES, n_inputs))
        model = _core.LinearModel(a, b, nk, theta[-1])
        run, rows = model.jacobian(u, past)
        assert rows.shape == (SAMPLES, len(theta) + na)
        np.testing.assert_array_equal(run, model.simulate(u, past))
        point = np.concatenate([theta, past])
        moved = point[:, None] + 1j * STEP * np.eye(len(point))
        expected = linear_run(moved[: len(theta)], moved[len(theta) :], u, (na, nb, nk))
        size = np.abs(expected.real).max()
        assert np.abs(run - expected[:, 0].real).max() < 1e-12 * max(size, 1.0)
        worst = max(worst, relative_error(rows, expected.imag / STEP))
    assert worst <= WORST, worst


@pytest.mark.parametrize("model", ["linear", "network"])
def test_rest_is_a_state_of_zeros(model: str) -> None:
    case = random_network(np.random.default_rng(1))
    network = _core.NeuralOE(**case["settings"], theta=case["theta"])
    linear = _core.LinearModel(np.array([-0.5, 0.2]), np.ones((1, 1)), 1, 0.0)
    core = linear if model == "linear" else network
    np.testing.assert_array_equal(core.rest_state(), np.zeros(core.na))
