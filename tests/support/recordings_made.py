"""Recordings that several tests look at, and what must come out of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sewfast.recordfile import Header, RecordWriter

"""Whether the long versions run."""

COLUMNS = {"u": "V", "counts": "1", "current": "A"}
STARTED = "2026-01-31T12:00:00+00:00"


@dataclass(frozen=True)
class Made:
    """A recording file and the columns that were written into it, NaN in gaps."""

    path: Path
    raw: bytes
    columns: dict[str, NDArray[np.float64]]
    gaps: tuple[tuple[int, int], ...]


def header(n: int | None = None, **changes: object) -> Header:
    given: dict[str, object] = {
        "name": "chirp_lo_hi",
        "Ts": 0.001,
        "columns": COLUMNS,
        "n": n,
        "counts_per_rev": 1572.0,
        "device": {"name": "virtual", "boot_id": 7},
        "settings": {"seed": 3, "limits": {"u": 20.0}},
        "started": STARTED,
    }
    return Header(**{**given, **changes})  # type: ignore[arg-type]


def signals(n: int, seed: int = 0) -> dict[str, NDArray[np.generic]]:
    random = np.random.default_rng(seed)
    return {
        "u": random.normal(size=n),
        "counts": np.cumsum(random.integers(0, 9, n)),
        "current": random.normal(size=n).astype(np.float32),
    }


def make(
    path: Path,
    n: int = 1000,
    gaps: tuple[tuple[int, int], ...] = ((310, 20),),
    *,
    compress: bool = False,
) -> Made:
    """Ten samples at a time, as a link gives them, with events and gaps."""
    given = signals(n)
    lost = {k for first, count in gaps for k in range(first, first + count)}
    with RecordWriter(path, header(n), compress=compress) as writer:
        writer.event("armed", 0, limits={"u": 20.0})
        for first in range(0, n, 10):
            if first not in lost:
                writer.samples(first, {k: v[first : first + 10] for k, v in given.items()})
        writer.event("disarmed", n)
    return Made(path, path.read_bytes(), expected(given, gaps), gaps)


def expected(
    given: dict[str, NDArray[np.generic]], gaps: tuple[tuple[int, int], ...]
) -> dict[str, NDArray[np.float64]]:
    columns = {}
    for name, values in given.items():
        # a float32 is written by its shortest text
        text = values.astype(str) if values.dtype == np.float32 else values
        columns[name] = text.astype(np.float64)
        for first, count in gaps:
            columns[name][first : first + count] = np.nan
    return columns
