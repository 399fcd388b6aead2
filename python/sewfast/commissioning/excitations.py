"""The first motion of a machine at rest, and the excitations that follow from it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import _core
from ..causes import LOST, Cause, dead_zone, turns_at_rest, unsettled
from ..control.machine import Machine
from ..dataset import FloatArray
from ..errors import DataError, FitError
from ..recording import Recording
from ..rules import Fopdt, fit_fopdt
from .demands import Demands, Refusal, require

# --- First motion: the command that moves the machine, its direction, and a rough speed -----------


HOLD = 0.8
"""Duration of each [s]."""
MOVED = 0.02
"""Turns that count as motion."""
BLIND, GLANCE = 0.1, 0.1
"""A machine whose encoder has not counted yet gets more than this share of its largest command for
so long first [s]: it may turn unseen."""
STALLS, STALLING = 3, 0.2
"""Stalls under a load that are allowed, and the largest share of the command for them."""


@dataclass(frozen=True)
class Motion:
    """Speed is about `gain (u - threshold)` [RPM], gain in [RPM/V], threshold in [V]."""

    gain: float
    threshold: float

    def command(self, speed: float) -> float:
        """The command that holds about that speed [V]."""
        return self.threshold + speed / self.gain


def first_motion(machine: Machine, demands: Demands) -> Motion:
    """Try commands from small to large until the machine turns at a fair speed.
    Raises `Refusal` if nothing moves, the machine turns the wrong way or gets stuck, or its largest
    command does not reach a fair speed.
    """
    # commands to try, as shares of the largest, the smallest first
    shares = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0)
    # share of the top speed at which the trials end
    enough = 0.2
    levels: list[tuple[float, float]] = []
    stood, stalls, is_blind = 0.0, 0, True
    for share in shares:
        u = share * demands.u_max
        if is_blind and share > BLIND:
            glance = machine.excite(_pulse(u, machine.Ts, GLANCE), f"glance_{100 * share:g}")
            if np.ptp(glance.counts) == 0.0:
                stood = u
                continue
        recording = machine.excite(_pulse(u, machine.Ts), f"motion_{100 * share:g}")
        is_blind = is_blind and np.ptp(recording.counts) == 0.0
        speed = _judged(recording, u, may_stall=stalls < STALLS and share < STALLING)
        if speed is None:
            has_moved = bool(np.ptp(recording.counts) >= MOVED * machine.counts_per_rev)
            stalls += int(has_moved)
            stood = stood if has_moved else u
            continue
        levels.append((u, speed))
        if speed >= enough * demands.speed:
            return _motion(levels, stood)
    require(
        bool(levels),
        f"expected the machine to move at {demands.u_max:g} V at the latest, its encoder counted "
        f"less than {MOVED:g} turns; see whether the drive is enabled, the motor connected and the "
        "shaft free, whether the encoder counts when the shaft is turned by hand, and whether "
        "u_max is too small",
    )
    u, speed = levels[-1]
    raise Refusal(
        f"expected {enough * demands.speed:.4g} RPM within {HOLD:g} s at {u:g} V, a fifth of the "
        f"top speed of {demands.speed:g} RPM, the machine reached {speed:.4g}",
        cause=Cause(
            "out of reach",
            f"{u:g} V reach {speed:.4g} RPM; see what brakes the machine, and whether motor and "
            "supply are made for this speed, or lower speed",
            f"motion_{100 * shares[-1]:g}", None, speed,
        ),
    )  # fmt: skip


def _pulse(u: float, Ts: float, seconds: float = HOLD) -> FloatArray:
    before, hold = round(0.1 / Ts), max(2, round(seconds / Ts))
    command = np.zeros(before + hold)
    command[before:] = u
    return command


def _judged(recording: Recording, u: float, *, may_stall: bool) -> float | None:
    """The speed at the end [RPM]; None if it did not move, or stalled and was allowed to."""
    turns = (recording.counts - recording.counts[0]) / recording.counts_per_rev
    if np.max(np.abs(turns)) < MOVED:
        return None
    require(
        turns[-1] > -MOVED,
        f"expected a positive command to turn the machine forward, at {u:g} V it went "
        f"{turns[-1]:.3g} turns",
        # a load that hangs falls before it is commanded; behind a brake it falls with the command
        turns_at_rest(recording) or Cause(
            "sign",
            "a positive command turns the machine backwards, and a controller would run away; swap "
            "two motor leads or the encoder's A and B, or change the sign of the command in the "
            "drive; or take away the load if it drives the shaft", recording.name, None, -1.0,
        ),
    )  # fmt: skip
    tail = max(2, round(0.1 / recording.Ts))
    speed = 60.0 * (turns[-1] - turns[-tail]) / ((tail - 1) * recording.Ts)
    first = turns[: len(turns) // 2]
    stopped = turns[-1] == turns[-tail] and np.ptp(first) > MOVED
    # travel within which a load over the turn can stop the machine
    if stopped and may_stall and np.max(np.abs(turns)) < 1.0:
        # a load that varies over the turn stops a small command at its hardest angle
        return None
    require(
        not stopped,
        f"expected the machine to keep turning at {u:g} V, it stood still after "
        f"{abs(turns[-1]):.3g} turns: too little travel; free the shaft, take the end stop away, "
        "or see whether the encoder loses counts, or the command is a position",
    )
    return float(speed) if speed > 0.0 and turns[-1] >= MOVED else None


def _motion(levels: list[tuple[float, float]], stood: float) -> Motion:
    """The line through the last two levels, or from the largest command that moved nothing."""
    u, speed = levels[-1]
    before, slower = levels[-2] if len(levels) > 1 else (stood, 0.0)
    gain = max((speed - slower) / (u - before), speed / u)
    return Motion(gain, max(0.0, u - speed / gain))


# --- The step response: gain, time constant and dead time -----------------------------------------


STEP = 0.6
"""Target of the step as a share of the top speed."""


def step_response(machine: Machine, demands: Demands, motion: Motion) -> Fopdt:
    """Record steps until one settles, and fit it.
    Each longer step is so small that even a machine that integrates stays below the top speed.
    Raises `Refusal` if none settles, the fit is poor, or the command cannot reach the top speed.
    """
    # durations to try until the response settles [s]
    durations = (2.0, 6.0, 20.0)
    u = min(motion.command(STEP * demands.speed), demands.u_max)
    reason: Exception | None = None
    for k, seconds in enumerate(durations):
        recording = machine.excite(step(u, seconds, machine.Ts), "step")
        # a longer step would turn it unseen for longer
        require(
            bool(np.ptp(recording.counts) > 0.0),
            f"expected the encoder to count at {u:.3g} V as in the first motion, it counted "
            f"nothing in {seconds:g} s",
        )
        try:
            fopdt = fit_fopdt(recording.u, recording.y, Ts=recording.Ts)
        except (DataError, FitError) as error:
            reason = error
            if seconds < durations[-1]:
                at_worst = float(np.max(recording.y)) * durations[k + 1] / seconds
                room = min(1.0, demands.top / max(at_worst, 1e-3 * demands.top))
                u = motion.threshold + room * (u - motion.threshold)
            continue
        _checked(fopdt, demands, motion, machine.volt)
        return fopdt
    said, _, _ = str(reason).partition("; ")
    raise Refusal(
        f"expected a speed that settles within {durations[-1]:g} s at {u:.3g} V, it did not "
        f"({said}); see what varies: a changing load, a controller inside the drive, a "
        "machine that integrates", cause=unsettled(recording),
    ) from reason  # fmt: skip


def lost_motion(fopdt: Fopdt, demands: Demands, motion: Motion) -> Cause | None:
    """The dead zone of a machine that would reach the top speed but for the command that it loses.
    Of 80 healthy drives and motors none lost more than 9 % of its largest command, of which `LOST`
    counts as none; a dead band of 40 % is seen as 32 %.
    """
    if motion.threshold <= LOST * demands.u_max:
        return None
    u = min(motion.command(STEP * demands.speed), demands.u_max)
    reached = fopdt.K * u + fopdt.offset
    without = demands.top * (u - motion.threshold) / reached if reached > 0.0 else math.inf
    return dead_zone(motion.threshold, "step") if without <= demands.u_max else None


def _checked(fopdt: Fopdt, demands: Demands, motion: Motion, volt: float) -> None:
    # least fit [%]; below it the machine is not of first order with dead time
    least_fit = 80.0
    # a dead zone takes a constant from the command, and leaves the shape of the response
    require(
        fopdt.K > 0.0 and fopdt.fit_percent >= least_fit,
        f"expected a step response of first order with dead time (fit of {least_fit:g} % or more, "
        f"gain above 0), got {fopdt}; see the recording: the load must not change, nor a limit "
        "be reached",
    )
    needed = (demands.top - fopdt.offset) / fopdt.K
    require(
        needed <= demands.u_max,
        f"expected the top speed and a quarter more, {demands.top:.4g} RPM, to need less than "
        f"u_max = {demands.u_max:g} V, the step response says {needed:.3g} V",
        lost_motion(fopdt, demands, motion) or Cause(
            "out of reach",
            f"{demands.u_max:g} V reach {fopdt.K * demands.u_max + fopdt.offset:.4g} RPM; lower "
            f"speed, or {more_command(demands.u_max, volt)}",
            "step", None, needed,
        ),
    )  # fmt: skip


def more_command(u_max: float, volt: float) -> str:
    """What to do about a command at its limit: a limit is raised only if the machine has more."""
    if u_max < volt:
        return "raise u_max if motor and machine bear it"
    return (
        f"see what else takes its speed at the {volt:g} V that it bears: supply, brake, load, the "
        "scale of the command, counts_per_rev"
    )


# --- Signals for a machine of which only a first order with dead time is known --------------------


LONGEST = 60.0
"""Longest excitation [s]."""
SLOW = 0.15
"""Speed between the trapezoids as a share of the top: a shaft held by friction shows nothing."""
TRAPEZOIDS = (
    (0.45, 0.12, 0.12),
    (0.90, 0.40, 0.25),
    (0.25, 0.60, 0.60),
    (1.00, 0.20, 0.35),
    (0.65, 0.60, 0.40),
    (0.30, 0.06, 0.30),
    (0.80, 0.25, 0.15),
)
"""Heights as shares of the top speed, accelerations up and down as shares of the largest."""


def acceleration(fopdt: Fopdt, demands: Demands) -> float:
    """Acceleration at rest under the largest command without a current limit [RPM/s]."""
    return fopdt.K * demands.u_max / fopdt.T


def too_strong(fopdt: Fopdt, demands: Demands, machine: Machine) -> Cause | None:
    """The cause of a machine that a tenth of its largest command takes beyond its stated speed.
    Raises `Refusal` if a single sample of the largest command does: nobody could stop it in time.
    """
    stated = machine.speed if math.isfinite(machine.speed) else 2.0 * demands.top
    settled = fopdt.K * demands.u_max
    # of 27 sound drives and motors the largest command is worth 1 to 3.9 times the stated speed
    if settled <= 10.0 * stated:
        return None
    found = Cause(
        "gain too large",
        f"it turns at {fopdt.K:.4g} RPM per V, so that {stated / fopdt.K:.3g} V of "
        f"{demands.u_max:g} take it to its {stated:g} RPM; check counts_per_rev, the unit of the "
        "command, its scale in the drive; if the gain is meant, give a smaller u_max",
        "step", None, settled / stated,
    )  # fmt: skip
    reached = -settled * math.expm1(-machine.Ts / fopdt.T)
    require(
        reached <= stated,
        f"expected a machine that takes many samples to its {stated:g} RPM at "
        f"{demands.u_max:g} V, one of {machine.Ts:g} s takes it to {reached:.4g} RPM",
        found,
    )
    return found


def acceleration_shown(recording: Recording, demands: Demands) -> float:
    """Measured acceleration under the largest commands [RPM/s]; inf without such commands.
    It is the ninth decile of the changes of speed. Braking does not count: friction helps there as
    much as it hinders here.
    """
    hard = recording.u >= 0.7 * demands.u_max
    # spans for differences of speed, long enough to average the encoder's noise [s]; the shorter
    # ones are for fast machines, whose pulses are shorter
    for span in (max(1, round(seconds / recording.Ts)) for seconds in (0.02, 0.01, 0.005)):
        whole = np.convolve(hard, np.ones(span), "valid")[:-1] >= span
        change = (recording.y[span:] - recording.y[:-span])[: len(whole)][whole]
        # samples near the largest command needed for an estimate of the acceleration
        if len(change) >= 50 and np.quantile(change, 0.9) > 0.0:
            return float(np.quantile(change, 0.9)) / (span * recording.Ts)
    return float("inf")


def require_acceleration(shown: float, fopdt: Fopdt) -> None:
    """Refuse a machine that the largest command accelerates by this [RPM/s], far less than the
    smaller one of its step response did.
    """
    # share of the step's acceleration that a larger command must reach
    slowest = 0.1 * fopdt.K * fopdt.u_high / fopdt.T
    require(
        shown > slowest,
        f"expected the largest command to accelerate the machine by at least {slowest:.3g} RPM/s, "
        f"a tenth of what {fopdt.u_high:.3g} V did in the step response, it did by {shown:.3g}",
    )


def acceleration_from_rest(
    machine: Machine, fopdt: Fopdt, fastest: float, demands: Demands
) -> float:
    """The same from single pulses of the largest command [RPM/s], until one reaches a fair speed.
    Each is twice as long as the one before. Pulses between speeds do not help if they are planned
    with far more acceleration than a drive's current limit allows: they last only milliseconds.
    Where a pulse shows next to nothing, no longer one is tried: the encoder may be lost.
    """
    # shares of the top speed: aim of the first single pulse, and speed that ends the series
    first_share, fair_share = 0.2, 0.35
    samples = max(1, round(first_share * demands.top / (fastest * machine.Ts)))
    while True:
        seconds = samples * machine.Ts
        recording = machine.excite(_single(demands.u_max, samples, machine.Ts), f"limit_{samples}")
        reached = float(np.max(recording.y))
        require_acceleration(reached / seconds, fopdt)
        # a pulse of twice the length reaches at most about twice the speed
        # longest pulse of the series [s]
        if reached >= fair_share * demands.top or seconds >= 1.0:
            return reached / seconds
        samples *= 2


def _single(u: float, samples: int, Ts: float) -> FloatArray:
    before, after = round(0.05 / Ts), round(0.15 / Ts)
    command = np.zeros(before + samples + after)
    command[before : before + samples] = u
    return command


def step(u: float, seconds: float, Ts: float) -> FloatArray:
    """A step from 0 to `u` after a tenth of the time."""
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
    """A reference of random levels over the working range, for judging models [RPM]."""
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
    There a drive limits its current: fast loops reach that limit, gentle ones do not. Pulses
    planned with a larger acceleration than the machine's stay below the planned speeds.
    """
    T = fopdt.T
    return _core.jumps(
        # length of the pulses in time constants
        duration=min(20.0 * T, LONGEST),
        Ts=Ts,
        speed_low=SLOW * demands.top,
        speed_high=demands.top,
        change_min=0.25 * demands.top,
        # least size of a pulse as a share of the largest command; a current limit takes about half
        level_min=0.25 * demands.u_max,
        level_max=demands.u_max,
        hold_min=0.4 * T,
        hold_max=2.0 * T,
        ramp=0.0,
        gain=fopdt.K,
        acceleration=fastest,
        seed=seed,
    )


