"""Ensembles: a model like any other; files of every version are read, damaged ones named."""

import copy
import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plants import bent_data, linear_data
from sewfast import _core
from sewfast.arrays import FloatArray
from sewfast.control.loop import run
from sewfast.dataset import Dataset
from sewfast.dynamic_model import DynamicModel
from sewfast.errors import FitError, ModelFileError, SettingError
from sewfast.models import Ensemble, LinearOE, Model, load_model, model_schema
from sewfast.tuning import tune

NAMES = (0.01, ("u",), "y", ("V",), "RPM")
FILES = Path(__file__).parents[1] / "files"
KEPT = sorted(FILES.glob("*/*.json"))
KINDS = ("arx", "iv", "oe", "neural_oe", "neural_ss", "ensemble")


def lag(gain: float, pole: float = 0.5, **options: Any) -> LinearOE:
    core = _core.LinearModel(np.array([-pole]), np.array([[gain]]), 1, 0.0)
    return LinearOE(core, *NAMES, **options)


def three(combine: Any = "median") -> Ensemble:
    return Ensemble.of([lag(1.0), lag(2.0, 0.7), lag(9.0)], combine)


def test_a_member_is_linearised_in_the_middle_of_the_ensembles_inputs(tmp_path: Path) -> None:
    model = Ensemble.of([lag(1.0), lag(2.0, 0.7)], training={"input_range": [[1.0, 3.0]]})
    model.save(tmp_path / "m.json")
    for ensemble in (model, load_model(tmp_path / "m.json")):
        assert ensemble.members[1].linearise().u.tolist() == [2.0]
    # a file keeps it once
    assert [m["training"] for m in model.parameters()["members"]] == [{}, {}]


# --- a model like any other -------------------------------------------------------------------


def midmean(runs: FloatArray, axis: int) -> FloatArray:
    """Of 5 to 7 members: the mean without the two least and the two largest."""
    found: FloatArray = np.sort(runs, axis=axis)[2:-2].mean(axis=axis)
    return found


@pytest.mark.parametrize("combine", ["median", "midmean"])
@pytest.mark.parametrize("count", range(1, 5))
def test_a_midmean_of_four_is_their_median(combine: Any, count: int) -> None:
    data = bent_data(40)
    lags = [lag(g, p) for g, p in ((1.0, 0.5), (2.0, 0.7), (9.0, 0.5), (4.0, 0.6))[:count]]
    expected = Ensemble.of(lags, "median").simulate(data)[0]
    np.testing.assert_array_equal(Ensemble.of(lags, combine).simulate(data)[0], expected)


def test_a_midmean_follows_both_of_two_groups_and_no_quarter_that_goes_astray() -> None:
    u, few, many = np.ones(200), [lag(1.0)] * 7, [lag(2.0)] * 8
    for combine, expected in (("median", 2.0), ("midmean", 11.0 / 7.0)):
        found = Ensemble.of([*few, *many], combine).simulate(u)[-1]
        assert found == pytest.approx(expected * lag(1.0).dc_gain[0])
    # the median of these jumps if one member changes sides
    other = Ensemble.of([*few, *many[1:], lag(1.0)], "midmean").simulate(u)[-1]
    assert other == pytest.approx(10.0 / 7.0 * lag(1.0).dc_gain[0])
    astray = [lag(1.0)] * 11 + [lag(50.0)] * 4
    assert Ensemble.of(astray, "midmean").simulate(u)[-1] == pytest.approx(lag(1.0).dc_gain[0])


@pytest.mark.parametrize(
    ("combine", "reduce"), [("median", np.median), ("mean", np.mean), ("midmean", midmean)]
)
def test_runs_are_combined_sample_by_sample(combine: Any, reduce: Any) -> None:
    lags = [lag(g, p) for g, p in ((1.0, 0.5), (2.0, 0.7), (9.0, 0.5), (4.0, 0.6), (3.0, 0.8))]
    model, data = Ensemble.of(lags, combine), bent_data(60)
    for free in (lambda m: m.simulate(data), lambda m: m.predict(data, 2)):
        each = np.array([free(m)[0] for m in model.members])
        np.testing.assert_array_equal(free(model)[0], reduce(each, axis=0))


