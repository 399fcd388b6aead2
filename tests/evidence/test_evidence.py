"""The report card and what is behind it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sewfast
from effort import FULL
from plants import bent_data, linear_data, steps
from sewfast import Dataset, Model, _core
from sewfast.errors import DataError, SettingError
from sewfast.evidence import (
    Region,
    Residuals,
    bands,
    check,
    estimate,
    operating_range,
    residual_tests,
    with_training_evidence,
)
from sewfast.evidence.operating import linearise
from sewfast.evidence.parameters import Criteria
from sewfast.models import NeuralOE
from sewfast.models.base import Ensemble
from sewfast.storage import Fields


@cache
def linear_model() -> Model:
    return sewfast.identify(linear_data(1500, noise=0.5), model="oe")


@cache
def network() -> Model:
    return sewfast.identify(bent_data(2000, noise=0.05), model="neural-oe", starts=2)


@pytest.mark.parametrize("weight", [1e-90, 1e-160, 1e-300])
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_hidden_unit_that_is_next_to_nothing_leaves_evidence_in_numbers(
    weight: float, tmp_path: Path
) -> None:
    data = bent_data(400, noise=0.05)
    trained = sewfast.identify(data, model="neural_oe", hidden=3, starts=1, iterations=10)
    theta = trained.theta.copy()
    theta[trained.parameter_names.index("w2[0]")] = weight
    model = NeuralOE.core_from(Fields("model", {**trained.parameters(), "theta": theta.tolist()}))
    model = replace(trained, core=model, training={"input_range": [[-5.0, 5.0]]})
    kept = with_training_evidence(model, data)
    kept.save(tmp_path / "m.json")
    assert np.isfinite(kept.bands(data).upper[0]).all()
    # what the unit does to its own weights is nothing: five directions
    known = estimate(model, Residuals.of(model, data, horizon="free run"))
    assert known is not None
    assert np.isfinite(known.covariance).all()
    assert known.undetermined >= 5


@pytest.mark.parametrize("level", [0.0, 0.49, 1.0, math.nan, "0.9", True])
def test_a_level_that_no_band_has_is_refused(level: Any) -> None:
    for use in (check, bands):
        with pytest.raises(SettingError) as refused:
            use(linear_model(), linear_data(100), level=level)
        assert refused.value.name == "level"


def test_a_good_model_passes_and_the_card_says_so() -> None:
    data = linear_data(1500, seed=11, noise=0.5)
    card = linear_model().check(data)
    assert card.verdict == "ok"
    assert {t.name for t in card.tests} == {
        "autocorrelation", "input", "squared_input", "cubed_input", "output", "squares", "product",
        "feedback",
    }  # fmt: skip
    assert "verdict: ok" in str(card)
    assert json.loads(json.dumps(card.to_json(), allow_nan=False))["verdict"] == "ok"
    assert card.to_html().count("<tr>") == len(card.lines) + 1


def test_a_missing_nonlinearity_is_detected() -> None:
    u = steps(3000, 3)[:, 0]
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.8 * y[k - 1] + u[k - 1] + 0.15 * u[k - 1] ** 2
    y += 0.1 * np.random.default_rng(4).standard_normal(len(u))
    data = Dataset.from_arrays(u, y, 0.01)
    card = sewfast.identify(data, model="oe").check(data)
    found = {t.name: t for t in card.tests}
    assert found["squared_input"].p_value < 1e-6
    assert card.line(found["squared_input"].title).verdict == "fail"
    assert found["squared_input"].explained > 0.3
    assert found["input"].p_value > 1e-6


def test_a_wrong_order_is_detected() -> None:
    data = linear_data(2000, noise=0.2)
    card = sewfast.identify(data, model="oe", na=1, nb=1).check(data)
    found = {t.name: t for t in card.tests}["input"]
    assert not found.passed
    assert card.verdict in ("warn", "fail")


def test_a_plant_that_has_changed_is_detected_and_one_that_has_not_is_not() -> None:
    model, name = linear_model(), "parameters on these data"
    e = linear_data(1500, seed=11, noise=0.5).experiments[0]
    changed = Dataset.from_arrays(e.u, 1.1 * e.y, 0.01, input_units="V", output_unit="RPM")
    assert model.check(changed).line(name).verdict == "fail"
    accused = sum(
        model.check(linear_data(800, seed=s, noise=0.5)).line(name).verdict != "ok"
        for s in range(20, 44)
    )
    # at the 1 % level 4 or more of 24 come once in 10,000 runs
    assert accused < 4


def test_noise_that_grows_with_the_input_is_detected() -> None:
    data = linear_data(2000)
    e = data.experiments[0]
    noise = np.random.default_rng(1).standard_normal(len(e)) * 0.2 * np.abs(e.u[:, 0])
    noisy = Dataset.from_arrays(e.u, e.y + noise, data.Ts)
    model = sewfast.identify(noisy, model="oe")
    found = {t.name: t for t in model.check(noisy).tests}
    assert not found["squares"].passed


def test_bands_hold_what_they_promise_on_new_data() -> None:
    b = network().bands(bent_data(4000, seed=21, noise=0.05))
    # 3,980 nearly independent samples: 4 standard deviations of a share of .95 are 1.4 %; the
    # quantiles come from 2,000 samples, which adds as much again
    assert 0.92 < b.coverage < 0.98
    narrow = network().bands(bent_data(4000, seed=21, noise=0.05), 0.5)
    assert 0.44 < narrow.coverage < 0.56
    assert all((a <= c).all() for a, c in zip(b.lower, narrow.lower, strict=True))


def test_bands_need_a_level_and_a_model_that_knows() -> None:
    data = bent_data(300)
    with pytest.raises(SettingError, match="level"):
        network().bands(data, 1.5)
    with pytest.raises(SettingError, match="identify it again"):
        replace(network(), training={}).bands(data)


def test_an_ensemble_has_a_card_like_any_other() -> None:
    parts = [linear_data(700, seed=s, noise=0.5) for s in (1, 2, 3)]
    members = [sewfast.identify(p, model="oe") for p in parts]
    training = {k: members[0].training[k] for k in ("input_range", "output_range")}
    ensemble = with_training_evidence(
        Ensemble.of(members, training=training), Dataset.concat(parts)
    )
    card = ensemble.check(linear_data(1500, seed=11, noise=0.5))
    assert card.bands is not None
    assert 0.9 < card.bands.coverage < 0.99
    assert card.line("free run").verdict == "ok"
    assert card.operating is not None
    assert len(card.operating.members) == 3
    assert json.dumps(card.to_json(), allow_nan=False)


def test_evidence_survives_the_file(tmp_path) -> None:
    path = tmp_path / "m.json"
    network().save(path)
    again = sewfast.load_model(path)
    data = bent_data(500, seed=4, noise=0.05)
    assert str(again.check(data)) == str(network().check(data))


@pytest.mark.parametrize("value", [None, [], {}, {"mean": "a"}, {"mean": [0], "turn": [[1]]}])
def test_damaged_evidence_is_none(value: object) -> None:
    damaged = {**network().training, "region": value, "uncertainty": value}
    card = replace(network(), training=damaged).check(bent_data(500, noise=0.05))
    assert card.bands is None
    assert not card.distances


def test_the_region_holds_its_own_points_and_not_far_ones() -> None:
    points = np.random.default_rng(0).standard_normal((3000, 3)) @ np.diag([1.0, 1e-3, 100.0])
    region = Region.of(points)
    assert (region.distance(points) <= region.radius).mean() >= 0.995
    again = Region.from_json(json.loads(json.dumps(region.to_json())))
    far = points + np.array([0.0, 0.02, 0.0])
    assert (again.distance(far) > again.radius).mean() > 0.95
    new = np.random.default_rng(1).standard_normal((3000, 3)) @ np.diag([1.0, 1e-3, 100.0])
    assert (again.distance(new) > again.radius).mean() < 0.04


def test_larger_inputs_leave_the_training_region() -> None:
    e = bent_data(1000, seed=5, noise=0.05).experiments[0]
    large = Dataset.from_arrays(3.0 * e.u, e.y, 0.01, input_units="V", output_unit="RPM")
    card = network().check(large)
    assert card.outside > 0.2
    assert card.line("outside training region").verdict == "warn"


def test_operating_points_are_the_equilibria_and_slopes_of_the_simulation() -> None:
    model = network()
    o = operating_range(model)
    for p in o.points:
        still = np.tile(p.u, (3000, 1))
        run = model.core.simulate(still, np.full(2, p.y))
        assert run[-1] == pytest.approx(p.y, abs=1e-6)
        nudged = model.core.simulate(still + 1e-4, np.full(2, p.y))
        assert (nudged[-1] - p.y) / 1e-4 == pytest.approx(p.dc_gain[0], abs=2e-3)
    assert all(p.is_stable and p.settled for p in o.points)
    gains = [p.dc_gain[0] for p in o.points]
    assert max(gains) > 5 * min(gains)
    head, *rows = str(o).splitlines()
    assert head.split()[:3] == ["u", "y", "gain"]
    assert [float(row.split()[2]) for row in rows] == pytest.approx(gains, rel=1e-3)


def test_the_linearised_model_is_the_linear_model() -> None:
    model = linear_model()
    p = operating_range(model).points[4]
    assert p.dc_gain[0] == pytest.approx(model.dc_gain[0])
    np.testing.assert_allclose(np.sort(p.poles), np.sort(model.poles))
    hertz = np.array([0.1, 1.0, 10.0])
    z = np.exp(2j * np.pi * hertz * model.Ts)
    a, b = model.core.a, model.core.b[0]
    exact = (b[0] / z + b[1] / z**2) / (1 + a[0] / z + a[1] / z**2)
    np.testing.assert_allclose(p.response(hertz)[:, 0], exact)
    A, B, C, D = p.delayed()
    found = [(C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D)[0, 0] for s in z]
    np.testing.assert_allclose(found, exact)


def test_operating_points_as_a_control_object() -> None:
    control = pytest.importorskip("control")
    p = operating_range(linear_model()).points[0]
    assert control.dcgain(p.to_control()) == pytest.approx(p.dc_gain[0])


def test_standard_errors_are_the_spread_of_estimates() -> None:
    """Output-error residuals are coloured here: white-noise formulas would be half as large."""
    found, told = [], []
    for seed in range(60 if FULL else 20):
        data = linear_data(1500, seed=1)
        e = data.experiments[0]
        v = np.zeros(len(e))
        w = np.random.default_rng(seed).standard_normal(len(e))
        for k in range(1, len(e)):
            v[k] = 0.9 * v[k - 1] + 0.3 * w[k]
        noisy = Dataset.from_arrays(e.u, e.y + v, data.Ts)
        model = sewfast.identify(noisy, model="oe", na=2, nb=2, nk=1)
        p = estimate(model, Residuals.of(model, noisy))
        assert p is not None
        found.append(p.values)
        told.append(p.standard_errors)
    # of n estimates, a standard deviation is known to 1 / sqrt(2 n): 4 of these
    allowed = 1.0 + 4.0 / np.sqrt(2.0 * len(found))
    ratio = np.mean(told, axis=0) / np.std(found, axis=0)
    assert (ratio > 1.0 / allowed).all()
    assert (ratio < allowed).all()


@pytest.mark.parametrize(
    ("output", "given"), [("linear", []), ("saturation", [-1.5, 1.5, 0.3]), ("abs", [0.1])]
)
def test_state_space_is_linearised_exactly(output: str, given: list[float]) -> None:
    rng = np.random.default_rng(2)
    nx, nu, hidden = 3, 2, 4
    a = 0.9 * np.linalg.qr(rng.standard_normal((nx, nx)))[0]
    sizes = (nx * nu, nx * hidden, hidden * nx, hidden * nu, hidden, nx, nu, 1, hidden)
    theta = np.concatenate([a.ravel(), *(0.3 * rng.standard_normal(n) for n in sizes)])
    core = _core.NeuralSS(
        nx=nx, nk=2, n_inputs=nu, n_outputs=1, hidden=hidden, integrator=False, output=output,
        output_parameters=np.array(given), theta=theta, u_mean=np.array([0.5, 1.0]),
        u_scale=np.array([2.0, 3.0]), y_mean=np.array([0.0 if output == "abs" else 4.0]),
        y_scale=np.array([5.0]), state_mean=np.zeros(nx), state_covariance=np.eye(nx),
        residual_variance=np.ones(1), process_noise=1e-3,
    )  # fmt: skip
    u = np.array([1.0, -2.0])
    small = linearise(core, u)
    assert small.settled
    still = np.tile(u, (600, 1))
    np.testing.assert_allclose(core.simulate(still, small.state), small.y, rtol=1e-6)
    for j in range(nu):
        pulse = np.zeros((600, nu))
        pulse[50, j] = 1e-4
        up, down = (core.simulate(still + s * pulse, small.state) for s in (1.0, -1.0))
        run, x = [], np.zeros(nx)
        for k in range(600):
            v = pulse[k - small.delay] if k >= small.delay else np.zeros(nu)
            run.append(float((small.C @ x + small.D @ v)[0]))
            x = small.A @ x + small.B @ v
        np.testing.assert_allclose((up - down) / 2, run, atol=1e-9)


def test_criteria_by_hand() -> None:
    c = Criteria.of(50.0, 100, 5.0)
    assert c.aic == pytest.approx(100 * math.log(0.5) + 10)
    assert c.aicc == pytest.approx(c.aic + 2 * 5 * 6 / 94)
    assert c.bic == pytest.approx(100 * math.log(0.5) + 5 * math.log(100))
    assert c.fpe == pytest.approx(0.5 * 1.05 / 0.95)
    assert Criteria.of(0.0, 100, 5.0).to_json()["aic"] is None


# --- hostile input ----------------------------------------------------------------------------


def _perfect(n: int = 400) -> Dataset:
    u = steps(n, 9)
    y = linear_model().core.simulate(u, np.zeros(2))
    return Dataset.from_arrays(u, y, 0.01, input_units="V", output_unit="RPM")


def test_a_zero_residual_is_no_failure() -> None:
    card = linear_model().check(_perfect())
    assert card.line("free run").verdict == "ok"
    assert json.dumps(card.to_json(), allow_nan=False)


def test_a_constant_residual_is_an_offset_only() -> None:
    e = _perfect().experiments[0]
    y = e.y + 5.0 + 0.3 * np.random.default_rng(2).standard_normal(len(e))
    shifted = Dataset.from_arrays(e.u, y, 0.01, input_units="V", output_unit="RPM")
    card = linear_model().check(shifted)
    assert card.line("mean residual").verdict == "warn"
    assert card.line("mean residual").value == pytest.approx(5.0, abs=0.5)


def test_a_constant_input_cannot_be_tested_and_says_so() -> None:
    y = 16.0 + np.random.default_rng(0).standard_normal(300)
    still = Dataset.from_arrays(np.zeros(300), y, 0.01, input_units="V", output_unit="RPM")
    card = linear_model().check(still)
    assert card.line("residual with past inputs").shown == "not tested"
    assert card.line("residual with past inputs").verdict == "info"


def test_gaps_are_left_out() -> None:
    e = linear_data(2000, seed=12, noise=0.5).experiments[0]
    y = e.y.copy()
    y[300:420] = np.nan
    y[::17] = np.nan
    y[:20] = e.y[:20]
    card = linear_model().check(
        Dataset.from_arrays(e.u, y, 0.01, input_units="V", output_unit="RPM")
    )
    assert card.verdict == "ok"
    assert set(card.scores.pooled) == {"free run"}
    assert card.bands is not None
    assert card.bands.n == int(np.isfinite(y[20:]).sum())


def test_short_data_are_scored_and_not_tested() -> None:
    card = linear_model().check(linear_data(45, seed=3, noise=0.5))
    assert card.tests == ()
    assert card.line("free run").verdict == "ok"
    with pytest.raises(DataError):
        linear_model().check(linear_data(20, seed=3))


def test_several_experiments_and_inputs() -> None:
    parts = [linear_data(n, seed=n, noise=0.5, inputs=2, name=f"r{n}") for n in (700, 900, 1200)]
    data = Dataset.concat(parts)
    model = sewfast.identify(data, model="oe")
    fresh = [linear_data(n, seed=n + 1, noise=0.5, inputs=2) for n in (400, 800)]
    card = model.check(Dataset.concat(fresh), data)
    assert card.verdict == "ok"
    assert card.line("error over training").value == pytest.approx(1.0, abs=0.15)
    shape = {t.name: t.correlations.shape[0] for t in card.tests}
    assert (shape["input"], shape["squared_input"]) == (2, 3)
    assert card.criteria is not None
    assert card.parameters is not None
    assert card.parameters.names == (
        "a1",
        "a2",
        "b1 of u1",
        "b2 of u1",
        "b1 of u2",
        "b2 of u2",
        "offset",
    )
    assert len(card.bands.lower) == 2


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=60, max_size=120),
    st.sampled_from([0.0, 1e-9, 1.0, 1e9]),
)
def test_any_output_gives_a_card(values: list[float], scale: float) -> None:
    y = scale * np.array(values)
    data = Dataset.from_arrays(steps(len(y), 1), y, 0.01, input_units="V", output_unit="RPM")
    card = linear_model().check(data)
    assert json.dumps(card.to_json(), allow_nan=False)
    assert str(card)


def test_arx_is_judged_by_its_one_step_residual() -> None:
    rng = np.random.default_rng(8)
    u = steps(2000, 8)
    y = np.zeros(2000)
    for k in range(2, 2000):
        y[k] = 1.5 * y[k - 1] - 0.56 * y[k - 2] + 0.4 * u[k - 1, 0] + rng.standard_normal()
    data = Dataset.from_arrays(u, y, 0.01)
    model = sewfast.identify(data, model="arx")
    r = Residuals.of(model, data)
    assert r.horizon == "one step"
    tests = {t.name: t for t in residual_tests(r)}
    assert tests["autocorrelation"].judges
    assert tests["autocorrelation"].passed
    assert tests["input"].passed


def test_check_wants_a_data_set() -> None:
    with pytest.raises(DataError, match="expected a Dataset"):
        check(linear_model(), [1, 2])
    with pytest.raises(DataError, match="expected a Dataset"):
        bands(linear_model(), [1, 2])
