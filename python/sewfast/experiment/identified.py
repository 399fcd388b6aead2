"""Models of the experiment, and what they predict."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from ..dataset import Dataset
from ..evidence.figures import figures
from ..identification import identify
from ..machine import VirtualMachine
from ..models import Model
from ..recording import Recording, record
from ..report.artefacts import SCORED, record_of
from ..report.canvas import style, svg
from ..report.figures.trust import CAPTIONS
from ..signals import excitation
from ..validation import Validation, validate

PAPER_RECORDS = ("chirp_lo_hi",)
"""What the paper trains on."""
ALL_RECORDS = ("chirp_lo_hi", "saturating", "closed_loop")
"""What the default network trains on: the drive's limits and the controller's world as well."""
_SCALE = 1000.0
"""The paper's unit of speed [RPM]."""


def paper(recordings: Mapping[str, Recording], seed: int) -> Model:
    """The paper's network, on differences of counts as in the paper."""
    lo_hi = recordings["chirp_lo_hi"]
    data = lo_hi.dataset(lo_hi.speed("difference"))
    return identify(data, model="neural_oe", preset="paper", seed=seed)


def ideal_cost(machine: VirtualMachine, seed: int) -> float:
    """J of the paper's network in free run on Lo-Hi, on a machine without encoder and turn.

    Exact position instead of counts, and load, inertia and torque at their means over the turn.
    """
    parameters = machine.parameters | {"angle_dependence": 0.0, "quantisation": 0.0}
    ideal = VirtualMachine(parameters=parameters)
    lo_hi = record(ideal, excitation("chirp_lo_hi", seed), name="ideal", method="difference")
    model = identify(lo_hi.dataset(), model="neural_oe", preset="paper", seed=seed)
    return float(model.training["cost"])


def arx_raw(recordings: Mapping[str, Recording]) -> Model:
    """ARX on differences of counts, as the paper's rival was."""
    lo_hi = recordings["chirp_lo_hi"]
    return identify(lo_hi.dataset(lo_hi.speed("difference")), model="arx")


def linear(
    recordings: Mapping[str, Recording], kind: Literal["arx", "oe"], records: tuple[str, ...]
) -> Model:
    """A linear model by least squares or by output error."""
    return identify(_together(recordings, records), model=kind)


def neural(recordings: Mapping[str, Recording], seed: int) -> Model:
    """The default network."""
    return identify(_together(recordings, ALL_RECORDS), model="neural_oe", seed=seed)


def scores(
    models: Mapping[str, Model], recordings: Mapping[str, Recording]
) -> dict[str, dict[str, Validation]]:
    """Free run and one step of every model on every scored record, from rest, against the truth."""
    data = {r: recordings[record_of(r)].dataset() for r in SCORED}
    return {
        name: {r: validate(m, d, init=0, against="speed_true") for r, d in data.items()}
        for name, m in models.items()
    }


def report_card(model: Model, recording: Recording) -> tuple[dict[str, Any], dict[str, str]]:
    """The card of a model on a recording as JSON values, and its figures as inline SVG."""
    card = model.check(recording.dataset())
    with style():
        drawn = {
            name: svg(figure, f"check-{name}", CAPTIONS[name][1])
            for name, figure in figures(card).items()
        }
    return {**card.to_json(), "figures": list(drawn)}, drawn


def predictions(
    scored: Mapping[str, Mapping[str, Validation]],
) -> dict[str, dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]]:
    """Per scored record the series of every model, as the report draws them."""
    columns: dict[str, dict[str, Any]] = {r: {} for r in SCORED}
    for model, by_record in scored.items():
        for name, validation in by_record.items():
            series = validation.experiments[0]
            columns[name][f"{model}_simulation"] = series.simulated
            columns[name][f"{model}_one_step"] = series.one_step
    return columns


def identification_numbers(
    models: Mapping[str, Model],
    scored: Mapping[str, Mapping[str, Validation]],
    cost_floor: float,
) -> dict[str, dict[str, Any]]:
    """`identification` of `results.json`."""
    numbers = {
        name: {r: _score(v) for r, v in scored[name].items()} | _story(model)
        for name, model in models.items()
    }
    training = models["paper"].training
    on_training = scored["paper"]["chirp_lo_hi"]
    numbers["paper"] |= {
        "cost": training["cost"],
        "cost_floor": cost_floor,
        "cost_true": _cost(on_training.simulation.rmse),
        "cost_one_step": _cost(on_training.one_step.rmse),
        "iterations": training["iterations"],
    }
    return numbers


def _together(recordings: Mapping[str, Recording], records: tuple[str, ...]) -> Dataset:
    return Dataset.concat([recordings[r].dataset() for r in records])


def _score(validation: Validation) -> dict[str, dict[str, float]]:
    horizons = {"simulation": validation.simulation, "one_step": validation.one_step}
    return {
        horizon: {"rmse_rpm": s.rmse, "fit_percent": s.fit_percent}
        for horizon, s in horizons.items()
    }


def _story(model: Model) -> dict[str, Any]:
    return {
        "trained_on": [d["name"] for d in model.training["data"]],
        "seconds": model.training["seconds"],
        "termination": model.training["termination"],
    }


def _cost(rmse: float) -> float:
    """J of an error [RPM] in the paper's scaled units (paper Eq. 4)."""
    return (rmse / _SCALE) ** 2 / 2.0
