"""Records too short to choose by: the steady gain, the integrator."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from plants import steps
from sewfast import Dataset, identify
from sewfast.identification.short import time_constant

F = NDArray[np.float64]


def speed(u: F, pole: float = 0.9, gain: float = 1.5) -> F:
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + (1.0 - pole) * gain * u[k - 1]
    return y


def recording(u: F, y: F, seed: int, noise: float = 0.05) -> Dataset:
    error = noise * np.random.default_rng(seed + 1000).normal(size=len(u))
    return Dataset.from_arrays(u, y + error, 0.01)


@pytest.mark.parametrize(("n", "first"), [(60, 300), (60, 7000), (100, 7000)])
def test_a_pole_that_the_record_cannot_show_does_not_make_the_steady_gain(
    n: int, first: int
) -> None:
    gains, smaller = [], 0
    for seed in range(first, first + 20):
        u = steps(n, seed)[:, 0]
        model = identify(recording(u, speed(u), seed))
        gains.append(model.core.dc_gain()[0])
        smaller += model.orders["na"] == 1
    assert np.abs(gains).max() < 3.0
    assert np.median(gains) == pytest.approx(1.5, rel=0.05)
    # second order stays where it is no trend
    assert smaller < 10


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_a_drive_that_integrates_keeps_its_pole(pole: float) -> None:
    for seed in range(6):
        u = steps(100, seed)[:, 0]
        model = identify(recording(u, 0.05 * np.cumsum(speed(u, pole)), seed, 0.01))
        assert time_constant(model.core) > 100.0
