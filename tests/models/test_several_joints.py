"""Several joints: one call, one table; what is left of one and follows another."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import sewfast
from sewfast import Dataset, physics, read_joints
from sewfast.errors import DataError, SettingError
from sewfast.greybox import Joint, Joints

TS, N = 0.02, 700


def _arm(coupling: float) -> dict[str, Dataset]:
    """Two servos of k_p / J = 250 1/s^2 with 12-bit encoders; the weight on `lower` (in rad of
    position error) turns with the sum of both angles."""
    rng = np.random.default_rng(7)
    u = np.repeat(rng.uniform(-1.2, 1.2, (N // 35, 2)), 35, axis=0)
    q, w, y = np.zeros(2), np.zeros(2), np.zeros((N, 2))
    h, friction, step = TS / 20, np.array([0.01, 0.02]), 2.0 * math.pi / 4096
    for k in range(N):
        y[k] = np.round(q / step) * step
        for _ in range(20):
            weight = np.array([coupling * math.sin(q[0] + q[1]), 0.0])
            free = w + 250.0 * h * (u[k] - q - 0.08 * w - weight)
            w = np.sign(free) * np.maximum(np.abs(free) - 250.0 * h * friction, 0.0)
            q = q + h * w
    return read_joints(
        {
            "t": TS * np.arange(N), "lower.command": u[:, 0], "lower.position": y[:, 0],
            "upper.command": u[:, 1], "upper.position": y[:, 1], "still.command": 0.0 * u[:, 0],
            "still.position": 0.0 * u[:, 0],
        },
        unit="rad",
    )  # fmt: skip


@cache
def _joints(coupling: float) -> Joints:
    return physics(_arm(coupling))


def test_each_joint_is_fitted_and_one_that_never_moved_is_named() -> None:
    joints = _joints(0.0)
    assert list(joints) == ["lower", "upper"]
    for joint, friction in zip(joints.values(), (0.01, 0.02), strict=True):
        assert isinstance(joint, Joint)
        assert joint.value("inertia") == pytest.approx(1 / 250, rel=0.05)
        assert joint.value("friction") == pytest.approx(friction, rel=0.2)
    assert "still" in joints.unusable
    lines = str(joints).splitlines()
    assert lines[0] == "2 joints, each fitted alone"
    assert "inertia [rad/(rad/s^2)]" in lines[1]
    assert any(line.startswith("still: not fitted") for line in lines)
    assert joints.couplings == ()


def test_gravity_that_turns_with_another_joint_is_said() -> None:
    joints = _joints(0.1)
    found = {(c.joint, c.other): c for c in joints.couplings}
    assert list(found) == [("lower", "upper")]
    assert found["lower", "upper"].gravity > 0.5
    assert "lower: what is left follows upper" in str(joints)
    assert "lower: what is left follows upper" in joints._repr_html_()
    assert json.loads(json.dumps(joints.to_dict()))["couplings"][0]["other"] == "upper"


def test_a_joint_is_chosen_where_the_output_is_a_position() -> None:
    data = _arm(0.0)["upper"]
    assert isinstance(physics(data), Joint)
    with pytest.raises(DataError, match="expected at least one joint"):
        physics({"still": _arm(0.0)["still"]})
    with pytest.raises(SettingError, match="an angle or a length"):
        physics({"a": Dataset.from_arrays(np.arange(300.0), np.arange(300.0), TS)})


def test_the_command_line_shows_a_table_or_one_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from sewfast.cli import main

    arm = _arm(0.1)
    columns = {"t": TS * np.arange(N)}
    for name in ("lower", "upper"):
        (e,) = arm[name].experiments
        columns |= {f"{name}.command [rad]": e.u[:, 0], f"{name}.position [rad]": e.y}
    path = str(tmp_path / "arm.csv")
    sewfast.write_table(path, columns)

    assert main(["physics", path]) == 0
    out = capsys.readouterr().out
    assert "2 joints, each fitted alone" in out
    assert "lower: what is left follows upper" in out
    assert main(["physics", path, "-o", str(tmp_path / "joint.json")]) == 2
    assert "--joint NAME" in capsys.readouterr().err
    file = tmp_path / "joint.json"
    assert main(["physics", path, "--joint", "upper", "-o", str(file)]) == 0
    assert "joint with a controller inside" in capsys.readouterr().out
    assert file.exists()
    assert main(["look", path]) == 0
    assert "--joint NAME, of lower, upper" in capsys.readouterr().out
    assert main(["look", path, "--joint", "upper"]) == 0
    assert main(["identify", path, "--joint", "elbow"]) == 2
    assert "lower, upper" in capsys.readouterr().err
    assert main(["look", path, "--joint", "upper", "--output", "t"]) == 2
