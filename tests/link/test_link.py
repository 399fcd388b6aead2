"""The link's frames and the host's receiver against an implementation that shares no code."""

from __future__ import annotations

import json
import random
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sewfast import _core
from sewfast.errors import SettingError

GOLDEN = Path(__file__).parents[1] / "golden"
sys.path.insert(0, str(GOLDEN))

import link_frames as golden  # noqa: E402

FRAMES = st.tuples(
    st.integers(0, 2**8 - 1),
    st.integers(0, 2**16 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**64 - 1),
    st.binary(max_size=golden.MAX_BODY),
)
COUNTS_AND_U = [(0, 1), (1, 1000)]


@pytest.fixture(scope="module")
def vectors() -> dict[str, Any]:
    return json.loads((GOLDEN / "link_frames.json").read_text())


def batch(sequence: int, first: int, count: int = 10, *, tag: int = 7) -> bytes:
    """A SAMPLES frame on the wire whose counts are the numbers of its samples."""
    rows = [(first + k, (first + k) % 1000) for k in range(count)]
    body = golden.samples_body(0, [0, 1], rows)
    return golden.wire(0xC0, tag, sequence, 1000 * first, body)


def expecting() -> _core.LinkReceiver:
    receiver = _core.LinkReceiver()
    receiver.expect(COUNTS_AND_U, 1000)
    return receiver


def test_the_files_are_what_the_generator_writes(vectors):
    assert vectors == json.loads(json.dumps(golden.document()))
    assert (GOLDEN / "link_frames.txt").read_text() == golden.lines()


def test_the_vectors_keep_to_the_layout(vectors):
    for row in vectors["frames"]:
        body, frame, wire = (bytes.fromhex(row[name]) for name in ("body", "frame", "wire"))
        assert len(frame) == 19 + len(body) <= 250
        assert len(wire) == len(frame) + 2
        assert wire.find(0) == len(wire) - 1
        fields = (row["kind"], row["tag"], row["sequence"], int(row["time"]), body)
        assert list(golden.frames(wire)) == [fields]
        assert _core.link_frame(*fields) == wire


def test_sample_vectors_decode_to_their_rows(vectors):
    for k, case in enumerate(vectors["samples"]):
        receiver = _core.LinkReceiver()
        receiver.expect([tuple(channel) for channel in case["channels"]], 250)
        body = bytes.fromhex(case["body"])
        assert receiver.feed(_core.link_frame(0xC0, 1, k, 2**40, body)) == []
        times, columns = receiver.take()
        rows = np.array(case["rows"], float)
        scale = [steps if encoding == 1 else 1 for encoding, steps in case["channels"]]
        assert times.tolist() == [2**40 + 250 * k for k in range(len(rows))]
        np.testing.assert_array_equal(np.stack(columns, axis=1), rows / scale)
        assert receiver.counters["clipped"] == case["flags"] & 1
        assert receiver.counters["overflows"] == case["flags"] >> 1


@given(FRAMES)
def test_frames_are_those_of_the_reference_and_come_back(fields):
    wire = _core.link_frame(*fields)
    assert wire == golden.wire(*fields)
    assert list(golden.frames(wire)) == [fields]
    received = _core.LinkReceiver().feed(wire)
    assert received == ([fields] if fields[0] & 0x80 else [])


def test_a_long_body_or_an_unknown_encoding_is_refused_with_a_remedy():
    with pytest.raises(SettingError, match="at most 231 bytes, got 232; split"):
        _core.link_frame(1, 0, 0, 0, bytes(232))
    with pytest.raises(SettingError, match="0 to 2, got 3; the device may need"):
        _core.LinkReceiver().expect([(3, 1)], 1000)
    with pytest.raises(SettingError, match="1 to 16 streamed channels, got 0"):
        _core.LinkReceiver().expect([], 1000)
    with pytest.raises(SettingError, match="at least 1 us, got 0"):
        _core.LinkReceiver().expect(COUNTS_AND_U, 0)


def test_without_expectation_samples_come_out_as_frames():
    receiver = _core.LinkReceiver()
    assert [frame[0] for frame in receiver.feed(batch(0, 0))] == [0xC0]
    times, columns = receiver.take()
    assert (len(times), columns) == (0, [])


