"""`sewfast physics` on motors whose truth is known: errors, coverage of the intervals, time.

    python benches/physics.py --count 40             virtual machines, 20 s at 1 kHz, 1,572 counts
    python benches/physics.py --mujoco 20            one hinge in MuJoCo, damped and rubbing
    python benches/physics.py --logs 200             logs at 20 ms with gaps, spikes, wrong signs
    python benches/physics.py --coverage 200         how often intervals hold the truth
    python benches/physics.py --race 3               one joint against mujoco.sysid, same optimum
    python benches/physics.py --friction 20          Stribeck's and LuGre's friction
    python benches/physics.py --turning 20           cogging, ripple, sag, an encoder out of true
    python benches/physics.py --tracked 24           followed online: false alarms, J +10 % seen

Errors are in percent of the truth (delay in samples); `inside` counts 95 % intervals that hold it.
Seconds are those of the processor.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

import sewfast
from sewfast import _core
from sewfast.errors import DataError, FitError
from sewfast.greybox import Tracker
from sewfast.motorfit import WAVES
from sewfast.speed import speed_from_counts

SI = ("resistance_ohm", "motor_constant", "inertia", "coulomb_torque", "viscous_friction")


def truths(p: Mapping[str, float]) -> dict[str, float]:
    """What a virtual machine's parameters are in units of the command, and in SI units."""
    G, R, K = p["amplifier_gain"], p["resistance"], p["motor_constant"]
    torque = K * G / R
    return {
        "k_v": K / G + p["viscous_friction"] / torque,
        "k_a": p["inertia"] / torque,
        "k_s": p["coulomb_torque"] / torque,
        "electrical_lag": p["inductance"] / R,
        "delay": 0.0,
        "resistance_ohm": R,
        "motor_constant": K,
        "inertia": p["inertia"],
        "coulomb_torque": p["coulomb_torque"],
        "viscous_friction": p["viscous_friction"],
    }


def steps(seconds: float, Ts: float, seed: int, size: float = 8.0) -> np.ndarray:
    """Random steps in both directions."""
    return _core.random_steps(
        duration=seconds, Ts=Ts, low=-size, high=size, hold_min=50 * Ts if Ts < 0.01 else 0.2,
        hold_max=0.6 if Ts < 0.01 else 1.5, smoothing=0.0, seed=seed,
    )  # fmt: skip


def recorded(
    machine: sewfast.VirtualMachine, u: np.ndarray
) -> tuple[sewfast.Recording, np.ndarray]:
    """The run, and the current at its samples."""
    machine.reset()
    counts, current = np.empty(len(u)), np.empty(len(u))
    for k, v in enumerate(u):
        counts[k], current[k] = machine.counts, machine.current
        machine.step(float(v))
    y = speed_from_counts(counts, machine.Ts, machine.counts_per_rev)
    per_rev = machine.counts_per_rev
    return sewfast.Recording(u, counts, y, None, machine.Ts, per_rev, "steps"), current


class Tally:
    """Errors by name, and how many intervals held the truth."""

    def __init__(self) -> None:
        self.errors: dict[str, list[float]] = {}
        self.inside: dict[str, int] = {}
        self.seconds: list[float] = []

    def add(self, motor: sewfast.Motor, truth: Mapping[str, float], Ts: float) -> None:
        for name, true in truth.items():
            if name not in motor.parameters:
                continue
            found = motor.parameters[name]
            off = (found.value - true) / Ts if name == "delay" else 100 * (found.value / true - 1)
            self.errors.setdefault(name, []).append(abs(off))
            self.inside[name] = self.inside.get(name, 0) + (found.low <= true <= found.high)

    def show(self, title: str, count: int) -> None:
        print(f"{title}: {count} motors, seconds {np.median(self.seconds):.1f} median, "
              f"{max(self.seconds):.1f} worst")  # fmt: skip
        for name, off in self.errors.items():
            unit = "samples" if name == "delay" else "%"
            print(
                f"  {name:<17} told {len(off):3d}  error {np.median(off):6.3f} median "
                f"{np.quantile(off, 0.9):6.3f} 90 % {max(off):6.3f} worst {unit:<7} "
                f"inside {self.inside[name]}/{len(off)}"
            )


