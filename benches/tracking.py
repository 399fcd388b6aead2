"""What a feedforward is worth: error along references on machines, beside rivals: `make tracking`.

Each machine is recorded as in the README's example, a model identified, and gains tuned on it with
the default references. Rivals have the same plant, limits, encoder and sample time: our own PID
without feedforward, simple-pid with the gains of Eq. 12, and a linear-quadratic regulator with
integral action and a Kalman filter (python-control) on the model linearised half way up.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import control
import numpy as np
from simple_pid import PID

import sewfast
from moves import error, recorded
from sewfast import Controller, VirtualMachine, run, signals
from sewfast.control.margins import operating_point
from sewfast.errors import SettingError
from sewfast.evidence import OperatingPoint
from sewfast.gains import Gains
from sewfast.models import Model
from sewfast.rules import eq_12, fit_fopdt

TUNED = ("trapezoid", "trapezoids", "random")
UNSEEN = ("chirp_hi_lo", "chirp_lo_hi")
FRICTION = ("coulomb_torque", "stribeck_torque", "viscous_friction")
ALTERED = {
    f"{name} {100 * (share - 1):+.0f} %": dict.fromkeys(parts, share)
    for name, parts in {
        "inertia": ("inertia",),
        "friction": FRICTION,
        "gain": ("amplifier_gain",),
    }.items()
    for share in (0.75, 1.25)
}
"""Changes of the machine after identification: factors on its parameters."""


Decide = Callable[[float, float], float]
"""The command for a reference and a measured speed [RPM]."""


def stepped(machine: Any, r: np.ndarray, decide: Decide, limit: float = 20.0) -> float:
    """Error of a loop that another library decides on [RPM], within a limit of the command."""
    machine.reset()
    before, errors = machine.counts, []
    for wanted in r.tolist():
        counts = machine.counts
        errors.append(machine.speed_rpm - wanted)
        measured = (counts - before) * 60.0 / (machine.counts_per_rev * machine.Ts)
        before = counts
        machine.step(float(np.clip(decide(wanted, measured), -limit, limit)))
    return float(np.sqrt(np.mean(np.square(errors))))


def simple_pid(gains: Gains, Ts: float, limit: float = 20.0) -> Decide:
    """simple-pid with these gains, behind a mean of 8 samples."""
    own = gains.to("parallel")
    pid = PID(own.Kp, own.Ki, own.Kd, sample_time=None, output_limits=(-limit, limit))
    kept = [0.0] * 8

    def decide(r: float, y: float) -> float:
        kept[:] = [*kept[1:], y]
        pid.setpoint = r
        return float(pid(sum(kept) / 8, dt=Ts))

    return decide


def on_step(model: Model) -> Gains:
    """Eq. 12's gains on the model's step, with the delay of the mean."""
    u = np.where(np.arange(3000) < 100, 0.0, 6.0)
    fopdt = fit_fopdt(u, model.simulate(u), Ts=model.Ts)
    return eq_12(replace(fopdt, L=fopdt.L + 3.5 * model.Ts), Ms=1.8).gains


def regulator(point: OperatingPoint, counts: float) -> Callable[[], Decide]:
    """Linear-quadratic with integral action and a Kalman filter for the encoder's noise."""
    A, B, C, _ = point.delayed()
    n = len(A)
    step = 60.0 / (counts * point.Ts) / math.sqrt(6.0)
    whole = np.block([[A, np.zeros((n, 1))], [-C, np.ones((1, 1))]])
    weight = np.zeros((n + 1, n + 1))
    weight[:n, :n] = C.T @ C
    weight[n, n] = 3e-3
    K, _, _ = control.dlqr(whole, np.vstack([B, [[0.0]]]), weight, [[300.0]])
    L, _, _ = control.dlqe(A, B, C, [[0.3]], [[step**2]])
    K, L = np.asarray(K), np.asarray(L)
    gain, steady = float(point.dc_gain[0]), np.linalg.solve(np.eye(n) - A, B)

    def loop() -> Decide:
        state, total, u = np.zeros((n, 1)), 0.0, 0.0

        def decide(r: float, y: float) -> float:
            nonlocal state, total, u
            off = y - float((C @ state)[0, 0])
            corrected = state + L * off
            held = r / gain
            wanted = (
                held
                - float((K[:, :n] @ (corrected - steady * held))[0, 0])
                - float(K[0, n] * total)
            )
            u = float(np.clip(wanted, -20.0, 20.0))
            if u == wanted:
                total += r - y
            state = A @ corrected + B * u
            return u

        return decide

    return loop


