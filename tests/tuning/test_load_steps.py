"""Load steps in tuning: what they are, that they bind, what is refused."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import called as sewfast
from loops import QUIET, drive
from sewfast import (
    Constraints,
    Cost,
    FitError,
    LoadStep,
    SettingError,
    _core,
    load_controller,
    pareto,
    signals,
    tune,
)
from sewfast.control.loop import run
from sewfast.models import LinearOE
from sewfast.progress import TimeUp
from sewfast.tuning import costs, recoveries
from sewfast.tuning.task import Budget, Deadline

STEP = LoadStep(1500.0, -2.0)
SHORT = signals.reference("trapezoid")[:900]
AS_IT_IS = ((1.0, 0),)


def test_a_load_step_is_a_ramp_a_hold_and_a_command_behind_the_limits() -> None:
    r, d, band, mean = LoadStep(1500.0, -2.0, ramp=0.1, settle=0.2, look=0.3, mean=0.04).samples(
        0.001
    )
    assert (len(r), len(d), band, mean) == (600, 600, 15.0, 40)
    assert (r[0], r[50], r[100], r[-1]) == (0.0, 750.0, 1500.0, 1500.0)
    assert np.all(d[:300] == 0.0)
    assert np.all(d[300:] == -2.0)
    assert LoadStep(-800.0, 1.0).band == 8.0
    assert LoadStep(800.0, 1.0, ramp=0.0).samples(0.001)[0][0] == 800.0


@pytest.mark.parametrize("name", ["ramp", "settle", "look", "mean"])
def test_a_load_step_that_no_memory_holds_is_refused(name: str) -> None:
    long: dict[str, Any] = {name: 1e300}
    with pytest.raises(SettingError) as caught:
        LoadStep(1500.0, -2.0, **long).samples(0.001)
    assert caught.value.expected == "up to 10000 s with its mean"


def test_recoveries_are_those_of_the_run() -> None:
    r, d, band, _ = STEP.samples(QUIET.Ts)
    off = run(QUIET, drive(), r, disturbance=d).y[800:] - 1500.0
    (row,) = recoveries(QUIET, drive(), [STEP], variations=AS_IT_IS)
    outside = np.flatnonzero(np.abs(off) > band)
    assert row[0] == pytest.approx(outside[-1] + 1.0)
    assert row[1] == pytest.approx(np.sqrt(np.mean(off**2)))
    assert recoveries(QUIET, [drive(), drive()], [STEP]).shape == (6, 2)


def test_without_weight_or_limit_a_load_step_changes_nothing() -> None:
    plain = tune(drive(), [SHORT], start=QUIET, evaluations=60, threads=2)
    told = tune(drive(), [SHORT], start=QUIET, loads=[STEP], evaluations=60, threads=2)
    assert plain.controller == told.controller
    assert plain.cost == told.cost


def test_a_weight_on_the_load_is_paid_for_in_tracking() -> None:
    settings: dict[str, Any] = {"start": QUIET, "loads": [STEP], "evaluations": 250, "threads": 2}
    settings["feedforward"] = "none"
    free = tune(drive(), [SHORT], **settings)
    stiff = tune(drive(), [SHORT], cost=Cost(load=50.0), **settings)
    of = [recoveries(found.controller, drive(), [STEP])[:, 1].max() for found in (free, stiff)]
    assert of[1] < of[0]
    (expected,) = costs(stiff.controller, drive(), [SHORT])
    mean = recoveries(stiff.controller, drive(), [STEP])[:, 1].mean()
    assert stiff.cost == pytest.approx(expected + 50.0 * mean)


def test_no_plant_recovers_later_than_under_the_rival() -> None:
    quick = tune(
        drive(), [SHORT], start=QUIET, loads=[STEP], cost=Cost(recovery=10.0), evaluations=250,
        threads=2,
    ).controller  # fmt: skip
    allowed = recoveries(quick, drive(), [STEP], variations=AS_IT_IS)[:, 0]
    plain = tune(drive(), [SHORT], start=QUIET, evaluations=300, threads=2).controller
    assert recoveries(plain, drive(), [STEP], variations=AS_IT_IS)[0, 0] > allowed[0]
    found = tune(
        drive(), [SHORT], start=quick, loads=[STEP], constraints=Constraints(recovery=quick),
        evaluations=300, threads=2,
    )  # fmt: skip
    assert recoveries(found.controller, drive(), [STEP], variations=AS_IT_IS)[0, 0] <= allowed[0]
    assert "recovery no larger" in str(found)
    limit = float(recoveries(quick, drive(), [STEP])[:, 0].max())
    found = tune(
        drive(), [SHORT], start=quick, loads=[STEP], constraints=Constraints(recovery=limit),
        evaluations=100, threads=2,
    )  # fmt: skip
    assert recoveries(found.controller, drive(), [STEP])[:, 0].max() <= limit
    assert f"recovery <= {limit:g} ms" in str(found)


def test_recovery_may_be_an_objective() -> None:
    front = pareto(
        drive(), [SHORT], objectives=["tracking", "recovery"], start=QUIET, loads=[STEP],
        evaluations=240, size=16, threads=2,
    )  # fmt: skip
    assert front.units == {"tracking": "RPM", "recovery": "ms"}
    best = front.best("recovery")
    of = [recoveries(c, drive(), [STEP])[:, 0].mean() for c in (best, front.best("tracking"))]
    assert of[0] <= of[1]


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"disturbance": 0.0}, "disturbance of a load step other than 0"),
        ({"band": 0.0}, "band of a load step other than 0"),
        ({"look": 0.0}, "look of a load step other than 0"),
        ({"level": float("nan")}, "level: expected a number"),
        ({"settle": -1.0}, "settle of a load step of 0 or more"),
        ({"band": "wide"}, "band"),
    ],
)
def test_load_steps_that_make_no_sense_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(SettingError, match=says):
        replace(STEP, **settings)


def test_what_needs_a_load_step_says_so() -> None:
    for settings in ({"cost": Cost(load=1.0)}, {"constraints": Constraints(recovery=50.0)}):
        with pytest.raises(SettingError, match="load step"):
            tune(drive(), [SHORT], start=QUIET, evaluations=5, **settings)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="load step"):
        pareto(drive(), [SHORT], objectives=["tracking", "load"], start=QUIET, evaluations=50)
    with pytest.raises(SettingError, match="LoadStep"):
        tune(drive(), [SHORT], start=QUIET, loads=[1500.0], evaluations=5)  # type: ignore[list-item]
    with pytest.raises(SettingError, match="recovery"):
        Constraints(recovery=-1.0)


def test_bounds_the_wrong_way_round_are_refused() -> None:
    with pytest.raises(SettingError, match="lower one first"):
        tune(drive(), [SHORT], start=QUIET, variables=[("Ti", 0.5, 0.02)], evaluations=5)


@pytest.mark.budget
def test_a_search_ends_in_time_with_its_best() -> None:
    found = tune(
        drive(), [SHORT], start=QUIET, evaluations=10**7, time_budget=0.5, threads=2
    )  # fmt: skip
    assert found.termination == "time"
    assert 1 <= found.evaluations < 10**7
    assert found.cost <= found.start_cost
    assert f"{10**7 - found.evaluations} of {10**7} controllers" in found.lost
    assert found.cut is not None
    assert found.cut in str(found)
    whole = tune(drive(), [SHORT], start=QUIET, evaluations=5, time_budget=1e6, threads=2)
    assert whole.termination == "evaluations"
    assert (whole.lost, whole.cut) == ((), None)


@pytest.mark.budget
def test_a_search_ends_in_time_where_every_loop_diverges() -> None:
    a = np.poly([1.2, 0.976 + 0.173j, 0.976 - 0.173j, 0.79]).real
    core = _core.LinearModel(a[1:].copy(), np.array([[1e-3, 0.0]]), 1, 0.0)
    unstable = LinearOE(core, 1e-3, ("u",), "y", ("V",), "rpm", None)
    start = replace(QUIET, u_min=-1e9, u_max=1e9, counts_per_rev=None)
    with pytest.raises(FitError) as caught:
        tune(unstable, [np.ones(5000)], start=start, evaluations=10**9, time_budget=0.5, threads=2)
    assert caught.value.name == "time_budget"
    assert "more time" in caught.value.remedy


def test_a_deadline_asks_for_no_cost_but_for_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("sewfast.tuning.task.time.monotonic", lambda: now)
    time = Budget(10.0)
    deadline = Deadline(time, time.share(0.5), None)
    now = 4.9
    deadline(1, 9, np.inf)
    now = 5.1
    deadline(0, 9, np.inf)  # the start
    with pytest.raises(TimeUp):
        deadline(1, 9, np.inf)
    now = 11.6
    with pytest.raises(TimeUp):
        deadline(0, 9, np.inf)
    assert time.over("looks")
    assert time.lost == ["looks"]


@pytest.mark.budget
def test_what_was_lost_is_said_with_the_worst_grade_of_the_models() -> None:
    fair, good = (
        replace(drive(), training={"verdict": {"grade": grade}}) for grade in ("fair", "good")
    )
    found = tune(
        [good, fair], [SHORT], start=QUIET, evaluations=10**7, time_budget=0.5, threads=2
    )  # fmt: skip
    assert found.grade == "fair"
    assert found.cut is not None
    assert found.cut.endswith("the model is graded fair")


@pytest.mark.budget
def test_a_front_ends_in_time() -> None:
    given: dict[str, Any] = {"start": QUIET, "threads": 2, "size": 4}
    front = pareto(drive(), [SHORT], evaluations=10**7, time_budget=1.0, **given)
    assert 1 <= front.evaluations < 10**7
    assert f"{10**7 - front.evaluations} of {10**7} controllers" in front.lost
    assert front.cut is not None
    assert front.cut in str(front)
    with pytest.raises(SettingError, match="time_budget"):
        pareto(drive(), [SHORT], time_budget=0.0, **given)


@pytest.mark.parametrize("budget", [0.0, -1.0, float("nan"), float("inf"), "long"])
def test_a_time_budget_that_makes_no_sense_is_refused(budget: Any) -> None:
    with pytest.raises(SettingError, match="time_budget"):
        tune(drive(), [SHORT], start=QUIET, evaluations=5, time_budget=budget)


@pytest.mark.budget
def test_constraints_that_are_not_met_in_time_are_said() -> None:
    with pytest.raises(FitError, match="constraints"):
        tune(
            drive(), [SHORT], start=QUIET, loads=[STEP], constraints=Constraints(recovery=1.0),
            evaluations=10**7, time_budget=0.5, threads=2,
        )  # fmt: skip


def test_the_command_takes_a_load(tmp_path: Path) -> None:
    drive().save(tmp_path / "drive.json")
    sewfast(
        tmp_path, "tune", "drive.json", "--reference", "trapezoid", "--load=1500:-2",
        "--constraint", "recovery=90", "--evaluations", "150", "-o", "firm.json",
    )  # fmt: skip
    found = load_controller(tmp_path / "firm.json")
    assert recoveries(found, drive(), [STEP])[:, 0].max() <= 90.0
    for bad in ("--load=1500", "--load=a:b"):
        told = sewfast(tmp_path, "tune", "drive.json", bad, "-o", "firm.json", done=2)
        assert "LEVEL:COMMAND" in told.err


@pytest.mark.budget
def test_the_command_says_what_a_time_budget_cut_short(tmp_path: Path) -> None:
    drive().save(tmp_path / "drive.json")
    given = ("tune", "drive.json", "--evaluations", 10**7, "--time-budget", 1, "-o", "c.json")
    given += ("--reference", "trapezoid")
    for more in ((), ("--pareto", "tracking,chatter")):
        told = sewfast(tmp_path, *given, *more)
        assert "the time budget left no time for" in told.out
        lost = json.loads(sewfast(tmp_path, *given, *more, "--json").out)["lost"]
        assert any("controllers" in what for what in lost)
