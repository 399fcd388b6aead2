"""`Feed`: the newest samples of a running record, between the link's thread and a view's."""

from __future__ import annotations

import json
import math
import mmap
import os
import tempfile
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import DataError, SettingError
from ..units import counts_per_unit

# --- Memory: a feed's ring of samples, in this process or shared with another one -----------------


_COUNTERS = 4


@dataclass(frozen=True, eq=False)
class Memory:
    """A ring of samples. `counters` (4,) are claimed, end, received and gaps; `holds` (size,) is
    the number of the sample in each place, -1 for none, so that writing after a gap costs nothing;
    `rows` is (columns, size).
    """

    counters: NDArray[np.int64]
    holds: NDArray[np.int64]
    rows: NDArray[np.float64]

    @classmethod
    def own(cls, columns: int, size: int) -> Memory:
        """An empty ring in this process."""
        return cls(
            np.zeros(_COUNTERS, dtype=np.int64),
            np.full(size, -1, dtype=np.int64),
            np.full((columns, size), np.nan),
        )

    @classmethod
    def mapped(cls, file: int, columns: int, size: int) -> Memory:
        """The ring in a file made by `shared`."""
        buffer = mmap.mmap(file, 8 * (_COUNTERS + (1 + columns) * size))
        whole = np.frombuffer(buffer, dtype=np.int64, count=_COUNTERS + size)
        rows = np.frombuffer(buffer, dtype=np.float64, offset=8 * len(whole))
        return cls(whole[:_COUNTERS], whole[_COUNTERS:], rows.reshape(columns, size))

    def shared(self) -> tuple[int, Memory]:
        """The descriptor of an anonymous file, and a copy of this ring in it."""
        file = _anonymous_file()
        os.ftruncate(file, 8 * (_COUNTERS + len(self.holds) + self.rows.size))
        made = Memory.mapped(file, *self.rows.shape)
        made.counters[:], made.holds[:], made.rows[:] = self.counters, self.holds, self.rows
        return file, made


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("sewfast-live")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


# --- Speed from the change of counts over a window, without later samples -------------------------


def speed_over_window(counts: FloatArray, lag: int, Ts: float, counts_per_rev: float) -> FloatArray:
    """Mean speed [RPM] over the `lag` samples before each one, (N - lag,) from sample `lag` on.
    `counts` (N,) are accumulated, NaN where a sample is missing; `Ts` is in seconds; one count over
    the window is `60 / (lag Ts counts_per_rev)` RPM. The speed is NaN if a sample of the window is
    missing, because a device that was reset in the gap counts from another origin.
    """
    missing = np.concatenate(([0], np.cumsum(np.isnan(counts))))
    whole = missing[lag + 1 :] == missing[: len(counts) - lag]
    change = counts[lag:] - counts[: len(counts) - lag]
    scale = 1.0 / (lag * Ts * counts_per_unit(counts_per_rev))
    return np.where(whole, change * scale, np.nan)


# --- Feed: the newest samples of a running record, between the link's thread and a view's ---------


SPEED = "speed"
"""Name of the column that a feed derives from counts."""


_LEAST, _MOST = 4096, 131_072
"""Fewest and most samples kept of a column, at 8 bytes each."""


_CLAIMED, _END, _RECEIVED, _GAPS = range(4)


