"""Neural state space: exact derivatives, recovery, gaps, states on new data, files, Ctrl-C."""

from __future__ import annotations

import itertools
import os
import pickle
import signal
import threading
import time
from typing import Any

import numpy as np
import pytest

import neural_ss_equations
from effort import FULL
from sewfast import _core
from sewfast.control import paper_controller
from sewfast.dataset import Dataset
from sewfast.errors import DataError, FitError, SettingError
from sewfast.models import NeuralSS

CASES = 10_000 if FULL else 200
NAMES = (0.01, ("u",), "speed", ("V",), "RPM")


def made(case: dict[str, Any]) -> _core.NeuralSS:
    return _core.NeuralSS(theta=case["theta"], **case["settings"])


def fit(experiments: Any, validation: Any = (), **changes: Any) -> _core.NeuralSSFit:
    options: dict[str, Any] = {
        "nx": 2,
        "nk": 1,
        "hidden": 4,
        "linear": None,
        "output": "linear",
        "output_parameters": np.zeros(0),
        "integrator": False,
        "weight_decay": 1e-8,
        "hidden_scale": 1.0,
        "max_iterations": 60,
        "starts": 2,
        "first_start": 0,
        "seed": 0,
        "threads": 1,
    }
    return _core.fit_neural_ss(list(experiments), list(validation), **{**options, **changes})


