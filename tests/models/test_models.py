"""Models: simulation, prediction, and files that reproduce every bit or are refused by field."""

import copy
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from plants import OFFSET, A, B, bent_data, linear_data
from sewfast import Ensemble, _core
from sewfast.dataset import Dataset
from sewfast.errors import DataError, FitError, ModelFileError, SettingError, SewfastError
from sewfast.identification import identify
from sewfast.models import ARX, IV, LinearOE, Model, NeuralOE, NeuralSS, load_model

NAMES = (0.01, ("u",), "speed", ("V",), "RPM")


def exact(**options: Any) -> ARX:
    return ARX(_core.LinearModel(A, B, 1, OFFSET), *NAMES, **options)


def network(**options: Any) -> NeuralOE:
    theta = np.random.default_rng(0).uniform(-0.5, 0.5, 3 * 4 + 3 + 3 + 1 + 4)
    core = _core.NeuralOE(
        na=2,
        nb=2,
        nk=1,
        n_inputs=1,
        hidden=3,
        bypass=True,
        theta=theta,
        u_mean=np.array([0.1]),
        u_scale=np.array([3.0]),
        y_mean=5.0,
        y_scale=20.0,
        output_low=-3.0,
        output_high=3.0,
    )
    return NeuralOE(core, *NAMES, **options)


def state_space(**options: Any) -> NeuralSS:
    core = _core.NeuralSS(
        nx=2,
        nk=1,
        n_inputs=1,
        n_outputs=1,
        hidden=3,
        integrator=False,
        output="saturation",
        output_parameters=np.array([-3.0, 3.0, 0.1]),
        theta=np.random.default_rng(1).uniform(-0.3, 0.3, 31),
        u_mean=np.array([0.1]),
        u_scale=np.array([3.0]),
        y_mean=np.array([5.0]),
        y_scale=np.array([20.0]),
        state_mean=np.zeros(2),
        state_covariance=np.eye(2),
        residual_variance=np.array([0.01]),
        process_noise=1e-3,
    )
    return NeuralSS(core, *NAMES, **options)


CATALOGUE = {
    "arx": exact,
    "iv": lambda **o: IV(_core.LinearModel(A, B, 1, OFFSET), *NAMES, **o),
    "oe": lambda **o: LinearOE(_core.LinearModel(A, B, 1, OFFSET), *NAMES, **o),
    "neural_oe": network,
    "neural_ss": state_space,
}


@pytest.fixture(params=CATALOGUE)
def model(request: pytest.FixtureRequest) -> Model:
    made: Model = CATALOGUE[request.param](training={"cost": 1 / 3, "notes": ["a note"]})
    return made


# --- simulation and prediction ----------------------------------------------------------------


def test_from_rest_the_true_parameters_give_the_true_output() -> None:
    data = linear_data()
    (yhat,) = exact().simulate(data, init=0)
    np.testing.assert_allclose(yhat, data.experiments[0].y, rtol=0, atol=1e-12)


def test_the_initial_state_is_found_in_the_middle_of_a_recording() -> None:
    data = linear_data()[200:]
    (yhat,) = exact().simulate(data, init=20)
    np.testing.assert_allclose(yhat[20:], data.experiments[0].y[20:], rtol=0, atol=1e-6)


def test_one_list_entry_per_experiment(model: Model) -> None:
    data = Dataset.concat([linear_data(50), linear_data(70)])
    assert [len(y) for y in model.simulate(data)] == [50, 70]
    assert [len(y) for y in model.predict(data)] == [50, 70]


def test_simulation_ignores_outputs_after_the_initial_samples(model: Model) -> None:
    data = linear_data(60)
    y = data.experiments[0].y.copy()
    y[20:] = np.nan
    blind = Dataset.from_arrays(data.experiments[0].u, y, 0.01)
    np.testing.assert_array_equal(model.simulate(blind)[0], model.simulate(data)[0])


def test_simulation_from_rest_needs_no_output(model: Model) -> None:
    data = linear_data(30)
    blind = Dataset.from_arrays(data.experiments[0].u, np.full(30, np.nan), 0.01)
    np.testing.assert_array_equal(model.simulate(blind, init=0)[0], model.simulate(data, init=0)[0])


