"""The training region: where in regressor or state space a model has been, and what lies outside.

The training data's points are whitened and covered by balls about up to 200 of themselves (the
greedy k-centre of Gonzalez 1985); what 99.5 % of the training points keep from their nearest
centre is the radius, or what 98 % of them keep from the centres of other parts of the record where
that is more. A point farther than that from every centre is outside: no training sample was like
it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..dataset import Dataset, FloatArray
from ..models.base import INIT, Model
from .residuals import representative

CENTRES = 200
LARGEST_DIMENSION = 8
_SMALLEST_VARIANCE = 1e-8
_LEAST_SPREAD = 0.1
"""Deviations smaller than a tenth of a variable's own spread are no new region.

Between one sample and the next of a fast record there is less; any new rate would be far away.
"""
_MOST_POINTS = 20_000
_BLOCK = 4096
_TENTHS = 10
_FARTHEST = 1e60


@dataclass(frozen=True, eq=False)
class Region:
    """Balls of one radius about whitened centres.

    Attributes
    ----------
    mean : array, shape (d0,)
    turn : array, shape (d0, d)
        (point - mean) @ turn is whitened.
    centres : array, shape (c, d)
    radius : float
    """

    mean: FloatArray
    turn: FloatArray
    centres: FloatArray
    radius: float

    @classmethod
    def of(cls, points: FloatArray) -> Region:
        """The region of points, shape (N, d0), in their order of time."""
        mean, turn = _whitening(points)
        every = max(1, len(points) // _MOST_POINTS)
        centres = _spread_out(((points - mean) @ turn)[::every])
        region = cls(mean, turn, centres, 0.0)
        covering = float(np.quantile(region.distance(points), 0.995))
        radius = max(covering, _cross_radius(region, points[::every]))
        return cls(mean, turn, centres, radius * (1.0 + 1e-6) + 1e-9)

    def distance(self, points: FloatArray) -> FloatArray:
        """Whitened distance of points (N, d0) to the nearest centre, shape (N,)."""
        return np.concatenate([np.sqrt(d.min(axis=1)) for d in self._squares(points)])

    def _squares(self, points: FloatArray) -> Iterator[FloatArray]:
        """Squared distances (n, c) of a block of points after the other to all centres."""
        # a run that leaves the world is far away, and no overflow
        bounded = np.clip(np.nan_to_num(points), -_FARTHEST, _FARTHEST)
        white = np.clip((bounded - self.mean) @ self.turn, -_FARTHEST, _FARTHEST)
        centres = np.square(self.centres).sum(axis=1)
        for a in range(0, len(white), _BLOCK):
            part = white[a : a + _BLOCK]
            cross = centres - 2.0 * part @ self.centres.T
            yield np.maximum(np.square(part).sum(axis=1)[:, None] + cross, 0.0)

    def to_json(self) -> dict[str, Any]:
        """As JSON values with the digits that matter."""
        return {
            "mean": _short(self.mean),
            "turn": _short(self.turn),
            "centres": _short(self.centres),
            "radius": self.radius,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Region:
        """What `to_json` gave.

        Raises
        ------
        ValueError
            Where the values are of another form.
        """
        try:
            mean, turn, centres = (
                np.array(values[k], dtype=np.float64) for k in ("mean", "turn", "centres")
            )
            region = cls(mean, turn.reshape(len(mean), -1), centres, float(values["radius"]))
        except (KeyError, TypeError, ValueError) as e:
            raise ValueError(f"expected mean, turn, centres and radius: {e}") from e
        sizes = region.turn.shape[1], region.centres.shape[-1]
        if centres.ndim != 2 or sizes[0] != sizes[1] or not np.isfinite(region.radius):
            raise ValueError(
                f"expected centres as wide as turn, received {sizes[1]} and {sizes[0]}"
            )
        return region


def training_region(model: Model, data: Dataset) -> dict[str, Any]:
    """The region that a model passes through on its training data, for its `training["region"]`."""
    return Region.of(np.concatenate(points(model, data))).to_json()


def stored_region(model: Model) -> Region | None:
    """The region stored with the model; None where there is none that can be read."""
    values = model.training.get("region")
    if not isinstance(values, Mapping):
        return None
    try:
        return Region.from_json(values)
    except ValueError:
        return None


@dataclass(frozen=True, eq=False)
class Place:
    """Where a free run goes, seen from the training region.

    Attributes
    ----------
    points : arrays, shape (N, d0), one per experiment
    distances : arrays, shape (N,)
        To the nearest known point, over the region's radius.
    """

    region: Region
    points: list[FloatArray]

    @cached_property
    def distances(self) -> list[FloatArray]:
        radius = max(self.region.radius, 1e-300)
        return [self.region.distance(p) / radius for p in self.points]


def placed(
    model: Model, data: Dataset, training: Dataset | None = None, init: int = INIT
) -> Place | None:
    """In the region stored with the model, or that of the training data where they are given.

    None where there is neither.
    """
    known = stored_region(model)
    if training is not None:
        known = Region.from_json(training_region(model, training))
    if known is None:
        return None
    where = points(model, data, init)
    return Place(known, where) if where[0].shape[1] == len(known.mean) else None


def points(model: Model, data: Dataset, init: int = INIT) -> list[FloatArray]:
    """Where the model is at every sample in free run, one array (N, d0) per experiment.

    State and input for a state-space model, simulated regressor for the others.
    """
    single = representative(model)
    found = []
    for e, yhat in zip(data.experiments, model.simulate(data, init=init), strict=True):
        states = getattr(single.core, "states", None)
        if states is not None:
            inputs = _late(e.u, single.orders["nk"])
            found.append(np.column_stack([states(e.u, single.initial_state(e, init)), inputs]))
        else:
            found.append(_regressors(e.u, yhat, single.orders))
    return found


def _regressors(u: FloatArray, yhat: FloatArray, orders: Mapping[str, int]) -> FloatArray:
    past = [_late(yhat, i) for i in range(1, orders["na"] + 1)]
    past += [_late(u, orders["nk"] + i) for i in range(orders["nb"])]
    return np.column_stack(past)


def _late(x: FloatArray, lag: int) -> FloatArray:
    late: FloatArray = x[np.maximum(np.arange(len(x)) - lag, 0)]
    return late


def _whitening(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and the turn to unit covariance over the directions that vary."""
    mean = points.mean(axis=0)
    scale = points.std(axis=0)
    scale[scale <= 1e-12 * np.maximum(np.abs(mean), 1e-300)] = np.inf
    scaled = (points - mean) / scale
    sizes, vectors = np.linalg.eigh(scaled.T @ scaled / len(points))
    kept = np.flatnonzero(sizes > _SMALLEST_VARIANCE * max(sizes[-1], 1e-300))[-LARGEST_DIMENSION:]
    spread = np.sqrt(np.maximum(sizes[kept], _LEAST_SPREAD**2))
    return mean, (vectors[:, kept] / spread) / scale[:, None]


