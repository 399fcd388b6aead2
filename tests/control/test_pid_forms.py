"""A PID in MATLAB's and python-control's terms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sewfast import Controller, Gains, SettingError
from sewfast.control.forms import from_control, from_matlab, matlab_code, to_control, to_matlab

PID = Controller(
    Gains.standard(0.02, 0.2, 0.01), 0.001, alpha=0.4, beta=0.3, N=8.0, filter_samples=4,
    filter_time=0.003, observer_time=0.002,
)  # fmt: skip
FORMULAS = {"IFormula": "BackwardEuler", "DFormula": "BackwardEuler"}


def matlab_response(kind: str, n: dict[str, Any], w: np.ndarray) -> tuple[Any, Any]:
    """From r and y to u, from MATLAB's documentation of its PID objects."""
    z = np.exp(1j * w * n["Ts"])
    IF = DF = n["Ts"] * z / (z - 1)
    b, c = n.get("b", 1.0), n.get("c", 1.0)
    if kind.startswith("pidstd"):
        integral = n["Kp"] / n["Ti"] * IF
        derivative = n["Kp"] * n["Td"] / (n["Td"] / n["N"] + DF)
    else:
        integral, derivative = n["Ki"] * IF, n["Kd"] / (n["Tf"] + DF)
    return n["Kp"] * b + integral + derivative * c, -(n["Kp"] + integral + derivative)


@pytest.mark.parametrize("kind", ["pid", "pid2", "pidstd", "pidstd2"])
@pytest.mark.parametrize("N", [8.0, math.inf])
def test_matlabs_transfer_functions_are_the_controllers(kind: Any, N: float) -> None:
    bare = replace(PID, N=N, filter_samples=1, filter_time=0.0, observer_time=0.0)
    if not kind.endswith("2"):
        with pytest.raises(SettingError, match="take pid"):
            to_matlab(bare, kind)
        bare = replace(bare, alpha=0.0, beta=0.0)
    numbers = to_matlab(bare, kind)
    w = np.geomspace(1.0, 3000.0, 30)
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    assert control.isdtime(to_control(bare))
    z = np.exp(1j * w * bare.Ts)
    found = np.array([to_control(bare)(v)[0] for v in z])
    for column, exact in zip(found.T, matlab_response(kind, numbers, w), strict=True):
        np.testing.assert_allclose(column, exact, rtol=1e-9)


@given(
    st.floats(1e-4, 1e4), st.floats(1e-4, 1e4) | st.just(math.inf),
    st.floats(1e-4, 10.0) | st.just(0.0), st.floats(0.5, 50.0) | st.just(math.inf),
    st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.sampled_from(["pid2", "pidstd2"]),
)  # fmt: skip
def test_the_way_there_and_back(
    Kp: float, Ti: float, Td: float, N: float, alpha: float, beta: float, kind: Any
) -> None:
    start = Controller(Gains.standard(Kp, Ti, Td), 0.002, alpha=alpha, beta=beta, N=N)
    back = from_matlab(kind, **to_matlab(start, kind))
    gains = back.gains.to("standard")
    assert (gains.Kp, gains.Ti, gains.Td) == pytest.approx((Kp, Ti, Td), rel=1e-14)
    assert (back.alpha, back.beta) == pytest.approx((alpha, beta), abs=1e-15)
    assert pytest.approx(N, rel=1e-14) == back.N or (Td == 0.0 and math.isinf(back.N))


def test_python_control_steps_as_the_controller_does() -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    rng = np.random.default_rng(2)
    r, y = np.concatenate([[[0.0], [0.0]], rng.normal(size=(2, 400))], axis=1)
    t = np.arange(len(r)) * PID.Ts
    core = PID.core()
    stepped = [core.step(a, b) for a, b in zip(r, y, strict=True)]
    _, found = control.forced_response(to_control(PID), t, np.array([r, y]))
    np.testing.assert_allclose(np.squeeze(found), stepped, atol=1e-9 * np.abs(stepped).max())


def test_code_for_matlab() -> None:
    text = matlab_code(replace(PID, gains=Gains.standard(0.02, math.inf, 0.01)), "pidstd2")
    assert text == (
        "C = pidstd2(0.02, Inf, 0.01, 8.0, 0.6, 0.7, 0.001, 'IFormula', 'BackwardEuler', "
        "'DFormula', 'BackwardEuler');"
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"form": "pidx"}, "pidx"),
        ({"Ts": 0.0}, "continuous"),
        ({"IFormula": "Trapezoidal"}, "IFormula"),
        ({"DFormula": "ForwardEuler"}, "DFormula"),
        ({"Tf": -1.0}, "Tf"),
        ({"Kp": -1.0}, "sign of Kp"),
        ({"N": 3.0}, "received"),
        ({"Kd": "x"}, "Kd"),
    ],
)
def test_nothing_is_guessed(change: dict[str, Any], says: str) -> None:
    given = {"form": "pid", "Kp": 1.0, "Ki": 2.0, "Kd": 0.1, "Tf": 0.01, "Ts": 0.001, **FORMULAS}
    with pytest.raises(SettingError, match=says):
        from_matlab(**{**given, **change})
    missing = {k: v for k, v in given.items() if k != "Ki"}
    with pytest.raises(SettingError, match="Ki"):
        from_matlab(**missing)


# --- out of python-control ------------------------------------------------------------------------

POSITIVE = st.floats(1e-4, 1e4)


