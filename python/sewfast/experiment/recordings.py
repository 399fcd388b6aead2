"""Recordings of the experiment: open-loop excitations, and one closed loop under first gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .. import signals
from ..control import Controller, Fopdt, fit_fopdt, table_1
from ..recording import Recording
from ..speed import Method, floor_of_J
from .rig import Rig

EXCITATIONS = ("step", "chirp_lo_hi", "chirp_hi_lo", "random", "saturating", "saturating_2")
FILTER_SAMPLES = 8
"""Of the feedback's moving average: one count in a sample is 38 RPM, in eight it is 5."""
LIMIT = 20.0
"""Of the command to either side [V]."""
DERIVATIVE_FILTER = 10.0
_METHODS: tuple[Method, ...] = ("difference", "savgol", "kalman")


def open_loop(rig: Rig, seed: int) -> dict[str, Recording]:
    """Every excitation on the drive, each from rest."""
    return {name: rig.record(signals.excitation(name, seed), name) for name in EXCITATIONS}


def first_order(step: Recording) -> Fopdt:
    """Gain, time constant and dead time from the step response (paper Eq. 10-11)."""
    return fit_fopdt(step.u, step.y, Ts=step.Ts)


def coarse_controller(fopdt: Fopdt, *, Ts: float, counts_per_rev: float) -> Controller:
    """Gains by Table 1, nearest row; the delay of the feedback's filter counts as dead time."""
    delayed = replace(fopdt, L=fopdt.L + (FILTER_SAMPLES - 1) / 2 * Ts)
    rule = table_1(delayed, outside="nearest")
    return Controller(
        gains=rule.gains,
        Ts=Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=-LIMIT,
        u_max=LIMIT,
        filter_samples=FILTER_SAMPLES,
        counts_per_rev=counts_per_rev,
        notes="Table 1 on the recorded step response",
    )


def closed_loop(rig: Rig, controller: Controller) -> Recording:
    """A recording under the first gains, which follow trapezoids.

    The command is replayed: undisturbed, the machine does the same again and shows its counts.
    """
    return rig.record(rig.run(controller, "trapezoids").u, "closed_loop")


def speed_numbers(recording: Recording) -> dict[str, dict[str, float]]:
    """Error and floor of J of each way to a speed, against the true one."""
    true = recording.speed_true
    assert true is not None, "of a virtual machine"
    estimates = {m: recording.speed(m) for m in _METHODS}
    return {
        method: {
            "rmse_rpm": float(np.sqrt(np.mean((y - true) ** 2))),
            "cost_floor": floor_of_J(y, true),
        }
        for method, y in estimates.items()
    }
