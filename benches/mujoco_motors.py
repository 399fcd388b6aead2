"""Commissioning on motors of MuJoCo, drawn by a seed, beside gains tuned on MuJoCo itself.

Each is a DC motor behind a voltage (back EMF, resistance, inductance) on a gear, an output shaft
with inertia, viscous damping and Coulomb friction, on some an unbalanced mass that gravity pulls
at over the turn of the output shaft, and an encoder on the motor's shaft at 1 ms. Nothing here is
shared with the package's virtual machine or with benches/drives.py.

    python benches/mujoco_motors.py                     20 motors of seed 0
    python benches/mujoco_motors.py --only 3 7 -o m.json    two of them; a JSON is gone on with
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sewfast import Dataset, commission, signals
from sewfast.commissioning import Refusal, SteppedBench

MOTORS = 20
SUBSTEPS = 2
GRAVITY = 9.81


# --- the machine: all that sewfast asks of it is `reset`, `step`, `counts` ------------------------


class MujocoMotor:
    """A MuJoCo model with one joint and one voltage, as a machine that is advanced by samples.

    The encoder sits on the motor's shaft, `gear` times as fast as the joint.
    """

    def __init__(self, xml: str, counts_per_rev: float, gear: float = 1.0) -> None:
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self.per_radian = gear * counts_per_rev / (2.0 * math.pi)
        self.rpm = gear * 30.0 / math.pi
        self.before = 0.0

    @property
    def counts(self) -> float:
        return math.floor(self.data.qpos[0] * self.per_radian + 0.5)

    @property
    def speed_rpm(self) -> float:
        # MuJoCo moves a position with the speed at the end of a step, so the speed that the
        # positions have is half a step ahead of its own
        now = float(self.data.qvel[0])
        return (now + 0.5 * (now - self.before)) * self.rpm

    def reset(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.before = 0.0

    def step(self, u: float) -> None:
        self.data.ctrl[0] = u
        mujoco.mj_step(self.model, self.data, SUBSTEPS - 1)
        self.before = float(self.data.qvel[0])
        mujoco.mj_step(self.model, self.data, 1)


# --- the motors -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motor:
    """Parameters in SI units. Friction, damping and load are on the output shaft.

    Attributes
    ----------
    volt, constant, resistance, electrical : float
        Largest voltage [V], motor constant [V s], resistance [ohm], electrical time constant [s].
    rotor, load, gear : float
        Inertia of rotor and of load [kg m^2]; turns of the motor in one of the output shaft.
    viscous, coulomb, unbalance : float
        [N m s, N m, N m]; the last pulls over the turn of the output shaft.
    counts, speed : float
        Encoder counts of a turn; top of the working range [RPM], both of the motor's shaft.
    """

    name: str
    volt: float
    constant: float
    resistance: float
    electrical: float
    rotor: float
    load: float
    gear: float
    viscous: float
    coulomb: float
    unbalance: float
    counts: float
    speed: float

    @property
    def lag(self) -> float:
        """Mechanical time constant [s]."""
        inertia = self.rotor + self.load / self.gear**2
        return inertia * self.resistance / self.constant**2

    def xml(self) -> str:
        """The MuJoCo model. The mass hangs at rest: angle 0 is where nothing pulls."""
        arm = 0.05
        mass = max(self.unbalance / (GRAVITY * arm), 1e-6)
        # the load's inertia has that of the mass in it
        own = max(self.load - mass * arm**2, 0.02 * self.load)
        return f"""<mujoco>
  <option timestep="{1e-3 / SUBSTEPS}" integrator="implicitfast" gravity="0 0 -{GRAVITY}"/>
  <worldbody><body>
    <joint name="shaft" type="hinge" axis="0 1 0" damping="{self.viscous}"
      frictionloss="{self.coulomb}" solreffriction="0.004 1"/>
    <inertial pos="0 0 -{arm}" mass="{mass}" diaginertia="{own} {own} {own}"/>
  </body></worldbody>
  <actuator>
    <dcmotor joint="shaft" gear="{self.gear}" armature="{self.rotor}"
      motorconst="{self.constant}" resistance="{self.resistance}"
      inductance="{self.electrical * self.resistance} 0"
      ctrllimited="true" ctrlrange="-{self.volt} {self.volt}"/>
  </actuator>
</mujoco>"""


def drawn(number: int, seed: int = 0) -> Motor:
    """One motor of a seed."""
    rng = np.random.default_rng([seed, number])

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    volt, free, stall = float(rng.choice([12.0, 24.0, 48.0])), between(2500, 6000), between(0.1, 1)
    constant = volt / (free * math.pi / 30.0)
    resistance = constant * volt / stall
    slope = constant**2 / resistance
    gear = float(rng.choice([1.0, 1.0, 3.0, 5.0, 10.0, 20.0]))
    inertia, share = between(0.02, 0.3) * slope, rng.uniform(0.3, 0.8)
    has_load = bool(rng.random() < 0.5)
    return Motor(
        f"motor{number}", volt, constant, resistance, between(2e-4, 2e-3),
        rotor=inertia * (1.0 - share), load=inertia * share * gear**2, gear=gear,
        viscous=rng.uniform(0.0, 0.1) * slope * gear**2,
        coulomb=between(0.01, 0.08) * stall * gear,
        unbalance=has_load * between(0.01, 0.05) * stall * gear,
        counts=float(rng.choice([256, 512, 1024, 2048, 4096])),
        speed=round(0.5 * free, -2),
    )  # fmt: skip


def bench_of(motor: Motor) -> SteppedBench:
    """The motor as `commission` takes it."""
    machine = MujocoMotor(motor.xml(), motor.counts, motor.gear)
    return SteppedBench(
        machine, Ts=1e-3, counts_per_rev=motor.counts, volt=motor.volt, name=motor.name
    )


def recorded(bench: SteppedBench) -> Dataset:
    """The motor under the signals of README's example, scaled to its largest command."""
    parts = []
    for name in ("chirp_lo_hi", "saturating"):
        u = signals.excitation(name)
        parts.append(bench.excite(u * (0.9 * bench.volt / np.max(np.abs(u))), name).dataset())
    return Dataset.concat(parts)


