"""`Validation`: scores by their definitions, what is scored, and what is said beside it."""

import json
from typing import Any

import numpy as np
import pytest

from plants import OFFSET, A, B, linear_data
from refusals import refuses
from sewfast import _core
from sewfast.dataset import Dataset
from sewfast.errors import DataError, SettingError
from sewfast.models import ARX
from sewfast.validation import Scores, validate

TRAINING = {"input_range": [[-5.0, 5.0]]}
MODEL = ARX(
    _core.LinearModel(A, 1.01 * B, 1, OFFSET), 0.01, ("u",), "speed", ("V",), "RPM", None, TRAINING
)


def test_scores_by_hand() -> None:
    s = Scores.of(np.array([0.0, 2.0, 4.0, 2.0]), np.array([0.0, 2.0, 4.0, 0.0]))
    assert s.rmse == pytest.approx(1.0)
    assert s.max_abs == 2.0
    assert s.fit_percent == pytest.approx(100 * (1 - 2 / np.sqrt(8)))


def test_fit_is_undefined_for_a_constant_output() -> None:
    s = Scores.of(np.ones(3), np.zeros(3))
    assert np.isnan(s.fit_percent)
    assert s.to_json() == {"rmse": 1.0, "fit_percent": None, "max_abs": 1.0}


def test_only_samples_after_the_initial_ones_are_scored() -> None:
    data = linear_data(300)
    v = validate(MODEL, data, init=20)
    y, yhat = data.experiments[0].y, MODEL.simulate(data, init=20)[0]
    assert v.n == 280
    assert v.simulation.rmse == pytest.approx(np.sqrt(np.mean((y - yhat)[20:] ** 2)))
    assert v.simulation.max_abs == pytest.approx(np.abs((y - yhat)[20:]).max())
    assert validate(MODEL, data, init=0).n == 300


def test_one_step_and_free_run_stand_apart() -> None:
    v = validate(MODEL, linear_data(300))
    assert 0 < v.one_step.rmse < 0.5 * v.simulation.rmse


def test_experiments_are_pooled() -> None:
    data = Dataset.concat([linear_data(100, name="a"), linear_data(200, seed=3, name="b")])
    v = validate(MODEL, data)
    squares = [e.simulation_scores.rmse**2 * (len(e.y) - 20) for e in v.experiments]
    assert v.n == 260
    assert v.simulation.rmse == pytest.approx(np.sqrt(sum(squares) / 260))
    assert [e["n"] for e in v.to_json()["experiments"]] == [80, 180]
    assert "2, free run" in str(v)


def test_series_are_there_for_plots() -> None:
    data = linear_data(100)
    (e,) = validate(MODEL, data).experiments
    np.testing.assert_array_equal(e.error, data.experiments[0].y - e.simulated)
    np.testing.assert_array_equal(e.one_step_error, data.experiments[0].y - e.one_step)


def test_scores_against_a_channel() -> None:
    data = linear_data(300, noise=0.5)
    measured, true = validate(MODEL, data), validate(MODEL, data, against="truth")
    assert true.simulation.rmse < measured.simulation.rmse
    assert "truth" in str(true)
    with refuses(DataError, expected="a channel 'position'", received="truth"):
        validate(MODEL, data, against="position")


def test_json_holds_what_is_promised() -> None:
    found = json.loads(json.dumps(validate(MODEL, linear_data(100)).to_json(), allow_nan=False))
    for part in ("simulation", "one_step"):
        assert set(found[part]) == {"rmse", "fit_percent", "max_abs"}
    assert (found["n"], found["init"], found["unit"]) == (80, 20, "RPM")


def test_text_names_units_data_and_initial_state() -> None:
    text = str(validate(MODEL, linear_data(100, name="run.csv")))
    for words in ("[RPM]", "run.csv [0:100]", "first 20 samples", "free run", "one step ahead"):
        assert words in text
    assert "from rest" in str(validate(MODEL, linear_data(100), init=0))


def test_inputs_beyond_the_training_data_are_noted() -> None:
    data = linear_data(100)
    assert validate(MODEL, data).notes == ()
    wide = Dataset.from_arrays(2 * data.experiments[0].u, data.experiments[0].y, 0.01)
    (note,) = validate(MODEL, wide).notes
    assert "extrapolates" in note


def test_nothing_to_score_is_refused() -> None:
    with pytest.raises(DataError, match="more than init = 20 samples, received 20"):
        validate(MODEL, linear_data(20))
    data = linear_data(100)
    y = data.experiments[0].y.copy()
    y[50] = np.inf
    with pytest.raises(DataError, match="sample 50"):
        validate(MODEL, Dataset.from_arrays(data.experiments[0].u, y, 0.01))
    y[20:] = np.nan
    with pytest.raises(DataError, match=r"received 20 \(80 more not measured\)"):
        validate(MODEL, Dataset.from_arrays(data.experiments[0].u, y, 0.01))


def test_samples_that_were_not_measured_are_counted_and_not_scored() -> None:
    data = linear_data(200)
    y = data.experiments[0].y.copy()
    y[:5] = y[100:130] = np.nan
    holed = Dataset.from_arrays(data.experiments[0].u, y, 0.01)
    found = validate(MODEL, holed)
    (e,) = found.experiments
    assert (found.n, found.unmeasured, e.init) == (145, 30, 25)
    assert "145 samples scored, 30 not measured" in str(found)
    assert found.to_json()["unmeasured"] == found.to_json()["experiments"][0]["unmeasured"] == 30
    known = ~np.isnan(y)
    known[:25] = False
    rmse = np.sqrt(np.mean((y - e.simulated)[known] ** 2))
    assert found.simulation.rmse == pytest.approx(rmse, rel=1e-12)


@pytest.mark.parametrize("wrong", [None, 3, "m.json"])
def test_what_is_no_model_is_refused_in_words(wrong: Any) -> None:
    data = Dataset.from_arrays(np.arange(30.0), np.arange(30.0), 0.01)
    with pytest.raises(SettingError, match=r"model: expected a model, received .*load_model"):
        validate(wrong, data)
