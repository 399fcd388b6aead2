"""Analysis of a controller: steps, loop transfers, sensitivities, what-if; its text and files."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import result_folder
from cli import called as command
from loops import QUIET, drive
from sewfast import Cost, Ensemble, VirtualMachine, _core, identify, run, tune
from sewfast.analysis import Analysis, analyse, changes, run_under_load
from sewfast.control import Controller, Gains
from sewfast.control.systems import LinearLoop, response, simulate
from sewfast.dataset import Dataset
from sewfast.errors import DataError, ModelFileError, SettingError
from sewfast.models import LinearOE
from sewfast.report import report
from sewfast.report.commissioned import section

IDEAL = replace(QUIET, counts_per_rev=None)
TRAPEZOID = np.concatenate([np.zeros(50), np.linspace(0, 800, 100), np.full(150, 800.0)])


@cache
def several() -> Analysis:
    return analyse(
        IDEAL, Ensemble.of([drive(), drive(gain=540.0), drive(T1=0.3)]), speeds=[300.0, 1000.0],
        references=[TRAPEZOID], threads=2,
    )  # fmt: skip


# --- steps ----------------------------------------------------------------------------------------


def test_steps_are_those_of_the_linear_loop_where_nothing_is_limited() -> None:
    found = several()
    tracked, upset = found.responses
    assert (tracked.kind, upset.kind) == ("reference", "disturbance")
    assert tracked.y.shape == (3, len(tracked.t))
    for plant in range(3):
        linear = found.linear(plant=plant)
        n = int((tracked.t >= 0).sum())
        ones = np.ones((n, 1))
        # the step of the reference is seen in the sample in which it comes
        expected = tracked.level + tracked.size * simulate(linear.tracking, ones)[:, 0]
        assert np.allclose(tracked.y[plant][tracked.t >= 0], expected, atol=0.05)
        expected = upset.level + upset.disturbance * simulate(linear.disturbance, ones)[:, 0]
        assert np.allclose(upset.y[plant][upset.t >= 0], expected, atol=0.05)
    low, high = tracked.band
    assert np.all(low <= np.median(tracked.y, axis=0))
    assert np.all(high >= np.median(tracked.y, axis=0))


def test_metrics_of_steps_are_read_off_their_curves() -> None:
    tracked, upset = several().responses
    t = tracked.t[tracked.t >= 0]
    for y, told in zip(tracked.y[:, tracked.t >= 0], tracked.metrics(), strict=True):
        share = (y - tracked.level) / tracked.size
        assert told["overshoot_percent"] == pytest.approx(100 * (share.max() - 1), abs=1e-9)
        assert told["rise_ms"] is not None
        assert told["settling_ms"] is not None
        assert np.all(np.abs(share[1e3 * t >= told["settling_ms"] - 1e-6] - 1) <= 0.0201)
        assert 0 < told["rise_ms"] < told["settling_ms"]
    for y, told in zip(upset.y, upset.metrics(), strict=True):
        off = y[upset.t >= 0] - upset.level
        assert told["peak"] == off[np.argmax(np.abs(off))]
        assert told["peak"] < 0 < upset.size
        assert told["recovery_ms"] is not None
        assert told["recovery_ms"] > told["peak_ms"]
    # without control it would be as large as the reference's step
    gain = several().loops[1].points[0].gain
    assert abs(upset.disturbance) * gain == pytest.approx(upset.size, rel=0.11)


@pytest.mark.parametrize("pole", [1.0, 0.99999])
def test_a_disturbance_is_seen_on_a_plant_that_does_not_settle(pole: float) -> None:
    """A position, and one whose model has a pole beside 1: its gain is that of hours."""
    core = _core.LinearModel(np.poly([pole, 0.95])[1:], np.array([[2e-4, 2e-4]]), 1, 0.0)
    known = {"input_range": [[-10.0, 10.0]], "output_range": [-20.0, 20.0]}
    angle = LinearOE(core, 0.01, ("u",), "y", ("V",), "rad", None, known)
    held = Controller(Gains.standard(2.0, 8.0, 0.5, u_unit="V", y_unit="rad"), Ts=0.01,
                      u_min=-10, u_max=10)  # fmt: skip
    tracked, upset = analyse(held, angle, references=[np.zeros(100)], threads=1).responses
    n = int((upset.t >= 0).sum())
    free = angle.simulate(np.full(n, upset.disturbance))
    assert abs(free[-1]) == pytest.approx(abs(tracked.size), rel=0.1)


def test_what_never_settles_has_no_time() -> None:
    short = analyse(IDEAL, drive(), speeds=[1000.0], seconds=0.2, references=[TRAPEZOID])
    slow = replace(IDEAL, gains=Gains.standard(0.0005, 5.0))
    assert short.responses[0].metrics()[0]["settling_ms"] is not None
    sluggish = analyse(slow, drive(), speeds=[1000.0], seconds=0.2, references=[TRAPEZOID])
    told = sluggish.responses[0].metrics()[0]
    assert told["rise_ms"] is None
    assert told["settling_ms"] is None
    assert "-" in str(sluggish)


# --- frequency ------------------------------------------------------------------------------------


def test_margins_and_curves_agree() -> None:
    for loop in several().loops:
        assert loop.L.shape == (3, len(loop.hertz))
        assert np.allclose(loop.S + loop.T, 1.0)
        for i, point in enumerate(loop.points):
            linear = LinearLoop.of(IDEAL, point.system)
            expected = response(linear.L, loop.hertz, 0.001)
            assert np.allclose(loop.L[i], expected, rtol=1e-6, atol=1e-12)
            assert loop.margins[i].stable
            assert np.abs(loop.S[i]).max() == pytest.approx(loop.margins[i].Ms, rel=0.01)
    assert several().Ms == max(m.Ms for loop in several().loops for m in loop.margins)


def test_a_networks_loop_is_taken_about_its_operating_points() -> None:
    u = np.repeat(np.random.default_rng(0).uniform(-3.0, 3.0, 80), 15)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.95 * y[k - 1] + 6.0 * np.tanh(u[k - 1] / 2.0)
    data = Dataset.from_arrays(u, y, 0.01, input_units="V", output_unit="RPM")
    model = identify(data, model="neural_ss", nx=1, hidden=4, starts=1, seed=0)
    controller = Controller(
        Gains.standard(0.02, 0.3), Ts=0.01, u_min=-4.0, u_max=4.0
    )  # fmt: skip
    found = analyse(controller, model, speeds=[5.0, 80.0], references=[np.full(200, 50.0)])
    low, high = (loop.points[0] for loop in found.loops)
    # the slope of tanh falls with the speed
    assert high.gain < 0.8 * low.gain
    assert found.loops[0].Ms >= 1.0
    names = [w.name for w in found.what_if]
    assert "time constants x 1.25" in names


# --- sensitivities --------------------------------------------------------------------------------


def test_scores_are_those_of_the_moved_settings() -> None:
    found = several()
    assert [s.name for s in found.sensitivity] == ["Kp", "Ti", "Td", "alpha", "N"]
    kp = found.sensitivity[0]
    moved = replace(IDEAL, gains=Gains.standard(1.25 * 0.02, 0.05, 0.003))
    members = [drive(), drive(gain=540.0), drive(T1=0.3)]
    costs = [Cost().of(run(moved, m, TRAPEZOID)) for m in members]
    assert kp.scores[kp.factors.index(1.25)].cost == pytest.approx(float(np.mean(costs)), rel=1e-12)
    costs = [Cost().of(run(IDEAL, m, TRAPEZOID)) for m in members]
    assert found.score.cost == pytest.approx(float(np.mean(costs)), rel=1e-12)
    worst = max(run(IDEAL, m, TRAPEZOID).metrics()["rmse"] or 0.0 for m in members)
    assert found.score.tracking == pytest.approx(worst, rel=1e-9)
    # alpha is not in the loop
    alpha = found.sensitivity[3]
    assert {s.Ms for s in alpha.scores} == {found.score.Ms}


def test_gains_that_run_away_are_told() -> None:
    wild = replace(IDEAL, gains=Gains.standard(0.2, 0.05, 0.003), u_min=-math.inf, u_max=math.inf)
    found = analyse(wild, drive(), speeds=[500.0], references=[np.tile(TRAPEZOID, 40)])
    last = found.sensitivity[0].scores[-1]
    assert math.isinf(last.cost)
    assert math.isinf(last.Ms)
    assert "runs away" in str(found)
    json.dumps(found.to_json(), allow_nan=False)


@pytest.mark.parametrize("threads", [1, 3])
def test_any_number_of_threads_gives_the_same(threads: int) -> None:
    one = analyse(IDEAL, drive(), speeds=[700.0], references=[TRAPEZOID], threads=threads)
    other = analyse(IDEAL, drive(), speeds=[700.0], references=[TRAPEZOID], threads=2)
    assert one.to_json() == other.to_json()


# --- changed plants -------------------------------------------------------------------------------


def step_of(model: LinearOE) -> np.ndarray:
    u = (np.arange(4000) >= 20).astype(np.float64)
    return np.asarray(model.core.simulate(u[:, None], model.core.rest_state()))


def test_changes_of_linear_models_are_what_they_say() -> None:
    before = step_of(drive())
    assert np.allclose(step_of(changes.with_gain(drive(), 1.25)), 1.25 * before, rtol=1e-12)
    late = step_of(changes.with_delay(drive(), 3))
    assert np.allclose(late[3:], before[:-3], rtol=1e-12, atol=1e-12)
    slower = changes.with_time_constants(drive(), 1.25)
    assert np.allclose(
        np.sort(np.abs(np.roots([1.0, *slower.core.a]))),
        np.exp([-0.001 / (1.25 * 0.0074), -0.001 / (1.25 * 0.252)]),
    )
    assert step_of(slower)[-1] == pytest.approx(before[-1], rel=2e-5)


def test_an_integrator_slows_down_and_stays_one() -> None:
    model = LinearOE.from_tf([0.0, 0.02], [1.0, -1.0], 0.001, input_units=["V"], output_unit="RPM")
    slower = changes.with_time_constants(model, 2.0)
    assert np.allclose(slower.core.a, [-1.0])
    assert np.allclose(slower.core.b, 0.01)


def test_changes_that_do_not_fit_a_plant_are_refused_or_left_out() -> None:
    with pytest.raises(SettingError, match="got a machine"):
        changes.gain(1.1).apply(VirtualMachine())
    with pytest.raises(SettingError, match="got a model"):
        changes.inertia(1.1).apply(drive())
    found = analyse(
        IDEAL, drive(), speeds=[500.0], references=[TRAPEZOID],
        changes=[changes.inertia(2.0), changes.gain(1.1)],
    )  # fmt: skip
    assert [w.name for w in found.what_if] == ["gain x 1.1"]


# --- the machine ----------------------------------------------------------------------------------


def test_under_no_load_the_machine_runs_as_ever() -> None:
    r = np.concatenate([np.linspace(0, 900, 200), np.full(200, 900.0)])
    machine = VirtualMachine(2)
    loaded = run_under_load(QUIET, machine, r, np.zeros(400))
    free = run(QUIET, machine, r)
    for name in ("u", "y", "feedback"):
        assert np.array_equal(getattr(loaded, name), getattr(free, name))


def test_a_load_is_felt_and_answered() -> None:
    r = np.concatenate([np.linspace(0, 1000, 200), np.full(1200, 1000.0)])
    load = np.where(np.arange(1400) < 700, 0.0, 0.1)
    smooth = VirtualMachine(angle_dependence=False)
    told = run_under_load(QUIET, smooth, r, load)
    assert told.y[700:1000].min() < 993.0
    assert abs(told.y[-100:].mean() - 1000.0) < 1.0
    # u' = u + T R/(K amplifier gain)
    p = smooth.parameters
    volt = 0.1 * p["resistance"] / p["motor_constant"] / p["amplifier_gain"]
    assert told.u[-200:].mean() - told.u[500:700].mean() == pytest.approx(volt, rel=0.05)
    with pytest.raises(DataError, match="a finite load"):
        run_under_load(QUIET, smooth, r, load[:-1])


def test_the_machine_itself_is_analysed() -> None:
    found = analyse(QUIET, VirtualMachine(), references=[TRAPEZOID])
    assert [round(loop.level) for loop in found.loops] == [300, 1000, 2000]
    assert "inertia x 1.25" in [w.name for w in found.what_if]
    assert found.responses[1].metrics()[0]["peak"] is not None


# --- files, text, command -------------------------------------------------------------------------


def test_files_and_figures_are_whole(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    names = ["responses", "bode", "sensitivity", "what_if"]
    drawn = several().figures()
    assert list(drawn) == names
    for figure in drawn.values():
        for ax in figure.axes:
            assert ax.get_xlabel() or ax.get_shared_x_axes().get_siblings(ax)
    assert drawn["responses"].axes[0].get_ylabel() == "output [RPM]"
    assert "[Hz]" in drawn["bode"].axes[3].get_xlabel()
    written = several().save(tmp_path / "new")
    drawn = [path.read_bytes() for path in written if path.suffix == ".png"]
    assert drawn
    assert all(content.startswith(b"\x89PNG") for content in drawn)
    assert all(p.stat().st_size > 1000 for p in written)
    told = json.loads((tmp_path / "new" / "analysis.json").read_text())
    assert told["format"] == "sewfast.analysis"
    assert told["figures"] == names
    assert told["Ms"] == several().Ms
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingError, match="choose another"):
        several().save(tmp_path / "file")


def test_units_that_nobody_knows_leave_no_brackets() -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    found = several()
    bare = tuple(replace(r, y_unit="", u_unit="") for r in found.responses)
    drawn = replace(found, responses=bare).plot()
    words = [text for ax in drawn.ravel() for text in (ax.get_ylabel(), ax.get_title(loc="left"))]
    assert "output" in words
    assert not any("[]" in text or text != text.strip() or "  " in text for text in words)


def test_a_notebook_shows_margins_and_judgement() -> None:
    shown = several()._repr_html_()
    assert shown.count("<table") == 2
    assert "phase margin" in shown
    assert "limit cycle" in shown


def test_the_text_holds_every_part() -> None:
    text = str(several())
    for part in (
        "margins",
        "reference step",
        "disturbance",
        "Kp -25 %",
        "gain x 1.25",
        "limit cycle",
    ):
        assert part in text


def test_refusals_say_what_to_give() -> None:
    with pytest.raises(SettingError, match=r"analyse\(controller, plants\)"):
        analyse(drive(), QUIET)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="at least one plant"):
        analyse(IDEAL, [])
    core = _core.LinearModel(np.array([-0.9]), np.array([[0.1], [0.2]]), 1, 0.0)
    two = LinearOE(core, 0.001, ("u", "load"), "y", ("V", "N m"), "RPM")
    with pytest.raises(SettingError, match=r"one input.*with 2"):
        analyse(IDEAL, two)
    with pytest.raises(SettingError, match="sample time"):
        analyse(replace(IDEAL, Ts=0.002), drive())


@pytest.mark.nightly("another report")
def test_the_page_shows_the_analysis_in_its_folder(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    folder = result_folder.make(tmp_path / "demo")
    several().save(folder, png=False)
    assert not list(folder.glob("analysis/*.png"))
    page = report(folder).read_text(encoding="utf-8")
    assert 'id="analysis"' in page
    assert page.count('<figure id="analysis-') == 4
    assert "gain x 1.25" in page
    assert "limit cycle" in page


def test_a_damaged_analysis_is_refused_by_name(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    assert section(tmp_path) is None
    several().save(tmp_path, png=False)
    assert section(tmp_path) is not None
    drawing = tmp_path / "analysis" / "bode.svg"
    drawing.write_text("<svg><script>alert(1)</script></svg>")
    with pytest.raises(DataError, match=r"bode\.svg"):
        section(tmp_path)
    drawing.unlink()
    with pytest.raises(DataError, match=r"bode\.svg"):
        section(tmp_path)
    (tmp_path / "analysis.json").write_text('{"format": "sewfast.analysis", "version": 1}')
    with pytest.raises(ModelFileError, match=r"analysis\.json"):
        section(tmp_path)


def test_the_command_prints_and_writes(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the report extra")
    IDEAL.save(tmp_path / "controller.json")
    drive().save(tmp_path / "drive.json")
    call = [
        "analyse",
        "controller.json",
        "drive.json",
        "--speed",
        "500",
        "--reference",
        "trapezoid",
    ]
    told = command(tmp_path, *call).out
    assert "margins" in told
    assert "Kp +25 %" in told
    values = command(tmp_path, *call, "--json", "--out", "out").json()
    assert values["loops"][0]["plants"][0]["margins"]["stable"] is True
    assert all((tmp_path / name).is_file() for name in values["files"])
    assert "none.json" in command(tmp_path, "analyse", "controller.json", "none.json", done=2).err


# --- The recorded range, and the limits of tune ---------------------------------------------------


def recorded(low: float, high: float) -> LinearOE:
    core = drive().core
    record = {"input_range": [[-20.0, 20.0]], "output_range": [low, high]}
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), record)


@pytest.mark.parametrize(
    ("low", "high", "level", "step"),
    [(-309.0, 300.0, -150.0, 15.45), (0.0, 3000.0, 1500.0, 150.0), (1000.0, 3000.0, 2000.0, 150.0)],
)
def test_steps_suit_the_recorded_range(low: float, high: float, level: float, step: float) -> None:
    found = analyse(QUIET, recorded(low, high), references=["trapezoid"], threads=1)
    tracked = found.responses[0]
    assert (tracked.level, tracked.size) == (level, pytest.approx(step))


def test_a_loop_is_judged_on_what_it_was_tuned_for() -> None:
    """Not on a jump from rest to the level of the steps; nor where noise alone has been."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, 60), 60)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = y[k - 1] + 0.02 / 0.8 * (2.0 * u[k - 1] - y[k - 1])
    record = Dataset.from_arrays(u, y + 1.0 * rng.normal(size=len(u)), 0.02)
    model = identify(record, model="oe")
    found = analyse(tune(model, evaluations=300, threads=1).pid, model, threads=1)
    assert abs(found.responses[0].level) < 1.1
    assert found.judgement is not None
    assert found.judgement.line("saturation").verdict == "ok"
    assert found.judgement.line("training region").verdict == "ok"


@pytest.mark.parametrize(("share", "verdict"), [(1.0, "ok"), (6.0, "warn"), (30.0, "fail")])
def test_margins_are_judged_by_the_limits_of_tune(share: float, verdict: str) -> None:
    gains = replace(QUIET.gains, Kp=share * QUIET.gains.Kp)
    found = analyse(replace(QUIET, gains=gains), recorded(0.0, 3000.0), references=["trapezoid"])
    assert found.judgement is not None
    line = found.judgement.line("margins")
    assert line.verdict == verdict
    assert (found.Ms > 2.0) is (verdict != "ok")
    if verdict == "warn":
        assert "close to instability" in line.meaning
