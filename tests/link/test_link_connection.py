"""A session with a device: commands executed once, refusals that teach, hostile bytes."""

from __future__ import annotations

import gc
import random
import struct
import sys
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_link_drive import Kept

import link_device as script
from effort import FULL
from link_device import golden
from link_simulated import SimulatedPort, driven, linked, simulated
from refusals import refuses
from sewfast import _core
from sewfast.errors import LinkError, SewfastError
from sewfast.link import Plan, connect, wire
from sewfast.link.wire import Kind

NOTHING = (HealthCheck.too_slow,)


# --- greeting -----------------------------------------------------------------------------------


def test_a_device_is_known_by_its_greeting():
    with simulated() as (_, port):
        drive = driven(port)
        identity = drive.identity
        assert (identity.name, identity.firmware, identity.version) == ("script", "1.0", 3)
        assert (identity.boot, identity.tag) == (0x1BEEF, 0xBEEF)
        assert (identity.period_us, identity.Ts, identity.capacity) == (1000, 0.001, 512)
        assert identity.counts_per_rev == 1572.0
        assert not identity.on_credit
        assert identity.is_computed
        assert [c.name for c in drive.channels] == ["counts", "u", "r", "feedback", "speed_true"]
        assert [c.unit for c in drive.channels] == ["", "V", "RPM", "RPM", "RPM"]
        assert "script (firmware 1.0) on simulated" in str(drive)


def test_sessions_differ():
    with simulated() as (_, port):
        assert len({linked(port).session for _ in range(20)}) == 20


def test_a_greeting_to_another_host_is_not_taken():
    with simulated() as (device, port):
        kept = []
        device.mangle = lambda kind, wire: kept.append(wire) or [wire]
        before = linked(port)
        device.reset()
        device.mangle = lambda kind, wire: [wire]
        device.wire.out = b"".join(kept)
        link = linked(port)
        assert link.identity.session == link.session != before.session
        assert link.identity.boot == device.boot != before.identity.boot


def test_frames_carry_the_session_and_the_clock():
    with simulated() as (device, port):
        hello = commands(device, script.HELLO)
        link = linked(port)
        said = commands(device, script.ECHO)
        port._clock.now = 5000.0
        link.ask(Kind.ECHO, b"data")
        assert said[0][3] == link.session << 32 | 5_000_000_000 % 2**32
        assert hello[0][3] >> 32 == 0


def test_greeting_sets_and_moves_nothing():
    with simulated() as (device, port):
        linked(port)
        assert device.executed == []
        assert device.limits == (0.0,) * 4


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (b"", "HELLO within 1 s, received nothing; check cable"),
        (b"\x55\xaa" * 40, r"80 bytes that are not frames .*baud rate \(115200\)"),
    ],
)
def test_what_does_not_answer(answers, message):
    with simulated() as (device, port):
        device.intercept = lambda frame: True
        device.wire.out = answers
        with pytest.raises(LinkError, match=message):
            linked(port)


def test_a_line_that_only_echoes_is_told_apart():
    with simulated() as (device, port):
        device.hear = lambda data: device.wire.write(data) or b""
        with refuses(LinkError, received="only what was sent", remedy="connected to each other"):
            linked(port)


def test_a_device_that_boots_slowly_is_waited_for():
    with simulated() as (device, port):
        count = iter(range(100))
        device.intercept = lambda frame: next(count) < 7
        assert linked(port).identity.name == "script"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"hello_result": b"\x0a\x05\0\0\0"}, r"protocol version 5, sewfast 4; update the older"),
        ({"schema": 0x12345678}, r"match the device's schema hash"),
        ({"channels": 1}, r"2 to 16 channels"),
    ],
)
def test_a_device_that_speaks_otherwise(given, message):
    with simulated(**given) as (_, port), pytest.raises(LinkError, match=message):
        driven(port)


# --- commands -----------------------------------------------------------------------------------


def commands(device, kind):
    """Frames of one kind as they arrived."""
    seen = []
    before = device.intercept

    def keep(frame):
        if frame[0] == kind:
            seen.append(frame)
        return before(frame)

    device.intercept = keep
    return seen


