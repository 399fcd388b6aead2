"""Recording files that were damaged: nothing false is read, what is whole is read."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import textwrap
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from effort import FULL
from recordings_made import Made, header, make
from refusals import refuses
from sewfast.errors import DataError
from sewfast.recordfile import RecordedFile, RecordWriter, read_recording
from sewfast.recordfile.format import Assembler, Message, Topic, opening
from sewfast.recordfile.reader import decode_recording
from sewfast.recordfile.writer import _groups

resource = pytest.importorskip("resource", reason="limits a file's size as POSIX systems can")


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "zstd"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    if request.param:
        pytest.importorskip("zstandard", reason="needs the extra zstd")
    return make(tmp_path_factory.mktemp("made") / "run.mcap", compress=request.param)


@pytest.fixture(scope="module")
def whole(made: Made) -> RecordedFile:
    return read_recording(made.path)


def decode(raw: bytes) -> RecordedFile:
    return decode_recording(Path("damaged.mcap"), raw)


def assert_nothing_false(found: RecordedFile, whole: RecordedFile) -> None:
    """Every value is the one that was written, or NaN in a gap that is listed."""
    assert found.header == whole.header
    assert found.outcome in (whole.outcome, "torn")
    assert len(found) <= len(whole)
    missing = np.zeros(len(found), dtype=bool)
    for first, count in found.gaps:
        missing[first : first + count] = True
    for name, column in whole.columns.items():
        expected = np.where(missing, np.nan, column[: len(found)])
        np.testing.assert_array_equal(found.columns[name], expected)
    kinds = [e["kind"] for e in found.events]
    assert set(kinds) <= {e["kind"] for e in whole.events}
    assert len(kinds) == len(set(kinds))


@pytest.mark.nightly("flips every bit", by_day=["zstd"])
def test_every_flipped_bit_is_found(made: Made, whole: RecordedFile) -> None:
    random = np.random.default_rng(1)
    for bit in random.integers(0, 8 * len(made.raw), 10_000 if FULL else 500):
        raw = bytearray(made.raw)
        raw[bit // 8] ^= 1 << bit % 8
        found = decode(bytes(raw))
        assert_nothing_false(found, whole)
        assert found.damage, bit
        # one flip costs at most one message
        assert whole.received - found.received <= 100


@pytest.mark.nightly("flips every bit")
def test_every_bit_of_the_structure_counts(made: Made, whole: RecordedFile) -> None:
    """All bits outside of the JSON: opcodes, lengths, checksums, index."""
    heads = structure(made.raw)
    for byte in heads if FULL else heads[::41]:
        for bit in range(8):
            raw = bytearray(made.raw)
            raw[byte] ^= 1 << bit
            found = decode(bytes(raw))
            assert_nothing_false(found, whole)
            assert found.damage, (byte, bit)


def structure(raw: bytes) -> list[int]:
    """Offsets of all bytes in front of, between and behind the chunks' contents."""
    found, at = list(range(8)), 8
    while at < len(raw) - 8:
        opcode, length = struct.unpack_from("<BQ", raw, at)
        size = 9 + length
        found += range(at, at + min(size, 80 if opcode == 6 else size))
        at += size
    return found + list(range(len(raw) - 8, len(raw)))


@pytest.mark.parametrize("kind", ["cut out", "put in", "zeroed", "repeated"])
def test_damage_of_any_size(made: Made, whole: RecordedFile, kind: str) -> None:
    random = np.random.default_rng(2)
    for _ in range(500 if FULL else 60):
        a, b = sorted(random.integers(0, len(made.raw), 2).tolist())
        noise = random.integers(0, 256, b - a, dtype=np.uint8).tobytes()
        middle = {"cut out": b"", "put in": noise, "zeroed": bytes(b - a)}.get(
            kind, 2 * made.raw[a:b]
        )
        try:
            found = decode(made.raw[:a] + middle + made.raw[b:])
        except DataError:
            # both copies of the header are gone
            assert a < 6000
            continue
        assert_nothing_false(found, whole)
        assert found.damage or a == b


