"""The first motion of a machine at rest, and the excitations that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import _core
from ..control.machine import Machine
from ..dataset import FloatArray
from ..errors import DataError, FitError
from ..recording import Recording
from ..rules import Fopdt, fit_fopdt
from .demands import Demands, Refusal, require

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


def first_motion(bench: Machine, demands: Demands) -> Motion:
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


def step_response(bench: Machine, demands: Demands, motion: Motion) -> Fopdt:
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


# --- Signals for a machine that is known as a first order with dead time only ---------------------


SPANS = 0.02, 0.01, 0.005
"""Over which a change of speed is an acceleration and not the encoder's noise [s]; the shorter ones
where a fast machine's pulses are shorter."""
FIRST_SHARE, FAIR_SHARE = 0.2, 0.35
"""Of the top speed, that a single pulse is planned for and that ends the series."""
LONGEST_PULSE = 1.0
"""Of the series [s]."""
LEAST_HARD = 50
"""Samples near the largest command from which an acceleration is told."""
LONGEST = 60.0
"""Of any excitation [s]."""
PULSES = 20.0
"""Length of the pulses in time constants."""
HARD = 0.25
"""Least size of a pulse in shares of the largest command: a current limit is met halfway."""
SLOW = 0.15
"""Speed between the trapezoids in shares of the top: a shaft that friction holds tells nothing."""
TRAPEZOIDS = (
    (0.45, 0.12, 0.12),
    (0.90, 0.40, 0.25),
    (0.25, 0.60, 0.60),
    (1.00, 0.20, 0.35),
    (0.65, 0.60, 0.40),
    (0.30, 0.06, 0.30),
    (0.80, 0.25, 0.15),
)
"""Height in shares of the top, accelerations up and down in shares of what the limit allows."""


def acceleration(fopdt: Fopdt, demands: Demands) -> float:
    """What the largest command would give at rest without a current limit [RPM/s]."""
    return fopdt.K * demands.u_max / fopdt.T


def acceleration_shown(recording: Recording, demands: Demands) -> float:
    """What the machine does when it speeds up under the largest commands [RPM/s]: the ninth decile
    of its changes of speed; inf where there are no such commands.

    How it brakes is not asked: friction helps there as much as it hinders here.
    """
    hard = recording.u >= 0.7 * demands.u_max
    for span in (max(1, round(seconds / recording.Ts)) for seconds in SPANS):
        whole = np.convolve(hard, np.ones(span), "valid")[:-1] >= span
        change = (recording.y[span:] - recording.y[:-span])[: len(whole)][whole]
        if len(change) >= LEAST_HARD and np.quantile(change, 0.9) > 0.0:
            return float(np.quantile(change, 0.9)) / (span * recording.Ts)
    return float("inf")


def acceleration_from_rest(bench: Machine, fastest: float, demands: Demands) -> float:
    """The same from single pulses of the largest command [RPM/s], each twice as long as the one
    before, until one brings a fair speed.

    Where pulses between speeds are planned with far more acceleration than a drive's current limit
    allows, they are over within milliseconds.
    """
    samples = max(1, round(FIRST_SHARE * demands.top / (fastest * bench.Ts)))
    while True:
        seconds = samples * bench.Ts
        recording = bench.excite(_single(demands.u_max, samples, bench.Ts), f"limit_{samples}")
        reached = float(np.max(recording.y))
        # a pulse of twice the length brings at most about twice the speed
        if reached >= FAIR_SHARE * demands.top or seconds >= LONGEST_PULSE:
            return max(reached, 1e-3 * demands.top) / seconds
        samples *= 2


def _single(u: float, samples: int, Ts: float) -> FloatArray:
    before, after = round(0.05 / Ts), round(0.15 / Ts)
    command = np.zeros(before + samples + after)
    command[before : before + samples] = u
    return command


def step(u: float, seconds: float, Ts: float) -> FloatArray:
    """From 0 to `u` after a tenth."""
    return _core.step(duration=seconds, Ts=Ts, at=0.1 * seconds, low=0.0, high=u)


def trapezoids(fopdt: Fopdt, fastest: float, demands: Demands, Ts: float) -> FloatArray:
    """A reference over the working range, edges from gentle to steep [RPM]."""
    top = demands.top
    hold = 1.5 * fopdt.T
    slow = SLOW * top
    parts = [np.linspace(0.0, slow, max(2, round(0.4 * fopdt.T / Ts)))]
    for height, up, down in TRAPEZOIDS:
        rise, fall = ((height * top - slow) / (share * fastest) for share in (up, down))
        parts.append(
            _core.trapezoid(
                duration=rise + fall + 2.4 * hold,
                Ts=Ts,
                start=0.4 * hold,
                rise=max(rise, Ts),
                hold=hold,
                fall=max(fall, Ts),
                low=slow,
                high=height * top,
            )
        )
    return np.concatenate(parts)


