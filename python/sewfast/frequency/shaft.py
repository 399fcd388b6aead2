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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray
from ..control.biquad import Biquad
from ..errors import DataError, FitError
from ..models import LinearOE
from ..tables import html_of
from .response import Complex, FrequencyResponse

RIGID, SHAFT = 4, 4
"""Number of parameters of a rigid machine, and of each shaft."""
LEAST, LEAST_GAIN = 20, 1e-300
"""Least number of frequencies for a fit, and least magnitude of a usable one."""
CLEAR = 100.0
"""Error that a resonance has to explain to be accepted, in mean squared errors of a frequency."""
NEIGHBOURS = 10
"""Lines to either side over which the uncertainty is smoothed: few blocks estimate it poorly."""
FLOOR = 0.005
"""Part of the gain that no fit has to explain: friction and dead time distort every response a
little, which could otherwise outweigh a less visible resonance."""
ORDERS = 2
"""Number of rational fits that give starts: of the machine's order, and one order higher."""
ROUNDS = 12
"""Iterations of a rational fit, each weighted by the one before."""
DELAYS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
"""Delays tried for a start [samples]."""
FAST = 0.3
"""Least lag of a start [samples]."""
BEGIN, FINISH = 12, 4
"""Evaluations for every start, and the number of best ones that are followed to the end."""
LIFTED = 50.0
"""Squared errors over their mean, summed over as many lines as a shaft needs, above which a second
shaft is searched; noise gives 16 with a standard deviation of 6."""
DAMPED = 0.5
"""Damping ratio from which two poles do not count as a resonance."""
RATIOS = (0.03, 30.0)
"""Limits of the ratio of load to motor inertia of a shaft."""
NEAR, SHOWN = 1.4, 8
"""Factor around antiresonance and resonance, and least number of usable frequencies within it: two
for each of the shaft's parameters, half of them around either. Fewer can be explained by many
spurious shafts."""
BEYOND, FARTHEST = (1.05, 1.3, 1.8), 1.0
"""Starts for a resonance beyond the measured range, relative to the highest frequency; and the
largest one accepted, relative to the sample rate."""
CONFIDENCE = 1.96
DEPTHS, WIDTHS = (0.02, 0.7), (0.1, 2.0)
"""Limits of depth and width of a proposed notch."""


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
class ShaftFit:
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
        return _sampled(self._theta, f, self.response.Ts, self.response.from_counts)

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
        low, high = DEPTHS
        return Biquad.notch(fr, min(max(depth, low), high), min(max(width, WIDTHS[0]), WIDTHS[1]))

    def to_dict(self) -> dict[str, Any]:
        """Parameters with their intervals, as JSON values."""
        rows = {name: vars(p) for name, p in self.parameters.items()}
        return {
            "resonance": self.has_resonance, "misfit": self.misfit, "parameters": rows,
            "beyond_hertz": self.beyond_hertz,
        }  # fmt: skip

    def _repr_html_(self) -> str:
        return html_of(str(self))

    def __repr__(self) -> str:
        return f"<{str(self).splitlines()[0]}>"

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


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
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
    task, level = _task_of(response)
    f = task.hertz
    rigid = min((_solved(task, x) for x in _rigid_starts(task)), key=lambda s: s[0])
    best, beyond = rigid, None
    if resonance is not False:
        shaft = _best_shaft(task, _shaft_starts(task, rigid[1]))
        if shaft is not None and (resonance or _is_better(task, shaft[0], rigid[0])):
            best = shaft
        second = _best_shaft(task, _second_starts(task, rigid[1], shaft))
        if second is not None and _is_better(task, second[0], best[0]):
            best = second
        if best is rigid and resonance:
            raise FitError(
                name="resonance", expected="one within the measured frequencies", received="none",
                remedy="leave resonance=None, or measure to higher frequencies",
            )  # fmt: skip
        if best is rigid:
            beyond = _beyond(task, rigid)
    cost, theta, covariance = best
    if not math.isfinite(cost):
        raise FitError(
            name="response", expected="a fit that converges", received="none",
            remedy="look at it: is it a speed?",
        )  # fmt: skip
    freedom = max(2 * len(f) - len(theta), 1)
    scale = max(1.0, cost / freedom)
    theta[0] += math.log(level)
    parameters = _parameters(theta, covariance * scale, response)
    return ShaftFit(parameters, math.sqrt(cost / freedom), response, theta, beyond)


# --- The sampled response -------------------------------------------------------------------------


def _shafts(theta: FloatArray) -> FloatArray:
    """Frequency [rad/s] and damping of each shaft's resonance and antiresonance, (shafts, 4)."""
    found: FloatArray = np.exp(theta[RIGID:]).reshape(-1, SHAFT)
    return found


