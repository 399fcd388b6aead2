"""Nonlinear least squares whose success is checked: SciPy's arguments, the core's engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..arrays import FloatArray, is_whole
from ..errors import DataError, Interrupted, SettingError

Differences: TypeAlias = Literal["2-point", "3-point", "cs"]

#: Relative steps that balance rounding and truncation; complex steps have no cancellation.
_STEPS = {"2-point": 2.0**-26, "3-point": 2.0 ** (-52 / 3), "cs": 2.0**-300}
#: Relative errors of the resulting Jacobian.
_ERRORS = {"2-point": 2.0**-24, "3-point": 2.0**-33, "cs": 0.0}


@dataclass(frozen=True)
class LeastSquaresResult:
    """A solution, how the iteration reached it and how well the data determine it.

    As with SciPy's result, ``result["x"]`` is ``result.x``, and ``dict(result)`` works.
    ``success`` is True only if a test for a minimum held and was confirmed: the Jacobian has
    full rank, and further undamped steps became shorter and ended below the tolerances.

    Attributes
    ----------
    x
        Parameters, shape (n,): the best found, for any termination.
    cost
        ``0.5 * sum(fun(x)**2)``.
    fun, jac
        Residuals (m,) and Jacobian (m, n) at ``x``.
    success
        True for the terminations ``small_gradient``, ``small_step``, ``small_reduction``.
    termination
        One of these; or ``max_evaluations``, ``stalled``, ``flat``, ``rank_deficient``, ``saddle``,
        ``not_finite``, ``interrupted``.
    status
        1, 2, 3: success by ``gtol``, ``ftol``, ``xtol``; 0: ``max_nfev`` is used up; below 0: the
        other terminations.
    message
        Advice on the termination.
    nfev, njev
        Evaluations of ``fun`` and of the Jacobian; as in SciPy's ``trf``, evaluations that a
        numerical Jacobian makes are not counted.
    optimality
        Largest component of the gradient ``jac.T @ fun`` among parameters not on a bound.
    relative_offset
        Cosine between the residuals and the range of the Jacobian [1]_; 0 at a minimum whose
        residuals are not zero.
    active_mask
        -1 where the lower bound holds a parameter, 1 where the upper one does, else 0; shape (n,).
    covariance
        ``s^2 inv(jac.T @ jac)`` with ``s^2 = 2 cost / (m - n)``, shape (n, n): zero for
        parameters on a bound, which count as known; infinite variances for parameters that the data
        do not determine; NaN if m = n.
    standard_errors
        Square roots of its diagonal, shape (n,).
    condition
        Condition number of the Jacobian with its columns scaled to length 1.
    rank
        Its rank, without parameters on a bound.
    trace
        Cost at the start and after each accepted step.

    References
    ----------
    .. [1] D. M. Bates, D. G. Watts, Technometrics 23 (1981) 179-183.
    """

    x: FloatArray
    cost: float
    fun: FloatArray
    jac: FloatArray
    success: bool
    termination: str
    status: int
    message: str
    nfev: int
    njev: int
    optimality: float
    relative_offset: float
    active_mask: NDArray[np.int64]
    covariance: FloatArray
    standard_errors: FloatArray
    condition: float
    rank: int
    trace: FloatArray

    @property
    def grad(self) -> FloatArray:
        """Gradient of the cost at ``x``: ``jac.T @ fun``, shape (n,)."""
        gradient: FloatArray = self.jac.T @ self.fun
        return gradient

    def keys(self) -> tuple[str, ...]:
        """Names of the values."""
        return (*(f.name for f in fields(self)), "grad")

    def __getitem__(self, name: str) -> Any:
        """The value of a name; `KeyError` if there is none."""
        if name not in self.keys():
            raise KeyError(name)
        return getattr(self, name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __len__(self) -> int:
        return len(self.keys())

    def __str__(self) -> str:
        ended = "converged" if self.success else "NOT converged"
        rows = [
            f"least squares {ended} ({self.termination}): {self.message}",
            f"cost {self.cost:.6g} after {self.nfev} evaluations, {self.njev} Jacobians; "
            f"rank {self.rank} of {len(self.x)}, condition {self.condition:.3g}",
        ]
        pairs = zip(self.x, self.standard_errors, strict=True)
        rows += [f"  x[{j}] = {x:.10g} +- {error:.3g}" for j, (x, error) in enumerate(pairs)]
        return "\n".join(rows)


def least_squares(
    fun: Callable[..., ArrayLike],
    x0: ArrayLike,
    jac: Callable[..., ArrayLike] | Differences | None = None,
    *,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ftol: float | None = 1e-8,
    xtol: float | None = 1e-8,
    gtol: float | None = 1e-8,
    x_scale: ArrayLike | Literal["jac"] = "jac",
    max_nfev: int | None = None,
    args: Sequence[Any] = (),
    kwargs: Mapping[str, Any] | None = None,
) -> LeastSquaresResult:
    """Minimise ``0.5 * sum(fun(x)**2)``, by Levenberg-Marquardt in a trust region [1]_.

    The arguments are those of ``scipy.optimize.least_squares``. The difference is the end: if a
    test for a minimum holds, undamped steps from there must contract before ``success`` is True;
    they provide the last digits, which the cost cannot show.

    Parameters
    ----------
    fun
        ``fun(x, *args, **kwargs)`` returns the residuals, shape (m,), real. Values that are not
        finite reject the step. ``x`` is a new array in each call.
    x0
        Start, shape (n,) or a number.
    jac
        ``jac(x, *args, **kwargs)`` returns the derivatives, shape (m, n). Or a difference:
        ``2-point`` (also for None), ``3-point`` (twice the evaluations, more digits), ``cs``:
        complex steps, exact where ``fun`` is analytic and takes complex ``x``.
    bounds
        Lower and upper bounds, numbers or shape (n,), infinite for none. ``x0`` lies within.
    ftol
        Relative reduction of the cost at which the solver tries to confirm a minimum, and cosine
        (see ``gtol``) that is small enough then. None switches a test off.
    xtol
        Change of each parameter relative to its value (or standard error, if that is larger)
        below which steps are small enough.
    gtol
        Cosine between the residuals and the range of the Jacobian that counts as zero.
    x_scale
        Typical sizes of the parameters, a number or shape (n,); ``jac``: the Jacobian's columns
        scale them, so that units play no part.
    max_nfev
        Evaluations of ``fun`` at most; None: the larger of 1000 and 200 (n + 1).
    args, kwargs
        Passed on to ``fun`` and ``jac``.

    Returns
    -------
    LeastSquaresResult
        With covariance, rank and the reason for stopping. Stopping never raises an exception.

    Raises
    ------
    DataError
        For residuals or Jacobians of a wrong shape, complex or no numbers.
    SettingError
        For a start, bounds, tolerances or scales that cannot be used.
    Interrupted
        For Ctrl-C; its ``best`` is the result so far. All other exceptions of ``fun`` and ``jac``
        pass unchanged.

    References
    ----------
    .. [1] J. J. More, Lecture Notes in Mathematics 630 (1978) 105-116.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(6.0)
    >>> y = 2.0 * np.exp(-0.5 * t)
    >>> fit = least_squares(lambda x: x[0] * np.exp(-x[1] * t) - y, [1.0, 1.0])
    >>> fit.success, fit.x.round(6)
    (True, array([2. , 0.5]))
    """
    start = _vector("x0", x0)
    model = _Model(fun, jac, tuple(args), dict(kwargs or {}), start)
    first = model.first()
    lower, upper = (None, None) if bounds is None else _bounds(bounds, start.size)
    model.lower, model.upper = lower, upper
    story = _core.least_squares_fit(
        model.residuals,
        model.jacobian,
        start,
        first,
        lower=lower,
        upper=upper,
        x_scale=_scale(x_scale, start.size),
        ftol=_tolerance("ftol", ftol),
        xtol=_tolerance("xtol", xtol),
        gtol=_tolerance("gtol", gtol),
        max_nfev=_evaluations(max_nfev, start.size),
        precision=_ERRORS[model.jac] if isinstance(model.jac, str) else 0.0,
    )
    with np.errstate(invalid="ignore"):
        deviations = np.sqrt(np.diag(story["covariance"]))
    result = LeastSquaresResult(**story, standard_errors=deviations)
    if result.termination == "interrupted":
        raise Interrupted(result)
    return result


class _Model:
    """The caller's functions, with their values checked and converted for the core."""

    def __init__(
        self,
        fun: Callable[..., ArrayLike],
        jac: Callable[..., ArrayLike] | str | None,
        args: tuple[Any, ...],
        kwargs: dict[str, Any],
        start: FloatArray,
    ) -> None:
        if not callable(fun):
            raise SettingError(f"expected a function as fun, got {fun!r}; pass one that takes x")
        jac = "2-point" if jac is None else jac
        if not callable(jac) and not (isinstance(jac, str) and jac in _STEPS):
            raise SettingError(
                f"expected jac as a function or one of {', '.join(get_args(Differences))}, "
                f"got {jac!r}; leave it out for differences"
            )
        self._fun, self._args, self._kwargs = fun, args, kwargs
        self.jac = jac
        self._start, self._m = start, 0
        self.lower: FloatArray | None = None
        self.upper: FloatArray | None = None

    def first(self) -> FloatArray:
        """Residuals at the start, which fix their number."""
        values = self._values(self._start.copy())
        self._m = values.size
        return values

    def residuals(self, x: FloatArray) -> FloatArray:
        values = self._values(x)
        if values.size != self._m:
            raise DataError(
                f"expected {self._m} residuals as at x0, got {values.size}; "
                "return the same number at every x"
            )
        return values

    def jacobian(self, x: FloatArray, residuals: FloatArray) -> FloatArray:
        if isinstance(self.jac, str):
            return self._differences(x, residuals, self.jac)
        values = self.jac(x, *self._args, **self._kwargs)
        matrix = _real("jac", values)
        if matrix.shape != (self._m, x.size):
            raise DataError(
                f"expected jac of shape ({self._m}, {x.size}), residuals by parameters, got "
                f"{matrix.shape}; row i holds the derivatives of residual i"
            )
        return np.ascontiguousarray(matrix, dtype=np.float64)

    def _values(self, x: FloatArray) -> FloatArray:
        values = _real("fun", self._fun(x, *self._args, **self._kwargs))
        if values.ndim > 1:
            raise DataError(
                f"expected residuals of shape (m,), got {values.shape}; return one row of numbers"
            )
        return np.ascontiguousarray(np.atleast_1d(values), dtype=np.float64)

    def _differences(self, x: FloatArray, residuals: FloatArray, kind: str) -> FloatArray:
        matrix = np.empty((self._m, x.size))
        # a parameter near zero keeps a step of the size of its start
        sizes = np.maximum(np.abs(x), _STEPS["2-point"] * np.abs(self._start))
        for j, size in enumerate(np.where(sizes > 0, sizes, 1.0)):
            step = _STEPS[kind] * size
            if kind == "cs":
                matrix[:, j] = self._complex(x, j, step)
            elif kind == "3-point" and self._has_room(x, j, step):
                high, above = self._beside(x, j, step)
                low, below = self._beside(x, j, -step)
                matrix[:, j] = (high - low) / (above - below)
            else:
                room = self.upper is None or x[j] + step <= self.upper[j]
                high, above = self._beside(x, j, step if room else -step)
                matrix[:, j] = (high - residuals) / (above - x[j])
        return matrix

    def _has_room(self, x: FloatArray, j: int, step: float) -> bool:
        low = -np.inf if self.lower is None else self.lower[j]
        high = np.inf if self.upper is None else self.upper[j]
        return bool(low <= x[j] - step and x[j] + step <= high)

    def _beside(self, x: FloatArray, j: int, step: float) -> tuple[FloatArray, float]:
        moved = x.copy()
        moved[j] += step
        # the step actually made, after rounding
        place = float(moved[j])
        return self.residuals(moved), place

    def _complex(self, x: FloatArray, j: int, step: float) -> FloatArray:
        moved = x.astype(np.complex128)
        moved[j] += 1j * step
        values = np.asarray(self._fun(moved, *self._args, **self._kwargs))
        if values.dtype.kind != "c" or values.size != self._m:
            raise DataError(
                f'expected {self._m} complex residuals of a complex x for jac="cs", got '
                f"{values.dtype} of shape {values.shape}; fun must be analytic, or choose 3-point"
            )
        return np.ascontiguousarray(np.atleast_1d(values).imag / step)


