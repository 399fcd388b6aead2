"""`propose`: gains, and filters for a resonant shaft, from a measured frequency response.

The loop should suppress disturbances up to as high a frequency as a largest sensitivity Ms allows.
The search maximises the bandwidth of the sensitivity, the frequency at which |S| reaches 1/sqrt(2),
over gain, integral and derivative time, lag of the feedback and the filters' frequencies and
dampings. Ms is limited on the fitted machine, which shows whether the loop is stable, and on the
measured lines with their 95 % circles, which include what the fit misses. Above the measured lines
the machine is unknown, and the loop's gain is kept low. No filter, a notch, a biquad with free
zeros and poles, and two of these are tried in turn; a filter that does not pay is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from .. import _core
from ..arrays import FloatArray
from ..control.biquad import Biquad
from ..control.controller import Controller
from ..control.margins import Margins, loop_path, margins, sampled
from ..errors import FitError, SettingError
from ..gains import Gains, real
from ..tables import html_of
from .response import Complex, FrequencyResponse
from .shaft import ShaftFit

MS = 1.7
"""Default largest sensitivity."""
WORTH = 1.05
"""Least bandwidth with a filter, relative to the one without it."""
BLIND = 1.25
"""Safety factor on the loop's gain, from the fit, above the measured lines."""
BESIDE = (0.6, 1.5)
"""Start of a second filter, relative to the first one's frequency; it begins without effect."""
GRID = 100
"""Number of frequencies above the measured lines at which the loop's gain is looked at."""
SPREADS = (0.4, 0.2, 0.1)
"""Sizes of the simplex in a round of the search, each started from the previous best."""
ROUNDS, FURTHER = 4, 1.01
"""Most rounds, and least gain in bandwidth of a round for another one."""
STEPS = 100
"""Evaluations of one round per searched number."""
SAME = 1e-4
"""Difference of best and worst point of a simplex, in log bandwidth, at which it ends."""
OUTSIDE = 30.0
"""Weight of an Ms above the limit, relative to it, against the logarithm of the bandwidth, and of a
peak of |S| above `LEVEL` below it: the bandwidth itself would jump where such a peak arises."""
LEVEL = 0.99 / math.sqrt(2.0)
"""What |S| is to keep below: a little less than its value at the bandwidth."""
SLOWEST = 8.0
"""Largest integral time, in radians of the bandwidth: a slow integral would not remove a lasting
disturbance, however large the bandwidth."""
QUIET = 0.05
"""Largest motion of the command due to the encoder's rounding (rms), relative to its limit."""
DERIVATIVE_FILTER = 10.0
DEPTH, WIDTH, DAMPING = (0.005, 1.0), (0.02, 5.0), (1e-3, 3.0)
"""Least and largest numbers of filters."""
INVERSE = 0.3
"""Initial damping of the poles that the inverse of a shaft puts on its antiresonance."""


@dataclass(frozen=True, eq=False, repr=False)
class Proposal:
    """A controller from a frequency response, and its margins on the fitted machine.
    The loop weakens disturbances by 3 dB or more up to `bandwidth_hertz` [Hz]; `without` is the
    best proposal without filters, if this one has any.
    """

    controller: Controller
    bandwidth_hertz: float
    margins: Margins
    without: Proposal | None = None

    def _repr_html_(self) -> str:
        return html_of(str(self))

    def __repr__(self) -> str:
        return f"<{str(self).splitlines()[0]}>"

    def __str__(self) -> str:
        first = f"disturbances weakened up to {self.bandwidth_hertz:.3g} Hz"
        if self.without is not None:
            what = "filter" if len(self.controller.biquads) == 1 else "filters"
            first += f", without the {what} up to {self.without.bandwidth_hertz:.3g} Hz"
        return "\n".join([first, str(self.margins), str(self.controller)])


def propose(
    fit: ShaftFit,
    *,
    Ms: float = MS,
    notch: bool = True,
    like: Controller | None = None,
    counts_per_rev: float | None = None,
    u_max: float = math.inf,
) -> Proposal:
    """PID gains of the largest bandwidth under a largest sensitivity, with filters if they pay.
    `Ms` holds on the fit and on the measured lines with their bands; `notch` allows a notch, or one
    or two biquads with free zeros and poles. Limits, moving average, encoder and units are those of
    `like`, by default a mean of 4 samples and the encoder of the measured machine. Raises
    `FitError` if no gains are stable within Ms.
    """
    Ms = real("Ms", Ms)
    if not 1.0 < Ms < math.inf:
        raise SettingError(name="Ms", expected="finite and above 1", received=f"{Ms:g}")
    of = fit.response
    if like is None:
        own = of.provenance.get("counts_per_rev")
        if counts_per_rev is None and own is not None:
            counts_per_rev = real("counts_per_rev", own)
        # the encoder is stated, so an output without a unit is the speed from its counts
        known = of.y_unit or ("RPM" if counts_per_rev is not None else "")
        units = {"u_unit": of.u_unit, "y_unit": known}
        like = Controller(
            Gains.standard(1.0, 1.0, 0.0, **units), Ts=of.Ts, filter_samples=4, u_min=-u_max,
            u_max=u_max, counts_per_rev=counts_per_rev,
        )  # fmt: skip
    task = _Task.of(fit, like, Ms)
    plain = _best(task, task.starts(2))
    best = plain
    if notch and fit.has_resonance:
        best = _filtered(task, plain)
    if not math.isfinite(best[0]):
        raise FitError(
            name="Ms", expected=f"gains under which the loop is stable with at most {Ms:g}",
            received="none", remedy="look at the response, or allow a larger Ms",
        )  # fmt: skip
    without = None if best is plain else _proposal(task, plain[1])
    return replace(_proposal(task, best[1]), without=without)


