"""`SimpleFOC`: a motor of a SimpleFOC sketch, over its Commander.

Written from the maker's documents and sources; never run on hardware (docs/boards.md).
"""

from __future__ import annotations

import math
import re
import time
from contextlib import suppress

from ..errors import LinkError, SettingError
from .boards import QUIET_WITHIN, WATCHDOG, Clock, PolledBoard
from .ports import Port


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
            wanted[self._watchdog] = 1e3 * WATCHDOG
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
