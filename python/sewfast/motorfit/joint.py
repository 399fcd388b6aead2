"""A joint: a motor's equations with a position as output, perhaps behind a controller of its own.

A position tells more than a speed (the angle, and so gravity) and less (its noise is that of an
encoder, its free run drifts). So it is fitted as it is, without differences: by output error over
pieces of the record whose initial positions and speeds are fitted with the parameters.

`u` drives the joint, or is a position command to a controller of its own. Of that controller
encoder and command show only ratios: with its gain as the unit, inertia is ``J / kp`` (in commands
per acceleration) and friction the position error that breaks it loose.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray
from ..dataset import Dataset, Experiment
from ..errors import DataError, FitError, SettingError
from ..units import is_position, radians, spelled
from .problem import NOTHING, PARAMETERS, PLACE

JOINT = {name: len(PARAMETERS) + j for j, name in enumerate(_core.GREYBOX_JOINT)}
"""Places of the parameters of a joint."""
PLACES = {**PLACE, **JOINT}
TERMS: dict[str, tuple[str, ...]] = {
    "lag": ("tau",),
    "stribeck": ("k_t", "w_s", "exponent"),
    "gravity": ("load_1c", "load_1s"),
    "loaded": ("k_l", "k_b"),
    "directional": ("k_m", "k_g", "k_b"),
    "quadratic": ("k_mm",),
    "creep": ("creep",),
    "settling": ("settling",),
    "reach": ("reach", "damping"),
    "dead_band": ("dead_band",),
    "rate": ("rate",),
    "backlash": ("play", "load_share", "rub_share"),
    "cogging": ("cogging_c", "cogging_s", "cogging_order"),
}
"""Terms that a joint may have beyond inertia, viscous and dry friction, offset and delay."""
BY_ANGLE = ("gravity", "cogging")
"""Terms without which a longer free run of a joint without a controller goes elsewhere."""
WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Widths of the bells that smooth a start's signals [samples]."""
DELAYS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Delays of a start [samples]."""
NOT_NEGATIVE = {
    "k_e", "k_b", "tau", "delay", "k_s", "k_l", "k_m", "k_g", "k_mm", "creep", "settling",
    "dead_band", "damping", "rub_share",
}  # fmt: skip
POSITIVE = {
    "k_a", "w_s", "reach", "limit", "k_q", "rate", "play", "load_share", "cogging_order",
}  # fmt: skip
EXPONENTS = (0.5, 3.0)
"""Exponents of Stribeck's fall that were measured (Armstrong-Helouvry 1994, Automatica 30)."""
ITERATIONS, ENOUGH = 30, 1.0
FLOOR = 1e-3
"""Least part of a start that a positive parameter keeps."""
RESOLVED = 4.0
"""Integration steps in which the fastest of the dynamics may turn by one radian at most."""
SETTLED = 1e-2
"""Squared distances to the minimum in standard errors, at which a descent and the last one end."""
NEARBY, NEAR = 6, 0.02
"""Starts around the fit, and their relative distance: of 6 MuJoCo joints two had a lower minimum
nearby, with errors of reach and delay a tenth as large (.01 and .08 found the same)."""
WAVES_TRIED, MOST_ORDERS = 2, 400
"""Orders from which a fit of cogging starts, of so many in which smoothed signals are searched."""
GLANCE = 3
"""Iterations of each start of a term; the best start is fitted further."""
DRIFT = 2.0**4
"""Most growth of the squared error over pieces twice as long: a force that is off moves a joint
with the square of time. A run whose error grows by more has gone another way than the joint."""
STARTED, PIECES = 32, 4
"""Pieces over which starts are compared, and those of the last fit, beside which the drift of a
whole record is another error."""
SHORTEST, FIRST = 50, 30
"""Least samples of a piece, and those of its first outputs that give its state. A piece with fewer
measured ones is left out."""
LEAD = 10
"""Samples before a piece whose commands may still act in it. They count as not measured."""
OTHER_UNIT = math.sqrt(180.0 / math.pi)
"""Range of a position over its command's that is nearer to degrees per radian than to 1."""
STOPPED = 0.1
"""Least range of the commands, and how far they go beyond it, relative to all of them, that leave a
joint at one place if that is a stop: friction holds a joint too, but not twice at one count."""
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6}
"""Factor from each unit of a length to m."""
MOST_STEPS = 32
"""Most integration steps per sample."""
STEPS_PER_RADIAN = 100.0
"""Integration steps while the fastest of the dynamics turns by one radian. With 12 a limit of the
controller was seen as a lag besides (benches/joints.py, servos 0, 3 and 5)."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """A fitted joint: its core, the terms that its record shows, and those that it does not.
    `covariance` (n, n) is that of the free parameters, and `determined` (n,) says of which the
    record holds any information; None unless they were asked for.
    """

    core: _core.GreyBox
    terms: tuple[str, ...]
    missing: tuple[str, ...]
    covariance: FloatArray | None = None
    determined: NDArray[np.bool_] | None = None


def is_commanded(data: Dataset) -> bool:
    """Whether the command is a position, for a controller inside: input and output both angles, or
    both lengths, or in one unit.
    """
    given, unit = data.input_units[0], data.output_unit
    both_angles = radians(given) is not None and radians(unit) is not None
    both_lengths = spelled(given) in METRES and spelled(unit) in METRES
    return is_position(unit) and (both_angles or both_lengths or spelled(given) == spelled(unit))


def factor(unit: str) -> float:
    """Factor from a unit to rad or m; 1 for any other."""
    return radians(unit) or METRES.get(spelled(unit), 1.0)


def fitted(
    data: Dataset,
    look: Callable[[], object] = lambda: None,
    *,
    integrates: bool,
    covariance: bool = False,
) -> JointFit:
    """The equations of a joint at the least squares of the position's free run over pieces.
    Without `integrates` the command is that of a controller inside. Raises `DataError` for more
    than one input and `FitError` if no start is a joint.
    """
    if data.n_inputs != 1:
        raise DataError(
            name="inputs", expected="one input, the joint's command",
            received=", ".join(data.input_names), remedy="choose its column",
        )  # fmt: skip
    if not integrates:
        _require_following(data)
    fit = _Fit(data, look)
    found, terms = fit.lengthened(fit.started(integrates))
    found, terms, missing = fit.with_terms(fit.without_delay(found), terms)
    found = fit.settled(found)
    known: tuple[Any, Any] = (None, None)
    if covariance:
        known = fit.covariance(found, terms)
    _require_sign(fit, found.core, integrates)
    return JointFit(found.core, terms, missing, *known)


def _require_following(data: Dataset) -> None:
    """`DataError` for a position that does not follow its command as under a controller: one in
    another unit, before a gear, or at a stop. Their ranges tell a unit, not how they go together:
    a joint that swings, or whose commands are quicker than it is, answers late or not at all.
    """
    given, unit = factor(data.input_units[0]), factor(data.output_unit)
    pairs = [(given * e.u[:, 0], unit * e.y) for e in data.experiments]
    commanded, moved = (np.concatenate(x) for x in zip(*pairs, strict=True))
    span = float(np.ptp(commanded))
    share = float(np.nanmax(moved) - np.nanmin(moved)) / span if span > 0.0 else 1.0
    if not 1.0 / OTHER_UNIT < share < OTHER_UNIT:
        raise DataError(
            name=data.source,
            expected="a position that moves as far as its command, as one does under a controller",
            received=f"one that moves {share:.3g} times as far; 57.3 would be degrees in place "
            "of radians, another number a gear between the two",
            remedy="state the unit of each, and give both on the same side of the gear",
        )  # fmt: skip
    for side in (1.0, -1.0):
        for e, (u, y) in zip(data.experiments, pairs, strict=True):
            if stop := _stop(side * u, side * y):
                first, last, off = stop
                raise DataError(
                    name=data.source, expected="a joint that moves freely",
                    received=f"one at a stop at {e.y[first]:.4g} {data.output_unit}, such as in "
                    f"samples {first} to {last}, where its command goes up to "
                    f"{off / unit:.3g} {data.output_unit} further",
                    remedy="leave out what goes to the stop, or record commands within it",
                )  # fmt: skip


def _require_sign(fit: _Fit, core: _core.GreyBox, integrates: bool) -> None:
    """`DataError` for a position that a mere start explains better than the whole fit does, if the
    command has the other sign.
    """
    data = fit.data
    turned = tuple(replace(e, u=-e.u) for e in data.experiments)
    other = _Fit(replace(data, experiments=turned), fit.look)
    with contextlib.suppress(FitError):
        other.started(integrates, (fit.width,))
    fit.cut(STARTED)
    found = squares(core, fit.pieces, core.first_states(_arrays(fit.pieces)))
    if other.begun < found:
        raise DataError(
            name=data.source, expected="a position that goes where its command sends it",
            received="one that goes the other way", remedy="turn the sign of one of the two",
        )  # fmt: skip


def _stop(u: FloatArray, y: FloatArray) -> tuple[int, int, float] | None:
    """First and last sample of a rest at the largest position, and how far beyond it the command
    goes in such rests; None unless different commands leave the joint at that same place.
    """
    steps = np.abs(np.diff(y))
    band = float(np.min(steps[steps > 0.0], initial=math.inf))
    top = np.nanmax(y)
    edges = np.flatnonzero(np.diff(np.r_[0, (y >= top - band).astype(int), 0]))
    rests = [(a, b) for a, b in edges.reshape(-1, 2) if b - a >= FIRST]
    if not rests:
        return None
    # a command that has just changed still finds the joint there
    low, high = np.quantile(np.concatenate([u[a:b] for a, b in rests]), [0.1, 0.9])
    if min(high - low, high - top) < STOPPED * float(np.ptp(u)):
        return None
    off = [float(np.median(u[a:b])) - top for a, b in rests]
    a, b = rests[int(np.argmax(off))]
    return int(a), int(b) - 1, max(off)


@dataclass(frozen=True, eq=False)
class Descent:
    """The least sum of squares, its core, and the initial states of the pieces there."""

    cost: float
    core: _core.GreyBox
    states: FloatArray


class _Fit:
    """Pieces of a record, and fits of one core to them."""

    def __init__(self, data: Dataset, look: Callable[[], object]) -> None:
        self.data, self.look = data, look
        self.unit, self.command_unit = factor(data.output_unit), factor(data.input_units[0])
        self.is_angle = radians(data.output_unit) is not None
        self.pieces: Sequence[Experiment] = data.experiments
        self.width = WIDTHS[0]
        """Width of the bell with which the start was best."""
        self.begun = math.inf
        """Sum of squares of that start, over short pieces."""
        self.orders: list[float] | None = None
        self.tried = 0
        """Orders of cogging from which those are the best."""
        self.least: dict[str, float] = {}
        """Least inertia: of the start, since bounds relative to each fit would compound."""
        u = np.concatenate([e.u[:, 0] for e in data.experiments])
        # friction that grows faster than the drive would lock a joint that is driven more
        self.most = {"k_l": 1.0, "k_m": 1.0, "k_mm": 0.5 / max(float(np.ptp(u)), 1e-300)}
        """Largest friction per drive, within the range of the commands; and parts of a whole."""
        self.most |= {"load_share": 0.99, "rub_share": 0.99}

    def cut(self, share: int) -> None:
        """Each experiment in as many pieces as belong to it."""
        length = max(len(self.data) / share, SHORTEST)
        self.pieces = [p for e in self.data.experiments for p in _cut(e, length)]
        if not self.pieces:
            measured = sum(int(np.isfinite(e.y).sum()) for e in self.data.experiments)
            raise DataError(
                name=self.data.source,
                expected=f"pieces of {len(self.data) / share:.0f} samples with at least {FIRST} "
                "measured positions", received=f"none, and {measured:,} in all",
                remedy="record more, with fewer gaps",
            )  # fmt: skip

    # --- the start ------------------------------------------------------------------------------

    def started(self, integrates: bool, widths: Sequence[float] = WIDTHS) -> _core.GreyBox:
        """The best of regressions of smoothed signals, by free run over short pieces."""
        self.cut(STARTED)
        best = None
        k_q = 0.0 if integrates else 1.0 / self.command_unit
        for width in widths:
            self.look()
            starts = _core.greybox_regressed(
                _arrays(self.data.experiments), width=width, delays=DELAYS, Ts=self.data.Ts,
                unit=self.unit, k_q=k_q,
            )  # fmt: skip
            for delay, start in zip(DELAYS, starts, strict=True):
                k_v, k_a, k_s, offset = start or 4 * (math.nan,)
                if not (k_a > 0.0 and math.isfinite(k_v)):
                    continue
                known = {
                    "k_e": max(k_v, 0.0), "k_a": k_a, "k_s": max(k_s, 0.0), "offset": offset,
                    "delay": delay * self.data.Ts,
                }  # fmt: skip
                core = self.core(known, k_q, list(known))
                cost = squares(core, self.pieces, core.first_states(_arrays(self.pieces)))
                if cost < self.begun:
                    best, self.begun, self.width = core, cost, width
                    # what turns faster than the integration can follow is not told apart
                    h = RESOLVED * self.data.Ts / core.settings["steps"]
                    self.least = {"k_a": max(FLOOR * k_a, h * (known["k_e"] + h * k_q))}
        if best is None:
            raise FitError(
                name="data", expected="a position that follows its command as a joint does",
                received="one of which no start is a joint",
                remedy="is the output a position, the input what drives it, and no sign turned?",
            )  # fmt: skip
        return best

    def core(self, known: dict[str, float], k_q: float, free: Sequence[str]) -> _core.GreyBox:
        values = NOTHING.copy()
        for name, value in known.items():
            values[PLACE[name]] = value
        own = np.zeros(len(JOINT))
        own[JOINT["k_q"] - len(PARAMETERS)] = k_q
        u = np.concatenate([e.u[:, 0] for e in self.data.experiments])
        y = np.concatenate([e.y for e in self.data.experiments])
        drive = u - k_q * self.unit * y if k_q else u
        speeds = np.concatenate([np.diff(e.y[::4]) for e in self.data.experiments])
        fast = max(known["k_e"] / known["k_a"], math.sqrt(abs(k_q) / known["k_a"]))
        steps = math.ceil(self.data.Ts * fast * STEPS_PER_RADIAN)
        return _core.GreyBox(
            values=values, joint=own.tolist(), position=True,
            free=[PLACES[n] for n in free], Ts=self.data.Ts,
            steps=int(np.clip(steps, 2, MOST_STEPS)), mean=False, unit=self.unit,
            speed_scale=max(float(np.nanstd(speeds)) * self.unit / (4.0 * self.data.Ts), 1e-12),
            command_scale=max(float(np.nanstd(drive)), 1e-12),
            residual_variance=max(1e-6 * float(np.nanvar(y)), 1e-300), process_noise=1e-6,
            theta=np.array([known[n] for n in free]),
        )  # fmt: skip

    # --- the fit --------------------------------------------------------------------------------

    def descended(
        self, core: _core.GreyBox, iterations: int = ITERATIONS, enough: float = ENOUGH
    ) -> Descent:
        """The least squares over the pieces, whose states are fitted with the core."""
        return descended(
            core, core.theta, self.pieces, self.look, iterations, enough=enough, least=self.least,
            most=self.most,
        )  # fmt: skip

    def lengthened(self, core: _core.GreyBox) -> tuple[Descent, tuple[str, ...]]:
        """The fit over the longest pieces on which it holds, and its terms so far.

        Forces by angle are sought over the shortest pieces: without one that is there, a joint goes
        elsewhere in longer ones, and no descent from there comes back. A controller inside brings
        it back.
        """
        self.cut(STARTED)
        found, terms = self.descended(core), tuple[str, ...]()
        if core.settings["integrator"]:
            found, terms, _ = self.with_terms(found, among=BY_ANGLE)
        for share in (16, 8, PIECES):
            shorter = self.pieces
            self.cut(share)
            longer = self._tried(found.core, ITERATIONS)
            if longer is None or longer.cost > DRIFT * found.cost:
                self.pieces = shorter
                break
            found = longer
        return found, terms

    def without_delay(self, found: Descent) -> Descent:
        """The fit, or the one that a descent without a delay finds: stops of dry friction give the
        delay more than one minimum.
        """
        place = found.core.settings["free"].index(PLACE["delay"])
        theta = found.core.theta.copy()
        theta[place] = 0.0
        other = self.descended(changed(found.core, theta=theta))
        return other if other.cost < found.cost else found

    def with_terms(
        self, plain: Descent, terms: Sequence[str] = (), among: Sequence[str] = tuple(TERMS)
    ) -> tuple[Descent, tuple[str, ...], tuple[str, ...]]:
        """The fit with those of the terms that lower the cost by more than their number explains:
        one after the other, the best one first (Schwarz 1978, with the number of samples that the
        residuals' correlation leaves). It has `terms` already.
        """
        own, taken = self.finer(plain), list(terms)
        while found := self._more(own, [t for t in among if t not in taken]):
            term, one = found[0]
            if not self._explains(own, one, term, self.independent(own)):
                break
            own = self.finer(one)
            taken.append(term)
        own = self.descended(own.core)
        # one that another has made superfluous goes again
        for term in (*terms, *taken[len(terms) : -1]):
            fewer = self._tried(_without(own.core, term, taken), ITERATIONS)
            if fewer and not self._explains(fewer, own, term, self.independent(own)):
                own = fewer
                taken.remove(term)
        missing = tuple(t for t in TERMS if t not in taken and self._may_have(t, own.core))
        return own, tuple(t for t in TERMS if t in taken), missing

    def finer(self, own: Descent) -> Descent:
        """The fit in integration steps so short that shorter ones explain no more than a parameter
        does: what coarse ones leave looks like Stribeck's bump, creep or cogging. With a controller
        inside, its dynamics have set them.
        """
        if not own.core.settings["integrator"]:
            return own
        while (steps := 2 * own.core.settings["steps"]) <= MOST_STEPS:
            one = self._tried(changed(own.core, steps=steps), ITERATIONS)
            n = self.independent(own)
            if one is None or own.cost < one.cost * n ** (1.0 / n):
                break
            own = one
        return own

    def _more(self, own: Descent, among: Sequence[str]) -> list[tuple[str, Descent]]:
        """Fits with one more term, the best one first (Schwarz 1978)."""
        n = self.independent(own)

        def schwarz(of: tuple[str, Descent]) -> float:
            return n * math.log(max(of[1].cost, 1e-300)) + self._price(of[0], n)

        found: dict[str, Descent] = {}
        for term in among:
            if not self._may_have(term, own.core):
                continue
            for begun in self._begun(own.core, term):
                if one := self._tried(begun, GLANCE):
                    found[term] = min(found.get(term, one), one, key=lambda f: f.cost)
        best = [(term, f) for term, one in found.items() if (f := self._tried(one.core, 12))]
        return sorted((of for of in best if _holds(of[1].core)), key=schwarz)

    def _tried(self, core: _core.GreyBox, iterations: int) -> Descent | None:
        """A descent; None from where a free run does not stay finite."""
        try:
            return self.descended(core, iterations)
        except (FitError, SettingError):
            return None

    def covariance(self, own: Descent, taken: Sequence[str]) -> tuple[FloatArray, Any]:
        """Covariance of the free parameters, and which of them are determined.

        Beside the fit stand others that the record hardly tells from it: with one more term, or
        integrated in half the steps. Each counts by its Akaike weight, with the number of
        independent samples (unconditional variance: Burnham and Anderson 2002, section 4.3).
        """
        found, determined = own.core.covariance(_arrays(self.pieces), own.states)
        n, p = self.independent(own), len(own.core.theta)
        finer = changed(own.core, steps=2 * own.core.settings["steps"])
        left = [term for term in TERMS if term not in taken]
        others = [(len(TERMS[term]), f) for term, f in self._more(own, left)]
        if one := self._tried(finer, 12):
            others.append((0, one))
        total, apart = 1.0, np.zeros((p, p))
        for more, other in others:
            gain = n * math.log(max(own.cost, 1e-300) / max(other.cost, 1e-300))
            weight = math.exp(min(0.5 * gain - more, 9.0))
            off = other.core.theta[:p] - own.core.theta
            total += weight
            apart += weight * np.outer(off, off)
        return found + apart / total, determined

    def settled(self, found: Descent) -> Descent:
        """The least of descents from around the fit: where dry friction stops and a controller
        reaches its limit the cost has kinks, and a descent ends at one of several minima.
        """
        best = self.descended(found.core, enough=SETTLED)
        rng = np.random.default_rng(0)
        for _ in range(NEARBY):
            start = best.core.theta * (1.0 + NEAR * rng.standard_normal(len(best.core.theta)))
            with contextlib.suppress(FitError, SettingError):
                other = self.descended(changed(best.core, theta=start), enough=SETTLED)
                best = min(best, other, key=lambda f: f.cost)
        return best

    def _explains(self, fewer: Descent, more: Descent, term: str, n: float) -> bool:
        """Whether a term lowers the cost by more than the number of its parameters explains."""
        gain = n * math.log(max(fewer.cost, 1e-300) / max(more.cost, 1e-300))
        return gain >= self._price(term, n)

    def _price(self, term: str, n: float) -> float:
        """What the parameters of a term explain of `n log cost`, and the best of many orders
        (Chen and Chen 2008, Biometrika 95).
        """
        tried = max(self.tried, 1) if term == "cogging" else 1
        return len(TERMS[term]) * math.log(n) + 2.0 * math.log(tried)

    def _may_have(self, term: str, core: _core.GreyBox) -> bool:
        if term == "gravity":
            return self.is_angle
        # behind a controller inside, a lag of the current is a part of the delay
        integrates: bool = core.settings["integrator"]
        only = {"lag": True, "reach": False, "dead_band": False, "rate": False}
        return only.get(term, integrates) == integrates

    def _begun(self, core: _core.GreyBox, term: str) -> Iterator[_core.GreyBox]:
        """Starts of a core with one more term."""
        s = core.settings
        k_s, scale = float(s["values"][PLACE["k_s"]]), s["command_scale"]
        size = max(k_s, 0.02 * scale)
        fast, rmse = s["speed_scale"], s["unit"] * math.sqrt(s["residual_variance"])
        k_q = s["joint"][JOINT["k_q"] - len(PARAMETERS)]
        orders = self._orders(core) if term == "cogging" else []
        starts: dict[str, list[dict[str, float]]] = {
            "lag": [{"tau": s["Ts"]}],
            "stribeck": [
                {"k_t": share * k_s, "w_s": part * fast, "exponent": 1.5}
                for share in (0.3, -0.8)
                for part in (0.01, 0.05, 0.3)
            ],
            "gravity": [{"load_1c": 0.0, "load_1s": 0.0}],
            "loaded": [{"k_l": 0.05, "k_b": 0.0}],
            "directional": [{"k_m": 0.03, "k_g": 0.03, "k_b": 0.0}],
            "quadratic": [{"k_mm": 0.03 / scale}],
            "creep": [{"creep": 0.1 * s["Ts"]}],
            "settling": [{"settling": 0.5 * s["Ts"]}],
            "reach": [{"reach": part * scale, "damping": 0.0} for part in (1.0, 2.0, 3.0)],
            "dead_band": [{"dead_band": part * size} for part in (0.3, 0.8)],
            # without a limit of the rate, the delay has stood for it
            "rate": [{"rate": part * k_q * fast, "delay": 0.0} for part in (1.0, 2.0, 3.0)],
            "backlash": [
                {"play": part * rmse, "load_share": share, "rub_share": rub}
                for part in (1.0, 3.0)
                for share, rub in ((0.1, 0.3), (0.4, 0.6))
            ],
            "cogging": [
                {"cogging_c": 0.0, "cogging_s": 0.0, "cogging_order": order} for order in orders
            ],
        }
        for values in starts[term]:
            more = {PLACES[n]: v for n, v in values.items() if PLACES[n] not in s["free"]}
            theta = np.array([*core.theta, *more.values()])
            if "delay" in values:
                theta[s["free"].index(PLACE["delay"])] = values["delay"]
            yield changed(core, free=[*s["free"], *more], theta=theta)

    def _orders(self, core: _core.GreyBox) -> list[float]:
        """Orders of waves over the position that explain most of what drives, in smoothed signals:
        of those that repeat within the record's range, and not within four of its steps."""
        if self.orders is None:
            s, y = core.settings, [self.unit * e.y for e in self.data.experiments]
            span = float(np.nanmax(np.concatenate(y)) - np.nanmin(np.concatenate(y)))
            steps = np.abs(np.concatenate([np.diff(q) for q in y]))
            step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else span
            first, last = 4.0 * math.pi / span, 2.0 * math.pi / (4.0 * step)
            # creep makes the steps as small as one likes
            wide = min(MOST_ORDERS, (last - first) * span / math.pi)
            tried = first + math.pi / span * np.arange(max(0, math.ceil(wide)))
            left = np.array(
                _core.greybox_waves(
                    _arrays(self.data.experiments), width=self.width,
                    delay=float(s["values"][PLACE["delay"]]) / s["Ts"], Ts=s["Ts"], unit=self.unit,
                    k_q=s["joint"][JOINT["k_q"] - len(PARAMETERS)], orders=tried.tolist(),
                )
            )  # fmt: skip
            self.tried, padded = len(tried), np.pad(left, 1, constant_values=math.inf)
            least = np.flatnonzero((left < padded[:-2]) & (left <= padded[2:]))
            self.orders = tried[least[np.argsort(left[least])][:WAVES_TRIED]].tolist()
        return self.orders

    def independent(self, found: Descent) -> float:
        """Number of samples that are as good as independent, by the residuals' correlation."""
        n: float = found.core.independent(_arrays(self.pieces), found.states)
        return n


def _holds(core: _core.GreyBox) -> bool:
    """Whether the controller can hold the joint's weight at any angle."""
    s = core.settings
    reach = s["joint"][JOINT["reach"] - len(PARAMETERS)]
    turned = s["values"][[PLACE["load_1c"], PLACE["load_1s"]]]
    weight = math.hypot(*turned) + abs(s["values"][PLACE["offset"]])
    return not 0.0 < reach <= weight


def squares(core: _core.GreyBox, pieces: Sequence[Experiment], states: FloatArray) -> float:
    """Weighted squared errors of free runs from these states; infinite if one diverges."""
    total: float = core.squares(_arrays(pieces), np.ascontiguousarray(states))
    return total


def _without(core: _core.GreyBox, term: str, taken: Sequence[str]) -> _core.GreyBox:
    """The core without a term, with the parameters that others of those taken share with it."""
    others = {n for t in taken if t != term for n in TERMS[t]}
    s, gone = core.settings, [PLACES[n] for n in TERMS[term] if n not in others]
    kept = [j for j, place in enumerate(s["free"]) if place not in gone]
    values, own = s["values"].copy(), list(s["joint"])
    for place in gone:
        if place < len(PARAMETERS):
            values[place] = NOTHING[place]
        else:
            own[place - len(PARAMETERS)] = 0.0
    free = [s["free"][j] for j in kept]
    return changed(core, values=values, joint=own, free=free, theta=core.theta[kept])


def descended(
    core: _core.GreyBox,
    start: FloatArray,
    pieces: Sequence[Experiment],
    look: Callable[[], object],
    iterations: int,
    prior: FloatArray | None = None,
    enough: float = ENOUGH,
    least: Mapping[str, float] | None = None,
    most: Mapping[str, float] | None = None,
) -> Descent:
    """The least sum of squares from `start` (p,). The initial speed and position of
    each piece are fitted too. `prior` (p,) are inverse standard deviations about 0, in units of the
    residuals; `least` bounds parameters that would else have a thousandth of their start, `most`
    those that would else have no upper bound.
    """
    names = {place: name for name, place in PLACES.items()}
    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    for j, place in enumerate(core.settings["free"]):
        if names[place] in NOT_NEGATIVE:
            low[j] = 0.0
        elif names[place] == "exponent":
            low[j], high[j] = EXPONENTS
        elif names[place] in POSITIVE:
            low[j] = (least or {}).get(names[place], FLOOR * start[j])
        high[j] = min(high[j], (most or {}).get(names[place], math.inf))
    known = np.zeros(len(start)) if prior is None else prior
    best, cost, states = changed(core, theta=start).descended(
        _arrays(pieces), prior=known, low=low, high=high, enough=enough, iterations=iterations,
        progress=lambda *_: look(),
    )  # fmt: skip
    return Descent(cost, best, states)


def changed(core: _core.GreyBox, **values: Any) -> _core.GreyBox:
    """The core with other settings or parameters."""
    own: dict[str, Any] = {**core.settings, "theta": core.theta, **values}
    return _core.GreyBox(**{k: v for k, v in own.items() if k not in _DERIVED})


_DERIVED = ("nx", "nk", "n_inputs", "integrator", "hidden")


def weights(e: Experiment) -> FloatArray:
    """Square roots of the weights; 0 where nothing was measured."""
    root = np.ones(len(e)) if e.weights is None else np.sqrt(e.weights)
    return np.where(np.isfinite(e.y), root, 0.0)


def _arrays(pieces: Sequence[Experiment]) -> list[tuple[FloatArray, ...]]:
    """Command, position and weights of each piece."""
    return [(e.u, e.y) if e.weights is None else (e.u, e.y, e.weights) for e in pieces]


def _cut(e: Experiment, length: float) -> list[Experiment]:
    """Pieces of about a length, from their first to their last measured output."""
    count = max(1, round(len(e) / length))
    edges = np.linspace(0, len(e), count + 1).round().astype(int)
    pieces = []
    for a, b in itertools.pairwise(edges.tolist()):
        measured = np.flatnonzero(np.isfinite(e.y[a:b]))
        if len(measured) >= min(FIRST, len(e)):
            first = a + int(measured[0])
            lead = min(LEAD, first)
            piece = e.cut(first - lead, a + int(measured[-1]) + 1)
            y = piece.y.copy()
            y[:lead] = np.nan
            pieces.append(replace(piece, y=y))
    return pieces


def pieces_of(data: Dataset) -> Dataset:
    """The data in the pieces of the last fit."""
    length = max(len(data) / PIECES, SHORTEST)
    return replace(data, experiments=tuple(p for e in data.experiments for p in _cut(e, length)))
