"""Linear models in other forms: transfer function, state space, continuous, toolboxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..dataset import FloatArray
from ..errors import SettingError, not_installed

# --- ContinuousModel: the differential equation behind a zero-order hold --------------------------


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousModel:
    """dx/dt = A x + B u(t - dead_time), y = C x + D u(t - dead_time), in deviations.

    Attributes
    ----------
    A, B, C, D : array, shape (n, n), (n, nu), (1, n), (1, nu)
        With time in seconds. The state is that of `to_ss` at the sampling instants.
    dead_time : float
        Dead time [s]: the delay `nk` without the sample that the hold accounts for.
    input_names, output_name
        As in the model.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    dead_time: float
    input_names: tuple[str, ...]
    output_name: str

    @property
    def poles(self) -> tuple[complex, ...]:
        """Poles [1/s], the slowest first."""
        return tuple(sorted(map(complex, np.linalg.eigvals(self.A)), key=lambda p: -p.real))

    def frequency_response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """G(i omega), shape (n_inputs, len(omega)), for omega in rad/s, including the dead time."""
        w = np.atleast_1d(np.asarray(omega, dtype=np.float64))
        eye = np.eye(len(self.A))
        rows = [(self.C @ np.linalg.solve(1j * v * eye - self.A, self.B) + self.D)[0] for v in w]
        response: NDArray[np.complex128] = np.array(rows).T * np.exp(-1j * w * self.dead_time)
        return response

    def to_control(self) -> Any:
        """`control.StateSpace` in continuous time, without the dead time.

        Raises
        ------
        SettingError
            If python-control is not installed.
        """
        control = require_control()
        names = {"inputs": list(self.input_names), "outputs": [self.output_name]}
        return control.ss(self.A, self.B, self.C, self.D, **names)

    def __repr__(self) -> str:
        poles = ", ".join(
            f"{p.real:.4g}" + (f"{p.imag:+.4g}j" if p.imag else "") for p in self.poles
        )
        return f"ContinuousModel(poles [1/s]: {poles}; dead time {self.dead_time:g} s)"


def continuous(
    core: _core.LinearModel, Ts: float, input_names: tuple[str, ...], output_name: str
) -> ContinuousModel:
    """The inverse of the zero-order hold: `[[A, B], [0, 0]] Ts = log [[Ad, Bd], [0, I]]`.
    Raises `SettingError` if a pole is zero or negative: no differential equation has such a
    discretisation.
    """
    spare = max(core.nk - 1, 0)
    s = observer_form(_core.LinearModel(core.a, core.b, core.nk - spare, core.offset))
    _require_logarithm(np.linalg.eigvals(s.A), s, core)
    n, nu = s.B.shape
    held = np.block([[s.A, s.B], [np.zeros((nu, n)), np.eye(nu)]])
    log = logarithm(held) / Ts
    return ContinuousModel(
        log[:n, :n].copy(), log[:n, n:].copy(), s.C, s.D, spare * Ts, input_names, output_name
    )


def logarithm(matrix: FloatArray) -> FloatArray:
    """Principal logarithm by square roots until near I, then Gauss-Legendre (Higham 2008, ch.
    11). `log(I + X) = int_0^1 X (I + t X)^-1 dt`, and the logarithm of a square root is half of it.
    """
    eye, roots = np.eye(len(matrix)), 0
    while np.linalg.norm(matrix - eye, 1) > 0.25 and roots < 60:
        matrix, roots = _square_root(matrix), roots + 1
    x = matrix - eye
    # the [8/8] Pade approximant: exact to rounding within .25 of I
    nodes, weights = np.polynomial.legendre.leggauss(8)
    terms = (
        w / 2 * np.linalg.solve(eye + (t + 1) / 2 * x, x)
        for t, w in zip(nodes, weights, strict=True)
    )
    log: FloatArray = 2.0**roots * sum(terms, np.zeros_like(x))
    return log


def _square_root(matrix: FloatArray) -> FloatArray:
    """Principal square root by the product form of Denman and Beavers (Higham 2008, eq. 6.29)."""
    eye, m, x = np.eye(len(matrix)), matrix, matrix
    for _ in range(60):
        inverse = np.linalg.inv(m)
        x = 0.5 * x @ (eye + inverse)
        m = 0.5 * (eye + 0.5 * (m + inverse))
        if np.linalg.norm(m - eye, 1) < 1e-14 * len(m):
            break
    return x


def _require_logarithm(poles: Any, s: StateSpace, core: _core.LinearModel) -> None:
    if len(s.A) > core.na:
        raise SettingError(
            f"expected at most {core.na} coefficients per input beside the delay (nb <= na), "
            f"received {core.b.shape[1]}: the others are poles at 0, which no differential "
            "equation has; identify with nb <= na"
        )
    size = max(np.abs(poles).max(), 1e-300)
    bad = [p.real for p in poles if p.real <= 0.0 and abs(p.imag) <= 1e-9 * size]
    if bad:
        raise SettingError(
            f"expected poles off the negative real axis and 0, received "
            f"{', '.join(f'{p:.4g}' for p in bad)}; no differential equation under a hold has "
            "such a pole: lower na, or sample faster"
        )


