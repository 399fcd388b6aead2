"""The steps that deployed code has to compute, and the loss of single precision.

A model or controller that single precision would change is rejected here, before anything is
written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sewfast import _core
from sewfast.control import Controller
from sewfast.dataset import FloatArray
from sewfast.errors import FitError, SettingError
from sewfast.models import Ensemble, Model
from sewfast.models.base import Combine, EnsembleCore, kept
from sewfast.validation import doubling, largest_pole

MOST_LOSS = 0.01
"""Largest change by single precision that is accepted, as a share of the output's span."""
_SAMPLES = 5000
"""Length of the free run that measures the loss of single precision."""
_MOST_MEMBERS = 64


# --- Models ---------------------------------------------------------------------------------------


def embedded_members(
    model: Model, precision: str
) -> tuple[list[Model], list[_core.EmbeddedModel], Combine]:
    """A model's members, their steps (a network's in scaled units), how outputs combine."""
    members = list(model.members) if isinstance(model, Ensemble) else [model]
    if len(members) > _MOST_MEMBERS:
        raise SettingError(
            name="model", expected=f"at most {_MOST_MEMBERS} members for a processor",
            received=str(len(members)),
            remedy="deploy some of them with Ensemble.of(model.members[:3])",
        )  # fmt: skip
    scaled = {"scaled": precision == "f32"}
    embedded = [m.core.embedded(**(scaled if m.kind == "neural_oe" else {})) for m in members]
    return members, embedded, model.combine if isinstance(model, Ensemble) else "median"


def excitation(model: Model, samples: int) -> FloatArray:
    """Steps over the range that the model was trained on, held for 1 to 80 samples, (N, inputs)."""
    rng = np.random.default_rng(0)
    ranges = model.training.get("input_range") or [[-1.0, 1.0]] * len(model.input_names)
    columns = [
        np.repeat(rng.uniform(low, high, samples), rng.integers(1, 81, samples))[:samples]
        for low, high in ranges
    ]
    return np.ascontiguousarray(np.stack(columns, axis=1))


def at_rest(members: list[Model]) -> tuple[list[FloatArray], FloatArray]:
    """The states of a plant's models at its operating point, and the inputs that hold it there.
    Models of several recordings have none in common: they begin at rest without inputs.
    """
    if len({m.rest.u for m in members}) > 1:
        return [m.core.rest_state() for m in members], np.zeros(len(members[0].rest.u))
    return [m.rest_state() for m in members], np.array(members[0].rest.u)


@np.errstate(over="ignore", invalid="ignore")  # test vectors of an unstable model, as in the C
def combined_run(
    members: list[Model],
    embedded: list[_core.EmbeddedModel],
    combined: Combine,
    u: FloatArray,
    precision: str,
) -> FloatArray:
    """The free run from rest, as the C computes it."""
    states, held = at_rest(members)
    runs = [
        e.run(u, state, held, precision=precision)
        for state, e in zip(states, embedded, strict=True)
    ]
    if precision == "f64":
        return EnsembleCore((), combined).combined(np.array(runs))
    single = np.array(runs, dtype=np.float32)
    if combined != "mean":
        single = np.sort(single, axis=0)[slice(*kept(combined, len(runs)))]
    total = np.zeros(single.shape[1], dtype=np.float32)
    for run in single:
        total = total + run
    return np.asarray(total / np.float32(len(single)), dtype=np.float64)


def model_loss(
    model: Model, members: list[Model], embedded: list[_core.EmbeddedModel], combined: Combine
) -> str:
    """A note on the loss of single precision; `SettingError` if it is more than `MOST_LOSS`."""
    _, exact, _ = embedded_members(model, "f64")
    # errors of an unstable model grow as its outputs do
    samples = min([_SAMPLES, *(n for m in members if (n := doubling(m)) is not None)])
    u = excitation(model, samples)
    with np.errstate(all="ignore"):
        double = combined_run(members, exact, combined, u, "f64")
        single = combined_run(members, embedded, combined, u, "f32")
        span = float(np.ptp(double)) or float(np.max(np.abs(double))) or 1.0
        loss = float(np.max(np.abs(single - double))) / span
    if not np.isfinite(double).all():
        raise FitError(
            name="model", expected="a free run that stays finite over its own input range",
            received="one that leaves it", remedy="identify a stable model",
        )  # fmt: skip
    if not loss <= MOST_LOSS:
        poles = [abs(p) for m in members if m.kind in ("arx", "oe", "iv") for p in m.poles]  # type: ignore[attr-defined]
        slow = f" (its slowest pole is {max(poles):.9g})" if poles else ""
        got = f"{loss:.3%}" if math.isfinite(loss) else "an overflow"
        raise SettingError(
            name="precision",
            expected=f"a model that single precision changes by at most {MOST_LOSS:.0%} of its "
            "span",
            received=f"{got}{slow}",
            remedy="deploy it with precision f64, or identify it at a longer sample time",
        )  # fmt: skip
    return f"single precision changes a free run of {samples} samples by {loss:.1e} of its span"