def _filtered(task: _Task, plain: Point) -> Point:
    """The best controller with as few filters as pay."""
    p = {name: found.value for name, found in task.fit.parameters.items()}
    levelled = np.log(task.fit.notch().numbers)
    starts = [plain[1], *task.starts(1)]
    notch = _best(task, [np.concatenate([x, levelled]) for x in starts])
    gains, own = notch[1][:4], np.exp(notch[1][4:])
    # the same notch, and the inverse of the shaft
    same = _freed(*own)
    inverse = np.log([
        p["resonance_hertz"], 2.0 * p["resonance_damping"], p["antiresonance_hertz"], INVERSE,
    ])  # fmt: skip
    one = _best(task, [np.concatenate([gains, x]) for x in (same, inverse)])
    more = [np.log([own[0] * beside, 0.7, own[0] * beside, 0.7]) for beside in BESIDE]
    if task.fit.resonances > 1:
        more.append(_freed(*task.fit.notch(2).numbers))
    two = _best(task, [np.concatenate([one[1], x]) for x in more])
    best = plain
    for found in (notch, one, two):
        if found[0] - best[0] > math.log(WORTH):
            best = found
    return best


def _freed(frequency: float, depth: float, width: float) -> FloatArray:
    """A notch as a biquad with free zeros and poles, in logarithms."""
    found: FloatArray = np.log([frequency, 0.5 * depth * width, frequency, 0.5 * width])
    return found


def _proposal(task: _Task, x: FloatArray) -> Proposal:
    controller = task.controller(x)
    found = margins(controller, task.fit.to_model())
    return Proposal(controller, found.bandwidth / (2.0 * math.pi), found)


@dataclass(frozen=True, eq=False)
class _Task:
    """What the search compares with, and the controller and merit of a search point."""

    fit: ShaftFit
    like: Controller
    Ms: float
    above: Complex
    """The fit above the measured lines."""
    ones: FrequencyResponse
    """Ones there and at the measured lines with enough coherence, to compute feedback."""
    lines: Complex
    circles: FloatArray
    """Measured response at these lines, and the radius of its 95 % circles."""
    model: tuple[FloatArray, FloatArray]
    quiet: float

    @classmethod
    def of(cls, fit: ShaftFit, like: Controller, Ms: float) -> _Task:
        of = fit.response
        of.loop(like)  # raises for another sample time or other units
        model = sampled(fit.to_model(), of.Ts)
        per_unit, reach = like.counts_per_unit, 0.5 * (like.u_max - like.u_min)
        known = per_unit > 0.0 and math.isfinite(reach)
        # a speed is the difference of two roundings of variance 1/12
        quiet = QUIET * reach * math.sqrt(6.0) * per_unit * of.Ts if known else math.inf
        seen = of.coherence > 0.5
        last = of.hertz[seen][-1]
        above = np.geomspace(last, max(last, 0.499 / of.Ts), GRID)
        places = np.concatenate([above, of.hertz[seen]])
        ones = replace(of, hertz=places, value=np.ones(len(places), dtype=np.complex128))
        return cls(
            fit, like, Ms, fit.at(above), ones, of.value[seen], of.radius()[seen], model, quiet
        )

    def controller(self, x: FloatArray) -> Controller:
        """The controller of logarithms of Kp, Ti, Td, the lag, and the filters.
        A notch has frequency, depth and width; each of one or two biquads has frequency and damping
        of the zeros, then of the poles.
        """
        Kp, Ti, Td, lag, *filters = np.exp(np.clip(x, -40.0, 40.0))
        g = self.like.gains
        Ts = self.like.Ts
        gains = Gains.standard(
            float(Kp),
            float(min(max(Ti, Ts), 1e5)),
            _or_none(Td, Ts),
            u_unit=g.u_unit,
            y_unit=g.y_unit,
        )
        biquads: list[Biquad] = []
        low, high = 1e-4 / Ts, 0.49 / Ts
        if len(filters) == 3:
            f, depth, width = filters
            biquads.append(
                Biquad.notch(_within(f, low, high), _within(depth, *DEPTH), _within(width, *WIDTH))
            )
        else:
            for zero, damped, pole, pole_damped in np.reshape(filters, (-1, 4)):
                biquads.append(
                    Biquad.resonance(
                        _within(zero, low, high), _within(damped, *DAMPING),
                        _within(pole, low, high), _within(pole_damped, *DAMPING),
                    )
                )  # fmt: skip
        return replace(
            self.like, gains=gains, alpha=0.0, beta=0.0, N=DERIVATIVE_FILTER,
            filter_time=_or_none(lag, Ts), biquads=tuple(biquads),
            notes="proposed from a frequency response",
        )  # fmt: skip

    def starts(self, count: int) -> list[FloatArray]:
        """Gains for the machine's lag below its first resonance, each a tenth of the previous."""
        p = {name: found.value for name, found in self.fit.parameters.items()}
        K, T = p["gain"], p.get("lag_1", 0.05)
        late = p["delay"] + p.get("lag_2", 0.0) + 3.0 * self.like.Ts
        shares = 0.1 ** np.arange(count)
        return [
            np.log(
                [
                    s * 0.4 * T / (K * late),
                    max(8.0 * late / s, 4.0 * self.like.Ts),
                    max(0.5 * p.get("lag_2", 0.0), 0.2 * self.like.Ts),
                    self.like.Ts,
                ]
            )
            for s in shares
        ]

    def merit(self, x: FloatArray) -> float:
        """Logarithm of the bandwidth, minus a penalty for exceeding Ms; -inf if unstable."""
        try:
            controller = self.controller(x)
        except SettingError:
            return -math.inf
        found = _core.margins(loop_path(controller), *self.model, level=LEVEL)
        if not found["stable"]:
            return -math.inf
        feedback = self.ones.loop(controller)
        above, at_lines = feedback[:GRID], feedback[GRID:]
        worst = max(float(found["Ms"]), self._measured(at_lines), self._unmeasured(above))
        excess = max(0.0, worst / self.Ms - 1.0)
        bandwidth = max(omega / (level / LEVEL) ** OUTSIDE for level, omega in found["levels"])
        slow = controller.gains.Ti * bandwidth / SLOWEST
        noise = float(found["noise_gain"]) / self.quiet
        return (
            math.log(bandwidth) - OUTSIDE * min(excess, 10.0) - max(0.0, math.log(slow))
            - max(0.0, math.log(noise) if noise > 0.0 else 0.0)
        )  # fmt: skip

    def _measured(self, feedback: Complex) -> float:
        """Largest sensitivity at the measured lines, including their 95 % circles."""
        distance = np.abs(1.0 + self.lines * feedback) - self.circles * np.abs(feedback)
        return float(1.0 / np.maximum(distance, 1e-6).min())

    def _unmeasured(self, feedback: Complex) -> float:
        """Largest sensitivity above the measured lines, from the loop's gain alone."""
        gain = float(np.abs(self.above * feedback).max())
        return float(1.0 / (1.0 - min(BLIND * gain, 0.999)))