def test_a_lost_command_is_repeated_unchanged():
    with simulated() as (device, port):
        link = linked(port)
        lose = iter([True, True])
        device.intercept = lambda frame: next(lose, False)
        seen = commands(device, script.ECHO)
        assert link.ask(Kind.ECHO, b"data") == b"data"
        assert len(seen) == 3
        assert len(set(seen)) == 1


def test_a_lost_reply_does_not_execute_the_command_again():
    with simulated() as (device, port):
        link = linked(port)
        lose = iter([[], []])
        device.mangle = lambda kind, wire: next(lose, [wire])
        assert link.ask(Kind.ECHO, b"data") == b"data"
        assert device.executed == [(script.ECHO, b"data")]


def test_replies_of_earlier_commands_and_repeats_are_not_used():
    with simulated() as (device, port):
        link = linked(port)
        kept = []
        device.mangle = lambda kind, wire: kept.append(wire) or [wire, wire]
        assert link.ask(Kind.ECHO, b"one") == b"one"
        device.mangle = lambda kind, wire: [kept[0], wire]
        assert link.ask(Kind.ECHO, b"two") == b"two"
        # a new frame that answers the command before
        old = struct.pack("<I", link.receiver.sequences[0]) + b"\0two"
        device.mangle = lambda kind, wire: [wire]
        device.send(0x8B, old)
        assert link.ask(Kind.ECHO, b"three") == b"three"


def test_a_command_without_an_answer_is_given_up_and_the_next_one_works():
    with simulated() as (device, port):
        link = linked(port)
        device.intercept = lambda frame: True
        seen = commands(device, script.STATUS)
        received = r"^nothing at all within 1(\.\d)? s of 1\d attempts"
        with refuses(LinkError, expected="answer to STATUS", received=received):
            link.status()
        assert 9 <= len(seen) <= 11
        device.intercept = lambda frame: False
        assert link.status().state == "idle"


def test_a_command_is_repeated_for_the_whole_watchdog_time():
    with simulated() as (device, port):
        link = linked(port, watchdog=5.0)
        device.intercept = lambda frame: True
        seen = commands(device, script.STOP)
        began = port._clock.now
        with refuses(LinkError, expected="answer to STOP", received="within 5 s"):
            link.stop()
        assert port._clock.now - began >= 5.0
        assert len(seen) >= 400


def test_what_else_came_is_said_where_an_answer_did_not():
    with simulated() as (device, port):
        link = linked(port)
        device.intercept = lambda frame: device.send(0xC3, b"said") or True
        with refuses(LinkError, received=r"1\d other frames", remedy="too busy"):
            link.status()


def test_a_stop_is_repeated_sooner():
    with simulated() as (device, port):
        link = linked(port)
        lose = iter([True, True, True])
        device.intercept = lambda frame: next(lose, False)
        began = port._clock.now
        link.stop()
        assert port._clock.now - began < 0.05


def test_the_status_is_read_field_by_field():
    body = struct.pack(
        "<BBBHIQIIIfiIIIIII", 4, 2, 1, 0x15, 7, 123_000, 50, 60, 55, -3.5, -9, 1, 2, 3, 44, 99, 6
    )
    found = wire.status(wire.Reply(3, 0, 0, body, 200_000))
    assert found == wire.Status(
        "tripped", "speed", 1, 0x15, 7, 123_000, 50, 60, 55, -3.5, -9, 1, 2, 3, 44, 99, 200_000, 6
    )


@pytest.mark.parametrize("result", [*range(1, 13), 77])
@pytest.mark.parametrize("kind", [*Kind][:11])
def test_each_refusal_says_what_to_do(kind, result):
    with pytest.raises(LinkError) as caught:
        wire.Reply(kind, result, 2, b"", 0).checked()
    error = caught.value
    assert (error.name, error.expected) == (kind.name, "a device that takes it")
    assert error.remedy or "unknown to" in str(error.received)


