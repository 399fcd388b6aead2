"""Searches of one tuning task: evaluations until within 1 % of the best cost that any found.

The task: a linear output-error model of the virtual machine, its gain at .8, 1 and 1.25 with a
delay, trapezoid, both chirps and the random reference, six variables. Rivals see the same box:
pymoo's genetic algorithm and pycma, through `sewfast.tuning.costs`.

    python benches/bench_tuning.py [SEEDS] [EVALUATIONS]
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

import sewfast
from sewfast import Cost, signals
from sewfast.tuning import costs, first_controller, tune
from sewfast.tuning.task import threads_or_all

COST = Cost(tracking=1.0, chatter=5.0, overshoot=3.0, saturation=0.0)


@cache
def model() -> sewfast.Model:
    machine = sewfast.VirtualMachine()
    u = signals.excitation("chirp_lo_hi")
    y = sewfast.speed_from_counts(machine.run(u).counts, machine.Ts, machine.counts_per_rev)
    data = sewfast.Dataset.from_arrays(u, y, machine.Ts, input_units="V", output_unit="RPM")
    return sewfast.identify(data, model="oe")


@cache
def references() -> tuple[Any, ...]:
    """Trapezoid to 2,000 RPM in .4 s, Hi-Lo to 2,000, Lo-Hi to 600, random 200 to 2,000."""
    k = np.arange(1500.0)
    trapezoid = 2000.0 * np.clip(np.minimum((k - 100) / 400, (1400 - k) / 400), 0, 1)
    names = ("chirp_hi_lo", "chirp_lo_hi", "random")
    return (trapezoid, *(signals.reference(name) for name in names))


@cache
def box() -> tuple[Any, ...]:
    """The variables that `tune` searches, with their bounds."""
    return tune(model(), references(), evaluations=1, cost=COST).variables


def controller(point: Any) -> sewfast.Controller:
    """At a point of the unit box, scaled as `tune` scales it."""
    values = {}
    for place, v in zip(np.clip(point, 0, 1), box(), strict=True):
        linear = v.name in ("alpha", "beta")
        ratio = 1.0 if linear else v.high / v.low
        values[v.name] = v.low + place * (v.high - v.low) if linear else v.low * ratio**place
    return first_controller(model()).with_values(values, "")


def start() -> Any:
    places = []
    began = first_controller(model())
    gains = began.gains.to("standard")
    for v in box():
        own = getattr(gains, v.name) if v.name in ("Kp", "Ti", "Td") else getattr(began, v.name)
        linear = v.name in ("alpha", "beta")
        share = (own - v.low) / (v.high - v.low)
        places.append(share if linear else np.log(own / v.low) / np.log(v.high / v.low))
    return np.clip(places, 0, 1)


def values(points: Any) -> Any:
    return costs([controller(p) for p in points], model(), references(), cost=COST)


def by_sewfast(method: Any) -> Callable[[int, int], Any]:
    def search(seed: int, evaluations: int) -> Any:
        found = tune(
            model(), references(), cost=COST, method=method, evaluations=evaluations, seed=seed
        )
        return found.trace

    return search


def by_pycma(seed: int, evaluations: int) -> Any:
    import cma

    trace: list[float] = []
    options = {"bounds": [0, 1], "seed": seed + 1, "maxfevals": evaluations, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(list(start()), 0.15, options)
    while len(trace) < evaluations and not strategy.stop():
        points = strategy.ask()
        found = values(points)
        strategy.tell(points, list(np.nan_to_num(found, posinf=1e9)))
        trace += list(found)
    return np.minimum.accumulate(trace)


def by_pymoo(seed: int, evaluations: int) -> Any:
    from pymoo.algorithms.soo.nonconvex.ga import GA
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize

    trace: list[float] = []

    class Tuning(Problem):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(n_var=len(box()), n_obj=1, xl=0.0, xu=1.0)

        def _evaluate(self, x: Any, out: Any, *args: Any, **kwargs: Any) -> None:
            found = values(x)
            trace.extend(found)
            out["F"] = np.nan_to_num(found, posinf=1e9)[:, None]

    rng = np.random.default_rng(seed)
    near = np.clip(start() + 0.08 * rng.standard_normal((12, len(box()))), 0, 1)
    first = np.vstack([start(), near, rng.random((11, len(box())))])
    algorithm = GA(pop_size=24, sampling=first)
    minimize(Tuning(), algorithm, ("n_eval", evaluations), seed=seed + 1)
    return np.minimum.accumulate(trace)


SEARCHES: dict[str, Callable[[int, int], Any]] = {
    "genetic": by_sewfast("genetic"),
    "cma-es": by_sewfast("cma-es"),
    "pymoo GA": by_pymoo,
    "pycma": by_pycma,
}


def genetic(seeds: int, evaluations: int = 3000) -> str:
    """How many of so many genetic searches come within 1 % of the least that any search found.

    Beside them one of 5,000 evaluations and one of CMA-ES of 4,000 look for the least.
    """
    traces = [by_sewfast("genetic")(seed, evaluations) for seed in range(seeds)]
    far = [by_sewfast("genetic")(seeds, 5000), by_sewfast("cma-es")(seeds, 4000)]
    best = min(trace[-1] for trace in traces + far)
    close = sum(trace[-1] <= 1.01 * best for trace in traces)
    worst = max(trace[-1] for trace in traces) / best
    return (
        f"genetic algorithm, {evaluations} evaluations: {close} of {seeds} seeds within 1 % of the "
        f"best known cost {best:.4f}, the worst at {worst:.4f} of it"
    )


def main(seeds: int, evaluations: int) -> None:
    traces: dict[str, list[Any]] = {}
    seconds: dict[str, float] = {}
    for name, search in SEARCHES.items():
        began = time.perf_counter()
        traces[name] = [search(seed, evaluations) for seed in range(seeds)]
        seconds[name] = (time.perf_counter() - began) / seeds
    best = min(trace[-1] for found in traces.values() for trace in found)
    print(f"best cost {best:.4f}; {threads_or_all(None)} threads")
    for name, found in traces.items():
        at = [int(np.argmax(t <= 1.01 * best)) + 1 for t in found if t[-1] <= 1.01 * best]
        middle = f"{np.median(at):.0f}" if at else "-"
        worst = max(t[-1] for t in found) / best
        print(
            f"{name:10} {len(at)} of {seeds} within 1 %, median after {middle} evaluations, "
            f"worst {worst:.4f} of the best, {seconds[name]:.1f} s a search"
        )


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    given = [int(argument) for argument in sys.argv[1:]]
    main(*(given + [20, 3000][len(given) :]))