# --- figures --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Figures:
    """What came of one commissioning; `oracle` is the cost of gains tuned on MuJoCo itself."""

    motor: str
    seed: int
    drawn: str
    verdict: str
    reason: str
    predicted: float | None
    measured: float | None
    oracle: float | None
    resonance: str
    cpu: float
    oracle_cpu: float

    @property
    def ratio(self) -> float | None:
        """Cost over the oracle's."""
        if self.measured is None or self.oracle is None:
            return None
        return self.measured / self.oracle


def figures(
    motor: Motor, seed: int, evaluations: int | None, cost_alone: bool = False, **settings: Any
) -> Figures:
    """Commission one motor; `evaluations` of the oracle, 0 for none."""
    from oracle import EVALUATIONS, oracle

    bench, reason, best = bench_of(motor), "", None
    began = time.process_time()
    try:
        found = commission(bench, speed=motor.speed, seed=seed, **settings)
    except Refusal as refusal:
        if refusal.so_far is None:
            raise
        found, reason = refusal.so_far, f"{refusal.stage}: {refusal}"
    used, began = time.process_time() - began, time.process_time()
    if found.measured_cost is not None and evaluations != 0:
        best = oracle(
            bench, found, seed=seed, evaluations=evaluations or EVALUATIONS, cost_alone=cost_alone
        ).cost
    small = found.small_signal
    described = (
        f"{motor.volt:g} V, {1e3 * motor.lag:.0f} ms, 1:{motor.gear:g}, {motor.counts:g} counts"
        + (", load" if motor.unbalance else "")
    )
    return Figures(
        motor.name, seed, described, found.verdict, reason, found.predicted_cost,
        found.measured_cost, best,
        "" if small is None or small.resonance is None else str(small.resonance),
        used, time.process_time() - began,
    )  # fmt: skip


def line(f: Figures) -> str:
    """A row of the table."""
    numbers = (f.predicted, f.measured, f.oracle, f.ratio)
    costs = " ".join(f"{'-' if c is None else f'{c:.2f}':>8}" for c in numbers)
    return (
        f"{f.motor:8}{f.seed:3}  {f.drawn:40}{f.verdict:26}{costs}  {f.cpu:5.0f} "
        f"{f.oracle_cpu:5.0f}  {f.resonance} {f.reason[:200]}"
    ).rstrip()


HEAD = (
    f"{'motor':8}{'seed':>4} {'drawn':40}{'verdict':26}{'predicted':>8}{'measured':>9}"
    f"{'oracle':>9}{'ratio':>9}  cpu s, oracle's"
)


def summary(found: list[Figures]) -> str:
    """Verified, cost over the oracle's, measured over predicted."""
    verified = sum(f.verdict.startswith("verified") for f in found)
    told = f"verified {verified} of {len(found)}"
    ratios = [f.ratio for f in found if f.ratio is not None]
    if ratios:
        told += f"; cost over the oracle's: median {np.median(ratios):.2f}, worst {max(ratios):.2f}"
    apart = [f.measured / f.predicted for f in found if f.measured and f.predicted]
    if apart:
        told += f"; measured over predicted: median {np.median(apart):.2f}, worst {max(apart):.2f}"
    return told


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", type=int, help="motors by number, from 0")
    parser.add_argument("--seeds", type=int, default=1, help="commissionings of each")
    parser.add_argument("--draw", type=int, default=0, help="seed that the motors are drawn by")
    parser.add_argument("--oracle", type=int, help="evaluations of the oracle (0: none)")
    parser.add_argument(
        "--cost-alone", action="store_true", help="an oracle that need not bear a load, nor any Ms"
    )
    parser.add_argument("-o", dest="out", type=Path, help="JSON to write, and to go on with")
    args = parser.parse_args()
    kept: dict[str, dict[str, Any]] = {}
    if args.out is not None and args.out.exists():
        kept = json.loads(args.out.read_text())
    found = []
    print(f"MuJoCo {mujoco.__version__}, motors drawn by seed {args.draw}\n{HEAD}")
    for number in args.only or range(MOTORS):
        for seed in range(args.seeds):
            key = f"{args.draw}/{number}/{seed}"
            if key not in kept:
                one = figures(drawn(number, args.draw), seed, args.oracle, args.cost_alone)
                kept[key] = vars(one)
            found.append(Figures(**kept[key]))
            print(line(found[-1]), flush=True)
            if args.out is not None:
                args.out.write_text(json.dumps(kept, indent=1) + "\n")
    print(f"\n{summary(found)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
