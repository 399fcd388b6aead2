"""Equations of one's own: parameters, what the record cannot part, refusals, files without code."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_physics import linear

import sewfast
from sewfast import physics
from sewfast.errors import DataError, FitError, ModelFileError, SettingError
from sewfast.greybox import EquationFit, load_equations

STARTS = {"kv": 0.01, "ka": 0.01, "ks": (0.1, 0.0, 5.0)}


def motor(x: Any, u: Any, p: Any) -> Any:
    return [(u - p["kv"] * x[0] - p["ks"] * np.tanh(x[0])) / p["ka"]]


def scalar(x: Any, u: Any, p: Any) -> Any:
    """The same, which takes numbers only."""
    return (u - p["kv"] * x[0] - p["ks"] * math.tanh(x[0])) / p["ka"]


def data(n: int = 400, noise: float = 1.0, seed: int = 0) -> sewfast.Dataset:
    u, y = linear(n, seed=seed, noise=noise)
    return sewfast.Dataset.from_arrays(u, y, 0.02, output_unit="rad/s")


@pytest.fixture(scope="module")
def fitted() -> EquationFit:
    return physics(data(), equations=motor, parameters=STARTS)


def test_the_parameters_are_found_with_intervals(fitted: EquationFit) -> None:
    for name, true in {"kv": 0.02, "ka": 0.006, "ks": 0.3}.items():
        found = fitted.parameters[name]
        assert found.value == pytest.approx(true, rel=0.05), name
        assert found.low < found.value < found.high
    assert fitted.converged
    assert fitted.fit_percent > 98.0
    assert fitted.equations_name == f"{__name__}.motor"
    assert "kv" in str(fitted)
    assert "kv" in fitted._repr_html_()


def test_a_function_of_numbers_gives_what_one_of_arrays_does(fitted: EquationFit) -> None:
    one = physics(data(), equations=scalar, parameters=STARTS)
    assert one.values == pytest.approx(fitted.values, rel=1e-6)


def test_a_second_state_is_the_winding() -> None:
    """Against small steps of Euler's, with a current that lags by 30 ms."""
    u, _ = linear(300)
    truth = {"kv": 0.02, "ka": 0.006, "tau": 0.03}

    def lagging(x: Any, u: Any, p: Any) -> Any:
        return np.stack([x[1] / p["ka"], (u - x[1] - p["kv"] * x[0]) / p["tau"]])

    w, drive, y = 0.0, 0.0, np.empty(len(u))
    for k, command in enumerate(u):
        y[k] = w
        for _ in range(200):
            w, drive = (
                w + 1e-4 * drive / truth["ka"],
                drive + 1e-4 * (command - drive - truth["kv"] * w) / truth["tau"],
            )
    noisy = y + 0.3 * np.random.default_rng(2).standard_normal(len(y))
    record = sewfast.Dataset.from_arrays(u, noisy, 0.02, output_unit="rad/s")
    fit = physics(
        record, equations=lagging, states=2,
        parameters={"kv": 0.015, "ka": 0.008, "tau": (0.05, 0.005, 1.0)}, substeps=2,
    )  # fmt: skip
    for name, true in truth.items():
        assert fit.value(name) == pytest.approx(true, rel=0.02), name


@pytest.mark.nightly("counts coverage over many records")
def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    def plain(x: Any, u: Any, p: Any) -> Any:
        return (u - p["kv"] * x) / p["ka"]

    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-8, 8, 12), 20)
    a = math.exp(-0.02 * 0.02 / 0.006)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = a * y[k - 1] + (1 - a) * u[k - 1] / 0.02
    inside = 0
    for _ in range(20):
        noisy = y + 3.0 * rng.standard_normal(len(y))
        record = sewfast.Dataset.from_arrays(u, noisy, 0.02, output_unit="rad/s")
        fit = physics(record, equations=plain, parameters={"kv": 0.03, "ka": 0.01})
        kv, ka = fit.parameters["kv"], fit.parameters["ka"]
        inside += (kv.low <= 0.02 <= kv.high) + (ka.low <= 0.006 <= ka.high)
    # 38 of 40 are 95 %; below 33 has a probability of 1 %
    assert inside >= 33


