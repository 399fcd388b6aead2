"""Small signals of the compiled models: equilibrium and A, B, C, D from their numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..dataset import FloatArray
from ..errors import SettingError, SewfastError

_RUN = 2000
"""Samples of a constant input that bring a model near its equilibrium."""
_NEWTON = 30


@dataclass(frozen=True, eq=False)
class Linearised:
    """x+ = A x + B v, y = C x + D v in small signals, v(k) = u(k - delay); in the data's units.

    Attributes
    ----------
    state : array
        Where it is linearised, as the compiled model's `simulate` takes it.
    """

    y: float
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    delay: int
    settled: bool
    saturated: bool
    state: FloatArray


def linearise(core: Any, u: FloatArray, state: FloatArray | None = None) -> Linearised:
    """About the equilibrium at a constant input, sought from `state` on (None: rest).

    Raises
    ------
    SettingError
        For a kind of model that is none of the linear difference equation, the network and the
        neural state-space model.
    """
    if hasattr(core, "a") and hasattr(core, "offset"):
        return _linear(core, u)
    settings = core.settings
    if "na" in settings:
        return _network(core, settings, u, state)
    if "nx" in settings:
        return _state_space(core, settings, u, state)
    raise SettingError(f"linearise: expected a model of sewfast, received {type(core).__name__}")


# --- lagged models -------------------------------------------------------------------------------


def _linear(core: Any, u: FloatArray) -> Linearised:
    left = 1.0 + core.a.sum()
    settled = bool(abs(left) > 1e-12)
    y = float((core.b.sum(axis=1) @ u + core.offset) / left) if settled else np.nan
    state = np.full(core.na, y if settled else 0.0)
    return _difference(-core.a, core.b, core.nk, y, settled, False, state)


def _network(core: Any, s: dict[str, Any], u: FloatArray, state: FloatArray | None) -> Linearised:
    y = _steady(core, u, np.zeros(s["na"]) if state is None else state)
    settled = False
    for _ in range(_NEWTON):
        value, to_y, to_u, saturated = _gradient(core, s, y, u)
        step = (value - y) / (1.0 - to_y.sum()) if abs(1.0 - to_y.sum()) > 1e-12 else np.inf
        settled = bool(abs(step) <= 1e-9 * s["y_scale"])
        if settled or not np.isfinite(step) or abs(step) > 100.0 * s["y_scale"]:
            break
        y += step
    value, to_y, to_u, saturated = _gradient(core, s, y, u)
    return _difference(to_y, to_u, s["nk"], y, settled, saturated, np.full(s["na"], y))


def _steady(core: Any, u: FloatArray, state: FloatArray) -> float:
    """The output after a long constant input; where that runs away, the state's own."""
    try:
        return float(core.simulate(np.tile(u, (_RUN, 1)), state)[-1])
    except SewfastError:
        return float(state[0]) if len(state) else 0.0


def _gradient(
    core: Any, s: dict[str, Any], y: float, u: FloatArray
) -> tuple[float, FloatArray, FloatArray, bool]:
    """f at constant y and u, and its slopes in every past output (na,) and input (nu, nb)."""
    theta, na, nb, width = core.theta, s["na"], s["nb"], len(u)
    phi = np.concatenate(
        [
            np.full(na, (y - s["y_mean"]) / s["y_scale"]),
            np.repeat((u - s["u_mean"]) / s["u_scale"], nb),
        ]
    )
    hidden, n = s["hidden"], len(phi)
    w1 = theta[: hidden * n].reshape(hidden, n)
    b1, w2 = theta[hidden * n :][:hidden], theta[hidden * (n + 1) :][:hidden]
    b2 = theta[hidden * (n + 2)]
    linear = theta[hidden * (n + 2) + 1 :] if s["bypass"] else np.zeros(n)
    h = np.tanh(w1 @ phi + b1)
    value = w2 @ h + b2 + linear @ phi
    slope = (w2 * (1.0 - h**2)) @ w1 + linear
    low, high = s["output_low"], s["output_high"]
    saturated = (low is not None and value <= low) or (high is not None and value >= high)
    if saturated:
        value, slope = min(max(value, low), high), np.zeros(n)
    to_u = slope[na:].reshape(width, nb) * s["y_scale"] / s["u_scale"][:, None]
    return float(value * s["y_scale"] + s["y_mean"]), slope[:na], to_u, bool(saturated)


