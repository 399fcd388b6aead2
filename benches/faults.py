"""Machines that are not what they were thought to be: `commission` on each of 30 faults.

For each seed a drive is drawn that commissioning was not made with (`drives.drawn`). One fault is
put into it, from the start or from a time in one run of the commissioning on. The commissioning
must end without calling the machine verified, name the cause, and command rest before the machine
is much faster than its owner said. `--healthy` puts nothing into them: no cause may be named then.

    python benches/faults.py --seeds 20 --jobs 2 --out faults.json
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import sewfast
from drives import FAMILY, Drive, Simulator, drawn
from sewfast.commissioning import SteppedBench
from sewfast.errors import SewfastError

VOLT, SPEED, STATED = 20.0, 1500.0, 2400.0
"""Largest command [V], top of the working range and speed that must not be passed [RPM]."""


class Motor(Simulator):
    """A drive with whatever is wrong with it, from the beginning or from a time in a run on.

    ``command`` and ``encoder`` are factors, ``stuck``, ``load``, ``dead`` and ``holds`` belong to
    the command [V], ``jump`` and ``bits`` to the counter, ``delay`` is in seconds, the others are
    parameters of the drive.
    """

    def __init__(self, drive: Drive, wrong: dict[str, float], run: str, at: float) -> None:
        self.wrong, self.begins_in, self.begins_at = wrong, run, at
        self.run, self.has_begun, self.total, self.fastest = "", not run, 0.0, 0.0
        self.passed: float | None = None
        self.at_rest: float | None = None
        self.held: float | None = None
        self.jumped = False
        super().__init__(drive)
        if self.has_begun:
            self._change()

    def _change(self) -> None:
        known = {f.name for f in fields(Drive)}
        self._p = replace(
            self.drive, **{k: v for k, v in self.wrong.items() if k in known}
        ).vector()

    def reset(self) -> None:
        super().reset()
        self.t = self.counted = self.before = 0.0
        self.sent = [0.0] * 400

    def now(self, name: str, healthy: float) -> float:
        """A number of the fault, once it has begun."""
        return self.wrong.get(name, healthy) if self.has_begun else healthy

    @property
    def counts(self) -> float:
        counted = math.floor(self.counted)
        bits = int(self.now("bits", 0))
        if bits:
            counted = (counted + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
        return float(counted)

    def step(self, u: float) -> None:
        self._watch(u)
        if not self.has_begun and self.run == self.begins_in and self.t >= self.begins_at:
            self.has_begun = True
            self._change()
            self.counted += self.wrong.get("jump", 0.0)
        self.sent.append(u)
        u = self.sent[-1 - round(self.now("delay", 0.0) / self.drive.Ts)]
        u = math.copysign(max(0.0, abs(u) - self.now("dead", 0.0)), u) * self.now("command", 1.0)
        if self.now("holds", 0.0):
            self.held = u if self.held is None else self.held
            u = self.held
        super().step(self.now("stuck", u) + self.now("load", 0.0))
        self.counted += self.now("encoder", 1.0) * (super().counts - self.before)
        self.before = super().counts
        self.t += self.drive.Ts
        self.total += self.drive.Ts

    def _watch(self, u: float) -> None:
        """When the stated speed was passed, and when rest was commanded after it."""
        self.fastest = max(self.fastest, abs(self.speed_rpm))
        if abs(self.speed_rpm) > STATED and self.passed is None:
            self.passed = self.total
        if self.passed is not None and self.at_rest is None and u == 0.0:
            self.at_rest = self.total


@dataclass(frozen=True, eq=False)
class Bench(SteppedBench):
    """Tells the motor which run it is."""

    def excite(self, u: Any, name: str) -> Any:
        assert isinstance(self.machine, Motor)
        self.machine.run = name
        return super().excite(u, name)

    def follow(self, controller: Any, r: Any, name: str, *, watch: Any = None) -> Any:
        assert isinstance(self.machine, Motor)
        self.machine.run = name
        return super().follow(controller, r, name, watch=watch)


@dataclass(frozen=True)
class Fault:
    """What is wrong, in which run, and the causes that name it rightly."""

    name: str
    wrong: dict[str, float]
    causes: tuple[str, ...]
    run: str = ""
    at: float = 0.0
    may_verify: bool = False


FREE = {
    "constant": 0.005, "inertia": 1e-4, "coulomb": 5e-4, "stribeck": 0.0, "viscous": 0.0,
    "once": 0.0, "twice": 0.0,
}  # fmt: skip
"""A motor whose speed is the integral of its command."""
# seen from rest, the signs of command and encoder are one, as are a dead encoder and stage
SIGNS, LOST = ("sign", "command sign", "encoder sign"), ("no motion", "encoder lost", "stage off")
LOOP, EXCITED, LAST = "trapezoids", "pulses", "trapezoid"
FAULTS = (
    Fault("sign turned", {"command": -1.0}, SIGNS),
    Fault("encoder dead", {"encoder": 0.0}, LOST),
    Fault("stage off", {"command": 0.0}, ("no motion", "stage off")),
    Fault("turns at 0 V", {"load": 1.0}, ("turns at rest",), may_verify=True),
    Fault("integrates", FREE, ("integrates",)),
    Fault("supply is 5 times as high", {"command": 5.0}, ("gain",), LOOP, 0.7),
    Fault("dead band of 40 %", {"dead": 0.4 * VOLT}, ("dead zone", "friction")),
    Fault("stuck stage", {"stuck": 3.0}, ("turns at rest", "stage stuck", "load")),
    Fault("counter of 16 bits wraps", {"bits": 16}, ("counts jumped",)),
    Fault("tenth of the gain", {"command": 0.1}, ("gain", "out of reach")),
    Fault("command turns", {"command": -1.0}, ("command sign",), LOOP, 0.7),
    Fault("encoder turns", {"encoder": -1.0}, ("encoder sign",), LOOP, 0.7),
    Fault("encoder freezes", {"encoder": 0.0}, ("encoder lost",), LOOP, 0.7),
    Fault("encoder loses a channel", {"encoder": 0.5}, ("counts scaled",), LOOP, 0.7),
    Fault("counts jump", {"jump": 30000.0}, ("counts jumped",), LOOP, 0.7),
    Fault("stage sticks", {"holds": 1.0}, ("stage stuck",), LOOP, 0.7),
    Fault("stage sticks at full", {"stuck": VOLT}, ("stage stuck",), LOOP, 0.7),
    Fault("stage fails", {"command": 0.0}, ("stage off",), LOOP, 0.7),
    Fault("command turns in pulses", {"command": -1.0}, SIGNS, EXCITED, 0.1),
    Fault("encoder freezes in pulses", {"encoder": 0.0}, LOST, EXCITED, 0.1),
    Fault("stage sticks in pulses", {"stuck": VOLT}, ("stage stuck",), EXCITED, 0.1),
    Fault("command turns at last", {"command": -1.0}, ("command sign",), LAST, 0.5),
    Fault("encoder turns at last", {"encoder": -1.0}, ("encoder sign",), LAST, 0.5),
    Fault("encoder freezes at last", {"encoder": 0.0}, ("encoder lost",), LAST, 0.5),
    Fault("stage sticks at last", {"holds": 1.0}, ("stage stuck",), LAST, 0.5),
    Fault("supply falls to a third", {"command": 0.33}, ("gain",), LAST, 0.5, True),
    Fault("brake comes on", {"coulomb": 1.0}, ("friction", "load", "gain"), LAST, 0.5, True),
    Fault("load drives", {"load": 2.0}, ("load",), LAST, 0.5, True),
    Fault("delay of 30 ms", {"delay": 0.03}, ("delay",), LAST, 0.3, True),
    Fault("four times the inertia", {"inertia": 0.01}, ("inertia",), LAST, 0.3, True),
)  # fmt: skip


HEALTHY = Fault("healthy", {}, (), may_verify=True)


def tried(case: tuple[Fault, Drive, int]) -> dict[str, Any]:
    """One commissioning of one machine with one fault."""
    fault, drive, seed = case
    motor = Motor(drive, fault.wrong, fault.run, fault.at)
    bench = Bench(motor, drive.Ts, drive.counts, VOLT, drive.name, STATED)
    began = time.process_time()
    try:
        found = sewfast.commission(
            bench, speed=SPEED, members=1, evaluations=100, threads=1, seed=seed
        )
        verdict, text, cause = found.verdict, found.reason, found.cause
    except SewfastError as error:
        verdict, text, cause = type(error).__name__, str(error), error.cause
    late = None
    if motor.passed is not None:
        late = (motor.at_rest if motor.at_rest is not None else math.inf) - motor.passed
    named, verified = cause.name if cause else "", verdict.startswith("verified")
    return {
        "fault": fault.name, "machine": drive.name, "seed": seed, "verdict": verdict,
        "cause": named, "text": text, "late": late, "over": motor.fastest / STATED,
        "is_right": named in fault.causes or (not named and verified and fault.may_verify),
        "is_false": verified and not fault.may_verify, "advises": "raise" in text,
        "seconds": time.process_time() - began,
    }  # fmt: skip


def cases(seeds: range, only: str, *, healthy: bool) -> Iterator[tuple[Fault, Drive, int]]:
    if healthy:
        drives = [*FAMILY, *map(drawn, seeds)]
        yield from ((HEALTHY, drive, seed) for drive in drives for seed in range(2))
        return
    for fault in FAULTS:
        if only in fault.name:
            yield from ((fault, drawn(seed), seed) for seed in seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="part of a fault's name")
    parser.add_argument("--healthy", action="store_true", help="machines without a fault")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.seeds)
    with ProcessPoolExecutor(args.jobs) as pool:
        found = []
        for f in pool.map(tried, cases(seeds, args.only, healthy=args.healthy)):
            found.append(f)
            print(
                f"{f['fault']:28s}{f['machine']:10s} {f['verdict']}: {f['cause']}", file=sys.stderr
            )
    print(f"{'fault':28s} right  not named  wrong  false verified  latest [s]  over speed")
    for fault in (HEALTHY, *FAULTS):
        its = [f for f in found if f["fault"] == fault.name]
        if not its:
            continue
        wrong = Counter(f["cause"] for f in its if f["cause"] and not f["is_right"])
        late = max((f["late"] for f in its if f["late"] is not None), default=None)
        print(
            f"{fault.name:28s} {sum(f['is_right'] for f in its):5d} "
            f"{sum(not f['cause'] for f in its):10d} {sum(wrong.values()):6d} "
            f"{sum(f['is_false'] for f in its):15d}  {'-' if late is None else f'{late:.3f}':>10s} "
            f"{max(f['over'] for f in its):10.2f}  {dict(wrong) or ''}"
        )
    right = sum(f["is_right"] for f in found)
    print(
        f"{right} of {len(found)} named rightly; {sum(f['is_false'] for f in found)} false verified"
    )
    print(f"advice to raise: {sum(f['advises'] for f in found)}")
    if args.out:
        args.out.write_text(json.dumps(found, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
