"""What `identify` returns goes through everything that takes a model, or is refused in words.

A new kind of model is one more row of `kinds.CASES`.
"""

from __future__ import annotations

import copy
import json
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import called as command
from kinds import CASES, TS, levels, model_of, recording
from sewfast import Controller, Dataset, Ensemble, Gains, Model
from sewfast.equilibrium import linearise
from sewfast.errors import DataError, ModelFileError, SettingError, SewfastError
from sewfast.evidence import bands
from sewfast.models.files import from_dict
from sewfast.trust import judge

CONTROLLER = Controller(
    gains=Gains.standard(0.02, 0.2, 0.0), Ts=TS, counts_per_rev=None, u_min=-5.0, u_max=5.0,
    filter_samples=1,
)  # fmt: skip
REFERENCE = np.repeat([0.0, 2.0, 4.0, 1.0], 60)
every_kind = pytest.mark.parametrize("name", CASES)
BY_DAY = [
    "oe",
    "hammerstein_wiener",
    "grey_box",
    "neural_oe",
    "neural_ss, two inputs",
    "ensemble of mixed kinds",
]
one_of_each = pytest.mark.nightly(
    "the same for every kind", by_day=[*BY_DAY, "neural_ss, integrator", "ensemble, no delay"]
)


def singles(model: Model) -> tuple[Model, ...]:
    return model.members or (model,)


def refusal(model: Model) -> str | None:
    """The words of the refusal where no loop can be closed around the model."""
    if len(model.input_names) > 1:
        return "one input"
    late = "nk|depends on u|answers a sample later"
    return late if any(m.orders["nk"] == 0 for m in singles(model)) else None


@pytest.mark.nightly("the same for every kind", by_day=[*BY_DAY, "oe without evidence"])
@every_kind
def test_check_gives_a_card(name: str) -> None:
    model = model_of(name)
    data, known = recording(model, 300, seed=2), CASES[name].evidence
    for card, evidence in ((model.check(data), known), (model.check(data, recording(model)), True)):
        assert json.dumps(card.to_json(), allow_nan=False)
        assert card.line("free run").verdict == "ok"
        region = card.line("outside training region")
        assert region.verdict in (("ok", "warn") if evidence else ("info",))
        assert (card.bands is not None) == evidence
        assert card.operating is not None
        assert len(card.operating.points) == 9 * data.n_inputs
        assert len(card.operating.members) == (len(model.members) if len(model.members) > 1 else 0)
        assert card.summary in str(card).replace("\n", " ")
        assert not re.search(r"\bnan\b", str(card))
        # names that Python alone has
        assert not re.search(r"\b(training|inputs|model|sewfast)[=.(]", str(card))


@pytest.mark.nightly(
    "the same for every kind",
    by_day=["oe", "grey_box", "neural_ss, two inputs", "ensemble of mixed kinds"],
)
@every_kind
def test_figures_are_drawn(name: str) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    from sewfast.evidence.figures import figures

    card = model_of(name).check(recording(model_of(name), 200, seed=2))
    assert {"residuals", "bode", "poles"} <= set(figures(card))


@every_kind
def test_validate_predict_simulate_and_bands(name: str) -> None:
    model, data = model_of(name), recording(model_of(name), 400, seed=3)
    found = model.validate(data)
    assert found.simulation.fit_percent > 80.0
    assert found.grade in ("good", "fair")
    assert f"verdict: {found.verdict}" in str(found)
    (simulated,), (predicted,) = model.simulate(data), model.predict(data, 5)
    assert simulated.shape == predicted.shape == (400,)
    assert model.title in str(model)
    training = None if CASES[name].evidence else recording(model)
    if training is not None:
        with pytest.raises(SettingError, match="training data"):
            model.bands(data)
    band = bands(model, data, training=training)
    if name != "ensemble of integrators":
        # those drift apart: where their record ends is not known
        assert band.coverage > 0.85
    assert band.n == 380


@one_of_each
@every_kind
def test_run_analyse_tune_and_judge(name: str) -> None:
    model = model_of(name)
    words = refusal(model)
    calls: list[Any] = [
        lambda: sewfast.run(CONTROLLER, model, REFERENCE),
        lambda: sewfast.analyse(CONTROLLER, model, references=[REFERENCE], threads=1),
        lambda: judge(CONTROLLER, model, REFERENCE, refuse=False),
        lambda: sewfast.tune(model, REFERENCE, start=CONTROLLER, evaluations=12, threads=1),
    ]
    for call in calls:
        if words is None:
            assert str(call())
        else:
            with pytest.raises(SettingError, match=words):
                call()