def test_everything_that_goes_wrong_is_counted_and_listed():
    receiver = expecting()
    frames = [batch(k, 10 * k) for k in range(10)]
    damaged = frames[6][:30] + bytes([frames[6][30] ^ 0x41 or 1]) + frames[6][31:]
    delivered = [*frames[0:2], frames[1], *frames[4:6], damaged, frames[7], frames[3]]
    reset = [batch(2, 500, tag=8), batch(3, 510, tag=8)]
    assert receiver.feed(b"".join(delivered + reset)) == []
    assert receiver.anomalies() == [
        ("repeated", 1, 1),
        ("missing", 2, 2),
        ("rejected", 6, 1),
        ("missing", 6, 1),
        ("late", 3, 1),
        ("reset", 2, 2),
    ]
    assert receiver.anomalies() == []
    counters = receiver.counters
    assert (counters["frames"], counters["samples"]) == (9, 70)
    assert (counters["missing"], counters["repeated"], counters["late"]) == (3, 1, 1)
    assert (counters["rejected"], counters["resets"], counters["unlisted"]) == (1, 1, 0)
    times, columns = receiver.take()
    used = [10 * k + j for k in (0, 1, 4, 5, 7, 50, 51) for j in range(10)]
    assert columns[0].tolist() == used
    assert times.tolist() == [1000 * k for k in used]
    assert [len(receiver.take()[0]), receiver.counters["samples"]] == [0, 70]


def in_order(received: list[golden.Frame]) -> list[golden.Frame]:
    """What of these frames a receiver may use, by PROTOCOL's rule in its plainest form."""
    used: list[golden.Frame] = []
    for frame in received:
        if not used or (frame[2] - used[-1][2]) % 2**32 in range(1, 2**31):
            used.append(frame)
    return used


@given(
    st.lists(
        st.one_of(
            FRAMES.map(lambda fields: golden.wire(fields[0] | 0x80, 5, *fields[2:])),
            st.binary(max_size=60),
            st.integers(0, 30).map(lambda k: batch(k, 10 * k, tag=5)[:-3]),
            st.just(b"\0"),
        ),
        max_size=12,
    ),
    st.lists(st.integers(1, 90), min_size=1, max_size=5),
)
def test_hostile_streams_give_what_the_reference_gives(pieces, cuts):
    stream = b"".join(pieces)
    receiver, received, at, k = _core.LinkReceiver(), [], 0, 0
    while at < len(stream):
        received += receiver.feed(stream[at : at + cuts[k % len(cuts)]])
        at, k = at + cuts[k % len(cuts)], k + 1
    whole = [frame for frame in golden.frames(stream) if frame[0] & 0x80]
    assert received == in_order(whole)
    assert receiver.counters["frames"] == len(whole)


def mutated(dice: random.Random, wire: bytes) -> bytes:
    at = dice.randrange(len(wire))
    match dice.randrange(6):
        case 0:
            return wire[:at] + bytes([wire[at] ^ 1 << dice.randrange(8)]) + wire[at + 1 :]
        case 1:
            return wire[:at]
        case 2:
            return wire[:at] + dice.randbytes(dice.randrange(1, 5)) + wire[at:]
        case 3:
            return wire[:at] + wire[at + dice.randrange(1, 4) :]
        case 4:
            return dice.randbytes(dice.randrange(1, 80))
        case _:
            return wire[:at] + wire


def numbered(sequence: int) -> bytes:
    return batch(sequence, 3 * sequence % 30_000, 3)


def test_1e5_mutated_frames_bring_no_wrong_sample_and_lose_none_unlisted():
    dice, receiver = random.Random(3), expecting()
    receiver.feed(numbered(0))
    sequence, used, missing = 1, 0, 0
    for _ in range(5_000):
        stream = [mutated(dice, numbered(sequence + k)) for k in range(20)]
        # the first whole frame may be joined to what stands before it; the second is in step
        stream += [numbered(sequence + k) for k in (20, 21)]
        sequence += 22
        assert receiver.feed(b"".join(stream)) == []
        times, (counts, u) = receiver.take()
        assert counts[-3:].tolist() == [3 * (sequence - 1) % 30_000 + k for k in range(3)]
        np.testing.assert_array_equal(times, 1000 * counts.astype(np.int64))
        np.testing.assert_array_equal(np.round(1000 * u), counts % 1000)
        used += len(counts) // 3
        missing += sum(count for kind, _, count in receiver.anomalies() if kind == "missing")
    assert used + missing == sequence
    assert receiver.counters["missing"] == missing
    assert receiver.counters["unlisted"] == 0
    assert used > 5_000


def test_a_frame_from_a_host_is_an_echo_and_no_frame_of_the_device():
    receiver = _core.LinkReceiver()
    keep = _core.link_frame(0x20, 7, 3, 0, struct.pack("<I", 50_000))
    assert receiver.feed(keep) == []
    assert receiver.anomalies() == [("echoed", 3, 1)]
    assert receiver.counters["frames"] == 0


# --- bodies: the core's beside struct, which shares no code with it -------------------------------

U8, U16, U32, U64 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64))
SINGLE = st.floats(width=32, allow_nan=False)
TEXT = st.text(max_size=10)


