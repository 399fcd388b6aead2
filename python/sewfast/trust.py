"""Doubts about a closed loop: training region, saturation, limit cycle, disagreement."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, TypeAlias

import numpy as np

from .control.controller import SampledController
from .control.defaults import default_references
from .control.loop import (
    ClosedLoopRun,
    Plant,
    Plants,
    References,
    each_plant,
    each_reference,
    outside_region,
    titles,
    trial,
)
from .dataset import FloatArray
from .errors import FitError, SettingError
from .evidence.card import Line, VerdictTable
from .evidence.verdicts import OUTSIDE
from .gains import real
from .models import Model
from .units import revolutions_per_second

# --- Disagreement of an ensemble's members under one controller and reference ---------------------


@dataclass(frozen=True)
class Disagreement:
    """Disagreement of the plants on one reference.

    Attributes
    ----------
    reference, plant : str
        The reference, and the member farthest from the median.
    plants : int
        Number of plants compared.
    rms : float
        Rms distance of that member's output from the median of all, sample by sample [y]; for two
        plants, half of their distance.
    span : float
        Span of the reference [y].
    """

    reference: str
    plant: str
    plants: int
    rms: float
    span: float

    @property
    def share(self) -> float:
        """`rms` over `span`."""
        return self.rms / max(self.span, 1e-300)


def disagreements(runs: Sequence[ClosedLoopRun]) -> tuple[Disagreement, ...]:
    """Compare runs of one controller over the same reference on several plants.

    Parameters
    ----------
    runs : sequence of ClosedLoopRun
        Single runs without another to compare with are ignored.
    """
    groups: dict[tuple[SampledController, str, bytes], list[ClosedLoopRun]] = {}
    for run in runs:
        groups.setdefault((run.controller, run.reference, run.r.tobytes()), []).append(run)
    return tuple(_of(group) for group in groups.values() if len(group) > 1)


def _of(group: list[ClosedLoopRun]) -> Disagreement:
    y = np.array([run.y for run in group])
    middle = np.median(y, axis=0)
    known = np.isfinite(middle)
    rms = np.sqrt(np.mean(np.square(y - middle)[:, known], axis=1)) if known.any() else np.zeros(1)
    worst = int(np.argmax(rms))
    r = group[0].r
    return Disagreement(
        group[0].reference,
        group[worst].plant,
        len(group),
        float(rms[worst]),
        float(r.max() - r.min()) or float(np.abs(r).max()),
    )


# --- `Oscillation`: self-excited oscillation at constant reference --------------------------------


SETTLING = 0.4
"""Share of a constant stretch that counts as settling after the change before it."""
LEAST_PERIODS = 5.0
SHAFT_ORDERS = (1, 2, 3, 4)


@dataclass(frozen=True)
class Oscillation:
    """The oscillation of a loop at constant reference, on the stretch where it is largest.

    Attributes
    ----------
    command, output : float
        Rms about a straight line, without the shaft's orders [u], [y].
    swing : float
        `command` over half the command's range (without limits: over its largest magnitude).
    ripple : float
        `output` over the largest reference.
    level : float
        The constant reference [y].
    hertz : float
        Mean frequency, from swings beyond half of the rms to either side.
    lasts : bool
        At least `LEAST_PERIODS`, and not dying away.
    """

    command: float
    output: float
    swing: float
    ripple: float
    level: float
    hertz: float
    lasts: bool


def oscillation(run: ClosedLoopRun) -> Oscillation | None:
    """The worst oscillation of a run at constant reference; None if no stretch is long enough.

    A limit cycle is a lasting oscillation caused by the loop itself: not the transition to a new
    level, not a decaying oscillation, and not the response to a load over the shaft's turn. So the
    first `SETTLING` of each constant stretch is left out, and a straight line is removed from the
    rest and, if the output is a speed, the shaft's orders `SHAFT_ORDERS`. The effect of the
    encoder's steps and of noise stays in: it is smaller than a limit cycle.

    Parameters
    ----------
    run : ClosedLoopRun
    """
    found = [_oscillation_of(run, part) for part in _constant(run)]
    return max(found, key=lambda o: (o.lasts, o.swing + o.ripple), default=None)


def _constant(run: ClosedLoopRun) -> Iterator[slice]:
    """The stretches of constant reference without missing samples, after settling."""
    known = np.isfinite(run.u) & np.isfinite(run.y)
    still = np.concatenate([[False], np.diff(run.r) == 0.0]) & known
    still[1:] &= known[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    for start, stop in edges.reshape(-1, 2).tolist():
        first = start + math.ceil(SETTLING * (stop - start))
        # least samples of the rest of a stretch
        if stop - first >= 100:
            yield slice(first, stop)


def _oscillation_of(run: ClosedLoopRun, part: slice) -> Oscillation:
    forced = _forced(run, part)
    u, y = (_without(values[part], forced) for values in (run.u, run.y))
    command, output = _rms(u), _rms(y)
    swing = command / max(_half_range(run), 1e-300)
    ripple = output / max(float(np.abs(run.r).max()), 1e-300)
    usual = Limits()
    # by its usual limit: noise in the command hides that an output settles
    main = u if swing * usual.ripple >= ripple * usual.swing else y
    periods = _periods(main)
    half = len(main) // 2
    # least rms of the second half relative to the first for an oscillation that does not decay
    lasts = periods >= LEAST_PERIODS and _rms(main[half:]) >= 0.5 * _rms(main[:half])
    hertz = periods / (len(main) * run.Ts)
    return Oscillation(command, output, swing, ripple, float(run.r[part][0]), hertz, lasts)


def _periods(values: FloatArray) -> float:
    """Periods of an oscillation. Only swings of some size count: noise about zero is none."""
    swings = values[np.abs(values) > 0.5 * _rms(values)]
    return 0.5 * float(np.count_nonzero(np.diff(np.signbit(swings))))


def _forced(run: ClosedLoopRun, part: slice) -> FloatArray:
    """Columns of the regressors to remove: a straight line and the shaft's orders, shape (n, c)."""
    n = part.stop - part.start
    columns = [np.ones(n), np.linspace(-1.0, 1.0, n)]
    per_unit = revolutions_per_second(run.units["y"])
    if per_unit is not None:
        turns = np.cumsum(run.y[part]) * per_unit * run.Ts
        travelled = abs(float(turns[-1] - turns[0]))
        for order in SHAFT_ORDERS:
            # least periods of an order within a stretch: fewer cannot be distinguished from a trend
            if order * travelled >= 3.0:
                angle = 2.0 * np.pi * order * turns
                columns += [np.cos(angle), np.sin(angle)]
    return np.column_stack(columns)


