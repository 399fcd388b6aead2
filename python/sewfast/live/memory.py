"""`Memory`: the numbers of a feed's ring, in this process or shared with another one."""

from __future__ import annotations

import mmap
import os
import tempfile
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_COUNTERS = 4


@dataclass(frozen=True, eq=False)
class Memory:
    """A ring of samples.

    Attributes
    ----------
    counters : array of int64, shape (4,)
        Claimed, end, received, gaps.
    holds : array of int64, shape (size,)
        Which sample a place holds, so that a gap costs nothing when it is put; -1 for none.
    rows : array, shape (columns, size)
    """

    counters: NDArray[np.int64]
    holds: NDArray[np.int64]
    rows: NDArray[np.float64]

    @classmethod
    def own(cls, columns: int, size: int) -> Memory:
        """Empty, in this process."""
        return cls(
            np.zeros(_COUNTERS, dtype=np.int64),
            np.full(size, -1, dtype=np.int64),
            np.full((columns, size), np.nan),
        )

    @classmethod
    def mapped(cls, file: int, columns: int, size: int) -> Memory:
        """What is in a file that was made by `shared`."""
        buffer = mmap.mmap(file, 8 * (_COUNTERS + (1 + columns) * size))
        whole = np.frombuffer(buffer, dtype=np.int64, count=_COUNTERS + size)
        rows = np.frombuffer(buffer, dtype=np.float64, offset=8 * len(whole))
        return cls(whole[:_COUNTERS], whole[_COUNTERS:], rows.reshape(columns, size))

    def shared(self) -> tuple[int, Memory]:
        """A file without a name [descriptor] and the same numbers in it."""
        file = _nameless()
        os.ftruncate(file, 8 * (_COUNTERS + len(self.holds) + self.rows.size))
        made = Memory.mapped(file, *self.rows.shape)
        made.counters[:], made.holds[:], made.rows[:] = self.counters, self.holds, self.rows
        return file, made


def _nameless() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("sewfast-live")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