def bent(samples: int, seed: int, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A second-order drive whose friction grows with its speed, about 40 V and 300 RPM."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2, 2, samples // 10 + 1), 10)[:samples]
    x, y = np.zeros(2), np.empty(samples)
    for k in range(samples):
        y[k] = 300 + 50 * x[0]
        pushed = u[max(k - 1, 0)]
        x = np.array([0.8 * x[0] + 0.3 * x[1], 0.7 * x[1] + 0.3 * pushed - 0.3 * np.tanh(2 * x[0])])
    return 40 + u[:, None], y + noise * rng.normal(size=samples)


def linear_start(u: np.ndarray, y: np.ndarray) -> _core.LinearModel:
    return _core.fit_oe([(u, y)], na=2, nb=2, nk=1).model


def percent(y: np.ndarray, yhat: np.ndarray) -> float:
    return float(100 * (1 - np.linalg.norm(y - yhat) / np.linalg.norm(y - y.mean())))


# --- arithmetic -----------------------------------------------------------------------------------


def test_run_and_derivatives_agree_with_complex_steps() -> None:
    """Relative to the largest derivative by the same parameter; SEWFAST_SOAK takes 10,000."""
    rng = np.random.default_rng(20040)
    worst = 0.0
    for _ in range(CASES):
        case = neural_ss_equations.random_case(rng)
        expected, derivatives = neural_ss_equations.jacobian(
            case["theta"], case["state"], case["u"], case["settings"]
        )
        run, rows = made(case).jacobian(case["u"], case["state"])
        assert np.array_equal(run, made(case).simulate(case["u"], case["state"]))
        rows = rows.reshape(derivatives.shape)
        scale = np.abs(expected - case["settings"]["y_mean"]).max()
        np.testing.assert_allclose(run.reshape(expected.shape), expected, 1e-11, 1e-12 * scale)
        largest = np.abs(derivatives).max(axis=(0, 1))
        error = np.abs(rows - derivatives).max(axis=(0, 1))
        assert not error[largest == 0].any()
        worst = max(worst, float((error[largest > 0] / largest[largest > 0]).max()))
    print(f"{CASES} networks, worst relative error {worst:.2g}")
    assert worst <= 1e-10


def test_runs_rows_and_states_have_their_shapes() -> None:
    case = neural_ss_equations.random_case(np.random.default_rng(1))
    core, u, state = made(case), case["u"], case["state"]
    run, rows = core.jacobian(u, state)
    assert run.shape == (30,)
    assert rows.shape == (30, len(case["theta"]) + core.nx)
    assert core.predict(u, run, state, 2).shape == run.shape
    assert core.states(u, state).shape == (30, core.nx)
    np.testing.assert_array_equal(core.states(u, state)[0], state)
    with pytest.raises(SettingError, match="one output"):
        made({**case, "settings": case["settings"] | {"n_outputs": 2}})


def test_a_clean_record_gives_its_state_back() -> None:
    rng = np.random.default_rng(2)
    for _ in range(60):
        case = neural_ss_equations.random_case(rng, samples=60)
        if case["settings"]["output"] != "linear":
            continue  # a sign that is lost, or a limit, can hide the state
        case["settings"]["residual_variance"][:] = 1e-12
        core = made(case)
        y = core.simulate(case["u"], case["state"])
        found = core.estimate_initial_state(case["u"], y)
        again = core.simulate(case["u"], found)
        scale = np.max(case["settings"]["y_scale"])
        assert np.abs(again - y).max() < 1e-4 * scale


def test_without_outputs_the_state_is_the_prior_and_a_gap_changes_little() -> None:
    case = neural_ss_equations.random_case(np.random.default_rng(3), samples=60)
    case["settings"] |= {"output": "linear", "output_parameters": np.zeros(0)}
    case["settings"]["state_mean"] = np.full(case["settings"]["nx"], 0.25)
    core = made(case)
    y = core.simulate(case["u"], case["state"])
    unknown = core.estimate_initial_state(case["u"], np.full_like(y, np.nan))
    np.testing.assert_allclose(unknown, 0.25, atol=1e-9)
    y[5:10] = np.nan
    found = core.estimate_initial_state(case["u"], y)
    assert np.linalg.norm(found - case["state"]) < np.linalg.norm(unknown - case["state"])


def test_a_record_without_number_is_refused() -> None:
    case = neural_ss_equations.random_case(np.random.default_rng(4))
    core = made(case)
    u = case["u"].copy()
    u[3] = np.nan
    with pytest.raises(DataError, match="finite"):
        core.simulate(u, case["state"])
    with pytest.raises(DataError, match="states"):
        core.simulate(case["u"], np.zeros(9))
    with pytest.raises(SettingError, match="horizon"):
        core.predict(case["u"], core.simulate(case["u"], case["state"]), case["state"], 0)


def test_a_model_that_runs_away_says_so() -> None:
    case = neural_ss_equations.random_case(np.random.default_rng(5), samples=400)
    where, shape = neural_ss_equations.parts(case["settings"])["A"]
    case["theta"][where] = (1e3 * np.eye(shape[0])).ravel()
    with pytest.raises(FitError, match="unstable"):
        made(case).simulate(case["u"], case["state"])


# --- training -------------------------------------------------------------------------------------


def test_the_guard_says_in_words_what_is_wrong_with_a_model() -> None:
    u, y = bent(3_000, 3, 1.0)
    linear = linear_start(u, y)
    found = fit([(u, y)], linear=linear, guard=False)
    assert found.sounds == [True, True]
    good = found.model
    assert _core.guard(good, [(u, y)], linear=[linear]) == ""
    assert _core.guard(linear, [(u, y)]) == ""
    theta = good.theta.copy()
    theta[0] += 1.0  # a pole beyond 1
    wild = _core.NeuralSS(theta=theta, **good.settings)
    assert "runs away" in _core.guard(wild, [(u, y)], linear=[linear])
    slow = _core.LinearModel(np.array([-0.99999]), np.array([[1e-5]]), 1, 300e-5)
    assert _core.guard(slow, [(u, y)]) == "does not forget its initial state"
    assert _core.guard(slow, [(u, y)], linear=[slow]) == ""
    lagged = _core.fit_neural_oe(
        [(u, y)], [], na=2, nb=2, nk=1, hidden=3, linear=linear, u_mean=None, u_scale=None,
        y_mean=None, y_scale=None, saturate=None, initial_state="estimated", weight_decay=1e-8,
        max_iterations=20, starts=1, seed=0, threads=1,
    )  # fmt: skip
    assert lagged.sound
    assert _core.guard(lagged.model, [(u, y)], linear=[linear]) == ""
    with pytest.raises(
        TypeError, match="expected a LinearModel, a NeuralOE or a NeuralSS, got int"
    ):
        _core.guard(3, [(u, y)])  # type: ignore[arg-type]
    with pytest.raises(DataError, match="1 inputs in every experiment"):
        _core.guard(good, [(np.hstack([u, u]), y)])


def test_a_grown_model_is_trained_further() -> None:
    u, y = bent(1_500, 4, 1.0)
    small = fit([(u, y)], nx=1, hidden=2, max_iterations=30)
    larger = small.model.grown(3, 8, 5)
    assert (larger.settings["nx"], larger.settings["hidden"]) == (3, 8)
    state = larger.estimate_initial_state(u[:20], y[:20])
    before = small.model.simulate(u, small.model.estimate_initial_state(u[:20], y[:20]))
    assert np.std(larger.simulate(u, state)[100:] - before[100:]) < 1e-2 * np.std(y)
    trained = fit(
        [(u, y)], nx=3, hidden=8, max_iterations=60, starts=1, initial=[larger], guard=False
    )
    assert trained.cost < 0.5 * small.cost
    with pytest.raises(SettingError, match="at least the 1 states and 2 hidden units"):
        small.model.grown(1, 1, 0)


def test_training_finds_what_a_linear_model_cannot() -> None:
    u, y = bent(2000, 0, noise=0.05)
    other, truth = bent(1000, 1)
    linear = linear_start(u, y)
    found = fit([(u, y)], linear=linear, starts=3)
    assert found.sound
    state = found.model.estimate_initial_state(other[:20], truth[:20])
    free = percent(truth[20:], found.model.simulate(other, state)[20:])
    past = linear.estimate_initial_state(other[:20], truth[:20])
    assert percent(truth[20:], linear.simulate(other, past)[20:]) < 95
    assert free > 99
    one_step = found.model.predict(other, truth, state, 1)
    assert percent(truth[20:], one_step[20:]) > 99


def test_a_linear_start_begins_where_the_linear_model_is() -> None:
    u, y = bent(2000, 2)
    linear = linear_start(u, y)
    found = fit([(u, y)], linear=linear, starts=1, max_iterations=1)
    residual = y - linear.simulate(u, linear.estimate_initial_state(u, y))
    begun = found.trace[0] / (0.5 * np.mean((residual / y.std()) ** 2))
    assert 0.8 < begun < 1.25


@pytest.mark.parametrize("delay", [1, 2])
def test_a_linear_model_with_offset_and_direct_input_is_realised(delay: int) -> None:
    rng = np.random.default_rng(6)
    u = 3 + rng.normal(size=(800, 2))
    linear = _core.LinearModel(
        np.array([-1.5, 0.7]), np.array([[0.5, 0.3, 0.1], [0.2, 0.0, -0.4]]), delay, 2.0
    )
    y = linear.simulate(u, np.array([20.0, 21.0]))
    found = fit([(u, y)], linear=linear, nk=delay, starts=1, max_iterations=1)
    assert found.trace[0] < 1e-3


def test_gaps_have_no_weight() -> None:
    u, y = bent(1500, 3)
    hidden = y.copy()
    hidden[100:200] = np.nan
    hidden[800:900] = np.nan
    found = fit([(u[:500], hidden[:500]), (u[500:], hidden[500:])], hidden=6, nx=3)
    assert found.initial_states.shape == (2, 3)
    run = found.model.simulate(u[:500], found.initial_states[0])
    assert percent(y[:500], run) > 97


def test_validation_data_stop_and_rank_the_starts() -> None:
    u, y = bent(600, 4, noise=2.0)
    other, truth = bent(600, 5, noise=2.0)
    found = fit([(u, y)], [(other, truth)], linear=linear_start(u, y), starts=4, hidden=8)
    assert found.validation_cost == found.start_costs[found.start]
    sound = [c for c, s in zip(found.start_costs, found.sounds, strict=True) if s]
    assert found.validation_cost == min(sound or found.start_costs)
    assert len(found.models) == np.isfinite(found.start_costs).sum()
    chosen = found.start_models[found.start]
    assert chosen is not None
    np.testing.assert_array_equal(chosen.theta, found.model.theta)


def test_threads_and_the_split_of_the_starts_leave_every_bit() -> None:
    u, y = bent(500, 6, noise=1.0)
    options: dict[str, Any] = {"linear": linear_start(u, y), "max_iterations": 15}
    one = fit([(u, y)], [(u, y)], starts=3, threads=1, **options)
    two = fit([(u, y)], [(u, y)], starts=3, threads=2, **options)
    last = fit([(u, y)], [(u, y)], starts=1, first_start=2, **options)
    np.testing.assert_array_equal(one.start_costs, two.start_costs)
    for a, b in zip(one.start_models, two.start_models, strict=True):
        assert a is not None
        assert b is not None
        np.testing.assert_array_equal(a.theta, b.theta)
    assert last.start_costs[0] == one.start_costs[2]
    assert one.model.settings["process_noise"] == two.model.settings["process_noise"]


def test_a_sensor_without_sign_is_seen_through() -> None:
    u, y = bent(2000, 7)
    size = np.abs(y - 300)
    # of the unfolded output: the sign is lost on a linear model
    linear = linear_start(u, y - 300)
    found = fit([(u, size)], linear=linear, output="abs", output_parameters=np.array([0.02]))
    assert found.model.settings["y_mean"] == 0.0
    state = found.initial_states[0]
    assert percent(size, found.model.simulate(u, state)) > 95


def test_a_limit_is_kept() -> None:
    u, y = bent(1500, 8)
    cut = np.clip(y, 270, 330)
    low, high = (270 - cut.mean()) / cut.std(), (330 - cut.mean()) / cut.std()
    found = fit(
        [(u, cut)],
        linear=linear_start(u, cut),
        output="saturation",
        output_parameters=np.array([low, high, 0.02]),
    )
    run = found.model.simulate(u, found.initial_states[0])
    assert run.min() > 269
    assert run.max() < 331
    assert percent(cut, run) > 95


def test_an_integrator_stays_one() -> None:
    rng = np.random.default_rng(9)
    u = rng.normal(size=(1500, 1))
    speed = np.zeros(1500)
    for k in range(1, 1500):
        speed[k] = 0.9 * speed[k - 1] + 0.1 * np.tanh(u[k - 1, 0])
    angle = np.concatenate([[0.0], np.cumsum(speed)[:-1]])
    slow = _core.LinearModel(np.array([-1.899, 0.8991]), np.array([[0.0, 0.1]]), 1, 0.0)
    found = fit([(u, angle)], linear=slow, integrator=True)
    a = found.model.theta[:4].reshape(2, 2)
    assert a[1, 1] == 1.0
    assert a[0, 1] == 0.0
    assert percent(angle, found.model.simulate(u, found.initial_states[0])) > 95


@pytest.mark.nightly("trains six networks")
@pytest.mark.parametrize("hidden", [2, 4])
@pytest.mark.parametrize("friction", [0.15, 0.25, 0.35])
def test_an_integrator_finds_dry_friction(friction: float, hidden: int) -> None:
    """A carriage of 1 kg between places 1 s apart, under a controller of position and speed [mm, N,
    ms]: from smooth random units alone the error is two to three times larger."""
    rng = np.random.default_rng(3)
    stops = rng.uniform(-100, 100, 7)
    ramp = np.clip(np.arange(1000) / 500, 0, 1)
    ramp = 3 * ramp**2 - 2 * ramp**3
    target = np.concatenate([a + (b - a) * ramp for a, b in itertools.pairwise(stops)])
    q, v, u, y = stops[0], 0.0, np.empty(6000), np.empty(6000)
    for k in range(6000):
        y[k] = q
        u[k] = 45 * (0.03 * (target[k] - q) - v)
        free = v + 1e-3 * (u[k] - 2 * v)
        # friction can stop the carriage, not turn it round
        v = np.sign(free) * max(abs(free) - 1e-3 * friction, 0.0)
        q += v
    pair = (u[:, None], y)
    linear = _core.fit_oe([pair], na=2, nb=3, nk=1).model
    found = fit([pair], hidden=hidden, linear=linear, integrator=True, starts=6, max_iterations=100)
    run = found.model.simulate(pair[0], found.initial_states[0])
    assert percent(y, run) > 99.75


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"integrator": True, "linear": "oscillating"}, "slow real pole"),
        ({"nx": 0}, "nx"),
        ({"hidden": 0}, "hidden"),
        ({"starts": 0}, "starts"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"weight_decay": -1.0}, "weight decay"),
        ({"hidden_scale": 0.0}, "hidden scale"),
        ({"output": "relu"}, "output"),
        ({"output": "abs"}, "output"),
        ({"output": "saturation", "output_parameters": np.array([1.0, 0.0, 0.1])}, "low below"),
        ({"nx": 1, "linear": "second order"}, "order 1"),
        ({"nk": 2, "linear": "second order"}, "delay"),
    ],
)
def test_wrong_settings_are_refused_with_a_remedy(changes: dict[str, Any], words: str) -> None:
    u, y = bent(300, 10)
    if "linear" in changes:
        oscillating = _core.LinearModel(np.array([-1.0, 0.5]), np.array([[1.0]]), 1, 0.0)
        start = oscillating if changes["linear"] == "oscillating" else linear_start(u, y)
        changes = {**changes, "linear": start}
    with pytest.raises(SettingError, match=words):
        fit([(u, y)], **changes)


