"""The training region: the signals of a model's free run on its training data. The run
of an unstable model begins anew whenever it has doubled (`scored_runs`): its plant was held in a
loop.

A model is judged by the input and output of its free run, so that one measure serves every kind,
including ensembles. A sample lies outside if any of three distances exceeds 1:

- *nearest*: distance of the point (inputs, output, change of the output over a lag) to the nearest
  training point, over the radius. The output changes visibly over the lag, so that a short sample
  time does not make the change vanish. The radius is the distance that a tenth of the training
  record keeps from the other nine tenths, for the worst tenth of ten: a new stretch of the same
  excitation relates to the record as each tenth does to the others.
- *level*: the standard deviation of each signal within a window, over its largest value in the
  training data. A signal of twice the amplitude still crosses zero, and a Gaussian one is rarely
  where the training data have never been; how far it moves over some time reveals it. A level that
  is held, however long, is no larger signal. The window is the shortest one over which most of the
  training record, doubled in amplitude, would be outside.
- *peak*: the largest deviation within the last few lags, the time over which a sample affects the
  model.

For a model that integrates, such as that of a position, the point has no output: at rest an axis
is the same everywhere, and a record that goes back and forth never rests at its ends. Level and
peak bound its output like any other.

A two-level input makes the regressor's points degenerate (they lie on a few planes), and any
ellipsoid or whitening of them turns rounding into distance. Here nothing is whitened: every
coordinate is divided by half its own range.

How far a new stretch exceeds the bounds depends on the number of independent pieces in the record;
the margins below were set on PRBS, steps, multisines and chirps into lags of first and second
order, and are measured on others by tests/evidence/test_region.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from ..dataset import Dataset, FloatArray
from ..dynamic_model import INIT, DynamicModel
from ..validation import scored_runs

Signals: TypeAlias = tuple[FloatArray, FloatArray]
"""Inputs (N, nu) and output (N,) of one run."""

FORM = 2
"""Version of the stored values; version 1 whitened the model's own regressor or state."""
CENTRES = 300
_FARTHEST = 1000.0
"""Largest distance; squares of larger ones would swamp later values by rounding."""


_INPUT_PEAK, _OUTPUT = 1.3, 1.7
"""Factors on the largest peak of an input, and on the largest level and peak of the output."""
_SMALLEST = 1e-6
"""Least level, relative to the signal: an input that never moved is outside once it moves."""


