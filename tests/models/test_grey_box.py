"""The grey box: what it finds on motors, when it takes a network, its file, its refusals."""

from __future__ import annotations

import json
import math
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import sewfast as command
from effort import FULL
from sewfast import Dataset, _core
from sewfast.analysis.changes import with_delay, with_time_constants
from sewfast.errors import DataError, ModelFileError, SettingError
from sewfast.identification.task import Clock
from sewfast.models.grey_box import NAMES, GreyBox

TS = 0.002


def _steps(n: int, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-8.0, 8.0, n // 60 + 1), 60)[:n]


def _plant(n: int, seed: int, fan: float = 0.0, noise: float = 2.0) -> Dataset:
    """Speed [rpm] of a motor with dry friction, and a fan on its shaft."""
    u, y, w, h = _steps(n, seed), np.zeros(n), 0.0, TS / 10
    for k in range(n):
        y[k] = w
        for _ in range(10):
            free = w + h / 0.004 * (u[k] - 0.02 * w - fan * w * abs(w))
            w = np.sign(free) * max(abs(free) - h * 0.3 / 0.004, 0.0)
    y = y * 60.0 / (2.0 * np.pi) + noise * np.random.default_rng(seed + 99).normal(size=n)
    return Dataset.from_arrays(u, y, TS, input_units=("V",), output_unit="rpm")


@cache
def _model(fan: float = 0.0, seed: int = 1) -> Any:
    return sewfast.identify(_plant(5000, seed, fan), model="grey-box")


@pytest.mark.nightly("a fit for each seed", by_day=["1"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_motor_is_found_without_a_network(seed: int) -> None:
    model = _model(0.0, seed)
    assert isinstance(model, GreyBox)
    assert model.orders["hidden"] == 0
    of = model.motor
    assert of["k_e"] + of["k_b"] == pytest.approx(0.02, rel=0.01)
    assert of["k_a"] == pytest.approx(0.004, rel=0.02)
    assert of["k_s"] == pytest.approx(0.3, rel=0.05)
    fresh = _plant(3000, seed + 40)
    assert model.validate(fresh).simulation.rmse < 1.15 * 2.0


@pytest.mark.nightly("a default search for each seed", by_day=["1"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_network_is_taken_where_something_is_left(seed: int) -> None:
    model = _model(6e-5, seed)
    assert model.orders["hidden"] == 4
    plain, whole = (t["held_out_rmse"] for t in model.training["tried"])
    assert whole < 0.5 * plain
    fresh = _plant(3000, seed + 40, 6e-5)
    assert model.validate(fresh).simulation.rmse < 0.5 * plain
    assert "4 tanh for what they leave" in str(model)


def test_units_that_are_asked_for_are_taken() -> None:
    model: Any = sewfast.identify(_plant(2000, 5), model="grey_box", hidden=2)
    assert model.orders["hidden"] == 2
    assert model.parameter_names[-8:] == tuple(f"{w}[{i}]" for i in (0, 1) for w in "bpqc")
    assert len(model.parameter_names) == len(model.theta)
    # judged by the same equations and as many units without the last part of the record
    assert "of data not trained on" in model.training["verdict"]["text"]
    assert [t["hidden"] for t in model.training["tried"]] == [0, 2]


def test_the_plant_of_a_loop_moves_as_the_free_run_does() -> None:
    """A proportional controller on the model, and its command through the free run."""
    model = _model(6e-5)
    r = np.repeat([500.0, -800.0, 0.0, 1500.0], 400)
    gains = sewfast.Gains("standard", 0.005, 0.1, 0.0, u_unit="V", y_unit="rpm")
    run = sewfast.run(sewfast.Controller(gains, TS, u_min=-10.0, u_max=10.0), model, r)
    # a free run takes the first command as held before, a loop begins without one
    u = np.concatenate([[0.0], run.u])[:, None]
    again = model.core.simulate(u, model.core.rest_state())[1:]
    np.testing.assert_allclose(again, run.y, rtol=1e-9, atol=1e-6)
    assert abs(run.y[-1] - 1500.0) < 15.0


def test_it_is_tuned_on_and_a_member_of_an_ensemble(tmp_path: Path) -> None:
    model = _model(6e-5)
    linear = sewfast.identify(_plant(3000, 1, 6e-5), model="oe")
    both = sewfast.Ensemble.of([model, linear])
    assert np.isfinite(both.validate(_plant(1000, 9, 6e-5)).simulation.rmse)
    tuned = sewfast.tune(both, u_min=-10.0, u_max=10.0, evaluations=40)
    assert tuned.cost < math.inf
    both.save(tmp_path / "both.json")
    again = sewfast.load_model(tmp_path / "both.json")
    u = _steps(300, 4)
    np.testing.assert_array_equal(again.simulate(u), both.simulate(u))


def test_gaps_and_weights_are_heeded() -> None:
    e = _plant(4000, 8, 6e-5).experiments[0]
    y, weights = e.y.copy(), np.ones(4000)
    y[500:700] = np.nan
    y[2000:2100] += 5000.0
    weights[2000:2100] = 0.0
    data = Dataset.from_arrays(e.u, y, TS, weights=weights, output_unit="rpm")
    model = sewfast.identify(data, model="grey_box", hidden=4)
    assert model.validate(_plant(2000, 44, 6e-5)).simulation.rmse < 3.0 * 2.0


def test_a_file_with_a_wrong_number_says_which_field(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    _model().save(path)
    values = json.loads(path.read_text())
    assert values["parameters"]["limit"] is None
    for change in (
        {"values": [1.0]}, {"free": ["k_x"]}, {"free": ["k_e", "k_e"]}, {"unit": 0.0},
        {"theta": [1.0]}, {"Ts": -1.0}, {"process_noise": -1.0},
    ):  # fmt: skip
        path.write_text(json.dumps({**values, "parameters": {**values["parameters"], **change}}))
        with pytest.raises(ModelFileError, match=r"parameters|free"):
            sewfast.load_model(path)


def test_what_is_no_motor_is_refused() -> None:
    data = _plant(2000, 3)
    e = data.experiments[0]
    with pytest.raises(SettingError) as refused:
        sewfast.identify(Dataset.from_arrays(e.u, e.y, TS, output_unit="kg"), model="grey_box")
    assert refused.value.name == "output_unit"
    two = Dataset.from_arrays(np.c_[e.u, e.u**2], e.y, TS, output_unit="rpm")
    with pytest.raises(DataError) as other:
        sewfast.identify(two, model="grey_box")
    assert other.value.name == "inputs"
    with pytest.raises(DataError, match="sign"):
        sewfast.identify(Dataset.from_arrays(e.u, -e.y, TS, output_unit="rpm"), model="grey_box")
    for setting in ({"na": 2}, {"nk": 1}, {"nx": 2}, {"hidden": 7}):
        with pytest.raises(SettingError, match=next(iter(setting))):
            sewfast.identify(data, model="grey_box", **setting)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="no form for microcontrollers"):
        _model().core.embedded()


def test_the_core_refuses_what_is_no_motor() -> None:
    own = dict(_model().core.settings)
    for derived in ("nx", "nk", "n_inputs", "integrator", "hidden"):
        del own[derived]
    whole = {**own, "theta": _model().core.theta}
    load = np.array(whole["values"])
    load[NAMES.index("load_1c")] = 0.1
    for change, words in (
        ({"theta": whole["theta"][1:]}, "parameters of the motor"), ({"unit": 0.0}, "unit"),
        ({"values": load}, "load_1"), ({"speed_scale": np.nan}, "speed_scale"),
        ({"values": load[:3]}, "30 values"), ({"free": [99, *whole["free"][1:]]}, "places"),
    ):  # fmt: skip
        with pytest.raises(SettingError, match=words):
            _core.GreyBox(**{**whole, **change})


def test_threads_change_nothing_and_a_seed_repeats() -> None:
    data = _plant(2000, 12, 6e-5)
    options: Any = {"model": "grey_box", "hidden": 3, "iterations": 5}
    one, two = (sewfast.identify(data, threads=t, seed=4, **options) for t in (1, 2))
    np.testing.assert_array_equal(one.theta, two.theta)


def test_the_command_line_makes_and_uses_one(tmp_path: Path) -> None:
    e = _plant(2500, 13).experiments[0]
    columns = {"t": TS * np.arange(2500), "u": e.u[:, 0], "y": e.y}
    sewfast.write_table(tmp_path / "run.csv", columns, units={"u": "V", "y": "rpm"})
    made = command(
        tmp_path, "identify", "run.csv", "--input", "u", "--output", "y",
        "--model", "grey-box", "-o", "m.json",
    )  # fmt: skip
    assert "Grey box" in made.out
    assert "k_v 0.0" in made.out
    assert "verdict: " in command(tmp_path, "validate", "m.json", "run.csv").out


def test_a_slower_and_a_later_one_are_what_they_say() -> None:
    model, u = _model(), np.repeat([0.0, 6.0], 400)
    late = with_delay(model, 2).simulate(u)
    np.testing.assert_allclose(late[402:], model.simulate(u)[400:-2], rtol=1e-9, atol=1e-6)
    slow = with_time_constants(model, 2.0)
    assert slow.motor["k_a"] == pytest.approx(2.0 * model.motor["k_a"])
    long = np.full(2500, 6.0)
    assert slow.simulate(long)[-1] == pytest.approx(model.simulate(long)[-1], rel=0.01)


# --- as a candidate of the search -----------------------------------------------------------------


@pytest.mark.slow("the one full search by day that ends in a motor")
@pytest.mark.parametrize("seed", [1, 2, 3] if FULL else [1])
def test_the_search_takes_a_motor_for_a_motor(seed: int) -> None:
    model: Any = sewfast.identify(_plant(1500, seed), seed=seed)
    assert model.kind == "grey_box"
    choice = model.training["choice"]
    assert choice["chosen"] == "grey_box"
    assert "the equations of a motor" in choice["reason"]
    assert [c["kind"] for c in choice["candidates"]].count("grey_box") == 1
    assert choice["free_run_rmse"]["grey_box"] < 0.7 * choice["free_run_rmse"]["oe"]
    assert model.training["verdict"]["grade"] == "good"
    assert model.alternatives[-1].kind == "oe"
    fresh = _plant(3000, seed + 40)
    assert model.validate(fresh).simulation.rmse < 1.15 * 2.0  # rpm, the noise is 2


@pytest.mark.nightly("default searches in several units")
def test_what_is_linear_stays_linear_whatever_its_unit() -> None:
    for seed in range(3 if FULL else 1):
        u, rng = _steps(3000, seed), np.random.default_rng(seed)
        y = np.zeros(len(u))
        for k in range(2, len(u)):
            y[k] = 1.6 * y[k - 1] - 0.64 * y[k - 2] + 3.0 * u[k - 1]
        y += rng.normal(size=len(y))
        data = Dataset.from_arrays(u, y, TS, output_unit="rpm")
        assert sewfast.identify(data, seed=seed).kind == "oe"


@pytest.mark.nightly("a search of seconds")
@pytest.mark.parametrize(
    "given", [{"nx": 2}, {"nk": 1}, {"hidden": 4}, {"output": "linear"}] if FULL else [{"nk": 1}]
)
def test_a_structure_that_is_given_is_no_motor_s(given: dict[str, Any]) -> None:
    model = sewfast.identify(_plant(1000, 1), time_budget=4.0, **given)
    assert "grey_box" not in [c["kind"] for c in model.training["choice"]["candidates"]]


def test_a_search_in_a_hurry_and_one_interrupted_keep_the_motor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(self: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sewfast.identification.table.Table._screened", stopped)
    with pytest.raises(sewfast.Interrupted) as e:
        sewfast.identify(_plant(3000, 1))
    assert e.value.best.kind == "grey_box"
    assert e.value.best.training["termination"] == "interrupted"
    assert e.value.best.validate(_plant(3000, 41)).simulation.rmse < 1.2 * 2.0


def test_a_motor_is_tried_before_any_larger_linear_model(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []

    def motor(*_: object) -> None:
        order.append("motor")

    def linear(self: Any, *_: object) -> None:
        order.append(f"linear after {len(self.candidates)}")

    def ends(self: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sewfast.identification.grey_box.Motors.candidate", motor)
    monkeypatch.setattr("sewfast.identification.linear.LinearTable.search", linear)
    monkeypatch.setattr("sewfast.identification.table.Table._screened", ends)
    with pytest.raises(sewfast.Interrupted):
        sewfast.identify(_plant(1000, 1))
    assert order == ["motor", "linear after 1"]


def test_a_budget_ends_the_fit_of_a_motor_with_the_motor_so_far(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data, looks = _plant(1500, 1), count()
    # a clock that counts: every look takes a second
    monkeypatch.setattr(Clock, "spent", property(lambda self: float(next(looks))))
    with pytest.raises(sewfast.FitError, match="time_budget"):  # before there is a motor
        sewfast.identify(data, model="grey_box", hidden=2, time_budget=3.0)
    errors = []
    for budget in (100.0, 1e9):
        looks = count()
        model = sewfast.identify(data, model="grey_box", hidden=2, time_budget=budget)
        errors.append(model.validate(data).simulation.rmse)
        lost = model.training.get("time_budget", {}).get("lost", [])
        assert ("iterations of the fit" in lost) == (budget < 1e9)
    assert errors[0] < 0.5 * float(np.std(data.experiments[0].y))
    assert errors[1] <= 1.01 * errors[0]


def test_it_is_trained_further_alone_and_with_its_network() -> None:
    for hidden in (None, 2):
        early = sewfast.identify(
            _plant(1500, 5, 6e-5), model="grey_box", hidden=hidden, iterations=2, select=False
        )
        data = _plant(4000, 6, 6e-5)
        further = sewfast.identify(data, model=early)
        assert further.orders == early.orders
        assert further.training["trained_further"]
        rmse = [m.validate(data).simulation.rmse for m in (early, further)]
        assert rmse[1] < rmse[0]


@pytest.mark.parametrize("unit", ["min^-1", "U/min", "min⁻¹", "1/min", "tr/min", "r/min", "Rpm"])
def test_speeds_are_known_by_their_spellings(unit: str) -> None:
    data = _plant(1500, 2)
    other = Dataset.from_arrays(data.experiments[0].u, data.experiments[0].y, TS, output_unit=unit)
    models: Any = [sewfast.identify(d, model="grey_box", select=False) for d in (data, other)]
    np.testing.assert_array_equal(models[0].theta, models[1].theta)
