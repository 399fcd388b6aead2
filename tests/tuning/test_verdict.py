"""The default limit of Ms, and the verdict on tuned gains."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import refused, sewfast
from kinds import model_of
from loops import QUIET
from sewfast import _core, pareto, signals
from sewfast.control import Controller, Gains
from sewfast.control.defaults import drive_references
from sewfast.control.loop import run
from sewfast.control.margins import levels_over, margins, operating_point
from sewfast.dataset import Dataset
from sewfast.errors import FitError, SettingError
from sewfast.evidence.region import training_region
from sewfast.machine import VirtualMachine
from sewfast.models import Ensemble, LinearOE, Model
from sewfast.trust import judge
from sewfast.tuning import tune
from sewfast.tuning import verdict as verdicts
from sewfast.tuning.judge import verdict_on
from sewfast.tuning.objective import LARGEST_MS, Constraints, Cost
from sewfast.tuning.robustness import _levels
from sewfast.tuning.task import Budget, TuningTask
from sewfast.tuning.verdict import GRADES, Objection, Verdict, _at_limit, command_for, verdict_of

SHORT = signals.reference("trapezoid")[:900]
FIXED: dict[str, Any] = {"variables": ["alpha"], "evaluations": 10, "seed": 0}
"""A search that changes nothing in the loop."""


def drive(gain: float = 490.0, **record: Any) -> LinearOE:
    p, q = math.exp(-0.001 / 0.252), math.exp(-0.001 / 0.0074)
    b = gain * (1 - p) * (1 - q) / 2
    core = _core.LinearModel(np.array([-p - q, p * q]), np.array([[b, b]]), 1, 0.0)
    known = {"input_range": [[-20.0, 20.0]], **record}
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), known)


def with_ms_of(limit: float, plant: Model, level: float, start: Controller) -> Controller:
    """The controller with the share of its gain at which Ms is this."""
    low, high = 1e-3, 30.0
    about = plant if hasattr(plant, "to_tf") else operating_point(plant, level)
    for _ in range(50):
        middle = math.sqrt(low * high)
        scaled = replace(start, gains=replace(start.gains, Kp=middle * start.gains.Kp))
        is_calm = margins(scaled, about, speed=level).Ms < limit
        low, high = (middle, high) if is_calm else (low, middle)
    return scaled


# --- The default limit ----------------------------------------------------------------------------


def test_without_a_limit_of_its_own_a_search_keeps_to_the_default() -> None:
    # a command that may chatter pays for a large Ms
    settings: dict[str, Any] = {
        "cost": Cost(chatter=0.0), "evaluations": 1000, "threads": 2, "variations": [(1.0, 0)],
    }  # fmt: skip
    free = tune(drive(), SHORT, constraints=Constraints(Ms=math.inf), **settings)
    assert margins(free.pid, drive()).Ms > 1.1 * LARGEST_MS
    assert "Ms not limited" in str(free)
    assert free.verdict.grade in ("fair", "poor")
    assert "close to instability" in (free.warning or "")
    usual = tune(drive(), SHORT, **settings)
    assert margins(usual.pid, drive()).Ms <= 1.001 * LARGEST_MS
    assert usual.constraints == Constraints(Ms=LARGEST_MS)
    assert (usual.verdict.grade, usual.warning) == ("good", None)
    assert "Ms <= 1.8" in str(usual)
    assert usual.cost >= free.cost
    front = pareto(drive(), SHORT, evaluations=200, size=10, threads=2)
    assert max(margins(c, drive()).Ms for c in front) <= 1.001 * LARGEST_MS
    assert front.verdict.grade == "good"


def test_an_objective_has_no_default_limit() -> None:
    front = pareto(
        drive(), SHORT, objectives=["tracking", "Ms"], cost=Cost(chatter=0.0), evaluations=3000,
        threads=2, variations=[(1.0, 0)],
    )  # fmt: skip
    assert front.values[:, 1].max() > LARGEST_MS


@pytest.mark.nightly(
    "every kind on both sides", by_day=["linear-1.1", "neural_oe-0.9", "ensemble of neural_oe-1.1"]
)
@pytest.mark.parametrize("share", [0.9, 1.1])
@pytest.mark.parametrize("kind", ["linear", "neural_oe", "ensemble of neural_oe"])
def test_gains_above_the_limit_are_kept_and_said_if_there_are_no_others(
    kind: str, share: float
) -> None:
    """Gains just below and just above the limit at the level where the loop is liveliest."""
    model, level, start = drive(), 500.0, QUIET
    if kind != "linear":
        model, level = model_of("neural_oe"), 1.0
        gains = Gains.standard(0.5, 0.2, u_unit="V", y_unit=model.output_unit)
        start = Controller(gains, Ts=model.Ts, u_min=-20, u_max=20)
    r = level * np.repeat([0.0, 1.0, 2.0], 150)
    levels = levels_over(0.0, 2.0 * level, 0.0)
    worst = {lv: margins(start, model, speed=lv).Ms for lv in levels}
    at_limit = with_ms_of(LARGEST_MS, model, max(worst, key=lambda lv: worst[lv]), start)
    start = replace(at_limit, gains=replace(at_limit.gains, Kp=share * at_limit.gains.Kp))
    plant = model if not kind.startswith("ensemble") else Ensemble.of([model, model], "mean")
    found = tune(plant, [r], start=start, **FIXED)
    assert found.pid.gains.Kp == pytest.approx(start.gains.Kp)
    said = [o for o in found.verdict.objections if o.text.startswith("Ms is ")]
    assert bool(said) is (share > 1.0)
    if said:
        assert "no gains with at most 1.8 were found" in said[0].remedy
        assert str(said[0]) in str(found)
    # with the gain free there are others
    kept = tune(plant, [r], start=start, evaluations=60, variables=["Kp"])
    assert max(margins(kept.pid, model, speed=lv).Ms for lv in worst) <= LARGEST_MS * 1.001


def test_the_progress_of_searches_with_wider_limits_goes_on() -> None:
    done: list[tuple[int, int]] = []
    tune(
        drive(), [SHORT], start=with_ms_of(2.4, drive(), 0.0, QUIET), variables=["alpha"],
        evaluations=2000, feedforward="none",
        progress=lambda now, total, _: done.append((now, total)),
    )  # fmt: skip
    assert done == sorted(done)
    assert max(total for _, total in done) > 2000
    assert all(now <= total for now, total in done)


def test_ms_is_taken_on_both_sides_and_at_every_point() -> None:
    model = model_of("grey_box")
    r = 5.0 * np.repeat([0.0, 1.0, 0.0, -1.0], 100)
    gains = Gains.standard(1.0, 0.05, u_unit="V", y_unit=model.output_unit)
    base = Controller(gains, Ts=model.Ts, u_min=-20, u_max=20)
    lively = with_ms_of(2.4, model, 4.5, base)
    assert "about 4.5 " in (tune(model, [r], start=lively, **FIXED).warning or "")
    # a schedule that is lively only where the references do not stay
    quiet, hot = QUIET.gains, with_ms_of(2.5, drive(), 0.0, QUIET).gains
    scheduled = replace(QUIET, schedule=((100.0, hot), (1000.0, quiet)))
    found = tune(drive(), [np.repeat([1000.0, 4000.0], 150)], start=scheduled, **FIXED)
    assert "about 100 RPM" in (found.warning or "")
    assert found.verdict.grade == "poor"
    # two fixed gains as a front: its knee is what is judged
    front = pareto(drive(), [SHORT], start=replace(QUIET, gains=hot), variables=["alpha"],
                   objectives=["tracking", "chatter"], evaluations=20)  # fmt: skip
    assert front.verdict.grade == "poor"
    assert str(front.verdict) in str(front)


def test_a_model_that_most_contradict_in_the_sign_of_its_gain_forbids_no_gains() -> None:
    """No controller with an integral holds both signs."""
    settings: dict[str, Any] = {"start": QUIET, "evaluations": 60, "threads": 1}
    agreed = tune([drive(), drive(450.0)], [SHORT], **settings)
    assert agreed.verdict.grade == "good"
    found = tune([drive(), drive(450.0), drive(-30.0)], [SHORT], **settings)
    assert "1 of 3 linear loops" in (found.warning or "")
    assert not found.verdict.unfit
    # of two nobody knows which is right
    assert tune([drive(), drive(-490.0)], [SHORT], **settings).verdict.unfit


def test_a_machine_and_state_feedback_have_no_default_limit() -> None:
    found = tune(VirtualMachine(), SHORT, start=QUIET, evaluations=5, threads=1)
    assert found.constraints == Constraints()
    states = tune(drive(), SHORT, controller="state_feedback", evaluations=5, threads=1)
    assert states.constraints == Constraints()
    with pytest.raises(SettingError, match="a model, or another linear plant"):
        tune(VirtualMachine(), SHORT, start=QUIET, constraints=Constraints(Ms=1.6))


def test_a_limit_that_is_asked_for_stays_a_requirement() -> None:
    with pytest.raises(FitError, match="constraints"):
        tune(drive(), [SHORT], start=QUIET, constraints=Constraints(Ms=1.0001), **FIXED)
    # of a nonlinear model it is taken at the same levels as the default
    model = model_of("neural_oe")
    gains = Gains.standard(0.5, 0.2, u_unit="V", y_unit=model.output_unit)
    start = Controller(gains, Ts=model.Ts, u_min=-20, u_max=20)
    limits = Constraints(Ms=1.3)
    found = tune(model, [np.repeat([0.0, 1.0], 150)], start=start, constraints=limits,
                 evaluations=60, threads=2)  # fmt: skip
    assert margins(found.pid, model, speed=0.5).Ms <= 1.3 * 1.001


# --- The verdict ----------------------------------------------------------------------------------


def test_a_controller_is_no_better_than_its_model() -> None:
    assert Verdict().grade == "good"
    for model, grade in (("useless", "unfit"), ("poor", "poor"), ("fair", "fair")):
        assert Verdict((), model).grade == grade
        assert f"the model is graded {model}" in str(Verdict((), model))
    both = Verdict((Objection("fair", "a", "b"), Objection("poor", "c", "d")), "good")
    assert both.grade == "poor"
    assert both.to_json() == {"grade": "poor", "reasons": ["a; b", "c; d"]}
    both.require_fit()
    with pytest.raises(FitError, match=r"received c; d, or write it all the same with --force"):
        Verdict((Objection("unfit", "c", "d"),)).require_fit()
    weak = drive(verdict={"grade": "poor", "text": "poor"})
    assert tune(weak, [SHORT], start=QUIET, **FIXED).verdict.grade == "poor"


def test_gains_of_whose_ms_nothing_is_known_are_fair() -> None:
    model = model_of("neural_oe")
    gains = Gains.standard(1e-3, 0.2, u_unit="V", y_unit=model.output_unit)
    start = Controller(gains, Ts=model.Ts, u_min=-20, u_max=20)
    # no command holds the network there
    found = tune(model, [np.full(300, 1e4)], start=start, evaluations=5, threads=1)
    assert found.verdict.grade in ("fair", "poor", "unfit")
    (text,) = [o for o in found.verdict.objections if "Ms is not known" in o.text]
    assert text.grade == "fair"
    assert "it reaches" in text.text


def test_gains_that_destabilise_the_model_are_unfit() -> None:
    wild = replace(QUIET, gains=replace(QUIET.gains, Kp=30.0 * QUIET.gains.Kp))
    found = tune(drive(), [1.0 * SHORT], start=wild, **FIXED)
    assert found.verdict.grade == "unfit"
    assert "the linear loop is unstable" in (found.warning or "")


def test_a_loop_that_is_stuck_at_a_limit_is_unfit_only_if_its_reference_is_calm() -> None:
    model = drive()
    calm = np.interp(np.arange(2000), [0, 1000, 2000], [500.0, 1500.0, 1500.0])
    needed = command_for(model, calm, -20.0, 20.0)
    assert needed[500] == pytest.approx((calm[500] + 0.26 * 1000.0) / 490.0, rel=0.02)
    backwards = replace(QUIET, gains=replace(QUIET.gains, Kp=-QUIET.gains.Kp))
    assert _at_limit(run(backwards, model, calm), model) > 0.8
    assert _at_limit(run(QUIET, model, calm), model) == 0.0
    # beyond its reach, at 9,800 RPM, the command has to be at the limit
    far = np.full(2000, 12_000.0)
    assert np.mean(run(QUIET, model, far).u == 20.0) > 0.8
    assert _at_limit(run(QUIET, model, far), model) == 0.0


def test_gains_that_do_not_bring_the_model_to_a_held_level_are_poor() -> None:
    lazy = replace(QUIET, gains=Gains.parallel(0.002, 0.0, 0.0))
    settings: dict[str, Any] = {**FIXED, "feedforward": "none"}
    found = tune(drive(), [SHORT], start=lazy, **settings)
    assert found.verdict.grade == "poor"
    assert "RPM that the reference holds" in (found.warning or "")
    assert "holds" not in (tune(drive(), [SHORT], start=QUIET, **settings).warning or "")
    # nor is a level that ends before the drive can have moved
    short = np.concatenate([SHORT[:500], np.full(20, SHORT[499] + 1000.0)])
    assert "holds" not in (tune(drive(), [short], start=QUIET, **settings).warning or "")
    # a level that the command cannot hold is no fault of the gains
    far = np.interp(np.arange(3000), [0, 1000, 3000], [0.0, 12_000.0, 12_000.0])
    assert "holds" not in (tune(drive(), [far], start=QUIET, **settings).warning or "")


@pytest.mark.parametrize(("top", "grade"), [(1000.0, "good"), (3000.0, "unfit")])
def test_a_loop_outside_the_record_is_unfit(top: float, grade: str) -> None:
    model = drive(input_range=[[0.0, 3.0]], output_range=[0.0, 1400.0])
    r = top * np.minimum(1.0, np.arange(1500) / 500.0)
    found = tune(model, [r], start=QUIET, evaluations=40, threads=1)
    assert found.verdict.grade == grade
    assert ("outside the recorded" in (found.warning or "")) is (grade == "unfit")


@pytest.mark.parametrize(("top", "grade"), [(300.0, "good"), (900.0, "poor")])
def test_gains_are_no_better_than_their_runs_are_known(top: float, grade: str) -> None:
    """What `run` warns of, by the same words."""
    random = np.random.default_rng(0)
    u = np.repeat(random.uniform(0.0, 1.0, 30), 500)[:, None]
    y = drive().simulate(u)
    data = Dataset.from_arrays(u, y, 0.001, output_unit="RPM", input_units=["V"])
    known = {"input_range": [[-3.0, 3.0]], "output_range": [-1400.0, 1400.0]}
    model = drive(**known, region=training_region(drive(), data))
    r = top * np.minimum(1.0, np.arange(1500) / 500.0)
    task = TuningTask.of(
        [model], [r], start=QUIET, first={}, cost=None,
        aggregate="mean", constraints=None, variations=None,
    )  # fmt: skip
    found = verdict_of(task.with_loops(Budget(None)), QUIET, Budget(None))
    warned = judge(run(QUIET, model, r), model).warnings
    assert found.grade == grade
    assert ("where the model was not trained" in (found.warning or "")) is (grade == "poor")
    assert any("where the model was not trained" in line.meaning for line in warned) is (
        grade == "poor"
    )


def test_a_step_that_gains_from_ramps_overshoot_is_said() -> None:
    pole = math.exp(-10.0 / 400.0)
    b = [0.0, 0.0, 0.0, 0.6 * (1.0 - pole)]
    known = {"input_range": [[0.0, 100.0]], "output_range": [0.0, 60.0]}
    oven = replace(LinearOE.from_tf(b, [1.0, -pole], 10.0), training=known)
    calm = Controller(Gains.standard(2.0, 400.0), Ts=10.0, u_min=0.0, u_max=100.0)
    assert verdict_on(calm, oven).grade == "good"
    eager = replace(calm, gains=Gains.standard(1.0, 100.0))
    (said,) = [o for o in verdict_on(eager, oven).objections if "a step of" in o.text]
    assert said.grade == "fair"
    assert "/s, as r_rate" in said.remedy
    # the ramp that it names is one without
    rate = float(said.remedy.split("at most ")[1].split()[0])
    step = drive_references(oven, 0.0, 100.0)["step"]
    assert run(eager, oven, step).y.max() > 1.05 * step[-1]
    assert run(replace(eager, r_rate=rate), oven, step).y.max() < 1.05 * step[-1]
    # who gives a reference knows what will be played
    ramp = drive_references(oven, 0.0, 100.0)["trapezoid"]
    found = tune(oven, [ramp], start=eager, **FIXED)
    assert "a step of" not in (found.warning or "")


def test_the_command_refuses_unfit_gains_unless_it_is_forced(tmp_path: Path) -> None:
    drive().save(tmp_path / "drive.json")
    wild = replace(QUIET, gains=replace(QUIET.gains, Kp=30.0 * QUIET.gains.Kp))
    wild.save(tmp_path / "wild.json")
    asked = ("tune", "drive.json", "--start", "wild.json", "--variables", "alpha",
             "--reference", "trapezoid", "--evaluations", "20", "-o", "c.json")  # fmt: skip
    for more in ((), ("--pareto", "tracking,chatter", "--front", "front.csv")):
        said = refused(tmp_path, *asked, *more)
        assert "controller: expected one that the drive can be run with" in said
        assert "the linear loop is unstable" in said
        assert "--force" in said
        assert not (tmp_path / "c.json").exists()
        assert not (tmp_path / "front.csv").exists()
    told = json.loads(sewfast(tmp_path, *asked, "--force", "--json").out)
    assert (tmp_path / "c.json").exists()
    assert told["verdict"]["grade"] == GRADES[0]
    assert told["verdict"]["reasons"][0] in told["warning"]
    usual = ("tune", "drive.json", "--reference", "trapezoid", "--evaluations", "20")
    free = sewfast(tmp_path, *usual, "--constraint", "Ms=inf", "-o", "free.json").out
    assert "Ms not limited" in free
    assert "within    Ms <= 1.8" in sewfast(tmp_path, *usual, "-o", "usual.json").out


@pytest.mark.parametrize("level", [30.0, 80.0, 90.0])
def test_full_power_on_the_way_to_a_step_is_no_limit_without_need(level: float) -> None:
    pole = math.exp(-10.0 / 1000.0)
    heater = LinearOE.from_tf([0.0, 100.0 * (1.0 - pole)], [1.0, -pole], 10.0)
    pid = Controller(Gains.standard(0.2, 400.0), Ts=10.0, u_min=0.0, u_max=1.0)
    found = run(pid, heater, np.full(600, level))
    assert abs(found.y[-1] - level) < 0.1
    assert _at_limit(found, heater) < 0.1


def test_the_runs_for_a_verdict_end_with_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between any two models, as one run of a slow plant can take seconds."""
    ran = []
    monkeypatch.setattr(verdicts, "run", lambda *given: ran.append(given) or run(*given))
    task = TuningTask.of(
        [drive()] * 4, [SHORT, 0.5 * SHORT], start=QUIET, first={}, cost=None,
        aggregate="mean", constraints=None, variations=None,
    )  # fmt: skip
    time = Budget(1.0)
    monkeypatch.setattr(Budget, "spent", property(lambda _: float(len(ran))))
    found = verdict_of(task, QUIET, time)
    assert len(ran) == 2
    assert found.grade == "fair"
    assert "left no time" in (found.warning or "")
    assert time.lost == ["the runs for the verdict"]
    # nor is it found out then what a loop at a limit needs, which takes longer than its runs
    ran.clear()
    monkeypatch.setattr(verdicts, "_railed", lambda found: np.ones(len(found.r), dtype=bool))
    monkeypatch.setattr(verdicts, "_at_limit", lambda *given: ran.append(given) or 0.0)
    assert "left no time" in (verdict_of(task, QUIET, Budget(5.0)).warning or "")
    assert len(ran) == 6


