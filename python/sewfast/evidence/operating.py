"""Linearisation over the operating range: equilibria, poles, gains, frequency responses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray
from ..dynamic_model import DynamicModel
from ..equilibrium import Linearised, linearise
from ..errors import DataError, SettingError, not_installed
from .region import TrainingRegion, stored_region
from .residuals import representative

INTEGRATES = 2.5e-4
"""Distance of a pole from 1 below which a step takes longer than 16,000 samples to settle."""


def integrating_pole(model: DynamicModel) -> float | None:
    """The pole at 1, or so close, given noise and friction, that no practical step settles; or
    None.
    """
    try:
        small = linearise(representative(model).core, np.zeros(len(model.input_names)))
    except SettingError:
        return None
    if not (small.A.size and np.isfinite(small.A).all()):
        return None
    poles = np.linalg.eigvals(small.A)
    nearest = poles[np.argmin(np.abs(poles - 1.0))]
    return float(nearest.real) if abs(nearest - 1.0) < INTEGRATES else None


# --- Linearisation over the operating range: equilibria, poles, gains, frequency responses --------


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """A linear model about one constant input.

    Attributes
    ----------
    u : array, shape (nu,)
    y : float
        Steady output.
    A, B, C, D : array, shapes (n, n), (n, nu), (1, n), (1, nu)
        Small-signal model in the data's units; the inputs act `delay` samples later.
    delay : int
    settled : bool
        Whether this is an equilibrium. If not, the linear model holds at the last state of a long
        run (an integrator drifts).
    saturated : bool
        Whether the output is on a limit, where no signal passes.
    known : bool
        Whether the training data came near it; also True if the model does not store its region.
    Ts : float
        Sample time [s].
    drift : float
        Change of an integrator's output per sample; 0 for other models.
    """

    u: FloatArray
    y: float
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    delay: int
    settled: bool
    saturated: bool
    known: bool
    Ts: float
    drift: float = 0.0

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Poles in the z plane, the slowest first, without those of the delay (at 0)."""
        found = np.linalg.eigvals(self.A).astype(np.complex128)
        return found[np.argsort(-np.abs(found), kind="stable")]

    @property
    def is_stable(self) -> bool:
        return bool(np.all(np.abs(self.poles) < 1.0))

    @property
    def dc_gain(self) -> FloatArray:
        """Steady output over steady input, shape (nu,); infinite for an integrator."""
        matrix = np.eye(len(self.A)) - self.A
        if len(matrix) and np.linalg.cond(matrix) > 1e10:
            return np.full(self.B.shape[1], np.inf)
        gain: FloatArray = (self.C @ np.linalg.solve(matrix, self.B) + self.D)[0]
        return gain

    @property
    def time_constants(self) -> FloatArray:
        """-Ts/ln|pole| [s], the slowest first; infinite for a pole that does not decay."""
        size = np.abs(self.poles)
        size = np.clip(size, 1e-300, None)
        return np.where(size < 1.0, -self.Ts / np.log(np.minimum(size, 1.0 - 1e-16)), np.inf)

    def response(self, hertz: FloatArray) -> NDArray[np.complex128]:
        """Frequency response, shape (len(hertz), nu)."""
        z = np.exp(2j * np.pi * np.asarray(hertz, dtype=np.float64) * self.Ts)
        eye = np.eye(len(self.A))
        inner = np.linalg.solve(
            z[:, None, None] * eye - self.A, np.broadcast_to(self.B, (len(z), *self.B.shape))
        )
        found: NDArray[np.complex128] = ((self.C @ inner)[:, 0] + self.D) * z[
            :, None
        ] ** -self.delay
        return found

    def bandwidth(self, i: int = 0) -> float:
        """Frequency at which the gain of input i first falls to 1/sqrt 2 of the steady one [Hz].

        NaN if it never does.
        """
        steady = abs(self.dc_gain[i])
        if not 0.0 < steady < math.inf:
            return math.nan
        hertz = np.geomspace(1e-5, 0.5, 2000) / self.Ts
        below = np.flatnonzero(np.abs(self.response(hertz)[:, i]) < steady / math.sqrt(2.0))
        if len(below) == 0:
            return math.nan
        if below[0] == 0:
            return float(hertz[0])
        pair = hertz[below[0] - 1 : below[0] + 1]
        sizes = np.abs(self.response(pair)[:, i]) * math.sqrt(2.0) / steady
        share = math.log(sizes[0]) / math.log(sizes[0] / sizes[1])
        return float(pair[0] * (pair[1] / pair[0]) ** share)

    def to_control(self) -> Any:
        """The linear model with its delay as a `control.StateSpace`.

        Raises
        ------
        SettingError
            If python-control is not installed.
        """
        try:
            import control
        except ImportError as e:
            raise not_installed("control", "to_control", "sewfast[control]") from e
        A, B, C, D = self.delayed()
        return control.ss(A, B, C, D, self.Ts)

    def delayed(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """A, B, C, D with the delay as additional states."""
        A, B, C, D = self.A, self.B, self.C, self.D
        for _ in range(self.delay):
            n, m = B.shape
            A = np.block([[A, B], [np.zeros((m, n + m))]])
            C = np.hstack([C, D])
            B = np.vstack([np.zeros((n, m)), np.eye(m)])
            D = np.zeros_like(D)
        return A, B, C, D

    def to_json(self) -> dict[str, Any]:
        """As JSON values; numbers that are not finite become None."""
        return {
            "u": self.u.tolist(),
            "y": self.y if math.isfinite(self.y) else None,
            "poles": [[p.real, p.imag] for p in self.poles.tolist()],
            "time_constants_s": _finite(self.time_constants),
            "dc_gain": _finite(self.dc_gain),
            "bandwidth_hz": _finite([self.bandwidth(i) for i in range(len(self.u))]),
            "settled": self.settled,
            "saturated": self.saturated,
            "known": self.known,
        }


@dataclass(frozen=True, eq=False)
class OperatingRange:
    """Operating points over the range of the training inputs.

    Attributes
    ----------
    points : tuple of OperatingPoint
        Every input over its range while the others are at mid-range, input by input.
    varied : tuple of int
        Index of the varied input at each point.
    members : tuple of tuple of OperatingPoint
        The points of every member of an ensemble; `points` are then those of the first.
    """

    points: tuple[OperatingPoint, ...]
    varied: tuple[int, ...]
    members: tuple[tuple[OperatingPoint, ...], ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_name: str
    output_unit: str
    Ts: float

    def gain_unit(self, i: int = 0) -> str:
        """Unit of the gain from input i; empty if either unit is unknown."""
        known = self.output_unit and self.input_units[i]
        return f"{self.output_unit}/{self.input_units[i]}" if known else ""

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies for a Bode plot [Hz]: from well below the slowest corner to half the rate."""
        slowest = [
            max((t for t in p.time_constants if math.isfinite(t)), default=self.Ts)
            for p in self.points
        ]
        low = 0.05 / (2.0 * math.pi * max(*slowest, self.Ts))
        return np.geomspace(min(low, 0.05 / self.Ts), 0.5 / self.Ts, 120)

    def __str__(self) -> str:
        header = [*self.input_names, self.output_name, "gain", "slowest [s]", "bandwidth [Hz]", ""]
        rows = [_row(p, i) for p, i in zip(self.points, self.varied, strict=True)]
        widths = [max(len(r[j]) for r in [header, *rows]) for j in range(len(header))]
        return "\n".join(
            "  ".join(c.rjust(w) for c, w in zip(r, widths, strict=True)).rstrip()
            for r in [header, *rows]
        )

    def to_json(self) -> list[dict[str, Any]]:
        """The points as JSON values."""
        return [{"varied": i, **p.to_json()} for p, i in zip(self.points, self.varied, strict=True)]


def operating_range(
    model: DynamicModel, inputs: Sequence[FloatArray] | None = None, points: int = 9
) -> OperatingRange:
    """Linearise a model over the range of its training inputs.

    Parameters
    ----------
    model : Model
    inputs : sequence of array, shape (nu,), or None
        Operating points; None spreads `points` over each input's range in the training data.
    points : int

    Raises
    ------
    DataError
        If the model does not store the range of its training inputs and none are given.
    """
    region = stored_region(model)
    first = representative(model)
    if inputs is None:
        grid, varied = _grid(first, _input_range(model, first), points, region)
    else:
        grid, varied = _given(model, inputs)
    members = model.members or (model,)
    found = tuple(tuple(_points(m, grid, region)) for m in members)
    return OperatingRange(
        found[0], varied, found if len(found) > 1 else (), model.input_names, model.input_units,
        model.output_name, model.output_unit, model.Ts,
    )  # fmt: skip


def _input_range(model: DynamicModel, first: DynamicModel) -> FloatArray:
    """Range of the training inputs, (nu, 2), stored with an ensemble or with its members."""
    ranges = model.training.get("input_range") or first.training.get("input_range")
    if not ranges:
        raise DataError(
            "operating range: expected a model that stores the range of its training inputs, "
            "received one without; identify it again, or give the operating points"
        )
    limits: FloatArray = np.array(ranges, dtype=np.float64)
    return limits


def _grid(
    model: DynamicModel, limits: FloatArray, points: int, region: TrainingRegion | None
) -> tuple[list[FloatArray], tuple[int, ...]]:
    grid: list[FloatArray] = []
    for i in range(len(limits)):
        grid += _closed_in(model, limits, i, points, region)
    return grid, tuple(i for i in range(len(limits)) for _ in range(points))


def _closed_in(
    model: DynamicModel, limits: FloatArray, i: int, points: int, region: TrainingRegion | None
) -> list[FloatArray]:
    """Values of input i near the training data: the height of a pulse, say, was never held."""
    low, high = limits[i]
    # rounds that narrow the range of an input to the values near the training data
    for _ in range(3):
        line = _line(limits, i, low, high, points)
        known = [k for k, p in enumerate(_points(model, line, region)) if p.known]
        if not known or len(known) > 0.7 * points:
            break
        low = line[max(known[0] - 1, 0)][i]
        high = line[min(known[-1] + 1, points - 1)][i]
    return _line(limits, i, low, high, points)


def _line(limits: FloatArray, i: int, low: float, high: float, points: int) -> list[FloatArray]:
    """Input i from low to high, the others at mid-range."""
    grid = np.tile(limits.mean(axis=1), (points, 1))
    grid[:, i] = np.linspace(low, high, points)
    return list(grid)


def _given(
    model: DynamicModel, inputs: Sequence[FloatArray]
) -> tuple[list[FloatArray], tuple[int, ...]]:
    grid = [np.atleast_1d(np.asarray(u, dtype=np.float64)) for u in inputs]
    for u in grid:
        if u.shape != (len(model.input_names),) or not np.isfinite(u).all():
            raise DataError(
                f"inputs: expected finite arrays of shape ({len(model.input_names)},), "
                f"received {u!r}"
            )
    return grid, (0,) * len(grid)


def _points(
    model: DynamicModel, grid: Sequence[FloatArray], region: TrainingRegion | None
) -> list[OperatingPoint]:
    found, state = [], None
    for u in grid:
        small = linearise(model.core, u, state)
        state = small.state
        found.append(_point(model, u, small, region))
    return found


def _point(
    model: DynamicModel, u: FloatArray, small: Linearised, region: TrainingRegion | None
) -> OperatingPoint:
    known = region is None or region.holds(u, small.y)
    return OperatingPoint(
        u, small.y, small.A, small.B, small.C, small.D, small.delay, small.settled,
        small.saturated, known, model.Ts, small.drift,
    )  # fmt: skip


def point_at_level(model: DynamicModel, u: FloatArray, level: float) -> OperatingPoint:
    """The operating point of an integrator at an input that holds its output, at that output."""
    small = linearise(model.core, u, level=level)
    reached = abs(small.y - level) <= 1e-6 * max(abs(level), 1.0)
    return _point(model, u, replace(small, settled=reached), stored_region(model))


def _row(p: OperatingPoint, i: int) -> list[str]:
    note = "" if p.known else "not in the training data"
    note = note if p.settled else "no equilibrium"
    note = "saturated" if p.saturated else note
    note = note if p.is_stable else "unstable"
    numbers = [p.dc_gain[i], float(p.time_constants.max(initial=0.0)), p.bandwidth(i)]
    # an integrator rests at any output and has no steady gain
    return [*("-" if math.isnan(v) else f"{v:.4g}" for v in [*p.u, p.y, *numbers]), note]


def _finite(values: Sequence[float] | FloatArray) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in values]
