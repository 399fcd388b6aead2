"""The page of an experiment shows a motor that lies in its folder."""

from pathlib import Path

import numpy as np
import pytest

import result_folder
import sewfast
from sewfast.errors import ModelFileError
from sewfast.report import report


def test_a_page_shows_the_motor_in_its_folder(tmp_path: Path) -> None:
    folder = result_folder.make(tmp_path / "demo")
    u = np.repeat(np.random.default_rng(1).uniform(-8, 8, 20), 286)
    recording = sewfast.record(sewfast.VirtualMachine(3), u, name="steps")
    motor = sewfast.physics(recording, structure=["lag", "coulomb"])
    motor.save(folder / "motor.json")
    page = report(folder).read_text(encoding="utf-8")
    assert "Physical parameters" in page
    assert f"{motor.value('k_a'):.5g}" in page
    assert "pass current" in page  # what the record does not determine is there with its reason
    (folder / "motor.json").write_text("{}")
    with pytest.raises(ModelFileError, match="motor"):
        report(folder)
