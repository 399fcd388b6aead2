"""Which terms of a motor a record shows: all are fitted together, then those that it does show.

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
from .intervals import inverse
from .records import Records
from .starts import started
from .task import FINE, NEAR, TERMS, WAVES, State, Task, fitted, least_inertia
from .waves import CLEAR, with_waves

ORDERS = {"load_1": 1, "load_2": 2, "inertia_2": 2}
"""How often a term repeats in a turn."""
SHAPES = {"ripple", "w_s"}
"""Parameters that say how a term goes, not how large it is."""
SHAPED = {"drop", "stribeck"}
"""Terms that have one."""
ALWAYS = {"delay", "limit", "coulomb"}
"""Terms that stay: a delay of nothing is an answer, a limit has a test of its own, and without dry
friction, which every motor has, k_v would take its place unnoticed."""

SHOWN = 1.0
"""Wald's statistic of a single parameter from which its term stays: one that is larger than its
standard deviation makes the others worse by its absence than by its uncertainty (Toro-Vizcarrondo
and Wallace 1968, JASA 63). Whether it is printed is a question of its own interval."""
SURE = 16.0
"""The same of a term that is fitted only where it stands out."""
UNEXPLAINED = 0.005
"""Share of the speed's variance, from which a limit is looked for with all parameters free."""
LIMITED = 0.9
"""Of the cost without, that a limit of the current has to fall below."""
STRETCH = 10_000
"""Samples on which the way is found; all of them then have their say. Of 20 s at 1 kHz, 5,000 end
in another minimum for 1 of 60 machines, 2,500 for 1 of 8; all 20,000 gain nothing."""
BUMPS = (0.02, 0.06)
"""Of the usual speed, at which Stribeck's friction is tried to fall off."""
ON_THE_WAY = 8
"""Integration steps per sample at most, until the terms are settled: a motor far faster than its
samples takes 64, of which the parameters move by a few per cent of an answer that is not final."""
WORSE = 1.1
"""Times the free-run error that a whitened fit may have over a plain one."""


@dataclass(frozen=True, eq=False)
class Estimated:
    """What a record says of a motor.

    Attributes
    ----------
    state : State
        All parameters at the least squares, and the terms that are shown.
    covariance : array, shape (n, n)
        Of what is free in the state.
    reasons : mapping of str by name
        Terms, and the inertia, that the record does not show, and why.
    records : Records
        With the starts that were settled and the spikes that were left out.
    task : Task
        What was compared.
    """

    state: State
    covariance: FloatArray
    reasons: dict[str, str]
    records: Records
    task: Task


