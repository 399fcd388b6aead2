"""Verification: predictions of the tuned loop by members that agree, and the machine itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..causes import Cause
from ..control.controller import Controller, SampledController
from ..control.loop import ClosedLoopRun, held_levels, missed_levels, run
from ..control.machine import WATCHED
from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble, Model
from ..trust import Judgement, judge
from ..tuning.objective import Cost
from .bench import Aborted, RecordedBench
from .demands import Refusal, require
from .excitations import more_command
from .gains import EXPECTED, Swing, frequency_of, unsettled
from .slow import Thinning

DISAGREE = 0.05
"""Largest distance of a member from the median of all, rms over the reference's span."""


class Disagreement(Refusal):
    """The networks do not agree on a closed loop."""


def span(reference: FloatArray) -> float:
    """Range of a reference, including the standstill before it, in its unit."""
    return float(max(reference.max(), 0.0) - min(reference.min(), 0.0))


def agreeing(
    controller: Controller, ensemble: Ensemble, references: Mapping[str, FloatArray]
) -> Ensemble:
    """The ensemble without members that deviate; `Disagreement` if fewer than half agree."""
    members = list(ensemble.members)
    apart = np.zeros(len(members))
    for r in references.values():
        runs = np.array([_output(controller, m, r) for m in members])
        known = np.isfinite(runs).all(axis=1)
        median = np.median(runs[known], axis=0) if known.any() else np.zeros(len(r))
        distances = np.sqrt(np.mean((runs - median) ** 2, axis=1)) / span(r)
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
    """The output of a loop; infinite if the member diverges."""
    try:
        return run(controller, member, r).y
    except FitError:
        return np.full(len(r), np.inf)


# --- Prediction and measurement -------------------------------------------------------------------


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
        The run of the machine; None before it has run.
    members : tuple of ClosedLoopRun
    """

    reference: str
    predicted: ClosedLoopRun
    measured: ClosedLoopRun | None
    members: tuple[ClosedLoopRun, ...]

    @property
    def span(self) -> float:
        """Range of the reference, including standstill [RPM]; errors are judged relative to it."""
        return span(self.predicted.r)

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
    """The ensemble's predictions for every reference.
    `pushes` are commands added after the limiter, one for each reference: the load over the turn.
    Raises `Refusal` if members disagree or diverge.
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
            "the recording covers this reference's range, or demand less of it",
        )
        found.append(comparison)
    return tuple(found)


def measure(
    controller: Controller,
    machine: RecordedBench,
    predicted: tuple[Comparison, ...],
    references: Mapping[str, FloatArray],
    keep: Callable[[tuple[Comparison, ...]], object],
    cost: Cost,
) -> Swing | None:
    """Run the references on the machine, the shortest first, and compare each as it ends. If the
    machine allows it, a run is also watched on the way. A loop that is `restless` ends it. Raises
    `Refusal` as `require_alike`, before the next reference runs, and if `Watching` ends a run.
    """
    found = dict(enumerate(predicted))
    for i in sorted(found, key=lambda i: len(found[i].predicted.r)):
        name = found[i].reference
        watch = Watching(found[i].predicted, controller, machine.counts_per_rev, machine.volt)
        run = machine.follow(controller, references[name], name, watch=watch).run
        found[i] = replace(found[i], measured=run)
        keep(tuple(found[k] for k in range(len(predicted))))
        require_alike(found[i], machine.volt)
        swing = restless(found[i], cost)
        if swing is not None:
            return swing
    return None


POOR = 2.0
"""Multiple of the predicted cost above which a prediction is poor."""


def restless(c: Comparison, cost: Cost) -> Swing | None:
    """The swing of a command at a level that is held, of which no member knows anything.
    Play and friction do so at amplitudes that look quiet beside the limits: it is one if the
    command swings twice as far as under any member, in a run that costs twice as much.
    """
    run = c.alike
    assert run is not None
    if cost.of(run) <= POOR * max(cost.of(m) for m in c.members):
        return None
    for _, hold in held_levels(c.predicted.r):
        rest = unsettled(run.u[hold])
        if rest.std() > EXPECTED * max(unsettled(m.u[hold]).std() for m in c.members):
            return Swing(1.0, frequency_of(rest, run.Ts), float(rest.std()), 0.0)
    return None


WINDOW = 0.25
"""Window of the command's chatter [s]."""
TIMES, FLOOR = 4.0, 0.05
"""Chatter that ends a run: a multiple of the largest predicted one, but at least this share of the
largest command, rms from sample to sample."""


