"""Tuning by simulation: what it finds, that it repeats, what it refuses."""

import math
import re
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loops import QUIET
from sewfast import _core, pareto, signals
from sewfast.control import Controller, Gains
from sewfast.control.loop import run
from sewfast.control.margins import margins
from sewfast.dataset import Dataset
from sewfast.errors import DataError, FitError, Interrupted, SettingError
from sewfast.identification import identify
from sewfast.machine import VirtualMachine
from sewfast.models import LinearOE
from sewfast.tuning import costs, default_variations, first_controller, tune
from sewfast.tuning.objective import Constraints, Cost, terms


def linear(a: list[float], b: list[float]) -> LinearOE:
    core = _core.LinearModel(np.array(a), np.array([b]), 1, 0.0)
    record = {"input_range": [[-20.0, 20.0]]}
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), record)


def drive(T1: float = 0.252, T2: float = 0.0074, gain: float = 490.0) -> LinearOE:
    p, q = math.exp(-0.001 / T1), math.exp(-0.001 / T2)
    b = gain * (1 - p) * (1 - q) / 2
    return linear([-p - q, p * q], [b, b])


SHORT = signals.reference("trapezoid")[:900]


def test_a_model_with_two_inputs_is_refused_by_name() -> None:
    core = _core.LinearModel(np.array([-0.9]), np.array([[0.1], [0.2]]), 1, 0.0)
    two = LinearOE(core, 0.001, ("u", "load"), "y", ("V", "N m"), "RPM")
    with pytest.raises(SettingError, match=r"one input.*received 2"):
        tune(two, [SHORT])


def test_starts_from_the_models_own_step_response() -> None:
    first = first_controller(drive())
    assert first.gains.Kp == pytest.approx(12.5 / 490, rel=0.05)
    assert first.gains.Ti == pytest.approx(0.22 * 0.252, rel=0.1)
    assert (first.filter_samples, first.counts_per_rev, first.u_max) == (8, 1572.0, 20.0)
    assert run(first, drive(), "trapezoid").metrics()["overshoot_percent"] < 10
    reverse = first_controller(drive(gain=-490.0))
    assert reverse.gains.Kp == pytest.approx(-first.gains.Kp, rel=0.05)


def test_tuned_gains_track_on_the_model_and_on_the_machine() -> None:
    result = tune(drive(), "trapezoid", evaluations=500, threads=2)
    assert result.cost < 0.3 * result.start_cost
    assert np.all(np.diff(result.trace) <= 0)
    assert result.trace[-1] == result.cost
    model = run(result.controller, drive(), "trapezoid").metrics()
    machine = run(result.controller, VirtualMachine(), "trapezoid").metrics()
    for told in (model, machine):
        assert told["rise_time_ms"] == pytest.approx(120, abs=15)
        assert told["overshoot_percent"] < 3
    assert machine["rmse"] < 80


def test_a_seed_gives_the_same_bits_at_any_number_of_threads() -> None:
    first, second = (
        tune(drive(), SHORT, evaluations=120, seed=3, threads=threads) for threads in (1, 3)
    )
    assert first.controller == second.controller
    assert np.array_equal(first.trace, second.trace)
    other = tune(drive(), SHORT, evaluations=120, seed=4, threads=2)
    assert other.controller != first.controller


def test_one_controller_serves_several_plants_and_a_machine() -> None:
    start = first_controller(drive())
    plants = [drive(), drive(T2=0.012), VirtualMachine(1)]
    result = tune(plants, [SHORT], start=start, variations=[(1.0, 0)], evaluations=150, threads=2)
    assert result.cost < 0.5 * result.start_cost
    for plant in plants:
        assert run(result.controller, plant, SHORT).metrics()["rmse"] < 150


def test_cma_es_is_the_other_method() -> None:
    found = {
        method: tune(drive(), SHORT, method=method, evaluations=500, threads=2)
        for method in ("genetic", "cma-es")
    }
    assert found["cma-es"].cost == pytest.approx(found["genetic"].cost, rel=0.1)
    assert found["cma-es"].controller != found["genetic"].controller