@one_of_each
@every_kind
def test_tune_finds_its_own_start_or_says_why_not(name: str) -> None:
    model = model_of(name)
    settings: dict[str, Any] = {
        "u_min": -5.0, "u_max": 5.0, "counts_per_rev": None, "filter_samples": 1,
        "evaluations": 4, "threads": 1,
    }  # fmt: skip
    words = refusal(model)
    if words is not None:
        with pytest.raises(SettingError, match=words):
            sewfast.tune(model, REFERENCE, **settings)
    else:
        assert sewfast.tune(model, REFERENCE, **settings).controller


@every_kind
def test_margins_and_conversions_work_or_say_what_to_do(name: str) -> None:
    model = model_of(name)
    if model.members:
        with pytest.raises(SettingError, match=r"members|one input"):
            sewfast.margins(CONTROLLER, model, speed=4.0)
        with pytest.raises(SettingError, match="members"):
            model.linearise()
    elif refusal(model) is None:
        assert sewfast.margins(CONTROLLER, model, speed=4.0).Ms > 1.0
    for one in singles(model):
        at = one.linearise(np.zeros(len(one.input_names)))
        assert at.poles.shape == (len(at.A),)
        if hasattr(one, "to_tf"):
            np.testing.assert_allclose(abs(at.poles[0]), abs(one.poles[0]))
        else:
            with pytest.raises(SettingError, match=r"linearise\(u\)"):
                one.to_control()  # type: ignore[attr-defined]
            with pytest.raises(AttributeError, match="no attribute 'to_nothing'"):
                one.to_nothing()  # type: ignore[attr-defined]
    if model.members:
        with pytest.raises(SettingError, match=r"members\[0\]\.linearise"):
            model.to_control()  # type: ignore[attr-defined]


@every_kind
def test_files_pickles_and_copies_are_equal(name: str, tmp_path: Path) -> None:
    model = model_of(name)
    model.save(tmp_path / "m.json")
    twins = [
        sewfast.load_model(tmp_path / "m.json"), pickle.loads(pickle.dumps(model)),
        copy.copy(model), copy.deepcopy(model),
    ]  # fmt: skip
    data = recording(model, 300, seed=4)
    for twin in twins:
        assert twin == model
        assert hash(twin) == hash(model)
        assert len({twin, model}) == 1
        np.testing.assert_array_equal(twin.simulate(data)[0], model.simulate(data)[0])
    changed = model.to_dict() | {"Ts": 2.0 * model.Ts}
    assert from_dict(json.loads(json.dumps(changed))) != model
    assert model != "model"
    others = [n for n in CASES if n != name and CASES[n].evidence]
    assert model != model_of(others[0])


# --- arrays and derivatives -----------------------------------------------------------------------


@every_kind
def test_an_array_is_simulated_from_rest_or_from_a_state(name: str) -> None:
    model = model_of(name)
    n = len(model.input_names)
    u = levels(200, 5, n)
    rest = model.simulate(u)
    assert rest.shape == (200,)
    as_data = Dataset.from_arrays(
        u, None, TS, input_names=model.input_names, input_units=model.input_units,
        output_name=model.output_name, output_unit=model.output_unit,
    )  # fmt: skip
    np.testing.assert_array_equal(rest, model.simulate(as_data, init=0)[0])
    if n == 1:
        np.testing.assert_array_equal(rest, model.simulate(u[:, 0].tolist()))
    state = model.core.rest_state() + 0.2
    moved = model.simulate(u, initial_state=state)
    assert not np.array_equal(moved, rest)
    np.testing.assert_array_equal(moved, model.core.simulate(u, state))