def _difference(
    to_y: FloatArray, to_u: FloatArray, nk: int, y: float, settled: bool, saturated: bool,
    state: FloatArray,
) -> Linearised:  # fmt: skip
    """Observer form of y(k) = sum to_y_i y(k-i) + sum to_u_ji v_j(k-i+1)."""
    n = max(len(to_y), to_u.shape[1] - 1)
    a, later = np.zeros(n), np.zeros((n, len(to_u)))
    a[: len(to_y)] = to_y
    later[: to_u.shape[1] - 1] = to_u[:, 1:].T
    d = to_u[:, 0]
    A = np.eye(n, k=1)
    A[:, 0] += a
    B = later + np.outer(a, d)
    return Linearised(y, A, B, np.eye(1, n), d[None, :], nk, settled, saturated, state)


# --- state space ---------------------------------------------------------------------------------


def _state_space(
    core: Any, s: dict[str, Any], u: FloatArray, state: FloatArray | None
) -> Linearised:
    m = _matrices(core.theta, s)
    v = (u - s["u_mean"]) / s["u_scale"]
    x = _last_state(core, u, core.rest_state() if state is None else state)
    # an integrator's last state drifts, and nothing but itself depends on it
    free = len(x) - 1 if s["integrator"] else len(x)
    settled = False
    for _ in range(_NEWTON):
        ahead, A, B, *_ = _slopes(m, s, x, v)
        matrix = (np.eye(len(x)) - A)[:free, :free]
        if free and np.linalg.cond(matrix) > 1e12:
            break
        step = np.linalg.solve(matrix, (ahead - x)[:free])
        settled = bool(np.abs(step).max(initial=0.0) <= 1e-9)
        if settled or not np.isfinite(step).all() or np.abs(step).max(initial=0.0) > 100.0:
            break
        x = x.copy()
        x[:free] += step
    ahead, A, B, C, D, y = _slopes(m, s, x, v)
    settled = settled and bool(np.abs(ahead - x).max(initial=0.0) <= 1e-6)
    gain = s["y_scale"][0] / s["u_scale"]
    y0 = float(y[0] * s["y_scale"][0] + s["y_mean"][0])
    return Linearised(
        y0, A, B / s["u_scale"], C[:1] * s["y_scale"][0], D[:1] * gain, s["nk"], settled, False, x
    )


def _matrices(theta: FloatArray, s: dict[str, Any]) -> dict[str, FloatArray]:
    nx, nu, ny, hidden = s["nx"], s["n_inputs"], s["n_outputs"], s["hidden"]
    shapes = {
        "A": (nx, nx), "B": (nx, nu), "E": (nx, hidden), "Wx": (hidden, nx), "Wu": (hidden, nu),
        "bh": (hidden,), "C": (ny, nx), "D": (ny, nu), "c": (ny,), "G": (ny, hidden),
    }  # fmt: skip
    found, at = {}, 0
    for name, shape in shapes.items():
        size = int(np.prod(shape))
        found[name] = np.asarray(theta[at : at + size]).reshape(shape)
        at += size
    return found


def _slopes(
    m: dict[str, FloatArray], s: dict[str, Any], x: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """x+, then A, B, C, D and y about (x, v) in scaled units."""
    h = np.tanh(m["Wx"] @ x + m["Wu"] @ v + m["bh"])
    slope = (1.0 - h**2)[:, None]
    by_x, by_u = slope * m["Wx"], slope * m["Wu"]
    ahead = m["A"] @ x + m["B"] @ v + m["E"] @ h
    s_out = m["C"] @ x + m["D"] @ v + m["c"] + m["G"] @ h
    y, bend = _output(s_out, s)
    A, B = m["A"] + m["E"] @ by_x, m["B"] + m["E"] @ by_u
    C = bend[:, None] * (m["C"] + m["G"] @ by_x)
    D = bend[:, None] * (m["D"] + m["G"] @ by_u)
    return ahead, A, B, C, D, y


def _output(value: FloatArray, s: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """f(s) and f'(s) of docs/CONVENTIONS.md."""
    given = s["output_parameters"]
    if s["output"] == "abs":
        y = np.sqrt(value**2 + given[0] ** 2)
        return y, value / y
    if s["output"] == "saturation":
        low, high, w = given
        below, above = (value - low) / w, (value - high) / w
        y = low + w * np.logaddexp(0.0, below) - w * np.logaddexp(0.0, above)
        return y, _logistic(below) - _logistic(above)
    return value, np.ones_like(value)


def _logistic(z: FloatArray) -> FloatArray:
    found: FloatArray = 0.5 * (1.0 + np.tanh(0.5 * z))
    return found


def _last_state(core: Any, u: FloatArray, state: FloatArray) -> FloatArray:
    try:
        last = np.array(core.states(np.tile(u, (_RUN, 1)), state)[-1])
    except SewfastError:
        return np.array(state)
    return last if np.isfinite(last).all() else np.array(state)
