"""Residuals of a model, and scores over the horizon."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..arrays import gram, product
from ..dataset import Dataset, Experiment, FloatArray, require_dataset
from ..dynamic_model import INIT, DynamicModel, FreeRunJacobian, require_init
from ..errors import DataError, FitError
from ..validation import Scores

# --- `Residuals`, with their sensitivity to every parameter ---------------------------------------


Horizon: TypeAlias = Literal["free run", "one step"]


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment: `y` (N,), NaN where not measured, `yhat` [output unit], and `counts`, the
    measured samples after the initial ones. `psi` (N, p) is the sensitivity of yhat to the
    parameters, `state` (N, s) an orthonormal basis of its changes due to the initial state, zero
    where a sample does not count.
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
        """`psi` where samples count, with the effect of the initial state projected out."""
        return self.without_state(np.where(self.counts[:, None], self.psi, 0.0))

    @property
    def error(self) -> FloatArray:
        """y - yhat, zero where a sample does not count."""
        return np.where(self.counts, self.y - self.yhat, 0.0)

    def without_state(self, columns: FloatArray) -> FloatArray:
        """Columns (N,) or (N, m) with the effect of the initial state projected out."""
        wide = columns.reshape(len(columns), -1)
        left = wide - product(self.state, gram(self.state, wide))
        return left.reshape(columns.shape)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of all experiments.

    Attributes
    ----------
    horizon : "free run" or "one step"
        Their origin: an ARX model should have white one-step residuals, every other kind a free
        run whose residuals are independent of the input.
    spent : int
        Number of effective parameters (rank of the sensitivity).
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
        """Residuals of a model, by default at the horizon for which it was fitted.

        Raises
        ------
        DataError
            If the data do not match the model or leave nothing to judge.
        FitError
            If the model is unstable on this input.
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
        """Number of samples that count."""
        return sum(int(r.counts.sum()) for r in self.runs)

    @property
    def width(self) -> int:
        """Parameters."""
        return int(self.runs[0].psi.shape[1])

    @cached_property
    def gram(self) -> FloatArray:
        """Psi'Psi over all experiments, shape (p, p)."""
        found: FloatArray = np.sum([gram(r.sensitivity) for r in self.runs], axis=0)
        return found

    @cached_property
    def errors(self) -> list[FloatArray]:
        """Residuals without mean and initial state's effect, one array (N,) per experiment."""
        errors = [r.without_state(r.error) for r in self.runs]
        mean = self.mean
        return [e - mean * one for e, one in zip(errors, self.constants, strict=True)]

    @cached_property
    def constants(self) -> list[FloatArray]:
        """A constant with the initial state's effect projected out, one array (N,) per run."""
        return [r.without_state(r.counts.astype(np.float64)) for r in self.runs]

    @cached_property
    def mean(self) -> float:
        """Mean residual without the initial state's effect; 0 if that explains a constant."""
        ones = self.constants
        length = float(sum(one @ one for one in ones))
        total = float(sum(one @ r.error for one, r in zip(ones, self.runs, strict=True)))
        return total / length if length > 1e-9 * self.n else 0.0

    @property
    def is_nothing(self) -> bool:
        """Whether the residuals are only rounding."""
        power = sum(float(e @ e) for e in self.errors)
        size = sum(float(np.sum(np.square(r.y[r.counts]))) for r in self.runs)
        return power <= 1e-20 * size

    def columns(self, sensitivity: Sequence[FloatArray] | None = None) -> list[_core._Experiment]:
        """Per experiment inputs, computed output, residual, which samples count, sensitivity."""
        psi = sensitivity or [r.sensitivity for r in self.runs]
        return [
            (r.u, r.yhat, e, r.counts, z)
            for r, e, z in zip(self.runs, self.errors, psi, strict=True)
        ]


def representative(model: DynamicModel) -> DynamicModel:
    """The model itself, or an ensemble's first member, the best one in training."""
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
    """Sensitivities of the model, or of the member with free runs nearest to the ensemble's."""
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
    """An orthonormal basis of the columns' span, with its numerical rank."""
    scale = np.abs(columns).max(axis=0, initial=0.0)
    columns = columns[:, scale > 0.0] / scale[scale > 0.0]
    if columns.shape[1] == 0 or len(columns) == 0:
        return np.zeros((len(columns), 0))
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    kept: FloatArray = basis[:, sizes > 1e-10 * sizes[0]]
    return kept


# --- `HorizonScores`: errors one step, k steps ahead and in free run, per experiment and pooled ---


@dataclass(frozen=True)
class HorizonScores:
    """Scores by horizon: `free run` and `1 step`, `5 steps`, .. In `experiments` they are None if
    an experiment has no sample to score; `names` are those of the experiments, with their ranges.
    """

    pooled: dict[str, Scores]
    experiments: dict[str, tuple[Scores | None, ...]]
    names: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        return {
            horizon: {
                **scores.to_json(),
                "experiments": [
                    {"name": n, **(s.to_json() if s else {"rmse": None})}
                    for n, s in zip(self.names, self.experiments[horizon], strict=True)
                ],
            }
            for horizon, scores in self.pooled.items()
        }


def horizon_scores(
    model: DynamicModel, data: Dataset, residuals: Residuals, steps: tuple[int, ...] = (1, 5, 20)
) -> HorizonScores:
    """Errors of the free run, and some steps ahead if the outputs are complete."""
    series: dict[str, list[FloatArray]] = {"free run": [r.yhat for r in residuals.runs]}
    if all(np.isfinite(e.y).all() for e in data.experiments):
        for k in steps:
            name = "1 step" if k == 1 else f"{k} steps"
            series[name] = model.predict(data, k, init=residuals.init)
    pooled, single = {}, {}
    for name, runs in series.items():
        pairs = [
            (r.y[r.counts], yhat[r.counts]) for r, yhat in zip(residuals.runs, runs, strict=True)
        ]
        single[name] = tuple(Scores.of(y, yhat) if len(y) else None for y, yhat in pairs)
        pooled[name] = Scores.of(*(np.concatenate(c) for c in zip(*pairs, strict=True)))
    names = tuple(f"{r.name} [{r.range_text}]" for r in residuals.runs)
    return HorizonScores(pooled, single, names)


def fit_text(scores: Scores, unit: str) -> str:
    """`rmse 1.23 RPM, fit 98.7 %`."""
    fit = f", fit {scores.fit_percent:.2f} %" if math.isfinite(scores.fit_percent) else ""
    return f"{scores.rmse:.4g} {unit}".rstrip() + fit
