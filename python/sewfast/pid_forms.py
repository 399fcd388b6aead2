"""A controller's PID as MATLAB's objects and python-control's, and back from them.

MATLAB's discrete PID with both formulas `BackwardEuler` is this package's, term by term:

    C = Kp + Ki Ts z/(z - 1) + Kd/(Tf + Ts z/(z - 1)),  Tf = Td/N, b = 1 - alpha, c = 1 - beta
"""

from __future__ import annotations

import math
from typing import Any, Literal, TypeAlias

from .control import Controller
from .errors import SettingError
from .gains import Gains, real
from .loop import require_controller
from .pid_fractions import from_control

__all__ = ["from_control", "from_matlab", "matlab_code", "to_control", "to_matlab"]

Object: TypeAlias = Literal["pid", "pid2", "pidstd", "pidstd2"]

FORMULA = "BackwardEuler"
_NAMES = {
    "pid": ("Kp", "Ki", "Kd", "Tf"),
    "pid2": ("Kp", "Ki", "Kd", "Tf", "b", "c"),
    "pidstd": ("Kp", "Ti", "Td", "N"),
    "pidstd2": ("Kp", "Ti", "Td", "N", "b", "c"),
}
"""Numbers of each object, in the order of its constructor."""


def to_matlab(controller: Controller, form: Object = "pid2") -> dict[str, Any]:
    """The numbers of one of MATLAB's PID objects, `Ts`, `IFormula` and `DFormula` by name.

    Parameters
    ----------
    controller : Controller
        Limits, filters of the feedback, ramp and schedule have no place there.
    form : "pid", "pid2", "pidstd" or "pidstd2"
        `pid` and `pidstd` have one degree of freedom: alpha and beta must be 0.

    Raises
    ------
    SettingError
        For another form, weights that it cannot hold, or a gain schedule.
    """
    require_controller(controller, None, "to_matlab(controller, form)")
    _require_form(form)
    if controller.schedule:
        raise SettingError(
            "expected constant gains, received a gain schedule; convert its points one by one"
        )
    if not form.endswith("2") and (controller.alpha or controller.beta):
        raise SettingError(
            f"expected alpha = beta = 0 for {form}, received {controller.alpha:g} and "
            f"{controller.beta:g}; take {form}2, which has the weights b and c"
        )
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
    """The line that makes the object in MATLAB, every digit kept."""
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
        What the object is: `class(C)` in MATLAB.
    Ts : float
        Its sample time [s].
    IFormula, DFormula : str
        Its formulas; both must be `BackwardEuler`, the only ones that are this controller's.
    u_unit, y_unit : str
        Units of command and output, which MATLAB does not keep.
    **numbers : float
        Every number of the form by its name: Kp, Ki, Kd, Tf or Kp, Ti, Td, N, and b, c.

    Returns
    -------
    Controller
        Without limits and feedback filters; `dataclasses.replace` sets them.

    Raises
    ------
    SettingError
        For another form or formula, continuous time, a number that is missing or does not belong
        there, or gains that the standard form cannot express.
    """
    _require_form(form)
    if not (real("Ts", Ts) > 0.0):
        raise SettingError(
            f"expected a sample time above 0 s, received Ts = {Ts}; a continuous-time object is "
            "made discrete in MATLAB, with both formulas BackwardEuler"
        )
    for name, formula in (("IFormula", IFormula), ("DFormula", DFormula)):
        if formula != FORMULA:
            raise SettingError(
                f"{name}: expected 'BackwardEuler', received {formula!r}; set it in MATLAB "
                f"(C.{name} = 'BackwardEuler') and check the loop there: it is another controller"
            )
    if set(numbers) != set(_NAMES[form]):
        raise SettingError(
            f"expected {', '.join(_NAMES[form])} of {form}, received {', '.join(numbers) or 'none'}"
        )
    n = {name: real(name, value) for name, value in numbers.items()}
    units = {"u_unit": u_unit, "y_unit": y_unit}
    if form.startswith("pidstd"):
        gains, N = Gains.standard(n["Kp"], n["Ti"], n["Td"], **units), n["N"]
    else:
        gains = Gains.parallel(n["Kp"], n["Ki"], n["Kd"], **units)
        N = gains.to("standard").Td / n["Tf"] if n["Tf"] > 0.0 and n["Kd"] != 0.0 else math.inf
        if n["Tf"] < 0.0:
            raise SettingError(f"expected Tf of 0 s or more, received {n['Tf']}")
    alpha, beta = 1.0 - n.get("b", 1.0), 1.0 - n.get("c", 1.0)
    return Controller(gains, Ts, alpha=alpha, beta=beta, N=N, notes=f"from MATLAB's {form}")


def to_control(controller: Controller) -> Any:
    """`control.StateSpace` from `[r, y]` to `u`, feedback filters included, dt = Ts.

    Equal to the controller itself where no limit, ramp or schedule acts and the run begins at
    zero. `control.tf(...)` of it is a pair of transfer functions; `from_control` reads it back
    where there is no feedback filter.

    Raises
    ------
    SettingError
        Where python-control is not installed, or for a gain schedule.
    """
    from .analysis.systems import beside, gain, measurement, pid, series
    from .models.toolboxes import require_control

    require_controller(controller, None, "to_control(controller)")
    if controller.schedule:
        raise SettingError("expected constant gains, received a gain schedule: it is not linear")
    inputs = beside(gain(1.0), measurement(controller, encoder=False))
    system = series(inputs, pid(controller))
    return require_control().ss(*system, controller.Ts, inputs=["r", "y"], outputs=["u"])


def _require_form(form: str) -> None:
    if not (isinstance(form, str) and form in _NAMES):
        raise SettingError(f"expected a form out of {', '.join(_NAMES)}, received {form!r}")


def _number(value: float) -> str:
    return "Inf" if math.isinf(value) else repr(float(value))
