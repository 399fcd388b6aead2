"""What research asks of a model: runs on arrays, derivatives, an operating point, equality."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from plants import bent_data, linear_data
from sewfast import Ensemble, Model, identify, load_model
from sewfast.errors import DataError, SettingError

KINDS: dict[str, dict[str, Any]] = {
    "arx": {},
    "oe": {},
    "neural_oe": {"starts": 1, "iterations": 15, "hidden": 4},
    "neural_ss": {"nx": 1, "nk": 1, "hidden": 4, "starts": 1, "iterations": 15},
}


def model_of(kind: Any) -> Model:
    found = identify(bent_data(600, noise=0.05), model=kind, **KINDS[kind])
    return found.members[0] if found.members else found


@pytest.mark.parametrize("kind", KINDS)
def test_an_array_runs_as_a_data_set_does_from_rest(kind: str) -> None:
    model, data = model_of(kind), bent_data(300, seed=3)
    (e,) = data.experiments
    run = model.simulate(e.u[:, 0])
    np.testing.assert_array_equal(run, model.simulate(data, init=0)[0])
    np.testing.assert_array_equal(run, model.simulate(e.u))
    with pytest.raises(DataError):
        model.simulate(np.ones((30, 2)))
    with pytest.raises(SettingError, match="initial_state"):
        model.simulate(data, initial_state=np.zeros(2))  # type: ignore[call-overload]


@pytest.mark.parametrize("kind", KINDS)
def test_the_jacobian_is_that_of_finite_differences_by_the_state(kind: str) -> None:
    model, u = model_of(kind), bent_data(120, seed=4).experiments[0].u
    rest = model.core.rest_state()
    found = model.jacobian(u, initial_state=rest)
    np.testing.assert_allclose(found.y, model.simulate(u, initial_state=rest), rtol=1e-9)
    assert found.theta.shape == (120, len(model.parameter_names))
    assert found.state.shape == (120, len(model.state_names))
    for i in range(len(rest)):
        step = np.zeros(len(rest))
        step[i] = 1e-5
        runs = [model.simulate(u, initial_state=rest + sign * step) for sign in (1.0, -1.0)]
        slope = (runs[0] - runs[1]) / 2e-5
        np.testing.assert_allclose(found.state[:, i], slope, atol=1e-5, rtol=1e-4)


def test_an_operating_point_has_the_gain_of_small_steps() -> None:
    model = model_of("neural_ss")
    point = model.linearise(1.0)
    low, high = (model.simulate(np.full(3000, 1.0 + d))[-1] for d in (-1e-3, 1e-3))
    assert float(point.dc_gain[0]) == pytest.approx((high - low) / 2e-3, rel=1e-3)
    with pytest.raises(SettingError, match="ensemble"):
        Ensemble.of([model, model]).linearise(1.0)


def test_a_model_equals_its_copies_and_no_other(tmp_path: Any) -> None:
    model = identify(linear_data(400, noise=0.1), model="oe")
    model.save(tmp_path / "m.json")
    assert model == load_model(tmp_path / "m.json")
    assert model != identify(linear_data(400, seed=1, noise=0.1), model="oe")
