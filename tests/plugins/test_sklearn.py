"""The scikit-learn regressor: scikit-learn's own checks, and what cross-validation means here."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

pytest.importorskip("sklearn", reason="needs scikit-learn")

from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, KFold, LeaveOneGroupOut, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

import sewfast
from sewfast.errors import DataError, SettingError
from sewfast_sklearn import FreeRunRegressor, blocks

SHORT = "has fewer samples than an initial state and the orders need"
ORDERED = "samples of a dynamic system are not exchangeable"
FEW = """
    dict_unchanged dont_overwrite_parameters estimators_dtypes estimators_fit_returns_self
    estimators_nan_inf estimators_overwrite_params f_contiguous_array_estimator fit2d_1feature
    fit2d_predict1d n_features_in_after_fitting readonly_memmap_input
    regressors_no_decision_function
"""
EXPECTED = {
    **{f"check_{name}": SHORT for name in FEW.split()},
    "check_methods_sample_order_invariance": ORDERED,
    "check_methods_subset_invariance": ORDERED,
}


def lagged(count: int = 1200, seed: int = 0, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Input (N, 1) and noisy output (N,) of a second-order lag."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.normal(size=-(-count // 15)), 15)[:count], np.zeros(count)
    for k in range(2, count):
        y[k] = 1.6 * y[k - 1] - 0.64 * y[k - 2] + 0.02 * u[k - 1] + 0.02 * u[k - 2]
    return u[:, None], y + noise * rng.normal(size=count)


def test_it_is_a_public_name() -> None:
    assert sewfast.sklearn.FreeRunRegressor is FreeRunRegressor
    assert "sklearn" in dir(sewfast)


def test_scikit_learns_own_checks() -> None:
    regressor = FreeRunRegressor(model="arx", na=1, nb=1, nk=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of checks that are left out
        check_estimator(regressor, expected_failed_checks=EXPECTED)


def test_it_is_identify_and_a_free_run() -> None:
    u, y = lagged()
    fitted = FreeRunRegressor(Ts=0.01).fit(u[:800], y[:800])
    data = sewfast.Dataset.from_arrays(u[:800], y[:800], 0.01)
    model = sewfast.identify(data, model="oe", threads=1)
    np.testing.assert_array_equal(fitted.model_.theta, model.theta)
    np.testing.assert_array_equal(fitted.predict(u[800:]), model.simulate(u[800:, 0]))
    held = sewfast.Dataset.from_arrays(u[800:], y[800:], 0.01)
    fit = model.validate(held).simulation.fit_percent / 100.0
    # R^2 = 1 - (1 - fit)^2 by the definition of the fit
    assert fitted.score(u[800:], y[800:]) == pytest.approx(1.0 - (1.0 - fit) ** 2, abs=1e-9)


def test_recordings_stay_apart() -> None:
    first, second = lagged(600, seed=1), lagged(500, seed=2)
    u, y = (np.concatenate(parts) for parts in zip(first, second, strict=True))
    labels = np.repeat([7, 3], [600, 500])
    fitted = FreeRunRegressor(Ts=0.01).fit(u, y, experiment=labels)
    parts = [sewfast.Dataset.from_arrays(*part, 0.01) for part in (first, second)]
    both = sewfast.identify(sewfast.Dataset.concat(parts), model="oe", threads=1)
    np.testing.assert_array_equal(fitted.model_.theta, both.theta)
    assert fitted.score(u, y, experiment=labels) > fitted.score(u, y) - 1e-3


def test_blocks_validate_what_shuffled_folds_cannot() -> None:
    u, y = lagged()
    regressor, labels = FreeRunRegressor(Ts=0.01), blocks(len(y), 4)
    assert [int((labels == k).sum()) for k in range(4)] == [300] * 4
    scores = cross_val_score(
        regressor, u, y, groups=labels, cv=LeaveOneGroupOut(), params={"experiment": labels}
    )
    assert scores.min() > 0.85
    shuffled = cross_val_score(regressor, u, y, cv=KFold(4, shuffle=True, random_state=0))
    assert shuffled.max() < scores.min() - 0.3


def test_pipelines_searches_and_clones() -> None:
    u, y = lagged()
    pipeline = make_pipeline(StandardScaler(), FreeRunRegressor(Ts=0.01))
    assert pipeline.fit(u[:900], y[:900]).score(u[900:], y[900:]) > 0.85
    labels = blocks(len(y), 3)
    search = GridSearchCV(FreeRunRegressor(Ts=0.01), {"na": [1, 2]}, cv=LeaveOneGroupOut())
    search.fit(u, y, groups=labels, experiment=labels)
    assert search.best_params_ == {"na": 2}
    assert clone(search.best_estimator_).get_params()["na"] == 2


def test_misuse_is_refused() -> None:
    u, y = lagged(200)
    regressor = FreeRunRegressor(Ts=0.01, model="arx")
    with pytest.raises(SettingError, match=r"experiment: expected a label for each of 200 rows"):
        regressor.fit(u, y, experiment=[1, 2])
    with pytest.raises(ValueError, match="NaN"):
        regressor.fit(u, np.where(np.arange(200) == 3, np.nan, y))
    fitted = regressor.fit(u, y)
    with pytest.raises(DataError):
        fitted.score(u[:15], y[:15])
    with pytest.raises(SettingError, match="count: expected 2 to 200 blocks"):
        blocks(200, 1)
