"""Bodies of the link's frames as values, and back (docs/PROTOCOL.md); refusals."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any
from zlib import crc32

from ..errors import LinkError

# --- Bodies of the link's frames as values, and values as bodies (docs/PROTOCOL.md) ---------------


VERSION = 3
MAX_BODY = 231
LARGEST = 3.4028234e38
"""Of single precision."""


class Kind(IntEnum):
    """What the host sends."""

    HELLO = 0x01
    DESCRIBE = 0x02
    STATUS = 0x03
    LIMITS = 0x04
    ARM = 0x05
    STOP = 0x06
    CLEAR = 0x07
    UPLOAD = 0x08
    GAINS = 0x09
    START = 0x0A
    ECHO = 0x0B
    BIQUADS = 0x0C
    KEEP = 0x20
    DRIVE = 0x21
    CREDIT = 0x22


REPLY = 0x80
SAMPLES, EVENT, BEAT = 0xC0, 0xC1, 0xC2

STATES = ("boot", "idle", "armed", "running", "tripped")
REASONS = (
    "none", "watchdog", "speed", "acceleration", "current", "underrun", "bad command",
    "host changed", "measurement", "no motion", "stop input", "late", "swinging",
)  # fmt: skip
EVENTS = ("", "boot", "armed", "started", "finished", "stopped", "tripped", "cleared")
MODES = {"commands": 0, "controller": 1, "direct": 2}

PROFILE, PID, DIRECT, CREDIT, CURRENT, COMPUTED, DESIGN, BIQUADS = (1 << b for b in range(8))
"""Capabilities of a device."""


def name_of(names: Sequence[str], value: int) -> str:
    """The name of a value; one of a later firmware stays a number."""
    return names[value] if value < len(names) else f"unknown ({value})"


# --- replies ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Identity:
    """Who the device is.

    Parameters
    ----------
    name, firmware : str
    version : int
        Of the protocol that both sides speak.
    boot : int
        Its boot id; another one means that it has been reset.
    schema : int
        CRC-32 of its channels.
    state : str
        When it was asked.
    channels : int
    period_us : int
        Control period [us].
    capabilities : int
        Bits, docs/PROTOCOL.md.
    capacity : int
        Values that its profile memory holds.
    counts_per_rev : float
        Counts of its encoder in one turn.
    session : int
        Whose HELLO it has answered.
    key : int
        What ARM repeats: only a host that hears the device knows it.
    """

    name: str
    firmware: str
    version: int
    boot: int
    schema: int
    state: str
    channels: int
    period_us: int
    capabilities: int
    capacity: int
    counts_per_rev: float
    session: int = 0
    key: int = 0

    @property
    def Ts(self) -> float:
        """Control period [s]."""
        return self.period_us * 1e-6

    @property
    def tag(self) -> int:
        """What marks its frames: the low half of the boot id."""
        return self.boot & 0xFFFF

    @property
    def on_credit(self) -> bool:
        """Whether its time advances only by what the host grants."""
        return bool(self.capabilities & CREDIT)

    @property
    def is_computed(self) -> bool:
        """Whether it is a virtual machine, whose true speed is known."""
        return bool(self.capabilities & COMPUTED)


@dataclass(frozen=True)
class Channel:
    """A quantity that the device measures or computes at each sample."""

    number: int
    encoding: int
    steps_per_unit: int
    name: str
    unit: str


@dataclass(frozen=True)
class Status:
    """What the device says of itself; the run is the present or the last one.

    `taken` of `length` samples are behind it; the profile ends at `end`. `received`, `refused` and
    `dropped` count frames, `late_us` is the latest control period [us]; `foreign` counts frames of
    other sessions.
    """

    state: str
    reason: str
    mode: int
    mask: int
    run: int
    start: int
    taken: int
    length: int
    end: int
    speed_rpm: float
    counts: int
    received: int
    refused: int
    dropped: int
    late_us: int
    session: int
    time_us: int
    foreign: int = 0


@dataclass(frozen=True)
class Limits:
    """Limits that the device enforces, and its own ceilings; 0 is a limit that is not set."""

    volt: float
    speed_rpm: float
    acceleration: float
    current: float
    ceilings: tuple[float, float, float, float]

    @property
    def values(self) -> tuple[float, float, float, float]:
        """Volt, speed [RPM], acceleration [RPM/s], current [A]."""
        return self.volt, self.speed_rpm, self.acceleration, self.current

    @property
    def are_set(self) -> bool:
        """Whether the device has been given limits in this session."""
        return any(self.values)


@dataclass(frozen=True)
class Event:
    """Something that happened on the device: `samples` into run `run`, at `time_us`."""

    name: str
    state: str
    reason: str
    run: int
    samples: int
    value: float
    time_us: int


@dataclass(frozen=True)
class Reply:
    """The answer to a command: result 0 with a body, or a refusal with its detail."""

    kind: int
    result: int
    detail: int
    body: bytes
    time_us: int

    def checked(self) -> bytes:
        """The body.

        Raises
        ------
        LinkError
            Where the device refused the command; the message says why and what to do.
        """
        if self.result:
            # the names of the fields lie beside the messages, which need the kinds from here

            raise LinkError(refusal(self.kind, self.result, self.detail))
        return self.body


_REPLY = struct.Struct("<IB")
_HELLO = struct.Struct("<BIIBBIIIf")
_SESSION = struct.Struct("<II")
"""At the end of the reply to HELLO: session and key."""
_CHANNEL = struct.Struct("<BBI")
_STATUS = struct.Struct("<BBBHIQIIIfiIIIIII")
_LIMITS = struct.Struct("<8f")
_EVENT = struct.Struct("<BBBIIf")
_START = struct.Struct("<BIQIHB")
_STARTED = struct.Struct("<IQ")
_UPLOADED = struct.Struct("<II")
_GAINS = struct.Struct("<12fB")


def reply(kind: int, time_us: int, body: bytes) -> tuple[int, Reply] | None:
    """The command's sequence and its reply; None for what is no reply."""
    if len(body) < _REPLY.size:
        return None
    sequence, result = _REPLY.unpack_from(body)
    rest = body[_REPLY.size :]
    if result and len(rest) != 4:
        return None
    detail = int.from_bytes(rest, "little") if result else 0
    return sequence, Reply(kind & ~REPLY, result, detail, b"" if result else rest, time_us)


