"""Linear difference equations with offset: ARX, instrumental variables, linear output error."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..arrays import FloatArray, labelled, on_grid
from ..errors import SettingError
from ..storage import Fields
from ..units import duration
from .base import SingleModel
from .conversion import (
    ContinuousModel,
    StateSpace,
    continuous,
    control_state_space,
    control_transfer_function,
    difference_equation,
    from_state_space,
    in_descending_powers,
    observer_form,
    offset_at,
    polynomials_of,
    scipy_system,
    transfer_function,
)
from .rest import Rest


class LinearDifference(SingleModel):
    """y(k) = -sum a_i y(k-i) + sum_j sum_i b_ji u_j(k-nk-i+1) + offset (docs/CONVENTIONS.md)."""

    core: _core.LinearModel

    @property
    def orders(self) -> dict[str, int]:
        return {"na": self.core.na, "nb": int(self.core.b.shape[1]), "nk": self.core.nk}

    @property
    def theta(self) -> FloatArray:
        """`[a, b input by input, offset]`, shape (na + nu nb + 1,)."""
        core = self.core
        return np.concatenate([core.a, core.b.ravel(), [core.offset]])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """`a1 ..`, `b1 ..` (of several inputs `b1 of NAME`), `offset`."""
        nb = self.core.b.shape[1]
        of = ["" if len(self.core.b) == 1 else f" of {name}" for name in self.input_names]
        b = [f"b{i + 1}{one}" for one in of for i in range(nb)]
        return (*(f"a{i + 1}" for i in range(self.core.na)), *b, "offset")

    @property
    def poles(self) -> tuple[complex, ...]:
        """Poles in the z plane, the slowest first."""
        found = [complex(re, im) for re, im in self.core.poles()]
        return tuple(sorted(found, key=abs, reverse=True))

    @property
    def dc_gain(self) -> tuple[float, ...]:
        """Steady output over steady input, for each input [output unit / input unit]."""
        return tuple(float(g) for g in self.core.dc_gain())

    def parameters(self) -> dict[str, Any]:
        core = self.core
        return {"a": core.a.tolist(), "b": core.b.tolist(), "nk": core.nk, "offset": core.offset}

    def with_output_scaled(self, factor: float) -> dict[str, Any]:
        return {"b": (factor * self.core.b).tolist(), "offset": factor * self.core.offset}

    def about(self, rest: Rest) -> _core.LinearModel:
        # at zero, too, the offset is on the grid on which it is at other levels
        u = np.zeros(len(self.input_names)) if rest.is_zero else np.array(rest.u)
        core, offset = self.core, self.with_zero_at(u, rest.y)["offset"]
        if offset == core.offset:
            return core
        return _core.LinearModel(core.a, core.b, core.nk, offset)

    def with_zero_at(self, u: FloatArray, y: float) -> dict[str, Any]:
        moved = self.core.offset - offset_at(self.core, u, y)
        low, high = self.training.get("output_range", (0.0, 0.0))
        # so fine that a steady output is right to a millionth of the span, but for plants that come
        # near to integrate: a level of some hundred spans takes away what is below 2^-40 of one
        steady = math.frexp(1.0 + float(self.core.a.sum()))[1]
        bits = min(max(34, 20 - steady), 40)
        return {"offset": float(on_grid(moved, high - low, bits=bits))}

    @staticmethod
    def core_from(fields: Fields) -> _core.LinearModel:
        """The compiled model from the parameters of a file."""
        a = fields.vector("a")
        b = fields.matrix("b")
        return _core.LinearModel(a, b, fields.integer("nk"), fields.number("offset"))

    def transfer_function(self, i: int = 0) -> str:
        """G(z) from input `i` as text, in powers of z^-1."""
        b = _polynomial(self.core.b[i], self.core.nk)
        a = _polynomial(np.concatenate([[1.0], self.core.a]), 0)
        return f"G(z) = ({b}) / ({a})"

    # --- other forms ------------------------------------------------------------------------------

    def to_tf(self) -> tuple[FloatArray, FloatArray]:
        """Transfer function of deviations, as coefficients of z^0, z^-1, z^-2, ..

        Returns
        -------
        num : array, shape (n_inputs, nk + nb)
            One row per input; the delay is `nk` leading zeros.
        den : array, shape (na + 1,)
            `[1, a_1, .., a_na]`, common to all inputs.
        """
        return transfer_function(self.core)

    def to_ss(self) -> StateSpace:
        """State space of deviations in observer form: `A, B, C, D = model.to_ss()`.

        Returns
        -------
        StateSpace
            x(k+1) = A x(k) + B u(k), y(k) = C x(k) + D u(k), of order n = max(na, nk + nb - 1);
            shapes (n, n), (n, n_inputs), (1, n), (1, n_inputs). `x_i(k)` is the contribution of
            inputs and outputs up to sample k - 1 to y(k+i-1); the states include the delay.
        """
        return observer_form(self.core)

    def to_control(self, form: str = "tf") -> Any:
        """`control.TransferFunction` (`form` "tf") or `control.StateSpace` ("ss"), dt = Ts, named.

        Raises
        ------
        SettingError
            If python-control is not installed, or for another form.
        """
        inputs, output = list(self.input_names), self.output_name
        if form == "ss":
            return control_state_space(self.to_ss(), self.Ts, inputs, output)
        if form != "tf":
            raise SettingError(f"form: expected 'tf' or 'ss', received {form!r}")
        return control_transfer_function(*in_descending_powers(self.core), self.Ts, inputs, output)

    def to_scipy(self) -> Any:
        """`scipy.signal.dlti` with dt = Ts: a transfer function, or a state space for many inputs.

        Raises
        ------
        SettingError
            If scipy is not installed.
        """
        return scipy_system(*in_descending_powers(self.core), self.to_ss(), self.Ts)

    def to_continuous(self) -> ContinuousModel:
        """The differential equation whose discretisation with a zero-order hold is this model.

        Raises
        ------
        SettingError
            If there is none: a pole on the negative real axis or at 0, or nb > na.
        """
        return continuous(self.core, self.Ts, self.input_names, self.output_name)

    def frequency_response(self, omega: ArrayLike) -> NDArray[np.complex128]:
        """G(exp(i omega Ts)), shape (n_inputs, len(omega)), for omega in rad/s."""
        num, den = self.to_tf()
        z = np.exp(-1j * self.Ts * np.atleast_1d(np.asarray(omega, dtype=np.float64)))
        powers = z ** np.arange(max(num.shape[1], len(den)))[:, None]
        response: NDArray[np.complex128] = num @ powers[: num.shape[1]] / (den @ powers[: len(den)])
        return response

    def steady_output(self, u0: ArrayLike) -> float:
        """The output at which the model rests under constant inputs `u0`.

        Raises
        ------
        SettingError
            If `u0` has not one value per input, or for a pole at 1, which has no such level.
        """
        at_rest = 1.0 + float(self.core.a.sum())
        if at_rest == 0.0:
            raise SettingError("expected no pole at 1, received one; an integrator has no level")
        return (self.core.offset - offset_at(self.core, u0, 0.0)) / at_rest

    @classmethod
    def from_tf(
        cls,
        num: ArrayLike,
        den: ArrayLike,
        Ts: float,
        *,
        offset: float = 0.0,
        operating_point: tuple[ArrayLike, float] | None = None,
        input_names: Sequence[str] | None = None,
        output_name: str = "y",
        input_units: Sequence[str] | None = None,
        output_unit: str = "",
    ) -> Any:
        """A model from a transfer function in powers of z^-1, as `to_tf` gives it.

        Parameters
        ----------
        num : array_like, shape (m,) or (n_inputs, m)
            Leading zeros common to all rows are the delay `nk`.
        den : array_like, shape (na + 1,)
        Ts : float
            Sample time [s].
        offset : float
            Offset, which a transfer function lacks: `model.core.offset` of its original model.
        operating_point : (u0, y0) or None
            Instead of `offset`: the inputs and the output, in the data's units, about which the
            transfer function describes deviations. The model then rests at y0 under u0.
        input_names, output_name, input_units, output_unit
            As in the data set; by default `u` or `u1, u2, ..` and `y`, without units.

        Returns
        -------
        Model
            A model of the class on which it is called.

        Raises
        ------
        SettingError
            If shapes or values are impossible, or both `offset` and `operating_point` are given.
        """
        core = difference_equation(num, den, offset)
        if operating_point is not None:
            if offset != 0.0:
                raise SettingError("expected offset or operating_point, received both")
            at = offset_at(core, *operating_point)
            core = _core.LinearModel(core.a, core.b, core.nk, at)
        width = len(core.b)
        numbered = tuple(f"u{i + 1}" for i in range(width)) if width > 1 else ("u",)
        names = numbered if input_names is None else tuple(input_names)
        units = ("",) * width if input_units is None else tuple(input_units)
        if not len(names) == len(units) == width:
            raise SettingError(
                f"expected {width} input names and units, received {list(names)}, {list(units)}"
            )
        if not (np.isfinite(Ts) and Ts > 0.0):
            raise SettingError(f"Ts: expected a positive sample time in seconds, received {Ts}")
        return cls(core, float(Ts), names, output_name, units, output_unit)

    @classmethod
    def from_ss(
        cls, A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, Ts: float, **options: Any
    ) -> Any:
        """A model from a state space with one output; options as in `from_tf`.

        The observer form of `to_ss` is converted exactly, up to the last bit of `b` if nk = 0; in
        any other form na is the order n, with the rounding errors of an eigenvalue problem.

        Raises
        ------
        SettingError
            As `from_tf`.
        """
        return cls.from_tf(*from_state_space(A, B, C, D), Ts, **options)

    @classmethod
    def from_control(cls, system: Any, Ts: float | None = None, **options: Any) -> Any:
        """A model from a discrete-time python-control system with one output.

        Parameters
        ----------
        system : control.TransferFunction or control.StateSpace
            Its names are used. Different denominators are multiplied out.
        Ts : float or None
            Sample time [s] if `system.dt` is True.
        **options
            As in `from_tf`.

        Raises
        ------
        SettingError
            For continuous time or several outputs, and as `from_tf`.
        """
        num, den, dt = polynomials_of(system, Ts)
        names = {
            "input_names": getattr(system, "input_labels", None),
            "output_name": next(iter(getattr(system, "output_labels", None) or ["y"])),
        }
        return cls.from_tf(num, den, dt, **names | options)

    @classmethod
    def from_scipy(cls, system: Any, Ts: float | None = None, **options: Any) -> Any:
        """A model from a `scipy.signal.dlti` with one output; arguments as in `from_control`.

        Raises
        ------
        SettingError
            As `from_control`.
        """
        num, den, dt = polynomials_of(system, Ts)
        return cls.from_tf(num, den, dt, **options)

    def describe(self) -> list[str]:
        lines = []
        for i, (name, unit) in enumerate(zip(self.input_names, self.input_units, strict=True)):
            gain_unit = f"{self.output_unit}/{unit}" if unit and self.output_unit else ""
            gain = f"{self.dc_gain[i]:.6g} {gain_unit}".strip()
            lines.append(f"{labelled(name, unit)}: {self.transfer_function(i)}, steady gain {gain}")
        lines.append("poles: " + ", ".join(_pole_text(p, self.Ts) for p in self.poles))
        return [*lines, f"offset: {self.core.offset:.6g} per sample"]


class ARX(LinearDifference):
    """ARX model by least squares on the one-step error (paper Eq. 8; Ljung 1999, section 7.3).
    An unstable plant that a loop held is one by the prediction error of an ARMAX model (ibid.,
    section 4.2): `training["method"]` says so.
    """

    kind: ClassVar[str] = "arx"
    title: ClassVar[str] = "ARX"

    def describe(self) -> list[str]:
        return [f"by {self.training.get('method', 'least squares')}", *super().describe()]


class IV(LinearDifference):
    """Refined instrumental variables, SRIV (Young 2011, section 6.4): unbiased by output noise."""

    kind: ClassVar[str] = "iv"
    title: ClassVar[str] = "Refined instrumental variables"


class LinearOE(LinearDifference):
    """Linear output-error model: least squares of the free run, with stable poles."""

    kind: ClassVar[str] = "oe"
    title: ClassVar[str] = "Linear output error"


def _polynomial(coefficients: Any, delay: int) -> str:
    terms = [
        f"{c:+.6g}" + (f" z^-{delay + i}" if delay + i else "") for i, c in enumerate(coefficients)
    ]
    return " ".join(terms).removeprefix("+")


def _pole_text(pole: complex, Ts: float) -> str:
    """A pole and its mode: time constant, frequency, alternation or integration."""
    size = abs(pole)
    number = f"{pole.real:.6g}{pole.imag:+.6g}i" if pole.imag else f"{pole.real:.6g}"
    if abs(pole - 1.0) <= 1e-9:
        return f"{number} (integrates)"
    if number == "1":
        number = f"1 {'-' if pole.real < 1.0 else '+'} {abs(1.0 - pole.real):.2g}"
    if not 0.0 < size < 1.0:
        return number
    tau = duration(-Ts / math.log(size))
    if pole.imag:
        hertz = abs(cmath.phase(pole)) / (2 * math.pi * Ts)
        return f"{number} ({tau}, {hertz:.4g} Hz)"
    if pole.real < 0.0:
        # not a lag of the plant: due to delay, noise or too high an order
        return f"{number} (alternates from sample to sample, dies away in {tau})"
    return f"{number} ({tau})"
