"""Logs of other tools: written by their own libraries, read to the bit; damaged ones refused."""

from __future__ import annotations

import importlib.util
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast.errors import DataError, SettingError
from sewfast.readers import Table, logs, read_table

RNG = np.random.default_rng(0)
T = 10.0 + np.arange(200) * 0.002
DAMAGED = int(os.environ.get("SEWFAST_DAMAGED", "80"))
U, Y = RNG.normal(size=200), RNG.normal(size=200)
SLOW_T, SLOW = T[5::20], RNG.normal(size=10)


def mdf(path: Path) -> Path:
    asammdf = pytest.importorskip("asammdf")
    file = asammdf.MDF(version="4.10")
    signal = asammdf.Signal
    pair = [signal(U, T, name="u", unit="V"), signal(Y, T, name="y", unit="RPM")]
    file.append(pair)
    file.append([signal(SLOW, SLOW_T, name="temperature", unit="degC")])
    file.save(path)
    return path


def tdms(path: Path) -> Path:
    nptdms = pytest.importorskip("nptdms")
    waves = {"wf_increment": 0.002, "wf_start_offset": 0.0}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [
                nptdms.ChannelObject("drive", "u", U, {**waves, "unit_string": "V"}),
                nptdms.ChannelObject("drive", "y", Y, {**waves, "unit_string": "RPM"}),
            ]
        )
    return path


def ulog(path: Path) -> Path:
    pytest.importorskip("pyulog")
    raw = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)

    def message(kind: bytes, content: bytes) -> bytes:
        return struct.pack("<H", len(content)) + kind + content

    raw += message(b"B", bytes(40))
    raw += message(b"F", b"drive:uint64_t timestamp;double u;double y;")
    raw += message(b"F", b"slow:uint64_t timestamp;double temperature;")
    raw += message(b"A", struct.pack("<BH", 0, 1) + b"drive")
    raw += message(b"A", struct.pack("<BH", 0, 2) + b"slow")
    for t, u, y in zip(T, U, Y, strict=True):
        raw += message(b"D", struct.pack("<HQdd", 1, round(t * 1e6), u, y))
    for t, value in zip(SLOW_T, SLOW, strict=True):
        raw += message(b"D", struct.pack("<HQd", 2, round(t * 1e6), value))
    path.write_bytes(raw)
    return path


def wpilog(path: Path) -> Path:
    raw = b"WPILOG" + struct.pack("<HI", 0x0100, 0)

    def record(entry: int, stamp: int, content: bytes) -> bytes:
        return struct.pack("<BBHI", 0b0110100, entry, len(content), stamp) + content

    def start(entry: int, name: bytes, kind: bytes) -> bytes:
        texts = b"".join(struct.pack("<I", len(x)) + x for x in (name, kind, b""))
        return record(0, 0, b"\x00" + struct.pack("<I", entry) + texts)

    raw += start(1, b"u", b"double") + start(2, b"y", b"double") + start(3, b"text", b"string")
    raw += start(4, b"temperature", b"double") + start(5, b"on", b"boolean")
    raw += start(6, b"pose", b"double[]")
    for k, (t, u, y) in enumerate(zip(T, U, Y, strict=True)):
        stamp = round(t * 1e6)
        raw += record(1, stamp, struct.pack("<d", u)) + record(2, stamp, struct.pack("<d", y))
        raw += record(3, stamp, b"hello") + record(5, stamp, bytes([k % 2]))
        raw += record(6, stamp, struct.pack("<dd", u, -u))
    for t, value in zip(SLOW_T, SLOW, strict=True):
        raw += record(4, round(t * 1e6), struct.pack("<d", value))
    path.write_bytes(raw)
    return path


def ros1(path: Path) -> Path:
    return _ros(path, "ros1")


def ros2(path: Path) -> Path:
    return _ros(path, "ros2")


def _ros(path: Path, version: str) -> Path:
    pytest.importorskip("rosbags")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == "ros1" else Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/Point"
    point = store.types[kind]
    if version == "ros1":
        from rosbags.rosbag1 import Writer

        with Writer(path) as writer:
            topic = writer.add_connection("/drive", kind, typestore=store)
            for t, u, y in zip(T, U, Y, strict=True):
                content = store.serialize_ros1(point(u, y, 0.0), kind)
                writer.write(topic, round(t * 1e9), content)
        return path
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    folder = path.with_suffix("")
    with Writer2(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer2:
        topic = writer2.add_connection("/drive", kind, typestore=store)
        for t, u, y in zip(T, U, Y, strict=True):
            writer2.write(topic, round(t * 1e9), store.serialize_cdr(point(u, y, 0.0), kind))
    return next(folder.glob("*.mcap"))


KINDS: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "run.mf4": (mdf, "u", "y"),
    "run.tdms": (tdms, "u", "y"),
    "run.ulg": (ulog, "drive.u", "drive.y"),
    "run.wpilog": (wpilog, "u", "y"),
    "run.bag": (ros1, "/drive.x", "/drive.y"),
    "run.mcap": (ros2, "/drive.x", "/drive.y"),
}


