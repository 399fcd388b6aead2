"""The searches beside pymoo and pycma: the same optimum, comparable work, comparable fronts."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from sewfast import _core
from sewfast.errors import SettingError

LOW, HIGH = -2.0, 2.0


def rosenbrock(place: Any) -> float:
    x = LOW + np.asarray(place) * (HIGH - LOW)
    return float(np.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2))


def zdt(number: int, x: Any) -> tuple[float, float]:
    """Problems 1, 2, 3 and 6 of Zitzler, Deb and Thiele (2000)."""
    rest = float(np.mean(x[1:]))
    f, g = float(x[0]), 1.0 + 9.0 * rest
    if number == 6:
        f = float(1.0 - np.exp(-4.0 * x[0]) * np.sin(6.0 * np.pi * x[0]) ** 6)
        g = 1.0 + 9.0 * rest**0.25
    h = {
        1: 1.0 - np.sqrt(f / g),
        2: 1.0 - (f / g) ** 2,
        3: 1.0 - np.sqrt(f / g) - f / g * np.sin(10.0 * np.pi * f),
        6: 1.0 - (f / g) ** 2,
    }[number]
    return f, float(g * h)


def volume(points: Any) -> float:
    """Area that the points dominate below (1.1, 1.1)."""
    area, lowest = 0.0, 1.1
    for x, y in sorted(map(tuple, points)):
        if x < 1.1 and y < lowest:
            area += (1.1 - x) * (lowest - y)
            lowest = y
    return float(area)


def reached(trace: Any, value: float) -> int:
    """Evaluations until a value; one more than there were where it is not reached."""
    below = np.flatnonzero(np.asarray(trace) <= value)
    return int(below[0]) + 1 if len(below) else len(trace) + 1


def by_pycma(seed: int, evaluations: int) -> list[float]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cma = pytest.importorskip("cma", reason="needs the extra test")
        settings = {
            "bounds": [0, 1],
            "seed": seed + 1,
            "maxfevals": evaluations,
            "verbose": -9,
        }
        strategy = cma.CMAEvolutionStrategy([0.5] * 4, 0.3, settings)
        values: list[float] = []
        while not strategy.stop():
            points = strategy.ask()
            costs = [rosenbrock(p) for p in points]
            values += costs
            strategy.tell(points, costs)
    return values


def test_cma_es_needs_no_more_than_pycma() -> None:
    ours, theirs = [], []
    for seed in range(5):
        settings: dict[str, Any] = {"evaluations": 4000, "seed": seed}
        found = _core.search_least(rosenbrock, 4, method="cma-es", **settings)
        ours.append(reached(found["trace"], 1e-6))
        theirs.append(reached(by_pycma(seed, 4000), 1e-6))
    assert np.median(ours) < 1.5 * np.median(theirs)


def test_the_genetic_algorithm_comes_to_the_same_optimum() -> None:
    found = _core.search_least(rosenbrock, 4, method="genetic", evaluations=4000, seed=0)
    assert found["value"] < 1e-6
    np.testing.assert_allclose(LOW + found["x"] * (HIGH - LOW), 1.0, atol=1e-2)
    assert len(found["trace"]) == 4000
    assert found["trace"][-1] == found["value"] == rosenbrock(found["x"])


def by_pymoo(number: int, seed: int, size: int, evaluations: int) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("pymoo", reason="needs the extra test")
        from pymoo.algorithms.moo.nsga2 import NSGA2
        from pymoo.optimize import minimize
        from pymoo.problems import get_problem

        problem = get_problem(f"zdt{number}")
        algorithm = NSGA2(pop_size=size)
        return minimize(problem, algorithm, ("n_eval", evaluations), seed=seed + 1).F


@pytest.mark.nightly("seven problems against pymoo")
@pytest.mark.parametrize("number", [1, 2, 3, 6])
def test_fronts_are_as_large_as_pymoos(number: int) -> None:
    size, evaluations, dimensions = 50, 8000, 10 if number == 6 else 30
    ours, theirs = [], []
    for seed in range(3):
        found = _core.search_front(
            lambda x: zdt(number, x), dimensions, 2, size=size, evaluations=evaluations, seed=seed
        )
        ours.append(volume(found["values"]))
        theirs.append(volume(by_pymoo(number, seed, size, evaluations)))
    assert np.median(ours) > 0.97 * np.median(theirs)


def test_what_a_function_raises_ends_the_search() -> None:
    calls = []

    def faulty(x: Any) -> float:
        calls.append(x)
        if len(calls) == 30:
            raise ZeroDivisionError("here")
        return float(np.sum(x))

    with pytest.raises(ZeroDivisionError, match="here"):
        _core.search_least(faulty, 3, method="genetic", evaluations=1000, seed=0)
    assert len(calls) == 30


@pytest.mark.parametrize(
    "settings", [{"method": "luck"}, {"evaluations": 0}, {"start": [0.5]}, {"start": [2.0, 0.0]}]
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any]) -> None:
    usual = {"method": "genetic", "evaluations": 10, "seed": 0}
    with pytest.raises(SettingError, match="expected"):
        _core.search_least(rosenbrock, 2, **{**usual, **settings})
