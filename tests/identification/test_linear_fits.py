"""Linear fits with one to three inputs: unbiased, as sure as they say, at the Cramer-Rao bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import sewfast as api
from plants import steps
from sewfast import IV, Dataset, SettingError, _core, identify
from sewfast.errors import DataError, FitError
from sewfast.identification.linear import time_constant

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


# --- ARX against NumPy's least squares on rows, on data that make it hard -------------------------


WELL_POSED = 1e3


def rows(u: np.ndarray, y: np.ndarray, na: int, nb: int, nk: int) -> np.ndarray:
    """Rows ``[y(k-1..), u_0(k-nk..), .., 1, y(k)]``, those that were measured throughout."""
    first = max(na, nk + nb - 1)
    k = np.arange(first, len(y))
    past = [y[k - 1 - i] for i in range(na)]
    inputs = [u[k - nk - i, j] for j in range(u.shape[1]) for i in range(nb)]
    table = np.stack([*past, *inputs, np.ones(len(k)), y[k]], axis=1)
    return table[np.isfinite(table).all(axis=1)]


def data(
    seed: int, samples: int, inputs: int, offset: float, scale: float, gaps: bool
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(samples, inputs)) + offset
    y = np.zeros(samples)
    for k in range(2, samples):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + u[k - 1].sum() + 0.3 * rng.normal()
    if gaps:
        y[rng.random(samples) < 0.05] = np.nan
    return u * scale, y * scale


@settings(deadline=None, max_examples=60)
@given(
    orders=st.tuples(st.integers(1, 4), st.integers(1, 4), st.integers(0, 5)),
    inputs=st.integers(1, 3),
    lengths=st.lists(st.integers(30, 3000), min_size=1, max_size=3),
    offset=st.sampled_from([0.0, 1.0, -30.0, 1e4]),
    exponent=st.sampled_from([-170, -80, -3, 0, 6, 80, 160]),
    gaps=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_agrees_with_lstsq(
    orders: tuple[int, int, int],
    inputs: int,
    lengths: list[int],
    offset: float,
    exponent: int,
    gaps: bool,
    seed: int,
) -> None:
    na, nb, nk = orders
    scale = 10.0**exponent
    pairs = [data(seed + i, n, inputs, offset, scale, gaps) for i, n in enumerate(lengths)]
    table = np.concatenate([rows(u / scale, y / scale, *orders) for u, y in pairs])
    columns, target = table[:, :-1], table[:, -1]
    if len(target) < 2 * columns.shape[1]:
        return
    sizes = np.linalg.norm(columns, axis=0)
    expected, _, _, singular = np.linalg.lstsq(columns / sizes, target, rcond=None)
    try:
        model = _core.fit_arx(pairs, na=na, nb=nb, nk=nk, offset=True)
    except FitError:
        assert singular[-1] <= 1e-11 * singular[0]
        return
    found = np.concatenate([-model.a, model.b.ravel(), [model.offset / scale]]) * sizes
    if singular[0] <= WELL_POSED * singular[-1]:
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max(), rtol=0)
    best = np.linalg.norm(target - columns / sizes @ expected)
    left = np.linalg.norm(target - columns / sizes @ found)
    assert left <= best * (1 + 1e-9) + 1e-9 * np.linalg.norm(target)


def test_a_long_record_agrees_with_lstsq() -> None:
    u, y = data(3, 200_000, 1, 0.0, 1.0, gaps=False)
    table = rows(u, y, 2, 2, 1)[:, [0, 1, 2, 3, 5]]
    expected = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
    model = _core.fit_arx([(u, y)], na=2, nb=2, nk=1, offset=False)
    np.testing.assert_allclose(np.concatenate([-model.a, model.b[0]]), expected, atol=1e-9)


@pytest.mark.parametrize("at", [0, 1, 2, 777, 1998, 1999])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_names_a_sample_that_cannot_be_used(at: int, value: float) -> None:
    u, y = data(0, 2000, 1, 0.0, 1.0, gaps=False)
    u[at] = value
    with pytest.raises(DataError, match=rf"sample {at};"):
        _core.fit_arx([(u, y)], na=2, nb=2, nk=3, offset=True)


def test_refuses_a_column_that_never_changes() -> None:
    u, y = data(0, 2000, 2, 0.0, 1.0, gaps=False)
    u[:, 1] = 4.0
    with pytest.raises(DataError, match="input 1 to change"):
        _core.fit_arx([(u, y)], na=2, nb=1, nk=1, offset=False)


# --- Records too short to choose by: the steady gain, the integrator ------------------------------


F = NDArray[np.float64]


def speed(u: F, pole: float = 0.9, gain: float = 1.5) -> F:
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + (1.0 - pole) * gain * u[k - 1]
    return y


def recording(u: F, y: F, seed: int, noise: float = 0.05) -> Dataset:
    error = noise * np.random.default_rng(seed + 1000).normal(size=len(u))
    return Dataset.from_arrays(u, y + error, 0.01)


@pytest.mark.parametrize(("n", "first"), [(60, 300), (60, 7000), (100, 7000)])
def test_a_pole_that_the_record_cannot_show_does_not_make_the_steady_gain(
    n: int, first: int
) -> None:
    gains, smaller = [], 0
    for seed in range(first, first + 20):
        u = steps(n, seed)[:, 0]
        model = identify(recording(u, speed(u), seed))
        gains.append(model.core.dc_gain()[0])
        smaller += model.orders["na"] == 1
    assert np.abs(gains).max() < 3.0
    assert np.median(gains) == pytest.approx(1.5, rel=0.05)
    # second order stays where it is no trend
    assert smaller < 10


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_a_drive_that_integrates_keeps_its_pole(pole: float) -> None:
    for seed in range(6):
        u = steps(100, seed)[:, 0]
        model = identify(recording(u, 0.05 * np.cumsum(speed(u, pole)), seed, 0.01))
        assert time_constant(model.core) > 100.0
