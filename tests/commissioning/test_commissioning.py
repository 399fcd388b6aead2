"""Commissioning: whole on small effort, interruptions, the folder.

Networks and searches are cut short: what is tested is what is done, not how well the controller
does; benches/commissioning.py measures that.
"""

from __future__ import annotations

import json
import math
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import called as sewfast
from commissioned import SMALL, short
from fitted import fitted, made
from link_device import ScriptedDevice
from moments import once_on
from sewfast import (
    Commissioning,
    Controller,
    Dataset,
    Ensemble,
    FitError,
    Gains,
    Interrupted,
    LinearOE,
    Recording,
    SettingError,
    VirtualMachine,
    _core,
    bode,
    commission,
    load_controller,
    load_model,
    load_response,
    read_table,
    stop_at,
)
from sewfast.causes import cause_after
from sewfast.commissioning import STAGES, Refusal, gains, training, verification
from sewfast.commissioning.bench import (
    DriveBench,
    MachineBench,
    RecordedBench,
    SteppedBench,
    bench_of,
)
from sewfast.commissioning.demands import demands
from sewfast.commissioning.gains import Requirements
from sewfast.commissioning.positions import (
    Stop,
    Unsuited,
    position_loop,
    telling,
    unmet,
    verified_stops,
)
from sewfast.errors import LinkError
from sewfast.link import VirtualDevice, connect
from sewfast.report import commissioned, report
from sewfast.tuning import search
from sewfast.tuning.objective import LARGEST_MS


@pytest.fixture(autouse=True, scope="module")
def _short() -> Iterator[None]:
    with short():
        yield


def on_the_virtual_machine() -> Commissioning:
    with short():
        return commission(VirtualMachine(), **SMALL)


def with_page(folder: Path) -> None:
    whole = fitted(on_the_virtual_machine)
    assert whole.save(folder / "out") == folder / "out" / "report.html"


@pytest.fixture(scope="module")
def whole() -> Commissioning:
    return fitted(on_the_virtual_machine)


@pytest.fixture(scope="module")
def saved() -> Path:
    """Its folder, written once; a test that changes it takes a copy."""
    return made(with_page) / "out"


@pytest.fixture
def out(saved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "out"))


# --- whole --------------------------------------------------------------------------------------


