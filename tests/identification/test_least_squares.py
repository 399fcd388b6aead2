"""Least squares: certified answers, MINPACK's problems, honest ends, callers' mistakes."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import mgh
import nist
from sewfast import DataError, Interrupted, LeastSquaresResult, SettingError, least_squares

TIGHT = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}


def _certified(folder: Path, **options: object) -> list[tuple[str, float, LeastSquaresResult]]:
    """Name, digits and result of all 54 starts; ``jac="exact"`` takes the derivatives."""
    found = []
    for problem in nist.read_all(folder / "nist_strd"):
        exact = options.get("jac") == "exact"
        use = {**options, "jac": problem.jacobian} if exact else options
        for start in problem.starts:
            with np.errstate(all="ignore"):
                fit = least_squares(problem.residuals, start, **use)  # type: ignore[arg-type]
            found.append((problem.name, problem.digits(fit.x), fit))
    assert len(found) == 54
    return found


def test_tight_tolerances_give_every_certified_digit(recordings: Path) -> None:
    found = _certified(recordings, jac="exact", **TIGHT)
    digits = np.array([d for _, d, _ in found])
    assert digits.min() >= 10
    assert digits.mean() >= 10.6
    assert all(fit.success for _, _, fit in found)


def test_defaults_reach_the_certified_values(recordings: Path) -> None:
    found = _certified(recordings, jac="exact")
    digits = np.array([d for _, d, _ in found])
    assert digits.min() >= 8
    assert digits.mean() >= 10
    assert all(fit.success for _, _, fit in found)


@pytest.mark.parametrize(
    ("jac", "mean", "least"), [("2-point", 7.5, 4.5), ("3-point", 9.5, 7.5), ("cs", 10, 8)]
)
def test_differences_give_no_false_success(
    recordings: Path, jac: str, mean: float, least: float
) -> None:
    found = _certified(recordings, jac=jac)
    digits = np.array([d for _, d, _ in found])
    assert digits.mean() >= mean
    assert digits.min() >= least
    assert sum(fit.success for _, _, fit in found) >= 50


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_success_keeps_what_its_tolerance_promises(recordings: Path, tolerance: float) -> None:
    found = _certified(recordings, jac="exact", ftol=tolerance, xtol=tolerance, gtol=tolerance)
    for name, digits, fit in found:
        if fit.success:
            assert digits >= -np.log10(tolerance) - 1, (name, digits, fit.termination)


@pytest.mark.parametrize("evaluations", [1, 4, 13, 34])
def test_no_success_where_the_evaluations_end(recordings: Path, evaluations: int) -> None:
    for name, digits, fit in _certified(recordings, jac="exact", max_nfev=evaluations):
        assert fit.success == (digits > 4) or not fit.success, name
        assert fit.nfev <= evaluations + len(fit.x)
        assert fit.success or fit.termination in ("max_evaluations", "flat", "rank_deficient")


def test_standard_errors_are_the_certified_ones(recordings: Path) -> None:
    for problem in nist.read_all(recordings / "nist_strd"):
        fit = least_squares(problem.residuals, problem.starts[1], problem.jacobian, **TIGHT)  # type: ignore[arg-type]
        # Lanczos1 is exact to rounding: its residuals, and all deviations with them, are noise
        if problem.name != "Lanczos1":
            assert nist.lre(fit.standard_errors, problem.deviations) >= 8, problem.name


LISTED = [case for case in mgh.cases() if case.listed]
FAR = [case for case in mgh.cases() if not case.listed]


def _no_higher_than_minpack(case: mgh.Case, fit: LeastSquaresResult) -> bool:
    from scipy.optimize import least_squares as scipy_least_squares

    tolerances = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-12}
    known = scipy_least_squares(
        case.residuals, case.start, case.jacobian, method="lm", max_nfev=4000, **tolerances
    )
    return fit.cost <= float(known.cost) * (1 + 1e-8) + 1e-25


def _fit(case: mgh.Case) -> LeastSquaresResult:
    with np.errstate(all="ignore"):
        return least_squares(case.residuals, case.start, case.jacobian, max_nfev=4000)


@pytest.mark.parametrize("case", LISTED, ids=lambda c: c.name)
def test_no_cost_above_minpack(case: mgh.Case) -> None:
    pytest.importorskip("scipy")
    fit = _fit(case)
    assert _no_higher_than_minpack(case, fit)
    if fit.success:
        _is_minimum(case, fit)


@pytest.mark.nightly("31 far starts; the listed ones run in `make test`")
@pytest.mark.filterwarnings("ignore:.*encountered in:RuntimeWarning")
def test_far_starts_end_in_a_minimum_or_say_so() -> None:
    """From ten or a hundred times x0 the last bits of the function choose among the minima.

    With those changed at random, 4 to 7 of the 31 starts end above MINPACK.
    """
    pytest.importorskip("scipy")
    fits = [_fit(case) for case in FAR]
    for case, fit in zip(FAR, fits, strict=True):
        if fit.success:
            _is_minimum(case, fit)
    as_low = sum(map(_no_higher_than_minpack, FAR, fits))
    assert len(FAR) == 31
    assert as_low >= 22


def _is_minimum(case: mgh.Case, fit: LeastSquaresResult) -> None:
    """No small change in any of many directions lowers the cost by more than rounding."""
    random = np.random.default_rng(1)
    scale = 1e-4 * (np.abs(fit.x) + np.abs(fit.x).max() * 1e-3)
    for _ in range(100):
        moved = fit.x + scale * random.normal(size=fit.x.size)
        cost = 0.5 * np.sum(case.residuals(moved) ** 2)
        assert cost >= fit.cost * (1 - 1e-9) - 1e-25


def test_most_of_minpacks_starts_are_successes() -> None:
    assert len(LISTED) == 53
    with np.errstate(all="ignore"):
        ends = [least_squares(c.residuals, c.start, c.jacobian).termination for c in LISTED]
    assert sum(end.startswith("small") for end in ends) >= 37
    assert {"max_evaluations", "interrupted", "not_finite"}.isdisjoint(ends)


# --- ends that tell the truth ---------------------------------------------------------------------

T = np.linspace(0, 5, 30)


def _decay(x: np.ndarray) -> np.ndarray:
    return x[0] * np.exp(-x[1] * T) - 2 * np.exp(-0.5 * T) - 0.01 * np.sin(9 * T)


def test_twins_are_rank_deficient_with_infinite_errors() -> None:
    fit = least_squares(lambda x: (x[0] + x[1]) * T + x[2] - 3 * T - np.cos(T), [1.0, 1.0, 0.0])
    assert (fit.termination, fit.success, fit.rank) == ("rank_deficient", False, 2)
    assert np.isinf(fit.standard_errors[:2]).all()
    assert np.isfinite(fit.standard_errors[2])
    best = np.linalg.lstsq(np.column_stack([T, np.ones(30)]), 3 * T + np.cos(T), rcond=None)
    assert 2 * fit.cost == pytest.approx(best[1][0], rel=1e-9)


def test_a_parameter_without_effect_is_rank_deficient() -> None:
    fit = least_squares(lambda x: x[0] * T - np.cos(T) + 0 * x[1], [1.0, 1.0])
    assert fit.termination == "rank_deficient"
    assert fit.x[1] == 1.0


def test_a_parameter_that_runs_to_infinity_is_no_success() -> None:
    fit = least_squares(lambda x: np.exp(-x[0] * (1 + T)) + 1, [0.0])
    assert not fit.success
    assert fit.termination in ("flat", "rank_deficient", "stalled")


def test_a_ridge_is_no_minimum() -> None:
    fit = least_squares(lambda x: x**2 - 1, [0.0, 0.0], lambda x: np.diag(2 * x))
    assert not fit.success
    # symmetric in x, so that the gradient at the start is zero though the cost falls on both sides
    humps = least_squares(
        lambda x: np.array([x[0] ** 2 - 1, 0.1 * x[0]]), [1e-9], lambda x: [[2 * x[0]], [0.1]]
    )
    assert not humps.success or abs(humps.x[0]) > 0.9


def test_fewer_residuals_than_parameters_are_rank_deficient() -> None:
    fit = least_squares(lambda x: x[0] + 2 * x[1] - 3, [5.0, 5.0])
    assert (fit.termination, fit.rank) == ("rank_deficient", 1)
    assert fit.cost < 1e-20


def test_start_that_is_not_finite_is_named() -> None:
    fit = least_squares(lambda x: np.full(3, np.nan), [1.0, 2.0])
    assert (fit.termination, fit.success, fit.status) == ("not_finite", False, -1)
    assert fit.nfev == 1
    assert np.isnan(fit.jac).all()


def test_regions_that_are_not_finite_are_left() -> None:
    def fun(x: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.log(x[0]) * T + x[0] - 2.0

    fit = least_squares(fun, [80.0])
    assert fit.success


def test_jacobian_that_is_not_finite_is_named() -> None:
    fit = least_squares(_decay, [1.0, 1.0], lambda x: np.full((30, 2), np.nan))
    assert fit.termination == "not_finite"


def test_evaluations_are_bounded() -> None:
    fit = least_squares(_decay, [1.0, 3.0], max_nfev=3)
    assert (fit.termination, fit.status, fit.nfev) == ("max_evaluations", 0, 3)
    assert fit.cost < 0.5 * np.sum(_decay(np.array([1.0, 3.0])) ** 2)


def test_a_wrong_jacobian_is_no_success() -> None:
    fit = least_squares(_decay, [1.0, 1.0], lambda x: np.column_stack([np.sin(T), np.cos(T)]))
    assert not fit.success


def test_result_is_consistent() -> None:
    fit = least_squares(_decay, [1.0, 1.0], "3-point")
    np.testing.assert_array_equal(fit.fun, _decay(fit.x))
    assert fit.cost == pytest.approx(0.5 * np.sum(fit.fun**2))
    assert fit.optimality == pytest.approx(np.abs(fit.jac.T @ fit.fun).max(), abs=1e-12)
    inverse = np.linalg.inv(fit.jac.T @ fit.jac) * 2 * fit.cost / 28
    np.testing.assert_allclose(fit.covariance, inverse, rtol=1e-9)
    assert fit.trace[-1] == fit.cost
    assert (fit.rank, fit.condition < 100) == (2, True)
    assert "converged" in str(fit)


# --- bounds ---------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_bounded_lines_satisfy_kuhn_and_tucker(seed: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random.normal(size=(12, 4)), random.normal(size=12)
    low, high = -random.uniform(0, 0.4, 4), random.uniform(0, 0.4, 4)
    fit = least_squares(lambda x: a @ x - b, np.zeros(4), lambda x: a, bounds=(low, high))
    assert fit.success
    assert (fit.x >= low).all()
    assert (fit.x <= high).all()
    gradient = a.T @ (a @ fit.x - b)
    np.testing.assert_array_equal(fit.active_mask == -1, (fit.x == low) & (gradient >= 0))
    np.testing.assert_array_equal(fit.active_mask == 1, (fit.x == high) & (gradient <= 0))
    assert np.abs(gradient[fit.active_mask == 0]).max(initial=0) < 1e-7
    assert (fit.standard_errors[fit.active_mask != 0] == 0).all()


def test_never_evaluates_outside_the_bounds() -> None:
    seen = []

    def fun(x: np.ndarray) -> np.ndarray:
        seen.append(x)
        return _decay(x)

    for jac in ("2-point", "3-point"):
        fit = least_squares(fun, [1.0, 0.7], jac, bounds=([0, 0.6], [1.5, np.inf]))  # type: ignore[arg-type]
        assert fit.success
        assert fit.x[1] == 0.6
    points = np.array(seen)
    assert (points >= [0, 0.6]).all()
    assert (points[:, 0] <= 1.5).all()


def test_bounds_that_do_not_bind_change_nothing() -> None:
    free = least_squares(_decay, [1.0, 1.0])
    bound = least_squares(_decay, [1.0, 1.0], bounds=(-100, 100))
    np.testing.assert_array_equal(free.x, bound.x)


# --- what callers do ------------------------------------------------------------------------------


def test_arrays_are_the_callers_own() -> None:
    kept, copies = [], []

    def fun(x: np.ndarray) -> np.ndarray:
        kept.append(x)
        copies.append(x.copy())
        return _decay(x)

    def jac(x: np.ndarray) -> np.ndarray:
        made = nist.complex_step(_decay, x)
        x += 1e6
        return made

    start = np.array([1.0, 1.0])
    fit = least_squares(fun, start, jac)
    assert fit.success
    np.testing.assert_array_equal(start, [1.0, 1.0])
    np.testing.assert_array_equal(kept, copies)
    assert not any(
        np.shares_memory(a, b) for a in kept for b in (*kept, fit.x, start) if a is not b
    )


def test_returned_arrays_are_not_kept() -> None:
    buffer = np.empty(30)

    def fun(x: np.ndarray) -> np.ndarray:
        buffer[:] = _decay(x)
        return buffer

    fit = least_squares(fun, [1.0, 1.0], lambda x: nist.complex_step(_decay, x))
    buffer[:] = 0
    np.testing.assert_array_equal(fit.fun, _decay(fit.x))


def test_arguments_are_passed_on() -> None:
    def fun(x: np.ndarray, t: np.ndarray, *, rate: float) -> np.ndarray:
        return x * np.exp(-rate * t) - 2 * np.exp(-rate * t)

    fit = least_squares(fun, 1.0, args=(T,), kwargs={"rate": 0.5})
    assert fit.x == pytest.approx(2.0)


def test_accepts_lists_integers_and_strides() -> None:
    wide = np.zeros((30, 4))

    def jac(x: np.ndarray) -> np.ndarray:
        wide[:, ::2] = nist.complex_step(_decay, x)
        return wide[:, ::2]

    fit = least_squares(lambda x: list(_decay(x)), [1, 1], jac)
    assert fit.success


def test_the_result_is_used_as_scipys_is() -> None:
    """A mapping with the names of `OptimizeResult`, and its gradient."""
    scipy = pytest.importorskip("scipy.optimize")
    t = np.arange(6.0)

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return x[0] * np.exp(-x[1] * t) - np.array([2.1, 1.2, 0.8, 0.4, 0.3, 0.1])

    found, known = least_squares(residuals, [1.0, 1.0]), scipy.least_squares(residuals, [1.0, 1.0])
    assert set(known) <= set(found)
    assert len(found) == len(dict(found)) == len(list(found))
    for name in ("x", "cost", "fun", "jac", "active_mask"):
        np.testing.assert_allclose(found[name], known[name], rtol=1e-5, atol=1e-7)
        np.testing.assert_array_equal(dict(found)[name], getattr(found, name))
    np.testing.assert_array_equal(found["grad"], found.jac.T @ found.fun)
    assert np.abs(found.grad).max() == pytest.approx(found.optimality, abs=1e-12)
    with pytest.raises(KeyError, match="gradient"):
        found["gradient"]


class _OwnError(Exception):
    pass


@pytest.mark.parametrize(
    "error", [_OwnError("x"), ZeroDivisionError(), SystemExit(3), StopIteration()]
)
@pytest.mark.parametrize("where", ["first", "later", "jac"])
def test_exceptions_of_callbacks_pass_unchanged(error: BaseException, where: str) -> None:
    calls = []

    def fun(x: np.ndarray) -> np.ndarray:
        calls.append(0)
        if where == "first" or (where == "later" and len(calls) == 4):
            raise error
        return _decay(x)

    def jac(x: np.ndarray) -> np.ndarray:
        if where == "jac":
            raise error
        return nist.complex_step(_decay, x)

    with pytest.raises(type(error)) as caught:
        least_squares(fun, [1.0, 1.0], jac)
    assert caught.value is error


def _for_ever(fun: Callable[[np.ndarray], np.ndarray]) -> None:
    while True:
        least_squares(fun, [-1.2, 1.0], ftol=None, xtol=None, gtol=None, max_nfev=10**6)


def test_ctrl_c_keeps_the_best_point() -> None:
    def slow(x: np.ndarray) -> np.ndarray:
        time.sleep(0.002)
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]) + 1e-3 * np.sin(1e3 * x)

    timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(Interrupted) as caught:
        _for_ever(slow)
    timer.join()
    best = caught.value.best
    assert (best.termination, best.success) == ("interrupted", False)
    assert np.isfinite(best.x).all()


def _two(x: np.ndarray) -> np.ndarray:
    return np.array([x[0] - 1, x[1] - 2])


REFUSED: list[tuple[type[Exception], str, Callable[[], object]]] = [
    (SettingError, "function as fun", lambda: least_squares(3, [1.0])),  # type: ignore[arg-type]
    (SettingError, "finite x0", lambda: least_squares(_two, [np.nan, 1.0])),
    (SettingError, "finite x0", lambda: least_squares(_two, [np.inf, 1.0])),
    (SettingError, "real numbers", lambda: least_squares(_two, [1j, 1.0])),
    (SettingError, "shape", lambda: least_squares(_two, [[1.0, 1.0]])),
    (SettingError, "ragged", lambda: least_squares(_two, [[1.0], [1.0, 2.0]])),
    (SettingError, "parameter", lambda: least_squares(lambda x: np.ones(2), [])),
    (SettingError, "residual", lambda: least_squares(lambda x: [], [1.0])),
    (SettingError, "expected jac", lambda: least_squares(_two, [1.0, 1.0], "4-point")),  # type: ignore[arg-type]
    (SettingError, "expected jac", lambda: least_squares(_two, [1.0, 1.0], 7)),  # type: ignore[arg-type]
    (SettingError, "pair", lambda: least_squares(_two, [1.0, 1.0], bounds=3)),  # type: ignore[arg-type]
    (SettingError, "within", lambda: least_squares(_two, [1.0, 1.0], bounds=(2, 3))),
    (SettingError, "below", lambda: least_squares(_two, [1.0, 1.0], bounds=(1, 1))),
    (SettingError, "alike", lambda: least_squares(_two, [1.0, 1.0], bounds=([0.0] * 3, 9))),
    (SettingError, "below", lambda: least_squares(_two, [1.0, 1.0], bounds=(np.nan, 9))),
    (SettingError, "x_scale", lambda: least_squares(_two, [1.0, 1.0], x_scale="svd")),  # type: ignore[arg-type]
    (SettingError, "x_scale", lambda: least_squares(_two, [1.0, 1.0], x_scale=[1.0, 0.0])),
    (SettingError, "ftol", lambda: least_squares(_two, [1.0, 1.0], ftol=-1.0)),
    (SettingError, "xtol", lambda: least_squares(_two, [1.0, 1.0], xtol=np.nan)),
    (SettingError, "gtol", lambda: least_squares(_two, [1.0, 1.0], gtol="x")),  # type: ignore[arg-type]
    (SettingError, "max_nfev", lambda: least_squares(_two, [1.0, 1.0], max_nfev=0)),
    (DataError, "shape", lambda: least_squares(lambda x: np.eye(2), [1.0, 1.0])),
    (DataError, "real", lambda: least_squares(lambda x: x * 1j, [1.0, 1.0])),
    (DataError, "real", lambda: least_squares(lambda x: ["a"], [1.0])),
    (DataError, "real", lambda: least_squares(lambda x: None, [1.0])),  # type: ignore[arg-type, return-value]
    (DataError, r"\(2, 2\)", lambda: least_squares(_two, [1.0, 1.0], lambda x: np.ones((3, 2)))),
    (DataError, r"\(2, 2\)", lambda: least_squares(_two, [1.0, 1.0], lambda x: np.ones(2))),
    (DataError, "complex", lambda: least_squares(lambda x: np.abs(x), [1.0, 1.0], "cs")),
    (DataError, "same number", lambda: least_squares(lambda x: np.ones(2 + (x[0] != 1)), [1.0])),
]


@pytest.mark.parametrize(
    ("error", "words", "call"), REFUSED, ids=lambda v: v if isinstance(v, str) else ""
)
def test_mistakes_are_refused(
    error: type[Exception], words: str, call: Callable[[], object]
) -> None:
    with pytest.raises(error, match=words):
        call()


# --- laws -----------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(-6, 6))
def test_units_play_no_part(seed: int, power: int) -> None:
    random = np.random.default_rng(seed)
    start, noise = random.uniform(0.5, 2, 2), 0.05 * random.normal(size=30)
    unit = np.array([10.0**power, 1.0])
    plain = least_squares(lambda x: _decay(x) + noise, start, "cs")
    other = least_squares(lambda x: _decay(x * unit) + noise, start / unit, "cs")
    assert plain.success
    assert other.success
    np.testing.assert_allclose(other.x * unit, plain.x, rtol=1e-7)
    np.testing.assert_allclose(other.standard_errors * unit, plain.standard_errors, rtol=1e-6)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 8), st.integers(0, 8), st.integers(0, 2**32 - 1))
def test_linear_problems_are_solved_at_once(n: int, extra: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random.normal(size=(n + extra, n)), random.normal(size=n + extra)
    fit = least_squares(lambda x: a @ x - b, random.normal(size=n), lambda x: a)
    known = np.linalg.lstsq(a, b, rcond=None)[0]
    tolerance = 1e-12 * np.linalg.cond(a) * (1 + np.linalg.norm(known))
    np.testing.assert_allclose(fit.x, known, atol=tolerance, rtol=0)
