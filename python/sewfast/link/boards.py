"""Drives of other makers that are polled over text: `ODrive` and `SimpleFOC` as a `Machine`.

Read in this order: `PolledBoard`, which plays a run sample by sample from this computer, with its
limits and its way out; then what each board is asked and told. Both are written from their makers'
documents and sources and have never been run on hardware (docs/boards.md).

The pace is the host's: the position is asked for, the command is sent, and both go over the line in
every sample. The time of each answer is kept, so that an answer that comes late costs no accuracy,
and a sample that comes later than a whole period ends the run.
"""

from __future__ import annotations

import math
import re
import time
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


# --- ODrive, firmware 0.5 -------------------------------------------------------------------------


IDLE, CLOSED_LOOP = 1, 8
"""States of an axis."""
TORQUE, PASSTHROUGH = 1, 1
"""Its control mode and input mode."""
GIMBAL = 2
"""The motor type whose commands are voltages."""
WATCHDOG = 0.2
"""Time without a command after which the board switches the motor off by itself [s]."""
ARMS_WITHIN = 2.0


class ODrive(PolledBoard):
    """An axis of an ODrive with firmware 0.5, over its ASCII protocol (USB or UART).

    The command is a torque [N m], or a voltage [V] where the motor is configured as a gimbal motor:
    `unit` says which; recordings name the column `u [V]` either way. Calibrate the motor, set
    `vel_limit` and `current_lim` and have the axis at rest in IDLE first.

    Parameters
    ----------
    port, Ts, volt, speed, baud, clock
        As `PolledBoard`; `volt` is in N m, or V of a gimbal motor.
    axis : int
        0 or 1.
    counts_per_rev : float, optional
        By default what the axis' encoder is configured for.

    Notes
    -----
    During a run the axis' own watchdog is set to 0.2 s: where this computer dies, the ODrive
    switches the motor off by itself. Afterwards control mode, input mode and watchdog are as
    before.
    """

    def __init__(
        self,
        port: str | Port,
        *,
        volt: float,
        speed: float,
        Ts: float = 0.01,
        axis: int = 0,
        counts_per_rev: float | None = None,
        baud: int = 115_200,
        clock: Clock = time,
    ) -> None:
        if axis not in (0, 1) or isinstance(axis, bool):
            raise SettingError(name="axis", expected="0 or 1", received=repr(axis))
        self._axis, self._asks_counts = axis, counts_per_rev is None
        self._before: dict[str, float] = {}
        self.unit = "N m"
        super().__init__(
            port, Ts=Ts, volt=volt, speed=speed, counts_per_rev=counts_per_rev or 1.0, baud=baud,
            clock=clock,
        )  # fmt: skip

    @property
    def name(self) -> str:
        return f"ODrive axis {self._axis}"

    def _prepare(self) -> None:
        version = [round(self._read(f"fw_version_{part}")) for part in ("major", "minor")]
        if version != [0, 5]:
            raise SettingError(
                name=self._port.url, expected="an ODrive with firmware 0.5",
                received=f"firmware {version[0]}.{version[1]}",
                remedy="others name their properties differently; `sewfast.Machine` takes your own",
            )  # fmt: skip
        if self._asks_counts:
            self.counts_per_rev = self._read(f"{self._place}.encoder.config.cpr")
        if round(self._read(f"{self._place}.motor.config.motor_type")) == GIMBAL:
            self.unit = "V"
        if round(self._read(f"{self._place}.current_state")) != IDLE:
            raise LinkError(
                name=self.name, expected="an axis in IDLE", received="one that something drives",
                remedy="end what drives it, and request IDLE",
            )  # fmt: skip
        self._require_no_error()

    @property
    def _place(self) -> str:
        return f"axis{self._axis}"

    def _read(self, what: str) -> float:
        answer = self._ask(f"r {what}")
        try:
            return float(answer)
        except ValueError:
            raise self._unexpected(f"the number {what}", answer) from None

    def _write(self, what: str, value: float) -> None:
        """Without an answer, unless it is refused; that is seen by the next question."""
        self._tell(f"w {self._place}.{what} {value:g}")

    def _require_no_error(self) -> None:
        error = round(self._read(f"{self._place}.error"))
        if error:
            raise LinkError(
                name=self.name, expected="an axis without errors", received=f"error 0x{error:x}",
                remedy="see dump_errors(odrv0) in odrivetool, and clear them",
            )  # fmt: skip

    def _arm(self) -> None:
        self._require_no_error()
        for what, value in (
            ("controller.config.control_mode", TORQUE),
            ("controller.config.input_mode", PASSTHROUGH),
            ("config.watchdog_timeout", WATCHDOG),
        ):
            self._before.setdefault(what, self._read(f"{self._place}.{what}"))
            self._write(what, value)
        self._apply(0.0)
        self._write("config.enable_watchdog", 1)
        self._write("requested_state", CLOSED_LOOP)
        deadline = self._clock.monotonic() + ARMS_WITHIN
        while round(self._read(f"{self._place}.current_state")) != CLOSED_LOOP:
            self._apply(0.0)
            if self._clock.monotonic() > deadline:
                self._require_no_error()
                raise LinkError(
                    name=self.name, expected="closed-loop control when asked for",
                    received="another state", remedy="calibrate motor and encoder first",
                )  # fmt: skip
            self._clock.sleep(0.005)

    def _disarm(self) -> None:
        self._write("requested_state", IDLE)
        deadline = self._clock.monotonic() + ARMS_WITHIN
        while round(self._read(f"{self._place}.current_state")) != IDLE:
            if self._clock.monotonic() > deadline:
                raise LinkError(
                    name=self.name, expected="IDLE when asked for", received="another state"
                )
            self._clock.sleep(0.005)
        self._write("config.enable_watchdog", 0)
        for what, value in self._before.items():
            self._write(what, value)
        self._before.clear()

    def _require_running(self) -> None:
        if round(self._read(f"{self._place}.current_state")) != CLOSED_LOOP:
            self._require_no_error()
            raise LinkError(
                name=self.name, expected="closed-loop control", received="an axis that left it",
                remedy="see dump_errors(odrv0) in odrivetool",
            )  # fmt: skip

    def _apply(self, u: float) -> None:
        self._tell(f"c {self._axis} {u:.6f}")

    def _position(self) -> float:
        answer = self._ask(f"f {self._axis}")
        found = re.fullmatch(r"(\S+) (\S+)", answer)
        with suppress(ValueError):
            if found is not None and math.isfinite(turns := float(found[1])):
                return turns
        raise self._unexpected("position and velocity", answer)


