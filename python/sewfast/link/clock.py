"""`Clock`: bounds on a device's clock from the exchanges with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MAX_DRIFT = 0.1
"""Drift that every working oscillator stays within, a microcontroller's RC oscillator included."""

RESOLUTION = 1.2e-6
"""A device counts whole microseconds of its own clock, rounded down [s, with the drift]."""

_Points = NDArray[np.float64]


@dataclass(frozen=True)
class ClockBounds:
    """Bounds on the difference between the host's and the device's clock.

    Host time is `at + offset + (1 + drift) * (device time - at)`, with `at` the device's time of
    the last exchange.

    Parameters
    ----------
    at_us : int
        Device's time at the last exchange [us].
    offset_s : (float, float)
        Host time (a monotonic clock) less device time then [s].
    drift_ppm : (float, float)
        How much faster the host's clock runs [1e-6].
    exchanges : int
        Exchanges that the bounds are from.
    consistent : bool
        False if no offset and drift explain them all: a clock was set or jumped.
    """

    at_us: int
    offset_s: tuple[float, float]
    drift_ppm: tuple[float, float]
    exchanges: int
    consistent: bool

    def __str__(self) -> str:
        if not self.consistent:
            return f"the clocks contradict each other over {self.exchanges} exchanges"
        low, high = self.drift_ppm
        width = (self.offset_s[1] - self.offset_s[0]) * 1e6
        return f"clock known within {width:.0f} us, drift {low:.0f} to {high:.0f} ppm"


class Clock:
    """Collects exchanges (sent, device's time, received).

    The device's time lies between the two host times, so the line `host(device)` passes above
    `sent` and below `received` there. Only the convex hulls of the two sets matter, so memory stays
    small in a session of any length.
    """

    def __init__(self) -> None:
        self._low: list[tuple[float, float]] = []
        self._high: list[tuple[float, float]] = []
        self._exchanges = 0

    def add(self, sent: float, device_us: int, received: float) -> None:
        """An exchange: host times [s] and the device's time in its reply [us]."""
        device = device_us * 1e-6
        if self._low and device < self._low[-1][0]:
            return
        _extend(self._low, (device, sent - RESOLUTION), 1.0)
        _extend(self._high, (device, received), -1.0)
        self._exchanges += 1

    def bounds(self) -> ClockBounds | None:
        """The tightest bounds that all exchanges allow; None before the first."""
        if not self._low:
            return None
        last = self._low[-1][0]
        at = round(last * 1e6)
        low = np.array(self._low) - (last, 0.0)
        high = np.array(self._high) - (last, 0.0)
        slopes = _slopes(low, high)
        if slopes[0] > slopes[1]:
            unknown = (-np.inf, np.inf)
            return ClockBounds(at, unknown, unknown, self._exchanges, False)
        offset = _offsets(low, high, slopes)
        drift = ((slopes[0] - 1.0) * 1e6, (slopes[1] - 1.0) * 1e6)
        offset = (offset[0] - last, offset[1] - last)
        return ClockBounds(at, offset, drift, self._exchanges, True)


def _extend(hull: list[tuple[float, float]], point: tuple[float, float], side: float) -> None:
    """Append to a monotone chain: the upper hull of `sent`, the lower hull of `received`."""
    while len(hull) >= 2 and side * _turn(hull[-2], hull[-1], point) >= 0.0:
        hull.pop()
    if hull and hull[-1][0] == point[0]:
        if side * (hull[-1][1] - point[1]) >= 0.0:
            return
        hull.pop()
    hull.append(point)


def _turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _slopes(low: _Points, high: _Points) -> tuple[float, float]:
    """Least and greatest slope of a line above all of `low` and below all of `high`."""
    dx = high[None, :, 0] - low[:, None, 0]
    dy = high[None, :, 1] - low[:, None, 1]
    if np.any((dx == 0.0) & (dy < 0.0)):
        return 1.0, 0.0
    later, earlier = dx > 0.0, dx < 0.0
    greatest = min(1.0 + MAX_DRIFT, *(dy[later] / dx[later]).tolist(), 1.0 + MAX_DRIFT)
    least = max(1.0 - MAX_DRIFT, *(dy[earlier] / dx[earlier]).tolist(), 1.0 - MAX_DRIFT)
    return least, greatest


def _offsets(low: _Points, high: _Points, slopes: tuple[float, float]) -> tuple[float, float]:
    """Least and greatest value at 0 of such a line.

    They are reached at the least or greatest slope, or at the slope of an edge of a hull.
    """
    at = [np.clip(s, *slopes) for s in (*slopes, *_edges(low), *_edges(high))]
    least = min(float(np.max(low[:, 1] - s * low[:, 0])) for s in at)
    greatest = max(float(np.min(high[:, 1] - s * high[:, 0])) for s in at)
    return least, greatest


def _edges(points: _Points) -> _Points:
    steps = np.diff(points, axis=0)
    return np.asarray(steps[:, 1] / steps[:, 0])