def _within(value: float, low: float, high: float) -> float:
    return float(min(max(value, low), high))


def _or_none(time: float, Ts: float) -> float:
    """The time, or 0 if it is less than a tenth of a sample."""
    return 0.0 if time < 0.1 * Ts else float(min(time, 100.0 * Ts))


Point: TypeAlias = tuple[float, FloatArray]
"""Point of the search: merit and logarithms of the numbers."""


def _best(task: _Task, starts: list[FloatArray]) -> Point:
    """The best of simplex searches from each start, restarted at their end."""
    found = (-math.inf, starts[0])
    for start in starts:
        x, merit = start, -math.inf
        for _ in range(ROUNDS):
            before = merit
            for spread in SPREADS:
                merit, x = simplex(task.merit, x, spread, STEPS * len(x))
            if not merit - before > math.log(FURTHER):
                break
        if merit > found[0]:
            found = (merit, x)
    within = found[0] > -math.inf and _core.margins(
        loop_path(task.controller(found[1])), *task.model
    )["Ms"] <= task.Ms * (1.0 + 1e-2)
    return found if within else (-math.inf, found[1])


def simplex(
    merit: Callable[[FloatArray], float], start: FloatArray, spread: float, steps: int
) -> tuple[float, FloatArray]:
    """Maximise the merit by the simplex of Nelder and Mead (Computer Journal 7, 1965)."""
    n = len(start)
    points = [start, *(start + spread * row for row in np.eye(n))]
    values = [merit(x) for x in points]
    for _ in range(steps):
        order = np.argsort(values, kind="stable")[::-1]
        points, values = [points[i] for i in order], [values[i] for i in order]
        if values[0] - values[-1] < SAME:
            break
        middle = np.mean(points[:-1], axis=0)
        away = middle - points[-1]
        tried = middle + away
        value = merit(tried)
        if value > values[0]:
            further = merit(middle + 2.0 * away)
            if further > value:
                tried, value = middle + 2.0 * away, further
        elif value <= values[-2]:
            # inside, on the side that is better
            tried = middle + (0.5 if value > values[-1] else -0.5) * away
            value = merit(tried)
            if value <= values[-1]:
                points = [points[0], *(0.5 * (x + points[0]) for x in points[1:])]
                values = [values[0], *(merit(x) for x in points[1:])]
                continue
        points[-1], values[-1] = tried, value
    best = int(np.argmax(values))
    return values[best], points[best]
