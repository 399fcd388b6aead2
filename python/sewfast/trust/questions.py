"""The lines of a judgement: from what was seen in runs to limits, verdicts and sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..evidence.card import Line
from .disagreement import Disagreement
from .judgement import JudgedRun
from .limits import Limits

FAR = 0.2


def region(runs: Sequence[JudgedRun], limits: Limits) -> Line:
    """Does a model have to say what it has never seen?"""
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
    far = "the loop runs where the model was not trained: what it promises there is a guess"
    some = "some of the loop runs where the model was not trained"
    text = (
        f"{far if worst.outside > FAR else some} (worst: {worst.name}); record such operation, "
        "best in a closed loop, and identify again, or demand less"
    )
    return Line(name, worst.outside, shown, limit, "warn", text)


def saturation(runs: Sequence[JudgedRun], limits: Limits) -> Line:
    """Does the loop lean on the limits of the command?"""
    worst = max(runs, key=lambda r: r.saturated)
    name, limit = "saturation", f"<= {100 * limits.saturated:g} %"
    shown = f"{100 * worst.saturated:.1f} % of the time"
    if worst.saturated <= limits.saturated:
        text = "the command keeps within its limits for most of the time"
        return Line(name, worst.saturated, shown, limit, "ok", text)
    text = (
        f"the command stays at a limit (worst: {worst.name}): there the loop is open, gains say "
        "nothing and a disturbance is not rejected; demand less, or check whether it swings"
    )
    return Line(name, worst.saturated, shown, limit, "warn", text)


def limit_cycle(runs: Sequence[JudgedRun], limits: Limits) -> Line:
    """Does the loop swing by itself?"""
    name = "limit cycle"
    limit = f"swing <= {100 * limits.swing:g} %, ripple <= {100 * limits.ripple:g} %"
    seen = [(r, r.oscillation) for r in runs if r.oscillation is not None]
    if not seen:
        text = "no reference is constant for long enough to see whether the loop swings by itself"
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
            "at constant reference the loop comes to rest, but for the encoder's steps and what "
            "the load does",
        )  # fmt: skip
    text = (
        f"at a constant reference of {worst.level:g} {units['y']} the loop swings by itself, with "
        f"about {worst.hertz:.3g} Hz (worst: {run.name}): it tracks as a limit cycle held by the "
        "limits; lower the gains, filter the feedback, or take delay out of the loop"
    )
    return Line(name, worst.swing, shown, limit, "warn", text)


def disagreement(found: Sequence[Disagreement], limits: Limits, unit: str) -> Line:
    """Do models of the same plant promise the same?"""
    name, limit = "disagreement", f"<= {100 * limits.disagreement:g} % of the reference's span"
    if not found:
        text = "one plant alone: nothing says how far its promise may be off; tune on several"
        return Line(name, math.nan, "not known", limit, "info", text)
    worst = max(found, key=lambda d: d.share)
    shown = f"{worst.rms:.3g} {unit} rms, {100 * worst.share:.3g} %"
    if worst.share <= limits.disagreement:
        text = f"{worst.plants} plants answer alike: what they promise does not hang on one of them"
        return Line(name, worst.share, shown, limit, "ok", text)
    text = (
        f"{worst.plant} parts from the median of {worst.plants} plants on {worst.reference}: the "
        "data do not decide what this loop will do; leave out members that fit badly, or record "
        "a closed loop and identify again"
    )
    return Line(name, worst.share, shown, limit, "fail", text)
