"""Frequency responses of any record by local polynomials, without window or periods.

The spectra of a finite record are related, at the line k of its transform, by

    Y(k) = G(k) U(k) + T(k) + V(k)

T is leakage: the transient at the beginning of the record minus the one at its end. It is as smooth
over the frequency as G, so over a few lines both are parabolas, found by least squares; the
residuals are noise, and give the variance (Pintelon and Schoukens 2012, section 7.2). A window only
reduces the leakage, and smears resonances. The leakage expected in an interval is learned from all
the others.

The remaining question is the number of lines. The lines are divided into intervals: starting from
wide ones, an interval is halved, and its halves again, if Akaike's criterion, corrected for few
lines, prefers two parabolas to one (Hurvich and Tsai, Biometrika 76, 1989). Around a resonance the
intervals become narrow; where the response is smooth they stay wide, and average more. Each is read
at the three Gauss points, where a parabola's error from a smooth curve is least; under even power
the three errors are independent.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray
from ..dataset import Dataset, Experiment
from ..errors import DataError, SettingError
from ..readers import parse_source, read_table
from ..recording import Recording
from ..speed import speed_from_counts
from .estimate import record_of, spectral
from .response import LEVEL, Complex, FrequencyResponse

LINES = 13
"""Least lines of an interval: seven more than the coefficients of the two parabolas."""
WIDEST = 0.25
"""Largest width of an interval, relative to its first frequency."""
NARROWEST = 0.006
"""Width, relative to its frequency, below which an interval is not halved: fine enough for a
damping of .003, while the time for long records stays that of their transform."""
SAMPLES = 4 * LINES
RANK = 1e-9
"""Diagonal element of R, relative to the largest, below which a column adds nothing."""
ROUNDING = 1e-13
"""Magnitude, relative to the largest line, below which a line counts as empty."""
FLOOR = 1e-24
"""Mean square of the residual that cannot be distinguished from rounding."""
GAUSS = np.array([-math.sqrt(0.6), 0.0, math.sqrt(0.6)])
CHANCE = 3.0
"""Standard deviations above chance by which a reference must be visible in the input."""


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
    signals = record_of(u, y, r)
    n = len(signals[0])
    if n < SAMPLES:
        raise DataError(
            name="u", expected=f"at least {SAMPLES} samples", received=str(n),
            remedy="record longer",
        )  # fmt: skip
    largest = [max(float(np.abs(s).max()), 1e-300) for s in signals]
    spectra = np.stack(
        [
            np.fft.rfft((s - s.mean()) / top)[1 : (n + 1) // 2]
            for s, top in zip(signals, largest, strict=True)
        ]
    )
    # lines at the level of rounding have no power
    size = np.abs(spectra)
    spectra[size < ROUNDING * size.max(axis=1, keepdims=True)] = 0.0
    by = 0 if r is None else 2
    outputs = np.ascontiguousarray(spectra[[1] if r is None else [1, 0]].T)
    pieces = list(_divided(spectra[by], outputs))
    if not pieces:
        raise DataError(
            name="u" if r is None else "r", expected="power at three frequencies or more",
            received="one that hardly moves", remedy="excite more frequencies",
        )  # fmt: skip
    if r is not None:
        _require_related(pieces)
    leakage = _leakage(pieces)
    pieces = [_shrunk(piece, spectra[by], outputs, leakage) for piece in pieces]
    seen = [piece.response() for piece in pieces]
    value: Complex = np.concatenate([part[0] for part in seen])
    place, variance, coherence = (np.concatenate([part[k] for part in seen]) for k in (1, 2, 3))
    blocks = np.repeat([piece.freedom + 1.0 for piece in pieces], len(GAUSS))
    scale = largest[1] / largest[0]
    known = np.isfinite(value * scale) & np.isfinite(variance * scale**2)
    return FrequencyResponse(
        place[known] / (n * Ts), value[known] * scale,
        np.maximum(variance[known] * scale**2, 1e-300), coherence[known], blocks[known],
        float(Ts), **labels,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Piece:
    """Two parabolas over the lines from index `start` to before `stop`.

    Attributes
    ----------
    solution : array of complex, shape (6, m)
        Coefficients for each of m outputs: first of the response to the input over `scale`, then of
        the leakage.
    inverse : array of complex, shape (6, 6)
        Inverse of the triangular factor R of the regressors.
    products : array of complex, shape (m, m)
        Sums of conj(e_i) e_j over the residuals of the outputs.
    power : float
        Mean squared magnitude of u.
    output : array, shape (m,)
        Mean squared magnitude of each output.
    """

    start: int
    stop: int
    scale: float
    solution: Complex
    inverse: Complex
    products: Complex
    power: float
    output: FloatArray

    @property
    def freedom(self) -> int:
        """Complex degrees of freedom left after fitting two parabolas."""
        return self.stop - self.start - 6

    @property
    def ratio(self) -> FloatArray:
        """Variance of the noise over the power, for each output."""
        found: FloatArray = np.diag(self.products).real / self.freedom / self.output
        return found

    @cached_property
    def criterion(self) -> float:
        """Akaike's corrected criterion; real and imaginary part of a line are two observations.
        Outputs count as independent: in a loop they share one noise, with a determinant of 0.
        """
        n, k = 2 * (self.stop - self.start), 2 * len(self.solution)
        size = 2.0 * np.diag(self.products).real / n + FLOOR
        return float(n * np.log(size).sum() + len(size) * n * (n + k) / (n - k - 2))

    @property
    def places(self) -> FloatArray:
        """Line numbers at its Gauss points, in general between two lines."""
        return 1.0 + self.start + 0.5 * (1.0 + GAUSS) * (self.stop - self.start - 1)

    def gains(self) -> tuple[Complex, FloatArray]:
        """Gains of the outputs, shape (3, m), and their variance under unit noise, shape (3,)."""
        powers = GAUSS[:, None] ** np.arange(3)
        spread = (np.abs(powers @ self.inverse[:3]) ** 2).sum(axis=1)
        return powers @ self.solution[:3] / self.scale, spread / self.scale**2

    def response(self) -> tuple[Complex, FloatArray, FloatArray, FloatArray]:
        """Output over input, number of the line, variance, coherence."""
        gains, spread = self.gains()
        C = self.products / self.freedom
        if C.shape == (1, 1):
            value, per = gains[:, 0], np.ones(len(gains))
            noise = np.full(len(gains), C[0, 0].real)
        else:
            # residual of the output minus the response times that of the input: the loop's noise
            value, per = gains[:, 0] / gains[:, 1], np.abs(gains[:, 1]) ** 2
            noise = C[0, 0].real - 2.0 * (value * C[0, 1]).real + np.abs(value) ** 2 * C[1, 1].real
            noise = np.maximum(noise, 0.0)
        # an uncertain response must not appear large: subtract the contribution of its error
        explained = np.maximum(np.abs(value) ** 2 - noise * spread / per, 0.0) * self.power
        share = explained / np.maximum(explained + noise, 1e-300)
        return value, self.places, noise * spread / per, share


def _divided(source: Complex, outputs: Complex) -> Iterator[_Piece]:
    """The intervals, from the lowest line upwards."""
    start, lines = 0, len(source)
    while lines - start >= LINES:
        width = max(LINES, int(WIDEST * (start + 1)))
        piece = None
        # a sparse multisine has no power in a few lines
        while piece is None and width < 2 * lines:
            stop = start + width
            stop = lines if lines - stop < LINES else stop
            piece, width = _piece(source, outputs, start, stop), 2 * width
        if piece is None:
            return
        yield from _best(source, outputs, piece)[1]
        start = piece.stop


def _best(source: Complex, outputs: Complex, piece: _Piece) -> tuple[float, list[_Piece]]:
    """The piece itself, or the best of its halves if these have the lower criterion."""
    length = piece.stop - piece.start
    if length < max(2 * LINES, NARROWEST * piece.start):
        return piece.criterion, [piece]
    middle = piece.start + length // 2
    halves = [
        _piece(source, outputs, piece.start, middle),
        _piece(source, outputs, middle, piece.stop),
    ]
    if any(half is None for half in halves):
        return piece.criterion, [piece]
    parts = [_best(source, outputs, half) for half in halves if half is not None]
    together = sum(criterion for criterion, _ in parts)
    if together < piece.criterion:
        return together, [p for _, found in parts for p in found]
    return piece.criterion, [piece]


def _piece(source: Complex, outputs: Complex, start: int, stop: int) -> _Piece | None:
    """Fit one interval; None if the input has too little power there."""
    part, seen = source[start:stop], outputs[start:stop]
    scale = float(np.abs(part).max())
    if scale == 0.0:
        return None
    Q, R = np.linalg.qr(_regressors(part / scale))
    diagonal = np.abs(np.diag(R))
    k = int(np.argmin(np.append(diagonal > RANK * diagonal.max(), False)))
    if k < 3:
        return None
    inverse = np.linalg.inv(R[:k, :k])
    turned = Q[:, :k].conj().T @ seen
    left = seen - Q[:, :k] @ turned
    own = part if seen.shape[1] == 1 else seen[:, 1]
    return _Piece(
        start, stop, scale, inverse @ turned, inverse, left.conj().T @ left,
        float(np.mean(np.abs(own) ** 2)), np.mean(np.abs(seen) ** 2, axis=0),
    )  # fmt: skip


def _regressors(source: Complex) -> Complex:
    """Parabolas times the input, and parabolas, shape (lines, 6)."""
    x = np.linspace(-1.0, 1.0, len(source))
    powers = np.stack([np.ones_like(x), x, x * x], axis=1)
    return np.hstack([powers * source[:, None], powers])


def _leakage(pieces: list[_Piece]) -> FloatArray:
    """Mean squares of the leakage's three coefficients over the outputs' power, shape (3,), from
    the half of the intervals that determine them best.
    """
    full = [piece for piece in pieces if len(piece.solution) == 6]
    if not full:
        return np.zeros(3)
    share = np.array([np.mean(np.abs(p.solution[3:]) ** 2 / p.output, axis=1) for p in full])
    doubt = np.array([(np.abs(p.inverse[3:]) ** 2).sum(axis=1) * p.ratio.mean() for p in full])
    clear = doubt <= np.median(doubt, axis=0)
    found: FloatArray = np.maximum(np.where(clear, share - doubt, 0.0).sum(axis=0), 0.0)
    found /= clear.sum(axis=0)
    return found


def _shrunk(piece: _Piece, source: Complex, outputs: Complex, leakage: FloatArray) -> _Piece:
    """The piece refitted with a prior on its leakage, from its size in other intervals.
    The prior adds three observations of 0 with that variance. If the command's own spectrum is
    smooth, as that of a chirp near its start, response and leakage cannot be separated otherwise.
    """
    kept = leakage > 0.0
    columns = np.flatnonzero(np.append([True] * 3, kept))
    observed = np.zeros((kept.sum(), len(columns)))
    observed[:, 3:] = np.diag(np.sqrt(piece.ratio.min() / leakage[kept]))
    lines = slice(piece.start, piece.stop)
    regressors = _regressors(source[lines] / piece.scale)[:, columns]
    Q, R = np.linalg.qr(np.vstack([regressors, observed]))
    inverse = np.linalg.inv(R)
    turned = Q[: len(regressors)].conj().T @ outputs[lines]
    return replace(piece, solution=inverse @ turned, inverse=inverse)


def _require_related(pieces: list[_Piece]) -> None:
    """Refuse a reference that is visible in the input no more than by chance."""
    seen = []
    for piece in pieces:
        gains, spread = piece.gains()
        nu = piece.freedom
        noise = piece.products[1, 1].real / nu
        quantile = nu * ((1.0 - LEVEL) ** (-1.0 / nu) - 1.0)
        seen += (np.abs(gains[:, 1]) ** 2 > quantile * noise * spread).tolist()
    chance = 1.0 - LEVEL
    if np.mean(seen) < chance + CHANCE * math.sqrt(chance * LEVEL / len(seen)):
        raise DataError(
            name="r", expected="a reference that moves u",
            received="one that has nothing to do with it",
            remedy="name the column that the controller follows",
        )  # fmt: skip


# --- The response of a recording or a data set, with cautions about parts that are not linear -----


RecordMethod: TypeAlias = Literal["segments", "local"]

LEAST_RUN = 3
"""Equal samples in a row at the largest or smallest value that count as a command at a limit."""
MOVES = 0.9
"""Least share of the other samples that differ from the one before; a staircase has fewer."""
REVERSED = 0.02
"""A mean speed over 20 ms in the opposite direction counts as a reversal from this share of the
largest speed on."""
MEAN = 0.02
OUTSIDE = 1.0, 99.0
"""Percentiles of the second half of a record; one that begins outside them has a run-up."""


def of_record(
    on: Recording | Dataset, reference: str | None, method: str | None, segment: int | None
) -> FrequencyResponse:
    """`bode` of a record, with the same arguments."""
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
            remedy="take bode(recording), or a speed by method=\"difference\"",
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
    k = max(1, round(MEAN / Ts))
    if is_speed and len(y) >= k and np.isfinite(y).all():
        means = np.convolve(y, np.ones(k) / k, "valid")
        back = np.flatnonzero(means * np.sign(means.sum()) < -REVERSED * np.abs(means).max())
        if len(back):
            found.append(
                f"the speed changes its sign, first at {back[0] * Ts:.4g} s: there friction acts "
                "like a step, and the response is that of a mean over both directions"
            )
    if len(y) >= LEAST_RUN and np.isfinite(y).all():
        later = y[len(y) // 2 :]
        low, high = np.percentile(later, OUTSIDE)
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
    if not long.any() or moves < MOVES:
        return np.zeros(0, dtype=np.intp)
    return np.concatenate([np.arange(a, b) for a, b in zip(starts[long], stops[long], strict=True)])


def unsmoothed(source: str | os.PathLike[str], data: Dataset) -> Dataset:
    """The same record with the difference of counts as its speed, for `bode`.

    A speed estimated with the help of later counts hides the delay.

    Parameters
    ----------
    source : path
        The recording that the data were read from; columns after a colon as on the command line.
    data : Dataset
        A data set with a speed from counts.

    Raises
    ------
    DataError
        For a record in pieces.
    """
    assert data.counts is not None
    column, per_rev = data.counts
    counts = read_table(parse_source(os.fspath(source))[0])[column]
    one = data.experiments[0]
    if len(data.experiments) > 1 or len(counts) != len(one.y):
        raise DataError(
            name=str(source), expected="one even record without gaps",
            received=f"{len(data.experiments)} pieces", remedy="cut one out",
        )  # fmt: skip
    y = speed_from_counts(counts, data.Ts, per_rev, method="difference")
    return replace(data, experiments=(replace(one, y=y),), looks_ahead=False)
