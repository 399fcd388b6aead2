"""Changed files: each is refused, or loads and can be used (`make mutations`: by the thousand)."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benches"))
import sewfast
from kinds import model_of
from refusals import refuses
from sewfast.commissioning.result import numbers_in
from sewfast.equilibrium import linearise
from sewfast.errors import DataError, ModelFileError, SewfastError
from sewfast.report.artefacts import drawing

pytest.importorskip("resource", reason="bounds memory as POSIX systems can")
mutations = pytest.importorskip("mutations", reason="needs fork")


@pytest.mark.parametrize("name", ["controller", "recording", "table", "project"])
def test_changed_files_are_refused_or_used(name: str, tmp_path: Path) -> None:
    for k in range(40):
        found, why = mutations.outcome(name, tmp_path, 7, k)
        assert found in mutations.GOOD, why


def edited(path: Path, change: Callable[[Any], object]) -> Path:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    return path


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"samples": ["700"]}, "training.samples"),
        ({"samples": 1e9}, "training.samples"),
        ({"output_range": [1.0]}, "training.output_range"),
        ({"notes": [1]}, r"training.notes\[0\]"),
        ({"verdict": {"next": 5}}, "training.verdict.next"),
        ({"choice": {"candidates": [{"nx": "a"}]}}, r"candidates\[0\].nx"),
        ({"uncertainty": {"factor": [[1e200]]}}, "training.uncertainty.factor"),
        ({"rest": {"u": [0.0], "y": True}}, "training.rest.y"),
        ({"rest": {"u": [], "y": 0.0}}, "rest.u"),
    ],
)
def test_what_a_model_remembers_is_checked(
    change: dict[str, Any], field: str, tmp_path: Path
) -> None:
    path = tmp_path / "m.json"
    model_of("oe").save(path)
    edited(path, lambda values: values["training"].update(change))
    with pytest.raises(ModelFileError, match=field):
        sewfast.load_model(path)


def test_a_rest_that_the_kind_cannot_have_is_refused_on_load(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    model_of("grey_box").save(path)
    edited(path, lambda v: v["training"].update(rest={"u": [1.0], "y": 5.0}))
    with pytest.raises(ModelFileError, match=r"training\.rest"):
        sewfast.load_model(path)


def test_a_model_that_gives_no_number_says_so_in_use(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    model_of("grey_box").save(path)
    edited(path, lambda v: v["parameters"].update(command_scale=5e-324))
    with pytest.raises(SewfastError, match="got NaN at sample 0"):
        linearise(sewfast.load_model(path).core, np.ones(1))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("variance", -1.0), ("coherence", -0.5), ("provenance", True),
        ("provenance", {"cautions": True}),
    ],
)  # fmt: skip
def test_a_response_that_could_not_be_printed(field: str, value: Any, tmp_path: Path) -> None:
    path = mutations.make_responses(tmp_path)[0]
    edited(path, lambda v: v.update({field: [value] * 24 if type(value) is float else value}))
    with pytest.raises(ModelFileError, match=field):
        sewfast.load_response(path)


def test_a_response_of_zeros_has_a_size_and_a_text(tmp_path: Path) -> None:
    path = mutations.make_responses(tmp_path)[0]
    zeros = [0.0] * 24
    edited(path, lambda v: v.update(real=zeros, imaginary=zeros, variance=zeros, noise=zeros))
    response = sewfast.load_response(path)
    assert abs(response.at(2.0)) < 1e-200
    assert "frequency response" in str(response)


def test_pipes_and_devices_are_no_files(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reading: list[Callable[[Path], object]] = [
        sewfast.load_model, sewfast.load_controller, sewfast.load_response, sewfast.load_motor,
        sewfast.read_table, sewfast.fleet,
    ]  # fmt: skip
    for path in (pipe, Path("/dev/zero")):
        for read in reading:
            with pytest.raises(SewfastError, match="a pipe or a device"):
                read(path)
        assert numbers_in(path) == {}
        with pytest.raises(DataError, match="a pipe or a device"):
            drawing(path)
    with refuses(DataError, expected="a file", received="a folder"):
        sewfast.read_table(tmp_path)
