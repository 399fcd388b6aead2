"""Simulation bands: the range about a free run in which a measured sample is expected.

The half width at sample k is a quantile of e/s times s(k), s(k)^2 = sigma^2 + |Psi(k) F|^2: the
spread of the residual plus the contribution of the parameters' uncertainty (delta method, with the
sandwich covariance P = FF', which allows for coloured residuals). For an ensemble the spread of its
members replaces the second part. The quantiles are those of residuals on left-out data: every tenth
of the training data is left out in turn, to first order (Cook and Weisberg 1982), so that neither
normality nor a perfect model is assumed (CV+ and normalised conformal bands: Barber et al. 2021,
Lei et al. 2018). Outside the training region s grows in proportion to the distance, up to ten
times.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real
from statistics import NormalDist
from typing import Any

import numpy as np

from ..arrays import gram
from ..dataset import Dataset, FloatArray
from ..dynamic_model import INIT, DynamicModel
from ..errors import FitError, SettingError
from .parameters import Information, Parameters, estimate
from .region import RegionRuns, region_runs
from .residuals import Residuals

LEVEL = 0.95
BLOCKS = 10


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Distribution of the distance of measured samples from a model's free run.
    `spread` is the standard deviation s of the residual [output unit]; `factor` F (p, r) gives the
    significant part FF' of the parameters' covariance, r = 0 for an ensemble. `probabilities` and
    `quantiles` (q,) are the distribution of e/s.
    """

    spread: float
    factor: FloatArray
    probabilities: FloatArray
    quantiles: FloatArray
    samples: int

    def quantile(self, probability: float) -> float:
        """Quantile of e/s, interpolated on the scale of a normal variable."""
        normal = NormalDist().inv_cdf
        at = [normal(float(p)) for p in self.probabilities]
        return float(np.interp(normal(probability), at, self.quantiles))

    def to_json(self) -> dict[str, Any]:
        return {
            "spread": self.spread,
            "factor": [[float(f"{v:.6e}") for v in row] for row in self.factor],
            "probabilities": self.probabilities.tolist(),
            "quantiles": self.quantiles.tolist(),
            "samples": self.samples,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Uncertainty:
        """What `to_json` gave. Raises `ValueError` if the values are of another form."""
        try:
            factor = np.array(values["factor"], dtype=np.float64)
            p, q = (np.array(values[k], dtype=np.float64) for k in ("probabilities", "quantiles"))
            spread, samples = float(values["spread"]), int(values["samples"])
        except (KeyError, TypeError, ValueError) as e:
            raise ValueError(f"expected spread, factor, probabilities and quantiles: {e}") from e
        factor = factor.reshape(len(factor), -1) if factor.size else np.zeros((0, 0))
        sound = p.ndim == 1 and p.shape == q.shape and len(p) > 1 and bool(np.all(np.diff(p) > 0))
        if not (sound and p[0] > 0 and p[-1] < 1 and np.all(np.diff(q) >= 0) and spread >= 0):
            raise ValueError("expected rising probabilities and quantiles of one length")
        return cls(spread, factor, p, q, samples)


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands about the free run of every experiment, and their measured coverage.

    Attributes
    ----------
    level : float
        Share of measured samples that the band should contain.
    lower, simulated, upper : tuple of array, shape (N,)
    inside : tuple of float
        Share of each experiment's measured samples after the initial ones that lie inside; NaN if
        none is measured.
    coverage : float
        Share for all experiments together.
    n : int
        Number of measured samples.
    """

    level: float
    lower: tuple[FloatArray, ...]
    simulated: tuple[FloatArray, ...]
    upper: tuple[FloatArray, ...]
    inside: tuple[float, ...]
    coverage: float
    n: int

    def to_json(self) -> dict[str, Any]:
        """The shares as JSON values, without the series."""
        return {
            "level": self.level,
            "coverage": _number(self.coverage),
            "experiments": [_number(v) for v in self.inside],
            "n": self.n,
        }


def require_level(level: float) -> None:
    """Raise a `SettingError` for a level for which no band can be made."""
    is_number = isinstance(level, Real) and not isinstance(level, bool)
    if not is_number or not 0.5 <= level <= 0.999:
        raise SettingError(f"level: expected a share from 0.5 to 0.999, received {level!r}")


def bands(
    model: DynamicModel,
    data: Dataset,
    level: float = LEVEL,
    *,
    init: int = INIT,
    training: Dataset | None = None,
) -> Bands:
    """Bands about a free run.

    Parameters
    ----------
    model : Model
    data : Dataset
        Outputs after the first `init` samples can be NaN; measured ones are counted.
    level : float
        Share of measured samples to expect inside, .5 to .999.
    init : int
        As for `simulate`.
    training : Dataset or None
        The model's training data; None: the evidence stored by `identify`.

    Raises
    ------
    SettingError
        For a level out of range, or a model without stored uncertainty.
    DataError, FitError
        As for `simulate`.
    """
    require_level(level)
    known = uncertainty(model, training) if training is not None else stored_uncertainty(model)
    if known is None:
        raise SettingError(
            "bands: expected a model that stores its uncertainty, received one without; identify "
            "it again, or give its training data (training=...)"
        )
    residuals = Residuals.of(model, data, init, "free run")
    return bands_of(model, data, residuals, known, level, region_runs(model, data, training, init))


def bands_of(
    model: DynamicModel,
    data: Dataset,
    residuals: Residuals,
    known: Uncertainty,
    level: float,
    place: RegionRuns | None = None,
) -> Bands:
    """Bands about computed free runs, widened by their distances from the training region."""
    tail = 0.5 * (1.0 - level)
    low, high = known.quantile(tail), known.quantile(1.0 - tail)
    spreads = _spreads(model, data, residuals, known)
    if place is not None:
        spreads = [s * np.clip(d, 1.0, 10.0) for s, d in zip(spreads, place.distances, strict=True)]
    lower = tuple(r.yhat + low * s for r, s in zip(residuals.runs, spreads, strict=True))
    upper = tuple(r.yhat + high * s for r, s in zip(residuals.runs, spreads, strict=True))
    hits = [
        ((r.y >= a) & (r.y <= b))[r.counts]
        for r, a, b in zip(residuals.runs, lower, upper, strict=True)
    ]
    n = sum(map(len, hits))
    return Bands(
        level,
        lower,
        tuple(r.yhat for r in residuals.runs),
        upper,
        tuple(float(h.mean()) if len(h) else math.nan for h in hits),
        float(np.concatenate(hits).mean()) if n else math.nan,
        n,
    )


def uncertainty(model: DynamicModel, data: Dataset, init: int = INIT) -> Uncertainty:
    residuals = Residuals.of(model, data, init, "free run")
    found = None if model.members else estimate(model, residuals)
    return uncertainty_of(model, data, residuals, found)


def uncertainty_of(
    model: DynamicModel, data: Dataset, residuals: Residuals, found: Parameters | None
) -> Uncertainty:
    """Uncertainty from free runs on the training data and the estimated parameters."""
    tails = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.35, 0.5)
    factor = np.zeros((0, 0)) if found is None else _factor(found, residuals)
    errors = _left_out(model, residuals)
    power = sum(
        float(np.sum(np.square(e[r.counts]))) for e, r in zip(errors, residuals.runs, strict=True)
    )
    spread = math.sqrt(power / residuals.n)
    empty = Uncertainty(spread, factor, np.zeros(0), np.zeros(0), residuals.n)
    spreads = _spreads(model, data, residuals, empty)
    scores = np.concatenate(
        [
            (e / np.where(s > 0, s, 1.0))[r.counts]
            for e, s, r in zip(errors, spreads, residuals.runs, strict=True)
        ]
    )
    probabilities = np.array([*tails, *(1.0 - t for t in tails[-2::-1])])
    return Uncertainty(
        spread, factor, probabilities, np.quantile(scores, probabilities), residuals.n
    )


def stored_uncertainty(model: DynamicModel) -> Uncertainty | None:
    """The uncertainty stored with the model; None if there is none, or it is unreadable."""
    values = model.training.get("uncertainty")
    if not isinstance(values, Mapping):
        return None
    try:
        return Uncertainty.from_json(values)
    except ValueError:
        return None


def _factor(found: Parameters, residuals: Residuals) -> FloatArray:
    """F with FF' close to P, from the directions that move the free run most."""
    sizes, vectors = np.linalg.eigh(found.covariance)
    root = vectors * np.sqrt(np.maximum(sizes, 0.0))
    # directions of P^(1/2), sorted by their contribution to the free run's variance
    moved, turn = np.linalg.eigh(root.T @ residuals.gram @ root)
    order = np.argsort(moved)[::-1]
    share = np.cumsum(moved[order]) / max(moved.sum(), 1e-300)
    kept = order[: int(np.searchsorted(share, 0.999)) + 1]
    factor: FloatArray = root @ turn[:, kept]
    return factor


def _left_out(model: DynamicModel, residuals: Residuals) -> list[FloatArray]:
    """Residuals of every block for parameters fitted to the other blocks only.
    To first order, e_b + Psi_b (H - H_b + L)^-1 Psi_b' e_b.
    """
    errors = [r.error for r in residuals.runs]
    if residuals.width == 0:
        return errors
    information = Information.of(model, residuals)
    found = [e.copy() for e in errors]
    for run, e, out in zip(residuals.runs, errors, found, strict=True):
        for a, b in _blocks(len(e), residuals.n):
            psi = run.sensitivity[a:b]
            # least relative information of a direction in which parameters move when a block is
            # left out. In weaker directions a network is nonlinear long before the first-order step
            # is reached
            inverse = information.inverse(gram(psi), 1e-4)
            change = psi @ (inverse @ (psi.T @ e[a:b]))
            out[a:b] = e[a:b] + _bounded(change, e[a:b])
    return found


def _blocks(length: int, total: int) -> list[tuple[int, int]]:
    """Blocks of one run, such that all runs together have about `BLOCKS`."""
    count = max(1, round(BLOCKS * length / max(total, 1)))
    if count == 1 and length >= total:
        count = 2
    edges = np.linspace(0, length, count + 1).astype(int)
    return [(int(a), int(b)) for a, b in itertools.pairwise(edges)]


def _bounded(change: FloatArray, e: FloatArray) -> FloatArray:
    # largest growth of a residual when its block is left out: the limit of the first order
    largest = 3.0 * float(np.linalg.norm(e))
    size = float(np.linalg.norm(change))
    return change if size <= largest else change * (largest / size)


def _spreads(
    model: DynamicModel, data: Dataset, residuals: Residuals, known: Uncertainty
) -> list[FloatArray]:
    """s(k) of every experiment."""
    own = [np.full(len(r.y), known.spread) for r in residuals.runs]
    if model.members:
        runs = _member_runs(model.members, data, residuals.init)
        together = zip(own, *runs, strict=True)
        return [np.sqrt(s**2 + _member_variance(np.stack(same))) for s, *same in together]
    factor = known.factor
    if factor.size == 0 or factor.shape[0] != residuals.width:
        return own
    return [
        np.sqrt(s**2 + np.square(r.psi @ factor).sum(axis=1))
        for s, r in zip(own, residuals.runs, strict=True)
    ]


def _member_runs(
    members: Sequence[DynamicModel], data: Dataset, init: int
) -> list[list[FloatArray]]:
    """Free runs of the members that do not diverge, as counted in the ensemble's own run."""
    found = []
    for member in members:
        with suppress(FitError):
            found.append(member.simulate(data, init=init))
    return found


def _member_variance(runs: FloatArray) -> FloatArray:
    """Variance across members (M, N) from the median absolute deviation, robust to outliers."""
    middle = np.median(runs, axis=0)
    found: FloatArray = (1.4826 * np.median(np.abs(runs - middle), axis=0)) ** 2
    return found


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
