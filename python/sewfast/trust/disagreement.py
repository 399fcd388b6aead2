"""`Disagreement`: how far members of an ensemble part under the same controller and reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun


@dataclass(frozen=True)
class Disagreement:
    """Members on one reference.

    Attributes
    ----------
    reference, plant : str
        The reference, and the member farthest from the median.
    plants : int
        How many were compared.
    rms : float
        Rms distance of that member's output from the median of all, sample by sample [y]; of two
        it is half of their distance.
    span : float
        Of the reference [y].
    """

    reference: str
    plant: str
    plants: int
    rms: float
    span: float

    @property
    def share(self) -> float:
        """`rms` over `span`."""
        return self.rms / max(self.span, 1e-300)


def disagreements(runs: Sequence[ClosedLoopRun]) -> tuple[Disagreement, ...]:
    """Runs of one controller over the same reference on several plants, compared.

    Parameters
    ----------
    runs : sequence of ClosedLoopRun
        Those that stand alone are not compared.
    """
    groups: dict[tuple[Controller, str, bytes], list[ClosedLoopRun]] = {}
    for run in runs:
        groups.setdefault((run.controller, run.reference, run.r.tobytes()), []).append(run)
    return tuple(_of(group) for group in groups.values() if len(group) > 1)


def _of(group: list[ClosedLoopRun]) -> Disagreement:
    y = np.array([run.y for run in group])
    middle = np.median(y, axis=0)
    known = np.isfinite(middle)
    rms = np.sqrt(np.mean(np.square(y - middle)[:, known], axis=1)) if known.any() else np.zeros(1)
    worst = int(np.argmax(rms))
    r = group[0].r
    return Disagreement(
        group[0].reference,
        group[worst].plant,
        len(group),
        float(rms[worst]),
        float(r.max() - r.min()) or float(np.abs(r).max()),
    )
