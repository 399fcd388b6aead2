"""The core's models against references in NumPy, and their fits on made and on measured data."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sewfast import _core
from sewfast.errors import DataError, FitError, SettingError

_GOLDEN = Path(__file__).parents[1] / "golden"


def _load_reference() -> Any:
    spec = importlib.util.spec_from_file_location("neural_oe", _GOLDEN / "neural_oe.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reference = _load_reference()

_DATA = Path(os.environ.get("SEWFAST_DATA", Path(__file__).parents[2] / "../shared/data"))


def _network(case: dict[str, Any]) -> _core.NeuralOE:
    arrays_of = {k: np.asarray(case["settings"][k], float) for k in ("u_mean", "u_scale")}
    return _core.NeuralOE(**{**case["settings"], **arrays_of}, theta=np.asarray(case["theta"]))


def _drive(
    samples: int, seed: int, noise: float = 15.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Voltage (N, 1), true and measured speed [RPM]: current saturates, friction sticks."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / samples
    u = 4 * (0.5 + 0.5 * t) * (1 - np.cos(2 * np.pi * (2 * t + 18 * t * t)))
    u += rng.normal(size=samples // 250 + 1).repeat(250)[:samples]
    speed, torque = np.zeros(samples), 0.0
    for k in range(1, samples):
        wanted = np.clip(u[k - 1] - 0.3 * np.tanh(speed[k - 1] / 60) - speed[k - 1] / 490, -3, 3)
        torque += 0.13 * (wanted - torque)
        speed[k] = speed[k - 1] + 1.95 * torque
    return u[:, None].copy(), speed, speed + noise * rng.normal(size=samples)


def _fit(records: list[Any], validation: list[Any], **changes: Any) -> _core.NeuralFit:
    chosen: dict[str, Any] = {
        "na": 2,
        "nb": 2,
        "nk": 1,
        "hidden": 4,
        "linear": None,
        "u_mean": None,
        "u_scale": None,
        "y_mean": None,
        "y_scale": None,
        "saturate": None,
        "initial_state": "estimated",
        "weight_decay": 1e-8,
        "max_iterations": 30,
        "starts": 2,
        "seed": 1,
        "threads": 1,
    }
    return _core.fit_neural_oe(records, validation, **{**chosen, **changes})


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- the network against its reference ------------------------------------------------------------


@pytest.mark.parametrize("case", json.loads((_GOLDEN / "neural_oe.json").read_text("utf-8")))
def test_network_reproduces_golden_run_and_jacobian(case: dict[str, Any]) -> None:
    run, jacobian = _network(case).jacobian(np.array(case["u"]), np.array(case["y_past"]))
    np.testing.assert_allclose(run, case["run"], rtol=1e-12)
    size = np.abs(case["jacobian"]).max()
    np.testing.assert_allclose(jacobian, case["jacobian"], rtol=1e-10, atol=1e-11 * size)


def test_jacobian_agrees_with_complex_step_on_200_networks() -> None:
    rng = np.random.default_rng(7)
    for _ in range(200):
        case = reference.random_case(rng)
        run, jacobian = _network(case).jacobian(case["u"], case["y_past"])
        expected = reference.jacobian(case["theta"], case["y_past"], case["u"], case["settings"])
        spread = case["settings"]["y_scale"]
        np.testing.assert_allclose(run, expected[0], rtol=0, atol=1e-11 * spread)
        scale = np.abs(expected[1]).max(axis=0) + 1e-300
        assert np.max(np.abs(jacobian - expected[1]) / scale) < 1e-10


def test_prediction_uses_measured_outputs_up_to_its_horizon() -> None:
    case = reference.random_case(np.random.default_rng(3))
    model, u, past = _network(case), case["u"], case["y_past"]
    free = model.simulate(u, past)
    # a free run stays in the data's units, a prediction scales every output
    near = {"rtol": 0, "atol": 1e-13 * case["settings"]["y_scale"]}
    np.testing.assert_allclose(model.predict(u, free, past, 1), free, **near)
    unmeasured = model.predict(u, np.zeros_like(free), past, len(free))
    np.testing.assert_allclose(unmeasured, free, **near)


def test_one_step_prediction_is_one_step_of_a_run_from_measured_outputs() -> None:
    rng = np.random.default_rng(4)
    case = reference.random_case(rng)
    while (case["settings"]["nb"], case["settings"]["nk"]) != (1, 1):
        case = reference.random_case(rng)
    model, u, past = _network(case), case["u"], case["y_past"]
    measured = case["settings"]["y_mean"] + rng.normal(size=len(u))
    one = model.predict(u, measured, past, 1)
    for k in (10, 30, 59):
        state = measured[k - 1 : k - 1 - len(past) : -1].copy()
        # The input before this run is held at its first value, the one that acts on sample k.
        first = model.simulate(u[k - 1 :], state)[0]
        # a run takes the scaling into its weights
        assert abs(one[k] - first) < 1e-13 * case["settings"]["y_scale"]


@pytest.mark.parametrize("kind", ["linear", "network"])
def test_small_signals_follow_the_linearised_step(kind: str) -> None:
    rng = np.random.default_rng(7)
    na, nb, nk, nu = 2, 3, 2, 2
    b = 0.3 * rng.standard_normal((nu, nb))
    model: Any = _core.LinearModel(np.array([-1.2, 0.4]), b, nk, 0.3)
    if kind == "network":
        theta = 0.3 * rng.standard_normal(4 * (na + nu * nb + 2) + 1)
        model = _core.NeuralOE(
            na=na, nb=nb, nk=nk, n_inputs=nu, hidden=4, bypass=False, theta=theta,
            u_mean=np.ones(nu), u_scale=np.array([2.0, 3.0]), y_mean=4.0, y_scale=5.0,
            output_low=None, output_high=None,
        )  # fmt: skip
    u = np.tile([1.0, -2.0], (400, 1))
    rest = np.full(na, model.simulate(u, np.zeros(na))[-1])
    A, B, C, D = model.linearise(u[0], np.concatenate([rest, np.repeat(u[0], nb - 1)]))
    assert (A.shape, B.shape, C.shape, D.shape) == ((6, 6), (6, 2), (1, 6), (1, 2))
    for j in range(nu):
        pulse = np.zeros((60, nu))
        pulse[10, j] = 1e-4
        up, down = (model.simulate(u[:60] + s * pulse, rest) for s in (1.0, -1.0))
        run, x = [], np.zeros(len(A))
        for k in range(60):
            v = pulse[k - nk] if k >= nk else np.zeros(nu)
            run.append(float((C @ x + D @ v)[0]))
            x = A @ x + B @ v
        np.testing.assert_allclose((up - down) / 2, run, atol=1e-9)
    with pytest.raises(DataError, match="2 inputs and 6 states"):
        model.linearise(u[0], rest)


def test_settings_rebuild_the_same_network() -> None:
    case = reference.random_case(np.random.default_rng(5))
    model = _network(case)
    again = _core.NeuralOE(**model.settings, theta=model.theta)  # type: ignore[arg-type]
    assert np.array_equal(
        again.simulate(case["u"], case["y_past"]), model.simulate(case["u"], case["y_past"])
    )


# --- linear models --------------------------------------------------------------------------------


def test_linear_model_equals_its_difference_equation() -> None:
    model = _core.LinearModel(np.array([-1.5, 0.7]), np.array([[0.5, 0.3], [-0.2, 0.1]]), 1, 0.05)
    u = np.random.default_rng(0).normal(size=(50, 2))
    y = model.simulate(u, np.array([0.3, -0.4]))
    for k in range(2, 50):
        inputs = model.b[0] @ u[k - 1 : k - 3 : -1, 0] if k > 2 else model.b[0] @ u[[1, 0], 0]
        inputs += model.b[1] @ (u[k - 1 : k - 3 : -1, 1] if k > 2 else u[[1, 0], 1])
        assert y[k] == pytest.approx(1.5 * y[k - 1] - 0.7 * y[k - 2] + inputs + 0.05, rel=1e-12)
    assert model.is_stable
    assert np.hypot(*model.poles().T) == pytest.approx(0.7**0.5)
    assert model.dc_gain() == pytest.approx([4.0, -0.5])


def test_output_error_reaches_the_noise_where_arx_does_not() -> None:
    rng = np.random.default_rng(2)
    truth = _core.LinearModel(
        np.array([-1.86963746, 0.87013806]), np.array([[0.1255, 0.1198]]), 1, 0.0
    )
    t = np.arange(20_000) * 1e-3
    u = 3 * (1 - np.cos(2 * np.pi * (0.1 * t + 0.0725 * t * t)))[:, None]
    clean = truth.simulate(u, np.zeros(2))
    y = clean + 15 * rng.normal(size=len(t))
    arx = _core.fit_arx([(u, y)], na=2, nb=2, nk=1, offset=True)
    fit = _core.fit_oe([(u, y)], na=2, nb=2, nk=1)
    assert _rms(fit.model.simulate(u, fit.initial_states[0]) - clean) < 1.0
    assert arx.a[0] > -1.0
    assert np.sqrt(2 * fit.cost) == pytest.approx(15, rel=0.02)
    assert np.all(np.diff(fit.trace) < 0)
    assert fit.model.is_stable


def test_a_state_estimated_from_the_first_samples_continues_the_run() -> None:
    model = _core.LinearModel(np.array([-1.7, 0.72]), np.array([[0.05, 0.03]]), 1, 0.2)
    u = np.random.default_rng(1).normal(size=(200, 1))
    y = model.simulate(u, np.array([6.0, 5.0]))
    state = model.estimate_initial_state(u[:20], y[:20])
    assert _rms(model.simulate(u, state) - y) < 1e-4


@settings(max_examples=60, deadline=None)
@given(
    u=arrays(float, st.tuples(st.integers(0, 8), st.integers(1, 3))),
    y=arrays(float, st.integers(0, 8)),
    na=st.integers(0, 3),
    nb=st.integers(0, 3),
    nk=st.integers(0, 3),
)
def test_hostile_data_is_refused_or_fitted_never_worse(
    u: np.ndarray, y: np.ndarray, na: int, nb: int, nk: int
) -> None:
    for fit in (_core.fit_arx, _core.fit_iv, _core.fit_oe):
        with contextlib.suppress(DataError, SettingError, FitError):
            result = fit([(u, y)], na=na, nb=nb, nk=nk, offset=True)
            model = getattr(result, "model", result)
            assert np.all(np.isfinite(model.a))
            assert np.all(np.isfinite(model.b))


# --- training -------------------------------------------------------------------------------------


def test_training_beats_the_linear_model_where_the_drive_saturates() -> None:
    u, _, y = _drive(4000, 1)
    v, clean, z = _drive(4000, 2)
    linear = _core.fit_oe([(u, y)], na=2, nb=2, nk=1)
    fit = _fit([(u, y)], [(v, z)], linear=linear.model, hidden=6, max_iterations=60)
    worst = _rms(linear.model.simulate(v, np.zeros(2)) - clean)
    assert _rms(fit.model.simulate(v, np.zeros(2)) - clean) < 0.5 * worst
    assert fit.cost < linear.cost / fit.model.settings["y_scale"] ** 2  # type: ignore[operator]
    assert fit.start_costs[fit.start] == fit.start_costs.min() == fit.validation_cost
    assert np.all(np.diff(fit.trace) < 1e-12)
    assert len(fit.models) == 2


def test_paper_preset_reaches_the_noise_for_four_of_five_seeds() -> None:
    u, clean, y = _drive(6000, 10)
    preset: dict[str, Any] = {
        "hidden": 8, "u_mean": np.zeros(1), "u_scale": np.array([10.0]), "y_mean": 0.0,
        "y_scale": 1000.0, "saturate": 0.2, "initial_state": "measured", "weight_decay": 0.0,
        "max_iterations": 100, "starts": 4, "threads": 0,
    }  # fmt: skip
    floor = 0.5 * _rms((y - clean) / 1000) ** 2
    costs = [_fit([(u, y)], [], seed=seed, **preset).cost for seed in range(5)]
    assert sum(cost < 1.8 * floor for cost in costs) >= 4, np.array(costs) / floor


def test_training_starts_exactly_at_the_linear_model() -> None:
    u, _, y = _drive(1500, 3)
    linear = _core.fit_oe([(u, y)], na=2, nb=2, nk=1)
    fit = _fit([(u, y)], [], linear=linear.model, max_iterations=1, starts=1)
    scale = float(fit.model.settings["y_scale"])  # type: ignore[arg-type]
    assert fit.trace[0] == pytest.approx(linear.cost / scale**2, rel=1e-4)


def test_training_goes_on_from_given_parameters() -> None:
    u, _, y = _drive(800, 9)
    first = _fit([(u, y)], [], starts=1, max_iterations=5, weight_decay=0.0, initial_state="zero")
    theta = first.model.theta
    on = _fit(
        [(u, y)], [], starts=1, weight_decay=0.0, initial_state="zero", initial_theta=theta[None]
    )
    assert on.trace[0] == pytest.approx(first.cost, rel=1e-12)
    assert on.cost < first.cost
    assert on.trials >= len(on.trace) - 1 > 0


@pytest.mark.parametrize("initial_state", ["zero", "measured", "estimated"])
def test_a_seed_gives_the_same_bits_at_any_number_of_threads(initial_state: str) -> None:
    u, _, y = _drive(800, 4)
    fits = [
        _fit(
            [(u, y), (u[:300], y[:300])],
            [],
            starts=5,
            threads=threads,
            max_iterations=8,
            initial_state=initial_state,
        )
        for threads in (1, 2, 5)
    ]
    for fit in fits[1:]:
        assert fit.model.theta.tobytes() == fits[0].model.theta.tobytes()
        assert fit.start_costs.tobytes() == fits[0].start_costs.tobytes()
    other = _fit([(u, y), (u[:300], y[:300])], [], starts=5, max_iterations=8, seed=2)
    assert other.model.theta.tobytes() != fits[0].model.theta.tobytes()


def test_reported_cost_is_the_free_run_of_the_model() -> None:
    u, _, y = _drive(1000, 5)
    fit = _fit([(u, y)], [], weight_decay=1e-4, saturate=0.2)
    error = (fit.model.simulate(u, fit.initial_states[0]) - y) / fit.model.settings["y_scale"]
    assert fit.cost == pytest.approx(0.5 * np.mean(error**2), rel=1e-9)
    width = np.ptp(y) / fit.model.settings["y_scale"]  # type: ignore[operator]
    low, high = (fit.model.settings[name] for name in ("output_low", "output_high"))
    assert high - low == pytest.approx(1.2 * width)  # type: ignore[operator]


def test_two_inputs_and_long_delays_are_learnt() -> None:
    rng = np.random.default_rng(6)
    u = rng.normal(size=(1500, 2))
    y = np.zeros(1500)
    for k in range(3, 1500):
        y[k] = 0.8 * y[k - 1] + np.tanh(u[k - 3, 0]) + 0.3 * u[k - 3, 1] ** 2
    fit = _fit([(u, y)], [], na=1, nb=1, nk=3, hidden=8, max_iterations=150, starts=4)
    run = fit.model.simulate(u, fit.initial_states[0])
    assert _rms(run - y) < 0.05 * np.std(y)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"hidden": 0}, "hidden units"),
        ({"starts": 0}, "starts"),
        ({"initial_state": "guessed"}, "zero, measured or estimated"),
        ({"weight_decay": -1.0}, "weight decay"),
        ({"saturate": float("nan")}, "saturate"),
        ({"u_mean": np.zeros(1)}, "leave all out"),
        (
            {"u_mean": np.zeros(2), "u_scale": np.ones(2), "y_mean": 0.0, "y_scale": 1.0},
            "per input",
        ),
        ({"na": 3, "linear": "second order"}, "same na"),
        ({"initial_theta": np.zeros((1, 3)), "starts": 1}, "25 finite numbers"),
        ({"initial_theta": np.full((1, 25), np.nan), "starts": 1}, "0 are finite"),
        (
            {"initial_theta": np.zeros((1, 25)), "starts": 2},
            "expected an initial_theta of 2 starts",
        ),
    ],
)
def test_wrong_settings_are_refused_with_a_remedy(changes: dict[str, Any], words: str) -> None:
    u, _, y = _drive(300, 7)
    if "linear" in changes:
        changes = {**changes, "linear": _core.fit_arx([(u, y)], na=2, nb=2, nk=1, offset=True)}
    with pytest.raises(SettingError, match=words):
        _fit([(u, y)], [], **changes)


def test_unusable_records_are_refused() -> None:
    u, _, y = _drive(300, 8)
    with pytest.raises(DataError, match="to change"):
        _fit([(np.ones_like(u), y)], [])
    with pytest.raises(DataError, match="more than"):
        _fit([(u[:20], y[:20])], [])
    with pytest.raises(DataError, match="finite"):
        _fit([(u, np.where(np.arange(300) == 7, np.inf, y))], [])
    with pytest.raises(DataError, match="inputs in every experiment"):
        _fit([(u, y)], [(np.hstack([u, u]), y)])


def test_progress_is_reported_and_its_exceptions_come_through() -> None:
    u, _, y = _drive(3000, 9)
    seen: list[tuple[int, int, float]] = []
    _fit([(u, y)], [], starts=4, hidden=8, progress=lambda *state: seen.append(state))
    assert seen
    assert seen[-1][1] == 120
    assert all(done <= 120 for done, _, _ in seen)

    def fails(*_: object) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _fit([(u, y)], [], starts=8, hidden=8, max_iterations=200, progress=fails)


# --- measured data --------------------------------------------------------------------------------


@pytest.mark.skipif(not _DATA.is_dir(), reason="SEWFAST_DATA names no folder of public recordings")
@pytest.mark.parametrize(
    ("file", "na", "least"),
    [("dc_motor_un/prbs_open_exp.csv", 2, 77.0), ("bldc_cigan/bldc.csv", 1, 92.0)],
)
def test_output_error_fits_measured_drives_in_free_run(file: str, na: int, least: float) -> None:
    table = np.genfromtxt(_DATA / file, delimiter=",", names=True)
    u, y, cut = table["u"][:, None].copy(), table["y"].copy(), int(0.6 * len(table))
    model = _core.fit_oe([(u[:cut], y[:cut])], na=na, nb=na, nk=1).model
    u, y = u[cut:].copy(), y[cut:].copy()
    run = model.simulate(u, model.estimate_initial_state(u[:20], y[:20]))[20:]
    fit = 100 * (1 - np.linalg.norm(run - y[20:]) / np.linalg.norm(y[20:] - y[20:].mean()))
    assert fit > least
