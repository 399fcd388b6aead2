"""`physics`: a motor's parameters by output error, and which of them the record shows.

A start comes from linear regression of smoothed signals over a few lags and delays, judged by the
free run. All terms are then fitted together, those that the record does not show are removed
(Wald's test), and the rest is fitted again. Intervals are those of a misspecified model, from the
long-run covariance of the scores (White 1982, Econometrica 50; Newey and West 1987, Econometrica
55), since what is left over is friction and load that no term has, not white noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray
from ..dataset import Dataset
from ..errors import DataError, FitError, SettingError
from ..identification.least_squares import least_squares
from ..recording import Recording
from .motor import Estimate, Motor, motor_of
from .records import Piece, Records, records_of

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
}
"""Parts of a motor beside back-EMF and inertia, and the parameters of each."""
ORDERS = {"load_1": 1, "load_2": 2, "inertia_2": 2}
"""How often a term repeats in a turn."""
SHAPES = {"ripple", "w_s"}
"""Parameters that say how a term goes, not how large it is."""
ALWAYS = {"delay", "limit", "coulomb"}
"""Terms that stay: a delay of nothing is an answer, a limit has a test of its own, and without dry
friction, which every motor has, k_v would take its place unnoticed."""
STRUCTURES = {"dcmotor": tuple(TERMS)}

SHOWN = 4.0
"""Wald's statistic from which a term is shown: two standard deviations of a single parameter."""
UNEXPLAINED = 0.005
"""Share of the speed's variance, from which a limit is looked for with all parameters free."""
LIMITED = 0.9
"""Of the cost without, that a limit of the current has to fall below."""
SINGULAR = 1e-11
"""Of the largest eigenvalue, from which a direction is seen."""
BOUNDLESS = 1e6
"""Standard deviations for a direction that is not, at unit noise."""
EVALUATIONS = 60
STRETCH = 20_000
"""Samples on which the way is found; all of them then have their say."""
COARSE, FINE = 1e-4, 1e-7
"""Tolerances on the way, and of what is printed."""
WHITE = 12
"""Order of the autoregression that says how what is left over hangs together."""
BUMPS = (0.02, 0.06)
"""Of the usual speed, at which Stribeck's friction is tried to fall off."""
FLOOR = 0.05
"""Of the power of what is left over, white: a filter does not magnify what is hardly there."""
WORSE = 1.1
"""Times the free-run error that a whitened fit may have over a plain one."""
CLIPPED = 5.0
"""Robust standard deviations from which a sample, alone, is left out as a spike."""


