"""The emulated board beside Python: the same motor and the same controller, sample by sample.

python benches/board.py target/bare/mps2-an386.elf --steps 1000000
python benches/board.py target/bare/mps2-an386.elf --commission pil

The first compares closed loops on the board with the step in single precision in Python around
the same motor: every count and every filtered measurement. The second runs the controller of
`sewfast pil` around that motor in Python and compares its cost with that on the board; then it
commissions the motor in Python.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np

import sewfast
from sewfast.commissioning import SteppedBench
from sewfast.link import connect
from sewfast_deploy.emulated import EmulatedBoard

F = np.float32
COUNTS_PER_REV, GAIN, LAG, FRICTION = F(1572.0), F(490.0), F(0.15), F(0.25)
PERIOD, TO_S = F(1000.0), F(1e-6)
RUN = 50_000
"""Samples of a run."""


class Motor:
    """The motor of examples/firmware/mps2/board.c, in its arithmetic; it shows counts alone."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._speed, self._fraction, self.counts = F(0.0), F(0.0), 0.0

    def step(self, u: float) -> None:
        applied = F(u)
        held = abs(applied) <= FRICTION
        if self._speed != 0.0 or not held:
            against = np.copysign(FRICTION, self._speed if self._speed != 0.0 else applied)
            share = TO_S * PERIOD / LAG
            following = self._speed + share * (GAIN * (applied - against) - self._speed)
            self._speed = F(0.0) if held and following * self._speed <= 0.0 else following
        self._fraction += self._speed * COUNTS_PER_REV * (TO_S * PERIOD / F(60.0))
        whole = np.floor(self._fraction)
        self.counts += float(whole)
        self._fraction -= whole


def controller() -> sewfast.Controller:
    """With everything but a schedule."""
    return sewfast.Controller(
        sewfast.Gains.standard(Kp=0.02, Ti=0.1, Td=0.002), alpha=0.4, N=10, u_min=-10, u_max=10,
        slew=4000, filter_samples=8, observer_time=0.003, r_rate=20_000,
        biquads=(sewfast.Biquad.notch(60.0), sewfast.Biquad.low_pass(200.0)),
    )  # fmt: skip


def replayed(
    run: sewfast.control.machine.RecordedRun, r: np.ndarray, motor: Motor
) -> tuple[int, int]:
    """Samples whose counts, and whose filtered measurement, differ from those in Python."""
    core, start = controller().core().single(), motor.counts
    counts, feedback = np.zeros(len(r)), np.zeros(len(r))
    per_unit = F(0.001) * F(COUNTS_PER_REV / 60.0)
    before = motor.counts
    for k, reference in enumerate(r.tolist()):
        counts[k] = motor.counts - start
        u = F(core.step(reference, float(F(motor.counts - before) / per_unit)))
        feedback[k], before = core.filtered, motor.counts
        # the device applies what it records: whole millivolts
        motor.step(float(np.trunc(u * F(1000.0) + np.copysign(F(0.5), u)) / F(1000.0)))
    for _ in range(2000):
        motor.step(0.0)  # the board's turns on as well, to rest
    found = run.recording.counts - run.recording.counts[0]
    return int(np.sum(found != counts)), int(np.sum(run.feedback != feedback))


def compare(firmware: Path, steps: int) -> int:
    rng, wrong, motor = np.random.default_rng(0), np.zeros(2, dtype=int), Motor()
    runs = math.ceil(steps / RUN)
    with EmulatedBoard(firmware, boot_id=1) as board, connect(board.port) as drive:
        drive.set_limits(volt=10, speed_rpm=8000, acceleration=90_000, current=float("inf"))
        for k in range(runs):
            levels = rng.uniform(-3000.0, 3000.0, RUN // 500)
            r = np.repeat(levels, 500).astype(np.float32).astype(np.float64)
            r[-1500:] = 0.0
            wrong += replayed(sewfast.run(controller(), drive, r), r, motor)
            differ = f"{wrong[0]} counts and {wrong[1]} filtered measurements differ"
            print(f"{(k + 1) * RUN:,} steps: {differ}", flush=True)
        print(board.figures())
    return int(wrong.any())


def commission(folder: Path, seeds: int) -> int:
    bench = SteppedBench(Motor(), 0.001, float(COUNTS_PER_REV), 10.0, "the motor", 8000.0)
    tuned = sewfast.load_controller(folder / "commission" / "controllers" / "tuned.json")
    weight = json.loads((folder / "commission" / "commissioning.json").read_text())["cost"][
        "chatter"
    ]
    board, here = [], []

    def cost(r: np.ndarray, y: np.ndarray, u: np.ndarray) -> float:
        """Tracking and chatter; the reference is followed without overshoot."""
        return float(np.sqrt(np.mean((r - y) ** 2)) + weight * np.sqrt(np.mean(np.diff(u) ** 2)))

    for file in sorted((folder / "commission" / "runs").glob("*_measured.npz")):
        run = np.load(file)
        own = sewfast.run(tuned, bench, run["r"])
        board.append(cost(run["r"], run["y"], run["u"]))
        here.append(cost(run["r"], own.y, own.u))
    ratio = np.mean(board) / np.mean(here)
    print(f"its controller: {np.mean(board):.3f} RPM on the board, {np.mean(here):.3f} in Python, "
          f"ratio {ratio:.4f}")  # fmt: skip
    for seed in range(seeds):
        found = sewfast.commission(bench, members=2, evaluations=500, seed=seed).numbers()
        print(f"commissioned in Python, seed {seed}: {found['verdict']}, "
              f"{found['measured_cost']:.3f} RPM", flush=True)  # fmt: skip
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("firmware", type=Path)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--commission", type=Path, metavar="DIR", help="what `sewfast pil` left")
    parser.add_argument("--seeds", type=int, default=5, help="of commissioning in Python")
    args = parser.parse_args()
    return (
        commission(args.commission, args.seeds)
        if args.commission
        else compare(args.firmware, args.steps)
    )


if __name__ == "__main__":
    sys.exit(main())
