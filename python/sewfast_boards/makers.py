"""Boards of other makers: `ODrive`, an axis of an ODrive with firmware 0.5, over its ASCII
protocol; `SimpleFOC`, a motor of a SimpleFOC sketch, over its Commander.

Written from the makers' documents and sources; never run on hardware (docs/boards.md).
"""

from __future__ import annotations

import math
import re
import time
from contextlib import suppress

from sewfast.errors import LinkError, SettingError
from sewfast.link.ports import Port

from .polled import QUIET_WITHIN, Clock, PolledBoard

IDLE, CLOSED_LOOP = 1, 8
"""States of an axis."""
TORQUE, PASSTHROUGH = 1, 1
"""Control mode and input mode during a run."""
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
        By default the configured value of the axis's encoder.

    Notes
    -----
    During a run the axis's own watchdog is set to 0.2 s, or 3 `Ts`: if this computer dies, the
    ODrive switches the motor off by itself. Afterwards control mode, input mode and watchdog are
    as before.
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
        self._axis, self._reads_counts = axis, counts_per_rev is None
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
        if self._reads_counts:
            self.counts_per_rev = self._read(f"{self._place}.encoder.config.cpr")
        # motor type with voltages as commands
        if round(self._read(f"{self._place}.motor.config.motor_type")) == 2:
            self.unit = "V"
        if round(self._read(f"{self._place}.current_state")) != IDLE:
            raise LinkError(
                name=self.name, expected="an axis in IDLE", received="one that is in use",
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
        """Set a property; only a refusal is answered, and the next question reads that answer."""
        self._send(f"w {self._place}.{what} {value:g}")

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
            ("config.watchdog_timeout", self._alive_within),
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
        self._send(f"c {self._axis} {u:.6f}")

    def _position(self) -> float:
        answer = self._ask(f"f {self._axis}")
        found = re.fullmatch(r"(\S+) (\S+)", answer)
        with suppress(ValueError):
            if found is not None and math.isfinite(turns := float(found[1])):
                return turns
        raise self._unexpected("position and velocity", answer)


class SimpleFOC(PolledBoard):
    """A motor of a SimpleFOC sketch, over its Commander, in torque mode by voltage.

    The sketch registers the motor (`commander.add('M', onMotor, "motor")`) and a time without a
    command after which it switches the motor off, under a label that contains the word `watchdog`
    (docs/boards.md shows the ten lines). The motor must have no phase resistance set: with one,
    SimpleFOC takes commands as currents.

    Parameters
    ----------
    port, Ts, volt, speed, counts_per_rev, baud, clock
        As `PolledBoard`; `volt` is in V. `counts_per_rev` is the sensor's, such as 16384.
    motor : str
        The letter under which the sketch registers the motor.
    watchdog : bool
        False if the sketch has none and somebody stands at the switch: if this computer dies,
        SimpleFOC itself keeps applying the last voltage.
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
        self._motor, self._requires_watchdog = motor, watchdog
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
        self._send("@1")
        self._send("#6")
        self._discard()
        registered = self._registered()
        if self._motor not in registered:
            raise SettingError(
                name="motor", expected=f"a motor that the sketch has registered as {self._motor!r}",
                received=", ".join(sorted(registered)) or "none",
                remedy="add it with commander.add, or name its letter",
            )  # fmt: skip
        self._watchdog = next((c for c, label in registered.items() if "watchdog" in label), None)
        if self._watchdog is None and self._requires_watchdog:
            raise SettingError(
                name="watchdog", expected="a sketch that stops the motor without commands",
                received="none",
                remedy="add its lines (page on drives of other makers), or watchdog=False",
            )  # fmt: skip
        self._send(f"{self._motor}MD0")
        if not self._discard():
            raise LinkError(
                name=self._port.url, expected="a board that is silent unless asked",
                received="one that keeps sending", remedy="remove telemetry from the sketch",
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
        """Letters and labels that the sketch has registered."""
        self._send("?")
        found, deadline = {}, self._clock.monotonic() + QUIET_WITHIN
        with suppress(LinkError):
            # only silence marks the end of the list
            while self._clock.monotonic() < deadline:
                letter, separator, label = self._line("?").partition(":")
                if separator and len(letter) == 1:
                    found[letter] = label.lower()
        return found

    def _arm(self) -> None:
        motor = self._motor
        wanted = {f"{motor}LU": self.volt}
        if self._watchdog is not None:
            wanted[self._watchdog] = 1e3 * self._alive_within
        for command, answer in ((f"{motor}C0", "torque"), (f"{motor}T0", "volt")):
            if (found := self._ask(command)) != answer:
                raise self._unexpected(f"{answer!r} in answer to {command!r}", found)
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

    def _require(self, command: str, wanted: float) -> None:
        """Send a setting and check that the board confirms it."""
        if not math.isclose(found := self._number(command), wanted, rel_tol=1e-4, abs_tol=1e-4):
            raise self._unexpected(f"{wanted:g} in answer to {command!r}", f"{found:g}")

    def _require_running(self) -> None:
        if self._number(f"{self._motor}E") != 1.0:
            raise LinkError(
                name=self.name, expected="a motor that is enabled", received="a disabled one",
                remedy="read the board's own output; a watchdog may have expired",
            )  # fmt: skip

    def _apply(self, u: float) -> None:
        self._require(f"{self._motor}{u:.6f}", u)

    def _position(self) -> float:
        return self._number(f"{self._motor}MG6") / (2.0 * math.pi)
