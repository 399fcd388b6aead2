"""The sample time of a table, and an even grid for uneven time stamps."""

from __future__ import annotations

import datetime
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..errors import DataError, SettingError
from .containers import Table

TOLERANCE = 0.01
"""Part of the period by which even steps can differ from it."""
GAP = 3.5
"""Steps of more periods than this are gaps, in which nothing is known."""
_SECONDS = {
    "": 1.0, "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "ns": 1e-9,
    **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours", "std"), 3600.0),
    "millis": 1e-3, "milliseconds": 1e-3, "micros": 1e-6, "microseconds": 1e-6,
    "nanos": 1e-9, "nanoseconds": 1e-9,
}  # fmt: skip
_UNIT = "|".join(filter(None, _SECONDS))
_TIME = re.compile(
    r"(?:t|(?:(?:elapsed|relative|rel|unix|epoch|system|sys|log|run)[_ ]?)?time|time[_ ]?stamp|"
    r"stamp|"
    r"(?:elapsed|relative|rel|unix|epoch)|time[_ ]since[_ ](?:start|boot|power[_ ]?on)|seconds?|"
    rf"zeit|laufzeit|zeitstempel|temps|tiempo|tempo|x-axis|x_value)(?:[_ ]({_UNIT}))?"
    r"|(ms|us|millis(?:econds)?|micros(?:econds)?|nanos(?:econds)?)"
)
"""Names of a time column, with its unit or as its unit alone; `x-axis` and `x_value` are those of
Keysight's scopes and of LabVIEW, `millis` and `micros` those of an Arduino."""
_DATE = re.compile(r"date|date[_ ]?time|datum|zeitpunkt|moment")
"""Names of a time column whose cells were dates with times of day."""
_NUMBER = re.compile(
    r"#|(sample|row|line|record|packet|frame)s?([_ ]?(no|nr|number|index|count|counter))?|index|"
    r"idx|no|nr|seq(uence)?|counter|n|k"
)
"""Names of a column that numbers the rows, if its numbers do (`numbers_rows`)."""
LONG, ABSURD, SHORT = 0.5, 900.0, 1e-5
"""Sample times [s] of a time column without a unit, read as seconds. From `LONG` on, a warning says
that the unit can be another one: drives are sampled every 20 us to 200 ms, so a column that counts
milliseconds (from 1 ms) or smaller units (from 1 us) lies above it. So do processes with time
constants of minutes, but no controlled process lies above `ABSURD`, which is refused. Units that
would make a sample time below `SHORT` are not suggested."""
_EPOCH = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "us"), (1e11, 1e-3, "ms"))
"""From which number on a time without a unit counts which unit since 1970: seconds reach 1e11 in
the year 5138, milliseconds reached it in 1973."""


