"""References that a drive can follow: bounds kept, levels met, reach taken from the models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lags import LEAD, PI, drive, error
from sewfast import DataError, FitError, Reach, SettingError, plan, profile, run

STEP = np.repeat([0.0, 2000.0, 0.0], [100, 500, 400])


@settings(deadline=None)
@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=8),
    st.floats(10.0, 1e5),
    st.floats(100.0, 1e9) | st.just(np.inf),
)
def test_bounds_are_kept_and_the_last_level_is_met(
    levels: list[float], rate: float, jerk: float
) -> None:
    r = np.repeat([0.0, *levels], 50)
    found = profile(r, Ts=1e-3, rate=rate, jerk=jerk, low=-800.0, high=800.0)
    rates = np.diff(found.r) / 1e-3
    assert np.abs(rates).max(initial=0.0) <= rate * (1 + 1e-9) + 1e-6
    if np.isfinite(jerk):
        assert np.abs(np.diff(rates)).max(initial=0.0) / 1e-3 <= jerk * (1 + 1e-6) + 1e-2
    assert found.r[-1] == np.clip(levels[-1], -800.0, 800.0)
    assert len(found.r) >= len(r)
    assert len(found.columns()["asked"]) == len(found.r)


def test_the_reach_of_a_lag_is_what_its_voltage_leaves() -> None:
    reach = Reach.of(drive(), u_min=-8.0, u_max=8.0, share=1.0)
    at = np.interp(1500.0, reach.levels, reach.up)
    assert at == pytest.approx((490.0 * 8.0 - 1500.0) / 0.25, rel=0.05)
    weak = Reach.of([drive(), drive(gain=400.0)], u_min=-8.0, u_max=8.0, share=1.0)
    assert np.all(weak.up <= reach.up * (1 + 1e-9))
    assert weak.high < reach.high


def test_a_step_becomes_the_quickest_way_that_the_drive_has() -> None:
    tight = {"u_min": -6.0, "u_max": 6.0}
    found = profile(STEP, drive(), **tight)
    assert "rate" in found.bounds
    # the way up of a lag under nine tenths of its rate
    up = np.flatnonzero(found.r >= 1999.0)[0] * 1e-3 - 0.1
    exact = 0.25 / 0.9 * np.log(490.0 * 6.0 / (490.0 * 6.0 - 2000.0))
    assert up == pytest.approx(exact, rel=0.1)
    controller = replace(PI, feedforward=LEAD, **tight)
    table = plan(controller, drive(), STEP, within_reach=True)
    asked = plan(controller, drive(), STEP)
    assert table.limited < 0.5 * asked.limited
    assert error(run(controller, drive(), table=table)) < 50.0


def test_what_it_cannot_do_is_said() -> None:
    high = profile(np.repeat([0.0, 9000.0], [50, 400]), drive())
    assert "level" in high.bounds
    assert high.r.max() == high.reach.high
    assert "bounds that acted: level" in str(high)
    short = profile(np.repeat([0.0, 2000.0], [50, 10]), drive())
    assert short.later > 0.0
    assert "longer" in str(short)
    calm = profile(np.linspace(0.0, 10.0, 2000), drive())
    assert not calm.bounds
    assert "no bound acted" in str(calm)


def test_bad_input_is_refused() -> None:
    for bad in ({"rate": 0.0}, {"jerk": -1.0}, {"low": 2.0, "high": 1.0}):
        with pytest.raises(SettingError, match="jerk"):
            profile(STEP, Ts=1e-3, **{"rate": 1.0, **bad})
    with pytest.raises(SettingError, match="Ts"):
        profile(STEP)
    with pytest.raises(SettingError, match="Ts"):
        profile(STEP, Ts=1e-3)
    with pytest.raises(DataError):
        profile([], Ts=1e-3, rate=1.0)
    with pytest.raises(DataError):
        profile([0.0, np.inf], Ts=1e-3, rate=1.0)
    with pytest.raises(FitError, match="begins"):
        profile([5.0, 0.0], Ts=1e-3, rate=1.0, high=2.0)
    with pytest.raises(SettingError):
        profile(STEP, drive(), share=0.0)