def test_only_what_is_named_is_searched_within_its_bounds() -> None:
    start = first_controller(drive())
    wanted = ["alpha", ("Kp", 0.01, 0.02), ("filter_samples", 2, 5)]
    found = tune(drive(), SHORT, start=start, variables=wanted, evaluations=80, threads=2)
    assert [v.name for v in found.variables] == ["alpha", "Kp", "filter_samples"]
    tuned, kept = found.controller, start.gains.to("standard")
    assert 0.01 <= tuned.gains.Kp <= 0.02
    assert tuned.filter_samples in (2, 3, 4, 5)
    assert (tuned.gains.Ti, tuned.gains.Td) == (kept.Ti, kept.Td)
    assert (tuned.beta, tuned.N) == (start.beta, start.N)
    assert found.variables[1].value == tuned.gains.Kp
    assert "searched  alpha" in str(found)


def test_a_bound_that_is_reached_is_told() -> None:
    start = first_controller(drive())
    wanted = [("Kp", 1e-4, 2e-4)]
    found = tune(drive(), SHORT, start=start, variables=wanted, evaluations=60, threads=2)
    assert found.variables[0].at_bound
    assert "at a bound" in str(found)


def test_constraints_come_before_the_cost() -> None:
    settings: dict[str, Any] = {"evaluations": 300, "threads": 2, "variations": [(1.0, 0)]}
    free = tune(drive(), SHORT, **settings)
    limit = 0.8 * float(np.max(np.abs(run(free.controller, drive(), SHORT).u)))
    bound = tune(drive(), SHORT, constraints=Constraints(u=limit), **settings)
    assert np.max(np.abs(run(bound.controller, drive(), SHORT).u)) <= limit
    assert bound.cost > free.cost
    assert "u <= " in str(bound)
    with pytest.raises(FitError, match="constraints"):
        tune(drive(), SHORT, constraints=Constraints(u=1e-6), evaluations=30, threads=1)


def test_the_largest_sensitivity_is_that_of_the_margins() -> None:
    settings: dict[str, Any] = {"evaluations": 300, "threads": 2, "variations": [(1.0, 0)]}
    unlimited = Constraints(Ms=math.inf)
    free = margins(tune(drive(), SHORT, constraints=unlimited, **settings).controller, drive()).Ms
    limit = 1.0 + 0.7 * (free - 1.0)
    bound = tune(drive(), SHORT, constraints=Constraints(Ms=limit), **settings)
    assert margins(bound.controller, drive()).Ms <= limit * (1.0 + 1e-9)
    start = first_controller(drive())
    plants = {"models": VirtualMachine(), "start": start}
    with pytest.raises(SettingError, match=r"plant=\.\.\."):
        tune(references=SHORT, constraints=Constraints(Ms=limit), **plants, **settings)
    given = Constraints(Ms=limit, plant=drive())
    found = tune(references=SHORT, constraints=given, **plants, **{**settings, "evaluations": 60})
    assert margins(found.controller, drive()).Ms <= limit * (1.0 + 1e-9)


def test_costs_compare_controllers_as_the_search_does() -> None:
    found = tune(drive(), SHORT, feedforward="none", evaluations=60, threads=2)
    both = costs([found.start, found.controller], drive(), SHORT, threads=1)
    assert list(both) == [found.start_cost, found.cost]
    assert costs(found.start, drive(), SHORT) == found.start_cost
    with pytest.raises(SettingError, match="controllers"):
        costs([], drive(), SHORT)


def test_a_front_trades_one_for_the_other(tmp_path: Path) -> None:
    front = pareto(drive(), SHORT, evaluations=600, size=20, threads=2)
    tracking, chatter = front.values.T
    assert len(front) >= 5
    assert np.all(np.diff(tracking) >= 0)
    assert np.all(np.diff(chatter) <= 0)
    assert front.units == {"tracking": "RPM", "chatter": "V"}
    assert front.picked is front.controllers[front.pick]
    assert 0 < front.pick < len(front) - 1
    first, last = (terms(run(front.best(o), drive(), SHORT)) for o in front.objectives)
    assert first["tracking"] < last["tracking"]
    assert first["chatter"] > last["chatter"]
    assert "* the knee" in str(front)
    front.save(tmp_path / "front.csv")
    table = np.genfromtxt(tmp_path / "front.csv", delimiter=",", names=True)
    assert len(table) == len(front)
    for name in ("front.png", "front.svg"):
        front.plot(file=tmp_path / name)
        assert (tmp_path / name).stat().st_size > 1000
    with pytest.raises(SettingError, match=r"\.png"):
        front.plot(file=tmp_path / "front.txt")
    with pytest.raises(SettingError, match="tracking, chatter"):
        front.best("lag")


