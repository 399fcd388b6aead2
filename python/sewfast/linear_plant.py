"""Linear plants in whatever form they come, as a fraction in z^-1 at a sample time."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from . import _core
from .dataset import FloatArray
from .errors import SettingError
from .models.conversion import from_state_space, polynomials_of, transfer_function

_GRID = 25
"""Constant commands among which a speed is sought."""
_HALVINGS = 20
"""Of the interval in which it lies."""


def sampled(plant: Any, Ts: float, speed: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator in powers of z^-1, shapes (m,) and (n + 1,).

    Parameters
    ----------
    plant : Fopdt, model, OperatingPoint, or system of python-control or scipy.signal
    Ts : float
        Sample time [s]; what is continuous is sampled under a zero-order hold.
    speed : float, optional
        Steady output about which a nonlinear model is linearised.

    Raises
    ------
    SettingError
        For several inputs, another sample time, a nonlinear model without a speed, or what is no
        plant.
    """
    if all(hasattr(plant, name) for name in ("K", "T", "L")):
        return _core.sampled_fopdt(plant.K, plant.T, plant.L, Ts=Ts)
    if hasattr(plant, "core") and hasattr(plant, "input_names"):
        return _of_model(plant, Ts, speed)
    if all(hasattr(plant, name) for name in ("delay", "settled", "delayed")):
        return _of_point(plant, Ts)
    return _of_system(plant, Ts)


def _of_model(model: Any, Ts: float, speed: float | None) -> tuple[FloatArray, FloatArray]:
    _require(len(model.input_names), model.Ts, Ts)
    if hasattr(model, "to_tf"):
        num, den = transfer_function(model.core)
        return num[0].copy(), den
    if model.members:
        raise SettingError(
            "expected one plant, received an ensemble; take the margins of each of its members, or "
            "analyse the controller on all of them"
        )
    if speed is None:
        raise SettingError(
            "expected the speed at which the nonlinear model is linearised, received none; give "
            "speed, or the linear model about a command: model.linearise(u)"
        )
    return _of_point(operating_point(model, speed), Ts)


def operating_point(model: Any, speed: float) -> Any:
    """The `OperatingPoint` of a model with one input whose steady output is `speed`.

    Raises
    ------
    SettingError
        Where no command within the range of the training data holds that speed.
    """
    from .evidence.operating import operating_range

    low, high = model.training.get("input_range", [[-1.0, 1.0]])[0]
    grid = operating_range(model, [np.array([u]) for u in np.linspace(low, high, _GRID)]).points
    if not any(p.settled for p in grid) and any(p.drift for p in grid):
        return _integrating_point(model, grid, speed)
    pairs = [p for p in itertools.pairwise(grid) if (p[0].y - speed) * (p[1].y - speed) <= 0.0]
    if not pairs:
        reached = [p.y for p in grid]
        raise SettingError(
            f"expected a speed that the model holds at a constant command, received {speed:g}; "
            f"from {low:.4g} to {high:.4g} it reaches {min(reached):.4g} to {max(reached):.4g}"
        )
    below, above = pairs[0]
    # halves, as steady outputs may jump where friction lets go
    for _ in range(_HALVINGS):
        found = operating_range(model, [0.5 * (below.u + above.u)]).points[0]
        if (found.y - speed) * (below.y - speed) > 0.0:
            below = found
        else:
            above = found
    return _require_steady(above, speed)


def _integrating_point(model: Any, grid: Any, level: float) -> Any:
    """Where an integrator keeps its output: at a command of its own, at any level."""
    from .evidence.operating import operating_range, point_at_level

    pairs = [p for p in itertools.pairwise(grid) if p[0].drift * p[1].drift <= 0.0]
    if not pairs:
        raise SettingError(
            "expected a command at which the integrating model keeps its output, received none: "
            f"from {grid[0].u[0]:.4g} to {grid[-1].u[0]:.4g} it always moves the same way; record "
            "both ways and identify again"
        )
    below, above = pairs[0]
    for _ in range(_HALVINGS):
        found = operating_range(model, [0.5 * (below.u + above.u)]).points[0]
        if found.drift * below.drift > 0.0:
            below = found
        else:
            above = found
    return _require_steady(point_at_level(model, above.u, level), level)


def _require_steady(point: Any, speed: float) -> Any:
    if not point.settled or point.saturated:
        raise SettingError(
            f"expected a steady state at {speed:g}, received one that "
            f"{'lies on a limit of the output' if point.saturated else 'does not settle'}; take "
            "another speed"
        )
    return point


def _of_point(point: Any, Ts: float) -> tuple[FloatArray, FloatArray]:
    _require(len(point.u), point.Ts, Ts)
    num, den = from_state_space(point.A, point.B, point.C, point.D)
    return np.concatenate([np.zeros(point.delay), num[0]]), den


def _of_system(system: Any, Ts: float) -> tuple[FloatArray, FloatArray]:
    if not any(hasattr(system, name) for name in ("num", "A", "zeros")):
        raise SettingError(
            "expected an Fopdt, a model, an operating point or a system of python-control or "
            f"scipy.signal, received {type(system).__name__}"
        )
    inputs, outputs = (getattr(system, name, 1) for name in ("ninputs", "noutputs"))
    _require(inputs or 1, Ts, Ts)
    if (outputs or 1) != 1:
        raise SettingError(f"expected one output, received {outputs}; take one of them")
    try:
        discrete = _discrete(system, Ts)
    except (ValueError, NotImplementedError) as error:
        raise SettingError(
            f"expected a proper linear system to sample under a zero-order hold, received {error}"
        ) from error
    num, den, _ = polynomials_of(discrete, Ts)
    _require(len(num), Ts, Ts)
    return np.ascontiguousarray(num[0]), np.ascontiguousarray(den)


def _discrete(system: Any, Ts: float) -> Any:
    """A system in continuous time as it is under a zero-order hold; others as they are."""
    if getattr(system, "dt", math.nan) not in (0, None):
        return system
    if type(system).__module__.startswith("control."):
        import control

        # python-control keeps None for an unspecified time base: nothing is assumed about it
        return control.sample_system(system, Ts, method="zoh") if system.dt == 0 else system
    if hasattr(system, "to_discrete"):
        return system.to_ss().to_discrete(Ts, method="zoh")
    return system


def _require(inputs: int, of: float, Ts: float) -> None:
    if inputs != 1:
        raise SettingError(f"expected a plant with one input, received {inputs}; take one of them")
    if not math.isclose(of, Ts, rel_tol=1e-9):
        raise SettingError(
            f"expected a plant at the controller's sample time of {Ts:g} s, received one at "
            f"{of:g} s; resample one of them"
        )
