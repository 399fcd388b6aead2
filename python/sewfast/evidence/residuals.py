"""`Residuals`: what a model leaves of data, with its sensitivity to every parameter."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..dataset import Dataset, Experiment, FloatArray, require_dataset
from ..dynamic_model import INIT, DynamicModel, FreeRunJacobian, require_init
from ..errors import DataError, FitError
from .noise import Noise

Horizon: TypeAlias = Literal["free run", "one step"]


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment.

    Attributes
    ----------
    y, yhat : array, shape (N,)
        Measured (NaN where it is not) and computed output [output unit].
    counts : array of bool, shape (N,)
        Samples that are measured and come after the initial ones.
    psi : array, shape (N, p)
        Sensitivity of yhat to the parameters.
    state : array, shape (N, s)
        Orthonormal: what a change of the initial state could do to yhat, zero where a sample does
        not count.
    """

    name: str
    range_text: str
    u: FloatArray
    y: FloatArray
    yhat: FloatArray
    counts: NDArray[np.bool_]
    psi: FloatArray
    state: FloatArray

    @property
    def first(self) -> int:
        """The first sample that counts."""
        return int(np.argmax(self.counts))

    @cached_property
    def sensitivity(self) -> FloatArray:
        """`psi` where samples count, less what a change of the initial state could do as well."""
        return self.without_state(np.where(self.counts[:, None], self.psi, 0.0))

    @property
    def error(self) -> FloatArray:
        """y - yhat, zero where a sample does not count."""
        return np.where(self.counts, self.y - self.yhat, 0.0)

    def without_state(self, columns: FloatArray) -> FloatArray:
        """Columns (N,) or (N, m) less what a change of the initial state could explain."""
        left: FloatArray = columns - self.state @ (self.state.T @ columns)
        return left


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all experiments.

    Attributes
    ----------
    horizon : "free run" or "one step"
        What they come from: an ARX model promises white one-step residuals, every other kind a
        free run that leaves nothing of the input.
    spent : int
        Parameters, those that matter (rank of the sensitivity).
    """

    horizon: Horizon
    runs: tuple[Run, ...]
    init: int
    Ts: float
    input_names: tuple[str, ...]
    unit: str

    @classmethod
    def of(
        cls, model: DynamicModel, data: Dataset, init: int = INIT, horizon: Horizon | None = None
    ) -> Residuals:
        """Residuals of a model, at the horizon that it was made for unless told otherwise.

        Raises
        ------
        DataError
            Where the data do not fit the model or leave nothing to judge.
        FitError
            Where the model is unstable on this input.
        """
        require_dataset(data, "data")
        require_init(init)
        horizon = horizon or ("one step" if model.kind == "arx" else "free run")
        if horizon == "one step":
            data.require_complete()
            runs = _one_step_runs(model, data, init)
        else:
            runs = _free_runs(model, data, init)
        if not any(r.counts.any() for r in runs):
            raise DataError(
                f"{data.source}: expected measured outputs after the first init = {init} samples, "
                "received none; lower init or give a longer range"
            )
        unit = data.output_unit or model.output_unit
        return cls(horizon, tuple(runs), init, data.Ts, data.input_names, unit)

    @property
    def n(self) -> int:
        """Samples that count."""
        return sum(int(r.counts.sum()) for r in self.runs)

    @property
    def width(self) -> int:
        """Parameters."""
        return int(self.runs[0].psi.shape[1])

    @property
    def errors(self) -> list[FloatArray]:
        """Residuals less their mean and what the initial state could explain, one array (N,) "
        "per experiment."""
        errors = [r.without_state(r.error) for r in self.runs]
        mean = self.mean
        return [e - mean * one for e, one in zip(errors, self.constants, strict=True)]

    @property
    def constants(self) -> list[FloatArray]:
        """A constant less what the initial state could do of it, one array (N,) per experiment."""
        return [r.without_state(r.counts.astype(np.float64)) for r in self.runs]

    @property
    def mean(self) -> float:
        """Of the residuals, beside what the initial state explains; 0 where it explains all."""
        ones = self.constants
        length = float(sum(one @ one for one in ones))
        total = float(sum(one @ r.error for one, r in zip(ones, self.runs, strict=True)))
        return total / length if length > 1e-9 * self.n else 0.0

    @property
    def is_nothing(self) -> bool:
        """Whether all that is left is rounding."""
        power = sum(float(e @ e) for e in self.errors)
        size = sum(float(np.sum(np.square(r.y[r.counts]))) for r in self.runs)
        return power <= 1e-20 * size

    def noise(self, values: Sequence[FloatArray] | None = None, spent: float = 0.0) -> Noise:
        """The colour of the residuals, or of other series of the same samples."""
        series = self.errors if values is None else values
        return Noise.fit([(v, r.counts) for v, r in zip(series, self.runs, strict=True)], spent)


