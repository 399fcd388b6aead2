"""A board of another maker that is polled over lines of text, as a `Machine`: what all share.

`PolledBoard` plays a run sample by sample from this computer, with its limits and its way out; what
a board is asked and told is in `odrive` and `simplefoc`.

The pace is the host's: the position is asked for, the command is sent, and both go over the line in
every sample. The time of each answer is kept, so that an answer that comes late costs no accuracy,
and a sample that comes later than a whole period ends the run.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Protocol

import numpy as np

from ..arrays import FloatArray
from ..control.controller import SampledController
from ..control.machine import WATCHED, RecordedRun, Watch
from ..errors import Interrupted, LinkError, SettingError
from ..gains import real
from ..recording import Recording, require_finite
from .ports import Port, Unique, open_port

SHORTEST_TS, LONGEST_TS = 0.002, 0.5
"""Sample times [s] for which a host that is no real-time system is good enough."""
SHARE = 0.6
"""Of a period, what asking and telling may take of it: the rest is for the host's own pauses."""
SPEED_WINDOW = 0.05
"""Time over which the speed is taken that is held against the limit [s]."""
REST = 0.3
"""Time without a count after which a motor is taken to be at rest [s]."""
REST_WITHIN = 20.0
"""Longest wait for that [s]."""
ANSWER_WITHIN = 0.25
"""Longest wait for a line [s]."""
QUIET, QUIET_WITHIN = 0.02, 0.5
"""Time without a byte after which nothing is on its way, and the longest wait for it [s]."""
WATCHDOG = 0.2
"""Time without a command after which a board is to switch the motor off by itself [s]."""
LONGEST_LINE = 4096
"""Characters without an end of line after which the other side is no board of this kind."""


class Clock(Protocol):
    """What says the time and waits: `time`, or a simulated one."""

    def monotonic(self) -> float: ...
    def sleep(self, seconds: float, /) -> None: ...


