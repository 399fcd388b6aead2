"""The ensemble: several networks from the same recordings, those that predict well enough."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ..dataset import Dataset, Experiment
from ..dataset.pieces import thinned
from ..dataset.sensor import measuring
from ..errors import FitError
from ..evidence import ReportCard, check, with_training_evidence
from ..identification import seeded
from ..identification.folds import later_part
from ..identification.task import wrap
from ..models import Ensemble, LinearOE, Model
from ..recording import Recording
from ..rules import Fopdt
from ..validation import validate
from .demands import Demands, require
from .small_signal import SIZE, fitted, simplest

LEAST_FIT = 85.0
"""Least fit of the best member in free run on held-out data [%]."""
MOST_SAMPLES = 80_000
"""Most training samples; from longer recordings, blocks spread over them are used."""


@dataclass(frozen=True, eq=False)
class Trained:
    """An ensemble with its errors: the `rmse` of each member in free run on the held-out recording
    [RPM], and for the best one its `fit_percent` and its report `card` on that recording. `dropped`
    is the number of members left out.
    """

    ensemble: Ensemble
    rmse: tuple[float, ...]
    fit_percent: float
    dropped: int
    card: ReportCard

    def errors_of(self, some: Ensemble) -> tuple[float, ...]:
        """`rmse` of the members in `some`."""
        pairs = zip(self.ensemble.members, self.rmse, strict=True)
        return tuple(e for m, e in pairs if any(m is other for other in some.members))


def train(
    recordings: Sequence[Recording],
    judge: Recording,
    demands: Demands,
    progress: Callable[[int, int], object],
) -> Trained:
    """Train members with different seeds; keep those that predict held-out data.
    Raises `Refusal` if no network can be trained, or the best one does not predict well enough, and
    `Interrupted` on Ctrl-C.
    """
    data = thinned(_measured(recordings), MOST_SAMPLES)
    members = _members(data, demands, progress)
    require(
        bool(members),
        "expected networks that can be trained on the recordings, none could; see the recordings "
        "and `sewfast identify`",
    )
    held_out = _measured([judge])
    scores = [validate_member(m, held_out) for m in members]
    best = min(rmse for rmse, _ in scores)
    # who errs by twice as much as the best on held-out data is left out, but not within .02 of the
    # recording's span
    bound = max(2.0 * best, 0.02 * float(np.ptp(judge.y)))
    ranked = sorted(range(len(scores)), key=lambda i: scores[i][0])
    kept = [i for i in ranked if scores[i][0] <= bound][: demands.members]
    fit = max(fit for _, fit in scores)
    require(
        fit >= LEAST_FIT,
        f"expected a free-run fit of {LEAST_FIT:g} % or more on the recording {judge.name!r}, "
        f"which was not trained on, the best of {len(members)} networks has {fit:.1f} % "
        f"({best:.3g} RPM rms); see the recordings: a load that varied, a limit reached, a "
        "shaft that slips",
    )
    return Trained(
        Ensemble.of([members[i] for i in kept]),
        tuple(scores[i][0] for i in kept),
        fit,
        len(members) - len(kept),
        check(members[min(kept, key=lambda i: scores[i][0])], held_out),
    )


def _measured(recordings: Sequence[Recording]) -> Dataset:
    """The recordings without what no plant has left in them, as `identify` takes them."""
    return measuring(Dataset.concat([r.dataset() for r in recordings]))


def validate_member(model: Model, data: Dataset) -> tuple[float, float]:
    """Error and fit of the free run from rest; infinite if it diverges."""
    try:
        found = validate(model, data, init=0).simulation
    except FitError:
        return float("inf"), -float("inf")
    return found.rmse, found.fit_percent


def _members(
    data: Dataset, demands: Demands, progress: Callable[[int, int], object]
) -> list[Model]:
    """Networks by seed, trained in parallel; Ctrl-C ends all of them. Twice as many are trained as
    needed, as some end in a poor minimum; the better half by the error on the training data stays.
    """
    stopped = threading.Event()
    # networks trained for each member
    seeds = [demands.seed + i for i in range(2 * demands.members)]

    def look(*_: object) -> None:
        if stopped.is_set():
            raise InterruptedError

    pool = ThreadPoolExecutor(min(demands.threads, len(seeds)))
    try:
        train = pool.submit(seeded, data, progress=look).result()

        def one(seed: int) -> Model | None:
            try:
                return train(seed, look)
            except (FitError, InterruptedError):
                return None

        done: list[Model | None] = []
        for future in [pool.submit(one, seed) for seed in seeds]:
            done.append(future.result())
            progress(len(done), len(seeds))
        trained = [m for m in done if m is not None]
        trained.sort(key=lambda m: validate_member(m, data)[0])
        kept = list(pool.map(lambda m: with_training_evidence(m, data), trained[: demands.members]))
    except FitError:
        kept = []
    except BaseException:
        stopped.set()
        # the evidence that follows a training cannot be stopped: do not wait for it
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()
    return kept


# --- The linear rival: a model of another kind, from the same recordings --------------------------
#
# The search that fits networks can end in a poor minimum, and networks can bend anywhere outside
# the recorded range. A linear output-error model does neither. It replaces networks that fail, and
# gives a second opinion on gains tuned on them. Networks that agree are used without it: effects
# that it cannot represent, above all the current limit, would make the gains worse.


ORDERS = (1, 2, 3)
THINNED = (1,)
"""Orders of a model at every k-th sample: faster dynamics only appear as delay. For drive `slow10`,
order 3 fits no better (97.86 % instead of 97.87 %) and invents a pair of poles under which sound
gains have an Ms of 8."""
LINEAR = 1.25 * SIZE
"""Largest distance of the command from the one that holds the speed, as a share of the largest
command. The small signals reach `SIZE`; beyond it a drive that limits its current responds less.
With stretches beyond it, the free-run fit on the random levels is 1 % instead of 97 % (drive `weak`
of benches/drives.py), with the pulses 18 to 38 % instead of 98.5 % (`lash`, `shaft60`); on drives
that reach no limit (`nominal`, `heavy`) the cut makes no difference."""


@dataclass(frozen=True, eq=False)
class Rival:
    """A linear model with its errors on held-out data.

    Attributes
    ----------
    model : Model
    rmse : float
        Error in free run on the held-out recording [RPM].
    fit_percent : float
    """

    model: Model
    rmse: float
    fit_percent: float

    @property
    def is_fit(self) -> bool:
        """Whether it predicts as well as is required of networks."""
        return self.fit_percent >= LEAST_FIT

    def alone(self, judge: Recording) -> Trained:
        """An ensemble of this model alone, if networks fail."""
        return Trained(
            Ensemble.of([self.model]),
            (self.rmse,),
            self.fit_percent,
            0,
            check(self.model, _measured([judge])),
        )


def linear_rival(
    recordings: Sequence[Recording],
    judge: Recording,
    fopdt: Fopdt,
    demands: Demands,
    orders: Sequence[int] = ORDERS,
) -> Rival | None:
    """The simplest linear model of the stretches in which the drive is linear; None if none can be
    fitted. `judge` is the held-out recording, `fopdt` gives the command that holds a speed, and the
    order is one of `orders`.
    """
    whole, reach = _measured(recordings), LINEAR * demands.u_max
    pairs = zip(recordings, whole.experiments, strict=True)
    found = [part for r, e in pairs for part in _stretches(r, e, fopdt, reach)]
    if not found:
        return None
    data = thinned(replace(whole, experiments=tuple(found)), MOST_SAMPLES)
    part = later_part(data)
    if part is None:
        return None
    tried = {order: fitted(part, order) for order in orders}
    fits = {order: fit for order, fit in tried.items() if fit is not None}
    if not fits:
        return None
    model = wrap(LinearOE, fits[simplest(fits)][0], data)
    rmse, fit = validate_member(model, _measured([judge]))
    return Rival(model, rmse, fit)


def _stretches(
    recording: Recording, experiment: Experiment, fopdt: Fopdt, reach: float
) -> list[Experiment]:
    """The stretches with the command within `reach` [V] of the one that holds the speed."""
    holding = (recording.y - fopdt.offset) / fopdt.K
    near = np.concatenate([[False], np.abs(recording.u - holding) <= reach, [False]])
    begins, ends = np.flatnonzero(np.diff(near)).reshape(-1, 2).T
    runs = zip(begins, ends, strict=True)
    # least samples of a stretch: in shorter ones the initial state dominates
    return [experiment.cut(int(a), int(b)) for a, b in runs if b - a >= 200]
