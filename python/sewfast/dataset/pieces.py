"""Parts of a data set: ranges, fractions, what lies between gaps."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError, SettingError
from ..runs import runs

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment

SHORTEST_PIECE = 100
"""Samples between two gaps that `Dataset.split_at_gaps` keeps at least."""


def take(data: Dataset, text: str) -> Dataset:
    """`"A:B"` of every experiment, 0-based, end excluded; A or B may be left out.

    Raises
    ------
    SettingError
        Where the text is not a range.
    DataError
        Where the range leaves an experiment or is empty.
    """
    pieces = (e.cut(*range_of_text(text, e)) for e in data.experiments)
    return replace(data, experiments=tuple(pieces))


def range_of_text(text: str, e: Experiment) -> tuple[int, int]:
    """First sample and end of `"A:B"` in an experiment; refuses as `Dataset.slice` does."""
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", text)
    if match is None:
        raise SettingError(
            f"expected a range A:B, 0-based, end excluded, such as 0:400; received {text!r}"
        )
    start, stop = int(match[1] or 0), int(match[2]) if match[2] else len(e)
    if not 0 <= start < stop <= len(e):
        raise DataError(
            f"{e.name}: expected a range inside 0:{len(e)} with at least one sample, received "
            f"{start}:{stop}"
        )
    return start, stop


def split(data: Dataset, fraction: float) -> tuple[Dataset, Dataset]:
    """The first `fraction` of every experiment, and the rest of it.

    Raises
    ------
    SettingError
        Where the fraction is not between 0 and 1.
    DataError
        Where an experiment is too short to leave samples on both sides.
    """
    if not 0.0 < fraction < 1.0:
        raise SettingError(f"expected a fraction between 0 and 1, received {fraction}")
    at = [round(fraction * len(e)) for e in data.experiments]
    first = tuple(e.cut(0, k) for e, k in zip(data.experiments, at, strict=True))
    rest = tuple(e.cut(k, len(e)) for e, k in zip(data.experiments, at, strict=True))
    return replace(data, experiments=first), replace(data, experiments=rest)


def split_at_gaps(
    data: Dataset, shortest: int = SHORTEST_PIECE, *, of: Literal["any", "inputs"] = "any"
) -> Dataset:
    """The pieces without NaN between the gaps, each as an experiment of its own.

    Only a gap in an input needs this: models run through gaps in the output, which have no weight.

    Parameters
    ----------
    shortest : int
        Samples that a piece must have; shorter ones are left out, which `notes` says. The
        initial state alone takes 20.
    of : {"any", "inputs"}
        Whether a gap in the output parts an experiment, or only one in an input.

    Raises
    ------
    SettingError
        Where `shortest` is no whole number above 0, or `of` is neither of the two.
    DataError
        Where no piece is left.
    """
    if isinstance(shortest, bool) or not isinstance(shortest, int) or shortest < 1:
        raise SettingError(f"shortest: expected a number of samples above 0, got {shortest!r}")
    if of not in ("any", "inputs"):
        raise SettingError(f"of: expected 'any' or 'inputs', received {of!r}")
    pieces = [(e, a, n) for e in data.experiments for a, n in runs(_without_gap(e, of))]
    kept = tuple(e.cut(a, a + n) for e, a, n in pieces if n >= shortest)
    if not kept:
        longest = max((n for _, _, n in pieces), default=0)
        raise DataError(
            f"{data.source}: expected a piece of at least {shortest} samples without a gap, "
            f"received {longest} at most; record again, or lower `shortest`"
        )
    dropped = tuple(
        f"{e.name}: samples {e.start + a}:{e.start + a + n} between gaps are left out, fewer "
        f"than {shortest}"
        for e, a, n in pieces
        if n < shortest
    )
    return replace(data, experiments=kept, notes=(*data.notes, *dropped))


def _without_gap(e: Experiment, of: str) -> NDArray[np.bool_]:
    return e.measured if of == "any" else e.known_inputs
