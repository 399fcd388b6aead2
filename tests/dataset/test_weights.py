"""Weights of samples: what they change in fits and scores, where they go along, what is none."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cli
import sewfast
from sewfast import Dataset, Experiment, _core, identify
from sewfast.errors import DataError, SettingError
from sewfast.identification.folds import errors_of, later_part

A, B, OFFSET = (-1.6, 0.66), (0.05, 0.03), 0.1
N, BAD = 1500, slice(700, 900)
NETWORK: dict[str, Any] = {
    "nk": 1,
    "hidden": 4,
    "weight_decay": 1e-4,
    "max_iterations": 15,
    "starts": 1,
    "seed": 1,
    "threads": 1,
}
LAGGED: dict[str, Any] = NETWORK | {
    "na": 2,
    "nb": 2,
    "u_mean": None,
    "u_scale": None,
    "y_mean": None,
    "y_scale": None,
    "saturate": None,
    "initial_state": "estimated",
}
STATES: dict[str, Any] = NETWORK | {
    "nx": 2,
    "output": "linear",
    "output_parameters": np.zeros(0),
    "integrator": False,
    "hidden_scale": 1.0,
    "first_start": 0,
}


def recording(seed: int = 0, noise: float = 0.01) -> tuple[Any, Any]:
    """Steps of random height through the system above."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.standard_normal((N // 5, 1)), 5, 0)
    truth = _core.LinearModel(np.array(A), np.array([B]), 1, OFFSET)
    return u, truth.simulate(u, np.array([3.0, 2.0])) + noise * random.standard_normal(N)


def spoilt(y: Any) -> Any:
    """The output with a stretch in which the sensor said nonsense."""
    y = y.copy()
    y[BAD] += 5.0 * np.random.default_rng(5).standard_normal(BAD.stop - BAD.start)
    return y


def weights(inside: float, outside: float = 1.0) -> Any:
    w = np.full(N, outside)
    w[BAD] = inside
    return w


def dataset(u: Any, y: Any, w: Any = None) -> Dataset:
    return Dataset.from_arrays(u, y, 0.01, weights=w)


def told(model: Any) -> dict[str, Any]:
    """All that a model says of its training, but for the time that it took."""
    return {k: v for k, v in model.training.items() if k != "seconds"}


# --- what is fitted -------------------------------------------------------------------------------


def test_weight_0_on_nonsense_gives_the_parameters_of_the_clean_record() -> None:
    u, y = recording(noise=0.0)
    found = identify(dataset(u, spoilt(y), weights(0.0)), model="arx")
    np.testing.assert_allclose(found.core.a, A, atol=1e-8)
    np.testing.assert_allclose(found.core.b[0], B, atol=1e-8)
    assert abs(identify(dataset(u, spoilt(y)), model="arx").core.a[0] - A[0]) > 0.1
    u, y = recording()
    clean = identify(dataset(u, y), model="oe")
    found = identify(dataset(u, spoilt(y), weights(0.0)), model="oe")
    # 200 of 1,500 samples fewer: within a few standard errors of the clean record's parameters
    errors = np.array(clean.training["standard_errors"]["a"])
    assert (np.abs(found.core.a - clean.core.a) < 3.0 * errors).all()
    assert found.training["cost"] == pytest.approx(clean.training["cost"], rel=0.1)
    assert identify(dataset(u, spoilt(y)), model="oe").training["cost"] > 100 * 0.01**2


