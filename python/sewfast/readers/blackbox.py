"""Logs that need no other package: Betaflight's black box, Saleae's analogue export.

The black box format is that of Betaflight's own documents ("Blackbox logging internals") and of its
encoder: a text header that names the fields, their predictors and encodings, then frames. I frames
stand alone, P frames hold differences from the two frames before. After damage, reading goes on at
the next I frame: a log that ends in a crash is worth reading up to there.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..arrays import FloatArray

BLACKBOX = b"H Product:Blackbox"
SALEAE = b"<SALEAE>"
_FRAMES = frozenset(b"IPSGHE")


class Damaged(ValueError):
    """The bytes are no valid frame, or the file ends within one."""


# --- Black box: numbers ---------------------------------------------------------------------------


class _Bytes:
    """The bytes of a file and the position of the next one."""

    def __init__(self, raw: bytes, at: int) -> None:
        self.raw, self.at = raw, at

    def byte(self) -> int:
        if self.at >= len(self.raw):
            raise Damaged("it ends within a frame")
        self.at += 1
        return self.raw[self.at - 1]

    def unsigned(self) -> int:
        """Seven bits a byte, the lowest first; the eighth is set if another byte follows."""
        value = 0
        for shift in (0, 7, 14, 21, 28):
            b = self.byte()
            value |= (b & 0x7F) << shift
            if b < 0x80:
                return value & 0xFFFFFFFF
        raise Damaged("a number of more than 32 bits")

    def signed(self) -> int:
        """Zigzag: 0, -1, 1, -2, .. as 0, 1, 2, 3, .."""
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def little(self, count: int) -> int:
        """A signed number of whole bytes."""
        return int.from_bytes(bytes(self.byte() for _ in range(count)), "little", signed=True)


def _of_bits(value: int, bits: int) -> int:
    """The two's complement number in the lowest bits."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


def _each(read: Callable[[_Bytes], int]) -> Callable[[_Bytes, int], list[int]]:
    return lambda data, count: [read(data) for _ in range(count)]


def _tag8_8svb(data: _Bytes, count: int) -> list[int]:
    """A byte whose bits mark which of up to eight fields are not 0; a single field has none."""
    if count == 1:
        return [data.signed()]
    tag = data.byte()
    return [data.signed() if tag >> k & 1 else 0 for k in range(count)]


def _tag2_3s32(data: _Bytes, count: int) -> list[int]:
    """Three fields of 2, 4 or 6 bits, or of 1 to 4 bytes each."""
    lead = data.byte()
    kind = lead >> 6
    if kind == 0:
        return [_of_bits(lead >> 4, 2), _of_bits(lead >> 2, 2), _of_bits(lead, 2)]
    if kind == 1:
        second = data.byte()
        return [_of_bits(lead, 4), _of_bits(second >> 4, 4), _of_bits(second, 4)]
    if kind == 2:
        return [_of_bits(lead, 6), _of_bits(data.byte(), 6), _of_bits(data.byte(), 6)]
    return [data.little((lead >> 2 * k & 3) + 1) for k in range(3)]


def _tag2_3svariable(data: _Bytes, count: int) -> list[int]:
    """Three fields of 2 bits, of 5, 5 and 4, of 8, 7 and 7, or of 1 to 4 bytes each."""
    lead = data.byte()
    kind = lead >> 6
    if kind == 0:
        return [_of_bits(lead >> 4, 2), _of_bits(lead >> 2, 2), _of_bits(lead, 2)]
    if kind == 1:
        word = lead << 8 | data.byte()
        return [_of_bits(word >> 9, 5), _of_bits(word >> 4, 5), _of_bits(word, 4)]
    if kind == 2:
        word = lead << 16 | data.byte() << 8 | data.byte()
        return [_of_bits(word >> 14, 8), _of_bits(word >> 7, 7), _of_bits(word, 7)]
    return [data.little((lead >> 2 * k & 3) + 1) for k in range(3)]


def _tag8_4s16(data: _Bytes, count: int) -> list[int]:
    """Four fields of 0, 4, 8 or 16 bits, packed by halves of bytes, the high one first."""
    tag = data.byte()
    halves: list[int] = []

    def half() -> int:
        if not halves:
            b = data.byte()
            halves.extend((b & 15, b >> 4))
        return halves.pop()

    def wide(count: int) -> int:
        value = 0
        for _ in range(count):
            value = value << 4 | half()
        return _of_bits(value, 4 * count)

    return [wide((0, 1, 2, 4)[tag >> 2 * k & 3]) if tag >> 2 * k & 3 else 0 for k in range(4)]


_ENCODINGS: dict[int, tuple[Callable[[_Bytes, int], list[int]], int]] = {
    0: (_each(_Bytes.signed), 1),
    1: (_each(_Bytes.unsigned), 1),
    3: (_each(lambda data: -_of_bits(data.unsigned(), 14)), 1),
    6: (_tag8_8svb, 8),
    7: (_tag2_3s32, 3),
    8: (_tag8_4s16, 4),
    9: (lambda data, count: [0] * count, 1),
    10: (_tag2_3svariable, 3),
}
"""By number in the header: the reader of a group of fields, and the size of such a group."""