class PolledBoard(Unique, ABC):
    """A board that takes a command and gives its position over lines of text.

    Parameters
    ----------
    port : str or Port
        What `sewfast.link.open_port` takes, or a port that is open.
    Ts : float
        Sample time [s], 0.002 to 0.5; refused where the line does not carry it.
    volt : float
        Largest command to either side, in the unit that the board takes. Larger ones are clipped.
    speed : float
        Speed [RPM] beyond which a run is ended.
    counts_per_rev : float
        Encoder counts of one turn.
    baud : int
        Bits per second of a serial port.
    clock : module or object
        With `monotonic()` and `sleep(seconds)`.

    Attributes
    ----------
    late : float
        The latest sample of the last run [s], beyond its due time.

    Raises
    ------
    SettingError
        For a number outside its range, and where a sample takes longer than the line allows.
    LinkError
        Where the port does not open, or nothing of this kind answers.

    Notes
    -----
    Every run begins at rest and ends with command 0 and the output off, also one that is broken off
    by an exception, Ctrl-C or a limit. What happens where this computer itself dies is up to the
    board: see each.
    """

    Ts: float
    volt: float
    speed: float
    counts_per_rev: float

    def __init__(
        self,
        port: str | Port,
        *,
        Ts: float,
        volt: float,
        speed: float,
        counts_per_rev: float,
        baud: int,
        clock: Clock,
    ) -> None:
        self.Ts = _within("Ts", Ts, SHORTEST_TS, LONGEST_TS)
        self.volt = _within("volt", volt, 0.0, math.inf)
        self.speed = _within("speed", speed, 0.0, math.inf)
        self.counts_per_rev = _within("counts_per_rev", counts_per_rev, 0.0, math.inf)
        self.late = 0.0
        self._clock = clock
        self._waiting = b""
        self._port = open_port(port, baud) if isinstance(port, str) else port
        try:
            self._discard()
            self._prepare()
            self._require_pace()
        except BaseException:
            self._port.close()
            raise

    # --- what each board is ---------------------------------------------------------------------

    @property
    @abstractmethod
    def name(self) -> str:
        """Of the machine, for messages and files."""

    @abstractmethod
    def _prepare(self) -> None:
        """Find out whether the other side is such a board, and can be used."""

    @abstractmethod
    def _arm(self) -> None:
        """Command 0 and the output on."""

    @abstractmethod
    def _disarm(self) -> None:
        """The output off, confirmed."""

    @abstractmethod
    def _apply(self, u: float) -> None:
        """Send a command."""

    @abstractmethod
    def _position(self) -> float:
        """Ask for the position [turns]."""

    def _require_running(self) -> None:
        """Refuse to go on where the board has switched itself off; asked every so often."""

    # --- a machine ------------------------------------------------------------------------------

    def excite(self, u: FloatArray, name: str) -> Recording:
        """Apply commands, shape (N,), one per sample.

        Raises
        ------
        DataError
            For a command that is not finite.
        LinkError
            Where the board fails, is too fast or too late; `recording` holds what came.
        Interrupted
            On Ctrl-C; `best` is the recording up to there.
        """
        require_finite("command", u)
        return self._played(lambda k, speed: float(u[k]), len(u), name, None)

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        """Run a controller, which is computed here, along a reference [RPM], shape (N,).

        Raises
        ------
        SettingError
            For a controller of another sample time.
        DataError, LinkError, Interrupted
            As `excite`.
        """
        require_finite("reference", r)
        if not math.isclose(controller.Ts, self.Ts, rel_tol=0.01):
            raise SettingError(
                name="controller", expected=f"the machine's sample time of {self.Ts} s",
                received=f"{controller.Ts} s", remedy="tune a controller for this machine",
            )  # fmt: skip
        core, feedback = controller.core(), np.zeros(len(r))

        def decide(k: int, speed: float) -> float:
            u = core.step(float(r[k]), speed)
            feedback[k] = core.filtered
            return u

        recording = self._played(decide, len(r), name, watch)
        t = np.arange(len(r), dtype=np.float64) * self.Ts
        return RecordedRun(
            t, np.array(r), recording.u, recording.y, feedback, controller, self.name, name,
            recording=recording,
        )  # fmt: skip

    def stop(self) -> None:
        """Command 0 and the output off, at once.

        Raises
        ------
        LinkError
            Where the board does not confirm it: switch its supply off.
        """
        self._halt()

    def close(self) -> None:
        """Give the port back."""
        self._port.close()

    def __enter__(self) -> PolledBoard:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # --- a run ------------------------------------------------------------------------------

    def _played(
        self, decide: Callable[[int, float], float], samples: int, name: str, watch: Watch | None
    ) -> Recording:
        run = _Samples(samples)
        self._await_rest()
        try:
            try:
                self._arm()
                self._pump(run, decide, watch)
            finally:
                # whatever has happened: no run leaves the motor driven
                self._halt()
        except KeyboardInterrupt as e:
            raise Interrupted(self._recording(run, name)) from e
        except LinkError as e:
            e.recording = self._recording(run, name)
            raise
        found = self._recording(run, name)
        if found is None:
            raise SettingError(
                name="u", expected="5 samples or more", received=str(samples),
                remedy="a speed cannot be estimated from fewer",
            )  # fmt: skip
        return found

    def _pump(
        self, run: _Samples, decide: Callable[[int, float], float], watch: Watch | None
    ) -> None:
        clock, begun = self._clock, self._clock.monotonic()
        window = max(1, round(SPEED_WINDOW / self.Ts))
        self.late = 0.0
        for k in range(len(run.u) + 1):
            due = begun + k * self.Ts
            clock.sleep(max(0.0, due - clock.monotonic()))
            late = clock.monotonic() - due
            self.late = max(self.late, late)
            if late > self.Ts:
                raise LinkError(
                    name=self.name, expected=f"a sample every {self.Ts:g} s",
                    received=f"sample {k} late by {late:.3g} s",
                    remedy="take a longer Ts, close other programs, or a faster line",
                )  # fmt: skip
            asked = clock.monotonic()
            run.turns[k] = self._position()
            # the board looks at its encoder between question and answer
            run.at[k] = 0.5 * (asked + clock.monotonic()) - begun
            self._require_slow(run, k, window)
            if k == len(run.u):
                break  # what the last command did
            if k and k % WATCHED == 0:
                self._require_running()
                if watch is not None:
                    seen = (run.turns[k - WATCHED : k] - run.turns[0]) * self.counts_per_rev
                    watch(k - WATCHED, run.u[k - WATCHED : k], seen)
            u = decide(k, run.speed(k))
            run.u[k] = min(max(u, -self.volt), self.volt)
            self._apply(run.u[k])
            run.told[k] = clock.monotonic() - begun
            run.done = k + 1
        self._require_running()

    def _require_slow(self, run: _Samples, k: int, window: int) -> None:
        first = max(0, k - window)
        if k == 0:
            return
        speed = (run.turns[k] - run.turns[first]) / (run.at[k] - run.at[first]) * 60.0
        if not abs(speed) <= self.speed:
            raise LinkError(
                name=self.name, expected=f"at most {self.speed:g} RPM",
                received=f"{speed:.0f} RPM at sample {k}",
                remedy="excite it less, or raise `speed` if the machine bears it",
            )  # fmt: skip

    def _recording(self, run: _Samples, name: str) -> Recording | None:
        """What was seen, at even times: those at which the commands were sent.

        The positions between two answers lie on a straight line, so that neither the host's jitter
        nor the time that a command takes on the line is in the speed.
        """
        if run.done < 5:
            return None
        u = run.u[: run.done].copy()
        grid = np.arange(run.done) * self.Ts
        grid += float(np.median(run.told[: run.done] - grid))
        # a run that was broken off has no answer after its last command
        known = run.at[: run.done + 1] > -math.inf
        at, turns = run.at[: run.done + 1][known], run.turns[: run.done + 1][known]
        counts = np.interp(grid, at, turns) * self.counts_per_rev
        return Recording.of_counts(
            u, counts, Ts=self.Ts, counts_per_rev=self.counts_per_rev, name=name
        )

    def _halt(self) -> None:
        """Command 0, output off. A second Ctrl-C must not keep the motor driven."""
        for attempt in range(3):
            try:
                try:
                    with suppress(LinkError):
                        self._discard()
                    self._apply(0.0)
                finally:
                    self._disarm()
                return
            except KeyboardInterrupt:
                if attempt == 2:
                    raise
            except LinkError as e:
                if attempt == 2:
                    raise LinkError(
                        name=self.name, expected="command 0 and the output off, confirmed",
                        received=str(e), remedy="SWITCH THE SUPPLY OFF: the motor may be driven",
                    ) from e  # fmt: skip

    def _await_rest(self) -> None:
        clock = self._clock
        before, began = self._position(), clock.monotonic()
        since = began
        while clock.monotonic() - since < REST:
            if clock.monotonic() - began > REST_WITHIN:
                raise LinkError(
                    name=self.name, expected=f"the motor at rest within {REST_WITHIN:g} s",
                    received="one that turns", remedy="brake it, or wait longer",
                )  # fmt: skip
            clock.sleep(0.02)
            # an estimate of an observer moves by less than a count at rest
            if abs(self._position() - before) * self.counts_per_rev > 1.5:
                before, since = self._position(), clock.monotonic()

    def _require_pace(self) -> None:
        """Refuse a sample time that the line does not carry: the worst of some samples."""
        worst = 0.0
        for _ in range(5):
            began = self._clock.monotonic()
            self._position()
            self._apply(0.0)
            worst = max(worst, self._clock.monotonic() - began)
        if worst > SHARE * self.Ts:
            raise SettingError(
                name="Ts", expected=f"at least {worst / SHARE:.2g} s on this line",
                received=f"{self.Ts:g} s",
                remedy="take a longer one, or a faster line (USB, a higher baud rate)",
            )  # fmt: skip

    # --- lines of text --------------------------------------------------------------------------

    def _tell(self, text: str) -> None:
        self._port.write(text.encode("ascii") + b"\n")

    def _ask(self, text: str) -> str:
        """Send a line and take the next one that comes."""
        self._tell(text)
        return self._line(text)

    def _number(self, text: str) -> float:
        """Ask for a number; lines that are none, such as a telemetry's, are passed over."""
        self._tell(text)
        for _ in range(20):
            line = self._line(text)
            with suppress(ValueError):
                value = float(line)
                if math.isfinite(value):
                    return value
        raise self._unexpected(f"a number in answer to {text!r}", line)

    def _line(self, question: str) -> str:
        deadline = self._clock.monotonic() + ANSWER_WITHIN
        while b"\n" not in self._waiting:
            left = deadline - self._clock.monotonic()
            if left <= 0.0 or len(self._waiting) > LONGEST_LINE:
                raise LinkError(
                    name=self._port.url, expected=f"an answer to {question!r}",
                    received="none" if not self._waiting else "no end of a line",
                    remedy="check port, baud rate and that the board runs",
                )  # fmt: skip
            self._waiting += self._port.read(left)
        line, _, self._waiting = self._waiting.partition(b"\n")
        return line.decode("ascii", "replace").strip()

    def _discard(self) -> bool:
        """Forget what has come: an answer to somebody else, or to what was broken off.

        Returns
        -------
        bool
            Whether it has become quiet; a telemetry never does.
        """
        self._waiting = b""
        deadline = self._clock.monotonic() + QUIET_WITHIN
        while self._port.read(QUIET):
            if self._clock.monotonic() > deadline:
                return False
        return True

    def _unexpected(self, expected: str, received: str) -> LinkError:
        return LinkError(
            name=self._port.url, expected=expected, received=repr(received[:60]),
            remedy="is this the right port, and the board of this kind?",
        )  # fmt: skip


class _Samples:
    """What a run has sent and seen; times in seconds from its start, -inf: not there."""

    def __init__(self, samples: int) -> None:
        self.u = np.zeros(samples)
        self.told = np.full(samples, -math.inf)
        self.turns = np.zeros(samples + 1)
        self.at = np.full(samples + 1, -math.inf)
        self.done = 0

    def speed(self, k: int) -> float:
        """The speed from one answer to the next [RPM]."""
        if k == 0:
            return 0.0
        return float((self.turns[k] - self.turns[k - 1]) / (self.at[k] - self.at[k - 1]) * 60.0)


def _within(name: str, value: float, low: float, high: float) -> float:
    number = real(name, value)
    if not (low <= number <= high and 0.0 < number < math.inf):
        bounds = f"{low:g} to {high:g}" if high < math.inf else "a finite number above 0"
        raise SettingError(
            name=name, expected=bounds, received=f"{number:g}",
            remedy="see the page on drives of other makers",
        )  # fmt: skip
    return number
