"""Tuning rules, and `Fopdt`, the first-order model with dead time that they start from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .errors import SettingError
from .gains import Gains, real, vector

__all__ = ["BY_NAME", "Fopdt", "Rule", "amigo", "by_name", "eq_12", "simc", "table_1"]


# --- Fopdt: first order plus dead time, and its fit to a step response ----------------------------


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
        Standard errors, valid for coloured residuals; NaN without a fit.
    limited : int
        Samples on a limit of the output, which had no weight.
    moving : bool
        Whether the machine was not at rest before the step: its free response was fitted as well.
    overshoot_percent : float
        Overshoot of the response in percent of its rise; 0 if it does not stand out from the noise.
        A response with an overshoot is not of first order.

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
                f"K = {self.K:g} {self._unit}, T = {self.T:g} s, L = {self.L:g} s"
            )

    @property
    def _unit(self) -> str:
        return f"{self.y_unit or 'y'}/{self.u_unit or 'u'}"

    @property
    def warning(self) -> str:
        """Why gains from this fit should not be trusted; empty if there is no reason."""
        if not self.overshoot_percent:
            return ""
        return (
            f"overshoots by {self.overshoot_percent:.0f} %, which a first-order model with dead "
            "time cannot: do not trust gains from this fit, identify a model of second order or "
            "higher"
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
            f"K {with_error(self.K, self.K_se)} {self._unit}",
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
    response if that exceeds three of its standard errors. Standard errors are valid for coloured
    residuals, which are whitened by an autoregression (Andrews, Monahan 1992). `Fopdt.warning`
    reports an overshoot beyond what the noise explains: the response is then not of first order.

    Parameters
    ----------
    u, y : array, shape (N,)
        Input and output; a raw, quantised speed is fine.
    Ts : float
        Sample time [s].

    Raises
    ------
    DataError
        Without a step, or if the response does not settle or is hidden by noise.
    SettingError
        For a sample time that is not above 0.
    """
    found = _core.fit_fopdt(vector("u", u), vector("y", y), Ts=real("Ts", Ts))
    return Fopdt(**found, u_unit=u_unit, y_unit=y_unit)


# --- Tuning rules: gains, alpha and beta from a first-order model with dead time ------------------


@dataclass(frozen=True)
class Rule:
    """The result of a tuning rule.

    Attributes
    ----------
    gains : Gains
        In standard form.
    alpha, beta : float
        Shares of the reference taken out of the proportional and of the derivative term.
    name : str
        Name of the rule.
    costs : dict
        For Eq. 12 with `K = T = 1`: `disturbance_cost`, `reference_cost`, and `Ms` of the loop in
        continuous time; empty for other rules.
    """

    gains: Gains
    alpha: float
    beta: float
    name: str = ""
    costs: dict[str, float] = field(default_factory=dict, hash=False)

    def __str__(self) -> str:
        return f"{self.gains}, alpha {self.alpha:.4g}, beta {self.beta:.4g} ({self.name})"


def table_1(fopdt: Fopdt, *, outside: Literal["error", "nearest"] = "error") -> Rule:
    """Coarse tuning by the paper's Table 1, interpolated in L/T.

    Parameters
    ----------
    fopdt : Fopdt
    outside : "error" or "nearest"
        What to do if L/T is not in .1 to 1. Below .1, the nearest row is that of `L = .1 T`, a
        longer dead time than the plant's: conservative. Above 1 it is not.

    Raises
    ------
    SettingError
        If L/T is outside the table and `outside` is "error", or for K = 0 or T <= 0.
    """
    if outside not in ("error", "nearest"):
        raise SettingError(f"expected outside='error' or 'nearest', got {outside!r}")
    _require(fopdt)
    found = _core.table_1(fopdt.K, fopdt.T, fopdt.L, nearest=outside == "nearest")
    return _rule(fopdt, found, "table-1")


