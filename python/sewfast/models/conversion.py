"""A linear model's coefficients as transfer function and state space, and back.

Only deviations from an operating point are converted; the offset is what makes one out of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..dataset import FloatArray
from ..errors import SettingError


class StateSpace(NamedTuple):
    """x(k+1) = A x(k) + B u(k), y(k) = C x(k) + D u(k); shapes (n, n), (n, nu), (1, n), (1, nu)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


def transfer_function(core: _core.LinearModel) -> tuple[FloatArray, FloatArray]:
    """Numerators (nu, nk + nb) and the common denominator (na + 1,), in powers of z^-1."""
    num = np.hstack([np.zeros((len(core.b), core.nk)), core.b])
    return num, np.concatenate([[1.0], core.a])


def difference_equation(num: ArrayLike, den: ArrayLike, offset: float) -> _core.LinearModel:
    """The model of a transfer function in powers of z^-1, the opposite of `transfer_function`.

    Leading zeros that all numerators share become the delay; trailing ones are left out.

    Raises
    ------
    SettingError
        Where shapes are wrong, values are not finite, or the denominator begins with zero.
    """
    numerators, denominator = np.atleast_2d(_finite(num, "num")), _finite(den, "den")
    if numerators.ndim != 2 or denominator.ndim != 1 or 0 in (numerators.size, denominator.size):
        raise SettingError(
            "expected num of shape (m,) or (n_inputs, m) and den of shape (na + 1,), received "
            f"{np.shape(num)} and {np.shape(den)}"
        )
    if denominator[0] == 0.0:
        raise SettingError(
            "den: expected a first coefficient other than 0, received 0; y(k) must not depend on "
            "later samples: give coefficients of z^0, z^-1, .."
        )
    used = np.flatnonzero(np.any(numerators != 0.0, axis=0))
    if len(used) == 0:
        raise SettingError("num: expected a coefficient other than 0, received zeros only")
    b = numerators[:, used[0] : used[-1] + 1] / denominator[0]
    a = denominator[1:] / denominator[0] if len(denominator) > 1 else np.zeros(1)
    return _core.LinearModel(a, np.ascontiguousarray(b), int(used[0]), float(offset))


def observer_form(core: _core.LinearModel) -> StateSpace:
    """State space of order max(na, nk + nb - 1) in observer form.

    `x_i(k)` is what inputs and outputs up to sample k - 1 contribute to `y(k+i-1)`:
    `x_i(k) = sum_{m >= i} ( -a_m y(k-1-m+i) + beta_m u(k-1-m+i) )`, with the numerator
    `beta_0 + beta_1 z^-1 + ..`, in which the delay is leading zeros.
    """
    num, den = transfer_function(core)
    n = max(len(den), num.shape[1]) - 1
    a, beta = _padded(den[None], n + 1)[0], _padded(num, n + 1)
    A = np.eye(n, k=1)
    A[:, 0] = -a[1:]
    B = beta[:, 1:].T - np.outer(a[1:], beta[:, 0])
    C = np.eye(1, n)
    return StateSpace(A, np.ascontiguousarray(B), C, beta[:, :1].T.copy())


