"""Least squares beside SciPy's: digits on NIST's certified regressions, and time, in one process.

``python benches/bench_least_squares.py`` prints the digits of every problem (log relative error of
the worst parameter, the worse of both starts) and a summary, with defaults and with tolerances of
1e-15; needs SEWFAST_DATA, the folder of the public recordings.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import nist

scipy_optimize = pytest.importorskip("scipy.optimize")

TIGHT = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-15}
WHO = ("sewfast", "lm", "trf")
FEW = 4
"""Correct digits below which a reported success is false."""


def _solver(who: str, options: dict[str, Any]) -> Callable[..., Any]:
    if who == "sewfast":
        return lambda p, b: sewfast.least_squares(p.residuals, b, p.jacobian, **options)
    # SciPy's 100 evaluations per parameter end some runs at tight tolerances before the minimum
    more = {**options, "max_nfev": 5000} if options else {}
    return lambda p, b: scipy_optimize.least_squares(
        p.residuals, b, p.jacobian, method=who, x_scale="jac", **more
    )


def problems() -> list[nist.Regression]:
    folder = os.environ.get("SEWFAST_DATA")
    if folder is None:
        pytest.skip("needs public recordings: set SEWFAST_DATA to their folder")
    return nist.read_all(Path(folder) / "nist_strd")


def solve_all(who: str, options: dict[str, Any]) -> list[tuple[str, float, Any]]:
    """Name, digits and result of all 54 starts."""
    solve = _solver(who, options)
    found = []
    with np.errstate(all="ignore"):
        for problem in problems():
            for start in problem.starts:
                fit = solve(problem, start)
                found.append((problem.name, problem.digits(fit.x), fit))
    return found


def summary(who: str, found: list[tuple[str, float, Any]], seconds: float) -> str:
    digits = np.array([d for _, d, _ in found])
    false = sum(fit.success and d < FEW for _, d, fit in found)
    calls = sum(fit.nfev for _, _, fit in found)
    return (
        f"{who:8} mean {digits.mean():5.2f}  least {digits.min():4.1f}  "
        f"4 digits {np.sum(digits >= 4):2d}  6 digits {np.sum(digits >= 6):2d}  "
        f"false successes {false}  evaluations {calls:5d}  {seconds:.2f} s"
    )


@pytest.mark.benchmark(group="54 starts of NIST's regressions, defaults")
@pytest.mark.parametrize("who", WHO)
def test_certified(benchmark: Any, who: str) -> None:
    found = benchmark.pedantic(solve_all, args=(who, {}), rounds=3)
    print("\n" + summary(who, found, benchmark.stats.stats.median))


@pytest.mark.benchmark(group="one fit, 3 parameters, 100 residuals")
@pytest.mark.parametrize("who", WHO)
def test_one_fit(benchmark: Any, who: str) -> None:
    """What a call costs where the functions cost next to nothing."""
    t = np.linspace(0, 4, 100)
    y = 2 * np.exp(-t) + 0.3 + 0.01 * np.sin(20 * t)

    def residuals(x: np.ndarray) -> np.ndarray:
        return x[0] * np.exp(-x[1] * t) + x[2] - y

    def jacobian(x: np.ndarray) -> np.ndarray:
        e = np.exp(-x[1] * t)
        return np.column_stack([e, -x[0] * t * e, np.ones_like(t)])

    start = np.array([1.0, 0.5, 0.0])
    if who == "sewfast":
        benchmark(sewfast.least_squares, residuals, start, jacobian)
    else:
        benchmark(scipy_optimize.least_squares, residuals, start, jacobian, method=who)


def main() -> None:
    for title, options in (("defaults", {}), ("tolerances 1e-15", TIGHT)):
        table: dict[str, list[float]] = {}
        lines = []
        for who in WHO:
            began = time.perf_counter()
            found = solve_all(who, options)
            lines.append(summary(who, found, time.perf_counter() - began))
            for (name, first, _), (_, second, _) in zip(found[::2], found[1::2], strict=True):
                table.setdefault(name, []).append(min(first, second))
        print(f"\n{title}\n{'':10}" + "".join(f"{who:>9}" for who in WHO))
        for name, digits in table.items():
            print(f"{name:10}" + "".join(f"{d:9.1f}" for d in digits))
        print("\n".join(lines))


if __name__ == "__main__":
    main()
