"""Recordings prepared for the fit of a motor: in rad/s, split at gaps, without spikes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import FloatArray, as_column, bridged, runs
from ..dataset import Dataset
from ..errors import DataError, SettingError
from ..recording import Recording
from ..units import REVOLUTIONS_PER_SECOND, revolutions_per_second

SHORTEST = 50
"""Shortest piece between gaps, in samples; a shorter one is not worth its unknown start."""
LEAST = 200
"""Least samples of all pieces together."""
SPIKE = 8.0
"""Standard deviations from the median of its neighbours above which a sample is a spike."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A run without gaps; its arrays have shape (N,).
    `u` and `y` are command and speed [rad/s], `used` are the samples compared in the fit, and
    `speed` is that of the first sample [rad/s]. `angle` is that of the shaft [rad], from the
    counts, or the sum of the speeds; `current` is measured.
    """

    u: FloatArray
    y: FloatArray
    used: NDArray[np.bool_]
    speed: float
    angle: FloatArray
    current: FloatArray | None


@dataclass(frozen=True, eq=False)
class Records:
    """All pieces, with the meaning of their values.
    With `mean`, the speed is the mean over the previous sample, as a difference of counts is.
    `quantum` is the step of its values [rad/s], 0 without quantisation.
    """

    pieces: tuple[Piece, ...]
    Ts: float
    u_unit: str
    speed_unit: str
    mean: bool
    quantum: float
    counts_per_rev: float | None
    spikes: int

    def liveliest(self, n: int) -> Records:
        """The `n` consecutive samples whose speed varies most, as views of the pieces; or all."""
        if sum(len(p.u) for p in self.pieces) <= n:
            return self
        windows = [
            _window(p, k, min(k + n, len(p.u)), self.quantum)
            for p in self.pieces
            for k in range(0, max(len(p.u) - n // 2, 1), n // 2)
        ]
        return replace(self, pieces=(max(windows, key=lambda w: float(np.var(w.y))),))

    @property
    def used(self) -> int:
        return int(sum(p.used.sum() for p in self.pieces))


def rad_per_second(unit: str) -> float:
    """Factor from a unit of speed to rad/s."""
    turns = revolutions_per_second(unit)
    if turns is None:
        raise SettingError(
            f"expected a speed in {', '.join(REVOLUTIONS_PER_SECOND)}, received the unit {unit!r}; "
            "say which it is: speed_unit='rpm', or --unit deg for a position"
        )
    return 2.0 * math.pi * turns


def records_of(
    data: Recording | Dataset, current: str | ArrayLike | None, speed_unit: str | None
) -> Records:
    """The records to fit."""
    if isinstance(data, Recording):
        return _of_recording(data, current, speed_unit)
    if not isinstance(data, Dataset):
        raise SettingError(
            f"expected a Recording or a Dataset, received {type(data).__name__}; "
            "sewfast.Dataset.from_arrays(u, y, Ts, output_unit='rpm') makes one of arrays"
        )
    if len(data.input_names) != 1:
        raise DataError(
            f"expected one input, the motor's command, received {list(data.input_names)}; "
            "choose its column"
        )
    unit = speed_unit if speed_unit is not None else data.output_unit
    factor = rad_per_second(unit)
    # a speed computed from counts without looking ahead is their difference
    differs = data.counts is not None and not data.looks_ahead
    quantum = 2.0 * math.pi / data.counts[1] / data.Ts if data.counts and differs else 0.0
    whole, spikes = [], 0
    for e in data.experiments:
        y = np.where(e.weights == 0.0, np.nan, e.y) if e.weights is not None else e.y
        i = _current(current, e.channels, len(e), len(data.experiments))
        pieces, left_out = _pieces(e.u[:, 0], factor * y, None, i, data.Ts, quantum, mean=differs)
        whole += pieces
        spikes += left_out
    per_rev = None if data.counts is None else data.counts[1]
    return _checked(
        Records(tuple(whole), data.Ts, data.input_units[0], unit, differs, quantum, per_rev, spikes)
    )


def _of_recording(
    data: Recording, current: str | ArrayLike | None, speed_unit: str | None
) -> Records:
    if isinstance(current, str):
        raise SettingError(
            "expected the current of a Recording as an array of its length, received the name "
            f"{current!r}; pass current=array [A]"
        )
    per_count = 2.0 * math.pi / data.counts_per_rev
    angle = per_count * data.counts
    y = np.diff(angle, prepend=angle[:1]) / data.Ts
    i = _current(current, {}, len(data), 1)
    quantum = per_count / data.Ts
    pieces, spikes = _pieces(data.u, y, angle, i, data.Ts, quantum, mean=True)
    unit = "rpm" if speed_unit is None else speed_unit
    rad_per_second(unit)
    return _checked(
        Records(
            tuple(pieces), data.Ts, "V", unit, True, quantum, data.counts_per_rev, spikes
        )
    )  # fmt: skip


def _current(
    current: str | ArrayLike | None, channels: Mapping[str, FloatArray], n: int, experiments: int
) -> FloatArray | None:
    if current is None:
        return None
    if isinstance(current, str):
        if current not in channels:
            raise DataError(
                f"expected the current in a channel, received {current!r}; known are "
                f"{', '.join(channels) or 'none'}"
            )
        return np.asarray(channels[current], dtype=np.float64)
    if experiments > 1:
        raise SettingError(
            f"expected the name of the current's channel for {experiments} experiments, received "
            "an array; pass channels to Dataset.from_arrays"
        )
    return as_column(current, "current", n)


def _pieces(
    u: FloatArray,
    y: FloatArray,
    angle: FloatArray | None,
    current: FloatArray | None,
    Ts: float,
    quantum: float,
    *,
    mean: bool,
) -> tuple[list[Piece], int]:
    """Split where a command or an angle is missing; a missing speed is only left out."""
    known = np.isfinite(u)
    if angle is not None:
        known &= np.isfinite(angle)
    if current is not None:
        known &= np.isfinite(current)
    found, spikes = [], 0
    for start, n in runs(known):
        part = slice(start, start + n)
        measured = np.isfinite(y[part])
        if angle is not None and start > 0:
            measured[0] = False  # a difference across the gap
        if n < SHORTEST or measured.sum() < SHORTEST:
            continue
        speed = bridged(y[part], measured)
        spiked = spikes_of(speed, quantum) & measured
        spikes += int(spiked.sum())
        good = measured & ~spiked
        speed = bridged(speed, good)
        used = good.copy()
        used[0] = False  # the start of the simulation
        turned = _integral(speed, Ts, mean=mean) if angle is None else angle[part]
        first = _first(speed, quantum)
        i = None if current is None else np.ascontiguousarray(current[part])
        found.append(
            Piece(
                np.ascontiguousarray(u[part]), speed, used, first, np.ascontiguousarray(turned), i
            )
        )  # fmt: skip
    return found, spikes


def _window(p: Piece, start: int, stop: int, quantum: float) -> Piece:
    part = slice(start, stop)
    current = None if p.current is None else p.current[part]
    first = p.speed if start == 0 else _first(p.y[part], quantum)
    return Piece(p.u[part], p.y[part], p.used[part], first, p.angle[part], current)


def spikes_of(y: FloatArray, quantum: float) -> NDArray[np.bool_]:
    """Samples far from the median of themselves and their four neighbours.
    The usual distance is that of nine in ten samples: up to eleven of 300 samples can be spikes. At
    a corner, and at either end, a signal is off by at most two of its quicker steps.
    """
    if len(y) < 10:
        return np.zeros(len(y), dtype=bool)
    middle = np.median(np.lib.stride_tricks.sliding_window_view(y, 5), axis=1)
    quick = 2.0 * float(np.quantile(np.abs(np.diff(middle)), 0.98))
    off = np.abs(y - np.pad(middle, 2, mode="edge"))
    spread = max(1.4826 * float(np.median(off)), float(np.quantile(off, 0.9)), quantum)
    return off > max(SPIKE * spread, quick, 1e-9 * float(np.abs(y).max()))


def _integral(y: FloatArray, Ts: float, *, mean: bool) -> FloatArray:
    steps = y[1:] if mean else 0.5 * (y[1:] + y[:-1])
    return np.concatenate([[0.0], np.cumsum(steps) * Ts])


def _first(y: FloatArray, quantum: float) -> float:
    """The speed at the start, from a line through the first samples, or 0 at standstill."""
    head = y[: min(20, len(y))]
    if np.abs(head[:5]).max() <= 1.01 * quantum or not head[:5].any():
        return 0.0
    _, start = np.polyfit(np.arange(len(head)), head, 1)
    return float(start)


def _checked(records: Records) -> Records:
    n = records.used
    if n < LEAST:
        raise DataError(
            f"expected at least {LEAST} samples in pieces of {SHORTEST} without gaps, received "
            f"{n}; record longer, 10 s with changes of speed in both directions"
        )
    y = np.concatenate([p.y for p in records.pieces])
    u = np.concatenate([p.u for p in records.pieces])
    if np.ptp(u) == 0.0:
        raise DataError(
            f"expected a command that changes, received {u[0]:g} {records.u_unit} throughout; "
            "excite with random steps"
        )
    if np.ptp(y) <= 3.0 * records.quantum or np.ptp(y) == 0.0:
        raise DataError(
            f"expected a speed that changes, received {np.ptp(y):.3g} rad/s from least to most "
            f"(one count in a sample is {records.quantum:.3g} rad/s); excite more strongly"
        )
    return records
