"""A second opinion on tuned gains, and the linear model that gives it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import call_refused as refused
from cli import called as sewfast
from sewfast import _core, load_controller, signals
from sewfast.commissioning.demands import demands
from sewfast.commissioning.gains import SENSITIVE, sensible
from sewfast.commissioning.small_signal import SmallSignal
from sewfast.commissioning.training import linear_rival
from sewfast.control import Fopdt
from sewfast.control.benches import MachineBench
from sewfast.control.margins import margins
from sewfast.errors import Interrupted, SettingError
from sewfast.machine import VirtualMachine
from sewfast.models import Ensemble, LinearOE
from sewfast.tuning.objective import Constraints
from sewfast.tuning.opinion import MUCH, SecondOpinion
from sewfast.tuning.search import TuningResult, tune

SHORT = signals.reference("trapezoid")[:900]


def drive(gain: float = 490.0, Ts: float = 1e-3) -> LinearOE:
    """A second-order drive [RPM/V]."""
    p, q = math.exp(-Ts / 0.252), math.exp(-Ts / 0.0074)
    b = gain * (1 - p) * (1 - q) / 2
    core = _core.LinearModel(np.array([-p - q, p * q]), np.array([[b, b]]), 1, 0.0)
    record = {"input_range": [[-20.0, 20.0]]}
    return LinearOE(core, Ts, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), record)


def tuned(**changes: Any) -> TuningResult:
    return tune(drive(), [SHORT], **{"evaluations": 200, "threads": 1, **changes})


def test_a_rival_that_agrees_changes_nothing() -> None:
    alone, asked = tuned(), tuned(rival=drive(gain=470.0))
    assert asked.controller == alone.controller
    assert asked.cost == alone.cost
    assert (alone.opinion, alone.warning, asked.warning) == (None, None, None)
    assert asked.opinion is not None
    assert asked.opinion.relative.max() < MUCH


def test_models_that_contradict_each_other_are_named_and_the_least_wrong_gains_taken() -> None:
    # a model whose gain is five times the drive's: its gains are a fifth of what the drive needs
    wrong, right = drive(gain=2450.0), drive()
    found = tune(wrong, [SHORT], rival=right, evaluations=600, threads=1)
    opinion = found.opinion
    assert opinion is not None
    assert found.warning is not None
    assert "wrong in closed loop" in found.warning
    assert found.warning in str(found)
    assert opinion.costs.shape == (2, 3)
    worst = opinion.relative.max(axis=0)
    assert worst[opinion.pick] == worst.min()
    assert found.controller == opinion.candidates[opinion.pick]
    assert found.cost == pytest.approx(opinion.costs[0, opinion.pick])
    assert {v.name: v.value for v in found.variables}["Kp"] == found.controller.gains.Kp
    # on the drive itself they cost less than what the wrong model asks for
    assert opinion.costs[1, opinion.pick] < opinion.costs[1, 0]


def test_gains_beyond_the_constraints_are_not_taken() -> None:
    c = tuned().controller
    costs = np.array([[1.0, 4.0], [9.0, 1.0]])
    free = SecondOpinion((c, c), costs, np.array([True, True]))
    bound = SecondOpinion((c, c), costs, np.array([True, False]))
    assert (free.pick, bound.pick) == (1, 0)
    assert free.is_contradiction
    assert bound.warning is not None
    assert "those tuned on the models" in bound.warning


def test_loops_that_run_away_contradict() -> None:
    c = tuned().controller
    costs = np.array([[1.0, np.inf], [2.0, 1.9]])
    found = SecondOpinion((c, c), costs, np.array([True, True]))
    assert found.pick == 0
    assert found.relative[0, 1] == np.inf


def test_a_rival_without_gains_within_the_constraints_has_no_opinion() -> None:
    # its loop with a dead time of 80 samples can have no such Ms
    core = _core.LinearModel(np.array([-1.05]), np.array([[30.0]]), 80, 0.0)
    base = drive()
    late = LinearOE(core, base.Ts, ("u",), "y", ("V",), "RPM", ("counts", 1572.0))
    found = tuned(rival=late, constraints=Constraints(Ms=1.5), evaluations=60)
    assert found.opinion is None


def test_ctrl_c_within_the_second_opinion_keeps_the_gains() -> None:
    from sewfast.tuning import search

    found: list[Any] = []

    def stopped(*args: Any) -> Any:
        found.append(args[0])
        raise Interrupted(None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search._Search, "brief", lambda self: type("S", (), {"within": stopped})())
        with pytest.raises(Interrupted) as caught:
            tuned(rival=drive(gain=470.0))
    assert found
    assert caught.value.best == tuned(feedforward="none").controller


@pytest.mark.parametrize(
    ("rival", "match"),
    [([], "got none"), (drive(Ts=2e-3), "sample time|0.002"), ("linear.json", "expected models")],
)
def test_a_rival_that_cannot_be_run_is_refused(rival: Any, match: str) -> None:
    with pytest.raises(SettingError, match=match):
        tuned(rival=rival)


@pytest.mark.budget
@pytest.mark.nightly("the same without a rival runs by day")
def test_a_time_budget_is_kept_with_a_rival() -> None:
    found = tuned(rival=drive(gain=470.0), evaluations=10**6, time_budget=2.0)
    assert found.termination == "time"
    assert (found.opinion is None) == ("the second opinion of the rival" in found.lost)


def test_the_command_asks_a_rival(tmp_path: Path) -> None:
    drive(gain=2450.0).save(tmp_path / "wrong.json")
    drive().save(tmp_path / "right.json")
    told = sewfast(
        tmp_path, "tune", "wrong.json", "--rival", "right.json", "--reference", "trapezoid",
        "--evaluations", "300", "-o", "c.json",
    )  # fmt: skip
    assert "verdict   poor: the gains tuned on the models" in told.out
    assert load_controller(tmp_path / "c.json").gains.Kp > 0.0
    said = refused(
        tmp_path, "tune", "wrong.json", "--rival", "right.json", "--pareto", "tracking,chatter",
        "-o", "c.json",
    )  # fmt: skip
    assert "--rival" in said


def test_a_member_that_is_far_more_sensitive_than_the_small_signals_has_no_say() -> None:
    asked = demands(
        MachineBench(VirtualMachine()), u_max=None, speed=None, references=None, members=4,
        evaluations=1, seed=0, threads=1,
    )  # fmt: skip
    rule = tuned().controller
    small = SmallSignal(drive(), None, None)
    sound, wrong = [drive(), drive(gain=470.0), drive(gain=520.0)], drive(gain=4900.0)
    assert margins(rule, wrong).Ms > SENSITIVE * margins(rule, small.model).Ms
    found = sensible(rule, Ensemble.of([*sound, wrong]), small, asked)
    assert [m.core for m in found.members] == [m.core for m in sound]
    whole = Ensemble.of(sound)
    assert sensible(rule, whole, small, asked) is whole
    # where most of them are, or nothing is known of small signals, all stay
    most = Ensemble.of([sound[0], wrong, drive(gain=5000.0)])
    assert sensible(rule, most, small, asked) is most
    other = Ensemble.of([*sound, wrong])
    assert sensible(rule, other, None, asked) is other


# --- the linear model of a commissioning ----------------------------------------------------------


def test_the_rival_learns_where_the_drive_is_linear() -> None:
    bench = MachineBench(VirtualMachine())
    asked = demands(
        bench, u_max=None, speed=None, references=None, members=1, evaluations=1, seed=0, threads=1
    )
    rng = np.random.default_rng(0)
    gentle = 2.0 + np.repeat(rng.uniform(-0.5, 0.5, 40), 100)
    hard = np.repeat(np.tile([18.0, -16.0], 10), 60)
    judge = bench.excite(np.repeat([1.5, 2.5, 3.0, 2.0], 600), "levels")
    fopdt = Fopdt(K=490.0, T=0.25, L=0.008)
    alone = linear_rival([bench.excite(gentle, "gentle")], judge, fopdt, asked)
    # what is beyond the linear stretches does not matter, and makes no rival by itself
    both = [bench.excite(u, name) for u, name in ((gentle, "gentle"), (hard, "hard"))]
    beside = linear_rival(both, judge, fopdt, asked)
    assert alone is not None
    assert beside is not None
    assert alone.is_fit
    assert beside.rmse == pytest.approx(alone.rmse, rel=0.05)
    assert linear_rival([both[1]], judge, fopdt, asked) is None
    stood_in = alone.alone(judge)
    assert stood_in.ensemble.members == (alone.model,)
    assert stood_in.rmse == (alone.rmse,)


def test_what_a_frozen_sensor_said_is_not_learned() -> None:
    bench = MachineBench(VirtualMachine())
    asked = demands(
        bench, u_max=None, speed=None, references=None, members=1, evaluations=1, seed=0, threads=1
    )
    rng = np.random.default_rng(0)
    gentle = 2.0 + np.repeat(rng.uniform(-0.5, 0.5, 40), 100)
    record = bench.excite(gentle, "gentle")
    judge = bench.excite(np.repeat([1.5, 2.5, 3.0, 2.0], 600), "levels")
    fopdt = Fopdt(K=490.0, T=0.25, L=0.008)

    y = record.y.copy()
    y[1000:2200] = y[1000]
    sound, beside = (linear_rival([r], judge, fopdt, asked) for r in (record, replace(record, y=y)))
    assert sound is not None
    assert beside is not None
    assert beside.rmse < 2.0 * sound.rmse  # 15 times without the mask
