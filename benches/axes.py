"""Following positions on 20 axes of MuJoCo, beside LinuxCNC's autotuned `pid`: `make axes`.

Four axes of each kind: friction alone, a gear with a heavy load, an unbalanced arm, play between
motor and load, and a load on a spring. Each is recorded by its command and its encoder, a model
identified, and a position loop tuned on it. Both controllers then follow the same S-curves, which
neither was tuned on. LinuxCNC's gains come from its own relay test, FF1 and FF2 from the recording,
as its manual has it. Of smaller gains, a grid of them, those are taken that follow best with
neither a larger Ms nor more change of the command than ours, and, alone, with no larger Ms.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sewfast
from mujoco_motors import Motor, MujocoMotor, drawn, recorded
from rivals.linuxcnc import LinuxCncPid, autotuned, is_installed
from sewfast import PositionController
from sewfast.commissioning import SteppedBench
from sewfast.control.margins import sampled
from sewfast.errors import SewfastError

KINDS = ("friction", "gear", "arm", "play", "spring")
EACH, TS = 4, 1e-3
REST, STANDS = 0.3, 1.0
"""Before the first move, and after each [s]."""
MOVES = ((2.0, 0.6), (-0.5, 0.3), (6.0, 0.9), (-7.5, 0.5))
"""Turns, and the speed as a part of the largest known one."""
LEVELS = (0.25, 0.5, 0.75)
"""Speeds at which LinuxCNC's Ms is taken, as parts of the largest known one."""
SOFTER = tuple(0.75**k for k in range(16))
SLOWER, DAMPED = (1.0, 0.25, 0.06, 0.0), (0.5, 1.0, 2.0)
"""Factors on LinuxCNC's gains: on all, further on I, further on D."""
Array = NDArray[np.float64]


class Axis(MujocoMotor):
    """A motor of MuJoCo whose load hangs behind play or a spring; the encoder is the motor's."""

    def __init__(self, motor: Motor, kind: str, seed: int) -> None:
        random = np.random.default_rng([seed, 31])
        xml = motor.xml()
        if kind in ("play", "spring"):
            apart = math.radians(random.uniform(0.2, 1.0)) * (kind == "play")
            rate = 2.0 * math.pi * random.uniform(30.0, 80.0)
            own = motor.rotor * motor.gear**2
            shared = motor.load * own / (motor.load + own)
            joint = (
                f'range="-{apart / 2} {apart / 2}" limited="true" solreflimit="0.004 1"'
                if kind == "play"
                else f'stiffness="{shared * rate**2}" damping="{0.1 * shared * rate}"'
            )
            load, rest = motor.load, 0.02 * motor.load
            xml = xml.replace(
                "</body></worldbody>",
                f'<body><joint type="hinge" axis="0 1 0" {joint}/><inertial pos="0 0 0" '
                f'mass="1e-3" diaginertia="{load} {load} {load}"/></body></body></worldbody>',
            ).replace(f'diaginertia="{motor.load} {motor.load} {motor.load}"',
                      f'diaginertia="{rest} {rest} {rest}"')  # fmt: skip
        super().__init__(xml, motor.counts, motor.gear)

    def played(self, decide: Any, r: Array) -> tuple[Array, Array]:
        """True positions [counts] and commands of a loop, from rest."""
        self.reset()
        true, u = np.zeros(len(r)), np.zeros(len(r))
        for k, goal in enumerate(r.tolist()):
            true[k] = self.data.qpos[0] * self.per_radian
            u[k] = decide(goal, self.counts)
            self.step(u[k])
        return true, u


