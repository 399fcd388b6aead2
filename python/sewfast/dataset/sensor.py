"""Stretches in which a sensor says nothing: it died, or a few samples stand out.

`rust/core/src/sensor.rs` finds them and says by which evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .. import _core

if TYPE_CHECKING:
    from .dataset import Dataset


@dataclass(frozen=True)
class Dead:
    """A stretch in which the output's sensor says nothing: samples `start` to `stop`, excluded.
    Samples are those of the file, 0-based; `experiment` is the index in the data set.
    """

    experiment: int
    start: int
    stop: int
    value: float


def dead_stretches(data: Dataset) -> tuple[Dead, ...]:
    """Stretches in which the output stands still while the rest says that it cannot."""
    return _stretches(data, _core.dead([(e.u, e.y) for e in data.experiments]))


def spikes(data: Dataset) -> tuple[Dead, ...]:
    """Short stretches of the output that have most of its power, while no input stands out."""
    return _stretches(data, _core.spikes([(e.u, e.y) for e in data.experiments]))


def _stretches(data: Dataset, found: list[list[tuple[int, int]]]) -> tuple[Dead, ...]:
    return tuple(
        Dead(i, e.start + first, e.start + first + count, float(e.y[first]))
        for i, (e, stretches) in enumerate(zip(data.experiments, found, strict=True))
        for first, count in stretches
    )


def measuring(data: Dataset) -> Dataset:
    """The data without spikes, and then without dead stretches, as `identify` takes them."""
    data = alive(data, spikes(data))
    return alive(data, dead_stretches(data))


def alive(data: Dataset, dead: Sequence[Dead]) -> Dataset:
    """The data without these dead stretches."""
    if not dead:
        return data
    masks = [np.zeros(len(e), dtype=np.bool_) for e in data.experiments]
    for d in dead:
        start = data.experiments[d.experiment].start
        masks[d.experiment][d.start - start : d.stop - start] = True
    return data.mask(masks, why="that no plant has left out")