# --- A linear model's coefficients as transfer function and state space, and back -----------------
# Only deviations from an operating point are converted; the offset restores absolute values.


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
    """The model of a transfer function in z^-1: common leading zeros are the delay."""
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
    `x_i(k)` is the contribution of inputs and outputs up to sample k - 1 to `y(k+i-1)`:
    `x_i(k) = sum_{m >= i} ( -a_m y(k-1-m+i) + beta_m u(k-1-m+i) )`, with the numerator
    `beta_0 + beta_1 z^-1 + ..`, whose leading zeros are the delay.
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
    The denominator is the characteristic polynomial of A, `den(z) = det(z I - A)`; the numerator is
    its product with the impulse response D, C B, C A B, .. In observer form both are read off.
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
    """Fractions in descending powers of z, one per input, as rows in z^-1 over one denominator."""
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
    """The offset that makes (u0, y0) a steady point: `(1 + sum a) y0 - sum_j u0_j sum_i b_ji`."""
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
    """The rows without trailing columns of zeros, but with at least one column."""
    used = np.flatnonzero(np.any(rows != 0.0, axis=0))
    return rows[:, : used[-1] + 1] if len(used) else rows[:, :1]


def _product(factors: list[FloatArray]) -> FloatArray:
    product = np.ones(1)
    for factor in factors:
        product = factor if len(product) == 1 else np.convolve(product, factor)
    return product


# --- Conversion from and to objects of python-control and scipy.signal ----------------------------


_PURPOSE = "its linear systems (to_tf and to_ss give plain arrays)"


def require_control() -> Any:
    """python-control, or a `SettingError` that says how to install it."""
    try:
        import control
    except ImportError as e:
        raise not_installed("control", _PURPOSE, "sewfast[control]") from e
    return control


def require_scipy_signal() -> Any:
    """scipy.signal, or a `SettingError` that says how to install it."""
    try:
        from scipy import signal
    except ImportError as e:
        raise not_installed("scipy", _PURPOSE, "sewfast[control]") from e
    return signal


def control_transfer_function(
    numerators: list[FloatArray], den: FloatArray, Ts: float, inputs: list[str], output: str
) -> Any:
    """`control.TransferFunction` with one output from polynomials in descending powers of z."""
    control = require_control()
    dens = [den] * len(numerators)
    return control.tf([numerators], [dens], Ts, inputs=inputs, outputs=[output])


def control_state_space(s: StateSpace, Ts: float, inputs: list[str], output: str) -> Any:
    """`control.StateSpace` with one output."""
    return require_control().ss(*s, Ts, inputs=inputs, outputs=[output])


def scipy_system(numerators: list[FloatArray], den: FloatArray, s: StateSpace, Ts: float) -> Any:
    """`scipy.signal.dlti`: a transfer function for one input, a state space for several."""
    signal = require_scipy_signal()
    if len(numerators) == 1:
        return signal.dlti(numerators[0], den, dt=Ts)
    return signal.dlti(*s, dt=Ts)


def polynomials_of(system: Any, Ts: float | None) -> tuple[FloatArray, FloatArray, float]:
    """Numerators and denominator in powers of z^-1 of a system, and its sample time [s]."""
    dt = _sample_time(getattr(system, "dt", None), Ts)
    if all(hasattr(system, name) for name in "ABCD"):
        num, den = from_state_space(system.A, system.B, system.C, system.D)
    elif hasattr(system, "num") and hasattr(system, "den"):
        num, den = with_common_denominator(*_polynomial_lists(system))
    elif hasattr(system, "zeros") and hasattr(system, "to_tf"):
        num, den = with_common_denominator(*_polynomial_lists(system.to_tf()))
    else:
        raise SettingError(
            "expected a transfer function or state space of python-control or scipy.signal, "
            f"received {type(system).__name__}"
        )
    return num, den, dt


def _polynomial_lists(system: Any) -> tuple[list[FloatArray], list[FloatArray]]:
    """Polynomials per input; python-control nests them by output and input."""
    num, den = system.num, system.den
    if isinstance(den, np.ndarray) and den.ndim == 1:
        num, den = [np.atleast_2d(num)], [[den]]
    if len(num) != 1:
        raise SettingError(f"expected one output, received {len(num)}; take one of them")
    rows = [np.asarray(n, dtype=np.float64) for n in num[0]]
    dens = [np.asarray(d, dtype=np.float64) for d in den[0]]
    if len(rows) != len(dens):
        raise SettingError(f"expected one output, received {len(rows)}; take one of them")
    return rows, dens


def _sample_time(dt: Any, Ts: float | None) -> float:
    """Sample time of the system, or `Ts` if it has none (`dt` True or None: unspecified)."""
    if dt is not None and not isinstance(dt, bool) and dt > 0:
        if Ts is not None and abs(dt - Ts) > 1e-9 * Ts:
            raise SettingError(
                name="Ts", expected=f"that of the system, dt = {dt:g} s", received=f"{Ts:g} s",
                remedy="leave Ts out",
            )  # fmt: skip
        return float(dt)
    if dt is True and Ts is not None:
        return Ts
    raise SettingError(
        f"expected a system in discrete time with its sample time in seconds, received dt = {dt}; "
        "convert it (control.sample_system) or give Ts where dt is True"
    )
