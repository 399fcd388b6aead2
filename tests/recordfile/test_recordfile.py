"""Recording files: what is written is read, by us and by the format's own reader."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import sys
import threading
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recordings_made import COLUMNS, STARTED, Made, header, make, signals
from refusals import refuses
from sewfast.errors import DataError, SettingError
from sewfast.recordfile import Header, RecordWriter, export, read_recording, save_columns
from sewfast.recordfile.format import numbers
from sewfast.recordfile.reader import read_header


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "zstd"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    if request.param:
        pytest.importorskip("zstandard", reason="needs the extra zstd")
    return make(tmp_path_factory.mktemp("made") / "run.mcap", compress=request.param)


def test_what_was_written_is_read(made: Made) -> None:
    found = read_recording(made.path)
    assert tuple(found.columns) == tuple(COLUMNS)
    for name, values in made.columns.items():
        np.testing.assert_array_equal(found.columns[name], values)
        assert not found.columns[name].flags.writeable
    assert (found.gaps, found.outcome, found.damage) == (made.gaps, "complete", ())
    assert (len(found), found.received, found.complete) == (1000, 980, False)
    assert found.header == header(1000)
    assert [(e["kind"], e["index"], e["detail"]) for e in found.events] == [
        ("armed", 0, {"limits": {"u": 20.0}}),
        ("disarmed", 1000, {}),
    ]


def test_a_float32_column_reads_back_to_the_same_float32(made: Made) -> None:
    found = read_recording(made.path).columns["current"]
    there = np.isfinite(found)
    np.testing.assert_array_equal(
        found[there].astype(np.float32), signals(1000)["current"][there].astype(np.float32)
    )
    # the shortest text, not the 17 digits of its float64
    assert len(repr(float(found[0]))) < 13


def test_a_whole_recording_is_complete(tmp_path: Path) -> None:
    found = read_recording(make(tmp_path / "run.mcap", gaps=()).path)
    assert found.complete
    assert "no gap, no damage" in repr(found)


@pytest.mark.parametrize("count", [0, 1, 99, 100, 101, 250])
def test_any_number_of_samples(tmp_path: Path, count: int) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path, header(columns={"u": "V"})) as writer:
        writer.samples(0, {"u": np.arange(count) / 3})
    found = read_recording(path)
    np.testing.assert_array_equal(found.columns["u"], np.arange(count) / 3)
    assert found.complete


def test_planned_samples_that_never_came_are_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path, header(20, columns={"u": "V"})) as writer:
        writer.samples(5, {"u": np.ones(10)})
    assert read_recording(path).gaps == ((0, 5), (15, 5))
    with RecordWriter(path, header(20, columns={"u": "V"}), overwrite=True) as writer:
        writer.samples(5, {"u": np.ones(10)})
        writer.close("tripped")
    found = read_recording(path)
    assert (found.gaps, found.outcome, len(found)) == (((0, 5),), "tripped", 15)


def record_until(error: BaseException, path: Path) -> None:
    with RecordWriter(path, header(9, columns={"u": "V"})) as writer:
        writer.samples(0, {"u": np.ones(4)})
        raise error


def test_ctrl_c_and_faults_are_told_apart(tmp_path: Path) -> None:
    for error, outcome in ((KeyboardInterrupt(), "interrupted"), (OSError(), "failed")):
        path = tmp_path / f"{outcome}.mcap"
        with pytest.raises(type(error)):
            record_until(error, path)
        found = read_recording(path)
        assert (found.outcome, found.received, found.gaps) == (outcome, 4, ())


def test_a_sample_that_waits_is_written_without_another_call(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordWriter(path, header(columns={"u": "V"}))
    writer.samples(0, {"u": [1.5, 2.5]})
    assert len(read_recording(path)) == 0
    threading.Event().wait(1.0)
    found = read_recording(path)
    np.testing.assert_array_equal(found.columns["u"], [1.5, 2.5])
    assert found.outcome == "torn"
    writer.close()
    assert read_recording(path).outcome == "complete"


def test_messages_hold_a_hundred_samples_at_full_rate(made: Made) -> None:
    mcap = pytest.importorskip("mcap.reader")
    lengths = [
        len(json.loads(message.data)["index"])
        for _, _, message in mcap.make_reader(io.BytesIO(made.raw)).iter_messages(
            "/sewfast/samples"
        )
    ]
    assert sum(lengths) == 980
    assert max(lengths) == 100
    # one before the gap, one at the end
    assert sum(n < 50 for n in lengths) <= 2


def test_the_formats_own_reader_agrees(made: Made) -> None:
    mcap = pytest.importorskip("mcap.reader")
    stream_reader = pytest.importorskip("mcap.stream_reader")
    reader = mcap.make_reader(io.BytesIO(made.raw), validate_crcs=True)
    summary = reader.get_summary()
    assert {c.topic for c in summary.channels.values()} == {
        "/sewfast/header", "/sewfast/samples", "/sewfast/events", "/sewfast/completeness",
    }  # fmt: skip
    messages = list(reader.iter_messages())
    assert summary.statistics.message_count == len(messages) == summary.statistics.chunk_count
    assert summary.statistics.message_start_time == 1769860800 * 10**9
    for schema, channel, message in messages:
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        assert_valid(json.loads(message.data), json.loads(schema.data))
    stream = stream_reader.StreamReader(io.BytesIO(made.raw), validate_crcs=True)
    opcodes = [type(record).__name__ for record in stream.records]
    assert opcodes.count("Message") == len(messages)
    assert opcodes[-1] == "Footer"


def test_the_index_leads_to_every_chunk(made: Made) -> None:
    mcap = pytest.importorskip("mcap.reader")
    for index in mcap.make_reader(io.BytesIO(made.raw)).get_summary().chunk_indexes:
        assert made.raw[index.chunk_start_offset] == 6
        for channel, at in index.message_index_offsets.items():
            assert made.raw[at] == 7
            assert int.from_bytes(made.raw[at + 9 : at + 11], "little") == channel


def assert_valid(value: Any, schema: dict[str, Any]) -> None:
    """The part of JSON schema that the files use."""
    kinds = {
        "object": dict, "array": list, "string": str, "integer": int, "number": (int, float),
        "null": type(None),
    }  # fmt: skip
    if "type" in schema:
        names = [schema["type"]] if isinstance(schema["type"], str) else schema["type"]
        assert any(isinstance(value, kinds[name]) for name in names), (value, schema)
    for name in schema.get("required", ()):
        assert_valid(value[name], schema["properties"][name])
    for item in value if "items" in schema else ():
        assert_valid(item, schema["items"])


def test_times_are_those_of_the_samples(made: Made) -> None:
    mcap = pytest.importorskip("mcap.reader")
    start = 1769860800 * 10**9
    for _, _, message in mcap.make_reader(io.BytesIO(made.raw)).iter_messages("/sewfast/samples"):
        content = json.loads(message.data)
        assert message.publish_time == start + content["index"][0] * 10**6
        assert message.log_time == start + content["index"][-1] * 10**6
        assert content["t"] == [round(k * 0.001, 9) for k in content["index"]]


values = st.lists(
    st.one_of(
        st.floats(allow_infinity=False), st.integers(-(2**53), 2**53).map(float), st.just(-0.0)
    ),
    min_size=1,
    max_size=8,
)
names = st.text(min_size=1).filter(lambda name: fit_name(name))


@settings(max_examples=40, deadline=None)
@given(
    columns=st.dictionaries(names, values, min_size=1, max_size=3),
    pieces=st.lists(st.tuples(st.integers(0, 300), st.integers(1, 250)), max_size=5),
)
def test_any_columns_and_gaps_come_back(
    columns: dict[str, list[float]],
    pieces: list[tuple[int, int]],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("any") / "run.mcap"
    end = sum(map(sum, pieces))
    truth = {name: np.resize(values, end) for name, values in columns.items()}
    gaps, at = [], 0
    with RecordWriter(path, header(columns=dict.fromkeys(columns, ""))) as writer:
        for ahead, count in pieces:
            gaps += [(at, ahead)] if ahead else []
            at += ahead
            writer.samples(at, {name: v[at : at + count].copy() for name, v in truth.items()})
            for values in truth.values():
                values[at - ahead : at] = np.nan
            at += count
    found = read_recording(path)
    assert (found.gaps, found.damage) == (tuple(gaps), ())
    for name, values in truth.items():
        np.testing.assert_array_equal(found.columns[name], values)
        there = ~np.isnan(values)
        np.testing.assert_array_equal(
            np.signbit(found.columns[name][there]), np.signbit(values[there])
        )


def fit_name(name: str) -> bool:
    return bool(name.strip()) and name not in ("t", "index") and name.isprintable()


def test_whole_numbers_are_written_as_such() -> None:
    assert json.dumps(numbers("c", np.array([3.0, -4.0]))) == "[3, -4]"
    assert json.dumps(numbers("c", np.array([0.1, np.nan, 2], dtype=np.float32))) == (
        "[0.1, null, 2.0]"
    )


@pytest.mark.parametrize(
    ("columns", "first", "word"),
    [
        ({"u": [1.0]}, 0, "current"),
        ({"u": [1.0], "counts": [1], "current": [1.0], "x": [2]}, 0, "x"),
        ({"u": [1.0], "counts": [1, 2], "current": [1.0]}, 0, "one length"),
        ({"u": [[1.0]], "counts": [1], "current": [1.0]}, 0, "(1, 1)"),
        ({"u": [np.inf], "counts": [1], "current": [1.0]}, 0, "inf"),
        ({"u": ["1"], "counts": [1], "current": [1.0]}, 0, "u"),
        ({"u": [1.0], "counts": [2**60], "current": [1.0]}, 0, "2^53"),
        ({"u": [1.0], "counts": [1], "current": [1.0]}, -1, "-1"),
        ({"u": [1.0], "counts": [1], "current": [1.0]}, 1.5, "1.5"),
        ({"u": [1.0], "counts": [1], "current": [1.0]}, 10**9, "gaps of at most"),
    ],
)
def test_unusable_samples_are_refused_and_leave_the_file_alone(
    tmp_path: Path, columns: Any, first: Any, word: str
) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path, header()) as writer:
        with pytest.raises(DataError, match=re.escape(word)):
            writer.samples(first, columns)
        writer.samples(0, {"u": [1.0], "counts": [2], "current": [3.0]})
    found = read_recording(path)
    assert found.complete
    assert len(found) == 1


def test_a_sample_is_written_once(tmp_path: Path) -> None:
    with RecordWriter(tmp_path / "run.mcap", header(columns={"u": "V"})) as writer:
        writer.samples(0, {"u": np.ones(10)})
        with pytest.raises(DataError, match="from 10 on, received 9"):
            writer.samples(9, {"u": np.ones(10)})


def test_a_closed_recording_takes_nothing_more(tmp_path: Path) -> None:
    writer = RecordWriter(tmp_path / "run.mcap", header(columns={"u": "V"}))
    writer.close()
    writer.close()
    with pytest.raises(DataError, match="closed"):
        writer.samples(0, {"u": [1.0]})
    with pytest.raises(DataError, match="closed"):
        writer.event("late")


def test_an_event_that_json_does_not_know_is_refused(tmp_path: Path) -> None:
    with RecordWriter(tmp_path / "run.mcap", header()) as writer:
        with pytest.raises(SettingError, match="event 'odd'"):
            writer.event("odd", detail=object())
        with pytest.raises(SettingError, match="event 'odd'"):
            writer.event("odd", value=float("inf"))
        writer.event("even", value=np.float32(0.5), list=np.arange(2))
    assert read_recording(tmp_path / "run.mcap").events[0]["detail"] == {
        "value": 0.5,
        "list": [0, 1],
    }


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"name": 3}, "name"),
        ({"Ts": 0.0}, "Ts"),
        ({"Ts": True}, "Ts"),
        ({"Ts": float("nan")}, "Ts"),
        ({"Ts": 10**400}, "Ts"),
        ({"Ts": 1e-12}, "Ts: expected 1e-09 to 1e+06 s"),
        ({"name": "\ud800"}, "header"),
        ({"settings": {"a": "\ud800"}}, "settings"),
        ({"started": "9999-12-31T00:00:00+00:00"}, "started"),
        ({"columns": {}}, "columns"),
        ({"columns": {"t": "s"}}, "t"),
        ({"columns": {"u": 3}}, "u"),
        ({"columns": {f"c{k}": "" for k in range(300)}}, "256"),
        ({"n": -1}, "n:"),
        ({"n": 1.5}, "n:"),
        ({"counts_per_rev": 0}, "counts_per_rev"),
        ({"device": []}, "device"),
        ({"settings": {"Td": float("inf")}}, "settings"),
        ({"settings": {"x": "y" * 2_000_000}}, "at most"),
        ({"started": "yesterday"}, "started"),
        ({"started": "2026-01-31T12:00:00"}, "offset from UTC"),
    ],
)
def test_a_header_is_checked(change: dict[str, Any], word: str) -> None:
    with pytest.raises(SettingError, match=re.escape(word)):
        header(**change)


def test_a_header_does_not_change_with_its_sources() -> None:
    device = {"name": "virtual"}
    made = header(device=device)
    device["name"] = "other"
    assert made.device["name"] == "virtual"
    with pytest.raises(TypeError):
        made.columns["x"] = "V"  # type: ignore[index]
    assert Header.from_json(json.loads(made.encode())) == made
    assert header(started=STARTED.replace("+00:00", "Z")).start_ns() == made.start_ns()


def test_places_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_text("mine")
    with refuses(SettingError, expected="new name", received="kept"):
        RecordWriter(path, header())
    assert path.read_text() == "mine"
    for place in (tmp_path, tmp_path / "none" / "run.mcap"):
        with pytest.raises(DataError, match=re.escape(str(place))):
            RecordWriter(place, header())
        with pytest.raises(DataError, match=re.escape(str(place))):
            RecordWriter(place, header(), overwrite=True)


@pytest.mark.parametrize("ending", [".csv", ".npz", ".mat", ".parquet"])
def test_an_export_holds_the_same_values(made: Made, tmp_path: Path, ending: str) -> None:
    from sewfast.readers import read_table

    for needed in {".mat": ("scipy",), ".parquet": ("pyarrow",)}.get(ending, ()):
        pytest.importorskip(needed)
    out = tmp_path / f"run{ending}"
    export(made.path, out)
    table = read_table(out)
    np.testing.assert_array_equal(table["t"], np.round(np.arange(1000) * 0.001, 9))
    for name, column in made.columns.items():
        np.testing.assert_array_equal(table[name], column)
    if ending in (".csv", ".parquet"):
        assert (table.unit("u"), table.unit("counts"), table.unit("t")) == ("V", "", "s")


def test_an_export_with_one_message_a_sample_is_a_recording(made: Made, tmp_path: Path) -> None:
    out = tmp_path / "curves.mcap"
    export(made.path, out)
    found, whole = read_recording(out), read_recording(made.path)
    for name, column in whole.columns.items():
        np.testing.assert_array_equal(found.columns[name], column)
    assert (found.header, found.gaps, found.outcome) == (whole.header, whole.gaps, whole.outcome)
    assert list(map(dict, found.events)) == list(map(dict, whole.events))
    assert found.damage == ()
    mcap = pytest.importorskip("mcap.reader")
    reader = mcap.make_reader(io.BytesIO(out.read_bytes()), validate_crcs=True)
    rows = list(reader.iter_messages("/sewfast/samples"))
    assert len(rows) == 980
    for schema, _, message in rows:
        content = json.loads(message.data)
        assert_valid(content, json.loads(schema.data))
        assert message.log_time == 1769860800 * 10**9 + content["index"] * 10**6
    assert reader.get_summary().statistics.message_count == 980 + 2 + 2 + 1


def test_a_torn_recording_is_repaired_but_stays_torn(made: Made, tmp_path: Path) -> None:
    mcap = pytest.importorskip("mcap.reader")
    (tmp_path / "torn.mcap").write_bytes(made.raw[: len(made.raw) // 2])
    torn = export(tmp_path / "torn.mcap", tmp_path / "whole.mcap")
    found = read_recording(tmp_path / "whole.mcap")
    assert (found.outcome, found.damage, found.received) == ("torn", (), torn.received)
    with (tmp_path / "whole.mcap").open("rb") as file:
        assert mcap.make_reader(file).get_summary() is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["torn.mcap", "whole.mcap"]


def test_columns_are_saved_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    given = signals(250)
    save_columns(path, header(250), given)
    np.testing.assert_array_equal(read_recording(path).columns["u"], given["u"])
    with pytest.raises(DataError):
        save_columns(path, header(), {"u": np.ones(3)})
    assert read_recording(path).complete
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


@pytest.mark.nightly("an hour of samples")
def test_a_long_recording_needs_little_memory(tmp_path: Path) -> None:
    short, longer = (growth(tmp_path / f"{n}.mcap", n) for n in (20, 120))
    # 100,000 samples more, of the 3,600,000 of an hour at 1 kHz
    assert 36 * (longer - short) < 5_000_000


def growth(path: Path, blocks: int) -> int:
    """Bytes that a writer holds after a thousand samples for each block."""
    block = {"u": np.linspace(0, 1, 1000), "counts": np.arange(1000), "current": np.ones(1000)}
    tracemalloc.start()
    try:
        with RecordWriter(path, header()) as writer:
            for k in range(blocks):
                writer.samples(1000 * k, block)
            writer.close()
            return tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()


class Msvcrt:
    """The locks of Windows' C library as documented: of bytes from the present position on."""

    LK_NBLCK, LK_UNLCK = 2, 0

    def __init__(self) -> None:
        self.held: dict[tuple[int, int], int] = {}

    def locking(self, file: int, mode: int, count: int) -> None:
        assert count == 1
        place = os.fstat(file).st_ino, os.lseek(file, 0, os.SEEK_CUR)
        if mode == self.LK_UNLCK and self.held.get(place) == file:
            del self.held[place]
        elif mode == self.LK_NBLCK and place not in self.held:
            self.held[place] = file
        else:
            raise PermissionError(errno.EACCES, "Permission denied")


