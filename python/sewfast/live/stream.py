"""`Tail`: the samples of a feed as JSON objects, at no more than a set rate."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator

from .feed import Feed

PERIOD_S = 0.02
"""Between two looks at the feed [s]."""

RATE = 2500
"""Samples that a stream sends in a second at most; of a faster record every second one, or
fewer. What was not used in the last second may be made up for."""


class Tail:
    """What has come since the last look.

    Parameters
    ----------
    feed : Feed
    now : callable
        Seconds of the wall clock; what a sample is stamped with starts from it.
    """

    def __init__(self, feed: Feed, now: Callable[[], float] = time.time) -> None:
        self._feed, self._now = feed, now
        self._next = 0
        self._looked = now()
        self._allowed = float(RATE)
        self._began: float | None = None
        self._said = 0

    def rows(self) -> Iterator[tuple[float, dict[str, float]]]:
        """Wall time [s] and columns of each sample that is sent; a missing value is left out."""
        feed, stop = self._feed, self._feed.end
        self._refill()
        start = max(self._next, feed.oldest)
        if stop <= start:
            return
        if self._began is None:
            self._began = self._looked - stop * feed.Ts
        stride = math.ceil((stop - start) / max(self._allowed, 1.0))
        self._allowed -= (stop - start) / stride
        # the same samples whenever the look was: multiples of the stride
        first = -(-start // stride) * stride
        columns = {name: c[first - start :: stride] for name, c in feed.read(start, stop).items()}
        self._next = stop
        for k, values in enumerate(zip(*(c.tolist() for c in columns.values()), strict=True)):
            known = {n: v for n, v in zip(columns, values, strict=True) if math.isfinite(v)}
            if known:
                t = (first + k * stride) * feed.Ts
                yield self._began + t, {"t": round(t, 9), **known}

    @property
    def now(self) -> float:
        """Wall time of the last look [s]."""
        return self._looked

    def _refill(self) -> None:
        """What may be sent grows with time (a token bucket)."""
        now = self._now()
        passed, self._looked = max(now - self._looked, 0.0), now
        self._allowed = min(self._allowed + RATE * passed, RATE)

    def said(self) -> Iterator[str]:
        """The lines of status since the last look."""
        for number, text in self._feed.said(self._said):
            self._said = number
            yield text


def encode(value: object) -> bytes:
    """Strict JSON: what is not a number must not be in it."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