def test_a_torn_tail_costs_what_is_torn(made: Made, whole: RecordedFile) -> None:
    random = np.random.default_rng(3)
    offsets = range(len(made.raw)) if FULL else boundaries(made.raw)
    received = 0
    for cut in sorted({*offsets, *random.integers(0, len(made.raw), 200).tolist()}):
        try:
            found = decode(made.raw[:cut])
        except DataError:
            assert received == 0
            continue
        assert_nothing_false(found, whole)
        assert found.damage
        assert found.received >= received
        received = found.received
        assert cut < len(made.raw) - 3000 or found.outcome == "complete" or found.received == 980
    assert received == 980


def boundaries(raw: bytes) -> list[int]:
    found, at = [8], 8
    while at < len(raw) - 8:
        at += 9 + struct.unpack_from("<Q", raw, at + 1)[0]
        found += [at - 1, at, at + 1]
    return found


def test_a_file_without_header_is_refused_by_name(made: Made, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(
        made.raw[:8] + made.raw[8:].replace(b"sewfast.recording", b"another.recording")
    )
    with pytest.raises(DataError, match=r"run\.mcap.*/sewfast/header"):
        read_recording(path)
    path.write_bytes(b"t,u\n0,1\n")
    with pytest.raises(DataError, match=r"run\.mcap.*another kind"):
        read_recording(path)
    with pytest.raises(DataError, match="folder"):
        read_recording(tmp_path)
    with refuses(DataError, received="No such file"):
        read_recording(tmp_path / "none.mcap")


class Forged:
    """A file whose checksums hold although its contents are made up."""

    def __init__(self, columns: dict[str, str], **changes: object) -> None:
        made = header(columns=columns, **changes)
        self._assembler = Assembler(columns)
        self.raw = opening()
        self.add(Topic.HEADER, made.encode(), leading=True)

    def add(self, topic: Topic, data: bytes, *, leading: bool = False) -> None:
        message = Message(topic, 0, 0, data)
        self.raw += self._assembler.chunk([message], len(self.raw), leading=leading)


GOOD = {"index": [0, 1], "t": [0.0, 0.001], "u": [1.5, 2.5]}


@pytest.mark.parametrize(
    "content",
    [
        b"", b"[]", b"{", b"null", b"\xff\xfe", b"[" * 100_000, b'{"index":' + b"9" * 10_000 + b"}",
        *(json.dumps({**GOOD, **change}).encode() for change in (
            {"index": []}, {"index": [1, 0]}, {"index": [0, 0]}, {"index": [-1, 0]},
            {"index": [0, 1, 2]}, {"index": [0, 2**60]}, {"index": [0.5, 1]}, {"index": [True, 2]},
            {"index": None}, {"u": [1.0]}, {"u": ["1", "2"]}, {"u": [True, False]}, {"u": 1},
            {"u": [[1], [2]]}, {"u": [10**400, 1]}, {"u": [float("inf"), 1]},
            {"u": [float("nan"), 1]}, {"index": [5, 2**52]}, {"index": [2**50, 2**50 + 1]},
        )),
        b'{"index":[0,1],"t":[0,1],"u":[1e999,1]}',
    ],
)  # fmt: skip
def test_contents_that_make_no_sense_are_left_out(content: bytes) -> None:
    forged = Forged({"u": "V"})
    forged.add(Topic.SAMPLES, content)
    forged.add(Topic.EVENTS, content)
    forged.add(Topic.COMPLETENESS, content)
    forged.add(Topic.SAMPLES, json.dumps({**GOOD, "index": [10, 11]}).encode())
    found = decode(forged.raw)
    np.testing.assert_array_equal(found.columns["u"], [np.nan] * 10 + [1.5, 2.5])
    assert found.gaps == ((0, 10),)
    assert sum("is left out" in text for text in found.damage) == 3
    assert found.outcome == "torn"


@pytest.mark.parametrize(
    "account",
    [
        {"outcome": "complete", "received": 2, "end": 2**50},
        {"outcome": "complete", "received": 2**50, "end": 2},
        {"outcome": "complete", "received": 2, "end": 1},
    ],
)
def test_an_account_that_does_not_fit_is_damage(account: dict[str, object]) -> None:
    forged = Forged({"u": "V"})
    forged.add(Topic.SAMPLES, json.dumps(GOOD).encode())
    forged.add(Topic.COMPLETENESS, json.dumps(account).encode())
    found = decode(forged.raw)
    assert len(found) == 2
    assert any(str(account["end"]) in d or str(account["received"]) in d for d in found.damage)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)
