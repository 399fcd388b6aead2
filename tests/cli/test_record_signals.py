"""`sewfast record`: signals from files, and made gentle; a drive that has tripped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cli import call_refused as refused
from cli import called as sewfast
from sewfast import signals
from sewfast.link import VirtualDevice, connect
from sewfast.readers import read_table
from sewfast.recordfile import read_recording
from sewfast.storage import write_table


def test_a_signal_is_scaled(tmp_path: Path) -> None:
    sewfast(tmp_path, "record", "--on", "virtual", "--signal", "step", "--scale", 0.2,
            "-o", "gentle.mcap")  # fmt: skip
    made = read_recording(tmp_path / "gentle.mcap")
    np.testing.assert_array_equal(made.columns["u"], 0.2 * signals.excitation("step"))
    assert made.header.settings["scale"] == 0.2


def test_a_signal_comes_from_a_file(tmp_path: Path) -> None:
    t = 0.001 * np.arange(600)
    write_table(tmp_path / "ramp.csv", {"t": t, "u": 2.0 * t}, units={"t": "s", "u": "V"})
    with VirtualDevice(fast=True) as device:
        sewfast(tmp_path, "record", "--on", device.port, "--signal", "ramp.csv", "-o", "out.mcap")
    made = read_recording(tmp_path / "out.mcap")
    np.testing.assert_allclose(made.columns["u"], 2.0 * t, atol=0.0005)
    assert (made.header.name, made.header.settings["signal"]) == ("ramp", "ramp.csv")


@pytest.mark.parametrize("scale", ["nan", "inf"])
def test_a_factor_must_be_a_number(tmp_path: Path, scale: str) -> None:
    said = refused(tmp_path, "record", "--on", "virtual", "--signal", "step", "--scale", scale)
    assert "--scale" in said


def test_a_signal_at_another_sample_time_is_refused(tmp_path: Path) -> None:
    columns = {"t": 0.002 * np.arange(300), "u": np.ones(300)}
    write_table(tmp_path / "slow.csv", columns, units={"t": "s", "u": "V"})
    with VirtualDevice(fast=True) as device:
        for place in ("virtual", device.port):
            said = refused(tmp_path, "record", "--on", place, "--signal", "slow.csv",
                           "-o", "out.mcap")  # fmt: skip
            assert "every 0.001 s" in said
            assert "0.002" in said


def test_a_tripped_drive_says_why(tmp_path: Path) -> None:
    record = ("record", "--signal", "step", "--on")
    limits = "volt=8,speed=300,acceleration=inf,current=15"
    with VirtualDevice(fast=True) as device:
        port = device.port
        sewfast(tmp_path, *record, port, "--limits", limits, "-o", "a.mcap", done=2)
        said = refused(tmp_path, *record, port, "-o", "b.mcap")
        assert "tripped: speed" in said
        assert f"sewfast clear {port}" in said
        with connect(port) as drive:
            assert drive.status().state == "tripped"
        sewfast(tmp_path, "clear", port)
        sewfast(tmp_path, *record, port, "--limits", "volt=8,speed=inf,acceleration=inf,current=15",
                "-o", "b.csv")  # fmt: skip
    assert len(read_table(tmp_path / "b.csv").columns["u"]) == 3000