@pytest.mark.parametrize("objectives", ["tracking", ["tracking"], ["tracking", "speed"], [1, 2]])
def test_objectives_that_make_no_sense_are_refused(objectives: Any) -> None:
    with pytest.raises(SettingError, match="objectives"):
        pareto(drive(), SHORT, objectives=objectives, evaluations=40, threads=1)


def test_weights_buy_what_they_say() -> None:
    calm, wild = (
        tune(drive(), SHORT, cost=Cost(chatter=weight), evaluations=400, threads=2)
        for weight in (1500.0, 0.0)
    )
    effort = [run(r.controller, drive(), SHORT).metrics()["du_rms"] for r in (calm, wild)]
    assert effort[0] < effort[1]
    assert calm.weights == Cost(chatter=1500.0, overshoot=30.0, saturation=60.0)


def test_the_cost_of_runs_is_that_of_the_search() -> None:
    cost = Cost(chatter=5.0, effort=2.0, rise=1.0, lag=3.0)
    references = ["trapezoid", SHORT, "random"]
    settings: dict[str, Any] = {"variations": [(1.0, 0)], "evaluations": 1, "threads": 1}
    found = tune(drive(), references, cost=cost, **settings)
    runs = [run(found.start, drive(), r) for r in references]
    assert cost.of(runs) == pytest.approx(found.start_cost, rel=1e-9)
    told = terms(runs[0])
    metrics = runs[0].metrics()
    assert told["tracking"] == pytest.approx(metrics["rmse"], rel=1e-12)
    assert told["overshoot"] == metrics["overshoot_percent"]
    assert told["u_max"] == np.max(np.abs(runs[0].u))
    assert 0 < told["lag"] < 100


def test_the_penalty_of_overshoot_begins_gradually_in_a_search_and_of_a_run() -> None:
    start = first_controller(drive())
    made = run(start, drive(), SHORT)
    overshoot = terms(made)["overshoot"]
    assert overshoot > 0.5
    # at the limit a tenth of it is rounded: a fortieth costs
    for limit, beyond in ((overshoot, overshoot / 40), (2 * overshoot, 0.0), (0.0, overshoot)):
        cost = Cost(overshoot=300.0, overshoot_limit=limit)
        free = replace(cost, overshoot=0.0).of(made)
        assert cost.of(made) - free == pytest.approx(300.0 * beyond, abs=1e-9)
        (same,) = costs(start, drive(), SHORT, cost=cost, variations=[(1.0, 0)])
        assert same == pytest.approx(cost.of(made), rel=1e-12)


def test_gains_do_not_depend_on_the_levels_of_a_record() -> None:
    """Bit for bit: a search amplifies any difference, and may end in another minimum."""
    rng = np.random.default_rng(3)
    u, y = np.repeat(rng.uniform(-3.0, 3.0, 40), 50), np.zeros(2000)
    u[:50] = 0.0
    for k in range(1, len(u)):
        y[k] = y[k - 1] + 0.1 * (60.0 * u[k - 1] - y[k - 1])
    y += 0.5 * rng.standard_normal(len(u))
    found = []
    for rest, level in ((0.0, 0.0), (0.0, 24.5), (-12.3, 293.15)):
        record = Dataset.from_arrays(u + rest, y + level, 0.01, input_units="V", output_unit="degC")
        model = identify(record, model="oe", threads=2)
        assert model.rest.y == pytest.approx(level, abs=0.3)
        assert model.rest.is_standstill == (level == 0.0)
        gains = tune(model, evaluations=500, feedforward="none", threads=2).pid.gains
        found.append((gains.Kp, gains.integral, gains.derivative))
    assert found[0] == found[1] == found[2]


