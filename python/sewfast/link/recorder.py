"""`Recorder`: a run's samples to memory, a file and a live view, none of which hold it up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..live import Feed
from ..recordfile import RecordWriter

FloatArray = NDArray[np.float64]


class Recorder:
    """The sink of `Drive.stream`.

    Parameters
    ----------
    columns : mapping of name to unit
        The streamed columns.
    n : int
        Samples of the run.
    writer : RecordWriter, optional
        The file. The samples are then not kept in memory.
    feed : Feed, optional
        Of a live view.
    """

    def __init__(
        self,
        columns: Mapping[str, str],
        n: int,
        *,
        writer: RecordWriter | None = None,
        feed: Feed | None = None,
    ) -> None:
        self._kept = None if writer else {name: np.full(n, np.nan) for name in columns}
        self._file = writer
        self._feed = feed
        self._end = 0

    def samples(self, first: int, columns: Mapping[str, FloatArray]) -> None:
        """A batch that came; called by the thread that owns the link.

        Raises
        ------
        DataError
            Where the file takes no more.
        """
        if self._file is not None:
            self._file.samples(first, columns)
        if self._kept is not None:
            stop = first + len(next(iter(columns.values())))
            for name, kept in self._kept.items():
                kept[first:stop] = columns[name]
            self._end = max(self._end, stop)
        if self._feed is not None:
            self._feed.put(first, columns)

    def event(self, kind: str, index: int | None = None, **detail: Any) -> None:
        """Something that happened on the way; see `samples`."""
        if self._file is not None:
            self._file.event(kind, index, **{k: _finite(v) for k, v in detail.items()})
        if self._feed is not None:
            self._feed.say(describe(kind, index, detail))

    def columns(self) -> dict[str, FloatArray]:
        """What came, sample 0 to the last one, NaN in gaps; where there is no file."""
        kept = self._kept or {}
        return {name: values[: self._end] for name, values in kept.items()}

    def close(self, outcome: str) -> None:
        """Write what waits and close the file.

        Raises
        ------
        DataError
            Where the file could not be written to its end.
        """
        if self._file is not None:
            self._file.close(outcome)


def _finite(value: Any) -> Any:
    """What JSON can say: a device may send infinity as the value of an event."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe(kind: str, index: int | None, detail: Mapping[str, Any]) -> str:
    """An event as a line of text."""
    at = "" if index is None else f" at sample {index}"
    said = ", ".join(f"{name} {value}" for name, value in detail.items())
    return f"{kind}{at}" + (f": {said}" if said else "")