def identity(body: bytes) -> Identity:
    """The reply to HELLO."""
    values, rest = _start(_HELLO, body, "HELLO")
    version, boot, schema, state, channels, period, capabilities, capacity, counts = values
    name, rest = _text(rest, "HELLO")
    firmware, rest = _text(rest, "HELLO")
    (session, key), _ = _start(_SESSION, rest, "HELLO")
    if not 2 <= channels <= 16 or period == 0 or not (math.isfinite(counts) and counts >= 0):
        raise LinkError(
            "expected a device with 2 to 16 channels, a control period and counts per turn, got "
            f"{channels}, {period} us and {counts}; mend the firmware"
        )
    return Identity(
        name, firmware, version, boot, schema, name_of(STATES, state), channels, period,
        capabilities, capacity, counts, session, key,
    )  # fmt: skip


def greets(reply: Reply, session: int) -> bool:
    """Whether a reply to HELLO is to that of `session`, not to another host's before."""
    return reply.result != 0 or reply.body[-8:-4] == struct.pack("<I", session)


def channel(body: bytes) -> Channel:
    """The reply to DESCRIBE."""
    (number, encoding, steps), rest = _start(_CHANNEL, body, "DESCRIBE")
    name, rest = _text(rest, "DESCRIBE")
    unit, rest = _text(rest, "DESCRIBE")
    if encoding > 2 or (encoding == 1 and steps == 0):
        raise LinkError(
            f"expected channel {number} in encoding 0, 1 (with steps per unit) or 2, got "
            f"{encoding} with {steps} steps; update sewfast or mend the firmware"
        )
    return Channel(number, encoding, steps, name, unit)