@pytest.mark.parametrize("name", KINDS)
def test_values_are_those_that_were_written(name: str, tmp_path: Path) -> None:
    make, u, y = KINDS[name]
    table = read_table(make(tmp_path / name))
    np.testing.assert_array_equal(table[u], U)
    np.testing.assert_array_equal(table[y], Y)
    data = sewfast.read(table, inputs=u, output=y)
    assert data.Ts == pytest.approx(0.002, rel=1e-6)
    np.testing.assert_array_equal(data.experiments[0].y, Y)


@pytest.mark.parametrize("name", ["run.mf4", "run.tdms"])
def test_units_are_kept(name: str, tmp_path: Path) -> None:
    table = read_table(KINDS[name][0](tmp_path / name))
    assert (table.unit("u"), table.unit("y")) == ("V", "RPM")


@pytest.mark.parametrize(
    ("name", "slow"),
    [("run.mf4", "temperature"), ("run.ulg", "slow.temperature"), ("run.wpilog", "temperature")],
)
def test_a_slow_signal_is_held(name: str, slow: str, tmp_path: Path) -> None:
    table = read_table(KINDS[name][0](tmp_path / name))
    expected = np.full(200, np.nan)
    expected[5:] = np.repeat(SLOW, 20)[:195]
    np.testing.assert_array_equal(table[slow], expected)
    assert "last value" in " ".join(table.notes)


def test_a_wpilog_is_what_their_own_reader_finds(tmp_path: Path) -> None:
    wpiutil = pytest.importorskip("wpiutil.log")
    path = wpilog(tmp_path / "run.wpilog")
    names: dict[int, str] = {}
    theirs: dict[str, list[float]] = {}
    for record in wpiutil.DataLogReader(str(path)):
        if record.isStart():
            begun = record.getStartData()
            names[begun.entry] = begun.name
        elif not record.isControl() and names[record.getEntry()] in ("u", "y", "temperature"):
            theirs.setdefault(names[record.getEntry()], []).append(record.getDouble())
    table = read_table(path)
    for name in ("u", "y"):
        np.testing.assert_array_equal(table[name], theirs[name])
    assert theirs["temperature"] == list(SLOW)
    np.testing.assert_array_equal(table["on"], np.arange(200) % 2)
    np.testing.assert_array_equal(table["pose.1"], -U)
    assert "text" not in table


def test_a_log_that_was_cut_off_keeps_what_came(tmp_path: Path) -> None:
    whole = wpilog(tmp_path / "run.wpilog").read_bytes()
    (tmp_path / "cut.wpilog").write_bytes(whole[: len(whole) // 2])
    table = read_table(tmp_path / "cut.wpilog")
    count = len(table["u"])
    assert 50 < count < 200
    np.testing.assert_array_equal(table["u"], U[:count])


@pytest.mark.parametrize("name", KINDS)
def test_a_damaged_log_is_refused_or_read(name: str, tmp_path: Path) -> None:
    """Cut, flipped, filled: a table or a DataError, nothing else."""
    raw = KINDS[name][0](tmp_path / name).read_bytes()
    rng = np.random.default_rng(1)
    place = tmp_path / f"damaged-{name}"
    outcomes = set()
    # a reader in a process of its own takes a second to start
    for _ in range(DAMAGED if name == "run.wpilog" else DAMAGED // 10):
        content = bytearray(raw)
        for at in rng.integers(8, len(raw), rng.integers(1, 30)):
            content[at] = rng.integers(0, 256)
        if rng.random() < 0.5:
            del content[int(rng.integers(8, len(raw))) :]
        place.write_bytes(content)
        try:
            outcomes.add(type(read_table(place)))
        except DataError as refused:
            outcomes.add(DataError if str(place) in str(refused) else str)
    assert outcomes <= {Table, DataError}
    assert outcomes


@pytest.mark.parametrize("name", ["run.mf4", "run.tdms", "run.ulg", "run.bag", "run.mcap"])
def test_a_missing_library_is_named(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = KINDS[name][0](tmp_path / name)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(SettingError, match=r'pip install "sewfast\[logs\]"'):
        read_table(path)


def test_what_is_no_series_says_why(tmp_path: Path) -> None:
    def joined(*signals: Any) -> Table:
        return logs.joined(tmp_path / "x", [logs.Signal(*s) for s in signals], "a log")

    with pytest.raises(DataError, match="empty"):
        joined()
    with pytest.raises(DataError, match="not numeric"):
        joined(("a", None, np.array(["x", "y"])))
    table = joined(("a", T, U), ("a", T, Y), ("b", None, Y), ("c", T[:3], Y), ("d", T, U[:1]))
    assert table.names == ("t", "a", "a.2")
    assert set(table.unusable) == {"b", "c", "d"}
    with pytest.raises(DataError, match="no time stamps"):
        table["b"]


def test_a_reader_that_finds_no_end_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ulog(tmp_path / "run.ulg")
    monkeypatch.setattr(logs, "PATIENCE", 0.0)
    monkeypatch.setattr(logs, "PATIENCE_PER_MB", 0.0)
    with pytest.raises(DataError, match="no end"):
        read_table(path)
