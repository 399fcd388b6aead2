"""`cause_of`: the name of what is wrong with a machine, from a run and earlier ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from . import _core
from .arrays import FloatArray, known_until
from .errors import DataError
from .recording import Recording

ABORTED = "_aborted"
"""Suffix of the names of recordings of runs that were ended early."""
EXPLAINED = 0.5
"""A change is believed if no more than this share of the error is left with it: on runs of healthy
drives, each fitted up to its change, .68 and more were left (docs/guards.md)."""
NOTED, TIMES = 0.02, 3.0
"""Without the change the error must be larger than this share of the speed, and larger by this
factor than on the earlier runs to which the motor was fitted."""
ALIKE, UNSURE = 0.05, 0.1
"""Shares of the speed by which a motor of its own errs at most on a run that can be an earlier one,
and on one that shows what the machine always was."""
LOST = 0.1
"""Shares of motion, of a speed, and of the largest command that count as none."""


@dataclass(frozen=True)
class Cause:
    """What is wrong with a machine.

    Attributes
    ----------
    name : str
        ``command sign``, ``encoder sign``, ``sign`` (one of both), ``encoder lost``, ``counts
        scaled``, ``counts jumped``, ``stage stuck``, ``stage off``, ``gain``, ``gain too large``,
        ``load``, ``turns at rest``, ``delay``, ``inertia``, ``friction``, ``dead zone``,
        ``integrates``, ``no motion`` or ``out of reach``.
    text : str
        What was seen, in numbers, and what to check.
    run : str
        Name of the run that shows it.
    at : float or None
        When it began in that run [s]; None if it was there before.
    value : float
        The number that belongs to it: a factor, a command [V], counts or seconds.
    """

    name: str
    text: str
    run: str
    at: float | None
    value: float

    def __str__(self) -> str:
        return f"{self.name}: {self.text}"

    def to_json(self) -> dict[str, Any]:
        """The fields as JSON values."""
        return {
            "name": self.name, "text": self.text, "run": self.run, "at": self.at,
            "value": self.value,
        }  # fmt: skip


class Seen(Cause):
    """A cause that a guard saw as it came, and not one that was concluded from a run."""


def loss(recording: Recording, k: int, concluded: Cause | None) -> Seen:
    """What became of an encoder whose counts fell from one sample to the next, as a guard saw by
    sample `k`: what the run says, if that is about signs or counts, else the ratio of the paces. A
    motor that was seen for some milliseconds may have been stopped by anything.
    """
    if concluded is not None and concluded.name in SUDDEN:
        found = concluded
    else:
        r = recording
        # samples that the guard waits, and those before the fall that it looks at
        waits = max(8, math.ceil(0.01 / r.Ts))
        paces = np.diff(r.counts[: k + 1])
        value = float(paces[-waits:].mean() / paces[-waits - 4 : -waits].mean())
        at, run = (k - waits) * r.Ts, r.name.removesuffix(ABORTED)
        name, text = _counts(value, f"{at:.3g} s after {run!r} began")
        found = Cause(name, text, run, at, value)
    return Seen(found.name, found.text, found.run, found.at, found.value)


def sudden(recording: Recording, moved: float | None = None) -> Cause | None:
    """What became of counts whose pace changed in the last samples by far more than in the run
    before, so that no torque did it; or that have `moved` since in a way in which nothing coasts.
    A device that trips at once leaves nothing else to look at.
    """
    # samples among which the change is; those before it whose pace is its mean; how far it stands
    # out from the largest change before; least counts a sample of a motor that turns
    last, earlier, factor, least = 3, 5, 3.0, 3.0
    paces = np.diff(recording.counts)
    paces = paces[np.isfinite(paces)]
    if len(paces) < last + 2 * earlier:
        return None
    changes = np.abs(np.diff(paces))
    k = len(paces) - last + int(np.argmax(changes[-last:]))
    pace, now = float(paces[k - earlier : k].mean()), float(paces[k])
    # a motor that only begins to turn has no pace yet to tell it from
    if abs(pace) < least:
        return None
    if not changes[k - 1] > factor * changes[:-last].max():
        # it went on until the end: from there a motor coasts by more than a count, and forward
        if moved is None or moved * pace > abs(pace):
            return None
        k, now = len(paces), -pace if moved * pace < -abs(pace) else 0.0
    at, run = k * recording.Ts, recording.name.removesuffix(ABORTED)
    when = f"{at:.3g} s after {run!r} began"
    value = now / pace
    if abs(value) > factor:
        return Cause("counts jumped", _jump(now - pace, when)[1], run, at, now - pace)
    name, text = _counts(value, when)
    return Cause(name, text, run, at, value)


def cause_of(
    recording: Recording,
    before: Sequence[Recording] = (),
    *,
    volt: float = math.inf,
    speed: float = math.inf,
) -> Cause | None:
    """Name what is wrong with a machine by one of its runs.

    A motor of first order with delay, friction and a constant load is fitted to earlier runs or,
    without any, to the run itself until something changes. Each change that a drive is known for is
    then simulated at every time of the run, with the recorded commands, and the one that leaves
    the smallest error is the cause, if it leaves no more than half. If nothing changed, the motor
    itself is looked at.

    Parameters
    ----------
    recording : Recording
        A run from rest that went wrong, as far as it went (`LinkError.recording`).
    before : sequence of Recording, optional
        Earlier runs from rest, of the machine as it should be, at the same sample time.
    volt : float, optional
        Largest command [V].
    speed : float, optional
        Speed that the machine must not pass [RPM].

    Returns
    -------
    Cause or None
        None if no known cause explains the run, or no such motor the earlier ones.

    Raises
    ------
    DataError
        For fewer than three samples.
    SettingError
        For a sample time or counts per turn that are not above 0.
    """
    return _Look.at(recording, before, volt, speed).cause()


def cause_among(
    runs: Sequence[Recording], *, volt: float = math.inf, speed: float = math.inf
) -> Cause | None:
    """The cause that ended a series of runs. The last run is looked at alone, compared with those
    before it that a motor explains, and with all of them; the change that leaves the smallest error
    is the cause. If that shows nothing, a fault may have come unseen in an earlier run.
    """
    if not runs:
        return None
    last, moved = runs[-1], [r for r in runs[:-1] if np.ptp(r.counts) > 0.0]
    if np.ptp(last.counts) == 0.0 and moved:
        return _idle(runs)
    look = _look(last, volt, speed)
    known: list[_Look] = []
    unseen: list[Cause] = []
    looks = _looks(moved, volt, speed)
    recent = [earlier.recording for earlier in looks]
    for earlier in looks:
        # less may be left on a run that did not end the series
        if cause := earlier.change(0.25):
            unseen.append(cause)
        elif earlier.is_alike:
            known.append(earlier)
    if look is not None:
        changes, own = [look.explanation()], look.always()
        if own is not None and own.name == "integrates":
            if changes[0] is None and all(earlier.is_unsettled() for earlier in known):
                return own
            own = None
        # a fault that nobody saw yet spoils a motor of all runs, few runs one of those that agree
        series = [[k.recording for k in known]] if known else []
        if len(known) < len(recent):
            series.append(recent)
        for before in series:
            changes.append(_Look.at(last, before, volt, speed).explanation())
        explained = [change for change in changes if change is not None]
        if explained:
            return min(explained, key=lambda change: change[0])[1]
        if own is not None:
            return own
    return unseen[0] if unseen else _between(recent, known, volt, speed)


def cause_after(
    sound: Sequence[Recording],
    recording: Recording,
    *,
    volt: float = math.inf,
    speed: float = math.inf,
) -> Cause | None:
    """The cause that came in a run after others in which the machine was sound. The run is compared
    with those only: a motor that is fitted to a part of it alone could be any.
    """
    looks = _looks([r for r in sound if np.ptp(r.counts) > 0.0], volt, speed)
    before = [earlier.recording for earlier in looks if earlier.is_alike]
    try:
        return _Look.at(recording, before, volt, speed).change() if before else None
    except DataError:  # it landed within a few samples
        return None


def _looks(runs: Sequence[Recording], volt: float, speed: float) -> list[_Look]:
    """Each run of a series looked at alone, if it is long enough."""
    # the last ones of the series: each takes some tenths of a second
    looks = [_look(recording, volt, speed) for recording in runs[-12:]]
    return [look for look in looks if look is not None]


def _between(
    runs: Sequence[Recording], known: Sequence[_Look], volt: float, speed: float
) -> Cause | None:
    """What changed in the latest of these runs that differs from those before it, and lasted."""

    def known_among(some: Sequence[Recording]) -> list[Recording]:
        return [k.recording for k in known if any(k.recording is r for r in some)]

    for i in reversed(range(1, len(runs))):
        before, after = known_among(runs[:i]), known_among(runs[i + 1 :])
        if before and (cause := _Look.at(runs[i], before, volt, speed).change()):
            # what breaks stays broken: the last run has to show it, too
            last = _Look.at(after[-1], before, volt, speed).change() if after else cause
            if last is not None and last.name == cause.name:
                return cause
    return None


def _look(recording: Recording, volt: float, speed: float) -> _Look | None:
    try:
        return _Look.at(recording, (), volt, speed)
    except DataError:  # too few samples
        return None


def _idle(runs: Sequence[Recording]) -> Cause:
    """Why a machine that has moved stands still at a command."""
    largest = [float(np.max(np.abs(r.u), initial=0.0)) for r in runs]
    moved = [u for r, u in zip(runs, largest, strict=True) if np.ptp(r.counts) > 0.0]
    if min(moved) <= largest[-1]:
        return Cause(
            "encoder lost",
            f"the encoder counts nothing at up to {largest[-1]:.3g} V, of which {min(moved):.3g} V "
            f"moved it before; {_LOST_ENCODER}, whether the drive is still enabled",
            runs[-1].name, None, 0.0,
        )  # fmt: skip
    stood = max(u for r, u in zip(runs, largest, strict=True) if np.ptp(r.counts) == 0.0)
    return dead_zone(stood, runs[-1].name)


def dead_zone(volt: float, run: str) -> Cause:
    """The cause of a machine that small commands do not move."""
    text = f"the first {volt:.3g} V move nothing; check friction, a brake that is on, the dead band"
    return Cause("dead zone", f"{text} of the drive", run, None, volt)


def turns_at_rest(r: Recording) -> Cause | None:
    """Whether a machine moves before it is commanded."""
    moves = np.flatnonzero(r.u)
    end = int(moves[0]) if len(moves) else len(r)
    counted = float(r.counts[max(0, end - 1)] - r.counts[0])
    # counts without a command that are a motion, and no trembling at an edge of the encoder
    if not abs(counted) >= 5:
        return None
    return turning(60.0 * counted / (r.counts_per_rev * (end - 1) * r.Ts), r.name)


def unsettled(r: Recording) -> Cause | None:
    """The cause of a long step that is far from settled, if a motor explains it."""
    look = _Look.at(r, (), math.inf, math.inf)
    is_motor = look.found["error"] <= UNSURE * look.found["size"]
    return look.integrates() if is_motor and look.is_unsettled(1.0) else None


def turning(rpm: float, run: str) -> Cause:
    """The cause of a machine that turns without a command."""
    text = f"the machine turns at {rpm:.4g} RPM without a command; {_LOAD}"
    return Cause("turns at rest", text, run, None, rpm)


def _columns(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Commands and counts, until the first that a link has lost."""
    end = known_until(recording.u, recording.counts)
    u, counts = recording.u[:end], recording.counts[:end]
    return np.ascontiguousarray(u), np.ascontiguousarray(counts, dtype=np.float64)