class Watching:
    """Ends a run that is going wrong, instead of judging it afterwards.
    It ends a run if the command chatters `TIMES` as much as predicted, as in an oscillating loop,
    or if the machine is so far from the prediction, or has been at a limit for so long, that the
    run will be refused in any case. `predicted` has the machine's samples, or for a slow drive
    every k-th of them; `controller` is the machine's, `volt` the largest command that it bears.
    """

    def __init__(
        self,
        predicted: ClosedLoopRun,
        controller: Controller,
        counts_per_rev: float,
        volt: float = math.inf,
    ) -> None:
        self._predicted, self._controller, self._Ts = predicted, controller, controller.Ts
        self._k = max(1, round(predicted.Ts / controller.Ts))
        self._per_turn, self._volt = counts_per_rev, volt
        n = self._k * len(predicted.r)
        self._u, self._counts = np.full(n, np.nan), np.full(n, np.nan)
        self._judged, self._squares, self._railed = 0, 0.0, 0
        # multiple of the allowed distance at which a run is hopeless, whatever its rest
        self._allowed = n * (1.1 * APART * span(predicted.r)) ** 2
        self._window = max(10, round(WINDOW / self._Ts))
        self._most = max(
            TIMES * self._chatter_predicted(), FLOOR * max(abs(controller.u_min), controller.u_max)
        )

    def __call__(self, first: int, u: FloatArray, counts: FloatArray) -> None:
        """Check samples `first`, `first + 1`, ... Raises `Aborted` if the run is going wrong."""
        end = min(first + len(u), len(self._u))
        if end <= first:
            return
        self._u[first:end], self._counts[first:end] = u[: end - first], counts[: end - first]
        self._chatters(end)
        self._parts(end)

    def _chatter_predicted(self) -> float:
        """The largest predicted chatter in any window, from sample to sample of the machine [V]."""
        changes = np.diff(self._predicted.u, append=self._predicted.u[-1]) / math.sqrt(self._k)
        width = min(len(changes), max(5, self._window // self._k))
        return float(np.sqrt(np.convolve(changes**2, np.ones(width) / width, "valid").max()))

    def _chatters(self, end: int) -> None:
        recent = self._u[max(0, end - self._window) : end]
        changes = np.diff(recent)
        # ignore samples lost on a link
        chatter = _rms(changes[np.isfinite(changes)]) if np.isfinite(changes).any() else 0.0
        if len(recent) == self._window and chatter > self._most:
            self._end(
                end, f"expected a command that moves by up to {self._most:.3g} V rms a sample, it "
                f"moved by {chatter:.3g} for {WINDOW:g} s, as in a loop that swings; look for "
                "play, for a shaft that gives, for a delay",
            )  # fmt: skip

    def _parts(self, end: int) -> None:
        """End a run too far off, in means of blocks of samples, or too long at a limit."""
        p, c = self._predicted, self._controller
        block = WATCHED * self._k
        for begin in range(self._judged, end - block, block):
            stop = begin + block
            counted = self._counts[stop] - self._counts[begin]
            speed = 60.0 * counted / (self._per_turn * block * self._Ts)
            distance = speed - float(np.mean(p.y[begin // self._k : stop // self._k]))
            self._squares += 0.0 if math.isnan(distance) else block * distance**2
            u = self._u[begin:stop]
            self._railed += int(np.sum((u >= c.u_max - 1e-9) | (u <= c.u_min + 1e-9)))
            self._judged = stop
        if self._squares > self._allowed:
            self._end(
                end, f"expected the machine within {100 * APART:g} % of the span from the "
                "prediction, it was already further from it than that allows over the whole "
                "reference; the machine may have changed since it was recorded",
            )  # fmt: skip
        if self._railed > SATURATED * len(self._u) + block:
            self._end(
                end, "expected the command within its limits most of the time, it was already at "
                "one for half of the whole reference", self._out_of_reach(end),
            )  # fmt: skip

    def _out_of_reach(self, end: int) -> Cause:
        y = np.diff(self._counts[:end], append=np.nan) * 60.0 / (self._per_turn * self._Ts)
        r = np.repeat(self._predicted.r, self._k)[:end]
        reference = self._predicted.reference
        return out_of_reach(r, y, self._u[:end], self._controller, reference, self._volt)

    def _end(self, end: int, reason: str, cause: Cause | None = None) -> None:
        stop = Aborted.after(
            f"{reason}; the controller is not verified", self._predicted.reference,
            self._u[:end], self._counts[:end], self._controller, self._per_turn,
        )  # fmt: skip
        stop.cause = cause
        raise stop


def out_of_reach(
    r: FloatArray,
    y: FloatArray,
    u: FloatArray,
    controller: SampledController,
    reference: str,
    volt: float,
) -> Cause:
    """The cause of a loop at the limit of its command: where it is farthest from its reference.
    The machine bears `volt`.
    """
    apart = _off_at_limit(r, y, u, controller)
    k = int(np.argmax(apart))
    return Cause(
        "out of reach",
        f"{reference!r} asks for {r[k]:.4g} RPM where {u[k]:.4g} V reach {y[k]:.4g}; make it lower "
        f"or slower, or {more_command(controller.u_max, volt)}",
        reference, k * controller.Ts, float(apart[k]),
    )  # fmt: skip


def unreached(comparisons: Sequence[Comparison]) -> str:
    """What the machine did not reach although it did what was predicted; empty if nothing. A level
    that a reference holds for a tenth of its length, or at its end, must be met, in the mean over
    the last quarter of the hold, within `APART` of the reference's span. The command must be at a
    limit no longer than predicted, and a reference without an edge must not be farther off than
    that while it is, for more than `APART` of its length.
    """
    said = []
    for c in comparisons:
        alike = c.alike
        if alike is None:
            continue
        said += [
            f"{mean:.4g} of {level:.4g} RPM on {c.reference!r}"
            for mean, level, _ in missed_levels(alike, APART * c.span)
        ]
        off = _off_at_limit(alike.r, alike.y, alike.u, alike.controller)
        far = off > APART * c.span
        if np.abs(np.diff(alike.r)).max() <= APART * c.span and np.mean(far) > APART:
            said.append(
                f"up to {off.max():.4g} RPM off while the command was at its limit, for "
                f"{100 * np.mean(far):.0f} % of {c.reference!r}"
            )
        # the median of the members' commands is at a limit only where most of them are
        runs = (alike, c.predicted, *c.members)
        limit, *expected = map(_at_limit, runs)
        if limit > max(expected) + APART:
            said.append(
                f"the command was at a limit for {100 * limit:.0f} % of {c.reference!r}, "
                f"{100 * max(expected):.0f} % predicted"
            )
    return "; ".join(said)


def _off_at_limit(
    r: FloatArray, y: FloatArray, u: FloatArray, controller: SampledController
) -> FloatArray:
    """Distance from the reference where the command is at a limit, 0 elsewhere."""
    railed = (u >= controller.u_max - 1e-9) | (u <= controller.u_min + 1e-9)
    return np.where(railed & np.isfinite(y), np.abs(r - y), 0.0)


def _at_limit(found: ClosedLoopRun) -> float:
    """Share of samples at a limit of the command."""
    return found.metrics()["saturated"] or 0.0


def judged(predicted: tuple[Comparison, ...], ensemble: Ensemble) -> Judgement:
    """Verdicts of the first member on every reference, of all on the shortest."""
    shortest = min(predicted, key=lambda c: len(c.predicted.r))
    runs = [m for c in predicted for m in (c.members if c is shortest else c.members[:1])]
    return judge(runs, ensemble, refuse=False)


def require_alike(c: Comparison, volt: float) -> None:
    """Raise `Refusal` if the machine, which bears `volt`, deviates from the prediction."""
    assert c.measured is not None
    assert c.apart is not None
    require_unsaturated(c.measured, volt)
    require(
        c.apart <= APART * c.span,
        f"expected the machine within {100 * APART:g} % of the span from the prediction on "
        f"{c.reference!r}, it was {c.apart:.3g} RPM rms apart; the controller is not verified: "
        "see both in the report; the machine may have changed since it was recorded, or the "
        "reference leaves the range of the recording",
    )


def require_unsaturated(found: ClosedLoopRun, volt: float) -> None:
    """Raise `Refusal` for a loop that is at the limit of its command for too long."""
    saturated = _at_limit(found)
    require(
        saturated <= SATURATED,
        f"expected the command within its limits most of the time on {found.reference!r}, it was "
        f"at one for {100 * saturated:.0f} % of the samples",
        out_of_reach(found.r, found.y, found.u, found.controller, found.reference, volt),
    )