@pytest.mark.parametrize("kind", ["lagged", "state space"])
def test_weight_0_gives_networks_that_know_nothing_of_the_nonsense(kind: str) -> None:
    u, y = recording()
    y = np.minimum(y, 0.6) + 0.2 * np.maximum(y - 0.6, 0.0)
    linear = _core.fit_oe([(u, y)], na=2, nb=2, nk=1).model
    # the core takes means and ranges, too, from what was measured
    unseen = spoilt(y)
    unseen[BAD] = np.nan

    def fitted(*experiment: Any) -> Any:
        if kind == "lagged":
            return _core.fit_neural_oe([experiment], [], linear=linear, **LAGGED)
        return _core.fit_neural_ss([experiment], [], linear=linear, **STATES)

    def rmse(fit: Any) -> float:
        run = fit.model.simulate(u, fit.model.estimate_initial_state(u[:20], y[:20]))
        return float(np.sqrt(np.mean((run - y)[20:] ** 2)))

    clean, found, misled = fitted(u, y), fitted(u, unseen, weights(0.0)), fitted(u, spoilt(y))
    assert rmse(found) < 1.2 * rmse(clean) < 0.06 < 0.5 * rmse(misled)
    # a weight of 0 is no measurement, but for rounding
    np.testing.assert_allclose(found.cost, fitted(u, unseen).cost, rtol=1e-9)
    zero = fitted(u, y, weights(0.0)).model
    run = zero.simulate(u, zero.estimate_initial_state(u[:20], y[:20]))
    assert np.sqrt(np.mean((run - y)[20:] ** 2)) < 1.2 * rmse(clean)


@pytest.mark.parametrize("kind", ["arx", "oe", "neural_oe"])
def test_weight_0_is_not_measured_and_equal_weights_are_none(kind: Any) -> None:
    u, y = recording()

    def found(data: Dataset) -> Any:
        return identify(data, model=kind, starts=1 if kind == "neural_oe" else None, threads=1)

    plain = found(dataset(u, y))
    for value in (1.0, 2.0, 1e-200):
        other = found(dataset(u, y, np.full(N, value)))
        np.testing.assert_array_equal(other.theta, plain.theta)
        assert told(other) == told(plain)
    masked = found(dataset(u, spoilt(y)).mask(f"{BAD.start}:{BAD.stop}"))
    weighed = found(dataset(u, spoilt(y), weights(0.0, 3.0)))
    np.testing.assert_array_equal(weighed.theta, masked.theta)
    assert weighed.training["cost"] == masked.training["cost"]
    assert "200 outputs of weight 0" in weighed.training["preparation"][0]


def test_the_cost_is_the_weighted_mean_and_only_ratios_count() -> None:
    u, y = recording()
    noisy = y + weights(1.0, 0.0) * np.random.default_rng(3).standard_normal(N)
    w = weights(1e-4)
    fit = _core.fit_oe([(u, noisy, w)], na=2, nb=2, nk=1)
    run = fit.model.simulate(u, np.ascontiguousarray(fit.initial_states[0]))
    assert fit.cost == pytest.approx(np.sum(w * (noisy - run) ** 2) / w.sum() / 2, rel=1e-9)
    # weights that are inverse variances: errors of the parameters fall to those of the good part
    plain = _core.fit_oe([(u, noisy)], na=2, nb=2, nk=1)
    assert fit.standard_errors[0] < 0.1 * plain.standard_errors[0]
    assert abs(fit.model.a[0] - A[0]) < 5.0 * fit.standard_errors[0]
    again = _core.fit_oe([(u, noisy, 7.0 * w)], na=2, nb=2, nk=1)
    np.testing.assert_allclose(again.model.a, fit.model.a, rtol=1e-6)
    np.testing.assert_allclose(again.standard_errors, fit.standard_errors, rtol=1e-4)
    linear = fit.model
    lagged = _core.fit_neural_oe([(u, noisy, w)], [(u, noisy, w)], linear=linear, **LAGGED)
    run = lagged.model.simulate(u, np.ascontiguousarray(lagged.initial_states[0]))
    scale = lagged.model.settings["y_scale"]
    expected = np.sum(w * (noisy - run) ** 2) / w.sum() / 2 / scale**2
    assert lagged.cost == pytest.approx(expected, rel=1e-6)
    states = _core.fit_neural_ss([(u, noisy, w)], [(u, noisy, w)], linear=linear, **STATES)
    run = states.model.simulate(u, np.ascontiguousarray(states.initial_states[0]))
    scale = states.model.settings["y_scale"][0]
    expected = np.sum(w * (noisy - run) ** 2) / w.sum() / 2 / scale**2
    assert states.cost == pytest.approx(expected, rel=1e-6)
    assert states.model.settings["residual_variance"][0] == pytest.approx(2 * states.cost, rel=1e-6)
    for network in (lagged, states):
        # what is held out is scored by its weights as well
        assert network.validation_cost == pytest.approx(network.cost, rel=0.2)