@every_kind
def test_the_jacobian_is_that_of_the_simulation(name: str) -> None:
    model = model_of(name)
    u = levels(80, 6, len(model.input_names))
    state = model.core.rest_state() + 0.1
    found = model.jacobian(u, initial_state=state)
    np.testing.assert_allclose(found.y, model.simulate(u, initial_state=state), rtol=1e-9)
    assert found.theta.shape == (80, len(model.theta))
    assert found.state.shape == (80, len(state))
    assert len(set(model.parameter_names)) == len(model.theta)
    assert len(model.state_names) == len(state)
    scale = np.abs(found.y).max()
    for i, h in enumerate(1e-6 * np.eye(len(state))):
        ahead, back = (model.simulate(u, initial_state=state + d) for d in (h, -h))
        np.testing.assert_allclose(
            found.state[:, i], (ahead - back) / 2e-6, atol=1e-5 * scale, err_msg=str(i)
        )
    if model.members:
        return
    for i, parameter in enumerate(model.parameter_names):
        h = 1e-6 * max(abs(model.theta[i]), 1.0)
        try:
            ahead, back = (_moved(model, i, d).simulate(u, initial_state=state) for d in (h, -h))
        except ModelFileError:
            # a parameter that the integrator holds at its value
            assert model.core.settings["integrator"]
            continue
        slope = (ahead - back) / (2.0 * h)
        size = max(float(np.abs(slope).max()), float(scale))
        np.testing.assert_allclose(found.theta[:, i], slope, atol=1e-4 * size, err_msg=parameter)


def _moved(model: Model, i: int, step: float) -> Model:
    """The model with one parameter changed, by way of its file's own fields."""
    values = model.parameters()
    theta = model.theta.copy()
    theta[i] += step
    if "theta" in values:
        return from_dict(model.to_dict() | {"parameters": {**values, "theta": theta.tolist()}})
    na, shape = model.orders["na"], np.shape(values["b"])
    a, b, offset = theta[:na], theta[na:-1].reshape(shape), float(theta[-1])
    changed = {**values, "a": a.tolist(), "b": b.tolist(), "offset": offset}
    return from_dict(model.to_dict() | {"parameters": changed})


def test_a_jacobian_on_a_data_set_has_one_part_per_experiment() -> None:
    model = model_of("neural_ss")
    data = Dataset.concat([recording(model, n, seed=n) for n in (100, 150)])
    found = model.jacobian(data)
    assert [len(f.y) for f in found] == [100, 150]
    for one, yhat in zip(found, model.simulate(data), strict=True):
        np.testing.assert_allclose(one.y, yhat, rtol=1e-9)


def test_the_median_has_the_derivative_of_the_member_in_the_middle() -> None:
    model = model_of("ensemble of neural_ss")
    u = levels(80, 7, 1)
    found = model.jacobian(u)
    owner = np.array([n.split(":")[0] for n in model.parameter_names]).astype(int)
    runs = np.array([m.simulate(u) for m in model.members])
    middle = runs.argsort(axis=0)[1]
    for k in (10, 40, 79):
        assert set(owner[found.theta[k] != 0.0]) == {middle[k]}


@pytest.mark.parametrize(
    ("name", "u", "state", "words"),
    [
        ("oe", np.zeros((5, 2)), None, r"\(N,\) or \(N, 1\).*\(5, 2\)"),
        ("oe", np.zeros((1, 5)), None, r"\(1, 5\).*time comes first"),
        ("oe, three inputs", np.zeros(5), None, r"\(N, 3\) for u1, u2, u3.*\(5,\)"),
        ("oe", 3.0, None, r"received \(\)"),
        ("oe", np.zeros(0), None, r"received \(0,\)"),
        ("oe", [0.0, 1.0, np.nan], None, "at sample 2"),
        ("oe", ["a", "b"], None, "expected numbers"),
        ("oe", np.zeros(5), np.zeros(3), r"shape \(2,\).*speed\(-1\), speed\(-2\).*\(3,\)"),
        ("oe", np.zeros(5), [0.0, np.inf], "finite"),
        ("oe", np.zeros(5), ["a"], "expected numbers"),
        ("neural_ss", np.zeros(5), [0.0], r"x\[0\], x\[1\]"),
    ],
)
def test_wrong_shapes_are_refused_with_both(name: str, u: Any, state: Any, words: str) -> None:
    for call in (model_of(name).simulate, model_of(name).jacobian):
        with pytest.raises(DataError, match=words):
            call(u, initial_state=state)


def test_a_state_belongs_to_an_array() -> None:
    model: Any = model_of("oe")
    for call in (model.simulate, model.jacobian):
        with pytest.raises(SettingError, match="init"):
            call(recording(model), initial_state=np.zeros(2))


