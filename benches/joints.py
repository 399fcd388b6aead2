"""Positions: drives like EMPS, smart servos and MuJoCo joints, drawn by a seed; whole `identify`.

Three kinds of joints that share nothing with the package's equations but physics:

drives   a carriage behind a force or a voltage of unknown unit (EMPS: Janot, Gautier and Brunot
         2019), in a cascade that repeats one trajectory; friction by direction, Stribeck's fall, a
         slightly flexible belt, encoder steps. Test: the same with pulses of force.
servos   a position command to a controller inside (PD, dead band, limited torque), gravity,
         12-bit steps, 50 to 200 Hz. Test: other motions.
mujoco   the same at 200 Hz on MuJoCo's integrator (at 4 kHz, so that its parameters are those of
         the equations) and dry friction, with gravity and the friction
         models M1 to M6 of Rhoban's "better actuator models", by seed one after the other.

    python benches/joints.py                        the half for rules: seeds 0 to 9 of each kind
    python benches/joints.py --held                 seeds 100 to 109, on which nothing is decided
    python benches/joints.py --kind servos --seeds 3 4
    python benches/joints.py --physics              parameters and intervals only, without a search
    python benches/joints.py --sage FOLDER --train multisine random_waypoints

The last one takes real joints: a folder of motions as SAGE records them, such as
`output/real/so101/custom` of https://github.com/isaac-sim2real/sage (50 motions of six STS3215 at
50 Hz). Each joint is fitted to one motion and judged on all others in which it moves.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, __file__.rpartition("/")[0] or ".")

from battery.simulators import compiled
from sewfast import Dataset, identify, physics, read_joints

F = NDArray[np.float64]
SUBSTEPS = 10
FIRST = 20
"""Outputs that are given of a test record, as EMPS gives them."""


@dataclass(frozen=True)
class Case:
    """One joint: its training record, its test record, what is true of it, and the true model."""

    train: Dataset
    test: Dataset
    clean: F
    """The test's positions without noise or steps."""
    truth: dict[str, float] = field(default_factory=dict)
    floor: float = math.nan
    """Free run of the true equations on the test."""


# --- drives like EMPS -----------------------------------------------------------------------------


@compiled
def _drive(
    r: F, pulses: F, kp: float, kv: float, gain: float, limit: float, M: float, viscous: float,
    ahead: float, back: float, offset: float, stribeck: float, fall: float, share: float,
    frequency: float, step: float, Ts: float, sub: int,
) -> tuple[F, F, F]:  # fmt: skip
    """Command, position of the motor's encoder, exact position; two masses on a belt."""
    N = len(r)
    u, y, exact = np.empty(N), np.empty(N), np.empty(N)
    q, v, p, w = 0.0, 0.0, 0.0, 0.0
    m1, m2 = (1.0 - share) * M, share * M
    stiff = m2 * (2.0 * math.pi * frequency) ** 2
    damping = 0.06 * math.sqrt(stiff * m2)
    h = Ts / sub
    last = 0.0
    for k in range(N):
        exact[k] = q
        seen = math.floor(q / step + 0.5) * step if step > 0.0 else q
        y[k] = seen
        speed = (seen - last) / Ts if k > 0 else 0.0
        last = seen
        force = kv * (kp * (r[k] - seen) - speed) / gain + pulses[k] / gain
        force = min(max(force, -limit), limit)
        u[k] = force
        for _ in range(sub):
            belt = stiff * (q - p) + damping * (v - w)
            free = v + h / m1 * (gain * force - belt - offset - viscous * v)
            coulomb = ahead if free > 0.0 else back
            most = h / m1 * (coulomb + stribeck * math.exp(-((v / fall) ** 2)))
            v = 0.0 if abs(free) <= most else free - math.copysign(most, free)
            w += h / m2 * belt
            q += h * v
            p += h * w
    return u, y, exact


