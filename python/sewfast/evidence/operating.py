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
from ..errors import DataError, SettingError, SewfastError, not_installed
from .region import TrainingRegion, stored_region
from .residuals import representative

# --- Small signals of the compiled models about their equilibria ----------------------------------


_RUN = 2000
"""Samples of constant input to bring a model near its equilibrium."""
_NEWTON = 30


INTEGRATES = 2.5e-4
"""Distance of a pole from 1 below which a step takes longer than 16,000 samples to settle."""


@dataclass(frozen=True, eq=False)
class Linearised:
    """x+ = A x + B v, y = C x + D v in small signals, v(k) = u(k - delay); in the data's units.

    Attributes
    ----------
    state : array
        State of the linearisation, as for the compiled model's `simulate`.
    drift : float
        Change of an integrator's output per sample at this state; 0 for other models.
    """

    y: float
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    delay: int
    settled: bool
    saturated: bool
    state: FloatArray
    drift: float = 0.0


def linearise(
    core: Any, u: FloatArray, state: FloatArray | None = None, level: float | None = None
) -> Linearised:
    """Linearise about the equilibrium at a constant input, searched from `state` (None: rest).

    Parameters
    ----------
    core : compiled model
    u : array, shape (nu,)
    state : array, optional
    level : float, optional
        Output level for an integrator, which rests at any level or at none.

    Raises
    ------
    SettingError
        For an object that is no compiled model, linear, lagged or state space.
    """
    u = np.ascontiguousarray(u, dtype=np.float64)
    if hasattr(core, "a") and hasattr(core, "offset"):
        return _linear(core, u, level)
    settings = core.settings
    if "na" in settings:
        return _network(core, settings, u, state)
    if "nx" in settings:
        return _state_space(core, settings, u, state, level)
    raise SettingError(f"linearise: expected a model of sewfast, received {type(core).__name__}")