# --- SimpleFOC: the Commander ---------------------------------------------------------------------


class SimpleFOC(PolledBoard):
    """A motor of a SimpleFOC sketch, over its Commander, in torque mode by voltage.

    The sketch registers the motor (`commander.add('M', onMotor, "motor")`) and a time after which
    it switches the motor off where nothing comes, with a label that holds the word `watchdog`
    (docs/boards.md shows the ten lines). The motor has no phase resistance set: with one, SimpleFOC
    takes commands as currents.

    Parameters
    ----------
    port, Ts, volt, speed, counts_per_rev, baud, clock
        As `PolledBoard`; `volt` is in V. `counts_per_rev` is the sensor's, such as 16384.
    motor : str
        The letter under which the sketch has registered the motor.
    watchdog : bool
        False where the sketch has none, and somebody stands at the switch: SimpleFOC itself goes on
        with the last voltage where this computer dies.
    """

    def __init__(
        self,
        port: str | Port,
        *,
        volt: float,
        speed: float,
        counts_per_rev: float,
        Ts: float = 0.02,
        motor: str = "M",
        watchdog: bool = True,
        baud: int = 115_200,
        clock: Clock = time,
    ) -> None:
        if not re.fullmatch(r"[A-Za-z]", str(motor)):
            raise SettingError(name="motor", expected="one letter", received=repr(motor))
        self._motor, self._wants_watchdog = motor, watchdog
        self._before: dict[str, float] = {}
        self._watchdog: str | None = None
        super().__init__(
            port, Ts=Ts, volt=volt, speed=speed, counts_per_rev=counts_per_rev, baud=baud,
            clock=clock,
        )  # fmt: skip

    @property
    def name(self) -> str:
        return f"SimpleFOC motor {self._motor}"

    def _prepare(self) -> None:
        # numbers alone, with six decimals
        self._tell("@1")
        self._tell("#6")
        self._discard()
        registered = self._registered()
        if self._motor not in registered:
            raise SettingError(
                name="motor", expected=f"a motor that the sketch has registered as {self._motor!r}",
                received=", ".join(sorted(registered)) or "none",
                remedy="add it with commander.add, or name its letter",
            )  # fmt: skip
        self._watchdog = next((c for c, label in registered.items() if "watchdog" in label), None)
        if self._watchdog is None and self._wants_watchdog:
            raise SettingError(
                name="watchdog", expected="a sketch that stops the motor where nothing comes",
                received="none",
                remedy="add its lines (page on drives of other makers), or watchdog=False",
            )  # fmt: skip
        self._tell(f"{self._motor}MD0")
        if not self._discard():
            raise LinkError(
                name=self._port.url, expected="a board that is silent unless asked",
                received="one that goes on telling", remedy="take its telemetry out of the sketch",
            )  # fmt: skip
        if self._number(f"{self._motor}R") > 0.0:
            raise SettingError(
                name=self.name, expected="a motor whose phase resistance is not set",
                received="one whose commands are currents",
                remedy="take the resistance out of BLDCMotor(...)",
            )  # fmt: skip
        # a sketch leaves its motor enabled after initFOC
        self._halt()

    def _registered(self) -> dict[str, str]:
        """Letters and labels of what the sketch has registered."""
        self._tell("?")
        found, deadline = {}, self._clock.monotonic() + QUIET_WITHIN
        with suppress(LinkError):
            # the list has no end but silence
            while self._clock.monotonic() < deadline:
                letter, separator, label = self._line("?").partition(":")
                if separator and len(letter) == 1:
                    found[letter] = label.lower()
        return found

    def _arm(self) -> None:
        motor = self._motor
        wanted = {f"{motor}LU": self.volt}
        if self._watchdog is not None:
            wanted[self._watchdog] = 1e3 * WATCHDOG
        for told, answer in ((f"{motor}C0", "torque"), (f"{motor}T0", "volt")):
            if (found := self._ask(told)) != answer:
                raise self._unexpected(f"{answer!r} in answer to {told!r}", found)
        for what, value in wanted.items():
            self._before.setdefault(what, self._number(what))
            self._require(f"{what}{value:.6f}", value)
        self._apply(0.0)
        self._require(f"{motor}E1", 1.0)

    def _disarm(self) -> None:
        self._require(f"{self._motor}E0", 0.0)
        for what, value in self._before.items():
            self._require(f"{what}{value:.6f}", value)
        self._before.clear()

    def _require(self, told: str, wanted: float) -> None:
        """Tell it and see that it is so."""
        if not math.isclose(found := self._number(told), wanted, rel_tol=1e-4, abs_tol=1e-4):
            raise self._unexpected(f"{wanted:g} in answer to {told!r}", f"{found:g}")

    def _require_running(self) -> None:
        if self._number(f"{self._motor}E") != 1.0:
            raise LinkError(
                name=self.name, expected="a motor that is enabled", received="a disabled one",
                remedy="see what the board says on its own; a watchdog may have expired",
            )  # fmt: skip

    def _apply(self, u: float) -> None:
        self._require(f"{self._motor}{u:.6f}", u)

    def _position(self) -> float:
        return self._number(f"{self._motor}MG6") / (2.0 * math.pi)
