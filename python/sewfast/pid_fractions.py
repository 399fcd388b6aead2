"""PIDs out of python-control's objects: the one set of gains that a fraction in z can have.

With `p = Tf/(Tf + Ts)`, `Tf = Td/N`, the controller is

    C(z) = Kp + Ki z/(z - 1) + kd (z - 1)/(z - p),    Ki = Kp Ts/Ti,    kd = Kp Td/(Tf + Ts)

so that the poles say what there is and the residues how much of it: nothing is left to guess.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .control import Controller
from .dataset import FloatArray
from .errors import SettingError
from .gains import Gains, real
from .models.toolboxes import polynomials_of, require_control

_SAME = 1e-9
"""Relative difference up to which numbers of one object are one number."""
_ROUNDING = 1e-12
"""Share of a denominator's coefficients below which its value at z = 1 is 0."""
_NOTHING = 1e-13
"""Share of all gains below which one is what rounding left."""


@dataclass(frozen=True)
class _Terms:
    """Gains per sample and the derivative's pole; NaN where no pole is seen."""

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
        From the error to the command, or from `[r, y]` to the command; two inputs that are labelled
        r and y may have either order. Its poles are 1 (integral) and one of 0 to 1 (derivative with
        its filter), or one of them, or none.
    Ts : float, optional
        Sample time [s], where the object does not state it (`dt` is True or None).
    u_unit, y_unit : str
        Units of command and output, which python-control does not keep.

    Returns
    -------
    Controller
        Gains in standard form; without limits and feedback filters, which
        `dataclasses.replace` sets.

    Raises
    ------
    SettingError
        For what is no such PID: continuous time, other poles (a feedback filter, another formula
        than the backward difference), a measured output that does not enter as `-C y`, gains of
        different signs.
    """
    control = require_control()
    if not isinstance(system, (control.TransferFunction, control.StateSpace)):
        raise SettingError(
            "expected a TransferFunction or a StateSpace of python-control, received "
            f"{type(system).__name__}"
        )
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
            "expected a PID in discrete time, received one in continuous time; give its gains to "
            "Gains.parallel or Gains.standard: Controller samples them with backward differences"
        )
    stated = None if system.dt is None or isinstance(system.dt, bool) else float(system.dt)
    if stated is None and given is None:
        raise SettingError(f"expected a sample time, received dt = {system.dt}; give Ts [s]")
    if stated is not None and given is not None and not math.isclose(stated, given, rel_tol=_SAME):
        raise SettingError(
            f"Ts: the system has dt = {stated:g} s, received {given:g}; leave it out"
        )
    dt = given if stated is None else stated
    assert dt is not None
    if not 0.0 < dt < math.inf:
        raise SettingError(f"expected a finite sample time above 0 s, received {dt:g}")
    return dt


def _fractions(system: Any, dt: float) -> list[tuple[FloatArray, FloatArray]]:
    """Numerator and denominator of each input in descending powers of z, of one length."""
    if system.noutputs != 1 or system.ninputs not in (1, 2):
        raise SettingError(
            "expected a PID from the error, or from r and y, to one command; received "
            f"{system.ninputs} inputs and {system.noutputs} outputs"
        )
    if hasattr(system, "A"):
        # powers of z^-1 up to one order are those of z, from the highest down
        timed = require_control().ss(system.A, system.B, system.C, system.D, dt)
        nums, den, _ = polynomials_of(timed, None)
        pairs = [(num, den) for num in nums]
    else:
        inputs = range(system.ninputs)
        pairs = [(np.asarray(system.num[0][i]), np.asarray(system.den[0][i])) for i in inputs]
        if any(len(num) > len(den) for num, den in pairs):
            raise SettingError("expected a PID that is causal, received more zeros than poles")
        pairs = [(np.pad(num, (len(den) - len(num), 0)), den) for num, den in pairs]
    return [_levelled(np.asarray(n, float), np.asarray(d, float)) for n, d in pairs]


def _levelled(num: FloatArray, den: FloatArray) -> tuple[FloatArray, FloatArray]:
    size = max(len(num), len(den))
    n, d = np.zeros(size), np.zeros(size)
    n[: len(num)], d[: len(den)] = num, den
    return n / d[0], d / d[0]


def _terms(num: FloatArray, den: FloatArray) -> _Terms:
    """What the poles and their residues say."""
    order = len(den) - 1
    if order > 2:
        raise _other(den)
    integrates = order > 0 and bool(abs(den.sum()) <= _ROUNDING * np.abs(den).sum())
    if order == 2 and not integrates:
        raise _other(den)
    # the product of the poles: beside 1 it is the other one
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
    size = np.abs(num).max(initial=0.0)
    Ki, kd = (0.0 if abs(x) <= _NOTHING * size else x for x in (Ki, kd))
    return _Terms(float(num[0]) - Ki - kd, Ki, kd, pole if kd else math.nan)


def _other(den: FloatArray) -> SettingError:
    poles = ", ".join(f"{p:.6g}" for p in np.roots(den))
    return SettingError(
        f"expected the poles of a PID, 1 and one from 0 to below 1, received {poles}; take "
        "feedback filters out and set them by dataclasses.replace, cancel poles with "
        "control.minreal, and use the backward difference for integral and derivative"
    )


def _weights(of_r: _Terms, own: _Terms) -> tuple[float, float]:
    """Alpha and beta; the other terms of both ways must agree."""
    size = abs(own.Kp) + abs(own.Ki) + abs(own.kd)
    same_pole = not (of_r.kd and own.kd) or abs(of_r.pole - own.pole) <= _SAME
    if abs(of_r.Ki - own.Ki) > _SAME * size or not same_pole:
        raise SettingError(
            "expected r and -y to go through one integral and one derivative filter, received "
            f"integral gains of {of_r.Ki:.6g} and {own.Ki:.6g} per sample, filter poles at "
            f"{of_r.pole:.6g} and {own.pole:.6g}; the inputs are r and y, in this order"
        )
    for name, theirs, ours in (("Kp", of_r.Kp, own.Kp), ("Kd", of_r.kd, own.kd)):
        if not ours and abs(theirs) > _SAME * size:
            raise SettingError(
                f"expected {name} to act on the output where it acts on the reference, received 0 "
                f"and {theirs:.6g}; that part is a feedforward"
            )
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
