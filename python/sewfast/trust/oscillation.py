"""`Oscillation`: does a loop swing by itself where its reference is constant?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..control.loop import ClosedLoopRun
from ..dataset import FloatArray
from ..units import REVOLUTIONS_PER_SECOND

SETTLING = 0.4
"""Part of a constant stretch that belongs to what came before."""
LEAST_SAMPLES = 100
"""Of what is judged of a stretch: less says nothing about what lasts."""
LEAST_PERIODS = 5.0
LASTING = 0.5
"""Second half over first half [rms] from which on an oscillation does not die away."""
SHAFT_ORDERS = (1, 2, 3, 4)
LEAST_TURNS = 3.0
"""Periods of an order within a stretch from which on it can be told from a trend."""


@dataclass(frozen=True)
class Oscillation:
    """What a loop does at constant reference, at the stretch where it swings most.

    Attributes
    ----------
    command, output : float
        Rms about a straight line, without what repeats with the shaft's turn [u], [y].
    swing : float
        `command` over half the command's range (where it has none: over its largest size).
    ripple : float
        `output` over the largest reference.
    level : float
        The constant reference [y].
    hertz : float
        Mean frequency, from crossings of the mean.
    lasts : bool
        At least `LEAST_PERIODS`, and not dying away.
    """

    command: float
    output: float
    swing: float
    ripple: float
    level: float
    hertz: float
    lasts: bool


def oscillation(run: ClosedLoopRun) -> Oscillation | None:
    """The worst oscillation of a run at constant reference; None where no stretch is long enough.

    A limit cycle is an oscillation of the loop's own making that lasts: neither the way to a new
    level, nor a swing that dies away, nor the answer to a load that repeats with the shaft's turn.
    So the first `SETTLING` of each constant stretch is left out, the rest is freed of a straight
    line and, where the output is a speed, of the shaft's orders `SHAFT_ORDERS`. What the encoder's
    steps and noise put into the command stays in: it is told from a limit cycle by its size.

    Parameters
    ----------
    run : ClosedLoopRun
    """
    found = [_of(run, part) for part in _constant(run)]
    return max(found, key=lambda o: (o.lasts, o.swing + o.ripple), default=None)


def _constant(run: ClosedLoopRun) -> Iterator[slice]:
    """The judged parts of the stretches of constant reference without missing samples."""
    known = np.isfinite(run.u) & np.isfinite(run.y)
    still = np.concatenate([[False], np.diff(run.r) == 0.0]) & known
    still[1:] &= known[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    for start, stop in edges.reshape(-1, 2).tolist():
        first = start + math.ceil(SETTLING * (stop - start))
        if stop - first >= LEAST_SAMPLES:
            yield slice(first, stop)


def _of(run: ClosedLoopRun, part: slice) -> Oscillation:
    forced = _forced(run, part)
    u, y = (_without(values[part], forced) for values in (run.u, run.y))
    command, output = _rms(u), _rms(y)
    swing = command / max(_half_range(run), 1e-300)
    ripple = output / max(float(np.abs(run.r).max()), 1e-300)
    main = u if swing >= ripple else y
    periods = 0.5 * np.count_nonzero(np.diff(np.signbit(main)))
    half = len(main) // 2
    lasts = periods >= LEAST_PERIODS and _rms(main[half:]) >= LASTING * _rms(main[:half])
    hertz = periods / (len(main) * run.Ts)
    return Oscillation(
        command, output, swing, ripple, float(run.r[part][0]), float(hertz), bool(lasts)
    )


def _forced(run: ClosedLoopRun, part: slice) -> FloatArray:
    """What may be taken off, as columns: a straight line and the shaft's orders, shape (n, c)."""
    n = part.stop - part.start
    columns = [np.ones(n), np.linspace(-1.0, 1.0, n)]
    per_unit = REVOLUTIONS_PER_SECOND.get(run.units["y"].lower())
    if per_unit is not None:
        turns = np.cumsum(run.y[part]) * per_unit * run.Ts
        travelled = abs(float(turns[-1] - turns[0]))
        for order in SHAFT_ORDERS:
            if order * travelled >= LEAST_TURNS:
                angle = 2.0 * np.pi * order * turns
                columns += [np.cos(angle), np.sin(angle)]
    return np.column_stack(columns)


def _without(values: FloatArray, columns: FloatArray) -> FloatArray:
    found: FloatArray = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return found


def _half_range(run: ClosedLoopRun) -> float:
    c = run.controller
    half = 0.5 * (c.u_max - c.u_min)
    return half if math.isfinite(half) else float(np.nanmax(np.abs(run.u)))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