def physics(
    data: Recording | Dataset,
    *,
    structure: str | Sequence[str] = "dcmotor",
    current: str | ArrayLike | None = None,
    volts: float | None = None,
    speed_unit: str | None = None,
) -> Motor:
    """Friction, inertia and electrical constants of a motor from one record, with 95 % intervals.

    Command and speed alone determine the command per speed `k_v` and per acceleration `k_a`, dry
    friction `k_s`, lag, delay and variations over the turn, all in units of the command. R, Ke and
    J then each scale with an unmeasured quantity and are not printed. A measured `current` adds the
    resistance [command/A] and separates k_v into back-EMF and viscous friction; with `volts` as
    well, all are in SI units.

    Parameters
    ----------
    data : Recording or Dataset
        One input; of a `Recording` the counts are fitted. Random steps in both directions for 10 s
        show most; several experiments are fitted together.
    structure : "dcmotor" or sequence of str
        Terms that may be in it, of `lag`, `delay`, `coulomb`, `offset`, `drop`, `stribeck`,
        `load_1`, `load_2`, `inertia_2` (varying once, twice per turn) and `limit`. "dcmotor" tries
        all; a term that the record does not show is omitted.
    current : str or array, shape (N,), optional
        Motor current [A]: a channel of the data set, or its samples.
    volts : float, optional
        Volts on the winding per unit of command; 1 if the command is that voltage.
    speed_unit : str, optional
        rpm, rad/s, rev/s or deg/s, if the data set does not say.

    Returns
    -------
    Motor
        Parameters with intervals, and the names of those that the record does not determine.

    Raises
    ------
    DataError
        If speed or command do not change, the speed falls as the command rises (a sign is
        wrong), or too few samples are left.
    SettingError
        For an unknown term or unit.
    FitError
        If nothing converges to a motor.

    Notes
    -----
    Equations: `rust/core/src/greybox.rs`; conventions of kS, kV, kA as in WPILib's system
    identification. Errors are those of the free run.
    """
    terms = _terms(structure)
    if volts is not None and not (
        isinstance(volts, (int, float)) and math.isfinite(volts) and volts > 0
    ):
        raise SettingError(f"expected volts per unit of command above 0, received {volts!r}")
    records = records_of(data, current, speed_unit)
    reasons = _too_fast(records, terms)
    terms = tuple(t for t in terms if t not in reasons)
    if "stribeck" in terms and _never_slow(records):
        terms = tuple(t for t in terms if t != "stribeck")
        reasons["stribeck"] = "the record is hardly ever slow; add reversals"
    if "offset" in terms and not _turns_both_ways(records):
        terms = tuple(t for t in terms if t != "offset")
        reasons["offset"] = (
            "the speed has one sign, so that k_s holds friction and constant load together"
        )
    first = Task(records.liveliest(STRETCH))
    state = _fitted(first, _started(first, terms))
    first.leave_out_spikes(state)
    state = _with_limit(first, _fitted(first, state), terms)
    first.leave_out_spikes(state)
    state = _all_terms(first, state, terms)
    task = Task(records, first.steps)
    task.leave_out_spikes(state)
    state, shares = _shown_terms(task, state, terms)
    reasons |= {
        t: f"not shown, if there is any (Wald's statistic {shares[t]:.2g}, it takes {SHOWN:g})"
        for t in shares
    }
    covariance = task.covariance(state)
    estimate = Estimate(
        state.theta, state.resistance, tuple(state.names()), covariance, tuple(state.terms)
    )
    records = replace(records, spikes=records.spikes + first.spikes + task.spikes)
    return motor_of(estimate, records, task.outcome(state), reasons, volts, task.converged)


def _turns_both_ways(records: Records) -> bool:
    """Whether it turns in either direction for a hundredth of the time, faster than it creeps."""
    y = np.concatenate([p.y for p in records.pieces])
    clear = max(2.0 * records.quantum, 0.02 * float(np.abs(y).max()))
    return bool(min(np.mean(y > clear), np.mean(y < -clear)) > 0.01)


def _never_slow(records: Records) -> bool:
    """Whether it creeps for less than a hundredth of the time."""
    y = np.abs(np.concatenate([p.y for p in records.pieces]))
    return bool(np.mean((y > 0.0) & (y < 0.1 * np.quantile(y, 0.9))) < 0.01)


def _too_fast(records: Records, terms: tuple[str, ...]) -> dict[str, str]:
    """What repeats over a turn, and passes between two samples; with the reason."""
    y = np.concatenate([p.y for p in records.pieces])
    turn = float(np.quantile(np.abs(y), 0.95)) * records.Ts
    why = (
        f"the shaft turns {turn:.2g} rad between two samples, too far to see what repeats; record "
        "faster, or more slowly turning"
    )
    return {t: why for t, order in ORDERS.items() if t in terms and order * turn > 0.5 * math.pi}


def _terms(structure: str | Sequence[str]) -> tuple[str, ...]:
    if isinstance(structure, str):
        if structure not in STRUCTURES:
            raise SettingError(
                f"expected structure {', '.join(STRUCTURES)} or a list of terms, received "
                f"{structure!r}; terms are {', '.join(TERMS)}"
            )
        return STRUCTURES[structure]
    given = list(structure)
    for t in given:
        if t not in TERMS:
            raise SettingError(f"expected terms of {', '.join(TERMS)}, received {t!r}")
    return tuple(t for t in TERMS if t in given)


