"""Tails and quantiles of the chi-square and the normal distribution."""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist

_TINY = 1e-300
_EPS = 1e-16
_MOST_TERMS = 100_000


def chi2_tail(x: float, freedom: int) -> float:
    """Probability that a chi-square variable exceeds `x`.

    Parameters
    ----------
    x : float
        0 or more; infinity has the tail 0.
    freedom : int
        Degrees of freedom, 1 or more.

    Notes
    -----
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

    Notes
    -----
    Bisection of `chi2_tail`, which falls everywhere; the start is Wilson and Hilferty's.
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
