"""`Experiment`: the samples of one run, and how much each of them counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import FloatArray, as_column, as_float, as_inputs, frozen
from ..errors import DataError

if TYPE_CHECKING:
    from .dataset import Dataset
    from .trends import Trend


def as_weights(values: ArrayLike, n: int) -> FloatArray:
    """Weights (N,), finite and 0 or more."""
    weights = as_float(values, "weights")
    if weights.shape != (n,):
        raise DataError(
            f"weights: expected shape ({n},), one for each sample, received {weights.shape}; cut "
            "them to the same range as the output"
        )
    wrong = ~(np.isfinite(weights) & (weights >= 0.0))
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(
            f"weights: expected finite numbers of 0 or more, received {weights[k]} at sample {k} "
            "(0-based); 0 leaves a sample out, 1 counts it in full"
        )
    return weights


def require_some_weight(e: Experiment) -> None:
    """Raise `DataError` where every measured sample of an experiment has weight 0."""
    if e.weights is None:
        return
    measured = ~np.isnan(e.y)
    if not e.weights[measured if measured.any() else slice(None)].any():
        raise DataError(
            f"{e.name} [{e.range_text}], weights: every measured sample has weight 0; expected one "
            "that counts: give it a weight above 0, or leave this experiment out"
        )


def weights_of(e: Experiment) -> FloatArray:
    """The weights of an experiment, ones where it has none, shape (N,)."""
    return np.ones(len(e)) if e.weights is None else e.weights


def mean_square(squares: FloatArray, weights: FloatArray) -> float:
    """Weighted mean of squared errors, both (N,); those that are NaN do not count."""
    counting = weights[~np.isnan(squares)]
    return float(np.nanmean(weights * squares) / np.mean(counting))


def without_weightless(e: Experiment) -> Experiment:
    """The experiment with samples of weight 0 marked as not measured."""
    if e.weights is None or e.weights.all():
        return e
    return replace(e, y=frozen(np.where(e.weights == 0.0, np.nan, e.y)))


def in_effect(data: Dataset) -> Dataset:
    """The data as fits and scores use them. Samples of weight 0 count as not measured. Only ratios
    of the other weights matter: equal weights are dropped, others are scaled to a largest one of 1.
    """
    if all(e.weights is None for e in data.experiments):
        return data
    for e in data.experiments:
        require_some_weight(e)
    measured = [weights_of(e)[~np.isnan(e.y)] for e in data.experiments]
    high = max((float(w.max()) for w in measured if len(w)), default=1.0)
    experiments, notes = [], []
    for given in data.experiments:
        weights = np.minimum(weights_of(given) / high, 1.0)
        e = without_weightless(replace(given, weights=frozen(weights)))
        require_some_weight(e)
        experiments.append(e)
        taken = e.unmeasured - given.unmeasured
        if taken:
            note = f"{taken} outputs of weight 0 count as not measured"
            notes.append(f"{e.name} [{e.range_text}]: {note}")
    counting = np.concatenate([weights_of(e)[~np.isnan(e.y)] for e in experiments])
    if (counting == 1.0).all():
        experiments = [replace(e, weights=None) for e in experiments]
    else:
        notes.append(f"samples weigh {counting.min():.3g} to 1")
    return replace(data, experiments=tuple(experiments), notes=(*data.notes, *notes))


# --- Experiment: columns of one run ---------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Experiment:
    """One uninterrupted recording.

    Parameters
    ----------
    u : array, shape (N, n_inputs) or (N,)
        Inputs; `u[k]` is held from sample k to k + 1.
    y : array, shape (N,)
        Output, measured before `u[k]` acts. NaN marks samples that were not measured.
    channels : mapping of name to array of shape (N,)
        Further columns for plots and scores (the true speed of a virtual machine, say).
    name : str
        Its origin, for messages.
    start : int
        Index of its first sample in the recording from which it was cut.
    removed : Trend or None
        The trend removed by `Dataset.detrend`; `Dataset.restore` adds it again.
    weights : array, shape (N,), or None
        How much the squared error of each sample counts in `identify` and `validate`: finite, 0 or
        more, not all 0. A sample of weight 0 counts as not measured wherever a model is fitted,
        scored or checked, or starts from. None: all equal. Statistics, pictures and preparation
        ignore weights; only `resample` and `differentiate`, which mix neighbours, omit samples of
        weight 0.

    Raises
    ------
    DataError
        If shapes disagree, nothing is left, or the values are not real numbers.
    """

    u: FloatArray
    y: FloatArray
    channels: Mapping[str, FloatArray] = field(default_factory=dict)
    name: str = "array"
    start: int = 0
    removed: Trend | None = None
    weights: FloatArray | None = None

    def __post_init__(self) -> None:
        y = as_column(self.y, "y")
        if len(y) == 0:
            raise DataError(f"{self.name}: expected at least 1 sample, received none")
        channels = {key: as_column(v, key, len(y)) for key, v in self.channels.items()}
        object.__setattr__(self, "y", y)
        object.__setattr__(self, "u", as_inputs(self.u, len(y)))
        object.__setattr__(self, "channels", MappingProxyType(channels))
        if self.weights is not None:
            object.__setattr__(self, "weights", as_weights(self.weights, len(y)))

    def __len__(self) -> int:
        return len(self.y)

    def __repr__(self) -> str:
        return f"Experiment({self.name!r}, {self.range_text}, {self.u.shape[1]} input(s))"

    def __reduce__(self) -> tuple[Any, ...]:
        # a mappingproxy cannot be pickled
        values = (self.u, self.y, dict(self.channels), self.name, self.start, self.removed)
        return Experiment, (*values, self.weights)

    @property
    def range_text(self) -> str:
        """Its place in the recording, as `A:B`."""
        return f"{self.start}:{self.start + len(self)}"

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Where inputs and output are finite, shape (N,)."""
        known: NDArray[np.bool_] = np.isfinite(self.y)
        return known & self.known_inputs

    @property
    def known_inputs(self) -> NDArray[np.bool_]:
        """Where every input is finite, shape (N,)."""
        known: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(self.u), axis=1)
        return known

    @property
    def counted(self) -> str:
        """How many samples were measured, for messages: `97`, or `97 (3 more not measured)`."""
        missing = self.unmeasured
        return f"{len(self) - missing}" + (f" ({missing} more not measured)" if missing else "")

    @property
    def unmeasured(self) -> int:
        """Samples whose output is NaN."""
        return int(np.isnan(self.y).sum())

    def initial_samples(self, init: int) -> int:
        """Number of first samples that contain `init` measured outputs; `init` if none is missing.

        Raises
        ------
        DataError
            If fewer than `init` were measured.
        """
        known = np.flatnonzero(~np.isnan(self.y[:init]))
        if len(known) < init:
            known = np.flatnonzero(~np.isnan(self.y))
        if len(known) < init:
            raise DataError(
                f"{self.name}: expected at least init = {init} samples to start from, received "
                f"{self.counted}; lower init (--init), 0 to start from rest, or give a longer range"
            )
        return int(known[init - 1]) + 1 if init else 0

    def cut(self, start: int, stop: int) -> Experiment:
        """Samples `start` to `stop`, end excluded, as views.

        Raises
        ------
        DataError
            If the range leaves the experiment or is empty.
        """
        if not 0 <= start < stop <= len(self):
            raise DataError(
                f"{self.name}: expected a range inside 0:{len(self)} with at least one sample, "
                f"received {start}:{stop}"
            )
        channels = {key: v[start:stop] for key, v in self.channels.items()}
        return Experiment(
            self.u[start:stop],
            self.y[start:stop],
            channels,
            self.name,
            self.start + start,
            self.removed,
            None if self.weights is None else self.weights[start:stop],
        )
