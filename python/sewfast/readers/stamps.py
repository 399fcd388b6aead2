"""Moments that are written as text or held as objects -> seconds.

Loggers and spreadsheets write a date and a time of day, `2026-03-14 10:00:00.010`, or the time of
day alone. Only differences matter here, so every column counts from its own first moment.
"""

from __future__ import annotations

import datetime
import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..arrays import FloatArray

_MOMENT = re.compile(
    r"(?:(?P<ymd>\d{4}[-/.]\d\d?[-/.]\d\d?)|(?P<other>\d\d?[./-]\d\d?[./-]\d{4}))?[T ]*"
    r"(?P<h>\d\d?):(?P<m>[0-5]\d)(?::(?P<s>[0-5]\d)(?:[.,:](?P<f>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>[Zz]|[+-]\d\d:?\d\d)?"
)
_DAY = 86_400 * 10**9

Date = Callable[[str], int]
"""The day that a text stands for, counted from any one."""


def is_moment(text: str) -> bool:
    """Whether a text is a time of day, with or without a date."""
    return _MOMENT.fullmatch(text.strip()) is not None


def seconds_of_texts(texts: Sequence[str]) -> FloatArray | None:
    """Seconds from the first moment; None where a text is none.

    A date is year, month, day, or day, month, year between points; between slashes it is read with
    the month first where that gives dates. A time of day without a date goes on after midnight.
    """
    found = [_MOMENT.fullmatch(text.strip()) for text in texts]
    for date in (_month_first, _day_first):
        try:
            moments = [_nanoseconds(m, date) for m in found if m is not None]
        except ValueError:  # no such day
            continue
        if len(moments) != len(found) or not moments:
            return None
        if all(m is None or not (m["ymd"] or m["other"]) for m in found):
            moments = _across_midnight(moments)
        return _from_first(moments)
    return None


def seconds_of_objects(values: Sequence[Any]) -> FloatArray | None:
    """Seconds of Python's moments, times of day or durations, the first two from the first one.

    None for anything else; NaN where a value is missing (None, NaT, NaN).
    """
    known = [v for v in values if v is not None and v == v]
    if not known:
        return None
    made: list[int] = []
    for value in known:
        if isinstance(value, str):
            return None if len(known) < len(values) else seconds_of_texts(list(values))
        if isinstance(value, datetime.datetime):
            # clocks are set forward and back; where the zone is known that does not matter
            naive = value if value.tzinfo is None else value.astimezone(datetime.timezone.utc)
            made.append(_of_delta(naive.replace(tzinfo=None) - datetime.datetime(1970, 1, 1)))
        elif isinstance(value, datetime.time):
            midnight = datetime.datetime.combine(datetime.date(1970, 1, 1), datetime.time())
            moment = datetime.datetime.combine(midnight.date(), value.replace(tzinfo=None))
            made.append(_of_delta(moment - midnight))
        elif isinstance(value, datetime.timedelta):
            made.append(_of_delta(value))
        else:
            return None
    if len({type(v) for v in known}) > 1:
        return None
    if isinstance(known[0], datetime.time):
        made = _across_midnight(made)
    first = 0 if isinstance(known[0], datetime.timedelta) else made[0]
    seconds = iter(np.array([m - first for m in made], dtype=np.float64) * 1e-9)
    return np.array([next(seconds) if v is not None and v == v else np.nan for v in values])


def _of_delta(delta: datetime.timedelta) -> int:
    """Whole nanoseconds; a float of seconds since 1970 would not keep microseconds."""
    whole = (delta.days * 86_400 + delta.seconds) * 10**9 + delta.microseconds * 1000
    return whole + int(getattr(delta, "nanoseconds", 0))


def _nanoseconds(match: re.Match[str], date: Date) -> int:
    hours = int(match["h"])
    if match["half"]:
        hours = hours % 12 + (12 if match["half"].lower() == "pm" else 0)
    whole = (hours * 60 + int(match["m"])) * 60 + int(match["s"] or 0)
    zone = match["zone"] or "Z"
    if zone not in "Zz":
        offset = (int(zone[1:3]) * 60 + int(zone[-2:])) * 60
        whole += offset if zone[0] == "-" else -offset
    written = match["ymd"] or match["other"]
    days = date(written) if written else 0
    return days * _DAY + whole * 10**9 + int((match["f"] or "0").ljust(9, "0"))


def _month_first(text: str) -> int:
    first, second, third = (int(part) for part in re.split(r"[-/.]", text))
    if first > 31:
        return datetime.date(first, second, third).toordinal()
    if "/" not in text:
        return datetime.date(third, second, first).toordinal()
    return datetime.date(third, first, second).toordinal()


def _day_first(text: str) -> int:
    first, second, third = (int(part) for part in re.split(r"[-/.]", text))
    parts = (first, second, third) if first > 31 else (third, second, first)
    return datetime.date(*parts).toordinal()


def _across_midnight(moments: list[int]) -> list[int]:
    """Times of day that fall by more than half a day are those of the next day."""
    days, made = 0, moments[:1]
    for before, now in itertools.pairwise(moments):
        days += before - now > _DAY // 2
        made.append(now + days * _DAY)
    return made


def _from_first(moments: Sequence[int]) -> FloatArray:
    first = moments[0]
    return np.array([m - first for m in moments], dtype=np.float64) * 1e-9
