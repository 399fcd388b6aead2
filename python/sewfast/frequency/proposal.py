"""`propose`: gains, and notches where a shaft swings, for a machine that was shaken.

The loop is to fight disturbances down to as high a frequency as a largest sensitivity allows:
maximised is the bandwidth of the sensitivity, the frequency at which |S| comes to 1/sqrt(2), over
gain, integral and derivative time, lag of the feedback and, with a notch, its frequency, depth and
width. Ms is held to on the fitted machine, which says whether the loop is stable, and on the
measured lines with their 95 % circles, which know what the fit does not. The same without a notch
is always tried: one that is not worth it is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .. import _core
from ..arrays import FloatArray
from ..control.biquad import Biquad
from ..control.controller import Controller
from ..control.margins import Margins, loop_path, margins, sampled
from ..errors import FitError, SettingError
from ..gains import Gains, real
from ..tables import html_of
from .response import Complex
from .shaft import ShaftFit

MS = 1.7
"""Largest sensitivity unless another is asked for."""
WORTH = 1.05
"""Times the bandwidth without it, that a notch has to bring."""
GRID = 400
"""Frequencies at which the bandwidth is looked for."""
ROUNDS = 3
"""Of the search, each from the best of the one before."""
STEPS = 220
"""Of one round."""
OUTSIDE = 30.0
"""Weight of an Ms above the limit, relative to it, against the logarithm of the bandwidth."""
SLOWEST = 8.0
"""Integral time, in radians of the bandwidth: without an integral that is fast enough a disturbance
that stays is not fought down, whatever the bandwidth."""
QUIET = 0.05
"""Of the command's limit, that the encoder's rounding may move it by (rms)."""
DERIVATIVE_FILTER = 10.0
HALF = 1.0 / math.sqrt(2.0)


@dataclass(frozen=True, eq=False, repr=False)
class Proposal:
    """A controller for a machine that was shaken, and what it does on the fit.

    Attributes
    ----------
    controller : Controller
    bandwidth_hertz : float
        To which the loop weakens disturbances by 3 dB and more [Hz].
    margins : Margins
        On the fitted machine.
    without : Proposal or None
        The best without a notch, where there is one.
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
            first += f", without the notch up to {self.without.bandwidth_hertz:.3g} Hz"
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
    """PID gains of the largest bandwidth under a largest sensitivity, with a notch if that pays.

    Parameters
    ----------
    fit : ShaftFit
        Of the machine, rigid or with a shaft.
    Ms : float
        Largest sensitivity, on the fit and on the measured lines with their bands.
    notch : bool
        Whether a notch may be used.
    like : Controller, optional
        Limits, moving average, encoder and units of this one; by default a mean of 4 samples.
    counts_per_rev, u_max : float, optional
        Encoder and limit of the command, without `like`; the encoder by default that of the machine
        that was shaken.

    Returns
    -------
    Proposal

    Raises
    ------
    SettingError
        For an Ms not above 1, or a controller at another sample time.
    FitError
        Where no gains are stable within Ms.
    """
    Ms = real("Ms", Ms)
    if not 1.0 < Ms < math.inf:
        raise SettingError(name="Ms", expected="finite and above 1", received=f"{Ms:g}")
    of = fit.response
    if like is None:
        own = of.provenance.get("counts_per_rev")
        if counts_per_rev is None and own is not None:
            counts_per_rev = real("counts_per_rev", own)
        units = {"u_unit": of.u_unit or "V", "y_unit": of.y_unit or "RPM"}
        like = Controller(
            Gains.standard(1.0, 1.0, 0.0, **units), Ts=of.Ts, filter_samples=4, u_min=-u_max,
            u_max=u_max, counts_per_rev=counts_per_rev,
        )  # fmt: skip
    task = _Task.of(fit, like, Ms)
    plain = _best(task, task.starts(2))
    best = plain
    if notch and fit.has_resonance:
        levelled = np.log(fit.notch().numbers)
        starts = [plain[1], *task.starts(1)]
        found = _best(task, [np.concatenate([x, levelled]) for x in starts])
        best = found if found[0] - plain[0] > math.log(WORTH) else plain
    if not math.isfinite(best[0]):
        raise FitError(
            name="Ms", expected=f"gains under which the loop is stable with at most {Ms:g}",
            received="none", remedy="look at the response, or allow a larger Ms",
        )  # fmt: skip
    without = None if best is plain else _proposal(task, plain[1])
    return replace(_proposal(task, best[1]), without=without)


