"""A drive of first order with an encoder, and the controller of its moves."""

from __future__ import annotations

from typing import Any

import numpy as np

from sewfast import Controller, Feedforward, Gains, LinearOE, _core

RAMP = np.clip((np.arange(900) - 100) * 15.0, 0.0, 1500.0)
LEAD = Feedforward(6, 0.5, ((-3000.0, -6.5), (0.0, 0.0), (3000.0, 6.5)), (0.4, 0.2))
PI = Controller(
    Gains.standard(0.01, 0.1), u_min=-20, u_max=20, filter_samples=8, counts_per_rev=1572
)


def drive(time: float = 0.25, gain: float = 490.0, delay: int = 4) -> LinearOE:
    """A lag [s] with a gain [RPM/V] and a delay [samples of 1 ms]."""
    pole = np.exp(-0.001 / time)
    core = _core.LinearModel(np.array([-pole]), np.array([[gain * (1 - pole)]]), delay, 0.0)
    known = {"input_range": [[-20.0, 20.0]], "output_range": [-3500.0, 3500.0]}
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), known)


def rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def error(found: Any) -> float:
    """Tracking error of a run [RPM rms]."""
    return rms(found.y - found.r)
