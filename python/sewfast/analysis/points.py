"""`PlantPoint`: a plant linearised at a steady output, and `LoopBode`: L, S and T there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..control.controller import Controller
from ..control.defaults import recorded_outputs
from ..control.loop import Plant
from ..control.margins import Margins, levels_over, loop_response, margins, operating_point
from ..dataset import FloatArray
from ..errors import SettingError
from ..evidence.operating import OperatingPoint, operating_range
from ..machine import VirtualMachine
from ..models import Model
from ..models.conversion import StateSpace
from ..models.linear import LinearDifference

# --- PlantPoint: a plant as a linear system at a steady output ------------------------------------


@dataclass(frozen=True, eq=False)
class PlantPoint:
    """One plant linearised at one steady output.

    Attributes
    ----------
    plant : str
        Title of the plant.
    u, y : float
        Steady input and output [u], [y].
    system : StateSpace
        Model of the deviations, including the delay.
    gain : float
        Steady output over steady input [y/u]; infinite for an integrator.
    known : bool
        Whether the model's training data came near.
    """

    plant: str
    u: float
    y: float
    system: StateSpace
    gain: float
    known: bool
    Ts: float

    # the interface of plants for `margins`
    @property
    def A(self) -> FloatArray:
        """State matrix."""
        return self.system.A

    @property
    def B(self) -> FloatArray:
        """Input matrix."""
        return self.system.B

    @property
    def C(self) -> FloatArray:
        """Output matrix."""
        return self.system.C

    @property
    def D(self) -> FloatArray:
        """Direct feedthrough: 0."""
        return self.system.D

    @property
    def dt(self) -> float:
        """Sample time [s], by its name in toolboxes."""
        return self.Ts


def plant_points(
    plants: Sequence[Plant], names: Sequence[str], speeds: Sequence[float] | None
) -> tuple[tuple[PlantPoint, ...], ...]:
    """The plants at each of the operating points, without those that cannot rest there. `speeds`
    are steady outputs [y], by default spread over the training data of the first model.
    """
    for plant in plants:
        if isinstance(plant, Model) and len(plant.input_names) != 1:
            raise SettingError(
                f"expected models with one input, got one with {len(plant.input_names)}; identify "
                "it from the command alone"
            )
    wanted = _speeds(plants) if speeds is None else [float(s) for s in speeds]
    rows, reason = [], None
    for speed in wanted:
        row = []
        for plant, name in zip(plants, names, strict=True):
            try:
                row.append(_of(plant, name, speed))
            except SettingError as e:
                reason = e
        if row:
            rows.append(tuple(row))
    if not rows:
        raise SettingError(f"expected an output at which a plant can rest: {reason}") from reason
    return tuple(rows)


def _speeds(plants: Sequence[Plant]) -> list[float]:
    first = next((p for p in plants if isinstance(p, Model)), None)
    if first is None:
        return [300.0, 1000.0, 2000.0]
    # of the record only what the model holds: its ends may be noise
    near = operating_range(first).points if first.training.get("input_range") else ()
    known = [p.y for p in near if p.known and p.settled and not p.saturated]
    low, high = first.training.get("output_range") or (
        min(known, default=0.0),
        max(known, default=0.0),
    )
    if known and min(known) < high and max(known) > low:
        low, high = max(low, min(known)), min(high, max(known))
    rest = first.rest.y
    levels = levels_over(low, high, rest)
    if not known or isinstance(first, LinearDifference):
        levels = levels[1:2]
    # two digits of the way from rest are enough for a default
    return [rest + float(f"{level - rest:.2g}") for level in levels]


def recorded_way(plants: Sequence[Plant]) -> float | None:
    """From rest to the farther end of the first model's recorded output [y]; None if unknown."""
    first = next((p for p in plants if isinstance(p, Model)), None)
    known = None if first is None else recorded_outputs(first)
    if first is None or known is None:
        return None
    return max(abs(end - first.rest.y) for end in known) or None


def _of(plant: Plant, name: str, speed: float) -> PlantPoint:
    if isinstance(plant, VirtualMachine):
        return _machine_point(plant, name, speed)
    if isinstance(plant, LinearDifference):
        return _linear_point(plant, name, speed)
    return _model_point(plant, name, operating_point(plant, speed))


def _model_point(model: Model, name: str, p: OperatingPoint) -> PlantPoint:
    system = StateSpace(*p.delayed())
    gain = float(p.dc_gain[0])
    return PlantPoint(name, float(p.u[0]), p.y, system, gain, p.known, model.Ts)


