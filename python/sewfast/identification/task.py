"""`Clock` and `Pool`: time budget and threads. `Task`: one identification and its provenance."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias, TypeVar

from ..dataset import Dataset, FloatArray
from ..errors import FitError, Interrupted
from ..models import Model
from ..models.base import Fitted
from ..progress import TimeUp, latest
from ..threads import Workers
from ..validation import validate

# --- Clock and threads ----------------------------------------------------------------------------

Progress: TypeAlias = Callable[[int, int, float], object]
Look: TypeAlias = Callable[[int, int, float], None]
"""Progress callback of a compiled fit; it raises KeyboardInterrupt to end the fit."""

T = TypeVar("T")
R = TypeVar("R")

PERIOD = 0.02
"""Interval at which the calling thread checks for Ctrl-C and shows progress [s]."""
CLOSING = 0.3
"""Processor time that is kept for verdict and evidence [s]; the evidence takes .25 s or more."""


HIDDEN = 4
"""Hidden units of the first networks that are tried, alone or beside a motor."""


@dataclass(frozen=True)
class Shares:
    """Parts of a time budget by which work must be finished. A fit that cannot be finished is worth
    nothing, so that each of them leaves time for what follows: `linear` is for linear models but
    the smallest, `joint` for the equations of a joint and `choice` for one among structures.
    `search`, `networks` trained to the end and `refit` to everything follow each other, each before
    the `guard` of its own; a kind by name has its `fit`. The rest is for verdict and evidence.
    """

    linear: float = 0.12
    joint: float = 0.3
    choice: float = 0.4
    search: float = 0.7
    networks: float = 0.87
    fit: float = 0.9
    refit: float = 0.94
    guard: float = 0.95


SHARES = Shares()


class Clock:
    """Time since it was created or began anew, and a budget [s]; without one it never runs out.
    `lost` lists the work that the budget cut short, in words: the result then depends on the
    machine.
    """

    def __init__(self, budget: float | None) -> None:
        self.budget = budget
        self.lost: list[str] = []
        self._processor = self._waited = 0.0
        self.begin()

    def begin(self) -> None:
        """Count from now on."""
        self._began = time.perf_counter()

    def lose(self, what: str) -> None:
        """Note that the budget cut this work short."""
        if what not in self.lost:
            self.lost.append(what)

    @property
    def truncated(self) -> bool:
        """Whether the budget has cut anything short."""
        return bool(self.lost)

    def worked(self, processor: float, waited: float) -> None:
        """Count processor time that took so long to come [s]."""
        self._processor += processor
        self._waited += waited

    @property
    def pace(self) -> float:
        """Seconds of one processor in a second, at most 1; less beside other work."""
        if not self._processor > 0.0 < self._waited:
            return 1.0
        return min(1.0, self._processor / self._waited)

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return time.perf_counter() - self._began

    @property
    def for_fits(self) -> float:
        """The part of the budget for fits [s], at least half: verdict and evidence follow
        (`latest`).
        """
        if self.budget is None:
            return math.inf
        ends = latest(self.budget) - CLOSING / self.pace
        return min(max(ends, 0.5 * self.budget), self.budget)

    def left(self, end: float) -> float:
        """Processor time until then without that of verdict and evidence [s]."""
        return (end - self.spent) * self.pace - CLOSING

    @property
    def can_close(self) -> bool:
        """Whether there is still time for evidence."""
        return self.budget is None or self.left(latest(self.budget)) >= 0.0

    def until(self, share: float) -> float | None:
        """Time at which this share of the budget is used up (`time.perf_counter`); None without."""
        return None if self.budget is None else self._began + share * self.for_fits

    def within(self, share: float, most: float) -> float | None:
        """When this share of the budget, `most` of it at most, has passed; None without one."""
        until = self.until(most)
        return until and min(until, time.perf_counter() + share * self.for_fits)

    def over(self, share: float, what: str) -> bool:
        """Whether this share of the budget is used up; if so, `what` is lost."""
        is_over = self.budget is not None and self.spent >= share * self.for_fits
        if is_over:
            self.lose(what)
        return is_over

    def limited(self, progress: Progress | None, share: float, what: str) -> Progress | None:
        """`progress` that ends a fit, as Ctrl-C would, after this share of the budget; `what` is
        lost.
        """
        if self.budget is None:
            return progress
        last = (time.process_time(), time.perf_counter())

        def look(done: int, total: int, best: float) -> None:
            nonlocal last
            if progress is not None:
                progress(done, total, best)
            (processor, clock), last = last, (time.process_time(), time.perf_counter())
            self.worked(last[0] - processor, last[1] - clock)
            if self.spent >= share * self.for_fits:
                self.lose(what)
                raise TimeUp

        return look


class Stopped(Exception):
    """Ctrl-C during the work; the search holds the results so far."""


class Pool:
    """Runs compiled work on threads while the caller listens, at most every `PERIOD`."""

    def __init__(self, threads: int, clock: Clock, progress: Progress | None) -> None:
        self.threads = threads
        self.clock = clock
        self.progress = progress
        self.share = 0.0
        self.best = float("inf")

    def map(
        self,
        work: Callable[[T, Look], R | None],
        items: Sequence[T],
        *,
        until: float | None = None,
        share: float | None = None,
        what: str = "",
    ) -> list[R | None]:
        """`work(item, look)` of every item, in the order of the items.
        `work` passes `look` to the compiled function, which then ends at a deadline or on Ctrl-C
        with its best result so far. Items not begun by the deadline `until`, on
        `time.perf_counter`, give None, and `what` is lost. `share` is the part of the whole
        identification that is done after the items, for the progress. Raises `Stopped` on Ctrl-C.
        """
        stopping = threading.Event()
        began, ended = self.share, self.share if share is None else share

        def look(*_: object) -> None:
            if stopping.is_set() or (until is not None and time.perf_counter() >= until):
                raise TimeUp

        def one(item: T) -> R | None:
            try:
                look()
                return work(item, look)
            except KeyboardInterrupt:
                return None

        start, processor = time.perf_counter(), time.process_time()
        with ThreadPoolExecutor(min(self.threads, max(len(items), 1))) as threads:
            futures = [threads.submit(one, item) for item in items]
            try:
                self._listen(futures, began, ended)
            except KeyboardInterrupt:
                stopping.set()
                raise Stopped from None
            except BaseException:
                stopping.set()
                raise
        now = time.perf_counter()
        self.clock.worked(time.process_time() - processor, now - start)
        if items and until is not None and now >= until:
            self.clock.lose(what)
        self.share = ended
        return [f.result() for f in futures]

    def _listen(self, futures: Sequence[Future[Any]], began: float, ended: float) -> None:
        pending = set(futures)
        while pending:
            # a signal also interrupts wait()
            _, pending = wait(pending, timeout=PERIOD)
            part = 1.0 - len(pending) / len(futures)
            self.show(began + part * (ended - began))

    def show(self, share: float) -> None:
        """Call the progress function, if any, with the larger share of work or time done."""
        # total of the progress count
        steps = 1000
        if self.progress is None:
            return
        clock = self.clock
        if clock.budget is not None:
            share = max(share, clock.spent / clock.budget)
        self.progress(min(steps, round(steps * share)), steps, self.best)


# --- One identification ---------------------------------------------------------------------------


Provenance: TypeAlias = dict[str, Any]
Pairs: TypeAlias = list[tuple[FloatArray, ...]]


@dataclass(frozen=True)
class Task:
    """One identification: training data, validation data, and settings (None: by the kind)."""

    data: Dataset
    validation: Dataset | None = None
    na: int = 2
    nb: int = 2
    nk: int | None = None
    nx: int | None = None
    hidden: int | None = None
    output: str | None = None
    starts: int | None = None
    seed: int = 0
    iterations: int | None = None
    threads: int = 1
    progress: Progress | None = None
    workers: Workers | None = None
    select: bool = True
    is_order_given: bool = False
    clock: Clock = field(default_factory=lambda: Clock(None))
    began: float = field(default_factory=time.perf_counter)

    @property
    def orders(self) -> dict[str, int]:
        """Orders of a lagged model."""
        return {"na": self.na, "nb": self.nb, "nk": 1 if self.nk is None else self.nk}

    def fit_options(self, **orders: int) -> dict[str, Any]:
        """Settings of a linear fit, in the task's orders unless others are given."""
        options: dict[str, Any] = {**self.orders, **orders}
        return options | {"max_iterations": self.iterations_or_usual, "progress": self.progress}

    @property
    def iterations_or_usual(self) -> int:
        """Most iterations of a fit, 100 by default."""
        return 100 if self.iterations is None else self.iterations

    @property
    def hidden_or_usual(self) -> int:
        """Hidden units of a lagged network."""
        return 8 if self.hidden is None else self.hidden

    def model(self, cls: type[Model], core: Any, extra: Provenance) -> Model:
        """A model of these data, with the provenance that every kind records, and `extra`."""
        return self.documented(wrap(cls, core, self.data), extra)

    def documented(self, model: Model, extra: Provenance) -> Model:
        """The model with the provenance that every kind records, and `extra`."""
        data = self.data
        common = {
            "data": sources(data),
            "samples": len(data),
            "unmeasured": sum(e.unmeasured for e in data.experiments),
            "preparation": list(data.notes),
            "input_range": [list(r) for r in data.input_range],
            "output_range": list(data.output_range),
            "settings": {"max_iterations": self.iterations_or_usual},
            "seconds": time.perf_counter() - self.began,
        }
        return with_provenance(model, common | extra)


