"""First motion: which command moves the machine, which way, and about how fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..dataset import FloatArray
from ..recording import Recording
from .bench import Bench
from .demands import Demands
from .refusal import Refusal, require

SHARES = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0)
"""Commands that are tried, in shares of the largest, the smallest first."""
HOLD = 0.8
"""How long each is held [s]."""
MOVED = 0.02
"""Turns that count as motion."""
ENOUGH = 0.2
"""Share of the top speed at which the trials end."""
LEAST_TURNS = 1.0
"""Travel within which a load over the turn may stop the machine."""
STALLS, STALLING = 3, 0.2
"""How often, and up to which share of the largest command, it may."""


@dataclass(frozen=True)
class Motion:
    """Speed is about `gain (u - threshold)`.

    Attributes
    ----------
    gain : float
        [RPM/V]
    threshold : float
        Command that friction takes [V].
    """

    gain: float
    threshold: float

    def command(self, speed: float) -> float:
        """What holds about that speed [V]."""
        return self.threshold + speed / self.gain


def first_motion(bench: Bench, demands: Demands) -> Motion:
    """Try commands from small to large until the machine turns at a fair speed.

    Raises
    ------
    Refusal
        Where nothing moves, the machine turns the wrong way or is stopped in its way, or its
        largest command does not bring a fair speed.
    """
    levels: list[tuple[float, float]] = []
    stalls = 0
    for share in SHARES:
        u = share * demands.u_max
        recording = bench.excite(_pulse(u, bench.Ts), f"motion_{100 * share:g}")
        speed = _judged(recording, u, may_stall=stalls < STALLS and share < STALLING)
        if speed is None:
            stalls += int(np.ptp(recording.counts) >= MOVED * bench.counts_per_rev)
            continue
        levels.append((u, speed))
        if speed >= ENOUGH * demands.speed:
            return _motion(levels)
    require(
        bool(levels),
        f"expected the machine to move at {demands.u_max:g} V at the latest, its encoder counted "
        f"less than {MOVED:g} turns; see whether the drive is enabled, the motor connected and the "
        "shaft free, whether the encoder counts when the shaft is turned by hand, and whether "
        "u_max is too small",
    )
    u, speed = levels[-1]
    raise Refusal(
        f"expected {ENOUGH * demands.speed:.4g} RPM within {HOLD:g} s at {u:g} V, a fifth of the "
        f"top speed of {demands.speed:g} RPM, the machine reached {speed:.4g}; raise u_max, or "
        "lower speed"
    )


def _pulse(u: float, Ts: float) -> FloatArray:
    before, hold = round(0.1 / Ts), round(HOLD / Ts)
    command = np.zeros(before + hold)
    command[before:] = u
    return command


def _judged(recording: Recording, u: float, *, may_stall: bool) -> float | None:
    """The speed at the end [RPM]; None where it did not move, or stopped and may have."""
    turns = (recording.counts - recording.counts[0]) / recording.counts_per_rev
    if np.max(np.abs(turns)) < MOVED:
        return None
    require(
        turns[-1] > -MOVED,
        f"expected a positive command to turn the machine forward, at {u:g} V it went "
        f"{turns[-1]:.3g} turns: backwards; swap two motor leads or the encoder's A and B, or "
        "change the sign of the command in the drive, as a controller would run away",
    )
    tail = max(2, round(0.1 / recording.Ts))
    speed = 60.0 * (turns[-1] - turns[-tail]) / ((tail - 1) * recording.Ts)
    first = turns[: len(turns) // 2]
    stopped = turns[-1] == turns[-tail] and np.ptp(first) > MOVED
    if stopped and may_stall and np.max(np.abs(turns)) < LEAST_TURNS:
        # a load that varies over the turn stops a small command at its hardest angle
        return None
    require(
        not stopped,
        f"expected the machine to keep turning at {u:g} V, it stood still after "
        f"{abs(turns[-1]):.3g} turns: too little travel; free the shaft, take the end stop away, "
        "or see whether the encoder loses counts",
    )
    return float(speed) if speed > 0.0 and turns[-1] >= MOVED else None


def _motion(levels: list[tuple[float, float]]) -> Motion:
    """The line through the last two levels; through the origin where there is one."""
    u, speed = levels[-1]
    if len(levels) == 1:
        return Motion(speed / u, 0.0)
    before, slower = levels[-2]
    gain = max((speed - slower) / (u - before), speed / u)
    return Motion(gain, max(0.0, u - speed / gain))