@dataclass(frozen=True, eq=False)
class Region:
    """Balls of one radius about scaled centres.

    Attributes
    ----------
    mean, scale : array, shape (d,)
        The centres are in coordinates (point - mean) / scale.
    centres : array, shape (c, d)
    radius : float
    """

    mean: FloatArray
    scale: FloatArray
    centres: FloatArray
    radius: float

    @classmethod
    def of(cls, points: FloatArray, least_scale: FloatArray | None = None) -> Region:
        """The region of points, shape (N, d), in their order of time.

        Parameters
        ----------
        points : array, shape (N, d)
        least_scale : array, shape (d,), optional
            Lower bound of each coordinate's scale, which is half its range.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        mean = 0.5 * (low + high)
        scale = np.maximum(0.5 * (high - low), _SMALLEST * np.maximum(abs(low), abs(high)))
        if least_scale is not None:
            scale = np.maximum(scale, least_scale)
        scale = np.maximum(scale, 1e-12)
        kept = ((points - mean) / scale)[:: max(1, len(points) // 4000)]
        centres, covered = _spread_out(kept)
        # least radius, as a part of half a range: a twentieth of the range is no new region
        radius = max(0.1, _between_tenths(kept)) + covered
        return cls(mean, scale, centres, radius)

    @np.errstate(over="ignore")
    def distance(self, points: FloatArray) -> FloatArray:
        """Scaled distance of points (N, d) to the nearest centre, shape (N,)."""
        return _nearest((points - self.mean) / self.scale, self.centres)

    def to_json(self) -> dict[str, Any]:
        """As JSON values, rounded to significant digits."""
        return {
            "mean": _short(self.mean, 7),
            "scale": _short(self.scale, 7),
            "centres": _short(self.centres, 4),
            "radius": self.radius,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Region:
        """What `to_json` gave.

        Raises
        ------
        ValueError
            If the values are of another form.
        """
        mean, scale, centres = (_array(values, k) for k in ("mean", "scale", "centres"))
        sound = mean.ndim == 1 and mean.shape == scale.shape and bool((scale > 0.0).all())
        if not sound or centres.shape[1:] != mean.shape or not len(centres):
            raise ValueError(
                f"expected mean and scale of shape (d,) and centres (c, d), received {mean.shape}, "
                f"{scale.shape} and {centres.shape}"
            )
        return cls(mean, scale, centres, _positive(values, "radius"))


@dataclass(frozen=True, eq=False)
class TrainingRegion:
    """The region of a model's training data. `nearest` is the region of the points (inputs, output,
    change of the output over `lag`), without the output for a model that integrates. `centre`
    (nu + 1,) holds the means of the inputs and the output; `peak` (nu + 1,) bounds the
    distance from them, `level` the standard deviation within the window. `lag` and
    `window` are in samples.
    """

    nearest: Region
    centre: FloatArray
    level: FloatArray
    peak: FloatArray
    lag: int
    window: int

    @classmethod
    def of(cls, runs: Sequence[Signals], *, integrates: bool = False) -> TrainingRegion:
        """The region of runs on training data: inputs (N, nu) and output (N,) of each experiment.
        With `integrates` all rest positions of the model are equivalent.
        """
        lag = max(1, int(np.median([_lag(y) for _, y in runs])))
        points = np.concatenate([_points(u, y, lag, integrates) for u, y in runs])
        signals = [np.column_stack(run) for run in runs]
        together = np.concatenate(signals)
        centre = together.mean(axis=0)
        # a change that is small compared with the output itself is no new region
        floor = np.zeros(points.shape[1])
        floor[-1] = 0.1 * 0.5 * float(np.ptp(together[:, -1]))
        largest = np.maximum(
            np.abs(together - centre).max(axis=0), _SMALLEST * np.abs(together).max(axis=0)
        )
        largest = np.maximum(largest, 1e-12)
        factors = np.full(len(centre), _INPUT_PEAK)
        factors[-1] = _OUTPUT
        peak = factors * largest
        window, level = _window(signals, centre, peak, lag)
        return cls(Region.of(points, floor), centre, level, peak, lag, window)

    def distances(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """Distance of every sample of a run, relative to the bounds: above 1 is outside.
        `u` is (N, nu) and `y` (N,); the distances (N,) are at most 1000.
        """
        y = np.nan_to_num(y, nan=1e300, posinf=1e300, neginf=-1e300)
        points = _points(u, y, self.lag, self.integrates)
        near = self.nearest.distance(points) / self.nearest.radius
        signals = np.column_stack([u, y]) - self.centre
        size = _size(signals, self.level, self.peak, self.lag, self.window)
        return np.minimum(np.maximum(near, size), _FARTHEST)

    def holds(self, u: FloatArray, y: float) -> bool:
        """Whether a steady state with inputs (nu,) and output is near the training data."""
        if not (np.isfinite(u).all() and np.isfinite(y)):
            return False
        point = np.concatenate([u, [0.0] if self.integrates else [y, 0.0]])
        return bool(self.nearest.distance(point[None])[0] <= self.nearest.radius)

    @property
    def integrates(self) -> bool:
        """Whether the points have no output coordinate."""
        return len(self.nearest.mean) == len(self.centre)

    @property
    def n_inputs(self) -> int:
        return len(self.centre) - 1

    def to_json(self) -> dict[str, Any]:
        return {
            "form": FORM,
            "lag": self.lag,
            "window": self.window,
            **{k: _short(getattr(self, k), 7) for k in ("centre", "level", "peak")},
            "nearest": self.nearest.to_json(),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TrainingRegion:
        """What `to_json` gave. Raises `ValueError` for another form, such as an older version's."""
        nearest = values.get("nearest")
        if values.get("form") != FORM or not isinstance(nearest, Mapping):
            raise ValueError(f"expected a region of form {FORM}, received {values.get('form')!r}")
        inner = Region.from_json(nearest)
        centre, level, peak = (_array(values, k) for k in ("centre", "level", "peak"))
        lag, window = (int(_positive(values, k)) for k in ("lag", "window"))
        shapes = {centre.shape, level.shape, peak.shape}
        ragged = len(shapes) != 1 or len(inner.mean) - len(centre) not in (0, 1)
        if ragged or not ((level > 0.0) & (peak > 0.0)).all():
            raise ValueError(
                f"expected centre, level and peak of one shape, with {len(inner.mean)} or one less "
                f"for the coordinates of a point, received {shapes}"
            )
        return cls(inner, centre, level, peak, max(lag, 1), max(window, 1))


