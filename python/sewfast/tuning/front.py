"""`pareto`: the best trade-offs between several objectives."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import _core
from ..control.controller import Controller, pid_of
from ..control.loop import Plants, References
from ..errors import FitError, Interrupted, SettingError
from ..gains import whole
from ..plotting import Drawing, Panel, Plotted, lettered
from ..progress import TimeUp, shown_in_notebooks
from ..storage import write_table
from ..tables import Table, significant
from .lead import WEIGHTS
from .objective import Constraints, Cost, LoadStep
from .search import TuningResult, tune
from .task import (
    LOOK,
    Aggregate,
    Budget,
    Deadline,
    Progress,
    TuningTask,
    Wanted,
    budget,
    cut_short,
    shifted,
    threads_or_all,
)
from .verdict import Verdict, verdict_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TUNED = 0.25
"""Share of the evaluations for the tuned controller from which the front starts."""


@dataclass(frozen=True, eq=False)
class ParetoFront(Plotted):
    """Controllers of which none is better than another in every objective.

    Attributes
    ----------
    controllers : tuple of Controller
        Sorted by the first objective.
    objectives : tuple of str
        The quantities to be minimised.
    units : dict
        The unit of each objective.
    values : array, shape (controllers, objectives)
        In these units, over plants and references.
    pick : int
        The knee: the controller closest to the best of every objective at once, each as a share of
        its range on the front, on a logarithmic scale for ranges wider than 1 to 10.
    evaluations : int
        Controllers tried.
    verdict : Verdict
        As `TuningResult.verdict`, of the knee.
    lost : tuple of str
        As `TuningResult.lost`.
    """

    controllers: tuple[Controller, ...]
    objectives: tuple[str, ...]
    units: dict[str, str]
    values: NDArray[np.float64]
    pick: int
    evaluations: int
    verdict: Verdict = field(default_factory=Verdict)
    lost: tuple[str, ...] = ()

    @property
    def grade(self) -> str:
        """As `TuningResult.grade`."""
        return self.verdict.model

    @property
    def warning(self) -> str | None:
        """As `TuningResult.warning`."""
        return self.verdict.warning

    @property
    def cut(self) -> str | None:
        """As `TuningResult.cut`."""
        return cut_short(self.lost, self.grade)

    def __len__(self) -> int:
        return len(self.controllers)

    def __iter__(self) -> Iterator[Controller]:
        return iter(self.controllers)

    @property
    def picked(self) -> Controller:
        """The controller at the knee."""
        return self.controllers[self.pick]

    def best(self, objective: str) -> Controller:
        """The controller with the lowest value of one objective.

        Raises
        ------
        SettingError
            For a name that is not an objective.
        """
        if objective not in self.objectives:
            raise SettingError(f"expected one of {', '.join(self.objectives)}, got {objective!r}")
        column = self.values[:, self.objectives.index(objective)]
        return self.controllers[int(np.argmin(column))]

    def table(self) -> dict[str, NDArray[np.float64]]:
        """A column per objective and gain, for a file or a plot; `picked` is 1 at the knee."""
        standard = [c.gains.to("standard") for c in self.controllers]
        columns = {name: self.values[:, i] for i, name in enumerate(self.objectives)}
        numbers = {
            "Kp": [g.Kp for g in standard],
            "Ti": [g.Ti for g in standard],
            "Td": [g.Td for g in standard],
            "alpha": [c.alpha for c in self.controllers],
            "beta": [c.beta for c in self.controllers],
            "N": [c.N for c in self.controllers],
        }
        columns |= {name: np.array(column) for name, column in numbers.items()}
        columns["picked"] = (np.arange(len(self)) == self.pick).astype(np.float64)
        return columns

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write `table` as CSV, .npz, .mat or Parquet by the ending, objectives with their units.

        Raises
        ------
        SettingError, DataError
            For an unknown file extension, or a file that cannot be written.
        """
        gains = self.picked.gains
        units = {**self.units, "Kp": f"{gains.u_unit}/{gains.y_unit}", "Ti": "s", "Td": "s"}
        write_table(path, self.table(), units=units)

    def drawing(self) -> Drawing:
        """The front, with a panel for every pair of objectives and the knee marked."""
        return drawing(self)

    def _repr_html_(self) -> str:
        header = [f"{n} [{self.units[n]}]" if self.units[n] else n for n in self.objectives]
        rows = tuple(
            ("the knee" if i == self.pick else "", *map(significant, row))
            for i, row in enumerate(self.values.tolist())
        )
        return Table(f"{len(self)} controllers", ("", *header), rows).to_html()

    def __str__(self) -> str:
        names = [f"{n} [{self.units[n]}]" if self.units[n] else n for n in self.objectives]
        width = max(12, *(len(n) for n in names))
        head = "  " + "".join(f"{n:>{width + 2}}" for n in names)
        rows = [
            f"{'*' if i == self.pick else ' '} " + "".join(f"{v:>{width + 2}.4g}" for v in row)
            for i, row in enumerate(self.values)
        ]
        note = "* the knee: closest to the best of every objective, in shares of its range here"
        remarks = (("in time", self.cut), ("verdict", str(self.verdict)))
        warning = [f"  {name:<9} {text}" for name, text in remarks if text is not None]
        return "\n".join([f"{len(self)} controllers", head, *rows, note, *warning])


