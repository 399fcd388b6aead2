"""`Rig`: the virtual machine as the experiment has it, a drive behind a port."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..commissioning.bench import DriveBench, Followed
from ..control import Controller
from ..errors import LinkError
from ..link import VirtualDevice, connect
from ..loop import ClosedLoopRun, run
from ..machine import VirtualMachine
from ..recording import Recording, record

T = TypeVar("T")


@dataclass(eq=False)
class Rig(DriveBench):
    """A drive, and what went over its link so far.

    Attributes
    ----------
    drive : Drive
    machine : VirtualMachine
        What is behind the port; asked only for what no drive could tell.
    port : str
        `pty` or `tcp`.
    samples : int
        That the device took and the host received.
    seconds : float
        That the runs took.
    """

    machine: VirtualMachine
    port: str
    samples: int = 0
    seconds: float = 0.0

    def excite(self, u: NDArray[np.float64], name: str) -> Recording:
        """Excite the drive, as a bench of commissioning."""
        return self.record(u, name)

    def follow(self, controller: Controller, r: NDArray[np.float64], name: str) -> Followed:
        """Run a controller on the drive, as a bench of commissioning."""
        began = time.perf_counter()
        return self._counted(super().follow(controller, r, name), began)

    def record(self, u: NDArray[np.float64], name: str) -> Recording:
        """Excite the drive from rest; see `sewfast.recording.record`."""
        began = time.perf_counter()
        return self._counted(record(self.drive, u, name=name), began)

    def run(
        self, controller: Controller, reference: str, *, seed: int = 0, volt: float | None = None
    ) -> ClosedLoopRun:
        """Run a controller on the drive, with another volt limit where one is given."""
        began = time.perf_counter()
        before = self.drive.limits().volt
        self.drive.set_limits(volt=volt)
        found = run(controller, self.drive, reference, seed=seed)
        self.drive.set_limits(volt=before)
        return self._counted(found, began)

    def _counted(self, found: T, began: float) -> T:
        """What came, once it is known that nothing is missing."""
        outcome = self.drive.outcome
        if outcome is None or not outcome.is_complete:
            raise LinkError(f"expected every sample of the run, received: {outcome}; run it again")
        self.samples += outcome.received
        self.seconds += time.perf_counter() - began
        return found

    def numbers(self) -> dict[str, Any]:
        """`link` of `results.json`."""
        return {
            "port": self.port,
            "protocol": self.drive.identity.version,
            "samples": self.samples,
            "missing": 0,
            "times_real_time": self.samples * self.Ts / self.seconds,
        }


@contextmanager
def rig(machine: VirtualMachine) -> Iterator[Rig]:
    """Serve a machine on a port of its own and connect to it, limits at their ceilings."""
    port = _port()
    with (
        VirtualDevice(machine.name, fast=True, endpoint=port) as device,
        connect(device.port) as drive,
    ):
        drive.set_limits()
        yield Rig(drive, machine, port)


def _port() -> Literal["pty", "tcp"]:
    """A serial port where there are pseudo terminals and something that opens them."""
    return "pty" if find_spec("serial") and find_spec("pty") and find_spec("termios") else "tcp"
