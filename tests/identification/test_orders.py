"""Orders and delay: known plants are found, criteria are what they are said to be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from sewfast import DataError, Dataset, SettingError, _core
from sewfast.identification.order_table import Structure

A, B = [-1.5, 0.7], [[0.5, 0.3]]


def record(
    n: int = 2000, nk: int = 3, noise: float = 0.1, seed: int = 0, delays: tuple[int, ...] = (0,)
) -> Dataset:
    """Steps of five samples into a second-order plant; `delays` more for each input."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-5.0, 5.0, (n // 5 + 1, len(delays))), 5, axis=0)[:n]
    late = [u[np.maximum(np.arange(n) - d, 0), j] for j, d in enumerate(delays)]
    b = np.vstack([np.array(B) * (j + 1) for j in range(len(delays))])
    model = _core.LinearModel(np.array(A), b, nk, 0.4)
    y = model.simulate(np.stack(late, axis=1), np.zeros(2))
    return Dataset.from_arrays(u, y + noise * y.std() * rng.normal(size=n), 0.01, output_unit="RPM")


# --- delay ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("nk", [1, 3, 12])
def test_the_delay_is_found_and_is_sure(nk: int) -> None:
    found = api.delay(record(nk=nk))
    (only,) = found.inputs
    assert found.nk == only.nk == nk
    assert only.low <= nk <= only.high
    assert only.high - only.low <= 1
    assert only.first_correlated == nk
    assert np.argmin(only.cost) == np.flatnonzero(only.lags == nk)[0]
    assert f"nk = {nk}" in str(found)
    assert f"{10 * nk:g} ms" in str(found)
    assert json.loads(json.dumps(found.to_json()))["nk"] == nk


def test_each_input_has_its_own_delay_and_the_smallest_is_common() -> None:
    found = api.delay(record(nk=1, delays=(5, 2, 9), noise=0.05))
    assert [i.nk for i in found.inputs] == [6, 3, 10]
    assert found.nk == 3
    # the other inputs are noise to a correlation, which may hide its first lag
    for one, true in zip(found.inputs, (6, 3, 10), strict=True):
        assert one.first_correlated is not None
        assert true <= one.first_correlated <= true + 2


def test_a_slow_drive_with_a_counted_encoder_does_not_look_late() -> None:
    # 490 / ((.252 s + 1)(.0074 s + 1)) at 1 ms and 7 ms of dead time: one step ahead it looks late
    rng = np.random.default_rng(0)
    plant = _core.LinearModel(
        np.array([-1.86963746, 0.87013806]), np.array([[0.1255, 0.1198]]), 8, 0
    )
    u = np.repeat(rng.uniform(0.0, 6.0, 100), 100)
    y = plant.simulate(u[:, None].copy(), np.zeros(2)) + 15.0 * rng.normal(size=len(u))
    (found,) = api.delay(Dataset.from_arrays(u, y, 0.001), longest=16).inputs
    assert found.low <= 8 <= found.high
    assert 5 <= found.nk <= 11
    assert np.argmin(found.one_step_cost) + 1 > 11


def test_independent_series_correlate_by_chance_alone() -> None:
    rng = np.random.default_rng(3)
    beyond = 0
    for _ in range(40):
        u, y = np.repeat(rng.normal(size=200), 5), rng.normal(size=1000)
        (found,) = api.delay(Dataset.from_arrays(u, y, 0.01), longest=10).inputs
        beyond += found.first_correlated is not None
    # 5 % of 40 expected; more than 9 has a probability below 1e-4
    assert beyond <= 9


def test_samples_that_were_not_measured_are_left_out() -> None:
    data = record()
    y = data.experiments[0].y.copy()
    y[100:140] = np.nan
    y[::37] = np.nan
    holes = Dataset.from_arrays(data.experiments[0].u, y, 0.01)
    assert api.delay(holes).nk == 3
    assert api.orders(holes, na=3, nb=3).choice.nk == 3


# --- orders ---------------------------------------------------------------------------------------


