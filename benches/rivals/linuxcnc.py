"""LinuxCNC's `pid` with its relay autotune, the component of the Debian package linuxcnc-uspace."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

MODULE = Path("/usr/lib/linuxcnc/modules/pid.so")
BITS = ("enable", "saturated", "index-enable", "error-previous-target", "tune-mode", "tune-start")


@cache
def _hal() -> Any:
    """The calls of HAL that the component makes, compiled once."""
    source = Path(__file__).with_name("hal.c")
    library = Path(tempfile.mkdtemp()) / "hal.so"
    subprocess.run(
        ["cc", "-O1", "-shared", "-fPIC", "-o", str(library), str(source), "-ldl"], check=True
    )
    hal = ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    hal.hal_pin.restype = ctypes.c_void_p
    return hal


def is_installed() -> bool:
    """Whether the component is on this computer."""
    return MODULE.exists()


class LinuxCncPid:
    """One loop; `command` and `feedback` in counts, the output in volt.

    Parameters
    ----------
    Ts, limit : float
        Sample time [s]; largest output [V].
    gains : float
        Values of pins by their names: Pgain, Igain, Dgain, FF1, FF2 and so on.
    """

    def __init__(self, Ts: float, limit: float, **gains: float) -> None:
        self._hal, self._period = _hal(), round(Ts * 1e9)
        if self._hal.hal_load(str(MODULE).encode()) != 0:
            raise RuntimeError(f"{MODULE} does not load: apt-get install linuxcnc-uspace")
        self._pins: dict[str, Any] = {}
        self["maxoutput"], self["enable"] = limit, 1
        for name, value in gains.items():
            self[name] = value

    def _pin(self, name: str) -> Any:
        if name not in self._pins:
            kind: Any = ctypes.c_double
            if name in BITS:
                kind = ctypes.c_bool
            elif name in ("tune-cycles", "tune-type"):
                kind = ctypes.c_uint32
            at = self._hal.hal_pin(f"pid.0.{name}".encode())
            if not at:
                raise KeyError(name)
            self._pins[name] = kind.from_address(at)
        return self._pins[name]

    def __getitem__(self, name: str) -> float:
        return float(self._pin(name).value)

    def __setitem__(self, name: str, value: float) -> None:
        pin = self._pin(name)
        pin.value = type(pin.value)(value)

    def step(self, command: float, feedback: float) -> float:
        """The output of one sample."""
        self["command"], self["feedback"] = command, feedback
        self._hal.hal_calculate(self._period)
        return self["output"]


def autotuned(
    step: Callable[[float], float], Ts: float, limit: float, *, effort: float, seconds: float = 20.0
) -> dict[str, float]:
    """Gains of the relay test at rest: `step` takes a command [V] and returns the counts then.

    Raises
    ------
    RuntimeError
        If the test does not end in this time.
    """
    pid = LinuxCncPid(Ts, limit)
    pid["tune-effort"], pid["tune-cycles"], pid["tune-type"] = effort, 20, 0
    pid["tune-mode"] = 1
    counts = step(pid.step(0.0, 0.0))
    pid["tune-start"] = 1
    for _ in range(round(seconds / Ts)):
        counts = step(pid.step(0.0, counts))
        if not pid["tune-start"]:
            break
    else:
        raise RuntimeError(f"the relay test of {effort:g} V does not end in {seconds:g} s")
    return {name: pid[name] for name in ("Pgain", "Igain", "Dgain")}
