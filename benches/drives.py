"""Drives that sewfast was not made with: a simulator of its own, for figures of commissioning.

Motor with inverter and current limit, friction with a Stribeck effect, a load over the turn, a
shaft between motor and load, an encoder on the motor. Nothing here is shared with the package's
virtual machine. `FAMILY` has one machine for each thing that differs from drive to drive, `drawn`
others with several differences at once.

    python benches/drives.py                    one commissioning on each, with its figures
    python benches/drives.py --only shaft60     one of them
    python benches/drives.py --oracle 200       beside gains tuned on the drive itself
    python benches/drives.py --changed          and on the drive as it is later: CHANGES
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sewfast import Commissioning, commission
from sewfast.commissioning import Refusal, SteppedBench
from sewfast.tuning.task import GAINS

try:
    from numba import njit
except ImportError:  # the same arithmetic, a hundred times slower

    def njit(**_: object) -> Callable[[Any], Any]:
        return lambda function: function


SUBSTEPS = 20
"""Of the integration in a sample: 50 us."""


@dataclass(frozen=True)
class Drive:
    """Parameters in SI units; the command is in volts of a +-10 V interface.

    Attributes
    ----------
    gain : float
        Motor voltage per command [V/V].
    resistance, inductance, constant, current : float
        Of the motor [ohm, H, N m/A]; the drive's current limit [A].
    inertia, coulomb, stribeck, viscous : float
        [kg m^2, N m, N m, N m s].
    once, twice : float
        Load torque once and twice a turn [N m].
    sag : float
        Resistance of the supply, on the motor's side [ohm].
    share, shaft, damping, lash : float
        Part of the inertia behind the shaft, frequency of motor against load [Hz], its damping
        ratio, play [rad]; a share of 0 is a stiff machine.
    counts : float
        Encoder counts of a turn.
    late, old : int
        Samples until a command acts; age of the counts [samples].
    """

    name: str
    gain: float = 15.0
    resistance: float = 8.0
    inductance: float = 0.03
    constant: float = 0.28
    current: float = 5.0
    inertia: float = 0.002
    coulomb: float = 0.1
    stribeck: float = 0.05
    viscous: float = 3e-4
    once: float = 0.08
    twice: float = 0.03
    sag: float = 0.0
    share: float = 0.0
    shaft: float = 0.0
    damping: float = 0.02
    lash: float = 0.0
    counts: float = 1572.0
    late: int = 0
    old: int = 0
    u_limit: float = 20.0
    Ts: float = 1e-3

    def vector(self) -> np.ndarray:
        """What the integration takes."""
        motor, load = self.inertia * (1.0 - self.share), self.inertia * self.share
        stiffness = damping = 0.0
        if self.share > 0.0:
            omega = 2.0 * math.pi * self.shaft
            reduced = motor * load / (motor + load)
            stiffness, damping = reduced * omega**2, 2.0 * self.damping * omega * reduced
        return np.array([
            self.gain, self.resistance, self.inductance, self.constant, self.current, motor, load,
            stiffness, damping, self.lash, self.coulomb, self.stribeck, self.viscous, self.once,
            self.twice, self.sag, self.Ts / SUBSTEPS,
        ])  # fmt: skip


BASE = Drive("nominal")
FAMILY = (
    BASE,
    replace(BASE, name="light", inertia=0.0007),
    replace(BASE, name="heavy", inertia=0.006),
    replace(BASE, name="sticky", coulomb=0.3, stribeck=0.15),
    replace(BASE, name="late2", late=2),
    replace(BASE, name="enc256", counts=256.0),
    replace(BASE, name="enc8192", counts=8192.0),
    replace(BASE, name="weak", current=2.5, coulomb=0.2),
    replace(BASE, name="knocking", once=0.6),
    replace(BASE, name="sag", sag=60.0),
    replace(BASE, name="old3", old=3),
    replace(BASE, name="slow10", inertia=0.02, current=5.0),
    replace(BASE, name="fast02", inertia=0.0004),
    replace(BASE, name="shaft60", share=0.6, shaft=60.0),
    replace(BASE, name="shaft40", share=0.6, shaft=40.0),
    replace(BASE, name="shaft110", share=0.4, shaft=110.0),
    replace(BASE, name="lash", share=0.6, shaft=80.0, damping=0.1, lash=math.radians(2.0)),
)


def drawn(seed: int) -> Drive:
    """A stiff machine with several differences at once."""
    rng = np.random.default_rng(seed)

    def factor(spread: float) -> float:
        return float(np.exp(rng.uniform(-1.0, 1.0) * math.log(spread)))

    return Drive(
        f"drawn{seed}", inertia=0.002 * factor(3.0), coulomb=0.1 * factor(2.5),
        stribeck=0.05 * factor(2.0), current=5.0 * factor(1.5), once=0.08 * factor(3.0),
        resistance=8.0 * factor(1.4), late=int(rng.integers(0, 3)),
        counts=float(rng.choice([512, 1572, 4096])), sag=float(rng.uniform(0.0, 4.0)),
    )  # fmt: skip


@njit(cache=True)
def advance(state, p, volt, steps):  # type: ignore[no-untyped-def]
    """Current, motor speed, motor angle, load speed, load angle after so many steps."""
    i, w, a, v, b = state
    (gain, R, L, k, most, J, Jl, c, d, lash, coulomb, stribeck, viscous, once, twice, sag, h) = p
    for _ in range(steps):
        supply = max(0.0, 310.0 - sag * abs(i))
        e = min(max(gain * volt, -supply), supply)
        i = (i + h / L * (e - k * w)) / (1.0 + h * R / L)
        i = min(max(i, -most), most)
        speed = v if Jl > 0.0 else w
        angle = b if Jl > 0.0 else a
        # regularised within 1 rad/s: a stiff sign would ask for events
        friction = (coulomb + stribeck * math.exp(-((speed / 10.0) ** 2))) * math.tanh(speed / 0.5)
        load = friction + viscous * speed + once * math.sin(angle) + twice * math.sin(2.0 * angle)
        if Jl > 0.0:
            gap = a - b
            if lash > 0.0:
                half = 0.5 * lash
                gap = gap - half if gap > half else gap + half if gap < -half else 0.0
            inside = lash == 0.0 or gap != 0.0
            shaft = c * gap + (d * (w - v) if inside else 0.0)
            w += h / J * (k * i - shaft)
            v += h / Jl * (shaft - load)
            b += h * v
        else:
            w += h / J * (k * i - load)
        a += h * w
    return i, w, a, v, b


@dataclass
class Simulator:
    """One drive, sample by sample."""

    drive: Drive
    railed: int = 0
    samples: int = 0
    _state: tuple[float, ...] = field(default=(0.0,) * 5)

    def __post_init__(self) -> None:
        self._p = self.drive.vector()
        self.reset()

    def reset(self) -> None:
        """To rest, at angle 0."""
        self._state = (0.0,) * 5
        self._pending = [0.0] * self.drive.late
        self._seen = [0.0] * (self.drive.old + 1)

    @property
    def counts(self) -> float:
        """What the encoder shows now."""
        return self._seen[0]

    @property
    def speed_rpm(self) -> float:
        """True speed of the motor [RPM]."""
        return self._state[1] * 30.0 / math.pi

    def step(self, u: float) -> None:
        """Hold a command for one sample."""
        self.samples += 1
        self.railed += abs(u) >= self.drive.u_limit * 0.999
        self._pending.append(u)
        self._state = advance(self._state, self._p, self._pending.pop(0), SUBSTEPS)
        turns = self._state[2] / (2.0 * math.pi)
        self._seen = [*self._seen[1:], math.floor(turns * self.drive.counts + 0.5)]


def bench_of(simulator: Simulator) -> SteppedBench:
    """The machine as `commission` takes it."""
    drive = simulator.drive
    return SteppedBench(
        simulator, name=drive.name, Ts=drive.Ts, counts_per_rev=drive.counts, volt=drive.u_limit
    )


CHANGES: dict[str, Callable[[Drive], Drive]] = {
    "inertia x .8": lambda d: replace(d, inertia=0.8 * d.inertia),
    "inertia x 1.25": lambda d: replace(d, inertia=1.25 * d.inertia),
    "gain x .8": lambda d: replace(d, gain=0.8 * d.gain),
    "gain x 1.25": lambda d: replace(d, gain=1.25 * d.gain),
    "2 ms later": lambda d: replace(d, late=d.late + round(2e-3 / d.Ts)),
    **{
        f"resonance {100 * s - 100:+.0f} %": lambda d, s=s: replace(d, shaft=s * d.shaft)
        for s in (0.9, 0.95, 0.97, 1.03, 1.05, 1.1)
    },
}
"""What a machine is some time after its commissioning."""


def after_changes(found: Commissioning, drive: Drive) -> tuple[float, str]:
    """The error over that of the drive as it was commissioned, rms; the worst of `CHANGES`.

    On the standard references at a pace that the least gain reaches.
    """
    from oracle import driven, practised

    controller = found.controller
    references = practised(bench_of(Simulator(drive)), found, 0, min(GAINS)).values()

    def error(drive: Drive) -> float:
        runs = [driven(bench_of(Simulator(drive)), controller, r, "changed") for r in references]
        return math.sqrt(float(np.mean(np.concatenate([(run.r - run.y) ** 2 for run in runs]))))

    own = error(drive)
    changed = {name: change(drive) for name, change in CHANGES.items()}
    ratios = {name: error(d) / own for name, d in changed.items() if d != drive}
    worst = max(ratios, key=lambda name: ratios[name])
    return ratios[worst], worst


# --- figures --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Figures:
    """What came of one commissioning."""

    machine: str
    seed: int
    verdict: str
    stage: str
    reason: str
    predicted: float | None
    measured: float | None
    oracle: float | None
    railed: float
    moved: float
    cpu: float
    changed: float | None = None
    worst: str = ""


def figures(
    drive: Drive, seed: int, evaluations: int = 0, *, changes: bool = False, **settings: Any
) -> Figures:
    """Commission one machine; `railed` is the time at a limit of the command in all [s].

    `evaluations` are the oracle's; 0 for none.
    """
    simulator = Simulator(drive)
    used = time.process_time()
    stage, reason, best = "", "", None
    try:
        found = commission(bench_of(simulator), seed=seed, **settings)
        verdict = found.verdict
    except Refusal as refusal:
        if refusal.so_far is None:
            raise
        found, verdict, stage, reason = refusal.so_far, "refused", refusal.stage, str(refusal)
    used = time.process_time() - used
    railed, moved = simulator.railed * drive.Ts, simulator.samples * drive.Ts
    if evaluations and found.measured_cost is not None:
        from oracle import oracle

        best = oracle(bench_of(simulator), found, seed=seed, evaluations=evaluations).cost
    later = after_changes(found, drive) if changes and found.measured_cost is not None else ()
    return Figures(
        drive.name, seed, verdict, stage, reason, found.predicted_cost, found.measured_cost, best,
        railed, moved, used, *later,
    )  # fmt: skip


def line(f: Figures) -> str:
    """For progress."""
    costs = " ".join(
        f"{'-' if c is None else f'{c:.2f}':>8}" for c in (f.predicted, f.measured, f.oracle)
    )
    return (
        f"{f.machine:12}{f.seed:3} {f.verdict:9}{costs}  railed {f.railed:6.2f} s of "
        f"{f.moved:6.1f}  cpu {f.cpu:6.1f}  {f.stage} {f.reason[:150]}"
        + (f"{f.changed:6.2f} times with {f.worst}" if f.changed is not None else "")
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", help="machines by name, drawnN among them")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--oracle", type=int, default=0, help="evaluations of an oracle")
    parser.add_argument("--changed", action="store_true", help="on changed drives, too")
    parser.add_argument("-o", dest="out", type=Path, help="JSON to write, and to go on from")
    args = parser.parse_args()
    named = {d.name: d for d in FAMILY}
    wanted = args.only or list(named)
    drives = [named[n] if n in named else drawn(int(n.removeprefix("drawn"))) for n in wanted]
    kept = args.out is not None and args.out.exists()
    found = [Figures(**f) for f in json.loads(args.out.read_text())] if kept else []
    done = {(f.machine, f.seed) for f in found}
    for seed, drive in itertools.product(range(args.seeds), drives):
        if (drive.name, seed) in done:
            continue
        found.append(figures(drive, seed, args.oracle, changes=args.changed))
        print(line(found[-1]), flush=True)
        if args.out is not None:  # after each, as a family takes an hour
            args.out.write_text(json.dumps([vars(f) for f in found], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
