"""`record`: commands applied to a machine, and what it did."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray
from ..errors import DataError
from ..machine import VirtualMachine
from ..recordfile.writer import require_replaceable
from ..recording import Recording
from ..speed import Method
from .benches import MachineBench, guarded, machine_of
from .machine import Machine, cancelled_by, is_streaming

if TYPE_CHECKING:
    from ..live import ViewKind


def record(
    machine: VirtualMachine | Machine,
    u: ArrayLike,
    *,
    name: str = "array",
    method: Method = "kalman",
    file: str | os.PathLike[str] | None = None,
    live: str | ViewKind = "none",
    settings: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    cancel: threading.Event | None = None,
) -> Recording:
    """Excite a machine from rest and record it.

    Parameters
    ----------
    machine : VirtualMachine, Drive or a machine of your own
        A virtual machine is reset first and stays in the state at the end of the run. A drive
        (`sewfast.link`) waits for rest, is armed and started; its limits must have been set. Your
        own is a `Machine`; wrap a simulator in a `sewfast.commissioning.SteppedBench`.
    u : array, shape (N,)
        Command [V] at the machine's sample time; see `sewfast.signals.excitation`.
    name : str
        Name of the excitation, for messages and files.
    method : "kalman", "savgol" or "difference"
        Method of estimating the speed of a virtual machine or a drive from the counts.
    file : path, optional
        For a drive, an MCAP recording, written while it runs so that nothing is lost; for another
        machine any format, written at the end.
    live : str
        For a drive: see `sewfast.live.open_view`.
    settings : mapping, optional
        Further entries for the header of the file.
    overwrite : bool
        Whether `file` may replace a recording of a drive, which cannot be repeated exactly; one of
        a virtual machine is always replaced.
    cancel : threading.Event, optional
        For a drive: set it in another thread to end the run as Ctrl-C does.

    Returns
    -------
    Recording
        For a virtual machine, `u` is the command as given, which the machine clips at its limit;
        for a drive, the command as applied.

    Raises
    ------
    DataError
        If `u` is not one-dimensional and finite, or too short for a speed.
    SettingError
        Before anything moves, if `file` has an unknown ending or must not be replaced.
    LinkError
        If the port or the drive failed or tripped; the motor is stopped, `recording` holds the
        samples so far.
    Interrupted
        On Ctrl-C or `cancel` with a drive; the motor is stopped, `best` is the recording so far.
    """
    if not is_streaming(machine):
        machine_of(machine, name="machine", remedy="the machine comes first: record(machine, u)")
    command = _command(u)
    if is_streaming(machine):
        return machine.excite(
            command, name, method=method, file=file, live=live, settings=settings,
            overwrite=overwrite, **cancelled_by(cancel),
        )  # fmt: skip
    if file is not None:
        require_replaceable(file, overwrite=overwrite)
    if isinstance(machine, VirtualMachine):
        found = MachineBench(machine, method=method).excite(command, name)
    else:
        found = guarded(machine).excite(command, name)
    if file is not None:
        found.save(file, overwrite=overwrite)
    return found


def _command(u: ArrayLike) -> FloatArray:
    try:
        if np.iscomplexobj(u):
            raise TypeError("complex numbers")
        command = np.array(u, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as e:
        raise DataError(
            name="u", expected="numbers", received=repr(str(u)[:60]),
            remedy="a named one is sewfast.signals.excitation('step')",
        ) from e  # fmt: skip
    if command.ndim != 1:
        raise DataError(
            name="u", expected="shape (N,)", received=str(command.shape), remedy="pass one column"
        )
    return command
