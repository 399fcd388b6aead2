"""What a summary of data says: every number, every piece of advice, `sewfast look`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from sewfast.dataset import Dataset
from sewfast.dataset.outliers import band, power_spectrum, usual_threshold
from sewfast.dataset.summary import nice
from sewfast.errors import SettingError

N, TS = 20_000, 1e-3
T = np.arange(N) * TS


def advice(u: Any, y: Any, Ts: float = TS) -> str:
    return "\n".join(Dataset.from_arrays(u, y, Ts).summary().advice)


def excited(seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).standard_normal(N // 10), 10)


def test_the_numbers_of_a_column() -> None:
    random = np.random.default_rng(0)
    y = 30.0 + 8.0 * np.sin(2 * np.pi * 7.0 * T) + 0.5 * T + 0.1 * random.standard_normal(N)
    y[100:110] = np.nan
    y[500] = np.nan
    u = np.round(5.0 * np.sin(2 * np.pi * 3.0 * T)) * 0.25
    found = Dataset.from_arrays(u, y, TS, output_name="speed", output_unit="RPM").summary()
    uc, yc = found.columns
    assert (yc.n, yc.missing, yc.gaps, yc.longest_gap) == (N, 11, 2, 10)
    assert yc.low == np.nanmin(y)
    assert yc.mean == pytest.approx(np.nanmean(y))
    assert yc.std == pytest.approx(np.nanstd(y))
    # the line of seven whole waves in a second is 0.5 a second, but for the waves' own share
    assert yc.trend == pytest.approx(0.5 * 20, abs=0.2)
    assert yc.quantum is None
    assert uc.quantum == pytest.approx(0.25, rel=1e-9)
    # 20,000 third differences fix the noise to about a percent
    assert yc.noise == pytest.approx(0.1, rel=0.05)
    assert yc.band is not None
    assert yc.band[0] <= 7.0 <= yc.band[1] < 8.0
    assert uc.at_high == pytest.approx(np.mean(u == u.max()), abs=1e-12)
    assert "output speed [RPM]" in str(found)
    assert found.to_json()["columns"][1]["missing"] == 11
    json.dumps(found.to_json(), allow_nan=False)


def test_the_spectrum_holds_the_power() -> None:
    wave = 3.0 * np.sin(2 * np.pi * 50.0 * T)
    frequency, power = power_spectrum([wave, wave[:5000]], TS)
    assert power.sum() * (frequency[1] - frequency[0]) == pytest.approx(4.5, rel=0.01)
    assert band(frequency, power) == pytest.approx((50.0, 50.0), abs=0.5)
    white = np.random.default_rng(0).standard_normal(N)
    low, high = band(*power_spectrum([white], TS)) or (0.0, 0.0)
    assert (low, high) == pytest.approx((25.0, 475.0), abs=10.0)
    assert len(power_spectrum([wave[:31]], TS)[0]) == 0


@pytest.mark.parametrize(
    ("u", "y", "words"),
    [
        (np.where(T[7] == T, np.nan, excited()), excited(1), "u is not known at 1 samples"),
        (excited(), np.where(T < 1.0, np.nan, excited(1)), "not measured at 1000 samples (5.0%)"),
        (excited(), np.full(N, np.nan), "nothing is known of y"),
        (np.ones(N), excited(1), "u is constant at 1"),
        (excited(), np.minimum(excited(1), 0.5), "y stays at 0.5 for 3"),
        (excited(), np.random.default_rng(0).standard_normal(N), "of what y does: excite"),
        (excited(), np.sin(T), "data.resample"),
        (excited(), np.where(T[7] == T, np.inf, excited(1)), "1 value of y is infinite"),
        (
            excited(),
            np.sin(9 * T) + 5.0 * (T[777] == T),
            "1 value of y stands out from its neighbours, at sample 777:",
        ),
        (excited()[:300], excited(1)[:300], "300 samples are few"),
        (excited(), np.sin(2 * np.pi * 300 * T), "close to half the sampling rate"),
    ],
)
def test_each_finding_has_its_advice(u: Any, y: Any, words: str) -> None:
    assert words in advice(u, y)


@pytest.mark.nightly("a million samples")
def test_chance_makes_no_outliers_of_a_long_record() -> None:
    """The threshold grows with the record, and a spike of 30 deviations still stands out."""
    n = 1_000_000
    y = 0.01 * np.random.default_rng(0).standard_normal(n) + np.sin(np.arange(n) / 300)
    y[234_567] += 0.3
    data = Dataset.from_arrays(np.repeat(excited(), 50), y, TS)
    assert usual_threshold(data[:20_000]) == 6.0
    assert usual_threshold(data) == pytest.approx(7.27, abs=0.01)
    assert data.summary().outliers_at == (("array", 234_567),)


def test_a_position_is_not_to_be_resampled_for_its_slow_spectrum() -> None:
    u = excited()
    angle = np.cumsum(np.convolve(u, np.exp(-np.arange(100) / 20), "full")[:N])
    found = Dataset.from_arrays(u, angle, TS).summary()
    assert found.diagnosis.find("integrator") is not None
    assert not any("resample" in line for line in found.advice)
    assert "as a position does" in str(found)
    json.dumps(found.to_json(), allow_nan=False)


def answer(u: np.ndarray) -> np.ndarray:
    """A lag of 20 samples, from the sample after the input on."""
    return np.convolve(u, np.r_[0.0, np.exp(-np.arange(100) / 20)], "full")[: len(u)]


def test_good_data_need_no_advice() -> None:
    u = excited()
    y = answer(u)
    y += 0.02 * np.random.default_rng(3).standard_normal(N)
    assert advice(u, y) == ""
    assert "nothing stands in the way" in str(Dataset.from_arrays(u, y, TS).summary())


def test_round_numbers() -> None:
    assert [nice(v) for v in (0.0199, 0.02, 7.0, 1.0)] == [0.01, 0.02, 5.0, 1.0]


values = st.floats(width=64) | st.sampled_from([0.0, 1.0, np.nan, np.inf, 1e308, -1e308, 5e-324])


@settings(deadline=None, max_examples=150)
@given(st.data(), st.integers(1, 80), st.integers(1, 2))
def test_a_summary_of_anything(draw: st.DataObject, n: int, inputs: int) -> None:
    u = draw.draw(hnp.arrays(np.float64, (n, inputs), elements=values))
    y = draw.draw(hnp.arrays(np.float64, n, elements=values))
    found = Dataset.from_arrays(u, y, 0.01).summary()
    assert len(found.columns) == inputs + 1
    assert str(found)
    json.dumps(found.to_json(), allow_nan=False)


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    u = excited()[:2000]
    y = answer(u)
    y[300:350] = np.nan
    y[700] += 500.0
    u[900:905] = np.nan
    columns = {"t": T[:2000], "u": u, "speed": y}
    api.write_table(tmp_path / "run.csv", columns, units={"t": "s", "u": "V", "speed": "RPM"})
    return tmp_path


def test_look_says_what_is_in_recognised_columns_and_lists_those_in_doubt(folder: Path) -> None:
    text = sewfast(folder, "look", "run.csv:u:speed").out
    assert sewfast(folder, "look", "run.csv").out == text
    assert "output speed [RPM]" in text
    assert "50 in 1 gaps" in text
    assert "1 value of speed stands out from its neighbours, at sample 700" in text
    assert "--mask outliers" in text
    taken = sewfast(folder, "look", "run.csv:u:speed", "--mask", "outliers")
    assert "stands out" not in taken.out
    assert "1 outputs stand out" in taken.err
    assert "--hold-inputs" in text
    found = json.loads(
        sewfast(folder, "look", "run.csv", "--input", "u", "--output", "speed", "--json").out
    )
    assert found["columns"][0]["missing"] == 5
    assert found["outliers"] == 1
    assert found["outliers_at"] == [{"experiment": "run.csv", "sample": 700}]
    assert [f["kind"] for f in found["findings"]] == ["spike"]
    assert json.loads(sewfast(folder, "look", "run.csv", "--json").out) == found
    columns = {"t": T[:2000], "a": np.sin(T[:2000]), "b": T[:2000] ** 2}
    api.write_table(folder / "doubt.csv", columns, units={"a": "1", "b": "2"})
    listed = sewfast(folder, "look", "doubt.csv").out
    assert "--input COL --output COL" in listed
    assert "b [2]" in listed
    columns = json.loads(sewfast(folder, "look", "doubt.csv", "--json").out)["doubt.csv"]
    assert [c["name"] for c in columns] == ["t", "a", "b"]


def test_look_draws(folder: Path) -> None:
    pytest.importorskip("matplotlib")
    printed = sewfast(folder, "look", "run.csv:u:speed", "--plot", "look.png").out
    assert "written to look.png" in printed
    assert (folder / "look.png").read_bytes().startswith(b"\x89PNG")
    assert ".png" in refused(folder, "look", "run.csv:u:speed", "--plot", "look.doc")
    (folder / "other.csv").write_text("t,left,right\n" + "".join(f"{k},1,2\n" for k in range(50)))
    assert "which column" in refused(folder, "look", "other.csv", "--plot", "other.png")
    with pytest.raises(SettingError, match="folder that exists"):
        Dataset.from_arrays(T, T, TS).summary().plot(file=folder / "nowhere" / "look.png")


def test_a_model_from_prepared_data(folder: Path) -> None:
    options = ("--hold-inputs", "--mask", "700:701", "--resample", "0.002", "--model", "arx")
    options += ("--train", "0:1500", "--validate", "1500:2000", "--detrend", "0")
    done = sewfast(folder, "identify", "run.csv:u:speed", *options, "-o", "m.json")
    model = api.load_model(folder / "m.json")
    assert model.Ts == 0.002
    told = "\n".join(model.training["preparation"])
    for words in ("1 outputs masked", "held", "resampled from", "mean of all experiments taken"):
        assert words in told
        assert words in done.err
    assert model.training["samples"] == 750
    options = ("--hold-inputs", "--resample", "0.002")
    assert "m.json" not in sewfast(folder, "validate", "m.json", "run.csv", *options).err
    assert "sample 900" in refused(folder, "identify", "run.csv:u:speed", "-o", "x.json")
    assert "0.001" in refused(folder, "validate", "m.json", "run.csv", "--hold-inputs")


def test_simulate_holds_inputs(folder: Path) -> None:
    sewfast(
        folder, "identify", "run.csv:u:speed", "--hold-inputs", "--model", "arx", "-o", "m.json"
    )
    assert "sample 900" in refused(folder, "simulate", "m.json", "run.csv", "-o", "p.csv")
    done = sewfast(folder, "simulate", "m.json", "run.csv", "--hold-inputs", "-o", "p.csv")
    assert "held" in done.err
    assert len(api.read_table(folder / "p.csv")["y_hat"]) == 2000