def test_the_worst_plant_counts_alone() -> None:
    plants = [drive(), drive(gain=300.0)]
    settings: dict[str, Any] = {"evaluations": 1, "threads": 1, "variations": [(1.0, 0)]}
    settings["start"] = first_controller(drive())
    apart = [tune(p, SHORT, **settings).cost for p in plants]
    assert tune(plants, SHORT, aggregate="worst", **settings).cost == max(apart)
    assert tune(plants, SHORT, **settings).cost == pytest.approx(np.mean(apart), rel=1e-12)


@pytest.mark.parametrize("limits", [{"Ms": 1.0}, {"u": -1.0}, {"overshoot": math.inf}])
def test_limits_that_make_no_sense_are_refused(limits: dict[str, float]) -> None:
    with pytest.raises(SettingError, match="above"):
        Constraints(**limits)


@pytest.mark.parametrize("weight", [-1.0, math.inf, math.nan, "much"])
def test_weights_that_make_no_sense_are_refused(weight: Any) -> None:
    with pytest.raises(SettingError, match="lag"):
        Cost(lag=weight)
    with pytest.raises(SettingError, match="tracking"):
        Cost(tracking=None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="chater"):
        Cost(chater=1.0)  # type: ignore[call-arg]


def test_keeps_what_the_start_says() -> None:
    start = Controller(
        Gains.per_sample(0.02, 2e-4, 0.05, Ts=0.001),
        u_min=-15.0,
        u_max=15.0,
        filter_samples=4,
        filter_time=0.002,
        counts_per_rev=4000.0,
        Tt=0.05,
    )
    tuned = tune(drive(), SHORT, start=start, evaluations=60, threads=2).controller
    assert (tuned.u_min, tuned.u_max, tuned.Tt) == (-15.0, 15.0, 0.05)
    assert (tuned.filter_samples, tuned.filter_time, tuned.counts_per_rev) == (4, 0.002, 4000.0)
    assert math.isinf(tuned.N)
    assert tuned.gains.form == "standard"
    assert default_variations(start) == ((1.0, 0), (0.8, 1), (1.25, 1))


def test_references_may_be_one_or_several_names_or_samples() -> None:
    settings: dict[str, Any] = {"start": first_controller(drive()), "evaluations": 1, "threads": 1}
    one = tune(drive(), "trapezoid", **settings).cost
    samples = signals.reference("trapezoid")
    for same in (samples, list(samples), ["trapezoid"], [samples], [list(samples)]):
        assert tune(drive(), same, **settings).cost == one
    assert tune(drive(), ["trapezoid", samples], **settings).cost == pytest.approx(one, rel=1e-12)
    assert tune(drive(), ["trapezoid", "random"], **settings).cost != one


