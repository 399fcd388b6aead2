"""Frequency responses of any record by local polynomials, without window or periods.

`rust/core/src/local_polynomial.rs` computes them, and has the derivation.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray
from ..dataset import Dataset, Experiment
from ..errors import DataError, SettingError
from ..readers import parse_source, read_table
from ..readers.recording import smoothed_by
from ..recording import Recording
from ..speed import speed_from_counts
from .estimate import record_of, spectral
from .response import FrequencyResponse


def local_polynomial(
    u: ArrayLike, y: ArrayLike, *, Ts: float, r: ArrayLike | None = None, **labels: Any
) -> FrequencyResponse:
    """Response from any record, without the leakage of its beginning and end.

    Parameters
    ----------
    u, y : array, shape (N,)
        Input and output; the machine can be in motion at the start and at the end.
    Ts : float
        Sample time [s].
    r : array, shape (N,), optional
        Reference of a closed loop around the plant, or any signal that moves u and is independent
        of the noise. Output and input are each related to it, and their quotient is the plant.
    labels
        `u_unit`, `y_unit`, `from_counts`, `provenance` of the result.

    Returns
    -------
    FrequencyResponse
        Frequencies are denser where the response changes faster; `blocks` has a value for each.

    Raises
    ------
    DataError
        For other shapes, values that are not finite, fewer than 52 samples, an input that does not
        move, or a reference that is unrelated to it.
    """
    # least samples: lines for two intervals
    samples = 52
    signals = record_of(u, y, r)
    n = len(signals[0])
    if n < samples:
        raise DataError(
            name="u", expected=f"at least {samples} samples", received=str(n),
            remedy="record longer",
        )  # fmt: skip
    found = _core.record_response(*signals, *([None] if r is None else []))
    if found is None:
        raise DataError(
            name="u" if r is None else "r", expected="power at three frequencies or more",
            received="one that hardly moves", remedy="excite more frequencies",
        )  # fmt: skip
    lines, value, variance, coherence, blocks, is_related = found
    if not is_related:
        raise DataError(
            name="r", expected="a reference that moves u",
            received="one that has nothing to do with it",
            remedy="name the column that the controller follows",
        )  # fmt: skip
    return FrequencyResponse(
        lines / (n * Ts), value, variance, coherence, blocks, float(Ts), **labels
    )


# --- The response of a recording or a data set, with cautions about parts that are not linear -----


RecordMethod: TypeAlias = Literal["segments", "local"]

LEAST_RUN = 3
"""Equal samples in a row at the largest or smallest value that count as a command at a limit."""


def of_record(
    on: Recording | Dataset, reference: str | None, method: str | None, segment: int | None
) -> FrequencyResponse:
    if method not in (None, *get_args(RecordMethod)):
        raise SettingError(
            name="method", expected=" or ".join(get_args(RecordMethod)), received=repr(method)
        )
    if method == "local" and segment is not None:
        raise SettingError(
            name="segment", expected="none with the method local", received=repr(segment),
            remedy="leave it out: how many frequencies belong together is found for each",
        )  # fmt: skip
    if isinstance(on, Recording):
        u, r = on.u, None
        y = speed_from_counts(on.counts, on.Ts, on.counts_per_rev, method="difference")
        if reference is not None:
            raise SettingError(
                name="reference", expected="none for a recording of a command",
                received=repr(reference), remedy="a data set names its columns",
            )  # fmt: skip
        labels = {"u_unit": "V", "y_unit": "RPM", "from_counts": True}
        name = on.name
    else:
        one = _one_of(on)
        u, y, r, name = one.u[:, 0], one.y, None, one.name
        if reference is not None:
            if reference not in one.channels:
                raise SettingError(
                    name="reference",
                    expected=f"one of {', '.join(one.channels) or 'no columns'}",
                    received=repr(reference),
                )  # fmt: skip
            r = one.channels[reference]
        labels = {
            "u_unit": on.input_units[0], "y_unit": on.output_unit,
            "from_counts": on.counts is not None,
        }  # fmt: skip
    provenance = {"recording": name, **_cautions(u, y, on.Ts, is_speed=labels["y_unit"] == "RPM")}
    if method == "local":
        return local_polynomial(u, y, Ts=on.Ts, r=r, provenance=provenance, **labels)
    return spectral(u, y, Ts=on.Ts, r=r, segment=segment, provenance=provenance, **labels)


def _one_of(on: Dataset) -> Experiment:
    if len(on.experiments) != 1 or len(on.input_names) != 1:
        raise DataError(
            name="data", expected="one record with one input",
            received=f"{len(on.experiments)} with {len(on.input_names)}",
            remedy="take one by data[k] and data.select(input)",
        )  # fmt: skip
    if on.looks_ahead:
        raise DataError(
            name="data", expected="an output as it was measured",
            received="a speed that was smoothed with samples after it, which hides the delay",
            remedy="take bode(recording), unsmoothed(file, data), or a speed by "
                'method="difference" (--counts, --counts-per-rev)',
        )  # fmt: skip
    return on.experiments[0]


def _cautions(u: FloatArray, y: FloatArray, Ts: float, *, is_speed: bool) -> dict[str, Any]:
    """Cautions about parts of a record that a linear response does not describe."""
    found = []
    at = _limited(np.asarray(u, dtype=np.float64))
    if len(at):
        found.append(
            f"u rests at its largest or smallest value in {len(at)} samples, the first at "
            f"{at[0] * Ts:.4g} s: if it was limited after it was recorded, the response is wrong"
        )
    k = max(1, round(0.02 / Ts))
    if is_speed and len(y) >= k and np.isfinite(y).all():
        means = np.convolve(y, np.ones(k) / k, "valid")
        # a mean speed over 20 ms in the opposite direction counts as a reversal from this share of
        # the largest speed on
        back = np.flatnonzero(means * np.sign(means.sum()) < -0.02 * np.abs(means).max())
        if len(back):
            found.append(
                f"the speed changes its sign, first at {back[0] * Ts:.4g} s: there friction acts "
                "like a step, and the response is that of a mean over both directions"
            )
    if len(y) >= LEAST_RUN and np.isfinite(y).all():
        later = y[len(y) // 2 :]
        # percentiles of the second half of a record; one that begins outside them has a run-up
        low, high = np.percentile(later, (1.0, 99.0))
        ends = np.flatnonzero((y >= low) & (y <= high))
        if not low <= y[: k + 1].mean() <= high and len(ends):
            found.append(
                f"the record begins away from where it works later, which it reaches at "
                f"{ends[0] * Ts:.4g} s: its lowest frequencies are those of the run-up; cut it off"
            )
    return {"cautions": found} if found else {}


def _limited(u: FloatArray) -> Any:
    """Samples at which a command rests at an extreme, unless it is a staircase anyway."""
    if len(u) < LEAST_RUN or not np.isfinite(u).all():
        return np.zeros(0, dtype=np.intp)
    extreme = (u == u.max()) | (u == u.min())
    edges = np.diff(np.concatenate([[0], extreme.astype(np.intp), [0]]))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    long = stops - starts >= LEAST_RUN
    moves = np.mean(np.diff(u)[~extreme[1:]] != 0.0) if not extreme[1:].all() else 0.0
    # least share of the other samples that differ from the one before; a staircase has fewer
    if not long.any() or moves < 0.9:
        return np.zeros(0, dtype=np.intp)
    return np.concatenate([np.arange(a, b) for a, b in zip(starts[long], stops[long], strict=True)])


def unsmoothed(source: str | os.PathLike[str], data: Dataset) -> Dataset:
    """The same record with the difference of counts as its speed, for `bode`.

    A speed estimated with the help of later counts hides the delay. Data whose output was measured
    are returned as they are; so is a speed that another tool has smoothed, which `bode` refuses.

    Parameters
    ----------
    source : path
        The recording that the data were read from; columns after a colon as on the command line.
    data : Dataset

    Raises
    ------
    DataError
        For a record in pieces.
    """
    if not data.looks_ahead:
        return data
    table = read_table(parse_source(os.fspath(source))[0])
    one = data.experiments[0]
    if data.counts is None:
        slope = smoothed_by(table, data.output_name)
        if slope is None or not _is_part(one.y, table[data.output_name]):
            return data
        y = slope * np.diff(table["counts"], prepend=table["counts"][:1])
        y[np.isnan(one.y)] = np.nan
    else:
        column, per_rev = data.counts
        counts = table[column]
        if len(data.experiments) > 1 or len(counts) != len(one.y):
            raise DataError(
                name=str(source), expected="one even record without gaps, not shifted or cut",
                received=f"{len(data.experiments)} pieces, {len(one.y):,} of {len(counts):,} rows",
                remedy="cut one out",
            )  # fmt: skip
        y = speed_from_counts(counts, data.Ts, per_rev, method="difference")
    return replace(data, experiments=(replace(one, y=y),), looks_ahead=False)


def _is_part(y: FloatArray, column: FloatArray) -> bool:
    """Whether an output is a column as it was read, but for what was left out."""
    return len(y) == len(column) and bool(np.all((y == column) | np.isnan(y)))
