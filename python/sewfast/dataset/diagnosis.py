"""`diagnose`: properties of a record that decide what can be identified from it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import _core
from ..arrays import FloatArray, labelled
from ..tables import Table
from .faults import faults
from .feedback import Integration, feedback, integration
from .outliers import quantum
from .pieces import LARGEST, require_dataset

if TYPE_CHECKING:
    from .dataset import Dataset

_REFERENCE = re.compile(
    r"((y_?)?(r|ref|reference|set_?point|sp|target|soll|sollwert|demand)"
    # a `voltage_ref` can be the plant's input, a `speed_ref` cannot
    r"|(motor[_ ]?)?(n|speed|rpm|velocity|vel|omega|drehzahl|position|pos|angle|theta|winkel)"
    r"[_ .-]?(ref|reference|set_?point|sp|target|soll|sollwert|demand|cmd|command))"
    # a `setpoint voltage` is what an amplifier is given
    r"([_ .-](?!(motor[_ ]?)?(volt|spannung|tension|pwm|duty|curr|strom)).*)?",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Finding:
    """One property of a record.
    `kind` is `dead_sensor`, `spike`, `wraps`, `no_dynamics`, `exchanged`, `late_input`, `at_once`,
    `unstable`, `integrator`, `closed_loop`, `repeats`, `two_level_input`, `rests`, `short_record`,
    `limited_input` or `coarse_output`. `text`, the finding and its meaning, and `remedy` are
    sentences without a full stop; `evidence` has the figures, in SI units and those of the columns.
    """

    kind: str
    text: str
    remedy: str
    evidence: Mapping[str, float | str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """As JSON values: None where a number is not known."""
        evidence = {
            name: value if isinstance(value, str) or math.isfinite(value) else None
            for name, value in self.evidence.items()
        }
        return {"kind": self.kind, "text": self.text, "remedy": self.remedy, "evidence": evidence}

    def __str__(self) -> str:
        return f"{self.text}. {self.remedy[:1].upper()}{self.remedy[1:]}."


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """The findings of `diagnose`; `str` is a page of text.

    Attributes
    ----------
    findings : tuple of Finding
        The most decisive one comes first.
    """

    findings: tuple[Finding, ...]

    def find(self, kind: str) -> Finding | None:
        """The first finding of that kind; None if there is none."""
        return next((f for f in self.findings if f.kind == kind), None)

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {"findings": [f.to_json() for f in self.findings]}

    def _repr_html_(self) -> str:
        if not self.findings:
            return Table(str(self), (), ()).to_html()
        rows = tuple((f.kind, f.text, f.remedy) for f in self.findings)
        header = ("finding", "what was seen", "what to do")
        return Table("what the data are", header, rows, words=True).to_html()

    def __repr__(self) -> str:
        return f"Diagnosis({', '.join(f.kind for f in self.findings) or 'nothing found'})"

    def __str__(self) -> str:
        if not self.findings:
            return "what the data are: nothing that stands in the way of identifying"
        return "\n".join(["what the data are:", *(f"- {f}" for f in self.findings)])


def diagnose(data: Dataset) -> Diagnosis:
    """Report the properties of a record that decide what can be identified from it.

    ==================  ======================================================================
    `dead_sensor`       the output keeps one value while the rest says that it cannot
    `spike`             a few samples of the output have more power than all others
    `wraps`             the output is an angle that jumps back by a turn
    `no_dynamics`       the output is computed from the input: a multiple, a mean, an integral
    `changes`           from a sample on the output has another sign, scale or time
    `exchanged`         the input answers the output
    `late_input`        the output moves before the input, which was logged late
    `at_once`           the output moves in the sample in which the input does
    `unstable`          an unstable plant, which only a closed loop holds
    `integrator`        the output is a position: it integrates what an input drives
    `closed_loop`       an input was computed from the output, or a reference was recorded
    `repeats`           one trajectory over and over: a held-out part contains nothing new
    `two_level_input`   an input with two levels shows no nonlinearity
    `rests`             the ends, a fifth of the record or more, at rest
    `short_record`      shorter than three of its slowest time constants
    `limited_input`     an input that often stays at its limit
    `coarse_output`     a sensor with few steps within the output's motion
    ==================  ======================================================================

    The data are not changed, and no finding forbids anything. Long records take some tenths of a
    second: the test for feedback uses at most 20,000 samples, most others means of blocks.

    Parameters
    ----------
    data : Dataset
        Values can be missing.

    Returns
    -------
    Diagnosis

    Raises
    ------
    DataError
        If it is not a data set.

    Notes
    -----
    Two tests are statistical: that for an integrator, a regression of Dickey and Fuller (1979) on
    means of blocks, and that for feedback, whether innovations of the output help to predict the
    input (Granger 1969).

    Examples
    --------
    >>> import numpy as np
    >>> from sewfast.dataset import Dataset
    >>> u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 200), 10)
    >>> position = np.cumsum(np.convolve(u, np.full(8, 0.125), "full")[:2000]) * 0.01
    >>> diagnose(Dataset.from_arrays(u, position, 0.01))
    Diagnosis(integrator, two_level_input)
    """
    require_dataset(data, "data")
    wrong = [Finding(f.kind, f.text, f.remedy, f.evidence) for f in faults(data)]
    found = None if any(f.kind == "wraps" for f in wrong) else integration(data)
    return Diagnosis(
        (
            *wrong,
            *_integrator(data, found),
            *_closed_loop(data),
            *_repeats(data),
            *_two_levels(data),
            *_rests(data),
            *_short(data, found),
            *_limited(data),
            *_coarse(data),
        )
    )


def _input(data: Dataset, j: int) -> str:
    return labelled(data.input_names[j], data.input_units[j])


def _output(data: Dataset) -> str:
    return labelled(data.output_name, data.output_unit)


def _arrays(data: Dataset) -> list[tuple[FloatArray, FloatArray]]:
    return [(e.u, e.y) for e in data.experiments]


def _known(column: FloatArray) -> FloatArray:
    return column[np.abs(column) < LARGEST]


# --- the output -----------------------------------------------------------------------------------


def _integrator(data: Dataset, found: Integration | None) -> Iterator[Finding]:
    if found is None or not found.is_integral:
        return
    u = data.input_names[found.input]
    yield Finding(
        "integrator",
        f"{_output(data)} integrates what {u} drives, as a position does: it moves on for as long "
        f"as {u} acts, and nothing in the record brings it back",
        "take its speed, data.differentiate() (--differentiate), or keep the position and identify "
        "a model with an integrator; a model without one has no steady state to find",
        {
            "input": u,
            "gain_per_second": found.gain,
            "lengths_in_time_constants": found.lengths,
            "standard_errors_driving": found.driving,
            "standard_errors_restoring": found.restoring,
        },
    )


def _short(data: Dataset, found: Integration | None) -> Iterator[Finding]:
    # standard errors by which the slowest pole must be known before a record is called short
    sure = 5.0
    if found is None or found.is_integral or found.restoring < sure:
        return
    # three time constants of the slowest pole
    if 0.0 < found.lengths < 3.0 and found.driving > sure:
        yield Finding(
            "short_record",
            f"the record is {found.lengths:.2g} times as long as the slowest time constant of "
            f"{data.output_name}, about {found.time_constant:.2g} s: its steady gain is a guess",
            f"record for {5.0 * found.time_constant:.2g} s or more, with some levels held for as "
            "long as a time constant",
            {
                "lengths_in_time_constants": found.lengths,
                "time_constant_s": found.time_constant,
                "standard_errors_restoring": found.restoring,
            },
        )


def _coarse(data: Dataset) -> Iterator[Finding]:
    known = _known(np.concatenate([e.y for e in data.experiments])[:200_000])
    step = quantum(known) if len(known) else None
    # steps of the sensor in a standard deviation of the output, below which it counts as coarse
    if step is None or not float(known.std()) < 10.0 * step:
        return
    steps = float(known.std()) / step
    yield Finding(
        "coarse_output",
        f"{_output(data)} comes in steps of {step:.4g}, {steps:.2g} of them in its standard "
        "deviation: a model would mainly fit the rounding",
        "of an encoder, record the counts and let their speed be computed (--counts COL "
        "--counts-per-rev N); else excite more strongly or use a finer sensor",
        {"step": step, "steps_in_standard_deviation": steps},
    )


# --- the inputs -----------------------------------------------------------------------------------


def _two_levels(data: Dataset) -> Iterator[Finding]:
    for j, levels in enumerate(_core.two_levels(_arrays(data))):
        if levels is None:
            continue
        low, high = levels
        yield Finding(
            "two_level_input",
            f"{_input(data, j)} has two levels only, {low:.4g} and {high:.4g}: no nonlinearity of "
            "it can be told from these, a straight line goes through any two points",
            "take a linear model, valid between these levels; for another one record many levels: "
            "random steps, a multisine, a chirp (sewfast signals)",
            {"input": data.input_names[j], "low": low, "high": high},
        )


def _limited(data: Dataset) -> Iterator[Finding]:
    for j, value, stretches, share in _core.limits(_arrays(data)):
        yield Finding(
            "limited_input",
            f"{_input(data, j)} stays at its limit of {value:.4g} in {stretches} "
            f"stretches, {share:.0%} of the samples",
            "make sure that it was recorded behind the limiter: a command that the "
            "amplifier did not follow makes a wrong model",
            {"input": data.input_names[j], "limit": value, "share": share},
        )


def _closed_loop(data: Dataset) -> Iterator[Finding]:
    remedy = (
        "identify by output error (oe, networks) on long records, not by arx, which noise in a "
        "loop biases; move the reference strongly, and validate on another trajectory"
    )
    reference = _reference(data)
    if reference is not None:
        name, correlation = reference
        yield Finding(
            "closed_loop",
            f"{data.output_name} follows the recorded reference {name}: the record was made in "
            "closed loop, so the inputs hold noise of the output",
            remedy,
            {"reference": name, "correlation": correlation},
        )
        return
    found = feedback(data)
    if found is None:
        return
    when = "in the same sample" if found.lead == 0 else f"{found.lead} samples later"
    yield Finding(
        "closed_loop",
        f"{data.input_names[found.input]} answers to the noise of {data.output_name} {when}: the "
        "record was made in closed loop",
        remedy,
        {
            "input": data.input_names[found.input],
            "lead_samples": found.lead,
            "correlation": found.correlation,
            "standard_errors": found.significance,
            "standard_errors_of_misfit": found.misfit,
        },
    )


def is_reference(name: str) -> bool:
    """Whether a column has a name for a loop's reference: r, setpoint, speed_ref."""
    return _REFERENCE.fullmatch(name) is not None


