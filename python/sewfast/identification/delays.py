"""Dead time: `delay`, by regressions on lags that share one triangular factor."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import NormalDist
from typing import Any

import numpy as np

from .. import _core
from ..arrays import gram, require_whole
from ..dataset import Dataset, Experiment, FloatArray, require_dataset
from ..dataset.experiment import in_effect
from ..dataset.pieces import require_fittable
from ..errors import DataError, FitError, SettingError
from ..plotting import SHADE, lettered, stacked
from ..tables import html_of
from ..units import duration

CHUNK = 4096
DEPENDENT = 1e-10
"""Singular values below this part of the largest (for columns of length 1) count as zero."""


@dataclass(frozen=True)
class Solution:
    """Least squares on some of the columns.
    `squares` is the sum of squared residuals, and `rank` the number of parameters that the data
    determine.
    """

    columns: tuple[int, ...]
    theta: FloatArray
    squares: float
    rank: int


class LaggedRegression:
    """The triangle R of [y(k), y(k-1) .., u_1(k) u_1(k-1) .., u_2(k) .., 1] over all whole rows.
    A regression on some of these columns has the same sums of squares as the one on those columns
    of R, which has only as many rows as columns. R'R is never formed: its condition number is the
    square of R's. There are `na` past outputs and `lags` values of each input from u(k) on back;
    rows with a sample that is not finite are left out.
    """

    def __init__(self, data: Dataset, na: int, lags: int) -> None:
        self.na, self.lags, self.n_inputs = na, lags, data.n_inputs
        width = 2 + na + lags * data.n_inputs
        self.triangle: FloatArray = np.zeros((0, width))
        self.samples = 0
        for experiment in data.experiments:
            for rows in _chunks(experiment, na, lags):
                self.samples += len(rows)
                stacked = np.vstack([self.triangle, rows])
                self.triangle = np.asarray(np.linalg.qr(stacked, mode="r"), dtype=np.float64)

    def columns(self, na: int, windows: Sequence[tuple[int, int]]) -> tuple[int, ...]:
        """Columns of y(k-1) .. y(k-na), of each input's lags `start:stop`, and of the constant."""
        first = 1 + self.na
        inputs = [
            first + j * self.lags + lag
            for j, (start, stop) in enumerate(windows)
            for lag in range(start, stop)
        ]
        return (*range(1, na + 1), *inputs, first + self.lags * self.n_inputs)

    def solve(self, columns: tuple[int, ...]) -> Solution:
        """Least squares of y(k) on these columns, the least-norm one where they are dependent."""
        chosen, y = self.triangle[:, columns], self.triangle[:, 0]
        lengths = np.linalg.norm(chosen, axis=0)
        scale = 1.0 / np.where(lengths > 0.0, lengths, 1.0)
        theta, _, rank, _ = np.linalg.lstsq(chosen * scale, y, rcond=DEPENDENT)
        theta = theta * scale
        return Solution(columns, theta, float(np.sum((y - chosen @ theta) ** 2)), int(rank))

    def squares(self, solution: Solution) -> float:
        """Sum of squared one-step errors of a solution found on other data."""
        error = self.triangle[:, 0] - self.triangle[:, solution.columns] @ solution.theta
        return float(np.sum(error**2))


def _chunks(e: Experiment, na: int, lags: int) -> Iterator[FloatArray]:
    first = max(na, lags - 1)
    for start in range(first, len(e), CHUNK):
        k = np.arange(start, min(start + CHUNK, len(e)))
        past = e.y[k[:, None] - np.arange(na + 1)]
        inputs = [e.u[k[:, None] - np.arange(lags), j] for j in range(e.u.shape[1])]
        rows = np.hstack([past, *inputs, np.ones((len(k), 1))])
        yield rows[np.isfinite(rows).all(axis=1)]


# --- delay: the dead time of each input -----------------------------------------------------------


LONGEST = 30
"""Largest delay tried by default [samples]."""
ORDER = 4
"""Past outputs and inputs of the ARX models."""
REFINED = 2
"""Past outputs and inputs of the models whose free runs are compared; more could mimic a delay."""
ITERATIONS = 6
SMOOTH = 2000
"""Lags over which the residual's autocorrelations are summed."""
WHITENING = 20
"""Order of the autoregression that makes an input white."""