def arrays(data: Dataset) -> Pairs:
    """Inputs and output of each experiment, and its weights if it has any."""
    return [(e.u, e.y) if e.weights is None else (e.u, e.y, e.weights) for e in data.experiments]


def sources(data: Dataset) -> list[Provenance]:
    """Origin of the samples, as JSON values."""
    return [{"name": e.name, "range": e.range_text, "samples": len(e)} for e in data.experiments]


def wrap(cls: type[Model], core: Any, data: Dataset) -> Model:
    """A model in the data's names and units, without its provenance."""
    d = data
    return cls(core, d.Ts, d.input_names, d.output_name, d.input_units, d.output_unit, d.counts)


def with_provenance(model: Model, extra: Provenance) -> Model:
    """The model with additional provenance."""
    return replace(model, training={**model.training, **extra})


def completed(model: Model) -> Model:
    """The model; raised as the best one so far if Ctrl-C or a deadline ended its fit."""
    if model.training["termination"] == "interrupted":
        raise Interrupted(model)
    return model


def fit_provenance(fit: Fitted) -> Provenance:
    """Provenance of a fit: cost, iterations and termination."""
    return {
        "cost": fit.cost,
        "cost_horizon": "free run",
        "iterations": fit.iterations,
        "termination": fit.termination,
        "trace": fit.trace.tolist(),
    }


def free_run_rmse(model: Model, data: Dataset) -> float:
    """Pooled rms error of the free run; infinite if it diverges."""
    try:
        return validate(model, data).simulation.rmse
    except FitError:
        return math.inf


def finite(value: float) -> float | None:
    """None for infinity and NaN, which JSON cannot hold."""
    return value if math.isfinite(value) else None