def _in_order(theta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Reordered: the lowest resonance first, each antiresonance with the resonance above it.
    The response does not depend on which pair of zeros belongs to which pair of poles.
    """
    at = np.arange(len(theta))
    for first in (RIGID, RIGID + 2):  # resonances, antiresonances
        order = np.argsort(theta[first::SHAFT], kind="stable")
        for j in range(2):
            at[first + j :: SHAFT] = first + j + SHAFT * order
    return theta[at], covariance[np.ix_(at, at)]


def _mark(number: int) -> str:
    """The mark of a shaft in the names of its parameters."""
    return "" if number == 1 else f"_{number}"


def _sampled(theta: FloatArray, hertz: FloatArray, Ts: float, counted: bool) -> Complex:
    """Response of the measured quantity: speed at the samples, or its mean between them."""
    found: Complex = _core.shaft_response(theta, hertz, Ts=Ts, counted=counted)
    return found


def sampled_model(theta: FloatArray, Ts: float, u_unit: str, y_unit: str) -> LinearOE:
    """G under a held command, at the samples; theta: logarithms, except the delay in samples."""
    num, den = _core.shaft_fraction(theta, Ts=Ts)
    return LinearOE.from_tf(num, den, Ts, input_units=(u_unit,), output_unit=y_unit)  # type: ignore[no-any-return]


# --- The search -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Task:
    hertz: FloatArray
    value: Complex
    sigma: FloatArray
    Ts: float
    counted: bool


def _task_of(response: FrequencyResponse) -> tuple[_Task, float]:
    """The usable lines, divided by their median magnitude, and that."""
    hertz, value = np.asarray(response.hertz), np.asarray(response.value)
    variance = np.asarray(response.variance)
    usable = (response.coherence > 0.5) & (hertz > 0.0) & (np.abs(value) > LEAST_GAIN)
    usable &= np.isfinite(value) & np.isfinite(variance)
    if usable.sum() < LEAST:
        raise DataError(
            name="response", expected=f"at least {LEAST} frequencies with a coherence above .5",
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
    sigma = np.sqrt(0.5 * _smoothed(spread**2) + (FLOOR * np.abs(g)) ** 2)
    return _Task(f, g, sigma, Ts, response.from_counts), level


def _smoothed(variance: FloatArray) -> FloatArray:
    logs = np.log(np.maximum(variance, 1e-300))  # a simulation without noise has none
    n = len(logs)
    around = [
        np.median(logs[max(0, k - NEIGHBOURS) : min(n, k + NEIGHBOURS + 1)]) for k in range(n)
    ]
    return np.exp(around)


def _solved(
    task: _Task, start: FloatArray, evaluations: int = 200
) -> tuple[float, FloatArray, FloatArray]:
    cost, theta, covariance = _core.fit_shaft(
        start, task.hertz, task.value, task.sigma, Ts=task.Ts, counted=task.counted,
        evaluations=evaluations,
    )  # fmt: skip
    return cost, *_in_order(theta, covariance)


def _rigid_starts(task: _Task) -> list[FloatArray]:
    """Starts with a corner where the gain has fallen to .7, and lags beyond it."""
    size = np.abs(task.value)
    K = float(size[: max(3, len(size) // 50)].max())
    below = np.flatnonzero(size < K / math.sqrt(2.0))
    corner = task.hertz[below[0]] if len(below) else task.hertz[-1]
    T = 1.0 / (2.0 * math.pi * corner)
    return [
        np.array([math.log(K), math.log(T + fast), math.log(T * fast), delay])
        for fast in (0.03 * T, 0.3 * T)
        for delay in (0.1, 1.5)
    ]


def _shaft_starts(task: _Task, rigid: FloatArray) -> list[FloatArray]:
    """Starts from rational fits, and where the response is most above the rigid machine's."""
    f = task.hertz
    ratio = np.abs(task.value) / np.abs(_sampled(rigid, f, task.Ts, task.counted))
    return _rational_starts(task, rigid, 1) + _starts_at(task, rigid, ratio, f[_peaks(ratio)[:4]])


def _second_starts(
    task: _Task, rigid: FloatArray, shaft: tuple[float, FloatArray, FloatArray] | None
) -> list[FloatArray]:
    """Starts from rational fits, and where the response is above that of one shaft, the latter over
    as many lines as a shaft needs.
    """
    starts = _rational_starts(task, rigid, 2)
    if shaft is None:
        return starts
    cost, theta, _ = shaft
    f, fit = task.hertz, _sampled(theta, task.hertz, task.Ts, task.counted)
    usual = cost / max(2 * len(f) - len(theta), 1)
    off = np.abs((task.value - fit) / task.sigma) ** 2 / max(usual, 1e-300)
    unexplained = np.convolve(off, np.ones(SHOWN), "same")
    ratio = np.abs(task.value) / np.abs(fit)
    peaks = _peaks(ratio)
    return starts + _starts_at(task, theta, ratio, f[peaks[unexplained[peaks] > LIFTED][:4]])


def _rational_starts(task: _Task, fit: FloatArray, shafts: int) -> list[FloatArray]:
    """Starts from the poles and zeros of rational fits, which themselves need no start.
    Every choice of oscillating poles and zeros in the measured range is a start, if each
    antiresonance is below its resonance.
    """
    starts = []
    for order in range(2 + 2 * shafts, 2 + 2 * shafts + ORDERS):
        zeros, poles = (_swinging(q, task) for q in _rational(task, order))
        for resonances, antiresonances in product(
            combinations(poles, shafts), combinations(zeros, shafts)
        ):
            pairs = list(zip(resonances, antiresonances, strict=True))
            if all(RATIOS[0] < (r[0] / a[0]) ** 2 - 1.0 < RATIOS[1] for r, a in pairs):
                shaft = np.concatenate([np.log([*r, *a]) for r, a in pairs])
                starts += _with_lags(task, fit, shaft)
    return starts


def _with_lags(task: _Task, fit: FloatArray, shafts: FloatArray) -> list[FloatArray]:
    """Starts: these shafts with the lags of a fit, and with the gain, lags and delay that fit best.
    Divided by the shafts, the response is `K / (1 + a1 s + a2 s^2)`, whose inverse is linear in its
    coefficients; a few values of the delay are tried. Holding the command delays by half a sample,
    a mean over a sample by another half.
    """
    s = 2j * np.pi * task.hertz
    shape = np.ones(len(s), dtype=np.complex128)
    for wr, zr, wa, za in np.exp(shafts).reshape(-1, SHAFT):
        shape *= (s * s + 2.0 * za * wa * s + wa * wa) / (s * s + 2.0 * zr * wr * s + wr * wr)
        shape *= (wr / wa) ** 2
    best: tuple[float, list[FloatArray]] = math.inf, []
    kept = np.concatenate([fit[:RIGID], shafts])
    for delay in DELAYS:
        samples = delay + (1.0 if task.counted else 0.5)
        inverse = shape * np.exp(-s * samples * task.Ts) / task.value
        weight = np.abs(task.value) / (task.sigma * np.abs(inverse))
        rows = weight[:, None] * np.stack([np.ones(len(s)), s, s * s], axis=1)
        goal = weight * inverse
        found, left = _real_solution(rows, goal)
        cost = float(left[0]) if len(left) else math.inf
        # with lags below 0, a delay stands for a lag that it is not
        if cost < best[0] and found[0] > 0.0 and found[1] > 0.0 and found[2] > 0.0:
            a1, a2 = np.maximum(found[1:] / found[0], [FAST * task.Ts, (FAST * task.Ts) ** 2])
            lags = [-math.log(found[0]), math.log(a1), math.log(a2), delay]
            best = cost, [np.concatenate([lags, shafts])]
    return [kept, *best[1]]


def _rational(task: _Task, order: int) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator of a rational fit, in powers of a delay of one sample.
    The equation error is linear in the coefficients. Weighted by the denominator of the fit before,
    it approaches the output error (Sanathanan and Koerner 1963); the best iterate is returned.
    """
    delays = np.exp(-2j * np.pi * np.outer(task.hertz * task.Ts, np.arange(order + 3)))
    columns = np.hstack([delays[:, 1:], -task.value[:, None] * delays[:, 1 : order + 1]])
    weight, best = 1.0 / task.sigma, (math.inf, np.zeros(1), np.ones(1))
    for _ in range(ROUNDS):
        rows, goal = weight[:, None] * columns, weight * task.value
        found, _ = _real_solution(rows, goal)
        num = np.concatenate([[0.0], found[: order + 2]])
        den = np.concatenate([[1.0], found[order + 2 :]])
        below = delays[:, : order + 1] @ den
        weight = 1.0 / (task.sigma * np.maximum(np.abs(below), 1e-12))
        with np.errstate(all="ignore"):
            off = delays @ num / below - task.value
        cost = float(np.sum(np.abs(off / task.sigma) ** 2))
        if cost < best[0]:
            best = cost, num, den
    return best[1], best[2]


def _real_solution(rows: Complex, goal: Complex) -> tuple[FloatArray, FloatArray]:
    """Real least-squares solution of complex equations, and its sum of squares if it is unique."""
    found, left, *_ = np.linalg.lstsq(
        np.vstack([rows.real, rows.imag]), np.concatenate([goal.real, goal.imag]), rcond=None
    )
    return found, left


def _swinging(coefficients: FloatArray, task: _Task) -> list[tuple[float, float]]:
    """Frequency [rad/s] and damping of the roots that a shaft could have, in ascending order."""
    roots = np.roots(np.trim_zeros(coefficients, "f"))
    roots = np.log(roots[(roots.imag > 0.0) & (np.abs(roots) > 1e-3)]) / task.Ts
    sizes = np.abs(roots)
    inside = (sizes > 2.0 * np.pi * task.hertz[0]) & (sizes < 2.0 * np.pi * task.hertz[-1])
    found = [(abs(p), max(abs(p.real) / abs(p), 1e-3)) for p in roots[inside]]
    return sorted((w, z) for w, z in found if z < DAMPED)


def _peaks(ratio: FloatArray) -> NDArray[np.intp]:
    """Indices of the local maxima, the largest first."""
    inner = np.flatnonzero((ratio[1:-1] >= ratio[:-2]) & (ratio[1:-1] >= ratio[2:])) + 1
    found: NDArray[np.intp] = inner[np.argsort(-ratio[inner])]
    return found


def _starts_at(
    task: _Task, fit: FloatArray, ratio: FloatArray, places: Iterable[float]
) -> list[FloatArray]:
    """The fit with a shaft at each place, its antiresonance at the valley before it or close by."""
    f, starts = task.hertz, []
    for place in places:
        left = (f > 0.3 * place) & (f < 0.98 * place)
        valley = f[left][ratio[left].argmin()] if left.any() else 0.75 * place
        for antiresonance in (valley, 0.75 * place):
            shaft = np.log([2 * math.pi * place, 0.03, 2 * math.pi * antiresonance, 0.03])
            starts += _with_lags(task, fit, np.concatenate([fit[RIGID:], shaft]))
    return starts


def _beyond(task: _Task, rigid: tuple[float, FloatArray, FloatArray]) -> float | None:
    """Frequency of a resonance above the measured range [Hz]; None if there is no evidence.
    Its flank has to explain as much as a resonance within the range.
    """
    found = []
    for factor, ratio in product(BEYOND, (0.6, 0.85)):
        w = 2.0 * math.pi * factor * task.hertz[-1]
        start = np.concatenate([rigid[1], np.log([w, 0.02, ratio * w, 0.02])])
        cost, theta, _ = _solved(task, start)
        wr, zr, wa, za = np.exp(theta[4:])
        above = task.hertz[-1] < wr / (2.0 * math.pi) < FARTHEST / task.Ts
        inertias = RATIOS[0] < (wr / wa) ** 2 - 1.0 < RATIOS[1]
        if above and inertias and max(zr, za) < DAMPED and _is_better(task, cost, rigid[0]):
            found.append((cost, float(wr / (2.0 * math.pi))))
    return min(found, default=(0.0, None))[1]


def _best_shaft(
    task: _Task, starts: list[FloatArray]
) -> tuple[float, FloatArray, FloatArray] | None:
    """The best fit from these starts with plausible shafts; None if there is none."""
    begun = sorted((_solved(task, x, BEGIN) for x in starts), key=lambda s: s[0])
    found = [
        s for s in (_solved(task, x) for _, x, _ in begun[:FINISH]) if _is_shaft(s[1], task.hertz)
    ]
    return min(found, key=lambda s: s[0], default=None)


def _is_shaft(theta: FloatArray, f: FloatArray) -> bool:
    """Whether each pair of zeros and poles is a plausible shaft within the measured range.
    Command and speed belong to the same mass, so antiresonances and resonances alternate. Poles
    next to the zeros of another shaft only describe a line or two that fit badly.
    """
    shafts = _shafts(theta)
    alternate = (shafts[1:, 2] / shafts[:-1, 0]) ** 2 - 1.0 > RATIOS[0]
    return bool(alternate.all()) and all(_is_one(shaft, f) for shaft in shafts)


def _is_one(shaft: FloatArray, f: FloatArray) -> bool:
    wr, zr, wa, za = shaft
    inside = f[0] < wa / (2 * math.pi) and wr / (2 * math.pi) < f[-1]
    shown = (f > wa / (2 * math.pi) / NEAR) & (f < wr / (2 * math.pi) * NEAR)
    inside &= int(shown.sum()) >= SHOWN
    for w in (wa, wr):
        about = np.abs(np.log(f * 2 * math.pi / w)) < math.log(NEAR)
        inside &= int(about.sum()) >= SHOWN // 2
    return bool(inside and RATIOS[0] < (wr / wa) ** 2 - 1.0 < RATIOS[1] and max(zr, za) < DAMPED)


def _is_better(task: _Task, shaft: float, rigid: float) -> bool:
    """Whether the shaft explains clearly more, relative to its own remaining error."""
    freedom = max(2 * len(task.hertz) - RIGID - SHAFT, 1)
    return (rigid - shaft) > CLEAR * shaft / freedom


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
