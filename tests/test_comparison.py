"""`compare`: several models on the same data."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import sewfast
from cli import call_refused as refused
from cli import called as command
from plants import bent_data, linear_data
from sewfast import Dataset, Model, SettingError, _core
from sewfast.models import LinearOE

HELD = bent_data(500, noise=0.05)


@cache
def models() -> tuple[Model, Model]:
    train = linear_data(600, noise=0.2)
    return sewfast.identify(train, model="arx"), sewfast.identify(train, model="oe")


def unstable() -> Model:
    core = _core.LinearModel(np.array([-1.5]), np.array([[0.1]]), 1, 0.0)
    return LinearOE(core, HELD.Ts, ("u",), "y", HELD.input_units, HELD.output_unit)


def test_scores_are_those_of_validate() -> None:
    arx, oe = models()
    data = linear_data(300, seed=9, noise=0.2)
    found = sewfast.compare(arx, oe, data)
    assert found.names == ("arx", "oe")
    assert found["oe"].simulation == sewfast.validate(oe, data).simulation
    assert found.parameters == (len(arx.theta), len(oe.theta))
    errors = [found[name].simulation.rmse for name in found.names]
    assert found.best == found.names[int(np.argmin(errors))]
    assert f"{found['arx'].simulation.fit_percent:.2f}" in str(found)
    assert str(found).splitlines()[-1] == f"smallest free-run error: {found.best}"
    assert found.to_json()["models"][1]["scores"]["n"] == 280
    assert "<table>" in found._repr_html_()
    again = sewfast.compare({"one": arx, "two": oe}, data=data, init=0)
    assert again.names == ("one", "two")
    assert again["one"].n == 300
    assert sewfast.compare(oe, oe, data).names == ("oe 1", "oe 2")


def test_a_model_that_runs_away_is_a_row() -> None:
    long = Dataset.from_arrays(
        np.ones(3000), np.ones(3000), HELD.Ts, input_units="V", output_unit="RPM"
    )
    wild = sewfast.Ensemble.of([unstable(), unstable()])
    found = sewfast.compare({"wild": wild, "calm": models()[1]}, long)
    assert found.validations[0] is None
    assert found.best == "calm"
    assert "runs away" in str(found)
    with pytest.raises(KeyError, match="calm"):
        found["wild"]
    alone = sewfast.compare(wild, long)
    assert (alone.best, alone.to_json()["best"]) == ("", None)
    pytest.importorskip("matplotlib", reason="needs the report extra")
    with pytest.raises(SettingError, match="all diverge"):
        alone.plot()


def test_what_is_no_model_or_no_data_is_refused() -> None:
    arx, _ = models()
    with pytest.raises(SettingError, match="expected a Dataset"):
        sewfast.compare(arx, arx)
    with pytest.raises(SettingError, match="one model or more"):
        sewfast.compare(HELD)
    with pytest.raises(SettingError, match="got str"):
        sewfast.compare(arx, "oe", HELD)  # type: ignore[arg-type]


def test_the_command_compares_and_draws(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    for model, name in zip(models(), ("arx.json", "oe.json"), strict=True):
        model.save(tmp_path / name)
    data = linear_data(300, seed=9, noise=0.2)
    e = data.experiments[0]
    columns = {"t": data.Ts * np.arange(len(e)), "u": e.u[:, 0], data.output_name: e.y}
    units = {"u": "V", data.output_name: "RPM"}
    sewfast.write_table(tmp_path / "other.csv", columns, units=units)
    said = command(tmp_path, "compare", "arx.json", "oe.json", "other.csv", "--plot", "both.png")
    assert "smallest free-run error" in said.out
    assert (tmp_path / "both.png").read_bytes().startswith(b"\x89PNG")
    found = command(tmp_path, "compare", "arx.json", "oe.json", "other.csv", "--json").json()
    assert [m["name"] for m in found["models"]] == ["arx", "oe"]
    assert "twice" in refused(tmp_path, "compare", "oe.json", "oe.json", "other.csv")
