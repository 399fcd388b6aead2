"""`ResidualTest`: a set of correlations under one verdict.

The statistic is r'(Z'RZ)^+ r with r = Z'e, one column of Z per lag, R the covariance matrix of e.
The directions in which a change of the parameters moves e are first projected out of Z: the
statistic is then chi-square whether the parameters were estimated on these data or on others (Ljung
1999, sections 16.5 and 16.6; Breusch and Godfrey 1978). R is Bartlett's, from an autoregression of
the coloured residual. For a strongly coloured residual R is too uncertain for 25 sums at once, and
the test accepts too often. Whitened by the same autoregression the test is exact, but rejects for
the curvature of the model, which is large compared with the innovation. The statistic of a test is
the mean of both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ..arrays import gram, product
from ..dataset import FloatArray
from .residuals import Noise

# --- Tails and quantiles of the chi-square and the normal distribution ----------------------------


_TINY = 1e-300
_EPS = 1e-16
_MOST_TERMS = 100_000


def chi2_tail(x: float, freedom: int) -> float:
    """Probability that a chi-square variable exceeds `x` (0 or more; infinity has the tail 0).
    Q(a, z) with a = freedom/2, z = x/2: power series of P below a + 1, Lentz's continued fraction
    above (Abramowitz and Stegun 6.5.29 and 6.5.31).
    """
    if freedom < 1 or math.isnan(x):
        raise ValueError(f"expected x and at least 1 degree of freedom, received {x}, {freedom}")
    if x <= 0.0:
        return 1.0
    if math.isinf(x):
        return 0.0
    a, z = 0.5 * freedom, 0.5 * x
    scale = math.exp(a * math.log(z) - z - math.lgamma(a))
    if z < a + 1.0:
        return max(0.0, 1.0 - scale * _series(a, z))
    return scale * _fraction(a, z)


def _series(a: float, z: float) -> float:
    term = total = 1.0 / a
    for i in range(1, _MOST_TERMS):
        term *= z / (a + i)
        total += term
        if term < _EPS * total:
            break
    return total


def _fraction(a: float, z: float) -> float:
    b = z + 1.0 - a
    c, d = 1.0 / _TINY, 1.0 / b
    h = d
    for i in range(1, _MOST_TERMS):
        step = -i * (i - a)
        b += 2.0
        d = 1.0 / _away(step * d + b)
        c = _away(b + step / c)
        h *= c * d
        if abs(c * d - 1.0) < _EPS * 8:
            break
    return h


def _away(value: float) -> float:
    return value if abs(value) > _TINY else _TINY


@cache
def chi2_quantile(tail: float, freedom: int) -> float:
    """The value that a chi-square variable exceeds with probability `tail`.
    Bisection of `chi2_tail`, which decreases everywhere; the start is Wilson and Hilferty's.
    """
    if not 0.0 < tail < 1.0:
        raise ValueError(f"expected a probability between 0 and 1, received {tail}")
    low, high = 0.0, max(1.0, _wilson_hilferty(tail, freedom))
    while chi2_tail(high, freedom) > tail:
        low, high = high, 2.0 * high
    for _ in range(200):
        middle = 0.5 * (low + high)
        if chi2_tail(middle, freedom) > tail:
            low = middle
        else:
            high = middle
        if high - low <= 1e-14 * high:
            break
    return 0.5 * (low + high)


def _wilson_hilferty(tail: float, freedom: int) -> float:
    spread = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - spread + normal_quantile(tail) * math.sqrt(spread)) ** 3)


def normal_quantile(tail: float) -> float:
    """The value that a standard normal variable exceeds with probability `tail`."""
    return -NormalDist().inv_cdf(tail)


# --- A set of correlations under one verdict ------------------------------------------------------


LEVEL = 0.01
_INDEPENDENT = 1e-7
"""Least eigenvalue, relative to the largest, for a combination of the sums to count."""


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


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over all samples (n,), their covariance (n, n), and the scales of the correlations (n,).
    The values divided by `scales` are correlations; `reference` (n,) holds the variances of the
    values without any correction. `room` is the number of samples minus that of the parameters
    estimated on them.
    """

    values: FloatArray
    covariance: FloatArray
    scales: FloatArray
    reference: FloatArray
    explained: float
    room: float

    @classmethod
    def of(
        cls,
        instruments: Sequence[FloatArray],
        target: Sequence[FloatArray],
        noise: Noise,
        directions: Sequence[FloatArray],
    ) -> Sums:
        """Z'e, where the directions are projected out of Z. Each argument has one array per
        experiment: `instruments` Z (N, n), `target` e (N,), and `directions` (N, p), orthonormal
        over all experiments together. `noise` is that of the target.
        """
        power = sum(float(e @ e) for e in target)
        squares = np.sum([np.square(z).sum(axis=0) for z in instruments], axis=0)
        overlap = np.sum([gram(d, z) for d, z in zip(directions, instruments, strict=True)], axis=0)
        freed = [z - product(d, overlap) for d, z in zip(directions, instruments, strict=True)]
        values = np.sum([z.T @ e for z, e in zip(freed, target, strict=True)], axis=0)
        own = np.sum([gram(z) for z in freed], axis=0)
        shaped = (noise.shaped(z) for z in freed)
        covariance = np.sum([gram(v) for v in shaped], axis=0)
        reference = squares * noise.variance
        scales = np.sqrt(np.maximum(squares * power, 1e-300))
        explained = _explained(values, own, covariance, squares, power)
        room = sum(int(np.count_nonzero(e)) for e in target) - directions[0].shape[1]
        return cls(values, covariance, scales, reference, explained, float(room))

    def statistic(self) -> tuple[float, int]:
        """The quadratic form with Bartlett's factor, and its degrees of freedom."""
        found, freedom = quadratic(self.values, self.covariance, self.reference)
        return _likelihood_ratio(found, freedom, self.room), freedom


