"""Logs of other tools -> `Table`: MDF, TDMS, ULog, WPILOG, ROS bags, MCAP, Betaflight, Saleae.

Each signal of such a log has its own time stamps. The signal with the most samples gives the rows.
Signals with the same stamps are added unchanged; any other is held: each row has its last value,
NaN before the first. No value is interpolated.

On a damaged file, a reader from another package can raise anything, print, crash in its C code or
loop for ever. It therefore runs in a separate process, and every failure becomes a `DataError`.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import FloatArray
from ..errors import DataError, not_installed, printable
from ..recordfile.format import LIBRARY, MAGIC
from ..storage import file_bytes
from .blackbox import BLACKBOX, SALEAE, blackbox_series, saleae_series
from .containers import ELEMENTS, MAX_COLUMNS, Table, freeze, labels_of

PATIENCE, PATIENCE_PER_MB = 20.0, 5.0
"""Time limit of a reader, and addition per megabyte of the file [s]."""
_DEPTH = 8
"""Deepest nesting of messages that is read."""


@dataclass(frozen=True)
class Signal:
    """One signal of a log: its times [s], or None where it has none, its values, shape (N,)."""

    name: str
    t: FloatArray | None
    values: Any
    unit: str = ""


def is_log(raw: bytes) -> bool:
    """Whether a file that begins like this is a log that can be read here."""
    return _kind_of(raw) is not None


def read_log(path: Path, raw: bytes) -> Table:
    """Read every signal of a log."""
    name = _kind_of(raw)
    assert name is not None
    kind = _KINDS[name]
    if kind.module is None:
        try:
            found = list(kind.signals(path, raw))
        except (struct.error, IndexError, ValueError) as e:
            raise DataError(f"{path}: expected {kind.title}, but it cannot be read: {e}") from e
        return joined(path, found, kind.title)
    if importlib.util.find_spec(kind.module) is None:
        raise not_installed(kind.module, f"reading {kind.title}", "sewfast[logs]")
    return joined(path, _from_a_process(path, raw, name), kind.title)


def _from_a_process(path: Path, raw: bytes, name: str) -> list[Signal]:
    title = _KINDS[name].title
    limit = PATIENCE + PATIENCE_PER_MB * len(raw) / 1e6
    program = f"from {__name__} import send; send({name!r})"
    try:
        done = subprocess.run(
            [sys.executable, "-c", program, os.fspath(path.absolute())],
            capture_output=True, check=False, timeout=limit,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise DataError(
            f"{path}: expected {title}, but its reader found no end within {limit:.0f} s; the file "
            "is damaged, or this computer is busy: try again"
        ) from None
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        reason = lines[-1] if done.returncode > 0 and lines else "its reader crashed on it"
        raise DataError(
            f"{path}: expected {title}, but it cannot be read: {printable(reason)[:200]}"
        )
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        texts = [str(text) for text in found["texts"]]
        return [
            Signal(name, found.get(f"{k}.t"), found[f"{k}.y"], unit)
            for k, (name, unit) in enumerate(zip(texts[::2], texts[1::2], strict=True))
        ]


def send(name: str) -> None:
    """The program of a reader's process: the signals of the file in argv to stdout, as `.npz`."""
    # memory limit of a reader, and addition per byte of the file [B]: a damaged length field can
    # make it request any amount
    memory, memory_per_byte = 2_000_000_000, 50
    out, sys.stdout = sys.stdout.buffer, sys.stderr
    path = Path(sys.argv[1])
    raw = file_bytes(path)
    _bound_memory(memory + memory_per_byte * len(raw))
    arrays: dict[str, Any] = {}
    texts: list[str] = []
    for k, signal in enumerate(_KINDS[name].signals(path, raw)):
        values = np.asarray(signal.values)
        arrays[f"{k}.y"] = values if values.dtype.kind in "biuf" else np.array("not numeric")
        if signal.t is not None:
            arrays[f"{k}.t"] = signal.t
        texts += [signal.name, signal.unit]
    # a pipe cannot seek
    whole = io.BytesIO()
    np.savez(whole, texts=np.array(texts, dtype=str), **arrays)
    out.write(whole.getvalue())


