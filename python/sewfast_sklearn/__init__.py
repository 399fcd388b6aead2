"""A scikit-learn regressor around `identify`, for its cross-validation, pipelines and searches.

Samples of a dynamic system are not exchangeable: folds that shuffle rows, or join separate pieces,
destroy the dynamics. Cross-validate by whole recordings or by blocks of one, with `experiment` and
scikit-learn's group splitters (docs/choosing-a-model.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sewfast.dataset import Dataset, FloatArray
from sewfast.dynamic_model import INIT
from sewfast.errors import DataError, SettingError, not_installed
from sewfast.identification import identify
from sewfast.kinds import Kind
from sewfast.models import Model

try:
    from sklearn.base import BaseEstimator, RegressorMixin
    from sklearn.metrics import r2_score
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as e:
    raise not_installed("scikit-learn", "the regressor", "sewfast[sklearn]") from e


class FreeRunRegressor(RegressorMixin, BaseEstimator):
    """Fits a dynamic model to inputs `X` and an output `y`, and predicts in free run.

    Parameters
    ----------
    Ts : float
        Sample time [s].
    model : str
        As for `sewfast.identify`. Linear output error takes a fraction of a second; `auto` searches
        for tens of seconds in each fold.
    na, nb, nk : int or None
        As for `sewfast.identify`.
    time_budget : float or None
        Time for each fit [s].
    seed : int
        Seed of a network's starts.
    init : int
        Samples of each experiment from which `score` estimates the initial state; the score is of
        the others.

    Attributes
    ----------
    model_ : sewfast.Model
        The identified model, for `validate`, `check` and `tune`.
    n_features_in_ : int
        Number of inputs.

    Examples
    --------
    >>> import numpy as np
    >>> from sewfast_sklearn import FreeRunRegressor
    >>> u = np.repeat(np.random.default_rng(0).normal(size=40), 10)
    >>> y = np.zeros(400)
    >>> for k in range(1, 400):
    ...     y[k] = 0.9 * y[k - 1] + 0.2 * u[k - 1]
    >>> fitted = FreeRunRegressor(Ts=0.01, model="arx", na=1, nb=1).fit(u[:300, None], y[:300])
    >>> print(f"{fitted.score(u[300:, None], y[300:]):.3f}")
    1.000
    """

    def __init__(
        self,
        Ts: float = 1.0,
        *,
        model: Kind = "oe",
        na: int | None = None,
        nb: int | None = None,
        nk: int | None = None,
        time_budget: float | None = None,
        seed: int = 0,
        init: int = INIT,
    ) -> None:
        self.Ts = Ts
        self.model = model
        self.na = na
        self.nb = nb
        self.nk = nk
        self.time_budget = time_budget
        self.seed = seed
        self.init = init

    def fit(self, X: ArrayLike, y: ArrayLike, experiment: ArrayLike | None = None) -> Any:
        """Identify the model.

        Parameters
        ----------
        X : array_like, shape (N, n_inputs)
            Inputs, one row per sample, in order of time.
        y : array_like, shape (N,)
            Output.
        experiment : array_like, shape (N,), optional
            Label of the recording of each row: consecutive rows with the same value are one
            experiment, with a separate initial state. By default all rows are one.

        Returns
        -------
        FreeRunRegressor
            Itself.

        Raises
        ------
        ValueError
            For shapes that do not agree, too few samples or values that are not finite.
        SettingError, DataError, FitError
            As for `sewfast.identify`.
        """
        data = self._data(*_checked(self, X, y, reset=True), experiment)
        self.model_: Model = identify(
            data, model=self.model, na=self.na, nb=self.nb, nk=self.nk,
            time_budget=self.time_budget, seed=self.seed, threads=1, progress=None,
        )  # fmt: skip
        return self

    def predict(self, X: ArrayLike) -> FloatArray:
        """The free run from rest, computed from the inputs alone.

        Parameters
        ----------
        X : array_like, shape (N, n_inputs)
            One experiment, in order of time.

        Returns
        -------
        array, shape (N,)
        """
        check_is_fitted(self)
        checked: FloatArray = validate_data(self, X, dtype=np.float64, reset=False)
        return self.model_.simulate(checked)

    def score(self, X: ArrayLike, y: ArrayLike, experiment: ArrayLike | None = None) -> float:
        """R^2 of the free run, with a separate initial state for each experiment.

        Parameters
        ----------
        X, y, experiment
            As for `fit`. The first `init` samples of each experiment determine its initial state
            and are not scored.

        Returns
        -------
        float
            1 if the run explains everything, 0 if it is as good as the mean.
        """
        check_is_fitted(self)
        data = self._data(*_checked(self, X, y, reset=False), experiment)
        runs = self.model_.simulate(data, init=self.init)
        pairs = zip(data.experiments, runs, strict=True)
        scored = [(e.y[self.init :], run[self.init :]) for e, run in pairs]
        measured, run = (np.concatenate(parts) for parts in zip(*scored, strict=True))
        if len(measured) < 2:
            raise DataError(
                f"X: expected more samples than init = {self.init} in an experiment, received "
                f"{len(data.experiments[0].y)}; score a longer one"
            )
        return float(r2_score(measured, run))

    def _data(self, X: FloatArray, y: FloatArray, experiment: ArrayLike | None) -> Dataset:
        if experiment is None:
            return Dataset.from_arrays(X, y, self.Ts)
        labels = np.asarray(experiment)
        if labels.shape != y.shape:
            raise SettingError(
                f"experiment: expected a label for each of {len(y)} rows, received an array of "
                f"shape {labels.shape}"
            )
        ends = [*(np.flatnonzero(labels[1:] != labels[:-1]) + 1), len(y)]
        pieces = zip([0, *ends[:-1]], ends, strict=True)
        return Dataset.concat(Dataset.from_arrays(X[a:b], y[a:b], self.Ts) for a, b in pieces)


def _checked(
    regressor: FreeRunRegressor, X: ArrayLike, y: ArrayLike, *, reset: bool
) -> tuple[FloatArray, FloatArray]:
    """Inputs (N, n) and output (N,), checked by scikit-learn."""
    inputs, output = validate_data(
        regressor, X, y, dtype=np.float64, y_numeric=True, reset=reset, ensure_min_samples=2
    )
    return inputs, np.asarray(output, dtype=np.float64)


def blocks(samples: int, count: int = 5) -> NDArray[np.int_]:
    """Labels that divide one recording into blocks of equal length, for scikit-learn's groups.

    Parameters
    ----------
    samples : int
        Rows of the recording.
    count : int
        Number of blocks; each should be several times as long as the slowest time constant.

    Returns
    -------
    array of int, shape (samples,)
        0 to count - 1: both `experiment` of the regressor and `groups` of `LeaveOneGroupOut`.
    """
    if not 2 <= count <= samples:
        raise SettingError(
            f"count: expected 2 to {samples} blocks of {samples} samples, received {count}"
        )
    return np.arange(samples) * count // samples
