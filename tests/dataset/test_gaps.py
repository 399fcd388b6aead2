"""Outputs that were not measured (NaN): what fits, states and predictions make of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from refusals import refuses
from sewfast import _core, identify
from sewfast.dataset import Dataset, FloatArray
from sewfast.errors import DataError, FitError

A, B, OFFSET = (-1.6, 0.66), (0.05, 0.03), 0.1
NETWORK: dict[str, Any] = {
    "na": 2,
    "nb": 2,
    "nk": 1,
    "hidden": 4,
    "u_mean": None,
    "u_scale": None,
    "y_mean": None,
    "y_scale": None,
    "saturate": 1.0,
    "weight_decay": 1e-4,
    "max_iterations": 15,
    "starts": 2,
    "seed": 1,
    "threads": 2,
}
STARTS = ["estimated", "measured", "zero"]


def recording(
    seed: int, noise: float = 0.01, state: tuple[float, float] = (3.0, 2.0), n: int = 1500
) -> tuple[FloatArray, FloatArray]:
    """Steps of random height through the system above."""
    random = np.random.default_rng(seed)
    u = np.ascontiguousarray(np.repeat(random.standard_normal((n // 5, 1)), 5, 0))
    truth = _core.LinearModel(np.array(A), np.array([B]), 1, OFFSET)
    y = truth.simulate(u, np.array(state))
    return u, y + noise * random.standard_normal(n)


def masked(y: FloatArray, kind: str) -> FloatArray:
    y = y.copy()
    if kind == "random":
        y[np.random.default_rng(9).random(len(y)) < 0.3] = np.nan
    if kind == "long gaps":
        y[300:600] = y[900:1100] = np.nan
    if kind == "first samples":
        y[:200] = np.nan
    if kind == "every tenth":
        y[np.arange(len(y)) % 10 != 0] = np.nan
    return y


@pytest.mark.parametrize("kind", ["none", "random", "long gaps", "first samples", "every tenth"])
def test_output_error_recovers_a_system_through_gaps(kind: str) -> None:
    (u, y), (u2, y2) = recording(0), recording(1, state=(-2.0, 0.0))
    fit = _core.fit_oe([(u, masked(y, kind)), (u2, masked(y2, kind))], na=2, nb=2, nk=1)
    # With 1 % noise a tenth of the samples still fixes the poles to a few per mille.
    np.testing.assert_allclose(fit.model.a, A, atol=0.005)
    np.testing.assert_allclose(fit.model.dc_gain(), sum(B) / (1 + sum(A)), rtol=0.005)
    # The mean of N squares of white noise has a relative spread of sqrt(2/N); N is 300 at least.
    assert fit.cost == pytest.approx(0.5 * 0.01**2, rel=5 * np.sqrt(2 / 300))


@pytest.mark.parametrize("kind", ["random", "long gaps", "first samples"])
def test_least_squares_recovers_a_clean_system_through_gaps(kind: str) -> None:
    u, y = recording(0, noise=0.0)
    model = _core.fit_arx([(u, masked(y, kind))], na=2, nb=2, nk=1, offset=True)
    np.testing.assert_allclose(model.a, A, atol=1e-8)
    np.testing.assert_allclose(model.b[0], B, atol=1e-8)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("kind", ["random", "long gaps", "first samples"])
def test_a_network_learns_through_gaps(kind: str, start: str) -> None:
    u, y = recording(3, state=(0.0, 0.0) if start == "zero" else (3.0, 2.0))
    linear = _core.fit_oe([(u, y)], na=2, nb=2, nk=1).model
    z = masked(y, kind)
    fit = _core.fit_neural_oe([(u, z)], [(u, z)], linear=linear, initial_state=start, **NETWORK)
    run = fit.model.simulate(u, fit.model.estimate_initial_state(u[:20], y[:20]))
    # Also where nothing was measured the run is right, to a few times the noise.
    assert np.sqrt(np.mean((run - y)[40:] ** 2)) < 0.04
    assert fit.sound
    assert fit.validation_cost is not None


def test_where_nothing_was_measured_nothing_has_weight() -> None:
    """The cost of masked data is the cost over what is left."""
    u, y = recording(0)
    z = masked(y, "random")
    fit = _core.fit_oe([(u, z)], na=2, nb=2, nk=1)
    run = fit.model.simulate(u, fit.model.estimate_initial_state(u, z))
    # the estimate of the state has a weak prior, which the fit has not
    assert np.nanmean((run - z) ** 2) / 2 == pytest.approx(fit.cost, rel=1e-3)


@pytest.mark.parametrize("start", ["estimated", "measured"])
def test_masking_the_first_part_is_leaving_it_out(start: str) -> None:
    """A run begins at the first measured sample; what came before is the inputs' past alone."""
    u, y = recording(0)
    u[:700] = u[700]
    z = y.copy()
    z[:700] = np.nan
    pairs = ((u, z), (u[700:], y[700:]))
    gap, cut = (_core.fit_oe([pair], na=2, nb=2, nk=1) for pair in pairs)
    np.testing.assert_allclose(gap.model.a, cut.model.a, rtol=1e-6)
    np.testing.assert_allclose(gap.initial_states, cut.initial_states, rtol=1e-4)
    scaling = {"u_mean": np.zeros(1), "u_scale": np.ones(1), "y_mean": 0.5, "y_scale": 2.0}
    settings = NETWORK | scaling | {"linear": cut.model, "initial_state": start}
    networks = [_core.fit_neural_oe([pair], [], **settings) for pair in pairs]
    np.testing.assert_array_equal(networks[0].model.theta, networks[1].model.theta)
    np.testing.assert_array_equal(networks[0].initial_states, networks[1].initial_states)


