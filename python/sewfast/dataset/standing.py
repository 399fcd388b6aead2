"""The level at which a record stands still before its inputs first move."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .experiment import without_weightless
from .outliers import white_noise

if TYPE_CHECKING:
    from .experiment import Experiment

SIGMAS = 3.0
"""Standard errors beyond which a drift, or a level, is not noise."""


@dataclass(frozen=True)
class Standing:
    """The samples of an experiment before its inputs first move, if its output stood still.
    `samples` is their number, `y` the mean output; `near_zero` says that the inputs are zero and
    noise explains the difference of `y` from zero. `scatter` is the standard deviation of the
    outputs, of the whole record's white noise at least.
    """

    samples: int
    u: tuple[float, ...]
    y: float
    scatter: float
    near_zero: bool = False


def standing(experiment: Experiment) -> Standing | None:
    """The standing samples at the beginning of an experiment; None if there are none.
    The inputs keep their first values, and the output has at least three measured samples whose
    drift is explained by noise.
    """
    rounding = 1e-9
    e = without_weightless(experiment)
    moved = (e.u != e.u[0]).any(axis=1)
    if not moved.any():
        return None
    n = int(np.argmax(moved))
    k = np.flatnonzero(np.isfinite(e.y[:n]))
    # fewest measured outputs by which a drift can be told from noise
    if len(k) < 3:
        return None
    y, spread = e.y[k], float(np.nanmax(e.y) - np.nanmin(e.y))
    about = k - k.mean()
    slope = float(about @ (y - y.mean()) / (about @ about))
    # the noise of the whole record: that of a few samples is known too badly to see a drift
    white = white_noise(e.y)
    error = white / math.sqrt(float(about @ about))
    if abs(slope) > SIGMAS * error + rounding * spread / n:
        return None
    level = float(y.mean())
    u = tuple(float(v) for v in e.u[0])
    deviation = float(y.std(ddof=1))
    noise = deviation / math.sqrt(len(y))
    near = abs(level) <= _student(len(y) - 1) * noise + rounding * spread
    return Standing(n, u, level, max(deviation, white), near_zero=near and not any(u))


def _student(freedom: int) -> float:
    """`SIGMAS` of a normal distribution as a value of Student's (Wallace, 1959)."""
    z = SIGMAS * (8 * freedom + 3) / (8 * freedom + 1)
    return math.sqrt(freedom * math.expm1(z * z / freedom))