def _reference(data: Dataset) -> tuple[str, float] | None:
    """A channel with a reference's name that the output follows, and their correlation."""
    for name in data.experiments[0].channels:
        if not is_reference(name) or any(name not in e.channels for e in data.experiments):
            continue
        r, y = (
            np.concatenate(c)
            for c in zip(*((e.channels[name], e.y) for e in data.experiments), strict=True)
        )
        known = (np.abs(r) < LARGEST) & (np.abs(y) < LARGEST)
        if known.sum() > 2 and np.ptp(r[known]) > 0.0 and np.ptp(y[known]) > 0.0:
            correlation = float(np.corrcoef(r[known], y[known])[0, 1])
            if correlation > 0.5:
                return name, correlation
    return None


# --- the record -----------------------------------------------------------------------------------


def _repeats(data: Dataset) -> Iterator[Finding]:
    e = max(data.experiments, key=len)
    found = _core.period(_arrays(data))
    if found is None:
        return
    period, correlation = found
    seconds, times = period * data.Ts, len(e) / period
    yield Finding(
        "repeats",
        f"{e.name} repeats one trajectory of {seconds:.3g} s {times:.1f} times: what is held out "
        "of it was learned elsewhere in it, and its error flatters",
        "record another trajectory and judge the model on that (sewfast validate MODEL OTHER)",
        {"period_s": seconds, "times": times, "correlation": correlation},
    )


def _rests(data: Dataset) -> Iterator[Finding]:
    found = zip(data.experiments, _core.rests(_arrays(data)), strict=True)
    ends = [(e, 0, 0) if a >= len(e) else (e, a, b) for e, (a, b) in found]
    share = sum(a + b for _, a, b in ends) / len(data)
    # part of a record that can be at rest at its ends without a finding
    if share < 0.2:
        return
    e, before, after = max(ends, key=lambda end: end[1] + end[2])
    # a short rest is useful: it shows the level and helps to estimate the initial state
    keep = max(20, len(e) // 50)
    first, last = max(0, before - keep), len(e) - max(0, after - keep)
    one = len(data.experiments) == 1
    where = f"before sample {before} and from {len(e) - after} on"
    if not before or not after:
        where = f"from sample {len(e) - after} on" if after else f"before sample {before}"
    yield Finding(
        "rests",
        f"inputs and output rest for {share:.0%} of the record"
        f"{'' if one else 's'}, {'' if one else f'{e.name} '}{where}: these samples say little and "
        "weigh as much as the others",
        f"leave most of them out: data[{first}:{last}] (--train {first}:{last})"
        + ("" if one else f" for {e.name}"),
        {"share": share, "first": float(first), "last": float(last)},
    )
