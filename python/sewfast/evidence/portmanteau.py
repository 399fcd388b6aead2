"""The residual tests, linear and nonlinear: sets of correlations under one verdict each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..dataset import FloatArray
from .residuals import Residuals

LAGS = 25
LEAST_SAMPLES = 50
LEVEL = 0.01
"""Share of good models that fail a test."""

_TESTS = (
    ("autocorrelation", "residual with its own past", "e"),
    ("input", "residual with past inputs", ""),
    ("squared_input", "residual with squares of past inputs", ""),
    ("cubed_input", "residual with cubes of past inputs", ""),
    ("output", "residual with powers of the computed output", "ŷ"),
    ("squares", "squared residual with squares of past inputs", ""),
    ("product", "residual with past residual times input", ""),
    ("feedback", "inputs with past residuals", ""),
)
"""Name, title, and the series; without one, the inputs."""


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """One portmanteau test.

    Attributes
    ----------
    name, title : str
    lags : array of int, shape (m,)
        Samples by which the second series is earlier.
    series : tuple of str
        The series with which the residual is correlated.
    correlations : array, shape (len(series), m)
        Between -1 and 1.
    limits : array, shape (len(series), m)
        99 % of single correlations lie within plus or minus this; for plots, not for the verdict.
    statistic, p_value : float
        Chi-square of all correlations together, and the probability of a larger one; NaN if
        nothing can be tested.
    freedom : int
        Its degrees of freedom.
    threshold : float
        Value that the statistic exceeds by chance for one good model in a hundred.
    explained : float
        Share of the residual's power explained by the correlations, beyond chance; 0 to 1.
    judges : bool
        Whether a good model of this kind should pass the test.
    """

    name: str
    title: str
    lags: NDArray[np.int64]
    series: tuple[str, ...]
    correlations: FloatArray
    limits: FloatArray
    statistic: float
    p_value: float
    freedom: int
    threshold: float
    explained: float
    judges: bool

    @property
    def passed(self) -> bool:
        """Whether the statistic is within that of good models, or nothing can be tested."""
        return not self.p_value < LEVEL

    def __str__(self) -> str:
        return f"{self.title}: p = {self.p_value:.3g}, chi2({self.freedom}) = {self.statistic:.4g}"


def residual_tests(residuals: Residuals, memory: int = LAGS) -> tuple[ResidualTest, ...]:
    """Linear and nonlinear tests of residuals.

    Parameters
    ----------
    residuals : Residuals
    memory : int
        Samples over which the initial state fades; the lags reach that far, at least to 24.

    Returns
    -------
    tuple of ResidualTest
        `autocorrelation` of e (judges one-step residuals only); `input`: e(k) with u(k - lag);
        `squared_input`, `cubed_input`: e with u^2, u^3; `output`: e with powers of the computed
        output (Ramsey 1969); `squares`: e^2 with u^2; `product`: e(k) with
        e(k - 1 - lag) u(k - 1 - lag); `feedback`: u(k) with e(k - lag). Empty if there are fewer
        than 50 samples, or the residuals are only rounding.

    Notes
    -----
    Billings and Voon, *Int. J. Control* 38 (1983) 193 and 44 (1986) 235. The means of inputs and of
    their squares and products are removed. The statistic: `rust/core/src/residuals/sums.rs`.
    """
    if residuals.is_nothing or residuals.n < LEAST_SAMPLES:
        return ()
    one_step = residuals.horizon == "one step"
    tests = _core.residual_tests(residuals.columns(), memory=memory, one_step=one_step)
    judges = {"autocorrelation": one_step, "feedback": False}
    return tuple(
        _named(name, title, test, [own] if own else residuals.input_names, judges.get(name, True))
        for (name, title, own), test in zip(_TESTS, tests, strict=True)
    )


def parameter_test(residuals: Residuals, trained: int) -> ResidualTest | None:
    """Whether other parameters would do better on data not trained on.
    The test takes the residual against its significant sensitivities, and allows for the
    uncertainty that `trained` samples leave. None without sensitivities or with too few samples.
    """
    if residuals.is_nothing or residuals.n < LEAST_SAMPLES or residuals.width == 0:
        return None
    test = _core.parameter_test(residuals.columns(), trained=trained)
    return _named("parameters", "parameters on these data", test, ["e"], True)


def _named(
    name: str, title: str, test: _core._Tested, names: Sequence[str], judges: bool
) -> ResidualTest:
    lags, series, correlations, limits, statistic, p_value, freedom, threshold, explained = test
    shown = tuple(_product([names[i] for i in factors]) for factors in series)
    return ResidualTest(
        name, title, np.array(lags, dtype=np.int64), shown, correlations, limits, statistic,
        p_value, freedom, threshold, explained, judges,
    )  # fmt: skip


def _product(names: list[str]) -> str:
    """`u`, `u²`, `u³` or `u·v`."""
    return names[0] + " ²³"[len(names) - 1].strip() if len(set(names)) == 1 else "·".join(names)