def test_progress_is_told_and_ctrl_c_keeps_the_best() -> None:
    seen: list[tuple[int, int, float]] = []

    timer = threading.Timer(0.1, signal.raise_signal, [signal.SIGINT])

    def watch(done: int, total: int, best: float) -> None:
        if not seen and done > 0:
            timer.start()
        if done > 0:
            seen.append((done, total, best))

    with pytest.raises(Interrupted) as caught:
        tune(drive(), evaluations=10_000_000, threads=2, progress=watch)
    timer.join()
    assert isinstance(caught.value.best, Controller)
    assert seen[-1][1] == 10_000_000
    assert 0 < seen[-1][0] < 10_000_000


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"u_max": math.inf}, "u_max"),
        ({"u_min": -math.inf}, "limits"),
        ({"u_max": -30.0}, "u_max"),
        ({"cost": {"chatter": 1.0}}, "Cost"),
        ({"aggregate": "best"}, "aggregate"),
        ({"method": "luck"}, "method"),
        ({"constraints": {"u": 1.0}}, "Constraints"),
        ({"variables": []}, "variables"),
        ({"variables": "Kp"}, "variables"),
        ({"variables": ["Kq"]}, "Kq"),
        ({"variables": ["Kp", "Kp"]}, "Kp twice"),
        ({"variables": [("Kp", 1.0)]}, "name, low, high"),
        ({"variables": [("Kp", "low", 1.0)]}, "bounds of Kp"),
        ({"variables": [("Ti", -1.0, 1.0)]}, "Ti"),
        ({"variables": ["Kp[0]"]}, "schedule"),
        ({"variables": ["r_rate"]}, "r_rate"),
        ({"evaluations": 0}, "evaluation"),
        ({"evaluations": 1.5}, "evaluations"),
        ({"seed": -1}, "seed"),
        ({"threads": 0}, "thread"),
        ({"variations": []}, "variations"),
        ({"variations": [1.0]}, "variations"),
        ({"variations": [(0.0, 0)]}, "gain"),
        ({"variations": [(1.0, 0.5)]}, "delay"),
        ({"variations": [(1.0, 99)]}, "delay"),
        ({"filter_samples": 100}, "filter_samples"),
        ({"references": "unheard"}, "unheard"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(SettingError, match=says):
        tune(drive(), **{"references": SHORT, "evaluations": 2, **settings})


def test_plants_that_cannot_be_tuned_on_are_refused() -> None:
    with pytest.raises(SettingError, match="plant"):
        tune([], SHORT)
    with pytest.raises(SettingError, match="machine"):
        tune(VirtualMachine(), SHORT)
    # neither it nor its rate settles: an acceleration is commanded
    with pytest.raises(FitError, match="settles"):
        tune(linear([-2.0, 1.0], [1.0, 0.0]), SHORT)
    unstable, start = linear([-3.0], [1.0]), first_controller(drive())
    with pytest.raises(FitError, match="diverge"):
        tune(unstable, SHORT, start=start, evaluations=30, threads=2)


@pytest.mark.parametrize("references", [[], [[]], [[0.0, math.nan]]])
def test_references_that_cannot_be_run_are_refused(references: Any) -> None:
    with pytest.raises(DataError, match="reference"):
        tune(drive(), references, evaluations=2)


def test_a_unit_that_nobody_stated_stays_open_until_it_is_needed() -> None:
    u = np.repeat([0.0, 2.0, 1.0, 3.0], 600)
    y = np.zeros_like(u)
    for k in range(1, len(u)):
        y[k] = 0.99 * y[k - 1] + 4.9 * u[k - 1]
    model = identify(Dataset.from_arrays(u, y, 1e-3), model="arx", na=1, nb=1)
    found = tune(model, "trapezoid", evaluations=40)
    assert (found.controller.gains.u_unit, found.controller.gains.y_unit) == ("", "")
    assert "u/y" in str(found)
    with pytest.raises(SettingError, match=r"unit of the output 'y'.*--unit RPM"):
        tune(model, counts_per_rev=1572.0)
    stated = tune(model, counts_per_rev=1572.0, output_unit="rad/s", evaluations=20).controller
    assert (stated.gains.y_unit, stated.counts_per_rev) == ("rad/s", 1572.0)
    with pytest.raises(SettingError, match=r"model's unit 'RPM', got output_unit = 'rad/s'"):
        tune(drive(), output_unit="rad/s")


@pytest.mark.parametrize(
    ("top", "least", "is_said"), [(7_000, 0.8, False), (9_000, 0.8, True), (9_000, 1.0, False)]
)
def test_references_beyond_what_the_least_gain_reaches_are_said(
    top: float, least: float, is_said: bool
) -> None:
    """The drive reaches 9,800 RPM at its limit of 20 V, with .8 of its gain 7,840."""
    r = top * np.minimum(1.0, np.arange(400) / 300.0)
    options: dict[str, Any] = {"start": QUIET, "evaluations": 10, "threads": 1}
    found = tune(drive(), [r], variations=[(least, 0), (1.25, 2)], **options)
    assert (found.warning is not None) is is_said
    if found.warning is not None:
        assert "the references ask for 0 to 9000 RPM" in found.warning
        low, high = re.search(r"reaches (\S+) to (\S+) at", found.warning).groups()  # type: ignore[union-attr]
        assert [float(low), float(high)] == pytest.approx([-7840.0, 7840.0], rel=0.02)
        assert found.warning in str(found)
