"""`Responses`: steps of the reference and of a disturbance, on every plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..control import Controller
from ..dataset import FloatArray
from ..errors import SettingError
from ..loop import ClosedLoopRun, Plant, run
from ..machine import VirtualMachine
from .arguments import finite
from .loading import run_under_load, torque_of
from .points import PlantPoint

SETTLED = 0.02
"""Of the step: where a response counts as settled, unless the output swings by more of itself."""
RECOVERED = 0.01
"""Of what the disturbance would do without control: where it counts as rejected, likewise."""
RISE = (0.1, 0.9)


@dataclass(frozen=True, eq=False)
class Responses:
    """One kind of step on every plant, about one operating point.

    Attributes
    ----------
    kind : str
        `reference` or `disturbance`.
    t : array, shape (N,)
        Time since the step [s]; negative before it.
    r : array, shape (N,)
        Reference [y].
    y, u : array, shape (plants, N)
        True outputs [y] and commands [u].
    plants : tuple of str
    level : float
        The output before the step [y].
    size : float
        Of the reference step [y]; of a disturbance what it would do to the output without control.
    disturbance : float
        Of the step at the plant's input [u]; 0 for a reference step.
    y_unit, u_unit : str
    """

    kind: str
    t: FloatArray
    r: FloatArray
    y: FloatArray
    u: FloatArray
    plants: tuple[str, ...]
    level: float
    size: float
    disturbance: float
    y_unit: str
    u_unit: str

    @property
    def band(self) -> tuple[FloatArray, FloatArray]:
        """The smallest and the largest output of all plants, sample by sample."""
        return self.y.min(axis=0), self.y.max(axis=0)

    def metrics(self) -> tuple[dict[str, float | None], ...]:
        """Per plant.

        Returns
        -------
        tuple of dict
            Of a reference step `rise_ms` (10 to 90 %), `overshoot_percent`, `settling_ms` (within
            `SETTLED` of the step from then on); of a disturbance `peak` [y], `peak_ms`,
            `recovery_ms` (within `RECOVERED` of `size` from then on). None where it does not. What
            the output strayed by before the step, as a load over the turn makes it, is allowed
            for.
        """
        of = _reference_metrics if self.kind == "reference" else _disturbance_metrics
        return tuple(of(self, y) for y in self.y)

    def to_json(self) -> dict[str, Any]:
        """What the responses amount to, as JSON values; the curves are in the figures."""
        return {
            "kind": self.kind,
            "level": self.level,
            "size": self.size,
            "disturbance": self.disturbance,
            "plants": [
                {"plant": name, **m} for name, m in zip(self.plants, self.metrics(), strict=True)
            ],
        }


def _reference_metrics(of: Responses, y: FloatArray) -> dict[str, float | None]:
    after = of.t >= 0.0
    t, share = of.t[after], (y[after] - of.level) / of.size
    low, high = (_first(t, share >= s) for s in RISE)
    rise = None if low is None or high is None else 1e3 * (high - low)
    return {
        "rise_ms": rise,
        "overshoot_percent": 100.0 * max(float(share.max()) - 1.0, 0.0),
        "settling_ms": _since(t, np.abs(share - 1.0) <= max(SETTLED, _own(of, y) / abs(of.size))),
    }


def _disturbance_metrics(of: Responses, y: FloatArray) -> dict[str, float | None]:
    after = of.t >= 0.0
    t, off = of.t[after], y[after] - of.level
    peak = int(np.argmax(np.abs(off)))
    return {
        "peak": float(off[peak]),
        "peak_ms": 1e3 * float(t[peak]),
        "recovery_ms": _since(t, np.abs(off) <= max(RECOVERED * abs(of.size), _own(of, y))),
    }


def _own(of: Responses, y: FloatArray) -> float:
    """How far the output strays from its mean while nothing happens, and a quarter more."""
    before = y[of.t < 0.0]
    return 1.25 * float(np.abs(before - before.mean()).max(initial=0.0))


def _first(t: FloatArray, holds: Any) -> float | None:
    return float(t[int(np.argmax(holds))]) if holds.any() else None


def _since(t: FloatArray, holds: Any) -> float | None:
    """When it begins to hold for good [ms]; None where it does not at the end."""
    outside = np.flatnonzero(~holds)
    if len(outside) == 0:
        return 0.0
    last = int(outside[-1])
    return None if last + 1 == len(t) else 1e3 * float(t[last + 1])


# --- simulation -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Steps:
    """What the responses are to: an operating point, the size of the steps, how long to look.

    Attributes
    ----------
    level, step : float
        The output before the step, and the reference's step [y].
    disturbance : float
        At the plant's input [u].
    samples : int
        After the step; as many lead to the operating point, and half as many are shown before.
    """

    level: float
    step: float
    disturbance: float
    samples: int


def responses(
    controller: Controller, plants: Sequence[Plant], names: Sequence[str], steps: Steps
) -> tuple[Responses, Responses]:
    """Reference step and disturbance step, with the encoder, the filters and the limits."""
    n = steps.samples
    lead = 3 * n
    ramp = np.interp(np.arange(lead), [0, n], [0.0, steps.level])
    r = np.concatenate([ramp, np.full(n, steps.level)])
    raised = np.concatenate([ramp, np.full(n, steps.level + steps.step)])
    d = np.where(np.arange(len(r)) < lead, 0.0, steps.disturbance)
    tracked = [run(controller, p, raised, name="reference step") for p in plants]
    upset = [_disturbed(controller, p, r, d) for p in plants]
    first = lead - n // 2
    made = [_cut(raised, tracked, lead, first, steps, names, "reference")]
    made.append(_cut(r, upset, lead, first, steps, names, "disturbance"))
    return made[0], replace(made[1], disturbance=steps.disturbance)


def _disturbed(controller: Controller, plant: Plant, r: FloatArray, d: FloatArray) -> ClosedLoopRun:
    """A load takes what a negative disturbance at the input takes."""
    if isinstance(plant, VirtualMachine):
        load = torque_of(plant, 1.0) * -d
        return run_under_load(controller, plant, r, load, name="disturbance step")
    return run(controller, plant, r, disturbance=d, name="disturbance step")


def _cut(
    r: FloatArray, runs: Sequence[ClosedLoopRun], lead: int, first: int, steps: Steps,
    names: Sequence[str], kind: str,
) -> Responses:  # fmt: skip
    gains = runs[0].controller.gains
    t = (np.arange(first, len(r), dtype=np.float64) - lead) * runs[0].Ts
    return Responses(
        kind, t, r[first:], np.array([x.y[first:] for x in runs]),
        np.array([x.u[first:] for x in runs]), tuple(names), steps.level, steps.step, 0.0,
        gains.y_unit, gains.u_unit,
    )  # fmt: skip


def default_steps(
    controller: Controller,
    points: Sequence[PlantPoint],
    slowest: float,
    *,
    level: float | None,
    step: float | None,
    disturbance: float | None,
    seconds: float | None,
) -> Steps:
    """Steps that fit a plant: a tenth of its level, a disturbance that would do the same.

    Parameters
    ----------
    controller : Controller
    points : sequence of PlantPoint
        The plants about the operating point.
    slowest : float
        Time constant of the slowest closed-loop pole [s].
    level, step, disturbance, seconds : float or None
        Instead of the defaults.

    Raises
    ------
    SettingError
        For what is not finite, a step of 0, or seconds that are not above 0.
    """
    given = {"level": level, "step": step, "disturbance": disturbance, "seconds": seconds}
    checked = {name: finite(name, v) for name, v in given.items() if v is not None}
    if checked.get("step", 1.0) == 0.0 or checked.get("disturbance", 1.0) == 0.0:
        raise SettingError("expected a step and a disturbance other than 0, got 0; leave it out")
    if checked.get("seconds", 1.0) <= 0.0:
        raise SettingError(f"expected seconds above 0, got {seconds:g}")
    level = points[0].y if level is None else level
    gains = [abs(p.gain) for p in points if math.isfinite(p.gain) and p.gain]
    gain = float(np.median(gains)) if gains else math.inf
    half = 0.5 * (controller.u_max - controller.u_min)
    if step is None:
        small = 0.01 * half * gain if math.isfinite(half * gain) else 1.0
        step = 0.1 * abs(level) if level else small
    if disturbance is None:
        disturbance = -step / gain if math.isfinite(gain) else -0.05 * (
            half if math.isfinite(half) else 1.0
        )  # fmt: skip
    if seconds is None:
        seconds = 5.0 * slowest
    samples = round(seconds / controller.Ts)
    return Steps(float(level), float(step), float(disturbance), min(max(samples, 200), 20_000))
