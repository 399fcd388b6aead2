"""A drive that another library simulates: motulator's synchronous motor with vector control.

The 2.2 kW motor of motulator's examples, its current-vector control at 250 us (field weakening,
a computing delay, an averaged inverter), and a shaft with Coulomb and viscous friction. The command
is a torque [N m] at 1 ms, the speed is that of an encoder of 4,096 counts. `commission` takes it
from rest; then its gains, with feedforward and without, follow references beside motulator's own
speed controller, which is told the true inertia and has the bandwidth that is best for it on the
tuned references, and simple-pid with the gains of SIMC.

    python benches/pmsm.py                 seed 0
    python benches/pmsm.py --seeds 0 1 2
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import replace

import numpy as np
from motulator.drive import control, model
from motulator.drive.control import sm
from motulator.drive.utils import SynchronousMachinePars
from scipy.integrate import solve_ivp

from sewfast import commission, signals
from sewfast.commissioning import SteppedBench
from sewfast.rules import simc
from tracking import TUNED, UNSEEN, Decide, simple_pid, stepped

TORQUE, SPEED, TS, COUNTS = 14.0, 1500.0, 1e-3, 4096.0
INERTIA = 0.015
NOMINAL = 2.0 * math.pi * 75.0
"""Electrical angular speed from which the field is weakened [rad/s]."""
RPM = 30.0 / math.pi


def friction(speed: float) -> float:
    """Torque over speed [N m s/rad]: .4 N m of Coulomb's, and viscous."""
    return 0.4 / math.hypot(speed, 1.0) + 0.02


class Pmsm:
    """motulator's motor and vector control as a machine that is advanced by samples."""

    Ts, counts_per_rev = TS, COUNTS

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        own = SynchronousMachinePars(n_p=3, R_s=3.6, L_d=0.036, L_q=0.051, psi_f=0.545)
        self.drive = model.Drive(
            model.VoltageSourceConverter(u_dc=540.0),
            model.SynchronousMachine(own),
            model.StiffMechanicalSystem(J=INERTIA, B_L=friction),
        )
        limits = sm.CurrentReferenceCfg(own, nom_w_m=NOMINAL, max_i_s=1.5 * math.sqrt(2.0) * 5.0)
        self.control = sm.CurrentVectorControl(own, limits, sensorless=False)
        self.torque, self.turned, self.end = 0.0, 0.0, 0.0
        self.control.ref.tau_M = lambda t: self.torque

    @property
    def speed_rpm(self) -> float:
        return float(self.drive.mechanics.meas_speed()) * RPM

    @property
    def counts(self) -> float:
        return math.floor(self.turned * COUNTS / (2.0 * math.pi) + 0.5)

    def step(self, u: float) -> None:
        """As motulator's own loop of simulation, which cannot be stopped after a sample."""
        self.torque, self.end = u, self.end + TS
        drive = self.drive
        while drive.t0 < self.end - 1e-9:
            span, duty = self.control(drive)
            times, states = drive.pwm(span, drive.delay(duty))
            before = drive.mechanics.meas_position()
            for dt, state in zip(times, states, strict=True):
                drive.converter.inp.q_cs = state
                until = drive.t0 + dt
                found = solve_ivp(drive.rhs, (drive.t0, until), drive.get_initial_values())
                drive.set_states(list(found.y[:, -1]))
                drive.set_outputs(until)
                drive.t0 = until
            turned = drive.mechanics.meas_position() - before
            self.turned += math.remainder(turned, 2.0 * math.pi)


def motulators(bandwidth: float) -> Decide:
    """motulator's speed controller with the true inertia and this bandwidth [rad/s]."""
    loop = control.SpeedController(INERTIA, bandwidth, TORQUE)

    def decide(r: float, y: float) -> float:
        u = float(loop.output(r / RPM, y / RPM))
        loop.update(TS, u)
        return u

    return decide


def shown(seed: int) -> None:
    """Commission the drive and print the errors of every loop on it."""
    machine = Pmsm()
    bench = SteppedBench(machine, TS, COUNTS, TORQUE, "motulator", speed=1.6 * SPEED)
    began = time.process_time()
    done = commission(bench, speed=SPEED, seed=seed)
    print(
        f"seed {seed}: {done.verdict}, {time.process_time() - began:.0f} s of processor with the "
        f"simulation; {done.controller}",
        flush=True,
    )
    assert done.fopdt is not None
    # the mean of 8 samples delays; the ratio of delay to time constant is below those of Eq. 12
    rule = simc(replace(done.fopdt, L=done.fopdt.L + 3.5 * TS)).gains
    controller = done.controller
    lead = done.tuning.lead
    print(lead, flush=True)
    # a slow drive is tuned on every k-th sample
    weights = {} if lead is None else {n: getattr(lead.alone, n) for n in ("alpha", "beta")}
    alone = replace(controller, feedforward=None, **weights)
    references = {name: signals.reference(name, seed) for name in (*TUNED, *UNSEEN)}
    references = {n: 0.8 * SPEED / np.max(np.abs(r)) * r for n, r in references.items()}
    best = min(
        (2.0 * math.pi * hz for hz in (20.0, 30.0, 45.0, 65.0, 90.0)),
        key=lambda b: sum(stepped(machine, references[n], motulators(b), TORQUE) for n in TUNED),
    )
    print(f"motulator's speed controller is best at {best / (2.0 * math.pi):g} Hz")
    print(f"{'error [RPM rms]':16} feedforward  PID alone  motulator  simple-pid")
    for name, r in references.items():
        own = [
            math.sqrt(np.mean((run.recording.speed_true - r) ** 2))
            for run in (bench.follow(c, r, name) for c in (controller, alone))
        ]
        rivals = (motulators(best), simple_pid(rule, TS, TORQUE))
        other = [stepped(machine, r, loop, TORQUE) for loop in rivals]
        print(f"{name:16}" + "".join(f" {e:11.1f}" for e in (*own, *other)), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    for seed in parser.parse_args().seeds:
        shown(seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
