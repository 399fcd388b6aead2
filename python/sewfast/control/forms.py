"""Conversion of a PID to and from the objects of MATLAB and python-control."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from ..dataset import FloatArray
from ..errors import SettingError
from ..gains import Gains, real
from ..models.conversion import polynomials_of, require_control
from .controller import Controller
from .loop import require_controller
from .systems import beside, gain, measurement, pid, series

# --- From python-control: the unique gains of a fraction in z -------------------------------------
# With `p = Tf/(Tf + Ts)`, `Tf = Td/N`, the controller is
#
#     C(z) = Kp + Ki z/(z - 1) + kd (z - 1)/(z - p),    Ki = Kp Ts/Ti,    kd = Kp Td/(Tf + Ts)
#
# The poles determine its terms and the residues their gains, so nothing has to be guessed.


_SAME = 1e-9
"""Relative difference up to which two numbers of an object count as equal."""


@dataclass(frozen=True)
class _Terms:
    """Gains per sample and the derivative's pole; NaN without such a pole."""

    Kp: float
    Ki: float
    kd: float
    pole: float


def from_control(
    system: Any, *, Ts: float | None = None, u_unit: str = "V", y_unit: str = "RPM"
) -> Controller:
    """A controller from a discrete-time PID of python-control; the counterpart of `to_control`.

    Parameters
    ----------
    system : control.TransferFunction or control.StateSpace
        From the error to the command, or from `[r, y]` to the command; two inputs labelled r and y
        can have either order. Its poles are 1 (integral) and one from 0 to 1 (derivative with its
        filter), or one of them, or none.
    Ts : float, optional
        Sample time [s], if the object does not state it (`dt` is True or None).
    u_unit, y_unit : str
        Units of command and output, which python-control does not keep.

    Returns
    -------
    Controller
        Gains in standard form, without limits and feedback filters, which can be set by
        `dataclasses.replace`.

    Raises
    ------
    SettingError
        For anything else: continuous time, other poles (a feedback filter, another formula than the
        backward difference), a measured output that does not enter as `-C y`, gains of different
        signs.
    """
    control = require_control()
    if not isinstance(system, (control.TransferFunction, control.StateSpace)):
        raise SettingError(
            name="system", expected="a TransferFunction or a StateSpace of python-control",
            received=type(system).__name__,
        )  # fmt: skip
    dt = _sample_time(system, Ts)
    terms = [_terms(*fraction) for fraction in _fractions(system, dt)]
    if len(terms) == 1:
        return _controller(terms[0], 0.0, 0.0, dt, u_unit, y_unit)
    of_r, of_y = reversed(terms) if list(system.input_labels) == ["y", "r"] else terms
    own = _Terms(-of_y.Kp, -of_y.Ki, -of_y.kd, of_y.pole)
    alpha, beta = _weights(of_r, own)
    return _controller(own, alpha, beta, dt, u_unit, y_unit)


def _sample_time(system: Any, Ts: float | None) -> float:
    given = None if Ts is None else real("Ts", Ts)
    if system.dt == 0 and not isinstance(system.dt, bool):
        raise SettingError(
            name="system", expected="a PID in discrete time", received="one in continuous time",
            remedy="give its gains to Gains.parallel or Gains.standard: Controller samples them "
            "with backward differences",
        )  # fmt: skip
    stated = None if system.dt is None or isinstance(system.dt, bool) else float(system.dt)
    if stated is None and given is None:
        raise SettingError(
            name="Ts", expected="a sample time", received=f"dt = {system.dt}", remedy="give Ts [s]"
        )
    if stated is not None and given is not None and not math.isclose(stated, given, rel_tol=_SAME):
        raise SettingError(
            name="Ts", expected=f"that of the system, dt = {stated:g} s", received=f"{given:g}",
            remedy="leave it out",
        )  # fmt: skip
    dt = given if stated is None else stated
    assert dt is not None
    if not 0.0 < dt < math.inf:
        raise SettingError(name="Ts", expected="finite and above 0 s", received=f"{dt:g}")
    return dt