def _bang(rng: np.random.Generator, stroke: float, N: int) -> F:
    """One trajectory of bang-bang accelerations both ways, four times."""
    one: list[float] = []
    period = N // 4
    places = stroke * np.array([0.0, 1.0, rng.uniform(0.2, 0.6), 1.0, rng.uniform(-0.2, 0.2), 0.0])
    for a, b in itertools.pairwise(places.tolist()):
        n = int(period / (len(places) - 1))
        x = np.clip(np.arange(n) / (rng.uniform(0.5, 0.8) * n), 0.0, 1.0)
        one.extend(a + (b - a) * np.where(x < 0.5, 2.0 * x**2, 1.0 - 2.0 * (1.0 - x) ** 2))
    return np.resize(np.array(one), N)


def drive(seed: int) -> Case:
    """20 to 150 kg, .2 to .4 m, 24,800 samples of 1 ms; friction, noise, units and belt by seed."""
    rng = np.random.default_rng([seed, 1])
    M = rng.uniform(20.0, 150.0)
    coulomb = M * rng.uniform(0.1, 0.3)
    side = rng.uniform(-0.05, 0.05) * coulomb
    gain = float(rng.choice([1.0, 35.0, 0.02]))
    own = {
        "M": M, "viscous": M * rng.uniform(1.0, 3.0), "ahead": coulomb + side,
        "back": coulomb - side, "offset": rng.uniform(-0.2, 0.2) * coulomb,
        "stribeck": rng.choice([0.0, 0.15]) * coulomb, "fall": rng.uniform(0.005, 0.03),
        "share": rng.uniform(0.05, 0.4), "frequency": rng.uniform(25.0, 60.0),
        "step": rng.choice([2e-6, 1e-5, 5e-5]),
    }  # fmt: skip
    stroke, Ts, N = rng.uniform(0.2, 0.4), 1e-3, 24_800
    r = _bang(rng, stroke, N)
    kp, kv = rng.uniform(15.0, 30.0), M * rng.uniform(20.0, 40.0)
    most = 4.0 * M / gain
    values = [float(v) for v in own.values()]

    def run(pulses: F) -> tuple[F, F, F]:
        found: tuple[F, F, F] = _drive(r, pulses, kp, kv, gain, most, *values, Ts, SUBSTEPS)
        return found

    u, y, _ = run(np.zeros(N))
    pulses = np.zeros(N)
    for at in rng.integers(500, N - 500, 12):
        pulses[at : at + int(rng.integers(50, 200))] += rng.choice([-1, 1]) * 0.4 * np.abs(u).max()
    v, z, exact = run(pulses * gain)
    unit, factor = (("m", 1.0), ("mm", 1e3), ("", 1.0))[seed % 3]

    def made(u: F, y: F) -> Dataset:
        return Dataset.from_arrays(u, factor * y, Ts, output_unit=unit, name=f"drives/{seed}")

    return Case(made(u, y), made(v, z), factor * exact, own | {"unit": gain * factor})


def _commanded(u: F, y: F, Ts: float, name: str) -> Dataset:
    """The record of a joint with a controller inside."""
    return Dataset.from_arrays(u, y, Ts, input_units=("rad",), output_unit="rad", name=name)


# --- smart servos ---------------------------------------------------------------------------------


