"""Unstable plants: what a closed loop held, and no free run can."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .. import _core
from ..errors import SewfastError

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment

ORDER = 20
"""Orders of the equation-error model. Of 200 unstable plants in loops (`tests/dataset/
test_stability.py`) it shows 192, with 8 orders 165: noise of the measurement asks for many."""
GROWTH = 100.0
"""Growth over half a record from which it cannot come from an open loop. Integrators of 10 seeds of
the battery's families reach 8 by chance, all others less."""
TURN = 40.0
"""Fewest samples of a turn of the pole. Outputs that were smoothed or filtered in both directions
have quicker ones, which are no plant's. Of 576 records of the battery, plain and resampled, none
is called unstable; of 166 filtered in both directions over many samples, some are."""
_MOST = 20_000
"""Most samples of an experiment, from its beginning."""


def unstable_pole(data: Dataset) -> float | None:
    """Modulus of an unstable pole per sample; None if the record shows none.
    A bounded record of an unstable plant comes from a closed loop. There least squares of many
    orders is still consistent if a reference or a dither moves the loop (Ljung 1999, section 13.4).
    Both halves of a record have to show a pole that would have grown a hundredfold in open loop.
    """
    middles = [(e, min(len(e), _MOST) // 2) for e in data.experiments if len(e) > 1]
    halves = [e.cut(0, k) for e, k in middles], [e.cut(k, 2 * k) for e, k in middles]
    pole, growth = min((_largest_pole(half) for half in halves), key=lambda found: found[1])
    return pole if growth >= math.log(GROWTH) else None


def _largest_pole(experiments: Sequence[Experiment]) -> tuple[float, float]:
    """Modulus of the largest pole, and the logarithm of its growth over the mean experiment."""
    samples, none = sum(len(e) for e in experiments), (0.0, -math.inf)
    if not experiments:
        return none
    order = max(2, min(ORDER, samples // (10 * (1 + experiments[0].u.shape[1]))))
    try:
        fit = _core.fit_arx(
            [(e.u, e.y) for e in experiments], na=order, nb=order, nk=1, offset=True
        )
        poles = np.roots(np.concatenate([[1.0], fit.a]))
    except (SewfastError, np.linalg.LinAlgError):
        return none
    largest = poles[np.argmax(np.abs(poles))] if len(poles) else 0.0
    pole = float(np.abs(largest))
    if pole == 0.0 or abs(np.angle(largest)) > 2.0 * math.pi / TURN:
        return none
    return pole, samples / len(experiments) * math.log(pole)