def test_whole_weights_are_repetitions() -> None:
    (u, y), (u2, y2) = recording(0, 0.1), recording(1, 0.1)
    twice = [dataset(u, y), dataset(u, y), dataset(u2, y2)]
    weighed = [dataset(u, y, np.full(N, 2.0)), dataset(u2, y2)]
    one, other = (identify(Dataset.concat(d), model="arx") for d in (twice, weighed))
    np.testing.assert_allclose(other.theta, one.theta, rtol=1e-10)
    assert other.training["cost"] == pytest.approx(one.training["cost"], rel=1e-10)


def test_instrumental_variables_take_masks_and_no_weights() -> None:
    u, y = recording()
    with pytest.raises(SettingError, match=r"weights: expected none for instrumental"):
        identify(dataset(u, y, weights(0.5)), model="iv")
    found = identify(dataset(u, spoilt(y), weights(0.0)), model="iv")
    np.testing.assert_allclose(found.core.a, A, atol=0.01)


@pytest.mark.nightly("a default search")
def test_the_search_for_a_structure_is_weighted_throughout() -> None:
    u, y = recording()
    w = weights(1e-3)
    w[300:400] = 0.0
    z = spoilt(y)
    z[300:400] += 50.0  # still moving, so that it is no dead sensor that `identify` leaves out

    def rmse(data: Dataset) -> float:
        model = identify(data, iterations=5, starts=1, threads=1)
        return float(model.validate(dataset(u, y)).simulation.rmse)

    assert rmse(dataset(u, z, w)) < 0.03
    assert rmse(dataset(u, z)) > 0.3


# --- what is scored -------------------------------------------------------------------------------


def test_scores_are_weighted() -> None:
    u, y = recording()
    model = sewfast.LinearOE.from_tf([0.0, *B], [1.0, *A], Ts=0.01)
    y = y + weights(1.0, 0.0)
    w = weights(0.25)
    found = model.validate(dataset(u, y, w))
    (run,) = model.simulate(dataset(u, y))
    e, w = (y - run)[20:], w[20:]
    mean = np.sum(w * y[20:]) / w.sum()
    assert found.simulation.rmse == pytest.approx(np.sqrt(np.sum(w * e**2) / w.sum()), rel=1e-12)
    ratio = np.sum(w * e**2) / np.sum(w * (y[20:] - mean) ** 2)
    assert found.simulation.fit_percent == pytest.approx(100 * (1 - np.sqrt(ratio)), rel=1e-12)
    assert found.simulation.max_abs == np.abs(e).max()
    assert found.experiments[0].simulation_scores == found.simulation
    (step,) = model.predict(dataset(u, y))
    e = (y - step)[20:]
    assert found.one_step.rmse == pytest.approx(np.sqrt(np.sum(w * e**2) / w.sum()), rel=1e-12)
    ones = model.validate(dataset(u, y, np.full(N, 3.0)))
    assert ones.to_json() == model.validate(dataset(u, y)).to_json()
    assert (model.validate(dataset(u, y, weights(0.1))).simulation.rmse) < found.simulation.rmse


def test_weight_0_is_not_scored_and_sets_no_state() -> None:
    u, y = recording()
    model = sewfast.LinearOE.from_tf([0.0, *B], [1.0, *A], Ts=0.01)
    w = weights(0.0)
    w[:40] = 0.0
    y = spoilt(y)
    y[:40] = 30.0
    truth = {"truth": y}
    data = Dataset.from_arrays(u, y, 0.01, weights=w, channels=truth)
    masked = dataset(u, y).mask(f"{BAD.start}:{BAD.stop}").mask("0:40")
    for one, other in [
        (model.simulate(data), model.simulate(masked)),
        (model.predict(data), model.predict(masked)),
    ]:
        np.testing.assert_array_equal(one[0], other[0])
    found = model.validate(data)
    assert found.to_json() == model.validate(masked).to_json()
    assert found.unmeasured == BAD.stop - BAD.start
    assert model.validate(data, against="truth").simulation == found.simulation
    assert model.check(data).to_json() == model.check(masked).to_json()
    assert str(sewfast.delay(data)) == str(sewfast.delay(masked))
    assert str(sewfast.orders(data, na=2, nb=2)) == str(sewfast.orders(masked, na=2, nb=2))


