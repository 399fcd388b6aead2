"""The closing sentence of a report card: good enough or not, because of what, what to do first."""

from __future__ import annotations

from collections.abc import Sequence

from .lines import Line

_NAMED = 3
"""Lines that are named; of more there is only the number."""
_STEPS = (
    # by weight: a model that fails an early one is not helped by mending a later one
    ("free run", "check the columns, the delay and the orders, or record with a larger excitation"),
    ("largest pole", "record at the operating points that are unstable, and train on them as well"),
    (
        "outside training region",
        "record operation like this, and train on it as well before relying on the model here",
    ),
    ("error over training", "train on data like these as well, or take a smaller model"),
    (
        "parameters on these data",
        "train on this recording as well, and allow a network: a linear model is a compromise "
        "where the plant bends; if that does not help, the plant has changed in between",
    ),
    (
        "residual with past residual times input",
        "compare recordings from different times: the gain drifts, or noise acts inside the loop",
    ),
    (
        "residual with",
        "let identify search for the structure (no model named): it tries other orders, delays and "
        "networks",
    ),
    ("squared residual", "allow a network, or see whether the noise grows with the amplitude"),
    ("mean residual", "see whether the zero of a sensor or an amplifier has moved"),
    ("samples per parameter", "record longer, or take a smaller model"),
    ("inside", "read the bands with care: noise or operation differ from the training data"),
)
"""How a line's name begins, and what to do where it warns or fails."""


def summary(lines: Sequence[Line]) -> str:
    """Of the lines of a report card."""
    failed = [x for x in lines if x.verdict == "fail"]
    warned = [x for x in lines if x.verdict == "warn"]
    free = next((x for x in lines if x.name == "free run"), None)
    if free is not None and free.verdict == "fail":
        return f"useless here ({free.shown}); first {_step([free])}"
    shown = "" if free is None else f" ({free.shown})"
    if free is not None and free.verdict == "info":
        return "the output is constant here, which says nothing of the model; record one that moves"
    follows = f"the free run follows the data{shown}"
    if free is not None and free.verdict == "warn":
        follows = f"not good enough to tune on: the free run follows the data loosely{shown}"
        warned.remove(free)
    if failed:
        return f"{follows}, and {_counted(failed, 'fail')}; first {_step(failed)}"
    if free is not None and free.verdict == "warn":
        return f"{follows}; first {_step([free, *warned])}"
    if warned:
        return (
            f"good enough to tune on with care{shown}: {_counted(warned, 'warn')}; to do better, "
            f"{_step(warned)}"
        )
    return f"good enough to tune a controller on{shown}: nothing here speaks against the model"


def _counted(lines: Sequence[Line], verb: str) -> str:
    names = ", ".join(x.name for x in lines[:_NAMED])
    more = len(lines) - _NAMED
    count = f"one line {verb}s" if len(lines) == 1 else f"{len(lines)} lines {verb}"
    return f"{count} ({names}{f' and {more} more' if more > 0 else ''})"


def _step(lines: Sequence[Line]) -> str:
    for start, step in _STEPS:
        if any(x.name.startswith(start) for x in lines):
            return step
    return "read the lines above"
