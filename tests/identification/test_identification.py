"""`identify`: known plants are found, settings and data are checked, the choice is told."""

import json
import os
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from plants import OFFSET, A, B, bent_data, linear_data
from sewfast import _core
from sewfast.dataset import Dataset
from sewfast.errors import DataError, Interrupted, SettingError
from sewfast.identification import identify, seeded
from sewfast.models import ARX, IV, Ensemble, LinearOE, NeuralOE, NeuralSS
from sewfast.readers import read
from sewfast.validation import validate

DATA = Path(os.environ.get("SEWFAST_DATA", Path(__file__).parents[3] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no measured data (set SEWFAST_DATA)")
QUICK: dict[str, Any] = {"iterations": 20, "starts": 2, "hidden": 4}
SEARCHED = ("auto", "neural_ss")
SMALL: dict[str, Any] = {**QUICK, "nx": 2, "nk": 1}


# --- recovery ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["arx", "iv", "oe"])
@pytest.mark.parametrize("inputs", [1, 2])
def test_linear_models_recover_a_linear_plant(kind: Any, inputs: int) -> None:
    model = identify(linear_data(inputs=inputs), model=kind)
    assert isinstance(model, (ARX, IV, LinearOE))
    np.testing.assert_allclose(model.core.a, A, rtol=1e-6)
    np.testing.assert_allclose(model.core.b, np.vstack([B, 2 * B])[:inputs], rtol=1e-6)
    assert model.core.offset == pytest.approx(OFFSET, rel=1e-6)


def test_output_error_is_unbiased_by_measurement_noise_where_arx_is_not() -> None:
    data = linear_data(3000, noise=1.0)
    arx, oe = identify(data, model="arx"), identify(data, model="oe")
    off = [np.abs(m.core.a - A).max() for m in (arx, oe)]
    assert off[1] < 0.05 < off[0]


def test_two_experiments_are_fitted_together() -> None:
    data = Dataset.concat([linear_data(200), linear_data(200, seed=5)])
    model = identify(data, model="oe")
    np.testing.assert_allclose(model.core.a, A, rtol=1e-6)
    assert model.training["samples"] == 400
    assert [d["samples"] for d in model.training["data"]] == [200, 200]


def test_networks_that_share_their_linear_start_are_those_of_identify() -> None:
    data = bent_data()
    train = seeded(data, iterations=5)
    thetas = []
    for seed in (0, 3):
        alone = identify(
            data, model="neural_oe", starts=1, seed=seed, iterations=5, threads=1, select=False
        )
        network = train(seed)
        np.testing.assert_array_equal(network.core.theta, alone.core.theta)
        evidence = {"region", "uncertainty", "information", "verdict", "rest", "noise"}
        assert set(alone.training) - set(network.training) <= evidence
        assert network.training["cost"] == alone.training["cost"]
        thetas.append(network.core.theta)
    assert not np.array_equal(*thetas)
    with pytest.raises(DataError):
        seeded(linear_data(20))


def test_the_network_fits_what_no_linear_model_can() -> None:
    data, fresh = bent_data(), bent_data(seed=9)
    linear = validate(identify(data, model="oe"), fresh)
    network = validate(identify(data, model="neural-oe", **QUICK), fresh)
    assert network.simulation.rmse < 0.5 * linear.simulation.rmse


# --- selection --------------------------------------------------------------------------------


@pytest.mark.slow("the one full search by day that ends in a network")
def test_auto_takes_the_network_where_it_helps_and_says_why() -> None:
    model = identify(bent_data(noise=0.01), **SMALL)
    assert isinstance(model, (NeuralSS, Ensemble))
    choice = model.training["choice"]
    assert choice["chosen"] == "neural_ss"
    rmse = choice["free_run_rmse"]
    assert rmse["neural_ss"] < 0.9 * rmse["oe"]
    assert "free-run error" in choice["reason"]
    assert [d["range"] for d in choice["held_out"]] == ["0:200", "200:400", "400:600", "600:800"]
    assert model.training["samples"] == 800
    kinds = {c["kind"] for c in choice["candidates"]}
    assert kinds == {"oe", "neural_ss"}
    assert "chosen: neural_ss" in str(model)


def test_auto_takes_the_linear_model_where_the_network_does_not_help() -> None:
    model = identify(linear_data(800, noise=0.5), **SMALL)
    assert isinstance(model, LinearOE)
    assert model.training["choice"]["chosen"] == "oe"


@pytest.mark.parametrize("kind", ["neural_oe", "neural_ss"])
def test_the_network_says_where_it_does_not_help(kind: Any) -> None:
    options = QUICK if kind == "neural_oe" else SMALL
    model = identify(linear_data(800, noise=0.5), model=kind, **options)
    assert isinstance(model, (NeuralOE, NeuralSS, Ensemble))
    assert "consider model oe" in model.training["notes"][0]


def test_given_validation_data_decide_and_are_not_learned_from() -> None:
    other = bent_data(300, seed=4, name="other")
    model = identify(bent_data(), validation=other, **SMALL)
    assert model.training["choice"]["held_out"] == [
        {"name": "other", "range": "0:300", "samples": 300}
    ]
    assert model.training["samples_fitted"] == 800


def test_records_too_short_to_hold_out_fall_back_on_the_linear_model() -> None:
    model = identify(linear_data(150), **SMALL)
    assert isinstance(model, LinearOE)
    assert "too short" in model.training["choice"]["reason"]


def test_a_sensor_that_does_not_see_the_sign_is_found() -> None:
    plain = bent_data(900, noise=0.005)
    e = plain.experiments[0]
    data = Dataset.from_arrays(e.u, np.abs(e.y), 0.01)
    model = identify(data, **SMALL)
    assert model.training["choice"]["chosen_structure"]["output"] == "abs"


def test_a_sensor_that_ends_at_a_limit_is_found() -> None:
    plain = bent_data(900, noise=0.005)
    e = plain.experiments[0]
    limit = float(np.quantile(e.y, 0.8))
    data = Dataset.from_arrays(e.u, np.minimum(e.y, limit), 0.01)
    tried = {c.get("output") for c in identify(data, **SMALL).training["choice"]["candidates"]}
    assert "saturation" in tried


# --- workers and time --------------------------------------------------------------------------


def searched(**options: Any) -> Any:
    few = {"iterations": 8, "starts": 3, "hidden": 4, "nx": 2, "nk": 1}
    return identify(bent_data(400), model="neural_ss", **few, **options).parameters()


def test_any_workers_give_the_same_bits(process_pool: Any) -> None:
    expected = searched(threads=1)
    with ThreadPoolExecutor(2) as threads:
        assert searched(workers=threads) == expected
    assert searched(workers=process_pool) == expected
    assert searched(workers=map) == expected


@pytest.fixture
def process_pool() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.mark.nightly("a cluster; by day that of `test_fleet`")
def test_a_dask_cluster_gives_the_same_bits() -> None:
    distributed = pytest.importorskip("distributed")
    with warnings.catch_warnings():
        # the cluster's own clean-up is not what is tested
        warnings.simplefilter("ignore")
        options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
        with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
            found = searched(workers=client)
            again = searched(workers=client.get_executor())
    assert found == again == searched(threads=1)


def test_what_cannot_map_is_no_worker() -> None:
    with pytest.raises(SettingError, match="workers: expected an executor"):
        identify(bent_data(), workers=4)  # type: ignore[arg-type]


def test_a_time_budget_that_bites_is_told_and_leaves_a_model() -> None:
    model = identify(bent_data(), time_budget=1e-6, **SMALL)
    assert "time budget" in str(model.training["notes"])
    assert np.isfinite(model.simulate(bent_data())[0]).all()
    cut = model.training["time_budget"]
    assert cut["seconds"] == 1e-6
    assert "networks" in " ".join(cut["lost"])
    assert cut["grade"] == model.training["verdict"]["grade"]
    note = next(n for n in model.training["notes"] if "time budget" in n)
    assert all(what in note for what in (*cut["lost"], cut["grade"]))


def test_a_time_budget_that_does_not_bite_changes_nothing() -> None:
    model = identify(bent_data(400), time_budget=1e6, **SMALL)
    assert "notes" not in model.training
    assert model.parameters() == identify(bent_data(400), **SMALL).parameters()


# --- what is promised of every model ----------------------------------------------------------


@pytest.mark.parametrize("kind", ["arx", "oe", "neural_oe", "neural_ss", "auto"])
def test_the_story_is_whole_and_is_json(kind: Any) -> None:
    model = identify(bent_data(), model=kind, **(SMALL if kind in SEARCHED else QUICK))
    story = json.loads(json.dumps(model.training, allow_nan=False))
    assert story["data"] == [{"name": "bent", "range": "0:800", "samples": 800}]
    assert story["cost"] >= 0
    assert story["cost_horizon"] == ("one step" if kind == "arx" else "free run")
    assert story["input_range"] == [list(r) for r in bent_data().input_range]
    for name in ("termination", "initial_state", "seconds", "output_range", "cost_unit"):
        assert name in story


@pytest.mark.parametrize("preset", [None, "paper"])
def test_a_seed_gives_the_same_bits_at_any_number_of_threads(preset: Any) -> None:
    one, two = (
        identify(bent_data(), model="neural_oe", preset=preset, iterations=10, threads=t)
        for t in (1, 2)
    )
    assert isinstance(one, NeuralOE)
    assert one.parameters() == two.parameters()
    other = identify(bent_data(), model="neural_oe", preset=preset, iterations=10, seed=1)
    assert one.parameters() != other.parameters()


def test_the_papers_preset_is_the_papers_network() -> None:
    model = identify(bent_data(), preset="paper", iterations=10)
    assert isinstance(model, NeuralOE)
    s = model.settings
    assert (s["na"], s["nb"], s["nk"], s["hidden"], s["bypass"]) == (2, 2, 1, 8, False)
    assert (s["u_mean"], s["u_scale"], s["y_mean"], s["y_scale"]) == ([0.0], [10.0], 0.0, 1000.0)
    low, high = bent_data().output_range
    width = high - low
    np.testing.assert_allclose(
        [s["output_low"], s["output_high"]],
        [(low - 0.1 * width) / 1000, (high + 0.1 * width) / 1000],
    )
    assert model.training["preset"] == "paper"


def test_data_are_not_changed() -> None:
    u, y = np.sin(np.arange(300.0)), np.cumsum(np.sin(np.arange(300.0)))
    before = u.copy(), y.copy()
    identify(Dataset.from_arrays(u, y, 1.0), model="oe")
    np.testing.assert_array_equal(u, before[0])
    np.testing.assert_array_equal(y, before[1])


@pytest.mark.parametrize("kind", ["auto", "neural_oe"])
def test_a_seed_is_a_number_for_every_kind(kind: Any) -> None:
    wrong: Any = None
    with pytest.raises(SettingError, match="seed: expected a whole number"):
        identify(linear_data(200), model=kind, seed=wrong)


# --- interruption -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["oe", "neural_oe", "neural_ss", "auto"])
def test_an_interruption_hands_over_the_best_model(kind: Any) -> None:
    calls = 0

    def stop(done: int, total: int, best: float) -> None:
        nonlocal calls
        calls += 1
        raise KeyboardInterrupt

    data = Dataset.concat([bent_data(20000, seed=s) for s in range(4)])
    with pytest.raises(KeyboardInterrupt) as caught:
        identify(data, model=kind, progress=stop)
    assert calls >= 1
    if isinstance(caught.value, Interrupted):
        best = caught.value.best
        assert np.isfinite(best.simulate(bent_data())[0]).all()
        assert kind in ("auto", (best.members or (best,))[0].kind)


@pytest.mark.parametrize("stopped", [2, 3])
def test_an_interruption_of_the_fits_that_judge_the_start_is_not_lost(
    monkeypatch: pytest.MonkeyPatch, stopped: int
) -> None:
    fitted, calls = _core.fit_oe, 0

    def fit(*args: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        found = fitted(*args, **options)
        # what the core gives back after a Ctrl-C: when it comes cannot be timed
        return (
            SimpleNamespace(model=found.model, termination="interrupted")
            if calls == stopped
            else found
        )

    monkeypatch.setattr(_core, "fit_oe", fit)
    with pytest.raises(KeyboardInterrupt) as caught:
        identify(bent_data(600, noise=0.02), model="neural_oe", **QUICK)
    assert calls == stopped
    # no network is there yet, and a linear model was not asked for
    assert not isinstance(caught.value, Interrupted)


def test_a_progress_that_cannot_be_called_is_refused() -> None:
    with pytest.raises(SettingError) as refused:
        identify(linear_data(), model="arx", progress=3)  # type: ignore[arg-type]
    assert refused.value.name == "progress"


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"model": "narx"},
            "auto, arx, iv, oe, .*neural-oe, neural-ss or a model .*, received 'narx'",
        ),
        ({"model": "paper"}, "auto, arx, iv, oe, .*neural-oe, neural-ss or"),
        ({"preset": "other"}, "'paper' or none"),
        ({"preset": "paper", "model": "arx"}, "neural-oe"),
        ({"preset": "paper", "na": 3}, "na = 2"),
        ({"na": 0, "model": "oe"}, "na: expected a whole number from 1"),
        ({"nb": 2.0, "model": "oe"}, "nb: expected a whole number"),
        ({"nk": -1}, "nk"),
        ({"hidden": 0}, "hidden"),
        ({"starts": 0}, "starts"),
        ({"seed": -1}, "seed"),
        ({"iterations": 0}, "iterations"),
        ({"threads": 0}, "threads"),
        ({"hidden": True}, "hidden"),
        ({"nx": 0, "model": "neural_ss"}, "nx"),
        ({"nx": 2, "model": "oe"}, "nx: model oe has none"),
        ({"na": 2}, "na: model auto has none, received 2; give nx, or name a lagged model"),
        ({"output": "tanh"}, "output: expected one of linear, saturation, abs"),
        ({"time_budget": 0}, "time_budget: expected seconds above 0"),
    ],
)
def test_settings_out_of_range_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingError, match=words):
        identify(linear_data(), **options)