def test_one_step_prediction_takes_measured_outputs(model: Model) -> None:
    data = linear_data(60)
    far = model.predict(data, 1000, init=5)[0]
    np.testing.assert_allclose(far, model.simulate(data, init=5)[0], rtol=1e-12, atol=1e-12)
    assert not np.allclose(model.predict(data, 1, init=5)[0], far) or isinstance(
        model, (ARX, IV, LinearOE)
    )


def test_what_does_not_fit_the_model_is_refused(model: Model) -> None:
    with pytest.raises(DataError, match=r"expected 1 inputs.*received 2"):
        model.simulate(linear_data(inputs=2))
    slow = Dataset.from_arrays(np.ones(30), np.ones(30), 0.02)
    with pytest.raises(DataError, match=r"Ts = 0\.01 s, received 0\.02"):
        model.simulate(slow)
    metric = Dataset.from_arrays(np.ones(30), np.ones(30), 0.01, output_unit="rad/s")
    with pytest.raises(DataError, match=r"'RPM'.*'rad/s'"):
        model.simulate(metric)
    holes = Dataset.from_arrays([1.0, np.nan] * 20, np.ones(40), 0.01)
    with pytest.raises(DataError, match="sample 1"):
        model.simulate(holes)


def test_the_initial_samples_must_be_there(model: Model) -> None:
    data = linear_data(30)
    with pytest.raises(DataError, match="at least init = 31"):
        model.simulate(data, init=31)
    with pytest.raises(SettingError, match="init"):
        model.simulate(data, init=-1)
    y = data.experiments[0].y.copy()
    y[5:16] = np.nan
    with pytest.raises(DataError, match=r"at least init = 20 samples.*received 19 \(11 more"):
        model.simulate(Dataset.from_arrays(np.ones(30), y, 0.01))
    assert len(model.simulate(Dataset.from_arrays(np.ones(30), y, 0.01), init=19)[0]) == 30
    with pytest.raises(SettingError, match="horizon"):
        model.predict(data, 0)


def test_an_unstable_run_says_so() -> None:
    core = _core.LinearModel(np.array([-3.0]), np.array([[1.0]]), 1, 0.0)
    with pytest.raises(FitError, match="unstable"):
        ARX(core, *NAMES).simulate(linear_data(2000), init=0)


# --- what a model says of itself --------------------------------------------------------------


def test_linear_models_show_poles_gain_and_transfer_function() -> None:
    model = exact()
    np.testing.assert_allclose(model.poles, [0.8, 0.7], atol=1e-12)
    assert model.dc_gain[0] == pytest.approx(0.6 / 0.06)
    assert model.transfer_function() == ("G(z) = (0.4 z^-1 +0.2 z^-2) / (1 -1.5 z^-1 +0.56 z^-2)")
    text = str(model)
    assert "10 RPM/V" in text
    assert "0.8 (44.81 ms)" in text


def test_every_model_names_its_columns_orders_and_notes(model: Model) -> None:
    assert "u [V] -> speed [RPM]" in str(model)
    assert ("nx=2" if isinstance(model, NeuralSS) else "na=2, nb=2") + ", nk=1" in repr(model)
    assert "a note" in str(model)
    assert model.columns == {
        "inputs": ("u",),
        "output": "speed",
        "counts": None,
        "counts_per_rev": None,
    }


# --- files ------------------------------------------------------------------------------------


def test_a_file_reproduces_every_bit(model: Model, tmp_path: Path) -> None:
    model.save(tmp_path / "m.json")
    again = load_model(tmp_path / "m.json")
    assert type(again) is type(model)
    assert again.to_dict() == model.to_dict()
    data = linear_data(100)
    np.testing.assert_array_equal(again.simulate(data)[0], model.simulate(data)[0])
    again.save(tmp_path / "n.json")
    assert (tmp_path / "n.json").read_bytes() == (tmp_path / "m.json").read_bytes()


@pytest.mark.parametrize("kind", ["arx", "oe", "neural_oe"])
def test_an_identified_model_survives_its_file(kind: Any, tmp_path: Path) -> None:
    model = identify(bent_data(), model=kind, iterations=5, starts=2)
    model.save(tmp_path / "m.json")
    assert load_model(tmp_path / "m.json").to_dict() == model.to_dict()