def host_time(session: int, us: int) -> int:
    """What stands for the time in a host's frames: its session above its clock, which wraps."""
    return session << 32 | us & 0xFFFFFFFF


def schema_hash(version: int, period_us: int, descriptions: Sequence[bytes]) -> int:
    """CRC-32 of version, period and the bodies of all DESCRIBE replies in order."""
    return crc32(b"".join([struct.pack("<BI", version, period_us), *descriptions]))


def status(answer: Reply) -> Status:
    """The reply to STATUS."""
    values: Any = _start(_STATUS, answer.checked(), "STATUS")[0]
    names = (name_of(STATES, values[0]), name_of(REASONS, values[1]))
    told = (*values[2:-1], answer.time_us, values[-1])
    return Status(*names, *told)


def limits(body: bytes) -> Limits:
    """The reply to LIMITS."""
    values: Any = _start(_LIMITS, body, "LIMITS")[0]
    return Limits(*values[:4], ceilings=values[4:])  # type: ignore[misc]


def event(time_us: int, body: bytes) -> Event | None:
    """An event; None where its body is not one."""
    if len(body) != _EVENT.size:
        return None
    code, state, reason, run, samples, value = _EVENT.unpack(body)
    names = (name_of(EVENTS, code), name_of(STATES, state), name_of(REASONS, reason))
    return Event(*names, run, samples, value, time_us)


def started(body: bytes) -> tuple[int, int]:
    """Number of the run and its start [us]."""
    (run, at), _ = _start(_STARTED, body, "START")
    return run, at


def uploaded(body: bytes) -> tuple[int, int]:
    """End of the profile and room behind it [values]."""
    (end, room), _ = _start(_UPLOADED, body, "UPLOAD")
    return end, room


# --- commands -----------------------------------------------------------------------------------


def hello(session: int) -> bytes:
    return struct.pack("<BBI", VERSION, VERSION, session)


def watchdog(us: int) -> bytes:
    return struct.pack("<I", us)


def arm(us: int, key: int) -> bytes:
    return struct.pack("<II", us, key)


def credit(us: int, until: int) -> bytes:
    return struct.pack("<IQ", us, min(until, 2**64 - 1))


def drive(us: int, u: float) -> bytes:
    return struct.pack("<If", us, _single(u))


def set_limits(values: Sequence[float]) -> bytes:
    return struct.pack("<4f", *map(_single, values))


def upload(table: int, offset: int, values: bytes) -> bytes:
    return struct.pack("<BI", table, offset) + values


def gains(values: Sequence[float], filter_samples: int) -> bytes:
    return _GAINS.pack(*map(_single, values), filter_samples)


def design(observer_time: float, r_rate: float, points: Sequence[Sequence[float]]) -> bytes:
    """What follows the gains for a device that knows observer, ramp and schedule."""
    rows = [struct.pack("<4f", *map(_single, point)) for point in points]
    head = struct.pack("<ffB", _single(observer_time), _single(r_rate), len(rows))
    return b"".join((head, *rows))


def biquads(sections: Sequence[Sequence[float]]) -> bytes:
    rows = [struct.pack("<4f", *map(_single, section)) for section in sections]
    return b"".join((bytes([len(rows)]), *rows))


def start(mode: int, us: int, at: int, length: int, mask: int, batch: int) -> bytes:
    return _START.pack(mode, us, at, length, mask, batch)


def _single(value: float) -> float:
    """What single precision holds; beyond its range is infinite."""
    return value if abs(value) <= LARGEST else math.copysign(math.inf, value)


def body_size(encodings: Sequence[int], batch: int) -> int:
    """Bytes in the body of a batch of samples."""
    sizes = {0: 2 * batch + 2, 1: 2 * batch, 2: 4 * batch}
    return 1 + sum(sizes[e] for e in encodings)


