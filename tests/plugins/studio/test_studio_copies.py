"""What a page offers to copy is Python that compiles and commands that the command line knows."""

from __future__ import annotations

import ast
import shlex
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast.cli.parser import build_parser
from sewfast_studio import driving, requests

PLACES = {
    "virtual": driving.Place("virtual:3", limits={"volt": 20.0, "speed_rpm": 3000.0}),
    "serial": driving.Place("/dev/my port", baud=9600, watchdog=0.25, limits={"volt": 12.0}),
}
ASKED: dict[str, dict[str, Any]] = {
    "record": {"signal": "pulses", "seed": 2, "scale": 0.5, "file": "a run.csv"},
    "run": {
        "controller": "it's.json", "reference": "trapezoid", "seed": 0, "scale": 1.5,
        "file": "b.csv",
    },
    "commission": {"seed": 1, "members": 2, "evaluations": 50},
}  # fmt: skip
STEP = requests.Step(
    "-odd.csv", ("u",), "y", resample=0.01, model="oe", seed=4,
    mask=("3:5", "outliers"), shift=2, hold=True,
)  # fmt: skip


def called(script: str, name: str) -> ast.Call:
    """The one call of `sewfast.NAME` in a script."""
    calls = [n for n in ast.walk(ast.parse(script)) if isinstance(n, ast.Call)]
    (found,) = (c for c in calls if ast.unparse(c.func) == f"sewfast.{name}")
    return found


def known(commands: str, name: str) -> Any:
    """The options of the one line that calls `sewfast NAME`."""
    (line,) = (w for w in map(shlex.split, commands.splitlines()) if w[:2] == ["sewfast", name])
    return build_parser().parse_args(line[1:])


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ASKED)
def test_work_on_a_drive(kind: str, place: str) -> None:
    asked, where = ASKED[kind], PLACES[place]
    copy = driving.copies(kind, where, asked)
    call = ast.unparse(called(copy["python"], kind))
    if "file" in asked:
        assert f"file={asked['file']!r}" in call
    if kind == "run":
        assert f"{asked['controller']!r}" in copy["python"]
    options = known(copy["commands"], kind)
    assert options.on == ("./drive.port" if where.is_virtual else where.port)
    if kind == "commission":
        assert (options.seed, options.members, options.evaluations) == (1, 2, 50)


def test_a_commissioning_of_a_virtual_machine() -> None:
    asked = requests.Commission("virtual", 1, 2, 50)
    assert "evaluations=50" in ast.unparse(called(asked.python(), "commission"))
    assert known(asked.commands(), "commission").members == 2


@pytest.mark.parametrize("name", ["look", "bode", "identify", "validate"])
def test_steps(name: str) -> None:
    columns = {"inputs": ["u"], "output": "y"}
    # as the studio does: the filter of resampling looks ahead
    step = replace(STEP, resample=None, mask=(), hold=False) if name == "bode" else STEP
    copy = requests.script(step, name, columns, None, None)
    assert ast.unparse(called(copy, "read")).startswith("sewfast.read('-odd.csv', inputs=['u']")
    if name != "look":
        called(copy, name)
    said = requests.commands(step, name, columns, None, None)
    options = known(said, name)
    assert "./-odd.csv" in options.data
    assert options.shift_input == 2
    if name != "bode":
        assert (options.mask, options.hold_inputs) == (["3:5", "outliers"], True)


def test_the_copy_of_a_changed_recording_gives_the_same_data() -> None:
    u = np.repeat([0.0, 1.0, np.nan, 2.0, 1.0], 40)
    y = np.convolve(np.nan_to_num(u), 0.1 * np.ones(10))[:200]
    y[50] = 90.0
    step = replace(STEP, resample=None)
    data = sewfast.Dataset.from_arrays(u, y, Ts=0.01)
    found = step.changed(data)
    copied: dict[str, Any] = {"data": data}
    lines = requests.script(step, "look", {"inputs": ["u"], "output": "y"}, None, None)
    exec("\n".join(x for x in lines.splitlines() if x.startswith("data = data.")), copied)
    for ours, theirs in zip(found.experiments, copied["data"].experiments, strict=True):
        np.testing.assert_array_equal(ours.u, theirs.u)
        np.testing.assert_array_equal(ours.y, theirs.y)
    assert np.isfinite(found.experiments[0].u).all()
