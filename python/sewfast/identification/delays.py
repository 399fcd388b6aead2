"""Dead time of each input: `delay`; `rust/core/src/dead_time.rs` computes it."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from .. import _core
from ..arrays import require_whole
from ..dataset import Dataset, FloatArray, require_dataset
from ..dataset.experiment import in_effect
from ..dataset.pieces import require_fittable
from ..errors import SettingError
from ..plotting import SHADE, lettered, stacked
from ..tables import Shown
from ..units import duration

LONGEST = 30
"""Largest delay tried by default [samples]."""


@dataclass(frozen=True, eq=False)
class InputDelay:
    """Estimate of one input's delay. `nk` is that of the model with the lowest free-run error,
    `low` and `high` those with a likelihood of at least `1 - confidence` of its own, by the
    independent samples of the residual. `cost` and `one_step_cost` (L,) are mean square errors of a
    model with each delay [output unit squared], inf without one; `correlation` (L,) is that of
    prewhitened signals, `bound` its bound for independent ones at all lags together, and
    `first_correlated` the first lag beyond it, or None.
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
class DelayEstimate(Shown):
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
    found = _core.delay(
        [(e.u, e.y) for e in data.experiments],
        least=least,
        longest=longest,
        confidence=confidence,
    )
    lags = np.arange(least, longest + 1, dtype=np.float64)
    inputs = []
    for name, of in zip(data.input_names, found, strict=True):
        best, (low, high), seen, cost, one_step, correlation, bound = of
        first = None if seen is None else least + seen
        inputs.append(
            InputDelay(
                name, least + best, least + low, least + high, first, lags, cost, one_step,
                correlation, bound,
            )
        )  # fmt: skip
    return DelayEstimate(min(i.nk for i in inputs), tuple(inputs), data.Ts, confidence)


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
