"""Logs of other tools: written by their own libraries, read to the bit; damaged ones refused."""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from sewfast.errors import DataError, SettingError
from sewfast.readers import Table, logs, read_table
from sewfast.readers import blackbox as blackbox_module

RNG = np.random.default_rng(0)
T = 10.0 + np.arange(200) * 0.002
DAMAGED = int(os.environ.get("SEWFAST_DAMAGED", "40"))
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


def foxglove(path: Path) -> Path:
    """As Foxglove's own writer makes it, with a topic in another encoding."""
    writing = pytest.importorskip("mcap.writer")
    with path.open("wb") as file:
        writer = writing.Writer(file, chunk_size=4000)
        writer.start()
        schema = writer.register_schema("drive", "jsonschema", b"{}")
        drive = writer.register_channel("/drive", "json", schema)
        slow = writer.register_channel("/slow", "json", schema)
        image = writer.register_channel("/image", "protobuf", 0)
        for k, (t, u, y) in enumerate(zip(T, U, Y, strict=True)):
            data = json.dumps({"u": u, "state": {"y": y, "on": True}, "text": "x"}).encode()
            writer.add_message(drive, round(t * 1e9), data, round(t * 1e9), k)
        for t, value in zip(SLOW_T, SLOW, strict=True):
            writer.add_message(slow, round(t * 1e9), json.dumps([value]).encode(), 0)
        writer.add_message(image, round(T[0] * 1e9), b"\x08\x01", 0)
        writer.finish()
    return path


HEADER = """\
H Product:Blackbox flight data recorder by Nicholas Sherlock
H Data version:2
H I interval:32
H P interval:1/2
H Field I name:loopIteration,time,axisP[0],axisP[1],axisP[2],rc[0],rc[1],rc[2],rc[3],vbat,motor[0],motor[1],u,y,debug
H Field I signed:0,0,1,1,1,1,1,1,0,0,0,0,1,1,0
H Field I predictor:0,0,0,0,0,0,0,0,4,9,11,5,0,0,0
H Field I encoding:1,1,0,0,0,0,0,0,1,3,1,0,0,0,1
H Field P predictor:6,2,1,1,1,1,1,1,1,1,3,3,1,1,1
H Field P encoding:9,0,7,7,7,8,8,8,8,6,6,6,6,6,0
H Field S name:flightModeFlags,stateFlags
H Field S signed:0,0
H Field S predictor:0,0
H Field S encoding:1,1
H minthrottle:1070
H vbatref:1600
H motorOutput:158,2047
"""  # noqa: E501
"""As a flight controller writes it, with the fields `u` and `y` of a drive for once."""
COUNTS = RNG.integers(-1000, 1000, (200, 13))
COUNTS[:, [6, 7, 8, 9, 12]] = np.abs(COUNTS[:, [6, 7, 8, 9, 12]]) + 1070


