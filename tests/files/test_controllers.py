"""Files of controllers: every version loads as what it was, and the newest is what is written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sewfast import Biquad, Controller, Feedforward, Gains, load_controller
from sewfast.errors import ModelFileError

GOLDEN = Path(__file__).parents[1] / "golden"
WHOLE = Controller(
    Gains.standard(0.02, 0.25, 0.004), alpha=0.4, beta=0.2, N=8.0, Tt=0.05, u_min=-20.0,
    u_max=20.0, slew=4000.0, filter_samples=8, filter_time=0.002, observer_time=0.003,
    r_rate=20000.0, counts_per_rev=1572.0,
    biquads=(Biquad.notch(60.0, depth=0.1, width=0.5), Biquad.low_pass(200.0)),
    schedule=(
        (300.0, Gains.standard(0.01, 0.3, 0.002)), (1000.0, Gains.standard(0.02, 0.2, 0.004)),
    ),
    feedforward=Feedforward(
        8, 0.5, ((-3000.0, -9.1), (-60.0, -0.9), (60.0, 0.9), (3000.0, 9.3)),
        (0.004, 0.012, -0.003),
    ),
)  # fmt: skip
VERSIONS = {
    2: replace(WHOLE, biquads=(), feedforward=None),
    3: replace(WHOLE, feedforward=None),
    5: WHOLE,
}


@pytest.mark.parametrize("version", VERSIONS)
def test_a_file_of_each_version_is_what_it_was(version: int, tmp_path: Path) -> None:
    golden = GOLDEN / f"controller_{version}.json"
    found = load_controller(golden)
    assert found == replace(VERSIONS[version], notes=f"a file of version {version}")
    found.save(tmp_path / "now.json")
    now = json.loads((tmp_path / "now.json").read_text())
    assert now["version"] == 5
    assert load_controller(tmp_path / "now.json") == found
    if version == 5:
        assert now == json.loads(golden.read_text())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"preview": 31}, "preview"),
        ({"preview": 1.5}, "preview"),
        ({"late": None}, "late"),
        ({"late": 2.0}, "late"),
        ({"levels": [{"y": 1.0, "u": 0.0}, {"y": 1.0, "u": 1.0}]}, "growing"),
        ({"levels": [{"y": 1.0}]}, "u"),
        ({"levels": [{"y": 1.0 * k, "u": 0.0} for k in range(9)]}, "8 levels"),
        ({"levels": [], "taps": []}, "at least one level or tap"),
        ({"taps": [0.1] * 17}, "16 taps"),
        ({"taps": ["x"]}, "taps"),
        ({"more": 1}, "more"),
    ],
)
def test_a_feedforward_that_cannot_be_is_refused_on_load(
    change: dict[str, object], field: str, tmp_path: Path
) -> None:
    values = json.loads((GOLDEN / "controller_5.json").read_text())
    values["feedforward"].update(change)
    (tmp_path / "c.json").write_text(json.dumps(values))
    with pytest.raises(ModelFileError, match=field):
        load_controller(tmp_path / "c.json")


def test_no_feedforward_is_null_and_of_no_earlier_version(tmp_path: Path) -> None:
    values = json.loads((GOLDEN / "controller_5.json").read_text())
    path = tmp_path / "c.json"
    path.write_text(json.dumps({**values, "feedforward": None}))
    assert load_controller(path) == replace(WHOLE, feedforward=None, notes="a file of version 5")
    path.write_text(json.dumps({**values, "version": 3}))
    with pytest.raises(ModelFileError, match=r"kind|feedforward"):
        load_controller(path)
