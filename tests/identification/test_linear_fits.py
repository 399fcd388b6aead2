"""Linear fits with one to three inputs: unbiased, as sure as they say, at the Cramer-Rao bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sewfast as api
from sewfast import IV, Dataset, FitError, SettingError, _core

SIGMA = 0.5
DELAYS = (1, 3, 2)
NB = 4


def plant(inputs: int) -> _core.LinearModel:
    """Second order; input j acts after `DELAYS[j]` samples: zeros at the head of its b."""
    b = np.zeros((inputs, NB))
    for j, delay in enumerate(DELAYS[:inputs]):
        b[j, delay - 1 : delay + 1] = np.array([0.5, 0.3]) * (-1) ** j * (1 + j)
    return _core.LinearModel(np.array([-1.5, 0.7]), b, 1, 0.4)


def test_output_error_goes_on_from_a_model_and_refuses_one_of_other_orders() -> None:
    rng, truth = np.random.default_rng(3), plant(2)
    u = excitation(2_000, 2, 4)
    data = [(u, truth.simulate(u, np.zeros(2)) + SIGMA * rng.normal(size=len(u)))]
    searched = _core.fit_oe(data, na=2, nb=NB, nk=1)
    found = _core.fit_oe(data, na=2, nb=NB, nk=1, initial=truth)
    assert found.cost == pytest.approx(searched.cost, rel=1e-9)
    assert found.iterations < searched.iterations / 5
    assert np.allclose(theta_of(found.model), theta_of(searched.model), rtol=1e-5, atol=1e-7)
    again = _core.fit_oe(data, na=2, nb=NB, nk=1, initial=found.model)
    assert again.trace[0] == pytest.approx(found.cost, rel=1e-12)
    with pytest.raises(SettingError, match="na 2, nb 3 and nk 1, got one with na 2, nb 4 and nk 1"):
        _core.fit_oe(data, na=2, nb=3, nk=1, initial=truth)
    with pytest.raises(SettingError, match="initial model of 2 inputs"):
        _core.fit_oe(data, na=2, nb=NB, nk=1, initial=plant(1))


def excitation(n: int, inputs: int, seed: int) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).normal(1.0, 1.0, (n // 3 + 1, inputs)), 3, axis=0)[
        :n
    ]


def theta_of(model: _core.LinearModel) -> np.ndarray:
    return np.concatenate([model.a, model.b.ravel(), [model.offset]])


def cramer_rao_bound(records: list[Any], model: _core.LinearModel, sigma: float) -> np.ndarray:
    """Of [a, b, offset] with an unknown state per experiment and white output noise."""
    blocks, n = [], len(theta_of(model))
    for i, (u, state) in enumerate(records):
        rows = model.jacobian(u, state)[1]
        states = np.zeros((len(rows), model.na * len(records)))
        states[:, i * model.na : (i + 1) * model.na] = rows[:, n:]
        blocks.append(np.hstack([rows[:, :n], states]))
    J = np.vstack(blocks)
    return sigma**2 * np.linalg.inv(J.T @ J)[:n, :n]


def check_scores(errors: np.ndarray, covariance: np.ndarray) -> None:
    """Errors (trials, n) are draws from a normal distribution with mean 0 and this covariance.

    Whitened they are unit normals z: sqrt(T) times a mean of z is a unit normal, the sum of z^2 has
    mean T n and variance 2 T n. Five deviations are allowed, and 10 % for what the asymptotic
    theory leaves out at this number of samples.
    """
    z = np.linalg.solve(np.linalg.cholesky(covariance), errors.T).T
    trials, n = z.shape
    assert np.abs(z.mean(axis=0)).max() < 5.0 / np.sqrt(trials) + 0.1
    assert abs(np.mean(z**2) - 1.0) < 5.0 * np.sqrt(2.0 / (trials * n)) + 0.1


@pytest.mark.parametrize("inputs", [1, 2, 3])
@pytest.mark.parametrize(("kind", "trials"), [("iv", 60), ("oe", 8)])
def test_estimates_reach_the_cramer_rao_bound(kind: str, trials: int, inputs: int) -> None:
    truth, fit = plant(inputs), {"iv": _core.fit_iv, "oe": _core.fit_oe}[kind]
    lengths, states = (500, 300), (np.array([4.0, 3.0]), np.array([-2.0, 1.0]))
    u = [excitation(n, inputs, i) for i, n in enumerate(lengths)]
    clean = [truth.simulate(v, s) for v, s in zip(u, states, strict=True)]
    expected = cramer_rao_bound(list(zip(u, states, strict=True)), truth, SIGMA)
    errors, told = [], []
    for trial in range(trials):
        rng = np.random.default_rng([trial, inputs])
        records = [(v, y + SIGMA * rng.normal(size=len(y))) for v, y in zip(u, clean, strict=True)]
        found = fit(records, na=2, nb=NB, nk=1)
        assert found.model.is_stable
        errors.append(theta_of(found.model) - theta_of(truth))
        told.append(found.covariance)
        np.testing.assert_allclose(found.standard_errors, np.sqrt(np.diag(found.covariance)))
    check_scores(np.array(errors), expected)
    ratio = np.sqrt(np.mean([np.diag(c) for c in told], axis=0) / np.diag(expected))
    # the noise's variance alone is known to sqrt(2/800) = 5 % in each trial
    assert np.all(np.abs(ratio - 1.0) < 0.25), ratio


@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_least_squares_reaches_its_bound_where_noise_is_filtered_by_the_plant(inputs: int) -> None:
    truth, shaping = (
        plant(inputs),
        _core.LinearModel(np.array([-1.5, 0.7]), np.ones((1, 1)), 0, 0.0),
    )
    u = excitation(1500, inputs, 1)
    clean = truth.simulate(u, np.zeros(2))
    errors, moment = [], np.zeros((2 + NB * inputs + 1,) * 2)
    for trial in range(200):
        e = SIGMA * np.random.default_rng([trial, inputs]).normal(size=(len(u), 1))
        y = clean + shaping.simulate(e, np.zeros(2))
        errors.append(theta_of(_core.fit_arx([(u, y)], na=2, nb=NB, nk=1, offset=True)))
        k = np.arange(NB, len(u))
        lagged = [-y[k - 1], -y[k - 2]]
        lagged += [u[k - 1 - i, j] for j in range(inputs) for i in range(NB)]
        phi = np.column_stack([*lagged, np.ones(len(k))])
        moment += phi.T @ phi / 200
    check_scores(np.array(errors) - theta_of(truth), SIGMA**2 * np.linalg.inv(moment))


def test_output_error_and_instrumental_variables_agree_with_each_other() -> None:
    truth, u = plant(2), excitation(2000, 2, 3)
    y = truth.simulate(u, np.zeros(2)) + SIGMA * np.random.default_rng(0).normal(size=2000)
    iv, oe = (fit([(u, y)], na=2, nb=NB, nk=1) for fit in (_core.fit_iv, _core.fit_oe))
    assert iv.termination == "small_step"
    apart = np.abs(theta_of(iv.model) - theta_of(oe.model)) / oe.standard_errors
    assert apart.max() < 0.5
    np.testing.assert_allclose(iv.standard_errors, oe.standard_errors, rtol=0.1)
    assert oe.cost <= iv.cost * (1 + 1e-9)


def test_without_an_offset_none_is_estimated() -> None:
    truth = _core.LinearModel(np.array([-0.9]), np.array([[0.2]]), 1, 0.0)
    u = excitation(400, 1, 4)
    y = truth.simulate(u, np.zeros(1)) + 0.1 * np.random.default_rng(0).normal(size=400)
    for fit in (_core.fit_iv, _core.fit_oe):
        found = fit([(u, y)], na=1, nb=1, nk=1, offset=False)
        assert found.model.offset == 0.0
        assert found.standard_errors[-1] == 0.0
        assert np.all(found.standard_errors[:-1] > 0.0)


def test_parameters_that_no_data_fix_have_no_finite_error() -> None:
    u = np.zeros((200, 1))
    u[100:] = 1.0
    truth = _core.LinearModel(np.array([-0.5]), np.array([[1.0]]), 1, 0.0)
    y = truth.simulate(u, np.zeros(1)) + 0.1 * np.random.default_rng(0).normal(size=200)
    try:
        found = _core.fit_iv([(u, y)], na=6, nb=6, nk=1)
    except FitError:
        return
    assert found.termination != "small_step" or found.standard_errors.max() > 0.1


def test_identify_tells_standard_errors_and_whether_it_settled() -> None:
    truth, u = plant(2), excitation(1000, 2, 5)
    y = truth.simulate(u, np.zeros(2)) + SIGMA * np.random.default_rng(1).normal(size=1000)
    data = Dataset.from_arrays(u, y, 0.01, output_unit="RPM")
    model = api.identify(data, model="iv", nb=NB)
    assert isinstance(model, IV)
    assert model.training["termination"] == "small_step"
    errors = model.training["standard_errors"]
    assert np.shape(errors["a"]) == (2,)
    assert np.shape(errors["b"]) == (2, NB)
    off = np.abs(model.core.b - truth.b) / np.array(errors["b"])
    assert off.max() < 5.0
    hurried = api.identify(data, model="iv", nb=NB, iterations=1)
    assert "did not settle" in str(hurried)
