"""The ensemble: several networks from the same recordings, and which of them are fit to tune on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from ..dataset import Dataset
from ..errors import FitError
from ..evidence import ReportCard, check
from ..identification import identify
from ..identification.folds import thinned
from ..models import Ensemble, Model
from ..recording import Recording
from ..validation import validate
from .demands import Demands
from .refusal import require

WORST = 2.0
"""Members with a larger multiple of the best one's error on data not trained on are left out."""
LEAST_FIT = 85.0
"""Percent of the best member in free run on data not trained on."""
MOST_SAMPLES = 80_000
"""Trained on: of a slow machine blocks from all over its long recordings."""
CLOSE = 0.02
"""Of the span of that recording: members that are within it stay, whatever the best one does."""
DRAWN = 2
"""Networks that are trained for each one that is wanted."""


@dataclass(frozen=True, eq=False)
class Trained:
    """An ensemble with its errors.

    Attributes
    ----------
    ensemble : Ensemble
    rmse : tuple of float
        Of each member in free run on the recording to judge by [RPM].
    fit_percent : float
        Of the best one.
    dropped : int
        Members that were left out.
    card : ReportCard
        Of the best one on that recording.
    """

    ensemble: Ensemble
    rmse: tuple[float, ...]
    fit_percent: float
    dropped: int
    card: ReportCard

    def errors_of(self, some: Ensemble) -> tuple[float, ...]:
        """`rmse` of those members that are in `some`."""
        pairs = zip(self.ensemble.members, self.rmse, strict=True)
        return tuple(e for m, e in pairs if any(m is other for other in some.members))


def train(
    recordings: Sequence[Recording],
    judge: Recording,
    demands: Demands,
    progress: Callable[[int, int], object],
) -> Trained:
    """Train members that differ in their seeds; keep those that predict what they have not seen.

    Raises
    ------
    Refusal
        Where members differ too much, or none predicts.
    Interrupted
        On Ctrl-C.
    """
    data = thinned(Dataset.concat([r.dataset() for r in recordings]), MOST_SAMPLES)
    members = _members(data, demands, progress)
    require(
        bool(members),
        "expected networks that can be trained on the recordings, none could; see the recordings "
        "and `sewfast identify`",
    )
    held_out = judge.dataset()
    scores = [validate_member(m, held_out) for m in members]
    best = min(rmse for rmse, _ in scores)
    bound = max(WORST * best, CLOSE * float(np.ptp(judge.y)))
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


def validate_member(model: Model, data: Dataset) -> tuple[float, float]:
    """Error and fit of the free run from rest; infinite where it runs away."""
    try:
        found = validate(model, data, init=0).simulation
    except FitError:
        return float("inf"), -float("inf")
    return found.rmse, found.fit_percent


def _members(
    data: Dataset, demands: Demands, progress: Callable[[int, int], object]
) -> list[Model]:
    """Networks by seed, side by side; a Ctrl-C ends all of them.

    Twice as many are trained as are wanted, as some end in a poor minimum: the better half by the
    error on their own training data stays.
    """
    stopped = threading.Event()
    seeds = [demands.seed + i for i in range(DRAWN * demands.members)]
    done: list[Model | None] = [None] * len(seeds)

    def one(i: int) -> None:
        def look(*_: object) -> None:
            if stopped.is_set():
                raise InterruptedError

        try:
            done[i] = identify(
                data, model="neural_oe", starts=1, seed=seeds[i], threads=1, select=False,
                progress=look,
            )  # fmt: skip
        except (FitError, InterruptedError):
            return

    pool = ThreadPoolExecutor(min(demands.threads, len(seeds)))
    try:
        for i, future in enumerate([pool.submit(one, i) for i in range(len(seeds))]):
            future.result()
            progress(i + 1, len(seeds))
    except BaseException:
        stopped.set()
        # the evidence that follows a training cannot be stopped, nor is it waited for
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()
    trained = sorted((m for m in done if m is not None), key=lambda m: validate_member(m, data)[0])
    return trained[: demands.members]