def test_the_callers_array_is_not_changed() -> None:
    u = np.asfortranarray(levels(50, 1, 3)).astype(np.float32)
    before = u.copy()
    model_of("oe, three inputs").simulate(u)
    np.testing.assert_array_equal(u, before)


# --- members that differ, integrators -------------------------------------------------------------


def test_a_member_that_runs_away_on_new_data_does_not_stop_the_check() -> None:
    """The ensemble leaves it out of its runs; sensitivities are those of a member near these."""
    sound: Any = model_of("oe")
    wild = sewfast.LinearOE.from_tf(
        [0.0, 0.5], [1.0, -3.0], TS, input_units=["V"], output_name="speed", output_unit="RPM"
    )
    model = Ensemble.of([wild, sound, sound], training=dict(sound.training))
    with pytest.raises(SewfastError):
        wild.simulate(recording(sound))
    card = model.check(recording(sound, 500, seed=2))
    assert card.line("free run").verdict == "ok"
    assert card.tests


def test_an_integrator_is_linearised_where_it_keeps_its_output() -> None:
    model = model_of("neural_ss, integrator")
    found = sewfast.analyse(CONTROLLER, model, speeds=[10.0], references=[REFERENCE], threads=1)
    point = found.loops[0].points[0]
    assert point.y == pytest.approx(10.0, rel=1e-6)
    assert np.isinf(point.gain)
    state = linearise(model.core, np.array([point.u]), level=point.y).state
    still = model.simulate(np.full(50, point.u), initial_state=state)
    np.testing.assert_allclose(still, point.y, atol=1e-2)


@pytest.mark.parametrize("name", ["oe, integrator", "neural_ss, integrator"])
def test_an_integrators_drift_is_what_its_output_moves_by(name: str) -> None:
    model = model_of(name)
    point = model.linearise(2.0)
    run = model.simulate(np.full(3000, 2.0))
    assert not point.settled
    assert point.drift == pytest.approx(run[-1] - run[-2], rel=1e-6)
    assert model_of("neural_ss").linearise(2.0).drift == 0.0


# --- the command line -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ensemble of two structures", "ensemble of mixed kinds"])
def test_ensembles_on_the_command_line(name: str, tmp_path: Path) -> None:
    model = model_of(name)
    model.save(tmp_path / "m.json")
    CONTROLLER.save(tmp_path / "c.json")
    e = recording(model, 300, seed=2).experiments[0]
    columns = {"t": TS * np.arange(300), "u": e.u[:, 0], "speed": e.y}
    sewfast.write_table(tmp_path / "new.csv", columns, units={"u": "V", "speed": "RPM"})
    t = TS * np.arange(len(REFERENCE))
    sewfast.write_table(tmp_path / "r.csv", {"t": t, "r": REFERENCE}, units={"r": "RPM"})
    assert "in short: " in command(tmp_path, "check", "m.json", "new.csv").out
    assert "verdict: " in command(tmp_path, "validate", "m.json", "new.csv").out
    run = ("--on", "m.json", "--reference", "r.csv", "-o", "run.csv")
    assert "error" in command(tmp_path, "run", "c.json", *run).out
    tune = ("--reference", "r.csv", "--start", "c.json", "--evaluations", "8", "-o", "new.json")
    assert "evaluations" in command(tmp_path, "tune", "m.json", *tune).out
    both = command(tmp_path, "tune", "m.json", *tune, "--u-max", "3", "--filter", "2", done=2)
    assert "received --u-max, --filter; leave them out" in both.err


def test_a_position_is_tuned_on_the_command_line(tmp_path: Path) -> None:
    model_of("neural_ss, integrator").save(tmp_path / "m.json")
    CONTROLLER.save(tmp_path / "c.json")
    t = TS * np.arange(len(REFERENCE))
    sewfast.write_table(tmp_path / "r.csv", {"t": t, "r": REFERENCE}, units={"r": "RPM"})
    tune = ("tune", "m.json", "--reference", "r.csv", "--evaluations", "8", "-o", "new.json")
    assert "evaluations" in command(tmp_path, *tune, "--u-max", "5", "--u-min", "-5").out
    assert "evaluations" in command(tmp_path, *tune, "--start", "c.json").out
