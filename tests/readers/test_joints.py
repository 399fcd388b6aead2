"""Joints of a robot: command and position of each from SAGE, LeRobot, ROS, archives and tables."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sewfast import read_joints, read_table
from sewfast.errors import DataError, SettingError
from sewfast.readers import Roles, joint_columns, roles

NAMES, TS, N = ("Rotation", "Elbow"), 0.02, 120
RNG = np.random.default_rng(5)
U = np.repeat(RNG.uniform(-1.0, 1.0, (N // 10, 2)), 10, axis=0)
Q = np.vstack([np.zeros((1, 2)), 0.8 * U[:-1] + 0.01 * RNG.normal(size=(N - 1, 2))])
T = TS * np.arange(N)


def _sage(folder: Path, *, names: tuple[str, ...] | None = NAMES) -> Path:
    folder.mkdir()
    if names:
        (folder / "joint_list.txt").write_text("\n".join(names))
    rows = [f'CONTROL,{1e6 * t},"{u.tolist()}"' for t, u in zip(T, U, strict=True)]
    (folder / "control.csv").write_text("\n".join(["type,timestamp,positions", *rows]))
    rows = [
        f'STATE_MOTOR,{1e6 * t},"{q.tolist()}","[0.0, 0.0]","[0.1, 0.2]"'
        for t, q in zip(T, Q, strict=True)
    ]
    head = "type,timestamp,positions,velocities,torques"
    (folder / "state_motor.csv").write_text("\n".join([head, *rows]))
    return folder


def _is_whole(joints: Any, unit: str) -> None:
    assert tuple(joints) == NAMES
    for k, data in enumerate(joints.values()):
        (e,) = data.experiments
        np.testing.assert_allclose(e.u[:, 0], U[:, k], atol=1e-6)
        np.testing.assert_allclose(e.y, Q[:, k], atol=1e-6)
        assert data.Ts == pytest.approx(TS)
        assert (data.input_units, data.output_unit) == ((unit,), unit)


def test_a_folder_of_sage_has_all_joints_in_rad(tmp_path: Path) -> None:
    folder = _sage(tmp_path / "motion")
    table = read_table(folder)
    assert "state_motor.velocities.Elbow" in table
    assert table.unit("control.positions.Elbow") == "rad"
    _is_whole(read_joints(folder), "rad")
    one = read_joints([folder, folder], joints=["Elbow"])
    assert list(one) == ["Elbow"]
    assert len(one["Elbow"].experiments) == 2


def test_without_a_list_of_names_joints_are_numbered(tmp_path: Path) -> None:
    assert list(read_joints(_sage(tmp_path / "motion", names=None))) == ["joint0", "joint1"]


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        ("control.csv", "folder of SAGE"),
        ("torn", "line 42"),
        ("names", "one for each joint of joint_list.txt"),
    ],
)
def test_a_damaged_folder_says_what_is_wrong(tmp_path: Path, damage: str, expected: str) -> None:
    folder = _sage(tmp_path / "motion")
    if damage == "torn":
        lines = (folder / "state_motor.csv").read_text().splitlines()
        (folder / "state_motor.csv").write_text("\n".join([*lines[:41], lines[41][:-15]]))
    elif damage == "names":
        (folder / "joint_list.txt").write_text("one two three")
    else:
        (folder / damage).unlink()
    with pytest.raises(DataError, match=expected):
        read_table(folder)


def test_episodes_of_lerobot_are_experiments(tmp_path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    folder = tmp_path / "data" / "chunk-000"
    folder.mkdir(parents=True)
    (tmp_path / "meta").mkdir()
    names = [f"{name}.pos" for name in NAMES]
    features = {"action": {"names": names}, "observation.state": {"names": {"motors": names}}}
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    both = {"action": [*U.tolist()] * 2, "observation.state": [*Q.tolist()] * 2}
    both |= {"timestamp": [*T] * 2, "episode_index": [3] * N + [4] * N}
    path = folder / "file-000.parquet"
    pq.write_table(pa.table(both), path)
    joints = read_joints(path, unit="deg")
    assert tuple(joints) == NAMES
    first, second = joints["Elbow"].experiments
    assert "episode 3" in first.name
    np.testing.assert_array_equal(first.y, second.y)
    np.testing.assert_allclose(first.y, Q[:, 1])
    assert joints["Elbow"].output_unit == "deg"
    assert read_joints(path)["Elbow"].output_unit == ""  # LeRobot does not say which


def test_messages_name_their_joints(tmp_path: Path) -> None:
    writing = pytest.importorskip("mcap.writer")
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = writing.Writer(file)
        writer.start()
        schema = writer.register_schema("joints", "jsonschema", b"{}")
        topics = [writer.register_channel(n, "json", schema) for n in ("/goal", "/joint_states")]
        names = [f"arm/{name}" for name in NAMES]
        for k in range(N):
            at = round(1e9 * T[k])
            point = {"positions": U[k].tolist(), "time_from_start": 0.1}
            goal = json.dumps({"joint_names": names, "points": [point]}).encode()
            state = json.dumps({"name": names, "position": Q[k].tolist(), "effort": []}).encode()
            for topic, data in zip(topics, (goal, state), strict=True):
                writer.add_message(topic, log_time=at, data=data, publish_time=at)
        writer.finish()
    joints = read_joints(path, unit="rad")
    assert tuple(joints) == ("arm_Rotation", "arm_Elbow")
    _is_whole(dict(zip(NAMES, joints.values(), strict=True)), "rad")


def test_messages_of_ros_name_their_joints(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    stamp, header = (store.types[f"{n}/msg/{c}"] for n, c in (
        ("builtin_interfaces", "Time"), ("std_msgs", "Header"),
    ))  # fmt: skip
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [
            writer.add_connection(n, kind, typestore=store)
            for n in ("/joint_command", "/joint_states")
        ]
        for k in range(N):
            for topic, values in zip(topics, (U[k], Q[k]), strict=True):
                message = store.types[kind](
                    header(stamp(sec=k, nanosec=0), ""), list(NAMES), values, 0.0 * values,
                    np.empty(0),
                )  # fmt: skip
                writer.write(topic, round(1e9 * T[k]), store.serialize_cdr(message, kind))
    path = next((tmp_path / "run").glob("*.mcap"))
    _is_whole(read_joints(path, unit="rad"), "rad")


def test_archives_and_tables_name_their_joints(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", t=T, command=U, position=Q, joint_names=np.array(NAMES))
    _is_whole(read_joints(tmp_path / "run.npz", unit="rad"), "rad")
    columns = {"t": T}
    for k, name in enumerate(NAMES):
        columns |= {f"{name}_cmd": U[:, k], f"{name}_pos": Q[:, k], f"{name}_velocity": Q[:, k]}
    _is_whole(read_joints(columns, unit="rad"), "rad")


def test_what_is_no_joint_is_none() -> None:
    assert joint_columns(read_table({"t": T, "u": U[:, 0], "speed": Q[:, 0]})) == {}
    # two commands of one joint leave doubt
    table = {"a.command": U[:, 0], "a.goal": U[:, 1], "a.position": Q[:, 0]}
    assert joint_columns(read_table(table)) == {}


def test_a_joint_alone_needs_no_name() -> None:
    for command, position in (("goal", "present"), ("goal_position_deg", "present_position_deg")):
        table = read_table({"timestamp": T, command: U[:, 0], position: Q[:, 0]})
        assert list(joint_columns(table).values()) == [(command, position)]
        assert roles(table) == Roles(command, position)
        # beside further columns, a reference and a position are those of a loop
        loop = read_table({"t": T, command: U[:, 0], position: Q[:, 0], "u": U[:, 1]})
        assert joint_columns(loop) == {}
    stage = read_table({"time_s": T, "force_N": U[:, 0], "position_m": Q[:, 0]})
    assert roles(stage) == Roles("force_N", "position_m")
    assert (stage.unit("force_N"), stage.unit("position_m")) == ("N", "m")
    assert read_table({"phase_m": T}).unit("phase_m") == ""


def test_joints_of_several_words_keep_their_columns() -> None:
    columns = {f"{side}_elbow_{kind}": U[:, k] for side in ("left", "right")
               for k, kind in enumerate(("cmd", "pos"))}  # fmt: skip
    assert set(joint_columns(read_table(columns))) == {"left_elbow", "right_elbow"}
    mixed = {"left_elbow_cmd": U[:, 0], "left_wrist_pos": Q[:, 0]}
    assert joint_columns(read_table(mixed)) == {}
    error = {"elbow.target_pos": U[:, 0], "elbow.pos_error": Q[:, 0]}
    assert joint_columns(read_table(error)) == {}
    turned = {"cmd_elbow": U[:, 0], "pos_elbow": Q[:, 0]}
    assert list(joint_columns(read_table(turned))) == ["elbow"]
    units = {"t": T, "elbow.command [rad]": U[:, 0], "elbow.position [m]": Q[:, 0]}
    with pytest.raises(SettingError, match="rad and m"):
        read_joints(units)
    units["elbow.position [rad]"] = units.pop("elbow.position [m]")
    with pytest.raises(SettingError, match="deg beside rad"):
        read_joints(units, unit="deg")
    assert list(read_joints(units, joints="elbow")) == ["elbow"]


def test_unknown_joints_and_units_are_refused(tmp_path: Path) -> None:
    folder = _sage(tmp_path / "motion")
    with pytest.raises(SettingError, match="Rotation, Elbow"):
        read_joints(folder, joints=["Shoulder"])
    with pytest.raises(SettingError, match="mm, counts"):
        read_joints(folder, unit="V")
    with pytest.raises(SettingError, match=r"elbow\.command"):
        read_joints({"t": T, "u": U[:, 0], "y": Q[:, 0]})
