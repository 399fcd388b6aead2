"""`Gains` of a PID with their form and units; checks of single numbers and vectors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .errors import DataError, SettingError

Form: TypeAlias = Literal["standard", "parallel", "per_sample"]

_FIELDS: dict[str, tuple[str, ...]] = {
    "standard": ("Kp", "Ti", "Td"),
    "parallel": ("Kp", "Ki", "Kd"),
    "per_sample": ("Kp", "Ki", "Kd", "Ts"),
}


def real(name: str, value: Any) -> float:
    """The value as a float; text, None and NaN are refused by name."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if isinstance(value, (str, bytes)) or math.isnan(number):
        raise SettingError(name=name, expected="a number", received=repr(value))
    return number


def whole(name: str, value: Any) -> int:
    """The value as an int of 0 to 2^63 - 1; fractions, booleans and text are refused by name."""
    number = math.nan if isinstance(value, bool) else real(name, value)
    if not (0 <= number < 2**63 and number.is_integer()):
        raise SettingError(name=name, expected="a whole number of 0 or more", received=repr(value))
    return int(value)


def vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """The values as float64, shape (N,), C-contiguous, or a `DataError`."""
    try:
        if np.iscomplexobj(values):
            raise TypeError("complex ones; take their real part")
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(name=name, expected="numbers", received=str(error)) from error
    if np.ndim(values) != 1:
        raise DataError(
            name=name, expected="shape (N,)", received=f"{np.shape(values)}",
            remedy="give one column",
        )  # fmt: skip
    return array


def _require_form(form: Any) -> None:
    if not (isinstance(form, str) and form in _FIELDS):
        raise SettingError(f"expected one of {', '.join(_FIELDS)} for form, got {form!r}")