def test_errors_on_what_is_held_out_are_weighted() -> None:
    u, y = recording()
    w = np.ones(N)
    w[1400:] = 0.5
    part = later_part(dataset(u, y, w))
    assert part is not None
    (held,) = part.held.experiments
    # off by 1 in the last hundred of the 300 samples, which count half
    run = np.where(np.arange(held.start, N) >= 1400, y[held.start :] + 1.0, y[held.start :])
    found = errors_of([run], part)
    assert found.rmse == pytest.approx(np.sqrt(50 / 250))
    assert found.counts.sum() == 250


# --- where they go along --------------------------------------------------------------------------


def test_weights_go_along_with_their_samples() -> None:
    u, y = recording()
    w = np.linspace(0.5, 2.0, N)
    data = Dataset.from_arrays(u, y, 0.01, weights=w, name="run")
    assert not data.experiments[0].weights.flags.writeable
    assert "run [0:1500], weighted" in str(data)
    first, second = data.split(0.6)
    np.testing.assert_array_equal(first.experiments[0].weights, w[:900])
    np.testing.assert_array_equal(second.experiments[0].weights, w[900:])
    np.testing.assert_array_equal(data[100:200].experiments[0].weights, w[100:200])
    np.testing.assert_array_equal(data.slice("7:9").experiments[0].weights, w[7:9])
    again = pickle.loads(pickle.dumps(data))
    np.testing.assert_array_equal(again.experiments[0].weights, w)
    for other in (data.mask("3:5"), data.detrend(), data.differentiate(method="difference")):
        np.testing.assert_array_equal(other.experiments[0].weights, w)
    pieces = data.mask("500:600").split_at_gaps()
    np.testing.assert_array_equal(pieces.experiments[1].weights, w[600:])
    both = Dataset.concat([data, dataset(u, y)])
    assert both.experiments[1].weights is None


def test_another_sample_time_takes_the_mean_weight_and_nothing_of_weight_0() -> None:
    u, y = recording()
    slow = dataset(u, spoilt(y), weights(0.0)).resample(0.05)
    clean = dataset(u, y).mask(f"{BAD.start}:{BAD.stop}").resample(0.05)
    np.testing.assert_array_equal(slow.experiments[0].y, clean.experiments[0].y)
    ramp = np.arange(N) / N
    slow = dataset(u, y, ramp).resample(0.05)
    np.testing.assert_allclose(slow.experiments[0].weights[1:-1], ramp[5:-5:5], atol=1e-12)
    fast = dataset(u, y, weights(0.0)).resample(0.004)
    assert fast.experiments[0].weights.min() == 0.0
    assert fast.experiments[0].weights.max() == 1.0


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_files_carry_weights_in_a_column(suffix: str, tmp_path: Path) -> None:
    u, y = recording()
    w = np.random.default_rng(1).random(N)
    path = tmp_path / f"run{suffix}"
    sewfast.write_table(path, {"u": u[:, 0], "y": y, "trust": w})
    data = sewfast.read(path, inputs="u", output="y", weights="trust", Ts=0.01)
    np.testing.assert_array_equal(data.experiments[0].weights, w)
    assert sewfast.read(path, inputs="u", output="y", Ts=0.01).experiments[0].weights is None
    with pytest.raises(DataError, match="trust"):
        sewfast.read(path, inputs="u", output="y", weights="believe", Ts=0.01)
    with pytest.raises(DataError, match=r"'y': weights: .* received -"):
        sewfast.read(path, inputs="u", output="trust", weights="y", Ts=0.01)


