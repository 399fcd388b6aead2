"""The descent of a motor's fit, its sums, and the covariance that intervals come from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_physics import linear

import sewfast
from sewfast import physics
from sewfast.motorfit.estimation import covariance_of, minimised
from sewfast.motorfit.problem import NOTHING, PLACE, Problem, State
from sewfast.motorfit.records import records_of, spikes_of

FREE = (np.full(2, -np.inf), np.full(2, np.inf))
T = np.linspace(0.0, 4.0, 25)


def decay(noise: float, seed: int = 0) -> tuple[Any, Any, np.ndarray]:
    """`2 exp(-t)` in noise: normal equations and cost of `x[0] exp(-x[1] t)`, and the values."""
    y = 2.0 * np.exp(-T) + noise * np.random.default_rng(seed).standard_normal(len(T))

    def parts(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e = np.exp(-x[1] * T)
        return x[0] * e - y, np.stack([e, -x[0] * T * e], axis=1)

    def normal(x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        r, J = parts(x)
        return float(r @ r), J.T @ r, J.T @ J

    return normal, lambda x: float(parts(x)[0] @ parts(x)[0]), y


def test_the_least_squares_are_those_of_the_certified_solver() -> None:
    normal, cost, y = decay(0.1)
    found = minimised(normal, cost, np.array([1.0, 0.3]), FREE, len(T), enough=1e-8, iterations=50)
    sure = sewfast.least_squares(lambda x: x[0] * np.exp(-x[1] * T) - y, [1.0, 0.3])
    assert found.x == pytest.approx(sure.x, rel=1e-4)
    assert found.left < 1e-8


def test_a_bound_holds_what_would_leave_it() -> None:
    normal, cost, y = decay(0.1)
    low, high = np.array([-np.inf, 1.5]), np.full(2, np.inf)
    found = minimised(
        normal, cost, np.array([1.0, 2.0]), (low, high), len(T), enough=1e-8, iterations=50
    )
    e = np.exp(-1.5 * T)
    assert found.x == pytest.approx([float(e @ y) / float(e @ e), 1.5], rel=1e-6)


def test_scores_that_hang_together_widen_the_covariance() -> None:
    rng = np.random.default_rng(4)
    e = rng.standard_normal(4000)
    alike = np.repeat(e[:400], 10)
    J = np.ones((4000, 1))
    one, other = (float(covariance_of(J, r, [4000])[0, 0]) for r in (e, alike))
    assert one == pytest.approx(1 / 4000, rel=0.4)
    assert other == pytest.approx(10 / 4000, rel=0.6)


def test_windows_to_which_a_fit_bends_do_not_narrow_the_covariance() -> None:
    """Of 12 parameters that show for a while each; without the correction the ratio is .5."""
    rng = np.random.default_rng(7)
    shape = np.exp(-0.5 * ((np.arange(300.0)[:, None] - np.linspace(20, 280, 12)) / 15) ** 2)
    ratios = []
    for _ in range(60):
        J, e = shape * rng.standard_normal((300, 12)), rng.standard_normal(300)
        left = e - J @ np.linalg.lstsq(J, e, rcond=None)[0]
        found = np.diag(covariance_of(J, left, [300]))
        ratios.append(np.mean(found / np.diag(np.linalg.inv(J.T @ J))))
    student = (1.0 + 1.2 / (1.5 * 300 / 20)) ** 2
    assert np.mean(ratios) / student == pytest.approx(1.0, abs=0.12)


def test_spikes_of_a_short_record_are_found_and_its_corners_kept() -> None:
    """Eleven in 300 samples, two of them side by side at the end."""
    _, y = linear(300)
    at = np.array([20, 57, 90, 91, 130, 155, 180, 222, 260, 298, 299])
    spiked = y.copy()
    spiked[at] += np.where(np.arange(11) % 3, 400.0, -300.0)
    spiked[299] = spiked[298]
    assert np.array_equal(np.flatnonzero(spikes_of(spiked, 0.0)), at)
    assert not spikes_of(y, 0.0).any()


def test_the_sums_of_the_core_are_those_of_residuals_and_jacobian() -> None:
    """With gaps, a current and filters of several taps, over two pieces."""
    rng = np.random.default_rng(5)
    u, y = linear(600)
    y[250:255] = np.nan
    u[300] = np.nan
    record = sewfast.Dataset.from_arrays(u, y, 0.02, output_unit="rad/s")
    problem = Problem(records_of(record, rng.standard_normal(600), None))
    problem.speed_filter = np.array([0.9, -0.4, 0.2])
    problem.current_filter = np.array([1.5, -0.5])
    theta = NOTHING.copy()
    for name, value in {"k_e": 0.02, "k_a": 0.006, "tau": 0.01, "k_s": 0.3}.items():
        theta[PLACE[name]] = value
    state = State(theta, 0.7, ("lag", "coulomb", "load_1"))
    cost, gradient, matrix = problem.normal(state)
    J, r = problem.jacobian(state), problem.residuals(state)
    assert len(problem.records.pieces) == 2
    assert cost == pytest.approx(float(r @ r), rel=1e-12)
    assert gradient == pytest.approx(J.T @ r, rel=1e-9, abs=1e-9 * np.abs(J.T @ r).max())
    assert matrix == pytest.approx(J.T @ J, rel=1e-9, abs=1e-12 * float(np.max(J.T @ J)))


def test_a_ramp_does_not_show_the_inertia() -> None:
    u = np.linspace(0.0, 8.0, 1500)
    y, w = np.empty(1500), 0.0
    for k, command in enumerate(u):
        y[k] = w
        w += 0.02 / 0.006 * max(command - 0.02 * w - 0.3, 0.0)
    y += np.random.default_rng(6).standard_normal(1500)
    motor = physics(sewfast.Dataset.from_arrays(u, y, 0.02, output_unit="rad/s"))
    assert "steps" in motor.undetermined["k_a"]
    assert motor.value("k_v") == pytest.approx(0.02, rel=0.01)
