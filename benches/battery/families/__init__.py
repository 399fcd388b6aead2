"""Families of simulated systems: `make(family, seed)` draws a system and its records.

Each seed gives another system: time constants, gains, friction, orders, signal to noise and length
are drawn within the ranges that the family states. Outputs of test records are free of noise. Their
excitation is of the training's kind unless the family says otherwise, inputs are within the range
of the training's, and outputs leave it by little.

Rules of the search may be made on the families of RULES. Those of HELD are only run for the record:
nothing is decided on them. Each half has a motor with friction, an integrator (a position), a chain
of blocks, a linear truth, small records and large ones.

    RULES  first_order_encoder, prbs_drift, dead_time, motor_friction, drive_limit, angle,
           position_periodic, hammerstein, wiener_hammerstein, tanks, duffing, backlash, two_inputs,
           short_lags, short_hammerstein, short_tank, short_motor
    HELD   second_order_encoder, two_mass, three_inputs, motor_loop, slow_drive, position, wiener,
           hammerstein_wiener, bouc_wen, bilinear, gain_scheduled,
           short_oscillator, short_wiener, short_scheduled, short_loop
"""

from __future__ import annotations

import zlib

import numpy as np

from ..simulators import FloatArray
from . import blocks, linear, motors, plants, positions, short
from .system import FAMILIES, Case, Family, Levels, Record, System, Truth, rms

__all__ = [
    "FAMILIES",
    "HELD",
    "RULES",
    "Case",
    "Family",
    "Record",
    "System",
    "Truth",
    "make",
    "rms",
]

CHAPTERS = (linear, motors, positions, blocks, plants, short)
NAMES = tuple(name for chapter in CHAPTERS for name in vars(chapter) if name in FAMILIES)
"""Of all families, in the order of the chapters."""
RULES = tuple(name for name in NAMES if FAMILIES[name].split == "rules")
HELD = tuple(name for name in NAMES if FAMILIES[name].split == "held")


def make(name: str, seed: int) -> Case:
    """The case of a family with this seed; the same one on every machine."""
    entry = FAMILIES[name]
    drawn = entry.draw(np.random.default_rng([seed, zlib.crc32(name.encode())]))
    residuals = [r.y - drawn.truth.simulate(r) for r in drawn.train]
    samples = sum(len(r.y) for r in drawn.train)
    return Case(
        name,
        seed,
        tuple(drawn.train),
        tuple(drawn.test),
        drawn.Ts,
        20 if samples < 2000 else 50,
        entry.is_linear,
        drawn.truth,
        rms(np.concatenate(residuals)),
        _probe(drawn, drawn.gain_levels),
        _probe(drawn, _range(drawn)),
    )


def _range(drawn: System) -> Levels | None:
    """The ends of the recorded first input, each held as long as the other levels."""
    if drawn.gain_levels is None:
        return None
    u = np.concatenate([r.u if r.u.ndim == 1 else r.u[:, 0] for r in drawn.train])
    return float(u.min()), float(u.max()), drawn.gain_levels[2]


def _probe(drawn: System, levels: Levels | None) -> FloatArray | None:
    if levels is None:
        return None
    low, high, hold = levels
    u = np.repeat([low, high], hold)
    # further inputs (a brake) rest
    return u if drawn.inputs == 1 else np.column_stack([u, np.zeros((len(u), drawn.inputs - 1))])
