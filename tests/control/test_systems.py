"""The linear loop as state space: equal to the simulated loop where nothing is limited."""

from dataclasses import replace

import numpy as np
import pytest

from loops import QUIET, drive
from sewfast import run
from sewfast.control import Controller, Gains
from sewfast.control.margins import loop_response
from sewfast.control.systems import LinearLoop, response, simulate
from sewfast.models import LinearOE

IDEAL = replace(QUIET, counts_per_rev=None, u_min=-np.inf, u_max=np.inf)
CONTROLLERS = {
    "plain": replace(IDEAL, filter_samples=1, N=np.inf),
    "averaged": IDEAL,
    "lagged": replace(IDEAL, filter_time=0.004, beta=0.6),
    "observed": replace(IDEAL, observer_time=0.003),
    "without integral": replace(IDEAL, gains=Gains.standard(0.02, np.inf, 0.003)),
}


def loop(controller: Controller, model: LinearOE | None = None) -> LinearLoop:
    return LinearLoop.of(controller, (model or drive()).to_ss())


@pytest.mark.parametrize("name", CONTROLLERS)
def test_equals_the_simulated_loop(name: str) -> None:
    controller = CONTROLLERS[name]
    r = np.cumsum(np.random.default_rng(1).normal(size=600))
    r -= r[0]
    told = run(controller, drive(), r)
    found = simulate(loop(controller).closed, np.column_stack([r, np.zeros(600)]))
    assert np.allclose(found[:, 0], told.y, rtol=0, atol=1e-9 * np.abs(told.y).max())
    assert np.allclose(found[:, 1], told.u, rtol=0, atol=1e-9 * np.abs(told.u).max())


def test_sensitivities_add_up_and_poles_are_those_of_the_loop() -> None:
    linear = loop(IDEAL)
    hertz = np.geomspace(0.1, 499.0, 60)
    L, S, T = (response(getattr(linear, n), hertz, 0.001) for n in "LST")
    assert np.allclose(S, 1 / (1 + L), rtol=1e-8)
    assert np.allclose(S + T, 1.0, rtol=0, atol=1e-9)
    poles = np.linalg.eigvals(linear.S.A)
    assert np.allclose(np.sort(np.abs(poles))[::-1][:3], np.abs(linear.poles())[:3], rtol=1e-9)
    assert np.abs(linear.poles()).max() < 1.0
    hot = loop(replace(IDEAL, gains=Gains.standard(0.3, 0.05, 0.003)))
    assert np.abs(hot.poles()).max() > 1.0


def test_alpha_and_beta_do_not_touch_the_disturbance() -> None:
    other = replace(IDEAL, alpha=0.9, beta=-0.5)
    d = np.column_stack([np.zeros(400), np.ones(400)])
    one, two = (simulate(loop(c).closed, d) for c in (IDEAL, other))
    assert np.array_equal(one, two)
    r = d[:, ::-1]
    assert not np.allclose(*(simulate(loop(c).closed, r) for c in (IDEAL, other)))


def test_a_schedule_is_taken_at_a_speed_with_its_slope() -> None:
    points = (
        (200.0, Gains.standard(0.01, 0.1, 0.002)),
        (2000.0, Gains.standard(0.03, 0.05, 0.002)),
    )
    scheduled = replace(IDEAL, schedule=points, alpha=0.3)
    hertz = np.geomspace(0.5, 400.0, 40)
    for speed in (100.0, 1000.0, 3000.0):
        linear = LinearLoop.of(scheduled, drive().to_ss(), speed=speed)
        expected = loop_response(scheduled, drive(), 2 * np.pi * hertz, speed=speed)
        assert np.allclose(response(linear.L, hertz, 0.001), expected, rtol=1e-7)
    # small signals about 1,000 RPM are those of the simulated loop
    r = np.full(3000, 1000.0)
    r[2500:] += 1e-3
    told = run(scheduled, drive(), r).y[2500:] - 1000.0
    linear = LinearLoop.of(scheduled, drive().to_ss(), speed=1000.0)
    step = simulate(linear.tracking, np.full((500, 1), 1e-3))[:, 0]
    assert np.allclose(told, step, rtol=0, atol=2e-5)


def test_the_encoder_delays_by_half_a_sample() -> None:
    hertz = np.array([1.0, 50.0, 200.0])
    ideal = response(loop(IDEAL).L, hertz, 0.001)
    counted = response(loop(replace(IDEAL, counts_per_rev=1572.0)).L, hertz, 0.001)
    assert np.allclose(np.angle(ideal / counted), 2 * np.pi * hertz * 0.0005, rtol=1e-9)


def test_toolboxes_get_the_same_loop() -> None:
    control = pytest.importorskip("control")
    pytest.importorskip("scipy")
    linear = loop(IDEAL)
    T = linear.to_control("T")
    assert T.dt == 0.001
    hertz = np.array([1.0, 20.0])
    assert np.allclose(T(np.exp(2j * np.pi * hertz * 0.001)), response(linear.T, hertz, 0.001))
    steps = control.step_response(linear.to_control("tracking"), T=np.arange(300) * 0.001)
    expected = simulate(linear.tracking, np.ones((300, 1)))[:, 0]
    assert np.allclose(steps.outputs, expected, atol=1e-9)
    _, y = linear.to_scipy("disturbance").step(n=300)
    expected = simulate(linear.disturbance, np.ones((300, 1)))[:, 0]
    assert np.allclose(np.squeeze(y), expected, atol=1e-7)