def integrating_pole(model: DynamicModel) -> float | None:
    """The pole at 1, or so close that no practical step settles; None if there is none.

    A record of a position determines it up to noise and friction.
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


# --- lagged models -------------------------------------------------------------------------------


def _linear(core: Any, u: FloatArray, level: float | None) -> Linearised:
    left = 1.0 + core.a.sum()
    push = float(core.b.sum(axis=1) @ u + core.offset)
    settled = bool(abs(left) > 1e-12)
    if settled:
        y, drift = push / left, 0.0
    else:
        # A(q) = (1 - q^-1) F(q): the output moves by push / F(1) a sample
        rest = float(np.cumsum(np.concatenate([[1.0], core.a]))[:-1].sum())
        y = np.nan if level is None else level
        drift = push / rest if rest != 0.0 else np.inf
    state = np.full(core.na, y if np.isfinite(y) else 0.0)
    return _difference(-core.a, core.b, core.nk, y, settled, False, state, drift)


def _network(core: Any, s: dict[str, Any], u: FloatArray, state: FloatArray | None) -> Linearised:
    na, nb = s["na"], s["nb"]

    def slopes(y: float) -> tuple[float, FloatArray, FloatArray]:
        """f at constant y and u, and its slopes in every past output (na,) and input (nu, nb)."""
        past = np.full(na, y)
        value = float(core.simulate(u[None, :], past)[0])
        _, _, C, D = core.linearise(u, np.concatenate([past, np.repeat(u, nb - 1)]))
        return value, C[0, :na], np.hstack([D.T, C[0, na:].reshape(len(u), nb - 1)])

    y = _steady(core, u, np.zeros(na) if state is None else state)
    # for a model without scales, the magnitude of the output there
    scale = s.get("y_scale", max(abs(y), 1e-6))
    settled = False
    for _ in range(_NEWTON):
        value, to_y, _ = slopes(y)
        step = (value - y) / (1.0 - to_y.sum()) if abs(1.0 - to_y.sum()) > 1e-12 else np.inf
        settled = bool(abs(step) <= 1e-9 * scale)
        if settled or not np.isfinite(step) or abs(step) > 100.0 * scale:
            break
        y += step
    _, to_y, to_u = slopes(y)
    limited = any(s.get(name) is not None for name in ("output_low", "output_high"))
    # on a limit nothing moves the output
    saturated = limited and not (to_y.any() or to_u.any())
    return _difference(to_y, to_u, s["nk"], y, settled, saturated, np.full(na, y))


def _steady(core: Any, u: FloatArray, state: FloatArray) -> float:
    """The output after a long constant input; if that diverges, the output of the state."""
    try:
        return float(core.simulate(np.tile(u, (_RUN, 1)), state)[-1])
    except SewfastError:
        return float(state[0]) if len(state) else 0.0


def _difference(
    to_y: FloatArray, to_u: FloatArray, nk: int, y: float, settled: bool, saturated: bool,
    state: FloatArray, drift: float = 0.0,
) -> Linearised:  # fmt: skip
    """Observer form of y(k) = sum to_y_i y(k-i) + sum to_u_ji v_j(k-i+1)."""
    n = max(len(to_y), to_u.shape[1] - 1)
    a, later = np.zeros(n), np.zeros((n, len(to_u)))
    a[: len(to_y)] = to_y
    later[: to_u.shape[1] - 1] = to_u[:, 1:].T
    d = to_u[:, 0]
    A = np.eye(n, k=1)
    A[:, 0] += a
    B = later + np.outer(a, d)
    return Linearised(y, A, B, np.eye(1, n), d[None, :], nk, settled, saturated, state, drift)


# --- state space ---------------------------------------------------------------------------------


def _state_space(
    core: Any, s: dict[str, Any], u: FloatArray, state: FloatArray | None, level: float | None
) -> Linearised:
    x = _last_state(core, u, core.rest_state() if state is None else state)
    # an integrator's last state drifts, and no other state depends on it
    free = len(x) - 1 if s["integrator"] else len(x)
    held = np.tile(u, (2, 1))
    settled = False
    for _ in range(_NEWTON):
        matrix = (np.eye(len(x)) - core.linearise(u, x)[0])[:free, :free]
        if free and np.linalg.cond(matrix) > 1e12:
            break
        step = np.linalg.solve(matrix, (core.states(held, x)[1] - x)[:free])
        settled = bool(np.abs(step).max(initial=0.0) <= 1e-9)
        if settled or not np.isfinite(step).all() or np.abs(step).max(initial=0.0) > 100.0:
            break
        x = x.copy()
        x[:free] += step
    settled = settled and bool(np.abs(core.states(held, x)[1] - x).max(initial=0.0) <= 1e-6)
    if s["integrator"] and level is not None:
        x = _moved_to(core, u, x, level)
    A, B, C, D = core.linearise(u, x)
    y, following = np.ravel(core.simulate(held, x))
    drift = float(following - y) if s["integrator"] else 0.0
    return Linearised(float(y), A, B, C[:1], D[:1], s["nk"], settled, False, x, drift)


def _moved_to(core: Any, u: FloatArray, x: FloatArray, level: float) -> FloatArray:
    """The integrator's state, the last one, at which the output is `level`, by Newton's method.

    If the output function does not reach that level, the state is returned unchanged.
    """
    moved = x.copy()
    for _ in range(_NEWTON):
        left = level - float(np.ravel(core.simulate(u[None, :], moved))[0])
        if abs(left) <= 1e-9 * max(abs(level), 1.0):
            return moved
        slope = float(core.linearise(u, moved)[2][0, -1])
        if abs(slope) < 1e-12:
            break
        moved[-1] += left / slope
        if not np.isfinite(moved).all():
            break
    return x


def _last_state(core: Any, u: FloatArray, state: FloatArray) -> FloatArray:
    try:
        last = np.array(core.states(np.tile(u, (_RUN, 1)), state)[-1])
    except SewfastError:
        return np.array(state)
    return last if np.isfinite(last).all() else np.array(state)


# --- Linearisation over the operating range: equilibria, poles, gains, frequency responses --------


POINTS = 9
FREQUENCIES = 120
_CLOSING = 3
"""Rounds that narrow the range of an input to the values near the training data."""


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
        return np.geomspace(min(low, 0.05 / self.Ts), 0.5 / self.Ts, FREQUENCIES)

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
    model: DynamicModel, inputs: Sequence[FloatArray] | None = None, points: int = POINTS
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
    for _ in range(_CLOSING):
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
