"""ONNX of every kind of model, run by onnxruntime beside the free run of the package."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kinds
from sewfast import deploy, paper_controller
from sewfast.cli import main
from sewfast.errors import SettingError
from sewfast_deploy.onnx import initial_state

onnx = pytest.importorskip("onnx", reason="needs onnx")
runtime = pytest.importorskip("onnxruntime", reason="needs onnxruntime")
SAMPLES = 10_000


def session(path: Path) -> Any:
    """On one thread."""
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


@pytest.mark.nightly(
    "the same for every kind",
    by_day=[
        "oe, three inputs",
        "neural_oe, nk 2, no bypass",
        "neural_ss, saturation",
        "neural_ss, integrator",
        "ensemble of mixed kinds",
        "ensemble, no delay",
    ],
)
@pytest.mark.parametrize("name", kinds.DEPLOYED)
def test_the_free_run_is_that_of_the_package(name: str, tmp_path: Path) -> None:
    model = kinds.model_of(name)
    deploy(model, tmp_path, to="onnx", name="drive")
    u = kinds.levels(SAMPLES, 5, len(model.input_names))
    expected = model.core.simulate(u, model.core.rest_state())
    state = initial_state(model, held=u[0])
    found, last = session(tmp_path / "drive_simulate.onnx").run(
        None, {"u": u[:, None, :], "state": state}
    )
    span = np.ptp(expected)
    assert np.abs(found[:, 0] - expected).max() <= 1e-12 * span
    # and sample by sample
    step = session(tmp_path / "drive_step.onnx")
    for k in range(50):
        y, state = step.run(None, {"u": u[k : k + 1], "state": state})
        assert abs(y[0, 0] - expected[k]) <= 1e-12 * span
    assert last.shape == state.shape


def test_a_batch_is_its_runs(tmp_path: Path) -> None:
    model = kinds.model_of("ensemble of mixed kinds")
    deploy(model, tmp_path, to="onnx")
    simulate = session(tmp_path / "model_simulate.onnx")
    batch = np.stack([kinds.levels(300, seed, 1) for seed in range(7)], axis=1)
    state = np.repeat(initial_state(model), 7, axis=0)
    together, _ = simulate.run(None, {"u": batch, "state": state})
    for i in range(7):
        alone, _ = simulate.run(None, {"u": batch[:, i : i + 1], "state": state[:1]})
        assert np.abs(together[:, i] - alone[:, 0]).max() <= 1e-12 * np.ptp(alone)


def test_a_state_of_ones_own_is_taken(tmp_path: Path) -> None:
    model = kinds.model_of("neural_oe, two inputs")
    deploy(model, tmp_path, to="onnx")
    u = kinds.levels(200, 8, 2)
    past = np.array([3.0, 2.0])
    expected = model.core.simulate(u, past)
    state = initial_state(model, past, held=u[0])
    found, _ = session(tmp_path / "model_simulate.onnx").run(
        None, {"u": u[:, None, :], "state": state}
    )
    assert np.abs(found[:, 0] - expected).max() <= 1e-12 * np.ptp(expected)


def test_the_file_says_what_it_is_and_loops_nowhere(tmp_path: Path) -> None:
    deploy(kinds.model_of("neural_ss"), tmp_path, to="onnx", name="drive")
    for file in tmp_path.glob("*.onnx"):
        made = onnx.load(file)
        properties = {p.key: p.value for p in made.metadata_props}
        assert properties["output"] == "speed [RPM]"
        assert properties["inputs"] == "u [V]"
        assert float(properties["sample_time_s"]) == kinds.TS
        assert {n.op_type for n in made.graph.node}.isdisjoint({"Loop", "If"})


def test_what_has_no_graph_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SettingError, match="controllers to c99"):
        deploy(paper_controller(), tmp_path, to="onnx")
    model = kinds.model_of("oe")
    with pytest.raises(SettingError, match="expected f64 for onnx"):
        deploy(model, tmp_path, to="onnx", precision="f32")
    model.save(tmp_path / "drive.json")
    out = tmp_path / "graphs"
    assert main(["deploy", str(tmp_path / "drive.json"), str(out), "--to", "onnx", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["files"]) == 2
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(SettingError, match=r'pip install "sewfast\[onnx\]"'):
        deploy(model, tmp_path, to="onnx")