def test_the_page_has_margins_as_predicted_and_as_measured(
    whole: Commissioning, saved: Path, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    response = bode(VirtualMachine(), speed=1000.0, realisations=1, periods=2)
    margins = {
        "speed": 1000.0,
        "predicted": {"Ms": 1.234, "phase_margin_deg": 61.2, "gain_margin": 10.0},
        "measured": {"Ms": 1.345, "phase_margin_deg": math.inf, "gain_margin": math.inf}
        | {"Ms_band": [1.3, math.inf]},
    }
    found = replace(whole, margins=margins, response=response)
    page = found.save(tmp_path / "with").read_text(encoding="utf-8")
    for shown in ("1.23", "1.34 (1.30 to –)", "61°", "20.0 dB", "∞", 'id="frequency-response"'):
        assert shown in page
    again = load_response(tmp_path / "with" / "analysis" / "response.json")
    np.testing.assert_array_equal(again.value, response.value)
    assert "Margins, predicted" not in (saved / "report.html").read_text(encoding="utf-8")


def test_it_is_drawn_and_shown(whole: Commissioning, tmp_path: Path) -> None:
    assert "<td>" in whole._repr_html_()
    pytest.importorskip("matplotlib", reason="needs the report extra")
    panels = whole.plot(reference="random", file=tmp_path / "random.png")
    labels = [line.get_label() for line in panels[0].lines]
    assert labels == ["measured", "predicted", "reference"]
    with pytest.raises(SettingError, match="chirp_lo_hi"):
        whole.plot(reference="ramp")


def test_it_ends_verified_with_prediction_beside_measurement(whole: Commissioning) -> None:
    assert whole.is_verified
    assert tuple(whole.seconds) == STAGES
    assert [c.reference for c in whole.comparisons] == [
        "trapezoid", "chirp_hi_lo", "chirp_lo_hi", "random",
    ]  # fmt: skip
    for c in whole.comparisons:
        assert c.measured is not None
        np.testing.assert_array_equal(c.measured.r, c.predicted.r)
        assert c.apart == pytest.approx(np.sqrt(np.mean((c.measured.y - c.predicted.y) ** 2)))
    assert whole.models is not None
    assert len(whole.rmse) == len(whole.models.members) == 2
    assert whole.measured_cost is not None
    assert "verified" in str(whole)


def test_the_tuned_gains_are_better_than_the_first_on_the_machine(whole: Commissioning) -> None:
    assert whole.first is not None
    assert whole.cost is not None
    bench = MachineBench(VirtualMachine())
    first = [bench.follow(whole.first, c.predicted.r, c.reference) for c in whole.comparisons]
    assert whole.measured_cost is not None
    assert whole.measured_cost < 0.5 * whole.cost.of(first)


def test_the_gains_bear_what_is_required_beside_the_cost(whole: Commissioning) -> None:
    assert whole.met is not None
    assert max(whole.met["Ms"]) <= whole.met["Ms_limit"] == LARGEST_MS
    load, recovery = whole.met["load"], whole.met["recovery_ms"]
    assert (load["level"], load["disturbance"]) == (1500.0, -2.0)
    assert len(recovery["tuned"]) == 2
    assert all(t <= r for t, r in zip(recovery["tuned"], recovery["rule"], strict=True))
    assert whole.first is not None
    assert "eq-12, Ms <= 1.8" in whole.first.notes
    assert "recovery" in str(whole)


def test_report_card_and_judgement_are_evidence(whole: Commissioning, saved: Path) -> None:
    assert whole.card is not None
    assert whole.card.data.startswith("levels")
    assert whole.judgement is not None
    assert {r.run.reference for r in whole.judgement.runs} == {
        c.reference for c in whole.comparisons
    }
    told = whole.numbers()["evidence"]
    assert told["report card"]["verdict"] == whole.card.verdict
    page = (saved / "report.html").read_text()
    assert "training region" in page
    assert "Required besides the cost" in page


@pytest.mark.nightly("a commissioning of its own")
def test_without_a_load_or_ms_nothing_is_required() -> None:
    found = commission(VirtualMachine(2), load=0.0, Ms=None, time_budget=1e6, **SMALL)
    assert found.met == {"Ms_limit": None, "Ms": [], "tolerance": [], "load": None}
    assert found.tuning is not None
    assert str(found.tuning.constraints) == "Ms not limited"


def test_a_rule_that_no_member_bears_is_no_measure(whole: Commissioning) -> None:
    assert whole.fopdt is not None
    assert whole.first is not None
    assert whole.models is not None
    asked = demands(
        MachineBench(VirtualMachine()), u_max=None, speed=None, references=None, members=1,
        evaluations=1, seed=0, threads=1,
    )  # fmt: skip
    wild = replace(whole.first, gains=Gains.standard(50.0, 1e-3), u_min=-1e9, u_max=1e9)
    runaway = _core.LinearModel(np.array([-2.0]), np.array([[500.0]]), 1, 0.0)
    good = whole.models.members[0]
    unstable = LinearOE(runaway, good.Ts, good.input_names, good.output_name, ("V",), "RPM")
    found = Requirements.of(Ensemble.of([unstable]), whole.fopdt, 2e4, wild, asked, None)
    assert (found.loads, found.rival, found.constraints.recovery) == ((), None, None)


def test_nothing_is_learned_from_the_true_speed_or_the_recording_judged_by(
    whole: Commissioning,
) -> None:
    assert whole.models is not None
    for member in whole.models.members:
        assert {d["name"] for d in member.training["data"]} <= {
            "step",
            "pulses",
            "pulses_limited",
            "trapezoids",
        }
    for name in ("pulses", "trapezoids", "levels"):
        recording = whole.recordings[name]
        np.testing.assert_array_equal(recording.y, recording.speed("kalman"))


def test_excitation_stays_within_command_and_speed(whole: Commissioning) -> None:
    for recording in whole.recordings.values():
        assert np.max(np.abs(recording.u)) <= 20.0
        assert recording.speed_true is not None
        assert np.max(recording.speed_true) < 1.25 * 1.2 * 2000.0


@pytest.mark.nightly("a commissioning, made again")
def test_a_seed_gives_the_same_controller_again(whole: Commissioning) -> None:
    again = commission(VirtualMachine(), **SMALL, threads=1)
    assert again.controller == whole.controller


@pytest.mark.nightly("a commissioning of its own")
def test_another_range_and_limit_are_kept() -> None:
    found = commission(VirtualMachine(3), u_max=12.0, speed=1200.0, **SMALL)
    assert found.controller is not None
    assert (found.controller.u_min, found.controller.u_max) == (-12.0, 12.0)
    assert max(float(c.predicted.r.max()) for c in found.comparisons) == pytest.approx(1200.0)
    assert all(np.max(np.abs(r.u)) <= 12.0 for r in found.recordings.values())


@pytest.mark.nightly("a commissioning of its own")
def test_own_references_are_verified_on() -> None:
    r = np.concatenate([np.linspace(0.0, 900.0, 400), np.full(800, 900.0)])
    found = commission(VirtualMachine(), references={"mine": r}, **SMALL)
    assert [c.reference for c in found.comparisons] == ["mine"]
    np.testing.assert_array_equal(found.comparisons[0].predicted.r, r)


@pytest.mark.nightly("a commissioning of its own")
def test_a_constant_reference_is_judged_by_the_way_from_rest() -> None:
    found = commission(VirtualMachine(), references={"hold": np.full(1500, 900.0)}, **SMALL)
    assert found.is_verified
    assert found.comparisons[0].span == 900.0


@pytest.mark.nightly("a commissioning of its own; by day the experiment's goes over the link")
def test_a_drive_behind_a_port_is_commissioned_as_the_machine_is(whole: Commissioning) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits()
        found = commission(drive, **SMALL)
        assert drive.limits().volt == drive.limits().ceilings[0]
    assert found.is_verified
    assert found.fopdt is not None
    assert whole.fopdt is not None
    # commands travel as single precision
    np.testing.assert_allclose(found.fopdt.K, whole.fopdt.K, rtol=1e-3)


def test_a_drives_volt_limit_is_lowered_as_long_as_it_lasts() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits()
        before = drive.limits().volt
        with bench_of(drive, 7.0) as bench:
            assert isinstance(bench, DriveBench)
            assert bench.volt == pytest.approx(7.0)
        assert drive.limits().volt == before


def test_a_position_loop_stops_where_it_is_predicted(whole: Commissioning, tmp_path: Path) -> None:
    controller, models, cost = whole.controller, whole.models, whole.cost
    assert isinstance(controller, Controller)
    assert models is not None
    assert cost is not None
    practice = {c.reference: c.predicted.r for c in whole.comparisons}
    position = position_loop(controller, models, practice, cost, None, 1500.0)
    assert position.controller.fastest == 1500.0
    bench, kept = MachineBench(VirtualMachine(), speed=3000.0), []
    stops = verified_stops(position.controller, bench, models, 2000.0, kept.append)
    assert kept[-1] == stops
    assert unmet(stops) == ""
    assert all(s.measured is not None and s.measured.metrics()["passed"] < 0.5 for s in stops)
    # a drive that brakes less than its models is not verified, and makes no further stop
    weak = VirtualMachine(parameters={"inertia": 0.004})
    missed = verified_stops(position.controller, MachineBench(weak), models, 2000.0, kept.append)
    assert "passed its goal" in unmet(missed)
    assert [s.measured is None for s in missed] == [False, True, True]
    cut = stop_at(position.controller, VirtualMachine(), "90deg", speed=1500.0, after=0.05)
    assert "has not come to rest" in unmet([Stop("cut", (), cut)])
    found = replace(whole, position=position, stops=stops)
    page = found.save(tmp_path / "positions").read_text()
    assert "Stops at an angle" in page
    assert "270deg from 1500 RPM" in page
    assert "270deg from 1500 RPM" in str(found)
    law = load_controller(tmp_path / "positions/controllers/position.json")
    assert law == position.controller
    slow = replace(controller, Ts=1e-4, filter_samples=1, feedforward=None)
    with pytest.raises(Unsuited, match="slow drive"):
        position_loop(slow, models, practice, cost, None, 1500.0)


def test_a_missed_stop_has_the_cause_that_came_with_it(whole: Commissioning) -> None:
    controller, models, cost = whole.controller, whole.models, whole.cost
    assert isinstance(controller, Controller)
    assert models is not None
    assert cost is not None
    practice = {c.reference: c.predicted.r for c in whole.comparisons}
    law = position_loop(controller, models, practice, cost, None, 1500.0).controller

    def stopped(machine: MachineBench | SteppedBench) -> tuple[list[Recording], list[bool]]:
        bench = RecordedBench(machine, lambda *_: None, lambda *_: None, lambda *_: None)
        stops = verified_stops(law, bench, models, 2000.0, lambda _: None)
        found = telling(bench.runs, stops, law)
        return found, [len(part) < len(run) for part, run in zip(found, bench.runs, strict=True)]

    (*sound, last), landed = stopped(MachineBench(VirtualMachine()))
    assert landed == [True, True, True], "what lands is left out"
    sound = [whole.recordings["trapezoids"], whole.recordings["levels"], *sound]
    limits = {"volt": 20.0, "speed": 3000.0}
    assert cause_after(sound, last, **limits) is None
    assert cause_after([], last, **limits) is None, "no earlier run to compare with"
    heavy = VirtualMachine(parameters={"inertia": 0.006})
    cause = cause_after(sound, stopped(MachineBench(heavy))[0][-1], **limits)
    assert cause is not None
    assert cause.name == "inertia"
    assert cause.value == pytest.approx(3.0, rel=0.4)
    (never,), landed = stopped(SteppedBench(Sticks(), 0.001, 1572.0, 20.0))
    assert landed == [False]
    cause = cause_after(sound, never, **limits)
    assert cause is not None
    assert cause.name == "stage stuck"
    # it shows where the command changes next
    assert cause.at == pytest.approx(Sticks.AFTER * 0.001, abs=0.1)


class Sticks:
    """The virtual machine, whose stage holds its command from some sample on."""

    AFTER = 500

    def __init__(self) -> None:
        self.machine, self.u, self.taken = VirtualMachine(), 0.0, 0

    @property
    def counts(self) -> float:
        return float(self.machine.counts)

    def reset(self) -> None:
        self.machine.reset()
        self.taken = 0

    def step(self, u: float) -> None:
        self.taken += 1
        self.u = u if self.taken < self.AFTER else self.u
        self.machine.step(self.u)


def test_positions_are_asked_for_by_name_and_not_of_a_device_without(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="loop"):
        commission(VirtualMachine(), loop="angle")  # type: ignore[arg-type]
    with ScriptedDevice(tmp_path) as device, connect(device.url) as drive:
        drive.set_limits()
        with pytest.raises(SettingError, match="SEWFAST_CAN_POSITIONS"):
            commission(drive, loop="position")
        assert drive.outcome is None


@pytest.mark.nightly("a commissioning of its own")
def test_positions_are_commissioned() -> None:
    found = commission(VirtualMachine(), loop="position", **SMALL)
    assert found.is_verified
    assert len(found.stops) == 3


@pytest.mark.nightly("a commissioning of its own")
def test_positions_are_commissioned_on_a_device() -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=8000.0)
        found = commission(drive, loop="position", **SMALL)
    assert found.is_verified
    assert len(found.stops) == 3


