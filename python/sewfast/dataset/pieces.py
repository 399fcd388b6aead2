"""Checks of a data set before it is used, and parts of it."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, frozen, is_whole, range_of, require_same_units, runs
from ..errors import DataError, SettingError

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment

# --- Checks of a data set before it is used -------------------------------------------------------


INPUT_REMEDY = (
    "a simulation needs every input: choose a range without it, take the pieces between, "
    "Dataset.split_at_gaps (--split-at-gaps), or take the one last known, "
    'Dataset.fill_inputs("hold") (--hold-inputs)'
)
OUTPUT_REMEDY = (
    "repair it, choose a range without it, or take the pieces between, "
    "Dataset.split_at_gaps (--split-at-gaps)"
)


def require_dataset(data: object, what: str) -> None:
    """Raise a `DataError` that says how to make a `Dataset` if `data` is none."""
    from .dataset import Dataset

    if not isinstance(data, Dataset):
        raise DataError(
            f"{what}: expected a Dataset, received {type(data).__name__}; make one with "
            "sewfast.read or Dataset.from_arrays"
        )


def require_alike(data: Dataset, other: Dataset) -> None:
    """Raise `DataError` if two data sets cannot be joined: inputs, units, sample time (1 %)."""
    if data.n_inputs != other.n_inputs:
        raise DataError(
            f"expected {data.n_inputs} inputs, as in {data.source}, received {other.n_inputs} "
            f"in {other.source}"
        )
    require_same_units(data, other)
    if abs(data.Ts - other.Ts) > 0.01 * data.Ts:
        raise DataError(
            f"expected one sample time: {data.Ts} s in {data.source}, received {other.Ts} s in "
            f"{other.source}; resample one of them"
        )


def require_inputs(data: Dataset) -> None:
    """Raise `DataError` that names the first input value that is not finite."""
    for e in data.experiments:
        for name, column in zip(data.input_names, e.u.T, strict=True):
            require_finite(column, f"{e.name}, input {name!r}", e.start, INPUT_REMEDY)


def require_measured(data: Dataset, least: int = 1) -> None:
    """Raise `DataError` unless every input is known and enough outputs were measured.
    An output that is NaN was not measured and is no error; an infinite one is. Every experiment
    must have at least `least` measured outputs.
    """
    require_inputs(data)
    for e in data.experiments:
        what = f"{e.name} [{e.range_text}], output {data.output_name!r}"
        if np.isinf(e.y).any():
            k = int(np.argmax(np.isinf(e.y)))
            raise DataError(
                f"{what}: expected finite values, or NaN where it was not measured, received "
                f"{e.y[k]} at sample {e.start + k} (0-based); set it to NaN: Dataset.mask"
            )
        measured = len(e) - e.unmeasured
        if measured == 0 < least:
            raise DataError(f"{what}: every value is NaN; expected a measured column")
        if measured < least:
            raise DataError(
                f"{what}: expected at least {least} samples, received {e.counted}; "
                "leave this experiment out, or record again"
            )


def require_complete(data: Dataset) -> None:
    """Raise `DataError` that names the first input or output value that is not finite."""
    require_inputs(data)
    for e in data.experiments:
        require_finite(e.y, f"{e.name}, output {data.output_name!r}", e.start, OUTPUT_REMEDY)


LARGEST = 1e150
"""Magnitude from which on squares overflow; no measured quantity is as large."""
LARGEST_FITTED, SMALLEST_FITTED = 1e60, 1e-60
"""Magnitude and range between which covariances and their inverses do not overflow."""


def require_sane(data: Dataset, largest: float = LARGEST) -> None:
    """Raise `DataError` if a value is infinite or beyond any measured quantity; NaN is allowed."""
    for e in data.experiments:
        columns = zip((*data.input_names, data.output_name), (*e.u.T, e.y), strict=True)
        for name, column in columns:
            bad = np.abs(column) >= largest
            if bad.any():
                k = int(np.argmax(bad))
                raise DataError(
                    f"{e.name}, {name!r}: expected finite values below {largest:g}, or NaN where "
                    f"nothing is known, received {column[k]:g} at sample {e.start + k} (0-based); "
                    "set it to NaN (of an output: Dataset.mask), or change the unit"
                )


def require_excited(data: Dataset) -> None:
    """Raise `DataError` if an input or the output never moves: there is nothing to identify."""
    for i, name in enumerate(data.input_names):
        if all(np.min(e.u[:, i]) == np.max(e.u[:, i]) for e in data.experiments):
            raise DataError(
                f"{data.source}: input {name!r} is constant at {data.experiments[0].u[0, i]:g}; "
                "expected an input that moves; record with an excitation (`sewfast signals`)"
            )
    ranges = [range_of(e.y) for e in data.experiments]
    if not any(low < high for low, high in ranges):
        raise DataError(
            f"{data.source}: output {data.output_name!r} is constant at {ranges[0][0]:g}; expected "
            "an output that follows the input; check the column and the sensor"
        )


def require_fittable(data: Dataset) -> None:
    """Raise `DataError` if squares overflow; `require_measured` comes first."""
    require_sane(data, LARGEST_FITTED)
    columns = [*np.concatenate([e.u for e in data.experiments]).T]
    columns.append(np.concatenate([e.y for e in data.experiments]))
    for name, column in zip((*data.input_names, data.output_name), columns, strict=True):
        low, high = range_of(column)
        if high - low < SMALLEST_FITTED:
            raise DataError(
                f"{data.source}, {name!r}: expected values that differ by {SMALLEST_FITTED:g} or "
                f"more, received {low:g} to {high:g}; change the unit, or check the column"
            )


def require_finite(column: FloatArray, what: str, start: int, remedy: str) -> None:
    """Raise `DataError` that names the first value that is not finite."""
    bad = ~np.isfinite(column)
    if not bad.any():
        return
    if bad.all():
        raise DataError(f"{what}: every value is NaN or infinite; expected a measured column")
    k = int(np.argmax(bad))
    raise DataError(
        f"{what}: expected finite values, received {column[k]} at sample {start + k} (0-based; "
        f"{int(bad.sum())} such in {len(column)} samples); {remedy}"
    )


# --- Parts of a data set: ranges, fractions, pieces between gaps ----------------------------------


SHORTEST_PIECE = 100
"""Shortest piece between two gaps that `Dataset.split_at_gaps` keeps, in samples."""


def take(data: Dataset, text: str) -> Dataset:
    """`"A:B"` of every experiment, 0-based, end excluded; A or B can be left out."""
    pieces = (e.cut(*range_of_text(text, e)) for e in data.experiments)
    return replace(data, experiments=tuple(pieces))


def range_of_text(text: str, e: Experiment) -> tuple[int, int]:
    """First sample and end of `"A:B"` in an experiment; refuses as `Dataset.slice` does."""
    match = re.fullmatch(r"\s*(\d*)\s*:\s*(\d*)\s*", text)
    if match is None:
        raise SettingError(
            f"expected a range A:B, 0-based, end excluded, such as 0:400; received {text!r}"
        )
    start, stop = int(match[1] or 0), int(match[2]) if match[2] else len(e)
    if not 0 <= start < stop <= len(e):
        raise DataError(
            f"{e.name}: expected a range inside 0:{len(e)} with at least one sample, received "
            f"{start}:{stop}"
        )
    return start, stop


def split(
    data: Dataset,
    *fractions: float,
    at: Sequence[float] | None = None,
    by: Literal["samples", "experiments"] = "samples",
) -> tuple[Dataset, ...]:
    """Parts in their order: by fractions, at times, or whole experiments.

    Parameters
    ----------
    *fractions : float
        Of each part but the last, which is the rest: `split(0.6, 0.2)` gives three parts.
    at : sequence of float or None
        Instead of fractions, where to cut [s] from the first sample of each experiment.
    by : {"samples", "experiments"}
        Whether every experiment is cut, or whole experiments go to the parts. Neighbouring samples
        are alike, so whole experiments make the stronger test.

    Raises
    ------
    SettingError
        If a fraction is not between 0 and 1, they leave no rest, times do not increase, or both
        or none are given.
    DataError
        If an experiment is too short to leave samples in every part, or there are fewer
        experiments than parts.
    """
    if by not in ("samples", "experiments"):
        raise SettingError(f"by: expected 'samples' or 'experiments', received {by!r}")
    if (at is None) != bool(fractions) or (at is not None and by == "experiments"):
        raise SettingError(
            "split: expected fractions, such as split(0.7), or times, such as split(at=[10.0]); "
            f"received {fractions} and at={at}, by={by!r}"
        )
    ends = _ends(fractions) if at is None else _times(at)
    if by == "experiments":
        return _whole_experiments(data, ends)
    scale = [float(len(e)) if at is None else 1.0 / data.Ts for e in data.experiments]
    edges = [
        [0, *(round(end * s) for end in ends), len(e)]
        for e, s in zip(data.experiments, scale, strict=True)
    ]
    parts = range(len(ends) + 1)
    return tuple(
        replace(
            data,
            experiments=tuple(
                e.cut(k[i], k[i + 1]) for e, k in zip(data.experiments, edges, strict=True)
            ),
        )
        for i in parts
    )


def _ends(fractions: Sequence[float]) -> list[float]:
    for fraction in fractions:
        number = isinstance(fraction, (int, float, np.number)) and not isinstance(fraction, bool)
        if not (number and 0.0 < fraction < 1.0):
            raise SettingError(f"expected a fraction between 0 and 1, received {fraction!r}")
    ends = np.cumsum(fractions)
    if ends[-1] > 1.0 - 1e-9:
        raise SettingError(f"expected fractions that leave a rest, received a sum of {ends[-1]:g}")
    return [float(end) for end in ends]


def _times(at: Sequence[float]) -> list[float]:
    times = np.asarray(at)
    sound = times.ndim == 1 and times.dtype.kind in "iuf" and len(times) > 0
    if not (sound and np.isfinite(times).all() and (np.diff(times, prepend=0.0) > 0.0).all()):
        raise SettingError(f"at: expected increasing times [s] above 0, received {at!r}")
    return [float(t) for t in times]


def _whole_experiments(data: Dataset, ends: list[float]) -> tuple[Dataset, ...]:
    total = len(data.experiments)
    edges = [0, *(round(end * total) for end in ends), total]
    if any(a >= b for a, b in itertools.pairwise(edges)):
        raise DataError(
            f"{data.source}: expected experiments for {len(ends) + 1} parts, received {total}; "
            "record more, or split by samples"
        )
    return tuple(
        replace(data, experiments=data.experiments[a:b]) for a, b in itertools.pairwise(edges)
    )


def split_at_gaps(
    data: Dataset, shortest: int = SHORTEST_PIECE, *, of: Literal["any", "inputs"] = "any"
) -> Dataset:
    """The pieces without NaN between the gaps, each as a separate experiment.

    Only a gap in an input needs this: models run through gaps in the output, which have no weight.

    Parameters
    ----------
    shortest : int
        Least samples of a piece; shorter ones are left out, with a note. The
        initial state alone takes 20.
    of : {"any", "inputs"}
        Whether a gap in the output splits an experiment, or only one in an input.

    Raises
    ------
    SettingError
        If `shortest` is no whole number above 0, or `of` is neither of the two.
    DataError
        If no piece is left.
    """
    if isinstance(shortest, bool) or not isinstance(shortest, int) or shortest < 1:
        raise SettingError(f"shortest: expected a number of samples above 0, got {shortest!r}")
    if of not in ("any", "inputs"):
        raise SettingError(f"of: expected 'any' or 'inputs', received {of!r}")
    pieces = [
        (e, a, n)
        for e in data.experiments
        for a, n in runs(e.measured if of == "any" else e.known_inputs)
    ]
    kept = tuple(e.cut(a, a + n) for e, a, n in pieces if n >= shortest)
    if not kept:
        longest = max((n for _, _, n in pieces), default=0)
        raise DataError(
            f"{data.source}: expected a piece of at least {shortest} samples without a gap, "
            f"received {longest} at most; record again, or lower `shortest`"
        )
    dropped = tuple(
        f"{e.name}: samples {e.start + a}:{e.start + a + n} between gaps are left out, fewer "
        f"than {shortest}"
        for e, a, n in pieces
        if n < shortest
    )
    return replace(data, experiments=kept, notes=(*data.notes, *dropped))


BLOCKS, SHORTEST = 4, 40
"""Blocks of an experiment that is thinned, and samples of one at least."""


def thinned(data: Dataset, samples: int) -> Dataset:
    """Blocks spread over every experiment: a chirp is a different signal at its end."""
    if len(data) <= samples:
        return data
    share = samples / len(data)
    pieces = (piece for e in data.experiments for piece in _blocks(e, round(share * len(e))))
    return replace(data, experiments=tuple(pieces))


def _blocks(e: Experiment, samples: int) -> list[Experiment]:
    length = max(SHORTEST, samples // BLOCKS)
    if BLOCKS * length >= len(e):
        return [e]
    starts = (round(i * (len(e) - length) / (BLOCKS - 1)) for i in range(BLOCKS))
    blocks = [e.cut(a, a + length) for a in starts]
    return [b for b in blocks if len(b) - b.unmeasured > SHORTEST // 2]


# --- Missing samples: outputs without weight, inputs filled by a stated assumption ----------------


BoolArray: TypeAlias = NDArray[np.bool_]
Where: TypeAlias = "str | Sequence[BoolArray] | BoolArray | Callable[[Experiment], BoolArray]"


def mask(data: Dataset, where: Where, *, why: str = "masked") -> Dataset:
    """The data with NaN in the output wherever `where` selects a sample: it then has no weight.

    Inputs and channels stay: a model still runs through such samples but is not scored there.

    Parameters
    ----------
    where : str, array of bool, sequence of arrays of bool, or callable
        A range `"A:B"` of every experiment (0-based, end excluded); a mask of shape (N,), one per
        experiment if there are several, True where the output is to be ignored; or a function from
        an experiment to its mask.
    why : str
        Reason given in the note.

    Raises
    ------
    DataError
        If a mask has not the experiment's length or is not of bool, or a range leaves an
        experiment.
    SettingError
        If the text is not a range.
    """
    masks = _masks(data, where)
    experiments, notes = [], []
    for e, forgotten in zip(data.experiments, masks, strict=True):
        taken = forgotten & ~np.isnan(e.y)
        experiments.append(replace(e, y=frozen(np.where(forgotten, np.nan, e.y))))
        if taken.any():
            notes.append(f"{e.name} [{e.range_text}]: {int(taken.sum())} outputs {why}")
    return replace(data, experiments=tuple(experiments), notes=(*data.notes, *notes))


def shift_inputs(data: Dataset, samples: int) -> Dataset:
    """The data with inputs read `samples` earlier, for a command that was logged late.
    `u(k + samples)` takes the place of `u(k)`; outputs and channels stay. The last samples of every
    experiment, for which no input is left, are cut off. Negative numbers read the inputs later, and
    cut off the first samples. Raises `SettingError` if an experiment has no more samples than that.
    """
    shortest = min(map(len, data.experiments))
    if not (is_whole(samples) and abs(samples) < shortest):
        raise SettingError(
            f"shift_inputs: expected a whole number of samples below {shortest}, the length of the "
            f"record, received {samples!r}"
        )
    if samples == 0:
        return data
    first, last = max(0, -samples), max(0, samples)
    experiments = []
    for e in data.experiments:
        kept = e.cut(first, len(e) - last)
        u = e.u[first + samples : len(e) - last + samples]
        experiments.append(replace(kept, u=u))
    note = f"inputs read {abs(samples)} sample(s) {'earlier' if samples > 0 else 'later'}"
    return replace(data, experiments=tuple(experiments), notes=(*data.notes, note))


def _masks(data: Dataset, where: Where) -> list[BoolArray]:
    if isinstance(where, str):
        return [_range_mask(e, where) for e in data.experiments]
    if callable(where):
        where = [where(e) for e in data.experiments]
    elif isinstance(where, np.ndarray) and where.ndim == 1 and where.dtype != object:
        where = [where]
    if len(where) != len(data.experiments):
        raise DataError(
            f"mask: expected {len(data.experiments)} masks, one per experiment, received "
            f"{len(where)}; give a list of masks, or a function of the experiment"
        )
    return [_checked(e, m) for e, m in zip(data.experiments, where, strict=True)]


def _range_mask(e: Experiment, text: str) -> BoolArray:
    start, stop = range_of_text(text, e)
    forgotten = np.zeros(len(e), dtype=np.bool_)
    forgotten[start:stop] = True
    return forgotten


def _checked(e: Experiment, values: BoolArray) -> BoolArray:
    array = np.asarray(values)
    if array.dtype != np.bool_ or array.shape != (len(e),):
        raise DataError(
            f"{e.name}: expected a mask of {len(e)} truth values, shape ({len(e)},), received "
            f"{array.dtype} of shape {array.shape}; compare something: np.abs(e.y) > 100"
        )
    return array


def fill_inputs(data: Dataset, method: str = "hold", *, longest: int | None = None) -> Dataset:
    """The data with the gaps in the inputs filled, by an assumption that the notes state.

    Parameters
    ----------
    method : {"hold"}
        `hold` assumes that an input stayed at its last known value until the next known one: true
        of a command whose repetitions were not recorded, false of a measured signal that moved.
    longest : int or None
        Longer gaps [samples] are left for `split_at_gaps(of="inputs")`. None fills all.

    Raises
    ------
    SettingError
        For another method, or a length that is no whole number above 0.
    DataError
        If an experiment begins with an unknown input: nothing is known to hold.
    """
    if method != "hold":
        raise SettingError(f"fill_inputs: expected the method 'hold', received {method!r}")
    if longest is not None and (isinstance(longest, bool) or not isinstance(longest, int)):
        raise SettingError(f"longest: expected a number of samples, received {longest!r}")
    if longest is not None and longest < 1:
        raise SettingError(f"longest: expected 1 sample or more, received {longest}")
    notes: list[str] = []
    filled = [_held(e, data.input_names, longest, notes) for e in data.experiments]
    return replace(data, experiments=tuple(filled), notes=(*data.notes, *notes))


def _held(
    e: Experiment, names: tuple[str, ...], longest: int | None, notes: list[str]
) -> Experiment:
    if e.known_inputs.all():
        return e
    u = e.u.copy()
    for name, column in zip(names, u.T, strict=True):
        gaps = [g for g in runs(~np.isfinite(column)) if longest is None or g[1] <= longest]
        for start, length in gaps:
            if start == 0:
                raise DataError(
                    name=f"{e.name}: input {name!r}",
                    expected="a value before the first gap to hold",
                    received=f"none in the first {length} samples",
                    remedy=f"begin later: data[{length}:]",
                )  # fmt: skip
            column[start : start + length] = column[start - 1]
        if gaps:
            notes.append(
                f"{e.name} [{e.range_text}]: {sum(n for _, n in gaps)} missing values of input "
                f"{name!r} in {len(gaps)} gaps (the longest {max(n for _, n in gaps)}) are taken "
                "to be the last known value, held"
            )
    return replace(e, u=frozen(u))