@dataclass(frozen=True, eq=False)
class TimeBase:
    """Sample time of a table [s], and how its rows become samples.
    `grid` is None where every row is one; `notes` are the assumptions that were made.
    """

    Ts: float
    grid: Grid | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Grid:
    """An even grid over uneven time stamps. `count` is the number of the table's rows; `rows` are
    the indices of those used, of several with one time stamp the last, and `t` (rows,) their times
    [s], the first at 0. `Ts` is the step of the grid [s], and `period` the median step of the time
    stamps [s]. If `exact`, every row lies on the grid: nothing is interpolated, rows are missing.
    """

    count: int
    rows: NDArray[np.intp]
    t: FloatArray
    Ts: float
    period: float
    exact: bool

    @property
    def times(self) -> FloatArray:
        """Times of the grid [s]."""
        return np.arange(1 + math.floor(self.t[-1] / self.Ts + 0.01)) * self.Ts

    @property
    def gaps(self) -> FloatArray:
        """Lengths of the gaps [s]."""
        steps = np.diff(self.t)
        found: FloatArray = steps[steps > GAP * self.period]
        return found

    def output(self, column: FloatArray) -> FloatArray:
        """A measured column at the grid's times: straight lines between rows, NaN in gaps."""
        known, at = column[self.rows], self.times
        if self.exact:
            found = np.full(len(at), np.nan)
            found[np.rint(self.t / self.Ts).astype(np.intp)] = known
            return found
        after = np.clip(np.searchsorted(self.t, at, side="left"), 1, len(self.t) - 1)
        before = after - 1
        length = self.t[after] - self.t[before]
        share = np.clip((at - self.t[before]) / length, 0.0, 1.0)
        line = known[before] + share * (known[after] - known[before])
        # inside a gap nothing is known; a grid time that coincides with a row needs no other row
        line = np.where(length > GAP * self.period, np.nan, line)
        line = np.where(share < TOLERANCE, known[before], line)
        found = np.where(share > 1.0 - TOLERANCE, known[after], line)
        return found

    def held(self, column: FloatArray) -> FloatArray:
        """The mean over each step of the grid of a column that is held from row to row.
        This keeps the input's integral, as `Dataset.resample` does. It is NaN where a part of the
        step lies in a gap or belongs to a row without a value.
        """
        if self.exact:
            found = self.output(column)
            place = np.rint(self.t / self.Ts).astype(np.intp)
            for before, steps in zip(place, np.diff(place), strict=False):
                if 1 < steps <= GAP:
                    found[before + 1 : before + steps] = found[before]
            return found
        cut = self.t[:-1][np.diff(self.t) > GAP * self.period] + self.period
        starts = np.concatenate([self.t, cut])
        order = np.argsort(starts, kind="stable")
        values = np.concatenate([column[self.rows], np.full(len(cut), np.nan)])[order]
        edges = np.append(starts[order], self.t[-1] + max(self.period, self.Ts))
        unknown = ~np.isfinite(values)
        middle = 0.0 if unknown.all() else float(np.mean(values[~unknown]))
        filled = np.where(unknown, 0.0, values - middle)
        ends = np.append(self.times, self.times[-1] + self.Ts)
        means = middle + _means(filled, edges, ends)
        missing = _means(unknown.astype(np.float64), edges, ends) > TOLERANCE
        return np.where(missing, np.nan, means)

    def note(self, table: Table) -> str:
        """What was done, for the notes; a warning where rows are missing or doubled."""
        steps = np.diff(self.t)
        gaps = self.gaps
        missing = len(self.times) - len(self.rows) if self.exact else 0
        said = []
        if missing:
            place = table.row(int(self.rows[1 + np.argmax(steps)]))
            text = (
                f"{counted(missing, 'row')} missing in the even time stamps of {self.Ts:g} s, "
                f"{'' if missing == 1 else 'the longest gap '}before {place}"
            )
            if not len(gaps):
                text += (
                    ": outputs there are not known (NaN), inputs are held for up to "
                    f"{math.floor(GAP) - 1} samples"
                )
            said.append(text)
        elif not self.exact:
            inside = steps[steps <= GAP * self.period]
            said.append(
                f"time stamps are uneven (steps of {inside.min():.4g} to {inside.max():.4g} s, "
                f"median {self.period:.4g} s); resampled to Ts = {self.Ts:.6g} s, outputs by "
                "straight lines between rows, inputs as held and averaged"
            )
        if len(gaps) == 1:
            said.append(f"1 gap of {gaps[0]:.4g} s is not known (NaN)")
        elif len(gaps):
            said.append(f"{len(gaps)} gaps, the longest {gaps.max():.4g} s, are not known (NaN)")
        if doubled := self.count - len(self.rows):
            after = self.rows[np.flatnonzero(np.diff(self.rows, prepend=-1) > 1)[0]]
            said.append(
                f"{counted(doubled, 'row')} left out, as the next one has the same time stamp "
                f"(first before {table.row(int(after))})"
            )
        lost = missing or doubled or len(gaps)
        return f"{'warning: ' if lost else ''}{table.path.name}: {'; '.join(said)}"


def counted(count: int, what: str) -> str:
    """`1 row is`, `3 rows are`."""
    return f"1 {what} is" if count == 1 else f"{count} {what}s are"


