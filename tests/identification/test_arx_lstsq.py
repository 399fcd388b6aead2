"""ARX against NumPy's least squares on rows, on data that make it hard."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sewfast import _core
from sewfast.errors import DataError, FitError

WELL_POSED = 1e3


def rows(u: np.ndarray, y: np.ndarray, na: int, nb: int, nk: int) -> np.ndarray:
    """Rows ``[y(k-1..), u_0(k-nk..), .., 1, y(k)]``, those that were measured throughout."""
    first = max(na, nk + nb - 1)
    k = np.arange(first, len(y))
    past = [y[k - 1 - i] for i in range(na)]
    inputs = [u[k - nk - i, j] for j in range(u.shape[1]) for i in range(nb)]
    table = np.stack([*past, *inputs, np.ones(len(k)), y[k]], axis=1)
    return table[np.isfinite(table).all(axis=1)]


def data(
    seed: int, samples: int, inputs: int, offset: float, scale: float, gaps: bool
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(samples, inputs)) + offset
    y = np.zeros(samples)
    for k in range(2, samples):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + u[k - 1].sum() + 0.3 * rng.normal()
    if gaps:
        y[rng.random(samples) < 0.05] = np.nan
    return u * scale, y * scale


@settings(deadline=None, max_examples=60)
@given(
    orders=st.tuples(st.integers(1, 4), st.integers(1, 4), st.integers(0, 5)),
    inputs=st.integers(1, 3),
    lengths=st.lists(st.integers(30, 3000), min_size=1, max_size=3),
    offset=st.sampled_from([0.0, 1.0, -30.0, 1e4]),
    exponent=st.sampled_from([-170, -80, -3, 0, 6, 80, 160]),
    gaps=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_agrees_with_lstsq(
    orders: tuple[int, int, int],
    inputs: int,
    lengths: list[int],
    offset: float,
    exponent: int,
    gaps: bool,
    seed: int,
) -> None:
    na, nb, nk = orders
    scale = 10.0**exponent
    pairs = [data(seed + i, n, inputs, offset, scale, gaps) for i, n in enumerate(lengths)]
    table = np.concatenate([rows(u / scale, y / scale, *orders) for u, y in pairs])
    columns, target = table[:, :-1], table[:, -1]
    if len(target) < 2 * columns.shape[1]:
        return
    sizes = np.linalg.norm(columns, axis=0)
    expected, _, _, singular = np.linalg.lstsq(columns / sizes, target, rcond=None)
    try:
        model = _core.fit_arx(pairs, na=na, nb=nb, nk=nk, offset=True)
    except FitError:
        assert singular[-1] <= 1e-11 * singular[0]
        return
    found = np.concatenate([-model.a, model.b.ravel(), [model.offset / scale]]) * sizes
    if singular[0] <= WELL_POSED * singular[-1]:
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max(), rtol=0)
    best = np.linalg.norm(target - columns / sizes @ expected)
    left = np.linalg.norm(target - columns / sizes @ found)
    assert left <= best * (1 + 1e-9) + 1e-9 * np.linalg.norm(target)


def test_a_long_record_agrees_with_lstsq() -> None:
    u, y = data(3, 200_000, 1, 0.0, 1.0, gaps=False)
    table = rows(u, y, 2, 2, 1)[:, [0, 1, 2, 3, 5]]
    expected = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
    model = _core.fit_arx([(u, y)], na=2, nb=2, nk=1, offset=False)
    np.testing.assert_allclose(np.concatenate([-model.a, model.b[0]]), expected, atol=1e-9)


@pytest.mark.parametrize("at", [0, 1, 2, 777, 1998, 1999])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_names_a_sample_that_cannot_be_used(at: int, value: float) -> None:
    u, y = data(0, 2000, 1, 0.0, 1.0, gaps=False)
    u[at] = value
    with pytest.raises(DataError, match=rf"sample {at};"):
        _core.fit_arx([(u, y)], na=2, nb=2, nk=3, offset=True)


def test_refuses_a_column_that_never_changes() -> None:
    u, y = data(0, 2000, 2, 0.0, 1.0, gaps=False)
    u[:, 1] = 4.0
    with pytest.raises(DataError, match="input 1 to change"):
        _core.fit_arx([(u, y)], na=2, nb=1, nk=1, offset=False)
