"""Faults of a record: a sensor that died, columns without dynamics, exchanged or late columns, and
unstable plants.

All tests compare a record with itself, and take the side of the record in doubt. Values that
`identify` refuses count as not known, and no test judges columns that do not move, so that none
fails on any numbers: columns are compared about their mean, in units of their deviation.

- A sensor that died, or said nonsense for a few samples (`sensor`).
- A counter that wraps: the output jumps by its whole range against the way that it moves before and
  after.
- No dynamics: for the whole record, the output is the input times a number or a curve of it, or it
  or its change is a sum of an input in the same sample and in some before.
- A change: one part of the record predicts the other with another sign, scale or time (`changes`).
- The order in time: the past of a cause helps to predict its effect beyond the effect's own past,
  and not the other way (Granger 1969).

`rust/core/src/faults.rs` has the tests of columns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .. import _core
from ..arrays import labelled
from ..errors import DataError
from ..units import duration
from .changes import NOTED, changed
from .sensor import Dead, alive, dead_stretches, spikes

if TYPE_CHECKING:
    from .dataset import Dataset

PAST = 10
"""Most samples by which an input acts late in a sum of inputs; the search has the same."""

# --- The faults in words, and what `identify` does about them -------------------------------------


@dataclass(frozen=True)
class Fault:
    """One fault of a record: what was seen, what to do about it, and the figures behind it."""

    kind: str
    text: str
    remedy: str
    evidence: dict[str, float | str]
    dead: tuple[Dead, ...] = ()

    @property
    def is_of_plant(self) -> bool:
        """Whether the plant is so, and the record may be sound."""
        return self.kind in ("unstable", "at_once")

    @property
    def with_remedy(self) -> str:
        """What is wrong and what to do."""
        return f"{self.text}: {self.remedy}"

    @property
    def warning(self) -> str:
        """For the notes of a model."""
        return f"warning: {f'{self.text}; left out' if self.dead else self.with_remedy}"


def faults(data: Dataset) -> tuple[Fault, ...]:
    """What is wrong: dead stretches, columns of no plant, two records in one, an unstable plant."""
    if wrap := tuple(_wraps(data)):
        return wrap
    if apart := spikes(data):
        rest = faults(alive(data, apart))
        return (_spike_fault(data, apart), *rest)
    found = (*(_dead_fault(data, dead) for dead in dead_stretches(data)), *_order_fault(data))
    return found or tuple(_change_fault(data)) or tuple(_unstable_fault(data))


def _wraps(data: Dataset) -> Iterator[Fault]:
    """Jumps by nearly the whole range, against the motion before and after."""
    if (found := _core.wraps([(e.u, e.y) for e in data.experiments])) is None:
        return
    period, back = found
    yield Fault(
        "wraps",
        f"{labelled(data.output_name, data.output_unit)} jumps back by {period:.6g} at {back} "
        "places while it moves on: an angle or a counter that wraps, which no model can follow",
        f"unwrap it before it is read: np.unwrap(y, period={period:.6g})",
        {"period": period, "jumps": float(back)},
    )


def _spike_fault(data: Dataset, apart: tuple[Dead, ...]) -> Fault:
    spike = apart[0]
    of = "" if len(data.experiments) == 1 else f" of {data.experiments[spike.experiment].name}"
    span = f"{spike.start}:{spike.stop}"
    mask = f'data.mask("{span}") (--mask {span})'
    text = f"{data.output_name} is {spike.value:.6g} in samples {span}{of}"
    if len(apart) > 1:
        others = ", ".join(f"{s.start}" for s in apart[1:6]) + (", ..." if len(apart) > 6 else "")
        text += f", and as far off at {len(apart) - 1} other places ({others})"
        mask = "with all others that stand out, data.mask(data.mark_outliers()) (--mask outliers)"
    return Fault(
        "spike",
        f"{text}, far from the samples beside it, and has more power there than in all the rest "
        "of the record",
        f"leave it out, {mask}, and check cable, sensor and log",
        {
            "first": float(spike.start), "last": float(spike.stop), "value": spike.value,
            "places": float(len(apart)),
        },
        apart,
    )  # fmt: skip


def _dead_fault(data: Dataset, dead: Dead) -> Fault:
    e = data.experiments[dead.experiment]
    of = "" if len(data.experiments) == 1 else f" of {e.name}"
    span = f"{dead.start}:{dead.stop}"
    return Fault(
        "dead_sensor",
        f"{data.output_name} keeps the value {dead.value:.6g} to the last bit in samples {span}"
        f"{of}, {(dead.stop - dead.start) / len(e):.0%} of the record, while the input moves as it "
        "does elsewhere: the sensor was dead or frozen",
        f'leave these samples out, data.mask("{span}") (--mask {span})'
        + ("" if len(data.experiments) == 1 else ", in their file alone")
        + ", and check cable and sensor",
        {"first": float(dead.start), "last": float(dead.stop), "value": dead.value},
        (dead,),
    )


def _order_fault(data: Dataset) -> Iterator[Fault]:
    y = labelled(data.output_name, data.output_unit)
    experiments = [(e.u, e.y) for e in data.experiments]
    if (copy := _core.copied(experiments)) is not None:
        j, gain, offset, delay = copy
        name = data.input_names[j]
        after = "" if delay == 0 else f" of {delay} samples before"
        yield Fault(
            "no_dynamics",
            f"{y} is {name}{after} times {gain:.4g}, exactly: there are no dynamics between "
            "the two, as one column was read twice or computed from the other",
            "name the column of a sensor as output",
            {"input": name, "gain": gain, "offset": offset, "delay": float(delay)},
        )
        return
    if data.looks_ahead:
        return
    if (sums := _core.computed(experiments)) is not None:
        names = " and ".join(data.input_names)
        yield Fault(
            "no_dynamics",
            f"{y} is a curve of {names} in the same sample, to rounding: there are no dynamics "
            "between the two, as the column was computed from the other"
            if sums == "curve"
            else f"{'each change of ' if sums == 'change' else ''}{y} is a sum of {names} in the "
            f"same sample and in up to {PAST} before, to rounding: the column was computed from "
            "the other, as a mean, a difference or an integral is",
            "name the column of a sensor as output",
            {"input": names, "sums": sums},
        )
        return
    if (order := _core.order_in_time(experiments)) is None:
        return
    kind, j, late, likelihood = order
    name = data.input_names[j]
    u = labelled(name, data.input_units[j])
    evidence: dict[str, float | str] = {
        "input": name, "shift": float(late), "log_likelihood": likelihood,
    }  # fmt: skip
    shift = f"data.shift_inputs({late}) (--shift-input {late})"
    if kind == "exchanged":
        yield Fault(
            "exchanged",
            f"{u} answers {y}, and {data.output_name} does not answer {name}: input and output "
            "are exchanged",
            f"take {data.output_name} as input and {name} as output",
            evidence,
        )
    elif kind == "late":
        yield Fault(
            "late_input",
            f"{y} moves {late - 1} sample{'s' if late > 2 else ''} before {u} does: "
            f"{name} was logged {late} samples late, counted to one sample from the command "
            f"to the output, or {data.output_name} was smoothed with later samples; every delay "
            "and time constant would be wrong",
            f"read {name} earlier, {shift}, or take {data.output_name} as it was measured",
            evidence,
        )
    else:
        yield Fault(
            "at_once",
            f"{y} moves in the same sample as {u} (nk = 0), and a controller that has to measure "
            "first cannot be closed around such a model: it would need the output before the "
            "command",
            f"if {name} was logged a sample late, {shift}; if the plant does answer at once, "
            "identify it with nk=0 (--nk 0), to simulate",
            evidence,
        )


def _change_fault(data: Dataset) -> Iterator[Fault]:
    if (change := changed(data)) is None:
        return
    e, u = data.experiments[change.experiment], " and ".join(data.input_names)
    of = "" if len(data.experiments) == 1 else f" of {e.name}"
    y = labelled(data.output_name, data.output_unit)
    gain, shift = change.gain, change.shift
    if shift:
        lost = f"rows of {data.output_name if shift > 0 else u} are missing there"
        when = "earlier" if shift > 0 else "later"
        what = f"comes {abs(shift)} samples {when} against {u}: {lost}"
    elif abs(gain) < NOTED:
        what = f"no longer answers {u}: a motor that is off, a cable, a sensor"
    else:
        why = "its sign has turned" if gain < 0.0 else "another scale, unit or load"
        what = f"answers {u} with {gain:.2g} times its gain: {why}"
    yield Fault(
        "changes",
        f"from about sample {change.start}{of} ({duration(change.start * data.Ts)}) on {y} "
        f"{what}; this explains {1.0 - change.left:.0%} of what one model of the "
        "whole record leaves",
        "identify each part by itself, "
        f'data.slice("{e.start}:{change.start}") (--train {e.start}:{change.start}), and check how '
        "the file was written, its units, leads and sensors",
        {"first": float(change.start), "gain": gain, "shift": float(shift), "left": change.left},
    )


def _unstable_fault(data: Dataset) -> Iterator[Fault]:
    if (pole := _core.unstable_pole([(e.u, e.y) for e in data.experiments])) is None:
        return
    y = labelled(data.output_name, data.output_unit)
    doubles = math.log(2.0) / math.log(pole) * data.Ts
    yield Fault(
        "unstable",
        f"{y} is that of an unstable plant in a closed loop: a pole at {pole:.5g}, so that it "
        f"doubles every {duration(doubles)} without its controller",
        "leave the kind of model to the search, which takes an unstable one then; or name the "
        "loop's reference as input",
        {"pole": pole, "doubles": doubles},
    )


def sound(data: Dataset) -> tuple[Dataset, tuple[Fault, ...]]:
    """The data without dead stretches and spikes, and what was found, for `identify`.
    Raises `DataError` if the columns are no input and output of a plant: one is computed from the
    other, they are exchanged, or a counter wraps.
    """
    found = faults(data)
    wrong = next((f for f in found if f.kind in ("no_dynamics", "exchanged", "wraps")), None)
    if wrong is not None:
        raise DataError(
            name=data.source, expected="an output that answers the input", received=wrong.text,
            remedy=wrong.remedy,
        )  # fmt: skip
    return alive(data, [d for f in found for d in f.dead]), found
