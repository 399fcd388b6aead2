"""`Header`: the description of a recording, as JSON in its first message."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from types import MappingProxyType
from typing import Any

import numpy as np

from ..arrays import is_whole
from ..errors import SettingError
from ..storage import with_printable_texts

FORMAT, VERSION = "sewfast.recording", 1
LARGEST_HEADER = 1 << 20
"""Bytes of the header as JSON."""
MOST_MISSING = 50_000_000
"""Most values in all gaps of a recording together: a reader allocates them."""
_TAKEN = ("t", "index")
_EMPTY: Mapping[str, Any] = MappingProxyType({})


def bearable(missing: int, columns: int) -> bool:
    """Whether a reader would allocate the rows of gaps of `missing` samples altogether."""
    return missing * columns <= MOST_MISSING


def now() -> str:
    """The time of day in UTC, ISO 8601, to the microsecond."""
    return datetime.now(timezone.utc).isoformat(timespec="microseconds")


@dataclass(frozen=True)
class Header:
    """Description of a recording, written before its first sample.

    Parameters
    ----------
    name : str
        Name of the excitation or reference.
    Ts : float
        Sample time [s].
    columns : mapping of name to unit
        For example ``{"u": "V", "counts": "1", "speed_true": "RPM"}``; ``t`` and ``index`` are
        reserved.
    n : int or None
        Planned number of samples; None: until stopped.
    counts_per_rev : float or None
        Encoder counts of one turn, for the column ``counts``.
    device : mapping
        Identity: name, firmware, boot id, schema hash, protocol version.
    settings : mapping
        Signal, seed, limits, gains, watchdog: everything needed to repeat the run.
    started : str
        Time of sample 0, ISO 8601 with its offset from UTC; now by default.

    Raises
    ------
    SettingError
        For a value that is outside its range or has no JSON form.
    """

    name: str
    Ts: float
    columns: Mapping[str, str]
    n: int | None = None
    counts_per_rev: float | None = None
    device: Mapping[str, Any] = field(default_factory=lambda: _EMPTY)
    settings: Mapping[str, Any] = field(default_factory=lambda: _EMPTY)
    started: str = field(default_factory=now)

    def __post_init__(self) -> None:
        # sample times [s]: the file counts nanoseconds
        shortest_ts, longest_ts = 1e-9, 1e6
        if not isinstance(self.name, str):
            raise SettingError(name="name", expected="text", received=repr(self.name))
        object.__setattr__(self, "Ts", _positive("Ts", self.Ts))
        if not shortest_ts <= self.Ts <= longest_ts:
            raise SettingError(
                name="Ts", expected=f"{shortest_ts:g} to {longest_ts:g} s", received=f"{self.Ts:g}"
            )
        object.__setattr__(self, "columns", _columns(self.columns))
        if self.n is not None:
            object.__setattr__(self, "n", _whole_number(self.n))
        if self.counts_per_rev is not None:
            value = _positive("counts_per_rev", self.counts_per_rev)
            object.__setattr__(self, "counts_per_rev", value)
        object.__setattr__(self, "device", _plain("device", self.device))
        object.__setattr__(self, "settings", _plain("settings", self.settings))
        plain("header", {"texts": [self.name, *self.columns, *self.columns.values()]})
        if len(self.encode()) > LARGEST_HEADER:
            raise SettingError(
                name="header", expected=f"at most {LARGEST_HEADER} bytes",
                received=str(len(self.encode())), remedy="leave long settings out",
            )  # fmt: skip
        self.start_ns()

    def start_ns(self) -> int:
        """`started` in nanoseconds since 1970-01-01 UTC."""
        try:
            # Python 3.10 cannot parse the Z
            at = datetime.fromisoformat(self.started.replace("Z", "+00:00"))
        except (AttributeError, TypeError, ValueError):
            at = None
        if at is None or at.tzinfo is None or not 1970 < at.year < 2500:
            raise SettingError(
                name="started",
                expected="a time such as 2026-01-31T12:00:00+00:00, with its offset from UTC",
                received=repr(self.started),
            )  # fmt: skip
        since = at - datetime(1970, 1, 1, tzinfo=timezone.utc)
        return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000

    def time_ns(self, index: int) -> int:
        """Time of sample `index` in nanoseconds since 1970-01-01 UTC."""
        # the last time that the file can state, in the year 2554
        return min(self.start_ns() + round(index * self.Ts * 1e9), 2**64 - 1)

    def encode(self) -> bytes:
        """The header message: JSON with format and version."""
        content = {
            "format": FORMAT,
            "version": VERSION,
            "name": self.name,
            "Ts": self.Ts,
            "columns": dict(self.columns),
            "n": self.n,
            "counts_per_rev": self.counts_per_rev,
            "device": dict(self.device),
            "settings": dict(self.settings),
            "started": self.started,
        }
        return json.dumps(content, allow_nan=False).encode()

    def __reduce__(self) -> tuple[Any, ...]:
        return Header.from_json, (json.loads(self.encode()),)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Header:
        """From the header message.

        Raises
        ------
        SettingError
            If it is of another format or version, or a value is missing or unusable.
        """
        content = with_printable_texts(content)
        if content.get("format") != FORMAT:
            raise SettingError(
                name="format", expected=repr(FORMAT), received=repr(str(content.get("format"))[:60])
            )
        if content.get("version") != VERSION or isinstance(content["version"], bool):
            raise SettingError(
                name="version", expected=f"{VERSION} of {FORMAT!r}",
                received=str(content.get("version"))[:60],
                remedy="try a newer sewfast",
            )  # fmt: skip
        names = ("name", "Ts", "columns", "n", "counts_per_rev", "device", "settings", "started")
        if missing := [name for name in names if name not in content]:
            raise SettingError(name="header", expected=" and ".join(missing), received="none")
        return cls(**{name: content[name] for name in names})


def _positive(what: str, value: object) -> float:
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    try:
        found = float(value) if number else math.nan  # type: ignore[arg-type]
    except OverflowError:
        found = math.inf
    if not (math.isfinite(found) and found > 0):
        raise SettingError(name=what, expected="a positive number", received=str(value)[:60])
    return found


def _whole_number(value: object) -> int:
    if not is_whole(value) or not 0 <= value <= 2**53:
        raise SettingError(
            name="n", expected="a whole number of samples or None", received=repr(value)
        )
    return int(value)


def _columns(columns: object) -> Mapping[str, str]:
    most_columns = 256
    if not isinstance(columns, Mapping) or not 0 < len(columns) <= most_columns:
        raise SettingError(
            name="columns", expected=f"1 to {most_columns} names with their units",
            received=str(columns)[:200],
        )  # fmt: skip
    for name, unit in columns.items():
        text = isinstance(name, str) and isinstance(unit, str)
        if not text or not name.strip() or name in _TAKEN:
            raise SettingError(
                name="columns",
                expected=f"a name other than {' and '.join(_TAKEN)} with its unit as text",
                received=f"{name!r}: {unit!r}",
            )  # fmt: skip
    return MappingProxyType(dict(columns))


def _plain(what: str, content: object) -> Mapping[str, Any]:
    """A copy that survives JSON unchanged."""
    if not isinstance(content, Mapping):
        raise SettingError(name=what, expected="a mapping", received=type(content).__name__)
    return MappingProxyType(plain(what, content))


def plain(what: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """A deep copy of finite numbers, text, lists and dicts; NumPy's values become Python's."""
    try:
        text = json.dumps(dict(content), allow_nan=False, ensure_ascii=False, default=_python)
        # half of a surrogate pair could not be printed
        text.encode()
    except (TypeError, ValueError, RecursionError) as e:
        raise SettingError(
            name=what, expected="finite numbers, text, lists and dicts", received=str(e),
            remedy="infinity is written as None",
        ) from e  # fmt: skip
    copy: dict[str, Any] = json.loads(text)
    return copy


def _python(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"a value of type {type(value).__name__}")
