"""`Noise`: the colour of a residual as an autoregression, and the covariances from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray

LARGEST_ORDER = 40


@dataclass(frozen=True, eq=False)
class Noise:
    """e(k) = sum_i ar[i] e(k-1-i) + w(k), w white.

    Attributes
    ----------
    ar : array, shape (p,)
        p = 0: white.
    innovation : float
        Variance of w.
    variance : float
        Variance of e.
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
        """Least squares, the order by Akaike's criterion.

        Parameters
        ----------
        series : pairs of values (N,) and whether each of them counts (N,)
            One pair per experiment.
        spent : float
            Parameters that were estimated on these samples: they take as many degrees of freedom.
        sparing : bool
            By Schwarz's criterion, for a series that is white unless much speaks against it.
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
        """Where w(k) follows from values that are all known, shape (N,)."""
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
        """Columns V with V'V = Z'RZ, R the covariance matrix of the noise.

        Parameters
        ----------
        columns : array, shape (N, m)
            Z, zero where a sample does not count.

        Returns
        -------
        array, shape (M, m), M > N
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
    """The smallest 2^a, 3 2^a or 5 2^a that is at least `n`: quick to transform."""
    return min(f << max(0, (-(-n // f) - 1).bit_length()) for f in (1, 3, 5))


def _largest_order(series: Sequence[tuple[FloatArray, NDArray[np.bool_]]]) -> int:
    longest = max((int(known.sum()) for _, known in series), default=0)
    return min(LARGEST_ORDER, int(10.0 * np.log10(max(longest, 1))), longest // 20)


def _gram(series: Sequence[tuple[FloatArray, NDArray[np.bool_]]], order: int) -> FloatArray:
    """Sums of e(k-i) e(k-j), i, j = 0 .. order, over whole windows; the last row is their "
    "number."""
    total = np.zeros((order + 2, order + 1))
    for e, known in series:
        if len(e) <= order:
            continue
        rows = np.lib.stride_tricks.sliding_window_view(e, order + 1)[:, ::-1]
        whole = np.lib.stride_tricks.sliding_window_view(known, order + 1).all(axis=1)
        kept = rows[whole]
        total[:-1] += kept.T @ kept
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
