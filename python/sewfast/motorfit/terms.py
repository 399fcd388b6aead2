"""Terms of a motor that a record shows, and intervals of their parameters by profile likelihood.

A start comes from linear regression of smoothed signals over a few lags and delays, judged by the
free run. All terms are then fitted together, those that the record does not show are removed
(Wald's test), and the rest is fitted again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import FloatArray
from ..progress import TimeUp
from .estimation import CONFIDENCE, Normal, inverse, minimised
from .problem import FINE, NEAR, PARAMETERS, TERMS, WAVES, Problem, State
from .records import Records
from .starts import CLEAR, started, with_waves

ORDERS = {"load_1": 1, "load_2": 2, "inertia_2": 2}
"""Number of times that a term repeats in a turn."""
SHAPES = {"ripple", "w_s"}
"""Parameters of a term's shape, not of its size."""
SHAPED = {"drop", "stribeck"}
"""Terms with such a parameter."""
ALWAYS = {"delay", "limit", "coulomb"}
"""Terms that are always kept: a delay of zero is a valid result, a limit has a separate test, and
without dry friction, which every motor has, k_v would absorb it unnoticed."""

SHOWN = 1.0
"""Wald's statistic of a single parameter above which its term is kept: omitting a parameter larger
than its standard deviation harms the others more than its uncertainty does (Toro-Vizcarrondo and
Wallace 1968, JASA 63). Its own interval decides whether it is printed."""
SURE = 16.0
"""The same for a term that is fitted only if it stands out."""
UNEXPLAINED = 0.005
"""Unexplained share of the speed's variance above which a limit is sought with all terms free."""
LIMITED = 0.9
"""Largest cost with a limit of the current, relative to the cost without."""
STRETCH = 10_000
"""Samples of the first fit, before all are used. Of 20 s at 1 kHz, 5,000 samples end in another
minimum for 1 of 60 machines, 2,500 for 1 of 8; all 20,000 gain nothing."""
BUMPS = (0.02, 0.06)
"""Speeds tried for the fall of Stribeck friction, relative to the usual speed."""
ON_THE_WAY = 8
"""Most integration steps per sample until the terms are chosen: a motor far faster than its samples
would need 64, which changes intermediate parameters by only a few per cent."""
WORSE = 1.1
"""Largest free-run error of a whitened fit relative to a plain one."""


@dataclass(frozen=True, eq=False)
class Estimated:
    """Result of the fit of a motor. `state` has all parameters at the least-squares solution and
    the terms that are shown; `covariance` (n, n) is that of its free parameters. `reasons` says why
    the record does not show a term (or the inertia). `records` have estimated initial speeds and no
    spikes; `problem` is that of the final fit.
    """

    state: State
    covariance: FloatArray
    reasons: dict[str, str]
    records: Records
    problem: Problem


def estimated(
    records: Records,
    terms: tuple[str, ...],
    look: Callable[[], object] = lambda: None,
    *,
    if_clear: tuple[str, ...] = (),
) -> Estimated:
    """The parameters, and which of the terms the records show.
    Terms in `if_clear` are fitted only if the residuals without them show them clearly. `look` is
    called from time to time; an exception of it ends the fit. If it raises `TimeUp` when a motor is
    known, the result is the motor so far, whose covariance is infinite. Raises `DataError` if the
    speed falls as the command rises, and `FitError` if nothing converges to a motor.
    """
    reasons = _too_fast(records, terms)
    terms = tuple(t for t in terms if t not in reasons)
    if "stribeck" in terms and _never_slow(records):
        terms = tuple(t for t in terms if t not in ("stribeck", "stribeck_difference"))
        reasons["stribeck"] = "the record is hardly ever slow; add reversals"
    if "offset" in terms and not _turns_both_ways(records):
        terms = tuple(t for t in terms if t != "offset")
        reasons["offset"] = (
            "the speed has one sign, so that k_s holds friction and constant load together"
        )
    first = Problem(records.liveliest(STRETCH), look=look)
    so_far = [first.fitted(started(first, terms))]
    try:
        return _refined(first, records, so_far, terms, reasons, if_clear)
    except TimeUp:
        state = so_far[-1]
        n = len(state.names())
        return Estimated(state, np.full((n, n), np.inf), reasons, first.records, first)