@compiled
def _servo(
    r: F, N: int, every: int, h: float, J: float, viscous: float, coulomb: float, stribeck: float,
    fall: float, loaded: float, gravity: float, phase: float, kp: float, kd: float, dead: float,
    most: float, emf: float, late: int, step: float,
) -> tuple[F, F]:  # fmt: skip
    """Position in steps, and exact, of a joint behind its controller, from rest at its command."""
    y, exact = np.empty(N), np.empty(N)
    q, v = r[0], 0.0
    for k in range(N * every):
        if k % every == 0:
            exact[k // every] = q
            y[k // every] = math.floor(q / step + 0.5) * step
        due = r[max(k - late, 0) // every]
        error = due - q
        error = 0.0 if abs(error) <= dead else error - math.copysign(dead, error)
        torque = min(max(kp * error - kd * v, -most), most) - emf * v
        load = gravity * math.sin(q + phase)
        free = v + h / J * (torque - load - viscous * v)
        dry = coulomb + stribeck * math.exp(-((v / fall) ** 2)) + loaded * abs(torque + load)
        bound = h / J * dry
        v = 0.0 if abs(free) <= bound else free - math.copysign(bound, free)
        q += h * v
    return y, exact


def _motion(rng: np.random.Generator, N: int, Ts: float, kind: int) -> F:
    """A chirp, waypoints or levels, from -1 to 1 rad."""
    t = Ts * np.arange(N)
    if kind == 0:
        top = rng.uniform(1.0, 3.0)
        return rng.uniform(0.4, 0.8) * np.sin(
            2 * np.pi * (0.1 * t + (top - 0.1) * t**2 / 2 / t[-1])
        )
    hold = int(rng.uniform(0.4, 1.0) / Ts)
    levels = np.repeat(rng.uniform(-0.9, 0.9, N // hold + 2), hold)
    if kind == 1:
        return np.asarray(levels[:N])
    return np.asarray(np.convolve(levels, np.ones(hold) / hold, "valid")[:N])


def servo(seed: int) -> Case:
    """20 s at 50, 100 or 200 Hz in 12-bit steps; gravity, dead band and limit by seed."""
    rng = np.random.default_rng([seed, 2])
    Ts = float(rng.choice([0.02, 0.01, 0.005]))
    every = round(Ts / 2.5e-4)
    J, N = rng.uniform(0.005, 0.03), round(20.0 / Ts)
    w = rng.uniform(12.0, 25.0)
    kp = J * w * w
    own = {
        "J": J, "viscous": J * rng.uniform(1.0, 5.0), "coulomb": kp * rng.uniform(0.01, 0.04),
        "stribeck": kp * rng.choice([0.0, 0.01]), "fall": 0.1, "loaded": rng.choice([0.0, 0.1]),
        "gravity": kp * rng.choice([0.0, 0.08]), "phase": rng.uniform(-1.0, 1.0), "kp": kp,
        "kd": J * w * rng.uniform(0.2, 0.8), "dead": rng.choice([0.0, 0.006]),
        "most": kp * rng.choice([0.25, 10.0]), "emf": J * w * rng.uniform(0.5, 1.2),
        "late": round(rng.uniform(0.5, 3.0) * every),
    }  # fmt: skip
    step = 2.0 * math.pi / 4096
    values = [float(v) for v in own.values()]
    values[-1] = int(own["late"])

    def run(kind: int) -> tuple[F, F, F]:
        r = np.concatenate([_motion(rng, N // 2, Ts, kind), _motion(rng, N - N // 2, Ts, 1)])
        y, exact = _servo(r, N, every, 2.5e-4, *values, step)
        return r, y, exact

    r, y, _ = run(2)
    v, z, exact = run(0)
    make = partial(_commanded, Ts=Ts, name=f"servos/{seed}")
    return Case(make(r, y), make(v, z), exact, own)


# --- joints of MuJoCo -----------------------------------------------------------------------------


def _friction(kind: int, p: dict[str, float], w: float, motor: float, outer: float) -> float:
    """Dry friction of M1 to M6 at a speed, a motor's torque and an outer one."""
    fall = math.exp(-((abs(w) / p["fall"]) ** 1.5))
    dry = p["coulomb"]
    if kind in (2, 4, 5, 6):
        dry += fall * p["stribeck"]
    if kind in (3, 4):
        dry += p["loaded"] * abs(motor - outer)
    if kind in (5, 6):
        dry += p["loaded"] * abs(motor) + 0.5 * p["loaded"] * abs(outer)
    if kind == 6:
        dry += 0.3 * p["loaded"] / p["most"] * motor**2
    return dry


def mujoco_joint(seed: int) -> Case:
    """20 s at 200 Hz; M1 for seed 0, M2 for seed 1, .. M6 for seed 5, and again."""
    import mujoco

    rng = np.random.default_rng([seed, 3])
    kind, Ts, every, N = seed % 6 + 1, 0.005, 20, 4000
    step = Ts / every
    load, arm = rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.12)
    armature = rng.uniform(0.003, 0.015)
    J, pull = armature + load * arm**2, load * arm * 9.81
    w = rng.uniform(15.0, 25.0)
    kp = max(J * w * w, 8.0 * pull)
    p = {
        "coulomb": kp * rng.uniform(0.01, 0.03), "stribeck": kp * 0.01, "fall": 0.15,
        "loaded": rng.uniform(0.03, 0.12), "most": kp * float(rng.choice([0.5, 10.0])),
    }  # fmt: skip
    viscous, emf = J * rng.uniform(1.0, 4.0), J * w * rng.uniform(0.6, 1.4)
    kd, late = J * w * rng.uniform(0.2, 0.6), 4 * int(rng.integers(2, 12))
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 -9.81"/>
  <worldbody><body><joint name="j" axis="0 1 0" damping="{viscous + emf}" armature="{armature}"
    frictionloss="0.01" solreffriction="0.004 1"/>
    <inertial pos="0 0 -{arm}" mass="{load}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
  <actuator><motor joint="j"/></actuator></mujoco>""")
    count = 2.0 * math.pi / 4096

    def run(kind_of_motion: int) -> tuple[F, F, F]:
        r = np.concatenate(
            [_motion(rng, N // 2, Ts, kind_of_motion), _motion(rng, N - N // 2, Ts, 1)]
        )
        data, exact = mujoco.MjData(model), np.empty(N)
        data.qpos[0] = r[0]
        mujoco.mj_forward(model, data)
        for k in range(N * every):
            if k % every == 0:
                exact[k // every] = data.qpos[0]
            q, v = float(data.qpos[0]), float(data.qvel[0])
            torque = kp * (r[max(k - late, 0) // every] - q) - kd * v
            torque = min(max(torque, -p["most"]), p["most"])
            outer = -pull * math.sin(q)
            model.dof_frictionloss[0] = _friction(kind, p, v, torque - emf * v, outer)
            data.ctrl[0] = torque
            mujoco.mj_step(model, data)
        return r, np.floor(exact / count + 0.5) * count, exact

    make = partial(_commanded, Ts=Ts, name=f"mujoco/{seed}")
    (r, y, _), (v, z, exact) = run(2), run(0)
    # half a step of the implicit damping adds to the inertia, and of the explicit one is taken
    # from it (docs/physics.md)
    J += 0.5 * step * (viscous + emf - kd)
    truth = {
        "inertia": J / kp, "friction": p["coulomb"] / kp, "stiffness": kp / J,
        "gravity": pull / kp, "delay": step * (late - 0.5), "reach": p["most"] / kp,
        "damping": kd / kp,
    }  # fmt: skip
    return Case(make(r, y), make(v, z), exact, truth)


_OF_DRIVES = {"inertia": "M", "viscous": "viscous"}
KINDS = {"drives": drive, "servos": servo, "mujoco": mujoco_joint}


def judged(case: Case, model: Any) -> float:
    """Root mean square error of the free run from the first outputs of the test."""
    e = case.test.experiments[0]
    state = model.core.estimate_initial_state(e.u[:FIRST], e.y[:FIRST])
    run = model.core.simulate(e.u, state)
    return float(np.sqrt(np.mean((run - case.clean)[FIRST:] ** 2)))


def delayed(case: Case) -> float:
    """The command, late by what suits the training record best: what a servo must beat."""

    def late(data: Dataset, y: F, n: int) -> float:
        u = data.experiments[0].u[:, 0]
        run = np.concatenate([np.full(n, u[0]), u[: len(u) - n]])
        return float(np.sqrt(np.mean((run - y)[FIRST:] ** 2)))

    own = case.train.experiments[0].y
    n = min(range(60), key=lambda n: late(case.train, own, n))
    return late(case.test, case.clean, n)


# both simulators take the position from the speed at the end of a step: half of one early
def parameters(kind: str, seed: int) -> None:
    """Print what `physics` tells: the free run over the true one, and intervals with truths."""
    case, began = KINDS[kind](seed), time.process_time()
    data = replace(case.train, output_unit=case.train.output_unit or "m")
    joint = physics(data, structure="joint")
    seconds = time.process_time() - began
    truth = dict(case.truth)
    if kind == "servos":
        kp = truth["kp"]
        truth = {
            "inertia": truth["J"] / kp, "friction": truth["coulomb"] / kp,
            "stiffness": kp / truth["J"], "gravity": truth["gravity"] / kp,
            "delay": 2.5e-4 * (truth["late"] - 0.5), "reach": truth["most"] / kp,
            "damping": truth["kd"] / kp, "dead_band": truth["dead"],
            "load_friction": truth["loaded"],
        }  # fmt: skip
    elif kind == "drives":
        truth = {n: truth[m] / truth["unit"] for n, m in _OF_DRIVES.items()}
    of, told = joint.parameters, []
    for name, true in truth.items():
        if name in of:
            holds = "" if of[name].low <= true <= of[name].high else "!"
            told.append(
                f"{name} {100 * (of[name].value / true - 1) if true else math.inf:+.1f}%{holds}"
            )
    e = case.test.experiments[0]
    own = judged(case, joint.model)
    steps = float(np.sqrt(np.mean((e.y - case.clean)[FIRST:] ** 2)))
    ratio = math.hypot(own, steps) / steps
    print(
        f"{kind} {seed}: {own / np.std(case.clean):.4f} of the spread, {ratio:.2f} of the true "
        f"free run; {', '.join(told)}; terms {', '.join(joint.terms)}; processor {seconds:.1f} s",
        flush=True,
    )


# --- real joints, as SAGE records them ------------------------------------------------------------


LEAST_SPAN = 0.1
"""Least span of a command [rad] with which a joint counts as moved in a motion."""


def motions(folder: Path, training: list[str], whole: bool) -> None:
    """Print for each joint and training motion the error on each other motion, and its share of the
    better of a linear model and the delayed command."""
    known = {f.name: read_joints(f) for f in sorted(folder.iterdir()) if f.is_dir()}
    shares: list[float] = []
    for train in training:
        for name, data in known[train].items():
            if not _moves(data):
                continue
            began = time.process_time()
            model = identify(data) if whole else physics(data).to_model()
            seconds, linear = time.process_time() - began, identify(data, model="oe")
            own = []
            for other, joints in known.items():
                if other == train or not _moves(joints[name]):
                    continue
                case = Case(data, joints[name], joints[name].experiments[0].y)
                rivals = judged(case, linear), delayed(case)
                own.append(judged(case, model) / min(rivals))
            shares += own
            print(
                f"{train} {name}: {np.median(own):.2f} of the better of oe and the delayed command "
                f"(median of {len(own)} motions; quarter {np.quantile(own, 0.75):.2f}, worst "
                f"{max(own):.2f}); processor {seconds:.1f} s",
                flush=True,
            )
    print(f"all: median {np.median(shares):.2f}, worst {max(shares):.2f}, of {len(shares)}")


def _moves(data: Dataset) -> bool:
    return float(np.ptp(data.experiments[0].u)) >= LEAST_SPAN


def main() -> None:
    """Print one row for each joint."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=list(KINDS), nargs="*", default=list(KINDS))
    parser.add_argument("--seeds", type=int, nargs="*")
    parser.add_argument("--physics", action="store_true", help="parameters only")
    parser.add_argument("--held", action="store_true", help="seeds 100 to 109")
    parser.add_argument("--sage", type=Path, help="folder of real motions")
    parser.add_argument("--train", nargs="*", default=["multisine", "random_waypoints"])
    given = parser.parse_args()
    if given.sage:
        motions(given.sage, given.train, whole=not given.physics)
        return
    seeds = given.seeds if given.seeds else range(100, 110) if given.held else range(10)
    for kind in given.kind:
        for seed in seeds:
            if given.physics:
                parameters(kind, seed)
                continue
            case = KINDS[kind](seed)
            began, cpu = time.perf_counter(), time.process_time()
            model = identify(case.train, seed=seed)
            linear = identify(case.train, model="oe")
            spread = float(np.std(case.clean))
            print(
                f"{kind} {seed}: {judged(case, model) / spread:.4f} of the spread; oe "
                f"{judged(case, linear) / spread:.4f}, delayed command "
                f"{delayed(case) / spread:.4f}; {model.kind} {model.orders}, "
                f"{time.perf_counter() - began:.1f} s, processor "
                f"{time.process_time() - cpu:.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
