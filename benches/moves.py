"""Known moves: what a table brings, and what repetitions add: `make moves`.

Each machine is recorded as in the README's example, a model identified and gains tuned on it. Then
a table of the trapezoid is planned on the model (`plan`), played on the machine, and learned on for
eight repetitions (`learn`). Errors are those of the true speed [RPM rms]; learning sees counts.

`--motors` does the same with motors of MuJoCo, on trapezoids to their working speed whose ramps
take half again as long as the steepest that the motor can against its friction and load.

`--runs` repeats learning on machines that changed after identification: inertia a quarter off
either way, noise on the load that no two runs share, and a further load from repetition 5 on.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import mujoco_motors
import sewfast
from mujoco_motors import Motor
from sewfast import Controller, MoveTable, VirtualMachine, learn, plan, run, signals
from sewfast.commissioning import SteppedBench
from sewfast.models import Model

Drive = tuple[Model, Controller, Controller]


def recorded(machine: VirtualMachine) -> sewfast.Dataset:
    """The training record of the README's example."""
    parts = []
    for name in ("chirp_lo_hi", "saturating"):
        machine.reset()
        u = signals.excitation(name)
        y = sewfast.speed_from_counts(machine.run(u).counts, machine.Ts, machine.counts_per_rev)
        parts.append(
            sewfast.Dataset.from_arrays(u, y, machine.Ts, input_units="V", output_unit="RPM")
        )
    return sewfast.Dataset.concat(parts)


def error(loop: sewfast.ClosedLoopRun) -> float:
    return float(np.sqrt(np.mean((loop.y - loop.r) ** 2)))


def drive_of(
    seed: int, machine: VirtualMachine | SteppedBench, kept: Path | None, kind: str = "auto"
) -> Drive:
    """Model and gains, with feedforward and without; taken from a folder if they are there."""
    names = ("model", "with", "alone")
    if kept is not None:
        files = [kept / f"{machine.name.replace(':', '-')}-{seed}-{name}.json" for name in names]
        if all(f.exists() for f in files):
            pids = map(sewfast.load_controller, files[1:])
            return sewfast.load_model(files[0]), *pids  # type: ignore[return-value]
    if isinstance(machine, VirtualMachine):
        data = recorded(machine)
    else:
        data = mujoco_motors.recorded(machine)
    model = sewfast.identify(data, model=kind, seed=seed)
    tuned = sewfast.tune(model, counts_per_rev=machine.counts_per_rev, seed=seed)
    alone = tuned.pid if tuned.lead is None else tuned.lead.alone
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        for one, file in zip((model, tuned.pid, alone), files, strict=True):
            one.save(file)
    return model, tuned.pid, alone


def row(
    model: Model, led: Controller, alone: Controller, machine: VirtualMachine | SteppedBench,
    reference: str | np.ndarray = "trapezoid",
) -> dict[str, Any]:  # fmt: skip
    """Errors on one machine, and the seconds that a plan took."""
    plain = run(alone, machine, reference)
    found: dict[str, Any] = {"alone": error(plain), "with": error(run(led, machine, reference))}
    for name, controller in (("table", led), ("table alone", alone)):
        began = time.perf_counter()
        table = plan(controller, model, reference)
        found[f"{name} s"] = time.perf_counter() - began
        played = run(controller, machine, table=table)
        found[name] = error(played)
        learned = learn(table, model, machine)
        best = run(controller, machine, table=learned.table)
        found[f"{name} learned"] = error(best)
        found[f"{name} change"] = float(np.std(np.diff(best.u)) / np.std(np.diff(plain.u)))
        found[f"{name} played"] = len(learned.repetitions)
    return found


def trapezoid(motor: Motor) -> np.ndarray:
    """To the working speed, half of that without load, and back [RPM]."""
    stall = motor.gear * motor.constant * motor.volt / motor.resistance
    turning = motor.viscous * motor.speed * math.pi / 30.0 / motor.gear
    # of the stall torque half is lost at half of the speed without load, and this to the load
    held = (motor.coulomb + turning + motor.unbalance) / stall
    ramp = 1.5 * max(motor.lag, 0.02) * 0.5 / (0.5 - held)
    times = np.cumsum([0.1, ramp, 0.4, ramp, 0.3])
    t = np.arange(round(times[-1] / 1e-3)) * 1e-3
    return np.interp(t, times[:4], [0.0, motor.speed, motor.speed, 0.0])


class Shaken:
    """A virtual machine with noise on its load, and more load from a repetition on [N m]."""

    def __init__(self, machine: VirtualMachine, noise: float, late: float, seed: int) -> None:
        self.machine, self.noise, self.late = machine, noise, late
        self.random, self.runs = np.random.default_rng(seed), 0

    @property
    def counts(self) -> float:
        return float(self.machine.counts)

    @property
    def speed_rpm(self) -> float:
        return self.machine.speed_rpm

    def reset(self) -> None:
        self.machine.reset()
        self.runs += 1

    def step(self, u: float) -> None:
        late = self.late if self.runs >= 5 else 0.0
        self.machine.set_load(late + self.noise * self.random.standard_normal())
        self.machine.step(u)


