"""The Hammerstein-Wiener model: what it finds, its structure, its file, its refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import called as command
from sewfast import Dataset, _core
from sewfast.errors import Interrupted, ModelFileError, SettingError
from sewfast.identification import lagged
from sewfast.models.hammerstein import HammersteinWiener

TS = 0.01


def _levels(n: int, seed: int) -> Any:
    drawn = np.random.default_rng(seed).uniform(-1.0, 1.0, n // 12 + 1)
    return np.repeat(drawn, 12)[:n]


def _band(u: Any) -> Any:
    """A dead band."""
    return u - np.clip(u, -0.25, 0.25)


def _sensor(x: Any) -> Any:
    """Flattens towards both ends."""
    return 30.0 * np.tanh(x / 20.0)


def _plant(
    n: int, seed: int, *, before: Any = None, behind: Any = None, noise: float = 0.05
) -> Dataset:
    u, x = _levels(n, seed), np.zeros(n)
    w = u if before is None else before(u)
    for k in range(2, n):
        x[k] = 1.5 * x[k - 1] - 0.56 * x[k - 2] + 2.0 * w[k - 1] + 0.5 * w[k - 2]
    y = x if behind is None else behind(x)
    y = y + noise * np.random.default_rng(seed + 100).normal(size=n)
    return Dataset.from_arrays(
        u, y, TS, input_names=("u",), input_units=("V",), output_name="y", output_unit="RPM"
    )


@pytest.mark.nightly(
    "every structure, three seeds",
    by_day=["_band-None-structure0-1", "None-_sensor-structure1-2", "_band-_sensor-structure2-3"],
)
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("before", "behind", "structure"),
    [
        (_band, None, {"input_pieces": 8}),
        (None, _sensor, {"output_pieces": 8}),
        (_band, _sensor, {"input_pieces": 8, "output_pieces": 8}),
    ],
)
def test_a_curve_is_found_where_the_plant_has_one(
    seed: int, before: Any, behind: Any, structure: dict[str, int]
) -> None:
    data = _plant(3000, seed, before=before, behind=behind)
    fresh = _plant(1500, seed + 50, before=before, behind=behind)
    model: Any = sewfast.identify(data, model="hammerstein-wiener", seed=0)
    line: Any = sewfast.identify(data, model="oe", seed=0)
    assert isinstance(model, HammersteinWiener)
    assert structure.items() <= model.training["structure"].items()
    own, linear = (m.validate(fresh).simulation.rmse for m in (model, line))
    assert own < 0.5 * linear
    curve = model.characteristics()[0]
    if before is not None:
        flat = np.abs(curve.x) < 0.2
        steep = np.diff(curve.y) / np.diff(curve.x)
        assert np.abs(steep[flat[1:] & flat[:-1]]).max() < 0.5


def test_linear_data_give_the_plainest_structure_and_straight_curves() -> None:
    model: Any = sewfast.identify(_plant(2000, 5), model="hammerstein_wiener")
    assert model.training["structure"] == {"input_pieces": 8, "output_pieces": 1}
    curve = model.characteristics()[0]
    assert np.abs(curve.y - curve.x).max() < 0.02 * np.ptp(curve.x)
    assert [t["input_pieces"] for t in model.training["tried"]] == [8, 1, 8, 8]


def test_pieces_are_as_many_as_asked_for_and_validation_data_choose() -> None:
    data, other = _plant(1500, 6, before=_band), _plant(800, 7, before=_band)
    model: Any = sewfast.identify(data, model="hammerstein-wiener", hidden=4, validation=other)
    assert model.orders["input_pieces"] == 4
    assert model.orders["output_pieces"] == 1
    assert len(model.theta) == len(model.parameter_names) == 2 + 2 + 1 + 3
    assert "curve of u: off by up to" in str(model)


def _first_order(seed: int) -> Dataset:
    u = np.repeat(np.random.default_rng(seed).uniform(-5.0, 5.0, 215), 7)[:1500]
    y = np.zeros(1500)
    for k in range(1, 1500):
        y[k] = 0.9 * y[k - 1] + 0.3 * np.tanh(u[k - 1] / 2.0)
    return Dataset.from_arrays(u, y + 0.01 * np.random.default_rng(seed + 1).normal(size=1500), TS)


def test_a_pole_to_spare_is_left_out_unless_the_order_is_given() -> None:
    for seed in (104, 109):
        model: Any = sewfast.identify(_first_order(seed), model="hammerstein-wiener")
        assert model.orders["na"] == 1
        assert -model.theta[0] == pytest.approx(0.9, abs=0.01)
    asked: Any = sewfast.identify(_first_order(104), model="hammerstein-wiener", na=2)
    assert asked.orders["na"] == 2
    second: Any = sewfast.identify(_plant(1500, 6, before=_band), model="hammerstein-wiener")
    assert second.orders["na"] == 2


def test_gaps_and_weights_are_heeded() -> None:
    data = _plant(2000, 8, before=_band)
    e = data.experiments[0]
    y = e.y.copy()
    y[500:700] = np.nan
    spoilt = y.copy()
    spoilt[1000:1100] += 50.0
    weights = np.ones(2000)
    weights[1000:1100] = 0.0
    weighed = Dataset.from_arrays(e.u, spoilt, TS, weights=weights)
    model: Any = sewfast.identify(weighed, model="hammerstein-wiener", hidden=4)
    clean: Any = sewfast.identify(
        Dataset.from_arrays(e.u, y, TS), model="hammerstein-wiener", hidden=4
    )
    fresh = _plant(1000, 9, before=_band).experiments[0]
    runs = [m.simulate(fresh.u) for m in (model, clean)]
    assert np.sqrt(np.mean((runs[0] - runs[1]) ** 2)) < 0.02 * np.ptp(fresh.y)


def test_a_file_with_a_wrong_number_says_which_field(tmp_path: Path) -> None:
    model: Any = sewfast.identify(
        _plant(800, 10, before=_band), model="hammerstein-wiener", hidden=3
    )
    path = tmp_path / "m.json"
    model.save(path)
    values = json.loads(path.read_text())
    for change in ({"input_low": [1.0, 2.0]}, {"theta": [0.0]}, {"x_high": -1e9}):
        broken = {**values, "parameters": {**values["parameters"], **change}}
        path.write_text(json.dumps(broken))
        with pytest.raises(ModelFileError, match=r"parameters|n_inputs"):
            sewfast.load_model(path)


def test_what_it_cannot_do_is_said() -> None:
    model: Any = sewfast.identify(
        _plant(800, 11, before=_band), model="hammerstein-wiener", hidden=3
    )
    with pytest.raises(SettingError, match="no form for microcontrollers"):
        model.core.embedded()
    with pytest.raises(SettingError, match="nx"):
        sewfast.identify(_plant(800, 11), model="hammerstein-wiener", nx=2)
    with pytest.raises(SettingError, match="pieces"):
        sewfast.identify(_plant(800, 11), model="hammerstein-wiener", hidden=1000)


def test_a_seed_and_threads_change_nothing() -> None:
    data = _plant(1000, 12, before=_band, behind=_sensor)
    options: Any = {"model": "hammerstein-wiener", "hidden": 4}
    one, two = (sewfast.identify(data, threads=t, seed=s, **options) for t, s in ((1, 0), (2, 5)))
    np.testing.assert_array_equal(one.theta, two.theta)


def test_an_interrupt_of_the_choice_hands_over_the_best_so_far(tmp_path: Path) -> None:
    fits, last = 0, 0

    def progress(done: int, total: int, best: float) -> None:
        nonlocal fits, last
        fits += done < last
        last = done
        if fits == 2:
            raise KeyboardInterrupt

    data = _plant(800, 14, before=_band)
    with pytest.raises(Interrupted) as caught:
        sewfast.identify(data, model="hammerstein-wiener", progress=progress)
    best = caught.value.best
    assert best.kind == "hammerstein_wiener"
    assert len(best.training["tried"]) >= 1
    best.save(tmp_path / "m.json")
    assert sewfast.load_model(tmp_path / "m.json").training == best.training


def test_a_budget_that_ends_the_choice_leaves_time_for_a_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lagged, "SHARES", replace(lagged.SHARES, choice=1e-9))
    data = _plant(800, 14, before=_band)
    model = sewfast.identify(data, model="hammerstein-wiener", time_budget=600.0)
    assert model.training["tried"] == []
    assert "structures" in model.training["time_budget"]["lost"]
    assert sewfast.validate(model, data).simulation.fit_percent > 90.0


def test_the_command_line_makes_and_uses_one(tmp_path: Path) -> None:
    e = _plant(1500, 13, before=_band).experiments[0]
    columns = {"t": TS * np.arange(1500), "u": e.u[:, 0], "y": e.y}
    sewfast.write_table(tmp_path / "run.csv", columns, units={"u": "V", "y": "RPM"})
    made = command(
        tmp_path, "identify", "run.csv", "--input", "u", "--output", "y",
        "--model", "hammerstein-wiener", "-o", "m.json",
    )  # fmt: skip
    assert "Hammerstein-Wiener" in made.out
    assert "verdict: " in command(tmp_path, "validate", "m.json", "run.csv").out
    assert "hammerstein-wiener" in command(tmp_path, "identify", "--help").out


def test_the_core_refuses_what_is_no_model() -> None:
    one = np.zeros(1)
    settings: Any = {
        "na": 1, "nb": 1, "nk": 1, "input_low": one, "input_high": one + 1.0, "input_pieces": 2,
        "x_low": 0.0, "x_high": 1.0, "output_pieces": 2, "theta": np.zeros(5),
    }  # fmt: skip
    assert _core.HammersteinWiener(**settings).settings["x_high"] == 1.0
    for change, words in (
        ({"theta": np.zeros(4)}, "5 parameters"), ({"input_high": one}, "input that moves"),
        ({"x_high": np.nan}, "output"), ({"output_pieces": 0}, "pieces"),
        ({"theta": np.full(5, np.inf)}, "finite"),
    ):  # fmt: skip
        with pytest.raises(SettingError, match=words):
            _core.HammersteinWiener(**{**settings, **change})


def test_it_is_not_trained_further_alone_or_in_an_ensemble() -> None:
    data = _plant(400, 1, before=_band)
    model = sewfast.identify(data, model="hammerstein_wiener", hidden=2, iterations=5)
    linear = sewfast.identify(data, model="oe")
    for given in (model, sewfast.Ensemble.of([linear, model])):
        with pytest.raises(SettingError) as refused:
            sewfast.identify(data, model=given)
        assert refused.value.name == "model"
        assert "Hammerstein-Wiener" in str(refused.value.received)
        assert "identify it anew" in str(refused.value.remedy)