def _without(values: FloatArray, columns: FloatArray) -> FloatArray:
    found: FloatArray = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return found


def _half_range(run: ClosedLoopRun) -> float:
    c = run.controller
    half = 0.5 * (c.u_max - c.u_min)
    return half if math.isfinite(half) else float(np.nanmax(np.abs(run.u)))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --- `Limits` of the judgement --------------------------------------------------------------------


@dataclass(frozen=True)
class Limits:
    """Bounds; exceeding one gives a warning, or a refusal (`disagreement`).

    Parameters
    ----------
    outside : float
        Share of the samples outside the model's training region.
    saturated : float
        Share of the samples with the command at a limit.
    swing : float
        Limit cycle: rms of the command's oscillation at constant reference over half its range.
    ripple : float
        Limit cycle: rms of the output's oscillation at constant reference over the largest
        reference.
    disagreement : float
        Rms distance of a member's output from the median of all members, over the reference's span.

    Raises
    ------
    SettingError
        For a bound that is not a number of 0 or more.
    """

    outside: float = OUTSIDE
    saturated: float = 0.1
    swing: float = 0.15
    ripple: float = 0.02
    disagreement: float = 0.05

    def __post_init__(self) -> None:
        for each in fields(self):
            value = real(each.name, getattr(self, each.name))
            if not 0.0 <= value <= math.inf:
                raise SettingError(f"expected a bound of 0 or more for {each.name}, got {value:g}")
            object.__setattr__(self, each.name, value)


