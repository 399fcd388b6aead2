"""A recording with one message a sample: what plotting programs draw as curves without more ado."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import samples
from .container import Assembler, Message, opening
from .reader import RecordedFile
from .sink import Sink, batched, replacing
from .topics import Topic

CHUNK_SAMPLES = 500


def save_curves(path: str | os.PathLike[str], recording: RecordedFile) -> None:
    """Write a recording anew, whole and with one message a sample; it appears whole or not at all.

    `read_recording` reads it as it reads any other. Samples in gaps have no message, what was
    damaged is not in it, and a recording that is torn remains one that says so.

    Raises
    ------
    DataError
        Where the file cannot be written.
    """
    with replacing(Path(path)) as temporary:
        sink = Sink(temporary, overwrite=False)
        try:
            assembler = Assembler(recording.header.columns, single=True)
            sink.append(opening())
            for count, group in enumerate(_groups(recording)):
                sink.append(assembler.chunk(group, sink.size, leading=count == 0))
            for piece in batched(assembler.ending(sink.size, sink.crc)):
                sink.append(piece)
        finally:
            sink.close()


def _groups(recording: RecordedFile) -> Iterator[list[Message]]:
    header = recording.header
    start = header.start_ns()
    first = Message(Topic.HEADER, start, start, header.encode())
    yield from ([first], [first])
    for event in recording.events:
        at = start + round(event["elapsed"] * 1e9)
        at = at if event["index"] is None else header.time_ns(event["index"])
        yield [Message(Topic.EVENTS, at, at, samples.dumps(dict(event)))]
    messages = _samples(recording)
    while group := list(itertools.islice(messages, CHUNK_SAMPLES)):
        yield group
    at = header.time_ns(len(recording))
    yield [Message(Topic.COMPLETENESS, at, at, samples.dumps(_account(recording)))]


def _samples(recording: RecordedFile) -> Iterator[Message]:
    header = recording.header
    gaps = iter((*recording.gaps, (len(recording), 0)))
    begin = 0
    for first, count in gaps:
        for k, row in zip(range(begin, first), _rows(recording, begin, first), strict=True):
            at = header.time_ns(k)
            own = {"index": k, "t": round(k * header.Ts, 9)}
            data = samples.dumps({**own, **dict(zip(recording.columns, row, strict=True))})
            yield Message(Topic.SAMPLES, at, at, data)
        begin = first + count


def _rows(recording: RecordedFile, begin: int, end: int) -> Iterable[tuple[Any, ...]]:
    columns = [samples.numbers(n, np.array(c[begin:end])) for n, c in recording.columns.items()]
    return zip(*columns, strict=True)


def _account(recording: RecordedFile) -> dict[str, Any]:
    return {
        "outcome": recording.outcome,
        "received": recording.received,
        "expected": recording.header.n,
        "end": len(recording),
        "gap_count": len(recording.gaps),
        "gaps": [list(gap) for gap in recording.gaps[: samples.MOST_GAPS_LISTED]],
    }
