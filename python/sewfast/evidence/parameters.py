"""Parameters: covariance, conditioning, effective number, and information criteria."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from .. import _core
from ..dataset import FloatArray
from ..dynamic_model import DynamicModel
from .residuals import Residuals, representative

# --- Information criteria -------------------------------------------------------------------------


@dataclass(frozen=True)
class Criteria:
    """Criteria of a model on its training data; smaller is better, only differences matter. `aic`,
    `aicc` and `bic` are n ln(RSS/n) + 2 p, + 2 p (p + 1)/(n - p - 1), and n ln(RSS/n) + p ln n for
    the effective number of `parameters`; `fpe` is RSS/n (1 + p/n)/(1 - p/n) [output unit squared].
    They assume a white residual; with a coloured one they favour too many parameters. Sources:
    Akaike (1974), Hurvich and Tsai (1989), Schwarz (1978), Akaike (1969); Ljung 1999, section 16.4.
    """

    parameters: float
    n: int
    aic: float
    aicc: float
    bic: float
    fpe: float

    @classmethod
    def of(cls, squares: float, n: int, parameters: float) -> Criteria:
        """From the sum of squared residuals of n samples."""
        nan = math.nan
        if n < 1 or not squares > 0.0:
            return cls(parameters, n, nan, nan, nan, nan)
        p = parameters
        fit = n * math.log(squares / n)
        aic = fit + 2.0 * p
        room = n - p - 1.0
        aicc = aic + 2.0 * p * (p + 1.0) / room if room > 0.0 else nan
        fpe = squares / n * (1.0 + p / n) / (1.0 - p / n) if p < n else nan
        return cls(p, n, aic, aicc, fit + p * math.log(n), fpe)

    def to_json(self) -> dict[str, float | None]:
        """As JSON values: None where a criterion is undefined."""
        return {k: v if math.isfinite(v) else None for k, v in asdict(self).items()}


# --- Parameters: sandwich covariance, conditioning, effective number ------------------------------


DETERMINED = 1e-10
"""Least information of a direction, relative to the largest; double precision ends there."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """Estimates of the parameters and their uncertainty.

    Attributes
    ----------
    values : array, shape (p,)
    covariance : array, shape (p, p)
        (H + L)^-1 Psi'R Psi (H + L)^-1 with H = Psi'Psi, L the weight decay, R the residual's
        covariance matrix, coloured (Ljung 1999, eq. 9.42; Newey and West 1987); undetermined
        directions count as fixed.
    effective : float
        trace (H + L)^-1 H: number of parameters determined by the data, not the weight decay.
    condition : float
        Condition of the sensitivity with columns of unit length; infinity if a direction has no
        effect.
    undetermined : int
        Number of directions without information in the data.
    names : tuple of str
    """

    values: FloatArray
    covariance: FloatArray
    effective: float
    condition: float
    undetermined: int
    names: tuple[str, ...]

    @property
    def standard_errors(self) -> FloatArray:
        """Square roots of the variances, shape (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def loose(self, share: float = 1.0) -> list[str]:
        """Names of the parameters whose standard error exceeds that share of their magnitude."""
        bound = share * np.abs(self.values)
        return [n for n, s, b in zip(self.names, self.standard_errors, bound, strict=True) if s > b]


@dataclass(frozen=True, eq=False)
class Information:
    """The normal matrix Psi'Psi (p, p) and its inverse over the determined directions."""

    gram: FloatArray
    penalty: FloatArray

    @classmethod
    def of(cls, model: DynamicModel, residuals: Residuals) -> Information:
        return cls(residuals.gram, penalty(model, residuals))

    @property
    def scale(self) -> FloatArray:
        """Square roots of the diagonal; the largest one in place of 0."""
        return _unit_scale(np.diag(self.gram) + self.penalty)

    def inverse(self, less: FloatArray | None = None, determined: float = DETERMINED) -> FloatArray:
        """(gram - less + penalty)^+ over the determined directions."""
        matrix = self.gram + np.diag(self.penalty)
        if less is not None:
            matrix = matrix - less
        outer = np.outer(self.scale, self.scale)
        sizes, vectors = np.linalg.eigh(matrix / outer)
        kept = sizes > determined * max(sizes[-1], DETERMINED) if len(sizes) else sizes > 0
        vectors = vectors[:, kept]
        found: FloatArray = (vectors / sizes[kept]) @ vectors.T / outer
        return found

    def conditioning(self) -> tuple[float, int]:
        """Condition number of the sensitivity, and number of directions without information."""
        scale = _unit_scale(np.diag(self.gram))
        sizes = np.linalg.eigvalsh(self.gram / np.outer(scale, scale))
        if len(sizes) == 0 or sizes[-1] <= 0.0:
            return np.inf, len(sizes)
        lost = int(np.sum(sizes <= DETERMINED * sizes[-1]))
        condition = np.sqrt(sizes[-1] / sizes[0]) if lost == 0 else np.inf
        return float(condition), lost


def _unit_scale(squares: FloatArray) -> FloatArray:
    """Factors that normalise columns of these squared lengths; columns of zeros stay so.
    Weight decay can shrink the effect of a hidden unit to 1e-160, so that the inverse of its
    information overflows in any units.
    """
    lengths = np.sqrt(squares)
    largest = lengths.max(initial=0.0) or 1.0
    # least length of a sensitivity's column, relative to the longest, to carry information
    return np.where(lengths > 1e-60 * largest, lengths, largest)


@dataclass(frozen=True)
class StoredInformation:
    """How well a model's training data determine its `number` of parameters, as `Parameters`."""

    number: int
    samples: int
    effective: float
    condition: float
    undetermined: int

    @classmethod
    def of(cls, p: Parameters, samples: int) -> StoredInformation:
        return cls(len(p.values), samples, p.effective, p.condition, p.undetermined)

    def to_json(self) -> dict[str, float | None]:
        """As JSON values: None for an infinite condition."""
        return {k: v if np.isfinite(v) else None for k, v in asdict(self).items()}

    @classmethod
    def stored(cls, model: DynamicModel) -> StoredInformation | None:
        """The values stored with the model; None if there are none, or they are unreadable."""
        values = model.training.get("information")
        if not isinstance(values, Mapping):
            return None
        try:
            number, samples, undetermined = (
                int(values[k]) for k in ("number", "samples", "undetermined")
            )
            condition = values["condition"]
            return cls(
                number,
                samples,
                float(values["effective"]),
                math.inf if condition is None else float(condition),
                undetermined,
            )
        except (KeyError, TypeError, ValueError):
            return None


def estimate(model: DynamicModel, residuals: Residuals) -> Parameters | None:
    """Parameters of a model and their uncertainty; None for an ensemble, which has several sets."""
    if residuals.width == 0 or model.members:
        return None
    information = Information.of(model, residuals)
    inverse = information.inverse()
    effective = float(np.trace(inverse @ information.gram))
    coloured = _core.coloured_information(residuals.columns(), spent=effective)
    if not np.isfinite(coloured).all():
        return None  # the sensitivities of an unstable model outgrow all numbers
    covariance = inverse @ coloured @ inverse
    values, names = _values(model, residuals)
    condition, lost = information.conditioning()
    return Parameters(values, covariance, effective, condition, lost, names)


def penalty(model: DynamicModel, residuals: Residuals) -> FloatArray:
    """Weight decay as a diagonal added to Psi'Psi in the data's units (docs/CONVENTIONS.md, J)."""
    single = representative(model)
    decay = single.training.get("weight_decay", 0.0)
    decay = decay if isinstance(decay, float) and np.isfinite(decay) else 0.0
    weights = np.zeros(residuals.width)
    if decay > 0.0 and single.kind in _DECAYED:
        share, y_scale = _DECAYED[single.kind](single)
        if len(share) == residuals.width:
            n = single.training.get("samples_fitted", residuals.n)
            weights = decay * float(n) * y_scale**2 * share
    return weights


def _network_decay(model: DynamicModel) -> tuple[FloatArray, float]:
    s = model.core.settings
    regressors = s["na"] + s["nb"] * s["n_inputs"]
    hidden = s["hidden"]
    parts = [np.ones(hidden * regressors), np.full(hidden, 0.1), np.ones(hidden)]
    rest = len(model.core.theta) - sum(map(len, parts))
    return np.concatenate([*parts, np.zeros(rest)]), float(s["y_scale"])


def _state_space_decay(model: DynamicModel) -> tuple[FloatArray, float]:
    s = model.core.settings
    nx, nu, ny, hidden = s["nx"], s["n_inputs"], s["n_outputs"], s["hidden"]
    parts = [(nx * (nx + nu), 0.0), (nx * hidden, 1.0), (hidden * (nx + nu), 1.0), (hidden, 0.1)]
    parts += [(ny * (nx + nu + 1), 0.0), (ny * hidden, 1.0)]
    share = np.concatenate([np.full(size, weight) for size, weight in parts])
    return share, float(s["y_scale"][0])


_DECAYED = {"neural_oe": _network_decay, "neural_ss": _state_space_decay}


def _values(model: DynamicModel, residuals: Residuals) -> tuple[FloatArray, tuple[str, ...]]:
    values, names = model.theta, model.parameter_names
    if residuals.horizon == "one step":
        # regressors are the past outputs, a_i their negative coefficients
        na = model.orders["na"]
        values = np.concatenate([-values[:na], values[na:]])
        names = (*(f"-{n}" for n in names[:na]), *names[na:])
    return values[: residuals.width], names[: residuals.width]
