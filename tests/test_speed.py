"""Speed from counts on the virtual machine and on hostile input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sewfast.errors import DataError, SettingError
from sewfast.machine import VirtualMachine
from sewfast.signals import excitation
from sewfast.speed import floor_of_J, speed_from_counts
from sewfast.units import counts_per_unit

METHODS = ["difference", "savgol", "kalman"]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def lo_hi():
    return VirtualMachine().run(excitation("chirp_lo_hi"))


def test_units_agree_with_each_other():
    counts = np.cumsum(np.arange(200) % 7)
    rev = speed_from_counts(counts, 0.001, 1572, unit="rev/s", method="difference")
    for unit, factor in {"rpm": 60, "rad/s": math.tau, "deg/s": 360}.items():
        other = speed_from_counts(counts, 0.001, 1572, unit=unit, method="difference")
        np.testing.assert_allclose(other, rev * factor, rtol=1e-12)
    assert 1 / (0.001 * counts_per_unit(1572, "RPM")) == pytest.approx(38.168, abs=1e-3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("unit", ["rpm", "rad/s"])
def test_a_steady_speed_is_found_in_every_unit(method, unit):
    counts = np.floor(np.arange(3000) * 26.2 + 0.4)
    truth = 1000.0 if unit == "rpm" else 1000 * math.tau / 60
    speed = speed_from_counts(counts, 0.001, 1572, method=method, unit=unit)
    assert speed.shape == counts.shape
    assert speed[500:-500].mean() == pytest.approx(truth, rel=1e-4)


def test_integers_and_floats_give_the_same_and_are_left_alone(lo_hi):
    counts = lo_hi.counts[:2000].copy()
    for method in METHODS:
        a = speed_from_counts(counts, 0.001, 1572, method=method)
        b = speed_from_counts(counts.astype(np.int32), 0.001, 1572, method=method)
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(counts, lo_hi.counts[:2000])


def test_savgol_agrees_with_scipy(lo_hi):
    signal = pytest.importorskip("scipy.signal")
    for window, order in [(41, 3), (7, 2), (101, 5)]:
        theirs = signal.savgol_filter(lo_hi.counts, window, order, deriv=1) * 60_000 / 1572
        ours = speed_from_counts(
            lo_hi.counts, 0.001, 1572, method="savgol", window=window, order=order
        )
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_a_wrapped_counter_is_noticed_and_unwrapped(lo_hi):
    wrapped = (lo_hi.counts.astype(np.int64) % 2**16).astype(np.uint16)
    with pytest.raises(DataError, match="unwrap_bits=16"):
        speed_from_counts(wrapped, 0.001, 1572)
    whole = speed_from_counts(lo_hi.counts, 0.001, 1572)
    np.testing.assert_array_equal(speed_from_counts(wrapped, 0.001, 1572, unwrap_bits=16), whole)
    signed = wrapped.astype(np.int16)
    np.testing.assert_allclose(speed_from_counts(signed, 0.001, 1572, unwrap_bits=16), whole)


def test_the_floor_of_J_of_raw_differences_is_that_of_rounding(lo_hi):
    raw = speed_from_counts(lo_hi.counts, 0.001, 1572, method="difference")
    floor = floor_of_J(raw, lo_hi.speed_rpm)
    assert floor == pytest.approx(rms((raw - lo_hi.speed_rpm) / 1000) ** 2 / 2)
    assert 6e-5 < floor < 1.5e-4
    assert floor_of_J([1.0, 2.0], [1.0, 4.0], y_scale=2.0) == 0.25


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_the_smoother_is_within_one_rpm_of_the_truth_on_lo_hi(seed):
    run = VirtualMachine(seed).run(excitation("chirp_lo_hi"))
    speed = speed_from_counts(run.counts, 0.001, 1572)
    assert rms(speed - run.speed_rpm) < 1.0
    assert floor_of_J(speed, run.speed_rpm) < 5e-7


def test_ripple_is_modelled_where_there_is_some():
    command = excitation("chirp_lo_hi")[:8000]
    for angle_dependence in (True, False):
        counts = VirtualMachine(angle_dependence=angle_dependence).run(command).counts
        plain = speed_from_counts(counts, 0.001, 1572, ripple_orders=())
        same = np.array_equal(speed_from_counts(counts, 0.001, 1572), plain)
        assert same == (not angle_dependence)


def test_an_exact_position_gives_the_speed_itself():
    run = VirtualMachine(quantisation=False).run(excitation("chirp_lo_hi"))
    assert rms(speed_from_counts(run.counts, 0.001, 1572) - run.speed_rpm) < 0.05


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"Ts": 0.0}, "Ts"),
        ({"Ts": math.nan}, "Ts"),
        ({"counts_per_rev": 0}, "counts_per_rev"),
        ({"counts_per_rev": math.inf}, "counts_per_rev"),
        ({"unit": "knots"}, "rad/s"),
        ({"method": "magic"}, "savgol"),
        ({"method": "savgol", "window": 40}, "41"),
        ({"method": "savgol", "window": 5, "order": 5}, "order"),
        ({"method": "savgol", "window": 5.0}, "window"),
        ({"method": "savgol", "order": -1}, "order"),
        ({"process_noise": 0.0}, "process_noise"),
        ({"process_noise": math.nan}, "process_noise"),
        ({"unwrap_bits": 60}, "unwrap_bits"),
        ({"ripple_orders": [1, 1]}, "ripple_orders"),
        ({"ripple_orders": [0.5]}, "ripple_orders"),
        ({"ripple_orders": [-1]}, "ripple_orders"),
    ],
)
def test_settings_outside_their_range_are_refused(change, match):
    settings = {"Ts": 0.001, "counts_per_rev": 1572, **change}
    with pytest.raises(SettingError, match=match):
        speed_from_counts(np.arange(100), **settings)


@pytest.mark.parametrize(
    "counts",
    [
        [],
        [1],
        np.zeros((5, 2)),
        np.zeros(9, dtype=complex),
        ["a", "b"],
        [[1], [2, 3]],
        [True, False, True],
        [0, 1, 2, math.nan, 4, 5],
        np.array([2**60, 2**60 + 1] * 4),
    ],
    ids=lambda c: str(np.shape(c) if isinstance(c, np.ndarray) else c),
)
def test_counts_that_cannot_be_used_are_refused(counts):
    with pytest.raises(DataError, match="expected"):
        speed_from_counts(counts, 0.001, 1572)


def test_floors_of_columns_that_do_not_match_are_refused():
    for estimate, truth in [([], []), ([1.0], [1.0, 2.0]), ([math.nan], [1.0])]:
        with pytest.raises(DataError):
            floor_of_J(estimate, truth)
    with pytest.raises(SettingError):
        floor_of_J([1.0], [1.0], y_scale=0)


@given(
    arrays(np.float64, st.integers(0, 80), elements=st.floats(allow_nan=True)),
    st.sampled_from(METHODS),
)
def test_whatever_counts_come_the_speed_is_finite_or_refused(counts, method):
    try:
        speed = speed_from_counts(counts, 0.001, 1572, method=method, window=5)
    except DataError:
        return
    assert np.isfinite(speed).all()