def _fractions(system: Any, dt: float) -> list[tuple[FloatArray, FloatArray]]:
    """Numerator and denominator of each input in descending powers of z, of one length."""
    if system.noutputs != 1 or system.ninputs not in (1, 2):
        raise SettingError(
            name="system", expected="a PID from the error, or from r and y, to one command",
            received=f"{system.ninputs} inputs and {system.noutputs} outputs",
        )  # fmt: skip
    if hasattr(system, "A"):
        # powers of z^-1 up to one order are those of z, from the highest down
        timed = require_control().ss(system.A, system.B, system.C, system.D, dt)
        nums, den, _ = polynomials_of(timed, None)
        pairs = [(num, den) for num in nums]
    else:
        inputs = range(system.ninputs)
        pairs = [(np.asarray(system.num[0][i]), np.asarray(system.den[0][i])) for i in inputs]
        if any(len(num) > len(den) for num, den in pairs):
            raise SettingError(
                name="system", expected="a PID that is causal", received="more zeros than poles"
            )
        pairs = [(np.pad(num, (len(den) - len(num), 0)), den) for num, den in pairs]
    return [_levelled(np.asarray(n, float), np.asarray(d, float)) for n, d in pairs]


def _levelled(num: FloatArray, den: FloatArray) -> tuple[FloatArray, FloatArray]:
    size = max(len(num), len(den))
    n, d = np.zeros(size), np.zeros(size)
    n[: len(num)], d[: len(den)] = num, den
    return n / d[0], d / d[0]


def _terms(num: FloatArray, den: FloatArray) -> _Terms:
    """The gains by the poles and their residues."""
    order = len(den) - 1
    if order > 2:
        raise _other(den)
    # share of a denominator's coefficients below which its value at z = 1 counts as 0
    integrates = order > 0 and bool(abs(den.sum()) <= 1e-12 * np.abs(den).sum())
    if order == 2 and not integrates:
        raise _other(den)
    # the product of the poles: if one is 1, it is the other one
    pole = math.nan
    if order == 2:
        pole = float(den[2])
    elif order == 1 and not integrates:
        pole = float(-den[1])
    if not (math.isnan(pole) or 0.0 <= pole < 1.0):
        raise _other(den)
    at = np.polynomial.polynomial.polyval
    rising = num[::-1]
    one = 1.0 if math.isnan(pole) else 1.0 - pole
    Ki = float(at(1.0, rising)) / one if integrates else 0.0
    kd = 0.0
    if not math.isnan(pole):
        kd = float(at(pole, rising)) / (one**2 if integrates else -one)
    # rounding of a sum of the coefficients, which the distance of the poles divides, too
    rounding = 1e-14 * float(np.abs(num).sum()) / one
    Ki = 0.0 if abs(Ki) <= rounding else Ki
    kd = 0.0 if abs(kd) <= rounding / (one if integrates else 1.0) else kd
    return _Terms(float(num[0]) - Ki - kd, Ki, kd, pole if kd else math.nan)


def _other(den: FloatArray) -> SettingError:
    poles = ", ".join(f"{p:.6g}" for p in np.roots(den))
    return SettingError(
        name="system", expected="the poles of a PID, 1 and one from 0 to below 1",
        received=str(poles),
        remedy="take feedback filters out and set them by dataclasses.replace, cancel poles with "
        "control.minreal, and use the backward difference for integral and derivative",
    )  # fmt: skip


def _weights(of_r: _Terms, own: _Terms) -> tuple[float, float]:
    """Alpha and beta; the other terms of both inputs must agree."""
    size = abs(own.Kp) + abs(own.Ki) + abs(own.kd)
    same_pole = not (of_r.kd and own.kd) or abs(of_r.pole - own.pole) <= _SAME
    if abs(of_r.Ki - own.Ki) > _SAME * size or not same_pole:
        raise SettingError(
            name="system", expected="r and -y to go through one integral and one derivative filter",
            received=f"integral gains of {of_r.Ki:.6g} and {own.Ki:.6g} per sample, filter poles "
            f"at {of_r.pole:.6g} and {own.pole:.6g}",
            remedy="the inputs are r and y, in this order",
        )  # fmt: skip
    for name, theirs, ours in (("Kp", of_r.Kp, own.Kp), ("Kd", of_r.kd, own.kd)):
        if not ours and abs(theirs) > _SAME * size:
            raise SettingError(
                name="system",
                expected=f"{name} to act on the output where it acts on the reference",
                received=f"0 and {theirs:.6g}", remedy="that part is a feedforward",
            )  # fmt: skip
    alpha = 1.0 - of_r.Kp / own.Kp if own.Kp else 0.0
    return alpha, 1.0 - of_r.kd / own.kd if own.kd else 0.0


