"""Machines that are not what they were thought to be: `commission` on each of 30 faults.

The machines are drives that commissioning was not made with (`drives.drawn`), motors of MuJoCo
(`mujoco_motors.drawn`) and the motor of the emulated board, which its device guards. One fault is
put into it, from the start or from a time in one run of the commissioning on. The commissioning
must end without calling the machine verified, name the cause, and command rest before the machine
is much faster than its owner said. `--healthy` puts nothing into them, nor into the virtual
machines that join them: no cause may be named then.

    python benches/faults.py --out faults.json           600 runs; those that the file has are kept
    python benches/faults.py --drives 3 --motors 0       fewer
    python benches/faults.py --stops --boards 0          in the stops of a position loop
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
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import mujoco_motors
import sewfast
from drives import FAMILY, Drive, Simulator, drawn
from sewfast.commissioning import SteppedBench
from sewfast.errors import SewfastError
from sewfast.link import connect
from sewfast_deploy.emulated import EmulatedBoard

VOLT, SPEED = 20.0, 1500.0
"""Largest command [V] and top of the working range [RPM] of a drive."""
FIRMWARE = Path(__file__).parents[1] / "target" / "bare" / "mps2-an386.elf"
"""Of the emulated board (`make firmware`)."""
STATED = 1.6
"""Speed that must not be passed, over the top of the working range."""


class Plant(Protocol):
    """A healthy motor that can be changed while it turns."""

    @property
    def counts(self) -> float: ...
    @property
    def speed_rpm(self) -> float: ...
    def reset(self) -> None: ...
    def step(self, u: float) -> None: ...
    def change(self, inertia: float, brake: float, *, free: bool) -> None:
        """Factor on the inertia, friction to add over the stall torque, without back EMF."""


class Drawn(Simulator):
    """A drive of another simulator."""

    def change(self, inertia: float, brake: float, *, free: bool) -> None:
        """As in `Plant`."""
        d = self.drive
        stall = d.current * d.constant
        d = replace(d, inertia=inertia * d.inertia, coulomb=d.coulomb + brake * stall)
        if free:
            d = replace(
                d, constant=0.005, inertia=1e-4, coulomb=5e-4, stribeck=0.0, viscous=0.0,
                once=0.0, twice=0.0,
            )  # fmt: skip
        self._p = d.vector()


class Hinge(mujoco_motors.MujocoMotor):
    """A motor of MuJoCo."""

    def __init__(self, motor: mujoco_motors.Motor) -> None:
        self.motor = motor
        super().__init__(motor.xml(), motor.counts, motor.gear)

    def change(self, inertia: float, brake: float, *, free: bool) -> None:
        """As in `Plant`."""
        m = self.motor
        stall = m.volt * m.constant / m.resistance * m.gear
        m = replace(
            m, rotor=inertia * m.rotor, load=inertia * m.load, coulomb=m.coulomb + brake * stall
        )
        if free:
            m = replace(
                m, constant=m.constant / 50, resistance=m.resistance / 50, viscous=0.0,
                coulomb=1e-3 * stall, unbalance=0.0,
            )  # fmt: skip
        other = mujoco_motors.MujocoMotor(m.xml(), m.counts, m.gear)
        other.data.qpos[:], other.data.qvel[:] = self.data.qpos, self.data.qvel
        self.model, self.data = other.model, other.data


class Motor:
    """A motor with whatever is wrong with it, from the beginning or from a time in a run on.

    ``command`` and ``encoder`` are factors, ``stuck``, ``load`` and ``dead`` shares of the largest
    command, ``holds`` keeps the last one; ``jump`` and ``bits`` belong to the counter, ``delay`` is
    in seconds, ``inertia``, ``brake`` and ``free`` change the motor.
    """

    def __init__(self, plant: Plant, bench: Machine, fault: Fault) -> None:
        self.plant, self.fault, self.Ts, self.volt = plant, fault, bench.Ts, bench.volt
        self.stated = bench.stated
        self.run, self.has_begun, self.total, self.fastest = "", not fault.run, 0.0, 0.0
        self.passed: float | None = None
        self.at_rest: float | None = None
        self.held: float | None = None
        if self.has_begun:
            self._change()
        self.load = self.volt * fault.wrong.get("load", 0.0)
        while self.has_begun and self.load and not self._turns():
            self.load *= 1.5
        self.reset()

    def _turns(self) -> bool:
        """Whether the load alone keeps the motor turning, which friction may hold."""
        self.plant.reset()
        for _ in range(round(1.0 / self.Ts)):
            self.plant.step(self.load)
        return abs(self.plant.speed_rpm) > 0.01 * self.stated

    def _change(self) -> None:
        wrong = self.fault.wrong
        if wrong.keys() & {"inertia", "brake", "free"}:
            self.plant.change(
                wrong.get("inertia", 1.0), wrong.get("brake", 0.0), free="free" in wrong
            )

    def reset(self) -> None:
        self.plant.reset()
        self.t = self.counted = self.before = 0.0
        self.sent = [0.0] * 400

    def now(self, name: str, healthy: float) -> float:
        """A number of the fault, once it has begun."""
        return self.fault.wrong.get(name, healthy) if self.has_begun else healthy

    @property
    def speed_rpm(self) -> float:
        return self.plant.speed_rpm

    @property
    def counts(self) -> float:
        counted = math.floor(self.counted)
        bits = int(self.now("bits", 0))
        if bits:
            counted = (counted + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
        return float(counted)

    def step(self, u: float) -> None:
        self._watch(u)
        if not self.has_begun and self.run == self.fault.run and self.t >= self.fault.at:
            self.has_begun = True
            self._change()
            self.counted += self.fault.wrong.get("jump", 0.0)
        self.sent.append(u)
        u = self.sent[-1 - round(self.now("delay", 0.0) / self.Ts)]
        dead = self.volt * self.now("dead", 0.0)
        u = math.copysign(max(0.0, abs(u) - dead), u) * self.now("command", 1.0)
        if self.now("holds", 0.0):
            self.held = u if self.held is None else self.held
            u = self.held
        load = self.load if self.has_begun else 0.0
        self.plant.step(self.volt * self.now("stuck", u / self.volt) + load)
        self.counted += self.now("encoder", 1.0) * (self.plant.counts - self.before)
        self.before = self.plant.counts
        self.t += self.Ts
        self.total += self.Ts

    def _watch(self, u: float) -> None:
        """When the stated speed was passed, and when rest was commanded after it."""
        self.fastest = max(self.fastest, abs(self.speed_rpm))
        if abs(self.speed_rpm) > self.stated and self.passed is None:
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
        # a stop's name goes on with the speed it is made from
        self.machine.run = name.partition(" from ")[0]
        return super().follow(controller, r, name, watch=watch)


@dataclass(frozen=True)
class Fault:
    """What is wrong, in which run, and the causes that name it rightly. A loop that follows its
    references may be verified with some of them, and with those that are `said` if it is.
    """

    name: str
    wrong: dict[str, float]
    causes: tuple[str, ...]
    run: str = ""
    at: float = 0.0
    may_verify: bool = False
    said: bool = False


# seen from rest, the signs of command and encoder are one, as are a dead encoder and stage
SIGNS, LOST = ("sign", "command sign", "encoder sign"), ("no motion", "encoder lost", "stage off")
LOOP, EXCITED, LAST, STOP = "trapezoids", "pulses", "trapezoid", "stop at 90deg"
FAULTS = (
    Fault("sign turned", {"command": -1.0}, SIGNS),
    Fault("encoder dead", {"encoder": 0.0}, LOST),
    Fault("stage off", {"command": 0.0}, ("no motion", "stage off")),
    Fault("turns at 0 V", {"load": 0.05}, ("turns at rest",), said=True),
    Fault("integrates", {"free": 1.0}, ("integrates",), may_verify=True),
    Fault("supply is 5 times as high", {"command": 5.0}, ("gain",), LOOP, 0.7),
    Fault("dead band of 40 %", {"dead": 0.4}, ("dead zone", "friction"), said=True),
    Fault("stuck stage", {"stuck": 0.15}, ("turns at rest", "stage stuck", "load")),
    Fault("counter of 16 bits wraps", {"bits": 16}, ("counts jumped",)),
    Fault("tenth of the gain", {"command": 0.1}, ("gain", "out of reach")),
    Fault("command turns", {"command": -1.0}, ("command sign",), LOOP, 0.7),
    Fault("encoder turns", {"encoder": -1.0}, ("encoder sign",), LOOP, 0.7),
    Fault("encoder freezes", {"encoder": 0.0}, ("encoder lost",), LOOP, 0.7),
    Fault("encoder loses a channel", {"encoder": 0.5}, ("counts scaled",), LOOP, 0.7),
    Fault("counts jump", {"jump": 30000.0}, ("counts jumped",), LOOP, 0.7),
    Fault("stage sticks", {"holds": 1.0}, ("stage stuck",), LOOP, 0.7),
    Fault("stage sticks at full", {"stuck": 1.0}, ("stage stuck",), LOOP, 0.7),
    Fault("stage fails", {"command": 0.0}, ("stage off",), LOOP, 0.7),
    Fault("command turns in pulses", {"command": -1.0}, SIGNS, EXCITED, 0.1),
    Fault("encoder freezes in pulses", {"encoder": 0.0}, LOST, EXCITED, 0.1),
    Fault("stage sticks in pulses", {"stuck": 1.0}, ("stage stuck",), EXCITED, 0.1),
    Fault("command turns at last", {"command": -1.0}, ("command sign",), LAST, 0.5),
    Fault("encoder turns at last", {"encoder": -1.0}, ("encoder sign",), LAST, 0.5),
    Fault("encoder freezes at last", {"encoder": 0.0}, ("encoder lost",), LAST, 0.5),
    Fault("stage sticks at last", {"holds": 1.0}, ("stage stuck",), LAST, 0.5),
    Fault("supply falls to a third", {"command": 0.33}, ("gain",), LAST, 0.5, True),
    Fault("brake comes on", {"brake": 0.7}, ("friction", "load", "gain"), LAST, 0.5, True),
    Fault("load drives", {"load": 0.1}, ("load",), LAST, 0.5, True),
    Fault("delay of 30 ms", {"delay": 0.03}, ("delay",), LAST, 0.3, True),
    Fault("four times the inertia", {"inertia": 4.0}, ("inertia",), LAST, 0.3, True),
)  # fmt: skip


IN_STOPS = (
    Fault("sound stops", {}, (), STOP, 0.4, True),
    Fault("command turns in a stop", {"command": -1.0}, ("command sign",), STOP, 0.4),
    Fault("encoder freezes in a stop", {"encoder": 0.0}, ("encoder lost",), STOP, 0.4),
    Fault("encoder loses a channel in a stop", {"encoder": 0.5}, ("counts scaled",), STOP, 0.4),
    Fault("counts jump in a stop", {"jump": 30000.0}, ("counts jumped",), STOP, 0.4),
    Fault("stage sticks in a stop", {"holds": 1.0}, ("stage stuck",), STOP, 0.4),
    Fault("stage fails in a stop", {"command": 0.0}, ("stage off",), STOP, 0.4),
    Fault("supply falls in a stop", {"command": 0.33}, ("gain",), STOP, 0.4, True),
    Fault("brake in a stop", {"brake": 0.7}, ("friction", "load", "gain"), STOP, 0.4, True),
    Fault("load drives in a stop", {"load": 0.2}, ("load",), STOP, 0.4, True),
    Fault("delay of 30 ms in a stop", {"delay": 0.03}, ("delay",), STOP, 0.4, True),
    Fault("four times the inertia in a stop", {"inertia": 4.0}, ("inertia",), STOP, 0.4, True),
)  # fmt: skip
"""Of `--stops`: they begin in the first of the stops at an angle that verify a position loop."""


HEALTHY = Fault("healthy", {}, (), may_verify=True)


@dataclass(frozen=True)
class Machine:
    """One to commission: a drive, a motor of MuJoCo, the name of a virtual machine, which nothing
    can be put into, or, without any, the emulated board.
    """

    of: Drive | mujoco_motors.Motor | str | None

    @property
    def name(self) -> str:
        if isinstance(self.of, str):
            return self.of
        return "board" if self.of is None else self.of.name

    @property
    def speed(self) -> float:
        """Top of the working range [RPM]."""
        return self.of.speed if isinstance(self.of, mujoco_motors.Motor) else SPEED

    @property
    def stated(self) -> float:
        """Speed that must not be passed [RPM]."""
        return STATED * self.speed

    @property
    def volt(self) -> float:
        """Largest command [V]."""
        return self.of.volt if isinstance(self.of, mujoco_motors.Motor) else VOLT

    @property
    def Ts(self) -> float:
        return self.of.Ts if isinstance(self.of, Drive) else 1e-3

    @property
    def counts(self) -> float:
        """Of the encoder, to a turn."""
        assert self.of is not None
        if isinstance(self.of, str):
            return float(self.plant().counts_per_rev)
        return self.of.counts

    def plant(self) -> Any:
        """A `Plant`, or a virtual machine."""
        if isinstance(self.of, str):
            return sewfast.VirtualMachine.from_name(self.of)
        return Drawn(self.of) if isinstance(self.of, Drive) else Hinge(self.of)


BOARD = Machine(None)
ON_BOARD = {"command", "encoder", "load", "stuck", "dead", "holds", "jump", "brake", "inertia"}
"""What can be wrong with the board's motor."""