@shown_in_notebooks("pareto")
def pareto(
    models: Plants,
    references: References = None,
    *,
    objectives: Sequence[str] = ("tracking", "chatter"),
    start: Controller | None = None,
    variables: Sequence[Wanted] | None = None,
    cost: Cost | None = None,
    aggregate: Aggregate = "mean",
    constraints: Constraints | None = None,
    variations: Sequence[tuple[float, int]] | None = None,
    loads: Sequence[LoadStep] = (),
    size: int = 40,
    evaluations: int = 3000,
    time_budget: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> ParetoFront:
    """Find the best trade-offs between several objectives (NSGA-II, Deb et al. 2002).

    A quarter of the evaluations is spent on tuning one controller for `cost`, the start of the
    population; the rest spreads the population along the front.

    Parameters
    ----------
    models, references, start, variables, aggregate, constraints, variations, loads, seed, threads
        As in `tune`; without a start, that of `tune` with its default limits. If Ms is an
        objective, it has no limit by default. A feedforward of the start is that of every
        controller of the front, and the start's weights of the reference, whose work it does,
        are searched only if they are named.
    objectives : sequence of str
        Two or more of tracking, chatter, effort, overshoot, rise, lag, saturation, recovery, load,
        cost, Ms.
    cost : Cost, optional
        Defines the objective ``cost``, for which the first controller is tuned.
    size : int
        Most controllers on the front.
    evaluations : int
        Candidates tried.
    time_budget : float, optional
        As of `tune`; a quarter of it is for the first controller.
    progress : callable, optional
        Called with (done, total, lowest cost). By default a notebook shows a bar; None shows
        nothing.

    Returns
    -------
    ParetoFront

    Raises
    ------
    SettingError, DataError
        For plants, references or settings that cannot be used.
    FitError
        If no candidate stays bounded within the constraints, or a time budget ends before the
        first population is tried.
    Interrupted
        After Ctrl-C; its `best` is the front so far, or the best controller if there is none.
    """
    time = Budget(None if time_budget is None else budget(time_budget))
    total, names = whole("evaluations", evaluations), _checked(objectives)
    if total < 2:
        raise SettingError(f"expected 2 evaluations or more, got {total}; 3,000 are usual")
    settings: dict[str, Any] = {
        "cost": cost,
        "aggregate": aggregate,
        "constraints": constraints,
        "variations": variations,
        "loads": loads,
    }
    limit = getattr(constraints, "Ms", None)
    if limit is None and "Ms" in names:
        # the front shows what less of it costs
        limit = math.inf
        settings["constraints"] = replace(constraints or Constraints(), Ms=limit)
    first = max(1, int(_TUNED * total))
    tuned = tune(
        models,
        references,
        start=start,
        variables=variables,
        feedforward="none",
        evaluations=first,
        seed=seed,
        threads=threads,
        time_budget=None if time.seconds is None else _TUNED * time.seconds,
        progress=shifted(progress, 0, total),
        **settings,
    )
    settings["constraints"] = tuned.constraints
    begun = tuned.start
    if isinstance(start, Controller) and start.feedforward is not None:
        assert isinstance(begun, Controller)
        begun = replace(begun, alpha=start.alpha, beta=start.beta, feedforward=start.feedforward)
        if variables is None:
            variables = [(v.name, v.low, v.high) for v in tuned.variables if v.name not in WEIGHTS]
    task = TuningTask.of(models, references, start=begun, first={}, **settings)
    task = task.with_loops(time)
    rest = max(1, total - first)
    deadline = Deadline(time, time.share(1.0 - LOOK), shifted(progress, first, total))
    try:
        found = _core.pareto(
            task.core(variables, ms="Ms" in names),
            others=[task.about(tuned.pid).core()],
            objectives=names,
            size=whole("size", size),
            evaluations=rest,
            seed=whole("seed", seed),
            threads=threads_or_all(threads),
            progress=deadline,
        )
    except (FitError, TimeUp):
        if deadline.passed:
            raise _unfinished(time, size) from None
        raise
    if deadline.passed and found["termination"] == "interrupted":
        if not found["controllers"]:
            raise _unfinished(time, size)
        found["termination"] = "time"
    if "time" in (found["termination"], tuned.termination):
        left = total - tuned.evaluations - int(found["evaluations"])
        time.lose(f"{left} of {total} controllers")
    front = _front(found, task, names, tuned)
    verdict = verdict_of(task, front.picked, time, limit=limit)
    return replace(front, lost=tuple(time.lost), verdict=verdict)


def _unfinished(time: Budget, size: int) -> FitError:
    """The error if the time is up before the first population."""
    return FitError(
        name="time_budget", expected=f"time for a first population of {size} controllers",
        received=f"{time.seconds:g} s", remedy="give more time, or a smaller size",
    )  # fmt: skip


def _checked(objectives: Sequence[str]) -> list[str]:
    if isinstance(objectives, str) or not all(isinstance(o, str) for o in objectives):
        raise SettingError(
            f"expected a list of objectives, got {objectives!r}; for example ['tracking', 'effort']"
        )
    twice = [o for i, o in enumerate(objectives) if o in objectives[:i]]
    if twice:
        raise SettingError(f"expected each objective once, got {twice[0]!r} twice")
    return list(objectives)


def _front(found: Any, task: TuningTask, objectives: list[str], tuned: TuningResult) -> ParetoFront:
    interrupted = found["termination"] == "interrupted"
    if interrupted and not found["controllers"]:
        raise Interrupted(tuned.pid)
    start = pid_of(task.start, "pareto")
    names = [name for name, _, _ in found["variables"]]
    notes = "on the front of " + ", ".join(objectives) + task.assumed
    # keep one of several controllers with the same values
    values, rows = np.unique(np.array(found["values"]), axis=0, return_index=True)
    controllers = tuple(
        start.with_values(dict(zip(names, found["controllers"][i], strict=True)), notes)
        for i in rows
    )
    pick = knee(values)
    front = ParetoFront(
        controllers=controllers,
        objectives=tuple(objectives),
        units=_units(objectives, start),
        values=values,
        pick=pick,
        evaluations=tuned.evaluations + int(found["evaluations"]),
    )
    if interrupted:
        raise Interrupted(front)
    return front


def _units(objectives: Sequence[str], controller: Controller) -> dict[str, str]:
    u, y = controller.gains.u_unit, controller.gains.y_unit
    known = {
        "cost": y,
        "tracking": y,
        "chatter": u,
        "effort": u,
        "overshoot": "%",
        "rise": "ms",
        "lag": "ms",
        "recovery": "ms",
        "load": y,
    }
    return {name: known.get(name, "") for name in objectives}


def wide(column: NDArray[np.float64]) -> bool:
    """Whether values are so far apart that ratios matter more than differences."""
    return bool(column.min() > 0.0 and column.max() > 10.0 * column.min())


def knee(values: NDArray[np.float64]) -> int:
    """The row closest to the minimum of all columns at once, over their (wide: log) ranges."""
    columns = [np.log(c) if wide(c) else c for c in values.T]
    shares = [(c - c.min()) / (np.ptp(c) or 1.0) for c in columns]
    return int(np.argmin(np.sum(np.square(shares), axis=0)))


# --- The figure -----------------------------------------------------------------------------------


NAMES = {
    "cost": "cost",
    "tracking": "tracking error, rms",
    "chatter": "change of the command, rms",
    "effort": "command, rms",
    "overshoot": "overshoot",
    "rise": "rise time beyond the reference's",
    "lag": "lag",
    "saturation": "share of samples at a limit",
    "recovery": "recovery from a load",
    "load": "deviation under a load",
    "Ms": "largest sensitivity Ms",
}


def drawing(front: ParetoFront) -> Drawing:
    """A panel for every pair of objectives."""
    pairs = itertools.combinations(range(len(front.objectives)), 2)
    panels: list[Panel | None] = [partial(_panel, front=front, i=i, j=j) for i, j in pairs]
    columns = min(2, len(panels))
    panels += [None] * (-len(panels) % columns)
    rows = tuple(tuple(panels[k : k + columns]) for k in range(0, len(panels), columns))
    # height of a panel [inch]
    return Drawing(rows, (3.6,) * len(rows), (1.0,) * columns, share_x=False, legend=2)


def _panel(axis: Axes, front: ParetoFront, i: int, j: int) -> None:
    x, y = front.values[:, i], front.values[:, j]
    order = np.argsort(x)
    if len(front.objectives) == 2:
        axis.step(x[order], y[order], where="post", color="#bbbbbb", lw=1.0, zorder=1)
    axis.scatter(x, y, s=18, color="#0072B2", label="controllers of the front", zorder=2)
    k = front.pick
    axis.scatter(
        x[k], y[k], s=90, marker="D", facecolor="none", edgecolor="#D55E00", lw=1.8,
        label="the knee", zorder=3,
    )  # fmt: skip
    axis.set_xscale("log" if wide(x) else "linear")
    axis.set_yscale("log" if wide(y) else "linear")
    axis.set_xlabel(_label(front, i))
    axis.set_ylabel(_label(front, j))


def _label(front: ParetoFront, i: int) -> str:
    name = front.objectives[i]
    unit = front.units[name]
    return lettered(NAMES[name] + (f" [{unit}]" if unit else ""))