def test_what_only_a_ratio_shows_is_named_with_its_partners() -> None:
    fit = physics(
        data(), parameters={"K": 0.01, "R": 1.0, "kv": 0.01, "z": 1.0},
        equations=lambda x, u, p: p["K"] / p["R"] * (u - p["kv"] * x[0]) / 6e-5 + 0.0 * p["z"],
    )  # fmt: skip
    assert set(fit.parameters) == {"kv"}
    assert "R" in fit.undetermined["K"]
    assert "K" in fit.undetermined["R"]
    assert fit.undetermined["z"] == "the free run does not depend on it"
    with pytest.raises(DataError, match="combinations"):
        fit.value("K")
    with pytest.raises(DataError, match="kv"):
        fit.value("J")


# --- What is refused ------------------------------------------------------------------------------


def raising(x: Any, u: Any, p: Any) -> Any:
    raise ValueError("no such regime")


@pytest.mark.parametrize(
    ("arguments", "error", "name", "received"),
    [
        ({"equations": "motor"}, SettingError, "equations", "'motor'"),
        ({"equations": lambda x, u, p: [0.0, 0.0]}, SettingError, "equations", "(2,)"),
        ({"equations": lambda x, u, p: "fast"}, SettingError, "equations", "str"),
        ({"equations": lambda x, u, p: None}, FitError, "equations", "nan"),
        ({"equations": lambda x, u, p: math.nan * x}, FitError, "equations", "nan"),
        ({"equations": raising}, FitError, "equations", "no such regime"),
        ({"equations": lambda x, u, p: 1e9 * x + u * p["kv"]}, FitError, "equations", "NaN"),
        ({"parameters": {}}, SettingError, "parameters", "{}"),
        ({"parameters": {"kv": "large"}}, SettingError, "kv", "'large'"),
        ({"parameters": {"kv": (2.0, 0.0, 1.0)}}, SettingError, "kv", "2.0"),
        ({"parameters": {"kv": (1.0, 1.0, 1.0)}}, SettingError, "kv", "1.0"),
        ({"parameters": {**STARTS, "kv": (0.03, 0.025, 1.0)}}, FitError, "kv", "lower"),
        ({"states": 0}, SettingError, "states", "0"),
        ({"substeps": 1.5}, SettingError, "substeps", "1.5"),
        ({"current": np.zeros(400)}, SettingError, "equations", "other arguments"),
        ({"parameters": None}, SettingError, "equations", "one of the two"),
    ],
)
def test_what_cannot_be_fitted_is_refused_by_name(
    arguments: dict[str, Any], error: type, name: str, received: str
) -> None:
    with pytest.raises(error) as caught:
        physics(data(), **{"equations": motor, "parameters": STARTS, **arguments})
    assert caught.value.name == name  # type: ignore[attr-defined]
    assert received in str(caught.value.received)  # type: ignore[attr-defined]


def test_a_function_that_raises_on_the_way_is_named_with_its_cause() -> None:
    def fragile(x: Any, u: Any, p: Any) -> Any:
        if float(np.max(p["kv"])) > 0.0101:
            raise OverflowError("too large")
        return motor(x, u, p)

    with pytest.raises(FitError, match="OverflowError: too large") as caught:
        physics(data(), equations=fragile, parameters=STARTS)
    assert isinstance(caught.value.__cause__, OverflowError)


# --- Files ----------------------------------------------------------------------------------------


def test_a_file_holds_the_parameters_and_no_code(fitted: EquationFit, tmp_path: Path) -> None:
    path = tmp_path / "fit.json"
    fitted.save(path)
    assert "tanh" not in path.read_text()
    again = load_equations(path)
    assert again.to_dict() == fitted.to_dict()
    with pytest.raises(SettingError) as caught:
        again.simulate(np.ones(10))
    assert caught.value.name == "equations"
    assert "with_equations" in str(caught.value.remedy)
    u = np.repeat([3.0, -2.0], 100)
    whole = again.with_equations(motor)
    assert np.array_equal(whole.simulate(u), fitted.simulate(u))
    assert whole.simulate(u, speed=50.0)[0] == 50.0
    with pytest.raises(SettingError):
        again.with_equations("motor")  # type: ignore[arg-type]
    stored = json.loads(path.read_text())
    for change in (
        {"version": 2},
        {"values": {"kv": "x"}},
        {"parameters": {"kv": {"value": 1.0}}},
        {"states": 0},
        {"speed_unit": "furlongs"},
        {"code": "import os"},
    ):
        path.write_text(json.dumps({**stored, **change}))
        with pytest.raises(ModelFileError):
            load_equations(path)
