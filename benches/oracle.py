"""The best that gains do on a machine itself: what a commissioning's cost is held against.

Same variables and bounds, same cost and same references as the commissioning's search, but every
loop runs on the machine. Unless it is to look at the cost alone it must bear what the commissioned
gains bear: a load step deviates the speed no more than under them, and Ms on the small signals is
within the same limit. Nothing in the package knows it. The machine is any that can be advanced
sample by sample, so the search is pycma's; `tune` runs models only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cma
import numpy as np

from sewfast import Commissioning, Controller
from sewfast.commissioning import SteppedBench
from sewfast.commissioning.demands import demands
from sewfast.commissioning.excitations import standard
from sewfast.commissioning.slow import Thinning
from sewfast.control.controller import NOTCH_NAMES
from sewfast.control.loop import ClosedLoopRun
from sewfast.control.margins import margins
from sewfast.tuning.objective import Cost
from sewfast.tuning.search import Variable

EVALUATIONS = 200
"""From the tuned gains; two thirds of it in a first search, the rest close to its best."""
FINALISTS = 3
"""Of the search over the short references, which then run the long ones."""
LINEAR = ("alpha", "beta", "filter_time")
BEARS = 1.02
"""Times the commissioned gains' deviation under the load that the oracle's may have."""
REFUSED, WORST = 10.0, 20.0
"""Times the best cost: of candidates that do not bear what they must, by how much. A search whose
candidates all cost the same ends there, and the commissioned gains lie on the edge of what is
borne: with one cost for all the search was over after two generations on most machines."""
HOPELESS = 3.0
"""Times the best cost: a candidate whose first references cost more runs no others."""


@dataclass(frozen=True)
class Oracle:
    """Its controller, and what that costs on the references of the verification."""

    controller: Controller
    cost: float
    evaluations: int


def oracle(
    bench: SteppedBench,
    found: Commissioning,
    *,
    seed: int = 0,
    evaluations: int = EVALUATIONS,
    cost_alone: bool = False,
) -> Oracle:
    """The least cost that a search on the machine finds; never above the commissioned one's."""
    assert found.controller is not None
    assert found.tuning is not None
    assert found.cost is not None
    own, cost = found.controller, found.cost
    box = [_including(v, own, found) for v in found.tuning.variables]
    # not of the prediction, which takes every k-th sample of a slow drive
    verify = {c.reference: c.measured.r for c in found.comparisons if c.measured is not None}
    practice = practised(bench, found, seed)
    short = (lambda controller: 0.0) if cost_alone else _requirement(bench, found)
    tried: list[tuple[float, Controller]] = [(_cost(bench, own, practice, cost), own)]

    def value(point: Sequence[float]) -> float:
        controller = _at(point, box, own)
        best = min(c for c, _ in tried)
        missed = short(controller)
        if missed == 0.0:
            tried.append((_cost(bench, controller, practice, cost, HOPELESS * best), controller))
        else:
            tried.append((best * min(REFUSED + missed, WORST), controller))
        return tried[-1][0]

    start, first = _place(own, box), round(evaluations * 2 / 3)
    for spread, until in ((0.12, first), (0.04, evaluations)):
        options = {"bounds": [0, 1], "seed": seed + 1, "verbose": -9}
        strategy = cma.CMAEvolutionStrategy(list(start), spread, options)
        while len(tried) < until and not strategy.stop():
            points = strategy.ask()
            strategy.tell(points, [value(p) for p in points])
        start = _place(min(tried, key=lambda t: t[0])[1], box)
    finalists = [c for _, c in sorted(tried, key=lambda t: t[0])[:FINALISTS]]
    whole = [(_cost(bench, c, verify, cost), c) for c in (own, *finalists)]
    least, controller = min(whole, key=lambda t: t[0])
    return Oracle(controller, least, len(tried))


def practised(
    bench: SteppedBench, found: Commissioning, seed: int, pace: float = 1.0
) -> Mapping[str, np.ndarray]:
    """The short references of a commissioning, at a share of the acceleration that it measured."""
    assert found.controller is not None
    assert found.acceleration is not None
    trapezoid = next(c for c in found.comparisons if c.reference == "trapezoid")
    asked = demands(
        bench, u_max=found.controller.u_max, speed=float(trapezoid.predicted.r.max()),
        references=None, members=1, evaluations=1, seed=seed, threads=1,
    )  # fmt: skip
    return standard(pace * found.acceleration, asked, bench.Ts, short=True)


