"""What tuning begins with: a conservative controller from a model's own step response."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias

from .control.controller import Controller
from .control.defaults import command_limits, drive_step, filter_length, require_one_input
from .control.loop import Plant, plant_units
from .errors import SettingError
from .gains import Gains, whole
from .models import Model
from .rules import table_1
from .units import REVOLUTIONS_PER_SECOND

DERIVATIVE_FILTER = 10.0
"""N to begin with."""

Encoder: TypeAlias = float | Literal["model"] | None


def first_controller(
    plant: Plant,
    *,
    u_min: float | None = None,
    u_max: float | None = None,
    counts_per_rev: Encoder = "model",
    filter_samples: int | None = None,
    output_unit: str | None = None,
) -> Controller:
    """A conservative controller from a model's own step response by Table 1 (nearest row).

    The moving average's delay counts as dead time. Parameters are those of `tune`.

    Raises
    ------
    SettingError
        For a machine: record its step response and use `fit_fopdt` and `table_1`. For limits that
        are neither stated nor recorded, and for an encoder on an output of unknown unit.
    FitError
        Where no step of the model settles.
    """
    if not isinstance(plant, Model):
        raise SettingError(
            "expected a model to find a start from, got a machine; give start=, or tune on a model"
        )
    require_one_input(plant)
    low, high, note = command_limits([plant], u_min, u_max)
    u_unit, y_unit = _units(plant, output_unit)
    step = drive_step(plant, low, high)
    if filter_samples is None:
        filter_samples = filter_length(plant.Ts, step.slowest)
    average = (max(1, whole("filter_samples", filter_samples)) - 1) / 2 * plant.Ts
    rule = table_1(replace(step.fopdt, L=step.fopdt.L + average), outside="nearest")
    gains = Gains.standard(
        rule.gains.Kp, rule.gains.Ti, rule.gains.Td, u_unit=u_unit, y_unit=y_unit
    )
    return Controller(
        gains=gains,
        Ts=plant.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=low,
        u_max=high,
        filter_samples=filter_samples,
        counts_per_rev=_encoder(plant, counts_per_rev, y_unit),
        notes="; ".join(n for n in ("Table 1 on the model's step response", note) if n),
    )


def _units(plant: Model, stated: str | None) -> tuple[str, str]:
    """Units of command and output; empty where nobody says them."""
    u_unit, y_unit = plant_units(plant)
    if stated is not None and not isinstance(stated, str):
        raise SettingError(f"expected a unit as text for output_unit, got {stated!r}")
    if stated and y_unit and stated.lower() != y_unit.lower():
        raise SettingError(
            f"expected the output in the model's unit {y_unit!r}, got output_unit = {stated!r}; "
            "leave it out, or identify the model from converted data"
        )
    return u_unit, y_unit or stated or ""


def _encoder(plant: Model, stated: Encoder, unit: str) -> float | None:
    """Counts of one turn: as stated, else of the counts that the model's output came from."""
    counts = stated
    if isinstance(stated, str):
        if stated != "model":
            raise SettingError(
                f"expected counts_per_rev as a number, None for ideal feedback, or 'model', got "
                f"{stated!r}"
            )
        counts = plant.counts[1] if plant.counts else None
        if unit.lower() not in REVOLUTIONS_PER_SECOND:
            return None
    if counts is not None and not unit:
        raise SettingError(
            f"expected the unit of the output {plant.output_name!r} for an encoder, as the model "
            "states none; give it, output_unit='RPM' (--unit RPM), or name the column "
            f"'{plant.output_name} [RPM]' in the recording"
        )
    return counts  # type: ignore[return-value]
