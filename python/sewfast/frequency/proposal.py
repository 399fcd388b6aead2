"""`propose`: gains, and filters for a resonant shaft, from a measured frequency response.

The loop should suppress disturbances up to as high a frequency as a largest sensitivity Ms allows.
The search, in Rust (`rust/core/src/proposal.rs`), maximises the bandwidth of the sensitivity over
gain, integral and derivative time, lag of the feedback and the filters' frequencies and dampings,
within Ms on the fitted machine and on the measured lines with their 95 % circles. No filter, a
notch, a biquad with free zeros and poles, and two of these are tried in turn; a filter that does
not pay is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from .. import _core
from ..arrays import FloatArray
from ..control.biquad import Biquad
from ..control.controller import Controller
from ..control.margins import Margins, loop_path, margins, sampled
from ..errors import FitError, SettingError
from ..gains import Gains, real
from ..tables import Shown
from .shaft import ShaftFit


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Shown):
    """A controller from a frequency response, and its margins on the fitted machine.
    The loop weakens disturbances by 3 dB or more up to `bandwidth_hertz` [Hz]; `without` is the
    best proposal without filters, if this one has any.
    """

    controller: Controller
    bandwidth_hertz: float
    margins: Margins
    without: Proposal | None = None

    def __str__(self) -> str:
        first = f"disturbances weakened up to {self.bandwidth_hertz:.3g} Hz"
        if self.without is not None:
            what = "filter" if len(self.controller.biquads) == 1 else "filters"
            first += f", without the {what} up to {self.without.bandwidth_hertz:.3g} Hz"
        return "\n".join([first, str(self.margins), str(self.controller)])


def propose(
    fit: ShaftFit,
    *,
    Ms: float = 1.7,
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
    search = _Search(fit, like, Ms)
    plain = search.best(search.starts(2))
    best = plain
    if notch and fit.has_resonance:
        best = _filtered(search, plain)
    if best.merit is None:
        raise FitError(
            name="Ms", expected=f"gains under which the loop is stable with at most {Ms:g}",
            received="none", remedy="look at the response, or allow a larger Ms",
        )  # fmt: skip
    without = None if best is plain else _proposal(fit, plain)
    return replace(_proposal(fit, best), without=without)


def _filtered(search: _Search, plain: _Found) -> _Found:
    """The best controller with as few filters as pay."""
    fit = search.fit
    p = {name: found.value for name, found in fit.parameters.items()}
    levelled = np.log(fit.notch().numbers)
    starts = [plain.x, *search.starts(1)]
    notch = search.best([np.concatenate([x, levelled]) for x in starts])
    gains, own = notch.x[:4], np.exp(notch.x[4:])
    # the same notch, and the inverse of the shaft
    same = _freed(*own)
    # initial damping of the poles that the inverse of a shaft puts on its antiresonance
    inverse = np.log([
        p["resonance_hertz"], 2.0 * p["resonance_damping"], p["antiresonance_hertz"], 0.3,
    ])  # fmt: skip
    one = search.best([np.concatenate([gains, x]) for x in (same, inverse)])
    # start of a second filter, relative to the first one's frequency; it begins without effect
    more = [np.log([own[0] * beside, 0.7, own[0] * beside, 0.7]) for beside in (0.6, 1.5)]
    if fit.resonances > 1:
        more.append(_freed(*fit.notch(2).numbers))
    two = search.best([np.concatenate([one.x, x]) for x in more])
    best = plain
    for found in (notch, one, two):
        # least bandwidth with a filter, relative to the one without it
        if found.log_bandwidth - best.log_bandwidth > math.log(1.05):
            best = found
    return best


def _freed(frequency: float, depth: float, width: float) -> FloatArray:
    """A notch as a biquad with free zeros and poles, in logarithms."""
    found: FloatArray = np.log([frequency, 0.5 * depth * width, frequency, 0.5 * width])
    return found


def _proposal(fit: ShaftFit, found: _Found) -> Proposal:
    its = margins(found.controller, fit.to_model())
    return Proposal(found.controller, its.bandwidth / (2.0 * math.pi), its)


@dataclass(frozen=True, eq=False)
class _Found:
    """The best controller of some starts; without `merit` it is not stable within Ms.
    `x` has the logarithms of Kp, Ti, Td, the lag, and the filters: frequency, depth and width of a
    notch, or frequency and damping of the zeros, then of the poles, of one or two biquads.
    """

    merit: float | None
    x: FloatArray
    controller: Controller

    @property
    def log_bandwidth(self) -> float:
        """Logarithm of the bandwidth, less what exceeds a limit; -inf if not stable within Ms."""
        return -math.inf if self.merit is None else self.merit


class _Search:
    """The search on one machine, in Rust (`sewfast_core::proposal`)."""

    def __init__(self, fit: ShaftFit, like: Controller, Ms: float) -> None:
        # number of frequencies above the measured lines at which the loop's gain is looked at
        grid = 100
        of = fit.response
        of.loop(like)  # raises for another sample time or other units
        per_unit, reach = like.counts_per_unit, 0.5 * (like.u_max - like.u_min)
        known = per_unit > 0.0 and math.isfinite(reach)
        # a speed is the difference of two roundings of variance 1/12
        # largest motion of the command due to the encoder's rounding (rms), relative to its limit
        quiet = 0.05 * reach * math.sqrt(6.0) * per_unit * of.Ts if known else math.inf
        seen = of.coherence > 0.5
        last = of.hertz[seen][-1]
        above = np.geomspace(last, max(last, 0.499 / of.Ts), grid)
        tau = 2.0 * np.pi
        self.fit = fit
        self.like = like
        self._task = _core.ProposalTask(
            loop_path(like), *sampled(fit.to_model(), of.Ts), Ms=Ms, quiet=quiet,
            lines=(tau * of.hertz[seen], of.value[seen], of.radius()[seen], of.from_counts),
            above=(tau * above, fit.at(above), np.zeros(grid), of.from_counts),
        )  # fmt: skip

    def best(self, starts: list[FloatArray]) -> _Found:
        """The best of simplex searches from each start."""
        merit, x, ((Kp, Ti, Td, N), lag, filters) = self._task.best(starts)
        g = self.like.gains
        controller = replace(
            self.like, gains=Gains.standard(Kp, Ti, Td, u_unit=g.u_unit, y_unit=g.y_unit),
            alpha=0.0, beta=0.0, N=N, filter_time=lag, biquads=tuple(
                Biquad.notch(*f) if len(f) == 3 else Biquad.resonance(*f) for f in filters
            ), notes="proposed from a frequency response",
        )  # fmt: skip
        return _Found(merit, x, controller)

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
