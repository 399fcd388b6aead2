"""Where a motor's fit starts: regressions of smoothed signals, judged by their free runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import DataError, FitError
from .records import Records
from .task import NOTHING, PLACE, State, Task, fitted


def started(task: Task, terms: tuple[str, ...]) -> State:
    """The best of a few regressions, by its free run."""
    first = tuple(t for t in ("lag", "delay", "coulomb", "offset") if t in terms)
    Ts = task.records.Ts
    best, cost, signs = None, math.inf, []
    for width in (1.5, 5.0, 15.0, 45.0):
        smoothed = _smoothed(task.records, width)
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
                of_this = _Speeds(task).cost(state)
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
    alone = _Speeds(task)
    task.k_v = alone.k_v = max(float(best.theta[0]), 1e-12)
    best = fitted(alone, best)
    alone.settle_steps(best)
    explained = 1.0 - alone.cost(best) / max(float(np.sum((y - y.mean()) ** 2)), 1e-300)
    if best.value("k_e") + best.value("k_b") < 0.0 or explained < 0.5:
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

    def __init__(self, task: Task) -> None:
        pieces = tuple(replace(p, current=None) for p in task.records.pieces)
        super().__init__(replace(task.records, pieces=pieces), task.steps, look=task.look)


Smoothed: TypeAlias = tuple[FloatArray, FloatArray, NDArray[np.bool_]]
"""Of a piece: command under the bell, (N,); speed, rate, sign and 1 beside it, (N, 4); moving."""


def _smoothed(records: Records, width: float) -> list[Smoothed]:
    """Signals under a bell of this width, of pieces that are longer.

    The bell's derivative stands for that of the speed (modulating functions, Shinbrot 1957).
    """
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
    """`u = k_v w + k_a dw/dt + k_s sign w + offset`, the command late by a lag and a delay."""
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
    if len({*np.sign(A[:, 2])}) < 2:  # one sign: friction and offset are one
        found = _solved(A[:, :3], b)
        return np.array([*found[:2], abs(found[2]), 0.0])
    return _solved(A, b)


def _solved(A: FloatArray, b: FloatArray) -> FloatArray:
    """Least squares of tall columns of one scale each."""
    scale = np.sqrt(np.einsum("ij,ij->j", A, A))
    scale[scale == 0.0] = 1.0
    A = A / scale
    found: FloatArray = np.linalg.lstsq(A.T @ A, A.T @ b, rcond=None)[0] / scale
    return found