def test_a_refusal_names_the_field():
    def message(kind, result, detail):
        with pytest.raises(LinkError) as caught:
            wire.Reply(kind, result, detail, b"", 0).checked()
        return str(caught.value)

    assert "speed is beyond a limit" in message(Kind.LIMITS, 6, 1)
    assert "does not offer current; its limit is inf" in message(Kind.LIMITS, 8, 3)
    assert "does not offer mode; leave it out" in message(Kind.START, 8, 0)
    assert "batch is outside its range" in message(Kind.START, 3, 5)
    assert "value 7 is beyond a limit" in message(Kind.UPLOAD, 6, 7)
    assert "not while tripped; find out why, then clear" in message(Kind.ARM, 4, 4)
    assert "does not support the command" in message(0x0C, 1, 0x0C)


@given(st.sampled_from([*Kind][:11]), st.binary(max_size=60))
def test_a_reply_with_any_body_is_read_or_refused(kind, body):
    reply = wire.Reply(kind, 0, 0, body, 5)
    readers = {
        Kind.HELLO: wire.identity, Kind.DESCRIBE: wire.channel, Kind.LIMITS: wire.limits,
        Kind.UPLOAD: wire.uploaded, Kind.START: wire.started,
    }  # fmt: skip
    with suppress(LinkError):
        readers.get(kind, bytes)(reply.checked())
    with suppress(LinkError):
        wire.status(reply)


def test_what_single_precision_does_not_hold_is_infinite():
    assert struct.unpack("<4f", wire.set_limits((1e300, -1e300, 1.5, np.inf)))[:3] == (
        np.inf, -np.inf, 1.5,
    )  # fmt: skip
    assert struct.unpack("<If", _core.LinkBodies.drive(5, -1e39)) == (5, -np.inf)


@given(st.text(max_size=24))
def test_a_name_cannot_write_to_the_terminal(name):
    body = bytes([0, 2]) + struct.pack("<I", 1)
    text = name.encode("utf-8", "surrogatepass")
    found = wire.channel(body + bytes([len(text)]) + text + b"\0")
    assert found.name.isprintable()


# --- hostile bytes ------------------------------------------------------------------------------


class Hostile(SimulatedPort):
    """A device whose every frame is changed by dice, and bytes that nobody sent."""

    def __init__(self, device, clock, dice):
        self.dice = dice
        super().__init__(device, clock)

    def read(self, timeout):
        data = super().read(timeout)
        return mutated(data, self.dice) if data else data


def mutated(data: bytes, dice: random.Random) -> bytes:
    """The same frames, with one of them made anew around other content in some."""
    blocks = data.split(b"\0")
    changed = []
    for block in blocks:
        way = dice.randrange(40)
        frame = golden.unstuffed(block) if way < 6 else None
        if frame and len(frame) >= 19:
            content = bytearray(frame[:-4])
            for _ in range(dice.randrange(1, 4)):
                content[dice.randrange(len(content))] = dice.choice((0, 1, 127, 128, 255))
            if way < 3:
                # the tag stays: another one is only a reset
                content[1:3] = frame[1:3]
            if way == 0:
                content = content[: dice.randrange(15, len(content) + 1)]
            block = golden.stuffed(bytes(content) + struct.pack("<I", golden.zlib.crc32(content)))
        elif way == 7:
            block = dice.randbytes(dice.randrange(300)).replace(b"\0", b"\1")
        elif way == 8:
            block = block + b"\0" + block
        changed.append(block)
    return b"\0".join(changed)


@settings(max_examples=10_000 if FULL else 100, deadline=None, suppress_health_check=NOTHING)
@given(st.integers(0, 2**32))
def test_a_hostile_device_ends_a_run_with_an_outcome_or_a_link_error(seed):
    dice = random.Random(seed)
    with simulated(capacity=70) as (device, quiet):
        port = Hostile(device, quiet._clock, dice)
        sink = Kept()
        try:
            outcome = driven(port).stream(Plan("commands", np.ones(200)), sink)
        except SewfastError:
            return
        indexes = sink.indexes() if sink.blocks else np.zeros(0)
        assert np.all(np.diff(indexes) > 0)
        assert outcome.received == len(indexes)
        assert len(outcome.gaps) <= 200
        if outcome.taken == 200:
            listed = sum(n for _, n in outcome.gaps)
            assert outcome.received + listed == 200