def test_a_recording_is_locked_where_only_windows_locks_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Msvcrt()
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", library)
    path = tmp_path / "run.mcap"
    with RecordWriter(path, header(10)) as out:
        assert len(library.held) == 1
        with pytest.raises(SettingError, match="nobody else writes"):
            RecordWriter(path, header(10), overwrite=True)
        out.samples(0, {name: values[:10] for name, values in signals(10).items()})
    assert library.held == {}
    assert len(read_recording(path)) == 10


@pytest.mark.nightly("a long recording")
def test_a_compressed_recording_is_smaller_and_the_same(tmp_path: Path) -> None:
    pytest.importorskip("zstandard", reason="needs the extra zstd")
    plain = make(tmp_path / "plain.mcap", 5000)
    packed = make(tmp_path / "packed.mcap", 5000, compress=True)
    assert len(packed.raw) < 0.6 * len(plain.raw)
    found, expected = read_recording(packed.path), read_recording(plain.path)
    assert (found.header, found.gaps, found.damage) == (expected.header, expected.gaps, ())
    for name, column in expected.columns.items():
        np.testing.assert_array_equal(found.columns[name], column)
    small, large = tmp_path / "small.mcap", tmp_path / "large.mcap"
    export(plain.path, small, compress=True)
    export(packed.path, large)
    assert small.stat().st_size < 0.5 * large.stat().st_size
    for name, column in expected.columns.items():
        np.testing.assert_array_equal(read_recording(small).columns[name], column)
        np.testing.assert_array_equal(read_recording(large).columns[name], column)
    with refuses(SettingError, name="compress"):
        export(plain.path, tmp_path / "run.csv", compress=True)


