"""Machines as their owners write them: `commission`, `record` and `run` on sound and faulty ones.

Each is a class of a few lines with `reset`, `step` and `counts`, drawn anew for each seed, and is
met in three ways: stepped by a `SteppedBench`, and as a `sewfast.Machine` of its own whose `excite`
and `follow` take a `watch` or do not. A faulty one must be commanded to rest soon after it passes
its stated speed, must not be called verified, and its cause must be named; a sound one must not be
stopped. What is judged is the true speed, which the machine notes itself.

    python benches/own_machines.py --seeds 0 1 2 --out own.json
    python benches/own_machines.py --only flips --ways stepped
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from sewfast import Machine, Recording
from sewfast.commissioning import SteppedBench
from sewfast.control.machine import RecordedRun
from sewfast.errors import SewfastError

TOP, STATED = 1500.0, 1.4
"""Top of the working range [RPM], and the speed that must not be passed, over it."""
LATEST, FASTEST, FASTEST_OF_60 = 0.02, 1.25, 2.0
"""What is allowed: from the stated speed to the command of rest [s], and speed over the stated."""


@dataclass
class Motor:
    """First order, with friction and an encoder; a fault begins in the run `fails` at `at` [s]."""

    volt: float
    gain: float
    lag: float
    friction: float
    lines: float
    Ts: float
    fails: int = 0
    at: float = 0.0
    speed: float = 0.0
    angle: float = 0.0
    run: int = 0
    t: float = 0.0
    life: float = 0.0
    top: float = 0.0
    passed: float | None = None
    rested: float | None = None

    @classmethod
    def drawn(cls, seed: int) -> Motor:
        rng = np.random.default_rng([seed, 40])
        volt = float(rng.choice([10.0, 24.0, 48.0]))
        gain = TOP * rng.uniform(1.6, 2.6) / volt
        lag = float(np.exp(rng.uniform(np.log(0.03), np.log(0.4))))
        return cls(
            volt, gain, lag, rng.uniform(0.0, 0.05) * volt, float(rng.choice([1024, 2000, 8192])),
            float(rng.choice([0.001, 0.002])), int(rng.integers(4, 8)), rng.uniform(0.2, 0.9),
        )  # fmt: skip

    def reset(self) -> None:
        self.speed = self.angle = self.t = 0.0
        self.run += 1

    @property
    def is_faulty(self) -> bool:
        return self.run > self.fails or (self.run == self.fails and self.t >= self.at)

    @property
    def counts(self) -> float:
        return math.floor(self.lines * self.angle)

    def step(self, u: float) -> None:
        if abs(self.speed) > STATED * TOP and self.passed is None:
            self.passed = self.life
        if self.passed is not None and self.rested is None and u == 0.0:
            self.rested = self.life
        for _ in range(10):
            self.advance(u, 0.1 * self.Ts)
        self.t, self.life = self.t + self.Ts, self.life + self.Ts
        self.top = max(self.top, abs(self.speed))

    def advance(self, u: float, h: float) -> None:
        u -= self.friction * math.tanh(self.speed / 5.0)
        self.speed += h / self.lag * (self.gain * u - self.speed)
        self.angle += h * self.speed / 60.0


class Flips(Motor):
    def advance(self, u: float, h: float) -> None:
        super().advance(-u if self.is_faulty else u, h)


class Sticks(Motor):
    last = 0.0

    def advance(self, u: float, h: float) -> None:
        self.last = self.last if self.is_faulty else u
        super().advance(self.last, h)


class Integrates(Motor):
    def advance(self, u: float, h: float) -> None:
        self.speed += h / self.lag * self.gain * u
        self.angle += h * self.speed / 60.0


class Strong(Motor):
    """60 times the gain, from the beginning."""

    def advance(self, u: float, h: float) -> None:
        super().advance(60.0 * u, h)


class Grown(Motor):
    """60 times the gain, suddenly."""

    def advance(self, u: float, h: float) -> None:
        super().advance(60.0 * u if self.is_faulty else u, h)


class Freezes(Motor):
    last = 0.0

    @property
    def counts(self) -> float:
        if not self.is_faulty:
            self.last = math.floor(self.lines * self.angle)
        return self.last


class Scaled(Motor):
    """The encoder loses a channel: half of the counts from then on."""

    lost = 0.0

    def advance(self, u: float, h: float) -> None:
        before = self.angle
        super().advance(u, h)
        if self.is_faulty:
            self.lost += 0.5 * (self.angle - before)

    def reset(self) -> None:
        super().reset()
        self.lost = 0.0

    @property
    def counts(self) -> float:
        return math.floor(self.lines * (self.angle - self.lost))


class Weak(Motor):
    """It cannot reach the top speed."""

    def advance(self, u: float, h: float) -> None:
        super().advance(0.7 * TOP / (self.gain * self.volt) * u, h)


class Moves(Motor):
    """An offset turns it without a command."""

    def advance(self, u: float, h: float) -> None:
        super().advance(u + 0.08 * self.volt, h)


class DeadZone(Motor):
    def advance(self, u: float, h: float) -> None:
        super().advance(math.copysign(max(0.0, abs(u) - 0.4 * self.volt), u), h)


class Late(Motor):
    """30 ms of delay more, suddenly."""

    def reset(self) -> None:
        super().reset()
        self.sent = [0.0] * (1 + round(0.3 / self.Ts))

    def advance(self, u: float, h: float) -> None:
        self.sent = [*self.sent[1:], u]
        super().advance(self.sent[-1 - round(0.03 / h)] if self.is_faulty else u, h)


class Springy(Motor):
    """Two masses with a light resonance between 40 and 70 Hz; the encoder is on the motor."""

    def reset(self) -> None:
        super().reset()
        self.load = self.twist = 0.0

    def advance(self, u: float, h: float) -> None:
        w = 2.0 * math.pi * (40.0 + 30.0 * (self.gain % 1.0))
        k, d = 0.5 * w * w, 0.02 * w
        twist = k * self.twist + d * (self.speed - self.load)
        u -= self.friction * math.tanh(self.speed / 5.0)
        # half of the inertia on either side
        self.speed += h * (2.0 * (self.gain * u - self.speed) / self.lag - twist)
        self.load += h * twist
        self.twist += h * (self.speed - self.load)
        self.angle += h * self.speed / 60.0


@dataclass(frozen=True)
class Case:
    """A machine, what is said of it rightly, and what may be done with it. One whose cause is
    `said` may be verified if it is.
    """

    name: str
    kind: type[Motor]
    causes: tuple[str, ...] = ()
    later: bool = False
    may_verify: bool = False
    said: bool = False
    sound: bool = False
    with_: dict[str, float] | None = None


SLOW, QUICK, COARSE = {"lag": 3.0}, {"lag": 0.005, "Ts": 0.0005}, {"Ts": 0.005, "lag": 0.3}
CASES = (
    Case("flips", Flips, ("command sign", "sign"), later=True),
    Case("sticks", Sticks, ("stage stuck", "turns at rest"), later=True),
    Case("integrates", Integrates, ("integrates",), may_verify=True),
    Case("60 times the gain", Strong, ("gain too large", "gain"), said=True),
    Case("gain grows 60 times", Grown, ("gain", "gain too large"), later=True),
    Case("encoder freezes", Freezes, ("encoder lost", "no motion"), later=True),
    Case("counts halved", Scaled, ("counts scaled",), later=True),
    Case("out of reach", Weak, ("out of reach", "gain")),
    Case("moves at 0 V", Moves, ("turns at rest",), said=True),
    Case("dead zone", DeadZone, ("dead zone", "friction"), said=True),
    Case("delay grows", Late, ("delay",), later=True, may_verify=True),
    Case("two masses", Springy, (), may_verify=True, sound=True),
    Case("slow and heavy", Motor, may_verify=True, sound=True, with_=SLOW),
    Case("very quick", Motor, may_verify=True, sound=True, with_=QUICK),
    Case("5 ms", Motor, may_verify=True, sound=True, with_=COARSE),
)


@dataclass
class Own:
    """A `sewfast.Machine` of one's own: it plays a whole signal and hands back its log."""

    motor: Motor
    name: str = "own"

    def __post_init__(self) -> None:
        self.Ts, self.counts_per_rev, self.volt = self.motor.Ts, self.motor.lines, self.motor.volt
        self.speed = STATED * TOP

    def play(
        self, law: Callable[[int, float], float], n: int, name: str, watch: Any = None
    ) -> Recording:
        u, counts = np.zeros(n), np.zeros(n)
        self.motor.reset()
        try:
            for k in range(n):
                if watch is not None and k and k % 20 == 0:
                    watch(k - 20, u[k - 20 : k], counts[k - 20 : k])
                counts[k] = self.motor.counts
                u[k] = np.clip(law(k, counts[k]), -self.volt, self.volt)
                self.motor.step(u[k])
        finally:
            self.motor.step(0.0)
        return Recording.of_counts(
            u, counts, Ts=self.Ts, counts_per_rev=self.counts_per_rev, name=name
        )

    def excite(self, u: Any, name: str) -> Recording:
        return self.play(lambda k, counts: u[k], len(u), name)

    def follow(self, controller: Any, r: Any, name: str) -> RecordedRun:
        return self.followed(controller, r, name)

    def followed(self, controller: Any, r: Any, name: str, watch: Any = None) -> RecordedRun:
        core, before = controller.core(), [0.0]

        def law(k: int, counts: float) -> float:
            speed = (counts - before[0]) * 60.0 / (self.counts_per_rev * self.Ts)
            before[0] = counts
            return core.step(float(r[k]), speed)

        log = self.play(law, len(r), name, watch)
        return RecordedRun.of_recording(log, controller, r, plant=self.name)