def _requirement(bench: SteppedBench, found: Commissioning) -> Callable[[Controller], float]:
    """How far a controller is from bearing what the commissioned one does; 0 where it does."""
    assert found.controller is not None
    assert found.acceleration is not None
    met = found.met or {}
    load, limit, small = met.get("load"), met.get("Ms_limit"), found.small_signal
    # reached at half the acceleration that the machine has, settled for as long
    ramp = round(2.0 * load["level"] / found.acceleration / bench.Ts) if load else 0
    most = BEARS * deviation(bench, found.controller, load, ramp) if load else np.inf

    def short(controller: Controller) -> float:
        missed = 0.0
        if small is not None and limit is not None:
            missed += _beyond(margins(controller, small.model).Ms_robust, limit)
        if load:
            missed += _beyond(deviation(bench, controller, load, ramp), most)
        return missed

    return short


def _beyond(value: float, most: float) -> float:
    """Logarithm of how many times too large; that of a loop that runs away is bounded."""
    return max(0.0, np.log(min(value / most, 100.0))) if np.isfinite(value) else np.log(100.0)


def deviation(
    bench: SteppedBench, controller: Controller, load: Mapping[str, float], ramp: int
) -> float:
    """What a load that brakes does to a held speed [RPM rms]: beside the same loop without it."""
    look = max(200, ramp // 2)
    r = load["level"] * np.minimum(1.0, np.arange(2 * ramp + look) / ramp)
    push = np.where(np.arange(len(r)) >= 2 * ramp, load["disturbance"], 0.0)
    loops = [driven(bench, controller, r, "load", p).y for p in (push, 0.0 * push)]
    return float(np.sqrt(np.mean((loops[0] - loops[1])[-look:] ** 2)))


def driven(
    bench: SteppedBench,
    controller: Controller,
    r: np.ndarray,
    name: str,
    disturbance: np.ndarray | None = None,
) -> ClosedLoopRun:
    """A loop on the machine, of its true speed: what `SteppedBench.follow` does without recording.

    A disturbance [V] comes on behind the controller's limits.
    """
    machine, core = bench.machine, controller.core()
    per_count, before = 60.0 / (bench.counts_per_rev * bench.Ts), 0.0
    u, y, feedback = (np.zeros(len(r)) for _ in range(3))
    machine.reset()
    first = machine.counts
    push = [0.0] * len(r) if disturbance is None else disturbance.tolist()
    for k, wanted in enumerate(r.tolist()):
        counts = machine.counts - first
        y[k] = machine.speed_rpm  # type: ignore[attr-defined]
        u[k] = command = core.step(wanted, (counts - before) * per_count)
        feedback[k], before = core.filtered, counts
        machine.step(command + push[k])
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
    return replace(like.with_values(values, "oracle"), notes="oracle")


def _including(v: Variable, own: Controller, found: Commissioning) -> Variable:
    """Bounds at the machine's samples: those of a slow drive's search are at every k-th of them."""
    k = Thinning.between(found.sample_time or own.Ts, own.Ts).k
    low, high = (v.low, k * v.high) if v.name == "filter_samples" else (v.low, v.high)
    value = _value(own, v)
    return replace(v, low=min(low, value) if value > 0.0 else low, high=max(high, value))


def _value(controller: Controller, v: Variable) -> float:
    """Of a variable; `notch_depth[0]` is the second number of the first biquad."""
    name, _, k = v.name.removesuffix("]").partition("[")
    if name in NOTCH_NAMES:
        return controller.biquads[int(k)].numbers[NOTCH_NAMES.index(name)]
    of = controller.gains.to("standard") if v.name in ("Kp", "Ti", "Td") else controller
    return float(getattr(of, v.name))


def _place(controller: Controller, box: Sequence[Variable]) -> np.ndarray:
    """The point of the unit box where a controller lies."""
    places = []
    for v in box:
        own = _value(controller, v)
        if v.name in LINEAR or v.low <= 0.0:
            places.append((own - v.low) / (v.high - v.low))
        else:
            places.append(np.log(max(own, v.low) / v.low) / np.log(v.high / v.low))
    return np.clip(places, 0.0, 1.0)