def test_every_member_has_its_own_initial_state() -> None:
    model, e = three(), bent_data(60).experiments[0]
    expected = np.concatenate([m.initial_state(e, 20) for m in model.members])
    np.testing.assert_array_equal(model.initial_state(e, 20), expected)
    np.testing.assert_array_equal(model.initial_state(e, 0), np.zeros(3))


def test_it_validates_and_tells_its_members() -> None:
    model, data = three(), bent_data(200)
    assert np.isfinite(model.validate(data).simulation.rmse)
    assert model.orders == {"members": 3, "na": 1, "nb": 1, "nk": 1}
    assert "median of 3 x Linear output error" in str(model)


@pytest.mark.parametrize("combine", ["median", "mean", "midmean"])
def test_its_jacobian_is_the_derivative_of_its_run(combine: Any) -> None:
    poles, gains = (0.5, 0.7, 0.6), (1.0, 2.0, 1.5)
    u, state = bent_data(30).experiments[0].u, np.array([0.1, 0.2, 0.3])

    def core(change: float) -> Any:
        lags = [lag(g + change, p) for g, p in zip(gains, poles, strict=True)]
        return Ensemble.of(lags, combine).core

    run, rows = core(0.0).jacobian(u, state)
    np.testing.assert_array_equal(run, core(0.0).simulate(u, state))
    step = 1e-6
    found = (core(step).simulate(u, state) - core(-step).simulate(u, state)) / (2 * step)
    per_member = rows.shape[1] // 3
    gain_columns = [1 + i * per_member for i in range(3)]
    np.testing.assert_allclose(rows[:, gain_columns].sum(axis=1), found, rtol=1e-6, atol=1e-8)


def test_a_member_that_runs_away_is_left_out_and_most_must_stay() -> None:
    wild = [lag(1.0, 1e200) for _ in range(2)]
    data = bent_data(40)
    good = [lag(1.0), lag(2.0), lag(3.0)]
    kept = Ensemble.of([*good, wild[0]]).simulate(data, init=0)[0]
    np.testing.assert_array_equal(kept, Ensemble.of(good).simulate(data, init=0)[0])
    with pytest.raises(FitError, match="expected at least half of 3 members"):
        Ensemble.of([good[0], *wild]).simulate(data, init=0)


def test_what_is_no_ensemble_is_refused() -> None:
    with pytest.raises(SettingError, match="expected 1 to 1000 models, received 0"):
        Ensemble.of([])
    with pytest.raises(SettingError, match="received Ensemble"):
        Ensemble.of([three()])
    with pytest.raises(SettingError, match="midmean, median, mean"):
        three("mode")
    other = LinearOE(lag(1.0).core, 0.02, ("u",), "y", ("V",), "RPM")
    with pytest.raises(SettingError, match="models of one plant"):
        Ensemble.of([lag(1.0), other])


# --- as a plant --------------------------------------------------------------------------------


def test_a_controller_is_tuned_on_every_member_and_run_on_the_first() -> None:
    members = [lag(g, 0.95) for g in (4.0, 5.0, 6.0)]
    reference = np.repeat([0.0, 100.0, 0.0], 100)
    options: dict[str, Any] = {"counts_per_rev": None, "evaluations": 12, "threads": 1}
    limits = {"u_min": -20.0, "u_max": 20.0}
    together = tune(Ensemble.of(members), [reference], **limits, **options)
    apart = tune(members, [reference], start=together.start, **options)
    assert together.controller.gains == apart.controller.gains
    ran = run(together.controller, Ensemble.of(members), reference)
    alone = run(together.controller, members[0], reference)
    np.testing.assert_array_equal(ran.y, alone.y)
    assert ran.plant == "ensemble, first member"


# --- files ------------------------------------------------------------------------------------