def _bound_memory(most: int) -> None:
    """Limit the memory of this process to `most` bytes, where the system supports it."""
    try:
        import resource
    except ImportError:  # Windows
        return
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or hard > most:
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def joined(path: Path, signals: Sequence[Signal], kind: str) -> Table:
    """One table of all signals; time is its column `t`, from the first sample of any."""
    # most rows of a table
    largest = 50_000_000
    names = _unique([printable(s.name) for s in signals])
    usable: dict[str, Signal] = {}
    unusable: dict[str, str] = {}
    for name, signal in zip(names, signals, strict=True):
        reason = _reason(signal)
        if reason is None:
            usable[name] = signal
        else:
            unusable[name] = f"signal {name!r} is {reason}; expected a series of numbers"
    if not usable:
        reason = next(iter(unusable.values()), "it is empty")
        raise DataError(f"{path}: expected {kind} with series of numbers, received none; {reason}")
    if len(usable) > MAX_COLUMNS:
        raise DataError(f"{path}: expected at most {MAX_COLUMNS} signals, received {len(usable)}")
    units = {name: printable(s.unit) for name, s in usable.items() if s.unit}
    timed = {name: s for name, s in usable.items() if s.t is not None}
    if not timed:
        columns = {name: freeze(s.values) for name, s in usable.items()}
        return Table(path, columns, units, unusable)
    main = max(timed.values(), key=lambda s: len(s.values))
    assert main.t is not None
    if len(main.t) > largest:
        raise DataError(f"{path}: expected at most {largest} rows, received {len(main.t)}")
    columns, held = {}, 0
    for name, signal in timed.items():
        assert signal.t is not None
        alike = len(signal.t) == len(main.t) and np.array_equal(signal.t, main.t)
        held += not alike
        columns[name] = freeze(signal.values if alike else _held(signal, main.t))
    for name in usable.keys() - timed.keys():
        unusable[name] = f"signal {name!r} has no time stamps, while others have"
    t = "t" if "t" not in columns else "time"
    notes = () if not held else (
        f"{path}: {held} of {len(timed)} signals have time stamps of their own; each row has their "
        f"last value",
    )  # fmt: skip
    columns = {t: freeze(main.t - main.t[0]), **columns}
    return Table(path, columns, {t: "s", **units}, unusable, notes=notes)


def _held(signal: Signal, t: FloatArray) -> FloatArray:
    """The last value at each time, NaN before the first."""
    assert signal.t is not None
    order = np.argsort(signal.t, kind="stable")
    stamps, values = signal.t[order], np.asarray(signal.values, dtype=np.float64)[order]
    at = np.searchsorted(stamps, t, side="right") - 1
    return np.where(at >= 0, values[np.maximum(at, 0)], np.nan)


def _reason(signal: Signal) -> str | None:
    values = signal.values
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf":
        return "not numeric"
    if values.ndim != 1:
        return f"an array of shape {values.shape}"
    if len(values) < 2:
        return "empty" if len(values) == 0 else "a single number"
    if signal.t is not None and (len(signal.t) != len(values) or not np.isfinite(signal.t).all()):
        return "without a time stamp for each value"
    return None


def _unique(names: Sequence[str]) -> list[str]:
    """The names, with a number appended to repeated ones."""
    seen: dict[str, int] = {}
    found = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name}.{seen[name]}")
    return found


# --- The formats ----------------------------------------------------------------------------------


def _mdf(path: Path, raw: bytes) -> Iterator[Signal]:
    """Measurement data format of ASAM, version 3 and 4: physical values."""
    from asammdf import MDF

    with MDF(io.BytesIO(raw)) as file:
        for channel in file.iter_channels(skip_master=True):
            t = np.asarray(channel.timestamps, dtype=np.float64)
            values, invalid = np.asarray(channel.samples), channel.invalidation_bits
            if invalid is not None and values.dtype.kind in "biuf":
                # the bus or the sensor was not connected
                values = np.where(np.asarray(invalid, dtype=bool), np.nan, values)
            yield Signal(channel.name, t, values, channel.unit or "")


def _tdms(path: Path, raw: bytes) -> Iterator[Signal]:
    """LabVIEW's TDMS: channels `group.channel`, times from their waveform's properties."""
    from nptdms import TdmsFile

    file = TdmsFile.read(io.BytesIO(raw))
    groups = file.groups()
    for group in groups:
        for channel in group.channels():
            values, given = np.asarray(channel[:]), channel.properties
            name = channel.name if len(groups) == 1 else f"{group.name}.{channel.name}"
            given.setdefault("wf_start_offset", 0.0)
            try:
                t = np.asarray(channel.time_track(), dtype=np.float64)
            except KeyError:
                t = None
            unit = given.get("unit_string", "")
            if values.dtype.kind == "M" and len(values):
                values, unit = (values - values[0]) / np.timedelta64(1, "s"), "s"
            yield Signal(name, t, values, unit if isinstance(unit, str) else "")