def _refined(
    first: Problem,
    records: Records,
    so_far: list[State],
    terms: tuple[str, ...],
    reasons: dict[str, str],
    if_clear: tuple[str, ...],
) -> Estimated:
    """The motor with all terms, on all records; each better state is appended to `so_far`."""
    part, look, (state,) = first.records, first.look, so_far
    steps, first.steps = first.steps, min(first.steps, ON_THE_WAY)
    # so few steps diverge only if the motor is too fast for the record to show its inertia
    if not math.isfinite(first.cost(state)):
        first.steps = steps
    first.settle_starts(state)
    first.leave_out_spikes(state)
    state = _with_limit(first, first.fitted(state), terms)
    so_far.append(state)
    first.leave_out_spikes(state)
    state = _all_terms(first, state, tuple(t for t in terms if t not in WAVES))
    so_far.append(state)
    given = terms
    state = _with_clear(first, state, if_clear)
    true = functools.partial(_trued, c=state.value("eccentric_c"), s=state.value("eccentric_s"))
    first.records = true(first.records)
    before, state = state, with_waves(first, state, terms)
    if state is not before:  # terms hidden by the waves can be clear now
        state = first.fitted(state)
        first.weigh(state)
        state = _with_clear(first, state, if_clear)
    terms = tuple(t for t in TERMS if t in (*terms, *state.terms))
    needed = {t: SHOWN if t in given and t not in WAVES else SURE for t in terms}
    # keep the estimated initial speeds where the pieces are the same
    records = first.records if part is records else true(records)
    problem = Problem(records, first.steps, k_v=first.k_v, look=look)
    problem.settle_starts(state)
    problem.leave_out_spikes(state)
    state, shares, covariance = _shown_terms(problem, state, needed, steps)
    reasons |= {
        t: f"not shown, if there is any (Wald's statistic {share:.2g}, it takes {needed[t]:g})"
        for t, share in shares.items()
        if t in given and (t not in WAVES or state.orders[WAVES.index(t)])
    }
    missing = "no wave over the turn stands out from the residuals"
    if set(WAVES[:3]) <= set(terms) and not any(state.orders[:3]):
        reasons["cogging"] = missing
    if WAVES[3] in terms and not state.orders[3]:
        reasons["torque_ripple"] = missing
    if state.value("k_a") <= 1.01 * problem.least_inertia(state) or problem.is_slow(state):
        reasons["inertia"] = (
            "the record does not show how the motor speeds up; record steps, several samples in "
            "each of its time constants"
        )
    records = replace(problem.records, spikes=records.spikes + first.spikes + problem.spikes)
    return Estimated(state, covariance, reasons, records, problem)


def _trued(records: Records, *, c: float, s: float) -> Records:
    """Records with the shaft's angle: an eccentric encoder's makes sidebands of every wave."""
    if c == 0.0 and s == 0.0:
        return records
    pieces = [
        replace(p, angle=p.angle - c * np.sin(p.angle) + s * np.cos(p.angle))
        for p in records.pieces
    ]
    return replace(records, pieces=tuple(pieces))


def _turns_both_ways(records: Records) -> bool:
    """Whether it turns both ways, each for a hundredth of the time, faster than a creep."""
    y = np.concatenate([p.y for p in records.pieces])
    clear = max(2.0 * records.quantum, 0.02 * float(np.abs(y).max()))
    return bool(min(np.mean(y > clear), np.mean(y < -clear)) > 0.01)


def _never_slow(records: Records) -> bool:
    """Whether it creeps for less than a hundredth of the time."""
    y = np.abs(np.concatenate([p.y for p in records.pieces]))
    return bool(np.mean((y > 0.0) & (y < 0.1 * np.quantile(y, 0.9))) < 0.01)