@dataclass(frozen=True, eq=False)
class InputDelay:
    """Estimate of one input's delay.

    Attributes
    ----------
    nk : int
        Delay of the model with the lowest cost in free run [samples].
    low, high : int
        Range of the plausible delays: their likelihood is at least `1 - confidence` of the best
        one's, counting only the independent samples of the residual.
    first_correlated : int or None
        First lag at which input and output, both filtered to make the input white, correlate beyond
        chance; None if there is no such lag.
    cost : array, shape (L,)
        Mean square free-run error of a model with each delay [output unit squared]; inf if there is
        no such model.
    one_step_cost : array, shape (L,)
        Mean square one-step error of an ARX model with each delay.
    correlation : array, shape (L,)
        Prewhitened cross-correlation at each lag.
    bound : float
        Bound of |correlation| for independent input and output, for all lags together.
    """

    name: str
    nk: int
    low: int
    high: int
    first_correlated: int | None
    lags: FloatArray
    cost: FloatArray
    one_step_cost: FloatArray
    correlation: FloatArray
    bound: float

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        costs = (self.cost, self.one_step_cost, self.correlation)
        arrays: dict[str, Any] = {"lags": [int(v) for v in self.lags]} | {
            name: [v if math.isfinite(v) else None for v in values.tolist()]
            for name, values in zip(("cost", "one_step_cost", "correlation"), costs, strict=True)
        }
        names = ("name", "nk", "low", "high", "first_correlated", "bound")
        return {k: getattr(self, k) for k in names} | arrays

    def __str__(self) -> str:
        spread = f"{self.low}" if self.low == self.high else f"{self.low} to {self.high}"
        seen = self.first_correlated
        first = "no lag beyond chance" if seen is None else f"first beyond chance at lag {seen}"
        return f"{self.name}: nk = {self.nk} (plausible: {spread}); correlation: {first}"


