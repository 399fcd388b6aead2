"""Linear difference equations with offset: ARX, and the linear output-error model."""

from __future__ import annotations

import cmath
import math
from typing import Any, ClassVar

import numpy as np

from .. import _core
from ..dataset import labelled
from .base import Model
from .fields import Fields


class LinearDifference(Model):
    """y(k) = -sum a_i y(k-i) + sum_j sum_i b_ji u_j(k-nk-i+1) + offset (docs/CONVENTIONS.md)."""

    core: _core.LinearModel

    @property
    def orders(self) -> dict[str, int]:
        return {"na": self.core.na, "nb": int(self.core.b.shape[1]), "nk": self.core.nk}

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

    def describe(self) -> list[str]:
        lines = []
        for i, (name, unit) in enumerate(zip(self.input_names, self.input_units, strict=True)):
            gain_unit = f"{self.output_unit}/{unit}" if unit and self.output_unit else ""
            gain = f"{self.dc_gain[i]:.6g} {gain_unit}".strip()
            lines.append(f"{labelled(name, unit)}: {self.transfer_function(i)}, steady gain {gain}")
        lines.append("poles: " + ", ".join(_pole_text(p, self.Ts) for p in self.poles))
        return [*lines, f"offset: {self.core.offset:.6g} per sample"]


class ARX(LinearDifference):
    """ARX model by least squares on the one-step error (paper Eq. 8; Ljung 1999, section 7.3)."""

    kind: ClassVar[str] = "arx"
    title: ClassVar[str] = "ARX by least squares"


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
    """A pole with the time constant, and the frequency where it is complex, of its mode."""
    size = abs(pole)
    number = f"{pole.real:.6g}{pole.imag:+.6g}i" if pole.imag else f"{pole.real:.6g}"
    if not 0.0 < size < 1.0:
        return number
    tau = f"{-1e3 * Ts / math.log(size):.4g} ms"
    hertz = abs(cmath.phase(pole)) / (2 * math.pi * Ts)
    return f"{number} ({tau}, {hertz:.4g} Hz)" if pole.imag else f"{number} ({tau})"
