"""Initial values of a motor's fit: regressions of smoothed signals, and effects over the turn."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, gram
from ..errors import DataError, FitError
from .estimation import filtered
from .problem import NOTHING, PLACE, WAVES, Problem, State
from .records import Piece, Records


def started(problem: Problem, terms: tuple[str, ...]) -> State:
    """The best of a few regressions, judged by free run."""
    first = tuple(t for t in ("lag", "delay", "coulomb", "offset") if t in terms)
    Ts = problem.records.Ts
    # a start needs no resistance, which only currents show
    alone = problem.without_currents()
    best, cost, signs = None, math.inf, []
    for width in (1.5, 5.0, 15.0, 45.0):
        smoothed = _smoothed(problem.records, width)
        for lag in (0.0, 5.0, 20.0) if "lag" in terms else (0.0,):
            for delay in (0, 2, 6) if "delay" in terms else (0,):
                k_v, k_a, k_s, offset = _regressed(smoothed, lag, delay)
                signs.append(k_v < 0.0 and k_a < 0.0)
                if not (k_a > 0.0 and k_v > -1e-3):
                    continue
                theta = NOTHING.copy()
                values = {
                    "k_e": k_v, "k_a": k_a, "tau": lag * Ts, "delay": delay * Ts,
                    "k_s": max(k_s, 0.0), "offset": offset,
                }  # fmt: skip
                for name, value in values.items():
                    theta[PLACE[name]] = value
                state = State(theta, None, first)
                of_this = alone.cost(state)
                if of_this < cost:
                    best, cost = state, of_this
    y = np.concatenate([p.y for p in problem.records.pieces])
    if best is None or not math.isfinite(cost):
        if np.mean(signs) > 0.5:
            raise DataError(
                "expected a speed that rises with the command, received one that falls; reverse "
                "the sign of one of them"
            )
        raise FitError(
            "expected a speed that follows the command as a motor's does, none of the starts is "
            "one; is the output a speed, and the input what drives the motor?"
        )
    problem.k_v = alone.k_v = max(float(best.theta[0]), 1e-12)
    best = alone.fitted(best)
    alone.settle_steps(best)
    explained = 1.0 - alone.cost(best) / max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
    if best.value("k_e") + best.value("k_b") < 0.0 or explained < 0.5:
        raise FitError(
            f"expected a speed that follows the command as a motor's does, received one of which "
            f"the free run explains {100 * max(explained, 0):.0f} %; is the output a speed, the "
            "input what drives the motor, and the loop free of a load that others move?"
        )
    problem.steps = alone.steps
    if problem.has_current:
        drives = [
            (d[p.used], p.current[p.used])
            for p, (_, d, _, _) in zip(
                problem.records.pieces, problem.simulated(best, ()), strict=True
            )
            if p.current is not None
        ]
        drive, i = (np.concatenate(c) for c in zip(*drives, strict=True))
        resistance = float(drive @ drive) / float(drive @ i) if float(drive @ i) > 0 else math.nan
        if not (math.isfinite(resistance) and resistance > 0):
            raise DataError(
                "expected a current that rises with the command, received one that does not; "
                "reverse its sign, or leave it out"
            )
        best = State(best.theta, resistance, best.terms)
    problem.weigh(best)
    return best


Smoothed: TypeAlias = tuple[FloatArray, FloatArray, NDArray[np.bool_]]
"""Smoothed command, (N,); smoothed speed, rate, sign and 1, (N, 4); whether it moves."""


def _smoothed(records: Records, width: float) -> list[Smoothed]:
    """Signals smoothed by a bell, and its derivative for theirs (Shinbrot 1957), if long enough."""
    half = math.ceil(3.0 * width)
    k = np.arange(-half, half + 1)
    bell = np.exp(-0.5 * (k / width) ** 2)
    bell /= bell.sum()
    slope = -k / width**2 * bell / records.Ts
    found = []
    for p in records.pieces:
        if len(p.u) <= 2 * half:
            continue
        smooth, rates = (np.convolve(p.y, taps, "valid") for taps in (bell, slope))
        moving = np.abs(smooth) > 1.5 * records.quantum
        sign = np.where(moving, np.sign(smooth), 0.0)
        columns = np.stack([smooth, rates, sign, np.ones_like(sign)], axis=1)
        found.append((np.convolve(p.u, bell, "valid"), columns, moving))
    return found


def _regressed(pieces: Sequence[Smoothed], lag: float, delay: int) -> FloatArray:
    """Regress `u = k_v w + k_a dw/dt + k_s sign w + offset`, with `u` lagged and delayed."""
    fade = np.exp(-np.arange(math.ceil(5 * lag) + 1) / lag) if lag else np.ones(1)
    rows, commands = [], []
    for u, columns, moving in pieces:
        if len(u) <= len(fade) + delay:
            continue
        padded = np.concatenate([np.full(len(fade) - 1 + delay, u[0]), u[: len(u) - delay]])
        late = np.convolve(padded, fade / fade.sum(), "valid")
        rows.append(columns[moving])
        commands.append(late[moving])
    if not rows or sum(map(len, rows)) < 20:
        return np.full(4, math.nan)
    A, b = np.concatenate(rows), np.concatenate(commands)
    if len({*np.sign(A[:, 2])}) < 2:  # one sign: friction and offset are not separable
        found = _solved(A[:, :3], b)
        return np.array([*found[:2], abs(found[2]), 0.0])
    return _solved(A, b)


def _solved(A: FloatArray, b: FloatArray) -> FloatArray:
    """Least squares with the columns scaled."""
    scale = np.sqrt(np.einsum("ij,ij->j", A, A))
    scale[scale == 0.0] = 1.0
    A = A / scale
    found: FloatArray = np.linalg.lstsq(gram(A), A.T @ b, rcond=None)[0] / scale
    return found


# --- Cogging and torque ripple --------------------------------------------------------------------


# Cogging and torque ripple: their orders per turn are found before their sizes are fitted.
#
# To first order, the effect of a load of one more order on the speed is a wave of the angle,
# filtered by the motor's lags. The residuals are regressed on each such wave together with the
# parameters of the fit (a score test, Rao 1948); the clearest wave is removed, and the search
# continues in the rest. The final fit with all of them decides which are kept.

HIGHEST = 60
"""Largest order per turn searched; the least is 3, as 1 and 2 have separate terms."""
CLEAR = 30.0
"""Least statistic of a wave, or a term, in squared standard errors. Among 118 waves of white noise
the largest reaches 30 once in 25,000 records."""
ABOVE_OTHERS = 2.0
"""Least statistic relative to the median of all waves, since the residuals are not white."""
PER_WAVE = 8
"""Least encoder counts per wave."""
DECAYED = 8.0
"""Length of a response in time constants."""
RIPPLE = "torque_ripple"


def with_waves(problem: Problem, state: State, terms: tuple[str, ...]) -> State:
    """The state with the waves that stand out of the residuals, at their estimated sizes."""
    free = [t for t in WAVES if t in terms]
    if not free:
        return state
    candidates = [
        (order, kind)
        for order in _orders(problem.records)
        for kind in dict.fromkeys(t if t == RIPPLE else "cogging" for t in free)
    ]
    if not candidates:
        return state
    moved = _moved(problem, state, candidates)
    left, slopes = _left_over(problem, state)
    basis = np.linalg.qr(slopes)[0]
    moved -= basis @ (basis.T @ moved)
    pairs = moved.T.reshape(len(candidates), 2, -1)
    orders, taken, values = list(state.orders), list[str](), dict[str, float]()
    while free:
        grams = pairs @ pairs.transpose(0, 2, 1)
        by = pairs @ left
        sizes = np.einsum("mij,mj->mi", np.linalg.pinv(grams, rcond=1e-8, hermitian=True), by)
        variance = max(float(left @ left) / max(problem.records.used, 1), 1e-300)
        gains = np.einsum("mi,mi->m", sizes, by) / variance
        open_ = np.array([any(_is_kind(t, kind) for t in free) for _, kind in candidates])
        best = int(np.argmax(np.where(open_, gains, 0.0)))
        if gains[best] < max(CLEAR, ABOVE_OTHERS * float(np.median(gains))) or not open_[best]:
            break
        order, kind = candidates[best]
        term = next(t for t in free if _is_kind(t, kind))
        free.remove(term)
        taken.append(term)
        orders[WAVES.index(term)] = order
        ends = ("_c", "_s") if term == RIPPLE else ("c", "s")
        values |= {term + end: float(v) for end, v in zip(ends, sizes[best], strict=True)}
        one = np.linalg.qr(pairs[best].T)[0]
        left = left - one @ (one.T @ left)
        pairs = pairs - (pairs @ one) @ one.T
    if not taken:
        return state
    widened = State(state.theta, state.resistance, state.terms, tuple(orders))
    return widened.having([*state.terms, *taken], **values)


def _left_over(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals of the speeds, (N,), and their derivatives, (N, n)."""
    left, slopes = [], []
    runs = problem.simulated(state, [n for n in state.names() if n != "R"])
    for p, (y, _, by, _) in zip(problem.records.pieces, runs, strict=True):
        left.append(filtered(p.y - y, p.used, problem.speed_filter))
        slopes.append(filtered(by.T, p.used, problem.speed_filter).T)
    return np.concatenate(left), np.concatenate(slopes)