def shaken(table: MoveTable, model: Model, machine: VirtualMachine, seed: int) -> dict[str, Any]:
    """Learning on a changed machine: true errors of each repetition, and outcomes."""
    random = np.random.default_rng([42, seed])
    own = machine.parameters
    factor = (0.75, 1.25, 1.0, random.uniform(0.75, 1.25))[seed % 4]
    changed = VirtualMachine(parameters={**own, "inertia": own["inertia"] * factor})
    # torques in parts of the dry friction
    noise, late = (random.uniform(0.0, m) * own["coulomb_torque"] for m in (1.0, 4.0))
    moving = Shaken(changed, noise, late if seed % 2 else 0.0, seed)
    bench = SteppedBench(
        moving, Ts=machine.Ts, counts_per_rev=machine.counts_per_rev, volt=own["u_limit"],
        name=f"shaken {seed}",
    )  # fmt: skip
    errors: list[float] = []
    follow = bench.follow

    def noted(*given: Any, **options: Any) -> Any:
        done = follow(*given, **options)
        errors.append(float(np.sqrt(np.mean((done.y - table.reference) ** 2))))
        return done

    object.__setattr__(bench, "follow", noted)
    found = learn(table, model, bench, repetitions=12)
    # the plan and the result under the same, last condition
    plan_only = error(run(table.controller, bench, table=table))
    final = error(run(table.controller, bench, table=found.table))
    return {"errors": errors, "plan": plan_only, "final": final, "reason": found.reason}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5, help="on the nominal machine (5)")
    parser.add_argument("--machines", type=int, default=8, help="virtual:1 to this, seed 0 (8)")
    parser.add_argument("--motors", type=int, default=0, help="of MuJoCo in their place (0)")
    parser.add_argument("--model", default="auto", help="kind of the models (auto)")
    parser.add_argument("--runs", type=int, default=0, help="on changed machines (0)")
    parser.add_argument("--first", type=int, default=0, help="the first of these runs (0)")
    parser.add_argument("--kept", type=Path, help="folder that keeps models and gains")
    args = parser.parse_args()
    cases: list[tuple[str, int, Any, Any]] = []
    if args.motors:
        for motor in map(mujoco_motors.drawn, range(args.motors)):
            bench = mujoco_motors.bench_of(motor)
            cases.append((motor.name, 0, bench, trapezoid(motor)))
    else:
        cases += [(f"virtual, seed {s}", s, VirtualMachine(), None) for s in range(args.seeds)]
        cases += [(f"virtual:{k}", 0, VirtualMachine(k), None) for k in range(1, args.machines + 1)]
    if args.runs:
        drives = [(drive_of(s, m, args.kept, args.model), m) for _, s, m, _ in cases]
        return changed(drives, range(args.first, args.first + args.runs))
    rows = {}
    for title, seed, machine, reference in cases:
        drive = drive_of(seed, machine, args.kept, args.model)
        found = rows[title] = row(*drive, machine, "trapezoid" if reference is None else reference)
        print(
            f"{title:16} alone {found['alone']:5.1f} RPM, feedforward {found['with']:5.1f}, "
            f"table {found['table']:5.1f} ({found['table s']:.2f} s), learned "
            f"{found['table learned']:5.1f} after {found['table played']}, change of command x "
            f"{found['table change']:.2f}; PID alone: table {found['table alone']:5.1f} "
            f"({found['table alone s']:.2f} s), learned {found['table alone learned']:5.1f}",
            flush=True,
        )
    every = list(rows.values())
    for title, values in {
        "table over feedforward, worst and median": [r["table"] / r["with"] for r in every],
        "table over PID alone": [r["table"] / r["alone"] for r in every],
        "PID with a table over PID alone": [r["table alone"] / r["alone"] for r in every],
        "learned over PID alone (must .1)": [r["table learned"] / r["alone"] for r in every],
        "a plan [s] (must 1, stretch .2)": [r["table s"] for r in every],
    }.items():
        print(f"{title:44} {max(values):6.3f} {statistics.median(values):6.3f}")
    return 0


def changed(drives: list[tuple[Drive, VirtualMachine]], seeds: range) -> int:
    """Learning on changed machines; how many diverged."""
    tables = [(plan(led, model, "trapezoid"), model, m) for (model, led, _), m in drives]
    ratios, worst, diverged = [], [], 0
    for seed in seeds:
        found = shaken(*tables[seed % len(tables)], seed)
        ratio, peak = found["final"] / found["plan"], max(found["errors"]) / found["errors"][0]
        grown = not (math.isfinite(ratio) and ratio < 1.1)
        diverged += grown
        ratios.append(ratio)
        worst.append(peak)
        print(
            f"run {seed:3}: plan {found['plan']:5.1f}, learned {found['final']:5.1f} RPM, largest "
            f"over first {peak:.2f}, {found['reason']}{'  DIVERGED' * grown}",
            flush=True,
        )
    print(
        f"{diverged} of {len(ratios)} diverged; learned over plan: worst {max(ratios):.2f}, median "
        f"{statistics.median(ratios):.2f}; a repetition over the first: worst {max(worst):.2f}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