def _linear_point(model: LinearDifference, name: str, y: float) -> PlantPoint:
    num, den = model.to_tf()
    below = float(den.sum())
    gain = float(num.sum()) / below if abs(below) > 1e-12 else math.inf
    u = (y * below - model.core.offset) / float(num.sum()) if num.sum() else 0.0
    known = model.training.get("output_range", (y, y))
    inside = known[0] <= y <= known[1]
    return PlantPoint(name, float(u), y, model.to_ss(), gain, inside, model.Ts)


def _machine_point(machine: VirtualMachine, name: str, speed: float) -> PlantPoint:
    small = machine.linearise(speed)
    system = two_lags(small["gain"], small["T1"], small["T2"], machine.Ts)
    return PlantPoint(name, small["command"], speed, system, small["gain"], True, machine.Ts)


def two_lags(gain: float, T1: float, T2: float, Ts: float) -> StateSpace:
    """`gain/((T1 s + 1)(T2 s + 1))` under a zero-order hold, exactly; T1 and T2 differ."""
    p, q = math.exp(-Ts / T1), math.exp(-Ts / T2)
    # partial fractions: two lags in parallel
    a, b = gain * T1 / (T1 - T2), -gain * T2 / (T1 - T2)
    C = np.array([[a * (1.0 - p), b * (1.0 - q)]])
    return StateSpace(np.diag([p, q]), np.ones((2, 1)), C, np.zeros((1, 1)))


def to_json(point: PlantPoint) -> dict[str, Any]:
    return {
        "plant": point.plant,
        "u": point.u,
        "y": point.y,
        "gain": point.gain if math.isfinite(point.gain) else None,
        "known": point.known,
    }


# --- LoopBode: L, S and T of every plant at one operating point, with margins ---------------------


@dataclass(frozen=True, eq=False)
class LoopBode:
    """The loop around every plant at one operating point.

    Attributes
    ----------
    points : tuple of PlantPoint
        One per plant.
    hertz : array, shape (F,)
    L : array of complex, shape (plants, F)
        Loop gain, broken at the plant's input.
    margins : tuple of Margins
        One per plant.
    """

    points: tuple[PlantPoint, ...]
    hertz: FloatArray
    L: NDArray[np.complex128]
    margins: tuple[Margins, ...]

    @property
    def S(self) -> NDArray[np.complex128]:
        """Sensitivity 1/(1 + L), shape (plants, F)."""
        return np.asarray(1.0 / (1.0 + self.L), dtype=np.complex128)

    @property
    def T(self) -> NDArray[np.complex128]:
        """Complementary sensitivity L/(1 + L), shape (plants, F)."""
        return np.asarray(self.L / (1.0 + self.L), dtype=np.complex128)

    @property
    def level(self) -> float:
        """The steady output [y] of the first plant."""
        return self.points[0].y

    @property
    def Ms(self) -> float:
        """The largest Ms of all plants; infinite if one loop is unstable."""
        return max(m.Ms for m in self.margins)

    @property
    def worst(self) -> Margins:
        """The margins of the plant with the largest Ms."""
        return max(self.margins, key=lambda m: m.Ms)

    def to_json(self) -> dict[str, Any]:
        """Operating point and margins as JSON values; the curves are in the figures."""
        rows = zip(self.points, self.margins, strict=True)
        return {
            "level": self.level,
            "plants": [{**to_json(p), "margins": margins_json(m)} for p, m in rows],
        }


def margins_json(found: Margins) -> dict[str, Any]:
    """Margins as JSON values; numbers that are not finite become None."""
    names = (
        "Ms", "Mt", "gain_margin", "phase_margin_deg", "delay_margin_s", "noise_gain"
    )  # fmt: skip
    values = {n: getattr(found, n) for n in names}
    return {
        "stable": found.stable,
        **{n: v if math.isfinite(v) else None for n, v in values.items()},
    }


def loop_bodes(
    controller: Controller, points: Sequence[Sequence[PlantPoint]], slowest: float
) -> tuple[LoopBode, ...]:
    """The loop at every operating point. Each of `points` has its plants; `slowest` is the time
    constant of the slowest closed-loop pole [s], from which the frequencies begin.
    """
    # lowest frequency relative to that of the slowest closed-loop pole
    low = min(0.02 / (2.0 * math.pi * slowest), 0.01 / controller.Ts)
    hertz = np.geomspace(low, 0.5 / controller.Ts, 240)
    return tuple(_lines_of(controller, tuple(row), hertz) for row in points)


def _lines_of(controller: Controller, row: tuple[PlantPoint, ...], hertz: FloatArray) -> LoopBode:
    omega = 2.0 * math.pi * hertz
    L = np.array([loop_response(controller, p, omega, speed=p.y) for p in row])
    return LoopBode(row, hertz, L, tuple(margins(controller, p, speed=p.y) for p in row))