def tried(case: tuple[Fault, Machine, int]) -> dict[str, Any]:
    """One commissioning of one machine with one fault."""
    fault, machine, seed = case
    began = time.process_time()
    on: Any = _Board(fault)
    if machine.of is not None:
        motor = Motor(machine.plant(), machine, fault)
        on = nullcontext(
            Bench(motor, machine.Ts, machine.counts, machine.volt, machine.name, machine.stated)
        )
    found: Any = None
    with on as bench:
        try:
            found = sewfast.commission(
                bench, speed=machine.speed, members=1, evaluations=100, threads=1, seed=seed,
                loop="position" if fault.run == STOP else "speed",
            )  # fmt: skip
            verdict, text, cause = found.verdict, found.reason, found.cause
        except SewfastError as error:
            verdict, text, cause = type(error).__name__, str(error), error.cause
            found = getattr(error, "so_far", None)
    fopdt = getattr(found, "fopdt", None)
    late = None
    if machine.of is None:
        fastest = on.fastest
    else:
        fastest = motor.fastest
        if motor.passed is not None:
            late = (motor.at_rest if motor.at_rest is not None else math.inf) - motor.passed
    named, verified = cause.name if cause else "", verdict.startswith("verified")
    is_named = named in fault.causes
    may_verify = fault.may_verify or (fault.said and is_named)
    return {
        "fault": fault.name, "machine": machine.name, "seed": seed, "verdict": verdict,
        "cause": named, "text": text, "late": late, "over": fastest / machine.stated,
        "is_right": is_named or (not named and verified and fault.may_verify),
        "is_false": verified and not may_verify, "advises": "raise" in text,
        "strength": fopdt and fopdt.K * machine.volt / machine.stated,
        "began": machine.of is None or motor.has_begun,
        "seconds": time.process_time() - began,
    }  # fmt: skip