def unsigned(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def signed(value: int) -> bytes:
    return unsigned((value << 1) ^ (value >> 31) if value >= 0 else ((-value) << 1) - 1)


def halves(values: list[int]) -> bytes:
    """TAG8_4S16, version 2: a selector, then 0, 4, 8 or 16 bits of each."""
    kinds = [0 if v == 0 else 1 if -8 <= v < 8 else 2 if -128 <= v < 128 else 3 for v in values]
    digits = "".join(
        f"{v & 15:x}" if k == 1 else f"{v & 255:02x}" if k == 2 else f"{v & 65535:04x}" if k else ""
        for v, k in zip(values, kinds, strict=True)
    )
    selector = sum(k << 2 * i for i, k in enumerate(kinds))
    return bytes([selector]) + bytes.fromhex(digits + "0" * (len(digits) % 2))


def triple(values: list[int], k: int) -> bytes:
    """TAG2_3S32 in the smallest form that holds the values."""
    if all(-2 <= v < 2 for v in values):
        return bytes([sum((v & 3) << s for v, s in zip(values, (4, 2, 0), strict=True))])
    if all(-8 <= v < 8 for v in values):
        return bytes([64 | values[0] & 15, (values[1] & 15) << 4 | values[2] & 15])
    if all(-32 <= v < 32 for v in values):
        return bytes([128 | values[0] & 63, values[1] & 63, values[2] & 63])
    sizes = [1 if -128 <= v < 128 else 2 for v in values]
    lead = 192 | sum((n - 1) << 2 * i for i, n in enumerate(sizes))
    return bytes([lead]) + b"".join(
        v.to_bytes(n, "little", signed=True) for v, n in zip(values, sizes, strict=True)
    )


def tagged(values: list[int]) -> bytes:
    """TAG8_8SVB: a bit for each field that is not 0."""
    tag = sum((v != 0) << i for i, v in enumerate(values))
    return bytes([tag]) + b"".join(signed(v) for v in values if v)


def blackbox_rows() -> list[list[int]]:
    """What the log below holds: loop, time, then the counts; the first three rows hardly change."""
    counts = COUNTS.copy()
    counts[1] = counts[0]
    counts[2] = counts[0] + 1
    counts[3] = counts[2] + RNG.integers(-7, 7, 13)
    times = [round(t * 1e6) for t in T]
    return [[2 * k, times[k], *map(int, counts[k])] for k in range(200)]


ROWS = blackbox_rows()


def average(a: int, b: int) -> int:
    return int((a + b) / 2)


def blackbox(path: Path) -> Path:
    raw = HEADER.encode()
    for k, row in enumerate(ROWS):
        if row[0] % 32 == 0:
            motor = row[10]
            raw += b"I" + unsigned(row[0]) + unsigned(row[1])
            raw += b"".join(signed(v) for v in row[2:8])
            raw += unsigned(row[8] - 1070) + unsigned((1600 - row[9]) & 0x3FFF)
            raw += unsigned(motor - 158) + signed(row[11] - motor)
            raw += signed(row[12]) + signed(row[13]) + unsigned(row[14])
            one = two = row
        else:
            change = [new - old for new, old in zip(row, one, strict=True)]
            raw += b"P" + signed(row[1] - (2 * one[1] - two[1]))
            raw += triple(change[2:5], k) + halves(change[5:9])
            motors = [row[i] - average(one[i], two[i]) for i in (10, 11)]
            raw += tagged([change[9], *motors, change[12], change[13]]) + signed(change[14])
            one, two = row, one
        if k == 0:
            raw += b"S" + unsigned(5) + unsigned(1)
        if k == 50:
            raw += b"E\x1e" + unsigned(3) + unsigned(5) + b"S" + unsigned(7) + unsigned(300)
    path.write_bytes(raw + b"E\xffEnd of log\0")
    return path


def saleae(path: Path) -> Path:
    head = struct.pack("<8siidQQQ", b"<SALEAE>", 0, 1, 10.0, 1000, 2, 200)
    path.write_bytes(head + U.astype("<f4").tobytes())
    return path


KINDS: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "run.mf4": (mdf, "u", "y"),
    "run.tdms": (tdms, "u", "y"),
    "run.ulg": (ulog, "drive.u", "drive.y"),
    "run.wpilog": (wpilog, "u", "y"),
    "run.bag": (ros1, "/drive.x", "/drive.y"),
    "run.mcap": (ros2, "/drive.x", "/drive.y"),
    "foxglove.mcap": (foxglove, "/drive.u", "/drive.state.y"),
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


def test_a_black_box_holds_what_was_written(tmp_path: Path) -> None:
    """Every encoding and predictor that flight controllers use, in each of its forms."""
    table = read_table(blackbox(tmp_path / "run.bbl"))
    rows = np.array(ROWS)
    names = HEADER.split("Field I name:")[1].split("\n")[0].replace("[", ".").replace("]", "")
    for k, name in enumerate(names.split(",")):
        if name != "time":
            np.testing.assert_array_equal(table[name], rows[:, k], err_msg=name)
    np.testing.assert_allclose(table["t"], T - T[0], atol=1e-9)
    np.testing.assert_array_equal(table["flightModeFlags"], [0] + 50 * [5] + 149 * [7])
    data = sewfast.read(table, inputs="u", output="y")
    assert data.Ts == pytest.approx(0.002)


def test_a_black_box_is_read_as_orangebox_reads_it(tmp_path: Path) -> None:
    orangebox = pytest.importorskip("orangebox")
    path = blackbox(tmp_path / "run.bbl")
    parser = orangebox.Parser.load(str(path))
    # before the first slow frame it has texts
    theirs = np.array([[float(v or 0) for v in frame.data] for frame in parser.frames()])
    table = read_table(path)
    names = [n.replace("[", ".").replace("]", "") for n in parser.field_names]
    ours = np.column_stack([table[n] for n in names if n != "time"])
    np.testing.assert_array_equal(ours, np.delete(theirs, names.index("time"), axis=1))


def test_a_black_box_goes_on_behind_what_is_damaged(tmp_path: Path) -> None:
    raw = bytearray(blackbox(tmp_path / "run.bbl").read_bytes())
    at = len(raw) // 2
    raw[at : at + 40] = b"\x00" * 40
    (tmp_path / "run.bbl").write_bytes(raw)
    found = read_table(tmp_path / "run.bbl")
    kept = set(map(int, found["loopIteration"]))
    written = {row[0]: row for row in ROWS}
    assert 150 <= len(kept & written.keys()) < 200
    rows = {int(k): v for k, v in zip(found["loopIteration"], found["y"], strict=True)}
    wrong = sum(rows[k] != written[k][13] for k in kept & written.keys())
    assert wrong <= 1, "a frame that ends where another begins cannot be told from a sound one"


def test_loops_that_are_not_logged_are_counted_as_the_flight_controller_does() -> None:
    """A frame is due at every `interval`th loop, and in between `part` of every `whole` loops."""
    for interval, part, whole in ((32, 1, 2), (32, 1, 4), (30, 2, 3), (256, 1, 16), (7, 3, 5)):
        due = [
            k for k in range(3 * interval)
            if k % interval == 0 or (k % interval + part - 1) % whole < part
        ]  # fmt: skip
        for now, following in itertools.pairwise(due):
            assert blackbox_module._skipped(now, interval, part, whole) == following - now - 1


def test_of_several_flights_the_longest_is_read(tmp_path: Path) -> None:
    whole = blackbox(tmp_path / "run.bbl").read_bytes()
    (tmp_path / "run.bbl").write_bytes(whole[: len(whole) // 3] + whole + whole[: len(whole) // 2])
    assert len(read_table(tmp_path / "run.bbl")["y"]) == 200


def test_saleae_analogue_values_are_exact(tmp_path: Path) -> None:
    table = read_table(saleae(tmp_path / "analog_0.bin"))
    np.testing.assert_array_equal(table["voltage"], U.astype("<f4").astype(float))
    np.testing.assert_allclose(table["t"], 0.002 * np.arange(200), atol=1e-12)
    assert table.unit("voltage") == "V"


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ((0, 0, 10.0, 1000, 2, 200), "a digital channel"),
        ((1, 1, 10.0, 1000, 2, 200), "version 1"),
        ((0, 1, 10.0, 0, 2, 200), "a sample rate of 0"),
        ((0, 1, float("nan"), 1000, 2, 200), "a sample rate"),
        ((0, 1, 10.0, 1000, 2, 201), "201 samples are promised, 200 are there"),
        ((0, 1, 10.0, 1000, 2, 2**63), "are promised"),
    ],
)
def test_other_saleae_files_are_refused(
    tmp_path: Path, head: tuple[float, ...], words: str
) -> None:
    raw = struct.pack("<8siidQQQ", b"<SALEAE>", *head) + U.astype("<f4").tobytes()
    (tmp_path / "a.bin").write_bytes(raw)
    with pytest.raises(DataError, match=words):
        read_table(tmp_path / "a.bin")


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


OWN = ("run.wpilog", "run.bbl", "run.bin")
"""Read here and not by a library in a process of its own."""


@pytest.mark.nightly(
    "damages every kind of log many times", by_day=["run.tdms", "run.ulg", "run.wpilog", "run.mcap"]
)
@pytest.mark.parametrize("name", [*KINDS, "run.bbl", "run.bin"])
def test_a_damaged_log_is_refused_or_read(name: str, tmp_path: Path) -> None:
    """Cut, flipped, filled: a table or a DataError, nothing else."""
    make = {"run.bbl": blackbox, "run.bin": saleae} | {n: kind[0] for n, kind in KINDS.items()}
    raw = make[name](tmp_path / name).read_bytes()
    rng = np.random.default_rng(1)
    place = tmp_path / f"damaged-{name}"
    outcomes = set()
    # a reader in a process of its own takes a second to start
    for _ in range(DAMAGED if name in OWN else DAMAGED // 10):
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


@pytest.mark.skipif(sys.platform != "linux", reason="other systems bound no memory of a process")
def test_a_reader_that_asks_for_more_memory_than_a_file_can_need_is_refused_it() -> None:
    program = (
        "import numpy as np; from sewfast.readers.logs import _bound_memory; "
        "_bound_memory(1_000_000_000); np.ones(10_000_000); np.ones(1_000_000_000)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1
    assert "Unable to allocate 7.45 GiB" in done.stderr.splitlines()[-1]


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


def test_samples_that_mdf_calls_invalid_were_not_measured(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    bits = np.arange(len(T)) % 5 == 0
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(U, T, name="u", invalidation_bits=bits)])
        file.save(tmp_path / "run.mf4")
    u = read_table(tmp_path / "run.mf4")["u"]
    np.testing.assert_array_equal(u, np.where(bits, np.nan, U))


def test_tdms_channels_of_moments_and_without_an_offset(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    moments = np.datetime64("2026-03-14T10:00:00", "us") + (1e6 * T).round().astype("m8[us]")
    with nptdms.TdmsWriter(tmp_path / "moments.tdms") as writer:
        columns = {"Time": moments, "u": U, "y": Y}
        writer.write_segment([nptdms.ChannelObject("g", n, v) for n, v in columns.items()])
    data = sewfast.read(tmp_path / "moments.tdms", inputs="u", output="y")
    assert data.Ts == pytest.approx(T[1] - T[0])
    with nptdms.TdmsWriter(tmp_path / "wave.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("g", "u", U, {"wf_increment": 0.004})])
    assert sewfast.read(tmp_path / "wave.tdms", inputs="u").Ts == pytest.approx(0.004)


def test_an_mcap_of_json_names_what_it_cannot_read(tmp_path: Path) -> None:
    table = read_table(foxglove(tmp_path / "run.mcap"))
    assert "/image (protobuf)" in table.unusable
    np.testing.assert_array_equal(table["/slow.0"][5::20], SLOW)
    assert np.isnan(table["/slow.0"][:5]).all()
    np.testing.assert_array_equal(table["/drive.state.on"], 1.0)
    np.testing.assert_allclose(table["t"], T - T[0], atol=1e-9)


def test_a_recording_of_ours_is_no_log_whoever_has_packed_it(tmp_path: Path) -> None:
    machine = sewfast.VirtualMachine()
    sewfast.record(machine, U, file=tmp_path / "run.mcap")
    raw = (tmp_path / "run.mcap").read_bytes()
    assert not logs.is_log(raw)
    # torn, its first chunk damaged, rewritten by another library
    assert not logs.is_log(raw[: len(raw) // 2].replace(b"/sewfast/", b"/sewbest/"))
    assert not logs.is_log(raw.replace(b"\x07\0\0\0sewfast", b"\x07\0\0\0another", 1))
