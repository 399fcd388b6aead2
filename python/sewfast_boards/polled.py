"""A board of another maker, polled over lines of text, as a `Machine`: what all of them share.

`PolledBoard` runs sample by sample from this computer, checks the limits and ends every run safely;
`makers` holds the commands of each board.

The host sets the pace: in every sample it reads the position and sends the command. It keeps the
time of each answer, so that a late answer costs no accuracy; a sample that is late by a whole
period ends the run.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

import numpy as np

from sewfast.arrays import FloatArray
from sewfast.control.controller import SampledController
from sewfast.control.guarding import TOO_FAST
from sewfast.control.machine import WATCHED, RecordedRun, Watch
from sewfast.errors import Interrupted, LinkError, SettingError
from sewfast.gains import real
from sewfast.link.ports import Port, Unique, open_port
from sewfast.recording import Recording, require_finite

SHORTEST_TS, LONGEST_TS = 0.002, 0.5
"""Sample times [s] that a host without a real-time system can keep."""
SHARE = 0.6
"""Share of a period that reading and writing may take: the rest is for the host's own pauses."""
REST_WITHIN = 20.0
"""Longest wait for rest [s]."""
QUIET, QUIET_WITHIN = 0.02, 0.5
"""Time without a byte after which the line counts as quiet, and the longest wait for that [s]."""
WATCHDOG, SAMPLES = 0.2, 3.0
"""Time without a command after which a board switches the motor off by itself [s], and its least
number of samples: a command that is one sample late ends a run, and must find a board that runs."""


class Clock(Protocol):
    """A clock that can also wait: the module `time`, or a simulated one."""

    def monotonic(self) -> float: ...
    def sleep(self, seconds: float, /) -> None: ...


