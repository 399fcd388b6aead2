"""What a command reads is never what it writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sewfast
from sewfast.cli import main
from sewfast.link import VirtualDevice


@pytest.fixture
def ramp(tmp_path: Path) -> Path:
    t = 0.001 * np.arange(200)
    path = tmp_path / "ramp.csv"
    sewfast.write_table(path, {"t": t, "u": np.minimum(t, 1.0)}, units={"t": "s", "u": "V"})
    return path


def refused(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    assert main(args) == 2
    return capsys.readouterr().err


def test_a_signal_is_not_written_over(ramp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = ramp.read_bytes()
    record = ("record", "--on", "virtual", "--signal", str(ramp))
    assert "a separate file" in refused(capsys, *record, "-o", str(ramp))
    link = ramp.with_name("other.csv")
    link.symlink_to(ramp)
    assert "a separate file" in refused(capsys, *record, "-o", str(link))
    (ramp.parent / "x").mkdir()
    elsewhere = ramp.parent / "x" / ".." / "ramp.csv"
    assert "a separate file" in refused(capsys, *record, "-o", str(elsewhere))
    assert ramp.read_bytes() == before


def test_nor_beside_a_recording_that_may_be_replaced(
    ramp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = ramp.read_bytes()
    recording = ramp.with_suffix(".mcap")
    with VirtualDevice(fast=True, endpoint="tcp") as device:
        record = ("record", "--on", device.port, "--signal")
        assert main([*record, str(ramp), "-o", str(recording)]) == 0
        assert recording.exists()
        capsys.readouterr()
        assert "a separate file" in refused(capsys, *record, str(ramp), "-o", str(ramp))
        assert ramp.read_bytes() == before
        kept = recording.read_bytes()
        assert "a separate file" in refused(capsys, *record, str(recording), "-o", str(ramp))
        assert recording.read_bytes() == kept


def test_two_outputs_are_two_files(ramp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(ramp.with_name("out.csv"))
    command = ("run", "none.json", "--on", "socket://127.0.0.1:1", "--reference", str(ramp))
    said = refused(capsys, *command, "--host-loop", "-o", out, "--samples", out)
    assert "a separate file" in said


def test_a_model_is_not_written_over_by_its_controller(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "m.json"
    model.write_text("{}")
    assert "a separate file" in refused(capsys, "tune", str(model), "-o", str(model))
    data = tmp_path / "d.json"
    data.write_text("{}")
    assert "a separate file" in refused(capsys, "identify", f"{data}:u:y", "-o", str(data))
    assert (model.read_text(), data.read_text()) == ("{}", "{}")


@pytest.mark.parametrize("option", ["--trace", "--fault-log"])
def test_a_recording_is_no_place_for_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    kept = tmp_path / "run.mcap"
    kept.write_bytes(b"what a drive did")
    assert "which is kept" in refused(capsys, "device", option, str(kept), "--for", "0.1")
    assert kept.read_bytes() == b"what a drive did"


def test_an_export_is_not_written_over_the_recording(
    ramp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = ramp.read_bytes()
    said = refused(
        capsys, "physics", str(ramp), "--structure", "joint", "--export", "mujoco", str(ramp)
    )
    assert "a separate file" in said
    assert ramp.read_bytes() == before