# --- `Judgement`: doubts about a set of closed loops, one line per check --------------------------


FORMAT = "sewfast.judgement"
VERSION = 1


@dataclass(frozen=True, eq=False)
class JudgedRun:
    """One run with its figures.

    Attributes
    ----------
    run : ClosedLoopRun
    outside, farthest : float
        Share of the samples outside the training region, and the largest distance relative to the
        region's radius; NaN without a known region.
    saturated : float
        Share of the samples with the command at a limit.
    oscillation : Oscillation or None
        None if no stretch of constant reference is long enough.
    """

    run: ClosedLoopRun
    outside: float
    farthest: float
    saturated: float
    oscillation: Oscillation | None

    @property
    def name(self) -> str:
        """Reference and plant."""
        return f"{self.run.reference} on {self.run.plant}"

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        o = self.oscillation
        return {
            "reference": self.run.reference,
            "plant": self.run.plant,
            "outside": self.outside if math.isfinite(self.outside) else None,
            "farthest": self.farthest if math.isfinite(self.farthest) else None,
            "saturated": self.saturated,
            "oscillation": o and dict(vars(o)),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Judgement(VerdictTable):
    """Lines with verdicts, and the runs behind them.

    Attributes
    ----------
    lines : tuple of Line
        `training region`, `saturation`, `limit cycle`, `disagreement`.
    runs : tuple of JudgedRun
    disagreements : tuple of Disagreement
        One per reference that several plants ran.
    limits : Limits
    """

    lines: tuple[Line, ...]
    runs: tuple[JudgedRun, ...]
    disagreements: tuple[Disagreement, ...]
    limits: Limits

    heading = "Closed loop"
    style = "judgement"

    @property
    def title(self) -> str:
        """Number of runs, and their references."""
        names = ", ".join(dict.fromkeys(r.run.reference for r in self.runs))
        return f"{len(self.runs)} run{'s' if len(self.runs) > 1 else ''} of {names}"

    @property
    def warnings(self) -> tuple[Line, ...]:
        """The lines whose verdict is `warn` or `fail`."""
        return tuple(x for x in self.lines if x.verdict in ("warn", "fail"))

    def to_json(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "verdict": self.verdict,
            "lines": [line.to_json() for line in self.lines],
            "runs": [run.to_json() for run in self.runs],
            "disagreements": [{**vars(d), "share": d.share} for d in self.disagreements],
            "limits": dict(vars(self.limits)),
        }


# --- The lines of a judgement: verdicts and sentences from the figures and limits -----------------


FAR = 0.2


def region(runs: Sequence[JudgedRun], limits: Limits) -> Line:
    """Does the loop leave the region that the model was trained in?"""
    name, limit = "training region", f"<= {100 * limits.outside:g} %"
    known = [r for r in runs if math.isfinite(r.outside)]
    if not known:
        return Line(
            name, math.nan, "not known", limit, "info",
            "no model with a stored training region was given: give the one that was tuned on",
        )  # fmt: skip
    worst = max(known, key=lambda r: (r.outside, r.farthest))
    shown = f"{100 * worst.outside:.2f} % of samples, {worst.farthest:.3g} radii at most"
    if worst.outside <= limits.outside:
        text = "the loop stays where the model was trained"
        return Line(name, worst.outside, shown, limit, "ok", text)
    far = "the loop runs where the model was not trained: its predictions there are a guess"
    some = "some of the loop runs where the model was not trained"
    text = (
        f"{far if worst.outside > FAR else some} (worst: {worst.name}); record such operation, "
        "best in a closed loop, and identify again, or demand less"
    )
    return Line(name, worst.outside, shown, limit, "warn", text)


def saturation(runs: Sequence[JudgedRun], limits: Limits) -> Line:
    """Is the command at its limits for long?"""
    worst = max(runs, key=lambda r: r.saturated)
    name, limit = "saturation", f"<= {100 * limits.saturated:g} %"
    shown = f"{100 * worst.saturated:.1f} % of the time"
    if worst.saturated <= limits.saturated:
        text = "the command is within its limits most of the time"
        return Line(name, worst.saturated, shown, limit, "ok", text)
    text = (
        f"the command stays at a limit (worst: {worst.name}): there the loop is open, gains "
        "have no effect and a disturbance is not rejected; demand less, or check whether it "
        "oscillates"
    )
    return Line(name, worst.saturated, shown, limit, "warn", text)


def limit_cycle(runs: Sequence[JudgedRun], limits: Limits) -> Line:
    """Does the loop oscillate by itself?"""
    name = "limit cycle"
    limit = f"swing <= {100 * limits.swing:g} %, ripple <= {100 * limits.ripple:g} %"
    seen = [(r, r.oscillation) for r in runs if r.oscillation is not None]
    if not seen:
        text = (
            "no reference is constant for long enough to see whether the loop oscillates by itself"
        )
        return Line(name, math.nan, "not seen", limit, "info", text)
    cycling = [
        (r, o) for r, o in seen if o.lasts and (o.swing > limits.swing or o.ripple > limits.ripple)
    ]
    run, worst = max(cycling or seen, key=lambda pair: pair[1].swing + pair[1].ripple)
    units = run.run.units
    shown = (
        f"{worst.command:.3g} {units['u']}, {worst.output:.3g} {units['y']} rms "
        f"({100 * worst.swing:.3g} %, {100 * worst.ripple:.3g} %)"
    )
    if not cycling:
        return Line(
            name, worst.swing, shown, limit, "ok",
            "at constant reference the loop settles, except for encoder steps and the "
            "load",
        )  # fmt: skip
    text = (
        f"at a constant reference of {worst.level:g} {units['y']} the loop oscillates by itself, "
        f"at about {worst.hertz:.3g} Hz (worst: {run.name}): it tracks in a limit cycle that only "
        "the limits contain; lower the gains, filter the feedback, or take delay out of the loop"
    )
    return Line(name, worst.swing, shown, limit, "warn", text)


def disagreement(found: Sequence[Disagreement], limits: Limits, unit: str) -> Line:
    """Do models of the same plant predict the same?"""
    name, limit = "disagreement", f"<= {100 * limits.disagreement:g} % of the reference's span"
    if not found:
        text = "one plant alone does not show how far its prediction may be off; tune on several"
        return Line(name, math.nan, "not known", limit, "info", text)
    worst = max(found, key=lambda d: d.share)
    shown = f"{worst.rms:.3g} {unit} rms, {100 * worst.share:.3g} %"
    if worst.share <= limits.disagreement:
        text = f"{worst.plants} plants respond alike: the prediction does not depend on one of them"
        return Line(name, worst.share, shown, limit, "ok", text)
    text = (
        f"{worst.plant} deviates from the median of {worst.plants} plants on {worst.reference}: "
        f"the "
        "data do not determine what this loop will do; leave out members that fit badly, or record "
        "a closed loop and identify again"
    )
    return Line(name, worst.share, shown, limit, "fail", text)


# --- judge ----------------------------------------------------------------------------------------


class HasController(Protocol):
    """A result with a controller, as from `tune` or `commission`."""

    @property
    def controller(self) -> SampledController | None: ...


Judgeable: TypeAlias = ClosedLoopRun | Sequence[ClosedLoopRun] | SampledController | HasController

REFERENCES = ("trapezoid", "random")


def judge(
    what: Judgeable,
    on: Plants | None = None,
    references: References = None,
    *,
    limits: Limits | None = None,
    seed: int = 0,
    refuse: bool = True,
) -> Judgement:
    """Compare simulated or measured closed loops with limits.

    - `training region`: the share of samples outside the model's training region. A measured run is
      located by the response of the model to its command.
    - `saturation`: the share of samples with the command at a limit.
    - `limit cycle`: a lasting oscillation caused by the loop itself at constant reference
      (`sewfast.trust.oscillation`).
    - `disagreement`: the distance between plants on the same reference under the same controller.

    Parameters
    ----------
    what : ClosedLoopRun, sequence of them, Controller, TuningResult or Commissioning
        Runs are judged as they are; a controller, or that of a result, is run on every plant of
        `on`.
    on : Model, VirtualMachine or sequence of them, optional
        The plants for a controller, including every member of an ensemble; by default the models of
        a commissioning. With runs: the models whose training region applies.
    references : str, array of shape (N,), or sequence of them, optional
        References for a controller; by default `REFERENCES`, or the same shapes over the first
        plant's recorded range if the catalogue does not suit it.
    limits : Limits, optional
        The bounds.
    seed : int
        Chooses named random references.
    refuse : bool
        Whether to raise if members disagree; otherwise the line `disagreement` fails.

    Returns
    -------
    Judgement

    Raises
    ------
    FitError
        If members of an ensemble disagree by more than the bound, or one diverges.
    SettingError
        For other arguments, a controller without plants, or models with another sample time or
        other units than the runs.
    """
    if not (limits is None or isinstance(limits, Limits)):
        raise SettingError(
            f"expected Limits, got {type(limits).__name__}; for example Limits(saturated=0.02)"
        )
    limits = limits or Limits()
    models = each_plant(getattr(what, "models", None) if on is None else on)
    runs = _runs(what, models, references, seed)
    regions = [m for m in models if isinstance(m, Model)]
    found = tuple(_judged(r, model) for r, model in _with_model(runs, regions))
    apart = disagreements([r for r, _ in runs])
    unit = found[0].run.units["y"]
    lines = (
        region(found, limits),
        saturation(found, limits),
        limit_cycle(found, limits),
        disagreement(apart, limits, unit),
    )
    if refuse and lines[-1].verdict == "fail":
        raise FitError(
            name="plants", expected=f"some that agree in closed loop ({lines[-1].limit})",
            received=f"{lines[-1].shown}: {lines[-1].meaning}",
        )  # fmt: skip
    return Judgement(lines, found, apart, limits)


_Run: TypeAlias = tuple[ClosedLoopRun, "Plant | None"]


def _runs(
    what: Judgeable, plants: list[Plant], references: References, seed: int
) -> list[_Run]:  # fmt: skip
    if isinstance(what, ClosedLoopRun):
        return [(what, None)]
    controller = getattr(what, "controller", what)
    if isinstance(controller, SampledController):
        if not plants:
            raise SettingError(
                "expected plants to run the controller on, got none; give judge(controller, models)"
            )
        if references is None:
            references = default_references(plants[0], controller, REFERENCES)
        return [
            (trial(controller, plant, r, title, seed), plant)
            for r in each_reference(references, ())
            for plant, title in zip(plants, titles(plants), strict=True)
        ]
    if isinstance(what, Sequence) and what and all(isinstance(r, ClosedLoopRun) for r in what):
        return [(r, None) for r in what]
    raise SettingError(
        "expected closed-loop runs, a Controller or a TuningResult to judge, got "
        f"{type(what).__name__}; run(controller, plant, reference) gives a run"
    )


def _with_model(runs: list[_Run], models: list[Model]) -> list[_Run]:
    """Each run with the model whose training region applies, if there is one."""
    given = models[0] if models else None
    return [(r, plant if isinstance(plant, Model) else given) for r, plant in runs]


def _judged(found: ClosedLoopRun, model: Any) -> JudgedRun:
    outside, farthest = outside_region(found, model)
    saturated = found.metrics()["saturated"] or 0.0
    return JudgedRun(found, outside, farthest, saturated, oscillation(found))
