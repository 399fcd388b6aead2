"""Blocks of the whole record, convex weights, and the table of structures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import sewfast
from plants import bent_data, linear_data
from sewfast import Dataset, Ensemble, Experiment, LinearOE, NeuralSS, _core, identify, validate
from sewfast.errors import DataError, Interrupted
from sewfast.identification import table
from sewfast.identification.blocks import COUNT, Blocks, Mixture, Row, blocked, combined
from sewfast.identification.mixture import MOST_MEMBERS
from sewfast.identification.table import Table
from sewfast.identification.task import Clock, Pool, Task

F = NDArray[np.float64]
QUICK: dict[str, Any] = {"nx": 1, "nk": 1, "hidden": 4, "starts": 2, "iterations": 30}


# --- blocks ---------------------------------------------------------------------------------------


def test_every_sample_is_held_out_once_and_never_fitted_then() -> None:
    data = Dataset.concat([linear_data(1000, name="a"), linear_data(600, name="b")])
    folds = blocked(data)
    assert len(folds) == COUNT
    ranges = [[(s["name"], s["range"]) for s in f.sources] for f in folds]
    third = [("a", "800:1000"), ("b", "0:200")]
    assert ranges == [[("a", "0:400")], [("a", "400:800")], third, [("b", "200:600")]]
    for fold in folds:
        assert len(fold.fitted) + sum(s["samples"] for s in fold.sources) == len(data)
    blocks = Blocks(data, folds)
    # but for the outputs that give the state where an experiment begins
    assert len(blocks.weights) == len(data) - 2 * 20
    assert len(blocks.together.fitted) == len(data)


def test_a_part_that_was_not_measured_is_not_held_out() -> None:
    (e,) = linear_data(800).experiments
    y = e.y.copy()
    y[:200] = np.nan
    folds = blocked(Dataset.from_arrays(e.u, y, 0.01))
    assert [[s["range"] for s in f.sources] for f in folds] == [
        ["200:400"],
        ["400:600"],
        ["600:800"],
    ]


@pytest.mark.parametrize("samples", [60, 150])
def test_too_few_samples_have_no_blocks(samples: int) -> None:
    assert blocked(linear_data(samples)) == ()


def test_an_input_that_moves_once_has_no_blocks() -> None:
    u = np.r_[np.zeros(100), np.ones(900)]
    assert blocked(Dataset.from_arrays(u, np.cumsum(u), 0.01)) == ()


def test_validation_data_are_the_only_block() -> None:
    (only,) = blocked(linear_data(400), linear_data(300, seed=3))
    assert only.is_given
    assert len(only.fitted) == 400


@pytest.mark.parametrize(
    ("samples", "folds", "pieces"), [(6_600, 4, 1), (8_000, 3, 2), (30_000, 1, 4)]
)
def test_many_data_are_judged_by_fewer_blocks_that_are_spread(
    samples: int, folds: int, pieces: int
) -> None:
    data = linear_data(samples)
    found = blocked(data)
    assert len(found) == folds
    assert {len(f.held.experiments) for f in found} == {pieces}
    scored = sum(s["samples"] for f in found for s in f.sources)
    assert scored >= 5_000
    (last,) = (e for e in found[-1].held.experiments[-1:])
    # the outputs before a block are known, and give its state
    assert last.initial_samples(20) == 200
    assert np.isfinite(last.y).all()


def test_a_network_has_to_halve_the_error_to_need_the_input_of_the_same_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = bent_data(600, noise=0.02)
    for error, stays in ((0.6, False), (0.4, True)):
        asked = Table(_task(data), Blocks(data, blocked(data)), Pool(1, Clock(None), None))

        def stage(wanted: Any, *_: Any, error: float = error, asked: Table = asked) -> list[Row]:
            rows = []
            for s, _ in wanted:
                r = np.full(len(asked.blocks.weights), 1.0 if s.nk else error)
                rows.append(Row("neural_ss", 3, s, (), (), r, asked.blocks.errors(r)))
            asked.rows |= {r.found: r for r in rows}
            return rows

        monkeypatch.setattr(asked, "_stage", stage)
        asked.linear.search(None)
        kept = asked._screened()
        assert any(r.found.nk == 0 for r in kept) == stays
        assert any(s.nk == 0 for s in asked.rows) == stays


def _task(data: Dataset) -> Task:
    return Task(data)


# --- weights --------------------------------------------------------------------------------------


def rows_of(residuals: F, blocks: Blocks, parameters: list[int]) -> list[Row]:
    return [
        Row("oe", p, None, (), (), r, blocks.errors(r))
        for r, p in zip(residuals, parameters, strict=True)
    ]


@pytest.fixture(scope="module")
def blocks() -> Blocks:
    data = linear_data(1000)
    return Blocks(data, blocked(data))


def drawn(blocks: Blocks, *sizes: float) -> F:
    found = np.random.default_rng(0).normal(size=(len(sizes), len(blocks.weights)))
    found *= np.array(sizes)[:, None]
    return found


def test_models_with_independent_errors_share_by_their_variances(blocks: Blocks) -> None:
    found = combined(rows_of(drawn(blocks, 1.0, 1.0, 1.8), blocks, [3, 3, 3]), blocks)
    np.testing.assert_allclose(found.weights, [0.433, 0.433, 0.134], atol=0.04)
    assert found.errors.rmse == pytest.approx(0.658, rel=0.1)


def test_the_simplest_of_equal_models_is_alone(blocks: Blocks) -> None:
    (one,) = drawn(blocks, 1.0)
    rows = rows_of(np.array([1.001 * one, one, 0.999 * one]), blocks, [2, 4, 9])
    assert combined(rows, blocks).rows == (rows[0],)


def test_a_model_that_errs_more_has_no_weight(blocks: Blocks) -> None:
    good, noise = drawn(blocks, 1.0, 1.0)
    rows = rows_of(np.array([good + 2.0 * noise, good]), blocks, [2, 9])
    assert combined(rows, blocks).rows == (rows[1],)


def test_a_mixture_is_judged_as_the_members_that_it_has(blocks: Blocks) -> None:
    rows = rows_of(drawn(blocks, 1.0, 1.2, 1.5), blocks, [3, 3, 3])
    wanted = Mixture.of(rows, blocks)
    # one network of the scarcest structure must not be all that is left
    shares, found = wanted.of_members(1, blocks)
    assert shares.tolist() == [1.0, 1.0, 1.0]
    thirds = blocks.errors(np.mean([r.residual for r in rows], axis=0))
    assert found.errors.rmse == pytest.approx(thirds.rmse)
    shares, found = wanted.of_members(15, blocks)
    assert found.errors.rmse == pytest.approx(wanted.errors.rmse, rel=0.01)
    # a third of a model that errs five times as much is worse than none
    rows = rows_of(drawn(blocks, 1.0, 1.2, 5.0), blocks, [3, 3, 3])
    shares, found = Mixture.of(rows, blocks).of_members(2, blocks)
    assert found.rows == tuple(rows[:2])


def test_a_motor_is_fitted_to_the_whole_record() -> None:
    # in blocks of 625 samples, its friction is lost in the limit of current: 28 RPM
    machine, parts = sewfast.VirtualMachine(5), list[Dataset]()
    for name in ("chirp_lo_hi", "saturating"):
        machine.reset()
        u = sewfast.signals.excitation(name)
        y = sewfast.speed_from_counts(machine.run(u).counts, 1e-3, machine.counts_per_rev)
        parts.append(Dataset.from_arrays(u, y, 1e-3, input_units="V", output_unit="RPM"))
    task = _task(Dataset.concat(parts))
    asked = Table(task, Blocks(task.data, blocked(task.data)), Pool(2, Clock(None), None))
    asked._try_motor()
    (row,) = asked.rows.values()
    assert row.kind == "grey_box"
    assert row.rmse < 6.0


def test_a_sample_without_weight_does_not_count() -> None:
    residuals, weights = np.array([[1.0, 3.0], [5.0, 0.0]]), np.array([1.0, 0.0])
    assert _core.convex_weights(residuals, weights).tolist() == [1.0, 0.0]


def test_a_model_that_runs_away_is_refused() -> None:
    with pytest.raises(DataError, match="leave out models that run away"):
        _core.convex_weights(np.array([[1.0, np.inf]]), np.ones(1))


# --- the model ------------------------------------------------------------------------------------


def test_a_bent_plant_gets_networks_and_their_weights_are_told() -> None:
    model = identify(bent_data(600, noise=0.02), **QUICK)
    choice = model.training["choice"]
    weights = [c["weight"] for c in choice["candidates"] if "weight" in c]
    assert sum(weights) == pytest.approx(1.0, abs=0.01)
    assert [d["range"] for d in choice["held_out"]] == ["0:150", "150:300", "300:450", "450:600"]
    assert " %" in str(model)
    verdict = model.training["verdict"]
    assert verdict["grade"] == "good"
    assert len(verdict["blocks"]) == COUNT
    assert min(verdict["blocks"]) <= verdict["fit_percent"] <= max(verdict["blocks"])
    assert "block by block" in verdict["text"]


@pytest.mark.parametrize(
    ("pole", "sizes"),
    [(0.9, [(2, 4)]), (1.0, [(2, 2), (2, 4), (3, 2), (3, 4)])],
)
def test_several_integrators_are_tried_where_the_record_shows_one_and_one_else(
    pole: float, sizes: list[tuple[int, int]]
) -> None:
    u = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 150), 8)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + 0.1 * u[k - 1]
    y += 0.01 * np.random.default_rng(1).normal(size=len(u))
    task = _task(Dataset.from_arrays(u, y, 0.01))
    folds = blocked(task.data)
    tried = Table(task, Blocks(task.data, folds), Pool(1, Clock(None), None))
    tried.linear.search(None)
    found = tried._likely(tried._outputs())
    assert [(s.nx, s.hidden) for s in found if s.integrator] == sizes


def test_one_start_is_one_network() -> None:
    model = identify(bent_data(600), model="neural_ss", **{**QUICK, "starts": 1})
    assert isinstance(model, NeuralSS)


def test_the_first_member_is_of_the_structure_with_most_weight() -> None:
    model = identify(bent_data(500, noise=0.05), nk=1, starts=2, iterations=20)
    assert isinstance(model, Ensemble)
    assert len(model.members) <= MOST_MEMBERS
    listed = [c for c in model.training["choice"]["candidates"] if "weight" in c]
    heaviest = max(listed, key=lambda c: c["weight"])
    assert model.members[0].kind == heaviest["kind"]
    assert model.members[0].orders["nk"] == 1


def test_shifting_the_levels_changes_nothing_but_them() -> None:
    (e,) = bent_data(600, noise=0.02).experiments
    one, other = (
        identify(Dataset.from_arrays(e.u + du, e.y + dy, 0.01), **QUICK)
        for du, dy in ((0.0, 0.0), (24.5, 293.15))
    )
    scale = float(np.std(e.y))
    (a,), (b,) = (
        one.simulate(Dataset.from_arrays(e.u, e.y, 0.01)),
        other.simulate(Dataset.from_arrays(e.u + 24.5, e.y + 293.15, 0.01)),
    )
    assert np.max(np.abs(b - a - 293.15)) < 0.02 * scale


def test_an_outlier_among_the_starts_is_ignored() -> None:
    data = bent_data(600, noise=0.02)
    plain = identify(data, model="neural_ss", **{**QUICK, "starts": 4})
    assert isinstance(plain, Ensemble)
    wild = [replace(m, core=_scaled(m)) if i == 1 else m for i, m in enumerate(plain.members)]
    test = bent_data(400, seed=7)
    errors = [validate(Ensemble.of(m), test).simulation.rmse for m in (plain.members, wild)]
    assert errors[1] < 2.0 * errors[0]


def _scaled(model: sewfast.Model) -> Any:
    return _core.NeuralSS(**model.core.settings, theta=3.0 * model.core.theta)


def test_a_stop_before_the_networks_keeps_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(self: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(table.Table, "_screened", stopped)
    with pytest.raises(Interrupted) as e:
        identify(bent_data(600, noise=0.02))
    best = e.value.best
    assert {m.kind for m in best.members or (best,)} <= {"oe", "grey_box"}
    assert best.training["termination"] == "interrupted"
    assert validate(best, bent_data(400, seed=5)).simulation.rmse < np.inf


def test_a_linear_model_is_kept_when_the_motor_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(self: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(table.Table, "_try_motor", stopped)
    with pytest.raises(Interrupted) as e:
        identify(bent_data(600, noise=0.02))
    assert isinstance(e.value.best, LinearOE)


@pytest.mark.parametrize(
    ("unit", "order"), [("RPM", ["motor", "linear"]), ("mm", ["linear", "motor"])]
)
def test_only_a_speed_asks_for_a_motor_before_the_larger_linear_models(
    monkeypatch: pytest.MonkeyPatch, unit: str, order: list[str]
) -> None:
    """A joint takes longer than all of these: a budget would end with the smallest."""
    done: list[str] = []

    def stopped(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(table.Table, "_try_motor", lambda _: done.append("motor"))
    monkeypatch.setattr(table.LinearTable, "search", lambda *_: done.append("linear"))
    monkeypatch.setattr(table.Table, "_screened", stopped)
    (e,) = bent_data(600, noise=0.02).experiments
    with pytest.raises(Interrupted):
        identify(Dataset.from_arrays(e.u, e.y, 0.01, output_unit=unit))
    assert done == order


def test_a_curve_without_memory_gets_a_network() -> None:
    # linear fits without some of the blocks end at a trend, from which no network can start
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 20), 15)
    y = np.tanh(2.0 * u) + 0.02 * rng.normal(size=len(u))
    model = identify(Dataset.from_arrays(u, y, 0.01), starts=2, iterations=20)
    assert {m.kind for m in model.members or (model,)} & {"neural_ss", "neural_oe"}
    assert model.training["verdict"]["fit_percent"] > 80.0


@pytest.mark.nightly("a default search")
def test_a_rectified_output_is_no_question_of_a_delay() -> None:
    rng = np.random.default_rng(0)
    rng.normal(size=600)
    u = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 21), 15)[:300]
    x = np.zeros(300)
    for k in range(1, 300):
        x[k] = 0.9 * x[k - 1] + 0.1 * np.tanh(2.0 * u[k - 1])
    y = np.abs(x) + 0.005 * rng.normal(size=300)
    model = identify(Dataset.from_arrays(u, y, 0.01), starts=2, iterations=20)
    assert "abs" in {c.get("output") for c in model.training["choice"]["candidates"]}
    only = identify(
        Dataset.from_arrays(u, y, 0.01), model="neural_ss", output="abs", nx=1, starts=2
    )
    assert {m.kind for m in only.members or (only,)} == {"neural_ss"}


def test_weights_of_samples_count_in_the_fit_of_a_block() -> None:
    (e,) = bent_data(600, noise=0.02).experiments
    y, w = e.y.copy(), np.ones(600)
    y[320:330] += 20.0
    w[320:330] = 0.0
    spoilt = Experiment(e.u, y, {}, "spoilt", 0, weights=w)
    data = replace(Dataset.from_arrays(e.u, y, 0.01), experiments=(spoilt,))
    verdict = identify(data, **QUICK).training["verdict"]
    assert min(verdict["blocks"]) > 80.0