def training_region(model: DynamicModel, data: Dataset) -> dict[str, Any]:
    return _region(model, data).to_json()


def _region(model: DynamicModel, data: Dataset) -> TrainingRegion:
    from .operating import integrating_pole

    runs = _runs(model, data, INIT)
    return TrainingRegion.of(runs, integrates=integrating_pole(model) is not None)


def stored_region(model: DynamicModel) -> TrainingRegion | None:
    """The region stored with the model; None if there is none, or it is unreadable."""
    values = model.training.get("region")
    if not isinstance(values, Mapping):
        return None
    try:
        region = TrainingRegion.from_json(values)
    except ValueError:
        return None
    return region if region.n_inputs == len(model.input_names) else None


@dataclass(frozen=True, eq=False)
class RegionRuns:
    """Free runs, as inputs (N, nu) and simulated output (N,) of each experiment, and their
    distances (N,) from the training region, relative to its bounds: above 1 is outside.
    """

    region: TrainingRegion
    runs: list[Signals]

    @cached_property
    def distances(self) -> list[FloatArray]:
        return [self.region.distances(u, y) for u, y in self.runs]


def region_runs(
    model: DynamicModel, data: Dataset, training: Dataset | None = None, init: int = INIT
) -> RegionRuns | None:
    """Free runs in the region of the training data if given, else in the stored one.
    None if there is neither.
    """
    if training is not None:
        known: TrainingRegion | None = _region(model, training)
    else:
        known = stored_region(model)
    return None if known is None else RegionRuns(known, _runs(model, data, init))


def _runs(model: DynamicModel, data: Dataset, init: int) -> list[Signals]:
    simulated = scored_runs(model, data, init)
    return [(e.u, yhat) for e, yhat in zip(data.experiments, simulated, strict=True)]


# --- the nearest training point -------------------------------------------------------------------


def _points(u: FloatArray, y: FloatArray, lag: int, integrates: bool) -> FloatArray:
    """Inputs, output (unless the model integrates) and its change over the lag, (N, nu + 2)."""
    change = np.zeros(len(y))
    if len(y) > 1:
        lag = min(lag, len(y) - 1)
        change[lag:] = y[lag:] - y[:-lag]
        change[:lag] = change[lag]
    return np.column_stack([u, change] if integrates else [u, y, change])


def _lag(y: FloatArray) -> int:
    """Samples over which the output changes visibly, up to a twentieth of the record."""
    variance = float(y.var())
    lag = 1
    while lag < len(y) // 20:
        # mean square change over the lag, relative to the variance: a correlation of three quarters
        if np.mean(np.square(y[lag:] - y[:-lag])) > 0.5 * variance:
            break
        lag = max(lag + 1, int(1.3 * lag))
    return lag


def _spread_out(points: FloatArray) -> tuple[FloatArray, float]:
    """Up to `CENTRES` points by greedy k-centre (Gonzalez 1985), and the largest distance left."""
    chosen = [int(np.argmin(np.square(points).sum(axis=1)))]
    nearest = np.square(points - points[chosen[0]]).sum(axis=1)
    while len(chosen) < CENTRES:
        farthest = int(np.argmax(nearest))
        if nearest[farthest] <= 1e-4:
            break
        chosen.append(farthest)
        np.minimum(nearest, np.square(points - points[farthest]).sum(axis=1), out=nearest)
    return points[chosen], float(np.sqrt(nearest.max()))


def _between_tenths(points: FloatArray) -> float:
    """Distance of 98 % of a tenth of the points from the other nine, for the worst tenth."""
    tenths = 10
    if len(points) < 2 * tenths:
        return 0.0
    tenth = np.arange(len(points)) * tenths // len(points)
    found = [_nearest(points[tenth == i], points[tenth != i]) for i in range(tenths)]
    # share of the points of a tenth that lie within its distance from the other tenths
    return float(max(np.quantile(d, 0.98) for d in found))


def _nearest(points: FloatArray, centres: FloatArray) -> FloatArray:
    """Distance of every point (N, d) to the nearest centre (c, d), shape (N,)."""
    block = 4096
    bounded = np.clip(np.nan_to_num(points), -_FARTHEST, _FARTHEST)
    square = np.square(centres).sum(axis=1)
    found = np.empty(len(points))
    for a in range(0, len(points), block):
        part = bounded[a : a + block]
        cross = (square - 2.0 * part @ centres.T).min(axis=1)
        found[a : a + block] = np.square(part).sum(axis=1) + cross
    return np.sqrt(np.maximum(found, 0.0))