def test_a_recording_that_another_program_has_compressed_is_read(
    made: Made, tmp_path: Path
) -> None:
    """As `mcap compress` does: all topics together in chunks of its own size."""
    pytest.importorskip("zstandard", reason="needs the extra zstd")
    reader = pytest.importorskip("mcap.reader").make_reader(io.BytesIO(made.raw))
    own = pytest.importorskip("mcap.writer")
    path = tmp_path / "packed.mcap"
    with path.open("wb") as file:
        writer = own.Writer(file, chunk_size=20_000, compression=own.CompressionType.ZSTD)
        writer.start()
        summary = reader.get_summary()
        for number, schema in sorted(summary.schemas.items()):
            assert writer.register_schema(schema.name, schema.encoding, schema.data) == number
        for number, channel in sorted(summary.channels.items()):
            given = (channel.topic, channel.message_encoding, channel.schema_id)
            assert writer.register_channel(*given) == number
        for _, channel, message in reader.iter_messages(log_time_order=False):
            writer.add_message(
                channel.id, message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    found = read_recording(path)
    for name, column in made.columns.items():
        np.testing.assert_array_equal(found.columns[name], column)
    assert (found.gaps, found.outcome) == (made.gaps, "complete")


def test_constant_columns_come_back(tmp_path: Path) -> None:
    """They are packed so well that a reader could not tell them from a file made to be large."""
    pytest.importorskip("zstandard", reason="needs the extra zstd")
    columns = {f"a channel with a name, number {k}": np.zeros(3000) for k in range(250)}
    made = header(3000, columns=dict.fromkeys(columns, "1"))
    plain, curves = tmp_path / "run.mcap", tmp_path / "curves.mcap"
    with RecordWriter(plain, made, compress=True) as writer:
        writer.samples(0, columns)
    export(plain, curves, compress=True)
    for path in (plain, curves):
        found = read_recording(path)
        assert found.complete
        assert not np.any(list(found.columns.values()))


def test_without_the_package_it_is_named(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = make(tmp_path / "run.mcap", compress=True)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    for refused in (
        lambda: RecordWriter(tmp_path / "new.mcap", header(), compress=True),
        lambda: export(made.path, tmp_path / "new.mcap", compress=True),
        lambda: read_recording(packed.path),
    ):
        with refuses(SettingError, name="zstandard", remedy=r"sewfast\[zstd\]"):
            refused()
    assert not (tmp_path / "new.mcap").exists()
    # what the recording is of can be read, so that it is not replaced
    assert read_header(packed.path) == header(1000)
