"""`ResidualTest`: a set of correlations under one verdict.

The statistic is r'(Z'RZ)^+ r with r = Z'e, one column of Z per lag, R the covariance matrix of e.
Z is first freed of what a change of the parameters could have done to e: then it is chi-square
whether the parameters were estimated on these data or on others (Ljung 1999, sections 16.5 and
16.6; Breusch and Godfrey 1978). R is Bartlett's: the residual as it is, coloured, with an
autoregression for R. A strongly coloured residual knows its own R too badly for 25 sums at once,
and the form acquits too often; whitened by the same autoregression it is exact, but then accuses
for the curvature of the model, which is large beside the innovation. The statistic of a test is
the mean of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray
from .distributions import chi2_quantile, chi2_tail, normal_quantile
from .noise import Noise

LEVEL = 0.01
_INDEPENDENT = 1e-7
"""Eigenvalue, relative to the largest, from which a combination of the sums counts."""


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """One portmanteau test.

    Attributes
    ----------
    name, title : str
    lags : array of int, shape (m,)
        Samples by which the second series is earlier.
    series : tuple of str
        What the residual is correlated with.
    correlations : array, shape (len(series), m)
        Between -1 and 1.
    limits : array, shape (len(series), m)
        99 % of single correlations lie within plus or minus this; for the eye, not for the verdict.
    statistic, p_value : float
        Chi-square of all of them together, and the chance of a larger one; NaN where nothing can be
        tested.
    freedom : int
        Its degrees of freedom.
    threshold : float
        What the statistic exceeds by chance in one of a hundred good models.
    explained : float
        Share of the residual's power behind the correlations, over what chance gives; 0 to 1.
    judges : bool
        Whether a good model of this kind promises that the test passes.
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
        """Whether the statistic is one that a good model gives, or nothing can be tested."""
        return not self.p_value < LEVEL

    def __str__(self) -> str:
        return f"{self.title}: p = {self.p_value:.3g}, chi2({self.freedom}) = {self.statistic:.4g}"


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over all samples, their covariance, and what makes correlations of them.

    Attributes
    ----------
    values : array, shape (n,)
    covariance : array, shape (n, n)
    scales : array, shape (n,)
        The values over these are correlations.
    reference : array, shape (n,)
        Variances that the values would have without any correction.
    explained : float
    room : float
        Samples less the parameters that were estimated on them.
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
        """Z'e, where Z is freed of the directions.

        Parameters
        ----------
        instruments : arrays, shape (N, n)
            Z, one array per experiment.
        target : arrays, shape (N,)
            e.
        noise : Noise
            Of the target.
        directions : arrays, shape (N, p)
            Orthonormal over all experiments together.
        """
        power = sum(float(e @ e) for e in target)
        squares = np.sum([np.square(z).sum(axis=0) for z in instruments], axis=0)
        overlap = np.sum([d.T @ z for d, z in zip(directions, instruments, strict=True)], axis=0)
        freed = [z - d @ overlap for d, z in zip(directions, instruments, strict=True)]
        values = np.sum([z.T @ e for z, e in zip(freed, target, strict=True)], axis=0)
        gram = np.sum([z.T @ z for z in freed], axis=0)
        shaped = (noise.shaped(z) for z in freed)
        covariance = np.sum([v.T @ v for v in shaped], axis=0)
        reference = squares * noise.variance
        scales = np.sqrt(np.maximum(squares * power, 1e-300))
        explained = _explained(values, gram, covariance, squares, power)
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
    """The test that the sums make; they are in the order of the series, then of the lags.

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
    """Nearer to chi-square than the quadratic form, whose variance holds the effect that is tested.

    -(n - (m + 2)/2) ln(1 - S/n), Bartlett's correction for a regression with m regressors.
    """
    share = statistic / max(room, 1.0)
    if share >= 1.0:
        return float(np.inf)
    return float(-max(room - 0.5 * freedom - 1.0, 1.0) * np.log1p(-share))


def quadratic(
    values: FloatArray, covariance: FloatArray, reference: FloatArray
) -> tuple[float, int]:
    """r' C^+ r over the combinations that C determines, and their number."""
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
    """What a regression of e on Z takes of its power, less what it takes by chance."""
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
    """An orthonormal basis, over all experiments together, of what the columns (N, p) span.

    Directions whose information is below `determined` times the largest are left out.
    """
    scale = np.sqrt(np.sum([np.square(c).sum(axis=0) for c in columns], axis=0))
    used = (scale > 0.0) & np.isfinite(scale)
    scaled = [c[:, used] / scale[used] for c in columns]
    if not used.any():
        return scaled
    sizes, vectors = np.linalg.eigh(np.sum([c.T @ c for c in scaled], axis=0))
    kept = sizes > determined * sizes[-1]
    turn = vectors[:, kept] / np.sqrt(sizes[kept])
    return [c @ turn for c in scaled]
