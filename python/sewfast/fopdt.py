"""`Fopdt`: first order plus dead time, and its fit to a step response."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .errors import SettingError
from .gains import real, vector


@dataclass(frozen=True)
class Fopdt:
    """First order plus dead time, `K e^(-sL) / (1 + sT)`, about a step (paper Eq. 10-11).

    Parameters
    ----------
    K : float
        Gain [y/u].
    T, L : float
        Time constant and dead time [s].
    offset : float
        The output settles at `K u + offset` [y].
    u_low, u_high : float
        Input before and after the step [u].
    fit_percent : float
        100 (1 - |y - model| / |y - mean(y)|) over the samples used.
    u_unit, y_unit : str
        Units of input and output.
    K_se, T_se, L_se : float
        Standard errors, for residuals of any colour; NaN where it was not fitted.
    limited : int
        Samples on a limit of the output, which had no weight.
    moving : bool
        Whether the machine was not at rest before the step: its free response was fitted as well.
    overshoot_percent : float
        How far the response goes beyond where it settles, in percent of its rise; 0 where that does
        not stand out of the noise. Such a response is of no first order.

    Raises
    ------
    SettingError
        For a K that is not finite, a T that is not above 0 s or an L below 0 s.
    """

    K: float
    T: float
    L: float
    offset: float = 0.0
    u_low: float = 0.0
    u_high: float = 1.0
    fit_percent: float = math.nan
    u_unit: str = "V"
    y_unit: str = "RPM"
    K_se: float = math.nan
    T_se: float = math.nan
    L_se: float = math.nan
    limited: int = 0
    moving: bool = False
    overshoot_percent: float = 0.0

    def __post_init__(self) -> None:
        for name in ("K", "T", "L", "offset", "u_low", "u_high"):
            object.__setattr__(self, name, real(name, getattr(self, name)))
        if not (math.isfinite(self.K) and 0.0 < self.T < math.inf and 0.0 <= self.L < math.inf):
            raise SettingError(
                "expected a finite gain K, T above 0 s and L of 0 s or more, got "
                f"K = {self.K:g} {self.y_unit}/{self.u_unit}, T = {self.T:g} s, L = {self.L:g} s"
            )

    @property
    def warning(self) -> str:
        """What speaks against gains from these numbers; empty where nothing does."""
        if not self.overshoot_percent:
            return ""
        return (
            f"overshoots by {self.overshoot_percent:.0f} %, which no first order with dead time "
            "does: do not trust gains from these numbers, identify a model of second order or more"
        )

    def response(self, t: ArrayLike) -> NDArray[np.float64]:
        """The output at times `t` [s] after the step, shape as `t`; `t` may be negative."""
        since = np.maximum(np.asarray(t, dtype=np.float64) - self.L, 0.0)
        share = -np.expm1(-since / self.T)
        return np.asarray(self.offset + self.K * (self.u_low + share * (self.u_high - self.u_low)))

    def __str__(self) -> str:
        def with_error(value: float, error: float) -> str:
            return f"{value:.6g}" + ("" if math.isnan(error) else f" +- {error:.2g}")

        parts = [
            f"K {with_error(self.K, self.K_se)} {self.y_unit}/{self.u_unit}",
            f"T {with_error(self.T, self.T_se)} s",
            f"L {with_error(self.L, self.L_se)} s (L/T {self.L / self.T:.3g})",
        ]
        if not math.isnan(self.fit_percent):
            parts.append(f"fit {self.fit_percent:.2f} %")
        if self.limited:
            parts.append(f"{self.limited} samples on a limit left out")
        if self.moving:
            parts.append("not from rest")
        if self.warning:
            parts.append(f"warning: {self.warning}")
        return ", ".join(parts)


def fit_fopdt(
    u: ArrayLike, y: ArrayLike, *, Ts: float, u_unit: str = "V", y_unit: str = "RPM"
) -> Fopdt:
    """First-order-plus-dead-time approximation of a measured step response.

    Least squares over K, T, L and the level before the step. The record is used from its start to
    the second step of the input; the first may be anywhere after some samples. Samples on a limit
    of the output have no weight, and a machine that was not at rest is fitted with its free
    response where that is three of its standard errors. Standard errors hold for residuals of any
    colour, which are whitened by an autoregression (Andrews, Monahan 1992). An overshoot beyond
    what the noise explains is told (`Fopdt.warning`): the response is then of no first order.

    Parameters
    ----------
    u, y : array, shape (N,)
        Input and output; a raw speed with its quantisation will do.
    Ts : float
        Sample time [s].

    Raises
    ------
    DataError
        Without a step, or where the response does not settle or drowns in noise.
    SettingError
        For a sample time that is not above 0.
    """
    found = _core.fit_fopdt(vector("u", u), vector("y", y), Ts=real("Ts", Ts))
    return Fopdt(**found, u_unit=u_unit, y_unit=y_unit)
