"""The bodies of the link's frames as values, names and refusals (docs/PROTOCOL.md).

The compiled core encodes and decodes their bytes, for this client and for the loop on the host.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVar

from .._core import LinkBodies
from ..errors import LinkError

VERSION, MAX_BODY = LinkBodies.VERSION, LinkBodies.MAX_BODY
LARGEST = 3.4028234e38
"""Largest number in single precision."""
LATEST = 2**64 - 1
"""Latest time that a frame can carry [us]."""


class Kind(IntEnum):
    """Frames of the host."""

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
    CONTROLLER = 0x0D
    FEEDFORWARD = 0x0E
    POSITION = 0x0F
    ANGLE = 0x10
    TRAVEL = 0x11
    KEEP = 0x20
    DRIVE = 0x21
    CREDIT = 0x22


STATES = ("boot", "idle", "armed", "running", "tripped")
REASONS = (
    "none", "watchdog", "speed", "acceleration", "current", "underrun", "bad command",
    "host changed", "measurement", "no motion", "stop input", "late", "swinging", "travel",
)  # fmt: skip
EVENTS = ("", "boot", "armed", "started", "finished", "stopped", "tripped", "cleared")
MODES = {"commands": 0, "controller": 1, "direct": 2, "positions": 3}

(
    PROFILE, PID, DIRECT, CREDIT, CURRENT, COMPUTED, DESIGN, BIQUADS, KINDS, FEEDFORWARD, POSITIONS
) = (1 << b for b in range(11))  # fmt: skip
"""Capabilities of a device."""

ANYWHERE = (-(2**31), 2**31 - 1)
"""Limits of the position that are none: the counter may wrap."""
FARTHEST = 2.0**22
"""Farthest goal or angle that a device takes, where single precision has half counts [counts]."""


def name_of(names: Sequence[str], value: int) -> str:
    """The name of a value; an unknown one, of a later firmware, stays a number."""
    return names[value] if value < len(names) else f"unknown ({value})"


# --- replies ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Identity:
    """A device's name, firmware and capabilities.

    Parameters
    ----------
    name, firmware : str
    version : int
        Version of the protocol that both sides use.
    boot : int
        Its boot id; another one means that it was reset.
    schema : int
        CRC-32 of its channels.
    state : str
        Its state at HELLO.
    channels : int
    period_us : int
        Control period [us].
    capabilities : int
        Bits; see docs/PROTOCOL.md.
    capacity : int
        Number of values that its profile memory holds.
    counts_per_rev : float
        Counts of its encoder in one turn.
    session : int
        Session of the HELLO that it answered.
    key : int
        Repeated in ARM, as proof that the host receives the device's frames.
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
        """Mark of its frames: the low half of the boot id."""
        return self.boot & 0xFFFF

    @property
    def on_credit(self) -> bool:
        """Whether its time advances only as the host grants it."""
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
    """The device's status; the run is the present or the last one.

    `taken` of `length` samples are done; the profile ends at `end`. `received`, `refused` and
    `dropped` count frames, `late_us` is the largest delay of a control period [us]; `foreign`
    counts frames of other sessions.
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
    """Limits that the device enforces, and its own ceilings; 0 means that a limit is not set."""

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
        """Whether limits were set in this session."""
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
        """The body; `LinkError` with the reason and the remedy if the device refused."""
        if self.result:
            raise refusal(self.kind, self.result, self.detail)
        return self.body


def identity(body: bytes) -> Identity:
    """The reply to HELLO."""
    fields, session, key = _whole(LinkBodies.greeting(body), body, "HELLO")
    (
        name, firmware, version, boot, schema, state, channels, period, capabilities, capacity,
        counts,
    ) = fields  # fmt: skip
    if not 2 <= channels <= 16 or period == 0 or not (math.isfinite(counts) and counts >= 0):
        raise LinkError(
            name="HELLO",
            expected="a device with 2 to 16 channels, a control period and counts per turn",
            received=f"{channels}, {period} us and {counts}", remedy="fix the firmware",
        )  # fmt: skip
    return Identity(
        _shown(name), _shown(firmware), version, boot, schema, name_of(STATES, state), channels,
        period, capabilities, capacity, counts, session, key,
    )  # fmt: skip


def channel(body: bytes) -> Channel:
    """The reply to DESCRIBE."""
    fields = _whole(LinkBodies.description(body), body, "DESCRIBE")
    number, encoding, steps, name, unit = fields
    if encoding > 2 or (encoding == 1 and steps == 0):
        raise LinkError(
            name=f"DESCRIBE: channel {number}", expected="encoding 0, 1 (with steps per unit) or 2",
            received=f"{encoding} with {steps} steps", remedy="update sewfast or fix the firmware",
        )  # fmt: skip
    return Channel(number, encoding, steps, _shown(name), _shown(unit))


schema_hash = LinkBodies.schema
"""CRC-32 of version, period and the bodies of all DESCRIBE replies in order."""


def status(answer: Reply) -> Status:
    """The reply to STATUS."""
    body = answer.checked()
    run, counted = _whole(LinkBodies.status(body), body, "STATUS")
    names = (name_of(STATES, run[0]), name_of(REASONS, run[1]))
    speed, counts, received, refused, dropped, late, session, foreign = counted
    return Status(
        *names, *run[2:], speed, counts, received, refused, dropped, late, session, answer.time_us,
        foreign,
    )  # fmt: skip


def limits(body: bytes) -> Limits:
    """The reply to LIMITS."""
    volt, speed, acceleration, current, *ceilings = _whole(
        LinkBodies.limits_of(body), body, "LIMITS"
    )
    a, b, c, d = ceilings
    return Limits(volt, speed, acceleration, current, (a, b, c, d))


def travel(body: bytes) -> tuple[int, int, int, int]:
    """The reply to TRAVEL: least and greatest count in force, then the device's own."""
    low, high, least, greatest = _whole(LinkBodies.travel_of(body), body, "TRAVEL")
    return low, high, least, greatest