def _is_kind(term: str, kind: str) -> bool:
    return (term == RIPPLE) == (kind == RIPPLE)


def _orders(records: Records) -> range:
    """Orders that the slower samples show above the noise of the encoder."""
    turns = np.concatenate([np.abs(np.diff(p.angle)) for p in records.pieces])
    moving = turns[turns > 0.0]
    if not len(moving):
        return range(0)
    highest = min(HIGHEST, int(0.5 * math.pi / max(float(np.quantile(moving, 0.1)), 1e-9)))
    if records.counts_per_rev is not None:
        highest = min(highest, int(records.counts_per_rev / PER_WAVE))
    return range(3, highest + 1)


def _moved(problem: Problem, state: State, candidates: list[tuple[int, str]]) -> FloatArray:
    """Changes of the whitened speeds due to cosine and sine of each wave, (N, 2 candidates)."""
    parts = []
    speeds, lag = _responses(state, problem.records.Ts, problem.speed_filter)
    drives = [drive for _, drive, _, _ in problem.simulated(state, ())]
    for p, drive in zip(problem.records.pieces, drives, strict=True):
        kernels = [speeds[: len(p.u)], lag[: len(p.u)]]
        size = 1 << (len(p.u) + sum(map(len, kernels))).bit_length()
        through, electrical = (np.fft.fft(k, size) for k in kernels)
        columns = []
        emf_of, waves = p.y * state.value("k_e"), _waves(p, problem.records.quantum)
        wave, at = next(waves), 1
        for order, kind in candidates:
            while at < order:
                wave, at = next(waves), at + 1
            if kind == RIPPLE:  # torque per current, and back-EMF behind the current's lag
                emf = np.fft.fft(wave * emf_of, size) * electrical
                force = np.fft.fft(wave * drive, size) - emf
            else:
                force = -np.fft.fft(wave, size)
            moved = np.fft.ifft(force * through)[: len(p.u)]
            columns += [moved.real, moved.imag]
        parts.append(np.stack(columns, axis=1))
    return np.concatenate(parts)


