"""Small signals of the compiled models about their equilibria."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .dataset import FloatArray
from .errors import SettingError, SewfastError

_RUN = 2000
"""Samples of constant input to bring a model near its equilibrium."""
_NEWTON = 30


@dataclass(frozen=True, eq=False)
class Linearised:
    """x+ = A x + B v, y = C x + D v in small signals, v(k) = u(k - delay); in the data's units.
    `state` is that of the linearisation, as for the compiled model's `simulate`. `drift` is the
    change of an integrator's output per sample at this state, 0 for other models.
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
    drift: float = 0.0


def linearise(
    core: Any, u: FloatArray, state: FloatArray | None = None, level: float | None = None
) -> Linearised:
    """Linearise about the equilibrium at a constant input, searched from `state` (None: rest). `u`
    has shape (nu,). `level` is the output level for an integrator, which rests at any level or at
    none.
    """
    u = np.ascontiguousarray(u, dtype=np.float64)
    if hasattr(core, "a") and hasattr(core, "offset"):
        return _linear(core, u, level)
    settings = core.settings
    if "na" in settings:
        return _network(core, settings, u, state)
    if "nx" in settings:
        return _state_space(core, settings, u, state, level)
    raise SettingError(f"linearise: expected a model of sewfast, received {type(core).__name__}")


# --- lagged models -------------------------------------------------------------------------------


def _linear(core: Any, u: FloatArray, level: float | None) -> Linearised:
    left = 1.0 + float(core.a.sum())
    push = float(core.b.sum(axis=1) @ u + core.offset)
    settled = bool(abs(left) > 1e-12)
    if settled:
        y, drift = push / left, 0.0
    else:
        # A(q) = (1 - q^-1) F(q): the output moves by push / F(1) a sample
        rest = float(np.cumsum(np.concatenate([[1.0], core.a]))[:-1].sum())
        y = np.nan if level is None else level
        drift = push / rest if rest != 0.0 else np.inf
    state = np.full(core.na, y if np.isfinite(y) else 0.0)
    return _difference(-core.a, core.b, core.nk, y, settled, False, state, drift)


def _network(core: Any, s: dict[str, Any], u: FloatArray, state: FloatArray | None) -> Linearised:
    na, nb = s["na"], s["nb"]

    def slopes(y: float) -> tuple[float, FloatArray, FloatArray]:
        """f at constant y and u, and its slopes in every past output (na,) and input (nu, nb)."""
        past = np.full(na, y)
        value = float(core.simulate(u[None, :], past)[0])
        _, _, C, D = core.linearise(u, np.concatenate([past, np.repeat(u, nb - 1)]))
        return value, C[0, :na], np.hstack([D.T, C[0, na:].reshape(len(u), nb - 1)])

    y = _steady(core, u, np.zeros(na) if state is None else state)
    # for a model without scales, the magnitude of the output there
    scale = s.get("y_scale", max(abs(y), 1e-6))
    settled = False
    for _ in range(_NEWTON):
        value, to_y, _ = slopes(y)
        step = (value - y) / (1.0 - to_y.sum()) if abs(1.0 - to_y.sum()) > 1e-12 else np.inf
        settled = bool(abs(step) <= 1e-9 * scale)
        if settled or not np.isfinite(step) or abs(step) > 100.0 * scale:
            break
        y += step
    _, to_y, to_u = slopes(y)
    limited = any(s.get(name) is not None for name in ("output_low", "output_high"))
    # on a limit nothing moves the output
    saturated = limited and not (to_y.any() or to_u.any())
    return _difference(to_y, to_u, s["nk"], y, settled, saturated, np.full(na, y))


def _steady(core: Any, u: FloatArray, state: FloatArray) -> float:
    """The output after a long constant input; if that diverges, the output of the state."""
    try:
        return float(core.simulate(np.tile(u, (_RUN, 1)), state)[-1])
    except SewfastError:
        return float(state[0]) if len(state) else 0.0


def _difference(
    to_y: FloatArray, to_u: FloatArray, nk: int, y: float, settled: bool, saturated: bool,
    state: FloatArray, drift: float = 0.0,
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
    return Linearised(y, A, B, np.eye(1, n), d[None, :], nk, settled, saturated, state, drift)


# --- state space ---------------------------------------------------------------------------------


def _state_space(
    core: Any, s: dict[str, Any], u: FloatArray, state: FloatArray | None, level: float | None
) -> Linearised:
    x = _last_state(core, u, core.rest_state() if state is None else state)
    # an integrator's last state drifts, and no other state depends on it
    free = len(x) - 1 if s["integrator"] else len(x)
    held = np.tile(u, (2, 1))
    settled = False
    for _ in range(_NEWTON):
        matrix = (np.eye(len(x)) - core.linearise(u, x)[0])[:free, :free]
        if not np.isfinite(matrix).all() or (free and np.linalg.cond(matrix) > 1e12):
            break
        step = np.linalg.solve(matrix, (core.states(held, x)[1] - x)[:free])
        settled = bool(np.abs(step).max(initial=0.0) <= 1e-9)
        if settled or not np.isfinite(step).all() or np.abs(step).max(initial=0.0) > 100.0:
            break
        x = x.copy()
        x[:free] += step
    settled = settled and bool(np.abs(core.states(held, x)[1] - x).max(initial=0.0) <= 1e-6)
    if s["integrator"] and level is not None:
        x = _moved_to(core, u, x, level)
    A, B, C, D = core.linearise(u, x)
    y, following = np.ravel(core.simulate(held, x))
    drift = float(following - y) if s["integrator"] else 0.0
    return Linearised(float(y), A, B, C[:1], D[:1], s["nk"], settled, False, x, drift)


def _moved_to(core: Any, u: FloatArray, x: FloatArray, level: float) -> FloatArray:
    """The integrator's state, the last one, with the output `level` (Newton); else unchanged."""
    moved = x.copy()
    for _ in range(_NEWTON):
        left = level - float(np.ravel(core.simulate(u[None, :], moved))[0])
        if abs(left) <= 1e-9 * max(abs(level), 1.0):
            return moved
        slope = float(core.linearise(u, moved)[2][0, -1])
        if abs(slope) < 1e-12:
            break
        moved[-1] += left / slope
        if not np.isfinite(moved).all():
            break
    return x


def _last_state(core: Any, u: FloatArray, state: FloatArray) -> FloatArray:
    try:
        last = np.array(core.states(np.tile(u, (_RUN, 1)), state)[-1])
    except SewfastError:
        return np.array(state)
    return last if np.isfinite(last).all() else np.array(state)