class _Board(AbstractContextManager[Any]):
    """The emulated board as a drive whose motor breaks in one run."""

    def __init__(self, fault: Fault) -> None:
        wrong = dict(fault.wrong)
        self._at = fault.at
        self._run = fault.run
        if wrong.pop("holds", 0.0):
            wrong["stuck"] = math.inf
        for share in ("load", "stuck", "dead", "brake"):
            if share in wrong:
                wrong[share] *= VOLT
        if "inertia" in wrong:
            wrong["lag"] = wrong.pop("inertia")
        self._wrong = wrong
        self.fastest = 0.0

    def __enter__(self) -> Any:
        self._opened = ExitStack()
        self._board = self._opened.enter_context(EmulatedBoard(FIRMWARE, boot_id=1))
        with self._opened.pop_all() as opening:
            drive = opening.enter_context(connect(self._board.port))
            self._opened = opening.pop_all()
        drive.set_limits(volt=VOLT, speed_rpm=STATED * SPEED)
        for name in ("excite", "follow"):
            setattr(drive, name, self._watched(getattr(drive, name)))
        if self._wrong and not self._run:
            self._board.break_motor(**self._wrong)
        return drive

    def _watched(self, play: Any) -> Any:
        def played(what: Any, *arguments: Any, **options: Any) -> Any:
            if self._wrong and arguments[-1] == self._run:
                self._board.break_motor(self._at, **self._wrong)
            return play(what, *arguments, **options)

        return played

    def __exit__(self, *exception: object) -> None:
        self.fastest = self._board.fastest
        self._opened.close()