def verdict(
    name: str,
    title: str,
    lags: NDArray[np.int64],
    series: tuple[str, ...],
    sums: Sums,
    judges: bool,
    white: Sums | None = None,
) -> ResidualTest:
    """The test of the sums, which are ordered by series, then by lag.
    With `white`, the same sums of the whitened series, the statistic is the mean of both.
    """
    shape = (len(series), len(lags))
    spread = np.sqrt(np.maximum(np.diag(sums.covariance), 0.0))
    statistic, freedom = sums.statistic()
    if white is not None and freedom:
        other, its_freedom = white.statistic()
        statistic = max(0.5 * (statistic + other + freedom - its_freedom), 0.0)
    return ResidualTest(
        name,
        title,
        lags,
        series,
        (sums.values / sums.scales).reshape(shape),
        (normal_quantile(0.005) * spread / sums.scales).reshape(shape),
        statistic if freedom else np.nan,
        chi2_tail(statistic, freedom) if freedom else np.nan,
        freedom,
        chi2_quantile(LEVEL, freedom) if freedom else np.nan,
        sums.explained,
        judges,
    )


def _likelihood_ratio(statistic: float, freedom: int, room: float) -> float:
    """-(n - (m + 2)/2) ln(1 - S/n), Bartlett's correction for a regression with m regressors.
    It is closer to chi-square than the quadratic form, whose variance includes the tested effect.
    """
    share = statistic / max(room, 1.0)
    if share >= 1.0:
        return float(np.inf)
    return float(-max(room - 0.5 * freedom - 1.0, 1.0) * np.log1p(-share))


def quadratic(
    values: FloatArray, covariance: FloatArray, reference: FloatArray
) -> tuple[float, int]:
    """r' C^+ r over the combinations determined by C, and their number."""
    if not (np.isfinite(covariance).all() and np.isfinite(values).all()):
        return np.nan, 0
    scale = np.sqrt(reference)
    used = scale > 0.0
    if not used.any():
        return np.nan, 0
    scaled = covariance[np.ix_(used, used)] / np.outer(scale[used], scale[used])
    sizes, vectors = np.linalg.eigh(scaled)
    kept = sizes > _INDEPENDENT * max(sizes[-1], _INDEPENDENT)
    if not kept.any():
        return np.nan, 0
    parts = vectors[:, kept].T @ (values[used] / scale[used])
    return float(np.sum(parts**2 / sizes[kept])), int(kept.sum())


def _explained(
    values: FloatArray, gram: FloatArray, covariance: FloatArray, squares: FloatArray, power: float
) -> float:
    """Share of e's power that a regression on Z explains, minus the share by chance."""
    scale = np.sqrt(squares)
    used = scale > 0.0
    if power <= 0.0 or not used.any():
        return 0.0
    outer = np.outer(scale[used], scale[used])
    sizes, vectors = np.linalg.eigh(gram[np.ix_(used, used)] / outer)
    kept = sizes > _INDEPENDENT * max(sizes[-1], _INDEPENDENT)
    vectors = vectors[:, kept] / np.sqrt(sizes[kept])
    taken = np.sum((vectors.T @ (values[used] / scale[used])) ** 2)
    chance = np.sum(vectors * ((covariance[np.ix_(used, used)] / outer) @ vectors))
    return float(np.clip((taken - chance) / power, 0.0, 1.0))


def independent_directions(
    columns: Sequence[FloatArray], determined: float = 1e-10
) -> list[FloatArray]:
    """An orthonormal basis, over all experiments together, of the span of the columns (N, p).
    Directions with information below `determined` times the largest are left out.
    """
    scale = np.sqrt(np.sum([np.square(c).sum(axis=0) for c in columns], axis=0))
    used = (scale > 0.0) & np.isfinite(scale)
    scaled = [c[:, used] / scale[used] for c in columns]
    if not used.any():
        return scaled
    sizes, vectors = np.linalg.eigh(np.sum([gram(c) for c in scaled], axis=0))
    kept = sizes > determined * sizes[-1]
    turn = vectors[:, kept] / np.sqrt(sizes[kept])
    return [product(c, turn) for c in scaled]