def eq_12(fopdt: Fopdt, *, Ms: float = math.inf) -> Rule:
    """Gains that minimise Eq. 12, for any L/T from .01 to 2; Table 1 lists them for ten ratios.

    The gains minimise the paper's integral after a step of the disturbance; alpha and beta minimise
    it after a step of the reference. Without a limit the loops are fragile: Ms is 2 to 3.2.

    Parameters
    ----------
    fopdt : Fopdt
    Ms : float
        Largest allowed |S| in continuous time; 1.4 to 2 is usual, inf for no limit.

    Raises
    ------
    SettingError
        If L/T is outside .01 to 2, for K = 0 or T <= 0, or an Ms of 1.1 or less.
    """
    _require(fopdt)
    found = _core.eq_12(fopdt.K, fopdt.T, fopdt.L, Ms=real("Ms", Ms))
    costs = {name: found[name] for name in ("disturbance_cost", "reference_cost", "Ms")}
    limit = "" if math.isinf(Ms) else f", Ms <= {Ms:g}"
    return replace(_rule(fopdt, found, f"eq-12{limit}"), costs=costs)


def simc(fopdt: Fopdt, *, tau_c: float | None = None, kind: Literal["PI", "PID"] = "PI") -> Rule:
    """SIMC: aims at a closed loop of first order with time constant `tau_c` and the dead time.

    Parameters
    ----------
    fopdt : Fopdt
    tau_c : float, optional
        Closed-loop time constant [s]; smaller is faster and less robust. By default L for PI, and
        L/2 for PID, which gives about the same Ms of 1.6 to 1.7.
    kind : "PI" or "PID"
        PID adds a derivative of L/3 on the output, converted exactly from series to standard form.

    Raises
    ------
    SettingError
        For K = 0, T <= 0, another kind, a negative tau_c, or tau_c = L = 0.

    References
    ----------
    S. Skogestad, J. Process Control 13, 2003; C. Grimholt, S. Skogestad, J. Process Control 70,
    2018 (the derivative).
    """
    if kind not in ("PI", "PID"):
        raise SettingError(f"expected kind='PI' or 'PID', got {kind!r}")
    _require(fopdt)
    usual = fopdt.L if kind == "PI" else fopdt.L / 2
    tau = usual if tau_c is None else real("tau_c", tau_c)
    found = _core.simc(fopdt.K, fopdt.T, fopdt.L, tau_c=tau, derivative=kind == "PID")
    return _rule(fopdt, found, f"simc-{kind.lower()}, tau_c {tau:g} s")


def amigo(fopdt: Fopdt) -> Rule:
    """AMIGO: fitted to the PID gains of least integral error with Ms and Mt of at most 1.4.

    Raises
    ------
    SettingError
        For K = 0, T <= 0 or L = 0.

    References
    ----------
    K. J. Astrom, T. Hagglund, J. Process Control 14, 2004.
    """
    _require(fopdt)
    return _rule(fopdt, _core.amigo(fopdt.K, fopdt.T, fopdt.L), "amigo")


def _simc_pid(fopdt: Fopdt) -> Rule:
    return simc(fopdt, kind="PID")


BY_NAME: dict[str, Callable[[Fopdt], Rule]] = {
    "table-1": table_1,
    "eq-12": eq_12,
    "simc": simc,
    "simc-pid": _simc_pid,
    "amigo": amigo,
}
"""Every rule with its defaults."""


def by_name(name: str) -> Callable[[Fopdt], Rule]:
    """The rule of that name; `_` counts as `-`.

    Raises
    ------
    SettingError
        For another name.
    """
    rule = BY_NAME.get(str(name).replace("_", "-").lower())
    if rule is None:
        raise SettingError(f"expected one of the rules {', '.join(BY_NAME)}, got {name!r}")
    return rule


def _require(fopdt: Any) -> None:
    if not isinstance(fopdt, Fopdt):
        raise SettingError(
            f"expected an Fopdt, got {type(fopdt).__name__}; fit one to a recorded step with "
            "fit_fopdt, or give Fopdt(K, T, L)"
        )


def _rule(fopdt: Fopdt, found: dict[str, Any], name: str) -> Rule:
    units = {"u_unit": fopdt.u_unit, "y_unit": fopdt.y_unit}
    gains = Gains.standard(found["Kp"], found["Ti"], found["Td"], **units)
    return Rule(gains, found["alpha"], found["beta"], name)
