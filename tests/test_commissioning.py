"""Commissioning: whole on small effort, and every reason to stop.

Networks and searches are cut short: what is tested is what is done and refused, not how well the
controller does; benches/commissioning.py measures that.
"""

from __future__ import annotations

import functools
import json
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import sewfast
from sewfast import (
    Commissioning,
    Controller,
    DataError,
    Dataset,
    Ensemble,
    FitError,
    Gains,
    Interrupted,
    LinearOE,
    SettingError,
    VirtualMachine,
    _core,
    commission,
    identification,
    load_controller,
    load_model,
    read_table,
    tuning,
)
from sewfast.commissioning import (
    STAGES,
    Bench,
    Followed,
    Refusal,
    agreement,
    gains,
    procedure,
    training,
)
from sewfast.commissioning.bench import DriveBench, MachineBench, bench_of
from sewfast.commissioning.demands import demands
from sewfast.commissioning.requirements import Requirements
from sewfast.link import VirtualDevice, connect
from sewfast.recording import Recording
from sewfast.report import report


@pytest.fixture(autouse=True, scope="module")
def _short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        quick = functools.partial(identification.identify, iterations=15)
        patch.setattr(training, "identify", quick)
        yield


SMALL: dict[str, Any] = {"members": 2, "evaluations": 25, "seed": 1}


@pytest.fixture(scope="module")
def whole(_short: None) -> Commissioning:
    return commission(VirtualMachine(), **SMALL)


@dataclass
class Bent(Bench):
    """The virtual machine with a bend in what it does or shows."""

    inner: MachineBench
    sign: float = 1.0
    most: float = np.inf
    slips: bool = False
    played: int = 0

    name = "bent"
    speed = np.inf

    @property
    def Ts(self) -> float:
        return self.inner.Ts

    @property
    def counts_per_rev(self) -> float:
        return self.inner.counts_per_rev

    @property
    def volt(self) -> float:
        return self.inner.volt

    def bend(self, recording: Recording) -> Recording:
        counts = np.minimum(self.sign * recording.counts, self.most)
        if self.slips:
            counts = counts * (1.0 + 0.5 * np.sin(np.arange(len(counts)) / 700.0))
        bent = replace(recording, counts=counts)
        return replace(bent, y=bent.speed("savgol"))

    def excite(self, u: np.ndarray, name: str) -> Recording:
        self.played += 1
        return self.bend(self.inner.excite(u, name))

    def follow(self, controller: Controller, r: np.ndarray, name: str) -> Followed:
        self.played += 1
        found = self.inner.follow(controller, r, name)
        return Followed(found.run, self.bend(found.recording))


def bent(parameters: dict[str, float] | None = None, **bend: Any) -> Bent:
    return Bent(MachineBench(VirtualMachine(parameters=parameters)), **bend)


# --- whole --------------------------------------------------------------------------------------


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
    first = [bench.follow(whole.first, c.predicted.r, c.reference).run for c in whole.comparisons]
    assert whole.measured_cost is not None
    assert whole.measured_cost < 0.5 * whole.cost.of(first)


def test_the_gains_bear_what_is_required_beside_the_cost(whole: Commissioning) -> None:
    assert whole.met is not None
    assert max(whole.met["Ms"]) <= whole.met["Ms_limit"] == 2.0
    load, recovery = whole.met["load"], whole.met["recovery_ms"]
    assert (load["level"], load["disturbance"]) == (1500.0, -2.0)
    assert len(recovery["tuned"]) == 2
    assert all(t <= r for t, r in zip(recovery["tuned"], recovery["rule"], strict=True))
    assert whole.first is not None
    assert "eq-12, Ms <= 1.8" in whole.first.notes
    assert "recovery" in str(whole)


def test_report_card_and_judgement_are_evidence(whole: Commissioning, tmp_path: Path) -> None:
    assert whole.card is not None
    assert whole.card.data.startswith("levels")
    assert whole.judgement is not None
    assert {r.run.reference for r in whole.judgement.runs} == {
        c.reference for c in whole.comparisons
    }
    told = whole.numbers()["evidence"]
    assert told["report card"]["verdict"] == whole.card.verdict
    page = whole.save(tmp_path / "out").read_text()
    assert "training region" in page
    assert "Required beside the cost" in page