def _ulog(path: Path, raw: bytes) -> Iterator[Signal]:
    """PX4's ULog: `topic.field`, or `topic.2.field` of a second instance."""
    from pyulog import ULog

    for topic in ULog(io.BytesIO(raw)).data_list:
        instance = f".{topic.multi_id}" if topic.multi_id else ""
        t = np.asarray(topic.data["timestamp"], dtype=np.float64) * 1e-6
        for field, values in topic.data.items():
            if field != "timestamp":
                yield Signal(f"{topic.name}{instance}.{field}", t, np.asarray(values))


def _rosbag(path: Path, raw: bytes) -> Iterator[Signal]:
    """ROS 1 bags, MCAP files with ROS messages: `/topic.field`, stamped when they were logged."""
    from rosbags.highlevel import AnyReader

    series: dict[str, tuple[list[float], list[float]]] = {}
    with AnyReader([path]) as reader:
        for connection, stamp, content in reader.messages():
            message = reader.deserialize(content, connection.msgtype)
            for name, value in _numbers(connection.topic, message, 0):
                times, values = series.setdefault(name, ([], []))
                times.append(stamp * 1e-9)
                values.append(value)
    for name, (times, values) in series.items():
        yield Signal(name, np.array(times), np.array(values))


def _mcap(path: Path, raw: bytes) -> Iterator[Signal]:
    """MCAP's messages in JSON: `/topic.field`, stamped when they were logged."""
    from mcap.reader import make_reader

    series: dict[str, tuple[list[int], list[float]]] = {}
    others: set[str] = set()
    for _, channel, message in make_reader(io.BytesIO(raw)).iter_messages():
        if channel.message_encoding != "json":
            others.add(f"{channel.topic} ({channel.message_encoding or 'no encoding'})")
            continue
        for name, value in _numbers(channel.topic, json.loads(message.data), 0):
            times, values = series.setdefault(name, ([], []))
            times.append(message.log_time)
            values.append(value)
    # a float64 cannot hold nanoseconds since 1970 exactly
    first = min((times[0] for times, _ in series.values()), default=0)
    for name, (stamps, values) in series.items():
        yield Signal(name, (np.array(stamps) - first) * 1e-9, np.array(values))
    for name in sorted(others):
        yield Signal(name, None, np.array("no JSON"))


def _numbers(
    name: str, value: Any, depth: int, labels: tuple[str, ...] = ()
) -> Iterator[tuple[str, float]]:
    """The numbers of a message by name; those of an array by its labels, if it has as many."""
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        yield name, float(value)
    elif depth >= _DEPTH:
        return
    elif isinstance(value, (list, tuple, np.ndarray)):
        known = labels if len(labels) == len(value) else range(len(value))
        for k, item in zip(known, value[:ELEMENTS], strict=False):
            yield from _numbers(f"{name}.{k}", item, depth + 1, labels)
    else:
        fields = value if isinstance(value, dict) else _fields(value)
        own = labels_of(fields) or labels
        for field, item in fields.items():
            yield from _numbers(f"{name}.{field}", item, depth + 1, own)


def _fields(message: Any) -> dict[str, Any]:
    names = getattr(message, "__dataclass_fields__", ())
    return {name: getattr(message, name) for name in names if not name.startswith("__")}


_FORMATS = {"double": "<f8", "float": "<f4", "int64": "<i8", "boolean": "?"}
"""WPILib's numeric types as NumPy types; `TYPE[]` is an array of them."""


