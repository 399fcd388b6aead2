"""Unstable plants: what a closed loop held, and no free run can."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .. import _core
from ..errors import DataError, FitError

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment

ORDER = 20
"""Orders of the equation-error model. Of 30 unstable plants in loops (`tests/dataset/
test_stability.py`) it shows all, with 8 orders 26: noise of the measurement asks for many."""
GROWTH = 100.0
"""Growth over half a record from which it cannot come from an open loop. Integrators of 10 seeds of
the battery's families reach 8 by chance, all other families less; the 30 unstable plants 140."""
_MOST = 20_000
"""Most samples of an experiment, from its beginning."""


def unstable_pole(data: Dataset) -> float | None:
    """Modulus of an unstable pole per sample; None if the record shows none.

    A bounded record of an unstable plant comes from a closed loop. There least squares of many
    orders is still consistent if a reference or a dither moves the loop (Ljung 1999, section 13.4).
    Both halves of a record have to show a pole that would have grown a hundredfold in open loop.
    """
    middles = [(e, min(len(e), _MOST) // 2) for e in data.experiments]
    halves = [e.cut(0, k) for e, k in middles], [e.cut(k, 2 * k) for e, k in middles]
    pole, growth = min((_largest_pole(half) for half in halves), key=lambda found: found[1])
    return pole if growth >= math.log(GROWTH) else None


def _largest_pole(experiments: Sequence[Experiment]) -> tuple[float, float]:
    """Modulus of the largest pole, and the logarithm of its growth over the mean experiment."""
    samples = sum(len(e) for e in experiments)
    order = max(2, min(ORDER, samples // (10 * (1 + experiments[0].u.shape[1]))))
    try:
        fit = _core.fit_arx(
            [(e.u, e.y) for e in experiments], na=order, nb=order, nk=1, offset=True
        )
        poles = np.roots(np.concatenate([[1.0], fit.a]))
    except (DataError, FitError, np.linalg.LinAlgError):
        return 0.0, -math.inf
    pole = float(np.abs(poles).max(initial=0.0))
    length = samples / len(experiments)
    return pole, length * math.log(pole) if pole > 0.0 else -math.inf