def wire_size(body: int) -> int:
    """Bytes on the wire of a frame: header, CRC, stuffing and the closing zero."""
    return body + 21


def _start(shape: struct.Struct, body: bytes, name: str) -> tuple[tuple[int, ...], bytes]:
    if len(body) < shape.size:
        raise _short(name, shape.size, len(body))
    return shape.unpack_from(body), body[shape.size :]


def _text(body: bytes, name: str) -> tuple[str, bytes]:
    size = body[0] if body else 0
    if len(body) < 1 + size:
        raise _short(name, 1 + size, len(body))
    text = body[1 : 1 + size].decode("utf-8", "replace")
    # a name goes to terminals and files
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text), body[
        1 + size :
    ]


def _short(name: str, expected: int, received: int) -> LinkError:
    return LinkError(
        f"expected at least {expected} bytes in the reply to {name}, got {received}; "
        "mend the firmware (docs/PROTOCOL.md)"
    )


# --- Refusals: what a device's result codes mean and what to do about them ------------------------


_FIELDS: dict[int, tuple[str, ...]] = {
    Kind.HELLO: ("version from", "version to", "session"),
    Kind.DESCRIBE: ("channel",),
    Kind.LIMITS: ("volt", "speed", "acceleration", "current"),
    Kind.ARM: ("watchdog", "key"),
    Kind.GAINS: (
        "Kp", "Ti", "Td", "alpha", "beta", "N", "Tt", "u_min", "u_max", "slew", "filter_time",
        "counts per unit", "filter_samples", "observer_time", "r_rate", "schedule",
    ),
    Kind.BIQUADS: ("the number of biquads",),
    Kind.START: ("mode", "watchdog", "at", "length", "mask", "batch"),
}  # fmt: skip


def refusal(kind: int, result: int, detail: int) -> str:
    """What a device's refusal means and what to do."""
    name = Kind(kind).name if kind in Kind._value2member_map_ else f"command {kind:#04x}"
    return f"expected the device to take {name}, it refused: {_refused(kind, result, detail)}"


def _without(kind: int) -> str:
    return "its limit is inf" if kind == Kind.LIMITS else "leave it out"


def _refused(kind: int, result: int, detail: int) -> str:
    where = _field(kind, detail)
    texts = {
        1: "it does not know the command; update the firmware",
        2: f"wrong length, {detail} bytes; update sewfast and the firmware to the same version",
        3: f"{where} is outside its range; change it",
        4: f"not while {name_of(STATES, detail)}; {_way_out(detail)}",
        5: "it has been reset since; connect again, set the limits and start anew",
        6: f"{where} is beyond a limit; lower it or raise the limit",
        7: f"no room in its profile memory, {detail} values would fit; wait for it to play on",
        8: f"it does not offer {where}; {_without(kind)}",
        9: f"values out of order, it expects number {detail}; upload from there",
        10: f"it speaks protocol version {detail}, sewfast {VERSION}; update the older one",
        11: "the motor is moving; wait for rest",
        12: "no limits were set in this session; set them first",
        13: "the key is not that of its reply to HELLO; connect again",
    }
    return texts.get(result, f"result {result} (detail {detail}), which this sewfast does not know")


def _field(kind: int, index: int) -> str:
    if kind == Kind.UPLOAD:
        return f"value {index}"
    if kind == Kind.BIQUADS and index:
        return f"biquad {1 + (index - 1) // 4}"
    names = _FIELDS.get(kind, ())
    return names[index] if index < len(names) else f"field {index}"


def _way_out(state: int) -> str:
    remedies = {
        0: "wait until it has measured well",
        1: "arm it first",
        2: "start or stop it first",
        3: "stop it first",
        4: "find out why, then clear the trip",
    }
    return remedies.get(state, "update sewfast")
