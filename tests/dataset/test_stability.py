"""Unstable plants in closed loops are found, and nothing else is taken for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from effort import FULL
from sewfast import Controller, Dataset, Gains, _core, identify, run, tune
from sewfast.arrays import FloatArray
from sewfast.dataset import diagnose
from sewfast.errors import FitError
from sewfast.models import ARX, LinearOE

Plant = tuple[FloatArray, FloatArray]


def plant(rng: np.random.Generator, Ts: float) -> Plant:
    """A falling body, a runaway of first order behind a lag, or a body behind an actuator."""
    w, gain = rng.uniform(0.01, 0.06) / Ts, rng.uniform(0.5, 3.0)
    A, B = (
        ([[0.0, 1.0], [w * w, 0.0]], [0.0, gain * w * w]),
        ([[w, w], [0.0, -3.0 * w]], [0.0, 3.0 * w]),
        ([[0.0, 1.0, 0.0], [w * w, 0.0, w * w], [0.0, 0.0, -4.0 * w]], [0.0, 0.0, 4.0 * w]),
    )[rng.integers(3)]
    n = len(A)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = A, B
    moved = expm(whole * Ts)
    return moved[:n, :n], moved[:n, n]


def looped(seed: int) -> tuple[Dataset, float]:
    """An unstable plant under state feedback with a dither, and its pole."""
    rng = np.random.default_rng(seed)
    Ts = float(rng.choice([0.001, 0.01, 0.05]))
    F, G = plant(rng, Ts)
    weights = np.diag([1.0, *[0.1 * Ts**2] * (len(F) - 1)])
    cost = np.array([[rng.uniform(0.05, 2.0)]])
    P = solve_discrete_are(F, G[:, None], weights, cost)
    K = (G @ P @ F) / (cost[0, 0] + G @ P @ G)
    n, dither = int(rng.integers(600, 4000)), rng.uniform(0.1, 1.0)
    reference = rng.choice([0.0, 0.5]) * np.repeat(rng.uniform(-1.0, 1.0, n // 50 + 1), 50)[:n]
    u, y, x = np.zeros(n), np.zeros(n), np.zeros(len(F))
    for k in range(n):
        u[k] = -K @ x + dither * rng.standard_normal() + reference[k]
        y[k], x = x[0], F @ x + G * u[k]
    y += y.std() * rng.choice([0.001, 0.01, 0.03]) * rng.standard_normal(n)
    return Dataset.from_arrays(u, y, Ts), float(np.abs(np.linalg.eigvals(F)).max())


def unstable_pole(data: Dataset) -> float | None:
    return _core.unstable_pole([(e.u, e.y) for e in data.experiments])


def test_unstable_plants_in_loops_are_found() -> None:
    seeds, missed = range(200 if FULL else 20), 0
    for seed in seeds:
        data, pole = looped(seed)
        found = unstable_pole(data)
        if len(data) / 2 * np.log(pole) < 2.0 * np.log(100.0):
            continue  # so short a record does not tell
        if found is None:
            missed += 1
        else:
            assert found == pytest.approx(pole, abs=0.7 * (pole - 1.0))
    assert missed <= len(seeds) // 20


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
def test_nothing_else_is_taken_for_unstable(noise: float) -> None:
    """Integrators in and out of loops, slow poles, resonances, and columns that say nothing."""
    rng = np.random.default_rng(7)
    plants = {
        "integrator": [1.0, -1.0], "two integrators": [1.0, -2.0, 1.0],
        "slow": [1.0, -0.99999], "resonance": [1.0, -1.99, 0.99995], "quick": [1.0, -0.2],
    }  # fmt: skip
    for name, a in plants.items():
        for loop in (0.0, 0.05):
            for _ in range(40 if FULL else 4):
                n = int(rng.integers(300, 3000))
                r = np.repeat(rng.uniform(-1.0, 1.0, n // 10 + 1), 10)[:n]
                u, y = np.zeros(n), np.zeros(n)
                for k in range(n):
                    past = sum(-c * y[k - i] for i, c in enumerate(a) if 0 < i <= k)
                    y[k] = past + (0.1 * u[k - 1] if k else 0.0)
                    slope = y[k] - y[k - 1] if k else 0.0
                    u[k] = r[k] - loop * y[k] - (2.0 * slope if loop else 0.0)
                y += noise * y.std() * rng.standard_normal(n)
                assert unstable_pole(Dataset.from_arrays(u, y, 0.01)) is None, (name, loop)
    for u, y in ((np.ones(200), np.ones(200)), (rng.standard_normal(9), rng.standard_normal(9))):
        assert unstable_pole(Dataset.from_arrays(u, y, 0.01)) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_stable_model_of_an_unstable_plant_is_useless(seed: int) -> None:
    data, _ = looped(seed)
    model = identify(data, model="oe", na=2, nb=2)
    verdict = model.training["verdict"]
    assert verdict["grade"] == "useless"
    assert "unstable plant in a closed loop" in verdict["text"]
    assert "leave the kind of model to the search" in verdict["next"][0]


def held(samples: int = 1500) -> tuple[LinearOE, Dataset]:
    """A falling body, and its record under a controller with a dither on the command."""
    truth = LinearOE.from_tf([0.0, 1.6e-3, 1.6e-3], [1.0, -2.0024, 1.0], 0.01)
    rng = np.random.default_rng(2)
    own = Controller(
        Gains.standard(2.5, np.inf, 0.2, y_unit="rad"), Ts=0.01, N=20.0, u_min=-9.0, u_max=9.0
    )
    loop = run(own, truth, np.zeros(samples), feedforward=0.3 * rng.standard_normal(samples))
    y = loop.y + 5e-4 * rng.standard_normal(samples)
    return truth, Dataset.from_arrays(loop.u, y, 0.01, input_units=("V",), output_unit="rad")


def test_an_unstable_plant_is_identified_and_tuned_without_an_option() -> None:
    truth, data = held()
    assert diagnose(data).find("unstable") is not None
    model = identify(data)
    assert model.kind == "arx"
    assert model.orders == {"na": 2, "nb": 2, "nk": 1}
    assert isinstance(model, ARX)
    assert np.abs(model.poles) == pytest.approx([1.0502, 0.9522], abs=3e-3)
    assert "by ARMAX, prediction error" in str(model)
    verdict = model.training["verdict"]
    assert verdict["grade"] == "fair"
    assert "free runs as long as it doubles, 14 samples" in verdict["text"]
    assert verdict["fit_percent"] > 90.0
    found = tune(model, np.repeat([0.0, 0.05], 300), evaluations=300, threads=1)
    assert found.verdict.grade == "fair"
    after = run(found.controller, truth, np.repeat([0.0, 0.05], 600))
    assert np.abs(after.y[-100:] - 0.05).max() < 0.01


@pytest.mark.parametrize("every", [2, 9])
def test_outputs_that_are_missing_one_by_one_are_predicted(every: int) -> None:
    _, data = held()
    data = data.mask(np.arange(len(data)) % every == every - 1)
    assert diagnose(data).find("unstable") is not None
    model = identify(data)
    assert isinstance(model, ARX)
    assert np.abs(model.poles).max() == pytest.approx(1.0502, abs=3e-3)


def test_gaps_and_a_level_at_rest_are_no_obstacle() -> None:
    _, data = held()
    (e,) = data.experiments
    y = e.y + 2.0
    y[[5, *range(700, 720)]] = np.nan
    moved = Dataset.from_arrays(e.u + 3.0, y, 0.01, input_units=("V",), output_unit="rad")
    model = identify(moved)
    assert isinstance(model, ARX)
    assert np.abs(model.poles) == pytest.approx([1.0502, 0.9522], abs=3e-3)
    assert model.rest.u[0] == pytest.approx(3.0, abs=0.1)
    assert model.rest.y == pytest.approx(2.0, abs=0.05)
    found = model.validate(moved)
    assert (found.grade, found.ahead) == ("fair", 14)
    assert found.simulation.fit_percent > 90.0
    tuned = tune(model, evaluations=200, threads=1)
    assert tuned.verdict.grade == "fair"
    assert tuned.pid.u_min < 3.0 < tuned.pid.u_max


def test_least_squares_of_many_orders_say_what_noise_leaves_of_them() -> None:
    _, data = held()
    verdict = identify(data, model="arx", na=8, nb=8).training["verdict"]
    assert "unstable, as its plant has to be" in verdict["text"]


def test_an_unstable_plant_that_no_pid_holds_is_refused() -> None:
    # it doubles within two samples, and answers after six of them
    model = LinearOE.from_tf([0.0] * 6 + [0.4], [1.0, -1.4], 0.01)
    model = replace(model, training={"input_range": [[-1.0, 1.0]], "output_range": [-1.0, 1.0]})
    with pytest.raises(FitError, match=r"none of \d+ PIDs holds"):
        tune(model, evaluations=10)


@pytest.mark.parametrize("seed", range(8 if FULL else 2))
def test_unstable_plants_are_stabilised_or_refused(seed: int) -> None:
    data, pole = looped(seed)
    model = identify(data, threads=1)
    assert isinstance(model, ARX)
    assert max(np.abs(model.poles)) == pytest.approx(pole, abs=2e-3)
