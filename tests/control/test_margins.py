"""Margins of the sampled loop: against python-control, against runs of the controller itself."""

from __future__ import annotations

import math
import warnings
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plants import bent_data
from sewfast import (
    Biquad,
    Controller,
    Ensemble,
    Gains,
    LinearOE,
    SettingError,
    identify,
    margins,
    operating_point,
)
from sewfast.control import Fopdt
from sewfast.control.margins import loop_response
from sewfast.evidence import operating_range

Ts = 0.001
DRIVE = Fopdt(490.0, 0.25, 0.0083)
PID = Controller(
    Gains.standard(0.012, 0.08, 0.006), Ts, N=8.0, filter_samples=5, filter_time=0.002
)  # fmt: skip


def fraction(controller: Controller, plant: Fopdt) -> tuple[Any, Any]:
    """Path and plant as python-control has them, written from docs/CONVENTIONS.md."""
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    g = controller.gains.to("per_sample", Ts=Ts)
    standard = controller.gains.to("standard")
    z = control.tf([1, 0], [1], Ts)
    Tf = standard.Td / controller.N
    pid = g.Kp + g.Ki * z / (z - 1) + standard.Kp * standard.Td * (z - 1) / ((Tf + Ts) * z - Tf)
    n = controller.filter_samples
    mean = control.tf([1.0 / n] * n, [1.0] + [0.0] * (n - 1), Ts)
    lag = Ts * z / ((Ts + controller.filter_time) * z - controller.filter_time)
    whole, part = divmod(plant.L, Ts)
    a = math.exp(-Ts / plant.T)
    early = math.exp(-(Ts - part) / plant.T)
    num = [plant.K * (1 - early), plant.K * (early - a)]
    G = control.tf(num, [1.0, -a] + [0.0] * (int(whole) + 1), Ts)
    return pid * mean * lag, G


def test_the_same_as_python_control() -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    R, G = fraction(PID, DRIVE)
    found = margins(PID, DRIVE)
    omega = np.geomspace(0.1, math.pi / Ts, 4000)
    L = (R * G)(np.exp(1j * omega * Ts))
    np.testing.assert_allclose(loop_response(PID, DRIVE, omega), L, rtol=1e-7)
    with warnings.catch_warnings():
        # it takes a grid of frequencies where its polynomials are inaccurate, and says so
        warnings.simplefilter("ignore")
        gm, pm, _, wpc, wgc, _ = control.stability_margins(R * G)
    assert found.stable
    assert (found.gain_margin, found.phase_margin_deg) == pytest.approx((gm, pm), rel=1e-4)
    assert wpc == pytest.approx(min(found.phase_crossovers, key=lambda w: abs(w - wpc)), rel=1e-4)
    assert wgc == pytest.approx(found.gain_crossovers[0], rel=1e-4)
    assert found.Ms == pytest.approx(np.max(1 / np.abs(1 + L)), rel=1e-4)
    assert found.Mt == pytest.approx(np.max(np.abs(L / (1 + L))), rel=1e-4)
    assert found.delay_margin_s == pytest.approx(math.radians(pm) / wgc, rel=1e-4)


def test_noise_gain_is_that_of_a_simulation() -> None:
    """White noise on the speed, through the controller itself: the exact figure within 5 sigma."""
    from sewfast import _core

    found = margins(PID, DRIVE)
    num, den = _core.sampled_fopdt(DRIVE.K, DRIVE.T, DRIVE.L, Ts=Ts)
    noise = np.random.default_rng(5).standard_normal(100_000)
    core, past, y, u = PID.core(), np.zeros(len(num) - 1), 0.0, np.zeros(len(noise))
    for k, n in enumerate(noise):
        u[k] = core.step(0.0, y + n)
        past = np.concatenate([[u[k]], past[:-1]])
        y = float(-den[1] * y + num[1:] @ past)
    u = u[2000:]
    # the variance of a mean square of a Gaussian process is 2 sum r(m)^2 / N
    r = np.fft.irfft(np.abs(np.fft.rfft(u - u.mean(), 2 * len(u))) ** 2)[:500] / len(u)
    sigma = math.sqrt(2 * (r[0] ** 2 + 2 * np.sum(r[1:] ** 2)) / len(u)) / r[0] / 2
    assert sigma < 0.02
    assert np.sqrt(np.mean(u**2)) == pytest.approx(found.noise_gain, rel=5 * sigma)


@settings(max_examples=40, deadline=None)
@given(
    st.floats(0.001, 0.1), st.floats(0.01, 1.0) | st.just(math.inf), st.floats(0.0, 0.02),
    st.integers(1, 12), st.booleans(), st.floats(0.0, 0.03),
)  # fmt: skip
def test_stable_is_what_decays(
    Kp: float, Ti: float, Td: float, samples: int, encoder: bool, L: float
) -> None:
    counts = 1572.0 if encoder else None
    controller = Controller(
        Gains.standard(Kp, Ti, Td), Ts, N=10.0, filter_samples=samples, counts_per_rev=counts
    )
    plant = replace(DRIVE, L=L)
    found = margins(controller, plant)
    assert found.stable == (found.largest_pole < 1.0)
    if not found.stable:
        assert math.isinf(found.Ms)
        assert math.isnan(found.delay_margin_s)
        assert "unstable" in str(found)
        return
    assert found.Ms >= 1 / (1 - 1 / found.gain_margin) - 1e-6
    if found.delay_margin_s > 0.1:
        return
    late = margins(controller, replace(plant, L=L + Ts * math.ceil(found.delay_margin_s / Ts + 1)))
    early = margins(controller, replace(plant, L=L + Ts * math.floor(found.delay_margin_s / Ts)))
    assert early.stable or early.largest_pole < 1.0 + 1e-6
    assert not late.stable