class Watched(Own):
    def excite(self, u: Any, name: str, *, watch: Any = None) -> Recording:
        return self.play(lambda k, counts: u[k], len(u), name, watch)

    def follow(self, controller: Any, r: Any, name: str, *, watch: Any = None) -> RecordedRun:
        return self.followed(controller, r, name, watch)


def stepped(motor: Motor) -> Machine:
    return SteppedBench(motor, motor.Ts, motor.lines, motor.volt, name="own", speed=STATED * TOP)


WAYS: dict[str, Callable[[Motor], Any]] = {"stepped": stepped, "watched": Watched, "own": Own}
DEEDS = ("commission", "record", "run")


def made(case: Case, seed: int, kind: type[Motor]) -> Motor:
    m = Motor.drawn(seed)
    m = kind(m.volt, m.gain, m.lag, m.friction, m.lines, m.Ts, m.fails, m.at)
    return replace(m, **(case.with_ or {}))


def gains(motor: Motor) -> sewfast.Controller:
    """A PI controller by rule, for the sound motor: what an owner has already."""
    wanted = 0.5 * motor.lag + 8 * motor.Ts
    return sewfast.Controller(
        sewfast.Gains.standard(
            motor.lag / (motor.gain * wanted), min(motor.lag, 4.0 * wanted),
            u_unit="V", y_unit="RPM",
        ),
        Ts=motor.Ts, u_min=-motor.volt, u_max=motor.volt, filter_samples=4,
        counts_per_rev=motor.lines,
    )  # fmt: skip