def test_uneven_times_leave_no_trace_of_rows_of_weight_0(tmp_path: Path) -> None:
    t = np.cumsum(np.random.default_rng(2).uniform(0.008, 0.012, N))
    t[1000:] += 0.5
    u, y = recording()
    path = tmp_path / "run.csv"
    sewfast.write_table(path, {"t": t, "u": u[:, 0], "y": spoilt(y) + 100, "w": weights(0.0)})
    data = sewfast.read(path, inputs="u", output="y", weights="w", Ts=0.01)
    e = data.experiments[0]
    assert ((e.weights >= 0.0) & (e.weights <= 1.0)).all()
    known = e.y[~np.isnan(e.y)]
    assert known.min() > 100 + y.min() - 0.1
    assert known.max() < 100 + y.max() + 0.1


def test_command_line(tmp_path: Path) -> None:
    u, y = recording()
    sewfast.write_table(tmp_path / "run.csv", {"u": u[:, 0], "y": spoilt(y), "w": weights(0.0)})
    columns = ("--input", "u", "--output", "y", "--ts", ".01", "--weights", "w")
    found = cli.sewfast(tmp_path, "identify", "run.csv", *columns, "--model", "oe", "-o", "m.json")
    assert "200 outputs of weight 0 count as not measured" in found.out
    bad = cli.sewfast(tmp_path, "validate", "m.json", "run.csv", "--ts", ".01")
    good = cli.sewfast(tmp_path, "validate", "m.json", "run.csv", "--ts", ".01", "--weights", "w")
    assert "useless" in bad.out
    assert "verdict: good enough" in good.out


# --- what is none ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.ones(N - 1), r"weights: expected shape \(1500,\).* received \(1499,\)"),
        (np.ones((N, 1)), r"weights: expected shape \(1500,\)"),
        (1.0, r"weights: expected shape \(1500,\)"),
        (weights(-1.0), "weights: expected finite .* of 0 or more, received -1.0 at sample 700"),
        (weights(np.nan), "received nan at sample 700"),
        (weights(np.inf), "received inf at sample 700"),
        (np.zeros(N), "weights: every measured sample has weight 0"),
        (weights(1.0, 0.0), "weights: every measured sample has weight 0"),
        (np.array(["1"] * N), "weights: expected real numbers"),
        (1j * np.ones(N), "weights: expected real numbers"),
    ],
)  # fmt: skip
def test_what_is_no_weight_is_refused_by_name(given: Any, message: str) -> None:
    u, y = recording()
    y[BAD] = np.nan
    with pytest.raises(DataError, match=message):
        dataset(u, y, given)


def test_experiments_without_any_weight_are_refused_where_they_are_used() -> None:
    u, y = recording()
    data = dataset(u, y, weights(0.0))
    part = data[BAD.start : BAD.stop]
    model = sewfast.LinearOE.from_tf([0.0, *B], [1.0, *A], Ts=0.01)
    for use in (lambda: identify(part, model="oe"), lambda: model.validate(part)):
        with pytest.raises(DataError, match=r"\[700:900\], weights: every measured sample"):
            use()
    with pytest.raises(DataError, match="weights"):
        identify(Dataset((Experiment(u, y, weights=np.zeros(N)),), 0.01), model="arx")
    with pytest.raises(DataError, match="weights: expected shape"):
        Experiment(u, y, weights=np.ones(3))


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_the_core_refuses_what_is_no_weight(value: float) -> None:
    u, y = recording()
    for wrong in (weights(value), np.ones(3), np.zeros(N)):
        with pytest.raises(DataError, match="weight"):
            _core.fit_oe([(u, y, wrong)], na=2, nb=2, nk=1)
        with pytest.raises(DataError, match="weight"):
            _core.fit_arx([(u, y, wrong)], na=2, nb=2, nk=1, offset=True)
        with pytest.raises(DataError, match="weight"):
            _core.fit_neural_ss([(u, y, wrong)], [], linear=None, **STATES)
    same = _core.fit_oe([(u, y, np.ones(N))], na=2, nb=2, nk=1)
    np.testing.assert_array_equal(same.model.a, _core.fit_oe([(u, y)], na=2, nb=2, nk=1).model.a)