def _wpilog(path: Path, raw: bytes) -> Iterator[Signal]:
    """WPILib's data log 1.0, read here: `wpiutil/doc/datalog.adoc` of the allwpilib repository."""
    if len(raw) < 12 or struct.unpack_from("<H", raw, 6)[0] >> 8 != 1:
        raise DataError(f"{path}: expected a WPILib data log of version 1")
    at = 12 + struct.unpack_from("<I", raw, 8)[0]
    kinds: dict[int, tuple[str, np.dtype[Any], bool]] = {}
    series: dict[str, tuple[list[int], list[tuple[Any, ...]]]] = {}
    while at < len(raw):
        head = raw[at]
        sizes = (head & 3) + 1, (head >> 2 & 3) + 1, (head >> 4 & 7) + 1
        fields = []
        at += 1
        for size in sizes:
            fields.append(int.from_bytes(raw[at : at + size], "little"))
            at += size
        entry, length, stamp = fields
        payload = raw[at : at + length]
        at += length
        if len(payload) < length:
            break  # a truncated log is read up to its last whole record
        if entry == 0:
            _control(payload, kinds)
        elif entry in kinds:
            name, dtype, many = kinds[entry]
            if len(payload) % dtype.itemsize or (len(payload) != dtype.itemsize and not many):
                raise DataError(f"{path}: expected {dtype} in {name!r}, got {len(payload)} bytes")
            values = np.frombuffer(payload, dtype)[:ELEMENTS].tolist()
            for k, value in enumerate(values):
                times, column = series.setdefault(f"{name}.{k}" if many else name, ([], []))
                times.append(stamp)
                column.append(value)
    for name, (times, column) in series.items():
        yield Signal(name, np.array(times, dtype=np.float64) * 1e-6, np.array(column))


def _control(payload: bytes, kinds: dict[int, tuple[str, np.dtype[Any], bool]]) -> None:
    """Apply a control record: start (0) or finish (1) of an entry; others are ignored."""
    if payload[:1] == b"\x01":
        kinds.pop(struct.unpack_from("<I", payload, 1)[0], None)
    if payload[:1] != b"\x00":
        return
    (entry,), texts, at = struct.unpack_from("<I", payload, 1), [], 5
    for _ in range(2):
        (length,) = struct.unpack_from("<I", payload, at)
        texts.append(payload[at + 4 : at + 4 + length].decode("utf-8", "replace"))
        at += 4 + length
    name, kind = texts
    if kind.removesuffix("[]") in _FORMATS:
        kinds[entry] = name, np.dtype(_FORMATS[kind.removesuffix("[]")]), kind.endswith("[]")


def _blackbox(path: Path, raw: bytes) -> Iterator[Signal]:
    """Betaflight's black box, read here: fields of the main frames, `motor.0` and the like."""
    for name, t, values in blackbox_series(raw):
        yield Signal(name, t, values)


def _saleae(path: Path, raw: bytes) -> Iterator[Signal]:
    """An analogue channel of Saleae's Logic 2, exported as binary, read here."""
    t, values = saleae_series(raw)
    yield Signal("voltage", t, values, "V")


@dataclass(frozen=True)
class _Kind:
    """First bytes of a log, its title, the package that reads it (None: sewfast), its reader."""

    magic: tuple[bytes, ...]
    title: str
    module: str | None
    signals: Callable[[Path, bytes], Iterator[Signal]]


_KINDS = {
    "mdf": _Kind((b"MDF     ", b"UnFinMF "), "an MDF file", "asammdf", _mdf),
    "tdms": _Kind((b"TDSm",), "a TDMS file", "nptdms", _tdms),
    "ulog": _Kind((b"ULog\x01\x12\x35",), "a PX4 ULog", "pyulog", _ulog),
    "wpilog": _Kind((b"WPILOG",), "a WPILib data log", None, _wpilog),
    "rosbag": _Kind((b"#ROSBAG V2.0",), "a ROS bag", "rosbags", _rosbag),
    "mcap": _Kind((), "an MCAP file", "mcap", _mcap),
    "blackbox": _Kind((BLACKBOX,), "a Betaflight black box log", None, _blackbox),
    "saleae": _Kind((SALEAE,), "a Saleae export", None, _saleae),
}


def _kind_of(raw: bytes) -> str | None:
    for name, kind in _KINDS.items():
        if raw.startswith(kind.magic):
            return name
    if not raw.startswith(MAGIC):
        return None
    # an MCAP file states its profile behind the opcode and length of its header
    if raw.startswith(b"ros", len(MAGIC) + 13):
        return "rosbag"
    # a recording of sewfast, even if damaged or repacked, still contains one of these
    own = any(mark in raw for mark in (b"/sewfast/", b"sewfast.recording", LIBRARY.encode()))
    return None if own else "mcap"