# --- References for the verification, and shorter ones of the same kind for tuning ----------------


GENTLE = 0.75
"""Largest acceleration of the standard references as a share of the machine's."""


def pace_of(fastest: float, demands: Demands) -> float:
    """Factor by which all references are stretched for a slow machine; 1 for a fast one."""
    return max(1.0, demands.speed / 0.4 / (GENTLE * fastest))


def standard(fastest: float, demands: Demands, Ts: float, *, short: bool) -> dict[str, FloatArray]:
    """Trapezoid, chirps of shrinking and of growing amplitude, random levels [RPM].
    At 2,000 RPM and for a fast machine: 0 to 2,000 RPM in .4 s; .1 to 3 Hz in 20 s up to 2,000 RPM
    and up to 600; random levels of 200 to 2,000 RPM, 10 s. They are scaled to other top speeds, and
    stretched if `fastest`, the acceleration at the command's limit [RPM/s], is too small. With
    `short`, for tuning, sweeps are shorter and random levels differ.
    """
    pace = pace_of(fastest, demands)
    size = demands.speed / 2000.0
    # length of the sweeps for tuning as a share of those for the verification
    share = 0.35 if short else 1.0
    # the complete sweeps of a slow machine would take minutes in every loop that a search simulates
    # largest pace at which the references for tuning still get longer; beyond it they cover less
    brief = min(pace, 2.5) if short else pace
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
