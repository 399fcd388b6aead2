"""Tuning by simulated closed loops: `tune`."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..control.controller import Controller, SampledController, pid_of
from ..control.loop import Plant, Plants, References, check_fits, each_plant, run
from ..control.position import PositionController
from ..errors import FitError, Interrupted, SettingError
from ..gains import whole
from ..progress import TimeUp, shown_in_notebooks
from ..tables import Table, significant
from .lead import LEADING, LEADS, PART, WEIGHTS, Effort, Lead, Led, with_lead
from .objective import Constraints, Cost, LoadStep
from .opinion import SHARE, SecondOpinion, second_opinion
from .position import PositionTuning, sound_speed_loop, with_position
from .robustness import HAIR, within_default
from .task import (
    LOOK,
    Aggregate,
    Budget,
    Deadline,
    Encoder,
    Progress,
    TuningTask,
    Variable,
    Wanted,
    budget,
    cut_short,
    shifted,
    threads_or_all,
)
from .verdict import Verdict, out_of_reach, verdict_of

Method: TypeAlias = Literal["genetic", "cma-es"]
Loop: TypeAlias = Literal["speed", "position"]
LOOPS = ("speed", "position")

_ENDED_BY = {
    "evaluations": "their number",
    "converged": "convergence",
    "time": "the time budget",
    "interrupted": "Ctrl-C",
}
"""The terminations in words."""
_KEEPS = "a controller that keeps to the constraints"
"""Missing in a search without gains within its limits, in the words of the core."""
_RIVAL = "the second opinion of the rival"


@dataclass(frozen=True, eq=False)
class TuningResult:
    """The tuned controller and a record of its search.

    Attributes
    ----------
    controller : Controller or StateFeedback
        Ready to run.
    start : Controller or StateFeedback
        The start of the search, moved to the given bounds if it lay outside.
    cost, start_cost : float
        Cost of the gains found, without feedforward, and of the start in the output's unit, over
        plants and references; inf if one diverges.
    variables : tuple of Variable
        The searched variables, their bounds and the values found.
    trace : array, shape (evaluations,)
        The cost of the best controller so far after each evaluation, the start's first. Those tried
        on a part of the runs only do not lower it.
    termination : str
        ``evaluations``, ``converged``, ``time`` or ``interrupted``.
    weights : Cost
        The weights, each a number.
    aggregate : str
        ``mean`` or ``worst``, over the plants.
    constraints : Constraints
        The constraints that applied, with the limit of Ms.
    method : str
        ``genetic`` or ``cma-es``.
    lost : tuple of str
        The work that a time budget cut short, in words; empty if it cut nothing.
    verdict : Verdict
        Grade and reasons: gains that destabilise a model, saturate on a calm reference or leave the
        record for most of a run are ``unfit``; those whose Ms is above 2, or on which two kinds of
        model contradict each other, ``poor``; no gains are better than their models.
    opinion : SecondOpinion or None
        The comparison with a rival; None without one, or if no gains suit it.
    lead : Led or None
        What the feedforward is worth, with the PID alone; None if none was asked for.
    position : PositionTuning or None
        The position loop, whose controller is then `controller`; None if none was asked for.
    """

    controller: SampledController
    start: SampledController
    cost: float
    start_cost: float
    variables: tuple[Variable, ...]
    trace: NDArray[np.float64]
    termination: str
    weights: Cost
    aggregate: str
    constraints: Constraints
    method: str
    lost: tuple[str, ...] = ()
    verdict: Verdict = field(default_factory=Verdict)
    opinion: SecondOpinion | None = None
    lead: Led | None = None
    position: PositionTuning | None = None

    @property
    def grade(self) -> str:
        """The worst grade that the models' verdicts give; empty if they have none."""
        return self.verdict.model

    @property
    def warning(self) -> str | None:
        """The reasons of the verdict, with what to do; None if there are none."""
        return self.verdict.warning

    @property
    def cut(self) -> str | None:
        """What a time budget cut short, and the grade of the models; None if it cut nothing."""
        return cut_short(self.lost, self.grade)

    @property
    def pid(self) -> Controller:
        """The controller as a PID; under a position loop that of the speed.

        Raises
        ------
        SettingError
            For a controller of another kind.
        """
        return pid_of(self._speed, "what comes next")

    @property
    def _speed(self) -> SampledController:
        """The controller of the speed."""
        own = self.controller
        return own.speed if isinstance(own, PositionController) else own

    @property
    def evaluations(self) -> int:
        """Controllers tried."""
        return len(self.trace)

    def plot(
        self,
        on: Plant,
        reference: str | ArrayLike | None = None,
        *,
        ax: Any = None,
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Run the tuned controller and the start on a plant, and draw both.

        Parameters
        ----------
        on : Model or VirtualMachine
        reference : str or array, shape (N,), optional
            As for `sewfast.run`; by default a trapezoid that suits the plant.
        ax, file
            As for `Drawing.plot`. One axes shows the output; further axes show error and command.

        Raises
        ------
        SettingError
            As `Drawing.plot` and `sewfast.run`.
        FitError
            If the tuned loop diverges on this plant; a start that does is left out.
        """
        from ..plotting import Trace, loop_drawing

        after = run(self._speed, on, reference)
        traces = [Trace.of(after.columns(), "measured", "tuned")]
        with contextlib.suppress(FitError):
            before = run(self.start, on, reference)
            traces.append(Trace.of(before.columns(), "model", "start"))
        limits = (self.controller.u_min, self.controller.u_max)
        return loop_drawing(traces, after.units["y"], after.units["u"], limits).plot(ax, file)

    def _repr_html_(self) -> str:
        unit = self.controller.y_unit or "y"
        rows = tuple(
            (v.name, significant(v.value, 4), significant(v.low), significant(v.high))
            for v in self.variables
        )
        return Table(
            f"cost {self.cost:.4g} {unit} (start {self.start_cost:.4g}), {self.evaluations} "
            f"controllers tried, ended by {_ENDED_BY.get(self.termination, self.termination)}",
            ("searched", "found", "from", "to"),
            rows,
        ).to_html([f"{name}: {text}" for name, text in self._remarks()])

    def _remarks(self) -> list[tuple[str, str]]:
        forward = ("forward", None if self.lead is None else str(self.lead))
        position = ("position", None if self.position is None else str(self.position))
        pairs = (("in time", self.cut), forward, position, ("verdict", str(self.verdict)))
        return [(name, text) for name, text in pairs if text is not None]

    def __str__(self) -> str:
        unit = self.controller.y_unit or "y"
        lines = [
            f"cost {self.cost:.4g} {unit} (start {self.start_cost:.4g}) after {self.evaluations} "
            f"evaluations, ended by {_ENDED_BY.get(self.termination, self.termination)}",
            "  searched  " + "\n            ".join(str(v) for v in self.variables),
        ]
        if self.constraints != Constraints():
            lines.append(f"  within    {self.constraints}")
        lines += [f"  {name:<9} {text}" for name, text in self._remarks()]
        return "\n".join([*lines, str(self.controller)])


@shown_in_notebooks("tune")
def tune(
    models: Plants,
    references: References = None,
    *,
    u_min: float | None = None,
    u_max: float | None = None,
    counts_per_rev: Encoder = "model",
    filter_samples: int | None = None,
    output_unit: str | None = None,
    start: SampledController | None = None,
    controller: str = Controller.KIND,
    variables: Sequence[Wanted] | None = None,
    cost: Cost | None = None,
    aggregate: Aggregate = "mean",
    constraints: Constraints | None = None,
    variations: Sequence[tuple[float, int]] | None = None,
    loads: Sequence[LoadStep] = (),
    disturbances: Sequence[ArrayLike] | None = None,
    rival: Plants | None = None,
    feedforward: Lead = "preview",
    loop: Loop = "speed",
    method: Method = "genetic",
    evaluations: int = 3000,
    time_budget: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> TuningResult:
    """Search for the controller settings with the lowest cost in simulated loops.

    A candidate runs on every plant in every variation over every reference, with encoder, feedback
    filter and limits in the loop. A run's cost is a weighted sum of terms (`Cost`). Three quarters
    of the candidates follow each reference on one plant only; the others, about the best of these,
    do all of it until nothing improves any more. Costs are within some percent of a search over
    everything, in less than half of its time. A seed gives the same bits at any number of threads.
    The result is never worse than a start that keeps to the constraints.

    Parameters
    ----------
    models : model, machine or sequence of them
        Plants that the controller must suit, with one input, one sample time and the same units;
        every member of an ensemble is one.
    references : str, array of shape (N,), or sequence of them, optional
        Names (`sewfast.signals`) or samples [y]; trapezoid, trapezoids and random by default. A
        name is the signal of the catalogue for a drive in RPM at 1 ms, on any other the same shape
        over the first model's recorded range, at its own pace (`drive_references`). So are the
        defaults wherever the catalogue does not suit the drive.
    u_min, u_max : float, optional
        Limits of the command [u]. By default the range of the input that the first model was
        identified on, with 0: a controller must not demand more than the drive is known to
        withstand.
    counts_per_rev : float, None or "model"
        Encoder in the loop of the models; None for ideal feedback, "model" for that of the counts
        that the first model's output was computed from, if it was.
    filter_samples : int, optional
        Moving average in the feedback. By default 8 ms, at most a tenth of the time constant.
    output_unit : str, optional
        Unit of the output if the model states none: an encoder needs it.
    start : Controller or StateFeedback, optional
        Start of the search; settings that are not searched are kept, and the five settings above
        are ignored. By default Table 1 on the first model's own step response.
    controller : str
        The kind of controller without a start, ``pid`` or ``state_feedback`` (`StateFeedback`); see
        `sewfast.control.files.KINDS`.
    variables : sequence of str or (str, float, float), optional
        Variables of the search, by name or with bounds: ``Kp``, ``Ti``, ``Td``, ``alpha``,
        ``beta``, ``N``, ``Tt``, ``filter_samples``, ``filter_time``, ``observer_time``, ``r_rate``;
        ``Kp[0]``, ``Ti[0]``, ``Td[0]`` and so on of a gain schedule's points, ``schedule`` for all
        of them. By default the gains, alpha, beta, and N if the start has a derivative filter.
    cost : Cost, optional
        Weights of the terms.
    aggregate : "mean" or "worst"
        Aggregate over the plants in their variations; over the references it is the mean.
    constraints : Constraints, optional
        Requirements that come before the cost. Without a limit of Ms, that of every model is at
        most `sewfast.tuning.objective.LARGEST_MS`, 1.8, about the levels of the references; if no
        gains keep to it, the verdict says so. ``Constraints(Ms=math.inf)`` has no limit.
    variations : sequence of (gain, delay), optional
        Output gain and extra input delay in samples, applied to every plant. By default the plant
        unchanged, and with the gains .8 and 1.25 and a delay of a quarter of the moving average, at
        least one sample: dynamics that identification missed must not upset the loop.
    loads : sequence of LoadStep
        Load steps simulated for every candidate, from which recovery and load of `cost` and
        `constraints` are computed. These runs count for nothing else.
    disturbances : sequence of array, shape (N,), optional
        One for each reference: a command added after the limiter, unknown to the controller [u],
        such as a load over the turn that no model contains.
    rival : model, optional
        A model of another kind of the same drive, such as a linear one next to networks: its own
        gains are searched for briefly (a fifth of the evaluations). If either set of gains costs
        more than three times as much on the other's model as that model's own gains,
        `TuningResult.warning` reports it. Then the result is the one of these two and of gains
        tuned on both whose larger cost, relative to the least on the same model, is smallest.
    feedforward : "preview", "causal" or "none"
        The command that the models need for the reference, added to that of a PID
        (`sewfast.Feedforward`): with the reference known ahead, in time only, or not at all. It
        takes the place of alpha and beta if they are searched; the gains stay. The result has it
        only if following the references costs less over all plants, and no more on any of them in
        any variation.
    loop : "speed" or "position"
        With a position loop over the speed loop (`sewfast.PositionController`): its gain, and how
        hard a move may brake, by simulated stops on every model. The speed must be counted.
    method : "genetic" or "cma-es"
        A genetic algorithm with local refinement, or CMA-ES with restarts.
    evaluations : int
        Candidates tried.
    time_budget : float, optional
        Time of the whole call [s], with first gains and second opinion, after which the best so
        far is the result (`termination` is ``time``; `TuningResult.cut` says what was lost). Then
        the same seed no longer gives the same bits. It returns within a tenth of it and half a
        second more.
    seed : int
        Seed of the search.
    threads : int, optional
        All processors by default.
    progress : callable, optional
        Called with (done, total, lowest cost). By default a notebook shows a bar; None shows
        nothing.

    Raises
    ------
    SettingError, DataError
        For plants, references or settings that cannot be used.
    FitError
        If every candidate diverges or breaks a constraint, or all do until the time is up.
    Interrupted
        After Ctrl-C; its `best` is the best controller so far.
    """
    time = Budget(None if time_budget is None else budget(time_budget))
    first = {
        "u_min": u_min,
        "u_max": u_max,
        "counts_per_rev": counts_per_rev,
        "filter_samples": filter_samples,
        "output_unit": output_unit,
        "controller": controller,
    }
    if not isinstance(method, str):
        raise SettingError(f"expected method 'genetic' or 'cma-es', got {method!r}")
    if feedforward not in LEADS:
        raise SettingError(
            name="feedforward", expected=f"one of {', '.join(LEADS)}", received=repr(feedforward)
        )
    if loop not in LOOPS:
        raise SettingError(name="loop", expected=f"one of {', '.join(LOOPS)}", received=repr(loop))
    if isinstance(start, PositionController):
        start = start.speed
    if isinstance(start, Controller):
        # a feedforward is made anew, of these models
        start = replace(start, feedforward=None)
    task = TuningTask.of(
        models,
        references,
        start=start,
        first=first,
        cost=cost,
        aggregate=aggregate,
        constraints=constraints,
        variations=variations,
        loads=loads,
        disturbances=disturbances,
    )
    search = _Search(
        method, whole("evaluations", evaluations), time, whole("seed", seed),
        threads_or_all(threads), progress,
        1.0 - LOOK - SHARE * (rival is not None) - LEADING * (feedforward != "none"),
    )  # fmt: skip
    if loop == "position" and task.start.counts_per_rev is None:
        raise SettingError(
            name="counts_per_rev", expected="an encoder, whose counts are the position",
            received="none", remedy="give that of the drive (--counts-per-rev)",
        )  # fmt: skip
    # check the rival before the search, which may take long
    other = None if rival is None else replace(task, plants=_rivals(rival, task))
    task = task.with_loops(time)
    result = search.within(task, variables)
    known = list(out_of_reach(task)) if references is not None else []
    if other is not None and not time.over(_RIVAL):
        result = _asked(result, task, other.with_loops(time), search, variables)
        if result.opinion is not None and result.opinion.objection is not None:
            known.append(result.opinion.objection)
    result = _led(result, task, feedforward, time, other, search.threads)
    try:
        verdict = verdict_of(task, result.controller, time, limit=task.constraints.Ms, others=known)
    except KeyboardInterrupt:
        raise Interrupted(result.controller) from None
    result = replace(result, lost=tuple(time.lost), verdict=verdict)
    if loop == "speed":
        return result
    try:
        position = with_position(task, sound_speed_loop(task, result))
    except KeyboardInterrupt:
        raise Interrupted(result.controller) from None
    return replace(result, controller=position.controller, position=position)


@dataclass(frozen=True)
class _Search:
    """The settings of a search; `part` is how much of the time that is left it may take."""

    method: str
    evaluations: int
    budget: Budget
    seed: int
    threads: int
    progress: Progress | None
    part: float

    def within(self, task: TuningTask, variables: Sequence[Wanted] | None) -> TuningResult:
        """The search within the default limit of Ms, if the task has none and gains keep to it."""
        refused: FitError | None = None
        for k, tried in enumerate(within_default(task)):
            # one search after the other is shown as one that goes on
            one = replace(self, progress=shifted(self.progress, k * self.evaluations))
            try:
                return one._on(tried, variables, is_strict=tried is task)
            except FitError as error:
                if _KEEPS not in (error.expected or ""):
                    raise
                refused = error
        assert refused is not None
        raise refused

    def _on(
        self, task: TuningTask, variables: Sequence[Wanted] | None, *, is_strict: bool
    ) -> TuningResult:
        deadline = Deadline(self.budget, self.budget.share(self.part), self.progress)
        try:
            found = _core.tune(
                task.core(variables),
                method=self.method,
                evaluations=self.evaluations,
                seed=self.seed,
                threads=self.threads,
                progress=deadline,
            )
        except (FitError, TimeUp):
            if deadline.passed:
                raise self.budget.refusal(deadline.tried) from None
            raise
        result = _result(found, task, self.method)
        if deadline.passed and result.termination == "interrupted":
            left = self.evaluations - result.evaluations
            self.budget.lose(f"{left} of {self.evaluations} controllers")
            violation = found["violation"]
            if not is_strict:
                # gains that only exceed the default limit are kept
                Ms, limit = task.loops.worst(result.controller)[0], task.constraints.Ms
                violation -= max(0.0, HAIR * Ms / (limit or math.inf) - 1.0)
            return _in_time(result, violation)
        if result.termination == "interrupted":
            raise Interrupted(result.controller)
        return result

    def brief(self) -> _Search:
        """The search of a second opinion: shorter, and without progress; Ctrl-C ends it, too."""
        few = max(1, round(SHARE * self.evaluations))
        return replace(self, evaluations=few, progress=None, part=0.5)


def _rivals(rival: Plants, task: TuningTask) -> list[Plant]:
    """The plants of a rival. Raises `SettingError` if one does not suit the controller."""
    plants = each_plant(rival)
    if not plants:
        raise SettingError("expected a model as rival, got none; leave rival out")
    for plant in plants:
        check_fits(task.start, plant)
    return plants


def _asked(
    result: TuningResult,
    task: TuningTask,
    rival: TuningTask,
    search: _Search,
    variables: Sequence[Wanted] | None,
) -> TuningResult:
    """The result with a second opinion, and with the gains that this picks."""
    found: list[TuningResult] = [result]

    def brief(on: TuningTask) -> SampledController:
        try:
            found.append(search.brief().within(on, variables))
        except Interrupted:
            raise Interrupted(result.controller) from None
        except FitError as error:
            if error.name == "time_budget":
                search.budget.lose(_RIVAL)
            raise
        return found[-1].controller

    opinion = second_opinion(result.controller, task, rival, brief)
    if opinion is None:
        return result
    pick = opinion.pick
    taken = found[pick]
    return replace(
        result, controller=taken.controller, variables=taken.variables,
        cost=result.cost if pick == 0 else float(opinion.costs[0, pick]), opinion=opinion,
    )  # fmt: skip


def _led(
    result: TuningResult,
    task: TuningTask,
    lead: Lead,
    time: Budget,
    rival: TuningTask | None,
    threads: int,
) -> TuningResult:
    """The result with a feedforward, if that is better."""
    alone = result.controller
    if lead == "none" or not isinstance(alone, Controller):
        return result
    others = [] if rival is None else [rival]
    names = [v.name for v in result.variables]
    try:
        effort = Effort(Deadline(time, time.share(PART), None), threads)
        controller, led = with_lead(task, alone, lead, names, others, effort)
    except TimeUp:
        time.lose("the feedforward")
        return result
    except KeyboardInterrupt:
        raise Interrupted(alone) from None
    variables = tuple(
        replace(v, value=getattr(controller, v.name)) if v.name in WEIGHTS else v
        for v in result.variables
    )
    return replace(result, controller=controller, variables=variables, lead=led)


def _in_time(result: TuningResult, violation: float) -> TuningResult:
    if violation > 0.0:
        raise FitError(
            name="time_budget", expected=f"time for {_KEEPS}",
            received=f"the best of {result.evaluations}, which exceeds them by {violation:.3g} of "
            "their limits in sum", remedy="give more time, or relax them",
        )  # fmt: skip
    return replace(result, termination="time")


def _result(found: Mapping[str, Any], task: TuningTask, method: str) -> TuningResult:
    rows = zip(found["variables"], found["values"], strict=True)
    variables = tuple(Variable(name, low, high, value) for (name, low, high), value in rows)
    values = {v.name: v.value for v in variables}
    began = {v.name: value for v, value in zip(variables, found["start"], strict=True)}
    notes = "tuned by simulated closed loops" + task.assumed
    return TuningResult(
        controller=task.start.with_values(values, notes),
        start=task.start.with_values(began, task.start.notes) if found["moved"] else task.start,
        cost=found["cost"],
        start_cost=found["start_cost"],
        variables=variables,
        trace=np.asarray(found["trace"]),
        termination=str(found["termination"]),
        weights=Cost(**found["weights"]),
        aggregate=task.aggregate,
        constraints=task.constraints,
        method=method,
    )
