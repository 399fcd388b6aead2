"""What to do about the numbers that a summary of data shows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from .pieces import SMALLEST_FITTED

if TYPE_CHECKING:
    from .summary import ColumnSummary, Summary

LIMITED = 0.02
"""Part of the samples at one limit from which on the output counts as limited."""
NOISY = 0.2
"""White noise over standard deviation from which on the output counts as noisy."""
FINE = 50.0
"""Samples in a period of the highest frequency from which on the sample time is very short."""
ENOUGH = 10.0
"""Samples that such a period needs."""
NYQUIST = 0.25
"""Upper end of the band, in parts of the sampling rate, from which on it is close to the limit."""
SHOWN = 8
"""Outliers whose places are named."""
FEW = 500
"""Samples below which an identification has little to go by."""


def advice(found: Summary) -> Iterator[str]:
    """One sentence per finding: what it is, what it does, what helps."""
    output = found.columns[-1]
    for c in found.columns:
        yield from _values(c)
    if found.outliers:
        yield _outliers(found, output.name)
    yield from _limits(output)
    yield from _noise(output)
    # of a position nearly all power is slow, whatever the speed does
    if found.diagnosis.find("integrator") is None and found.diagnosis.find("wraps") is None:
        yield from _rate(output, found.Ts)
    if found.n < FEW:
        yield (
            f"{found.n} samples are few: a network needs about ten for each of its parameters; "
            "record longer, or identify a linear model (model='oe')"
        )


def _values(c: ColumnSummary) -> Iterator[str]:
    if c.unusable:
        yield (
            f"{c.unusable} {'value' if c.unusable == 1 else 'values'} of {c.name} "
            f"{'is' if c.unusable == 1 else 'are'} infinite or 1e150 and more, as no sensor gives "
            f"{'it' if c.unusable == 1 else 'them'}: repair the file"
            + (
                ", or mask them: data.mask(lambda e: abs(e.y) > LIMIT)"
                if c.role == "output"
                else ""
            )
        )
    if c.n == c.missing:
        yield f"nothing is known of {c.name}: choose another column"
    elif c.missing and c.role == "input":
        yield (
            f"{c.name} is not known at {c.missing} samples, and a simulation needs every input: "
            'data.fill_inputs("hold") where it stayed as it was (--hold-inputs), else the pieces '
            'between: data.split_at_gaps(of="inputs") (--split-at-gaps)'
        )
    elif c.missing:
        yield (
            f"{c.name} was not measured at {c.missing} samples ({c.missing / c.n:.1%}): they have "
            "no weight, models run through them; nothing needs to be done"
        )
    elif not c.moves and not math.isnan(c.low):
        moves = "excites the plant" if c.role == "input" else "follows the input"
        yield f"{c.name} is constant at {c.low:g}: there is nothing to learn until it {moves}"
    elif c.high - c.low < SMALLEST_FITTED:
        yield f"{c.name} moves by {c.high - c.low:g}, too little to be squared: change the unit"


def _outliers(found: Summary, name: str) -> str:
    several = len(found.experiments) > 1
    shown = ", ".join(f"{k} of {e}" if several else str(k) for e, k in found.outliers_at[:SHOWN])
    more = "" if found.outliers <= SHOWN else f" and {found.outliers - SHOWN} more"
    one = found.outliers == 1
    return (
        f"{found.outliers} {'value' if one else 'values'} of {name} "
        f"{'stands' if one else 'stand'} out of {'its' if one else 'their'} neighbours, at sample"
        f"{'' if one else 's'} {shown}{more}: look at {'it' if one else 'them'}, then take "
        f"{'it' if one else 'them'} out, data.mask(data.mark_outliers()) (--mask outliers)"
    )


def _limits(output: ColumnSummary) -> Iterator[str]:
    for part, value in ((output.at_low, output.low), (output.at_high, output.high)):
        if part > LIMITED:
            yield (
                f"{output.name} stays at {value:g} for {part:.1%} of the samples: a limit of the "
                "sensor or of the plant. A network can learn it, a linear model cannot; of a "
                "sensor's limit mask these samples"
            )


def _noise(output: ColumnSummary) -> Iterator[str]:
    # the square of a tiny output may be 0
    known = output.moves and output.std > 0.0 and math.isfinite(output.noise)
    if known and output.noise > NOISY * output.std:
        yield (
            f"white noise is {output.noise / output.std:.0%} of what {output.name} does: excite "
            "more strongly or record longer; prefer output error to arx, which noise bends"
        )


def _rate(output: ColumnSummary, Ts: float) -> Iterator[str]:
    if output.band is None or output.top is None or not output.moves:
        return
    if 1.0 / (output.top * Ts) > FINE:
        wanted = nice(1.0 / (ENOUGH * output.top))
        yield (
            f"99.9 % of the power of {output.name} lies below {output.top:.3g} Hz, "
            f"{1.0 / (output.top * Ts):.0f} samples in a period: where no controller is to run at "
            f"this rate, fits are faster at a longer sample time, data.resample({wanted:g}) "
            f"(--resample {wanted:g})"
        )
    elif output.band[1] * Ts > NYQUIST:
        yield (
            f"{output.name} moves up to {output.band[1]:.3g} Hz, close to half the sampling rate: "
            "either most of it is noise, or the sample time is too long to see what the plant does"
        )


def nice(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)) * power)
