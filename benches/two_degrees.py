"""Two degrees of freedom on the virtual machines: load steps, and what retuning one part leaves.

    python benches/two_degrees.py [--machines 0 1 2 3 4] [--out FILE.json]

A load of .3 N m comes on while 1,500 RPM are held. Beside Eq. 12's gains stands the controller that
`sewfast.commission` found on the same machine. Then only alpha and beta are retuned, and the answer
to the load is compared; then only the loop, while the reference is followed by feedforward.
Machine 0 is the nominal one.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sewfast import Controller, Gains, VirtualMachine, commission
from sewfast.analysis import run_under_load
from sewfast.analysis.responses import RECOVERED, torque_of
from sewfast.control import Fopdt
from sewfast.dataset import FloatArray
from sewfast.rules import eq_12

LOAD = 0.3
"""[N m]"""
SPEED = 1500.0
TIGHT = 2.5
"""A second, tighter band of recovery [RPM]; the first is `RECOVERED` of what the load would do."""
TURN = 40
"""Samples of a turn at 1,500 RPM."""
AT = 1800


def eq_12_controller(fopdt: Fopdt, like: Controller) -> Controller:
    """Eq. 12's gains in the same surroundings; the delay of the feedback's filter is dead time."""
    delay = ((like.filter_samples - 1) / 2 * like.Ts) + like.filter_time
    rule = eq_12(replace(fopdt, L=fopdt.L + delay))
    return replace(
        like, gains=rule.gains, alpha=rule.alpha, beta=rule.beta, N=10.0, schedule=(),
    )  # fmt: skip


def deviation(controller: Controller, machine: VirtualMachine) -> FloatArray:
    """Of the held speed from the load on, in the mean over a turn [RPM]."""
    r = np.interp(np.arange(AT + 1200), [0, 400], [0.0, SPEED])
    load = np.where(np.arange(len(r)) < AT, 0.0, LOAD)
    off = run_under_load(controller, machine, r, load).y - r
    return np.convolve(off, np.full(TURN, 1 / TURN), "valid")[AT - TURN + 1 :]


def answer(controller: Controller, machine: VirtualMachine) -> dict[str, float]:
    """Peak [RPM], recovery [ms] into both bands, integral of the error [RPM s].

    All of the mean over a turn. The first band is `RECOVERED` of what the load would do to the
    speed without control.
    """
    off = np.abs(deviation(controller, machine))
    free = LOAD / torque_of(machine, 1.0) * machine.linearise(SPEED)["gain"]
    return {
        "peak_rpm": float(off.max()),
        "recovery_ms": _last(off > RECOVERED * free),
        "recovery_tight_ms": _last(off > TIGHT),
        "iae_rpm_s": float(off.sum() * controller.Ts),
    }


def _last(outside: NDArray[np.bool_]) -> float:
    """When it was outside for the last time [ms]."""
    found = np.flatnonzero(outside)
    return float(found[-1] + 1) if len(found) else 0.0


def retuned_f2(controller: Controller, machine: VirtualMachine) -> dict[str, float]:
    """How much other alpha and beta, and another Kp, change the answer to the load [RPM rms]."""
    base = deviation(controller, machine)[:400]
    weights = replace(controller, alpha=controller.alpha + 0.4, beta=controller.beta + 0.4)
    softer = scaled(controller, 0.5)
    return {
        "f2_moves_load_rpm": _rms(deviation(weights, machine)[:400] - base),
        "f1_moves_load_rpm": _rms(deviation(softer, machine)[:400] - base),
    }


def retuned_f1(controller: Controller, machine: VirtualMachine) -> dict[str, float]:
    """How much half of Kp changes tracking, with and without feedforward [RPM rms]."""
    wanted, ahead = model_following(machine)
    late = round(0.5 + (controller.filter_samples - 1) / 2 + controller.filter_time / controller.Ts)
    r = np.concatenate([np.zeros(late), wanted[: len(wanted) - late]])
    bare = replace(controller, alpha=0.0, beta=0.0)

    def moved(command: FloatArray) -> float:
        none = np.zeros(len(r))
        one, other = (
            run_under_load(c, machine, r, none, feedforward=command).y
            for c in (bare, scaled(bare, 0.5))
        )
        return _rms(one - other)

    return {
        "f1_moves_followed_rpm": moved(ahead),
        "f1_moves_tracking_rpm": moved(np.zeros(len(r))),
    }


def scaled(controller: Controller, factor: float) -> Controller:
    """The loop's gain times a factor."""

    def of(gains: Gains) -> Gains:
        g = gains.to("standard")
        return Gains.standard(factor * g.Kp, g.Ti, g.Td, u_unit=g.u_unit, y_unit=g.y_unit)

    schedule = tuple((s, of(g)) for s, g in controller.schedule)
    return replace(controller, gains=of(controller.gains), schedule=schedule)


def model_following(machine: VirtualMachine) -> tuple[FloatArray, FloatArray]:
    """A trapezoid through three lags of 20 ms, and the command that the machine needs for it."""
    wanted = np.interp(np.arange(1500), [100, 500, 1100, 1500], [0.0, 2000.0, 2000.0, 200.0])
    pole = np.exp(-0.001 / 0.02)
    for _ in range(3):
        lagged = np.zeros(len(wanted))
        for k in range(1, len(wanted)):
            lagged[k] = pole * lagged[k - 1] + (1 - pole) * wanted[k - 1]
        wanted = lagged
    small = machine.linearise(1500.0)
    rate = np.gradient(wanted, 0.001)
    T1, T2 = small["T1"], small["T2"]
    inertia = (T1 + T2) * rate + T1 * T2 * np.gradient(rate, 0.001)
    friction = small["command"] - 1500.0 / small["gain"]
    return wanted, (wanted + inertia) / small["gain"] + friction * (wanted > 1.0)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def measured(seed: int) -> dict[str, Any]:
    machine = VirtualMachine(seed or None)
    found = commission(machine)
    assert found.controller is not None
    assert found.fopdt is not None
    rule = eq_12_controller(found.fopdt, found.controller)
    return {
        "machine": machine.name,
        "commissioned": answer(found.controller, machine),
        "eq_12": answer(rule, machine),
        **retuned_f2(found.controller, machine),
        **retuned_f1(found.controller, machine),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows = []
    for seed in args.machines:
        row = measured(seed)
        rows.append(row)
        print(json.dumps(row, indent=1), flush=True)
    if args.out is not None:
        args.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