def _real(name: str, values: object) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise DataError(f"expected an array from {name}, got a ragged list; {error}") from error
    if array.dtype.kind not in "biuf":
        raise DataError(
            f"expected real numbers from {name}, got {array.dtype} of shape {array.shape}; "
            "return a dense array (real and imaginary parts of complex residuals as two halves)"
        )
    return array


def _vector(name: str, values: ArrayLike) -> FloatArray:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise SettingError(f"expected {name} as one column, got a ragged list; {error}") from error
    if array.ndim > 1 or array.dtype.kind not in "iuf":
        raise SettingError(
            f"expected {name} as real numbers of shape (n,), got {array.dtype} of shape "
            f"{array.shape}; pass one column of numbers"
        )
    return np.array(np.atleast_1d(array), dtype=np.float64, order="C")


def _bounds(bounds: tuple[ArrayLike, ArrayLike], n: int) -> tuple[FloatArray, FloatArray]:
    try:
        low, high = bounds
    except (TypeError, ValueError) as error:
        raise SettingError(
            f"expected bounds as a pair (lower, upper), got {bounds!r}; use infinities for none"
        ) from error
    return _full("bounds", low, n), _full("bounds", high, n)


def _scale(scale: ArrayLike | str, n: int) -> FloatArray | None:
    if isinstance(scale, str):
        if scale != "jac":
            raise SettingError(f'expected x_scale "jac" or numbers, got {scale!r}; choose one')
        return None
    return _full("x_scale", scale, n)


def _full(name: str, values: ArrayLike, n: int) -> FloatArray:
    array = _vector(name, values)
    return np.full(n, array[0]) if np.ndim(values) == 0 else array


def _tolerance(name: str, value: float | None) -> float:
    if value is None:
        return 0.0
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise SettingError(f"expected {name} as a number or None, got {value!r}; 1e-8 is usual")
    return float(value)


def _evaluations(value: int | None, n: int) -> int:
    if value is None:
        return max(1000, 200 * (n + 1))
    if not is_whole(value) or value < 1:
        raise SettingError(f"expected max_nfev as a whole number above 0, got {value!r}")
    return int(min(value, 2**62))