# --- Black box: fields and frames -----------------------------------------------------------------


@dataclass
class _Frame:
    """The fields of one kind of frame."""

    names: list[str] = field(default_factory=list)
    signed: list[int] = field(default_factory=list)
    predictors: list[int] = field(default_factory=list)
    encodings: list[int] = field(default_factory=list)

    def values(self, data: _Bytes) -> list[int]:
        """The fields as they are written, without their predictions."""
        found: list[int] = []
        k = 0
        while k < len(self.encodings):
            encoding = self.encodings[k]
            if encoding not in _ENCODINGS:
                raise ValueError(f"fields with the unknown encoding {encoding}")
            read, most = _ENCODINGS[encoding]
            count = 1
            while count < most and self.encodings[k + count : k + count + 1] == [encoding]:
                count += 1
            # encodings whose groups have all their fields
            if encoding in (7, 8, 10) and count < most:
                raise ValueError(f"encoding {encoding} with {count} fields, expected {most}")
            found += read(data, count)
            k += count
        return found


@dataclass
class _Header:
    """The text before the frames."""

    frames: dict[str, _Frame] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)

    def number(self, name: str, default: int, *, at: int = 0) -> int:
        try:
            return int(self.settings[name].split(",")[at])
        except (KeyError, IndexError, ValueError):
            return default


def blackbox_series(raw: bytes) -> Iterator[tuple[str, FloatArray, Any]]:
    """Names, times [s] and values of the fields of a black box log; of several flights the longest.
    A field is `motor.0` where the log calls it `motor[0]`. S frames are `slow` fields of the main
    frames' times. GPS frames are left out. Raises `ValueError` if the header is damaged or no frame
    can be read.
    """
    starts = [m.start() for m in re.finditer(re.escape(BLACKBOX), raw)]
    names: list[str] = []
    table = np.zeros((0, 0), dtype=np.int64)
    for start, stop in zip(starts, [*starts[1:], len(raw)], strict=True):
        flight = raw[start:stop]
        header, at = _header(flight, 0)
        found, numbers = _flight(header, _Bytes(flight, at))
        rows = np.frombuffer(numbers, dtype=np.int64).reshape(-1, len(found))
        if len(rows) > len(table):
            names, table = found, rows
    if not len(table):
        raise ValueError("there is no frame that can be read")
    if "time" not in names:
        raise ValueError("its frames have no time")
    t = table[:, names.index("time")].astype(np.float64) * 1e-6
    for k, name in enumerate(names):
        if name != "time":
            yield re.sub(r"\[(\d+)\]", r".\1", name), t, table[:, k]


def _header(raw: bytes, at: int) -> tuple[_Header, int]:
    found = _Header()
    while raw[at : at + 2] == b"H ":
        end = raw.find(b"\n", at)
        if end < 0:
            raise ValueError("its header has no end")
        name, _, value = raw[at + 2 : end].decode("latin-1").partition(":")
        at = end + 1
        match = re.fullmatch(r"Field ([A-Z]) (name|signed|predictor|encoding)", name)
        if match is None:
            found.settings[name] = value
            continue
        frame = found.frames.setdefault(match[1], _Frame())
        parts = value.split(",")
        if len(parts) > 512:
            raise ValueError(f"frames of {len(parts)} fields")
        if match[2] == "name":
            frame.names = parts
        else:
            numbers = [int(part) for part in parts]
            attribute = {"predictor": "predictors", "encoding": "encodings"}.get(match[2], match[2])
            setattr(frame, attribute, numbers)
    _require_whole(found)
    return found, at


def _require_whole(header: _Header) -> None:
    main, between = header.frames.get("I"), header.frames.get("P")
    if main is None or between is None:
        raise ValueError("its header does not describe I and P frames")
    between.names, between.signed = main.names, main.signed
    for name in ("I", "P", "S"):
        frame = header.frames.get(name)
        if frame is None:
            continue
        frame.predictors = frame.predictors or [0] * len(frame.names)
        sizes = {len(frame.names), len(frame.predictors), len(frame.encodings)}
        if len(sizes) != 1 or not frame.names:
            raise ValueError(f"{name} frames have lists of fields of different lengths")


