"""A motor's least-squares problem: free parameters, whitened residuals of a record, the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .. import _core
from ..arrays import FloatArray, gram
from ..errors import SettingError
from .estimation import Normal, covariance_of, filtered, inverse, minimised, whitener
from .records import Records, spikes_of

PARAMETERS = tuple(_core.GREYBOX_PARAMETERS)
PLACE = {name: j for j, name in enumerate(PARAMETERS)}

TERMS: dict[str, tuple[str, ...]] = {
    "lag": ("tau",),
    "delay": ("delay",),
    "coulomb": ("k_s",),
    "offset": ("offset",),
    "drop": ("drop", "ripple"),
    "stribeck": ("k_t", "w_s"),
    "load_1": ("load_1c", "load_1s"),
    "load_2": ("load_2c", "load_2s"),
    "inertia_2": ("inertia_2c", "inertia_2s"),
    "limit": ("limit",),
    "stribeck_difference": ("k_d",),
    "sag": ("sag",),
    "eccentricity": ("eccentric_c", "eccentric_s"),
    "cogging_1": ("cogging_1c", "cogging_1s"),
    "cogging_2": ("cogging_2c", "cogging_2s"),
    "cogging_3": ("cogging_3c", "cogging_3s"),
    "torque_ripple": ("torque_ripple_c", "torque_ripple_s"),
}
"""Terms of a motor besides back-EMF and inertia, and the parameters of each."""
WAVES = ("cogging_1", "cogging_2", "cogging_3", "torque_ripple")
"""Terms whose orders per turn are found from the record, as listed in `State.orders`."""
OPTIONAL = ("stribeck_difference", "sag", "eccentricity")
"""Terms that few motors have, and each of which makes the others less certain: they are fitted if
requested, or if they stand out clearly."""
VISCOUS, VISCOUS_SPREAD = 0.05, 0.15
"""Prior mean and standard deviation of viscous friction, relative to k_v, if no current separates
it from back-EMF. Assuming none would be too certain: its current acts on the dead zone, and dry
friction would compensate for it. On 36 machines with 1 to 32 % of it, intervals of k_v, k_a and k_s
contained the truth 102 times of 108; with a standard deviation of .05, 90 times.
"""
ITERATIONS = 40
COARSE, NEAR, FINE = 1.0, 0.1, 0.01
"""Squared distances to the minimum in standard errors: for intermediate fits, tests, results."""
QUASISTATIC = 0.05
"""Least standard deviation of the accelerating part of the command, relative to the whole, to show
k_a. Of 60 slow ramps, sines and triangles one interval, at .003, was off by 87 % of the truth;
those at .01 to .05 were at least two thirds of it wide; from .05 on 43 of 46 contained it, the
others were off by .6 %.
"""
PER_TIME_CONSTANT = 50.0
"""Integration step (second order) relative to the time constant: an error of 1/15,000 of it."""
QUICKEST = 1.0 / 16.0
"""Shortest time constant that a record can show, in samples."""
STARTS = 5
"""Most steps for estimating the initial speeds: dry friction makes the problem nonlinear if a start
is on the wrong side of a standstill."""
AMMETER = 1e-3
"""Least error of the current and of its scale, relative to its root mean square. A simulator's
current has none, and its residuals at reversals would then outweigh all speeds."""
TIMING = 0.01
"""Standard deviation, in samples, of the instant at which a command begins to act, which no
residual shows. It affects delay and time constants, for a motor without noise more than all else.
"""
WHITE = 12
"""Order of the autoregression that models the residual's colour."""


@dataclass(frozen=True)
class State:
    """Values of all parameters, and which of them are free."""

    theta: FloatArray
    resistance: float | None
    terms: tuple[str, ...]
    orders: tuple[int, ...] = (0,) * len(WAVES)
    """Order per turn of each of `WAVES`; 0 for none."""

    def names(self) -> list[str]:
        free = ["k_e", "k_a", "k_b", *(["R"] if self.resistance is not None else [])]
        return free + [p for t in self.terms for p in TERMS[t]]

    def vector(self) -> FloatArray:
        return np.array([self.value(n) for n in self.names()])

    def value(self, name: str) -> float:
        if name == "R":
            assert self.resistance is not None
            return self.resistance
        return float(self.theta[PLACE[name]])

    def at(self, x: FloatArray) -> State:
        theta, resistance = self.theta.copy(), self.resistance
        for name, value in zip(self.names(), x, strict=True):
            if name == "R":
                resistance = float(value)
            else:
                theta[PLACE[name]] = value
        return replace(self, theta=theta, resistance=resistance)

    def having(self, terms: Sequence[str], **values: float) -> State:
        """The state with other terms; parameters of dropped terms are set to 0."""
        theta = self.theta.copy()
        for t in set(self.terms) - set(terms):
            for p in TERMS[t]:
                theta[PLACE[p]] = NOTHING[PLACE[p]]
        for name, value in values.items():
            theta[PLACE[name]] = value
        return replace(self, theta=theta, terms=tuple(t for t in TERMS if t in terms))


