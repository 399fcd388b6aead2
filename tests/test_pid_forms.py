"""A PID in MATLAB's and python-control's terms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sewfast import Controller, Gains, SettingError
from sewfast.pid_forms import from_matlab, matlab_code, to_control, to_matlab

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