def test_a_run_of_which_the_link_lost_samples_is_made_once_more() -> None:
    made: list[int] = []
    with (
        VirtualDevice(fast=True, faults="drop=.004", seed=3) as device,
        connect(device.port) as drive,
    ):
        drive.set_limits()
        stream = drive.stream

        def counted(*told: Any) -> Any:
            made[-1] += 1
            return stream(*told)

        drive.stream = counted  # type: ignore[method-assign]
        repeated = 0
        with bench_of(drive, None) as bench:
            for _ in range(100):
                made.append(0)
                with suppress(LinkError):  # lost twice
                    assert np.isfinite(bench.excite(np.full(400, 2.0), "step").counts).all()
                    repeated += made[-1] == 2
                if repeated:
                    break
    assert repeated


def test_the_page_says_of_every_stage_what_was_done() -> None:
    assert set(STAGES) <= set(commissioned.WHAT)


# --- Ctrl-C -------------------------------------------------------------------------------------


@pytest.mark.nightly("a commissioning for each stage", by_day=["training"])
@pytest.mark.parametrize("stage", ["closed loop", "training", "tuning", "verification"])
def test_an_interruption_keeps_what_there_is(stage: str, tmp_path: Path) -> None:
    def interrupt(done: int, total: int, text: str) -> None:
        if text == stage:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as caught:
        commission(VirtualMachine(), **SMALL, progress=interrupt)
    best = caught.value.best
    assert isinstance(best, Commissioning)
    assert best.verdict == "interrupted"
    assert best.controller is not None
    best.save(tmp_path / "out")
    told = json.loads((tmp_path / "out" / "commissioning.json").read_text())
    assert told["verdict"] == "interrupted"
    assert load_controller(tmp_path / "out" / "controllers" / "tuned.json") == best.controller