def _too_fast(records: Records, terms: tuple[str, ...]) -> dict[str, str]:
    """Terms that repeat over a turn but pass between two samples, with the reason."""
    y = np.concatenate([p.y for p in records.pieces])
    turn = float(np.quantile(np.abs(y), 0.95)) * records.Ts
    why = (
        f"the shaft turns {turn:.2g} rad between two samples, too far to see repetitions; record "
        "faster, or at lower speed"
    )
    return {t: why for t, order in ORDERS.items() if t in terms and order * turn > 0.5 * math.pi}


# --- Choice of terms ------------------------------------------------------------------------------


def _with_limit(problem: Problem, state: State, terms: tuple[str, ...]) -> State:
    """The state with a limit of the current, if the cost without is clearly higher."""
    if "limit" not in terms:
        return state
    drive = np.concatenate([np.abs(d) for _, d, _, _ in problem.simulated(state, ())])
    places = [float(np.quantile(drive, q)) for q in (0.999, 0.98, 0.94, 0.88, 0.8)]
    tried = [state.having([*state.terms, "limit"], limit=max(v, 1e-9)) for v in places]
    before = problem.cost(state)
    best = min(tried, key=problem.cost)
    y, model = problem.outcome(state)
    if problem.cost(best) <= LIMITED * before:
        tried = [best]
    elif np.mean((y - model) ** 2) < UNEXPLAINED * np.var(y):
        return state
    # if much is unexplained, other parameters have moved to compensate for a missing limit
    found = min((problem.fitted(s) for s in tried), key=problem.cost)
    return found if problem.cost(found) < LIMITED * before else state


def _all_terms(problem: Problem, state: State, terms: tuple[str, ...]) -> State:
    """All terms fitted together, roughly."""
    size = max(state.value("k_s"), 0.01 * float(np.std(problem.records.pieces[0].u)))
    _, fast = problem.stribeck_speeds()
    starts = {
        "drop": 0.2 * size, "ripple": 0.2 * size, "k_t": 0.2 * size, "w_s": 0.1 * fast,
    }  # fmt: skip
    whole = [t for t in terms if t != "limit" or "limit" in state.terms]
    new = {p for t in set(whole) - set(state.terms) for p in TERMS[t]}
    state = state.having(whole, **{p: v for p, v in starts.items() if p in new})
    state = problem.fitted(state)
    problem.weigh(state)
    tried = [problem.fitted(state)]
    if "stribeck" in whole:  # the speed at which friction falls off has more than one minimum
        bumps = [state.having(whole, k_t=0.4 * size, w_s=part * fast) for part in BUMPS]
        tried += [problem.fitted(s) for s in bumps]
    return min(
        [*tried, state],
        key=lambda s: (problem.rmse(s) > WORSE * problem.rmse(state), problem.cost(s)),
    )


def _with_clear(problem: Problem, state: State, terms: tuple[str, ...]) -> State:
    """The state with those of the terms that the residuals show clearly, one after the other."""
    while clear := _clear(problem, state, terms):
        state = problem.fitted(state.having([*state.terms, *clear]))
        problem.weigh(state)
    return state


def _clear(problem: Problem, state: State, terms: tuple[str, ...]) -> list[str]:
    """Terms without which the fit is clearly worse, by their scores (Rao 1948)."""
    bumpy = "stribeck" in state.terms and problem.parts_sides(state.value("w_s"))
    tried = [t for t in terms if t not in state.terms and (bumpy or t != "stribeck_difference")]
    if not tried:
        return []
    whole = state.having([*state.terms, *tried])
    cost, gradient, matrix = problem.normal(whole)
    names, variance, clear = whole.names(), max(cost / problem.count, 1e-300), []
    rest = [names.index(n) for n in state.names()]
    known, _ = inverse(matrix[np.ix_(rest, rest)])
    for t in tried:
        at = [names.index(n) for n in TERMS[t]]
        across = matrix[np.ix_(at, rest)]
        left = matrix[np.ix_(at, at)] - across @ known @ across.T
        slope = gradient[at] - across @ known @ gradient[rest]
        if float(slope @ np.linalg.pinv(left) @ slope) > CLEAR * variance:
            clear.append(t)
    return clear