def axis(number: int, seed: int) -> tuple[Motor, str]:
    """The motor of an axis and its kind."""
    kind = KINDS[number // EACH]
    found = 0
    while True:
        motor = drawn(100 * number + found, seed)
        if {"arm": motor.unbalance > 0.0, "gear": motor.gear > 1.0}.get(kind, True) and (
            kind == "arm" or motor.unbalance == 0.0
        ):
            return motor, kind
        found += 1


def s_curves(controller: PositionController, turn: float) -> Array:
    """Goals [counts]: moves at half of the drive's rates, with a jerk of theirs in 40 ms."""
    rate = 0.5 * min(min(up, down) for _, up, down in controller.rows())
    pieces, at = [np.zeros(round(REST / TS))], 0.0
    for turns, share in MOVES:
        way, top = abs(turns) * turn, share * controller.fastest * controller.counts_per_unit
        steepest = rate * controller.counts_per_unit
        top = min(top, math.sqrt(way * steepest))
        ramp, hold = top / steepest, way / top - top / steepest
        t = np.arange(round((2 * ramp + max(hold, 0.0)) / TS) + 2) * TS
        speed = np.clip(np.minimum(t, t[-1] - t) * steepest, 0.0, top)
        speed = np.convolve(speed, np.full(40, 1.0 / 40.0))
        moved = np.cumsum(speed) * (way / np.sum(speed))
        pieces.append(at + math.copysign(1.0, turns) * moved)
        at = pieces[-1][-1]
        pieces.append(np.full(round(STANDS / TS), at))
    return np.concatenate(pieces)


def largest_sensitivity(gains: dict[str, float], plants: list[tuple[Array, Array]]) -> float:
    """Ms of LinuxCNC's loop, from its gains on counts and plants from command to counts [Ts]."""
    z = np.exp(-1j * np.geomspace(1e-3, math.pi, 4000))
    law = gains["Pgain"] + gains["Igain"] * TS / (1 - z) + gains["Dgain"] * (1 - z) / TS
    peaks = []
    for num, den in plants:
        plant = np.polyval(num[::-1], z) / np.polyval(den[::-1], z) / (1 - z)
        path = law * plant
        # crossings of the negative axis beyond -1 make the loop unstable whatever |S| is
        turned = np.unwrap(np.angle(1.0 + path))
        unstable = abs(turned[-1] - turned[0]) > 0.75 * math.pi * 2
        peaks.append(math.inf if unstable else float(np.max(np.abs(1.0 / (1.0 + path)))))
    return max(peaks)


def feedforward(data: sewfast.Dataset, per_unit: float) -> dict[str, float]:
    """FF1 [V s/count] and FF2 from the recording, with dry friction beside them."""
    rows, commands = [], []
    for one in data.experiments:
        y = np.convolve(one.y.ravel(), np.full(9, 1.0 / 9.0), "same") * per_unit
        a = np.gradient(y, TS)
        kept = slice(20, -20)
        rows.append(
            np.column_stack([y, a, np.sign(y) * (np.abs(y) > 0.02 * np.max(np.abs(y)))])[kept]
        )
        commands.append(one.u.ravel()[kept])
    found, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(commands), rcond=None)
    return {"FF1": float(found[0]), "FF2": float(found[1])}


