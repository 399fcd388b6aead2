"""Plants and controllers with known loops, for the tests of what judges and analyses them."""

import math
from typing import Any

import numpy as np

from sewfast import _core
from sewfast.control import Controller, Gains
from sewfast.models import LinearOE

QUIET = Controller(
    Gains.standard(0.02, 0.05, 0.003),
    alpha=0.3,
    N=5,
    u_min=-20,
    u_max=20,
    filter_samples=8,
    counts_per_rev=1572,
)
"""Tracks on the virtual machine and on `drive()`, far from its limits of stability."""


def drive(
    T1: float = 0.252, T2: float = 0.0074, gain: float = 490.0, training: Any = None
) -> LinearOE:
    """A motor of 490 RPM/V with two time constants [s], sampled every millisecond."""
    p, q = math.exp(-0.001 / T1), math.exp(-0.001 / T2)
    b = gain * (1 - p) * (1 - q) / 2
    core = _core.LinearModel(np.array([-p - q, p * q]), np.array([[b, b]]), 1, 0.0)
    record = {"input_range": [[-20.0, 20.0]]} if training is None else training
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", training=record)