def test_the_true_structure_is_chosen() -> None:
    table = api.orders(record())
    assert table.choice.orders == {"na": 2, "nb": 2, "nk": 3}
    assert table.choice.free_run <= 1.05 * table.best.free_run
    assert table.minimum("bic").nk == 3
    model = api.identify(record(), model="oe", **table.choice.orders)
    assert model.orders == table.choice.orders


def test_without_noise_every_criterion_finds_the_structure() -> None:
    table = api.orders(record(noise=0.0), nk=3)
    assert table.choice.orders == {"na": 2, "nb": 2, "nk": 3}
    assert table.choice.one_step < 1e-9
    by = {(r.na, r.nb): r for r in table.rows}
    assert by[2, 2].lipschitz < 0.5 * by[1, 1].lipschitz
    assert by[1, 1].one_step > 0.01


def rows_of(u: np.ndarray, y: np.ndarray, row: Structure) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and outputs from the first sample on that has three samples before it."""
    k = np.arange(3, len(y))
    lagged = [y[k - i] for i in range(1, row.na + 1)]
    lagged += [u[k - row.nk - i, j] for j in range(u.shape[1]) for i in range(row.nb)]
    return np.column_stack([*lagged, np.ones(len(k))]), y[k]


def test_rows_are_the_regressions_that_they_say() -> None:
    data = record(nk=1, delays=(0, 1))
    table = api.orders(data, na=[1, 3], nb=[2], nk=[1, 2])
    assert [(r.na, r.nb, r.nk) for r in table.rows] == [(1, 2, 1), (3, 2, 1), (1, 2, 2), (3, 2, 2)]
    cut = round(0.7 * len(data))
    (e,) = data.experiments
    for row in table.rows:
        phi, y = rows_of(e.u[:cut], e.y[:cut], row)
        theta = np.linalg.lstsq(phi, y, rcond=None)[0]
        n, p = phi.shape
        variance = np.mean((y - phi @ theta) ** 2)
        assert row.parameters == p
        assert row.aic == pytest.approx(n * np.log(variance) + 2 * p, rel=1e-9)
        assert row.aicc == pytest.approx(row.aic + 2 * p * (p + 1) / (n - p - 1), rel=1e-9)
        assert row.bic == pytest.approx(n * np.log(variance) + p * np.log(n), rel=1e-9)
        assert row.fpe == pytest.approx(variance * (1 + p / n) / (1 - p / n), rel=1e-9)
        fresh, later = rows_of(e.u[cut:], e.y[cut:], row)
        assert row.one_step == pytest.approx(np.sqrt(np.mean((later - fresh @ theta) ** 2)))


def test_free_run_is_that_of_the_better_model_on_the_later_part() -> None:
    data = record()
    table = api.orders(data, na=[2], nb=[2], nk=3)
    (e,) = data.experiments
    cut = round(0.7 * len(data))
    known = [(e.u[:cut], e.y[:cut])]
    iv = _core.fit_iv(known, na=2, nb=2, nk=3, max_iterations=10).model
    arx = _core.fit_arx(known, na=2, nb=2, nk=3, offset=True)
    u, y = e.u[cut:], e.y[cut:]
    errors = []
    for model in (arx, iv):
        run = model.simulate(u, model.estimate_initial_state(u[:20], y[:20]))
        errors.append(np.sqrt(np.mean((y - run)[20:] ** 2)))
    assert errors[1] < errors[0]
    assert table.rows[0].free_run == pytest.approx(errors[1], rel=1e-3)


def test_table_prints_its_choice_and_goes_to_json() -> None:
    table = api.orders(record(), na=2, nb=2)
    text = str(table)
    assert "<- choice" in text
    assert "choice: na = 2, nb = 2, nk = 3" in text
    assert "y [RPM]" in text
    values = json.loads(json.dumps(table.to_json(), allow_nan=False))
    assert values["choice"] == table.choice.orders
    assert len(values["rows"]) == len(table.rows)
    assert values["delay"]["nk"] == 3


def test_validation_data_are_judged_on_where_given() -> None:
    table = api.orders(record(), na=2, nb=2, nk=3, validation=record(seed=5))
    assert table.choice.orders == {"na": 2, "nb": 2, "nk": 3}
    assert table.delay is None


# --- Lipschitz quotients --------------------------------------------------------------------------


def test_lipschitz_index_falls_until_the_true_lags_of_a_nonlinear_plant() -> None:
    rng = np.random.default_rng(1)
    n = 3000
    u, y = rng.uniform(-1.0, 1.0, n), np.zeros(n)
    for k in range(2, n):
        y[k] = 0.8 * np.tanh(y[k - 1]) - 0.4 * y[k - 2] + u[k - 1] + 0.5 * u[k - 2] ** 2
    data = Dataset.from_arrays(u, y, 0.01)
    one, two, three, four = _indices(data, 4)
    assert one > 5.0 * two
    assert two < 1.5 * min(three, four)
    shifted = Dataset.from_arrays(1e3 + 50 * u, 3.0 - 1e-3 * y, 0.01)
    assert _indices(shifted, 2)[1] == pytest.approx(two, rel=1e-6)


def _indices(data: Dataset, most: int) -> list[float]:
    """Of structures with as many past inputs as outputs."""
    rows = api.orders(data, na=most, nb=most, nk=1, validation=data).rows
    return [row.lipschitz for row in rows if row.na == row.nb]


# --- refusals, command line -----------------------------------------------------------------------


def test_what_cannot_be_judged_is_refused() -> None:
    data = record(400)
    with pytest.raises(DataError, match="record longer"):
        api.orders(data[:60])
    with pytest.raises(DataError, match="record longer"):
        api.delay(data[:60])
    with pytest.raises(DataError, match="constant"):
        api.orders(Dataset.from_arrays(np.ones(400), data.experiments[0].y, 0.01))
    (e,) = data.experiments
    infinite = np.where(np.arange(len(e)) == 50, np.inf, e.y)
    for u, y, said in (
        (e.u * 1e200, e.y * 1e200, "below 1e\\+60"),
        (e.u * 1e-200, e.y * 1e-200, "differ by 1e-60"),
        (e.u, infinite, "received inf at sample 50"),
    ):
        unfit = Dataset.from_arrays(u, y, 0.01)
        with pytest.raises(DataError, match=said):
            api.delay(unfit)
        for nk in (None, 1):
            with pytest.raises(DataError, match=said):
                api.orders(unfit, nk=nk)
    with pytest.raises(DataError, match="received inf at sample 50"):
        api.orders(data, validation=Dataset.from_arrays(e.u, infinite, 0.01))
    with pytest.raises(SettingError, match="na: expected whole numbers"):
        api.orders(data, na=0)
    with pytest.raises(SettingError, match="held_out"):
        api.orders(data, held_out=1.0)
    with pytest.raises(SettingError, match="longest"):
        api.delay(data, longest=0)
    with pytest.raises(SettingError, match="confidence"):
        api.delay(data, confidence=1.0)
    with pytest.raises(SettingError, match="criterion"):
        api.orders(data, na=1, nb=1, nk=1).minimum("cic")


def test_command(tmp_path: Path) -> None:
    data = record()
    (e,) = data.experiments
    columns = {"t": 0.01 * np.arange(len(e)), "u": e.u[:, 0], "y": e.y}
    api.write_table(tmp_path / "run.csv", columns, units={"t": "s", "u": "V", "y": "RPM"})
    command = ("orders", "run.csv", "--input", "u", "--output", "y", "--na", "2", "--nb", "2")
    assert "choice: na = 2, nb = 2, nk = 3" in sewfast(tmp_path, *command).out
    found = sewfast(tmp_path, *command, "--nk", "3", "--json").json()
    assert found["choice"] == {"na": 2, "nb": 2, "nk": 3}
    assert found["delay"] is None
    alone = sewfast(tmp_path, "orders", "run.csv", "--input", "u", "--json", *command[-4:]).json()
    assert alone["choice"] == {"na": 2, "nb": 2, "nk": 3}
    api.write_table(tmp_path / "doubt.csv", {"t": columns["t"], "a": e.y, "b": e.y, "u": e.u[:, 0]})
    assert "--output" in refused(tmp_path, "orders", "doubt.csv", "--input", "u")
