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

_OF_A_RUN = ("started", "gap")
"""Events that say that the device has accepted a start."""


class Recorder:
    """The sink of `Drive.stream`.

    Parameters
    ----------
    columns : mapping of name to unit
        The streamed columns.
    n : int
        Samples of the run.
    writer : RecordWriter, optional
        The file, a lazy one: it gets nothing before the run has begun. The samples are then not
        kept in memory.
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
        size = 0 if writer else n
        self._kept = {name: np.full(size, np.nan) for name in columns}
        self._file = writer
        self._feed = feed
        self._end = 0
        self._begun = False
        self._early: list[tuple[str, int | None, dict[str, Any]]] = []

    def samples(self, first: int, columns: Mapping[str, FloatArray]) -> None:
        """A batch that came; called by the thread that owns the link.

        Raises
        ------
        DataError
            Where the file takes no more.
        """
        self._begin()
        if self._file is not None:
            self._file.samples(first, columns)
        else:
            stop = first + len(next(iter(columns.values())))
            for name, kept in self._kept.items():
                kept[first:stop] = columns[name]
            self._end = max(self._end, stop)
        if self._feed is not None:
            self._feed.put(first, columns)

    def event(self, kind: str, index: int | None = None, **detail: Any) -> None:
        """Something that happened on the way; see `samples`."""
        if kind in _OF_A_RUN:
            self._begin()
        if self._begun:
            self._write_down(kind, index, detail)
        else:
            self._early.append((kind, index, detail))
        if self._feed is not None:
            self._feed.say(describe(kind, index, detail))

    def _begin(self) -> None:
        """The run is there: what happened on the way to it belongs to its recording."""
        if not self._begun:
            self._begun = True
            for event in self._early:
                self._write_down(*event)

    def _write_down(self, kind: str, index: int | None, detail: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.event(kind, index, **{k: _finite(v) for k, v in detail.items()})

    def columns(self) -> dict[str, FloatArray]:
        """What came, sample 0 to the last one, NaN in gaps; where there is no file."""
        return {name: values[: self._end] for name, values in self._kept.items()}

    def close(self, outcome: str, taken: int | None) -> None:
        """Write what waits and close the file.

        Parameters
        ----------
        outcome : str
            How it ended.
        taken : int or None
            Samples that the device took, where that is known.

        Raises
        ------
        DataError
            Where the file could not be written to its end.
        """
        if self._file is not None:
            self._file.close(outcome, taken=taken)


def _finite(value: Any) -> Any:
    """What JSON can say: a device may send infinity as the value of an event."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def describe(kind: str, index: int | None, detail: Mapping[str, Any]) -> str:
    """An event as a line of text."""
    at = "" if index is None else f" at sample {index}"
    said = ", ".join(f"{name} {value}" for name, value in detail.items())
    return f"{kind}{at}" + (f": {said}" if said else "")
