"""Runs of `identify` on cases of the battery, their scores, and the summary over families.

What is reported of the test error e of a run (o: the oracle's, s: rms of the training's noise):

    over_oracle    e / o, on the noise-free test record
    as_measured    sqrt(e^2 + s^2) / sqrt(o^2 + s^2): the same ratio on a test record that has the
                   training's noise, as every real one has
    over_oe        e / output error's
    over_hindsight e / the least of output error's with 2, 3 and 4 past values (short records)
    over_noise     e / s
    spread         worst over median of the runs of one case, which differ in the seed only
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sewfast import Model, SewfastError, identify

from .families import FAMILIES, Case, make
from .references import References, digest, gain_error, references, score

WORSE = 1.05
"""A run is counted as worse than output error above this ratio."""
NETWORKS = ("neural_ss", "neural_oe")


@dataclass(frozen=True)
class Task:
    """One case and how `identify` is called on it; `runs` of 0 only gives its references."""

    family: str
    seed: int
    runs: int = 1
    time_budget: float | None = None
    threads: int | None = None
    kept: References | None = None


@dataclass(frozen=True)
class Run:
    """One call of `identify`; `failure` says why there is no model."""

    seed: int
    error: float
    seconds: float
    cpu: float
    kind: str = ""
    orders: str = ""
    gain_error: float | None = None
    range_gain_error: float | None = None
    failure: str = ""

    @property
    def is_network(self) -> bool:
        return any(kind in NETWORKS for kind in self.kind.split("+"))


@dataclass(frozen=True)
class Outcome:
    """All runs of one case with its references."""

    family: str
    seed: int
    samples: int
    is_linear: bool
    references: References
    runs: tuple[Run, ...]

    @property
    def split(self) -> str:
        return FAMILIES[self.family].split

    @property
    def median(self) -> float:
        """Error of the median run."""
        return float(np.median([r.error for r in self.runs]))

    def over_oracle(self) -> list[float]:
        """Infinite where the oracle is the truth itself: no other parameters fit better."""
        oracle = self.references.oracle
        return [r.error / oracle if oracle else math.inf for r in self.runs]

    def as_measured(self) -> list[float]:
        s = self.references.noise
        return [math.hypot(r.error, s) / math.hypot(self.references.oracle, s) for r in self.runs]

    def over_oe(self) -> list[float]:
        return [r.error / self.references.oe for r in self.runs]

    def over_oe_measured(self) -> list[float]:
        s = self.references.noise
        return [math.hypot(r.error, s) / math.hypot(self.references.oe, s) for r in self.runs]

    def over_hindsight(self) -> list[float]:
        """Empty for longer records."""
        least = self.references.hindsight
        return [r.error / least for r in self.runs] if least else []

    def over_noise(self) -> list[float]:
        return [r.error / self.references.noise for r in self.runs]

    @property
    def spread(self) -> float:
        """Worst over median; 1 for a single run, infinite where any failed."""
        worst = max(r.error for r in self.runs)
        return worst / self.median if math.isfinite(worst) else math.inf

    def to_json(self) -> dict[str, Any]:
        return {
            **{k: v for k, v in asdict(self).items() if k != "runs"},
            "split": self.split,
            "runs": [
                {**asdict(run), **dict(zip(_RATIOS, values, strict=True))}
                for run, *values in zip(
                    self.runs,
                    self.over_oracle(),
                    self.as_measured(),
                    self.over_oe(),
                    self.over_noise(),
                    strict=True,
                )
            ],
        }


_RATIOS = ("over_oracle", "as_measured", "over_oe", "over_noise")


# --- running --------------------------------------------------------------------------------------


def outcome(task: Task) -> Outcome:
    """Make the case, its references where none are kept for these data, and run `identify`."""
    case = make(task.family, task.seed)
    kept = task.kept
    if kept is None or kept.digest != digest(case):
        kept = references(case)
    runs = [_run(task, case, kept, seed) for seed in range(task.runs)]
    return Outcome(task.family, task.seed, case.samples, case.is_linear, kept, tuple(runs))


def _run(task: Task, case: Case, kept: References, seed: int) -> Run:
    data = case.training
    wall, used = time.perf_counter(), time.process_time()
    failure, model = "", None
    try:
        model = identify(data, seed=seed, time_budget=task.time_budget, threads=task.threads)
    except SewfastError as e:
        failure = f"{type(e).__name__}: {e}"
    wall, used = time.perf_counter() - wall, time.process_time() - used
    if model is None:
        return Run(seed, math.inf, wall, used, failure=failure)
    gains = [
        None if gain is None or probe is None else gain_error(case, model, gain, probe)
        for gain, probe in ((kept.gain, case.gain_probe), (kept.range_gain, case.range_probe))
    ]
    orders = " ".join(f"{k}={v}" for k, v in model.orders.items())
    return Run(seed, score(case, model), wall, used, kind_of(model), orders, *gains)


def kind_of(model: Model) -> str:
    """The kind of a model, or of an ensemble's members: one name, or several joined by +."""
    kinds = {m.kind for m in model.members} or {model.kind}
    return "+".join(sorted(kinds))