def _proposal(task: _Task, x: FloatArray) -> Proposal:
    controller = task.controller(x)
    return Proposal(
        controller, task.bandwidth(controller), margins(controller, task.fit.to_model())
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Task:
    """The fit on a dense grid, and what a point of the search stands for."""

    fit: ShaftFit
    like: Controller
    Ms: float
    hertz: FloatArray
    plant: Complex
    model: tuple[FloatArray, FloatArray]
    quiet: float

    @classmethod
    def of(cls, fit: ShaftFit, like: Controller, Ms: float) -> _Task:
        of = fit.response
        hertz = np.geomspace(0.05 * of.hertz[0], 0.499 / of.Ts, GRID)
        of.loop(like)  # refuses another sample time and other units
        model = sampled(fit.to_model(), of.Ts)
        per_unit, reach = like.counts_per_unit, 0.5 * (like.u_max - like.u_min)
        known = per_unit > 0.0 and math.isfinite(reach)
        # a speed is the difference of two roundings of variance 1/12
        quiet = QUIET * reach * math.sqrt(6.0) * per_unit * of.Ts if known else math.inf
        return cls(fit, like, Ms, hertz, fit.at(hertz), model, quiet)

    def controller(self, x: FloatArray) -> Controller:
        """From logarithms of Kp, Ti, Td, the lag, and frequency, depth, width of a notch."""
        Kp, Ti, Td, lag, *notch = np.exp(np.clip(x, -40.0, 40.0))
        g = self.like.gains
        Ts = self.like.Ts
        gains = Gains.standard(
            float(Kp),
            float(min(max(Ti, Ts), 1e5)),
            _or_none(Td, Ts),
            u_unit=g.u_unit,
            y_unit=g.y_unit,
        )
        biquads: tuple[Biquad, ...] = ()
        if notch:
            f, depth, width = notch
            biquads = (
                Biquad.notch(
                    float(min(max(f, 0.01 / Ts / 100), 0.49 / Ts)),
                    float(min(max(depth, 0.005), 1.0)), float(min(max(width, 0.02), 5.0)),
                ),
            )  # fmt: skip
        return replace(
            self.like, gains=gains, alpha=0.0, beta=0.0, N=DERIVATIVE_FILTER,
            filter_time=_or_none(lag, Ts), biquads=biquads,
            notes="proposed from a frequency response",
        )  # fmt: skip

    def starts(self, count: int) -> list[FloatArray]:
        """Gains for the lag that the machine shows below its first swing, each a tenth of those
        before.
        """
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

    def bandwidth(self, controller: Controller) -> float:
        """Where |S| first comes to 1/sqrt(2) [Hz]."""
        S = 1.0 / np.abs(1.0 + self.plant * self._feedback(controller, self.hertz))
        above = np.flatnonzero(S >= HALF)
        if not len(above) or above[0] == 0:
            return float(self.hertz[0 if len(above) else -1])
        k = int(above[0])
        share = math.log(HALF / S[k - 1]) / math.log(S[k] / S[k - 1])
        return float(self.hertz[k - 1] * (self.hertz[k] / self.hertz[k - 1]) ** share)

    def _feedback(self, controller: Controller, hertz: FloatArray) -> Complex:
        of = replace(
            self.fit.response, hertz=hertz, value=np.ones(len(hertz), dtype=np.complex128)
        )  # fmt: skip
        return of.loop(controller)

    def merit(self, x: FloatArray) -> float:
        """Logarithm of the bandwidth, less what an Ms beyond the limit costs; -inf if unstable."""
        try:
            controller = self.controller(x)
        except SettingError:
            return -math.inf
        found = _core.margins(loop_path(controller), *self.model)
        if not found["stable"]:
            return -math.inf
        worst = max(float(found["Ms"]), self._measured(controller))
        excess = max(0.0, worst / self.Ms - 1.0)
        bandwidth = self.bandwidth(controller)
        slow = controller.gains.Ti * 2.0 * math.pi * bandwidth / SLOWEST
        noise = float(found["noise_gain"]) / self.quiet
        return (
            math.log(bandwidth) - OUTSIDE * min(excess, 10.0) - max(0.0, math.log(slow))
            - max(0.0, math.log(noise) if noise > 0.0 else 0.0)
        )  # fmt: skip

    def _measured(self, controller: Controller) -> float:
        """The largest sensitivity that the measured lines allow, their 95 % circles included."""
        of = self.fit.response
        feedback, seen = self._feedback(controller, of.hertz), of.coherence > 0.5
        distance = np.abs(1.0 + of.value * feedback) - of.radius() * np.abs(feedback)
        return float(1.0 / np.maximum(distance[seen], 1e-6).min())


def _or_none(time: float, Ts: float) -> float:
    """A time of less than a tenth of a sample is none."""
    return 0.0 if time < 0.1 * Ts else float(min(time, 100.0 * Ts))


def _best(task: _Task, starts: list[FloatArray]) -> tuple[float, FloatArray]:
    """The best of a simplex search from each start, begun again at its end."""
    found = (-math.inf, starts[0])
    for start in starts:
        x, spread = start, 0.4
        for _ in range(ROUNDS):
            merit, x = simplex(task.merit, x, spread, STEPS)
            spread *= 0.5
            if merit > found[0]:
                found = (merit, x)
    within = found[0] > -math.inf and _core.margins(
        loop_path(task.controller(found[1])), *task.model
    )["Ms"] <= task.Ms * (1.0 + 1e-2)
    return found if within else (-math.inf, found[1])


def simplex(
    merit: Callable[[FloatArray], float], start: FloatArray, spread: float, steps: int
) -> tuple[float, FloatArray]:
    """The largest merit by the simplex of Nelder and Mead (Computer Journal 7, 1965)."""
    n = len(start)
    points = [start, *(start + spread * row for row in np.eye(n))]
    values = [merit(x) for x in points]
    for _ in range(steps):
        order = np.argsort(values, kind="stable")[::-1]
        points, values = [points[i] for i in order], [values[i] for i in order]
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