def test_what_takes_long_is_asked_only_of_a_loop_that_shows_a_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("command_for", "_settling"):
        monkeypatch.setattr(verdicts, name, lambda *_: pytest.fail("it takes long"))
    task = TuningTask.of(
        [drive()], [SHORT], start=QUIET, first={}, cost=None,
        aggregate="mean", constraints=None, variations=None,
    )  # fmt: skip
    task = task.with_loops(Budget(None))
    assert verdict_of(task, QUIET, Budget(None)).grade == "good"


def test_gains_are_no_better_than_an_ensemble() -> None:
    members = [LinearOE.from_tf([0.0, 0.5], [1.0, pole], 0.01) for pole in (-0.95, -0.94)]
    known = {"input_range": [[-3.0, 3.0]], "output_range": [-20.0, 20.0]}
    poor = Ensemble.of(members, training={**known, "verdict": {"grade": "poor"}})
    assert tune(poor, evaluations=30, threads=1).verdict.grade == "poor"


def test_levels_of_both_directions_leave_out_the_standstill() -> None:
    task = TuningTask.of(
        drive(), [np.array([-1000.0, 1500.0])], start=QUIET, first={}, cost=None,
        aggregate="mean", constraints=None, variations=None,
    )  # fmt: skip
    assert _levels(task) == [-500.0, 750.0, 1350.0]
    assert _levels(replace(task, references=[np.array([400.0, 1000.0])])) == [460.0, 700.0, 940.0]