@dataclass(frozen=True, eq=False, repr=False)
class DelayEstimate:
    """Delays of all inputs; prints itself.

    Attributes
    ----------
    nk : int
        Delay for a model that has one delay for all inputs: the smallest of them.
    inputs : tuple of InputDelay
    Ts : float
        Sample time [s].
    confidence : float
    """

    nk: int
    inputs: tuple[InputDelay, ...]
    Ts: float
    confidence: float

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        inputs = [i.to_json() for i in self.inputs]
        return {"nk": self.nk, "Ts": self.Ts, "confidence": self.confidence, "inputs": inputs}

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw, for each input, the free-run error over the delay, and the correlation below.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`; one panel shows the errors of the first input.
        """
        panels: list[Any] = []
        for found in self.inputs:
            panels += [partial(_draw_costs, found=found), partial(_draw_correlation, found=found)]
        return stacked(panels, (2.0, 1.8) * len(self.inputs)).plot(ax, file)

    def _repr_html_(self) -> str:
        """A table for a notebook."""
        return html_of(str(self))

    def __str__(self) -> str:
        head = f"delay: {self.nk} sample(s), {duration(self.nk * self.Ts, 6)}"
        return "\n".join([head, *(f"  {i}" for i in self.inputs)])

    __repr__ = __str__


def _draw_costs(ax: Any, found: InputDelay) -> None:
    """The rms error of a model with each delay; plausible delays are shaded."""
    known = np.isfinite(found.cost)
    ax.axvspan(found.low - 0.4, found.high + 0.4, color=SHADE)
    ax.plot(found.lags[known], np.sqrt(found.cost[known]), marker="o", markersize=3)
    ax.axvline(found.nk, color="black", linewidth=0.8)
    ax.set_title(lettered(f"{found.name}: nk = {found.nk}"), loc="left")
    ax.set_ylabel("free-run error, rms")


def _draw_correlation(ax: Any, found: InputDelay) -> None:
    """The correlation at each lag, with the bound of chance."""
    ax.axhspan(-found.bound, found.bound, color=SHADE)
    ax.vlines(found.lags, 0.0, found.correlation)
    ax.plot(found.lags, found.correlation, linestyle="none", marker="o", markersize=3)
    ax.set_ylabel("correlation")
    ax.set_xlabel("lag, delay [samples]")


def delay(
    data: Dataset, *, longest: int = LONGEST, least: int = 1, confidence: float = 0.95
) -> DelayEstimate:
    """Estimate the delay of each input in three ways.

    Free run: models with two past outputs and two past inputs from `nk` on are fitted by
    instrumental variables for every `nk`, the other inputs at their own best delays. The likelihood
    of a delay relative to the best one is `(cost_best / cost)^(N/2)`, with `N` the number of
    samples over the sum of the squared residual autocorrelations: a nonlinear drive leaves a smooth
    residual, which carries less information than its length suggests.

    One step: the same for ARX models of order 4, which cost next to nothing. At a high sampling
    rate noise makes their estimates late, so they only provide the start.

    Correlation: an autoregression of order 20 is fitted to the input, and input and output are
    filtered by it; the input is then white, and independent series correlate within `z / sqrt(N)`
    (Box, Jenkins, Reinsel 2008, section 12.1).

    Parameters
    ----------
    data : Dataset
        Samples that were not measured, or have weight 0, are omitted; other weights are ignored.
    longest : int
        Largest delay considered [samples].
    least : int
        Smallest delay considered; 0 admits inputs that act at once, which feedback in the recording
        can mimic.
    confidence : float
        Confidence level of the range of plausible delays, and of the bound on all correlations.

    Returns
    -------
    DelayEstimate

    Raises
    ------
    DataError
        If the data are too short, never move, or are so large or small that squares overflow.
    SettingError
        If a setting is out of its range.

    Notes
    -----
    A drive responds through its inertia: the first coefficients can be too small to detect, so the
    estimate can be late by a sample or two. The model can then still start at 1.
    """
    _require(data, longest, least, confidence)
    data = in_effect(data)
    data.require_measured(0)
    require_fittable(data)
    regression = LaggedRegression(data, ORDER, longest + ORDER)
    needed = 2 * regression.triangle.shape[1]
    if regression.samples < needed:
        raise DataError(
            f"{data.source}: expected at least {needed} samples with {longest + ORDER} samples "
            f"before them, received {regression.samples}; lower `longest`, or record longer"
        )
    lags = range(least, longest + 1)
    one_step = [_one_step_costs(regression, j, lags) for j in range(data.n_inputs)]
    best = [lags[int(np.argmin(c))] for c in one_step]
    costs = one_step
    for _ in range(1 if data.n_inputs == 1 else 2):
        costs = []
        for j in range(data.n_inputs):
            costs.append(_free_run_costs(data, j, lags, best))
            best[j] = lags[int(np.argmin(costs[j]))]
    samples = _independent_samples(data, best)
    found = tuple(
        _of_input(data, j, lags, confidence, samples, costs[j], one_step[j])
        for j in range(data.n_inputs)
    )
    return DelayEstimate(min(i.nk for i in found), found, data.Ts, confidence)


def reach(data: Dataset) -> int:
    """Largest delay that the length of the records allows."""
    shortest = min(len(e) for e in data.experiments)
    return max(1, min(LONGEST, shortest // 10))


def _require(data: Dataset, longest: int, least: int, confidence: float) -> None:
    require_dataset(data, "data")
    data.require_inputs()
    data.require_excited()
    for name, value, low, high in (("least", least, 0, 1000), ("longest", longest, least, 1000)):
        require_whole(name, value, low, high)
    if not 0.0 < confidence < 1.0:
        raise SettingError(f"confidence: expected a number between 0 and 1, received {confidence}")


def _one_step_costs(regression: LaggedRegression, j: int, lags: range) -> FloatArray:
    """Mean square errors of ARX models in which the other inputs have all lags."""
    everything = [(0, regression.lags)] * regression.n_inputs
    costs = []
    for nk in lags:
        windows = [*everything[:j], (nk, nk + ORDER), *everything[j + 1 :]]
        costs.append(regression.solve(regression.columns(ORDER, windows)).squares)
    return np.array(costs) / regression.samples


def _free_run_costs(data: Dataset, j: int, lags: range, best: list[int]) -> FloatArray:
    """Mean square free-run errors with input `j` delayed by each lag, others by their best."""
    costs = []
    for nk in lags:
        try:
            costs.append(2.0 * _refined(data, [*best[:j], nk, *best[j + 1 :]]).cost)
        except (DataError, FitError):
            costs.append(math.inf)
    if not np.isfinite(costs).any():
        raise FitError(
            f"{data.source}: expected a linear model with a finite free run, found none at any "
            "delay; check units and signs, or record with more excitation"
        )
    return np.array(costs)


def _refined(data: Dataset, delays: list[int]) -> _core.LinearFit:
    """The second-order model with these delays."""
    arrays = [(_delayed(e.u, delays), e.y) for e in data.experiments]
    fit = _core.fit_iv(arrays, na=REFINED, nb=REFINED, nk=1, max_iterations=ITERATIONS)
    if fit.termination == "interrupted":
        raise KeyboardInterrupt
    return fit


def _independent_samples(data: Dataset, delays: list[int]) -> float:
    """Samples over the sum of the residual's squared autocorrelations (Bartlett)."""
    fit = _refined(data, delays)
    products, samples = np.zeros(1), 0
    for e, state in zip(data.experiments, fit.initial_states, strict=True):
        first = int(np.argmax(np.isfinite(e.y)))
        error = e.y[first:] - fit.model.simulate(_delayed(e.u, delays)[first:], state)
        error = np.where(np.isfinite(error), error - np.nanmean(error), 0.0)
        power = np.abs(np.fft.rfft(error, 2 * len(error))) ** 2
        found = np.fft.irfft(power)[: min(len(error) // 4 + 1, SMOOTH)]
        products = _sum(products, found)
        samples += int(np.isfinite(e.y).sum())
    if products[0] <= 0.0:
        return float(samples)
    squares = (products[1:] / products[0]) ** 2
    # squared autocorrelations of a white residual have the mean 1/N
    excess = float(squares.sum()) - len(squares) / samples
    return samples / (1.0 + 2.0 * max(excess, 0.0))


def _sum(one: FloatArray, other: FloatArray) -> FloatArray:
    """Sum of two series with a common start, over the longer of both."""
    total = np.zeros(max(len(one), len(other)))
    total[: len(one)] += one
    total[: len(other)] += other
    return total


def _delayed(u: FloatArray, delays: list[int]) -> FloatArray:
    """Inputs delayed by one sample less than `delays`, held at their first values."""
    k = np.arange(len(u))
    shifted = [u[np.clip(k - (d - 1), 0, len(u) - 1), j] for j, d in enumerate(delays)]
    return np.ascontiguousarray(np.stack(shifted, axis=1))


def _of_input(
    data: Dataset,
    j: int,
    lags: range,
    confidence: float,
    independent: float,
    cost: FloatArray,
    one_step_cost: FloatArray,
) -> InputDelay:
    measured = np.concatenate([e.y[np.isfinite(e.y)] for e in data.experiments])
    # floor of rounding: a clean record has costs of nearly zero, whose ratios mean nothing
    floor = 1e-16 * float(np.var(measured))
    deviance = independent * np.log((cost + floor) / (cost.min() + floor))
    plausible = np.flatnonzero(deviance <= -2.0 * math.log(1.0 - confidence))
    correlation, samples = _prewhitened_correlation(data, j, lags)
    # significance of each of L lags such that all together keep the level (Sidak)
    each = 1.0 - (1.0 - confidence ** (1.0 / len(lags))) / 2.0
    bound = NormalDist().inv_cdf(each) / math.sqrt(samples)
    beyond = np.flatnonzero(np.abs(correlation) > bound)
    return InputDelay(
        name=data.input_names[j],
        nk=lags[int(np.argmin(cost))],
        low=lags[int(plausible[0])],
        high=lags[int(plausible[-1])],
        first_correlated=lags[int(beyond[0])] if len(beyond) else None,
        lags=np.arange(lags.start, lags.stop, dtype=np.float64),
        cost=cost,
        one_step_cost=one_step_cost,
        correlation=correlation,
        bound=bound,
    )


def _prewhitened_correlation(data: Dataset, j: int, lags: range) -> tuple[FloatArray, int]:
    """Correlation of input `j` and the output after the filter that makes the input white."""
    whitener = _autoregression([e.u[:, j] for e in data.experiments])
    sums, power, samples = np.zeros(len(lags)), np.zeros(2), 0
    for e in data.experiments:
        u, y = (np.convolve(v - np.nanmean(v), whitener, "valid") for v in (e.u[:, j], e.y))
        known = np.isfinite(y)
        y = np.where(known, y, 0.0)
        sums += [u[: len(u) - lag] @ y[lag:] if lag < len(u) else 0.0 for lag in lags]
        power += [u @ u, y @ y]
        samples += int(known.sum())
    size = math.sqrt(power.prod())
    return (sums / size if size > 0.0 else sums), max(samples, 1)


def _autoregression(series: list[FloatArray]) -> FloatArray:
    """Filter [1, c_1, .., c_n] that makes the series white, by least squares."""
    order = min(WHITENING, *(max((len(s) - 1) // 4, 0) for s in series))
    mean = np.mean(np.concatenate(series))
    rows = [np.lib.stride_tricks.sliding_window_view(s - mean, order + 1)[:, ::-1] for s in series]
    sums = np.sum([gram(r) for r in rows], axis=0)
    # the ridge bounds the filter for inputs that few parameters describe (steps, sines)
    ridge = 1e-8 * sums[0, 0] * np.eye(order)
    return np.concatenate([[1.0], -np.linalg.solve(sums[1:, 1:] + ridge, sums[1:, 0])])