def test_unusable_records_are_refused() -> None:
    u, y = bent(300, 11)
    with pytest.raises(DataError, match="one experiment"):
        fit([])
    with pytest.raises(DataError, match="to change"):
        fit([(np.ones_like(u), y)])
    with pytest.raises(DataError, match="a measured output"):
        fit([(u, np.full(300, np.nan))])
    with pytest.raises(DataError, match="more than"):
        fit([(u[:20], y[:20])])
    with pytest.raises(DataError, match="finite values in u, got NaN at sample 7"):
        fit([(np.where(np.arange(300)[:, None] == 7, np.nan, u), y)])
    with pytest.raises(DataError, match="inf"):
        fit([(u, np.where(np.arange(300) == 7, np.inf, y))])
    with pytest.raises(DataError, match="same number"):
        fit([(u, y[:-1])])
    with pytest.raises(DataError, match="leave that experiment out"):
        fit([(u, y)], [(np.hstack([u, u]), y)])


def test_ctrl_c_keeps_the_best_so_far() -> None:
    u, y = bent(20_000, 12, noise=1.0)
    seen = threading.Event()

    def interrupt() -> None:
        if seen.wait(60):
            os.kill(os.getpid(), signal.SIGINT)

    watcher = threading.Thread(target=interrupt)
    watcher.start()
    began = time.perf_counter()

    def progress(done: int, total: int, cost: float) -> None:
        if done > 3:
            seen.set()

    found = fit(
        [(u, y)],
        linear=linear_start(u, y),
        hidden=30,
        starts=50,
        max_iterations=10_000,
        progress=progress,
    )
    watcher.join()
    assert time.perf_counter() > began
    assert found.termination == "interrupted"
    assert found.cost <= found.trace[0]
    assert len(found.start_models) == 50


