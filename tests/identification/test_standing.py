"""Records that stand still at first: their rest, and gains that no initial state takes over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from effort import FULL
from sewfast import Dataset, LinearOE, _core, identify
from sewfast.arrays import FloatArray
from sewfast.control import fit_fopdt
from sewfast.dataset.standing import Standing, standing
from sewfast.identification.rest import for_loops


def two_lags(k: FloatArray, slow: float, fast: float) -> FloatArray:
    """The response to a step of size 1 at k = 0 [samples]."""
    since = np.maximum(k, 0.0)
    share = slow * np.exp(-since / slow) - fast * np.exp(-since / fast)
    return 1.0 - share / (slow - fast)


def single_step(seed: int) -> tuple[Dataset, float]:
    """A step after 3 to 20 standing samples, at some level and with some noise, and its gain."""
    rng = np.random.default_rng(seed)
    at, slow = int(rng.integers(3, 21)), rng.uniform(60.0, 200.0)
    gain = float(rng.uniform(5.0, 40.0) * rng.choice([1.0, -1.0]))
    n = at + int(rng.uniform(4.0, 8.0) * slow)
    u = rng.choice([0.0, 3.0]) + 6.0 * (np.arange(n) >= at)
    y = 6.0 * gain * two_lags(np.arange(n) - at, slow, rng.uniform(0.05, 0.5) * slow)
    noise = 6.0 * abs(gain) * rng.uniform(0.001, 0.02) * rng.standard_normal(n)
    return Dataset.from_arrays(u, y + rng.choice([0.0, 24.5, 293.15]) + noise, Ts=0.001), gain


@pytest.mark.parametrize("kind", ["oe", "auto"])
@pytest.mark.parametrize("seed", range(30 if FULL else 6))
def test_a_step_soon_after_the_start_tells_its_gain(seed: int, kind: str) -> None:
    data, gain = single_step(seed)
    model = identify(data, model=kind, threads=1)
    assert isinstance(model, LinearOE)
    assert model.dc_gain[0] == pytest.approx(gain, rel=0.05)
    # nothing of a single step can be held out to judge by
    assert model.training["verdict"]["grade"] == "fair"


def test_the_rest_of_a_record_is_kept_in_its_model() -> None:
    rng, n = np.random.default_rng(0), 600
    u = np.concatenate([np.full(40, 2.0), np.repeat(rng.uniform(2.0, 9.0, 28), 20)])
    plant = _core.LinearModel(np.array([-0.9]), np.array([[0.2]]), 1, 0.0)
    y = plant.simulate(u[:, None], np.array([4.0])) + 0.01 * rng.standard_normal(n)
    for level in (0.0, 24.5, 293.15):
        model = identify(Dataset.from_arrays(u, y + level, Ts=0.1), model="oe", threads=1)
        assert model.rest.u == (2.0,)
        assert model.rest.source == "standing samples"
        assert model.rest.y == pytest.approx(4.0 + level, abs=0.01)
        assert model.training["rest"] == model.rest.to_json()
    # without standing samples: the equilibrium under the least command
    model = identify(Dataset.from_arrays(u[60:], y[60:] + 24.5, Ts=0.1), model="oe", threads=1)
    assert model.rest.source == "equilibrium"
    assert model.rest.y == pytest.approx(24.5 + 2.0 * model.rest.u[0], abs=0.5)


def test_a_fast_record_about_a_level_rests_at_its_mean_command() -> None:
    """A network is known at no end of it: the record was never long enough at either."""
    rng, n = np.random.default_rng(2), 3000
    u = 2.0 + np.repeat(rng.choice([-1.0, 1.0], n // 10), 10) * rng.uniform(0.5, 1.0, n)
    y, x = np.zeros(n), 24.5
    for k in range(n):
        y[k] = x
        x += 0.01 * (21.0 + np.sqrt(6.0 * u[k]) - x)
    record = Dataset.from_arrays(u, y + 0.005 * rng.standard_normal(n), 0.002)
    model = identify(record, model="neural_oe", starts=1, threads=1, seed=0)
    assert model.rest.source == "equilibrium"
    assert model.rest.u[0] == pytest.approx(u.mean())
    assert model.rest.y == pytest.approx(21.0 + np.sqrt(12.0), abs=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_what_integrates_rests_where_it_stays(seed: int) -> None:
    """A hover: no command but one holds a level, and all levels are alike to it."""
    rng, n = np.random.default_rng(seed), 3000
    u, y, fall = np.zeros(n), np.zeros(n), 0.0
    height, dither = 3.0, np.repeat(rng.choice([-15.0, 15.0], n // 20), 20)
    for k in range(n):
        y[k] = height + 0.005 * rng.standard_normal()
        u[k] = np.clip(50.0 + 25.0 * (3.0 - y[k]) - 30.0 * fall + dither[k], 20.0, 90.0)
        fall += 0.02 * (0.196 * (u[k] - 50.0) - 0.4 * fall)
        height += 0.02 * fall
    model = identify(Dataset.from_arrays(u, y, 0.02), model="oe", na=2, nb=3, nk=1, threads=1)
    assert model.rest.u[0] == pytest.approx(50.0, abs=1.0)
    assert model.rest.y == pytest.approx(y.mean(), abs=0.2 * np.ptp(y))


@pytest.mark.parametrize(("held", "u", "y"), [(4, 60.0, 3000.0), (200, 66.0, 3132.0)])
def test_too_few_standing_samples_to_show_a_response_are_no_rest(
    held: int, u: float, y: float
) -> None:
    """A turbine under load ran with 60 % until the record began with 66."""
    rng, n = np.random.default_rng(18), 800
    command = 60.0 + 6.0 * np.repeat([1.0, -1.0, *rng.choice([-1.0, 1.0], n // 4 - 2)], 4)
    command = np.concatenate([np.full(held - 4, 66.0), command])
    speed, valve = np.full(len(command), 3000.0 if held == 4 else 3132.0), command[0]
    valve = 60.0 if held == 4 else 66.0
    for k in range(1, len(command)):
        valve += 0.12 * (command[k - 1] - valve)
        speed[k] = speed[k - 1] + 0.02 * (3000.0 + 22.0 * (valve - 60.0) - speed[k - 1])
    record = Dataset.from_arrays(command, speed + 2.0 * rng.standard_normal(len(command)), 0.02)
    rest = identify(record, model="oe").rest
    assert rest.u[0] == pytest.approx(u, abs=1.0)
    assert rest.y == pytest.approx(y + 22.0 * (rest.u[0] - u), abs=5.0)


def test_a_motor_that_turns_late_does_not_rest_at_its_first_command() -> None:
    """It stood at 0 V until the record began with 5 V, for less than its lags show."""
    rng, n = np.random.default_rng(0), 1500
    u = 5.0 * np.repeat([1.0, -1.0, *rng.choice([-1.0, 1.0], n // 4 - 2)], 4)
    current, speed, y = 0.0, 0.0, np.zeros(n)
    for k in range(1, n):
        current += 0.1 * (u[k - 1] - current)
        speed += 0.01 * (90.0 * current - speed)
        y[k] = speed
    y += 3.0 * rng.standard_normal(n)
    record = Dataset.from_arrays(u, y, 0.001, input_units=("V",), output_unit="RPM")
    assert standing(record.experiments[0]) is not None
    assert identify(record, model="oe").rest.is_zero


def test_a_level_that_no_record_shows_is_no_rest_where_a_budget_lost_the_region() -> None:
    """A chiller that a loop holds at 7 degC with 54 %: without a command it would be at 19."""
    rng = np.random.default_rng(3)
    u = 54.0 + np.repeat(10.0 * rng.choice([-1.0, 1.0], 100), 6)
    y = np.full(600, 7.0)
    for k in range(1, 600):
        y[k] = y[k - 1] + 0.04 * (19.0 - 0.22222 * u[k - 1] - y[k - 1])
    record = Dataset.from_arrays(u, y + 0.03 * rng.standard_normal(600), 5.0)
    model = identify(record, model="oe")
    kept = {k: v for k, v in model.training.items() if k not in ("region", "rest")}
    for found in (model, for_loops(replace(model, training=kept), record)):
        assert found.rest.u[0] == pytest.approx(u.mean())
        assert found.rest.y == pytest.approx(19.0 - 0.22222 * u.mean(), abs=0.2)


def test_only_outputs_that_stand_still_are_a_rest() -> None:
    u = np.repeat([0.0, 1.0], [50, 150])
    noise = 0.01 * np.random.default_rng(1).standard_normal(200)

    def found(y: FloatArray) -> Standing | None:
        return standing(Dataset.from_arrays(u, y, Ts=1.0).experiments[0])

    response = two_lags(np.arange(200.0) - 50.0, 20.0, 5.0)
    here, there = found(response + noise), found(response + noise + 22.0)
    assert here is not None
    assert there is not None
    # the mean at every level; beside it, whether noise explains what differs from zero
    assert (here.near_zero, there.near_zero) == (True, False)
    assert here.y == pytest.approx(0.0, abs=0.01)
    assert there.y == pytest.approx(here.y + 22.0, abs=1e-12)
    # an output that still cools down is at no rest
    assert found(response + noise + np.exp(-np.arange(200.0) / 40.0)) is None
    # and neither is a record that never moves, or moves at once
    assert standing(Dataset.from_arrays(u * 0.0, noise, Ts=1.0).experiments[0]) is None
    assert standing(Dataset.from_arrays(u[49:], noise[49:], Ts=1.0).experiments[0]) is None


@pytest.mark.parametrize("seed", range(5))
def test_a_second_lag_after_standing_samples_is_no_motion_from_before(seed: int) -> None:
    rng = np.random.default_rng(seed)
    k, u = np.arange(1000.0) - 60.0, np.repeat([10.0, 30.0], [60, 940])
    y = 22.5 + 0.85 * 20.0 * two_lags(k, 140.0, 35.0) + 0.05 * rng.standard_normal(1000)
    found = fit_fopdt(u, y, Ts=1.0)
    assert not found.moving
    assert found.K == pytest.approx(0.85, rel=0.02)  # noqa: SIM300
    # a plant that does move before the step is still seen
    cooling = y + 8.0 * np.exp(-(k + 60.0) / 150.0)
    assert fit_fopdt(u, cooling, Ts=1.0).moving


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_an_input_averaged_over_its_step_is_one_step(share: float) -> None:
    # the step comes this share of a sample after sample 100
    u = np.repeat([100.0, 1100.0], [100, 150])
    u[100] += share * (100.0 - 1100.0)
    since = np.maximum(np.arange(250.0) - 100.0 - share, 0.0)
    y = -0.42 * np.expm1(-since / 2.0) + 1e-3 * np.random.default_rng(0).standard_normal(250)
    found = fit_fopdt(u, y, Ts=0.02)
    assert found.K == pytest.approx(0.42 / 1000.0, rel=0.01)  # noqa: SIM300
    assert found.T == pytest.approx(0.04, rel=0.02)  # noqa: SIM300
    assert found.L < 0.002