# --- level and peak -------------------------------------------------------------------------------


def _window(
    signals: Sequence[FloatArray], centre: FloatArray, peak: FloatArray, lag: int
) -> tuple[int, FloatArray]:
    """The shortest window, with the level's bounds, that has doubled inputs outside."""
    # factor on the largest training level of an input, and an addition for few windows
    input_level, few_windows = 1.2, 0.2
    n = sum(map(len, signals))
    whole = np.sqrt(sum(np.square(x - centre).sum(axis=0) for x in signals) / n)
    # least number of windows in the record
    window, largest = max(4, 2 * lag), max(4, 2 * lag, n // 6)
    best: tuple[float, int, FloatArray] | None = None
    while True:
        swing = np.max([_swing(x - centre, window).max(axis=0) for x in signals], axis=0)
        factors = np.full(len(centre), input_level + few_windows * np.sqrt(window / n))
        factors[-1] = _OUTPUT
        # factor on the level of the whole record, if that gives more: half way to the double, in dB
        level = np.maximum(np.maximum(factors * swing, 1.4 * whole), _SMALLEST * peak)
        doubled = (
            np.concatenate(
                [_size(d[:, :-1], level[:-1], peak[:-1], lag, window) > 1.0 for d in bigger]
            )
            for bigger in (
                [2.0 * x - centre for x in signals],
                [2.0 * (x - centre) for x in signals],
            )
        )
        seen = min(float(d.mean()) for d in doubled)
        if best is None or seen > best[0]:
            best = seen, window, level
        # share of the training record, doubled in amplitude, that must lie outside with the window
        if seen >= 0.85 or window >= largest:
            return best[1], best[2]
        window = min(int(1.4 * window) + 1, largest)


def _size(
    signals: FloatArray, level: FloatArray, peak: FloatArray, lag: int, window: int
) -> FloatArray:
    """Largest of swing and peak of the deviations (N, m), relative to their bounds, (N,)."""
    bound = _FARTHEST * np.minimum(level, peak)
    signals = np.clip(signals, -bound, bound)
    swing = (_swing(signals, window) / level).max(axis=1)
    peaks = _largest((np.abs(signals) / peak).max(axis=1), min(window, max(4, 3 * lag)))
    size: FloatArray = np.maximum(swing, peaks)
    return size


def _rms(signals: FloatArray, window: int) -> FloatArray:
    """Moving rms of each column; the first samples have the value of the first whole window."""
    window = min(window, len(signals))
    sums = np.cumsum(np.square(signals), axis=0)
    sums[window:] -= sums[:-window].copy()
    sums[: window - 1] = sums[window - 1]
    rms: FloatArray = np.sqrt(np.maximum(sums, 0.0) / window)
    return rms


def _swing(signals: FloatArray, window: int) -> FloatArray:
    """Moving standard deviation of each column, as `_rms`."""
    window = min(window, len(signals))
    sums = np.cumsum(signals, axis=0)
    sums[window:] -= sums[:-window].copy()
    sums[: window - 1] = sums[window - 1]
    swing: FloatArray = np.sqrt(np.maximum(_rms(signals, window) ** 2 - (sums / window) ** 2, 0.0))
    return swing


def _largest(values: FloatArray, window: int) -> FloatArray:
    """Moving maximum, (N,), by doubling spans; the first samples as in the first window."""
    window = min(window, len(values))
    found: FloatArray = values.copy()
    span = 1
    while span < window:
        step = min(span, window - span)
        found[step:] = np.maximum(found[step:], found[:-step])
        span += step
    found[: window - 1] = found[window - 1]
    return found


# --- as JSON --------------------------------------------------------------------------------------


def _short(values: FloatArray, digits: int) -> Any:
    """Values rounded to so many digits: the region is not known to the last bit."""
    rounded = [float(f"{v:.{digits - 1}e}") for v in values.ravel()]
    return np.array(rounded).reshape(values.shape).tolist()


def _array(values: Mapping[str, Any], name: str) -> FloatArray:
    try:
        found = np.array(values[name], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as e:
        raise ValueError(f"{name}: expected numbers: {e}") from e
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: expected finite numbers")
    return found


def _positive(values: Mapping[str, Any], name: str) -> float:
    found = _array(values, name)
    if found.ndim or not found > 0.0:
        raise ValueError(f"{name}: expected a number above 0, received {found}")
    return float(found)