class Feed:
    """Hands samples from one thread to another; the first one never waits.

    `put` copies a batch into a ring of fixed size and returns; it takes no lock. Samples that a
    view has not read when the ring wraps around are lost to the view, never to the recording. Any
    number of views can read.

    Parameters
    ----------
    columns : mapping of str to str
        Name of each streamed column and its unit ("" for none). `u` is the command, `r` a
        reference, `counts` accumulated encoder counts.
    Ts : float
        Sample time [s].
    n : int or None
        Number of planned samples; None if unknown.
    title : str
        A short title of the record.
    counts_per_rev : float, optional
        With it and a column `counts`, the column `speed` [RPM] is derived; NaN if a sample of its
        window is missing.
    speed_window : float
        Window of that mean speed [s].

    Attributes
    ----------
    columns : dict of str to str
        Including the derived speed.
    window : int
        Samples that a plot spans: all planned ones of a short record, else the last seconds.
    closed : threading.Event
        Set when no more samples follow.

    Raises
    ------
    SettingError
        Without columns, or for a number outside its range.
    """

    def __init__(
        self,
        columns: Mapping[str, str],
        Ts: float,
        n: int | None,
        title: str,
        *,
        counts_per_rev: float | None = None,
        speed_window: float = 0.02,
    ) -> None:
        _require(bool(columns), "at least one column", "none", "name what is streamed")
        _require_above_zero("Ts", Ts)
        _require_above_zero("speed_window", speed_window)
        if n is not None:
            _require_above_zero("n", n)
        if counts_per_rev is not None:
            _require_above_zero("counts_per_rev", counts_per_rev)
        self.Ts, self.n, self.title = float(Ts), n, title
        self._streamed = {name: row for row, name in enumerate(columns)}
        self._per_rev = counts_per_rev if "counts" in columns else None
        self._lag = max(1, round(speed_window / Ts))
        self.columns = {**columns, SPEED: "RPM"} if self._derives else dict(columns)
        self._size, self.window = _extent(self.Ts, n)
        self._memory = Memory.own(len(columns), self._size)
        self._pipe: int | None = None
        self.description: dict[str, Any] = {
            "columns": dict(columns),
            "Ts": self.Ts,
            "n": None if n is None else int(n),
            "title": title,
            "counts_per_rev": None if counts_per_rev is None else float(counts_per_rev),
            "speed_window": float(speed_window),
        }
        self._notes: deque[tuple[int, str]] = deque(maxlen=64)
        self._noted = 0
        self.closed = threading.Event()

    @property
    def _derives(self) -> bool:
        return self._per_rev is not None and SPEED not in self._streamed

    @classmethod
    def attached(cls, file: int, description: Mapping[str, Any]) -> Feed:
        """The feed of another process, from its memory and its `description`."""
        feed = cls(**description)
        feed._memory = Memory.mapped(file, len(feed._streamed), feed._size)
        return feed

    @contextmanager
    def share(self, pipe: int) -> Iterator[int]:
        """Memory that another process can map, as a file's descriptor.

        Parameters
        ----------
        pipe : int
            Non-blocking descriptor for the notes, as lines of JSON.
        """
        file, self._memory = self._memory.shared()
        self._pipe = pipe
        try:
            yield file
        finally:
            self._pipe = None
            os.close(file)

    @property
    def end(self) -> int:
        """Number of the sample after the newest one."""
        return int(self._memory.counters[_END])

    @property
    def received(self) -> int:
        """Number of samples received."""
        return int(self._memory.counters[_RECEIVED])

    @property
    def gaps(self) -> int:
        """Number of gaps between batches."""
        return int(self._memory.counters[_GAPS])

    @property
    def missing(self) -> int:
        """Number of missing samples up to the newest one."""
        return max(self.end - self.received, 0)

    def put(self, first: int, columns: Mapping[str, NDArray[np.generic]]) -> None:
        """Add a batch; called by the thread that owns the link.

        Parameters
        ----------
        first : int
            Number of the batch's first sample, from 0 at the start of the record; samples between
            the last batch and this one are a gap.
        columns : mapping of str to array, shape (k,)
            Copied. A missing column becomes NaN; an unknown one is ignored.

        Raises
        ------
        DataError
            For columns of different length.
        """
        if self.closed.is_set() or first < 0 or not columns:
            return
        count = len(next(iter(columns.values())))
        end = first + count
        counters = self._memory.counters
        before = counters[_END]
        counters[_CLAIMED] = max(before, end)
        kept = min(count, self._size)
        start = end - kept
        place = start % self._size
        head = min(kept, self._size - place)
        self._write(slice(place, place + head), start, count - kept, columns, count)
        if head < kept:
            self._write(slice(0, kept - head), start + head, count - kept + head, columns, count)
        counters[_GAPS] += first > before
        counters[_RECEIVED] += count
        counters[_END] = max(before, end)

    def _write(
        self,
        places: slice,
        first: int,
        skip: int,
        columns: Mapping[str, NDArray[np.generic]],
        count: int,
    ) -> None:
        """Copy a batch without its first `skip` samples into neighbouring places."""
        width, rows = places.stop - places.start, self._memory.rows
        for name, row in self._streamed.items():
            values = columns.get(name)
            if values is None:
                rows[row, places] = np.nan
            elif len(values) == count:
                rows[row, places] = values[skip : skip + width]
            else:
                raise DataError(
                    f"expected every column of a batch to have {count} samples, received "
                    f"{len(values)} of {name}; put whole batches"
                )
        self._memory.holds[places] = np.arange(first, first + width)

    def say(self, text: str) -> None:
        """Add a line of status, such as "tripped: speed limit"; the newest are kept."""
        self._noted += 1
        self._notes.append((self._noted, text))
        if self._pipe is not None:
            # a view that hangs or has ended misses the line
            with suppress(OSError):
                # most characters of a note: a short write to a pipe is never partial (POSIX,
                # PIPE_BUF)
                os.write(self._pipe, json.dumps(text[:500]).encode() + b"\n")

    def notes(self, after: int = 0) -> list[tuple[int, str]]:
        """The lines of status with numbers above `after`: (number, text), oldest first."""
        for _ in range(3):
            try:
                return [line for line in self._notes if line[0] > after]
            except RuntimeError:  # another thread added one
                continue
        return []

    def close(self) -> None:
        """End the feed: no more samples follow, and the views finish."""
        self.closed.set()

    def read(self, start: int, stop: int) -> dict[str, FloatArray]:
        """Samples `start` to `stop - 1` of every column in `columns`, NaN for missing ones.

        Parameters
        ----------
        start, stop : int
            At most a ring's length apart.

        Returns
        -------
        dict of str to array, shape (stop - start,)
        """
        if not self._derives:
            return dict(zip(self._streamed, self._copy(start, stop), strict=True))
        rows = self._copy(start - self._lag, stop)
        found = {name: rows[row, self._lag :] for name, row in self._streamed.items()}
        counts = rows[self._streamed["counts"]]
        found[SPEED] = speed_over_window(counts, self._lag, self.Ts, self._per_rev or 1.0)
        return found

    def _copy(self, start: int, stop: int) -> FloatArray:
        """The rows of a range; NaN for samples that the writer has overwritten meanwhile."""
        wanted = np.arange(start, stop)
        places = wanted % self._size
        rows = self._memory.rows[:, places]
        known = self._memory.holds[places] == wanted
        known &= wanted >= self._memory.counters[_CLAIMED] - self._size
        rows[:, ~known] = np.nan
        return rows

    @property
    def oldest(self) -> int:
        """The oldest sample that will not be overwritten before a view has read it."""
        return max(0, self.end - self._size + self._size // 16)


def _extent(Ts: float, n: int | None) -> tuple[int, int]:
    """Samples in the ring, and the number of them that a plot spans."""
    # a record of at most this length [s] is kept whole
    whole = n is not None and n * Ts <= 30.0
    # the part kept of a longer record, or of one without a planned end [s]
    wanted = n if n is not None and whole else math.ceil(10.0 / Ts)
    # kept in addition to the span of a plot, for a slow view [s]
    size = min(max(wanted + math.ceil(2.0 / Ts), _LEAST), _MOST)
    return size, min(wanted, size - size // 8)


def _require(ok: bool, expected: str, received: object, remedy: str) -> None:
    if not ok:
        raise SettingError(f"a feed expected {expected}, received {received}; {remedy}")


def _require_above_zero(name: str, value: float) -> None:
    ok = math.isfinite(value) and value > 0
    _require(ok, f"{name} finite and above 0", value, f"give {name} as a positive number")