def event(
    code: int, state: int, reason: int, run: int, samples: int, value: float, time_us: int
) -> Event:
    """An event from the fields that the core decoded."""
    names = (name_of(EVENTS, code), name_of(STATES, state), name_of(REASONS, reason))
    return Event(*names, run, samples, value, time_us)


def started(body: bytes) -> tuple[int, int]:
    """Number of the run and its start [us]."""
    return _whole(LinkBodies.started(body), body, "START")


def begins(body: bytes) -> int:
    """The sample with which the stop of an ANGLE begins."""
    whole = body if len(body) == 4 else None
    return int.from_bytes(_whole(whole, body, "ANGLE"), "little")


def uploaded(body: bytes) -> tuple[int, int]:
    """End of the profile and room behind it [values]."""
    return _whole(LinkBodies.uploaded(body), body, "UPLOAD")


T = TypeVar("T")


def _whole(fields: T | None, body: bytes, name: str) -> T:
    if fields is None:
        raise LinkError(
            name=name, expected="a whole reply", received=f"{len(body)} bytes",
            remedy="fix the firmware (docs/PROTOCOL.md)",
        )  # fmt: skip
    return fields


def _shown(name: str) -> str:
    """A name that is safe to print and to write to files."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in name)


# --- commands -----------------------------------------------------------------------------------


arm, set_limits, gains = LinkBodies.arm, LinkBodies.limits, LinkBodies.gains
biquads, feedforward = LinkBodies.biquads, LinkBodies.feedforward
position, angle, set_travel = LinkBodies.position, LinkBodies.angle, LinkBodies.travel
controller, start = LinkBodies.controller, LinkBodies.start


def body_size(encodings: Sequence[int], batch: int) -> int:
    """Bytes in the body of a batch of samples."""
    sizes = {0: 2 * batch + 2, 1: 2 * batch, 2: 4 * batch}
    return 1 + sum(sizes[e] for e in encodings)


def wire_size(body: int) -> int:
    """Bytes on the wire of a frame: header, CRC, stuffing and the closing zero."""
    around: int = LinkBodies.AROUND
    return body + around


# --- refusals: result codes and remedies ----------------------------------------------------------


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
    Kind.FEEDFORWARD: ("its preview, levels or taps",),
    Kind.CONTROLLER: ("kind", "counts per unit"),
    Kind.POSITION: ("its gain, speeds, landing, smoothing or rates",),
    Kind.ANGLE: ("the sample of the stop, or a run without a position loop,", "angle", "way"),
    Kind.TRAVEL: ("the least count", "the greatest count"),
    Kind.START: ("mode", "watchdog", "at", "length", "mask", "batch"),
}  # fmt: skip


def refusal(kind: int, result: int, detail: int) -> LinkError:
    """The error for a device's refusal, with its remedy."""
    name = Kind(kind).name if kind in Kind._value2member_map_ else f"command {kind:#04x}"
    reason, _, remedy = _refused(kind, result, detail).partition("; ")
    return LinkError(
        name=name, expected="a device that takes it", received=f"a refusal: {reason}", remedy=remedy
    )


def _without(kind: int) -> str:
    return "its limit is inf" if kind == Kind.LIMITS else "leave it out"


def _refused(kind: int, result: int, detail: int) -> str:
    where = _field(kind, detail)
    texts = {
        1: "its firmware does not support the command; update it",
        2: f"wrong length, {detail} bytes; update sewfast and the firmware to the same version",
        3: f"{where} is outside its range; change it",
        4: f"not while {name_of(STATES, detail)}; {_way_out(detail)}",
        5: "it has been reset since; connect again, set the limits and start anew",
        6: f"{_field(kind, detail, limit=True)} is beyond a limit; lower it or raise the limit",
        7: f"no room in its profile memory, {detail} values would fit; wait for it to play on",
        8: f"it does not offer {where}; {_without(kind)}",
        9: f"values out of order, it expects number {detail}; upload from there",
        10: f"it speaks protocol version {detail}, sewfast {VERSION}; update the older one",
        11: "the motor is moving; wait for rest",
        12: "no limits were set in this session; set them first",
        13: "the key is not that of its reply to HELLO; connect again",
    }
    return texts.get(
        result, f"result {result} (detail {detail}), unknown to this version of sewfast"
    )


def _field(kind: int, index: int, *, limit: bool = False) -> str:
    if limit and kind == Kind.START and index == 0:
        return "its profile, or what its controller does,"
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
