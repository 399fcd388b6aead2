"""`Commissioning`: the result of a commissioning, its numbers, and its folder."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__, storage
from ..analysis.analysis import NUMBERS as ANALYSIS
from ..causes import Cause
from ..control.controller import Controller
from ..control.loop import ClosedLoopRun
from ..errors import DataError, SettingError
from ..evidence import Line, ReportCard
from ..frequency import FrequencyResponse
from ..models import Ensemble
from ..plotting import Trace, loop_drawing
from ..recording import Recording
from ..report.commissioned import FORMAT, NUMBERS, RESPONSE, VERSION, run_file
from ..rules import Fopdt
from ..storage import write_table
from ..tables import Shown
from ..trust import Judgement
from ..tuning.objective import Cost
from ..tuning.position import PositionTuning
from ..tuning.search import TuningResult
from .checkpoint import clear, prepare, require_repeatable
from .excitations import Motion
from .positions import Stop
from .slow import Thinning, TurnLoad
from .small_signal import SmallSignal
from .training import Rival
from .verification import POOR, Comparison

VERIFIED, VERIFIED_POORLY = "verified", "verified, prediction poor"
UNREACHED = "predicted, target not reached"


@dataclass(frozen=True, eq=False)
class Commissioning(Shown):
    """A controller with the evidence for it.

    Attributes
    ----------
    machine : str
    verdict : str
        ``verified``: run on the machine, which behaved as predicted; ``verified, prediction poor``:
        the speeds agree with the prediction, but the cost is more than twice as high; ``predicted,
        target not reached``: as predicted, but off a held level, or longer at a limit. ``refused``,
        ``interrupted``: ended at `stage`; it holds the results until then, the rest is None or
        empty.
    stage, reason : str
        The last stage, and why it ended there.
    seconds : mapping of stage to float
    recordings : mapping of name to Recording
        Recordings of the machine, for `identify`.
    motion : Motion or None
    fopdt : Fopdt or None
        From the step response.
    small_signal : SmallSignal or None
        Linear model about a working speed, including the resonance if there is one.
    acceleration : float or None
        Acceleration measured at the limit of the command [RPM/s].
    turn_load : TurnLoad or None
        The load over the turn, as a command; None if none was seen.
    first : Controller or None
        The gains by rule, under which the closed loop was recorded.
    models : Ensemble or None
        The models used for tuning: networks, or the linear rival alone if these failed.
    rival : Rival or None
        The linear model that competes with the networks.
    rmse : tuple of float
        Error of each member on the recording `levels`, which is not used for training [RPM].
    controller : Controller or None
        The best so far: the tuned one, or else the first.
    tuning : TuningResult or None
    cost : Cost or None
        Weights of the search.
    met : mapping or None
        How the gains meet the requirements besides the cost: `Ms` on the small signals or, without
        these, on the linearised members; `recovery_ms` of each member after the load step, with the
        tuned gains and with the rule's.
    card : ReportCard or None
        Report card of the best member on the recording `levels`.
    judgement : Judgement or None
        Verdicts on the predicted loops.
    comparisons : tuple of Comparison
        Prediction compared with measurement, per reference.
    margins : mapping or None
        For a machine with a resonance: `predicted` by its small signals and `measured` on it, at
        `speed` [RPM]: `Ms`, `phase_margin_deg`, `gain_margin`.
    response : FrequencyResponse or None
        The response that the measured margins were computed from.
    sample_time : float or None
        Sample time of the simulations [s]: for a slow drive a multiple of the machine's.
    notes : tuple of str
        Anything unusual: networks that failed, models that contradict each other, gains that were
        lowered.
    recorded_in : Path or None
        The folder in which each recording was written as it was taken.
    position : PositionTuning or None
        The position loop over the controller's kind of gains, if one was asked for.
    stops : tuple of Stop
        Stops at an angle that verify it: predicted by each model, and measured.
    cause : Cause or None
        What is wrong with the machine, if it was refused or missed its target and a run shows why.
    """

    machine: str
    verdict: str
    stage: str
    reason: str
    seconds: Mapping[str, float]
    recordings: Mapping[str, Recording] = field(default_factory=dict)
    motion: Motion | None = None
    fopdt: Fopdt | None = None
    small_signal: SmallSignal | None = None
    acceleration: float | None = None
    turn_load: TurnLoad | None = None
    first: Controller | None = None
    models: Ensemble | None = None
    rival: Rival | None = None
    rmse: tuple[float, ...] = ()
    controller: Controller | None = None
    tuning: TuningResult | None = None
    cost: Cost | None = None
    met: Mapping[str, Any] | None = None
    card: ReportCard | None = None
    judgement: Judgement | None = None
    comparisons: tuple[Comparison, ...] = ()
    margins: Mapping[str, Any] | None = None
    response: FrequencyResponse | None = None
    sample_time: float | None = None
    notes: tuple[str, ...] = ()
    recorded_in: Path | None = None
    cause: Cause | None = None
    position: PositionTuning | None = None
    stops: tuple[Stop, ...] = ()

    @property
    def is_verified(self) -> bool:
        """Whether the machine behaved as predicted and reached what was asked for."""
        return self.verdict in (VERIFIED, VERIFIED_POORLY)

    @property
    def is_predicted_poorly(self) -> bool:
        """Whether the measured cost is more than twice the predicted one."""
        predicted, measured = self.predicted_cost, self.measured_cost
        return predicted is not None and measured is not None and measured > POOR * predicted

    @property
    def predicted_cost(self) -> float | None:
        """Predicted cost over the references [RPM]."""
        if self.cost is None or not self.comparisons:
            return None
        thinning = Thinning()
        if self.sample_time is not None and self.controller is not None:
            thinning = Thinning.between(self.sample_time, self.controller.Ts)
        return thinning.cost(self.cost).of([c.predicted for c in self.comparisons])

    @property
    def measured_cost(self) -> float | None:
        """Measured cost over the references [RPM]."""
        runs = [c.measured for c in self.comparisons if c.measured is not None]
        if self.cost is None or not runs or len(runs) < len(self.comparisons):
            return None
        return self.cost.of(runs)

    def numbers(self) -> dict[str, Any]:
        """Every number as JSON values."""
        return numbers(self)

    def save(
        self, folder: str | os.PathLike[str], *, overwrite: bool = False, page: bool = True
    ) -> Path:
        """Write recordings, models, controllers, runs, `commissioning.json` and `report.html`.

        Parameters
        ----------
        folder : path
            Created if it does not exist; see docs/CONVENTIONS.md for the layout.
        overwrite : bool
            Whether to replace files of these names that were not written by a commissioning.
        page : bool
            Whether to analyse the loop and write the page, which takes a second or two.

        Returns
        -------
        Path
            The page, or `commissioning.json` without it or the report's packages.

        Raises
        ------
        SettingError
            For a folder with files from another source.
        DataError
            If it cannot be created.
        """
        return write(self, Path(folder), overwrite=overwrite, page=page)

    def plot(
        self,
        ax: Any = None,
        *,
        reference: str | None = None,
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Draw the predicted and the measured loop: output, error, command.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`. One axes shows the output; further axes show error and command.
        reference : str, optional
            One of `comparisons`; by default the first.

        Raises
        ------
        SettingError
            For another reference, if no loop was predicted yet, or as `Drawing.plot`.
        """
        found = {c.reference: c for c in self.comparisons}
        name = next(iter(found), None) if reference is None else reference
        if name not in found:
            raise SettingError(
                name="reference",
                expected=f"one of the references {', '.join(found) or 'none, as it ended before'}",
                received=repr(reference),
            )  # fmt: skip
        shown = found[name]
        kinds = {"model": ("predicted", shown.predicted), "machine": ("measured", shown.measured)}
        traces = [
            Trace.of(run.columns(), look, label)
            for look, (label, run) in kinds.items()
            if run is not None
        ]
        units = shown.predicted.units
        return loop_drawing(traces, units["y"], units["u"]).plot(ax, file)

    def __str__(self) -> str:
        lines = [f"commissioning of {self.machine}: {self.verdict}"]
        if self.reason:
            lines.append(f"  at {self.stage}: {self.reason}")
        if self.fopdt is not None:
            lines.append(f"  step response  {self.fopdt}")
        if self.small_signal is not None and self.small_signal.resonance is not None:
            lines.append(f"  small signals  {self.small_signal.resonance}")
        if self.models is not None:
            worst = f"{min(self.rmse):.3g} to {max(self.rmse):.3g}"
            lines.append(
                f"  models         {len(self.models.members)}, free run on data not trained on "
                f"{worst} RPM rms"
            )
        if self.rival is not None:
            lines.append(
                f"  linear rival   order {self.rival.model.orders['na']}, free run on the same "
                f"{self.rival.rmse:.3g} RPM rms"
            )
        lines += [f"  note           {note}" for note in self.notes]
        lines += _evidence(self)
        lines += [_comparison(c) for c in self.comparisons]
        if self.position is not None:
            lines += [f"  position loop  {self.position}", *map(str, self.stops)]
        if self.measured_cost is not None and self.predicted_cost is not None:
            lines.append(
                f"  cost           predicted {self.predicted_cost:.4g}, measured "
                f"{self.measured_cost:.4g} RPM"
            )
        if self.controller is not None:
            lines.append(str(self.controller))
        lines.append(f"  {sum(self.seconds.values()):.1f} s")
        return "\n".join(lines)