def _waves(p: Piece, quantum: float) -> Iterator[NDArray[np.complex128]]:
    """Waves of order 1, 2, .., averaged over each sample, complex for cosine and sine, (N,)."""
    turned = np.diff(p.angle, append=p.angle[-1:])
    once, half = np.exp(1j * (p.angle + 0.5 * turned)), np.exp(0.5j * turned)
    # at a standstill dry friction holds the shaft against any wave
    once[(turned == 0.0) & (np.abs(p.y) <= quantum)] = 0.0
    within = np.where(turned == 0.0, 1.0, turned)
    wave, edge = once, half
    for order in itertools.count(1):
        # sin(x)/x of half the angle, 1 at 0
        share = np.where(turned == 0.0, 1.0, 2.0 * edge.imag / (order * within))
        yield share * wave
        wave, edge = wave * once, edge * half


def _responses(state: State, Ts: float, taps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened speeds after a one-sample torque of 1 command; current after such a voltage."""
    k_v, k_a = max(state.theta[0] + state.theta[1], 1e-12), float(state.theta[PLACE["k_a"]])
    speeds = Ts / k_a * _decaying(Ts * k_v / k_a)
    lag = _decaying(min(Ts / max(state.value("tau"), 1e-9), 50.0))
    return np.convolve(np.concatenate([[0.0], speeds]), taps), lag / lag.sum()


def _decaying(rate: float) -> FloatArray:
    rate = max(rate, 1e-5)
    found: FloatArray = np.exp(-rate * np.arange(math.ceil(DECAYED / rate)))
    return found
