"""References that a drive is verified on, and shorter ones of the same kind to tune on."""

from __future__ import annotations

from .. import _core
from ..dataset import FloatArray
from .demands import Demands

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