FRAMES = 10_000_000 if FULL else 40_000
CHUNK = 1000


def test_hostile_frames_leave_the_memory_as_it_was():
    """Random and mutated frames, each made anew, a thousand in a read, with a command under way."""
    frames = HostileFrames(3)
    answered = failed = 0
    blocks = []
    with simulated() as (device, port):
        link = linked(port)
        link.receiver.expect([(0, 1), (1, 1000), (2, 1)], 1000)
        device.advance = lambda: None
        device.intercept = lambda frame: True
        for fed in range(0, FRAMES, CHUNK):
            if not link.is_busy:
                link.begin(frames.dice.choice(ASKED))
            device.wire.out = b"".join(
                frames.next(link.receiver.sequences[0]) for _ in range(CHUNK)
            )
            try:
                link.turn(0.0)
            except LinkError:
                link._failed = None
                failed += 1
            link.receiver.take()
            device.arrived.clear()
            reply = link.answer()
            if reply is not None:
                answered += 1
                with suppress(LinkError):
                    READERS.get(reply.kind, bytes)(reply.checked())
            if fed % (FRAMES // 20) == 0:
                # an exception and its traceback hold each other until collected
                gc.collect()
                blocks.append(sys.getallocatedblocks())
        assert link.receiver.counters["frames"] > FRAMES / 2
        assert len(link.events) <= 256
    assert answered > FRAMES / CHUNK / 4
    assert failed > FRAMES / CHUNK / 4
    assert blocks[-1] - blocks[2] < 5000, blocks
    print(f"{FRAMES} frames: {answered} replies taken, {failed} link errors, blocks {blocks}")


ASKED = (Kind.STATUS, Kind.DESCRIBE, Kind.LIMITS, Kind.UPLOAD, Kind.START, Kind.ECHO)
READERS = {
    Kind.DESCRIBE: wire.channel, Kind.LIMITS: wire.limits, Kind.UPLOAD: wire.uploaded,
    Kind.START: wire.started,
}  # fmt: skip


class HostileFrames:
    """Frames with a right CRC around anything, some of them damaged afterwards."""

    KINDS = (0xC0, 0xC0, 0xC1, 0xC2, 0x81, *(0x80 | kind for kind in ASKED))
    LENGTHS = (0, 1, 5, 15, 43, 66, 67, 231)

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        self._noise = b""
        self._at = 0

    def _body(self, length: int) -> bytes:
        if self._at + length > len(self._noise):
            self._noise, self._at = self.dice.randbytes(1 << 16), 0
        self._at += length
        return self._noise[self._at - length : self._at]

    def next(self, asked: int) -> bytes:
        """The next frame; of the replies, many answer the command `asked`."""
        bits = self.dice.getrandbits(64)
        kind = bits & 0xFF if bits >> 60 == 0 else self.KINDS[(bits >> 8 & 0xFF) % len(self.KINDS)]
        tag = 0xBEEF if bits >> 16 & 0x1FF else bits & 0xFFFF
        time_us = (0, bits >> 24, 2**64 - 1, bits >> 40)[bits >> 25 & 3]
        length = self.LENGTHS[bits >> 27 & 7] if bits >> 30 & 1 else (bits >> 31 & 0xFF) % 232
        body = self._body(length)
        if length > 5 and bits >> 39 & 1:
            body = struct.pack("<IB", asked, 0 if bits >> 41 & 3 else bits >> 43 & 15) + body[5:]
        frame = golden.wire(kind, tag, bits >> 32, time_us, body)
        if bits >> 47 & 7 == 0:
            at = bits % len(frame)
            frame = frame[:at] + bytes([frame[at] ^ 1 << (bits >> 50 & 7)]) + frame[at + 1 :]
        return frame


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [{"watchdog": 0.0}, {"watchdog": 11.0}, {"resume": -1.0}])
def test_settings_outside_their_range(given):
    with pytest.raises(SewfastError, match=next(iter(given))):
        connect("socket://127.0.0.1:1", **given)