def test_the_input_must_be_known_and_something_measured() -> None:
    u, y = recording(0)
    broken = u.copy()
    broken[77] = np.nan
    nothing = np.full_like(y, np.nan)
    infinite = y.copy()
    infinite[5] = np.inf
    for bad, message in [
        ((broken, y), "sample 77"),
        ((u, nothing), "NaN throughout"),
        ((u, infinite), "sample 5"),
    ]:
        with pytest.raises(DataError, match=message):
            _core.fit_oe([bad], na=2, nb=2, nk=1)
        with pytest.raises(DataError, match=message):
            _core.fit_arx([bad], na=2, nb=2, nk=1, offset=True)
    few = nothing.copy()
    few[::300] = 1.0 + np.arange(5)
    with pytest.raises((DataError, FitError), match=r"samples|measured"):
        _core.fit_oe([(u, few)], na=2, nb=2, nk=1)
    alternate = masked(y, "every tenth")
    with pytest.raises(DataError, match="in a row"):
        _core.fit_neural_oe([(u, alternate)], [], linear=None, initial_state="measured", **NETWORK)


def test_prediction_runs_on_over_what_was_not_measured() -> None:
    u, y = recording(0, noise=0.0)
    model = _core.LinearModel(np.array(A), np.array([B]), 1, OFFSET)
    state = model.estimate_initial_state(u[:20], y[:20])
    z = masked(y, "long gaps")
    for horizon in (1, 5):
        np.testing.assert_allclose(model.predict(u, z, state, horizon), y, atol=1e-4)
    np.testing.assert_array_equal(
        model.predict(u, np.full_like(y, np.nan), state, 1), model.simulate(u, state)
    )


# --- through the public interface ---------------------------------------------------------------


def data_of(y: FloatArray, u: FloatArray) -> Dataset:
    return Dataset.from_arrays(u, y, 0.01, name="run")


@pytest.mark.nightly("a fit of every kind", by_day=["arx", "neural_oe"])
@pytest.mark.parametrize("kind", ["arx", "oe", "neural_oe", "auto"])
def test_what_stood_in_a_gap_changes_nothing(kind: Any) -> None:
    """Garbage that is masked gives the same bits as NaN from the beginning."""
    u, y = recording(0)
    where = np.isnan(masked(y, "random")) | np.isnan(masked(y, "long gaps"))
    garbage = np.where(where, 1e9 * np.sin(np.arange(len(y))), y)
    texts = [
        str(identify(data, model=kind, iterations=5, starts=1).parameters())
        for data in (data_of(garbage, u).mask(where), data_of(np.where(where, np.nan, y), u))
    ]
    assert texts[0] == texts[1]


@pytest.mark.nightly("a network for each kind of gap; by day one of given size")
@pytest.mark.parametrize("kind", ["random", "long gaps", "first samples"])
def test_identify_takes_gaps(kind: str) -> None:
    u, y = recording(0)
    z = masked(y, kind)
    model = identify(data_of(z, u), model="auto", iterations=20, starts=1)
    assert model.training["unmeasured"] == np.isnan(z).sum()
    found = model.validate(data_of(z, u))
    assert found.simulation.rmse == pytest.approx(0.01, rel=0.15)
    assert found.n + found.unmeasured + found.experiments[0].init == len(z)
    clean = model.validate(data_of(y, u))
    assert clean.simulation.rmse == pytest.approx(0.01, rel=0.15)
    assert np.isfinite(model.predict(data_of(z, u), 3)[0]).all()


def test_a_gap_in_the_input_names_its_remedies() -> None:
    u, y = recording(0)
    u[400:410] = np.nan
    data = data_of(y, u)
    with pytest.raises(DataError, match=r"sample 400.*split_at_gaps.*fill_inputs\(\"hold\"\)"):
        identify(data)
    held = data.fill_inputs("hold")
    assert "10 missing values of input 'u' in 1 gaps" in str(held)
    assert (held.experiments[0].u[400:410] == u[399]).all()
    assert np.isnan(data.experiments[0].u[400:410]).all()
    assert identify(held, model="arx")
    pieces = data.mask("100:120").split_at_gaps(of="inputs")
    assert [e.range_text for e in pieces.experiments] == ["0:400", "410:1500"]
    assert data.fill_inputs(longest=9).experiments[0].unmeasured == 0
    with refuses(DataError, expected="to hold"):
        data[400:].fill_inputs()