def done(deed: str, machine: Any, motor: Motor, seed: int) -> tuple[str, str, Any]:
    """Verdict, text and cause of a deed."""
    if deed == "commission":
        found = sewfast.commission(
            machine, speed=TOP, members=1, evaluations=100, threads=1, seed=seed
        )
        return found.verdict, found.reason, found.cause
    motor.fails = min(motor.fails, 1)
    samples = round(max(3.0, 10.0 * motor.lag) / motor.Ts)
    if deed == "record":
        levels = np.repeat([0.0, 0.3, 0.55, 0.2], samples // 4)
        sewfast.record(machine, levels * motor.volt, name="levels")
    else:
        r = np.repeat([0.5, 0.9, 0.3, 0.8], samples // 4) * TOP
        sewfast.run(gains(motor), machine, r, name="levels")
    return "done", "", None


def tried(case: Case, way: str, deed: str, seed: int) -> dict[str, Any]:
    motor = made(case, seed, case.kind)
    if not case.later:
        motor.fails = 0
    began = time.process_time()
    try:
        verdict, text, cause = done(deed, WAYS[way](motor), motor, seed)
    except SewfastError as error:
        verdict, text, cause = type(error).__name__, str(error), error.cause
    late = None
    if motor.passed is not None:
        late = (math.inf if motor.rested is None else motor.rested) - motor.passed
    return {
        "case": case.name, "way": way, "deed": deed, "seed": seed, "verdict": verdict,
        "cause": cause.name if cause else "", "text": text, "late": late,
        "Ts": motor.Ts, "over": motor.top / (STATED * TOP), "advises": "raise" in text,
        "seconds": time.process_time() - began,
    }  # fmt: skip


def faults_of(case: Case, f: dict[str, Any]) -> list[str]:
    """What was wrong with what was done."""
    verified = f["verdict"].startswith("verified")
    found = []
    if case.sound and f["verdict"] in ("LinkError", "Aborted"):
        found.append("tripped")
    if case.sound and f["cause"]:
        found.append("accused")
    if verified and not (case.may_verify or (case.said and f["cause"] in case.causes)):
        found.append("false verified")
    if f["cause"] and case.causes and f["cause"] not in case.causes:
        found.append("wrong cause")
    if not case.sound and not f["cause"] and f["verdict"] not in ("verified", "done"):
        found.append("no cause")
    # who cannot be watched is refused afterwards
    if f["late"] is not None and f["over"] > 1.05 and f["verdict"] in ("done", "verified"):
        found.append("too fast unseen")
    if f["way"] == "stepped":
        if f["late"] is not None and f["late"] > 1.01 * LATEST:
            found.append("late")
        most = FASTEST_OF_60 if "60" in case.name else FASTEST
        # a stage that does not obey can reach any speed, and within a sample nobody can act
        if case.name != "sticks" and f["over"] > most and f["late"] > 1.01 * f["Ts"]:
            found.append("too fast")
    if f["advises"] and case.name != "out of reach":
        found.append("advice to raise")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--only", default="", help="part of a machine's name")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--deeds", nargs="*", default=list(DEEDS), choices=list(DEEDS))
    parser.add_argument("--out", type=Path, help="JSON; what it has already is not run again")
    args = parser.parse_args()
    found: list[dict[str, Any]] = []
    if args.out and args.out.exists():
        found = json.loads(args.out.read_text(encoding="utf-8"))
    have = {(f["case"], f["way"], f["deed"], f["seed"]) for f in found}
    wrong: Counter[str] = Counter()
    for seed in args.seeds:
        for case in (c for c in CASES if args.only in c.name):
            for way in args.ways:
                for deed in args.deeds:
                    if (case.name, way, deed, seed) not in have:
                        found.append(tried(case, way, deed, seed))
                        if args.out:
                            args.out.write_text(json.dumps(found, indent=1), encoding="utf-8")
    by_name = {case.name: case for case in CASES}
    for f in found:
        said = faults_of(by_name[f["case"]], f)
        wrong.update(said)
        late = "" if f["late"] is None else f"{1e3 * f['late']:.0f} ms"
        print(
            f"{f['case']:20s} {f['way']:8s} {f['deed']:11s} {f['seed']:3d} {f['verdict']:12.40s} "
            f"{f['cause']:15s} {late:>8s} {f['over']:5.2f}  {', '.join(said)}"
        )
    print(f"{len(found)} done; {dict(wrong) or 'nothing wrong'}")


if __name__ == "__main__":
    main()