def machines(args: argparse.Namespace) -> Iterator[tuple[Machine, int]]:
    """Each with its seed, of every kind by turns."""
    virtuals = args.virtuals if args.healthy else 0
    for i in range(max(args.drives, args.motors, args.boards, virtuals)):
        seed = args.first + i
        if i < args.drives:
            yield Machine(drawn(seed)), seed
        if i < args.motors:
            yield Machine(mujoco_motors.drawn(seed, seed=1)), seed
        if i < args.boards:
            yield BOARD, seed
        if i < virtuals:
            yield Machine(f"virtual:{seed}"), seed


def cases(args: argparse.Namespace) -> Iterator[tuple[Fault, Machine, int]]:
    if args.healthy:
        yield from ((HEALTHY, Machine(d), seed) for d in FAMILY for seed in range(2))
        yield from ((HEALTHY, m, seed) for m, seed in machines(args))
        return
    faults = IN_STOPS if args.stops else FAULTS
    for i, (machine, seed) in enumerate(machines(args)):
        for fault in faults[i % args.every :: args.every]:
            # the firmware of the board has no positions
            can_be = machine is not BOARD or (not args.stops and fault.wrong.keys() <= ON_BOARD)
            if args.only in fault.name and can_be:
                yield fault, machine, seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", type=int, default=12, help="drives of another simulator")
    parser.add_argument("--motors", type=int, default=7, help="motors of MuJoCo")
    parser.add_argument("--boards", type=int, default=1, help="times on the emulated board")
    parser.add_argument("--virtuals", type=int, default=0, help="virtual machines, if healthy")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--every", type=int, default=1, help="every so many faults of a machine")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="part of a fault's name")
    parser.add_argument("--healthy", action="store_true", help="machines without a fault")
    parser.add_argument("--stops", action="store_true", help="faults in stops of a position loop")
    parser.add_argument("--out", type=Path, help="JSON; what it has already is not run again")
    args = parser.parse_args()
    if args.boards and not FIRMWARE.exists():
        parser.error(f"expected {FIRMWARE}, there is none: make firmware, or --boards 0")
    found: list[dict[str, Any]] = []
    if args.out and args.out.exists():
        found = json.loads(args.out.read_text(encoding="utf-8"))
    have = {(f["fault"], f["machine"], f["seed"]) for f in found}
    due = [c for c in cases(args) if (c[0].name, c[1].name, c[2]) not in have]
    with ProcessPoolExecutor(args.jobs) as pool:
        for f in pool.map(tried, due):
            found.append(f)
            print(
                f"{f['fault']:28s}{f['machine']:10s} {f['verdict']}: {f['cause']}", file=sys.stderr
            )
            if args.out:
                args.out.write_text(json.dumps(found, indent=1), encoding="utf-8")
    print(f"{'fault':33s} right  not named  wrong  false verified  latest [s]  over speed")
    for fault in (HEALTHY, *FAULTS, *IN_STOPS):
        its = [f for f in found if f["fault"] == fault.name]
        if not its:
            continue
        wrong = Counter(f["cause"] for f in its if f["cause"] and not f["is_right"])
        late = max((f["late"] for f in its if f["late"] is not None), default=None)
        print(
            f"{fault.name:33s} {sum(f['is_right'] for f in its):5d} "
            f"{sum(not f['cause'] for f in its):10d} {sum(wrong.values()):6d} "
            f"{sum(f['is_false'] for f in its):15d}  {'-' if late is None else f'{late:.3f}':>10s} "
            f"{max(f['over'] for f in its):10.2f}  {dict(wrong) or ''}"
        )
    for kind in ("", "drawn", "motor", "virtual", "board"):
        its = [f for f in found if f["machine"].startswith(kind)]
        print(
            f"{kind or 'all':8s}{sum(f['is_right'] for f in its)} of {len(its)} named rightly, "
            f"{sum(f['is_false'] for f in its)} false verified, advice to raise: "
            f"{sum(f['advises'] for f in its)}"
        )


if __name__ == "__main__":
    main()
