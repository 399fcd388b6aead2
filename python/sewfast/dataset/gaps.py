"""Missing samples: outputs taken out of the score, inputs filled by a stated assumption."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, frozen, runs
from ..errors import DataError, SettingError
from .pieces import range_of_text

if TYPE_CHECKING:
    from .dataset import Dataset
    from .experiment import Experiment

BoolArray: TypeAlias = NDArray[np.bool_]
Where: TypeAlias = "str | Sequence[BoolArray] | BoolArray | Callable[[Experiment], BoolArray]"


def mask(data: Dataset, where: Where, *, why: str = "masked") -> Dataset:
    """The data with NaN in the output where `where` says so: these samples lose their weight.

    Inputs and channels stay: a model still runs through such samples, it is not scored there.

    Parameters
    ----------
    where : str, array of bool, sequence of arrays of bool, or callable
        A range `"A:B"` of every experiment (0-based, end excluded); a mask of shape (N,), one per
        experiment where there are several, True where the output is to be forgotten; or a function
        from an experiment to its mask.
    why : str
        What the note says.

    Raises
    ------
    DataError
        Where a mask has not the experiment's length or is not of bool, or a range leaves an
        experiment.
    SettingError
        Where the text is not a range.
    """
    masks = _masks(data, where)
    experiments, notes = [], []
    for e, forgotten in zip(data.experiments, masks, strict=True):
        taken = forgotten & ~np.isnan(e.y)
        experiments.append(replace(e, y=frozen(np.where(forgotten, np.nan, e.y))))
        if taken.any():
            notes.append(f"{e.name} [{e.range_text}]: {int(taken.sum())} outputs {why}")
    return replace(data, experiments=tuple(experiments), notes=(*data.notes, *notes))


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
        Where an experiment begins with an unknown input: nothing is known to hold.
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
                    f"{e.name}: input {name!r} is not known at its first {length} samples, so "
                    f"there is nothing to hold; begin later: data[{length}:]"
                )
            column[start : start + length] = column[start - 1]
        if gaps:
            notes.append(
                f"{e.name} [{e.range_text}]: {sum(n for _, n in gaps)} missing values of input "
                f"{name!r} in {len(gaps)} gaps (the longest {max(n for _, n in gaps)}) are taken "
                "to be the last known value, held"
            )
    return replace(e, u=frozen(u))


def interpolated(column: FloatArray) -> FloatArray:
    """The column with straight lines over its gaps; level beyond its ends."""
    known = np.isfinite(column)
    index = np.arange(len(column), dtype=np.float64)
    return np.interp(index, index[known], column[known])
