"""Faults of a record: a sensor that died, columns without dynamics, exchanged or late columns, and
unstable plants.

All tests compare a record with itself, and take the side of the record in doubt. Values that
`identify` refuses count as not known, and no test judges columns that do not move, so that none
fails on any numbers: columns are compared about their mean, in units of their deviation.

- A sensor that died, or said nonsense for a few samples (`sensor`).
- A counter that wraps: the output jumps by its whole range against the way that it moves before and
  after.
- No dynamics: for the whole record, the output is the input times a number, or it or its change is
  a sum of an input in the same sample and in some before.
- A change: one part of the record predicts the other with another sign, scale or time (`changes`).
- The order in time: the past of a cause helps to predict its effect beyond the effect's own past,
  and not the other way (Granger 1969).
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import FloatArray, labelled, runs
from ..errors import DataError
from ..units import duration
from .changes import NOTED, changed
from .outliers import quantum
from .pieces import LARGEST_FITTED
from .sensor import (
    PAST,
    Dead,
    alive,
    dead_stretches,
    known_rows,
    measured_columns,
    scale_of,
    spikes,
)
from .stability import unstable_pole

if TYPE_CHECKING:
    from .dataset import Dataset

MOST = 20_000
"""Most samples that a regression uses."""
SURE = 60.0
"""Twice the log-likelihood that a cause must add. By chance the 10 coefficients of a lead add 10,
and 60 in one of 3e8 records."""
PARTS = 8
"""Parts of a record of which the loudest does not count. In 3 of 100 records of `end_stop` in
`tests/dataset/test_faults.py` one bump said 65 to 189 for a late input, the other parts below 0."""
OCTAVES = 6
"""Means of an input over 10, 20, 40 .. samples before these: plants with long dead times."""


# --- Columns of which one is computed from the other, exchanged, or late --------------------------


@dataclass(frozen=True)
class Copy:
    """The output is `gain` times the input `delay` samples before, plus `offset`."""

    input: int
    gain: float
    offset: float
    delay: int


def copied(data: Dataset) -> Copy | None:
    """An input that the output repeats to rounding, up to `PAST` samples later."""
    experiments = [measured_columns(e) for e in data.experiments]
    for j, delay in itertools.product(range(data.n_inputs), range(PAST + 1)):
        u = np.concatenate([c[: max(0, len(c) - delay), j] for c in experiments])
        y = np.concatenate([c[delay:, -1] for c in experiments])
        known = np.isfinite(u) & np.isfinite(y)
        u, y = u[known], y[known]
        # a few steps between two levels, later, are those of any plant that settles in a sample
        is_binary = delay > 0 and len(np.unique(u[:MOST])) < 3
        if len(y) < 4 * PAST or (is_binary and np.count_nonzero(np.diff(u)) < PAST):
            continue
        # most records show in their beginning that this is none
        if _of_line(u[:MOST], y[:MOST]) is None or scale_of([np.column_stack([u, y])]) is None:
            continue
        if (covariance := _of_line(u, y)) is None:
            continue
        gain = covariance / float(u.var())
        offset = float(y.mean() - gain * u.mean())
        rounding = _rounding(y) + abs(gain) * _rounding(u)
        if float(np.abs(y - gain * u - offset).max()) <= 1.01 * rounding:
            return Copy(j, gain, offset, delay)
    return None


def _of_line(u: FloatArray, y: FloatArray) -> float | None:
    """The covariance of two columns that lie on a line; None if they do not."""
    covariance = float(np.mean((u - u.mean()) * (y - y.mean())))
    return covariance if abs(covariance) >= 0.999 * float(u.std() * y.std()) else None


def _rounding(column: FloatArray) -> float:
    """Half of a step: of the grid that was printed, or of six digits where none is seen or the
    grid is so coarse that its steps are levels.
    """
    step = quantum(column) or 0.0
    return 0.5 * (step if 0.0 < step < 0.02 * column.std() else 1e-5 * float(np.ptp(column)))


def computed(data: Dataset) -> str | None:
    """Whether the output, or its change, is a sum of inputs, in the same sample too, to rounding.
    A simulation without noise answers one sample later, and a plant has a memory of its own.
    """
    pieces = [] if data.looks_ahead else _pieces(data)
    if sum(map(len, pieces)) < 10 * PAST * (1 + data.n_inputs):
        return None
    lags = range(PAST + 1)
    u = np.concatenate([np.hstack([p[PAST - i : len(p) - i, :-1] for i in lags]) for p in pieces])
    now = np.concatenate([p[PAST:, -1] for p in pieces])
    change = np.concatenate([np.diff(p[PAST - 1 :, -1]) for p in pieces])
    # any response fits a few moves
    if np.count_nonzero(np.diff(u[:, : data.n_inputs], axis=0).any(axis=1)) < 2 * PAST:
        return None
    digits = 0.5e-5 * np.ptp(u, axis=0)
    roundings = 0.5e-5 * float(np.ptp(now)), _rounding(now)

    def is_exact(target: FloatArray, first: int) -> bool:
        X = np.column_stack([u[:, first:], np.ones(len(u))])
        theta = np.linalg.lstsq(X, target, rcond=1e-10)[0]
        of_u = float(np.abs(theta[:-1]) @ digits[first:])
        allowed = [v for r in roundings if (v := 2.0 * r + of_u) < 0.02 * float(target.std())]
        return float(np.abs(target - X @ theta).max()) <= max(allowed, default=0.0)

    for name, target in (("output", now), ("change", change)):
        if is_exact(target, 0) and not is_exact(target, data.n_inputs):
            return name
    return None


@dataclass(frozen=True)
class Order:
    """Which of two signals moves first.
    `kind` is "exchanged" (the input answers the output), "late" (the input was logged `shift`
    samples late; read so much earlier, it moves one sample before the output) or "at_once" (the
    output moves in the sample in which the input does). `evidence` is twice the log-likelihood that
    shows it.
    """

    kind: str
    input: int
    shift: int
    evidence: float


def order_in_time(data: Dataset) -> Order | None:
    """Whether an input moves after the output that it should drive; None if no input does.
    An input that keeps its value to the last bit for most samples is no answer to a noisy output:
    if the output moves before it, it was logged late. Other late inputs look like those that a
    controller computed, so only exchanged columns are found: the past of the output predicts the
    input, and the past of the input says nothing about the output.
    """
    if data.looks_ahead:
        return None
    pieces = _pieces(data)
    if sum(map(len, pieces)) < 10 * PAST * (2 + data.n_inputs):
        return None
    for j in range(data.n_inputs):
        found = _late(pieces, j) if _is_held(pieces, j) else _exchanged(pieces, j)
        if found is not None:
            return found
    return None


def _pieces(data: Dataset) -> list[FloatArray]:
    """Known stretches of the longest experiments, at most `MOST` samples, each column scaled."""
    pieces, left = [], MOST
    for e in sorted(data.experiments, key=len, reverse=True):
        columns = measured_columns(e)
        for first, count in runs(known_rows(columns)):
            if min(count, left) > 4 * PAST:
                pieces.append(columns[first : first + min(count, left)])
                left -= len(pieces[-1])
    scale = scale_of(pieces)
    return [] if scale is None else [(p - scale[0]) / scale[1] for p in pieces]


def _is_held(pieces: list[FloatArray], j: int) -> bool:
    still = sum(int((np.diff(p[:, j]) == 0.0).sum()) for p in pieces)
    moving = sum(int((np.diff(p[:, -1]) != 0.0).sum()) for p in pieces)
    count = sum(len(p) - 1 for p in pieces)
    return 2 * still > count and 2 * moving > count


def _evidence(
    pieces: list[FloatArray], of: int, past: tuple[int, ...], more: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """How much `more` columns say of column `of`, beyond the past of the columns `past`.
    The `more` columns (rows,) stand beside the rows `PAST` to `-PAST` of all pieces. Returns two
    arrays (len(more),): twice the log-likelihood that each of `more` and those behind it add
    together; and without the part of the record that says most, as one bump into an end stop can
    look like anything.
    """
    y = _beside(pieces, of, 0)
    lags = [_beside(pieces, c, -i) for c in past for i in range(1, PAST + 1)]
    X = np.stack([*lags, np.ones(len(y)), *more], axis=1)
    # the triangle has the same residuals, and few rows
    R = np.asarray(np.linalg.qr(np.column_stack([X, y]), mode="r"), dtype=np.float64)
    widths = range(len(lags) + 1, X.shape[1] + 1)
    parts = np.array([_squares(X[:, :w], y, R[:, :w], R[:, -1]) for w in widths])
    whole = len(y) * np.log(parts[:-1].sum(axis=1) / parts[-1].sum())
    added = len(y) / PARTS * np.log(parts[:-1] / parts[-1])
    return whole, np.minimum(whole, added.sum(axis=1) - added.max(axis=1))


def _squares(X: FloatArray, y: FloatArray, R: FloatArray, target: FloatArray) -> list[float]:
    """Sums of squares that the columns leave of y, in `PARTS` parts of the rows."""
    error = y - X @ np.linalg.lstsq(R, target, rcond=1e-10)[0]
    # below this only the rounding of the columns is left, and of a column that stands still nothing
    return [
        max(float(e @ e), 1e-12 * float(v @ v), sys.float_info.min)
        for e, v in zip(np.array_split(error, PARTS), np.array_split(y, PARTS), strict=True)
    ]


def _beside(pieces: list[FloatArray], j: int, ahead: int) -> FloatArray:
    """Column j `ahead` samples after the rows of `_evidence`."""
    return np.concatenate([p[PAST + ahead : len(p) - PAST + ahead, j] for p in pieces])


def _distant(pieces: list[FloatArray], j: int) -> list[FloatArray]:
    """Means of column j over octaves of lags from `PAST` on, 0 before the first sample."""
    edges = [PAST * 2**i for i in range(OCTAVES + 1)]
    means: list[list[FloatArray]] = [[] for _ in range(OCTAVES)]
    for p in pieces:
        total = np.concatenate([[0.0], np.cumsum(p[:, j])])
        k = np.arange(PAST, len(p) - PAST)
        at = [total[np.maximum(k - edge, 0)] for edge in edges]
        for i in range(OCTAVES):
            means[i].append((at[i] - at[i + 1]) / (edges[i + 1] - edges[i]))
    return [np.concatenate(m) for m in means]


def _late(pieces: list[FloatArray], j: int) -> Order | None:
    """How many samples the output leads an input that no controller computed."""
    everything = tuple(range(pieces[0].shape[1]))
    ahead = [_beside(pieces, j, i) for i in range(PAST + 1)]
    _, evidence = _evidence(pieces, everything[-1], everything, ahead)
    sure = np.flatnonzero(evidence > SURE)
    # the farthest lead matters: the record differs from this model in another way
    if len(sure) == 0 or sure[-1] == PAST:
        return None
    # the last lead without which something is lost
    lead = int(sure[-1])
    kind = "late" if lead > 0 else "at_once"
    return Order(kind, j, lead + 1, float(evidence[lead]))


def _exchanged(pieces: list[FloatArray], j: int) -> Order | None:
    of = pieces[0].shape[1] - 1
    lags = [_beside(pieces, j, -i) for i in range(1, PAST + 1)]
    driven, _ = _evidence(pieces, of, (of,), [*lags, *_distant(pieces, j)])
    if driven[0] > SURE:
        return None
    lags = [_beside(pieces, of, -i) for i in range(1, PAST + 1)]
    _, answers = _evidence(pieces, j, (j,), lags)
    return Order("exchanged", j, 0, float(answers[0])) if answers[0] > SURE else None


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
    """Dead stretches of the output's sensor, columns that are no input and output of a plant, a
    record in two parts that do not go together, or a plant that only a closed loop holds."""
    if wrap := tuple(_wraps(data)):
        return wrap
    if apart := spikes(data):
        rest = faults(alive(data, apart))
        return (_spike_fault(data, apart), *rest)
    found = (*(_dead_fault(data, dead) for dead in dead_stretches(data)), *_order_fault(data))
    return found or tuple(_change_fault(data)) or tuple(_unstable_fault(data))


def _wraps(data: Dataset) -> Iterator[Fault]:
    """Jumps by nearly the whole range, against the motion before and after."""
    columns = [e.y[np.abs(e.y) < LARGEST_FITTED] for e in data.experiments]
    everything = np.concatenate(columns)
    span = float(np.ptp(everything)) if len(everything) else 0.0
    if span == 0.0:
        return
    back, other, sizes = 0, 0, []
    changes = [np.diff(y) for y in columns]
    for change in changes:
        # changes of an angle are either small or jumps; noise has changes of all sizes between
        other += int(np.sum((np.abs(change) > 0.35 * span) & (np.abs(change) <= 0.7 * span)))
        jumps = np.where(np.abs(change) > 0.7 * span, np.sign(change), 0.0)
        for k in np.flatnonzero(jumps):
            if -jumps[k] in jumps[max(k - 5, 0) : k + 6]:
                # there and back: a spike
                other += 1
                continue
            around = np.concatenate([change[max(k - 5, 0) : k], change[k + 1 : k + 6]])
            slope = float(np.median(around)) if len(around) else 0.0
            if slope * change[k] < 0.0 and abs(slope) < 0.2 * span:
                back += 1
                sizes.append(abs(float(change[k]) - slope))
            else:
                other += 1
    if back < 2 or back < 4 * other:
        return
    period = float(np.median(sizes))
    # what wraps stays within one turn but for noise (six deviations are at most eight of its median
    # steps); a stretch that is shifted does not
    if span > period + 8.0 * float(np.median(np.abs(np.concatenate(changes)))):
        return
    turns = (360.0, math.tau, 1.0, *(2.0**b for b in range(8, 33)))
    period = next((turn for turn in turns if abs(period / turn - 1.0) < 0.02), period)
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
    if (copy := copied(data)) is not None:
        name = data.input_names[copy.input]
        after = "" if copy.delay == 0 else f" of {copy.delay} samples before"
        yield Fault(
            "no_dynamics",
            f"{y} is {name}{after} times {copy.gain:.6g}, exactly: there are no dynamics between "
            "the two, as one column was read twice or computed from the other",
            "name the column of a sensor as output",
            {"input": name, "gain": copy.gain, "offset": copy.offset, "delay": float(copy.delay)},
        )
        return
    if (sums := computed(data)) is not None:
        names = " and ".join(data.input_names)
        yield Fault(
            "no_dynamics",
            f"{'each change of ' if sums == 'change' else ''}{y} is a sum of {names} in the same "
            f"sample and in up to {PAST} before, to rounding: the column was computed from the "
            "other, as a mean, a difference or an integral is",
            "name the column of a sensor as output",
            {"input": names, "sums": sums},
        )
        return
    if (order := order_in_time(data)) is None:
        return
    name = data.input_names[order.input]
    u = labelled(name, data.input_units[order.input])
    evidence: dict[str, float | str] = {
        "input": name, "shift": float(order.shift), "log_likelihood": order.evidence,
    }  # fmt: skip
    shift = f"data.shift_inputs({order.shift}) (--shift-input {order.shift})"
    if order.kind == "exchanged":
        yield Fault(
            "exchanged",
            f"{u} answers {y}, and {data.output_name} does not answer {name}: input and output "
            "are exchanged",
            f"take {data.output_name} as input and {name} as output",
            evidence,
        )
    elif order.kind == "late":
        yield Fault(
            "late_input",
            f"{y} moves {order.shift - 1} sample{'s' if order.shift > 2 else ''} before {u} does: "
            f"{name} was logged {order.shift} samples late, counted to one sample from the command "
            "to the output; every delay and time constant would be wrong",
            f"read it earlier, {shift}",
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
    if (pole := unstable_pole(data)) is None:
        return
    y = labelled(data.output_name, data.output_unit)
    doubles = math.log(2.0) / math.log(pole) * data.Ts
    yield Fault(
        "unstable",
        f"{y} is that of an unstable plant in a closed loop: a pole at {pole:.5g}, so that it "
        f"doubles every {duration(doubles)} without its controller",
        'identify it one step ahead, with model="arx" and 8 or more orders (--model arx --na 8 '
        "--nb 8), and tune from the controller that holds it (--start); or name the loop's "
        "reference as input",
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