def test_an_interruption_of_the_first_stage_is_none_of_the_program() -> None:
    def interrupt(*told: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(Interrupted) as caught:
        commission(VirtualMachine(), **SMALL, progress=interrupt)
    assert caught.value.best.stage == STAGES[0]


def test_ctrl_c_does_not_wait_for_what_cannot_be_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a member is told of itself after its training takes seconds and looks at no request."""
    begun, over = threading.Event(), threading.Event()
    waited: list[bool] = []

    def deaf(data: Dataset, **options: Any) -> Any:
        begun.set()
        waited.append(not over.wait(60.0))
        raise FitError("not trained")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)

    def alarm() -> None:
        begun.wait()
        signal.setitimer(signal.ITIMER_REAL, 0.05)

    threading.Thread(target=alarm).start()
    monkeypatch.setattr(training, "seeded", deaf)
    try:
        with pytest.raises(Interrupted) as caught:
            commission(VirtualMachine(), **SMALL)
        assert not waited
    finally:
        over.set()
        signal.signal(signal.SIGALRM, before)
    assert caught.value.best.stage == "training"


@pytest.mark.nightly("a commissioning for each stage", by_day=["step response"])
@pytest.mark.parametrize("stage", ["step response", "training", "tuning", "verification"])
def test_cancelled_it_ends_as_after_ctrl_c(stage: str) -> None:
    cancel = threading.Event()

    def progress(done: int, total: int, text: str) -> None:
        if text == stage:
            cancel.set()

    with pytest.raises(Interrupted) as caught:
        commission(VirtualMachine(), **SMALL, progress=progress, cancel=cancel)
    best = caught.value.best
    assert (best.verdict, best.reason, best.stage) == ("interrupted", "cancelled", stage)
    assert (best.controller is not None) == (stage != "step response")


def test_cancelled_it_stops_a_drive_that_runs() -> None:
    cancel = threading.Event()
    # in real time: a fast device can be done with its command before it hears of the cancellation
    with VirtualDevice() as device, connect(device.port, watchdog=2.0) as drive:
        drive.set_limits()
        once_on(device, cancel.set, after=0.0)
        with pytest.raises(Interrupted) as caught:
            commission(drive, **SMALL, cancel=cancel)
        assert drive.outcome is not None
        assert drive.outcome.reason == "cancelled"
        assert drive.status().state == "idle"
        assert device.trace()[-1]["event"] == "off"
    assert caught.value.best.stage == "first motion"


@pytest.mark.nightly("a commissioning of its own")
def test_between_stages_somebody_is_asked(whole: Commissioning) -> None:
    seen: list[tuple[str, Commissioning]] = []
    found = commission(
        VirtualMachine(), **SMALL, between=lambda stage, so_far: seen.append((stage, so_far))
    )
    assert [stage for stage, _ in seen] == [*STAGES, "references"]
    predicted = seen[-1][1].comparisons
    assert all(c.measured is None for c in predicted)
    assert [c.reference for c in predicted] == [c.reference for c in found.comparisons]
    assert found.controller == whole.controller


@pytest.mark.nightly("a commissioning of its own")
def test_an_interrupted_search_keeps_its_best_gains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(*args: Any, start: Controller, **options: Any) -> search.TuningResult:
        raise Interrupted(replace(start, notes="the best so far"))

    monkeypatch.setattr(gains, "tune", stopped)
    with pytest.raises(Interrupted) as caught:
        commission(VirtualMachine(), **SMALL)
    assert caught.value.best.controller.notes == "the best so far"


# --- the folder ---------------------------------------------------------------------------------


@pytest.mark.nightly("a commissioning of its own")
def test_the_folder_holds_everything_and_its_page_is_written_anew(
    whole: Commissioning, out: Path
) -> None:
    page = out / "report.html"
    told = json.loads((out / "commissioning.json").read_text())
    assert (told["format"], told["version"]) == ("sewfast.commissioning", 1)
    assert told["measured_cost"] == pytest.approx(whole.measured_cost)
    assert load_controller(out / "controllers" / "tuned.json") == whole.controller
    assert whole.models is not None
    assert len(load_model(out / "models" / "ensemble.json").members) == 2  # type: ignore[attr-defined]
    assert len(read_table(out / "recordings" / "pulses.csv")["y"]) > 1000
    assert {p.name for p in (out / "runs").iterdir()} == {
        f"{c.reference}_{kind}.npz" for c in whole.comparisons for kind in ("predicted", "measured")
    }
    text = page.read_text()
    assert "Commissioning of the virtual machine" in text
    assert ">verified</span>" in text
    assert '<figure id="analysis-bode">' in text
    page.unlink()
    assert report(out) == page
    assert page.read_text() == text


@pytest.mark.nightly("a commissioning of its own")
def test_a_linear_rival_is_asked_and_shown(whole: Commissioning, out: Path) -> None:
    assert whole.rival is not None
    assert whole.rival.is_fit
    assert whole.tuning is not None
    assert whole.tuning.opinion is not None
    assert whole.notes == ()
    assert "A second opinion." in (out / "report.html").read_text()
    # a folder of before, without what is told of the rival
    numbers = out / "commissioning.json"
    told = json.loads(numbers.read_text())
    assert told["second_opinion"]["taken"] == 0
    for name in ("rival", "second_opinion", "notes", "simulated_at_s"):
        del told[name]
    del told["models"]["kind"]
    numbers.write_text(json.dumps(told))
    assert "A second opinion." not in report(out).read_text()
    told["notes"] = ["tuned on <the> linear model"]
    numbers.write_text(json.dumps(told))
    assert "tuned on &lt;the&gt; linear model" in report(out).read_text()


def test_a_folder_of_somebody_else_is_left_alone(whole: Commissioning, tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "mine.json").write_text("mine")
    with pytest.raises(SettingError, match="overwrite"):
        whole.save(tmp_path)
    assert (tmp_path / "models" / "mine.json").read_text() == "mine"


@pytest.mark.nightly("a commissioning of its own")
def test_nothing_of_an_earlier_commissioning_stays(whole: Commissioning, out: Path) -> None:
    assert list((out / "runs").iterdir())
    replace(whole, comparisons=(), recordings={}).save(out)
    assert not list((out / "runs").iterdir())
    assert not list((out / "recordings").iterdir())


@pytest.mark.nightly("a commissioning and its page; the one that is refused runs by day")
def test_the_command_fills_a_folder(tmp_path: Path) -> None:
    told = sewfast(
        tmp_path, "commission", "--on", "virtual:2", "--out", "two", "--members", "1",
        "--evaluations", "10", "--speed", "1500", "--json",
    )  # fmt: skip
    assert json.loads(told.out)["verdict"] == "verified"
    assert (tmp_path / "two" / "report.html").is_file()


def test_the_command_keeps_what_it_refused(tmp_path: Path) -> None:
    told = sewfast(
        tmp_path, "commission", "--on", "virtual", "--out", "weak", "--u-max", "3", done=2
    )
    assert "lower speed" in told.err
    found = json.loads((tmp_path / "weak" / "commissioning.json").read_text())
    assert found["verdict"] == "refused"


# --- members that part --------------------------------------------------------------------------


def test_a_member_that_parts_from_the_others_is_left_out(whole: Commissioning) -> None:
    assert whole.models is not None
    assert whole.controller is not None
    r = {"hold": np.concatenate([np.linspace(0.0, 900.0, 300), np.full(300, 900.0)])}
    good = whole.models.members[0]
    linear = _core.LinearModel(np.array([-0.9]), np.array([[0.5]]), 1, 0.0)
    stuck = LinearOE(linear, good.Ts, good.input_names, good.output_name, ("V",), "RPM")
    kept = verification.agreeing(whole.controller, Ensemble.of([good, stuck, good]), r)
    assert kept.members == (good, good)
    with pytest.raises(Refusal, match="at least half of 2 networks"):
        verification.agreeing(whole.controller, Ensemble.of([good, stuck]), r)
