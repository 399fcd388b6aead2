"""Bounds of the clocks: certain, as tight as the exchanges allow, small in memory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sewfast.link.connection import MAX_DRIFT, RESOLUTION, Clock

EXCHANGES = st.lists(
    st.tuples(st.integers(0, 500_000), st.floats(0.0, 0.02), st.floats(0.0, 0.02)),
    min_size=1,
    max_size=40,
)


def exchanges(steps, offset, drift):
    """Sent, device's time, received; the device's time grows by each step."""
    device_us, found = 1000, []
    for step, before, after in steps:
        device_us += step
        host = offset + (1.0 + drift) * device_us * 1e-6
        found.append((host - before, device_us, host + after))
    return found


def bounds(found):
    clock = Clock()
    for exchange in found:
        clock.add(*exchange)
    return clock.bounds()


def test_nothing_is_known_before_the_first_exchange():
    assert Clock().bounds() is None


def test_one_exchange_bounds_the_offset_by_its_round_trip():
    found = bounds([(10.0, 4_000_000, 10.002)])
    assert found.at_us == 4_000_000
    assert found.offset_s == pytest.approx((6.0 - RESOLUTION, 6.002), abs=1e-12)
    assert found.drift_ppm == pytest.approx((-MAX_DRIFT * 1e6, MAX_DRIFT * 1e6))


@given(EXCHANGES, st.floats(-1e4, 1e4), st.floats(-1e-3, 1e-3))
def test_the_truth_is_always_within_the_bounds(steps, offset, drift):
    found = bounds(exchanges(steps, offset, drift))
    truth = offset + drift * found.at_us * 1e-6
    assert found.consistent
    assert found.offset_s[0] - 1e-9 <= truth <= found.offset_s[1] + 1e-9
    # rounding of the host's time over the shortest stretch
    slack = 1e-3 + 1e6 * 1e-11 / 1e-6 * any(0 < step < 100 for step, _, _ in steps)
    assert found.drift_ppm[0] - slack <= drift * 1e6 <= found.drift_ppm[1] + slack


@pytest.mark.parametrize("seed", range(10))
def test_no_tighter_bounds_exist(seed):
    linprog = pytest.importorskip("scipy.optimize", reason="needs scipy").linprog
    random = np.random.default_rng(seed)
    steps = [(int(s), *random.exponential(1e-3, 2)) for s in random.integers(1000, 200_000, 30)]
    found = exchanges(steps, 3.0, 4e-5)
    sent, device, received = np.array(found).T
    x = (device - device[-1]) * 1e-6
    ones = np.ones_like(x)
    rows = np.vstack([np.c_[ones, x], -np.c_[ones, x]])
    right = np.r_[received, RESOLUTION - sent]
    got = bounds(found)
    for cost, expected in (
        ([1, 0], got.offset_s[0] + device[-1] * 1e-6),
        ([-1, 0], -got.offset_s[1] - device[-1] * 1e-6),
        ([0, 1], 1 + got.drift_ppm[0] * 1e-6),
        ([0, -1], -1 - got.drift_ppm[1] * 1e-6),
    ):
        best = linprog(cost, A_ub=rows, b_ub=right, bounds=[(None, None)] * 2)
        assert best.fun == pytest.approx(expected, abs=1e-7)


def test_a_clock_that_jumps_is_a_contradiction():
    found = bounds([(0.0, 0, 0.001), (1.0, 1_000_000, 1.001), (2.0, 2_500_000, 2.001)])
    assert not found.consistent
    assert "contradict" in str(found)


def test_a_reply_older_than_the_last_is_not_used():
    clock = Clock()
    clock.add(1.0, 1_000_000, 1.001)
    before = clock.bounds()
    clock.add(1.1, 999_000, 1.101)
    assert clock.bounds() == before


def test_a_day_of_exchanges_stays_small_and_quick():
    random = np.random.default_rng(1)
    clock = Clock()
    for k, (a, b) in enumerate(random.exponential(2e-3, (100_000, 2))):
        at = 0.5 * k
        clock.add(at - a, 500_000 * k, at + b)
    found = clock.bounds()
    assert found.exchanges == 100_000
    assert len(clock._low) + len(clock._high) < 200
    assert found.drift_ppm[0] <= 0.0 <= found.drift_ppm[1]
    assert found.drift_ppm[1] - found.drift_ppm[0] < 1.0
