"""Guards of closed loops: region, saturation, limit cycle, members that disagree."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cli import called as command
from loops import QUIET, drive
from sewfast import Ensemble, VirtualMachine, identify, paper_controller, run, signals, tune
from sewfast.control import Controller, Gains
from sewfast.control.loop import ClosedLoopRun
from sewfast.dataset import Dataset
from sewfast.errors import FitError, SettingError
from sewfast.trust import Limits, disagreements, judge, oscillation

LEVELS = np.concatenate(
    [np.linspace(0.0, 1500.0, 200), np.full(900, 1500.0), np.full(900, 300.0), np.full(900, 120.0)]
)


def loop(y: np.ndarray, u: np.ndarray, r: np.ndarray, unit: str = "RPM") -> ClosedLoopRun:
    """A run with these columns."""
    gains = Gains.standard(0.02, 0.05, y_unit=unit)
    controller = replace(QUIET, gains=gains, counts_per_rev=None)
    t = 0.001 * np.arange(len(r))
    return ClosedLoopRun(t, r, u, y, y, controller, "made", "levels")


# --- limit cycles ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 1, 2, 3, 4])
def test_the_papers_gains_cycle_on_every_machine_and_quiet_ones_on_none(seed: int | None) -> None:
    machine = VirtualMachine(seed, u_limit=10.0)
    paper = oscillation(run(paper_controller(), machine, "trapezoid"))
    assert paper is not None
    assert paper.lasts
    assert paper.swing > 2 * Limits().swing
    quiet = oscillation(run(QUIET, VirtualMachine(seed), LEVELS))
    assert quiet is not None
    assert quiet.swing < 0.3 * Limits().swing
    assert quiet.ripple < 0.5 * Limits().ripple


def test_gains_beyond_the_limit_of_stability_cycle_with_their_own_frequency() -> None:
    hot = replace(QUIET, gains=Gains.standard(0.2, 0.05, 0.003))
    seen = oscillation(run(hot, drive(), LEVELS))
    assert seen is not None
    assert seen.lasts
    assert seen.hertz == pytest.approx(36.0, rel=0.05)
    line = judge(run(hot, drive(), LEVELS)).line("limit cycle")
    assert line.verdict == "warn"
    assert f"{seen.hertz:.3g} Hz" in line.meaning


def test_a_swing_that_dies_away_is_no_limit_cycle() -> None:
    t = 0.001 * np.arange(2000)
    r = np.full(2000, 1000.0)
    swing = np.sin(2 * np.pi * 20 * t)
    for decay, lasts in ((0.15, False), (1e9, True)):
        wave = swing * np.exp(-t / decay)
        seen = oscillation(loop(r + 100 * wave, 2 + 8 * wave, r))
        assert seen is not None
        assert seen.lasts == lasts


def test_noise_about_zero_makes_no_limit_cycle_of_a_decay() -> None:
    t = 0.02 * np.arange(520)
    r = np.full(len(t), -450.0)
    noise = np.random.default_rng(0).normal(size=len(t))
    for decay, lasts in ((2.5, False), (1e9, True)):
        wave = np.cos(2 * np.pi * (0.3 if decay < 10 else 1.0) * t) * np.exp(-t / decay)
        seen = oscillation(loop(r + 300 * wave, 12 * wave + 0.5 * noise, r))
        assert seen is not None
        assert seen.lasts == lasts


def test_what_repeats_with_the_shafts_turn_is_forced() -> None:
    """60 RPM is a turn a second, a load of four a turn 4 Hz."""
    t = 0.001 * np.arange(10_000)
    r = np.full(len(t), 60.0)
    forced = np.cos(2 * np.pi * 4 * t)
    speed = loop(r + forced, 1 + 8 * forced, r)
    other = loop(r + forced, 1 + 8 * forced, r, unit="m/s")
    seen, unknown = oscillation(speed), oscillation(other)
    assert seen is not None
    assert unknown is not None
    assert seen.swing < 0.05 < 0.2 < unknown.swing


def test_without_constant_reference_nothing_is_said() -> None:
    told = run(QUIET, drive(), signals.reference("chirp_lo_hi")[:3000])
    assert oscillation(told) is None
    assert judge(told).line("limit cycle").verdict == "info"


def test_lost_samples_part_a_stretch() -> None:
    t = 0.001 * np.arange(2000)
    r = np.full(2000, 1000.0)
    wave = np.sin(2 * np.pi * 20 * t)
    u = 2 + 8 * wave
    u[::50] = np.nan
    assert oscillation(loop(r, u, r)) is None
    u = 2 + 8 * wave
    u[300] = np.nan
    seen = oscillation(loop(r, u, r))
    assert seen is not None
    assert seen.command == pytest.approx(8 / math.sqrt(2), rel=0.01)


# --- the judgement --------------------------------------------------------------------------------


def test_saturation_is_told_with_its_share_and_run() -> None:
    small = replace(QUIET, u_min=-3.5, u_max=3.5)
    found = judge([run(QUIET, drive(), LEVELS, name="wide"), run(small, drive(), LEVELS)])
    line = found.line("saturation")
    assert line.verdict == "warn"
    assert line.value == found.runs[1].saturated > Limits().saturated
    assert "worst: reference on oe" in line.meaning
    assert judge(found.runs[1].run, limits=Limits(saturated=1.0)).line("saturation").verdict == "ok"


def trained(scale: float) -> Dataset:
    """A closed-loop recording of the drive, up to 2,000 RPM times the scale."""
    told = run(QUIET, drive(), scale * signals.reference("random"))
    return Dataset.from_arrays(told.u, told.y, 0.001, input_units="V", output_unit="RPM")


def test_a_loop_beyond_the_training_data_is_warned_of() -> None:
    narrow = identify(trained(0.1), model="oe")
    wide = identify(trained(1.0), model="oe")
    inside = judge(QUIET, wide, "random", seed=3).line("training region")
    assert inside.verdict == "ok"
    outside = judge(QUIET, narrow, "random", seed=1).line("training region")
    assert outside.verdict == "warn"
    assert outside.value > 0.5
    measured = run(QUIET, VirtualMachine(), "random", seed=3)
    assert judge(measured, narrow).line("training region").verdict == "warn"
    assert judge(measured, wide).line("training region").value < 0.05
    assert judge(measured).line("training region").verdict == "info"


def test_members_that_disagree_are_refused_with_bound_and_figure() -> None:
    alike = Ensemble.of([drive(), drive(gain=500.0), drive(T1=0.26)])
    found = judge(QUIET, alike, "trapezoid")
    assert len(found.runs) == 3
    line = found.line("disagreement")
    assert line.verdict == "ok"
    apart = Ensemble.of([drive(), drive(), drive(gain=60.0)])
    with pytest.raises(FitError, match=r"<= 5 % .*span.*RPM rms, .* %.*3 of 3"):
        judge(QUIET, apart, "trapezoid")
    told = judge(QUIET, apart, "trapezoid", refuse=False)
    assert told.verdict == "fail"
    assert told.warnings
    worst = told.disagreements[0]
    direct = [run(QUIET, m, "trapezoid").y for m in apart.members]
    expected = np.sqrt(np.mean((direct[2] - np.median(direct, axis=0)) ** 2))
    assert worst.rms == pytest.approx(float(expected), rel=1e-12)
    assert worst.span == 3000.0
    assert judge(QUIET, apart, "trapezoid", limits=Limits(disagreement=1.0)).verdict != "fail"


def test_only_runs_of_one_controller_and_reference_are_compared() -> None:
    one, other = run(QUIET, drive(), "trapezoid"), run(QUIET, drive(), LEVELS)
    softer = run(replace(QUIET, alpha=0.6), drive(), LEVELS)
    assert disagreements([one, other, softer]) == ()
    assert len(disagreements([one, other, run(QUIET, drive(gain=400.0), LEVELS)])) == 1


def test_what_tune_found_is_judged_in_one_call() -> None:
    found = tune(drive(), "trapezoid", evaluations=30, threads=1)
    judged = judge(found, drive(), "trapezoid")
    assert [x.name for x in judged.lines] == [
        "training region", "saturation", "limit cycle", "disagreement",
    ]  # fmt: skip
    assert judged.line("disagreement").verdict == "info"
    json.dumps(judged.to_json(), allow_nan=False)
    assert judged.verdict in str(judged)
    assert "<table" in judged.to_html()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: judge(QUIET), "judge\\(controller, models\\)"),
        (lambda: judge(3), "got int"),  # type: ignore[arg-type]
        (lambda: judge([]), "got list"),
        (lambda: judge(QUIET, 3), "received int"),  # type: ignore[arg-type]
        (lambda: Limits(swing=-1.0), "swing"),
        (lambda: Limits(outside=math.nan), "outside"),
    ],
)
def test_refusals_say_what_to_give(call, words: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(SettingError, match=words):
        call()


def test_a_loop_that_runs_away_names_the_member() -> None:
    wild = replace(QUIET, gains=Gains.standard(5.0, 0.05, 0.0), u_min=-math.inf, u_max=math.inf,
                   counts_per_rev=None)  # fmt: skip
    with pytest.raises(FitError, match=r"runs away on oe, 1 of 2"):
        judge(wild, [drive(), drive()], LEVELS)


def test_what_commission_found_brings_its_own_models() -> None:
    found: Any = SimpleNamespace(controller=QUIET, models=Ensemble.of([drive(), drive()]))
    assert len(judge(found, references="trapezoid").runs) == 2
    assert len(judge(found, drive(), "trapezoid").runs) == 1


def test_a_run_on_the_command_line_tells_its_warnings(tmp_path: Path) -> None:
    paper_controller().save(tmp_path / "paper.json")
    QUIET.save(tmp_path / "quiet.json")
    common = ("--on", "virtual", "--reference", "trapezoid", "-o", "run.csv")
    assert "warning   limit cycle" in command(tmp_path, "run", "paper.json", *common).out
    assert "warning" not in command(tmp_path, "run", "quiet.json", *common).out
    told = command(tmp_path, "run", "paper.json", *common, "--json").json()
    assert "limit cycle" in [line["name"] for line in told["warnings"]]


def test_a_loop_around_an_unstable_plant_is_located_by_its_output() -> None:
    """Its command alone takes the model anywhere."""
    rng = np.random.default_rng(0)
    u, y, r = np.zeros(2000), np.zeros(2000), np.repeat(rng.uniform(-1.0, 1.0, 40), 50)
    for k in range(1, 2000):
        y[k] = 1.03 * y[k - 1] + 0.1 * u[k - 1] + 1e-3 * rng.normal()
        u[k] = 3.0 * (r[k] - y[k]) + 0.3 * rng.normal()
    model = identify(Dataset.from_arrays(u, y, 0.01), model="arx", na=1, nb=1)
    assert abs(model.poles[0]) > 1.02
    controller = Controller(Gains.standard(3.0, 1.0, u_unit="", y_unit=""), Ts=0.01)
    found = judge(run(controller, model, 0.8 * r), model).line("training region")
    assert found.verdict == "ok"
