"""Biquads: notches, low passes and lead-lags of a controller, for machines with resonances.

Up to four act one after the other on the reference and on the filtered feedback. For the loop this
equals a filter of the command, as the PID is linear in both. Each has gain 1 at zero frequency and
is sampled by the bilinear transform with prewarping; for arithmetic and equations see
`sewfast_control::biquad`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..arrays import FloatArray
from ..errors import SettingError
from ..gains import real

MOST = 4
"""Most biquads of a controller."""

NUMBERS: Mapping[str, tuple[str, ...]] = {
    "notch": ("frequency", "depth", "width"),
    "low_pass": ("frequency", "damping"),
    "lead_lag": ("zero", "pole"),
    "resonance": ("zero_frequency", "zero_damping", "pole_frequency", "pole_damping"),
}
"""Arguments of each kind, in the order of its constructor."""


@dataclass(frozen=True)
class Biquad:
    """A second-order filter with gain 1 at zero frequency; make it with one of its constructors.

    Attributes
    ----------
    kind : str
        ``notch``, ``low_pass``, ``lead_lag`` or ``resonance``.
    numbers : tuple of float
        The arguments of the constructor, in its order.

    Examples
    --------
    >>> print(Biquad.notch(60.0, depth=0.1, width=0.5))
    notch at 60 Hz, depth 0.1, width 0.5
    """

    kind: str
    numbers: tuple[float, ...]

    def __post_init__(self) -> None:
        names = NUMBERS.get(self.kind) if isinstance(self.kind, str) else None
        if names is None:
            raise SettingError(
                name="kind", expected=f"one of {', '.join(NUMBERS)}", received=repr(self.kind)
            )
        if not isinstance(self.numbers, (tuple, list)) or len(self.numbers) != len(names):
            raise SettingError(
                name="numbers", expected=f"{', '.join(names)} of a {self.kind}",
                received=repr(self.numbers), remedy=f"make it with Biquad.{self.kind}(...)",
            )  # fmt: skip
        numbers = tuple(real(name, x) for name, x in zip(names, self.numbers, strict=True))
        object.__setattr__(self, "numbers", numbers)

    @classmethod
    def notch(cls, frequency: float, depth: float = 0.1, width: float = 0.5) -> Biquad:
        """Remove an oscillation at `frequency` [Hz].

        The gain there is `depth`, 0 to 1; the band that a deep notch attenuates by 3 dB or more is
        `width` times as wide as the frequency:
        H(s) = (s^2 + depth width w s + w^2)/(s^2 + width w s + w^2).
        """
        return cls("notch", (frequency, depth, width))

    @classmethod
    def low_pass(cls, frequency: float, damping: float = math.sqrt(0.5)) -> Biquad:
        """H(s) = w^2/(s^2 + 2 damping w s + w^2), w = 2 pi `frequency` [Hz]."""
        return cls("low_pass", (frequency, damping))

    @classmethod
    def lead_lag(cls, zero: float, pole: float) -> Biquad:
        """H(s) = (1 + s/w_zero)/(1 + s/w_pole), both [Hz]: a lead if the zero comes first."""
        return cls("lead_lag", (zero, pole))

    @classmethod
    def resonance(
        cls, zero_frequency: float, zero_damping: float, pole_frequency: float, pole_damping: float
    ) -> Biquad:
        """Zeros and poles, each with its own frequency [Hz] and damping ratio.

        With the zeros on a shaft's resonance and the poles on its antiresonance it is the inverse
        of the shaft.
        """
        return cls(
            "resonance", (zero_frequency, zero_damping, pole_frequency, pole_damping)
        )  # fmt: skip

    def coefficients(self, Ts: float) -> tuple[float, float, float, float]:
        """`c0`, `c1`, `a1`, `a2` of H(z) = 1 + (1 - q)(c0 + c1 q)/(1 + a1 q + a2 q^2), q = 1/z.

        Raises
        ------
        SettingError
            For a frequency that is not between 0 and half the sample rate, or another number
            outside its range.
        """
        return _core.biquad(self.kind, list(self.numbers), Ts=Ts)

    def to_tf(self, Ts: float) -> tuple[FloatArray, FloatArray]:
        """Numerator and denominator in powers of z^-1, each of shape (3,)."""
        c0, c1, a1, a2 = self.coefficients(Ts)
        return np.array([1.0 + c0, a1 + c1 - c0, a2 - c1]), np.array([1.0, a1, a2])

    def response(self, hertz: ArrayLike, Ts: float) -> NDArray[np.complex128]:
        """H at frequencies [Hz], shape (n,)."""
        c0, c1, a1, a2 = self.coefficients(Ts)
        q = np.exp(-2j * np.pi * np.atleast_1d(np.asarray(hertz, dtype=np.float64)) * Ts)
        found: NDArray[np.complex128] = 1.0 + (1.0 - q) * (c0 + c1 * q) / (
            1.0 + a1 * q + a2 * q * q
        )
        return found

    def named(self) -> dict[str, float]:
        """The numbers by name."""
        return dict(zip(NUMBERS[self.kind], self.numbers, strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Kind and numbers as JSON values."""
        return {"kind": self.kind, **self.named()}

    def __str__(self) -> str:
        n = self.named()
        if self.kind == "notch":
            return (
                f"notch at {n['frequency']:.4g} Hz, depth {n['depth']:.3g}, width {n['width']:.3g}"
            )
        if self.kind == "low_pass":
            return f"low pass at {n['frequency']:.4g} Hz, damping {n['damping']:.3g}"
        if self.kind == "lead_lag":
            name = "lead" if n["zero"] < n["pole"] else "lag"
            return f"{name} with zero at {n['zero']:.4g} Hz, pole at {n['pole']:.4g} Hz"
        return (
            f"zeros at {n['zero_frequency']:.4g} Hz (damping {n['zero_damping']:.3g}), poles at "
            f"{n['pole_frequency']:.4g} Hz (damping {n['pole_damping']:.3g})"
        )