def estimated(
    records: Records,
    terms: tuple[str, ...],
    look: Callable[[], object] = lambda: None,
    *,
    if_clear: tuple[str, ...] = (),
) -> Estimated:
    """The parameters, and which of the terms the records show.

    Terms in `if_clear` are fitted where what is left over without them shows them clearly. `look`
    is called from time to time; what it raises ends the fit.

    Raises
    ------
    DataError
        If the speed falls as the command rises.
    FitError
        If nothing converges to a motor.
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
    part = records.liveliest(STRETCH)
    first = Task(part, look=look)
    state = fitted(first, started(first, terms))
    steps, first.steps = first.steps, min(first.steps, ON_THE_WAY)
    if not math.isfinite(first.cost(state)):  # so few overshoot: no record shows its inertia
        first.steps = steps
    first.settle_starts(state)
    first.leave_out_spikes(state)
    state = _with_limit(first, fitted(first, state), terms)
    first.leave_out_spikes(state)
    state = _all_terms(first, state, tuple(t for t in terms if t not in WAVES))
    given = terms
    state = _with_clear(first, state, if_clear)
    true = functools.partial(_trued, c=state.value("eccentric_c"), s=state.value("eccentric_s"))
    first.records = true(first.records)
    before, state = state, with_waves(first, state, terms)
    if state is not before:  # what hid behind the waves may be clear now
        state = fitted(first, state)
        first.weigh(state)
        state = _with_clear(first, state, if_clear)
    terms = tuple(t for t in TERMS if t in (*terms, *state.terms))
    needed = {t: SHOWN if t in given and t not in WAVES else SURE for t in terms}
    # with the starts that were settled, where they are the same
    records = first.records if part is records else true(records)
    task = Task(records, first.steps, k_v=first.k_v, look=look)
    task.settle_starts(state)
    task.leave_out_spikes(state)
    state, shares, covariance = _shown_terms(task, state, needed, steps)
    reasons |= {
        t: f"not shown, if there is any (Wald's statistic {share:.2g}, it takes {needed[t]:g})"
        for t, share in shares.items()
        if t in given and (t not in WAVES or state.orders[WAVES.index(t)])
    }
    missing = "no wave over the turn stands out from what is left over"
    if set(WAVES[:3]) <= set(terms) and not any(state.orders[:3]):
        reasons["cogging"] = missing
    if WAVES[3] in terms and not state.orders[3]:
        reasons["torque_ripple"] = missing
    if state.value("k_a") <= 1.01 * least_inertia(task, state) or task.is_slow(state):
        reasons["inertia"] = (
            "the record does not show how the motor speeds up; record steps, several samples in "
            "each of its time constants"
        )
    records = replace(task.records, spikes=records.spikes + first.spikes + task.spikes)
    return Estimated(state, covariance, reasons, records, task)


def _trued(records: Records, *, c: float, s: float) -> Records:
    """With angles of the shaft in place of those that an eccentric encoder shows.

    A wave of order n would else have sidebands at n - 1 and n + 1.
    """
    if c == 0.0 and s == 0.0:
        return records
    pieces = [
        replace(p, angle=p.angle - c * np.sin(p.angle) + s * np.cos(p.angle))
        for p in records.pieces
    ]
    return replace(records, pieces=tuple(pieces))


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
    found = min((fitted(task, s) for s in tried), key=task.cost)
    return found if task.cost(found) < LIMITED * before else state


def _all_terms(task: Task, state: State, terms: tuple[str, ...]) -> State:
    """All terms fitted together, roughly."""
    size = max(state.value("k_s"), 0.01 * float(np.std(task.records.pieces[0].u)))
    _, fast = task.stribeck_speeds()
    starts = {
        "drop": 0.2 * size, "ripple": 0.2 * size, "k_t": 0.2 * size, "w_s": 0.1 * fast,
    }  # fmt: skip
    whole = [t for t in terms if t != "limit" or "limit" in state.terms]
    new = {p for t in set(whole) - set(state.terms) for p in TERMS[t]}
    state = state.having(whole, **{p: v for p, v in starts.items() if p in new})
    state = fitted(task, state)
    task.weigh(state)
    tried = [fitted(task, state)]
    if "stribeck" in whole:  # the speed at which friction falls off has more than one minimum
        bumps = [state.having(whole, k_t=0.4 * size, w_s=part * fast) for part in BUMPS]
        tried += [fitted(task, s) for s in bumps]
    return min(
        [*tried, state], key=lambda s: (task.rmse(s) > WORSE * task.rmse(state), task.cost(s))
    )


def _with_clear(task: Task, state: State, terms: tuple[str, ...]) -> State:
    """With those of the terms that what is left over shows clearly, one after the other."""
    while clear := _clear(task, state, terms):
        state = fitted(task, state.having([*state.terms, *clear]))
        task.weigh(state)
    return state


def _clear(task: Task, state: State, terms: tuple[str, ...]) -> list[str]:
    """Those without which the fit is clearly worse, by their scores (Rao 1948)."""
    bumpy = "stribeck" in state.terms and _parts_sides(task, state.value("w_s"))
    tried = [t for t in terms if t not in state.terms and (bumpy or t != "stribeck_difference")]
    if not tried:
        return []
    whole = state.having([*state.terms, *tried])
    cost, gradient, matrix = task.normal(whole)
    names, variance, clear = whole.names(), max(cost / task.count, 1e-300), []
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


def _parts_sides(task: Task, w_s: float) -> bool:
    """Whether friction that falls off over this speed [rad/s] can show its own in each direction.

    Slower, there is no sample to show it; faster, the difference is a constant load.
    """
    least, usual = task.stribeck_speeds()
    return max(2.0 * least, task.records.quantum) <= w_s <= 0.3 * usual


def _shown_terms(
    task: Task, start: State, needed: Mapping[str, float], steps: int
) -> tuple[State, dict[str, float], FloatArray]:
    """All terms fitted together, then without those that are not shown, in as many steps as needed.

    `needed` has the statistic from which each stays. Returns the state, the statistics of the terms
    left out, and the covariance of what is free. It counts in that a dead zone or Stribeck's
    friction which is not shown may still be there, hidden in the resistance or in dry friction.
    """
    task.weigh(start)
    state = fitted(task, start, NEAR)
    if task.rmse(state) > WORSE * task.rmse(start):
        task.weigh(start, order=0)
        state = fitted(task, start, NEAR)
    _, fast = task.stribeck_speeds()
    explained: dict[str, float] = {}
    whole = task.covariance(state)
    kept, out = list(state.terms), {t: 0.0 for t in needed if t not in state.terms}
    names, covariance, x = state.names(), whole, state.vector()
    while True:
        wald = {t: _wald(t, names, x, covariance) for t in kept if t not in ALWAYS}
        shown = {t: max(v, explained.get(t, 0.0)) for t, v in wald.items()}
        if "stribeck" in kept and x[names.index("w_s")] > 0.99 * fast:
            shown["stribeck"] = 0.0  # it falls off nowhere: that is Coulomb's friction
        if "stribeck_difference" in kept:
            if not _parts_sides(task, x[names.index("w_s")]):
                shown["stribeck_difference"] = 0.0
            shown["stribeck"] = math.inf  # the difference has its shape, and goes first
        weakest = min(shown, key=lambda t: shown[t] / needed[t], default=None)
        if weakest is None or shown[weakest] >= needed[weakest]:
            break
        if weakest in SHAPED and shown[weakest] > 0.0 and weakest not in explained:
            explained[weakest] = _explained(task, state, weakest, whole)
            continue
        out[weakest] = shown[weakest]
        kept.remove(weakest)
        names, x, covariance = _without(TERMS[weakest], names, x, covariance)
    task.steps = steps
    last = fitted(task, state.having(kept), FINE)
    hidden = [t for t in state.terms if t in SHAPED and t not in kept]
    shapes = {p: state.value(p) for t in hidden for p in TERMS[t] if p in SHAPES}
    wider = last.having([*kept, *hidden], **shapes)
    at = [wider.names().index(n) for n in last.names()]
    return last, out, task.covariance(wider)[np.ix_(at, at)]


def _explained(task: Task, state: State, term: str, covariance: FloatArray) -> float:
    """The deviance of a fit without a term, over what errors of this colour would give.

    Where a shape is vague the amplitude is too, whatever the term explains: Wald's statistic is
    then a poor one (Chandler and Bate 2007, Biometrika 94, for the factor).
    """
    cost, _, matrix = task.normal(state)
    variance = max(cost / task.count, 1e-300)
    at = next(j for j, n in enumerate(state.names()) if n in TERMS[term] and n not in SHAPES)
    white = inverse(matrix)[0][at, at] * variance
    without = fitted(task, state.having([t for t in state.terms if t != term]))
    deviance = (task.cost(without) - cost) / variance
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