def _spread_out(points: FloatArray) -> FloatArray:
    """Up to `CENTRES` of the points, each the farthest from those before it."""
    chosen = [int(np.argmin(np.square(points).sum(axis=1)))]
    nearest = np.square(points - points[chosen[0]]).sum(axis=1)
    while len(chosen) < CENTRES:
        farthest = int(np.argmax(nearest))
        if nearest[farthest] <= 1e-12:
            break
        chosen.append(farthest)
        np.minimum(nearest, np.square(points - points[farthest]).sum(axis=1), out=nearest)
    centres: FloatArray = points[chosen]
    return centres


def _cross_radius(region: Region, points: FloatArray) -> float:
    """What 98 % of the points keep from the centres of the other half of the tenths of the record.

    Without it every new record would seem to leave the region a little, as no two are the same.
    """
    if len(points) < 2 * _TENTHS:
        return 0.0
    half = np.arange(len(points)) * _TENTHS // len(points) % 2 == 0
    white = (points - region.mean) @ region.turn
    distances = [
        replace(region, centres=_spread_out(white[one])).distance(points[~one])
        for one in (half, ~half)
    ]
    return float(np.quantile(np.concatenate(distances), 0.98))


def _short(values: FloatArray) -> Any:
    """Seven digits: the region is a judgement, its last bits are not."""
    rounded = [float(f"{v:.6e}") for v in values.ravel()]
    return np.array(rounded).reshape(values.shape).tolist()