def test_counts_are_remembered(tmp_path: Path) -> None:
    exact(counts=("n", 1572.0)).save(tmp_path / "m.json")
    assert load_model(tmp_path / "m.json").columns["counts_per_rev"] == 1572.0


DAMAGE: list[tuple[str, tuple[str | int, ...], Any, str]] = [
    ("arx", ("kind",), "narx", "one of arx, iv, oe, .*neural_oe, neural_ss"),
    ("arx", ("kind",), None, "'kind'"),
    ("arx", ("version",), 2, "version"),
    ("arx", ("format",), "other", "format"),
    ("arx", ("Ts",), 0.0, "'Ts': expected a positive number"),
    ("arx", ("Ts",), "0.01", "'Ts': expected a number"),
    ("arx", ("Ts",), True, "'Ts': expected a number"),
    ("arx", ("Ts",), 10**400, "beyond the range of float64"),
    ("arx", ("inputs",), [], "at least one input"),
    ("arx", ("inputs",), {"name": "u"}, "'inputs': expected a list"),
    ("arx", ("inputs", 0, "name"), 7, r"'inputs\[0\].name': expected text"),
    ("arx", ("inputs", 0), "u", r"'inputs\[0\]': expected an object"),
    ("arx", ("output", "unit"), None, "'output.unit': expected text"),
    ("arx", ("counts",), {"column": "n", "counts_per_rev": -1}, "counts_per_rev"),
    ("arx", ("parameters", "a"), [], "parameters"),
    ("arx", ("parameters", "a"), [1.0, "2"], "'parameters.a': expected a number"),
    ("arx", ("parameters", "a"), 1.0, "'parameters.a': expected a list"),
    ("arx", ("parameters", "b"), [1.0], "'parameters.b': expected rows"),
    ("arx", ("parameters", "b"), [[1.0], [1.0, 2.0]], "'parameters.b': expected rows"),
    ("arx", ("parameters", "b"), [[1.0], [1.0]], "expected 2 inputs"),
    ("arx", ("parameters", "nk"), -1, "'parameters.nk'"),
    ("arx", ("parameters", "nk"), 1.0, "'parameters.nk': expected a whole number"),
    ("arx", ("training",), [], "'training': expected an object"),
    ("arx", ("surprise",), 1, "'surprise'"),
    ("neural_oe", ("parameters", "theta"), [0.0], "parameters"),
    ("neural_oe", ("parameters", "hidden"), 999_999, "parameters"),
    ("neural_oe", ("parameters", "u_scale"), [0.0], "parameters"),
    ("neural_oe", ("parameters", "u_scale"), [1.0, 1.0], "parameters"),
    ("neural_oe", ("parameters", "y_scale"), None, "'parameters.y_scale': expected a number"),
    ("neural_oe", ("parameters", "bypass"), 1, "'parameters.bypass': expected true or false"),
    ("neural_oe", ("parameters", "output_low"), 9.0, "parameters"),
    ("neural_oe", ("parameters", "n_inputs"), 2, "parameters|inputs"),
    ("neural_ss", ("parameters", "theta"), [0.0], "parameters"),
    ("neural_ss", ("parameters", "hidden"), 999_999, "parameters"),
    ("neural_ss", ("parameters", "nx"), 0, "parameters"),
    ("neural_ss", ("parameters", "n_outputs"), 2, "'parameters.n_outputs': expected 1"),
    ("neural_ss", ("parameters", "output"), "relu", "'parameters.output': expected one of"),
    ("neural_ss", ("parameters", "output_parameters"), [1.0, 0.0, 0.1], "parameters"),
    ("neural_ss", ("parameters", "integrator"), True, "integrator"),
    ("neural_ss", ("parameters", "integrator"), 1, "'parameters.integrator': expected true"),
    ("neural_ss", ("parameters", "state_covariance"), [[1.0, 0.0]], "parameters"),
    ("neural_ss", ("parameters", "state_covariance"), [[-1.0, 0.0], [0.0, 1.0]], "parameters"),
    ("neural_ss", ("parameters", "residual_variance"), [0.0], "parameters"),
    ("neural_ss", ("parameters", "process_noise"), -1.0, "parameters"),
    ("neural_ss", ("parameters", "y_mean"), 5.0, "'parameters.y_mean': expected a list"),
]


