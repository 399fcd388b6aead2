"""The residual tests, linear and nonlinear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray
from .correlations import ResidualTest, Sums, independent_directions, verdict
from .noise import Noise, fast_length
from .residuals import Residuals, Run

LAGS = 25
LEAST_SAMPLES = 50
LARGEST_SET = 50
"""Sums in one test: with several inputs there are fewer lags of each."""

_Lags: TypeAlias = NDArray[np.int64]
_Columns: TypeAlias = list[FloatArray]


def residual_tests(residuals: Residuals, memory: int = LAGS) -> tuple[ResidualTest, ...]:
    """Linear and nonlinear tests of residuals.

    Parameters
    ----------
    residuals : Residuals
    memory : int
        Samples that the model remembers; the lags reach that far, at least to 24.

    Returns
    -------
    tuple of ResidualTest
        `autocorrelation` of e (judges one-step residuals only); `input`: e(k) with u(k - lag);
        `squared_input`: e with u^2; `squares`: e^2 with u^2; `product`: e(k) with
        e(k - 1 - lag) u(k - 1 - lag); `feedback`: u(k) with e(k - lag). None where there are fewer
        than 50 samples, or nothing but rounding is left.

    Notes
    -----
    Billings and Voon, *Int. J. Control* 38 (1983) 193 and 44 (1986) 235. Inputs and their squares
    and products are taken about their means.
    """
    if residuals.is_nothing or residuals.n < LEAST_SAMPLES:
        return ()
    setting = _Setting.of(residuals, memory)
    return tuple(
        test(setting)
        for test in (_autocorrelation, _input, _squared_input, _squares, _product, _feedback)
    )


def lags_over(memory: int, samples: int, count: int = LAGS) -> _Lags:
    """Lags from 0 on: i where the memory is short, else memory (i/(count-1))^2, close at first."""
    reach = max(count - 1, min(memory, samples // 10))
    i = np.arange(count)
    wide = np.rint(reach * (i / max(count - 1, 1)) ** 2).astype(np.int64)
    return np.unique(np.maximum(i, wide))


def lagged(columns: FloatArray, lags: _Lags, counts: NDArray[np.bool_]) -> FloatArray:
    """Columns (N, c) delayed by every lag, (N, c m), series by series; zero where none is known."""
    n, width = columns.shape
    found = np.zeros((n, width, len(lags)))
    for i, lag in enumerate(lags):
        if lag < n:
            found[lag:, :, i] = columns[: n - lag]
    found[~counts] = 0.0
    return found.reshape(n, width * len(lags))


def leading(columns: FloatArray, lags: _Lags, counts: NDArray[np.bool_]) -> FloatArray:
    """Columns ahead by every lag, else as `lagged`."""
    return lagged(columns[::-1], lags, counts[::-1])[::-1]


@dataclass(frozen=True, eq=False)
class _Setting:
    """What the tests share."""

    residuals: Residuals
    errors: _Columns
    noise: Noise
    directions: _Columns
    memory: int

    @classmethod
    def of(cls, residuals: Residuals, memory: int) -> _Setting:
        directions = independent_directions(
            [np.column_stack([r.sensitivity, r.counts]) for r in residuals.runs]
        )
        noise = residuals.noise(spent=directions[0].shape[1])
        return cls(residuals, residuals.errors, noise, directions, memory)

    @property
    def runs(self) -> tuple[Run, ...]:
        return self.residuals.runs

    @property
    def names(self) -> tuple[str, ...]:
        return self.residuals.input_names

    @property
    def constant(self) -> _Columns:
        """The direction of a mean alone."""
        return [r.counts[:, None] / np.sqrt(self.residuals.n) for r in self.runs]

    def lags(self, series: int = 1) -> _Lags:
        """As many as the record's length and the number of series allow."""
        n = self.residuals.n
        count = min(LAGS, max(5, LARGEST_SET // series), max(2, n // (8 * series)))
        return lags_over(self.memory, n, count)

    def spread(
        self, make: Callable[[FloatArray, _Lags, NDArray[np.bool_]], FloatArray],
        series: _Columns, lags: _Lags,
    ) -> _Columns:  # fmt: skip
        return [make(x, lags, r.counts) for x, r in zip(series, self.runs, strict=True)]

    def centred(self, of: Callable[[FloatArray], FloatArray]) -> _Columns:
        """Columns made of the inputs, about their common means."""
        columns = [of(r.u) for r in self.runs]
        mean = np.concatenate(columns).mean(axis=0)
        return [c - mean for c in columns]


def _products(u: FloatArray) -> FloatArray:
    """Squares and products of the inputs, each about its own mean first: u_i u_j for i <= j."""
    return np.column_stack([u[:, i] * u[:, j] for i, j in _pairs(u.shape[1])])


def _pairs(n: int) -> list[tuple[int, int]]:
    """With many inputs squares alone: their products would leave too few lags."""
    if n > 3:
        return [(i, i) for i in range(n)]
    return list(combinations_with_replacement(range(n), 2))


def _product_names(names: tuple[str, ...]) -> tuple[str, ...]:
    pairs = ((names[i], names[j]) for i, j in _pairs(len(names)))
    return tuple(f"{a}²" if a == b else f"{a}·{b}" for a, b in pairs)


def _autocorrelation(s: _Setting) -> ResidualTest:
    lags = s.lags() + 1
    judges = s.residuals.horizon == "one step"
    white = Noise(np.zeros(0), s.noise.variance, s.noise.variance)
    past = s.spread(lagged, [e[:, None] for e in s.errors], lags)
    # the sensitivities of a free run hold no noise: only a mean is to be taken out
    sums = Sums.of(past, s.errors, white, s.directions if judges else s.constant)
    title = "residual with its own past"
    return verdict("autocorrelation", title, lags, ("e",), sums, judges)


def _input(s: _Setting) -> ResidualTest:
    lags = s.lags(len(s.names))
    past = s.spread(lagged, s.centred(lambda u: u), lags)
    sums = Sums.of(past, s.errors, s.noise, s.directions)
    return verdict("input", "residual with past inputs", lags, s.names, sums, True)


def _squared_input(s: _Setting) -> ResidualTest:
    names = _product_names(s.names)
    lags = s.lags(len(names))
    past = s.spread(lagged, _squares_about_mean(s), lags)
    sums = Sums.of(past, s.errors, s.noise, s.directions)
    title = "residual with squares of past inputs"
    return verdict("squared_input", title, lags, names, sums, True)


def _squares(s: _Setting) -> ResidualTest:
    names = _product_names(s.names)
    lags = s.lags(len(names))
    past = s.spread(lagged, _squares_about_mean(s), lags)
    power = [
        np.where(r.counts, e**2 - s.noise.variance, 0.0)
        for e, r in zip(s.errors, s.runs, strict=True)
    ]
    noise = s.residuals.noise(power)
    sums = Sums.of(past, power, noise, s.constant)
    title = "squared residual with squares of past inputs"
    return verdict("squares", title, lags, names, sums, True)


def _feedback(s: _Setting) -> ResidualTest:
    lags = s.lags(len(s.names)) + 1
    ahead = s.spread(leading, s.centred(lambda u: u), lags)
    sums = Sums.of(ahead, s.errors, s.noise, s.directions)
    return verdict("feedback", "inputs with past residuals", lags, s.names, sums, False)


def _squares_about_mean(s: _Setting) -> _Columns:
    mean = np.concatenate([r.u for r in s.runs]).mean(axis=0)
    return s.centred(lambda u: _products(u - mean))


def _product(s: _Setting) -> ResidualTest:
    lags = s.lags(len(s.names))
    inputs = s.centred(lambda u: u)
    width, m = len(s.names), len(lags)
    values, squares = np.zeros((width, m)), np.zeros((width, m))
    covariance = np.zeros((width * m, width * m))
    for u, e in zip(inputs, s.errors, strict=True):
        for i, ahead in enumerate(lags[lags + 1 < len(e)] + 1):
            pairs = e[:-ahead] * e[ahead:]
            values[:, i] += u[:-ahead].T @ pairs
            squares[:, i] += np.square(u[:-ahead]).T @ np.square(pairs)
        covariance += _product_covariance(u, s.noise, lags)
    power = np.sqrt(len(s.runs) * s.residuals.n * np.maximum(squares, 1e-300))
    sums = Sums(values.ravel(), covariance, power.ravel(), np.diag(covariance).copy())
    title = "residual with past residual times input"
    return verdict("product", title, lags, s.names, sums, True)


def _product_covariance(u: FloatArray, noise: Noise, lags: _Lags) -> FloatArray:
    """Covariance of sum_k u(k) e(k) e(k+1+a) over lags a, for normal e (Isserlis).

    sum_h G_u(h) [R(h) R(h + b - a) + R(h + 1 + b) R(h - 1 - a)], G_u(h) = sum_k u(k) u(k+h).
    """
    n, width = u.shape
    top = int(lags[-1]) + 1
    reach = min(n - 1, 2000)
    r = noise.autocovariance(reach + 2 * top + 2, n)
    h = np.arange(-reach, reach + 1)
    first = r[np.abs(h)]
    found = np.empty((width, len(lags), width, len(lags)))
    for i in range(width):
        for j in range(width):
            g = _cross(u[:, i], u[:, j], reach)
            for a, lag in enumerate(lags):
                shift = lags[:, None] - lag
                same = first * r[np.abs(h + shift)]
                turned = r[np.abs(h + 1 + lags[:, None])] * r[np.abs(h - 1 - lag)]
                found[i, a, j] = (same + turned) @ g
    size = width * len(lags)
    matrix = found.reshape(size, size)
    symmetric: FloatArray = 0.5 * (matrix + matrix.T)
    return symmetric


def _cross(x: FloatArray, z: FloatArray, reach: int) -> FloatArray:
    """sum_k x(k) z(k + h) for h = -reach .. reach."""
    size = fast_length(len(x) + reach + 1)
    product = np.conj(np.fft.rfft(x, size)) * np.fft.rfft(z, size)
    circular = np.fft.irfft(product, size)
    return np.concatenate([circular[-reach:] if reach else circular[:0], circular[: reach + 1]])