def representative(model: DynamicModel) -> DynamicModel:
    """The model itself, or an ensemble's first member: the one that did best in training."""
    return model.members[0] if model.members else model


def _free_runs(model: DynamicModel, data: Dataset, init: int) -> list[Run]:
    simulated = model.simulate(data, init=init)
    slopes = _sensitivities(model, data, init, simulated)
    return [
        _run(e, yhat, init, slope.theta, slope.state)
        for e, yhat, slope in zip(data.experiments, simulated, slopes, strict=True)
    ]


def _sensitivities(
    model: DynamicModel, data: Dataset, init: int, simulated: Sequence[FloatArray]
) -> list[FreeRunJacobian]:
    """Of the model; of an ensemble, of the member whose free runs are nearest to its own."""
    nearest, least = model, np.inf
    for member in model.members:
        with suppress(FitError):
            runs = member.simulate(data, init=init)
            distance = max(float(np.abs(a - b).max()) for a, b in zip(runs, simulated, strict=True))
            if distance < least:
                nearest, least = member, distance
    return nearest.jacobian(data, init=init)


def _one_step_runs(model: DynamicModel, data: Dataset, init: int) -> list[Run]:
    orders = model.orders
    lag = max(orders["na"], orders["nk"] + orders["nb"] - 1)
    predicted = model.predict(data, init=init)
    return [
        _run(e, yhat, max(init, lag), regressors(e, **orders), np.zeros((len(e), 0)))
        for e, yhat in zip(data.experiments, predicted, strict=True)
    ]


def regressors(e: Experiment, *, na: int, nb: int, nk: int) -> FloatArray:
    """Rows of [y(k-1) .. y(k-na), u_1(k-nk) .., 1]; the first ones repeat the first sample."""
    lagged = [_delayed(e.y, i) for i in range(1, na + 1)]
    lagged += [_delayed(u, nk + i) for u in e.u.T for i in range(nb)]
    return np.column_stack([*lagged, np.ones(len(e))])


def _delayed(x: FloatArray, lag: int) -> FloatArray:
    late: FloatArray = x[np.maximum(np.arange(len(x)) - lag, 0)]
    return late


def _run(e: Experiment, yhat: FloatArray, first: int, psi: FloatArray, state: FloatArray) -> Run:
    counts = np.isfinite(e.y) & (np.arange(len(e)) >= first)
    basis = _orthonormal(np.where(counts[:, None], state, 0.0))
    return Run(e.name, e.range_text, e.u, e.y, yhat, counts, psi, basis)


def _orthonormal(columns: FloatArray) -> FloatArray:
    """An orthonormal basis of the columns' span, of its numerical rank."""
    scale = np.abs(columns).max(axis=0, initial=0.0)
    columns = columns[:, scale > 0.0] / scale[scale > 0.0]
    if columns.shape[1] == 0 or len(columns) == 0:
        return np.zeros((len(columns), 0))
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept: FloatArray = basis[:, sizes > 1e-10 * sizes[0]]
    return kept