KINDS = ["arx", "oe", "neural_oe", "neural_ss", "auto"]


@pytest.mark.parametrize("kind", KINDS)
def test_unusable_data_are_refused(kind: Any) -> None:
    n = 300
    u, y = np.sin(np.arange(n)), np.cos(np.arange(n))
    cases = [
        (np.ones(n), y, "input 'u' is constant"),
        (u, np.zeros(n), "output 'y' is constant"),
        (np.full(n, np.nan), y, "every value is NaN"),
        (u, np.full(n, np.nan), "every value is NaN"),
        (u, np.where(np.arange(n) == 250, np.inf, y), "sample 250"),
        (np.where(np.arange(n) == 250, np.nan, u), y, "sample 250.*fill_inputs"),
        (u, np.where(np.arange(n) > 9, np.nan, y), r"more than 22 samples, received 10 \(290 more"),
        (u[:15], y[:15], "more than 22 samples"),
    ]
    for bad_u, bad_y, words in cases:
        with pytest.raises(DataError, match=words):
            identify(Dataset.from_arrays(bad_u, bad_y, 0.01), model=kind)


def test_too_few_samples_for_the_orders_are_counted() -> None:
    with pytest.raises(DataError, match="at least 106 samples for 53 parameters, received 98"):
        identify(linear_data(100), model="neural_oe")
    with pytest.raises(DataError, match=r"short.*more than 22 samples, received 10"):
        identify(Dataset.concat([linear_data(), linear_data(10, name="short")]), model="oe")


