"""`ContinuousModel`: the differential equation that a zero-order hold turns into a linear model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..dataset import FloatArray
from ..errors import SettingError
from .conversion import StateSpace, observer_form
from .toolboxes import require_control

NODES = 8
"""Of the quadrature, which is the [8/8] Pade approximant: rounding below a distance of 0.25."""
NEAR = 0.25


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousModel:
    """dx/dt = A x + B u(t - dead_time), y = C x + D u(t - dead_time), in deviations.

    Attributes
    ----------
    A, B, C, D : array, shape (n, n), (n, nu), (1, n), (1, nu)
        With time in seconds. The state is that of `to_ss` at the sampling instants.
    dead_time : float
        [s]; what is left of the delay `nk` after the sample that the hold takes.
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
        """G(i omega), shape (n_inputs, len(omega)), for omega in rad/s; dead time included."""
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
            Where python-control is not installed.
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

    Raises
    ------
    SettingError
        Where a pole is at or left of 0: no differential equation gives it.
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
    """Principal logarithm by square roots until near I, then Gauss-Legendre (Higham 2008, ch. 11).

    `log(I + X) = int_0^1 X (I + t X)^-1 dt`, and the logarithm of a square root is half of it.
    """
    eye, roots = np.eye(len(matrix)), 0
    while np.linalg.norm(matrix - eye, 1) > NEAR and roots < 60:
        matrix, roots = _square_root(matrix), roots + 1
    x = matrix - eye
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
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