def linear(num: list[float], den: list[float]) -> Any:
    return LinearOE.from_tf(num, den, Ts, input_units=["V"], output_unit="RPM")


def test_a_plant_in_any_form() -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    signal = pytest.importorskip("scipy.signal", reason="needs the extra 'control'")
    lag = replace(DRIVE, L=0.0)
    expected = margins(PID, lag).to_dict()
    continuous = control.tf([490.0], [0.25, 1.0])
    a = math.exp(-Ts / 0.25)
    model = linear([0.0, 490.0 * (1 - a)], [1.0, -a])
    point = operating_range(model, [np.array([2.0])]).points[0]
    plants = [
        model, point, model.to_control(), model.to_control("ss"), model.to_scipy(), continuous,
        signal.lti([490.0], [0.25, 1.0]), signal.dlti([490.0 * (1 - a)], [1.0, -a], dt=Ts),
    ]  # fmt: skip
    for plant in plants:
        for name, value in margins(PID, plant).to_dict().items():
            if isinstance(value, float):
                assert value == pytest.approx(expected[name], rel=1e-5), (name, plant)


def test_an_encoder_is_half_a_sample_in_the_loop() -> None:
    ideal, counted = margins(PID, DRIVE), margins(replace(PID, counts_per_rev=1572.0), DRIVE)
    assert ideal.delay_margin_s - counted.delay_margin_s == pytest.approx(Ts / 2, rel=0.01)


def test_a_nonlinear_model_at_a_speed() -> None:
    model = identify(bent_data(), model="neural_oe", hidden=4, starts=1, seed=0)
    controller = Controller(Gains.standard(0.3, 0.2), model.Ts)
    fast, slow = (margins(controller, model, speed=y) for y in (2.6, 0.0))
    point = operating_range(model, [np.array([0.0])]).points[0]
    assert slow.Ms == pytest.approx(margins(controller, point).Ms, rel=0.1)
    # the input saturates: the gain falls, the loop is slower
    assert fast.gain_crossovers[0] < 0.7 * slow.gain_crossovers[0]
    with pytest.raises(SettingError, match="give speed"):
        margins(controller, model)
    with pytest.raises(SettingError, match="holds at a constant command"):
        margins(controller, model, speed=1e6)


def test_an_operating_point_saves_the_search_and_no_bit() -> None:
    model = identify(bent_data(), model="neural_oe", hidden=4, starts=1, seed=0)
    point = operating_point(model, 2.0)
    assert point.y == pytest.approx(2.0, rel=1e-3)
    for Kp in (0.3, 0.6):
        controller = Controller(Gains.standard(Kp, 0.2), model.Ts)
        found, direct = (margins(controller, p, speed=2.0) for p in (point, model))
        assert found == direct
    with pytest.raises(SettingError, match="members"):
        operating_point(Ensemble.of([model, model]), 2.0)


def test_what_is_no_plant_is_refused() -> None:
    two = LinearOE.from_tf([[0, 1.0], [0, 2.0]], [1.0, -0.5], Ts)
    for plant, says in [
        (two, "one input"),
        (linear([1.0], [1.0, -0.5]), "nk = 1"),
        (LinearOE.from_tf([0.0, 1.0], [1.0, -0.5], 0.002), "sample time"),
        ("drive", "received str"),
    ]:
        with pytest.raises(SettingError, match=says):
            margins(PID, plant)
    with pytest.raises(SettingError, match="omega"):
        loop_response(PID, DRIVE, [0.0])
    with pytest.raises(SettingError, match=r"the order is margins\(controller, plant\)"):
        margins(DRIVE, PID)  # type: ignore[arg-type]


def shaft(pitch: float = 1.0, gain: float = 1.0, delay: int = 0) -> Any:
    """A motor of first order whose shaft swings at 60 Hz and stands at 40 Hz, sampled."""
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    low, high = (2.0 * math.pi * pitch * f for f in (40.0, 60.0))
    zeros, poles = ([1.0, 2.0 * 0.02 * w, w * w] for w in (low, high))
    num = 490.0 * gain * (high / low) ** 2 * np.array(zeros)
    sampled = control.sample_system(control.tf(num, np.polymul([0.25, 1.0], poles)), Ts)
    return sampled * control.tf([1.0], [1.0] + delay * [0.0], Ts)


def test_a_narrow_notch_bears_no_other_resonance() -> None:
    plain = Controller(Gains.standard(0.03, 0.1, 0.0), Ts)
    narrow, wide = (
        replace(plain, biquads=(Biquad.notch(60.0, depth, width),))
        for depth, width in ((0.016, 0.25), (0.1, 1.0))
    )
    found, bears = margins(narrow, shaft()), margins(wide, shaft())
    assert found.changed is not None
    assert bears.changed is not None
    assert found.Ms < bears.Ms < 1.8
    assert found.changed[0] == found.Ms_robust == math.inf
    assert "unstable with its resonance" in str(found)
    Ms, gain, delay, pitch = bears.changed
    assert margins(wide, shaft(pitch, gain, delay)).Ms == pytest.approx(Ms, rel=0.01)
    assert bears.Ms_robust == 0.5 * Ms
    assert f"Ms {Ms:.3f} with its resonance 10 % lower" in str(bears)
    stiff = margins(narrow, DRIVE)
    assert stiff.changed is None
    assert stiff.Ms_robust == stiff.Ms


def test_margins_print_and_do_not_change() -> None:
    found = margins(PID, DRIVE)
    with pytest.raises(FrozenInstanceError):
        found.Ms = 1.0  # type: ignore[misc]
    text = str(found)
    for part in (f"Ms {found.Ms:.3f}", "phase margin", "V/RPM"):
        assert part in text
