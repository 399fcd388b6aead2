"""State feedback with an observer: `StateFeedback`, its gains from weights, its files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray
from ..errors import SettingError
from ..gains import real, vector
from ..storage import Fields
from .controller import SampledController, bounded, unbounded
from .margins import sampled

STATES = 4
"""Largest number of states of the plant."""
VARIABLES = ("rho", "integral", "noise", "weight", "lead")
"""Default variables of a search."""
_UNBOUNDED = {"u_min": -math.inf, "u_max": math.inf, "slew": math.inf, "r_rate": math.inf}
_REALS = ("Ts", *VARIABLES, *_UNBOUNDED)
FIELDS = (
    "version", "kind", "num", "den", "u_unit", "y_unit", *_REALS, "counts_per_rev", "notes",
)  # fmt: skip


@dataclass(frozen=True)
class StateFeedback(SampledController):
    """State feedback with an observer, integral action and reference feedforward.

    The plant is a difference equation of up to four states,
    ``y(k) = num[0] u(k-1) + .. - den[0] y(k-1) - ..``. The gains on its states minimise the sum of
    ``e^2 + rho u^2 + (integral int e dt)^2``; the observer is the Kalman filter of a plant whose
    command is disturbed by white noise, and whose measurement noise has `noise` times the variance
    of that. Its input is the command after the limits. Both follow from a Riccati equation
    (Franklin, Powell and Workman, Digital Control of Dynamic Systems, 3rd ed. 1998, chapters 8 and
    9; Astrom and Wittenmark, Computer-Controlled Systems, 3rd ed. 1997, chapters 4 and 11).

    Parameters
    ----------
    num, den : array, shape (n,)
        Coefficients of the plant with its encoder, 1 to 4 numbers each [y/u and 1], padded with
        zeros. `from_model` computes them from a model.
    rho : float
        Weight of the command's square, above 0 [(y/u)^2]: a smaller one is faster.
    integral : float
        Weight of the error's integral, 0 or more [1/s]; 0 for no integral action.
    noise : float
        Variance of the measurement over that of a disturbance of the command, above 0 [(y/u)^2]:
        a smaller one trusts the measurement more.
    weight : float
        Set-point weight: with 1 the model reaches the reference without the integral; a smaller one
        leaves a share to the integral, and reduces the overshoot.
    lead : float
        The reference fed forward is extrapolated by this time at its present rate [s].
    Ts : float
        Sample time [s].
    u_min, u_max : float
        Limits of the command [u]; infinite for none.
    slew : float
        Largest change of the command [u/s]; inf for none.
    r_rate : float
        Largest change of the reference used by the controller [y/s]; inf for none.
    counts_per_rev : float or None
        The encoder that measures a model's output; None for ideal feedback. A machine has its own.
    u_unit, y_unit : str
        Units of command and output.
    notes : str
        Where it comes from.

    Raises
    ------
    SettingError
        For a setting outside its range, more than four states, or a plant without such gains.
    """

    KIND: ClassVar[str] = "state_feedback"

    num: tuple[float, ...]
    den: tuple[float, ...]
    rho: float
    integral: float
    noise: float
    weight: float = 1.0
    lead: float = 0.0
    Ts: float = 0.001
    u_min: float = -math.inf
    u_max: float = math.inf
    slew: float = math.inf
    r_rate: float = math.inf
    counts_per_rev: float | None = None
    u_unit: str = "V"
    y_unit: str = "RPM"
    notes: str = ""

    def __post_init__(self) -> None:
        for name in _REALS:
            object.__setattr__(self, name, real(name, getattr(self, name)))
        for name in ("num", "den"):
            object.__setattr__(self, name, _four(name, getattr(self, name)))
        if self.counts_per_rev is not None:
            object.__setattr__(self, "counts_per_rev", real("counts_per_rev", self.counts_per_rev))
        for name in ("u_unit", "y_unit", "notes"):
            if not isinstance(getattr(self, name), str):
                raise SettingError(
                    name=name, expected="text", received=repr(getattr(self, name)),
                    remedy="give it in quotes",
                )  # fmt: skip
        _ = (self.core(), self.counts_per_unit)

    @classmethod
    def from_model(
        cls,
        plant: Any,
        *,
        speed: float | None = None,
        counts_per_rev: float | None = None,
        **settings: Any,
    ) -> StateFeedback:
        """The controller for a plant, by default with weights that suit its gain.

        Parameters
        ----------
        plant : model, OperatingPoint, Fopdt or system of python-control
            Linear, or a nonlinear model with a `speed` to linearise it about.
        speed : float, optional
            Steady output about which a nonlinear model is linearised [y].
        counts_per_rev : float, optional
            Encoder of the output. It measures the mean over a sample time, which needs one more
            state and is left out if there is none left.
        **settings
            Settings of this class: `rho`, `u_min` and the like.

        Raises
        ------
        SettingError
            For a plant with more than four states or without delay, or as the class.
        """
        Ts = real("Ts", settings.pop("Ts", getattr(plant, "Ts", 0.001)))
        num, den = _fraction(plant, Ts, speed)
        if counts_per_rev is not None and len(num) < STATES:
            num = np.convolve(num, [0.5, 0.5])
        # frequency [rad/sample] at which the plant's gain scales the first weights: a time constant
        # of 20 samples, well within what a loop can control
        gain = abs(_response(num, den, 0.05))
        if not 0.0 < gain < math.inf:
            raise SettingError(
                name="plant", expected="one that responds to its command",
                received=f"a gain of {gain:g}",
                remedy="identify it from a recording in which the command moves the output",
            )  # fmt: skip
        # first weight of the integral, per sample
        first = {"rho": gain**2, "noise": gain**2, "integral": 0.02 / Ts}
        return cls(
            tuple(num),
            tuple(den) or (0.0,),
            Ts=Ts,
            counts_per_rev=counts_per_rev,
            **(first | settings),
        )

    @classmethod
    def first(cls, plant: Any, **settings: Any) -> StateFeedback:
        """`from_model`; a nonlinear model is linearised in the middle of its recorded output."""
        filter_samples, middle = settings.pop("filter_samples"), settings.pop("middle")
        if filter_samples is not None:
            raise SettingError(
                name="filter_samples", expected="none, as the observer is the filter",
                received=f"{filter_samples}", remedy="leave it out, or search the weight 'noise'",
            )  # fmt: skip
        linear = next(iter(plant.members), plant)
        if hasattr(linear, "to_tf"):
            return cls.from_model(linear, **settings)
        if middle is None:
            raise SettingError(
                name="model", expected="a range of the output to linearise the model in",
                received="none in its file",
                remedy="give start=StateFeedback.from_model(model, speed=...)",
            )  # fmt: skip
        return cls.from_model(linear, speed=middle, **settings)

    def core(self) -> _core.StateFeedback:
        """The compiled controller, at rest: `step(r, y, feedforward)` gives a sample's command.

        `core().single()` is the same in single precision, bit by bit what a device computes.
        """
        return _core.StateFeedback(
            num=self.num, den=self.den, **{name: getattr(self, name) for name in _REALS}
        )

    def sent(self) -> tuple[int, list[float]]:
        """Number of the kind and its parameters, as sent to a device (docs/PROTOCOL.md)."""
        return 1, self.core().sent()

    @property
    def K(self) -> FloatArray:
        """Gains on the states, shape (4,) [u/y]."""
        return np.array(self.core().numbers["K"])

    @property
    def L(self) -> FloatArray:
        """Gains of the observer, shape (4,)."""
        return np.array(self.core().numbers["L"])

    @property
    def Ki(self) -> float:
        """Gain on the sum of errors, per sample [u/y]."""
        return float(self.core().numbers["Ki"])

    @property
    def Kr(self) -> float:
        """Gain on the reference [u/y]."""
        return float(self.core().numbers["Kr"])

    @property
    def pace(self) -> float:
        """An estimate of the plant's time constant from the controller alone [s]."""
        return 50.0 * self.Ts

    def with_values(self, values: Mapping[str, float], notes: str) -> StateFeedback:
        """The same controller with values by name; other names are ignored."""
        known: dict[str, Any] = {
            name: values[name] for name in (*VARIABLES, "r_rate") if name in values
        }
        return replace(self, notes=notes, **known)

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values; null means no such limit."""
        return {
            "kind": self.KIND,
            "num": list(self.num),
            "den": list(self.den),
            "u_unit": self.u_unit,
            "y_unit": self.y_unit,
            **{name: bounded(getattr(self, name)) for name in _REALS},
            "counts_per_rev": self.counts_per_rev,
            "notes": self.notes,
        }

    @classmethod
    def read(cls, fields: Fields) -> StateFeedback:
        """The counterpart of `to_dict`."""
        fields.require_only(FIELDS)
        numbers: dict[str, Any] = {name: unbounded(fields, name, _UNBOUNDED) for name in _REALS} | {
            name: fields.text(name) for name in ("u_unit", "y_unit", "notes")
        }
        return cls(
            num=tuple(fields.vector("num")),
            den=tuple(fields.vector("den")),
            counts_per_rev=fields.optional_number("counts_per_rev"),
            **numbers,
        )

    def __str__(self) -> str:
        u, y = self.u_unit or "u", self.y_unit or "y"
        encoder = "ideal" if self.counts_per_rev is None else f"{self.counts_per_rev:g} counts/rev"
        ramp = "" if math.isinf(self.r_rate) else f", ramp of {self.r_rate:g} {y}/s"
        used = max(len(np.trim_zeros(self.num, "b")), len(np.trim_zeros(self.den, "b")))
        shown = [", ".join(f"{x:.4g}" for x in gains[:used]) for gains in (self.K, self.L)]
        lines = [
            f"state feedback with an observer at {self.Ts:g} s from {y} to {u}, {used} states",
            f"  weights   rho {self.rho:.6g}, integral {self.integral:.6g} 1/s, noise "
            f"{self.noise:.6g}",
            f"  gains     K {shown[0]}; Ki {self.Ki:.4g} {u}/{y}",
            f"  observer  L {shown[1]}; {encoder}",
            f"  reference Kr {self.Kr:.4g} {u}/{y} (weight {self.weight:.4g}), lead "
            f"{1e3 * self.lead:.4g} ms{ramp}",
            f"  limits    {self.u_min:g} to {self.u_max:g} {u}, slew {self.slew:g} {u}/s",
        ]
        return "\n".join([*lines, f"  notes     {self.notes}"] if self.notes else lines)


def _four(name: str, given: ArrayLike) -> tuple[float, ...]:
    """The numbers padded with zeros to four."""
    numbers = [float(x) for x in vector(name, given)]
    while len(numbers) > STATES and numbers[-1] == 0.0:
        numbers.pop()
    if not 1 <= len(numbers) <= STATES:
        raise SettingError(
            name=name, expected=f"1 to {STATES} numbers", received=f"{len(numbers)}",
            remedy="identify a model with na of at most 4 and nk + nb of at most 5, or take a PID",
        )  # fmt: skip
    return (*numbers, *[0.0] * (STATES - len(numbers)))


def _fraction(plant: Any, Ts: float, speed: float | None) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator from `z^-1` on, of a plant with a delay of at least one sample."""
    num, den = sampled(plant, Ts, speed)
    num, den = num / den[0], den / den[0]
    if num[0] != 0.0:
        raise SettingError(
            name="plant", expected="one on which a command acts a sample later", received="nk = 0",
            remedy="identify it again with nk = 1",
        )  # fmt: skip
    given = (_four("num", [*num[1:], 0.0]), _four("den", [*den[1:], 0.0]))
    numerator, denominator = (np.trim_zeros(np.array(numbers), "b") for numbers in given)
    return numerator, denominator


def _response(num: FloatArray, den: FloatArray, theta: float) -> complex:
    back = np.exp(-1j * theta * np.arange(1, 1 + max(len(num), len(den))))
    return complex(num @ back[: len(num)] / (1.0 + den @ back[: len(den)]))