@pytest.mark.parametrize(("kind", "path", "value", "words"), DAMAGE)
def test_a_damaged_file_is_refused_by_field(
    tmp_path: Path, kind: str, path: tuple[str | int, ...], value: Any, words: str
) -> None:
    file = tmp_path / "m.json"
    CATALOGUE[kind]().save(file)
    document = json.loads(file.read_text())
    place: Any = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    file.write_text(json.dumps(document))
    with pytest.raises(ModelFileError, match=words) as caught:
        load_model(file)
    assert "m.json" in str(caught.value)


@pytest.mark.parametrize("kind", CATALOGUE)
def test_a_missing_field_is_named(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "m.json"
    CATALOGUE[kind]().save(file)
    whole = json.loads(file.read_text())
    for place in ("", "parameters"):
        for name in whole[place] if place else whole:
            document = copy.deepcopy(whole)
            del (document[place] if place else document)[name]
            file.write_text(json.dumps(document))
            with pytest.raises(ModelFileError, match=name):
                load_model(file)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_cut_or_changed_byte_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    file = tmp_path / "m.json"
    network().save(file)
    raw = bytearray(file.read_bytes())
    at = data.draw(st.integers(0, len(raw) - 1))
    raw[at] = data.draw(st.integers(0, 255))
    file.write_bytes(raw[: data.draw(st.integers(1, len(raw)))])
    try:
        model = load_model(file)
    except ModelFileError as e:
        assert "m.json" in str(e)  # noqa: PT017
    else:
        try:
            model.simulate(linear_data(30), init=0)
        except SewfastError as e:
            assert str(e)  # noqa: PT017


def test_values_that_are_not_finite_are_never_written(tmp_path: Path) -> None:
    with pytest.raises(ModelFileError, match=r"m.json"):
        exact(training={"cost": float("nan")}).save(tmp_path / "m.json")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("made", [exact, network])
def test_models_can_be_copied_and_sent_to_other_processes(made: Any) -> None:
    model = made(training={"samples": 3}, counts=("counts", 1572.0))
    data = linear_data()
    for twin in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model), copy.copy(model)):
        assert type(twin) is type(model)
        assert twin.to_dict() == model.to_dict()
        assert np.array_equal(twin.simulate(data)[0], model.simulate(data)[0])


@pytest.mark.parametrize("wrong", [None, "data.csv", np.ones((50, 1))])
def test_what_is_no_data_set_is_refused_with_the_way_to_make_one(wrong: Any) -> None:
    uses = [exact().predict, exact().validate, identify]
    # a free run takes an array of inputs, too
    uses += [] if isinstance(wrong, np.ndarray) else [exact().simulate]
    for use in uses:
        with pytest.raises(DataError, match=r"expected a Dataset.*from_arrays"):
            use(wrong)


@pytest.mark.parametrize("wrong", [None, "data.csv"])
def test_a_free_run_says_that_it_takes_an_array_as_well(wrong: Any) -> None:
    with pytest.raises(DataError, match=r"a Dataset, or an array of inputs of shape \(N,\)"):
        exact().simulate(wrong)


@pytest.mark.parametrize("wrong", [np.ones(5) + 1j, ["a"] * 5, [[1.0], 2.0]])
def test_what_is_no_real_number_is_refused_by_name(wrong: Any) -> None:
    model = exact()
    uses = {
        "u": [model.linearise, model.simulate],
        "initial_state": [lambda x: model.simulate(np.ones(5), initial_state=x)],
    }
    for name, those in uses.items():
        for use in those:
            with pytest.raises(DataError) as refused:
                use(wrong)
            assert refused.value.name == name


@pytest.mark.parametrize("init", [2.5, -1, True, "20", None])
def test_an_init_that_is_no_count_is_refused(init: Any) -> None:
    for use in (exact().simulate, exact().validate):
        with pytest.raises(SettingError, match="init: expected a whole number"):
            use(linear_data(), init=init)


# --- Runs on arrays, derivatives, an operating point, equality ------------------------------------


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