# --- the Python model -----------------------------------------------------------------------------


def trained() -> NeuralSS:
    u, y = bent(1200, 13, noise=0.5)
    core = fit([(u, y)], linear=linear_start(u, y), max_iterations=30).model
    return NeuralSS(core, *NAMES)


def test_a_data_set_is_simulated_predicted_and_validated() -> None:
    model = trained()
    u, y = bent(800, 14)
    data = Dataset.from_arrays(
        u, y, 0.01, input_units=("V",), output_name="speed", output_unit="RPM"
    )
    assert percent(y[20:], model.simulate(data)[0][20:]) > 97
    assert percent(y[20:], model.predict(data)[0][20:]) > 97
    assert model.validate(data).simulation.fit_percent > 97
    assert model.states(data)[0].shape == (800, 2)
    assert "2 states, 4 tanh" in str(model)
    assert "nx=2, nk=1, hidden=4" in repr(model)


def test_a_twin_has_every_bit() -> None:
    model = trained()
    twin = pickle.loads(pickle.dumps(model))
    assert twin.to_dict() == model.to_dict()
    u, _ = bent(200, 15)
    rest = model.core.rest_state()
    np.testing.assert_array_equal(twin.core.rest_state(), rest)
    np.testing.assert_array_equal(twin.core.simulate(u, rest), model.core.simulate(u, rest))


def test_a_loop_is_closed_around_it() -> None:
    case = neural_ss_equations.random_case(np.random.default_rng(16))
    while case["settings"]["n_inputs"] != 1:
        case = neural_ss_equations.random_case(
            np.random.default_rng(int(1e6 * case["theta"][0] ** 2))
        )
    case["settings"]["nk"] = 1
    core = made(case)
    controller = paper_controller().core()
    run = _core.closed_loop(core, controller, np.linspace(0, 10, 300), counts_per_unit=0.0)
    # before the first sample the plant has seen inputs of zero
    case["settings"]["nk"] = 0
    u = np.concatenate([[0.0], run["u"][:-1]])[:, None]
    np.testing.assert_allclose(made(case).simulate(u, core.rest_state()), run["y"], rtol=1e-9)
    with pytest.raises(SettingError, match="nk"):
        _core.closed_loop(made(case), controller, np.ones(10), counts_per_unit=0.0)