KEYS = st.sampled_from(
    ["index", "t", "u", "kind", "detail", "elapsed", "outcome", "received", "end", "gaps", "name",
     "Ts", "columns", "n", "counts_per_rev", "device", "settings", "started"]
)  # fmt: skip


@settings(max_examples=2000 if FULL else 60, deadline=None)
@given(
    topics=st.lists(st.tuples(st.sampled_from(Topic), st.dictionaries(KEYS, JSON)), max_size=4),
    change=st.dictionaries(KEYS, JSON, max_size=2),
)
def test_no_content_makes_the_reader_fail(
    topics: list[tuple[Topic, dict[str, object]]], change: dict[str, object]
) -> None:
    """Whatever the messages hold: a recording that can be printed and exported, or a refusal."""
    forged = Forged({"u": "V"})
    forged.raw = opening()
    first = {**json.loads(header(columns={"u": "V"}).encode()), **change}
    for topic, content in [(Topic.HEADER, first), (Topic.SAMPLES, GOOD), *topics]:
        forged.add(topic, json.dumps(content).encode())
    try:
        found = decode(forged.raw)
    except DataError:
        return
    str(found).encode()
    assert all(np.isfinite(c[c == c]).all() for c in found.columns.values())
    assert sum(len(list(group)) for group in _groups(found)) >= 3


@settings(max_examples=2000 if FULL else 60, deadline=None)
@given(st.binary(), st.binary(max_size=300))
def test_no_bytes_make_the_reader_fail(made: Made, junk: bytes, tail: bytes) -> None:
    with pytest.raises(DataError):
        decode(junk)
    whole = decode(made.raw + tail)
    assert whole.received == 980
    assert (whole.damage == ()) == (tail == b"")
    at = len(made.raw) // 2
    assert decode(made.raw[:at] + tail + made.raw[at:]).received >= 880


def test_a_file_cannot_steer_the_terminal(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path, header(device={"name": "\x1b[2J\n"})) as writer:
        writer.event("a\x07")
    assert read_recording(path).header.device["name"] == "\\x1b[2J\n"
    assert "name: \\x1b[2J\\n" in str(read_recording(path))
    assert "\x07" not in str(read_recording(path))


def test_repeated_samples_are_left_out() -> None:
    forged = Forged({"u": "V"})
    forged.add(Topic.SAMPLES, json.dumps(GOOD).encode())
    forged.add(Topic.SAMPLES, json.dumps({**GOOD, "u": [7.0, 8.0]}).encode())
    found = decode(forged.raw)
    np.testing.assert_array_equal(found.columns["u"], [1.5, 2.5])
    assert "sample 0 follows sample 1" in found.damage[0]


def test_oversized_lengths_take_no_memory(made: Made) -> None:
    records = boundaries(made.raw)[1:-3:3]
    tracemalloc.start()
    for at in [8, *(b + 1 for b in records[:10])]:
        for size in (2**32, 2**40, 2**63, 2**64 - 1):
            raw = bytearray(made.raw)
            raw[at + 1 : at + 9] = struct.pack("<Q", size)
            assert decode(bytes(raw)).damage
    body = b"x" * 100
    head = struct.pack("<BQQQQIIQ", 6, 2**40 + 40, 0, 0, 2**40, zlib.crc32(body), 0, 2**40)
    assert decode(made.raw[:-8] + head + body).damage
    assert tracemalloc.get_traced_memory()[1] < 20 * len(made.raw)
    tracemalloc.stop()