def run_all(
    tasks: Sequence[Task], jobs: int, ended: Callable[[Outcome], None]
) -> list[Outcome]:  # fmt: skip
    """All tasks, in this process or in several; `ended` is called as each ends."""
    done: dict[tuple[str, int], Outcome] = {}
    for found in _outcomes(tasks, jobs):
        done[found.family, found.seed] = found
        ended(found)
    return [done[t.family, t.seed] for t in tasks]


def _outcomes(tasks: Sequence[Task], jobs: int) -> Iterable[Outcome]:
    if jobs == 1:
        yield from map(outcome, tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        for future in as_completed([pool.submit(outcome, t) for t in tasks]):
            yield future.result()


# --- kept references ------------------------------------------------------------------------------


class Cache:
    """References in a JSON file, by family and seed; a missing file is an empty cache."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        text = path.read_text("utf-8") if path is not None and path.exists() else "{}"
        self._kept = {key: References(**value) for key, value in json.loads(text).items()}

    def get(self, family: str, seed: int) -> References | None:
        return self._kept.get(f"{family}/{seed}")

    def put(self, found: Outcome) -> None:
        """Keep an outcome's references, in the file as well, whole or not at all."""
        key = f"{found.family}/{found.seed}"
        if self.path is None or self._kept.get(key) == found.references:
            return
        self._kept[key] = found.references
        text = json.dumps({k: v.to_json() for k, v in sorted(self._kept.items())}, indent=1)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        new = self.path.with_name(self.path.name + f".{os.getpid()}")
        new.write_text(text + "\n", "utf-8")
        new.replace(self.path)


# --- summary --------------------------------------------------------------------------------------


def summary(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float | int | None]]:
    """Figures for each half that was run."""
    splits = sorted({o.split for o in outcomes}, reverse=True)
    return {s: _summary([o for o in outcomes if o.split == s]) for s in splits}


def _summary(outcomes: Sequence[Outcome]) -> dict[str, float | int | None]:
    runs = [(o, r) for o in outcomes for r in o.runs]
    gains = [r.gain_error for _, r in runs if r.gain_error is not None]
    range_gains = [r.range_gain_error for _, r in runs if r.range_gain_error is not None]
    linear = [r.is_network for o, r in runs if o.is_linear]
    worse = [x > WORSE for o in outcomes for x in o.over_oe()]
    visibly = [x > WORSE for o in outcomes for x in o.over_oe_measured()]
    repeated = [o.spread for o in outcomes if len(o.runs) > 1]
    return {
        "cases": len(outcomes),
        "runs": len(runs),
        "failed": sum(bool(r.failure) for _, r in runs),
        "over_oracle_median": _quantile([x for o in outcomes for x in o.over_oracle()], 0.5),
        "over_oracle_90": _quantile([x for o in outcomes for x in o.over_oracle()], 0.9),
        "as_measured_median": _quantile([x for o in outcomes for x in o.as_measured()], 0.5),
        "as_measured_90": _quantile([x for o in outcomes for x in o.as_measured()], 0.9),
        "over_noise_median": _quantile([x for o in outcomes for x in o.over_noise()], 0.5),
        "worse_than_oe": _share(worse),
        "worse_than_oe_measured": _share(visibly),
        "over_hindsight_median": _quantile([x for o in outcomes for x in o.over_hindsight()], 0.5),
        "over_hindsight_90": _quantile([x for o in outcomes for x in o.over_hindsight()], 0.9),
        "over_hindsight_worst": _quantile([x for o in outcomes for x in o.over_hindsight()], 1.0),
        "spread_95": _quantile(repeated, 0.95),
        "networks_for_linear_truth": _share(linear),
        "gain_error_median": _quantile(gains, 0.5),
        "gain_error_worst": _quantile(gains, 1.0),
        "range_gain_error_worst": _quantile(range_gains, 1.0),
        "seconds_median": _quantile([r.seconds for _, r in runs], 0.5),
        "seconds_worst": _quantile([r.seconds for _, r in runs], 1.0),
        "cpu_total": float(sum(r.cpu for _, r in runs)),
    }