NOTHING = np.array(
    [{"ripple": 1.0, "w_s": 1.0, "k_a": 1.0, "limit": math.inf}.get(p, 0.0) for p in PARAMETERS]
)
_POSITIVE = {"k_a", "limit", "R"}
_NOT_NEGATIVE = {"tau", "delay", "k_s", "k_t", "drop"}


@dataclass
class Problem:
    """The records, and the filters that weigh residuals of speeds [rad/s] and currents [A]."""

    records: Records
    steps: int = 2
    converged: bool = False
    spikes: int = 0
    k_v: float = math.nan
    """k_v of the start: the scale of the prior of viscous friction."""
    look: Callable[[], object] = lambda: None
    """Called before every simulation; an exception of it ends the fit."""
    speed_filter: FloatArray = field(default_factory=lambda: np.ones(1))
    current_filter: FloatArray = field(default_factory=lambda: np.ones(1))

    @property
    def has_current(self) -> bool:
        return self.records.pieces[0].current is not None

    def without_currents(self) -> Problem:
        """The same problem with the speeds alone, unweighted."""
        pieces = tuple(replace(p, current=None) for p in self.records.pieces)
        return Problem(replace(self.records, pieces=pieces), self.steps, look=self.look)

    def simulated(self, state: State, free: Sequence[str]) -> list[tuple[FloatArray, ...]]:
        """Speed, drive and their derivatives for each piece."""
        places = [PLACE[n] for n in free]
        r = self.records
        return [
            _core.greybox_run(
                state.theta, places, p.u, Ts=r.Ts, steps=self.steps, speed=p.speed, mean=r.mean,
                angle=p.angle, orders=state.orders,
            )
            for p in r.pieces
        ]  # fmt: skip

    def residuals(self, state: State) -> FloatArray:
        """Simulated minus measured values, whitened; speeds and then currents of each piece."""
        found = []
        for p, (y, drive, _, _) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            found.append(filtered(y - p.y, p.used, self.speed_filter))
            if p.current is not None:
                assert state.resistance is not None
                off = drive / state.resistance - p.current
                found.append(filtered(off, p.used, self.current_filter))
        return np.concatenate(found)

    def jacobian(self, state: State) -> FloatArray:
        names = state.names()
        inner = [n for n in names if n != "R"]
        columns = [names.index(n) for n in inner]
        found = []
        for p, (_, drive, y_by, drive_by) in zip(
            self.records.pieces, self.simulated(state, inner), strict=True
        ):
            rows = np.zeros((len(names), len(p.u)))
            rows[columns] = y_by.T
            found.append(filtered(rows, p.used, self.speed_filter).T)
            if p.current is not None:
                assert state.resistance is not None
                R = state.resistance
                rows = np.zeros((len(names), len(p.u)))
                rows[columns] = drive_by.T / R
                rows[names.index("R")] = -drive / (R * R)
                found.append(filtered(rows, p.used, self.current_filter).T)
        return np.concatenate(found)

    def normal(self, state: State) -> Normal:
        """Cost, gradient and Gram matrix of the whitened residuals."""
        names = state.names()
        inner = [n for n in names if n != "R"]
        cost, gradient, matrix = self._summed(state, inner)
        if "R" in names:  # the core has it last
            order = [*inner, "R"]
            at = [order.index(n) for n in names]
            gradient, matrix = gradient[at], matrix[np.ix_(at, at)]
        off, by, curvature = self._expected(state)
        return cost + off, gradient + by, matrix + curvature

    def _expected(self, state: State) -> Normal:
        """The prior of viscous friction, as an additional squared residual."""
        names = state.names()
        by, curvature = np.zeros(len(names)), np.zeros((len(names), len(names)))
        if self.has_current or not math.isfinite(self.k_v):
            return 0.0, by, curvature
        at, scale = names.index("k_b"), VISCOUS_SPREAD * self.k_v
        off = (state.value("k_b") - VISCOUS * self.k_v) / scale
        by[at], curvature[at, at] = off / scale, 1.0 / scale**2
        return off**2, by, curvature

    def cost(self, state: State) -> float:
        """Cost of the whitened residuals; infinite if the simulation fails."""
        try:
            cost, _, _ = self._summed(state, ())
        except SettingError:
            return math.inf
        cost += self._expected(state)[0]
        return cost if math.isfinite(cost) else math.inf

    def _summed(self, state: State, free: Sequence[str]) -> Normal:
        self.look()
        places, r = [PLACE[n] for n in free], self.records
        cost, gradient, matrix = 0.0, np.zeros(0), np.zeros((0, 0))
        for p in r.pieces:
            current = None
            if p.current is not None:
                assert state.resistance is not None
                current = (p.current, self.current_filter, state.resistance)
            one, slope, gram = _core.greybox_normal(
                state.theta, places, p.u, p.y, p.used, Ts=r.Ts, steps=self.steps,
                filter=self.speed_filter, speed=p.speed, mean=r.mean, angle=p.angle,
                orders=state.orders, current=current,
            )  # fmt: skip
            cost += one
            gradient = slope + (gradient if gradient.size else 0.0)
            matrix = gram + (matrix if matrix.size else 0.0)
        return cost, gradient, matrix

    @property
    def count(self) -> int:
        return self.records.used * (2 if self.has_current else 1)

    def outcome(self, state: State) -> tuple[FloatArray, ...]:
        """Measured and simulated speed [rad/s] of the samples used, and their free-run error."""
        ys, models = [], []
        for p, (y, *_) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            ys.append(p.y[p.used])
            models.append(y[p.used])
        return np.concatenate(ys), np.concatenate(models)

    def rmse(self, state: State) -> float:
        """Root mean square error of the free run's speed [rad/s]."""
        y, model = self.outcome(state)
        return float(np.sqrt(np.mean((y - model) ** 2)))

    def weigh(self, state: State, order: int = WHITE) -> None:
        """Set the filters that whiten the residuals of this fit, to variance 1.
        Encoder steps in a difference of counts cancel from sample to sample, while an unmodelled
        load lasts for many: each has its colour, and receives the proper weight.
        """
        speeds, currents, known = [], [], []
        for p, (y, drive, _, _) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            speeds.append(np.where(p.used, y - p.y, 0.0))
            if p.current is not None:
                assert state.resistance is not None
                currents.append(np.where(p.used, drive / state.resistance - p.current, 0.0))
                known.append(p.current[p.used])
        self.speed_filter = whitener(speeds, order)
        if currents:
            size = float(np.sqrt(np.mean(np.concatenate(known) ** 2)))
            best = 1.0 / max(AMMETER * size, 1e-300)
            self.current_filter = np.minimum(whitener(currents, 0), best)

    def leave_out_spikes(self, state: State) -> None:
        """Leave out samples with errors far from those of their neighbours, as a fit shows them."""
        for p, (y, *_) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            used = np.flatnonzero(p.used)
            far = used[spikes_of((y - p.y)[used], self.records.quantum)]
            p.used[far] = False
            self.spikes += len(far)

    def settle_starts(self, state: State) -> None:
        """Estimate the pieces' initial speeds by least squares together with the free parameters.
        A line through the first samples is only a first guess if the motor is fast compared with
        the sampling, or the record noisy.
        """
        for _ in range(STARTS):
            columns, moving = self._starts(state)
            if not moving:
                return
            J = np.concatenate([self.jacobian(state), columns], axis=1)
            matrix, slope, n = gram(J), J.T @ self.residuals(state), len(state.names())
            _, by, curvature = self._expected(state)
            matrix[:n, :n] += curvature
            slope[:n] += by
            step = -(inverse(matrix)[0] @ slope)[-len(moving) :]
            before, cost = self.records, self.cost(state)
            pieces = list(before.pieces)
            for j, change in zip(moving, step, strict=True):
                pieces[j] = replace(pieces[j], speed=pieces[j].speed + float(change))
            self.records = replace(before, pieces=tuple(pieces))
            if not self.cost(state) < cost:
                self.records = before
                return

    def _starts(self, state: State) -> tuple[FloatArray, list[int]]:
        """Derivatives of the residuals by the initial speeds of pieces that begin in motion.
        They decay with the motor's time constant; a piece that begins at standstill is held there
        by dry friction.
        """
        T = state.theta[PLACE["k_a"]] / max(state.theta[0] + state.theta[1], 1e-12)
        pieces = self.records.pieces
        moving = [j for j, p in enumerate(pieces) if p.speed != 0.0]
        found = []
        for j, p in enumerate(pieces):
            rows = np.zeros((len(moving), len(p.u)))
            if j in moving:
                rows[moving.index(j)] = np.exp(-np.arange(len(p.u)) * self.records.Ts / T)
            found.append(filtered(rows, p.used, self.speed_filter).T)
            if p.current is not None:
                found.append(np.zeros((len(p.u), len(moving))))
        return np.concatenate(found), moving

    def is_slow(self, state: State) -> bool:
        """Whether the accelerating command hardly changes: a ramp's looks like dry friction."""
        rates = [np.diff(y) / self.records.Ts for y, *_ in self.simulated(state, ())]
        u = np.concatenate([p.u for p in self.records.pieces])
        effort = state.value("k_a") * float(np.std(np.concatenate(rates)))
        return bool(effort < QUASISTATIC * float(np.std(u)))

    def parts_sides(self, w_s: float) -> bool:
        """Whether friction that falls off over this speed [rad/s] can be told apart by direction.
        At lower speeds there are no samples; at higher ones the difference is a constant load.
        """
        least, usual = self.stribeck_speeds()
        return max(2.0 * least, self.records.quantum) <= w_s <= 0.3 * usual

    def stribeck_speeds(self) -> tuple[float, float]:
        """Range of the speed over which friction can fall off; below it there are few samples."""
        usual = float(np.quantile(np.abs(np.concatenate([p.y for p in self.records.pieces])), 0.9))
        return 0.01 * usual, usual

    def ripples(self) -> tuple[float, float]:
        """Range of the command over which the drop can rise; over all of it, it is a resistance."""
        usual = float(np.quantile(np.abs(np.concatenate([p.u for p in self.records.pieces])), 0.9))
        return 0.001 * usual, 0.1 * usual

    def settle_steps(self, state: State) -> None:
        """Choose integration steps for the estimated time constant; the lag is solved exactly."""
        k_v = max(state.theta[0] + state.theta[1], 1e-12)
        fastest = min(self.records.Ts / 2.0, state.theta[PLACE["k_a"]] / k_v / PER_TIME_CONSTANT)
        self.steps = int(np.clip(math.ceil(self.records.Ts / max(fastest, 1e-12)), 2, 64))

    def covariance(self, state: State) -> FloatArray:
        """Covariance of the estimate, (n, n), including the estimation of the initial speeds.
        It is computed from sums of scores over a window, plus the inexactness of clocks and
        integration steps within a sample.
        """
        n, J = len(state.names()), [self.jacobian(state), self._starts(state)[0]]
        k_v = max(state.theta[0] + state.theta[1], 1e-12)
        lengths = [len(p.u) for p in self.records.pieces]
        whole = covariance_of(
            np.concatenate(J, axis=1), self.residuals(state), lengths,
            channels=2 if self.has_current else 1, known=self._expected(state)[2],
        )  # fmt: skip
        timing = (TIMING * self.records.Ts) ** 2
        for name, size in (("k_a", k_v), ("delay", 1.0), ("tau", 1.0)):
            if name in state.names():
                at = state.names().index(name)
                whole[at, at] += size**2 * timing
        if state.resistance is not None:
            at = state.names().index("R")
            whole[at, at] += (AMMETER * state.resistance) ** 2
        return whole[:n, :n]

    # --- the fit --------------------------------------------------------------------------------

    def fitted(self, state: State, enough: float = COARSE) -> State:
        """The state at the least-squares solution for its free parameters."""
        low, high = self.bounds(state)
        found = minimised(
            lambda x: self.normal(state.at(x)),
            lambda x: self.cost(state.at(x)),
            np.clip(state.vector(), low, high),
            (low, high),
            self.count,
            enough=enough,
            iterations=ITERATIONS,
        )
        # with the kinks of dry friction no test confirms a minimum: it is close enough
        # if the remaining gain is less than noise alone would give
        self.converged = found.left < len(low)
        return state.at(found.x)

    def bounds(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Least and largest values of the free parameters, (n,) each."""
        names = state.names()
        low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        for j, n in enumerate(names):
            if n in _POSITIVE:
                value = state.value(n)
                low[j] = 1e-3 * value if math.isfinite(value) and value > 0 else 1e-9
            elif n in _NOT_NEGATIVE or (n == "k_b" and state.resistance is None):
                low[j] = 0.0
            if n == "k_a":
                low[j] = max(low[j], self.least_inertia(state))
            if n == "delay":
                high[j] = 100.0 * self.records.Ts
            if n == "w_s":
                low[j], high[j] = self.stribeck_speeds()
            if n == "ripple":
                low[j], high[j] = self.ripples()
        return low, high

    def least_inertia(self, state: State) -> float:
        """k_a of a motor that is too fast for the samples to show and the integration to follow."""
        return float(QUICKEST * self.records.Ts * max(state.theta[0] + state.theta[1], 0.0))