def test_a_header_that_asks_for_too_much_is_refused() -> None:
    forged = Forged({"u": "V"})
    raw = forged.raw.replace(b'"version": 1', b'"version": 2')
    with pytest.raises(DataError):
        decode(raw)
    newer = Forged({"u": "V"})
    newer.raw = opening()
    content = json.loads(header(columns={"u": "V"}).encode())
    newer.add(Topic.HEADER, json.dumps({**content, "version": 2}).encode(), leading=True)
    with pytest.raises(DataError, match="newer sewfast"):
        decode(newer.raw)


_FULL = """
    import resource, sys
    import numpy as np
    from sewfast.errors import DataError
    from sewfast.recordfile import Header, RecordWriter
    header = Header("x", 0.001, {"u": "V"}, n=100_000)
    written = 0
    try:
        with RecordWriter(sys.argv[1], header) as writer:
            if len(sys.argv) > 2:
                resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
            for k in range(0, 100_000, 10):
                writer.samples(k, {"u": np.arange(k, k + 10) / 3})
                written = k + 10
    except DataError as e:
        print(written, e)
"""


def write_until_full(path: Path, *limit: int) -> tuple[int, str]:
    code = textwrap.dedent(_FULL)
    done = subprocess.run(
        [sys.executable, "-c", code, str(path), *map(str, limit)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    count, _, message = done.stdout.partition(" ")
    return int(count), message


def assert_whole_up_to(path: Path, written: int, message: str) -> None:
    found = read_recording(path)
    assert str(path) in message
    assert f"whole up to sample {len(found)} " in message
    assert 0 < len(found) <= written + 10
    np.testing.assert_array_equal(found.columns["u"], np.arange(len(found)) / 3)
    assert (found.outcome, found.gaps) == ("torn", ())
    assert found.damage == ("the end is missing",)


@pytest.mark.parametrize("limit", [20_000, 20_001, 65_536, 100_003])
def test_a_file_that_may_not_grow_is_whole_up_to_there(tmp_path: Path, limit: int) -> None:
    path = tmp_path / "run.mcap"
    written, message = write_until_full(path, limit)
    assert 0 < path.stat().st_size <= limit
    assert_whole_up_to(path, written, message)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to mount a small disk")
def test_a_full_disk_leaves_what_was_written(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "sewfast-test", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("this system lets nobody mount a small disk")
    try:
        written, message = write_until_full(disk / "run.mcap")
        assert "No space left" in message
        assert_whole_up_to(disk / "run.mcap", written, message)
        (disk / "rest").write_bytes(b"x" * (256 * 1024 - sum(
            p.stat().st_blocks * 512 for p in disk.iterdir())))  # fmt: skip
        with pytest.raises(DataError, match="No space left"):
            RecordWriter(disk / "second.mcap", header())
        assert not (disk / "second.mcap").exists()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_read_only_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o500)
    user = os.geteuid()
    try:
        if user == 0:
            # root may write everywhere, nobody may not
            os.seteuid(65534)
        with pytest.raises(DataError, match="Permission denied"):
            RecordWriter(folder / "run.mcap", header())
    finally:
        os.seteuid(user)


def record_on(writer: RecordWriter) -> None:
    """The thread that writes takes its time until it says that it cannot."""
    for k in range(100, 10_000):
        time.sleep(0.001)
        writer.samples(k, {"u": [1.0]})


def test_a_failed_writer_stays_failed(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    path = tmp_path / "run.mcap"
    writer = RecordWriter(path, header(columns={"u": "V"}))
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 100, hard))
        writer.samples(0, {"u": np.ones(100) / 3})
        with pytest.raises(DataError, match="whole up to sample 0"):
            record_on(writer)
        for call in (lambda: writer.samples(20_000, {"u": [1.0]}), lambda: writer.event("x")):
            with pytest.raises(DataError, match="whole up to sample 0"):
                call()
        with pytest.raises(DataError, match="whole up to sample 0"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    writer.close()
    assert read_recording(path).outcome == "torn"