def test_a_saved_ensemble_is_the_same_model(tmp_path: Path) -> None:
    model = Ensemble.of(
        [lag(1.0, training={"weight_decay": 1e-4}), lag(2.0)], "mean", {"cost": 0.5}
    )
    model.save(tmp_path / "m.json")
    for again in (load_model(tmp_path / "m.json"), pickle.loads(pickle.dumps(model))):
        assert isinstance(again, Ensemble)
        assert again.to_dict() == model.to_dict()
        data = bent_data(50)
        np.testing.assert_array_equal(again.simulate(data)[0], model.simulate(data)[0])


@pytest.mark.parametrize("path", [p for p in KEPT if p.stem in KINDS], ids=lambda p: p.stem)
def test_files_of_every_version_are_read_and_answer_as_then(path: Path) -> None:
    model = load_model(path)
    assert model.kind == path.stem
    expected = json.loads((path.parent / "answers.json").read_text())[path.stem]
    found = model.simulate(bent_data(40, seed=3), init=0)[0]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_a_file_of_every_kind_is_kept() -> None:
    assert {p.stem for p in KEPT} >= set(KINDS)


@pytest.mark.parametrize("path", [p for p in KEPT if p.stem in KINDS], ids=lambda p: p.stem)
def test_kept_files_follow_the_published_schema(path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(model_schema())
    values = json.loads(path.read_text())
    validator.validate(values)
    for field in ("kind", "Ts", "parameters"):
        broken = {k: v for k, v in values.items() if k != field}
        assert not validator.is_valid(broken)
    values["parameters"]["other"] = 1
    assert not validator.is_valid(values)


def edited(change: Any) -> dict[str, Any]:
    head = {"format": DynamicModel.FORMAT, "version": DynamicModel.VERSION}
    values = copy.deepcopy({**head, **three().to_dict()})
    change(values["parameters"])
    return values


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: p.update(combine="mode"), "'parameters.combine'"),
        (lambda p: p.update(members=[]), r"'parameters.members'.*1 to 1000"),
        (lambda p: p.update(members=p["members"] * 400), "1 to 1000 models"),
        (lambda p: p.update(other=1), "parameters.other"),
        (lambda p: p["members"][1].update(kind="ensemble"), r"members\[1\].kind"),
        (lambda p: p["members"][1]["parameters"].update(nk=-1), r"members\[1\].parameters.nk"),
        (lambda p: p["members"][2]["parameters"].update(a="x"), r"members\[2\].parameters.a"),
        (lambda p: p["members"][0].pop("parameters"), r"members\[0\].parameters"),
        (lambda p: p["members"][0]["parameters"].update(b=[[1.0], [1.0]]), "inputs"),
    ],
)
def test_damage_is_named(tmp_path: Path, change: Any, words: str) -> None:
    path = tmp_path / "m.json"
    path.write_text(json.dumps(edited(change)))
    with pytest.raises(ModelFileError, match=words):
        load_model(path)


def test_hostile_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    for text in ("[" * 100_000, '{"a":' * 100_000, '{"format": NaN}', '{"format": 1e999}'):
        path.write_text(text)
        with pytest.raises(ModelFileError, match=r"m\.json"):
            load_model(path)
    path.write_text(" " * (16 * 1024 * 1024 + 1))
    with pytest.raises(ModelFileError, match="16 MB"):
        load_model(path)


def test_an_odd_story_does_not_upset_printing() -> None:
    stories: list[Any] = [3, {"candidates": 3}, {"candidates": [1, {}, {"free_run_rmse": "x"}]}]
    for story in stories:
        assert "median" in str(Ensemble.of([lag(1.0)], "median", {"choice": story}))


def test_several_inputs() -> None:
    data: Dataset = linear_data(80, inputs=2)
    core = _core.LinearModel(np.array([-0.5]), np.array([[1.0], [2.0]]), 1, 0.0)
    member: Model = LinearOE(core, 0.01, data.input_names, "speed", ("V", "V"), "RPM")
    assert len(Ensemble.of([member, member]).simulate(data)[0]) == 80
