"""The experiment: whole result folders, honest training sets, the same numbers for the same seed.

Training and tuning are cut short: what is tested is how the pieces fit, not how well they do.
"""

import json
import math
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commissioned import short_experiment
from effort import FULL
from fitted import made
from sewfast import Commissioning, signals
from sewfast.control import Controller, Gains, load_controller
from sewfast.errors import DataError, SettingError
from sewfast.machine import VirtualMachine
from sewfast.models import load_model
from sewfast.readers import read, read_table
from sewfast.report import artefacts, report
from sewfast.validation import validate
from sewfast_demo import STAGES, loops, run_demo
from sewfast_demo import demo as experiment
from sewfast_demo.loops import drive_of

SCORES = ("rmse_rpm", "fit_percent")


@pytest.fixture(autouse=True, scope="module")
def _short() -> Any:
    with short_experiment():
        yield


def experiment_of_seed_3(folder: Path) -> None:
    """The results, and beside them the stages it named and what it commissioned."""
    stages: list[tuple[int, int, str]] = []
    found: list[Commissioning] = []
    commission = loops.commissioned

    def kept(*given: Any) -> Commissioning:
        found.append(commission(*given))
        return found[-1]

    with short_experiment(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(loops, "commissioned", kept)
        run_demo(folder / "results", seed=3, progress=lambda *told: stages.append(told))
    (folder / "seen").write_bytes(pickle.dumps((stages, found)))


@pytest.fixture(scope="module")
def demo() -> Path:
    return made(experiment_of_seed_3) / "results"


@pytest.fixture(scope="module")
def stages(demo: Path) -> list[tuple[int, int, str]]:
    return pickle.loads((demo.parent / "seen").read_bytes())[0]  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def commissioned(demo: Path) -> list[Commissioning]:
    return pickle.loads((demo.parent / "seen").read_bytes())[1]  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def results(demo: Path) -> dict[str, Any]:
    return dict(json.loads((demo / "results.json").read_text()))


@pytest.mark.slow("the first that asks for the experiment, which every test of it shares")
def test_the_results_hold_every_score(results: dict[str, Any]) -> None:
    assert (results["format"], results["version"]) == ("sewfast.results", 1)
    for model in ("paper", "neural_oe", "oe", "oe_all", "arx"):
        for record in ("chirp_lo_hi", "chirp_hi_lo", "random", "saturating"):
            for horizon in ("simulation", "one_step"):
                found = results["identification"][model][record][horizon]
                assert all(math.isfinite(found[name]) for name in SCORES)
    paper = results["identification"]["paper"]
    assert {"cost", "cost_floor", "iterations", "seconds"} <= set(paper)
    assert 5e-5 < paper["cost_floor"] < 2e-4
    assert results["seconds"] > 0.0


def test_the_results_hold_every_closed_loop(results: dict[str, Any]) -> None:
    for reference in ("trapezoid", "chirp_hi_lo", "chirp_lo_hi", "random"):
        found = results["control"][reference]
        assert math.isfinite(found["model_vs_machine_rmse_rpm"])
        for plant in ("model", "machine"):
            assert math.isfinite(found[plant]["rmse_rpm"])
            assert {"rise_time_ms", "overshoot_percent"} <= set(found[plant])
    assert results["control"]["trapezoid"]["reference_rise_time_ms"] == pytest.approx(120.0)


def test_nothing_is_trained_on_what_it_is_tested_on(results: dict[str, Any]) -> None:
    trained = {m: set(v["trained_on"]) for m, v in results["identification"].items()}
    assert trained["paper"] == trained["arx"] == trained["oe"] == {"chirp_lo_hi"}
    assert trained["neural_oe"] == trained["oe_all"]
    assert trained["neural_oe"] == {"chirp_lo_hi", "saturating", "closed_loop"}


@pytest.mark.parametrize("name", ["paper", "neural_oe", "oe", "oe_all", "arx"])
def test_a_saved_model_scores_what_the_results_say(
    demo: Path, results: dict[str, Any], name: str
) -> None:
    model = load_model(demo / "models" / f"{name}.json")
    path = demo / "recordings" / "saturating_2.csv"
    data = read(path, inputs="u", output="y", channels=["speed_true"])
    found = validate(model, data, init=0, against="speed_true")
    expected = results["identification"][name]["saturating"]
    assert found.simulation.rmse == pytest.approx(expected["simulation"]["rmse_rpm"], rel=1e-9)
    assert found.one_step.fit_percent == pytest.approx(expected["one_step"]["fit_percent"])


def test_the_saved_controller_gives_the_saved_run_again(demo: Path) -> None:
    controller = load_controller(demo / "controllers" / "tuned.json")
    with drive_of(VirtualMachine()) as bench:
        again = bench.run(controller, "random", seed=3)
    saved = read_table(demo / "runs" / "random_machine.npz")
    np.testing.assert_array_equal(again.u, saved["u"])
    np.testing.assert_array_equal(again.y, saved["y"])


@pytest.mark.nightly("the experiment's report once more")
def test_the_folder_makes_its_report_again(demo: Path, tmp_path: Path) -> None:
    first = (demo / "report.html").read_text(encoding="utf-8")
    again = report(shutil.copytree(demo, tmp_path / "again"))
    assert again.read_text(encoding="utf-8") == first


def test_no_temporary_file_is_left(demo: Path) -> None:
    assert not list(demo.rglob("*.tmp"))


def test_progress_names_every_stage_and_ends_full(
    demo: Path, stages: list[tuple[int, int, str]]
) -> None:
    n = len(STAGES)
    assert stages == [*((i, n, name) for i, name in enumerate(STAGES)), (n, n, "done")]


@pytest.mark.skipif(
    not FULL, reason="the experiment once more, of whose parts each repeats: SEWFAST_SOAK=1"
)
def test_the_same_seed_gives_the_same_numbers(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the page is made of what is compared
    monkeypatch.setattr(experiment, "report", lambda folder: folder)
    run_demo(tmp_path / "again", seed=3)
    for name in ("models/neural_oe.json", "controllers/tuned.json", "recordings/random.csv"):
        first, second = ((folder / name).read_text() for folder in (demo, tmp_path / "again"))
        assert _timeless(first) == _timeless(second)


def _timeless(text: str) -> list[str]:
    return [line for line in text.splitlines() if "seconds" not in line]


@pytest.mark.nightly("the experiment once more")
def test_an_interruption_leaves_an_earlier_experiment_as_it_was(
    demo: Path, commissioned: list[Commissioning], monkeypatch: pytest.MonkeyPatch
) -> None:
    # what comes before the writing has been tested above
    monkeypatch.setattr(loops, "commissioned", lambda *_: commissioned[0])
    before = {p: p.read_bytes() for p in demo.rglob("*") if p.is_file()}

    def interrupt(done: int, total: int, name: str) -> None:
        if name == "writing":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_demo(demo, seed=4, progress=interrupt)
    assert {p: p.read_bytes() for p in demo.rglob("*") if p.is_file()} == before


def test_an_interruption_before_writing_leaves_no_folder(tmp_path: Path) -> None:
    def interrupt(done: int, total: int, name: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path / "new", progress=interrupt)
    assert not (tmp_path / "new").exists()


def test_a_folder_that_was_interrupted_while_writing_is_no_result(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment, "write_table", fail)
    out = Path(shutil.copytree(demo, tmp_path / "cut"))
    models = {"paper": load_model(demo / "models" / "paper.json")}
    with pytest.raises(KeyboardInterrupt):
        experiment.write(
            out, {}, recordings={}, models=models, controllers={},
            predictions={"random": {"t": np.zeros(3)}}, runs={}, drawings={},
        )  # fmt: skip
    with pytest.raises(DataError, match=r"results\.json"):
        report(out)


@pytest.mark.parametrize("machine", ["real", "virtual:", "virtual:x"])
def test_an_unknown_machine_is_refused_before_anything_is_made(
    tmp_path: Path, machine: str
) -> None:
    with pytest.raises(SettingError, match="virtual"):
        run_demo(tmp_path / "out", machine=machine)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seed", [-1, 1.5, "x"])
def test_a_seed_that_is_none_is_refused_before_anything_is_made(tmp_path: Path, seed: Any) -> None:
    with pytest.raises(SettingError, match="seed"):
        run_demo(tmp_path / "out", seed=seed)
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(DataError, match="out"):
        run_demo(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_the_plant_of_eq_8_is_the_printed_one() -> None:
    gain = loops.eq8().core.dc_gain()[0]
    assert gain == pytest.approx((0.1228 + 0.1224) / (1 - 1.87 + 0.8705))


def test_the_drive_is_commissioned_beside_the_papers_way(
    demo: Path, results: dict[str, Any]
) -> None:
    told = results["commissioning"]
    assert told["verdict"] == "verified"
    saved = json.loads((demo / "commissioning" / "commissioning.json").read_text())
    assert saved["references"] == told["references"]
    for reference in ("trapezoid", "chirp_hi_lo", "chirp_lo_hi", "random"):
        apart = results["control"][reference]["model_vs_machine_rmse_rpm"]
        assert apart == pytest.approx(told["references"][reference]["apart_rmse_rpm"])
    assert "commissioning/report.html" in (demo / "report.html").read_text()


def test_the_papers_gains_track_on_their_plant_and_chatter_on_the_machine() -> None:
    with drive_of(VirtualMachine()) as bench:
        runs = loops.paper_runs(bench)
    numbers = loops.paper_numbers(runs)
    assert numbers["eq8"]["rise_time_ms"] == pytest.approx(186.0, abs=5.0)
    assert numbers["eq8"]["overshoot_percent"] < 5.0
    assert numbers["machine"]["chatter_v"] > 5.0
    assert max(np.abs(r.u).max() for r in runs.values()) <= 10.0


def test_only_per_sample_gains_on_rpm_track_on_the_papers_plant() -> None:
    found = loops.readings()
    tracking = found.pop("per_sample_rpm")["rmse_rpm"]
    assert tracking is not None
    others = [r["rmse_rpm"] for r in found.values()]
    assert all(error is None or error > 1.5 * tracking for error in others)


def test_the_closed_loop_recording_is_the_loop_itself() -> None:
    with drive_of(VirtualMachine()) as bench:
        step = bench.record(signals.excitation("step"), "step")
        controller = loops.coarse_controller(
            loops.first_order(step), Ts=bench.Ts, counts_per_rev=bench.counts_per_rev
        )
        recording = loops.closed_loop(bench, controller)
        loop = bench.run(controller, "trapezoids")
    np.testing.assert_array_equal(recording.speed_true, loop.y)


def test_the_experiment_went_over_the_link(results: dict[str, Any]) -> None:
    link = results["link"]
    # six open-loop records, the closed loop twice, four references, the paper's gains
    paper = 3000 + 4 * 20_000 + 15_000 + 2 * 9350 + 2 * 1500 + 2 * 20_000 + 10_000
    commissioned = sum(results["commissioning"]["recordings"].values()) / 0.001
    assert link["samples"] == paper + round(commissioned)
    assert link["missing"] == 0
    assert link["port"] in ("pty", "tcp")


@pytest.mark.parametrize("seed", [0, 1])
def test_the_link_changes_no_measured_figure(seed: int) -> None:
    """What the machine does behind the port is what it does in the same process."""
    controller = load_coarse()
    with drive_of(VirtualMachine()) as bench:
        behind = bench.run(controller, "random", seed=seed)
    direct = loops.run(controller, VirtualMachine(), "random", seed=seed)
    assert np.sqrt(np.mean((behind.y - direct.y) ** 2)) < 2.0


def load_coarse() -> Controller:
    gains = Gains.standard(0.0175, 0.064, 0.0064)
    return Controller(
        gains, alpha=0.65, beta=0.4, N=10.0, u_min=-20.0, u_max=20.0, filter_samples=8,
        counts_per_rev=1572.0,
    )  # fmt: skip


def test_the_record_scored_as_saturating_is_the_second_one() -> None:
    assert artefacts.record_of("saturating") == "saturating_2"
    assert "saturating_2" not in loops.ALL_RECORDS