def runs_away(members: list[Model]) -> list[str]:
    """A note on an unstable model, whatever the precision."""
    unstable = [(n, m) for m in members if (n := doubling(m)) is not None]
    if not unstable:
        return []
    ahead, worst = min(unstable, key=lambda pair: pair[0])
    return [
        f"the model is unstable, with a pole at {largest_pole(worst):.6g}: in any precision its "
        f"free run doubles every {ahead} samples; begin it anew from measured outputs as often"
    ]


# --- The controller -------------------------------------------------------------------------------


def controller_step(controller: Controller, precision: str) -> tuple[Any, list[str]]:
    """A controller's step in a precision, and notes on its loss."""
    core: Any = controller.core()
    if precision == "f64":
        return core, []
    try:
        single = core.single()
    except SettingError as error:
        raise SettingError(
            name="precision",
            expected=f"settings that single precision holds ({error.expected})",
            received=error.received,
            remedy="deploy it with precision f64",
        ) from error
    return single, [_controller_loss(controller, core.numbers, single.numbers)]


def _controller_loss(controller: Controller, double: Any, single: Any) -> str:
    """A note on the loss of single precision; `SettingError` if it would change the controller.
    A gain that becomes 0 is lost. An integral as large as the limits is resolved to 2^-24 of them.
    An error that adds less than half of that per sample does not change it, so a steady error of
    this size remains.
    """
    lost = [k for k in ("kp", "ki", "kd") if double[k] and not single[k]]
    if lost:
        raise SettingError(
            name="precision",
            expected="gains that single precision holds",
            received=", ".join(f"{k} {double[k]:.3g} a sample" for k in lost),
            remedy="deploy it with precision f64",
        )
    limit, still = min(_limit(controller), float(np.finfo(np.float32).max)), 0.0
    for gains in (
        g.to("standard") for g in (controller.gains, *(g for _, g in controller.schedule))
    ):
        if not (gains.Kp and math.isfinite(gains.Ti)):
            continue
        step = abs(gains.Kp) * controller.Ts / gains.Ti
        rests = 0.5 * float(np.spacing(np.float32(limit))) / step
        if rests * abs(gains.Kp) > MOST_LOSS * limit:
            raise SettingError(
                name="precision",
                expected=f"an integral that errors of {MOST_LOSS:.0%} of the working range move in "
                "single precision",
                received=f"Ti {gains.Ti:g} s at a sample time of {controller.Ts:g} s",
                remedy="deploy it with precision f64, or tune it for a longer sample time",
            )
        still = max(still, rests)
    unit = f" {controller.gains.y_unit}" if controller.gains.y_unit else ""
    return (
        f"single precision: errors below {still:.2g}{unit} no longer move an integral as large as "
        "the limits"
        if still
        else "single precision: all gains are held"
    )


def _limit(controller: Controller) -> float:
    """The larger limit of the command; 1 where there is none."""
    return max(
        (abs(v) for v in (controller.u_min, controller.u_max) if math.isfinite(v)), default=1.0
    )


@dataclass(frozen=True)
class Lead:
    """A feedforward's numbers."""

    preview: int
    late: float
    levels: list[list[float]]
    taps: list[float]

    @property
    def kept(self) -> int:
        """References that a step needs."""
        return max(self.preview + 2, len(self.taps) + 1)


def lead_of(numbers: Mapping[str, Any]) -> Lead | None:
    """The feedforward of a controller; None where there is none."""
    lead = Lead(*numbers["feedforward"])
    return lead if lead.levels or lead.taps else None


def early(numbers: Mapping[str, Any]) -> list[str]:
    """A note on the reference of a controller with feedforward."""
    lead = lead_of(numbers)
    if lead is None or lead.preview == 0:
        return []
    plural = "s" if lead.preview > 1 else ""
    return [
        f"the reference arrives {lead.preview} sample{plural} early; where it is not known ahead, "
        "give the present one and be followed that much later"
    ]


def signals(controller: Controller, count: int, precision: str) -> tuple[FloatArray, FloatArray]:
    """Reference and measurement about the size at which the proportional term spans the limits."""
    rng = np.random.default_rng(0)
    gains = controller.gains.to("standard")
    size = _limit(controller) / abs(gains.Kp) if gains.Kp else 1.0
    if controller.schedule:
        size = max(size, 1.5 * controller.schedule[-1][0])
    size = min(size, 1e30 if precision == "f32" else 1e300)
    r = np.repeat(rng.uniform(-size, size, count), 20)[:count]
    y = 0.7 * r + rng.normal(0.0, 0.2 * size, count)
    if precision == "f32":
        r, y = (v.astype(np.float32).astype(np.float64) for v in (r, y))
    return r, y
