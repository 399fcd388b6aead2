"""The linear rival: a model of another kind of the same drive, from recordings of the same hours.

Networks are fitted by a search that may end in a poor minimum, and they are free to bend where
nothing was recorded. A linear output-error model can do neither. It stands in where networks fail,
and gives a second opinion on gains that were tuned on them. It is not tuned on beside networks that
agree: what it cannot hold, the current limit above all, would cost the gains something on drives
whose networks are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..dataset import Experiment
from ..evidence import check
from ..identification.folds import folds, thinned
from ..identification.task import wrap
from ..models import Ensemble, LinearOE, Model
from ..recording import Recording
from ..rules import Fopdt
from .demands import Demands
from .small_signal import SIZE, fitted, simplest
from .training import LEAST_FIT, MOST_SAMPLES, Trained, validate_member

ORDERS = (1, 2, 3)
THINNED = (1,)
"""Of a model at every k-th sample: what is faster than that is the delay between its inputs. Of
drive `slow10` order 3 fits no better (97.86 % for 97.87 %) and makes up a pair of poles under which
sound gains have an Ms of 8."""
LINEAR = 1.25 * SIZE
"""Of the largest command: how far it may be from what holds the speed. The small signals reach
`SIZE`; beyond, a drive that limits its current answers less. With the stretches beyond it the
free-run fit on the random levels is 1 % instead of 97 % (drive `weak` of benches/drives.py), with
the pulses 18 to 38 % instead of 98.5 % (`lash`, `shaft60`); where no limit is reached (`nominal`,
`heavy`) the cut makes no difference."""
LEAST_RUN = 200
"""Samples of a stretch: shorter ones are all initial state."""


@dataclass(frozen=True, eq=False)
class Rival:
    """A linear model and how well it predicts what it was not fitted to.

    Attributes
    ----------
    model : Model
    rmse : float
        In free run on the recording to judge by [RPM].
    fit_percent : float
    """

    model: Model
    rmse: float
    fit_percent: float

    @property
    def is_fit(self) -> bool:
        """Whether it predicts as well as networks have to."""
        return self.fit_percent >= LEAST_FIT

    def alone(self, judge: Recording) -> Trained:
        """What is tuned on where networks cannot be."""
        return Trained(
            Ensemble.of([self.model]),
            (self.rmse,),
            self.fit_percent,
            0,
            check(self.model, judge.dataset()),
        )


def linear_rival(
    recordings: Sequence[Recording],
    judge: Recording,
    fopdt: Fopdt,
    demands: Demands,
    orders: Sequence[int] = ORDERS,
) -> Rival | None:
    """The simplest linear model of the stretches in which the drive is linear.

    Parameters
    ----------
    recordings : sequence of Recording
    judge : Recording
        Not learned from.
    fopdt : Fopdt
        Which command holds which speed.
    demands : Demands
    orders : sequence of int
        Tried.

    Returns
    -------
    Rival or None
        None where none can be fitted.
    """
    found = [part for r in recordings for part in _stretches(r, fopdt, LINEAR * demands.u_max)]
    if not found:
        return None
    whole = recordings[0].dataset()
    data = thinned(replace(whole, experiments=tuple(found)), MOST_SAMPLES)
    parts = folds(data)
    if not parts:
        return None
    tried = {order: fitted(parts[0], order) for order in orders}
    fits = {order: fit for order, fit in tried.items() if fit is not None}
    if not fits:
        return None
    model = wrap(LinearOE, fits[simplest(fits)][0], data)
    rmse, fit = validate_member(model, judge.dataset())
    return Rival(model, rmse, fit)


def _stretches(recording: Recording, fopdt: Fopdt, reach: float) -> list[Experiment]:
    """Where the command is within `reach` [V] of the one that holds the speed."""
    holding = (recording.y - fopdt.offset) / fopdt.K
    near = np.concatenate([[False], np.abs(recording.u - holding) <= reach, [False]])
    begins, ends = np.flatnonzero(np.diff(near)).reshape(-1, 2).T
    (experiment,) = recording.dataset().experiments
    runs = zip(begins, ends, strict=True)
    return [experiment.cut(int(a), int(b)) for a, b in runs if b - a >= LEAST_RUN]
