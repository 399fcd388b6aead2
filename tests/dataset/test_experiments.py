"""Several experiments: a state of its own for each, the same weight for every measured sample."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sewfast import _core, identify
from sewfast.dataset import Dataset, Experiment

A, B, OFFSET, NOISE = (-1.6, 0.66), (0.05, 0.03), 0.1, 0.01
STATES = ((8.0, 8.0), (-6.0, -5.0), (0.0, 0.0))
LENGTHS = (900, 400, 600)


def runs(noise: float = NOISE) -> list[Dataset]:
    """Three runs of one system from states far apart; the second has a gap at its beginning."""
    truth = _core.LinearModel(np.array(A), np.array([B]), 1, OFFSET)
    found = []
    for i, (state, n) in enumerate(zip(STATES, LENGTHS, strict=True)):
        random = np.random.default_rng(i)
        u = np.repeat(random.standard_normal(n // 4), 4)
        y = truth.simulate(np.ascontiguousarray(u[:, None]), np.array(state))
        y += noise * random.standard_normal(n)
        if i == 1:
            y[:7] = np.nan
        found.append(Dataset.from_arrays(u, y, 0.01, name=f"run{i}"))
    return found


def arrays(parts: list[Dataset]) -> list[tuple[Any, Any]]:
    experiments: list[Experiment] = [e for part in parts for e in part.experiments]
    return [(e.u, e.y) for e in experiments]


@pytest.mark.nightly("a fit of every kind", by_day=["arx", "neural_oe"])
@pytest.mark.parametrize("kind", ["arx", "oe", "neural_oe", "auto"])
def test_each_run_keeps_its_own_start(kind: Any) -> None:
    data = Dataset.concat(runs())
    model = identify(data, model=kind, iterations=40, starts=2)
    scores = model.validate(data)
    assert scores.n + scores.unmeasured == sum(len(e) for e in data.experiments) - sum(
        e.init for e in scores.experiments
    )
    bound = 4.0 * NOISE if kind == "arx" else 1.5 * NOISE
    for e in scores.experiments:
        assert e.simulation_scores.rmse < bound, e.name


def test_glued_runs_are_worse_than_experiments() -> None:
    parts = runs()
    u, y = (np.concatenate(c) for c in zip(*arrays(parts), strict=True))
    apart = _core.fit_oe(arrays(parts), na=2, nb=2, nk=1)
    glued = _core.fit_oe([(u, y)], na=2, nb=2, nk=1)
    assert apart.cost < 0.1 * glued.cost
    np.testing.assert_allclose(apart.model.a, A, atol=0.005)
    for state, found in zip(STATES[::2], apart.initial_states[::2], strict=True):
        np.testing.assert_allclose(found, state, atol=20 * NOISE)


@pytest.mark.parametrize("fit", ["oe", "neural_oe"])
def test_the_cost_is_a_mean_over_all_measured_samples(fit: str) -> None:
    parts = arrays(runs())
    linear = _core.fit_oe(parts, na=2, nb=2, nk=1)
    found: Any = linear
    scale = 1.0
    if fit == "neural_oe":
        found = _core.fit_neural_oe(
            parts, [], na=2, nb=2, nk=1, hidden=2, linear=linear.model, u_mean=np.zeros(1),
            u_scale=np.ones(1), y_mean=0.0, y_scale=2.0, saturate=None,
            initial_state="estimated", weight_decay=1e-4, max_iterations=5, starts=1, seed=0,
            threads=1,
        )  # fmt: skip
        scale = 2.0
    squares, count = 0.0, 0
    for (u, y), state in zip(parts, found.initial_states, strict=True):
        first = int(np.flatnonzero(~np.isnan(y))[0])
        # a run begins at the first measured sample; the inputs before it are its past
        run = found.model.simulate(u[first:], state)
        errors = (y[first:] - run)[~np.isnan(y[first:])]
        held = 3 if first else 0  # where the past of the input is held instead of known
        squares, count = squares + float(errors[held:] @ errors[held:]), count + len(errors)
    assert found.cost == pytest.approx(0.5 * squares / count / scale**2, rel=0.02)


def test_a_sample_counts_the_same_in_every_experiment() -> None:
    """Twice the same run weighs as much as two runs: normal equations add up over samples."""
    one, two, _ = arrays(runs())
    twice = _core.fit_arx([one, one, two], na=2, nb=2, nk=1, offset=True)
    # the same rows with weight two, by least squares of its own
    rows, outputs = [], []
    for (u, y), weight in ((one, np.sqrt(2.0)), (two, 1.0)):
        for k in range(2, len(y)):
            row = [-y[k - 1], -y[k - 2], u[k - 1, 0], u[k - 2, 0], 1.0]
            if np.isfinite([*row, y[k]]).all():
                rows.append(weight * np.array(row))
                outputs.append(weight * y[k])
    expected = np.linalg.lstsq(np.array(rows), np.array(outputs), rcond=None)[0]
    np.testing.assert_allclose([*twice.a, *twice.b[0], twice.offset], expected, rtol=1e-7)


def test_the_order_of_experiments_does_not_matter() -> None:
    parts = arrays(runs())
    forth = _core.fit_oe(parts, na=2, nb=2, nk=1)
    back = _core.fit_oe(parts[::-1], na=2, nb=2, nk=1)
    np.testing.assert_allclose(forth.model.a, back.model.a, rtol=1e-6)
    np.testing.assert_allclose(
        forth.initial_states, back.initial_states[::-1], rtol=1e-3, atol=1e-3
    )
