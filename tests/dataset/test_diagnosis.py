"""What records are: each finding where it must be, and nothing where it must not be.

The tests for integrators and for feedback are statistical. Their bounds were chosen on some
families of simulated drives (`RULES_*`) and are judged here on those and on others (`JUDGED_*`).
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import sewfast
from effort import FULL
from sewfast.dataset import Dataset, Diagnosis, Experiment, FloatArray
from sewfast.errors import DataError

TS = 1e-3
SEEDS = 8

Pair = tuple[FloatArray, FloatArray]
Family = Callable[[np.random.Generator, int], Pair]
"""Inputs and outputs of shape (N, SEEDS): the same drive with so many random numbers."""


# --- signals and drives, all seeds side by side ---------------------------------------------------


def held(random: np.random.Generator, n: int, low: float, high: float, hold: int) -> FloatArray:
    """Random levels, each held for half to one and a half times `hold` samples."""
    columns = []
    for _ in range(SEEDS):
        lengths = random.integers(max(hold // 2, 1), 3 * hold // 2 + 1, 2 * n // hold + 2)
        columns.append(np.repeat(random.uniform(low, high, len(lengths)), lengths)[:n])
    return np.stack(columns, axis=1)


def prbs(random: np.random.Generator, n: int, low: float, high: float, hold: int) -> FloatArray:
    bits = random.random((n // hold + 1, SEEDS)) < 0.5
    return np.repeat(np.where(bits, low, high), hold, axis=0)[:n]


def band(random: np.random.Generator, n: int, upto: float) -> FloatArray:
    """Noise of standard deviation 1 up to a frequency [1/sample]."""
    frequency = np.fft.rfftfreq(n)[:, None]
    parts = random.standard_normal((2, len(frequency), SEEDS))
    shape = (frequency < upto) & (frequency > 0.0)
    x = np.fft.irfft((parts[0] + 1j * parts[1]) * shape, n, axis=0)
    return np.asarray(x / x.std(axis=0))


def chirp(n: int, first: float, last: float) -> FloatArray:
    k = np.arange(n)
    wave = np.sin(2 * np.pi * (first * k + (last - first) * k**2 / (2 * n)))
    return np.repeat(wave[:, None], SEEDS, axis=1)


def moves(random: np.random.Generator, n: int, count: int, size: float) -> FloatArray:
    """A reference that goes smoothly from place to place and waits there."""
    columns = []
    for _ in range(SEEDS):
        ends = np.linspace(0, n, count + 1).astype(int)
        at, column = 0.0, []
        for a, b in itertools.pairwise(ends):
            to, s = random.uniform(-size, size), np.clip(2.0 * np.arange(b - a) / (b - a), 0.0, 1.0)
            column.append(at + (to - at) * s**2 * (3.0 - 2.0 * s))
            at = to
        columns.append(np.concatenate(column))
    return np.stack(columns, axis=1)


def lag(u: FloatArray, tau: float, gain: float = 1.0) -> FloatArray:
    """First-order lag of `tau` samples."""
    a = np.exp(-1.0 / tau)
    y, x = np.empty_like(u), np.zeros(u.shape[1])
    for k in range(len(u)):
        y[k] = x
        x = a * x + (1.0 - a) * gain * u[k]
    return y


def motor(u: FloatArray, friction: float = 0.3, Ts: float = 2e-3) -> Pair:
    """Speed and angle of a motor with dry and Stribeck friction; tau is 11 samples."""
    w, angle = np.zeros(u.shape[1]), np.zeros(u.shape[1])
    speed, position = np.empty_like(u), np.empty_like(u)
    for k in range(len(u)):
        speed[k], position[k] = w, angle
        for _ in range(2):
            stribeck = friction * (1.0 + 0.6 * np.exp(-((w / 0.5) ** 2)))
            w = w + 0.5 * Ts / 0.02 * (0.9 * u[k] - 0.91 * w - stribeck * np.tanh(w / 0.025))
            angle = angle + 0.5 * Ts * w
    return speed, position


def position_loop(
    r: FloatArray, noise: FloatArray, *, kp: float, kv: float, friction: float, load: float = 0.03
) -> Pair:
    """Command and position of an axis under a P controller of position over one of speed."""
    u, y = np.empty_like(r), np.empty_like(r)
    q, v, last = np.zeros(r.shape[1]), np.zeros(r.shape[1]), np.zeros(r.shape[1])
    for k in range(len(r)):
        y[k] = q + noise[k]
        u[k] = np.clip(kv * (kp * (r[k] - y[k]) - (y[k] - last) / TS), -3.0, 3.0)
        last = y[k]
        for _ in range(2):
            v = v + 0.5 * TS * (u[k] - 2.1 * v - friction * np.tanh(v / 0.002) - load)
            q = q + 0.5 * TS * v
    return u, y


def speed_loop(
    r: FloatArray, noise: FloatArray, *, Kp: float, Ki: float, delay: int = 0, load: Any = None
) -> Pair:
    """Command and speed of a motor with friction under a PI controller."""
    u, y = np.zeros_like(r), np.empty_like(r)
    w, total = np.zeros(r.shape[1]), np.zeros(r.shape[1])
    for k in range(len(r)):
        y[k] = w + noise[k]
        error = r[k] - y[max(k - delay, 0)]
        total = total + Ki * 2e-3 * error
        u[k] = np.clip(Kp * error + total, -10.0, 10.0)
        torque = 0.0 if load is None else load[k]
        w = w + 2e-3 / 0.02 * (0.9 * u[k] - 0.91 * w - 0.1 * np.tanh(w / 0.05) - torque)
    return u, y


def noisy(random: np.random.Generator, y: FloatArray, part: float) -> FloatArray:
    """With white noise of a part of the standard deviation."""
    return y + part * y.std(axis=0) * random.standard_normal(y.shape)


def drift(random: np.random.Generator, n: int) -> FloatArray:
    walk = np.cumsum(random.standard_normal((n, SEEDS)), axis=0)
    return np.asarray(walk / walk.std(axis=0))


# --- integrators ----------------------------------------------------------------------------------


def _servo(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60)
    return u, noisy(random, np.cumsum(lag(u, 40.0, 2.0), axis=0), 0.002) + 1e4


def _servo_with_friction(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60) + 0.2
    return u, motor(u)[1] + 1e-3 * random.standard_normal(u.shape)


def _counts_under_prbs(random: np.random.Generator, n: int) -> Pair:
    u = prbs(random, n, -1.0, 1.0, n // 300)
    return u, np.round(motor(u, 0.05)[1] * 1000.0) + 1e6


def _always_forward(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, 1.0, 4.0, n // 60)
    return u, motor(u)[1] * 57.3


def _axis_in_a_loop(random: np.random.Generator, n: int) -> Pair:
    noise = 2e-6 * random.standard_normal((n, SEEDS))
    return position_loop(moves(random, n, 14, 0.12), noise, kp=30.0, kv=40.0, friction=0.22)


def _soft_loop(random: np.random.Generator, n: int) -> Pair:
    noise = 1e-5 * random.standard_normal((n, SEEDS))
    return position_loop(held(random, n, -0.2, 0.2, n // 15), noise, kp=8.0, kv=6.0, friction=0.1)


def _double_integrator(random: np.random.Generator, n: int) -> Pair:
    """Torque to angle, hardly damped, which only a loop keeps in place."""
    r, w = moves(random, n, 14, 1.0), 60.0 / (n * TS)
    u, y = np.empty_like(r), np.empty_like(r)
    q, v = np.zeros(SEEDS), np.zeros(SEEDS)
    for k in range(n):
        y[k] = q + 1e-5 * random.standard_normal(SEEDS)
        u[k] = w * w * (r[k] - q) - 1.4 * w * v
        v = v + TS * (u[k] - 0.02 * w * v + 0.1 * w * w)
        q = q + TS * v
    return u, y


def _backlash(random: np.random.Generator, n: int) -> Pair:
    u, x = _servo_with_friction(random, n)
    y, at, gap = np.empty_like(x), np.zeros(SEEDS), 0.05 * x.std(axis=0)
    for k in range(n):
        at = np.clip(at, x[k] - gap, x[k] + gap)
        y[k] = at
    return u, y + 1e-3 * random.standard_normal(y.shape)


def _noisy_position(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60)
    return u, noisy(random, np.cumsum(lag(u, 30.0), axis=0), 0.1)


def _valve(random: np.random.Generator, n: int) -> Pair:
    """An actuator whose rate is limited, faster to one side."""
    u = held(random, n, -1.0, 1.0, n // 150)
    return u, noisy(random, np.cumsum(np.clip(u, -0.4, 0.6), axis=0), 0.02)


def _multisine(random: np.random.Generator, n: int) -> Pair:
    u = 2.0 * band(random, n, 40.0 / n)
    return u, motor(u, 0.2)[1]


def _step_of_a_loop(random: np.random.Generator, n: int) -> Pair:
    r = np.where(np.arange(n)[:, None] < n // 10, 0.0, 0.1) * np.ones(SEEDS)
    noise = 1e-6 * random.standard_normal((n, SEEDS))
    return position_loop(r, noise, kp=8.0, kv=30.0, friction=0.05, load=0.0)


def _slow(part: float, low: float = -1.0, noise: float = 0.01) -> Family:
    """A first-order drive that was recorded for 1/part time constants."""

    def family(random: np.random.Generator, n: int) -> Pair:
        u = held(random, n, low, 1.0, n // 30)
        return u, noisy(random, lag(u, part * n, 3.0), noise) - 70.0

    return family


def _slow_under_prbs(random: np.random.Generator, n: int) -> Pair:
    u = prbs(random, n, 0.0, 1.0, n // 100)
    return u, noisy(random, lag(u, n / 3), 0.01)


def _slow_step(random: np.random.Generator, n: int) -> Pair:
    u = np.where(np.arange(n)[:, None] < n // 20, 0.0, 1.0) * np.ones(SEEDS)
    return u, noisy(random, lag(u, n / 5), 0.01)


def _speed(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60)
    return u, noisy(random, motor(u)[0], 0.01)


def _speed_that_drifts(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60)
    y = lag(u, 30.0, 2.0)
    return u, noisy(random, y + y.std(axis=0) * drift(random, n), 0.02)


def _speed_on_a_ramp(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60)
    return u, noisy(random, lag(u, 30.0, 2.0) + np.linspace(0.0, 12.0, n)[:, None], 0.02)


def _two_time_constants(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -1.0, 1.0, n // 30)
    return u, noisy(random, lag(u, n / 4, 2.0) + lag(u, n / 60), 0.01)


def _speed_in_a_loop(random: np.random.Generator, n: int) -> Pair:
    noise = 0.02 * random.standard_normal((n, SEEDS))
    return speed_loop(held(random, n, -3.0, 3.0, n // 60), noise, Kp=0.5, Ki=2.0)


def _overdamped(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -1.0, 1.0, n // 30)
    return u, noisy(random, lag(lag(u, n / 4, 3.0), n / 20), 0.005)


def _slow_and_uneven(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -1.0, 1.0, n // 30)
    return u, noisy(random, lag(np.tanh(1.5 * u) + 0.5 * u**2, n / 5), 0.02)


def _saturated(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -1.2, 1.2, n // 50)
    x = lag(u, n / 50, 1.5)
    return u, noisy(random, np.where(x > 0.0, np.tanh(x), 0.5 * x), 0.02)


def _swinging_sensor(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -3.0, 3.0, n // 60)
    phase = random.uniform(0.0, 6.0, SEEDS) + np.linspace(0.0, 9.0, n)[:, None]
    return u, noisy(random, lag(u, 30.0, 2.0) + 3.0 * np.sin(phase), 0.02)


def _resonance(random: np.random.Generator, n: int) -> Pair:
    u = band(random, n, 0.3)
    y, x, v = np.empty_like(u), np.zeros(SEEDS), np.zeros(SEEDS)
    for k in range(n):
        y[k] = x
        v = v + 0.3 * (0.3 * (u[k] - x - 0.2 * x**3) - 0.1 * v)
        x = x + 0.3 * v
    return u, noisy(random, y, 0.01)


def _tank(random: np.random.Generator, n: int) -> Pair:
    u = np.clip(3.0 + 1.6 * band(random, n, 20.0 / n), 0.2, 9.0)
    y, x = np.empty_like(u), np.full(SEEDS, 3.0)
    for k in range(n):
        y[k] = x
        x = np.maximum(x + 6.0 / n * (u[k] - 1.7 * np.sqrt(x)), 0.0)
    return u, noisy(random, y, 0.01)


def _static(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -1.0, 1.0, n // 40)
    return u, 3.0 * u + 1.0 + 0.01 * random.standard_normal(u.shape)


def _high_pass(random: np.random.Generator, n: int) -> Pair:
    u = held(random, n, -1.0, 1.0, n // 60)
    return u, u - lag(u, n / 20) + 0.01 * random.standard_normal(u.shape)


def _not_driven(random: np.random.Generator, n: int) -> Pair:
    return held(random, n, -1.0, 1.0, n // 40), drift(random, n)


RULES_INTEGRAL = [_servo, _servo_with_friction, _counts_under_prbs, _always_forward]
RULES_INTEGRAL += [_axis_in_a_loop, _soft_loop]
JUDGED_INTEGRAL = [_double_integrator, _backlash, _noisy_position, _valve, _multisine]
JUDGED_INTEGRAL += [_step_of_a_loop]
RULES_STABLE = [_slow(1 / 5), _slow(1 / 3, low=0.0), _slow_under_prbs, _slow_step, _speed]
RULES_STABLE += [_speed_that_drifts, _speed_on_a_ramp, _two_time_constants, _speed_in_a_loop]
JUDGED_STABLE = [_overdamped, _slow_and_uneven, _saturated, _swinging_sensor, _resonance, _tank]
JUDGED_STABLE += [_static, _high_pass, _not_driven, _slow(1 / 2), _slow(1 / 5, noise=0.3)]


def datasets(family: Family, seed: int, n: int) -> list[Dataset]:
    u, y = family(np.random.default_rng([seed, n]), n)
    return [Dataset.from_arrays(u[:, j], y[:, j], TS) for j in range(SEEDS)]


def found(kind: str, family: Family, seed: int, n: int) -> float:
    """Part of the records of a family that have that finding."""
    records = datasets(family, seed, n)
    return sum(sewfast.diagnose(d).find(kind) is not None for d in records) / SEEDS


@pytest.mark.nightly("both halves of the family", by_day=["rules-1500"])
@pytest.mark.parametrize("n", [1500, 6000])
@pytest.mark.parametrize("families", [RULES_INTEGRAL, JUDGED_INTEGRAL], ids=["rules", "judged"])
def test_positions_are_integrators(families: list[Family], n: int) -> None:
    parts = {f.__name__: found("integrator", f, 0, n) for f in families}
    assert min(parts.values()) >= 0.75, parts
    assert np.mean(list(parts.values())) >= 0.95, parts


@pytest.mark.nightly("both halves of the family", by_day=["judged-1500"])
@pytest.mark.parametrize("n", [1500, 6000])
@pytest.mark.parametrize("families", [RULES_STABLE, JUDGED_STABLE], ids=["rules", "judged"])
def test_what_comes_back_is_no_integrator(families: list[Family], n: int) -> None:
    parts = {f"{f.__name__} {i}": found("integrator", f, 1, n) for i, f in enumerate(families)}
    assert sum(parts.values()) * SEEDS <= 1.0, parts


@pytest.mark.parametrize("lengths", [3, 5])
def test_a_slow_drive_of_20000_samples_is_no_integrator(lengths: int) -> None:
    for data in datasets(_slow(1.0 / lengths), 2, lengths * 20_000)[:3]:
        assert sewfast.diagnose(data).find("integrator") is None


def test_a_short_record_is_called_short() -> None:
    for data in datasets(_slow(1 / 2), 3, 4000):
        short = sewfast.diagnose(data).find("short_record")
        assert short is not None
        assert short.evidence["time_constant_s"] == pytest.approx(2.0, rel=0.1)
        assert "2 times" in short.text
    assert all(found("short_record", f, 3, 4000) == 0.0 for f in (_speed, _servo, _slow(1 / 5)))


def test_the_gain_of_an_integrator() -> None:
    for data in datasets(_servo, 4, 6000):
        integrator = sewfast.diagnose(data).find("integrator")
        assert integrator is not None
        # 2 a sample
        assert integrator.evidence["gain_per_second"] == pytest.approx(2.0 / TS, rel=0.02)


def test_an_integrator_in_parts_and_with_gaps() -> None:
    """Several experiments, homed elsewhere each time; another input that does nothing; NaN."""
    random = np.random.default_rng(5)
    parts = []
    for i in range(4):
        u = held(random, 2000, -3.0, 3.0, 40)[:, :2]
        y = np.cumsum(lag(u, 20.0), axis=0)[:, 1] + 1000.0 * i
        y[300:330] = np.nan
        y[::7] = np.nan
        parts.append(Dataset.from_arrays(u, y, TS, input_names=["idle", "torque"]))
    integrator = sewfast.diagnose(Dataset.concat(parts)).find("integrator")
    assert integrator is not None
    assert integrator.evidence["input"] == "torque"


# --- closed loops ---------------------------------------------------------------------------------


def _coloured(random: np.random.Generator, shape: tuple[int, int], a: float) -> FloatArray:
    return lag(random.standard_normal(shape), -1.0 / np.log(a)) / np.sqrt((1.0 - a) / (1.0 + a))


OPEN_INPUTS: dict[str, Family] = {  # type: ignore[type-arg]
    "held": lambda r, n: held(r, n, -3.0, 3.0, 50),
    "prbs": lambda r, n: prbs(r, n, -1.0, 3.0, 10),
    "band": lambda r, n: 1.5 * band(r, n, 0.05),
    "white": lambda r, n: r.standard_normal((n, SEEDS)),
    "chirp": lambda r, n: 2.5 * chirp(n, 2.0 / n, 60.0 / n) + 1.0,
    "smooth": lambda r, n: 8.0 * lag(lag(r.standard_normal((n, SEEDS)), 20.0), 20.0),
}
PLANTS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "lag": lambda u: lag(u, 30.0, 2.0),
    "motor": lambda u: motor(u)[0],
    "position": lambda u: motor(u, 0.1)[1],
    "saturated": lambda u: np.tanh(lag(u, 20.0)),
    "rectified": lambda u: np.abs(lag(u, 20.0)),
    "at once": lambda u: 0.3 * u + lag(u, 5.0),
    "dead time": lambda u: np.vstack([np.zeros((15, SEEDS)), lag(u, 20.0)[:-15]]),
}
NOISES: dict[str, Callable[[np.random.Generator, tuple[int, int]], FloatArray]] = {
    "none": lambda r, shape: np.zeros(shape),
    "white": lambda r, shape: 0.05 * r.standard_normal(shape),
    "coloured": lambda r, shape: 0.1 * _coloured(r, shape, 0.95),
    "drift": lambda r, shape: 0.3 * drift(r, shape[0]),
}


@pytest.mark.nightly("many drives")
def test_open_loops_are_not_called_closed() -> None:
    """Fewer than 2 % false alarms, over every input, plant and noise."""
    random, n, closed, records = np.random.default_rng(6), 3000, [], 0
    for i, (signal, make) in enumerate(OPEN_INPUTS.items()):
        for k, (plant, answer) in enumerate(PLANTS.items()):
            u = make(random, n)
            clean = answer(u)
            for m, (noise, add) in enumerate(NOISES.items()):
                y = clean + clean.std(axis=0) * add(random, u.shape)
                if not FULL and (i + k + m) % 3:
                    continue
                j, records = (i + k + m) % SEEDS, records + 1
                data = Dataset.from_arrays(u[:, j], y[:, j], TS)
                if sewfast.diagnose(data).find("closed_loop"):
                    closed.append((signal, plant, noise))
    assert records == (168 if FULL else 56)
    assert len(closed) < 0.02 * records, closed


def _pi(random: np.random.Generator, n: int) -> Pair:
    return _speed_in_a_loop(random, n)


def _pi_with_delay(random: np.random.Generator, n: int) -> Pair:
    noise = 0.02 * random.standard_normal((n, SEEDS))
    return speed_loop(held(random, n, -3.0, 3.0, 100), noise, Kp=0.5, Ki=2.0, delay=1)


def _pi_on_a_chirp(random: np.random.Generator, n: int) -> Pair:
    noise = 0.02 * random.standard_normal((n, SEEDS))
    return speed_loop(2.0 + chirp(n, 3.0 / n, 50.0 / n), noise, Kp=0.5, Ki=2.0)


def _pi_under_load(random: np.random.Generator, n: int) -> Pair:
    """A clean sensor; what the loop answers to is a load that wanders."""
    noise = 0.001 * random.standard_normal((n, SEEDS))
    load = 0.1 * _coloured(random, noise.shape, 0.99)
    return speed_loop(held(random, n, -3.0, 3.0, 100), noise, Kp=0.5, Ki=4.0, load=load)


def _integral_control(random: np.random.Generator, n: int) -> Pair:
    noise = 0.02 * random.standard_normal((n, SEEDS))
    return speed_loop(held(random, n, -3.0, 3.0, 100), noise, Kp=0.0, Ki=1.0)


def _position_loop(random: np.random.Generator, n: int) -> Pair:
    noise = 1e-4 * random.standard_normal((n, SEEDS))
    r = held(random, n, -0.2, 0.2, n // 15)
    return position_loop(r, noise, kp=8.0, kv=6.0, friction=0.1)


@pytest.mark.parametrize(
    "family",
    [_pi, _pi_with_delay, _pi_on_a_chirp, _pi_under_load, _integral_control, _position_loop],
)
def test_closed_loops_are_seen(family: Family) -> None:
    assert found("closed_loop", family, 7, 6000) == 1.0


def test_a_loop_that_is_slower_than_the_record() -> None:
    """The controller runs at every fifth sample and holds its command between."""
    u, y = _pi_with_delay(np.random.default_rng(8), 4000)
    slow = np.repeat(u, 5, axis=0)
    fast = np.stack([np.interp(np.arange(20_000) / 5.0, np.arange(4000), c) for c in y.T], axis=1)
    loop = sewfast.diagnose(Dataset.from_arrays(slow[:, 0], fast[:, 0], TS)).find("closed_loop")
    assert loop is not None


def test_a_smoothed_output_is_not_asked_for_feedback() -> None:
    """A smoother without delay moves before the input does, which looks like feedback."""
    random = np.random.default_rng(9)
    u = lag(random.standard_normal((20_000, 1)), 30.0) * 8.0
    counts = np.floor(motor(u, 0.1)[1][:, 0] * 250.0)
    speed = sewfast.speed_from_counts(counts, 2e-3, 1572)
    data = Dataset.from_arrays(u, speed, 2e-3)
    assert sewfast.diagnose(data).find("closed_loop") is not None
    assert sewfast.diagnose(replace(data, looks_ahead=True)).find("closed_loop") is None
    assert data.resample(0.01).looks_ahead
    assert not data.resample(0.01, antialias=False).looks_ahead
    assert sewfast.record(sewfast.VirtualMachine(), np.ones(500)).dataset().looks_ahead


def test_a_reference_tells_of_a_loop() -> None:
    u, y = _pi(np.random.default_rng(10), 400)
    r = np.roll(y[:, 0], -3)
    for name, is_one in (("r", True), ("Setpoint", True), ("speed_true", False), ("rate", False)):
        data = Dataset.from_arrays(u[:, 0], y[:, 0], TS, channels={name: r})
        loop = sewfast.diagnose(data).find("closed_loop")
        assert (loop is not None and loop.evidence.get("reference") == name) == is_one


# --- inputs and trajectories ----------------------------------------------------------------------


def answer(u: FloatArray, noise: float = 0.01, seed: int = 0) -> Dataset:
    y = lag(u[:, None], 20.0)[:, 0]
    y = y + noise * y.std() * np.random.default_rng(seed).standard_normal(len(y))
    return Dataset.from_arrays(u, y, TS)


def test_two_levels() -> None:
    random = np.random.default_rng(11)
    bits = prbs(random, 4000, -1.0, 3.0, 9)[:, 0]
    sine = np.sin(np.arange(4000) / 30.0)
    rounded = lag(bits[:, None], 1.0)[:, 0]
    three = np.repeat(random.choice([-1.0, 0.0, 1.0], 400), 10)
    for u, two in (
        (bits, True),
        (bits + 0.1 * random.standard_normal(4000), True),
        (np.where(np.arange(4000) < 300, 0.0, 5.0), True),
        (np.r_[bits, 50.0], True),
        (sine, False),
        (three, False),
        (rounded, False),
        (held(random, 4000, -1.0, 1.0, 40)[:, 0], False),
        (random.standard_normal(4000), False),
    ):
        assert (sewfast.diagnose(answer(u)).find("two_level_input") is not None) == two
    both = Dataset.from_arrays(np.column_stack([bits, bits[::-1], sine]), rounded, TS)
    names = [f.evidence["input"] for f in sewfast.diagnose(both).findings]
    assert names == ["u1", "u2"]


def test_a_trajectory_that_repeats() -> None:
    random = np.random.default_rng(12)
    once = band(random, 1111, 0.05)[:, 0]
    found = sewfast.diagnose(answer(np.tile(once, 4)[:4000])).find("repeats")
    assert found is not None
    assert found.evidence["period_s"] == pytest.approx(1.111)
    assert found.evidence["times"] == pytest.approx(3.6, abs=0.01)
    # once and a half is no repetition that the held-out end could have been learned from
    assert sewfast.diagnose(answer(np.tile(once, 2)[:1600])).find("repeats") is None
    for u in (once, chirp(4000, 5e-4, 0.02)[:, 0], held(random, 4000, -1, 1, 40)[:, 0]):
        assert sewfast.diagnose(answer(u)).find("repeats") is None
    # a closed loop: the reference repeats, the command holds noise
    r = np.tile(moves(random, 3000, 3, 0.12), (3, 1))
    noise = 5e-6 * random.standard_normal(r.shape)
    u, y = position_loop(r, noise, kp=30.0, kv=40.0, friction=0.22)
    found = sewfast.diagnose(Dataset.from_arrays(u[:, 0], y[:, 0], TS)).find("repeats")
    assert found is not None
    assert found.evidence["period_s"] == pytest.approx(3.0, abs=0.02)


def test_a_period_in_a_long_record() -> None:
    once = band(np.random.default_rng(13), 60_000, 0.005)[:, 0]
    u = np.tile(once, 4)
    found = sewfast.diagnose(Dataset.from_arrays(u, u, TS)).find("repeats")
    assert found is not None
    assert found.evidence["period_s"] == pytest.approx(60.0, rel=1e-3)


def test_ends_at_rest() -> None:
    u = held(np.random.default_rng(14), 2000, -1.0, 1.0, 40)[:, 0]
    rest = sewfast.diagnose(answer(np.r_[np.zeros(500), u, np.zeros(1500)])).find("rests")
    assert rest is not None
    # the output takes some time constants to come to rest
    assert rest.evidence["share"] == pytest.approx(0.48, abs=0.02)
    first, last = rest.evidence["first"], rest.evidence["last"]
    assert isinstance(first, float)
    assert isinstance(last, float)
    assert 400 <= first <= 500
    assert 2500 <= last <= 2700
    assert f"--train {first:.0f}:{last:.0f}" in rest.remedy
    white = np.random.default_rng(15).standard_normal(4000)
    for quiet in (u, np.r_[np.zeros(200), u], white, np.sin(np.arange(4000) / 50.0)):
        assert sewfast.diagnose(answer(quiet)).find("rests") is None


def test_an_angle_that_wraps() -> None:
    u, angle = _always_forward(np.random.default_rng(16), 4000)
    wrapped = Dataset.from_arrays(u[:, 0], np.mod(angle[:, 0], 360.0), TS, output_unit="deg")
    diagnosis = sewfast.diagnose(wrapped)
    wraps = diagnosis.find("wraps")
    assert wraps is not None
    assert wraps.evidence["period"] == 360.0
    assert diagnosis.find("integrator") is None
    bits = prbs(np.random.default_rng(17), 4000, -1.0, 1.0, 50)[:, 0]
    spiked = angle[:, 0].copy()
    spiked[[700, 1500, 2000]] += 1e4
    spikes = Dataset.from_arrays(u[:, 0], spiked, TS)
    assert sewfast.diagnose(spikes).find("wraps") is None
    # a static plant jumps by its whole range too
    assert sewfast.diagnose(Dataset.from_arrays(bits, 3.0 * bits, TS)).find("wraps") is None
    # so does noise, now and then; but its moves are of every size
    for seed in range(12):
        r = np.random.default_rng(seed)
        noise = Dataset.from_arrays(r.normal(size=4000), r.normal(size=4000), TS)
        assert sewfast.diagnose(noise).find("wraps") is None


def test_coarse_outputs_and_limited_inputs() -> None:
    u = 3.0 * band(np.random.default_rng(18), 4000, 0.01)[:, 0]
    data = answer(np.clip(u, -2.0, 2.0), noise=0.0)
    limits = [f for f in sewfast.diagnose(data).findings if f.kind == "limited_input"]
    assert [f.evidence["limit"] for f in limits] == [-2.0, 2.0]
    assert sewfast.diagnose(answer(u)).find("limited_input") is None
    y = data.experiments[0].y
    for steps, coarse in ((4.0, True), (40.0, False)):
        step = y.std() / steps
        rounded = Dataset.from_arrays(u, np.round(y / step) * step, TS)
        found = sewfast.diagnose(rounded).find("coarse_output")
        assert (found is not None) == coarse


# --- the whole ------------------------------------------------------------------------------------


def test_a_diagnosis_prints_itself() -> None:
    (data, *_) = datasets(_counts_under_prbs, 19, 3000)
    diagnosis = sewfast.diagnose(data)
    assert [f.kind for f in diagnosis.findings] == ["integrator", "two_level_input"]
    text = str(diagnosis)
    assert "--differentiate" in text
    assert "nonlinearity" in text
    assert repr(diagnosis) == "Diagnosis(integrator, two_level_input)"
    numbers = json.loads(json.dumps(diagnosis.to_json(), allow_nan=False))
    assert numbers["findings"][0]["evidence"]["input"] == "u"
    assert "nothing" in str(Diagnosis(()))
    with pytest.raises(DataError, match="expected a Dataset"):
        sewfast.diagnose(data.experiments[0])  # type: ignore[arg-type]


def test_good_data_have_no_findings() -> None:
    u = held(np.random.default_rng(20), 20_000, -3.0, 3.0, 100)[:, 0]
    assert sewfast.diagnose(answer(u)).findings == ()


values = st.floats(width=64) | st.sampled_from([0.0, 1.0, np.nan, np.inf, 1e308, -1e308, 5e-324])


@settings(deadline=None, max_examples=40)
@given(st.data(), st.integers(1, 60), st.integers(1, 2), st.sampled_from([1, 9]))
def test_a_diagnosis_of_anything(draw: st.DataObject, n: int, inputs: int, times: int) -> None:
    u = draw.draw(hnp.arrays(np.float64, (n, inputs), elements=values))
    y = draw.draw(hnp.arrays(np.float64, n, elements=values))
    u, y = np.tile(u, (times, 1)), np.tile(y, times)
    data = Dataset((Experiment(u, y), Experiment(u, y)), 0.01, *_names(inputs))
    json.dumps(sewfast.diagnose(data).to_json(), allow_nan=False)


def test_an_input_that_is_wild_where_the_output_is_missing_overflows_nowhere() -> None:
    """Beside it the inputs that count are so small that in their scale its square is infinite."""
    u, y = np.zeros(34), np.full(34, 1e150)
    u[:2] = 4e-151, 1e9
    y[[0, 2, 3]] = 0.0, 0.0, 1.0
    once = Experiment(np.tile(u, 9)[:, None], np.tile(y, 9))
    found = sewfast.diagnose(Dataset((once, once), 0.01, *_names(1)))
    assert found.find("integrator") is None


def test_an_input_that_is_unknown_in_one_experiment_says_nothing_there() -> None:
    u = held(np.random.default_rng(0), 2000, -3.0, 3.0, 100)[:, 0]
    (known,) = answer(u).experiments
    unknown = Experiment(np.full((2000, 1), np.nan), known.y)
    both = Dataset((known, unknown), 0.01, *_names(1))
    assert sewfast.diagnose(both).findings == sewfast.diagnose(answer(u)).findings


def _names(inputs: int) -> tuple[Any, ...]:
    return tuple(f"u{i}" for i in range(inputs)), "y", ("",) * inputs


def test_public_recordings(recordings: Path) -> None:
    """A motor's speed and its position, a loop with its reference, a two-level input."""
    bldc = recordings / "bldc_cigan" / "bldc.csv"
    position = sewfast.diagnose(sewfast.read(bldc, inputs="u", output="position"))
    assert position.find("integrator") is not None
    assert sewfast.diagnose(sewfast.read(bldc, inputs="u", output="y")).find("integrator") is None
    motor = recordings / "dc_motor_un"
    loop = sewfast.read(motor / "stairs_closed_exp.csv", inputs="u", output="y", channels=["r"])
    assert sewfast.diagnose(loop).find("closed_loop") is not None
    bits = sewfast.read(motor / "prbs_open_exp.csv", inputs="u", output="y")
    kinds = {f.kind for f in sewfast.diagnose(bits).findings}
    assert kinds == {"two_level_input", "coarse_output"}