def _flight(header: _Header, data: _Bytes) -> tuple[list[str], array[int]]:
    """Every main frame, each with the last slow one."""
    main, slow = header.frames["I"], header.frames.get("S")
    names = [*main.names, *(slow.names if slow is not None else ())]
    held: list[int] = [0] * (len(slow.names) if slow is not None else 0)
    rows = array("q")
    last: list[int] | None = None
    before: list[int] | None = None
    interval = max(header.number("I interval", 32), 1)
    share = header.settings.get("P interval", "1/1").split("/")
    try:
        # a share of the loops, 1/2, or the number of loops per frame
        part, whole = (int(share[0]), int(share[1])) if len(share) == 2 else (1, int(share[0]))
    except ValueError:
        part, whole = 1, 1
    part, whole = max(part, 1), max(whole, 1)
    while data.at < len(data.raw) and len(rows) < 500_000_000:
        start = data.at
        kind = chr(data.byte())
        try:
            if kind == "I":
                fresh = _predicted(header, main, data, None, None, 0)
            elif kind == "P":
                if last is None:
                    raise Damaged("nothing to add to")
                skipped = _skipped(last[0], interval, part, whole)
                fresh = _predicted(header, header.frames["P"], data, last, before, skipped)
            elif kind == "S" and slow is not None:
                fresh = None
                fresh_slow = slow.values(data)
            elif kind in "GH" and kind in header.frames:
                fresh = None
                header.frames[kind].values(data)
            elif kind == "E":
                fresh = None
                if _event(data):
                    break
            else:
                raise Damaged("no frame begins with this byte")
            if data.at < len(data.raw) and data.raw[data.at] not in _FRAMES:
                raise Damaged("no frame follows")
        except Damaged:
            # differences are meaningless until the next whole frame
            last = before = None
            found = data.raw.find(b"I", start + 1)
            data.at = len(data.raw) if found < 0 else found
            continue
        if kind == "S":
            held = fresh_slow
        if fresh is None:
            continue
        rows.extend((*fresh, *held))
        before = fresh if kind == "I" or last is None else last
        last = fresh
    return names, rows


def _skipped(iteration: int, interval: int, part: int, whole: int) -> int:
    """Number of loops after an iteration that the flight controller was set not to log."""
    if part >= whole:
        return 0
    place = (iteration + 1) % interval
    to_whole = (interval - place) % interval
    phase = (place + part - 1) % whole
    return min(to_whole, 0 if phase < part else whole - phase)


def _predicted(
    header: _Header, frame: _Frame, data: _Bytes, last: list[int] | None,
    before: list[int] | None, skipped: int,
) -> list[int]:  # fmt: skip
    """The fields of a frame with their predictions added."""
    values = frame.values(data)
    names = frame.names
    motor = names.index("motor[0]") if "motor[0]" in names else -1
    older = last if before is None else before
    for k, predictor in enumerate(frame.predictors):
        if predictor == 0:
            base = 0
        elif predictor == 1:
            base = 0 if last is None else last[k]
        elif predictor == 2:
            base = 0 if last is None or older is None else 2 * last[k] - older[k]
        elif predictor == 3:
            # rounded towards 0, as in C
            base = 0 if last is None or older is None else int((last[k] + older[k]) / 2)
        elif predictor == 4:
            base = header.number("minthrottle", 1150)
        elif predictor == 5:
            if motor < 0 or motor > k:
                raise ValueError("a field that is predicted from a motor that is not there")
            base = values[motor]
        elif predictor == 6:
            base = skipped + 1 + (0 if last is None else last[k])
        elif predictor == 8:
            base = 1500
        elif predictor == 9:
            base = header.number("vbatref", 4095)
        elif predictor == 11:
            base = header.number("motorOutput", 0)
        else:
            raise ValueError(f"a field with the unknown predictor {predictor}")
        values[k] = _wrapped(values[k] + base, bool(frame.signed[k : k + 1] == [1]))
    return values


def _wrapped(value: int, signed: bool) -> int:
    """A sum wrapped to 32 bits."""
    return _of_bits(value, 32) if signed else value & 0xFFFFFFFF


def _event(data: _Bytes) -> bool:
    """Skip an event; return whether it ends the log."""
    kind = data.byte()
    if kind == 255:
        if data.raw[data.at : data.at + 11] != b"End of log\0":
            raise Damaged("an end without its mark")
        return True
    if kind == 0 or kind == 15:  # beep, disarm
        data.unsigned()
    elif kind in (14, 30):  # resume, flight mode
        data.unsigned()
        data.unsigned()
    elif kind == 13:  # adjustment in flight: a number of 4 bytes where the highest bit is set
        if data.byte() >= 0x80:
            data.little(4)
        else:
            data.signed()
    else:
        raise Damaged("an unknown event")
    return False


# --- Saleae ---------------------------------------------------------------------------------------


def saleae_series(raw: bytes) -> tuple[FloatArray, Any]:
    """Times [s] and voltages [V] of an analogue channel that Logic 2 exported as binary, version 0.
    Raises `ValueError` for a digital channel, another version, or a file that ends too early.
    """
    version, kind = struct.unpack_from("<ii", raw, 8)
    if version != 0 or kind not in (0, 1):
        raise ValueError(f"version {version}, type {kind}; version 0 is known here")
    if kind == 0:
        raise ValueError("a digital channel, which has no values between its edges")
    begin, rate, factor, count = struct.unpack_from("<dQQQ", raw, 16)
    if rate == 0 or factor == 0 or not np.isfinite(begin):
        raise ValueError(f"a sample rate of {rate}, every {factor}th sample")
    if 48 + 4 * count > len(raw):
        raise ValueError(f"{count} samples are promised, {(len(raw) - 48) // 4} are there")
    values = np.frombuffer(raw, "<f4", count, 48)
    return begin + np.arange(count) * (factor / rate), values