# --- What is fitted: parameters that are free, residuals and their derivatives --------------------


@dataclass(frozen=True)
class State:
    """Values of all parameters, and which are free."""

    theta: FloatArray
    resistance: float | None
    terms: tuple[str, ...]

    def names(self) -> list[str]:
        free = ["k_e", "k_a", *(["k_b", "R"] if self.resistance is not None else [])]
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
        return State(theta, resistance, self.terms)

    def having(self, terms: Sequence[str], **values: float) -> State:
        """With other terms: those that go are set to nothing."""
        theta = self.theta.copy()
        for t in set(self.terms) - set(terms):
            for p in TERMS[t]:
                theta[PLACE[p]] = _NOTHING[PLACE[p]]
        for name, value in values.items():
            theta[PLACE[name]] = value
        return State(theta, self.resistance, tuple(t for t in TERMS if t in terms))


_NOTHING = np.array(
    [{"ripple": 1.0, "w_s": 1.0, "k_a": 1.0, "limit": math.inf}.get(p, 0.0) for p in PARAMETERS]
)
_POSITIVE = {"k_a", "ripple", "w_s", "limit", "R"}
_NOT_NEGATIVE = {"tau", "delay", "k_s", "k_t", "drop"}


@dataclass
class Task:
    """The records, and filters that weigh what is left over of speeds [rad/s] and currents [A]."""

    records: Records
    steps: int = 2
    converged: bool = False
    spikes: int = 0
    speed_filter: FloatArray = field(default_factory=lambda: np.ones(1))
    current_filter: FloatArray = field(default_factory=lambda: np.ones(1))

    @property
    def has_current(self) -> bool:
        return self.records.pieces[0].current is not None

    def simulated(self, state: State, free: Sequence[str]) -> list[tuple[FloatArray, ...]]:
        """Of each piece speed, drive and their derivatives."""
        places = [PLACE[n] for n in free]
        r = self.records
        return [
            _core.greybox_run(
                state.theta, places, p.u, Ts=r.Ts, steps=self.steps, speed=p.speed, mean=r.mean,
                angle=p.angle,
            )
            for p in r.pieces
        ]  # fmt: skip

    def residuals(self, state: State) -> FloatArray:
        """Simulated less measured, whitened; of each piece the speeds and then the currents."""
        found = []
        for p, (y, drive, _, _) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            found.append(self.whitened(p, y - p.y, self.speed_filter))
            if p.current is not None:
                assert state.resistance is not None
                off = drive / state.resistance - p.current
                found.append(self.whitened(p, off, self.current_filter))
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
            found.append(self.whitened(p, rows, self.speed_filter).T)
            if p.current is not None:
                assert state.resistance is not None
                R = state.resistance
                rows = np.zeros((len(names), len(p.u)))
                rows[columns] = drive_by.T / R
                rows[names.index("R")] = -drive / (R * R)
                found.append(self.whitened(p, rows, self.current_filter).T)
        return np.concatenate(found)

    @staticmethod
    def whitened(p: Piece, rows: FloatArray, taps: FloatArray) -> FloatArray:
        """Through a filter; samples that are not used are nothing."""
        kept: FloatArray = np.where(p.used, rows, 0.0)
        found: FloatArray = taps[0] * kept
        for lag in range(1, len(taps)):
            found[..., lag:] += taps[lag] * kept[..., :-lag]
        return found

    def cost(self, state: State) -> float:
        try:
            r = self.residuals(state)
        except SettingError:
            return math.inf
        return float(r @ r) if np.isfinite(r).all() else math.inf

    def outcome(self, state: State) -> tuple[FloatArray, ...]:
        """Measured and simulated speed [rad/s] of the samples used, and their free-run error."""
        ys, models = [], []
        for p, (y, *_) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            ys.append(p.y[p.used])
            models.append(y[p.used])
        return np.concatenate(ys), np.concatenate(models)

    def rmse(self, state: State) -> float:
        """Of the free run's speed [rad/s]."""
        y, model = self.outcome(state)
        return float(np.sqrt(np.mean((y - model) ** 2)))

    def weigh(self, state: State, order: int = WHITE) -> None:
        """Filters that make white, of variance 1, what this fit leaves over.

        An encoder's steps in a difference of counts cancel from sample to sample, and a load that
        no term has stays for many: each has its own colour, and counts as little as it deserves.
        """
        speeds, currents = [], []
        for p, (y, drive, _, _) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            speeds.append(np.where(p.used, y - p.y, 0.0))
            if p.current is not None:
                assert state.resistance is not None
                currents.append(np.where(p.used, drive / state.resistance - p.current, 0.0))
        self.speed_filter = _whitener(speeds, order)
        if currents:
            self.current_filter = _whitener(currents, 0)

    def leave_out_spikes(self, state: State) -> None:
        """Samples that stand far off alone, once a fit shows what is far."""
        for p, (y, *_) in zip(self.records.pieces, self.simulated(state, ()), strict=True):
            off = np.abs(y - p.y)
            spread = max(1.4826 * float(np.median(off[p.used])), self.records.quantum)
            far = off > CLIPPED * spread
            far &= p.used
            alone = far & ~np.roll(far, 1) & ~np.roll(far, -1)
            p.used[alone] = False
            self.spikes += int(alone.sum())

    def stribeck_speeds(self) -> tuple[float, float]:
        """In which friction may fall off: below, there is hardly a sample to show it."""
        usual = float(np.quantile(np.abs(np.concatenate([p.y for p in self.records.pieces])), 0.9))
        return 0.01 * usual, usual

    def settle_steps(self, state: State) -> None:
        """Integration steps for the time constants that were found."""
        k_v = max(state.theta[0] + state.theta[1], 1e-12)
        fastest = min(self.records.Ts / 2.0, state.theta[PLACE["k_a"]] / k_v / 30.0)
        tau = state.theta[PLACE["tau"]]
        if tau > 0.05 * self.records.Ts:
            fastest = min(fastest, tau / 2.0)
        self.steps = int(np.clip(math.ceil(self.records.Ts / max(fastest, 1e-12)), 2, 64))

    def covariance(self, state: State) -> FloatArray:
        """Of the estimate; sums of scores over a window stand for their long-run covariance."""
        names = state.names()
        J, r = self.jacobian(state), self.residuals(state)
        inner, unknown = _inverse(J.T @ J)
        k_v = max(state.theta[0] + state.theta[1], 1e-12)
        settling = 2.0 * state.theta[PLACE["k_a"]] / k_v / self.records.Ts
        middle = np.zeros((len(names), len(names)))
        at, total = 0, 0.0
        for p in self.records.pieces:
            n = len(p.u)
            g = J[at : at + n] * r[at : at + n, None]
            at += n
            if p.current is not None:
                g = g + J[at : at + n] * r[at : at + n, None]
                at += n
            window = int(np.clip(max(settling, math.sqrt(n)), 1, max(n // 15, 1)))
            sums = np.cumsum(np.concatenate([np.zeros((window, len(names))), g]), axis=0)
            sums = np.concatenate([sums, np.repeat(sums[-1:], window - 1, axis=0)])
            within = sums[window:] - sums[:-window]
            middle += within.T @ within / window
            total += 1.5 * n / window
        spread = (1.0 + 1.2 / max(total, 1.0)) ** 2  # Student's quantile over the normal one
        return inner @ middle @ inner * spread + unknown


def _whitener(parts: Sequence[FloatArray], order: int) -> FloatArray:
    """Of an autoregression (Yule-Walker equations), over its innovations' standard deviation."""
    n = sum(map(len, parts))
    r = np.array([sum(float(x[k:] @ x[: len(x) - k]) for x in parts) for k in range(order + 1)]) / n
    if r[0] <= 0.0:
        return np.ones(1)
    r[0] *= 1.0 + FLOOR
    lags = np.abs(np.subtract.outer(np.arange(order), np.arange(order)))
    a = np.linalg.solve(r[lags], r[1:])
    return np.concatenate([[1.0], -a]) / math.sqrt(max(r[0] - float(a @ r[1:]), 1e-12 * r[0]))


def _inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of a positive matrix where it has one, and a covariance beyond all bounds where it has none.

    A step to a single speed, say, does not part friction from back-EMF: what is left in such a
    direction is rounding, whose inverse would be a lie and whose omission a certainty.
    """
    d = np.sqrt(np.diag(matrix))
    d[d == 0.0] = 1.0
    size, along = np.linalg.eigh(matrix / np.outer(d, d))
    along /= d[:, None]
    known = size > SINGULAR * size[-1]
    unknown = along[:, ~known] * BOUNDLESS
    return along[:, known] / size[known] @ along[:, known].T, unknown @ unknown.T


def _fitted(task: Task, state: State, tolerance: float = COARSE) -> State:
    """At the least squares of all that is free in it."""
    names = state.names()
    low = np.array([_least(n, state) for n in names])
    high = np.full(len(names), np.inf)
    for j, n in enumerate(names):
        if n == "delay":
            high[j] = 100.0 * task.records.Ts
        if n == "w_s":
            low[j], high[j] = task.stribeck_speeds()
    start = np.clip(state.vector(), low, high)
    found = least_squares(
        lambda x: task.residuals(state.at(x)),
        start,
        lambda x: task.jacobian(state.at(x)),
        bounds=(low, high),
        max_nfev=EVALUATIONS,
        ftol=tolerance,
        xtol=tolerance,
    )
    # where dry friction makes the cost a broken line no test confirms a minimum: it is near enough
    # where what is left to gain is less than what noise alone would give
    left = len(found.fun) * found.relative_offset**2
    task.converged = found.success or left < len(names)
    return state.at(found.x)


def _least(name: str, state: State) -> float:
    if name in _POSITIVE:
        value = state.value(name)
        return 1e-3 * value if math.isfinite(value) and value > 0 else 1e-9
    return 0.0 if name in _NOT_NEGATIVE else -np.inf


# --- Where it starts ------------------------------------------------------------------------------


def _started(task: Task, terms: tuple[str, ...]) -> State:
    """The best of a few regressions, by its free run."""
    first = tuple(t for t in ("lag", "delay", "coulomb", "offset") if t in terms)
    Ts = task.records.Ts
    best, cost, signs = None, math.inf, []
    for width in (1.5, 5.0, 15.0, 45.0):
        for lag in (0.0, 5.0, 20.0) if "lag" in terms else (0.0,):
            for delay in (0, 2, 6) if "delay" in terms else (0,):
                k_v, k_a, k_s, offset = _regressed(task.records, width, lag, delay)
                signs.append(k_v < 0.0 and k_a < 0.0)
                if not (k_a > 0.0 and k_v > -1e-3):
                    continue
                theta = _NOTHING.copy()
                values = {
                    "k_e": k_v, "k_a": k_a, "tau": lag * Ts, "delay": delay * Ts,
                    "k_s": max(k_s, 0.0), "offset": offset,
                }  # fmt: skip
                for name, value in values.items():
                    theta[PLACE[name]] = value
                state = State(theta, None, first)
                of_this = _Speeds(task.records, task.steps).cost(state)
                if of_this < cost:
                    best, cost = state, of_this
    y = np.concatenate([p.y for p in task.records.pieces])
    if best is None or not math.isfinite(cost):
        if np.mean(signs) > 0.5:
            raise DataError(
                "expected a speed that rises with the command, received one that falls; turn the "
                "sign of one of them"
            )
        raise FitError(
            "expected a speed that follows the command as a motor's does, none of the starts is "
            "one; is the output a speed, and the input what drives the motor?"
        )
    alone = _Speeds(task.records, task.steps)
    best = _fitted(alone, best)
    alone.settle_steps(best)
    explained = 1.0 - alone.cost(best) / max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
    if best.theta[0] < 0.0 or explained < 0.5:
        raise FitError(
            f"expected a speed that follows the command as a motor's does, received one of which "
            f"the free run explains {100 * max(explained, 0):.0f} %; is the output a speed, the "
            "input what drives the motor, and the loop free of a load that others move?"
        )
    task.steps = alone.steps
    if task.has_current:
        drives = [
            (d[p.used], p.current[p.used])
            for p, (_, d, _, _) in zip(task.records.pieces, task.simulated(best, ()), strict=True)
            if p.current is not None
        ]
        drive, i = (np.concatenate(c) for c in zip(*drives, strict=True))
        resistance = float(drive @ drive) / float(drive @ i) if float(drive @ i) > 0 else math.nan
        if not (math.isfinite(resistance) and resistance > 0):
            raise DataError(
                "expected a current that rises with the command, received one that does not; turn "
                "its sign, or leave it out"
            )
        best = State(best.theta, resistance, best.terms)
    task.weigh(best)
    return best


class _Speeds(Task):
    """The speeds alone: a start needs no resistance."""

    def __init__(self, records: Records, steps: int) -> None:
        pieces = tuple(replace(p, current=None) for p in records.pieces)
        super().__init__(replace(records, pieces=pieces), steps)


def _regressed(records: Records, width: float, lag: float, delay: int) -> FloatArray:
    """`u = k_v w + k_a dw/dt + k_s sign w + offset` of signals under a bell of this width.

    The bell's derivative stands for that of the speed (modulating functions, Shinbrot 1957).
    """
    half = math.ceil(3.0 * width)
    k = np.arange(-half, half + 1)
    bell = np.exp(-0.5 * (k / width) ** 2)
    bell /= bell.sum()
    slope = -k / width**2 * bell / records.Ts
    fade = np.exp(-np.arange(math.ceil(5 * lag) + 1) / lag) if lag else np.ones(1)
    rows, commands = [], []
    quiet = 1.5 * records.quantum
    for p in records.pieces:
        if len(p.u) <= 2 * half + len(fade) + delay:
            continue
        late = np.concatenate([np.full(delay, p.u[0]), p.u[: len(p.u) - delay]])
        padded = np.concatenate([np.full(len(fade) - 1, late[0]), late])
        lagged = np.convolve(padded, fade / fade.sum(), "valid")
        smooth = np.convolve(p.y, bell, "valid")
        rates = np.convolve(p.y, slope, "valid")
        moving = np.abs(smooth) > quiet
        sign = np.where(moving, np.sign(smooth), 0.0)
        columns = np.stack([smooth, rates, sign, np.ones_like(sign)], axis=1)
        rows.append(columns[moving])
        commands.append(np.convolve(lagged, bell, "valid")[moving])
    if not rows or sum(map(len, rows)) < 20:
        return np.full(4, math.nan)
    A, b = np.concatenate(rows), np.concatenate(commands)
    if len({*np.sign(A[:, 2])}) < 2:  # one sign: friction and offset are one
        found = np.linalg.lstsq(A[:, :3], b, rcond=None)[0]
        return np.array([*found[:2], abs(found[2]), 0.0])
    found = np.linalg.lstsq(A, b, rcond=None)[0]
    return np.asarray(found, dtype=np.float64)


# --- Which terms there are ------------------------------------------------------------------------


def _with_limit(task: Task, state: State, terms: tuple[str, ...]) -> State:
    """With a limit of the current, where the cost without is clearly higher."""
    if "limit" not in terms:
        return state
    drive = np.concatenate([np.abs(d) for _, d, _, _ in task.simulated(state, ())])
    places = [float(np.quantile(drive, q)) for q in (0.999, 0.98, 0.94, 0.88, 0.8)]
    tried = [state.having([*state.terms, "limit"], limit=max(v, 1e-9)) for v in places]
    before = task.cost(state)
    best = min(tried, key=task.cost)
    y, model = task.outcome(state)
    if task.cost(best) <= LIMITED * before:
        tried = [best]
    elif np.mean((y - model) ** 2) < UNEXPLAINED * np.var(y):
        return state
    # where much is left to explain, other parameters have bent to stand for a limit
    found = min((_fitted(task, s) for s in tried), key=task.cost)
    return found if task.cost(found) < LIMITED * before else state


def _all_terms(task: Task, state: State, terms: tuple[str, ...]) -> State:
    """All terms fitted together, roughly."""
    size = max(state.value("k_s"), 0.01 * float(np.std(task.records.pieces[0].u)))
    _, fast = task.stribeck_speeds()
    starts = {
        "drop": 0.2 * size, "ripple": 0.2 * size, "k_t": 0.2 * size, "w_s": 0.1 * fast,
        "load_1c": 0.0, "load_1s": 0.0, "load_2c": 0.0, "load_2s": 0.0,
    }  # fmt: skip
    whole = [t for t in terms if t != "limit" or "limit" in state.terms]
    new = {p for t in set(whole) - set(state.terms) for p in TERMS[t]}
    state = state.having(whole, **{p: v for p, v in starts.items() if p in new})
    state = _fitted(task, state)
    task.weigh(state)
    tried = [_fitted(task, state)]
    if "stribeck" in whole:  # the speed at which friction falls off has more than one minimum
        bumps = [state.having(whole, k_t=0.4 * size, w_s=part * fast) for part in BUMPS]
        tried += [_fitted(task, s) for s in bumps]
    return min(
        [*tried, state], key=lambda s: (task.rmse(s) > WORSE * task.rmse(state), task.cost(s))
    )


def _shown_terms(
    task: Task, start: State, terms: tuple[str, ...]
) -> tuple[State, dict[str, float]]:
    """All terms fitted together, then without those that are not shown; their statistics."""
    task.weigh(start)
    state = _fitted(task, start, FINE)
    if task.rmse(state) > WORSE * task.rmse(start):
        task.weigh(start, order=0)
        state = _fitted(task, start, FINE)
    _, fast = task.stribeck_speeds()
    kept, out = list(state.terms), {t: 0.0 for t in terms if t not in state.terms}
    names, covariance, x = state.names(), task.covariance(state), state.vector()
    while True:
        shown = {t: _wald(t, names, x, covariance) for t in kept if t not in ALWAYS}
        if "stribeck" in kept and x[names.index("w_s")] > 0.99 * fast:
            shown["stribeck"] = 0.0  # it falls off nowhere: that is Coulomb's friction
        weakest = min(shown, key=lambda t: shown[t], default=None)
        if weakest is None or shown[weakest] >= SHOWN:
            break
        out[weakest] = shown[weakest]
        kept.remove(weakest)
        names, x, covariance = _without(TERMS[weakest], names, x, covariance)
    if len(kept) < len(state.terms):
        state = _fitted(task, state.having(kept), FINE)
    return state, out


def _wald(term: str, names: list[str], x: FloatArray, covariance: FloatArray) -> float:
    at = [names.index(p) for p in TERMS[term] if p not in SHAPES]
    try:
        return float(x[at] @ np.linalg.solve(covariance[np.ix_(at, at)], x[at]))
    except np.linalg.LinAlgError:
        return 0.0


def _without(
    gone: tuple[str, ...], names: list[str], x: FloatArray, covariance: FloatArray
) -> tuple[list[str], FloatArray, FloatArray]:
    """The estimate on condition that some parameters are nothing."""
    out = [j for j, n in enumerate(names) if n in gone]
    sizes = [j for j in out if names[j] not in SHAPES]
    left = [j for j in range(len(names)) if j not in out]
    gain = covariance[np.ix_(left, sizes)] @ np.linalg.pinv(covariance[np.ix_(sizes, sizes)])
    return (
        [names[j] for j in left],
        x[left] - gain @ x[sizes],
        covariance[np.ix_(left, left)] - gain @ covariance[np.ix_(sizes, left)],
    )