@dataclass(frozen=True)
class _Look:
    """A run with what the core found, and the limits of its machine."""

    recording: Recording
    found: dict[str, Any]
    volt: float
    speed: float
    usual: float
    """Largest speed of this run and of those before it [RPM, rms]."""

    @classmethod
    def at(
        cls, recording: Recording, before: Sequence[Recording], volt: float, speed: float
    ) -> _Look:
        found = _core.causes(
            *_columns(recording), [_columns(r) for r in before], Ts=recording.Ts,
            counts_per_rev=recording.counts_per_rev, most=volt,
        )  # fmt: skip
        speeds = [float(np.sqrt(np.mean(np.nan_to_num(r.y) ** 2))) for r in before]
        return cls(recording, found, volt, speed, max(found["size"], *speeds, 0.0))

    @property
    def is_alike(self) -> bool:
        """Whether its own motor explains the run well enough to be compared with."""
        return bool(self.found["error"] <= ALIKE * self.found["size"])

    @property
    def stands(self) -> bool:
        """Whether next to nothing moves, and in the second half nothing."""
        _, counts = _columns(self.recording)
        late = counts[len(counts) // 2 :]
        return bool(self.found["size"] < LOST * self.usual and np.ptp(late) <= 1.0)

    @property
    def name(self) -> str:
        """The run's name; one that was ended early is saved under another."""
        return self.recording.name.removesuffix(ABORTED)

    def cause(self) -> Cause | None:
        """What explains the run: a change, or what the motor of a run alone lacks."""
        is_alone = math.isnan(self.found["unsure"])
        return self.change() or (self.always() if is_alone else None)

    def change(self, explained: float = EXPLAINED) -> Cause | None:
        """The change that explains the run, leaving this share of the error at most."""
        change = self.explanation(explained)
        return None if change is None else change[1]

    def explanation(self, explained: float = EXPLAINED) -> tuple[float, Cause] | None:
        """The error that such a change leaves [RPM], and the change."""
        # changes with an error of up to this multiple of the least are equal: the likelier is taken
        ties = 1.05
        if (early := turns_at_rest(self.recording)) is not None:
            return 0.0, early
        found = self.found
        is_alone = math.isnan(found["unsure"])
        least = NOTED if is_alone else max(NOTED, TIMES * found["unsure"])
        least = max(least * found["size"], found["rounding"])
        findings = found["findings"]
        if self.stands:
            # a delay longer than the run explains that as well
            findings = [f for f in findings if f[0] in ("counts", "gain")]
        if found["error"] > least and findings:
            most = min(explained * found["error"], ties * findings[0][3])
            equal = {f[0]: f for f in findings if f[3] <= most}
            if equal:
                change = next(name for name in _NAMED if name in equal)
                _, value, at, error, motor = equal[change]
                # no change where one motor explains all runs as well
                if not found["together"] <= ties * error:
                    return error, self.changed(change, value, at, motor)
        return None

    def changed(self, change: str, value: float, at: float, motor: dict[str, float]) -> Cause:
        """The name of a change and its value."""
        r = self.recording
        # the first blocks of a run cannot be told from its start
        early = at <= max(0.02, 10.0 * r.Ts)
        when = (
            f"from the start of {self.name!r}" if early else f"{at:.3g} s after {self.name!r} began"
        )
        if change == "stuck" and abs(value * motor["gain"]) < LOST * self.usual:
            change, value = "gain", 0.0
        words = partial(_jump, per_turn=r.counts_per_rev) if change == "jump" else _NAMED[change]
        name, text = words(value, when)
        return Cause(name, text, self.name, None if early else at, value)

    def always(self) -> Cause | None:
        """What the motor that explains the whole run lacks."""
        r, motor = self.recording, self.found["motor"]
        largest = float(np.max(np.abs(r.u), initial=0.0))
        travel = float(np.ptp(r.counts)) / r.counts_per_rev
        gain = motor["gain"]
        unlike = self.found["error"] / max(self.found["size"], 1e-9)
        name: str
        if travel == 0.0:
            if largest < 0.5 * self.volt and math.isfinite(self.volt):
                return None
            name, value = "no motion", largest
            text = (
                f"the encoder does not count at all at up to {largest:.3g} V; {_LOST_ENCODER}, "
                "whether the drive is enabled, the motor connected and the shaft free"
            )
        elif self.found["backwards"] < min(UNSURE, unlike / TIMES):
            name, value = "sign", -1.0
            text = f"a positive command turns the machine backwards; {_SIGN}"
        elif unlike > UNSURE:
            return None
        # gain is too large if the largest command reaches this many times the machine's own limit
        elif self.is_too_fast() and gain * self.volt > 3.0 * self.speed and self.bends():
            value = gain * self.volt / self.speed
            name = "gain too large"
            text = (
                f"it turns at {gain:.4g} RPM per V, so that {self.speed / gain:.3g} V of "
                f"{self.volt:g} take it to its {self.speed:g} RPM; check counts_per_rev, the unit "
                "of the command, its scale in the drive"
            )
        elif self.is_unsettled():
            return self.integrates()
        else:
            return None
        return Cause(name, text, self.name, None, float(value))

    def bends(self) -> bool:
        """Whether a run that was ended early shows that its speed would have settled: an answer of
        first order falls behind a straight line by half the run's length over its time constant.
        """
        return bool(
            0.5 * len(self.recording) * self.recording.Ts > LOST * self.found["motor"]["lag"]
        )

    def is_unsettled(self, lags: float = 0.5) -> bool:
        """Whether the run is shorter than this many time constants of its motor."""
        return bool(lags * self.found["motor"]["lag"] > len(self.recording) * self.recording.Ts)

    def integrates(self) -> Cause:
        """The cause of a speed that grows for as long as the run lasts."""
        value = float(self.found["motor"]["gain"] / self.found["motor"]["lag"])
        text = (
            f"the speed grows by {value:.4g} RPM/s per V and does not settle: the command is a "
            "torque with little friction, or an acceleration; command it as a speed or a voltage, "
            "or give the machine friction"
        )
        return Cause("integrates", text, self.name, None, value)

    def is_too_fast(self) -> bool:
        """Whether the run reached the machine's own limit of speed."""
        r, (_, counts) = self.recording, _columns(self.recording)
        k = min(4, len(counts) - 1)
        turns = np.abs(counts[k:] - counts[:-k]).max() / r.counts_per_rev
        return bool(60.0 * turns / (k * r.Ts) > 0.8 * self.speed)


SUDDEN = ("encoder lost", "encoder sign", "counts scaled", "counts jumped", "command sign", "sign")
"""Causes that can change a speed from one sample to the next."""
_LOST_ENCODER = "check the encoder's cable and supply, the coupling, whether the shaft is blocked"
_SIGN = "swap two motor leads or the encoder's A and B, or change a sign in the drive"
_LOAD = "check what drives the shaft: gravity, a spring, a load, an offset of the command"


def _gain(value: float, when: str) -> tuple[str, str]:
    if value < -LOST:
        return "command sign", (
            f"{when} the machine answers with {value:.2g} times its gain: the sign of the command "
            "has turned; check the motor leads, the direction signal, the sign in the drive"
        )
    if value < LOST:
        return "stage off", (
            f"{when} no command moves the machine any more; check whether the drive is enabled, "
            "its fuse, its temperature, the motor leads"
        )
    what = "fallen" if value < 1.0 else "grown"
    return "gain", (
        f"{when} the machine answers with {value:.3g} times its gain: it has {what}; check the "
        "supply, a limit of current or temperature, the scale of the command"
    )


def _counts(value: float, when: str) -> tuple[str, str]:
    if value < -LOST:
        return "encoder sign", (
            f"{when} the encoder counts {value:.2g} times the motion: its sign has turned; check "
            "A and B, and the setting of its direction"
        )
    if value < LOST:
        return "encoder lost", f"{when} the encoder no longer counts; {_LOST_ENCODER}"
    return "counts scaled", (
        f"{when} the encoder counts {value:.3g} times the motion; check for a channel that is "
        "lost, the setting of its resolution, a belt or coupling that slips"
    )


def _jump(value: float, when: str, per_turn: float = math.inf) -> tuple[str, str]:
    counters = {2.0**n: f"a counter of {n} bits that wraps" for n in range(8, 33)}
    wraps = counters | {per_turn: "an angle that begins anew at every turn"}
    seen = next((what for size, what in wraps.items() if abs(abs(value) / size - 1.0) < 0.02), None)
    what = (
        f"as {seen}; unwrap it where it is read"
        if seen
        else "more than the machine can turn; check for disturbed lines and torn transfers"
    )
    return "counts jumped", f"{when} the counts jump by {value:.6g}: {what}"


_TEXTS = {
    "delay": "{when} the machine answers {ms:.3g} ms later; check filters in the drive, the load "
    "of the bus and of the computer",
    "inertia": "{when} the time constant is {value:.3g} times as long at the same gain; check what "
    "is coupled to the shaft, and for a limit of current",
    "friction": "{when} friction or a braking load takes {value:.3g} V of command more; check for "
    "a brake, a bearing, a shaft that jams, a load",
    "load": "{when} a load worth {value:.3g} V of command acts; " + _LOAD,
    "stage stuck": "{when} the machine behaves as at {value:.3g} V, whatever the command; switch "
    "it off, check the output stage and the line of the command",
}
"""Causes that one change has, whatever its value."""


def _text(name: str, value: float, when: str) -> tuple[str, str]:
    return name, _TEXTS[name].format(when=when, value=value, ms=1e3 * value)


_NAMED: dict[str, Callable[[float, str], tuple[str, str]]] = {
    "jump": _jump,
    "counts": _counts,
    "gain": _gain,
    "delay": partial(_text, "delay"),
    "inertia": partial(_text, "inertia"),
    "friction": partial(_text, "friction"),
    "stuck": partial(_text, "stage stuck"),
    "load": partial(_text, "load"),
}
"""The changes of the core, the likelier first."""