def test_without_a_load_or_ms_nothing_is_required() -> None:
    found = commission(VirtualMachine(2), load=0.0, Ms=None, time_budget=1e6, **SMALL)
    assert found.met == {"Ms_limit": None, "Ms": [], "load": None}
    assert found.tuning is not None
    assert str(found.tuning.constraints) == "none"


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
    found = Requirements.of(Ensemble.of([unstable]), whole.fopdt, wild, asked)
    assert (found.loads, found.rival, found.constraints.recovery) == ((), None, None)


def test_nothing_is_learned_from_the_true_speed_or_the_recording_judged_by(
    whole: Commissioning,
) -> None:
    assert whole.models is not None
    for member in whole.models.members:
        assert {d["name"] for d in member.training["data"]} <= {"pulses", "trapezoids"}
    for name in ("pulses", "trapezoids", "levels"):
        recording = whole.recordings[name]
        np.testing.assert_array_equal(recording.y, recording.speed("kalman"))


def test_excitation_stays_within_command_and_speed(whole: Commissioning) -> None:
    for recording in whole.recordings.values():
        assert np.max(np.abs(recording.u)) <= 20.0
        assert recording.speed_true is not None
        assert np.max(recording.speed_true) < 1.25 * 1.2 * 2000.0


def test_a_seed_gives_the_same_controller_again(whole: Commissioning) -> None:
    again = commission(VirtualMachine(), **SMALL, threads=1)
    assert again.controller == whole.controller


def test_another_range_and_limit_are_kept() -> None:
    found = commission(VirtualMachine(3), u_max=12.0, speed=1200.0, **SMALL)
    assert found.controller is not None
    assert (found.controller.u_min, found.controller.u_max) == (-12.0, 12.0)
    assert max(float(c.predicted.r.max()) for c in found.comparisons) == pytest.approx(1200.0)
    assert all(np.max(np.abs(r.u)) <= 12.0 for r in found.recordings.values())


def test_own_references_are_verified_on() -> None:
    r = np.concatenate([np.linspace(0.0, 900.0, 400), np.full(800, 900.0)])
    found = commission(VirtualMachine(), references={"mine": r}, **SMALL)
    assert [c.reference for c in found.comparisons] == ["mine"]
    np.testing.assert_array_equal(found.comparisons[0].predicted.r, r)


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


# --- reasons to stop ----------------------------------------------------------------------------


def refused(bench: Bench, match: str, **options: Any) -> Refusal:
    with pytest.raises(Refusal, match=match) as caught:
        commission(bench, **{**SMALL, **options})
    assert caught.value.so_far is not None
    assert caught.value.so_far.verdict == "refused"
    assert caught.value.so_far.stage == caught.value.stage
    return caught.value


def test_a_dead_machine_is_refused_at_the_first_motion() -> None:
    found = refused(bent({"coulomb_torque": 10.0}), "expected the machine to move.*free")
    assert found.stage == "first motion"
    assert found.so_far is not None
    assert found.so_far.recordings


def test_a_machine_that_turns_backwards_is_refused_before_a_loop_is_closed() -> None:
    bench = bent(sign=-1.0)
    assert refused(bench, "backwards; swap").stage == "first motion"
    assert bench.played <= 8


def test_an_end_stop_is_too_little_travel() -> None:
    assert refused(bent(most=300.0), "too little travel").stage == "first motion"


def test_a_machine_too_weak_for_its_top_speed_is_refused() -> None:
    found = refused(bent(), "lower speed", u_max=3.0)
    assert found.stage in ("first motion", "step response")


def test_a_loop_that_leans_on_its_limit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def wild(*args: Any) -> Controller:
        return replace(gains.first_gains(*args), gains=Gains.standard(50.0, 0.05))

    monkeypatch.setattr(procedure, "first_gains", wild)
    found = refused(bent(), "within its limits most of the time")
    assert found.stage == "closed loop"


def test_a_step_that_does_not_settle_is_refused() -> None:
    assert refused(bent(slips=True), "expected a s").stage in ("first motion", "step response")


def test_networks_that_do_not_predict_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = iter([(100.0, 40.0), (110.0, 35.0)])
    monkeypatch.setattr(training, "validate_member", lambda *_: next(scores))
    assert refused(bent(), "free-run fit of 85 %").stage == "training"


def test_networks_that_differ_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = iter([(3.0, 99.0), (100.0, 60.0), (120.0, 50.0)])
    monkeypatch.setattr(training, "validate_member", lambda *_: next(scores))
    assert refused(bent(), "networks that agree", members=3).stage == "training"