def _evidence(c: Commissioning) -> list[str]:
    """Lines for the report card, the judgement and the requirements besides the cost."""
    lines = []
    if c.card is not None:
        lines.append(f"  report card    {c.card.verdict}{_named(c.card.lines)}")
    if c.met is not None and c.met["Ms"]:
        borne = c.met.get("tolerance")  # a resonance is that of the one model of small signals
        lines.append(f"  Ms             {max(c.met['Ms']):.3g}{f'; {borne[0]}' if borne else ''}")
    if c.met is not None and c.met["load"] is not None:
        tuned, rule = (max(c.met["recovery_ms"][n]) for n in ("tuned", "rule"))
        volt = abs(c.met["load"]["disturbance"])
        lines.append(
            f"  load of {volt:.3g} V   recovery {tuned:.0f} ms at most, by Eq. 12 {rule:.0f} ms"
        )
    if c.margins is not None:
        lines.append(_margins(c.margins))
    if c.judgement is not None:
        lines.append(f"  loops          {c.judgement.verdict}{_named(c.judgement.lines)}")
    return lines


def _margins(found: Mapping[str, Any]) -> str:
    one, other = found["predicted"], found["measured"]

    def db(share: float) -> str:
        return f"{20.0 * math.log10(share):.3g}" if math.isfinite(share) else "inf"

    return (
        f"  margins        at {found['speed']:.4g} RPM predicted / measured: Ms {one['Ms']:.3g} / "
        f"{other['Ms']:.3g}, phase {one['phase_margin_deg']:.3g} / "
        f"{other['phase_margin_deg']:.3g} deg, gain {db(one['gain_margin'])} / "
        f"{db(other['gain_margin'])} dB"
    )


