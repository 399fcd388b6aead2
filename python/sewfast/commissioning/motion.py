"""First motion, and the step response with a first order that explains it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..dataset import FloatArray
from ..errors import DataError, FitError
from ..recording import Recording
from ..rules import Fopdt, fit_fopdt
from .bench import Bench
from .demands import Demands
from .excitations import step
from .refusal import Refusal, require

# --- First motion: which command moves the machine, which way, and about how fast -----------------


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


# --- The step response: gain, time constant and dead time, with the evidence for them -------------


SHARE = 0.6
"""Of the top speed that the step aims at."""
DURATIONS = (2.0, 6.0, 20.0)
"""Tried until the response settles [s]."""
LEAST_FIT = 80.0
"""Percent; below it the machine is no first order with dead time."""


def step_response(bench: Bench, demands: Demands, motion: Motion) -> Fopdt:
    """Record steps until one settles, and fit it.

    Raises
    ------
    Refusal
        Where none settles, the fit is poor, or the top speed is out of the command's reach.
    """
    u = min(motion.command(SHARE * demands.speed), demands.u_max)
    reason: Exception | None = None
    for seconds in DURATIONS:
        recording = bench.excite(step(u, seconds, bench.Ts), "step")
        try:
            fopdt = fit_fopdt(recording.u, recording.y, Ts=recording.Ts)
        except (DataError, FitError) as error:
            reason = error
            continue
        _checked(fopdt, demands)
        return fopdt
    raise Refusal(
        f"expected a speed that settles within {DURATIONS[-1]:g} s at {u:.3g} V, it did not "
        f"({reason}); see what varies: a load that comes and goes, a drive with a controller of "
        "its own, a machine that integrates"
    ) from reason


def _checked(fopdt: Fopdt, demands: Demands) -> None:
    require(
        fopdt.K > 0.0 and fopdt.fit_percent >= LEAST_FIT,
        f"expected a step response of first order with dead time (fit of {LEAST_FIT:g} % or more, "
        f"gain above 0), got {fopdt}; see the recording: the load must not change, nor a limit "
        "be reached",
    )
    needed = (demands.top - fopdt.offset) / fopdt.K
    require(
        needed <= demands.u_max,
        f"expected the top speed and a quarter more, {demands.top:.4g} RPM, to need less than "
        f"u_max = {demands.u_max:g} V, the step response says {needed:.3g} V; lower speed, or "
        "raise u_max",
    )