def levels(fopdt: Fopdt, fastest: float, demands: Demands, Ts: float, seed: int) -> FloatArray:
    """A reference of random levels over the working range, to judge models by [RPM]."""
    change = max(0.8 * fopdt.T, 4.0 * demands.speed / fastest)
    return _core.random_steps(
        duration=min(25.0 * change, LONGEST),
        Ts=Ts,
        low=0.1 * demands.speed,
        high=demands.speed,
        hold_min=1.25 * change,
        hold_max=4.0 * change,
        smoothing=change,
        seed=seed,
        start=0.0,
    )


def pulses(fopdt: Fopdt, fastest: float, demands: Demands, Ts: float, seed: int) -> FloatArray:
    """Short commands near the largest, between speeds of the working range [V].

    A drive limits its current there, which no gentle loop reaches and every fast one does. Planned
    with a larger acceleration than the machine has, they stay below the speeds of the plan.
    """
    T = fopdt.T
    return _core.jumps(
        duration=min(PULSES * T, LONGEST),
        Ts=Ts,
        speed_low=SLOW * demands.top,
        speed_high=demands.top,
        change_min=0.25 * demands.top,
        level_min=HARD * demands.u_max,
        level_max=demands.u_max,
        hold_min=0.4 * T,
        hold_max=2.0 * T,
        ramp=0.0,
        gain=fopdt.K,
        acceleration=fastest,
        seed=seed,
    )


# --- References that a drive is verified on, and shorter ones of the same kind to tune on ---------


GENTLE = 0.75
"""Largest share of the machine's acceleration that the standard references ask for."""
BRIEF = 2.5
"""Slowness up to which the ones to tune on last longer; beyond it they cover less."""
SHORT = 0.35
"""Length of the sweeps to tune on, in shares of those to verify on."""


def pace_of(fastest: float, demands: Demands) -> float:
    """How many times longer everything lasts than on a machine that is fast enough."""
    return max(1.0, demands.speed / 0.4 / (GENTLE * fastest))


def standard(fastest: float, demands: Demands, Ts: float, *, short: bool) -> dict[str, FloatArray]:
    """Trapezoid, chirps of shrinking and of growing amplitude, random levels [RPM].

    At 2,000 RPM and a machine that is fast enough: 0 to 2,000 RPM in .4 s; .1 to 3 Hz in 20 s to
    2,000 RPM and to 600; random levels of 200 to 2,000 RPM, 10 s. Other top speeds to scale; where
    the machine is too slow for that all of it lasts longer.

    Parameters
    ----------
    fastest : float
        What the machine accelerates with at the limit of its command [RPM/s].
    short : bool
        Whether to tune on: shorter sweeps, other random levels.
    """
    pace = pace_of(fastest, demands)
    size = demands.speed / 2000.0
    share = SHORT if short else 1.0
    # a slow machine's whole sweeps would be minutes of every loop that a search simulates
    brief = min(pace, BRIEF) if short else pace
    # the change of random levels is half a cosine, steepest in its middle
    change = max(0.2 * pace, 0.5 * math.pi * 1800.0 * size / (GENTLE * fastest))
    return {
        "trapezoid": _core.trapezoid(
            duration=2.0 * pace, Ts=Ts, start=0.1 * pace, rise=0.4 * pace, hold=0.6 * pace,
            fall=0.4 * pace, low=0.0, high=demands.speed,
        ),
        "chirp_hi_lo": _sweep((1080.0, 150.0), (1080.0, 400.0), size, pace, brief * share, Ts),
        "chirp_lo_hi": _sweep((50.0, 250.0), (50.0, 350.0), size, pace, brief * share, Ts),
        "random": _core.random_steps(
            duration=5.0 * brief if short else 10.0 * pace, Ts=Ts, low=200.0 * size,
            high=2000.0 * size, hold_min=1.25 * change, hold_max=4.5 * change, smoothing=change,
            seed=demands.seed + short, start=0.0,
        ),
    }  # fmt: skip


def _sweep(
    amplitude: tuple[float, float],
    offset: tuple[float, float],
    size: float,
    pace: float,
    length: float,
    Ts: float,
) -> FloatArray:
    return _core.chirp(
        duration=20.0 * length, Ts=Ts, f_start=0.1 / pace, f_end=3.0 / pace,
        amplitude_start=size * amplitude[0], amplitude_end=size * amplitude[1],
        offset_start=size * offset[0], offset_end=size * offset[1],
    )  # fmt: skip
