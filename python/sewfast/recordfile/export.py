"""`export`: a recording as CSV, Parquet, `.mat`, `.npz`, or MCAP of curves."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DataError, SettingError
from ..writers import write_table
from . import format
from .filing import Sink, batched, replacing
from .format import Assembler, Message, Topic, opening
from .reader import RecordedFile, read_recording
from .writer import require_replaceable

# --- A recording with one message a sample: what plotting programs draw as curves without more ado


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
        yield [Message(Topic.EVENTS, at, at, format.dumps(dict(event)))]
    messages = _samples(recording)
    while group := list(itertools.islice(messages, CHUNK_SAMPLES)):
        yield group
    at = header.time_ns(len(recording))
    yield [Message(Topic.COMPLETENESS, at, at, format.dumps(_account(recording)))]


def _samples(recording: RecordedFile) -> Iterator[Message]:
    header = recording.header
    gaps = iter((*recording.gaps, (len(recording), 0)))
    begin = 0
    for first, count in gaps:
        for k, row in zip(range(begin, first), _rows(recording, begin, first), strict=True):
            at = header.time_ns(k)
            own = {"index": k, "t": round(k * header.Ts, 9)}
            data = format.dumps({**own, **dict(zip(recording.columns, row, strict=True))})
            yield Message(Topic.SAMPLES, at, at, data)
        begin = first + count


def _rows(recording: RecordedFile, begin: int, end: int) -> Iterable[tuple[Any, ...]]:
    columns = [format.numbers(n, np.array(c[begin:end])) for n, c in recording.columns.items()]
    return zip(*columns, strict=True)


def _account(recording: RecordedFile) -> dict[str, Any]:
    return {
        "outcome": recording.outcome,
        "received": recording.received,
        "expected": recording.header.n,
        "end": len(recording),
        "gap_count": len(recording.gaps),
        "gaps": [list(gap) for gap in recording.gaps[: format.MOST_GAPS_LISTED]],
    }


# --- A recording -> CSV, Parquet, .mat, .npz, or MCAP with one message a sample -------------------


def _is_earlier(out: Path, recording: RecordedFile) -> bool:
    """Whether a file is an earlier export of this recording, and holds no more than it."""
    if out.suffix.lower() != ".mcap" or not out.is_file():
        return False
    try:
        found = read_recording(out)
    except DataError:
        return False
    return found.header == recording.header and found.received <= recording.received


def export(
    path: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False
) -> RecordedFile:
    """Write a recording's columns with `t` in the format that the extension of `out` says.

    Gaps are rows of NaN. Events, settings and the device's identity go into `.mcap` only.

    Parameters
    ----------
    path : path
        The recording.
    out : path
        `.csv`, `.parquet`, `.mat`, `.npz`, or `.mcap`: one message a sample, for programs that
        plot; also the repair of a file that lacks its end. A file that exists is replaced in one
        step, save a recording of a drive.
    overwrite : bool
        Whether that may be replaced as well.

    Returns
    -------
    RecordedFile
        What was read.

    Raises
    ------
    DataError
        Where the recording cannot be read or the other file not be written.
    SettingError
        Where the extension is unknown or its package is not installed, `out` is the recording
        itself, or another one that cannot be had again.
    """
    recording = read_recording(path)
    if Path(out).exists() and Path(out).samefile(path):
        raise SettingError(
            f"{out}: expected another file than the recording, which cannot be had again, got the "
            "same; choose another name"
        )
    require_replaceable(out, overwrite=overwrite or _is_earlier(Path(out), recording))
    if Path(out).suffix.lower() == ".mcap":
        save_curves(out, recording)
    else:
        write_table(out, recording.table_columns(), units=recording.units)
    return recording