def from_state_space(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Numerators and denominator in powers of z^-1 of any state space with one output.

    The denominator is the characteristic polynomial of A, `den(z) = det(z I - A)`; the numerator
    is its product with the impulse response D, C B, C A B, .. In observer form both are read off.

    Raises
    ------
    SettingError
        Where shapes disagree, values are not finite, or there are several outputs.
    """
    s = _checked(A, B, C, D)
    n = len(s.A)
    shifted = np.eye(n, k=1)
    shifted[:, 0] = s.A[:, 0]
    if n and np.array_equal(s.A, shifted) and np.array_equal(s.C, np.eye(1, n)):
        a = np.concatenate([[1.0], -s.A[:, 0]])
        num = np.hstack([s.D.T, (s.B + np.outer(a[1:], s.D[0])).T])
        return _shortened(num), _shortened(a[None])[0]
    a = np.real(np.poly(s.A)) if n else np.ones(1)
    response, x = [s.D[0]], s.B
    for _ in range(n):
        response.append((s.C @ x)[0])
        x = s.A @ x
    num = np.array([np.convolve(a, h)[: n + 1] for h in np.array(response).T])
    return num, a


def with_common_denominator(
    numerators: list[FloatArray], denominators: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Fractions in descending powers of z, one per input, as rows in z^-1 over one denominator.

    Raises
    ------
    SettingError
        Where a numerator has a higher degree than its denominator: that looks into the future.
    """
    distinct: list[FloatArray] = []
    for den in denominators:
        if not any(np.array_equal(den, other) for other in distinct):
            distinct.append(den)
    common = _product(distinct)
    rows = []
    for num, den in zip(numerators, denominators, strict=True):
        others = [d for d in distinct if not np.array_equal(d, den)]
        row = np.convolve(num, _product(others))
        if len(row) > len(common):
            raise SettingError(
                f"expected numerators of at most the denominator's degree {len(common) - 1} in z, "
                f"received {len(row) - 1}; the model would look into the future"
            )
        rows.append(np.concatenate([np.zeros(len(common) - len(row)), row]))
    return _shortened(np.array(rows)), _shortened(common[None])[0]


def in_descending_powers(core: _core.LinearModel) -> tuple[list[FloatArray], FloatArray]:
    """Numerators, without leading zeros, and the denominator in descending powers of z."""
    num, den = transfer_function(core)
    size = max(num.shape[1], len(den))
    rows = [np.trim_zeros(row, "f") for row in _padded(num, size)]
    return [r if len(r) else np.zeros(1) for r in rows], _padded(den[None], size)[0]


def offset_at(core: _core.LinearModel, u0: ArrayLike, y0: float) -> float:
    """The offset that makes (u0, y0) a steady point: `(1 + sum a) y0 - sum_j u0_j sum_i b_ji`.

    Raises
    ------
    SettingError
        Where `u0` has not one finite value per input.
    """
    u = np.atleast_1d(_finite(u0, "operating point"))
    if u.shape != (len(core.b),):
        raise SettingError(
            f"operating point: expected {len(core.b)} inputs, one value each, received shape "
            f"{np.shape(u0)}"
        )
    return float((1.0 + core.a.sum()) * y0 - core.b.sum(axis=1) @ u)


def _checked(A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike) -> StateSpace:
    names = zip("ABCD", (A, B, C, D), strict=True)
    s = StateSpace(*(np.atleast_2d(_finite(m, name)) for name, m in names))
    n, nu = len(s.A), s.D.shape[-1]
    if n == 1 and s.B.size == nu:
        s = s._replace(B=s.B.reshape(1, nu))
    expected = ((n, n), (n, nu), (1, n), (1, nu))
    if tuple(m.shape for m in s) != expected:
        raise SettingError(
            f"expected A, B, C, D of shapes {', '.join(map(str, expected))}, with one output, "
            f"received {', '.join(str(m.shape) for m in s)}"
        )
    return s


def _finite(values: Any, name: str) -> FloatArray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise SettingError(f"{name}: expected real numbers, received {values!r}") from e
    if not np.isfinite(array).all():
        raise SettingError(f"{name}: expected finite numbers, received NaN or infinity")
    return array


def _padded(rows: FloatArray, size: int) -> FloatArray:
    return np.hstack([rows, np.zeros((len(rows), size - rows.shape[1]))])


def _shortened(rows: FloatArray) -> FloatArray:
    """Without the columns of zeros at the end, but for the first one."""
    used = np.flatnonzero(np.any(rows != 0.0, axis=0))
    return rows[:, : used[-1] + 1] if len(used) else rows[:, :1]


def _product(factors: list[FloatArray]) -> FloatArray:
    product = np.ones(1)
    for factor in factors:
        product = factor if len(product) == 1 else np.convolve(product, factor)
    return product
