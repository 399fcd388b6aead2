"""Residuals of a model, a model of their noise, and scores over the horizon."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import gram, product
from ..dataset import Dataset, Experiment, FloatArray, require_dataset
from ..dynamic_model import INIT, DynamicModel, FreeRunJacobian, require_init
from ..errors import DataError, FitError
from ..validation import Scores

LARGEST_ORDER = 40


@dataclass(frozen=True, eq=False)
class Noise:
    """e(k) = sum_i ar[i] e(k-1-i) + w(k), w white. `ar` is (p,), and p = 0 is white; `innovation`
    is the variance of w, `variance` that of e.
    """

    ar: FloatArray
    innovation: float
    variance: float

    @classmethod
    def fit(
        cls,
        series: Sequence[tuple[FloatArray, NDArray[np.bool_]]],
        spent: float = 0.0,
        sparing: bool = False,
    ) -> Noise:
        """Least squares, the order by Akaike's criterion. `series` has per experiment the values
        (N,) and whether each of them counts (N,); `spent` parameters estimated on these samples
        cost a degree of freedom each. `sparing` takes Schwarz's criterion, for a series that is
        white unless there is strong evidence.
        """
        n = sum(int(known.sum()) for _, known in series)
        squares = sum(float(e[known] @ e[known]) for e, known in series)
        free = max(n - spent, 0.5 * n, 1.0)
        order = _largest_order(series)
        if order == 0 or squares <= 0.0:
            return cls(np.zeros(0), squares / free, squares / free)
        ar, ratio = _autoregression(_gram(series, order), np.log(n) if sparing else 2.0)
        return cls(ar, squares / free * ratio, squares / free)

    @property
    def is_white(self) -> bool:
        return len(self.ar) == 0

    def spectrum(self, length: int) -> FloatArray:
        """Power at the frequencies of a real Fourier transform of `length` samples."""
        whitening = np.concatenate([[1.0], -self.ar])
        power: FloatArray = self.innovation / np.abs(np.fft.rfft(whitening, length)) ** 2
        return power

    def autocovariance(self, lags: int, length: int) -> FloatArray:
        """R(0) .. R(lags - 1) of a series of `length` samples."""
        size = fast_length(2 * max(length, lags))
        found: FloatArray = np.fft.irfft(self.spectrum(size), size)[:lags]
        return found

    def whole(self, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Where w(k) depends only on known values, shape (N,)."""
        p = len(self.ar)
        found: NDArray[np.bool_] = np.convolve(known, np.ones(p + 1))[: len(known)] > p + 0.5
        return found

    def whitened(self, columns: FloatArray) -> FloatArray:
        """w(k) of every column (N, m), with zeros before the first sample."""
        n = len(columns)
        size = fast_length(n + len(self.ar))
        gain = np.fft.rfft(np.concatenate([[1.0], -self.ar]), size)
        found = np.empty_like(columns)
        for j in range(columns.shape[1]):
            found[:, j] = np.fft.irfft(gain * np.fft.rfft(columns[:, j], size), size)[:n]
        return found

    def shaped(self, columns: FloatArray) -> FloatArray:
        """Columns V (M, m), M > N, with V'V = Z'RZ, R the covariance matrix of the noise.
        `columns` Z (N, m) is zero where a sample does not count.
        """
        if self.is_white:
            scaled: FloatArray = columns * self.innovation**0.5
            return scaled
        size = fast_length(2 * len(columns) if len(columns) < 4096 else len(columns) + 4096)
        root = np.sqrt(self.spectrum(size))
        found = np.empty((size, columns.shape[1]))
        for j in range(columns.shape[1]):
            found[:, j] = np.fft.irfft(root * np.fft.rfft(columns[:, j], size), size)
        return found


