"""The least-squares problems of More, Garbow and Hillstrom (ACM TOMS 7, 1981, 17-41)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from nist import FloatArray, complex_step

_BARD = np.array(
    [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.1, 4.39]
)
_KOWALIK_V = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])
_KOWALIK_Y = np.array(
    [0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246]
)
# fmt: off
_MEYER = np.array([
    34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820,
    3307, 2872.0,
])
_OSBORNE_1 = np.array([
    0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.85, 0.818, 0.784, 0.751, 0.718, 0.685,
    0.658, 0.628, 0.603, 0.58, 0.558, 0.538, 0.522, 0.506, 0.49, 0.478, 0.467, 0.457, 0.448,
    0.438, 0.431, 0.424, 0.42, 0.414, 0.411, 0.406,
])
_OSBORNE_2 = np.array([
    1.366, 1.191, 1.112, 1.013, 0.991, 0.885, 0.831, 0.847, 0.786, 0.725, 0.746, 0.679, 0.608,
    0.655, 0.616, 0.606, 0.602, 0.626, 0.651, 0.724, 0.649, 0.649, 0.694, 0.644, 0.624, 0.661,
    0.612, 0.558, 0.533, 0.495, 0.5, 0.423, 0.395, 0.375, 0.372, 0.391, 0.396, 0.405, 0.428,
    0.429, 0.523, 0.562, 0.607, 0.653, 0.672, 0.708, 0.633, 0.668, 0.645, 0.632, 0.591, 0.559,
    0.597, 0.625, 0.739, 0.71, 0.729, 0.72, 0.636, 0.581, 0.428, 0.292, 0.162, 0.098, 0.054,
])
# fmt: on


def _linear_full_rank(m: int) -> Callable[[FloatArray], FloatArray]:
    def f(x: FloatArray) -> FloatArray:
        head = x - 2 * np.sum(x) / m - 1
        return np.concatenate([head, np.full(m - len(x), -2 * np.sum(x) / m - 1)])

    return f


def _linear_rank_1(m: int) -> Callable[[FloatArray], FloatArray]:
    return lambda x: np.arange(1, m + 1) * np.sum(np.arange(1, len(x) + 1) * x) - 1


def _linear_rank_1_zeros(m: int) -> Callable[[FloatArray], FloatArray]:
    def f(x: FloatArray) -> FloatArray:
        s = np.sum(np.arange(2, len(x)) * x[1:-1])
        inner = np.arange(1, m - 1) * s - 1
        return np.concatenate([[-1.0], inner, [-1.0]])

    return f


def _rosenbrock(x: FloatArray) -> FloatArray:
    return np.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def _helical_valley(x: FloatArray) -> FloatArray:
    if x[0].real == 0:
        angle = 0.25 * np.sign(x[1].real)
    else:
        angle = np.arctan(x[1] / x[0]) / (2 * np.pi) + (0.5 if x[0].real < 0 else 0)
    radius = np.sqrt(x[0] ** 2 + x[1] ** 2)
    return np.stack([10 * (x[2] - 10 * angle), 10 * (radius - 1), x[2]])


def _powell_singular(x: FloatArray) -> FloatArray:
    root = np.sqrt
    return np.stack(
        [
            x[0] + 10 * x[1],
            root(5) * (x[2] - x[3]),
            (x[1] - 2 * x[2]) ** 2,
            root(10) * (x[0] - x[3]) ** 2,
        ]
    )


def _freudenstein_roth(x: FloatArray) -> FloatArray:
    return np.stack(
        [
            -13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1],
            -29 + x[0] + ((1 + x[1]) * x[1] - 14) * x[1],
        ]
    )


def _bard(x: FloatArray) -> FloatArray:
    u = np.arange(1, 16)
    v, w = 16 - u, np.minimum(u, 16 - u)
    return _BARD - (x[0] + u / (v * x[1] + w * x[2]))


def _kowalik_osborne(x: FloatArray) -> FloatArray:
    v = _KOWALIK_V
    return _KOWALIK_Y - x[0] * (v**2 + v * x[1]) / (v**2 + v * x[2] + x[3])


def _meyer(x: FloatArray) -> FloatArray:
    return x[0] * np.exp(x[1] / (45 + 5 * np.arange(1, 17) + x[2])) - _MEYER


def _watson(x: FloatArray) -> FloatArray:
    t = np.arange(1, 30) / 29
    powers = t[:, None] ** np.arange(len(x))
    slope = (powers[:, :-1] * np.arange(1, len(x))) @ x[1:]
    inner = slope - (powers @ x) ** 2 - 1
    return np.concatenate([inner, [x[0], x[1] - x[0] ** 2 - 1]])


def _box(x: FloatArray) -> FloatArray:
    t = np.arange(1, 11) / 10
    return np.exp(-t * x[0]) - np.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10 * t))


def _jennrich_sampson(x: FloatArray) -> FloatArray:
    i = np.arange(1, 11)
    return 2 + 2 * i - (np.exp(i * x[0]) + np.exp(i * x[1]))


def _brown_dennis(x: FloatArray) -> FloatArray:
    t = np.arange(1, 21) / 5
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + np.sin(t) * x[3] - np.cos(t)) ** 2


def _chebyquad(m: int) -> Callable[[FloatArray], FloatArray]:
    def f(x: FloatArray) -> FloatArray:
        shifted, before, now = 2 * x - 1, np.ones_like(x), 2 * x - 1
        rows = []
        for i in range(1, m + 1):
            integral = -1 / (i * i - 1) if i % 2 == 0 else 0.0
            rows.append(np.mean(now) - integral)
            before, now = now, 2 * shifted * now - before
        return np.stack(rows)

    return f


def _brown_almost_linear(x: FloatArray) -> FloatArray:
    head = x[:-1] + np.sum(x) - (len(x) + 1)
    return np.concatenate([head, [np.prod(x) - 1]])


def _osborne_1(x: FloatArray) -> FloatArray:
    t = 10 * np.arange(33)
    return _OSBORNE_1 - (x[0] + x[1] * np.exp(-t * x[3]) + x[2] * np.exp(-t * x[4]))


def _osborne_2(x: FloatArray) -> FloatArray:
    t = np.arange(65) / 10
    bells = [x[i] * np.exp(-((t - x[i + 7]) ** 2) * x[i + 4]) for i in (1, 2, 3)]
    return _OSBORNE_2 - (x[0] * np.exp(-t * x[4]) + bells[0] + bells[1] + bells[2])


@dataclass(frozen=True)
class Case:
    """A problem from one of its starts; ``listed``: MINPACK's own tests start there too."""

    name: str
    listed: bool
    function: Callable[[FloatArray], FloatArray]
    start: FloatArray

    def residuals(self, x: FloatArray) -> FloatArray:
        """f (m,); complex where x is."""
        return self.function(x)

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Exact derivatives, by complex steps."""
        return complex_step(self.function, x)


#: Name, function, standard start, how many of x0, 10 x0, 100 x0 MINPACK's own tests start from.
_SET = [
    ("linear full rank 5x10", _linear_full_rank(10), np.ones(5), 1),
    ("linear full rank 5x50", _linear_full_rank(50), np.ones(5), 1),
    ("linear rank 1, 5x10", _linear_rank_1(10), np.ones(5), 1),
    ("linear rank 1, 5x50", _linear_rank_1(50), np.ones(5), 1),
    ("linear rank 1 with zeros, 5x10", _linear_rank_1_zeros(10), np.ones(5), 1),
    ("linear rank 1 with zeros, 5x50", _linear_rank_1_zeros(50), np.ones(5), 1),
    ("Rosenbrock", _rosenbrock, np.array([-1.2, 1]), 3),
    ("helical valley", _helical_valley, np.array([-1.0, 0, 0]), 3),
    ("Powell singular", _powell_singular, np.array([3.0, -1, 0, 1]), 3),
    ("Freudenstein Roth", _freudenstein_roth, np.array([0.5, -2]), 3),
    ("Bard", _bard, np.ones(3), 3),
    ("Kowalik Osborne", _kowalik_osborne, np.array([0.25, 0.39, 0.415, 0.39]), 3),
    ("Meyer", _meyer, np.array([0.02, 4000, 250]), 2),
    ("Watson 6", _watson, np.zeros(6), 3),
    ("Watson 9", _watson, np.zeros(9), 3),
    ("Watson 12", _watson, np.zeros(12), 3),
    ("Box", _box, np.array([0.0, 10, 20]), 1),
    ("Jennrich Sampson", _jennrich_sampson, np.array([0.3, 0.4]), 1),
    ("Brown Dennis", _brown_dennis, np.array([25.0, 5, -5, -1]), 3),
    ("Chebyquad 1x8", _chebyquad(8), np.arange(1, 2) / 2, 3),
    ("Chebyquad 8x8", _chebyquad(8), np.arange(1, 9) / 9, 1),
    ("Chebyquad 9x9", _chebyquad(9), np.arange(1, 10) / 10, 1),
    ("Chebyquad 10x10", _chebyquad(10), np.arange(1, 11) / 11, 1),
    ("Brown almost linear 10", _brown_almost_linear, np.full(10, 0.5), 3),
    ("Brown almost linear 30", _brown_almost_linear, np.full(30, 0.5), 1),
    ("Brown almost linear 40", _brown_almost_linear, np.full(40, 0.5), 1),
    ("Osborne 1", _osborne_1, np.array([0.5, 1.5, -1, 0.01, 0.02]), 1),
    ("Osborne 2", _osborne_2, np.array([1.3, 0.65, 0.65, 0.7, 0.6, 3, 5, 7, 2, 4.5, 5.5]), 1),
]


def cases() -> Iterator[Case]:
    """Every problem from x0, 10 x0 and 100 x0; from ones where x0 is zero and is multiplied."""
    for name, function, start, listed in _SET:
        for place, factor in enumerate((1, 10, 100)):
            base = start if factor == 1 or start.any() else np.ones_like(start)
            yield Case(f"{name}, x0 * {factor}", place < listed, function, factor * base)