def row(seed: int, machine: VirtualMachine) -> dict[str, Any]:
    """The errors on one machine, model and tuning of one seed [RPM rms]."""
    began = time.process_time()
    model = sewfast.identify(recorded(machine), seed=seed)
    tuned = sewfast.tune(model, counts_per_rev=machine.counts_per_rev, seed=seed)
    led = tuned.pid
    alone = led if tuned.lead is None else tuned.lead.alone
    found: dict[str, Any] = {
        "taken": led.feedforward is not None,
        "cpu": time.process_time() - began,
    }
    member = model.members[0] if model.members else model
    rivals: dict[str, Callable[[], Decide]] = {
        "simple-pid": partial(simple_pid, on_step(member), member.Ts)
    }
    with contextlib.suppress(SettingError):  # a member that holds no such speed
        point = operating_point(member, 1500.0)
        rivals["LQI"] = regulator(point, machine.counts_per_rev)
    for name in (*TUNED, *UNSEEN):
        loops = {"with": run(led, machine, name), "alone": run(alone, machine, name)}
        predicted = run(led, model, name)
        found[name] = {key: error(loop) for key, loop in loops.items()}
        found[name]["off"] = float(np.sqrt(np.mean((predicted.y - loops["with"].y) ** 2)))
        change = [float(np.std(np.diff(loop.u))) for loop in loops.values()]
        found[name]["change"] = change[0] / change[1]
        for rival, made in rivals.items():
            found[name][rival] = stepped(machine, signals.reference(name, 0), made())
    found["altered"] = [altered(machine, led, alone, factors) for factors in ALTERED.values()]
    return found


def altered(
    machine: VirtualMachine, led: Controller, alone: Controller, factors: dict[str, float]
) -> float:
    """Error over that of the PID alone on a changed machine, the worst of the tuned references."""
    changed = {name: machine.parameters[name] * factor for name, factor in factors.items()}
    other = VirtualMachine(parameters={**machine.parameters, **changed})
    pairs = [(run(led, other, name), run(alone, other, name)) for name in TUNED]
    return max(error(one) / error(two) for one, two in pairs)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="on the nominal machine (5)")
    parser.add_argument("--machines", type=int, default=8, help="virtual:1 to this, seed 0 (8)")
    args = parser.parse_args()
    cases = [(f"virtual, seed {s}", s, VirtualMachine()) for s in range(args.seeds)]
    cases += [(f"virtual:{k}", 0, VirtualMachine(k)) for k in range(1, args.machines + 1)]
    rows = {}
    for title, seed, machine in cases:
        found = rows[title] = row(seed, machine)
        first = found["trapezoid"]
        print(
            f"{title:16} trapezoid {first['with']:5.1f} RPM, alone {first['alone']:5.1f}, "
            f"simple-pid {first['simple-pid']:6.1f}, LQI {first.get('LQI', math.nan):6.1f}; "
            f"off {first['off']:.1f}, change of command x {first['change']:.2f}; unseen x "
            + " ".join(f"{found[n]['with'] / found[n]['alone']:.2f}" for n in UNSEEN)
            + "; a quarter off x "
            + " ".join(f"{ratio:.2f}" for ratio in found["altered"])
            + ("" if found["taken"] else "; NOT TAKEN"),
            flush=True,
        )
    every = list(rows.values())
    worst = {
        "trapezoid on the machine, worst [RPM rms] (must 10, stretch 6)": max(
            r["trapezoid"]["with"] for r in every
        ),
        "prediction off, worst [RPM rms] (5, 3)": max(
            r[n]["off"] for r in every for n in (*TUNED, *UNSEEN)
        ),
        "change of command over the PID's, worst (1.1, 1.0)": max(
            r["trapezoid"]["change"] for r in every
        ),
        "references never seen, error over the PID's, worst (.33, .17)": max(
            r[n]["with"] / r[n]["alone"] for r in every for n in UNSEEN
        ),
        "machine a quarter off, error over the PID's, worst (1.0)": max(
            max(r["altered"]) for r in every
        ),
        "the same, median (.5)": statistics.median(x for r in every for x in r["altered"]),
    }
    print()
    for title, value in worst.items():
        print(f"{title:68} {value:6.2f}")
    print("altered:", ", ".join(ALTERED))
    return 0


if __name__ == "__main__":
    sys.exit(main())
