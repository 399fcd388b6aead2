"""Lipschitz quotients: how many lags a function from past to output needs, whatever its form."""

from __future__ import annotations

import math

import numpy as np

from .dataset import Dataset, Experiment, FloatArray

POINTS = 600
"""Samples compared pairwise, evenly over the data."""
SHARE = 0.02
"""Of the points, the number of largest quotients that are averaged."""


def lipschitz_index(data: Dataset, na: int, nb: int, nk: int) -> float:
    """Geometric mean of the largest quotients |dy| / |dphi|, times sqrt(n) (He and Asada 1993).

    With too few lags two nearly equal regressors can have very different outputs: the index is
    large. It falls to a level as lags are added; the order is where it stops falling. Noise raises
    that level. Inputs and output are taken in units of their standard deviations.

    Parameters
    ----------
    data : Dataset
        Samples that were not measured are left out.
    na, nb, nk : int
        The regressor's lags.

    Returns
    -------
    float
        NaN where there are too few samples.
    """
    mean, scale = _moments(data)
    rows = np.vstack([_regressors(e, na, nb, nk, mean, scale) for e in data.experiments])
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 20:
        return math.nan
    rows = rows[np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int)]
    y, phi = rows[:, 0], rows[:, 1:]
    power = np.sum(phi**2, axis=1)
    apart = power[:, None] + power - 2.0 * phi @ phi.T
    # distances below rounding are no distances, among them those of points from themselves
    near = apart <= 1e-14 * power.max()
    quotients = np.where(near, 0.0, (y[:, None] - y) ** 2 / np.where(near, 1.0, apart)).ravel()
    # every pair is there twice
    count = 2 * max(1, int(SHARE * len(y)))
    largest = np.partition(quotients, len(quotients) - count)[-count:]
    if largest.min() <= 0.0:
        return math.nan
    return math.sqrt(phi.shape[1]) * math.exp(float(np.mean(np.log(largest))) / 2.0)


def _moments(data: Dataset) -> tuple[FloatArray, FloatArray]:
    """Means and standard deviations of [y, u_1, ..]."""
    columns = np.vstack([np.column_stack([e.y, e.u]) for e in data.experiments])
    scale = np.nanstd(columns, axis=0)
    return np.nanmean(columns, axis=0), np.where(scale > 0.0, scale, 1.0)


def _regressors(
    e: Experiment, na: int, nb: int, nk: int, mean: FloatArray, scale: FloatArray
) -> FloatArray:
    y, u = (e.y - mean[0]) / scale[0], (e.u - mean[1:]) / scale[1:]
    first = max(na, nk + nb - 1)
    k = np.arange(first, len(y))
    past = y[k[:, None] - np.arange(na + 1)]
    inputs = [u[k[:, None] - nk - np.arange(nb), j] for j in range(u.shape[1])]
    return np.hstack([past, *inputs])
