"""Named signals and the generators behind them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sewfast import _core
from sewfast.errors import DataError, SettingError
from sewfast.signals import (
    EXCITATIONS,
    REFERENCES,
    TS,
    available,
    crest_factor,
    excitation,
    reference,
)

RANDOM = ["random", "prbs", "multisine", "saturating", "saturating_2"]


def eq_8(u, acceleration=math.inf):
    """Speed [RPM] of 490/((.252 s + 1)(.0074 s + 1)), its acceleration limited."""
    slow = fast = 0.0
    speed, limited = np.empty(len(u)), 0
    for k, volt in enumerate(u):
        speed[k] = slow
        demand = (490 * fast - slow) / 0.252
        limited += abs(demand) > acceleration
        for _ in range(4):
            fast += TS / 4 * (volt - fast) / 0.0074
            rate = (490 * fast - slow) / 0.252
            slow += TS / 4 * min(max(rate, -acceleration), acceleration)
    return speed, limited / len(u)


@pytest.mark.parametrize("signal", available(), ids=lambda s: f"{s.name} {s.unit}")
@pytest.mark.parametrize("seed", [0, 1, 2**64 - 1])
def test_every_signal_has_its_length_and_keeps_its_limits(signal, seed):
    values = signal.generate(seed)
    assert values.dtype == np.float64
    assert len(values) == round(signal.duration_s / TS)
    assert signal.low <= values.min() < values.max() <= signal.high
    assert np.abs(np.diff(values)).max() <= signal.rate * TS
    np.testing.assert_array_equal(values, signal.generate(seed))


def test_the_seed_chooses_the_random_signals_alone():
    for name in EXCITATIONS:
        same = np.array_equal(excitation(name, 0), excitation(name, 1))
        assert same == (name not in RANDOM)
    assert not np.array_equal(reference("random", 0), reference("random", 1))
    assert not np.array_equal(excitation("saturating")[:15000], excitation("saturating_2"))


@pytest.mark.parametrize("name", ["chirp_lo_hi", "chirp_hi_lo"])
def test_chirps_press_a_pedal_up_to_3000_rpm(name):
    u = excitation(name)
    speed, _ = eq_8(u)
    assert u.min() >= 0
    assert 2900 < speed.max() < 3100
    swing = [np.ptp(part) for part in np.array_split(u, 4)]
    assert swing == sorted(swing, reverse=name == "chirp_hi_lo")


@pytest.mark.parametrize("name", ["saturating", "saturating_2"])
@pytest.mark.parametrize("seed", range(3))
def test_saturating_records_reach_the_current_limit_within_the_range_of_speed(name, seed):
    u = excitation(name, seed)
    speed, limited = eq_8(u, 25_000.0)
    assert limited > 0.05
    assert np.mean((speed < 0) | (speed > 5000)) < 0.02


def test_references_are_what_their_names_say():
    r = reference("trapezoid")
    assert r[100] == 0
    assert r[250] == pytest.approx(3000)
    assert r[850] == pytest.approx(3000)
    assert r[1001:].max() == 0
    assert 1950 < reference("chirp-hi-lo").max() <= 2000
    assert 550 < reference("chirp_lo_hi").max() <= 600
    random = reference("random", 5)
    assert random[0] < 1
    assert 200 <= random[200:].min() < random.max() <= 2000
    assert all(reference(name).min() >= 0 for name in REFERENCES)


def test_names_take_dashes_and_unknown_ones_are_answered_with_the_known():
    np.testing.assert_array_equal(excitation("Chirp-Lo-Hi"), excitation("chirp_lo_hi"))
    with pytest.raises(SettingError, match=r"chirp_lo_hi.*saturating_2"):
        excitation("sawtooth")
    with pytest.raises(SettingError, match="trapezoids"):
        reference("prbs")


@pytest.mark.parametrize("seed", [-1, 1.5, "0", True, 2**64, None])
def test_seeds_are_whole_numbers(seed):
    with pytest.raises(SettingError, match="seed"):
        excitation("random", seed)


def test_crest_factors():
    assert crest_factor(np.sin(np.arange(1000) * math.tau / 1000)) == pytest.approx(math.sqrt(2))
    assert 2.5 < crest_factor(excitation("multisine")) < 4.5
    with pytest.raises(DataError):
        crest_factor(np.array([]))


def test_multisine_fills_its_band_and_nothing_else():
    power = np.abs(np.fft.rfft(excitation("multisine"))) ** 2
    band = power[2:101]
    assert band.min() == pytest.approx(band.max(), rel=1e-9)
    assert power[101:].max() < 1e-18 * band.max()


numbers = st.floats(allow_nan=True, allow_infinity=True)
hostile = st.one_of(numbers, st.sampled_from([0.0, -1.0, 1e-300, 1e300, 0.001, 1.0]))
GENERATORS = {
    _core.step: ["duration", "Ts", "at", "low", "high"],
    _core.trapezoid: ["duration", "Ts", "start", "rise", "hold", "fall", "low", "high"],
    _core.prbs: ["duration", "Ts", "low", "high", "hold"],
    _core.multisine: ["duration", "Ts", "f_low", "f_high", "amplitude", "offset"],
    _core.random_steps: ["duration", "Ts", "low", "high", "hold_min", "hold_max", "smoothing"],
}


@given(st.sampled_from(list(GENERATORS)), st.data())
def test_hostile_settings_are_refused_or_give_a_finite_signal(generator, data):
    settings = {name: data.draw(hostile) for name in GENERATORS[generator]}
    # Length is drawn small: what is refused for its length is tested beside the code.
    settings["duration"] = data.draw(st.sampled_from([-1.0, math.nan, 0.5, 1.0]))
    settings["Ts"] = data.draw(st.sampled_from([0.0, -1.0, math.inf, 1e-9, 0.001, 0.01]))
    if generator not in (_core.step, _core.trapezoid):
        settings["seed"] = 1
    try:
        values = generator(**settings)
    except SettingError:
        return
    assert np.isfinite(values).all()


def test_too_many_samples_are_refused_before_memory_is_asked_for():
    with pytest.raises(SettingError, match="100000000 samples"):
        _core.step(duration=1e9, Ts=1e-3, at=0.0, low=0.0, high=1.0)


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60),
    st.floats(0.01, 10),
    st.floats(0.01, 10),
)
def test_limit_holds_as_numpy_computes_it_and_is_idempotent(signal, rate, slew):
    settings = {"Ts": 0.5, "low": -3.0, "high": 2.0, "rate": rate, "slew": slew}
    x = _core.limit(np.array(signal), **settings)
    assert ((x >= -3) & (x <= 2)).all()
    assert (np.abs(np.diff(x)) <= rate * 0.5).all()
    assert (np.abs(np.diff(x, 2)) <= slew * 0.25).all()
    np.testing.assert_array_equal(_core.limit(x, **settings), x)