def virtual(count: int, first: int, seconds: float) -> None:
    alone, whole, printed = Tally(), Tally(), 0
    for seed in range(first, first + count):
        machine = sewfast.VirtualMachine(seed)
        recording, current = recorded(machine, steps(seconds, 0.001, seed))
        truth = truths(machine.parameters)
        start = time.process_time()
        motor = sewfast.physics(recording)
        alone.seconds.append(time.process_time() - start)
        printed += any(name in motor.parameters for name in SI)
        alone.add(motor, truth, machine.Ts)
        start = time.process_time()
        volts = machine.parameters["amplifier_gain"]
        motor = sewfast.physics(recording, current=current, volts=volts)
        whole.seconds.append(time.process_time() - start)
        whole.add(motor, truth, machine.Ts)
    alone.show(f"virtual machines {first} to {first + count - 1}, {seconds:g} s, no current", count)
    print(f"  printed R, Ke or J alone: {printed} of {count}")
    whole.show("with current and volts", count)


def hinge(seed: int, seconds: float) -> tuple[sewfast.Recording, np.ndarray, dict[str, float]]:
    """A rigid hinge in MuJoCo behind a motor without inductance; 1 kHz, encoder of 4,000 counts."""
    import mujoco

    rng = np.random.default_rng(seed)
    J, K = 10 ** rng.uniform(-4.5, -3), 10 ** rng.uniform(-1.6, -0.6)
    R = rng.uniform(0.5, 5.0)
    dry, viscous = rng.uniform(0.02, 0.08) * K / R * 12, rng.uniform(0.02, 0.3) * K * K / R
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.00005" integrator="RK4" gravity="0 0 0"/>
        <worldbody><body><joint type="hinge" axis="0 0 1" armature="{J - 1e-6}"
        damping="{viscous}" frictionloss="{dry}" solreffriction="-1 -1e4" name="j"/>
        <inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
        <actuator><general joint="j" gainprm="{K / R}" biastype="affine"
        biasprm="0 0 {-K * K / R}"/></actuator></mujoco>"""
    )
    data = mujoco.MjData(model)
    tau = J * R / K**2
    Ts = 0.001
    u = steps(seconds, Ts, seed, 12.0)
    counts, current = np.empty(len(u)), np.empty(len(u))
    for k, v in enumerate(u):
        counts[k] = math.floor(data.qpos[0] / math.tau * 4000)
        # read before the command of this sample acts, as a drive does
        current[k] = (data.ctrl[0] - K * data.qvel[0]) / R
        data.ctrl[0] = v
        # not its implicit integrators: they add half a step's worth of damping to the inertia and
        # half a step to the angle, which the intervals of these records are narrow enough to show
        mujoco.mj_step(model, data, 20)
    y = speed_from_counts(counts, Ts, 4000.0)
    recording = sewfast.Recording(u, counts, y, None, Ts, 4000.0, "steps")
    torque = K / R
    truth = {
        "k_v": K + viscous / torque, "k_a": J / torque, "k_s": dry / torque, "resistance_ohm": R,
        "motor_constant": K, "inertia": J, "coulomb_torque": dry, "viscous_friction": viscous,
        "time_constant": tau / (1 + viscous / torque / K),
    }  # fmt: skip
    return recording, current, truth


def simulated(count: int, seconds: float) -> None:
    tally = Tally()
    for seed in range(count):
        recording, current, truth = hinge(seed, seconds)
        start = time.process_time()
        motor = sewfast.physics(recording, current=current, volts=1.0)
        tally.seconds.append(time.process_time() - start)
        tally.add(motor, truth, recording.Ts)
    tally.show("hinges in MuJoCo, with current", count)


def ordinary(u: np.ndarray, y: np.ndarray, Ts: float) -> tuple[float, float]:
    """kV and kA by ordinary least squares of the acceleration, as WPILib's SysId has it."""
    w = y * math.tau / 60
    rows = np.stack([w[:-1], u[:-1], np.sign(w[:-1])], axis=1)
    slope = np.diff(w) / Ts
    good = np.isfinite(slope) & (np.abs(w[:-1]) > 1.0)
    alpha, beta, _ = np.linalg.lstsq(rows[good], slope[good], rcond=None)[0]
    return -alpha / beta, 1.0 / beta


