"""From a position to its speed: values, units, gaps, notes, and the option on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from sewfast.dataset import Dataset, FloatArray
from sewfast.dataset.rates import rate_unit
from sewfast.errors import DataError, SettingError

TS = 1e-3
N = 4000


def drive(seed: int = 0, n: int = N) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Command, speed [deg/s] and angle [deg] of a drive with gain 100 and 20 ms, exactly."""
    u = np.repeat(np.random.default_rng(seed).uniform(-3.0, 3.0, n // 50 + 1), 50)[:n]
    a, speed, angle = np.exp(-TS / 0.02), np.zeros(n), np.zeros(n)
    for k in range(1, n):
        speed[k] = a * speed[k - 1] + (1.0 - a) * 100.0 * u[k - 1]
        lag = 0.02 * (speed[k - 1] - 100.0 * u[k - 1]) * (1.0 - a)
        angle[k] = angle[k - 1] + 100.0 * u[k - 1] * TS + lag
    return u, speed, angle


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize(
    ("noise", "step", "wrong"), [(0.0, 0.0, 0.01), (0.05, 0.0, 0.06), (0.0, 0.1, 0.04)]
)
def test_the_speed_of_a_position(unit: float, noise: float, step: float, wrong: float) -> None:
    """A few percent whatever the sensor, in any unit; central differences have 22 and 31 %."""
    u, speed, angle = drive()
    y = angle + noise * np.random.default_rng(1).standard_normal(N) + 1e3
    y = np.round(y / step) * step if step else y
    data = Dataset.from_arrays(u, y * unit, TS)
    smoothed = data.differentiate().experiments[0].y / unit
    assert rms(smoothed - speed) < wrong * speed.std()
    if noise:
        assert rms(np.gradient(y, TS) - speed) > 3.0 * wrong * speed.std()
    # without delay: any shift is worse
    for shift in (-5, 5):
        assert rms(np.roll(smoothed, shift)[20:-20] - speed[20:-20]) > rms(smoothed - speed)


def test_methods() -> None:
    u, speed, angle = drive()
    data = Dataset.from_arrays(u, angle, TS)
    cubic = data.differentiate(method="savgol").experiments[0].y
    assert rms(cubic - speed) < 0.15 * speed.std()
    late = data.differentiate(method="difference")
    np.testing.assert_allclose(late.experiments[0].y[1:], np.diff(angle) / TS)
    assert not late.looks_ahead
    assert data.differentiate().looks_ahead
    with pytest.raises(SettingError, match="kalman, savgol, difference"):
        data.differentiate(method="cubic")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("unit", "rate"),
    [
        ("deg", "deg/s"), ("rad", "rad/s"), ("rev", "rev/s"), ("counts", "counts/s"), ("m", "m/s"),
        ("mm", "mm/s"), ("", ""), ("m/s", "m/s^2"), ("rad/s^2", "rad/s^3"), ("RPM", "RPM/s"),
    ],
)  # fmt: skip
def test_units(unit: str, rate: str) -> None:
    assert rate_unit(unit) == rate
    u, _, angle = drive()
    data = Dataset.from_arrays(u, angle, TS, output_unit=unit, output_name="angle")
    speed = data.differentiate()
    assert speed.output_unit == rate
    assert speed.output_name == "angle"
    assert speed.notes[-1].startswith("output angle differentiated")
    assert (f"to {rate} by a Kalman smoother" in speed.notes[-1]) == bool(rate)
    assert data.output_unit == unit


def test_gaps_stay_and_part_what_is_long() -> None:
    u, speed, angle = drive()
    y = angle.copy()
    y[::9] = np.nan
    y[1000:1200] = np.nan
    y[1203:1300] = np.nan
    data = Dataset.from_arrays(u, y, TS).differentiate()
    rate = data.experiments[0].y
    missing = np.isnan(y)
    missing[1200:1203] = True
    np.testing.assert_array_equal(np.isnan(rate), missing)
    assert rms(rate - speed) < 0.05 * speed.std()
    assert "3 outputs in short pieces lost" in data.notes[-1]
    for gone in (np.full(N, np.nan), np.where(np.arange(N) % 50 < 4, angle, np.nan)):
        with pytest.raises(DataError, match="5 samples in a row"):
            Dataset.from_arrays(u, gone, TS).differentiate()


def test_a_position_at_rest_has_no_speed() -> None:
    u, _, angle = drive()
    still = Dataset.from_arrays(u, np.full(N, 7.5), TS).differentiate()
    np.testing.assert_array_equal(still.experiments[0].y, 0.0)
    halted = angle - angle[1000]
    halted[:1000] = 0.0
    rate = Dataset.from_arrays(u, halted, TS).differentiate().experiments[0].y
    assert np.abs(rate[:950]).max() < 1e-3


def test_what_was_taken_off_becomes_a_speed_too() -> None:
    u, speed, angle = drive()
    data = Dataset.from_arrays(u, angle + 300.0 * TS * np.arange(N), TS)
    flat = data.detrend(1).differentiate()
    back = flat.restore([e.y for e in flat.experiments])[0]
    assert rms(back - speed - 300.0) < 0.02 * speed.std()


def test_a_model_of_the_speed_says_where_it_comes_from() -> None:
    u, speed, angle = drive()
    data = Dataset.from_arrays(u, np.round(angle * 10.0) / 10.0, TS, output_unit="deg")
    model = api.identify(data.differentiate(), model="oe", na=1, nb=1)
    assert model.output_unit == "deg/s"
    assert "Kalman smoother" in model.training["preparation"][0]
    truth = Dataset.from_arrays(u, speed, TS, output_unit="deg/s")
    assert model.validate(truth).simulation.fit_percent > 97.0
    with pytest.raises(DataError, match="'deg/s'"):
        model.validate(data)


def test_on_the_command_line(tmp_path: Path) -> None:
    """Found by look, taken by identify, asked for again by validate."""
    for name, seed in (("one", 0), ("two", 1)):
        u, _, angle = drive(seed)
        columns = {"t": TS * np.arange(N), "u": u, "angle": np.round(angle, 1)}
        api.write_table(
            tmp_path / f"{name}.csv", columns, units={"t": "s", "u": "V", "angle": "deg"}
        )
    source = ("one.csv", "--input", "u", "--output", "angle")
    look = sewfast(tmp_path, "look", *source).out
    assert "angle [deg] integrates what u drives, as a position does" in look
    assert "--differentiate" in look
    assert "resample" not in look
    look = sewfast(tmp_path, "look", *source, "--differentiate").out
    assert "integrates" not in look
    assert "output angle [deg/s]" in look
    found = json.loads(sewfast(tmp_path, "look", *source, "--json").out)
    assert [f["kind"] for f in found["findings"]] == ["integrator"]

    options = ("--differentiate", "--resample", "0.002", "--model", "oe")
    done = sewfast(tmp_path, "identify", *source, *options, "-o", "m.json")
    assert "differentiated from deg to deg/s" in done.err
    model = api.load_model(tmp_path / "m.json")
    assert model.output_unit == "deg/s"
    assert "differentiated" in model.training["preparation"][0]
    options = ("--differentiate", "--resample", "0.002")
    done = sewfast(tmp_path, "validate", "m.json", "two.csv", *options, "--json")
    assert json.loads(done.out)["simulation"]["fit_percent"] > 95.0
    assert "'deg/s'" in refused(tmp_path, "validate", "m.json", "two.csv", "--resample", "0.002")
    sewfast(tmp_path, "check", "m.json", "two.csv", *options, "--training", "one.csv")