def _controller(
    terms: _Terms, alpha: float, beta: float, Ts: float, u_unit: str, y_unit: str
) -> Controller:
    filtered = 0.0 if math.isnan(terms.pole) else terms.pole * Ts / (1.0 - terms.pole)
    units = {"u_unit": u_unit, "y_unit": y_unit}
    parallel = Gains.parallel(terms.Kp, terms.Ki / Ts, terms.kd * (filtered + Ts), **units)
    gains = parallel.to("standard")
    N = gains.Td / filtered if filtered else math.inf
    return Controller(gains, Ts, alpha=alpha, beta=beta, N=N, notes="from python-control")


# --- To and from MATLAB, and to python-control ----------------------------------------------------
# MATLAB's discrete PID with both formulas `BackwardEuler` equals this package's, term by term:
#
#     C = Kp + Ki Ts z/(z - 1) + Kd/(Tf + Ts z/(z - 1)),  Tf = Td/N, b = 1 - alpha, c = 1 - beta


Object: TypeAlias = Literal["pid", "pid2", "pidstd", "pidstd2"]

FORMULA = "BackwardEuler"
_NAMES = {
    "pid": ("Kp", "Ki", "Kd", "Tf"),
    "pid2": ("Kp", "Ki", "Kd", "Tf", "b", "c"),
    "pidstd": ("Kp", "Ti", "Td", "N"),
    "pidstd2": ("Kp", "Ti", "Td", "N", "b", "c"),
}
"""Arguments of each object, in the order of its constructor."""


def to_matlab(controller: Controller, form: Object = "pid2") -> dict[str, Any]:
    """The numbers of one of MATLAB's PID objects, `Ts`, `IFormula` and `DFormula` by name.

    Parameters
    ----------
    controller : Controller
        Limits, feedback filters, ramp and feedforward are left out.
    form : "pid", "pid2", "pidstd" or "pidstd2"
        `pid` and `pidstd` have one degree of freedom: alpha and beta must be 0.

    Raises
    ------
    SettingError
        For another form, weights that it does not have, a gain schedule, or biquads.
    """
    require_controller(controller, None, "to_matlab(controller, form)")
    _require_form(form)
    if controller.schedule:
        raise SettingError(
            name="controller", expected="constant gains", received="a gain schedule",
            remedy="convert its points one by one",
        )  # fmt: skip
    if controller.biquads:
        raise SettingError(
            name="controller",
            expected="none with biquads, which MATLAB's PID objects have no place for",
            received=str(len(controller.biquads)),
            remedy="take them out and put them in series: Biquad.to_tf(Ts)",
        )  # fmt: skip
    if not form.endswith("2") and (controller.alpha or controller.beta):
        raise SettingError(
            name="form", expected=f"alpha = beta = 0 for {form}",
            received=f"{controller.alpha:g} and {controller.beta:g}",
            remedy=f"take {form}2, which has the weights b and c",
        )  # fmt: skip
    standard, parallel = controller.gains.to("standard"), controller.gains.to("parallel")
    values = {
        "Kp": standard.Kp,
        "Ti": standard.Ti,
        "Td": standard.Td,
        "N": controller.N,
        "Ki": parallel.Ki,
        "Kd": parallel.Kd,
        "Tf": standard.Td / controller.N,
        "b": 1.0 - controller.alpha,
        "c": 1.0 - controller.beta,
    }
    numbers: dict[str, Any] = {name: values[name] for name in _NAMES[form]}
    return {**numbers, "Ts": controller.Ts, "IFormula": FORMULA, "DFormula": FORMULA}


