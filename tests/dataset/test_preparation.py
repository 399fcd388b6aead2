"""Preparation of data: trends, sample times, parts, outliers; nothing of the caller's changes."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sewfast import _core, identify
from sewfast.dataset import Dataset, FloatArray
from sewfast.errors import DataError, SettingError, SewfastError

TAU, TS = 0.05, 1e-3


def lag(u: FloatArray, Ts: float = TS) -> FloatArray:
    """A first-order lag of gain 2, exactly, for an input that is held."""
    a = np.exp(-Ts / TAU)
    model = _core.LinearModel(np.array([-a]), np.array([[2.0 * (1.0 - a)]]), 1, 0.0)
    return model.simulate(np.ascontiguousarray(u[:, None]), np.zeros(1))


def steps(n: int, hold: int, seed: int = 0) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).standard_normal(-(-n // hold)), hold)[:n]


def two_runs() -> Dataset:
    """Two experiments of two inputs, about an operating point, with a gap."""
    random = np.random.default_rng(1)
    runs = []
    for n in (300, 200):
        u = random.standard_normal((n, 2)) + np.array([5.0, -3.0])
        y = 100.0 + np.cumsum(u[:, 0] - 5.0)
        y[40:50] = np.nan
        runs.append(Dataset.from_arrays(u, y, TS, name=f"run{n}", channels={"truth": y + 1.0}))
    return Dataset.concat(runs)


# --- trends ---------------------------------------------------------------------------------------


def test_order_0_takes_one_operating_point_off_all_experiments() -> None:
    data = two_runs()
    flat = data.detrend(0)
    for i, column in enumerate(("u", "y")):
        before = np.concatenate([getattr(e, column) for e in data.experiments])
        after = np.concatenate([getattr(e, column) for e in flat.experiments])
        assert np.abs(np.nanmean(after, axis=0)).max() < 1e-12
        np.testing.assert_allclose(
            before - after, (np.nanmean(before, axis=0) + 0.0 * before), err_msg=str(i)
        )
    np.testing.assert_array_equal(
        flat.experiments[0].channels["truth"], data.experiments[0].channels["truth"]
    )
    assert len(flat.notes) == 2
    assert "mean of all experiments taken off, u1 " in flat.notes[0]


@pytest.mark.parametrize("order", [0, 1, "steady"])
def test_what_was_taken_off_is_put_back(order: Any) -> None:
    data = two_runs()
    if order == "steady":
        rest = np.zeros((40, 2)) + np.array([5.0, -3.0])
        data = Dataset.concat(
            [
                Dataset.from_arrays(np.vstack([rest, e.u]), np.r_[np.full(40, 100.0), e.y], TS)
                for e in data.experiments
            ]
        )
    flat = data.detrend(order)
    for part, whole in ((flat, data), (flat[30:120], data[30:120])):
        back = part.restore([e.y for e in part.experiments])
        for y, e in zip(back, whole.experiments, strict=True):
            np.testing.assert_allclose(y, e.y, rtol=1e-12, atol=1e-9)
    again = flat.detrend(1)
    for y, e in zip(again.restore([e.y for e in again.experiments]), data.experiments, strict=True):
        np.testing.assert_allclose(y, e.y, rtol=1e-12, atol=1e-9)
    copy = pickle.loads(pickle.dumps(flat))
    np.testing.assert_array_equal(
        copy.restore([e.y for e in copy.experiments])[0],
        flat.restore([e.y for e in flat.experiments])[0],
    )


def test_a_line_is_taken_off_each_experiment() -> None:
    k = np.arange(400.0)
    wave = np.sin(k * 2 * np.pi / 40)
    y = wave + 7.0 + 0.01 * k
    y[100:140] = np.nan
    flat = Dataset.from_arrays(wave, y, TS).detrend(1)
    slope = np.polyfit(k[~np.isnan(y)], flat.experiments[0].y[~np.isnan(y)], 1)
    assert np.abs(slope).max() < 1e-10
    # the wave itself has a slope over whole periods, of 6 / (pi * samples) at most
    assert flat.experiments[0].removed is not None
    assert flat.experiments[0].removed.slope[1] == pytest.approx(0.01, abs=0.006)


def test_offsets_of_one_data_set_come_off_another() -> None:
    train, other = two_runs(), two_runs()[50:]
    like = other.detrend(like=train.detrend(0))
    np.testing.assert_array_equal(like.experiments[1].u, train.detrend(0)[50:].experiments[1].u)
    with pytest.raises(SettingError, match="one constant offset"):
        other.detrend(like=train.detrend(1))
    with pytest.raises(SettingError, match="one constant offset"):
        other.detrend(like=train)


def test_a_model_of_deviations_is_the_model_about_its_operating_point() -> None:
    u = steps(2000, 10)
    data = Dataset.from_arrays(u + 4.0, lag(u) + 30.0, TS)
    flat = data.detrend(0)
    run = flat.restore(identify(flat, model="oe", na=1, nb=1).simulate(flat))[0]
    np.testing.assert_allclose(run[20:], data.experiments[0].y[20:], atol=1e-6)


def test_a_model_says_how_its_data_were_prepared() -> None:
    u = steps(2000, 10)
    data = Dataset.from_arrays(u, lag(u), TS, channels={"truth": lag(u)})
    flat = data.mask("7:9").detrend(0)
    model = identify(flat, model="arx", na=1, nb=1)
    assert "prepared: array [0:2000]: 2 outputs masked" in str(model)
    assert "mean of all experiments taken off" in model.training["preparation"][1]
    with pytest.raises(DataError, match="without an offset taken off"):
        model.validate(flat, against="truth")
    assert model.validate(data, against="truth").n == 1980


def test_rest_is_the_level_before_an_input_moves() -> None:
    u = np.r_[np.full(100, 2.0), 2.0 + steps(400, 20)]
    y = 50.0 + np.r_[np.zeros(100), lag(u[100:] - 2.0)]
    (e,) = Dataset.from_arrays(u, y, TS).detrend("steady").experiments
    assert np.abs(e.u[:100]).max() < 1e-12
    assert np.abs(e.y[:100]).max() < 1e-12
    with pytest.raises(DataError, match="at rest before an input moves, received 19"):
        Dataset.from_arrays(u[101:], y[101:], TS).detrend("steady")
    drifting = y + np.r_[np.linspace(0, 3, 100), np.full(400, 3.0)]
    with pytest.raises(DataError, match="still moves"):
        Dataset.from_arrays(u, drifting, TS).detrend("steady")


# --- sample times ---------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [5.0, 2.5, 3.37, 0.5, 0.37])
def test_a_resampled_record_holds_the_same_plant(ratio: float) -> None:
    u = steps(20_000, 25)
    fast = Dataset.from_arrays(u, lag(u), TS)
    slow = fast.resample(ratio * TS)
    assert slow.Ts == pytest.approx(ratio * TS)
    assert len(slow) == int(20_000 / ratio + 1e-9)
    model = identify(slow, model="oe", na=1, nb=1)
    # the filter takes the corners of the response, its bias is some per mille at these rates
    assert model.dc_gain[0] == pytest.approx(2.0, rel=0.01)  # type: ignore[attr-defined]
    pole = model.poles[0].real  # type: ignore[attr-defined]
    assert pole == pytest.approx(np.exp(-ratio * TS / TAU), abs=0.01)


def test_an_input_held_over_whole_periods_is_exact_without_the_filter() -> None:
    u = steps(20_000, 20)
    slow = Dataset.from_arrays(u, lag(u), TS).resample(20 * TS, antialias=False)
    np.testing.assert_allclose(slow.experiments[0].u[:, 0], u[::20], rtol=1e-14)
    np.testing.assert_array_equal(slow.experiments[0].y, lag(u)[::20])
    assert "antialias=False" in Dataset.from_arrays(u, lag(u), TS).resample(20 * TS).notes[0]
    pole = identify(slow, model="oe", na=1, nb=1).poles[0].real  # type: ignore[attr-defined]
    assert pole == pytest.approx(np.exp(-20 * TS / TAU), abs=1e-9)


def test_the_filter_keeps_what_it_should_and_takes_what_would_fold_back() -> None:
    t = np.arange(20_000) * TS
    inner = slice(30, -30)  # beyond the filter's reach from both ends

    def resampled(hertz: float, **options: Any) -> FloatArray:
        wave = np.sin(2 * np.pi * hertz * t)
        return Dataset.from_arrays(wave, wave, TS).resample(0.01, **options).experiments[0].y

    slow = np.arange(2000) * 0.01
    assert np.abs(resampled(30.0) - np.sin(2 * np.pi * 30 * slow))[inner].max() < 2e-3
    assert np.abs(resampled(70.0))[inner].max() < 2e-3
    assert np.abs(resampled(70.0, antialias=False))[inner].max() > 0.9
    constant = Dataset.from_arrays(t, np.full(20_000, 5.0), TS).resample(0.00313)
    np.testing.assert_allclose(constant.experiments[0].y, 5.0, rtol=1e-12)


def test_upsampling_returns_to_the_same_samples() -> None:
    u = steps(500, 7)
    y = lag(u)
    back = Dataset.from_arrays(u, y, TS).resample(TS / 4).resample(TS, antialias=False)
    np.testing.assert_allclose(back.experiments[0].u[:, 0], u, atol=1e-12)
    np.testing.assert_allclose(back.experiments[0].y, y, atol=1e-12)


def test_means_of_a_held_input_over_any_period() -> None:
    u = steps(1000, 1)
    slow = Dataset.from_arrays(u, u, 1.0).resample(2.5)
    expected = [(u[0] + u[1] + 0.5 * u[2]) / 2.5, (0.5 * u[2] + u[3] + u[4]) / 2.5]
    np.testing.assert_allclose(slow.experiments[0].u[:2, 0], expected, atol=1e-12)
    sampled = Dataset.from_arrays(u, u, 1.0).resample(2.5, inputs="sampled").experiments[0]
    np.testing.assert_allclose(sampled.u[:, 0], sampled.y)


def test_gaps_stay_gaps() -> None:
    t = np.arange(1000.0)
    y = np.sin(t / 50.0)
    y[400:500] = np.nan
    y[703] = np.nan
    u = np.cos(t / 30.0)
    u[605] = np.nan
    e = Dataset.from_arrays(u, y, 1.0).resample(10.0).experiments[0]
    assert set(np.flatnonzero(np.isnan(e.y))) == set(range(40, 50))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(e.u[:, 0])), [60])
    known = ~np.isnan(e.y)
    known[[38, 39, 50, 51, 52]] = False
    assert np.abs(e.y - np.sin(np.arange(100) * 0.2))[known].max() < 0.02


def test_a_trend_survives_another_sample_time() -> None:
    k = np.arange(1000.0)
    data = Dataset.from_arrays(np.sin(k / 9), np.sin(k / 7) + 3.0 + 0.02 * k, 1.0)[100:900]
    slow = data.detrend(1).resample(4.0)
    back = slow.restore([e.y for e in slow.experiments])[0]
    np.testing.assert_allclose(back, data.resample(4.0).experiments[0].y, atol=1e-9)
    assert slow.experiments[0].start == 25


@pytest.mark.parametrize("Ts", [0.0, -1.0, np.nan, np.inf, "1", True, None, 1e-12])
def test_no_sample_time(Ts: Any) -> None:
    with pytest.raises(SettingError, match="sample"):
        two_runs().resample(Ts)
    with pytest.raises(DataError, match="one new period"):
        two_runs().resample(1e9)
    with pytest.raises(SettingError, match="held"):
        two_runs().resample(0.01, inputs="foh")  # type: ignore[arg-type]


# --- parts ----------------------------------------------------------------------------------------


def test_parts_by_fractions_times_and_experiments() -> None:
    data = two_runs()
    ranges = [[e.range_text for e in part.experiments] for part in data.split(0.5, 0.25)]
    assert ranges == [["0:150", "0:100"], ["150:225", "100:150"], ["225:300", "150:200"]]
    ranges = [[e.range_text for e in part.experiments] for part in data.split(at=[0.05, 0.1])]
    assert ranges == [["0:50", "0:50"], ["50:100", "50:100"], ["100:300", "100:200"]]
    names = [[e.name for e in part.experiments] for part in data.split(0.5, by="experiments")]
    assert names == [["run300"], ["run200"]]
    for wrong in ((), (0.5, 0.5), (0.7, 0.4), ("half",), (True,)):
        with pytest.raises(SettingError):
            data.split(*wrong)  # type: ignore[arg-type]
    for times in ([], [-1.0], [0.1, 0.1], [np.nan], "0.1", [[0.1]]):
        with pytest.raises(SettingError, match="times"):
            data.split(at=times)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="range inside"):
        data.split(at=[0.25])
    with pytest.raises(DataError, match="3 parts"):
        data.split(0.3, 0.3, by="experiments")


# --- masks and outliers ---------------------------------------------------------------------------


def test_masks_by_range_arrays_and_function() -> None:
    data = two_runs()
    by_range = data.mask("10:20")
    by_arrays = data.mask(
        [(np.arange(len(e)) >= 10) & (np.arange(len(e)) < 20) for e in data.experiments]
    )
    by_function = data.mask(lambda e: (np.arange(len(e)) >= 10) & (np.arange(len(e)) < 20))
    for other in (by_arrays, by_function):
        for a, b in zip(by_range.experiments, other.experiments, strict=True):
            np.testing.assert_array_equal(a.y, b.y)
            np.testing.assert_array_equal(a.u, b.u)
    assert by_range.experiments[0].unmeasured == 20
    assert by_range.notes == (
        "run300 [0:300]: 10 outputs masked",
        "run200 [0:200]: 10 outputs masked",
    )
    for wrong in (
        np.zeros(300, bool),
        [np.zeros(300, bool)],
        [np.zeros(9, bool)] * 2,
        [np.zeros(300)] * 2,
    ):
        with pytest.raises(DataError, match="mask"):
            data.mask(wrong)
    with pytest.raises(SettingError, match="range"):
        data.mask("now")


def spiked(n: int = 20_000, seed: int = 0) -> tuple[Dataset, FloatArray]:
    """Steps through the lag with noise, and thirty single spikes of fifty standard deviations."""
    random = np.random.default_rng(seed)
    u = steps(n, 20, seed)
    y = lag(u) + 0.02 * random.standard_normal(n)
    at = np.sort(random.choice(np.arange(50, n), 30, replace=False))
    y[at] += random.choice([-1.0, 1.0], 30)
    return Dataset.from_arrays(u, y, TS), at


def test_outliers_are_marked_and_nothing_else() -> None:
    data, at = spiked()
    marks = data.mark_outliers()
    found = np.flatnonzero(marks[0])
    assert set(found) <= set(at)
    assert len(found) >= 25
    assert f"{len(found)} of 20000 outputs stand out" in str(marks)
    assert data.experiments[0].unmeasured == 0
    assert data.mask(marks, why="stand out").experiments[0].unmeasured == len(found)
    clean = data.mask(marks)
    model = identify(clean, model="oe", na=1, nb=1)
    assert set(np.flatnonzero(data.mark_outliers(model=model)[0])) == set(at)


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_has_no_outliers(seed: int) -> None:
    y = np.random.default_rng(seed).standard_normal(50_000)
    assert Dataset.from_arrays(y, y, 1.0).mark_outliers().marked == 0


def test_a_quantised_speed_and_a_square_wave_have_no_outliers() -> None:
    k = np.arange(20_000)
    for y in (np.round(np.sin(k / 900) * 20) * 38.168, np.sign(np.sin(k / 100)), np.ones(20_000)):
        assert Dataset.from_arrays(y, y, 1.0).mark_outliers().marked == 0
    spike = np.zeros(100)
    spike[50] = 1.0
    assert list(np.flatnonzero(Dataset.from_arrays(spike, spike, 1.0).mark_outliers()[0])) == [50]


@pytest.mark.parametrize(
    "options", [{"threshold": 0}, {"threshold": "6"}, {"window": 4}, {"window": 1}, {"window": 7.0}]
)
def test_no_outlier_setting(options: Any) -> None:
    with pytest.raises(SettingError, match="expected"):
        two_runs().mark_outliers(**options)


# --- whatever comes -------------------------------------------------------------------------------

values = st.floats(width=64, allow_nan=True, allow_infinity=True) | st.sampled_from(
    [0.0, 1.0, np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324]
)
PREPARED: list[Any] = [
    lambda d: d.detrend(0),
    lambda d: d.detrend(1),
    lambda d: d.detrend("steady"),
    lambda d: d.detrend(0).resample(d.Ts * 3),
    lambda d: d.resample(d.Ts * 3),
    lambda d: d.resample(d.Ts * 2.7, inputs="sampled"),
    lambda d: d.resample(d.Ts / 2.2, antialias=False),
    lambda d: d.mask(d.mark_outliers()),
    lambda d: d.mask(lambda e: np.abs(e.y) > 1.0),
    lambda d: d.fill_inputs("hold"),
    lambda d: d.split(0.5)[1],
    lambda d: d.split_at_gaps(2, of="inputs"),
]


@settings(deadline=None, max_examples=150)
@given(st.data(), st.integers(1, 30), st.integers(1, 2), st.sampled_from(PREPARED))
def test_hostile_values_give_a_data_set_or_a_clear_error(
    draw: st.DataObject, n: int, inputs: int, prepare: Any
) -> None:
    u = draw.draw(hnp.arrays(np.float64, (n, inputs), elements=values))
    y = draw.draw(hnp.arrays(np.float64, n, elements=values))
    before = u.copy(), y.copy()
    data = Dataset.from_arrays(u, y, 0.01)
    try:
        found = prepare(data)
    except SewfastError as e:
        found = str(e)
    if isinstance(found, str):
        assert any(word in found for word in ("expected", "nothing", "no value"))
    else:
        assert isinstance(found, Dataset)
        assert not np.isinf(found.experiments[0].y).any() or np.isinf(y).any()
    np.testing.assert_array_equal(before[0], u)
    np.testing.assert_array_equal(before[1], y)
    np.testing.assert_array_equal(data.experiments[0].y, y)
    np.testing.assert_array_equal(data.experiments[0].u, u)


@pytest.mark.parametrize(
    ("u", "y"),
    [
        (np.zeros(0), np.zeros(0)),
        (np.zeros((3, 2, 1)), np.zeros(3)),
        (np.zeros((3, 0)), np.zeros(3)),
        (np.zeros(3), np.zeros((3, 1))),
        (np.zeros(3), np.zeros(4)),
        (["a", "b"], [1.0, 2.0]),
        ([1j, 2.0], [1.0, 2.0]),
        ([None, 1.0], [1.0, 2.0]),
    ],
)
def test_hostile_shapes_are_refused(u: Any, y: Any) -> None:
    with pytest.raises(DataError, match="expected"):
        Dataset.from_arrays(u, y, 0.01)


def test_integers_and_masked_arrays_are_taken() -> None:
    u = np.arange(300) % 7
    y = np.ma.masked_array(np.arange(300) % 11, mask=np.arange(300) % 5 == 0)
    data = Dataset.from_arrays(u, y, 0.01)
    assert data.experiments[0].unmeasured == 60
    for prepare in (data.detrend(0), data.resample(0.02), data.mask(data.mark_outliers())):
        assert prepare.experiments[0].u.dtype == np.float64
    assert y.mask.sum() == 60