@given(U8, U16, U32, U32, U64, SINGLE, st.binary(max_size=200))
def test_a_commands_body_is_its_fields_one_after_the_other(byte, short, a, b, long, u, values):
    bodies = _core.LinkBodies
    assert bodies.hello(a) == struct.pack("<BBI", 3, 4, a)
    moves = golden.position(31, 1, 8)
    rows = [struct.unpack_from("<3f", moves, 19 + 12 * k) for k in range(8)]
    assert bodies.position((30.0, 3000.0, 12.0, 60.0), 31, True, rows) == moves
    assert bodies.angle(a, u, False) == struct.pack("<IfB", a, u, 1)
    assert bodies.travel(-short, short) == struct.pack("<ii", -short, short)
    assert bodies.travel_of(struct.pack("<4i", -short, short, -7, 7)) == [-short, short, -7, 7]
    assert bodies.arm(a, b) == struct.pack("<II", a, b)
    assert bodies.keep(a) == struct.pack("<I", a)
    assert bodies.drive(a, u) == struct.pack("<If", a, u)
    assert bodies.credit(a, long) == struct.pack("<IQ", a, long)
    assert bodies.limits((u, 1.0, 2.0, 3.0)) == struct.pack("<4f", u, 1.0, 2.0, 3.0)
    assert bodies.upload(byte, a, values) == struct.pack("<BI", byte, a) + values
    told = struct.pack("<BIQIHB", byte, a, long, b, short, 7)
    assert bodies.start(byte, a, long, b, short, 7) == told
    assert bodies.host_time(a, long) == a << 32 | long & 0xFFFFFFFF


@given(st.tuples(*[SINGLE] * 12), U8, SINGLE, st.lists(st.tuples(*[SINGLE] * 4), max_size=8))
def test_gains_are_followed_by_what_a_device_may_not_know(values, samples, u, points):
    bodies, gains = _core.LinkBodies, struct.pack("<12fB", *values, samples)
    assert bodies.gains(values, samples) == gains
    rows = b"".join(struct.pack("<4f", *point) for point in points)
    design = struct.pack("<ffB", u, np.inf, len(points)) + rows
    assert bodies.gains(values, samples, (u, np.inf, points)) == gains + design
    assert bodies.biquads(points) == bytes([len(points)]) + rows


def test_a_body_that_no_frame_holds_is_refused():
    with pytest.raises(SettingError, match="expected a body of at most 231 bytes"):
        _core.LinkBodies.upload(0, 0, bytes(227))
    for wrong in (-1, 2**32):
        with pytest.raises(OverflowError):
            _core.LinkBodies.keep(wrong)


@given(U8, U16, U32, U64, SINGLE, TEXT, TEXT)
def test_a_reply_is_read_field_by_field(byte, short, a, long, u, name, unit):
    bodies = _core.LinkBodies

    def text(value):
        raw = value.encode()
        return bytes([len(raw)]) + raw

    assert bodies.reply(struct.pack("<IB", a, byte) + b"rest") == (a, byte, b"rest")
    greeting = struct.pack("<BIIBBIIIf", byte, a, 1, 2, 3, 4, 5, 6, u) + text(name) + text(unit)
    told = (name, unit, byte, a, 1, 2, 3, 4, 5, 6, u)
    assert bodies.greeting(greeting + struct.pack("<II", 7, a)) == (told, 7, a)
    description = struct.pack("<BBI", byte, 1, a) + text(name) + text(unit)
    assert bodies.description(description) == (byte, 1, a, name, unit)
    fields = (byte, 1, 2, short, a, long, 3, 4, 5, u, -6, 7, 8, 9, 10, 11, 12)
    status = struct.pack("<BBBHIQIIIfiIIIIII", *fields)
    assert bodies.status(status) == (fields[:9], fields[9:])
    assert bodies.limits_of(struct.pack("<8f", u, *range(7))) == [u, *range(7)]
    assert bodies.started(struct.pack("<IQ", a, long)) == (a, long)
    assert bodies.uploaded(struct.pack("<II", a, 5)) == (a, 5)
    event = struct.pack("<BBBIIf", byte, 1, 2, a, 4, u)
    assert bodies.event(event) == (byte, 1, 2, a, 4, u)
    assert bodies.event(event + b"\0") is None
    for read, body in (
        (bodies.greeting, greeting), (bodies.description, description), (bodies.status, status),
        (bodies.event, event), (bodies.started, event), (bodies.limits_of, event),
    ):  # fmt: skip
        for size in range(0, 8):
            assert read(body[:size]) is None


@given(U8, U32, st.lists(st.binary(max_size=40), max_size=16))
def test_the_schema_is_the_crc_of_all_descriptions(version, period, replies):
    told = struct.pack("<BI", version, period) + b"".join(replies)
    assert _core.LinkBodies.schema(version, period, replies) == zlib.crc32(told)