def _means(values: FloatArray, edges: FloatArray, ends: FloatArray) -> FloatArray:
    """Means between `ends` of values that each hold from one edge to the next."""
    total = np.concatenate([[0.0], np.cumsum(values * np.diff(edges))])
    found: FloatArray = np.diff(np.interp(ends, edges, total)) / np.diff(ends)
    return found


def time_column(table: Table) -> str | None:
    """The column with a name for time: t, time, timestamp, seconds, also time_ms and the like.
    Where there is none, dates with times of day are the time, whatever the name.
    """
    names = [n for n in table.names if _is_time(n)] or [
        n for n in table.names
        if n in table.moments or (_DATE.fullmatch(n.lower()) and table.unit(n) == "s")
    ]  # fmt: skip
    return next((n for n in names if n.lower() in ("t", "time")), next(iter(names), None))


def _is_time(name: str) -> bool:
    return _TIME.fullmatch(name.lower()) is not None


# --- Columns that number the rows -----------------------------------------------------------------


def numbers_rows(table: Table, name: str) -> bool:
    """Whether a column numbers the rows, by its name and as most of its steps are the same."""
    # `n [rpm]` is a speed
    named = _NUMBER.fullmatch(name.lower()) and table.unit(name) in ("", "-", "1", "#")
    return bool(named) and _step(table[name]) > 0


def _step(numbers: FloatArray) -> float:
    """The step of nine in ten of these whole numbers; 0 if there is none."""
    if len(numbers) < 3 or not (np.abs(numbers) < 2.0**53).all() or (numbers % 1.0).any():
        return 0.0
    steps = np.diff(numbers)
    usual = float(np.median(steps))
    return usual if np.mean(steps == usual) >= 0.9 else 0.0


def _misnumbered(table: Table, taken: str | None) -> tuple[str, ...]:
    """Warnings on numbers of rows that are missing, doubled or out of order."""
    names = [n for n in table.names if n != taken and numbers_rows(table, n)]
    return tuple(note for n in names[:1] for note in _jumps(table, n))


def _jumps(table: Table, name: str) -> Iterator[str]:
    numbers = table[name]
    step, steps = _step(numbers), np.diff(numbers)
    # what wraps goes on with its usual step: an integer, or twice a count of something else
    span = float(np.ptp(numbers)) + step
    cyclic = np.sum(steps + span == step) > 1
    turn = span if cyclic else next((2.0**b for b in (8, 16, 32) if numbers.max() < 2.0**b), 0.0)
    if (steps + turn == step).any():
        steps = np.where(steps < -0.5 * turn, steps + turn, steps)
    back = steps < 0.0
    faults = [(back, "out of order")] if back.any() else [
        (steps > step, "missing"), (steps == 0.0, "doubled")
    ]  # fmt: skip
    for wrong, what in faults:
        if len(at := np.flatnonzero(wrong)):
            k = int(at[0])
            count = round(float(np.sum(steps[at] / step - 1.0))) if steps[k] > 0.0 else len(at)
            yield (
                f"warning: {table.path.name}: {counted(count, 'row')} {what} by the numbers in "
                f"column {name!r}, at {len(at)} place{'' if len(at) == 1 else 's'}, first "
                f"{numbers[k + 1]:.15g} after {numbers[k]:.15g} at {table.row(k + 1)}: use a part "
                "without such places (--train A:B), or record it again"
            )


# --- Time column -> sample time -------------------------------------------------------------------


def time_base(table: Table, given: float | None, column: str | None = None) -> TimeBase:
    """`_time_base`, with the rows that a column of numbers shows as lost."""
    base = _time_base(table, given, column)
    if base.grid is not None and base.grid.exact:
        return base
    taken = table.resolve(column) if column is not None else time_column(table)
    return replace(base, notes=(*base.notes, *_misnumbered(table, taken)))


