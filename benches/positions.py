"""Stops at an angle and standstill on virtual machines: `make positions`.

Each machine is recorded as in the README's example, a model identified, a speed loop and a position
loop tuned on it. Then the machine is brought from random speeds to random angles. A stop's error is
how far the true angle rests from the one that was asked for; its turns are compared with the way
that the same machine takes under full reverse from the same state, which nothing can be shorter
than. At the end the loop holds an angle for ten seconds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from moves import recorded
from sewfast import PositionController, VirtualMachine

LOWEST, HIGHEST = 500.0, 4000.0
"""Speeds of the stops [RPM]."""
STANDS = 11.0
"""Time from a stop on of which the last ten seconds are standstill [s]."""


def tuned(machine: VirtualMachine, seed: int, kind: str, kept: Path | None) -> PositionController:
    """The position controller of a machine; taken from a folder if it is there."""
    file = None
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
        file = kept / f"{machine.name.replace(':', '-')}-{seed}-{kind}.json"
    stored = None if file is None else file.with_suffix(".model.json")
    if stored is not None and stored.exists():
        model = sewfast.load_model(stored)
    else:
        model = sewfast.identify(recorded(machine), model=kind, seed=seed)
        if stored is not None:
            model.save(stored)
    if file is not None and file.exists():
        found = sewfast.load_controller(file)
    else:
        result = sewfast.tune(
            model, counts_per_rev=machine.counts_per_rev, loop="position", seed=seed
        )
        print(f"# {machine.name}: {result.position}", flush=True)
        found = result.controller
        if file is not None:
            found.save(file)
    assert isinstance(found, PositionController)
    return found


def reverse_turns(machine: VirtualMachine, run: sewfast.PositionRun) -> float:
    """The turns to rest under the largest command against the motion, from the start of a stop."""
    machine.reset()
    machine.run(run.u[: run.start])
    against = -np.sign(machine.speed_rpm) * machine.parameters["u_limit"]
    way, sign = 0.0, np.sign(machine.speed_rpm)
    before = machine.speed_rpm
    while sign * machine.speed_rpm > 0.0:
        machine.step(against)
        way += 0.5 * (before + max(0.0, sign * machine.speed_rpm) * sign) * machine.Ts / 60.0
        before = machine.speed_rpm
    return abs(way)


def stops(
    machine: VirtualMachine, controller: PositionController, count: int, seed: int
) -> list[dict[str, Any]]:
    """Random stops: error and passing [deg], turns beyond those of full reverse, rest [counts]."""
    random = np.random.default_rng([seed, 7])
    rows = []
    for _ in range(count):
        speed = random.uniform(LOWEST, min(HIGHEST, controller.fastest))
        angle = random.uniform(0.0, 360.0)
        run = sewfast.stop_at(controller, machine, f"{angle}deg", speed=speed)
        m = run.metrics()
        # the true angle, not the count that the encoder rounds it to
        true = run.position[-1] * 360.0 / machine.counts_per_rev - angle
        error = (true + 180.0) % 360.0 - 180.0
        least = reverse_turns(machine, run)
        # the first passage of the angle that full reverse could not have stopped before
        begun = run.position[run.start] / machine.counts_per_rev
        first = np.ceil(begun + least - angle / 360.0) + angle / 360.0 - begun
        assert m["turns"] is not None
        assert m["passed"] is not None
        rows.append(
            {
                "speed": speed, "error": error, "passed": m["passed"], "turns": m["turns"],
                "beyond": m["turns"] - least, "later": m["turns"] - first, "time": m["time"],
                "rest": m["rest_counts"], "rms": m["rms"],
            }
        )  # fmt: skip
    return rows


def standstill(machine: VirtualMachine, controller: PositionController) -> tuple[float, float]:
    """Peak to peak over ten seconds [counts, V]."""
    run = sewfast.stop_at(controller, machine, "90deg", after=STANDS)
    last = round((STANDS - 10.0) / machine.Ts)
    return float(np.ptp(run.counts[run.start + last :])), float(np.ptp(run.u[run.start + last :]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="of model and gains (1)")
    parser.add_argument("--machines", type=int, default=8, help="virtual:1 to :N, too (8)")
    parser.add_argument("--first", type=int, default=0, help="the first of them, 0 for virtual (0)")
    parser.add_argument("--stops", type=int, default=100, help="on each machine (100)")
    parser.add_argument("--model", default="auto", help="kind of the models (auto)")
    parser.add_argument("--kept", type=Path, help="folder for models and controllers")
    args = parser.parse_args()
    names = ["virtual", *(f"virtual:{k}" for k in range(1, args.machines + 1))][args.first :]
    header = ("machine", "seed", "worst [deg]", "median", "passed", "turns beyond", "median",
              "a turn later", "rms [deg]", "still [counts]", "[V]")  # fmt: skip
    print(" | ".join(header))
    worst = [0.0] * 4
    for name in names:
        machine = VirtualMachine.from_name(name)
        for seed in range(args.seeds):
            controller = tuned(machine, seed, args.model, args.kept)
            rows = stops(machine, controller, args.stops, seed)
            column = {key: np.array([row[key] for row in rows], dtype=float) for key in rows[0]}
            errors = np.abs(column["error"])
            still, swing = standstill(machine, controller)
            values = (
                errors.max(), np.median(errors), column["passed"].max(), column["beyond"].max(),
                np.median(column["beyond"]), float(np.sum(column["later"] > 0.5)),
                np.median(column["rms"]), still, swing,
            )  # fmt: skip
            print(" | ".join([name, str(seed), *(f"{v:.3f}" for v in values)]), flush=True)
            found = (values[0], values[2], values[3], still)
            worst = [max(a, b) for a, b in zip(worst, found, strict=True)]
    print(
        f"worst of all: {worst[0]:.3f} deg off, passed by {worst[1]:.3f} deg, "
        f"{worst[2]:.3f} turns beyond full reverse, {worst[3]:g} counts at rest"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