def matlab_code(controller: Controller, form: Object = "pid2") -> str:
    """The line of code for the object in MATLAB, with every digit."""
    numbers = to_matlab(controller, form)
    texts = [_number(numbers[name]) for name in (*_NAMES[form], "Ts")]
    return f"C = {form}({', '.join(texts)}, 'IFormula', '{FORMULA}', 'DFormula', '{FORMULA}');"


def from_matlab(
    form: Object,
    *,
    Ts: float,
    IFormula: str,
    DFormula: str,
    u_unit: str = "V",
    y_unit: str = "RPM",
    **numbers: float,
) -> Controller:
    """A controller from the numbers of one of MATLAB's PID objects; nothing is guessed.

    Parameters
    ----------
    form : "pid", "pid2", "pidstd" or "pidstd2"
        Class of the object: `class(C)` in MATLAB.
    Ts : float
        Its sample time [s].
    IFormula, DFormula : str
        Its formulas; both must be `BackwardEuler`, as in this controller.
    u_unit, y_unit : str
        Units of command and output, which MATLAB does not keep.
    **numbers : float
        Every number of the form by its name: Kp, Ki, Kd, Tf or Kp, Ti, Td, N, and b, c.

    Returns
    -------
    Controller
        Without limits and feedback filters, which can be set by `dataclasses.replace`.

    Raises
    ------
    SettingError
        For another form or formula, continuous time, a missing or unknown number, or gains that the
        standard form cannot express.
    """
    _require_form(form)
    if not (real("Ts", Ts) > 0.0):
        raise SettingError(
            name="Ts", expected="above 0 s", received=f"{Ts}",
            remedy="a continuous-time object is made discrete in MATLAB, with both formulas "
            "BackwardEuler",
        )  # fmt: skip
    for name, formula in (("IFormula", IFormula), ("DFormula", DFormula)):
        if formula != FORMULA:
            raise SettingError(
                name=name, expected="'BackwardEuler'", received=repr(formula),
                remedy=f"set it in MATLAB (C.{name} = 'BackwardEuler') and check the loop there: "
                "it is another controller",
            )  # fmt: skip
    if set(numbers) != set(_NAMES[form]):
        raise SettingError(
            name="numbers", expected=f"{', '.join(_NAMES[form])} of {form}",
            received=", ".join(numbers) or "none",
        )  # fmt: skip
    n = {name: real(name, value) for name, value in numbers.items()}
    units = {"u_unit": u_unit, "y_unit": y_unit}
    if form.startswith("pidstd"):
        gains, N = Gains.standard(n["Kp"], n["Ti"], n["Td"], **units), n["N"]
    else:
        gains = Gains.parallel(n["Kp"], n["Ki"], n["Kd"], **units)
        N = gains.to("standard").Td / n["Tf"] if n["Tf"] > 0.0 and n["Kd"] != 0.0 else math.inf
        if n["Tf"] < 0.0:
            raise SettingError(name="Tf", expected="0 s or more", received=str(n["Tf"]))
    alpha, beta = 1.0 - n.get("b", 1.0), 1.0 - n.get("c", 1.0)
    return Controller(gains, Ts, alpha=alpha, beta=beta, N=N, notes=f"from MATLAB's {form}")


def to_control(controller: Controller) -> Any:
    """`control.StateSpace` from `[r, y]` to `u`, feedback filters included, dt = Ts.

    It equals the controller as long as no limit, ramp or schedule acts and the run begins at zero.
    `control.tf(...)` of it is a pair of transfer functions; without feedback filters,
    `from_control` converts it back.

    Raises
    ------
    SettingError
        If python-control is not installed, or for a gain schedule.
    """
    require_controller(controller, None, "to_control(controller)")
    if controller.schedule:
        raise SettingError(
            name="controller", expected="constant gains",
            received="a gain schedule, which is not linear",
        )  # fmt: skip
    inputs = beside(gain(1.0), measurement(controller, encoder=False))
    system = series(inputs, pid(controller))
    return require_control().ss(*system, controller.Ts, inputs=["r", "y"], outputs=["u"])


def _require_form(form: str) -> None:
    if not (isinstance(form, str) and form in _NAMES):
        raise SettingError(name="form", expected=f"one of {', '.join(_NAMES)}", received=repr(form))


def _number(value: float) -> str:
    return "Inf" if math.isinf(value) else repr(float(value))