def logged(seed: int) -> tuple[np.ndarray, np.ndarray, Mapping[str, float], str]:
    """A log at 20 ms: command, speed [rpm] with its defects, truths, and the worst defect."""
    rng = np.random.default_rng(seed)
    machine = sewfast.VirtualMachine(seed)
    kind = rng.choice(["steps", "steps", "steps", "ramp", "short"])
    seconds = 6.0 if kind == "short" else 30.0
    u = np.repeat(steps(seconds, 0.02, seed), 20)
    if (
        kind == "ramp"
    ):  # quasistatic: hardly an acceleration, where a regression's kA turns negative
        u = np.linspace(0.0, 8.0, len(u))
    machine.reset()
    counts = machine.run(u).counts[::20]
    y = np.diff(counts, prepend=counts[0]) / 1572 / 0.02 * 60
    u = u[::20].copy()
    for at in rng.integers(0, len(y), rng.integers(0, 8)):
        y[at : at + rng.integers(1, 20)] = np.nan
    if rng.random() < 0.2:  # a whole run that is missing
        at = rng.integers(0, len(y) // 2)
        y[at : at + len(y) // 4] = np.nan
    spikes = rng.integers(0, len(y), rng.integers(0, 12))
    y[spikes] += rng.choice([-1, 1], len(spikes)) * rng.uniform(500, 5000, len(spikes))
    if rng.random() < 0.2:
        return u, -y, truths(machine.parameters), "sign"
    return u, y, truths(machine.parameters), str(kind)


def logs(count: int) -> Iterator[str]:
    """What became of each log: kV and kA within 5 %, a refusal, or neither."""
    for seed in range(count):
        u, y, truth, defect = logged(seed)
        data = sewfast.Dataset.from_arrays(u, y, 0.02, output_unit="rpm")
        regressed = dict(zip(("k_v", "k_a"), ordinary(u, y, 0.02), strict=True))
        off = max(abs(regressed[n] / truth[n] - 1) for n in regressed)
        came = "within 5 %" if off < 0.05 else "kA < 0" if regressed["k_a"] < 0 else "off"
        yield f"(regression: {came})"
        try:
            motor = sewfast.physics(data)
        except (DataError, FitError) as refusal:
            named = defect == "sign" and "sign" in str(refusal)
            yield "refused, sign named" if named else f"{defect}, refused: {str(refusal)[:60]}"
            continue
        shown = [n for n in ("k_v", "k_a") if n in motor.parameters]
        off = max((abs(motor.parameters[n].value / truth[n] - 1) for n in shown), default=0.0)
        if off >= 0.05:
            yield f"OFF by {100 * off:.0f} %, {defect}, seed {seed}"
        else:
            missing = [n for n in ("k_v", "k_a") if n not in shown]
            yield f"{' and '.join(missing)} named as undetermined" if missing else "within 5 %"


def coverage(count: int, seconds: float) -> None:
    """How often intervals hold the truth, with a current and without."""
    for with_current in (False, True):
        tally = Tally()
        for seed in range(1000, 1000 + count):
            machine = sewfast.VirtualMachine(seed)
            recording, current = recorded(machine, steps(seconds, 0.001, seed))
            known = {"current": current, "volts": machine.parameters["amplifier_gain"]}
            start = time.process_time()
            motor = sewfast.physics(recording, **(known if with_current else {}))
            tally.seconds.append(time.process_time() - start)
            tally.add(motor, truths(machine.parameters), machine.Ts)
        what = "with" if with_current else "without"
        tally.show(f"{what} current, {seconds:g} s, seeds 1000 to {999 + count}", count)
        inside, told = sum(tally.inside.values()), sum(map(len, tally.errors.values()))
        print(f"  all: inside {inside}/{told}, {100 * inside / told:.1f} %")


ROD = """<mujoco><option timestep="0.001" integrator="implicitfast" gravity="0 0 0"/>
<worldbody><body><joint type="hinge" axis="0 0 1" armature="{J}" damping="{b}" frictionloss="{c}"
name="j" solreffriction="-1 -1e4"/>
<inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
<actuator><motor joint="j"/></actuator><sensor><jointvel joint="j" name="w"/></sensor></mujoco>"""


def race(count: int) -> None:
    """Armature, damping and dry friction of one joint, by `mujoco.sysid` and by `physics`.

    `pip install "mujoco[sysid]"` is needed for it.
    """
    import mujoco
    from mujoco import sysid

    names, seconds = ("armature", "damping", "frictionloss"), 10.0
    ratios = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        J = 10 ** rng.uniform(-3.5, -2.5)
        true = {"J": J, "b": J / rng.uniform(0.1, 0.4), "c": 0.0}
        true["c"] = rng.uniform(0.5, 2.0) * true["b"] * 10
        u = steps(seconds, 0.001, seed, 8.0) * true["b"] * 25
        spec = mujoco.MjSpec.from_string(ROD.format(**true))
        model = spec.compile()
        data = mujoco.MjData(model)
        w = np.empty(len(u))
        for k, v in enumerate(u):
            w[k] = data.qvel[0]
            data.ctrl[0] = v
            mujoco.mj_step(model, data)
        w += 0.1 * rng.standard_normal(len(w))
        params = sysid.ParameterDict()
        for name, value in zip(names, true.values(), strict=True):
            params.add(
                sysid.Parameter(
                    name, nominal=value, min_value=0.2 * value, max_value=5 * value,
                    modifier=lambda s, p, n=name: setattr(
                        s.joint("j"), n, p.value[0] if n != "damping" else [p.value[0], 0.0, 0.0]
                    ),
                )
            )  # fmt: skip
            params[name].value[:] = 1.5 * value
        t = 0.001 * np.arange(len(u))
        state = sysid.create_initial_state(model, np.zeros(1), np.zeros(1), np.zeros(0))
        # a sensor has the value before the step, and the time after it
        measured = sysid.TimeSeries.from_names(t[1:], w[:-1, None], model)
        sequences = sysid.ModelSequences(
            "joint", spec, "steps", state, sysid.TimeSeries(t, u[:, None]), measured
        )
        start = time.process_time()
        residual = sysid.build_residual_fn(models_sequences=[sequences])
        found, _ = sysid.optimize(initial_params=params, residual_fn=residual, verbose=False)
        theirs = time.process_time() - start
        start = time.process_time()
        record = sewfast.Dataset.from_arrays(u, w, 0.001, output_unit="rad/s")
        motor = sewfast.physics(record, structure=["coulomb"])
        ours = time.process_time() - start
        ratios.append(theirs / ours)
        print(f"  seed {seed}: mujoco.sysid {theirs:.2f} s, physics {ours:.3f} s")
        for name, mine, value in zip(names, ("k_a", "k_v", "k_s"), true.values(), strict=True):
            other = float(found[name].value[0])
            print(
                f"    {name:<12} true {value:.5g}  theirs {100 * (other / value - 1):+.2f} %  "
                f"ours {100 * (motor.value(mine) / value - 1):+.2f} %"
            )
    print(
        f"one joint, {count} seeds: {np.median(ratios):.0f} times as fast, least {min(ratios):.0f}"
    )


def rubbing(seeds: Sequence[int], run: int, seconds: float, kind: str) -> list[sewfast.Recording]:
    """Motors whose dry friction falls off with the speed, or is LuGre's; 1 kHz, 4,000 counts.

    Steps are small and large in turn, with many reversals and standstills. LuGre's (Canudas
    de Wit and others 1995) bends by 1 to 10 mrad before it slides.
    """
    Ts, per, motors, commands = 0.001, 20, [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        T, k_v, k_s = (
            10 ** rng.uniform(-1.8, -0.7),
            10 ** rng.uniform(-2, -1.3),
            rng.uniform(0.2, 0.8),
        )
        k_t, fall = k_s * rng.uniform(0.3, 1.0), rng.uniform(0.02, 0.08) * 8.0 / k_v
        motors.append(
            (k_v, T * k_v, k_s, k_t, fall, 10 ** rng.uniform(-3, -2), rng.uniform(0.3, 1))
        )
        sizes = np.random.default_rng([seed, run]).choice([2.0, 4.0, 8.0], math.ceil(seconds / 2))
        u = steps(seconds, Ts, 1000 * run + seed, 1.0)
        commands.append(u * np.repeat(sizes, 2000)[: len(u)])
    k_v, k_a, k_s, k_t, fall, bend, damped = np.array(motors).T
    u = np.array(commands).T
    stiff = k_s / bend
    damping = 2.0 * damped * np.sqrt(stiff * k_a)
    w, angle, bristle, angles, h = *np.zeros((3, len(seeds))), np.empty_like(u), Ts / per
    for k, command in enumerate(u):
        angles[k] = angle
        for _ in range(per):
            dry = k_s + k_t * np.exp(-((w / fall) ** 2))
            if kind == "LuGre":
                bent = (bristle + h * w) / (1.0 + h * stiff * np.abs(w) / dry)
                rate, bristle = (bent - bristle) / h, bent
                w = w + h / k_a * (command - k_v * w - stiff * bristle - damping * rate)
            else:
                free = w + h / k_a * (command - k_v * w)
                w = np.sign(free) * np.maximum(np.abs(free) - h * dry / k_a, 0.0)
            angle = angle + h * w
    counts = np.floor(angles / math.tau * 4000)
    return [
        sewfast.Recording(v, c, speed_from_counts(c, Ts, 4000.0), None, Ts, 4000.0, "steps")
        for v, c in zip(u.T.copy(), counts.T.copy(), strict=True)
    ]


def friction(count: int, first: int, seconds: float) -> None:
    """Free-run error on another record, less that of the counts, over Coulomb's."""
    seeds = range(first, first + count)
    for kind in ("Stribeck", "LuGre"):
        ratios = []
        pairs = [rubbing(seeds, run, seconds, kind) for run in (0, 1)]
        for seed, record, other in zip(seeds, *pairs, strict=True):
            speed = np.diff(other.counts, prepend=0.0) / 4000 * 60 / other.Ts
            errors = []
            for structure in (["lag", "delay", "coulomb", "offset"], "dcmotor"):
                motor = sewfast.physics(record, structure=structure)
                model = motor.simulate(other.u)
                mean = np.concatenate([[0.0], 0.5 * (model[1:] + model[:-1])])
                square = np.mean((mean - speed) ** 2) - (60 / 4000 / other.Ts) ** 2 / 6
                errors.append(math.sqrt(max(square, 0.0)))
            ratios.append(errors[1] / errors[0])
            print(f"  {kind} {seed}: Coulomb {errors[0]:.2f} RPM, all terms {errors[1]:.2f} RPM, "
                  f"{', '.join(motor.terms)}")  # fmt: skip
        print(f"{kind}, seeds {first} to {first + count - 1}: error over Coulomb's "
              f"{np.median(ratios):.2f} median, {max(ratios):.2f} worst")  # fmt: skip


OPTIONAL = ("stribeck_difference", "sag", "eccentricity")


def turning(
    seeds: Sequence[int], run: int, seconds: float
) -> list[tuple[sewfast.Recording, dict[str, float], np.ndarray]]:
    """Motors that vary over the turn, their truths and true speeds [rpm]; 1 kHz, 4,000 counts.

    Every third is even: no cogging, no ripple, a rigid supply, an encoder that runs true and
    friction that is the same in both directions. The others have one to three orders of cogging.
    """
    Ts, per, found = 0.001, 20, []
    h = Ts / per
    for seed in seeds:
        rng = np.random.default_rng(seed)
        k_v = 10 ** rng.uniform(-2, -1.3)
        k_a, tau = 10 ** rng.uniform(-1.8, -0.7) * k_v, rng.uniform(0.5e-3, 3e-3)
        k_s, w_s = rng.uniform(0.2, 0.8), rng.uniform(0.02, 0.08) * 8.0 / k_v
        k_t, varies = k_s * rng.uniform(0.4, 1.0), float(seed % 3 > 0)
        k_d = varies * k_t * rng.uniform(0.2, 0.6)
        sag = varies * rng.uniform(0.05, 0.2) / 8.0**2
        eccentric = varies * rng.uniform(0.005, 0.02)
        orders = rng.choice(np.arange(5, 40), 1 + seed % 3, replace=False)
        cogging = varies * k_s * rng.uniform(0.1, 0.4, len(orders))
        ripple_order = int(rng.choice([4, 6, 12]))
        ripple = varies * rng.uniform(0.02, 0.06)
        phases = rng.uniform(0.0, math.tau, 6)
        sizes = np.random.default_rng([seed, run]).choice([2.0, 4.0, 8.0], math.ceil(seconds / 2))
        u = steps(seconds, Ts, 1000 * run + seed, 1.0)
        u = u * np.repeat(sizes, 2000)[: len(u)]
        w = angle = x = 0.0
        share = 1.0 - math.exp(-h / tau)
        angles = np.empty(len(u))
        cogs = [
            (float(a), int(n), float(f)) for a, n, f in zip(cogging, orders, phases, strict=False)
        ]
        for k, command in enumerate(u.tolist()):
            angles[k] = angle
            for _ in range(per):
                gain = 1.0 + ripple * math.cos(ripple_order * angle + phases[5])
                load = sum(a * math.cos(n * angle + f) for a, n, f in cogs)
                x += share * (command * (1.0 - sag * command * x) - x - k_v * gain * w)
                free = w + h / k_a * (gain * x - load)
                bump = (k_t + math.copysign(k_d, free)) / (1.0 + (w / w_s) ** 2)
                w = math.copysign(max(abs(free) - h / k_a * (k_s + bump), 0.0), free)
                angle += h * w
        shown = angles + eccentric * np.sin(angles + phases[4])
        counts = np.floor(shown / math.tau * 4000)
        recording = sewfast.Recording(
            u, counts, speed_from_counts(counts, Ts, 4000.0), None, Ts, 4000.0, "steps"
        )
        truth = {"k_v": k_v, "k_a": k_a, "k_s": k_s, "electrical_lag": tau, "stribeck": k_t}
        if varies:
            truth |= {f"load_{n}": a for a, n, _ in cogs}
            truth |= {"stribeck_difference": k_d, "sag": sag, "eccentricity": eccentric}
            truth["torque_ripple"] = ripple
        found.append((recording, truth, np.diff(angles, prepend=0.0) / math.tau * 60 / Ts))
    return found


def varying(count: int, first: int, seconds: float) -> None:
    """Terms of the turn and of the supply: found, missed, wrong; free run on another record."""
    usual, all_of, missed, wrong, ratios = Tally(), Tally(), 0, 0, []
    plain = [t for t in sewfast.greybox.fit.STRUCTURES["dcmotor"] if t not in WAVES]
    seeds = range(first, first + count)
    pairs = [turning(seeds, run, seconds) for run in (0, 1)]
    for seed, (record, truth, _), (other, _, speed) in zip(seeds, *pairs, strict=True):
        errors = []
        for structure in (plain, "dcmotor", ["dcmotor", *OPTIONAL]):
            start = time.process_time()
            motor = sewfast.physics(record, structure=structure)
            took = time.process_time() - start
            model = motor.simulate(other.u)
            mean = np.concatenate([[0.0], 0.5 * (model[1:] + model[:-1])])
            errors.append(float(np.sqrt(np.mean((mean - speed) ** 2))))
            if structure == "dcmotor":
                usually = motor
            if structure is not plain:
                tally = usual if structure == "dcmotor" else all_of
                tally.add(motor, truth, record.Ts)
                tally.seconds.append(took)
        waves = {n for n in usually.parameters if n.startswith("load_")} - {"load_1", "load_2"}
        extra = {n for n in (*OPTIONAL, "torque_ripple") if n in usually.parameters}
        true = {n for n in truth if n.startswith("load_")}
        missed += len(true - waves)
        wrong += len(waves - true) + len(extra - set(truth))
        ratios.append([errors[1] / errors[0], errors[2] / errors[0]])
        print(f"  seed {seed}: {errors[0]:.2f}, {errors[1]:.2f}, {errors[2]:.2f} RPM; "
              f"true {sorted(true)}, found {sorted(waves)} {sorted(extra)}")  # fmt: skip
    usual.show("dcmotor", count)
    all_of.show(f"with {', '.join(OPTIONAL)}", count)
    middle, worst = np.median(ratios, axis=0), np.max(ratios, axis=0)
    print(f"waves missed {missed}, terms that are not there {wrong}; error over that without "
          f"{middle[0]:.2f} median {worst[0]:.2f} worst, "
          f"with all {middle[1]:.2f}, {worst[1]:.2f}")  # fmt: skip


def tracked(count: int, seconds: float) -> None:
    """Machines followed once their estimate is sure, then also with a tenth more inertia."""
    false, seen, share, waited = dict.fromkeys(("k_v", "k_a", "k_s"), 0), [], [], []
    for seed in range(200, 200 + count):
        machine = sewfast.VirtualMachine(seed)
        heavier = {**machine.parameters, "inertia": 1.1 * machine.parameters["inertia"]}
        u = steps(seconds, 0.001, seed)
        ys = []
        for one in (machine, sewfast.VirtualMachine(parameters=heavier)):
            one.reset()
            ys.append(np.diff(one.run(u).counts, prepend=0) / 1572 * math.tau / 0.001)
        lag = truths(machine.parameters)["electrical_lag"]
        for y, is_same in zip(ys, (True, False), strict=True):
            tracker, start = Tracker(Ts=0.001, speed=300.0, lag=lag), 5000
            tracker.run(u[:start], ys[0][:start])
            tracker.watch()
            while tracker.waits:
                tracker.run(u[start : start + 100], ys[0][start : start + 100])
                start += 100
            waited.append(start / 1000)
            reference = tracker.estimate["k_a"]
            track = tracker.run(u[start:], y[start:])
            if is_same:
                for name in false:
                    false[name] += int(np.sum(np.diff(track.moved[name].astype(int)) == 1))
                share.append(100 * float(track.estimates["k_a"].std()) / reference)
            else:
                at = np.flatnonzero(track.moved["k_a"])
                seen.append(float(at[0]) / 1000 if len(at) else math.inf)
    hours = (count * seconds - sum(waited) / 2.0) / 3600
    print(
        f"{count} machines followed for {seconds:g} s: false alarms {false} in {hours:.1f} h, "
        f"k_a within {np.median(share):.2f} % (standard deviation, median)\n"
        f"  a tenth more inertia seen after {np.median(seen):.1f} s median, {max(seen):.1f} worst; "
        f"within 2 s {sum(s <= 2 for s in seen)}/{count}\n"
        f"  watched from {np.median(waited):.0f} s on, {max(waited):.0f} at the latest"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--mujoco", type=int, default=0)
    parser.add_argument("--logs", type=int, default=0)
    parser.add_argument("--tracked", type=int, default=0)
    parser.add_argument("--coverage", type=int, default=0)
    parser.add_argument("--race", type=int, default=0)
    parser.add_argument("--friction", type=int, default=0)
    parser.add_argument("--turning", type=int, default=0)
    args = parser.parse_args()
    if args.count:
        virtual(args.count, args.first, args.seconds)
    if args.mujoco:
        simulated(args.mujoco, args.seconds)
    if args.friction:
        friction(args.friction, args.first, args.seconds)
    if args.turning:
        varying(args.turning, args.first, args.seconds)
    if args.tracked:
        tracked(args.tracked, 120.0)
    if args.coverage:
        coverage(args.coverage, args.seconds)
    if args.race:
        race(args.race)
    if args.logs:
        found = list(logs(args.logs))
        print(f"{args.logs} logs at 20 ms")
        for outcome in sorted(set(found)):
            print(f"  {outcome}: {found.count(outcome)}")


if __name__ == "__main__":
    main()
