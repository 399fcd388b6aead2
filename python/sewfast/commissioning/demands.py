"""`Demands`: the checked settings of a commissioning; `Refusal`: not enough evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from ..causes import Cause
from ..control.machine import Machine
from ..dataset import FloatArray
from ..errors import FitError, SettingError
from ..gains import real, whole
from ..report.commissioned import file_name
from ..tuning.objective import LARGEST_MS, Constraints
from ..tuning.search import LOOPS
from ..tuning.task import budget

if TYPE_CHECKING:
    from .result import Commissioning


class Refusal(FitError):
    """Commissioning stops, as the evidence is not good enough; the machine is at rest.

    Attributes
    ----------
    stage : str
        The stage at which it stopped.
    so_far : Commissioning or None
        Recordings, models and gains until then.
    """

    stage: str = ""
    so_far: Commissioning | None = None


def require(met: bool, message: str, cause: Cause | None = None) -> None:
    """Raise `Refusal` with this message unless the condition is met."""
    if not met:
        raise Refusal(message, cause=cause)


# --- `Demands` ------------------------------------------------------------------------------------


OVER = 1.25
"""Training covers this multiple of the top of the working range, as the loop overshoots it."""
ROOM = 1.1
"""The machine's limit over the top of planned signals: three motors passed it by up to 1.1 % at
1.25 times the working range, where it was their limit."""


@dataclass(frozen=True)
class Demands:
    """Limits, working range and effort. `u_max` [V] and `speed` [RPM] bound command and working
    range; `references` are those of the verification [RPM] and `practice` those of tuning, None for
    those of `excitations.standard`. `members` models make the ensemble, and the search tries
    `evaluations` controllers for `time_budget` [s]. `load` is a step of command [V] (None: a share
    of `u_max`; 0: not required), `Ms` the largest sensitivity on the small signals; above `stated`
    [RPM] the machine ends a run. `positions`: whether there is to be a position loop.
    """

    u_max: float
    speed: float
    references: Mapping[str, FloatArray] | None
    practice: Mapping[str, FloatArray] | None
    members: int
    evaluations: int
    seed: int
    threads: int
    load: float | None = None
    Ms: float | None = LARGEST_MS
    time_budget: float | None = None
    stated: float = math.inf
    positions: bool = False

    @property
    def top(self) -> float:
        """Largest speed of the planned signals [RPM], some way below the machine's own limit."""
        return min(OVER * self.speed, self.stated / ROOM)


def demands(
    machine: Machine,
    *,
    u_max: float | None,
    speed: float | None,
    references: Mapping[str, FloatArray] | None,
    practice: Mapping[str, FloatArray] | None = None,
    members: int,
    evaluations: int,
    seed: int,
    threads: int,
    load: float | None = None,
    Ms: float | None = LARGEST_MS,
    time_budget: float | None = None,
    loop: str = "speed",
) -> Demands:
    """The demands, checked against the machine's limits."""
    _require_machine(machine)
    if loop not in LOOPS:
        raise SettingError(name="loop", expected=f"one of {', '.join(LOOPS)}", received=repr(loop))
    volt = machine.volt if u_max is None else real("u_max", u_max)
    if not 0.0 < volt < math.inf:
        raise SettingError(
            name="u_max", expected="above 0 V", received=f"{volt:g}",
            remedy="give the amplifier's limit",
        )  # fmt: skip
    if volt > machine.volt * (1.0 + 1e-6):
        raise SettingError(
            name="u_max", expected=f"within the machine's limit of {machine.volt:g} V",
            received=f"{volt:g}",
        )  # fmt: skip
    asked = [*(references or {}).values(), *(practice or {}).values()]
    named = max(float(r.max()) for r in asked) if asked else None
    top = real("speed", speed if speed is not None else named if named is not None else 2000.0)
    if not 0.0 < top < math.inf:
        raise SettingError(name="speed", expected="above 0 RPM", received=f"{top:g}")
    if named is not None and named > top * (1.0 + 1e-9):
        raise SettingError(
            name="references", expected=f"none beyond the top speed of {top:g} RPM",
            received=f"one up to {named:g}", remedy="raise speed, or lower that reference",
        )  # fmt: skip
    if top * OVER > machine.speed:
        raise SettingError(
            name="speed",
            expected=f"a limit of the machine of {OVER:g} times that, {OVER * top:g} RPM, as "
            "training goes beyond the working range",
            received=f"{machine.speed:g}", remedy="raise that limit, or lower speed",
        )  # fmt: skip
    return Demands(
        volt,
        top,
        _fixed(references),
        _fixed(practice),
        _members(members),
        _at_least(1, "evaluations", evaluations),
        whole("seed", seed),
        _at_least(1, "threads", threads),
        _load(load, volt),
        None if Ms in (None, math.inf) else Constraints(Ms=Ms).Ms,
        None if time_budget is None else budget(time_budget),
        machine.speed,
        loop == "position",
    )


def _require_machine(machine: Machine) -> None:
    """Refuse a machine with impossible figures before it moves."""
    # shortest and longest sample time of a machine [s]: the signals are planned in seconds
    for name, low, high in (("Ts", 1e-5, 0.1), ("counts_per_rev", 1.0, 1e9)):
        value = real(name, getattr(machine, name))
        if not low <= value <= high:
            raise SettingError(
                name=name, expected=f"{low:g} to {high:g} of the machine", received=f"{value:g}",
                remedy="see what its controller and its encoder are set to",
            )  # fmt: skip
    for name in ("volt", "speed"):
        value = real(name, getattr(machine, name))
        if not value > 0.0:
            raise SettingError(
                name=name, expected="a limit of the machine above 0", received=f"{value:g}",
                remedy="see its amplifier; a speed without a limit is inf",
            )  # fmt: skip


def _load(load: float | None, volt: float) -> float | None:
    if load is None:
        return None
    size = real("load", load)
    if not 0.0 <= size < volt:
        raise SettingError(
            name="load", expected=f"from 0 V to below u_max = {volt:g} V", received=f"{size:g}",
            remedy="0 for none",
        )  # fmt: skip
    return size


def _fixed(references: Mapping[str, FloatArray] | None) -> Mapping[str, FloatArray] | None:
    """The references, whose names must also be distinct file names."""
    # longest name of a reference's file [bytes]; file systems allow 255, including the endings
    longest_name = 100
    if references is None:
        return None
    files: dict[str, str] = {}
    for name in references:
        file = file_name(name)
        if len(file.encode()) > longest_name:
            raise SettingError(
                name="references", expected=f"names of up to {longest_name} bytes",
                received=f"{name[:40]!r}.. of {len(file.encode())}", remedy="shorten it",
            )  # fmt: skip
        if file in files:
            raise SettingError(
                name="references", expected="names that differ in letters, digits, '-', '_' or '.'",
                received=f"{files[file]!r} and {name!r}, which would be one file",
                remedy="rename one",
            )  # fmt: skip
        files[file] = name
    return MappingProxyType(dict(references))


def _members(value: int) -> int:
    most_members = 100
    number = _at_least(1, "members", value)
    if number > most_members:
        raise SettingError(
            name="members", expected=f"up to {most_members}", received=f"{number}",
            remedy="4 are usual, and each is trained for seconds",
        )  # fmt: skip
    return number


def _at_least(least: int, name: str, value: int) -> int:
    number = whole(name, value)
    if number < least:
        raise SettingError(name=name, expected=f"{least} or more", received=f"{number}")
    return number
