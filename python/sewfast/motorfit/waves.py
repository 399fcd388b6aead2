"""Cogging and torque ripple: how often they repeat per turn is found before their sizes are fitted.

What a load of one more order would do to the speed is, to first order, a wave of the angle through
the motor's own lags. What the fit leaves over is regressed on each such wave, beside the parameters
of the fit (a score test, Rao 1948); the clearest is taken out, and the search goes on in the rest.
The fit with all of them decides which are there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from .intervals import filtered
from .records import Piece
from .task import PLACE, WAVES, State, Task

HIGHEST = 60
"""Order per turn up to which is looked; the least is 3, as 1 and 2 have terms of their own."""
CLEAR = 30.0
"""Squared standard errors from which a wave, or a term, may be one. Of 118 waves of white noise the
largest has 30 once in 25,000 records."""
ABOVE_OTHERS = 2.0
"""Times the median of all waves: what is left over is not white, and all of them have some of it.
"""
PER_WAVE = 8
"""Counts of the encoder in a wave, at least."""
DECAYED = 8.0
"""Time constants after which a response is over."""
RIPPLE = "torque_ripple"


def with_waves(task: Task, state: State, terms: tuple[str, ...]) -> State:
    """With the waves that stand out of what is left over, as large as they seem to be."""
    free = [t for t in WAVES if t in terms]
    if not free:
        return state
    candidates = [
        (order, kind)
        for order in _orders(task)
        for kind in dict.fromkeys(t if t == RIPPLE else "cogging" for t in free)
    ]
    if not candidates:
        return state
    moved = _moved(task, state, candidates)
    left, slopes = _left_over(task, state)
    basis = np.linalg.qr(slopes)[0]
    moved -= basis @ (basis.T @ moved)
    pairs = moved.T.reshape(len(candidates), 2, -1)
    orders, taken, values = list(state.orders), list[str](), dict[str, float]()
    while free:
        grams = pairs @ pairs.transpose(0, 2, 1)
        by = pairs @ left
        sizes = np.einsum("mij,mj->mi", np.linalg.pinv(grams, rcond=1e-8, hermitian=True), by)
        variance = max(float(left @ left) / max(task.records.used, 1), 1e-300)
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


def _left_over(task: Task, state: State) -> tuple[FloatArray, FloatArray]:
    """What the fit leaves of the speeds, (N,), and its derivatives, (N, n), whitened."""
    left, slopes = [], []
    runs = task.simulated(state, [n for n in state.names() if n != "R"])
    for p, (y, _, by, _) in zip(task.records.pieces, runs, strict=True):
        left.append(filtered(p.y - y, p.used, task.speed_filter))
        slopes.append(filtered(by.T, p.used, task.speed_filter).T)
    return np.concatenate(left), np.concatenate(slopes)


def _is_kind(term: str, kind: str) -> bool:
    return (term == RIPPLE) == (kind == RIPPLE)


def _orders(task: Task) -> range:
    """Those of which the slower samples show more than noise of the encoder."""
    records = task.records
    turns = np.concatenate([np.abs(np.diff(p.angle)) for p in records.pieces])
    moving = turns[turns > 0.0]
    if not len(moving):
        return range(0)
    highest = min(HIGHEST, int(0.5 * math.pi / max(float(np.quantile(moving, 0.1)), 1e-9)))
    if records.counts_per_rev is not None:
        highest = min(highest, int(records.counts_per_rev / PER_WAVE))
    return range(3, highest + 1)


def _moved(task: Task, state: State, candidates: list[tuple[int, str]]) -> FloatArray:
    """Changes of the whitened speeds by cosine and sine of each wave, (N, 2 candidates)."""
    parts = []
    speeds, lag = _responses(state, task.records.Ts, task.speed_filter)
    drives = [drive for _, drive, _, _ in task.simulated(state, ())]
    for p, drive in zip(task.records.pieces, drives, strict=True):
        kernels = [speeds[: len(p.u)], lag[: len(p.u)]]
        size = 1 << (len(p.u) + sum(map(len, kernels))).bit_length()
        through, electrical = (np.fft.fft(k, size) for k in kernels)
        columns = []
        emf_of, waves = p.y * state.value("k_e"), _waves(p, task.records.quantum)
        wave, at = next(waves), 1
        for order, kind in candidates:
            while at < order:
                wave, at = next(waves), at + 1
            if kind == RIPPLE:  # torque per current, and back-EMF, which the current follows late
                emf = np.fft.fft(wave * emf_of, size) * electrical
                force = np.fft.fft(wave * drive, size) - emf
            else:
                force = -np.fft.fft(wave, size)
            moved = np.fft.ifft(force * through)[: len(p.u)]
            columns += [moved.real, moved.imag]
        parts.append(np.stack(columns, axis=1))
    return np.concatenate(parts)


def _waves(p: Piece, quantum: float) -> Iterator[NDArray[np.complex128]]:
    """Of order 1, 2, .. the mean over each sample, cosine and sine as one complex number, (N,)."""
    turned = np.diff(p.angle, append=p.angle[-1:])
    once, half = np.exp(1j * (p.angle + 0.5 * turned)), np.exp(0.5j * turned)
    # at a standstill dry friction holds the shaft, whatever the wave
    once[(turned == 0.0) & (np.abs(p.y) <= quantum)] = 0.0
    within = np.where(turned == 0.0, 1.0, turned)
    wave, edge = once, half
    for order in itertools.count(1):
        # the sine of half the angle over that, 1 for none
        share = np.where(turned == 0.0, 1.0, 2.0 * edge.imag / (order * within))
        yield share * wave
        wave, edge = wave * once, edge * half


def _responses(state: State, Ts: float, taps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened speeds after a torque of 1 command for a sample; current after such a voltage."""
    k_v, k_a = max(state.theta[0] + state.theta[1], 1e-12), float(state.theta[PLACE["k_a"]])
    speeds = Ts / k_a * _decaying(Ts * k_v / k_a)
    lag = _decaying(min(Ts / max(state.value("tau"), 1e-9), 50.0))
    return np.convolve(np.concatenate([[0.0], speeds]), taps), lag / lag.sum()


def _decaying(rate: float) -> FloatArray:
    rate = max(rate, 1e-5)
    found: FloatArray = np.exp(-rate * np.arange(math.ceil(DECAYED / rate)))
    return found