@dataclass(frozen=True)
class Gains:
    """Gains of a PID in one of three forms that must not be mixed (docs/CONVENTIONS.md, Control).

    Made by `Gains.standard`, `Gains.parallel` or `Gains.per_sample`.

    Parameters
    ----------
    form : "standard", "parallel" or "per_sample"
    Kp : float
        Proportional gain [u/y].
    integral : float
        Ti [s], inf for none, or Ki [u/(y s)] in parallel, [u/y] in per-sample form.
    derivative : float
        Td [s], or Kd [u s/y] in parallel, [u/y] in per-sample form.
    Ts : float or None
        Sample time at which per-sample gains hold [s]; None in the other forms.
    u_unit, y_unit : str
        Units of the command and of the output.

    Raises
    ------
    SettingError
        For gains that are not numbers, of different signs, or with `Kp = 0` and another gain, which
        the standard form cannot express.
    """

    form: Form
    Kp: float
    integral: float
    derivative: float
    Ts: float | None = None
    u_unit: str = "V"
    y_unit: str = "RPM"

    def __post_init__(self) -> None:
        _require_form(self.form)
        for name in ("u_unit", "y_unit"):
            if not isinstance(getattr(self, name), str):
                raise SettingError(
                    f"expected a unit as text for {name}, got {getattr(self, name)!r}; for example "
                    "'V', or '' for none"
                )
        for field, name in zip(("Kp", "integral", "derivative"), _FIELDS[self.form], strict=False):
            object.__setattr__(self, field, real(name, getattr(self, field)))
        if (self.form == "per_sample") != (self.Ts is not None):
            raise SettingError(
                "expected a sample time Ts with per-sample gains and with no others, got "
                f"{self.form} gains with Ts = {self.Ts}"
            )
        if self.Ts is not None:
            object.__setattr__(self, "Ts", real("Ts", self.Ts))
        self._converted("standard", self.Ts)

    @classmethod
    def standard(
        cls, Kp: float, Ti: float, Td: float = 0.0, *, u_unit: str = "V", y_unit: str = "RPM"
    ) -> Gains:
        """`Kp (e + (1/Ti) int e dt + Td de/dt)`: Kp [u/y], Ti [s] (inf for no integral), Td [s]."""
        return cls("standard", Kp, Ti, Td, None, u_unit, y_unit)

    @classmethod
    def parallel(
        cls, Kp: float, Ki: float, Kd: float = 0.0, *, u_unit: str = "V", y_unit: str = "RPM"
    ) -> Gains:
        """`Kp e + Ki int e dt + Kd de/dt`: Kp [u/y], Ki [u/(y s)], Kd [u s/y]."""
        return cls("parallel", Kp, Ki, Kd, None, u_unit, y_unit)

    @classmethod
    def per_sample(
        cls,
        Kp: float,
        Ki: float,
        Kd: float = 0.0,
        *,
        Ts: float,
        u_unit: str = "V",
        y_unit: str = "RPM",
    ) -> Gains:
        """`Kp e + Ki sum e + Kd (e(k) - e(k-1))` at sample time `Ts` [s]: all gains [u/y]."""
        return cls("per_sample", Kp, Ki, Kd, Ts, u_unit, y_unit)

    def to(self, form: Form, *, Ts: float | None = None) -> Gains:
        """The same gains in another form; exact to rounding.

        Parameters
        ----------
        form : "standard", "parallel" or "per_sample"
        Ts : float, optional
            Sample time of per-sample gains [s]; by default that of these gains, if they have one.

        Raises
        ------
        SettingError
            For an unknown form, or per-sample gains without a sample time.
        """
        _require_form(form)
        units = (self.u_unit, self.y_unit)
        if form != "per_sample":
            return Gains(form, *self._converted(form, self.Ts), None, *units)
        Ts = self.Ts if Ts is None else real("Ts", Ts)
        if Ts is None:
            raise SettingError("expected a sample time for per-sample gains, got none; give Ts [s]")
        if self.form == "per_sample" and Ts != self.Ts:
            return self.to("standard").to("per_sample", Ts=Ts)
        return Gains(form, *self._converted(form, Ts), Ts, *units)

    def _converted(self, form: Form, Ts: float | None) -> tuple[float, float, float]:
        values = (self.Kp, self.integral, self.derivative)
        return _core.convert_gains(
            values, form=self.form, to=form, Ts=math.nan if Ts is None else Ts
        )

    @property
    def Ti(self) -> float:
        """Integral time [s]; of the standard form only."""
        return self._only("Ti", self.integral, "standard")

    @property
    def Td(self) -> float:
        """Derivative time [s]; of the standard form only."""
        return self._only("Td", self.derivative, "standard")

    @property
    def Ki(self) -> float:
        """Integral gain; of the parallel and the per-sample form."""
        return self._only("Ki", self.integral, "parallel", "per_sample")

    @property
    def Kd(self) -> float:
        """Derivative gain; of the parallel and the per-sample form."""
        return self._only("Kd", self.derivative, "parallel", "per_sample")

    def _only(self, name: str, value: float, *forms: str) -> float:
        if self.form not in forms:
            raise SettingError(
                f"expected gains in {' or '.join(forms)} form for {name}, got {self.form}; convert "
                f"them with .to({forms[0]!r})"
            )
        return value

    @property
    def units(self) -> dict[str, str]:
        """The unit of each gain by name; u and y stand for unknown units."""
        u, y = self.u_unit or "u", self.y_unit or "y"
        ratio = f"{u}/{y}"
        if self.form == "standard":
            return {"Kp": ratio, "Ti": "s", "Td": "s"}
        if self.form == "parallel":
            return {"Kp": ratio, "Ki": f"{u}/({y} s)", "Kd": f"{u} s/{y}"}
        return {"Kp": ratio, "Ki": ratio, "Kd": ratio, "Ts": "s"}

    def to_dict(self) -> dict[str, Any]:
        """The form, and the gains by their names in it."""
        values = (self.Kp, self.integral, self.derivative, self.Ts)
        return {"form": self.form, **dict(zip(_FIELDS[self.form], values, strict=False))}

    @staticmethod
    def fields_of(form: str) -> tuple[str, ...] | None:
        """Names of the gains in a form; None for an unknown form."""
        return _FIELDS.get(form)

    def __str__(self) -> str:
        numbers = {k: v for k, v in self.to_dict().items() if k not in ("form", "Ts")}
        parts = [f"{name} {value:.6g} {self.units[name]}" for name, value in numbers.items()]
        at = f" at {self.Ts:g} s" if self.Ts is not None else ""
        return f"{', '.join(parts)} ({self.form.replace('_', '-')}{at})"