@pytest.mark.parametrize("as_fraction", [False, True])
@example(9061.5, math.inf, 0.75, 0.5, 0.0, 0.0)
@example(1.0, math.inf, 0.79296875, 0.5, 0.0, 0.0)
@given(
    POSITIVE | POSITIVE.map(lambda x: -x), st.floats(1e-2, 1e3) | st.just(math.inf),
    st.floats(1e-4, 1.0) | st.just(0.0), st.floats(0.5, 50.0) | st.just(math.inf),
    st.floats(-2.0, 2.0), st.floats(-2.0, 2.0),
)  # fmt: skip
def test_the_way_to_python_control_and_back(
    as_fraction: bool, Kp: float, Ti: float, Td: float, N: float, alpha: float, beta: float
) -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    start = Controller(Gains.standard(Kp, Ti, Td), 0.002, alpha=alpha, beta=beta, N=N)
    system = to_control(start)
    if as_fraction:
        a, b = (fraction(control, start, w) for w in ((1 - alpha, 1 - beta), (1.0, 1.0)))
        system = control.tf([[a.num[0][0], -b.num[0][0]]], [[a.den[0][0], b.den[0][0]]], 0.002)
    back = from_control(system)
    gains = back.gains.to("standard")
    assert gains.Kp == pytest.approx(Kp, rel=1e-7)
    assert gains.Ti == pytest.approx(Ti, rel=1e-5)
    assert gains.Td == pytest.approx(Td, rel=1e-7)
    assert back.alpha == pytest.approx(alpha, abs=1e-7)
    if Td:
        assert pytest.approx(N, rel=1e-6) == back.N
        assert back.beta == pytest.approx(beta, abs=1e-6)
    assert back.Ts == 0.002


def fraction(control: Any, c: Controller, weights: tuple[float, float]) -> Any:
    """C(z) as one would write it down, over one denominator."""
    g = c.gains.to("standard")
    z, Ts = control.tf([1, 0], [1], c.Ts), c.Ts
    Tf = g.Td / c.N
    found = weights[0] * g.Kp + 0 * z / z
    if not math.isinf(g.Ti):
        found = control.tf([weights[0] * g.Kp + g.Kp * Ts / g.Ti, -weights[0] * g.Kp], [1, -1], Ts)
    if g.Td:
        return found + weights[1] * g.Kp * g.Td * (z - 1) / ((Tf + Ts) * z - Tf)
    return control.tf([weights[0] * g.Kp], [1], Ts) if math.isinf(g.Ti) else found


def test_a_pid_from_the_error_and_inputs_by_their_names() -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    bare = replace(PID, filter_samples=1, filter_time=0.0, observer_time=0.0)
    alike = replace(bare, alpha=0.0, beta=0.0)
    one = from_control(fraction(control, alike, (1.0, 1.0)), u_unit="A", y_unit="rad/s")
    assert (one.alpha, one.beta, one.N) == pytest.approx((0.0, 0.0, 8.0))
    assert one.gains.units["Kp"] == "A/rad/s"
    s = to_control(bare)
    turned = control.ss(
        s.A, s.B[:, ::-1], s.C, s.D[:, ::-1], s.dt, inputs=["y", "r"], outputs=["u"]
    )
    assert from_control(turned).alpha == pytest.approx(0.4)
    unstated = control.ss(s.A, s.B, s.C, s.D, True, inputs=["r", "y"], outputs=["u"])
    assert from_control(unstated, Ts=0.001).gains.Td == pytest.approx(0.01)


def cases(control: Any) -> dict[str, tuple[Callable[[], Any], str]]:
    z = control.tf([1, 0], [1], 0.001)
    s = to_control(replace(PID, filter_samples=1, filter_time=0.0, observer_time=0.0))
    return {
        "no system": (lambda: 5, "received int"),
        "continuous time": (lambda: control.tf([1, 1], [1, 0]), "continuous"),
        "no sample time": (lambda: control.ss(s.A, s.B, s.C, s.D, True), "give Ts"),
        "feedback filters": (lambda: to_control(PID), "feedback filters out"),
        "trapezes": (lambda: 1 + 0.1 * (z - 1) / (z + 1), "backward difference"),
        "an integral that leaks": (
            lambda: 1 + 0.1 * z / (z - 0.999) + (z - 1) / (z - 0.5),
            "0.999",
        ),
        "a double integral": (lambda: 1 + 0.1 * z / (z - 1) / (z - 1), "received 1, 1"),
        "no derivative": (lambda: control.tf([1, 0, 0], [1, -1], 0.001), "causal"),
        "gains of two signs": (lambda: 1 - 0.1 * z / (z - 1), "sign of Kp"),
        "an output that adds": (
            lambda: control.ss(s.A, abs(s.B), s.C, abs(s.D), 0.001),
            "integral",
        ),
        "two commands": (lambda: control.ss(s.A, s.B, s.A, s.B, 0.001), "2 outputs"),
        "feedforward": (lambda: control.tf([[[1], [0]]], [[[1], [1]]], 0.001), "feedforward"),
    }


def test_what_is_no_pid_is_refused() -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    for name, (make, says) in cases(control).items():
        with pytest.raises(SettingError, match=says):
            pytest.fail(f"{name}: {from_control(make())}")
    with pytest.raises(SettingError, match="leave it out"):
        from_control(to_control(PID), Ts=0.002)