def test_validation_data_must_belong_to_the_training_data() -> None:
    with pytest.raises(DataError, match="one sample time"):
        identify(linear_data(), validation=Dataset.from_arrays(np.ones(50), np.ones(50), 0.1))
    with pytest.raises(DataError, match="more than 20 samples, received 20"):
        identify(linear_data(), validation=linear_data(20))
    with pytest.raises(DataError, match="one input"):
        identify(linear_data(inputs=2), preset="paper")


# --- measured data ----------------------------------------------------------------------------


@needs_data
@pytest.mark.parametrize(
    ("file", "least"), [("bldc_cigan/bldc.csv", 80.0), ("dc_motor_un/prbs_open_exp.csv", 75.0)]
)
def test_recordings_of_motors_are_identified(file: str, least: float) -> None:
    train, rest = read(DATA / file, inputs="u", output="y").split(0.6)
    v = validate(identify(train, model="oe"), rest)
    assert v.simulation.fit_percent > least


@needs_data
def test_the_network_keeps_its_head_where_the_drive_has_not_been() -> None:
    # the drive coasts to a stop between these two parts, and in neither of them
    whole = read(DATA / "bldc_cigan/bldc.csv", inputs="u", output="y")
    train, coast = Dataset.concat([whole[0:2500], whole[3700:5000]]), whole[2500:3700]
    linear = validate(identify(train, model="oe"), coast)
    network = validate(identify(train, model="neural_oe", starts=2), coast)
    assert network.simulation.rmse < 1.2 * linear.simulation.rmse
