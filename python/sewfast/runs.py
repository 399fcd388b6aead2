"""Runs of one value in a column: gaps, and the pieces between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def runs(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    """First index and length of each run of True in a mask of shape (N,).

    Examples
    --------
    >>> runs(np.array([True, True, False, True]))
    ((0, 2), (3, 1))
    """
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return tuple((int(a), int(b - a)) for a, b in edges.reshape(-1, 2))
