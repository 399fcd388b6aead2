"""The residual tests, linear and nonlinear."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray
from .correlations import ResidualTest, Sums, independent_directions, verdict
from .residuals import Noise, Residuals, Run

LAGS = 25
LEAST_SAMPLES = 50
_FOLLOWED = 1e-4
_MODERATE = 60
"""Binary exponent up to which the tests use values without rescaling."""
LARGEST_SET = 50
"""Most sums in one test: several inputs have fewer lags each."""

_Lags: TypeAlias = NDArray[np.int64]
_Columns: TypeAlias = list[FloatArray]


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
    their squares and products are removed.
    """
    if residuals.is_nothing or residuals.n < LEAST_SAMPLES:
        return ()
    setting = _Setting.of(_within_reach(residuals), memory)
    return tuple(test(setting) for test in _TESTS)


def _within_reach(residuals: Residuals) -> Residuals:
    """Residuals rescaled if their sixth powers would overflow or underflow.
    The tests are independent of units, and powers of two change no digit.
    """
    u = np.concatenate([r.u for r in residuals.runs])
    y = np.concatenate([r.yhat[r.counts] for r in residuals.runs])
    sizes = np.abs(np.column_stack([u.max(axis=0), u.min(axis=0)])).max(axis=1)
    of_u, of_y = _exponents(sizes), _exponents(np.abs(y).max(keepdims=True))
    if not (of_u.any() or of_y.any()):
        return residuals
    runs = tuple(
        replace(
            r, u=np.ldexp(r.u, -of_u), y=np.ldexp(r.y, -of_y), yhat=np.ldexp(r.yhat, -of_y)
        )
        for r in residuals.runs
    )  # fmt: skip
    return replace(residuals, runs=runs)


def _exponents(sizes: FloatArray) -> NDArray[np.int32]:
    exponents: NDArray[np.int32] = np.frexp(sizes)[1]
    return np.where(np.abs(exponents) > _MODERATE, exponents, 0).astype(np.int32)


def parameter_test(residuals: Residuals, trained: int) -> ResidualTest | None:
    """Whether other parameters would do better on data not trained on.
    The test takes the residual against its significant sensitivities, and allows for the
    uncertainty that `trained` samples leave. None without sensitivities or with too few samples.
    """
    if residuals.is_nothing or residuals.n < LEAST_SAMPLES or residuals.width == 0:
        return None
    basis = independent_directions([r.sensitivity for r in residuals.runs], _FOLLOWED)
    constant = _constant([r.counts for r in residuals.runs])
    sums = Sums.of(basis, residuals.errors, residuals.noise(), constant)
    if trained > 0:
        sums = replace(sums, covariance=sums.covariance * (1.0 + residuals.n / trained))
    lags = np.arange(basis[0].shape[1])
    return verdict("parameters", "parameters on these data", lags, ("e",), sums, True)