def _quantile(values: Sequence[float], q: float) -> float | None:
    """By rank, towards the worse: infinite values are values."""
    if not values:
        return None
    ranked = sorted(values)
    if q == 0.5:
        return float(np.median(ranked))
    return ranked[min(len(ranked) - 1, math.ceil(q * len(ranked)) - 1)]


def _share(flags: Sequence[bool]) -> float | None:
    return sum(flags) / len(flags) if flags else None


_WORDS = {
    "over_oracle_median": "error over the oracle's, median",
    "over_oracle_90": "error over the oracle's, 90 % quantile",
    "as_measured_median": "the same with the training's noise, median",
    "as_measured_90": "the same with the training's noise, 90 % quantile",
    "over_noise_median": "error over the noise, median",
    "worse_than_oe": f"share over {WORSE} x output error",
    "worse_than_oe_measured": "the same with the training's noise",
    "over_hindsight_median": "short records: error over output error's in hindsight, median",
    "over_hindsight_90": "the same, 90 % quantile",
    "over_hindsight_worst": "the same, worst",
    "spread_95": "worst over median seed, 95 % quantile",
    "networks_for_linear_truth": "share of networks for a linear truth",
    "gain_error_median": "steady gain of motors, median error",
    "gain_error_worst": "steady gain of motors, worst error",
    "range_gain_error_worst": "the same between the ends of the record, worst",
    "seconds_median": "wall, median [s]",
    "seconds_worst": "wall, worst [s]",
    "cpu_total": "processor, all runs [s]",
    "failed": "runs without a model",
}


def line(found: Outcome) -> str:
    """One case, for progress."""
    ref = found.references
    head = f"{found.family + '/' + str(found.seed):24}{found.samples:7}"
    if not found.runs:
        return (
            f"{head}  oracle {ref.oracle:.4g}, output error {ref.oe:.4g} (order {ref.oe_order}), "
            f"noise {ref.noise:.4g}"
        )
    first = found.runs[0]
    gains = [r.gain_error for r in found.runs if r.gain_error is not None]
    parts = [
        head,
        f"x oracle {np.median(found.over_oracle()):8.2f}",
        f"measured {np.median(found.as_measured()):6.2f}",
        f"x oe {max(found.over_oe()):6.3f}",
        f"x noise {np.median(found.over_noise()):6.2f}",
    ]
    if len(found.runs) > 1:
        parts.append(f"spread {found.spread:5.2f}")
    if gains:
        parts.append(f"gain {100 * max(gains):4.1f} %")
    parts.append(f"{np.median([r.seconds for r in found.runs]):5.1f} s")
    parts.append(f"(cpu {np.median([r.cpu for r in found.runs]):.1f})")
    parts.append(first.failure or f"{first.kind} {first.orders}")
    return "  ".join(parts)


def table(outcomes: Sequence[Outcome]) -> str:
    """A row for each family and the summary of each half."""
    rows = [
        f"{'family':22}{'half':6}{'cases':>6}{'x oracle':>10}{'measured':>10}{'worst':>8}"
        f"{'x oe':>8}{'x noise':>9}{'networks':>10}{'gain %':>8}{'wall s':>8}"
    ]
    for name in dict.fromkeys(o.family for o in outcomes):
        of = [o for o in outcomes if o.family == name and o.runs]
        if of:
            rows.append(_row(name, of))
    for split, figures in summary([o for o in outcomes if o.runs]).items():
        rows.append(f"\n{split}: {figures['cases']} cases, {figures['runs']} runs")
        for key, words in _WORDS.items():
            value = figures[key]
            rows.append(f"  {words:52}{'' if value is None else f'{value:.4g}'}")
    return "\n".join(rows)


def _row(name: str, of: Sequence[Outcome]) -> str:
    gains = [r.gain_error for o in of for r in o.runs if r.gain_error is not None]
    networks = sum(r.is_network for o in of for r in o.runs)
    runs = sum(len(o.runs) for o in of)
    return (
        f"{name:22}{of[0].split:6}{len(of):6}"
        f"{np.median([x for o in of for x in o.over_oracle()]):10.2f}"
        f"{np.median([x for o in of for x in o.as_measured()]):10.3f}"
        f"{max(x for o in of for x in o.as_measured()):8.2f}"
        f"{max(x for o in of for x in o.over_oe()):8.3f}"
        f"{np.median([x for o in of for x in o.over_noise()]):9.2f}"
        f"{f'{networks}/{runs}':>10}"
        f"{f'{100 * max(gains):.1f}' if gains else '':>8}"
        f"{np.median([r.seconds for o in of for r in o.runs]):8.1f}"
    )
