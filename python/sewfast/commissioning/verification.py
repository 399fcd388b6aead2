"""Verification: the tuned controller on the machine, on members that agree beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun, run
from ..control.machine import Machine
from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble, Model
from ..trust import Judgement, judge
from .demands import Refusal, require
from .slow import Thinning

DISAGREE = 0.05
"""Largest distance of a member from the median of all, rms over the reference's span."""


class Disagreement(Refusal):
    """Networks that do not agree on what a controller does."""


def agreeing(
    controller: Controller, ensemble: Ensemble, references: Mapping[str, FloatArray]
) -> Ensemble:
    """The ensemble without members that part from the others, in a false rest for instance.

    Raises
    ------
    Disagreement
        Where less than half of the members agree.
    """
    members = list(ensemble.members)
    apart = np.zeros(len(members))
    for r in references.values():
        runs = np.array([_output(controller, m, r) for m in members])
        known = np.isfinite(runs).all(axis=1)
        median = np.median(runs[known], axis=0) if known.any() else np.zeros(len(r))
        distances = np.sqrt(np.mean((runs - median) ** 2, axis=1)) / np.ptp(r)
        apart = np.maximum(apart, np.where(known, distances, np.inf))
    kept = [m for m, share in zip(members, apart, strict=True) if share <= DISAGREE]
    if 2 * len(kept) < len(members):
        raise Disagreement(
            f"expected at least half of {len(members)} networks within {100 * DISAGREE:g} % of the "
            f"span from their median in closed loop, {len(kept)} are; record longer, or raise "
            "members"
        )
    return ensemble if len(kept) == len(members) else Ensemble.of(kept)


def _output(controller: Controller, member: Model, r: FloatArray) -> FloatArray:
    """Not finite where the member runs away."""
    try:
        return run(controller, member, r).y
    except FitError:
        return np.full(len(r), np.inf)


# --- Verification: the tuned controller on the machine, its prediction beside it ------------------


APART = 0.05
"""Largest distance of measurement from prediction, rms over the reference's span."""
SATURATED = 0.5
"""Largest share of samples at a limit."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """One reference: predicted and measured.

    Attributes
    ----------
    reference : str
    predicted : ClosedLoopRun
        The median of the members' runs, for a slow drive at every k-th sample.
    measured : ClosedLoopRun or None
        On the machine; None where it was not run.
    members : tuple of ClosedLoopRun
    """

    reference: str
    predicted: ClosedLoopRun
    measured: ClosedLoopRun | None
    members: tuple[ClosedLoopRun, ...]

    @property
    def span(self) -> float:
        """Of the reference [RPM]."""
        return float(np.ptp(self.predicted.r))

    @property
    def apart(self) -> float | None:
        """Rms distance of the measured output from the predicted one [RPM]."""
        if self.measured is None:
            return None
        assert self.alike is not None
        return _rms(self.alike.y - self.predicted.y)

    @property
    def alike(self) -> ClosedLoopRun | None:
        """`measured` at the samples of `predicted`."""
        if self.measured is None:
            return None
        return Thinning.between(self.predicted.Ts, self.measured.Ts).run(self.measured)

    @property
    def disagreement(self) -> float:
        """Rms distance of the member farthest from the median [RPM]."""
        return max(_rms(m.y - self.predicted.y) for m in self.members)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def predict(
    controller: Controller,
    ensemble: Ensemble,
    references: Mapping[str, FloatArray],
    pushes: Sequence[FloatArray] | None = None,
) -> tuple[Comparison, ...]:
    """What the ensemble says of every reference, with a command behind the limits for each: that
    of the load over the turn.

    Raises
    ------
    Refusal
        Where members disagree, or run away.
    """
    found = []
    for i, (name, r) in enumerate(references.items()):
        push = None if pushes is None else pushes[i]
        try:
            runs = tuple(
                run(controller, m, r, name=name, disturbance=push) for m in ensemble.members
            )
        except FitError as error:
            raise Refusal(
                f"expected predictions of {name!r}, a member ran away: {error}"
            ) from error
        median = replace(
            runs[0],
            y=np.median([m.y for m in runs], axis=0),
            u=np.median([m.u for m in runs], axis=0),
            feedback=np.median([m.feedback for m in runs], axis=0),
            plant="ensemble",
        )
        comparison = Comparison(name, median, None, runs)
        require(
            comparison.disagreement <= DISAGREE * comparison.span,
            f"expected members that agree on {name!r} within {100 * DISAGREE:g} % of its span, one "
            f"is {comparison.disagreement:.3g} RPM rms from the median; record longer, so that "
            "they know this reference's world, or demand less of it",
        )
        found.append(comparison)
    return tuple(found)


def measure(
    controller: Controller,
    bench: Machine,
    predicted: tuple[Comparison, ...],
    references: Mapping[str, FloatArray],
    keep: Callable[[tuple[Comparison, ...]], object],
) -> tuple[Comparison, ...]:
    """The same on the machine: the shortest reference first, each judged as it ends.

    Raises
    ------
    Refusal
        As `require_alike`, before the next reference is run.
    """
    found = dict(enumerate(predicted))
    for i in sorted(found, key=lambda i: len(found[i].predicted.r)):
        name = found[i].reference
        run = bench.follow(controller, references[name], name)
        found[i] = replace(found[i], measured=run)
        keep(tuple(found[k] for k in range(len(predicted))))
        require_alike(found[i])
    return tuple(found[k] for k in range(len(predicted)))


def judged(predicted: tuple[Comparison, ...], ensemble: Ensemble) -> Judgement:
    """What speaks against the loops: of the first member on every reference, of all members on the
    shortest. That all agree on all of them has been required.
    """
    shortest = min(predicted, key=lambda c: len(c.predicted.r))
    runs = [m for c in predicted for m in (c.members if c is shortest else c.members[:1])]
    return judge(runs, ensemble, refuse=False)


def require_alike(c: Comparison) -> None:
    """Refuse a prediction that the machine has not borne out.

    Raises
    ------
    Refusal
    """
    assert c.measured is not None
    assert c.apart is not None
    require_unsaturated(c.measured)
    require(
        c.apart <= APART * c.span,
        f"expected the machine within {100 * APART:g} % of the span from the prediction on "
        f"{c.reference!r}, it was {c.apart:.3g} RPM rms apart; the controller is not verified: "
        "see both in the report; the machine may have changed since it was recorded, or the "
        "reference goes where it was not",
    )


def require_unsaturated(found: ClosedLoopRun) -> None:
    """Refuse a loop that leans on the limit of its command.

    Raises
    ------
    Refusal
    """
    saturated = found.metrics()["saturated"] or 0.0
    require(
        saturated <= SATURATED,
        f"expected the command within its limits most of the time on {found.reference!r}, it was "
        f"at one for {100 * saturated:.0f} % of the samples; raise u_max, or lower speed",
    )
