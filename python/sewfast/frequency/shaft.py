"""A rigid machine, or two or three masses on shafts, fitted to a frequency response.

With the electrical and mechanical lag `1 + a1 s + a2 s^2`, the motor's speed under a command is

    G(s) = K e^(-s tau) / (1 + a1 s + a2 s^2)  x  (w_r / w_a)^2 A(s) / R(s),
    A(s) = s^2 + 2 z_a w_a s + w_a^2,   R(s) = s^2 + 2 z_r w_r s + w_r^2

The motor stands still at the antiresonance w_a, where the load oscillates on the shaft alone, and
both oscillate against each other at the resonance w_r; the ratio of the two frequencies gives that
of the inertias (Ellis 2012, Control System Design Guide, chapter 16). The measured quantity is not
G but its response to a held command, as counted by the encoder; the core (`rust/core/src/shaft.rs`)
computes and fits that exactly, by partial fractions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import _core
from ..arrays import FloatArray
from ..control.biquad import Biquad
from ..errors import DataError, FitError
from ..models import LinearOE
from ..tables import Shown
from .response import Complex, FrequencyResponse

RIGID, SHAFT = 4, 4
"""Number of parameters of a rigid machine, and of each shaft."""
CONFIDENCE = 1.96


@dataclass(frozen=True)
class Parameter:
    """A fitted value and its 95 % interval."""

    value: float
    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"{self.value:.5g} {self.unit} ({self.low:.5g} to {self.high:.5g})"


@dataclass(frozen=True, eq=False, repr=False)
class ShaftFit(Shown):
    """A rigid machine, two masses or three, with intervals.

    Attributes
    ----------
    parameters : mapping of Parameter by name
        `gain` [y/u], `delay` [s] beyond the hold, `lag_1`, `lag_2` [s] if the lags are real,
        otherwise `swing_hertz`, `swing_damping`; with a shaft also `resonance_hertz` and
        `resonance_damping`, to which the motor's back-EMF adds, `antiresonance_hertz`,
        `antiresonance_damping`, `inertia_ratio` (all loads over the motor), with a second shaft
        `resonance_2_hertz` and so on.
    misfit : float
        Root mean square of error over standard deviation: 1 if noise explains everything.
    response : FrequencyResponse
        The fitted response.
    beyond_hertz : float or None
        Frequency of a resonance above the measured range, estimated from its flank [Hz].
    """

    parameters: Mapping[str, Parameter]
    misfit: float
    response: FrequencyResponse
    _theta: FloatArray
    beyond_hertz: float | None = None

    @property
    def has_resonance(self) -> bool:
        """Whether a shaft was found."""
        return self.resonances > 0

    @property
    def resonances(self) -> int:
        """Number of shafts: 0 for a rigid machine, 1 for two masses, 2 for three."""
        return (len(self._theta) - RIGID) // SHAFT

    def at(self, hertz: Any) -> Complex:
        """The fitted response of the measured quantity, at `hertz`."""
        f = np.ascontiguousarray(hertz, dtype=np.float64)
        of = self.response
        found: Complex = _core.shaft_response(self._theta, f, Ts=of.Ts, counted=of.from_counts)
        return found

    def to_model(self) -> LinearOE:
        """The fit as a linear model of the true speed at the samples."""
        of = self.response
        return sampled_model(self._theta, of.Ts, of.u_unit, of.y_unit)

    def notch(self, number: int = 1) -> Biquad:
        """The notch that cancels a resonance, by default the lowest.

        Its zeros are the poles of the oscillation. At w_r the shaft raises the gain by
        g = (w_r/w_a)^2 |A/R|; a depth of 1/g cancels that, and with a width of 2 z_r g the notch's
        zeros have the damping of the resonance.

        Raises
        ------
        FitError
            For a resonance that the machine does not have, or one beyond half the sample rate.
        """
        # limits of depth and width of a proposed notch
        depths, widths = (0.02, 0.7), (0.1, 2.0)
        if not 1 <= number <= self.resonances:
            kind = f"one of {self.resonances}" if self.resonances else "a rigid one"
            raise FitError(
                name="notch", expected=f"a machine with {number} or more resonances",
                received=kind, remedy="leave the notch out, or give Biquad.notch(frequency)",
            )  # fmt: skip
        p, mark = self.parameters, _mark(number)
        fr, fa = p[f"resonance{mark}_hertz"].value, p[f"antiresonance{mark}_hertz"].value
        zr, za = p[f"resonance{mark}_damping"].value, p[f"antiresonance{mark}_damping"].value
        if fr * self.response.Ts >= 0.5:
            raise FitError(
                name="notch", expected="a resonance below half the sample rate",
                received=f"one at {fr:.4g} Hz", remedy="sample faster",
            )  # fmt: skip
        ratio = fa / fr
        rises = abs(ratio**2 - 1.0 + 2j * za * ratio) / (2.0 * zr * ratio**2)
        depth, width = 1.0 / max(rises, 1.0), 2.0 * zr * max(rises, 1.0)
        low, high = depths
        return Biquad.notch(fr, min(max(depth, low), high), min(max(width, widths[0]), widths[1]))

    def to_dict(self) -> dict[str, Any]:
        """Parameters with their intervals, as JSON values."""
        rows = {name: vars(p) for name, p in self.parameters.items()}
        return {
            "resonance": self.has_resonance, "misfit": self.misfit, "parameters": rows,
            "beyond_hertz": self.beyond_hertz,
        }  # fmt: skip

    def __str__(self) -> str:
        kind = ("rigid", "two masses and a shaft", "three masses and two shafts")[self.resonances]
        width = max(map(len, self.parameters))
        rows = [f"  {name:<{width}}  {p}" for name, p in self.parameters.items()]
        found = [f"{kind}, misfit {self.misfit:.3g} (95 % intervals)", *rows]
        if self.beyond_hertz is not None:
            found.append(
                f"  a resonance beyond {self.response.hertz[-1]:.4g} Hz, near "
                f"{self.beyond_hertz:.3g} Hz by its flank: sample faster, or raise f_max"
            )
        return "\n".join([*found, *(f"  {self.notch(k + 1)}" for k in range(self.resonances))])


def fit_shaft(response: FrequencyResponse, *, resonance: bool | None = None) -> ShaftFit:
    """Fit a rigid machine, or two or three masses on shafts, to the response of its speed.

    Parameters
    ----------
    response : FrequencyResponse
        From command to speed, as `sewfast.bode` measures it; lines with a coherence below a half
        are omitted.
    resonance : bool, optional
        Whether there is a shaft. None: a shaft is accepted if it explains 100 times the mean
        squared error of a frequency, is damped below .5 and lies within the measured range. A
        second shaft has to satisfy the same conditions.

    Raises
    ------
    DataError
        For fewer than 20 usable frequencies.
    FitError
        If nothing converges, or a resonance is requested and none is found.
    """
    f, value, sigma, level = _usable(response)
    cost, theta, covariance, beyond = _core.fit_shaft(
        f, value, sigma, Ts=response.Ts, counted=response.from_counts, resonance=resonance
    )
    if resonance and len(theta) == RIGID:
        raise FitError(
            name="resonance", expected="one within the measured frequencies", received="none",
            remedy="leave resonance=None, or measure to higher frequencies",
        )  # fmt: skip
    if not math.isfinite(cost):
        raise FitError(
            name="response", expected="a fit that converges", received="none",
            remedy="look at it: is it a speed?",
        )  # fmt: skip
    freedom = max(2 * len(f) - len(theta), 1)
    scale = max(1.0, cost / freedom)
    theta[0] += math.log(level)
    with np.errstate(all="ignore"):  # what the lines do not determine has no finite variance
        parameters = _parameters(theta, covariance * scale, response)
    return ShaftFit(parameters, math.sqrt(cost / freedom), response, theta, beyond)


def _mark(number: int) -> str:
    """The mark of a shaft in the names of its parameters."""
    return "" if number == 1 else f"_{number}"


def sampled_model(theta: FloatArray, Ts: float, u_unit: str, y_unit: str) -> LinearOE:
    """G under a held command, at the samples; theta: logarithms, except the delay in samples."""
    num, den = _core.shaft_fraction(theta, Ts=Ts)
    return LinearOE.from_tf(num, den, Ts, input_units=(u_unit,), output_unit=y_unit)  # type: ignore[no-any-return]


def _usable(response: FrequencyResponse) -> tuple[FloatArray, Complex, FloatArray, float]:
    """Frequencies, values and deviations of usable lines over their median magnitude, and that."""
    # least number of frequencies for a fit, and least magnitude of a usable one
    least, least_gain = 20, 1e-300
    hertz, value = np.asarray(response.hertz), np.asarray(response.value)
    variance = np.asarray(response.variance)
    usable = (response.coherence > 0.5) & (hertz > 0.0) & (np.abs(value) > least_gain)
    usable &= np.isfinite(value) & np.isfinite(variance)
    if usable.sum() < least:
        raise DataError(
            name="response", expected=f"at least {least} frequencies with a coherence above .5",
            received=str(usable.sum()), remedy="excite more, or longer",
        )  # fmt: skip
    f, Ts = hertz[usable], response.Ts
    if not (math.isfinite(Ts) and Ts > 0.0 and np.all(np.diff(f) > 0.0)):
        raise DataError(
            name="response", expected="ascending frequencies and a sample time above 0 s",
            received=f"{f[0]:g} to {f[-1]:g} Hz, {Ts:g} s", remedy="sort the lines, each only once",
        )  # fmt: skip
    level = float(np.median(np.abs(value[usable])))
    if level == 0.0:
        raise DataError(
            name="response", expected="an output that moves with the input", received="a gain of 0",
            remedy="check which column is the output",
        )  # fmt: skip
    g = value[usable] / level
    spread = np.minimum(np.sqrt(np.maximum(variance[usable], 0.0)) / level, 1e100)
    # part of the gain that no fit has to explain: friction and dead time distort every response a
    # little, which could otherwise outweigh a less visible resonance
    sigma = np.sqrt(0.5 * _smoothed(spread**2) + (0.005 * np.abs(g)) ** 2)
    return f, g, sigma, level


def _smoothed(variance: FloatArray) -> FloatArray:
    # lines to either side over which the uncertainty is smoothed: few blocks estimate it poorly
    neighbours = 10
    logs = np.log(np.maximum(variance, 1e-300))  # a simulation without noise has none
    n = len(logs)
    around = [
        np.median(logs[max(0, k - neighbours) : min(n, k + neighbours + 1)]) for k in range(n)
    ]
    return np.exp(around)


def _parameters(
    theta: FloatArray, covariance: FloatArray, response: FrequencyResponse
) -> dict[str, Parameter]:
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))

    def positive(j: int, unit: str, scale: float = 1.0) -> Parameter:
        value, factor = math.exp(theta[j]) * scale, math.exp(min(CONFIDENCE * sd[j], 700.0))
        return Parameter(value, value / factor, value * factor, unit)

    def derived(function: Any, unit: str) -> Parameter:
        """By linear propagation."""
        value = function(theta)
        steps = 1e-5 * np.eye(len(theta))
        slope = np.array([(function(theta + s) - function(theta - s)) / 2e-5 for s in steps])
        off = CONFIDENCE * math.sqrt(max(slope @ covariance @ slope, 0.0))
        return Parameter(value, value - off, value + off, unit)

    unit = f"{response.y_unit}/{response.u_unit}" if response.y_unit else ""
    off = CONFIDENCE * sd[3] * response.Ts
    delay = theta[3] * response.Ts
    found = {
        "gain": positive(0, unit),
        "delay": Parameter(delay, max(delay - off, 0.0), delay + off, "s"),
    }
    a1, a2 = np.exp(theta[1:3])
    if a1 * a1 > 4.0 * a2:
        for name, sign in (("lag_1", 1.0), ("lag_2", -1.0)):
            found[name] = derived(lambda x, sign=sign: _lag(x, sign), "s")
    else:
        found["swing_hertz"] = derived(lambda x: math.exp(-0.5 * x[2]) / (2 * math.pi), "Hz")
        found["swing_damping"] = derived(lambda x: 0.5 * math.exp(x[1] - 0.5 * x[2]), "")
    turn, shafts = 1.0 / (2.0 * math.pi), range((len(theta) - RIGID) // SHAFT)
    for k in shafts:
        at, mark = RIGID + SHAFT * k, _mark(k + 1)
        found[f"resonance{mark}_hertz"] = positive(at, "Hz", turn)
        found[f"resonance{mark}_damping"] = positive(at + 1, "")
        found[f"antiresonance{mark}_hertz"] = positive(at + 2, "Hz", turn)
        found[f"antiresonance{mark}_damping"] = positive(at + 3, "")
    if shafts:  # far below all resonances the motor moves all loads, far above only itself
        found["inertia_ratio"] = derived(
            lambda x: math.exp(2.0 * float(np.sum(x[RIGID::SHAFT] - x[RIGID + 2 :: SHAFT]))) - 1.0,
            "",
        )
    return found


def _lag(theta: FloatArray, sign: float) -> float:
    a1, a2 = np.exp(theta[1:3])
    return float(0.5 * (a1 + sign * math.sqrt(max(a1 * a1 - 4.0 * a2, 0.0))))
