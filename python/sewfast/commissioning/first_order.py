"""The step response: gain, time constant and dead time, with the evidence for them."""

from __future__ import annotations

from ..control import Fopdt, fit_fopdt
from ..errors import DataError, FitError
from .bench import Bench
from .demands import Demands
from .excitations import step
from .motion import Motion
from .refusal import Refusal, require

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
