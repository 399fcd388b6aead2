"""What the live view costs: `Feed.put` for ten samples, alone and beside a view; one status."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from sewfast.live import Feed, open_view
from sewfast.live.view import status

UNITS = {"u": "V", "counts": "", "r": "RPM", "current": "A"}
BATCH, SAMPLES, TS = 10, 30_000, 0.001


def _feed() -> Feed:
    return Feed(UNITS, TS, SAMPLES, "bench", counts_per_rev=1572)


@contextmanager
def _terminal() -> Iterator[None]:
    """Standard error is a terminal that somebody reads."""
    ours, theirs = os.openpty()
    reader = threading.Thread(target=_drain, args=(ours,), daemon=True)
    reader.start()
    before = sys.stderr
    with os.fdopen(theirs, "w", encoding="utf-8") as stream:
        sys.stderr = stream
        try:
            yield
        finally:
            sys.stderr = before


def _drain(terminal: int) -> None:
    try:
        while os.read(terminal, 65536):
            pass
    except OSError:
        os.close(terminal)


@pytest.mark.parametrize("kind", ["none", "terminal", "plotjuggler", "foxglove:0"])
def test_put(benchmark: Any, kind: str) -> None:
    """Ten samples of four columns, as fast as they can be put: the view is as busy as it gets."""
    feed = _feed()
    batch = {name: np.arange(BATCH, dtype=float) for name in UNITS}
    first = iter(range(0, 1 << 62, BATCH))
    with _terminal(), open_view(kind, feed):
        benchmark(lambda: feed.put(next(first), batch))
    if benchmark.stats is not None:
        found = benchmark.stats.stats
        print(f"\n{kind}: put {1e6 * found.median:.2f} us, worst {1e3 * found.max:.2f} ms")


def test_status(benchmark: Any) -> None:
    """The line of 30 s at 1 kHz, ten of which are written in a second."""
    feed = _feed()
    feed.put(0, {name: np.arange(SAMPLES, dtype=float) for name in UNITS})
    benchmark(lambda: status(feed, 79))
    if benchmark.stats is not None:
        print(f"\n{1e6 * benchmark.stats.stats.median:.1f} us a line")
