"""A load on the virtual machine's shaft while a controller holds its speed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..control import Controller, vector
from ..dataset import FloatArray
from ..errors import DataError
from ..loop import ClosedLoopRun, check_fits, reference_samples
from ..machine import VirtualMachine


def run_under_load(
    controller: Controller,
    machine: VirtualMachine,
    reference: str | ArrayLike,
    load: ArrayLike,
    *,
    feedforward: ArrayLike | None = None,
    seed: int = 0,
    name: str | None = None,
) -> ClosedLoopRun:
    """Run a controller on a virtual machine whose shaft is loaded, from rest.

    Parameters
    ----------
    controller : Controller
    machine : VirtualMachine
        Is not changed.
    reference : str or array, shape (N,)
        As for `sewfast.run`.
    load : array, shape (N,)
        Load torque during each sample [N m], beside the machine's own; it brakes where it has the
        sign of the speed.
    feedforward : array, shape (N,), optional
        Added to the command before its limits [u].

    Raises
    ------
    SettingError, DataError
        As `sewfast.run`, and for a load that is not as long as the reference.
    """
    check_fits(controller, machine)
    r = reference_samples(reference, controller, seed)
    torque = _along("load", load, len(r))
    ahead = _along("feedforward", np.zeros(len(r)) if feedforward is None else feedforward, len(r))
    columns = _columns(controller, VirtualMachine(parameters=machine.parameters), r, torque, ahead)
    t = np.arange(len(r), dtype=np.float64) * controller.Ts
    title = name or (reference if isinstance(reference, str) else "reference")
    return ClosedLoopRun(
        t, r, *columns, controller, f"{machine.name} under load", title
    )  # fmt: skip


def _along(name: str, values: ArrayLike, n: int) -> FloatArray:
    found = vector(name, values)
    if len(found) != n or not np.isfinite(found).all():
        raise DataError(
            f"expected a finite {name} for each of the {n} samples of the reference, got "
            f"{len(found)}; give one value per sample"
        )
    return found


def _columns(
    controller: Controller, machine: VirtualMachine, r: FloatArray, torque: FloatArray,
    ahead: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    core = controller.core()
    per_speed = machine.counts_per_rev / 60.0 * controller.Ts
    u, y, feedback = (np.empty(len(r)) for _ in range(3))
    counts, speed = machine.counts, machine.speed_rpm
    before, held = counts, 0.0
    for k, wanted in enumerate(r.tolist()):
        u[k] = core.step(wanted, (counts - before) / per_speed, float(ahead[k]))
        y[k], feedback[k], before = speed, core.filtered, counts
        if torque[k] != held:
            held = float(torque[k])
            machine.set_load(held)
        counts, speed = machine.step(u[k])
    return u, y, feedback


def torque_of(machine: VirtualMachine, volt: float) -> float:
    """The load torque that costs the machine a command of `volt` when it is steady [N m]."""
    p = machine.parameters
    return volt * p["amplifier_gain"] * p["motor_constant"] / p["resistance"]
