"""Step responses that are of no first order: told where they are, not where noise looks like it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from cli import called as sewfast
from sewfast import fit_fopdt, write_table
from sewfast.control import Fopdt

AT = 100


def step(n: int) -> np.ndarray:
    return np.where(np.arange(n) < AT, 1.0, 3.0)


def since(n: int) -> np.ndarray:
    return 1e-3 * (np.arange(n) - AT)


def oscillating(damping: float, n: int, rise: float = 400.0, offset: float = 0.0) -> np.ndarray:
    """The response of a second order of 60 rad/s."""
    t = 60.0 * np.maximum(since(n), 0.0)
    ring = math.sqrt(1.0 - damping**2)
    left = np.exp(-damping * t) * (np.cos(ring * t) + damping / ring * np.sin(ring * t))
    return np.asarray(offset + rise * (1.0 - left))


def noise(seed: int, n: int, memory: float) -> np.ndarray:
    """Of deviation 1, each sample keeping `memory` of the one before."""
    white = np.random.default_rng(seed).normal(size=n)
    kept = [white[0]]
    for fresh in white[1:]:
        kept.append(memory * kept[-1] + math.sqrt(1.0 - memory**2) * fresh)
    return np.array(kept)


@pytest.mark.parametrize("damping", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("rise", [400.0, -400.0])
@pytest.mark.parametrize("scatter", [0.0, 8.0])
def test_an_oscillating_response_is_told(damping: float, rise: float, scatter: float) -> None:
    y = oscillating(damping, 1000, rise, offset=5000.0) + scatter * noise(0, 1000, 0.0)
    found = fit_fopdt(step(1000), y, Ts=1e-3)
    peak = 100.0 * math.exp(-math.pi * damping / math.sqrt(1.0 - damping**2))
    assert found.overshoot_percent == pytest.approx(peak, abs=8.0)
    assert "do not trust gains" in found.warning
    assert found.warning in str(found)


@pytest.mark.nightly("a thousand noisy steps", by_day=["0.02-0.0-20.0-0.0"])
@pytest.mark.parametrize(
    ("T", "L", "scatter", "memory"), [(0.02, 0.0, 20.0, 0.0), (0.06, 0.005, 10.0, 0.9)]
)
def test_noise_on_a_first_order_is_no_overshoot(
    T: float, L: float, scatter: float, memory: float
) -> None:
    """5.5 deviations at one of 500 samples of 200 records: a probability of .2 %."""
    n = 600
    y = Fopdt(100.0, T, L, u_low=1.0, u_high=3.0).response(since(n))
    for seed in range(200):
        found = fit_fopdt(step(n), y + scatter * noise(seed, n, memory), Ts=1e-3)
        assert found.overshoot_percent == 0.0, seed
        assert found.warning == ""


def test_neither_offset_nor_a_limit_is_an_overshoot() -> None:
    n = 800
    y = Fopdt(100.0, 0.06, 0.005, offset=1e4, u_low=1.0, u_high=3.0).response(since(n))
    for seed in range(5):
        noisy = y + 4.0 * noise(seed, n, 0.5)
        assert fit_fopdt(step(n), noisy, Ts=1e-3).warning == ""
        limited = fit_fopdt(step(n), np.minimum(noisy, 1e4 + 250.0), Ts=1e-3)
        assert limited.limited > 0
        assert limited.warning == ""


def test_a_ripple_that_stays_is_no_overshoot() -> None:
    n = 1000
    y = Fopdt(100.0, 0.06, 0.005, u_low=1.0, u_high=3.0).response(since(n))
    ripple = 15.0 * np.sin(2.0 * math.pi * np.arange(n) / 45.0)
    assert fit_fopdt(step(n), y + ripple, Ts=1e-3).warning == ""


def test_the_command_line_says_so(tmp_path: Path) -> None:
    t = since(1000) - since(1000)[0]
    columns = {"t": t, "u": step(1000), "y": oscillating(0.3, 1000)}
    write_table(tmp_path / "step.csv", columns)
    command = ("gains", "step.csv", "--input", "u", "--output", "y", "--rule", "amigo")
    told = sewfast(tmp_path, *command, "-o", "c.json")
    assert "warning: overshoots by 37 %" in told.out
    found = json.loads(sewfast(tmp_path, *command, "--json").out)
    assert found["plant"]["overshoot_percent"] == pytest.approx(37.2, abs=1.0)
    (warning,) = found["warnings"]
    assert "overshoots" in warning
    assert warning in json.loads((tmp_path / "c.json").read_text())["notes"]
