"""`Commissioning`: everything that came of one."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..control.controller import Controller
from ..errors import SettingError
from ..evidence import Line, ReportCard
from ..models import Ensemble
from ..plotting import Trace, html_of, loop_drawing
from ..recording import Recording
from ..rules import Fopdt
from ..trust import Judgement
from ..tuning.objective import Cost
from ..tuning.search import TuningResult
from .excitations import Motion
from .slow import Thinning, TurnLoad
from .small_signal import SmallSignal
from .training import Rival
from .verification import Comparison

VERIFIED, VERIFIED_POORLY = "verified", "verified, prediction poor"
VERDICTS = (VERIFIED, VERIFIED_POORLY, "refused", "interrupted")
POOR = 2.0
"""Measured cost over the predicted one from which the prediction is poor."""


@dataclass(frozen=True, eq=False)
class Commissioning:
    """A controller with the evidence for it.

    Attributes
    ----------
    machine : str
    verdict : str
        ``verified``: run on the machine, where it did as predicted; ``verified, prediction poor``:
        it kept to the speeds predicted, at more than twice the cost. ``refused``, ``interrupted``:
        ended at `stage`; what there is until then is here, the rest is None or empty.
    stage, reason : str
        The last stage; why it ended there.
    seconds : mapping of stage to float
    recordings : mapping of name to Recording
        Of the machine, for `identify`.
    motion : Motion or None
    fopdt : Fopdt or None
        From the step response.
    small_signal : SmallSignal or None
        The machine about a working speed, with its resonance where it has one.
    acceleration : float or None
        What the machine has shown at the limit of its command [RPM/s].
    turn_load : TurnLoad or None
        The load over the turn, as a command; None where none was seen.
    first : Controller or None
        The gains by rule, under which the closed loop was recorded.
    models : Ensemble or None
        What was tuned on: networks, or the linear rival alone where these failed.
    rival : Rival or None
        The linear model beside the networks.
    rmse : tuple of float
        Of each member on the recording `levels`, which none was trained on [RPM].
    controller : Controller or None
        The best there is: tuned, or else the first.
    tuning : TuningResult or None
    cost : Cost or None
        What counted how much.
    met : mapping or None
        What the gains do of what was required beside the cost: `Ms` of the members linearised,
        `recovery_ms` of each member under the load step, tuned and with the rule's gains.
    card : ReportCard or None
        How far the best member can be trusted, on the recording `levels`.
    judgement : Judgement or None
        What speaks against the loops as predicted.
    comparisons : tuple of Comparison
        Predicted and measured, per reference.
    sample_time : float or None
        Of what is simulated [s]: for a slow drive a multiple of the machine's.
    notes : tuple of str
        What went otherwise than usual: networks that failed, models that contradict each other,
        gains that were lowered.
    taken_in : Path or None
        The folder in which each recording was written as it came.
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
    sample_time: float | None = None
    notes: tuple[str, ...] = ()
    taken_in: Path | None = None

    @property
    def is_verified(self) -> bool:
        """Whether the machine did as predicted."""
        return self.verdict in (VERIFIED, VERIFIED_POORLY)

    @property
    def is_predicted_poorly(self) -> bool:
        """Whether the machine costs more than twice what was predicted."""
        predicted, measured = self.predicted_cost, self.measured_cost
        return predicted is not None and measured is not None and measured > POOR * predicted

    @property
    def predicted_cost(self) -> float | None:
        """Over the references [RPM]."""
        if self.cost is None or not self.comparisons:
            return None
        thinning = Thinning()
        if self.sample_time is not None and self.controller is not None:
            thinning = Thinning.between(self.sample_time, self.controller.Ts)
        return thinning.cost(self.cost).of([c.predicted for c in self.comparisons])

    @property
    def measured_cost(self) -> float | None:
        """Over the references, on the machine [RPM]."""
        runs = [c.measured for c in self.comparisons if c.measured is not None]
        if self.cost is None or not runs or len(runs) < len(self.comparisons):
            return None
        return self.cost.of(runs)

    def numbers(self) -> dict[str, Any]:
        """Every number as JSON values."""
        from .folder import numbers

        return numbers(self)

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write recordings, models, controllers, runs, `commissioning.json` and `report.html`.

        Parameters
        ----------
        folder : path
            Made where it is not there; see docs/ARCHITECTURE.md for the layout.
        overwrite : bool
            Whether files of these names may be replaced that no commissioning has left.

        Returns
        -------
        Path
            The page, or `commissioning.json` where the report's packages are missing.

        Raises
        ------
        SettingError
            For a folder with files of somebody else's.
        DataError
            Where it cannot be made.
        """
        from .folder import write

        return write(self, Path(folder), overwrite=overwrite)

    def plot(
        self,
        ax: Any = None,
        *,
        reference: str | None = None,
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Draw the loop as predicted beside that of the machine: output, error, command.

        Parameters
        ----------
        ax : Axes or sequence of Axes, optional
            One shows the output, further ones the error and the command.
        reference : str, optional
            One of `comparisons`; by default the first.
        file : path, optional
            Where to write the figure: PNG, SVG or PDF by its ending.

        Returns
        -------
        Axes or array of Axes
            `ax`, or the three panels of a new figure.

        Raises
        ------
        SettingError
            For another reference, or where it ended before any loop was predicted; where matplotlib
            is not installed or the file cannot be written.
        """
        found = {c.reference: c for c in self.comparisons}
        name = next(iter(found), None) if reference is None else reference
        if name not in found:
            raise SettingError(
                f"expected one of the references {', '.join(found) or 'none, as it ended before'}"
                f", got {reference!r}"
            )
        shown = found[name]
        kinds = {"model": ("predicted", shown.predicted), "machine": ("measured", shown.measured)}
        traces = [
            Trace.of(run.columns(), look, label)
            for look, (label, run) in kinds.items()
            if run is not None
        ]
        units = shown.predicted.units
        return loop_drawing(traces, units["y"], units["u"]).plot(ax, file)

    def _repr_html_(self) -> str:
        """A table for a notebook."""
        return html_of(str(self))

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
        lines += [_told(c) for c in self.comparisons]
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
    """Report card, judgement and what was required beside the cost, a line each."""
    lines = []
    if c.card is not None:
        lines.append(f"  report card    {c.card.verdict}{_named(c.card.lines)}")
    if c.met is not None and c.met["Ms"]:
        lines.append(f"  Ms             {max(c.met['Ms']):.3g} at most over the networks")
    if c.met is not None and c.met["load"] is not None:
        tuned, rule = (max(c.met["recovery_ms"][n]) for n in ("tuned", "rule"))
        volt = abs(c.met["load"]["disturbance"])
        lines.append(
            f"  load of {volt:.3g} V   recovery {tuned:.0f} ms at most, by Eq. 12 {rule:.0f} ms"
        )
    if c.judgement is not None:
        lines.append(f"  loops          {c.judgement.verdict}{_named(c.judgement.lines)}")
    return lines


def _named(lines: Sequence[Line]) -> str:
    """The first two questions that were not passed, and how many others."""
    names = [x.name for x in lines if x.verdict in ("warn", "fail")]
    more = f" and {len(names) - 2} more" if len(names) > 2 else ""
    return ": " + ", ".join(names[:2]) + more if names else ""


def _told(c: Comparison) -> str:
    predicted = c.predicted.metrics()["rmse"]
    text = f"  {c.reference:<14} error predicted {predicted:.4g}"
    if c.measured is None:
        return text + " RPM rms"
    return (
        f"{text}, measured {c.measured.metrics()['rmse']:.4g} RPM rms; {c.apart:.3g} RPM rms apart"
    )