def lags_over(memory: int, samples: int, count: int = LAGS) -> _Lags:
    """Lags from 0 on: i for a short memory, else memory (i/(count-1))^2, dense at first."""
    reach = max(count - 1, min(memory, samples // 10))
    i = np.arange(count)
    wide = np.rint(reach * (i / max(count - 1, 1)) ** 2).astype(np.int64)
    return np.unique(np.maximum(i, wide))


def lagged(columns: FloatArray, lags: _Lags, counts: NDArray[np.bool_]) -> FloatArray:
    """Columns (N, c) delayed by every lag, (N, c m), series by series; zero where unknown."""
    n, width = columns.shape
    found = np.zeros((n, width, len(lags)))
    for i, lag in enumerate(lags):
        if lag < n:
            found[lag:, :, i] = columns[: n - lag]
    found[~counts] = 0.0
    return found.reshape(n, width * len(lags))


def leading(columns: FloatArray, lags: _Lags, counts: NDArray[np.bool_]) -> FloatArray:
    """Columns advanced by every lag, otherwise as `lagged`."""
    return lagged(columns[::-1], lags, counts[::-1])[::-1]


@dataclass(frozen=True, eq=False)
class _Setting:
    """Quantities shared by the tests."""

    residuals: Residuals
    errors: _Columns
    noise: Noise
    directions: _Columns
    white: _Columns
    white_directions: _Columns
    known: list[NDArray[np.bool_]]
    memory: int

    @classmethod
    def of(cls, residuals: Residuals, memory: int) -> _Setting:
        directions = independent_directions(
            [np.column_stack([r.sensitivity, r.counts]) for r in residuals.runs]
        )
        noise = residuals.noise(spent=directions[0].shape[1])
        errors = residuals.errors
        known = [noise.whole(r.counts) for r in residuals.runs]
        basis = _whitened_basis(directions, known, noise)
        white = _innovations(errors, basis, known, noise)
        return cls(residuals, errors, noise, directions, white, basis, known, memory)

    @property
    def runs(self) -> tuple[Run, ...]:
        return self.residuals.runs

    @property
    def names(self) -> tuple[str, ...]:
        return self.residuals.input_names

    def lags(self, series: int = 1) -> _Lags:
        """As many lags as the record's length and the number of series allow."""
        n = self.residuals.n
        count = min(LAGS, max(5, LARGEST_SET // series), max(2, n // (8 * series)))
        return lags_over(self.memory, n, count)

    def spread(
        self, make: Callable[[FloatArray, _Lags, NDArray[np.bool_]], FloatArray],
        series: _Columns, lags: _Lags,
    ) -> _Columns:  # fmt: skip
        return [make(x, lags, r.counts) for x, r in zip(series, self.runs, strict=True)]

    def centred(self, of: Callable[[FloatArray], FloatArray]) -> _Columns:
        """Columns computed from the inputs, minus their common means."""
        return _about_mean_of_columns([of(r.u) for r in self.runs])


def _whitened_basis(columns: _Columns, known: list[NDArray[np.bool_]], noise: Noise) -> _Columns:
    """An orthonormal basis of the whitened columns, over samples whose past is known."""
    return independent_directions(
        [noise.whitened(c) * k[:, None] for c, k in zip(columns, known, strict=True)]
    )


def _innovations(
    errors: _Columns, basis: _Columns, known: list[NDArray[np.bool_]], noise: Noise
) -> _Columns:
    """Whitened residuals, with the sensitivities to the parameters projected out.
    A parameter change too small to see in the residual can be large compared with its innovation.
    """
    white = [
        np.where(k, noise.whitened(e[:, None])[:, 0], 0.0)
        for e, k in zip(errors, known, strict=True)
    ]
    taken = np.sum([d.T @ w for d, w in zip(basis, white, strict=True)], axis=0)
    return [w - d @ taken for d, w in zip(basis, white, strict=True)]


def _linear(
    s: _Setting,
    name: str,
    title: str,
    lags: _Lags,
    series: tuple[str, ...],
    instruments: _Columns,
    directions: _Columns | None = None,
    judges: bool = True,
) -> ResidualTest:
    """Test of the residual, plain and whitened, against columns without noise."""
    basis = s.white_directions
    if directions is not None:
        basis = _whitened_basis(directions, s.known, s.noise)
        directions = independent_directions(directions)
    shown = Sums.of(instruments, s.errors, s.noise, directions or s.directions)
    flat = [s.noise.whitened(z) * k[:, None] for z, k in zip(instruments, s.known, strict=True)]
    room = max(sum(int(k.sum()) for k in s.known) - s.white_directions[0].shape[1], 1)
    power = sum(float(w @ w) for w in s.white) / room
    whitened = Sums.of(flat, s.white, Noise(np.zeros(0), power, power), basis)
    return verdict(name, title, lags, series, shown, judges, whitened)


def _products(u: FloatArray) -> FloatArray:
    """Squares and products of the inputs after removing their means: u_i u_j for i <= j."""
    return np.column_stack([u[:, i] * u[:, j] for i, j in _pairs(u.shape[1])])


def _pairs(n: int) -> list[tuple[int, int]]:
    """Pairs of inputs; for many inputs only squares, as products would leave too few lags."""
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
    # the sensitivities of a free run are free of noise: only the mean is projected out
    sums = Sums.of(
        past, s.errors, white, s.directions if judges else _constant([r.counts for r in s.runs])
    )
    title = "residual with its own past"
    return verdict("autocorrelation", title, lags, ("e",), sums, judges)


def _input(s: _Setting) -> ResidualTest:
    lags = s.lags(len(s.names))
    past = s.spread(lagged, s.centred(lambda u: u), lags)
    return _linear(s, "input", "residual with past inputs", lags, s.names, past)


def _squared_input(s: _Setting) -> ResidualTest:
    names = _product_names(s.names)
    lags = s.lags(len(names))
    past = s.spread(lagged, _squares_about_mean(s), lags)
    title = "residual with squares of past inputs"
    return _linear(s, "squared_input", title, lags, names, past)


def _cubed_input(s: _Setting) -> ResidualTest:
    """Saturation and dead zone are odd functions, which squares do not detect."""
    names = tuple(f"{name}³" for name in s.names)
    lags = s.lags(len(names))
    mean = np.concatenate([r.u for r in s.runs]).mean(axis=0)
    past = s.spread(lagged, s.centred(lambda u: (u - mean) ** 3), lags)
    title = "residual with cubes of past inputs"
    return _linear(s, "cubed_input", title, lags, names, past)


def _output(s: _Setting) -> ResidualTest:
    """Ramsey's test: powers of the computed output, which depends on the input's whole past."""
    lags = s.lags(2)
    values = np.concatenate([r.yhat for r in s.runs])
    mean, spread = values.mean(), max(float(values.std()), 1e-300)
    scaled = [(r.yhat - mean) / spread for r in s.runs]
    powers = _about_mean_of_columns([np.column_stack([y**2, y**3]) for y in scaled])
    past = s.spread(lagged, powers, lags)
    title = "residual with powers of the computed output"
    return _linear(s, "output", title, lags, ("ŷ²", "ŷ³"), past)


def _about_mean_of_columns(columns: _Columns) -> _Columns:
    mean = np.concatenate(columns).mean(axis=0)
    return [c - mean for c in columns]


def _squares(s: _Setting) -> ResidualTest:
    names = _product_names(s.names)
    lags = s.lags(len(names))
    squares = _squares_about_mean(s)
    past = [lagged(q, lags, known) for q, known in zip(squares, s.known, strict=True)]
    bound = 3.0 * np.sqrt(s.noise.innovation)
    # the square of a single outlier would dominate
    power = _about_mean([np.minimum(np.abs(w), bound) ** 2 for w in s.white], s.known)
    noise = Noise.fit(list(zip(power, s.known, strict=True)), sparing=True)
    sums = Sums.of(past, power, noise, _constant(s.known))
    title = "squared residual with squares of past inputs"
    return verdict("squares", title, lags, names, sums, True)


def _feedback(s: _Setting) -> ResidualTest:
    lags = s.lags(len(s.names)) + 1
    ahead = s.spread(leading, s.centred(lambda u: u), lags)
    past = s.spread(lagged, s.centred(lambda u: u), lags - 1)
    known = [np.hstack(pair) for pair in zip(s.directions, past, strict=True)]
    title = "inputs with past residuals"
    # predictability of the input from its own past is no response to the residual
    return _linear(s, "feedback", title, lags, s.names, ahead, known, judges=False)


def _squares_about_mean(s: _Setting) -> _Columns:
    mean = np.concatenate([r.u for r in s.runs]).mean(axis=0)
    return s.centred(lambda u: _products(u - mean))


def _product(s: _Setting) -> ResidualTest:
    """Test of e(k) with e(k-1-lag) u(k-1-lag). For white w only the sum of
    u(k-1-a)^2 w(k)^2 w(k-1-a)^2 enters the covariance.
    """
    lags = s.lags(len(s.names))
    inputs = s.centred(lambda u: u)
    past = [
        lagged(w[:, None] * u, lags + 1, known)
        for w, u, known in zip(s.white, inputs, s.known, strict=True)
    ]
    power = sum(float(w @ w) for w in s.white)
    variance = power / max(sum(int(k.sum()) for k in s.known), 1)
    white = Noise(np.zeros(0), variance, variance)
    sums = Sums.of(past, s.white, white, _constant(s.known))
    title = "residual with past residual times input"
    return verdict("product", title, lags, s.names, sums, True)


def _about_mean(series: _Columns, known: Sequence[NDArray[np.bool_]]) -> _Columns:
    n = max(sum(int(k.sum()) for k in known), 1)
    mean = sum(float(x[k].sum()) for x, k in zip(series, known, strict=True)) / n
    return [np.where(k, x - mean, 0.0) for x, k in zip(series, known, strict=True)]


def _constant(known: Sequence[NDArray[np.bool_]]) -> _Columns:
    """The direction of a mean."""
    n = max(sum(int(k.sum()) for k in known), 1)
    return [k[:, None] / np.sqrt(n) for k in known]


_TESTS = (
    _autocorrelation,
    _input,
    _squared_input,
    _cubed_input,
    _output,
    _squares,
    _product,
    _feedback,
)
