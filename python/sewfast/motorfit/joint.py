"""A joint: a motor's equations with a position as output, perhaps behind a controller of its own.

A position tells more than a speed (the angle, and so gravity) and less (its noise is that of an
encoder, its free run drifts). So it is fitted as it is, without differences: by output error over
pieces of the record whose initial positions and speeds are fitted with the parameters.

`u` drives the joint, or is a position command to a controller of its own. Of that controller
encoder and command show only ratios: with its gain as the unit, inertia is ``J / kp`` (in commands
per acceleration) and friction the position error that breaks it loose.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import FloatArray, gram
from ..dataset import Dataset, Experiment
from ..errors import DataError, FitError, SettingError
from ..units import is_position, radians, spelled
from .estimation import SINGULAR, Normal, covariance_of, minimised
from .problem import NOTHING, PARAMETERS, PLACE

JOINT = {name: len(PARAMETERS) + j for j, name in enumerate(_core.GREYBOX_JOINT)}
"""Places of the parameters of a joint."""
PLACES = {**PLACE, **JOINT}
TERMS: dict[str, tuple[str, ...]] = {
    "lag": ("tau",),
    "stribeck": ("k_t", "w_s"),
    "gravity": ("load_1c", "load_1s"),
    "loaded": ("k_l",),
    "reach": ("reach", "damping"),
    "dead_band": ("dead_band",),
}
"""Terms that a joint may have beyond inertia, viscous and dry friction, offset and delay."""
WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Widths of the bells that smooth a start's signals [samples]."""
DELAYS = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Delays of a start [samples]."""
NOT_NEGATIVE = {"k_e", "tau", "delay", "k_s", "k_l", "dead_band", "damping"}
POSITIVE = {"k_a", "w_s", "reach", "limit", "k_q"}
ITERATIONS, ENOUGH = 30, 1.0
LEAK = 1e-3
"""Least part of a parameter in a direction without information, for it to be undetermined."""
PIECES = 4
"""Pieces of the last fit, beside which the drift of a whole record is another error."""
SHORTEST, FIRST = 50, 30
"""Least samples of a piece, and those of its first outputs that give its state. A piece with fewer
measured ones is left out."""
BRIDGED = 3
"""Longest gap that a start interpolates [samples], if its bells are not wider."""
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6}
"""Factor from each unit of a length to m."""
STEPS_PER_RADIAN = 50.0
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


def _factor(unit: str) -> float:
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
    fit = _Fit(data, look)
    core = fit.started(integrates)
    for share in (32, 16, 8, PIECES):
        fit.cut(share)
        found = fit.descended(core)
        core = found.core
    found, terms, missing = fit.with_terms(fit.without_delay(found))
    known = fit.covariance(found) if covariance else (None, None)
    return JointFit(found.core, terms, missing, *known)


@dataclass(frozen=True, eq=False)
class Descent:
    """The least sum of squares, its core, and the initial states of the pieces there."""

    cost: float
    core: _core.GreyBox
    states: Sequence[FloatArray]


class _Fit:
    """Pieces of a record, and fits of one core to them."""

    def __init__(self, data: Dataset, look: Callable[[], object]) -> None:
        self.data, self.look = data, look
        self.unit, self.command_unit = _factor(data.output_unit), _factor(data.input_units[0])
        self.is_angle = radians(data.output_unit) is not None
        self.pieces: Sequence[Experiment] = data.experiments

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

    def started(self, integrates: bool) -> _core.GreyBox:
        """The best of regressions of smoothed signals, by free run over short pieces."""
        self.cut(32)
        best, least = None, math.inf
        k_q = 0.0 if integrates else 1.0 / self.command_unit
        for width in WIDTHS:
            for delay in DELAYS:
                k_v, k_a, k_s, offset = self._regressed(width, delay, k_q)
                if not (k_a > 0.0 and math.isfinite(k_v)):
                    continue
                self.look()
                known = {
                    "k_e": max(k_v, 0.0), "k_a": k_a, "k_s": max(k_s, 0.0), "offset": offset,
                    "delay": delay * self.data.Ts,
                }  # fmt: skip
                core = self.core(known, k_q, list(known))
                cost = squares(core, self.pieces, self.states(core))
                if cost < least:
                    best, least = core, cost
        if best is None:
            raise FitError(
                name="data", expected="a position that follows its command as a joint does",
                received="one of which no start is a joint",
                remedy="is the output a position, and the input what drives it?",
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
            steps=int(np.clip(steps, 2, 32)), mean=False, unit=self.unit,
            speed_scale=max(float(np.nanstd(speeds)) * self.unit / (4.0 * self.data.Ts), 1e-12),
            command_scale=max(float(np.nanstd(drive)), 1e-12),
            residual_variance=max(1e-6 * float(np.nanvar(y)), 1e-300), process_noise=1e-6,
            theta=np.array([known[n] for n in free]),
        )  # fmt: skip

    def _regressed(self, width: float, delay: float, k_q: float) -> FloatArray:
        """Regress what drives on acceleration, speed, its sign and 1."""
        half = math.ceil(3.5 * width)
        k = np.arange(-half, half + 1)
        bell = np.exp(-0.5 * (k / width) ** 2)
        bell /= bell.sum()
        Ts = self.data.Ts
        slope = -k / width**2 * bell / Ts
        bend = (k**2 / width**4 - 1.0 / width**2) * bell
        bend = (bend - bend.sum() * bell) / Ts**2
        rows, drives = [], []
        for e in self.pieces:
            if len(e) <= 2 * half + 4:
                continue
            y, known = _bridged(e.y, max(width, BRIDGED))
            whole = np.convolve(~known, np.ones(len(k)), "valid") < 0.5
            if not whole.any():
                continue
            q = self.unit * y
            at = np.arange(len(e)) - 0.5 - delay
            u = np.interp(at, np.arange(len(e)), e.u[:, 0])
            q_s, v, a = (np.convolve(q, taps, "valid") for taps in (bell, slope, bend))
            clear = whole & (np.abs(v) > 0.05 * max(float(np.abs(v[whole]).max()), 1e-300))
            rows.append(np.stack([v, a, np.sign(v), np.ones_like(v)], axis=1)[clear])
            drives.append((np.convolve(u, bell, "valid") - k_q * q_s)[clear])
        if not rows or sum(map(len, rows)) < 20:
            return np.full(4, math.nan)
        A, b = np.concatenate(rows), np.concatenate(drives)
        scale = np.sqrt(np.einsum("ij,ij->j", A, A))
        scale[scale == 0.0] = 1.0
        found: FloatArray = np.linalg.lstsq(A / scale, b, rcond=None)[0] / scale
        return found

    # --- the fit --------------------------------------------------------------------------------

    def states(self, core: _core.GreyBox) -> list[FloatArray]:
        """Initial states of the pieces, from their first outputs."""
        return [begun(core, p) for p in self.pieces]

    def descended(self, core: _core.GreyBox, iterations: int = ITERATIONS) -> Descent:
        """The least squares over the pieces, whose states are fitted with the core."""
        return descended(core, core.theta, self.pieces, self.look, iterations)

    def without_delay(self, found: Descent) -> Descent:
        """The fit, or the one that a descent without a delay finds: stops of dry friction give the
        delay more than one minimum.
        """
        place = found.core.settings["free"].index(PLACE["delay"])
        theta = found.core.theta.copy()
        theta[place] = 0.0
        other = self.descended(changed(found.core, theta=theta))
        return other if other.cost < found.cost else found

    def with_terms(self, plain: Descent) -> tuple[Descent, tuple[str, ...], tuple[str, ...]]:
        """The fit with those of the terms that lower the cost by more than their number explains:
        one after the other, the one that lowers it most first (Schwarz 1978, with the number of
        samples that the residuals' correlation leaves).
        """
        own, taken = plain, list[str]()
        tried = [t for t in TERMS if self._may_have(t, plain.core)]
        while tried:
            found = []
            for term in tried:
                for begun in self._begun(own.core, term):
                    try:
                        found.append((term, self.descended(begun, 12)))
                    except (FitError, SettingError):
                        continue
            if not found:
                break
            term, one = min(found, key=lambda f: f[1].cost)
            if not self._explains(own, one, term, self.independent(own)):
                break
            own = one
            tried = [t for t in tried if t != term]
            taken.append(term)
        own = self.descended(own.core)
        # one that another has made superfluous goes again
        for term in taken[:-1]:
            try:
                fewer = self.descended(_without(own.core, term))
            except FitError:
                continue
            if not self._explains(fewer, own, term, self.independent(own)):
                own = fewer
                taken.remove(term)
        missing = tuple(t for t in TERMS if t not in taken and self._may_have(t, plain.core))
        return own, tuple(t for t in TERMS if t in taken), missing

    @staticmethod
    def _explains(fewer: Descent, more: Descent, term: str, n: float) -> bool:
        """Whether a term lowers the cost by more than the number of its parameters explains."""
        gain = n * math.log(max(fewer.cost, 1e-300) / max(more.cost, 1e-300))
        return gain >= len(TERMS[term]) * math.log(n)

    def covariance(self, found: Descent) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Covariance of the free parameters, (n, n), with the pieces' states estimated beside them,
        from sums of scores over a window (`covariance_of`); and which of them are determined, (n,).
        """
        core, states, n = found.core, found.states, len(found.core.theta)
        places = [n, n + core.settings["nx"] - 1]
        rows, residuals, lengths = [], [], []
        for i, (p, state) in enumerate(zip(self.pieces, states, strict=True)):
            run, by = core.jacobian(p.u, state)
            w = weights(p)
            own = np.zeros((len(p), n + 2 * len(states)))
            own[:, :n] = w[:, None] * by[:, :n]
            own[:, n + 2 * i : n + 2 * i + 2] = w[:, None] * by[:, places]
            rows.append(own)
            residuals.append(w * (run - np.nan_to_num(p.y)))
            lengths.append(len(p))
        windows = [max(1, min(round(math.sqrt(m)), m // 15)) for m in lengths]
        J = np.concatenate(rows)
        whole = covariance_of(J, np.concatenate(residuals), lengths, windows)
        return whole[:n, :n], _determined(J)[:n]

    def _may_have(self, term: str, core: _core.GreyBox) -> bool:
        if term == "gravity":
            return self.is_angle
        # behind a controller inside, a lag of the current is a part of the delay
        return (term == "lag") == core.settings["integrator"] or term in ("stribeck", "loaded")

    def _begun(self, core: _core.GreyBox, term: str) -> Iterator[_core.GreyBox]:
        """Starts of a core with one more term."""
        s = core.settings
        k_s, scale = float(s["values"][PLACE["k_s"]]), s["command_scale"]
        size = max(k_s, 0.02 * scale)
        fast = s["speed_scale"]
        starts: dict[str, list[dict[str, float]]] = {
            "lag": [{"tau": s["Ts"]}],
            "stribeck": [
                {"k_t": share * k_s, "w_s": part * fast}
                for share in (0.3, -0.8)
                for part in (0.01, 0.05, 0.3)
            ],
            "gravity": [{"load_1c": 0.0, "load_1s": 0.0}],
            "loaded": [{"k_l": 0.05}],
            "reach": [{"reach": part * scale, "damping": 0.0} for part in (1.0, 2.0, 3.0)],
            "dead_band": [{"dead_band": part * size} for part in (0.3, 0.8)],
        }
        for values in starts[term]:
            names = [*s["free"], *(PLACES[n] for n in values)]
            yield changed(core, free=names, theta=np.array([*core.theta, *values.values()]))

    def independent(self, found: Descent) -> float:
        """Number of samples that are as good as independent, by the residuals' correlation."""
        total = spread = 0.0
        for p, state in zip(self.pieces, found.states, strict=True):
            error = weights(p) * np.nan_to_num(found.core.simulate(p.u, state) - p.y)
            power = np.abs(np.fft.rfft(error, 2 * len(error))) ** 2
            r = np.fft.irfft(power)[: len(error) // 4]
            positive = np.flatnonzero(r <= 0.0)
            end = int(positive[0]) if len(positive) else len(r)
            spread += 2.0 * float(r[:end].sum()) - float(r[0])
            total += float(r[0])
        n = sum(int(np.isfinite(p.y).sum()) for p in self.pieces)
        return max(n * total / max(spread, 1e-300), 3.0)


def squares(
    core: _core.GreyBox, experiments: Sequence[Experiment], states: Sequence[FloatArray]
) -> float:
    """Weighted squared errors of free runs from these states; infinite if one diverges."""
    total = 0.0
    try:
        for e, state in zip(experiments, states, strict=True):
            error = weights(e) * (core.simulate(e.u, state) - np.nan_to_num(e.y))
            total += float(error @ error)
    except FitError:
        return math.inf
    return total if math.isfinite(total) else math.inf


def _determined(jacobian: FloatArray) -> NDArray[np.bool_]:
    """Which parameters are in no direction without information, (n,)."""
    d = np.sqrt(np.einsum("ij,ij->j", jacobian, jacobian))
    d[d == 0.0] = 1.0
    size, along = np.linalg.eigh(gram(jacobian / d))
    share = np.sum(along[:, size <= SINGULAR * size[-1]] ** 2, axis=1)
    found: NDArray[np.bool_] = share < LEAK**2
    return found


def _without(core: _core.GreyBox, term: str) -> _core.GreyBox:
    """The core without a term."""
    s, gone = core.settings, [PLACES[n] for n in TERMS[term]]
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
) -> Descent:
    """The least sum of squares from `start` (p,). The initial speed and position of
    each piece are fitted too. `prior` (p,) are inverse standard deviations about 0, in units of the
    residuals.
    """
    p, known = len(start), np.zeros(len(start)) if prior is None else prior
    places = [0, core.settings["nx"] - 1]
    first = changed(core, theta=start)
    starts = [begun(first, e) for e in pieces]
    x0 = np.concatenate([start, *(state[places] for state in starts)])

    def parts(x: FloatArray) -> tuple[_core.GreyBox | None, list[FloatArray]]:
        states = []
        for i, state in enumerate(starts):
            one = state.copy()
            one[places] = x[p + 2 * i : p + 2 * i + 2]
            states.append(one)
        try:
            return changed(core, theta=x[:p]), states
        except SettingError:
            return None, states

    @np.errstate(over="ignore", invalid="ignore")
    def normal(x: FloatArray) -> Normal:
        look()
        own, states = parts(x)
        assert own is not None
        cost = float((known * x[:p]) @ (known * x[:p]))
        slope, total = np.zeros(len(x)), np.zeros((len(x), len(x)))
        slope[:p], total[:p, :p] = known**2 * x[:p], np.diag(known**2)
        for i, (e, state) in enumerate(zip(pieces, states, strict=True)):
            y, rows = own.jacobian(e.u, state)
            w = weights(e)
            error = w * (y - np.nan_to_num(e.y))
            columns = [*range(p), *(p + j for j in places)]
            rows = w[:, None] * rows[:, columns]
            at = np.array([*range(p), p + 2 * i, p + 2 * i + 1])
            cost += float(error @ error)
            slope[at] += rows.T @ error
            total[np.ix_(at, at)] += rows.T @ rows
        if not np.isfinite(total).all():
            raise FitError(
                name="data", expected="a free run that changes with the parameters by finite "
                "amounts", received="infinite ones", remedy="record more moves in both directions",
            )  # fmt: skip
        return cost, slope, total

    def cost(x: FloatArray) -> float:
        look()
        own, states = parts(x)
        if own is None:
            return math.inf
        return float((known * x[:p]) @ (known * x[:p])) + squares(own, pieces, states)

    names = {place: name for name, place in PLACES.items()}
    low = np.full(len(x0), -np.inf)
    for j, place in enumerate(core.settings["free"]):
        if names[place] in NOT_NEGATIVE:
            low[j] = 0.0
        elif names[place] in POSITIVE:
            low[j] = 1e-3 * start[j]
    count = sum(int(np.isfinite(e.y).sum()) for e in pieces)
    bounds = (low, np.full(len(x0), np.inf))
    found = minimised(normal, cost, x0, bounds, count, enough=ENOUGH, iterations=iterations)
    total = sum(float(np.sum(weights(e) ** 2)) for e in pieces)
    variance = max(found.cost / max(total, 1e-300), 1e-300)
    best = changed(core, theta=found.x[:p], residual_variance=variance)
    return Descent(found.cost, best, parts(found.x)[1])


def begun(core: _core.GreyBox, piece: Experiment) -> FloatArray:
    """The state at the beginning of a piece, from its first outputs. They are taken in rad or m:
    what holds the state near them depends on the unit.
    """
    unit, measured = core.settings["unit"], np.flatnonzero(np.isfinite(piece.y))
    n = int(measured[:FIRST][-1]) + 1 if len(measured) else FIRST
    y = unit * piece.y[:n]
    state: FloatArray = changed(core, unit=1.0).estimate_initial_state(piece.u[:n], y)
    state[-1] /= unit
    return state


def changed(core: _core.GreyBox, **values: Any) -> _core.GreyBox:
    """The core with other settings or parameters."""
    own: dict[str, Any] = {**core.settings, "theta": core.theta, **values}
    return _core.GreyBox(**{k: v for k, v in own.items() if k not in _DERIVED})


_DERIVED = ("nx", "nk", "n_inputs", "integrator", "hidden")


def weights(e: Experiment) -> FloatArray:
    """Square roots of the weights; 0 where nothing was measured."""
    root = np.ones(len(e)) if e.weights is None else np.sqrt(e.weights)
    return np.where(np.isfinite(e.y), root, 0.0)


def _bridged(y: FloatArray, longest: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Outputs with interpolated gaps, and where they are measured or in a short gap, both (N,)."""
    at, known = np.arange(len(y)), np.isfinite(y)
    if known.all() or not known.any():
        return np.nan_to_num(y), known
    i = np.searchsorted(at[known], at)
    edges = np.concatenate([[-np.inf], at[known], [np.inf]])
    gap = edges[i + 1] - edges[i] - 1.0
    bridged: FloatArray = np.interp(at, at[known], y[known])
    return bridged, known | (gap <= longest)


def _cut(e: Experiment, length: float) -> list[Experiment]:
    """Pieces of about a length, from their first to their last measured output."""
    count = max(1, round(len(e) / length))
    edges = np.linspace(0, len(e), count + 1).round().astype(int)
    pieces = []
    for a, b in itertools.pairwise(edges.tolist()):
        measured = np.flatnonzero(np.isfinite(e.y[a:b]))
        if len(measured) >= min(FIRST, len(e)):
            pieces.append(e.cut(a + int(measured[0]), a + int(measured[-1]) + 1))
    return pieces


def pieces_of(data: Dataset) -> Dataset:
    """The data in the pieces of the last fit."""
    length = max(len(data) / PIECES, SHORTEST)
    return replace(data, experiments=tuple(p for e in data.experiments for p in _cut(e, length)))
