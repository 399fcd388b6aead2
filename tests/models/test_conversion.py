"""Linear models as transfer functions, state spaces and other packages' objects, and back."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sewfast import ARX, IV, LinearOE, SettingError, _core
from sewfast.models.conversion import StateSpace, logarithm

control = pytest.importorskip("control", reason="needs the extra 'control'")
signal = pytest.importorskip("scipy.signal", reason="needs the extra 'control'")

OMEGA = np.geomspace(1.0, 300.0, 40)
Ts = 0.01


def random_model(seed: int, inputs: int, nk: int | None = None, **options: Any) -> LinearOE:
    """Stable, poles of any kind, orders 1 to 4."""
    rng = np.random.default_rng(seed)
    na, nb = rng.integers(1, 5, 2)
    roots: list[complex] = []
    while len(roots) < na:
        root = rng.uniform(0.2, 0.97) * np.exp(1j * rng.uniform(0.0, np.pi))
        roots += [root, root.conj()] if na - len(roots) > 1 else [complex(rng.uniform(0.1, 0.95))]
    a = np.real(np.poly(roots))[1:]
    nk = int(rng.integers(0, 4)) if nk is None else nk
    core = _core.LinearModel(a, rng.normal(size=(inputs, nb)), nk, float(rng.normal()))
    names = tuple(f"in{i}" for i in range(inputs))
    return LinearOE(core, Ts, names, "speed", ("V",) * inputs, "RPM", **options)


def same(one: Any, other: Any, rtol: float = 0.0) -> None:
    for name in ("a", "b", "nk", "offset"):
        got, expected = np.asarray(getattr(one.core, name)), np.asarray(getattr(other.core, name))
        assert got.shape == expected.shape, name
        scale = max(np.abs(expected).max(initial=0.0), 1.0)
        np.testing.assert_allclose(got, expected, rtol=0, atol=rtol * scale, err_msg=name)


def from_rest(model: LinearOE, u: np.ndarray) -> np.ndarray:
    """Deviations after zero input before the start, which a leading stretch of zeros makes."""
    lead = np.zeros((20, u.shape[1]))
    bare = _core.LinearModel(model.core.a, model.core.b, model.core.nk, 0.0)
    return bare.simulate(np.vstack([lead, u]), np.zeros(bare.na))[20:]


def state_space_run(s: StateSpace, u: np.ndarray) -> np.ndarray:
    x, y = np.zeros(len(s.A)), []
    for row in u:
        y.append(float(s.C[0] @ x + s.D[0] @ row))
        x = s.A @ x + s.B @ row
    return np.array(y)


# --- simulations and frequency responses ------------------------------------------------------


@pytest.mark.parametrize("inputs", [1, 2, 3])
@pytest.mark.parametrize("seed", range(12))
def test_every_form_has_the_same_run_and_frequency_response(seed: int, inputs: int) -> None:
    model = random_model(seed, inputs)
    u = np.random.default_rng(seed).normal(size=(200, inputs))
    expected = from_rest(model, u)
    scale = np.abs(expected).max()
    s = model.to_ss()
    assert len(s.A) == max(model.core.na, model.core.nk + model.core.b.shape[1] - 1)
    np.testing.assert_allclose(state_space_run(s, u), expected, rtol=0, atol=1e-11 * scale)
    num, den = model.to_tf()
    filtered = sum(signal.lfilter(n, den, u[:, i]) for i, n in enumerate(num))
    np.testing.assert_allclose(filtered, expected, rtol=0, atol=1e-11 * scale)
    out = signal.dlsim(model.to_scipy(), u)[1]
    np.testing.assert_allclose(np.ravel(out), expected, rtol=0, atol=1e-11 * scale)
    response = model.frequency_response(OMEGA)
    assert response.shape == (inputs, len(OMEGA))
    z = np.exp(1j * OMEGA * Ts)
    for form in ("tf", "ss"):
        system = model.to_control(form)
        assert system.dt == Ts
        assert system.input_labels == list(model.input_names)
        assert system.output_labels == ["speed"]
        theirs = np.array([np.asarray(system(v)).reshape(1, -1)[0] for v in z]).T
        np.testing.assert_allclose(theirs, response, rtol=1e-8, atol=1e-10 * np.abs(response).max())
    answer = control.forced_response(model.to_control("ss"), inputs=u.T).outputs
    np.testing.assert_allclose(np.ravel(answer), expected, rtol=0, atol=1e-11 * scale)


def test_the_documented_state_is_what_the_past_contributes() -> None:
    model = random_model(5, 2, nk=2)
    s, core = model.to_ss(), model.core
    u = np.random.default_rng(1).normal(size=(60, 2))
    y, x = from_rest(model, u), np.zeros(len(s.A))
    num, den = model.to_tf()
    for k in range(60):
        for i in range(1, len(x) + 1):
            terms = [-den[m] * y[k - 1 - m + i] for m in range(i, len(den)) if k - 1 - m + i >= 0]
            terms += [
                num[:, m] @ u[k - 1 - m + i] for m in range(i, num.shape[1]) if k - 1 - m + i >= 0
            ]
            assert x[i - 1] == pytest.approx(sum(terms), abs=1e-10)
        x = s.A @ x + s.B @ u[k]
    assert core.nk == 2


# --- back -----------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), inputs=st.integers(1, 3))
def test_round_trips_are_exact(seed: int, inputs: int) -> None:
    model = random_model(seed, inputs)
    names: dict[str, Any] = {"input_names": model.input_names, "output_name": "speed"}
    kept = {"offset": model.core.offset}
    one_bit = 4e-16 * (1 + np.abs(model.core.a).max()) if model.core.nk == 0 else 0.0
    same(LinearOE.from_tf(*model.to_tf(), Ts, **kept), model)
    same(LinearOE.from_ss(*model.to_ss(), Ts, **kept), model, one_bit)
    tf = LinearOE.from_control(model.to_control(), **kept)
    same(tf, model)
    assert (tf.input_names, tf.output_name, tf.Ts) == (model.input_names, "speed", Ts)
    same(LinearOE.from_control(model.to_control("ss"), **kept), model, one_bit)
    back = LinearOE.from_scipy(model.to_scipy(), **kept, **names)
    same(back, model, one_bit)
    assert back.input_names == model.input_names


def test_the_class_it_is_called_on_is_the_class_of_the_model() -> None:
    model = random_model(3, 1)
    for cls in (ARX, IV, LinearOE):
        assert type(cls.from_tf(*model.to_tf(), Ts)) is cls


@pytest.mark.parametrize("seed", range(10))
def test_any_state_space_becomes_a_model_with_the_same_run(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, nu = rng.integers(1, 5), rng.integers(1, 4)
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.5, 0.95) / np.abs(np.linalg.eigvals(A)).max()
    s = StateSpace(A, rng.normal(size=(n, nu)), rng.normal(size=(1, n)), rng.normal(size=(1, nu)))
    u = rng.normal(size=(100, nu))
    model = LinearOE.from_ss(*s, Ts)
    expected = state_space_run(s, u)
    worst = np.abs(from_rest(model, u) - expected).max()
    assert worst < 1e-10 * np.abs(expected).max()


def test_different_denominators_are_multiplied_out() -> None:
    G = control.tf([[[1.0], [2.0, 0.5]]], [[[1.0, -0.5], [1.0, -0.9, 0.2]]], Ts)
    model = LinearOE.from_control(G)
    assert model.orders == {"na": 3, "nb": 3, "nk": 1}
    z = np.exp(1j * OMEGA * Ts)
    expected = np.array([1 / (z - 0.5), (2 * z + 0.5) / (z**2 - 0.9 * z + 0.2)])
    np.testing.assert_allclose(model.frequency_response(OMEGA), expected, rtol=1e-10)


def test_zeros_and_poles_of_scipy_are_taken() -> None:
    system = signal.ZerosPolesGain([0.2], [0.5, 0.9], 2.0, dt=Ts)
    model = LinearOE.from_scipy(system)
    np.testing.assert_allclose(model.core.a, [-1.4, 0.45], rtol=1e-14)
    np.testing.assert_allclose(model.core.b, [[2.0, -0.4]], rtol=1e-14)


def test_the_offset_is_kept_by_an_operating_point() -> None:
    model = random_model(8, 2, nk=1)
    u0 = np.array([1.5, -0.5])
    y0 = model.steady_output(u0)
    held = np.tile(u0, (2000, 1))
    assert model.core.simulate(held, np.zeros(model.core.na))[-1] == pytest.approx(y0, rel=1e-9)
    back = LinearOE.from_tf(*model.to_tf(), Ts, operating_point=(u0, y0))
    assert back.core.offset == pytest.approx(model.core.offset, rel=1e-9)


# --- continuous time ------------------------------------------------------------------------------


@pytest.mark.parametrize("nk", [1, 4])
@pytest.mark.parametrize("inputs", [1, 2])
def test_the_hold_of_the_continuous_model_is_the_model(nk: int, inputs: int) -> None:
    motor = control.ss(
        [[-4.0, 300.0], [-3.0, -135.0]], np.array([[0.0, -40.0], [135.0, 0.0]])[:, :inputs],
        [[1.0, 0.0]], np.zeros((1, inputs)),
    )  # fmt: skip
    sampled = control.sample_system(motor, Ts, "zoh")
    model = LinearOE.from_control(sampled)
    num, den = model.to_tf()
    delayed = np.hstack([np.zeros((inputs, nk - 1)), num])
    found = LinearOE.from_tf(delayed, den, Ts).to_continuous()
    assert found.dead_time == pytest.approx((nk - 1) * Ts)
    np.testing.assert_allclose(
        sorted(p.real for p in found.poles), sorted(np.real(motor.poles())), rtol=1e-8
    )
    dead = np.exp(-1j * OMEGA * found.dead_time)
    theirs = np.array([np.asarray(motor(1j * w)).reshape(1, -1)[0] for w in OMEGA]).T * dead
    np.testing.assert_allclose(found.frequency_response(OMEGA), theirs, rtol=1e-7)
    again = LinearOE.from_control(control.sample_system(found.to_control(), Ts, "zoh"))
    np.testing.assert_allclose(again.core.a, model.core.a, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.core.b, model.core.b, rtol=0, atol=1e-9)


def test_the_logarithm_inverts_the_exponential() -> None:
    linalg = pytest.importorskip("scipy.linalg")
    rng = np.random.default_rng(2)
    for _ in range(40):
        n = int(rng.integers(1, 6))
        matrix = rng.normal(size=(n, n)) * rng.uniform(0.01, 1.0)
        found = logarithm(linalg.expm(matrix))
        np.testing.assert_allclose(linalg.expm(found), linalg.expm(matrix), rtol=0, atol=1e-10)
    np.testing.assert_allclose(logarithm(np.eye(2)), np.zeros((2, 2)), atol=0)
    defective = np.array([[0.5, 1.0], [0.0, 0.5]])
    np.testing.assert_allclose(linalg.expm(logarithm(defective)), defective, atol=1e-12)


@pytest.mark.parametrize(
    ("num", "den", "words"),
    [
        ([0.0, 1.0], [1.0, 0.5], r"-0\.5"),
        ([0.0, 1.0, 0.3], [1.0, 0.0, 0.0], "off the negative"),
        ([0.0, 1.0, 0.3, 0.1], [1.0, -0.5], "nb <= na"),
    ],
)
def test_what_has_no_continuous_equivalent_is_refused(num: Any, den: Any, words: str) -> None:
    with pytest.raises(SettingError, match=words):
        LinearOE.from_tf(num, den, Ts).to_continuous()


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LinearOE.from_tf([1.0], [0.0, 1.0], Ts), "other than 0"),
        (lambda: LinearOE.from_tf([0.0, 0.0], [1.0, 0.5], Ts), "zeros only"),
        (lambda: LinearOE.from_tf([np.nan], [1.0, 0.5], Ts), "finite"),
        (lambda: LinearOE.from_tf([[[1.0]]], [1.0], Ts), "shape"),
        (lambda: LinearOE.from_tf(["a"], [1.0], Ts), "real numbers"),
        (lambda: LinearOE.from_tf([1.0], [1.0, 0.5], 0.0), "sample time"),
        (lambda: LinearOE.from_tf([1.0], [1.0, 0.5], Ts, input_names=["a", "b"]), "1 input names"),
        (
            lambda: LinearOE.from_tf([1.0], [1.0, 0.5], Ts, offset=1.0, operating_point=(0, 0)),
            "received both",
        ),
        (lambda: LinearOE.from_tf([1.0], [1.0], Ts, operating_point=([1, 2], 0)), "1 inputs"),
        (lambda: LinearOE.from_ss(np.eye(2), [[1], [1]], np.eye(2), [[0], [0]], Ts), "one output"),
        (lambda: LinearOE.from_control(control.tf([1], [1, 1])), "discrete time"),
        (lambda: LinearOE.from_control(control.tf([1], [1, 0.5], True)), "dt is True"),
        (lambda: LinearOE.from_control(control.tf([1], [1, 0.5], Ts), 0.02), "leave Ts out"),
        (
            lambda: LinearOE.from_control(control.tf([[[1]], [[1]]], [[[1, 0.5]], [[1, 0.5]]], Ts)),
            "one output",
        ),
        (lambda: LinearOE.from_scipy(signal.lti([1], [1, 1])), "discrete time"),
        (lambda: LinearOE.from_tf([0.0, 1.0], [1.0, -1.0], Ts).steady_output([1.0]), "pole at 1"),
        (lambda: LinearOE.from_tf([1.0], [1.0, 0.5], Ts).to_control("zpk"), "'tf' or 'ss'"),
    ],
)
def test_what_is_no_model_is_refused_with_a_remedy(make: Any, words: str) -> None:
    with pytest.raises(SettingError, match=words):
        make()


def test_dt_true_takes_the_given_sample_time() -> None:
    assert LinearOE.from_control(control.tf([1], [1, 0.5], True), Ts).Ts == Ts


@pytest.mark.parametrize(("module", "call"), [("control", "to_control"), ("scipy", "to_scipy")])
def test_a_missing_package_is_named(
    module: str, call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [m for m in sys.modules if m == module or m.startswith(f"{module}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SettingError, match=r"sewfast\[control\]"):
        getattr(random_model(1, 1), call)()