def _shown_terms(
    problem: Problem, start: State, needed: Mapping[str, float], steps: int
) -> tuple[State, dict[str, float], FloatArray]:
    """Fit all terms together, then drop those that are not shown, in as many steps as needed.
    `needed` has the statistic above which each is kept. Returns the state, the statistics of the
    dropped terms, and the covariance of the free parameters. The covariance allows for a dead zone
    or Stribeck friction that is not shown but hidden in the resistance or in dry friction.
    """
    problem.weigh(start)
    state = problem.fitted(start, NEAR)
    if problem.rmse(state) > WORSE * problem.rmse(start):
        problem.weigh(start, order=0)
        state = problem.fitted(start, NEAR)
    _, fast = problem.stribeck_speeds()
    explained: dict[str, float] = {}
    whole = problem.covariance(state)
    kept, out = list(state.terms), {t: 0.0 for t in needed if t not in state.terms}
    names, covariance, x = state.names(), whole, state.vector()
    while True:
        wald = {t: _wald(t, names, x, covariance) for t in kept if t not in ALWAYS}
        shown = {t: max(v, explained.get(t, 0.0)) for t, v in wald.items()}
        if "stribeck" in kept and x[names.index("w_s")] > 0.99 * fast:
            shown["stribeck"] = 0.0  # it never falls off: Coulomb friction
        if "stribeck_difference" in kept:
            if not problem.parts_sides(x[names.index("w_s")]):
                shown["stribeck_difference"] = 0.0
            shown["stribeck"] = math.inf  # the difference has its shape, and is dropped first
        weakest = min(shown, key=lambda t: shown[t] / needed[t], default=None)
        if weakest is None or shown[weakest] >= needed[weakest]:
            break
        if weakest in SHAPED and shown[weakest] > 0.0 and weakest not in explained:
            explained[weakest] = _explained(problem, state, weakest, whole)
            continue
        out[weakest] = shown[weakest]
        kept.remove(weakest)
        names, x, covariance = _without(TERMS[weakest], names, x, covariance)
    problem.steps = steps
    last = problem.fitted(state.having(kept), FINE)
    hidden = [t for t in state.terms if t in SHAPED and t not in kept]
    shapes = {p: state.value(p) for t in hidden for p in TERMS[t] if p in SHAPES}
    wider = last.having([*kept, *hidden], **shapes)
    at = [wider.names().index(n) for n in last.names()]
    return last, out, problem.covariance(wider)[np.ix_(at, at)]


def _explained(problem: Problem, state: State, term: str, covariance: FloatArray) -> float:
    """Deviance of a fit without a term, over its expectation for errors of this colour.
    If the shape of a term is uncertain, so is its amplitude, however much it explains: Wald's
    statistic is then inadequate (Chandler and Bate 2007, Biometrika 94, for the factor).
    """
    cost, _, matrix = problem.normal(state)
    variance = max(cost / problem.count, 1e-300)
    at = next(j for j, n in enumerate(state.names()) if n in TERMS[term] and n not in SHAPES)
    white = inverse(matrix)[0][at, at] * variance
    without = problem.fitted(state.having([t for t in state.terms if t != term]))
    deviance = (problem.cost(without) - cost) / variance
    return float(deviance * white / max(covariance[at, at], 1e-300))


def _wald(term: str, names: list[str], x: FloatArray, covariance: FloatArray) -> float:
    at = [names.index(p) for p in TERMS[term] if p not in SHAPES]
    try:
        return float(x[at] @ np.linalg.solve(covariance[np.ix_(at, at)], x[at]))
    except np.linalg.LinAlgError:
        return 0.0


def _without(
    gone: tuple[str, ...], names: list[str], x: FloatArray, covariance: FloatArray
) -> tuple[list[str], FloatArray, FloatArray]:
    """The estimate conditional on some parameters being 0."""
    out = [j for j, n in enumerate(names) if n in gone]
    sizes = [j for j in out if names[j] not in SHAPES]
    left = [j for j in range(len(names)) if j not in out]
    gain = covariance[np.ix_(left, sizes)] @ np.linalg.pinv(covariance[np.ix_(sizes, sizes)])
    return (
        [names[j] for j in left],
        x[left] - gain @ x[sizes],
        covariance[np.ix_(left, left)] - gain @ covariance[np.ix_(sizes, left)],
    )