def _time_base(table: Table, given: float | None, column: str | None) -> TimeBase:
    """Sample time and, where its time stamps are uneven, a grid for a table.
    `given` is the caller's sample time [s]: checked against even time stamps, the step of the grid
    for uneven ones. Raises `DataError` if time goes back, or even time stamps disagree with `given`
    by more than 1 %, or a grid would have far more samples than there are rows; `SettingError` if
    there is neither a time column nor a sample time.
    """
    if given is not None and not (
        isinstance(given, (int, float, np.number)) and math.isfinite(given) and given > 0
    ):
        raise SettingError(f"Ts: expected a positive sample time in seconds, received {given!r}")
    name = table.resolve(column) if column is not None else time_column(table)
    stated = table.Ts is not None and column is None
    if stated and (table.Ts_source == "the header" or name is None):
        assert table.Ts is not None
        if given is None:
            note = f"{table.path.name}: Ts = {table.Ts:g} s, from {table.Ts_source}"
            return TimeBase(table.Ts, None, () if table.Ts_source == "the header" else (note,))
        return TimeBase(_agreed(table, table.Ts_source, table.Ts, given))
    if name is None:
        if given is None:
            for spoiled in filter(_is_time, table.unusable):
                table.resolve(spoiled)  # raises with the reason
            raise SettingError(
                name=str(table.path), expected="a column t or time",
                received=f"{', '.join(table.names[:30])}",
                remedy="state the sample time in seconds (Ts, --ts), or name the column (time=...)",
            )  # fmt: skip
        return TimeBase(float(given))
    scale, notes = _unit(table, name)
    t = _seconds(table, name, scale or 1.0)
    steps = np.diff(t)
    period = float(np.median(steps[steps > 0.0]))
    if scale is None:
        scale, notes = _guessed(table, name, period, given)
        t, steps, period = t * scale, steps * scale, period * scale
    if np.abs(steps - period).max() <= TOLERANCE * period:
        # the mean step is exact even where every printed time is rounded
        found = float(t[-1] / len(steps))
        Ts = found if given is None else _agreed(table, f"column {name!r}", found, given)
        return TimeBase(Ts, None, notes)
    grid = _grid(table, name, t, period, given)
    return TimeBase(grid.Ts, grid, (*notes, grid.note(table)))


def _agreed(table: Table, source: str, found: float, given: float) -> float:
    if abs(found - given) > TOLERANCE * given:
        raise DataError(
            name=str(table.path), expected=f"Ts within 1 % of {found:.6g} s, as {source} says",
            received=f"{given:.6g} s", remedy="for another sample time resample (--resample)",
        )  # fmt: skip
    return float(given)


def _unit(table: Table, name: str) -> tuple[float | None, tuple[str, ...]]:
    """Seconds per unit of a time column, from its header, else from its name (time_ms).
    Numbers too large for seconds since 1970 count a smaller unit, which a note states. None if no
    unit is stated.
    """
    unit = table.unit(name)
    if not unit:
        match = _TIME.fullmatch(name.lower())
        unit = (match[1] or match[2] or "") if match else ""
    if unit.lower() not in _SECONDS:
        raise DataError(
            f"{table.path}: time in {unit!r} is not understood; expected ns, us, ms, s, min or h"
        )
    first = table[name][0] if len(table[name]) else 0.0
    for least, scale, epoch in _EPOCH if not unit else ():
        if math.isfinite(first) and first > least:
            note = f"{table.path.name}: column {name!r} is taken as {epoch} since 1970"
            return scale, (note,)
    return _SECONDS[unit.lower()] if unit else None, ()


def _guessed(
    table: Table, name: str, step: float, given: float | None
) -> tuple[float, tuple[str, ...]]:
    """Seconds per unit of a time column that states no unit, from its median step. The unit is
    seconds, unless the caller's sample time fits a smaller one. Steps that are long for a drive
    cause a warning, since the column then probably counts milliseconds.
    """
    smaller = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
    for unit, scale in smaller if given is not None and given < 0.01 * step else ():
        # not for a grid far finer than the rows
        if given is not None and 0.5 * given < step * scale < 2.0 * given:
            return scale, (f"{table.path.name}: column {name!r} counts {unit}, according to Ts",)
    if step < LONG or given is not None:
        return 1.0, ()
    ways = " or ".join(
        f"--ts {step * scale:.3g} if it counts {unit}"
        for unit, scale in smaller
        if SHORT <= step * scale < LONG
    )
    if step >= ABSURD:
        raise SettingError(
            name=f"{table.path}: column {name!r}", expected="a time with its unit",
            received=f"steps of {step:g} without one",
            remedy=f"state the sample time in seconds (Ts), {ways or '--ts'}, or name the unit in "
            "the header: t [ms]",
        )  # fmt: skip
    return 1.0, (
        f"warning: {table.path.name}: column {name!r} states no unit and is taken as seconds, so "
        f"that Ts = {step:g} s, long for a drive; if that is wrong, give "
        f"{ways or 'the sample time (--ts)'}, or name the unit in the header: t [ms]",
    )


