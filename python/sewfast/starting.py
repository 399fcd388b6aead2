"""What tuning begins with: a conservative controller from a model's own step response."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .control import Controller, Fopdt, Gains, fit_fopdt, table_1
from .errors import DataError, FitError, SettingError
from .evidence.linearised import linearise
from .evidence.residuals import representative
from .loop import Plant, plant_units
from .models import Model
from .units import REVOLUTIONS_PER_SECOND

DERIVATIVE_FILTER = 10.0
"""N to begin with."""
_STEP_SHARES = (0.25, 0.5, 0.1)
"""Shares of u_max that the first step response is looked for at."""
_STEP_SAMPLES = (4_000, 16_000)
_INTEGRATES = 1e-5
"""Distance of a pole from 1 below which a step takes far longer than these."""


def first_controller(
    plant: Plant,
    *,
    u_min: float = -20.0,
    u_max: float = 20.0,
    counts_per_rev: float | None = 1572.0,
    filter_samples: int = 8,
) -> Controller:
    """A conservative controller from a model's own step response by Table 1 (nearest row).

    The moving average's delay counts as dead time.

    Raises
    ------
    SettingError
        For a machine: record its step response and use `fit_fopdt` and `table_1`.
    FitError
        Where no step of the model settles.
    """
    if not isinstance(plant, Model):
        raise SettingError(
            "expected a model to find a start from, got a machine; give start=, or tune on a model"
        )
    if not np.isfinite(u_max) or u_max == 0:
        raise SettingError(
            f"expected a finite u_max other than 0 to size the step by, got {u_max}; give the "
            "amplifier's limit"
        )
    u_unit, y_unit = _stated_units(plant)
    fopdt = _step_fit(plant, u_max)
    delayed = replace(fopdt, L=fopdt.L + (filter_samples - 1) / 2 * plant.Ts)
    rule = table_1(delayed, outside="nearest")
    gains = Gains.standard(
        rule.gains.Kp, rule.gains.Ti, rule.gains.Td, u_unit=u_unit, y_unit=y_unit
    )
    turns = y_unit.lower() in REVOLUTIONS_PER_SECOND
    return Controller(
        gains=gains,
        Ts=plant.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=u_min,
        u_max=u_max,
        filter_samples=filter_samples,
        counts_per_rev=counts_per_rev if turns else None,
        notes="Table 1 on the model's step response" + assumed(plant),
    )


def _stated_units(plant: Plant) -> tuple[str, str]:
    """Units of command and output; what a model leaves open counts as volt and RPM."""
    u_unit, y_unit = plant_units(plant)
    return u_unit or "V", y_unit or "RPM"


def assumed(plant: Plant) -> str:
    """What was taken for granted about the units, for a controller's notes."""
    names = ("command in V", "output in RPM")
    open_ = [n for n, unit in zip(names, plant_units(plant), strict=True) if not unit]
    return f"; the model states no unit, taken: {', '.join(open_)}" if open_ else ""


def _step_fit(model: Model, u_max: float) -> Fopdt:
    """The model's step response, at the first size and length at which it settles."""
    if len(model.input_names) != 1:
        raise SettingError(
            f"expected a model with one input to tune on, got {len(model.input_names)}; identify "
            "it from the command alone"
        )
    reason: Exception | None = None
    for share in _STEP_SHARES:
        for samples in _STEP_SAMPLES:
            u = np.zeros(samples)
            u[samples // 20 :] = share * u_max
            try:
                y = model.core.simulate(u[:, None], model.core.rest_state())
                return fit_fopdt(u, y, Ts=model.Ts)
            except (DataError, FitError) as error:
                reason = error
    if _integrates(model):
        raise FitError(
            "expected a model whose step response settles, received one that integrates its input, "
            "as a position does; give a controller to start from, or identify the rate: "
            "differentiate the recorded output"
        ) from reason
    raise FitError(
        f"expected a model whose step response settles, got none up to u = {0.5 * u_max:g} "
        f"({reason}); give a controller to start from"
    ) from reason


def _integrates(model: Model) -> bool:
    """Whether a pole lies at 1, or so near that no step within reach settles."""
    small = linearise(representative(model).core, np.zeros(1))
    finite = bool(np.isfinite(small.A).all())
    return finite and bool(np.any(np.abs(np.linalg.eigvals(small.A) - 1.0) < _INTEGRATES))