@dataclass(frozen=True)
class Figures:
    """Of one axis: true following error and change of the command, rms [counts, V]; Ms."""

    axis: str
    ours: float
    ours_largest: float
    ours_effort: float
    ours_Ms: float
    still: float
    rival: float | None
    rival_effort: float | None
    rival_Ms: float | None
    rival_as_tuned: float | None
    rival_as_tuned_Ms: float | None
    rival_livelier: float | None
    cpu: float
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """Our error over the rival's; of one that needs more change of the command for its Ms, at
        that.
        """
        rival = self.rival_livelier if self.rival is None else self.rival
        return None if rival is None else self.ours / rival


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def figures(number: int, seed: int, model_kind: str) -> Figures:
    """Identify, tune and follow, then the rival on the same axis."""
    motor, kind = axis(number, seed)
    name = f"{kind} {number}"
    machine = Axis(motor, kind, 100 * seed + number)
    bench = SteppedBench(machine, Ts=TS, counts_per_rev=motor.counts, volt=motor.volt, name=name)
    began = time.process_time()
    data = recorded(bench)
    model = sewfast.identify(data, model=model_kind, seed=seed)
    tuned = sewfast.tune(model, counts_per_rev=motor.counts, loop="position", seed=seed)
    cpu = time.process_time() - began
    law = tuned.controller
    assert isinstance(law, PositionController)
    r = s_curves(law, motor.counts)
    run = sewfast.follow_positions(law, bench, r, unit="counts")
    # the same commands again, for the true position
    commands = iter(run.u.tolist())
    true, u = machine.played(lambda _goal, _counts: next(commands), r)
    begun = round(REST / TS)
    ours, effort = rms((true - r)[begun:]), rms(np.diff(u))
    still = float(np.ptp(run.counts[-round(0.5 * STANDS / TS) :]))
    Ms = tuned.position.Ms
    common = (name, ours, float(np.max(np.abs(true - r))), effort, Ms, still)
    if not is_installed():
        return Figures(*common, *[None] * 6, cpu=cpu, note="LinuxCNC is not installed")

    machine.reset()

    def relay(u: float) -> float:
        machine.step(u)
        return machine.counts

    gains = None
    for part in (0.3, 0.5, 0.8):
        machine.reset()
        try:
            gains = autotuned(relay, TS, motor.volt, effort=part * motor.volt)
            break
        except RuntimeError as error:
            note = str(error)
    if gains is None:
        return Figures(*common, *[None] * 6, cpu=cpu, note=note)
    per_sample = law.counts_per_unit * TS
    plants = []
    for one in model.members or (model,):
        for level in LEVELS:
            num, den = sampled(one, TS, level * law.fastest)
            plants.append((num * per_sample, den))
    forward = feedforward(data, law.counts_per_unit)

    def followed(own: dict[str, float]) -> tuple[float, float]:
        pid = LinuxCncPid(TS, motor.volt, **own, **forward)
        true, u = machine.played(pid.step, r)
        return rms((true - r)[begun:]), rms(np.diff(u))

    best: tuple[float, float, float] | None = None
    livelier = math.inf
    for softer, slower, damped in itertools.product(SOFTER, SLOWER, DAMPED):
        own = {
            "Pgain": softer * gains["Pgain"],
            "Igain": softer * slower * gains["Igain"],
            "Dgain": softer * damped * gains["Dgain"],
        }
        peak = largest_sensitivity(own, plants)
        if peak <= Ms:
            error, strain = followed(own)
            livelier = min(livelier, error)
            if strain <= 1.05 * effort and (best is None or error < best[0]):
                best = (error, strain, peak)
    return Figures(
        *common, *(best or (None, None, None)), rival_as_tuned=followed(gains)[0],
        rival_as_tuned_Ms=largest_sensitivity(gains, plants), cpu=cpu,
        rival_livelier=livelier if math.isfinite(livelier) else None,
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of axes (0 to 19)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", default="grey_box", help="kind of the models (grey_box)")
    parser.add_argument("-o", "--out", type=Path, help="JSON of all figures")
    args = parser.parse_args()
    print("axis | ours [counts] | largest | V/sample | Ms | still | LinuxCNC | V/sample | Ms | "
          "as tuned | Ms | Ms alone | ratio")  # fmt: skip
    rows = []
    for number in args.only if args.only is not None else range(EACH * len(KINDS)):
        try:
            one = figures(number, args.seed, args.model)
        except SewfastError as error:
            print(f"axis {number} | refused: {error}", flush=True)
            continue
        rows.append(one)
        values = (
            one.ours, one.ours_largest, one.ours_effort, one.ours_Ms, one.still, one.rival,
            one.rival_effort, one.rival_Ms, one.rival_as_tuned, one.rival_as_tuned_Ms,
            one.rival_livelier, one.ratio,
        )  # fmt: skip
        shown = ("-" if v is None else f"{v:.3g}" for v in values)
        print(" | ".join([one.axis, *shown]), one.note, f"({one.cpu:.0f} s)", flush=True)
    ratios = [one.ratio for one in rows if one.ratio is not None]
    if ratios:
        print(f"our error over LinuxCNC's: median {statistics.median(ratios):.2f}, worst "
              f"{max(ratios):.2f} of {len(ratios)}")  # fmt: skip
    if args.out:
        args.out.write_text(json.dumps([asdict(one) for one in rows], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