def _named(lines: Sequence[Line]) -> str:
    """The first two checks that were not passed, and the number of the others."""
    names = [x.name for x in lines if x.verdict in ("warn", "fail")]
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return ": " + ", ".join(names[:2]) + more if names else ""


def _comparison(c: Comparison) -> str:
    predicted = c.predicted.metrics()["rmse"]
    text = f"  {c.reference:<14} error predicted {predicted:.4g}"
    if c.measured is None:
        return text + " RPM rms"
    return (
        f"{text}, measured {c.measured.metrics()['rmse']:.4g} RPM rms; {c.apart:.3g} RPM rms apart"
    )


# --- The folder of a commissioning: complete files only, commissioning.json last ------------------


_FOLDERS = ("recordings", "models", "controllers", "runs", "analysis")


def require_own(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder with files that a commissioning of a virtual machine cannot repeat."""
    if not overwrite:
        require_repeatable(folder)
        _require_own_artefacts(folder)


def _require_own_artefacts(folder: Path) -> None:
    if _may_be_replaced(folder):
        return
    place = first_taken(folder, (*_FOLDERS, NUMBERS, "results.json", "report.html"))
    if place is not None:
        raise SettingError(
            name=str(place),
            expected="a folder without such files, or one of a virtual machine's commissioning, "
            "which can be repeated",
            received="another", remedy="choose another folder, or overwrite them (--overwrite)",
        )  # fmt: skip


def first_taken(folder: Path, names: Iterable[str]) -> Path | None:
    """The first of these that is a file, or a folder with something in it."""
    for name in names:
        place = folder / name
        if place.is_file() or (place.is_dir() and any(place.iterdir())):
            return place
    return None


def _may_be_replaced(folder: Path) -> bool:
    found = numbers_in(folder / NUMBERS)
    return found.get("format") == FORMAT and str(found.get("machine", "")).startswith("virtual")


def numbers_in(file: Path) -> dict[str, Any]:
    """The content of a file of results; empty if it is damaged or missing."""
    try:
        found = json.loads(storage.file_bytes(file))
    except (DataError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write(found: Commissioning, folder: Path, *, overwrite: bool, page: bool = True) -> Path:
    """Replace the artefacts of an earlier commissioning; then write the page.
    The report refuses a folder without `commissioning.json`, so an interruption in between leaves
    no mixture that looks complete. The checkpoint's recordings stay there until then.
    """
    if not overwrite:
        _require_own_artefacts(folder)
    prepare(folder)
    for name in (NUMBERS, ANALYSIS, "report.html"):
        (folder / name).unlink(missing_ok=True)
    for name in _FOLDERS:
        place = folder / name
        place.mkdir(exist_ok=True)
        # files of an earlier commissioning must not pass for this one's
        for old in place.iterdir():
            if old.suffix in (".csv", ".json", ".npz", ".svg"):
                old.unlink()
    _artefacts(found, folder)
    if page:
        _analysis(found, folder)
    if found.response is not None:
        found.response.save(folder / RESPONSE)
    storage.write(folder / NUMBERS, FORMAT, VERSION, {"sewfast": __version__, **numbers(found)})
    own = found.recorded_in is not None and found.recorded_in.resolve() == folder.resolve()
    if own and found.is_verified:
        # any other verdict leaves the checkpoint for a resumed attempt
        with suppress(OSError):
            # the tables hold the same: a failure here must not cost the page
            clear(folder)
    return _page(folder) if page else folder / NUMBERS


def _artefacts(found: Commissioning, folder: Path) -> None:
    """Write controllers and models first, a few kB: the tables can fill the disk.
    All tables are tried, even if one does not fit; then the `DataError` of the first that could not
    be written is raised.
    """
    for name, controller in (("tuned", found.controller), ("first", found.first)):
        if controller is not None:
            controller.save(folder / "controllers" / f"{name}.json")
    if found.position is not None:
        found.position.controller.save(folder / "controllers" / "position.json")
    if found.models is not None:
        found.models.save(folder / "models" / "ensemble.json")
    tables: list[Callable[[], object]] = [
        partial(recording.save, folder / "recordings" / f"{name}.csv")
        for name, recording in found.recordings.items()
    ]
    tables += [
        partial(write_table, folder / run_file(c.reference, kind), loop.columns())
        for c in found.comparisons
        for kind, loop in (("predicted", c.predicted), ("measured", c.measured))
        if loop is not None
    ]
    tables += [
        partial(write_table, folder / run_file(f"stop_{stop.name}", "measured"),
                stop.measured.columns())
        for stop in found.stops
        if stop.measured is not None
    ]  # fmt: skip
    failures: list[Exception] = []
    for table in tables:
        try:
            table()
        except (OSError, DataError) as error:
            failures.append(error)
    if failures:
        raise DataError(
            name=str(folder), expected=f"room for {len(tables)} tables",
            received=f"{failures[0]}, and so {len(failures)} are missing",
            remedy="the controllers and models are there: free some space and save again",
        ) from failures[0]  # fmt: skip


def _analysis(found: Commissioning, folder: Path) -> None:
    """The analysis of the loop for the page; optional, as the page is."""
    from ..analysis import analyse

    if found.controller is None or found.models is None:
        return
    runs = [c.predicted for c in found.comparisons]
    # longest reference for the analysis [s]
    references = [r.r for r in runs if r.t[-1] <= 5.0] or [r.r for r in runs[:1]] or None
    coarse = Thinning.between(found.models.members[0].Ts, found.controller.Ts)
    with suppress(SettingError):
        analyse(
            coarse.coarse(found.controller), found.models, references=references
        ).save(folder, png=False)  # fmt: skip


def _page(folder: Path) -> Path:
    from ..report import report

    try:
        return report(folder)
    except SettingError:
        # the page is optional; `sewfast report DIR` writes it once its packages are installed
        return folder / NUMBERS


# --- The numbers as JSON values, for `commissioning.json` -----------------------------------------


_FOPDT = ("K", "T", "L", "offset", "u_low", "u_high", "fit_percent")


def numbers(c: Commissioning) -> dict[str, Any]:
    """The content of `commissioning.json`; null for results that are missing."""
    return {
        "machine": c.machine,
        "verdict": c.verdict,
        "stage": c.stage,
        "reason": c.reason,
        "cause": None if c.cause is None else c.cause.to_json(),
        "seconds": dict(c.seconds),
        "recordings": {name: len(r) * r.Ts for name, r in c.recordings.items()},
        "motion": None if c.motion is None else dict(vars(c.motion)),
        "fopdt": None if c.fopdt is None else {n: getattr(c.fopdt, n) for n in _FOPDT},
        "small_signals": _small_signals(c),
        "acceleration_rpm_per_s": c.acceleration,
        "turn_load_v_rms": None if c.turn_load is None else c.turn_load.rms,
        "models": {
            "members": 0 if c.models is None else len(c.models.members),
            "levels_rmse_rpm": list(c.rmse),
            "kind": None if c.models is None else c.models.members[0].kind,
        },
        "rival": None
        if c.rival is None
        else {"order": c.rival.model.orders["na"], "levels_rmse_rpm": c.rival.rmse},
        "second_opinion": _opinion(c),
        "simulated_at_s": c.sample_time,
        "notes": list(c.notes),
        "controllers": {
            name: _gains(controller)
            for name, controller in (("first", c.first), ("tuned", c.controller))
            if controller is not None
        },
        "tuning": None
        if c.tuning is None
        else {
            "evaluations": c.tuning.evaluations,
            "cost": c.tuning.cost,
            "start_cost": c.tuning.start_cost,
            "termination": c.tuning.termination,
            "lost": list(c.tuning.lost),
            "constraints": str(c.tuning.constraints),
        },
        "cost": None if c.cost is None else dict(vars(c.cost)),
        "met": None if c.met is None else dict(c.met),
        "margins": _finite(c.margins),
        "evidence": {
            name: {"verdict": judged.verdict, "lines": [x.to_json() for x in judged.lines]}
            for name, judged in (("report card", c.card), ("closed loops", c.judgement))
            if judged is not None
        },
        "predicted_cost": c.predicted_cost,
        "measured_cost": c.measured_cost,
        "references": {x.reference: _comparison_numbers(x) for x in c.comparisons},
        "position": None
        if c.position is None
        else {**c.position.to_json(), "stops": [stop.to_json() for stop in c.stops]},
    }


def _finite(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The values with null for an infinite margin, which JSON lacks."""
    if found is None:
        return None

    def one(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {name: one(x) for name, x in value.items()}
        if isinstance(value, list):
            return [one(x) for x in value]
        return value if math.isfinite(value) else None

    return {name: one(value) for name, value in found.items()}


def _small_signals(c: Commissioning) -> dict[str, Any] | None:
    """Order, first-order description and resonance of the machine about a working speed."""
    found = c.small_signal
    if found is None:
        return None
    fopdt, resonance = found.fopdt, found.resonance
    return {
        "order": found.model.orders["na"],
        "fopdt": None if fopdt is None else {n: getattr(fopdt, n) for n in ("K", "T", "L")},
        "resonance": None if resonance is None else dict(vars(resonance)),
    }


def _opinion(c: Commissioning) -> dict[str, Any] | None:
    """Costs of the gains tuned on models, rival and both, on either; null if a loop diverges."""
    opinion = None if c.tuning is None else c.tuning.opinion
    if opinion is None:
        return None
    on_models, on_rival = ([x if np.isfinite(x) else None for x in row] for row in opinion.costs)
    return {"on_models": on_models, "on_rival": on_rival, "taken": opinion.pick}


def _gains(controller: Controller) -> dict[str, Any]:
    """The controller as in its file, with gains in standard form."""
    return {**controller.to_dict(), "gains": controller.gains.to("standard").to_dict()}


def _comparison_numbers(c: Comparison) -> dict[str, Any]:
    return {
        "predicted": run_numbers(c.predicted),
        "measured": None if c.measured is None else run_numbers(c.measured),
        "apart_rmse_rpm": c.apart,
        "disagreement_rmse_rpm": c.disagreement,
    }


def run_numbers(found: ClosedLoopRun) -> dict[str, float | None]:
    """The metrics of a run by their names in result files."""
    metrics = found.metrics()
    return {
        "rmse_rpm": metrics["rmse"],
        "max_abs_rpm": metrics["max_abs"],
        "rise_time_ms": metrics["rise_time_ms"],
        "overshoot_percent": metrics["overshoot_percent"],
        "effort_v": metrics["u_rms"],
        "chatter_v": metrics["du_rms"],
        "saturated": metrics["saturated"],
    }
