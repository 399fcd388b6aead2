"""The best that gains do on a machine itself: what a commissioning's cost is held against.

Same variables and bounds, same cost and same references as the commissioning's search, but every
loop runs on the machine. Nothing in the package knows it. The machine is any that can be advanced
sample by sample, so the search is pycma's; `tune` runs models only.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cma
import numpy as np

from sewfast import Commissioning, Controller
from sewfast.commissioning import SteppedBench
from sewfast.commissioning.demands import demands
from sewfast.commissioning.references import standard
from sewfast.cost import Cost
from sewfast.loop import ClosedLoopRun
from sewfast.tuning import Variable
from sewfast.variables import applied

EVALUATIONS = 200
"""From the tuned gains; two thirds of it in a first search, the rest close to its best."""
FINALISTS = 3
"""Of the search over the short references, which then run the long ones."""
LINEAR = ("alpha", "beta", "filter_time")
HOPELESS = 3.0
"""Times the best cost: a candidate whose first references cost more runs no others."""


@dataclass(frozen=True)
class Oracle:
    """Its controller, and what that costs on the references of the verification."""

    controller: Controller
    cost: float
    evaluations: int


def oracle(
    bench: SteppedBench, found: Commissioning, *, seed: int = 0, evaluations: int = EVALUATIONS
) -> Oracle:
    """The least cost that a search on the machine finds; never above the commissioned one's."""
    assert found.controller is not None
    assert found.tuning is not None
    assert found.cost is not None
    box, cost = found.tuning.variables, found.cost
    verify = {c.reference: c.predicted.r for c in found.comparisons}
    speed = max(float(r.max()) for r in verify.values()) if "trapezoid" not in verify else (
        float(verify["trapezoid"].max())
    )  # fmt: skip
    asked = demands(
        bench, u_max=found.controller.u_max, speed=speed, references=None, members=1,
        evaluations=evaluations, seed=seed, threads=os.cpu_count() or 1,
    )  # fmt: skip
    practice = standard(found.acceleration, asked, bench.Ts, short=True)

    tried: list[tuple[float, Controller]] = []

    def value(point: Sequence[float]) -> float:
        controller = _at(point, box, found.controller)
        best = min((c for c, _ in tried), default=np.inf)
        tried.append((_cost(bench, controller, practice, cost, HOPELESS * best), controller))
        return tried[-1][0]

    tried.append((_cost(bench, found.controller, practice, cost), found.controller))
    start, first = _place(found.controller, box), round(evaluations * 2 / 3)
    for spread, until in ((0.12, first), (0.04, evaluations)):
        options = {"bounds": [0, 1], "seed": seed + 1, "verbose": -9}
        strategy = cma.CMAEvolutionStrategy(list(start), spread, options)
        while len(tried) < until and not strategy.stop():
            points = strategy.ask()
            strategy.tell(points, [value(p) for p in points])
        start = _place(min(tried, key=lambda t: t[0])[1], box)
    finalists = [c for _, c in sorted(tried, key=lambda t: t[0])[:FINALISTS]]
    whole = [(_cost(bench, c, verify, cost), c) for c in (found.controller, *finalists)]
    least, controller = min(whole, key=lambda t: t[0])
    return Oracle(controller, least, len(tried))


def driven(bench: SteppedBench, controller: Controller, r: np.ndarray, name: str) -> ClosedLoopRun:
    """A loop on the machine, of its true speed; what `SteppedBench.follow` does without its
    recording.
    """
    machine, core = bench.machine, controller.core()
    per_count, before = 60.0 / (bench.counts_per_rev * bench.Ts), 0.0
    u, y, feedback = (np.zeros(len(r)) for _ in range(3))
    machine.reset()
    first = machine.counts
    for k, wanted in enumerate(r.tolist()):
        counts = machine.counts - first
        y[k] = machine.speed_rpm  # type: ignore[attr-defined]
        u[k] = command = core.step(wanted, (counts - before) * per_count)
        feedback[k], before = core.filtered, counts
        machine.step(command)
    machine.step(0.0)
    t = np.arange(len(r)) * bench.Ts
    return ClosedLoopRun(t, np.array(r), u, y, feedback, controller, bench.name, name)


def _cost(
    bench: SteppedBench,
    controller: Controller,
    references: Mapping[str, np.ndarray],
    cost: Cost,
    hopeless: float = np.inf,
) -> float:
    """Mean over the references; no more of these once the mean is above `hopeless` anyway."""
    total = 0.0
    for name, r in sorted(references.items(), key=lambda item: len(item[1])):
        # weights are numbers, so the mean of single costs is the cost of all runs
        total += cost.of(driven(bench, controller, r, name)) / len(references)
        if not total <= hopeless:
            break
    return total if np.isfinite(total) else 1e9


def _at(point: Sequence[float], box: Sequence[Variable], like: Controller) -> Controller:
    """At a point of the unit box."""
    values = {}
    for place, v in zip(np.clip(point, 0.0, 1.0), box, strict=True):
        is_linear = v.name in LINEAR or v.low <= 0.0
        values[v.name] = (
            v.low + place * (v.high - v.low) if is_linear else v.low * (v.high / v.low) ** place
        )
        if v.name == "filter_samples":
            values[v.name] = round(values[v.name])
    return replace(applied(values, like, "oracle"), notes="oracle")


def _place(controller: Controller, box: Sequence[Variable]) -> np.ndarray:
    """The point of the unit box where a controller lies."""
    gains, places = controller.gains.to("standard"), []
    for v in box:
        own = getattr(gains, v.name) if v.name in ("Kp", "Ti", "Td") else getattr(controller, v.name)
        if v.name in LINEAR or v.low <= 0.0:
            places.append((own - v.low) / (v.high - v.low))
        else:
            places.append(np.log(max(own, v.low) / v.low) / np.log(v.high / v.low))
    return np.clip(places, 0.0, 1.0)
