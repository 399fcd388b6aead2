"""`physics` with equations of your own: a Python function of state, command and parameters.

The function is called four times a step (Runge-Kutta), which is slow: seconds to minutes, where the
built-in motor takes one second. It is first tried with one column per set of parameters; a function
that accepts arrays is called once for all derivatives of a step.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import storage
from ..arrays import FloatArray, as_column, require_whole
from ..errors import DataError, FitError, SettingError
from ..frequency.shaft import Parameter
from ..identification.least_squares import least_squares
from ..motorfit.estimation import CONFIDENCE, covariance_of, filtered, whitener
from ..motorfit.records import Piece, Records, rad_per_second
from .motor import Findings, findings

Equations: TypeAlias = Callable[[Any, Any, Mapping[str, Any]], Any]
"""`f(x, u, p)`: derivatives of the state (n,), under a command, with parameters by name."""

MOST = 1000
"""Most states, and most substeps of a sample."""


@dataclass(frozen=True, eq=False, repr=False)
class EquationFit(Findings):
    """Parameters of equations that you gave, identified from a record.

    Attributes
    ----------
    parameters : mapping of Parameter by name
        Value and 95 % interval, in the function's units.
    undetermined : mapping of str by name
        Parameters that the record does not determine, and why; `values` has their fitted values.
    values : mapping of float by name
        All parameters at the least-squares solution.
    equations_name : str
        Module and name of the function.
    states : int
        Number of states; the first is the speed [rad/s].
    fit_percent, rmse : float
        Fit of the free run on the record, after its start; rmse in `speed_unit`.
    converged : bool
        Whether the least-squares minimum was confirmed.
    """

    FORMAT: ClassVar[str] = "sewfast-equations"
    VERSION: ClassVar[int] = 1

    parameters: Mapping[str, Parameter]
    undetermined: Mapping[str, str]
    values: Mapping[str, float]
    equations_name: str
    states: int
    substeps: int
    fit_percent: float
    rmse: float
    converged: bool
    samples: int
    Ts: float
    u_unit: str
    speed_unit: str
    equations: Equations | None = field(default=None)
    """The function; None in a fit read from a file, which holds no code."""

    def with_equations(self, equations: Equations) -> EquationFit:
        """The same fit with its function, which a file does not hold."""
        if not callable(equations):
            raise _not_callable(equations)
        return replace(self, equations=equations)

    def simulate(self, u: ArrayLike, *, Ts: float | None = None, speed: float = 0.0) -> FloatArray:
        """Speed [speed_unit] under commands, (N,), from an initial speed, other states from zero.

        Raises
        ------
        SettingError
            Without the function, as after reading a file, or if it does not accept its arguments.
        DataError
            If the commands are not finite, one-dimensional numbers, or the speed is not.
        """
        if self.equations is None:
            raise SettingError(
                name="equations", expected=f"the function {self.equations_name} that was fitted",
                received="a fit from a file, which holds no code",
                remedy="give it: fit.with_equations(function).simulate(u)",
            )  # fmt: skip
        step, factor = self.Ts if Ts is None else float(Ts), rad_per_second(self.speed_unit)
        simulation = Simulation(self.equations, tuple(self.values), self.states, self.substeps)
        x = np.array([list(self.values.values())]).T
        run = simulation.run(x, as_column(u, "u"), step, factor * float(speed), mean=False)
        found: FloatArray = run[:, 0] / factor
        if not np.isfinite(found).all():
            raise DataError(
                name="simulate", expected="a speed that stays finite", received="one that does not",
                remedy="check the sizes of command and sample time, or fit with more substeps",
            )  # fmt: skip
        return found

    def to_dict(self) -> dict[str, Any]:
        """Everything except the function, as JSON values."""
        return {
            "parameters": {n: vars(p) for n, p in self.parameters.items()},
            "undetermined": dict(self.undetermined),
            "values": dict(self.values),
            **{n: getattr(self, n) for n in _KEPT},
        }

    def __str__(self) -> str:
        width = max(map(len, self.values), default=0)
        lines = [
            f"{self.equations_name}: free run {self.fit_percent:.2f} %, {self.rmse:.3g} "
            f"{self.speed_unit} rmse of {self.samples:,} samples; 95 % intervals"
        ]
        lines += [f"  {name:<{width}}  {p}" for name, p in self.parameters.items()]
        lines += [f"  not determined: {name}: {why}" for name, why in self.undetermined.items()]
        if not self.converged:
            lines.append("  note: the least squares did not converge; intervals may be wrong")
        return "\n".join(lines)


_TEXTS = ("equations_name", "u_unit", "speed_unit")
_KEPT = (*_TEXTS, "states", "substeps", "fit_percent", "rmse", "converged", "samples", "Ts")


def load_equations(path: str | os.PathLike[str]) -> EquationFit:
    """Read a file of `EquationFit.save`; nothing is executed or imported.

    Raises
    ------
    ModelFileError
        For any other file.
    """
    stored = storage.read(path, EquationFit.FORMAT, (EquationFit.VERSION,))
    fields = storage.Fields(str(path), stored)
    fields.require_only(["version", "parameters", "undetermined", "values", *_KEPT])
    parameters, undetermined, unit = findings(fields)
    values = fields.object("values")
    for name in ("states", "substeps"):
        if not 1 <= fields.integer(name) <= MOST:
            raise fields.refuse(name, f"a whole number from 1 to {MOST}", fields.integer(name))
    return EquationFit(
        parameters, undetermined, {n: values.number(n) for n in values.values}, speed_unit=unit,
        **fields.take(
            text="equations_name u_unit", integer="states substeps samples",
            number="fit_percent rmse", flag="converged", positive="Ts",
        ),
    )  # fmt: skip


# --- Calls of the function ------------------------------------------------------------------------


def _not_callable(equations: object) -> SettingError:
    return SettingError(
        name="equations", expected="a function f(x, u, p) that returns the state's derivatives",
        received=repr(equations), remedy="pass the function itself, without calling it",
    )  # fmt: skip


@dataclass
class Simulation:
    """A function's free run, for several sets of parameters at once (columns)."""

    equations: Equations
    names: tuple[str, ...]
    states: int
    substeps: int
    together: bool = False
    """Whether the function takes all columns at once."""

    def derivative(self, x: FloatArray, u: float, p: Mapping[str, Any]) -> FloatArray:
        """Derivative of the state (n,) or (n, columns), with its shape checked."""
        try:
            found = self.equations(x, u, p)
        except Exception as e:
            at = ", ".join(f"{n}={np.ravel(v)[0]:.4g}" for n, v in p.items())
            raise FitError(
                name="equations", expected="a function that returns derivatives",
                received=f"{type(e).__name__}: {e} (x={np.ravel(x)[:4].tolist()}, u={u:.4g}, {at})",
                remedy="catch it there, or bound the parameters away from it",
            ) from e  # fmt: skip
        try:
            array = np.asarray(found, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.full(0, np.nan)
        if array.shape != x.shape and not (array.size == 1 == x.size):
            raise SettingError(
                name="equations", expected=f"derivatives of shape {x.shape}, one per state",
                received=f"{type(found).__name__} of shape {np.shape(array)}",
                remedy="return as many real numbers as the state has, or say states=...",
            )  # fmt: skip
        return array.reshape(x.shape)

    def settle(self, theta: FloatArray, u: float, speed: float) -> None:
        """Find out whether the function accepts all columns at once, with the same results."""
        x = np.zeros(self.states)
        x[0] = speed
        single = self.derivative(x, u, dict(zip(self.names, map(float, theta), strict=True)))
        if not np.isfinite(single).all():
            raise FitError(
                name="equations", expected="finite derivatives at the start of the record",
                received=str(single.tolist()),
                remedy="start from other parameters, or avoid a division by zero there",
            )  # fmt: skip
        rng = np.random.default_rng(0)
        states = speed * np.ones((self.states, 8)) + rng.standard_normal((self.states, 8)) * 50.0
        sets = theta[:, None] * (1.0 + 0.1 * rng.standard_normal((len(theta), 8)))
        try:
            each = self._each(states, u, sets)
            self.together = True
            self.together = bool(np.array_equal(self._all(states, u, sets), each, equal_nan=True))
        except (FitError, SettingError):
            self.together = False

    def _all(self, x: FloatArray, u: float, theta: FloatArray) -> FloatArray:
        if self.together:
            return self.derivative(x, u, dict(zip(self.names, theta, strict=True)))
        return self._each(x, u, theta)

    def _each(self, x: FloatArray, u: float, theta: FloatArray) -> FloatArray:
        columns = [
            self.derivative(x[:, j], u, dict(zip(self.names, theta[:, j].tolist(), strict=True)))
            for j in range(x.shape[1])
        ]
        return np.stack(columns, axis=1)

    def run(
        self,
        theta: FloatArray,
        u: FloatArray,
        Ts: float,
        speed: float | FloatArray,
        *,
        mean: bool,
    ) -> FloatArray:
        """Speed at the samples, or its mean over the previous sample, (N, columns)."""
        columns = theta.shape[1]
        x = np.zeros((self.states, columns))
        x[0] = speed
        shown, found = x[0].copy(), np.empty((len(u), columns))
        h = Ts / self.substeps
        with np.errstate(all="ignore"):
            for k, command in enumerate(u.tolist()):
                found[k] = shown
                total = np.zeros(columns)
                for _ in range(self.substeps):
                    a = self._all(x, command, theta)
                    b = self._all(x + 0.5 * h * a, command, theta)
                    c = self._all(x + 0.5 * h * b, command, theta)
                    d = self._all(x + h * c, command, theta)
                    after = x + h / 6.0 * (a + 2.0 * (b + c) + d)
                    total += 0.5 * (x[0] + after[0])
                    x = after
                shown = total / self.substeps if mean else x[0]
                if not np.isfinite(x).any():
                    found[k + 1 :] = np.nan
                    break
        return found


# --- The fit --------------------------------------------------------------------------------------


def fit_equations(
    records: Records,
    equations: Equations,
    parameters: Mapping[str, float | Sequence[float]],
    *,
    states: int,
    substeps: int,
) -> EquationFit:
    """Output error of the function's free run; see `physics`."""
    evaluations = 60
    if not callable(equations):
        raise _not_callable(equations)
    for name, count in (("states", states), ("substeps", substeps)):
        require_whole(name, count, 1, MOST)
    names, start, low, high = _starts(parameters)
    simulation = Simulation(equations, names, states, substeps)
    first = records.pieces[0]
    simulation.settle(start, float(first.u[0]), first.speed)
    filter_ = np.ones(1)

    def runs(theta: FloatArray) -> list[FloatArray]:
        return [
            simulation.run(theta, p.u, records.Ts, p.speed, mean=records.mean)
            for p in records.pieces
        ]

    def residuals(x: FloatArray) -> FloatArray:
        return _stacked(records.pieces, runs(x[:, None]), filter_)[:, 0]

    def jacobian(x: FloatArray) -> FloatArray:
        # half the step of a central difference, relative to the parameter
        h = 1e-4 * np.maximum(np.abs(x), 1e-3 * np.abs(start))
        more, less = np.minimum(x + h, high), np.maximum(x - h, low)
        sets = np.repeat(x[:, None], 2 * len(x), axis=1)
        j = np.arange(len(x))
        sets[j, 2 * j], sets[j, 2 * j + 1] = more, less
        rows = _stacked(records.pieces, runs(sets), filter_, off=False)
        found: FloatArray = (rows[:, 0::2] - rows[:, 1::2]) / (more - less)
        return found

    if not np.isfinite(residuals(start)).all():
        raise FitError(
            name="equations", expected="a finite free run from the start's parameters",
            received="NaN or infinity on the way",
            remedy="start from other parameters, or use more substeps than "
            f"{substeps} a sample: substeps={2 * substeps}",
        )  # fmt: skip
    found = least_squares(
        residuals, start, jacobian, bounds=(low, high), max_nfev=evaluations, ftol=1e-6, xtol=1e-6
    )
    records = _restarted(records, simulation, found.x)
    over = [y[:, 0] - p.y for p, y in zip(records.pieces, runs(found.x[:, None]), strict=True)]
    # order of the autoregression that models the residual's colour
    filter_ = whitener(
        [np.where(p.used, e, 0.0) for p, e in zip(records.pieces, over, strict=True)], 12
    )
    found = least_squares(residuals, found.x, jacobian, bounds=(low, high), max_nfev=evaluations)
    return _result(records, simulation, found, (start, low, high), runs(found.x[:, None]))


def _starts(
    parameters: Mapping[str, float | Sequence[float]],
) -> tuple[tuple[str, ...], FloatArray, FloatArray, FloatArray]:
    """Names, starts and bounds; a single number has none."""
    if not isinstance(parameters, Mapping) or not parameters:
        raise SettingError(
            name="parameters", expected="starts by name, {'J': 1e-3, 'b': (1e-4, 0, 1)}",
            received=repr(parameters), remedy="a start, or start, least and largest value",
        )  # fmt: skip
    rows = []
    for name, given in parameters.items():
        try:
            row = [float(v) for v in np.atleast_1d(np.asarray(given, dtype=np.float64))]
        except (TypeError, ValueError):
            row = []
        row = [*row, -math.inf, math.inf] if len(row) == 1 else row
        if len(row) != 3 or not math.isfinite(row[0]) or not row[1] <= row[0] <= row[2]:
            raise SettingError(
                name=str(name), expected="a start, or (start, least, largest), the start within",
                received=repr(given),
            )  # fmt: skip
        if row[1] == row[2]:
            raise SettingError(
                name=str(name), expected="bounds that differ", received=repr(given),
                remedy="write a fixed value into the function",
            )  # fmt: skip
        rows.append(row)
    start, low, high = np.array(rows).T
    return tuple(map(str, parameters)), start, low, high


def _restarted(records: Records, simulation: Simulation, theta: FloatArray) -> Records:
    """Initial speeds of the pieces by least squares, unless they start at standstill."""
    pieces = []
    for p in records.pieces:
        if p.speed == 0.0:
            pieces.append(p)
            continue
        h = 1e-3 * max(float(np.abs(p.y).max()), 1e-6)
        sets = np.repeat(theta[:, None], 2, axis=1)
        y = simulation.run(
            sets, p.u, records.Ts, np.array([p.speed, p.speed + h]), mean=records.mean
        )
        moves, off = ((y[:, 1] - y[:, 0]) / h)[p.used], (y[:, 0] - p.y)[p.used]
        pieces.append(
            replace(p, speed=p.speed - float(moves @ off) / max(float(moves @ moves), 1e-9))
        )
    return replace(records, pieces=tuple(pieces))


def _stacked(
    pieces: Sequence[Piece], runs: Sequence[FloatArray], taps: FloatArray, *, off: bool = True
) -> FloatArray:
    """Runs minus measured speeds, filtered; one piece below the other."""
    parts = [
        filtered((y - p.y[:, None] if off else y).T, p.used, taps).T
        for p, y in zip(pieces, runs, strict=True)
    ]
    return np.concatenate(parts)


def _merged(jacobian: FloatArray, names: Sequence[str]) -> dict[str, list[str]]:
    """Parameters that others can replace, and which: directions without effect on the run."""
    # least share of a parameter in a direction without effect to belong to it
    mixed = 0.02
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    size, along = np.linalg.eigh(jacobian.T @ jacobian / np.outer(scale, scale))
    # eigenvalue, relative to the largest of the scaled matrix, of a direction without effect
    blind = along[:, size < 1e-9 * size[-1]]
    shares = np.abs(blind @ blind.T)
    found: dict[str, list[str]] = {}
    for j, name in enumerate(names):
        others = [n for i, n in enumerate(names) if i != j and shares[i, j] > mixed]
        if shares[j, j] > mixed and others:
            found[name] = others
    return found


def _result(
    records: Records,
    simulation: Simulation,
    found: Any,
    ranges: tuple[FloatArray, FloatArray, FloatArray],
    runs: Sequence[FloatArray],
) -> EquationFit:
    """The fit: parameters with intervals, and the undetermined ones with their reasons."""
    _, low, high = ranges
    for name, x, least, most in zip(simulation.names, found.x, low, high, strict=True):
        if x in (least, most):
            raise FitError(
                name=name, expected=f"a value between its bounds, {least:g} and {most:g}",
                received=f"the {'lower' if x == least else 'upper'} one",
                remedy="widen the bound, or write that value into the function and leave the "
                "parameter out",
            )  # fmt: skip
    lengths = [len(p.u) for p in records.pieces]
    covariance = covariance_of(found.jac, found.fun, lengths)
    y = np.concatenate([p.y[p.used] for p in records.pieces])
    model = np.concatenate([r[p.used, 0] for p, r in zip(records.pieces, runs, strict=True)])
    spread = float(np.linalg.norm(y - y.mean()))
    parameters, undetermined = {}, {}
    effects = np.linalg.norm(found.jac, axis=0) * np.abs(found.x)
    merged = _merged(found.jac * found.x, simulation.names)
    for j, name in enumerate(simulation.names):
        value = float(found.x[j])
        half = CONFIDENCE * math.sqrt(max(float(covariance[j, j]), 0.0))
        # least effect of a parameter on the free run, relative to the speed's spread
        if effects[j] <= 1e-9 * np.linalg.norm(found.fun):
            undetermined[name] = "the free run does not depend on it"
        elif name in merged:
            undetermined[name] = (
                f"the record shows only combinations of it and {', '.join(merged[name])}; give one "
                "of them a value in the function"
            )
        # half-width of an interval, relative to the value, above which a parameter is not
        # determined
        elif half >= 1.0 * abs(value):
            undetermined[name] = (
                f"its interval, {value - half:.3g} to {value + half:.3g}, is as wide as its value"
            )
        else:
            parameters[name] = Parameter(value, value - half, value + half, "")
    factor = rad_per_second(records.speed_unit)
    f = simulation.equations
    return EquationFit(
        parameters,
        undetermined,
        dict(zip(simulation.names, map(float, found.x), strict=True)),
        f"{getattr(f, '__module__', '') or ''}.{getattr(f, '__qualname__', type(f).__name__)}",
        simulation.states,
        simulation.substeps,
        100.0 * (1.0 - float(np.linalg.norm(y - model)) / max(spread, 1e-300)),
        float(np.sqrt(np.mean((y - model) ** 2))) / factor,
        bool(found.success),
        len(y),
        records.Ts,
        records.u_unit,
        records.speed_unit,
        f,
    )