def fast_length(n: int) -> int:
    """The smallest 2^a, 3 2^a or 5 2^a that is at least `n`, for a fast transform."""
    return min(f << max(0, (-(-n // f) - 1).bit_length()) for f in (1, 3, 5))


WINDOWS = 1 << 17
"""Windows that are copied at a time."""


def _largest_order(series: Sequence[tuple[FloatArray, NDArray[np.bool_]]]) -> int:
    longest = max((int(known.sum()) for _, known in series), default=0)
    return min(LARGEST_ORDER, int(10.0 * np.log10(max(longest, 1))), longest // 20)


def _gram(series: Sequence[tuple[FloatArray, NDArray[np.bool_]]], order: int) -> FloatArray:
    """Sums of e(k-i) e(k-j), i, j = 0 .. order, over whole windows; last row: their number."""
    total = np.zeros((order + 2, order + 1))
    for e, known in series:
        if len(e) <= order:
            continue
        rows = np.lib.stride_tricks.sliding_window_view(e, order + 1)[:, ::-1]
        windows = np.lib.stride_tricks.sliding_window_view(known, order + 1)
        whole = np.asarray(windows.all(axis=1))
        # a copy of all windows of a long record is larger than everything else together
        for k in range(0, len(rows), WINDOWS):
            kept = rows[k : k + WINDOWS][whole[k : k + WINDOWS]]
            total[:-1] += gram(kept)
            total[-1, 0] += len(kept)
    return total


def _autoregression(gram: FloatArray, price: float) -> tuple[FloatArray, float]:
    """Coefficients of the best order, and the innovation's share of the variance."""
    sums, n = gram[:-1], gram[-1, 0]
    best, found, ratio = np.inf, np.zeros(0), 1.0
    if n < 2 * len(sums) or sums[0, 0] <= 0.0:
        return found, ratio
    for p in range(len(sums)):
        ar = _solve(sums[1 : p + 1, 1 : p + 1], sums[1 : p + 1, 0])
        left = (sums[0, 0] - ar @ sums[1 : p + 1, 0]) / sums[0, 0]
        criterion = n * np.log(max(left, 1e-14)) + price * p
        if criterion < best:
            best, found, ratio = criterion, ar, max(left, 1e-14) * n / max(n - p, 1.0)
    return found, float(min(ratio, 1.0))


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    if len(right) == 0:
        return np.zeros(0)
    ridge = 1e-12 * np.trace(matrix) / len(matrix)
    found: FloatArray = np.linalg.solve(matrix + ridge * np.eye(len(matrix)), right)
    return found


# --- `Residuals`, with their sensitivity to every parameter ---------------------------------------


Horizon: TypeAlias = Literal["free run", "one step"]


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment.

    Attributes
    ----------
    y, yhat : array, shape (N,)
        Measured (NaN where it is not) and computed output [output unit].
    counts : array of bool, shape (N,)
        Measured samples after the initial ones.
    psi : array, shape (N, p)
        Sensitivity of yhat to the parameters.
    state : array, shape (N, s)
        Orthonormal basis of the changes of yhat due to the initial state, zero where a sample does
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

    @property
    def errors(self) -> list[FloatArray]:
        """Residuals without mean and initial state's effect, one array (N,) per experiment."""
        errors = [r.without_state(r.error) for r in self.runs]
        mean = self.mean
        return [e - mean * one for e, one in zip(errors, self.constants, strict=True)]

    @property
    def constants(self) -> list[FloatArray]:
        """A constant with the initial state's effect projected out, one array (N,) per run."""
        return [r.without_state(r.counts.astype(np.float64)) for r in self.runs]

    @property
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

    def noise(self, values: Sequence[FloatArray] | None = None, spent: float = 0.0) -> Noise:
        """Noise model of the residuals, or of other series of the same samples."""
        series = self.errors if values is None else values
        return Noise.fit([(v, r.counts) for v, r in zip(series, self.runs, strict=True)], spent)


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


STEPS = (1, 5, 20)


@dataclass(frozen=True)
class HorizonScores:
    """Scores by horizon: `free run` and `1 step`, `5 steps`, .. In `experiments` they are None if
    an experiment has no sample to score; `names` are those of the experiments, with their ranges.
    """

    pooled: dict[str, Scores]
    experiments: dict[str, tuple[Scores | None, ...]]
    names: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
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
    model: DynamicModel, data: Dataset, residuals: Residuals, steps: tuple[int, ...] = STEPS
) -> HorizonScores:
    """Errors at every horizon; those some steps ahead only if the outputs are complete.
    `residuals` are those of the free run.
    """
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
