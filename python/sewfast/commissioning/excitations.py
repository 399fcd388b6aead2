"""Commands and references that are planned from what the machine has shown."""

from __future__ import annotations

import numpy as np

from .. import _core
from ..dataset import FloatArray
from ..recording import Recording
from ..rules import Fopdt
from .demands import Demands

# --- Signals for a machine that is known as a first order with dead time only ---------------------


SPAN = 0.02
"""Over which a change of speed is an acceleration and not the encoder's noise [s]."""
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
    """What the machine does under the pulses [RPM/s]: the ninth decile of its changes of speed."""
    span = max(1, round(SPAN / recording.Ts))
    hard = np.abs(recording.u) >= 0.7 * demands.u_max
    whole = np.convolve(hard, np.ones(span), "valid")[:-1] >= span
    change = np.abs(recording.y[span:] - recording.y[:-span])[: len(whole)][whole]
    if len(change) < LEAST_HARD:
        return float("inf")
    return float(np.quantile(change, 0.9)) / (span * recording.Ts)


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
    return {
        "trapezoid": _core.trapezoid(
            duration=2.0 * pace, Ts=Ts, start=0.1 * pace, rise=0.4 * pace, hold=0.6 * pace,
            fall=0.4 * pace, low=0.0, high=demands.speed,
        ),
        "chirp_hi_lo": _sweep((1080.0, 150.0), (1080.0, 400.0), size, pace, brief * share, Ts),
        "chirp_lo_hi": _sweep((50.0, 250.0), (50.0, 350.0), size, pace, brief * share, Ts),
        "random": _core.random_steps(
            duration=5.0 * brief if short else 10.0 * pace, Ts=Ts, low=200.0 * size,
            high=2000.0 * size, hold_min=0.25 * pace, hold_max=0.9 * pace, smoothing=0.2 * pace,
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
