"""python-control and scipy.signal: objects of theirs from arrays, and arrays from their objects."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..dataset import FloatArray
from ..errors import SettingError
from .conversion import StateSpace, from_state_space, with_common_denominator


def require_control() -> Any:
    """python-control, or a `SettingError` that says how to install it."""
    try:
        import control
    except ImportError as e:
        raise SettingError(
            "this needs python-control, which is not installed: "
            'pip install "sewfast[control]"; to_tf and to_ss give plain arrays'
        ) from e
    return control


def require_scipy_signal() -> Any:
    """scipy.signal, or a `SettingError` that says how to install it."""
    try:
        from scipy import signal
    except ImportError as e:
        raise SettingError(
            'this needs scipy, which is not installed: pip install "sewfast[control]"; '
            "to_tf and to_ss give plain arrays"
        ) from e
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
    """Numerators and denominator in powers of z^-1, and the sample time [s], of a system's object.

    Raises
    ------
    SettingError
        For continuous time, several outputs, no sample time, or what is no system.
    """
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
    """Of the system; `Ts` where that has none (`dt` True or None: unspecified)."""
    if dt is not None and not isinstance(dt, bool) and dt > 0:
        if Ts is not None and abs(dt - Ts) > 1e-9 * Ts:
            raise SettingError(f"Ts: the system has dt = {dt:g} s, received {Ts:g}; leave Ts out")
        return float(dt)
    if dt is True and Ts is not None:
        return Ts
    raise SettingError(
        f"expected a system in discrete time with its sample time in seconds, received dt = {dt}; "
        "convert it (control.sample_system) or give Ts where dt is True"
    )