# --- Profile-likelihood intervals -----------------------------------------------------------------


# Profile-likelihood intervals: how far a quantity can move while all parameters are refitted.
#
# An interval by curvature is symmetric and assumes a parabolic cost. Here the quantity is held away
# from its estimate, everything else is fitted again, and the ends are where the cost has risen by
# as much as chance explains (Venzon and Moolgavkar 1988, Applied Statistics 37). The residuals are
# not white noise, so that the rise is scaled by the ratio of the variance of the scores to the one
# that white noise would give (Chandler and Bate 2007, Biometrika 94).

HELD = 100.0
"""Stiffness that holds the quantity, relative to the cost's curvature: it yields by 1 %."""
TRIES = 4
REACHED = 0.02
"""Relative accuracy of an end."""
LONGEST = 3.0
"""Largest ratio of a step to the previous one."""
ITERATIONS = 12

Values = Mapping[str, float]


def profiled(
    found: Estimated, of: Callable[[Values], float], slope: FloatArray, half: float
) -> tuple[float, float]:
    """Ends of the 95 % interval of a quantity. `of` is the quantity as a function of all parameters
    by name and the resistance `R`, and `slope` (n,) are its derivatives with respect to the free
    parameters. The search starts at `half`, the half-width of the interval by curvature, above 0.
    """
    problem, state = found.problem, found.state
    x = state.vector()
    start, _, matrix = problem.normal(state)
    value = of(values_of(state))
    spread, _ = inverse(matrix)
    along = spread @ slope
    size = max(float(slope @ along), 1e-300)
    # rise of the cost at the end of an interval
    rise = (half / CONFIDENCE) ** 2 / size * CONFIDENCE**2
    low, high = problem.bounds(state)
    held = HELD / size
    ends = []
    for sign in (-1.0, 1.0):
        step, end = sign * half, value + sign * half
        for _ in range(TRIES):
            goal = value + step

            def normal(at: FloatArray, goal: float = goal) -> Normal:
                cost, gradient, gram = problem.normal(state.at(at))
                off, by = _off(state.at(at), of, goal)
                return (
                    cost + held * off**2, gradient + held * off * by,
                    gram + held * np.outer(by, by),
                )  # fmt: skip

            def cost(at: FloatArray, goal: float = goal) -> float:
                off = of(values_of(state.at(at))) - goal
                return problem.cost(state.at(at)) + held * off**2

            first = np.clip(x + step * along / size, low, high)
            if not math.isfinite(cost(first)):
                break
            reached = minimised(
                normal, cost, first, (low, high), problem.count, enough=FINE, iterations=ITERATIONS
            ).x
            way = of(values_of(state.at(reached))) - value
            share = math.sqrt(max(problem.cost(state.at(reached)) - start, 0.0) / rise)
            if way * sign <= 0.0:
                break
            end = value + way / max(share, 1.0 / LONGEST)
            if abs(share - 1.0) < REACHED:
                break
            step = end - value
        ends.append(end)
    return ends[0], ends[1]


def values_of(state: State) -> dict[str, float]:
    """All parameters by name, and the resistance."""
    known = dict(zip(PARAMETERS, state.theta.tolist(), strict=True))
    return known | {"R": math.nan if state.resistance is None else state.resistance}


def slope_of(
    known: Values, of: Callable[[Values], float], names: list[str], spreads: FloatArray
) -> FloatArray:
    """Derivatives of a quantity with respect to the free parameters, (n,)."""
    slope = np.zeros(len(names))
    for j, name in enumerate(names):
        value = known[name]
        h = 1e-4 * abs(value) or max(min(1e-3 * float(spreads[j]), 1e-6), 1e-12)
        more, less = (of({**known, name: value + s * h}) for s in (1.0, -1.0))
        slope[j] = (more - less) / (2.0 * h)
    return slope


def _off(state: State, of: Callable[[Values], float], goal: float) -> tuple[float, FloatArray]:
    known, names = values_of(state), state.names()
    return of(known) - goal, slope_of(known, of, names, np.zeros(len(names)))