class PolledBoard(Unique, ABC):
    """A board that takes a command and reports its position over lines of text.

    Parameters
    ----------
    port : str or Port
        An address for `sewfast.link.open_port`, or an open port.
    Ts : float
        Sample time [s], 0.002 to 0.5; refused if the line is too slow for it.
    volt : float
        Largest command in either direction, in the board's unit. Larger ones are clipped.
    speed : float
        Speed [RPM] above which a run is ended.
    counts_per_rev : float
        Encoder counts of one turn.
    baud : int
        Bits per second of a serial port.
    clock : module or object
        With `monotonic()` and `sleep(seconds)`.

    Attributes
    ----------
    late : float
        Largest delay of a sample in the last run [s].

    Raises
    ------
    SettingError
        For a number outside its range, and if the line is too slow for the sample time.
    LinkError
        If the port does not open, or no such board answers.

    Notes
    -----
    Every run begins at rest and ends with command 0 and the output off, even if an exception,
    Ctrl-C or a limit breaks it off. If this computer itself dies, it is up to the board what
    happens: see each.
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

    @property
    def _alive_within(self) -> float:
        """Time of the board's watchdog [s]."""
        return max(WATCHDOG, SAMPLES * self.Ts)

    # --- each board's own part ------------------------------------------------------------------

    @property
    @abstractmethod
    def name(self) -> str:
        """The machine's name, for messages and files."""

    @abstractmethod
    def _prepare(self) -> None:
        """Check that the other side is such a board and can be used."""

    @abstractmethod
    def _arm(self) -> None:
        """Set command 0 and switch the output on."""

    @abstractmethod
    def _disarm(self) -> None:
        """Switch the output off, and have that confirmed."""

    @abstractmethod
    def _apply(self, u: float) -> None:
        """Send a command."""

    @abstractmethod
    def _position(self) -> float:
        """Read the position [turns]."""

    def _require_running(self) -> None:
        """Raise if the board has switched itself off; called from time to time during a run."""

    # --- as a machine ---------------------------------------------------------------------------

    def excite(self, u: FloatArray, name: str) -> Recording:
        """Apply commands, shape (N,), one per sample.

        Raises
        ------
        DataError
            For a command that is not finite.
        LinkError
            If the board fails, is too fast or too late; `recording` holds the samples so far.
        Interrupted
            On Ctrl-C; `best` is the recording so far.
        """
        require_finite("command", u)
        return self._record_run(lambda k, speed: float(u[k]), len(u), name, None)

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        """Run a controller on this computer along a reference [RPM], shape (N,).

        Raises
        ------
        SettingError
            For a controller with another sample time.
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
        early = controller.early(r)

        def decide(k: int, speed: float) -> float:
            u = core.step(float(early[k]), speed)
            feedback[k] = core.filtered
            return u

        recording = self._record_run(decide, len(r), name, watch)
        t = np.arange(len(r), dtype=np.float64) * self.Ts
        return RecordedRun(
            t, np.array(r), recording.u, recording.y, feedback, controller, self.name, name,
            recording=recording,
        )  # fmt: skip

    def stop(self) -> None:
        """Set command 0 and switch the output off, at once.

        Raises
        ------
        LinkError
            If the board does not confirm it: switch its supply off.
        """
        self._halt()

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def __enter__(self) -> PolledBoard:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    # --- a run ------------------------------------------------------------------------------

    def _record_run(
        self, decide: Callable[[int, float], float], samples: int, name: str, watch: Watch | None
    ) -> Recording:
        run = _Samples(samples)
        self._await_rest()
        try:
            try:
                self._arm()
                self._pump(run, decide, watch)
            finally:
                # no run leaves the motor driven, however it ended
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
        # window of the speed that is compared with the limit [s]
        window = max(1, round(0.05 / self.Ts))
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
            # the board reads its encoder between question and answer
            run.at[k] = 0.5 * (asked + clock.monotonic()) - begun
            self._require_slow(run, k, window)
            if k == len(run.u):
                break  # one position more than commands: the effect of the last one
            if k and k % WATCHED == 0:
                self._require_running()
                if watch is not None:
                    seen = (run.turns[k - WATCHED : k] - run.turns[0]) * self.counts_per_rev
                    watch(k - WATCHED, run.u[k - WATCHED : k], seen)
            u = decide(k, run.speed(k))
            run.u[k] = min(max(u, -self.volt), self.volt)
            self._apply(run.u[k])
            run.sent_at[k] = clock.monotonic() - begun
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
                remedy=TOO_FAST,
            )  # fmt: skip

    def _recording(self, run: _Samples, name: str) -> Recording | None:
        """The run at even times, those at which the commands were sent.
        Positions are interpolated between the times of the answers, so that neither the host's
        jitter nor the transmission time of a command appears in the speed.
        """
        if run.done < 5:
            return None
        u = run.u[: run.done].copy()
        grid = np.arange(run.done) * self.Ts
        grid += float(np.median(run.sent_at[: run.done] - grid))
        # an aborted run has no answer after its last command
        known = run.at[: run.done + 1] > -math.inf
        at, turns = run.at[: run.done + 1][known], run.turns[: run.done + 1][known]
        counts = np.interp(grid, at, turns) * self.counts_per_rev
        return Recording.of_counts(
            u, counts, Ts=self.Ts, counts_per_rev=self.counts_per_rev, name=name
        )

    def _halt(self) -> None:
        """Set command 0, switch the output off; a second Ctrl-C must not prevent that."""
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
        # time without a count after which a motor counts as at rest [s]
        while clock.monotonic() - since < 0.3:
            if clock.monotonic() - began > REST_WITHIN:
                raise LinkError(
                    name=self.name, expected=f"the motor at rest within {REST_WITHIN:g} s",
                    received="one that turns", remedy="brake it, or wait longer",
                )  # fmt: skip
            clock.sleep(0.02)
            # a board's own position estimate wanders by less than a count at rest
            if abs(self._position() - before) * self.counts_per_rev > 1.5:
                before, since = self._position(), clock.monotonic()

    def _require_pace(self) -> None:
        """Refuse a sample time that is too short for the line, by the slowest of five samples."""
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

    def _send(self, text: str) -> None:
        self._port.write(text.encode("ascii") + b"\n")

    def _ask(self, text: str) -> str:
        """Send a line and return the next one received."""
        self._send(text)
        return self._line(text)

    def _number(self, text: str) -> float:
        """Ask for a number; other lines, such as telemetry, are skipped."""
        self._send(text)
        for _ in range(20):
            line = self._line(text)
            with suppress(ValueError):
                value = float(line)
                if math.isfinite(value):
                    return value
        raise self._unexpected(f"a number in answer to {text!r}", line)

    def _line(self, question: str) -> str:
        # longest wait for a line [s]
        deadline = self._clock.monotonic() + 0.25
        while b"\n" not in self._waiting:
            left = deadline - self._clock.monotonic()
            # a line with more characters does not come from a board of this kind
            if left <= 0.0 or len(self._waiting) > 4096:
                raise LinkError(
                    name=self._port.url, expected=f"an answer to {question!r}",
                    received="none" if not self._waiting else "no end of a line",
                    remedy="check port, baud rate and that the board runs",
                )  # fmt: skip
            self._waiting += self._port.read(left)
        line, _, self._waiting = self._waiting.partition(b"\n")
        return line.decode("ascii", "replace").strip()

    def _discard(self) -> bool:
        """Discard bytes of an earlier exchange; whether the line became quiet, as telemetry never
        does.
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
    """Commands and positions of a run; times in seconds from its start, -inf if missing."""

    def __init__(self, samples: int) -> None:
        self.u = np.zeros(samples)
        self.sent_at = np.full(samples, -math.inf)
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
