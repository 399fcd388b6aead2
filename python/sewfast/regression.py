"""`LaggedRegression`: every linear regression on lagged outputs and inputs, from one triangle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .dataset import Dataset, Experiment, FloatArray

CHUNK = 4096
DEPENDENT = 1e-10
"""Singular values below this part of the largest one, columns of length one, carry no parameter."""


@dataclass(frozen=True)
class Solution:
    """Least squares on some of the columns.

    Attributes
    ----------
    columns : tuple of int
    theta : array, shape (len(columns),)
    squares : float
        Sum of squared residuals.
    rank : int
        Parameters that the data fix: the effective number, for least squares.
    """

    columns: tuple[int, ...]
    theta: FloatArray
    squares: float
    rank: int


class LaggedRegression:
    """The triangle R of [y(k), y(k-1) .., u_1(k) u_1(k-1) .., u_2(k) .., 1] over all whole rows.

    Any regression on some of these columns has the sums of squares of the same one on R, which has
    as many rows as there are columns: hundreds of structures cost less than reading the data once.
    R'R is the Gram matrix, but its condition is the square of R's, so it is never formed.

    Parameters
    ----------
    data : Dataset
        Rows that touch a sample which is not finite are left out.
    na : int
        Past outputs.
    lags : int
        Values of each input, u(k) .. u(k - lags + 1).
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
        """Sum of squared one-step errors of a solution that came from other data."""
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
