"""What a turn does: the load over the shaft's angle, which no model of command and speed can hold.

Cams, cranks, an eccentric load and cogging push at the same angles turn after turn. What the first
closed loops leave unexplained is taken apart over the angle that the encoder shows, as a command
that would have had the same effect, and is put back where loops are simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble, Model
from ..recording import Recording
from .slow import Thinning

HARMONICS = 6
"""Of a turn that are told apart."""
WORTH_IT = 0.97
"""The load must bring what is unexplained on a recording that it was not taken from below this."""
SLOW = 0.5
"""Span of the moving mean that is taken away before [s]."""


@dataclass(frozen=True, eq=False)
class TurnLoad:
    """A command [V] over the angle: `sum_k a_k cos(k theta) + b_k sin(k theta)`.

    Attributes
    ----------
    cosine, sine : array, shape (HARMONICS,)
        [V]
    """

    cosine: FloatArray
    sine: FloatArray

    def at(self, turns: FloatArray) -> FloatArray:
        """The command [V] at these angles [turns]."""
        command: FloatArray = basis(turns) @ np.concatenate([self.cosine, self.sine])
        return command

    def along(self, r: FloatArray, Ts: float) -> FloatArray:
        """The command [V] of a machine that follows a reference [RPM], from angle 0."""
        return self.at(np.concatenate([[0.0], np.cumsum(r[:-1])]) * Ts / 60.0)

    @property
    def rms(self) -> float:
        """Over a turn [V]."""
        return float(np.sqrt(0.5 * (self.cosine @ self.cosine + self.sine @ self.sine)))


def basis(turns: FloatArray) -> FloatArray:
    """Cosines, then sines, of the harmonics of these angles; shape (N, 2 HARMONICS)."""
    angles = 2.0 * np.pi * turns[:, None] * np.arange(1, HARMONICS + 1)
    return np.hstack([np.cos(angles), np.sin(angles)])


def turn_load(
    ensemble: Ensemble,
    plant: Model,
    learned: Sequence[Recording],
    judge: Recording,
    k: int = 1,
) -> TurnLoad | None:
    """The load over the turn, where a recording that it was not taken from shows it too.

    Parameters
    ----------
    ensemble : Ensemble
        Its median's free run is what is explained.
    plant : Model
        From command to speed about a working speed: what a push does.
    learned, judge : Recordings
        To take it from, and to ask whether it is there.
    k : int
        Samples of the recordings in one of the models.
    """
    rows, rests = [], []
    for recording in learned:
        row, rest = _explained(ensemble, plant, recording, k)
        rows.append(row)
        rests.append(rest)
    solution, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(rests), rcond=1e-6)
    found = TurnLoad(solution[:HARMONICS], solution[HARMONICS:])
    row, rest = _explained(ensemble, plant, judge, k)
    left = rest - row @ solution
    return found if np.mean(left**2) < WORTH_IT**2 * np.mean(rest**2) else None


def _explained(
    ensemble: Ensemble, plant: Model, whole: Recording, k: int
) -> tuple[FloatArray, FloatArray]:
    """What each harmonic would do to the speed, and what the models leave unexplained [RPM].

    Both without what is slower than a few turns: friction that changes with warmth is no load over
    the turn.
    """
    thinning = Thinning(k)
    recording = thinning.recording(whole)
    turns = (whole.counts - whole.counts[0]) / whole.counts_per_rev
    core, zero = plant.core, np.zeros(plant.core.na)
    still = core.simulate(np.zeros((len(recording), 1)), zero)
    pushes = [np.ascontiguousarray(thinning.mean(c)[:, None]) for c in basis(turns).T]
    columns = [core.simulate(push, zero) - still for push in pushes]
    try:
        runs = np.array([m.simulate(recording.dataset(), init=0)[0] for m in ensemble.members])
    except FitError:
        return np.zeros((1, 2 * HARMONICS)), np.zeros(1)
    rest = recording.y - np.median(runs, axis=0)
    slow = max(3, round(SLOW / recording.Ts))
    rows = np.column_stack([_fast(c, slow) for c in columns])
    return rows, _fast(rest, slow)


def _fast(x: FloatArray, span: int) -> FloatArray:
    kernel = np.ones(span) / span
    weight = np.convolve(np.ones(len(x)), kernel, "same")
    return x - np.convolve(x, kernel, "same") / weight