def _seconds(table: Table, name: str, unit: float) -> FloatArray:
    """Times [s] from 0 on, never decreasing."""
    raw = table[name]
    if len(raw) < 2:
        raise DataError(
            f"{table.path}: column {name!r}: expected at least 2 samples, received {len(raw)}"
        )
    bad = np.flatnonzero(~np.isfinite(raw))
    if len(bad):
        raise DataError(
            f"{table.path}: column {name!r}: expected a time in every row, received {raw[bad[0]]} "
            f"at {table.row(int(bad[0]))}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        t: FloatArray = (raw - raw[0]) * unit
        steps = np.diff(t)
    # largest time [s]; sums of larger ones would overflow
    if not (np.abs(t) <= 1e300).all():
        raise DataError(
            f"{table.path}: column {name!r}: expected times within the numbers, received "
            f"{raw.min():g} to {raw.max():g}; check the column"
        )
    back = np.flatnonzero(steps < 0.0)
    same = int(np.sum(steps == 0.0))
    if len(back) or 2 * same > len(steps):
        k = int(back[0] if len(back) else np.flatnonzero(steps == 0.0)[0]) + 1
        why = _why_no_time(table, raw, back)
        raise DataError(
            f"{table.path}: column {name!r}: expected increasing time, received {raw[k]:.9g} after "
            f"{raw[k - 1]:.9g} at {table.row(k)}{why}; sort the rows or split the recording"
        )
    return t


def _why_no_time(table: Table, raw: FloatArray, back: NDArray[np.intp]) -> str:
    """How often time goes back or stands still, and what does so."""
    steps = np.diff(raw)
    if len(back):
        usual = float(np.median(steps))
        turns = [b for b in (16, 32) if (np.abs(steps[back] + 2.0**b - usual) < GAP * usual).all()]
        why = f": an integer of {turns[0]} bits that wraps, unwrap it first" if turns else ""
        return f" ({len(back)} of {len(steps)} steps go back{why})"
    same = np.flatnonzero(steps == 0.0)
    columns = [c for c in table.columns.values() if len(c) == len(raw)]
    twice = all(np.array_equal(c[same], c[same + 1], equal_nan=True) for c in columns)
    why = "rows written twice" if twice else "too coarse a clock"
    return f" (so are {len(same)} of {len(steps)} steps: {why})"


def _grid(table: Table, name: str, t: FloatArray, period: float, given: float | None) -> Grid:
    count = len(t)
    rows = np.flatnonzero(np.append(np.diff(t) > 0.0, True))
    t = t[rows] - t[rows[0]]
    # rows on a grid with empty places: the period that fits them best
    with np.errstate(over="ignore", invalid="ignore"):
        place = np.cumsum(np.append(0.0, np.rint(np.diff(t) / period)))
        fitted = float(t @ place / (place @ place)) if place[-1] > 0.0 else period
        off = np.abs(t - place * fitted).max()
    exact = bool(
        off <= TOLERANCE * fitted
        and (np.diff(place) > 0.0).all()
        and (given is None or abs(given - fitted) <= TOLERANCE * given)
    )
    Ts = fitted if exact else period if given is None else float(given)
    most = max(100 * len(t), 10_000)
    # in this order: a quotient of the largest time stamps would not be finite
    if not t[-1] < most * Ts:
        k = int(np.argmax(np.diff(t)))
        raise DataError(
            f"{table.path}: column {name!r}: expected time stamps that a grid of Ts = {Ts:.4g} s "
            f"has up to {most} samples for, received {len(t)} over {t[-1]:.4g} s, with a step of "
            f"{t[k + 1] - t[k]:.4g} s at {table.row(int(rows[k + 1]))}; remove that row, or "
            "give a longer sample time (Ts, --ts)"
        )
    if t[-1] < 2.0 * Ts:
        raise DataError(
            f"{table.path}: column {name!r}: expected time stamps over at least 2 sample times of "
            f"{Ts:.4g} s, received {t[-1]:.4g} s; give a shorter sample time (Ts, --ts)"
        )
    return Grid(count, rows, t, Ts, period, exact)


# --- Moments as text or objects -> seconds --------------------------------------------------------

# Loggers and spreadsheets write a date and a time of day, `2026-03-14 10:00:00.010`, or the time of
# day alone. Only differences matter here, so every column counts from its first moment.


_MOMENT = re.compile(
    r"(?:(?P<ymd>\d{4}[-/.]\d\d?[-/.]\d\d?)|(?P<other>\d\d?[./-]\d\d?[./-]\d{4}))?[T ]*"
    r"(?P<h>\d\d?):(?P<m>[0-5]\d)(?::(?P<s>[0-5]\d)(?:[.,:](?P<f>\d{1,9}))?)?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>[Zz]|[+-]\d\d:?\d\d)?"
)
_DAY = 86_400 * 10**9


def is_moment(text: str) -> bool:
    """Whether a text is a time of day, with or without a date."""
    return _MOMENT.fullmatch(text.strip()) is not None


def seconds_of_texts(texts: Sequence[str]) -> FloatArray | None:
    """Seconds from the first moment; None if a text is not a moment.
    A date is year, month, day, or day, month, year between points; between slashes the month comes
    first if that gives valid dates. Times of day without a date continue after midnight.
    """
    found = [_MOMENT.fullmatch(text.strip()) for text in texts]
    for month_first in (True, False):
        try:
            moments = [_nanoseconds(m, month_first=month_first) for m in found if m is not None]
        except ValueError:  # no such day
            continue
        if len(moments) != len(found) or not moments:
            return None
        if all(m is None or not (m["ymd"] or m["other"]) for m in found):
            moments = _across_midnight(moments)
        return np.array([m - moments[0] for m in moments], dtype=np.float64) * 1e-9
    return None


def seconds_of_objects(values: Sequence[Any]) -> FloatArray | None:
    """Seconds of Python's datetimes or times of day (from the first one) or durations.
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
            # in UTC, so that changes to and from summer time have no effect
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


def _nanoseconds(match: re.Match[str], *, month_first: bool) -> int:
    hours = int(match["h"])
    if match["half"]:
        hours = hours % 12 + (12 if match["half"].lower() == "pm" else 0)
    whole = (hours * 60 + int(match["m"])) * 60 + int(match["s"] or 0)
    zone = match["zone"] or "Z"
    if zone not in "Zz":
        offset = (int(zone[1:3]) * 60 + int(zone[-2:])) * 60
        whole += offset if zone[0] == "-" else -offset
    written = match["ymd"] or match["other"]
    days = _ordinal(written, month_first=month_first) if written else 0
    return days * _DAY + whole * 10**9 + int((match["f"] or "0").ljust(9, "0"))


def _ordinal(text: str, *, month_first: bool) -> int:
    first, second, third = (int(part) for part in re.split(r"[-/.]", text))
    if first > 31:
        return datetime.date(first, second, third).toordinal()
    if month_first and "/" in text:
        return datetime.date(third, first, second).toordinal()
    return datetime.date(third, second, first).toordinal()


def _across_midnight(moments: list[int]) -> list[int]:
    """Times of day, moved to the next day after each fall by more than half a day."""
    days, made = 0, moments[:1]
    for before, now in itertools.pairwise(moments):
        days += before - now > _DAY // 2
        made.append(now + days * _DAY)
    return made