def test_a_machine_that_changed_is_not_verified() -> None:
    class Changes(Bent):
        def follow(self, controller: Controller, r: np.ndarray, name: str) -> Followed:
            if name not in ("trapezoids", "levels"):
                values = {"current_limit": 1.0}
                self.inner = MachineBench(VirtualMachine(parameters=values))
            return super().follow(controller, r, name)

    found = refused(Changes(MachineBench(VirtualMachine())), "verif|limits most")
    assert found.stage == "verification"
    assert found.so_far is not None
    assert found.so_far.controller is not None


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"u_max": 0.0}, "u_max above 0"),
        ({"u_max": 40.0}, "within the machine's limit of 20 V"),
        ({"speed": -1.0}, "top speed above 0"),
        ({"members": 0}, "members of 1"),
        ({"evaluations": 0}, "evaluations of 1"),
        ({"load": -1.0}, "load from 0 V"),
        ({"load": 20.0}, "load from 0 V to below u_max"),
        ({"Ms": 0.9}, "above 1 for Ms"),
        ({"time_budget": 0.0}, "time_budget above 0"),
        ({"references": "trapezoid"}, "references by name"),
        ({"references": ["nonsense"]}, "known ones"),
        ({"references": ["trapezoid"], "speed": 500.0}, "raise speed"),
    ],
)
def test_demands_that_contradict_are_refused_before_anything_moves(
    options: dict[str, Any], match: str
) -> None:
    bench = bent()
    with pytest.raises(SettingError, match=match):
        commission(bench, **options)
    assert bench.played == 0


@pytest.mark.parametrize("samples", [[], [1.0, float("nan")]])
def test_a_reference_that_cannot_be_run_is_refused(samples: list[float]) -> None:
    bench = bent()
    with pytest.raises(DataError, match="finite samples in the reference 'mine'"):
        commission(bench, references={"mine": samples})
    assert bench.played == 0


def test_only_machines_are_commissioned() -> None:
    with pytest.raises(SettingError, match="VirtualMachine, a Drive or a Bench"):
        commission("virtual")  # type: ignore[arg-type]


# --- Ctrl-C -------------------------------------------------------------------------------------


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
    monkeypatch.setattr(training, "identify", deaf)
    try:
        with pytest.raises(Interrupted) as caught:
            commission(VirtualMachine(), **SMALL)
        assert not waited
    finally:
        over.set()
        signal.signal(signal.SIGALRM, before)
    assert caught.value.best.stage == "training"


def test_an_interrupted_search_keeps_its_best_gains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(*args: Any, start: Controller, **options: Any) -> tuning.TuningResult:
        raise Interrupted(replace(start, notes="the best so far"))

    monkeypatch.setattr(gains, "tune", stopped)
    with pytest.raises(Interrupted) as caught:
        commission(VirtualMachine(), **SMALL)
    assert caught.value.best.controller.notes == "the best so far"


# --- the folder ---------------------------------------------------------------------------------


def test_the_folder_holds_everything_and_its_page_is_written_anew(
    whole: Commissioning, tmp_path: Path
) -> None:
    page = whole.save(tmp_path / "out")
    out = tmp_path / "out"
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
    assert "Commissioning of virtual: verified" in text
    assert '<figure id="analysis-bode">' in text
    page.unlink()
    assert report(out) == page
    assert page.read_text() == text


def test_a_folder_of_somebody_else_is_left_alone(whole: Commissioning, tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "mine.json").write_text("mine")
    with pytest.raises(SettingError, match="overwrite"):
        whole.save(tmp_path)
    assert (tmp_path / "models" / "mine.json").read_text() == "mine"


def test_nothing_of_an_earlier_commissioning_stays(whole: Commissioning, tmp_path: Path) -> None:
    whole.save(tmp_path)
    replace(whole, comparisons=(), recordings={}).save(tmp_path)
    assert not list((tmp_path / "runs").iterdir())
    assert not list((tmp_path / "recordings").iterdir())


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
    kept = agreement.agreeing(whole.controller, Ensemble.of([good, stuck, good]), r)
    assert kept.members == (good, good)
    with pytest.raises(Refusal, match="more than half of 2 networks"):
        agreement.agreeing(whole.controller, Ensemble.of([good, stuck]), r)
